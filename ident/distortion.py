"""Noise, and even and odd nonlinear distortion, at lines that are not excited.

In closed loop the feedback carries distortion to both channels; on the torque side,
``D(k) = U(k) - Z(k) Y(k)`` with ``Z = G^-1`` interpolated between excited lines, what the linear
plant passes on is taken out (theory.md 8.2).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ident.dataset import Dataset
from ident.frf_basis import FRF


@dataclass(frozen=True)
class Distortion:
    """Rms torque per line, N m, by operating point, level and joint; each (Q, A, n).

    Attributes:
        operating_points, levels: of the axes.
        excited: torque at excited lines. noise: standard deviation of the mean over periods.
        even, odd: at even and odd lines that are not excited, noise taken out.
    """

    operating_points: tuple[str, ...]
    levels: tuple[float, ...]
    excited: np.ndarray
    noise: np.ndarray
    even: np.ndarray
    odd: np.ndarray


def estimate_distortion(dataset: Dataset, frf: FRF) -> Distortion:
    """Distortion levels of every operating point and level of a dataset."""
    segments = [s for s in dataset.select(role="identification", kind="multisine") if len(s.excited_lines)]
    levels = tuple(sorted({s.amplitude for s in segments}, reverse=True))
    out = np.full((4, len(frf.operating_points), len(levels), dataset.n), np.nan)
    for i, point in enumerate(frf.operating_points):
        for a, level in enumerate(levels):
            chosen = [s for s in segments if s.operating_point == point and s.amplitude == level]
            if chosen:
                out[:, i, a] = np.sqrt(np.mean([_levels(s, frf, i, dataset.sample_rate) for s in chosen], axis=0))
    return Distortion(frf.operating_points, levels, *out)


def _levels(segment, frf: FRF, point: int, sample_rate: float) -> np.ndarray:
    """Mean squares (4, n): excited torque, noise, even, odd."""
    spacing = sample_rate / segment.period
    first, last = (round(f / spacing, 6) for f in (frf.frequency[0], frf.frequency[-1]))
    lines = np.arange(int(np.ceil(first)), int(last) + 1)
    f = lines * spacing
    U = np.fft.rfft(segment.periodic("tau"), axis=1, norm="forward")[:, lines]
    Q = np.fft.rfft(segment.periodic("q"), axis=1, norm="forward")[:, lines]
    w = 2 * np.pi * f
    Z = np.linalg.inv(frf.G[point])
    flat = Z.reshape(len(frf.lines), -1)
    Zi = np.stack(
        [np.interp(f, frf.frequency, c.real) + 1j * np.interp(f, frf.frequency, c.imag) for c in flat.T], axis=1
    ).reshape(len(lines), *Z.shape[1:])
    D = U - np.einsum("lij,plj->pli", Zi, Q * -(w**2)[:, None])
    P = len(D)
    mean = D.mean(axis=0)
    noise = np.sum(np.abs(D - mean) ** 2, axis=0) / (P * (P - 1)) if P > 1 else np.zeros_like(mean, float)
    excited = np.isin(lines, segment.excited_lines)
    at_excited = np.abs(U.mean(axis=0)[excited]) ** 2
    rows = [at_excited.mean(axis=0) if excited.any() else np.full(noise.shape[1], np.nan), noise.mean(axis=0)]
    for parity in (0, 1):
        mask = ~excited & (lines % 2 == parity)
        power = np.mean(np.abs(mean[mask]) ** 2 - noise[mask], axis=0) if mask.any() else np.zeros(mean.shape[1])
        rows.append(np.maximum(power, 0.0))
    return np.stack(rows)
