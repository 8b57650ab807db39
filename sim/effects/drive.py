"""Effects between the commanded torque and the motor."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from sim.effects.effect import Run, State, Torque


@dataclass(frozen=True)
class TorqueConstant:
    """The motor delivers ``scale`` times the command."""

    place: str
    scale: float
    name = "torque_constant"

    def deliver(self, run: Run) -> Callable[[np.ndarray, int], np.ndarray]:
        return lambda u, k: self.scale * u


@dataclass(frozen=True)
class TorqueLag:
    """First-order lag of ``time_constant`` (s); each step delivers its mean over the step."""

    place: str
    time_constant: float
    name = "torque_lag"

    def deliver(self, run: Run) -> Callable[[np.ndarray, int], np.ndarray]:
        decay = np.exp(-run.step / self.time_constant)
        share = (1 - decay) * self.time_constant / run.step
        state: list[np.ndarray] = []

        def step(u: np.ndarray, k: int) -> np.ndarray:
            if not state:
                state.append(u.copy())
            mean = u + (state[0] - u) * share
            state[0] = u + (state[0] - u) * decay
            return mean

        return step


@dataclass(frozen=True)
class TorqueDelay:
    """The torque acts ``delay`` (s) late; a step over which it changes delivers its mean."""

    place: str
    delay: float
    name = "torque_delay"

    def deliver(self, run: Run) -> Callable[[np.ndarray, int], np.ndarray]:
        whole = int(np.floor(self.delay / run.step))
        part = self.delay / run.step - whole
        size = whole + 2
        past: list[np.ndarray] = []

        def step(u: np.ndarray, k: int) -> np.ndarray:
            if not past:
                past.extend([u.copy() for _ in range(size)])
            past.append(u.copy())
            del past[0]
            return (1 - part) * past[-1 - whole] + part * past[-2 - whole]

        return step


@dataclass(frozen=True)
class TorqueSaturation:
    """The torque is clipped at ``limit`` (N m)."""

    place: str
    limit: float
    name = "torque_saturation"

    def deliver(self, run: Run) -> Callable[[np.ndarray, int], np.ndarray]:
        return lambda u, k: np.clip(u, -self.limit, self.limit)


@dataclass(frozen=True)
class Cogging:
    """``amplitude sin(periods_per_rev q + phase)`` that drives the motor, q in rad on the link side."""

    place: str
    amplitude: float
    periods_per_rev: float
    phase: float = 0.0
    name = "cogging"

    def torque(self, run: Run) -> Callable[[State], Torque]:
        j = run.joint(self.place)
        return lambda x: Torque(j, self.amplitude * np.sin(self.periods_per_rev * x.q[:, j] + self.phase))
