"""Figures of the driven joints as ``robot.toml`` gives them, and guesses of those that it does not."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

from robot_assets.errors import DataError
from robot_assets.guesses import guess_joints
from robot_assets.joint import ENCODER, NOISE, VELOCITY, WINDUP, Joint
from robot_assets.spelling import NAMES, given_names, names_of
from robot_assets.urdf import Description
from robot_assets.values import MISSING, number

OF_DRIVE = ("gear_ratio", "motor_inertia", "stiffness", "damping", "viscous_friction")
DRIVE = re.compile(rf"(?m)^[ \t]*\[\[[ \t]*(?:{'|'.join(NAMES)})[ \t]*\]\]")  # begins the table of one


def read_drives(
    path: Path, entries: list[dict[str, Any]], locked: dict[str, float], urdf: Path, tree: Description
) -> tuple[tuple[Joint, ...], dict[str, tuple[str, ...]]]:
    """Driven joints, and of which of them a figure of the drive, or the limit of the torque, is a guess.

    Args:
        path: of ``robot.toml``. entries: its tables of the joints, with their names.
        locked: where other joints stand, rad or m. tree: what ``urdf`` describes.

    Raises:
        DataError: where a figure is wrong, or misses beside others of the same drive.
    """
    names = [entry["name"] for entry in entries]
    bare = [not any(given_names(entry, figure) for figure in OF_DRIVE[1:]) for entry in entries]
    guesses = [g.joint for g in guess_joints(urdf, tree, names, locked)] if any(bare) else [None] * len(names)
    joints = tuple(
        _joint(entry, str(path), tree, guess if nothing else None)
        for entry, guess, nothing in zip(entries, guesses, bare, strict=True)
    )
    return joints, _guessed(path, entries, joints, tree)


def _guessed(
    path: Path, entries: list[dict], joints: tuple[Joint, ...], tree: Description
) -> dict[str, tuple[str, ...]]:
    """As ``Robot.guessed``."""
    drives = DRIVE.split(path.read_text(encoding="utf-8-sig"))[1:]
    drives += [""] * (len(joints) - len(drives))

    def marked(figure: str) -> re.Pattern[str]:
        aliases = "|".join(names_of(figure))
        return re.compile(rf"(?m)^[ \t]*({aliases})[ \t]*=[^#\n]*#.*\bGUESS\b")

    def unknown(figure: str, joint: Joint, entry: dict, drive: str) -> bool:
        if figure == "torque_limit" and not given_names(entry, figure):
            return joint.torque_limit != tree.efforts[joint.name]
        return not given_names(entry, figure) or bool(marked(figure).search(drive))

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
        used = given_names(entry, key)
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
