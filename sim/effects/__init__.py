"""The catalogue of effects as what really happens in the plant."""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Sequence
from typing import Any

import numpy as np

from robot_assets.errors import DataError
from robot_assets.robot import Robot
from robot_assets.urdf import read_urdf
from sim.effects import drive, friction, sensing, structure, transmission
from sim.effects.effect import Effect

_CLASSES = (
    friction.CoulombFriction,
    friction.StribeckFriction,
    friction.PreslidingFriction,
    friction.LoadDependentFriction,
    friction.FrictionDrift,
    drive.Cogging,
    drive.TorqueConstant,
    drive.TorqueLag,
    drive.TorqueDelay,
    drive.TorqueSaturation,
    transmission.HardeningStiffness,
    transmission.SofteningStiffness,
    transmission.Backlash,
    transmission.Hysteresis,
    transmission.TransmissionError,
    transmission.JointCoupling,
    structure.Payload,
    structure.LinkInertia,
    structure.TransverseElasticity,
    structure.BaseElasticity,
    structure.GravitySpring,
    structure.DressPack,
    sensing.EncoderEccentricity,
    sensing.EncoderQuantization,
    sensing.SensorDelay,
    sensing.SensorLag,
)
PARALLEL = 0.9  # cosine from which on two axes are one
VECTORS = ("com", "axis")
DIVISORS = (
    "stribeck_velocity",
    "low_stiffness",
    "transition",
    "time_constant",
    "resolution",
    "yield_torque",
    "mass",
    "inertia",
)
SIZES = (
    "torque",
    "coulomb",
    "static",
    "stiffness",
    "damping",
    "delay",
    "limit",
    "gap",
    "friction",
    "coefficient",
    "cubic",
)
LEAST, LARGEST = 1e-12, 1e15  # sizes of parameters, SI
# Friction that drives the motor, and a drive of no torque or of the wrong sign, are none.
LIMITS = {"asymmetry": (-1.0, 1.0), "relative_change": (-1.0, LARGEST), "scale": (LEAST, LARGEST)}
CHANNELS = ("q", "q_link")
COM = ("com_x", "com_y", "com_z")  # the parts of ``com``: either is understood
LONGEST = 1.0  # s of a delay
EFFECTS = {c.name: c for c in _CLASSES}


def parameters_of(effect: Effect) -> dict[str, object]:
    """Parameters of an effect by their catalogue names."""
    return {f.name.rstrip("_"): getattr(effect, f.name) for f in dataclasses.fields(effect) if f.name != "place"}


def make_effect(name: str, place: str, **values: Any) -> Effect:
    """An effect from its catalogue name, place and parameters.

    Raises:
        DataError: for a name, place or parameter that there is not, or parameters that contradict each other.
    """
    if name not in EFFECTS:
        raise DataError("effect", name, "no such effect", f"one of {', '.join(sorted(EFFECTS))}")
    cls = EFFECTS[name]
    fields = {f.name.rstrip("_"): f for f in dataclasses.fields(cls) if f.name != "place"}
    values = _center_of_mass(values, fields, f"{name}@{place}")
    for key in values:
        if key not in fields:
            raise DataError(f"effect {name}", place, f"parameter {key}", f"one of {list(fields)}")
    required = [
        k for k, f in fields.items() if f.default is dataclasses.MISSING and f.default_factory is dataclasses.MISSING
    ]
    missing = [k for k in required if k not in values]
    if missing:
        raise DataError(f"effect {name}", place, f"no {missing[0]}", f"{required}")
    if name == "stribeck_friction" and values["static"] < values["coulomb"]:
        found, least = f"static {values['static']:g}", f"at least coulomb {values['coulomb']:g}"
        raise DataError(f"effect {name}", place, found, f"{least}: friction falls with speed")
    return cls(place=place, **{fields[k].name: v for k, v in values.items()})


