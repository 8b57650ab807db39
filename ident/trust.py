"""How far names can be trusted: by what is left where they sit, by held-out data, by the drives beside them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from ident.attribute import Attribution
from ident.baseline import DETECTION_EXCESS, JOINT_EXCESS, implausible
from ident.contests import SAME_PERIOD
from ident.costs import fair_costs, weighted_cost
from ident.evidence import WAVE, is_wave
from ident.extended import Prediction
from ident.faint import LATE, SHADOW
from ident.group import Group
from ident.hypotheses import Hypothesis
from ident.hypotheses.hypothesis import RIPPLE
from ident.model import Effect, is_linear
from ident.problem import NOT_COMPUTED, Problem, data_counts, predictions
from ident.pruning import UNTOLD, level
from ident.quantization import Steps
from ident.refits import settled
from ident.rounds import MIN_EVIDENCE, Round
from ident.torque_fit import Fit
from ident.verdict import LEFT_OUT, Gain, JointGain
from ident.weights import make_weights

LEFT_NOISE = 1.15  # chi2 per degree of freedom up to which the noise floor counts as reached
WORSE = 1.05  # held-out error of the extended model, over that of the baseline, that refutes it
CLEAR = 2.0  # held-out error of the baseline over the noise from which it tells
CLOSED = 0.5  # share of the gap that the extended model must then close
CARRIED = 0.8  # the same where it explains the data that it was fitted to down to the noise
ABOVE_NOISE = 1.5  # held-out error of the extended model over the noise, from which it has not carried over
SHORT = 0.25  # by which the gap closed on held-out data may fall short of what the fitted ones promise
COMES_ROUND = 1.25  # times that a ripple must come round along the path of its joint beside a spring there
FEWEST_PERIODS = 5.0  # of a ripple that motions must show in the compared band for its name to be trusted
SHADOW_OF_LAW = 0.05  # of what a law explains, below which a second one of the same element is not trusted
HARMONIC = 0.1  # the same of a ripple at a multiple of the periods of another one
# share of the discrepancy left, a third of its amplitude, at which a name is as likely wrong as right
HALF_TRUSTED = 0.1
# of the fall of the cost that a faint cause foretells on held-out data, below which it does not come
DENIED_SHARE = 0.25
CHANCE = 3.0  # standard deviations of that fall, within which it may be short by chance
SPRINGS = "gravity_spring", "dress_pack"  # of which the torque follows the position of the link
SURE = 2.0  # standard deviations of the inertia of a load, by which it is too large
LONGEST_LOAD = 1.0  # m, radius of gyration of a load, or half of the length of the arm where that is more
PATCHES = 3  # bodies and hinges other than those described, from which no name is trusted
LEFT_ERROR = 3.0  # chi2 per degree of freedom above which an unknown cause remains however strong the named ones are


def _at(h: Hypothesis, costs: np.ndarray) -> float:
    """Of costs by joint, those that an effect answers for: its joint, or all where it changes the chain."""
    return float(np.sum(costs) if h.on_chain else costs[h.joint])


def _excess(result: Fit, level: float) -> np.ndarray:
    """(n,) whitened cost of a fit by joint beyond ``level`` times the noise."""
    return np.maximum(result.costs - level * result.counts, 0.0)


def left_of(h: Hypothesis, result: Attribution) -> float:
    """Share of the discrepancy that is left where an effect sits, 0 to 1: there no other cause hides behind it.

    Where all joints together leave no more than noise, that of a single one may be known as badly as ``JOINT_EXCESS``
    says.
    """
    level = DETECTION_EXCESS if result.final.chi2_per_dof > DETECTION_EXCESS else JOINT_EXCESS
    before = _at(h, _excess(result.baseline, 1.0))
    after = _at(h, _excess(result.final, level))
    return float(np.clip(after / max(before, 1e-300), 0.0, 1.0)) if after > 0.0 else 0.0


def left_on_held_out(h: Hypothesis, gain: Gain | None) -> float:
    """Share, as power, that the extended model leaves of the error of the first one on held-out data where an effect
    sits; 0 where that is not clear of the noise.

    What stands for an unknown cause in the postures that were fitted leaves more of it in another one.
    """
    if gain is None:
        return 0.0
    at: Gain | JointGain = gain if h.on_chain or not gain.by_joint else list(gain.by_joint.values())[h.joint]
    if not at.before > CLEAR * at.noise_floor:
        return 0.0
    return float(np.clip((at.after - at.noise_floor) / (at.before - at.noise_floor), 0.0, 1.0) ** 2)


def explained_share(found: Round, final: Fit) -> float:
    """What a cause explains where it sits, over that and what is left there at the end: 1 where nothing is left.

    A cause that explains less than the unknown may be the unknown's own shadow.
    """
    winner = found.candidates[0]
    fall = max(_at(winner.hypothesis, found.before.costs - winner.fit.costs), 0.0)
    left = _at(winner.hypothesis, _excess(final, LEFT_NOISE))
    return fall / max(fall + left, 1e-300)


def is_halved(problem: Problem, gain: Gain) -> bool:
    """Whether a posture is left out of two: a model that is right is then fitted to half of what it was, and need not
    carry over as well."""
    return gain.method == LEFT_OUT and len({g.operating_point for g in problem.groups}) < 3


def fails_held_out(gain: Gain | None, final: Fit, left: float, halved: bool = False) -> bool:
    """Whether held-out data refute the extended model: no name is trusted then.

    It predicts them worse than the baseline, or leaves most of a clear error that the causes were named for;
    or it explains the data it was fitted to, and leaves more of the held-out ones than a model that is right.

    Args:
        left: share of the discrepancy, as power, that the model leaves of the data that it was fitted to.
        halved: ``is_halved``.
    """
    if gain is None:
        return False
    if gain.after > WORSE * gain.before:
        return True
    if gain.gap_closed is None or not gain.before > CLEAR * gain.noise_floor:
        return False
    if halved:
        return gain.gap_closed < CLOSED
    lost = final.chi2_per_dof < LEFT_ERROR and gain.after > ABOVE_NOISE * gain.noise_floor
    expected = 1.0 - np.sqrt(left)
    return gain.gap_closed < max(CARRIED if lost else CLOSED, expected - SHORT)


def patchwork(effects: Sequence[Effect]) -> bool:
    """Whether a model was given so many other bodies and hinges that together they stand for something else.

    Each of them shows at every joint, and a few describe most of what a chain of another kind does: an inertia between
    motor and gear was two links and a hinge.
    """
    chain = [e.hypothesis for e in effects if not e.hypothesis.decoy]
    return sum("body" in h.options or "hinge" in h.options for h in chain) >= PATCHES


def denied(problem: Problem, groups: Sequence[Group], found: Round) -> bool:
    """Whether held-out periodic data deny a cause that was named for less than the noise as a whole shows.

    A law of as many parameters as there are postures describes in these whatever another cause leaves. In a further
    posture a law that is right lowers the cost by what it changes there in units of the noise, ``E``, with a standard
    deviation of ``2 sqrt(E)``; one that is wrong need not. Where it changes little these data say nothing.

    Args:
        groups: held-out data.
    """
    periodic = tuple(g for g in groups if g.window is None)
    winner = found.candidates[0]
    if winner.hypothesis.decoy or not periodic or not settled(found.before):
        return False
    there = replace(problem, groups=periodic)
    try:
        before, after = (
            predictions(there, fit.model, [None] * len(periodic), None) for fit in (found.before, winner.fit)
        )
        weights = make_weights(there, after, 0.0)
    except NOT_COMPUTED:
        return False
    noise = max(1.0, weighted_cost(there, after, weights) / float(np.sum(data_counts(there))))
    changes = (g.observe_outputs(b.outputs() - a.outputs()) for g, a, b in zip(periodic, before, after, strict=True))
    foretold = sum(float(np.sum(np.abs(weights.apply(i, x)) ** 2)) for i, x in enumerate(changes)) / noise
    costs = [float(np.sum(fair_costs(there, x, weights))) for x in (before, after)]
    fall = (costs[0] - costs[1]) / noise
    return fall < min(DENIED_SHARE * foretold, foretold - CHANCE * 2.0 * np.sqrt(foretold))


def shown(effect: Effect, final: Fit, covariance: np.ndarray) -> bool:
    """Whether the data tell the size of what makes an effect the one that it is named, to about a factor of ``e``.

    One that makes it by exceeding another must do so beyond chance. Where each parameter has a value at which the
    effect is none, all of them together must be further from there than chance brings them (Wald 1943): a cause that has explained much while others were missing may be nothing beside
    these.
    """
    h = effect.hypothesis
    at = [final.names.index(h.coordinate(q.name)) for q in h.parameters]
    if level(final, effect, covariance):
        return False
    if "shown" in h.options:
        i = final.names.index(h.coordinate(h.options["shown"]))
        return bool(covariance[i, i] < UNTOLD**2)
    nulls = [q.null for q in h.parameters if q.null is not None]
    if len(nulls) < len(h.parameters):
        return True
    off = np.array(
        [q.to_internal(v) - q.to_internal(null) for q, v, null in zip(h.parameters, effect.p, nulls, strict=True)]
    )
    return bool(off @ np.linalg.solve(covariance[np.ix_(at, at)], off) > MIN_EVIDENCE)


def too_fast(problem: Problem, predictions: Sequence[Prediction], effect: Effect) -> bool:
    """Whether motions show less than a few periods of a ripple in the compared band: many wave numbers fit those.

    Elsewhere along the path the joint runs so fast that the ripple lies beyond the band.
    """
    if not problem.motions_alone or not effect.hypothesis.repeats:
        return False
    wave_number, path = effect.value(RIPPLE), 0.0
    for group, pred in zip(problem.groups, predictions, strict=True):
        assert group.window is not None  # of a motion
        speed = np.abs(pred.motion().v(effect.hypothesis.joint)) * (group.window > 0.5)
        slow = wave_number * speed < group.omega[group.n_compared - 1]
        path += float(np.sum(speed[slow])) * group.period_time / speed.shape[1]
    return wave_number * path < FEWEST_PERIODS * 2.0 * np.pi


def piece_of_a_curve(effect: Effect, final: Fit, predictions: Sequence[Prediction]) -> bool:
    """Whether an effect is a ripple beside a spring to the link, which hardly comes round along all that its joint
    moves; or the spring, where both leave more than noise there.

    A line and a part of a wave draw nearly any torque over the position, and where they miss it is none of theirs.
    """
    j = effect.hypothesis.joint
    if effect.hypothesis.on_chain:
        return False
    at_joint = [e for e in final.model.effects if e.hypothesis.joint == j and not e.hypothesis.on_chain]
    springs = [e for e in at_joint if e.hypothesis.effect in SPRINGS]
    ends = [(q.min(), q.max()) for q in (pred.motion().q(j) for pred in predictions)]
    path = max(top for _, top in ends) - min(bottom for bottom, _ in ends)
    parts = [e for e in at_joint if e.hypothesis.repeats and e.value(RIPPLE) * path < COMES_ROUND * 2.0 * np.pi]
    misses = final.costs[j] > LEFT_ERROR * final.counts[j]
    doubted = [*parts, *(springs if misses else ())]
    return bool(springs and parts) and any(e is effect for e in doubted)


def unlike_a_load(effect: Effect, final: Fit, covariance: np.ndarray) -> bool:
    """Whether an effect is a load that reaches further than an arm could carry one, beyond chance: a few grams with the
    inertia of a rod of metres are something else that moves at the flange."""
    h = effect.hypothesis
    if h.effect != "payload":
        return False

    def log_and_std(name: str) -> tuple[float, float]:
        i = final.names.index(h.coordinate(name))
        return float(np.log(effect.value(name))), float(np.sqrt(max(covariance[i, i], 0.0)))

    mass, least = log_and_std("mass")[0], (x - SURE * std for x, std in (log_and_std(f"inertia_{a}") for a in "xyz"))
    reach = sum(float(np.linalg.norm(x.translation)) for x in final.model.structure.model.jointPlacements)
    return bool(0.5 * (max(least) - mass) > np.log(max(LONGEST_LOAD, 0.5 * reach)))


def within_steps(effect: Effect, steps: Sequence[Steps]) -> bool:
    """Whether an error of a position is smaller than the steps in which this comes: it may be what these leave."""
    if effect.hypothesis.channel != "position" or not is_wave(effect.hypothesis.parameters):
        return False
    sine, cosine = (effect.value(name) for name in WAVE)
    amplitude = np.hypot(sine, cosine)
    return any(x.joint == effect.hypothesis.joint and amplitude < x.resolution for x in steps)


def shadowed(found: Round, rounds: Sequence[Round]) -> bool:
    """Whether a cause explains next to nothing beside another one at its joint: it may be what the other's law lacks.

    A law is not that of nature: what it leaves looks like a second law of the same element, or of the same joint.
    """

    def fall(x: Round) -> float:
        return float(x.before.costs[h.joint] - x.candidates[0].fit.costs[h.joint])

    h = found.candidates[0].hypothesis
    if h.on_chain:
        return False
    for other in rounds:
        o = other.candidates[0].hypothesis
        if other is found or o.joint != h.joint or o.channel == "model" or o.decoy:
            continue
        if o.effect == "gravity_spring" and (
            element(h) == "friction" or h.effect.endswith(LATE) or h.channel == "position"
        ):
            # What the law of a spring lacks follows the position, stores what it takes, is on time, and grows with no
            # acceleration as an error of the position does.
            continue
        if is_linear(o) and not is_linear(h) and down_to_noise(found):
            # What a filter lacks is as linear as that: what bends explains no more than a part of it.
            continue
        least = SHADOW
        alike = element(o) is not None and element(o) == element(h)
        cable = o.effect == "dress_pack" and element(h) == "friction"  # of which the law has a friction too
        if (alike or cable) and not explained_by_time(found):
            least = SHADOW_OF_LAW
        if overtone(found, other):
            least = HARMONIC
        if fall(found) < least * fall(other):
            return True
    return False


def explained_by_time(found: Round) -> bool:
    """Whether a cause that drifts explains its joint down to the noise: what a law lacks at all times does not look so."""
    return found.candidates[0].hypothesis.variable == "time" and down_to_noise(found)


def down_to_noise(found: Round) -> bool:
    """Whether a cause leaves noise alone at its joint."""
    winner = found.candidates[0]
    j = winner.hypothesis.joint
    return bool(winner.fit.costs[j] <= DETECTION_EXCESS * winner.fit.counts[j])


def overtone(found: Round, other: Round) -> bool:
    """Whether the ripple of a cause has a multiple of the periods of another one: no ripple of a machine is a sine."""
    best = [x.candidates[0] for x in (found, other)]
    if not all(c.hypothesis.repeats for c in best):
        return False
    waves = [e.value(RIPPLE) for c in best for e in c.fit.model.effects if e.hypothesis.key == c.hypothesis.key]
    ratio = waves[0] / waves[1]
    return round(ratio) >= 1 and abs(ratio - round(ratio)) < SAME_PERIOD * ratio


def element(h: Hypothesis) -> str | None:
    """What an effect is a law of, of which a joint has one: its gear or its friction."""
    if h.gear_law:
        return "gear"
    return "friction" if "friction" in h.effect else None


def collapsed(problem: Problem, final: Fit) -> bool:
    """Whether the final model explains the data badly and with drives that cannot be those of this arm.

    The causes that were found beside these may stand for what is missing too.
    """
    return final.chi2_per_dof > LEFT_ERROR and implausible(problem, final)


def known_probability(left: float, refuted: bool) -> float:
    """How far the names can be trusted, from the share of the discrepancy, as power, that they leave."""
    if refuted:
        return 0.4
    return float(1.0 / (1.0 + (left / HALF_TRUSTED) ** 2))
