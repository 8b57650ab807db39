"""What follows a cause that was found: its law of the gear as a loop, begun from other sizes, and the same friction at
other joints.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import partial

import numpy as np

from ident.evidence import Candidate, last_is_pointless
from ident.hypotheses import Hypothesis
from ident.hypotheses.friction import bristled_stribeck
from ident.model import Effect, Model, is_along_record
from ident.parallel import Workers
from ident.problem import Problem, predictions
from ident.pruning import plainer
from ident.refits import (
    POLISH_STEPS,
    RECORD_EXCESS,
    clip_to_bounds,
    either_turn,
    extended_by,
    polish,
    refit,
    reweighted,
    unsettled_at,
)
from ident.rounds import MIN_EVIDENCE, Round
from ident.screening import screen, signal_scale
from ident.search import MIN_SHARE
from ident.strong import simulated
from ident.torque_fit import Fit

# of what is left at a joint, from which a friction is fitted there too: a step at a few shapes shows half of it
LINEAR_SHARE = 0.5 * MIN_SHARE
# of a law of the gear, over that along the record or found so far, from which its loop is begun
LOOP_SIZES = (1.0, 0.6, 1.6)


def as_loops(problem: Problem, current: Fit, workers: Workers) -> Fit:
    """Laws of the gear along the record as loops where they can be, beside all causes that were found by then.

    Their size is sought about that along the record, which the noise taken there has blurred.
    """
    for h in [e.hypothesis for e in current.model.effects if is_along_record(e.hypothesis)]:
        others = tuple(e for e in current.model.effects if e.hypothesis.key != h.key)
        size, *shape = next(e.p for e in current.model.effects if e.hypothesis.key == h.key)
        models = [(*others, Effect(h, np.array([size * factor, *shape]))) for factor in LOOP_SIZES]
        starts = [replace(current, model=replace(current.model, effects=effects)) for effects in models]
        loops = [r for kept, r in workers.map(partial(simulated, problem, h), starts) if not is_along_record(kept)]
        if loops:
            best = polish(problem, min(loops, key=lambda r: r.cost))
            current = best if best.costs[h.joint] <= RECORD_EXCESS * best.counts[h.joint] else current
    return current


def from_other_motions(problem: Problem, current: Fit, workers: Workers) -> Fit:
    """The model with laws under which the arm may have several steady motions begun from other sizes, where they leave
    more than noise.

    Between two sizes at which a record changes from one motion to another the cost has a minimum each. So has a
    friction that turns at once, and that turns within a velocity that is seen.
    """
    for effect in current.model.effects:
        h, resized, j = effect.hypothesis, effect.hypothesis.options.get("bends"), effect.hypothesis.joint
        if not unsettled_at(current, j):
            continue
        turned = either_turn(problem, current, effect)
        if turned.cost < current.cost - MIN_EVIDENCE:
            current = polish(problem, turned)
        if "bristled" in h.options and not problem.motions_alone:
            current = with_bristle(problem, current, h, workers)
            continue
        if resized is None or is_along_record(h):
            continue
        others = tuple(e for e in current.model.effects if e.hypothesis.key != h.key)
        sizes = [clip_to_bounds(h, resized(effect.p, f, current.model.par.stiffness[j])) for f in LOOP_SIZES[1:]]
        models = [replace(current.model, effects=(*others, Effect(h, p))) for p in sizes]
        workers.say(f"other motions: {h.effect} at {h.place}")
        current = better_of(problem, current, models, workers)
    return current


def better_of(problem: Problem, current: Fit, models: Sequence[Model], workers: Workers) -> Fit:
    """The best of models that are fitted as a fit was, where it leaves clearly less; that fit elsewhere."""
    again = partial(refit, problem, weights=current.weights, remainders=current.remainders)
    fits = workers.map_in_time(again, models)
    best = min((r for r in fits if r is not None and not last_is_pointless(r)), key=lambda r: r.cost, default=current)
    return polish(problem, best) if best.cost < current.cost - MIN_EVIDENCE else current


def with_bristle(problem: Problem, current: Fit, stribeck: Hypothesis, workers: Workers) -> Fit:
    """The model with a friction that gives before it slips, as in the LuGre model, where that leaves less."""
    law = bristled_stribeck(stribeck.joint, stribeck.place)
    others = tuple(e for e in current.model.effects if e.hypothesis.key != law.key)
    own = next(e for e in current.model.effects if e.hypothesis.key == law.key)
    preds = predictions(problem, current.model, current.remainders)
    scale = signal_scale(problem, preds, law.joint, ())
    models = [
        replace(current.model, effects=(*others, Effect(law, clip_to_bounds(law, p))))
        for p in stribeck.options["bristled"](own.p, scale)
    ]
    workers.say(f"a bristle: {law.effect} at {law.place}")
    return better_of(problem, current, models, workers)


def companions(
    problem: Problem, current: Fit, winner: Candidate, hypotheses: Sequence[Hypothesis]
) -> tuple[Fit, list[Round]]:
    """A friction just named at other joints too, where at least two of them ask for it: a real arm has it at all. So is
    what a recorder does to one channel.

    Nothing else: what one ripple shakes at all joints, others of periods found freely would each explain at their own.
    Each must explain ``LINEAR_SHARE`` of what is left at its own joint by a linear step, and ``MIN_SHARE`` once all
    are fitted together. A single one is left to the next round, where it competes.

    Returns:
        The model with them, and a round for each; ``current`` and none where there are none.
    """
    effect = winner.hypothesis.effect
    same = [h for h in hypotheses if h.effect == effect and h.joint >= 0 and h.key != winner.hypothesis.key]
    if not ("friction" in effect or winner.hypothesis.options.get("of_record")) or len(same) < 2:
        return current, []
    preds = predictions(problem, current.model, current.remainders)
    noise = current.counts
    left = np.maximum(current.costs - noise, 1.0)
    scores = [
        s
        for s in screen(problem, current, preds, same)
        if s.start is not None and s.gain > LINEAR_SHARE * left[s.hypothesis.joint]
    ]
    if len(scores) < 2:
        return current, []
    model = current.model
    for score in scores:
        model = replace(model, effects=extended_by(model.effects, score))
    found = refit(problem, model, current.weights, current.remainders, POLISH_STEPS)
    if found is None:
        return current, []
    after = found.costs - noise
    kept = [s for s in scores if after[s.hypothesis.joint] < (1.0 - MIN_SHARE) * left[s.hypothesis.joint]]
    if len(kept) < 2:
        return current, []
    keys = {s.hypothesis.key for s in kept} | {e.hypothesis.key for e in current.model.effects}
    effects = tuple(e for e in found.model.effects if e.hypothesis.key in keys)
    last = polish(problem, replace(found, model=replace(found.model, effects=effects)))
    before = {e.hypothesis.key for e in current.model.effects}
    last = plainer(problem, last, hypotheses, before)
    scale = max(1.0, last.cost / last.count)
    joined = reweighted(problem, last, current.weights)
    by_joint = {s.hypothesis.joint: s for s in kept}
    rounds = [
        Round(
            current,
            (Candidate(e.hypothesis, joined, 0.0, winner.probability),),
            (by_joint[e.hypothesis.joint],),
            scale,
            1.0,
        )
        for e in last.model.effects
        if e.hypothesis.key not in before
    ]
    return last, rounds
