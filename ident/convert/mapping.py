"""The map of a log: which columns hold what, in which units and on which side of the gear."""

from __future__ import annotations

import itertools
import re
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from ident.convert.encoding import known_encoding
from ident.convert.quantities import KINDS, is_position, unit_factor, units_of
from robot_assets.errors import DataError
from robot_assets.values import choice, exists, instead_of_file, number, read_toml, show, subtable, tables, text, whole

SMALLEST = 1e-15  # a factor that leaves nothing of any signal
COLUMN = re.compile(r"(tau|q|qd|r|q_ref|q_link|temp)_([1-9][0-9]{0,3})$")
OPTIONS = {"source", "unit", "sign", "scale", "offset", "gear", "side", "torque_constant", "index", "unwrap", "plus"}
KEYS = {"sample_rate", "input_hold", "encoding", "time", "files", "columns", "multisine", "roles", "split"}
PLUS_KEYS = {"source", "factor", "index"}
TIME_KEYS = {"source", "unit", "plus"}
TIME_PLUS_KEYS = {"source", "unit"}
FILE_KEYS = {"name", "width", "time", "unit", "shift", "encoding"}
MULTISINE_KEYS = {"period", "operating_point", "excited_from", "excited_threshold", "excited_lines", "part"}
PART_KEYS = {"first", "last", "role"}
TIMES = list(KINDS["time"])
ROLES = ("identification", "validation")
SHIPPED = Path(__file__).parent / "maps"


@dataclass(frozen=True)
class Column:
    """``channel_joint = factor source + offset + sum of factor_k source_k``.

    Attributes:
        factor: everything multiplicative: unit, sign, scale, torque constant and gear ratio.
        offset: in the unit of the dataset, added last.
        index: column of a two-dimensional source, from 0; None: that of the joint.
        turn: of the source, in its own units, by which it jumps where it wraps; None where it does not.
        plus: (source, factor, index) of further terms: gears that couple joints.
        geared: whether the gear ratio of the robot is in the factor.
    """

    channel: str
    joint: int
    source: str
    factor: float
    offset: float
    index: int | None
    turn: float | None
    plus: tuple[tuple[str, float, int | None], ...] = ()
    geared: bool = False

    @property
    def sources(self) -> tuple[str, ...]:
        """Signals of the log that make up the column."""
        return (self.source, *(p[0] for p in self.plus))


@dataclass(frozen=True)
class Part:
    """Periods ``first..last`` (from 1) of a periodic log as one segment; without a role it has that of its file."""

    first: int
    last: int
    role: str | None


@dataclass(frozen=True)
class FilePart:
    """One of the files that a log is spread over; its signals are named ``prefix:signal``.

    Attributes:
        pattern: file name, with * and ?.
        width: values of one sample, where the file has one value a line; else None.
        time: its own time column, without the prefix; None where it has none. time_factor: s per unit of it.
        shift: s, added to its time: clocks may begin apart.
        encoding: of a text, where it is not that of the whole log.
    """

    prefix: str
    pattern: str
    width: int | None
    time: str | None = None
    time_factor: float = 1.0
    shift: float = 0.0
    encoding: str = ""


@dataclass(frozen=True)
class LogMap:
    """A whole map.

    Attributes:
        sample_rate: Hz, of the dataset. time_factor: s per unit of the time column.
        encoding: of texts; empty where they tell it themselves.
        time_plus: (source, s per unit) of what is added to it: full seconds with their fraction beside them.
        files: where a log is spread over several; else empty.
        roles: file name or its stem -> role; whole: whether each must be of a file given. split: share of a file
            without a role that is for identification, the rest validates.
    """

    sample_rate: float
    input_hold: str
    time: str | None
    time_factor: float
    files: tuple[FilePart, ...]
    columns: tuple[Column, ...]
    period: int | None
    parts: tuple[Part, ...]
    operating_point: str
    excited_from: str | None
    excited_threshold: float
    excited_lines: tuple[int, ...]
    roles: dict[str, str]
    split: float | None
    whole: bool = True
    time_plus: tuple[tuple[str, float], ...] = ()
    encoding: str = ""

    @property
    def sources(self) -> set[str]:
        """Names of all signals that the map reads."""
        out = {s for c in self.columns for s in c.sources}
        out |= {f"{f.prefix}:{f.time}" for f in self.files if f.time is not None}
        out |= {s for s, _ in self.time_plus}
        return out | {s for s in (self.time, self.excited_from) if s is not None}


