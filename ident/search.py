"""Candidates for a cause: screened hypotheses refitted with the baseline, from where the missing cause lets them be found.

A strong cause moves the drives to where no single step leads back. Candidates are therefore sought from the model as it
stands, from one fitted under softened weights, and strong laws from the starting guesses of the drives.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import partial

import numpy as np

from ident.baseline import DETECTION_EXCESS, HOPELESS, astray, begun_again, implausible
from ident.evidence import explained, last_is_pointless
from ident.extended import Effect, Model, Prediction, along_record, as_loop, has_rough_law, is_along_record, is_dry
from ident.hypotheses import Hypothesis
from ident.hypotheses.friction import SMOOTHING, other_turn
from ident.parallel import Workers
from ident.screening import Score, screen, signal_scale
from ident.torque_fit import (
    ANNEALING,
    NOT_COMPUTED,
    Fit,
    Problem,
    Weights,
    anneal,
    fair_costs,
    fit,
    joint_costs,
    make_weights,
    noise_costs,
    predictions,
    stepped,
    weighted_cost,
)

CLEAR_ANSWER = 0.5  # share of the excess that a linear step must explain where the baseline is hopeless
FAINT = 3.0  # chi2 per degree of freedom up to which what is left is searched from linear steps that keep the data
STRONG = 30.0  # chi2 per degree of freedom above which causes are sought under softened weights
FINALISTS = 3  # candidates that are fitted to the end
FIRST_STEPS = 4  # steps after which candidates are compared for the first time
STRONG_STEPS = 10  # at most, of a strong effect under each of the softened weights
RECOVERIES = 2  # at most, of gears gone astray beside one
RENEWALS = 3  # at most, of the noise of a law along the record under which its size is found
STRONG_GAP = 0.01  # relative fall of the cost in a step below which such a fit ends: the winner is fitted to the end
ANSWERED = 0.2  # share of the excess that the best may leave after the first steps where those are enough
NEAR = 1.1  # excess over that of the best, up to which candidates are compared once more
HOPEFUL = 5  # candidates fitted further after the first steps
RECORD_EXCESS = 1.6  # chi2 per degree of freedom up to which a model along the record leaves no more than noise
OTHER_MOTION = 10.0  # chi2 of a loop over that along the record, each in its own noise, from which it is in another motion
CLEARLY_BETTER = 0.8  # excess that a model along the record leaves, over that of one predicted whole, for it to count
HOPELESS_RATIO = 4.0  # excess, relative to the best, beyond which a candidate is dropped then
REFITS = 8  # candidates refitted in a round
REVIVED = 0.1  # of the nominal value, to which collapsed dampers are set before a fit
POLISH_STEPS = 40  # of the winner of a round
PER_EFFECT = 2  # of one effect, at most
NEAR_HINGE = 1.0 / 3.0  # screened gain of a hinge, relative to the best one, above which it is refitted too
NEAR_BODY = 1.0 / 3.0  # the same of a body's inertia, where one answers best
MID_RESONANCE, MID_RATIO = 0.425, 0.05  # of a hinge that screening does not place: over the highest line, damping
KEEP_RATIO = 0.02  # screened gain, relative to the best, below which nothing is refitted
SPILT = 0.1  # share of what is left at one joint that errors of the law there leave at others
MIN_SHARE = 0.35  # share of what is left unexplained that a cause must explain
WORTH_A_REFIT = 0.05  # share of the excess that a screened gain must explain: linear steps understate strong effects


def revived(problem: Problem, model: Model) -> Model:
    """A model whose collapsed dampers and viscous friction are back at a size that a fit can move, and hinges free to turn on.

    What a missing cause has driven towards nothing has no slope left in logarithmic coordinates; a hinge that has turned far from the
    axis from which it was sought is sought from a nearer one.
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
    return fit(
        problem,
        revived(problem, result.model),
        iterations=POLISH_STEPS,
        remainders=result.remainders,
        exact=True,
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


def worth_a_refit(current: Fit) -> float:
    """Share of the excess over noise that a linear step must explain for candidates to be refitted.

    Linear steps understate strong causes, and mean little about a baseline that a strong one has spoilt:
    there only a clear answer counts.
    """
    if current.chi2_per_dof > HOPELESS:
        return CLEAR_ANSWER
    if current.chi2_per_dof > STRONG:
        return 0.0
    return WORTH_A_REFIT


def worth_a_hinge(current: Fit) -> float:
    """Share of the excess over noise that the best candidate may leave before hinges are tried everywhere.

    Where nothing answers one may be missing. Of a strong discrepancy that is seen from the softened model.
    """
    return 1.0 - MIN_SHARE if current.chi2_per_dof <= STRONG else np.inf


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
    found, scores = explore(problem, stage, hypotheses, 0.0, ANSWERED, workers, rough=True)
    # Of laws of which nothing is left but a special case, that one goes on.
    last = [(h, r) for h, r in found if not last_is_pointless(r)][:FINALISTS]
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
    return replace(result, costs=fair_costs(problem, preds, weights), weights=weights)


def explore(
    problem: Problem,
    stage: Fit,
    hypotheses: Sequence[Hypothesis],
    least: float,
    bare: float,
    workers: Workers,
    *,
    rough: bool = False,
    quiet: frozenset[int] = frozenset(),
) -> tuple[list[tuple[Hypothesis, Fit]], list[Score]]:
    """Candidates fitted under the weights of ``stage``, best first, and all scores.

    Args:
        least: share of the excess over noise that a linear step must explain for any to be refitted.
        bare: share of it that the best may leave after the first steps, beyond which hinges are tried everywhere.
        rough: the first steps are enough where they answer: the candidates are fitted again.
        quiet: joints at which what is left asks for no hinge.
    """
    preds = predictions(problem, stage.model, stage.remainders)
    scores = screen(problem, stage, preds, hypotheses)
    excess = max(stage.cost - stage.count, 1.0)
    answered = bool(scores) and scores[0].gain >= least * excess

    def started(score: Score) -> Fit | None:
        # A start that has lost the data was a step that is not linear, and a gear that hits one end of its dead band after
        # the other takes minutes to fit. A hinge that stands anywhere begins off them, and what answers best is tried from anywhere.
        anywhere = "hinge" in score.hypothesis.options or score.gain >= scores[0].gain
        most = np.inf if anywhere else STRONG * (stage.count if stage.chi2_per_dof <= FAINT else stage.cost)
        model, cost = begin(problem, stage, score)
        result = refit(problem, model, stage.weights, stage.remainders, FIRST_STEPS, most) if anywhere or cost <= most else None
        if result is not None and turned(result.model.effects[-1]) is not result.model.effects[-1]:
            return refit(problem, result.model, stage.weights, stage.remainders, FIRST_STEPS) or result
        return result

    def finished(result: Fit) -> Fit:
        last = result if result.converged else refit(problem, result.model, stage.weights, result.remainders) or result
        return either_turn(problem, last, last.model.effects[-1])

    def begun(chosen: Sequence[Score]) -> list[tuple[Hypothesis, Fit]]:
        fits = workers.map_in_time(started, chosen, lambda s: f"refit: {s.hypothesis.effect} at {s.hypothesis.place}")
        return [(s.hypothesis, r) for s, r in zip(chosen, fits, strict=True) if r is not None]

    chosen = choose(scores) if answered else []
    found = begun(chosen)
    if not workers.late:
        found += begun(other_bodies(found, chosen, scores))
    # Where little is left gears have taken up a missing hinge, and another hypothesis most of the rest; a law along the
    # record, or under which a record may be in another steady motion, leaves that much itself.
    seen = np.setdiff1d(np.arange(len(stage.counts)), list(quiet))
    allowed = (DETECTION_EXCESS - 1.0) * np.sum(stage.counts[seen])
    unclear = stage.chi2_per_dof <= FAINT and not has_rough_law(stage.model) and left_by(found, seen) > allowed
    if not problem.motions_alone and (unclear or left_by(found) > bare * excess) and not workers.late:
        found += begun(hinges_everywhere(problem, preds, scores))
    found = hopeful(found)
    if not (rough and left_by(found) < ANSWERED * excess):
        last = workers.map(finished, [r for _, r in found])
        found = [(h, r) for (h, _), r in zip(found, last, strict=True)]
    return sorted(found, key=lambda x: x[1].cost), scores


def begin(problem: Problem, stage: Fit, score: Score) -> tuple[Model, float]:
    """The model with a screened hypothesis, what is fitted already as it is or after the step that goes with it: whichever costs less; and its cost.

    Where drives have taken the place of a cause, as a stiffer gear takes that of one that yields late, the cause beside them
    as they are is far from the data.
    """
    models = [stage.model] if score.step is None else [stage.model, stepped(problem, stage.model, score.step)]
    models = [replace(m, effects=extended_by(m.effects, score)) for m in models]

    def cost(model: Model) -> float:
        try:
            with np.errstate(over="ignore", invalid="ignore"):  # of a model that cannot be computed
                found = weighted_cost(problem, predictions(problem, model, stage.remainders), stage.weights)
        except NOT_COMPUTED:
            return np.inf
        return found if np.isfinite(found) else np.inf

    costs = [cost(m) for m in models]
    best = int(np.argmin(costs))
    return models[best], costs[best]


def left_by(found: Sequence[tuple[Hypothesis, Fit]], joints: np.ndarray | slice = slice(None)) -> float:
    """Excess of the cost over noise that the best candidate leaves, at some ``joints`` or all; infinite where there is none."""
    return min((float(np.sum((r.costs - r.counts)[joints])) for _, r in found), default=np.inf)


def hopeful(found: Sequence[tuple[Hypothesis, Fit]]) -> list[tuple[Hypothesis, Fit]]:
    """Candidates that a few steps have not shown to be far behind the best.

    The one that screening puts first is kept: where the drives have taken its place, as a stiffer gear takes that of
    one that yields late, the first steps lead uphill. So is the special case of a law that is kept, which does less by what the
    law has beyond it: where that is noise, it is the special case that is right.

    Args:
        found: in the order of their scores.
    """
    ranked = sorted(found, key=lambda x: x[1].cost)
    limit = HOPELESS_RATIO * max(ranked[0][1].cost - ranked[0][1].count, 0.0) if ranked else 0.0
    kept = [
        (h, r) for i, (h, r) in enumerate(ranked[:HOPEFUL]) if i < FINALISTS or (r.cost - r.count < limit and not r.converged)
    ]
    first = [(h, r) for h, r in found[:1] if not r.converged and all(h is not k for k, _ in kept)]
    kept += first
    special = {(h.options.get("absorbs"), h.place) for h, _ in kept}
    return [*kept, *((h, r) for h, r in ranked if h.key in special and all(h is not k for k, _ in kept))]


def refit(
    problem: Problem,
    model: Model,
    weights: Weights,
    remainders: Sequence[np.ndarray],
    iterations: int = 10,
    most: float = np.inf,
) -> Fit | None:
    """A candidate fitted from where screening put it.

    None where its model cannot be computed, costs more than ``most`` at the start, or ends where the data feel no change
    of its last effect, if it has any.
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
            )
    except NOT_COMPUTED:
        return None
    if not result.model.effects:
        return result
    felt = np.diag(result.information)[-len(result.model.effects[-1].p) :]
    return result if np.any(felt > 0.0) else None


def either_turn(problem: Problem, result: Fit, effect: Effect, iterations: int = 10) -> Fit:
    """A fit with one of its effects, a dry friction that turns at once, as one that turns within a velocity that is seen, or the other
    way round, where that costs less; no step of a fit leads from one to the other. As it is where the effect is another one."""
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


def choose(scores: Sequence[Score]) -> list[Score]:
    """The screened hypotheses worth a refit: the best, no effect more than ``PER_EFFECT`` times.

    A linear step hardly tells where a hinge is: if one is worth a refit, so are those before and after other joints
    that come near it.
    """
    out: list[Score] = []
    top = scores[0].gain if scores else 0.0
    for score in scores:
        same = sum(s.hypothesis.effect == score.hypothesis.effect for s in out)
        if score.start is None or same == PER_EFFECT or score.gain < KEEP_RATIO * top:
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


def other_bodies(found: Sequence[tuple[Hypothesis, Fit]], tried: Sequence[Score], scores: Sequence[Score]) -> list[Score]:
    """Bodies not yet ``tried`` whose inertia a linear step puts near the best of them, where that of some body answers best.

    What one link weighs more another does nearly as well: linear steps tell hardly which of them it is.
    """
    if not found or "body" not in min(found, key=lambda x: x[1].cost)[0].options:
        return []
    bodies = [s for s in scores if "body" in s.hypothesis.options and s.start is not None]
    return [s for s in bodies if all(s is not t for t in tried) and s.gain >= NEAR_BODY * bodies[0].gain]


def hinges_everywhere(problem: Problem, preds: Sequence[Prediction], scores: Sequence[Score]) -> list[Score]:
    """A hinge at each place where there may be one, of a resonance within the band.

    The gears have taken up the best part of one that is missing: a linear step from there has a wrong sign, or
    answers at another joint.
    """
    middle = MID_RESONANCE * signal_scale(problem, preds, 0, ()).highest_line
    hinges = [s for s in scores if "hinge" in s.hypothesis.options]
    return [
        replace(s, start=s.hypothesis.options["hinge"](problem.structure, problem.groups[0], middle, MID_RATIO), step=None)
        for s in hinges
    ]


def beside_strong(
    problem: Problem,
    before: Fit,
    ranked: Sequence[tuple[Hypothesis, Fit]],
    scores: Sequence[Score],
    workers: Workers,
    quiet: frozenset[int] = frozenset(),
) -> tuple[Fit, list[tuple[Hypothesis, Fit]]]:
    """Candidates, and the model without them, beside strong effects where one of those does better.

    A strong effect that is missing moves the drives to where none of its steps leads back, and with
    them the noise that the model passes on: a joint that sticks looks like one without motor inertia.
    Strong effects are therefore fitted from the starting guesses of the drives, under their own noise; laws of the
    gear along the record, where nothing depends on how a loop moves under parameters that are not right yet, and then
    as loops where these do as well. Those at the joint of the best candidate come first, and last where its own law leaves
    noise alone.

    Args:
        quiet: joints at which none is sought.
    """

    def annealed(score: Score) -> Fit | None:
        start = Model(problem.structure, problem.nominal, extended_by(before.model.effects, score))
        try:
            with np.errstate(over="ignore", invalid="ignore"):  # on the way to a model that cannot be computed
                last = recovered(problem, anneal(problem, start, ladder=ANNEALING[1:], iterations=STRONG_STEPS, gap=STRONG_GAP))
                return either_turn(problem, last, last.model.effects[-1])
        except NOT_COMPUTED:
            return None

    top = min(ranked, key=lambda x: x[1].cost)[0] if ranked else None
    likely, key = (top.joint, top.key) if top else (-1, None)
    chosen = strong_effects(problem, before, scores, likely, quiet)
    chosen = [replace(s, hypothesis=along_record(s.hypothesis)) if s.hypothesis.channel == "spring" else s for s in chosen]
    pairs: list[tuple[Hypothesis, Fit]] = []
    for here in (True, False):
        some = [s for s in chosen if (s.hypothesis.joint == likely) == here]
        fits = workers.map_in_time(annealed, some, lambda s: f"strong: {s.hypothesis.effect} at {s.hypothesis.place}")
        pairs += [(s.hypothesis, r) for s, r in zip(some, fits, strict=True) if r and not last_is_pointless(r)]
        if any(h.key == key and settled(r) for h, r in pairs):
            break
    strong = [(h, r) for h, r in pairs if not is_along_record(h)]
    along = sorted((x for x in pairs if is_along_record(x[0]) and not implausible(problem, x[1], [x[0].joint])), key=lambda x: x[1].cost)
    again = workers.map(lambda x: under_its_noise(problem, x[1]), along[:FINALISTS])
    along = [(h, r) for (h, _), r in zip(along[:FINALISTS], again, strict=True)]
    told = workers.map(lambda x: simulated(problem, *x), along)
    right = [r for (_, r), (h, _) in zip(along, told, strict=True) if not is_along_record(h)]
    strong += [(h, r) for h, r in told if not (is_along_record(h) and outdone_along(problem, h.joint, r, right))]
    if any(is_along_record(h) for h, _ in strong):
        own = workers.map(partial(under_own_noise, problem), [r for h, r in (*strong, *ranked) if not is_along_record(h)])
        whole = [r for r in own if r is not None]
        strong = [(h, r) for h, r in strong if not (is_along_record(h) and matched(problem, h.joint, r, whole))]
    if not left_by(strong) < left_by(ranked):
        return before, list(ranked)
    best: dict[tuple[str, str], tuple[Hypothesis, Fit]] = {}
    for h, r in sorted(strong, key=lambda x: x[1].cost):
        best.setdefault(h.key, (h, r))
    others = [(h, r) for h, r in ranked if h.key not in best]
    return under_noise_of_best(problem, before, [*best.values(), *others], workers)


def under_its_noise(problem: Problem, result: Fit) -> Fit:
    """A fit along the record, of a law at joints where much is left, under the noise that it sees where it ends, once and again.

    That noise is of the size of the law, and the size is found under it.
    """
    j = result.model.effects[-1].hypothesis.joint
    for _ in range(RENEWALS):
        if result.costs[j] <= RECORD_EXCESS * result.counts[j]:
            return result
        try:
            with np.errstate(over="ignore", invalid="ignore"):  # on the way to a model that cannot be computed
                other = fit(problem, revived(problem, result.model), iterations=STRONG_STEPS, remainders=result.remainders)
        except NOT_COMPUTED:
            return result
        if not other.costs[j] < result.costs[j]:
            return result
        result = other
    return result


def recovered(problem: Problem, result: Fit) -> Fit:
    """A fit of a strong effect, gears that have gone astray on the way begun again from their guesses as long as that does better.

    Where an effect is not yet of its size they take up what it leaves, and do not come back.
    """
    for _ in range(RECOVERIES):
        lost = astray(problem, result)
        if result.chi2_per_dof <= DETECTION_EXCESS or not np.any(lost):
            return result
        model = replace(result.model, par=begun_again(problem, result.model.par, lost))
        other = anneal(problem, model, ladder=ANNEALING[-2:], iterations=STRONG_STEPS, gap=STRONG_GAP, remainders=result.remainders)
        if not other.cost < CLEARLY_BETTER * result.cost:
            return result
        result = other
    return result


def strong_effects(
    problem: Problem, stage: Fit, scores: Sequence[Score], likely: int, quiet: frozenset[int] = frozenset()
) -> list[Score]:
    """Friction and the laws of the gear, of a strong size, at a ``likely`` joint and where most of the discrepancy is.

    None at joints that are ``quiet``: where most of it is at one of these, the next joint takes its place if it has ``SPILT`` of that.

    A gear that stiffens or softens moves its resonance with the amplitude, and a joint that sticks most
    of the time hardly shows its inertia: the linear step of a score says little about either. Motions below the
    resonances hardly show the gears.
    """
    preds = predictions(problem, stage.model, stage.remainders)
    excess = stage.costs - stage.counts
    loud = set(np.flatnonzero(excess >= SPILT * excess.max()).tolist()) - quiet
    loudest = max(loud, key=lambda j: stage.costs[j], default=-1)
    scales = {j: signal_scale(problem, preds, j, ()) for j in {loudest, likely} - quiet if j >= 0}
    return [
        replace(s, start=s.hypothesis.options["size"](scales[s.hypothesis.joint]))
        for s in scores
        if s.hypothesis.joint in scales
        and "size" in s.hypothesis.options
        and not (problem.motions_alone and s.hypothesis.channel == "spring")
    ]


def settled(current: Fit) -> bool:
    """Whether a model leaves no more than noise, as far as that is known: along the record, by a few draws.

    There the noise of one joint is taken large for all of them, so that each must leave no more.
    """
    if any(is_along_record(e.hypothesis) for e in current.model.effects):
        return bool(np.all(current.costs <= RECORD_EXCESS * current.counts))
    return current.chi2_per_dof <= DETECTION_EXCESS


def matched(problem: Problem, joint: int, along: Fit, whole: Sequence[Fit]) -> bool:
    """Whether a model that is predicted whole leaves noise at a joint, or about what one along the record leaves.

    Noise along the record is taken large for all joints, which flatters the model that it is taken for, most of all where
    another cause is missing. Both are seen in that noise, each less what its own noise is in those units; not where the whole one is
    far off in its own: much is within noise that is large enough.

    Args:
        whole: fits of models that are predicted whole, each under the noise that it sees itself.
    """
    if not whole:
        return False
    best = min(whole, key=lambda r: r.costs[joint])
    if best.costs[joint] <= DETECTION_EXCESS * best.counts[joint]:
        return True
    if best.costs[joint] > OTHER_MOTION * max(along.costs[joint], along.counts[joint]):
        return False
    left = max(along.costs[joint] - along.counts[joint], 0.0)
    return bool(left >= CLEARLY_BETTER * excess_under(problem, joint, best, along.weights))


def excess_under(problem: Problem, joint: int, result: Fit, weights: Weights) -> float:
    """Cost of a fit at a joint under other weights, less what its own noise is in those units."""
    costs = joint_costs(problem, predictions(problem, result.model, result.remainders), weights)
    return float(costs[joint] - noise_costs(problem, result.weights, weights)[joint])


def outdone_along(problem: Problem, joint: int, along: Fit, right: Sequence[Fit]) -> bool:
    """Whether a model along the record leaves no less at a joint than one along it whose law is right as a loop too.

    What the record tells both of them is no merit of a law that is right along it alone. Both are seen in the noise of the
    former, each less what its own noise is in those units, as in ``matched``. One that leaves clearly more in its own noise
    is not right: a hardening gear that rattles makes so much of the noise that anything is within it.

    Args:
        right: fits along the record of models with such laws.
    """
    left = max(along.costs[joint] - along.counts[joint], 0.0)
    others = [r for r in right if r.model.effects[-1].hypothesis.joint == joint and r.costs[joint] <= along.costs[joint] / CLEARLY_BETTER]
    return any(excess_under(problem, joint, r, along.weights) <= left for r in others)


def under_own_noise(problem: Problem, result: Fit) -> Fit | None:
    """A fit as it stands, its cost under the noise that its own model sees; None where drives gone astray make that infinite."""
    try:
        with np.errstate(over="ignore", invalid="ignore"):
            preds = predictions(problem, result.model, result.remainders)
            return reweighted(problem, result, make_weights(problem, preds, 0.0))
    except NOT_COMPUTED:
        return None


def simulated(problem: Problem, h: Hypothesis, result: Fit) -> tuple[Hypothesis, Fit]:
    """A law of the gear that was fitted along the record, as the loop that it is where that leaves noise, or no more than along the record.

    It does not where the arm rattles, and has several steady motions: then the loop is far off in its own noise, however large that
    along the record. Both are seen in the latter, each less what its own noise is in those units, as in ``matched``.
    """
    loop = as_loop(h)
    *others, last = result.model.effects
    model = replace(result.model, effects=(*others, replace(last, hypothesis=loop)))
    other = refit(problem, model, result.weights, result.remainders, FIRST_STEPS)
    # At the joint itself: another cause may be elsewhere.
    j = h.joint
    own = None if other is None else under_own_noise(problem, other)
    if own is None or own.costs[j] > OTHER_MOTION * max(result.costs[j], result.counts[j]):
        return h, result
    left = max(result.costs[j] - result.counts[j], (DETECTION_EXCESS - 1.0) * result.counts[j])
    return (h, result) if excess_under(problem, j, own, result.weights) > left else (loop, other)


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
