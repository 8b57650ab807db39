"""A robot folder from a URDF: starting guesses of what a URDF does not say.

Rigid bodies, limits and axes come from the URDF. Drive figures follow from rules of thumb on the
inertia that each joint sees and on its effort and velocity limits; over the shipped arms they are
right within a factor of about five, and are there to be replaced or identified.
"""

from __future__ import annotations

import shutil
import tempfile
import xml.etree.ElementTree as ET
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import tomlkit
from scipy.spatial.transform import Rotation

from robot_assets.errors import DataError
from robot_assets.plausible import doubts
from robot_assets.robot import ENCODER, NOISE, VELOCITY, WINDUP, Joint, Robot, load_robot
from robot_assets.urdf import Description, read_urdf
from robot_assets.values import LARGEST, exists

GRAVITY = 9.81  # m/s2
POSTURES = 64  # random ones, over which the seen inertia is taken
GEAR_RATIO = 100.0  # of a strain-wave or cycloidal gear of an arm; 1 for a linear drive
SOFTEST = 5.0  # Hz: no anti-resonance is guessed below
SCREW = 30.0  # Hz: anti-resonance of a ball screw with its carriage
DAMPING = 0.05  # damping ratio of the gear
ACCELERATION = 150.0  # rad/s2 that the torque limit gives the motor alone
MATCH = 0.5  # motor inertia over the inertia carried, at the least
DRAG = 0.1  # of the torque limit, taken by viscous friction at the velocity limit
Carrier = tuple[int, np.ndarray, np.ndarray, bool]  # joint, axis, a point of the axis, linear
MOST = 100  # driven joints
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


@dataclass(frozen=True)
class Draft:
    """A robot folder as it would be written."""

    guesses: tuple[JointGuess, ...]
    locked: dict[str, float]
    payload_link: str
    warnings: tuple[str, ...]


def draft_robot(urdf: str | Path, lock: Mapping[str, float | None] | None = None) -> Draft:
    """Guess the drives of a URDF.

    Args:
        lock: joints that do not move, and where they stand (rad or m; None: zero, or the limit
            nearest to it). Joints that mimic another one are locked by themselves.

    Raises:
        DataError: where the URDF cannot be read, has no free joint, or a locked joint is none of its own.
    """
    path = Path(urdf)
    if not exists(path):
        raise DataError("URDF", str(urdf), "no such file", "a URDF")
    tree = read_urdf(path)
    root = ET.fromstring(path.read_bytes())
    elements = {e.get("name", ""): e for e in root.findall("joint")}
    locked = _locked(path, tree, elements, dict(lock or {}))
    names = [name for name in elements if name in tree.limits and name not in locked]
    if not names:
        raise DataError("joints", str(path), "no movable joint that is free", "at least one to drive")
    if len(names) > MOST:
        raise DataError("joints", str(path), f"{len(names)} that are free", f"at most {MOST}: lock the others")
    inertia, weight = _seen(root, tree, names, locked)
    guesses, warnings = [], list(doubts(root))
    for j, name in enumerate(names):
        guesses.append(_guess(tree, name, inertia[:, j], float(weight[:, j].max())))
        _check_figures(guesses[-1], path)
        if inertia[:, j].max() <= 0:
            warnings.append(f"{name} carries no mass in the URDF: complete its <inertial> or add a [[load]]")
    if any(e.find(".//mesh") is not None for e in root.findall("link")):
        warnings.append("the URDF names mesh files, which are not copied: only the recording shows them")
    depth = {name: _depth(elements, tree.child[name]) for name in names}
    return Draft(tuple(guesses), locked, tree.child[max(names, key=lambda n: depth[n])], tuple(warnings))


def write_robot(
    urdf: str | Path, out: str | Path, lock: Mapping[str, float | None] | None = None
) -> tuple[Robot, tuple[str, ...]]:
    """Write a robot folder with a ``robot.toml`` of guesses and a copy of the URDF.

    Returns:
        The robot as it loads, and warnings.

    Raises:
        DataError: as ``draft_robot``; where ``out`` exists and is not empty, so that no edited file is lost.
    """
    source, target = Path(urdf), Path(out).absolute()
    if not source.name.isprintable():
        raise DataError("URDF", str(urdf), f"{source.name!a} for a name", "one that can be printed")
    draft = draft_robot(source, lock)
    if target.exists() and (not target.is_dir() or any(target.iterdir())):
        raise DataError("--out", str(out), "something there already", "a new or empty folder")
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        beside = Path(tempfile.mkdtemp(prefix=f".{target.name}-", dir=target.parent))
    except OSError as err:
        raise DataError("--out", str(out), str(err.strerror or err), "a folder that can be made") from err
    try:
        shutil.copyfile(source, beside / source.name)
        (beside / "robot.toml").write_text(render(draft, target.name, source.name), encoding="utf-8")
        try:
            load_robot(beside)
        except DataError as err:  # of a scratch file that no one has seen
            raise DataError(err.what, str(urdf), err.found, err.expected) from err
        beside.chmod(0o755)
        if target.exists():
            target.rmdir()
        beside.rename(target)
    finally:
        if beside.exists():
            shutil.rmtree(beside)
    return load_robot(target), draft.warnings


