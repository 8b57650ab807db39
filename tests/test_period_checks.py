"""Periods that are said of multisines, and do not repeat."""

from dataclasses import replace

import numpy as np
import pytest

from ident.dataset import Dataset, Segment
from ident.diagnosis import diagnose
from ident.period_checks import period_warnings, unrepeated
from robot_assets.robot import load_robot
from tests.test_stiction import PERIOD, PERIODS, sticking


def with_period(data, period):
    """The records as they are, said to repeat after another number of samples."""
    count = PERIODS * PERIOD // period
    cut = [
        replace(s, period=period, periods=count, **s.part(slice(0, count * period)))
        for s in data.segments
        if s.kind == "multisine"
    ]
    return replace(data, segments=tuple(cut))


@pytest.mark.parametrize("period", [PERIOD // 2, 1300])
def test_a_wrong_period_is_told_and_nothing_is_named(period):
    data, _ = sticking()
    wrong = with_period(data, period)
    assert all(f"a period of {period} samples" in w for s in wrong.segments for w in period_warnings(s, wrong))
    assert len(unrepeated(wrong)) == 1
    verdict = diagnose(wrong, max_causes=1)
    assert not verdict.causes and verdict.unexplained_verdict == "unknown cause remains"
    assert "mislabelled" in verdict.sentence and "nothing repeats" in verdict.sentence


def test_periods_that_repeat_are_not_told():
    """Neither where a motor sticks most of the time, nor a multiple of the period, nor with noise near the signal."""
    data, _ = sticking()
    assert not unrepeated(data)
    noisy = replace(
        data.segments[0],
        q=data.segments[0].q
        + 0.2 * np.std(data.segments[0].q) * np.random.default_rng(0).normal(size=data.segments[0].q.shape),
    )
    assert not period_warnings(noisy, data)
    assert not any(period_warnings(s, data) for s in data.segments)
    single = with_period(data, PERIODS * PERIOD)
    assert not any(period_warnings(s, single) for s in single.segments)


def moved(differ, transient=0.0):
    """Two periods of 400 samples of the arm ``ur10_bare``, in the second of which joint 3 does so much otherwise."""
    robot, rng, period = load_robot("ur10_bare"), np.random.default_rng(0), 400
    t = np.arange(2 * period) / 100.0
    phases = rng.uniform(0, 2 * np.pi, (2, 6))
    q = 0.1 * np.sin(2 * np.pi * 0.75 * t[:, None] + phases[0]) + 1e-5 * rng.normal(size=(len(t), 6))
    q[:, 5] *= 1e-4  # not excited: noise alone
    q[:, 5] += 1e-5 * rng.normal(size=len(t)).cumsum()
    q[:, 2] += differ * 0.1 * np.sin(2 * np.pi * 1.1 * t) * (t >= t[period])
    q += transient * np.exp(-t / 0.5)[:, None]
    s = Segment("ms", "multisine", "identification", t, 50.0 * np.roll(q, 3, axis=0), q, period=period, periods=2)
    return s, Dataset("d", robot, 100.0, robot.joint_names, "none", None, None, None, (s,))


def test_a_motion_that_repeats_at_some_joints_only_is_told():
    s, data = moved(1.0)
    (said,) = period_warnings(s, data)
    assert "does not repeat with a period of 400 samples" in said and "joint 3 (elbow_joint) most" in said
    assert not unrepeated(data)
    for good in (moved(0.0), moved(0.05), moved(0.0, transient=0.1)):
        assert not period_warnings(*good)
