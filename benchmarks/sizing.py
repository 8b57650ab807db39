"""Effects brought to a size: what they change, over the noise."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeVar

import numpy as np

E = TypeVar("E")

TRIALS = 6  # sizes found out, at most
NEAR = 0.1  # logarithm of the ratio to the target within which an effect is there
LONGEST = 4.0  # step of log strength
SLOPES = 0.3, 3.0  # of log size over log strength that a step believes


def brought_to(stronger: Callable[[float], E], size: Callable[[E], float], target: float) -> E:
    """The effect of a size, by secants of the logarithm of size over that of strength; the nearest where none is found.

    Args:
        stronger: the effect with its strength times a factor.
        size: of an effect, above nothing where the effect does anything.
    """
    found: list[tuple[float, float, E]] = []
    step = 0.0
    for _ in range(TRIALS):
        effect = stronger(float(np.exp(step)))
        off = float(np.log(max(size(effect), 1e-12) / target))
        found.append((step, off, effect))
        if abs(off) < NEAR:
            break
        slope = 1.0
        if len(found) > 1:
            (a, u, _), (b, v, _) = found[-2:]
            slope = float(np.clip((v - u) / (b - a), *SLOPES))
        step -= float(np.clip(off / slope, -LONGEST, LONGEST))
    return min(found, key=lambda x: abs(x[1]))[2]
