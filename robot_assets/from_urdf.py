"""A robot folder from a URDF: starting guesses of what a URDF does not say.

Rigid bodies, limits and axes come from the URDF, drive figures are those of ``guesses``.
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

from robot_assets.errors import DataError
from robot_assets.guesses import GRAVITY, JointGuess, guess_joints, link_at, unit_of
from robot_assets.plausible import doubts
from robot_assets.robot import Robot, load_robot
from robot_assets.urdf import Description, read_urdf
from robot_assets.values import exists, instead_of_file

MOST = 100  # driven joints


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
            nearest to it). Joints that mimic another one are locked by themselves, where it holds them.

    Raises:
        DataError: where the URDF cannot be read, has no free joint, or a locked joint is none of its own.
    """
    path = Path(urdf)
    if not exists(path):
        raise DataError("URDF", str(urdf), instead_of_file(path), "a URDF")
    tree = read_urdf(path)
    root = ET.fromstring(path.read_bytes())
    elements = {e.get("name", ""): e for e in root.findall("joint")}
    locked = _locked(path, tree, elements, dict(lock or {}))
    names = [name for name in elements if name in tree.limits and name not in locked]
    if not names:
        raise DataError("joints", str(path), "no movable joint that is free", "at least one to drive")
    if len(names) > MOST:
        raise DataError("joints", str(path), f"{len(names)} that are free", f"at most {MOST}: lock the others")
    guesses = guess_joints(path, tree, names, locked)
    warnings = _followers(tree, elements, lock or {}, locked) + list(doubts(root))
    for guess in guesses:
        if guess.inertia[1] <= 0:
            warnings.append(
                f"{guess.joint.name} carries no mass in the URDF: complete its <inertial> or add a [[load]]"
            )
    if any(e.find(".//mesh") is not None for e in root.findall("link")):
        warnings.append("the URDF names mesh files, which are not copied: only the recording shows them")
    depth = {name: _depth(elements, tree.child[name]) for name in names}
    return Draft(guesses, locked, tree.child[max(names, key=lambda n: depth[n])], tuple(warnings))


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
        unit = unit_of("kg m2", guess.prismatic)
        carries = f"{low:.3g} {unit}" if high <= 1.01 * low else f"{low:.3g} to {high:.3g} {unit}"
        lines += [
            "",
            f"# {'linear' if guess.prismatic else 'turning'} joint; carries {carries},"
            f" gravity takes up to {guess.weight:.3g} {unit_of('N m', guess.prismatic)}",
            "[[joint]]",
            f"name = {_quoted(guess.joint.name)}",
        ]
        for field, reason in guess.reasons.items():
            lines.append(f"{f'{field} = {_figure(getattr(guess.joint, field))}':<32}# {reason}")
    return "\n".join(lines) + "\n"


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
    mimics = {k: m for k in tree.limits if k not in lock and (m := elements[k].find("mimic")) is not None}

    def position(name: str) -> float:
        """Where a joint stands, beside those that are driven at zero."""
        value = lock.get(name)
        if name in mimics:
            leader = position(mimics[name].get("joint", ""))
            value = float(mimics[name].get("multiplier", "1")) * leader + float(mimics[name].get("offset", "0"))
        elif value is None and name not in lock:
            return 0.0
        return float(np.clip(value or 0.0, *tree.limits[name]))

    return {name: position(name) for name in (*lock, *mimics)}


def _followers(
    tree: Description, elements: dict[str, ET.Element], by_hand: Mapping[str, float | None], locked: Mapping[str, float]
) -> list[str]:
    """Of joints that mimic one that is driven, and cannot do so here, in words."""
    out = []
    for name in locked:
        leader = name
        while leader not in by_hand and leader in elements and (m := elements[leader].find("mimic")) is not None:
            leader = m.get("joint", "")
        if leader != name and leader in tree.limits and leader not in by_hand:
            unit = "m" if tree.kinds[name] == "prismatic" else "rad"
            out.append(
                f"{name} mimics {leader}, but a robot.toml has no joint that follows another: {name} is locked at "
                f"{locked[name]:.3g} {unit}, and what it carries does not move with {leader}"
            )
    return out


def _depth(elements: dict[str, ET.Element], link: str) -> int:
    parent = {link_at(e, "child"): link_at(e, "parent") for e in elements.values()}
    steps = 0
    while link in parent:
        link, steps = parent[link], steps + 1
    return steps


def _quoted(text: str) -> str:
    return tomlkit.item(text).as_string()


def _figure(value: float) -> str:
    text: str = f"{value:.3g}"
    return text if any(c in text for c in ".e") else f"{text}.0"
