"""Names and their rivals, weighed by how they foretell held-out data.

What tells two causes apart may not be among the records that a model is fitted to: over the speeds of small motions
about a posture a friction that falls is one of constant size beside less viscous friction, and along a large motion it
is far from that.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import replace

import numpy as np

from ident.attribute import Attribution
from ident.contests import REMATCH
from ident.evidence import Candidate
from ident.gain import Errors, segment_errors
from ident.group import Group
from ident.model import Model
from ident.parallel import Workers
from ident.problem import NOT_COMPUTED, Problem
from ident.refits import FINALISTS, POLISH_STEPS, beside_its_error, polish, refit, to_compete
from ident.rounds import Round
from ident.torque_fit import Fit
from ident.values import named_effects

# Errors of a law repeat along a motion and in all records of a posture: each segment counts as so many independent
# numbers of unknown variance, and no more segments than that count.
NUMBERS, MOST_SEGMENTS = 4.0, 4
ALIKE = 0.1  # logarithm of the ratio of two mean squared errors of a segment, within which they say nothing
ABOVE = 2.0  # error, as power, of either model over the noise, from which a segment says anything
LEAST = 1e-300  # N2 m2
SURE = 50.0  # nats, at most
SPOKEN = 1.0  # nats by which held-out data must move the odds of a rival to be told


def weighed_on_held_out(
    problem: Problem, held_out: Sequence[Group], result: Attribution, workers: Workers
) -> tuple[Attribution, list[str]]:
    """A result whose names and rivals are weighed by held-out data too, and a line on each of which these have moved
    the odds.

    A rival that they prefer takes the place of the cause; a decoy takes probability from its name alone.
    """
    lines: list[str] = []
    if not held_out:
        return result, lines
    for i, found in enumerate(result.rounds):
        named = {e.hypothesis.key for e in named_effects(result.final)}
        rivals = rivals_of(found, {e.hypothesis.key for e in result.final.model.effects})
        if found.candidates[0].hypothesis.key not in named or not rivals or workers.late:
            continue
        final, weighed, more = _weighed(problem, held_out, result, found, rivals, workers)
        rounds = (*result.rounds[:i], weighed, *result.rounds[i + 1 :])
        result = replace(result, final=final, rounds=rounds)
        lines += more
    return result, lines


def rivals_of(found: Round, there: Collection[tuple[str, str]]) -> list[Candidate]:
    """Candidates that the data of the fit leave in the running, the likeliest first.

    No laws of the gear: motions hardly show them, and of what they leave most is how a simulation of them began.

    Args:
        there: causes of the model, by ``key``: none of them is another one's rival.
    """
    if found.candidates[0].hypothesis.gear_law:
        return []
    others = (c for c in found.candidates[1:] if c.probability > REMATCH and not c.hypothesis.gear_law)
    # One that was renamed since, or of which nothing was left, is not in its own fit.
    fitted = [
        c
        for c in others
        if c.hypothesis.key not in there and c.hypothesis.key in {e.hypothesis.key for e in c.fit.model.effects}
    ]
    return sorted(fitted, key=lambda c: -c.probability)[:FINALISTS]


def _weighed(
    problem: Problem,
    held_out: Sequence[Group],
    result: Attribution,
    found: Round,
    rivals: Sequence[Candidate],
    workers: Workers,
) -> tuple[Fit, Round, list[str]]:
    """The model with that candidate of a round which all data prefer, the round, and what is to be said about it."""
    final, own, first = result.final, found.candidates[0], result.baseline.model
    enough = to_compete(final.cost, final.count)

    def left_by(model: Model) -> Errors:
        return segment_errors(problem, held_out, first, model)[0].seen_along()

    def entered(c: Candidate) -> tuple[Fit, Errors] | None:
        """None of one that cannot be fitted in that place, or not as well as the data of the fit have told."""
        try:
            there = refit(problem, with_rival(final.model, own, c), final.weights, final.remainders, POLISH_STEPS)
            return None if there is None or there.cost > enough else (there, left_by(there.model))
        except NOT_COMPUTED:
            return None

    workers.say(f"held-out data: {own.hypothesis.effect} at {own.hypothesis.place} and its rivals")
    try:
        left = left_by(final.model)
    except NOT_COMPUTED:
        return final, found, []
    fits, nats = dict[int, Fit](), dict[int, float]()
    for rival, entry in zip(rivals, workers.map_in_time(entered, rivals), strict=True):
        if entry is not None and left.segments and entry[1].segments == left.segments:
            fits[id(rival)], nats[id(rival)] = entry[0], nats_for(entry[1], left, joints_of(own, rival))
    odds = {id(c): c.probability * float(np.exp(nats.get(id(c), 0.0))) for c in found.candidates}
    share = sum(c.probability for c in found.candidates) / sum(odds.values())
    new = {id(c): replace(c, probability=share * odds[id(c)]) for c in found.candidates}
    names = [own, *(c for c in rivals if id(c) in nats and not c.hypothesis.decoy)]
    best = max(names, key=lambda c: new[id(c)].probability)
    others = sorted((new[id(c)] for c in found.candidates if c is not best), key=lambda c: -c.probability)
    lines = [line(own, c, nats[id(c)]) for c in rivals if abs(nats.get(id(c), 0.0)) > SPOKEN]
    weighed = replace(found, candidates=(new[id(best)], *others))
    if best is own:
        return final, weighed, lines
    lines.append(
        "They have chosen between these, so that the gain which is measured on them is that of the better one."
    )
    return settled_in(problem, fits[id(best)]), weighed, lines


def settled_in(problem: Problem, rival: Fit) -> Fit:
    """The model with a rival that has won, fitted to the end; as it is where that fails."""
    try:
        return beside_its_error(problem, polish(problem, rival))
    except NOT_COMPUTED:
        return rival


def with_rival(model: Model, own: Candidate, rival: Candidate) -> Model:
    """The model with a rival in the place of a cause: the rival's own where all others are in it."""
    others = [e for e in model.effects if e.hypothesis.key != own.hypothesis.key]
    effect = next(e for e in rival.fit.model.effects if e.hypothesis.key == rival.hypothesis.key)
    beside = {e.hypothesis.key for e in rival.fit.model.effects} - {rival.hypothesis.key}
    if beside == {e.hypothesis.key for e in others}:
        return rival.fit.model
    return replace(model, effects=(*others, effect))


