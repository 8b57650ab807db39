"""The files of a log to be guessed: one log over several files, or a log each; what they hold together."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

import numpy as np

from ident.convert.guess_names import families_of, oriented, score, words_of
from ident.convert.guess_order import Names
from ident.convert.guess_text import plain
from ident.convert.guess_time import FileClock, find_time
from ident.convert.quantities import UNITS
from ident.convert.reading import Survey
from ident.convert.spelling import split_unit, unit_of
from ident.convert.texts import VALUES
from robot_assets.errors import DataError
from robot_assets.robot import Robot

SHORTEST = 20  # samples; anything shorter is no signal but a setting
LARGEST = 1e30  # no stamp, in any unit, is beyond
BRACKETS = "[](){}<> "  # about a unit

T = TypeVar("T")


@dataclass(frozen=True)
class ReadLog:
    """What the files of a log hold; names are ``prefix:name`` where it is one log over several files.

    Attributes:
        parts: prefix -> (file, width) of one log over several files; empty where each file is a log.
        clocks: prefix -> clock where each file has one of its own.
        signals: those of all files, or of the first where each is a log.
        length: samples at which most values stand.
        units: by name, as the catalogue of units has them; ``unread``: those that it does not have, as they are written.
        dates: names of those that are dates.
        damaged: name -> row of the first value that is no number.
        doubts: name -> what is doubtful about how it was read, in words.
        lists: as of ``Survey``.
        warnings: what a person should know, in words.
    """

    parts: dict[str, tuple[Path, int | None]]
    clocks: dict[str, FileClock]
    signals: dict[str, np.ndarray]
    length: int
    units: dict[str, str]
    unread: dict[str, str]
    dates: set[str]
    damaged: dict[str, int]
    doubts: dict[str, str]
    lists: dict[str, tuple[str, ...]]
    warnings: list[str]

    def long_signals(self) -> dict[str, np.ndarray]:
        """Those of the length at which most values stand."""
        return {k: x for k, x in self.signals.items() if length_of(x) == self.length}


def read_together(paths: Sequence[Path], surveys: Sequence[Survey], arm: Robot) -> ReadLog:
    """What the files of a log hold together.

    Raises:
        DataError: where no signal is long enough.
    """
    # Damaged values are no reason to guess nothing: the conversion names them.
    logs = [{k: np.clip(_held(x), -LARGEST, LARGEST) for k, x in s.signals.items()} for s in surveys]
    parts = _parts(paths, logs, arm)
    starts = [f"{prefix}:" for prefix in parts] or [""]

    def named(of: Callable[[Survey], Mapping[str, T]]) -> dict[str, T]:
        return {f"{start}{k}": x for start, s in zip(starts, surveys) for k, x in of(s).items()}

    written = {k: text.strip(BRACKETS) for k, text in named(lambda s: s.units).items()}
    units = {k: unit for k, text in written.items() if (unit := unit_of(text))}
    dates = set(named(lambda s: dict.fromkeys(s.dates)))
    bad = {k: np.flatnonzero(~np.isfinite(x)) for k, x in named(lambda s: s.signals).items()}
    damaged = {k: int(rows[0]) + 1 for k, rows in bad.items() if len(rows)}
    doubts = named(lambda s: s.doubts)
    warnings = [f"{p.name}: guessed from its first {s.cut} rows" for p, s in zip(paths, surveys, strict=True) if s.cut]
    clocks = _clocks(logs, starts, units, dates, damaged, arm, warnings) if parts else {}
    signals = _on_one_clock(logs, clocks) if clocks else _joined(logs, parts) if parts else logs[0]
    lengths = [length_of(x) for x in signals.values() if length_of(x) >= SHORTEST]
    if not lengths:
        why = next((f" ({name} has {text})" for name, text in doubts.items()), "")
        raise DataError("log", str(paths[0]), f"no signal of {SHORTEST} samples or more{why}", "columns of numbers")
    if not parts:
        warnings += _other_orders(paths, [s.lists for s in surveys])
    return ReadLog(
        parts=parts,
        clocks=clocks,
        signals=signals,
        length=max(set(lengths), key=lambda k: sum(x.size for x in signals.values() if length_of(x) == k)),
        units=units,
        unread={k: text for k, text in written.items() if k not in units and text},
        dates=dates,
        damaged=damaged,
        doubts=doubts,
        lists=named(lambda s: s.lists),
        warnings=warnings,
    )


def _held(x: np.ndarray) -> np.ndarray:
    """A signal whose values that are no numbers are those before them, or the first; zero where it has none."""
    finite = np.isfinite(x)
    if np.all(finite):
        return x
    rows, good = oriented(x), oriented(finite)
    before = np.maximum.accumulate(np.where(good, np.arange(len(rows))[:, None], -1), axis=0)
    out = np.take_along_axis(rows, np.where(before < 0, np.argmax(good, axis=0), before), axis=0)
    out = np.where(np.any(good, axis=0), out, 0.0)
    return out.reshape(x.shape) if x.ndim < 2 or out.shape == x.shape else out.T


def length_of(x: np.ndarray) -> int:
    """Samples of a signal."""
    return max(x.shape) if x.ndim else 0


def _other_orders(paths: Sequence[Path], lists: Sequence[Names]) -> list[str]:
    """Of logs each, those that name their columns otherwise than the first, from which the map is guessed."""
    return [
        f"{path.name}: {plain(name)} lists other names than in {paths[0].name}: it needs a map of its own"
        for path, own in zip(paths[1:], lists[1:], strict=True)
        for name in own
        if own[name] != lists[0].get(name, own[name])
    ]


def _parts(paths: Sequence[Path], logs: list[dict[str, np.ndarray]], arm: Robot) -> dict[str, tuple[Path, int | None]]:
    """Prefix -> (file, width) where the files are parts of one log; empty where each is a log."""
    n = arm.n
    if len(paths) == 1:
        x = logs[0].get(VALUES)
        if x is None or x.shape[1] > 1 or n == 1 or x.size % n:
            return {}
        return {paths[0].stem: (paths[0], n)}
    told = [split_unit(name) for name in logs[0]]
    scores = [score(words_of(stem), channel, unit) for stem, unit in told for channel in ("tau", "q")]
    both = all(any(score(words_of(stem), c, unit) > 0 for stem, unit in told) for c in ("tau", "q"))
    if scores and both and not _a_joint_each(logs, arm):
        return {}
    shortest = min((length_of(x) for log in logs for x in log.values() if length_of(x) >= SHORTEST), default=0)
    out: dict[str, tuple[Path, int | None]] = {}
    for path, log in zip(paths, logs, strict=True):
        x = log.get(VALUES)
        folded = x is not None and x.shape[1] == 1 and n > 1 and x.size == n * shortest
        out[path.stem if path.stem not in out else path.name] = (path, n if folded else None)
    return out


def _a_joint_each(logs: list[dict[str, np.ndarray]], arm: Robot) -> bool:
    """Whether files that have position and torque are of a joint each: as many as joints, alike, and none has columns
    of all."""
    if len(logs) != arm.n or arm.n == 1 or any(set(log) != set(logs[0]) for log in logs):
        return False
    return all(
        f.x.shape[1] == 1 for f in families_of({k: x for k, x in logs[0].items() if length_of(x) >= SHORTEST}, {}, arm)
    )


def _clocks(
    logs: list[dict[str, np.ndarray]],
    starts: list[str],
    units: dict[str, str],
    dates: set[str],
    damaged: Mapping[str, int],
    arm: Robot,
    warnings: list[str],
) -> dict[str, FileClock]:
    """Prefix -> clock where each file has one of its own; else empty, and ``warnings`` say of one that cannot be
    used."""
    out = {}
    for log, start in zip(logs, starts, strict=True):
        own = {k: units[f"{start}{k}"] for k in log if f"{start}{k}" in units}
        own_dates, bad = (
            {d.removeprefix(start) for d in dates if d.startswith(start)},
            {k: damaged[f"{start}{k}"] for k in log if f"{start}{k}" in damaged},
        )
        time = find_time(families_of(log, own, arm), log, own_dates, bad, {})
        if time.source is None or time.t is None or time.rate is None or time.plus:
            if time.lost is not None:
                warnings.append(f"no time: {start}{time.lost[0]} {time.lost[2]}")
            return {}
        out[start] = FileClock(time.source, time.rate, time.unit, time.t * UNITS[time.unit or "s"])
    return out


def _on_one_clock(logs: list[dict[str, np.ndarray]], clocks: dict[str, FileClock]) -> dict[str, np.ndarray]:
    """Signals of all files at the lowest of their rates, near enough for a guess: begun together."""
    rate, end = min(c.rate for c in clocks.values()), min(c.t[-1] - c.t[0] for c in clocks.values())
    t = np.arange(max(int(end * rate), SHORTEST)) / rate
    out = {}
    for log, (start, c) in zip(logs, clocks.items(), strict=True):
        for name, x in log.items():
            if name != c.name and length_of(x) == len(c.t):
                out[f"{start}{name}"] = np.stack(
                    [np.interp(t, c.t - c.t[0], column) for column in oriented(x).T], axis=1
                )
    return out


def _joined(logs: list[dict[str, np.ndarray]], parts: dict[str, tuple[Path, int | None]]) -> dict[str, np.ndarray]:
    out = {}
    for log, (prefix, (_, width)) in zip(logs, parts.items(), strict=True):
        for name, x in log.items():
            out[f"{prefix}:{name}"] = x if width is None else x.reshape(-1, width)
    return out
