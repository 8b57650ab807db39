"""An exported arm driven along recorded motion in closed loop: the torque that its motors need.

The recorded torque is fed forward, held as it was recorded, and a stiff loop around each rotor adds what
the simulated arm needs beyond it to follow the recorded motion, over and over the recorded period until
it repeats. What the loop leaves of a tracking error is accounted for by the arm's own linear response

    U = U_recorded + U_loop + Z (Q_recorded - Q_simulated),

all as lines of the period, with ``Z`` the sampled impedance: recorded torque per motor position, by
differences of one integration step. The loop follows the lines of the position that stand above noise;
on the others ``Z`` alone counts, as it does in the noise of the torque residual.
"""

from __future__ import annotations

import copy
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import mujoco
import numpy as np
import scipy.fft
from mujoco.batch import Batch

from ident.graybox import hold_response
from ident.group import Group
from ident.inverse import Sampling, drifting_torque, recorded_share
from ident.show.export import FRICTION_SLIP, PASSIVE_GROUP, TORQUE_OFFSET, stage_lead

LOOP = 0.15  # frequency of the loop times the time by which torque lags what the loop sees, rad
PERIODS = 6  # at most, after the one in which the motion fades in
REPEATS = 0.02  # change from one period to the next, over the torque error, that counts as steady
LOST = 0.5  # rad or m off the recorded motion: the simulation has diverged
STEP = 1e-6  # of state and torque for differences
REST_STEPS = 50


@dataclass(frozen=True)
class Arm:
    """A compiled arm and where its drives stand.

    Attributes:
        model: MuJoCo model; its step divides the sample time.
        motor: (n,) addresses of the rotors in qpos and qvel alike. drive: (n,) ids of the actuators.
        gear: (n,) torque delivered per torque commanded, in the steady state.
        limit: (n,) N m, on the command. delay, lag: (n,) s, of the drives. sensor_delay: (n,) s, of the motor encoders.
        timing, roll_off, offset: s, s2 and (n,) N m, what the record of the torque has beyond the motors' own.
    """

    model: mujoco.MjModel
    motor: np.ndarray
    drive: np.ndarray
    gear: np.ndarray
    limit: np.ndarray
    delay: np.ndarray
    lag: np.ndarray
    sensor_delay: np.ndarray
    timing: float
    roll_off: float
    offset: np.ndarray

    @property
    def ctrl(self) -> np.ndarray:
        """(n,) addresses of the drives in ctrl."""
        return self.model.actuator_ctrladr[self.drive]

    @property
    def filters(self) -> np.ndarray:
        """Addresses in act of the drives that have a lag."""
        return self.model.actuator_actadr[self.drive[self.lag > 0]]


@dataclass(frozen=True)
class Replay:
    """Torque that the motors of a simulated arm need along the motion of a group.

    Attributes:
        U: (S, L, n) as recorded torque, N m. tracking: (S, n) rms tracking error of the loop, rad.
        change: of the torque from the period before, over the torque error; 0 where there is one period.
    """

    U: np.ndarray
    tracking: np.ndarray
    change: float


