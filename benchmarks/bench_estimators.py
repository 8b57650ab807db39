"""Estimators side by side.

H1, JIO, ARI, HAR and LOG: bias on a synthetic closed loop over noise. NLS, WNLS, LLS, WLLS and the
torque-residual fit: errors on one effect-free UR10 data set.
"""

from __future__ import annotations

import time

import numpy as np

from ident.diagnose import identify
from ident.estimate import ESTIMATORS, fit_frf
from ident.excitation import make_plan, operating_points
from ident.frf import Blocks, average, estimate_frf
from ident.graybox import Parameters, build_structure
from robot_assets.robot import load_robot
from sim import run_experiment
from sim.experiment import draw_drives
from sim.plant import build_plant, link_inertia_diagonal

FIELDS = ("stiffness", "damping", "motor_inertia", "viscous_friction")
AVERAGES = ("h1", "jio", "ari", "har", "log")


def closed_loop(rng: np.random.Generator, noise: float, M: int = 20, F: int = 40, n: int = 3) -> tuple[np.ndarray, Blocks]:
    """(G (F, n, n), spectra) of ``u = r - 0.8 y``, ``y = G u + v``; noise relative to r."""
    k = np.linspace(0.2, 2.0, F)[:, None, None]
    G = (np.eye(n) / (1 + 1j * k) + 0.15 * (1 - np.eye(n)) / (1 + 2j * k)).astype(complex)
    T = np.exp(2j * np.pi * np.outer(np.arange(n), np.arange(n)) / n) / np.sqrt(n)
    R = np.exp(2j * np.pi * rng.random((M, F, n, 1))) * T * np.exp(2j * np.pi * rng.random((M, F, 1, n)))
    v = noise * (rng.normal(size=R.shape) + 1j * rng.normal(size=R.shape)) / np.sqrt(2 * n)
    U = np.linalg.inv(np.eye(n) + 0.8 * G) @ (R - 0.8 * v)
    return G, Blocks(U[:, None], (G @ U + v)[:, None], R)


def bias_table(draws: int = 100) -> None:
    """Print relative bias and rms error of the five averages over noise."""
    rng = np.random.default_rng(0)
    print("noise/r   " + "  ".join(f"{a.upper():>13s}" for a in AVERAGES) + "   relative bias / rms error, 20 realizations")
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


def main() -> None:
    bias_table()
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
    main()
