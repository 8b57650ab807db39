"""Maxwell slips in parallel that stand for an element that yields gradually."""

from __future__ import annotations

import numpy as np
import scipy.optimize

from ident.hypotheses.yielding import SLIP, along_path, elastoplastic

# deflections at which slips yield, over that at which the element would if it were one
GIVES = np.geomspace(0.08, 4.0, 12)
# of the path along which they are alike: it grows to this deflection and dies out
SWINGS, POINTS, REACH = 12, 4800, 4.0
LEAST = 1e-3  # share of the torque below which a slip is left out


def maxwell_slips(stiffness: float, limit: float, exponent: float, recoil: float) -> list[tuple[float, float]]:
    """Stiffness (N m/rad) and yield torque (N m) of slips in parallel nearest to an element that yields.

    Weights of fixed slips by non-negative least squares along a swing of all amplitudes (parallel slips: Iwan, J. Appl.
    Mech. 33, 1966). Such a sum closes its small loops and a Bouc-Wen element does not: where a round one hardly yields
    the torques differ by up to half.
    """
    if exponent >= SLIP:
        return [(stiffness, limit)]
    t = np.arange(POINTS) / POINTS
    x = REACH * np.sin(np.pi * t) ** 2 * np.sin(2 * np.pi * SWINGS * t)
    wanted = along_path((x - np.roll(x, 1))[None], 1.0, 1.0, exponent, recoil)[0]
    parts = np.stack([elastoplastic(x[None], 1.0, give)[0] for give in GIVES], axis=1)
    weights, _ = scipy.optimize.nnls(parts, wanted)
    return [(w * stiffness, w * give * limit) for w, give in zip(weights, GIVES, strict=True) if w * give > LEAST]
