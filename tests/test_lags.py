"""Lags of drives and of encoders that have two poles, which are neither a lag of first order nor a delay."""

from dataclasses import replace

import numpy as np
import pytest

from ident.diagnosis import diagnose
from ident.hypotheses import catalogue, second_order
from ident.hypotheses.filters import lag, second_order_lag
from ident.identification import identify
from tests.conftest import quick_experiment, small_plan, through_files

S = 1j * np.linspace(0.0, 2e3, 50)
JOINT, PLACE, LATE = 2, "elbow_joint", 3e-3


def test_one_of_second_order_holds_one_of_first_and_two_in_a_row():
    assert np.allclose(second_order_lag([1e-3, 0.0], S), lag([1e-3], S))
    assert np.allclose(second_order_lag([2e-3, 0.25], S), lag([1e-3], S) ** 2)
    slow = S[:5]
    assert np.allclose(second_order_lag([1e-3, 0.5], slow), np.exp(1e-3 * slow), atol=2e-3)


def test_it_is_asked_for_where_a_lag_or_a_delay_stands(locked, tmp_path):
    setup, _ = identify(through_files(quick_experiment(small_plan(locked, 3), seed=3), tmp_path))
    asked = {h.effect: [x.effect for x in second_order(h)] for h in catalogue(setup.problem.structure)}
    assert {k: v for k, v in asked.items() if v} == {
        "torque_delay": ["torque_lag"],
        "torque_lag": ["torque_lag"],
        "sensor_delay": ["sensor_lag"],
        "sensor_lag": ["sensor_lag"],
    }
    wide = second_order(next(h for h in catalogue(setup.problem.structure) if h.effect == "torque_delay"))[0]
    assert second_order(wide) == []


def filtered(segment, channel, change):
    """A multisine with another signal at the joint: each period times ``change`` of complex frequencies, rad/s."""
    x = getattr(segment, channel).copy()
    N = segment.period
    s = 2j * np.pi * np.fft.rfftfreq(N, segment.t[1] - segment.t[0])
    for k in range(0, len(x) - N + 1, N):
        x[k : k + N, JOINT] = np.fft.irfft(change(s) * np.fft.rfft(x[k : k + N, JOINT]), N)
    return replace(segment, **{channel: x})


@pytest.mark.parametrize("square", [0.25, 0.4])
@pytest.mark.parametrize(("effect", "channel"), [("torque_lag", "tau"), ("sensor_lag", "q")])
def test_a_lag_of_second_order_is_one_cause(locked, tmp_path, effect, channel, square):
    """Not a delay with a lag beside it."""
    data = quick_experiment(small_plan(locked, 3), seed=3)

    def change(s):
        way = second_order_lag([LATE, square], s)
        return way if channel == "tau" else 1.0 / way

    data = replace(data, segments=tuple(filtered(x, channel, change) for x in data.segments))
    verdict = diagnose(through_files(data, tmp_path))
    assert [(c.effect, c.joint) for c in verdict.causes if c.probability > 0.5] == [(effect, PLACE)]
    found = verdict.causes[0].parameters
    assert found["time_constant"].value == pytest.approx(LATE, rel=0.01)
    assert found["square"].value == pytest.approx(square, abs=0.03)
