"""Time stamps that a clock or a file has rounded: rows sampled at even times, under stamps coarser than their steps
are even."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

LEAST = 0.05  # of a sample, below which rounding is none to care about
SAME = 0.1  # of the rounding step, in which steps of one size differ: fractions of a tick are rounded themselves
GAPS = 0.01  # of the rows, after which some are lost, at most: where more are the clock is not even
RARER = 0.01  # of the steps have the rarer size, at least, where it may as well be a row that was lost or repeated
DIFFER = 0.5  # of the rows that share a stamp with the one before, at least; else rows are repeated
SMOOTHER = 1.1  # times the roughness at the stamps, above which signals tell that these are right
LOOKED_AT = 200_000  # rows in which signals are looked at
SHORTEST = TICKS = 20  # rows, and times that their stamps rise, of a clock that can be told from a few jumps


@dataclass(frozen=True)
class Rounded:
    """A clock whose stamps are rounded.

    Attributes:
        t: (N,) even times of the rows, in the unit of the stamps; between gaps, where there are any.
        step: from row to row. by: what the stamps are rounded by; both in that unit.
    """

    t: np.ndarray
    step: float
    by: float


def even_rows(t: np.ndarray, signals: Sequence[np.ndarray], step: float | None = None) -> Rounded | None:
    """Even times of rows whose stamps (N,) are rounded; None where they are not, or where the rows do not look even.

    Rounded stamps of even rows take two steps only, neighbouring multiples of what they are rounded by, in such an
    order that no stamp is farther than that from its place on an even grid. Rows that were lost or repeated, and those
    written when something happened, do not keep that order, or their signals are rougher on the grid.

    Args:
        signals: (N,) or (N, k) each, of the rows; others are not looked at.
        step: from row to row, or of several rows, taken where the stamps allow it.
    """
    sizes = np.diff(t)
    if len(t) < SHORTEST or not t[-1] > t[0] or sizes.min() < 0:
        return None
    low = float(sizes.min())
    above = sizes[sizes > low + LEAST * (t[-1] - t[0]) / len(sizes)]
    if len(above) < TICKS:
        return None
    by = float(np.median(above)) - low
    gap = sizes > low + (1 + SAME) * by
    between = np.abs(sizes - low - by * (sizes > low + by / 2)) > SAME * by
    times = low / by
    if np.any(between & ~gap) or np.mean(gap) > GAPS or abs(times - round(times)) > SAME:
        return None
    # A few stamps twice, or steps of another size, are rows repeated or lost rather than a rounded clock.
    if (min(len(above), len(sizes) - len(above)) if round(times) else np.sum(sizes == 0)) < RARER * len(sizes):
        return None
    starts = np.concatenate([[0], np.flatnonzero(gap) + 1])
    grid = _grid(t, starts, by, None)
    if grid is None:
        return None
    if step is not None:
        grid = _grid(t, starts, by, step / max(1, round(step / grid[1]))) or grid
    found = Rounded(*grid, by)
    rows = [x.reshape(len(t), -1)[:LOOKED_AT] for x in signals if len(x) == len(t) and x.ndim <= 2]
    return found if _looks_even(t[:LOOKED_AT], found.t[:LOOKED_AT], rows) else None


def _grid(t: np.ndarray, starts: np.ndarray, by: float, step: float | None) -> tuple[np.ndarray, float] | None:
    """Even times of stretches of rows, which begin at ``starts``, and their step; None where stamps are farther than
    ``by`` from them."""
    lengths = np.diff(np.append(starts, len(t)))

    def centred(x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        mean = np.repeat(np.add.reduceat(x, starts) / lengths, lengths)
        return x - mean, mean

    k, _ = centred(np.arange(len(t), dtype=float))
    stamps, mean = centred(t)
    step = step or float(k @ stamps / (k @ k))
    off = stamps - step * k
    wide = np.maximum.reduceat(off, starts) - np.minimum.reduceat(off, starts)
    even = mean + step * k
    return (even, step) if wide.max() <= (1 + SAME) * by and np.all(np.diff(even) > 0) else None


def _looks_even(stamps: np.ndarray, even: np.ndarray, rows: Sequence[np.ndarray]) -> bool:
    """Whether rows of one stamp differ, and signals are no rougher at even times than at the stamps, of which the first
    row of each counts."""
    first = np.concatenate([[True], np.diff(stamps) > 0])
    if not rows or np.sum(first) < 3:
        return True
    same = np.flatnonzero(~first)
    differ = np.any([np.any(x[same] != x[same - 1], axis=1) for x in rows], axis=0)
    if len(same) and np.mean(differ) < DIFFER:
        return False
    ratios = []
    for x in (column for table in rows for column in table.T):
        if np.all(np.isfinite(x)) and not _monotone(x):  # of other clocks and counters either may be right
            ratios.append((_roughness(even, x) + 1e-300) / (_roughness(stamps[first], x[first]) + 1e-300))
    return not ratios or bool(np.exp(np.mean(np.log(np.clip(ratios, 0.1, 10.0)))) <= SMOOTHER)


def _monotone(x: np.ndarray) -> bool:
    steps = np.diff(x)
    return bool(np.all(steps >= 0) or np.all(steps <= 0))


def _roughness(t: np.ndarray, x: np.ndarray) -> float:
    """Root mean square of what samples (N,) differ by from the line between their neighbours."""
    share = (t[1:-1] - t[:-2]) / (t[2:] - t[:-2])
    return float(np.sqrt(np.mean((x[1:-1] - (1 - share) * x[:-2] - share * x[2:]) ** 2)))
