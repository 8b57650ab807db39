"""One experiment instead of n: parameter accuracy over experiment time, local against classical FRFs.

The UR10 plant with its noise and its own nonlinearity, effect-free, drives off by up to two, at three points.
Classical: n orthogonal experiments, the transient period thrown away. Local: one multisine in all joints from rest,
nothing thrown away. Errors are of the log-parameters by WLLS, root mean square over parameters and seeds; "error / std"
is 1 where the standard deviations of the fit are honest.
"""

from __future__ import annotations

import sys
import time

import numpy as np

from ident.chain import build_structure
from ident.estimate import fit_frf
from ident.excitation import operating_points
from ident.frf import estimate_frf
from ident.graybox import Parameters
from ident.plan import make_plan
from robot_assets.robot import load_robot
from sim import run_experiment
from sim.experiment import draw_drives
from sim.plant import build_plant, link_inertia_diagonal

POINTS = 3
FIELDS = ("stiffness", "damping", "motor_inertia", "viscous_friction")
CLASSICAL = ((2000, 2), (4000, 2), (4000, 3))  # period, periods with one for the transient
LOCAL = (12000, 24000, 48000)  # samples of one record
SEEDS = (1,)


def main(seeds: tuple[int, ...] = SEEDS) -> None:
    robot = load_robot("ur10")
    plant, structure, nominal = build_plant(robot), build_structure(robot), Parameters.nominal(robot)
    n = robot.n
    rows = [("jio", period, periods, "detection", None) for period, periods in CLASSICAL]
    rows += [(m, samples, 1, grid, 1) for samples in LOCAL for grid in ("odd", "all") for m in ("lpm", "lrm")]
    print(f"ur10, {POINTS} points, seeds {seeds}; rms errors of log-parameters")
    print(
        "FRF  lines      s/point  experiments  centres   springs   dampers   inertia   friction   error / std   FRF s   fit s"
    )
    for method, period, periods, grid, experiments in rows:
        errors, scaled, took = [], [], []
        for seed in seeds:
            postures = operating_points(robot, POINTS, np.random.default_rng(seed))
            plan = make_plan(
                robot,
                points=POINTS,
                validation_points=0,
                levels=(1.0,),
                seed=seed,
                period=period,
                periods=periods,
                transient_periods=1 if periods > 1 else 0,
                grid=grid,
                experiments=experiments,
                postures=postures,
                inertia=np.min([link_inertia_diagonal(plant, q) for q in postures], axis=0),
                trajectory=False,
            )
            drives = draw_drives(np.random.default_rng(seed), robot)
            truth = np.log(np.concatenate([drives[f] for f in FIELDS]))
            data = run_experiment(plan, seed=seed, drives=drives)
            began = time.perf_counter()
            frf = estimate_frf(data, estimator=method)
            between = time.perf_counter()
            fit = fit_frf(structure, frf, nominal, sample_time=1e-3, hold="zoh")
            took.append((between - began, time.perf_counter() - between))
            errors.append(fit.parameters.to_log() - truth)
            scaled.append(errors[-1] / np.sqrt(np.diag(fit.covariance))[:-1])
        size = np.sqrt(np.mean(np.square(errors).reshape(len(seeds), 4, n), axis=(0, 2)))
        seconds = period * periods * (experiments or n) / 1000
        print(
            f"{method:4s} {grid:10s} {seconds:6.0f}  {experiments or n:11d}  {len(frf.lines):7d}  {size[0]:8.1e}  {size[1]:8.1e}  {size[2]:8.1e}"
            f"  {size[3]:9.1e}  {np.sqrt(np.mean(np.square(scaled))):12.2f}  {np.mean(took, axis=0)[0]:6.2f}  {np.mean(took, axis=0)[1]:6.2f}",
            flush=True,
        )


if __name__ == "__main__":
    main(tuple(map(int, sys.argv[1:])) or SEEDS)
