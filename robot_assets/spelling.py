"""The drives, loads and limits of a ``robot.toml`` in the ways in which people write them down: a table for each.

``[[joint]]`` and ``[[load]]`` are the way of this project. What else says the same without doubt is read too: another
name of the array, one table where there is one, a table of each joint by its name, lists in the order of the joints, or
a list of the joints and their drives apart.
"""

from __future__ import annotations

from typing import Any

from robot_assets.errors import DataError
from robot_assets.values import show, subtable, tables

NAMES = ("joint", "joints", "drive", "drives")
LOADS = ("load", "loads", "payload", "payloads")
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
# Tables with a figure for all joints, or a list of one for each; and names beside those of ``names_of`` that only they
# have.
OF_ALL: dict[str, dict[str, tuple[str, ...]]] = {
    "noise": {"q_std": (), "tau_std": ()},
    "limits": {"torque_limit": ("effort", "torque"), "velocity_limit": ("velocity",)},
}


def joint_tables(data: dict[str, Any], where: str) -> list[dict[str, Any]]:
    """The tables of the driven joints, from the base on, each with its ``name``; and no more where nothing is said of
    the drives but whose they are.

    Raises:
        DataError: where the drives are written in two ways, lists differ in length, or a joint has no name.
    """
    listed = [key for key in NAMES if _all(data.get(key), str)]  # of joints by their names, the drives elsewhere
    used = [key for key in NAMES if key in data and key not in listed[:1]]
    if len(used) > 1:
        raise DataError(f"[[{used[1]}]]", where, f"[[{used[0]}]] beside it", "the drives in one place")
    if listed:
        entries = _in_order(data, data[listed[0]], used, where)
    else:
        entries = _entries(data, used, where)
    for table, figures in OF_ALL.items():
        entries = _with_figures(entries, table, subtable(data, table, where), figures, where)
    return entries


def load_tables(data: dict[str, Any], where: str) -> list[dict[str, Any]]:
    """The tables of the known loads.

    Raises:
        DataError: where they are written in two ways.
    """
    used = [key for key in LOADS if key in data and (key == LOADS[0] or isinstance(data[key], dict | list))]
    if len(used) > 1:
        raise DataError(f"[[{used[1]}]]", where, f"[[{used[0]}]] beside it", "the loads in one place")
    return some_tables(data, used[0], where) if used else []


def some_tables(data: dict[str, Any], key: str, where: str) -> list[dict[str, Any]]:
    """An array of tables, or the table where there is one; empty where the key is absent."""
    return tables({key: [data[key]]} if isinstance(data.get(key), dict) else data, key, where)


def names_of(figure: str) -> tuple[str, ...]:
    """The names that a figure of a joint goes by."""
    return (figure, *OTHER_NAMES.get(figure, ()))


def given_names(entry: dict[str, Any], figure: str) -> list[str]:
    """The names by which the table of a joint gives a figure."""
    return [name for name in names_of(figure) if name in entry]


def _in_order(data: dict[str, Any], names: list[str], used: list[str], where: str) -> list[dict[str, Any]]:
    """The tables of joints that are listed by their names, in that order."""
    if not used:
        return [{"name": name} for name in names]
    drives = data[used[0]]
    if isinstance(drives, dict) and not _all(list(drives.values()), dict):
        return _of_lists(drives, names, where)
    entries = _entries(data, used, where)
    if len(entries) == len(names) and not any("name" in entry for entry in entries):
        return [{"name": name, **entry} for name, entry in zip(names, entries, strict=True)]
    given = [entry.get("name") for entry in entries]
    if len(given) != len(names) or not all(given.count(name) == 1 for name in names):
        raise DataError(f"[[{used[0]}]]", where, f"drives of {show(given)}", f"one of each of {names}")
    return [entries[given.index(name)] for name in names]


def _entries(data: dict[str, Any], used: list[str], where: str) -> list[dict[str, Any]]:
    key = used[0] if used else NAMES[0]
    entry = data.get(key)
    if isinstance(entry, dict) and _all(list(entry.values()), dict):
        return [{"name": name, **own} for name, own in entry.items()]
    if isinstance(entry, dict):
        named = [k for k in ("name", "names", "joint", "joints") if k in entry]
        if len(named) != 1 or not _all(entry[named[0]], str):
            raise DataError(f"[{key}]", where, show(sorted(entry)), "[[joint]] tables, or lists with one of names")
        return _of_lists({k: v for k, v in entry.items() if k != named[0]}, entry[named[0]], where)
    return [_named(own) for own in tables(data, key, where)]


def _named(entry: dict[str, Any]) -> dict[str, Any]:
    """The table of a drive that says which joint it turns, with that as its name."""
    if "name" in entry or "joint" not in entry:
        return entry
    return {"name": entry["joint"], **{k: v for k, v in entry.items() if k != "joint"}}


def _of_lists(lists: dict[str, Any], names: list[str], where: str) -> list[dict[str, Any]]:
    for key, values in lists.items():
        if not isinstance(values, list) or len(values) != len(names):
            raise DataError(key, where, show(values), f"a list of {len(names)} in the order of {names}")
    return [{"name": name, **{k: v[i] for k, v in lists.items()}} for i, name in enumerate(names)]


def _with_figures(
    entries: list[dict[str, Any]], table: str, given: dict[str, Any], figures: dict[str, tuple[str, ...]], where: str
) -> list[dict[str, Any]]:
    """Figures of a table for all joints, as ``[noise]`` of a dataset, given to those that have none of their own."""
    names = [entry.get("name") for entry in entries]
    if _all(list(given.values()), dict) and any(name in names for name in given):
        return _with_own(entries, table, given, figures, where)
    for figure, others in figures.items():
        used = [key for key in (*names_of(figure), *others) if key in given]
        if not used:
            continue
        if len(used) > 1:
            raise DataError(f"[{table}] {used[1]}", where, f"{used[0]} beside it", "one of the two: they are the same")
        key, values = used[0], given[used[0]]
        if not isinstance(values, list):
            values = [values] * len(entries)
        if len(values) != len(entries):
            raise DataError(f"[{table}] {key}", where, show(values), f"a number, or a list of {len(entries)}")
        entries = [
            entry if given_names(entry, figure) else {**entry, figure: value}
            for entry, value in zip(entries, values, strict=True)
        ]
    return entries


def _with_own(
    entries: list[dict[str, Any]], table: str, given: dict[str, Any], figures: dict[str, tuple[str, ...]], where: str
) -> list[dict[str, Any]]:
    """The same of a table that has one of each joint, by its name."""
    names = [str(entry.get("name")) for entry in entries]
    strange = [name for name in given if name not in names]
    if strange:
        raise DataError(f"[{table}.{strange[0]}]", where, show(strange[0]), f"one of the joints {names}")
    return [
        _with_figures([entry], table, given.get(name, {}), figures, where)[0]
        for name, entry in zip(names, entries, strict=True)
    ]


def _all(values: Any, kind: type) -> bool:
    return isinstance(values, list) and bool(values) and all(isinstance(v, kind) for v in values)
