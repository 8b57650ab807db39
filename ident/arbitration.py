"""Names and their rivals, weighed by how they foretell held-out data.

What tells two causes apart may not be among the records that a model is fitted to: over the speeds of small motions
about a posture a friction that falls is one of constant size beside less viscous friction, and along a large motion it
is far from that.
"""

from __future__ import annotations

from collections.abc import Sequence
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
from ident.refits import FINALISTS, POLISH_STEPS, refit
from ident.rounds import Round
from ident.torque_fit import Fit
from ident.values import named_effects

# Errors of a law repeat along a motion and in all records of a posture: each segment counts as so many independent
# numbers of unknown variance, and no more segments than that count.
NUMBERS, MOST_SEGMENTS = 4.0, 4
ALIKE = 0.1  # logarithm of the ratio of two mean squared errors of a segment, within which they say nothing
LEAST = 1e-300  # N2 m2
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
        rivals = rivals_of(found)
        if found.candidates[0].hypothesis.key not in named or not rivals or workers.late:
            continue
        final, weighed, more = _weighed(problem, held_out, result, found, rivals, workers)
        rounds = (*result.rounds[:i], weighed, *result.rounds[i + 1 :])
        result = replace(result, final=final, rounds=rounds)
        lines += more
    return result, lines


def rivals_of(found: Round) -> list[Candidate]:
    """Candidates of other names that the data of the fit leave in the running, the likeliest first.

    No laws of the gear: motions hardly show them, and of what they leave most is how a simulation of them began.
    """
    winner = found.candidates[0].hypothesis
    if winner.gear_law:
        return []
    others = (c for c in found.candidates[1:] if c.hypothesis.key != winner.key and not c.hypothesis.gear_law)
    return sorted((c for c in others if c.probability > REMATCH), key=lambda c: -c.probability)[:FINALISTS]


def _weighed(
    problem: Problem,
    held_out: Sequence[Group],
    result: Attribution,
    found: Round,
    rivals: Sequence[Candidate],
    workers: Workers,
) -> tuple[Fit, Round, list[str]]:
    """The model with that candidate of a round which all data prefer, the round, and what is to be said about it."""
    final, own = result.final, found.candidates[0]

    def left_by(there: Fit) -> Errors:
        return segment_errors(problem, held_out, result.baseline.model, there.model)[0].seen_along()

    def entered(c: Candidate) -> tuple[Fit, Errors] | None:
        try:
            there = refit(problem, with_rival(final.model, own, c), final.weights, final.remainders, POLISH_STEPS)
            return None if there is None else (there, left_by(there))
        except NOT_COMPUTED:
            return None

    workers.say(f"held-out data: {own.hypothesis.effect} at {own.hypothesis.place} and its rivals")
    try:
        left = left_by(final)
    except NOT_COMPUTED:
        return final, found, []
    new, nats = {id(c): c for c in found.candidates}, {}
    for rival, entry in zip(rivals, workers.map_in_time(entered, rivals), strict=True):
        if entry is not None and entry[1].segments == left.segments:
            nats[id(rival)] = nats_for(entry[1], left)
            odds = rival.probability * float(np.exp(nats[id(rival)]))
            new[id(rival)] = replace(rival, fit=entry[0], probability=odds)
    share = sum(c.probability for c in found.candidates) / sum(c.probability for c in new.values())
    new = {k: replace(c, probability=share * c.probability) for k, c in new.items()}
    names = [own, *(c for c in rivals if id(c) in nats and not c.hypothesis.decoy)]
    best = max(names, key=lambda c: new[id(c)].probability)
    others = sorted((new[id(c)] for c in found.candidates if c is not best), key=lambda c: -c.probability)
    lines = [line(own, c, nats[id(c)]) for c in rivals if abs(nats.get(id(c), 0.0)) > SPOKEN]
    weighed = replace(found, candidates=(new[id(best)], *others))
    return final if best is own else new[id(best)].fit, weighed, lines


def with_rival(model: Model, own: Candidate, rival: Candidate) -> Model:
    """The model with a rival in the place of a cause: the rival's own where all others are in it."""
    others = [e for e in model.effects if e.hypothesis.key != own.hypothesis.key]
    effect = next(e for e in rival.fit.model.effects if e.hypothesis.key == rival.hypothesis.key)
    beside = {e.hypothesis.key for e in rival.fit.model.effects} - {rival.hypothesis.key}
    if beside == {e.hypothesis.key for e in others}:
        return rival.fit.model
    return replace(model, effects=(*(e for e in others if e.hypothesis.key != rival.hypothesis.key), effect))


def nats_for(rival: Errors, own: Errors) -> float:
    """Logarithm of the ratio of the likelihoods of two models, errors of each segment of a variance that is not known,
    at the joint at which the two differ most.

    Both leave the same noise, and where that is all they leave the ratio is 1.
    """
    names = np.array(own.segments)
    segments = tuple(dict.fromkeys(own.segments))
    a, b, noise = (
        np.array([x[names == s].mean(axis=0) for s in segments]) for x in (own.after, rival.after, own.noise)
    )
    joint = int(np.argmax(np.sum(np.abs(a - b) / noise, axis=0)))
    ratios = np.log(np.maximum(a[:, joint], LEAST) / np.maximum(b[:, joint], LEAST))
    beyond = np.sign(ratios) * np.maximum(np.abs(ratios) - ALIKE, 0.0)
    return float(0.5 * NUMBERS * min(len(segments), MOST_SEGMENTS) * np.mean(beyond))


def line(own: Candidate, rival: Candidate, nats: float) -> str:
    """What held-out data say of two causes."""
    names = [f"{c.hypothesis.effect} at {c.hypothesis.place}" for c in (own, rival)]
    better, worse = names[::-1] if nats > 0.0 else names
    return f"Held-out data speak for {better} against {worse}, by a factor of {np.exp(min(abs(nats), 50.0)):.3g} in the odds."
