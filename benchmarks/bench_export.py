"""Gain of the exported model by prediction and by simulation in MuJoCo, one effect hidden after another.

The effect's own hypothesis is fitted from its true values (that its name is found is for other benchmarks), the
model is exported, and both the arm without and that with the effect are simulated in closed loop along held-out
motion.
"""

from __future__ import annotations

import argparse
import time
from dataclasses import replace

import numpy as np

from ident.dataset import Dataset
from ident.excitation import operating_points
from ident.gain import measure_gain, segment_errors
from ident.hypotheses import Hypothesis, catalogue
from ident.identification import identify
from ident.model import Effect, Model, along_record
from ident.problem import Problem
from ident.show.export import build_mjcf, note_record
from ident.show.simulated_gain import export_baseline, simulated_errors, spread
from ident.simulable import WITHOUT_ELEMENT
from ident.torque_fit import Fit, fit
from ident.units import units_of_torques
from ident.values import baseline_values, reported_parameters
from ident.verdict import Cause, Gain
from robot_assets.robot import Robot, load_robot
from sim import draw_effect, run_experiment
from sim.effects import EFFECTS, parameters_of
from sim.experiment import plan_experiment

STRENGTH = 1.0
START = {
    "smoothing_velocity": 1e-3,
    "inertia": 1e-3,
    "reaction": 1.0,
    "viscous": 1.0,
    "com_x": 0.0,
    "com_y": 0.0,
    "com_z": 0.0,
    "tilt_1": 0.0,
    "tilt_2": 0.0,
}


def true_hypothesis(problem: Problem, effect) -> Effect:
    """The hypothesis of a hidden effect with its true values, nuisances at a guess."""
    truth = parameters_of(effect)
    if "com" in truth:
        truth |= dict(zip(("com_x", "com_y", "com_z"), truth["com"]))
    if "amplitude" in truth:
        phase = truth.get("phase", 0.0)
        truth |= {"sine": truth["amplitude"] * np.cos(phase), "cosine": truth["amplitude"] * np.sin(phase)}
    fits = [h for h in catalogue(problem.structure) if (h.effect, h.place) == (effect.name, effect.place)]
    if "axis" in truth:
        fits = [
            h
            for h in fits
            if tuple(h.options["axis"](np.zeros(len(h.parameters)))) == tuple(truth["axis"]) and not h.options["before"]
        ]
    if not fits:
        raise LookupError("no hypothesis of the torque equation")
    values = [
        float(truth.get(p.name, START.get(p.name, 1.0 if p.null is None else p.null))) for p in fits[0].parameters
    ]
    return Effect(fits[0], np.array(values))


def cause_of(effect: Effect, result: Fit) -> Cause:
    """A fitted effect as a verdict names it."""
    h: Hypothesis = effect.hypothesis
    values = reported_parameters(effect, result, result.covariance())
    return Cause(h.effect, h.place, values, 1.0, "", (), "q" if h.channel == "position" else None)


def small_dataset(robot: Robot, name: str, seed: int, period: int, levels: tuple[float, ...]) -> tuple[object, Dataset]:
    """An effect of a kind drawn and hidden in an arm with the drives of its description, and the data of it."""
    rng = np.random.default_rng(seed)
    postures = operating_points(robot, 2, rng)
    options = {
        "points": 1,
        "validation_points": 1,
        "levels": levels,
        "seed": seed,
        "period": period,
        "trajectory": False,
    }
    plan = plan_experiment(robot, postures, **options)
    effect = draw_effect(rng, robot, names=(name,), strength=STRENGTH)
    return effect, run_experiment(plan, [effect], seed=seed)


def both_gains(dataset: Dataset, effect, segments: int = 2) -> tuple[Gain, Gain]:
    """Gain by prediction and by simulation on the same segments, over the joints in which the effect shows."""
    setup, baseline = identify(dataset)
    problem, robot = setup.problem, dataset.robot
    hidden = true_hypothesis(problem, effect)
    if hidden.hypothesis.options.get("bends"):
        hidden = replace(hidden, hypothesis=along_record(hidden.hypothesis))
    result = fit(problem, Model(problem.structure, problem.nominal, (hidden,)))
    groups = tuple(g.pick(spread(len(g.segments), segments)) for g in setup.held_out)
    predicted, _ = segment_errors(problem, groups, baseline.model, result.model)
    values = {k: v.value for k, v in baseline_values(result)[0].items()}
    after = build_mjcf(robot, values, [cause_of(e, result) for e in result.model.effects])
    note_record(after, result.model.par.timing, problem.sampling.roll_off, {})
    simulated = simulated_errors(
        problem, groups, result.model, export_baseline(baseline.model, problem.sampling), after
    )
    excess = (predicted.before - predicted.noise).sum(axis=0)
    affected = np.flatnonzero(excess >= 0.1 * excess.sum())
    rng = np.random.default_rng(0)
    return tuple(measure_gain(e, units_of_torques(dataset.robot), affected, "", rng) for e in (predicted, simulated))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--robot", default="ur10")
    parser.add_argument("--effects", nargs="*", default=list(EFFECTS))
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--period", type=int, default=2000)
    parser.add_argument("--levels", type=float, nargs="+", default=[1.0, 0.4])
    args = parser.parse_args()
    robot = load_robot(args.robot)
    print(
        f"{'effect':22s} {'place':20s} {'before':>9s} {'noise':>9s} {'predicted':>9s} {'simulated':>9s} {'difference':>10s}  seconds"
    )
    for name in args.effects:
        began = time.perf_counter()
        # A seed of its own for each effect: places differ.
        seed = args.seed + list(EFFECTS).index(name)
        effect, data = small_dataset(robot, name, seed, args.period, tuple(args.levels))
        try:
            predicted, simulated = both_gains(data, effect)
        except (LookupError, FloatingPointError, np.linalg.LinAlgError) as err:
            print(f"{name:22s} {effect.place:20s} {err}", flush=True)
            continue
        if predicted is None or simulated is None:
            print(
                f"{name:22s} {effect.place:20s} no segment followed by {'the prediction' if predicted is None else 'the simulation'}"
            )
            continue
        closed = [g.gap_closed for g in (predicted, simulated)]
        shown = [f"{'no gap':>9s}" if c is None else f"{c:9.3f}" for c in closed]
        apart = "" if None in closed else f"{closed[1] - closed[0]:10.3f}"
        note = "" if name not in WITHOUT_ELEMENT else "  not in the file"
        print(
            f"{name:22s} {effect.place:20s} {predicted.before:9.4g} {predicted.noise_floor:9.4g}"
            f" {shown[0]} {shown[1]} {apart:>10s}  {time.perf_counter() - began:.0f}{note}",
            flush=True,
        )


if __name__ == "__main__":
    main()
