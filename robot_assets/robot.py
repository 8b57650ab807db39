"""What an arm is: drives, elastic hinges, loads, limits and where its rigid bodies stand.

A robot is a folder with a ``robot.toml`` and, where the description is our own, its URDF.
All drive figures are referred to the link side of the gear.
"""

from __future__ import annotations

import os
import sysconfig
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from robot_assets.drives import read_drives
from robot_assets.errors import DataError
from robot_assets.joint import Joint
from robot_assets.spelling import joint_tables, load_tables, some_tables
from robot_assets.urdf import read_urdf
from robot_assets.values import exists, number, read_toml, show, subtable, text, vector

ASSETS = Path(__file__).parent


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
    joints, guessed = read_drives(path, entries, locked_at, urdf, tree)
    hinges = tuple(_elasticity(e, where, names) for e in some_tables(data, "elasticity", where))
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
        loads=tuple(_load(e, where, tree.links, payload_link) for e in load_tables(data, where)),
        locked=locked_at,
        gravity=(float(gx), float(gy), float(gz)),
        mesh_dir=mesh_dir,
        payload_link=payload_link,
        q_min=np.array([tree.limits[n][0] for n in names]),
        q_max=np.array([tree.limits[n][1] for n in names]),
        description=str(data.get("description", "")),
        guessed=guessed,
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


def _load(entry: dict, where: str, links: frozenset[str], payload_link: str) -> Load:
    link = entry.get("link", payload_link)
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
