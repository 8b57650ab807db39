"""The chain of a robot: links, gears and hinges, with what effects change of its bodies."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path

import numpy as np
import pinocchio as pin

from robot_assets.errors import DataError
from robot_assets.robot import Elasticity, Robot
from robot_assets.urdf import completed


@dataclass(frozen=True)
class LinkChange:
    """How the body of a link differs from its description.

    Attributes:
        mass, inertia: factors, the latter on the inertia about the centre of mass.
        com: (3,) shift of the centre of mass in the frame of the link's joint, m.
        with_load: whether the loads that the robot names on it are part of it.
    """

    mass: float = 1.0
    com: tuple[float, float, float] = (0.0, 0.0, 0.0)
    inertia: float = 1.0
    with_load: bool = False

    def of(self, body: pin.Inertia) -> pin.Inertia:
        """The body with the change made."""
        return pin.Inertia(body.mass * self.mass, body.lever + np.asarray(self.com), body.inertia * self.inertia)

    def __add__(self, other: LinkChange) -> LinkChange:
        """Both changes, one after the other."""
        com = (self.com[0] + other.com[0], self.com[1] + other.com[1], self.com[2] + other.com[2])
        return LinkChange(self.mass * other.mass, com, self.inertia * other.inertia, self.with_load or other.with_load)


@dataclass(frozen=True)
class Structure:
    """What parameters do not change: the chain, and which of its coordinates are driven.

    Attributes:
        model: Pinocchio model over the N link coordinates, loads included.
        driven: (n,) index of each driven joint among the link coordinates.
        elastic: (n_e,) indices of the elastic hinges.
        bodies: link name -> (Pinocchio joint index, placement of the link frame in it).
        carriers: joint of the description -> index of the joint that carries its body, behind its hinges.
        robot: the robot it was built from.
        hinges, loads, links, inertias: what ``build_structure`` was given beyond the robot.
    """

    model: pin.Model
    driven: np.ndarray
    elastic: np.ndarray
    bodies: dict[str, tuple[int, pin.SE3]]
    robot: Robot
    hinges: tuple[Elasticity, ...] = ()
    loads: tuple[tuple[str, pin.Inertia], ...] = ()
    links: dict[str, LinkChange] = field(default_factory=dict)
    inertias: dict[str, pin.Inertia] = field(default_factory=dict)
    carriers: dict[str, int] = field(default_factory=dict)

    @property
    def n(self) -> int:
        """Number of motors."""
        return len(self.driven)

    @property
    def n_coordinates(self) -> int:
        """Number of link coordinates N."""
        return self.model.nv


INERTIAL = (
    "mass",
    *(f"first_moment_{i}" for i in "xyz"),
    *(f"inertia_{ij}" for ij in ("xx", "xy", "yy", "xz", "yz", "zz")),
)
"""Inertial parameters of a body in the frame of its joint, in the order of ``pin.Inertia.toDynamicParameters``."""


def _placed_loads(robot: Robot, source: pin.Model) -> list[tuple[str, pin.Inertia]]:
    """Loads that a robot names, each with its link, in the frame of the joint that carries that."""
    places = {f.name: f.placement for f in _links(source)}
    for load in robot.loads:
        if load.link not in places:
            raise DataError("load", str(robot.folder), load.link, f"a link among {sorted(places)}")
    return [
        (load.link, places[load.link].act(pin.Inertia(load.mass, np.asarray(load.com), np.asarray(load.inertia))))
        for load in robot.loads
    ]


def build_structure(
    robot: Robot,
    *,
    elasticities: tuple[Elasticity, ...] = (),
    loads: tuple[tuple[str, pin.Inertia], ...] = (),
    links: dict[str, LinkChange] | None = None,
    inertias: dict[str, pin.Inertia] | None = None,
) -> Structure:
    """Pinocchio chain of a robot, with elastic hinges and loads placed.

    Args:
        robot: the arm.
        elasticities: elastic hinges beyond those of the robot.
        loads: (link name, inertia in that link's frame) beyond those of the robot.
        links: link name -> how its body differs from its description.
        inertias: joint of the description -> inertia of the body on it, loads of the robot included, instead
            of what the description says.

    Raises:
        DataError: where the URDF lacks a joint or link that the robot names, or holds a joint
            that is neither driven nor locked.
    """
    source = _reduced_model(robot)
    hinges = robot.elasticities + tuple(elasticities)
    model = pin.Model()
    model.name = robot.name
    model.gravity.linear = np.asarray(robot.gravity, float)
    parent = {f.name: f.parentJoint for f in _links(source)}
    changed = {parent[link]: change for link, change in (links or {}).items()}
    known = inertias or {}
    placed = _placed_loads(robot, source)
    carrier = {0: _add_hinges(model, 0, [h for h in hinges if h.joint == "base"], pin.SE3.Identity())[0]}
    if carrier[0]:  # on a foundation that moves the root link moves with it
        model.appendBodyToJoint(carrier[0], source.inertias[0], pin.SE3.Identity())
    index: dict[str, int] = {}
    for i in range(1, source.njoints):
        name, joint = source.names[i], source.joints[i]
        own = [h for h in hinges if h.joint == name]
        below, placement = _add_hinges(
            model, carrier[source.parents[i]], [h for h in own if h.before], source.jointPlacements[i]
        )
        k = model.addJoint(below, _joint_model(joint, pin.neutral(source)), placement, name)
        index[name] = model.idx_vs[k]
        carrier[i], _ = _add_hinges(model, k, [h for h in own if not h.before], pin.SE3.Identity())
        body, change = known.get(name, source.inertias[i]), changed.get(i, LinkChange())
        if change.with_load and name not in known:
            body = sum((x for link, x in placed if parent[link] == i), body)
        model.appendBodyToJoint(carrier[i], change.of(body), pin.SE3.Identity())
    bodies = {f.name: (carrier[f.parentJoint], f.placement) for f in _links(source)}
    for link, inertia in placed:
        if source.names[parent[link]] not in known and not changed.get(parent[link], LinkChange()).with_load:
            model.appendBodyToJoint(bodies[link][0], inertia, pin.SE3.Identity())
    for link, inertia in loads:
        if link not in bodies:
            raise DataError("load", str(robot.folder), link, f"a link among {sorted(bodies)}")
        joint_index, placement = bodies[link]
        model.appendBodyToJoint(joint_index, inertia, placement)
    driven = np.array([index[name] for name in robot.joint_names])
    elastic = np.array([model.idx_vs[model.getJointId(_hinge_name(h))] for h in hinges], dtype=int)
    return Structure(
        model,
        driven,
        elastic,
        bodies,
        robot,
        tuple(elasticities),
        tuple(loads),
        dict(links or {}),
        dict(known),
        {source.names[i]: k for i, k in carrier.items() if i},
    )


def _reduced_model(robot: Robot) -> pin.Model:
    """The rigid chain of a robot's driven joints; a file is read once, as long as it stays the same."""
    changed = robot.urdf.stat().st_mtime_ns if robot.urdf.exists() else 0
    locked = tuple(sorted((name, float(angle)) for name, angle in robot.locked.items()))
    return _read_chain(str(robot.urdf), changed, robot.joint_names, locked, str(robot.folder))


@lru_cache(maxsize=8)
def _read_chain(
    urdf: str, changed: int, joint_names: tuple[str, ...], locked: tuple[tuple[str, float], ...], folder: str
) -> pin.Model:
    try:
        full = pin.buildModelFromXML(completed(Path(urdf)))
    except Exception as err:
        raise DataError("URDF", urdf, str(err).splitlines()[0], "a readable URDF") from err
    movable = set(full.names[1:])
    missing = [name for name in joint_names if name not in movable]
    if missing:
        raise DataError("joint", urdf, f"no {missing[0]}", f"one of {sorted(movable)}")
    angles = dict(locked)
    free = movable - set(joint_names)
    stray = sorted(free - set(angles))
    if stray:
        raise DataError("joint", folder, f"{stray[0]} neither driven nor locked", "a [locked] entry")
    q = pin.neutral(full)
    for name in free:
        joint = full.joints[full.getJointId(name)]
        q[joint.idx_q : joint.idx_q + joint.nq] = (
            [np.cos(angles[name]), np.sin(angles[name])] if joint.nq == 2 else [angles[name]]
        )
    own = tell_links_apart(full)
    reduced = pin.buildReducedModel(full, [full.getJointId(name) for name in free], q)
    for frame in _links(reduced):
        frame.name = own.get(frame.name, frame.name)
    return reduced


def tell_links_apart(model: pin.Model) -> dict[str, str]:
    """Other names for the links of a model that share theirs with a joint, which Pinocchio cannot reduce.

    Returns:
        the names that these links had, by those that they have now.
    """
    joints = {f.name for f in model.frames if f.type != pin.FrameType.BODY}
    own = {}
    for frame in _links(model):
        if frame.name in joints:
            own[f"link:{frame.name}"] = frame.name
            frame.name = f"link:{frame.name}"
    return own


def _links(model: pin.Model) -> list[pin.Frame]:
    return [f for f in model.frames if f.type == pin.FrameType.BODY]


def _joint_model(joint: pin.JointModel, neutral: np.ndarray) -> pin.JointModel:
    """The same axis as a joint of one coordinate (a URDF "continuous" joint has two).

    Args:
        neutral: a configuration of its chain.
    """
    data = joint.createData()
    joint.calc(data, neutral)
    freedom = np.asarray(data.S).reshape(6, -1)
    slides, turns = (bool(np.any(part)) for part in (freedom[:3], freedom[3:]))
    if freedom.shape != (6, 1) or slides == turns:
        raise DataError("joint", joint.shortname(), "a joint of several degrees of freedom", "revolute or prismatic")
    axis = freedom[:3, 0] if slides else freedom[3:, 0]
    return pin.JointModelPrismaticUnaligned(axis) if slides else pin.JointModelRevoluteUnaligned(axis)


def _hinge_name(hinge: Elasticity) -> str:
    return f"elasticity:{hinge.name}"


def _add_hinges(model: pin.Model, parent: int, hinges: Sequence[Elasticity], placement: pin.SE3) -> tuple[int, pin.SE3]:
    """The last of a chain of hinges, and where it takes what comes after them."""
    for hinge in hinges:
        axis = np.asarray(hinge.axis, float)
        revolute = pin.JointModelRevoluteUnaligned(axis / np.linalg.norm(axis))
        parent = model.addJoint(parent, revolute, placement, _hinge_name(hinge))
        placement = pin.SE3.Identity()
    return parent, placement
