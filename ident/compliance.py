"""Compliance of the links at many frequencies: inverses of small matrices, in compiled code.

LAPACK, asked for one small matrix at a time, takes longer to begin than to invert it.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from ident.recursion import FUSED


def link_compliance(
    M: np.ndarray, Kg: np.ndarray, stiffness: np.ndarray, damping: np.ndarray, rate: np.ndarray, square: np.ndarray
) -> np.ndarray:
    """Inverse of ``square M + Kg + diag(stiffness + rate damping)``; (F, N, N).

    Args:
        M, Kg: (N, N), or (F, N, N) one for each frequency.
        stiffness, damping: (N,) of each coordinate.
        rate, square: (F,) complex, what a position is multiplied by for its velocity and for its acceleration.

    Raises:
        numpy.linalg.LinAlgError: one of them is singular.
    """
    N = len(stiffness)
    M, Kg = (np.ascontiguousarray(x, float).reshape(-1, N, N) for x in (M, Kg))
    stiffness, damping = (np.ascontiguousarray(x, float) for x in (stiffness, damping))
    rate, square = (np.ascontiguousarray(x, complex) for x in (rate, square))
    out = np.empty((len(square), N, N), complex)
    if not _inverses(M, Kg, stiffness, damping, rate, square, out):
        raise np.linalg.LinAlgError("singular matrix")
    return out


@njit(cache=True, nogil=True, fastmath=FUSED, error_model="numpy")
def _inverses(M, Kg, stiffness, damping, rate, square, out):
    """``link_compliance`` into ``out``, by Gauss-Jordan elimination with row pivots; False where a pivot is zero."""
    F, N = len(square), len(stiffness)
    each_mass, each_gravity = int(len(M) > 1), int(len(Kg) > 1)
    rows = np.empty(N, np.int64)
    for f in range(F):
        A, mass, gravity = out[f], M[f * each_mass], Kg[f * each_gravity]
        for i in range(N):
            for j in range(N):
                A[i, j] = square[f] * mass[i, j] + gravity[i, j]
            A[i, i] += stiffness[i] + rate[f] * damping[i]
        for k in range(N):
            pivot, largest = k, 0.0
            for i in range(k, N):
                size = abs(A[i, k].real) + abs(A[i, k].imag)
                if size > largest:
                    pivot, largest = i, size
            if A[pivot, k] == 0.0:
                return False
            rows[k] = pivot
            if pivot != k:
                for j in range(N):
                    A[k, j], A[pivot, j] = A[pivot, j], A[k, j]
            scale = 1.0 / A[k, k]
            A[k, k] = 1.0
            for j in range(N):
                A[k, j] *= scale
            for i in range(N):
                if i != k:
                    factor = A[i, k]
                    A[i, k] = 0.0
                    for j in range(N):
                        A[i, j] -= factor * A[k, j]
        for k in range(N - 1, -1, -1):
            pivot = rows[k]
            if pivot != k:
                for i in range(N):
                    A[i, k], A[i, pivot] = A[i, pivot], A[i, k]
    return True
