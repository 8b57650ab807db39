"""Effects brought to a size: what they change, over the noise."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeVar

import numpy as np

E = TypeVar("E")

TRIALS = 12  # sizes found out, at most
NEAR = 0.1  # logarithm of the ratio to the target within which an effect is there
LONGEST = 4.0  # step of log strength
EDGE = 0.1  # share of the way between too little and too much, at either end, where no secant is followed
SLOPES = 0.3, 3.0  # of log size over log strength that a step believes


def brought_to(stronger: Callable[[float], E], size: Callable[[E], float], target: float) -> E:
    """The effect of a size, by secants of the logarithm of size over that of strength; the nearest where none is found.

    Between a strength that does too little and one that does too much in halves, where the secant leads out of there or to
    an end: such effects do nothing and all at once, as a limit does that the torque just reaches.

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
    return min(found, key=lambda x: abs(x[1]))[2]
