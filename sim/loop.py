"""Closed loop: the digital controller around all simulations of an experiment, stepped together."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from mujoco.batch import Batch

from robot_assets.threads import thread_count
from sim.effects.dry import resistance
from sim.effects.effect import Run, State
from sim.plant import Plant, free_inertia, without_engine_log

FARTHEST = 50.0  # rad or m: beyond, a simulation has diverged


@dataclass(frozen=True)
class Controller:
    """PID on the motor encoder, with a filtered difference for the velocity.

    Attributes:
        kp, ki, kd: (S, n) N m/rad, N m/(rad s), N m s/rad.
        feed_forward: (S, n) N m.
        All or some (S, N, n) instead, along a motion.
    """

    kp: np.ndarray
    ki: np.ndarray
    kd: np.ndarray
    feed_forward: np.ndarray


@dataclass(frozen=True)
class Noise:
    """Standard deviations (n,): encoder (rad), record of the torque and torque itself (N m)."""

    q: np.ndarray
    tau: np.ndarray
    process: np.ndarray


@dataclass(frozen=True)
class Record:
    """What was recorded: (S, N, n) torque, motor position and link position."""

    tau: np.ndarray
    q: np.ndarray
    q_link: np.ndarray


@without_engine_log
def run_loop(
    plant: Plant,
    qpos: np.ndarray,
    reference: np.ndarray,
    excitation: np.ndarray,
    samples: int,
    controller: Controller,
    noise: Noise,
    sample_rate: float,
    rng: np.random.Generator,
    start: np.ndarray,
    progress: Callable[[float], None] | None = None,
) -> Record:
    """Run S simulations for N samples.

    Args:
        qpos: (S, nq) initial state, at rest.
        reference: (S, 1 or N, n) rad. excitation: (S, period, n) N m, repeated.
        start: (S,) s, time at which each begins, for effects that drift.
    """
    S, n = len(qpos), plant.robot.n
    h = plant.model.opt.timestep
    substeps = round(1 / (sample_rate * h))
    batch = Batch(plant.model, S, nthread=thread_count())
    x, v, force = batch.bind("qpos"), batch.bind("qvel"), batch.bind("qfrc_applied")
    x[:] = qpos
    run = Run(S, h, 1 / sample_rate, plant.robot, plant.drives, plant.model, start)
    torques = [e.torque(run) for e in plant.effects if callable(getattr(e, "torque", None))]
    dry = [e.dry(run) for e in plant.effects if hasattr(e, "dry")]
    deliver = [(run.joint(e.place), e.deliver(run)) for e in plant.effects if hasattr(e, "deliver")]
    measure = [
        (run.joint(e.place), getattr(e, "channel", "q"), getattr(e, "after_noise", False), e.measure(run))
        for e in plant.effects
        if hasattr(e, "measure")
    ]
    fine = bool(torques or dry or deliver or any(not late for _, _, late, _ in measure))
    m, a = plant.motor, plant.link
    inertia = free_inertia(plant, qpos) if dry else np.ones((S, plant.model.nv))
    resist = resistance(h, dry, inertia[:, m], inertia[:, a])
    tau, q, q_link = (np.empty((S, samples, n)) for _ in range(3))
    integral = np.zeros((S, n))
    velocity = np.zeros((S, n))
    last = reference[:, 0].copy()
    last_ref = reference[:, 0]
    v_old = np.zeros((S, plant.model.nv))
    seen = {"q": x[:, m].copy(), "q_link": x[:, a].copy()}
    period = excitation.shape[1]
    for k in range(samples):
        show = {"q": x[:, m].copy(), "q_link": x[:, a].copy()}
        for j, channel, late, _ in measure:
            if not late:
                show[channel][:, j] = seen[channel][:, j] if k else show[channel][:, j]
        y = show["q"] + noise.q * rng.standard_normal((S, n))
        y_link = show["q_link"] + noise.q * rng.standard_normal((S, n))
        for j, channel, late, step in measure:
            if late and channel == "q":
                y[:, j] = step(y[:, j], True)
        ref = reference[:, min(k, reference.shape[1] - 1)]
        velocity = 0.5 * velocity + 0.5 * ((y - ref) - (last - last_ref)) * sample_rate
        last, last_ref = y, ref
        integral += (ref - y) / sample_rate
        u = _at(controller.feed_forward, k) + excitation[:, k % period]
        u = u + _at(controller.kp, k) * (ref - y) + _at(controller.ki, k) * integral - _at(controller.kd, k) * velocity
        tau[:, k] = u + noise.tau * rng.standard_normal((S, n))
        q[:, k], q_link[:, k] = y, y_link
        u = u + noise.process * rng.standard_normal((S, n))
        if not fine:
            force[:, m] = u
            batch.step(nstep=substeps)
        else:
            for i in range(substeps):
                v_old = _fine_step(batch, x, v, force, plant, u, k * substeps + i, run, torques, resist, deliver, v_old)
                for j, channel, late, step in measure:
                    if not late:
                        now = x[:, m[j]] if channel == "q" else x[:, a[j]]
                        seen[channel][:, j] = step(now.copy(), i == substeps - 1)
        if k % 50 == 0 and _lost(q[:, k]):
            q[:, k:] = np.nan
            break
        if progress is not None and k % 50 == 0:
            progress(k / samples)
    if progress is not None:
        progress(1.0)
    return Record(tau, q, q_link)


def _at(x: np.ndarray, k: int) -> np.ndarray:
    """Sample k of (S, N, n), the last one beyond its end; (S, n) as it is."""
    return x if x.ndim == 2 else x[:, min(k, x.shape[1] - 1)]


def _fine_step(
    batch: Batch,
    x: np.ndarray,
    v: np.ndarray,
    force: np.ndarray,
    plant: Plant,
    u: np.ndarray,
    index: int,
    run: Run,
    torques: list,
    resist: Callable,
    deliver: list,
    v_old: np.ndarray,
) -> np.ndarray:
    """One integration step with torques of effects; returns the velocity at its start."""
    m, a, h = plant.motor, plant.link, run.step
    now = v.copy()
    mid = now + 0.5 * (now - v_old) if index else now
    position = x + 0.5 * h * now if x.shape[1] == v.shape[1] else x
    state = State(
        time=np.full(run.simulations, (index + 0.5) * h),
        q=position[:, m],
        v=mid[:, m],
        q_link=position[:, a],
        v_link=mid[:, a],
        now_q=x[:, m],
        now_v=now[:, m],
        now_q_link=x[:, a],
    )
    given = u.copy()
    for j, step in deliver:
        given[:, j] = step(given[:, j], index)
    force[:] = 0.0
    force[:, m] = given
    for step in torques:
        torque = step(state)
        force[:, m[torque.joint]] += torque.motor
        force[:, a[torque.joint]] += torque.link
    for friction, against in resist(state):
        force[:, (a if friction.link else m)[friction.joint]] += against
    batch.step(nstep=1)
    return now


def failed(plant: Plant, record: Record) -> bool:
    """Whether a simulation has diverged."""
    return _lost(record.q)


def _lost(q: np.ndarray) -> bool:
    return not bool(np.abs(q).max() <= FARTHEST)  # NaN too
