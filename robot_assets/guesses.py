"""Starting guesses of the drives of an arm from the bodies that they carry.

They follow from rules of thumb on the inertia that each joint sees and on its effort and velocity limits in the URDF;
over the shipped arms they are right within a factor of about five, and are there to be replaced or identified.
"""

from __future__ import annotations

import xml.etree.ElementTree as ET
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from robot_assets.errors import DataError
from robot_assets.joint import ENCODER, NOISE, VELOCITY, WINDUP, Joint
from robot_assets.urdf import Description
from robot_assets.values import LARGEST

GRAVITY = 9.81  # m/s2
POSTURES = 64  # random ones, over which the seen inertia is taken
GEAR_RATIO = 100.0  # of a strain-wave or cycloidal gear of an arm; 1 for a linear drive
SOFTEST = 5.0  # Hz: no anti-resonance is guessed below
SCREW = 30.0  # Hz: anti-resonance of a ball screw with its carriage
DAMPING = 0.05  # damping ratio of the gear
ACCELERATION = 150.0  # rad/s2 that the torque limit gives the motor alone
# times what the least of the joints needs, from which one limit of the torque that all joints have was put in for none
PLACEHOLDER = 30.0
MATCH = 0.5  # motor inertia over the inertia carried, at the least
DRAG = 0.1  # of the torque limit, taken by viscous friction at the velocity limit
Carrier = tuple[int, np.ndarray, np.ndarray, bool]  # joint, axis, a point of the axis, linear
LINEAR_UNITS = {"rad": "m", "N m": "N", "kg m2": "kg"}


@dataclass(frozen=True)
class JointGuess:
    """The figures of one joint and where they come from.

    Attributes:
        joint: figures as they stand in ``robot.toml``.
        prismatic: linear axis: kg, N and m stand for kg m2, N m and rad.
        inertia: (2,) smallest and largest inertia that the joint carries, kg m2 or kg.
        weight: largest torque of gravity, N m or N.
        reasons: figure -> a sentence.
    """

    joint: Joint
    prismatic: bool
    inertia: tuple[float, float]
    weight: float
    reasons: dict[str, str]


def guess_joints(
    urdf: Path, tree: Description, names: Sequence[str], locked: Mapping[str, float]
) -> tuple[JointGuess, ...]:
    """Figures of the driven joints of a URDF, in the order of their names.

    Args:
        tree: what ``urdf`` describes.
        locked: where other joints stand, rad or m; at zero where it does not say.

    Raises:
        DataError: where the bodies that a joint carries give figures of no drive.
    """
    still = dict.fromkeys(tree.limits, 0.0) | dict(locked)
    inertia, weight = _seen(ET.fromstring(urdf.read_bytes()), tree, list(names), still)
    speeds = [tree.speeds[name] or VELOCITY[tree.kinds[name] == "prismatic"] for name in names]
    needed = [_needed(*each) for each in zip(inertia.T, weight.T, speeds, strict=True)]
    efforts = [tree.efforts[name] for name in names]
    if len(names) > 1 and len(set(efforts)) == 1 and efforts[0] > PLACEHOLDER * min(needed):
        efforts = [0.0] * len(names)
    guesses = tuple(
        _guess(tree, name, inertia[:, j], float(weight[:, j].max()), efforts[j], needed[j])
        for j, name in enumerate(names)
    )
    for guess in guesses:
        _check_figures(guess, urdf)
    return guesses


def _needed(inertia: np.ndarray, weight: np.ndarray, speed: float) -> float:
    """Torque that carries twice the weight and reaches full speed in 0.1 s, N m or N."""
    return float(max(2.0 * weight.max() + 10.0 * max(np.median(inertia), 1e-6) * speed, 1e-3))


