"""From a discrepancy to causes: detect, score, refit, compare, look again, stop.

Each round screens every hypothesis at every place against the current model, refits the few that
explain most together with the baseline and all causes found before, and weighs them by their
evidence. What is left over at the end decides whether the names can be trusted: decoys for what
the catalogue lacks compete with the names, and a residual far above the noise takes probability
from all of them.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import scipy.stats

from ident.extended import Effect, Model, Prediction, along_record, as_loop, is_along_record
from ident.graybox import Parameters
from ident.hypotheses import Hypothesis, Parameter, catalogue
from ident.parallel import Workers
from ident.screening import Score, screen, signal_scale
from ident.torque_fit import (
    ANNEALING,
    Fit,
    Problem,
    Weights,
    anneal,
    fit,
    inverse,
    joint_costs,
    make_weights,
    predictions,
)

DETECTION_LEVEL = 1e-4  # p-value below which there is a discrepancy
DOUBTED_LEVEL = 1e-2  # the same where the drives that fit cannot be those of this arm
DETECTION_EXCESS = 1.10  # chi2 per degree of freedom below which it is not worth a name
RECORD_EXCESS = 1.6  # the same of a model along the record
RESTART_DAMPING = (1.0, 10.0)  # factors on the dampers from which the baseline is fitted again
DRIVE = ("stiffness", "damping", "inertia", "viscous")  # figures of a drive among the parameters
ASTRAY = 10.0  # factor between a damper and its starting guess, beyond which the gear begins again
HOPELESS = 3e3  # chi2 per degree of freedom that no damper can have caused
CLEAR_ANSWER = 0.5  # share of the excess that a linear step must explain beyond that
FAINT = 3.0  # chi2 per degree of freedom up to which what is left is searched by linear steps alone
STRONG = 30.0  # chi2 per degree of freedom above which causes are sought under softened weights
FINALISTS = 3  # candidates that are fitted to the end
FIRST_STEPS = 4  # steps after which candidates are compared for the first time
STRONG_STEPS = 10  # at most, of a strong effect under each of the softened weights
NOT_COMPUTED = (np.linalg.LinAlgError, ArithmeticError, ValueError, RuntimeError)  # a model that has no solution
ANSWERED = 0.2  # share of the excess that the best may leave after the first steps where those are enough
NEAR = 1.1  # excess over that of the best, up to which candidates are compared once more
SETTLED = 0.05  # share of the excess up to which what is left needs no second search
HOPEFUL = 5  # candidates fitted further after the first steps
AS_GOOD = 0.8  # cost of a loop over that along the record, below which it is the loop that is right
IMPLAUSIBLE = 4.0  # factor between a drive figure and its starting guess
UNTOLD = 1.0  # standard deviation of a logarithm, from which the data say nothing of a parameter
UNDETERMINED = 0.2  # relative standard deviation above which a parameter counts as not determined
HOPELESS_RATIO = 4.0  # excess, relative to the best, beyond which a candidate is dropped then
REFITS = 8  # candidates refitted in a round
REVIVED = 0.1  # of the nominal value, to which collapsed dampers are set before a fit
POLISH_STEPS = 40  # of the winner of a round
PER_EFFECT = 2  # of one effect, at most
NEAR_HINGE = 1.0 / 3.0  # screened gain of a hinge, relative to the best one, above which it is refitted too
MID_RESONANCE, MID_RATIO = 0.5, 0.05  # of a hinge that screening does not place: share of the highest resonance tried, damping
KEEP_RATIO = 0.02  # screened gain, relative to the best, below which nothing is refitted
ABSENT = 3.0  # standard deviations from its null within which a parameter counts as absent
ABSENT_LEVEL = 2.7e-3  # the same of several together, as a probability
TEMPER = 3.0  # evidence differences are divided by this: neighbouring lines share their errors
MODEL_ERROR_SHARE = 0.3  # share of the model error that a wrong hypothesis may absorb by chance
STEADY = 1e-9  # relative, of an information matrix of which an inverse is taken
POINTLESS_NATS = 5.0  # against an effect whose essential parameter is found absent
DECOY_NATS = 2.0  # an effect of the catalogue is preferred to a decoy that does as well
MIN_EVIDENCE = 25.0  # fall of the scaled cost that a cause must bring
MIN_SHARE = 0.35  # share of what is left unexplained that a cause must explain
REMATCH = 0.02  # probability from which a rival is weighed against a cause again at the end
RIVAL = 0.1  # share of what the best candidate explains, where it explains most, that makes another its rival
WORTH_A_REFIT = 0.05  # share of the excess that a screened gain must explain: linear steps understate strong effects
WORTH_A_REFIT_FAINT = 0.1  # the same where what is left is faint


@dataclass(frozen=True)
class Candidate:
    """A refitted hypothesis: the model with it, and its evidence against the others."""

    hypothesis: Hypothesis
    fit: Fit
    log_evidence: float
    probability: float = 0.0


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
        before = max(self.baseline.chi2_per_dof - 1.0, 1e-12)
        return float(np.clip((self.final.chi2_per_dof - DETECTION_EXCESS) / before, 0.0, 1.0))


def fit_baseline(
    problem: Problem, progress: Callable[[str], None] | None = None, effects: tuple[Effect, ...] = ()
) -> Fit:
    """Baseline parameters of the gray-box, with the ``effects`` that every candidate has too.

    Where the fit leaves more than the noise it is started again: with less error added from the first, which leads into
    other minima; with other dampers, which are determined far worse than springs, and do not come back once they have
    collapsed; and gears that have gone astray, as one that is overdamped and hides its spring, from their guesses.
    """
    start = Model(problem.structure, problem.nominal, effects)
    best = first = anneal(problem, start, progress=progress)

    def again(par: Parameters) -> Fit:
        """Fitted from other drives."""
        return anneal(
            problem,
            replace(best.model, par=par),
            ladder=ANNEALING[-2:],
            iterations=8,
            remainders=best.remainders,
            progress=progress,
        )

    if best.chi2_per_dof > DETECTION_EXCESS:
        other = anneal(problem, start, ladder=ANNEALING[1:], progress=progress)
        best = min(best, other, key=lambda f: (np.sum(astray(problem, f)), f.cost))
    if DETECTION_EXCESS < best.chi2_per_dof < HOPELESS:
        for factor in RESTART_DAMPING:
            par = best.model.par
            damping = np.maximum(par.damping, problem.nominal.damping) * factor
            best = min(best, again(replace(par, damping=damping)), key=lambda f: f.cost)
    lost = astray(problem, best)
    if best.chi2_per_dof > DETECTION_EXCESS and np.any(lost):
        par, guess = best.model.par, problem.nominal
        drives = {name: np.where(lost, getattr(guess, name), getattr(par, name)) for name in DRIVE}
        other = again(replace(par, **drives))
        # Where they only go astray elsewhere they stand for what is missing.
        if other.cost < best.cost and np.sum(astray(problem, other)) < np.sum(lost):
            best = other
    return replace(best, softer=first.softer)


def astray(problem: Problem, result: Fit) -> np.ndarray:
    """(n,) whether a gear has ended far from its starting guess."""
    par, guess = result.model.par, problem.nominal
    far = [np.abs(np.log(a / b)) for a, b in ((par.stiffness, guess.stiffness), (par.damping, guess.damping))]
    return (far[0] > np.log(IMPLAUSIBLE)) | (far[1] > np.log(ASTRAY))


def discrepancy_p_value(result: Fit) -> float:
    """Probability of a cost this large by noise alone (chi-square, Wilson-Hilferty in the tail)."""
    dof = max(result.count - len(result.names), 1)
    return float(scipy.stats.chi2.sf(result.cost, dof))


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
    p_value = discrepancy_p_value(baseline)
    level = DOUBTED_LEVEL if implausible(problem, baseline) else DETECTION_LEVEL
    detected = p_value < level and baseline.chi2_per_dof > DETECTION_EXCESS
    if hypotheses is None:
        # In motions alone offsets of the torque are found with the inertias of the links, as part of the baseline.
        hypotheses = catalogue(problem.structure, offsets=not problem.motions_alone)
    hypotheses = tuple(hypotheses)
    current, rounds, unknown, count = baseline, [], False, 0
    while detected and count < max_causes and not settled(current) and not workers.late:
        workers.say(f"cause {count + 1}: screening {len(hypotheses)} hypotheses")
        found = attribute_once(problem, current, hypotheses, workers)
        if not found.candidates:
            break
        found = with_name(found)
        best, before = found.candidates[0], found.before
        fall = (before.cost - best.fit.cost) / found.scale
        if fall < MIN_EVIDENCE or found.explained < MIN_SHARE:
            break
        rounds.append(found)
        count += 1
        unknown = unknown or best.hypothesis.decoy
        if best.hypothesis.decoy and not best.hypothesis.options.get("baseline"):
            break
        current = polish(problem, best.fit)
        if current.chi2_per_dof > FAINT and not best.hypothesis.decoy:
            current, more = companions(problem, current, best, hypotheses)
            rounds += more
        effects = current.model.effects
        current = plainer(problem, current, hypotheses, set())
        rounds = renamed(rounds, effects, current.model.effects)
        taken = {e.hypothesis.key for e in (*effects, *current.model.effects)}
        current = pruned(problem, current)
        # A special case of what is there already would only share its size with it.
        taken |= {(e.hypothesis.options.get("absorbs"), e.hypothesis.place) for e in current.model.effects}
        loaded = any(effect == "payload" for effect, _ in taken)
        hypotheses = tuple(h for h in hypotheses if h.key not in taken and not (loaded and h.options.get("carries_load")))
    current, rounds = rematched(problem, current, rounds, workers)
    unknown = unknown or any(outdone(r) for r in rounds)
    left = {e.hypothesis.key for e in current.model.effects}
    kept = tuple(r for r in rounds if r.candidates[0].hypothesis.decoy or r.candidates[0].hypothesis.key in left)
    return Attribution(baseline, detected, p_value, kept, current, unknown)


def with_name(found: Round) -> Round:
    """A round that a decoy has won which holds a law of the catalogue, won by that law.

    Beside causes that are still missing what sets them apart means little: the decoy is a rival again at the end.
    """
    first = found.candidates[0].hypothesis
    special = first.options.get("absorbs") if first.decoy else None
    named = [c for c in found.candidates if c.hypothesis.key == (special, first.place)]
    return replace(found, candidates=(*named, *(c for c in found.candidates if c not in named))) if named else found


def outdone(found: Round) -> bool:
    """Whether a decoy does better than the cause that a round has named."""
    best = max(found.candidates, key=lambda c: c.probability)
    return best.hypothesis.decoy and best is not found.candidates[0]


def rematched(problem: Problem, current: Fit, rounds: Sequence[Round], workers: Workers) -> tuple[Fit, list[Round]]:
    """Causes against their rivals once more, beside all that was found after them.

    In the round in which a cause is named those still missing blur what sets it apart from its rivals.
    """
    out = []
    for found in rounds:
        winner = found.candidates[0].hypothesis
        there = {e.hypothesis.key for e in current.model.effects}
        if (len(there) > 1 or outdone(found)) and winner.key in there and not winner.decoy and not workers.late:
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
    rivals = [c.fit.model.effects[-1] for c in found.candidates[1:] if c.probability > REMATCH and c.hypothesis.key not in there]

    def entered(effect: Effect) -> Fit | None:
        model = replace(current.model, effects=(*others, effect))
        return refit(problem, model, current.weights, current.remainders, POLISH_STEPS)

    entrants = [own, *rivals[:FINALISTS]] if rivals else []
    fits = workers.map_in_time(entered, entrants, lambda e: f"again: {e.hypothesis.effect} at {e.hypothesis.place}")
    ran = [Candidate(e.hypothesis, r, 0.0) for e, r in zip(entrants, fits, strict=True) if r is not None]
    if len(ran) < 2 or ran[0].hypothesis is not own.hypothesis:
        return current, found
    weighed = weigh(ran, max(min(c.fit.cost for c in ran) - current.count, 0.0))
    best = weighed[0]
    if best.hypothesis.decoy:  # it takes probability from the name, and no place in the model
        best = next(c for c in weighed if c.hypothesis is own.hypothesis)
    elif best.hypothesis is not own.hypothesis:
        current = polish(problem, best.fit)
    now = {c.hypothesis.key: c.probability for c in weighed}
    known = [replace(c, probability=now.pop(c.hypothesis.key, 0.0)) for c in found.candidates]
    known.sort(key=lambda c: (c.hypothesis.key != best.hypothesis.key, -c.probability))
    return current, replace(found, candidates=tuple(known))


def pruned(problem: Problem, current: Fit) -> Fit:
    """The model without effects of which nothing is left.

    One that stood for a part of a cause as long as that had no name is not needed beside it; and one that won only since
    the drives found a better place in its company says nothing: that place is the baseline's then.
    """
    std = dict(zip(current.names, np.sqrt(np.maximum(np.diag(current.covariance()), 0.0)), strict=True))

    def nothing(effect: Effect) -> bool:
        if pointless(effect):
            return True
        h = effect.hypothesis
        own = [(q, v, std[f"{h.effect}@{h.place}:{q.name}"]) for q, v in zip(h.parameters, effect.p, strict=True) if not q.nuisance]
        off = [abs(q.to_internal(v) - q.to_internal(q.null)) / s for q, v, s in own if q.null is not None]
        sizes = [s > (UNTOLD if q.log else 0.5 * abs(v)) for q, v, s in own if q.null is None]
        return all(sizes) if sizes else all(x < ABSENT for x in off)

    effects = current.model.effects
    needed = tuple(e for e in effects if e.hypothesis.options.get("baseline") or not nothing(e))
    if len(needed) == len(effects):
        return current
    other = polish(problem, replace(current, model=replace(current.model, effects=needed)))
    scale = max(1.0, current.cost / current.count)
    return other if other.cost - current.cost < MIN_EVIDENCE * scale else current


def settled(current: Fit) -> bool:
    """Whether a model leaves no more than noise, as far as that is known: along the record, by a few draws."""
    along = any(is_along_record(e.hypothesis) for e in current.model.effects)
    return current.chi2_per_dof <= (RECORD_EXCESS if along else DETECTION_EXCESS)


def companions(
    problem: Problem, current: Fit, winner: Candidate, hypotheses: Sequence[Hypothesis]
) -> tuple[Fit, list[Round]]:
    """The effect just named at other joints too, where at least two of them ask for it: friction of a real arm.

    Each must explain ``MIN_SHARE`` of what is left at its own joint, and all are fitted together. A single
    one is left to the next round, where it competes.

    Returns:
        The model with them, and a round for each; ``current`` and none where there are none.
    """
    effect = winner.hypothesis.effect
    same = [h for h in hypotheses if h.effect == effect and h.joint >= 0 and h.key != winner.hypothesis.key]
    if len(same) < 2:
        return current, []
    preds = predictions(problem, current.model, current.remainders)
    noise = current.count / problem.structure.n
    left = np.maximum(current.costs - noise, 1.0)
    scores = [
        s
        for s in screen(problem, current, preds, same)
        if s.start is not None and s.gain > MIN_SHARE * left[s.hypothesis.joint]
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


def renamed(rounds: Sequence[Round], before: Sequence[Effect], after: Sequence[Effect]) -> list[Round]:
    """Rounds whose winners have been replaced by their special cases, effect by effect."""
    new = {a.hypothesis.key: b.hypothesis for a, b in zip(before, after, strict=True) if a.hypothesis is not b.hypothesis}

    def of(found: Round) -> Round:
        first, *others = found.candidates
        h = new.get(first.hypothesis.key, first.hypothesis)
        return replace(found, candidates=(replace(first, hypothesis=h), *others))

    return [of(r) for r in rounds]


def plainer(problem: Problem, result: Fit, hypotheses: Sequence[Hypothesis], kept: set[tuple[str, str]]) -> Fit:
    """The model with the special case in place of effects of which the data do not show what sets them apart from it.

    Args:
        kept: keys of effects that stay as they are.
    """
    known = {h.key: h for h in hypotheses}
    std = dict(zip(result.names, np.sqrt(np.maximum(np.diag(result.covariance()), 0.0)), strict=True))

    def plain(effect: Effect) -> Effect:
        h = effect.hypothesis
        special = known.get((h.options.get("absorbs", ""), h.place))
        if h.key in kept or special is None or "apart" not in h.options:
            return effect
        hidden = h.options.get("give", lambda p: np.inf)(effect.p) < problem.q_std[h.joint]
        if std[f"{h.effect}@{h.place}:{h.options['apart']}"] < UNTOLD and not hidden:
            return effect
        return Effect(special, clip_to_bounds(special, h.options["special"](effect.p)))

    effects = tuple(plain(e) for e in result.model.effects)
    swapped = sum(a is not b for a, b in zip(effects, result.model.effects, strict=True))
    if not swapped:
        return result
    other = polish(problem, replace(result, model=replace(result.model, effects=effects)))
    same = reweighted(problem, result, other.weights)
    scale = max(1.0, same.cost / same.count)
    return other if other.cost - same.cost < swapped * MIN_EVIDENCE * scale else result


def explained(before: Fit, after: Fit, noise: float = 1.0) -> float:
    """Share of the excess over noise that a cause explains: of all of it, or at the joint where it explains most.

    Of several causes at different joints each explains a part of the whole and most of its own joint.

    Args:
        noise: of what is compared, in units of the weights: next to nothing where these bear with large errors.
    """
    falls = before.costs - after.costs
    joint = int(np.argmax(falls))
    floor = noise * before.count
    whole = np.sum(falls) / max(before.cost - floor, 1.0)
    return float(max(whole, falls[joint] / max(before.costs[joint] - floor / len(falls), 1.0)))


def revived(problem: Problem, model: Model) -> Model:
    """A model whose collapsed dampers and viscous friction are back at a size that a fit can move.

    What a missing cause has driven towards nothing has no slope left in logarithmic coordinates.
    """
    par, least = model.par, problem.nominal
    return replace(
        model,
        par=replace(
            par,
            damping=np.maximum(par.damping, REVIVED * least.damping),
            viscous=np.maximum(par.viscous, REVIVED * least.viscous),
            elastic_damping=np.maximum(par.elastic_damping, REVIVED * least.elastic_damping),
        ),
    )


def polish(problem: Problem, result: Fit) -> Fit:
    """The winner fitted to the end, under the noise that it sees itself."""
    return fit(
        problem,
        revived(problem, result.model),
        iterations=POLISH_STEPS,
        remainders=result.remainders,
    )


def soften(problem: Problem, current: Fit) -> tuple[Fit, float]:
    """The model fitted again under weights that bear with its error, and the relative error added.

    A strong cause drives the baseline far from the truth, to where no step along a single
    hypothesis leads back. With an error relative to the torque added to the noise the baseline
    stays near, and hypotheses can be compared.
    """
    stages, ladder = current.softer, ANNEALING[:-1]
    if not stages:
        start = replace(current.model, par=problem.nominal)
        last = anneal(problem, start, ladder=ladder)
        stages = (*last.softer, last)
    kept = 1
    while kept < len(stages) and stages[kept].chi2_per_dof <= STRONG:
        kept += 1
    return stages[kept - 1], ladder[kept - 1]


def attribute_once(
    problem: Problem,
    current: Fit,
    hypotheses: Sequence[Hypothesis],
    workers: Workers = Workers(),
) -> Round:
    """One round: screen all, refit the best, weigh them.

    A strong cause may have spoilt the model from which others are sought, so that none of them answers;
    candidates are then also sought from a softened model. All are compared under the same weights.
    """
    before, softly = current, {}
    found, scores = explore(problem, current, hypotheses, worth_a_refit(problem, current), workers)
    excess = max(current.cost - current.count, 1.0)
    if current.chi2_per_dof > STRONG and left_by(found) > SETTLED * excess and not workers.late:
        before, found, scores, softly = explore_softly(problem, current, found, hypotheses, workers)
    best: dict[int, tuple[Hypothesis, Fit]] = {}
    for h, result in found:
        if not pointless(result.model.effects[-1]) and (id(h) not in best or result.cost < best[id(h)][1].cost):
            best[id(h)] = h, result
    ranked = sorted(best.values(), key=lambda x: x[1].cost)
    if ranked:
        before, ranked = under_noise_of_best(problem, before, ranked, workers)
    bent = bool(ranked) and ranked[0][0].options.get("bends", False)
    spoilt = not problem.motions_alone and (bent or implausible(problem, before))
    allowed = DETECTION_EXCESS - 1.0 if spoilt else FAINT
    if min(before.chi2_per_dof - 1.0, left_by(ranked) / before.count) > allowed and not workers.late:
        before, ranked = beside_strong(problem, before, ranked, scores, workers)
    if not ranked:
        return Round(before, (), tuple(scores), 1.0, 0.0)
    rivals, excess = rivals_of_best(before, ranked)
    weighed = weigh([Candidate(h, result, 0.0) for h, result in rivals], excess)
    scale = max(1.0, min(r.cost for _, r in ranked) / before.count)
    share = max(explained(before, weighed[0].fit), softly.get(weighed[0].hypothesis.key, 0.0))
    return Round(before, tuple(weighed), tuple(scores), scale, share)


def implausible(problem: Problem, result: Fit) -> bool:
    """Whether drives of a fit cannot be those of this arm: a stiffness or motor inertia far from its starting guess.

    They then stand for what is missing.
    """
    n, x = problem.structure.n, result.model.par.to_log() - problem.nominal.to_log()
    drives = np.r_[:n, 2 * n : 3 * n]  # stiffness and motor inertia
    known = np.sqrt(np.maximum(np.diag(result.covariance())[drives], 0.0)) < UNDETERMINED
    limit = np.log(IMPLAUSIBLE)
    # A gear stiffer than the data can see ends anywhere above. Motions hardly show gears, nor a small motor beside
    # its link: there the gears take up what else is wrong, and only a motor that is known tells.
    low = x[drives] < -limit
    if problem.motions_alone:
        known[:n] = False
        low &= known
    return bool(np.any(low | (known & (x[drives] > limit))))


def worth_a_refit(problem: Problem, current: Fit) -> float:
    """Share of the excess over noise that a linear step must explain for candidates to be refitted.

    Linear steps understate strong causes, and mean little about a baseline that a strong one has spoilt:
    there only a clear answer counts. Motions leave the drives near their guesses.
    """
    if current.chi2_per_dof > HOPELESS and not problem.motions_alone:
        return CLEAR_ANSWER
    if current.chi2_per_dof > STRONG:
        return 0.0
    return WORTH_A_REFIT if current.chi2_per_dof > FAINT else WORTH_A_REFIT_FAINT


def rivals_of_best(
    before: Fit, ranked: Sequence[tuple[Hypothesis, Fit]]
) -> tuple[list[tuple[Hypothesis, Fit]], float]:
    """Candidates that explain some of what the best one does, and the excess over noise that they leave there.

    A real arm has causes at every joint: one that explains another joint is no alternative, and what is left
    there is no error of this one. A change of the chain is seen at every joint.
    """
    ranked = sorted(ranked, key=lambda x: x[1].cost)
    best, top = ranked[0]
    falls = before.costs - top.costs
    at = int(np.argmax(falls))
    if best.channel == "model" or best.joint < 0 or falls[at] <= 0.0:
        return ranked, max(top.cost - before.count, 0.0)
    kept = [(h, r) for h, r in ranked if before.costs[at] - r.costs[at] >= RIVAL * falls[at]]
    left = min(r.costs[at] for _, r in kept) - before.count / len(falls)
    return kept, max(float(left), 0.0)


def explore_softly(
    problem: Problem,
    current: Fit,
    direct: Sequence[tuple[Hypothesis, Fit]],
    hypotheses: Sequence[Hypothesis],
    workers: Workers,
) -> tuple[Fit, list[tuple[Hypothesis, Fit]], list[Score], dict[tuple[str, str], float]]:
    """Candidates sought from a softened model, and those found ``direct``, under weights of the former.

    Returns:
        The model without a new cause under these weights, candidates and scores; and by ``key`` of a hypothesis
        what it explains under softened weights: of two causes the sharp ones may see the other one alone.
    """
    stage, level = soften(problem, current)
    found, scores = explore(problem, stage, hypotheses, 0.0, workers, rough=True)
    # Of laws of which nothing is left but a special case, that one goes on.
    last = [(h, r) for h, r in found if not pointless(r.model.effects[-1])][:FINALISTS]
    softly = {h.key: explained(stage, r, noise=0.0) for h, r in last}
    preds = predictions(problem, stage.model, stage.remainders)
    sharp = make_weights(problem, preds, 0.0)
    ladder = [make_weights(problem, preds, rho) for rho in ANNEALING if 0 < rho < level]
    ways = [(h, r, (*ladder, sharp)) for h, r in last]
    ways += [(h, r, (sharp,)) for h, r in direct[:FINALISTS]]

    def sharpened(way: tuple[Hypothesis, Fit, tuple[Weights, ...]]) -> Fit | None:
        _, result, steps = way
        last = None
        for weights in steps:
            last = refit(problem, result.model, weights, result.remainders)
            result = last or result
        return last

    fits = workers.map_in_time(sharpened, ways, lambda way: f"finalist: {way[0].effect} at {way[0].place}")
    finalists = [(h, r) for (h, _, _), r in zip(ways, fits, strict=True) if r is not None]
    return reweighted(problem, current, sharp), finalists, scores, softly


def under_noise_of_best(
    problem: Problem, before: Fit, ranked: Sequence[tuple[Hypothesis, Fit]], workers: Workers
) -> tuple[Fit, list[tuple[Hypothesis, Fit]]]:
    """Candidates, and the model without them, under the noise that the best of them sees.

    Noise of the position reaches the torque through the laws of effects; weights without them would
    take it for model error. A law along the record turns all noise into a residual of its own: what is left of that
    is compared as it is, in units of its own noise, with what others leave in units of theirs.

    Args:
        ranked: candidates, best first; the first ``FINALISTS``, and those that come near the best, are fitted again.
    """
    if is_along_record(ranked[0][0]):
        return before, list(ranked)
    top = ranked[0][1]
    weights = make_weights(problem, predictions(problem, top.model, top.remainders), 0.0)

    def moved(pair: tuple[Hypothesis, Fit]) -> Fit | None:
        return None if is_along_record(pair[0]) else refit(problem, pair[1].model, weights, pair[1].remainders)

    near = sum(r.cost - r.count <= NEAR * max(top.cost - top.count, 0.0) for _, r in ranked)
    last = min(max(near, FINALISTS), HOPEFUL)
    fits = workers.map(moved, ranked[:last])
    again = [*fits, *[None] * len(ranked[last:])]
    weighed = [
        (h, r if is_along_record(h) else new or reweighted(problem, r, weights))
        for (h, r), new in zip(ranked, again, strict=True)
    ]
    return reweighted(problem, before, weights), sorted(weighed, key=lambda x: x[1].cost)


def reweighted(problem: Problem, result: Fit, weights: Weights) -> Fit:
    """A fit as it stands, its cost under other weights."""
    preds = predictions(problem, result.model, result.remainders)
    return replace(result, costs=joint_costs(problem, preds, weights), weights=weights)


def explore(
    problem: Problem,
    stage: Fit,
    hypotheses: Sequence[Hypothesis],
    least: float,
    workers: Workers,
    *,
    rough: bool = False,
) -> tuple[list[tuple[Hypothesis, Fit]], list[Score]]:
    """Candidates fitted under the weights of ``stage``, best first, and all scores.

    Args:
        least: share of the excess over noise that a linear step must explain for any to be refitted.
        rough: the first steps are enough where they answer: the candidates are fitted again.
    """
    preds = predictions(problem, stage.model, stage.remainders)
    scores = screen(problem, stage, preds, hypotheses)
    excess = max(stage.cost - stage.count, 1.0)
    answered = bool(scores) and scores[0].gain >= least * excess
    # Where nothing answers a hinge may be missing. Of a strong discrepancy that is seen from the softened model.
    allowed = ANSWERED if rough else 1.0 - MIN_SHARE if stage.chi2_per_dof <= STRONG else np.inf

    def started(score: Score) -> Fit | None:
        model = replace(stage.model, effects=extended_by(stage.model.effects, score))
        return refit(problem, model, stage.weights, stage.remainders, FIRST_STEPS)

    def finished(result: Fit) -> Fit:
        return result if result.converged else refit(problem, result.model, stage.weights, result.remainders) or result

    def begun(chosen: Sequence[Score]) -> list[tuple[Hypothesis, Fit]]:
        fits = workers.map_in_time(started, chosen, lambda s: f"refit: {s.hypothesis.effect} at {s.hypothesis.place}")
        return [(s.hypothesis, r) for s, r in zip(chosen, fits, strict=True) if r is not None]

    found = begun(choose(scores)) if answered else []
    if not problem.motions_alone and left_by(found) > allowed * excess and not workers.late:
        found += begun(hinges_everywhere(problem, preds, scores))
    found = hopeful(found)
    if not (rough and left_by(found) < ANSWERED * excess):
        last = workers.map(finished, [r for _, r in found])
        found = [(h, r) for (h, _), r in zip(found, last, strict=True)]
    return sorted(found, key=lambda x: x[1].cost), scores


def left_by(found: Sequence[tuple[Hypothesis, Fit]]) -> float:
    """Excess of the cost over noise that the best candidate leaves; infinite where there is none."""
    return min((r.cost - r.count for _, r in found), default=np.inf)


def hopeful(found: Sequence[tuple[Hypothesis, Fit]]) -> list[tuple[Hypothesis, Fit]]:
    """Candidates that a few steps have not shown to be far behind the best.

    The one that screening puts first is kept: where the drives have taken its place, as a stiffer gear takes that of
    one that yields late, the first steps lead uphill.

    Args:
        found: in the order of their scores.
    """
    ranked = sorted(found, key=lambda x: x[1].cost)
    limit = HOPELESS_RATIO * max(ranked[0][1].cost - ranked[0][1].count, 0.0) if ranked else 0.0
    kept = [
        (h, r) for i, (h, r) in enumerate(ranked[:HOPEFUL]) if i < FINALISTS or (r.cost - r.count < limit and not r.converged)
    ]
    first = [(h, r) for h, r in found[:1] if not r.converged and all(h is not k for k, _ in kept)]
    return [*kept, *first]


def refit(
    problem: Problem, model: Model, weights: Weights, remainders: Sequence[np.ndarray], iterations: int = 10
) -> Fit | None:
    """A candidate fitted from where screening put it.

    None where its model cannot be computed, or ends where the data feel no change of its last effect.
    """
    try:
        with np.errstate(over="ignore", invalid="ignore"):  # on the way to a model that cannot be computed
            result = fit(
                problem,
                revived(problem, model),
                iterations=iterations,
                weights=weights,
                remainders=remainders,
            )
    except NOT_COMPUTED:
        return None
    felt = np.diag(result.information)[-len(result.model.effects[-1].p) :]
    return result if np.any(felt > 0.0) else None


def choose(scores: Sequence[Score]) -> list[Score]:
    """The screened hypotheses worth a refit: the best, no effect more than ``PER_EFFECT`` times.

    A linear step hardly tells where a hinge is: if one is worth a refit, so are those before and after other joints
    that come near it.
    """
    out: list[Score] = []
    top = scores[0].gain if scores else 0.0
    for score in scores:
        same = sum(s.hypothesis.effect == score.hypothesis.effect for s in out)
        if score.start is None or same >= PER_EFFECT or score.gain < KEEP_RATIO * top:
            continue
        out.append(score)
        if len(out) == REFITS:
            break
    hinges = [s for s in out if "hinge" in s.hypothesis.options]
    taken = {_side(s) for s in hinges}
    for s in scores:
        if hinges and "hinge" in s.hypothesis.options and s.start is not None and s.gain >= NEAR_HINGE * hinges[0].gain:
            if _side(s) not in taken:
                taken.add(_side(s))
                out.append(s)
    return out


def _side(score: Score) -> tuple[tuple[str, str], bool]:
    """Where a hinge is."""
    return score.hypothesis.key, score.hypothesis.options["before"]


def hinges_everywhere(problem: Problem, preds: Sequence[Prediction], scores: Sequence[Score]) -> list[Score]:
    """A hinge at each place where there may be one, of a resonance within the band.

    The gears have taken up the best part of one that is missing: a linear step from there has a wrong sign, or
    answers at another joint.
    """
    middle = MID_RESONANCE * signal_scale(problem, preds, 0, ()).resonances[-1]
    hinges = [s for s in scores if "hinge" in s.hypothesis.options]
    return [replace(s, start=s.hypothesis.options["hinge"](problem.structure, problem.groups[0], middle, MID_RATIO)) for s in hinges]


def beside_strong(
    problem: Problem,
    before: Fit,
    ranked: Sequence[tuple[Hypothesis, Fit]],
    scores: Sequence[Score],
    workers: Workers,
) -> tuple[Fit, list[tuple[Hypothesis, Fit]]]:
    """Candidates, and the model without them, beside strong effects where one of those does better.

    A strong effect that is missing moves the drives to where none of its steps leads back, and with
    them the noise that the model passes on: a joint that sticks looks like one without motor inertia.
    Strong effects are therefore fitted from the starting guesses of the drives, under their own noise; laws of the
    gear along the record, where nothing depends on how a loop moves under parameters that are not right yet, and then
    as loops where these do as well.
    """

    def annealed(score: Score) -> Fit | None:
        start = Model(problem.structure, problem.nominal, extended_by(before.model.effects, score))
        try:
            with np.errstate(over="ignore", invalid="ignore"):  # on the way to a model that cannot be computed
                return anneal(problem, start, ladder=ANNEALING[1:], iterations=STRONG_STEPS)
        except NOT_COMPUTED:
            return None

    likely = min(ranked, key=lambda x: x[1].cost)[0].joint if ranked else -1
    chosen = strong_effects(problem, before, scores, likely)
    chosen = [replace(s, hypothesis=along_record(s.hypothesis)) if s.hypothesis.channel == "spring" else s for s in chosen]
    fits = workers.map_in_time(annealed, chosen, lambda s: f"strong: {s.hypothesis.effect} at {s.hypothesis.place}")
    pairs = [(s.hypothesis, r) for s, r in zip(chosen, fits, strict=True) if r and not pointless(r.model.effects[-1])]
    strong = [(h, r) for h, r in pairs if not is_along_record(h)]
    along = sorted((x for x in pairs if is_along_record(x[0]) and not implausible(problem, x[1])), key=lambda x: x[1].cost)
    strong += workers.map(lambda x: simulated(problem, *x), along[:FINALISTS])
    if not left_by(strong) < left_by(ranked):
        return before, list(ranked)
    best: dict[tuple[str, str], tuple[Hypothesis, Fit]] = {}
    for h, r in sorted(strong, key=lambda x: x[1].cost):
        best.setdefault(h.key, (h, r))
    others = [(h, r) for h, r in ranked if h.key not in best]
    return under_noise_of_best(problem, before, [*best.values(), *others], workers)


def strong_effects(problem: Problem, stage: Fit, scores: Sequence[Score], likely: int) -> list[Score]:
    """Friction and the laws of the gear, of a strong size, at a ``likely`` joint and where most of the discrepancy is.

    A gear that stiffens or softens moves its resonance with the amplitude, and a joint that sticks most
    of the time hardly shows its inertia: the linear step of a score says little about either. Motions below the
    resonances hardly show the gears.
    """
    preds = predictions(problem, stage.model, stage.remainders)
    loudest = int(np.argmax(stage.costs))
    scales = {j: signal_scale(problem, preds, j, ()) for j in {loudest, likely} if j >= 0}
    return [
        replace(s, start=s.hypothesis.options["size"](scales[s.hypothesis.joint]))
        for s in scores
        if s.hypothesis.joint in scales
        and "size" in s.hypothesis.options
        and not (problem.motions_alone and s.hypothesis.channel == "spring")
    ]


def simulated(problem: Problem, h: Hypothesis, result: Fit) -> tuple[Hypothesis, Fit]:
    """A law of the gear that was fitted along the record, as the loop that it is where that reaches the noise, or nearly.

    It does not where the arm rattles, and has several steady motions.
    """
    loop = as_loop(h)
    *others, last = result.model.effects
    model = replace(result.model, effects=(*others, replace(last, hypothesis=loop)))
    other = refit(problem, model, result.weights, result.remainders, FIRST_STEPS)
    # At the joint itself: another cause may be elsewhere.
    noise, j = result.count / problem.structure.n, h.joint
    if other is not None and other.costs[j] < max(DETECTION_EXCESS * noise, AS_GOOD * result.costs[j]):
        return loop, other
    return h, result


def extended_by(effects: Sequence[Effect], score: Score) -> tuple[Effect, ...]:
    """Effects with the hypothesis of a score, which takes the place of a special case of its own."""
    h = score.hypothesis
    special = [e for e in effects if e.hypothesis.key == (h.options.get("absorbs"), h.place)]
    start = score.start
    if special:
        start = h.options["absorb"](start, score.weights, special[0].p)
    kept = tuple(e for e in effects if not special or e.hypothesis.key != special[0].hypothesis.key)
    return (*kept, Effect(h, clip_to_bounds(h, start)))


def clip_to_bounds(h: Hypothesis, start: np.ndarray) -> np.ndarray:
    """The start of a refit within the bounds of the parameters."""
    return np.array([np.clip(v, q.lower, q.upper) for v, q in zip(start, h.parameters, strict=True)])


def weigh(candidates: Sequence[Candidate], excess: float) -> list[Candidate]:
    """Probabilities of refitted hypotheses, best first.

    Under pure noise the evidence is half the difference of the costs. What the best model leaves
    above the noise is model error, and a wrong hypothesis may absorb part of that by chance: a
    difference counts only against ``TEMPER + MODEL_ERROR_SHARE x excess``. Parameters count by how far
    the data narrow them down (``occam``).

    Args:
        excess: cost beyond noise that the best of them leaves.
    """
    cost = np.array([c.fit.cost for c in candidates])
    decoy = np.array([c.hypothesis.decoy for c in candidates], float)
    temper = TEMPER + MODEL_ERROR_SHARE / 6.0 * excess
    evidence = -0.5 * (cost - cost.min()) / temper - DECOY_NATS * decoy
    evidence += [occam(c, temper) + c.hypothesis.options.get("nats", 0.0) for c in candidates]
    evidence -= evidence.max()
    probability = np.exp(evidence) / np.exp(evidence).sum()
    out = [
        replace(c, log_evidence=float(e), probability=float(p))
        for c, e, p in zip(candidates, evidence, probability, strict=True)
    ]
    return sorted(out, key=lambda c: -c.probability)


def occam(candidate: Candidate, temper: float) -> float:
    """Log of the share of what a hypothesis allowed beforehand that the data leave to it, at most 0.

    ``-log det(1 + P L / temper) / 2`` with the spread ``P`` of its parameters before the data and their
    information ``L`` with all other coordinates free (Laplace's approximation: MacKay, Neural Comput. 4,
    1992), and the density of the values themselves where there is a prior. A parameter that the data do
    not determine costs nothing, nor does one that they find absent, unless it is what makes the effect.
    """
    effect = candidate.fit.model.effects[-1]
    ps = effect.hypothesis.parameters
    H = candidate.fit.information
    x = np.array([q.to_internal(v) for q, v in zip(ps, effect.p, strict=True)])
    nulls = np.array([np.nan if q.null is None else q.to_internal(q.null) for q in ps])
    covariance = temper * inverse(H, STEADY)[-len(ps) :, -len(ps) :]
    absent = np.abs(x - nulls) < ABSENT * np.sqrt(np.diag(covariance))
    if np.any(absent):
        # Those that the data only know together can each be at their nulls, and not all of them.
        off = (x - nulls)[absent]
        if off @ inverse(covariance[np.ix_(absent, absent)], STEADY) @ off > scipy.stats.chi2.isf(ABSENT_LEVEL, len(off)):
            absent[:] = False
    keep = np.concatenate([np.ones(len(H) - len(ps), bool), ~absent])
    count = int(np.sum(~absent))
    options = effect.hypothesis.options
    essential = any(a and q.name == options.get("essential") for q, a in zip(ps, absent, strict=True))
    nats = POINTLESS_NATS * (essential or pointless(effect))
    if count == 0:
        return -nats
    own = np.linalg.inv(inverse(H[np.ix_(keep, keep)], STEADY)[-count:, -count:])
    amplitude = np.hypot(*(v for q, v in zip(ps, effect.p, strict=True) if q.name in ("sine", "cosine"))) if _wave(ps) else 0.0
    spread = np.array(
        [q.expected_spread(amplitude if q.name in ("sine", "cosine") else v) for q, v in zip(ps, effect.p, strict=True)]
    )[~absent]
    narrowed = np.linalg.slogdet(np.eye(count) + own * np.outer(spread, spread) / temper)[1]
    stiffness = candidate.fit.model.par.stiffness[effect.hypothesis.joint]
    density = sum(((v - q.prior_center(stiffness)) / q.spread) ** 2 for q, v in zip(ps, x, strict=True))
    return float(-0.5 * narrowed - 0.5 * density - nats)


def pointless(effect: Effect) -> bool:
    """Whether the parameters of an effect leave nothing of it that another one does not hold, or all lie at a bound."""
    h = effect.hypothesis
    sizes = [(q, v) for q, v in zip(h.parameters, effect.p, strict=True) if q.log and not q.nuisance]
    at_bound = bool(sizes) and all(not q.lower * 1.01 < v < q.upper * 0.99 for q, v in sizes)
    return at_bound or bool(h.options.get("trivial", lambda p: False)(effect.p))


def _wave(parameters: Sequence[Parameter]) -> bool:
    return {"sine", "cosine"} <= {q.name for q in parameters}

