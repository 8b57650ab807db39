"""Robot and effects to a compiled MuJoCo model.

Every driven joint is a hinge of the chain (``link:<joint>``) and a rotor beside the chain
(``motor:<joint>``) that turns about its own axis only; a fixed tendon of length
``q_motor - q_link`` is the gear: its native stiffness and damping act on both.
"""

from __future__ import annotations

import xml.etree.ElementTree as ET
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import wraps
from typing import ParamSpec, TypeVar

import mujoco
import numpy as np
from scipy.spatial.transform import Rotation

from robot_assets.errors import DataError
from robot_assets.robot import Elasticity, Robot

Arguments = ParamSpec("Arguments")
Result = TypeVar("Result")

REST_STEPS = 100
SHORTEST_STEP, LONGEST_STEP = 1e-5, 2.5e-4  # s, about
RESOLVED = 1.0  # rad, phase of the fastest mode in a step: Runge-Kutta is unstable from 2.8 on
DRIVE_FIELDS = ("stiffness", "damping", "motor_inertia", "viscous_friction")


def without_engine_log(function: Callable[Arguments, Result]) -> Callable[Arguments, Result]:
    """Keeps the engine from writing its warnings to the terminal and to a file where the user stands."""

    @wraps(function)
    def quiet(*args: Arguments.args, **kwargs: Arguments.kwargs) -> Result:
        config = mujoco.MjLogConfig.get()
        before = config.logto_console, config.logto_file
        config.logto_console = config.logto_file = False
        mujoco.MjLogConfig.set(config)
        try:
            return function(*args, **kwargs)
        finally:
            config.logto_console, config.logto_file = before
            mujoco.MjLogConfig.set(config)

    return quiet


@dataclass(frozen=True)
class Plant:
    """A compiled arm and where its coordinates stand.

    Attributes:
        model: MuJoCo model.
        motor, link: (n,) addresses of motor and link coordinates in qpos and qvel alike.
        hinges: (n_e,) addresses of the elastic hinges.
        drives: the true drive figures, each (n,).
        effects: what is hidden in it.
    """

    model: mujoco.MjModel
    motor: np.ndarray
    link: np.ndarray
    hinges: np.ndarray
    drives: dict[str, np.ndarray]
    robot: Robot
    effects: tuple

    def tendon(self, joint: int) -> int:
        """Id of a joint's gear."""
        return self.model.tendon(f"gear:{self.robot.joint_names[joint]}").id


def build_plant(
    robot: Robot,
    effects: Sequence = (),
    *,
    drives: dict[str, np.ndarray] | None = None,
    timestep: float = 2.5e-4,
    integrator: str = "RK4",
) -> Plant:
    """Compile an arm.

    Args:
        drives: true values of ``DRIVE_FIELDS``, each (n,); nominal where absent.
        timestep: s. integrator: of ``mujoco.mjtIntegrator``.
    """
    figures, hinges = _figures(robot, drives), _hinges(robot, effects)
    model = build_spec(robot, effects, drives=drives, timestep=timestep, integrator=integrator).compile()

    def address(name: str) -> int:
        return int(model.joint(name).qposadr[0])

    return Plant(
        model=model,
        motor=np.array([address(f"motor:{name}") for name in robot.joint_names]),
        link=np.array([address(f"link:{name}") for name in robot.joint_names]),
        hinges=np.array([address(f"hinge:{h.name}") for h in hinges], int),
        drives=figures,
        robot=robot,
        effects=tuple(effects),
    )


def build_spec(
    robot: Robot,
    effects: Sequence = (),
    *,
    drives: dict[str, np.ndarray] | None = None,
    timestep: float = 2.5e-4,
    integrator: str = "RK4",
) -> mujoco.MjSpec:
    """What ``build_plant`` compiles, for those who add to it; arguments as there."""
    figures = _figures(robot, drives)
    spec = mujoco.MjSpec()
    spec.compiler.degree = False
    spec.option.timestep = timestep
    spec.option.integrator = getattr(mujoco.mjtIntegrator, f"mjINT_{integrator}")
    spec.option.gravity = list(robot.gravity)
    # A simulation that diverges is to be seen as one, not begun anew.
    spec.option.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONTACT | mujoco.mjtDisableBit.mjDSBL_AUTORESET
    _add_chain(spec, robot, _hinges(robot, effects))
    for j, joint in enumerate(robot.joints):
        _add_drive(spec, joint.name, {f: figures[f][j] for f in DRIVE_FIELDS})
    # What a motor turns besides joins all springs of that gear, whichever effect adds them.
    for effect in sorted(effects, key=lambda e: getattr(e, "name", "") == "joint_coupling"):
        edit = getattr(effect, "edit", None)
        if edit is not None:
            edit(spec, robot, figures)
    return spec


