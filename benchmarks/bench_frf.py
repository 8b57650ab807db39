"""FRF estimators side by side on the irb in closed loop, against the true arm linearised.

Disturbed by plain noise, or, as a robot is, by friction and by torque ripple that return with the position of
the motor (Wernholt and Moberg 2008, R-2827). Two tables:

- H1, JIO, ARI, HAR and LOG over four realizations: bias and standard deviation, relative to the entries, by band, for
  driving entries (motor to itself) and coupling ones. Friction damps and ripple stiffens the arm on average, which no
  estimator can undo: in brackets the distance from the mean of the five.
- The same experiment time spent on periods of one realization, or on realizations.

    python benchmarks/bench_frf.py [--full]
"""

from __future__ import annotations

import sys
from dataclasses import replace

import numpy as np

from ident.candidates import draw_candidates
from ident.chain import build_structure
from ident.dataset import Dataset
from ident.frf import estimate_frf
from ident.graybox import Parameters, equilibrium, linearise, sampled_frf
from robot_assets.robot import Robot, load_robot
from sim import run_experiment
from sim.effects.drive import Cogging
from sim.effects.friction import CoulombFriction
from sim.experiment import plan_experiment

AVERAGES = ("h1", "jio", "ari", "har", "log")
REALIZATIONS = 4  # of one estimate
PERIODS = 4  # steady ones
LOW = 5.0  # Hz, end of the low band
NOISE = 25.0  # times that of robot.toml: few per cent of an entry
FRICTION, RIPPLE = 0.15, 0.15  # of the rms excitation torque of a joint
RIPPLES = 6  # per turn of the motor
SPENDING = ((1, 1), (1, 2), (1, 4), (2, 1), (4, 1))  # realizations, periods


def spoilt(robot: Robot, r: np.ndarray) -> list:
    """Friction and ripple at every joint, of a size relative to the excitation (..., n)."""
    size = r.reshape(-1, robot.n).std(axis=0)
    ratio = robot.array("gear_ratio")
    friction = [CoulombFriction(j, float(FRICTION * s)) for j, s in zip(robot.joint_names, size, strict=True)]
    return friction + [
        Cogging(j, float(RIPPLE * s), RIPPLES * float(g), 0.5 + k)
        for k, (j, s, g) in enumerate(zip(robot.joint_names, size, ratio, strict=True))
    ]


def part(data: Dataset, realizations: range, periods: int = PERIODS) -> Dataset:
    """Some realizations, and the first of their steady periods."""
    chosen = []
    for s in data.segments:
        if s.realization in realizations:
            stop = (s.transient_periods + periods) * s.period
            cut = {k: getattr(s, k)[:stop] for k in ("t", "tau", "q", "r")}
            chosen.append(replace(s, periods=s.transient_periods + periods, **cut))
    return replace(data, segments=tuple(chosen))


def estimator_table(data: Dataset, exact: np.ndarray, blocks: list[range]) -> None:
    """Print bias and standard deviation of the five averages."""
    n = data.n
    driving = np.eye(n, dtype=bool)
    found = {a: np.stack([estimate_frf(part(data, b), estimator=a).G[0] for b in blocks]) for a in AVERAGES}
    f = estimate_frf(part(data, blocks[0])).frequency
    common = np.mean([g.mean(axis=0) for g in found.values()], axis=0)
    groups = [(f < LOW, driving), (f >= LOW, driving), (f < LOW, ~driving), (f >= LOW, ~driving)]
    names = (f"driving <{LOW:g} Hz", "driving above", f"coupling <{LOW:g} Hz", "coupling above")
    print(
        "     "
        + "".join(f"{name:>20s}" for name in names)
        + "   bias / std (distance from the five), median, % of the entry"
    )
    for a, g in found.items():
        spread, off = g.var(axis=0, ddof=1), np.abs(g.mean(axis=0) - exact) ** 2
        # The mean of few estimates is off by chance as well: that part of the bias is taken out.
        squares = (off - spread / len(blocks), spread, np.abs(g.mean(axis=0) - common) ** 2)
        cells = []
        for band, entries in groups:
            b, s, c = (100 * np.sqrt(max(np.median((v / np.abs(exact) ** 2)[band][:, entries]), 0.0)) for v in squares)
            cells.append(f"{b:6.2f} /{s:6.2f} ({c:5.2f})")
        print(f"{a.upper():5s}" + "".join(f"{c:>20s}" for c in cells))


def spending_table(data: Dataset, blocks: list[range]) -> None:
    """Print how the scatter of an estimate falls with periods and with realizations."""
    cells = []
    for M, P in SPENDING:
        many = [range(k, k + M) for b in blocks for k in range(b.start, b.stop - M + 1, M)]
        g = np.stack([estimate_frf(part(data, m, P), estimator="jio").G[0] for m in many])
        spread = g.std(axis=0, ddof=1) / np.abs(g.mean(axis=0))
        cells.append(f"{100 * np.median(spread):6.2f}")
    print(
        "JIO, median std of an entry, %:  "
        + "   ".join(f"{M} x {P}: {c}" for (M, P), c in zip(SPENDING, cells, strict=True))
    )


def main(full: bool = False) -> None:
    robot = load_robot("irb")
    structure, true = build_structure(robot), Parameters.nominal(robot)
    count = REALIZATIONS * (12 if full else 4)
    posture = draw_candidates(robot, 1, np.random.default_rng(4)).q
    plan = plan_experiment(
        robot,
        posture,
        points=1,
        validation_points=0,
        realizations=count,
        levels=(1.0,),
        seed=1,
        period=2000,
        periods=PERIODS + 1,
        per_decade=30,
        band_hz=(0.5, 60.0),
        trajectory=False,
    )
    blocks = [range(k, k + REALIZATIONS) for k in range(1, count, REALIZATIONS)]
    effects = spoilt(robot, np.stack([e.r for e in plan.experiments]))
    print(
        f"irb, one posture, {len(plan.excitation.lines)} lines, {len(blocks)} estimates of {REALIZATIONS} realizations x {PERIODS} periods"
    )
    for title, hidden, noise in (("plain noise", [], NOISE), ("friction and ripple", effects, 1.0)):
        data = run_experiment(plan, hidden, seed=2, noise=noise, timestep=1e-3)
        q = estimate_frf(part(data, blocks[0])).q0[0]
        lin = linearise(structure, equilibrium(structure, true, q))
        exact = sampled_frf(structure, true, lin, plan.excitation.frequency, 1e-3, "zoh")[0]
        print(f"\n{title}")
        estimator_table(data, exact, blocks)
        print("realizations x periods: ", end="")
        spending_table(data, blocks)


if __name__ == "__main__":
    main("--full" in sys.argv[1:])
