"""Effects of the gear."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import mujoco
import numpy as np

from robot_assets.errors import DataError
from robot_assets.robot import Robot
from sim.effects.effect import GEAR_SPRINGS, Run, State, Torque, carried


@dataclass(frozen=True)
class HardeningStiffness:
    """Gear torque ``K delta + cubic delta^3``: the tendon's polynomial stiffness."""

    place: str
    cubic: float
    name = "hardening_stiffness"

    def edit(self, spec: mujoco.MjSpec, robot: Robot, drives: dict) -> None:
        gear = spec.tendon(f"gear:{self.place}")
        gear.stiffness = [gear.stiffness[0], gear.stiffness[1], gear.stiffness[2] + self.cubic]


@dataclass(frozen=True)
class SofteningStiffness:
    """``low_stiffness`` within ``transition`` (rad) of zero, or of the end of a dead band: a second spring with a wider one."""

    place: str
    low_stiffness: float
    transition: float
    name = "softening_stiffness"

    def edit(self, spec: mujoco.MjSpec, robot: Robot, drives: dict) -> None:
        if spec.tendon(f"outer:{self.place}") is not None:
            raise DataError(f"effect {self.name}", self.place, "it twice", "once at a joint")
        gear = spec.tendon(f"gear:{self.place}")
        high = float(gear.stiffness[0])
        if self.low_stiffness >= high:
            found = f"low_stiffness {self.low_stiffness:g}"
            raise DataError(f"effect {self.name}", self.place, found, f"less than the {high:g} of its gear")
        gear.stiffness = [self.low_stiffness, *gear.stiffness[1:]]
        play = float(gear.springlength[1])
        outer = spec.add_tendon(name=f"outer:{self.place}")
        outer.wrap_joint(f"motor:{self.place}", 1.0)
        outer.wrap_joint(f"link:{self.place}", -1.0)
        outer.stiffness = [high - self.low_stiffness, 0, 0]
        outer.springlength = [-play - self.transition, play + self.transition]


@dataclass(frozen=True)
class Backlash:
    """Dead band of width ``gap`` (rad): the tendon's spring range."""

    place: str
    gap: float
    name = "backlash"

    def edit(self, spec: mujoco.MjSpec, robot: Robot, drives: dict) -> None:
        for tendon in springs_of(spec, self.place):
            low, high = tendon.springlength
            tendon.springlength = [low - 0.5 * self.gap, high + 0.5 * self.gap]


@dataclass(frozen=True)
class Hysteresis:
    """Elastoplastic element of ``stiffness`` and ``yield_torque`` beside the gear (Maxwell slip)."""

    place: str
    stiffness: float
    yield_torque: float
    name = "hysteresis"

    def torque(self, run: Run) -> Callable[[State], Torque]:
        j = run.joint(self.place)
        memory: dict[str, np.ndarray] = {}

        def step(x: State) -> Torque:
            delta = x.q[:, j] - x.q_link[:, j]
            if not memory:
                memory["delta"], memory["h"] = delta, np.zeros(run.simulations)
            h = memory["h"] + self.stiffness * (delta - memory["delta"])
            memory["h"] = np.clip(h, -self.yield_torque, self.yield_torque)
            memory["delta"] = delta
            return Torque(j, -memory["h"], memory["h"])

        return step


@dataclass(frozen=True)
class TransmissionError:
    """The gear sees ``q + amplitude sin(periods_per_rev q + phase)``; power is conserved."""

    place: str
    amplitude: float
    periods_per_rev: float
    phase: float = 0.0
    name = "transmission_error"

    def torque(self, run: Run) -> Callable[[State], Torque]:
        j, load = run.joint(self.place), carried(run, self.place)

        def step(x: State) -> Torque:
            angle = self.periods_per_rev * x.q[:, j] + self.phase
            slope = self.amplitude * self.periods_per_rev * np.cos(angle)
            gear = load(x, self.amplitude * np.sin(angle), slope * x.v[:, j])
            h = gear - load(x)
            return Torque(j, -h - slope * gear, h)

        return step


@dataclass(frozen=True)
class JointCoupling:
    """Turning this motor turns the next joint too, by ``ratio``: a term of the next gear."""

    place: str
    ratio: float
    name = "joint_coupling"

    def edit(self, spec: mujoco.MjSpec, robot: Robot, drives: dict) -> None:
        target = robot.joint_names[robot.joint_names.index(self.place) + 1]
        for tendon in springs_of(spec, target):
            tendon.wrap_joint(f"motor:{self.place}", self.ratio)


def springs_of(spec: mujoco.MjSpec, joint: str) -> list[mujoco.MjsTendon]:
    """Tendons that carry torque from the motor of a joint to its link."""
    tendons = [spec.tendon(f"{spring}:{joint}") for spring in GEAR_SPRINGS]
    return [t for t in tendons if t is not None]
