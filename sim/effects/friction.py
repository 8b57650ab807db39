"""Friction of the motor side."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from sim.effects.effect import Run, State, Torque, carried

REVERSAL = 1e-3  # rad/s, velocity over which a regularised sign turns


def smooth_sign(v: np.ndarray) -> np.ndarray:
    return np.tanh(v / REVERSAL)


@dataclass(frozen=True)
class CoulombFriction:
    """``torque (sign v + asymmetry)`` against the motion."""

    place: str
    torque_: float
    asymmetry: float = 0.0
    name = "coulomb_friction"

    def torque(self, run: Run) -> Callable[[State], Torque]:
        j = run.joint(self.place)

        def step(x: State) -> Torque:
            s = smooth_sign(x.v[:, j])
            return Torque(j, -self.torque_ * (s + self.asymmetry * np.abs(s)))

        return step


@dataclass(frozen=True)
class StribeckFriction:
    """``coulomb + (static - coulomb) exp(-(v / v_s)^2)`` against the motion."""

    place: str
    coulomb: float
    static: float
    stribeck_velocity: float
    name = "stribeck_friction"

    def torque(self, run: Run) -> Callable[[State], Torque]:
        j = run.joint(self.place)

        def step(x: State) -> Torque:
            v = x.v[:, j]
            level = self.coulomb + (self.static - self.coulomb) * np.exp(-((v / self.stribeck_velocity) ** 2))
            return Torque(j, -level * smooth_sign(v))

        return step


@dataclass(frozen=True)
class PreslidingFriction:
    """LuGre bristle without Stribeck: ``z' = v - stiffness |v| z / coulomb``."""

    place: str
    stiffness: float
    coulomb: float
    name = "presliding_friction"

    def torque(self, run: Run) -> Callable[[State], Torque]:
        j = run.joint(self.place)
        z = np.zeros(run.simulations)

        def step(x: State) -> Torque:
            v = x.v[:, j]
            path = v * run.step * self.stiffness / self.coulomb
            decay = np.exp(-np.abs(path))
            before = z.copy()
            z[:] = z * decay + (1 - decay) * np.sign(path)
            return Torque(j, -self.coulomb * 0.5 * (before + z))

        return step


@dataclass(frozen=True)
class LoadDependentFriction:
    """``coefficient |transmitted torque|`` against the motion."""

    place: str
    coefficient: float
    name = "load_dependent_friction"

    def torque(self, run: Run) -> Callable[[State], Torque]:
        j, load = run.joint(self.place), carried(run, self.place)

        def step(x: State) -> Torque:
            return Torque(j, -self.coefficient * np.abs(load(x)) * smooth_sign(x.v[:, j]))

        return step


@dataclass(frozen=True)
class FrictionDrift:
    """Viscous and Coulomb friction change by ``relative_change`` with ``time_constant`` (s)."""

    place: str
    relative_change: float
    time_constant: float
    coulomb: float = 0.0
    name = "friction_drift"

    def torque(self, run: Run) -> Callable[[State], Torque]:
        j = run.joint(self.place)
        viscous = run.drives["viscous_friction"][j]

        def step(x: State) -> Torque:
            v = x.v[:, j]
            factor = 1 + self.relative_change * -np.expm1(-(run.start + x.time) / self.time_constant)
            return Torque(j, -self.coulomb * smooth_sign(v) * factor - viscous * v * (factor - 1))

        return step
