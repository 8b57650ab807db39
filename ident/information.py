"""Fisher information of candidate operating points, before anything is measured.

At an operating point the recorded torque and motion obey ``u = Z(theta) q + e``. An orthogonal
multisine gives n experiments with ``r r^H`` diagonal at each line; the position loop that holds the
posture turns them into the motion ``q = (Z + C)^-1 r``. White noise of encoder and torque record
leaves ``Sigma = S_u + Z S_q Z^H`` in ``e``, hence

    H = sum_lines 2 Re sum_experiments (dZ q)^H Sigma^-1 (dZ q)

which is the information ``2 Re Psi^H Lambda^-1 Psi`` of the FRF with its covariance (theory.md 2,
4 and 5; Wernholt and Lofberg 2007): ``dG = -G dZ G`` and the covariance of the FRF carries the same
factors, which cancel. Every derivative of ``Z`` is of rank one, ``c_p l_p l_p^T`` with ``c_p`` a
real number times a power of ``s``, so that H is a sum of products of two small Gram matrices.

Left out: the hold and the delay of the torque, which change its size by less than a percent in the
band, and nonlinear distortion, which nobody knows beforehand.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TypedDict

import numpy as np

from ident.chain import Structure
from ident.excitation import LOOP_HZ, TORQUE_SHARE, Excitation, shape_amplitudes
from ident.graybox import Linearisation, Parameters, equilibrium, impedance, linearise, spring_deflections
from robot_assets.errors import DataError

LOOP_DAMPING = 0.7  # of the position loop that holds a posture
CHUNK = 128  # lines of postures at a time: few enough that their matrices stay in the cache


@dataclass(frozen=True)
class Conditions:
    """What is common to the experiments at all candidates.

    Attributes:
        frequency: (F,) Hz, excited lines.
        amplitude: (F, n) peak torque of each line and input, N m.
        samples: recorded in the steady periods of all realizations of one experiment.
        q_std: (n,) rad. tau_std: (n,) N m; white sample noise.
    """

    frequency: np.ndarray
    amplitude: np.ndarray
    samples: int
    q_std: np.ndarray
    tau_std: np.ndarray


def conditions(
    structure: Structure,
    excitation: Excitation,
    lins: list[Linearisation],
    par: Parameters,
    *,
    realizations: int = 1,
) -> Conditions:
    """Conditions that the excitation and the noise of ``robot.toml`` give at a set of candidates.

    One amplitude for all, as in a plan: set by the least inertia and the largest gravity torque.
    """
    robot, loads = structure.robot, motor_loads(structure, par, lins)
    room = headroom(structure, loads["gravity_torque"])
    return Conditions(
        excitation.frequency,
        shape_amplitudes(robot, excitation.frequency, loads["inertia"], "torque", room),
        excitation.period * (excitation.periods - excitation.transient_periods) * realizations,
        robot.array("q_std"),
        robot.array("tau_std"),
    )


def headroom(structure: Structure, gravity: np.ndarray) -> np.ndarray:
    """(n,) torque left to the excitation beside a gravity torque (n,), N m; as ``make_plan`` has it."""
    limit = structure.robot.array("torque_limit")
    return np.maximum(TORQUE_SHARE * limit - gravity, 0.1 * limit)


def linearised(structure: Structure, par: Parameters, postures: np.ndarray) -> list[Linearisation]:
    """Linearisation at the equilibrium of every motor posture (Q, n)."""
    return [linearise(structure, equilibrium(structure, par, q)) for q in postures]


class MotorLoads(TypedDict):
    """Least ``inertia`` that each motor moves, kg m2, and largest ``gravity_torque``, N m, for ``make_plan``; (n,)."""

    inertia: np.ndarray
    gravity_torque: np.ndarray


def motor_loads(structure: Structure, par: Parameters, lins: Sequence[Linearisation]) -> MotorLoads:
    """What motors move and bear at worst over linearisations."""
    driven = structure.driven
    return {
        "inertia": par.inertia + np.min([np.diag(lin.M)[driven] for lin in lins], axis=0),
        "gravity_torque": np.max([np.abs(lin.g[driven]) for lin in lins], axis=0),
    }


def information(
    structure: Structure,
    par: Parameters,
    lins: list[Linearisation],
    given: Conditions,
    progress: Callable[[float], None] | None = None,
) -> np.ndarray:
    """Information matrix of the log-parameters at every linearisation; (Q, p, p), order of ``to_log``.

    Of one full set of n experiments with all their realizations and steady periods.

    Raises:
        DataError: where a noise level is not above zero.
    """
    if not (np.all(given.q_std > 0) and np.all(given.tau_std > 0)):
        raise DataError("q_std, tau_std", structure.robot.name, "a level of zero", "noise above zero")
    out = np.empty((len(lins), *2 * (len(par.to_log()),)))
    step = max(1, CHUNK // len(given.frequency))
    for start in range(0, len(lins), step):
        out[start : start + step] = _chunk(structure, par, lins[start : start + step], given)
        if progress is not None:
            progress(min(1.0, (start + step) / len(lins)))
    return out


def _chunk(structure: Structure, par: Parameters, lins: list[Linearisation], given: Conditions) -> np.ndarray:
    n, F, Q = structure.n, len(given.frequency), len(lins)
    omega = 2 * np.pi * given.frequency
    s = np.tile(1j * omega, Q)
    M, Kg = (np.repeat(np.stack([getattr(lin, name) for lin in lins]), F, axis=0) for name in ("M", "Kg"))
    Z, A_inv, C = impedance(structure, par, Linearisation(np.empty(0), M, Kg, np.empty(0)), s)
    # Springs and dampers share their directions, and so do inertia and friction of a motor.
    deflection, hinge = spring_deflections(structure, par, A_inv, C)
    rows = np.concatenate([deflection, np.broadcast_to(np.eye(n), Z.shape), hinge], axis=1)
    moved = np.stack([par.inertia + np.diag(lin.M)[structure.driven] for lin in lins]).repeat(F, axis=0)
    w = 2 * np.pi * LOOP_HZ
    k = np.arange(n)
    closed = Z.copy()
    closed[:, k, k] += moved * (w**2 + 2 * LOOP_DAMPING * w * s[:, None])
    root = np.tile(0.5 * np.sqrt(n) * given.amplitude, (Q, 1))
    motion = rows @ (np.linalg.inv(closed) * root[:, None, :])
    Sigma = (Z * given.q_std**2) @ np.conj(np.swapaxes(Z, 1, 2))
    Sigma[:, k, k] += given.tau_std**2
    torque = np.conj(rows) @ (np.linalg.inv(Sigma) * given.samples) @ np.swapaxes(rows, 1, 2)
    X = torque * (np.conj(motion) @ np.swapaxes(motion, 1, 2))
    # Powers of s: conj(s)^i s^j = (-j)^i j^j omega^(i + j), summed over lines.
    power, direction, size = _terms(structure, par)
    T = (omega ** np.arange(5)[:, None]) @ np.ascontiguousarray(X).view(float).reshape(Q, F, -1)
    T = T.view(complex).reshape(Q, 5, *X.shape[1:])
    phase = (-1j) ** power[:, None] * 1j**power
    T = T[:, power[:, None] + power, direction[:, None], direction] * phase
    return 2.0 * np.outer(size, size) * T.real


def _terms(structure: Structure, par: Parameters) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Power of s, direction among the columns, and size of each derivative of Z, order of ``to_log``."""
    n, e = structure.n, len(structure.elastic)
    gear, motor, hinge = np.arange(n), n + np.arange(n), 2 * n + np.arange(e)
    power = np.repeat([0, 1, 2, 1, 0, 1], [n, n, n, n, e, e])
    return power, np.concatenate([gear, gear, motor, motor, hinge, hinge]), np.exp(par.to_log())
