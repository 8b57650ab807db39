"""Samples of a position that were lost, against motions that rest, reverse, come in steps and are noisy."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ident.checking import inspect_dataset
from ident.diagnosis import diagnose
from ident.lost_samples import LostSamples, filled, lost_among, with_lost_samples_filled
from ident.verdict import UNKNOWN
from robot_assets.robot import load_robot
from tests.conftest import quick_experiment, small_plan, through_files

RATE = 1000.0


def repeated(x):
    """Samples of a single record that were lost."""
    return lost_among([x])[0][0]


def motion(rng, samples, highest_hz):
    """A multisine of about 0.01 rad rms."""
    f = np.arange(1.0, highest_hz, 2.0)
    phase = rng.uniform(0.0, 2.0 * np.pi, len(f))
    t = np.arange(samples)[:, None] / RATE
    return 0.01 * np.sqrt(2.0 / len(f)) * np.sum(np.cos(2.0 * np.pi * f * t + phase), axis=1)


def with_loss(rng, x, share):
    """The signal with samples that repeat the one before, at random."""
    x, lost = x.copy(), rng.random(len(x)) < share
    lost[:2] = False
    for k in np.flatnonzero(lost):
        x[k] = x[k - 1]
    return x, lost


@given(
    seed=st.integers(0, 2**31),
    highest=st.sampled_from([4.0, 20.0, 60.0]),
    noise=st.sampled_from([0.0, 1e-6, 1e-5, 1e-4]),
    step=st.sampled_from([0.0, 1e-6, 2e-5, 1e-4, 1e-3]),
    rests=st.booleans(),
)
@settings(max_examples=150, deadline=None)
def test_whole_records_have_lost_nothing(seed, highest, noise, step, rests):
    """Neither where dry friction holds the joint time and again, nor where encoders have steps."""
    rng = np.random.default_rng(seed)
    x = motion(rng, 3000, highest)
    if rests:  # held until the motion is 5 mrad ahead, and then caught up smoothly
        v = np.diff(x, prepend=x[0])
        x = np.cumsum(np.where(np.abs(v) < np.median(np.abs(v)), 0.0, v - np.sign(v) * np.median(np.abs(v))))
    x = x + noise * rng.standard_normal(len(x))
    x = step * np.round(x / step) if step else x
    assert not np.any(repeated(x))


@given(
    seed=st.integers(0, 2**31),
    speed=st.floats(0.2, 3.0) | st.sampled_from([0.9995, 1.0, 1.0005, 1.01, 2.0]),
    noise=st.sampled_from([0.0, 0.02, 0.05, 0.1, 0.3, 1.0]),
)
@settings(max_examples=100, deadline=None)
def test_counts_at_constant_speed_are_not_lost(seed, speed, noise):
    """Near a count a sample noise makes none and two of one now and then."""
    x = np.round(speed * np.arange(5000) + noise * np.random.default_rng(seed).standard_normal(5000))
    assert not np.any(repeated(1e-4 * x))


@given(
    seed=st.integers(0, 2**31),
    highest=st.sampled_from([10.0, 30.0, 60.0]),
    noise=st.sampled_from([1e-7, 1e-6, 1e-5]),
    step=st.sampled_from([0.0, 1e-7, 2e-6]),
    share=st.sampled_from([0.03, 0.06, 0.2]),
)
@settings(max_examples=60, deadline=None)
def test_what_was_lost_is_found_and_filled(seed, highest, noise, step, share):
    rng = np.random.default_rng(seed)
    whole = motion(rng, 4000, highest) + noise * rng.standard_normal(4000)
    whole = step * np.round(whole / step) if step else whole
    held, lost = with_loss(rng, whole, share)
    found = repeated(held)
    assert np.mean(found & ~lost) < (0.5 if step else 0.01) * share  # steps repeat values by themselves
    assert np.mean(found & lost) > 0.8 * np.mean(lost)
    error = np.std(filled(held, found) - whole)
    assert error < 0.1 * np.std(held - whole) + 2.0 * np.sqrt(share) * (noise + step)


@pytest.mark.parametrize("step", [0.0, 1e-7])
def test_the_last_sample_can_be_lost_too(step):
    """Nothing after it tells, so that it goes on as the motion before it did; one that rests at the end is whole."""
    rng = np.random.default_rng(2126)
    whole = motion(rng, 4000, 10.0) + 1e-7 * rng.standard_normal(4000)
    whole = step * np.round(whole / step) if step else whole
    held, lost = with_loss(rng, whole, 0.03)
    held[-1], lost[-1] = held[-2], True
    found, resting = lost_among([held, np.full(50, whole[0])])[0]
    assert found[-1] and not np.any(resting)
    assert abs(filled(held, found)[-1] - whole[-1]) < 0.2 * abs(held[-1] - whole[-1])


@pytest.mark.parametrize("every", [2, 3])
@pytest.mark.parametrize("coarse", [0.0, 0.3])
def test_a_slower_clock_is_none_that_loses(clean, every, coarse):
    """Every so many values one is new: told with its clock, and filled. A torque in steps repeats its values too."""
    data = clean[0]
    if coarse:
        step = coarse * np.concatenate([s.tau for s in data.segments]).std(axis=0)
        data = replace(data, segments=tuple(replace(s, tau=step * np.round(s.tau / step)) for s in data.segments))
    q = [s.q.copy() for s in data.segments]
    for x in q:
        x[:, 1] = x[np.arange(len(x)) // every * every, 1]
    slower = replace(data, segments=tuple(replace(s, q=x) for s, x in zip(data.segments, q, strict=True)))
    whole, found = with_lost_samples_filled(slower)
    (lost,) = found
    assert (lost.joint, lost.channel, lost.every) == (1, "q", every)
    assert lost.share == pytest.approx(1.0 - 1.0 / every, abs=0.05)
    (told,) = [w for w in inspect_dataset(slower).warnings if w.startswith("q_2 ")]
    assert f"has a new value every {every} samples only" in told
    for s, before, held in zip(whole.segments, data.segments, slower.segments, strict=True):
        error, was = (np.std(x - before.q[:, 1]) for x in (s.q[:, 1], held.q[:, 1]))
        assert error < 0.1 * was + data.robot.array("q_std")[1]
        assert np.array_equal(s.q[:, 0], before.q[:, 0])


def test_whole_datasets_and_rows_that_came_twice_stay_as_they_are(clean):
    """A log that is faster than what it records is late in torque and position alike."""
    again = [
        replace(s, **{c: getattr(s, c)[np.arange(len(s.t)) // 2 * 2] for c in ("q", "tau")}) for s in clean[0].segments
    ]
    for data in (clean[0], replace(clean[0], segments=tuple(again))):
        same, found = with_lost_samples_filled(data)
        assert same is data and found == ()


def test_lost_samples_are_an_unknown_cause_and_no_delay(tmp_path):
    """They delay the record now and then: of a fifth of them a quarter of a sample on average."""
    robot, rng = load_robot("twomass"), np.random.default_rng(5)
    data = quick_experiment(small_plan(robot, 4, period=1000), seed=4)
    lossy = replace(
        data,
        segments=tuple(replace(s, q=with_loss(rng, s.q[:, 0], 0.2)[0][:, None]) for s in data.segments),
    )
    lossy = through_files(lossy, tmp_path / "d")
    (told,) = {w.split(": ")[-1] for w in inspect_dataset(lossy).warnings if "repeat" in w}
    assert told.startswith("lost samples")
    verdict = diagnose(lossy)
    assert verdict.discrepancy.detected and verdict.unexplained_verdict == UNKNOWN and not verdict.causes
    assert verdict.discrepancy.where[0].feature == "samples that repeat the one before"
    assert any("of the samples repeat" in note for note in verdict.notes)
    assert verdict.next_experiment.startswith("Mend what loses samples of q of")
    _, (lost,) = with_lost_samples_filled(lossy)
    assert lost.every == 0 and lost.share == pytest.approx(0.2, abs=0.02)


@pytest.mark.parametrize(("share", "every", "many"), [(0.005, 0, False), (0.02, 0, True), (0.5, 2, False)])
def test_few_samples_or_those_of_a_slower_clock_are_no_cause(share, every, many):
    assert LostSamples(0, "q", share, every).many is many


def test_a_clock_shows_in_motions_that_rest():
    """Strokes with a third of the time at rest, by an encoder with and without counts."""
    ramp = 0.5 * (1.0 - np.cos(np.linspace(0.0, np.pi, 1000)))
    x = np.concatenate([ramp, np.ones(500), ramp[::-1], np.zeros(500)] * 2)
    for count in (0.0, 1e-5):
        y = count * np.round(x / count) if count else x
        (lost,), every = lost_among([y[np.arange(len(y)) // 3 * 3]])
        assert every == 3 and np.mean(lost) > 0.3


@pytest.mark.parametrize("share", [0.02, 0.1])
def test_an_encoder_with_counts_keeps_them(share):
    """In a motion whose samples that were lost are filled."""
    rng = np.random.default_rng(2)
    x = 1e-4 * np.round(1e4 * 0.5 * np.sin(2.0 * np.pi * 2.0 * np.arange(5000) / RATE))
    held, lost = with_loss(rng, x, share)
    found = repeated(held)
    assert np.mean(found & lost) > 0.8 * np.mean(lost)
    again = filled(held, found)
    assert np.allclose(again, 1e-4 * np.round(1e4 * again), atol=1e-12)
    assert np.abs(again - x)[found].max() < 0.1 * np.abs(held - x).max()
