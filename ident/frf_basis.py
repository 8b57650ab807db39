"""What all estimators of FRFs share: their result, the segments and lines that it comes from, and covariances over
lines."""

from __future__ import annotations

from dataclasses import dataclass
from fractions import Fraction

import numpy as np
from scipy.special import digamma

from ident.dataset import Dataset, Segment
from ident.group import mean_over_lines
from ident.recorded_noise import given_noise, noise_of
from robot_assets.errors import DataError

SMOOTH = 3  # lines on either side over which a covariance of few degrees of freedom is smoothed
ENOUGH = 8  # degrees of freedom from which a variance is taken as it is


@dataclass(frozen=True)
class FRF:
    """FRFs at Q operating points and F excited lines.

    Attributes:
        G: (Q, F, n, n) (rad/s2)/(N m).
        covariance: (Q, F, n n, n n) of vec G, columns stacked; of the estimate, not of one period.
        noise_std: (Q, F, n, n) standard deviation by measurement noise alone.
        total_std: (Q, F, n, n) with stochastic nonlinear distortion where realizations show it.
        frequency: (F,) Hz. lines: (F,), of the period of the first point.
        operating_points: names. q0: (Q, n) rad, mean motor position.
        amplitude: relative level, the highest of all points. realizations, periods: averaged; the fewest of all points.
        estimator: of ``ESTIMATORS`` or ``LOCAL``.
        not_used: segments of these levels in sets of fewer than n experiments, beside sets that are complete.
    """

    G: np.ndarray
    covariance: np.ndarray
    noise_std: np.ndarray
    total_std: np.ndarray
    frequency: np.ndarray
    lines: np.ndarray
    operating_points: tuple[str, ...]
    q0: np.ndarray
    amplitude: float
    realizations: int
    periods: int
    estimator: str
    not_used: tuple[str, ...] = ()


def frf_levels(dataset: Dataset, *, role: str = "identification") -> tuple[float, ...]:
    """Excitation levels of the multisine segments of a role, highest first."""
    return tuple(sorted({float(s.amplitude) for s in _periodic(dataset, role)}, reverse=True))


def choose_segments(
    dataset: Dataset, role: str, amplitude: float | None = None
) -> tuple[dict[str, list[Segment]], float]:
    """Multisine segments of a role at one level, by operating point, and that level.

    Where None, of each point those at its highest, and the highest of all.

    Raises:
        DataError: where there are none.
    """
    segments = _periodic(dataset, role)
    unsaid = [s.name for s in dataset.select(role=role, kind="multisine") if not len(s.excited_lines)]
    if not segments and unsaid:
        raise DataError(
            "excited_lines", f"{dataset.name}, segment {unsaid[0]}", "none", "the lines of the period that are excited"
        )
    if not segments:
        raise DataError("multisine segments", dataset.name, f"none of role {role}", "at least n per operating point")
    points: dict[str, list[Segment]] = {}
    for s in segments:
        points.setdefault(str(s.operating_point), []).append(s)
    highest = {name: max(s.amplitude for s in members) for name, members in points.items()}
    level = max(highest.values()) if amplitude is None else amplitude
    wanted = highest if amplitude is None else dict.fromkeys(points, amplitude)
    at_level = {name: [s for s in members if np.isclose(s.amplitude, wanted[name])] for name, members in points.items()}
    points = {name: members for name, members in at_level.items() if members}
    if not points:
        raise DataError("amplitude", dataset.name, f"{level:g}", f"one of {frf_levels(dataset, role=role)}")
    return points, float(level)


def _periodic(dataset: Dataset, role: str) -> list[Segment]:
    return [s for s in dataset.select(role=role, kind="multisine") if len(s.excited_lines)]


def sample_noise_power(dataset: Dataset, period: int, frequency: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Power (F, n) that white sample noise leaves in a line of torque and of acceleration."""
    known = {channel: given_noise(dataset, channel) for channel in ("q", "tau")}
    q, tau = (noise_of(dataset, channel) if given is None else given for channel, given in known.items())
    one = np.ones((len(frequency), 1))
    return one * tau**2 / period, (2 * np.pi * frequency[:, None]) ** 4 * q**2 / period


def common_lines(points: dict[str, list[Segment]], dataset: Dataset) -> dict[str, np.ndarray]:
    """Excited lines (F,) int, sorted, of each operating point, at the frequencies that all segments share.

    Raises:
        DataError: where periods of one point differ or no frequency is shared.
    """
    shared = None
    periods: dict[str, int] = {}
    for name, members in points.items():
        first = members[0]
        assert first.period is not None  # of a multisine
        periods[name] = first.period
        lines = np.asarray(first.excited_lines, int)
        for s in members:
            if s.period != first.period:
                raise DataError("period", s.name, str(s.period), f"{first.period} as in {first.name}")
            lines = np.intersect1d(lines, s.excited_lines)
        frequencies = {Fraction(int(k), first.period) for k in lines}
        shared = frequencies if shared is None else shared & frequencies
    if not shared:
        found, wanted = "no frequency that all segments share", "a common grid (`identify --estimator ml` needs none)"
        raise DataError("excited_lines", dataset.name, found, wanted)
    return {name: np.array([int(f * period) for f in sorted(shared)]) for name, period in periods.items()}


def kron_by_line(K: np.ndarray, Phi: np.ndarray) -> np.ndarray:
    """Kronecker product line by line; (F, n n, n n)."""
    F, n, _ = K.shape
    return np.einsum("fjl,fik->fjilk", K, Phi).reshape(F, n * n, n * n)


def steadied(Phi: np.ndarray, dof: float, shape: np.ndarray) -> np.ndarray:
    """(F, n, n) sample covariances of few degrees of freedom, steadied over neighbouring lines.

    Variances: mean of the logarithms of their ratio to ``shape`` (F, n) over just enough lines,
    freed of its bias ``digamma(dof) - ln dof``. Correlations: mean over ``SMOOTH`` lines on either side; where even
    that is short of rank they are drawn towards zero.
    """
    n = Phi.shape[1]
    k = np.arange(n)
    variance = np.maximum(Phi[:, k, k].real, 1e-300)
    root = np.sqrt(variance)
    half = min(SMOOTH, int(np.ceil((ENOUGH / dof - 1) / 2)))
    if half > 0:
        variance = shape * np.exp(mean_over_lines(np.log(variance / shape), half) - digamma(dof) + np.log(dof))
    correlation = Phi / (root[:, :, None] * root[:, None, :])
    if dof < ENOUGH * n:
        correlation = mean_over_lines(correlation, SMOOTH) * min(1.0, dof * (2 * SMOOTH + 1) / (ENOUGH * n))
        correlation[:, k, k] = 1.0
    scale = np.sqrt(variance)
    return scale[:, :, None] * correlation * scale[:, None, :]


def unvec(x: np.ndarray, n: int) -> np.ndarray:
    """(F, n n) of stacked columns to (F, n, n)."""
    return np.swapaxes(x.reshape(-1, n, n), -1, -2)
