"""Friction of the motor side: torque against motor motion."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from ident.group import Group
from ident.hypotheses.drifts import CHANGE, TIME_CONSTANT, first_change, time_constants, warmth
from ident.hypotheses.hypothesis import EXPONENT, Hypothesis, Parameter, Screen, SignalScale, sought
from ident.hypotheses.kernels import smooth_sign
from ident.hypotheses.yielding import DAHL, bristle, dipping_bristle
from ident.motion import Motion

LEAST_MOTION = 1e-9  # rad, of a joint that stands still
ASYMMETRY_SPREAD = 0.4  # before the data: most joints rub alike both ways
REST_QUANTILE = 0.95  # of what a friction balances at rest, that says its size
# velocity within which a friction turns over the noise of that which is seen, from which no rest is needed to know it
RESOLVED = 2.0
AT_ONCE, SEEN_TO_TURN = 0.1, 2.0  # the same over that velocity, of frictions begun on either side of it
SEEN = 3.0  # size of a friction over the noise of what is asked of it, below which rest tells nothing of it
LEAST_TORQUE = 1e-12  # N m
SHARP = 1e-3  # rad/s, within which a friction turns whose turn the data do not show
SHARP_SHARE = 2e-3  # the same, over the rms velocity
LEAST_DIP = 1.15  # static friction over Coulomb's, below which it is as good as that
NO_FRICTION = 1e-7  # N m, of a friction that is there because its logarithm must be something
WARMS = (
    "The friction of {joint} changes by {relative_change:.0%} over the recording, with a time constant of"
    " {time_constant:.0f} s"
)
DRY_PART = "; {coulomb:.3g} N m of it is Coulomb friction, at the start."
LEAST_CHANGE = 0.02  # of a friction that drifts, below which it may as well be the error of one that does not
MOST_DIP = 10.0  # the same, beyond which nothing rubs in motion: no friction of a bearing
# of the velocity in the fall of a Stribeck friction
DIP = Parameter("exponent", "1", 0.5, 2.0, log=True, nuisance=True, step=1e-2, center=2.0, spread=0.5, reported=True)
OF_A_DIP = {"apart": "stribeck_velocity", "shown": "static", "exceeds": ("static", "coulomb")}  # options of its laws
TURN_SHARE = 2e-3  # velocity within which a friction turns over that of its dip, at first
RISING = 0.2, 0.9  # exponents between a friction of constant size and a viscous one
MOST_GIVE = 0.3  # rad or m, of a bristle before it slips: what gives by more is a spring
SLIPS_AT_ONCE = 0.01  # of the usual motion, within which a bristle stiffer than the gear is a dry friction that turns
GIVES = 3e-4, 3e-3, 3e-2  # of a bristle before it slips, at first, over the rms motion
START_TIME = 0.05  # s, over which the torque at the start of a motion is averaged: half a period of its band
PROJECTIONS = 2  # of what is asked at rest, onto what dry friction can be
# of a bristle
RELAXATION = Parameter("relaxation", "s", 0.0, 1.0, nuisance=True, center=0.0, spread=0.01, null=0.0, reported=True)
SMOOTHING = Parameter("smoothing_velocity", "rad/s", 1e-6, 1.0, log=True, nuisance=True, step=0.05)
# of a friction that turns before the velocity does
LEAD = Parameter("lead", "s", 0.0, 0.1, nuisance=True, center=0.0, spread=0.01, null=0.0)
SOFT = 0.0, 0.01  # s, at first: of a friction, and of one that is a soft constraint
CLIPS = 1e-3  # s of it, from which it is a soft constraint, whose torque is a line between its limits


def direction(v: np.ndarray, smoothing: float = 0.0, clipped: float = 0.0) -> np.ndarray:
    """Sign of a velocity (S, T), averaged over each step of the grid.

    Within a step the velocity is taken as linear, so that a reversal between two samples enters
    with its own time: a plain sign would add broadband noise of the size of the step. A smoothing
    velocity widens the reversal as regularised and presliding friction do; ``clipped`` is the share of it that is a
    line between the two.
    """
    return smooth_sign(np.ascontiguousarray(v), float(smoothing), float(clipped))


def _turned(motion: Motion, j: int, smoothing: float, lead: float = 0.0) -> np.ndarray:
    """``direction`` of a motor's motion (S, T), which turns where ``v + lead v'`` does.

    A physics engine that holds a joint by a soft constraint asks of it the acceleration ``-v / lead``: MuJoCo's
    ``frictionloss`` is ``clip(m (v + lead v'))`` within its size (its documentation, Computation, "Friction loss").
    """

    def made() -> np.ndarray:
        clipped = 1.0 - np.exp(-lead / CLIPS) if lead else 0.0
        return direction(ahead(motion.v(j), motion.time_step, lead), smoothing, clipped)

    return motion.kept(("direction", j, smoothing, lead), made)


def ahead(v: np.ndarray, step: float, lead: float) -> np.ndarray:
    """A velocity (S, T) and ``lead`` times its rate, by differences over steps of time."""
    return v + lead * (np.roll(v, -1, axis=1) - np.roll(v, 1, axis=1)) / (2.0 * step) if lead else v


def dry(
    motion: Motion,
    j: int,
    smoothing: float,
    size: np.ndarray | float,
    back: np.ndarray | float | None = None,
    lead: float = 0.0,
) -> np.ndarray:
    """Dry friction (S, T), N m: its ``size`` in the direction of the motion; where the motor stands still what balances
    the drive.

    At rest dry friction is whatever the drive asks of it, up to its size (Coulomb 1785): no history of the velocity
    tells it, and the recorded torque does, where it shows more than noise.

    Args:
        back: the size in the other direction; the same where None.
        lead: s, by which it turns before the velocity does.
    """
    back = size if back is None else back
    s = _turned(motion, j, smoothing, lead)
    moving = np.where(s > 0, size, back) * s
    rest = resting(motion, j, smoothing)
    if rest is None:
        return moving
    largest = np.broadcast_to(np.maximum(np.abs(size), np.abs(back)), rest.shape)[rest].mean()
    if largest < SEEN * motion.asked_noise(j):
        return moving
    asked, least, most = motion.asked(j), -np.abs(back), np.abs(size)
    noise = motion.asked_noise(j)
    friction = np.where(rest, within(asked, least, most, noise), moving)
    # Of what is asked only some lines are known, and its jumps ring: what has these lines within the limits is sought,
    # by projection onto one and the other in turn (Papoulis 1975).
    for _ in range(PROJECTIONS):
        missing = asked - motion.group.to_time(motion.lines(friction)[..., None])[..., 0]
        friction = np.where(rest, within(friction + missing, least, most, noise), moving)
    return friction


def within(asked: np.ndarray, least: np.ndarray, most: np.ndarray, noise: float) -> np.ndarray:
    """What dry friction gives of that which is asked of it: one that is its size but for noise is nearly that.

    A motor that creeps or turns looks like one at rest, and is asked its size and noise, of which a limit at that size
    keeps one side: the friction would be found too large for what it takes. Within one standard deviation of the limit
    up to as much is added, which takes away a fifth of that and leaves no jump. More would ask too much of a soft
    constraint, which creeps at less than its size.
    """
    noise = np.minimum(noise, 0.25 * (most - least))
    more, less = (np.clip(x, 0.0, noise) for x in (asked - most + noise, least + noise - asked))
    return np.clip(asked + more - less, least, most)


def sense(motion: Motion, j: int, smoothing: float) -> np.ndarray:
    """Dry friction (S, T) over its size, of which the rest itself says one."""
    rest = resting(motion, j, smoothing)
    if rest is None:
        return _turned(motion, j, smoothing)
    size = np.quantile(np.abs(motion.asked(j)[rest]), REST_QUANTILE)
    if size < SEEN * motion.asked_noise(j):
        return _turned(motion, j, smoothing)
    return dry(motion, j, smoothing, size) / max(size, LEAST_TORQUE)


def resting(motion: Motion, j: int, smoothing: float) -> np.ndarray | None:
    """Where a motor stands still (S, T); None where it never does, that is not known, or a turn within ``smoothing``
    rad/s is seen without."""
    rest = motion.group.rest
    if rest is None or j in motion.told or not np.any(rest[..., j]):
        return None
    seen = motion.group.window is None and smoothing > RESOLVED * motion.group.turn_noise[j]
    return None if seen else rest[..., j]


def other_turn(groups: Sequence[Group], j: int, smoothing: float) -> float | None:
    """Velocity within which a friction turns, rad/s, from which no step leads to ``smoothing``; None where no motor is
    seen to rest.

    Rest tells a friction that turns at once, and not one that turns within a velocity that is seen.
    """
    known = [
        RESOLVED * g.turn_noise[j] for g in groups if g.window is None and g.rest is not None and np.any(g.rest[..., j])
    ]
    if not known:
        return None
    return AT_ONCE * min(known) if smoothing > min(known) else SEEN_TO_TURN * max(known)


def held_at_start(motion: Motion, j: int, size: float) -> np.ndarray | None:
    """(S,) friction with memory over its ``size`` where a motion begins; None where it repeats.

    What it holds then was left by motions that were not recorded: the recorded torque tells it.
    """
    if motion.group.window is None:
        return None
    first = max(1, round(START_TIME / motion.time_step))
    return np.clip(motion.asked(j)[:, :first].mean(axis=1) / size, -1.0, 1.0)


def turns(scale: SignalScale) -> list[tuple[float]]:
    """Velocities within which a friction may turn, rad/s: at once, so that rest tells it where the motor sticks, or
    smoothly."""
    return [(f * scale.v,) for f in (1e-5, 2e-3, 0.05)]


def coulomb_friction(joint: int, place: str, leads: bool = True) -> Hypothesis:
    """``torque (sign v + asymmetry)`` (effects.md).

    Args:
        leads: whether it may turn before the velocity does, of this and the others. Motions below the modes of the
            links do not show it.
    """
    lead, none = sought(LEAD, leads)

    def law(p, motion: Motion, j: int, k: float) -> np.ndarray:
        return dry(motion, j, p[2], p[0] * (1.0 + p[1]), p[0] * (1.0 - p[1]), *p[3:])

    def screen(motion: Motion, j: int, k: float, shape) -> Screen:
        s = sense(motion, j, shape[0])
        return Screen(
            (s, np.abs(s)),
            lambda c: np.array([c[0], np.clip(c[1] / c[0], -0.8, 0.8), shape[0], *none]) if c[0] > 0 else None,
            shape,
        )

    return Hypothesis(
        "coulomb_friction",
        place,
        joint,
        "motor",
        (
            Parameter("torque", "N m", 1e-9, 1e7, log=True),
            Parameter("asymmetry", "1", -0.95, 0.95, center=0.0, spread=ASYMMETRY_SPREAD, null=0.0),
            SMOOTHING,
            *lead,
        ),
        law,
        turns,
        screen,
        "The residual torque of {joint} is a step in its velocity: a friction torque of {torque:.3g} N m"
        " against the motion whatever its speed.",
        options={"dry": True, "shown": "torque", "size": lambda s: np.array([0.4 * s.torque, 0.0, 0.05 * s.v, *none])},
    )


def _dipping(v: np.ndarray, p: Sequence[float]) -> np.ndarray:
    """Size of a Stribeck friction, N m, at velocities (S, T)."""
    return p[0] + max(p[1] - p[0], 0.1 * p[0]) * np.exp(-(np.abs(v / p[2]) ** p[4]))


def _first_sizes(c: np.ndarray) -> tuple[float, float] | None:
    """Coulomb and static friction to begin with, N m, where a linear step asks for ``c`` of the one and of what is more
    at rest; None where it asks for none."""
    if c[0] + c[1] <= 0:
        return None
    coulomb = max(c[0], 0.3 * (c[0] + c[1]))
    return coulomb, max(c[0] + c[1], 1.3 * coulomb)


def stribeck_friction(joint: int, place: str, leads: bool = True) -> Hypothesis:
    """``sign v (coulomb + (static - coulomb) exp(-|v / v_s|^exponent))``: the exponent is 2, or 1, or between
    (Armstrong-Helouvry 1991)."""
    lead, none = sought(LEAD, leads)

    def law(p, motion: Motion, j: int, k: float) -> np.ndarray:
        return dry(motion, j, p[3], _dipping(motion.v(j), p), None, *p[5:])

    def screen(motion: Motion, j: int, k: float, shape) -> Screen:
        v = motion.v(j)
        s = sense(motion, j, shape[0] * TURN_SHARE)

        def start(c):
            sizes = _first_sizes(c)
            return sizes and np.array([*sizes, shape[0], shape[0] * TURN_SHARE, DIP.center, *none])

        return Screen((s, s * np.exp(-(np.abs(v / shape[0]) ** DIP.center))), start, shape)

    def absorb(p: np.ndarray, weights: np.ndarray, old: np.ndarray) -> np.ndarray:
        coulomb = max(old[0] + weights[0], 0.1 * old[0])
        return np.array([coulomb, coulomb + max(weights[1], 0.1 * coulomb), p[2], old[2], p[4], *old[3:]])

    return Hypothesis(
        "stribeck_friction",
        place,
        joint,
        "motor",
        (
            Parameter("coulomb", "N m", 1e-9, 1e7, log=True),
            Parameter("static", "N m", 1e-9, 1e7, log=True),
            Parameter("stribeck_velocity", "rad/s", 1e-6, 1e2, True, step=1e-2, center=0.05, spread=1.2),
            SMOOTHING,
            DIP,
            *lead,
        ),
        law,
        lambda scale: [(f * scale.v,) for f in (0.05, 0.15, 0.4, 1.0)],
        screen,
        "The residual torque of {joint} falls from {static:.3g} N m at rest to {coulomb:.3g} N m above"
        " {stribeck_velocity:.2g} rad/s: friction with a Stribeck dip.",
        options=OF_A_DIP
        | {
            "absorbs": "coulomb_friction",
            "absorb": absorb,
            "bristled": lambda p, s: [
                np.array([*p[:3], p[1] / (give * max(s.q, LEAST_MOTION)), p[4], 0.0]) for give in GIVES
            ],
            "special": lambda p: np.array([p[0], 0.0, p[3], *p[5:]]),
            "dry": True,
            "trivial": lambda p, k: not LEAST_DIP * p[0] < p[1] < MOST_DIP * p[0],
            "plain": lambda p: p[1] < LEAST_DIP * p[0],
            "within": lambda p: p[2],
            "widens": lambda p, s: [
                np.array([0.6 * p[0], 1.2 * p[0], f * s.v, p[2], DIP.center, *p[3:]]) for f in (0.05, 0.3)
            ],
        },
    )


def bristled_stribeck(joint: int, place: str) -> Hypothesis:
    """The same of a bristle that gives before it slips: the LuGre model (Canudas de Wit, Olsson, Astrom and Lischinsky,
    IEEE Trans. Automatic Control 40, 1995)."""

    def law(p, motion: Motion, j: int, k: float) -> np.ndarray:
        v = motion.v(j)
        # Velocities within the dip say of the friction beyond it that it is less, and no more.
        limits = _dipping(v, [max(p[0], p[1] / MOST_DIP), *p[1:]])
        h = dipping_bristle(v, motion.time_step, p[3], limits)
        return h + p[5] * rate_of(h, motion.time_step)

    def screen(motion: Motion, j: int, k: float, shape) -> Screen:
        v = motion.v(j)
        z = bristle(v, motion.time_step, shape[1])

        def start(c):
            sizes = _first_sizes(c)
            return sizes and np.array([*sizes, shape[0], sizes[1] / shape[1], DIP.center, 0.0])

        return Screen((z, z * np.exp(-(np.abs(v / shape[0]) ** DIP.center))), start, shape)

    def absorb(p: np.ndarray, weights: np.ndarray, old: np.ndarray) -> np.ndarray:
        coulomb = max(old[1] + weights[0], 0.1 * old[1])
        return np.array([coulomb, coulomb + max(weights[1], 0.1 * coulomb), p[2], old[0], p[4], old[3]])

    plain = stribeck_friction(joint, place)
    coulomb, static, velocity, *_ = plain.parameters
    stiffness = Parameter("stiffness", "N m/rad", 1e-6, 1e12, log=True, nuisance=True, step=1e-2, reported=True)
    return replace(
        plain,
        parameters=(coulomb, static, velocity, stiffness, DIP, RELAXATION),
        law=law,
        shapes=lambda scale: [
            (f * scale.v, give * max(scale.q, LEAST_MOTION)) for f in (0.15, 0.5) for give in (0.003, 0.03)
        ],
        screen=screen,
        options=OF_A_DIP
        | {
            "absorbs": "presliding_friction",
            "absorb": absorb,
            "special": lambda p: np.array([p[3], p[0], DAHL, p[5]]),
            "trivial": lambda p, k: p[1] <= LEAST_DIP * p[0],
            "widens": lambda p, s: [
                np.array([0.6 * p[1], 1.2 * p[1], f * s.v, p[0], DIP.center, p[3]]) for f in (0.05, 0.3, 1.0)
            ],
        },
    )


def rate_of(x: np.ndarray, dt: float) -> np.ndarray:
    """Rate of a signal (S, T) that repeats, by central differences."""
    return (np.roll(x, -1, axis=1) - np.roll(x, 1, axis=1)) / (2.0 * dt)


def presliding_friction(joint: int, place: str, damped: bool = True) -> Hypothesis:
    """Spring of ``stiffness`` before it slips at ``coulomb``: Dahl's bristle, or a sharper one (see ``yielding``).

    Its bending is damped by ``relaxation`` times the stiffness, as in the LuGre model, whose ``sigma_1`` this is
    (Canudas de Wit, Olsson, Astrom and Lischinsky, IEEE Trans. Automatic Control 40, 1995).

    Args:
        damped: whether that damping is sought. Motions below the modes of the links do not show it.
    """
    relaxation, undamped = sought(RELAXATION, damped)

    def law(p, motion: Motion, j: int, k: float) -> np.ndarray:
        start = held_at_start(motion, j, p[1])
        z = bristle(motion.v(j), motion.time_step, p[1] / p[0], p[2], start)
        if not damped:
            return p[1] * z
        rate = rate_of(z, motion.time_step)
        if start is not None:  # what it holds then was not bent in one step
            rate[:, [0, -1]] = 0.0
        return p[1] * (z + p[3] * rate)

    def screen(motion: Motion, j: int, k: float, shape) -> Screen:
        z = bristle(motion.v(j), motion.time_step, shape[0])
        return Screen((z,), lambda c: np.array([c[0] / shape[0], c[0], DAHL, *undamped]) if c[0] > 0 else None, shape)

    return Hypothesis(
        "presliding_friction",
        place,
        joint,
        "motor",
        (
            Parameter("stiffness", "N m/rad", 1e-6, 1e12, log=True, step=1e-2),
            Parameter("coulomb", "N m", 1e-9, 1e7, log=True),
            replace(EXPONENT, center=DAHL, null=DAHL),
            *relaxation,
        ),
        law,
        lambda scale: [(f * max(scale.q, LEAST_MOTION),) for f in (0.01, 0.03, 0.1, 0.3, 1.0)],
        screen,
        "The residual torque of {joint} makes loops in position: friction that yields as a spring of"
        " {stiffness:.3g} N m/rad before it slips at {coulomb:.3g} N m.",
        variable="swing",
        options={
            "absorbs": "coulomb_friction",
            "absorb": lambda p, weights, old: np.array([p[0] * old[0] / p[1], old[0], *p[2:]]),
            "apart": "stiffness",
            "shown": "coulomb",
            "give": lambda p: p[1] / p[0],
            "called": lambda p, swing, k: (
                ("coulomb_friction", {"coulomb": "torque"})
                if p[1] < SLIPS_AT_ONCE * swing * p[0] and p[0] > k
                else None
            ),
            "trivial": lambda p, k: p[1] > MOST_GIVE * p[0],
            # A bristle that hardly bends and is damped turns before the velocity does.
            "special": lambda p: np.array([p[1], 0.0, SHARP, *p[3:]]),
            "widens": lambda p, s: [
                np.array([p[0] / (f * max(s.q, LEAST_MOTION)), p[0], DAHL, *undamped]) for f in (0.02, 0.2)
            ],
        },
    )


def load_dependent_friction(joint: int, place: str, leads: bool = True) -> Hypothesis:
    """``coefficient |tau_s| sign v`` (Bittencourt and Gunnarsson 2012)."""
    lead, none = sought(LEAD, leads)

    def screen(motion: Motion, j: int, k: float, shape) -> Screen:
        unit = np.abs(motion.tau_s(j)) * sense(motion, j, shape[0])
        return Screen((unit,), lambda c: np.array([c[0], shape[0], *none]) if c[0] > 0 else None, shape)

    return Hypothesis(
        "load_dependent_friction",
        place,
        joint,
        "motor",
        (Parameter("coefficient", "1", 1e-9, 2.0, log=True), SMOOTHING, *lead),
        lambda p, motion, j, k: dry(motion, j, p[1], p[0] * np.abs(motion.tau_s(j)), None, *p[2:]),
        turns,
        screen,
        "The friction torque of {joint} is {coefficient:.3g} of the torque it transmits: it differs"
        " between postures as the load does.",
        options={"dry": True, "sees_load": True, "shown": "coefficient"},
    )


def friction_drift(joint: int, place: str, leads: bool = True) -> Hypothesis:
    """Friction times ``1 + relative_change (1 - exp(-t / time_constant))`` as the joint warms up.

    Viscous and Coulomb friction change alike; ``relative_change`` is negative where they fall.
    """
    lead, none = sought(LEAD, leads)

    def steady(p: np.ndarray) -> bool:
        return bool(abs(p[0]) < LEAST_CHANGE)

    def warming(motion: Motion, j: int, tau: float) -> tuple[np.ndarray, np.ndarray]:
        return motion.par.viscous[j] * motion.v(j), warmth(motion, tau)

    def law(p, motion: Motion, j: int, k: float) -> np.ndarray:
        drag, warm = warming(motion, j, p[1])
        return dry(motion, j, p[3], p[2] * (1.0 + p[0] * warm), None, *p[4:]) + p[0] * warm * drag

    def screen(motion: Motion, j: int, k: float, shape) -> Screen:
        smoothing = 2e-3 * np.sqrt(np.mean(motion.v(j) ** 2))
        drag, warm = warming(motion, j, shape[0])
        s = sense(motion, j, smoothing)

        def start(c):
            coulomb = max(c[1], 1e-6)
            change = c[2] / coulomb if c[1] > 1e-6 else c[0]
            change = first_change(change) or 0.1
            return np.array([change, shape[0], coulomb, smoothing, *none])

        return Screen((warm * drag, s, warm * s), start, shape)

    def absorb(p: np.ndarray, weights: np.ndarray, old: np.ndarray) -> np.ndarray:
        coulomb = max(old[0] + weights[1], 0.1 * old[0])
        return np.array([first_change(weights[2] / coulomb), p[1], coulomb, old[2], *old[3:]])

    return Hypothesis(
        "friction_drift",
        place,
        joint,
        "motor",
        (
            CHANGE,
            TIME_CONSTANT,
            Parameter("coulomb", "N m", 1e-9, 1e7, log=True, nuisance=True, reported=True),
            SMOOTHING,
            *lead,
        ),
        law,
        time_constants,
        screen,
        WARMS + DRY_PART,
        variable="time",
        options={
            "said": lambda numbers: WARMS + ("." if numbers["coulomb"] < NO_FRICTION else DRY_PART),
            "absorbs": "coulomb_friction",
            "absorb": absorb,
            "apart": "time_constant",
            "special": lambda p: np.array([p[2], 0.0, *p[3:]]),
            "essential": ("relative_change",),
            "dry": True,
            "trivial": lambda p, k: steady(p),
            "plain": steady,
        },
    )


def velocity_power(joint: int, place: str, power: int) -> Hypothesis:
    """Decoy: drag that grows with a power of the velocity, which the catalogue lacks."""

    def unit(motion: Motion, j: int) -> np.ndarray:
        v = motion.v(j)
        return np.sign(v) * np.abs(v) ** power

    return Hypothesis(
        f"unknown:drag_{power}",
        place,
        joint,
        "motor",
        (Parameter("coefficient", "SI", -1e9, 1e9),),
        lambda p, motion, j, k: p[0] * unit(motion, j),
        lambda scale: [()],
        lambda motion, j, k, shape: Screen((unit(motion, j),), lambda c: np.array([c[0]]), ()),
        f"The residual torque of {{joint}} grows with its velocity to the power {power}.",
    )


def rising_friction(joint: int, place: str) -> Hypothesis:
    """Decoy: friction that grows with a power of the speed below one, ``coefficient |v|^exponent sign(v)``.

    Between Coulomb's and a viscous one; thin lubricants rub like that.
    """

    def unit(motion: Motion, j: int, exponent: float, smoothing: float) -> np.ndarray:
        v = motion.v(j)
        return np.abs(v) ** exponent * direction(v, smoothing)

    def screen(motion: Motion, j: int, k: float, shape) -> Screen:
        turn = SHARP_SHARE * shape[1]
        return Screen(
            (unit(motion, j, shape[0], turn),), lambda c: np.array([c[0], shape[0], turn]) if c[0] > 0 else None, shape
        )

    return Hypothesis(
        "unknown:rising_friction",
        place,
        joint,
        "motor",
        (
            Parameter("coefficient", "SI", 1e-9, 1e9, log=True),
            Parameter("exponent", "1", *RISING, nuisance=True, step=1e-2),
            SMOOTHING,
        ),
        lambda p, motion, j, k: p[0] * unit(motion, j, p[1], p[2]),
        lambda scale: [(e, scale.v) for e in (0.35, 0.6)],
        screen,
        "The residual torque of {joint} grows with a power of its speed below one.",
        # At its bounds it is as good as Coulomb's, or viscous.
        options={"trivial": lambda p, k: not 1.05 * RISING[0] < p[1] < 0.95 * RISING[1]},
    )


def falling_drag(joint: int, place: str) -> Hypothesis:
    """Decoy: drag that grows with the speed up to one of its own and falls beyond, as of an eddy-current brake, ``2
    torque x / (1 + x^2)`` at ``x = v / velocity`` (Wouterse, IEE Proc. B 138, 1991)."""

    def unit(motion: Motion, j: int, velocity: float) -> np.ndarray:
        x = motion.v(j) / velocity
        return 2.0 * x / (1.0 + x * x)

    return Hypothesis(
        "unknown:falling_drag",
        place,
        joint,
        "motor",
        (
            Parameter("torque", "N m", 1e-9, 1e7, log=True),
            Parameter("velocity", "rad/s", 1e-6, 1e3, log=True, step=1e-2),
        ),
        lambda p, motion, j, k: p[0] * unit(motion, j, p[1]),
        lambda scale: [(f * scale.v,) for f in (0.15, 0.4, 1.0)],
        lambda motion, j, k, shape: Screen(
            (unit(motion, j, shape[0]),), lambda c: np.array([c[0], shape[0]]) if c[0] > 0 else None, shape
        ),
        "The residual torque of {joint} grows with its speed to {torque:.3g} N m at {velocity:.3g} rad/s and falls beyond.",
    )


def position_friction(joint: int, place: str, leads: bool = True) -> Hypothesis:
    """Decoy: friction whose size depends on the position of the joint, ``(constant + slope q + curvature q^2)
    sign(v)``."""
    lead, none = sought(LEAD, leads)

    def units(motion: Motion, j: int, smoothing: float) -> tuple[np.ndarray, ...]:
        q, s = motion.q(j), sense(motion, j, smoothing)
        return s, s * q, s * q**2

    def law(p, motion: Motion, j: int, k: float) -> np.ndarray:
        q = motion.q(j)
        return dry(motion, j, p[3], p[0] + p[1] * q + p[2] * q**2, None, *p[4:])

    return Hypothesis(
        "unknown:position_friction",
        place,
        joint,
        "motor",
        (
            Parameter("constant", "N m", -1e7, 1e7),
            Parameter("slope", "N m/rad", -1e9, 1e9, null=0.0),
            Parameter("curvature", "N m/rad2", -1e9, 1e9, null=0.0),
            SMOOTHING,
            *lead,
        ),
        law,
        turns,
        lambda motion, j, k, shape: Screen(
            units(motion, j, shape[0]), lambda c: np.array([*c, shape[0], *none]), shape
        ),
        "The residual torque of {joint} changes sign with direction, and its size with position.",
        options={
            "absorbs": "coulomb_friction",
            "absorb": lambda p, weights, old: np.array([old[0] + weights[0], weights[1], weights[2], *old[2:]]),
            "essential": ("slope", "curvature"),
            "dry": True,
        },
    )