def parse_effect(text: str, robot: Robot) -> Effect:
    """An effect from ``NAME@PLACE:key=value,...``; sizes of ``draw_effect`` where no key is given.

    Raises:
        DataError: where the text is of another form or names what there is not.
    """
    match = re.fullmatch(r"([a-z_]+)@([^:]+)(?::(.*))?", text.strip())
    if match is None:
        raise DataError("effect", text, "another form", "NAME@PLACE:key=value,...")
    name, place, rest = match.groups()
    if name not in EFFECTS:
        raise DataError("effect", text, name, f"one of {', '.join(sorted(EFFECTS))}")
    places = valid_places(name, robot)
    if place not in places:
        raise DataError("place", text, place, f"one of {places}")
    values: dict[str, Any] = {}
    for item in filter(None, (rest or "").split(",")):
        key, _, value = (part.strip() for part in item.partition("="))
        if key in values:
            raise DataError(f"parameter {key}", text, "it twice", "each parameter once")
        values[key] = _value(key, value, text)
    if not values:
        return draw_effect(np.random.default_rng(0), robot, names=(name,), place=place)
    return make_effect(name, place, **values)


def _center_of_mass(values: dict[str, Any], fields: dict, where: str) -> dict[str, Any]:
    """Values with a centre of mass as the effect takes it, of three numbers or in parts."""
    parts = [key for key in COM if key in values]
    if "com" in values and parts:
        raise DataError(f"parameter {parts[0]}", where, "com beside it", "one of the two")
    if "com" in values and "com" not in fields:
        return {k: v for k, v in values.items() if k != "com"} | dict(zip(COM, values["com"], strict=True))
    if parts and "com" in fields:
        com = tuple(values.get(key, 0.0) for key in COM)
        return {k: v for k, v in values.items() if k not in COM} | {"com": com}
    return values


def valid_places(name: str, robot: Robot) -> list[str]:
    """Where an effect can sit on an arm."""
    if name == "payload":
        return ["flange"]
    if name == "base_elasticity":
        return ["base"]
    if name == "link_inertia":
        from robot_assets.robot import moving_links

        return moving_links(robot)
    if name == "joint_coupling":
        return list(robot.joint_names[:-1])
    if name == "transverse_elasticity":
        return [joint for joint in robot.joint_names if len(free_axes(robot, joint))]
    return list(robot.joint_names)


def free_axes(robot: Robot, joint: str) -> np.ndarray:
    """(axes, 3) axes of a joint's frame across it about which the arm has no elasticity yet."""
    taken = [read_urdf(robot.urdf).axes[joint], *(h.axis for h in robot.elasticities if h.joint == joint)]
    axes = np.eye(3)
    return axes[np.abs(axes @ np.array(taken, float).T).max(axis=1) < PARALLEL]


def _value(key: str, text: str, where: str) -> object:
    if key == "channel":
        if text not in CHANNELS:
            raise DataError(f"parameter {key}", where, repr(text), f"one of {CHANNELS}")
        return text
    count = 3 if key in VECTORS else 1
    try:
        numbers = tuple(float(v) for v in text.split())
    except ValueError:
        numbers = ()
    if len(numbers) != count or not all(abs(v) <= LARGEST for v in numbers):
        expected = "three numbers with spaces" if count == 3 else "a number"
        raise DataError(f"parameter {key}", where, repr(text), f"{expected}, of at most {LARGEST:g}")
    if key == "axis" and not any(numbers):
        raise DataError(f"parameter {key}", where, repr(text), "a direction")
    low, high = LIMITS.get(key, (LEAST if key in DIVISORS else 0.0 if key in SIZES else -LARGEST, LARGEST))
    high = LONGEST if key == "delay" else high
    if count == 1 and not low <= numbers[0] <= high:
        raise DataError(f"parameter {key}", where, repr(text), f"a number from {low:g} to {high:g}")
    return numbers if count == 3 else numbers[0]


