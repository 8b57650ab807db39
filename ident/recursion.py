"""Newton-Euler recursion along many points of a Pinocchio chain, in compiled code.

Pinocchio's own ``rnea`` over arrays keeps the interpreter's lock; this one lets other threads run,
and goes joint by joint over a block of points that stays in the cache. Same numbers (tests).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import pinocchio as pin
from numba import njit

BLOCK = 256  # points
FUSED = {"contract"}  # products with sums in one instruction


# parent, prismatic, rotation, origin, mass, lever, inertia and gravity of a chain, as compiled code takes them
ChainArrays = tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]


@dataclass(frozen=True)
class Chain:
    """An open chain of joints with one coordinate each, as arrays over N joints.

    Attributes:
        parent: (N,) index of the joint before, -1 for the base.
        prismatic: (N,) bool.
        axis: (N, 3) in the frame of the joint.
        rotation, origin: (N, 3, 3), (N, 3) m, frame of the joint at zero in that of its parent.
        mass: (N,) kg; lever: (N, 3) m; inertia: (N, 3, 3) kg m2 about the centre of mass.
        gravity: (3,) m/s2.
    """

    parent: np.ndarray
    prismatic: np.ndarray
    axis: np.ndarray
    rotation: np.ndarray
    origin: np.ndarray
    mass: np.ndarray
    lever: np.ndarray
    inertia: np.ndarray
    gravity: np.ndarray


def chain_of(model: pin.Model) -> Chain:
    """Arrays of a model whose joints are unaligned revolute or prismatic ones, in the order of ``q``."""
    joints = range(1, model.njoints)
    return Chain(
        parent=np.array([model.parents[i] - 1 for i in joints]),
        prismatic=np.array(["Prismatic" in model.joints[i].shortname() for i in joints]),
        axis=np.array([model.joints[i].extract().axis for i in joints], float).reshape(-1, 3),
        rotation=np.array([model.jointPlacements[i].rotation for i in joints]),
        origin=np.array([model.jointPlacements[i].translation for i in joints]),
        mass=np.array([model.inertias[i].mass for i in joints]),
        lever=np.array([model.inertias[i].lever for i in joints]),
        inertia=np.array([model.inertias[i].inertia for i in joints]),
        gravity=np.asarray(model.gravity.linear, float).copy(),
    )


def newton_euler(chain: Chain, q: np.ndarray, v: np.ndarray, a: np.ndarray) -> np.ndarray:
    """Joint torques (points, N), N m, along coordinates, velocities and accelerations of that shape.

    Source: Luh, Walker and Paul, J. Dyn. Syst. Meas. Control 102 (1980), in frames of the joints.
    """
    q, v, a = (np.ascontiguousarray(x) for x in (q, v, a))
    sine, cosine = sines(q)
    return recursion(*along_z(chain), q, sine, cosine, v, a)


def along_z(chain: Chain) -> ChainArrays:
    """The arguments of ``recursion`` but the motion: the chain in frames turned so that each joint is along its ``z``.

    To turn by a joint is a few products there.
    """
    z = np.array([_with_z(tuple(e)) for e in chain.axis.tolist()])
    before = np.where((chain.parent < 0)[:, None, None], np.eye(3), z[chain.parent])
    to_frame, from_parent = z.swapaxes(1, 2), before.swapaxes(1, 2)
    return (
        chain.parent,
        chain.prismatic,
        np.ascontiguousarray(from_parent @ chain.rotation @ z),
        np.einsum("iab,ib->ia", from_parent, chain.origin),
        chain.mass,
        np.einsum("iab,ib->ia", to_frame, chain.lever),
        np.ascontiguousarray(to_frame @ chain.inertia @ z),
        chain.gravity,
    )


@lru_cache(maxsize=1024)
def _with_z(axis: tuple[float, float, float]) -> np.ndarray:
    """(3, 3) a rotation whose third column is a unit vector; axes stay while all else is fitted."""
    other = np.eye(3)[np.argmin(np.abs(axis))]
    x = np.cross(other, axis)
    x /= np.linalg.norm(x)
    return np.stack([x, np.cross(axis, x), axis], axis=1)


@njit(cache=True, nogil=True, fastmath=FUSED)
def sines(angle):
    """Sine and cosine of a contiguous array of angles, rad, together: without branches, so that processors take several
    angles at once.

    To one unit in the last place of one where angles are below 100,000 turns. Polynomials between -pi/4 and pi/4 and the
    three parts of pi/2, of which the first two have 33 bits, of FreeBSD's ``k_sin.c``, ``k_cos.c`` and ``e_rem_pio2.c``
    (Sun Microsystems, 1993).
    """
    flat = angle.ravel()
    sine, cosine = np.empty(flat.size), np.empty(flat.size)
    for i in range(flat.size):
        quarters = np.rint(flat[i] * (2.0 / np.pi))
        x = flat[i] - quarters * 1.57079632673412561417e00
        x -= quarters * 6.07710050630396597660e-11
        x -= quarters * 2.02226624879595063154e-21
        z = x * x
        tail = -1.98412698298579493134e-04 + z * (
            2.75573137070700676789e-06 + z * (-2.50507602534068634195e-08 + z * 1.58969099521155010221e-10)
        )
        s = x + x * z * (-1.66666666666666324348e-01 + z * (8.33333333332248946124e-03 + z * tail))
        tail = 2.48015872894767294178e-05 + z * (
            -2.75573143513906633035e-07 + z * (2.08757232129817482790e-09 - z * 1.13596475577881948265e-11)
        )
        c = 1.0 - 0.5 * z + z * z * (4.16666666666666019037e-02 + z * (-1.38888888888741095749e-03 + z * tail))
        turned = quarters - 4.0 * np.floor(0.25 * quarters)
        odd = (turned == 1.0) | (turned == 3.0)
        a, b = (c, s) if odd else (s, c)
        sine[i] = -a if turned >= 2.0 else a
        cosine[i] = -b if (turned == 1.0) | (turned == 2.0) else b
    return sine.reshape(angle.shape), cosine.reshape(angle.shape)


@njit(cache=True, nogil=True, inline="always", fastmath=FUSED)
def _cross(a, b):
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


@njit(cache=True, nogil=True, inline="always", fastmath=FUSED)
def _add(a, b):
    return a[0] + b[0], a[1] + b[1], a[2] + b[2]


@njit(cache=True, nogil=True, inline="always", fastmath=FUSED)
def _scaled(a, k):
    return a[0] * k, a[1] * k, a[2] * k


@njit(cache=True, nogil=True, inline="always", fastmath=FUSED)
def _times(M, x):
    return (
        M[0, 0] * x[0] + M[0, 1] * x[1] + M[0, 2] * x[2],
        M[1, 0] * x[0] + M[1, 1] * x[1] + M[1, 2] * x[2],
        M[2, 0] * x[0] + M[2, 1] * x[1] + M[2, 2] * x[2],
    )


@njit(cache=True, nogil=True, inline="always", fastmath=FUSED)
def _times_transposed(M, x):
    return (
        M[0, 0] * x[0] + M[1, 0] * x[1] + M[2, 0] * x[2],
        M[0, 1] * x[0] + M[1, 1] * x[1] + M[2, 1] * x[2],
        M[0, 2] * x[0] + M[1, 2] * x[1] + M[2, 2] * x[2],
    )


@njit(cache=True, nogil=True, inline="always", fastmath=FUSED)
def _turned(x, sine, cosine):
    """``x`` turned about ``z`` by an angle of that sine and cosine."""
    return cosine * x[0] - sine * x[1], sine * x[0] + cosine * x[1], x[2]


@njit(cache=True, nogil=True, fastmath=FUSED)
def recursion(parent, prismatic, rotation, origin, mass, lever, inertia, gravity, q, sine, cosine, v, a):
    """``newton_euler`` for compiled callers; the chain as ``along_z`` gives it."""
    T, N = q.shape
    out = np.empty((T, N))
    w = np.empty((N, 3, BLOCK))
    dw = np.empty((N, 3, BLOCK))
    acc = np.empty((N, 3, BLOCK))
    force = np.empty((N, 3, BLOCK))
    moment = np.empty((N, 3, BLOCK))
    for begin in range(0, T, BLOCK):
        B = min(BLOCK, T - begin)
        for i in range(N):
            p, slides = parent[i], prismatic[i]
            c = (lever[i, 0], lever[i, 1], lever[i, 2])
            z = (rotation[i, 0, 2], rotation[i, 1, 2], rotation[i, 2, 2])
            for b in range(B):
                t = begin + b
                if p < 0:
                    w_p, dw_p = (0.0, 0.0, 0.0), (0.0, 0.0, 0.0)
                    acc_p = (-gravity[0], -gravity[1], -gravity[2])
                else:
                    w_p = (w[p, 0, b], w[p, 1, b], w[p, 2, b])
                    dw_p = (dw[p, 0, b], dw[p, 1, b], dw[p, 2, b])
                    acc_p = (acc[p, 0, b], acc[p, 1, b], acc[p, 2, b])
                at = (origin[i, 0], origin[i, 1], origin[i, 2])
                if slides:
                    at = _add(at, _scaled(z, q[t, i]))
                there = _add(_add(acc_p, _cross(dw_p, at)), _cross(w_p, _cross(w_p, at)))
                w_i = _times_transposed(rotation[i], w_p)
                dw_i = _times_transposed(rotation[i], dw_p)
                acc_i = _times_transposed(rotation[i], there)
                if slides:
                    acc_i = (acc_i[0] + 2.0 * v[t, i] * w_i[1], acc_i[1] - 2.0 * v[t, i] * w_i[0], acc_i[2] + a[t, i])
                else:
                    w_i = _turned(w_i, -sine[t, i], cosine[t, i])
                    dw_i = _turned(dw_i, -sine[t, i], cosine[t, i])
                    acc_i = _turned(acc_i, -sine[t, i], cosine[t, i])
                    dw_i = (dw_i[0] + v[t, i] * w_i[1], dw_i[1] - v[t, i] * w_i[0], dw_i[2] + a[t, i])
                    w_i = (w_i[0], w_i[1], w_i[2] + v[t, i])
                f = _scaled(_add(_add(acc_i, _cross(dw_i, c)), _cross(w_i, _cross(w_i, c))), mass[i])
                m = _add(_times(inertia[i], dw_i), _cross(w_i, _times(inertia[i], w_i)))
                m = _add(m, _cross(c, f))
                for k in range(3):
                    w[i, k, b] = w_i[k]
                    dw[i, k, b] = dw_i[k]
                    acc[i, k, b] = acc_i[k]
                    force[i, k, b] = f[k]
                    moment[i, k, b] = m[k]
        for i in range(N - 1, -1, -1):
            p, slides = parent[i], prismatic[i]
            z = (rotation[i, 0, 2], rotation[i, 1, 2], rotation[i, 2, 2])
            for b in range(B):
                t = begin + b
                f = (force[i, 0, b], force[i, 1, b], force[i, 2, b])
                m = (moment[i, 0, b], moment[i, 1, b], moment[i, 2, b])
                out[t, i] = f[2] if slides else m[2]
                if p < 0:
                    continue
                at = (origin[i, 0], origin[i, 1], origin[i, 2])
                if slides:
                    at = _add(at, _scaled(z, q[t, i]))
                else:
                    f = _turned(f, sine[t, i], cosine[t, i])
                    m = _turned(m, sine[t, i], cosine[t, i])
                f = _times(rotation[i], f)
                m = _add(_times(rotation[i], m), _cross(at, f))
                for k in range(3):
                    force[p, k, b] += f[k]
                    moment[p, k, b] += m[k]
    return out
