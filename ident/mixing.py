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
    dx = np.stack([x - a for a, _ in past[:-1]])
    df = np.stack([f - b for _, b in past[:-1]])
    flat, last = df.reshape(*df.shape[:2], -1), f.reshape(len(f), -1)
    A = np.einsum("ask,bsk->sab", flat.conj(), flat, optimize=True).real
    b = np.einsum("ask,sk->sa", flat.conj(), last, optimize=True).real
    ridge = 1e-12 * np.trace(A, axis1=1, axis2=2) + 1e-300
    share = np.linalg.solve(A + ridge[:, None, None] * np.eye(len(dx)), b[..., None])[..., 0]
    return x + f - np.einsum("as...,sa->s...", dx + df, share, optimize=True)
