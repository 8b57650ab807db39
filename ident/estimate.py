"""Gray-box parameters from FRFs: NLS, WNLS, LLS and WLLS over all operating points at once.

``V(theta) = sum e^H W e`` with ``e = vec(G - G_theta)`` (NLS, WNLS) or ``e = log(vec G / vec
G_theta)`` (LLS, WLLS), ``W`` the identity or the inverse covariance (Wernholt and Moberg 2011;
theory.md 4). The logarithm is taken of the ratio, so that no phase has to be unwrapped.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy.optimize

from ident.frf import FRF
from ident.graybox import Parameters, Structure, equilibrium, linearise, parameter_names, sampled_frf
from robot_assets.errors import DataError

ESTIMATORS = ("nls", "wnls", "lls", "wlls")
LOG_SNR = 3.0  # entries below this ratio of size to deviation are left out of log criteria
UNDETERMINED = 0.2  # relative standard deviation
UNSEEN = 1e4
ROUNDS = 3  # linearisations anew at the equilibrium of the last estimate
NULL = 1e-12  # share of the scaled information below which a direction counts as unseen


@dataclass(frozen=True)
class Estimate:
    """Result of an FRF fit.

    Attributes:
        parameters: at the minimum. names: of the log-coordinates, timing last.
        covariance: (p, p) sandwich covariance of the log-coordinates (timing in s), for the
            weighted criteria scaled by the misfit where that exceeds one. A direction that the
            data do not see has variance ``UNSEEN``.
        cost: of the criterion. residuals: count of complex residuals, masked ones left out.
        undetermined: names whose relative deviation exceeds ``UNDETERMINED``.
    """

    parameters: Parameters
    names: tuple[str, ...]
    covariance: np.ndarray
    cost: float
    residuals: int
    undetermined: tuple[str, ...]
    estimator: str

    @property
    def correlation(self) -> np.ndarray:
        """(p, p) correlations."""
        d = np.sqrt(np.maximum(np.diag(self.covariance), 1e-300))
        return self.covariance / np.outer(d, d)


def fit_frf(
    structure: Structure,
    frf: FRF,
    nominal: Parameters,
    *,
    sample_time: float,
    hold: str,
    estimator: str = "wlls",
    starts: Sequence[Parameters] | None = None,
    seed: int = 0,
) -> Estimate:
    """Fit log-parameters to the FRFs of all operating points.

    A search by LLS from every start comes first, then the wanted criterion from the best of them.

    Args:
        nominal: starting guesses, and centre of the starts drawn where none are given.
        sample_time: s. hold: of the recorded torque, "zoh" or "none".
        seed: of the drawn starts.

    Raises:
        DataError: for an estimator that there is not, an arm of another number of motors, or a
            weighted criterion and FRFs without covariance.
    """
    if estimator not in ESTIMATORS:
        raise DataError("estimator", "fit_frf", repr(estimator), f"one of {ESTIMATORS}")
    if frf.G.shape[-1] != structure.n:
        raise DataError("FRF", "fit_frf", f"{frf.G.shape[-1]} motors", f"{structure.n}, those of the arm")
    if estimator in ("wnls", "wlls") and not np.all(np.einsum("qfii->qfi", frf.covariance).real > 0):
        raise DataError("covariance", "fit_frf", "an entry without variance", "a positive one for each")
    starts = tuple(starts) if starts else _starts(nominal, seed)
    found = [_minimise(structure, frf, p, sample_time, hold, "lls", 40) for p in starts]
    best = min(found, key=lambda f: f[1])[0]
    for _ in range(ROUNDS):
        best, cost = _minimise(structure, frf, best, sample_time, hold, estimator, 60)
    J, C = _whole(structure, frf, best, sample_time, hold, estimator)
    H = np.einsum("kip,kij,kjq->pq", J.conj(), C["W"], J, optimize=True).real
    WLW = C["W"] @ C["Lambda"] @ C["W"]
    B = 0.5 * np.einsum("kip,kij,kjq->pq", J.conj(), WLW, J, optimize=True).real
    covariance = _sandwich(H, B)
    count = int(C["mask"].sum())
    if estimator in ("wnls", "wlls"):
        covariance *= max(1.0, cost / max(count - len(H) / 2, 1.0))
    names = (*parameter_names(structure.robot), "timing")
    std = np.sqrt(np.maximum(np.diag(covariance), 0.0))[:-1]
    loose = tuple(n for n, s in zip(names[:-1], std, strict=True) if not s < UNDETERMINED)
    return Estimate(best, names, covariance, cost, count, loose, estimator)


def _sandwich(H: np.ndarray, B: np.ndarray) -> np.ndarray:
    """``H^-1 B H^-1``, with variance ``UNSEEN`` along directions that the information lacks.

    A pseudo-inverse would give those directions the variance zero, the very reverse of the truth.
    """
    d = np.sqrt(np.diag(H))
    d = np.where(d > 0, d, 1.0)
    value, vector = np.linalg.eigh(H / np.outer(d, d))
    seen = value > NULL * max(value[-1], 1e-300)
    inverse = (vector[:, seen] / value[seen]) @ vector[:, seen].T / np.outer(d, d)
    lost = vector[:, ~seen] / d[:, None]
    lost = lost / np.linalg.norm(lost, axis=0)
    return inverse @ B @ inverse + UNSEEN * lost @ lost.T


def _starts(nominal: Parameters, seed: int) -> tuple[Parameters, ...]:
    x = nominal.to_log()
    rng = np.random.default_rng(seed)
    return (nominal, *(nominal.with_log(x + rng.uniform(-0.7, 0.7, len(x))) for _ in range(2)))


def _weights(frf: FRF, estimator: str) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Weight, covariance of the residual, and mask: (Q F, n n, n n) twice and (Q F, n n)."""
    Q, F, n, _ = frf.G.shape
    g = np.swapaxes(frf.G, -1, -2).reshape(Q * F, n * n)
    Lambda = frf.covariance.reshape(Q * F, n * n, n * n)
    k = np.arange(n * n)
    std = np.sqrt(Lambda[:, k, k].real)
    mask = np.ones(g.shape, bool)
    if estimator in ("lls", "wlls"):
        mask = np.abs(g) > LOG_SNR * std
        scale = 1.0 / np.where(mask, g, 1.0)
        Lambda = scale[:, :, None] * Lambda * scale.conj()[:, None, :]
    Lambda = Lambda * (mask[:, :, None] & mask[:, None, :])
    if estimator in ("nls", "lls"):
        W = np.zeros_like(Lambda)
        W[:, k, k] = mask
        return W, Lambda, mask
    full = Lambda.copy()
    full[:, k, k] += ~mask + 1e-9 * np.einsum("kii->k", Lambda).real[:, None] / (n * n)
    W = np.linalg.inv(full) * (mask[:, :, None] & mask[:, None, :])
    return W, Lambda, mask


