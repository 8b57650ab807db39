"""Dry friction within a step of the integration.

Its sign turns within a velocity that a step of the integration may pass many times over. Held over the step at an
extrapolated velocity, a friction of more than ``REVERSAL inertia / step`` chatters about a motion that creeps, and is
not the friction that it says; here the velocity in the middle of the step and the friction there are solved together.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from sim.effects.effect import Dry, State

REVERSAL = 1e-3  # rad/s, velocity over which a regularised sign turns
# of the inertia that is counted on: with all of it a motor thrown into rest would ring from step to step
MOTOR_SHARE = 0.75
LINK_SHARE = 0.5  # the same of a link's at the start, which changes with the posture
TURNS, TURNED = 20, 1e-6  # steps of Newton at most; step in multiples of ``REVERSAL`` that ends them


def turn(asked: np.ndarray, size: np.ndarray) -> np.ndarray:
    """Root ``x`` (S,) of ``x + size tanh(x) = asked``, size at least zero.

    Newton from zero: where ``asked`` is positive the left is concave, and no step passes the root.
    """
    x = np.zeros_like(asked)
    for _ in range(TURNS):
        t = np.tanh(x)
        step = (asked - x - size * t) / (1.0 + size * (1.0 - t * t))
        x = x + step
        if np.abs(step).max() < TURNED:
            break
    return x


def resistance(
    step: float, laws: Sequence[Callable[[State], Dry]], motor_inertia: np.ndarray, link_inertia: np.ndarray
) -> Callable[[State], list[tuple[Dry, np.ndarray]]]:
    """Torque (S,) against the motion of each joint that has dry friction, all of its laws together, N m.

    What else acts on the coordinate is taken from the step before: of its change of velocity, all but the friction.

    Args:
        step: of the integration, s.
        motor_inertia, link_inertia: (S, n) what a torque there moves at the start, gears as springs, kg m2.
    """
    # Of the velocity half a step on, per torque.
    change_of = {
        link: 0.5 * step / (REVERSAL * x)
        for link, x in ((False, MOTOR_SHARE * motor_inertia), (True, LINK_SHARE * link_inertia))
    }
    before: dict[tuple[int, bool], np.ndarray] = {}

    def against(x: State) -> list[tuple[Dry, np.ndarray]]:
        total: dict[tuple[int, bool], Dry] = {}
        for law in laws:
            new = law(x)
            old = total.get((new.joint, new.link), Dry(new.joint, 0.0, 0.0, new.link))
            total[new.joint, new.link] = Dry(
                new.joint, old.forward + new.forward, old.backward + new.backward, new.link
            )
        out = []
        for key, dry in total.items():
            j = dry.joint
            v, change = (x.v_link if dry.link else x.v)[:, j], change_of[dry.link][:, j]
            asked = v / REVERSAL - change * before.get(key, 0.0)
            size = np.maximum(np.where(asked > 0.0, dry.forward, dry.backward), 0.0)
            before[key] = -size * np.tanh(turn(asked, change * size))
            out.append((dry, before[key]))
        return out

    return against
