"""Effects of the drive: between the torque that is recorded and the one that the motor delivers."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ident.hypotheses.filters import form
from ident.hypotheses.hypothesis import Hypothesis, Parameter, Screen, SignalScale
from ident.hypotheses.ripple import SECOND, ripple
from ident.inverse import recorded_share
from ident.motion import Motion, Recorded

KNEE = Parameter("knee", "1", 2e-3, 0.2, log=True, nuisance=True, step=0.02, center=0.03, spread=1.5, reported=True)
SCALE = Parameter("scale", "1", 0.2, 5.0, log=True, null=1.0)  # delivered torque over the recorded one
LEAST_ERROR = 1e-3  # of a scale, below which no constant of a motor is called wrong: laws of other causes lack as much
CROSSTALK = 0.05  # of the torque of another motor, that is expected
MOST_RIPPLE = 0.5  # of the torque of a motor, that ripples with it
LEAST_LIMIT = 0.3  # of the peak torque of a record: below, no loop would hold the arm


def scale_of(weight: float) -> float:
    """Delivered torque over the recorded one, where a linear step asks for ``weight`` of the torque more."""
    return 1.0 / (1.0 + np.clip(weight, -0.8, 4.0))


def over_gain(U: np.ndarray, gain: np.ndarray, motion: Recorded) -> np.ndarray:
    """Recorded torque (..., L) of which a motor delivers ``U`` (..., L), by a gain (S, T) that changes along the
    record."""
    return U + motion.lines((1.0 / gain - 1.0) * in_time(U, motion))


def in_time(U: np.ndarray, motion: Recorded) -> np.ndarray:
    """A spectrum (..., L) of one joint on the grid of time, (..., T)."""
    return motion.group.to_time(U[..., None])[..., 0]


def torque_constant(joint: int, place: str) -> Hypothesis:
    """Delivered torque is ``scale`` times the recorded one."""

    def screen(motion: Motion, j: int, k: float, shape) -> Screen:
        return Screen((motion.solution.U[..., j],), lambda c: np.array([scale_of(c[0])]))

    return Hypothesis(
        "torque_constant",
        place,
        joint,
        "drive",
        (SCALE,),
        lambda p, motion, j, k, U: U / p[0],
        lambda scale: [()],
        screen,
        "The motor of {joint} delivers {scale:.4g} times the torque that is recorded, at every frequency and"
        " in every posture.",
        variable="torque",
        options={
            "filter": lambda p, s: np.full(len(s), 1.0 / p[0]),
            "trivial": lambda p, k: abs(p[0] - 1.0) < LEAST_ERROR,
        },
    )


def torque_lag(joint: int, place: str, stepped: bool = True, second: bool = False) -> Hypothesis:
    """Current loop as a lag: ``delivered = recorded / (1 + s time_constant)``, or of second order.

    Args:
        stepped, second: as of ``filters.form``.
    """
    own, late, options = form("torque_delay", stepped, second)

    def screen(motion: Motion, j: int, k: float, shape) -> Screen:
        return Screen(
            (1j * motion.group.omega * motion.solution.U[..., j],),
            lambda c: np.array([c[0], *(0.0 for _ in own)]) if c[0] > 0 else None,
        )

    return Hypothesis(
        "torque_lag",
        place,
        joint,
        "drive",
        (Parameter("time_constant", "s", 1e-7, 1.0, log=True), *own),
        lambda p, motion, j, k, U: U * late(p, 1j * motion.group.omega),
        lambda scale: [()],
        screen,
        "The torque of {joint} follows its record as a lag of {time_constant:.3g} s: phase is lost and gain falls with"
        " frequency.",
        variable="torque",
        options=options,
    )


def torque_delay(joint: int, place: str) -> Hypothesis:
    """The torque comes ``delay`` after its record."""

    def late(p, s: np.ndarray) -> np.ndarray:
        return np.exp(s * p[0])

    def screen(motion: Motion, j: int, k: float, shape) -> Screen:
        return Screen(
            (1j * motion.group.omega * motion.solution.U[..., j],),
            lambda c: np.array([c[0]]) if c[0] > 0 else None,
        )

    return Hypothesis(
        "torque_delay",
        place,
        joint,
        "drive",
        (Parameter("delay", "s", 1e-7, 1.0, log=True),),
        lambda p, motion, j, k, U: U * late(p, 1j * motion.group.omega),
        lambda scale: [()],
        screen,
        "The torque of {joint} acts {delay:.3g} s after its record: phase linear in frequency, gain untouched.",
        variable="torque",
        options={"filter": late},
    )


def record_roll_off(joint: int, place: str) -> Hypothesis:
    """Decoy: the record of the torque loses gain towards high frequencies and no phase, as one that averages samples;
    or it gains some, as one that holds what the motor does not.

    Beside an offset of its clock that nobody knows, a short lag of the drive looks as the latter does.
    """

    def loss(p, s: np.ndarray) -> np.ndarray:
        return recorded_share(s.imag, 0.0, p[0])

    return Hypothesis(
        "unknown:record_roll_off",
        place,
        joint,
        "drive",
        (Parameter("roll_off", "s2", -1e-2, 1e-2, step=1e-10),),
        lambda p, motion, j, k, U: U * loss(p, 1j * motion.group.omega),
        lambda scale: [()],
        lambda motion, j, k, shape: Screen((-(motion.group.omega**2) * motion.solution.U[..., j],), np.array),
        "The record of the torque of {joint} changes its gain by {roll_off:.3g} s2 times the square of the frequency, as a"
        " recorder that averages or holds samples does; a short lag of the drive cannot be told from that here.",
        variable="torque",
        options={"filter": loss, "baseline": "record_roll_off", "of_record": True},
    )


def torque_saturation(joint: int, place: str, wound_up: bool = False) -> Hypothesis:
    """Delivered torque is clipped at ``limit``, which takes no more than the peaks.

    An amplifier that limits by a controller of its own bends before it does: ``u (1 + |u / limit|^(1 / knee))^-knee``, which
    clips sharply where the knee is small, and takes 2 % at two thirds of the limit where it is largest. A limit near
    zero would deliver nothing, and so explain any motor that hardly moves.

    Args:
        wound_up: whether the loop asks for many times what it gets in single motions: for a fifth of all that was
            recorded, and for half of a motion, at most.
    """

    def excess(limit: float, knee: float, motion: Recorded, j: int) -> np.ndarray:
        u = motion.torque(j)
        limit = max(limit, motion.usual_torque(j) if wound_up else LEAST_LIMIT * motion.peak_torque(j))
        over = np.log(np.maximum(np.abs(u), 1e-12 * limit) / limit) / knee
        return u * (1.0 - np.exp(-knee * np.logaddexp(0.0, over)))

    def shapes(scale: SignalScale) -> list[tuple[float, ...]]:
        if not wound_up:
            # Torque that is fast against the compared band meets a limit that its slow part stays below.
            return [(f * scale.peak_torque, KNEE.center) for f in (0.5, 0.65, 0.8, 0.9, 0.96, 1.0, 1.03)]
        low = scale.exceeded_torque
        return [(f * low, KNEE.center) for f in (1.0, 1.4)] if 1.4 * low < LEAST_LIMIT * scale.peak_torque else []

    return Hypothesis(
        "torque_saturation",
        place,
        joint,
        "drive",
        (Parameter("limit", "N m", 1e-6, 1e8, log=True, step=1e-3), KNEE),
        lambda p, motion, j, k, U: U + motion.lines(excess(p[0], p[1], motion, j)),
        shapes,
        lambda motion, j, k, shape: Screen(
            (excess(shape[0], shape[1], motion, j),), lambda c: np.array(shape) if c[0] > 0.2 else None, shape
        ),
        "The motor of {joint} delivers no more than {limit:.4g} N m: the residual torque sits at the peaks.",
        variable="torque",
        options={"shown": "limit"},
    )


def torque_curve(joint: int, place: str) -> Hypothesis:
    """Decoy: a motor whose iron saturates, ``reach tanh(u / reach)`` of a recorded torque ``u`` that stays below the
    reach.

    It falls short at every torque, where one that is clipped does at its peaks alone.
    """

    def excess(p, motion: Recorded, j: int) -> np.ndarray:
        u, reach = motion.torque(j), max(p[0], motion.peak_torque(j))
        return u - reach * np.tanh(u / reach)

    def screen(motion: Motion, j: int, k: float, shape) -> Screen:
        u, peak = motion.torque(j), motion.peak_torque(j)
        # what ``tanh`` lacks to third order, of a reach as large as the peak
        return Screen(
            (u**3 / (3.0 * peak**2),), lambda c: np.array([peak / np.sqrt(min(c[0], 1.0))]) if c[0] > 0 else None
        )

    return Hypothesis(
        "unknown:torque_curve",
        place,
        joint,
        "drive",
        (Parameter("reach", "N m", 1e-6, 1e9, log=True, step=1e-3),),
        lambda p, motion, j, k, U: U + motion.lines(excess(p, motion, j)),
        lambda scale: [()],
        screen,
        "The motor of {joint} delivers less of a torque the larger that is, at torques of any size.",
        variable="torque",
    )


def crosstalk(joint: int, place: str, other: int, beside: str) -> Hypothesis:
    """Decoy: the record of the torque of motor ``joint`` lacks ``share`` of that of motor ``other``, at ``beside``, which
    acts there too; or shows as much with the other sign, as currents that are measured side by side do.

    A coupling of the gears turns a joint as well.
    """

    def asked(motion: Recorded) -> np.ndarray:
        return motion.group.torque_share[..., other] * motion.group.U[..., other]

    return Hypothesis(
        "unknown:crosstalk",
        place,
        joint,
        "drive",
        (Parameter("share", "1", -1.0, 1.0, spread=CROSSTALK),),
        lambda p, motion, j, k, U: U - p[0] * asked(motion),
        lambda scale: [()],
        lambda motion, j, k, shape: Screen((-asked(motion),), np.array),
        "{share:.4g} times the torque of {turned} acts at {joint} too, or shows in the record there with the other sign.",
        variable="torque",
        options={"joints": (place, beside)},
    )


def cogging(joint: int, place: str, wave_number: float | None = None) -> Hypothesis:
    """``amplitude sin(periods_per_rev q + phase)`` that drives the motor, as MuJoCo's own element does, with a second
    harmonic."""

    def law(p, motion: Motion, j: int, k: float) -> np.ndarray:
        sine, n, cosine, *second = p
        return -ripple(sine, cosine, second, n * motion.q(j))[0]

    def screen(motion: Motion, j: int, k: float, shape) -> Screen:
        q = motion.q(j)
        return Screen(
            (-np.sin(shape[0] * q), -np.cos(shape[0] * q)), lambda c: np.array([c[0], shape[0], c[1], 0.0, 0.0]), shape
        )

    return Hypothesis(
        "cogging",
        place,
        joint,
        "motor",
        (
            Parameter("sine", "N m", -1e7, 1e7),
            Parameter("periods_per_rev", "1", 0.3, 1e5, step=1e-3),
            Parameter("cosine", "N m", -1e7, 1e7),
            *SECOND,
        ),
        law,
        lambda scale: [(n,) for n in scale.wave_numbers],
        screen,
        "The residual torque of {joint} is periodic in its motor angle: {amplitude:.3g} N m, {wave}.",
        variable="q",
    )


def torque_ripple(joint: int, place: str) -> Hypothesis:
    """Decoy: a ripple that grows with the torque, ``1 + fraction sin(periods_per_rev q + phase)`` times the recorded
    one.

    So do the flux of a motor and currents that are measured with an error of their scale.
    """

    def asked(p, motion: Motion, j: int, k: float, U: np.ndarray) -> np.ndarray:
        sine, n, cosine = p
        if not np.any(U):  # asked before the motion is known, of which nothing ripples
            return U
        q = n * motion.q(j)
        return over_gain(U, 1.0 + sine * np.sin(q) + cosine * np.cos(q), motion)

    def screen(motion: Motion, j: int, k: float, shape) -> Screen:
        q, u = shape[0] * motion.q(j), in_time(motion.solution.U[..., j], motion)
        return Screen((-np.sin(q) * u, -np.cos(q) * u), lambda c: np.array([c[0], shape[0], c[1]]), shape)

    part = Parameter("sine", "1", -MOST_RIPPLE, MOST_RIPPLE, spread=0.05)
    return Hypothesis(
        "unknown:torque_ripple",
        place,
        joint,
        "drive",
        (part, Parameter("periods_per_rev", "1", 0.3, 1e5, step=1e-3), replace(part, name="cosine")),
        asked,
        lambda scale: [(n,) for n in scale.wave_numbers],
        screen,
        "The torque that the motor of {joint} delivers of the recorded one is periodic in its motor angle.",
        variable="q",
    )


def time_ripple(joint: int, place: str, frequency: float) -> Hypothesis:
    """Decoy: a torque periodic in time at a frequency of its own, whatever the arm does."""

    def unit(motion: Motion) -> tuple[np.ndarray, np.ndarray]:
        x = 2 * np.pi * frequency * motion.time
        return np.sin(x), np.cos(x)

    def law(p, motion: Motion, j: int, k: float) -> np.ndarray:
        sine, cosine = unit(motion)
        return p[0] * sine + p[1] * cosine

    return Hypothesis(
        "unknown:time_ripple",
        place,
        joint,
        "motor",
        (Parameter("sine", "N m", -1e7, 1e7), Parameter("cosine", "N m", -1e7, 1e7)),
        law,
        lambda scale: [()],
        lambda motion, j, k, shape: Screen(unit(motion), lambda c: np.array(c)),
        "The residual torque of {joint} is periodic in time.",
        variable="time",
    )
