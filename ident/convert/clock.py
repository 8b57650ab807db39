"""Signals with time stamps on a uniform clock: gaps, jitter, other rates, files with clocks of their own."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import scipy.interpolate
import scipy.signal

from ident.convert.dates import seconds
from ident.convert.rounding import even_rows
from ident.dataset import Filled
from robot_assets.errors import DataError

JITTER = 0.05  # of a sample, above which time stamps are resampled
LONGEST_GAP = 0.5  # s without a sample, at most: what happened in it cannot be made up
LONGEST = 100  # times as many samples as the log: beyond, the unit of time is wrong
GAP = 1.5  # samples, of the log or of the dataset: a longer step is a gap
FASTER = 1.2  # times the rate of the dataset, above which a log holds frequencies that would fold
PASSED = 0.8  # of the new Nyquist frequency, up to which nothing changes; above all of it nothing is left
REJECTED = 80.0  # dB
OF_JOINTS = 0.4  # of the rows, at the time of the one before: rows of two joints each are half
FAR = 10.0  # times as far as from stamp to stamp


@dataclass(frozen=True)
class Stamps:
    """Time stamps of one file, checked.

    Attributes:
        t: (N,) s, not falling. rate: Hz, of the log, by the median of its steps.
        starts, ends: (G,) s, samples about the gaps.
        rounded: s, by which the stamps of the log are rounded: ``t`` are even times then; 0 where they are as they were.
    """

    t: np.ndarray
    rate: float
    starts: np.ndarray
    ends: np.ndarray
    rounded: float = 0.0

    def told(self) -> str:
        """What was done to rounded stamps, in words; empty where they are none."""
        if not self.rounded:
            return ""
        return f"stamps rounded to {self.rounded * 1e3:.4g} ms: its {len(self.t)} rows put at even times, {self.rate:.6g} Hz"

    def filled(self, start: float, end: float) -> Filled | None:
        """The gaps that reach into a stretch of time, s; None where there are none."""
        length = np.minimum(self.ends, end) - np.maximum(self.starts, start)
        length = length[length > 0]
        return Filled(len(length), float(length.max()), float(length.sum())) if len(length) else None


def stamp_seconds(x: np.ndarray, factor: float, first: Any) -> np.ndarray:
    """(N,) s since a first stamp; dates bring their own unit, others ``factor`` s of it."""
    return seconds(x, first) if x.dtype.kind in "Mm" else factor * x - factor * first


def changed(clock: Stamps, rows: np.ndarray, N: int, rate: float) -> str:
    """What resampling does to a log, in words; ``rows`` (N, k) are its signals."""
    step, filled = np.diff(clock.t), clock.filled(clock.t[0], clock.t[-1])
    gaps = f"{filled.gaps} gaps, {filled.total:.3g} s in all," if filled else "0 gaps"
    repeated = int(np.sum(np.all(rows[1:] == rows[:-1], axis=1)))
    filtered = f"; it has {clock.rate:.4g} Hz: filtered below {rate / 2:g} Hz" if folds(clock, rate) else ""
    return (
        f"{len(clock.t)} stamped samples resampled to {N} at {rate:g} Hz; {gaps} filled by interpolation, the longest {step.max() * 1e3:.3g} ms; "
        f"{int(np.sum(step == 0))} stamps twice, {repeated} samples that repeat the one before{filtered}"
    )


def check_order(t: np.ndarray, path: Path) -> None:
    """Raise a DataError where stamps (N,), s, are not finite or go back."""
    step = np.diff(t)
    bad = np.flatnonzero(~np.isfinite(t))
    if len(bad):
        raise DataError(
            "time", str(path), f"no stamp at sample {bad[0]} ({len(bad)} not finite in all)", "a stamp for each sample"
        )
    back = np.flatnonzero(step < 0)
    if len(back):
        k, more = int(back[0]), f", {len(back)} times in all" if len(back) > 1 else ""
        found = f"a stamp that goes back by {-step[k]:.6g} s at sample {k + 1}{more}"
        raise DataError("time", str(path), found, "rising time stamps: cut the log into two where it begins anew")


def check_stamps(t: np.ndarray, rate: float, path: Path, signals: Sequence[np.ndarray] = ()) -> Stamps:
    """Stamps (N,), s, for a dataset of ``rate`` Hz; even times where they are those, rounded.

    They have passed ``check_order``.

    Args:
        signals: (N, k) each, that tell whether the rows are even.

    Raises:
        DataError: where they have a gap too long to be filled, or are in another unit.
    """
    even = even_rows(t, signals, 1 / rate)
    t = t if even is None else even.t
    step = np.diff(t)
    span = t[-1] - t[0]
    usual = even.step if even is not None else float(np.median(step[step > 0])) if np.any(step > 0) else 1 / rate
    spans = len(t) / LONGEST <= span * rate <= LONGEST * len(t)
    # One that is ages long, beside steps that are right, is no wrong unit.
    if step.size and step.max() > max(LONGEST_GAP, 2.0 / rate) and (spans or 1 / LONGEST < usual * rate < LONGEST):
        found = f"{step.max():.4g} s without a sample after {t[int(np.argmax(step))] - t[0]:.4g} s"
        raise DataError("time", str(path), found, f"gaps of at most {LONGEST_GAP:g} s: cut the log into two there")
    if not spans:
        found = f"{len(t)} samples over {span:.4g} s"
        raise DataError("time", str(path), found, f"about sample_rate = {rate:g} Hz: is the unit of time right?")
    long = step > GAP * max(usual, 1 / rate)
    return Stamps(t, 1 / usual, t[:-1][long], t[1:][long], 0.0 if even is None else even.by)


def check_rows(t: np.ndarray, q: np.ndarray, path: Path) -> None:
    """Raise a DataError where rows of one stamp (N,) hold positions q (N, n) of several joints: they differ by far more
    than a joint moves from stamp to stamp, and not as where a clock is coarse."""
    same = np.diff(t) == 0
    if np.all(same) or not np.sum(same) > OF_JOINTS * len(same):
        return
    first = q[np.concatenate([[True], ~same])]
    within = np.median(np.abs(np.diff(q, axis=0)[same]), axis=0)
    if np.any(within > FAR * np.median(np.abs(np.diff(first, axis=0)), axis=0)):
        found = f"{int(np.sum(same))} of {len(q)} rows at the time of the one before, with positions far from it"
        expected = "a row for each time with columns for all joints: pivot a table of one joint a row"
        raise DataError("time", str(path), found, expected)


def uniform_times(start: float, end: float, rate: float) -> np.ndarray:
    """(N,) times of samples at ``rate`` Hz, s; the last may lie beyond the end by less than the jitter."""
    return start + np.arange(int(np.floor((end - start) * rate + JITTER)) + 1) / rate


def at_times(stamps: Stamps, t: np.ndarray, rate: float) -> bool:
    """Whether the samples stand at times ``t``, or at even steps beside them, as they are."""
    return len(t) == len(stamps.t) and bool(
        np.all(np.abs(np.diff(stamps.t) * rate - 1) < JITTER) and abs(stamps.t[0] - t[0]) * rate < JITTER
    )


def folds(stamps: Stamps, rate: float) -> bool:
    """Whether a log holds frequencies that a dataset of ``rate`` Hz cannot."""
    return stamps.rate > FASTER * rate


def resample(x: np.ndarray, stamps: Stamps, t: np.ndarray, rate: float) -> np.ndarray:
    """Signals (N, k) at the times ``t`` of ``rate`` Hz, (len(t), k).

    A log that is faster passes a filter without phase, the same for all signals: those above half of ``rate``
    would come back as lower ones, and a filter with phase would make its channels late.
    """
    keep = np.concatenate([[True], np.diff(stamps.t) > 0])
    at, x = stamps.t[keep], x[keep]
    if not folds(stamps, rate):
        return np.stack([np.interp(t, at, c) for c in x.T], axis=1)
    factor = int(np.ceil(stamps.rate / rate))
    fine = t[0] + np.arange((len(t) - 1) * factor + 1) / (factor * rate)
    return np.stack(
        [_decimate(_between(fine, at, c), factor) if np.all(np.isfinite(c)) else np.interp(t, at, c) for c in x.T],
        axis=1,
    )


def _between(t: np.ndarray, at: np.ndarray, x: np.ndarray) -> np.ndarray:
    """(len(t),) values between samples; monotone, as stamps that jitter would make a smooth curve swing."""
    return (
        scipy.interpolate.PchipInterpolator(at, x)(np.clip(t, at[0], at[-1])) if len(at) > 1 else np.full(len(t), x[0])
    )


def _decimate(x: np.ndarray, factor: int) -> np.ndarray:
    """Every ``factor``-th of samples (N,), of a signal that has lost what they cannot show."""
    length, beta = scipy.signal.kaiserord(REJECTED, (1 - PASSED) / factor)
    half = -(-(length // 2) // factor) * factor
    taps = scipy.signal.firwin(2 * half + 1, (1 + PASSED) / 2 / factor, window=("kaiser", beta))
    # Ends go on as their own image, turned about the last sample: neither value nor slope jumps there.
    padded = np.pad(x, half, mode="reflect", reflect_type="odd") if len(x) > 1 else np.pad(x, half, mode="edge")
    return scipy.signal.upfirdn(taps, padded, down=factor)[2 * half // factor :][: (len(x) - 1) // factor + 1]
