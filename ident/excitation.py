"""Excitation: random-phase multisines, their lines and amplitudes, and operating points.

Random-phase odd multisines with a random detection grid (Pintelon and Schoukens 2012), orthogonal
over the n_u experiments of a realization (Dobrowiecki, Schoukens and Guillaume 2006):
``R(k) = D_phi(k) T D_r(k)`` with the unitary DFT matrix ``T``, so that ``R R^H`` is diagonal.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from robot_assets.robot import Robot

DRAWS = 100  # random phases tried for the lowest crest factor
MOTION = 0.010  # rad rms, motor motion aimed at for level 1
LEAST_TORQUE = 10.0  # rms of the torque of level 1 over the noise of its sensor, for which a motor may move further
MOST_MOTION = 0.1  # rad or m rms, then
RANGE_SHARE = 0.05  # of the range of a joint that such a motion may have, rms
TORQUE_SHARE = 0.6  # of the torque limit that gravity and excitation may take together
SPEED_SHARE = 0.5  # of the velocity limit
LOOP_HZ = 2.5  # bandwidth assumed of the position loop that holds a posture


@dataclass(frozen=True)
class Excitation:
    """Grid of a multisine.

    Attributes:
        sample_rate: Hz. period: samples. periods: recorded. transient_periods: to be discarded.
        lines: (F,) excited DFT lines. detection: lines of the odd grid left out on purpose.
    """

    sample_rate: float
    period: int
    periods: int
    transient_periods: int
    lines: np.ndarray
    detection: np.ndarray

    @property
    def frequency(self) -> np.ndarray:
        """(F,) Hz."""
        return self.lines * self.sample_rate / self.period


def odd_random_grid(
    rng: np.random.Generator,
    period: int,
    sample_rate: float,
    band_hz: tuple[float, float],
    group: int = 4,
    per_decade: int | None = None,
) -> tuple[np.ndarray, np.ndarray]:
    """Odd lines of a band, one of every ``group`` left out at random: (excited, detection).

    Args:
        per_decade: about so many lines a decade, log-spaced and rounded to odd lines; all odd
            lines where None.
    """
    low, high = (f * period / sample_rate for f in band_hz)
    low, high = int(np.ceil(low - 1e-9)), int(np.floor(high + 1e-9))
    odd = np.arange(low | 1, high + 1, 2)
    if per_decade is not None and len(odd):
        wanted = np.geomspace(odd[0], odd[-1], max(2, round(per_decade * np.log10(odd[-1] / odd[0])) + 1))
        odd = np.unique(2 * (wanted.astype(int) // 2) + 1)
    n_groups = len(odd) // group
    left_out = np.arange(n_groups) * group + rng.integers(group, size=n_groups)
    return np.delete(odd, left_out), odd[left_out]


def orthogonal_multisines(
    rng: np.random.Generator, lines: np.ndarray, amplitudes: np.ndarray, period: int, draws: int = DRAWS
) -> np.ndarray:
    """Signals of the n_u experiments of one realization; (n_u, period, n).

    Args:
        lines: (F,) excited lines. amplitudes: (F, n) peak amplitude of each line and input.
        draws: random phases tried; the set of lowest crest factor is kept. The phases are not
            optimised beyond that, so that they stay random (theory.md 3.2).
    """
    n = amplitudes.shape[1]
    k = np.arange(n)
    T = np.exp(2j * np.pi * np.outer(k, k) / n) / np.sqrt(n)
    best, best_crest = np.empty((n, period, n)), np.inf
    for _ in range(max(1, draws // n)):
        phase_in = np.exp(2j * np.pi * rng.random((len(lines), n, 1)))
        phase_exp = np.exp(2j * np.pi * rng.random((len(lines), 1, n)))
        R = phase_in * T * phase_exp * amplitudes[:, :, None] * np.sqrt(n)
        X = np.zeros((n, period // 2 + 1, n), complex)
        X[:, lines] = 0.5 * R.transpose(2, 0, 1)
        r = np.fft.irfft(X, n=period, axis=1, norm="forward")
        crest = (np.abs(r).max(axis=1) / np.maximum(r.std(axis=1), 1e-300)).max()
        if crest < best_crest:
            best, best_crest = r, crest
    return best


def crest_factor(r: np.ndarray) -> float:
    """Largest peak over rms of the columns of (..., period, n)."""
    return float((np.abs(r).max(axis=-2) / r.std(axis=-2)).max())


def operating_points(
    robot: Robot, count: int, rng: np.random.Generator, effective_inertia: np.ndarray | None = None
) -> np.ndarray:
    """Postures spread over the joint range, (count, n) rad.

    The middle 60 % of each range, at most +-1.6 rad about its centre, filled by a latin hypercube.
    """
    center = 0.5 * (robot.q_min + robot.q_max)
    half = np.minimum(0.3 * (robot.q_max - robot.q_min), 1.6)
    cells = np.stack([rng.permutation(count) for _ in range(robot.n)], axis=1)
    return center + half * (2 * (cells + rng.random((count, robot.n))) / count - 1)


def shape_amplitudes(
    robot: Robot, frequency: np.ndarray, inertia: np.ndarray, injection: str, headroom: np.ndarray
) -> np.ndarray:
    """Amplitudes (F, n) of lines: torque that moves every motor alike up to a corner, then falls.

    Scaled so that the predicted motor motion is ``MOTION`` rad rms, or as much more (to ``MOST_MOTION``) as lifts the
    torque of a light drive out of its noise, and speed and torque stay within their shares of the limits.

    Args:
        inertia: (n,) kg m2 that a motor moves, its own included.
        headroom: (n,) N m of the torque limit left over by gravity.
    """
    w = 2 * np.pi * frequency[:, None]
    corner = 2 * np.pi * 6.0
    shape = np.ones((len(frequency), robot.n)) / np.sqrt(1 + (w / corner) ** 2)
    if injection == "position":
        shape = shape / (1 + (w / corner) ** 2)
        size = MOTION / np.sqrt(0.5 * np.sum(shape**2, axis=0))
        return shape * size
    # Torque to motion of the loop: its stiffness below the corner, the inertia above.
    motion = shape / (inertia * np.hypot(w**2, (2 * np.pi * LOOP_HZ) ** 2))
    size = MOTION / np.sqrt(0.5 * np.sum(motion**2, axis=0))
    rms = size * np.sqrt(0.5 * np.sum(shape**2, axis=0))
    most = np.maximum(np.minimum(MOST_MOTION, RANGE_SHARE * (robot.q_max - robot.q_min)), MOTION)
    more = np.clip(LEAST_TORQUE * robot.array("tau_std") / rms, 1.0, most / MOTION)
    size, rms = size * more, rms * more
    size = size * np.minimum(1.0, headroom / (3.5 * rms))
    speed = size * np.sqrt(0.5 * np.sum((motion * w) ** 2, axis=0))
    size = size * np.minimum(1.0, SPEED_SHARE * robot.array("velocity_limit") / (3.5 * speed))
    return shape * size
