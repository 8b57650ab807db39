"""Records less what the arm swings by itself from period to period.

A link that is hardly damped goes on swinging for many periods, of a transient or of noise in the loop. What a period
ends elsewhere than it began stands in its spectrum beside the steady state: over a whole period ``x''`` has the lines
``s^2 X`` and, of the ends, ``(dv + s dx) / T`` (Pintelon and Schoukens 2012, ch. 6). At a resonance that is far above
the noise, alternates from period to period, and so looks like noise that is many times what is left in their mean.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ident.baseline import DETECTION_EXCESS, FAINT
from ident.extended import Prediction
from ident.group import Group
from ident.noise import drifting, white_covariance
from ident.problem import Problem, predictions
from ident.torque_fit import Fit


def without_swings(problem: Problem, result: Fit) -> Problem:
    """The problem with periodic records less what the ends of their periods leave in the residual of a fit.

    Of each period what the ends can do is taken off as far as it explains the residual: two real numbers for each
    coordinate of the links and each motor, of the many that are compared.
    """
    preds = predictions(problem, result.model, result.remainders)
    groups = tuple(
        _steadied(problem, g, p) if g.window is None else g for g, p in zip(problem.groups, preds, strict=True)
    )
    return replace(problem, groups=groups)


def swings(problem: Problem, result: Fit) -> bool:
    """Whether records are to be taken without what swings: where periods drift, or where a single one ends elsewhere
    than it began and more than noise is left, of which not too much.

    What is missing in a model that is far from the data would be taken off with what swings, as far as a few numbers
    can do it.
    """
    if result.chi2_per_dof > FAINT:
        return False
    creeps = result.chi2_per_dof > DETECTION_EXCESS and any(g.creeps for g in problem.groups)
    return creeps or bool(np.any(drifting(problem.groups)))


def by_ends(pred: Prediction, lines: np.ndarray) -> np.ndarray:
    """(K, n, 2 N + 2 n) recorded torque by what links and motors differ by between the ends of a period, per unit."""
    plane, n = pred.plane, pred.structure.n
    motors = np.broadcast_to(np.eye(n), (len(lines), n, n))
    reached = np.concatenate([plane.link_gain[lines], motors], axis=2)
    both = np.concatenate([reached, plane.s[lines, None, None] * reached], axis=2)
    return (plane.record[lines, None] * pred.filters[0][lines])[:, :, None] * both


def _steadied(problem: Problem, group: Group, pred: Prediction) -> Group:
    lines, samples = np.arange(1, group.n_compared), problem.samples(group)
    Z = pred.sampled_impedance
    model = pred.U[:, None] + np.einsum("lij,splj->spli", Z, group.Q_periods - group.Q[:, None], optimize=True)
    error = (group.U_periods - model)[:, :, lines]
    root = np.linalg.cholesky(white_covariance(Z[lines], problem.tau_std**2 / samples, problem.q_std**2 / samples))
    basis = by_ends(pred, lines)
    whitened = np.linalg.solve(root, basis).reshape(-1, basis.shape[-1])
    seen = np.linalg.solve(root[None, None], error[..., None]).reshape(error.shape[0] * error.shape[1], -1)
    size = np.linalg.norm(whitened, axis=0)
    A, b = (np.concatenate([x.real, x.imag]) for x in (whitened / size, seen.T))
    ends = np.linalg.lstsq(A, b, rcond=None)[0] / size[:, None]
    swung = np.einsum("kim,mr->rki", basis, ends).reshape(error.shape)
    U_periods = group.U_periods.copy()
    U_periods[:, :, lines] -= swung
    return replace(group, U_periods=U_periods, U=U_periods.mean(axis=1))
