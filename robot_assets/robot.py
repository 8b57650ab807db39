"""What an arm is: drives, elastic hinges, loads, limits and where its rigid bodies stand.

A robot is a folder with a ``robot.toml`` and, where the description is our own, its URDF.
All drive figures are referred to the link side of the gear.
"""

from __future__ import annotations

import os
import re
import sysconfig
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from robot_assets.errors import DataError
from robot_assets.guesses import guess_joints
from robot_assets.joint import ENCODER, NOISE, VELOCITY, WINDUP, Joint
from robot_assets.spelling import NAMES, joint_tables
from robot_assets.urdf import Description, read_urdf
from robot_assets.values import MISSING, exists, number, read_toml, show, subtable, tables, text, vector

ASSETS = Path(__file__).parent
# Figures of a joint by other names that they go by.
OTHER_NAMES = {
    "gear_ratio": ("gear", "ratio"),
    "stiffness": ("spring_stiffness", "gear_stiffness"),
    "damping": ("spring_damping", "gear_damping"),
    "viscous_friction": ("motor_viscous_friction", "motor_viscous", "viscous"),
    "torque_limit": ("torque_max", "effort_limit"),
    "velocity_limit": ("velocity_max",),
    "q_std": ("q_noise_std",),
    "tau_std": ("tau_noise_std",),
}
OF_DRIVE = ("gear_ratio", "motor_inertia", "stiffness", "damping", "viscous_friction")
DRIVE = re.compile(rf"(?m)^[ \t]*\[\[[ \t]*(?:{'|'.join(NAMES)})[ \t]*\]\]")  # begins the table of one


@dataclass(frozen=True)
class Elasticity:
    """A spring-damper hinge that no motor turns, right after joint ``joint`` ("base": below all), or right before it.

    Attributes:
        axis: in the frame of that joint, after its rotation; before it where the hinge is.
        stiffness: N m/rad. damping: N m s/rad.
    """

    name: str
    joint: str
    axis: tuple[float, float, float]
    stiffness: float
    damping: float
    before: bool = False


@dataclass(frozen=True)
class Load:
    """A body bolted to a link: mass kg, com (3,) m and inertia (3, 3) kg m2 about it, link axes."""

    link: str
    mass: float
    com: np.ndarray
    inertia: np.ndarray


@dataclass(frozen=True)
class Robot:
    """An arm.

    Attributes:
        locked: URDF joints that do not move, with their position, rad or m.
        guessed: figure of a drive, or "torque_limit" -> joints of which it is a guess: ``robot.toml`` does not give it,
            nor the URDF the limit, or still marks it GUESS in the comment beside it, as ``simgap robot`` writes it.
    """

    name: str
    folder: Path
    urdf: Path
    joints: tuple[Joint, ...]
    elasticities: tuple[Elasticity, ...]
    loads: tuple[Load, ...]
    locked: dict[str, float]
    gravity: tuple[float, float, float]
    mesh_dir: Path | None
    payload_link: str
    q_min: np.ndarray
    q_max: np.ndarray
    description: str = ""
    guessed: dict[str, tuple[str, ...]] = field(default_factory=dict)

    @property
    def n(self) -> int:
        """Joints."""
        return len(self.joints)

    @property
    def joint_names(self) -> tuple[str, ...]:
        """Names of the joints, from the base on."""
        return tuple(j.name for j in self.joints)

    def array(self, field: str) -> np.ndarray:
        """One figure of all joints, (n,)."""
        return np.array([getattr(j, field) for j in self.joints], float)


