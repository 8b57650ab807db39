"""Covariance of the compared lines by noise alone: of the samples, of laws that are not linear, and of laws along the
record."""

from __future__ import annotations

import numpy as np

from ident.extended import Prediction
from ident.group import Group
from ident.law_noise import law_noise, loop_noise, record_noise
from ident.noise import residual_covariance, white_covariance
from ident.problem import Problem

LEAST_NOISE = 0.5  # of the noise of a linear arm, that is left in any direction of the residual
LEAK = 0.03  # of the largest share of that noise, that is in any direction too


def noise_covariance(
    problem: Problem, group: Group, prediction: Prediction, of_laws: np.ndarray | None = None
) -> np.ndarray:
    """Covariance of the compared lines of the torque residual by noise alone; (K, n, n) N2 m2.

    Args:
        of_laws: of ``noise_of_laws``, where it is known already.
    """
    S = noise_of_samples(problem, group, prediction)
    of_record = record_noise(prediction, group)
    if of_record is None:
        S = S + (noise_of_laws(prediction, group) if of_laws is None else of_laws)[: group.n_compared]
    else:
        S = _with_record(S, of_record[: group.n_compared])
    if group.rounding is not None:
        S += white_covariance(prediction.sampled_impedance[: group.n_compared], 0.0, group.rounding[:, None])
    return S


def noise_of_samples(problem: Problem, group: Group, prediction: Prediction) -> np.ndarray:
    """(K, n, n) of it, what noise of the torque and of the position are in the linear arm."""
    return residual_covariance(
        group,
        prediction.sampled_impedance,
        tau_std=problem.tau_std,
        q_std=problem.q_std,
        samples=problem.samples(group),
    )


def noise_of_laws(prediction: Prediction, group: Group) -> np.ndarray:
    """(L, n, n) covariance that laws which are not linear add to the noise, where none is along the record."""
    of_motors = law_noise(prediction, group)[:, :, None] * np.eye(prediction.U.shape[-1])
    of_loops = loop_noise(prediction, group)
    return of_motors if of_loops is None else of_motors + of_loops


def output_covariance(
    problem: Problem, group: Group, prediction: Prediction, of_laws: np.ndarray | None = None
) -> np.ndarray:
    """Covariance of all outputs: noise of a motor position is in the torque and in what a link encoder differs by; (K,
    n + M, n + M)."""
    S = noise_covariance(problem, group, prediction, of_laws)
    n, links, samples = S.shape[-1], list(group.links), problem.samples(group)
    if not links:
        return S
    position = problem.q_std**2 / samples
    if group.rounding is not None:
        position = position + group.rounding[:, None]
    assert group.link_std is not None  # link encoders are compared along motions
    recorded, true = prediction.filters
    per_position = prediction.about.output_per_position[: len(S)] * true[: len(S), None]
    per_position[:, :n] *= recorded[: len(S), :, None]
    of_links = np.concatenate([np.zeros(n), group.link_std[links] ** 2 / samples])
    all_of_it = white_covariance(per_position, of_links, position)
    all_of_it[:, :n, :n] = S
    return all_of_it


def _with_record(S: np.ndarray, more: np.ndarray) -> np.ndarray:
    """A covariance (K, n, n) and what answers to the record add to it, by draws.

    At least ``LEAST_NOISE`` of the former in any direction, and ``LEAK`` of the largest: draws know directions to so
    much.
    """
    root = np.linalg.cholesky(S)
    half = np.linalg.solve(root, more)
    relative = np.linalg.solve(root, np.conj(np.swapaxes(half, 1, 2)))
    values, vectors = np.linalg.eigh(0.5 * (relative + np.conj(np.swapaxes(relative, 1, 2))))
    values = np.maximum(1.0 + values, LEAST_NOISE)
    spread = root @ vectors
    return (spread * np.maximum(values, LEAK * values[:, -1:])[:, None, :]) @ np.conj(np.swapaxes(spread, 1, 2))
