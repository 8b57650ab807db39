"""Records that come from a simulation with a coarse time step, whose own error at all joints is not that of an arm.

Semi-implicit Euler, as MuJoCo's ``Euler`` and ``implicitfast`` are, has second differences for accelerations and shifted
ones for the velocities of dampers (``time_steps.TimeSteps``). With a step of 0.5 ms the noise of good sensors may be
below that. A step is a whole fraction of the sample time, and all joints have the same; a machine has none.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from typing import get_args

import numpy as np

from ident.baseline import DETECTION_EXCESS, renewed
from ident.derivatives import jacobians
from ident.extended import Prediction
from ident.inverse import plane_at, torque_record
from ident.problem import Problem, predictions
from ident.roll_off import told_by_most
from ident.time_steps import DAMPERS, TimeSteps
from ident.torque_fit import RIDGE, Fit, inverse, left_beside

FRACTIONS = (1, 2, 3, 4, 5, 6, 8, 10, 12, 16, 20)  # of the sample time, that a step may be
LEAST_JOINTS = 2  # that must show it: of one it may as well be something else
SURE = 5.0  # standard deviations from nothing
ALIKE = 4.0  # the same, of a joint from a step as it is sought
SETTLED = 1.25  # of the noise, that a joint is left with where nothing is missing there
SLACK = 0.5  # of the size, by which a joint may differ beside that: its model is not exact


def with_steps(problem: Problem, result: Fit) -> tuple[Problem, Fit]:
    """A problem and its fit with the time step that the records show; as they are where they show none, or where it
    leaves more than noise at most joints: that has other causes, which may look like one."""
    steps = shown_steps(problem, result)
    if steps is None:
        return problem, result
    stepped = in_steps(problem, steps)
    again = renewed(stepped, result)
    return (stepped, again) if told_by(result, again) else (problem, result)


def told_by(before: Fit, after: Fit) -> bool:
    """Whether a fit in time steps explains what one without leaves, at most joints, and leaves hardly more than noise
    there, and at most of those where that one leaves more; where it leaves more at none, there is nothing to explain."""
    settled, left = after.costs <= SETTLED * after.counts, before.costs > DETECTION_EXCESS * before.counts
    most = 2 * int(np.sum(settled)) > len(settled) and 2 * int(np.sum(settled & left)) > int(np.sum(left))
    return told_by_most(before, after) and most


def in_steps(problem: Problem, steps: TimeSteps) -> Problem:
    """The problem with records of a simulation in time steps."""
    return replace(problem, groups=tuple(replace(g, steps=steps) for g in problem.groups))


def shown_steps(problem: Problem, result: Fit) -> TimeSteps | None:
    """Time steps of which a fit leaves the error at most joints that can show it; None where there are none.

    A linear step from the fit, beside its coordinates: of the steps that there may be the one that explains most, and
    then at each joint by itself, where its size must come out as it is.
    """
    n = problem.structure.n
    if problem.motions_alone or n < LEAST_JOINTS or problem.steps is not None:
        return None
    preds = predictions(problem, result.model, result.remainders)
    made = jacobians(problem, result.model, preds, exact=False)
    beside = partial(left_beside, problem, result, preds, made)
    falls: dict[TimeSteps, float] = {}
    for kind in get_args(DAMPERS):
        steps = [TimeSteps(problem.sampling.sample_time / k, kind) for k in FRACTIONS]
        curvature, slope = beside([errors_of_steps(problem, g, pred, steps) for g, pred in enumerate(preds)])
        falls |= dict(zip(steps, 2.0 * slope - np.diag(curvature), strict=True))
    best = max(falls, key=lambda each: falls[each])
    whole = [errors_of_steps(problem, g, pred, [best]) for g, pred in enumerate(preds)]
    curvature, slope = beside([x * np.eye(x.shape[2])[:, :n] for x in whole])
    covariance = inverse(curvature, RIDGE)
    size = covariance @ slope
    std = np.sqrt(np.maximum(result.costs / result.counts, 1.0) * np.diag(covariance))
    told = std < 1.0 / SURE
    near = told & (np.abs(size - 1.0) < ALIKE * std + SLACK)
    return best if np.sum(near) >= LEAST_JOINTS and 2 * np.sum(near) > np.sum(told) else None


def errors_of_steps(problem: Problem, group: int, pred: Prediction, steps: Sequence[TimeSteps]) -> np.ndarray:
    """(S, K, n + M, len(steps)) what time steps change of the outputs of a group."""
    there, bare = problem.groups[group], pred.plane.output_per_position
    out = []
    for each in steps:
        stepped = replace(there, steps=each)
        record = torque_record(pred.par, stepped, problem.sampling)
        plane = plane_at(pred.structure, pred.par, pred.plane.lin, stepped, record)
        change = (plane.output_per_position - bare)[: there.n_compared]
        out.append(np.matmul(change, pred.solution.Q[:, : there.n_compared, :, None])[..., 0])
    return np.stack(out, axis=-1)
