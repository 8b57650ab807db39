"""How a machine changes while it warms up, and a decoy that does so beside its friction."""

from __future__ import annotations

import numpy as np

from ident.hypotheses.drive import SCALE, in_time, over_gain, scale_of
from ident.hypotheses.hypothesis import Hypothesis, Parameter, Screen, SignalScale
from ident.motion import Motion, Recorded

CHANGE = Parameter("relative_change", "1", -0.98, 5.0, step=1e-3, center=0.0, spread=0.5, null=0.0)
TIME_CONSTANT = Parameter("time_constant", "s", 1.0, 1e5, log=True, step=1e-2)
PLAIN = 3.0  # time constant over the least one, below which a drift is over before it shows
BEGUN = (0.1, 0.3, 1.0)  # of the recording, time constants from which a drift is begun


def warmth(motion: Recorded, time_constant: float) -> np.ndarray:
    """How far a machine has warmed up since the recording began, 0 to 1; (S, T)."""
    return 1.0 - np.exp(-motion.time / time_constant)


def time_constants(scale: SignalScale) -> list[tuple[float, ...]]:
    """Time constants to screen, none of a recording that is one record."""
    return [(share * scale.duration,) for share in BEGUN] if scale.duration > 0 else []


def first_change(change: float) -> float:
    """A relative change as a linear step asks for it, within what a fit may begin from."""
    return float(np.clip(change, -0.9, 3.0))


def torque_drift(joint: int, place: str) -> Hypothesis:
    """Decoy: a torque constant that changes with time, as that of a warm magnet does.

    Delivered torque is ``scale (1 + relative_change (1 - exp(-t / time_constant)))`` times the recorded one.
    """

    def asked(p, motion: Recorded, j: int, k: float, U: np.ndarray) -> np.ndarray:
        scale, change, tau = p
        return over_gain(U, scale * (1.0 + change * warmth(motion, tau)), motion)

    def screen(motion: Motion, j: int, k: float, shape) -> Screen:
        u = in_time(motion.solution.U[..., j], motion)

        def start(c):
            return np.array([scale_of(c[0]), first_change(c[1]), shape[0]])

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
            "absorb": lambda p, weights, old: np.array([old[0] * scale_of(weights[0]), *p[1:]]),
            "apart": "time_constant",
            "plain": lambda p: p[2] < PLAIN * TIME_CONSTANT.lower,
            "special": lambda p: np.array([p[0] * (1.0 + p[1])]),
            "essential": ("relative_change",),
        },
    )
