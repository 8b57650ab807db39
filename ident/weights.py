"""Weights that whiten the compared lines under noise, and under a relative error of the model."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from ident.costs import has_scatter, noise_of
from ident.extended import Prediction
from ident.group import Group
from ident.output_noise import noise_of_laws, output_covariance
from ident.problem import Problem, Weights, output_error

LINK_ERROR = 0.01  # of the wind-up that link encoders show, up to which what a model leaves is an error of its law


def make_weights(problem: Problem, predictions: Sequence[Prediction], rho: float) -> Weights:
    """Weights at the current model; ``rho`` is a relative error added to the noise.

    Lines of a motion, seen through its window, count in units of the noise of a whole record: neighbours share theirs,
    and the sum of their squares is that of ``data_count`` independent numbers.
    """
    whiten, covariance = [], []
    known = has_scatter(problem, predictions[0].model)
    laws = (
        [noise_of_laws(pred, group) for group, pred in zip(problem.groups, predictions, strict=True)] if known else []
    )
    added: Sequence[np.ndarray | None] = laws if known else [None] * len(predictions)
    for group, pred, of_laws in zip(problem.groups, predictions, added, strict=True):
        S = output_covariance(problem, group, pred, of_laws)
        k = np.arange(S.shape[1])
        # Offsets that wander are slower than any line, and no scatter of neighbouring lines shows them: the static one is
        # given twice the deviation of white noise.
        S[0] *= 4.0
        links = k[problem.structure.n :]
        if rho > 0 or len(links):
            power = np.mean(np.abs(_signals(group, pred)[:, : group.n_compared]) ** 2, axis=0)
        if rho > 0:
            S[:, k, k] += rho**2 * power
            S[1:, k, k] += 1e-2 * rho**2 * power[1:].mean(axis=0)
        if len(links):
            left = np.mean(np.abs(output_error(group, pred)[:, 1:, links]) ** 2, axis=(0, 1)) - S[
                1:, links, links
            ].real.mean(axis=0)
            S[:, links, links] += np.clip(left, 0.0, LINK_ERROR**2 * power[1:, links].mean(axis=0))
        whiten.append(whitening(S))
        covariance.append(S)
    weights = Weights(tuple(whiten), tuple(covariance))
    return replace(weights, by_noise=noise_of(problem, predictions, weights, laws)) if known else weights


def with_model_error(problem: Problem, predictions: Sequence[Prediction], weights: Weights) -> Weights:
    """Weights under noise and the error of the model that is left beside it, of each output as much at all lines.

    Where that error is far above the noise the lines of least noise are no better known than others.
    """
    whiten, covariance = [], []
    for group, pred, S in zip(problem.groups, predictions, weights.covariance, strict=True):
        left = np.mean(np.abs(output_error(group, pred)[:, 1:]) ** 2, axis=(0, 1)) / group.window_share
        S = S + np.diag(np.maximum(left - np.einsum("kii->ki", S[1:]).real.mean(axis=0), 0.0))
        covariance.append(S)
        whiten.append(whitening(S))
    return Weights(tuple(whiten), tuple(covariance))


def whitening(S: np.ndarray) -> np.ndarray:
    """Whitening of complex lines of covariance (K, o, o), the first of which is real."""
    root = np.linalg.inv(np.linalg.cholesky(S)) * np.sqrt(2.0)
    root[0] /= np.sqrt(2.0)
    return root


def _signals(group: Group, prediction: Prediction) -> np.ndarray:
    """(S, L, n + M) what errors of a model are relative to: the torque, and the wind-up of the gears that link encoders
    show."""
    if not group.links:
        return group.U
    assert group.Q_link is not None  # of which links are compared
    windup = group.Q_link[..., list(group.links)] - group.Q @ prediction.par.coupling[list(group.links)].T
    windup[:, 0] = 0.0
    return np.concatenate([group.U, windup], axis=-1)
