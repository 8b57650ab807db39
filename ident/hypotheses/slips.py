"""Friction that yields slip by slip: elements in parallel, each of which remembers where it turned by itself.

Beyond the one element of Dahl and LuGre small loops close and do not wander (Iwan, J. Appl. Mech. 33, 1966; for
friction the generalised Maxwell slip, Al-Bender, Lampaert and Swevers, IEEE Trans. Automatic Control 50, 2005).
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.special import ndtri

from ident.hypotheses.friction import RELAXATION, presliding_friction, rate_of
from ident.hypotheses.hypothesis import Hypothesis, Parameter
from ident.hypotheses.yielding import DAHL, elastoplastic
from ident.motion import Motion

SLIPS = 10
# of the logarithms of the deflections at which they yield
SPREAD = Parameter("spread", "1", 0.05, 2.0, log=True, nuisance=True, step=2e-2, center=0.7, spread=0.7, reported=True)
SPREADS = 0.3, 1.0  # at first


def parallel_slips(stiffness: float, limit: float, spread: float) -> tuple[float, np.ndarray]:
    """Stiffness of each slip, N m/rad, and the torques at which they yield, (SLIPS,) N m: of equal shares of a normal
    distribution of the logarithms, which add up to ``limit``."""
    give = np.exp(spread * ndtri((np.arange(SLIPS) + 0.5) / SLIPS))
    return stiffness / SLIPS, limit * give / give.sum()


def slipping_friction(joint: int, place: str) -> Hypothesis:
    """``presliding_friction`` of slips in parallel. Fitted where one element leaves more than noise."""

    def law(p, motion: Motion, j: int, k: float) -> np.ndarray:
        q, begins = motion.q(j), motion.group.window is not None
        each, limits = parallel_slips(p[0], p[1], p[2])
        h = np.sum([elastoplastic(q, each, limit, begins=begins) for limit in limits], axis=0)
        return h + p[3] * rate_of(h, motion.time_step)

    plain = presliding_friction(joint, place)
    stiffness, coulomb, *_ = plain.parameters
    own = {
        "holds": "presliding_friction",
        "widens": lambda p, scale: [np.array([p[0], p[1], spread, p[3]]) for spread in SPREADS],
        "narrow": lambda p: np.array([p[0], p[1], DAHL, p[3]]),
    }
    return replace(
        plain,
        parameters=(stiffness, coulomb, SPREAD, RELAXATION),
        law=law,
        screen=None,
        options=plain.options | own,
    )
