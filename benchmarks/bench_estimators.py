"""NLS, WNLS, LLS, WLLS and the torque-residual fit on one effect-free UR10 data set."""

from __future__ import annotations

import time

import numpy as np

from ident.diagnose import identify
from ident.estimate import ESTIMATORS, fit_frf
from ident.excitation import make_plan, operating_points
from ident.frf import estimate_frf
from ident.graybox import Parameters, build_structure
from robot_assets.robot import load_robot
from sim import run_experiment
from sim.experiment import draw_drives
from sim.plant import build_plant, link_inertia_diagonal

FIELDS = ("stiffness", "damping", "motor_inertia", "viscous_friction")


def main() -> None:
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
