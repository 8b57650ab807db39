"""The experiment that separates two hypotheses: closed cases, and one round trip to a plan."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from ident.evidence import Candidate
from ident.hypotheses import catalogue
from ident.model import Effect, Model
from ident.next_experiment import _Option, _options, _separation, advice, moved, separating_experiment, within_reach
from ident.plan_file import plan_from_toml, plan_to_toml
from ident.torque_fit import fit


@pytest.fixture(scope="module")
def fitted(clean):
    """Problem, and the baseline, a hardening gear and Coulomb friction at the elbow, each as it stands."""
    from ident.identification import identify

    setup, baseline = identify(clean[0])
    named = {h.key: h for h in catalogue(setup.problem.structure)}

    def with_effect(effect, *p):
        h = named[effect, "elbow_joint"]
        model = Model(setup.problem.structure, baseline.model.par, (Effect(h, np.array(p, float)),))
        return h, fit(setup.problem, model, iterations=0, remainders=baseline.remainders)

    return (
        setup.problem,
        baseline,
        with_effect("hardening_stiffness", 1e9),
        with_effect("coulomb_friction", 0.2, 0.0, 1e-3, 0.0),
    )


def option(problem, factor, shift=0.0):
    group = next(g for g in problem.groups if g.window is None)
    return _Option(moved(group.pick(np.arange(2)), factor, 2, shift), factor, 2, shift)


def test_a_model_is_not_separated_from_itself(fitted):
    problem, baseline, (_, hard), _ = fitted
    for result in (baseline, hard):
        assert _separation(problem, option(problem, 2.0), result, result) == pytest.approx(0.0, abs=1e-6)


def test_what_cannot_be_computed_separates_nothing(fitted):
    problem, baseline, (_, hard), _ = fitted
    for lost in (np.nan, np.inf):
        unknown = replace(hard, information=lost * hard.information)
        assert _separation(problem, option(problem, 2.0), baseline, unknown) == 0.0


def test_what_the_drives_can_take_up_does_not_separate(fitted):
    """A stiffness that differs by 1 % is a parameter of both models: only where it is known already does it tell."""
    problem, baseline, _, _ = fitted
    par = baseline.model.par
    stiffer = replace(baseline, model=replace(baseline.model, par=replace(par, stiffness=1.01 * par.stiffness)))

    def separation(known):
        return _separation(
            problem, option(problem, 1.0), *(replace(x, information=known * x.information) for x in (stiffer, baseline))
        )

    assert 0 < separation(1e-6) < 0.05 * separation(1e6)


def test_a_cubic_spring_shows_more_the_larger_the_motion(fitted):
    problem, baseline, (_, hard), _ = fitted
    small, large = (_separation(problem, option(problem, f), baseline, hard) for f in (0.5, 2.0))
    # Under gravity the cube is first of all a stiffness of its own in every posture: its torque goes with the
    # motion, and the evidence with the square of that.
    assert 0 < 8 * small < large


def test_the_plan_is_one_that_the_arm_can_run(fitted, tmp_path):
    problem, baseline, (gear, hard), (rub, friction) = fitted
    candidates = (Candidate(gear, hard, 0.0, 0.55), Candidate(rub, friction, -0.2, 0.45))
    result = SimpleNamespace(rounds=(SimpleNamespace(candidates=candidates),), baseline=baseline)
    found = separating_experiment(problem, result)
    assert "hardening_stiffness at elbow_joint" in found.text and "coulomb_friction at elbow_joint" in found.text
    assert found.nats > 5
    plan_to_toml(found.plan, tmp_path / "next_plan.toml")
    again, robot = plan_from_toml(tmp_path / "next_plan.toml"), problem.structure.robot
    assert {e.operating_point for e in again.experiments} == {"op01"} and len(
        {e.amplitude for e in again.experiments}
    ) == 3
    q0 = again.experiments[0].q0
    assert np.all(q0 > robot.q_min) and np.all(q0 < robot.q_max)


@pytest.mark.parametrize("joint", [-1, 2])
def test_an_axis_is_moved_by_no_more_than_it_has_room_for(fitted, joint):
    problem = fitted[0]
    groups = [g for g in problem.groups if g.window is None]
    robot, at = problem.structure.robot, groups[0].posture
    short = replace(robot, q_min=at - 0.1, q_max=at + 0.1)
    options = list(_options(SimpleNamespace(structure=SimpleNamespace(robot=short)), groups[:1], joint))
    assert {round(o.shift, 9) for o in options} >= {-0.06, 0.06} and all(abs(o.shift) < 0.061 for o in options)


def test_a_motion_that_leaves_the_range_or_is_too_fast_is_not_planned(fitted):
    problem = fitted[0]
    group = next(g for g in problem.groups if g.window is None)
    robot, joint = problem.structure.robot, 2
    at, Q = group.posture, group.Q * (group.omega > 0)[:, None]
    swing = np.abs(group.to_time(Q)).max(axis=(0, 1))
    fastest = np.abs(group.to_time(1j * group.omega[:, None] * Q)).max(axis=(0, 1))
    room = replace(robot, q_min=at - 3.0 * swing, q_max=at + 3.0 * swing)
    assert within_reach(room, group, 2.0, joint, 0.0)
    assert not within_reach(room, group, 4.0, joint, 0.0)
    assert within_reach(room, group, 1.0, joint, 1.5 * swing[joint])
    assert not within_reach(room, group, 1.0, joint, 2.5 * swing[joint])
    slow = replace(
        room, joints=tuple(replace(j, velocity_limit=1.5 * v) for j, v in zip(robot.joints, fastest, strict=True))
    )
    assert not within_reach(slow, group, 2.0, joint, 0.0) and within_reach(slow, group, 1.0, joint, 0.0)


def test_where_no_experiment_can_be_made_none_is_planned(fitted, monkeypatch):
    """A load on a single axis has no other posture, and is its torque constant to every motion."""
    problem, _, (gear, hard), (rub, friction) = fitted
    scaled = replace(rub, effect="torque_constant")
    candidates = (Candidate(gear, hard, 0.0, 0.55), Candidate(scaled, friction, -0.2, 0.45))
    monkeypatch.setattr("ident.next_experiment._options", lambda *args: iter(()))
    found = separating_experiment(problem, SimpleNamespace(rounds=(SimpleNamespace(candidates=candidates),)))
    assert found.plan is None and found.nats == 0.0 and "of 0 experiments" in found.text
    assert "known mass" in found.text


def test_a_sure_cause_asks_for_nothing(fitted):
    problem, _, (gear, hard), (rub, friction) = fitted
    candidates = (Candidate(gear, hard, 0.0, 0.95), Candidate(rub, friction, -3.0, 0.05))
    assert separating_experiment(problem, SimpleNamespace(rounds=(SimpleNamespace(candidates=candidates),))) is None


@pytest.mark.parametrize(("axes", "there"), [(6, "postures"), (1, "positions of the axis")])
def test_advice_asks_for_what_the_robot_can_do(axes, there):
    other = SimpleNamespace(effect="payload", joint="flange")
    doubtful, sure = (
        SimpleNamespace(effect="cogging", joint="j", probability=p, alternatives=(other,)) for p in (0.6, 0.95)
    )
    asked = advice((doubtful,), True, axes)
    assert f"two more {there}" in asked and asked.startswith("To tell cogging at j from payload at flange:")
    other.joint = "j"
    assert advice((doubtful,), True, axes).startswith("To tell cogging from payload at j:")
    assert f"two more {there}" in advice((sure,), True, axes) and advice((sure,), False, axes) is None
