"""A first map of a log, guessed from names, shapes and ranges, for a person to edit.

Names say what a signal may be; ``guess_units`` says in which unit and on which side of the gear.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import tomlkit

from ident.convert.guess_units import NAMED_UNITS, Family, Scale, guess_scales, range_text
from ident.convert.mapping import UNITS
from ident.convert.reading import VALUES, list_signals
from robot_assets.errors import DataError
from robot_assets.robot import Robot, linear_joints, load_robot

SHORTEST = 20  # samples; anything shorter is no signal but a setting
LARGEST = 1e30  # no stamp, in any unit, is beyond
RATES = (20.0, 50e3)  # Hz: a log of an arm is sampled between
CHANNELS = ("tau", "q", "qd", "q_ref", "q_link", "temp")
# Words in names, and how surely each tells. One letter tells little.
WORDS: dict[str, dict[str, float]] = {
    "torque": dict.fromkeys(("tau", "torque", "torques", "trq", "effort", "efforts", "moment", "force", "current", "currents", "curr", "iq", "drehmoment", "strom", "kraft"), 3.0)
    | dict.fromkeys(("cur", "voltage", "volt"), 2.0)
    | dict.fromkeys(("u", "i", "f", "m"), 0.5),
    "velocity": dict.fromkeys(("dq", "qd", "qdot", "qp", "vel", "velocity", "velocities", "omega", "speed", "rpm", "geschwindigkeit"), 3.0)
    | dict.fromkeys(("v", "w"), 0.5),
    "position": dict.fromkeys(("pos", "position", "positions", "theta", "phi", "angle", "angles", "encoder", "enc", "qm", "winkel", "weg"), 3.0)
    | {"q": 2.5, "x": 0.5, "ql": 2.5, "qg": 2.5},
    "temperature": dict.fromkeys(("temp", "temperature", "temperatur"), 3.0),
}  # fmt: skip
REFERENCE = ("ref", "cmd", "des", "desired", "command", "target", "setpoint", "goal", "soll", "qg")
LINK = ("link", "load", "se", "secondary", "output", "arm", "abtrieb", "ql", "external")
MOTOR = ("motor", "mot", "qm")
ACTUAL = ("act", "actual", "meas", "measured", "ist", "rec", "state", "states", "read")
DERIVED = ("err", "error", "ff", "feedforward", "acc", "acceleration", "ddq", "qdd", "model", "est", "sim", "init", "limit", "residual", "std")
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
    logs = [{k: np.nan_to_num(np.clip(x, -LARGEST, LARGEST)) for k, x in list_signals(p).items()} for p in paths]
    parts = _parts(paths, logs, arm.n)
    signals = _joined(paths, logs, parts) if parts else logs[0]
    lengths = [_length(x) for x in signals.values() if _length(x) >= SHORTEST]
    if not lengths:
        raise DataError("log", str(paths[0]), f"no signal of {SHORTEST} samples or more", "columns of numbers")
    # The log has the length at which most values stand.
    N = max(set(lengths), key=lambda k: sum(x.size for x in signals.values() if _length(x) == k))
    families = _families({k: x for k, x in signals.items() if _length(x) == N}, arm)
    time, rate, time_unit = _time(families, signals, N, arm.n)
    chosen, others = _choose([f for f in families if f.x.shape[1] == arm.n and f is not time], arm)
    linear = linear_joints(arm)
    scales = guess_scales(chosen, arm, linear, rate)
    text = _render(paths, arm, parts, time, time_unit, rate, chosen, others, scales, families, linear)
    found = {c: f"{chosen[c].name}{', ' + ', '.join(s.options) if (s := scales[c]).options else ''}" for c in chosen}
    if time is not None:
        found["time"] = f"{time.name}, {rate:g} Hz"
    return GuessedMap(text, found, tuple(c for c in ("tau", "q") if c not in chosen))


def _length(x: np.ndarray) -> int:
    return max(x.shape) if x.ndim else 0


def _oriented(x: np.ndarray) -> np.ndarray:
    """(N, k) with time first."""
    if x.ndim < 2:
        return x.reshape(-1, 1)
    return x if x.shape[0] >= x.shape[1] else x.T


# --- files of one log, or a log each


def _parts(paths: list[Path], logs: list[dict[str, np.ndarray]], n: int) -> dict[str, tuple[Path, int | None]]:
    """Prefix -> (file, width) where the files are parts of one log; empty where each is a log."""
    if len(paths) == 1:
        x = logs[0].get(VALUES)
        if x is None or x.shape[1] > 1 or n == 1 or x.size % n:
            return {}
        return {paths[0].stem: (paths[0], n)}
    scores = [_score(_words(name), channel) for name in logs[0] for channel in ("tau", "q")]
    both = all(any(_score(_words(name), c) > 0 for name in logs[0]) for c in ("tau", "q"))
    if scores and both:
        return {}
    shortest = min((_length(x) for log in logs for x in log.values() if _length(x) >= SHORTEST), default=0)
    out: dict[str, tuple[Path, int | None]] = {}
    for path, log in zip(paths, logs, strict=True):
        x = log.get(VALUES)
        folded = x is not None and x.shape[1] == 1 and n > 1 and x.size == n * shortest
        out[path.stem if path.stem not in out else path.name] = (path, n if folded else None)
    return out


def _joined(
    paths: list[Path], logs: list[dict[str, np.ndarray]], parts: dict[str, tuple[Path, int | None]]
) -> dict[str, np.ndarray]:
    out = {}
    for log, (prefix, (_, width)) in zip(logs, parts.items(), strict=True):
        for name, x in log.items():
            out[f"{prefix}:{name}"] = x if width is None else x.reshape(-1, width)
    return out


# --- names


def _words(name: str) -> tuple[str, ...]:
    """Parts of a name: "rec.actPos_mot1" gives rec, act, pos, mot; "Istposition" gives ist, position."""
    name = re.sub(r"([a-z0-9])([A-Z])", r"\1 \2", name)
    words = (w.lower() for w in re.findall(r"[A-Za-zµ]+", name))
    return tuple(part for w in words for part in _split(w))


def _split(word: str) -> tuple[str, ...]:
    """A word, or the two that it is put together of: a role and a quantity."""
    quantities = [q for table in WORDS.values() for q in table if len(q) > 2]
    for role in (*REFERENCE, *LINK, *MOTOR, *ACTUAL):
        rest = word.removeprefix(role)
        if len(role) > 2 and rest != word and any(rest.startswith(q) for q in quantities):
            return role, rest
    return (word,)


def _families(signals: dict[str, np.ndarray], arm: Robot) -> list[Family]:
    """Arrays of a column a joint, single columns numbered or named by joint, and what is left alone."""
    n, out, single = arm.n, [], {}
    for name, x in signals.items():
        x = _oriented(x)
        if x.shape[1] == 1:
            single[name] = x[:, 0]
        elif x.shape[1] >= n:
            out.append(Family(name, _words(name), tuple((name, j) for j in range(n)), x[:, :n]))
    if n == 1:
        return out + [Family(k, _words(k), ((k, None),), x[:, None]) for k, x in single.items()]
    sets: dict[str, dict[int, str]] = {}
    for name in single:
        # Longer joint names first: "joint_1" is also part of "joint_10".
        joint = next((j for j in sorted(arm.joint_names, key=len, reverse=True) if j in name), None)
        if joint is not None:
            sets.setdefault(name.replace(joint, "{}", 1), {})[arm.joint_names.index(joint)] = name
        for m in re.finditer(r"\d+", name):
            sets.setdefault(name[: m.start()] + "{#}" + name[m.end() :], {})[int(m[0])] = name
    used: set[str] = set()
    for stem, members in sets.items():
        first = 0 if 0 in members else 1
        if "{#}" not in stem:
            first = 0
        names = [members.get(first + j) for j in range(n)]
        if None in names or used & set(names):
            continue
        used |= set(names)
        columns = np.stack([single[k] for k in names], axis=1)
        out.append(Family(stem.replace("{#}", "#").replace("{}", "JOINT"), _words(stem), tuple((k, None) for k in names), columns))
    return out + [Family(k, _words(k), ((k, None),), x[:, None]) for k, x in single.items() if k not in used]


def _score(words: tuple[str, ...], channel: str) -> float:
    """How well a name fits a channel; at most 0 where it does not."""
    kind = {"tau": "torque", "qd": "velocity", "temp": "temperature"}.get(channel, "position")
    fit = {k: max((v for w in words for word, v in table.items() if w == word or (len(word) > 3 and w.startswith(word))), default=0.0) for k, table in WORDS.items()}
    score = fit[kind]
    if score <= 0 or any(fit[k] > score for k in fit):
        return 0.0
    family = Family("", words, (), np.empty((0, 0)))
    reference, link = family.has(REFERENCE), family.has(LINK)
    if channel == "q_ref":
        return score if reference and not family.has(DERIVED) else 0.0
    if channel == "q_link":
        return score if link and not reference and not family.has(DERIVED) else 0.0
    score += family.has(ACTUAL) + 0.5 * family.has(MOTOR)
    score -= 2.0 * reference + 2.4 * family.has(DERIVED) + (channel in ("q", "qd")) * 1.5 * link
    return score


def _choose(families: list[Family], arm: Robot) -> tuple[dict[str, Family], dict[str, list[Family]]]:
    """The best family of each channel, and what else might be meant."""
    moving = [f for f in families if np.all(np.isfinite(f.x)) and np.any(np.ptp(f.x, axis=0) > 0)]
    chosen: dict[str, Family] = {}
    others: dict[str, list[Family]] = {}
    taken: set[str] = set()
    for channel in CHANNELS:
        ranked = sorted((f for f in moving if f.name not in taken and _score(f.words, channel) > 0), key=lambda f: -_score(f.words, channel))
        if ranked:
            chosen[channel] = ranked[0]
            others[channel] = ranked[1:5]
            taken.add(ranked[0].name)
    left = [f for f in moving if f.name not in taken]
    if "tau" not in chosen and "q" in chosen and len(left) == 1:
        # A log for identification has a torque: it is the one that is left.
        chosen["tau"], others["tau"] = left[0], []
    return chosen, others


def _time(families: list[Family], signals: dict[str, np.ndarray], N: int, n: int) -> tuple[Family | None, float | None, str]:
    """The time column, the sampling rate in Hz and the unit of the column."""
    best: tuple[tuple[bool, bool, int], Family, float, str] | None = None
    for f in families:
        if f.x.shape[1] != 1 or not any(w in TIMES or w.startswith("time") for w in f.words) or not np.all(np.isfinite(f.x)):
            continue
        step = np.diff(f.x[:, 0])
        if np.any(step < 0) or not np.any(step > 0):
            continue
        median = float(np.median(step[step > 0]))
        named = next((NAMED_UNITS[w] for w in f.words if NAMED_UNITS.get(w) in ("s", "ms", "us", "ns")), None)
        for order, unit in enumerate([named] if named else ["s", "ms", "us", "ns"]):
            rate = 1.0 / (median * UNITS[unit])
            if RATES[0] <= rate <= RATES[1]:
                # Whole numbers count samples more often than milliseconds.
                counter = bool(median == 1.0 and np.all(step == 1.0))
                key = (counter, "rec" not in f.words and "stamp" not in f.words, order)
                if best is None or key < best[0]:
                    best = (key, f, _round_rate(rate, 0.05 if np.ptp(step) > 0.1 * median else 5e-3), unit)
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
        lines += [f"{_quoted(k)} = {{ name = {_quoted(p.name)}{f', width = {w}' if w else ''} }}" for k, (p, w) in parts.items()]
    if time is not None:
        lines += ["", "[time]", f"source = {_quoted(time.sources[0][0])}", f'unit = "{time_unit}"']
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
        lines += ["", f"# {channel}: {scale.note}" if scale.note else f"# {channel}"]
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
