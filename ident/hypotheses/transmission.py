"""Effects of the gear: torque against its deflection, and its kinematic error."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ident.hypotheses import kernels
from ident.hypotheses.hypothesis import EXPONENT, START, Hypothesis, Parameter, Screen
from ident.hypotheses.ripple import SECOND, ripple
from ident.hypotheses.yielding import elastoplastic
from ident.motion import Motion

ROUNDED = 5.0  # exponent of a hysteresis before the data
SOFTEST = 0.05  # share of its stiffness that a soft middle keeps at least: with less it is a dead band
LEAST_SIZE = 1e-8  # rad or N m: of a law that does nothing


def hardening_stiffness(joint: int, place: str) -> Hypothesis:
    """Gear torque ``K delta + cubic delta^3``."""

    def screen(motion: Motion, j: int, k: float, shape) -> Screen:
        return Screen((motion.delta(j) ** 3,), lambda c: np.array([c[0]]) if c[0] > 0 else None)

    return Hypothesis(
        "hardening_stiffness",
        place,
        joint,
        "spring",
        (Parameter("cubic", "N m/rad3", 1e-3, 1e20, log=True, step=1e-2),),
        lambda p, delta, k: kernels.Law(kernels.CUBIC, p[0], 0.0, k),
        lambda scale: [()],
        screen,
        "The gear of {joint} stiffens with its deflection (cubic term {cubic:.3g} N m/rad3): the resonance"
        " climbs with amplitude and with gravity load.",
        variable="delta",
        options={"size": lambda s: np.array([0.3 * s.stiffness / s.delta_rms**2]), "bends": lambda p, f, k: p * f},
    )


def backlash(joint: int, place: str, damping_time: float) -> Hypothesis:
    """Dead band of width ``gap`` in the gear's deflection.

    Within it the gear's damper acts as outside, or is ``loose`` as its spring is: a part of it, as a time constant of
    the spring.

    Args:
        damping_time: nominal damping of the gear over its stiffness, s; what is loose is no more.
    """

    def screen(motion: Motion, j: int, k: float, shape) -> Screen:
        if not shape:
            # A gear that always carries its load one way is through its dead band, however wide: the arm stands
            # elsewhere.
            delta = motion.delta(j)
            carried = -0.5 * k * np.sign(delta).mean(axis=1, keepdims=True)
            return Screen(
                (np.broadcast_to(carried, delta.shape),), lambda c: np.array([c[0], 0.0]) if c[0] > 0.0 else None, shape
            )
        delta = motion.delta(j)
        signal = -k * np.clip(delta, -0.5 * shape[0], 0.5 * shape[0])
        # As long as the gear stays on its flanks the response grows with the gap; beyond, a linear step is not followed
        # far.
        most = max(3.0 * shape[0], 2.0 * np.abs(delta).min())
        return Screen(
            (signal,),
            lambda c: np.array([np.clip(c[0] * shape[0], 0.3 * shape[0], most), 0.0]) if c[0] > 0.1 else None,
            shape,
        )

    return Hypothesis(
        "backlash",
        place,
        joint,
        "spring",
        (
            Parameter("gap", "rad", 1e-9, 0.5, log=True, step=1e-2),
            Parameter(
                "loose", "s", 0.0, damping_time, nuisance=True, step=0.02 * damping_time, spread=damping_time, null=0.0
            ),
        ),
        lambda p, delta, k: kernels.Law(kernels.BACKLASH, p[0], k * p[1], k),
        lambda scale: [(), *((2 * f * scale.delta[2],) for f in (0.03, 0.1, 0.3, 1.0))],
        screen,
        "The gear of {joint} has a dead band of {gap:.3g} rad: its resonance drops at small amplitude wherever"
        " gravity does not preload it.",
        variable="delta",
        options={"size": lambda s: np.array([0.5 * s.delta_rms, 0.0]), "bends": lambda p, f, k: p * np.array([f, 1.0])},
    )


def softening_stiffness(joint: int, place: str) -> Hypothesis:
    """Stiffness ``low_stiffness`` within ``transition`` of zero deflection, K beyond."""

    def resized(p: np.ndarray, factor: float, k: float) -> np.ndarray:
        # What the gear carries less beyond the transition is known best.
        low = max(k - (k - p[0]) / factor, 2.0 * SOFTEST * k)
        return np.array([low, p[1] * (k - p[0]) / (k - low)])

    def screen(motion: Motion, j: int, k: float, shape) -> Screen:
        signal = -np.clip(motion.delta(j), -shape[0], shape[0])

        def start(c):
            return np.array([max(k - c[0], SOFTEST * k), shape[0]]) if c[0] > 0 else None

        return Screen((signal,), start, shape)

    return Hypothesis(
        "softening_stiffness",
        place,
        joint,
        "spring",
        (
            Parameter(
                "low_stiffness", "N m/rad", 1e-3, 1e12, True, step=1e-2, center=0.3, spread=0.8, per_stiffness=True
            ),
            Parameter("transition", "rad", 0.1 * LEAST_SIZE, 1.0, log=True, step=1e-2),
        ),
        lambda p, delta, k: kernels.Law(kernels.SOFTENING, float(np.clip(p[0], SOFTEST * k, k)), p[1], k),
        lambda scale: [(f * scale.delta[2],) for f in (0.1, 0.3, 0.7, 1.5)],
        screen,
        "The gear of {joint} is soft about zero torque ({low_stiffness:.3g} N m/rad within"
        " {transition:.3g} rad): its resonance falls where it carries little.",
        variable="delta",
        options={
            "size": lambda s: np.array([0.5 * s.stiffness, 0.5 * s.delta_rms]),
            # a dead band, or the spring of the gear itself
            "trivial": lambda p, k: p[0] <= 1.02 * SOFTEST * k or p[0] >= k or p[1] <= LEAST_SIZE,
            "middle": lambda p: (p[1], p[0]),  # rad to either side, and the slope there
            "bends": resized,
        },
    )


def hysteresis(joint: int, place: str) -> Hypothesis:
    """Element that yields beside the gear's spring: from a Bouc-Wen one to a Maxwell slip (see ``yielding``)."""

    def screen(motion: Motion, j: int, k: float, shape) -> Screen:
        unit = elastoplastic(motion.delta(j), 1.0, shape[0], begins=motion.group.window is not None)
        return Screen(
            (unit,), lambda c: np.array([c[0], c[0] * shape[0], ROUNDED, 0.0, 0.0]) if c[0] > 0 else None, shape
        )

    return Hypothesis(
        "hysteresis",
        place,
        joint,
        "spring",
        (
            Parameter("stiffness", "N m/rad", 1e-3, 1e12, True, step=1e-2, center=0.3, spread=1.5, per_stiffness=True),
            Parameter("yield_torque", "N m", 0.1 * LEAST_SIZE, 1e7, log=True, step=1e-2),
            replace(EXPONENT, center=ROUNDED),
            Parameter(
                "recoil", "1", 0.0, 1.5, nuisance=True, step=0.05, center=0.0, spread=0.5, null=0.0, reported=True
            ),
            START,
        ),
        lambda p, delta, k: kernels.Law(kernels.HYSTERESIS, p[0], p[1], k, *p[2:]),
        lambda scale: [(f * scale.delta[1],) for f in (0.03, 0.1, 0.3, 1.0)],
        screen,
        "The torque of {joint} makes loops against the gear's deflection: an element of {stiffness:.3g} N m/rad"
        " that yields at {yield_torque:.3g} N m.",
        variable="delta",
        options={
            "size": lambda s: np.array([0.4 * s.stiffness, 0.2 * s.stiffness * s.delta_rms, ROUNDED, 0.0, 0.0]),
            "shown": "yield_torque",
            "trivial": lambda p, k: p[1] <= LEAST_SIZE,
        },
    )


