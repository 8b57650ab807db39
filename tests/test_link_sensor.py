"""Link encoders that come late, seen against the motion of the links that the model predicts."""

import numpy as np
import pytest

from ident.diagnosis import diagnose
from ident.plan import make_plan
from robot_assets.robot import load_robot
from sim.effects import make_effect
from sim.experiment import draw_drives
from tests.conftest import quick_experiment, small_plan, through_files


@pytest.mark.parametrize("seed", [11, pytest.param(12, marks=pytest.mark.slow)])
def test_a_late_link_encoder_is_named_and_no_other_cause(ur10, tmp_path, seed):
    rng = np.random.default_rng(seed)
    place, delay = str(rng.choice(ur10.joint_names)), float(rng.uniform(5e-4, 4e-3))
    effect = make_effect("sensor_delay", place, delay=delay, channel="q_link")
    data = quick_experiment(
        small_plan(ur10, seed, levels=(1.0,), period=1000),
        [effect],
        seed=seed,
        drives=draw_drives(rng, ur10),
        link_encoders=True,
    )
    verdict = diagnose(through_files(data, tmp_path))
    assert [(c.effect, c.joint, c.channel) for c in verdict.causes] == [("sensor_delay", place, "q_link")]
    assert verdict.causes[0].parameters["delay"].value == pytest.approx(delay, rel=0.02)
    assert verdict.discrepancy.detected and verdict.unexplained_verdict == "noise floor reached"


@pytest.mark.slow
def test_link_encoders_on_time_are_not_named(ur10, tmp_path):
    drives = draw_drives(np.random.default_rng(13), ur10)
    data = quick_experiment(
        small_plan(ur10, 13, levels=(1.0,), period=1000), [], seed=13, drives=drives, link_encoders=True
    )
    assert not diagnose(through_files(data, tmp_path)).causes


@pytest.mark.parametrize(("channel", "recorded"), [("q_link", True), ("q", False)])
def test_a_late_link_encoder_is_recorded_unasked(channel, recorded):
    robot = load_robot("twomass")
    hidden = make_effect("sensor_delay", robot.joint_names[0], delay=5e-3, channel=channel)
    plan = make_plan(robot, points=1, validation_points=0, levels=(1.0,), period=200, trajectory=False)
    (segment, *_) = quick_experiment(plan, [hidden]).segments
    assert (segment.q_link is not None) == recorded
