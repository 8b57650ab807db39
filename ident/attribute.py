"""From a discrepancy to causes: detect, score, refit, compare, look again, stop.

Each round screens every hypothesis at every place against the current model, refits the few that
explain most together with the baseline and all causes found before, and weighs them by their
evidence. What is left over at the end decides whether the names can be trusted: decoys for what
the catalogue lacks compete with the names, and a residual far above the noise takes probability
from all of them.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from ident.baseline import DETECTION_EXCESS, HOPELESS, discrepancy_p_value, implausible
from ident.evidence import (
    ABSENT,
    LAW_ERROR,
    TEMPER,
    TEMPER_OF_NOISE,
    WAVE,
    Candidate,
    explained,
    is_wave,
    last_is_pointless,
    model_error,
    pointless,
    rivals_of_best,
    weigh,
)
from ident.extended import Effect, Model, is_along_record, joints_along_record
from ident.faint import SEEN, hidden
from ident.hypotheses import Hypothesis, catalogue
from ident.parallel import Workers
from ident.records import Group
from ident.screening import Score, screen, signal_scale
from ident.search import (
    FAINT,
    FINALISTS,
    FIRST_STEPS,
    MIN_SHARE,
    POLISH_STEPS,
    RECORD_EXCESS,
    STRONG,
    beside_strong,
    clip_to_bounds,
    either_turn,
    explore,
    explore_softly,
    extended_by,
    left_by,
    polish,
    refit,
    reweighted,
    settled,
    simulated,
    under_noise_of_best,
    under_own_noise,
    worth_a_hinge,
    worth_a_refit,
)
from ident.torque_fit import Fit, Problem, predictions

DETECTION_LEVEL = 1e-4  # p-value below which there is a discrepancy
DOUBTED_LEVEL = 1e-2  # the same where the drives that fit cannot be those of this arm
SETTLED = 0.05  # share of the excess up to which what is left needs no second search
UNTOLD = 1.0  # standard deviation of a logarithm, from which the data say nothing of a parameter
LEFT_TO_DECOYS = 0.03  # share of the discrepancy up to which a decoy explains what laws of causes lack, and belies no name
NEARLY = 0.95  # of what a decoy explains, that a law of the catalogue must, to take its place as long as causes are missing
LINEAR_SHARE = 0.5 * MIN_SHARE  # of what is left at a joint, from which a friction is fitted there too: a step at a few shapes shows half of it
LOOP_SIZES = (1.0, 0.6, 1.6)  # of a law of the gear, over that along the record or found so far, from which its loop is begun
SPOILT = 0.3  # of the noise, left where a strong effect may have spoilt the drives, that asks for one
MIN_EVIDENCE = 25.0  # fall of the scaled cost that a cause must bring
LAWS_LEAVE = 1e-4  # of what causes explain at a joint, left there by errors of a hundredth in their laws: no other is sought loudly
RIPPLE = "periods_per_rev"  # parameter of effects that repeat with the position
SAME_PERIOD = 0.01  # relative, of two ripples
NEXT_TO_REST = 2.0  # velocity over that at which a motor may as well rest, up to which friction may stand for what holds it then
REMATCH = 0.02  # probability from which a rival is weighed against a cause again at the end


@dataclass(frozen=True)
class Round:
    """One round of attribution: what competed, and who won.

    ``before`` is the model without a new cause, its cost under the weights of the candidates; ``explained`` is the
    share of its excess over noise that the winner explains.
    """

    before: Fit
    candidates: tuple[Candidate, ...]
    scores: tuple[Score, ...]
    scale: float
    explained: float

    @property
    def fall(self) -> float:
        """Of the cost, by the winner."""
        return self.before.cost - self.candidates[0].fit.cost


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


def left_share(baseline: Fit, current: Fit) -> float:
    """Share of the discrepancy of the baseline that a model leaves, 0 to 1."""
    before = max(baseline.chi2_per_dof - 1.0, 1e-12)
    return float(np.clip((current.chi2_per_dof - DETECTION_EXCESS) / before, 0.0, 1.0))


def attribute(
    problem: Problem,
    baseline: Fit,
    *,
    max_causes: int = 4,
    hypotheses: Sequence[Hypothesis] | None = None,
    workers: Workers = Workers(),
) -> Attribution:
    """Find the causes of what the baseline does not explain.

    Args:
        max_causes: rounds at most; an effect found at several joints at once is one of them.
        workers: where candidates are fitted.
    """
    if hypotheses is None:
        # In motions alone offsets of the torque are found with the inertias of the links, as part of the baseline.
        hypotheses = catalogue(problem.structure, offsets=not problem.motions_alone)
    every = hypotheses = tuple(hypotheses)
    p_value = p_detected = discrepancy_p_value(baseline)
    level = DOUBTED_LEVEL if implausible(problem, baseline) else DETECTION_LEVEL
    loud = p_value < level and baseline.chi2_per_dof > DETECTION_EXCESS
    current, rounds, unknown, count, looped = baseline, [], False, 0, None
    while count < max_causes and not workers.late:
        if settled(current) and looped is not current:
            # Along the record noise is taken large, and hides other causes.
            current = looped = as_loops(problem, current, workers)
        told = baseline.costs - current.costs
        asked, faint = hypotheses, not loud or settled(less_errors_of_laws(current, told))
        if faint:
            workers.say("what the noise as a whole would hide")
            asked, by_chance = hidden(problem, current, hypotheses, told)
            if not asked:
                break
            p_detected = p_detected if loud or rounds else by_chance
        workers.say(f"cause {count + 1}: screening {len(asked)} hypotheses")
        # What is left beside a cause is mostly what its law lacks, and no hinge unless little is left; what is faint shows none everywhere.
        bare = np.inf if rounds or faint else worth_a_hinge(current)
        least = 0.0 if faint else worth_a_refit(current)
        quiet = frozenset() if faint else shadows(problem, current, rounds)
        found = attribute_once(problem, current, asked, workers, least, bare, quiet)
        if not answers(found) and current.chi2_per_dof > HOPELESS and not workers.late:
            found = beside_unclear(problem, current, found, asked, workers, bare)
        if not answers(found, SEEN if faint else MIN_EVIDENCE):
            break
        found = with_name(found)
        best = found.candidates[0]
        rounds.append(found)
        count += 1
        unknown = unknown or (best.hypothesis.decoy and left_share(baseline, current) > LEFT_TO_DECOYS)
        if best.hypothesis.decoy and not best.hypothesis.options.get("baseline"):
            break
        current = from_other_motions(problem, polish(problem, best.fit), workers)
        if current.chi2_per_dof > FAINT and not best.hypothesis.decoy:
            current, more = companions(problem, current, best, hypotheses)
            rounds += more
        effects = current.model.effects
        current = plainer(problem, current, hypotheses, set())
        rounds = renamed(rounds, effects, current.model.effects)
        taken = {e.hypothesis.key for e in (*effects, *current.model.effects)}
        current = pruned(problem, current)
        if len(rounds) > 1:
            # What is sought next would make up for a cause that was named wrongly as long as this one was missing.
            current, earlier = weighed_again(problem, current, rounds[:-1], workers)
            rounds = [*earlier, rounds[-1]]
        taken |= {e.hypothesis.key for e in current.model.effects}
        # A special case of what is there already would only share its size with it.
        taken |= {(e.hypothesis.options.get("absorbs"), e.hypothesis.place) for e in current.model.effects}
        loaded = any(effect == "payload" for effect, _ in taken)
        hypotheses = tuple(h for h in hypotheses if h.key not in taken and not (loaded and h.options.get("carries_load")))
    if looped is not current and not workers.late:
        current = as_loops(problem, current, workers)
    current = without_shadows(problem, current, rounds, workers)
    current, rounds = weighed_again(problem, current, rounds, workers)
    effects = current.model.effects
    itself = [e for e in effects if not plainly_special(problem, current.model, e)]
    if len(itself) < len(effects) and not workers.late:
        current = plainer(problem, current, every, {e.hypothesis.key for e in itself})
        rounds = renamed(rounds, effects, current.model.effects)
    left = {e.hypothesis.key for e in current.model.effects}
    kept = tuple(r for r in rounds if r.candidates[0].hypothesis.decoy or r.candidates[0].hypothesis.key in left)
    unknown = unknown or any(outdone(r) and told_share(baseline, r) > LEFT_TO_DECOYS for r in kept)
    return Attribution(baseline, loud or bool(kept), p_detected if kept else p_value, kept, current, unknown)


def less_errors_of_laws(current: Fit, told: np.ndarray) -> Fit:
    """A fit as if it left no more than noise at joints where that may be errors of the laws of causes there.

    Args:
        told: (n,) fall of the cost by joint that causes have brought.
    """
    own = [e.hypothesis.joint for e in current.model.effects if not e.hypothesis.on_chain]
    laws = np.zeros(len(told))
    laws[own] = LAWS_LEAVE * np.maximum(told[own], 0.0)
    return replace(current, costs=np.where(current.costs - current.counts < laws, np.minimum(current.costs, current.counts), current.costs))


def told_share(baseline: Fit, found: Round) -> float:
    """Share of the discrepancy of the baseline that a round explains; more than 1 of one within the error of the noise."""
    return found.fall / max(baseline.cost - DETECTION_EXCESS * baseline.count, 1.0)


def answers(found: Round, least: float = MIN_EVIDENCE) -> bool:
    """Whether the best candidate of a round explains enough to be a cause, ``least`` of the scaled cost."""
    return bool(found.candidates) and found.fall >= least * found.scale and found.explained >= MIN_SHARE


def with_name(found: Round) -> Round:
    """A round that a decoy has won, won by the law of the catalogue that it holds, or by one that explains nearly as much.

    Beside causes that are still missing what sets them apart means little: the decoy is a rival again at the end.
    """
    best, *others = found.candidates
    first = best.hypothesis
    if not first.decoy or first.options.get("baseline"):
        return found
    named = [c for c in others if c.hypothesis.key == (first.options.get("absorbs"), first.place)]
    if not named:
        least = NEARLY * found.fall
        named = [c for c in others if not c.hypothesis.decoy and found.before.cost - c.fit.cost >= least][:1]
    return replace(found, candidates=(*named, *(c for c in found.candidates if c not in named))) if named else found


def outdone(found: Round) -> bool:
    """Whether a decoy does better than the cause that a round has named."""
    best = max(found.candidates, key=lambda c: c.probability)
    return best.hypothesis.decoy and best is not found.candidates[0]


def weighed_again(
    problem: Problem, current: Fit, rounds: Sequence[Round], workers: Workers
) -> tuple[Fit, list[Round]]:
    """``rematched``, and the model pruned where a rival has won: alone it may explain what the loser did beside others."""
    found, rounds = rematched(problem, current, rounds, workers)
    return found if found is current else pruned(problem, found), rounds


def rematched(problem: Problem, current: Fit, rounds: Sequence[Round], workers: Workers) -> tuple[Fit, list[Round]]:
    """Causes against their rivals once more, beside all that was found after them.

    In the round in which a cause is named those still missing blur what sets it apart from its rivals.
    """
    out = []
    for found in rounds:
        winner = found.candidates[0].hypothesis
        there = {e.hypothesis.key for e in current.model.effects}
        blurred = len(there) > 1 or outdone(found) or nearly_settled(current)
        if blurred and winner.key in there and not winner.decoy and not workers.late:
            current, found = contest(problem, current, found, workers)
        out.append(found)
    return current, out


def contest(problem: Problem, current: Fit, found: Round, workers: Workers) -> tuple[Fit, Round]:
    """The winner of a round and its rivals, each fitted in its place: the model with the best of them, and the round."""
    effects = current.model.effects
    there = {e.hypothesis.key for e in effects}
    winner = found.candidates[0].hypothesis
    others = tuple(e for e in effects if e.hypothesis.key != winner.key)
    own = next(e for e in effects if e.hypothesis.key == winner.key)

    def other(h: Hypothesis) -> bool:
        """Whether it is not there already: a body with its load is another one than without."""
        loaded = [x.options.get("with_load") for x in (h, own.hypothesis)]
        return h.key not in there or (h.key == winner.key and loaded[0] != loaded[1])

    rivals = [c.fit.model.effects[-1] for c in found.candidates[1:] if c.probability > REMATCH and other(c.hypothesis)]
    rivals = [*rivals[:FINALISTS], *(wider(problem, current, own) if nearly_settled(current) else []), *elsewhere(problem, current, own, others)]

    def entered(effect: Effect) -> Fit | None:
        model = replace(current.model, effects=(*others, effect))
        last = refit(problem, model, current.weights, current.remainders, POLISH_STEPS)
        return last and either_turn(problem, last, last.model.effects[-1], POLISH_STEPS)

    entrants = [own, *rivals] if rivals else []
    fits = workers.map_in_time(entered, entrants, lambda e: f"again: {e.hypothesis.effect} at {e.hypothesis.place}")
    ran = [Candidate(e.hypothesis, r, 0.0) for e, r in zip(entrants, fits, strict=True) if r is not None]
    if len(ran) < 2 or ran[0].hypothesis is not own.hypothesis:
        return current, found
    first = ran[0].fit
    best_of: dict[tuple[str, str], Candidate] = {}
    for c in sorted(ran, key=lambda c: c.fit.cost):
        best_of.setdefault(c.hypothesis.key, c)
    ran = list(best_of.values())
    excess = model_error(min(c.fit.cost for c in ran), current.count, found.fall)
    weighed = weigh(ran, excess, temper_of(found.before))
    best = weighed[0]
    if best.hypothesis.decoy:  # it takes probability from the name, and no place in the model
        best = next(c for c in weighed if c.hypothesis.key == own.hypothesis.key)
    elif best.fit is not first:
        current = polish(problem, best.fit)
    now = {c.hypothesis.key: c.probability for c in weighed}
    seen = {c.hypothesis.key for c in found.candidates}
    new = [c for c in weighed if c.hypothesis.key not in seen]
    known = new + [replace(c, probability=now.pop(c.hypothesis.key, 0.0)) for c in found.candidates]
    known.sort(key=lambda c: (c.hypothesis.key != best.hypothesis.key, -c.probability))
    return current, replace(found, candidates=tuple(known))


def elsewhere(problem: Problem, current: Fit, own: Effect, others: Sequence[Effect]) -> list[Effect]:
    """A ripple as it is screened beside all others: found beside causes that were missing its wave number may be another's."""
    if RIPPLE not in [q.name for q in own.hypothesis.parameters]:
        return []
    without = refit(problem, replace(current.model, effects=tuple(others)), current.weights, current.remainders, FIRST_STEPS)
    if without is None:
        return []
    preds = predictions(problem, without.model, without.remainders)
    scores = screen(problem, without, preds, [own.hypothesis])
    found = [Effect(own.hypothesis, clip_to_bounds(own.hypothesis, s.start)) for s in scores if s.start is not None]
    return [e for e in found if abs(e.value(RIPPLE) / own.value(RIPPLE) - 1.0) > SAME_PERIOD]


