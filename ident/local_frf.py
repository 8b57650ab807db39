"""FRFs from fewer experiments than inputs: local polynomial and local rational methods, in closed loop.

Around a line the responses of torque and acceleration ``z = [u; a]`` to the reference are smooth
functions of frequency, and so is the transient of each record. Over a window of excited lines with
offset ``x`` from its centre,

    d(x) z(x) = N(x) r(x) + t(x) + v(x)        N, t polynomials of x, d = 1 + d_1 x + ...

is fitted by least squares: ``d = 1`` is the local polynomial method (LPM; Pintelon and Schoukens
2012, ch. 7), a denominator common to all outputs the local rational method (LRM; McKelvey and
Guerin 2012; Voorhoeve et al. 2018), which follows a resonance that a polynomial cannot. One random
phase multisine that excites all inputs at all lines then does for n experiments, without waiting
for the steady state. Since the reference carries no noise, ``G = N_a(0) N_u(0)^-1`` is free of the
bias of the feedback (Zimmermann and Moberg 2023; theory.md 7.5 and 8.3).

The whole record is transformed, transient periods included: with several periods the lines between
those of the period show transient and noise alone.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ident.dataset import Dataset, Segment
from ident.frf_basis import FRF, choose_segments, common_lines, kron_by_line, sample_noise_power, steadied, unvec
from robot_assets.errors import DataError

METHODS = ("lpm", "lrm")
ORDER = 2  # of the polynomials
POLES = 2  # of the common denominator
SPARE = 6  # degrees of freedom of a window beyond the number of motors
REWEIGHT = 3  # rounds in which the error of the rational model is divided by its last denominator


@dataclass(frozen=True)
class Window:
    """Lines about one centre.

    Attributes:
        R: (E, B, n) reference, zero between excited lines. Z: (E, B, 2 n) torque, then acceleration.
        offset: (B,) distance from the centre, 1 at the farther end. excited: (B,) mask.
    """

    R: np.ndarray
    Z: np.ndarray
    offset: np.ndarray
    excited: np.ndarray


@dataclass(frozen=True)
class Local:
    """FRF at the centre of a window.

    Attributes:
        G: (n, n). gain: (n, n) ``K`` of the covariance ``K kron Phi`` of vec G.
        noise, total: (n, n) covariance of the output error ``a - G u`` between excited lines and on them.
        noise_dof, total_dof: their degrees of freedom.
    """

    G: np.ndarray
    gain: np.ndarray
    noise: np.ndarray
    total: np.ndarray
    noise_dof: float
    total_dof: float


def estimate_local(
    dataset: Dataset,
    *,
    method: str = "lrm",
    role: str = "identification",
    amplitude: float | None = None,
    order: int = ORDER,
    poles: int = POLES,
    half_width: int | None = None,
    stride: int | None = None,
) -> FRF:
    """FRFs of all operating points at one excitation level, from any number of experiments each.

    Args:
        method: of ``METHODS``.
        amplitude: level; of each point its highest where None.
        order: of the polynomials. poles: of the denominator (LRM).
        half_width: excited lines on either side of a centre; as few as leave ``SPARE`` degrees of
            freedom beyond n where None.
        stride: excited lines from one centre to the next; where None as many as share the window's
            lines out among its free values, so that neighbours count the same data about once.

    Raises:
        DataError: for a method or level that there is not, a segment without reference, inputs that
            are not excited independently, or a band with fewer lines than one window.
    """
    if method not in METHODS:
        raise DataError("method", "estimate_local", repr(method), f"one of {METHODS}")
    points, level = choose_segments(dataset, role, amplitude)
    chosen = [s for members in points.values() for s in members]
    for s in chosen:
        if s.r is None:
            raise DataError("r", s.name, "no reference", "r columns, which local methods need")
    if len({s.period for s in chosen}) > 1:
        raise DataError("period", dataset.name, "several", "one, which local methods need")
    period = chosen[0].period
    assert period is not None  # of a multisine
    n, lines = dataset.n, common_lines(points, dataset)[next(iter(points))]
    poles = poles if method == "lrm" else 0
    E = min(len(members) for members in points.values())
    P = min(int(s.periods or 0) for s in chosen)
    half = half_width if half_width is not None else _half_width(n, E, P, order, poles)
    width = 2 * half + 1
    if len(lines) < width:
        expected = f"{width}, those of a window of order {order} for {n} inputs and {E} experiments"
        raise DataError("excited lines", dataset.name, str(len(lines)), expected)
    step = stride or max(1, width // (order + 1))
    centres = np.arange(half % step, len(lines), step)
    results = [
        [_fit(_window(spectra, lines, c, half, P), order, poles, name) for c in centres.tolist()]
        for name, spectra in ((name, _spectra(members, P, lines)) for name, members in points.items())
    ]
    frequency = lines[centres] * dataset.sample_rate / period
    power = sample_noise_power(dataset, period * P, frequency)
    noise, total = (np.stack([_covariance(row, power, kind) for row in results]) for kind in ("noise", "total"))
    k = np.arange(n * n)
    std = [np.sqrt(np.stack([unvec(c[:, k, k].real, n) for c in C])) for C in (noise, total)]
    return FRF(
        G=np.stack([[local.G for local in row] for row in results]),
        covariance=total,
        noise_std=std[0],
        total_std=std[1],
        frequency=frequency,
        lines=lines[centres],
        operating_points=tuple(points),
        q0=np.stack([np.mean([s.periodic("q").mean(axis=(0, 1)) for s in m], axis=0) for m in points.values()]),
        amplitude=level,
        realizations=max(1, E // n),
        periods=P,
        estimator=method,
    )


def _half_width(n: int, E: int, P: int, order: int, poles: int) -> int:
    """Fewest lines on either side of a centre that leave ``n + SPARE`` degrees of freedom."""
    wanted = n * (order + 1) + poles + n + SPARE
    per_line = E
    if P == 1:
        wanted += E * (order + 1)
    return int(np.ceil((wanted / per_line - 1) / 2))


def _spectra(members: list[Segment], P: int, lines: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Reference (E, N/2 + 1, n) and torque with acceleration (E, N/2 + 1, 2 n) of whole records."""
    R, Z = [], []
    for s in members:
        assert s.period is not None and s.r is not None  # checked
        N = P * s.period
        w = 2 * np.pi * np.arange(N // 2 + 1) / (N * float(np.median(np.diff(s.t))))
        r, u, q = (np.fft.rfft(x[:N], axis=0, norm="forward") for x in (s.r, s.tau, s.q))
        excitation = np.zeros_like(r)
        excitation[lines * P] = r[lines * P]
        R.append(excitation)
        Z.append(np.concatenate([u, -(w**2)[:, None] * q], axis=1))
    return np.stack(R), np.stack(Z)


def _window(spectra: tuple[np.ndarray, np.ndarray], lines: np.ndarray, centre: int, half: int, P: int) -> Window:
    """Excited lines nearest to a centre in number, and what lies between those of the period."""
    R, Z = spectra
    start = int(np.clip(centre - half, 0, len(lines) - 2 * half - 1))
    on = lines[start : start + 2 * half + 1] * P
    bins = on
    if P > 1:
        between = np.arange(on[0], on[-1] + 1)
        bins = np.union1d(on, between[between % P != 0])
    offset = (bins - lines[centre] * P).astype(float)
    return Window(R[:, bins], Z[:, bins], offset / np.abs(offset).max(), np.isin(bins, on))


def _fit(window: Window, order: int, poles: int, point: str) -> Local:
    """Least squares over one window; the denominator by Sanathanan-Koerner iterations."""
    E, B, n = window.R.shape
    x = window.offset
    powers = x[:, None] ** np.arange(order + 1)
    size = np.sqrt(np.mean(np.abs(window.R[:, window.excited]) ** 2, axis=(0, 1)))
    if not np.all(size > 0):
        raise DataError(
            "r", f"operating point {point}", "an input without excitation", "all inputs excited in every window"
        )
    R = window.R / size
    # Columns: references times powers of the offset, the plain references first; a transient for each record.
    by_reference = (powers[None, :, :, None] * R[:, :, None, :]).reshape(E * B, -1)
    transient = np.einsum("ef,bs->ebfs", np.eye(E), powers).reshape(E * B, -1)
    K = np.concatenate([by_reference, transient], axis=1)
    Z = window.Z.reshape(E * B, -1)
    rows = np.tile(x, E)
    denominator = np.ones(E * B, complex)
    scale = np.sqrt(np.mean(np.abs(Z) ** 2, axis=0))
    for _ in range(1 + (REWEIGHT if poles else 0)):
        weight = 1.0 / denominator
        Q, upper = np.linalg.qr(K * weight[:, None])
        if poles:
            denominator = _denominator(Q, Z * weight[:, None] / scale, rows, poles)
        target = Z * (denominator * weight)[:, None]
        error = target - Q @ (Q.conj().T @ target)
        scale = np.maximum(np.sqrt(np.mean(np.abs(error) ** 2, axis=0)), 1e-12 * scale)
    if np.abs(np.diag(upper)).min() < 1e-9 * np.abs(np.diag(upper)).max():
        raise DataError(
            "r", f"operating point {point}", "inputs that are not excited independently", "random phases in all"
        )
    pick = np.linalg.inv(upper)[:n] @ Q.conj().T / size[:, None]
    N = (pick @ target).T
    G = N[n:] @ np.linalg.inv(N[:n])
    e = error[:, n:] - error[:, :n] @ G.T
    A = pick.T @ np.linalg.inv(N[:n])
    free = 1.0 - np.sum(np.abs(Q) ** 2, axis=1)
    on = np.tile(window.excited, E)
    total, total_dof = _scatter(e[on], free[on].sum() - poles)
    noise, noise_dof = total, total_dof
    if np.any(~on):
        # By a fit of the transient alone: distortion on the excited lines must not get into it.
        Q, _ = np.linalg.qr((transient * weight[:, None])[~on])
        off = target[~on, n:] - target[~on, :n] @ G.T
        noise, noise_dof = _scatter(off - Q @ (Q.conj().T @ off), len(Q) - Q.shape[1])
    return Local(G, A.T @ A.conj(), noise, total, noise_dof, total_dof)


def _denominator(Q: np.ndarray, Z: np.ndarray, offset: np.ndarray, poles: int) -> np.ndarray:
    """(rows,) common denominator that leaves least of ``d Z`` outside the span of ``Q``."""
    left = [Z * offset[:, None] ** s for s in range(poles + 1)]
    left = [(m - Q @ (Q.conj().T @ m)).ravel() for m in left]
    d, *_ = np.linalg.lstsq(np.stack(left[1:], axis=1), -left[0], rcond=None)
    return 1.0 + (offset[:, None] ** np.arange(1, poles + 1)) @ d


def _scatter(e: np.ndarray, dof: float) -> tuple[np.ndarray, float]:
    dof = max(float(dof), 1.0)
    return e.T @ e.conj() / dof, dof


def _covariance(row: list[Local], power: tuple[np.ndarray, np.ndarray], kind: str) -> np.ndarray:
    """(F, n n, n n) of vec G at all centres of a point, the error covariance steadied over them."""
    Phi = np.stack([getattr(local, kind) for local in row])
    G = np.stack([local.G for local in row])
    u, y = power
    expected = (np.abs(G) ** 2 @ u[:, :, None])[..., 0] + y
    dof = float(np.median([getattr(local, f"{kind}_dof") for local in row]))
    return kron_by_line(np.stack([local.gain for local in row]), steadied(Phi, dof, np.maximum(expected, 1e-300)))
