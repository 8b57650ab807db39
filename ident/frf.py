"""Nonparametric FRFs with covariance, in closed loop, at every operating point.

``G``: motor torque to motor acceleration, ``(j w)^2`` times the spectrum of the motor position.
For realization m the spectra of the n_u experiments form ``U, Y, R`` (n, n_u) at each line, and

    H1    [sum Y U^H] [sum U U^H]^-1            JIO  [sum Y R^H] [sum U R^H]^-1
    ARI   mean of Y U^-1                        HAR  inverse of the mean of U Y^-1
    LOG   geometric mean of the entries of Y U^-1 (Guillaume 1998), phases taken relative to ARI

(Wernholt and Moberg 2008, report R-2827; theory.md 3.3).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ident.dataset import Dataset, Segment
from robot_assets.errors import DataError

ESTIMATORS = ("auto", "h1", "jio", "ari", "har", "log")
SMOOTH = 3  # lines on either side over which a covariance of too few realizations is smoothed


@dataclass(frozen=True)
class FRF:
    """FRFs at Q operating points and F excited lines.

    Attributes:
        G: (Q, F, n, n) (rad/s2)/(N m).
        covariance: (Q, F, n n, n n) of vec G, columns stacked; of the estimate, not of one period.
        noise_std: (Q, F, n, n) standard deviation by measurement noise alone.
        total_std: (Q, F, n, n) with stochastic nonlinear distortion where realizations show it.
        frequency: (F,) Hz. lines: (F,).
        operating_points: names. q0: (Q, n) rad, mean motor position.
        amplitude: relative level. realizations, periods: averaged.
        estimator: of ``ESTIMATORS``.
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


@dataclass(frozen=True)
class Blocks:
    """Spectra of one operating point: (M, P, F, n, n_u) of torque, acceleration; R (M, F, n, n_u)."""

    U: np.ndarray
    Y: np.ndarray
    R: np.ndarray | None


def estimate_frf(
    dataset: Dataset, *, estimator: str = "auto", role: str = "identification", amplitude: float | None = None
) -> FRF:
    """Estimate the FRFs of all operating points at one excitation level.

    Args:
        estimator: one of ``ESTIMATORS``; "auto" is JIO where a reference was recorded, else ARI.
        amplitude: level; the highest where None.

    Raises:
        DataError: where no point has n independent experiments at that level.
    """
    if estimator not in ESTIMATORS:
        raise DataError("estimator", "estimate_frf", repr(estimator), f"one of {ESTIMATORS}")
    segments = [s for s in dataset.select(role=role, kind="multisine") if len(s.excited_lines)]
    if not segments:
        raise DataError("multisine segments", dataset.name, f"none of role {role}", "at least n per operating point")
    level = max(s.amplitude for s in segments) if amplitude is None else amplitude
    chosen = [s for s in segments if np.isclose(s.amplitude, level)]
    points: dict[str, list[Segment]] = {}
    for s in chosen:
        points.setdefault(str(s.operating_point), []).append(s)
    lines = _common_lines(chosen, dataset)
    frequency = lines * dataset.sample_rate / chosen[0].period
    out = []
    for name, members in points.items():
        blocks = _blocks(members, lines, frequency, dataset.n, name)
        if estimator == "jio" and blocks.R is None:
            raise DataError("r", name, "no reference", "r columns, which JIO needs")
        kind = estimator if estimator != "auto" else ("ari" if blocks.R is None else "jio")
        out.append((name, blocks, kind, np.mean([s.periodic("q").mean(axis=(0, 1)) for s in members], axis=0)))
    results = [average(b, kind) for _, b, kind, _ in out]
    spreads = [_covariance(b, G) for (_, b, _, _), G in zip(out, results, strict=True)]
    n = dataset.n
    diag = [tuple(_unvec(np.einsum("fii->fi", c).real, n) for c in pair) for pair in spreads]
    return FRF(
        G=np.stack(results),
        covariance=np.stack([total for _, total in spreads]),
        noise_std=np.sqrt(np.stack([d[0] for d in diag])),
        total_std=np.sqrt(np.stack([d[1] for d in diag])),
        frequency=frequency,
        lines=lines,
        operating_points=tuple(name for name, *_ in out),
        q0=np.stack([q for *_, q in out]),
        amplitude=float(level),
        realizations=out[0][1].U.shape[0],
        periods=out[0][1].U.shape[1],
        estimator=out[0][2],
    )


def average(blocks: Blocks, estimator: str) -> np.ndarray:
    """One of the five averages over realizations; (F, n, n)."""
    U, Y = blocks.U.mean(axis=1), blocks.Y.mean(axis=1)
    if estimator in ("h1", "jio"):
        right = np.conj(np.swapaxes(U if estimator == "h1" else blocks.R, -1, -2))
        return np.matmul((Y @ right).sum(axis=0), np.linalg.inv((U @ right).sum(axis=0)))
    each = Y @ np.linalg.inv(U)
    if estimator == "ari":
        return each.mean(axis=0)
    if estimator == "har":
        return np.linalg.inv(np.linalg.inv(each).mean(axis=0))
    mean = each.mean(axis=0)
    phase = mean / np.maximum(np.abs(mean), 1e-300)
    ratio = np.where(each == 0, 1e-300, each) / phase
    return np.exp(np.log(ratio).mean(axis=0)) * phase


