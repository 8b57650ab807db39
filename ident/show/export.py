"""The extended model for the user: parameters as TOML, the arm as MJCF."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import mujoco
import numpy as np
import pinocchio as pin
import tomlkit

from ident.chain import LinkChange, build_structure
from ident.hypotheses.slips import parallel_slips
from ident.hypotheses.yielding import SLIP
from ident.show.dips import SQUARE, square_dips
from ident.show.slips import maxwell_slips
from ident.simulable import is_sum_of_slips, not_simulated
from ident.units import unit_suffix
from ident.verdict import Cause, Diagnosis
from robot_assets.robot import Elasticity, Robot

TIMESTEP = 2.5e-4  # s, with the Runge-Kutta integrator
FINE_TIMESTEP = 5e-5  # s: for what yields, and for bristles, which upset the stages of Runge-Kutta
MOST_REFINED = 10  # at most this many times finer where a delay or a lag is shorter than a step
BRISTLE = 0.7  # frequency of a bristle that stands for a sign, over the step rate, rad
TIGHT = [0.999, 0.999, 0.001, 0.5, 2.0]  # impedance of dry friction: hardly any creep
NO_INPUT = int(mujoco.mjtCtrlInput.mjINPUT_NONE)
FRICTION_SLIP = "friction"  # begins the names of springs that stand for the friction of a motor or a link
PASSIVE_GROUP = 1  # of actuators without input
MOST_CONSTANT = 0.99  # share of a force of a spring that does not grow with its length
TORQUE_OFFSET = "torque_offset"
FLAT = 1e-5  # of the largest moment of inertia, by which the others are more together
ROTOR_MASS = 1e-3  # kg, of a sphere of 50 mm: a body must have a mass; its inertia is taken off the armature
ROTOR_BODY = 0.4 * ROTOR_MASS * 0.05**2


def write_model_toml(diagnosis: Diagnosis, path: Path) -> None:
    """Parameters of the extended model and its effects, with units, and what of these model.xml does not simulate."""
    head: dict = {
        "format": "simgap-model/1",
        "robot": diagnosis.robot.name,
        "dataset": diagnosis.verdict.dataset,
        "not_simulated": [text for text in map(not_simulated, diagnosis.verdict.causes) if text],
        "parameters": {},
        "effect": [],
    }
    for name, value in diagnosis.verdict.baseline.items():
        kind, joint = name.split(".", 1)
        entry = {
            "value": value.value,
            "std": value.std,
            "unit": value.unit,
            "identified": name not in diagnosis.verdict.unidentified,
        }
        head["parameters"].setdefault(joint, {})[kind] = entry
    for cause in diagnosis.verdict.causes:
        head["effect"].append(
            {
                "name": cause.effect,
                "place": cause.joint,
                "probability": cause.probability,
                "simulated": not not_simulated(cause),
                **({"channel": cause.channel} if cause.channel else {}),
                **({"joints": list(cause.joints)} if cause.joints else {}),
                **({"with_load": True} if cause.with_load else {}),
                "parameters": {
                    k: {"value": v.value, "std": v.std, "unit": v.unit} for k, v in cause.parameters.items()
                },
            }
        )
    path.write_text(tomlkit.dumps(head), encoding="utf-8")


def write_mjcf(diagnosis: Diagnosis, path: Path) -> None:
    """MJCF of the extended model."""
    spec = build_mjcf(diagnosis.robot, diagnosis.parameters, diagnosis.verdict.causes, diagnosis.inertias)
    baseline = diagnosis.verdict.baseline
    offsets = {k.split(".", 1)[1]: v.value for k, v in baseline.items() if k.startswith(f"{TORQUE_OFFSET}.")}
    note_record(spec, diagnosis.timing, diagnosis.roll_off, offsets)
    spec.compile()
    path.write_text(spec.to_xml(), encoding="utf-8")


def build_mjcf(
    robot: Robot,
    parameters: dict[str, float],
    causes: Sequence[Cause] = (),
    inertias: dict[str, pin.Inertia] | None = None,
) -> mujoco.MjSpec:
    """A MuJoCo arm with identified parameters and named effects.

    Bodies are written from the Pinocchio chain. A motor is a rotor beside the chain; a fixed
    tendon of length ``q_motor - q_link`` is its gear. Effects are native elements where MuJoCo has
    them (``ident.simulable`` says of which it has none). All are kept as ``<custom>`` numbers
    ``simgap.<i>.<effect>.<place>.<parameter>`` and a text ``simgap.effect.<i>`` that says which elements stand for the
    effect, if any. Delays, lags, friction and what yields hold under the time step and the integrator of the file;
    others need not.

    Args:
        parameters: by the names of ``ident.graybox.parameter_names``, and ``link_friction.<joint>`` where links have
            some.
        inertias: of bodies by joint of the description, instead of those of the description.
    """
    hinges = tuple(
        replace(
            h,
            stiffness=parameters.get(f"stiffness.{h.name}", h.stiffness),
            damping=parameters.get(f"damping.{h.name}", h.damping),
        )
        for h in robot.elasticities
    )
    hidden = tuple(_hidden_hinge(i, c) for i, c in enumerate(causes) if c.effect.endswith("_elasticity"))
    loads = tuple(_payload(robot, c) for c in causes if c.effect == "payload")
    links = {c.joint: _link_change(c) for c in causes if c.effect == "link_inertia"}
    arm = replace(robot, elasticities=hinges)
    structure = build_structure(arm, elasticities=hidden, loads=loads, links=links, inertias=inertias)
    spec = mujoco.MjSpec()
    spec.modelname = robot.name
    spec.compiler.degree = False  # else angles such as springref are taken as degrees
    fastest = max(parameters[f"damping.{name}"] / parameters[f"motor_inertia.{name}"] for name in robot.joint_names)
    spec.option.timestep, spec.option.integrator = _stepping(causes, fastest)
    spec.option.gravity = list(robot.gravity)
    springs = {f"elasticity:{h.name}": h for h in (*hinges, *hidden)}
    _add_bodies(spec, structure.model, springs)
    for joint in robot.joints:
        _add_motor(spec, joint.name, parameters)
        spec.joint(f"link:{joint.name}").damping = [parameters.get(f"link_friction.{joint.name}", 0.0), 0, 0]
    for i, cause in enumerate(causes):
        if cause.joint in robot.joint_names:
            _add_effect(spec, i, cause)
        _note_effect(spec, i, cause, _turned(robot, cause))
    for (source, target), ratio in _couplings(robot, causes).items():
        slips = [f"slip:{i}." for i, c in enumerate(causes) if c.effect == "hysteresis" and c.joint == target]
        for tendon in spec.tendons:
            if tendon.name in (f"gear:{target}", f"outer:{target}") or tendon.name.startswith(tuple(slips)):
                tendon.wrap_joint(f"motor:{source}", ratio)
    return spec


def _hidden_hinge(index: int, cause: Cause) -> Elasticity:
    p = {k: v.value for k, v in cause.parameters.items()}
    axis = (p["axis_x"], p["axis_y"], p["axis_z"])
    name = f"{cause.effect}:{cause.joint}:{index}"
    return Elasticity(name, cause.joint, axis, p["stiffness"], p["damping"], before="before" in p)


def _payload(robot: Robot, cause: Cause) -> tuple[str, pin.Inertia]:
    p = {k: v.value for k, v in cause.parameters.items()}
    com = np.array([p["com_x"], p["com_y"], p["com_z"]])
    own = np.diag([p.get(f"inertia_{i}", 0.0) for i in "xyz"])
    return robot.payload_link, pin.Inertia(p["mass"], com, own)


def _link_change(cause: Cause) -> LinkChange:
    p = {k: v.value for k, v in cause.parameters.items()}
    return LinkChange(p["mass"], (p["com_x"], p["com_y"], p["com_z"]), p["inertia"], cause.with_load)


def _of_a_body(moments: np.ndarray) -> np.ndarray:
    """The nearest principal moments of inertia, ascending (3,) kg m2, that a body can have: the largest is no more than
    the sum of the others, with a margin for the digits of the file.

    A flat body has that sum itself, and rounding passes it; MuJoCo takes no such body.
    """
    beyond = (1.0 + FLAT) * moments[2] - moments[:2].sum()
    return moments + max(beyond, 0.0) / 3.0 * np.array([1.0, 1.0, -1.0])


def _add_bodies(spec: mujoco.MjSpec, model: pin.Model, springs: dict[str, Elasticity]) -> None:
    bodies = {0: spec.worldbody}
    for i in range(1, model.njoints):
        placement, inertia, name = model.jointPlacements[i], model.inertias[i], model.names[i]
        x, y, z, w = pin.Quaternion(placement.rotation).coeffs()
        body = bodies[model.parents[i]].add_body(name=f"body:{name}", pos=placement.translation, quat=[w, x, y, z])
        body.explicitinertial = True
        body.mass = max(float(inertia.mass), 1e-9)
        body.ipos = inertia.lever
        values, axes = np.linalg.eigh(inertia.inertia)
        axes[:, 0] *= np.sign(np.linalg.det(axes))
        x, y, z, w = pin.Quaternion(axes).coeffs()
        body.iquat, body.inertia = [w, x, y, z], _of_a_body(np.maximum(values, 1e-12))
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
        if np.linalg.norm(placement.translation) > 0.02 and model.parents[i]:
            _add_bone(bodies[model.parents[i]], placement.translation)


def _add_bone(body: mujoco.MjsBody, end: np.ndarray) -> None:
    """A capsule from a joint to the next, for the eye alone: no mass, no contact."""
    body.add_geom(
        type=mujoco.mjtGeom.mjGEOM_CAPSULE,
        fromto=[0, 0, 0, *end],
        size=[0.03, 0, 0],
        mass=0,
        contype=0,
        conaffinity=0,
        group=2,
        rgba=[0.67, 0.7, 0.73, 1],
    )


def _add_motor(spec: mujoco.MjSpec, name: str, parameters: dict[str, float]) -> None:
    rotor = spec.worldbody.add_body(name=f"rotor:{name}")
    rotor.add_geom(
        type=mujoco.mjtGeom.mjGEOM_SPHERE,
        size=[0.05, 0, 0],
        mass=ROTOR_MASS,
        contype=0,
        conaffinity=0,
        rgba=[0, 0, 0, 0],
    )
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


ELEMENTS = {
    "torque_constant": "gear of drive:{place}",
    "torque_delay": "delay of drive:{place}",
    "torque_saturation": "forcerange of drive:{place}",
    "hardening_stiffness": "cubic stiffness of gear:{place}",
    "softening_stiffness": "stiffness of gear:{place} and, beyond the transition, outer:{place}",
    "backlash": "springlength of gear:{place}",
    "joint_coupling": "motor:{place} in gear:{turned}",
    "payload": "inertia of the body that carries it",
    "link_inertia": "inertia of the body",
    "transverse_elasticity": "hinge elasticity:{effect}:{place}:{index}",
    "base_elasticity": "hinge elasticity:{effect}:{place}:{index}",
}
"""What of the arm stands for an effect that has no element of its own."""


def _element(spec: mujoco.MjSpec, index: int, cause: Cause, turned: str) -> str:
    """Which elements of the file stand for an effect.

    Args:
        turned: joint that a coupled one turns too.
    """
    named = re.compile(rf"(passive|slip|friction|spring|encoder):{index}(\..+)?")
    own = [x.name for x in (*spec.actuators, *spec.tendons, *spec.sensors) if named.fullmatch(x.name)]
    p = {k: v.value for k, v in cause.parameters.items()}
    shared = ELEMENTS.get(cause.effect, "").format(place=cause.joint, effect=cause.effect, index=index, turned=turned)
    if cause.effect == "coulomb_friction" and "stiffness" not in p:
        shared = f"frictionloss of motor:{cause.joint}"
    elif cause.effect == "torque_lag":
        lag, late = lag_and_delay(p)
        parts = [name for name, x in (("filter of first order", lag), ("delay", late)) if x > 0.0]
        shared = f"{' and '.join(parts)} of drive:{cause.joint}"
    elif cause.effect in ("gravity_spring", "dress_pack") and "stretch" not in p:
        rubs = " and frictionloss" if p.get("friction", 0.0) > 0.0 and "yield_angle" not in p else ""
        shared = f"spring{rubs} of link:{cause.joint}"
    lost = not_simulated(cause)
    there = ", ".join([shared] * bool(shared) + own)
    if not there:
        return "none: not simulated by this file"
    return f"{there}; not simulated: {lost}" if lost else there


def _note_effect(spec: mujoco.MjSpec, index: int, cause: Cause, turned: str) -> None:
    """The effect as custom elements, whether or not MuJoCo has an element for it; ``turned`` as of ``_element``."""
    for key, x in cause.parameters.items():
        number = spec.add_numeric(name=f"simgap.{index}.{cause.effect}.{cause.joint}.{key}")
        number.data, number.size = [float(x.value)], 1
    values = ", ".join(f"{k} = {x.value:.6g} +- {x.std:.2g}{unit_suffix(x.unit)}" for k, x in cause.parameters.items())
    text = spec.add_text(name=f"simgap.effect.{index}")
    text.data = f"{cause.effect} at {cause.joint}, probability {cause.probability:.3f}; {values}; element: " + _element(
        spec, index, cause, turned
    )


def _turned(robot: Robot, cause: Cause) -> str:
    """The joint that a coupled one turns too: the next one where the cause does not say which; empty of others."""
    if cause.effect != "joint_coupling":
        return ""
    return cause.joints[-1] if cause.joints else robot.joint_names[robot.joint_names.index(cause.joint) + 1]


def _couplings(robot: Robot, causes: Sequence[Cause]) -> dict[tuple[str, str], float]:
    """(motor, joint that it turns too) -> ratio; a tendon takes a joint once."""
    out: dict[tuple[str, str], float] = {}
    for c in causes:
        if c.effect == "joint_coupling":
            pair = (c.joint, _turned(robot, c))
            out[pair] = out.get(pair, 0.0) + c.parameters["ratio"].value
    return out


def _stepping(causes: Sequence[Cause], fastest: float) -> tuple[float, mujoco.mjtIntegrator]:
    """Time step (s) and integrator under which the elements of the effects hold.

    ``fastest`` is the rate at which a damper stops a rotor, 1/s: beyond the step rate it is for the implicit
    integrator. The force of a bristle in the inner stages of Runge-Kutta runs away where it relaxes within a step
    and its level changes with velocity; the implicit integrator has no such stages. How far a spring has yielded is
    kept once a step, whatever the stages saw of it: of a friction that yields this is the larger error, so that it is
    for the implicit integrator too, and in a gear the smaller one beside what an integrator of first order makes of the
    gear's spring. Both shrink with the step. A filter is stable with Runge-Kutta, and a delay read from past samples
    alone, where they last longer than a step.
    """
    yielding = {c.effect for c in causes if _slips(c)}
    if fastest * TIMESTEP > 1.0 or yielding - {"hysteresis"} or any(c.effect == "stribeck_friction" for c in causes):
        return FINE_TIMESTEP, mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    parts = [TIMESTEP / FINE_TIMESTEP - 1e-9 if yielding else 1.0]
    for c in causes:
        if c.effect == "torque_delay":
            parts.append(1.5 * TIMESTEP / c.parameters["delay"].value)
        elif c.effect == "torque_lag":
            lag, late = lag_and_delay({name: value.value for name, value in c.parameters.items()})
            parts += [steps * TIMESTEP / time for steps, time in ((1.0, lag), (1.5, late)) if time > 0.0]
    return TIMESTEP / min(int(np.ceil(max(parts))), MOST_REFINED), mujoco.mjtIntegrator.mjINT_RK4


def lag_and_delay(p: Mapping[str, float]) -> tuple[float, float]:
    """Time constant of a filter of first order and the delay beside it that a ``torque_lag`` is up to the second power
    of frequency, s; the delay is below nought where it comes sooner. One of second order that hardly loses gain is a
    delay alone, and a delay far below a step a part of the lag."""
    late_by, square = p["time_constant"] * (1.0 + p.get("stepped", 0.0)), p.get("square", 0.0)
    lag = p["time_constant"] * np.sqrt(max(1.0 - 2.0 * square, 0.0))
    if square and lag < TIMESTEP:
        return 0.0, late_by
    delay = late_by - lag
    return (late_by, 0.0) if 0.0 < delay < TIMESTEP / MOST_REFINED else (lag, delay)


def stage_lead(timestep: float, integrator: int) -> float:
    """Time by which a step sees an input on average ahead of its beginning, s.

    Runge-Kutta reads a delayed input at the times of its stages, half a step late on average, where the
    true input is held over the step.
    """
    return 0.5 * timestep if integrator == mujoco.mjtIntegrator.mjINT_RK4 else 0.0


def note_record(spec: mujoco.MjSpec, timing: float, roll_off: float, offsets: dict[str, float]) -> None:
    """What the recorded torque has beyond that of the motors: numbers ``simgap.record.*``.

    Args:
        timing: delay of the torque against its record that the hold does not explain, s.
        roll_off: what the record loses towards high frequencies, s2.
        offsets: constant errors of the recorded torque by joint, N m.
    """
    errors = {f"{TORQUE_OFFSET}.{k}": v for k, v in offsets.items()}
    for key, value in {"timing": timing, "roll_off": roll_off, **errors}.items():
        if value:
            number = spec.add_numeric(name=f"simgap.record.{key}")
            number.data, number.size = [float(value)], 1


def _add_effect(spec: mujoco.MjSpec, index: int, cause: Cause) -> None:
    """Native elements of an effect at a joint, on top of those of effects before it."""
    p = {k: v.value for k, v in cause.parameters.items()}
    name = cause.joint
    motor, link = spec.joint(f"motor:{name}"), spec.joint(f"link:{name}")
    gear, drive = spec.tendon(f"gear:{name}"), spec.actuator(f"drive:{name}")
    step = spec.option.timestep
    if cause.effect == "coulomb_friction" and "stiffness" not in p:
        _add_friction(motor, p["torque"], step, p.get("lead", 0.0))
        bias = p["torque"] * p.get("asymmetry", 0.0)
        if bias:
            _add_passive(spec, index, name, cogging=[-bias, 0.0, 0.5 * np.pi])
    elif cause.effect == "stribeck_friction":
        stiffest, levels = motor.armature * (BRISTLE / step) ** 2, (p["coulomb"], max(p["static"], p["coulomb"]))
        stiffness = min(p.get("stiffness", np.inf), stiffest)
        damping = stiffness * p.get("relaxation", 0.0)
        dips = square_dips(p["stribeck_velocity"], p.get("exponent", SQUARE))
        for part, (share, velocity) in enumerate(dips):
            bristle = [share * stiffness, share * damping, *(share * level for level in levels), velocity]
            _add_passive(spec, f"{index}.{part}" if part else index, name, lugre=bristle)
    elif cause.effect in ("presliding_friction", "coulomb_friction"):
        if slips := _slips(cause):
            _add_slips(spec, f"{FRICTION_SLIP}:{index}", slips, {f"motor:{name}": 1.0})
        else:
            limit = p["coulomb"] if cause.effect == "presliding_friction" else p["torque"]
            damping = p["stiffness"] * p.get("relaxation", 0.0)
            _add_passive(spec, index, name, lugre=[p["stiffness"], damping, limit, limit, 1.0])
    elif cause.effect == "cogging":
        _add_passive(spec, index, name, cogging=[p["amplitude"], p["periods_per_rev"], p.get("phase", 0.0)])
        sine, cosine = (p.get(f"second_{part}", 0.0) for part in ("sine", "cosine"))
        if sine or cosine:
            size, phase = float(np.hypot(sine, cosine)), float(np.arctan2(cosine, sine))
            twice = [p["amplitude"] * size, 2.0 * p["periods_per_rev"], phase]
            _add_passive(spec, f"{index}.second", name, cogging=twice)
    elif cause.effect == "torque_constant":
        drive.gear = [drive.gear[0] * p["scale"], 0, 0, 0, 0, 0]
    elif cause.effect == "torque_delay":
        _add_delay(drive, p["delay"], spec.option)
    elif cause.effect == "torque_lag":
        lag, late = lag_and_delay(p)
        if lag > 0.0:
            exact = spec.option.integrator != mujoco.mjtIntegrator.mjINT_RK4
            drive.dyntype = mujoco.mjtDyn.mjDYN_FILTEREXACT if exact else mujoco.mjtDyn.mjDYN_FILTER
            drive.dynprm = [lag + min(late, 0.0), *([0] * (len(drive.dynprm) - 1))]
        if late > 0.0:
            _add_delay(drive, late, spec.option)
    elif cause.effect == "torque_saturation":
        drive.forcelimited, drive.forcerange = True, [-p["limit"], p["limit"]]
    elif cause.effect == "hardening_stiffness":
        gear.stiffness = [gear.stiffness[0], 0, gear.stiffness[2] + p["cubic"]]
    elif cause.effect == "backlash":
        gear.springlength = [-0.5 * p["gap"], 0.5 * p["gap"]]
    elif cause.effect == "softening_stiffness":
        k = float(gear.stiffness[0])
        low = min(p["low_stiffness"], k)
        gear.stiffness = [low, 0, gear.stiffness[2]]
        _add_parallel(spec, f"outer:{name}", name, k - low, p["transition"])
    elif cause.effect == "hysteresis":
        _add_slips(spec, f"slip:{index}", _slips(cause), {f"motor:{name}": 1.0, f"link:{name}": -1.0})
    elif cause.effect in ("gravity_spring", "dress_pack"):
        if "stretch" in p:
            _add_spring_between_points(spec, f"spring:{index}", link, p)
        else:
            _add_spring(link, p["stiffness"], p.get("rest_angle", 0.0))
        if slips := _slips(cause):
            _add_slips(spec, f"{FRICTION_SLIP}:{index}", slips, {f"link:{name}": 1.0})
        elif p.get("friction", 0.0) > 0:
            _add_friction(link, p["friction"], step, p.get("lead", 0.0))
    elif cause.effect == "sensor_delay":
        side = "link" if cause.channel == "q_link" else "motor"
        sensor = spec.add_sensor(name=f"encoder:{index}", type=mujoco.mjtSensor.mjSENS_JOINTPOS)
        sensor.objtype, sensor.objname = mujoco.mjtObj.mjOBJ_JOINT, f"{side}:{name}"
        sensor.delay, sensor.interp = p["delay"], 1
        sensor.nsample = int(np.ceil(p["delay"] / step)) + 2


def _add_delay(drive: mujoco.MjsActuator, delay: float, option: mujoco.MjOption) -> None:
    """A delay of a torque, s, linear between past steps: over one in which the input changes it delivers the mean. The
    first of a drive makes up for what its stages see ahead."""
    drive.delay += delay + (0.0 if drive.delay else stage_lead(option.timestep, option.integrator))
    drive.interp, drive.nsample = 1, int(np.ceil(drive.delay / option.timestep)) + 2


def _add_friction(joint: mujoco.MjsJoint, torque: float, step: float, lead: float = 0.0) -> None:
    """Dry friction that turns as sharply as the step allows, or ``lead`` s before the velocity does; by MuJoCo's default
    it is 0.01 s."""
    joint.frictionloss += torque
    joint.solref_friction, joint.solimp_friction = [2.0 * max(step, lead / TIGHT[1]), 1.0], TIGHT


def _add_passive(spec: mujoco.MjSpec, index: int | str, joint: str, **parts: list[float]) -> None:
    """A motor without windings or input: its cogging or its bristle (LuGre) alone acts on the joint.

    Cogging of no periods is a constant torque.
    """
    passive = spec.add_actuator(name=f"passive:{index}", target=f"motor:{joint}")
    passive.trntype, passive.group = mujoco.mjtTrn.mjTRN_JOINT, PASSIVE_GROUP
    passive.set_to_dcmotor(motorconst=[0.0, 0.0], resistance=1.0, ctrlspec=NO_INPUT, **parts)


def _add_parallel(spec: mujoco.MjSpec, name: str, joint: str, stiffness: float, free: float) -> mujoco.MjsTendon:
    """A spring beside the gear of a joint with a dead band of ``free`` rad on either side."""
    spring = spec.add_tendon(name=name)
    spring.wrap_joint(f"motor:{joint}", 1.0)
    spring.wrap_joint(f"link:{joint}", -1.0)
    spring.stiffness, spring.springlength = [stiffness, 0, 0], [-free, free]
    return spring


def _add_spring_between_points(spec: mujoco.MjSpec, name: str, joint: mujoco.MjsJoint, p: Mapping[str, float]) -> None:
    """A tendon from a point of the link to one before its joint, as ``link_springs.spring_between_points`` describes.

    Their distances from the axis are chosen: the torque says their ratio alone. A force that does not grow with the
    length is that of a spring which is slack there, or of a further part of the tendon that does not move.
    """
    far, share = 1.0, min(p["constant_share"], MOST_CONSTANT)
    near = _nearer(p["stretch"]) * far
    ratio = p["stiffness"] / (near * far)
    axis = np.asarray(joint.axis) / np.linalg.norm(joint.axis)
    across = np.cross(axis, np.eye(3)[np.argmin(np.abs(axis))])
    across /= np.linalg.norm(across)
    body = joint.parent
    placed = pin.SE3(pin.Quaternion(*body.quat).matrix(), np.asarray(body.pos))
    at_rest = pin.AngleAxis(p["rest_angle"], axis).matrix() @ across
    body.add_site(name=f"{name}.link", pos=near * across)
    before = placed.act(far * at_rest)
    body.parent.add_site(name=f"{name}.before", pos=before)
    spring = spec.add_tendon(name=name, rgba=[0, 0, 0, 0])
    force_over_stiffness = share * (far - near) / (1.0 - share)
    if share > 0.0:
        body.parent.add_site(name=f"{name}.end", pos=before + placed.rotation @ (force_over_stiffness * axis))
        spring.wrap_site(f"{name}.end")
    spring.wrap_site(f"{name}.before")
    spring.wrap_site(f"{name}.link")
    spring.stiffness = [ratio * (1.0 - share), 0, 0]
    spring.springlength = [max(-force_over_stiffness, 0.0)] * 2


def _nearer(stretch: float) -> float:
    """Smaller over larger distance ``r`` of two points from an axis, of a ``stretch`` of ``2 r / (1 - r)^2``."""
    half = 1.0 + 1.0 / stretch
    return float(half - np.sqrt(half**2 - 1.0))


def _slips(cause: Cause) -> list[tuple[float, float]]:
    """Stiffness (N m/rad) and yield torque (N m) of the springs that an effect is written as; none of one that is not.

    A friction that yields is the bristle that MuJoCo has, unless it is sharper or a sum of slips.
    """
    p = {k: v.value for k, v in cause.parameters.items()}
    if cause.effect == "hysteresis":
        return maxwell_slips(p["stiffness"], p["yield_torque"], p.get("exponent", SLIP), p.get("recoil", 0.0))
    if cause.effect == "dress_pack":
        return [(p["friction"] / p["yield_angle"], p["friction"])] if "yield_angle" in p else []
    if cause.effect not in ("presliding_friction", "coulomb_friction") or "stiffness" not in p:
        return []
    limit = p["coulomb"] if cause.effect == "presliding_friction" else p["torque"]
    if "spread" in p:
        each, limits = parallel_slips(p["stiffness"], limit, p["spread"])
        return [(each, x) for x in limits]
    return maxwell_slips(p["stiffness"], limit, p["exponent"], 1.0) if is_sum_of_slips(cause) else []


def _add_slips(spec: mujoco.MjSpec, name: str, slips: Sequence[tuple[float, float]], along: dict[str, float]) -> None:
    """Springs that yield, each of a stiffness (N m/rad) up to a torque (N m), along a sum of joints."""
    for i, (stiffness, limit) in enumerate(slips):
        slip = spec.add_tendon(name=f"{name}.{i}")
        for joint, share in along.items():
            slip.wrap_joint(joint, share)
        slip.stiffness, slip.springlength, slip.springyield = [stiffness, 0, 0], [0, 0], limit / stiffness


def _add_spring(joint: mujoco.MjsJoint, stiffness: float, rest: float) -> None:
    """A spring in parallel with the one that the joint has."""
    own = float(joint.stiffness[0])
    total = own + stiffness
    if total > 0:
        joint.springref = (own * joint.springref + stiffness * rest) / total
        joint.stiffness = [total, 0, 0]
