"""Units of a map, what each of them measures, and which of them a channel can have."""

from __future__ import annotations

from typing import Any

import numpy as np

from robot_assets.errors import DataError
from robot_assets.values import show

# Kind of quantity -> unit -> how much of the SI unit it is.
KINDS = {
    "angle": {"rad": 1.0, "deg": np.pi / 180, "mrad": 1e-3, "rev": 2 * np.pi},
    "angular speed": {"rad/s": 1.0, "deg/s": np.pi / 180, "rpm": np.pi / 30},
    "torque": {"N m": 1.0, "mN m": 1e-3, "kN m": 1e3},
    "force": {"N": 1.0, "kN": 1e3},
    "current": {"A": 1.0, "mA": 1e-3},
    "voltage": {"V": 1.0},
    "length": {"m": 1.0, "mm": 1e-3, "um": 1e-6},
    "speed": {"m/s": 1.0, "mm/s": 1e-3},
    "time": {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9},
    "temperature": {"degC": 1.0},
}
UNITS = {unit: factor for kind in KINDS.values() for unit, factor in kind.items()}
TURNING = {"position": "angle", "velocity": "angular speed", "torque": "torque"}
LINEAR = {"position": "length", "velocity": "speed", "torque": "force"}
QUANTITIES = {"tau": ("torque",), "qd": ("velocity",), "r": ("torque", "position")}  # all others are positions


def units_of(channel: str, linear: bool, geared: bool) -> list[str]:
    """Units that a channel of a joint can have.

    Args:
        geared: whether a gear stands between: a motor that turns may move a linear joint, and the other way round.
    """
    if channel == "temp":
        return list(KINDS["temperature"])
    kinds: list[str] = []
    for quantity in QUANTITIES.get(channel, ("position",)):
        kinds += [own[quantity] for own in ((LINEAR, TURNING) if linear else (TURNING, LINEAR))[: 1 + geared]]
        kinds += ["current", "voltage"] if quantity == "torque" else []
    return [unit for kind in kinds for unit in KINDS[kind]]


def unit_factor(unit: Any, allowed: list[str], key: str, where: str) -> float:
    """SI units in one of ``unit``.

    Raises:
        DataError: where it is none of those allowed.
    """
    if not isinstance(unit, str) or unit not in allowed:
        raise DataError(f"unit of {key}", where, show(unit), f"one of {allowed}")
    return UNITS[unit]


def is_position(unit: Any) -> bool:
    """Whether a unit is one of angles or lengths."""
    return any(unit in KINDS[own["position"]] for own in (TURNING, LINEAR))