def render(draft: Draft, name: str, urdf_name: str) -> str:
    """The text of ``robot.toml``, every guess with its reason."""
    lines = [
        "# Written from a URDF. Every figure marked GUESS is a starting guess, referred to the link side of the",
        "# gear: replace it where a data sheet or a measurement says better. Identification starts from them.",
        *(f"# CHECK: {w}" for w in draft.warnings),
        f"name = {_quoted(name)}",
        'description = "from a URDF, drives guessed"',
        f"gravity = [0.0, 0.0, {-GRAVITY}]          # GUESS: the base stands upright",
        f"payload_link = {_quoted(draft.payload_link)}   # the last link of the chain; where a payload would be",
        "",
        "[urdf]",
        f"file = {_quoted(urdf_name)}",
    ]
    if draft.locked:
        lines += ["", "[locked]", *(f"{_quoted(k)} = {_figure(v)}" for k, v in draft.locked.items())]
    for guess in draft.guesses:
        low, high = guess.inertia
        unit = _unit("kg m2", guess.prismatic)
        carries = f"{low:.3g} {unit}" if high <= 1.01 * low else f"{low:.3g} to {high:.3g} {unit}"
        lines += [
            "",
            f"# {'linear' if guess.prismatic else 'turning'} joint; carries {carries},"
            f" gravity takes up to {guess.weight:.3g} {_unit('N m', guess.prismatic)}",
            "[[joint]]",
            f"name = {_quoted(guess.joint.name)}",
        ]
        for field, reason in guess.reasons.items():
            lines.append(f"{f'{field} = {_figure(getattr(guess.joint, field))}':<32}# {reason}")
    return "\n".join(lines) + "\n"


def _guess(tree: Description, name: str, inertia: np.ndarray, weight: float) -> JointGuess:
    linear = tree.kinds[name] == "prismatic"
    effort, velocity = tree.efforts[name], tree.speeds[name]
    carried = float(np.median(inertia))
    newton, rad, kg = (_unit(u, linear) for u in ("N m", "rad", "kg m2"))
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
        torque = max(2.0 * weight + 10.0 * max(carried, 1e-6) * velocity, 1e-3)
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
            found = (
                f"{low:.3g} to {high:.3g} {_unit('kg m2', guess.prismatic)} carried, which gives {field} = {value:.3g}"
            )
            raise DataError(
                f"joint {guess.joint.name}", str(path), found, "masses and inertias of an arm on the links beyond it"
            )


def _locked(path: Path, tree: Description, elements: dict[str, ET.Element], lock: dict) -> dict[str, float]:
    for name in lock:
        if name not in tree.limits:
            raise DataError("--lock", str(path), name, f"a movable joint: {sorted(tree.limits)}")
        if lock[name] is not None and not abs(lock[name]) < 1e6:
            raise DataError("--lock", str(path), f"{name}={lock[name]}", "a position in rad or m")
        low, high = tree.limits[name]
        given = elements[name].find("limit") is not None and tree.kinds[name] != "continuous"
        if lock[name] is not None and given and not low <= lock[name] <= high:
            raise DataError(
                "--lock", str(path), f"{name}={lock[name]:g}", f"a position within its limits, {low:g} to {high:g}"
            )
    for name in tree.limits:
        if elements[name].find("mimic") is not None:
            lock.setdefault(name, None)
    return {k: float(np.clip(0.0, *tree.limits[k])) if v is None else float(v) for k, v in lock.items()}


def _seen(
    root: ET.Element, tree: Description, names: list[str], locked: dict[str, float]
) -> tuple[np.ndarray, np.ndarray]:
    """Inertia carried by each joint and size of its gravity torque in random postures, (POSTURES, n) each."""
    rng = np.random.default_rng(0)
    low, high = np.array([np.clip(tree.limits[name], -np.pi, np.pi) for name in names]).T
    joints = root.findall("joint")
    bodies = {e.get("name", ""): _body(e) for e in root.findall("link")}
    children: dict[str, list[ET.Element]] = {}
    for joint in joints:
        children.setdefault(_link(joint, "parent"), []).append(joint)
    (base,) = set(bodies) - {_link(j, "child") for j in joints}
    inertia, weight = np.zeros((POSTURES, len(names))), np.zeros((POSTURES, len(names)))
    q = dict(zip(names, rng.uniform(low, high, (POSTURES, len(names))).T, strict=True))
    q |= {name: np.full(POSTURES, at) for name, at in locked.items()}
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
            stack.append((_link(joint, "child"), R_joint, x_joint, carried))
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


def _link(joint: ET.Element, end: str) -> str:
    """The link at the "parent" or "child" end of a joint."""
    element = joint.find(end)
    return "" if element is None else element.get("link", "")


def _depth(elements: dict[str, ET.Element], link: str) -> int:
    parent = {_link(e, "child"): _link(e, "parent") for e in elements.values()}
    steps = 0
    while link in parent:
        link, steps = parent[link], steps + 1
    return steps


def _unit(unit: str, linear: bool) -> str:
    return LINEAR_UNITS[unit] if linear else unit


def _quoted(text: str) -> str:
    return tomlkit.item(text).as_string()


def _figure(value: float) -> str:
    text: str = f"{value:.3g}"
    return text if any(c in text for c in ".e") else f"{text}.0"
