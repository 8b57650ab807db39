"""Causes that raise the noise as a whole by less than its estimate errs.

The sum of squares over all lines of all joints shows a cause only where it raises that sum by more than the error of
the estimate of the noise. The response of one hypothesis is a few numbers, and known to far less: nothing but noise
explains about 20 of the cost in the best of all hypotheses, on any arm, and a tenth more noise at each of many thousand
lines no more than a tenth more of that (score test, Rao 1948; theory.md 9.3).

Where the scatter between periods does not say how the noise is spread over the lines, what noise alone explains is told
by what is left itself with its phases drawn anew, all joints of a line together: of the same spectrum and correlation,
and no response. Where it does, what the periods differ by tells whether the noise of lines and joints goes together, as
that of a clock that wanders does: then a few numbers explain much of it too, and nothing is told. The noise of positions
is in what they answer as well as in what is left: what it explains by that is told by drawing it anew.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import scipy.stats

from ident.baseline import DETECTION_EXCESS
from ident.extended import Prediction
from ident.group import Group
from ident.hypotheses import Hypothesis
from ident.model import has_rough_law, is_along_record, is_linear
from ident.noise import drifting
from ident.problem import Problem, predictions
from ident.screening import Score, most_explained, screen
from ident.torque_fit import Fit

SEEN = 32.0  # fall of the cost in a linear step, over the noise, from which a faint cause is sought
# factor on that beside a law along the record, whose noise is known by a few draws, or one under which single
ROUGH = 10.0
# records may be in another steady motion than the model
# of what the clearest explains, below which no other can be the cause: of faint ones linear steps tell nearly all
LINEAR = 0.3
DRAWS = 4  # of what noise may have left
# factor on what the best of all hypotheses explains of other phases, from which a faint cause is sought
BY_PHASES = 2.5
# share of what causes explain at a joint up to which more there may be errors of a few per cent of their laws
SHADOW = 1e-3
LATE = "_delay", "_lag"  # effects by which a channel comes late
# of a sample: what a law that is not quite that of nature puts into the timing, which all joints have in common, is no
# delay of those that show it
LEAST_LATE = 5e-3


def hidden(
    problem: Problem, current: Fit, hypotheses: Sequence[Hypothesis], told: np.ndarray
) -> tuple[tuple[Hypothesis, ...], float]:
    """Hypotheses that may be what a model leaves within its noise, none where that shows nothing but noise.

    Args:
        told: as of ``faint_scores``.

    Returns:
        The hypotheses, and about the probability that the best of all explains so much of noise alone (Bonferroni, a
        trial each).
    """
    scores = faint_scores(problem, current, hypotheses, told)
    clear, asked = beyond_noise_of_positions(problem, current, scores)
    if clear is None:
        return (), 1.0
    explained = by_noise_alone(problem, current, hypotheses)
    if explained > (SEEN if scatter_is_seen(problem) else clear.gain / BY_PHASES):
        return (), 1.0
    chance = min(1.0, len(scores) * scipy.stats.chi2.sf(clear.gain, clear.dof))
    return tuple(s.hypothesis for s in asked), float(chance)


def faint_scores(problem: Problem, current: Fit, hypotheses: Sequence[Hypothesis], told: np.ndarray) -> list[Score]:
    """What hypotheses explain beyond what laws already found may leave, best first; of those that have a place to start
    from.

    None of motions, nor beside link encoders, of which the weights follow what the model leaves. None where periods
    drift, at that joint or of the whole chain: a few numbers explain much of such noise. None at the joint of a law
    along the record, which turns noise into a signal of its own there.

    Args:
        told: (n,) fall of the cost by joint that causes have brought.
    """
    if any(g.window is not None or g.links for g in problem.groups):
        return []
    along = {e.hypothesis.joint for e in current.model.effects if is_along_record(e.hypothesis)}
    drift = set(np.flatnonzero(drifting(problem.groups)))
    hypotheses = [h for h in hypotheses if (not drift if h.on_chain else h.joint not in along | drift)]
    if not hypotheses:
        return []
    at_joints = left_by_laws(current, told)
    preds = predictions(problem, current.model, current.remainders)
    scores = in_signal(problem, current, preds, screen(problem, current, preds, hypotheses))
    return [
        s
        for s in scores
        if s.start is not None
        and s.gain > _at(s.hypothesis, at_joints, np.max(at_joints))
        and not (current.model.effects and of_timing(s, problem.sampling.sample_time))
    ]


def of_timing(score: Score, sample_time: float) -> bool:
    """Whether a hypothesis asks for a joint that is late by no more than an error of the common timing may be."""
    if score.start is None or not score.hypothesis.effect.endswith(LATE):
        return False
    return bool(score.start[0] < LEAST_LATE * sample_time)


def in_signal(problem: Problem, current: Fit, preds: Sequence[Prediction], scores: Sequence[Score]) -> list[Score]:
    """Scores of which those of linear hypotheses are no more than what these explain at rest and at lines that some
    record excites, best first; where they would be seen.

    At other lines a linear arm answers noise alone, and what noise adds there is known by as few periods as were
    recorded.
    """
    linear = [s.hypothesis for s in scores if s.gain > SEEN and is_linear(s.hypothesis)]
    if not linear:
        return list(scores)

    def there_alone(whiten: np.ndarray, group: Group) -> np.ndarray:
        signal = np.any(group.excited, axis=0)[: len(whiten)]
        signal[0] = True
        signal |= not np.any(signal[1:])  # of a record that does not say what it excites
        return whiten * signal[:, None, None]

    whiten = tuple(map(there_alone, current.weights.whiten, problem.groups))
    there = screen(problem, replace(current, weights=replace(current.weights, whiten=whiten)), preds, linear)
    most = {id(s.hypothesis): s.gain for s in there}
    least = [replace(s, gain=min(s.gain, most.get(id(s.hypothesis), s.gain))) for s in scores]
    return sorted(least, key=lambda s: -s.gain)


def scatter_is_seen(problem: Problem) -> bool:
    """Whether the scatter between periods measures the noise of all records."""
    return all(g.U_periods.shape[1] > 1 for g in problem.groups)


def by_noise_alone(problem: Problem, current: Fit, hypotheses: Sequence[Hypothesis]) -> float:
    """What the best of all hypotheses explains of noise like that of the records: the most in a few draws."""
    preds = predictions(problem, current.model, current.remainders)
    draw, rng = with_other_scatter if scatter_is_seen(problem) else with_other_phases, np.random.default_rng(DRAWS)
    draws = [
        replace(problem, groups=tuple(draw(g, p, rng) for g, p in zip(problem.groups, preds, strict=True)))
        for _ in range(DRAWS)
    ]
    return float(np.max(most_explained(problem, current, preds, hypotheses, draws)))


def beyond_noise_of_positions(
    problem: Problem, current: Fit, scores: Sequence[Score]
) -> tuple[Score | None, list[Score]]:
    """The clearest score that the noise of positions does not explain, and those that come near it."""
    left, of_noise = list(scores), dict[int, float]()
    while (clear := seen(left, current)) is not None:
        asked = [s for s in left if s.gain >= LINEAR * clear.gain]
        new = [s.hypothesis for s in asked if id(s.hypothesis) not in of_noise]
        if new:
            of_noise |= by_noise_of_positions(problem, current, new)
        beyond = [s for s in asked if s.gain > BY_PHASES * of_noise[id(s.hypothesis)]]
        if any(s is clear for s in beyond):
            return clear, beyond
        left = [s for s in left if s.gain < LINEAR * clear.gain or any(s is x for x in beyond)]
    return None, []


def by_noise_of_positions(problem: Problem, current: Fit, hypotheses: Sequence[Hypothesis]) -> dict[int, float]:
    """What each hypothesis, by ``id``, explains of noise that the positions along which it is asked hold too: the most
    in a few draws.

    A joint that hardly moves in a record answers a linear hypothesis with its noise, which is in the residual as well:
    both go together in all records, however many there are.
    """
    rng, most = np.random.default_rng(DRAWS), dict.fromkeys(map(id, hypotheses), 0.0)
    for _ in range(DRAWS):
        moved = [with_noise_drawn_anew(group, rng) for group in problem.groups]
        drawn = replace(problem, groups=tuple(group for group, _, _ in moved))
        preds = predictions(drawn, current.model, current.remainders)
        groups = tuple(
            replace(g, U=p.U + torque - np.einsum("lij,slj->sli", p.sampled_impedance, position))
            for (g, torque, position), p in zip(moved, preds, strict=True)
        )
        for score in screen(replace(problem, groups=groups), current, preds, hypotheses):
            most[id(score.hypothesis)] = max(most[id(score.hypothesis)], score.gain)
    return most


def with_noise_drawn_anew(group: Group, rng: np.random.Generator) -> tuple[Group, np.ndarray, np.ndarray]:
    """A group whose positions hold other noise, and noise of its torques and that of these positions; (S, L, n)."""

    def drawn(variance: np.ndarray) -> np.ndarray:
        both = rng.normal(size=(2, *group.U.shape)) * np.sqrt(0.5 * variance)
        both[:, :, 0] = 0.0
        return both[0] + 1j * both[1]

    torque, position = drawn(group.torque_noise), drawn(group.position_noise)
    return replace(group, Q=group.signal_share * group.Q + position), torque, position


def with_other_phases(group: Group, prediction: Prediction, rng: np.random.Generator) -> Group:
    """A group of which what a model leaves has other phases, the same of all joints at a line; the sign at the mean."""
    turn = np.exp(2j * np.pi * rng.random(group.U.shape[:2]))
    turn[:, 0] = np.where(turn[:, 0].real > 0.0, 1.0, -1.0)
    return replace(group, U=prediction.U + turn[..., None] * (group.U - prediction.U))


def with_other_scatter(group: Group, prediction: Prediction, rng: np.random.Generator) -> Group:
    """A group of which a model leaves what its periods differ by, mixed at random, of the size of the noise of their
    mean."""
    S, P = group.U_periods.shape[:2]
    mix = rng.normal(size=(S, P))
    mix -= mix.mean(axis=1, keepdims=True)
    mix /= np.linalg.norm(mix, axis=1, keepdims=True) * np.sqrt(P)
    U, Q = (np.einsum("sp,splj->slj", mix, x) for x in (group.U_periods, group.Q_periods))
    passed_on = np.einsum("lij,slj->sli", prediction.sampled_impedance, Q)
    return replace(group, U=prediction.U + U - passed_on)


def left_by_laws(current: Fit, told: np.ndarray) -> np.ndarray:
    """Cost by joint (n,) that errors of the laws of causes already found may leave, in proportion to what causes
    explain there.

    Such errors show at the joint of their cause first. Elsewhere they leave no larger share than there, as far as the
    noise there is known; a change of the chain has no such joint.

    Args:
        told: (n,) fall of the cost by joint that causes have brought.
    """
    told = np.maximum(told, 0.0)
    causes = [e.hypothesis for e in current.model.effects]
    own = sorted({h.joint for h in causes})
    share = np.full(len(told), SHADOW)
    if own and not any(h.on_chain for h in causes):
        above = np.maximum(current.costs - current.counts, 0.0) + (DETECTION_EXCESS - 1.0) * current.counts
        seen_there = max(float(above[j] / max(told[j], 1e-300)) for j in own)
        share[np.setdiff1d(np.arange(len(told)), own)] = min(SHADOW, seen_there)
    return share * told


def seen(scores: Sequence[Score], current: Fit) -> Score | None:
    """The clearest score, if noise does not come near it by chance, nor noise that was estimated too small at its
    joint."""
    whole = max(1.0, current.chi2_per_dof)
    by_joint = np.maximum(current.costs / np.maximum(current.counts, 1.0), whole)
    least = SEEN * (ROUGH if has_rough_law(current.model) else 1.0)
    return next((s for s in scores if s.gain > least * _at(s.hypothesis, by_joint, whole)), None)


def _at(h: Hypothesis, by_joint: np.ndarray, whole: float) -> float:
    return float(whole if h.on_chain else by_joint[h.joint])
