"""What changes while the machine warms up beside its friction."""

from __future__ import annotations

import numpy as np

from ident.hypotheses.drive import SCALE
from ident.hypotheses.hypothesis import Hypothesis, Parameter, Screen, SignalScale
from ident.motion import Motion

CHANGE = Parameter("relative_change", "1", -0.98, 5.0, step=1e-3, center=0.0, spread=0.5, null=0.0)
TIME_CONSTANT = Parameter("time_constant", "s", 1.0, 1e5, log=True, step=1e-2)
PLAIN = 3.0  # time constant over the least one, below which a drift is over before it shows
BEGUN = (0.1, 0.3, 1.0)  # of the recording, time constants from which a drift is begun


def warmth(motion: Motion, time_constant: float) -> np.ndarray:
    """How far a machine has warmed up since the recording began, 0 to 1; (S, T)."""
    return 1.0 - np.exp(-motion.time / time_constant)


def time_constants(scale: SignalScale) -> list[tuple[float, ...]]:
    """Time constants to screen, none of a recording that is one record."""
    return [(share * scale.duration,) for share in BEGUN] if scale.duration > 0 else []


def torque_drift(joint: int, place: str) -> Hypothesis:
    """Decoy: a torque constant that changes with time, as that of a warm magnet does.

    Delivered torque is ``scale (1 + relative_change (1 - exp(-t / time_constant)))`` times the recorded one.
    """

    def asked(p, motion: Motion, j: int, k: float, U: np.ndarray) -> np.ndarray:
        scale, change, tau = p
        more = 1.0 / (scale * (1.0 + change * warmth(motion, tau))) - 1.0
        return U + motion.lines(more * motion.group.to_time(U[..., None])[..., 0])

    def screen(motion: Motion, j: int, k: float, shape) -> Screen:
        u = motion.group.to_time(motion.solution.U[..., j : j + 1])[..., 0]

        def start(c):
            return np.array([1.0 / (1.0 + np.clip(c[0], -0.8, 4.0)), np.clip(c[1], -0.9, 3.0), shape[0]])

        return Screen((u, -warmth(motion, shape[0]) * u), start, shape)

    return Hypothesis(
        "unknown:torque_drift",
        place,
        joint,
        "drive",
        (SCALE, CHANGE, TIME_CONSTANT),
        asked,
        time_constants,
        screen,
        "The torque that the motor of {joint} delivers of the recorded one changes with time.",
        variable="time",
        options={
            "absorbs": "torque_constant",
            "absorb": lambda p, weights, old: np.array([old[0] / (1.0 + np.clip(weights[0], -0.8, 4.0)), *p[1:]]),
            "apart": "time_constant",
            "plain": lambda p: p[2] < PLAIN * TIME_CONSTANT.lower,
            "special": lambda p: np.array([p[0] * (1.0 + p[1])]),
            "essential": ("relative_change",),
        },
    )
