"""What an arm is: drives, elastic hinges, loads, limits and where its rigid bodies stand.

A robot is a folder with a ``robot.toml`` and, where the description is our own, its URDF.
All drive figures are referred to the link side of the gear.
"""

from __future__ import annotations

import sysconfig
import tomllib
import xml.etree.ElementTree as ET
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from robot_assets.errors import DataError

ASSETS = Path(__file__).parent


@dataclass(frozen=True)
class Joint:
    """A driven joint.

    Attributes:
        gear_ratio: motor turns per joint turn.
        motor_inertia: kg m2. stiffness: N m/rad. damping, viscous_friction: N m s/rad.
        torque_limit: N m. velocity_limit: rad/s. q_std: encoder noise, rad. tau_std: N m.
    """

    name: str
    gear_ratio: float
    motor_inertia: float
    stiffness: float
    damping: float
    viscous_friction: float
    torque_limit: float
    velocity_limit: float
    q_std: float
    tau_std: float


@dataclass(frozen=True)
class Elasticity:
    """A spring-damper hinge that no motor turns, right after joint ``joint`` ("base": below all).

    Attributes:
        axis: in the frame of that joint, after its rotation.
        stiffness: N m/rad. damping: N m s/rad.
    """

    name: str
    joint: str
    axis: tuple[float, float, float]
    stiffness: float
    damping: float


@dataclass(frozen=True)
class Load:
    """A body bolted to a link: mass kg, com (3,) m and inertia (3, 3) kg m2 about it, link axes."""

    link: str
    mass: float
    com: np.ndarray
    inertia: np.ndarray


@dataclass(frozen=True)
class Robot:
    """An arm. ``locked`` names URDF joints that do not move, with their position (rad or m)."""

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

    @property
    def n(self) -> int:
        return len(self.joints)

    @property
    def joint_names(self) -> tuple[str, ...]:
        return tuple(j.name for j in self.joints)

    def array(self, field: str) -> np.ndarray:
        """One figure of all joints, (n,)."""
        return np.array([getattr(j, field) for j in self.joints], float)


def load_robot(name_or_path: str | Path, relative_to: Path | None = None) -> Robot:
    """Read a robot folder: a name in ``robot_assets`` or a path.

    Raises:
        DataError: where the folder, a key or the URDF is missing or wrong.
    """
    folder = _folder(name_or_path, relative_to)
    path = folder / "robot.toml"
    try:
        data = tomllib.loads(path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError) as err:
        raise DataError("robot", str(path), str(err), "a readable robot.toml") from err
    except tomllib.TOMLDecodeError as err:
        raise DataError("robot", str(path), f"invalid TOML ({err})", "valid TOML") from err
    urdf, mesh_dir = _urdf(data.get("urdf"), folder, path)
    joints = tuple(_joint(entry, i, path) for i, entry in enumerate(_tables(data, "joint", path)))
    if not joints:
        raise DataError("[[joint]]", str(path), "none", "at least one driven joint")
    names = [j.name for j in joints]
    if len(set(names)) < len(names):
        raise DataError("[[joint]] name", str(path), "a duplicate", "distinct names")
    limits = _limits(urdf)
    for name in [*names, *data.get("locked", {})]:
        if name not in limits:
            raise DataError("joint", str(path), name, f"a movable joint of {urdf.name}: {sorted(limits)}")
    links = _links(urdf)
    loads = tuple(_load(e, path, links) for e in _tables(data, "load", path))
    hinges = tuple(_elasticity(e, path, names) for e in _tables(data, "elasticity", path))
    payload_link = data.get("payload_link", "")
    if payload_link and payload_link not in links:
        raise DataError("payload_link", str(path), payload_link, f"a link of {urdf.name}")
    return Robot(
        name=str(data.get("name", folder.name)),
        folder=folder,
        urdf=urdf,
        joints=joints,
        elasticities=hinges,
        loads=loads,
        locked={k: float(v) for k, v in data.get("locked", {}).items()},
        gravity=tuple(_vector(data.get("gravity", [0, 0, -9.81]), "gravity", path)),
        mesh_dir=mesh_dir,
        payload_link=payload_link,
        q_min=np.array([limits[n][0] for n in names]),
        q_max=np.array([limits[n][1] for n in names]),
        description=str(data.get("description", "")),
    )


def _folder(name_or_path: str | Path, relative_to: Path | None) -> Path:
    text = str(name_or_path)
    candidates = [Path(text)] if Path(text).is_absolute() else []
    if not candidates:
        candidates = [(relative_to or Path.cwd()) / text]
        if "/" not in text and "\\" not in text:
            candidates.insert(0, ASSETS / text)
    for folder in candidates:
        if (folder / "robot.toml").is_file():
            return folder.resolve()
    known = sorted(p.parent.name for p in ASSETS.glob("*/robot.toml"))
    raise DataError("robot", text, "no robot.toml", f"one of {known} or the path of a robot folder")


