"""Excitations that are held from sample to sample while a faster loop works between them.

What a controller adds acts as it is recorded, up to a delay that all torques share. What is asked of it from outside,
once a sample, acts later by up to as long as it is held: ``acting = recorded + (exp(-s lag) - 1) r``. An effect of the
catalogue has one joint; such a controller has all of them.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ident.baseline import renewed
from ident.group import Group
from ident.problem import Problem
from ident.roll_off import LEAST_JOINTS, STEPS, agreed, of_each_joint, told_by_most
from ident.torque_fit import Fit


def with_late_excitation(problem: Problem, result: Fit) -> tuple[Problem, Fit]:
    """A problem with the torque that acts, and its fit, where most joints share a lag of the excitation; as they are
    where that explains little of what most of them leave."""
    first, start = result, problem
    for _ in range(STEPS):
        more = shared_lag(problem, result)
        if not more:
            break
        sampling = replace(problem.sampling, late_excitation=problem.sampling.late_excitation + more)
        problem = replace(problem, sampling=sampling, groups=tuple(acting(g, more) for g in problem.groups))
        result = renewed(problem, result)
    return (problem, result) if told_by_most(first, result) else (start, first)


def acting(group: Group, lag: float) -> Group:
    """A group with the torque that acts where its excitation does so by ``lag``, s, later than it is recorded; as it is
    where it holds no excitation."""
    if group.R is None or not lag:
        return group
    late = np.exp(-1j * group.omega[:, None] * lag) * group.R
    change = late - group.R
    return replace(group, U=group.U + change, U_periods=group.U_periods + change[:, None], R=late)


def shared_lag(problem: Problem, result: Fit) -> float:
    """Lag of the excitation, s, that a fit leaves in the torque of most joints; 0 where there is none, or where it cannot
    be told.

    Each joint has a lag of its own in a linear step. Most must agree: an
    excitation that is no torque, as the reference of a position, has a gain of its own at each.
    """
    known = all(g.R is not None for g in problem.groups)
    if problem.sampling.hold != "none" or problem.structure.n < LEAST_JOINTS or not known:
        return 0.0
    own, variance = of_each_joint(problem, result, lambda group, pred: pred.plane.s[:, None] * group.R)
    std = np.sqrt(np.maximum(result.costs / result.counts, 1.0) * variance)
    return agreed(own, std, problem.sampling.sample_time)
