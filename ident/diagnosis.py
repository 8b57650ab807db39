"""The main job: data to verdict, each step one function."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from concurrent.futures import Executor
from dataclasses import replace

import numpy as np

from ident.attribute import Attribution, attribute
from ident.baseline import DETECTION_EXCESS, fit_baseline, renewed
from ident.conclude import (
    along_note,
    chosen_motion_note,
    conclude,
    named_effects,
    nameless_law,
    roll_off_note,
    step_note,
)
from ident.dataset import Dataset
from ident.extended import Prediction
from ident.gain import ratio_interval
from ident.group import Group
from ident.held_out import not_fitted, with_held_out
from ident.hypotheses.sensing import torque_offset
from ident.identification import (
    RUNAWAY,
    Setup,
    identify,
    set_up,
    under_noise_beside_causes,
    with_noise_of_fast_lines,
    with_steps_of,
)
from ident.left_out import SEED, errors_on_parts
from ident.leftover import find_leftover
from ident.link_sensor import comparable_links, find_link_delays, with_link_encoders
from ident.model import Effect
from ident.next_experiment import separating_experiment
from ident.parallel import Workers, one_thread_each
from ident.period_checks import unrepeated
from ident.problem import NOT_COMPUTED, Problem, predictions
from ident.refuted import HeldOut, held_out, taken_back
from ident.reporting import affected_joints, evidence_plot, frf_views, spectrum_map, torque_traces
from ident.rigid import RigidFit, carried_over, fit_rigid
from ident.stepping import with_steps
from ident.swings import swings, without_swings
from ident.tones import Tone, find_tones
from ident.torque_checks import mislabelled
from ident.torque_fit import Fit
from ident.trust import LEFT_ERROR, denied, known_probability
from ident.verdict import UNKNOWN, Diagnosis, Verdict
from robot_assets.robot import guessed_drives

# share of the discrepancy of torque and link encoders together, above which the torque is asked alone
LEFT_BY_BOTH = 0.1
# chi2 with the links' inertias found, over that without, that is worth them by itself; geometric mean over joints
SETTLED_BY_INERTIAS = 0.7
# squares of the torque left with inertias found, over those with inertias described, on parts left out, that are worth
# them
CARRIED_OVER = 0.9
LEFT_TO_LINKS = 1e-3  # share of the discrepancy up to which errors of the laws of causes, not links, are what is left
TOWARDS = 0.68  # level of the interval that says so: neither choice is the safe one
MAX_SECONDS = 600.0  # of search for causes


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
    foretell = not doubts and setup.problem.motions_alone and inertias_foretell(setup)
    first_search = workers.for_half() if foretell else workers  # causes are then sought beside these inertias too
    if linked is None or not explained(linked[-1]):
        setup, baseline, result = sought(dataset, setup, baseline, max_causes, first_search)
        linked = linked if linked is not None and linked[-1].detected and not result.detected else None
    if linked is not None:
        setup, recorded, baseline, result = linked
    nominal, rigid, cut = setup.problem.nominal, None, first_search.late
    if linked is None and unresolved(result) and foretell and not workers.late:
        setup, result, rigid = with_inertias(setup, result, max_causes, workers)
        cut = workers.late or (cut and rigid is None)
    problem = setup.problem
    say("gain on held-out data")
    first = predictions(problem, baseline.model, baseline.remainders)
    method = "validation segments" if dataset is given else "the end of the only motion, held out"

    def tested(found: Attribution, inertias: bool) -> HeldOut:
        affected = affected_joints(problem, baseline, first) if found.detected else ()
        return held_out(setup, nominal, baseline, found, inertias and rigid is not None, affected, method, workers)

    kept, test, notes = taken_back(setup, result, tested)
    if kept is not result and not kept.rounds:
        rigid = None
    result = kept
    gain, judged = test.gain, test.judged
    if test.told_by_torque:
        notes.append(chosen_motion_note(test.told_by_torque))
    if gain is not None and judged is not None:
        notes += along_note(gain, judged)
    say("evidence")
    last = predictions(problem, result.final.model, result.final.remainders)
    late = find_link_delays(recorded, last, problem.sampling.sample_time)
    separating = separating_experiment(problem, result)
    belied = {r.candidates[0].hypothesis.key for r in result.rounds if denied(problem, setup.held_out, r)}
    tones = tones_of(recorded, last)
    verdict = conclude(
        dataset,
        problem,
        setup.steps,
        baseline,
        result,
        gain,
        first,
        last,
        late,
        separating,
        rigid,
        belied,
        tones,
        judged,
    )
    left = None
    if verdict.unexplained_verdict == UNKNOWN and result.detected:  # tones alone are told by themselves
        left = find_leftover(problem, result.final, result.nameless)
        told = (left.text if left else "") + nameless_law(result, problem.structure)
        verdict = replace(verdict, residual_description=told.strip())
    if setup.ran_away:
        names = ", ".join(setup.ran_away)
        notes.append(
            f"Not among the held-out data: {names}. Torques above {RUNAWAY:g} times those of the others say that the loop was lost."
        )
    if cut:
        notes.append(f"The {max_seconds:g} s for the search for causes are used up: with more time more may be found.")
    notes += [f"Not used: {line}." for line in not_fitted(given)]
    if guessed := guessed_drives(dataset.robot):
        notes.append(f"The drives of {', '.join(guessed)} were fitted from guesses: robot.toml does not know them.")
    if problem.steps is not None:
        notes.append(step_note(problem.steps))
    if problem.sampling.roll_off:
        notes.append(roll_off_note(problem))
    if gain is None and not setup.held_out:
        notes.append(
            "No gain is measured: nothing is held out, and of a single operating point nothing can be left out."
        )
    verdict = replace(verdict, notes=(*verdict.notes, *notes))
    if doubts:
        verdict = withdrawn(verdict, doubts)
    return Diagnosis(
        verdict=verdict,
        robot=dataset.robot,
        joints=dataset.joints,
        frf=frf_views(dataset, problem, first, last),
        spectrum=spectrum_map(problem, baseline, first, last),
        evidence=(
            *(
                evidence_plot(problem, result.final, last, effect, i)
                for i, effect in enumerate(named_effects(result.final))
            ),
            *([] if left is None else [left.plot]),
        ),
        traces=torque_traces(test.shown, test.pairs),
        parameters={k: v.value for k, v in verdict.baseline.items()},
        seconds=time.perf_counter() - began,
        next_plan=separating.plan if separating else None,
        inertias=problem.structure.inertias,
        timing=result.final.model.par.timing,
        roll_off=problem.sampling.roll_off,
        candidates=tuple(
            tuple((c.hypothesis.effect, c.hypothesis.place, c.probability) for c in r.candidates) for r in result.rounds
        ),
    )


def tones_of(recorded: Sequence[Group], found: Sequence[Prediction]) -> tuple[Tone, ...]:
    """``find_tones`` beside a model; none where its impedance cannot carry noise."""
    try:
        return find_tones(recorded, [p.sampled_impedance for p in found])
    except (np.linalg.LinAlgError, ArithmeticError):
        return ()


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


def sought(
    dataset: Dataset, setup: Setup, baseline: Fit, max_causes: int, workers: Workers
) -> tuple[Setup, Fit, Attribution]:
    """Causes of what the baseline leaves; once more where beside these the noise turns out to be far more or far less
    than was guessed, or that the arm still swung."""
    found = under_noise_seen(dataset, *beside_steps(setup, baseline, max_causes, workers), max_causes, workers)
    return beside_steady_records(*found, max_causes, workers)


def beside_steps(setup: Setup, baseline: Fit, max_causes: int, workers: Workers) -> tuple[Setup, Fit, Attribution]:
    """Causes of what the baseline leaves; beside the time steps of a simulation that made the records, where a model
    with some of them shows these and the baseline was too far from the data for that."""

    shown: list[Problem] = []

    def shows_steps(fit: Fit) -> bool:
        try:
            stepped = with_steps(setup.problem, fit)[0] if fit.model.effects else setup.problem
        except NOT_COMPUTED:
            return False
        if stepped is not setup.problem:
            shown.append(stepped)
        return bool(shown)

    result = attribute(setup.problem, baseline, max_causes=max_causes, until=shows_steps, workers=workers)
    if not shown or workers.late:
        return setup, baseline, result
    workers.say("time steps of a simulation")
    first = fit_baseline(shown[-1], workers.say)
    again = attribute(shown[-1], first, max_causes=max_causes, workers=workers)
    return with_steps_of(setup, shown[-1]), first, again


def under_noise_seen(
    dataset: Dataset, setup: Setup, baseline: Fit, result: Attribution, max_causes: int, workers: Workers
) -> tuple[Setup, Fit, Attribution]:
    """Causes of what the baseline leaves, under the noise that is seen beside those found."""
    try:
        louder = with_noise_of_fast_lines(dataset, setup.problem, result.final)
        if louder is not setup.problem and not workers.late:
            workers.say("more noise")
            setup, baseline = replace(setup, problem=louder), fit_baseline(louder, workers.say)
            return setup, baseline, attribute(louder, baseline, max_causes=max_causes, workers=workers)
        other, first = under_noise_beside_causes(dataset, setup, result.final)
    except NOT_COMPUTED:
        return setup, baseline, result
    if other is setup or workers.late:
        return setup, baseline, result
    workers.say("less noise")
    return other, first, attribute(other.problem, first, max_causes=max_causes, known=result, workers=workers)


def beside_steady_records(
    setup: Setup, baseline: Fit, result: Attribution, max_causes: int, workers: Workers
) -> tuple[Setup, Fit, Attribution]:
    """Causes beside records less what the arm swings by itself, where those found by then show it and the baseline was
    too far from the data for that."""
    final = result.final
    shown = bool(result.rounds) and final.chi2_per_dof > DETECTION_EXCESS and not swings(setup.problem, baseline)
    if not shown or workers.late or not swings(setup.problem, final):
        return setup, baseline, result
    workers.say("records less what swings")
    try:
        problem = without_swings(setup.problem, final)
        first = renewed(problem, baseline)
    except NOT_COMPUTED:
        return setup, baseline, result
    again = attribute(problem, first, max_causes=max_causes, known=result, workers=workers)
    return replace(setup, problem=problem), first, again


def unresolved(result: Attribution) -> bool:
    """Whether so much is left without a cause, over noise and over the discrepancy, that links which are not as
    described may be why."""
    much = result.final.chi2_per_dof > LEFT_ERROR and result.left_share > LEFT_TO_LINKS
    return result.detected and (much or result.unknown)


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
    both, told = with_link_encoders(wide.problem, late), setup.problem
    wide = replace(wide, problem=replace(both, q_std=told.q_std, tau_std=told.tau_std, sampling=told.sampling))
    try:
        fitted = fit_baseline(wide.problem, workers.say)
        found = attribute(wide.problem, fitted, max_causes=max_causes, workers=workers.for_half())
    except NOT_COMPUTED:
        return None
    return wide, recorded, fitted, found


def explained(result: Attribution) -> bool:
    """Whether causes found in torque and link encoders explain what both show."""
    return bool(result.rounds) and result.detected and not result.unknown and result.left_share <= LEFT_BY_BOTH


def with_inertias(
    setup: Setup, result: Attribution, max_causes: int, workers: Workers
) -> tuple[Setup, Attribution, RigidFit | None]:
    """Causes sought anew with inertias of the links and offsets of the torque found from motions, where that explains
    far more.

    The links of a real arm are not those of its description, torque records have offsets, and friction is
    judged wrongly beside both.
    """
    workers.say("inertias of the links")
    problem = setup.problem
    try:
        rigid = fit_rigid(problem.structure, problem.nominal, problem.groups)
        problem = replace(problem, structure=rigid.structure, nominal=rigid.par)
        offsets = tuple(
            Effect(torque_offset(j, name), np.zeros(1)) for j, name in enumerate(problem.structure.robot.joint_names)
        )
        baseline = fit_baseline(problem, workers.say, offsets)
    except NOT_COMPUTED:
        return setup, result, None
    if left_over(baseline, result.baseline) > 1.0:  # no better to begin with than the links of the description
        return setup, result, None
    other = attribute(problem, baseline, max_causes=max_causes, workers=workers)
    left = left_over(other.final, result.final)
    if not worth_it(left, foretold(setup, result.final, other.final, workers)):
        return setup, result, None
    return replace(setup, problem=problem), other, rigid


def inertias_foretell(setup: Setup) -> bool:
    """Whether parts of the motions that are left out are predicted better with inertias found from the others.

    Short motions fit well with other inertias that foretell nothing.
    """
    problem = setup.problem
    try:
        return carried_over(problem.structure, problem.nominal, problem.groups) <= CARRIED_OVER
    except NOT_COMPUTED:
        return False


def worth_it(left: float, left_out: tuple[float, float]) -> bool:
    """Whether inertias found are kept, by what they leave over what is left without.

    Args:
        left: of the motions that were fitted (``left_over``). Both sides have causes of their own, sought apart, which
            makes this rough: it counts where it is much, and parts left out where it is not.
        left_out: interval of the same on parts of them that were not (``foretold``).
    """
    least, most = left_out
    return least <= 1.0 and (left <= SETTLED_BY_INERTIAS or most < 1.0)


def foretold(setup: Setup, one: Fit, other: Fit, workers: Workers) -> tuple[float, float]:
    """Interval of what ``other``, of inertias found, leaves of parts of the motions over what ``one`` leaves there
    (``ratio_interval``), both fitted again without these parts; (inf, inf) where they cannot be.

    Motions that are held out take no part in the choice: they measure what it gains.
    """
    try:
        errors = errors_on_parts(setup.problem, one, other, workers, renewed=True)
    except NOT_COMPUTED:
        return np.inf, np.inf
    return ratio_interval(errors, np.random.default_rng(SEED), TOWARDS)


def left_over(one: Fit, other: Fit) -> float:
    """What a fit leaves, over what another leaves: geometric mean over the joints, at each of them no less than
    noise."""
    logs = [np.log(np.maximum(fit.costs / fit.counts, 1.0)) for fit in (one, other)]
    return float(np.exp(np.mean(logs[0] - logs[1])))
