"""Laws with memory, stepped along time in compiled code.

Each takes (S, T) signals over one period and returns the periodic steady state: the period is run
again until it repeats (friction elements forget in one).
"""

from __future__ import annotations

import numpy as np
from numba import njit

SWEEPS = 25  # periods at most until the steady state
CUBIC, BACKLASH, SOFTENING, HYSTERESIS = 0, 1, 2, 3


@njit(cache=True)
def bristle(v: np.ndarray, dt: float, length: float) -> np.ndarray:
    """Dahl bristle of unit Coulomb torque along velocity ``v`` (S, T).

    ``z' = v / length - |v| / length z``: exact over steps of constant velocity (Dahl 1968).

    Args:
        length: breakaway distance, Coulomb torque over bristle stiffness, rad.
    """
    S, T = v.shape
    out = np.empty((S, T))
    for i in range(S):
        z = 0.0
        for sweep in range(2):
            for k in range(T):
                path = 0.5 * (v[i, k] + v[i, k - 1]) * dt / length
                decay = np.exp(-abs(path))
                z = z * decay + (1.0 - decay) * (1.0 if path > 0 else -1.0)
                out[i, k] = z
    return out


@njit(cache=True)
def elastoplastic(x: np.ndarray, stiffness: float, limit: float) -> np.ndarray:
    """Maxwell slip element: torque of a spring that yields, along deflection ``x`` (S, T)."""
    S, T = x.shape
    out = np.empty((S, T))
    for i in range(S):
        h = 0.0
        for sweep in range(2):
            for k in range(T):
                h = h + stiffness * (x[i, k] - x[i, k - 1])
                h = min(max(h, -limit), limit)
                out[i, k] = h
    return out


@njit(cache=True)
def spring_torque(code: int, a: float, b: float, k: float, x: float, x_old: float, h_old: float) -> float:
    """Torque beyond ``k x`` of a nonlinear gear at deflection ``x``."""
    if code == 0:
        return a * x * x * x
    if code == 1:
        half = 0.5 * a
        if x > half:
            return -k * half
        if x < -half:
            return k * half
        return -k * x
    if code == 2:
        if x > b:
            return (a - k) * b
        if x < -b:
            return -(a - k) * b
        return (a - k) * x
    return min(max(h_old + a * (x - x_old), -b), b)


@njit(cache=True)
def spring_loop(
    code: int,
    a: float,
    b: float,
    k: float,
    linear: np.ndarray,
    decay: np.ndarray,
    gain_old: np.ndarray,
    gain_new: np.ndarray,
) -> np.ndarray:
    """Steady state of ``delta = linear - r * h(delta)``; (S, T) torque ``h``.

    ``r`` is the compliance of the arm at the spring, as a sum of modes stepped with a first-order
    hold: ``x+ = decay x + gain_old h + gain_new h+``, ``delta = linear - Re sum x``.

    Args:
        code, a, b: law and its two parameters; k: linear stiffness, N m/rad.
        linear: (S, T) deflection without ``h``, rad.
        decay, gain_old, gain_new: (modes,) complex.
    """
    S, T = linear.shape
    modes = len(decay)
    out = np.zeros((S, T))
    direct = 0.0
    for m in range(modes):
        direct += gain_new[m].real
    x = np.zeros(modes, np.complex128)
    for i in range(S):
        x[:] = 0.0
        h = spring_torque(code, a, b, k, linear[i, T - 1], linear[i, T - 1], 0.0)
        delta = linear[i, T - 1]
        for sweep in range(SWEEPS):
            change = 0.0
            largest = 0.0
            for t in range(T):
                free = linear[i, t]
                for m in range(modes):
                    x[m] = decay[m] * x[m] + gain_old[m] * h
                    free -= x[m].real
                guess = free - direct * h
                h_new = h
                for it in range(4):
                    h_new = spring_torque(code, a, b, k, guess, delta, h)
                    guess = free - direct * h_new
                for m in range(modes):
                    x[m] += gain_new[m] * h_new
                delta = guess
                h = h_new
                change = max(change, abs(h - out[i, t]))
                largest = max(largest, abs(h))
                out[i, t] = h
            if sweep > 0 and change <= 1e-5 * largest:
                break
    return out


def modal_compliance(
    M: np.ndarray, D: np.ndarray, K: np.ndarray, column: int, dt: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Modes of ``[(s^2 M + s D + K)^{-1}]_{cc}`` for ``spring_loop``: decay, gain_old, gain_new.

    Conjugate pairs are folded into one mode of twice the residue; a first-order hold over ``dt``.
    """
    N = len(M)
    M_inv = np.linalg.inv(M)
    A = np.block([[np.zeros((N, N)), np.eye(N)], [-M_inv @ K, -M_inv @ D]])
    poles, right = np.linalg.eig(A)
    B = np.zeros(2 * N)
    B[N:] = M_inv[:, column]
    residue = right[column] * np.linalg.solve(right, B)
    upper = poles.imag > 1e-9
    real = np.abs(poles.imag) <= 1e-9
    poles = np.concatenate([poles[upper], poles[real]])
    residue = np.concatenate([2 * residue[upper], residue[real]])
    z = poles * dt
    decay = np.exp(z)
    phi1 = np.expm1(z) / z
    phi2 = (phi1 - 1.0) / z
    return decay, residue * dt * (phi1 - phi2), residue * dt * phi2
