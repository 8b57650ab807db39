"""Elements that yield: a spring up to a limit, and how it gets there.

The torque ``h`` along a path ``x`` follows ``h' = k (1 - w^n) x'`` where the path drives it on and ``h' = k (1 + r w^n)
x'`` where it leads it back, ``w = |h| / limit``: a Bouc-Wen element (Wen, J. Eng. Mech. Div. ASCE 102, 1976, with
``beta + gamma = 1``, ``beta - gamma = r >= 0``). It holds Dahl's bristle (``n = 1``, ``r = 1``; Dahl 1968) and, where
``n`` is large, the Maxwell slip; several slips of different limits in parallel are close to one of some ``n`` between.
"""

from __future__ import annotations

import numpy as np
from numba import njit

DAHL = 1.0  # exponent of Dahl's bristle
SLIP = 50.0  # exponent from which on the element is a Maxwell slip
SHORT = 1e-4  # of the deflection at which an element yields: a step whose square is nothing


def elastoplastic(x: np.ndarray, stiffness: float, limit: float, *, begins: bool = False) -> np.ndarray:
    """Maxwell slip element: torque of a spring that yields, along one period of a deflection ``x`` (S, T).

    Args:
        begins: whether it is relaxed where the period begins; else as the period before has left it.
    """
    if begins:
        return onward(np.diff(x, axis=1, prepend=x[:, :1]), stiffness, limit, SLIP, 0.0, np.zeros(len(x)))
    return along_path(x - np.roll(x, 1, axis=1), stiffness, limit, SLIP, 0.0)


def bristle(
    v: np.ndarray, dt: float, length: float, exponent: float = DAHL, start: np.ndarray | None = None
) -> np.ndarray:
    """Torque of a bristle of unit Coulomb torque along one period of a velocity ``v`` (S, T), rad/s.

    Args:
        dt: s; length: breakaway distance, Coulomb torque over bristle stiffness, rad.
        exponent: Dahl's where nothing is said: exact then over steps of constant velocity.
        start: (S,) torque at the first instant; what the period before has left where None.
    """
    steps = 0.5 * dt * (v + np.roll(v, 1, axis=1))
    if start is None:
        return along_path(steps, 1.0 / length, 1.0, exponent, 1.0)
    steps[:, 0] = 0.0
    return onward(steps, 1.0 / length, 1.0, exponent, 1.0, start)


def dipping_bristle(v: np.ndarray, dt: float, stiffness: float, limits: np.ndarray) -> np.ndarray:
    """Torque of a Dahl bristle whose Coulomb torque changes on the way, along one period of a velocity ``v`` (S, T).

    That of the LuGre model but for the damping of the bristle (Canudas de Wit, Olsson, Astrom and Lischinsky, IEEE
    Trans. Automatic Control 40, 1995).

    Args:
        dt: s; stiffness: N m/rad; limits: (S, T) N m, above zero.
    """
    steps = 0.5 * dt * (v + np.roll(v, 1, axis=1))
    before = following(steps, stiffness, limits, np.zeros(len(v)))
    return following(steps, stiffness, limits, before[:, -1].copy())


@njit(cache=True, nogil=True)
def following(steps: np.ndarray, stiffness: float, limits: np.ndarray, start: np.ndarray) -> np.ndarray:
    """Torque (S, T) of a Dahl bristle along steps, from a torque ``start`` (S,).

    Exact where the limit (S, T), that after each step, changes at an even rate over it: a stiff bristle is at the limit.
    """
    S, T = steps.shape
    h, out = start.copy(), np.empty((S, T))
    for i in range(S):
        for t in range(T):
            sign = 1.0 if steps[i, t] > 0 else -1.0
            before, after = sign * limits[i, t - 1], sign * limits[i, t]
            lost, share = _decay(2.0 * stiffness * abs(steps[i, t] / (before + after)))
            h[i] = after - (after - before) * share + (h[i] - before) * (1.0 + lost)
            out[i, t] = h[i]
    return out


@njit(cache=True, nogil=True)
def along_path(steps: np.ndarray, stiffness: float, limit: float, exponent: float, recoil: float) -> np.ndarray:
    """Torque of an element that yields along the steps (S, T) of one period, after one period before it."""
    before = onward(steps, stiffness, limit, exponent, recoil, np.zeros(len(steps)))
    return onward(steps, stiffness, limit, exponent, recoil, before[:, -1].copy())


