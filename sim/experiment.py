"""A plan run on a plant: the dataset that a real robot would give."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from ident.dataset import Dataset, Segment
from ident.excitation import LOOP_HZ
from ident.plan import Plan, make_plan
from robot_assets.errors import DataError
from robot_assets.robot import Robot
from sim.loop import Controller, Noise, failed, run_loop
from sim.plant import DRIVE_FIELDS, Plant, build_plant, gravity_torque, link_inertia_diagonal, rest, time_step

DAMPING_RATIO = 0.7
PROCESS_SHARE = 0.5  # of the torque noise that really acts on the motor, in units of tau_std
PAUSE = 2.0  # s between two segments
FEED_FORWARD_EVERY = 20  # samples of a motion between postures whose holding torque is looked at


def draw_drives(rng: np.random.Generator, robot: Robot, factor: float = 2.0) -> dict[str, np.ndarray]:
    """True drive figures within ``factor`` of the nominal ones, log-uniform."""
    return {f: robot.array(f) * np.exp(rng.uniform(-np.log(factor), np.log(factor), robot.n)) for f in DRIVE_FIELDS}


def plan_experiment(robot: Robot, postures: np.ndarray, **options: Any) -> Plan:
    """A plan whose levels suit the inertia and the gravity torque that the arm has in all its postures.

    Args:
        postures: (points, n) rad, those for validation last.
        options: others of ``ident.excitation.make_plan``.
    """
    plant = build_plant(robot)
    return make_plan(
        robot,
        postures=postures,
        inertia=np.min([link_inertia_diagonal(plant, q) for q in postures], axis=0),
        gravity_torque=np.max([np.abs(gravity_torque(plant, q)) for q in postures], axis=0),
        **options,
    )


def run_experiment(
    plan: Plan,
    effects: Sequence = (),
    *,
    seed: int = 0,
    drives: dict[str, np.ndarray] | None = None,
    noise: float = 1.0,
    timestep: float | None = None,
    integrator: str = "RK4",
    link_encoders: bool = False,
    name: str = "experiment",
    progress: Callable[[float], None] | None = None,
) -> Dataset:
    """Run every experiment and motion of a plan.

    Args:
        effects: what is hidden in the plant.
        drives: true drive figures; nominal where None.
        noise: factor on the noise of ``robot.toml``.
        timestep: s, of MuJoCo; a whole fraction of the sample time. ``time_step`` of the arm where None.
        link_encoders: whether they are recorded; they are where an effect sits in one.

    Raises:
        DataError: where the loop diverges, or the step does not divide the sample time.
    """
    link_encoders = link_encoders or in_link_encoder(effects)
    rng = np.random.default_rng(seed)
    plant = plant_for(plan, effects, drives, timestep, integrator)
    levels = noise_levels(plan.robot, noise)
    segments: list[Segment] = []
    share = len(plan.experiments) / max(len(plan.experiments) + len(plan.trajectories), 1)
    clock = 0.0
    if plan.experiments:
        inner = None if progress is None else lambda f: progress(share * f)
        segments += _multisines(plant, plan, levels, rng, link_encoders, inner)
        clock = segments[-1].t[-1] + PAUSE
    for move in plan.trajectories:
        segments.append(_motion(plant, plan, move, levels, rng, link_encoders, clock))
        clock = segments[-1].t[-1] + PAUSE
    if progress is not None:
        progress(1.0)
    return as_dataset(plan, segments, name)


def in_link_encoder(effects: Sequence) -> bool:
    """Whether an effect would leave no trace without link encoders."""
    return any(getattr(e, "channel", None) == "q_link" for e in effects)


def as_dataset(plan: Plan, segments: Sequence[Segment], name: str) -> Dataset:
    """Segments recorded on the plant as a dataset."""
    robot = plan.robot
    return Dataset(
        name=name,
        robot=robot,
        sample_rate=plan.excitation.sample_rate,
        joints=robot.joint_names,
        input_hold="zoh",
        q_std=None,
        tau_std=None,
        controller={"type": "pid"},
        segments=tuple(segments),
    )


def plant_for(
    plan: Plan, effects: Sequence, drives: dict[str, np.ndarray] | None, timestep: float | None, integrator: str
) -> Plant:
    """The plant of a plan, with a step that suits it where none is given.

    Raises:
        DataError: where a given step does not divide the sample time.
    """
    rate = plan.excitation.sample_rate
    if timestep is not None:
        check_step(timestep, rate)
    plant = build_plant(plan.robot, effects, drives=drives, integrator=integrator)
    plant.model.opt.timestep = time_step(plant, rate) if timestep is None else timestep
    return plant


def check_step(timestep: float, sample_rate: float) -> None:
    """Raise a DataError where the step does not divide the sample time."""
    steps = 1 / (sample_rate * timestep)
    if abs(steps - round(steps)) > 1e-9:
        raise DataError("timestep", "plant", f"{timestep:g} s", f"a whole fraction of {1 / sample_rate:g} s")


def noise_levels(robot: Robot, factor: float) -> Noise:
    """The noise of ``robot.toml`` times a factor."""
    q, tau = factor * robot.array("q_std"), factor * robot.array("tau_std")
    return Noise(q, tau, PROCESS_SHARE * tau)


def loop_gains(inertia: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Proportional and derivative gain of a loop of ``LOOP_HZ`` around an inertia."""
    w = 2 * np.pi * LOOP_HZ
    return inertia * w**2, 2 * DAMPING_RATIO * inertia * w


