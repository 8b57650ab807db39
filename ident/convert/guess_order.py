"""Which column of a signal is of which joint, where a log has a list of the names of its columns."""

from __future__ import annotations

import re
from collections.abc import Mapping

import numpy as np

# In the name of a column that counts joints.
COUNTED = re.compile(r"(?i)joint|axis|axes|achse|gelenk|motor|drive|(?<![a-z])(id|nr|index)(?![a-z])")
Names = Mapping[str, tuple[str, ...]]


def called(joints: tuple[str, ...]) -> list[tuple[str, str]]:
    """(joint, how a log may call it): its name, and what sets it apart from the others; longer ones first, as
    "joint_1" is also part of "joint_10"."""
    out = {name: name for name in joints}
    parts = {name: name.split("_") for name in joints}
    for name in joints if len(joints) > 1 else ():
        short = "_".join(p for p in parts[name] if not all(p in other for other in parts.values()))
        if len(short) > 2 and any(ch.isalpha() for ch in short):
            out.setdefault(short, name)
    return sorted(((joint, name) for name, joint in out.items()), key=lambda pair: -len(pair[1]))


def columns_of_joints(names: tuple[str, ...], joints: tuple[str, ...]) -> tuple[int, ...] | None:
    """(n,) the column of each joint by the names of the columns; None where a joint has none, or more than one.

    A name is that of a joint, or one begins or ends with the other: "left/joint_1" and "panda_joint1" are "joint_1" and
    "joint1".
    """
    out = []
    for joint in joints:
        shorts = [name for j, name in called(joints) if j == joint]
        ranks = (
            [k for k, name in enumerate(names) if name.lower() == joint.lower()],
            *([k for k, name in enumerate(names) if _alike(name.lower(), short.lower())] for short in shorts),
        )
        found = next((rank for rank in ranks if rank), [])
        if len(found) != 1:
            return None
        out.append(found[0])
    return tuple(out) if len(set(out)) == len(out) else None


def joint_column(labels: Names, signals: Mapping[str, np.ndarray], joints: tuple[str, ...]) -> tuple[str, str] | None:
    """(name, what it holds) of a column that says of which joint a row is; None where there is none.

    Args:
        labels: name -> distinct texts. signals: name -> numbers.
    """
    shorts = [name.lower() for _, name in called(joints)]
    for name, texts in labels.items():
        of_joints = all(any(t.lower() == s or _alike(t.lower(), s) for s in shorts) for t in texts)
        if texts and (of_joints or (len(texts) > 1 and COUNTED.search(name))):
            return name, ", ".join(texts)
    for name, x in signals.items():
        values = np.unique(x) if COUNTED.search(name) and x.ndim == 1 else ()
        if len(values) == len(joints) and any(np.array_equal(values, np.arange(len(joints)) + k) for k in (0, 1)):
            return name, ", ".join(f"{v:g}" for v in values)
    return None


def _alike(a: str, b: str) -> bool:
    """Whether one of two names begins or ends with the other, up to a sign that is no letter and no digit."""
    short, long = sorted((a, b), key=len)
    if not short or not (long.startswith(short) or long.endswith(short)):
        return False
    cut = len(short)
    before = long.endswith(short) and not long[:-cut][-1:].isalnum()
    return before or (long.startswith(short) and not long[cut : cut + 1].isalnum())


def columns_by_names(signal: str, width: int, lists: Names, joints: tuple[str, ...]) -> tuple[tuple[int, ...], str]:
    """(n,) columns of a signal that are of the joints, and a note on what says so.

    Args:
        width: columns of the signal, as many as joints or more.
        lists: name -> strings, of those in the log; empty where they change from row to row.
    """
    first = tuple(range(len(joints)))
    near = {k: v for k, v in lists.items() if _parent(k) == _parent(signal)} or lists
    fitting = {k: v for k, v in near.items() if len(v) == width}
    told = {k: c for k, v in fitting.items() if (c := columns_of_joints(v, joints)) is not None}
    if len(set(told.values())) > 1:
        return first, f"EDIT: joints in the order of the columns, as {' and '.join(told)} name them differently"
    if told:
        name, columns = next(iter(told.items()))
        return columns, f"columns by their names in {name} of the log"
    if fitting and len(joints) > 1:
        name, names = next(iter(fitting.items()))
        return (
            first,
            f"EDIT: joints in the order of the columns, which {name} of the log calls {', '.join(names)[:300]}",
        )
    changing = next((k for k, v in near.items() if not v), None)
    if changing is not None and len(joints) > 1:
        return first, f"EDIT: joints in the order of the columns, whose names in {changing} change from row to row"
    return first, f"EDIT? the first {len(joints)} of {width} columns" if width > len(joints) else ""


def _parent(name: str) -> str:
    """The structure, or the file, in which a signal stands."""
    return name[: max(name.rfind("."), name.rfind(":")) + 1]
