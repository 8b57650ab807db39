"""Where motors stand still, in records and in the mean of their periods."""

from __future__ import annotations

import numpy as np
import scipy.ndimage
import scipy.stats

from ident.group import Group

REST_TIME, REST_SAMPLES = 0.01, 5  # s, and samples at least, within which a motor that stands still does not move
REST_NOISE = 6.0  # beyond this many standard deviations of its noise
LONGER = 4  # times the time of a short rest
WIDER = 0.7  # standard deviations by which positions of one at rest may range further than noise does in the mean


def at_rest(q: np.ndarray, fs: float, span: float) -> np.ndarray:
    """Where motors stand still (N, n): samples in windows of ``span`` seconds that hold no more than noise, or a step
    of the encoder."""
    return _still(q, max(round(span * fs), REST_SAMPLES), _stillness(q, REST_NOISE), "nearest")


def at_rest_in_period(q: np.ndarray, fs: float, span: float) -> np.ndarray:
    """The same of the mean over periods (P, N, n): of motors that stand still for long, and most that do so for a short
    time, where those that creep must not be taken for them; where they turn they rest too (``turning``)."""
    mean, samples = q.mean(axis=0), q.reshape(-1, q.shape[-1])
    width = max(round(span * fs), REST_SAMPLES)
    short, long = (
        _still(mean, size, _stillness(samples, apart / np.sqrt(len(q))), "wrap")
        for size, apart in ((width, noise_range(width) + WIDER), (LONGER * width, REST_NOISE))
    )
    return short | long


def noise_range(count: int) -> float:
    """Mean range of so many independent normal numbers, standard deviations: twice their mean maximum, to 1 % from
    5 on (Chen and Tyler, Commun. Statist. Simul. Comput. 28, 1999)."""
    return float(2.0 * scipy.stats.norm.ppf(0.5264 ** (1.0 / count)))


def _stillness(q: np.ndarray, apart: float) -> np.ndarray:
    """(n,) what positions (N, n) of motors that stand still differ by, rad: so many standard deviations of their noise,
    or a step of the encoder."""
    steps = np.abs(np.diff(q, axis=0))
    least = np.min(np.where(steps > 0, steps, np.inf), axis=0)
    return np.maximum(apart * difference_noise(q), np.where(np.isfinite(least), 1.5 * least, 0.0))


def lasting(rest: np.ndarray, width: int) -> np.ndarray:
    """Where a motor rests (S, n_time, n) for ``width`` points at least: in a turn the velocity says more than the
    torque."""
    narrow = scipy.ndimage.minimum_filter1d(rest.astype(np.uint8), width, axis=1, mode="nearest")
    return scipy.ndimage.maximum_filter1d(narrow, width, axis=1, mode="nearest", origin=-1 if width % 2 == 0 else 0) > 0


def slow(group: Group) -> np.ndarray:
    """(S, n_time, n) where the velocity that laws see of a motion is as that of a motor that rests.

    Positions may differ by no more than noise where a motor moves slowly, and its direction is known.
    """
    return np.abs(group.velocity) < group.least_velocity[:, None]


def turning(group: Group) -> np.ndarray:
    """(S, n_time, n) where the velocity of a periodic motion turns between two points of the grid.

    Dry friction jumps there, and with it the acceleration: in a motion whose lines end the velocity turns too late.
    """
    turns = group.velocity * np.roll(group.velocity, -1, axis=1) <= 0.0
    return turns | np.roll(turns, 1, axis=1)


def _still(q: np.ndarray, width: int, level: np.ndarray, mode: str) -> np.ndarray:
    """Samples (N, n) in windows of ``width`` within which positions differ by no more than ``level``."""
    span = scipy.ndimage.maximum_filter1d(q, width, axis=0, mode=mode) - scipy.ndimage.minimum_filter1d(
        q, width, axis=0, mode=mode
    )
    # An even window reaches one sample further back than ahead: the windows that hold a sample reach the other way.
    origin = -1 if width % 2 == 0 else 0
    return scipy.ndimage.maximum_filter1d((span <= level).astype(np.uint8), width, axis=0, mode=mode, origin=origin) > 0


def difference_noise(x: np.ndarray) -> np.ndarray:
    """Standard deviation of white noise on a smooth signal (N, n), from fourth differences; (n,).

    ``var(diff^4 x) = 70 var(x)`` for white noise; the median makes it blind to spikes.
    """
    d = np.diff(x, n=4, axis=0)
    return 1.4826 * np.median(np.abs(d - np.median(d, axis=0)), axis=0) / np.sqrt(70.0)
