"""Springs to the link side: balancing springs, and bundles of cables."""

from __future__ import annotations

import numpy as np

from ident.hypotheses import kernels
from ident.hypotheses.friction import LEAD, SMOOTHING, SOFT, ahead, direction
from ident.hypotheses.hypothesis import START, Hypothesis, Parameter, Screen, no_law, sought
from ident.hypotheses.yielding import elastoplastic
from ident.motion import Motion

FARTHEST_REST = 10.0  # of a balancing spring, rad or m
YIELDS = 0.1  # of the rms motion, over which a cable gives before it slips, to begin with


def gravity_spring(joint: int, place: str) -> Hypothesis:
    """Balancing spring on the link: ``stiffness (q_link - rest_angle)`` against it."""

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
        },
    )


def dress_pack(joint: int, place: str, leads: bool = True, yields: bool = False) -> Hypothesis:
    """Cable bundle on the link side: ``stiffness q_link + friction sign(q_link')``.

    Args:
        leads: whether it may turn before the velocity does (see ``friction``).
        yields: whether the friction turns over with the path, as of cables that give before they slip (Dahl 1968), in
            place of the velocity.
    """
    lead, _ = sought(LEAD, leads)

    def screen(motion: Motion, j: int, k: float, shape) -> Screen:
        v, q = ahead(motion.v_link(j), motion.time_step, sum(shape)), motion.q_link(j)
        turn = 0.02 * float(np.sqrt(np.mean(v**2)))
        give = YIELDS * float(np.std(q))

        def start(c):
            own = (give, 0.0) if yields else (turn, *shape)
            return np.array([max(c[0], 1e-3), max(c[1], 1e-3), *own]) if max(c[0], c[1]) > 0 else None

        if not yields:
            return Screen((q, direction(v, turn)), start, shape)
        return Screen((q, elastoplastic(q, 1.0 / max(give, 1e-12), 1.0, begins=motion.group.window is not None)), start)

    own = (
        (Parameter("yield_angle", "rad", 1e-7, 1.0, log=True, nuisance=True, step=0.02), START)
        if yields
        else (SMOOTHING, *lead)
    )
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
        lambda scale: [(x,) for x in SOFT] if lead and not yields else [()],
        screen,
        "A bundle of {stiffness:.3g} N m/rad with {friction:.3g} N m of friction pulls on the link of {joint}.",
        variable="q",
        options={
            "loop": lambda p: (
                kernels.Law(kernels.CABLE, p[0], p[1], p[1] / p[2], start=p[3])
                if yields
                else kernels.Law(kernels.LINK, p[0], p[1], p[2], lead=sum(p[3:]))
            ),
            # Without a spring to speak of it is a second friction, which a stiff gear hardly tells from that of the
            # motor.
            "trivial": lambda p, k: p[0] < 0.2 * p[1],
            "absorbs": "gravity_spring",
            "absorb": lambda p, weights, old: np.array([old[0], *p[1:]]),
            "apart": "friction",
            "special": lambda p: np.array([p[0], 0.0]),
        },
    )
