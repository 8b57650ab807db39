"""Effects of the position channel."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ident.hypotheses.drive import SCALE, scale_of
from ident.hypotheses.filters import form
from ident.hypotheses.hypothesis import Hypothesis, Parameter, Screen
from ident.hypotheses.ripple import SECOND, ripple
from ident.motion import Motion

TRUE_STEPS = 4  # from a measured position to the one at which its error is that of the encoder


def sensor_delay(joint: int, place: str) -> Hypothesis:
    """Measured position comes ``delay`` late: the true one is ``exp(s delay)`` times it."""

    def law(p, motion: Motion, j: int, k: float) -> np.ndarray:
        return np.expm1(1j * motion.group.omega * p[0]) * motion.solution.Q[..., j]

    return Hypothesis(
        "sensor_delay",
        place,
        joint,
        "position",
        (Parameter("delay", "s", 1e-7, 1.0, log=True),),
        law,
        lambda scale: [()],
        lambda motion, j, k, shape: Screen(
            (1j * motion.group.omega * motion.solution.Q[..., j],),
            lambda c: np.array([c[0]]) if c[0] > 0 else None,
        ),
        "The position of {joint} comes {delay:.3g} s late: the phase of one row, linear in frequency, also where"
        " other joints drive it.",
        variable="v",
        options={"filter": lambda p, s: np.exp(s * p[0])},
    )


def sensor_lag(joint: int, place: str, stepped: bool = True, second: bool = False) -> Hypothesis:
    """Measured position is filtered: the true one is ``(1 + s time_constant)`` times it, or that of second order.

    Args:
        stepped, second: as of ``filters.form``.
    """
    own, late, options = form("sensor_delay", stepped, second)

    def law(p, motion: Motion, j: int, k: float) -> np.ndarray:
        return (late(p, 1j * motion.group.omega) - 1.0) * motion.solution.Q[..., j]

    return Hypothesis(
        "sensor_lag",
        place,
        joint,
        "position",
        (Parameter("time_constant", "s", 1e-7, 1.0, log=True), *own),
        law,
        lambda scale: [()],
        lambda motion, j, k, shape: Screen(
            (1j * motion.group.omega * motion.solution.Q[..., j],),
            lambda c: np.array([c[0], *(0.0 for _ in own)]) if c[0] > 0 else None,
        ),
        "The position of {joint} passes a filter of {time_constant:.3g} s: phase and gain of one row of the FRF"
        " fall with frequency.",
        variable="v",
        options=options,
    )


def encoder_eccentricity(joint: int, place: str, turns: float = 1.0, oval: bool = False) -> Hypothesis:
    """Measured position holds ``amplitude sin(turns q + phase)`` of the true one ``q``, which is that much less.

    Args:
        turns: of the encoder in a turn of the joint: the gear ratio where it sits at the motor.
        oval: whether its error has a second harmonic, as of a disc that is no circle. Fitted where the first leaves
            more than noise.
    """

    def wave(p) -> tuple[float, float]:
        """Amplitude and phase: a sine a sample is half the work of two."""
        return float(np.hypot(p[0], p[1])), float(np.arctan2(p[1], p[0]))

    def error_at(p, angle: np.ndarray) -> np.ndarray:
        if oval:
            return ripple(p[0], p[1], p[2:], angle)[0]
        amplitude, phase = wave(p)
        return amplitude * np.sin(angle + phase)

    def law(p, motion: Motion, j: int, k: float) -> np.ndarray:
        angle = turns * motion.q(j)
        error = error_at(p, angle)
        for _ in range(TRUE_STEPS - 1):
            error = error_at(p, angle - turns * error)
        return -motion.lines(error)

    def slope(p, q: np.ndarray) -> np.ndarray:
        return 1.0 / (1.0 + turns * ripple(p[0], p[1], p[2:], turns * q)[1])

    def screen(motion: Motion, j: int, k: float, shape) -> Screen:
        q, unseen = turns * motion.q(j), turns * motion.unseen(j)
        sine, cosine = np.sin(q), np.cos(q)
        return Screen(
            (-motion.lines(sine) - np.mean(cosine) * unseen, -motion.lines(cosine) + np.mean(sine) * unseen),
            lambda c: np.array(c),
        )

    wide = {
        "holds": "encoder_eccentricity",
        "widens": lambda p, scale: [np.array([*p[:2], 0.0, 0.0])],
        "narrow": lambda p: p[:2],
    }
    return Hypothesis(
        "encoder_eccentricity",
        place,
        joint,
        "position",
        (
            Parameter("sine", "rad", -0.2, 0.2, step=1e-6),
            Parameter("cosine", "rad", -0.2, 0.2, step=1e-6),
            *(SECOND if oval else ()),
        ),
        law,
        lambda scale: [()],
        None if oval else screen,
        "The encoder of {joint} errs by {amplitude:.3g} rad once a turn of "
        + ("its motor." if turns != 1.0 else "the joint."),
        variable="q",
        options={"slope": slope, "turns": turns} | (wide if oval else {}),
    )


def position_scale(joint: int, place: str) -> Hypothesis:
    """Decoy: measured position is ``scale`` times the true one, as with a wrong number of counts or teeth. An encoder
    that is out of centre does nearly that where it turns little."""

    def law(p, motion: Motion, j: int, k: float) -> np.ndarray:
        return (1.0 / p[0] - 1.0) * motion.solution.Q[..., j]

    return Hypothesis(
        "unknown:position_scale",
        place,
        joint,
        "position",
        (SCALE,),
        law,
        lambda scale: [()],
        lambda motion, j, k, shape: Screen((-motion.solution.Q[..., j],), lambda c: np.array([scale_of(-c[0])])),
        "The position of {joint} is recorded {scale:.4g} times as large as it is.",
        variable="q",
        options={"filter": lambda p, s: np.full(len(s), 1.0 / p[0])},
    )


def torque_offset(joint: int, place: str) -> Hypothesis:
    """A constant error of the recorded torque: no effect of the catalogue, but of every torque sensor."""
    return Hypothesis(
        "torque_offset",
        place,
        joint,
        "motor",
        (Parameter("offset", "N m", -1e7, 1e7),),
        lambda p, motion, j, k: p[0] * np.ones_like(motion.q(j)),
        lambda scale: [()],
        lambda motion, j, k, shape: Screen((np.ones_like(motion.q(j)),), lambda c: np.array([c[0]]), ()),
        "The recorded torque of {joint} is off by {offset:.3g} N m.",
        options={"baseline": "torque_offset"},
    )


def constant_torque(joint: int, place: str) -> Hypothesis:
    """Decoy: such an error where it is no part of the baseline; a spring with a far rest would take it."""
    return replace(torque_offset(joint, place), effect="unknown:constant_torque", options={})
