"""What the arm swings by itself from period to period: taken off exactly, and no noise any more."""

from dataclasses import dataclass, replace
from types import SimpleNamespace

import numpy as np
import pytest

from ident.identification import identify
from ident.parallel import Workers
from ident.plan import make_plan
from ident.problem import predictions
from ident.seek import beside_steady_records
from ident.swings import by_ends, without_swings
from robot_assets.robot import load_robot
from sim import run_experiment


def test_ends_of_periods_are_taken_off(identified):
    _, setup, result = identified
    problem, rng = setup.problem, np.random.default_rng(2)
    preds = predictions(problem, result.model, result.remainders)
    swung = []
    for group, pred in zip(problem.groups, preds, strict=True):
        lines = np.arange(1, group.n_compared)
        basis = by_ends(pred, lines)
        size = np.linalg.norm(basis, axis=(0, 1))
        each = rng.normal(size=(*group.U_periods.shape[:2], basis.shape[-1])) / size
        U = group.U_periods.copy()
        U[:, :, lines] += 10.0 * np.linalg.norm(group.U[:, lines]) * np.einsum("kim,spm->spki", basis, each)
        swung.append(replace(group, U_periods=U, U=U.mean(axis=1)))
    plain = without_swings(problem, result).groups
    again = without_swings(replace(problem, groups=tuple(swung)), result).groups
    for a, b, c, g in zip(plain, again, swung, problem.groups, strict=True):
        off = np.linalg.norm(c.U[:, 1 : g.n_compared] - g.U[:, 1 : g.n_compared])
        assert np.linalg.norm((a.U - b.U)[:, 1 : g.n_compared]) < 3e-4 * off  # images of the held torque hold it too
        # Of noise alone next to nothing: few numbers of many.
        assert np.linalg.norm(a.U - g.U) < 0.01 * off
    assert problem.groups[0].U is setup.problem.groups[0].U


@pytest.mark.slow
def test_a_link_that_goes_on_swinging_is_no_noise():
    """Hardly damped, it is excited by noise in the loop; its noise had been 70 times too large at the resonance."""
    robot = load_robot("twomass")
    setup, baseline = identify(run_experiment(make_plan(robot, trajectory=False, points=2), [], seed=4))
    assert baseline.chi2_per_dof == pytest.approx(1.0, abs=0.15)
    assert setup.problem.tau_std == pytest.approx(robot.array("tau_std"), rel=0.15)


@pytest.mark.slow
@pytest.mark.parametrize("scale", [1.0, 1.5])
def test_nothing_is_taken_off_where_a_model_is_far_from_the_data(clean, monkeypatch, scale):
    """A part of what is missing would go with it."""
    asked = []
    for module in ("identification", "swings"):
        monkeypatch.setattr(f"ident.{module}.drifting", lambda groups: np.ones(6, bool))
    monkeypatch.setattr("ident.identification.without_swings", lambda problem, result: asked.append(result) or problem)
    wrong = np.where(np.arange(6) == 1, scale, 1.0)
    data = replace(clean[0], segments=tuple(replace(s, tau=s.tau * wrong) for s in clean[0].segments))
    _, result = identify(data)
    assert (result.chi2_per_dof > 3.0) == (scale > 1.0) == (not asked)


@dataclass(frozen=True)
class Stage:
    problem: str


@pytest.mark.parametrize(("left", "first", "again"), [(2.0, 20.0, True), (1.0, 20.0, False), (2.0, 2.0, False)])
def test_records_are_taken_without_swings_beside_causes_that_bring_the_model_near(monkeypatch, left, first, again):
    """And not where next to nothing is left, or where the first model was as near."""
    baseline, final = (SimpleNamespace(chi2_per_dof=x) for x in (first, left))
    asked = []
    monkeypatch.setattr("ident.seek.swings", lambda problem, fit: fit.chi2_per_dof < 3.0)
    monkeypatch.setattr("ident.seek.without_swings", lambda problem, fit: f"{problem} without {fit.chi2_per_dof}")
    monkeypatch.setattr("ident.seek.renewed", lambda problem, fit: fit)
    monkeypatch.setattr("ident.seek.attribute", lambda problem, fit, known, **rest: asked.append(problem) or known)
    result = SimpleNamespace(rounds=["a cause"], final=final)
    setup, *_ = beside_steady_records(Stage("records"), baseline, result, 4, Workers())
    assert asked == (["records without 2.0"] if again else [])
    assert setup.problem == (asked[0] if again else "records")
