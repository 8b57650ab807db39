"""Effects of bodies: an unknown load, and links that are not those of the model."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pinocchio as pin

from ident.chain import LinkChange, Structure, build_structure
from ident.group import Group
from ident.hypotheses.hypothesis import Hypothesis, Parameter, no_law
from ident.hypotheses.structure import Change, torques_of_changes
from ident.inverse import Plane
from ident.motion import Solution

LOAD_NATS = 2.0  # log odds of a load against a wrong last body: loads come and go
EXACT = 0.01  # of the mass of that body, up to which no description is exact: a load of less has no odds over it
SMALLEST_SIZE = 1e-6  # of a change of a body, over what is expected of one
SMALL_LOAD = 0.03  # m, radius of gyration of a load from which its fit starts
FARTHEST = 2.0  # m, of the centre of mass of a load
LINK_STEPS = (1e-3, 1e-4, 1e-4, 1e-4, 1e-3)  # of mass, com and inertia of a link, for unit responses


def payload(link: str) -> Hypothesis:
    """Unknown load with its centre of mass at ``com`` in the frame of the flange's link.

    Its inertia about the centre is that of a body along the axes of the frame: what a ball would leave, a wrong link
    takes up.
    """

    def change(p) -> Change:
        return Change(loads=((link, pin.Inertia(float(p[0]), np.asarray(p[1:4], float), np.diag(p[4:7]))),))

    def responses(structure, par, plane, group, solution, shape):
        joint, placement = structure.bodies[link]
        columns = [_move(np.append(unit, np.zeros(6)), placement) for unit in np.eye(4)]
        return _inertial_responses(structure, joint, columns, plane, group, solution)

    def start(c):
        if c[0] <= 0:
            return None
        return np.concatenate([[c[0]], np.clip(c[1:] / c[0], -0.4, 0.4), np.full(3, c[0] * SMALL_LOAD**2)])

    return Hypothesis(
        "payload",
        "flange",
        -1,
        "model",
        (
            Parameter("mass", "kg", 1e-6, 1e4, log=True, step=1e-3),
            Parameter("com_x", "m", -FARTHEST, FARTHEST, step=1e-3, center=0.0, spread=0.2, null=0.0),
            Parameter("com_y", "m", -FARTHEST, FARTHEST, step=1e-3, center=0.0, spread=0.2, null=0.0),
            Parameter("com_z", "m", -FARTHEST, FARTHEST, step=1e-3, center=0.0, spread=0.2, null=0.0),
            *(Parameter(f"inertia_{i}", "kg m2", 1e-9, 1e4, log=True, step=1e-1) for i in "xyz"),
        ),
        no_law,
        lambda scale: [()],
        None,
        "An unknown load of {mass:.3g} kg hangs at the flange: anti-resonances fall at every posture and the gravity"
        " torque changes with them.",
        variable="posture",
        options={"body": link, "change": change, "responses": responses, "start": start, "shown": "mass"},
    )


def payload_like(link: str, without: Structure, changed: Structure) -> np.ndarray | None:
    """Parameters of a ``payload`` that has the mass and first moment by which the body of a link differs in two chains;
    None where
    it has become lighter."""
    joint, placement = without.bodies[link]
    mass, *moment = (
        changed.model.inertias[joint].toDynamicParameters() - without.model.inertias[joint].toDynamicParameters()
    )[:4]
    if mass <= 0.0:
        return None
    com = placement.actInv(np.array(moment) / mass)
    return np.concatenate([[mass], np.clip(com, -FARTHEST, FARTHEST), np.full(3, mass * SMALL_LOAD**2)])


def link_inertia(link: str, joint_index: int, carries_load: bool = False, with_load: bool = False) -> Hypothesis:
    """Mass, centre of mass and inertia of a link are not those of the model.

    ``mass`` and ``inertia`` (about the centre of mass) are factors, ``com`` is a shift in the frame of
    the link's joint. The data seldom determine all of them: what they leave open stays near the model.

    Args:
        carries_load: whether a payload would be part of the same body.
        with_load: whether the loads that the robot names on it are.
    """

    parameters = (
        Parameter("mass", "1", 0.05, 20.0, log=True, step=1e-4, center=1.0, spread=0.5, null=1.0),
        Parameter("com_x", "m", -1.0, 1.0, step=1e-4, center=0.0, spread=0.1, null=0.0),
        Parameter("com_y", "m", -1.0, 1.0, step=1e-4, center=0.0, spread=0.1, null=0.0),
        Parameter("com_z", "m", -1.0, 1.0, step=1e-4, center=0.0, spread=0.1, null=0.0),
        Parameter("inertia", "1", 0.02, 50.0, log=True, step=1e-3, center=1.0, spread=0.5, null=1.0),
    )

    def how(p) -> LinkChange:
        return LinkChange(float(p[0]), (float(p[1]), float(p[2]), float(p[3])), float(p[4]), with_load)

    def of_size(p) -> float:
        """A load is expected to be as large as it is found; a change of a body that a load would make as well, and
        that is no larger than that to which no description is exact, as large as that."""
        if not carries_load or abs(p[0] - 1.0) > EXACT:
            return 1.0
        off = [(v - q.center) / q.spread for q, v in zip(parameters, p, strict=True)]
        return float(np.clip(np.max(np.abs(off)), SMALLEST_SIZE, 1.0))

    def responses(structure, par, plane, group, solution, shape):
        joint, _ = structure.bodies[link]
        robot = structure.robot if with_load else replace(structure.robot, loads=())
        bare = build_structure(robot, links=structure.links, inertias=structure.inertias)
        own = bare.model.inertias[bare.bodies[link][0]]
        base = own.toDynamicParameters()
        changed = np.array([1.0, 0.0, 0.0, 0.0, 1.0]) + np.diag(LINK_STEPS)
        columns = [(how(p).of(own).toDynamicParameters() - base) / h for p, h in zip(changed, LINK_STEPS, strict=True)]
        return _inertial_responses(structure, joint, columns, plane, group, solution)

    return Hypothesis(
        "link_inertia",
        link,
        joint_index,
        "model",
        parameters,
        no_law,
        lambda scale: [()],
        None,
        f"The body of {{joint}}{', with the load on it,' if with_load else ''} is not that of the model:"
        " its mass is {mass:.3g} times, its inertia {inertia:.3g} times"
        " what the model says, its centre of mass off by ({com_x:.3g}, {com_y:.3g}, {com_z:.3g}) m.",
        variable="posture",
        options={
            "body": link,
            "nats": lambda p: -LOAD_NATS * (carries_load and abs(p[0] - 1.0) > EXACT),
            "of_size": of_size,
            "with_load": with_load,
            "carries_load": carries_load,  # what it carries and its own body are one to the data
            "change": lambda p: Change(links=((link, how(p)),)),
            "responses": responses,
            "start": lambda c: np.array(
                [np.clip(1.0 + c[0], 0.3, 4.0), *np.clip(c[1:4], -0.2, 0.2), np.clip(1.0 + c[4], 0.3, 4.0)]
            ),
        },
    )


def _inertial_responses(
    structure: Structure,
    joint: int,
    columns: Sequence[np.ndarray],
    plane: Plane,
    group: Group,
    solution: Solution,
) -> list[np.ndarray]:
    """Recorded torques and link positions (S, L, n + M) per unit of inertial parameters added to a body.

    ``columns`` hold dynamic parameters [m, m c, I] (10,) in the frame of the joint; inverse dynamics is
    linear in them, so that a response is a difference of two inverse dynamics.
    """

    def added(column: np.ndarray) -> Structure:
        model = structure.model.copy()
        model.inertias[joint] = pin.Inertia.FromDynamicParameters(model.inertias[joint].toDynamicParameters() + column)
        return replace(structure, model=model)

    return torques_of_changes(structure, map(added, columns), plane, group, solution)


def _move(parameters: np.ndarray, placement: pin.SE3) -> np.ndarray:
    """Dynamic parameters (10,) of a body given in a frame at ``placement`` of its joint.

    Works for parameters that are no body by themselves (a first moment without mass).
    """
    if np.allclose(placement.homogeneous, np.eye(4)):
        return parameters
    big = pin.Inertia(1e3, np.zeros(3), 1e3 * np.eye(3)).toDynamicParameters()

    def moved(x: np.ndarray) -> np.ndarray:
        return placement.act(pin.Inertia.FromDynamicParameters(x)).toDynamicParameters()

    return moved(big + parameters) - moved(big)
