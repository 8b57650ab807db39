"""Tones of the torque that do not repeat with the period: what shakes a joint at a frequency of its own.

Such a tone is in the scatter between periods, or in what a transient one ends with beside a single steady one, where it
would count as noise. It stands at one line and leaks to those next to it, where noise of samples, carried to the torque
by the impedance of the arm, is smooth over lines once that impedance is taken off. Where the impedance itself is sharp,
links that still swing from how the record began look alike.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy.stats

from ident.group import Group
from ident.noise import ROUNDED, noise_alone, white_covariance, white_levels

REACH, NEXT = 12, 2  # lines on either side that say what noise is near by, but for those next to a tone
LOUDEST = 10.0  # power of a line over that of noise near by, from which it is a tone
QUIETEST = 0.01  # least power of noise near by, over that of all lines
BY_CHANCE = 1e-9  # probability of such a line in noise anywhere
SPREAD = 2  # lines on either side, of a spectrum through a window, that a tone reaches
SHARP = 2.0  # size of the impedance over that two lines away, from which links swing there on their own


@dataclass(frozen=True)
class Tone:
    """A line that stands above the noise near by.

    Attributes:
        joint: where it is loudest; frequency_hz: of the line, to within one; beside a single steady period to within a
            few, as what a window shows.
        ratio: its power over that of the noise.
    """

    joint: int
    frequency_hz: float
    ratio: float


def find_tones(groups: Sequence[Group], impedances: Sequence[np.ndarray]) -> tuple[Tone, ...]:
    """The loudest tone of each joint that has any, loudest first; of records that show noise alone.

    Args:
        impedances: (L, n, n) recorded torque per motor position, by group.
    """
    loudest: dict[int, Tone] = {}
    for group, Z in zip(groups, impedances, strict=True):
        if not group.shows_noise:
            continue
        ratio, lines, dof = over_noise(group, Z)
        chance = ratio.size * scipy.stats.gamma.sf(dof * ratio, dof)
        for i, j in np.argwhere((ratio > LOUDEST) & (chance < BY_CHANCE) & ~_swinging_at(lines, Z, group)):
            tone = Tone(int(j), float(group.omega[lines[i]] / (2.0 * np.pi)), float(ratio[i, j]))
            if tone.joint not in loudest or tone.ratio > loudest[tone.joint].ratio:
                loudest[tone.joint] = tone
    return tuple(sorted(loudest.values(), key=lambda t: -t.ratio))


def swinging(Z: np.ndarray) -> np.ndarray:
    """(K, n) lines at and next to those where the torque of a joint has a sharp resonance of its own, the motors held.

    Args:
        Z: (K, n, n) torque per motor position.
    """
    size = np.log(np.maximum(np.linalg.norm(Z[1:], axis=-1), 1e-300))  # at rest it may be next to nothing
    padded = np.pad(size, ((2, 2), (0, 0)), mode="edge")
    sharp = np.pad(size - 0.5 * (padded[:-4] + padded[4:]) > np.log(SHARP), ((2, 1), (0, 0)))
    return sharp[:-2] | sharp[1:-1] | sharp[2:]


def _swinging_at(lines: np.ndarray, Z: np.ndarray, group: Group) -> np.ndarray:
    """``swinging`` (J, n) at some lines of a period, or at those that a window brings to them."""
    there = swinging(Z)
    reach = SPREAD * group.noise_spacing if group.U_periods.shape[1] == 1 else 0
    near = np.clip(lines[:, None] + np.arange(-reach, reach + 1), 0, len(Z) - 1)
    return np.any(there[near], axis=1)


def over_noise(group: Group, Z: np.ndarray) -> tuple[np.ndarray, np.ndarray, float]:
    """Power (J, n) of noise at each line that shows it alone over that near by, ones at the first; those lines, and its
    degrees of freedom."""
    noise = noise_alone(group, Z)
    assert noise is not None  # of such a group
    d, lines, dof = noise
    Z = Z[lines]
    own = dof if group.U_periods.shape[1] > 1 else float(len(d))  # of one line, which lines next to it are like
    power = np.sum(np.abs(d) ** 2, axis=0)
    torque, position = white_levels(power[1:], Z[1:], np.full(len(power) - 1, dof))
    # What rounding leaves of records without noise is none, and holds no tone.
    torque = torque + ROUNDED**2 * np.mean(np.sum(2.0 * np.abs(group.U) ** 2, axis=1), axis=0)
    root = np.linalg.cholesky(white_covariance(Z, torque, position))
    white = np.sum(np.abs(np.linalg.solve(root[None], d[..., None])[..., 0]) ** 2, axis=0)
    middle = scipy.stats.gamma.median(own) / own  # of the power of lines of noise, over its mean
    padded = np.pad(white[1:], ((REACH, REACH), (0, 0)), constant_values=np.nan)
    around = np.lib.stride_tricks.sliding_window_view(padded, 2 * REACH + 1, axis=0)
    near = np.delete(around, np.arange(REACH - NEXT, REACH + NEXT + 1), axis=-1)
    ratio = np.ones_like(white)
    told = np.any(np.isfinite(near), axis=-1)  # of a few lines the middle ones have none near by
    ratio[1:][told] = white[1:][told] * middle / np.maximum(np.nanmedian(near[told], axis=-1), QUIETEST)
    return ratio, lines, own
