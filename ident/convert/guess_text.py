"""The text of a guessed map: every line to be read, and the doubtful ones marked EDIT."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
import tomlkit

from ident.convert.guess_names import CHANNELS
from ident.convert.guess_time import FileClock, FoundTime
from ident.convert.guess_units import Family, Scale, range_text
from robot_assets.robot import Robot

# Of a linear joint, where the others of the arm turn and say their units in angles.
LINEAR_UNITS = {
    "rad": "m",
    "mrad": "mm",
    "deg": "mm",
    "rev": "m",
    "rad/s": "m/s",
    "deg/s": "mm/s",
    "rpm": "mm/s",
    "N m": "N",
    "mN m": "N",
    "kN m": "kN",
}

LONGEST_NOTE = 1000  # characters


def render(
    paths: list[Path],
    arm: Robot,
    parts: dict[str, tuple[Path, int | None]],
    clocks: dict[str, FileClock],
    time: FoundTime,
    chosen: dict[str, Family],
    others: dict[str, list[Family]],
    scales: dict[str, Scale],
    families: list[Family],
    linear: np.ndarray,
    doubts: Mapping[str, str],
) -> str:
    """A map file in TOML, with what was guessed, why, and what is to be edited."""
    lines = [
        f"# First map of {plain(paths[0].name)} for the robot {plain(arm.name)}: guessed, so check every line,",
        "# above all those marked EDIT. Result: tau in N m (N), q in rad (m), both on the link side of the gear.",
        f"sample_rate = {time.rate or 1000.0!r}" + _rate_note(time, bool(clocks)),
        'input_hold = "none"      # "zoh" where the torque is held over a sample',
    ]
    if len(paths) == 1 or parts:
        lines.append("split = 0.7              # the first 70 % identify, the rest validates")
    elif len(paths) > 1:
        lines += [
            "",
            "[roles]",
            *(f'{quoted(p.name)} = "{"validation" if p is paths[-1] else "identification"}"' for p in paths),
        ]
    if parts:
        lines += ["", "[files]                  # one log over several files; their signals are prefix:name"]
        for prefix, (path, width) in parts.items():
            options = [f"name = {quoted(path.name)}", *([f"width = {width}"] if width else [])]
            clock = clocks.get(f"{prefix}:")
            if clock is not None:
                options += [f"time = {quoted(clock.name)}", *([f'unit = "{clock.unit}"'] if clock.unit else [])]
            lines.append(f"{quoted(prefix)} = {{ {', '.join(options)} }}")
        if clocks:
            lines.append("# Each has a time of its own: they are joined where all of them have samples.")
    if time.source is not None:
        lines += [
            "",
            "[time]" + (f"                   # {plain(time.doubt)}" if time.doubt else ""),
            f"source = {quoted(time.source)}",
        ]
        lines += [f'unit = "{time.unit}"'] if time.unit else ["# dates, which need no unit"]
        if time.plus:
            lines.append(
                "plus = [" + ", ".join(f'{{ source = {quoted(s)}, unit = "{u}" }}' for s, u in time.plus) + "]"
            )
    elif time.lost is not None:
        name, unit, why = time.lost
        lines += [
            "",
            f"# EDIT: {plain(name)} is not used as the time: it {why}.",
            "# Mend the log, or leave it out: the samples then count as even.",
            "# [time]",
            f"# source = {quoted(name)}",
        ]
        lines += [f'# unit = "{unit}"'] if unit else []
    lines += ["", "[columns]"]
    for channel in CHANNELS:
        if channel not in chosen:
            if channel in ("tau", "q"):
                meaning = "motor torque or current" if channel == "tau" else "motor position"
                lines += ["", f"# EDIT: nothing in the log looks like the {meaning}; complete and take the # away"]
                units = {"tau": ("N m", "N"), "q": ("rad", "m")}[channel]
                lines += [
                    f'# {channel}_{j + 1} = {{ source = "...", unit = "{units[int(linear[j])]}" }}'
                    for j in range(arm.n)
                ]
            continue
        family, scale = chosen[channel], scales[channel]
        damaged = (
            f"EDIT: {plain(name)} has {plain(doubts[name])}"
            for name, _ in dict(family.sources).items()
            if name in doubts
        )
        notes = plain("; ".join(note for note in (family.note, scale.note, *damaged) if note), LONGEST_NOTE)
        lines += ["", f"# {channel}: {notes}" if notes else f"# {channel}"]
        if others[channel]:
            lines.append("# might also be: " + ", ".join(plain(f.name) for f in others[channel]))
        broken = channel == "qd" and "EDIT" in scale.note
        for j, (source, index) in enumerate(family.sources):
            forward = channel == "tau" and scale.signs is not None and not scale.signs[j] < 0
            options = [o for o in scale.options if not (forward and o == "sign = -1")]
            if linear[j] and not np.all(linear):
                options = [
                    f'unit = "{LINEAR_UNITS[u]}"' if (u := o[len('unit = "') : -1]) in LINEAR_UNITS else o
                    for o in options
                ]
            options = [
                f"source = {quoted(source)}",
                *([] if index is None or index == j else [f"index = {index}"]),
                *options,
            ]
            # Only encoders at the link may be at some joints alone.
            if channel == "q_link" and np.ptp(family.x[:, j]) == 0:
                lines.append(f"# {channel}_{j + 1} is constant in the log")
                continue
            lines.append(f"{'# ' if broken else ''}{channel}_{j + 1} = {{ {', '.join(options)} }}")
    period = period_of(chosen)
    if period is not None:
        N = len(chosen["tau"].x)
        lines += [
            "", f"# The torque repeats every {period} samples: for a multisine around one posture take the # away (and `split`).",
            "# [multisine]", f"# period = {period}", '# operating_point = "op01"', "# excited_lines = [1, 3, 5]   # EDIT, or excited_from = a signal",
            "# [[multisine.part]]", "# first = 2                # the first period has the transient", f"# last = {max(2, N // period)}",
            '# role = "identification"',
        ]  # fmt: skip
    unused = [f for f in families if f.name not in time.sources and f.name not in {c.name for c in chosen.values()}]
    if unused:
        lines += ["", "# Not used:"] + [f"#   {plain(f.name)}: {range_text(f.x)}" for f in unused[:60]]
    return "\n".join(lines) + "\n"


def _rate_note(time: FoundTime, joined: bool) -> str:
    if time.source is not None or joined:
        return f"        # {plain(time.doubt)}" if time.doubt.startswith("EDIT") else ""
    if time.lost is not None and time.rate is not None:
        return f"        # EDIT: Hz, by the median step of {plain(time.lost[0])}, which is not used as the time"
    return "" if time.rate is not None else "        # EDIT: Hz; the log has no time column that was found"


def period_of(chosen: dict[str, Family]) -> int | None:
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


def plain(text: str, most: int = 120) -> str:
    """Text of a log as it may stand in a comment: one line without control characters."""
    return "".join(ch if ch.isprintable() else " " for ch in text)[:most]


def quoted(text: str) -> str:
    """A string of TOML."""
    return tomlkit.item(text).as_string()
