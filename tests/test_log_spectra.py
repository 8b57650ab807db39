"""Drives to begin with, by the logarithms of the spectra."""

from dataclasses import replace

import numpy as np
import pytest

from ident.baseline import fit_baseline, implausible
from ident.graybox import equilibrium, impedance, linearise
from ident.inverse import torque_record
from ident.log_spectra import (
    FIELDS,
    GUESSED,
    KNOWN,
    begun_by_logarithms,
    costs_near,
    looked_at,
    mean_cost,
    spectra_of,
)
from ident.model import Model
from ident.time_steps import TimeSteps
from ident.torque_fit import anneal


def guessed_by(problem, par, factor, seed):
    """The problem of an arm whose drives are guesses, off by up to a factor."""
    rng, robot = np.random.default_rng(seed), problem.structure.robot
    off = {
        field: getattr(par, field) * factor ** rng.uniform(-1.0, 1.0, len(par.stiffness))
        for field in ("stiffness", "inertia", "damping", "viscous")
    }
    every = dict.fromkeys(robot.guessed, robot.joint_names)
    structure = replace(problem.structure, robot=replace(robot, guessed=every))
    return replace(problem, structure=structure, nominal=replace(par, **off))


@pytest.mark.parametrize("seed", range(4))
def test_drives_that_are_off_by_up_to_a_factor_of_ten_are_found_roughly(identified, seed):
    _, setup, result = identified
    problem = guessed_by(setup.problem, result.model.par, 10.0, seed)
    found = begun_by_logarithms(problem)
    for field, error in (("stiffness", 0.35), ("inertia", 0.15)):
        ratio = getattr(found, field) / getattr(result.model.par, field)
        assert np.max(np.abs(np.log(ratio))) < np.log1p(error), (field, ratio)


def test_least_squares_that_lead_away_from_far_guesses_end_at_the_drives_from_there(identified):
    _, setup, result = identified
    problem = guessed_by(setup.problem, result.model.par, 10.0, 1)
    astray = anneal(problem, replace(result.model, par=problem.nominal))
    assert astray.chi2_per_dof > 10.0
    found = fit_baseline(problem)
    assert found.chi2_per_dof < 1.1 and not implausible(problem, found)
    assert found.model.par.stiffness == pytest.approx(result.model.par.stiffness, rel=0.01)


@pytest.mark.parametrize(("guessed", "reach"), [(True, GUESSED), (False, KNOWN)])
def test_drives_stay_in_reach_of_what_is_known_of_them(identified, guessed, reach):
    _, setup, result = identified
    problem = guessed_by(setup.problem, result.model.par, 1.0, 0)
    far = replace(problem, nominal=replace(problem.nominal, stiffness=50.0 * problem.nominal.stiffness))
    if not guessed:
        far = replace(far, structure=setup.problem.structure)
    ratio = begun_by_logarithms(far).stiffness / far.nominal.stiffness
    assert np.all((ratio > 0.99 / reach) & (ratio < 1.01 * reach)) and np.min(ratio) < 2.0 / reach


def test_lines_that_are_noise_or_not_excited_are_not_looked_at(identified):
    group = identified[1].problem.groups[0]
    seen = spectra_of(group)
    assert seen.position.shape == seen.torque.shape == seen.seen.shape
    assert np.all(
        np.isin(
            seen.group.omega, group.omega[1 : group.n_compared][np.any(group.excited, axis=0)[1 : group.n_compared]]
        )
    )
    assert np.mean(seen.seen) > 0.5
    assert not np.any(spectra_of(replace(group, white_torque_noise=np.full(6, 1e9))).seen)


def whole_cost(problem, spectra, model):
    """Mean of the bounded squares of logarithms, of the whole impedance."""
    squares = []
    for x in spectra:
        lin = linearise(model.structure, equilibrium(model.structure, model.par, x.group.posture))
        Z = impedance(model.structure, model.par, lin, 1j * x.group.omega, x.group.steps)[0]
        torque = np.einsum("kij,skj->ski", Z, x.position)
        torque = torque_record(model.par, x.group, problem.sampling)[:, None] * torque
        squares.append(np.abs(np.log(torque / x.torque)[x.seen]) ** 2)
    every = np.concatenate(squares)
    return np.mean(every / (1.0 + every))


@pytest.mark.parametrize("steps", [None, TimeSteps(1e-3, "implicit"), TimeSteps(1e-3, "apart")])
def test_costs_near_a_model_are_those_of_each_model_there(identified, steps):
    """Whatever was asked before: what is kept of that is only what is still the same."""
    problem = identified[1].problem
    problem = replace(problem, groups=tuple(replace(g, steps=steps) for g in problem.groups))
    n, nominal, spectra = problem.structure.n, problem.nominal, looked_at(problem)
    cost_at = costs_near(problem, spectra, Model(problem.structure, nominal))
    rng, x = np.random.default_rng(0), np.zeros(4 * n)
    for k in rng.permutation(np.repeat(np.arange(4 * n), 2)):
        x[k] = rng.normal()
        drives = {f: getattr(nominal, f) * np.exp(x[i * n : (i + 1) * n]) for i, f in enumerate(FIELDS)}
        model = Model(problem.structure, replace(nominal, **drives))
        expected = whole_cost(problem, spectra, model)
        assert cost_at(x) == pytest.approx(expected, rel=1e-9)
        assert mean_cost(problem, spectra, model) == pytest.approx(expected, rel=1e-9)


def test_motions_tell_no_logarithms(identified):
    problem = identified[1].problem
    motions = replace(problem, groups=tuple(replace(g, window=np.ones(g.n_time)) for g in problem.groups))
    assert begun_by_logarithms(motions) is problem.nominal
