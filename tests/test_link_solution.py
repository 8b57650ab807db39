"""The motion of the links along a given motion of the motors: a fixed point of the geometric remainder."""

from dataclasses import replace

import numpy as np
import pytest

from ident import inverse
from ident.coordinates import pack, unpack
from ident.derivatives import jacobian
from ident.extended import predict
from ident.identification import set_up
from ident.inverse import (
    NEWTON_STEPS,
    REMAINDER_STEPS,
    baseline_products,
    geometric_remainder,
    make_plane,
    solve,
    static_remainder,
    true_position,
)
from ident.model import Model
from robot_assets.robot import load_robot
from tests.conftest import quick_experiment, small_plan, through_files


@pytest.mark.parametrize(("share", "larger"), [(1.0, 6.0), (0.03, 6.0), (0.1, 16.0), (0.3, 40.0)])
def test_links_on_lightly_damped_gears_are_solved_along_large_motions(clean, monkeypatch, share, larger):
    """Where gears hardly damp and links move far, steps by the arm at rest lead away, and those by the arm along the
    motion lead there."""
    looks, plain = [], inverse.geometric_remainder
    monkeypatch.setattr(inverse, "geometric_remainder", lambda *args: looks.append(1) or plain(*args))
    problem = set_up(clean[0]).problem
    group = next(g for g in problem.groups if g.window is None)
    light = replace(problem.nominal, damping=share * problem.nominal.damping)
    structure, par = Model(problem.structure, light).built
    plane = make_plane(structure, par, group, problem.sampling)
    large = true_position(structure, par, plane, group, problem.sampling).copy()
    large[:, 1:] *= larger
    found = solve(structure, par, plane, group, problem.sampling, Q=large, steps=REMAINDER_STEPS)
    assert len(looks) < 60
    left = geometric_remainder(structure, plane, group, found.Q_a) - found.W
    assert np.abs(left).max() < 1e-5 * np.abs(found.W).max()


def test_a_step_that_is_asked_for_is_taken(clean):
    """Differences to models near by stand on it."""
    problem = set_up(clean[0]).problem
    group = next(g for g in problem.groups if g.window is None)
    structure, par = Model(problem.structure, problem.nominal).built
    plane = make_plane(structure, par, group, problem.sampling)
    far = static_remainder(structure, par, plane, group)
    far[:, 1:40] += 1e-2 * np.abs(far).max()

    def left(steps):
        found = solve(structure, par, plane, group, problem.sampling, W=far, steps=steps)
        return np.abs(geometric_remainder(structure, plane, group, found.Q_a) - found.W).max()

    assert left(2) < 0.3 * left(1) and left(1) < 0.3 * left(0)


def test_a_single_axis_without_a_remainder_takes_one_step(tmp_path, monkeypatch):
    robot = load_robot("twomass")
    problem = set_up(through_files(quick_experiment(small_plan(robot, 4, period=1000), [], seed=4), tmp_path)).problem
    asked = []
    plain = inverse.geometric_remainder
    monkeypatch.setattr(inverse, "geometric_remainder", lambda *args: asked.append(1) or plain(*args))
    predict(Model(problem.structure, problem.nominal), problem.groups[0], problem.sampling)
    assert len(asked) == 1


def test_links_whose_motion_does_not_repeat_are_given_up(clean, monkeypatch):
    """As of a gear that hits one end of its dead band after the other: every look at it shows another motion."""
    problem = set_up(clean[0]).problem
    asked, rng, plain = [], np.random.default_rng(2), inverse.geometric_remainder

    def unsettled(*args):
        asked.append(1)
        out = plain(*args)
        return out + np.abs(out).max() * rng.normal(size=out.shape)

    monkeypatch.setattr(inverse, "geometric_remainder", unsettled)
    predict(Model(problem.structure, problem.nominal), problem.groups[0], problem.sampling)
    assert 2 * NEWTON_STEPS <= len(asked) < REMAINDER_STEPS


def test_derivatives_follow_links_whose_motion_took_the_links_along_it_to_find(clean, monkeypatch):
    """With the remainder held those of the gears point elsewhere, and a fit of such arms ends nowhere."""
    problem = set_up(clean[0]).problem
    group = next(g for g in problem.groups if g.window is None).pick(np.arange(2))
    plane = make_plane(problem.structure, problem.nominal, group, problem.sampling)
    Q = true_position(problem.structure, problem.nominal, plane, group, problem.sampling).copy()
    Q[:, 1:] *= 30.0
    group = replace(group, Q=Q)
    model = Model(problem.structure, replace(problem.nominal, damping=0.3 * problem.nominal.damping))
    problem = replace(problem, groups=(group,), sampling=replace(problem.sampling, hold="none"))
    at = predict(model, group, problem.sampling)
    there = at.solution
    assert there.torques.varying is not None
    found = jacobian(problem, model, group, at).dense()
    held = baseline_products(at.structure, at.par, at.plane, there, found.shape[1]).dense()
    monkeypatch.setattr(inverse, "NEAR_CHANGE", 1e-8)
    x, n = pack(model), model.structure.n

    def solved(x):
        model_there, begin = unpack(model, x, np.inf), {"W": there.W, "torques": there.torques}
        return predict(model_there, group, problem.sampling, steps=REMAINDER_STEPS, **begin).U[:, : found.shape[1]]

    for c in (1, n + 2):  # stiffness of a gear, damping of another
        step = 1e-4 * (np.arange(len(x)) == c)
        expected = (solved(x + step) - solved(x - step)) / 2e-4
        off = [np.linalg.norm(J[..., c] - expected) / np.linalg.norm(expected) for J in (found, held)]
        assert off[0] < 0.1 < 0.5 < off[1]
