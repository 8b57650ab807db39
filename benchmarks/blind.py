"""Blind benchmark: effects drawn and hidden in the plant, and what the diagnosis names.

The diagnosis sees the files of a dataset alone. Drives are drawn within a factor of two of the
nominal; the plant's step and integrator differ from case to case.

    python benchmarks/blind.py --size quick --out benchmarks/results/blind-quick

Cases run side by side in processes, or on a Dask cluster (``--executor dask://HOST:PORT``) whose workers
have this folder on their path.

``--kind mix`` draws the arm as well, and none, one, two or an effect that the catalogue lacks. ``--sizes 3 100`` scales
every effect until what it changes alone is that many times the noise, spread evenly over its logarithm.
"""

from __future__ import annotations

import argparse
import copy
import json
import tempfile
import time
import traceback
from collections.abc import Callable, Sequence
from concurrent.futures import Executor, ThreadPoolExecutor, as_completed
from dataclasses import dataclass, replace
from functools import cache, partial
from pathlib import Path

import numpy as np
from blind_summary import pictures, table
from outside import draw_outside
from provenance import commit
from sizing import brought_to, distortion, noise_power, spectra

from ident.dataset import Dataset, Segment
from ident.dataset_io import load_dataset, save_dataset
from ident.diagnosis import diagnose_fully
from ident.excitation import operating_points
from ident.parallel import open_executor
from ident.plan import Experiment, Plan
from robot_assets.errors import DataError
from robot_assets.robot import Robot, load_robot
from sim import draw_effect, run_experiment
from sim.effects import EFFECTS, parameters_of
from sim.experiment import draw_drives, plan_experiment
from sim.plant import build_plant, gravity_torque

ISSUE_SIX = ("coulomb_friction", "cogging", "torque_constant", "torque_delay", "hardening_stiffness", "payload")
ARMS = ("ur10", "irb", "panda")
KINDS = {"none": 0.15, "one": 0.5, "two": 0.2, "outside": 0.15}
STEP = 0.01  # of the logarithm of a figure of the drives, to see what it does
COARSE = 5e-4  # s, step of the simulations that tell sizes
COUNTS = {"none": 0, "one": 1, "two": 2, "outside": 0}
CASES = {"smoke": 6, "quick": 26, "sixty": 60, "full": 400}


@dataclass(frozen=True)
class Case:
    """A plan, what is hidden in the plant, and the plant's own figures.

    ``stronger`` gives each hidden effect again, its strength times a factor.
    """

    plan: Plan
    hidden: list
    stronger: list[Callable[[float], object]]
    drives: dict[str, np.ndarray]
    timestep: float
    seed: int

    def simulate(self) -> Dataset:
        return run_experiment(self.plan, self.hidden, seed=self.seed, drives=self.drives, timestep=self.timestep)

    def truth(self, size: Callable[[object], float]) -> list[dict]:
        return [
            {"effect": e.name, "place": e.place, "parameters": _plain(parameters_of(e)), "size": size(e)}
            for e in self.hidden
        ]

    def sizer(self) -> Callable[[object], float]:
        """Distortion over noise of an effect: what it alone changes at the joint and posture (none held out) that show
        it most.

        Root mean square over the excited band of what changes in torque and position lines and no change of the drives
        would make, over the noise of these lines, in the first experiment at the largest level; the plant is simulated
        without noise, for one steady period. Its step is coarse: a size is a difference of two simulations, and of the
        error of the step little is left in it.
        """
        plan, robot = self.plan, self.plan.robot
        shown = [e for e in shown_in(plan) if e.experiment == 1]
        some = tuple(e for e in shown if e.amplitude == max(x.amplitude for x in shown))
        small = replace(plan, experiments=some, trajectories=())
        one = replace(small, excitation=replace(plan.excitation, periods=plan.excitation.transient_periods + 1))
        lines = int(plan.excitation.lines.max())

        def coarsely(plan: Plan, drives: dict, effects: Sequence = (), noise: float = 0.0) -> tuple[Segment, ...]:
            options = {"timestep": COARSE, "integrator": "IMPLICITFAST", "noise": noise}
            return run_experiment(plan, effects, seed=self.seed, drives=drives, **options).segments

        plain = spectra(coarsely(one, self.drives), lines)
        noise = noise_power(coarsely(small, self.drives, noise=1.0), lines)
        others = [
            {**self.drives, name: values * np.exp(STEP * (np.arange(robot.n) == j))}
            for name, values in self.drives.items()
            for j in range(robot.n)
        ]
        ways = np.stack([spectra(coarsely(one, drives), lines) - plain for drives in others])

        def size(effect: object) -> float:
            try:
                return distortion(spectra(coarsely(one, self.drives, [effect]), lines) - plain, ways, noise)
            except DataError:  # the loop is lost
                return float("inf")

        return cache(size)

    def scaled(self, size: Callable[[object], float], low: float, high: float) -> Case:
        """The case with each effect at a size drawn between two, as near as its strength brings it there."""
        rng = np.random.default_rng([self.seed, 2])
        targets = np.exp(rng.uniform(np.log(low), np.log(high), len(self.hidden)))
        return replace(self, hidden=[brought_to(s, size, t) for s, t in zip(self.stronger, targets, strict=True)])


