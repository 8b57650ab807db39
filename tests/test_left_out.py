"""What is left of parts of motions that a model was not fitted to, and fits beside an error that is no noise."""

from dataclasses import replace

import numpy as np
import pytest

from ident.attribute import attribute
from ident.dataset import Dataset, Segment
from ident.hypotheses import catalogue
from ident.identification import identify
from ident.left_out import carries_over
from ident.model import Effect
from ident.parallel import Workers
from ident.refits import beside_its_error, polish
from robot_assets.robot import load_robot
from tests.conftest import through_postures

pytestmark = pytest.mark.xdist_group("left_out")  # one worker makes what they share

RATE, SECONDS, COULOMB = 100.0, 60.0, 20.0
WANDER = 8.0  # N, of a force that follows nothing


def wandering(rng, t):
    """A force that drifts along, of as many turns in the record as noise has that is averaged over two seconds."""
    steps = rng.normal(size=len(t))
    width = int(2.0 * RATE)
    slow = np.convolve(steps, np.hanning(width), mode="same")
    return WANDER * slow / slow.std()


@pytest.fixture(scope="module")
def wandered():
    """Motions of one linear drive, with friction and a force that nothing of the model explains; the problem and the
    fit without any cause."""
    robot, segments = load_robot("emps"), []
    for i, role in enumerate(("identification", "validation")):
        rng = np.random.default_rng(40 + i)
        t, q, v, a = (0.3 * x if x.ndim > 1 else x for x in through_postures(rng, 1, RATE, SECONDS))
        force = 95.1 * a + 203.5 * v + COULOMB * np.sign(v) + wandering(rng, t)[:, None]
        tau = force + 0.01 * rng.normal(size=force.shape)
        segments.append(Segment(name=f"m{i}", role=role, kind="trajectory", t=t, tau=tau, q=q))
    data = Dataset(
        name="wandered",
        robot=robot,
        sample_rate=RATE,
        joints=robot.joint_names,
        input_hold="none",
        q_std=np.full(1, 1e-7),
        tau_std=np.full(1, 0.01),
        controller=None,
        segments=tuple(segments),
    )
    setup, first = identify(data)
    return setup.problem, first


def beside(problem, fit, name, *p):
    h = next(h for h in catalogue(problem.structure, motions_alone=True) if h.effect == name)
    size = len(h.parameters)
    effect = Effect(h, np.array([*p, *(q.center or 1.0 for q in h.parameters[len(p) :])][:size]))
    return polish(problem, replace(fit, model=replace(fit.model, effects=(*fit.model.effects, effect))))


def test_a_law_that_is_there_lowers_what_is_left_of_parts_left_out_and_one_that_is_not_does_not(wandered):
    problem, first = wandered
    friction = beside(problem, first, "coulomb_friction", 10.0, 0.0)
    assert friction.chi2_per_dof > 1e3  # far from the noise with the right law
    assert carries_over(problem, first, friction, 0, Workers())
    cogging = beside(problem, friction, "cogging", 1.0, 1.0, 40.0)
    assert friction.cost - cogging.cost > 25.0 * friction.chi2_per_dof  # more than chance, were what is left noise
    assert not carries_over(problem, friction, cogging, 0, Workers())


def test_the_search_in_motions_stops_where_laws_follow_what_was_driven_alone(wandered):
    problem, first = wandered
    some = {"coulomb_friction", "load_dependent_friction", "cogging", "gravity_spring", "torque_constant"}
    some = [h for h in catalogue(problem.structure, motions_alone=True) if h.effect in some]
    found = attribute(problem, first, hypotheses=some)
    effects = [e for e in found.final.model.effects if not e.hypothesis.decoy]
    assert [e.hypothesis.effect for e in effects] == ["coulomb_friction"]
    assert found.left_share > 0.0 and found.final.chi2_per_dof > 1e3


def test_what_is_found_beside_an_error_of_the_model_is_known_as_well_as_that_lets_it(wandered):
    problem, first = wandered
    friction = beside(problem, first, "coulomb_friction", 10.0, 0.0)
    last = beside_its_error(problem, friction)
    at = last.names.index(last.model.effects[-1].hypothesis.coordinate("torque"))
    std = np.sqrt(last.covariance()[at, at])
    assert abs(np.log(last.model.effects[-1].p[0] / COULOMB)) < 3.0 * std and std < 0.1
    assert last.cost == pytest.approx(friction.cost, rel=0.1)  # in units of the noise
    near = replace(friction, costs=friction.counts)
    assert beside_its_error(problem, near) is near
