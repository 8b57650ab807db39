"""Gain of an exported model: both models simulated in MuJoCo, in closed loop, along held-out motion."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from ident.dataset import Dataset
from ident.extended import predict
from ident.format_checks import checked
from ident.gain import Errors, mean_squares, measure_gain
from ident.graybox import parameter_names
from ident.group import Group
from ident.held_out import with_held_out
from ident.identification import identify
from ident.inverse import Sampling
from ident.left_out import SEED
from ident.lost_samples import with_lost_samples_filled
from ident.model import Model
from ident.output_noise import noise_covariance
from ident.parallel import one_thread_each
from ident.problem import Problem, predictions
from ident.reporting import affected_joints
from ident.show.export import build_mjcf, note_record
from ident.show.replay import load_arm, replay
from ident.units import units_of_torques
from ident.verdict import Gain
from robot_assets.errors import DataError

METRIC = "RMS error of the torque that the simulated motors need"
SEGMENTS = 4  # of each operating point that are simulated


@one_thread_each
def simulated_gain(
    dataset: Dataset,
    model: str | Path | mujoco.MjSpec,
    *,
    segments: int = SEGMENTS,
    progress: Callable[[str], None] | None = None,
) -> Gain | None:
    """Gain of an exported model over the identified one without effects, by simulation of both.

    The metric is that of the verdict's gain (``ident.gain``), with the torque of the simulated arms in the place of
    predictions (``ident.show.replay``). Joints and noise floor are those of the ``verdict.json`` beside the file. Without
    one, or where that measures its gain on other segments, they are those of the model without effects: what is missing
    of it may be in its noise.

    Args:
        dataset: with held-out segments, or a single motion whose end is held out.
        model: ``model.xml`` of a diagnosis of it, or a spec, which has no verdict beside it.
        segments: of each operating point that are simulated, at most.
        progress: told in a line what is done.

    Returns:
        The gain, None where no held-out segment can be followed.

    Raises:
        DataError: where the dataset breaks the format or has no held-out segments.
    """
    dataset = with_held_out(with_lost_samples_filled(checked(dataset))[0])
    none = DataError("segments", dataset.name, "none of role validation", "at least one to simulate")
    if not any(s.role == "validation" for s in dataset.segments):
        raise none
    setup, baseline = identify(dataset, progress=progress)
    if not setup.held_out:
        raise none
    problem = setup.problem
    groups = tuple(g.pick(spread(len(g.segments), segments)) for g in setup.held_out)
    joints = problem.structure.robot.joint_names
    told = gain_beside(model, dataset.name, joints, [name for g in groups for name in g.segments])
    if told is None:
        affected = affected_joints(problem, baseline, predictions(problem, baseline.model, baseline.remainders))
    else:
        affected = tuple(j for j, name in enumerate(joints) if name in told["joints"])
    if progress is not None:
        progress("simulation of both models")
    before = export_baseline(baseline.model, problem.sampling)
    errors = simulated_errors(problem, groups, baseline.model, before, model)
    if told is not None:
        floor = np.array([told["by_joint"][name]["noise_floor"] for name in joints])
        errors = replace(errors, noise=np.broadcast_to(floor**2, errors.noise.shape))
    rng = np.random.default_rng(SEED)
    return measure_gain(
        errors, units_of_torques(problem.structure.robot), affected, "simulated in closed loop", rng, METRIC
    )


def gain_beside(
    model: str | Path | mujoco.MjSpec, dataset: str, joints: Sequence[str], segments: Sequence[str]
) -> dict[str, Any] | None:
    """The gain of the ``verdict.json`` in the folder of a file, as it is written; None where there is none of this
    dataset, on these joints and segments."""
    if isinstance(model, mujoco.MjSpec):
        return None
    try:
        verdict = json.loads(Path(model).with_name("verdict.json").read_text(encoding="utf-8"))
        gain = verdict["gain"]
        fits = verdict["dataset"] == dataset and set(gain["joints"]) <= set(joints)
        fits = fits and set(gain["by_joint"]) == set(joints) and set(segments) <= set(gain["segments"])
        fits = fits and all(float(x["noise_floor"]) >= 0.0 for x in gain["by_joint"].values())
    except (OSError, ValueError, KeyError, TypeError):
        return None
    return gain if fits else None


def export_baseline(model: Model, sampling: Sampling) -> mujoco.MjSpec:
    """MJCF of a model without effects, with what the record of its torque has beyond it."""
    robot = model.structure.robot
    values = dict(zip(parameter_names(robot), np.exp(model.par.to_log()), strict=True))
    spec = build_mjcf(robot, values, inertias=model.structure.inertias)
    note_record(spec, model.par.timing, sampling.roll_off, {})
    return spec


def simulated_errors(
    problem: Problem,
    groups: Sequence[Group],
    noise_of: Model,
    before: str | Path | mujoco.MjSpec,
    after: str | Path | mujoco.MjSpec,
) -> Errors:
    """Errors of the torque that two simulated arms need, in the compared band; a group that one loses is left out.

    Args:
        noise_of: the model by which noise of the position counts as torque.
    """
    joints = problem.structure.robot.joint_names
    arms = [load_arm(x, joints, problem.sampling.sample_time) for x in (before, after)]
    names: list[str] = []
    out: list[list[np.ndarray]] = [[], [], []]
    for group in groups:
        share = group.window_share
        try:
            needed = [replay(arm, group, problem.sampling).U for arm in arms]
            noise = noise_covariance(problem, group, predict(noise_of, group, problem.sampling))
        except FloatingPointError:
            continue
        names += group.segments
        for store, U in zip(out, needed):
            store.append(mean_squares(np.abs(group.observe(group.U - U)) ** 2) / share)
        floor = mean_squares(np.einsum("kii->ki", noise).real[None])
        out[2].append(np.repeat(floor, len(group.segments), axis=0))
    joined = (np.concatenate(x) if x else np.zeros((0, len(joints))) for x in out)
    return Errors(tuple(names), *joined)


def spread(count: int, most: int) -> np.ndarray:
    """At most ``most`` of ``count`` indices, over the whole range."""
    return np.unique(np.linspace(0, count - 1, min(count, most)).round().astype(int))