def joints_of(own: Candidate, rival: Candidate) -> tuple[int, ...] | None:
    """Joints at which two causes sit; None, all, where either changes the chain."""
    both = own.hypothesis, rival.hypothesis
    return None if any(h.on_chain for h in both) else tuple(sorted({h.joint for h in both}))


def nats_for(rival: Errors, own: Errors, joints: Sequence[int] | None = None) -> float:
    """Logarithm of the ratio of the likelihoods of two models, errors of each segment of a variance that is not known,
    at the joint at which this says most.

    Segments of which both leave noise alone say nothing.

    Args:
        joints: that are looked at; all where None.
    """
    names = np.array(own.segments)
    segments = tuple(dict.fromkeys(own.segments))
    a, b, noise = (
        np.array([x[names == s].mean(axis=0) for s in segments]) for x in (own.after, rival.after, own.noise)
    )
    ratios = np.log(np.maximum(a, LEAST) / np.maximum(b, LEAST))
    beyond = np.sign(ratios) * np.maximum(np.abs(ratios) - ALIKE, 0.0)
    told = np.mean(np.where(np.maximum(a, b) > ABOVE * noise, beyond, 0.0), axis=0)
    seen = told if joints is None else told[list(joints)]
    most = seen[int(np.argmax(np.abs(seen)))]
    return float(np.clip(0.5 * NUMBERS * min(len(segments), MOST_SEGMENTS) * most, -SURE, SURE))


def line(own: Candidate, rival: Candidate, nats: float) -> str:
    """What held-out data say of two causes."""
    names = [f"{c.hypothesis.effect} at {c.hypothesis.place}" for c in (own, rival)]
    better, worse = names[::-1] if nats > 0.0 else names
    return f"Held-out data speak for {better} against {worse}, by a factor of {np.exp(abs(nats)):.3g} in the odds."
