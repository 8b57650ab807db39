"""Friction of the motor side."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from sim.effects.effect import Dry, Run, State, Torque, carried


@dataclass(frozen=True)
class CoulombFriction:
    """``torque (sign v + asymmetry)`` against the motion."""

    place: str
    torque_: float
    asymmetry: float = 0.0
    name = "coulomb_friction"

    def dry(self, run: Run) -> Callable[[State], Dry]:
        dry = Dry(run.joint(self.place), self.torque_ * (1 + self.asymmetry), self.torque_ * (1 - self.asymmetry))
        return lambda x: dry


@dataclass(frozen=True)
class StribeckFriction:
    """``coulomb + (static - coulomb) exp(-(v / v_s)^2)`` against the motion."""

    place: str
    coulomb: float
    static: float
    stribeck_velocity: float
    name = "stribeck_friction"

    def dry(self, run: Run) -> Callable[[State], Dry]:
        j = run.joint(self.place)

        def step(x: State) -> Dry:
            level = self.coulomb + (self.static - self.coulomb) * np.exp(-((x.v[:, j] / self.stribeck_velocity) ** 2))
            return Dry(j, level, level)

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

    def dry(self, run: Run) -> Callable[[State], Dry]:
        j, load = run.joint(self.place), carried(run, self.place)

        def step(x: State) -> Dry:
            size = self.coefficient * np.abs(load(x))
            return Dry(j, size, size)

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
        return lambda x: Torque(j, -viscous * x.v[:, j] * (self._factor(run, x) - 1))

    def dry(self, run: Run) -> Callable[[State], Dry]:
        j = run.joint(self.place)

        def step(x: State) -> Dry:
            size = self.coulomb * self._factor(run, x)
            return Dry(j, size, size)

        return step

    def _factor(self, run: Run, x: State) -> np.ndarray:
        """(S,) of the friction at that time."""
        return 1 + self.relative_change * -np.expm1(-(run.start + x.time) / self.time_constant)
