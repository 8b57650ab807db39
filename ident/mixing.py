"""Anderson mixing of fixed points."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

MEMORY = 6  # past iterates that are mixed


def mixed(past: Sequence[tuple[np.ndarray, np.ndarray]]) -> np.ndarray:
    """Next iterate of the fixed point ``x = x + change(x)``, for every entry of the first axis by itself.

    The combination of past iterates whose changes cancel best. Plain steps overshoot or creep where the arm is
    resonant (Walker and Ni, SIAM J. Numer. Anal. 49, 2011).

    Args:
        past: iterates and their changes, (S, ...) each, real or complex, the newest last.
    """
    x, f = past[-1]
    if len(past) == 1:
        return x + f
    steps = np.stack([(x - a).reshape(len(x), -1) for a, _ in past[:-1]], axis=1)
    turns = np.stack([(f - b).reshape(len(f), -1) for _, b in past[:-1]], axis=1)
    # Real and imaginary parts side by side.
    R, last = (np.ascontiguousarray(y).view(float) for y in (turns, f.reshape(len(f), -1)))
    A, b = R @ R.transpose(0, 2, 1), R @ last[..., None]
    ridge = 1e-12 * np.trace(A, axis1=1, axis2=2) + 1e-300
    share = np.linalg.solve(A + ridge[:, None, None] * np.eye(A.shape[1]), b)
    return x + f - (share.transpose(0, 2, 1) @ (steps + turns)).reshape(x.shape)