def _whole(
    structure: Structure, frf: FRF, par: Parameters, sample_time: float, hold: str, estimator: str
) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """Derivative of the residual (Q F, n n, p), and weight, covariance and mask."""
    W, Lambda, mask = _weights(frf, estimator)
    lins = [linearise(structure, equilibrium(structure, par, q)) for q in frf.q0]
    _, J = _residual(structure, frf, par, lins, sample_time, hold, estimator, mask)
    return J, {"W": W, "Lambda": Lambda, "mask": mask}


def _residual(structure, frf, par, lins, sample_time, hold, estimator, mask) -> tuple[np.ndarray, np.ndarray]:
    n = structure.n
    rs, Js = [], []
    for G, lin in zip(frf.G, lins, strict=True):
        model, dG = sampled_frf(structure, par, lin, frf.frequency, sample_time, hold, derivatives=True)
        flat = lambda X: np.swapaxes(X, 1, 2).reshape(len(X), n * n, *X.shape[3:])  # noqa: E731
        g, m, d = flat(G), flat(model), flat(dG)
        if estimator in ("lls", "wlls"):
            safe = np.where(np.abs(m) > 1e-300, m, 1e-300)
            rs.append(np.log(np.where(g == 0, 1.0, g) / safe))
            Js.append(-d / safe[..., None])
        else:
            rs.append(g - m)
            Js.append(-d)
    r, J = np.concatenate(rs), np.concatenate(Js)
    return np.where(mask, r, 0.0), np.where(mask[..., None], J, 0.0)


def _minimise(
    structure: Structure, frf: FRF, start: Parameters, sample_time: float, hold: str, estimator: str, steps: int
) -> tuple[Parameters, float]:
    W, _, mask = _weights(frf, estimator)
    root = np.swapaxes(np.linalg.cholesky(W + 1e-300 * np.eye(W.shape[1])), -1, -2).conj() if estimator in ("wnls", "wlls") else W
    lins = [linearise(structure, equilibrium(structure, start, q)) for q in frf.q0]
    x0 = np.append(start.to_log(), start.timing / sample_time)

    def at(x: np.ndarray) -> Parameters:
        par = start.with_log(x[:-1])
        return type(par)(**{**par.__dict__, "timing": float(x[-1] * sample_time)})

    def evaluate(x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        r, J = _residual(structure, frf, at(x), lins, sample_time, hold, estimator, mask)
        J[..., -1] *= sample_time
        r, J = (root @ r[..., None])[..., 0].ravel(), (root @ J).reshape(-1, J.shape[-1])
        return np.concatenate([r.real, r.imag]), np.concatenate([J.real, J.imag])

    cache: dict[bytes, tuple[np.ndarray, np.ndarray]] = {}

    def both(x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        key = x.tobytes()
        if key not in cache:
            cache.clear()
            cache[key] = evaluate(x)
        return cache[key]

    bounds = (np.append(x0[:-1] - 6, -0.6), np.append(x0[:-1] + 6, 0.6))
    result = scipy.optimize.least_squares(
        lambda x: both(x)[0], np.clip(x0, *bounds), jac=lambda x: both(x)[1], bounds=bounds, x_scale="jac", max_nfev=steps, xtol=1e-10, ftol=1e-10
    )
    return at(result.x), float(2 * result.cost)