def wider(problem: Problem, current: Fit, effect: Effect) -> list[Effect]:
    """Laws of the catalogue that hold an effect as a special case, at several shapes: a linear step may not lead there."""
    h = effect.hypothesis
    there = {e.hypothesis.key for e in current.model.effects}
    laws = [
        x
        for x in catalogue(problem.structure)
        if (x.options.get("absorbs"), x.place) == h.key and "widens" in x.options and x.key not in there
    ]
    if not laws:
        return []
    scale = signal_scale(problem, predictions(problem, current.model, current.remainders), h.joint, ())
    return [Effect(x, clip_to_bounds(x, p)) for x in laws for p in x.options["widens"](effect.p, scale)]


def pruned(problem: Problem, current: Fit) -> Fit:
    """The model without effects of which nothing is left.

    One that stood for a part of a cause as long as that had no name is not needed beside it; and one that won only since
    the drives found a better place in its company says nothing: that place is the baseline's then.
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
        sizes = [s > (UNTOLD if q.log else 0.5 * abs(v)) for q, v, s in own if q.null is None and (not wave or q.name in WAVE)]
        return all(sizes) if sizes else all(x < ABSENT for x in off)

    effects = current.model.effects
    needed = tuple(e for e in effects if e.hypothesis.options.get("baseline") or not nothing(e))
    if len(needed) == len(effects):
        return current
    other = polish(problem, replace(current, model=replace(current.model, effects=needed)))
    same = reweighted(problem, current, other.weights)
    return other if other.cost - same.cost < MIN_EVIDENCE * max(1.0, same.cost / same.count) else current


def nearly_settled(current: Fit) -> bool:
    """Whether a little more than noise is left, so that the shape of a law can be what it lacks."""
    return not settled(current) and current.chi2_per_dof <= FAINT


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
    """The model with laws under which the arm may have several steady motions begun from other sizes, where they leave more than noise.

    Between two sizes at which a record changes from one motion to another the cost has a minimum each. So has a friction that
    turns at once, and that turns within a velocity that is seen.
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
        best = min((r for r in fits if r is not None and not last_is_pointless(r)), key=lambda r: r.cost, default=current)
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
        Round(current, (Candidate(e.hypothesis, joined, 0.0, winner.probability),), (by_joint[e.hypothesis.joint],), scale, 1.0)
        for e in last.model.effects
        if e.hypothesis.key not in before
    ]
    return last, rounds


