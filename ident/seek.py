"""The search for causes as a whole: in torque or link encoders, under the noise, the steps in time and the inertias
that show on the way."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass, replace

import numpy as np

from ident.attribute import Attribution, attribute
from ident.baseline import DETECTION_EXCESS, fit_baseline, renewed
from ident.dataset import Dataset
from ident.gain import ratio_interval
from ident.graybox import Parameters
from ident.group import Group
from ident.hypotheses.sensing import torque_offset
from ident.identification import (
    Setup,
    guessed_noise,
    set_up,
    under_noise_beside_causes,
    with_noise_of_fast_lines,
    with_noise_of_unexcited_lines,
    with_steps_of,
)
from ident.late_excitation import acting
from ident.left_out import SEED, errors_on_parts
from ident.link_sensor import comparable_links, find_link_delays, with_link_encoders
from ident.model import Effect
from ident.parallel import Workers
from ident.problem import NOT_COMPUTED, Problem, predictions
from ident.rigid import RigidFit, carried_over, fit_rigid
from ident.stepping import with_steps
from ident.swings import swings, without_swings
from ident.torque_fit import Fit
from ident.trust import LEFT_ERROR

# share of the discrepancy of torque and link encoders together, above which the torque is asked alone
LEFT_BY_BOTH = 0.1
# chi2 with the links' inertias found, over that without, that is worth them by itself; geometric mean over joints
SETTLED_BY_INERTIAS = 0.7
# squares of the torque left with inertias found, over those with inertias described, on parts left out, that are worth
# them
CARRIED_OVER = 0.9
LEFT_TO_LINKS = 1e-3  # share of the discrepancy up to which errors of the laws of causes, not links, are what is left
TOWARDS = 0.68  # level of the interval that says so: neither choice is the safe one


@dataclass(frozen=True)
class Sought:
    """What a search for causes ended with.

    Attributes:
        recorded: fitted groups as they were recorded.
        baseline: the first model.
        nominal: starting guesses of the drives, of links as they are described.
        rigid: inertias of the links where they were found too.
        late: whether the time for it was used up.
    """

    setup: Setup
    recorded: tuple[Group, ...]
    baseline: Fit
    result: Attribution
    nominal: Parameters
    rigid: RigidFit | None = None
    late: bool = False


def seek(
    dataset: Dataset, setup: Setup, baseline: Fit, max_causes: int, workers: Workers, mislabelled: bool = False
) -> Sought:
    """Causes of what the baseline leaves: in link encoders and torque together where those explain both, in the torque
    alone otherwise, and with inertias of the links where motions ask for them.

    Args:
        max_causes: rounds of attribution at most.
        mislabelled: whether the recording is, so that neither link encoders nor inertias are asked.
    """
    recorded = setup.problem.groups
    linked = None if mislabelled else by_link_encoders(dataset, setup, baseline, max_causes, workers)
    if linked is not None and explained(linked.result):
        return gone_on_with(linked, max_causes, workers)
    foretell = not mislabelled and setup.problem.motions_alone and inertias_foretell(setup)
    first_search = workers.for_half() if foretell else workers  # causes are then sought beside these inertias too
    guess = setup.problem.tau_std
    setup, baseline, result = sought(dataset, setup, baseline, max_causes, workers, first_search)
    if linked is not None and linked.result.detected and not result.detected:
        if np.any(setup.problem.tau_std > guess) and not workers.late:  # what both show may be that noise as well
            linked = by_link_encoders(dataset, setup, baseline, max_causes, workers)
        if linked is not None and linked.result.detected:
            return replace(linked, late=linked.late or first_search.late)
    found = Sought(setup, recorded, baseline, result, setup.problem.nominal, late=first_search.late)
    if foretell and unresolved(result) and not workers.late:
        return with_inertias(found, max_causes, workers)
    return gone_on_with(found, max_causes, workers)


def gone_on_with(found: Sought, max_causes: int, workers: Workers) -> Sought:
    """A search that ended with its share of the time, gone on with in what is left of the whole; any other as it is."""
    if not found.late or workers.late:
        return found
    try:
        result = attribute(
            found.setup.problem, found.baseline, max_causes=max_causes, known=found.result, workers=workers
        )
    except NOT_COMPUTED:
        return found
    return replace(found, result=result, late=workers.late)


def sought(
    dataset: Dataset, setup: Setup, baseline: Fit, max_causes: int, workers: Workers, first: Workers | None = None
) -> tuple[Setup, Fit, Attribution]:
    """Causes of what the baseline leaves; once more where beside these the noise turns out to be far more or far less
    than was guessed, or that the arm still swung.

    Args:
        first: those of the search under the noise that was guessed; ``workers`` where None.
    """
    found = beside_steps(dataset, setup, baseline, max_causes, first or workers)
    return beside_steady_records(*under_noise_seen(dataset, *found, max_causes, workers), max_causes, workers)


def beside_steps(
    dataset: Dataset, setup: Setup, baseline: Fit, max_causes: int, workers: Workers
) -> tuple[Setup, Fit, Attribution]:
    """Causes of what the baseline leaves; beside the time steps of a simulation that made the records, where a model
    with some of them shows these and the baseline was too far from the data for that.

    Where what such a model leaves is noise, and more than was known of, they are sought anew under that.
    """
    shown: list[Problem] = []
    noisy: list[Problem] = []

    def shows_steps(fit: Fit) -> bool:
        try:
            stepped = with_steps(setup.problem, fit)[0] if fit.model.effects else setup.problem
        except NOT_COMPUTED:
            return False
        if stepped is not setup.problem:
            shown.append(stepped)
        return bool(shown)

    def shows_noise(fit: Fit) -> bool:
        problem = louder(dataset, setup.problem, fit)
        if problem is not setup.problem:
            noisy.append(problem)
        return bool(noisy)

    def ends(fit: Fit) -> bool:
        return shows_steps(fit) or shows_noise(fit)

    result = attribute(setup.problem, baseline, max_causes=max_causes, until=ends, workers=workers)
    if noisy and not shown and not workers.late:
        with suppress(*NOT_COMPUTED):
            return under_more_noise(setup, noisy[-1], max_causes, workers)
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
        noisy = louder(dataset, setup.problem, result.final)
        if noisy is not setup.problem and not workers.late:
            return under_more_noise(setup, noisy, max_causes, workers)
        other, first = under_noise_beside_causes(dataset, setup, result.final)
    except NOT_COMPUTED:
        return setup, baseline, result
    if other is setup or workers.late:
        return setup, baseline, result
    workers.say("less noise")
    return other, first, attribute(other.problem, first, max_causes=max_causes, known=result, workers=workers)


def under_more_noise(setup: Setup, noisy: Problem, max_causes: int, workers: Workers) -> tuple[Setup, Fit, Attribution]:
    """Causes sought anew under more noise than was known of."""
    workers.say("more noise")
    baseline = fit_baseline(noisy, workers.say)
    found = attribute(noisy, baseline, max_causes=max_causes, workers=workers)
    return replace(setup, problem=noisy), baseline, found


def louder(dataset: Dataset, problem: Problem, fit: Fit) -> Problem:
    """The problem under more noise than is given or was guessed, where a fit shows it: at the fast lines of motions
    (``with_noise_of_fast_lines``), or, where noise is given, beside causes at the lines that nothing excites
    (``with_noise_of_unexcited_lines``); the problem itself where there is no such model."""
    try:
        noisy = with_noise_of_fast_lines(dataset, problem, fit)
        if noisy is problem and fit.model.effects and not any(guessed_noise(dataset)):
            noisy = with_noise_of_unexcited_lines(dataset, problem, fit)
    except NOT_COMPUTED:
        return problem
    return noisy


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


def by_link_encoders(dataset: Dataset, setup: Setup, baseline: Fit, max_causes: int, workers: Workers) -> Sought | None:
    """Causes sought in torque and link encoders together.

    Link encoders of a real arm have errors of their own, and with links that are not those of the model what they show
    of the gears belies its torque. Where these causes do not explain what both show, the torque alone says more,
    if it shows anything.

    Returns:
        None where there is no such fit.
    """
    if not comparable_links(setup.problem):
        return None
    workers.say("link encoders")
    late = find_link_delays(
        setup.problem.groups,
        predictions(setup.problem, baseline.model, baseline.remainders),
        setup.problem.sampling.sample_time,
    )
    wide, told = set_up(dataset, fast=True), setup.problem
    recorded, held_out = (
        tuple(acting(g, told.sampling.late_excitation) for g in groups)
        for groups in (wide.problem.groups, wide.held_out)
    )
    both = with_link_encoders(replace(wide.problem, groups=recorded), late)
    both = replace(both, q_std=told.q_std, tau_std=told.tau_std, noise_denied=told.noise_denied, sampling=told.sampling)
    wide = replace(wide, problem=both, held_out=held_out)
    half = workers.for_half()
    try:
        fitted = fit_baseline(wide.problem, workers.say)
        found = attribute(wide.problem, fitted, max_causes=max_causes, workers=half)
    except NOT_COMPUTED:
        return None
    return Sought(wide, recorded, fitted, found, wide.problem.nominal, late=half.late)


def explained(result: Attribution) -> bool:
    """Whether causes found in torque and link encoders explain what both show."""
    return bool(result.rounds) and result.detected and not result.unknown and result.left_share <= LEFT_BY_BOTH


def with_inertias(found: Sought, max_causes: int, workers: Workers) -> Sought:
    """Causes sought anew with inertias of the links and offsets of the torque found from motions, where that explains
    far more.

    The links of a real arm are not those of its description, torque records have offsets, and friction is
    judged wrongly beside both.
    """
    workers.say("inertias of the links")
    problem, result = found.setup.problem, found.result
    try:
        rigid = fit_rigid(problem.structure, problem.nominal, problem.groups)
        problem = replace(problem, structure=rigid.structure, nominal=rigid.par)
        offsets = tuple(
            Effect(torque_offset(j, name), np.zeros(1)) for j, name in enumerate(problem.structure.robot.joint_names)
        )
        baseline = fit_baseline(problem, workers.say, offsets)
    except NOT_COMPUTED:
        return replace(found, late=found.late or workers.late)
    if left_over(baseline, result.baseline) > 1.0:  # no better to begin with than the links of the description
        return replace(found, late=found.late or workers.late)
    other = attribute(problem, baseline, max_causes=max_causes, workers=workers)
    left = left_over(other.final, result.final)
    if not worth_it(left, foretold(found.setup.problem, result.final, other.final, workers)):
        return replace(found, late=found.late or workers.late)
    return replace(found, setup=replace(found.setup, problem=problem), result=other, rigid=rigid, late=workers.late)


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


def foretold(problem: Problem, one: Fit, other: Fit, workers: Workers) -> tuple[float, float]:
    """Interval of what ``other``, of inertias found, leaves of parts of the motions over what ``one`` leaves there
    (``ratio_interval``), both fitted again without these parts; (inf, inf) where they cannot be.

    Motions that are held out take no part in the choice: they measure what it gains.
    """
    try:
        errors = errors_on_parts(problem, one, other, workers, renewed=True)
    except NOT_COMPUTED:
        return np.inf, np.inf
    return ratio_interval(errors, np.random.default_rng(SEED), TOWARDS)


def left_over(one: Fit, other: Fit) -> float:
    """What a fit leaves, over what another leaves: geometric mean over the joints, at each of them no less than
    noise."""
    logs = [np.log(np.maximum(fit.costs / fit.counts, 1.0)) for fit in (one, other)]
    return float(np.exp(np.mean(logs[0] - logs[1])))
