"""Steps of Newton's method for the motion of links: their linear dynamics along a motion.

The arm at rest tells how a small torque moves the links as long as they stay near its posture. Where they move far,
inertia, Coriolis torque and gravity change on the way, and with them the resonances of gears that hardly damp:

    M(t) a + C(t) v + K(t) q = -change(t),      M, C, K: slopes of inverse dynamics along the motion, with springs

is solved for the periodic ``q(t)``, marched in steps of time (Newmark, J. Eng. Mech. Div. ASCE 85, 1959) from the state
that returns to itself after a period (Floquet).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy.fft
from numba import njit

from ident.group import Group, to_lines, to_time
from ident.recursion import Chain, newton_euler

POINTS, MOST_POINTS = 8.0, 24.0  # of the time grid per line: as few, and as many where modes are faster than lines
# Newmark's beta: that of Fox and Goodwin (Proc. Camb. Phil. Soc. 45, 1949) puts resonances where they are to fourth order,
# and stays bounded where no mode turns by more than sqrt(6) rad in a step; that of the trapezoidal rule always does
FOURTH_ORDER, BOUNDED = 1.0 / 12.0, 0.25
ROOM = 1 << 29  # bytes for the slopes of a group; records beyond go on by the arm at rest
MOST_TURN, AIMED_TURN = 2.0, 1.2  # rad, along the motion and at rest
LOOKED_AT = 16  # steps of time between looks at the modes
STEP = 1e-6  # of a difference by position, rad, and by velocity, rad/s


@dataclass(frozen=True)
class Varying:
    """Links along the motions of S records of a group, T points of time each.

    Attributes:
        records: (S,) which they are.
        time_step: s.
        factors: (S, T, N, N) triangular factors of what resists an acceleration in a step of time.
        by_velocity, by_position: (S, T, N, N) slopes of the torque.
        beta: Newmark's.
        inertia: (S, N, N) at the first point of time.
        turn: (S, 2N, 2N) state after a period by that before it, where nothing drives.
        at_rest: (L, N, N) torque per position of the arm at rest, in the same steps of time.
    """

    records: np.ndarray
    time_step: float
    factors: np.ndarray
    by_velocity: np.ndarray
    by_position: np.ndarray
    beta: float
    inertia: np.ndarray
    turn: np.ndarray
    at_rest: np.ndarray

    def step(self, change: np.ndarray, records: np.ndarray) -> np.ndarray:
        """By how much to move the remainder (R, L, N) of R records, which the motion that it causes would change by
        ``change``, N m.

        ``change`` itself for links that stay near the posture at rest, and for records that are not linearised.
        """
        out = change.copy()
        there = np.flatnonzero(np.isin(records, self.records))
        if len(there):
            rows = np.searchsorted(self.records, records[there])
            out[there, : len(self.at_rest)] = self._answer(change[there, : len(self.at_rest)], rows)
        return out

    def _answer(self, change: np.ndarray, rows: np.ndarray) -> np.ndarray:
        load = to_time(-change, self.factors.shape[1])
        h = self.time_step
        moved = np.empty_like(load)
        N = load.shape[-1]
        for i, f, path in zip(rows, load, moved, strict=True):
            slopes = self.factors[i], self.by_velocity[i], self.by_position[i], h, self.beta
            still = np.zeros(2 * N)
            end = march(*slopes, still, np.linalg.solve(self.inertia[i], f[0]), f, path)
            start = np.linalg.solve(np.eye(2 * N) - self.turn[i], end)
            march(*slopes, start, self._acceleration(i, start, f[0]), f, path)
        moved = np.roll(moved, 1, axis=1)  # the last point is the first of the next period
        return -np.einsum("lab,slb->sla", self.at_rest, to_lines(moved, len(self.at_rest)))

    def _acceleration(self, i: int, state: np.ndarray, load: np.ndarray) -> np.ndarray:
        q, v = np.split(state, 2)
        return np.linalg.solve(self.inertia[i], load - self.by_velocity[i, 0] @ v - self.by_position[i, 0] @ q)


def along(
    chain: Chain,
    spring: np.ndarray,
    damper: np.ndarray,
    rest: Sequence[np.ndarray],
    group: Group,
    records: np.ndarray,
    Q_a: np.ndarray,
) -> Varying:
    """Links linearised along a motion.

    Args:
        spring, damper: (N,) at the coordinates, N m/rad and N m s/rad.
        rest: M, Kg (N, N) of the arm at rest, kg m2 and N m/rad.
        records: (S,) which of the group's; the first ones alone where there is no room for all.
        Q_a: (S, L, N) motion of their links, rad.

    Raises:
        FloatingPointError: no arm moves so.
    """
    omega = group.omega[: group.n_slow]
    lines, N = len(omega), Q_a.shape[-1]
    inertia_at_rest, held = rest[0], np.diag(spring) + rest[1]
    fastest = np.sqrt(np.abs(np.linalg.eigvals(np.linalg.solve(inertia_at_rest, held)))).max()
    steps = np.clip(fastest * group.period_time / AIMED_TURN, POINTS * lines, MOST_POINTS * lines)
    n_time = scipy.fft.next_fast_len(int(steps), real=True)
    most = max(1, ROOM // (3 * 8 * n_time * N * N))
    records, Q_a = records[:most], Q_a[:most, :lines]
    s = 1j * omega[:, None]
    with np.errstate(over="ignore", invalid="ignore"):
        M, C, K = slopes(chain, *(to_time(s**k * Q_a, n_time) for k in range(3)))
    if not all(np.all(np.isfinite(x)) for x in (M, C, K)):
        raise FloatingPointError("the links cannot be linearised along their motion")
    k = np.arange(N)
    C[..., k, k] += damper
    K[..., k, k] += spring
    h = group.period_time / n_time
    inertia = M[:, 0].copy()
    looks = (slice(None), slice(None, None, LOOKED_AT))
    fastest = np.abs(np.linalg.eigvals(np.linalg.solve(M[looks], K[looks]))).max()
    beta = FOURTH_ORDER if h * np.sqrt(fastest) < MOST_TURN else BOUNDED
    factors = factorised(M + 0.5 * h * C + beta * h * h * K)
    # of a line, velocity and acceleration in such steps
    mean = np.tanh(0.5 * h * s)[..., None]
    rate = 2.0 / h * mean / (1.0 - (1.0 - 4.0 * beta) * mean**2)
    square = 2.0 / h * mean * rate
    of_rest = square * inertia_at_rest + rate * np.diag(damper) + held
    turn = np.empty((len(Q_a), 2 * N, 2 * N))
    out = Varying(records, h, factors, C, K, beta, inertia, turn, of_rest)
    nothing = np.zeros((n_time, N))
    path = np.empty_like(nothing)
    for i in range(len(Q_a)):
        for j, state in enumerate(np.eye(2 * N)):
            a = out._acceleration(i, state, nothing[0])
            turn[i, :, j] = march(factors[i], C[i], K[i], h, beta, state, a, nothing, path)
    return out


def slopes(chain: Chain, q: np.ndarray, v: np.ndarray, a: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Slopes (..., N, N) of the torque along a motion (..., N) by acceleration, velocity and position."""
    N = q.shape[-1]
    flat = [x.reshape(-1, N) for x in (q, v, a)]
    torque = newton_euler(chain, *flat)
    out = tuple(np.empty((len(torque), N, N)) for _ in range(3))
    for j, unit in enumerate(np.eye(N)):
        # linear in the acceleration: a difference over one whole unit is exact
        for slope, which, step in zip(out, (2, 1, 0), (1.0, STEP, STEP), strict=True):
            moved = [x + step * unit if which == i else x for i, x in enumerate(flat)]
            slope[:, :, j] = (newton_euler(chain, *moved) - torque) / step
    M, C, K = (x.reshape(*q.shape, N) for x in out)
    return M, C, K


