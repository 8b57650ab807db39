"""Candidates for a cause: screened hypotheses refitted with the baseline, from where the missing cause lets them be
found.

A strong cause moves the drives to where no single step leads back. Candidates are therefore sought from the model as it
stands, from one fitted under softened weights, and strong laws from the starting guesses of the drives.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TypeVar

import numpy as np

from ident.afresh import PLACES, RATIO, sought_afresh
from ident.baseline import DETECTION_EXCESS, FAINT, HOPELESS, bent
from ident.coordinates import stepped
from ident.costs import weighted_cost
from ident.evidence import explained, last_is_pointless
from ident.extended import Prediction
from ident.hypotheses import Hypothesis
from ident.model import Model, has_loop, is_along_record
from ident.parallel import Workers
from ident.problem import NOT_COMPUTED, Problem, Weights, predictions
from ident.refits import (
    FINALISTS,
    FIRST_STEPS,
    either_turn,
    extended_by,
    left_by,
    refit,
    reweighted,
    to_compete,
    turned,
)
from ident.screening import Score, screen, signal_scale
from ident.thinning import on_few, thinned
from ident.torque_fit import ANNEALING, Fit, anneal
from ident.weights import make_weights

T = TypeVar("T")

CLEAR_ANSWER = 0.5  # share of the excess that a linear step must explain where the baseline is hopeless
STRONG = 30.0  # chi2 per degree of freedom above which causes are sought under softened weights
ANSWERED = 0.2  # share of the excess that the best may leave after the first steps where those are enough
NEAR = 1.1  # excess over that of the best, up to which candidates are compared once more
HARDLY = 0.02  # share of the excess that the best must explain after the first steps for any to be fitted further
HOPEFUL = 5  # candidates fitted further after the first steps
HOPELESS_RATIO = 4.0  # excess, relative to the best, beyond which a candidate is dropped then
REFITS = 8  # candidates of the catalogue refitted in a round
DECOYS = 4  # decoys, at most
PER_EFFECT = 2  # of one effect, at most
NEAR_HINGE = 1.0 / 3.0  # screened gain of a hinge, relative to the best one, above which it is refitted too
NEAR_BODY = 1.0 / 3.0  # the same of a body's inertia, where one answers best
KEEP_RATIO = 0.02  # screened gain, relative to the best, below which nothing is refitted
MIN_SHARE = 0.35  # share of what is left unexplained that a cause must explain
WORTH_A_REFIT = 0.05  # share of the excess that a screened gain must explain: linear steps understate strong effects


def soften(problem: Problem, current: Fit) -> tuple[Fit, float]:
    """The model fitted again under weights that bear with its error, and the relative error added.

    A strong cause drives the baseline far from the truth, to where no step along a single
    hypothesis leads back. With an error relative to the torque added to the noise the baseline
    stays near, and hypotheses can be compared.
    """
    stages = softened(problem, current)
    kept = 1
    while kept < len(stages) and stages[kept].chi2_per_dof <= STRONG:
        kept += 1
    return stages[kept - 1], ANNEALING[kept - 1]


def softened(problem: Problem, current: Fit) -> tuple[Fit, ...]:
    """The model fitted from the starting guesses of the drives under each of the softened weights of ``ANNEALING``; as it
    is with the drives that a problem begins with, where its own cannot be those of the arm: to these they would lead
    again."""
    if bent(problem, current):
        begun = replace(current, model=replace(current.model, par=problem.begun))
        return tuple(on_few(problem, begun, rho) for rho in ANNEALING[:-1])
    if current.softer:
        return current.softer
    last = anneal(problem, replace(current.model, par=problem.nominal), ladder=ANNEALING[:-1])
    return (*last.softer, last)


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
    few = thinned(problem)
    rough = stage if few is problem else on_few(few, stage, level)
    found, scores = explore(few, rough, hypotheses, 0.0, ANSWERED, workers, rough=True)
    # Of laws of which nothing is left but a special case, that one goes on.
    last = best_named([(h, r) for h, r in found if not last_is_pointless(r)], FINALISTS, FINALISTS)
    softly = {h.key: explained(rough, r, noise=0.0) for h, r in last}
    preds = predictions(problem, stage.model, stage.remainders)
    sharp = make_weights(problem, preds, 0.0)
    ladder = [make_weights(problem, preds, rho) for rho in ANNEALING if 0 < rho < level]
    cold = None if few is problem else [None] * len(problem.groups)
    ways = [(h, r.model, cold or r.remainders, (*ladder, sharp)) for h, r in last]
    ways += [(h, r.model, r.remainders, (sharp,)) for h, r in best_named(direct, FINALISTS, FINALISTS)]
    if bent(problem, current) and not workers.late:
        ways += [(h, r.model, r.remainders, (sharp,)) for h, r in sought_afresh(problem, current, hypotheses, workers)]

    def sharpened(way: tuple[Hypothesis, Model, Sequence[np.ndarray | None], tuple[Weights, ...]]) -> Fit | None:
        _, model, remainders, steps = way
        last = None
        for weights in steps:
            last = refit(problem, model, weights, remainders)
            if last is not None:
                model, remainders = last.model, last.remainders
        return last

    fits = workers.map_in_time(sharpened, ways, lambda way: f"finalist: {way[0].effect} at {way[0].place}")
    finalists = [(h, r) for (h, *_), r in zip(ways, fits, strict=True) if r is not None]
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

    enough = to_compete(reweighted(problem, top, weights).cost, top.count)

    def moved(pair: tuple[Hypothesis, Fit]) -> Fit | None:
        h, result = pair
        return None if is_along_record(h) else refit(problem, result.model, weights, result.remainders, aim=enough)

    near = sum(r.cost - r.count <= NEAR * max(top.cost - top.count, 0.0) for _, r in ranked)
    last = min(max(near, FINALISTS), HOPEFUL)
    if before.chi2_per_dof > FAINT and top.cost - top.count > (1.0 - WORTH_A_REFIT) * (before.cost - before.count):
        last = 0  # far from an answer in any noise
    fits = workers.map_in_time(moved, ranked[:last])
    again = [*fits, *[None] * len(ranked[last:])]
    weighed = [
        (h, r if is_along_record(h) else new or reweighted(problem, r, weights))
        for (h, r), new in zip(ranked, again, strict=True)
    ]
    return reweighted(problem, before, weights), sorted(weighed, key=lambda x: x[1].cost)


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

    def told(score: Score) -> str:
        return f"refit: {score.hypothesis.effect} at {score.hypothesis.place}"

    def started(score: Score, of: Problem = problem, at: Fit = stage) -> Fit | None:
        fits = [started_at(s, of, at) for s in (score, *score.near)]
        return min((r for r in fits if r is not None), key=lambda r: r.cost, default=None)

    def started_at(score: Score, of: Problem, at: Fit) -> Fit | None:
        # A start that has lost the data was a step that is not linear, and a gear that hits one end of its dead band
        # after the other takes minutes to fit. A hinge that stands anywhere begins off them, and what answers best is
        # tried from anywhere.
        anywhere = "hinge" in score.hypothesis.options or score.gain >= scores[0].gain
        most = np.inf if anywhere else STRONG * (at.count if at.chi2_per_dof <= FAINT else at.cost)
        model, cost = begin(of, at, score)
        result = (
            refit(of, model, at.weights, at.remainders, FIRST_STEPS, most, DETECTION_EXCESS * at.count)
            if anywhere or cost <= most
            else None
        )
        if result is not None and turned(result.model.effects[-1]) is not result.model.effects[-1]:
            # On its way to another axis it creeps.
            return refit(of, result.model, at.weights, result.remainders, FIRST_STEPS) or result
        return result

    def finished(result: Fit) -> Fit:
        last = result
        if not result.converged:
            last = refit(problem, result.model, stage.weights, result.remainders, aim=enough) or result
        return either_turn(problem, last, last.model.effects[-1])

    def begun(chosen: Sequence[Score]) -> list[tuple[Hypothesis, Fit]]:
        fits = workers.map_in_time(started, chosen, told)
        return [(s.hypothesis, r) for s, r in zip(chosen, fits, strict=True) if r is not None]

    def begun_on_few(chosen: Sequence[Score]) -> list[tuple[Hypothesis, Fit]]:
        """Those of many that do best on a few records, begun there."""
        few = problem if rough else thinned(problem)
        if few is problem:
            return begun(chosen)
        there = on_few(few, stage, 0.0)
        fits = workers.map_in_time(lambda s: started(s, few, there), chosen, told)
        ranked = [(s.hypothesis, r) for s, r in zip(chosen, fits, strict=True) if r is not None]
        ranked = sorted(ranked, key=lambda x: x[1].cost)[:HOPEFUL]
        whole = workers.map_in_time(
            lambda x: refit(problem, x[1].model, stage.weights, stage.remainders, FIRST_STEPS), ranked
        )
        return [(h, r) for (h, _), r in zip(ranked, whole, strict=True) if r is not None]

    chosen = choose(scores) if answered else []
    found = begun(chosen)
    if not workers.late:
        found += begun(other_bodies(found, chosen, scores))
    # Where little is left gears have taken up a missing hinge, and another hypothesis most of the rest; a law that is
    # solved as a loop or along the record leaves that much itself.
    seen = np.setdiff1d(np.arange(len(stage.counts)), list(quiet))
    allowed = (DETECTION_EXCESS - 1.0) * np.sum(stage.counts[seen])
    unclear = (
        stage.chi2_per_dof <= FAINT
        and not any(map(has_loop, stage.model.effects))
        and left_by(found, seen) > allowed
        and not leaves_at_its_own(found, excess)
    )
    if not problem.motions_alone and (unclear or left_by(found) > bare * excess) and not workers.late:
        found += begun_on_few(hinges_everywhere(problem, preds, scores))
    found = hopeful(found)
    hardly = left_by(found) > (1.0 - HARDLY) * excess
    if not hardly and not (rough and left_by(found) < ANSWERED * excess):
        enough = to_compete(min(r.cost for _, r in found), stage.count)
        last = workers.map_in_time(finished, [r for _, r in found])
        found = [(h, new or r) for (h, r), new in zip(found, last, strict=True)]
    return sorted(found, key=lambda x: x[1].cost), scores


def leaves_at_its_own(found: Sequence[tuple[Hypothesis, Fit]], excess: float) -> bool:
    """Whether the best candidate explains most of the ``excess`` of the cost over noise, and leaves more than noise at
    its own joint alone: what its law lacks, and no hinge, which other joints would show."""
    if not found:
        return False
    h, best = min(found, key=lambda x: x[1].cost)
    left_at = np.flatnonzero(best.costs > DETECTION_EXCESS * best.counts).tolist()
    return not h.on_chain and set(left_at) <= {h.joint} and best.cost - best.count < ANSWERED * excess


def begin(problem: Problem, stage: Fit, score: Score) -> tuple[Model, float]:
    """The model with a screened hypothesis, what is fitted already as it is or after the step that goes with it:
    whichever costs less; and its cost.

    Where drives have taken the place of a cause, as a stiffer gear takes that of one that yields late, the cause beside
    them as they are is far from the data.
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


