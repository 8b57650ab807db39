"""Nonparametric FRFs with covariance, in closed loop, at every operating point.

``G``: motor torque to motor acceleration, ``(j w)^2`` times the spectrum of the motor position.
For realization m the spectra of the n_u experiments form ``U, Y, R`` (n, n_u) at each line, and

    H1    [sum Y U^H] [sum U U^H]^-1            JIO  [sum Y R^H] [sum U R^H]^-1
    ARI   mean of Y U^-1                        HAR  inverse of the mean of U Y^-1
    LOG   geometric mean of the entries of Y U^-1 (Guillaume 1998), phases taken relative to ARI

(Wernholt and Moberg 2008, report R-2827; theory.md 3.3).
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ident.dataset import Dataset, Segment
from ident.format_checks import checked
from ident.frf_basis import (
    FRF,
    SMOOTH,
    choose_segments,
    common_lines,
    kron_by_line,
    sample_noise_power,
    steadied,
    unvec,
)
from ident.group import mean_over_lines
from ident.local_frf import estimate_local
from ident.recorded_noise import given_noise
from robot_assets.errors import DataError

ESTIMATORS = ("auto", "h1", "jio", "ari", "har", "log")
LOCAL = ("lpm", "lrm")  # of ``ident.local_frf``
NEAREST = 2 * SMOOTH + 1  # lines that nothing excites, over which the scatter of a single period is averaged


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
        estimator: one of ``ESTIMATORS``; "auto" is JIO where a reference was recorded, else ARI. Or one
            of ``LOCAL``, for fewer experiments than inputs.
        amplitude: level; of each point its highest where None.

    Raises:
        DataError: where the dataset breaks the format, nothing was recorded at that level, a point has fewer than n
            experiments or experiments that do not excite every input, or JIO has no reference.
    """
    if estimator not in ESTIMATORS + LOCAL:
        raise DataError("estimator", "estimate_frf", repr(estimator), f"one of {ESTIMATORS + LOCAL}")
    dataset = checked(dataset)
    if estimator in LOCAL:
        return estimate_local(dataset, method=estimator, role=role, amplitude=amplitude)
    points, level = choose_segments(dataset, role, amplitude)
    lines = common_lines(points, dataset)
    periods = [int(members[0].period or 0) for members in points.values()]
    first = lines[next(iter(points))]
    frequency, n = first * dataset.sample_rate / periods[0], dataset.n
    blocks = [_blocks(members, lines[name], frequency, n, name) for name, members in points.items()]
    without = [name for name, b in zip(points, blocks, strict=True) if b.R is None]
    if estimator == "jio" and without:
        raise DataError("r", f"operating point {without[0]}", "no reference of full rank", "r columns, which JIO needs")
    kind = estimator if estimator != "auto" else ("ari" if without else "jio")
    results = [average(b, kind) for b in blocks]
    powers = [sample_noise_power(dataset, period, frequency) for period in periods]
    unsaid = any(given_noise(dataset, channel) is None for channel in ("q", "tau"))
    scatters = [
        _unexcited_scatter(members, lines[name], G, dataset) if unsaid and b.U.shape[:2] == (1, 1) else None
        for (name, members), b, G in zip(points.items(), blocks, results, strict=True)
    ]
    spreads = [
        _covariance(b, G, kind, power, scatter)
        for b, G, power, scatter in zip(blocks, results, powers, scatters, strict=True)
    ]
    diag = [tuple(unvec(np.einsum("fii->fi", c).real, n) for c in pair) for pair in spreads]
    return FRF(
        G=np.stack(results),
        covariance=np.stack([total for _, total in spreads]),
        noise_std=np.sqrt(np.stack([d[0] for d in diag])),
        total_std=np.sqrt(np.stack([d[1] for d in diag])),
        frequency=frequency,
        lines=first,
        operating_points=tuple(points),
        q0=np.stack([np.mean([s.periodic("q").mean(axis=(0, 1)) for s in m], axis=0) for m in points.values()]),
        amplitude=level,
        realizations=min(b.U.shape[0] for b in blocks),
        periods=min(b.U.shape[1] for b in blocks),
        estimator=kind,
        not_used=tuple(
            s.name for members in points.values() for x in experiment_sets(members, n) if len(x) < n for s in x.values()
        ),
    )


