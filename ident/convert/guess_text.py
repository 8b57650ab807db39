"""The text of a guessed map: every line to be read, and the doubtful ones marked EDIT."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
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

# Channels that a map needs: what they are, and their units of joints that turn and of linear ones.
MISSED = {"tau": ("motor torque or current", ("N m", "N")), "q": ("motor position", ("rad", "m"))}

LONGEST_NOTE = 1000  # characters
MOST_UNUSED = 60  # signals that are listed
LONGEST_PERIODIC = 2**19  # samples in which a period is looked for
UNLIKE = 0.3  # of a signal, by which two periods of it may differ beside its noise


@dataclass(frozen=True)
class Guess:
    """What was guessed of a log.

    Attributes:
        parts: prefix -> (file, width) of one log over several files; clocks: by prefix, where each has one of its own.
        chosen: channel -> signals taken for it; others: that might also be it; scales: their units, by channel.
        families: all signals. linear: (n,) joints that are.
        doubts: name of a signal -> what is doubtful about how it was read.
        encoding: of texts, where it is not UTF-8.
    """

    paths: Sequence[Path]
    arm: Robot
    parts: Mapping[str, tuple[Path, int | None]]
    clocks: Mapping[str, FileClock]
    time: FoundTime
    chosen: Mapping[str, Family]
    others: Mapping[str, Sequence[Family]]
    scales: Mapping[str, Scale]
    families: Sequence[Family]
    linear: np.ndarray
    doubts: Mapping[str, str]
    encoding: str = ""


def render(guess: Guess) -> str:
    """A map file in TOML, with what was guessed, why, and what is to be edited."""
    sections = (_head, _files, _time, _columns, _multisine, _unused)
    return "\n".join(line for section in sections for line in section(guess)) + "\n"


def _head(guess: Guess) -> Iterator[str]:
    yield f"# First map of {plain(guess.paths[0].name)} for the robot {plain(guess.arm.name)}: guessed, so check every line,"
    yield "# above all those marked EDIT. Result: tau in N m (N), q in rad (m), both on the link side of the gear."
    yield f"sample_rate = {guess.time.rate or 1000.0!r}" + _rate_note(guess.time, bool(guess.clocks))
    yield 'input_hold = "none"      # "zoh" where the torque is held over a sample'
    if guess.encoding:
        yield f"encoding = {quoted(guess.encoding)}"
    if len(guess.paths) == 1 or guess.parts:
        yield "split = 0.7              # the first 70 % identify, the rest validates"
        return
    yield from ("", "[roles]")
    for path in guess.paths:
        yield f'{quoted(path.name)} = "{"validation" if path is guess.paths[-1] else "identification"}"'


def _files(guess: Guess) -> Iterator[str]:
    if not guess.parts:
        return
    yield from ("", "[files]                  # one log over several files; their signals are prefix:name")
    for prefix, (path, width) in guess.parts.items():
        options = [f"name = {quoted(path.name)}", *([f"width = {width}"] if width else [])]
        clock = guess.clocks.get(f"{prefix}:")
        if clock is not None:
            options += [f"time = {quoted(clock.name)}", *([f'unit = "{clock.unit}"'] if clock.unit else [])]
        yield f"{quoted(prefix)} = {{ {', '.join(options)} }}"
    if guess.clocks:
        yield "# Each has a time of its own: they are joined where all of them have samples."


def _time(guess: Guess) -> Iterator[str]:
    time = guess.time
    if time.source is not None:
        yield from ("", "[time]" + (f"                   # {plain(time.doubt)}" if time.doubt else ""))
        yield f"source = {quoted(time.source)}"
        yield f'unit = "{time.unit}"' if time.unit else "# dates, which need no unit"
        if time.plus:
            added = ", ".join(f'{{ source = {quoted(s)}, unit = "{u}" }}' for s, u in time.plus)
            yield f"plus = [{added}]"
    elif time.lost is not None:
        name, unit, why = time.lost
        yield from ("", f"# EDIT: {plain(name)} is not used as the time: it {why}.")
        yield "# Mend the log, or leave it out: the samples then count as even."
        yield from ("# [time]", f"# source = {quoted(name)}")
        if unit:
            yield f'# unit = "{unit}"'


def _columns(guess: Guess) -> Iterator[str]:
    yield from ("", "[columns]")
    for channel in CHANNELS:
        if channel in guess.chosen:
            yield from _channel(guess, channel)
        elif channel in MISSED:
            meaning, units = MISSED[channel]
            yield from ("", f"# EDIT: nothing in the log looks like the {meaning}; complete and take the # away")
            for j, linear in enumerate(guess.linear):
                yield f'# {channel}_{j + 1} = {{ source = "...", unit = "{units[int(linear)]}" }}'


def _channel(guess: Guess, channel: str) -> Iterator[str]:
    """The columns of a channel, with what was guessed about them."""
    family, scale, doubts = guess.chosen[channel], guess.scales[channel], guess.doubts
    damaged = (
        f"EDIT: {plain(name)} has {plain(doubts[name])}" for name, _ in dict(family.sources).items() if name in doubts
    )
    notes = plain("; ".join(note for note in (family.note, scale.note, *damaged) if note), LONGEST_NOTE)
    yield from ("", f"# {channel}: {notes}" if notes else f"# {channel}")
    if guess.others[channel]:
        yield "# might also be: " + ", ".join(plain(f.name) for f in guess.others[channel])
    broken = channel == "qd" and "EDIT" in scale.note
    for j, (source, index) in enumerate(family.sources):
        # Only encoders at the link may be at some joints alone.
        if channel == "q_link" and np.ptp(family.x[:, j]) == 0:
            yield f"# {channel}_{j + 1} is constant in the log"
            continue
        options = [f"source = {quoted(source)}", *([] if index is None or index == j else [f"index = {index}"])]
        options += _options_at(scale, channel, j, guess.linear)
        yield f"{'# ' if broken else ''}{channel}_{j + 1} = {{ {', '.join(options)} }}"


def _options_at(scale: Scale, channel: str, j: int, linear: np.ndarray) -> list[str]:
    """Unit, sign and gear of a joint, where they are those of the other joints but for what it is."""
    forward = channel == "tau" and scale.signs is not None and not scale.signs[j] < 0
    options = [o for o in scale.options if not (forward and o == "sign = -1")]
    if not linear[j] or np.all(linear):
        return options
    in_length = {f'unit = "{angle}"': f'unit = "{length}"' for angle, length in LINEAR_UNITS.items()}
    return [in_length.get(o, o) for o in options]


def _multisine(guess: Guess) -> Iterator[str]:
    period = period_of(guess.chosen)
    if period is None:
        return
    last = max(2, len(guess.chosen["tau"].x) // period)
    several = len(guess.paths) > 1 and not guess.parts
    yield from (
        "",
        f"# The motion repeats every {period} samples: for a multisine around one posture take the # away"
        + (", of all files." if several else " (and `split`)."),
        "# [multisine]",
        f"# period = {period}",
        '# operating_point = "op01"',
        "# excited_lines = [1, 3, 5]   # EDIT, or excited_from = a signal",
        "# [[multisine.part]]",
        "# first = 2                # the first period has the transient",
        f"# last = {last}" + ("                # the role is that of each file in [roles]" if several else ""),
        *([] if several else ['# role = "identification"']),
    )


def _unused(guess: Guess) -> Iterator[str]:
    used = guess.time.sources | {f.name for f in guess.chosen.values()}
    unused = [f for f in guess.families if f.name not in used]
    read = {name for f in guess.families for name, _ in f.sources} | guess.time.sources
    unread = [name for name in guess.doubts if name not in read]
    if unused or unread:
        yield from ("", "# Not used:")
        yield from (f"#   {plain(f.name)}: {range_text(f.x)}" for f in unused[:MOST_UNUSED])
        yield from (f"#   {plain(k)}: not read, as it has {plain(guess.doubts[k])}" for k in unread[:MOST_UNUSED])


def _rate_note(time: FoundTime, joined: bool) -> str:
    if time.source is not None or joined:
        return f"        # {plain(time.doubt)}" if time.doubt.startswith("EDIT") else ""
    if time.lost is not None and time.rate is not None:
        return f"        # EDIT: Hz, by the median step of {plain(time.lost[0])}, which is not used as the time"
    return "" if time.rate is not None else "        # EDIT: Hz; the log has no time column that was found"


def period_of(chosen: Mapping[str, Family]) -> int | None:
    """Samples after which torque and position of all joints repeat, at least three times; None where they do not."""
    if "tau" not in chosen:
        return None
    x = chosen["tau"].x
    x = x[:LONGEST_PERIODIC, int(np.argmax(np.std(x, axis=0)))]
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
    hill = lags[start:end]
    period = int(hill[np.argmax(c[start:end])])
    channels = [chosen[k].x[:LONGEST_PERIODIC] for k in ("tau", "q") if k in chosen]
    moving = [x for x in channels if np.any(np.ptp(x[period:], axis=0) > 0)]
    if not moving or any(_change(x, period) > UNLIKE**2 for x in moving):
        return None
    # The top of a smooth hill is blurred by noise, of which one of the columns that repeat has the least.
    columns = [x for x in np.concatenate(moving, axis=1).T[..., None] if np.ptp(x[period:]) > 0]
    clear = min((x for x in columns if _change(x, period) <= UNLIKE**2), key=_noise_share)
    near = 0
    while near != period:
        about = [p for p in range(period - 2, period + 3) if hill[0] <= p <= hill[-1]]
        near, period = period, min(about, key=lambda p: _change(clear, p))
    return period if all(_change(x, period) <= UNLIKE**2 for x in moving) else None


def _noise_share(x: np.ndarray) -> float:
    """Variance of white noise in signals (N, n), of which third differences have 20 times, over that of the signals."""
    return float(np.mean(np.diff(x, 3, axis=0) ** 2) / 20 / np.mean(np.var(x, axis=0)))


def _change(x: np.ndarray, period: int) -> float:
    """What signals (N, n) of all joints differ by from the period before, their noise apart, over their variance; after
    the first period, which has the transient. A joint that is not excited creeps, by little beside the others."""
    x = x[period:]
    return float(np.mean((x[period:] - x[:-period]) ** 2) / np.mean(np.var(x, axis=0))) - 2 * _noise_share(x)


def plain(text: str, most: int = 120) -> str:
    """Text of a log as it may stand in a comment: one line without control characters."""
    return "".join(ch if ch.isprintable() else " " for ch in text)[:most]


def quoted(text: str) -> str:
    """A string of TOML."""
    return tomlkit.item(text).as_string()