def without_shadows(problem: Problem, current: Fit, rounds: Sequence[Round], workers: Workers) -> Fit:
    """The model without companions of a friction that the data do not need beside a cause that was found after them.

    They competed with no other hypothesis, and made up for that cause as long as it was missing.
    """
    alone = {r.candidates[0].hypothesis.key for r in rounds if len(r.candidates) == 1 and r.before is not rounds[-1].before}
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
    new = {a.hypothesis.key: b.hypothesis for a, b in zip(before, after, strict=True) if a.hypothesis is not b.hypothesis}

    def of(found: Round) -> Round:
        first, *others = found.candidates
        h = new.get(first.hypothesis.key, first.hypothesis)
        return replace(found, candidates=(replace(first, hypothesis=h), *(c for c in others if c.hypothesis.key != h.key)))

    return [of(r) for r in rounds]


def plainer(problem: Problem, result: Fit, hypotheses: Sequence[Hypothesis], kept: set[tuple[str, str]]) -> Fit:
    """The model with the special case in place of effects of which the data do not show what sets them apart from it.

    Args:
        kept: keys of effects that stay as they are.
    """
    known = {h.key: h for h in hypotheses}
    special_by_itself = partial(plainly_special, problem, result.model)
    std = dict(zip(result.names, np.sqrt(np.maximum(np.diag(result.covariance()), 0.0)), strict=True))

    def plain(effect: Effect) -> Effect:
        h = effect.hypothesis
        special = known.get((h.options.get("absorbs", ""), h.place))
        if h.key in kept or special is None or "apart" not in h.options:
            return effect
        hidden = h.options.get("give", lambda p: np.inf)(effect.p) < problem.q_std[h.joint]
        if std[h.coordinate(h.options['apart'])] < UNTOLD and not hidden and not special_by_itself(effect):
            return effect
        return Effect(special, clip_to_bounds(special, h.options["special"](effect.p)))

    effects = tuple(plain(e) for e in result.model.effects)
    swapped = sum(a is not b for a, b in zip(effects, result.model.effects, strict=True))
    if not swapped:
        return result
    other = polish(problem, replace(result, model=replace(result.model, effects=effects)))
    same = reweighted(problem, result, other.weights)
    scale = max(1.0, same.cost / same.count)
    # One that has reached what makes it its special case is that one, whatever errors of the law make of the rest.
    certain = all(a is b or special_by_itself(a) for a, b in zip(result.model.effects, effects, strict=True))
    return other if certain or other.cost - same.cost < swapped * MIN_EVIDENCE * scale else result


