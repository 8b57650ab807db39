"""Models fitted again to a part of the records, and what they leave of the rest: whether what was found foretells it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from ident.chain import build_structure
from ident.extended import Prediction
from ident.gain import Errors, mean_squares, ratio_interval, segment_errors
from ident.group import Group
from ident.model import Model
from ident.output_noise import output_covariance
from ident.parallel import Workers
from ident.problem import NOT_COMPUTED, Problem, output_error, predictions
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
    return joined([errors for errors, _ in _on_parts(problem, one, other, workers, renewed)])


def _on_parts(
    problem: Problem, one: Fit, other: Fit, workers: Workers, renewed: bool
) -> list[tuple[Errors, Errors | None]]:
    """``errors_on_parts`` of each part, and those of link encoders where these are compared."""

    def without(part: int) -> tuple[Errors, Errors | None]:
        kept, out = ([cut(group, part, PARTS, inside) for group in problem.groups] for inside in (False, True))
        models = [
            refitted(problem, kept, start, renewed and start is other, start.remainders) for start in (one, other)
        ]
        errors, pairs = segment_errors(problem, out, *models)
        return errors, link_errors(problem, pairs)

    return workers.map(without, range(PARTS))


def link_errors(problem: Problem, pairs: Sequence[tuple[Prediction, Prediction]]) -> Errors | None:
    """Mean squared errors of the link encoders that are compared, rad2, (rows, joints that have one), by two models;
    None where none is.

    Args:
        pairs: predictions of the same group before and after.
    """
    n, rows = problem.structure.n, []
    for before, after in pairs:
        group = before.group
        if not group.links:
            return None
        squares = [np.abs(output_error(group, x)[..., n:]) ** 2 for x in (before, after)]
        variance = np.einsum("kii->ki", output_covariance(problem, group, after)).real[:, n:]
        noise = np.broadcast_to(variance, squares[0].shape)
        rows.append([mean_squares(x) for x in (*(s / group.window_share for s in squares), noise)])
    if not rows:
        return None
    names = tuple(name for before, _ in pairs for name in before.group.segments)
    return Errors(names, *(np.concatenate(x) for x in zip(*rows, strict=True)))


def carries_over(problem: Problem, before: Fit, after: Fit, joint: int, workers: Workers) -> bool:
    """Whether a cause found in motions lowers what is left of parts of them that are left out of its fit.

    Where a model is far from the data what it leaves is no noise, and many a law follows it along the path that was
    driven; neighbouring samples share that, which no count of them tells.

    Args:
        before, after: without the cause and with it.
        joint: at which it explains most; it may also carry over at all joints together, or to the link encoder of that
            joint, which shows errors of a gear or an encoder that its torque hardly does.
    """
    try:
        parts = _on_parts(problem, before, after, workers, renewed=False)
    except NOT_COMPUTED:
        return False
    torque = joined([errors for errors, _ in parts])
    told = [_at(torque, joint), torque]
    of_links = [links for _, links in parts if links is not None]
    if of_links and joint in problem.groups[0].links:
        told.append(_at(joined(of_links), problem.groups[0].links.index(joint)))
    return any(ratio_interval(e, np.random.default_rng(SEED), CARRIES)[1] < 1.0 for e in told)


def _at(errors: Errors, joint: int) -> Errors:
    """Errors of one joint alone."""
    return replace(errors, along=None, **{f: getattr(errors, f)[:, [joint]] for f in ("before", "after", "noise")})


def with_error_as_noise(problem: Problem, result: Fit, joint: int) -> Problem:
    """The problem of motions with what a model leaves at a joint taken for noise of its torque and its link encoder."""
    preds = predictions(problem, result.model, result.remainders)

    def louder(std: np.ndarray, column: int) -> np.ndarray:
        powers = [
            problem.samples(group) * np.mean(np.abs(output_error(group, pred)[:, 1:, column]) ** 2) / group.window_share
            for group, pred in zip(problem.groups, preds, strict=True)
        ]
        out = std.copy()
        out[joint] = np.hypot(out[joint], np.sqrt(np.mean(powers)))
        return out

    links, told = problem.groups[0].links, problem.groups[0].link_std
    other = replace(problem, tau_std=louder(problem.tau_std, joint))
    if told is None or joint not in links:
        return other
    std = louder(told, problem.structure.n + links.index(joint))
    return replace(other, groups=tuple(replace(g, link_std=std) for g in problem.groups))
