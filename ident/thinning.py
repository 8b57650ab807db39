"""A few records that stand for all of them, where candidates are only looked for.

Far above the noise a third of the records tells as well as all which candidates are worth a fit.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ident.costs import fair_costs
from ident.problem import Problem, data_counts, predictions
from ident.torque_fit import Fit
from ident.weights import make_weights

ENOUGH = 8  # records
EVERY = 3  # of those of a group, at most, which is kept
LEAST_MOTION = 0.5  # share of its motion over that of the records, which every joint must keep


def thinned(problem: Problem) -> Problem:
    """The problem with every second or third record of each group, or as it is where that leaves few or a joint
    rests.

    Of neighbouring groups other records are kept: where each joint is excited alone all of them move.
    """
    step = min(EVERY, sum(len(g.segments) for g in problem.groups) // ENOUGH)
    if step < 2 or problem.motions_alone:
        return problem
    rows = [
        np.arange(g % step % len(group.segments), len(group.segments), step) for g, group in enumerate(problem.groups)
    ]
    few = replace(problem, groups=tuple(group.pick(r) for group, r in zip(problem.groups, rows, strict=True)))
    kept, of = (sum(np.sum(np.abs(g.Q[:, 1:]) ** 2, axis=(0, 1)) for g in x.groups) for x in (few, problem))
    share = sum(map(len, rows)) / sum(len(g.segments) for g in problem.groups)
    return few if np.all(kept >= LEAST_MOTION * share * of) else problem


def on_few(few: Problem, result: Fit, rho: float) -> Fit:
    """A fit as it stands on the records of a ``thinned`` problem, with a relative error ``rho`` added to the noise."""
    preds = predictions(few, result.model, [None] * len(few.groups), steps=None)
    weights = make_weights(few, preds, rho)
    remainders = tuple(p.solution.W for p in preds)
    costs = fair_costs(few, preds, weights)
    return replace(result, costs=costs, counts=data_counts(few), remainders=remainders, weights=weights, softer=())
