"""What a robot takes from its URDF, checked: links, joints and their limits."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from xml.parsers import expat

import numpy as np

from robot_assets.errors import DataError
from robot_assets.values import LARGEST

MOVABLE = ("revolute", "continuous", "prismatic")
SHORTEST = 1e-6  # of an axis
MOST = 1000  # links, and joints
NEGATIVE = 1e-3  # of the largest moment of inertia: what rounding in a file may leave below zero
SLIGHT = 1e-7  # kg m2, the same: of links that hardly weigh anything
BOUNDLESS = 1e6  # rad or m: a limit beyond stands for none
LIMIT = {"lower": -np.pi, "upper": np.pi, "effort": 0.0, "velocity": 0.0}  # of a joint that says nothing of them
MOMENTS = ("ixx", "iyy", "izz", "ixy", "ixz", "iyz")
DEEPEST = 100  # elements inside elements: parsers of the engines recurse


@dataclass(frozen=True)
class Description:
    """A tree of links.

    Attributes:
        links: names. limits: movable joint -> lower and upper position, rad or m.
        child: joint -> the link it carries. kinds: movable joint -> one of ``MOVABLE``.
        axes: movable joint -> its axis in its own frame, of length one.
        efforts, speeds: movable joint -> limit of its torque, N m or N, and of its velocity; 0 where it says none that
            can be used.
    """

    links: frozenset[str]
    limits: dict[str, tuple[float, float]]
    child: dict[str, str]
    kinds: dict[str, str]
    axes: dict[str, tuple[float, float, float]]
    efforts: dict[str, float]
    speeds: dict[str, float]


def read_urdf(path: Path) -> Description:
    """Read and check a URDF.

    Raises:
        DataError: where it is no XML, is no single tree of links, or a figure is no number.
    """
    root = _root(path)
    links = [_name(e, "link", path) for e in root.findall("link")]
    joints = [(_name(e, "joint", path), e) for e in root.findall("joint")]
    for names, kind in ((links, "link"), ([name for name, _ in joints], "joint")):
        if len(names) > MOST:
            raise DataError(f"{kind}s", str(path), f"{len(names)}", f"at most {MOST}")
        double = {n for n in names if names.count(n) > 1}
        if double:
            raise DataError(f"{kind} {min(double)}", str(path), "it twice", "distinct names")
    limits, child, parent, kinds, axes = {}, {}, {}, {}, {}
    for name, joint in joints:
        ends = []
        for end in ("parent", "child"):
            element = joint.find(end)
            link = None if element is None else element.get("link")
            if link not in links:
                raise DataError(f"{end} of joint {name}", str(path), repr(link), "a link of the URDF")
            ends.append(str(link))
        if ends[1] in parent:
            raise DataError(f"link {ends[1]}", str(path), "a second parent", "a tree of links")
        parent[ends[1]], child[name] = ends[0], ends[1]
        _numbers(joint.find("origin"), f"joint {name}", path)
        if joint.get("type") in MOVABLE:
            limits[name], kinds[name] = _limit(joint, name, path), str(joint.get("type"))
            axis = _vector(joint.find("axis"), "xyz", f"axis of joint {name}", path, "1 0 0")
            if not np.any(axis):
                raise DataError(f"axis of joint {name}", str(path), "a zero vector", "a direction")
            if not SHORTEST <= np.abs(axis).max():  # the square of less may be zero
                raise DataError(
                    f"axis of joint {name}",
                    str(path),
                    f"a vector of {np.abs(axis).max():.3g}",
                    "a direction, of about length one",
                )
            x, y, z = np.asarray(axis) / np.linalg.norm(axis)
            axes[name] = (float(x), float(y), float(z))
        elif joint.get("type") != "fixed":
            raise DataError(f"joint {name} type", str(path), repr(joint.get("type")), f"fixed or one of {MOVABLE}")
    _one_tree(links, parent, path)
    _check_mimics(joints, path)
    for element, link in zip(root.findall("link"), links, strict=True):
        _check_inertial(element.find("inertial"), link, path)
    movable = [(name, joint.find("limit")) for name, joint in joints if name in limits]
    efforts, speeds = (
        {name: 0.0 if limit is None else _positive(limit.get(key)) for name, limit in movable}
        for key in ("effort", "velocity")
    )
    return Description(frozenset(links), limits, child, kinds, axes, efforts, speeds)


def _positive(text: str | None) -> float:
    """A limit; 0 where there is none that can be used."""
    try:
        value = float(text or 0.0)
    except ValueError:
        return 0.0
    return value if 0 < value < 1e9 else 0.0


def _root(path: Path) -> ET.Element:
    text = path.read_bytes()
    depth = 0

    def refuse(*_: object) -> None:
        raise DataError("URDF", str(path), "a document type or an entity declaration", "a URDF without one")

    def enter(*_: object) -> None:
        nonlocal depth
        depth += 1
        if depth > DEEPEST:
            raise DataError("URDF", str(path), f"more than {DEEPEST} elements inside each other", "a URDF")

    def leave(*_: object) -> None:
        nonlocal depth
        depth -= 1

    look = expat.ParserCreate()
    look.StartDoctypeDeclHandler, look.StartElementHandler, look.EndElementHandler = refuse, enter, leave
    try:
        look.Parse(text, True)
        root = ET.fromstring(text)
    except (expat.ExpatError, ET.ParseError, ValueError, LookupError) as err:
        raise DataError("URDF", str(path), f"invalid XML ({err})", "a readable URDF") from err
    if root.tag != "robot":
        raise DataError("URDF", str(path), f"<{root.tag}> at the top", "<robot>")
    return root


def _name(element: ET.Element, kind: str, path: Path) -> str:
    name = element.get("name")
    if not name or not name.isprintable():
        raise DataError(f"{kind} name", str(path), repr(name), "a name that can be printed")
    return name


def _one_tree(links: list[str], parent: dict[str, str], path: Path) -> None:
    roots = [link for link in links if link not in parent]
    if len(roots) != 1:
        raise DataError("links", str(path), f"{len(roots)} without a parent {roots[:4]}", "a tree with one root")
    for link in links:
        at, steps = link, 0
        while at in parent and steps <= len(links):
            at, steps = parent[at], steps + 1
        if at != roots[0]:
            raise DataError(f"link {link}", str(path), "a loop of joints", "a tree of links")


def _check_mimics(joints: list[tuple[str, ET.Element]], path: Path) -> None:
    """Raise a DataError where a joint mimics none of the URDF, or in the end itself."""
    leads = {name: str(mimic.get("joint")) for name, e in joints if (mimic := e.find("mimic")) is not None}
    names = {name for name, _ in joints}
    for name, joint in joints:
        mimic = joint.find("mimic")
        if mimic is not None:
            for key, default in (("multiplier", "1"), ("offset", "0")):
                _number(mimic.get(key, default), f"{key} of the mimic of joint {name}", path)
    for name in leads:
        at, steps = name, 0
        while at in leads and steps <= len(leads):
            at, steps = leads[at], steps + 1
            if at == name:
                raise DataError(
                    f"mimic of joint {name}", str(path), "itself" if steps == 1 else "a loop of joints", "another joint"
                )
        if leads[name] not in names:
            raise DataError(f"mimic of joint {name}", str(path), repr(leads[name]), "a joint of the URDF")


def completed(path: Path) -> str:
    """The text of a URDF, with what some readers demand and it does not say: limits (``LIMIT``) and products of
    inertia."""
    root = _root(path)
    for joint in root.iter("joint"):
        if joint.get("type") in ("revolute", "prismatic"):
            limit = joint.find("limit")
            low, high = _limit(joint, str(joint.get("name")), path)
            limit = ET.SubElement(joint, "limit") if limit is None else limit
            limit.attrib |= {"lower": repr(low), "upper": repr(high)}
            _complete(limit, LIMIT)
    for tensor in root.iter("inertia"):
        _complete(tensor, dict.fromkeys(MOMENTS, 0.0))
    return ET.tostring(root, encoding="unicode")


def _complete(element: ET.Element, values: dict[str, float]) -> None:
    for key in values.keys() - element.keys():
        element.set(key, str(values[key]))


def _limit(joint: ET.Element, name: str, path: Path) -> tuple[float, float]:
    limit = joint.find("limit")
    if limit is None or joint.get("type") == "continuous":
        return LIMIT["lower"], LIMIT["upper"]
    low, high = (
        _number(limit.get(end, str(LIMIT[end])), f"{end} limit of joint {name}", path, np.inf)
        for end in ("lower", "upper")
    )
    if low == high == 0.0 and joint.get("type") == "revolute":  # as programs write it that know of none
        return LIMIT["lower"], LIMIT["upper"]
    open_low, open_high = low < -BOUNDLESS, high > BOUNDLESS
    if open_low:
        low = LIMIT["lower"] if open_high else min(LIMIT["lower"], high - 2.0 * np.pi)
    if open_high:
        high = LIMIT["upper"] if open_low else max(LIMIT["upper"], low + 2.0 * np.pi)
    if low >= high:
        raise DataError(f"limit of joint {name}", str(path), f"{low:g} to {high:g}", "a lower limit below the upper")
    return low, high


def _check_inertial(inertial: ET.Element | None, link: str, path: Path) -> None:
    if inertial is None:
        return
    _numbers(inertial.find("origin"), f"inertial of link {link}", path)
    mass, tensor = inertial.find("mass"), inertial.find("inertia")
    if mass is None or tensor is None:
        raise DataError(f"inertial of link {link}", str(path), "no mass or no inertia", "both")
    if _number(mass.get("value"), f"mass of link {link}", path) < 0:
        raise DataError(f"mass of link {link}", str(path), str(mass.get("value")), "at least zero")
    moments = principal([_number(tensor.get(key, "0"), f"{key} of link {link}", path) for key in MOMENTS])
    if moments.min() < -max(NEGATIVE * np.abs(moments).max(), SLIGHT):
        raise DataError(
            f"inertia of link {link}", str(path), f"a moment of {moments.min():.3g} kg m2", "moments of at least zero"
        )


def principal(tensor: Sequence[float]) -> np.ndarray:
    """(3,) moments of inertia, ascending, of a tensor in the order of ``MOMENTS``."""
    xx, yy, zz, xy, xz, yz = tensor
    return np.linalg.eigvalsh([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])


def _numbers(origin: ET.Element | None, what: str, path: Path) -> None:
    for key in ("xyz", "rpy"):
        _vector(origin, key, f"{key} of {what}", path, "0 0 0")


def _vector(element: ET.Element | None, key: str, what: str, path: Path, default: str) -> list[float]:
    words = (default if element is None else element.get(key, default)).split()
    if len(words) != 3:
        raise DataError(what, str(path), " ".join(words), "three numbers")
    return [_number(word, what, path) for word in words]


def _number(word: str | None, what: str, path: Path, most: float = LARGEST) -> float:
    try:
        value = float(str(word))
    except ValueError:
        value = np.nan
    if not abs(value) <= most:
        raise DataError(what, str(path), repr(word), f"a number of at most {most:g}")
    return value
