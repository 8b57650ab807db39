"""Tones that do not repeat with the period of the excitation, against the noise that carries them."""

from dataclasses import replace
from types import SimpleNamespace
from warnings import catch_warnings, simplefilter

import numpy as np
import pytest

from ident.chain import build_structure
from ident.conclude import of_their_own
from ident.diagnosis import diagnose
from ident.hypotheses import catalogue
from ident.identification import identify
from ident.model import Effect
from ident.problem import predictions
from ident.tones import Tone, find_tones, over_noise, swinging
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


@pytest.mark.slow
def test_a_tone_off_the_lines_is_found_where_it_is(clean):
    data, _ = clean
    setup, fit = identify(with_tone(data, 2, 13.7, 0.3))
    first, *others = tones(setup.problem, fit)
    assert first.joint == 2 and abs(first.frequency_hz - 13.7) < 0.5 and first.ratio > 30.0
    assert not others


@pytest.mark.parametrize(("damping", "told"), [(0.01, True), (0.5, False)])
def test_a_resonance_of_the_links_is_where_they_swing(damping, told):
    """Of one link on its gear, the motor held: torque per motor position ``k (k - J w^2) / (k - J w^2 + i d w)``."""
    w, w0 = 2.0 * np.pi * 0.25 * np.arange(80), 2.0 * np.pi * 5.0
    Z = 1e4 * (1.0 + w**2 / (w0**2 - w**2 + 2j * damping * w0 * w))
    Z[0] = 0.0  # as without gravity
    there = swinging(Z[:, None, None])
    assert there.shape == (len(Z), 1) and set(np.flatnonzero(there)) == ({19, 20, 21} if told else set())


def test_lines_with_none_near_by_show_no_tone(monkeypatch):
    """Of six lines the middle one has none but those next to it."""
    d = np.random.default_rng(0).normal(size=(2, 6, 2)) + 0j
    monkeypatch.setattr("ident.tones.noise_alone", lambda group, Z: (d, np.arange(6), 1.0))
    group = SimpleNamespace(U=np.ones((2, 6, 2)), U_periods=np.ones((2, 3, 6, 2)))
    with catch_warnings():
        simplefilter("error")
        ratio, _, _ = over_noise(group, np.tile(np.eye(2), (6, 1, 1)))
    assert np.all(np.isfinite(ratio)) and np.all(ratio[3] == 1.0)


@pytest.mark.slow
def test_links_that_still_swing_from_the_start_are_no_tone():
    """The links of the heavy arm swing at 5.5 Hz with little damping: one period of transient leaves some of it."""
    plan = small_plan(load_robot("irb"), 3, levels=(1.0,))
    setup, fit = identify(quick_experiment(plan, [], seed=3))
    assert not tones(setup.problem, fit)


@pytest.mark.slow
def test_a_tone_that_repeats_with_the_period_is_no_scatter(clean):
    data, _ = clean
    setup, fit = identify(with_tone(data, 2, 13.0, 0.3))
    assert not tones(setup.problem, fit)


def test_records_without_noise_hold_no_tone():
    robot = load_robot("twomass")
    setup, fit = identify(quick_experiment(small_plan(robot, 3, period=1000, levels=(4.0,)), [], seed=3, noise=0.0))
    assert not tones(setup.problem, fit)


@pytest.mark.parametrize(("effect", "left"), [("coulomb_friction", ()), ("torque_lag", (0,)), ("payload", (0,))])
def test_a_joint_that_sticks_need_not_repeat(ur10, effect, left):
    h = next(h for h in catalogue(build_structure(ur10)) if h.effect == effect)
    found = SimpleNamespace(model=SimpleNamespace(effects=(Effect(h, np.ones(len(h.parameters))),)))
    assert tuple(x.joint for x in of_their_own([Tone(0, 3.0, 20.0)], found)) == left


def of_two_periods(data):
    """The dataset with the transient and one steady period of each record."""
    segments = (replace(s, periods=2, **s.part(slice(None, 2 * s.period))) for s in data.segments)
    return replace(data, segments=tuple(segments))


@pytest.mark.parametrize(("amplitude", "shortened"), [(0.0, False), (0.02, False), (0.0, True), (0.1, True)])
def test_what_shakes_a_drive_at_its_own_frequency_is_an_unknown_cause(tmp_path, amplitude, shortened):
    robot = load_robot("twomass")
    data = quick_experiment(small_plan(robot, 3, period=1000, levels=(4.0,)), [], seed=3)
    data = with_tone(data, 0, 21.3, amplitude)
    verdict = diagnose(through_files(of_two_periods(data) if shortened else data, tmp_path))
    assert not verdict.causes
    assert verdict.discrepancy.detected == bool(amplitude)
    if amplitude:
        assert verdict.unexplained_verdict == "unknown cause remains"
        (note,) = (x for x in verdict.notes if "near " in x and "drive" in x)
        assert abs(float(note.split("near ")[1].split(" Hz")[0]) - 21.3) < (3.0 if shortened else 0.7)
        assert verdict.discrepancy.where[0].joint == "drive" and "tone" in verdict.discrepancy.where[0].feature
    else:
        assert verdict.unexplained_verdict == "noise floor reached"