def _common_lines(segments: list[Segment], dataset: Dataset) -> np.ndarray:
    first = segments[0]
    lines = np.asarray(first.excited_lines, int)
    for s in segments:
        if s.period != first.period:
            raise DataError("period", s.name, str(s.period), f"{first.period} as in {first.name}")
        lines = np.intersect1d(lines, s.excited_lines)
    if not len(lines):
        raise DataError("excited_lines", dataset.name, "no line that all segments share", "a common grid")
    return lines


def _blocks(members: list[Segment], lines: np.ndarray, frequency: np.ndarray, n: int, name: str) -> Blocks:
    by_realization: dict[int, dict[int, Segment]] = {}
    for i, s in enumerate(members):
        by_realization.setdefault(s.realization or 1, {}).setdefault(s.experiment or i + 1, s)
    complete = [r for r in by_realization.values() if len(r) >= n]
    if not complete:
        most = max(len(r) for r in by_realization.values())
        raise DataError("experiments", f"operating point {name}", f"{most}", f"{n}, one per input")
    periods = min(s.steady_periods for r in complete for s in r.values())
    acceleration = -((2 * np.pi * frequency) ** 2)

    def spectra(s: Segment, channel: str) -> np.ndarray:
        return np.fft.rfft(s.periodic(channel)[:periods], axis=1, norm="forward")[:, lines]

    U, Y, R = [], [], []
    with_r = all(s.r is not None for r in complete for s in r.values())
    for r in complete:
        chosen = [r[k] for k in sorted(r)][:n]
        U.append(np.stack([spectra(s, "tau") for s in chosen], axis=-1))
        Y.append(np.stack([spectra(s, "q") for s in chosen], axis=-1) * acceleration[:, None, None])
        if with_r:
            R.append(np.stack([spectra(s, "r").mean(axis=0) for s in chosen], axis=-1))
    reference = np.stack(R) if with_r else None
    if reference is not None and np.any(np.linalg.cond(reference) > 1e8):
        reference = None
    return Blocks(np.stack(U), np.stack(Y), reference)


def _covariance(blocks: Blocks, G: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Noise and total covariance of vec G, each (F, n n, n n).

    Noise: scatter of ``(Y_p - G U_p) U^-1`` between periods. Total: scatter of ``Y U^-1`` between
    realizations, never below the noise; with a single realization they are the same. Sample
    covariances of low rank are smoothed over neighbouring lines (theory.md 3.4).
    """
    M, P, F, n, _ = blocks.U.shape
    U_inv = np.linalg.inv(blocks.U.mean(axis=1))
    E = (blocks.Y - G @ blocks.U) @ U_inv[:, None]
    vec = np.swapaxes(E, -1, -2).reshape(M, P, F, n * n)
    if P > 1:
        d = vec - vec.mean(axis=1, keepdims=True)
        noise = np.einsum("mpfi,mpfj->fij", d, d.conj(), optimize=True) / (M * M * P * (P - 1))
        noise = _smooth(noise, M * (P - 1), n * n)
    else:
        noise = np.zeros((F, n * n, n * n), complex)
    if M < 2:
        return noise, noise
    d = vec.mean(axis=1)
    d = d - d.mean(axis=0)
    total = np.einsum("mfi,mfj->fij", d, d.conj(), optimize=True) / (M * (M - 1))
    total = _smooth(total, M - 1, n * n)
    low = np.einsum("fii->fi", total).real < np.einsum("fii->fi", noise).real
    k = np.arange(n * n)
    total[:, k, k] = np.where(low, np.einsum("fii->fi", noise), total[:, k, k])
    return noise, total


def _smooth(C: np.ndarray, dof: int, size: int) -> np.ndarray:
    """Mean over neighbouring lines; what rank is still missing is made up on the diagonal."""
    if dof >= 2 * size:
        return C
    kernel = np.ones(2 * SMOOTH + 1)
    count = np.convolve(np.ones(len(C)), kernel, mode="same")
    flat = C.reshape(len(C), -1)
    out = np.stack([np.convolve(c, kernel, mode="same") for c in flat.T], axis=1) / count[:, None]
    out = out.reshape(C.shape)
    share = min(1.0, dof * (2 * SMOOTH + 1) / (4.0 * size))
    k = np.arange(size)
    mixed = share * out
    mixed[:, k, k] = out[:, k, k]
    return mixed


def _unvec(x: np.ndarray, n: int) -> np.ndarray:
    """(F, n n) of stacked columns to (F, n, n)."""
    return np.swapaxes(x.reshape(-1, n, n), -1, -2)
