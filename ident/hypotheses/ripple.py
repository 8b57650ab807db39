"""What repeats with a position: a sine and cosine of its angle, and a weaker second harmonic of them.

Slots, teeth and balls of real drives make harmonics; a ripple far above the noise would leave what it lacks of them.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ident.hypotheses.hypothesis import Parameter

LARGEST_SECOND, SECOND_SPREAD = 0.6, 0.15  # of the second harmonic, over the first: at most, and before the data
SECOND = tuple(
    Parameter(
        name, "1", -LARGEST_SECOND, LARGEST_SECOND, nuisance=True, step=1e-2, center=0.0, spread=SECOND_SPREAD, null=0.0
    )
    for name in ("second_sine", "second_cosine")
)


def ripple(sine: float, cosine: float, second: Sequence[float], angle: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """A ripple and its slope over the angle.

    Args:
        sine, cosine: of the first harmonic, any unit.
        second: (2,) sine and cosine of the second harmonic, over the amplitude of the first.
        angle: rad, any shape.

    Returns:
        Value and slope, of the shape of ``angle``, in the unit of the first harmonic.
    """
    s, c = np.sin(angle), np.cos(angle)
    value, slope = sine * s + cosine * c, sine * c - cosine * s
    if np.any(second):
        a, b = np.hypot(sine, cosine) * np.asarray(second)
        double_s, double_c = 2.0 * s * c, 1.0 - 2.0 * s * s
        value, slope = value + a * double_s + b * double_c, slope + 2.0 * (a * double_c - b * double_s)
    return value, slope
