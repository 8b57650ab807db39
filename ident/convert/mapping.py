"""The map of a log: which columns hold what, in which units and on which side of the gear."""

from __future__ import annotations

import re
import tomllib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from robot_assets.errors import DataError

UNITS = {
    "rad": 1.0, "deg": np.pi / 180, "mrad": 1e-3, "rev": 2 * np.pi, "rad/s": 1.0, "deg/s": np.pi / 180,
    "N m": 1.0, "mN m": 1e-3, "kN m": 1e3, "N": 1.0, "A": 1.0, "mA": 1e-3, "V": 1.0, "m": 1.0, "mm": 1e-3,
    "m/s": 1.0, "s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9, "degC": 1.0,
}
COLUMN = re.compile(r"(tau|q|qd|r|q_ref|q_link|temp)_([1-9][0-9]*)$")
OPTIONS = {"source", "unit", "sign", "scale", "offset", "gear", "side", "torque_constant", "index", "unwrap"}


@dataclass(frozen=True)
class Column:
    """``channel_joint = sign (scale unit source [+ gear, torque constant] + offset)``.

    Attributes:
        factor: everything multiplicative: unit, sign, scale, torque constant and gear ratio.
        index: column of a two-dimensional source, from 0.
    """

    channel: str
    joint: int
    source: str
    factor: float
    offset: float
    index: int
    unwrap: bool


@dataclass(frozen=True)
class Part:
    """Periods ``first..last`` (from 1) of a periodic log as one segment."""

    first: int
    last: int
    role: str


@dataclass(frozen=True)
class LogMap:
    """A whole map."""

    sample_rate: float
    input_hold: str
    time: str | None
    time_factor: float
    columns: tuple[Column, ...]
    period: int | None
    parts: tuple[Part, ...]
    operating_point: str
    excited_from: str | None
    excited_threshold: float
    excited_lines: tuple[int, ...]
    roles: dict[str, str]
    split: float | None


def read_map(path: str | Path, ratios: np.ndarray) -> LogMap:
    """Read a map file.

    Args:
        ratios: (n,) gear ratios of the robot, for columns with ``side = "motor"``.

    Raises:
        DataError: with the key at fault.
    """
    where = str(path)
    try:
        data = tomllib.loads(Path(path).read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError, tomllib.TOMLDecodeError) as err:
        raise DataError("map", where, str(err), "a readable TOML map") from err
    rate = data.get("sample_rate")
    if not isinstance(rate, int | float) or not 0 < rate < 1e7:
        raise DataError("sample_rate", where, repr(rate), "Hz, above zero")
    if data.get("input_hold", "none") not in ("zoh", "none"):
        raise DataError("input_hold", where, repr(data["input_hold"]), '"zoh" or "none"')
    entries = data.get("columns")
    if not isinstance(entries, dict) or not entries:
        raise DataError("[columns]", where, repr(entries)[:60], 'a table such as q_1 = { source = "angle", unit = "deg" }')
    columns = tuple(_column(k, v, ratios, where) for k, v in entries.items())
    have = {(c.channel, c.joint) for c in columns}
    for channel in ("tau", "q"):
        for j in range(len(ratios)):
            if (channel, j) not in have:
                raise DataError(f"{channel}_{j + 1}", where, "no such column", f"{channel}_1 to {channel}_{len(ratios)}")
    time = data.get("time")
    if time is not None and not (isinstance(time, dict) and isinstance(time.get("source"), str)):
        raise DataError("[time]", where, repr(time), '{ source = "...", unit = "s" }')
    multisine = data.get("multisine", {})
    parts = tuple(
        Part(int(p["first"]), int(p["last"]), str(p.get("role", "identification"))) for p in multisine.get("part", [])
    )
    return LogMap(
        sample_rate=float(rate),
        input_hold=data.get("input_hold", "none"),
        time=None if time is None else time["source"],
        time_factor=1.0 if time is None else _unit(time.get("unit", "s"), "time", where),
        columns=columns,
        period=multisine.get("period"),
        parts=parts,
        operating_point=str(multisine.get("operating_point", "op01")),
        excited_from=multisine.get("excited_from"),
        excited_threshold=float(multisine.get("excited_threshold", 0.05)),
        excited_lines=tuple(int(k) for k in multisine.get("excited_lines", [])),
        roles={str(k): str(v) for k, v in data.get("roles", {}).items()},
        split=data.get("split"),
    )


def _unit(unit: Any, key: str, where: str) -> float:
    if unit not in UNITS:
        raise DataError(f"unit of {key}", where, repr(unit), f"one of {list(UNITS)}")
    return UNITS[unit]


def _column(key: str, entry: Any, ratios: np.ndarray, where: str) -> Column:
    match = COLUMN.match(key)
    if match is None or int(match[2]) > len(ratios):
        raise DataError("column", where, key, f"tau_, q_, qd_, r_, q_ref_, q_link_ or temp_ and 1 to {len(ratios)}")
    if isinstance(entry, str):
        entry = {"source": entry}
    if not isinstance(entry, dict) or not isinstance(entry.get("source"), str):
        raise DataError(key, where, repr(entry), '{ source = "name in the log", unit = "..." }')
    stray = set(entry) - OPTIONS
    if stray:
        raise DataError(f"{key}.{sorted(stray)[0]}", where, "an unknown option", f"one of {sorted(OPTIONS)}")
    channel, joint = match[1], int(match[2]) - 1
    factor = _unit(entry.get("unit", "N m" if channel in ("tau", "r") else "rad"), key, where)
    factor *= float(entry.get("sign", 1)) * float(entry.get("scale", 1.0)) * float(entry.get("torque_constant", 1.0))
    side = entry.get("side", "link")
    if side not in ("link", "motor"):
        raise DataError(f"{key}.side", where, repr(side), '"link" or "motor"')
    ratio = float(entry.get("gear", ratios[joint] if side == "motor" else 1.0))
    factor *= ratio if channel in ("tau", "r") else 1.0 / ratio
    return Column(
        channel, joint, entry["source"], factor, float(entry.get("offset", 0.0)), int(entry.get("index", joint)), bool(entry.get("unwrap", False))
    )
