"""Inertial parameters of the links from motions: inverse dynamics, linear in them.

For motions whose description of the links is in doubt. Along the recorded motion, slow against every
resonance, the motor torque is (Atkeson, An and Hollerbach, Int. J. Robotics Research 5, 1986)

    u = T^T Y(q, q', q'') pi + J q_m'' + f q_m' + F sign(q_m') + o

Differentiation is exact in the compared band, without phase error; both sides are seen through the same
band and window. Joints are weighted by what is left at them, found iteratively. Each link keeps a mass
density that is nowhere negative: its pseudo-inertia is ``L A A^T L^T`` with ``L`` that of the description
and ``A`` triangular with a positive diagonal (Rucker and Wensing, IEEE RA-L 7, 2022), and a weak prior on
``A`` leaves what the motions do not show as it was described.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import pinocchio as pin
import scipy.linalg

from ident.chain import Structure, build_structure
from ident.graybox import Parameters
from ident.group import Group
from ident.hypotheses.friction import direction
from ident.inverse import coarse_group
from ident.recursion import Chain, chain_of, newton_euler

COORDINATES = 10  # of the inertia of a body
PRIOR_STD = 0.5  # of each entry of A about the identity
PRIOR_LOG_STD = 1.5  # of motor inertia and viscous friction, natural logarithm
REWEIGHTINGS = 4  # of the joints
STEPS = 25  # of Levenberg-Marquardt under each
RANK = 1e-3  # singular value of the whitened regressor, over the largest, that counts as shown
LEAST_SHARE = 1e-6  # of the size of a pseudo-inertia, added where a described body has none
PARTS = 4  # of a motion, left out in turn to see how inertias carry over
CROSSING = 0.3  # s, over which such a part fades at its cuts
SLOW = 0.002  # of the rms velocity, over which friction turns


@dataclass(frozen=True)
class RigidFit:
    """Rigid arm with friction, fitted to motions.

    Attributes:
        structure: the chain with the inertias found.
        par: starting parameters with the motor inertia and viscous friction found.
        std: (bodies, 10) of the inertial parameters, in the order of ``pin.Inertia.toDynamicParameters``.
        bodies: joints of the description that carry the bodies.
        rank: combinations that the motions show, of the 10 parameters of each body, motor inertias and viscous
            frictions.
        left: (n,) rms torque that is left in the band, N m.
    """

    structure: Structure
    par: Parameters
    std: np.ndarray
    bodies: tuple[str, ...]
    rank: int
    left: np.ndarray


def fit_rigid(structure: Structure, nominal: Parameters, groups: Sequence[Group]) -> RigidFit:
    """Inertias of all links, motor inertia and friction from motions.

    Args:
        structure: the chain as described, without loads or changes of links; elastic hinges are held at rest.
        nominal: starting guesses of the drives.
        groups: motions.
    """
    bodies = {n: i for n, i in structure.carriers.items() if structure.model.inertias[i].mass > 0}
    names, indices = tuple(bodies), list(bodies.values())
    described = np.array([structure.model.inertias[i].toDynamicParameters() for i in indices])
    roots = np.array([_root(p) for p in described])
    parts = [_rows(structure, nominal.coupling, group, indices) for group in groups]
    y, Y, a, v, friction = (np.concatenate([p[k] for p in parts], axis=0) for k in range(5))
    n, B = structure.n, len(indices)
    x = np.concatenate([np.zeros(COORDINATES * B), np.log(nominal.inertia), np.log(nominal.viscous)])
    center = x.copy()
    prior = np.concatenate([np.full(COORDINATES * B, PRIOR_STD**-2), np.full(2 * n, PRIOR_LOG_STD**-2)])
    scale = np.sqrt(np.mean(y**2, axis=0))
    for _ in range(REWEIGHTINGS):
        problem = _Weighted.build(y, Y, a, v, friction, np.maximum(scale, 1e-9))
        x, H = _minimise(problem, roots, x, center, prior)
        scale = np.sqrt(np.mean(problem.left(_model(roots, x, n)) ** 2, axis=0)) * scale
    power = sum(group.period_time * group.window_share for group in groups)
    rms = scale * np.sqrt(len(y) / power)
    pi, dpi = _inertias(roots, x[: COORDINATES * B])
    covariance = np.linalg.inv(H + np.diag(prior))
    std = np.sqrt(
        np.array(
            [
                np.einsum("ij,jk,ik->i", dpi[b], covariance[s, s], dpi[b])
                for b, s in enumerate(slice(COORDINATES * b, COORDINATES * (b + 1)) for b in range(B))
            ]
        )
    )
    changed = build_structure(
        structure.robot,
        elasticities=structure.hinges,
        inertias={name: pin.Inertia.FromDynamicParameters(p) for name, p in zip(names, pi, strict=True)},
    )
    par = replace(nominal, inertia=np.exp(x[COORDINATES * B :][:n]), viscous=np.exp(x[COORDINATES * B + n :]))
    return RigidFit(changed, par, std, names, problem.rank(), rms)


def carried_over(structure: Structure, nominal: Parameters, groups: Sequence[Group]) -> float:
    """What inertias found leave of parts of the motions that were left out, over what those described leave there.

    ``PARTS`` of every motion are left out in turn; of the squares of the torque at each joint a geometric mean over the
    joints. Above 1 the motions are too short or too poor for so many parameters, however well these fit. Motor inertia,
    friction and offset are fitted under both.

    Args:
        structure, nominal, groups: as of ``fit_rigid``.
    """
    indices = [i for i in structure.carriers.values() if structure.model.inertias[i].mass > 0]

    def rows(part: Sequence[Group]) -> list[np.ndarray]:
        each = [_rows(structure, nominal.coupling, group, indices) for group in part]
        return [np.concatenate(x) for x in zip(*each, strict=True)]

    left = np.zeros((2, structure.n))
    for part in range(PARTS):
        kept, out = ([cut(group, part, PARTS, inside) for group in groups] for inside in (False, True))
        found = fit_rigid(structure, nominal, kept).structure.model
        given, other = rows(kept), rows(out)
        left += [_left_with(model, indices, given, other) for model in (found, structure.model)]
    return float(np.exp(np.mean(np.log(left[0] / np.maximum(left[1], 1e-300)))))


def cut(group: Group, part: int, parts: int, inside: bool) -> Group:
    """A motion seen through its window in one of so many parts of time, or outside of it; both fade at the cuts."""
    assert group.window is not None  # of a motion
    time = np.arange(group.n_time) * group.period_time / group.n_time
    length = time[np.flatnonzero(group.window).max()] / parts
    # No cut where the record itself begins or ends.
    begins, ends = part * length if part else -np.inf, (part + 1) * length if part < parts - 1 else np.inf
    depth = np.minimum(time - begins, ends - time)
    fade = np.clip((depth if inside else -depth) / CROSSING, 0.0, 1.0)
    return replace(group, window=group.window * np.sin(0.5 * np.pi * fade) ** 2)


def _left_with(
    model: pin.Model, indices: Sequence[int], given: Sequence[np.ndarray], other: Sequence[np.ndarray]
) -> np.ndarray:
    """(n,) squares left of ``other`` by bodies of a model with drives fitted to ``given``, both as of ``_rows``."""
    bodies = np.concatenate([model.inertias[i].toDynamicParameters() for i in indices])

    def at(rows: Sequence[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
        y, Y, a, v, friction = rows
        return y - Y @ bodies, np.concatenate([a[..., None], v[..., None], friction], axis=-1)

    (y, X), (y_other, X_other) = at(given), at(other)
    drives = np.stack([np.linalg.lstsq(X[:, j], y[:, j], rcond=None)[0] for j in range(y.shape[1])])
    return np.sum((y_other - np.einsum("rjc,jc->rj", X_other, drives)) ** 2, axis=0)


def _rows(structure: Structure, coupling: np.ndarray, group: Group, indices: Sequence[int]) -> tuple[np.ndarray, ...]:
    """What a motion tells: its torque and the columns of that, through the same window and band, R real rows.

    Returns:
        y (R, n); Y (R, n, 10 B); motor acceleration and velocity (R, n); friction (R, n, 2): sign and one.
    """
    group = group.slow()
    coarse = coarse_group(group)
    s = 1j * group.omega[:, None]
    kinds = [coarse.to_time(s**k * group.Q[0]) for k in range(3)]
    links = [np.zeros((len(x), structure.n_coordinates)) for x in kinds]
    for link, x in zip(links, kinds, strict=True):
        link[:, structure.driven] = x @ coupling.T
    q, qd, qdd = links
    torques = regressor(chain_of(structure.model), q, qd, qdd, [i - 1 for i in indices])[:, structure.driven]
    v = group.to_time(s * group.Q[0])
    sign = np.stack([direction(x[None], SLOW * float(np.std(x)) + 1e-12)[0] for x in v.T], axis=-1)
    lines = {
        "y": group.U[0],
        "Y": coarse.to_lines(np.einsum("tip,ij->tjp", torques, coupling).reshape(len(torques), -1)),
        "a": s**2 * group.Q[0],
        "v": s * group.Q[0],
        "sign": group.to_lines(sign),
    }
    assert group.window is not None  # of a motion
    window = np.interp(np.arange(coarse.n_time) / coarse.n_time, np.arange(group.n_time) / group.n_time, group.window)
    coarse = replace(coarse, window=window)

    def seen(X: np.ndarray) -> np.ndarray:
        """Lines as rows of real numbers whose squares sum to the energy of the signal."""
        X = np.sqrt(group.period_time) * coarse.observe(X)  # lines of a long motion hold less noise
        X[1:] *= np.sqrt(2.0)
        return np.concatenate([X.real, X.imag[1:]])

    y, Y, a, v, sign = (seen(X) for X in lines.values())
    one = np.zeros_like(lines["y"])
    one[0] = 1.0
    return y, Y.reshape(len(y), structure.n, -1), a, v, np.stack([sign, seen(one)], axis=-1)


def regressor(chain: Chain, q: np.ndarray, v: np.ndarray, a: np.ndarray, bodies: Sequence[int]) -> np.ndarray:
    """Joint torques per inertial parameter; (T, N, 10 B).

    Inverse dynamics is linear in the ten parameters of a body (mass, first moment, inertia about the joint's
    frame): ten bodies whose parameters are independent give all of it.
    """
    probes = [(1.0, np.zeros(3), np.zeros((3, 3)))]
    probes += [(1.0, e, np.zeros((3, 3))) for e in np.eye(3)]
    for i, j in ((0, 0), (0, 1), (1, 1), (0, 2), (1, 2), (2, 2)):
        shape = np.zeros((3, 3))
        shape[i, j] = shape[j, i] = 1.0
        probes.append((0.0, np.zeros(3), shape))
    of_probe = np.array([pin.Inertia(*probe).toDynamicParameters() for probe in probes])
    none = replace(chain, mass=0 * chain.mass, lever=0 * chain.lever, inertia=0 * chain.inertia)
    out = []
    for body in bodies:
        columns = []
        for mass, lever, inertia in probes:
            alone = replace(none, mass=none.mass.copy(), lever=none.lever.copy(), inertia=none.inertia.copy())
            alone.mass[body], alone.lever[body], alone.inertia[body] = mass, lever, inertia
            columns.append(newton_euler(alone, q, v, a))
        out.append(np.stack(columns, axis=-1) @ np.linalg.inv(of_probe).T)
    return np.concatenate(out, axis=-1)


def _pseudo(p: np.ndarray) -> np.ndarray:
    """(4, 4) pseudo-inertia of ten parameters: second moments of the mass, first moments, mass."""
    I = p[[4, 5, 7, 5, 6, 8, 7, 8, 9]].reshape(3, 3)
    P = np.empty((4, 4))
    P[:3, :3] = 0.5 * np.trace(I) * np.eye(3) - I
    P[:3, 3] = P[3, :3] = p[1:4]
    P[3, 3] = p[0]
    return P


def _from_pseudo(P: np.ndarray) -> np.ndarray:
    """Ten parameters of pseudo-inertias (..., 4, 4); (..., 10)."""
    S = P[..., :3, :3]
    I = np.trace(S, axis1=-2, axis2=-1)[..., None, None] * np.eye(3) - S
    about = I[..., [0, 0, 1, 0, 1, 2], [0, 1, 1, 2, 2, 2]]
    return np.concatenate([P[..., 3:, 3], P[..., :3, 3], about], axis=-1)


def _root(p: np.ndarray) -> np.ndarray:
    """Cholesky factor of the pseudo-inertia of a described body, made positive where it is not."""
    P = _pseudo(p)
    values, vectors = np.linalg.eigh(P)
    return np.linalg.cholesky((vectors * np.maximum(values, LEAST_SHARE * np.trace(P))) @ vectors.T)


def _inertias(roots: np.ndarray, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Inertial parameters (B, 10) at coordinates (10 B,), and their derivatives (B, 10, 10)."""
    x = x.reshape(-1, COORDINATES)
    B = len(x)
    A = np.zeros((B, 4, 4))
    k, (i, j) = np.arange(4), np.tril_indices(4, -1)
    A[:, k, k] = np.exp(x[:, :4])
    A[:, i, j] = x[:, 4:]
    M = roots @ A
    slopes = np.zeros((B, COORDINATES, 4, 4))
    slopes[:, k, k, k] = A[:, k, k]
    slopes[:, 4 + np.arange(6), i, j] = 1.0
    change = roots[:, None] @ slopes @ np.swapaxes(M, 1, 2)[:, None]
    change = change + np.swapaxes(change, -1, -2)
    return _from_pseudo(M @ np.swapaxes(M, 1, 2)), np.swapaxes(_from_pseudo(change), 1, 2)