def _figures(robot: Robot, drives: dict[str, np.ndarray] | None) -> dict[str, np.ndarray]:
    return {f: robot.array(f) for f in DRIVE_FIELDS} | dict(drives or {})


def _hinges(robot: Robot, effects: Sequence) -> list[Elasticity]:
    """Of the arm and of effects.

    Raises:
        DataError: where two turn about one axis: what turns between them would have no inertia.
    """
    hinges = list(robot.elasticities)
    for effect in effects:
        for new in getattr(effect, "hinges", lambda: ())():
            for old in hinges:
                if (old.joint, old.before) == (new.joint, new.before) and _parallel(old.axis, new.axis):
                    raise DataError("axis", new.name, f"that of the elasticity {old.name}", "an axis across it")
            hinges.append(new)
    return hinges


def _parallel(a: Sequence[float], b: Sequence[float]) -> bool:
    return float(np.linalg.norm(np.cross(a, b))) < 1e-6 * float(np.linalg.norm(a) * np.linalg.norm(b))


@without_engine_log
def fastest_rate(plant: Plant) -> float:
    """Magnitude of the fastest eigenvalue of the arm at its zero position, springs and dampers linear, rad/s; infinite
    where it has none."""
    model, data, nv = plant.model, mujoco.MjData(plant.model), plant.model.nv
    mujoco.mj_forward(model, data)
    M = np.zeros((nv, nv))
    mujoco.mj_fullM(model, data, M)
    along = np.zeros((model.ntendon, nv))
    for j in range(plant.robot.n):
        along[plant.tendon(j), [plant.motor[j], plant.link[j]]] = 1.0, -1.0
    K = along.T * model.tendon_stiffness @ along + np.diag(model.jnt_stiffness)
    D = along.T * model.tendon_damping @ along + np.diag(model.dof_damping)
    try:
        forces = np.linalg.solve(M, np.hstack([K, D]))
        return float(np.abs(np.linalg.eigvals(np.block([[np.zeros((nv, nv)), np.eye(nv)], [-forces]]))).max())
    except np.linalg.LinAlgError:  # huge figures
        return np.inf


def time_step(plant: Plant, sample_rate: float) -> float:
    """Step of the integration that suits an arm, a whole fraction of the sample time, s."""
    rate = np.clip(fastest_rate(plant) / RESOLVED, 1.0 / LONGEST_STEP, 1.0 / SHORTEST_STEP)  # steps a second, at least
    return 1.0 / (sample_rate * float(np.ceil(rate / sample_rate - 1e-9)))


def link_inertia_diagonal(plant: Plant, q: np.ndarray) -> np.ndarray:
    """(n,) inertia that each motor moves in a posture with stiff gears, its own included, kg m2."""
    data = mujoco.MjData(plant.model)
    data.qpos[plant.link] = q
    mujoco.mj_forward(plant.model, data)
    M = np.zeros((plant.model.nv, plant.model.nv))
    mujoco.mj_fullM(plant.model, data, M)
    return np.diag(M)[plant.link] + plant.drives["motor_inertia"]


def free_inertia(plant: Plant, qpos: np.ndarray) -> np.ndarray:
    """(S, nv) inertia that a torque at each coordinate meets with all others free, in each state (S, nq), kg m2."""
    data, nv = mujoco.MjData(plant.model), plant.model.nv
    out, unit = np.empty((len(qpos), nv)), np.eye(nv)
    for i, x in enumerate(qpos):
        data.qpos[:] = x
        mujoco.mj_forward(plant.model, data)
        moved = np.empty((nv, nv))
        mujoco.mj_solveM(plant.model, data, moved, unit)
        out[i] = 1.0 / np.diag(moved)
    return out


