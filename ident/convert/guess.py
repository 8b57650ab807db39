"""A first map of a log, guessed from names, shapes and ranges, for a person to edit.

``guess_names`` says what a signal may be by its name, ``guess_units`` in which unit and on which side of the gear.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import tomlkit

from ident.convert.guess_names import CHANNELS, choose, families_of, oriented, score, words_of
from ident.convert.guess_units import NAMED_UNITS, Family, Scale, guess_scales, range_text, unwrapped
from ident.convert.mapping import UNITS
from ident.convert.reading import survey_log
from ident.convert.spelling import split_unit, unit_of
from ident.convert.texts import VALUES
from robot_assets.errors import DataError
from robot_assets.robot import Robot, linear_joints, load_robot

SHORTEST = 20  # samples; anything shorter is no signal but a setting
LARGEST = 1e30  # no stamp, in any unit, is beyond
RATES = (20.0, 50e3)  # Hz: a log of an arm is sampled between
SECONDS = ("s", "ms", "us", "ns")
TIMES = ("t", "time", "times", "stamp", "timestamp", "zeit", "secs", "sec")
SETTINGS = {"fs": 1, "rate": 1, "sample_rate": 1, "frequency": 1, "dt": -1, "ts": -1, "sample_time": -1, "tsample": -1}


@dataclass(frozen=True)
class GuessedMap:
    """The text of a map.

    Attributes:
        found: channel -> what was taken for it, in words.
        missing: required channels for which nothing was found: the map needs them.
    """

    text: str
    found: dict[str, str]
    missing: tuple[str, ...]


def guess_map(files: Sequence[Path], robot: str | Path) -> GuessedMap:
    """Guess the map of one or more logs of a robot.

    Raises:
        DataError: for a log or robot that cannot be read, or where no signal is long enough.
    """
    arm = load_robot(robot)
    paths = [Path(f) for f in files]
    if not paths:
        raise DataError("files", "command line", "none", "at least one log")
    # Damaged values are no reason to guess nothing: the conversion names them.
    surveys = [survey_log(p) for p in paths]
    logs = [{k: np.nan_to_num(np.clip(x, -LARGEST, LARGEST)) for k, x in s.signals.items()} for s in surveys]
    parts = _parts(paths, logs, arm.n)
    starts = [f"{prefix}:" for prefix in parts] or [""]
    units = {f"{p}{k}": u for p, s in zip(starts, surveys) for k, text in s.units.items() if (u := unit_of(text.strip("[](){}<> ")))}
    dates = {f"{p}{k}" for p, s in zip(starts, surveys) for k in s.dates}
    clocks = _clocks(logs, starts, units, dates, arm) if parts else {}
    signals = _on_one_clock(logs, clocks) if clocks else _joined(logs, parts) if parts else logs[0]
    lengths = [_length(x) for x in signals.values() if _length(x) >= SHORTEST]
    if not lengths:
        raise DataError("log", str(paths[0]), f"no signal of {SHORTEST} samples or more", "columns of numbers")
    # The log has the length at which most values stand.
    N = max(set(lengths), key=lambda k: sum(x.size for x in signals.values() if _length(x) == k))
    families = families_of({k: x for k, x in signals.items() if _length(x) == N}, units, arm)
    time, rate, time_unit = _time(families, signals, dates) if not clocks else (None, min(c.rate for c in clocks.values()), "")
    chosen, others = choose([f for f in families if f.x.shape[1] == arm.n and f is not time and f.name not in dates], arm)
    if not {"tau", "q"} & set(chosen):
        names = ", ".join(_plain(f.name) for f in families if f is not time)
        raise DataError("signals", str(paths[0]), f"nothing that looks like a position or a torque of {arm.n} joints: {names[:300] or 'none'}", "names or units that tell, or a map by hand")
    linear = linear_joints(arm)
    chosen = {c: unwrapped(f) if c in ("q", "q_ref", "q_link") and not np.any(linear) else f for c, f in chosen.items()}
    scales = guess_scales(chosen, arm, linear, rate)
    text = _render(paths, arm, parts, clocks, time, time_unit, rate, chosen, others, scales, families, linear)
    found = {c: f"{chosen[c].name}{', ' + ', '.join(s.options) if (s := scales[c]).options else ''}" for c in chosen}
    if time is not None or clocks:
        found["time"] = f"{time.name if time is not None else ', '.join(c.name for c in clocks.values())}, {rate:g} Hz"
    return GuessedMap(text, found, tuple(c for c in ("tau", "q") if c not in chosen))


def _length(x: np.ndarray) -> int:
    return max(x.shape) if x.ndim else 0


# --- files of one log, or a log each


def _parts(paths: list[Path], logs: list[dict[str, np.ndarray]], n: int) -> dict[str, tuple[Path, int | None]]:
    """Prefix -> (file, width) where the files are parts of one log; empty where each is a log."""
    if len(paths) == 1:
        x = logs[0].get(VALUES)
        if x is None or x.shape[1] > 1 or n == 1 or x.size % n:
            return {}
        return {paths[0].stem: (paths[0], n)}
    told = [split_unit(name) for name in logs[0]]
    scores = [score(words_of(stem), channel, unit) for stem, unit in told for channel in ("tau", "q")]
    both = all(any(score(words_of(stem), c, unit) > 0 for stem, unit in told) for c in ("tau", "q"))
    if scores and both:
        return {}
    shortest = min((_length(x) for log in logs for x in log.values() if _length(x) >= SHORTEST), default=0)
    out: dict[str, tuple[Path, int | None]] = {}
    for path, log in zip(paths, logs, strict=True):
        x = log.get(VALUES)
        folded = x is not None and x.shape[1] == 1 and n > 1 and x.size == n * shortest
        out[path.stem if path.stem not in out else path.name] = (path, n if folded else None)
    return out


@dataclass(frozen=True)
class FileClock:
    """The time column of one of several files: its name, rate in Hz, unit ("" of dates) and times in s."""

    name: str
    rate: float
    unit: str
    t: np.ndarray


def _clocks(
    logs: list[dict[str, np.ndarray]], starts: list[str], units: dict[str, str], dates: set[str], arm: Robot
) -> dict[str, FileClock]:
    """Prefix -> clock where each file has one of its own; else empty."""
    out = {}
    for log, start in zip(logs, starts, strict=True):
        own = {k: units[f"{start}{k}"] for k in log if f"{start}{k}" in units}
        time, rate, unit = _time(families_of(log, own, arm), log, {d.removeprefix(start) for d in dates if d.startswith(start)})
        if time is None or rate is None:
            return {}
        out[start] = FileClock(time.sources[0][0], rate, unit, time.x[:, 0] * UNITS[unit or "s"])
    return out


def _on_one_clock(logs: list[dict[str, np.ndarray]], clocks: dict[str, FileClock]) -> dict[str, np.ndarray]:
    """Signals of all files at the lowest of their rates, near enough for a guess: begun together."""
    rate, end = min(c.rate for c in clocks.values()), min(c.t[-1] - c.t[0] for c in clocks.values())
    t = np.arange(max(int(end * rate), SHORTEST)) / rate
    out = {}
    for log, (start, c) in zip(logs, clocks.items(), strict=True):
        for name, x in log.items():
            if name != c.name and _length(x) == len(c.t):
                out[f"{start}{name}"] = np.stack([np.interp(t, c.t - c.t[0], column) for column in oriented(x).T], axis=1)
    return out


def _joined(logs: list[dict[str, np.ndarray]], parts: dict[str, tuple[Path, int | None]]) -> dict[str, np.ndarray]:
    out = {}
    for log, (prefix, (_, width)) in zip(logs, parts.items(), strict=True):
        for name, x in log.items():
            out[f"{prefix}:{name}"] = x if width is None else x.reshape(-1, width)
    return out


# --- time


def _time(families: list[Family], signals: dict[str, np.ndarray], dates: set[str]) -> tuple[Family | None, float | None, str]:
    """The time column, the sampling rate in Hz and the unit of the column, which dates need not have."""
    best: tuple[tuple[int, bool, int], Family, float, str] | None = None
    for f in families:
        date = f.name in dates
        told = date or f.unit in SECONDS or any(w in TIMES or w.startswith("time") for w in f.words)
        if f.x.shape[1] != 1 or not told or not np.all(np.isfinite(f.x)):
            continue
        step = np.diff(f.x[:, 0])
        if np.any(step < 0) or not np.any(step > 0):
            continue
        median = float(np.median(step[step > 0]))
        named = f.unit if f.unit in SECONDS else next((NAMED_UNITS[w] for w in f.words if NAMED_UNITS.get(w) in SECONDS), None)
        for order, unit in enumerate(["s"] if date else [named] if named else SECONDS):
            rate = 1.0 / (median * UNITS[unit])
            if RATES[0] <= rate <= RATES[1]:
                # Whole numbers count samples more often than milliseconds.
                counter = bool(median == 1.0 and np.all(step == 1.0))
                key = (2 * counter + date, "rec" not in f.words and "stamp" not in f.words, order)
                if best is None or key < best[0]:
                    best = (key, f, _round_rate(rate, 0.05 if np.ptp(step) > 0.1 * median else 5e-3), "" if date else unit)
                break
    if best is not None:
        return best[1], best[2], best[3]
    for name, x in signals.items():
        power = SETTINGS.get(re.split(r"[.:]", name)[-1].lower())
        if power is not None and x.size == 1 and x.item() > 0 and RATES[0] <= x.item() ** power <= RATES[1]:
            return None, _round_rate(float(x.item() ** power), 1e-6), ""
    return None, None, ""


def _round_rate(rate: float, within: float) -> float:
    """A rate, rounded where a round one is near: time stamps jitter."""
    for step in (1.0, 0.5, 0.1, 0.01):
        size = step * 10.0 ** np.floor(np.log10(rate))
        rounded = float(np.round(rate / size) * size)
        if abs(rounded / rate - 1) < within:
            return rounded
    return float(f"{rate:.6g}")


# --- the file


def _render(
    paths: list[Path],
    arm: Robot,
    parts: dict[str, tuple[Path, int | None]],
    clocks: dict[str, FileClock],
    time: Family | None,
    time_unit: str,
    rate: float | None,
    chosen: dict[str, Family],
    others: dict[str, list[Family]],
    scales: dict[str, Scale],
    families: list[Family],
    linear: np.ndarray,
) -> str:
    lines = [
        f"# First map of {_plain(paths[0].name)} for the robot {_plain(arm.name)}: guessed, so check every line,",
        "# above all those marked EDIT. Result: tau in N m (N), q in rad (m), both on the link side of the gear.",
        f"sample_rate = {rate or 1000.0!r}" + ("" if rate else "        # EDIT: Hz; the log has no time column that was found"),
        'input_hold = "none"      # "zoh" where the torque is held over a sample',
    ]
    if len(paths) == 1 or parts:
        lines.append("split = 0.7              # the first 70 % identify, the rest validates")
    elif len(paths) > 1:
        lines += ["", "[roles]", *(f'{_quoted(p.name)} = "{"validation" if p is paths[-1] else "identification"}"' for p in paths)]
    if parts:
        lines += ["", "[files]                  # one log over several files; their signals are prefix:name"]
        for prefix, (path, width) in parts.items():
            options = [f"name = {_quoted(path.name)}", *([f"width = {width}"] if width else [])]
            clock = clocks.get(f"{prefix}:")
            if clock is not None:
                options += [f"time = {_quoted(clock.name)}", *([f'unit = "{clock.unit}"'] if clock.unit else [])]
            lines.append(f"{_quoted(prefix)} = {{ {', '.join(options)} }}")
        if clocks:
            lines.append("# Each has a time of its own: they are joined where all of them have samples.")
    if time is not None:
        lines += ["", "[time]", f"source = {_quoted(time.sources[0][0])}"]
        lines += [f'unit = "{time_unit}"'] if time_unit else ["# dates, which need no unit"]
    lines += ["", "[columns]"]
    for channel in CHANNELS:
        if channel not in chosen:
            if channel in ("tau", "q"):
                meaning = "motor torque or current" if channel == "tau" else "motor position"
                lines += ["", f"# EDIT: nothing in the log looks like the {meaning}; complete and take the # away"]
                unit = {"tau": ("N m", "N"), "q": ("rad", "m")}[channel]
                lines += [f'# {channel}_{j + 1} = {{ source = "...", unit = "{unit[int(linear[j])]}" }}' for j in range(arm.n)]
            continue
        family, scale = chosen[channel], scales[channel]
        notes = "; ".join(note for note in (family.note, scale.note) if note)
        lines += ["", f"# {channel}: {notes}" if notes else f"# {channel}"]
        if others[channel]:
            lines.append("# might also be: " + ", ".join(_plain(f.name) for f in others[channel]))
        broken = channel == "qd" and "EDIT" in scale.note
        for j, (source, index) in enumerate(family.sources):
            options = [o for o in scale.options if channel != "tau" or o != "sign = -1" or scale.signs[j] < 0]
            options = [f"source = {_quoted(source)}", *([] if index is None or index == j else [f"index = {index}"]), *options]
            if channel != "temp" and np.ptp(family.x[:, j]) == 0 and channel not in ("tau", "q"):
                lines.append(f"# {channel}_{j + 1} is constant in the log")
                continue
            lines.append(f"{'# ' if broken else ''}{channel}_{j + 1} = {{ {', '.join(options)} }}")
    period = _period(chosen)
    if period is not None:
        N = len(chosen["tau"].x)
        lines += [
            "", f"# The torque repeats every {period} samples: for a multisine around one posture take the # away (and `split`).",
            "# [multisine]", f"# period = {period}", '# operating_point = "op01"', "# excited_lines = [1, 3, 5]   # EDIT, or excited_from = a signal",
            "# [[multisine.part]]", "# first = 2                # the first period has the transient", f"# last = {max(2, N // period)}",
            '# role = "identification"',
        ]  # fmt: skip
    unused = [f for f in families if f is not time and f.name not in {c.name for c in chosen.values()}]
    if unused:
        lines += ["", "# Not used:"] + [f"#   {_plain(f.name)}: {range_text(f.x)}" for f in unused[:60]]
    return "\n".join(lines) + "\n"


def _period(chosen: dict[str, Family]) -> int | None:
    """Samples after which the torque repeats, at least three times; None where it does not."""
    if "tau" not in chosen:
        return None
    x = chosen["tau"].x
    x = x[: 2**19, int(np.argmax(np.std(x, axis=0)))]
    x = x - x.mean()
    N = len(x)
    r = np.fft.irfft(np.abs(np.fft.rfft(x, 2 * N)) ** 2)[:N]
    lags = np.arange(16, N // 3)
    if r[0] <= 0 or not len(lags):
        return None
    c = r[lags] / (N - lags) * N / r[0]
    # The slow start of the correlation is no period: look beyond its first fall.
    low = np.flatnonzero(c < 0.5)
    if not len(low):
        return None
    c[: low[0]] = 0.0
    if c.max() < 0.9:
        return None
    # The first hill that is as high as any, and its top.
    start = int(np.flatnonzero(c > 0.97 * c.max())[0])
    below = np.flatnonzero(c[start:] < 0.9 * c.max())
    end = start + (int(below[0]) if len(below) else len(c) - start)
    return int(lags[start + int(np.argmax(c[start:end]))])


def _plain(text: str) -> str:
    return "".join(ch if ch.isprintable() else " " for ch in text)[:120]


def _quoted(text: str) -> str:
    return tomlkit.item(text).as_string()