def _model(roots: np.ndarray, x: np.ndarray, n: int) -> tuple[np.ndarray, np.ndarray]:
    """Parameters (10 B + 2 n,) in which the torque is linear, and their derivatives by ``x``."""
    m = x.shape[0] - 2 * n
    pi, dpi = _inertias(roots, x[:m])
    drives = np.exp(x[m:])
    return np.concatenate([pi.ravel(), drives]), scipy.linalg.block_diag(*dpi, np.diag(drives))


@dataclass(frozen=True)
class _Weighted:
    """Normal equations of the torque in the parameters that it is linear in; friction is eliminated.

    ``|y - X p|^2 = |y|^2 - 2 p^T z + p^T gram p`` with ``gram`` (m, m) and ``z`` (m,). ``y``, ``X`` are as weighted.
    """

    z: np.ndarray
    y: np.ndarray
    X: np.ndarray
    gram: np.ndarray

    @classmethod
    def build(cls, y, Y, a, v, friction, scale) -> _Weighted:
        n = y.shape[1]
        eye = np.eye(n)
        X = np.concatenate([Y, a[:, :, None] * eye, v[:, :, None] * eye], axis=-1) / scale[:, None]
        y = y / scale
        f = friction / scale[:, None]
        # Sign and one of a joint act on that joint alone.
        Q = np.stack([np.linalg.qr(f[:, j])[0] for j in range(n)], axis=1)
        X = X - np.einsum("tjc,ujc,ujp->tjp", Q, Q, X, optimize=True)
        y = y - np.einsum("tjc,ujc,uj->tj", Q, Q, y, optimize=True)
        flat = X.reshape(-1, X.shape[-1])
        gram = flat.T @ flat
        return cls(flat.T @ y.ravel(), y, X, gram)

    def left(self, model: tuple[np.ndarray, np.ndarray]) -> np.ndarray:
        """(R, n) weighted residual at a model."""
        return self.y - self.X @ model[0]

    def rank(self) -> int:
        """Parameters, or combinations of them, that the motions show: rank of the scaled regressor."""
        size = np.sqrt(np.maximum(np.diag(self.gram), 1e-300))
        values = np.linalg.eigvalsh(self.gram / np.outer(size, size))
        return int(np.sum(values > RANK**2 * values[-1]))


