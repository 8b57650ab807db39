"""Effects of the position channel: what the encoder shows."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from sim.effects.effect import Run


@dataclass(frozen=True)
class EncoderEccentricity:
    """Position error ``amplitude sin(q + phase)``, once a turn."""

    place: str
    amplitude: float
    phase: float = 0.0
    name = "encoder_eccentricity"

    def measure(self, run: Run) -> Callable[[np.ndarray, bool], np.ndarray]:
        return lambda q, sampled: q + self.amplitude * np.sin(q + self.phase)


@dataclass(frozen=True)
class EncoderQuantization:
    """Position in steps of ``resolution`` (rad)."""

    place: str
    resolution: float
    name = "encoder_quantization"
    after_noise = True

    def measure(self, run: Run) -> Callable[[np.ndarray, bool], np.ndarray]:
        return lambda q, sampled: np.round(q / self.resolution) * self.resolution


@dataclass(frozen=True)
class SensorDelay:
    """A position channel comes ``delay`` (s) late: "q" (motor encoder) or "q_link"."""

    place: str
    delay: float
    channel: str = "q"
    name = "sensor_delay"

    def measure(self, run: Run) -> Callable[[np.ndarray, bool], np.ndarray]:
        steps = self.delay / run.step
        whole, part = int(np.floor(steps)), steps - np.floor(steps)
        past: list[np.ndarray] = []

        def step(q: np.ndarray, sampled: bool) -> np.ndarray:
            if not past:
                past.extend([q.copy() for _ in range(whole + 2)])
            past.append(q.copy())
            del past[0]
            return (1 - part) * past[-1 - whole] + part * past[-2 - whole]

        return step


@dataclass(frozen=True)
class SensorLag:
    """A first-order filter of ``time_constant`` (s) in the position signal."""

    place: str
    time_constant: float
    name = "sensor_lag"

    def measure(self, run: Run) -> Callable[[np.ndarray, bool], np.ndarray]:
        ratio = run.step / self.time_constant
        decay = np.exp(-ratio)
        memory: list[np.ndarray] = []

        def step(q: np.ndarray, sampled: bool) -> np.ndarray:
            if not memory:
                memory.extend([q.copy(), q.copy()])
            y, last = memory
            # Exact for a position that is linear over the step.
            slope = (q - last) / ratio
            memory[0] = q - slope + (y - last + slope) * decay
            memory[1] = q.copy()
            return memory[0]

        return step
