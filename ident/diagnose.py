"""The main job: data to verdict, each step one function."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, replace

import numpy as np

from ident.attribute import Attribution, Candidate, Round, attribute, fit_baseline
from ident.dataset import Dataset
from ident.extended import Effect, Prediction, predict
from ident.gain import Errors, measure_gain, segment_errors
from ident.graybox import (
    Parameters,
    Structure,
    build_structure,
    equilibrium,
    linearise,
    parameter_unit,
    stiffness_diagonal,
)
from ident.inverse import Sampling
from ident.link_sensor import LinkDelay, find_link_delays
from ident.next_experiment import NextExperiment, advice, separating_experiment
from ident.noise import sample_noise
from ident.parallel import Workers, one_thread_each
from ident.quantization import Steps, find_steps
from ident.records import Group, build_groups, difference_noise
from ident.reporting import affected_joints, describe, evidence_plot, frf_views, spectrum_map, torque_traces, where
from ident.torque_fit import Fit, Problem, fit, predictions
from ident.verdict import Alternative, Cause, Diagnosis, Discrepancy, Gain, Value, Verdict, Where

MOTION_BAND_HZ = 10.0  # highest compared frequency of motions, at most
MOTION_SHARE = 0.4  # the same, in units of the lowest mode of the links
POSTURES = 8  # of a motion at which modes are looked at
LEAST_NOISE = {"q": 1e-7, "tau": 1e-3}  # over the signal, where differences of samples show less: filtered records
UNDETERMINED = 0.2  # relative standard deviation above which a parameter counts as not determined
LEFT_NOISE = 1.15  # chi2 per degree of freedom up to which the noise floor counts as reached
WORSE = 1.05  # held-out error of the extended model, over that of the baseline, that refutes it
CLEAR = 2.0  # held-out error of the baseline over the noise from which it tells
CLOSED = 0.5  # share of the gap that the extended model must then close
LEFT_ERROR = 3.0  # the same above which an unknown cause remains however strong the named ones are
IMPLAUSIBLE = 4.0  # factor between a drive figure and its starting guess
LEFT_SHARE = 0.03  # share of the discrepancy left over, above which an unknown cause remains
SEED = 0


@dataclass(frozen=True)
class Setup:
    """A problem with its held-out groups."""

    problem: Problem
    held_out: tuple[Group, ...]
    steps: tuple[Steps, ...] = ()


def set_up(dataset: Dataset) -> Setup:
    """Records, structure and starting guesses of a dataset.

    Raises:
        DataError: where nothing is left for identification.
    """
    robot = dataset.robot
    nominal, structure = Parameters.nominal(robot), build_structure(robot)
    band = motion_band_hz(dataset, structure, nominal)
    groups = build_groups(dataset, motion_band_hz=band)
    multisines = tuple(g for g in groups if g.window is None)
    held_out = ()
    if any(s.role == "validation" for s in dataset.segments):
        held_out = build_groups(dataset, role="validation", motion_band_hz=band)
    q_std, tau_std = _noise(dataset)
    declared = np.asarray(robot.array("q_std") if dataset.q_std is None else dataset.q_std, float)
    steps = find_steps(dataset, declared) if np.all(declared > 0) else ()
    step_std = np.zeros(robot.n)
    step_std[[x.joint for x in steps]] = [x.resolution / np.sqrt(12.0) for x in steps]
    problem = Problem(
        structure,
        multisines or groups,
        Sampling(1.0 / dataset.sample_rate, dataset.input_hold),
        nominal,
        tau_std,
        q_std,
        step_std=step_std,
    )
    return Setup(problem, held_out, steps)


def motion_band_hz(dataset: Dataset, structure: Structure, nominal: Parameters) -> float:
    """Highest compared frequency of motions, Hz: below the modes of the links on standing motors.

    Near such a mode the torque depends on how the links swung before the record began, which no
    record of the motors tells.
    """
    lowest = np.inf
    for segment in dataset.segments:
        if segment.kind != "trajectory":
            continue
        for q in segment.q[:: max(1, len(segment.q) // POSTURES)]:
            lin = linearise(structure, equilibrium(structure, nominal, q))
            K = np.diag(stiffness_diagonal(structure, nominal)) + lin.Kg
            squares = np.linalg.eigvals(np.linalg.solve(lin.M, K)).real
            lowest = min(lowest, *np.sqrt(squares[squares > 0]) / 2 / np.pi, np.inf)
    return float(min(MOTION_BAND_HZ, dataset.sample_rate / 10, MOTION_SHARE * lowest))


def _noise(dataset: Dataset) -> tuple[np.ndarray, np.ndarray]:
    """Sample noise of position and torque: as given, else from fourth differences of the data."""
    out = []
    for given, channel in ((dataset.q_std, "q"), (dataset.tau_std, "tau")):
        if given is not None and np.all(given > 0):
            out.append(np.asarray(given, float))
        else:
            signals = [getattr(s, channel) for s in dataset.segments]
            each = np.median([difference_noise(x) for x in signals], axis=0)
            size = np.median([np.std(x, axis=0) for x in signals], axis=0)
            floor = 1e-9 if channel == "q" else 1e-6
            out.append(np.maximum(each, np.maximum(LEAST_NOISE[channel] * size, floor)))
    return out[0], out[1]


@one_thread_each
def identify(dataset: Dataset, *, progress: Callable[[str], None] | None = None) -> tuple[Setup, Fit]:
    """Baseline parameters by maximum likelihood on the torque residual."""
    setup = set_up(dataset)
    result = fit_baseline(setup.problem, progress)
    return replace(setup, problem=with_measured_noise(setup.problem, result)), result


def with_measured_noise(problem: Problem, result: Fit) -> Problem:
    """Sample noise from the scatter between periods, for records that have a single one."""
    levels = []
    for group, pred in zip(problem.groups, predictions(problem, result.model, result.remainders), strict=True):
        found = sample_noise(group, pred.sampled_impedance, problem.samples(group))
        if found is not None:
            levels.append(found)
    if not levels:
        return problem
    tau, q = (np.median([level[i] for level in levels], axis=0) for i in range(2))
    return replace(problem, tau_std=np.maximum(tau, 1e-6), q_std=np.maximum(q, 1e-10))


def baseline_values(result: Fit) -> tuple[dict[str, Value], tuple[str, ...]]:
    """Baseline parameters with standard deviations, and those the data do not determine."""
    m = len(result.model.par.to_log())
    x = np.exp(result.model.par.to_log())
    std = np.sqrt(np.maximum(np.diag(result.covariance())[:m], 0.0))
    names = result.names[:m]
    values = {n: Value(float(v), float(v * s), parameter_unit(n)) for n, v, s in zip(names, x, std, strict=True)}
    return values, tuple(n for n, s in zip(names, std, strict=True) if not s < UNDETERMINED)


def diagnose(
    dataset: Dataset,
    *,
    max_causes: int = 4,
    progress: Callable[[str], None] | None = None,
    executor: Executor | None = None,
) -> Verdict:
    """Find what the simulation gets wrong; the verdict alone (see ``diagnose_fully``)."""
    return diagnose_fully(dataset, max_causes=max_causes, progress=progress, executor=executor).verdict


@one_thread_each
def diagnose_fully(
    dataset: Dataset,
    *,
    max_causes: int = 4,
    progress: Callable[[str], None] | None = None,
    executor: Executor | None = None,
) -> Diagnosis:
    """Identification, attribution, extension and gain, with all that reports show.

    Args:
        max_causes: rounds of attribution at most.
        progress: told in a line what is done.
        executor: of ``concurrent.futures``, for the fits of candidates; threads, one per core, where
            None. Results are the same.
    """
    began = time.perf_counter()
    workers = Workers(executor, progress)
    say = workers.say
    setup, baseline = identify(dataset, progress=say)
    problem = setup.problem
    result = attribute(problem, baseline, max_causes=max_causes, workers=workers)
    say("gain on held-out data")
    before, after = baseline.model, result.final.model
    first = predictions(problem, before, baseline.remainders)
    affected = affected_joints(problem, baseline, first) if result.detected else ()
    if setup.held_out:
        errors, pairs = segment_errors(problem, setup.held_out, before, after)
        gain = measure_gain(
            errors, dataset.joints, affected, "validation segments", np.random.default_rng(SEED)
        )
        shown = tuple(g for g in setup.held_out if g.segments[0] in errors.segments)
    else:
        gain = leave_one_out(setup, result, affected, workers)
        shown = problem.groups[:1]
        pairs = [(predict(before, g, problem.sampling), predict(after, g, problem.sampling)) for g in shown]
    say("evidence")
    last = predictions(problem, after, result.final.remainders)
    late = find_link_delays(problem, last)
    separating = separating_experiment(problem, result)
    verdict = make_verdict(dataset, setup, result, gain, first, last, late, separating)
    kept = result.rounds if len(verdict.causes) else ()
    return Diagnosis(
        verdict=verdict,
        robot=dataset.robot,
        joints=dataset.joints,
        frf=frf_views(dataset, problem, first, last),
        spectrum=spectrum_map(problem, baseline, first, last),
        evidence=tuple(
            evidence_plot(problem, result.final, last, i) for i in range(min(len(kept), len(after.effects)))
        ),
        traces=torque_traces(dataset, shown, pairs),
        parameters={k: v.value for k, v in baseline_values(result.final)[0].items()},
        seconds=time.perf_counter() - began,
        next_plan=separating.plan if separating else None,
        candidates=tuple(
            tuple((c.hypothesis.effect, c.hypothesis.place, c.probability) for c in r.candidates) for r in result.rounds
        ),
    )


def leave_one_out(
    setup: Setup, result: Attribution, affected: Sequence[int], workers: Workers = Workers()
) -> Gain | None:
    """Gain by leaving out one operating point after another, both models refitted without it."""
    problem = setup.problem
    if len(problem.groups) < 2:
        return None

    def without(i: int) -> Errors:
        part = replace(problem, groups=tuple(g for k, g in enumerate(problem.groups) if k != i))
        models = []
        for start in (result.baseline, result.final):
            remainders = [W for k, W in enumerate(start.remainders) if k != i]
            models.append(
                fit(part, start.model, iterations=4, remainders=remainders).model
            )
        return segment_errors(problem, problem.groups[i : i + 1], *models)[0]

    errors = workers.map(without, range(len(problem.groups)))
    joined = Errors(
        tuple(n for e in errors for n in e.segments),
        *(np.concatenate([getattr(e, f) for e in errors]) for f in ("before", "after", "noise")),
    )
    return measure_gain(
        joined,
        problem.structure.robot.joint_names,
        affected,
        "leave-one-operating-point-out",
        np.random.default_rng(SEED),
    )


def make_verdict(
    dataset: Dataset,
    setup: Setup,
    result: Attribution,
    gain: Gain | None,
    first: Sequence[Prediction],
    last: Sequence[Prediction],
    late: Sequence[LinkDelay] = (),
    separating: NextExperiment | None = None,
) -> Verdict:
    """Put the result into the words and numbers of verdict.json."""
    final = result.final
    left = result.left_share if result.detected else 0.0
    refuted = result.unknown or fails_held_out(gain)
    unknown = result.detected and (
        refuted
        or (left > LEFT_SHARE and final.chi2_per_dof > LEFT_NOISE)
        or final.chi2_per_dof > LEFT_ERROR
        or not final.model.effects
    )
    causes = []
    trust = known_probability(left, refuted or collapsed(setup.problem, final)) if result.detected else 1.0
    covariance = final.covariance()
    rounds = {r.candidates[0].hypothesis.key: r for r in result.rounds}
    for effect in final.model.effects:
        found = rounds[effect.hypothesis.key]
        causes.append(_cause(effect, found.candidates, final, covariance, trust * explained_share(found, final)))
    direct = [_rounded(x, dataset.joints[x.joint]) for x in setup.steps]
    direct += [_late(x, dataset.joints[x.joint]) for x in late]
    causes += direct
    detected = result.detected or bool(direct)
    seen = where(setup.problem, result.baseline, first) if result.detected else ()
    if not seen:
        seen += tuple(Where(dataset.joints[x.joint], "q", "position in steps", 1.0) for x in setup.steps)
        seen += tuple(Where(dataset.joints[x.joint], "q_link", "position that follows the velocity", 1.0) for x in late)
    verdict = "unknown cause remains" if unknown else "noise floor reached"
    values, undetermined = baseline_values(final)
    description = describe(setup.problem, final, last) if unknown else None
    return Verdict(
        dataset=dataset.name,
        baseline=values,
        discrepancy=Discrepancy(
            detected,
            0.0 if direct else result.p_value,
            result.baseline.chi2_per_dof,
            seen,
        ),
        causes=tuple(causes),
        unexplained_share=float(left),
        unexplained_verdict=verdict,
        gain=gain,
        next_experiment=separating.text if separating else advice(causes, unknown),
        sentence=sentence(causes, unknown, detected, gain),
        unidentified=undetermined,
        residual_description=description,
    )


def _rounded(steps: Steps, joint: str) -> Cause:
    """The cause of a position that comes in steps: seen in the samples, not weighed against others."""
    return Cause(
        effect="encoder_quantization",
        joint=joint,
        parameters={"resolution": Value(steps.resolution, steps.std, "rad")},
        probability=0.99,
        evidence=f"The position of {joint} takes steps of {steps.resolution:.3g} rad: its samples lie on a grid.",
        alternatives=(),
    )


def _late(late: LinkDelay, joint: str) -> Cause:
    """The cause of a link encoder that lags the motor encoder: the torque equation does not hold it."""
    return Cause(
        effect="sensor_delay",
        joint=joint,
        parameters={"delay": Value(late.delay, late.std, "s")},
        probability=0.95,
        evidence=f"The link encoder of {joint} comes {late.delay:.3g} s after its motor encoder: their difference"
        " follows the velocity, which looks like wind-up of the gear and is not.",
        alternatives=(),
        channel="q_link",
    )


def explained_share(found: Round, final: Fit) -> float:
    """What a cause explains, over that and what is left at the end: 1 where nothing is left.

    A cause that explains less than the unknown may be the unknown's own shadow.
    """
    fall = max(found.before.cost - found.candidates[0].fit.cost, 0.0)
    left = max(final.chi2_per_dof - LEFT_NOISE, 0.0) * final.count
    return fall / max(fall + left, 1e-300)


def fails_held_out(gain: Gain | None) -> bool:
    """Whether held-out data refute the extended model: no name is trusted then.

    It predicts them worse than the baseline, or leaves most of a clear error that the causes were named for.
    """
    if gain is None:
        return False
    clear = gain.before > CLEAR * gain.noise_floor and gain.gap_closed is not None
    return gain.after > WORSE * gain.before or (clear and gain.gap_closed < CLOSED)


def collapsed(problem: Problem, final: Fit) -> bool:
    """Whether the final model explains the data badly and with drives that cannot be those of this arm.

    Stiffness or motor inertia far from the starting guesses then stand for what is missing, and so may
    the causes that were found beside them.
    """
    n, x = problem.structure.n, final.model.par.to_log() - problem.nominal.to_log()
    drives = np.r_[:n, 2 * n : 3 * n]  # stiffness and motor inertia
    known = np.sqrt(np.maximum(np.diag(final.covariance())[drives], 0.0)) < UNDETERMINED
    limit = np.log(IMPLAUSIBLE)
    # A gear stiffer than the data can see ends anywhere above.
    return final.chi2_per_dof > LEFT_ERROR and bool(np.any((x[drives] < -limit) | (known & (x[drives] > limit))))


def known_probability(left: float, refuted: bool) -> float:
    """How far the names can be trusted, from the share of the discrepancy that they leave."""
    if refuted:
        return 0.4
    return float(1.0 / (1.0 + (left / 0.15) ** 2))


def _cause(
    effect: Effect, candidates: Sequence[Candidate], final: Fit, covariance: np.ndarray, trust: float
) -> Cause:
    h = effect.hypothesis
    same = [c for c in candidates if c.hypothesis.effect == h.effect and c.hypothesis.place == h.place]
    own = sum(c.probability for c in same) if candidates else 1.0
    others: dict[tuple[str, str], float] = {}
    for c in candidates:
        if c not in same and c.probability > 1e-3:
            name = "unknown" if c.hypothesis.decoy else c.hypothesis.effect
            others[(name, c.hypothesis.place)] = others.get((name, c.hypothesis.place), 0.0) + c.probability
    if h.options.get("trivial", lambda p: False)(effect.p):
        trust *= known_probability(1.0, True)
    parameters = reported_parameters(effect, final, covariance)
    numbers = {k: v.value for k, v in parameters.items()}
    return Cause(
        effect=h.effect,
        joint=h.place,
        parameters=parameters,
        probability=float(np.clip(own * trust, 0.0, 0.999)),
        evidence=h.sentence.format(joint=h.place, **numbers),
        alternatives=tuple(
            Alternative(e, p, float(v * trust)) for (e, p), v in sorted(others.items(), key=lambda x: -x[1])
        ),
        channel="q" if h.channel == "position" else None,
    )


def reported_parameters(effect: Effect, final: Fit, covariance: np.ndarray) -> dict[str, Value]:
    """Parameters under their catalogue names, SI, with standard deviations."""
    h = effect.hypothesis
    index = {name: i for i, name in enumerate(final.names)}
    out: dict[str, Value] = {}
    std = {}
    for q, v in zip(h.parameters, effect.p, strict=True):
        i = index[f"{h.effect}@{h.place}:{q.name}"]
        s = float(np.sqrt(max(covariance[i, i], 0.0)))
        std[q.name] = s * abs(v) if q.log else s
        if not q.nuisance:
            out[q.name] = Value(float(v), std[q.name], q.unit)
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
        axis = h.options["axis"]
        out |= {f"axis_{n}": Value(float(a), 0.0, "1") for n, a in zip("xyz", axis, strict=True)}
    return out


def sentence(causes: Sequence[Cause], unknown: bool, detected: bool, gain: Gain | None) -> str:
    """The verdict in one sentence."""
    if not detected:
        return "The simulation agrees with the data: nothing beyond noise was found."
    sure = [c for c in causes if c.probability > 0.5]
    if not sure:
        return "The simulation misses something that no effect of the catalogue explains: an unknown cause remains."
    names = " and ".join(f"{c.effect.replace('_', ' ')} at {c.joint} ({c.probability:.0%})" for c in sure)
    of_torque = any(c.channel != "q_link" and c.effect != "encoder_quantization" for c in sure)
    closed = "" if gain is None or gain.gap_closed is None or not of_torque else f"; naming it closes {gain.gap_closed:.1%} of the gap to the noise on held-out data"
    rest = ", and an unknown cause remains" if unknown else ""
    return f"The simulation misses {names}{closed}{rest}."
