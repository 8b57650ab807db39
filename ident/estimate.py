"""Gray-box parameters from FRFs: NLS, WNLS, LLS and WLLS over all operating points at once.

``V(theta) = sum e^H W e`` with ``e = vec(G - G_theta)`` (NLS, WNLS) or ``e = log(vec G / vec
G_theta)`` (LLS, WLLS), ``W`` the identity or the inverse covariance (Wernholt and Moberg 2011;
theory.md 4). The logarithm is taken of the ratio, so that no phase has to be unwrapped. WLLS takes its weights from
the measured entries in the search and from the fitted ones at the end.

Deviations are those of noise, and of distortion as far as it differs between realizations. Two errors of a real
record are neither, and hardly show in the misfit, being spread over many lines, but grow beside the noise with the
length of the record: what the changing geometry adds at whatever phases (of second order in the excitation; for the
ur10 at level 1 with two periods of 1 s 0.7 to 1.3 standard deviations, a quarter of it at half the level), and
transients after too short a lead (0.3 there with one period of 1 s, none with three). A second level shows the former;
the torque residual and the extended Kalman filter hold the geometry.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace

import numpy as np
import scipy.linalg

from ident.chain import Structure
from ident.frf_basis import FRF
from ident.graybox import Linearisation, Parameters, equilibrium, linearise, parameter_names, sampled_frf
from ident.parallel import one_thread_each
from robot_assets.errors import DataError

ESTIMATORS = ("nls", "wnls", "lls", "wlls")
LOG_SNR = 3.0  # entries below this ratio of size to deviation are left out of log criteria
SEARCH_SNR = 10.0  # the same in the search, where weak entries drive weak springs out of reach; half of all stay in
UNDETERMINED = 0.2  # relative standard deviation
UNSEEN = 1e4
ROUNDS = 3  # linearisations anew at the equilibrium of the last estimate
SETTLED = 1e-7  # change of the log-parameters by which a new equilibrium no longer matters
SEARCH, FINAL = 1e-3, 1e-8  # predicted relative fall of the cost at which a search, and the fit, stop
STEP, SMALL = 1.0, 0.1  # longest step in a log-parameter, and what may be taken without another look
REACH = 6.0  # bound on the change of a log-parameter in one minimisation
PORTION = 32  # lines evaluated at a time
TIMING = 0.6  # bound on the timing, samples
ROUNDED = 1e-9  # standard deviation of an entry over its size, at least: what rounding leaves of records without noise
NULL = 1e-12  # share of the scaled information below which a direction counts as unseen


@dataclass(frozen=True)
class Estimate:
    """Result of an FRF fit.

    Attributes:
        parameters: at the minimum. names: of the fitted log-coordinates, timing last.
        covariance: (p, p) sandwich covariance of those coordinates (timing in s), for the
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


