"""A whole plan run on the plant without a stop: one closed loop, one long recording."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from ident.dataset import Dataset, Segment
from ident.plan import Schedule
from robot_assets.errors import DataError
from sim.experiment import as_dataset, in_link_encoder, loop_gains, noise_levels, plant_for
from sim.loop import Controller, failed, run_loop
from sim.plant import Plant, link_inertia_diagonal, rest

KNOT = 50  # samples between postures at which gains and holding torque are computed


def run_recording(
    schedule: Schedule,
    effects: Sequence = (),
    *,
    seed: int = 0,
    drives: dict[str, np.ndarray] | None = None,
    noise: float = 1.0,
    timestep: float | None = None,
    integrator: str = "RK4",
    link_encoders: bool = False,
    name: str = "recording",
    progress: Callable[[float], None] | None = None,
) -> Dataset:
    """Run a schedule in one closed loop from rest in its first posture.

    The loop is that of separate experiments: its gains and its holding torque follow the posture, and
    the torque of a move is fed forward. There is no integral part.

    Args:
        effects, drives, noise, timestep, integrator, link_encoders: as in ``run_experiment``.

    Returns:
        A dataset of one segment, for ``ident.cutting.cut_recording``.

    Raises:
        DataError: where the loop diverges, or the step does not divide the sample time.
    """
    link_encoders = link_encoders or in_link_encoder(effects)
    plan = schedule.plan
    rate = plan.excitation.sample_rate
    plant = plant_for(plan, effects, drives, timestep, integrator)
    qpos, _ = rest(plant, schedule.q_ref[0])
    q_ref, r = schedule.q_ref[None], schedule.r[None]
    by_torque = plan.injection == "torque"
    record = run_loop(
        plant,
        qpos[None],
        q_ref if by_torque else q_ref + r,
        r if by_torque else np.zeros((1, 1, plan.robot.n)),
        len(schedule.q_ref),
        _controller(plant, schedule, rate),
        noise_levels(plan.robot, noise),
        rate,
        np.random.default_rng(seed),
        np.zeros(1),
        progress,
    )
    if failed(plant, record):
        raise DataError("closed loop", plan.robot.name, "a simulation that diverged", "a smaller effect or step")
    whole = Segment(
        name=name,
        kind="trajectory",
        role="identification",
        t=np.arange(len(schedule.q_ref)) / rate,
        tau=record.tau[0],
        q=record.q[0],
        q_link=record.q_link[0] if link_encoders else None,
        q_ref=schedule.q_ref,
        r=schedule.r,
    )
    return as_dataset(plan, [whole], name)


def _controller(plant: Plant, schedule: Schedule, rate: float) -> Controller:
    """Gains and feed-forward torque along the schedule, each (1, N, n)."""
    q, N = schedule.q_ref, len(schedule.q_ref)
    ends = [k for p in schedule.parts for k in (p.start, p.stop - 1)]
    moving = [k for p in schedule.parts if p.kind in ("move", "trajectory") for k in range(p.start, p.stop, KNOT)]
    knots = np.unique([*ends, *moving])
    known: dict[bytes, tuple[np.ndarray, np.ndarray]] = {}
    for k in knots:
        if q[k].tobytes() not in known:
            known[q[k].tobytes()] = link_inertia_diagonal(plant, q[k]), rest(plant, q[k])[1]
    inertia, hold = (
        np.stack(
            [
                np.interp(np.arange(N), knots, column)
                for column in np.stack([known[q[k].tobytes()][i] for k in knots]).T
            ],
            axis=1,
        )
        for i in range(2)
    )
    kp, kd = loop_gains(inertia)
    velocity = np.gradient(q, axis=0) * rate
    acceleration = np.gradient(velocity, axis=0) * rate
    forward = hold + inertia * acceleration + plant.robot.array("viscous_friction") * velocity
    return Controller(kp[None], np.zeros((1, schedule.q_ref.shape[1])), kd[None], forward[None])