def average(blocks: Blocks, estimator: str) -> np.ndarray:
    """One of the five averages over realizations; (F, n, n)."""
    U, Y = blocks.U.mean(axis=1), blocks.Y.mean(axis=1)
    if estimator in ("h1", "jio"):
        against = U if estimator == "h1" else blocks.R
        assert against is not None  # JIO is refused without a reference
        right = np.conj(np.swapaxes(against, -1, -2))
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


def _blocks(members: list[Segment], lines: np.ndarray, frequency: np.ndarray, n: int, name: str) -> Blocks:
    sets = experiment_sets(members, n)
    complete = [r for r in sets if len(r) == n]
    if not complete:
        most = max(len(r) for r in sets)
        raise DataError("experiments", f"operating point {name}", f"{most}", f"{n}, one per input")
    periods = min(s.steady_periods for r in complete for s in r.values())
    acceleration = -((2 * np.pi * frequency) ** 2)

    def spectra(s: Segment, channel: str) -> np.ndarray:
        return np.fft.rfft(s.periodic(channel)[:periods], axis=1, norm="forward")[:, lines]

    U, Y, R = [], [], []
    with_r = all(s.r is not None for r in complete for s in r.values())
    for r in complete:
        chosen = [r[k] for k in sorted(r)]
        U.append(np.stack([spectra(s, "tau") for s in chosen], axis=-1))
        Y.append(np.stack([spectra(s, "q") for s in chosen], axis=-1) * acceleration[:, None, None])
        if with_r:
            R.append(np.stack([spectra(s, "r").mean(axis=0) for s in chosen], axis=-1))
    if np.any(np.linalg.cond(np.mean(U, axis=1)) > 1e8):
        raise DataError(
            "tau", f"operating point {name}", "experiments that are not independent", f"{n} independent ones"
        )
    reference = np.stack(R) if with_r else None
    if reference is not None and np.any(np.linalg.cond(reference) > 1e8):
        reference = None
    return Blocks(np.stack(U), np.stack(Y), reference)


