"""Wall time and peak memory of a diagnosis of 36 segments of 12,000 samples, six joints."""

from __future__ import annotations

import resource
import time

import numpy as np

from ident.diagnosis import diagnose_fully
from ident.excitation import operating_points
from ident.plan import make_plan
from robot_assets.robot import load_robot
from sim import parse_effect, run_experiment
from sim.plant import build_plant, link_inertia_diagonal


def main() -> None:
    robot = load_robot("ur10")
    plant = build_plant(robot)
    postures = operating_points(robot, 2, np.random.default_rng(2))
    inertia = np.min([link_inertia_diagonal(plant, q) for q in postures], axis=0)
    plan = make_plan(robot, points=2, validation_points=0, postures=postures, inertia=inertia, trajectory=False)
    data = run_experiment(plan, [parse_effect("coulomb_friction@elbow_joint:torque=3", robot)])
    print(f"{len(data.segments)} segments of {data.segments[0].n_samples} samples")
    for attempt in ("first (compiles kernels)", "second"):
        began = time.perf_counter()
        verdict = diagnose_fully(data).verdict
        print(f"{attempt}: {time.perf_counter() - began:.1f} s, {verdict.sentence}")
    print(f"peak memory {resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6:.2f} GB")


if __name__ == "__main__":
    main()
