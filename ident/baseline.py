"""The baseline of a diagnosis: the gray-box without causes, fitted from several starts, and whether its drives can be
those of the arm."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
import scipy.stats

from ident.graybox import Parameters
from ident.log_spectra import FIELDS, KNOWN, begun_by_logarithms, credible, looked_at, mean_cost, valley
from ident.model import Effect, Model
from ident.problem import NOT_COMPUTED, Problem
from ident.torque_fit import ANNEALING, Fit, anneal, fit
from robot_assets.robot import guessed_drives

DETECTION_EXCESS = 1.10  # chi2 per degree of freedom up to which the estimate of the noise may be short of it
FAINT = 3.0  # chi2 per degree of freedom up to which what is left is searched from linear steps that keep the data
JOINT_EXCESS = 1.25  # the same of a single joint
JOINT_CHANCE = 4.0  # standard deviations of that by chance, which few data leave
ERROR_OF_LAWS = 0.01  # of what causes explain at a joint, left there by errors of their laws
RESTART_DAMPING = (1.0, 10.0)  # factors on the dampers from which the baseline is fitted again
ASTRAY = 10.0  # factor between a damper and its starting guess, beyond which the gear begins again
HOPELESS = 3e3  # chi2 per degree of freedom that no damper can have caused
LAST_STEPS = 8  # at most, under the noise that the baseline sees itself
RENEWALS = 3  # at most, of that noise
# natural logarithm of a drive figure, up to which a fit has moved so little that its noise is its own
SAME_NOISE = 0.05
UNDETERMINED = 0.2  # relative standard deviation above which a parameter counts as not determined


def fit_baseline(
    problem: Problem, progress: Callable[[str], None] | None = None, effects: tuple[Effect, ...] = ()
) -> Fit:
    """Baseline parameters of the gray-box, with the ``effects`` that every candidate has too.

    Where the fit leaves more than the noise it is started again: with less error added from the first, which leads into
    other minima; from drives that the logarithms of the spectra tell, which come first where the nominal ones are
    guesses; with other dampers, which are determined far worse than springs, and do not come back once they have
    collapsed; and gears that have gone astray, as one that is overdamped and hides its spring, from their guesses.
    """
    guessed = bool(guessed_drives(problem.structure.robot))

    def told() -> Problem:
        """The problem with the drives of ``begun_by_logarithms`` as those near which a fit is held at first."""
        return replace(problem, nominal=begun_by_logarithms(problem))

    def begun(there: Problem, ladder: Sequence[float] = ANNEALING) -> Fit:
        """Fitted from the nominal drives of a problem."""
        return anneal(there, Model(there.structure, there.nominal, effects), ladder=ladder, progress=progress)

    here = told() if guessed else problem
    best = first = begun(here)
    softer = first.softer

    def again(par: Parameters) -> Fit:
        """Fitted from other drives."""
        return anneal(
            problem,
            replace(best.model, par=par),
            ladder=ANNEALING[-2:],
            iterations=8,
            remainders=best.remainders,
            progress=progress,
        )

    if best.chi2_per_dof > DETECTION_EXCESS:
        rest = first if problem.motions_alone else begun(problem if guessed else told())
        best = min(first, begun(here, ANNEALING[1:]), rest, key=lambda f: (np.sum(astray(problem, f)), f.cost))
        softer = rest.softer if best is rest else first.softer
    if DETECTION_EXCESS < best.chi2_per_dof < HOPELESS:
        for factor in RESTART_DAMPING:
            par = best.model.par
            damping = np.maximum(par.damping, problem.nominal.damping) * factor
            best = min(best, again(replace(par, damping=damping)), key=lambda f: f.cost)
    lost = astray(problem, best)
    if best.chi2_per_dof > DETECTION_EXCESS and np.any(lost):
        other = again(begun_again(problem, best.model.par, lost))
        # Where they only go astray elsewhere they stand for what is missing.
        if other.cost < best.cost and np.sum(astray(problem, other)) < np.sum(lost):
            best = other
    return replace(renewed(problem, best, progress), softer=softer)


def renewed(problem: Problem, result: Fit, progress: Callable[[str], None] | None = None) -> Fit:
    """A fit under the noise that its own model passes on: its weights are those of a model on the way."""
    best = result
    for _ in range(RENEWALS):
        on_the_way = best.model.par.to_log()
        try:
            best = fit(problem, best.model, iterations=LAST_STEPS, remainders=best.remainders, progress=progress)
        except NOT_COMPUTED:
            break  # drives gone astray pass on noise without bounds
        if np.max(np.abs(best.model.par.to_log() - on_the_way)) < SAME_NOISE:
            break
    return replace(best, softer=result.softer)


def begun_again(problem: Problem, par: Parameters, lost: np.ndarray) -> Parameters:
    """Parameters with the drives of some joints (n,) back at where they began."""
    return replace(par, **{name: np.where(lost, getattr(problem.begun, name), getattr(par, name)) for name in FIELDS})


def start_of(problem: Problem, result: Fit) -> Parameters | None:
    """Drives to begin with where those of a fit have been led away: the logarithms of the spectra agree better there;
    else None."""
    spectra = looked_at(problem) if result.chi2_per_dof > FAINT else []
    if not spectra:
        return None
    model, cost = valley(problem, spectra, Model(problem.structure, problem.nominal))
    there = replace(problem, start=model.par)
    return model.par if bent(there, result) and cost < mean_cost(problem, spectra, result.model) else None


def astray(problem: Problem, result: Fit) -> np.ndarray:
    """(n,) whether a gear has ended far from its starting guess."""
    par, guess = result.model.par, problem.nominal
    far = [np.abs(np.log(a / b)) for a, b in ((par.stiffness, guess.stiffness), (par.damping, guess.damping))]
    return (far[0] > credible(problem)) | (far[1] > np.log(ASTRAY) + credible(problem) - np.log(KNOWN))


def discrepancy_p_value(result: Fit) -> float:
    """Probability of a cost this large by noise alone: of all joints, or of the clearest of those that are ``loud``
    (Bonferroni).

    By chi-square (Wilson-Hilferty in the tail).
    """
    dof = max(result.count - len(result.names), 1)
    whole = float(scipy.stats.chi2.sf(result.cost, dof))
    at = loud(result)
    if not np.any(at):
        return whole
    each = scipy.stats.chi2.sf(result.costs[at], np.maximum(result.counts[at], 1.0))
    return min(whole, float(len(at) * np.min(each)))


def loud(result: Fit, told: np.ndarray | float = 0.0) -> np.ndarray:
    """(n,) whether a joint alone leaves clearly more than noise, which all joints together may hide.

    The noise of one joint is known less well than that of all, and laws of causes that are named leave more at their
    own.

    Args:
        told: (n,) fall of the cost by joint that causes have brought.
    """
    by_chance = JOINT_EXCESS - 1.0 + JOINT_CHANCE * np.sqrt(2.0 / np.maximum(result.counts, 1.0))
    by_laws = ERROR_OF_LAWS * np.maximum(told, 0.0)
    return result.costs - result.counts > np.maximum(by_chance * result.counts, by_laws)


def implausible(problem: Problem, result: Fit, joints: Sequence[int] | None = None) -> bool:
    """Whether drives of a fit cannot be those of this arm: a stiffness or motor inertia far from its starting guess.

    They then stand for what is missing.

    Args:
        joints: whose drives are looked at; all where None.
    """
    return _far(problem, result, problem.nominal, credible(problem), joints)


def bent(problem: Problem, result: Fit) -> bool:
    """Whether drives of a fit have been led away, from what an arm like this may have or from what the problem begins
    with."""
    if problem.start is None:
        return False
    near = np.full(problem.structure.n, np.log(KNOWN))
    return implausible(problem, result) or _far(problem, result, problem.start, near)


def _far(
    problem: Problem, result: Fit, centre: Parameters, limit: np.ndarray, joints: Sequence[int] | None = None
) -> bool:
    """Whether a stiffness or motor inertia is further than a limit (n,), natural logarithm of a factor, from others."""
    n, x = problem.structure.n, result.model.par.to_log() - centre.to_log()
    drives = np.r_[:n, 2 * n : 3 * n]  # stiffness and motor inertia
    known = np.sqrt(np.maximum(np.diag(result.covariance())[drives], 0.0)) < UNDETERMINED
    limit = np.tile(limit, 2)
    # A gear stiffer than the data can see ends anywhere above. Motions hardly show gears, nor a small motor beside
    # its link: there the gears take up what else is wrong, and only a motor that is known tells.
    low = x[drives] < -limit
    if problem.motions_alone:
        known[:n] = False
        low &= known
    far = (low | (known & (x[drives] > limit))).reshape(2, n)
    return bool(np.any(far if joints is None else far[:, list(joints)]))
