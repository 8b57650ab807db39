"""Fits to synthetic FRFs of the ur10: recovery, bounds, intervals, what is not determined."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import chi2

from ident.chain import build_structure
from ident.estimate import ESTIMATORS, UNSEEN, _sandwich, fit_frf
from ident.excitation import operating_points
from ident.frf_basis import FRF
from ident.graybox import Parameters, equilibrium, linearise, parameter_names, sampled_frf
from robot_assets.errors import DataError
from robot_assets.robot import load_robot

pytestmark = pytest.mark.xdist_group("estimate")  # one worker makes what they share

STEP = 1e-3
BAND = np.geomspace(1.0, 60.0, 45)


@pytest.fixture(scope="module")
def arm(ur10):
    """(structure, nominal, truth off by up to two, postures (2, n))."""
    rng = np.random.default_rng(11)
    nominal = Parameters.nominal(ur10)
    x = nominal.to_log()
    return (
        build_structure(ur10),
        nominal,
        nominal.with_log(x + rng.uniform(-np.log(2), np.log(2), len(x))),
        np.array(operating_points(ur10, 2, rng)),
    )


def model_of(structure, par, postures, frequency=BAND):
    """(Q, F, n, n) at the equilibrium that belongs to the parameters."""
    lins = [linearise(structure, equilibrium(structure, par, q)) for q in postures]
    return np.stack([sampled_frf(structure, par, lin, frequency, STEP, "zoh")[0] for lin in lins])


def measured(G, postures, rng, *, relative=0.01, floor=0.0, frequency=BAND):
    """FRF of correlated circular noise: a share of each entry and a share of each line's largest."""
    Q, F, n, _ = G.shape
    g = np.swapaxes(G, -1, -2).reshape(Q, F, n * n)
    std = np.sqrt((relative * np.abs(g)) ** 2 + (floor * np.abs(g).max(axis=-1, keepdims=True)) ** 2)
    mix = np.linalg.cholesky(0.5 * np.eye(n * n) + 0.5)
    root = std[..., None] * mix
    z = (rng.normal(size=g.shape) + 1j * rng.normal(size=g.shape)) / np.sqrt(2)
    noisy = g + (root @ z[..., None])[..., 0]
    entry = np.swapaxes(std.reshape(Q, F, n, n), -1, -2)
    covariance = (root @ np.swapaxes(root, -1, -2)).astype(complex)
    return FRF(
        G=np.swapaxes(noisy.reshape(Q, F, n, n), -1, -2),
        covariance=covariance,
        noise_std=entry,
        total_std=entry,
        frequency=frequency,
        lines=np.arange(1, F + 1),
        operating_points=tuple(f"p{i}" for i in range(Q)),
        q0=postures,
        amplitude=1.0,
        realizations=1,
        periods=2,
        estimator="jio",
    )


def fit(arm, frf, start=None, **kwargs):
    structure, nominal, _, _ = arm
    kwargs.setdefault("starts", None if start is None else (start,))
    return fit_frf(structure, frf, nominal, sample_time=STEP, hold="zoh", **kwargs)


def log_error(result, truth):
    return result.parameters.to_log() - truth.to_log()


@pytest.mark.parametrize("estimator", ESTIMATORS)
def test_drives_off_by_two_are_found(arm, estimator):
    structure, _, truth, postures = arm
    frf = measured(model_of(structure, truth, postures), postures, np.random.default_rng(0))
    result = fit(arm, frf, estimator=estimator)
    error = np.abs(log_error(result, truth))
    std = np.sqrt(np.diag(result.covariance))[:-1]
    assert np.all(error < 4 * std)
    assert error[:6].max() < 0.01 and error[12:18].max() < 0.01
    assert not result.undetermined


@pytest.mark.parametrize("estimator", ["wnls", "wlls"])
def test_records_without_noise_are_fitted_to_what_rounding_leaves(arm, estimator):
    """A simulation without noise repeats to the last digit: covariances next to nothing, or none of some lines but
    rounding."""
    structure, _, truth, postures = arm
    frf = measured(model_of(structure, truth, postures), postures, np.random.default_rng(0), relative=1e-12)
    frf = replace(
        frf,
        covariance=1e-306
        * (1.0 + np.arange(len(BAND)))[None, :, None, None]
        * np.eye(structure.n**2, dtype=complex)[None, None].repeat(len(postures), 0),
    )
    result = fit(arm, frf, estimator=estimator)
    assert np.all(np.isfinite(result.covariance)) and np.abs(log_error(result, truth)).max() < 1e-5


