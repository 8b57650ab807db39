"""Strong effects, sought from the starting guesses of the drives, and laws of the gear along the record against those
that are predicted whole."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import replace
from functools import partial

import numpy as np

from ident.baseline import DETECTION_EXCESS, astray, begun_again, bent, implausible
from ident.costs import joint_costs, noise_costs
from ident.evidence import last_is_pointless
from ident.hypotheses import Hypothesis
from ident.model import Model, along_record, as_loop, is_along_record
from ident.parallel import Workers
from ident.problem import NOT_COMPUTED, Problem, Weights, predictions
from ident.refits import (
    FINALISTS,
    FIRST_STEPS,
    RECORD_EXCESS,
    either_turn,
    extended_by,
    left_by,
    refit,
    settled,
    under_own_noise,
)
from ident.screening import Score, signal_scale
from ident.search import softened, under_noise_of_best
from ident.thinning import thinned
from ident.torque_fit import ANNEALING, Fit, anneal

SOFTLY = ANNEALING[1:-1]  # errors added to the noise, relative, under which a strong effect is sought first
STRONG_STEPS = 10  # at most, of a strong effect under each of the softened weights
RECOVERIES = 2  # at most, of gears gone astray beside one
RENEWALS = 3  # at most, of the noise of a law along the record under which its size is found
STRONG_GAP = 0.01  # relative fall of the cost in a step below which such a fit ends: the winner is fitted to the end
# chi2 of a loop over that along the record, each in its own noise, from which it is in another motion
OTHER_MOTION = 10.0
CLEARLY_BETTER = 0.8  # excess that a model along the record leaves, over that of one predicted whole, for it to count
FAR_BEHIND = 1.5  # cost at its joint of a law along the record over that of the best candidate, beyond which it is out
HARDLY_LESS = 0.9  # of what is left without a strong effect under softened weights, for that to explain anything
UNANSWERED = 30.0  # chi2 per degree of freedom that the best may leave before laws of the gear are sought at all joints
ANSWERED = 0.05  # share of what the best leaves, up to which a law of the gear answers what nothing did
SPILT = 0.1  # share of what is left at one joint that errors of the law there leave at others


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
    as loops where these do as well. Those at the joint of the best candidate come first, and last where its own law
    leaves noise alone. A gear that bends turns the links of others too, and their drives with them to where any joint
    may be the loudest: where these cannot be those of the arm, and nothing answers, laws of the gear are sought at one
    joint after the other, until one answers.

    Args:
        quiet: joints at which none is sought.
    """

    annealed = partial(anneal, iterations=STRONG_STEPS, gap=STRONG_GAP, progress=workers.until_late)

    def found(score: Score) -> Fit | None:
        start = Model(problem.structure, problem.begun, extended_by(before.model.effects, score))
        try:
            with np.errstate(over="ignore", invalid="ignore"):  # on the way to a model that cannot be computed
                first = annealed(few, start, ladder=SOFTLY)
                if without and not shows_softly((*first.softer, first), without, score.hypothesis.joint):
                    return None
                there = first.remainders if few is problem else None
                first = annealed(problem, first.model, ladder=ANNEALING[-1:], remainders=there)
                last = recovered(problem, first)
                return either_turn(problem, last, last.model.effects[-1])
        except NOT_COMPUTED:
            return None

    top = min(ranked, key=lambda x: x[1].cost, default=None)
    likely, key = (top[0].joint, top[0].key) if top else (-1, None)
    loudest = loudest_joint(before, quiet)
    chosen = strong_effects(problem, before, scores, {loudest, likely} - quiet - {-1})
    few = thinned(problem)
    without = without_strong(few, before if few is problem else replace(before, softer=())) if chosen else ()

    def tried(some: Sequence[Score]) -> list[tuple[Hypothesis, Fit]]:
        some = [replace(s, hypothesis=along_record(s.hypothesis)) if is_spring(s) else s for s in some]
        fits = workers.map_in_time(found, some, lambda s: f"strong: {s.hypothesis.effect} at {s.hypothesis.place}")
        return [(s.hypothesis, r) for s, r in zip(some, fits, strict=True) if r and not last_is_pointless(r)]

    pairs = tried([s for s in chosen if s.hypothesis.joint == likely])
    if not any(h.key == key and settled(r) for h, r in pairs):
        pairs += tried([s for s in chosen if s.hypothesis.joint != likely])
    unanswered = left_by([*ranked, *pairs]) > UNANSWERED * before.count
    if chosen and unanswered and (bent(problem, before) or implausible(problem, before)) and not workers.late:
        elsewhere = set(range(problem.structure.n)) - quiet - {loudest, likely}
        laws = [s for s in strong_effects(problem, before, scores, elsewhere) if is_spring(s)]
        for joint in dict.fromkeys(s.hypothesis.joint for s in laws):  # that of the best score first
            at_joint = tried([s for s in laws if s.hypothesis.joint == joint])
            pairs += at_joint
            if left_by(at_joint) < ANSWERED * min(left_by(ranked), before.cost - before.count):
                break
    strong = proven(problem, before, pairs, ranked, workers)
    if not left_by(strong) < left_by(ranked):
        return before, list(ranked)
    best: dict[tuple[str, str], tuple[Hypothesis, Fit]] = {}
    for h, r in sorted(strong, key=lambda x: x[1].cost):
        best.setdefault(h.key, (h, r))
    others = [(h, r) for h, r in ranked if h.key not in best]
    return under_noise_of_best(problem, before, [*best.values(), *others], workers)