def read_map(path: str | Path, ratios: np.ndarray, linear: np.ndarray) -> LogMap:
    """Read a map file, or one of ``SHIPPED`` by its name.

    Args:
        ratios: (n,) gear ratios of the robot, for columns with ``side = "motor"``.
        linear: (n,) whether a joint is linear.

    Raises:
        DataError: with the key at fault.
    """
    file = Path(path)
    shipped = not exists(file) and exists(SHIPPED / f"{path}.toml") and file.name == str(path)
    if shipped:
        file = SHIPPED / f"{path}.toml"
    if not exists(file):
        raise DataError(
            "map",
            str(path),
            instead_of_file(Path(path)),
            f"a map, or one of {sorted(p.stem for p in SHIPPED.glob('*.toml'))}",
        )
    where = str(file)
    data = read_toml(file, "map")
    _known(data, KEYS, "", where)
    entries = data.get("columns")
    if not isinstance(entries, dict) or not entries:
        raise DataError("[columns]", where, show(entries), 'a table such as q_1 = { source = "angle", unit = "deg" }')
    columns = tuple(_column(k, v, ratios, linear, where) for k, v in entries.items())
    have = {(c.channel, c.joint) for c in columns}
    # Link encoders may be at some joints only, and what is not injected is no excitation.
    whole_ones = {"tau", "q", *(c.channel for c in columns)} - {"q_link", "r"}
    for channel in sorted(whole_ones):
        for j in range(len(ratios)):
            if (channel, j) not in have:
                raise DataError(
                    f"{channel}_{j + 1}", where, "no such column", f"{channel}_1 to {channel}_{len(ratios)}"
                )
    time = subtable(data, "time", where)
    _known(time, TIME_KEYS, "time.", where)
    multisine = subtable(data, "multisine", where)
    _known(multisine, MULTISINE_KEYS, "multisine.", where)
    parts = tuple(_part(entry, where) for entry in tables(multisine, "part", where))
    if "multisine" in data and not parts:
        raise DataError("[[multisine.part]]", where, "none", "the periods of at least one segment")
    by_first = sorted(parts, key=lambda p: p.first)
    for a, b in itertools.pairwise(by_first):
        if b.first <= a.last and (a.role or ROLES[0]) != (b.role or ROLES[0]):
            found = f"period {b.first} for {a.role or ROLES[0]} and for {b.role or ROLES[0]}"
            raise DataError("[[multisine.part]]", where, found, "held-out periods that nothing is fitted to")
    lines = multisine.get("excited_lines", [])
    if not isinstance(lines, list) or not all(
        isinstance(k, int) and not isinstance(k, bool) and 0 < k < 2**53 for k in lines
    ):
        raise DataError("multisine.excited_lines", where, show(lines), "whole numbers from 1")
    period = whole(multisine, "period", where, low=4) if multisine else None
    if period is not None and lines and max(lines) >= period / 2:
        raise DataError("multisine.excited_lines", where, f"line {max(lines)}", f"lines below Nyquist, {period / 2:g}")
    roles = subtable(data, "roles", where)
    if roles and any(part.role is not None for part in parts):
        raise DataError("[roles]", where, "role in [[multisine.part]] as well", "one of both")
    files = tuple(_file(k, v, where) for k, v in subtable(data, "files", where).items())
    source = text(time, "source", f"{where} time") if "time" in data else None
    factor = unit_factor(time.get("unit", "s"), TIMES, "time", where)
    time_plus = tuple(_time_plus(p, where) for p in tables(time, "plus", f"{where} time"))
    if time_plus and any(f.time for f in files):
        raise DataError("time.plus", where, "a time of each of [files] as well", "one time for all of them")
    if files and source is not None and not time_plus and not any(source.startswith(f"{f.prefix}:") for f in files):
        # A column of every file: each has a clock of its own.
        files, source = tuple(f if f.time else replace(f, time=source, time_factor=factor) for f in files), None
    clocks = [f.time is not None for f in files]
    if any(clocks) and (source is not None or not all(clocks)):
        found = f"none for {files[clocks.index(False)].prefix}" if source is None else f"[time] {source} as well"
        raise DataError("time of [files]", where, found, "a time for each of the files, or one for all of them")
    return LogMap(
        sample_rate=number(data, "sample_rate", where, low=1e-3, high=1e7),
        input_hold=choice(data, "input_hold", where, ("zoh", "none"), "none"),
        time=source,
        time_factor=factor,
        files=files,
        columns=columns,
        period=period,
        parts=parts,
        operating_point=text(multisine, "operating_point", where, "op01"),
        excited_from=text(multisine, "excited_from", where) if "excited_from" in multisine else None,
        excited_threshold=number(multisine, "excited_threshold", where, low=0.0, high=1.0, default=0.05),
        excited_lines=tuple(lines),
        roles={k: choice(roles, k, where, ROLES) for k in roles},
        split=number(data, "split", where, low=0.05, high=0.95) if "split" in data else None,
        whole=not shipped,  # of published logs any may be at hand
        time_plus=time_plus,
        encoding=_encoding(data, "encoding", where),
    )