def _urdf(entry: Any, folder: Path, path: Path) -> tuple[Path, Path | None]:
    if not isinstance(entry, dict) or not isinstance(entry.get("file"), str):
        raise DataError("[urdf]", str(path), repr(entry), 'a table with file = "..."')
    if "package" in entry:
        share = Path(sysconfig.get_paths()["purelib"]) / "cmeel.prefix" / "share"
        urdf = share / str(entry["package"]) / entry["file"]
        mesh_dir: Path | None = share
    else:
        urdf, mesh_dir = folder / entry["file"], folder
    if not urdf.is_file():
        raise DataError("[urdf] file", str(path), f"no file {urdf.name}", "an existing URDF")
    return urdf, mesh_dir


def _tables(data: dict, key: str, path: Path) -> list[dict]:
    entries = data.get(key, [])
    if not isinstance(entries, list) or not all(isinstance(e, dict) for e in entries):
        raise DataError(f"[[{key}]]", str(path), repr(entries)[:60], "an array of tables")
    return entries


def _number(entry: dict, key: str, path: Path, where: str, *, positive: bool = True) -> float:
    value = entry.get(key)
    if not isinstance(value, int | float) or isinstance(value, bool) or not np.isfinite(value):
        raise DataError(f"{where} {key}", str(path), repr(value), "a finite number")
    if positive and value <= 0:
        raise DataError(f"{where} {key}", str(path), repr(value), "a number above zero")
    return float(value)


def _vector(value: Any, key: str, path: Path) -> np.ndarray:
    try:
        out = np.asarray(value, float)
    except (TypeError, ValueError):
        out = np.empty(0)
    if out.shape != (3,) or not np.all(np.isfinite(out)):
        raise DataError(key, str(path), repr(value), "three finite numbers")
    return out


def _joint(entry: dict, i: int, path: Path) -> Joint:
    name = entry.get("name")
    if not isinstance(name, str):
        raise DataError(f"[[joint]] {i + 1} name", str(path), repr(name), "a joint's name")
    fields = [f for f in Joint.__dataclass_fields__ if f != "name"]
    return Joint(name, **{f: _number(entry, f, path, f"joint {name}") for f in fields})


def _elasticity(entry: dict, path: Path, joints: list[str]) -> Elasticity:
    if entry.get("joint") not in [*joints, "base"]:
        raise DataError("[[elasticity]] joint", str(path), repr(entry.get("joint")), f"base or one of {joints}")
    name = str(entry.get("name", entry["joint"]))
    axis = _vector(entry.get("axis"), f"elasticity {name} axis", path)
    numbers = [_number(entry, key, path, f"elasticity {name}") for key in ("stiffness", "damping")]
    return Elasticity(name, entry["joint"], tuple(float(a) for a in axis), *numbers)


def _load(entry: dict, path: Path, links: set[str]) -> Load:
    if entry.get("link") not in links:
        raise DataError("[[load]] link", str(path), repr(entry.get("link")), f"one of {sorted(links)}")
    inertia = np.asarray(entry.get("inertia", [0.0, 0.0, 0.0]), float)
    if inertia.shape == (3,):
        inertia = np.diag(inertia)
    if inertia.shape != (3, 3):
        raise DataError("[[load]] inertia", str(path), repr(entry.get("inertia")), "3 or 3 x 3 numbers")
    return Load(entry["link"], _number(entry, "mass", path, "load"), _vector(entry.get("com"), "load com", path), inertia)


def _root(urdf: Path) -> ET.Element:
    text = urdf.read_bytes()
    if b"<!ENTITY" in text:
        raise DataError("URDF", str(urdf), "an entity declaration", "a URDF without entities")
    try:
        return ET.fromstring(text)
    except ET.ParseError as err:
        raise DataError("URDF", str(urdf), f"invalid XML ({err})", "a readable URDF") from err


def _links(urdf: Path) -> set[str]:
    return {str(e.get("name")) for e in _root(urdf).findall("link")}


def _limits(urdf: Path) -> dict[str, tuple[float, float]]:
    """Lower and upper position of every movable joint, rad or m."""
    out = {}
    for joint in _root(urdf).findall("joint"):
        if joint.get("type") in ("revolute", "continuous", "prismatic"):
            limit = joint.find("limit")
            low = float(limit.get("lower", -np.pi)) if limit is not None else -np.pi
            high = float(limit.get("upper", np.pi)) if limit is not None else np.pi
            if joint.get("type") == "continuous":
                low, high = -np.pi, np.pi
            out[str(joint.get("name"))] = (low, high)
    return out


def moving_links(robot: Robot) -> list[str]:
    """Links that a driven joint carries directly: one per joint."""
    by_joint = {
        str(j.get("name")): str(j.find("child").get("link")) for j in _root(robot.urdf).findall("joint")
    }
    return [by_joint[name] for name in robot.joint_names]