def proven(
    problem: Problem,
    before: Fit,
    found: Sequence[tuple[Hypothesis, Fit]],
    ranked: Sequence[tuple[Hypothesis, Fit]],
    workers: Workers,
) -> list[tuple[Hypothesis, Fit]]:
    """Strong candidates that stay: all but laws along the record that a simulated law, or a candidate without a loop,
    does as well as; each as a loop where that does as well.

    Args:
        ranked: the candidates that are not strong.
    """
    best = min((r for _, r in ranked), key=lambda r: r.cost, default=None)
    strong = [(h, r) for h, r in found if not is_along_record(h)]
    # Noise along the record is taken large: a law that leaves as much even in that as no law, or clearly more than the
    # best, is far off.
    allowed = np.minimum(before.costs, FAR_BEHIND * best.costs) if best else before.costs
    along = sorted(
        (
            (h, r)
            for h, r in found
            if is_along_record(h) and r.costs[h.joint] < allowed[h.joint] and not implausible(problem, r, [h.joint])
        ),
        key=lambda x: x[1].cost,
    )
    again = workers.map(lambda x: under_its_noise(problem, x[1]), along[:FINALISTS])
    along = [(h, r) for (h, _), r in zip(along[:FINALISTS], again, strict=True)]
    told = workers.map(lambda x: simulated(problem, *x), along)
    right = [r for (_, r), (h, _) in zip(along, told, strict=True) if not is_along_record(h)]
    strong += [(h, r) for h, r in told if not (is_along_record(h) and outdone_along(problem, h.joint, r, right))]
    if any(is_along_record(h) for h, _ in strong):
        own = workers.map(
            partial(under_own_noise, problem), [r for h, r in (*strong, *ranked) if not is_along_record(h)]
        )
        whole = [r for r in own if r is not None]
        strong = [(h, r) for h, r in strong if not (is_along_record(h) and matched(problem, h.joint, r, whole))]
    return strong


def without_strong(problem: Problem, current: Fit) -> tuple[Fit, ...]:
    """The model as it is under the weights under which strong effects are sought; none where that cannot be computed
    from the starting guesses of the drives."""
    try:
        with np.errstate(over="ignore", invalid="ignore"):  # on the way to a model that cannot be computed
            return softened(problem, current)[-len(SOFTLY) :]
    except NOT_COMPUTED:
        return ()


def shows_softly(stages: Sequence[Fit], without: Sequence[Fit], joint: int) -> bool:
    """Whether a strong effect explains anything at its own joint under weights that bear with the error of a model, or
    there is nothing to explain there.

    Args:
        stages, without: fits with the effect and without, under one of these weights each.
    """
    count = without[-1].counts[joint]
    pairs = [(r.costs[joint] - count, w.costs[joint] - count) for r, w in zip(stages, without, strict=True)]
    told = [left < HARDLY_LESS * bare for left, bare in pairs if bare > (DETECTION_EXCESS - 1.0) * count]
    return any(told) or not told


def under_its_noise(problem: Problem, result: Fit) -> Fit:
    """A fit along the record, of a law at joints where much is left, under the noise that it sees where it ends, once
    and again.

    That noise is of the size of the law, and the size is found under it.
    """
    j = result.model.effects[-1].hypothesis.joint
    for _ in range(RENEWALS):
        if result.costs[j] <= RECORD_EXCESS * result.counts[j]:
            return result
        other = refit(problem, result.model, None, result.remainders, STRONG_STEPS)
        if other is None or not other.costs[j] < result.costs[j]:
            return result
        result = other
    return result


def recovered(problem: Problem, result: Fit) -> Fit:
    """A fit of a strong effect, gears that have gone astray on the way begun again from their guesses as long as that
    does better.

    Where an effect is not yet of its size they take up what it leaves, and do not come back.
    """
    for _ in range(RECOVERIES):
        lost = astray(problem, result)
        if result.chi2_per_dof <= DETECTION_EXCESS or not np.any(lost):
            return result
        model = replace(result.model, par=begun_again(problem, result.model.par, lost))
        other = anneal(
            problem, model, ladder=ANNEALING[-2:], iterations=STRONG_STEPS, gap=STRONG_GAP, remainders=result.remainders
        )
        if not other.cost < CLEARLY_BETTER * result.cost:
            return result
        result = other
    return result


def is_spring(score: Score) -> bool:
    """Whether a hypothesis is a law of the gear."""
    return score.hypothesis.channel == "spring"


