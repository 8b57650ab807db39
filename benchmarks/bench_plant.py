"""Simulation steps per second of the plant against bare ``mujoco.rollout``, same model, one run."""

from __future__ import annotations

import time

import mujoco
import mujoco.rollout
import numpy as np

from ident.excitation import operating_points
from ident.plan import make_plan
from robot_assets.robot import load_robot
from sim import run_experiment
from sim.plant import build_plant, link_inertia_diagonal

SIMULATIONS, PERIOD, PERIODS = 36, 500, 3


def main() -> None:
    robot = load_robot("ur10")
    plant = build_plant(robot)
    postures = operating_points(robot, 2, np.random.default_rng(0))
    inertia = np.min([link_inertia_diagonal(plant, q) for q in postures], axis=0)
    plan = make_plan(
        robot,
        points=2,
        validation_points=0,
        levels=(1.0, 0.5, 0.25),
        period=PERIOD,
        periods=PERIODS,
        band_hz=(2.0, 70.0),
        postures=postures,
        inertia=inertia,
        trajectory=False,
    )
    steps = len(plan.experiments) * PERIOD * PERIODS * 4
    began = time.perf_counter()
    run_experiment(plan)
    ours = steps / (time.perf_counter() - began)
    data = [mujoco.MjData(plant.model) for _ in range(2)]
    size = mujoco.mj_stateSize(plant.model, mujoco.mjtState.mjSTATE_FULLPHYSICS)
    with mujoco.rollout.Rollout(nthread=2) as rollout:
        began = time.perf_counter()
        rollout.rollout(plant.model, data, np.zeros((SIMULATIONS, size)), nstep=PERIOD * PERIODS * 4)
        bare = SIMULATIONS * PERIOD * PERIODS * 4 / (time.perf_counter() - began)
    print(f"plant {ours:,.0f} steps/s, bare rollout {bare:,.0f} steps/s, ratio {ours / bare:.2f}")


if __name__ == "__main__":
    main()
