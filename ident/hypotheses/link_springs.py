"""Springs to the link side: balancing springs, and bundles of cables."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ident.hypotheses import kernels
from ident.hypotheses.friction import LEAD, SMOOTHING, SOFT, ahead, direction
from ident.hypotheses.hypothesis import START, Hypothesis, Parameter, Screen, SignalScale, no_law, sought
from ident.hypotheses.yielding import elastoplastic
from ident.motion import Motion

FARTHEST_REST = 10.0  # of a balancing spring, rad or m
# of a spring between two points: torque of a force that does not grow with its length, over all of it, about rest; and
# what its length grows by in half a turn, 2 a b / (a - b)^2 of the distances of its points from the axis
CONSTANT = Parameter("constant_share", "1", -4.0, 1.0, nuisance=True, step=1e-2, center=0.0, spread=1.0, reported=True)
STRETCH = Parameter("stretch", "1", 1e-2, 1e2, True, nuisance=True, step=1e-2, center=1.0, spread=1.5, reported=True)
TURNS = 0.02  # of the rms velocity, within which the friction of a cable turns, to begin with
RUBS = 0.1, 1.0  # friction of a cable, over the torque of its spring in the rms motion, to begin with
REST = Parameter("rest_angle", "rad", -FARTHEST_REST, FARTHEST_REST, nuisance=True, step=1e-3, spread=0.3, null=0.0)
YIELDS = 0.1  # of the rms motion, over which a cable gives before it slips, to begin with
YIELD_ANGLE = Parameter("yield_angle", "rad", 1e-7, 1.0, log=True, nuisance=True, step=0.02, reported=True)


def gravity_spring(joint: int, place: str, linear: bool = False) -> Hypothesis:
    """Balancing spring on the link: ``stiffness (q_link - rest_angle)`` against it.

    Args:
        linear: whether the joint is, so that no spring between two points turns with it.
    """

    def screen(motion: Motion, j: int, k: float, shape) -> Screen:
        q = motion.q_link(j)
        return Screen(
            (q, np.ones_like(q)),
            lambda c: np.array([c[0], np.clip(-c[1] / c[0], -9.0, 9.0)]) if c[0] > 0 else None,
        )

    return Hypothesis(
        "gravity_spring",
        place,
        joint,
        "link",
        (
            Parameter("stiffness", "N m/rad", 1e-6, 1e9, log=True),
            Parameter("rest_angle", "rad", -FARTHEST_REST, FARTHEST_REST, step=1e-3),
        ),
        lambda p, motion, j, k: p[0] * (motion.q_link(j) - p[1]),
        lambda scale: [()],
        screen,
        "A spring of {stiffness:.3g} N m/rad with rest at {rest_angle:.3g} rad pulls on the link of {joint}: static"
        " torque that is linear in posture.",
        variable="q",
        options={
            "trivial": lambda p, k: abs(p[1]) > 0.95 * FARTHEST_REST,  # a constant torque
            "slope": lambda p, q: p[0],
            "linear": linear,
        },
    )


def spring_between_points(joint: int, place: str) -> Hypothesis:
    """Balancing spring between two points, one on either side of the joint: of ``stiffness`` about its rest.

    At the angle ``x`` from there its torque is ``stiffness sin x (1 - c + c / sqrt(u))``, ``u = 1 + stretch (1 - cos
    x)``: a spring without a length of its own has no ``c``, a gas spring that pushes alike at any length one of 1, a
    spring that is slack at a length one below nought.
    """

    def law(p, motion: Motion, j: int, k: float) -> np.ndarray:
        x = motion.q_link(j) - p[1]
        return p[0] * np.sin(x) * (1.0 + p[2] * ((1.0 + p[3] * (1.0 - np.cos(x))) ** -0.5 - 1.0))

    def slope(p, q: np.ndarray) -> np.ndarray:
        x = q - p[1]
        u = 1.0 + p[3] * (1.0 - np.cos(x))
        bent = 0.5 * p[2] * p[3] * np.sin(x) ** 2 * u**-1.5
        return p[0] * (np.cos(x) * (1.0 + p[2] * (u**-0.5 - 1.0)) - bent)

    def screen(motion: Motion, j: int, k: float, shape) -> Screen:
        q = motion.q_link(j)
        return Screen(
            (np.sin(q), np.cos(q)),
            lambda c: np.array([np.hypot(*c), np.arctan2(-c[1], c[0]), CONSTANT.center, STRETCH.center]),
        )

    plain = gravity_spring(joint, place)
    stiffness, rest = plain.parameters
    return replace(
        plain,
        parameters=(stiffness, replace(rest, lower=-2.0 * np.pi, upper=2.0 * np.pi), CONSTANT, STRETCH),
        law=law,
        screen=screen,
        sentence="A spring between two points, of {stiffness:.3g} N m/rad about its rest at {rest_angle:.3g} rad, pulls on the"
        " link of {joint}: static torque that depends on the posture.",
        options={
            "slope": slope,
            "holds": "gravity_spring",
            "widens": lambda p, scale: [np.array([*p[:2], CONSTANT.center, STRETCH.center])],
            "narrow": lambda p: p[:2],
        },
    )


def dress_pack(joint: int, place: str, leads: bool = True, yields: bool = False, hung: bool = False) -> Hypothesis:
    """Cable bundle on the link side: ``stiffness q_link + friction sign(q_link')``.

    Args:
        leads: whether it may turn before the velocity does (see ``friction``).
        yields: whether the friction turns over with the path, as of cables that give before they slip (Dahl 1968), in
            place of the velocity.
        hung: whether its spring is at rest at another angle than zero. Fitted where a balancing spring, or a bundle
            that is not, leaves more than noise.
    """
    lead, _ = sought(LEAD, leads and not yields)
    rest, _ = sought(REST, hung)
    own = (*((YIELD_ANGLE, START) if yields else (SMOOTHING, *lead)), *rest)

    def screen(motion: Motion, j: int, k: float, shape) -> Screen:
        v, q = ahead(motion.v_link(j), motion.time_step, sum(shape)), motion.q_link(j)
        turn = TURNS * float(np.sqrt(np.mean(v**2)))
        give = YIELDS * float(np.std(q))

        def start(c):
            turns = (give, 0.0) if yields else (turn, *shape)
            return np.array([max(c[0], 1e-3), max(c[1], 1e-3), *turns]) if max(c[0], c[1]) > 0 else None

        if not yields:
            return Screen((q, direction(v, turn)), start, shape)
        return Screen((q, elastoplastic(q, 1.0 / max(give, 1e-12), 1.0, begins=motion.group.window is not None)), start)

    def rest_of(p) -> float:
        return float(p[-1]) if rest else 0.0

    return Hypothesis(
        "dress_pack",
        place,
        joint,
        "link",
        (
            Parameter("stiffness", "N m/rad", 1e-6, 1e9, log=True, step=1e-3),
            Parameter("friction", "N m", 1e-9, 1e7, log=True, step=1e-3),
            *own,
        ),
        no_law,
        lambda scale: [(x,) for x in SOFT] if lead else [()],
        screen,
        "A bundle of {stiffness:.3g} N m/rad with {friction:.3g} N m of friction pulls on the link of {joint}.",
        variable="q",
        options={
            "loop": lambda p: (
                kernels.Law(kernels.CABLE, p[0], p[1], p[1] / p[2], start=p[3])
                if yields
                else kernels.Law(kernels.LINK, p[0], p[1], p[2], lead=float(p[3]) if lead else 0.0)
            ),
            "rest": rest_of,
            "yields": yields,
            # Without a spring to speak of it is a second friction, which a stiff gear hardly tells from that of the
            # motor.
            "trivial": lambda p, k: p[0] < 0.2 * p[1],
            "absorbs": "gravity_spring",
            "absorb": lambda p, weights, old: np.array([old[0], *p[1:]]),
            "apart": "friction",
            "special": lambda p: np.array([p[0], rest_of(p)]),
        },
    )


def hung_dress_pack(joint: int, place: str, spring: bool, yields: bool = False, leads: bool = True) -> Hypothesis:
    """A ``dress_pack`` that is at rest at another angle than zero.

    Args:
        spring: whether it is begun from a balancing spring; else from a bundle.
        yields, leads: as of ``dress_pack``.
    """
    plain = dress_pack(joint, place, leads=leads, yields=yields, hung=True)
    kept = len(plain.parameters) - 1  # of a bundle that is not

    def widens(p: np.ndarray, scale: SignalScale) -> list[np.ndarray]:
        if not spring:
            return [np.array([*p, *(0.0 for _ in range(kept - len(p))), 0.0])]
        turn = (TURNS * scale.v, 0.0)[: kept - 2]
        return [np.array([p[0], share * p[0] * scale.q, *turn, p[1]]) for share in RUBS]

    own = {"holds": "gravity_spring" if spring else "dress_pack", "widens": widens, "narrow": lambda p: p[:kept]}
    return replace(plain, screen=None, options=plain.options | own)