def _minimise(
    problem: _Weighted, roots: np.ndarray, x: np.ndarray, center: np.ndarray, prior: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Levenberg-Marquardt on ``|y - X p(x)|^2`` with a prior on ``x``; the minimum and its normal matrix."""
    n = problem.y.shape[1]
    power = float(np.sum(problem.y**2))

    def cost(x: np.ndarray) -> float:
        p = _model(roots, x, n)[0]
        fit = power - 2 * p @ problem.z + p @ problem.gram @ p
        return float(fit + np.sum(prior * (x - center) ** 2))

    now, damping = cost(x), 1e-3
    for _ in range(STEPS):
        p, dp = _model(roots, x, n)
        H = dp.T @ problem.gram @ dp
        b = dp.T @ (problem.z - problem.gram @ p) - prior * (x - center)
        for _ in range(8):
            step = np.linalg.solve(H + np.diag(prior) + damping * np.diag(np.diag(H) + prior), b)
            new = cost(x + np.clip(step, -1.0, 1.0))
            if new < now:
                break
            damping = 8 * max(damping, 1e-4)
        else:
            break
        x, gain, now = x + np.clip(step, -1.0, 1.0), now - new, new
        damping = max(damping / 10, 1e-9)
        if gain < 1e-6 * now:
            break
    dp = _model(roots, x, n)[1]
    return x, dp.T @ problem.gram @ dp
