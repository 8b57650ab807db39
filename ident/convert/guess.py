"""A first map of a log, guessed from names, shapes and ranges, for a person to edit.

``guess_names`` says what a signal may be by its name, ``guess_units`` in which unit and on which side of the gear,
``guess_time`` which one is the time; ``guess_text`` writes it down.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ident.convert.guess_names import choose, families_of, oriented, score, words_of
from ident.convert.guess_order import Names, joint_column
from ident.convert.guess_text import plain, render
from ident.convert.guess_time import FileClock, FoundTime, find_time
from ident.convert.guess_units import guess_scales, unwrapped
from ident.convert.quantities import UNITS
from ident.convert.reading import survey_log
from ident.convert.spelling import split_unit, unit_of
from ident.convert.texts import VALUES
from robot_assets.errors import DataError
from robot_assets.robot import Robot, linear_joints, load_robot

SHORTEST = 20  # samples; anything shorter is no signal but a setting
LARGEST = 1e30  # no stamp, in any unit, is beyond


@dataclass(frozen=True)
class GuessedMap:
    """The text of a map.

    Attributes:
        found: channel -> what was taken for it, in words.
        missing: required channels for which nothing was found: the map needs them.
        warnings: why something that is in the log was not used, in words.
    """

    text: str
    found: dict[str, str]
    missing: tuple[str, ...]
    warnings: tuple[str, ...] = ()


def guess_map(
    files: Sequence[Path], robot: str | Path, *, progress: Callable[[str], None] = lambda text: None
) -> GuessedMap:
    """Guess the map of one or more logs of a robot.

    Args:
        progress: told in words what is being done.

    Raises:
        DataError: for a log or robot that cannot be read, or where no signal is long enough.
    """
    arm = load_robot(robot)
    paths = [Path(f) for f in files]
    if not paths:
        raise DataError("files", "command line", "none", "at least one log")
    # Damaged values are no reason to guess nothing: the conversion names them.
    surveys = []
    for path in paths:
        progress(f"reading {path.name}")
        surveys.append(survey_log(path))
    progress("guessing the map")
    logs = [{k: np.nan_to_num(np.clip(x, -LARGEST, LARGEST)) for k, x in s.signals.items()} for s in surveys]
    parts = _parts(paths, logs, arm)
    starts = [f"{prefix}:" for prefix in parts] or [""]
    units = {
        f"{p}{k}": u
        for p, s in zip(starts, surveys)
        for k, text in s.units.items()
        if (u := unit_of(text.strip("[](){}<> ")))
    }
    unread = {
        f"{p}{k}": bare
        for p, s in zip(starts, surveys)
        for k, text in s.units.items()
        if f"{p}{k}" not in units and (bare := text.strip("[](){}<> "))
    }
    dates = {f"{p}{k}" for p, s in zip(starts, surveys) for k in s.dates}
    damaged = {
        f"{p}{k}": int(bad[0]) + 1
        for p, s in zip(starts, surveys)
        for k, x in s.signals.items()
        if len(bad := np.flatnonzero(~np.isfinite(x)))
    }
    doubts = {f"{p}{k}": text for p, s in zip(starts, surveys) for k, text in s.doubts.items()}
    warnings = [f"{p.name}: guessed from its first {s.cut} rows" for p, s in zip(paths, surveys) if s.cut]
    clocks = _clocks(logs, starts, units, dates, damaged, arm, warnings) if parts else {}
    signals = _on_one_clock(logs, clocks) if clocks else _joined(logs, parts) if parts else logs[0]
    lengths = [_length(x) for x in signals.values() if _length(x) >= SHORTEST]
    if not lengths:
        why = next((f" ({name} has {text})" for name, text in doubts.items()), "")
        raise DataError("log", str(paths[0]), f"no signal of {SHORTEST} samples or more{why}", "columns of numbers")
    # The log has the length at which most values stand.
    N = max(set(lengths), key=lambda k: sum(x.size for x in signals.values() if _length(x) == k))
    lists = {f"{p}{k}": names for p, s in zip(starts, surveys) for k, names in s.lists.items()}
    if not parts:
        warnings += _other_orders(paths, [s.lists for s in surveys])
    families = families_of({k: x for k, x in signals.items() if _length(x) == N}, units, arm, lists, unread)
    time = (
        FoundTime(rate=min(c.rate for c in clocks.values()))
        if clocks
        else find_time(families, signals, dates, damaged, doubts)
    )
    chosen, others = choose([f for f in families if f.x.shape[1] == arm.n and f.name not in time.sources | dates], arm)
    if not {"tau", "q"} & set(chosen):
        long = joint_column(surveys[0].labels, surveys[0].signals, arm.joint_names) if arm.n > 1 else None
        if long is not None:
            raise DataError(
                "rows",
                str(paths[0]),
                f"rows of one joint each: {plain(long[0])} holds {plain(long[1])}",
                f"a row for each time with columns for all joints: pivot the table by {plain(long[0])}",
            )
        names = ", ".join(plain(f.name) for f in families if f.name not in time.sources)
        raise DataError(
            "signals",
            str(paths[0]),
            f"nothing that looks like a position or a torque of {arm.n} joints: {names[:300] or 'none'}",
            "names or units that tell, or a map by hand",
        )
    linear = linear_joints(arm)
    chosen = {c: unwrapped(f) if c in ("q", "q_ref", "q_link") and not np.any(linear) else f for c, f in chosen.items()}
    scales = guess_scales(chosen, arm, linear, time.rate)
    text = render(paths, arm, parts, clocks, time, chosen, others, scales, families, linear, doubts)
    found = {c: f"{chosen[c].name}{', ' + ', '.join(s.options) if (s := scales[c]).options else ''}" for c in chosen}
    if time.source is not None or clocks:
        found["time"] = (
            f"{', '.join(c.name for c in clocks.values()) if clocks else ' + '.join((time.source or '', *(p[0] for p in time.plus)))}, {time.rate:g} Hz"
        )
        found["time"] += f"; {time.doubt}" if time.doubt else ""
    warnings += [
        f"{name} {doubts[name]}: the conversion will name it"
        for f in chosen.values()
        for name, _ in f.sources
        if name in doubts
    ]
    if time.lost is not None:
        warnings.insert(0, f"no time: {time.lost[0]} {time.lost[2]}")
    return GuessedMap(text, found, tuple(c for c in ("tau", "q") if c not in chosen), tuple(warnings))


def _length(x: np.ndarray) -> int:
    return max(x.shape) if x.ndim else 0


def _other_orders(paths: list[Path], lists: list[Names]) -> list[str]:
    """Of logs each, those that name their columns otherwise than the first, from which the map is guessed."""
    return [
        f"{path.name}: {plain(name)} lists other names than in {paths[0].name}: it needs a map of its own"
        for path, own in zip(paths[1:], lists[1:], strict=True)
        for name in own
        if own[name] != lists[0].get(name, own[name])
    ]


# --- files of one log, or a log each


def _parts(paths: list[Path], logs: list[dict[str, np.ndarray]], arm: Robot) -> dict[str, tuple[Path, int | None]]:
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
    shortest = min((_length(x) for log in logs for x in log.values() if _length(x) >= SHORTEST), default=0)
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
        f.x.shape[1] == 1 for f in families_of({k: x for k, x in logs[0].items() if _length(x) >= SHORTEST}, {}, arm)
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
            if name != c.name and _length(x) == len(c.t):
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
