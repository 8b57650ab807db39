"""Estimators side by side.

H1, JIO, ARI, HAR and LOG: bias on a synthetic closed loop over noise. NLS, WNLS, LLS and WLLS: mean square
error over the Cramer-Rao bound and coverage of intervals on FRFs of the irb, the time of a fit, and how it
grows. The same and the torque-residual fit: errors on one effect-free UR10 data set.

    python benchmarks/bench_estimators.py [--full | DRAWS]
"""

from __future__ import annotations

import sys
import time

import numpy as np

from ident.chain import Structure, build_structure
from ident.estimate import ESTIMATORS, fit_frf
from ident.excitation import LOOP_HZ, Excitation, operating_points
from ident.frf import Blocks, average, estimate_frf
from ident.frf_basis import FRF
from ident.graybox import Parameters, impedance, parameter_names, sampled_frf
from ident.identification import identify
from ident.information import LOOP_DAMPING, Conditions, conditions, linearised
from ident.plan import make_plan
from robot_assets.robot import load_robot
from sim import run_experiment
from sim.experiment import draw_drives
from sim.plant import build_plant, link_inertia_diagonal

FIELDS = ("stiffness", "damping", "motor_inertia", "viscous_friction")
AVERAGES = ("h1", "jio", "ari", "har", "log")


def closed_loop(
    rng: np.random.Generator, noise: float, M: int = 20, F: int = 40, n: int = 3
) -> tuple[np.ndarray, Blocks]:
    """(G (F, n, n), spectra) of ``u = r - 0.8 y``, ``y = G u + v``; noise relative to r."""
    k = np.linspace(0.2, 2.0, F)[:, None, None]
    G = (np.eye(n) / (1 + 1j * k) + 0.15 * (1 - np.eye(n)) / (1 + 2j * k)).astype(complex)
    T = np.exp(2j * np.pi * np.outer(np.arange(n), np.arange(n)) / n) / np.sqrt(n)
    R = np.exp(2j * np.pi * rng.random((M, F, n, 1))) * T * np.exp(2j * np.pi * rng.random((M, F, 1, n)))
    v = noise * (rng.normal(size=R.shape) + 1j * rng.normal(size=R.shape)) / np.sqrt(2 * n)
    U = np.linalg.inv(np.eye(n) + 0.8 * G) @ (R - 0.8 * v)
    return G, Blocks(U[:, None], (G @ U + v)[:, None], R)


QUICK, FULL = 10, 100  # draws


def bias_table(draws: int = FULL) -> None:
    """Print relative bias and rms error of the five averages over noise."""
    rng = np.random.default_rng(0)
    print(
        "noise/r   "
        + "  ".join(f"{a.upper():>13s}" for a in AVERAGES)
        + "   relative bias / rms error, 20 realizations"
    )
    for noise in (0.1, 0.3, 0.6, 1.0):
        errors = {a: [] for a in AVERAGES}
        for _ in range(draws):
            G, blocks = closed_loop(rng, noise)
            for a in AVERAGES:
                errors[a].append(average(blocks, a) - G)
        size = np.linalg.norm(G)
        cells = []
        for a in AVERAGES:
            e = np.array(errors[a])
            rms = np.sqrt(np.mean(np.sum(np.abs(e) ** 2, axis=(1, 2, 3))))
            cells.append(f"{np.linalg.norm(e.mean(axis=0)) / size:6.4f}/{rms / size:6.4f}")
        print(f"{noise:7.1f}   " + "  ".join(cells))
    print()


RELATIVE = 0.03  # median relative deviation of an FRF entry in the Monte Carlo


