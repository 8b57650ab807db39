"""Units of parameters, at rotary and at linear joints."""

from __future__ import annotations

import re
from collections.abc import Collection, Iterable

from ident.chain import INERTIAL
from robot_assets.robot import Robot, linear_joints

LINEAR_UNITS = {
    "N m": "N",
    "N m/rad": "N/m",
    "N m/rad2": "N/m2",
    "N m/rad3": "N/m3",
    "N m s/rad": "N s/m",
    "kg m2": "kg",
    "rad": "m",
    "rad/s": "m/s",
}
"""Units of a linear joint for those of a rotary one."""

KIND_UNITS = {
    "stiffness": "N m/rad",
    "damping": "N m s/rad",
    "motor_inertia": "kg m2",
    "viscous_friction": "N m s/rad",
    "torque_offset": "N m",
    "link_friction": "N m s/rad",
    "record_roll_off": "s2",
}
"""Units of the parameters of rotary joints by kind."""


_AFTER_A_NUMBER = re.compile(r"(?<= )(?:N m s/rad|N m/rad[23]?|N m|rad/s|rad)(?![\w/])")


def linear_names(robot: Robot) -> frozenset[str]:
    """Names of the linear joints."""
    return frozenset(n for n, linear in zip(robot.joint_names, linear_joints(robot), strict=True) if linear)


def unit_at(unit: str, linear: bool) -> str:
    """A unit of a rotary joint as it is at a joint that may be linear."""
    return LINEAR_UNITS.get(unit, unit) if linear else unit


def text_at(text: str, linear: bool) -> str:
    """A sentence with units of a rotary joint in it, as it is at a joint that may be linear."""
    return _AFTER_A_NUMBER.sub(lambda unit: LINEAR_UNITS[unit.group()], text) if linear else text


def parameter_unit(name: str, linear: Collection[str] = ()) -> str:
    """SI unit of a parameter named by ``graybox.parameter_names`` or of a kind in ``INERTIAL`` or ``KIND_UNITS``.

    Args:
        linear: names of the linear joints.
    """
    kind, _, place = name.partition(".")
    if kind in INERTIAL:
        return "kg" if kind == "mass" else "kg m" if kind.startswith("first") else "kg m2"
    return unit_at(KIND_UNITS[kind], place in linear)


def torque_units(robot: Robot) -> tuple[str, ...]:
    """Units of the torques of the joints."""
    return tuple(unit_at("N m", linear) for linear in linear_joints(robot))


def response_unit(robot: Robot) -> str:
    """Unit of frequency responses from torque to acceleration over all joints."""
    one_kind = {"N": "(m/s²)/N", "N m": "(rad/s²)/(N m)"}
    return one_kind.get(torque_unit(robot), "(rad/s² or m/s²)/(N m or N)")


def torque_unit(robot: Robot, joints: Collection[str] = ()) -> str:
    """Unit of torques over joints, all where none is said: those of linear joints are forces."""
    units = units_of_torques(robot)
    return common_unit(units[j] for j in joints or units)


def common_unit(units: Iterable[str]) -> str:
    """One unit for quantities of several, those of rotary joints first: "N m or N" where they differ."""
    return " or ".join(sorted(set(units), reverse=True))


def has_one_torque_unit(robot: Robot) -> bool:
    """Whether torques of all joints have one unit: else no number stands for all of them."""
    return len(set(torque_units(robot))) == 1


def units_of_torques(robot: Robot) -> dict[str, str]:
    """Unit of its torque by joint."""
    return dict(zip(robot.joint_names, torque_units(robot), strict=True))


def unit_suffix(unit: str) -> str:
    """The unit behind a number; nothing behind a pure one."""
    return "" if unit in ("", "1") else f" {unit}"
