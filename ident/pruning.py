"""What a model does not need: effects of which nothing is left, laws without what sets them apart, frictions that stood
for a later cause."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import partial

import numpy as np

from ident.evidence import ABSENT, WAVE, is_wave, pointless
from ident.group import Group
from ident.hypotheses import Hypothesis
from ident.model import Effect, Model, joints_along_record
from ident.parallel import Workers
from ident.problem import Problem, predictions
from ident.refits import POLISH_STEPS, beside_its_error, clip_to_bounds, polish, refit, reweighted
from ident.rounds import MIN_EVIDENCE, Round
from ident.torque_fit import Fit

UNTOLD = 1.0  # standard deviation of a logarithm, from which the data say nothing of a parameter
# velocity over that at which a motor may as well rest, up to which friction may stand for what holds it then
NEXT_TO_REST = 2.0
LED = 0.3  # of the velocity by which the turn of a friction leads, within which its size is not known
SAMPLED = 0.2  # the same of what the velocity changes by from sample to sample
# of what a friction explains of motions, that errors of its law where it turns leave
TURNS_LEAVE = 1e-3


def pruned(problem: Problem, current: Fit) -> Fit:
    """The model without effects of which nothing is left.

    One that stood for a part of a cause as long as that had no name is not needed beside it; and one that won only
    since the drives found a better place in its company says nothing: that place is the baseline's then.
    """
    std = dict(zip(current.names, np.sqrt(np.maximum(np.diag(current.covariance()), 0.0)), strict=True))

    def nothing(effect: Effect) -> bool:
        if pointless(effect, current.model.par.stiffness[effect.hypothesis.joint]):
            return True
        h = effect.hypothesis
        own = [(q, v, std[h.coordinate(q.name)]) for q, v in zip(h.parameters, effect.p, strict=True) if not q.nuisance]
        off = [abs(q.to_internal(v) - q.to_internal(q.null)) / s for q, v, s in own if q.null is not None]
        # The wave number of a wave that is not there may look sure.
        wave = is_wave(h.parameters)
        sizes = [
            s > (UNTOLD if q.log else 0.5 * abs(v))
            for q, v, s in own
            if q.null is None and (not wave or q.name in WAVE)
        ]
        return all(sizes) if sizes else all(x < ABSENT for x in off)

    effects, par, lines = current.model.effects, current.model.par, gears_of_one_slope(problem, current)
    needed = tuple(
        e for e in effects if e.hypothesis.key not in lines and (e.hypothesis.options.get("baseline") or not nothing(e))
    )
    if len(needed) == len(effects):
        return current
    stiffness = par.stiffness.copy()
    for j, slope in lines.values():
        stiffness[j] = slope
    model = replace(current.model, par=replace(par, stiffness=stiffness), effects=needed)
    other = polish(problem, replace(current, model=model))
    same = reweighted(problem, current, other.weights)
    return other if other.cost - same.cost < MIN_EVIDENCE * max(1.0, same.cost / same.count) else current


def without_effect(problem: Problem, current: Fit, key: tuple[str, str]) -> Fit:
    """The model without an effect, by its key, fitted to the end."""
    kept = tuple(e for e in current.model.effects if e.hypothesis.key != key)
    return beside_its_error(problem, polish(problem, replace(current, model=replace(current.model, effects=kept))))


def gears_of_one_slope(problem: Problem, current: Fit) -> dict[tuple[str, str], tuple[int, float]]:
    """Keys of laws of gears with a middle that no record leaves, and joint and slope there, N m/rad: a spring like any
    other, of which the drives had missed the stiffness."""
    softer = [e for e in current.model.effects if "middle" in e.hypothesis.options]
    preds = predictions(problem, current.model, current.remainders) if softer else []
    out = {}
    for e in softer:
        half, slope = e.hypothesis.options["middle"](e.p)
        if all(np.abs(pred.motion().delta(e.hypothesis.joint)).max() < half for pred in preds):
            out[e.hypothesis.key] = e.hypothesis.joint, slope
    return out


def without_shadows(problem: Problem, current: Fit, rounds: Sequence[Round], workers: Workers) -> Fit:
    """The model without companions of a friction that the data do not need beside a cause that was found after them.

    They competed with no other hypothesis, and made up for that cause as long as it was missing.
    """
    alone = {
        r.candidates[0].hypothesis.key for r in rounds if len(r.candidates) == 1 and r.before is not rounds[-1].before
    }
    doubted = [e.hypothesis for e in current.model.effects if e.hypothesis.key in alone]
    if not doubted or workers.late:
        return current

    def without(gone: Sequence[Hypothesis]) -> Model:
        keys = {h.key for h in gone}
        return replace(current.model, effects=tuple(e for e in current.model.effects if e.hypothesis.key not in keys))

    def rise(gone: Sequence[Hypothesis]) -> float:
        other = refit(problem, without(gone), current.weights, current.remainders, POLISH_STEPS)
        return np.inf if other is None else other.cost - current.cost

    def least(h: Hypothesis) -> float:
        """By what is left at its own joint: what is left at another, far above a smaller noise, says nothing of it."""
        left = current.chi2_per_dof if h.on_chain else current.costs[h.joint] / current.counts[h.joint]
        return MIN_EVIDENCE * max(1.0, left)

    rises = workers.map_in_time(lambda h: rise([h]), doubted, lambda h: f"without: {h.effect} at {h.place}")
    gone = [h for h, x in zip(doubted, rises, strict=True) if x is not None and x < least(h)]
    if not gone or (len(gone) > 1 and rise(gone) >= sum(map(least, gone))):
        return current
    return polish(problem, replace(current, model=without(gone)))


def renamed(rounds: Sequence[Round], before: Sequence[Effect], after: Sequence[Effect]) -> list[Round]:
    """Rounds whose winners have been replaced by their special cases, effect by effect."""
    new = {
        a.hypothesis.key: b.hypothesis for a, b in zip(before, after, strict=True) if a.hypothesis is not b.hypothesis
    }

    def of(found: Round) -> Round:
        first, *others = found.candidates
        h = new.get(first.hypothesis.key, first.hypothesis)
        return replace(found, candidates=(replace(first, hypothesis=h), *others))

    return [of(r) for r in rounds]


def plainer(
    problem: Problem,
    result: Fit,
    hypotheses: Sequence[Hypothesis],
    kept: set[tuple[str, str]],
    rounds: Sequence[Round] = (),
) -> Fit:
    """The model with the special case in place of effects of which the data do not show what sets them apart from it.

    Args:
        kept: keys of effects that stay as they are.
        rounds: that have named them. Of motions what a friction does where it turns is known to ``TURNS_LEAVE`` of what
            it explains.
    """
    known = {h.key: h for h in hypotheses}
    turns = {
        r.candidates[0].hypothesis.key: TURNS_LEAVE * r.fall
        for r in rounds
        if problem.motions_alone and "exceeds" in r.candidates[0].hypothesis.options
    }
    special_by_itself = partial(plainly_special, problem, result.model)

    def plain(effect: Effect) -> Effect:
        h = effect.hypothesis
        special = known.get((h.options.get("absorbs", ""), h.place))
        if h.key in kept or special is None or "apart" not in h.options:
            return effect
        hidden = h.options.get("give", lambda p: np.inf)(effect.p) < problem.q_std[h.joint]
        if not untold(result, effect) and not hidden and not special_by_itself(effect):
            return effect
        return Effect(special, clip_to_bounds(special, h.options["special"](effect.p)))

    effects = tuple(plain(e) for e in result.model.effects)
    swapped = sum(a is not b for a, b in zip(effects, result.model.effects, strict=True))
    if not swapped:
        return result
    other = polish(problem, replace(result, model=replace(result.model, effects=effects)))
    same = reweighted(problem, result, other.weights)
    scale = max(1.0, same.cost / same.count)
    allowed = swapped * MIN_EVIDENCE * scale + sum(
        turns.get(a.hypothesis.key, 0.0) for a, b in zip(result.model.effects, effects, strict=True) if a is not b
    )
    # One that has reached what makes it its special case is that one, whatever errors of the law make of the rest.
    certain = all(a is b or special_by_itself(a) for a, b in zip(result.model.effects, effects, strict=True))
    return other if certain or other.cost - same.cost < allowed else result


def untold(result: Fit, effect: Effect) -> bool:
    """Whether the data say nothing of what sets an effect of a fit apart from the special case that it holds."""
    h = effect.hypothesis
    if "apart" not in h.options:
        return False
    covariance = result.covariance()
    at = result.names.index(h.coordinate(h.options["apart"]))
    return bool(covariance[at, at] >= UNTOLD**2) or level(result, effect, covariance)


def level(result: Fit, effect: Effect, covariance: np.ndarray) -> bool:
    """Whether a parameter of an effect that must be larger than another one is so by chance alone."""
    h = effect.hypothesis
    if "exceeds" not in h.options:
        return False
    pair = [result.names.index(h.coordinate(name)) for name in h.options["exceeds"]]
    larger, smaller = (effect.value(name) for name in h.options["exceeds"])
    spread = covariance[np.ix_(pair, pair)]
    if spread[1, 1] > 1.0:  # one far below the other may be anything so small
        spread = np.diag([spread[0, 0], 1.0])
    off = np.array([larger, -smaller])
    return bool(larger - smaller < ABSENT * np.sqrt(off @ spread @ off))


def turns_within(problem: Problem, effect: Effect) -> list[float]:
    """Velocities, rad/s, within which the size of a friction is not known where it turns: shares of those by which its
    turn leads, or which pass between two samples, of the rms acceleration of each group."""
    names = [q.name for q in effect.hypothesis.parameters]
    lead, j = effect.value("lead") if "lead" in names else 0.0, effect.hypothesis.joint
    time = max(LED * lead, SAMPLED * problem.sampling.sample_time)
    shown = [g.omega[:, None] ** 2 * g.signal_share * g.Q for g in problem.groups]
    return [time * float(np.sqrt(2.0 * np.mean(np.sum(np.abs(A[..., j]) ** 2, axis=1)))) for A in shown]


def plainly_special(problem: Problem, model: Model, effect: Effect) -> bool:
    """Whether an effect is its special case by its parameters, beside laws along the record, or where it turns.

    Along the record nothing says what friction takes of the torque while a motor rests: what a friction has within
    velocities at which it may as well rest is an error of that. So is what it has within those by which its turn leads:
    a soft constraint that has a lead takes there what is asked of it; and within those that pass in a fraction of a
    sample.
    """
    h = effect.hypothesis
    if h.options.get("plain", lambda p: False)(effect.p):
        return True
    if "within" not in h.options:
        return False
    v = h.options["within"](effect.p)
    if all(v < x for x in turns_within(problem, effect)):
        return True

    def unseen(group: Group) -> bool:
        rests = group.rest is not None and bool(np.any(group.rest[..., h.joint]))
        return (
            rests
            and h.joint in joints_along_record(model, group)
            and v < NEXT_TO_REST * group.least_velocity[:, h.joint].mean()
        )

    return all(map(unseen, problem.groups))
