"""Samples of a position that were lost: the value before is repeated, though the joint moves on.

An encoder that misses a reading, or a bus that misses a packet, says once more what it said last. For those who read
the record that is a delay that comes and goes. The samples themselves show it: no motion, and no noise, repeats a value
and is back on its way one sample later.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.interpolate import make_interp_spline
from scipy.ndimage import minimum_filter1d

from ident.dataset import Dataset, Segment

CHANNELS = ("q", "q_link")
STANDS_OUT = 4.0  # error of a repeated value over that of a straight line between its neighbours elsewhere
USUAL = 90.0  # percentile of the latter
COUNTS = 2.0  # the same error over the count of an encoder
STEPS, NEAR = 1.5, 33  # change after a repeated value over the least of as many near by, which may be a count
CAUGHT_UP = 0.5  # difference, relative, of the speed over repeated values from those before and after
LONGEST = 20  # samples: where more are alike a joint rests, or the log froze
FEWEST, LEAST = 5, 1e-3  # such samples of a joint from which any were lost, and their share
MANY = 0.01  # share that is a cause
REGULAR = 0.8  # share of the values that stand as long as most, or a multiple of it, where a slower clock repeats them
ROWS = 0.9  # share of the repeated values that come with all torques repeated, from which rows of the log came twice
DEGREE = 5  # of the spline that fills them
MOST_COUNTS = 5  # of an encoder in the smallest step of a record
WHOLE, MOSTLY = 0.02, 0.95  # distance from whole counts, of that share of the steps


@dataclass(frozen=True)
class LostSamples:
    """Samples of a channel that repeat the one before in motion.

    Attributes:
        share: of all samples.
        every: samples after which a slower clock has a new value; 0 of samples that are lost at random.
    """

    joint: int
    channel: str
    share: float
    every: int = 0

    @property
    def many(self) -> bool:
        """Whether so many were lost at random that they are a cause, and no untidiness of the log."""
        return not self.every and self.share >= MANY


def with_lost_samples_filled(dataset: Dataset) -> tuple[Dataset, tuple[LostSamples, ...]]:
    """A dataset in which such samples follow from those about them, and what was filled.

    Not where rows of the log came twice: torque and position still go together there.
    """
    found, segments = [], list(dataset.segments)
    for channel in CHANNELS:
        for j in range(dataset.n):
            at = [
                k
                for k, s in enumerate(segments)
                if (x := getattr(s, channel)) is not None and np.all(np.isfinite(x[:, j]))
            ]
            records = [getattr(segments[k], channel)[:, j] for k in at]
            lost, every = lost_among(records)
            count = sum(int(np.sum(x)) for x in lost)
            twice = sum(int(np.sum(x & same_as_before(segments[k].tau))) for k, x in zip(at, lost, strict=True))
            if not count or twice > ROWS * count:
                continue
            found.append(LostSamples(j, channel, count / sum(map(len, records)), every))
            for k, x, gone in zip(at, records, lost, strict=True):
                segments[k] = _with(segments[k], channel, j, filled(x, gone))
    return replace(dataset, segments=tuple(segments)) if found else dataset, tuple(found)


def lost_among(records: Sequence[np.ndarray]) -> tuple[list[np.ndarray], int]:
    """Samples of the records of one signal, (N,) each, that repeat the one before where the motion about them does not
    stop; and ``LostSamples.every``."""
    runs = [runs_of(x) for x in records]
    whole, step = sum(map(len, records)), np.concatenate([np.abs(np.diff(r.values)) for r in runs] or [np.empty(0)])
    count = resolution(step)
    if sum(_clear(r, count) for r in runs) < max(FEWEST, LEAST * whole):
        return [np.zeros(len(x), bool) for x in records], 0
    lengths = np.concatenate([r.lengths[r.lengths <= LONGEST] for r in runs])
    usual = int(np.median(lengths))
    clocked = usual > 1 and np.mean(lengths % usual == 0) > REGULAR
    return [_repeats(r, count) for r in runs], usual if clocked else 0


@dataclass(frozen=True)
class Runs:
    """Runs of equal values of a signal: their values, where they start, and how many samples they last."""

    values: np.ndarray
    starts: np.ndarray
    lengths: np.ndarray


def runs_of(x: np.ndarray) -> Runs:
    """The runs of equal values of a signal (N,), or of equal rows (N, m)."""
    starts = np.flatnonzero(~same_as_before(x))
    return Runs(x[starts], starts, np.diff(np.concatenate([starts, [len(x)]])))


def _clear(runs: Runs, count: float) -> int:
    """Repeated samples that no motion explains.

    Args:
        count: of the encoder; 0 where it has none that shows.
    """
    between = runs.lengths[:-1]
    if len(between) < 3 or np.all(between == 1):
        return 0
    slope = np.diff(runs.values) / between
    # What a straight line between the neighbours of a value misses, where nothing is lost or all the same.
    bend = np.abs(slope[1:] - slope[:-1]) * between[1:] * between[:-1] / (between[1:] + between[:-1])
    missed, step = np.abs(slope) * (between - 1), np.abs(np.diff(runs.values))
    # Once it has a new value the joint is where it would be at its speed before and after: it has not paused.
    caught_up, off = np.zeros(len(slope), bool), np.abs(np.diff(slope))
    caught_up[1:-1] = np.maximum(off[1:], off[:-1]) < CAUGHT_UP * np.abs(slope[1:-1])
    short = (between > 1) & (between <= LONGEST) & (step > STEPS * minimum_filter1d(step, NEAR))
    clear = short & caught_up & (missed > max(STANDS_OUT * np.percentile(bend, USUAL), COUNTS * count))
    return int(np.sum((between - 1)[clear]))


def _repeats(runs: Runs, count: float) -> np.ndarray:
    """(N,) samples that repeat the one before, of an encoder with counts those alone after which it skips some: slow
    motion repeats the others. The last value is taken to be followed by a step as large as the one to it."""
    short = (runs.lengths > 1) & (runs.lengths <= LONGEST)
    if count:
        values = runs.values
        short &= np.abs(np.diff(values, append=2.0 * values[-1] - values[-2:][0])) > STEPS * count
    again = np.repeat(short, runs.lengths)
    again[runs.starts] = False
    return again


def filled(x: np.ndarray, lost: np.ndarray) -> np.ndarray:
    """A signal (N,) with the samples that were lost told by the others; on the counts of its encoder, if it has any."""
    kept, gone = np.flatnonzero(~lost), np.flatnonzero(lost)
    if not len(gone) or len(kept) <= DEGREE:
        return x
    out = x.copy()
    out[gone] = make_interp_spline(kept, x[kept], DEGREE)(np.minimum(gone, kept[-1]))
    out[gone] += np.maximum(gone - kept[-1], 0) * (x[kept[-1]] - x[kept[-2]]) / (kept[-1] - kept[-2])
    if count := resolution(np.diff(x)):
        out[gone] = x[kept[0]] + count * np.round((out[gone] - x[kept[0]]) / count)
    return out


def resolution(step: np.ndarray) -> float:
    """The count of an encoder: the smallest of some steps that is no rounding error, or a small fraction of it, where
    the others are multiples of that; else 0."""
    size = np.abs(step[(step != 0) & np.isfinite(step)])
    if not len(size):
        return 0.0
    size = size[size > 1e-9 * size.max()]
    for parts in range(1, MOST_COUNTS + 1):
        counts = parts * size / size.min()
        if np.mean(np.abs(counts - np.round(counts)) < WHOLE) > MOSTLY:
            return float(size.min()) / parts
    return 0.0


def same_as_before(x: np.ndarray) -> np.ndarray:
    """(N,) samples, or rows (N, m), that are those before them in all numbers."""
    return np.concatenate([[False], np.all(x[1:] == x[:-1], axis=tuple(range(1, x.ndim)))])


def _with(segment: Segment, channel: str, joint: int, x: np.ndarray) -> Segment:
    """A segment with another signal at a joint."""
    signals = getattr(segment, channel).copy()
    signals[:, joint] = x
    return replace(segment, **{channel: signals})
