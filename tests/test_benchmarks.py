"""The blind benchmark hides effects of the sizes that it says."""

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from benchmarks.sizing import CHANNELS, LARGEST, NEAR, TRIALS, brought_to, distortion, noise_power, spectra
from ident.dataset import Segment


@given(
    at_one=st.floats(0.01, 1e4),
    power=st.floats(0.5, 2.0),
    bend=st.floats(0.0, 0.2),
    target=st.floats(3.0, 100.0),
)
def test_an_effect_is_brought_to_its_size(at_one, power, bend, target):
    """By few trials, also where its size grows as no power of its strength; as near as a strength that a machine may
    have."""

    def size(strength: float) -> float:
        return at_one * strength**power * (1.0 + strength) ** -bend

    trials = []

    def stronger(factor: float) -> float:
        trials.append(factor)
        return factor

    found = brought_to(stronger, size, target)
    if size(np.exp(LARGEST)) > target:
        assert abs(np.log(size(found) / target)) < NEAR
    else:
        assert found == pytest.approx(np.exp(LARGEST)) or abs(np.log(size(found) / target)) < NEAR
    assert len(trials) <= TRIALS and trials[0] == 1.0


def test_the_nearest_of_an_effect_that_does_not_come_there():
    assert brought_to(lambda factor: factor, lambda strength: 200.0 + strength, 10.0) < 0.1


@given(limit=st.floats(-3.0, 3.0), target=st.floats(3.0, 100.0))
@example(limit=1.65625, target=30.5)  # secants that lead from one end to the other and back
def test_an_effect_that_does_nothing_up_to_a_strength_and_soon_too_much(limit, target):
    """As a torque limit, beyond which the arm falls: it is sought between."""

    def size(strength: float) -> float:
        over = np.log(strength) - limit
        return 0.0 if over < 0.0 else np.inf if over > 0.6 else 200.0 * over

    assert 0.5 < size(brought_to(lambda factor: factor, size, target)) / target < 2.0


def recording(rng, signal: np.ndarray, std: np.ndarray, periods: int) -> Segment:
    """Periods of a signal (period, n) with noise of ``std`` (n,) in torque, a tenth of it in position."""
    x = np.tile(signal, (periods, 1))
    tau, q = (x + size * std * rng.normal(size=x.shape) for size in (1.0, 0.1))
    return Segment(
        name="s", kind="multisine", role="identification", t=np.arange(len(x)) * 1e-3, tau=tau, q=q, q_link=None, r=None,
        period=len(signal), periods=periods, transient_periods=1,
    )  # fmt: skip


def test_noise_is_what_scatters_between_periods():
    """Of the mean over the steady periods, without what repeats."""
    rng, std, period, periods, lines = np.random.default_rng(0), np.array([0.2, 3.0]), 400, 5, 150
    signal = 10.0 * rng.normal(size=(period, 2))
    made = [recording(rng, signal, std, periods) for _ in range(8)]
    found = noise_power(made, lines)
    assert found.shape == (lines, len(CHANNELS), 2)
    expected = np.stack([std, 0.1 * std]) ** 2 / period / (periods - 1)
    assert found.mean(axis=0) == pytest.approx(expected, rel=0.1)
    of_means = spectra(made, lines) - spectra([recording(rng, signal, 0.0 * std, periods)], lines)
    assert np.mean(np.abs(of_means) ** 2, axis=(0, 1)) == pytest.approx(expected, rel=0.15)


@given(seed=st.integers(0, 2**32 - 1), size=st.floats(0.1, 1e3))
def test_a_distortion_is_what_no_drives_would_change(seed, size):
    """In units of the noise, of the joint and posture that show it most."""
    rng = np.random.default_rng(seed)

    def draw(*shape: int) -> np.ndarray:
        return rng.normal(size=shape) + 1j * rng.normal(size=shape)

    noise = np.exp(rng.normal(size=(40, 2, 3)))
    ways = draw(5, 2, 40, 2, 3) * np.exp(3.0 * rng.normal(size=(5, 1, 1, 1, 1)))
    change = 0.01 * np.sqrt(noise) * draw(2, 40, 2, 3)
    change[1, :, :, 2] += size * np.sqrt(noise[:, :, 2]) * np.exp(2j * np.pi * rng.random((40, 2)))
    alone, beside = (distortion(x, ways, noise) for x in (change, change + np.tensordot(rng.normal(size=5), ways, 1)))
    assert beside == pytest.approx(alone, rel=1e-6)
    assert 0.9 * size < alone < 1.05 * size + 0.05
    assert distortion(ways[0], ways, noise) < 1e-6 * np.abs(ways[0]).max()