def _multisines(
    plant: Plant, plan: Plan, levels: Noise, rng: np.random.Generator, link_encoders: bool, progress
) -> list[Segment]:
    x, n = plan.excitation, plan.robot.n
    S, N = len(plan.experiments), x.period * x.periods
    by_point: dict[str, tuple] = {}
    for e in plan.experiments:
        if e.operating_point not in by_point:
            qpos, hold = rest(plant, e.q0)
            by_point[e.operating_point] = qpos, hold, *loop_gains(link_inertia_diagonal(plant, e.q0))
    qpos, hold, kp, kd = (np.stack([by_point[e.operating_point][i] for e in plan.experiments]) for i in range(4))
    q0 = np.stack([e.q0 for e in plan.experiments])
    r = np.stack([e.r for e in plan.experiments])
    torque = r if plan.injection == "torque" else np.zeros((S, 1, n))
    reference = q0[:, None] if plan.injection == "torque" else q0[:, None] + np.tile(r, (1, x.periods, 1))
    start = np.arange(S) * (N / x.sample_rate + PAUSE)
    controller = Controller(kp, np.zeros_like(kp), kd, hold)
    record = run_loop(plant, qpos, reference, torque, N, controller, levels, x.sample_rate, rng, start, progress)
    if failed(plant, record):
        raise DataError("closed loop", plan.robot.name, "a simulation that diverged", "a smaller effect or step")
    t = np.arange(N) / x.sample_rate
    return [
        Segment(
            t=start[s] + t,
            tau=record.tau[s],
            q=record.q[s],
            q_link=record.q_link[s] if link_encoders else None,
            r=np.tile(r[s], (x.periods, 1)),
            **e.labels(x),
        )
        for s, e in enumerate(plan.experiments)
    ]


def _motion(
    plant: Plant, plan: Plan, move, levels: Noise, rng: np.random.Generator, link_encoders: bool, clock: float
) -> Segment:
    ref = move.q_ref
    rate = plan.excitation.sample_rate
    inertia = link_inertia_diagonal(plant, ref[0])
    kp, kd = loop_gains(inertia)
    qpos, _ = rest(plant, ref[0])
    at = np.arange(0, len(ref), FEED_FORWARD_EVERY)
    coarse = np.stack([rest(plant, ref[k])[1] for k in at])
    ff = np.stack([np.interp(np.arange(len(ref)), at, c) for c in coarse.T], axis=1)
    acceleration = np.gradient(np.gradient(ref, axis=0), axis=0) * rate**2
    ff = ff + inertia * acceleration + plan.robot.array("viscous_friction") * np.gradient(ref, axis=0) * rate
    controller = Controller(kp[None], 2.0 * kp[None], kd[None], ff[None])
    record = run_loop(
        plant,
        qpos[None],
        ref[None],
        np.zeros((1, 1, plan.robot.n)),
        len(ref),
        controller,
        levels,
        rate,
        rng,
        np.array([clock]),
    )
    if failed(plant, record):
        raise DataError("closed loop", move.name, "a motion that diverged", "a smaller effect or step")
    return Segment(
        name=move.name,
        kind="trajectory",
        role=move.role,
        t=clock + np.arange(len(ref)) / rate,
        tau=record.tau[0],
        q=record.q[0],
        q_link=record.q_link[0] if link_encoders else None,
        q_ref=ref,
    )