def transmission_error(joint: int, place: str) -> Hypothesis:
    """Gear sees ``q + amplitude sin(periods_per_rev q + phase)`` of the motor, with a second harmonic.

    A gear without losses passes the torque that it carries back to the motor with the slope of the
    error, ``tau_s d(error)/dq`` (virtual work); ``reaction`` is 1 then, and fitted because a gear
    need not be without losses.
    """

    def parts(p: np.ndarray, motion: Motion, j: int) -> tuple[np.ndarray, np.ndarray]:
        sine, n, cosine, reaction, *second = p
        error, slope = ripple(sine, cosine, second, n * motion.q(j))
        return error, reaction * n * slope * motion.tau_s(j)

    def screen(motion: Motion, j: int, k: float, shape) -> Screen:
        n, reaction = shape
        damping = motion.par.damping[j] / motion.par.stiffness[j]
        spring = k * (1 + 1j * motion.group.omega * damping)
        angle = n * motion.q(j)
        sine, cosine, carried = np.sin(angle), np.cos(angle), reaction * n * motion.tau_s(j)
        return Screen(
            (spring * motion.lines(sine), spring * motion.lines(cosine)),
            lambda c: np.array([c[0], n, c[1], reaction, 0.0, 0.0]),
            shape,
            (cosine * carried, -sine * carried),
        )

    return Hypothesis(
        "transmission_error",
        place,
        joint,
        "spring",
        (
            Parameter("sine", "rad", -0.1, 0.1, step=1e-7),
            Parameter("periods_per_rev", "1", 0.3, 1e5, step=1e-3),
            Parameter("cosine", "rad", -0.1, 0.1, step=1e-7),
            Parameter("reaction", "1", -0.5, 1.5, nuisance=True, step=1e-2, null=1.0),
            *SECOND,
        ),
        lambda p, motion, j, k: parts(p, motion, j),
        lambda scale: [(n, 1.0) for n in scale.wave_numbers],
        screen,
        "The gear of {joint} has a kinematic error of {amplitude:.3g} rad, {wave}: a ripple that grows near resonance.",
        variable="q",
        options={"kinematic": True},
    )