@njit(cache=True, nogil=True)
def factorised(matrices):
    """Triangular factors (..., N, N) of matrices that are near positive definite ones: no pivots are sought."""
    out = matrices.copy()
    N = out.shape[-1]
    for A in out.reshape(-1, N, N):
        for k in range(N):
            for i in range(k + 1, N):
                A[i, k] /= A[k, k]
                for j in range(k + 1, N):
                    A[i, j] -= A[i, k] * A[k, j]
    return out


@njit(cache=True, nogil=True)
def march(factors, by_velocity, by_position, h, beta, state, acceleration, load, path):
    """State (2N,) after a period, of positions and velocities, from ``state``; ``path`` (T, N) becomes the positions
    after each step.

    Args:
        factors, by_velocity, by_position: (T, N, N); ``h``: s; ``beta``: Newmark's.
        acceleration: (N,) at the start.
        load: (T, N) torque that drives, N m.
    """
    T, N = load.shape
    q, v, a = state[:N].copy(), state[N:].copy(), acceleration.copy()
    for t in range(1, T + 1):
        at = t % T
        for i in range(N):
            q[i] += h * v[i] + (0.5 - beta) * h * h * a[i]
            v[i] += 0.5 * h * a[i]
        for i in range(N):
            a[i] = load[at, i]
            for j in range(N):
                a[i] -= by_velocity[at, i, j] * v[j] + by_position[at, i, j] * q[j]
        for i in range(N):
            for j in range(i):
                a[i] -= factors[at, i, j] * a[j]
        for i in range(N - 1, -1, -1):
            for j in range(i + 1, N):
                a[i] -= factors[at, i, j] * a[j]
            a[i] /= factors[at, i, i]
        for i in range(N):
            q[i] += beta * h * h * a[i]
            v[i] += 0.5 * h * a[i]
            path[t - 1, i] = q[i]
    return np.concatenate((q, v))