@one_thread_each
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
    fitted: Collection[str] | None = None,
    search: bool = True,
) -> Estimate:
    """Fit log-parameters to the FRFs of all operating points.

    A search by LLS from every start comes first, then the wanted criterion from the best of the ends by it.

    Args:
        nominal: starting guesses, and centre of the starts drawn where none are given.
        sample_time: s. hold: of the recorded torque, "zoh" or "none".
        seed: of the drawn starts.
        fitted: names of ``parameter_names`` or "timing"; the others are held at the starts. All where None.
        search: whether that search is made; else the wanted criterion is minimised from the best start by it.

    Raises:
        DataError: for an estimator or parameter that there is not, an arm of another number of motors, or
            a weighted criterion and FRFs without covariance.
    """
    if estimator not in ESTIMATORS:
        raise DataError("estimator", "fit_frf", repr(estimator), f"one of {ESTIMATORS}")
    if frf.G.shape[-1] != structure.n:
        raise DataError("FRF", "fit_frf", f"{frf.G.shape[-1]} motors", f"{structure.n}, those of the arm")
    if estimator in ("wnls", "wlls") and not np.all(np.einsum("qfii->qfi", frf.covariance).real > 0):
        raise DataError("covariance", "fit_frf", "an entry without variance", "a positive one for each")
    k = np.arange(frf.covariance.shape[-1])
    covariance = frf.covariance.copy()
    covariance[..., k, k] += (ROUNDED * np.abs(frf.G).swapaxes(-1, -2).reshape(*frf.G.shape[:2], -1)) ** 2
    frf = replace(frf, covariance=covariance)
    names = (*parameter_names(structure.robot), "timing")
    stray = sorted(set(fitted or ()) - set(names))
    if stray:
        raise DataError("fitted", "fit_frf", stray[0], f"of {names}")
    free = np.array([fitted is None or name in fitted for name in names])
    ends = list(starts or _starts(nominal, seed))
    if search:
        first = _Criterion.of(structure, frf, sample_time, hold, "lls", SEARCH_SNR)
        ends = [_minimise(first, p, free, SEARCH).parameters for p in ends]
    criterion = _Criterion.of(structure, frf, sample_time, hold, estimator)
    # LLS hardly sees weak springs: an end that it likes may be far off by the wanted criterion.
    best = min(ends, key=lambda p: criterion.normal(p, criterion.linearised(p), free)[0]) if len(ends) > 1 else ends[0]
    for turn in range(ROUNDS):
        provisional = estimator == "wlls" and turn == 0
        last, result = best.to_log(), _minimise(criterion, best, free, SEARCH if provisional else FINAL)
        best = result.parameters
        if provisional:
            criterion = criterion.reweighted(best)
        elif np.max(np.abs(best.to_log() - last)) < SETTLED:
            break
    # From the timing in samples, in which it was fitted, to seconds.
    unit = np.append(np.ones(len(free) - 1), sample_time)[free]
    H = result.H / np.outer(unit, unit)
    B = 0.5 * H
    if estimator in ("nls", "lls"):
        B = 0.5 * criterion.scatter(best)[np.ix_(free, free)] / np.outer(unit, unit)
    covariance = _sandwich(H, B)
    count = int(criterion.mask.sum())
    if estimator in ("wnls", "wlls"):
        covariance *= max(1.0, result.cost / max(count - len(H) / 2, 1.0))
    names = tuple(name for name, use in zip(names, free, strict=True) if use)
    std = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    loose = tuple(n for n, s in zip(names, std, strict=True) if n != "timing" and not s < UNDETERMINED)
    return Estimate(best, names, covariance, result.cost, count, loose, estimator)


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


