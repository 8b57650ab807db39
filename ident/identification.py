"""From a dataset to its problem, and the drives that fit it: the model before any cause."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from ident.baseline import DETECTION_EXCESS, fit_baseline, renewed, start_of
from ident.chain import Structure, build_structure
from ident.channel_checks import MOVES
from ident.dataset import Dataset
from ident.extended import Prediction
from ident.format_checks import checked
from ident.graybox import Parameters, equilibrium, linearise, stiffness_diagonal
from ident.group import Group
from ident.inverse import Sampling
from ident.late_excitation import acting, with_late_excitation
from ident.noise import (
    DOUBT,
    alike_at_all_lines,
    drifting,
    power_at_fast_lines,
    sample_noise,
    torque_noise_left,
    unexcited_noise,
    white_covariance,
)
from ident.parallel import one_thread_each
from ident.problem import Problem, data_count, output_error, predictions
from ident.quantization import Steps, find_steps, with_rounding
from ident.recorded_noise import (
    declared_position_noise,
    given_noise,
    least_noise,
    noise_of,
    recorded_noise,
)
from ident.records import build_groups, with_turns_alike
from ident.refits import under_own_noise
from ident.roll_off import with_roll_off
from ident.stepping import in_steps, shown_steps, told_by
from ident.swings import swings, without_swings
from ident.torque_fit import Fit
from robot_assets.errors import DataError

MOTION_BAND_HZ = 10.0  # highest compared frequency of motions, at most
MOTION_SHARE = 0.4  # the same, in units of the lowest mode of the links
POSTURES = 8  # of a motion at which modes are looked at
RENEWALS = 3  # at most, of such noise
LOUD = 2.0  # power of noise as it was guessed, over that which is found, from which it is lowered
SLOW_LINES = 2.0  # power left at all lines of motions over that at the fast ones, up to which both are noise
ALIKE = 2.0  # power at the joint with most noise over that where it is least, up to which noise that is given is denied
FEWEST_ALIKE = 3  # joints at least, for that
RUNAWAY = 20.0  # largest torque of a held-out segment over that of all that is fitted to, above which its loop was lost


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
    held_out: tuple[Group, ...] = ()
    ran_away = runaways(dataset)
    told = replace(dataset, segments=tuple(s for s in dataset.segments if s.name not in ran_away))
    if told.select(role="validation"):
        held_out = build_groups(told, role="validation", motion_band_hz=band, fast=fast)
    groups, held_out = with_turns_alike(groups, held_out)
    multisines = tuple(g for g in groups if g.window is None)
    q_std, tau_std = recorded_noise(dataset)
    declared = declared_position_noise(dataset)
    steps = find_steps(dataset, declared) if np.all(declared > 0) else ()
    compared, held_out = (with_rounding(x, steps, dataset) for x in (multisines or groups, held_out))
    problem = Problem(
        structure,
        compared,
        Sampling(1.0 / dataset.sample_rate, dataset.input_hold),
        nominal,
        tau_std,
        q_std,
        # Of a single axis whose torque is held from sample to sample a common offset is a delay of its drive or its
        # sensor.
        free_timing=robot.n > 1 or dataset.input_hold == "none",
    )
    if data_count(problem) <= len(nominal.to_log()):
        found = f"{data_count(problem)} numbers to compare"
        raise DataError(
            "segments", dataset.name, found, f"more than the {len(nominal.to_log())} parameters: longer records"
        )
    if not moves(dataset, q_std):
        raise DataError(
            "positions", dataset.name, "no joint that moves beyond its noise", "motion that the drives bring about"
        )
    return Setup(problem, held_out, steps, ran_away)


def runaways(dataset: Dataset) -> tuple[str, ...]:
    """Names of held-out segments in which the loop was lost: their torque is beyond all that a model was fitted to.

    A drive at its limit asks for ever more; what it asks for then cannot be told from how the arm moved, and would
    outweigh all else that is held out.
    """
    known = max((np.abs(s.tau).max() for s in dataset.select(role="identification")), default=np.inf)
    return tuple(s.name for s in dataset.select(role="validation") if np.abs(s.tau).max() > RUNAWAY * known)


def moves(dataset: Dataset, q_std: np.ndarray) -> bool:
    """Whether any joint moves beyond the noise of its position (n,) in any segment."""
    return any(np.any(np.std(s.q, axis=0) > MOVES * q_std) for s in dataset.segments)


def motion_band_hz(dataset: Dataset, structure: Structure, nominal: Parameters) -> float:
    """Highest compared frequency of motions, Hz: below the modes of the links on standing motors.

    Near such a mode the torque depends on how the links swung before the record began, which no
    record of the motors tells. Held-out motions say nothing of it but where there are no others.
    """
    lowest = np.inf
    for segment in dataset.select(role="identification", kind="trajectory") or dataset.select(kind="trajectory"):
        for q in segment.q[:: max(1, len(segment.q) // POSTURES)]:
            lin = linearise(structure, equilibrium(structure, nominal, q))
            K = np.diag(stiffness_diagonal(structure, nominal)) + lin.Kg
            squares = np.linalg.eigvals(np.linalg.solve(lin.M, K)).real
            lowest = min(lowest, *np.sqrt(squares[squares > 0]) / 2 / np.pi, np.inf)
    return float(min(MOTION_BAND_HZ, dataset.sample_rate / 10, MOTION_SHARE * lowest))


@one_thread_each
def identify(dataset: Dataset, *, progress: Callable[[str], None] | None = None) -> tuple[Setup, Fit]:
    """Baseline parameters by maximum likelihood on the torque residual.

    Raises:
        DataError: where the dataset breaks the format, or its motions cannot be those of the robot; as of ``set_up``.
    """
    dataset = checked(dataset)
    setup = set_up(dataset)
    try:
        setup, result = in_shown_steps(dataset, *first_model(dataset, setup, progress), progress)
    except FloatingPointError as err:
        found = "motions along which the links of the model cannot be solved"
        raise DataError(
            "positions", dataset.name, found, "rad or m on the link side, of the robot that is named"
        ) from err
    as_recorded = setup.problem
    for _ in range(RENEWALS):
        if not swings(setup.problem, result):
            break
        setup = replace(setup, problem=without_swings(as_recorded, result))
        result = renewed(setup.problem, result, progress)
    problem, held_out = with_known_noise(with_measured_noise(setup.problem, result)), setup.held_out
    if setup.steps:
        noise = declared_position_noise(dataset), problem.q_std
        groups, held_out = (with_rounding(x, setup.steps, dataset, noise) for x in (problem.groups, held_out))
        problem = replace(problem, groups=groups)
        result = renewed(problem, result, progress)
    if any(g.known_noise is not None for g in problem.groups):
        result = renewed(problem, result, progress)
        # Few records are held out: all that the model is fitted to tell the noise better than the end of their own
        # transients.
        held_out = tuple(replace(g, U_noise=None, Q_noise=None) for g in held_out)
    # Where periods differ by a drift, as those of a motor that sticks do, what they differ by is no noise.
    share = 0.0 if np.any(drifting(setup.problem.groups)) else result.share
    problem = replace(problem, scatter_share=share, start=start_of(problem, result))
    return replace(setup, problem=problem, held_out=held_out), result


def first_model(dataset: Dataset, setup: Setup, progress: Callable[[str], None] | None = None) -> tuple[Setup, Fit]:
    """The setup with the torque that acts and what its record loses, and under the noise that is seen beside the drives;
    the drives that fit it."""
    told = setup.problem.sampling.late_excitation
    problem, result = with_late_excitation(setup.problem, fit_baseline(setup.problem, progress))
    more = problem.sampling.late_excitation - told
    problem, result = with_roll_off(problem, result)
    setup = replace(setup, problem=problem, held_out=tuple(acting(g, more) for g in setup.held_out))
    louder = with_noise_of_unexcited_lines(dataset, setup.problem, result)
    if louder is not setup.problem:
        setup = replace(setup, problem=louder)
        result = fit_baseline(louder, progress)
    return under_noise_that_is_left(dataset, setup, result, progress)


def in_shown_steps(
    dataset: Dataset, setup: Setup, result: Fit, progress: Callable[[str], None] | None = None
) -> tuple[Setup, Fit]:
    """The setup and its first model in the time steps of a simulation that the records show (``stepping``), where these
    leave no more than noise at most joints; else as they are."""
    steps = shown_steps(setup.problem, result)
    if steps is None:
        return setup, result
    sampling = replace(setup.problem.sampling, roll_off=0.0)
    stepped = with_steps_of(setup, replace(in_steps(setup.problem, steps), sampling=sampling))
    other, again = first_model(dataset, stepped, progress)
    return (other, again) if told_by(result, again) else (setup, result)


def with_steps_of(setup: Setup, problem: Problem) -> Setup:
    """The setup with a problem, and what is held out of it in the same time steps."""
    return replace(setup, problem=problem, held_out=tuple(replace(g, steps=problem.steps) for g in setup.held_out))


def whitened(problem: Problem, result: Fit, found: Sequence[Prediction]) -> list[np.ndarray]:
    """(S, K, n + M) of what a fit leaves, under its weights, by group; ``found`` is what it predicts."""
    return [
        result.weights.apply(i, output_error(g, p)) for i, (g, p) in enumerate(zip(problem.groups, found, strict=True))
    ]


def with_noise_of_unexcited_lines(dataset: Dataset, problem: Problem, result: Fit) -> Problem:
    """Sample noise, raised to what lines show that nothing excites, where periods show no scatter.

    Noise that is given is raised where what is left is alike at all lines of most joints: it says nothing of noise whose
    samples go together.
    """
    unknown = all(g.window is None and not g.shows_noise for g in problem.groups)
    if not unknown or result.chi2_per_dof <= DETECTION_EXCESS:
        return problem
    left = whitened(problem, result, predictions(problem, result.model, result.remainders))
    guessed = guessed_noise(dataset)
    power: float | np.ndarray | None = unexcited_noise(problem.groups, left) if any(guessed) else 1.0
    if power == 1.0:  # where much is missing at few joints, others tell
        power = alike_at_all_lines(problem.groups, left)
    if power is None or not np.any(power > 1.0):
        return problem
    raised = guessed if any(guessed) else (True, True)
    factor = np.sqrt(np.maximum(power, 1.0))
    q_std, tau_std = (
        std * factor if r else std for std, r in zip((problem.q_std, problem.tau_std), raised, strict=True)
    )
    return replace(problem, q_std=q_std, tau_std=tau_std, noise_denied=not any(guessed))


def under_noise_that_is_left(
    dataset: Dataset, setup: Setup, result: Fit, progress: Callable[[str], None] | None = None
) -> tuple[Setup, Fit]:
    """The setup under ``with_noise_that_is_left`` of a fit, and the first model under it; both as they are where that
    is no less.

    ``result`` is the first model, or one extended by causes: the more it explains, the more its residual tells.
    """
    first = result
    for _ in range(RENEWALS):
        quieter = with_noise_that_is_left(dataset, setup.problem, result)
        if quieter is setup.problem:
            break
        setup = replace(setup, problem=quieter)
        first = result = fit_baseline(quieter, progress)
    return setup, first


def under_noise_beside_causes(
    dataset: Dataset, setup: Setup, result: Fit, progress: Callable[[str], None] | None = None
) -> tuple[Setup, Fit]:
    """The same beside the causes that ``result`` has: of noise that was raised to what lines show that nothing excites,
    no more than is left.

    A ripple of the gear shows at those lines as at the others, and looks like noise as long as it is missing.
    """
    problem, first = setup.problem, result
    q_std, tau_std = recorded_noise(dataset)
    raised = np.any(problem.q_std > q_std) and not any(g.shows_noise for g in problem.groups)
    if raised and guessed_noise(dataset)[0]:
        guess = replace(problem, q_std=np.minimum(problem.q_std, q_std), tau_std=np.minimum(problem.tau_std, tau_std))
        seen = under_own_noise(guess, result)
        calmer = problem if seen is None else with_noise_of_unexcited_lines(dataset, guess, seen)
        again = under_own_noise(calmer, result) if np.all(LOUD * calmer.q_std**2 < problem.q_std**2) else None
        if again is not None:
            setup, result, first = replace(setup, problem=calmer), again, fit_baseline(calmer, progress)
    other, lowered = under_noise_that_is_left(dataset, setup, result, progress)
    return other, first if other is setup else lowered


def guessed_noise(dataset: Dataset) -> list[bool]:
    """Whether the noise of position and of torque are not given, or as ``_noise`` says not all that there is."""
    q_std, tau_std = (given_noise(dataset, channel) for channel in ("q", "tau"))
    return [q_std is None, tau_std is None or bool(np.any(noise_of(dataset, "tau") > np.sqrt(LOUD) * tau_std))]


def with_noise_that_is_left(dataset: Dataset, problem: Problem, result: Fit) -> Problem:
    """Noise of the torque that was guessed, lowered to what a fit leaves where that is far less and periods show no
    scatter.

    Differences of samples tell what circulates in the loop too: a differentiating controller makes of the noise of the
    encoder ten times that of the torque sensor and more, which cancels in the torque residual.
    """
    if not guessed_noise(dataset)[1] or any(g.shows_noise for g in problem.groups):
        return problem
    left, shares = left_at_lines(problem, result)
    power = DOUBT * torque_noise_left(left, shares)
    if np.all(LOUD * power > 1.0):
        return problem
    lowered = np.maximum(problem.tau_std * np.sqrt(power), least_noise(dataset, "tau"))
    lowered = np.where(LOUD * power > 1.0, problem.tau_std, np.minimum(lowered, problem.tau_std))
    return replace(problem, tau_std=lowered, noise_left=True)


def left_at_lines(problem: Problem, result: Fit) -> tuple[list[np.ndarray], list[np.ndarray]]:
    """What a fit leaves, (S, K, n) by group, each joint of unit mean power for noise as assumed; (K, n) share of the
    torque in that noise."""
    n, left, shares = problem.structure.n, [], []
    found = predictions(problem, result.model, result.remainders)
    for i, (group, pred) in enumerate(zip(problem.groups, found, strict=True)):
        position = white_covariance(pred.sampled_impedance[: group.n_compared], 0.0 * problem.q_std, problem.q_std**2)
        position = np.diagonal(position, axis1=1, axis2=2).real
        shares.append(problem.tau_std**2 / (problem.tau_std**2 + position))
        # Joint by joint: what whitening takes from one joint for what others show is no measure of its own two noises.
        assumed = np.diagonal(result.weights.covariance[i], axis1=1, axis2=2)[:, :n].real
        left.append(output_error(group, pred)[..., :n] * np.sqrt(2.0 / assumed))
    # Lines of a motion are seen through its window: their squares are told in units of the numbers that they are.
    mean = np.concatenate([np.abs(X[:, 1:, :n]).reshape(-1, n) ** 2 for X in whitened(problem, result, found)]).mean(
        axis=0
    )
    unit = np.sqrt(result.costs / result.counts / np.maximum(mean, 1e-300))
    return [X * unit for X in left], shares


def with_noise_of_fast_lines(dataset: Dataset, problem: Problem, result: Fit) -> Problem:
    """Noise of the torque in motions raised to what a fit leaves in the upper half of the compared band, where it leaves
    hardly more below.

    Noise of which neighbouring samples go together is more there than their differences, or its size, say, at most
    joints. What a model lacks follows the motion, and shows most at the slow lines of it, at some joint. Noise that is
    given is denied only by about as much of it at all of three joints or more.
    """
    n, guessed = problem.structure.n, guessed_noise(dataset)[1]
    if not problem.motions_alone or n < (2 if guessed else FEWEST_ALIKE):  # no others to compare a joint with
        return problem
    whole, torque = power_at_fast_lines(*left_at_lines(problem, result))
    if np.any(result.costs > SLOW_LINES * whole * result.counts) or np.sum(whole > LOUD) <= n / 2:
        return problem
    if not guessed and not (np.all(whole > LOUD) and whole.max() < ALIKE * whole.min()):
        return problem
    # Of noise that falls off within the band the fast lines hold the least.
    torque = torque * np.maximum(result.costs / (whole * result.counts), 1.0)
    return replace(problem, tau_std=problem.tau_std * np.sqrt(np.maximum(torque, 1.0)), noise_denied=not guessed)


def with_known_noise(problem: Problem) -> Problem:
    """What noise adds to costs, of records of a single period whose noise is measured, by its levels: no periods differ
    there."""

    def known(group: Group) -> Group:
        if group.window is not None or group.U_noise is None:
            return group
        torque, position = (std**2 / problem.samples(group) for std in (problem.tau_std, problem.q_std))
        return replace(group, known_noise=(torque, position))

    return replace(problem, groups=tuple(map(known, problem.groups)))


def with_measured_noise(problem: Problem, result: Fit) -> Problem:
    """Sample noise from the scatter between periods, for records that have a single one."""
    impedances = [p.sampled_impedance for p in predictions(problem, result.model, result.remainders)]
    levels = sample_noise(problem.groups, impedances, [problem.samples(g) for g in problem.groups])
    if levels is None:
        return problem
    return replace(problem, tau_std=np.maximum(levels[0], 1e-6), q_std=np.maximum(levels[1], 1e-10))