def loudest_joint(stage: Fit, quiet: frozenset[int]) -> int:
    """Where most of the discrepancy is; -1 where nowhere. Where that is at a joint that is ``quiet``, the next joint takes
    its place if it has ``SPILT`` of that."""
    excess = stage.costs - stage.counts
    loud = set(np.flatnonzero(excess >= SPILT * excess.max()).tolist()) - quiet
    return max(loud, key=lambda j: float(stage.costs[j]), default=-1)


def strong_effects(problem: Problem, stage: Fit, scores: Sequence[Score], joints: Collection[int]) -> list[Score]:
    """Friction and the laws of the gear, of a strong size, at some joints.

    A gear that stiffens or softens moves its resonance with the amplitude, and a joint that sticks most
    of the time hardly shows its inertia: the linear step of a score says little about either. Motions below the
    resonances hardly show the gears.
    """
    preds = predictions(problem, stage.model, stage.remainders)
    scales = {j: signal_scale(problem, preds, j, ()) for j in joints}
    return [
        replace(s, start=s.hypothesis.options["size"](scales[s.hypothesis.joint]))
        for s in scores
        if s.hypothesis.joint in scales
        and "size" in s.hypothesis.options
        and not (problem.motions_alone and is_spring(s))
    ]


def matched(problem: Problem, joint: int, along: Fit, whole: Sequence[Fit]) -> bool:
    """Whether a model that is predicted whole leaves noise at a joint, or about what one along the record leaves.

    Noise along the record is taken large for all joints, which flatters the model that it is taken for, most of all
    where another cause is missing. Both are seen in that noise, each less what its own noise is in those units; not
    where the whole one is far off in its own: much is within noise that is large enough, and its law along the record
    is compared in ``outdone_along``.

    Args:
        whole: fits of models that are predicted whole, each under the noise that it sees itself.
    """
    if not whole:
        return False
    best = min(whole, key=lambda r: r.costs[joint])
    if best.costs[joint] <= DETECTION_EXCESS * best.counts[joint]:
        return True
    if in_another_motion(joint, best, along):
        return False
    return bool(left_along(joint, along) >= CLEARLY_BETTER * excess_under(problem, joint, best, along.weights))


def in_another_motion(joint: int, whole: Fit, along: Fit) -> bool:
    """Whether a model with a loop in a gear is far off at a joint beside one along the record, each in its own noise.

    Without such a loop there is one steady motion, and a model that is far off is wrong or lacks a cause.
    """
    if not any(e.hypothesis.gear_law for e in whole.model.effects):
        return False
    return bool(whole.costs[joint] > OTHER_MOTION * max(along.costs[joint], along.counts[joint]))


def left_along(joint: int, along: Fit) -> float:
    """Excess of the cost over noise that a fit along the record leaves at a joint, at least what counts as none."""
    return float(max(along.costs[joint] - along.counts[joint], (DETECTION_EXCESS - 1.0) * along.counts[joint]))


def excess_under(problem: Problem, joint: int, result: Fit, weights: Weights) -> float:
    """Cost of a fit at a joint under other weights, less what its own noise is in those units."""
    costs = joint_costs(problem, predictions(problem, result.model, result.remainders), weights)
    return float(costs[joint] - noise_costs(problem, result.weights, weights)[joint])


def outdone_along(problem: Problem, joint: int, along: Fit, right: Sequence[Fit]) -> bool:
    """Whether a model along the record leaves no less at a joint than one along it whose law is right as a loop too.

    What the record tells both of them is no merit of a law that is right along it alone. Both are seen in the noise of
    the former, each less what its own noise is in those units, as in ``matched``. One that leaves clearly more in its
    own noise is not right: a hardening gear that rattles makes so much of the noise that anything is within it.

    Args:
        right: fits along the record of models with such laws.
    """
    left = left_along(joint, along)
    others = [
        r
        for r in right
        if r.model.effects[-1].hypothesis.joint == joint and r.costs[joint] <= along.costs[joint] / CLEARLY_BETTER
    ]
    return any(excess_under(problem, joint, r, along.weights) <= left for r in others)


def simulated(problem: Problem, h: Hypothesis, result: Fit) -> tuple[Hypothesis, Fit]:
    """A law of the gear that was fitted along the record, as the loop that it is where that leaves noise, or no more
    than along the record.

    It does not where the arm rattles, and has several steady motions: then the loop is far off in its own noise,
    however large that along the record. Both are seen in the latter, each less what its own noise is in those units, as
    in ``matched``.
    """
    loop = as_loop(h)
    *others, last = result.model.effects
    model = replace(result.model, effects=(*others, replace(last, hypothesis=loop)))
    other = refit(problem, model, result.weights, result.remainders, FIRST_STEPS)
    if other is None:
        return h, result
    # At the joint itself: another cause may be elsewhere.
    j = h.joint
    own = under_own_noise(problem, other)
    if own is None or in_another_motion(j, own, result):
        return h, result
    return (h, result) if excess_under(problem, j, own, result.weights) > left_along(j, result) else (loop, other)