@dataclass(frozen=True)
class _Criterion:
    """What is minimised, over all K = Q F lines of all operating points.

    Attributes:
        g: (K, n n) measured, columns stacked. mask: (K, n n) entries that count.
        root: (K, n n, n n) with ``root^H root`` the weight, or None where that is the mask.
        Lambda: (K, n n, n n) covariance of the residual.
    """

    structure: Structure
    frf: FRF
    sample_time: float
    hold: str
    logarithmic: bool
    g: np.ndarray
    mask: np.ndarray
    root: np.ndarray | None
    Lambda: np.ndarray

    @classmethod
    def of(
        cls, structure: Structure, frf: FRF, sample_time: float, hold: str, estimator: str, snr: float = LOG_SNR
    ) -> _Criterion:
        """The criterion of one of ``ESTIMATORS``; log criteria without the entries below ``snr``."""
        Q, F, n, _ = frf.G.shape
        g = np.swapaxes(frf.G, -1, -2).reshape(Q * F, n * n)
        Lambda = frf.covariance.reshape(Q * F, n * n, n * n)
        k = np.arange(n * n)
        std = np.sqrt(Lambda[:, k, k].real)
        mask = np.ones(g.shape, bool)
        if estimator in ("lls", "wlls"):
            size = np.abs(g)
            median = np.median(size / np.maximum(std, 1e-300))
            mask = size > max(LOG_SNR, min(snr, median)) * std
            Lambda = _relative(Lambda, g, mask)
        root = _root(Lambda, mask) if estimator in ("wnls", "wlls") else None
        return cls(structure, frf, sample_time, hold, estimator in ("lls", "wlls"), g, mask, root, Lambda)

    def reweighted(self, par: Parameters) -> _Criterion:
        """A weighted log criterion with the entries of the model in its weights and its mask.

        With ``g = m (1 + e)`` the expected gradient of ``|g|^2 |log(g / m)|^2`` is not zero but ``E |e|^2`` that of
        ``log |m|``: weights that share the noise of the entries pull these up, and so does a mask that keeps those
        which the noise has raised. ``E log(1 + e)`` alone is zero, for ``e`` is circular and the logarithm analytic.
        An entry further from the model than noise takes it keeps its own weight: there the model is not the truth.
        """
        lin, frequency = self.linearised(par), np.tile(self.frf.frequency, len(self.frf.q0))
        model, _ = sampled_frf(self.structure, par, lin, frequency, self.sample_time, self.hold)
        m = np.swapaxes(model, 1, 2).reshape(self.g.shape)
        covariance = self.frf.covariance.reshape(self.Lambda.shape)
        std = np.sqrt(np.einsum("kii->ki", covariance).real)
        size = np.where(np.abs(self.g - m) < LOG_SNR * std, m, self.g)
        mask = (np.abs(size) > LOG_SNR * std) & (self.g != 0)
        Lambda = _relative(covariance, size, mask)
        # With the same entries in it a line's root only needs its columns scaled.
        root = self.root * np.where(mask, size / np.where(self.mask, self.g, 1.0), 1.0)[:, None, :]
        other = np.any(mask != self.mask, axis=1)
        root[other] = _root(Lambda[other], mask[other])
        return replace(self, mask=mask, root=root, Lambda=Lambda)

    def linearised(self, par: Parameters) -> Linearisation:
        """Matrices at the equilibrium of every operating point, one for each line of each."""
        lins = [linearise(self.structure, equilibrium(self.structure, par, q)) for q in self.frf.q0]
        M, Kg = (
            np.repeat([getattr(lin, name) for lin in lins], len(self.frf.frequency), axis=0) for name in ("M", "Kg")
        )
        return Linearisation(np.empty(0), M, Kg, np.empty(0))

    def residual(self, par: Parameters, lin: Linearisation, part: slice) -> tuple[np.ndarray, np.ndarray]:
        """Residual (k, n n) and derivative (k, n n, p) of some lines, unweighted, masked entries zero.

        The last derivative is by the timing in samples.
        """
        g, mask = self.g[part], self.mask[part]
        frequency = np.tile(self.frf.frequency, len(self.frf.q0))[part]
        lin = Linearisation(lin.q, lin.M[part], lin.Kg[part], lin.g)
        model, dG = sampled_frf(self.structure, par, lin, frequency, self.sample_time, self.hold, derivatives=True)
        assert dG is not None  # as asked for
        m = np.swapaxes(model, 1, 2).reshape(g.shape)
        J = np.swapaxes(dG, 1, 2).reshape(*g.shape, -1)
        J[..., -1] *= self.sample_time
        if self.logarithmic:
            safe = np.where(np.abs(m) > 1e-300, m, 1e-300)
            r = np.log(np.where(mask, g, safe) / safe)
            J *= np.where(mask, -1.0 / safe, 0.0)[..., None]
            return r, J
        return g - m, np.negative(J, out=J)

    @property
    def parts(self) -> list[slice]:
        """The lines in portions that stay in the cache."""
        return [slice(k, k + PORTION) for k in range(0, len(self.g), PORTION)]

    def normal(self, par: Parameters, lin: Linearisation, fitted: np.ndarray) -> tuple[float, np.ndarray, np.ndarray]:
        """Cost, half its gradient and the Gauss-Newton matrix for the fitted of all coordinates."""
        p = int(fitted.sum())
        cost, g, H = 0.0, np.zeros(p), np.zeros((p, p))
        for part in self.parts:
            r, J = self.residual(par, lin, part)
            J = J if fitted.all() else np.ascontiguousarray(J[..., fitted])
            if self.root is not None:
                r, J = (self.root[part] @ r[..., None])[..., 0], self.root[part] @ J
            r, J = r.ravel(), J.reshape(-1, J.shape[-1])
            cost, g = cost + np.vdot(r, r).real, g + (r.conj() @ J).real
            H = H + scipy.linalg.blas.zherk(1.0, J.T).real
        return float(cost), g, np.triu(H) + np.triu(H, 1).T

    def scatter(self, par: Parameters) -> np.ndarray:
        """``Re J^H Lambda J``, the spread of the gradient of an unweighted criterion; (p, p)."""
        lin, spreads = self.linearised(par), []
        for part in self.parts:
            _, J = self.residual(par, lin, part)
            spreads.append(np.tensordot(J.conj(), self.Lambda[part] @ J, ((0, 1), (0, 1))).real)
        return sum(spreads, np.zeros_like(spreads[0]))


