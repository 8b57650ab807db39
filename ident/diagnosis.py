"""The main job: data to verdict, each step one function."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, replace

import numpy as np

from ident.attribute import Attribution, attribute
from ident.baseline import DETECTION_EXCESS, fit_baseline
from ident.channel_checks import MOVES
from ident.conclude import conclude, named_effects
from ident.dataset import Dataset
from ident.extended import Effect, Prediction, predict
from ident.gain import Errors, measure_gain, segment_errors
from ident.graybox import (
    Parameters,
    Structure,
    build_structure,
    equilibrium,
    linearise,
    stiffness_diagonal,
)
from ident.hypotheses.sensing import torque_offset
from ident.inverse import Sampling
from ident.link_sensor import comparable_links, find_link_delays, with_link_encoders
from ident.next_experiment import separating_experiment
from ident.noise import drifting, sample_noise, unexcited_noise
from ident.parallel import Workers, one_thread_each
from ident.period_checks import unrepeated
from ident.quantization import Steps, find_steps
from ident.records import Group, build_groups, difference_noise
from ident.reporting import affected_joints, evidence_plot, frf_views, spectrum_map, torque_traces
from ident.rigid import RigidFit, carried_over, fit_rigid
from ident.torque_checks import mislabelled
from ident.torque_fit import NOT_COMPUTED, Fit, Problem, data_count, fit, output_error, predictions
from ident.trust import LEFT_ERROR, denied, known_probability
from ident.units import torque_unit
from ident.verdict import UNKNOWN, Diagnosis, Gain, Verdict
from robot_assets.errors import DataError

MOTION_BAND_HZ = 10.0  # highest compared frequency of motions, at most
MOTION_SHARE = 0.4  # the same, in units of the lowest mode of the links
POSTURES = 8  # of a motion at which modes are looked at
LEAST_NOISE = {"q": 1e-7, "tau": 1e-3}  # over the signal, where differences of samples show less: filtered records
LEFT_BY_BOTH = 0.1  # share of the discrepancy of torque and link encoders together, above which the torque is asked alone
SETTLED_BY_INERTIAS = 0.7  # chi2 per degree of freedom with the links' inertias found, over that without, that is worth them
CARRIED_OVER = 0.9  # squares of the torque left with inertias found, over those with inertias described, on parts left out, that are worth them
HELD_OUT_SHARE = 1.0 / 3.0  # of a single motion
LEAST_HELD_OUT = 2.0  # s of it
RUNAWAY = 20.0  # largest torque of a held-out segment over that of all that is fitted to, above which its loop was lost
MAX_SECONDS = 600.0  # of search for causes
SEED = 0


@dataclass(frozen=True)
class Setup:
    """A problem with its held-out groups, the steps of its encoders, and the names of segments that ran away."""

    problem: Problem
    held_out: tuple[Group, ...]
    steps: tuple[Steps, ...] = ()
    ran_away: tuple[str, ...] = ()


def set_up(dataset: Dataset, *, fast: bool = False) -> Setup:
    """Records, structure and starting guesses of a dataset.

    Args:
        fast: as of ``build_groups``.

    Raises:
        DataError: where nothing is left for identification, no joint moves, or there is less to compare than to fit.
    """
    robot = dataset.robot
    nominal, structure = Parameters.nominal(robot), build_structure(robot)
    band = motion_band_hz(dataset, structure, nominal)
    groups = build_groups(dataset, motion_band_hz=band, fast=fast)
    multisines = tuple(g for g in groups if g.window is None)
    held_out, ran_away = (), runaways(dataset)
    told = replace(dataset, segments=tuple(s for s in dataset.segments if s.name not in ran_away))
    if told.select(role="validation"):
        held_out = build_groups(told, role="validation", motion_band_hz=band, fast=fast)
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
    if data_count(problem) <= len(nominal.to_log()):
        found = f"{data_count(problem)} numbers to compare"
        raise DataError("segments", dataset.name, found, f"more than the {len(nominal.to_log())} parameters: longer records")
    if not moves(dataset, q_std):
        raise DataError("positions", dataset.name, "no joint that moves beyond its noise", "motion that the drives bring about")
    return Setup(problem, held_out, steps, ran_away)


def runaways(dataset: Dataset) -> tuple[str, ...]:
    """Names of held-out segments in which the loop was lost: their torque is beyond all that a model was fitted to.

    A drive at its limit asks for ever more; what it asks for then cannot be told from how the arm moved, and would outweigh
    all else that is held out.
    """
    known = max((np.abs(s.tau).max() for s in dataset.select(role="identification")), default=np.inf)
    return tuple(s.name for s in dataset.select(role="validation") if np.abs(s.tau).max() > RUNAWAY * known)


def moves(dataset: Dataset, q_std: np.ndarray) -> bool:
    """Whether any joint moves beyond the noise of its position (n,) in any segment."""
    return any(np.any(np.std(s.q, axis=0) > MOVES * q_std) for s in dataset.segments)


def with_held_out(dataset: Dataset) -> Dataset:
    """The dataset, its end held out where it is a single motion: nothing else would test what is named."""
    if len(dataset.segments) != 1 or dataset.segments[0].kind != "trajectory":
        return dataset
    whole = dataset.segments[0]
    cut = round((1.0 - HELD_OUT_SHARE) * whole.n_samples)
    if (whole.n_samples - cut) / dataset.sample_rate < LEAST_HELD_OUT:
        return dataset

    first = replace(whole, role="identification", **whole.part(slice(None, cut)))
    last = replace(whole, name=f"{whole.name}-end", role="validation", **whole.part(slice(cut, None)))
    return replace(dataset, segments=(first, last))


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
    try:
        result = fit_baseline(setup.problem, progress)
        louder = with_noise_of_unexcited_lines(dataset, setup.problem, result)
        if louder is not setup.problem:
            setup = replace(setup, problem=louder)
            result = fit_baseline(louder, progress)
    except FloatingPointError as err:
        found = "motions along which the links of the model cannot be solved"
        raise DataError("positions", dataset.name, found, "rad or m on the link side, of the robot that is named") from err
    # Where periods differ by a drift, as those of a motor that sticks do, what they differ by is no noise.
    share = 0.0 if np.any(drifting(setup.problem.groups)) else result.share
    problem = replace(with_measured_noise(setup.problem, result), scatter_share=share)
    return replace(setup, problem=problem), result


def with_noise_of_unexcited_lines(dataset: Dataset, problem: Problem, result: Fit) -> Problem:
    """Sample noise that was guessed, raised to what lines show that nothing excites, where periods show no scatter."""
    guessed = [not (given is not None and np.all(given > 0)) for given in (dataset.q_std, dataset.tau_std)]
    single = all(g.window is None and g.U_periods.shape[1] == 1 for g in problem.groups)
    if not single or not any(guessed) or result.chi2_per_dof <= DETECTION_EXCESS:
        return problem
    found = predictions(problem, result.model, result.remainders)
    residuals = [output_error(g, p) for g, p in zip(problem.groups, found, strict=True)]
    factor = np.sqrt(unexcited_noise(problem.groups, [result.weights.apply(i, x) for i, x in enumerate(residuals)]))
    q_std, tau_std = (std * factor if unknown else std for std, unknown in zip((problem.q_std, problem.tau_std), guessed, strict=True))
    return replace(problem, q_std=q_std, tau_std=tau_std) if factor > 1.0 else problem


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


def diagnose(
    dataset: Dataset,
    *,
    max_causes: int = 4,
    max_seconds: float = MAX_SECONDS,
    progress: Callable[[str], None] | None = None,
    executor: Executor | None = None,
) -> Verdict:
    """Find what the simulation gets wrong; the verdict alone (see ``diagnose_fully``)."""
    return diagnose_fully(
        dataset, max_causes=max_causes, max_seconds=max_seconds, progress=progress, executor=executor
    ).verdict


@one_thread_each
def diagnose_fully(
    dataset: Dataset,
    *,
    max_causes: int = 4,
    max_seconds: float = MAX_SECONDS,
    progress: Callable[[str], None] | None = None,
    executor: Executor | None = None,
) -> Diagnosis:
    """Identification, attribution, extension and gain, with all that reports show.

    Args:
        max_causes: rounds of attribution at most.
        max_seconds: after which no further search for causes is begun; what was found by then is fitted,
            and the verdict says so. Results are reproducible where it is not reached.
        progress: told in a line what is done.
        executor: of ``concurrent.futures``, for the fits of candidates; threads, one per core, where
            None. Results are the same.
    """
    began = time.perf_counter()
    workers = Workers(executor, progress, time.monotonic() + max_seconds)
    say = workers.say
    given, dataset = dataset, with_held_out(dataset)
    doubts = [*unrepeated(given), *mislabelled(given)]
    if doubts:
        say("the recording looks mislabelled: no causes are sought")
        max_causes = 0
    setup, baseline = identify(dataset, progress=say)
    recorded = setup.problem.groups
    linked = None if doubts else by_link_encoders(dataset, setup, baseline, max_causes, workers)
    if linked is None or not explained(linked[-1]):
        result = attribute(setup.problem, baseline, max_causes=max_causes, workers=workers)
        linked = linked if linked is not None and linked[-1].detected and not result.detected else None
    if linked is not None:
        setup, recorded, baseline, result = linked
    nominal, rigid = setup.problem.nominal, None
    if linked is None and unresolved(result) and not doubts and not workers.late and setup.problem.motions_alone:
        setup, result, rigid = with_inertias(setup, result, max_causes, workers)
    problem, cut = setup.problem, workers.late
    say("gain on held-out data")
    first = predictions(problem, baseline.model, baseline.remainders)
    affected = affected_joints(problem, baseline, first) if result.detected else ()
    method = "validation segments" if dataset is given else "the end of the only motion, held out"

    def tested(found: Attribution) -> HeldOut:
        return held_out(setup, nominal, baseline, found, rigid is not None, affected, method, workers)

    gain, shown, pairs = tested(result)
    notes: list[str] = []
    if harmful(gain):
        names = ", ".join(f"{e.hypothesis.effect} at {e.hypothesis.place}" for e in named_effects(result.final))
        notes.append(
            f"Taken back: {names}. Held-out data are predicted worse with than without: {gain.after:.3g} in place of"
            f" {gain.before:.3g} {torque_unit(dataset.robot)}."
        )
        result, rigid = replace(result, rounds=(), final=baseline, unknown=True), None
        gain, shown, pairs = tested(result)
    say("evidence")
    last = predictions(problem, result.final.model, result.final.remainders)
    late = find_link_delays(recorded, last, problem.sampling.sample_time)
    separating = separating_experiment(problem, result)
    belied = {r.candidates[0].hypothesis.key for r in result.rounds if denied(problem, setup.held_out, r)}
    verdict = conclude(dataset, problem, setup.steps, baseline, result, gain, first, last, late, separating, rigid, belied)
    if setup.ran_away:
        names = ", ".join(setup.ran_away)
        notes.append(f"Not among the held-out data: {names}. Torques above {RUNAWAY:g} times those of the others say that the loop was lost.")
    if cut:
        notes.append(f"The {max_seconds:g} s for the search for causes are used up: with more time more may be found.")
    verdict = replace(verdict, notes=(*verdict.notes, *notes))
    if doubts:
        verdict = withdrawn(verdict, doubts)
    return Diagnosis(
        verdict=verdict,
        robot=dataset.robot,
        joints=dataset.joints,
        frf=frf_views(dataset, problem, first, last),
        spectrum=spectrum_map(problem, baseline, first, last),
        evidence=tuple(
            evidence_plot(problem, result.final, last, effect, i)
            for i, effect in enumerate(named_effects(result.final))
        ),
        traces=torque_traces(dataset, shown, pairs),
        parameters={k: v.value for k, v in verdict.baseline.items()},
        seconds=time.perf_counter() - began,
        next_plan=separating.plan if separating else None,
        inertias=problem.structure.inertias,
        timing=result.final.model.par.timing,
        candidates=tuple(
            tuple((c.hypothesis.effect, c.hypothesis.place, c.probability) for c in r.candidates) for r in result.rounds
        ),
    )


HeldOut = tuple[Gain | None, tuple[Group, ...], list[tuple[Prediction, Prediction]]]
"""Gain, and the groups that are shown with their predictions before and after."""


def held_out(
    setup: Setup,
    nominal: Parameters,
    baseline: Fit,
    result: Attribution,
    renewed: bool,
    affected: Sequence[int],
    method: str,
    workers: Workers,
) -> HeldOut:
    """What the extended model gains on data that it was not fitted to: held-out segments, or points left out.

    Args:
        nominal, renewed: as of ``leave_one_out``.
        affected: joints over which errors are taken.
        method: how segments are held out, for the verdict.
    """
    problem, before, after = setup.problem, baseline.model, result.final.model
    if setup.held_out:
        errors, pairs = segment_errors(problem, setup.held_out, before, after)
        gain = measure_gain(errors, problem.structure.robot.joint_names, affected, method, np.random.default_rng(SEED))
        return gain, tuple(g for g in setup.held_out if g.segments[0] in errors.segments), pairs
    gain = leave_one_out(setup, nominal, baseline, result, renewed, affected, workers)
    shown = problem.groups[:1]
    return gain, shown, [(predict(before, g, problem.sampling), predict(after, g, problem.sampling)) for g in shown]


def harmful(gain: Gain | None) -> bool:
    """Whether held-out data are predicted worse with the causes than without, beyond chance."""
    return gain is not None and gain.ci95 is not None and gain.ci95[1] < 0.0


def withdrawn(verdict: Verdict, doubts: Sequence[str]) -> Verdict:
    """The verdict on a recording whose labels are surely wrong: no name keeps more than half."""
    return replace(
        verdict,
        causes=tuple(replace(c, probability=min(c.probability, known_probability(1.0, True))) for c in verdict.causes),
        unexplained_verdict=UNKNOWN,
        next_experiment="None before the labels of this recording are right: mend them in its map and diagnose again.",
        sentence=f"The recording looks mislabelled, so that no cause can be named: {doubts[0]}",
        notes=(*verdict.notes, *doubts),
    )


def unresolved(result: Attribution) -> bool:
    """Whether much of the discrepancy is left without a cause."""
    final = result.final
    return result.detected and (final.chi2_per_dof > LEFT_ERROR or result.unknown)


def by_link_encoders(
    dataset: Dataset, setup: Setup, baseline: Fit, max_causes: int, workers: Workers
) -> tuple[Setup, tuple[Group, ...], Fit, Attribution] | None:
    """Causes sought in torque and link encoders together.

    Link encoders of a real arm have errors of their own, and with links that are not those of the model what they show
    of the gears belies its torque. Where these causes do not explain what both show, the torque alone says more,
    if it shows anything.

    Returns:
        The setup that was fitted, its groups as recorded, baseline and causes; None where there is no such fit.
    """
    if not comparable_links(setup.problem):
        return None
    workers.say("link encoders")
    late = find_link_delays(
        setup.problem.groups,
        predictions(setup.problem, baseline.model, baseline.remainders),
        setup.problem.sampling.sample_time,
    )
    wide = set_up(dataset, fast=True)
    recorded = wide.problem.groups
    wide = replace(wide, problem=with_link_encoders(wide.problem, late))
    try:
        both = fit_baseline(wide.problem, workers.say)
        found = attribute(wide.problem, both, max_causes=max_causes, workers=workers.for_half())
    except NOT_COMPUTED:
        return None
    return wide, recorded, both, found


def explained(result: Attribution) -> bool:
    """Whether causes found in torque and link encoders explain what both show."""
    return bool(result.rounds) and result.detected and not result.unknown and result.left_share <= LEFT_BY_BOTH


def with_inertias(
    setup: Setup, result: Attribution, max_causes: int, workers: Workers
) -> tuple[Setup, Attribution, RigidFit | None]:
    """Causes sought anew with inertias of the links and offsets of the torque found from motions, where that explains far more.

    The links of a real arm are not those of its description, torque records have offsets, and friction is
    judged wrongly beside both. Short motions fit well with other inertias that foretell nothing: parts of them left out say so.
    """
    workers.say("inertias of the links")
    problem = setup.problem
    try:
        if carried_over(problem.structure, problem.nominal, problem.groups) > CARRIED_OVER:
            return setup, result, None
        rigid = fit_rigid(problem.structure, problem.nominal, problem.groups)
        problem = replace(problem, structure=rigid.structure, nominal=rigid.par)
        offsets = tuple(Effect(torque_offset(j, name), np.zeros(1)) for j, name in enumerate(problem.structure.robot.joint_names))
        baseline = fit_baseline(problem, workers.say, offsets)
    except NOT_COMPUTED:
        return setup, result, None
    other = attribute(problem, baseline, max_causes=max_causes, workers=workers)
    if other.final.chi2_per_dof > SETTLED_BY_INERTIAS * result.final.chi2_per_dof:
        return setup, result, None
    return replace(setup, problem=problem), other, rigid


def leave_one_out(
    setup: Setup,
    nominal: Parameters,
    baseline: Fit,
    result: Attribution,
    renewed: bool,
    affected: Sequence[int],
    workers: Workers = Workers(),
) -> Gain | None:
    """Gain by leaving out one operating point after another, both models refitted without it.

    Args:
        nominal: starting guesses of the drives.
        baseline: the first model.
        renewed: whether the inertias of the links were found too.
    """
    problem = setup.problem
    if len(problem.groups) < 2:
        return None

    def without(i: int) -> Errors:
        part = replace(problem, nominal=nominal, groups=tuple(g for k, g in enumerate(problem.groups) if k != i))
        models = []
        for start in (baseline, result.final):
            remainders = [W for k, W in enumerate(start.remainders) if k != i]
            model, of = start.model, part
            if renewed and start is result.final:
                links = fit_rigid(build_structure(problem.structure.robot), nominal, part.groups)
                model, of = replace(model, structure=links.structure), replace(part, nominal=links.par)
            models.append(fit(of, model, iterations=4, remainders=remainders).model)
        return segment_errors(problem, problem.groups[i : i + 1], *models, alone=False)[0]

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