def draw_case(seed: int, names: tuple[str, ...] | None, kind: str, robot_name: str) -> Case:
    """Postures, excitation, effects, sizes, drives and the plant's step, all by one seed.

    Args:
        kind: of ``KINDS``, or "mix"; "mix" as ``robot_name`` draws one of ``ARMS``.
    """
    mixed = np.random.default_rng([seed, 1])
    if robot_name == "mix":
        robot_name = str(mixed.choice(ARMS))
    if kind == "mix":
        kind = str(mixed.choice(list(KINDS), p=list(KINDS.values())))
    rng = np.random.default_rng(seed)
    robot = load_robot(robot_name)
    pool = names or tuple(EFFECTS)
    plant = build_plant(robot)
    postures = operating_points(robot, 3, rng)
    plan = plan_experiment(
        robot,
        postures,
        points=2,
        seed=seed,
        levels=(1.0, 0.6, 0.3) if rng.random() < 0.5 else (1.0, 0.4),
        period=int(rng.choice([3000, 4000])),
    )
    shown = shown_in(plan)
    peak = np.max([np.abs(e.r).max(axis=0) for e in shown], axis=0)
    peak = peak + np.max([np.abs(gravity_torque(plant, e.q0)) for e in shown], axis=0)
    hidden, stronger = [], []
    for name in [None] if kind == "outside" else [pool[(seed + i * 7) % len(pool)] for i in range(COUNTS[kind])]:
        strength = float(np.exp(rng.uniform(-0.5, 1.0 if name is None else 0.7)))
        stronger.append(partial(_again, copy.deepcopy(rng), robot, name, peak, strength))
        hidden.append(_drawn(rng, robot, name, peak, strength))
    return Case(plan, hidden, stronger, draw_drives(rng, robot), float(rng.choice([2.5e-4, 2e-4])), seed)


def shown_in(plan: Plan) -> list[Experiment]:
    """Experiments of a plan that are not held out."""
    return [e for e in plan.experiments if e.role == "identification"]


def _drawn(rng: np.random.Generator, robot: Robot, name: str | None, peak: np.ndarray, strength: float) -> object:
    """An effect of the catalogue, or one that it lacks where there is no name."""
    if name is None:
        return draw_outside(rng, robot, strength)
    return draw_effect(rng, robot, names=(name,), strength=strength, peak_torque=peak)


def _again(
    rng: np.random.Generator, robot: Robot, name: str | None, peak: np.ndarray, strength: float, factor: float
) -> object:
    """What ``_drawn`` gave from this generator, its strength times a factor."""
    return _drawn(copy.deepcopy(rng), robot, name, peak, strength * factor)


def run_case(
    seed: int, names: tuple[str, ...] | None, kind: str, robot_name: str, sizes: tuple[float, float] | None = None
) -> dict:
    """Draw, simulate, write, read, diagnose, compare.

    Args:
        sizes: distortion over noise between which each effect is scaled; as drawn where None.
    """
    case = draw_case(seed, names, kind, robot_name)
    truth = [{"effect": e.name, "place": e.place} for e in case.hidden]
    began = time.perf_counter()
    try:
        if case.hidden:
            size = case.sizer()
            case = case if sizes is None else case.scaled(size, *sizes)
            truth = case.truth(size)
        data = case.simulate()
    except Exception as err:
        return {"seed": seed, "truth": truth, "error": f"{type(err).__name__}: {err}"}
    simulated = time.perf_counter() - began
    with tempfile.TemporaryDirectory() as folder:
        save_dataset(data, Path(folder) / "d")
        began = time.perf_counter()
        try:
            result = diagnose_fully(load_dataset(Path(folder) / "d"))
        except Exception as err:
            where = traceback.extract_tb(err.__traceback__)[-1]
            return {
                "seed": seed,
                "truth": truth,
                "error": f"{type(err).__name__}: {err} in {where.name}:{where.lineno}",
            }
    v = result.verdict.to_dict()
    return {
        "seed": seed,
        "robot": case.plan.robot.name,
        "truth": truth,
        "causes": [
            {k: c[k] for k in ("effect", "joint", "probability", "alternatives", "parameters")} for c in v["causes"]
        ],
        "unexplained": v["unexplained"],
        "chi2": v["discrepancy"]["chi2_per_dof"],
        "gain": v["gain"],
        "candidates": [list(r) for r in result.candidates],
        "simulated_s": simulated,
        "diagnosed_s": time.perf_counter() - began,
    }


def _plain(values: dict) -> dict:
    return {k: list(v) if isinstance(v, tuple) else v for k, v in values.items()}


