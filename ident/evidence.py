"""How far data speak for one refitted hypothesis against others."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import scipy.stats

from ident.baseline import DETECTION_EXCESS
from ident.hypotheses import Hypothesis, Parameter
from ident.model import Effect
from ident.torque_fit import Fit, inverse

ABSENT = 3.0  # standard deviations from its null within which a parameter counts as absent
ABSENT_LEVEL = 2.7e-3  # the same of several together, as a probability
TEMPER = 3.0  # evidence differences are divided by this: neighbouring lines share their errors
# the same where the model without any of them leaves noise alone, which is known by the scatter of a few periods
TEMPER_OF_NOISE = 1.5
MODEL_ERROR_SHARE = 0.3  # share of the model error that a wrong hypothesis may absorb by chance
STEADY = 1e-9  # relative, of an information matrix of which an inverse is taken
LAW_ERROR = 0.01  # share of what a cause explains that errors of its law leave
POINTLESS_NATS = 5.0  # against an effect whose essential parameters are found absent
DECOY_NATS = 2.0  # an effect of the catalogue is preferred to a decoy that does as well
WAVE = "sine", "cosine"  # amplitudes of an effect that repeats along its variable
FAR = 0.05  # of what the best candidate explains, that another leaves beyond it, from which it explains something else
RIVAL = 0.1  # share of what the best candidate explains, where it explains most, that makes another its rival


@dataclass(frozen=True)
class Candidate:
    """A refitted hypothesis: the model with it, and its evidence against the others."""

    hypothesis: Hypothesis
    fit: Fit
    log_evidence: float
    probability: float = 0.0


def explained(before: Fit, after: Fit, noise: float = 1.0) -> float:
    """Share of the excess over noise that a cause explains: of all of it, or at the joint where it explains most.

    Of several causes at different joints each explains a part of the whole and most of its own joint.

    Args:
        noise: of what is compared, in units of the weights: next to nothing where these bear with large errors, and at
            most what its estimate may be short of where no more is left.
    """
    falls = before.costs - after.costs
    joint = int(np.argmax(falls))
    floors = noise * before.counts
    whole = np.sum(falls) / max(before.cost - np.sum(floors), 1.0)
    return float(max(whole, falls[joint] / max(before.costs[joint] - floors[joint], 1.0)))


def rivals_of_best(
    before: Fit, ranked: Sequence[tuple[Hypothesis, Fit]]
) -> tuple[list[tuple[Hypothesis, Fit]], np.ndarray]:
    """Candidates that explain some of what the best one does, and the excess over noise by joint that counts as an
    error of theirs.

    A real arm has causes at every joint: one that explains another joint is no alternative, and what is left
    there is no error of this one. A change of the chain is seen at every joint.
    """
    ranked = sorted(ranked, key=lambda x: x[1].cost)
    best, top = ranked[0]
    falls = before.costs - top.costs
    at = int(np.argmax(falls))
    if best.on_chain or falls[at] <= 0.0:
        return ranked, errors_by_joint(top.costs, before.counts, float(np.sum(falls)))
    kept = [(h, r) for h, r in ranked if before.costs[at] - r.costs[at] >= RIVAL * falls[at]]
    left = top.costs.copy()
    left[at] = min(r.costs[at] for _, r in kept)
    return kept, errors_by_joint(left, before.counts, float(falls[at]))


def errors_by_joint(left: np.ndarray, counts: np.ndarray, fall: float) -> np.ndarray:
    """(n,) ``model_error`` of each joint, and at all of them a share of what is clearly left anywhere.

    What another cause leaves at its own joint blurs what candidates do there, and next to nothing of what they do
    elsewhere.

    Args:
        left: (n,) costs that the best candidate leaves, of ``counts`` data.
    """
    above = float(np.sum(np.maximum(left - DETECTION_EXCESS * counts, 0.0)))
    own = [model_error(x, k, fall) for x, k in zip(left, counts, strict=True)]
    return np.array(own) + LAW_ERROR * above


def model_error(left: float, count: float, fall: float) -> float:
    """Excess of a cost over noise that counts as an error of the law that leaves it.

    What lies within the error of the estimate of the noise counts as far as it is a ``LAW_ERROR`` of what the law
    explains; all of it where that is not known.

    Args:
        left: cost that the best candidate leaves, of ``count`` data.
        fall: of the cost, by the best candidate; not known where it is not above nothing.
    """
    within = float(np.clip(left - count, 0.0, (DETECTION_EXCESS - 1.0) * count))
    above = max(left - DETECTION_EXCESS * count, 0.0)
    return above + (min(within, LAW_ERROR * fall) if fall > 0.0 else within)


def weigh(
    candidates: Sequence[Candidate], excess: np.ndarray, falls: np.ndarray, temper: float = TEMPER
) -> list[Candidate]:
    """Probabilities of refitted hypotheses, best first.

    Under pure noise the evidence is half the difference of the costs. What the best model leaves
    above the noise is model error, and a wrong hypothesis may absorb part of that by chance: a
    difference at a joint counts only against ``temper + MODEL_ERROR_SHARE x excess`` there. Parameters count by how far
    the data narrow them down (``occam``), at the joints where the effect is seen. What explains far less than the best
    of them may be another cause, at a joint that little is left at: all that it leaves counts as at the joints of the
    best. A load and a change of the body that bears it are one body to the data but for how its inertia may turn out:
    what sets them apart at any joint counts against the model error at all of them, which reaches them all. One of which
    nothing is left that another does not hold comes after any that explains as much: it may be ahead by errors of laws
    alone, as a cable without a spring is of the friction of a motor.

    Args:
        excess: (n,) cost beyond noise by joint that the best of them leaves (``errors_by_joint``).
        falls: (n,) of the costs by joint, by the best of them.
        temper: what differences are divided by without that.
    """
    costs = np.array([c.fit.costs for c in candidates])
    decoy = np.array([c.hypothesis.decoy for c in candidates], float)
    tempers = temper + MODEL_ERROR_SHARE / 6.0 * excess
    where = np.maximum(falls, 0.0)
    where = where / np.sum(where) if np.any(where) else np.full(len(falls), 1.0 / len(falls))
    seen = 1.0 / float(np.sum(where / tempers))
    more = costs - costs[np.argmin(np.sum(costs, axis=1))]
    evidence = -0.5 * np.sum(more / tempers, axis=1)
    bears = np.array([c.hypothesis.bears_load for c in candidates])
    if np.any(bears):
        top = np.flatnonzero(bears)[np.argmin(np.sum(costs[bears], axis=1))]
        behind = np.sum(costs - costs[top], axis=1) / (temper + MODEL_ERROR_SHARE / 6.0 * np.sum(excess))
        evidence = np.where(bears, evidence[top] - 0.5 * behind, evidence)
    far = np.sum(more, axis=1) > FAR * np.sum(falls)
    evidence = np.where(far, np.minimum(evidence, -0.5 * np.sum(more, axis=1) / seen), evidence) - DECOY_NATS * decoy
    evidence += [occam(c, seen) + odds(c) for c in candidates]
    empty = np.array([last_is_pointless(c.fit) for c in candidates])
    full = ~empty & ~far & (decoy == 0.0)
    if np.any(full):
        evidence = np.where(empty, np.minimum(evidence, evidence[full].max() - POINTLESS_NATS), evidence)
    evidence -= evidence.max()
    probability = np.exp(evidence) / np.exp(evidence).sum()
    out = [
        replace(c, log_evidence=float(e), probability=float(p))
        for c, e, p in zip(candidates, evidence, probability, strict=True)
    ]
    return sorted(out, key=lambda c: -c.probability)


def odds(candidate: Candidate) -> float:
    """Log odds of a hypothesis before the data, at the values that they ask for."""
    nats = candidate.hypothesis.options.get("nats")
    return 0.0 if nats is None else float(nats(candidate.fit.model.effects[-1].p))


def occam(candidate: Candidate, temper: float) -> float:
    """Log of the share of what a hypothesis allowed beforehand that the data leave to it, at most 0.

    ``-log det(1 + P L / temper) / 2`` with the spread ``P`` of its parameters before the data and their
    information ``L`` with all other coordinates free (Laplace's approximation: MacKay, Neural Comput. 4,
    1992), and the density of the values themselves where there is a prior. A parameter that the data do
    not determine costs nothing, and one at a value that is usual no more than one that is absent. One that they find
    absent costs what they lose without it, and more where it is what makes the effect.
    """
    effect = candidate.fit.model.effects[-1]
    ps = effect.hypothesis.parameters
    H = candidate.fit.information
    x = np.array([q.to_internal(v) for q, v in zip(ps, effect.p, strict=True)])
    usual = effect.hypothesis.options.get("usual", lambda p: {})(effect.p)
    nulls = np.array(
        [np.nan if v is None else q.to_internal(v) for q, v in ((q, usual.get(q.name, q.null)) for q in ps)]
    )
    covariance = temper * inverse(H, STEADY)[-len(ps) :, -len(ps) :]
    absent = np.abs(x - nulls) < ABSENT * np.sqrt(np.diag(covariance))
    without = 0.0
    if np.any(absent):
        # Those that the data only know together can each be at their nulls, and not all of them.
        off = (x - nulls)[absent]
        without = float(off @ inverse(covariance[np.ix_(absent, absent)], STEADY) @ off)
        if without > scipy.stats.chi2.isf(ABSENT_LEVEL, len(off)):
            absent[:], without = False, 0.0
    keep = np.concatenate([np.ones(len(H) - len(ps), bool), ~absent])
    count = int(np.sum(~absent))
    options = effect.hypothesis.options
    essential = options.get("essential", ())
    nothing = bool(essential) and set(essential) <= {q.name for q, a in zip(ps, absent, strict=True) if a}
    stiffness = candidate.fit.model.par.stiffness[effect.hypothesis.joint]
    nats = POINTLESS_NATS * (nothing or pointless(effect, stiffness))
    if count == 0:
        return -0.5 * without - nats
    own = np.linalg.inv(inverse(H[np.ix_(keep, keep)], STEADY)[-count:, -count:])
    amplitude = np.hypot(*(v for q, v in zip(ps, effect.p, strict=True) if q.name in WAVE)) if is_wave(ps) else 0.0
    spread = np.array(
        [q.expected_spread(amplitude if q.name in WAVE else v) for q, v in zip(ps, effect.p, strict=True)]
    )[~absent] * options.get("of_size", lambda p: 1.0)(effect.p)
    narrowed = np.linalg.slogdet(np.eye(count) + own * np.outer(spread, spread) / temper)[1]
    density = sum(((v - q.prior_center(stiffness)) / q.spread) ** 2 for q, v in zip(ps, x, strict=True))
    return float(-0.5 * narrowed - 0.5 * density - 0.5 * without - nats)


def pointless(effect: Effect, stiffness: float) -> bool:
    """Whether the parameters of an effect leave nothing of it that another one does not hold, or all lie at a bound."""
    h = effect.hypothesis
    sizes = [(q, v) for q, v in zip(h.parameters, effect.p, strict=True) if q.log and not q.nuisance]
    at_bound = bool(sizes) and all(not q.lower * 1.01 < v < q.upper * 0.99 for q, v in sizes)
    return at_bound or bool(h.options.get("trivial", lambda p, k: False)(effect.p, stiffness))


def last_is_pointless(result: Fit) -> bool:
    """The same of the last effect of a fit."""
    effect = result.model.effects[-1]
    return pointless(effect, float(result.model.par.stiffness[effect.hypothesis.joint]))


def is_wave(parameters: Sequence[Parameter]) -> bool:
    """Whether parameters are those of a wave, with its two amplitudes."""
    return set(WAVE) <= {q.name for q in parameters}