def _known(table: dict, keys: set[str], start: str, where: str) -> None:
    """Raise a DataError where a table has a key that nothing reads: a misspelt one would count for nothing."""
    stray = set(table) - keys
    if stray:
        raise DataError(f"{start}{min(stray)}", where, "an unknown key", f"one of {sorted(keys)}")


def _encoding(table: dict, key: str, where: str) -> str:
    return known_encoding(text(table, "encoding", where), key, where) if "encoding" in table else ""


def _time_plus(entry: dict, where: str) -> tuple[str, float]:
    _known(entry, TIME_PLUS_KEYS, "time.plus.", where)
    return text(entry, "source", f"{where} time.plus"), unit_factor(entry.get("unit", "s"), TIMES, "time.plus", where)


def _part(entry: dict, where: str) -> Part:
    _known(entry, PART_KEYS, "multisine.part.", where)
    first = whole(entry, "first", where, low=1)
    last = whole(entry, "last", where, low=first)
    return Part(first, last, choice(entry, "role", where, ROLES) if "role" in entry else None)


def _file(prefix: str, entry: Any, where: str) -> FilePart:
    if isinstance(entry, str):
        entry = {"name": entry}
    if not isinstance(entry, dict):
        raise DataError(
            f"files.{prefix}",
            where,
            show(entry),
            '"name of a file" or { name = "...", width = 7, time = "t", unit = "s" }',
        )
    _known(entry, FILE_KEYS, f"files.{prefix}.", where)
    here = f"{where} files.{prefix}"
    return FilePart(
        prefix,
        text(entry, "name", here),
        whole(entry, "width", here, low=1, default=None),
        text(entry, "time", here) if "time" in entry else None,
        unit_factor(entry.get("unit", "s"), TIMES, f"files.{prefix}", where),
        number(entry, "shift", here, default=0.0),
        _encoding(entry, f"files.{prefix}.encoding", where),
    )


def _column(key: str, entry: Any, ratios: np.ndarray, linear: np.ndarray, where: str) -> Column:
    match = COLUMN.match(key)
    if match is None or int(match[2]) > len(ratios):
        raise DataError("column", where, key, f"tau_, q_, qd_, r_, q_ref_, q_link_ or temp_ and 1 to {len(ratios)}")
    if isinstance(entry, str):
        entry = {"source": entry}
    if not isinstance(entry, dict) or not isinstance(entry.get("source"), str):
        raise DataError(key, where, show(entry), '{ source = "name in the log", unit = "..." }')
    _known(entry, OPTIONS, f"{key}.", where)
    channel, joint = match[1], int(match[2]) - 1
    here = f"{where} {key}"
    motor = choice(entry, "side", here, ("link", "motor"), "link") == "motor"
    allowed = units_of(channel, bool(linear[joint]), "gear" in entry or (motor and bool(linear[joint])))
    factor = unit_factor(entry["unit"], allowed, key, where) if "unit" in entry else 1.0
    if number(entry, "sign", here, default=1.0) not in (-1.0, 1.0):
        raise DataError(f"{key}.sign", where, show(entry["sign"]), "1 or -1 (scale multiplies)")
    for option in ("sign", "scale", "torque_constant"):
        factor *= number(entry, option, here, default=1.0)
    turn = 2 * np.pi / abs(factor) if factor else None
    ratio = ratios[joint] if motor else 1.0
    ratio = number(entry, "gear", here, default=float(ratio))
    if ratio == 0 or factor == 0:
        raise DataError(key, where, "a factor of zero", "gear, sign, scale and torque_constant other than zero")
    if abs(factor) < SMALLEST or abs(ratio) < SMALLEST:
        raise DataError(
            key,
            where,
            f"a factor of {min(abs(factor), abs(ratio)):.3g}",
            f"unit, sign, scale, torque_constant and gear of at least {SMALLEST:g} in all",
        )
    # Torques grow by the gear ratio on the way to the link, angles shrink; a temperature has no side.
    by_torque = channel == "tau" or (channel == "r" and not is_position(entry.get("unit")))
    factor *= ratio if by_torque else 1.0 if channel == "temp" else 1.0 / ratio
    unwrap = entry.get("unwrap", False)
    if not isinstance(unwrap, bool):
        raise DataError(f"{key}.unwrap", where, show(unwrap), "true or false")
    plus = tables(entry, "plus", here)
    for p in plus:
        _known(p, PLUS_KEYS, f"{key}.plus.", where)
    return Column(
        channel,
        joint,
        entry["source"],
        factor,
        number(entry, "offset", here, default=0.0),
        whole(entry, "index", here, low=0, default=None),
        turn if unwrap else None,
        tuple(
            (text(p, "source", here), number(p, "factor", here), whole(p, "index", here, low=0, default=None))
            for p in plus
        ),
        motor and "gear" not in entry and channel != "temp",
    )
