"""Which column of a log is the time, in which unit, and the sampling rate that it says; or why none is."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from ident.convert.guess_units import NAMED_UNITS, Family
from ident.convert.quantities import KINDS, UNITS
from ident.convert.rounding import Rounded, even_rows
from ident.convert.spelling import split_unit

RATES = (20.0, 50e3)  # Hz: a log of an arm is mostly sampled between
SLOWEST, FASTEST = 0.1, 1e6  # Hz: no log of an arm is sampled beyond
SLOW = 5.0  # Hz, from which on a log in s is likelier than one in ms of a thousand times the rate
SHORT = 2.0  # s: a log that is shorter is likelier in another unit
DRIFT = 1e-4  # of a rate, by which clocks are apart
TWICE = 0.01  # of the rows, at the time of the one before, from which on that is said
SECONDS = tuple(KINDS["time"])
TIMES = (
    "t", "time", "times", "stamp", "timestamp", "zeit", "zeitstempel", "uhrzeit", "datum", "date", "datetime", "elapsed", "duration", "clock", "epoch",
    "ipoc", "sec", "secs",
)  # fmt: skip
SETTINGS = {"fs": 1, "rate": 1, "sample_rate": 1, "frequency": 1, "dt": -1, "ts": -1, "sample_time": -1, "tsample": -1}
WHOLE = re.compile(r"(?i)^(.*?)(secs?|seconds?)$")
PARTS = re.compile(r"(?i)^(.*?)(nano|micro|milli|n|u|m)(secs?|seconds?)$")
PART_UNITS = {"n": "ns", "nano": "ns", "u": "us", "micro": "us", "m": "ms", "milli": "ms"}


@dataclass(frozen=True)
class FoundTime:
    """The time of a log.

    Attributes:
        source: its column; None where there is none that can be used. unit: "" of dates.
        plus: (column, unit) of what is added: full seconds have their fraction beside them.
        t: (N,) in units of ``source``. rate: Hz; None where nothing says it.
        doubt: what a person should look at, in words. lost: (column, unit, why) of one that looks like the time and
            cannot be.
    """

    source: str | None = None
    unit: str = ""
    plus: tuple[tuple[str, str], ...] = ()
    t: np.ndarray | None = None
    rate: float | None = None
    doubt: str = ""
    lost: tuple[str, str, str] | None = None

    @property
    def sources(self) -> set[str]:
        """Signals of the log that make up the time."""
        return {s for s in (self.source, *(p[0] for p in self.plus)) if s is not None}


@dataclass(frozen=True)
class FileClock:
    """The time column of one of several files: its name, rate in Hz, unit ("" of dates) and times in s."""

    name: str
    rate: float
    unit: str
    t: np.ndarray


def find_time(
    families: list[Family],
    signals: dict[str, np.ndarray],
    dates: set[str],
    damaged: Mapping[str, int],
    doubts: Mapping[str, str],
) -> FoundTime:
    """The time of a log.

    Args:
        signals: all of the log; settings may say the rate. dates: names of those that are dates.
        damaged: name -> first row, from 1, without a number. doubts: name -> what is doubtful about how it was read.
    """
    best: tuple[tuple, FoundTime] | None = None
    lost: tuple[tuple, FoundTime] | None = None
    useless: tuple[str, str, str] | None = None  # the first that has the name of a time and nothing else of it
    single = {f.name: f for f in families if f.x.shape[1] == 1}
    pairs = _pairs(single)
    for f in (*(p[0] for p in pairs), *single.values()):
        plus = next((p[1] for p in pairs if p[0] is f), ())
        date = f.name in dates
        if not plus and not date and not _named(f):
            continue
        t = f.x[:, 0]
        step = np.diff(t)
        if not np.any(step > 0):
            useless = useless or (f.name, "", "falls" if np.any(step < 0) else "is the same in all rows")
            continue
        names = {f.name, *(p[0] for p in plus)}
        trouble = next((f"has no number in row {damaged[n]}" for n in sorted(names) if n in damaged), "") or _goes_back(
            t, step
        )
        # One that mostly rises is the time all the same, and told to be damaged; others only have such a name.
        if trouble and np.mean(step > 0) < 0.9:
            useless = useless or (f.name, "", trouble)
            continue
        even = None if trouble else even_rows(t, [x for k, x in signals.items() if k not in names])
        median = float(np.median(step[step > 0])) if even is None else even.step
        named = (
            "s"
            if plus or date
            else f.unit
            if f.unit in SECONDS
            else next((NAMED_UNITS[w] for w in f.words if NAMED_UNITS.get(w) in SECONDS), None)
        )
        unit, rate, doubt = _unit(median, named, t)
        # Whole numbers count samples more often than milliseconds.
        counter = bool(median == 1.0 and np.all(step == 1.0))
        key = (2 * counter + date, not plus, "rec" not in f.words and "stamp" not in f.words, SECONDS.index(unit))
        if not SLOWEST <= rate <= FASTEST:
            trouble = trouble or f"has steps of {median:.3g}, which is no rate of a log in any unit"
            rate = 0.0
        jitter = 0.05 if np.ptp(step) > 0.1 * median else 5e-3
        rounded = _round_rate(rate, jitter if even is None else max(even.by / np.ptp(t), DRIFT)) if rate else None
        shown = "" if date else unit
        if trouble:
            if lost is None or key < lost[0]:
                lost = key, FoundTime(rate=rounded, lost=(f.name, shown, trouble))
        elif best is None or key < best[0]:
            stamps = _coarse(step, even, "s" if date else unit, rounded)
            told = (doubt, *(f"EDIT? {doubts[n]}" for n in sorted(names) if n in doubts), stamps)
            doubt = "; ".join(d for d in told if d)
            best = (
                key,
                FoundTime(f.name, shown, plus, t, rounded, doubt.replace(" Hz if in", f" Hz if {f.name} is in", 1)),
            )
    if best is not None:
        return best[1]
    for name, x in signals.items():
        power = SETTINGS.get(re.split(r"[.:]", name)[-1].lower())
        if power is not None and x.size == 1 and x.item() > 0 and RATES[0] <= x.item() ** power <= RATES[1]:
            rate = _round_rate(float(x.item() ** power), 1e-6)
            return FoundTime(rate=rate, lost=lost[1].lost if lost else useless)
    return lost[1] if lost else FoundTime(lost=useless)


def _coarse(step: np.ndarray, even: Rounded | None, unit: str, rate: float | None) -> str:
    """What is doubtful about stamps that are coarser than the rows, in words."""
    if even is not None:
        by = even.by * UNITS[unit]
        return f"EDIT? stamps rounded to {by * 1e3:.4g} ms: {rate:g} Hz by rows over span, at even times"
    same = int(np.sum(step == 0))
    if same < TWICE * len(step):
        return ""
    return f"EDIT? {same} of {len(step) + 1} rows at the time of the one before, of which only the first is taken"


def _named(f: Family) -> bool:
    """Whether a name or its unit tells of a time."""
    return f.unit in SECONDS or _words_of_time(f.words)


def is_time(name: str) -> bool:
    """Whether the name of a column tells of a time."""
    stem, unit = split_unit(name)
    return unit in SECONDS or _words_of_time([w.lower() for w in re.findall(r"[A-Za-z]+", stem)])


def _words_of_time(words: Sequence[str]) -> bool:
    alone = bool(words) and all(NAMED_UNITS.get(w) in SECONDS for w in words)
    return alone or any(w in TIMES or w.startswith("time") for w in words)


def _goes_back(t: np.ndarray, step: np.ndarray) -> str:
    back = np.flatnonzero(step < 0)
    if not len(back):
        return ""
    k = int(back[0])
    more = f", {len(back)} times in all" if len(back) > 1 else ""
    return f"goes back in row {k + 2} (from {t[k]:.9g} to {t[k + 1]:.9g}{more})"


def _unit(median: float, named: str | None, t: np.ndarray) -> tuple[str, float, str]:
    """Unit, rate in Hz and doubt of stamps of a median step."""
    if named:
        rate = 1.0 / (median * UNITS[named])
        return (
            named,
            rate,
            ""
            if RATES[0] <= rate <= RATES[1]
            else f"EDIT? {rate:.4g} Hz is {'slow' if rate < RATES[0] else 'fast'} for a log of an arm",
        )
    fitting = [unit for unit in SECONDS if RATES[0] <= 1.0 / (median * UNITS[unit]) <= RATES[1]]
    in_seconds, span = 1.0 / median, float(np.ptp(t))
    whole = bool(np.all(t == np.round(t)))
    if 0.5 <= in_seconds < RATES[0] and not whole:
        slow = in_seconds >= SLOW or span * UNITS["ms"] < SHORT or not fitting
        unit, other = ("s", "ms") if slow else ("ms", "s")
        return (
            unit,
            1.0 / (median * UNITS[unit]),
            f"EDIT: {1.0 / (median * UNITS[unit]):.6g} Hz if in {unit}, {1.0 / (median * UNITS[other]):.6g} Hz in {other}",
        )
    unit = fitting[0] if fitting else "s"
    return unit, 1.0 / (median * UNITS[unit]), "" if fitting else f"EDIT: {in_seconds:.6g} Hz if in s"


def _pairs(single: dict[str, Family]) -> list[tuple[Family, tuple[tuple[str, str]]]]:
    """Full seconds and their fraction in two columns, as in ROS (sec and nanosec) and of Unix (tv_sec and tv_usec)."""
    fractions = {m[1].lower(): (name, PART_UNITS[m[2].lower()]) for name in single if (m := PARTS.match(name))}
    out = []
    for name, f in single.items():
        match = WHOLE.match(name)
        if match is None or match[1].lower() not in fractions:
            continue
        other, unit = fractions[match[1].lower()]
        full, part = f.x[:, 0], single[other].x[:, 0]
        if other != name and np.all(full == np.round(full)) and part.min() >= 0 and part.max() * UNITS[unit] < 1:
            t = full - full[0] + part * UNITS[unit]
            out.append((Family(name, f.words, f.sources, t[:, None]), ((other, unit),)))
    return out


def _round_rate(rate: float, within: float) -> float:
    """A rate, rounded where a round one is near: time stamps jitter."""
    for step in (1.0, 0.5, 0.1, 0.01):
        size = step * 10.0 ** np.floor(np.log10(rate))
        rounded = float(np.round(rate / size) * size)
        if abs(rounded / rate - 1) < within:
            return rounded
    return float(f"{rate:.6g}")
