"""Motions closed by a smooth return, so that they have a spectrum."""

from __future__ import annotations

import numpy as np

BRAKE_TIME = 1.0  # s, in which the acceleration at the ends of a motion fades in its return
END_TIME = 0.1  # s, over which slope and curvature of an end are taken
END_SAMPLES = 12  # at least


def close_motion(x: np.ndarray, n_return: int, fs: float, *, curvature: bool) -> np.ndarray:
    """Append a return from the last sample to the first; (N + n_return, n).

    A polynomial of fifth order with matching slopes, and none of higher order that end within ``BRAKE_TIME`` with
    matching ``curvature``: a motor whose acceleration ended at once would ask for a step of torque, which rings.

    Args:
        fs: samples per second.
    """
    width = min(max(round(END_TIME * fs), END_SAMPLES), len(x) // 2)
    v_end, a_end = _end_slope(x[-width:], -1)
    v_start, a_start = _end_slope(x[:width], 0)
    span = n_return + 1
    u = (np.arange(1, n_return + 1) / span)[:, None]
    s = u**3 * (10 - 15 * u + 6 * u**2)
    leave = u - 6 * u**3 + 8 * u**4 - 3 * u**5
    arrive = -4 * u**3 + 7 * u**4 - 3 * u**5
    back = x[-1] + (x[0] - x[-1]) * s + span * (v_end * leave + v_start * arrive)
    if curvature:
        brake = min(BRAKE_TIME * fs, span)
        back += brake**2 * (a_end * _bump(u * span / brake) + a_start * _bump((1.0 - u) * span / brake))
    return np.concatenate([x, back])


def _end_slope(x: np.ndarray, at: int) -> tuple[np.ndarray, np.ndarray]:
    """(n,) slope and curvature per sample at the first or last of samples (N, n), by a cubic through all of them."""
    t = np.arange(len(x), dtype=float)
    t = (t - t[at]) / max(len(x) - 1, 1)
    c = np.linalg.lstsq(np.vander(t, min(4, len(x)), increasing=True), x, rcond=None)[0]
    c = np.concatenate([c, np.zeros((3, x.shape[1]))])
    return c[1] / max(len(x) - 1, 1), 2.0 * c[2] / max(len(x) - 1, 1) ** 2


def _bump(u: np.ndarray) -> np.ndarray:
    """Unit curvature at 0, without value or slope there; none of the three from 1 on."""
    return np.where(u < 1.0, 0.5 * u**2 * (1.0 - np.minimum(u, 1.0)) ** 3, 0.0)
