"""What the record of the torque loses towards high frequencies, at all joints alike.

Where nothing says how the torque was held and sampled, as of a loop that is faster than the record, a recorder may
average samples, or hold them: ``recorded = actual exp(j w timing) (1 - roll_off w^2)``. An effect of the catalogue has
one joint; a recorder has all of them.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from ident.baseline import DETECTION_EXCESS, renewed
from ident.derivatives import jacobians
from ident.extended import Prediction
from ident.group import Group
from ident.problem import Problem, predictions
from ident.torque_fit import RIDGE, Fit, inverse, left_beside

LEAST_JOINTS = 2  # that must tell it, and agree: of one it may as well be a lag of its drive
SURE = 5.0  # standard deviations from nothing
ALIKE = 4.0  # the same of a joint from what all share
SLACK = 0.25  # of the roll-off, by which a joint may differ beside that: its model is not exact
LARGEST = 0.1  # sample times squared
TELLING = 0.25  # share of what a joint leaves beyond noise, that what all joints share must explain
BY_CHANCE = 4.0  # fall of a cost by a number more, up to which noise brings it
STEPS = 2  # from where a fit ends to where it ends with them


def with_roll_off(problem: Problem, result: Fit) -> tuple[Problem, Fit]:
    """A problem and its fit with the roll-off that most joints share; as they are where that explains little of what
    most of them leave."""
    first, start = result, problem
    for _ in range(STEPS):
        more = shared_roll_off(problem, result)
        if not more:
            break
        sampling = problem.sampling
        problem = replace(problem, sampling=replace(sampling, roll_off=sampling.roll_off + more))
        result = renewed(problem, result)
    return (problem, result) if told_by_most(first, result) else (start, first)


def told_by_most(before: Fit, after: Fit) -> bool:
    """Whether what a fit has beyond another explains enough of what that leaves, at most joints."""
    left = before.costs - DETECTION_EXCESS * before.counts  # a little more may be noise that is known too small
    explained = before.costs - after.costs > np.maximum(TELLING * left, BY_CHANCE)
    return 2 * int(np.sum(explained)) > len(explained)


def shared_roll_off(problem: Problem, result: Fit) -> float:
    """Roll-off, s2, that a fit leaves in the records of the torque of most joints; 0 where there is none, or where it
    cannot be told.

    A linear step: each joint with a roll-off of its own, beside the coordinates of the fit. Most joints must agree.
    """
    n = problem.structure.n
    if problem.sampling.hold != "none" or problem.motions_alone or n < LEAST_JOINTS:
        return 0.0
    own, variance = of_each_joint(problem, result, lambda _, pred: pred.plane.s[:, None] ** 2 * pred.U)
    std = np.sqrt(max(result.chi2_per_dof, 1.0) * variance)
    return agreed(own, std, LARGEST * problem.sampling.sample_time**2)


def of_each_joint(
    problem: Problem, result: Fit, signal: Callable[[Group, Prediction], np.ndarray]
) -> tuple[np.ndarray, np.ndarray]:
    """How much of a signal a fit leaves in the torque of each joint, by a linear step beside its coordinates, and the
    variance of that by noise; (n,) each.

    Args:
        signal: of a group and what is predicted for it, (S, L, n) N m per unit.
    """
    n = problem.structure.n
    preds = predictions(problem, result.model, result.remainders)
    made, lost = jacobians(problem, result.model, preds, exact=False), []
    for columns, pred, group in zip(made, preds, problem.groups, strict=True):
        S, top, outputs, _ = columns.whole.shape
        each = np.zeros((S, top, outputs, n), complex)
        each[..., range(n), range(n)] = signal(group, pred)[:, :top]
        lost.append(each)
    curvature, slope = left_beside(problem, result, preds, made, lost)
    covariance = inverse(curvature, RIDGE)
    return covariance @ slope, np.diag(covariance)


def agreed(values: np.ndarray, std: np.ndarray, limit: float) -> float:
    """The value that most of some (n,) agree on within their standard deviations; 0 where that is nothing, or beyond a
    limit, or where they differ."""
    order = np.argsort(values)
    weight = np.cumsum(std[order] ** -2.0)
    middle = float(values[order][np.searchsorted(weight, 0.5 * weight[-1])])
    near = np.abs(values - middle) < ALIKE * std + SLACK * abs(middle)
    told = near & (std < abs(middle) / SURE)
    most = 2 * np.sum(near) > len(values) and np.sum(told) >= LEAST_JOINTS
    return middle if most and abs(middle) < limit else 0.0
