"""What a verdict says in sentences: laws that were found, what was noticed beside them, and its one line."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from ident.attribute import DETECTION_LEVEL, Attribution
from ident.baseline import DETECTION_EXCESS
from ident.chain import Structure
from ident.hypotheses.hypothesis import RIPPLE
from ident.lost_samples import LostSamples
from ident.model import Effect
from ident.noise import drifting
from ident.problem import Problem
from ident.rigid import RigidFit
from ident.time_steps import TimeSteps
from ident.tones import Tone
from ident.torque_fit import Fit
from ident.units import text_at
from ident.values import at_linear_joint
from ident.verdict import Alternative, Cause, Gain

FAR_OFF = 1.5  # error of held-out data over their noise, from which it is told
ALONG = 0.8  # error of held-out data along the record over that of a simulation, below which both are told
NAMED = 0.5  # probability above which a cause is taken as named
LEAST_GIVEN = 1e-12  # N m, of noise that is given
LOUDER = 1.1  # noise of a joint over that which is given, that is more
TIE = 0.5  # of the probability of a cause, above which a rival ties with it
NOT_SOUGHT = "no cause was searched for"
TIME_UP = "the time for the search was used up before a cause was found"
WORSE = 1.02  # error of held-out data after over that before, from which it is told what has changed
CHANGED = 0.01  # of a parameter, from which its change is told
MOST_CHANGED = 4  # of them that are told
RIVAL = 0.1  # of the probability of a cause, above which the sentence tells a rival too


def sentence(causes: Sequence[Cause], unknown: bool, detected: bool, gain: Gain | None, unsought: str = "") -> str:
    """The verdict in one sentence.

    Args:
        unknown: whether something is left that no cause accounts for.
        unsought: why nothing can be said of that (``NOT_SOUGHT``, ``TIME_UP``); empty where causes of it were sought.
    """
    if not detected:
        return "The simulation agrees with the data: nothing beyond noise was found."
    sure = [c for c in causes if is_sure(c)]
    open_ones = [c for c in causes if not is_sure(c) and (c.probability > NAMED or not unknown)]
    possible = "; ".join(" or ".join(_said(x.effect, x.joint, x.probability) for x in likely(c)) for c in open_ones)
    left = f"something remains: {unsought}" if unsought else "an unknown cause remains"
    rest = f", and {left}" if unknown else ""
    if not sure and possible:
        return f"The simulation misses something that these data do not tell for sure: {possible}{rest}."
    if not sure and unsought:
        return f"The simulation misses something, and {unsought}."
    if not sure:
        return "The simulation misses something that no effect of the catalogue explains: an unknown cause remains."
    *others, last = [_said(c.effect, c.joint, c.probability) for c in sure]
    names = f"{', '.join(others)} and {last}" if others else last
    of_torque = any(c.channel != "q_link" and c.effect != "encoder_quantization" for c in sure)
    closed = (
        ""
        if gain is None or gain.closed_told is None or not of_torque
        else f"; naming {'them' if others else 'it'} closes {gain.closed_told:.1%} of the gap to the noise on held-out data"
    )
    return f"The simulation misses {names}{closed}{f'; not for sure {possible}' if possible else ''}{rest}."


def is_sure(cause: Cause) -> bool:
    """Whether the sentence names a cause as found: it is likelier than not, and no rival comes close."""
    rival = max((a.probability for a in cause.alternatives), default=0.0)
    return cause.probability > NAMED and rival <= TIE * cause.probability


def likely(cause: Cause) -> list[Cause | Alternative]:
    """A cause and the rivals that are not far less likely, likeliest first."""
    rivals = [a for a in cause.alternatives if a.probability > RIVAL * cause.probability]
    return sorted([cause, *rivals], key=lambda x: -x.probability)


def _said(effect: str, joint: str, probability: float) -> str:
    return f"{effect.replace('_', ' ')} at {joint} ({probability:.0%})"


def told(effect: Effect, structure: Structure, numbers: Mapping[str, float]) -> str:
    """An effect in a sentence, with the values of its parameters and with how often it repeats."""
    h = effect.hypothesis
    linear, joints = at_linear_joint(effect, structure), h.options.get("joints", ())
    wave = waves(numbers[RIPPLE], structure.robot.joints[h.joint].gear_ratio, linear) if RIPPLE in numbers else ""
    text = h.options["said"](numbers) if "said" in h.options else h.sentence
    return text_at(text, linear).format(joint=h.place, turned=joints[-1] if joints else "", wave=wave, **numbers)


def waves(number: float, gear_ratio: float, linear: bool) -> str:
    """How often something repeats, by its wave number, rad of it per rad or m of the joint."""
    if linear:
        return f"once in {2.0 * np.pi / number:.3g} m"
    of_motor = "" if gear_ratio == 1.0 else f", {number / gear_ratio:.4g} of its motor"
    return f"{number:.4g} times a turn of the joint{of_motor}"


def nameless_note(effect: Effect, structure: Structure) -> str:
    """What a model was extended by that is no effect of the catalogue, in a sentence."""
    h = effect.hypothesis
    numbers = {q.name: v for q, v in zip(h.parameters, effect.p, strict=True)}
    return told(effect, structure, numbers)


def nameless_law(result: Attribution, structure: Structure) -> str:
    """A sentence on the law without a name that came closest to what no cause explains; empty where none did."""
    if result.nameless is None:
        return ""
    law = nameless_note(result.nameless.candidates[0].fit.model.effects[-1], structure)
    share = result.nameless.explained
    return f" A law that has no name here explains {share:.0%} of what the named ones leave: {law[:1].lower()}{law[1:]}"


def record_note(effect: Effect) -> str:
    """How the torque of a gear was predicted that has several steady motions, in a sentence."""
    return (
        f"With {effect.hypothesis.effect.replace('_', ' ')} {effect.hypothesis.place} has several steady motions: in the"
        " periodic segments the recorded torque said which it made, a simulation may settle in another."
    )


def faint_note(result: Attribution) -> tuple[str, ...]:
    """Why what is no chance is not taken for a discrepancy, in a sentence; nothing where the model leaves noise."""
    if result.detected or result.p_value >= DETECTION_LEVEL:
        return ()
    return (
        f"The model leaves {result.baseline.chi2_per_dof:.3g} times the power of the noise that was estimated: more than chance"
        f" (p = {result.p_value:.1g}), but up to {DETECTION_EXCESS:g} times may be an error of that estimate.",
    )


def held_out_note(gain: Gain | None) -> tuple[str, ...]:
    """Joints of which held-out data differ although those that were fitted do not, in a sentence; nothing where none
    does."""
    off = {j: x.before / x.noise_floor for j, x in gain.by_joint.items() if x.noise_floor > 0.0} if gain else {}
    far = " and ".join(f"{x:.3g} times the noise at {j}" for j, x in off.items() if x > FAR_OFF)
    return (f"Held-out data are off by {far}: what they miss the fitted data do not show.",) if far else ()


def few_note(final: Fit) -> str:
    """Why no name is trusted that is told by next to no data, in a sentence."""
    return f"{final.count} numbers were compared and {len(final.names)} parameters fitted to them: too few for any name to be sure."


def refitted_note(baseline: Fit, final: Fit, gain: Gain | None) -> tuple[str, ...]:
    """What a model without a cause was changed in that predicts held-out data worse, in a sentence; nothing where it does
    not."""
    if gain is None or not gain.after > WORSE * gain.before:
        return ()
    names = final.names[: len(final.model.par.to_log())]
    by = np.expm1(final.model.par.to_log() - baseline.model.par.to_log())
    most = [j for j in np.argsort(-np.abs(by), kind="stable") if abs(by[j]) >= CHANGED][:MOST_CHANGED]
    changes = [f"{names[j]} by {by[j]:+.3g} times its value" for j in most]
    added = [
        f"{e.hypothesis.options['baseline'].replace('_', ' ')} of {e.hypothesis.place}" for e in final.model.effects
    ]
    fitted = f"drives fitted again ({', '.join(changes)})" if changes else "drives fitted again, all changed by little"
    what = f"{fitted} and with {', '.join(added)}" if added else fitted
    return (
        f"No cause is named, but the extended model is not the first one: it has its {what}. It predicts held-out data worse,"
        f" {gain.after:.3g} in place of {gain.before:.3g} {gain.metric.rpartition(', ')[2]}: trust no parameter of it.",
    )


def drift_note(problem: Problem) -> tuple[str, ...]:
    """What does not repeat from period to period, and is no noise of samples, in a sentence; nothing where nothing
    does."""
    names = problem.structure.robot.joint_names
    joints = [name for name, x in zip(names, drifting(problem.groups), strict=True) if x]
    if not joints:
        return ()
    return (
        f"At {', '.join(joints)} periods differ by more than noise of the samples: a drift, a transient or a disturbance of its"
        " own. None of the effects that are sought does that, and no faint one is named there.",
    )


def noise_note(problem: Problem, given: np.ndarray) -> tuple[str, ...]:
    """More noise of the torque than the dataset gives, in a sentence; nothing where that was not denied.

    Args:
        given: (n,) noise of the samples by the dataset, N m.
    """
    if not problem.noise_denied:
        return ()
    over = problem.tau_std / np.maximum(given, LEAST_GIVEN)
    joints = "all" if over.min() > LOUDER else "most"
    return (
        f"In the compared band the torque holds {over.min():.2g} to {over.max():.2g} times the noise that the dataset gives, alike"
        f" at {joints} joints and all lines, as noise does of which neighbouring samples go together. It is taken for that,"
        " and not for a cause.",
    )


def roll_off_note(problem: Problem) -> str:
    """A record of the torque that loses something towards high frequencies, or gains it, at all joints."""
    omega = max(float(g.omega[g.n_compared - 1]) for g in problem.groups if g.window is None)
    lost = problem.sampling.roll_off * omega**2
    return (
        f"The recorded torque is {abs(lost):.2%} too {'small' if lost > 0.0 else 'large'} at {omega / 2.0 / np.pi:.3g} Hz,"
        " by the square of the frequency and alike at all joints. That is taken for the recorder, which averages samples or"
        " holds them, and not for a cause."
    )


def excitation_note(problem: Problem) -> str:
    """An excitation that acts later than the torque of which it is a part."""
    return (
        f"The excitation (channel r) acts {1e3 * problem.sampling.late_excitation:.3g} ms later than the rest of the recorded torque,"
        " alike at all joints, as one does that is held from sample to sample while the controller is faster. That is taken"
        " for how the torque was made, and not for a cause."
    )


def load_note(effect: Effect) -> str:
    """A load with the inertia of a body that no arm could carry."""
    largest = max(effect.value(f"inertia_{axis}") for axis in "xyz")
    return (
        f"The payload has a radius of gyration of {np.sqrt(largest / effect.value('mass')):.2g} m, more than an arm could"
        " carry: something else moves at the flange."
    )


def along_note(gain: Gain, judged: Gain) -> tuple[str, ...]:
    """Where a gear rattles: what the extended model leaves along the record, by which its law is trusted."""
    if not judged.after < ALONG * gain.after:
        return ()
    unit = gain.metric.rpartition(", ")[2]
    return (
        f"The gear has more steady motions than the model is led to: simulated it leaves {gain.after:.3g} {unit} of held-out data, and"
        f" {judged.after:.3g} {unit} where the recorded torque says how the gear moved. Its law is trusted by the latter.",
    )


def chosen_motion_note(records: Sequence[str]) -> str:
    """Held-out records that are predicted in the steady motion that their torque tells (``gain.in_recorded_motion``)."""
    those = records[0] if len(records) == 1 else f"{len(records)} held-out records, {records[0]} first"
    return (
        f"A gear that bends lets the arm swing in more than one steady motion: in {those}, the model is in the one that the recorded"
        " torque tells, not in the one that it reaches from rest."
    )


def step_note(steps: TimeSteps) -> str:
    """Records of a simulation that steps in time, as of ``time_steps.TimeSteps``."""
    return (
        f"The records show the error of a simulation in time steps of {1e3 * steps.length:.3g} ms, by semi-implicit Euler with"
        f" dampers that are {'implicit for each body apart' if steps.apart else steps.dampers}, alike at all joints. That is no cause: it is part of how the"
        " records are compared, and the parameters are those of the arm without it."
    )


def tone_note(tone: Tone, joint: str) -> str:
    """What shakes a joint at a frequency of its own, in a sentence."""
    return (
        f"At {joint} the torque holds a tone near {tone.frequency_hz:.4g} Hz that does not repeat with the period of the excitation,"
        f" {tone.ratio:.3g} times the power of the noise there: something else shakes it, and counts as noise here."
    )


def time_note(seconds: float, nothing_left: bool) -> str:
    """A search that ended for want of time.

    Args:
        nothing_left: whether noise alone is left.
    """
    more = "; no more than noise is left" if nothing_left else ": with more time more may be found"
    return f"The {seconds:g} s for the search for causes are used up{more}."


def lost_note(lost: LostSamples, joint: str) -> str:
    """What was filled in the record of a position, in a sentence."""
    if lost.every:
        return f"{lost.channel} of {joint} has a new value every {lost.every} samples only: those between were filled by interpolation."
    return (
        f"Of {lost.channel} of {joint} {lost.share:.1%} of the samples repeat the one before, in motion: they were lost. They were filled"
        f" by interpolation{', and nothing of the catalogue does that' if lost.many else ''}."
    )


def belied_note(effect: Effect) -> str:
    """Why a cause is not trusted that held-out data deny, in a sentence."""
    h = effect.hypothesis
    return (
        f"What {h.effect.replace('_', ' ')} at {h.place} changes within the noise of the data that it was found in does not show in"
        " those that are held out: something else may be there."
    )


def inertia_note(rigid: RigidFit, baseline: Fit, result: Attribution) -> str:
    """What the inertias of the links do, in a sentence."""
    before, after = (np.sqrt(x.chi2_per_dof) for x in (baseline, result.baseline))
    return (
        f"The inertias of {len(rigid.bodies)} links were found from the motions, which show {rigid.rank} combinations of"
        f" them and the drives; by themselves they bring the torque error from {before:.3g} to {after:.3g} times the noise."
    )