def _guess(
    tree: Description, name: str, inertia: np.ndarray, weight: float, effort: float, needed: float
) -> JointGuess:
    """Figures of one joint; ``effort`` is the limit of its torque, 0 where the URDF says none that can be used."""
    linear, velocity = tree.kinds[name] == "prismatic", tree.speeds[name]
    carried = float(np.median(inertia))
    newton, rad, kg = (unit_of(u, linear) for u in ("N m", "rad", "kg m2"))
    reasons = {"gear_ratio": 'GUESS: matters only for logs taken on the motor side (side = "motor" in a map)'}
    ratio = 1.0 if linear else GEAR_RATIO
    if velocity > 0:
        reasons["velocity_limit"] = f"{rad}/s, of the URDF"
    else:
        velocity = VELOCITY[linear]
        reasons["velocity_limit"] = f"{rad}/s, GUESS: the URDF has none"
    if effort > 0:
        torque = effort
        reasons["torque_limit"] = f"{newton}, of the URDF"
    else:
        torque = needed
        reasons["torque_limit"] = f"{newton}, GUESS: twice the weight, and full speed in 0.1 s"
    if effort > 0 and not linear:
        motor = max(torque / ACCELERATION, MATCH * carried)
        reasons["motor_inertia"] = (
            f"{kg}, GUESS: {ACCELERATION:g} rad/s2 of the motor alone, {MATCH:g} of what the joint carries at the least"
        )
    else:
        motor = max(carried, 1e-6)
        reasons["motor_inertia"] = f"{kg}, GUESS: as much as the joint carries"
    if linear or effort <= 0:
        f = SCREW if linear else 3 * SOFTEST
        stiffness = max(carried, 1e-6) * (2 * np.pi * f) ** 2
        reasons["stiffness"] = f"{newton}/{rad}, GUESS: anti-resonance at {f:g} Hz"
    else:
        stiffness = max(torque / WINDUP, float(inertia.max()) * (2 * np.pi * SOFTEST) ** 2)
        reasons["stiffness"] = (
            f"{newton}/{rad}, GUESS: {WINDUP * 1e3:.2g} mrad under the torque limit, no anti-resonance below {SOFTEST:g} Hz"
        )
    load = max(carried, 0.1 * motor)  # what a URDF says of the last links is often too little
    reduced = motor * load / (motor + load)
    reasons["damping"] = f"{newton} s/{rad}, GUESS: {DAMPING:.0%} of critical"
    reasons["viscous_friction"] = f"{newton} s/{rad}, GUESS: {DRAG:.0%} of the torque limit at the velocity limit"
    reasons["q_std"] = f"{rad}, GUESS: noise of the motor encoder"
    reasons["tau_std"] = f"{newton}, GUESS: {NOISE:g} of the torque limit"
    joint = Joint(
        name=name,
        gear_ratio=ratio,
        motor_inertia=motor,
        stiffness=stiffness,
        damping=2 * DAMPING * float(np.sqrt(stiffness * reduced)),
        viscous_friction=DRAG * torque / velocity,
        torque_limit=torque,
        velocity_limit=velocity,
        q_std=ENCODER[linear],
        tau_std=NOISE * torque,
    )
    ordered = {f: reasons[f] for f in Joint.__dataclass_fields__ if f != "name"}
    return JointGuess(joint, linear, (float(inertia.min()), float(inertia.max())), weight, ordered)


def _check_figures(guess: JointGuess, path: Path) -> None:
    """Raise a DataError where the bodies that a joint carries give figures of no drive."""
    for field in guess.reasons:
        value = getattr(guess.joint, field)
        if not 0 < value <= LARGEST:
            low, high = guess.inertia
            found = f"{low:.3g} to {high:.3g} {unit_of('kg m2', guess.prismatic)} carried, which gives {field} = {value:.3g}"
            raise DataError(
                f"joint {guess.joint.name}", str(path), found, "masses and inertias of an arm on the links beyond it"
            )


