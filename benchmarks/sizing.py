"""Effects brought to a size: what they change that drives cannot, over the noise of the lines.

A friction that drives with more viscous friction would show too, or a hinge that a softer gear gives as well, is no
distortion that any data can tell.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TypeVar

import numpy as np
import scipy.fft
from scipy.ndimage import uniform_filter1d

from ident.dataset import Segment

E = TypeVar("E")

CHANNELS = "tau", "q"
NEIGHBOURS = 9  # lines over which the noise of a line is averaged: few periods tell it poorly

TRIALS = 12  # sizes found out, at most
NEAR = 0.25  # logarithm of the ratio to the target within which an effect is there: the size it has is what is reported
LONGEST = 4.0  # step of log strength
LARGEST = float(np.log(30.0))  # log strength: a gear with a gap of degrees is another machine
EDGE = 0.1  # share of the way between too little and too much, at either end, where no secant is followed
SLOPES = 0.3, 3.0  # of log size over log strength that a step believes


def brought_to(stronger: Callable[[float], E], size: Callable[[E], float], target: float) -> E:
    """The effect of a size, by secants of the logarithm of size over that of strength; the nearest where none is found.

    The strength ends where no machine has such an effect: one that hardly shows is left small.

    Between a strength that does too little and one that does too much in halves, where the secant leads out of there or
    to an end: such effects do nothing and all at once, as a limit does that the torque just reaches.

    Args:
        stronger: the effect with its strength times a factor.
        size: of an effect, 0 where it does nothing, infinite where the arm cannot run with it.
    """
    found: list[tuple[float, float, E]] = []
    step, low, high = 0.0, -np.inf, np.inf
    for _ in range(TRIALS):
        effect = stronger(float(np.exp(step)))
        off = float(np.log(np.clip(size(effect), 1e-12, 1e12) / target))
        found.append((step, off, effect))
        if abs(off) < NEAR:
            break
        low, high = (max(low, step), high) if off < 0.0 else (low, min(high, step))
        slope = 1.0
        if len(found) > 1:
            (a, u, _), (b, v, _) = found[-2:]
            slope = float(np.clip((v - u) / (b - a), *SLOPES))
        step -= float(np.clip(off / slope, -LONGEST, LONGEST))
        margin = EDGE * (high - low) if np.isfinite(high - low) else 0.0
        if not low + margin < step < high - margin:
            step = 0.5 * (low + high)
        step = min(step, LARGEST)
        if low >= LARGEST:
            break
    return min(found, key=lambda x: abs(x[1]))[2]


def spectra(segments: Sequence[Segment], lines: int) -> np.ndarray:
    """(S, lines, 2, n) mean over the steady periods of torque and position at lines 1 to ``lines``.

    What the arm does at rest is left out: the torque that holds it up would count for more than all its motion.
    """
    return np.stack([[_lines(s, c).mean(axis=0)[1 : lines + 1] for c in CHANNELS] for s in segments]).swapaxes(1, 2)


def noise_power(segments: Sequence[Segment], lines: int) -> np.ndarray:
    """(lines, 2, n) power of the noise of such means, from the scatter of periods, as an experimenter sees it.

    What disturbs the motor is in it, beside the noise of the sensors.
    """
    each = [[_lines(s, c).var(axis=0, ddof=1)[1 : lines + 1] / s.steady_periods for c in CHANNELS] for s in segments]
    return uniform_filter1d(np.mean(each, axis=0).swapaxes(0, 1), NEIGHBOURS, axis=0, mode="nearest")


def _lines(segment: Segment, channel: str) -> np.ndarray:
    return scipy.fft.rfft(segment.periodic(channel), axis=1, norm="forward")


def distortion(change: np.ndarray, drives: np.ndarray, noise: np.ndarray) -> float:
    """Root mean square over lines and channels of a change that drives cannot make, over the noise; of the segment and
    joint with most.

    Args:
        change: (S, K, 2, n) as of ``spectra``.
        drives: (W, S, K, 2, n) what small changes of single figures of the drives do.
        noise: (K, 2, n) as of ``noise_power``.
    """
    scale = 1.0 / np.sqrt(noise)
    b, A = (_real((x * scale).reshape(*x.shape[: x.ndim - 4], -1)) for x in (change, drives))
    A = A / np.maximum(np.linalg.norm(A, axis=1, keepdims=True), 1e-300)
    left = b - np.linalg.lstsq(A.T, b, rcond=1e-8)[0] @ A
    power = (left.reshape(2, *change.shape) ** 2).sum(axis=0).mean(axis=(1, 2))
    return float(np.sqrt(power.max()))


def _real(x: np.ndarray) -> np.ndarray:
    return np.concatenate([x.real, x.imag], axis=-1)