@njit(cache=True, nogil=True)
def onward(
    steps: np.ndarray, stiffness: float, limit: float, exponent: float, recoil: float, start: np.ndarray
) -> np.ndarray:
    """Torque (S, T) of an element that yields along steps from a torque ``start`` (S,).

    Records go side by side: a step waits for the one before it of its own record alone.
    """
    S, T = steps.shape
    ahead, h = np.ascontiguousarray(steps.T), start.copy()
    out = np.empty((T, S))
    for t in range(T):
        for i in range(S):
            h[i], _slope = yielded(stiffness, limit, exponent, recoil, h[i], ahead[t, i])
            out[t, i] = h[i]
    return np.ascontiguousarray(out.T)


@njit(cache=True, nogil=True)
def yielded(k: float, limit: float, n: float, recoil: float, h: float, dx: float) -> tuple[float, float]:
    """Torque after a step ``dx`` from a torque ``h``, and its slope there.

    By exponential steps, the law being linearised where each begins (Rosenbrock-Euler): of second order, stable for any
    ``dx``, and exact for Dahl's bristle.
    """
    return _yielded(k, limit, n, recoil, _power(h, limit, n), h, dx)


@njit(cache=True, nogil=True)
def _power(h: float, limit: float, n: float) -> float:
    """``w^n``; nothing of a Maxwell slip, which does not ask for it."""
    if n >= SLIP:
        return 0.0
    w = abs(h) / limit
    return w if n == DAHL else w**n


@njit(cache=True, nogil=True)
def _yielded(k: float, limit: float, n: float, recoil: float, power: float, h: float, dx: float) -> tuple[float, float]:
    """``yielded``, given the power ``w^n`` of where the step begins."""
    if n >= SLIP:
        new = h + k * dx
        if abs(new) > limit:
            return (limit if new > 0 else -limit), 0.0
        return new, k
    sign = 1.0 if dx > 0 else -1.0
    path, w, on = k * abs(dx) / limit, sign * h / limit, power
    if w < 0.0:
        back = recoil * power
        lost, share = _decay(n * back / -w * path)
        gone = (1.0 + back) * share * path
        if gone <= -w:
            return sign * limit * (w + gone), k * (1.0 + back) * (1.0 + lost)
        path, w, on = path * (1.0 + w / gone), 0.0, 0.0
    lost, share = _decay((n * on / w if w > 0.0 else (1.0 if n == 1.0 else 0.0)) * path)
    w += (1.0 - on) * share * path
    if w >= 1.0:
        return sign * limit, 0.0
    return sign * limit * w, k * (1.0 - on) * (1.0 + lost)


@njit(cache=True, nogil=True)
def _decay(x: float) -> tuple[float, float]:
    """``exp(-x) - 1``, and that over ``-x``; by a series where ``x`` is small, as it is but where an element yields."""
    if x < 1e-4:
        share = 1.0 - 0.5 * x * (1.0 - x / 3.0)
        return -x * share, share
    lost = np.expm1(-x)
    return lost, -lost / x


@njit(cache=True, nogil=True)
def yielding_point(
    k: float, limit: float, n: float, recoil: float, h: float, free: float, direct: float, near: float
) -> tuple[float, float]:
    """Step ``dx`` that solves ``dx + direct h(dx) = free``, and the torque there: by Newton's steps from ``near``.

    The last of them, which is short, moves the torque along its slope.
    """
    low, high = free - direct * limit, free + direct * limit
    dx = min(max(near, low), high)
    torque, power = h, _power(h, limit, n)
    for _ in range(60):
        torque, slope = _yielded(k, limit, n, recoil, power, h, dx)
        miss = dx + direct * torque - free
        if miss > 0.0:
            high = dx
        else:
            low = dx
        step = -miss / (1.0 + direct * slope)
        if not low <= dx + step <= high:  # Newton's steps go back and forth about a kink
            step = 0.5 * (low + high) - dx
        dx += step
        if abs(step) * k <= SHORT * limit:
            torque += slope * step
            break
    return dx, min(max(torque, -limit), limit)
