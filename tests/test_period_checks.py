"""Periods that are said of multisines, and do not repeat."""

from dataclasses import replace

import numpy as np
import pytest

from ident.diagnosis import diagnose
from ident.period_checks import period_warnings, unrepeated
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
    single = with_period(data, PERIODS * PERIOD)
    assert not any(period_warnings(s, single) for s in single.segments)