def _seen(
    root: ET.Element, tree: Description, names: list[str], still: dict[str, float]
) -> tuple[np.ndarray, np.ndarray]:
    """Inertia carried by each joint and size of its gravity torque in random postures, (POSTURES, n) each.

    Args:
        still: where joints stand that do not move, rad or m.
    """
    rng = np.random.default_rng(0)
    low, high = np.array([np.clip(tree.limits[name], -np.pi, np.pi) for name in names]).T
    joints = root.findall("joint")
    bodies = {e.get("name", ""): _body(e) for e in root.findall("link")}
    children: dict[str, list[ET.Element]] = {}
    for joint in joints:
        children.setdefault(link_at(joint, "parent"), []).append(joint)
    (base,) = set(bodies) - {link_at(j, "child") for j in joints}
    inertia, weight = np.zeros((POSTURES, len(names))), np.zeros((POSTURES, len(names)))
    q = {name: np.full(POSTURES, at) for name, at in still.items()}
    q |= zip(names, rng.uniform(low, high, (POSTURES, len(names))).T, strict=True)
    # All postures at once, (POSTURES, 3, 3) and (POSTURES, 3); without recursion: a chain may be longer than Python's
    # stack.
    start = np.broadcast_to(np.eye(3), (POSTURES, 3, 3))
    stack: list[tuple[str, np.ndarray, np.ndarray, tuple[Carrier, ...]]] = [(base, start, np.zeros((POSTURES, 3)), ())]
    while stack:
        link, R, x, above = stack.pop()
        mass, com, tensor = bodies[link]
        at, I = x + R @ com, R @ tensor @ R.transpose(0, 2, 1)
        for j, axis, origin, linear in above if mass or tensor.any() else ():
            arm = at - origin
            if linear:
                inertia[:, j] += mass
                weight[:, j] += mass * GRAVITY * axis[:, 2]
            else:
                along = np.sum(axis * arm, axis=1)
                inertia[:, j] += np.einsum("pi,pij,pj->p", axis, I, axis) + mass * (np.sum(arm**2, axis=1) - along**2)
                weight[:, j] += mass * GRAVITY * (axis[:, 0] * arm[:, 1] - axis[:, 1] * arm[:, 0])
        for joint in children.get(link, []):
            R_origin, x_origin = _origin(joint)
            R_joint, x_joint = R @ R_origin.as_matrix(), x + R @ x_origin
            name, slides, carried = joint.get("name", ""), joint.get("type") == "prismatic", above
            if joint.get("type") != "fixed":
                own = _three(joint.find("axis"), "xyz", "1 0 0")
                own = own / np.linalg.norm(own)
                axis = R_joint @ own
                if name in names:
                    carried = (*above, (names.index(name), axis, x_joint, slides))
                if slides:
                    x_joint = x_joint + axis * q[name][:, None]
                else:
                    R_joint = R_joint @ Rotation.from_rotvec(own * q[name][:, None]).as_matrix()
            stack.append((link_at(joint, "child"), R_joint, x_joint, carried))
    weight = np.abs(weight)
    return inertia, np.where(weight < 1e-9 * max(weight.max(), 1e-300), 0.0, weight)


def _body(link: ET.Element) -> tuple[float, np.ndarray, np.ndarray]:
    """Mass, centre of mass (3,) and inertia about it (3, 3), link axes."""
    inertial = link.find("inertial")
    if inertial is None:
        return 0.0, np.zeros(3), np.zeros((3, 3))
    R, com = _origin(inertial)
    mass, I = inertial.find("mass"), inertial.find("inertia")
    assert mass is not None and I is not None  # as read_urdf has checked
    xx, xy, xz, yy, yz, zz = (float(I.get(k, "0")) for k in ("ixx", "ixy", "ixz", "iyy", "iyz", "izz"))
    tensor = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
    return float(mass.get("value", "0")), com, R.as_matrix() @ tensor @ R.as_matrix().T


def _origin(element: ET.Element) -> tuple[Rotation, np.ndarray]:
    """Rotation and shift (3,) of a joint or an inertial."""
    origin = element.find("origin")
    return Rotation.from_euler("xyz", _three(origin, "rpy", "0 0 0")), _three(origin, "xyz", "0 0 0")


def _three(element: ET.Element | None, key: str, default: str) -> np.ndarray:
    return np.array([float(v) for v in (default if element is None else element.get(key, default)).split()])


def link_at(joint: ET.Element, end: str) -> str:
    """The link at the "parent" or "child" end of a joint."""
    element = joint.find(end)
    return "" if element is None else element.get("link", "")


def unit_of(unit: str, linear: bool) -> str:
    """The unit of a figure of a turning joint, as it is of a linear one."""
    return LINEAR_UNITS[unit] if linear else unit