def load_robot(name_or_path: str | Path, relative_to: Path | None = None) -> Robot:
    """Read a robot folder: a name in ``robot_assets`` or a path.

    Args:
        relative_to: folder of the file that names the robot. A robot of that name which lies there comes first.

    Raises:
        DataError: where the folder, a key or the URDF is missing or wrong.
    """
    folder = _folder(name_or_path, relative_to)
    path = folder / "robot.toml"
    where = str(path)
    data = read_toml(path, "robot")
    urdf, mesh_dir = _urdf(data.get("urdf"), folder, where)
    tree = read_urdf(urdf)
    entries = joint_tables(data, where)
    if not entries:
        raise DataError("[[joint]]", where, "none", "at least one driven joint")
    names = [text(entry, "name", f"{where} joint {i + 1}") for i, entry in enumerate(entries)]
    locked = subtable(data, "locked", where)
    _distinct([*names, *locked], "[[joint]] and [locked] names", where)
    for name in [*names, *locked]:
        if name not in tree.limits:
            raise DataError("joint", where, name, f"a movable joint of {urdf.name}: {sorted(tree.limits)}")
    locked_at = {name: number(locked, name, where) for name in locked}
    bare = [not any(_given(entry, figure) for figure in OF_DRIVE[1:]) for entry in entries]
    guesses = [g.joint for g in guess_joints(urdf, tree, names, locked_at)] if any(bare) else [None] * len(names)
    joints = tuple(
        _joint(entry, where, tree, guess if nothing else None)
        for entry, guess, nothing in zip(entries, guesses, bare, strict=True)
    )
    hinges = tuple(_elasticity(e, where, names) for e in tables(data, "elasticity", where))
    _distinct([h.name for h in hinges], "[[elasticity]] names", where)
    payload_link = data.get("payload_link", data.get("flange", tree.child[names[-1]]))
    if not isinstance(payload_link, str) or (payload_link and payload_link not in tree.links):
        raise DataError("payload_link", where, show(payload_link), f"a link of {urdf.name}")
    gx, gy, gz = vector(data.get("gravity", [0, 0, -9.81]), "gravity", where, 3)
    return Robot(
        name=text(data, "name", where, folder.name),
        folder=folder,
        urdf=urdf,
        joints=joints,
        elasticities=hinges,
        loads=tuple(_load(e, where, tree.links) for e in tables(data, "load", where)),
        locked=locked_at,
        gravity=(float(gx), float(gy), float(gz)),
        mesh_dir=mesh_dir,
        payload_link=payload_link,
        q_min=np.array([tree.limits[n][0] for n in names]),
        q_max=np.array([tree.limits[n][1] for n in names]),
        description=str(data.get("description", "")),
        guessed=_guessed(path, entries, joints, tree),
    )


def moving_links(robot: Robot) -> list[str]:
    """Links that a driven joint carries directly: one per joint."""
    child = read_urdf(robot.urdf).child
    return [child[name] for name in robot.joint_names]


def linear_joints(robot: Robot) -> np.ndarray:
    """(n,) whether a joint is linear: its figures are in kg, N and m for kg m2, N m and rad."""
    kinds = read_urdf(robot.urdf).kinds
    return np.array([kinds[name] == "prismatic" for name in robot.joint_names])


def guessed_drives(robot: Robot) -> tuple[str, ...]:
    """Joints of which the stiffness or the motor inertia is a guess."""
    unknown = {*robot.guessed["stiffness"], *robot.guessed["motor_inertia"]}
    return tuple(name for name in robot.joint_names if name in unknown)


def robot_reference(robot: Robot, folder: Path) -> str:
    """A robot as a file in a folder names it: one of ``ASSETS``, or by its path from there."""
    if robot.folder.parent == ASSETS.resolve():
        return robot.folder.name
    return Path(os.path.relpath(robot.folder, folder.resolve())).as_posix()


def _folder(name_or_path: str | Path, relative_to: Path | None) -> Path:
    text = str(name_or_path)
    candidates = [Path(text)] if Path(text).is_absolute() else []
    if not candidates:
        candidates = [(relative_to or Path.cwd()) / text]
        if "/" not in text and "\\" not in text:
            # A folder that lies beside the file that names it is meant, whatever it is called.
            candidates.insert(0 if relative_to is None else 1, ASSETS / text)
    for folder in candidates:
        if exists(folder / "robot.toml"):
            return folder.resolve()
    known = sorted(p.parent.name for p in ASSETS.glob("*/robot.toml"))
    raise DataError("robot", text, "no robot.toml", f"one of {known} or the path of a robot folder")


def _urdf(entry: Any, folder: Path, where: str) -> tuple[Path, Path | None]:
    if isinstance(entry, str):
        entry = {"file": entry}
    if not isinstance(entry, dict):
        raise DataError("[urdf]", where, show(entry), 'a table with file = "..."')
    file = text(entry, "file", where)
    if "package" in entry:
        share = Path(sysconfig.get_paths()["purelib"]) / "cmeel.prefix" / "share"
        urdf = share / text(entry, "package", where) / file
        mesh_dir: Path | None = share
    else:
        urdf, mesh_dir = folder / file, folder
    if not exists(urdf):
        raise DataError("[urdf] file", where, f"no file {urdf.name}", "an existing URDF")
    return urdf, mesh_dir