def gravity_torque(plant: Plant, q: np.ndarray) -> np.ndarray:
    """(n,) torque that holds the links at rest in a posture, stiff gears, N m."""
    data = mujoco.MjData(plant.model)
    data.qpos[plant.link] = q
    data.qpos[plant.motor] = q
    mujoco.mj_forward(plant.model, data)
    return (data.qfrc_bias - data.qfrc_passive)[plant.link]


@without_engine_log
def rest(plant: Plant, q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """State at rest with the motors at ``q`` (n,): (qpos, holding torque at the motors).

    Newton on the passive and bias forces, by differences, with a pull back to the last iterate that
    fades: in the dead band of a gear there is no slope to follow.
    """
    model, data = plant.model, mujoco.MjData(plant.model)
    free = np.concatenate([plant.link, plant.hinges]).astype(int)
    x = np.zeros(model.nq)
    x[plant.motor] = q
    x[plant.link] = q
    n_e = len(plant.hinges)
    pull = np.concatenate([plant.drives["stiffness"], np.full(n_e, plant.drives["stiffness"].mean())]) * 1e-2

    def force(x: np.ndarray) -> np.ndarray:
        data.qpos[:] = x
        data.qvel[:] = 0.0
        mujoco.mj_forward(model, data)
        return data.qfrc_passive - data.qfrc_bias

    for _ in range(REST_STEPS):
        f = force(x)[free]
        J = np.empty((len(free), len(free)))
        for c, k in enumerate(free):
            moved = x.copy()
            moved[k] += 1e-7
            J[:, c] = (force(moved)[free] - f) / 1e-7
        step = np.linalg.lstsq(J - np.diag(pull), -f, rcond=1e-14)[0]
        x[free] += np.clip(step, -0.05, 0.05)
        pull = 0.7 * pull
        if np.abs(step).max() < 1e-12:
            break
    return x, -force(x)[plant.motor]


def _add_drive(spec: mujoco.MjSpec, name: str, figures: dict[str, float]) -> None:
    rotor = spec.worldbody.add_body(name=f"rotor:{name}")
    rotor.explicitinertial = True
    rotor.mass, rotor.inertia = 1e-6, [1e-10] * 3
    rotor.add_joint(
        name=f"motor:{name}",
        axis=[0, 0, 1],
        armature=float(figures["motor_inertia"]),
        damping=[float(figures["viscous_friction"]), 0, 0],
    )
    gear = spec.add_tendon(name=f"gear:{name}")
    gear.wrap_joint(f"motor:{name}", 1.0)
    gear.wrap_joint(f"link:{name}", -1.0)
    gear.stiffness = [float(figures["stiffness"]), 0, 0]
    gear.damping = [float(figures["damping"]), 0, 0]
    gear.springlength = [0, 0]


def _add_chain(spec: mujoco.MjSpec, robot: Robot, hinges: Sequence[Elasticity]) -> None:
    root = ET.parse(robot.urdf).getroot()
    links = {e.attrib["name"]: e for e in root.findall("link")}
    joints = root.findall("joint")
    children: dict[str, list[ET.Element]] = {}
    for joint in joints:
        children.setdefault(_link_at(joint, "parent"), []).append(joint)
    base = set(links) - {_link_at(joint, "child") for joint in joints}
    loads: dict[str, list] = {}
    for load in robot.loads:
        loads.setdefault(load.link, []).append(load)

    def add(body: mujoco.MjsBody, link: str) -> None:
        _set_inertia(body, links[link])
        for i, load in enumerate(loads.get(link, [])):
            _add_mass(body, f"load:{link}:{i}", load.mass, load.com, load.inertia)
        for joint in children.get(link, []):
            name, kind = joint.attrib["name"], joint.get("type")
            child = _link_at(joint, "child")
            R, p = _origin(joint)
            axis = _numbers(joint.find("axis"), "xyz", "1 0 0")
            if kind != "fixed" and name not in robot.joint_names:
                if name not in robot.locked:
                    raise DataError("joint", str(robot.folder), f"{name} neither driven nor locked", "a [locked] entry")
                value = robot.locked[name]
                if kind == "prismatic":
                    p = p + R.apply(axis * value)
                else:
                    R = R * Rotation.from_rotvec(axis / np.linalg.norm(axis) * value)
            part = body.add_body(name=f"body:{child}", pos=p, quat=_quat(R))
            if name in robot.joint_names:
                _add_hinges(part, [h for h in hinges if h.joint == name and h.before])
                slide = kind == "prismatic"
                part.add_joint(
                    name=f"link:{name}",
                    axis=axis,
                    type=mujoco.mjtJoint.mjJNT_SLIDE if slide else mujoco.mjtJoint.mjJNT_HINGE,
                )
                _add_hinges(part, [h for h in hinges if h.joint == name and not h.before])
            add(part, child)

    bottom = spec.worldbody
    if any(h.joint == "base" for h in hinges):
        bottom = spec.worldbody.add_body(name="base")
        _add_hinges(bottom, [h for h in hinges if h.joint == "base"])
    for link in sorted(base):
        if bottom is spec.worldbody:
            part = bottom.add_body(name=f"body:{link}")
        else:
            part = bottom.add_body(name=f"body:{link}")
        add(part, link)


def _add_hinges(body: mujoco.MjsBody, hinges: Sequence[Elasticity]) -> None:
    for h in hinges:
        body.add_joint(
            name=f"hinge:{h.name}",
            axis=list(h.axis),
            stiffness=[h.stiffness, 0, 0],
            damping=[h.damping, 0, 0],
        )


def _set_inertia(body: mujoco.MjsBody, link: ET.Element) -> None:
    inertial = link.find("inertial")
    body.explicitinertial = True
    if inertial is None:
        body.mass, body.inertia = 1e-9, [1e-12] * 3
        return
    R, p = _origin(inertial)
    mass, I = inertial.find("mass"), inertial.find("inertia")
    assert mass is not None and I is not None  # a robot's URDF is checked
    ixx, ixy, ixz, iyy, iyz, izz = (float(I.get(k, 0)) for k in ("ixx", "ixy", "ixz", "iyy", "iyz", "izz"))
    tensor = R.as_matrix() @ np.array([[ixx, ixy, ixz], [ixy, iyy, iyz], [ixz, iyz, izz]]) @ R.as_matrix().T
    _put_inertia(body, float(mass.attrib["value"]), p, tensor)


def _put_inertia(body: mujoco.MjsBody, mass: float, com: np.ndarray, tensor: np.ndarray) -> None:
    values, axes = np.linalg.eigh(tensor)
    if np.linalg.det(axes) < 0:
        axes = axes * np.array([1, 1, -1])
    body.explicitinertial = True
    body.mass = max(mass, 1e-9)
    body.ipos = com
    body.iquat = _quat(Rotation.from_matrix(axes))
    least, middle, most = np.maximum(values, 1e-12)
    # Rounding makes more than a body can have of a flat one.
    body.inertia = [least, middle, min(most, (1.0 - 1e-12) * (least + middle))]


def _add_mass(body: mujoco.MjsBody, name: str, mass: float, com: np.ndarray, inertia: np.ndarray) -> None:
    part = body.add_body(name=name)
    _put_inertia(part, mass, np.asarray(com, float), np.asarray(inertia, float))


def _link_at(joint: ET.Element, end: str) -> str:
    """The link at an end of a joint, "parent" or "child"."""
    element = joint.find(end)
    assert element is not None  # a robot's URDF is checked
    return element.attrib["link"]


def _origin(element: ET.Element) -> tuple[Rotation, np.ndarray]:
    origin = element.find("origin")
    if origin is None:
        return Rotation.identity(), np.zeros(3)
    return Rotation.from_euler("xyz", _numbers(origin, "rpy", "0 0 0")), _numbers(origin, "xyz", "0 0 0")


def _numbers(element: ET.Element | None, key: str, default: str) -> np.ndarray:
    text = default if element is None else element.get(key, default)
    return np.array([float(v) for v in text.split()])


def _quat(R: Rotation) -> np.ndarray:
    x, y, z, w = R.as_quat()
    return np.array([w, x, y, z])
