"""Fits of candidates: from where screening put them, to the end, in other weights, and from the other side of what is
seen."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from ident.baseline import DETECTION_EXCESS, FAINT, implausible
from ident.costs import fair_costs
from ident.hypotheses import Hypothesis
from ident.hypotheses.friction import SMOOTHING, other_turn
from ident.model import Effect, Model, is_along_record, is_dry
from ident.problem import NOT_COMPUTED, Problem, Weights, predictions
from ident.screening import Score
from ident.torque_fit import Fit, fit
from ident.weights import make_weights, with_model_error

FINALISTS = 3  # candidates that are fitted to the end
FIRST_STEPS = 4  # steps after which candidates are compared for the first time
RECORD_EXCESS = 1.6  # chi2 per degree of freedom up to which a model along the record leaves no more than noise
REVIVED = 0.1  # of the nominal value, to which collapsed dampers are set before a fit
DECISIVE = 30.0  # difference of the costs of two candidates of which one leaves noise alone, that settles it
POLISH_STEPS = 40  # of the winner of a round


def revived(problem: Problem, model: Model) -> Model:
    """A model whose collapsed dampers and viscous friction are back at a size that a fit can move, and hinges free to
    turn on.

    What a missing cause has driven towards nothing has no slope left in logarithmic coordinates; a hinge that has
    turned far from the axis from which it was sought is sought from a nearer one.
    """
    par, least = model.par, problem.nominal
    return replace(
        model,
        effects=tuple(turned(e) for e in model.effects),
        par=replace(
            par,
            damping=np.maximum(par.damping, REVIVED * least.damping),
            viscous=np.maximum(par.viscous, REVIVED * least.viscous),
            elastic_damping=np.maximum(par.elastic_damping, REVIVED * least.elastic_damping),
        ),
    )


def turned(effect: Effect) -> Effect:
    """A hinge sought from the axis that is nearest to its own; any other effect as it is."""
    found = effect.hypothesis.options.get("nearer", lambda p: None)(effect.p)
    return effect if found is None else Effect(*found)


def polish(problem: Problem, result: Fit) -> Fit:
    """The winner fitted to the end, under the noise that it sees itself."""
    found = _to_the_end(problem, result)
    anew = with_drives_anew(problem, found)
    if anew is found:
        return found
    try:
        other = _to_the_end(problem, anew)
        return other if other.cost < reweighted(problem, found, other.weights).cost else found
    except NOT_COMPUTED:
        return found


def _to_the_end(problem: Problem, result: Fit) -> Fit:
    return fit(
        problem,
        revived(problem, result.model),
        iterations=POLISH_STEPS,
        remainders=result.remainders,
        exact=True,
    )


def beside_its_error(problem: Problem, result: Fit) -> Fit:
    """A model of motions fitted as is best beside the error that it leaves, where that is far above the noise.

    What it leaves by joint is told in units of the noise as before, and standard deviations are those beside the error.
    """
    if not problem.motions_alone or result.chi2_per_dof <= FAINT:
        return result
    preds = predictions(problem, result.model, result.remainders)
    weights = with_model_error(problem, preds, result.weights)
    try:
        other = fit(problem, result.model, iterations=POLISH_STEPS, weights=weights, remainders=result.remainders)
        same = reweighted(problem, other, result.weights)
    except NOT_COMPUTED:
        return result
    return replace(same, information=other.information * same.chi2_per_dof / max(1.0, other.chi2_per_dof))


def reweighted(problem: Problem, result: Fit, weights: Weights) -> Fit:
    """A fit as it stands, its cost under other weights."""
    preds = predictions(problem, result.model, result.remainders)
    return replace(result, costs=fair_costs(problem, preds, weights), weights=weights)


def left_by(found: Sequence[tuple[Hypothesis, Fit]], joints: np.ndarray | slice = slice(None)) -> float:
    """Excess of the cost over noise that the best candidate leaves, at some ``joints`` or all; infinite where there is
    none."""
    return min((float(np.sum((r.costs - r.counts)[joints])) for _, r in found), default=np.inf)


def refit(
    problem: Problem,
    model: Model,
    weights: Weights | None,
    remainders: Sequence[np.ndarray | None],
    iterations: int = 10,
    most: float = np.inf,
    aim: float = np.inf,
) -> Fit | None:
    """A candidate fitted from where screening put it; under the noise that it sees at the start where ``weights`` are
    None.

    One that creeps short of the cost ``aim`` is left there.
    None where its model cannot be computed, costs more than ``most`` at the start, or ends where the data feel no
    change of its last effect, if it has any.
    """
    try:
        with np.errstate(over="ignore", invalid="ignore"):  # on the way to a model that cannot be computed
            result = fit(
                problem,
                revived(problem, model),
                iterations=iterations,
                weights=weights,
                remainders=remainders,
                most=most,
                aim=aim,
            )
    except NOT_COMPUTED:
        return None
    if not result.model.effects:
        return result
    felt = np.diag(result.information)[-len(result.model.effects[-1].p) :]
    return result if np.any(felt > 0.0) else None


def with_drives_anew(problem: Problem, result: Fit) -> Fit:
    """A fit that leaves far more than noise with drives that cannot be those of this arm, made again from the drives that
    the problem begins with and their starting guesses, with its effects as they are, where that leaves less; any other
    as it is.

    Without a cause that is strong, least squares turn drives to where a fit with it does not find back from.
    """
    if result.chi2_per_dof <= FAINT or not implausible(problem, result):
        return result
    cold = [None] * len(problem.groups)
    begun = [problem.nominal] if problem.start is None else [problem.nominal, problem.start]
    again = [refit(problem, replace(result.model, par=par), result.weights, cold) for par in begun]
    return min((result, *(r for r in again if r is not None)), key=lambda r: r.cost)


def to_compete(best: float, count: int) -> float:
    """Cost up to which a candidate competes with the best one, of cost ``best`` over ``count`` data: the ``aim`` of its
    fit."""
    return best + max(DECISIVE, best - count)


def either_turn(problem: Problem, result: Fit, effect: Effect, iterations: int = 10) -> Fit:
    """A fit with one of its effects, a dry friction that turns at once, as one that turns within a velocity that is
    seen, or the other
    way round, where that costs less; no step of a fit leads from one to the other. As it is where the effect is another
    one."""
    h = effect.hypothesis
    if not is_dry(effect):
        return result
    at = [q.name for q in h.parameters].index(SMOOTHING.name)
    turn = other_turn(problem.groups, h.joint, effect.p[at])
    if turn is None:
        return result
    p = np.where(np.arange(len(effect.p)) == at, turn, effect.p)
    effects = tuple(Effect(h, clip_to_bounds(h, p)) if e.hypothesis.key == h.key else e for e in result.model.effects)
    other = refit(problem, replace(result.model, effects=effects), result.weights, result.remainders, iterations)
    return other if other is not None and other.cost < result.cost else result


def settled(current: Fit) -> bool:
    """Whether a model leaves no more than noise, as far as that is known: along the record, by a few draws.

    There the noise of one joint is taken large for all of them, so that each must leave no more.
    """
    if any(is_along_record(e.hypothesis) for e in current.model.effects):
        return bool(np.all(current.costs <= RECORD_EXCESS * current.counts))
    return current.chi2_per_dof <= DETECTION_EXCESS


def unsettled_at(current: Fit, joint: int) -> bool:
    """Whether a model leaves more than noise at a joint, by what it leaves at most joints where that is less than the
    noise that is assumed."""
    noise = min(1.0, float(np.median(current.costs / current.counts)))
    return bool(current.costs[joint] > DETECTION_EXCESS * noise * current.counts[joint])


def under_own_noise(problem: Problem, result: Fit) -> Fit | None:
    """A fit as it stands, its cost under the noise that its own model sees; None where drives gone astray make that
    infinite."""
    try:
        with np.errstate(over="ignore", invalid="ignore"):
            preds = predictions(problem, result.model, result.remainders)
            return reweighted(problem, result, make_weights(problem, preds, 0.0))
    except NOT_COMPUTED:
        return None


def extended_by(effects: Sequence[Effect], score: Score) -> tuple[Effect, ...]:
    """Effects with the hypothesis of a score, which takes the place of a special case of its own."""
    h = score.hypothesis
    special = [e for e in effects if e.hypothesis.key == (h.options.get("absorbs"), h.place)]
    start = score.start
    if special:
        start = h.options["absorb"](start, score.weights, special[0].p)
    assert start is not None  # else it is no candidate
    kept = tuple(e for e in effects if not special or e.hypothesis.key != special[0].hypothesis.key)
    return (*kept, Effect(h, clip_to_bounds(h, start)))


def clip_to_bounds(h: Hypothesis, start: np.ndarray) -> np.ndarray:
    """The start of a refit within the bounds of the parameters."""
    return np.array([np.clip(v, q.lower, q.upper) for v, q in zip(start, h.parameters, strict=True)])