def _distinct(names: list[str], what: str, where: str) -> None:
    double = sorted({name for name in names if names.count(name) > 1})
    if double:
        raise DataError(what, where, f"{double[0]} twice", "distinct names")


def _given(entry: dict, figure: str) -> list[str]:
    """The names by which the table of a joint gives a figure."""
    return [name for name in (figure, *OTHER_NAMES.get(figure, ())) if name in entry]


def _guessed(
    path: Path, entries: list[dict], joints: tuple[Joint, ...], tree: Description
) -> dict[str, tuple[str, ...]]:
    drives = DRIVE.split(path.read_text(encoding="utf-8-sig"))[1:]
    drives += [""] * (len(joints) - len(drives))

    def marked(figure: str) -> re.Pattern[str]:
        aliases = "|".join((figure, *OTHER_NAMES.get(figure, ())))
        return re.compile(rf"(?m)^[ \t]*({aliases})[ \t]*=[^#\n]*#.*\bGUESS\b")

    def unknown(figure: str, joint: Joint, entry: dict, drive: str) -> bool:
        if figure == "torque_limit" and not _given(entry, figure):
            return joint.torque_limit != tree.efforts[joint.name]
        return not _given(entry, figure) or bool(marked(figure).search(drive))

    each = list(zip(joints, entries, drives, strict=False))
    return {
        figure: tuple(joint.name for joint, entry, drive in each if unknown(figure, joint, entry, drive))
        for figure in (*OF_DRIVE, "torque_limit")
    }


def _joint(entry: dict, where: str, tree: Description, guess: Joint | None) -> Joint:
    """A joint from its table, and from ``guess`` where that says nothing of its drive: where it says some figures, one
    that is not among them is missed."""
    name = entry["name"]
    where, linear = f"{where} joint {name}", tree.kinds[name] == "prismatic"

    def figure(key: str, default: Any = MISSING) -> float:
        default = default if guess is None else getattr(guess, key)
        used = _given(entry, key)
        if len(used) > 1:
            raise DataError(used[1], where, f"{used[0]} beside it", "one of the two: they are the same")
        return number(entry, used[0] if used else key, where, low=0.0, above=True, default=default)

    stiffness = figure("stiffness")
    torque_limit = figure("torque_limit", tree.efforts.get(name) or WINDUP * stiffness)
    return Joint(
        name=name,
        gear_ratio=figure("gear_ratio"),
        motor_inertia=figure("motor_inertia"),
        stiffness=stiffness,
        damping=figure("damping"),
        viscous_friction=figure("viscous_friction"),
        torque_limit=torque_limit,
        velocity_limit=figure("velocity_limit", tree.speeds.get(name) or VELOCITY[linear]),
        q_std=figure("q_std", ENCODER[linear]),
        tau_std=figure("tau_std", NOISE * torque_limit),
    )


def _elasticity(entry: dict, where: str, joints: list[str]) -> Elasticity:
    joint = entry.get("joint")
    if joint not in ["base", *joints]:
        raise DataError("[[elasticity]] joint", where, show(joint), f"base or one of {joints}")
    name = text(entry, "name", where, joint)
    where = f"{where} elasticity {name}"
    x, y, z = vector(entry.get("axis"), "axis", where, 3)
    if x == y == z == 0:
        raise DataError("axis", where, "a zero vector", "a direction")
    stiffness, damping = (number(entry, key, where, low=0.0, above=True) for key in ("stiffness", "damping"))
    return Elasticity(name, joint, (float(x), float(y), float(z)), stiffness, damping)


def _load(entry: dict, where: str, links: frozenset[str]) -> Load:
    link = entry.get("link")
    if not isinstance(link, str) or link not in links:
        raise DataError("[[load]] link", where, show(link), f"one of {sorted(links)}")
    where = f"{where} load of {link}"
    rows = entry.get("inertia", [0.0, 0.0, 0.0])
    if isinstance(rows, list) and len(rows) == 3 and all(isinstance(row, list) for row in rows):
        inertia = np.array([vector(row, "inertia", where, 3) for row in rows])
    else:
        inertia = np.diag(vector(rows, "inertia", where, 3, "3 or 3 x 3 finite numbers"))
    if not np.allclose(inertia, inertia.T) or np.linalg.eigvalsh(inertia).min() < -1e-9 * np.abs(inertia).max():
        raise DataError("inertia", where, show(rows), "a symmetric tensor without negative moments")
    mass = number(entry, "mass", where, low=0.0, above=True)
    return Load(link, mass, vector(entry.get("com"), "com", where, 3), inertia)
