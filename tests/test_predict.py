"""Predictors against closed forms, against each other and against FRF matching."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import chi2

from ident.chain import build_structure
from ident.cutting import cut_recording, schedule_plan
from ident.estimate import fit_frf
from ident.filters import extended_kalman, particle_filter, stepper
from ident.frf_basis import FRF
from ident.graybox import Parameters, equilibrium, impedance, linearise, parameter_names, sampled_frf
from ident.kalman import StateSpace, innovations, kalman, local_predictor, state_space
from ident.predict import Noise, Runs, fit_prediction, gaussian, runs_of, score
from ident.recursion import along_z, chain_of
from robot_assets.errors import DataError
from robot_assets.robot import load_robot
from sim import run_experiment
from sim.experiment import plan_experiment
from sim.recording import run_recording

pytestmark = pytest.mark.xdist_group("predict")  # one worker makes what they share

TS = 1e-3
PERIOD = 1000
Q0 = np.array([-0.8, 0.9])
LOOP = np.array([1e4, 3e3])  # N m/rad, holds the pair where gravity would let it fall


@pytest.fixture(scope="module")
def twomass():
    robot = load_robot("twomass")
    return build_structure(robot), Parameters.nominal(robot)


@pytest.fixture(scope="module")
def pair():
    """Shoulder lift and elbow of the UR10, the other joints locked."""
    robot = load_robot("ur10")
    locked = {j: 0.3 for j in robot.joint_names if j not in ("shoulder_lift_joint", "elbow_joint")}
    return replace(robot, joints=robot.joints[1:3], locked=locked, q_min=robot.q_min[1:3], q_max=robot.q_max[1:3])


def linear(structure, par, q0=None):
    lin = linearise(structure, equilibrium(structure, par, np.zeros(structure.n) if q0 is None else q0))
    return lin, state_space(structure, par, lin, TS)


def simulated(space, noise, r, rng, stiff=0.0):
    """(torques, positions) (R, T, n) of the linear arm from rest, both noises drawn: written out here.

    ``r`` (R, T, n) is added to the torque of a loop of stiffness ``stiff`` (n,). All that the loop knows is ``y``:
    one that felt the state itself would tell more than predictions from ``y`` and ``u`` may know.
    """
    R, T, n = r.shape
    x, u, y, v = np.zeros((R, len(space.A))), np.empty(r.shape), np.empty(r.shape), np.zeros((R, n))
    for t in range(T):
        y[:, t] = x[:, :n] + noise.measurement * rng.standard_normal((R, n))
        v = 0.8 * v + 0.2 * (y[:, t] - y[:, max(t - 1, 0)]) / TS
        u[:, t] = r[:, t] - stiff * (y[:, t] + 0.1 * v)
        x = x @ space.A.T + (u[:, t] + noise.process * rng.standard_normal((R, n))) @ space.B.T
    return u, y


def multisine(rng, n, periods, amplitude):
    """(n experiments, periods PERIOD, n) orthogonal random-phase torque on odd lines of 1 to 80 Hz; lines."""
    lines = np.arange(1, 80, 2)
    phase = np.exp(2j * np.pi * (rng.random((len(lines), 1, n)) + np.outer(np.arange(n), np.arange(n)) / n))
    X = np.zeros((n, PERIOD // 2 + 1, n), complex)
    X[:, lines] = 0.5 * amplitude * phase.transpose(1, 0, 2)
    return np.tile(np.fft.irfft(X, n=PERIOD, axis=1, norm="forward"), (1, periods, 1)), lines


def test_riccati_of_a_scalar_system():
    a, b, q, r = 0.9, 0.5, 0.3, 0.7
    # p^2 + p (r (1 - a^2) - b^2 q^2) - b^2 q^2 r = 0, the positive root. A second state carries nothing.
    half = r**2 * (1 - a**2) - b**2 * q**2
    p = 0.5 * (-half + np.sqrt(half**2 + 4 * b**2 * q**2 * r**2))
    space = StateSpace(np.diag([a, 0.5]), np.array([[b], [0.0]]), np.eye(2), np.ones((2, 1)))
    found = kalman(space, Noise(np.array([q]), np.array([r])), 1.0)
    assert found.P[0, 0] == pytest.approx(p, rel=1e-10)
    assert found.Lambda[0, 0] == pytest.approx(p + r**2, rel=1e-10)
    assert found.K[0, 0] == pytest.approx(a * p / (p + r**2), rel=1e-10)


def test_riccati_equation_of_a_six_axis_arm_is_met():
    robot = load_robot("irb")
    structure, par = build_structure(robot), Parameters.nominal(robot)
    _, space = linear(structure, par, np.array([0.3, -0.4, 0.2, 0.5, -0.6, 0.1]))
    noise = Noise(robot.array("tau_std"), robot.array("q_std"))
    k, Q = kalman(space, noise, TS), space.B * noise.process**2 @ space.B.T
    d = np.sqrt(np.diag(k.P))
    assert np.max(np.abs(space.A @ k.P @ space.A.T + Q - k.K @ k.Lambda @ k.K.T - k.P) / np.outer(d, d)) < 1e-6
    C = np.eye(structure.n, len(space.A))
    assert np.abs(np.linalg.eigvals(space.A - k.K @ C)).max() < 1


def test_state_space_is_the_impedance_and_its_sampled_frf(pair):
    structure, par = build_structure(pair), Parameters.nominal(pair)
    lin, space = linear(structure, par, Q0)
    f = np.array([0.7, 4.0, 15.0, 60.0])
    eye = np.eye(len(space.A))
    for w, Z in zip(2 * np.pi * f, impedance(structure, par, lin, 2j * np.pi * f)[0], strict=True):
        np.testing.assert_allclose(
            np.linalg.solve(1j * w * eye - space.continuous, space.gain)[:2], np.linalg.inv(Z), rtol=1e-9
        )
    G, _ = sampled_frf(structure, par, lin, f, TS, "zoh")
    for w, g in zip(2 * np.pi * f, G, strict=True):
        exact = -(w**2) * np.linalg.solve(np.exp(1j * w * TS) * eye - space.A, space.B)[:2]
        assert np.abs(exact - g).max() < 1e-4 * np.abs(exact).max()


def test_innovations_are_white_with_the_predicted_covariance(pair):
    structure, par = build_structure(pair), Parameters.nominal(pair)
    _, space = linear(structure, par, Q0)
    noise, rng = Noise(np.array([0.5, 0.3]), np.array([3e-6, 5e-6])), np.random.default_rng(0)
    u, _ = multisine(rng, 2, 20, 0.5)
    u, y = simulated(space, noise, u, rng, LOOP)
    k = kalman(space, noise, TS)
    e = np.stack([innovations(k, *run) for run in zip(u, y, strict=True)])[:, 2 * PERIOD :].reshape(-1, 2)
    w = np.linalg.solve(np.linalg.cholesky(k.Lambda), e.T).T
    count = len(w)
    assert chi2.ppf(1e-4, 2 * count) < np.sum(w**2) < chi2.ppf(1 - 1e-4, 2 * count)
    correlation = np.stack([w[lag:].T @ w[:-lag] / np.sqrt(count) for lag in range(1, 51)])
    assert chi2.ppf(1e-4, 200) < np.sum(correlation**2) < chi2.ppf(1 - 1e-4, 200)
    worse = innovations(kalman(space, replace(noise, process=noise.process / 5), TS), u[0], y[0])[2 * PERIOD :]
    assert np.sum(worse[1:] * worse[:-1]) > 0.05 * np.sum(worse**2)


@pytest.mark.slow
def test_extended_filter_is_the_kalman_predictor_on_a_linear_arm(twomass):
    structure, par = twomass
    _, space = linear(structure, par)
    noise, rng = Noise(np.array([0.05]), np.array([1e-5])), np.random.default_rng(1)
    u, _ = multisine(rng, 1, 2, 0.3)
    u, y = simulated(space, noise, u, rng)
    runs = Runs(u, y, np.zeros(1, int), np.zeros((1, 1)), 0, TS)
    found, k = extended_kalman(structure, runs)(par, noise), kalman(space, noise, TS)
    np.testing.assert_allclose(found.innovations[0], innovations(k, u[0], y[0]), atol=1e-5 * np.sqrt(k.Lambda[0, 0]))
    np.testing.assert_allclose(found.covariance, np.broadcast_to(k.Lambda, found.covariance.shape), rtol=1e-6)


@pytest.mark.slow
def test_extended_filter_predicts_the_whole_arm_of_another_engine(pair):
    """Geometry of the arm, far above the noise: the linear predictor misses it, the filter whitens it."""
    plan = plan_experiment(
        pair, Q0[None], points=1, validation_points=0, levels=(1.0,), period=PERIOD, periods=2, trajectory=False
    )
    runs = runs_of(run_experiment(plan, seed=3))
    structure, par = build_structure(pair), Parameters.nominal(pair)
    # Recorded torque has noise of its own beside half of it that acts on the motor.
    noise = Noise(np.hypot(1.0, 0.5) * pair.array("tau_std"), pair.array("q_std"))

    found, plain = (make(structure, runs)(par, noise) for make in (extended_kalman, local_predictor))
    w = np.linalg.inv(np.linalg.cholesky(found.covariance)) @ found.innovations[..., None]
    assert np.mean(w**2) == pytest.approx(1.0, abs=4 * np.sqrt(2 / w.size))
    assert found.log_likelihood > plain.log_likelihood + 20


def test_runs_that_begin_in_motion_are_predicted_from_there(pair):
    """The second experiment of one long recording follows the first without a stop."""
    plan = plan_experiment(
        pair,
        Q0[None],
        points=1,
        validation_points=0,
        levels=(1.0,),
        period=PERIOD,
        periods=2,
        transient_periods=0,
        trajectory=False,
    )
    schedule = schedule_plan(plan)
    runs = runs_of(cut_recording(run_recording(schedule, seed=3), schedule))
    assert runs.skip == PERIOD and runs.spread is not None
    assert np.all(runs.spread[0] == 0) and np.all(runs.spread[1] > 0)
    structure, par = build_structure(pair), Parameters.nominal(pair)
    noise = Noise(np.hypot(1.0, 0.5) * pair.array("tau_std"), pair.array("q_std"))
    found = extended_kalman(structure, replace(runs, skip=0))(par, noise)
    w = np.linalg.inv(np.linalg.cholesky(found.covariance)) @ found.innovations[..., None]
    for part in (slice(0, 20), slice(20, 200), slice(200, None)):
        few = w[1, part]
        assert np.mean(few**2) < 1.0 + 5 * np.sqrt(2 / few.size)
    assert np.mean(w**2) == pytest.approx(1.0, abs=4 * np.sqrt(2 / w.size))
    with pytest.raises(DataError, match="motion"):
        particle_filter(structure, runs)


@pytest.mark.slow
def test_particle_likelihood_converges_to_the_kalman_one(twomass):
    structure, par = twomass
    _, space = linear(structure, par)
    noise, rng = Noise(np.array([0.05]), np.array([1e-5])), np.random.default_rng(2)
    u, _ = multisine(rng, 1, 1, 0.3)
    u, y = simulated(space, noise, u[:, :300], rng)
    runs = Runs(u, y, np.zeros(1, int), np.zeros((1, 1)), 0, TS)
    k = kalman(space, noise, TS)
    exact = gaussian(innovations(k, runs.u[0], y[0])[None], k.Lambda[None, None]).log_likelihood
    spread = {}
    for particles in (100, 1600):
        draws = [
            particle_filter(structure, runs, particles=particles, seed=s)(par, noise).log_likelihood for s in range(12)
        ]
        spread[particles] = np.std(draws, ddof=1)
        # The likelihood is unbiased, so its logarithm lies low by half its variance (Pitt et al. 2012).
        error = np.mean(draws) + 0.5 * spread[particles] ** 2 - exact
        assert abs(error) < 4 * spread[particles] / np.sqrt(12) + spread[particles] ** 2
    assert spread[1600] < 0.6 * spread[100]  # a quarter, with 11 degrees of freedom each


def test_particle_filter_repeats_itself(twomass):
    structure, par = twomass
    u = np.zeros((1, 50, 1))
    runs = Runs(u, 1e-5 * np.random.default_rng(0).standard_normal(u.shape), np.zeros(1, int), np.zeros((1, 1)), 0, TS)
    noise, predict = Noise(np.array([0.05]), np.array([1e-5])), particle_filter(structure, runs, particles=30)
    assert predict(par, noise).log_likelihood == predict(par, noise).log_likelihood


def test_a_remainder_is_stepped_to_second_order(pair):
    """A free swing in steps of 4, 2 and 1 ms: errors fall with the square of the step."""
    structure, par = build_structure(pair), Parameters.nominal(pair)
    from ident.filters import _step

    noise, ends = Noise(pair.array("tau_std"), pair.array("q_std")), []
    for h in (4e-3, 2e-3, 1e-3, 1.25e-4):
        s = stepper(structure, par, noise, Q0, h)
        x = (s.x0 + np.repeat([0.0, 0.3], 4))[None]
        for _ in range(round(0.08 / h)):
            x, _, _ = _step(
                along_z(chain_of(structure.model)),
                x,
                s.u0[None] + 20.0,
                s.x0,
                s.u0,
                s.A,
                s.B,
                s.hold,
                s.rise,
                s.springs,
                s.flat,
            )
        ends.append(x[0])
    errors = [np.linalg.norm(x[:4] - ends[-1][:4]) for x in ends[:-1]]
    assert errors[0] / errors[1] > 3 and errors[1] / errors[2] > 3


def test_score_is_the_slope_of_the_likelihood(pair):
    structure, par = build_structure(pair), Parameters.nominal(pair)
    _, space = linear(structure, par, Q0)
    noise, rng = Noise(np.array([0.5, 0.3]), np.array([3e-6, 5e-6])), np.random.default_rng(4)
    u, _ = multisine(rng, 2, 2, 0.5)
    u, y = simulated(space, noise, u, rng, LOOP)
    runs = Runs(u, y + Q0, np.zeros(2, int), Q0[None], PERIOD, TS)
    predict, p = local_predictor(structure, runs), 8
    x = np.concatenate([par.to_log() + 0.02, np.log(noise.process) + 0.3, np.log(noise.measurement) - 0.1])

    def look(x):
        return predict(par.with_log(x[:p]), Noise(*np.exp(x[p:]).reshape(2, 2)))

    g, F = score(look, look(x), x, 1e-6)
    h = 1e-4 * np.eye(len(x))
    central = [(look(x + d).log_likelihood - look(x - d).log_likelihood) / 2e-4 for d in h]
    np.testing.assert_allclose(g, central, rtol=2e-3, atol=1e-3 * np.sqrt(np.diag(F)).min())


def fitting(structure):
    """What of two joints the tests fit: springs and dampers."""
    names = parameter_names(structure.robot)
    return [n for n in names if n.startswith(("stiffness", "damping"))]


def test_information_of_prediction_errors_is_that_of_frf_matching(pair):
    """Theory: in steady state criterion (3) is FRF matching weighted by (U U^H)^-T kron Phi_v."""
    structure, par = build_structure(pair), Parameters.nominal(pair)
    lin, space = linear(structure, par, Q0)
    noise = Noise(np.array([0.5, 0.3]), np.array([3e-6, 5e-6]))
    u, lines = multisine(np.random.default_rng(5), 2, 8, 0.5)
    u, y = simulated(space, Noise(np.zeros(2), np.zeros(2)), u, np.random.default_rng(0), LOOP)
    runs = Runs(u, y + Q0, np.zeros(2, int), Q0[None], 7 * PERIOD, TS)
    predict = local_predictor(structure, runs)
    x = par.to_log()
    _, F = score(lambda x: predict(par.with_log(x), noise), predict(par, noise), x, 1e-5)
    # The innovation covariance changes with the parameters too: what that tells is no part of FRF matching.
    e, S = predict(par, noise).innovations, kalman(space, noise, TS).Lambda
    root = np.linalg.inv(np.linalg.cholesky(S))
    J = np.stack(
        [((predict(par.with_log(x + 1e-5 * d), noise).innovations - e) / 1e-5 @ root.T).ravel() for d in np.eye(8)]
    )
    s = 2j * np.pi * lines / (PERIOD * TS)
    G, dG = sampled_frf(structure, par, lin, lines / (PERIOD * TS), TS, "zoh", derivatives=True)
    U = np.swapaxes(np.fft.rfft(u[:, -PERIOD:], axis=1)[:, lines], 0, 1).swapaxes(1, 2)
    H = G / s[:, None, None] ** 2
    Phi = PERIOD * (H * noise.process**2 @ np.conj(np.swapaxes(H, 1, 2)) + np.diag(noise.measurement**2))
    expected = 0.0
    for k in range(len(lines)):
        Psi = np.swapaxes(dG[k, ..., :8] / s[k] ** 2, 0, 1).reshape(4, 8)
        W = np.kron((U[k] @ np.conj(U[k].T)).T, np.linalg.inv(Phi[k]))
        expected = expected + 2 * (np.conj(Psi.T) @ W @ Psi).real
    d = np.sqrt(np.diag(expected))
    assert np.max(np.abs(J @ J.T - expected) / np.outer(d, d)) < 0.01
    assert np.all(np.diag(F) >= np.diag(J @ J.T))


def test_prediction_errors_and_frfs_give_the_same_estimates_and_cover_the_truth(pair):
    structure, par = build_structure(pair), Parameters.nominal(pair)
    names, periods = fitting(structure), 3
    truth = par.with_log(par.to_log() + np.array([0.3, -0.2, 0.2, -0.3, 0, 0, 0, 0]))
    chosen = np.array([n in names for n in parameter_names(pair)])
    lin, space = linear(structure, truth, Q0)
    noise, rng = Noise(np.array([0.5, 0.3]), np.array([3e-6, 5e-6])), np.random.default_rng(6)
    r, lines = multisine(rng, 2, periods + 3, 0.5)
    H, _ = sampled_frf(structure, truth, lin, lines / (PERIOD * TS), TS, "zoh")
    z, apart, ratio = [], [], []
    for _ in range(5):
        u, y = simulated(space, noise, r, rng, LOOP)
        runs = Runs(u, y + Q0, np.zeros(2, int), Q0[None], 3 * PERIOD, TS)
        fit = fit_prediction(
            local_predictor(structure, runs),
            structure,
            par,
            Noise(5 * noise.process, 2 * noise.measurement),
            fitted=names,
        )
        assert fit.converged
        # FRFs of the same samples, with the covariance that the noise gives them.
        s = 2j * np.pi * lines / (PERIOD * TS)
        U, Y = (
            np.fft.rfft(v[:, 3 * PERIOD :].reshape(2, periods, PERIOD, 2).mean(axis=1), axis=1)[:, lines]
            for v in (u, y)
        )
        U, Y = (v.transpose(1, 2, 0) for v in (U, Y))
        h = H / s[:, None, None] ** 2
        Phi = PERIOD / periods * (h * noise.process**2 @ np.conj(np.swapaxes(h, 1, 2)) + np.diag(noise.measurement**2))
        Phi = np.abs(s[:, None, None]) ** 4 * Phi
        left = np.linalg.inv(U @ np.conj(np.swapaxes(U, 1, 2)))
        covariance = np.stack([np.kron(a.T, b) for a, b in zip(left, Phi, strict=True)])[None]
        G = (s[:, None, None] ** 2 * Y @ np.linalg.inv(U))[None]
        std = np.sqrt(np.einsum("qfii->qfi", covariance).real).reshape(1, -1, 2, 2).swapaxes(-1, -2)
        frf = FRF(G, covariance, std, std, lines / (PERIOD * TS), lines, ("p1",), Q0[None], 1.0, 1, periods, "jio")
        match = fit_frf(structure, frf, par, sample_time=TS, hold="zoh", estimator="wnls", starts=(par,), fitted=names)
        deviation = np.sqrt(np.diag(fit.covariance))[:4]
        a, b = (f.parameters.to_log()[chosen] for f in (fit, match))
        z.append((a - truth.to_log()[chosen]) / deviation)
        apart.append((a - b) / deviation)
        ratio.append(np.sqrt(np.diag(match.covariance)) / deviation)
    z = np.array(z)
    assert np.sum(z**2) < chi2.ppf(1 - 1e-3, z.size)
    assert np.mean(np.abs(z) < 1.96) > 0.75
    # Prediction errors also use what the spectrum of the noise tells of the arm: the same but for a small part.
    assert np.sqrt(np.mean(np.square(apart))) < 0.5
    np.testing.assert_allclose(np.median(ratio, axis=0), 1.0, atol=0.15)


def test_what_cannot_be_fitted_is_told(twomass):
    structure, par = twomass
    runs = Runs(np.zeros((1, 20, 1)), np.zeros((1, 20, 1)), np.zeros(1, int), np.zeros((1, 1)), 0, TS)
    noise = Noise(np.array([0.05]), np.array([1e-5]))
    with pytest.raises(DataError, match=r"stiff\.drive"):
        fit_prediction(local_predictor(structure, runs), structure, par, noise, fitted=["stiff.drive"])
