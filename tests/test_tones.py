"""Tones that do not repeat with the period of the excitation, against the noise that carries them."""

from dataclasses import replace

import numpy as np
import pytest

from ident.diagnosis import diagnose
from ident.identification import identify
from ident.problem import predictions
from ident.tones import find_tones
from robot_assets.robot import load_robot
from tests.conftest import quick_experiment, small_plan, through_files


def tones(problem, fit):
    preds = predictions(problem, fit.model, fit.remainders)
    return find_tones(problem.groups, [p.sampled_impedance for p in preds])


def with_tone(data, joint, frequency, amplitude):
    """The dataset with a tone in the recorded torque of a joint that runs on from segment to segment."""

    def hummed(i, s):
        tau = s.tau.copy()
        tau[:, joint] += amplitude * np.sin(2.0 * np.pi * frequency * (s.t + 17.3 * i))
        return replace(s, tau=tau)

    return replace(data, segments=tuple(hummed(i, s) for i, s in enumerate(data.segments)))


def test_noise_alone_holds_no_tone(identified):
    """Though at the resonances of an arm it is many times what it is near by."""
    _, setup, fit = identified
    assert not tones(setup.problem, fit)


def test_a_tone_off_the_lines_is_found_where_it_is(clean):
    data, _ = clean
    setup, fit = identify(with_tone(data, 2, 13.7, 0.3))
    first, *others = tones(setup.problem, fit)
    assert first.joint == 2 and abs(first.frequency_hz - 13.7) < 0.5 and first.ratio > 30.0
    assert not others


def test_a_tone_that_repeats_with_the_period_is_no_scatter(clean):
    data, _ = clean
    setup, fit = identify(with_tone(data, 2, 13.0, 0.3))
    assert not tones(setup.problem, fit)


def test_records_without_noise_hold_no_tone():
    robot = load_robot("twomass")
    setup, fit = identify(quick_experiment(small_plan(robot, 3, period=1000, levels=(4.0,)), [], seed=3, noise=0.0))
    assert not tones(setup.problem, fit)


@pytest.mark.parametrize("amplitude", [0.0, 0.02])
def test_what_shakes_a_drive_at_its_own_frequency_is_an_unknown_cause(tmp_path, amplitude):
    robot = load_robot("twomass")
    data = quick_experiment(small_plan(robot, 3, period=1000, levels=(4.0,)), [], seed=3)
    verdict = diagnose(through_files(with_tone(data, 0, 21.3, amplitude), tmp_path))
    assert not verdict.causes
    assert verdict.discrepancy.detected == bool(amplitude)
    if amplitude:
        assert verdict.unexplained_verdict == "unknown cause remains"
        assert any("near 21" in note and "drive" in note for note in verdict.notes)
        assert verdict.discrepancy.where[0].joint == "drive" and "tone" in verdict.discrepancy.where[0].feature
    else:
        assert verdict.unexplained_verdict == "noise floor reached"
