"""An excitation that acts later than the torque of which it is a part is no cause."""

from dataclasses import replace

import numpy as np
import pytest

from ident.diagnosis import diagnose
from ident.identification import identify
from sim.effects import make_effect
from sim.experiment import draw_drives
from tests.conftest import quick_experiment, small_plan, through_files

LAG = 4e-4  # s


def shifted(x, time, rate):
    """Signals (N, n) that repeat, by some time earlier."""
    turn = np.exp(2j * np.pi * np.fft.rfftfreq(len(x), 1.0 / rate) * time)
    return np.fft.irfft(turn[:, None] * np.fft.rfft(x, axis=0), len(x), axis=0)


def asked_early(data, lags):
    """Records of a controller that is asked for its excitation by ``lags`` (n,), s, before that acts."""

    def part(s):
        asked = np.stack([shifted(s.r[:, [j]], lag, data.sample_rate)[:, 0] for j, lag in enumerate(lags)], axis=1)
        return replace(s, tau=s.tau - s.r + asked, r=asked)

    return replace(data, segments=tuple(part(s) for s in data.segments))


@pytest.fixture(scope="module")
def sampled(locked):
    """Records that do not say how the torque is held."""
    data = quick_experiment(
        small_plan(locked, 9, levels=(1.0,)), [], seed=9, drives=draw_drives(np.random.default_rng(9), locked)
    )
    return replace(data, input_hold="none")


def lag_of(data):
    return identify(data)[0].problem.sampling.late_excitation


def test_an_excitation_that_acts_later_is_told_and_is_no_cause(sampled, tmp_path):
    early = asked_early(sampled, [LAG] * 3)
    setup, fit = identify(early)
    assert setup.problem.sampling.late_excitation == pytest.approx(LAG, rel=0.02)
    assert fit.chi2_per_dof == pytest.approx(1.0, abs=0.08)
    verdict = diagnose(through_files(early, tmp_path))
    assert not verdict.causes and not verdict.discrepancy.detected
    assert sum("later than the rest of the recorded torque" in note for note in verdict.notes) == 1


def test_what_acts_as_it_is_recorded_has_no_lag(sampled):
    assert lag_of(sampled) == 0.0


def test_a_torque_that_is_held_is_recorded_as_it_acts(sampled):
    assert lag_of(replace(asked_early(sampled, [LAG] * 3), input_hold="zoh")) == 0.0


def test_a_lag_of_one_joint_is_not_the_controllers(sampled):
    assert lag_of(asked_early(sampled, [0.0, LAG, 0.0])) == 0.0


def test_a_reference_of_positions_is_no_torque(sampled):
    """Its gain differs from joint to joint."""
    early = asked_early(sampled, [LAG] * 3)
    parts = tuple(replace(s, r=s.r / [1e3, 3e3, 2e2]) for s in early.segments)
    assert lag_of(replace(early, segments=parts)) == 0.0


def test_without_a_recorded_excitation_nothing_is_said(sampled):
    early = asked_early(sampled, [LAG] * 3)
    assert lag_of(replace(early, segments=tuple(replace(s, r=None) for s in early.segments))) == 0.0


@pytest.mark.slow
def test_link_encoders_are_compared_beside_a_late_excitation(locked, tmp_path):
    late = make_effect("sensor_delay", "elbow_joint", delay=2e-3, channel="q_link")
    data = quick_experiment(small_plan(locked, 9, levels=(1.0,)), [late], seed=9, link_encoders=True)
    verdict = diagnose(through_files(asked_early(replace(data, input_hold="none"), [LAG] * 3), tmp_path))
    assert [(c.effect, c.joint, c.channel) for c in verdict.causes] == [("sensor_delay", "elbow_joint", "q_link")]
    assert verdict.causes[0].parameters["delay"].value == pytest.approx(2e-3, rel=0.02)
    assert any("later than the rest of the recorded torque" in note for note in verdict.notes)
