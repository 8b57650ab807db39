"""Models fitted again to a part of the records, and what they leave of the rest: whether what was found foretells it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from ident.chain import build_structure
from ident.gain import Errors, ratio_interval, segment_errors
from ident.group import Group
from ident.model import Model
from ident.parallel import Workers
from ident.problem import NOT_COMPUTED, Problem, predictions, residual
from ident.rigid import cut, fit_rigid
from ident.torque_fit import Fit, fit

PARTS = 8  # of motions, left out in turn
AGAIN = 4  # iterations of a fit to records of which a part is left out
CARRIES = 0.9  # level of the interval by which a cause must lower what is left of these parts
SEED = 0


def refitted(
    problem: Problem, groups: Sequence[Group], start: Fit, renewed: bool, remainders: Sequence[np.ndarray]
) -> Model:
    """The model of a fit on other records.

    Args:
        renewed: whether the inertias of the links are found from these too.
        remainders: of these records, from which the fit starts.
    """
    model, problem = start.model, replace(problem, groups=tuple(groups))
    if renewed:
        links = fit_rigid(build_structure(problem.structure.robot), problem.nominal, groups)
        model, problem = replace(model, structure=links.structure), replace(problem, nominal=links.par)
    return fit(problem, model, iterations=AGAIN, remainders=list(remainders)).model


def joined(errors: Sequence[Errors]) -> Errors:
    """Errors one below the other."""
    names = tuple(name for e in errors for name in e.segments)
    by_torque = tuple(name for e in errors for name in e.told_by_torque)
    pairs = [(e, e.seen_along()) for e in errors]
    before, after, noise, *along = (
        np.concatenate(rows)
        for rows in zip(*((e.before, e.after, e.noise, x.after, x.noise) for e, x in pairs), strict=True)
    )
    return Errors(names, before, after, noise, told_by_torque=by_torque, along=(along[0], along[1]))


def errors_on_parts(problem: Problem, one: Fit, other: Fit, workers: Workers, renewed: bool = False) -> Errors:
    """Errors of two models on ``PARTS`` of the motions, each fitted again without the part.

    Args:
        one, other: before and after.
        renewed: whether the inertias of the links of ``other`` are found again too.

    Raises:
        NOT_COMPUTED: where there is no such fit.
    """

    def without(part: int) -> Errors:
        kept, out = ([cut(group, part, PARTS, inside) for group in problem.groups] for inside in (False, True))
        models = [
            refitted(problem, kept, start, renewed and start is other, start.remainders) for start in (one, other)
        ]
        return segment_errors(problem, out, *models)[0]

    return joined(workers.map(without, range(PARTS)))


def carries_over(problem: Problem, before: Fit, after: Fit, joint: int, workers: Workers) -> bool:
    """Whether a cause found in motions lowers what is left of parts of them that are left out of its fit.

    Where a model is far from the data what it leaves is no noise, and many a law follows it along the path that was
    driven; neighbouring samples share that, which no count of them tells.

    Args:
        before, after: without the cause and with it.
        joint: at which it explains most; it may also carry over at all joints together.
    """
    try:
        errors = errors_on_parts(problem, before, after, workers)
    except NOT_COMPUTED:
        return False
    own = replace(errors, along=None, **{f: getattr(errors, f)[:, [joint]] for f in ("before", "after", "noise")})
    return any(ratio_interval(e, np.random.default_rng(SEED), CARRIES)[1] < 1.0 for e in (own, errors))


def with_error_as_noise(problem: Problem, result: Fit, joint: int) -> Problem:
    """The problem of motions with what a model leaves at a joint taken for noise of its torque."""
    powers = [
        problem.samples(group) * np.mean(np.abs(residual(group, pred)[:, 1:, joint]) ** 2) / group.window_share
        for group, pred in zip(problem.groups, predictions(problem, result.model, result.remainders), strict=True)
    ]
    tau_std = problem.tau_std.copy()
    tau_std[joint] = np.hypot(tau_std[joint], np.sqrt(np.mean(powers)))
    return replace(problem, tau_std=tau_std)
