"""Samples of a position that were lost: the value before is repeated, though the joint moves on.

An encoder that misses a reading, or a bus that misses a packet, says once more what it said last. For those who read
the record that is a delay that comes and goes. The samples themselves show it: no motion, and no noise, repeats a value
and is back on its way one sample later.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.interpolate import make_interp_spline
from scipy.ndimage import minimum_filter1d

from ident.dataset import Dataset

CHANNELS = ("q", "q_link")
STANDS_OUT = 4.0  # error of a repeated value over that of a straight line between its neighbours elsewhere
USUAL = 90.0  # percentile of the latter
STEPS, NEAR = 1.5, 33  # change after a repeated value over the least of as many near by, which may be an encoder's step
CAUGHT_UP = 0.5  # difference, relative, of the speed over repeated values from those before and after
LONGEST = 20  # samples: where more are alike a joint rests, or the log froze
FEWEST, LEAST = 5, 1e-3  # such samples at a joint from which any were lost, and their share
REGULAR = 0.8  # share of the values that are repeated as often as most, from which a slower clock is what repeats them
DEGREE = 5  # of the spline that fills them


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


def with_lost_samples_filled(dataset: Dataset) -> tuple[Dataset, tuple[LostSamples, ...]]:
    """A dataset in which such samples follow from those about them, and what was filled."""
    found = []
    for channel in CHANNELS:
        for j in range(dataset.n):
            records = {
                k: x[:, j]
                for k, s in enumerate(dataset.segments)
                if (x := getattr(s, channel)) is not None and np.all(np.isfinite(x[:, j]))
            }
            lost = {k: repeated(x) & ~_row_again(dataset.segments[k].tau[:, j]) for k, x in records.items()}
            whole, count = sum(map(len, records.values())), sum(int(np.sum(at)) for at in lost.values())
            if count < FEWEST or count < LEAST * whole:
                continue
            found.append(LostSamples(j, channel, count / whole, _clock(list(lost.values()))))
            for k, at in lost.items():
                dataset = _with(dataset, k, channel, j, filled(records[k], at))
    return dataset, tuple(found)


def repeated(x: np.ndarray) -> np.ndarray:
    """(N,) samples that repeat the one before, where the motion about them does not stop."""
    starts = np.concatenate([[0], np.flatnonzero(np.diff(x)) + 1])
    lengths = np.diff(np.concatenate([starts, [len(x)]]))
    none = np.zeros(len(x), bool)
    if len(starts) < 4 or np.all(lengths == 1):
        return none
    values, between = x[starts], np.diff(starts)
    slope = np.diff(values) / between
    # What a straight line between the neighbours of a value misses, where nothing is lost or all the same.
    bend = np.abs(slope[1:] - slope[:-1]) * between[1:] * between[:-1] / (between[1:] + between[:-1])
    missed = np.abs(slope) * (lengths[:-1] - 1)
    steps = np.abs(np.diff(values))
    short = (lengths > 1) & (lengths <= LONGEST)
    runs = short[:-1] & (steps > STEPS * minimum_filter1d(steps, NEAR))
    # Once it has a new value the joint is where it would be at its speed before and after: it has not paused.
    caught_up = np.zeros(len(slope), bool)
    off = np.abs(np.diff(slope))
    caught_up[1:-1] = np.maximum(off[1:], off[:-1]) < CAUGHT_UP * np.abs(slope[1:-1])
    clear = runs & caught_up & (missed > STANDS_OUT * np.percentile(bend, USUAL))
    if np.sum((lengths[:-1] - 1)[clear]) < max(FEWEST, LEAST * len(x)):
        return none
    # Slow motion repeats values by the steps of an encoder alone.
    again = np.repeat(np.append(runs, False) if resolution(steps) else short, lengths)
    again[starts] = False
    return again


def filled(x: np.ndarray, lost: np.ndarray) -> np.ndarray:
    """A signal (N,) with the samples that were lost told by the others."""
    kept, gone = np.flatnonzero(~lost), np.flatnonzero(lost)
    if not len(gone) or len(kept) <= DEGREE:
        return x
    out = x.copy()
    out[gone] = make_interp_spline(kept, x[kept], DEGREE)(np.minimum(gone, kept[-1]))
    out[gone] += np.maximum(gone - kept[-1], 0) * (x[kept[-1]] - x[kept[-2]]) / (kept[-1] - kept[-2])
    return out


def resolution(step: np.ndarray) -> float:
    """The smallest of some steps that is no rounding error, where the others are multiples of it: the count of an
    encoder; else 0."""
    size = np.abs(step[step != 0])
    if not len(size):
        return 0.0
    size = size[size > 1e-9 * size.max()]
    counts = size / size.min()
    whole = np.mean(np.abs(counts - np.round(counts)) < 0.02) > 0.95
    return float(size.min()) if whole else 0.0


def _row_again(tau: np.ndarray) -> np.ndarray:
    """(N,) samples whose torque is that of the one before too: a row of the log that came twice, in which torque and
    position still go together."""
    return np.concatenate([[False], tau[1:] == tau[:-1]])


def _clock(lost: list[np.ndarray]) -> int:
    """Samples between new values where most are as far apart; else 0."""
    apart = np.concatenate([np.diff(np.flatnonzero(~at)) for at in lost])
    usual = int(np.median(apart))
    return usual if usual > 1 and np.mean(apart == usual) > REGULAR else 0


def _with(dataset: Dataset, segment: int, channel: str, joint: int, x: np.ndarray) -> Dataset:
    """A dataset with another signal at a joint of a segment."""
    segments = list(dataset.segments)
    signals = getattr(segments[segment], channel).copy()
    signals[:, joint] = x
    segments[segment] = replace(segments[segment], **{channel: signals})
    return replace(dataset, segments=tuple(segments))