def experiment_sets(members: Sequence[Segment], n: int) -> list[dict[int, Segment]]:
    """Segments of one operating point in sets of up to ``n`` experiments, by their number, 1 to ``n``.

    Those of a realization make a set; what is repeated there, and experiments beyond ``n``, make further ones. Segments
    that do not say which experiment they are follow one another.
    """
    sets: dict[tuple[int, int, int], dict[int, Segment]] = {}
    unnumbered, times = Counter[int](), Counter[tuple[int, int]]()
    for s in members:
        realization = s.realization or 1
        if s.experiment:
            experiment = int(s.experiment) - 1
        else:
            experiment = unnumbered[realization]
            unnumbered[realization] += 1
        k = times[realization, experiment]
        times[realization, experiment] += 1
        sets.setdefault((realization, experiment // n, k), {})[experiment % n + 1] = s
    return list(sets.values())


def _unexcited_scatter(
    members: Sequence[Segment], lines: np.ndarray, G: np.ndarray, dataset: Dataset
) -> np.ndarray | None:
    """Covariance (F, n, n) of ``E = Y - G U`` in a line of one period, by those that nothing excites about each of
    ``lines``: noise, and distortion with it. None where there are too few of them.

    G is interpolated between excited lines, and over a window the scatter follows the noise of the samples.
    """
    excited = np.unique(np.concatenate([s.excited_lines for s in members]))
    free = np.setdiff1d(np.arange(lines[0], lines[-1] + 1), excited)
    if len(free) < NEAREST:
        return None
    period = members[0].period
    assert period is not None  # of a multisine
    spacing = dataset.sample_rate / period
    flat = G.reshape(len(lines), -1).T
    between = np.stack([np.interp(free, lines, c.real) + 1j * np.interp(free, lines, c.imag) for c in flat], axis=1)
    between = between.reshape(len(free), *G.shape[1:])
    errors = []
    for s in members:
        U, Q = (np.fft.rfft(s.periodic(c), axis=1, norm="forward")[:, free] for c in ("tau", "q"))
        errors.append(-((2 * np.pi * spacing * free[:, None]) ** 2) * Q - np.einsum("lij,plj->pli", between, U))
    E = np.concatenate(errors)
    shapes = [
        np.sqrt(np.einsum("fii->fi", _sample_noise(H, *sample_noise_power(dataset, period, spacing * k))).real)
        for H, k in ((between, free), (G, lines))
    ]
    E = E / np.maximum(shapes[0], 1e-300)
    each = np.einsum("sli,slk->lik", E, E.conj()) / len(E)
    first = np.clip(np.searchsorted(free, lines) - NEAREST // 2, 0, len(free) - NEAREST)
    relative = each[first[:, None] + np.arange(NEAREST)].mean(axis=1)
    return shapes[1][:, :, None] * relative * shapes[1][:, None, :]


def _sample_noise(G: np.ndarray, torque: np.ndarray, acceleration: np.ndarray) -> np.ndarray:
    """Covariance (F, n, n) of ``E = Y - G U`` by powers (F, n) of noise of the samples of U and Y."""
    return (G * torque[:, None, :]) @ np.conj(np.swapaxes(G, -1, -2)) + acceleration[:, :, None] * np.eye(G.shape[1])


def _covariance(
    blocks: Blocks,
    G: np.ndarray,
    estimator: str = "ari",
    sample_power: tuple[np.ndarray, np.ndarray] | None = None,
    scatter: np.ndarray | None = None,
) -> tuple[np.ndarray, np.ndarray]:
    """Noise and total covariance of vec G, each (F, n n, n n).

    To first order ``G_hat - G = sum_m E_m A_m`` with the output error ``E = Y - G U`` and ``A_m`` of
    ``_gains``. The experiments share one covariance ``Phi`` (n, n) of a column of ``E``, hence
    ``Cov vec G_hat = (sum_m A_m^T conj(A_m)) kron Phi``: far fewer unknowns than the scatter of
    vec G itself has, which two periods could not give (theory.md 3.4, 8.1).

    Noise: ``Phi`` from the scatter of ``E`` between periods, M n (P - 1) degrees of freedom. Total:
    from what is left of ``E`` in all realizations, (M - 1) n, never below the noise; one
    realization cannot show nonlinear distortion, there they are the same.

    Args:
        sample_power: (F, n) power of torque and acceleration noise in a line of one period: the
            covariance where there is neither a second period nor a second realization, else the
            shape over frequency about which it is smoothed.
        scatter: (F, n, n) covariance of ``E`` in a line of one period, in place of that of the samples' noise.
    """
    M, P, F, n, _ = blocks.U.shape
    expected, shape = None, np.ones((F, n))
    if sample_power is not None:
        expected = _sample_noise(G, *sample_power)
        shape = np.maximum(np.einsum("fii->fi", expected).real, 1e-300)
    A = _gains(blocks, estimator)
    K = np.einsum("mfej,mfel->fjl", A, A.conj(), optimize=True)
    E = blocks.Y - G @ blocks.U
    noise = None
    if P > 1:
        d = E - E.mean(axis=1, keepdims=True)
        dof = M * n * (P - 1)
        noise = steadied(np.einsum("mpfie,mpfke->fik", d, d.conj(), optimize=True) / (P * dof), dof, shape)
    elif M < 2:
        noise = expected if scatter is None else scatter
    total = noise
    if M > 1:
        e = E.mean(axis=1)
        total = steadied(np.einsum("mfie,mfke->fik", e, e.conj(), optimize=True) / ((M - 1) * n), (M - 1) * n, shape)
        if noise is not None:
            # Distortion is smooth over frequency: its part is steadied before it is held at zero or more.
            k = np.arange(n)
            floor, found = noise[:, k, k].real, total[:, k, k].real
            excess = shape * mean_over_lines((found - floor) / shape, 2 * SMOOTH)
            # Correlations are kept: a variance lowered alone would leave no covariance matrix.
            root = np.sqrt((floor + np.maximum(excess, 0.0)) / found)
            total = root[:, :, None] * total * root[:, None, :]
    if total is None:
        total = np.zeros((F, n, n), complex)
    noise = total if noise is None else noise
    return kron_by_line(K, noise), kron_by_line(K, total)


def _gains(blocks: Blocks, estimator: str) -> np.ndarray:
    """``A_m`` of the error ``sum_m E_m A_m`` of an average; (M, F, n_u, n)."""
    U = blocks.U.mean(axis=1)
    if estimator in ("h1", "jio"):
        against = U if estimator == "h1" else blocks.R
        assert against is not None  # JIO is refused without a reference
        right = np.conj(np.swapaxes(against, -1, -2))
        return right @ np.linalg.inv((U @ right).sum(axis=0))
    return np.linalg.inv(U) / len(U)
