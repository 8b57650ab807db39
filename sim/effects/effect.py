"""What an effect of the plant may do, and the state it sees.

An effect is a frozen dataclass with ``name``, ``place`` and the parameters of the catalogue. It
may define any of:

    hinges() -> sequence of Elasticity           extra hinges of the chain
    edit(spec, robot, drives)                    native MuJoCo elements
    torque(run) -> step(State) -> Torque         a torque at every integration step
    dry(run) -> step(State) -> Dry               the size of a dry friction at every step (see ``dry``)
    deliver(run) -> step(u, index) -> u          what becomes of the commanded torque (S,) of its joint
    measure(run) -> step(State) -> (S,) rad      what the encoder shows of its joint
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, ClassVar, Protocol

import mujoco
import numpy as np

from robot_assets.robot import Robot


class Effect(Protocol):
    """What every effect has; the rest is looked for in it."""

    __dataclass_fields__: ClassVar[dict[str, Any]]

    @property
    def name(self) -> str: ...

    @property
    def place(self) -> str: ...


@dataclass(frozen=True)
class Run:
    """A run: number of simulations S, integration step h (s), sample time (s), compiled model, start times (S,)."""

    simulations: int
    step: float
    sample_time: float
    robot: Robot
    drives: dict[str, np.ndarray]
    model: mujoco.MjModel
    start: np.ndarray

    def joint(self, name: str) -> int:
        return self.robot.joint_names.index(name)


@dataclass(frozen=True)
class State:
    """State of all simulations in the middle of the coming integration step, each (S, n).

    Positions and velocities are extrapolated by half a step, so that a torque held over the step
    has no delay to first order. ``now_*`` are the values at its start.
    """

    time: np.ndarray
    q: np.ndarray
    v: np.ndarray
    q_link: np.ndarray
    v_link: np.ndarray
    now_q: np.ndarray
    now_v: np.ndarray
    now_q_link: np.ndarray


@dataclass(frozen=True)
class Torque:
    """Torques (S,) of one joint on its motor and on its link, N m."""

    joint: int
    motor: np.ndarray | float = 0.0
    link: np.ndarray | float = 0.0


@dataclass(frozen=True)
class Dry:
    """Dry friction of one joint: what it takes, each (S,) N m, to move forward and backward; at the motor or at the
    link."""

    joint: int
    forward: np.ndarray | float
    backward: np.ndarray | float
    link: bool = False


GEAR_SPRINGS = "gear", "outer"  # tendons of a joint that carry torque from its motor to its link


def carried(run: Run, place: str) -> Callable[..., np.ndarray]:
    """Torque (S,) that springs and damper of a joint's gear carry, laws in its tendons included, N m.

    It is asked for a state, with more wind-up (S,), rad, and its rate, rad/s, where there is an error of the
    transmission. An element that is a torque of its own, as that of a hysteresis, is beside them.
    """
    j, model = run.joint(place), run.model
    names = [model.tendon(i).name for i in range(model.ntendon)]
    ids = [names.index(f"{kind}:{place}") for kind in GEAR_SPRINGS if f"{kind}:{place}" in names]
    springs = [(model.tendon_stiffness[i], *model.tendon_stiffnesspoly[i], *model.tendon_lengthspring[i]) for i in ids]
    damping = sum(model.tendon_damping[i] for i in ids)
    others = _turned_by(run, ids[0], j)

    def at(x: State, more: np.ndarray | float = 0.0, rate: np.ndarray | float = 0.0) -> np.ndarray:
        delta = x.q[:, j] - x.q_link[:, j] + x.q @ others + more
        total = damping * (x.v[:, j] - x.v_link[:, j] + x.v @ others + rate)
        for stiffness, second, third, low, high in springs:
            over = delta - np.clip(delta, low, high)
            total = total + over * (stiffness + over * (second + over * third))
        return total

    return at


def _turned_by(run: Run, tendon: int, joint: int) -> np.ndarray:
    """(n,) by how much the other motors turn a joint: their part in the tendon of its gear."""
    model, ratios = run.model, np.zeros(run.robot.n)
    motors = [model.joint(f"motor:{name}").id for name in run.robot.joint_names]
    first = model.tendon_adr[tendon]
    for wrap in range(first, first + model.tendon_num[tendon]):
        at = int(model.wrap_objid[wrap])
        if at in motors and motors.index(at) != joint:
            ratios[motors.index(at)] += model.wrap_prm[wrap]
    return ratios