def test_the_sag_is_solved_for_the_parameters_found(arm):
    """Without noise every estimator ends at the truth itself, from springs four times too soft."""
    structure, nominal, truth, postures = arm
    frf = measured(model_of(structure, truth, postures), postures, np.random.default_rng(0), relative=1e-9)
    soft = replace(nominal, stiffness=truth.stiffness / 4)
    for estimator in ("lls", "wlls"):
        assert np.abs(log_error(fit(arm, frf, soft, estimator=estimator), truth)).max() < 1e-5


@pytest.fixture(scope="module")
def draws(arm):
    """Fits of every estimator to the same 16 draws: errors (16, 24), deviations (16, 24)."""
    structure, _, truth, postures = arm
    G = model_of(structure, truth, postures)
    out = {e: ([], []) for e in ("nls", "wnls", "wlls")}
    for seed in range(16):
        frf = measured(G, postures, np.random.default_rng(seed), relative=0.03)
        for estimator, (errors, stds) in out.items():
            result = fit(arm, frf, truth, estimator=estimator)
            errors.append(log_error(result, truth))
            stds.append(np.sqrt(np.diag(result.covariance))[:-1])
    return {e: (np.array(a), np.array(b)) for e, (a, b) in out.items()}


@pytest.mark.parametrize("estimator", ["nls", "wnls", "wlls"])
def test_intervals_cover_the_truth(draws, estimator):
    error, std = draws[estimator]
    assert 0.90 <= np.mean(np.abs(error) < 1.96 * std) <= 0.99


def test_weighted_fits_reach_the_cramer_rao_bound(arm, draws):
    """The bound ``[2 Re J^H Lambda^-1 J]^-1`` with J by central differences (theory.md 4)."""
    structure, _, truth, postures = arm
    frf = measured(model_of(structure, truth, postures), postures, np.random.default_rng(0), relative=0.03)
    x = truth.to_log()
    columns = []
    for i in range(len(x) + 1):
        step = np.zeros(len(x))
        if i < len(x):
            step[i] = 1e-5
        shift = 1e-8 if i == len(x) else 0.0
        up, down = (
            model_of(structure, replace(truth.with_log(x + s * step), timing=s * shift), postures) for s in (1, -1)
        )
        d = (up - down) / (2 * shift or 2e-5)
        columns.append(np.swapaxes(d, -1, -2).reshape(-1, 36))
    J = np.stack(columns, axis=-1)
    inverse = np.linalg.inv(frf.covariance.reshape(-1, 36, 36))
    bound = np.diag(np.linalg.inv(2 * np.einsum("kip,kij,kjq->pq", J.conj(), inverse, J, optimize=True).real))[:-1]
    for estimator in ("wnls", "wlls"):
        error, std = draws[estimator]
        assert 0.75 < np.mean(error**2 / bound) < 1.3
        assert np.allclose(std**2, bound, rtol=0.35)
    assert np.mean(draws["nls"][0] ** 2 / bound) > 1.5


def test_entries_below_the_noise_do_not_bias_log_fits(arm):
    structure, _, truth, postures = arm
    G = model_of(structure, truth, postures)
    frf = measured(G, postures, np.random.default_rng(3), relative=0.01, floor=0.01)
    buried = np.mean(np.abs(G) < 3 * frf.total_std)
    assert buried > 0.1
    result = fit(arm, frf, truth, estimator="wlls")
    assert result.residuals < 0.95 * G.size
    assert np.abs(log_error(result, truth))[:6].max() < 0.01


def test_weak_entries_do_not_bias_weighted_log_fits(arm):
    """Entries from a hundredth to thirty times their deviation: the mean error over draws is that of chance.

    Measured entries as weights, and a mask that keeps those that noise has raised, give mean errors of up to three
    standard deviations.
    """
    structure, _, truth, postures = arm
    G, z = model_of(structure, truth, postures), []
    for seed in range(16):
        result = fit(
            arm, measured(G, postures, np.random.default_rng(seed), floor=0.03), truth, estimator="wlls", search=False
        )
        z.append(log_error(result, truth) / np.sqrt(np.diag(result.covariance))[:-1])
    mean = np.mean(z, axis=0) * np.sqrt(len(z))
    assert np.sum(mean**2) < chi2.ppf(1 - 1e-3, mean.size)
    assert 0.8 < np.mean(np.square(z)) < 1.25


