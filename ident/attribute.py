"""From a discrepancy to causes: detect, score, refit, compare, look again, stop.

Each round screens every hypothesis at every place against the current model, refits the few that
explain most together with the baseline and all causes found before, and weighs them by their
evidence. What is left over at the end decides whether the names can be trusted: decoys for what
the catalogue lacks compete with the names, and a residual far above the noise takes probability
from all of them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from ident.baseline import DETECTION_EXCESS, HOPELESS, discrepancy_p_value, implausible, loud
from ident.contests import weighed_again
from ident.evidence import Candidate, last_is_pointless
from ident.faint import SEEN, hidden
from ident.hypotheses import Hypothesis, catalogue
from ident.left_out import carries_over, with_error_as_noise
from ident.model import Effect, is_along_record
from ident.pairs import beside_rivals
from ident.parallel import Workers
from ident.problem import Problem, predictions
from ident.pruning import plainer, plainly_special, pruned, renamed, untold, without_shadows
from ident.refits import (
    FAINT,
    POLISH_STEPS,
    RECORD_EXCESS,
    beside_its_error,
    clip_to_bounds,
    either_turn,
    extended_by,
    polish,
    refit,
    reweighted,
    settled,
)
from ident.rounds import (
    MIN_EVIDENCE,
    Round,
    answers,
    attribute_once,
    beside_unclear,
    left_share,
    outdone,
    shadows,
    told_share,
    with_name,
)
from ident.screening import screen
from ident.search import MIN_SHARE, worth_a_hinge, worth_a_refit
from ident.strong import simulated
from ident.torque_fit import Fit

DETECTION_LEVEL = 1e-4  # p-value below which there is a discrepancy
DOUBTED_LEVEL = 1e-2  # the same where the drives that fit cannot be those of this arm
# share of the discrepancy up to which a decoy explains what laws of causes lack, and belies no name
LEFT_TO_DECOYS = 0.03
LEFT_TO_PAIRS = 0.03  # the same, from which two causes are sought at once
# of what is left at a joint, from which a friction is fitted there too: a step at a few shapes shows half of it
LINEAR_SHARE = 0.5 * MIN_SHARE
# of a law of the gear, over that along the record or found so far, from which its loop is begun
LOOP_SIZES = (1.0, 0.6, 1.6)
# of what causes explain at a joint, left there by errors of a hundredth in their laws: no other is sought loudly
LAWS_LEAVE = 1e-4


@dataclass(frozen=True)
class Attribution:
    """Result: the baseline fit, rounds, and the final fit."""

    baseline: Fit
    detected: bool
    p_value: float
    rounds: tuple[Round, ...]
    final: Fit
    unknown: bool

    @property
    def left_share(self) -> float:
        """Share of the discrepancy (excess over noise) that no cause explains."""
        return left_share(self.baseline, self.final)


def attribute(
    problem: Problem,
    baseline: Fit,
    *,
    max_causes: int = 4,
    hypotheses: Sequence[Hypothesis] | None = None,
    known: Attribution | None = None,
    workers: Workers = Workers(),
) -> Attribution:
    """Find the causes of what the baseline does not explain.

    Args:
        max_causes: rounds at most; an effect found at several joints at once is one of them.
        known: causes of the same records that were found beside more noise, from which the search goes on.
        workers: where candidates are fitted.
    """
    if hypotheses is None:
        held = problem.sampling.hold == "zoh"
        hypotheses = catalogue(problem.structure, motions_alone=problem.motions_alone, held=held)
    every = hypotheses = tuple(hypotheses)
    p_value = p_detected = discrepancy_p_value(baseline)
    level = DOUBTED_LEVEL if implausible(problem, baseline) else DETECTION_LEVEL
    clear = p_value < level and (baseline.chi2_per_dof > DETECTION_EXCESS or np.any(loud(baseline)))
    given, current, rounds, unknown, looped = problem, baseline, [], False, None
    if known is not None and known.final.model.effects:
        current, rounds = carried_on(problem, known, workers)
        hypotheses = untaken(hypotheses, current.model.effects)
    count = len({r.candidates[0].hypothesis.effect for r in rounds})
    while count < max_causes and not workers.late:
        if settled(current) and looped is not current:
            # Along the record noise is taken large, and hides other causes.
            current = looped = as_loops(problem, current, workers)
        last, named = current, tuple(rounds)
        told = baseline.costs - current.costs
        quiet_as_a_whole = settled(less_errors_of_laws(current, told)) and not np.any(loud(current, told))
        asked, faint = hypotheses, not clear or quiet_as_a_whole
        if not asked or (faint and problem is not given):
            break
        if faint:
            workers.say("what the noise as a whole would hide")
            asked, by_chance = hidden(problem, current, hypotheses, told)
            if not asked:
                break
            p_detected = p_detected if clear or rounds else by_chance
        by_joint = problem.motions_alone and not faint and current.chi2_per_dof > FAINT
        workers.say(f"cause {count + 1}: screening {len(asked)} hypotheses")
        # What is left beside a cause is mostly what its law lacks, and no hinge unless little is left; what is faint
        # shows none everywhere.
        bare = np.inf if rounds or faint else worth_a_hinge(current)
        least = 0.0 if faint else worth_a_refit(current)
        quiet = frozenset() if faint else shadows(problem, current, rounds)
        found = attribute_once(problem, current, asked, workers, least, bare, quiet)
        if not answers(found) and current.chi2_per_dof > HOPELESS and not workers.late:
            found = beside_unclear(problem, current, found, asked, workers, bare)
        if not answers(found, SEEN if faint else MIN_EVIDENCE):
            much = not faint and left_share(baseline, current) > LEFT_TO_PAIRS and not workers.late
            pair = beside_rivals(problem, current, rounds, hypotheses, workers) if much else None
            if pair is None:
                if not by_joint:
                    break
                joint = int(np.argmax(current.costs - current.counts))
                problem, current, hypotheses = elsewhere(problem, current, hypotheses, joint)
                continue
            rounds, found = pair
        found = with_name(found)
        best = found.candidates[0]
        rounds.append(found)
        count += 1
        nameless = best.hypothesis.decoy and not best.hypothesis.options.get("of_record")
        # Beside causes of single joints of a motion it is another one: they are trusted by what is left where they sit.
        nameless = nameless and not (by_joint and named)
        unknown = unknown or (nameless and left_share(baseline, current) > LEFT_TO_DECOYS)
        if best.hypothesis.decoy and not best.hypothesis.options.get("baseline"):
            if not by_joint or best.hypothesis.on_chain:
                break
            problem, current, hypotheses = elsewhere(problem, current, hypotheses, best.hypothesis.joint)
            continue
        current = from_other_motions(problem, polish(problem, best.fit), workers)
        if current.chi2_per_dof > FAINT and not best.hypothesis.decoy:
            current, more = companions(problem, current, best, hypotheses)
            rounds += more
        effects = current.model.effects
        current = plainer(problem, current, hypotheses, set(), rounds)
        rounds = renamed(rounds, effects, current.model.effects)
        taken = {e.hypothesis.key for e in (*effects, *current.model.effects)}
        current = pruned(problem, current)
        if problem.motions_alone and current.chi2_per_dof > FAINT and not best.hypothesis.decoy:
            workers.say("parts of the motions left out")
            joint = int(np.argmax(found.falls))
            if not carries_over(problem, last, current, joint, workers):
                rounds, count = list(named), count - 1
                rest = tuple(h for h in hypotheses if h.key != best.hypothesis.key)
                problem, current, hypotheses = elsewhere(problem, last, rest, joint)
                continue
        if len(rounds) > 1:
            # What is sought next would make up for a cause that was named wrongly as long as this one was missing.
            current, earlier = weighed_again(problem, current, rounds[:-1], workers)
            rounds = [*earlier, rounds[-1]]
        hypotheses = tuple(h for h in untaken(hypotheses, current.model.effects) if h.key not in taken)
    if problem is not given:
        problem, current = given, polish(given, current)
    if looped is not current and not workers.late:
        current = as_loops(problem, current, workers)
    current, rounds = at_the_end(problem, current, rounds, every, workers)
    left = {e.hypothesis.key for e in current.model.effects}
    kept = tuple(r for r in rounds if r.candidates[0].hypothesis.decoy or r.candidates[0].hypothesis.key in left)
    unknown = unknown or any(outdone(r) and told_share(baseline, r) > LEFT_TO_DECOYS for r in kept)
    return Attribution(baseline, clear or bool(kept), p_detected if kept else p_value, kept, current, unknown)


def at_the_end(
    problem: Problem, current: Fit, rounds: list[Round], every: Sequence[Hypothesis], workers: Workers
) -> tuple[Fit, list[Round]]:
    """All causes beside each other: those that the last ones made needless, rivals, special cases, and the last fit.

    Args:
        every: hypotheses that were asked at first.
    """
    current = without_shadows(problem, current, rounds, workers)
    current, rounds = weighed_again(problem, current, rounds, workers)
    effects = current.model.effects
    # What a cause had that sets it apart from its special case may have been what one that was found later does.
    itself = [e for e in effects if not (plainly_special(problem, current.model, e) or untold(current, e))]
    if len(itself) < len(effects) and not workers.late:
        current = plainer(problem, current, every, {e.hypothesis.key for e in itself}, rounds)
        rounds = renamed(rounds, effects, current.model.effects)
    return beside_its_error(problem, current), rounds


def elsewhere(
    problem: Problem, current: Fit, hypotheses: Sequence[Hypothesis], joint: int
) -> tuple[Problem, Fit, tuple[Hypothesis, ...]]:
    """A search of motions that goes on at other joints than one at which what is left follows no law of the catalogue:
    there it counts as noise from then on.

    Along measured motions the torque of one joint tells nothing of that of another.
    """
    other = with_error_as_noise(problem, current, joint)
    return other, polish(other, current), tuple(h for h in hypotheses if h.joint != joint)


def carried_on(problem: Problem, known: Attribution, workers: Workers) -> tuple[Fit, list[Round]]:
    """Causes found beside other noise, fitted and weighed beside that of ``problem``: the model, and a round for
    each."""
    current = polish(problem, known.final)
    there = {e.hypothesis.key for e in current.model.effects}
    rounds = []
    for found in known.rounds:
        if found.candidates[0].hypothesis.key in there:
            seen = tuple(replace(c, fit=reweighted(problem, c.fit, current.weights)) for c in found.candidates)
            rounds.append(replace(found, before=reweighted(problem, found.before, current.weights), candidates=seen))
    return weighed_again(problem, current, rounds, workers)


def untaken(hypotheses: Sequence[Hypothesis], effects: Sequence[Effect]) -> tuple[Hypothesis, ...]:
    """Hypotheses that may be sought beside effects: a special case of what is there already would only share its size
    with it."""
    taken = {e.hypothesis.key for e in effects}
    taken |= {(e.hypothesis.options.get("absorbs"), e.hypothesis.place) for e in effects}
    loaded = any(effect == "payload" for effect, _ in taken)
    return tuple(h for h in hypotheses if h.key not in taken and not (loaded and h.options.get("carries_load")))


def less_errors_of_laws(current: Fit, told: np.ndarray) -> Fit:
    """A fit as if it left no more than noise at joints where that may be errors of the laws of causes there.

    Args:
        told: (n,) fall of the cost by joint that causes have brought.
    """
    own = [e.hypothesis.joint for e in current.model.effects if not e.hypothesis.on_chain]
    laws = np.zeros(len(told))
    laws[own] = LAWS_LEAVE * np.maximum(told[own], 0.0)
    return replace(
        current,
        costs=np.where(current.costs - current.counts < laws, np.minimum(current.costs, current.counts), current.costs),
    )


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
        if current.costs[j] <= DETECTION_EXCESS * current.counts[j]:
            continue
        turned = either_turn(problem, current, effect)
        if turned.cost < current.cost - MIN_EVIDENCE:
            current = polish(problem, turned)
        if resized is None or is_along_record(h):
            continue
        others = tuple(e for e in current.model.effects if e.hypothesis.key != h.key)
        sizes = [clip_to_bounds(h, resized(effect.p, f, current.model.par.stiffness[j])) for f in LOOP_SIZES[1:]]
        models = [replace(current.model, effects=(*others, Effect(h, p))) for p in sizes]
        workers.say(f"other motions: {h.effect} at {h.place}")
        again = partial(refit, problem, weights=current.weights, remainders=current.remainders)
        fits = workers.map_in_time(again, models)
        best = min(
            (r for r in fits if r is not None and not last_is_pointless(r)), key=lambda r: r.cost, default=current
        )
        if best.cost < current.cost - MIN_EVIDENCE:
            current = polish(problem, best)
    return current


def companions(
    problem: Problem, current: Fit, winner: Candidate, hypotheses: Sequence[Hypothesis]
) -> tuple[Fit, list[Round]]:
    """A friction just named at other joints too, where at least two of them ask for it: a real arm has it at all.

    Nothing else: what one ripple shakes at all joints, others of periods found freely would each explain at their own.
    Each must explain ``LINEAR_SHARE`` of what is left at its own joint by a linear step, and ``MIN_SHARE`` once all
    are fitted together. A single one is left to the next round, where it competes.

    Returns:
        The model with them, and a round for each; ``current`` and none where there are none.
    """
    effect = winner.hypothesis.effect
    same = [h for h in hypotheses if h.effect == effect and h.joint >= 0 and h.key != winner.hypothesis.key]
    if "friction" not in effect or len(same) < 2:
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