def plainly_special(problem: Problem, model: Model, effect: Effect) -> bool:
    """Whether an effect is its special case by its parameters, or beside laws along the record.

    Along the record nothing says what friction takes of the torque while a motor rests: what a friction has within velocities at
    which it may as well rest is an error of that.
    """
    h = effect.hypothesis
    if h.options.get("plain", lambda p: False)(effect.p):
        return True
    if "within" not in h.options:
        return False
    v = h.options["within"](effect.p)

    def unseen(group: Group) -> bool:
        rests = group.rest is not None and bool(np.any(group.rest[..., h.joint]))
        return rests and h.joint in joints_along_record(model, group) and v < NEXT_TO_REST * group.least_velocity[:, h.joint].mean()

    return all(map(unseen, problem.groups))


def attribute_once(
    problem: Problem,
    current: Fit,
    hypotheses: Sequence[Hypothesis],
    workers: Workers,
    least: float,
    bare: float,
    quiet: frozenset[int] = frozenset(),
) -> Round:
    """One round: screen all, refit the best, weigh them.

    A strong cause may have spoilt the model from which others are sought, so that none of them answers;
    candidates are then also sought from a softened model. All are compared under the same weights.

    Args:
        least, bare: as of ``search.explore``, from the model as it is.
        quiet: joints at which no strong effect is sought, and what is left asks for no hinge.
    """
    before, softly = current, {}
    found, scores = explore(problem, current, hypotheses, least, bare, workers, quiet=quiet)
    excess = max(current.cost - current.count, 1.0)
    told = bool(found) and settles_its_joint(problem, current, *found[0])
    if current.chi2_per_dof > STRONG and left_by(found) > SETTLED * excess and not told and not workers.late:
        before, found, scores, softly = explore_softly(problem, current, found, hypotheses, workers)
    best: dict[int, tuple[Hypothesis, Fit]] = {}
    for h, result in found:
        if not last_is_pointless(result) and (id(h) not in best or result.cost < best[id(h)][1].cost):
            best[id(h)] = h, result
    ranked = sorted(best.values(), key=lambda x: x[1].cost)
    if ranked:
        before, ranked = under_noise_of_best(problem, before, ranked, workers)
    if leaves_much(problem, before, ranked) and not told and not workers.late:
        before, ranked = beside_strong(problem, before, ranked, scores, workers, quiet)
    return weighed_round(before, ranked, scores, softly)


