"""Effects of the chain."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import mujoco
import numpy as np

from robot_assets.robot import Elasticity, Robot
from sim.effects.effect import Dry, Run, State


@dataclass(frozen=True)
class Payload:
    """Unknown point load in the frame of the flange's link."""

    mass: float
    com_x: float = 0.0
    com_y: float = 0.0
    com_z: float = 0.0
    place: str = "flange"
    name = "payload"

    def edit(self, spec: mujoco.MjSpec, robot: Robot, drives: dict) -> None:
        part = spec.body(f"body:{robot.payload_link}").add_body()
        part.explicitinertial = True
        part.mass = self.mass
        part.ipos = [self.com_x, self.com_y, self.com_z]
        part.inertia = [1e-9] * 3


@dataclass(frozen=True)
class LinkInertia:
    """Mass and inertia of a link are multiples of those of its description, its centre of mass is shifted.

    ``com`` in the frame of the link, m; ``inertia`` is the factor on that about the centre of mass.
    """

    place: str
    mass: float = 1.0
    inertia: float = 1.0
    com: tuple[float, float, float] = (0.0, 0.0, 0.0)
    name = "link_inertia"

    def edit(self, spec: mujoco.MjSpec, robot: Robot, drives: dict) -> None:
        body = spec.body(f"body:{self.place}")
        body.mass = float(body.mass) * self.mass
        body.inertia = np.asarray(body.inertia) * self.inertia
        body.ipos = np.asarray(body.ipos) + np.asarray(self.com)


@dataclass(frozen=True)
class TransverseElasticity:
    """A spring-damper hinge across a joint."""

    place: str
    stiffness: float
    damping: float
    axis: tuple[float, float, float]
    name = "transverse_elasticity"

    def hinges(self) -> tuple[Elasticity, ...]:
        return (_hidden(self.place, self.axis, self.stiffness, self.damping),)


@dataclass(frozen=True)
class BaseElasticity:
    """The foundation turns on a spring-damper."""

    stiffness: float
    damping: float
    axis: tuple[float, float, float] = (1.0, 0.0, 0.0)
    place: str = "base"
    name = "base_elasticity"

    def hinges(self) -> tuple[Elasticity, ...]:
        return (_hidden("base", self.axis, self.stiffness, self.damping),)


@dataclass(frozen=True)
class GravitySpring:
    """Balancing spring on the link."""

    place: str
    stiffness: float
    rest_angle: float = 0.0
    name = "gravity_spring"

    def edit(self, spec: mujoco.MjSpec, robot: Robot, drives: dict) -> None:
        add_spring(spec.joint(f"link:{self.place}"), self.stiffness, self.rest_angle)


@dataclass(frozen=True)
class DressPack:
    """Cable bundle on the link: a spring about zero and friction."""

    place: str
    stiffness: float
    friction: float
    name = "dress_pack"

    def edit(self, spec: mujoco.MjSpec, robot: Robot, drives: dict) -> None:
        add_spring(spec.joint(f"link:{self.place}"), self.stiffness, 0.0)

    def dry(self, run: Run) -> Callable[[State], Dry]:
        dry = Dry(run.joint(self.place), self.friction, self.friction, link=True)
        return lambda x: dry


def add_spring(joint: mujoco.MjsJoint, stiffness: float, rest_angle: float) -> None:
    """One more spring on a joint: two in parallel are one that rests between them."""
    there, both = float(joint.stiffness[0]), float(joint.stiffness[0]) + stiffness
    if both > 0.0:
        joint.springref = (there * float(joint.springref) + stiffness * rest_angle) / both
    joint.stiffness = [both, *joint.stiffness[1:]]


def _hidden(place: str, axis: tuple[float, float, float], stiffness: float, damping: float) -> Elasticity:
    """A hinge that the model lacks: there may be several at a place, about different axes."""
    return Elasticity(f"hidden:{place}:{' '.join(f'{x:g}' for x in axis)}", place, axis, stiffness, damping)
