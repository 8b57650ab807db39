"""Optimal operating points: time, gap, and gain over random points measured as long.

Each row: a criterion over 8,000 postures and 15 points. "All" are the log-parameters that
identification fits, "springs" the stiffnesses alone (12 on the irb), the others taken as known, as in
Wernholt and Lofberg 2007.
"""

from __future__ import annotations

import sys
import time

import numpy as np

from ident.candidates import draw_candidates
from ident.chain import build_structure
from ident.design import CRITERIA, LEAST, RANDOM, criterion_loss, optimal_weights, random_losses, round_weights
from ident.excitation import operating_points
from ident.graybox import Parameters, parameter_names
from ident.information import conditions, information, linearised
from ident.plan import make_plan
from robot_assets.robot import load_robot

POINTS = 15


def main(count: int = 8000) -> None:
    print(
        f"{POINTS} points of {count} postures; ratios: covariance determinant (D), summed variances (A) or largest eigenvalue (E)"
    )
    for name in ("irb", "ur10"):
        robot = load_robot(name)
        rng = np.random.default_rng(0)
        structure, par = build_structure(robot), Parameters.nominal(robot)
        began, used = time.perf_counter(), time.process_time()
        q = draw_candidates(robot, count, rng).q
        lins = linearised(structure, par, q)
        x = make_plan(robot, points=1, validation_points=0, levels=(1.0,), trajectory=False, postures=q[:1]).excitation
        given = conditions(structure, x, lins, par)
        H = information(structure, par, lins, given)
        seconds, cpu = time.perf_counter() - began, time.process_time() - used
        print(f"\n{name}: postures and information at {len(x.lines)} lines {seconds:.1f} s ({cpu:.1f} s of processor)")
        print(
            "parameters  crit      gap  support  weights s  rounding s  efficiency   median random / designed   best random"
        )
        # The default of `simgap experiment`: a latin hypercube in the middle of the joint range.
        middle = [
            information(structure, par, linearised(structure, par, operating_points(robot, POINTS, rng)), given).sum(
                axis=0
            )
            for _ in range(20)
        ]
        springs = [i for i, p in enumerate(parameter_names(robot)) if p.startswith("stiffness.")]
        for title, index in (("all", np.arange(H.shape[-1])), ("springs", np.array(springs))):
            part = np.ascontiguousarray(H[:, index[:, None], index])
            for criterion in CRITERIA:
                row(title, criterion, part, rng)
            designed = round_weights(part, optimal_weights(part).weights, POINTS)
            loss = criterion_loss(part[None][:, designed].sum(axis=1), "D")
            other = criterion_loss(np.stack(middle)[None][..., index[:, None], index], "D")
            print(
                f"{'':38s}D against 20 latin hypercubes in the middle of the range: {np.exp(np.median(other) - loss):.3g}"
            )


def row(title: str, criterion: str, H: np.ndarray, rng: np.random.Generator) -> None:
    began = time.perf_counter()
    best = optimal_weights(H, criterion=criterion)
    between = time.perf_counter()
    chosen = round_weights(H, best.weights, POINTS, criterion)
    end = time.perf_counter()
    loss = float(criterion_loss(H[None][:, chosen].sum(axis=1), criterion))
    bound = float(criterion_loss(POINTS * np.tensordot(H[None], best.weights, (1, 0)), criterion))
    efficiency = np.exp((bound - loss) / (H.shape[-1] if criterion == "D" else 1))
    random = random_losses(H, POINTS, criterion, rng, RANDOM)
    support = int((best.weights > LEAST).sum())
    print(
        f"{title:10s}  {criterion}     {best.gap:.1e}  {support:5d}  {between - began:8.2f}  {end - between:9.2f}  {efficiency:10.3f}"
        f"  {np.exp(np.median(random) - loss):22.3g}  {np.exp(random.min() - loss):14.3g}"
    )


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 8000)
