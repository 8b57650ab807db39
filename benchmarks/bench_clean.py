"""Nothing hidden: errors and intervals of the identified drives, and how often something is seen.

Drives are drawn within a factor of two of the nominal, postures and excitation by the seed.

    python benchmarks/bench_clean.py --draws 100 --out benchmarks/results/clean.txt
"""

from __future__ import annotations

import argparse
import os
import tempfile
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from provenance import commit

from ident.attribute import attribute
from ident.baseline import UNDETERMINED
from ident.dataset_io import load_dataset, save_dataset
from ident.excitation import operating_points
from ident.identification import identify
from robot_assets.robot import load_robot
from sim import run_experiment
from sim.experiment import draw_drives, plan_experiment

KINDS = ("stiffness", "damping", "motor_inertia", "viscous_friction")


@dataclass(frozen=True)
class Draw:
    """Relative errors and standard deviations (4 n,) in the order of ``KINDS``, and the test for more than noise."""

    seed: int
    error: np.ndarray
    std: np.ndarray
    chi2_per_dof: float
    seen: bool


def run_draw(seed: int) -> Draw:
    """Draw, simulate, write, read, identify."""
    rng = np.random.default_rng(seed)
    robot = load_robot("ur10")
    plan = plan_experiment(
        robot,
        operating_points(robot, 2, rng),
        points=2,
        validation_points=0,
        levels=(1.0, 0.4),
        seed=seed,
        period=2000,
        trajectory=False,
    )
    drives = draw_drives(rng, robot)
    with tempfile.TemporaryDirectory() as folder:
        save_dataset(run_experiment(plan, seed=seed, drives=drives), Path(folder) / "d")
        setup, result = identify(load_dataset(Path(folder) / "d"))
    truth = np.concatenate([drives[k] for k in KINDS])
    error = np.exp(result.model.par.to_log()) / truth - 1.0
    std = np.sqrt(np.diag(result.covariance()))[: len(truth)]
    seen = attribute(setup.problem, result).detected
    return Draw(seed, error, std, result.chi2_per_dof, seen)


def table(draws: list[Draw]) -> str:
    """Figures over all draws as text."""
    error, std = np.stack([d.error for d in draws]), np.stack([d.std for d in draws])
    known = std < UNDETERMINED
    covered = np.abs(error) < 1.96 * std
    rows = [f"{len(draws)} draws, seeds {draws[0].seed} to {draws[-1].seed}, nothing hidden"]
    for k, part in zip(KINDS, np.split(np.arange(error.shape[1]), len(KINDS)), strict=True):
        e, ok = np.abs(error[:, part]), known[:, part]
        rows.append(
            f"{k:17s} median error {np.median(e):.2%}, 99 % within {np.quantile(e[ok], 0.99):.2%}, largest"
            f" {e[ok].max():.2%} where determined ({ok.mean():.1%}); 95 % intervals cover {covered[:, part].mean():.1%}"
        )
    chi2 = np.array([d.chi2_per_dof for d in draws])
    rows.append(f"all intervals together cover {covered.mean():.1%}")
    rows.append(f"chi2 per degree of freedom {chi2.min():.3f} to {chi2.max():.3f}")
    rows.append(f"nothing beyond noise in {sum(not d.seen for d in draws)} of {len(draws)}")
    return "\n".join(rows)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--draws", type=int, default=20)
    parser.add_argument("--seed", type=int, default=5000)
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--out", type=Path)
    args = parser.parse_args()
    os.environ["SIMGAP_THREADS"] = "1"
    with ProcessPoolExecutor(args.workers) as executor:
        draws = []
        for draw in executor.map(run_draw, range(args.seed, args.seed + args.draws)):
            draws.append(draw)
            print(f"{len(draws)}/{args.draws}: chi2 per degree of freedom {draw.chi2_per_dof:.3f}", flush=True)
    text = table(draws)
    print(text)
    if args.out:
        head = f"python benchmarks/bench_clean.py --draws {args.draws} --seed {args.seed}, commit {commit()}"
        args.out.write_text(f"{head}\n{text}\n", encoding="utf-8")


if __name__ == "__main__":
    main()
