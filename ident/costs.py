"""Costs by joint, what noise adds to them, and costs as they would be with equal noise."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ident.errors_in_variables import scatter_costs
from ident.extended import Prediction
from ident.group import Group
from ident.model import Model, joints_along_record
from ident.output_noise import noise_of_laws, noise_of_samples
from ident.parallel import map_threads
from ident.problem import Problem, Weights, by_joint, output_error, record_count
from ident.stiction import as_held, held_share


def weighted_cost(problem: Problem, preds: Sequence[Prediction], weights: Weights) -> float:
    """Whitened sum of squares of the errors of all outputs."""
    return float(np.sum(joint_costs(problem, preds, weights)))


def joint_costs(problem: Problem, preds: Sequence[Prediction], weights: Weights) -> np.ndarray:
    """The same by joint, its link encoder included; (n,)."""
    each = [
        np.sum(np.abs(weights.apply(g, output_error(group, pred))) ** 2, axis=(0, 1))
        for g, (group, pred) in enumerate(zip(problem.groups, preds, strict=True))
    ]
    return by_joint(problem, each)


def noise_costs(problem: Problem, noise: Weights, weights: Weights) -> np.ndarray:
    """Costs by joint that the noise which some weights stand for is expected to have under others; (n,).

    Under themselves that is ``data_counts``.
    """
    each = []
    for group, covariance, whiten in zip(problem.groups, noise.covariance, weights.whiten, strict=True):
        spread = np.matmul(whiten, np.linalg.cholesky(covariance))
        each.append(record_count(group) * np.sum(np.abs(spread) ** 2, axis=(0, 2)))
    return by_joint(problem, each)


def has_scatter(problem: Problem, model: Model) -> bool:
    """Whether the scatter between periods tells what noise adds to the normal equations; along the record it does
    not."""
    return all(g.scatter is not None and not joints_along_record(model, g) for g in problem.groups)


def by_noise(
    problem: Problem, preds: Sequence[Prediction], weights: Weights, still: Sequence[np.ndarray | None] | None = None
) -> np.ndarray:
    """(n,) what noise adds to ``joint_costs`` (``errors_in_variables``).

    Args:
        still: of ``held_share``, of each group; of motors that nothing holds where None.
    """
    each = zip(problem.groups, preds, weights.whiten, still or [None] * len(preds), strict=True)
    return sum((scatter_costs(*of) for of in each), np.zeros(problem.structure.n))


def noise_of(problem: Problem, preds: Sequence[Prediction], weights: Weights, laws: Sequence[np.ndarray]) -> np.ndarray:
    """(n,) what noise adds to ``joint_costs``, by what is linear (``by_noise``) and by laws that are not.

    Args:
        laws: of ``noise_of_laws``, of each group.
    """
    each = []
    for group, of_laws, whiten in zip(problem.groups, laws, weights.whiten, strict=True):
        more = of_laws[: len(whiten)]
        each.append(record_count(group) * np.einsum("kij,kjl,kil->i", whiten, more, whiten.conj(), optimize=True).real)
    still = [held_share(*of) for of in zip(preds, problem.groups, strict=True)]
    return by_noise(problem, preds, weights, still) + by_joint(problem, each)


def fair_costs(problem: Problem, preds: Sequence[Prediction], weights: Weights) -> np.ndarray:
    """(n,) costs by joint as they would be with as much noise as the model of the weights passes on.

    A model that passes on less of the noise of the position, as one that is damped at its resonances does, costs less
    however wrong it is: that is no merit, and is made up for.
    """
    costs = joint_costs(problem, preds, weights)
    if not problem.scatter_share or weights.by_noise is None or not has_scatter(problem, preds[0].model):
        return costs + absorbed(problem, preds, weights)
    laws = [noise_of_laws(pred, group) for group, pred in zip(problem.groups, preds, strict=True)]
    more = noise_of(problem, preds, weights, laws) - weights.by_noise
    return np.maximum(costs - problem.scatter_share * more, 0.0)


def absorbed(problem: Problem, preds: Sequence[Prediction], weights: Weights) -> np.ndarray:
    """(n,) what noise would add to the costs at motors that dry friction holds, which takes it: no merit of the
    friction."""

    def of_group(of: tuple[Group, Prediction, np.ndarray]) -> np.ndarray:
        group, pred, whiten = of
        share, n = held_share(pred, group), problem.structure.n
        if share is None:
            return np.zeros(whiten.shape[1])
        S = noise_of_samples(problem, group, pred)
        W = whiten[:, :, :n]
        return record_count(group) * np.einsum("kij,kjl,kil->i", W, S - as_held(S, share), W.conj(), optimize=True).real

    return by_joint(problem, map_threads(of_group, zip(problem.groups, preds, weights.whiten, strict=True)))
