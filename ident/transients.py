"""Noise of records that hold one steady period, by how that differs from the end of the transient one before it.

What a model lacks repeats from period to period and noise does not, so that the scatter between periods tells them
apart (Pintelon and Schoukens 2012, ch. 2). A single steady period has none. By the end of a transient period the
transient has died down, and its samples differ from those a period later by noise alone.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import scipy.fft
import scipy.signal

from ident.dataset import Segment

# one over the share of the transient period, from its end, that is looked at: the longest that is steady
SHARES = (2, 4)
# power in the first half of it over that in the second, of any channel in the compared band, of a transient that goes
# on
DYING = 2.0
FEWEST_LINES = 12  # of such a spectrum
LEAKED = 2  # lines of it, from the first, that slow motion reaches through the window


def ends_of_transients(members: Sequence[Segment], top: int) -> tuple[int, np.ndarray, np.ndarray] | None:
    """Spectra of noise of the torque and of the position, as a line of one period holds it.

    Args:
        members: records of the same period.
        top: highest compared line.

    Returns:
        Spacing of these spectra in lines of the period, and (S, J, n) of each channel; None where records hold more
        periods, or none before, or where the transient goes on.
    """
    if any(s.steady_periods != 1 or s.transient_periods < 1 for s in members):
        return None
    period = members[0].period
    assert period is not None  # records of periods
    before, after = (
        [{c: getattr(s, c)[-m * period :][:period] for c in ("tau", "q")} for s in members] for m in (2, 1)
    )
    for spacing in SHARES:
        width, lines = period // spacing, top // spacing + 1
        if lines < FEWEST_LINES + LEAKED:
            return None
        channels = [
            np.stack([a[c][-width:] - b[c][-width:] for a, b in zip(after, before, strict=True)]) for c in ("tau", "q")
        ]
        if any(_goes_on(x, lines // 2 + 1) for x in channels):
            continue
        # A difference of two holds twice the noise, and a line of a period that of its samples over their number.
        torque, position = (_spectrum(x, lines) / np.sqrt(2.0 * period) for x in channels)
        return spacing, torque, position
    return None


def _goes_on(x: np.ndarray, lines: int) -> bool:
    """Whether differences (S, N, n) are larger in their first half than in their second, by some channel."""
    half = x.shape[1] // 2
    first, second = (
        np.sum(np.abs(_spectrum(part, lines)[:, LEAKED:]) ** 2, axis=(0, 1)) for part in (x[:, :half], x[:, -half:])
    )
    return bool(np.any(first > DYING * second))


def _spectrum(x: np.ndarray, lines: int) -> np.ndarray:
    """(S, lines, n) of samples (S, N, n) through a window: white noise has the variance of its samples in each line."""
    window = scipy.signal.windows.hann(x.shape[1], sym=False)
    return scipy.fft.rfft(x * window[:, None], axis=1)[:, :lines] / np.sqrt(np.sum(window**2))
