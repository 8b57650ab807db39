"""One round of attribution: every hypothesis screened, the best refitted, and weighed."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from ident.baseline import DETECTION_EXCESS, FAINT, bent, implausible
from ident.evidence import (
    LAW_ERROR,
    TEMPER,
    TEMPER_OF_NOISE,
    Candidate,
    explained,
    last_is_pointless,
    rivals_of_best,
    weigh,
)
from ident.hypotheses import Hypothesis
from ident.parallel import Workers
from ident.problem import Problem, predictions
from ident.refits import FINALISTS, left_by, refit, reweighted, settled, under_own_noise, with_drives_anew
from ident.screening import Score, screen
from ident.search import MIN_SHARE, STRONG, best_named, explore, explore_softly, under_noise_of_best
from ident.strong import beside_strong
from ident.torque_fit import Fit

SETTLED = 0.05  # share of the excess up to which what is left needs no second search
# of what a decoy explains, that a law of the catalogue must, to take its place as long as causes are missing
NEARLY = 0.95
FAR_FROM_NOISE = 2.0  # chi2 per degree of freedom of such a law, beside a decoy that leaves noise alone
NEXT_LEAVES = 0.1  # of what the best candidate leaves, that a linear step of another cause may leave of it
# share of what a cause explains that errors of its law leave at other joints, over that at its own, at most
PASSED_ON = 10.0
TOLD_AT_LEAST = 1e-9  # fall of the cost, of causes that bring none at a joint
SPOILT = 0.3  # of the noise, left where a strong effect may have spoilt the drives, that asks for one
MIN_EVIDENCE = 25.0  # fall of the scaled cost that a cause must bring


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
        return float(np.sum(self.falls))

    @property
    def falls(self) -> np.ndarray:
        """(n,) the same by joint."""
        return self.before.costs - self.candidates[0].fit.costs


def left_share(baseline: Fit, current: Fit) -> float:
    """Share of the discrepancy of the baseline that a model leaves, 0 to 1."""
    before = max(baseline.chi2_per_dof - 1.0, 1e-12)
    return float(np.clip((current.chi2_per_dof - DETECTION_EXCESS) / before, 0.0, 1.0))


def told_share(baseline: Fit, found: Round) -> float:
    """Share of the discrepancy of the baseline that a round explains; more than 1 of one within the error of the
    noise."""
    return found.fall / max(baseline.cost - DETECTION_EXCESS * baseline.count, 1.0)


def answers(found: Round, least: float = MIN_EVIDENCE) -> bool:
    """Whether the best candidate of a round explains enough to be a cause, ``least`` of the scaled cost."""
    return bool(found.candidates) and found.fall >= least * found.scale and found.explained >= MIN_SHARE


def with_name(found: Round) -> Round:
    """A round that a decoy has won, won by the law of the catalogue that it holds, or by one that explains nearly as
    much.

    Beside causes that are still missing what sets them apart means little: the decoy is a rival again at the end. Where
    the decoy leaves noise alone none is missing, and it stays where the others leave far more.
    """
    best, *others = found.candidates
    first = best.hypothesis
    if not first.decoy or first.options.get("baseline"):
        return found
    if settled(best.fit):
        others = [c for c in others if c.fit.chi2_per_dof <= FAR_FROM_NOISE]
    named = [c for c in others if c.hypothesis.key == (first.options.get("absorbs"), first.place)]
    if not named:
        least = NEARLY * found.fall
        named = [c for c in others if not c.hypothesis.decoy and found.before.cost - c.fit.cost >= least][:1]
    return replace(found, candidates=(*named, *(c for c in found.candidates if c not in named))) if named else found


def outdone(found: Round) -> bool:
    """Whether a decoy does better than the cause that a round has named."""
    best = max(found.candidates, key=lambda c: c.probability)
    return best.hypothesis.decoy and best is not found.candidates[0]


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
    before = current
    softly: dict[tuple[str, str], float] = {}
    found, scores = explore(problem, current, hypotheses, least, bare, workers, quiet=quiet)
    excess = max(current.cost - current.count, 1.0)
    told = bool(found) and settles_its_joint(problem, current, *found[0])
    spoilt = current.chi2_per_dof > STRONG or (current.chi2_per_dof > FAINT and bent(problem, current))
    if spoilt and left_by(found) > SETTLED * excess and not told and not workers.late:
        before, found, scores, softly = explore_softly(problem, current, found, hypotheses, workers)
    best: dict[int, tuple[Hypothesis, Fit]] = {}
    for h, result in found:
        if not last_is_pointless(result) and (id(h) not in best or result.cost < best[id(h)][1].cost):
            best[id(h)] = h, result
    ranked = sorted(best.values(), key=lambda x: x[1].cost)
    if ranked:
        before, ranked = under_noise_of_best(problem, before, ranked, workers)
        ranked = begun_anew(problem, ranked, workers)
    left = leaves_much(problem, before, ranked) and not told and not workers.late
    if left and not (ranked and next_answers(problem, before, *ranked[0], hypotheses)):
        before, ranked = beside_strong(problem, before, ranked, scores, workers, quiet)
    return weighed_round(before, ranked, scores, softly)


def begun_anew(
    problem: Problem, ranked: Sequence[tuple[Hypothesis, Fit]], workers: Workers
) -> list[tuple[Hypothesis, Fit]]:
    """Candidates of which the first are ``with_drives_anew``, best first."""
    if all(r.chi2_per_dof <= FAINT for _, r in ranked[:FINALISTS]):
        return list(ranked)
    new = workers.map_in_time(lambda x: with_drives_anew(problem, x[1]), ranked[:FINALISTS])
    fits = [r if n is None or last_is_pointless(n) else n for n, (_, r) in zip(new, ranked[:FINALISTS], strict=True)]
    first = [(h, r) for (h, _), r in zip(ranked[:FINALISTS], fits, strict=True)]
    return sorted([*first, *ranked[FINALISTS:]], key=lambda x: x[1].cost)


def leaves_much(problem: Problem, before: Fit, ranked: Sequence[tuple[Hypothesis, Fit]]) -> bool:
    """Whether the best candidate leaves so much that a strong effect may be missing.

    That is anything clearly above the noise where the drives cannot be those of the arm, or where the arm may have
    several steady motions under the law of the best; else more than what is faint, and than errors of its law.
    """
    bends = bool(ranked) and "bends" in ranked[0][0].options
    return min(before.cost - before.count, left_by(ranked)) > allowed_to_stay(problem, before, bends)


def allowed_to_stay(problem: Problem, before: Fit, bends: bool) -> float:
    """Excess over noise that the best candidate may leave with no strong effect missing; ``bends``: by its law the arm
    may have several steady motions."""
    spoilt = not problem.motions_alone and (bends or implausible(problem, before))
    return SPOILT * before.count if spoilt else max(FAINT * before.count, LAW_ERROR * (before.cost - before.count))


def next_answers(
    problem: Problem, before: Fit, best: Hypothesis, result: Fit, hypotheses: Sequence[Hypothesis]
) -> bool:
    """Whether a linear step of another hypothesis explains what the best candidate leaves: that is then another cause,
    and none strong.

    Of two causes the first to be named leaves the second, which the next round finds; strong effects show little in
    linear steps.
    """
    if "bends" in best.options or best.decoy:
        return False
    others = [h for h in hypotheses if h.key != best.key and not h.decoy]
    scores = screen(problem, result, predictions(problem, result.model, result.remainders), others)
    excess = result.cost - result.count
    gain = next((s.gain for s in scores if s.start is not None), 0.0)
    return excess - gain <= max(allowed_to_stay(problem, before, False), NEXT_LEAVES * excess)


def shadows(problem: Problem, current: Fit, rounds: Sequence[Round]) -> frozenset[int]:
    """Joints at which next to nothing is left beside what a cause has explained there, all in the noise of the model as
    it is.

    Up to ``LAW_ERROR`` of it; where the errors of its law reach other joints, no more than ``PASSED_ON`` times the
    share at its own.
    """
    left = current.costs - current.counts
    out = set()
    for found in rounds:
        h = found.candidates[0].hypothesis
        if h.joint < 0:
            continue
        told = np.maximum(reweighted(problem, found.before, current.weights).costs - current.costs, TOLD_AT_LEAST)
        if left[h.joint] < LAW_ERROR * told[h.joint]:
            out.add(h.joint)
            share = np.clip(PASSED_ON * left[h.joint] / told[h.joint], 0.0, LAW_ERROR)
            out |= set() if h.on_chain else set(np.flatnonzero(left < share * told).tolist())
    return frozenset(out)


def settles_its_joint(problem: Problem, current: Fit, h: Hypothesis, result: Fit) -> bool:
    """Whether a candidate leaves no more than noise of a clear discrepancy at its own joint: what is left has another
    cause.

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
    hopefuls = best_named([(h, r) for h, r in direct if not last_is_pointless(r)], FINALISTS, FINALISTS)
    same = workers.map_in_time(lambda x: refit(problem, x[1].model, found.before.weights, x[1].remainders), hopefuls)
    known = [(c.hypothesis, c.fit) for c in found.candidates]
    new = [
        (h, r) for (h, _), r in zip(hopefuls, same, strict=True) if r is not None and all(h is not k for k, _ in known)
    ]
    if not new:
        return found
    before, ranked = under_noise_of_best(problem, found.before, sorted(known + new, key=lambda x: x[1].cost), workers)
    return weighed_round(before, ranked, scores, {})


def temper_of(before: Fit) -> float:
    """What differences of evidence are divided by, from the model without any of the candidates."""
    return TEMPER_OF_NOISE if settled(before) else TEMPER


def weighed_round(
    before: Fit,
    ranked: Sequence[tuple[Hypothesis, Fit]],
    scores: Sequence[Score],
    softly: Mapping[tuple[str, str], float],
) -> Round:
    """Candidates weighed by their evidence.

    Args:
        softly: what hypotheses explain under softened weights, by ``key``.
    """
    if not ranked:
        return Round(before, (), tuple(scores), 1.0, 0.0)
    rivals, excess = rivals_of_best(before, ranked)
    falls = before.costs - min(ranked, key=lambda x: x[1].cost)[1].costs
    weighed = weigh([Candidate(h, result, 0.0) for h, result in rivals], excess, falls, temper_of(before))
    scale = max(1.0, min(r.cost for _, r in ranked) / before.count)
    noise = DETECTION_EXCESS if before.chi2_per_dof <= DETECTION_EXCESS else 1.0
    share = max(explained(before, weighed[0].fit, noise), softly.get(weighed[0].hypothesis.key, 0.0))
    return Round(before, tuple(weighed), tuple(scores), scale, min(share, 1.0))
