"""The conclusion of a diagnosis: fits put into the words and numbers of verdict.json."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from ident.attribute import Attribution
from ident.baseline import UNDETERMINED
from ident.dataset import Dataset
from ident.evidence import Candidate, pointless
from ident.extended import Prediction
from ident.group import Group
from ident.identification import RUNAWAY, Setup
from ident.link_sensor import LinkDelay
from ident.lost_samples import LostSamples
from ident.model import Effect, is_along_record
from ident.naming import called, told_name
from ident.next_experiment import NextExperiment, advice
from ident.notes import (
    along_note,
    belied_note,
    drift_note,
    excitation_note,
    faint_note,
    few_note,
    held_out_note,
    inertia_note,
    load_note,
    lost_note,
    nameless_note,
    noise_note,
    record_note,
    refitted_note,
    roll_off_note,
    sentence,
    step_note,
    told,
    tone_note,
)
from ident.quantization import Steps
from ident.recorded_noise import given_noise
from ident.reporting import where
from ident.rigid import RigidFit
from ident.rounds import Round
from ident.simulable import not_simulated_note
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
    piece_of_a_curve,
    shadowed,
    shown,
    too_fast,
    unlike_a_load,
    within_steps,
)
from ident.units import linear_names, unit_at
from ident.values import baseline_values, extended_baseline, inertia_values, named_effects, reported_parameters
from ident.verdict import UNKNOWN, Alternative, Cause, Discrepancy, Gain, Value, Verdict, Where

LATE_SURE, LATE_LIKELY, LATE_DOUBTED = 0.95, 0.6, 0.4  # probabilities of a link encoder that comes late
FEWEST = 2.0  # numbers that are compared, for each that is fitted, below which no name is trusted
LEFT_SHARE = 0.03  # share of the discrepancy left over, above which an unknown cause remains
TOLD = 0.2  # standard deviation of the Coulomb friction that drifts over its size, up to which the data show it


@dataclass(frozen=True)
class Findings:
    """All that a verdict is drawn from.

    Attributes:
        baseline: the first model, and ``first`` what it predicts.
        result: the causes; with ``rigid``, they are about the model with the inertias that were found.
        last: what the final model predicts.
        gain: on held-out data.
        judged: the gain that names are trusted by (``gain.Errors.seen_along``); ``gain`` itself where None.
        late: link encoders that lag.
        separating: the experiment that would tell tied causes apart.
        rigid: inertias of the links where they were found too.
        belied: causes, by ``key``, that held-out data deny (``trust.denied``).
        tones: what does not repeat with the period; lost: samples that were. Where nothing else is found these are an
            unknown cause.
        unsought: as of ``notes.sentence``.
    """

    dataset: Dataset
    setup: Setup
    baseline: Fit
    result: Attribution
    first: Sequence[Prediction]
    last: Sequence[Prediction]
    gain: Gain | None = None
    judged: Gain | None = None
    late: Sequence[LinkDelay] = ()
    separating: NextExperiment | None = None
    rigid: RigidFit | None = None
    belied: Collection[tuple[str, str]] = ()
    tones: Sequence[Tone] = ()
    lost: Sequence[LostSamples] = ()
    unsought: str = ""

    @property
    def final(self) -> Fit:
        """The extended model."""
        return self.result.final

    @property
    def left(self) -> float:
        """Share of the discrepancy that no cause explains."""
        return float(self.result.left_share) if self.result.detected else 0.0

    @property
    def trusted_gain(self) -> Gain | None:
        """The gain that names are trusted by."""
        return self.judged or self.gain

    @property
    def halved(self) -> bool:
        """As of ``trust.is_halved``."""
        return self.trusted_gain is not None and is_halved(self.setup.problem, self.trusted_gain)


def conclude(found: Findings) -> Verdict:
    """Put what was found into the words and numbers of verdict.json."""
    dataset, result = found.dataset, found.result
    tones = of_their_own(found.tones, found.final)
    refuted = is_refuted(found)
    remains = cause_remains(found, refuted)
    direct = seen_in_samples(found, remains)
    nameless = bool(tones) or any(x.many for x in found.lost)
    alone = nameless and not result.detected and not direct
    unknown = remains or alone
    detected = result.detected or bool(direct) or alone
    causes = (*named_causes(found, refuted), *direct)
    values, undetermined = parameters_of(found)
    return Verdict(
        dataset=dataset.name,
        baseline=values,
        discrepancy=Discrepancy(
            detected,
            0.0 if direct or alone else result.p_value,
            found.baseline.chi2_per_dof,
            tuple(places(found, tones)),
        ),
        causes=causes,
        unexplained_share=1.0 if alone else found.left,
        unexplained_verdict=UNKNOWN if unknown else "noise floor reached",
        gain=found.gain,
        next_experiment=next_step(found, causes, unknown, alone),
        sentence=sentence(causes, unknown, detected, found.gain, "" if alone else found.unsought),
        unidentified=undetermined,
        notes=tuple(notes_on(found, causes, tones, detected)),
    )


def next_step(found: Findings, causes: Sequence[Cause], unknown: bool, alone: bool) -> str | None:
    """What to do next, in a sentence; None where nothing asks for more.

    Args:
        alone: whether what has no name, and no fit, is all that was found.
    """
    lost = [f"{x.channel} of {found.dataset.joints[x.joint]}" for x in found.lost if x.many]
    if alone and lost:
        return (
            f"Mend what loses samples of {' and '.join(lost)}, and record again: with these filled nothing else shows."
        )
    if found.unsought and not alone:
        return None
    return found.separating.text if found.separating else advice(causes, unknown, found.dataset.n)


def is_refuted(found: Findings) -> bool:
    """Whether the model as a whole is not believed: something else is there than its causes."""
    failed = fails_held_out(found.trusted_gain, found.final, found.left, found.halved)
    return found.result.unknown or failed or patchwork(named_effects(found.final))


def cause_remains(found: Findings, refuted: bool) -> bool:
    """Whether something is left that no name accounts for."""
    chi2 = found.final.chi2_per_dof
    much = chi2 > LEFT_ERROR or (chi2 > LEFT_NOISE and found.left > LEFT_SHARE)
    named = named_effects(found.final)
    false = bool(found.belied) or bool(no_loads(found))
    nothing_else = not named and not of_steps(found)
    return found.result.detected and (refuted or much or false or nothing_else)


def of_steps(found: Findings) -> bool:
    """Whether all that was found lies within the noise as a whole, at joints whose encoders come in steps: noise of
    steps is not quite as it is taken."""
    stepped = {x.joint for x in found.setup.steps}
    at = {x.candidates[0].hypothesis.joint for x in found.result.rounds}
    return not found.result.clear and bool(at) and at <= stepped


def no_loads(found: Findings) -> list[Effect]:
    """Loads that no arm could carry (``trust.unlike_a_load``)."""
    covariance = found.final.covariance()
    return [e for e in named_effects(found.final) if unlike_a_load(e, found.final, covariance)]


def named_causes(found: Findings, refuted: bool) -> Iterator[Cause]:
    """The effects that were fitted, each with how far it is trusted."""
    covariance = found.final.covariance()
    rounds = {r.candidates[0].hypothesis.key: r for r in found.result.rounds}
    doubted = refuted or too_few(found.final) or collapsed(found.setup.problem, found.final)
    for effect in named_effects(found.final):
        of_effect = rounds[effect.hypothesis.key]
        trust = trust_in(effect, of_effect, found, doubted, covariance)
        cause = _cause(effect, of_effect.candidates, found.final, covariance, trust, found.setup.problem.groups)
        yield from (cause, *_drifting_friction(cause))


def too_few(final: Fit) -> bool:
    """Whether a model has nearly as many parameters as there are numbers to compare."""
    return final.count < FEWEST * len(final.names)


def trust_in(effect: Effect, of_effect: Round, found: Findings, doubted: bool, covariance: np.ndarray) -> float:
    """Probability that what an effect explains has a cause that the catalogue knows.

    Args:
        of_effect: the round that found it.
        doubted: whether the model as a whole is.
        covariance: of the parameters of the final model.
    """
    h, problem = effect.hypothesis, found.setup.problem
    share = left_of(h, found.result)
    # Other motions meet whatever else the description of an arm lacks.
    if not (problem.motions_alone or found.halved):
        share = max(share, left_on_held_out(h, found.trusted_gain))
    trust = known_probability(share, doubted) * explained_share(of_effect, found.final)
    doubtful = (
        pointless(effect, found.final.model.par.stiffness[h.joint])
        or too_fast(problem, found.last, effect)
        or piece_of_a_curve(effect, found.final, found.last)
        or unlike_a_load(effect, found.final, covariance)
        or within_steps(effect, found.setup.steps)
        or shadowed(of_effect, found.result.rounds)
        or h.key in found.belied
        or not shown(effect, found.final, covariance)
    )
    return trust * known_probability(1.0, True) if doubtful else trust


def seen_in_samples(found: Findings, remains: bool) -> tuple[Cause, ...]:
    """Causes that the samples themselves show, and no fit; ``remains`` as of ``_late``."""
    joints, linear = found.dataset.joints, linear_names(found.dataset.robot)
    rounded = (_rounded(x, joints[x.joint], linear) for x in found.setup.steps)
    return (*rounded, *(_late(x, joints[x.joint], remains) for x in found.late))


def places(found: Findings, tones: Sequence[Tone]) -> Iterator[Where]:
    """Where the discrepancy is; what the samples show by themselves, where the fit leaves nothing else."""
    fitted = where(found.setup.problem, found.baseline, found.first) if found.result.detected else ()
    if fitted:
        yield from fitted
        return
    joints = found.dataset.joints
    for steps in found.setup.steps:
        yield Where(joints[steps.joint], "q", "position in steps", 1.0)
    for tone in tones:
        yield Where(joints[tone.joint], "tau", f"a tone at {tone.frequency_hz:.4g} Hz", 1.0)
    for lag in found.late:
        yield Where(joints[lag.joint], "q_link", "position that follows the velocity", 1.0)
    for lost in (x for x in found.lost if x.many):
        yield Where(joints[lost.joint], lost.channel, "samples that repeat the one before", 1.0)


def parameters_of(found: Findings) -> tuple[dict[str, Value], tuple[str, ...]]:
    """All parameters beside those of the causes, and the names of those that the data do not determine."""
    values, undetermined = baseline_values(found.final)
    others = extended_baseline(found.final, found.final.covariance())
    if found.rigid is not None:
        others |= inertia_values(found.rigid)
    vague = tuple(k for k, v in others.items() if not v.std < UNDETERMINED * abs(v.value))
    return values | others, undetermined + vague


def notes_on(found: Findings, causes: Sequence[Cause], tones: Sequence[Tone], detected: bool) -> Iterator[str]:
    """What a reader should know beside the verdict, in sentences."""
    problem, final, joints = found.setup.problem, found.final, found.dataset.joints
    named = named_effects(final)
    if found.rigid is not None:
        yield inertia_note(found.rigid, found.baseline, found.result)
    if too_few(final) and causes:
        yield few_note(final)
    yield from faint_note(found.result)
    if not detected:
        yield from held_out_note(found.gain)
    if not named:
        yield from drift_note(problem)
        yield from refitted_note(found.baseline, final, found.gain)
    yield from (tone_note(x, joints[x.joint]) for x in tones)
    yield from (lost_note(x, joints[x.joint]) for x in found.lost)
    yield from (belied_note(e) for e in named if e.hypothesis.key in found.belied)
    yield from (load_note(e) for e in no_loads(found))
    yield from (nameless_note(e, problem.structure) for e in final.model.effects if e.hypothesis.decoy)
    yield from (record_note(e) for e in named if is_along_record(e.hypothesis))
    if found.gain is not None and found.judged is not None:
        yield from along_note(found.gain, found.judged)
    if ran_away := ", ".join(found.setup.ran_away):
        yield (
            f"Not among the held-out data: {ran_away}. Torques above {RUNAWAY:g} times those of the others say that the loop was lost."
        )
    if problem.steps is not None:
        yield step_note(problem.steps)
    given = given_noise(found.dataset, "tau")
    if given is not None:
        yield from noise_note(problem, given)
    if problem.sampling.roll_off:
        yield roll_off_note(problem)
    if problem.sampling.late_excitation:
        yield excitation_note(problem)
    yield from not_simulated_note(causes)
    if found.gain is None and not found.setup.held_out:
        yield "No gain is measured: nothing is held out, and of a single operating point nothing can be left out."


def of_their_own(tones: Sequence[Tone], final: Fit) -> tuple[Tone, ...]:
    """Tones at joints of which no nonlinear law is known: what sticks, slips or rattles need not repeat with the
    period."""
    laws = (e.hypothesis for e in named_effects(final))
    bent = {h.joint for h in laws if not h.on_chain and "filter" not in h.options}
    return tuple(x for x in tones if x.joint not in bent)


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


def _late(late: LinkDelay, joint: str, remains: bool) -> Cause:
    """The cause of a link encoder that lags the motor encoder: the torque equation does not hold it.

    Args:
        remains: whether an unknown cause does, which may wind up the gear as well.
    """
    return Cause(
        effect="sensor_delay",
        joint=joint,
        parameters={"delay": Value(late.delay, late.std, "s")},
        probability=LATE_SURE if late.clear else LATE_DOUBTED if remains else LATE_LIKELY,
        evidence=f"The link encoder of {joint} comes {late.delay:.3g} s after its motor encoder: their difference follows the velocity, which looks like wind-up of the gear"
        + (" and is not." if late.clear else "; viscous friction of the link would look the same."),
        alternatives=(),
        channel="q_link",
    )


def _cause(
    effect: Effect,
    candidates: Sequence[Candidate],
    final: Fit,
    covariance: np.ndarray,
    trust: float,
    groups: Sequence[Group],
) -> Cause:
    """What an effect is called, and what else could be in its place.

    Args:
        groups: as of ``naming.called``.
    """
    h = effect.hypothesis
    joints = h.options.get("joints", ())
    name, parameter_called = called(effect, groups, final.model.par.stiffness)
    own, others = 0.0 if candidates else 1.0, dict[tuple[str, str], float]()
    for c in candidates:
        other, place = told_name(c, groups), c.hypothesis.place
        if (other, place, c.hypothesis.options.get("joints", ())) == (name, h.place, joints):
            own += c.probability
        elif c.probability > 1e-3:
            others[other, place] = others.get((other, place), 0.0) + c.probability
    parameters = reported_parameters(effect, final, covariance)
    return Cause(
        effect=name,
        joint=h.place,
        parameters={parameter_called[k]: parameters[k] for k in parameter_called}
        | {k: v for k, v in parameters.items() if k not in parameter_called},
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
