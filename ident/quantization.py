"""Steps in a position channel, seen in its samples themselves.

A resolution that is coarse against the noise leaves the samples on a grid, which spectra do not
show: they hold its error as a floor at all lines.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import scipy.fft

from ident.dataset import Dataset
from ident.group import NOISE_LINES, Group, mean_over_lines
from ident.transients import LEAKED

COARSE = 1.5  # rounding error over the sample noise from which steps are an effect
SAMPLES = 4000  # looked at per joint
BACKGROUND = 0.15  # median of the same over other steps: positions that dwell raise it at many
STRETCH = 400.0  # half the positions in which steps blurred by noise are looked for, in least steps
ON_GRID = 0.02  # distance from the grid, in steps, of samples that lie on it
LEAST_CELLS = 20  # steps that the motion must span,
FEWEST_LEVELS, EXACT = 3, 1e-3  # or so many positions at least that lie on the grid to this share of a step
CELLS_PER_STEP = 8  # of the histogram of positions, in the least step
CLEAR = 10.0  # power of a line over that of white rounding errors, above which it is motion
SIZES = (0.8, 0.9, 1.1, 1.2)  # of a motion over that which is recorded, at which it is rounded once more
LEAST_STD = 1e-6  # of a step that is seen exactly: recorders write numbers with so many digits
CONTRAST = 0.35  # of the sum over samples of exp(2 pi j q / step), relative to its largest value


@dataclass(frozen=True)
class Steps:
    """Position of a joint in steps of ``resolution``, with standard deviation; rad."""

    joint: int
    resolution: float
    std: float


def find_steps(dataset: Dataset, q_std: np.ndarray) -> tuple[Steps, ...]:
    """Joints whose motor position comes in steps that are coarse against its noise, by the identification segments.

    Args:
        q_std: (n,) sample noise that the robot or the dataset declares, rad.
    """
    out = []
    for j in range(dataset.n):
        periodic = dataset.select(role="identification", kind="multisine")
        moving = max(periodic or dataset.select(role="identification"), key=lambda s: float(np.ptp(s.q[:, j])))
        q = moving.q[:: max(1, len(moving.q) // SAMPLES), j]
        found = _exact_grid(q)
        if found is None:
            found = _blurred_grid(q, float(q_std[j])) if periodic else None
        if found is not None and found[0] / np.sqrt(12.0) > COARSE * q_std[j]:
            out.append(Steps(j, *found))
    return tuple(out)


def with_rounding(
    groups: Sequence[Group],
    steps: Sequence[Steps],
    dataset: Dataset,
    noise: tuple[np.ndarray, np.ndarray] | None = None,
) -> tuple[Group, ...]:
    """Groups with the error that steps leave in their positions (``rounding_error``), less what scatters between
    periods as noise does.

    Args:
        noise: (n,) sample noise of the position before it is rounded, and as it scatters in the torque residual, rad.
            Where None the latter is taken from the positions, which move with what circulates in the loop too: that is
            no error, and too much is then taken off.
    """
    if not steps:
        return tuple(groups)
    segments = {s.name: s for s in dataset.segments}
    out = []
    for group in groups:
        samples = round(group.period_time * dataset.sample_rate)
        rounding = np.zeros((group.n_compared, dataset.n))
        for x in steps:
            # Where the steps lie is told by each group itself: over many of them small errors of one add up.
            recorded = np.concatenate([segments[name].q[:, x.joint] for name in group.segments])
            at = x.resolution * np.angle(np.mean(np.exp(2j * np.pi * recorded / x.resolution))) / (2 * np.pi)
            error = rounding_error(group.Q[:, :, x.joint], x.resolution, at, samples, group.n_compared)
            scatter = (
                _varying(group, x.joint)
                if noise is None
                else (noise[1][x.joint] ** 2 - noise[0][x.joint] ** 2) / samples
            )
            rounding[:, x.joint] = error * max(1.0 - scatter / error.mean(), 0.0)
        out.append(replace(group, rounding=rounding))
    return tuple(out)


def rounding_error(Q: np.ndarray, step: float, at: float, samples: int, lines: int) -> np.ndarray:
    """Variance (lines,) of a line of a position that comes in steps, rad2; mean over records.

    It is white with ``step^2 / 12`` where samples are many steps apart (Widrow and Kollar 2008, ch. 19). Slow motion
    holds the low lines, and motion with odd lines alone about the middle of a step the odd ones: the motion itself, its
    lines that stand out of such errors, is rounded once more, and the power of what that changes taken in the mean over
    lines near by, even and odd ones apart. As the motion holds errors of its own, which would not be made again, it is
    made smaller and larger.

    Args:
        Q: (S, L) spectra of the position, rad.
        at: where a step lies, rad.
    """
    white = step**2 / 12.0 / samples
    motion = np.where(np.abs(Q) ** 2 > CLEAR * white, Q, 0.0)[:, : samples // 2 + 1]
    motion[:, 0] = 0.0
    cells = scipy.fft.irfft(motion * samples, samples, axis=1) / step
    if np.ptp(cells, axis=1).max() < 1.0:
        return np.full(lines, white)
    cells = np.concatenate([x * cells + (Q[:, :1].real - at) / step for x in SIZES])
    error = step * (np.round(cells) - cells)
    power = np.mean(np.abs(scipy.fft.rfft(error, axis=1, norm="forward")[:, :lines]) ** 2, axis=0)
    for first in (0, 1):
        power[first::2] = mean_over_lines(power[first::2], NOISE_LINES)
    return power * white * samples / np.mean(error**2)


def _varying(group: Group, joint: int) -> float:
    """Variance of a line of the position that differs from period to period, in the mean over the compared ones."""
    if group.U_periods.shape[1] > 1:
        return float(np.mean(np.var(group.Q_periods[:, :, 1 : group.n_compared, joint], axis=1, ddof=1)))
    return 0.0 if group.Q_noise is None else float(np.mean(np.abs(group.Q_noise[:, LEAKED:, joint]) ** 2))


def _exact_grid(q: np.ndarray) -> tuple[float, float] | None:
    """Step and its deviation where every sample is a whole number of steps from the others."""
    levels = np.unique(q)
    if len(levels) < FEWEST_LEVELS or len(levels) > 0.7 * len(q):
        return None
    gaps = np.diff(levels)
    gaps = gaps[gaps > 1e-6 * np.median(gaps)]
    step = float(np.min(gaps))
    # Each longer gap tells the step better: the grid is followed from near to far.
    for reach in np.geomspace(1.0, max(np.ptp(levels) / step, 1.0), 12):
        near = gaps[gaps <= reach * step * 1.5]
        step = float(np.sum(near) / max(np.sum(np.round(near / step)), 1.0))
    cells = (levels - levels[0]) / step
    off = np.abs(cells - np.round(cells))
    few = np.ptp(levels) < LEAST_CELLS * step
    if np.any(off > EXACT) if few else np.mean(off < ON_GRID) < 0.98:
        return None
    return step, step * max(float(np.sqrt(np.mean(off**2)) / np.ptp(cells)), LEAST_STD)


def _blurred_grid(q: np.ndarray, noise: float) -> tuple[float, float] | None:
    """The same where noise was added after the rounding: clusters, by their characteristic function.

    Looked for in a stretch of positions short enough to be crossed evenly.
    """
    least = COARSE * np.sqrt(12.0) * noise
    near = q[np.abs(q - np.median(q)) < STRETCH * least][:SAMPLES]
    return _clusters(near, least) if len(near) > LEAST_CELLS**2 else None


def _clusters(q: np.ndarray, least: float) -> tuple[float, float] | None:
    """Step of at least ``least`` about whose multiples the samples cluster, and its deviation."""
    span = float(np.ptp(q))
    low, high = LEAST_CELLS / max(span, 1e-300), 1.0 / least
    if high <= low:
        return None
    cell = least / CELLS_PER_STEP
    bins = int(np.ceil(span / cell)) + 1
    length = scipy.fft.next_fast_len(5 * bins, real=True)
    counts = np.bincount(np.floor((q - q.min()) / cell).astype(int), minlength=bins)
    wave = np.arange(length // 2 + 1) / (length * cell)
    inside = (wave >= low) & (wave <= high)
    contrast = np.abs(scipy.fft.rfft(counts, n=length))[inside] / (len(q) * np.sinc(wave[inside] * cell))
    wave = wave[inside]
    best = int(np.argmax(contrast))
    if contrast[best] < CONTRAST or np.median(contrast) > BACKGROUND * contrast[best]:
        return None
    fine = wave[best] + np.linspace(-0.3, 0.3, 61) / span
    value = np.abs(np.exp(2j * np.pi * np.outer(fine, q)).mean(axis=1))
    step = 1.0 / float(fine[np.argmax(value)])
    return step, step**2 * 0.02 / span
