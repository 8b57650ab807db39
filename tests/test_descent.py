"""Steps of a fit: closed cases on a paraboloid."""

from dataclasses import dataclass, replace
from types import SimpleNamespace

import numpy as np
import pytest

from ident import torque_fit
from ident.descent import Criterion, Point, descend, nuisances
from ident.extended import predict
from ident.hypotheses import catalogue
from ident.model import Effect, Model
from ident.torque_fit import fit

CURVATURE = np.array([[2.0, 0.3, 0.1], [0.3, 1.0, 0.2], [0.1, 0.2, 3.0]])
LOWEST = np.array([5.0, -4.0, 20.0])
JUMP = 1e6


def model(*nuisance):
    """One drive parameter, the timing, and an effect with some parameters."""
    parameters = [SimpleNamespace(nuisance=x) for x in nuisance]
    effect = SimpleNamespace(hypothesis=SimpleNamespace(parameters=parameters, options={}, effect="a law"))
    return SimpleNamespace(par=SimpleNamespace(to_log=lambda: np.zeros(0)), effects=(effect,))


def value(x):
    return float((x - LOWEST) @ CURVATURE @ (x - LOWEST))


@dataclass(frozen=True)
class Bowl(Criterion):
    """``value``, and a jump where the last coordinate grows."""

    jumps: bool = False
    longest: float = np.inf

    def stepped(self, at, step, anew):
        if np.linalg.norm(step) > self.longest:
            return None
        x = at.x + step
        jump = JUMP if self.jumps and x[-1] > at.x[-1] else 0.0
        return Point(at.model, x, [], [], value(x) + jump)

    def cut(self, at, step):
        return step


def step_of(jumps, last_is_nuisance, monkeypatch, x=np.zeros(3), longest=np.inf):
    monkeypatch.setattr("ident.descent.is_slow", lambda model: False)
    here = Point(model(False, last_is_nuisance), x, [], [], value(x))
    bowl = Bowl(None, None, np.zeros(3), np.zeros(3), jumps=jumps, longest=longest)
    return descend(bowl, here, CURVATURE, CURVATURE @ (LOWEST - x), 1e-9, False)


def test_a_step_leads_to_the_lowest_point_of_a_paraboloid(monkeypatch):
    step, damping = step_of(False, True, monkeypatch)
    assert step.to.x == pytest.approx(LOWEST, rel=1e-6) and damping == 1e-9
    assert step.gain == pytest.approx(step.foretold)


def test_a_step_says_by_which_damping_it_was_taken(monkeypatch):
    """The next one begins there: where it does not, each climbs up to it again."""
    whole = np.linalg.norm(LOWEST)
    step, damping = step_of(False, True, monkeypatch, longest=0.9 * whole)
    assert 1e-2 < damping < 10.0 and np.linalg.norm(step.to.x) < 0.9 * whole
    step, damping = step_of(True, True, monkeypatch, longest=0.5 * whole)
    assert damping == 1e-9 and step.to.x[-1] == 0.0


def test_where_a_law_jumps_with_how_it_is_formed_the_others_step_on(monkeypatch):
    """A fit had ended there, and what it had not found was another cause's."""
    step, _ = step_of(True, True, monkeypatch)
    among = np.linalg.solve(CURVATURE[:2, :2], (CURVATURE @ LOWEST)[:2])
    assert step.to.x == pytest.approx([*among, 0.0], abs=1e-6)
    assert 0.0 < step.gain == pytest.approx(step.foretold)


def test_no_step_where_what_jumps_is_of_the_law_itself_or_nothing_is_gained(monkeypatch):
    assert step_of(True, False, monkeypatch)[0] is None
    assert step_of(True, True, monkeypatch, x=LOWEST)[0] is None


def test_nuisances_are_parameters_of_effects():
    assert nuisances(model(False, True)).tolist() == [False, False, True]


@pytest.mark.parametrize(("exact", "close"), [(True, True), (False, False)])
def test_columns_are_made_exactly_where_the_others_hardly_get_on(identified, monkeypatch, exact, close):
    """Those of a gear that hardens much see no valley along which its spring and its cube go together; each step of a
    fit had gained a little less than the one before, and it had ended far from the lowest point."""
    _, setup, best = identified
    par, structure = best.model.par, setup.problem.structure
    gear = next(h for h in catalogue(structure) if h.key == ("hardening_stiffness", "elbow_joint"))
    start = Model(structure, replace(par, stiffness=1.01 * par.stiffness), (Effect(gear, np.array([1e6])),))
    lowest = fit(setup.problem, start, remainders=best.remainders)
    made, asked = torque_fit.jacobians, []

    def jacobians(problem, model, preds, exact):
        asked.append(exact)
        return made(problem, model, preds, exact=exact)

    def equations(*args, of=torque_fit.normal_equations):
        H, b = of(*args)
        return (H, b) if asked[-1] else (16.0 * H, 4.0 * b)  # steps of a quarter

    monkeypatch.setattr(torque_fit, "jacobians", jacobians)
    monkeypatch.setattr(torque_fit, "normal_equations", equations)
    found = fit(setup.problem, start, iterations=8, remainders=best.remainders, exact=exact)
    assert (found.cost - lowest.cost < 1.0) == close
    assert asked[:2] == [False, False]


def test_the_linear_arm_is_made_anew_where_the_drives_are_others_alone(identified):
    _, setup, result = identified
    problem, group = setup.problem, setup.problem.groups[0]
    there = predict(result.model, group, problem.sampling)
    same = predict(replace(result.model), group, problem.sampling, near=there)
    assert same.plane is there.plane and np.array_equal(same.U, there.U)
    par = replace(result.model.par, viscous=1.01 * result.model.par.viscous)
    other = replace(result.model, par=par)
    moved = predict(other, group, problem.sampling, near=there)
    assert moved.plane is not there.plane
    assert np.array_equal(moved.U, predict(other, group, problem.sampling).U)
    later = replace(problem.sampling, roll_off=1e-6)
    assert predict(result.model, group, later, near=there).plane is not there.plane
    few = group.pick(np.arange(1))
    assert predict(result.model, few, problem.sampling, near=there).plane is not there.plane
