"""`simgap design`: a plan as a file, and what it promises."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from ident.design import LEAST, Design, design_experiment, design_plan
from ident.plan import Plan
from ident.plan_file import plan_to_toml
from robot_assets.errors import DataError
from robot_assets.robot import Robot

WORDS = {"D": "covariance determinant", "A": "sum of variances", "E": "largest eigenvalue of the covariance"}


def write_design(
    robot: Robot, out: Path, levels: tuple[float, ...], say: Callable[[str], None], **options
) -> tuple[dict[str, Any], str]:
    """Design an experiment and write its plan; returns a summary and a text that says the same.

    Args:
        levels: of the excitation, the largest first. options: of ``design_experiment``.

    Raises:
        DataError: where the plan cannot be written there, or the design fails.
    """
    if out.is_dir():
        raise DataError("--out", str(out), "a folder", "a file for the plan")
    for level in levels:
        if not 1e-9 <= level <= 1e9:
            raise DataError("--level", "command line", f"{level:g}", "an excitation level above zero")
    say("drawing postures and computing what each would show")
    last = [0]

    def share(done: float) -> None:
        if int(4 * done) > last[0]:
            last[0] = int(4 * done)
            say(f"information of the candidates: {done:.0%}")

    design = design_experiment(robot, progress=share, **options)
    say("writing the plan")
    plan = design_plan(design, levels=levels)
    plan_to_toml(plan, out)
    summary = _summary(design, plan, out)
    return summary, _text(design, summary)


def _summary(design: Design, plan: Plan, out: Path) -> dict[str, Any]:
    x, weights = plan.excitation, design.weights
    worst = np.argsort(design.std)[::-1][:5]
    return {
        "plan": str(out),
        "robot": plan.robot.name,
        "criterion": weights.criterion,
        "optimality_gap": weights.gap,
        "candidates": len(design.candidates.q),
        "refused": design.candidates.refused,
        "support": int((weights.weights > LEAST).sum()),
        "efficiency_of_rounding": design.efficiency,
        "median_random_over_designed": design.ratio,
        "best_random_over_designed": float(np.exp(design.random_loss.min() - design.loss)),
        "experiments": len(plan.experiments),
        "seconds": len(plan.experiments) * x.periods * x.period / x.sample_rate,
        "operating_points": design.postures.round(6).tolist(),
        "least_certain": {design.names[i]: float(design.std[i]) for i in worst},
        "note": design.candidates.note,
    }


def _text(design: Design, s: dict[str, Any]) -> str:
    refused = ", ".join(f"{count} for {why}" for why, count in s["refused"].items()) or "none"
    distinct = len(np.unique(design.chosen))
    rows = [
        f"{s['criterion']}-optimal over {s['candidates']} postures (refused: {refused}): gap {s['optimality_gap']:.1e}, {s['support']} carry weight",
        f"{len(design.chosen)} operating points, {distinct} of them distinct, {s['efficiency_of_rounding']:.1%} efficient",
        f"{WORDS[s['criterion']]} of random choices as long: {s['median_random_over_designed']:.3g} times it (median of {len(design.random_loss)}), {s['best_random_over_designed']:.3g} (best)",
        "least certain, by noise alone: " + ", ".join(f"{name} {std:.2g}" for name, std in s["least_certain"].items()),
        f"{s['experiments']} experiments, {s['seconds'] / 60:.1f} min, in {s['plan']}",
    ]
    return "\n".join([*rows, *([s["note"]] if s["note"] else [])])
