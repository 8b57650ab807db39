"""Local prediction errors: the stationary Kalman predictor of the arm linearised where it was measured.

At each operating point the gray-box is sampled exactly (the torque is held over a sample) and the predictor is the
stationary Kalman filter of criterion (3), equations (5) and (6), of Wernholt and Moberg (2011):

    x(t+1) = A x(t) + B u(t) + K e(t),    e(t) = y(t) - C x(t),    y = motor positions
    P = A P A^T + B Q B^T - K Lambda K^T,    Lambda = C P C^T + R,    K = A P C^T Lambda^-1

with states ``[q_m, q_a, q_m', q_a']`` about the equilibrium. ``Q``: white noise on the motor torque, held over a
sample; ``R``: white noise of the position. In steady state the criterion is FRF matching weighted by the inverse
covariance of the FRFs (tests/test_predict.py).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.linalg
from numba import njit

from ident.chain import Structure
from ident.graybox import Linearisation, Parameters, damping_diagonal, equilibrium, linearise, stiffness_diagonal
from ident.predict import Noise, Prediction, Predictor, Runs, gaussian
from robot_assets.errors import DataError


@dataclass(frozen=True)
class StateSpace:
    """The sampled linear arm, deviations from rest; states ``[q_m (n), q_a (N)]`` and their velocities.

    Attributes:
        A: (nx, nx). B: (nx, n) for a torque held over the sample. The output is the first n states.
        continuous, gain: A and B before sampling, 1/s.
    """

    A: np.ndarray
    B: np.ndarray
    continuous: np.ndarray
    gain: np.ndarray


@dataclass(frozen=True)
class Kalman:
    """Stationary predictor: K (nx, n), covariance P (nx, nx) of the predicted state, Lambda (n, n) of innovations."""

    space: StateSpace
    K: np.ndarray
    P: np.ndarray
    Lambda: np.ndarray


def spring_torque(structure: Structure, par: Parameters) -> np.ndarray:
    """(n + N, nx) torque of springs and dampers on motors and links per state; motor friction among it."""
    n, N, driven = structure.n, structure.n_coordinates, structure.driven
    out = []
    for gear, diagonal in ((par.stiffness, stiffness_diagonal), (par.damping, damping_diagonal)):
        W = np.zeros((n + N, n + N))
        W[:n, :n] = -par.coupling.T @ (gear[:, None] * par.coupling)
        W[:n, n + driven] = par.coupling.T * gear
        W[n + driven, :n] = gear[:, None] * par.coupling
        W[n:, n:] = -np.diag(diagonal(structure, par))
        out.append(W)
    k = np.arange(n)
    out[1][k, k] -= par.viscous
    return np.concatenate(out, axis=1)


def state_space(structure: Structure, par: Parameters, lin: Linearisation, sample_time: float) -> StateSpace:
    """Exact zero-order-hold sampling of the arm linearised at ``lin``."""
    n, N = structure.n, structure.n_coordinates
    half = n + N
    W = spring_torque(structure, par)
    W[n:, n:half] -= lin.Kg
    continuous, gain = np.zeros((2 * half, 2 * half)), np.zeros((2 * half, n))
    continuous[:half, half:] = np.eye(half)
    continuous[half : half + n] = W[:n] / par.inertia[:, None]
    continuous[half + n :] = np.linalg.solve(lin.M, W[n:])
    gain[half : half + n] = np.diag(1.0 / par.inertia)
    (A, B), _ = held(continuous, gain, sample_time)
    return StateSpace(A, B, continuous, gain)


def held(
    continuous: np.ndarray, gain: np.ndarray, sample_time: float
) -> tuple[tuple[np.ndarray, np.ndarray], np.ndarray]:
    """((A, B) for an input held over a sample, B for one that rises linearly over it from zero to one)."""
    nx, m = gain.shape
    block = np.zeros((nx + 2 * m, nx + 2 * m))
    block[:nx, :nx], block[:nx, nx : nx + m] = continuous * sample_time, gain * sample_time
    block[nx : nx + m, nx + m :] = np.eye(m)
    E = scipy.linalg.expm(block)
    return (E[:nx, :nx], E[:nx, nx : nx + m]), E[:nx, nx + m :]


def kalman(space: StateSpace, noise: Noise, sample_time: float) -> Kalman:
    """Stationary predictor from the discrete Riccati equation.

    States are scaled to the size of the noise first: radians and their variances leave the equation no digits.

    Raises:
        DataError: where no stationary predictor is found.
    """
    nx, n = space.B.shape
    size = float(np.exp(np.mean(np.log(noise.measurement))))
    scale = size * np.repeat([1.0, 0.1 / sample_time], nx // 2)
    A = space.A * scale / scale[:, None]
    G = space.B * noise.process / scale[:, None]
    try:
        P = scipy.linalg.solve_discrete_are(A.T, np.eye(nx)[:, :n], G @ G.T, np.diag((noise.measurement / size) ** 2))
    except np.linalg.LinAlgError as error:
        raise DataError("Riccati equation", "kalman", str(error), "an arm with noise on every motor") from error
    P = P * scale[:, None] * scale
    P = 0.5 * (P + P.T)
    Lambda = P[:n, :n] + np.diag(noise.measurement**2)
    return Kalman(space, space.A @ np.linalg.solve(Lambda, P[:n]).T, P, Lambda)


def local_predictor(structure: Structure, runs: Runs) -> Predictor:
    """Predictor of criterion (3): stationary Kalman filters of the arm linearised where each run was measured.

    Torques and positions are taken from their means over the samples that count, as FRFs are.
    """
    u, y = (x - x[:, runs.skip :].mean(axis=1, keepdims=True) for x in (runs.u, runs.y))

    def predict(par: Parameters, noise: Noise) -> Prediction:
        filters = []
        for q in runs.q0:
            lin = linearise(structure, equilibrium(structure, par, q))
            filters.append(kalman(state_space(structure, par, lin, runs.sample_time), noise, runs.sample_time))
        e = np.stack([innovations(filters[p], u[r], y[r]) for r, p in enumerate(runs.point)])
        return gaussian(e[:, runs.skip :], np.stack([filters[p].Lambda for p in runs.point])[:, None])

    return predict


def innovations(predictor: Kalman, u: np.ndarray, y: np.ndarray) -> np.ndarray:
    """(T, n) one-step prediction errors of one run (T, n) from the state zero."""
    space = predictor.space
    return _innovations(space.A, space.B, predictor.K, np.ascontiguousarray(u), np.ascontiguousarray(y))


@njit(cache=True, nogil=True)
def _innovations(A, B, K, u, y):
    T, n = u.shape
    nx = A.shape[0]
    e, x, new = np.empty((T, n)), np.zeros(nx), np.empty(nx)
    for t in range(T):
        for i in range(n):
            e[t, i] = y[t, i] - x[i]
        for i in range(nx):
            total = 0.0
            for j in range(nx):
                total += A[i, j] * x[j]
            for j in range(n):
                total += B[i, j] * u[t, j] + K[i, j] * e[t, j]
            new[i] = total
        x[:] = new
    return e
