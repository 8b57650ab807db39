"""The conclusion of a diagnosis: fits put into the words and numbers of verdict.json."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence

import numpy as np

from ident.attribute import DETECTION_LEVEL, Attribution
from ident.baseline import DETECTION_EXCESS, UNDETERMINED
from ident.chain import INERTIAL, Structure
from ident.dataset import Dataset
from ident.evidence import ABSENT, Candidate, pointless
from ident.extended import Prediction
from ident.hypotheses import Hypothesis
from ident.hypotheses.hypothesis import RIPPLE
from ident.link_sensor import LinkDelay
from ident.model import Effect, is_along_record
from ident.next_experiment import NextExperiment, advice
from ident.noise import drifting
from ident.problem import Problem
from ident.quantization import Steps
from ident.reporting import where
from ident.rigid import RigidFit
from ident.time_steps import TimeSteps
from ident.tones import Tone
from ident.torque_fit import Fit
from ident.trust import (
    LEFT_ERROR,
    LEFT_NOISE,
    collapsed,
    explained_share,
    fails_held_out,
    is_halved,
    known_probability,
    left_of,
    left_on_held_out,
    patchwork,
    shadowed,
    shown,
    too_fast,
    within_steps,
)
from ident.units import linear_names, parameter_unit, text_at, unit_at
from ident.verdict import UNKNOWN, Alternative, Cause, Discrepancy, Gain, Value, Verdict, Where

AXIS_STEP = 1e-6  # of a tilt
FEWEST = 2.0  # numbers that are compared, for each that is fitted, below which no name is trusted
LEFT_SHARE = 0.03  # share of the discrepancy left over, above which an unknown cause remains
TOLD = 0.2  # standard deviation of the Coulomb friction that drifts over its size, up to which the data show it
FAR_OFF = 1.5  # error of held-out data over their noise, from which it is told
ALONG = 0.8  # error of held-out data along the record over that of a simulation, below which both are told
RIVAL = 0.1  # of the probability of a cause, above which the sentence tells a rival too


def baseline_values(result: Fit) -> tuple[dict[str, Value], tuple[str, ...]]:
    """Baseline parameters with standard deviations, and those the data do not determine."""
    m = len(result.model.par.to_log())
    x = np.exp(result.model.par.to_log())
    std = np.sqrt(np.maximum(np.diag(result.covariance())[:m], 0.0))
    names = result.names[:m]
    linear = linear_names(result.model.structure.robot)
    values = {
        n: Value(float(v), float(v * s), parameter_unit(n, linear)) for n, v, s in zip(names, x, std, strict=True)
    }
    return values, tuple(n for n, s in zip(names, std, strict=True) if not s < UNDETERMINED)


def conclude(
    dataset: Dataset,
    problem: Problem,
    steps: Sequence[Steps],
    baseline: Fit,
    result: Attribution,
    gain: Gain | None,
    first: Sequence[Prediction],
    last: Sequence[Prediction],
    late: Sequence[LinkDelay] = (),
    separating: NextExperiment | None = None,
    rigid: RigidFit | None = None,
    belied: Collection[tuple[str, str]] = (),
    tones: Sequence[Tone] = (),
    judged: Gain | None = None,
) -> Verdict:
    """Put the result into the words and numbers of verdict.json.

    Args:
        judged: the gain that names are trusted by (``gain.Errors.seen_along``); ``gain`` itself where None.
        baseline: the first model, and ``first`` what it predicts.
        belied: causes, by ``key``, that held-out data deny (``trust.denied``).
        tones: what does not repeat with the period. Where nothing else is found it is an unknown cause.
        rigid: inertias of the links where they were found too: ``result`` is then about the model with them.
    """
    final = result.final
    tones = of_their_own(tones, final)
    left = result.left_share if result.detected else 0.0
    judged = judged or gain
    halved = judged is not None and is_halved(problem, judged)
    refuted = result.unknown or fails_held_out(judged, final, left, halved) or patchwork(named_effects(final))
    unknown = result.detected and (
        refuted
        or (left > LEFT_SHARE and final.chi2_per_dof > LEFT_NOISE)
        or final.chi2_per_dof > LEFT_ERROR
        or bool(belied)
        or not named_effects(final)
    )
    causes = []
    few = final.count < FEWEST * len(final.names)
    doubted = refuted or few or collapsed(problem, final)
    covariance = final.covariance()
    rounds = {r.candidates[0].hypothesis.key: r for r in result.rounds}
    for effect in named_effects(final):
        found = rounds[effect.hypothesis.key]
        share = left_of(effect.hypothesis, result)
        # Other motions meet whatever else the description of an arm lacks.
        if not (problem.motions_alone or halved):
            share = max(share, left_on_held_out(effect.hypothesis, judged))
        trust = known_probability(share, doubted)
        trust *= explained_share(found, final)
        doubtful = (
            pointless(effect, final.model.par.stiffness[effect.hypothesis.joint])
            or too_fast(problem, last, effect)
            or within_steps(effect, steps)
            or shadowed(found, result.rounds)
        )
        if doubtful or effect.hypothesis.key in belied or not shown(effect, final, covariance):
            trust *= known_probability(1.0, True)
        causes.append(_cause(effect, found.candidates, final, covariance, trust))
        causes += _drifting_friction(causes[-1])
    linear = linear_names(dataset.robot)
    direct = [_rounded(x, dataset.joints[x.joint], linear) for x in steps]
    direct += [_late(x, dataset.joints[x.joint]) for x in late]
    causes += direct
    alone = bool(tones) and not result.detected and not direct
    detected, unknown = result.detected or bool(direct) or alone, unknown or alone
    seen = where(problem, baseline, first) if result.detected else ()
    if not seen:
        seen += tuple(Where(dataset.joints[x.joint], "q", "position in steps", 1.0) for x in steps)
        seen += tuple(Where(dataset.joints[x.joint], "tau", f"a tone at {x.frequency_hz:.4g} Hz", 1.0) for x in tones)
        seen += tuple(Where(dataset.joints[x.joint], "q_link", "position that follows the velocity", 1.0) for x in late)
    verdict = UNKNOWN if unknown else "noise floor reached"
    values, undetermined = baseline_values(final)
    others = extended_baseline(final, covariance) | ({} if rigid is None else inertia_values(rigid))
    values |= others
    undetermined += tuple(k for k, v in others.items() if not v.std < UNDETERMINED * abs(v.value))
    return Verdict(
        dataset=dataset.name,
        baseline=values,
        discrepancy=Discrepancy(
            detected,
            0.0 if direct or alone else result.p_value,
            baseline.chi2_per_dof,
            seen,
        ),
        causes=tuple(causes),
        unexplained_share=1.0 if alone else float(left),
        unexplained_verdict=verdict,
        gain=gain,
        next_experiment=separating.text if separating else advice(causes, unknown, len(dataset.joints)),
        sentence=sentence(causes, unknown, detected, gain),
        unidentified=undetermined,
        notes=(
            *(() if rigid is None else (inertia_note(rigid, baseline, result),)),
            *(few_note(final) if few and causes else ()),
            *faint_note(result),
            *(() if detected else held_out_note(gain)),
            *(() if named_effects(final) else drift_note(problem)),
            *(tone_note(x, dataset.joints[x.joint]) for x in tones),
            *(belied_note(e) for e in named_effects(final) if e.hypothesis.key in belied),
            *(nameless_note(e, problem.structure) for e in final.model.effects if e.hypothesis.decoy),
            *(record_note(e) for e in named_effects(final) if is_along_record(e.hypothesis)),
        ),
    )


def named_effects(final: Fit) -> tuple[Effect, ...]:
    """The effects of a model that are causes, and no part of its baseline."""
    return tuple(e for e in final.model.effects if not e.hypothesis.options.get("baseline"))


def extended_baseline(final: Fit, covariance: np.ndarray) -> dict[str, Value]:
    """What the baseline holds beyond the drives: offsets of the torque records, friction of links; each of one
    parameter."""
    return {
        f"{e.hypothesis.options['baseline']}.{e.hypothesis.place}": value
        for e in final.model.effects
        if e.hypothesis.options.get("baseline")
        for value in reported_parameters(e, final, covariance).values()
    }


def inertia_values(rigid: RigidFit) -> dict[str, Value]:
    """Mass, first moment and inertia about the joint of every body, with standard deviations."""
    out = {}
    for body, std in zip(rigid.bodies, rigid.std, strict=True):
        model = rigid.structure.model
        p = model.inertias[rigid.structure.carriers[body]].toDynamicParameters()
        for kind, v, s in zip(INERTIAL, p, std, strict=True):
            name = f"{kind}.{body}"
            out[name] = Value(float(v), float(s), parameter_unit(name))
    return out


def nameless_law(result: Attribution, structure: Structure) -> str:
    """A sentence on the law without a name that came closest to what no cause explains; empty where none did."""
    if result.nameless is None:
        return ""
    law = nameless_note(result.nameless.candidates[0].fit.model.effects[-1], structure)
    share = result.nameless.explained
    return f" A law that has no name here explains {share:.0%} of what the named ones leave: {law[:1].lower()}{law[1:]}"


def nameless_note(effect: Effect, structure: Structure) -> str:
    """What a model was extended by that is no effect of the catalogue, in a sentence."""
    h = effect.hypothesis
    numbers = {q.name: v for q, v in zip(h.parameters, effect.p, strict=True)}
    return told(effect, structure, numbers)


def told(effect: Effect, structure: Structure, numbers: Mapping[str, float]) -> str:
    """An effect in a sentence, with the values of its parameters and with how often it repeats."""
    h = effect.hypothesis
    linear, joints = at_linear_joint(effect, structure), h.options.get("joints", ())
    wave = waves(numbers[RIPPLE], structure.robot.joints[h.joint].gear_ratio, linear) if RIPPLE in numbers else ""
    return text_at(h.sentence, linear).format(joint=h.place, turned=joints[-1] if joints else "", wave=wave, **numbers)


def waves(number: float, gear_ratio: float, linear: bool) -> str:
    """How often something repeats, by its wave number, rad of it per rad or m of the joint."""
    if linear:
        return f"once in {2.0 * np.pi / number:.3g} m"
    of_motor = "" if gear_ratio == 1.0 else f", {number / gear_ratio:.4g} of its motor"
    return f"{number:.4g} times a turn of the joint{of_motor}"


def at_linear_joint(effect: Effect, structure: Structure) -> bool:
    """Whether the parameters of an effect are those of a linear joint."""
    h = effect.hypothesis
    of_joint = h.channel != "model" or bool(h.options.get("baseline"))
    return of_joint and h.place in linear_names(structure.robot)


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


def few_note(final: Fit) -> tuple[str, ...]:
    """Why no name is trusted that is told by next to no data, in a sentence."""
    return (
        f"{final.count} numbers were compared and {len(final.names)} parameters fitted to them: too few for any name to be sure.",
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


def roll_off_note(problem: Problem) -> str:
    """A record of the torque that loses something towards high frequencies, or gains it, at all joints."""
    omega = max(float(g.omega[g.n_compared - 1]) for g in problem.groups if g.window is None)
    lost = problem.sampling.roll_off * omega**2
    return (
        f"The recorded torque is {abs(lost):.2%} too {'small' if lost > 0.0 else 'large'} at {omega / 2.0 / np.pi:.3g} Hz,"
        " by the square of the frequency and alike at all joints. That is taken for the recorder, which averages samples or"
        " holds them, and not for a cause."
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


def of_their_own(tones: Sequence[Tone], final: Fit) -> tuple[Tone, ...]:
    """Tones at joints of which no nonlinear law is known: what sticks, slips or rattles need not repeat with the
    period."""
    laws = (e.hypothesis for e in named_effects(final))
    bent = {h.joint for h in laws if not h.on_chain and "filter" not in h.options}
    return tuple(x for x in tones if x.joint not in bent)


def tone_note(tone: Tone, joint: str) -> str:
    """What shakes a joint at a frequency of its own, in a sentence."""
    return (
        f"At {joint} the torque holds a tone near {tone.frequency_hz:.4g} Hz that does not repeat with the period of the excitation,"
        f" {tone.ratio:.3g} times the power of the noise there: something else shakes it, and counts as noise here."
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


def _rounded(steps: Steps, joint: str, linear: Collection[str]) -> Cause:
    """The cause of a position that comes in steps: seen in the samples, not weighed against others."""
    unit = unit_at("rad", joint in linear)
    return Cause(
        effect="encoder_quantization",
        joint=joint,
        parameters={"resolution": Value(steps.resolution, steps.std, unit)},
        probability=0.99,
        evidence=f"The position of {joint} takes steps of {steps.resolution:.3g} {unit}: its samples lie on a grid.",
        alternatives=(),
    )


def _late(late: LinkDelay, joint: str) -> Cause:
    """The cause of a link encoder that lags the motor encoder: the torque equation does not hold it."""
    return Cause(
        effect="sensor_delay",
        joint=joint,
        parameters={"delay": Value(late.delay, late.std, "s")},
        probability=0.95 if late.clear else 0.6,
        evidence=f"The link encoder of {joint} comes {late.delay:.3g} s after its motor encoder: their difference follows the velocity, which looks like wind-up of the gear"
        + (" and is not." if late.clear else "; viscous friction of the link would look the same."),
        alternatives=(),
        channel="q_link",
    )


def _cause(effect: Effect, candidates: Sequence[Candidate], final: Fit, covariance: np.ndarray, trust: float) -> Cause:
    h = effect.hypothesis
    joints = h.options.get("joints", ())
    same = [c for c in candidates if c.hypothesis.key == h.key and c.hypothesis.options.get("joints", ()) == joints]
    own = sum(c.probability for c in same) if candidates else 1.0
    others: dict[tuple[str, str], float] = {}
    for c in candidates:
        if all(c is not x for x in same) and c.probability > 1e-3:
            name = "unknown" if c.hypothesis.decoy else c.hypothesis.effect
            others[(name, c.hypothesis.place)] = others.get((name, c.hypothesis.place), 0.0) + c.probability
    parameters = reported_parameters(effect, final, covariance)
    return Cause(
        effect=h.effect,
        joint=h.place,
        parameters=parameters,
        probability=float(np.clip(own * trust, 0.0, 0.999)),
        evidence=told(effect, final.model.structure, {k: v.value for k, v in parameters.items()}),
        alternatives=tuple(
            Alternative(e, p, float(v * trust)) for (e, p), v in sorted(others.items(), key=lambda x: -x[1])
        ),
        channel="q" if h.channel == "position" else None,
        joints=joints,
        with_load=h.options.get("with_load", False),
    )


def _drifting_friction(drift: Cause) -> tuple[Cause, ...]:
    """The Coulomb friction that changes with a ``friction_drift``: the model lacks it too, and the catalogue has it
    under a name of its own."""
    size = drift.parameters.get("coulomb")
    if drift.effect != "friction_drift" or size is None or not size.std < TOLD * size.value:
        return ()
    return (
        Cause(
            effect="coulomb_friction",
            joint=drift.joint,
            parameters={"torque": size},
            probability=drift.probability,
            evidence=f"Of the friction of {drift.joint} that drifts {size.value:.3g} {size.unit} do not depend on the speed, at the start.",
            alternatives=(),
        ),
    )


def reported_parameters(effect: Effect, final: Fit, covariance: np.ndarray) -> dict[str, Value]:
    """Parameters under their catalogue names, SI, with standard deviations."""
    h = effect.hypothesis
    index = {name: i for i, name in enumerate(final.names)}
    linear = at_linear_joint(effect, final.model.structure)
    out: dict[str, Value] = {}
    std = {}
    for q, v in zip(h.parameters, effect.p, strict=True):
        i = index[h.coordinate(q.name)]
        s = float(np.sqrt(max(covariance[i, i], 0.0)))
        std[q.name] = s * abs(v) if q.log else s
        found = q.null is not None and not q.at_start and abs(v - q.null) > ABSENT * std[q.name]
        if q.reported or not q.nuisance or found:
            out[q.name] = Value(float(v), std[q.name], unit_at(q.unit, linear))
    if "sine" in out:
        a, b = out.pop("sine"), out.pop("cosine")
        amplitude = float(np.hypot(a.value, b.value))
        sigma = float(np.hypot(a.std, b.std) / np.sqrt(2))
        phase = float(np.arctan2(b.value, a.value))
        out = {
            "amplitude": Value(amplitude, sigma, a.unit),
            **out,
            "phase": Value(phase, sigma / max(amplitude, 1e-300), "rad"),
        }
    if h.effect in ("transverse_elasticity", "base_elasticity"):
        axis = h.options["axis"](effect.p)
        spread = axis_std(h, effect.p, np.array([std[q.name] for q in h.parameters]))
        out = {name: value for name, value in out.items() if not name.startswith("tilt_")}
        out |= {f"axis_{n}": Value(float(a), float(s), "1") for n, a, s in zip("xyz", axis, spread, strict=True)}
        if h.options["before"]:
            out["before"] = Value(1.0, 0.0, "1")
    return out


def axis_std(h: Hypothesis, p: np.ndarray, std: np.ndarray) -> np.ndarray:
    """(3,) standard deviations of an elastic axis, to first order in those of its tilts."""
    axis, out = h.options["axis"], np.zeros(3)
    for i in range(2, len(p)):
        moved = p.copy()
        moved[i] += AXIS_STEP
        out += ((axis(moved) - axis(p)) / AXIS_STEP * std[i]) ** 2
    return np.sqrt(out)


def sentence(causes: Sequence[Cause], unknown: bool, detected: bool, gain: Gain | None) -> str:
    """The verdict in one sentence."""
    if not detected:
        return "The simulation agrees with the data: nothing beyond noise was found."
    sure = [c for c in causes if c.probability > 0.5]
    open_ones = [] if unknown else [c for c in causes if c.probability <= 0.5]
    possible = "; ".join(" or ".join(_said(x.effect, x.joint, x.probability) for x in likely(c)) for c in open_ones)
    if not sure and possible:
        return f"The simulation misses something that these data do not tell for sure: {possible}."
    if not sure:
        return "The simulation misses something that no effect of the catalogue explains: an unknown cause remains."
    *others, last = [_said(c.effect, c.joint, c.probability) for c in sure]
    names = f"{', '.join(others)} and {last}" if others else last
    of_torque = any(c.channel != "q_link" and c.effect != "encoder_quantization" for c in sure)
    closed = (
        ""
        if gain is None or gain.gap_closed is None or not of_torque
        else f"; naming {'them' if others else 'it'} closes {gain.gap_closed:.1%} of the gap to the noise on held-out data"
    )
    rest = ", and an unknown cause remains" if unknown else f"; not for sure {possible}" if possible else ""
    return f"The simulation misses {names}{closed}{rest}."


def likely(cause: Cause) -> list[Cause | Alternative]:
    """A cause and the rivals that are not far less likely, likeliest first."""
    rivals = [a for a in cause.alternatives if a.probability > RIVAL * cause.probability]
    return sorted([cause, *rivals], key=lambda x: -x.probability)


def _said(effect: str, joint: str, probability: float) -> str:
    return f"{effect.replace('_', ' ')} at {joint} ({probability:.0%})"
