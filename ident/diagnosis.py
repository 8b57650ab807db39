"""The main job: data to verdict, each step one function."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from concurrent.futures import Executor
from dataclasses import replace

import numpy as np

from ident.arbitration import weighed_on_held_out
from ident.attribute import Attribution
from ident.conclude import Findings, conclude
from ident.dataset import Dataset
from ident.extended import Prediction
from ident.format_checks import check_limits, checked
from ident.group import Group
from ident.held_out import not_fitted, with_held_out
from ident.identification import identify
from ident.leftover import find_leftover
from ident.link_sensor import find_link_delays
from ident.lost_samples import with_lost_samples_filled
from ident.next_experiment import separating_experiment
from ident.notes import NOT_SOUGHT, TIME_UP, chosen_motion_note, nameless_law, time_note
from ident.parallel import Workers, one_thread_each
from ident.period_checks import unrepeated
from ident.problem import predictions
from ident.refuted import HeldOut, held_out, taken_back, without_denied
from ident.reporting import affected_joints, evidence_plot, frf_views, spectrum_map, torque_traces
from ident.seek import Sought, seek
from ident.tones import Tone, find_tones
from ident.torque_checks import mislabelled
from ident.trust import denied, known_probability
from ident.values import named_effects
from ident.verdict import UNKNOWN, Diagnosis, Verdict
from robot_assets.robot import guessed_drives

MAX_SECONDS = 480.0  # of search for causes: with the fits that follow, ten minutes on two cores
END_HELD_OUT = "the end of the only motion, held out"


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

    Raises:
        DataError: where the dataset breaks the format, a limit is none, or as of ``identify``.
    """
    dataset = checked(dataset)
    check_limits(max_causes, max_seconds)
    began = time.perf_counter()
    workers = Workers(executor, progress, time.monotonic() + max_seconds)
    say = workers.say
    given, lost = with_lost_samples_filled(dataset)
    dataset = with_held_out(given)
    doubts = [*unrepeated(given), *mislabelled(given)]
    if doubts:
        say("the recording looks mislabelled: no causes are sought")
        max_causes = 0
    setup, baseline = identify(dataset, progress=say)
    begins = max_causes > 0 and not workers.late
    sought = seek(dataset, setup, baseline, max_causes, workers, mislabelled=bool(doubts))
    setup, problem, baseline = sought.setup, sought.setup.problem, sought.baseline
    first = predictions(problem, baseline.model, baseline.remainders)
    say("gain on held-out data")
    belied = {r.candidates[0].hypothesis.key for r in sought.result.rounds if denied(problem, setup.held_out, r)}
    kept, notes = without_denied(problem, sought.result, belied)
    kept, weighed = weighed_on_held_out(problem, setup.held_out, kept, workers)
    notes += weighed
    result, test, more = tested(
        sought, kept, first, "validation segments" if dataset is given else END_HELD_OUT, workers
    )
    notes += more
    say("evidence")
    last = predictions(problem, result.final.model, result.final.remainders)
    separating = separating_experiment(problem, result)
    verdict = conclude(
        Findings(
            dataset=dataset,
            setup=setup,
            baseline=baseline,
            result=result,
            first=first,
            last=last,
            gain=test.gain,
            judged=test.judged,
            late=find_link_delays(sought.recorded, last, problem.sampling.sample_time),
            separating=separating,
            rigid=sought.rigid if result is sought.result or result.rounds else None,
            belied=belied.intersection(r.candidates[0].hypothesis.key for r in result.rounds),
            tones=tones_of(sought.recorded, last),
            lost=lost,
            unsought=unsought(sought, begins),
        )
    )
    left = None
    if verdict.unexplained_verdict == UNKNOWN and result.detected:  # tones alone are told by themselves
        left = find_leftover(problem, result.final, result.nameless)
        told = (left.text if left else "") + nameless_law(result, problem.structure)
        verdict = replace(verdict, residual_description=told.strip())
    if sought.late:
        notes.append(time_note(max_seconds, verdict.unexplained_verdict != UNKNOWN))
    notes += (f"Not used: {line}." for line in not_fitted(given))
    if guessed := guessed_drives(dataset.robot):
        notes.append(f"The drives of {', '.join(guessed)} were fitted from guesses: robot.toml does not know them.")
    verdict = replace(verdict, notes=(*verdict.notes, *notes))
    if doubts:
        verdict = withdrawn(verdict, doubts)
    plots = [evidence_plot(problem, result.final, last, e, i) for i, e in enumerate(named_effects(result.final))]
    return Diagnosis(
        verdict=verdict,
        robot=dataset.robot,
        joints=dataset.joints,
        frf=frf_views(dataset, problem, first, last),
        spectrum=spectrum_map(problem, baseline, first, last),
        evidence=(*plots, *([] if left is None else [left.plot])),
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


def tested(
    sought: Sought, kept: Attribution, first: Sequence[Prediction], method: str, workers: Workers
) -> tuple[Attribution, HeldOut, list[str]]:
    """Causes without those that held-out data refute, what they gain there, and what is to be said about it.

    Args:
        kept: its causes, without those that are denied.
        first: what the first model predicts.
        method: how segments are held out, for the verdict.
    """
    problem, baseline = sought.setup.problem, sought.baseline

    def of_model(found: Attribution, inertias: bool) -> HeldOut:
        affected = affected_joints(problem, baseline, first) if found.detected else ()
        renewed = inertias and sought.rigid is not None
        return held_out(sought.setup, sought.nominal, baseline, found, renewed, affected, method, workers)

    result, test, notes = taken_back(sought.setup, kept, of_model)
    if test.told_by_torque:
        notes.append(chosen_motion_note(test.told_by_torque))
    return result, test, notes


def unsought(sought: Sought, begins: bool) -> str:
    """Why it cannot be said that nothing explains what is left: causes of it were not sought, or not to the end; empty
    where it can.

    Args:
        begins: whether there was time for a search.
    """
    if sought.result.rounds:
        return ""
    return TIME_UP if begins and sought.late else "" if begins else NOT_SOUGHT


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
