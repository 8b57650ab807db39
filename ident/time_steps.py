"""How a simulation that made records steps in time, and what derivatives are in it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

DAMPERS = Literal["implicit", "explicit", "apart"]


@dataclass(frozen=True)
class TimeSteps:
    """How a simulation steps in time: semi-implicit Euler, ``v += h a; q += h v``.

    The acceleration is then the second difference of the position. Dampers see its difference behind where they are
    "explicit", the one ahead where they are "implicit"; and where each body is implicit "apart", as tendons of
    MuJoCo under ``implicitfast`` are, the one behind, and body and rotor resist a change of their speed by ``h`` times
    what damps them.

    Attributes:
        length: h, s.
    """

    length: float
    dampers: DAMPERS

    @property
    def apart(self) -> float:
        """Inertia per damping that comes with it, s."""
        return self.length if self.dampers == "apart" else 0.0


def differences(s: np.ndarray, steps: TimeSteps | None) -> tuple[np.ndarray, np.ndarray]:
    """What a position is times for the velocity that a damper sees, and for the acceleration; (F,) each.

    ``s`` and ``s^2`` in continuous time, where ``steps`` is None.

    Args:
        s: (F,) complex frequencies, rad/s.
    """
    if steps is None:
        return s, s**2
    half = 0.5 * steps.length * s
    rate = 2.0 / steps.length * np.sinh(half)
    return rate * np.exp(half if steps.dampers == "implicit" else -half), rate**2