def leaves_much(problem: Problem, before: Fit, ranked: Sequence[tuple[Hypothesis, Fit]]) -> bool:
    """Whether the best candidate leaves so much that a strong effect may be missing.

    That is anything clearly above the noise where the drives cannot be those of the arm, or where the arm may have several steady
    motions under the law of the best; else more than what is faint, and than errors of its law.
    """
    bent = bool(ranked) and "bends" in ranked[0][0].options
    spoilt = not problem.motions_alone and (bent or implausible(problem, before))
    excess = before.cost - before.count
    allowed = SPOILT * before.count if spoilt else max(FAINT * before.count, LAW_ERROR * excess)
    return min(excess, left_by(ranked)) > allowed


def shadows(problem: Problem, current: Fit, rounds: Sequence[Round]) -> frozenset[int]:
    """Joints at which next to nothing is left beside what a cause there has explained, all in the noise of the model as it is."""
    left = current.costs - current.counts
    out = set()
    for found in rounds:
        j = found.candidates[0].hypothesis.joint
        if j >= 0 and left[j] < LAW_ERROR * (reweighted(problem, found.before, current.weights).costs[j] - current.costs[j]):
            out.add(j)
    return frozenset(out)


def settles_its_joint(problem: Problem, current: Fit, h: Hypothesis, result: Fit) -> bool:
    """Whether a candidate leaves no more than noise of a clear discrepancy at its own joint: what is left has another cause.

    Along the measured motion of the motors most effects reach the torque of their own joint alone.
    """
    j = h.joint
    if h.decoy or h.on_chain or current.costs[j] <= FAINT * current.counts[j]:
        return False
    own = under_own_noise(problem, result)
    return own is not None and bool(own.costs[j] <= DETECTION_EXCESS * own.counts[j])