def _relative(Lambda: np.ndarray, size: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """Covariance (K, m, m) of the logarithms of entries of ``size`` (K, m), zero where masked out."""
    scale = np.where(mask, 1.0 / np.where(mask, size, 1.0), 0.0)
    return scale[:, :, None] * Lambda * scale.conj()[:, None, :]


def _root(Lambda: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """Root (K, m, m) of the inverse of covariances; entries masked out stand alone in it."""
    k = np.arange(Lambda.shape[1])
    full = Lambda.copy()
    full[:, k, k] += ~mask + 1e-9 * np.einsum("kii->k", Lambda).real[:, None] / len(k)
    # Lambda = C C^H, hence the root of its inverse.
    return np.linalg.inv(np.linalg.cholesky(full))


@dataclass(frozen=True)
class _Minimum:
    parameters: Parameters
    cost: float
    H: np.ndarray


def _minimise(
    criterion: _Criterion, start: Parameters, fitted: np.ndarray, tolerance: float, steps: int = 60
) -> _Minimum:
    """Levenberg-Marquardt on the normal equations over the fitted coordinates (p,), equilibria those of the start.

    Damping by the diagonal, raised and lowered by Nielsen's rule (Madsen, Nielsen and Tingleff 2004,
    algorithm 3.16). A small step that promises less than ``tolerance`` of the cost is taken and is the last.
    """
    lin = criterion.linearised(start)
    whole = np.append(start.to_log(), np.clip(start.timing / criterion.sample_time, -TIMING, TIMING))
    x = whole[fitted]
    low, high = (np.append(whole[:-1] + sign * REACH, sign * TIMING)[fitted] for sign in (-1, 1))

    def at(x: np.ndarray) -> Parameters:
        moved = whole.copy()
        moved[fitted] = x
        return replace(start.with_log(moved[:-1]), timing=float(moved[-1] * criterion.sample_time))

    cost, g, H = criterion.normal(at(x), lin, fitted)
    damping, growth = 1e-3, 2.0
    for _ in range(steps):
        # A coordinate at its bound stays there while the cost would fall beyond it.
        free = ~(((x <= low) & (g > 0)) | ((x >= high) & (g < 0)))
        size = np.sqrt(np.where(np.diag(H) > 0, np.diag(H), 1.0))
        A = (H / np.outer(size, size) + damping * np.eye(len(x)))[np.ix_(free, free)]
        step = np.zeros_like(x)
        step[free] = -np.linalg.solve(A, g[free] / size[free]) / size[free]
        step = np.clip(x + step / max(1.0, np.max(np.abs(step)) / STEP), low, high) - x
        promised = -(2 * g @ step + step @ H @ step)
        if promised <= tolerance * cost and damping < 1e-2 and np.max(np.abs(step)) < SMALL:
            return _Minimum(at(x + step), max(cost - max(promised, 0.0), 0.0), H)
        trial = criterion.normal(at(x + step), lin, fitted)
        gain = (cost - trial[0]) / promised if promised > 0 else -1.0
        if gain > 0:
            x, (cost, g, H) = x + step, trial
            damping, growth = max(damping * max(1 / 30, 1 - (2 * gain - 1) ** 3), 1e-9), 2.0
        elif np.max(np.abs(step)) < 1e-12:
            break
        else:
            damping, growth = damping * growth, 2 * growth
    return _Minimum(at(x), cost, H)
