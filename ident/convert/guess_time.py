"""Which column of a log is the time, in which unit, and the sampling rate that it says."""

from __future__ import annotations

import re
from dataclasses import dataclass

import numpy as np

from ident.convert.guess_units import NAMED_UNITS, Family
from ident.convert.quantities import KINDS, UNITS

RATES = (20.0, 50e3)  # Hz: a log of an arm is sampled between
SECONDS = tuple(KINDS["time"])
TIMES = ("t", "time", "times", "stamp", "timestamp", "zeit", "secs", "sec")
SETTINGS = {"fs": 1, "rate": 1, "sample_rate": 1, "frequency": 1, "dt": -1, "ts": -1, "sample_time": -1, "tsample": -1}


@dataclass(frozen=True)
class FileClock:
    """The time column of one of several files: its name, rate in Hz, unit ("" of dates) and times in s."""

    name: str
    rate: float
    unit: str
    t: np.ndarray


def find_time(families: list[Family], signals: dict[str, np.ndarray], dates: set[str]) -> tuple[Family | None, float | None, str]:
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
