"""What a recorder of the torque loses at all joints is no cause, and what one joint loses is none of the recorder's."""

from dataclasses import replace

import numpy as np
import pytest

from ident.diagnosis import diagnose
from ident.identification import identify
from ident.plan import make_plan
from ident.roll_off import agreed
from robot_assets.robot import load_robot
from sim.effects import make_effect
from sim.experiment import draw_drives
from tests.conftest import quick_experiment, small_plan, through_files

RATE = 1000.0  # Hz, of the record
FASTER = 2  # samples of the loop in one of the record


@pytest.fixture(scope="module")
def averaged(locked):
    """A loop at 1 kHz, recorded at half of that: a torque between samples is the mean of the two beside it."""
    plan = small_plan(locked, 9, levels=(1.0,))
    data = quick_experiment(plan, [], seed=9, drives=draw_drives(np.random.default_rng(9), locked))

    def part(s):
        tau = 0.5 * (s.tau + np.roll(s.tau, 1, axis=0))
        parts = {"tau": tau[::FASTER], "q": s.q[::FASTER], "t": s.t[::FASTER], "r": s.r[::FASTER]}
        return replace(s, period=s.period // FASTER, **parts)

    segments = tuple(part(s) for s in data.segments)
    return replace(data, segments=segments, sample_rate=RATE / FASTER, input_hold="none", q_std=None, tau_std=None)


def test_a_recorder_that_averages_samples_is_told_and_is_no_cause(averaged, tmp_path):
    """Of two samples ``T`` apart the mean is ``cos(wT/2)``, of what is held ``sin(wT/2)/(wT/2)``: to second order
    ``1 - (wT)^2/12``."""
    setup, fit = identify(averaged)
    assert setup.problem.sampling.roll_off == pytest.approx(RATE**-2 / 12.0, rel=0.1)
    assert fit.chi2_per_dof == pytest.approx(1.0, abs=0.08)
    verdict = diagnose(through_files(averaged, tmp_path))
    assert not verdict.causes and not verdict.discrepancy.detected
    assert sum("alike at all joints" in note for note in verdict.notes) == 1


def mean_of_three(x):
    """Of neighbouring samples of signals that repeat."""
    return np.mean([np.roll(x, k, axis=0) for k in (-1, 0, 1)], axis=0)


def test_what_one_joint_loses_is_not_the_recorders(averaged):
    """The mean of three samples at one joint of three: the others do not outvote it. A torque that is held from sample
    to sample is recorded as it is."""

    def part(s):
        tau = s.tau.copy()
        tau[:, 1] = mean_of_three(s.tau[:, 1])
        return replace(s, tau=tau)

    given = replace(averaged, segments=tuple(part(s) for s in averaged.segments))
    assert identify(given)[0].problem.sampling.roll_off == 0.0
    held = replace(averaged, input_hold="zoh")
    assert identify(held)[0].problem.sampling.roll_off == 0.0


@pytest.mark.parametrize(
    ("values", "std", "expected"),
    [
        ([2.0, 2.1, 1.9, 2.0], [0.1] * 4, 2.0),
        ([2.0, 2.1, 1.9, 9.0], [0.1, 0.1, 0.1, 0.01], 0.0),  # the surest says another thing
        ([2.0, 2.1, 1.9, 9.0], [0.1, 0.1, 0.1, 0.2], 2.0),
        ([0.1, -0.1, 0.05, 0.0], [0.1] * 4, 0.0),  # nothing
        ([2.0, 2.0, 2.0, 2.0], [1.0] * 4, 0.0),  # not told
        ([2.0, -2.0, 1.0, 4.0], [0.1] * 4, 0.0),  # all differ
        ([20.0, 20.0, 20.0, 20.0], [0.1] * 4, 0.0),  # more than a recorder does
    ],
)
def test_most_joints_must_agree(values, std, expected):
    assert agreed(np.array(values), np.array(std), 10.0) == pytest.approx(expected, rel=0.06)


@pytest.fixture(scope="module")
def single(tmp_path_factory):
    """One linear axis with a spring on its link, its force averaged over three samples by the recorder."""
    robot = load_robot("emps")
    plan = make_plan(robot, points=2, validation_points=1, levels=(1.0,), period=2000, trajectory=False, seed=3)
    hidden = make_effect("gravity_spring", robot.joint_names[0], stiffness=10.0, rest_angle=0.1)
    data = quick_experiment(plan, [hidden], seed=3, noise=0.1)
    segments = tuple(replace(s, tau=mean_of_three(s.tau)) for s in data.segments)
    return through_files(replace(data, segments=segments, input_hold="none"), tmp_path_factory.mktemp("single"))


@pytest.mark.slow
def test_of_a_single_joint_it_is_found_among_the_causes_and_is_none(single):
    verdict = diagnose(single)
    assert [c.effect for c in verdict.causes if c.probability > 0.5] == ["gravity_spring"]
    assert verdict.unexplained_verdict == "noise floor reached"
    assert any("averages or holds samples" in note for note in verdict.notes)
    joint = single.joints[0]
    found = verdict.baseline[f"record_roll_off.{joint}"]
    assert found.unit == "s2" and found.value == pytest.approx(1e-6 / 3.0, rel=0.15)  # to second order