def test_what_the_band_does_not_show_is_said(arm):
    """Below 2 Hz no spring damper can be seen; the motor and load inertias add up."""
    structure, _, truth, postures = arm
    low = np.linspace(0.3, 2.0, 20)
    G = model_of(structure, truth, postures, low)
    frf = measured(G, postures, np.random.default_rng(0), frequency=low)
    result = fit(arm, frf, truth, estimator="wlls")
    dampers = {f"damping.{j}" for j in structure.robot.joint_names}
    assert len(dampers & set(result.undetermined)) >= 5


def test_an_unseen_direction_has_no_small_deviation():
    """Two parameters of which the data show only the sum, and one that they do not show at all."""
    J = np.array([[1.0, 1.0, 0.0, 0.0], [0.0, 0.0, 0.0, 2.0]]) * 1e3
    H = J.T @ J
    C = _sandwich(H, 0.5 * H)
    assert C[0, 0] > 0.4 * UNSEEN and C[2, 2] == pytest.approx(UNSEEN)
    assert C[0, 0] + 2 * C[0, 1] + C[1, 1] < 1e-3
    assert C[3, 3] == pytest.approx(0.5 / 4e6)


def test_correlations_are_of_unit_diagonal_and_starts_repeat(arm):
    structure, _, truth, postures = arm
    frf = measured(model_of(structure, truth, postures), postures, np.random.default_rng(0))
    one, two = fit(arm, frf, estimator="wlls", seed=3), fit(arm, frf, estimator="wlls", seed=3)
    assert np.array_equal(one.parameters.to_log(), two.parameters.to_log())
    assert np.allclose(np.diag(one.correlation), 1.0) and np.abs(one.correlation).max() < 1 + 1e-9


def test_weak_springs_do_not_run_away():
    """The irb from nominal figures alone: a search that trusts weak entries loses hinges in some draws."""
    robot = load_robot("irb")
    structure, nominal = build_structure(robot), Parameters.nominal(robot)
    rng = np.random.default_rng(0)
    names = parameter_names(robot)
    elastic = np.array([name.startswith(("stiffness", "damping")) for name in names])
    truth = nominal.with_log(nominal.to_log() + elastic * rng.uniform(-0.3, 0.3, len(names)))
    postures = operating_points(robot, 2, rng)
    band = np.geomspace(1.0, 60.0, 30)
    G = model_of(structure, truth, postures, band)
    fitted = [name for name, use in zip(names, elastic, strict=True) if use]
    for seed in range(12):
        frf = measured(G, postures, np.random.default_rng(seed), relative=0.02, floor=0.003, frequency=band)
        result = fit((structure, nominal, truth, postures), frf, nominal, estimator="wnls", fitted=fitted)
        error = log_error(result, truth)[elastic]
        assert np.all(np.abs(error) < 5 * np.sqrt(np.diag(result.covariance)))
        assert np.abs(error).max() < 0.5


def test_parameters_can_be_held(arm):
    """The springs alone, all else known: closer than when all is fitted, and nothing else moves."""
    structure, nominal, truth, postures = arm
    frf = measured(model_of(structure, truth, postures), postures, np.random.default_rng(0))
    springs = [n for n in parameter_names(structure.robot) if n.startswith("stiffness")]
    start = replace(truth, stiffness=nominal.stiffness)
    held, whole = fit(arm, frf, start, fitted=springs), fit(arm, frf, start)
    assert held.names == tuple(springs) and held.covariance.shape == (6, 6)
    assert np.array_equal(held.parameters.to_log()[6:], truth.to_log()[6:])
    assert np.all(np.diag(held.covariance) <= np.diag(whole.covariance)[:6])
    assert np.all(np.abs(log_error(held, truth))[:6] < 4 * np.sqrt(np.diag(held.covariance)))
    with pytest.raises(DataError, match="mass"):
        fit(arm, frf, fitted=["mass"])


def test_wrong_calls_are_refused(arm):
    structure, _, truth, postures = arm
    frf = measured(model_of(structure, truth, postures), postures, np.random.default_rng(0))
    with pytest.raises(DataError, match="estimator"):
        fit(arm, frf, estimator="ols")
    with pytest.raises(DataError, match="covariance"):
        fit(arm, replace(frf, covariance=0 * frf.covariance), estimator="wlls")
    with pytest.raises(DataError, match="5 motors"):
        fit(arm, replace(frf, G=frf.G[..., :5, :5]))