def judge(row: dict) -> dict:
    """Right effect and place, worst relative parameter error of the first cause."""
    if "error" in row:
        return {"right": False, "effect": False, "note": row["error"]}
    truth, causes = row["truth"], row["causes"]
    named = {(c["effect"], c["joint"]) for c in causes if c["probability"] > 0.5}
    wanted = {(t["effect"], t["place"]) for t in truth if not t["effect"].startswith("outside:")}
    # What drifts in the plant is viscous friction and, if it has any, Coulomb friction of its own.
    wanted |= {
        ("coulomb_friction", t["place"])
        for t in truth
        if t["effect"] == "friction_drift" and t["parameters"].get("coulomb")
    }
    right = named == wanted
    errors = []
    for t in truth:
        for c in causes:
            if (c["effect"], c["joint"]) == (t["effect"], t["place"]):
                for k, v in t["parameters"].items():
                    if (
                        isinstance(v, float)
                        and k in c["parameters"]
                        and k not in ("phase", "asymmetry", "coulomb")
                        and v
                    ):
                        errors.append(abs(c["parameters"][k]["value"] / v - 1))
    return {"right": right, "any": bool(named & wanted), "named": sorted(named), "errors": errors}


def run(cases: list[tuple], executor: Executor, keep: Callable[[list[dict]], None]) -> list[dict]:
    """All cases on any executor; sorted by seed, so that the order of completion does not matter.

    Args:
        keep: given all that have ended, whenever one has.
    """
    futures = [executor.submit(run_case, *case) for case in cases]
    rows = []
    for future in as_completed(futures):
        row = future.result()
        row["judged"] = judge(row)
        rows.append(row)
        print(line(row), flush=True)
        rows.sort(key=lambda r: r["seed"])
        keep(rows)
    return rows


def line(row: dict) -> str:
    truth = " + ".join(f"{t['effect']}@{t['place']} x{t.get('size', 0.0):.3g}" for t in row["truth"]) or "nothing"
    if "error" in row:
        return f"{row['seed']:5d} ERROR {truth}: {row['error']}"
    named = ", ".join(f"{c['effect']}@{c['joint']} {c['probability']:.2f}" for c in row["causes"]) or "nothing"
    closed = (row["gain"] or {}).get("gap_closed")
    mark = "ok  " if row["judged"]["right"] else "MISS"
    error = max(row["judged"]["errors"], default=float("nan"))
    return (
        f"{row['seed']:5d} {mark} {truth} -> {named} | {row['unexplained']['verdict']} {row['unexplained']['share']:.3f}"
        f" chi2 {row['chi2']:.3g} err {error:.3f} closed {closed if closed is None else round(closed, 3)}"
        f" {row['simulated_s']:.0f}+{row['diagnosed_s']:.0f} s"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--size", choices=CASES, default="quick")
    parser.add_argument("--effects", default="", help="comma-separated; all where empty; 'six' for the first six")
    parser.add_argument("--kind", choices=(*KINDS, "mix"), default="one", help="what is hidden")
    parser.add_argument("--robot", default="ur10", help="folder or name of an arm; 'mix' draws one")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--executor", default="processes", help="processes, processes:N or dask://HOST:PORT")
    parser.add_argument(
        "--sizes", type=float, nargs=2, metavar=("LOW", "HIGH"), help="distortion over noise of every effect"
    )
    parser.add_argument("--cases", type=int, help="number of cases, instead of a size")
    parser.add_argument("--out", type=Path, help="stem of the results: .json, .txt and .png")
    args = parser.parse_args()
    names = ISSUE_SIX if args.effects == "six" else tuple(filter(None, args.effects.split(","))) or None
    sizes = tuple(args.sizes) if args.sizes else None
    cases = [(args.seed + i, names, args.kind, args.robot, sizes) for i in range(args.cases or CASES[args.size])]
    options = f"--kind {args.kind} --robot {args.robot} --seed {args.seed} --cases {len(cases)}"
    if args.effects:
        options += f" --effects {args.effects}"
    if args.sizes:
        options += f" --sizes {args.sizes[0]:g} {args.sizes[1]:g}"
    head = f"python benchmarks/blind.py {options}, commit {commit()}"

    def keep(rows: list[dict]) -> None:
        if args.out:
            args.out.parent.mkdir(parents=True, exist_ok=True)
            args.out.with_suffix(".json").write_text(json.dumps(rows, indent=1) + "\n", encoding="utf-8")
            short = "" if len(rows) == len(cases) else f"; the {len(rows)} cases that have ended"
            lines = "\n".join(line(row) for row in rows)
            args.out.with_suffix(".txt").write_text(f"{head}{short}\n{lines}\n{table(rows)}\n", encoding="utf-8")

    with open_executor(args.executor) as executor:
        rows = run(cases, executor or ThreadPoolExecutor(1), keep)
    print(table(rows))
    if args.out:
        pictures(rows, args.out.with_suffix(".png"))


if __name__ == "__main__":
    main()
