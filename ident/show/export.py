"""The extended model for the user: parameters as TOML, the arm as MJCF."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import mujoco
import numpy as np
import pinocchio as pin
import tomlkit

from ident.graybox import build_structure, parameter_unit
from ident.verdict import Cause, Diagnosis
from robot_assets.robot import Elasticity, Robot

TIMESTEP = 2.5e-4
ROTOR_MASS = 1e-3  # kg, of a sphere of 50 mm: a body must have a mass; its inertia is taken off the armature
ROTOR_BODY = 0.4 * ROTOR_MASS * 0.05**2


def write_model_toml(diagnosis: Diagnosis, path: Path) -> None:
    """Parameters of the extended model and its effects, with units."""
    head: dict = {
        "format": "simgap-model/1",
        "robot": diagnosis.robot.name,
        "dataset": diagnosis.verdict.dataset,
        "parameters": {},
        "effect": [],
    }
    for name, value in diagnosis.verdict.baseline.items():
        kind, joint = name.split(".", 1)
        entry = {"value": value.value, "std": value.std, "unit": parameter_unit(name)}
        head["parameters"].setdefault(joint, {})[kind] = entry
    for cause in diagnosis.verdict.causes:
        head["effect"].append(
            {
                "name": cause.effect,
                "place": cause.joint,
                "probability": cause.probability,
                "parameters": {k: {"value": v.value, "std": v.std, "unit": v.unit} for k, v in cause.parameters.items()},
            }
        )
    path.write_text(tomlkit.dumps(head), encoding="utf-8")


def write_mjcf(diagnosis: Diagnosis, path: Path) -> None:
    """MJCF of the extended model."""
    spec = build_mjcf(diagnosis.robot, diagnosis.parameters, diagnosis.verdict.causes)
    spec.compile()
    path.write_text(spec.to_xml(), encoding="utf-8")


def build_mjcf(robot: Robot, parameters: dict[str, float], causes: Sequence[Cause] = ()) -> mujoco.MjSpec:
    """A MuJoCo arm with identified parameters and named effects.

    Bodies are written from the Pinocchio chain. A motor is a rotor beside the chain; a fixed
    tendon of length ``q_motor - q_link`` is its gear. Effects are native elements where MuJoCo has
    them, and all are kept as ``<custom>`` numbers ``simgap.<i>.<effect>.<place>.<parameter>``.

    Args:
        parameters: by the names of ``ident.graybox.parameter_names``.
    """
    hinges = tuple(
        replace(
            h,
            stiffness=parameters.get(f"stiffness.{h.name}", h.stiffness),
            damping=parameters.get(f"damping.{h.name}", h.damping),
        )
        for h in robot.elasticities
    )
    hidden = tuple(_hidden_hinge(c) for c in causes if c.effect.endswith("_elasticity"))
    loads = tuple(_payload(robot, c) for c in causes if c.effect == "payload")
    scales = {c.joint: c.parameters["scale"].value for c in causes if c.effect == "link_inertia"}
    arm = replace(robot, elasticities=hinges)
    structure = build_structure(arm, elasticities=hidden, loads=loads, scale_links=scales)
    spec = mujoco.MjSpec()
    spec.modelname = robot.name
    spec.option.timestep = TIMESTEP
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_RK4
    spec.option.gravity = list(robot.gravity)
    springs = {f"elasticity:{h.name}": h for h in (*hinges, *hidden)}
    _add_bodies(spec, structure.model, springs)
    for joint in robot.joints:
        _add_motor(spec, joint.name, parameters)
    for i, cause in enumerate(causes):
        _add_effect(spec, robot, i, cause, parameters)
    return spec


def _hidden_hinge(cause: Cause) -> Elasticity:
    p = {k: v.value for k, v in cause.parameters.items()}
    axis = (p["axis_x"], p["axis_y"], p["axis_z"])
    return Elasticity(f"{cause.effect}:{cause.joint}", cause.joint, axis, p["stiffness"], p["damping"])


def _payload(robot: Robot, cause: Cause) -> tuple[str, pin.Inertia]:
    p = {k: v.value for k, v in cause.parameters.items()}
    com = np.array([p["com_x"], p["com_y"], p["com_z"]])
    return robot.payload_link, pin.Inertia(p["mass"], com, np.zeros((3, 3)))


def _add_bodies(spec: mujoco.MjSpec, model: pin.Model, springs: dict[str, Elasticity]) -> None:
    bodies = {0: spec.worldbody}
    for i in range(1, model.njoints):
        placement, inertia, name = model.jointPlacements[i], model.inertias[i], model.names[i]
        x, y, z, w = pin.Quaternion(placement.rotation).coeffs()
        body = bodies[model.parents[i]].add_body(
            name=f"body:{name}", pos=placement.translation, quat=[w, x, y, z]
        )
        body.explicitinertial = True
        body.mass = max(float(inertia.mass), 1e-9)
        body.ipos = inertia.lever
        values, axes = np.linalg.eigh(inertia.inertia)
        axes[:, 0] *= np.sign(np.linalg.det(axes))
        x, y, z, w = pin.Quaternion(axes).coeffs()
        body.iquat, body.inertia = [w, x, y, z], np.maximum(values, 1e-12)
        slide = "Prismatic" in model.joints[i].shortname()
        joint = body.add_joint(
            name=name if name in springs else f"link:{name}",
            axis=model.joints[i].extract().axis,
            type=mujoco.mjtJoint.mjJNT_SLIDE if slide else mujoco.mjtJoint.mjJNT_HINGE,
        )
        if name in springs:
            joint.stiffness = [springs[name].stiffness, 0, 0]
            joint.damping = [springs[name].damping, 0, 0]
        bodies[i] = body


def _add_motor(spec: mujoco.MjSpec, name: str, parameters: dict[str, float]) -> None:
    rotor = spec.worldbody.add_body(name=f"rotor:{name}")
    rotor.add_geom(type=mujoco.mjtGeom.mjGEOM_SPHERE, size=[0.05, 0, 0], mass=ROTOR_MASS, contype=0, conaffinity=0, rgba=[0, 0, 0, 0])
    rotor.add_joint(
        name=f"motor:{name}",
        axis=[0, 0, 1],
        armature=max(parameters[f"motor_inertia.{name}"] - ROTOR_BODY, 0.0),
        damping=[parameters[f"viscous_friction.{name}"], 0, 0],
    )
    gear = spec.add_tendon(name=f"gear:{name}")
    gear.wrap_joint(f"motor:{name}", 1.0)
    gear.wrap_joint(f"link:{name}", -1.0)
    gear.stiffness = [parameters[f"stiffness.{name}"], 0, 0]
    gear.damping = [parameters[f"damping.{name}"], 0, 0]
    gear.springlength = [0, 0]
    drive = spec.add_actuator(name=f"drive:{name}", target=f"motor:{name}")
    drive.trntype = mujoco.mjtTrn.mjTRN_JOINT
    drive.set_to_motor()


def _add_effect(spec: mujoco.MjSpec, robot: Robot, index: int, cause: Cause, parameters: dict[str, float]) -> None:
    p = {k: v.value for k, v in cause.parameters.items()}
    for key, value in p.items():
        number = spec.add_numeric(name=f"simgap.{index}.{cause.effect}.{cause.joint}.{key}")
        number.data, number.size = [float(value)], 1
    name = cause.joint
    if name not in robot.joint_names:
        return
    motor, link = spec.joint(f"motor:{name}"), spec.joint(f"link:{name}")
    gear, drive = spec.tendon(f"gear:{name}"), spec.actuator(f"drive:{name}")
    k = parameters[f"stiffness.{name}"]
    if cause.effect == "coulomb_friction":
        motor.frictionloss = p["torque"]
    elif cause.effect in ("stribeck_friction", "presliding_friction"):
        motor.frictionloss = p["coulomb"]
    elif cause.effect == "torque_constant":
        drive.gear = [p["scale"], 0, 0, 0, 0, 0]
    elif cause.effect == "torque_delay":
        drive.delay, drive.nsample = p["delay"], int(np.ceil(p["delay"] / TIMESTEP)) + 2
    elif cause.effect == "torque_lag":
        drive.dyntype = mujoco.mjtDyn.mjDYN_FILTEREXACT
        drive.dynprm = [p["time_constant"], *([0] * (len(drive.dynprm) - 1))]
    elif cause.effect == "torque_saturation":
        drive.forcelimited, drive.forcerange = True, [-p["limit"], p["limit"]]
    elif cause.effect == "hardening_stiffness":
        gear.stiffness = [k, 0, p["cubic"]]
    elif cause.effect == "backlash":
        gear.springlength = [-0.5 * p["gap"], 0.5 * p["gap"]]
    elif cause.effect == "softening_stiffness":
        low = min(p["low_stiffness"], k)
        gear.stiffness = [low, 0, 0]
        outer = spec.add_tendon(name=f"outer:{name}")
        outer.wrap_joint(f"motor:{name}", 1.0)
        outer.wrap_joint(f"link:{name}", -1.0)
        outer.stiffness, outer.springlength = [k - low, 0, 0], [-p["transition"], p["transition"]]
    elif cause.effect == "gravity_spring":
        link.stiffness, link.springref = [p["stiffness"], 0, 0], p["rest_angle"]
    elif cause.effect == "dress_pack":
        link.stiffness, link.frictionloss = [p["stiffness"], 0, 0], p["friction"]
    elif cause.effect == "joint_coupling":
        target = robot.joint_names[robot.joint_names.index(name) + 1]
        spec.tendon(f"gear:{target}").wrap_joint(f"motor:{name}", p["ratio"])
