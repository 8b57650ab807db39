"""Stribeck frictions in parallel, each falling with the square of the velocity, that stand for one that falls
otherwise."""

from __future__ import annotations

import numpy as np
import scipy.optimize

SQUARE = 2.0  # exponent of the velocity in the fall of MuJoCo's own friction
# over the Stribeck velocity: those of the parts, and at which they are alike
WIDTHS, VELOCITIES = 2.0 ** np.arange(-6, 5), np.geomspace(1e-3, 30.0, 400)
LEAST = 1e-2  # share below which a part is left out


def square_dips(velocity: float, exponent: float) -> list[tuple[float, float]]:
    """Shares and Stribeck velocities (rad/s) of ``exp(-(v / v_s)^2)`` that add up to ``exp(-|v / velocity|^exponent)``.

    By non-negative least squares: a fall by a smaller power is a mixture of these (Bernstein; of the square of the
    velocity it is completely monotone). A few of them are within 2 % of one down to a power of 0.7, and 7 % of 0.5.
    """
    if exponent >= SQUARE:
        return [(1.0, velocity)]
    parts = np.exp(-((VELOCITIES[:, None] / WIDTHS) ** 2))
    shares, _ = scipy.optimize.nnls(parts, np.exp(-(VELOCITIES**exponent)))
    kept = shares > LEAST
    return list(zip(shares[kept] / shares[kept].sum(), velocity * WIDTHS[kept], strict=True))