def hopeful(found: Sequence[tuple[Hypothesis, Fit]]) -> list[tuple[Hypothesis, Fit]]:
    """Candidates that a few steps have not shown to be far behind the best.

    The one that screening puts first is kept: where the drives have taken its place, as a stiffer gear takes that of
    one that yields late, the first steps lead uphill. So is the special case of a law that is kept, which does less by
    what the law has beyond it: where that is noise, it is the special case that is right.

    Args:
        found: in the order of their scores.
    """
    ranked = sorted(found, key=lambda x: x[1].cost)
    limit = HOPELESS_RATIO * max(ranked[0][1].cost - ranked[0][1].count, 0.0) if ranked else 0.0
    near = [(h, r) for h, r in best_named(ranked, HOPEFUL, HOPEFUL) if r.cost - r.count < limit and not r.converged]
    kept = best_named(ranked, FINALISTS, FINALISTS)
    kept += [(h, r) for h, r in near if all(h is not k for k, _ in kept)]
    first = [(h, r) for h, r in found[:1] if not r.converged and all(h is not k for k, _ in kept)]
    kept += first
    special = {(h.options.get("absorbs"), h.place) for h, _ in kept}
    return [*kept, *((h, r) for h, r in ranked if h.key in special and all(h is not k for k, _ in kept))]