def draw_effect(
    rng: np.random.Generator,
    robot: Robot,
    *,
    names: Sequence[str] | None = None,
    strength: float = 1.0,
    place: str | None = None,
    peak_torque: np.ndarray | None = None,
) -> Effect:
    """An effect of random kind, place and size, clearly seen in an experiment of default size.

    Args:
        strength: factor on the size.
        peak_torque: (n,) torque that the experiment reaches, N m, for limits that are to be met.
    """
    name = str(rng.choice(list(names or EFFECTS)))
    place = place or str(rng.choice(valid_places(name, robot)))
    joint = robot.joints[robot.joint_names.index(place)] if place in robot.joint_names else robot.joints[0]
    spread = float(np.exp(rng.uniform(np.log(0.5), np.log(2.0))))
    size = strength * spread
    peak = 0.5 * joint.torque_limit
    if peak_torque is not None and place in robot.joint_names:
        peak = float(peak_torque[robot.joint_names.index(place)])
    torque = 0.02 * joint.torque_limit * size
    delta = 0.05 * joint.torque_limit / joint.stiffness
    phase = float(rng.uniform(-np.pi, np.pi))
    side = rng.permutation(np.eye(3))[0]
    periods = float(rng.choice([2.0, 4.0])) * joint.gear_ratio / float(rng.choice([1.0, 2.0]))
    k = joint.stiffness
    free = free_axes(robot, joint.name)
    others = [a for a in (side, np.roll(side, 1), np.roll(side, 2)) if np.any(free @ a)]
    across = others[0] if others else side
    wrong_link: dict[str, object] = {"mass": 1 + 0.15 * size}
    if rng.random() < 0.7:
        wrong_link["inertia"] = 1 + 0.15 * size
    if rng.random() < 0.5:
        wrong_link["com"] = tuple(float(v) for v in 0.02 * size * side)
    draws: dict[str, dict[str, object]] = {
        "coulomb_friction": {"torque": torque, "asymmetry": float(rng.uniform(-0.2, 0.2))},
        "stribeck_friction": {"coulomb": torque, "static": 2 * torque, "stribeck_velocity": 0.03},
        "presliding_friction": {"stiffness": torque / 2e-3, "coulomb": torque},
        "load_dependent_friction": {"coefficient": 0.05 * size},
        "friction_drift": {"relative_change": -min(0.3 * spread, 0.8), "time_constant": 60.0, "coulomb": torque},
        "cogging": {"amplitude": 0.5 * torque, "periods_per_rev": periods, "phase": phase},
        "torque_constant": {"scale": 1 + 0.08 * size * float(rng.choice([-1, 1]))},
        "torque_lag": {"time_constant": 1e-3 * size},
        "torque_delay": {"delay": 1e-3 * size},
        "torque_saturation": {"limit": peak * (0.75 - 0.1 * min(size, 2.0))},
        "hardening_stiffness": {"cubic": 0.3 * size * k / delta**2},
        "softening_stiffness": {"low_stiffness": k / (1 + size), "transition": delta},
        "backlash": {"gap": delta * size},
        "hysteresis": {"stiffness": 0.3 * k, "yield_torque": torque},
        "transmission_error": {"amplitude": 0.3 * torque / k, "periods_per_rev": periods, "phase": phase},
        "joint_coupling": {"ratio": 0.1 * size},
        "payload": {"mass": 1.5 * size, "com_x": 0.02, "com_y": 0.0, "com_z": 0.08},
        "link_inertia": wrong_link,
        "transverse_elasticity": {
            "stiffness": 0.7 * k / size,
            "damping": 6e-4 * k,
            "axis": tuple(float(v) for v in across),
        },
        "base_elasticity": {"stiffness": 10 * k / size, "damping": 6e-3 * k, "axis": (1.0, 0.0, 0.0)},
        "gravity_spring": {"stiffness": 0.1 * joint.torque_limit * size, "rest_angle": float(rng.uniform(-1, 1))},
        "dress_pack": {"stiffness": 0.1 * joint.torque_limit * size, "friction": 0.3 * torque},
        "encoder_eccentricity": {"amplitude": 4e-3 * size, "phase": phase},
        "encoder_quantization": {"resolution": 4e-5 * size},
        "sensor_delay": {"delay": 1e-3 * size},
        "sensor_lag": {"time_constant": 1e-3 * size},
    }
    return make_effect(name, place, **draws[name])