def load_arm(source: str | Path | mujoco.MjSpec, joints: Sequence[str], sample_time: float) -> Arm:
    """An exported arm, compiled with a step that divides the sample time.

    Args:
        source: path of the MJCF, or a spec as ``build_mjcf`` makes it (left as it is).
    """
    spec = source.copy() if isinstance(source, mujoco.MjSpec) else mujoco.MjSpec.from_file(str(source))
    old = spec.option.timestep
    step = sample_time / np.ceil(sample_time / old - 1e-9)
    lead = stage_lead(old, spec.option.integrator) - stage_lead(step, spec.option.integrator)
    delay, lag, gear, limit = (
        np.zeros(len(joints)),
        np.zeros(len(joints)),
        np.ones(len(joints)),
        np.full(len(joints), np.inf),
    )
    for j, name in enumerate(joints):
        drive = spec.actuator(f"drive:{name}")
        gear[j] = drive.gear[0]
        if drive.forcelimited == mujoco.mjtLimited.mjLIMITED_TRUE:
            limit[j] = drive.forcerange[1]
        if drive.delay:
            drive.delay -= lead
            drive.nsample = int(np.ceil(drive.delay / step)) + 2
            delay[j] = drive.delay - stage_lead(step, spec.option.integrator)
        if drive.dyntype in (mujoco.mjtDyn.mjDYN_FILTER, mujoco.mjtDyn.mjDYN_FILTEREXACT):
            lag[j] = drive.dynprm[0]
    spec.option.timestep = step
    late = np.zeros(len(joints))
    for sensor in spec.sensors:
        if sensor.objname in (f"motor:{name}" for name in joints):
            sensor.nsample = int(np.ceil(sensor.delay / step)) + 2
            late[[f"motor:{name}" for name in joints].index(sensor.objname)] += sensor.delay
    model = spec.compile()
    record = {model.numeric(i).name: float(model.numeric(i).data[0]) for i in range(model.nnumeric)}
    return Arm(
        model,
        motor=np.array([int(model.joint(f"motor:{name}").qposadr[0]) for name in joints]),
        drive=np.array([model.actuator(f"drive:{name}").id for name in joints]),
        gear=gear,
        limit=limit,
        delay=delay,
        lag=lag,
        sensor_delay=late,
        timing=record.get("simgap.record.timing", 0.0),
        roll_off=record.get("simgap.record.roll_off", 0.0),
        offset=np.array([record.get(f"simgap.record.{TORQUE_OFFSET}.{name}", 0.0) for name in joints]),
    )