def best_named(ranked: Sequence[tuple[Hypothesis, T]], count: int, decoys: int) -> list[tuple[Hypothesis, T]]:
    """The first ``count`` of the catalogue, of a ranking, and the first ``decoys`` before the last of them: these take
    no place of a named one."""
    decoy = np.array([h.decoy for h, _ in ranked], bool)
    before = np.cumsum(~decoy) - ~decoy  # named ones
    kept = (before < count) & (~decoy | (np.cumsum(decoy) <= decoys))
    return [pair for pair, k in zip(ranked, kept, strict=True) if k]


def choose(scores: Sequence[Score]) -> list[Score]:
    """The screened hypotheses worth a refit: the best, no effect at more than ``PER_EFFECT`` places.

    A linear step hardly tells where a hinge is: if one is worth a refit, so are those before and after other joints
    that come near it.
    """
    worth: list[tuple[Hypothesis, Score]] = []
    top = scores[0].gain if scores else 0.0
    for score in scores:
        same = len({h.place for h, _ in worth if h.effect == score.hypothesis.effect} - {score.hypothesis.place})
        if score.start is not None and same < PER_EFFECT and score.gain >= KEEP_RATIO * top:
            worth.append((score.hypothesis, score))
    out = [score for _, score in best_named(worth, REFITS, DECOYS)]
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


def other_bodies(
    found: Sequence[tuple[Hypothesis, Fit]], tried: Sequence[Score], scores: Sequence[Score]
) -> list[Score]:
    """Bodies not yet ``tried`` whose inertia a linear step puts near the best of them, where that of some body answers
    best.

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
    middle = PLACES[0] * signal_scale(problem, preds, 0, ()).highest_line
    hinges = [s for s in scores if "hinge" in s.hypothesis.options]
    return [
        replace(s, start=s.hypothesis.options["hinge"](problem.structure, problem.groups[0], middle, RATIO), step=None)
        for s in hinges
    ]