def exact(
    structure: Structure, par: Parameters, postures: np.ndarray, given: Conditions
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """FRF vectors (Q, F, n n), their derivatives (Q, F, n n, p) and roots of their covariance, noise of ``given``."""
    n, s, k = structure.n, 2j * np.pi * given.frequency, np.arange(structure.n)
    g, dg, roots = [], [], []
    for lin in linearised(structure, par, postures):
        G, dG = sampled_frf(structure, par, lin, given.frequency, 1e-3, "zoh", derivatives=True)
        Z, _, _ = impedance(structure, par, lin, s)
        inertia, w = par.inertia + np.diag(lin.M)[structure.driven], 2 * np.pi * LOOP_HZ
        closed = Z.copy()
        closed[:, k, k] += inertia * (w**2 + 2 * LOOP_DAMPING * w * s[:, None])
        U = Z @ (np.linalg.inv(closed) * (0.5 * np.sqrt(n) * given.amplitude)[:, None, :])
        Phi = (G * given.tau_std**2) @ np.conj(np.swapaxes(G, 1, 2))
        Phi[:, k, k] += np.abs(s[:, None]) ** 4 * given.q_std**2
        # Error E U^-1 with columns of E of covariance Phi: the root of its covariance is U^-T kron root(Phi).
        half = np.linalg.cholesky(Phi / given.samples)
        left = np.swapaxes(np.linalg.inv(U), 1, 2)
        roots.append(np.einsum("fab,fcd->facbd", left, half).reshape(len(s), n * n, n * n))
        g.append(np.swapaxes(G, 1, 2).reshape(len(s), n * n))
        dg.append(np.swapaxes(dG, 1, 2).reshape(len(s), n * n, -1))
    return np.stack(g), np.stack(dg), np.stack(roots)


def frf_case(points: int, lines: int, seed: int = 0) -> dict:
    """The irb at random postures, drives off nominal by up to 35 %, and noise of the size ``RELATIVE``."""
    robot, rng = load_robot("irb"), np.random.default_rng(seed)
    structure, nominal = build_structure(robot), Parameters.nominal(robot)
    period, rate = 20000, 1000.0
    grid = np.unique(np.round(np.geomspace(1.0, 60.0, lines) * period / rate).astype(int))
    while len(grid) < lines:
        grid = np.union1d(grid, grid[np.argmax(np.diff(grid))] + 1)
    names = parameter_names(robot)
    fitted = [n for n in names if n.startswith(("stiffness", "damping"))]
    chosen = np.array([n in fitted for n in names])
    truth = nominal.with_log(nominal.to_log() + chosen * rng.uniform(-0.3, 0.3, len(names)))
    postures = operating_points(robot, points, rng)
    excitation = Excitation(rate, period, 2, 1, grid, np.arange(0))
    given = conditions(structure, excitation, linearised(structure, nominal, postures), nominal)
    g, dg, roots = exact(structure, truth, postures, given)
    std = np.sqrt(np.sum(np.abs(roots) ** 2, axis=-1))
    roots = roots * RELATIVE / np.median(std / np.abs(g))
    covariance = roots @ np.conj(np.swapaxes(roots, -1, -2))
    J = (np.linalg.inv(roots) @ dg[..., :-1][..., chosen]).reshape(-1, chosen.sum())
    bound = np.diag(np.linalg.inv(2 * (J.conj().T @ J).real))
    return dict(
        structure=structure,
        nominal=nominal,
        truth=truth,
        postures=postures,
        frequency=given.frequency,
        g=g,
        roots=roots,
        covariance=covariance,
        bound=bound,
        fitted=fitted,
        chosen=chosen,
    )


def draw(case: dict, rng: np.random.Generator) -> FRF:
    """One set of noisy FRFs."""
    g, n = case["g"], case["structure"].n
    e = (rng.normal(size=g.shape) + 1j * rng.normal(size=g.shape)) / np.sqrt(2)
    G = np.swapaxes((g + (case["roots"] @ e[..., None])[..., 0]).reshape(*g.shape[:2], n, n), -1, -2)
    k = np.arange(n * n)
    std = np.swapaxes(np.sqrt(case["covariance"][..., k, k].real).reshape(*g.shape[:2], n, n), -1, -2)
    lines, points = np.arange(1, g.shape[1] + 1), tuple(f"p{i + 1}" for i in range(len(g)))
    return FRF(G, case["covariance"], std, std, case["frequency"], lines, points, case["postures"], 1.0, 1, 2, "jio")


def fitted_case(case: dict, frf: FRF, estimator: str, start: Parameters):
    """(estimate, error of the fitted log-parameters, seconds of processor)."""
    began = time.process_time()
    fit = fit_frf(
        case["structure"],
        frf,
        case["nominal"],
        sample_time=1e-3,
        hold="zoh",
        estimator=estimator,
        starts=(start,),
        fitted=case["fitted"],
    )
    seconds = time.process_time() - began
    return fit, (fit.parameters.to_log() - case["truth"].to_log())[case["chosen"]], seconds


def efficiency_table(draws: int = FULL) -> None:
    """Print mean square errors over the Cramer-Rao bound, coverage of 95 % intervals, and seconds a fit."""
    case, rng = frf_case(15, 80), np.random.default_rng(1)
    spring = np.array([name.startswith("stiffness") for name in case["fitted"]])
    size = np.sqrt(case["bound"])
    print(
        f"irb, 15 points x 80 lines, {len(spring)} parameters, {draws} draws of {RELATIVE:.0%} FRF noise; bound: springs {np.median(size[spring]):.1e}, dampers {np.median(size[~spring]):.1e} (median)"
    )
    out = {e: ([], [], []) for e in ESTIMATORS}
    for _ in range(draws):
        frf = draw(case, rng)
        for estimator, (errors, inside, seconds) in out.items():
            fit, error, took = fitted_case(case, frf, estimator, case["nominal"])
            errors.append(error)
            inside.append(np.abs(error) < 1.96 * np.sqrt(np.diag(fit.covariance)))
            seconds.append(took)
    print(
        "estimator   MSE / bound: all   springs   dampers   largest    bias^2 / MSE   coverage: mean  least   CPU s, median of one start"
    )
    for estimator, (errors, inside, seconds) in out.items():
        e, mse = np.array(errors), np.mean(np.square(errors), axis=0)
        ratio, covered = mse / case["bound"], np.mean(inside, axis=0)
        print(
            f"{estimator:10s}  {np.mean(ratio):16.2f}  {np.mean(ratio[spring]):8.2f}  {np.mean(ratio[~spring]):8.2f}  {ratio.max():8.2f}"
            f"  {np.mean(e.mean(axis=0) ** 2 / mse):14.3f}  {covered.mean():15.3f}  {covered.min():5.2f}  {np.median(seconds):9.2f}"
        )
    print()


def scaling_table() -> None:
    """Print the time of a WLLS fit from one start over points and lines, and the power with which it grows."""
    grid = [(points, lines) for points in (5, 15, 45) for lines in (20, 80, 320)]
    seconds = []
    for points, lines in grid:
        case = frf_case(points, lines)
        seconds.append(fitted_case(case, draw(case, np.random.default_rng(2)), "wlls", case["nominal"])[2])
    print("CPU seconds of a WLLS fit from one start, irb\npoints  lines: 20     80    320")
    for k in range(0, len(grid), 3):
        print(f"{grid[k][0]:6d}       " + " ".join(f"{c:6.2f}" for c in seconds[k : k + 3]))
    rows = np.column_stack([np.ones(len(grid)), np.log(grid)])
    power = np.linalg.lstsq(rows, np.log(seconds), rcond=None)[0]
    print(f"time ~ points^{power[1]:.2f} lines^{power[2]:.2f}\n")


def main(draws: int = QUICK) -> None:
    bias_table(draws)
    efficiency_table(draws)
    scaling_table()
    robot = load_robot("ur10")
    rng = np.random.default_rng(1)
    plant = build_plant(robot)
    postures = operating_points(robot, 3, rng)
    inertia = np.min([link_inertia_diagonal(plant, q) for q in postures], axis=0)
    plan = make_plan(robot, points=2, levels=(1.0,), postures=postures, inertia=inertia, trajectory=False)
    drives = draw_drives(rng, robot)
    data = run_experiment(plan, drives=drives)
    truth = np.concatenate([drives[f] for f in FIELDS])
    structure, frf = build_structure(robot), estimate_frf(data)
    print("estimator   stiffness  damping    inertia    viscous    (largest relative error)   seconds")

    def row(name: str, par: Parameters, seconds: float) -> None:
        e = np.abs(np.exp(par.to_log()) / truth - 1).reshape(4, -1).max(axis=1)
        print(f"{name:10s}  " + "  ".join(f"{v:9.2e}" for v in e) + f"                  {seconds:6.1f}")

    for estimator in ESTIMATORS:
        began = time.perf_counter()
        fit = fit_frf(structure, frf, Parameters.nominal(robot), sample_time=1e-3, hold="zoh", estimator=estimator)
        row(estimator, fit.parameters, time.perf_counter() - began)
    began = time.perf_counter()
    _, result = identify(data)
    row("ml", result.model.par, time.perf_counter() - began)


if __name__ == "__main__":
    main(FULL if "--full" in sys.argv[1:] else int(sys.argv[1]) if len(sys.argv) > 1 else QUICK)