def replay(arm: Arm, group: Group, sampling: Sampling) -> Replay:
    """Torque that the simulated motors need along the recorded motion of a group.

    A motion without periodicity is run once, from its return on.

    Raises:
        FloatingPointError: where the simulation diverges.
    """
    h = arm.model.opt.timestep
    N = round(group.period_time / sampling.sample_time)
    m = round(sampling.sample_time / h)
    s = 1j * group.omega[:, None]
    shift = recorded_share(group.omega, arm.timing, arm.roll_off)[:, None]
    rest, hold = equilibrium(arm, group.posture)
    Z = (
        sampled_impedance(arm, rest, hold, group.omega, m)
        * np.exp(s * arm.delay)[:, :, None]
        * np.exp(s * arm.sensor_delay)[:, None, :]
    )
    aim = group.Q * group.signal_share * np.exp(s * arm.sensor_delay)
    fed = group.U / shift
    fed[:, 0] -= arm.offset
    reference, velocity = _on_grid(aim, N * m), _on_grid(s * aim, N * m)
    if sampling.hold == "none":
        forward = _on_grid(fed * np.exp(0.5 * h * s), N * m)
    else:
        forward = np.repeat(_on_grid(fed, N), m, axis=1)
    loop = _Loop(arm, len(group.segments), rest, hold)
    begin = 0 if group.window is None else int(np.max(np.nonzero(group.window)[0]) * N // group.n_time) * m
    fade, slope = _fade(N * m - begin, h)
    off, of = reference[:, begin:] - rest[arm.motor], forward[:, begin:] - hold
    loop.run(rest[arm.motor] + fade * off, fade * velocity[:, begin:] + slope * off, hold + fade * of, m)
    ratio = hold_response(group.omega, h, "zoh") / hold_response(group.omega, sampling.sample_time, sampling.hold)
    U, change = None, 0.0
    for _ in range(PERIODS if group.window is None else 1):
        added, q = loop.run(reference, velocity, forward, m)
        missed = group.Q - _lines(q, len(group.omega)) * np.exp(-s * arm.sensor_delay)
        needed = fed + ratio[:, None] * _lines(added, len(group.omega)) + np.matmul(Z, missed[..., None])[..., 0]
        needed[:, 0] += arm.offset
        old, U = U, needed * shift
        if old is not None:
            K = group.n_compared
            change = float(np.linalg.norm((U - old)[:, :K]) / np.linalg.norm((group.U - U)[:, :K]))
            if change < REPEATS:
                break
    assert U is not None
    if group.drift is not None:
        U = U + shift * drifting_torque(Z, group.drift)
    tracking = np.sqrt(np.mean((q - reference[:, ::m]) ** 2, axis=1))
    return Replay(U, tracking, change)


def equilibrium(arm: Arm, posture: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """State at rest with the motors at ``posture`` (n,): positions (nq,), and torques that hold it (n,)."""
    model, data = arm.model, mujoco.MjData(arm.model)
    free = np.setdiff1d(np.arange(model.nq), arm.motor)
    x = np.zeros(model.nq)
    x[arm.motor] = posture
    for j, address in enumerate(arm.motor):
        name = model.joint(int(model.dof_jntid[address])).name.split(":", 1)[1]
        x[model.joint(f"link:{name}").qposadr[0]] = posture[j]

    def force(x: np.ndarray) -> np.ndarray:
        mujoco.mj_resetData(model, data)
        data.qpos[:] = x
        mujoco.mj_forward(model, data)
        return data.qfrc_passive - data.qfrc_bias + data.qfrc_actuator

    for _ in range(REST_STEPS):
        f = force(x)[free]
        J = np.stack([(force(_moved(x, k, 1e-7))[free] - f) / 1e-7 for k in free], axis=1)
        step = np.clip(np.linalg.lstsq(J, -f, rcond=1e-13)[0], -0.05, 0.05)
        x[free] += step
        if np.abs(step).max() < 1e-11:
            break
    return x, -force(x)[arm.motor] / arm.gear


def sampled_impedance(arm: Arm, rest: np.ndarray, hold: np.ndarray, omega: np.ndarray, substeps: int) -> np.ndarray:
    """Recorded torque per sampled motor position about rest, without delays; (L, n, n).

    Of ``x+ = A x + B u`` over one sample time, from differences of one integration step: the ``u`` that solves
    ``z x = A x + B u, C x = q``, which stands where the arm moves freely too. Dry friction, cogging and bristles
    are left out.
    """
    model = _smooth(arm)
    data = mujoco.MjData(model)
    nq, nv = model.nq, model.nv
    filters = arm.filters

    def after(x: np.ndarray, u: np.ndarray) -> np.ndarray:
        mujoco.mj_resetData(model, data)
        data.qpos[:], data.qvel[:], data.act[filters] = np.split(x, [nq, nq + nv])
        data.ctrl[arm.ctrl] = u
        mujoco.mj_step(model, data)
        return np.concatenate([data.qpos, data.qvel, data.act[filters]])

    x = np.concatenate([rest, np.zeros(nv), hold[arm.lag > 0]])
    n, size = len(hold), len(x)
    A1 = np.stack(
        [(after(_moved(x, k, STEP), hold) - after(_moved(x, k, -STEP), hold)) / (2 * STEP) for k in range(size)], 1
    )
    B1 = np.stack([(after(x, _moved(hold, k, 1.0)) - after(x, _moved(hold, k, -1.0))) / 2.0 for k in range(n)], 1)
    A, B = np.eye(size), np.zeros((size, n))
    for _ in range(substeps):
        A, B = A1 @ A, A1 @ B + B1
    z = np.exp(1j * omega * substeps * model.opt.timestep)
    system = np.zeros((len(omega), size + n, size + n), complex)
    system[:, :size, :size] = z[:, None, None] * np.eye(size) - A
    system[:, :size, size:] = -B
    system[:, size + np.arange(n), arm.motor] = 1.0
    right = np.zeros((size + n, n))
    right[size:] = np.eye(n)
    return np.linalg.solve(system, np.broadcast_to(right, (len(omega), *right.shape)))[:, size:]


def felt_inertia(arm: Arm, rest: np.ndarray) -> np.ndarray:
    """Inertia that each motor moves within an integration step, dry friction apart; (n,) kg m2.

    That of the rotor, and of the link too where a damper ties them together.
    """
    model = _smooth(arm)
    data = mujoco.MjData(model)

    def speed(torque: np.ndarray) -> np.ndarray:
        mujoco.mj_resetData(model, data)
        data.qpos[:] = rest
        data.qfrc_applied[arm.motor] = torque
        mujoco.mj_step(model, data)
        return data.qvel[arm.motor].copy()

    unit = np.eye(len(arm.motor))
    gained = [(speed(e) - speed(-e))[j] / 2.0 for j, e in enumerate(unit)]
    return model.opt.timestep / np.array(gained)


def _smooth(arm: Arm) -> mujoco.MjModel:
    """The arm without delays, dry friction and the parts of ``PASSIVE_GROUP``, which at rest would hold it."""
    model = copy.copy(arm.model)
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_FRICTIONLOSS
    model.opt.disableactuator |= 1 << PASSIVE_GROUP
    model.actuator_delay[:] = 0.0
    slips = [i for i in range(model.ntendon) if model.tendon(i).name.startswith(f"{FRICTION_SLIP}:")]
    model.tendon_stiffness[slips] = 0.0
    return model


class _Loop:
    """Simulations of an arm side by side, each motor in a loop of its own; keeps the state between runs."""

    def __init__(self, arm: Arm, simulations: int, rest: np.ndarray, hold: np.ndarray) -> None:
        self.arm = arm
        self.batch = Batch(arm.model, simulations, nthread=1)
        names = ("qpos", "qvel", "ctrl")
        self.q, self.v, self.ctrl = (self.batch.bind(name) for name in names)
        self.q[:] = rest
        data = mujoco.MjData(arm.model)
        if len(arm.filters):
            self.batch.bind("act")[:, arm.filters] = hold[arm.lag > 0]
        if arm.model.nhistory:
            for i, torque in zip(arm.drive, hold, strict=True):
                samples = int(arm.model.actuator_history[i, 0])
                if samples:
                    mujoco.mj_initCtrlHistory(arm.model, data, i, None, np.full(samples, torque))
            self.batch.bind("history")[:] = data.history
        frequency = LOOP / (arm.model.opt.timestep + arm.delay + arm.lag)
        inertia = felt_inertia(arm, rest)
        self.kp, self.kd = inertia * frequency**2 / arm.gear, 2.0 * inertia * frequency / arm.gear

    def run(
        self, reference: np.ndarray, velocity: np.ndarray, forward: np.ndarray, substeps: int
    ) -> tuple[np.ndarray, np.ndarray]:
        """Follow references (S, T, n), one integration step each: loop torque (S, T, n), position at samples.

        Torque beyond the limit of a drive is not delivered, and no motion tells it: there the record stands.
        """
        motor, drives, limit = self.arm.motor, self.arm.ctrl, self.arm.limit
        added = np.empty_like(reference)
        q = np.empty((len(reference), -(-reference.shape[1] // substeps), reference.shape[2]))
        for k in range(reference.shape[1]):
            at = self.q[:, motor]
            if k % substeps == 0:
                q[:, k // substeps] = at
            torque = self.kp * (reference[:, k] - at) + self.kd * (velocity[:, k] - self.v[:, motor])
            self.ctrl[:, drives] = torque + forward[:, k]
            added[:, k] = np.clip(torque + forward[:, k], -limit, limit) - np.clip(forward[:, k], -limit, limit)
            self.batch.step()
        if not np.all(np.isfinite(q)) or np.abs(q - reference[:, ::substeps]).max() > LOST:
            raise FloatingPointError("the simulated arm loses the recorded motion")
        return added, q


def _fade(points: int, step: float) -> tuple[np.ndarray, np.ndarray]:
    """Weights (points, 1) from 0 to 1 with flat ends, and their slope, 1/s."""
    u = ((np.arange(points) + 1.0) / points)[:, None]
    return u**3 * (10 - 15 * u + 6 * u**2), 30 * u**2 * (1 - u) ** 2 / (points * step)


def _moved(x: np.ndarray, k: int, by: float) -> np.ndarray:
    out = x.copy()
    out[k] += by
    return out


def _on_grid(X: np.ndarray, points: int) -> np.ndarray:
    """Spectrum (S, L, n) on a grid of one period (S, points, n)."""
    return scipy.fft.irfft(X, n=points, axis=1, norm="forward")


def _lines(x: np.ndarray, count: int) -> np.ndarray:
    """First lines (S, count, n) of one period (S, T, n)."""
    return scipy.fft.rfft(x, axis=1, norm="forward")[:, :count]