def beside_unclear(
    problem: Problem, current: Fit, found: Round, hypotheses: Sequence[Hypothesis], workers: Workers, bare: float
) -> Round:
    """A round in which nothing answers, with candidates of which a linear step has shown too little to try them.

    Args:
        bare: as of ``search.explore``.
    """
    direct, scores = explore(problem, current, hypotheses, 0.0, bare, workers)
    hopefuls = [(h, r) for h, r in direct if not last_is_pointless(r)][:FINALISTS]
    same = workers.map(lambda x: refit(problem, x[1].model, found.before.weights, x[1].remainders), hopefuls)
    known = [(c.hypothesis, c.fit) for c in found.candidates]
    new = [(h, r) for (h, _), r in zip(hopefuls, same, strict=True) if r is not None and all(h is not k for k, _ in known)]
    if not new:
        return found
    before, ranked = under_noise_of_best(problem, found.before, sorted(known + new, key=lambda x: x[1].cost), workers)
    return weighed_round(before, ranked, scores, {})


def temper_of(before: Fit) -> float:
    """What differences of evidence are divided by, from the model without any of the candidates."""
    return TEMPER_OF_NOISE if settled(before) else TEMPER


def weighed_round(
    before: Fit, ranked: Sequence[tuple[Hypothesis, Fit]], scores: Sequence[Score], softly: Mapping[tuple[str, str], float]
) -> Round:
    """Candidates weighed by their evidence.

    Args:
        softly: what hypotheses explain under softened weights, by ``key``.
    """
    if not ranked:
        return Round(before, (), tuple(scores), 1.0, 0.0)
    rivals, excess = rivals_of_best(before, ranked)
    weighed = weigh([Candidate(h, result, 0.0) for h, result in rivals], excess, temper_of(before))
    scale = max(1.0, min(r.cost for _, r in ranked) / before.count)
    noise = DETECTION_EXCESS if before.chi2_per_dof <= DETECTION_EXCESS else 1.0
    share = max(explained(before, weighed[0].fit, noise), softly.get(weighed[0].hypothesis.key, 0.0))
    return Round(before, tuple(weighed), tuple(scores), scale, min(share, 1.0))
