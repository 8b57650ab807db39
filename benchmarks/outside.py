"""Effects that the catalogue lacks, hidden in the plant to see that they get no name of it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import mujoco
import numpy as np

from robot_assets.robot import Robot
from sim.effects.effect import Dry, Run, State, Torque


@dataclass(frozen=True)
class QuadraticDrag:
    """Torque ``coefficient v |v|`` against the motor."""

    place: str
    coefficient: float
    name = "outside:quadratic_drag"

    def torque(self, run: Run) -> Callable[[State], Torque]:
        j = run.joint(self.place)
        return lambda x: Torque(j, -self.coefficient * x.v[:, j] * np.abs(x.v[:, j]))


@dataclass(frozen=True)
class PostureFriction:
    """Friction of the motor that grows with the distance from a posture: ``slope |q - centre| sign(v)``."""

    place: str
    slope: float
    centre: float
    name = "outside:posture_friction"

    def dry(self, run: Run) -> Callable[[State], Dry]:
        j = run.joint(self.place)

        def step(x: State) -> Dry:
            size = self.slope * np.abs(x.q[:, j] - self.centre)
            return Dry(j, size, size)

        return step


@dataclass(frozen=True)
class NeighbourDrag:
    """Viscous torque on a motor from the velocity of the next one: a shared oil bath."""

    place: str
    coefficient: float
    name = "outside:neighbour_drag"

    def torque(self, run: Run) -> Callable[[State], Torque]:
        j = run.joint(self.place)
        other = (j + 1) % len(run.robot.joint_names)
        return lambda x: Torque(j, -self.coefficient * x.v[:, other])


@dataclass(frozen=True)
class DriveDeadZone:
    """The drive delivers nothing within ``limit`` (N m) of zero, and that much less beyond."""

    place: str
    limit: float
    name = "outside:drive_dead_zone"

    def deliver(self, run: Run) -> Callable[[np.ndarray, int], np.ndarray]:
        return lambda u, k: u - np.clip(u, -self.limit, self.limit)


@dataclass(frozen=True)
class RateFriction:
    """Torque against the motor by the cube root of its velocity."""

    place: str
    coefficient: float
    name = "outside:cube_root_friction"

    def torque(self, run: Run) -> Callable[[State], Torque]:
        j = run.joint(self.place)
        return lambda x: Torque(j, -self.coefficient * np.cbrt(x.v[:, j]) * np.minimum(np.abs(x.v[:, j]) / 1e-3, 1.0))


@dataclass(frozen=True)
class LinkFriction:
    """Viscous friction of the link, behind the gear."""

    place: str
    coefficient: float
    name = "outside:link_friction"

    def edit(self, spec: mujoco.MjSpec, robot: Robot, drives: dict) -> None:
        spec.joint(f"link:{self.place}").damping = [self.coefficient, 0, 0]


KINDS = ("drag", "posture", "neighbour", "dead zone", "cube root", "link friction")


def draw_outside(rng: np.random.Generator, robot: Robot, strength: float) -> object:
    """One of them at a random joint, of a size that an experiment shows."""
    j = int(rng.integers(robot.n))
    joint = robot.joints[j]
    torque = 0.02 * joint.torque_limit * strength
    kind = KINDS[int(rng.integers(len(KINDS)))]
    if kind == "drag":
        return QuadraticDrag(joint.name, torque / (0.1 * joint.velocity_limit) ** 2)
    if kind == "posture":
        return PostureFriction(joint.name, torque, float(rng.uniform(-1.0, 1.0)))
    if kind == "neighbour":
        return NeighbourDrag(joint.name, torque / (0.05 * joint.velocity_limit))
    if kind == "dead zone":
        return DriveDeadZone(joint.name, torque)
    if kind == "link friction":
        return LinkFriction(joint.name, torque / (0.05 * joint.velocity_limit))
    return RateFriction(joint.name, torque / np.cbrt(0.05 * joint.velocity_limit))
