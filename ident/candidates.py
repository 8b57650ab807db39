"""Postures in which an arm can be measured: drawn in its range, refused where it would hit something.

The arm may touch neither itself nor the plane it stands on, and gravity must leave torque to
excite it with. Self-collision is judged by the collision geometry of the URDF.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass

import numpy as np
import pinocchio as pin

from ident.excitation import TORQUE_SHARE
from robot_assets.errors import DataError
from robot_assets.robot import Robot
from robot_assets.urdf import completed, read_urdf

MARGIN = 0.05  # of each joint range, at most 0.1 rad, left free at either end for the excitation
ALWAYS = 0.95  # share of postures from which a touching pair is taken for drawn too fat
TRIALS = 200  # postures that tell such pairs
PATIENCE = 200  # postures tried for each one wanted


@dataclass(frozen=True)
class Candidates:
    """Postures that can be measured.

    Attributes:
        q: (Q, n) motor positions, rad.
        refused: reason -> number of postures drawn and refused for it.
        note: what could not be checked, or "".
    """

    q: np.ndarray
    refused: dict[str, int]
    note: str


@dataclass(frozen=True)
class Body:
    """Kinematics and collision geometry of a robot.

    Attributes:
        index: (n,) Pinocchio index of the driven joints. rest: neutral configuration, locked joints set.
        geometry: pairs of links that are not neighbours, or None.
        flange: frame index.
        note: why there is no geometry, or "".
    """

    model: pin.Model
    index: np.ndarray
    rest: np.ndarray
    geometry: pin.GeometryModel | None
    flange: int
    note: str


def draw_candidates(robot: Robot, count: int, rng: np.random.Generator) -> Candidates:
    """Postures drawn uniformly in the joint range, with the flange above the base plane.

    Raises:
        DataError: where too few postures are admissible.
    """
    body = build_body(robot, rng)
    model, data = body.model, body.model.createData()
    touch = None if body.geometry is None else body.geometry.createData()
    limit = TORQUE_SHARE * robot.array("torque_limit")
    driven = [model.idx_vs[int(k)] for k in body.index]
    low, high = reach(robot)
    found: list[np.ndarray] = []
    refused: Counter[str] = Counter()
    for _ in range(PATIENCE * count):
        q = rng.uniform(low, high)
        full = configuration(body, q)
        if np.any(np.abs(pin.computeGeneralizedGravity(model, data, full)[driven]) > limit):
            refused["gravity torque"] += 1
        elif flange_height(body, data, full) < -1e-9:
            refused["flange below the base"] += 1
        elif touch is not None and pin.computeCollisions(model, data, body.geometry, touch, full, True):
            refused["self-collision"] += 1
        else:
            found.append(q)
            if len(found) == count:
                return Candidates(np.array(found), dict(refused), body.note)
    raise DataError("postures", robot.name, f"{len(found)} of {PATIENCE * count} drawn admissible", f"{count}")


def reach(robot: Robot) -> tuple[np.ndarray, np.ndarray]:
    """(n,) limits within which a posture is drawn, rad; one turn at most where the range is more.

    Raises:
        DataError: where a joint has no finite range.
    """
    if not np.all(np.isfinite(robot.q_max - robot.q_min)):
        raise DataError("joint limits", robot.name, "an endless joint", "finite limits in the URDF")
    margin = np.minimum(MARGIN * (robot.q_max - robot.q_min), 0.1)
    centre, half = 0.5 * (robot.q_max + robot.q_min), 0.5 * (robot.q_max - robot.q_min) - margin
    half = np.minimum(half, np.pi)
    return centre - half, centre + half


def build_body(robot: Robot, rng: np.random.Generator) -> Body:
    """Kinematics of a robot and the pairs of its links that can collide."""
    model = pin.buildModelFromXML(completed(robot.urdf))
    model.gravity.linear = np.asarray(robot.gravity, float)
    frames = {f.name: i for i, f in enumerate(model.frames) if f.type == pin.FrameType.BODY}
    for load in robot.loads:
        frame = model.frames[frames[load.link]]
        inertia = pin.Inertia(load.mass, np.asarray(load.com), np.asarray(load.inertia))
        model.appendBodyToJoint(frame.parentJoint, inertia, frame.placement)
    index = np.array([model.getJointId(name) for name in robot.joint_names])
    rest = pin.neutral(model)
    _set(model, rest, [model.getJointId(name) for name in robot.locked], list(robot.locked.values()))
    flange = robot.payload_link or read_urdf(robot.urdf).child[robot.joint_names[-1]]
    geometry, note = _geometry(robot, model)
    body = Body(model, index, rest, geometry, frames[flange], note)
    if geometry is not None:
        _drop_always_touching(body, geometry, robot, rng)
    return body


def configuration(body: Body, q: np.ndarray) -> np.ndarray:
    """Pinocchio configuration of a posture (n,) of the driven joints."""
    full = body.rest.copy()
    _set(body.model, full, body.index, q)
    return full


def flange_height(body: Body, data: pin.Data, full: np.ndarray) -> float:
    """Height of the flange over the plane the arm stands on, z = 0 of the URDF, m."""
    pin.forwardKinematics(body.model, data, full)
    return float(pin.updateFramePlacement(body.model, data, body.flange).translation[2])


def _set(model: pin.Model, full: np.ndarray, joints, angles) -> None:
    for k, angle in zip(joints, angles, strict=True):
        joint = model.joints[int(k)]
        full[joint.idx_q : joint.idx_q + joint.nq] = [np.cos(angle), np.sin(angle)] if joint.nq == 2 else [angle]


def _geometry(robot: Robot, model: pin.Model) -> tuple[pin.GeometryModel | None, str]:
    folders = [str(robot.mesh_dir)] if robot.mesh_dir else []
    try:
        geometry = pin.buildGeomFromUrdfString(model, completed(robot.urdf), pin.GeometryType.COLLISION, None, folders)
    except Exception as err:
        return None, f"self-collision not checked: {str(err).splitlines()[0]}"
    if geometry.ngeoms == 0:
        return None, "self-collision not checked: the URDF has no collision geometry"
    geometry.addAllCollisionPairs()
    for pair in list(geometry.collisionPairs):
        a, b = (geometry.geometryObjects[i].parentJoint for i in (pair.first, pair.second))
        if a == b or model.parents[a] == b or model.parents[b] == a:
            geometry.removeCollisionPair(pair)
    return geometry, ""


def _drop_always_touching(body: Body, geometry: pin.GeometryModel, robot: Robot, rng: np.random.Generator) -> None:
    """Remove pairs that touch in nearly every posture: shapes drawn too fat, or parts locked together."""
    data, touch = body.model.createData(), geometry.createData()
    hits = np.zeros(len(geometry.collisionPairs))
    low, high = reach(robot)
    for _ in range(TRIALS):
        pin.computeCollisions(body.model, data, geometry, touch, configuration(body, rng.uniform(low, high)), False)
        hits += [result.isCollision() for result in touch.collisionResults]
    always = [p for p, k in zip(list(geometry.collisionPairs), hits, strict=True) if k > ALWAYS * TRIALS]
    for pair in always:
        geometry.removeCollisionPair(pair)
