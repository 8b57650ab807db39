"""Prediction-error identification: recordings, the likelihood of innovations, and the fit that all predictors share.

The predictors are in ``ident.kalman`` (local, criterion (3) of Wernholt and Moberg 2011) and ``ident.filters``
(nonlinear, criterion (2)). Both give innovations ``e`` with covariance ``S``; what is maximised is the likelihood
``-1/2 sum e^T S^-1 e + log det 2 pi S``, so that the standard deviations of the noise are found with the parameters.
Noise of the *record* of the torque counts as noise of the torque; it correlates with the input, which biases gains by
the share of its power in that of the torque. A controller may be at work, provided it knows no more of the arm than the
recorded positions: one that also reads a tachometer puts more into ``u`` than predictions allow for, a bias again.
``Parameters.timing`` is not modelled.
"""

from __future__ import annotations

from collections.abc import Callable, Collection
from dataclasses import dataclass

import numpy as np

from ident.chain import Structure
from ident.dataset import Dataset
from ident.frf_basis import choose_segments
from ident.graybox import Parameters, parameter_names
from ident.recorded_noise import noise_of
from robot_assets.errors import DataError

PROMISE = 1e-3  # fall of -2 log L that a step promises at which a fit is done: far below one standard deviation
LONGEST = 0.7  # step in a log-parameter
DIFFERENCE = 1e-5  # step of the differences that give derivatives of innovations
AT_REST = 6.0  # standard deviations of a first sample from rest
WIDE, WIDEST = 20.0, 0.05  # of a likelihood that jumps: standard deviations of a coordinate by itself, and at most


@dataclass(frozen=True)
class Runs:
    """Recordings cut alike.

    Attributes:
        u: (R, T, n) recorded motor torque, N m. y: (R, T, n) motor position, rad.
        point: (R,) index of the operating point of each. q0: (Q, n) rad, motors at rest there.
        skip: leading samples that the criterion leaves out: the predictor settles.
        sample_time: s.
        spread: (R, 2) standard deviations, rad and rad/s, of the state about rest where each begins. None from rest.
    """

    u: np.ndarray
    y: np.ndarray
    point: np.ndarray
    q0: np.ndarray
    skip: int
    sample_time: float
    spread: np.ndarray | None = None


@dataclass(frozen=True)
class Noise:
    """Standard deviations (n,): torque held over a sample, N m; position, rad."""

    process: np.ndarray
    measurement: np.ndarray


@dataclass(frozen=True)
class Prediction:
    """What a predictor says of runs, transient left out.

    Attributes:
        innovations: (R, T, n) rad. covariance: (R, 1 or T, n, n) of them.
        log_likelihood: of the runs; that of Gaussian innovations where the predictor has no better.
    """

    innovations: np.ndarray
    covariance: np.ndarray
    log_likelihood: float


Predictor = Callable[[Parameters, Noise], Prediction]


@dataclass(frozen=True)
class PredictionFit:
    """Result of ``fit_prediction``.

    Attributes:
        parameters, noise: at the maximum.
        names: of the fitted log-coordinates: parameters, then ``process.<joint>`` and ``measurement.<joint>``.
        covariance: (p, p) inverse Fisher information of those.
        log_likelihood: there. evaluations: runs of the predictor. converged: whether it stopped by itself.
    """

    parameters: Parameters
    noise: Noise
    names: tuple[str, ...]
    covariance: np.ndarray
    log_likelihood: float
    evaluations: int
    converged: bool


def runs_of(dataset: Dataset, *, role: str = "identification", amplitude: float | None = None) -> Runs:
    """The multisine segments of a role at one level, whole; the highest level where None.

    Where some begin in motion, as parts of one long recording do, a period at least is skipped: the local predictor
    begins at rest and needs it to settle.

    Raises:
        DataError: where there are none, their lengths differ, they do not tell where the arm stood, the torque
            is not held, or a single period begins in motion.
    """
    if dataset.input_hold != "zoh":
        raise DataError("input_hold", dataset.name, dataset.input_hold, '"zoh", which the sampled model takes')
    points, _ = choose_segments(dataset, role, amplitude)
    chosen = [s for members in points.values() for s in members]
    first = chosen[0]
    leading = [s.transient_periods * int(s.period or 0) for s in chosen]
    for s, skipped in zip(chosen, leading, strict=True):
        if s.tau.shape != first.tau.shape or skipped != leading[0]:
            raise DataError("samples", s.name, f"{s.n_samples}", f"{first.n_samples}, as in {first.name}")
        if s.q0 is None:
            raise DataError("q0", s.name, "none", "the posture at rest")
    y, q0 = np.stack([s.q for s in chosen]), np.stack([m[0].q0 for m in points.values() if m[0].q0 is not None])
    point = np.repeat(np.arange(len(points)), [len(m) for m in points.values()])
    skip = leading[0]
    noise = noise_of(dataset, "q")
    spread = spread_at_start(y - q0[point][:, None], noise, 1.0 / dataset.sample_rate)
    if spread is not None:
        skip = max(skip, int(first.period or 0))
        if skip >= y.shape[1]:
            raise DataError(
                "periods", dataset.name, "a single one that begins in motion", "one to settle and one to count"
            )
    return Runs(np.stack([s.tau for s in chosen]), y, point, q0, skip, 1.0 / dataset.sample_rate, spread)


def spread_at_start(y: np.ndarray, noise: np.ndarray, sample_time: float) -> np.ndarray | None:
    """(R, 2) spread in rad and rad/s of the states in which runs begin; None where all begin at rest.

    A run begins at rest where its first sample is that within the noise. The state of one that does not is somewhere
    in its own motion: motors and links are given the rms of the motor that moves most.

    Args:
        y: (R, T, n) motor positions from rest, rad. noise: (n,) standard deviations of these.
    """
    moving = np.any(np.abs(y[:, 0]) > AT_REST * noise, axis=1)
    if not moving.any():
        return None
    size = np.sqrt(np.mean(y**2, axis=1)).max(axis=1)
    speed = np.sqrt(np.mean(np.diff(y, axis=1) ** 2, axis=1)).max(axis=1) / sample_time
    return moving[:, None] * np.stack([size, speed], axis=1)


def gaussian(e: np.ndarray, S: np.ndarray) -> Prediction:
    """Prediction with the likelihood of Gaussian innovations (R, T, n) of covariance (R, 1 or T, n, n)."""
    w = (np.linalg.inv(np.linalg.cholesky(S)) @ e[..., None])[..., 0]
    logdet = np.linalg.slogdet(S)[1].sum() * (e.shape[1] / S.shape[1])
    return Prediction(e, S, -0.5 * float(np.sum(w**2) + logdet + e.size * np.log(2 * np.pi)))


def fit_prediction(
    predict: Predictor,
    structure: Structure,
    start: Parameters,
    noise: Noise,
    *,
    fitted: Collection[str] | None = None,
    guide: Predictor | None = None,
    steps: int = 40,
    promise: float = PROMISE,
) -> PredictionFit:
    """Maximise the likelihood of a predictor over log-parameters and log standard deviations of its noise.

    Scoring (Gupta and Mehra 1974) with Levenberg's damping: Fisher information and gradient from differences of
    innovations and of their covariance.

    Args:
        start, noise: where the search begins.
        fitted: names of ``parameter_names``; the others are held. All where None.
        guide: for a predictor whose likelihood jumps, one that is smooth and nearly the same: information is taken
            from it, and the gradient from differences of the likelihood over ``WIDE`` of its standard deviations.
        steps: at most. promise: fall of ``-2 log L`` that a step must promise, ``PROMISE`` unless chance is larger.

    Raises:
        DataError: for a parameter that there is not, or a predictor that fails at the start.
    """
    names = parameter_names(structure.robot)
    stray = sorted(set(fitted or ()) - set(names))
    if stray:
        raise DataError("fitted", "fit_prediction", stray[0], f"of {names}")
    free = np.array([fitted is None or name in fitted for name in names])
    p, n, whole = int(free.sum()), structure.n, start.to_log()
    x = np.concatenate([whole[free], np.log(noise.process), np.log(noise.measurement)])
    count = 0

    def at(x: np.ndarray) -> tuple[Parameters, Noise]:
        moved = whole.copy()
        moved[free] = x[:p]
        return start.with_log(moved), Noise(*np.exp(x[p:]).reshape(2, n))

    def look(x: np.ndarray, predict: Predictor = predict) -> Prediction | None:
        nonlocal count
        count += 1
        try:
            found = predict(*at(x))
        except (DataError, np.linalg.LinAlgError):
            return None
        return found if np.isfinite(found.log_likelihood) and np.all(np.isfinite(found.innovations)) else None

    def slopes(now: Prediction, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        if guide is None:
            return score(look, now, x)
        near = look(x, guide)
        if near is None:
            raise DataError("guide", "fit_prediction", "a predictor that fails", "one that runs where the other does")
        _, F = score(lambda x: look(x, guide), near, x)
        moves = np.diag(np.minimum(WIDE / np.sqrt(np.maximum(np.diag(F), 1e-300)), WIDEST))
        rises = []
        for move in moves:
            after, before = look(x + move), look(x - move)
            if after is None or before is None:
                raise DataError("predictor", "fit_prediction", "a failure beside the estimate", "one that runs there")
            rises.append(after.log_likelihood - before.log_likelihood)
        return np.array(rises) / (2 * np.diag(moves)), F

    now = look(x)
    if now is None:
        raise DataError("start", "fit_prediction", "a predictor that fails there", "parameters that it can run with")
    damping, converged = 1e-3, False
    g, F = slopes(now, x)
    for _ in range(steps):
        size = np.sqrt(np.maximum(np.diag(F), 1e-300))
        step = np.linalg.lstsq(F / np.outer(size, size) + damping * np.eye(len(x)), g / size, rcond=1e-14)[0] / size
        step = step / max(1.0, np.max(np.abs(step)) / LONGEST)
        promised = 2 * g @ step - step @ F @ step
        if promised < promise and damping < 1e-1:
            converged = True
            break
        trial = look(x + step)
        gain = -1.0 if trial is None else 2 * (trial.log_likelihood - now.log_likelihood) / promised
        if trial is not None and gain > 0:
            x, now = x + step, trial
            g, F = slopes(now, x)
            damping = max(damping * (0.2 if gain > 0.5 else 1.0), 1e-9)
        elif damping > 1e8:
            break
        else:
            damping *= 6.0
    labels = [name for name, use in zip(names, free, strict=True) if use]
    labels += [f"{kind}.{joint}" for kind in ("process", "measurement") for joint in structure.robot.joint_names]
    return PredictionFit(*at(x), tuple(labels), np.linalg.pinv(F, hermitian=True), now.log_likelihood, count, converged)


def score(
    look: Callable[[np.ndarray], Prediction | None], now: Prediction, x: np.ndarray, difference: float = DIFFERENCE
) -> tuple[np.ndarray, np.ndarray]:
    """Gradient of the Gaussian log-likelihood (p,) and Fisher information (p, p) at ``x``.

    Where the covariance of innovations changes along a run, its part of the information is taken from means.

    Raises:
        DataError: where the predictor fails beside ``x``.
    """
    e, S = now.innovations, now.covariance
    T, repeats = e.shape[1], e.shape[1] / S.shape[1]
    root = np.linalg.inv(np.linalg.cholesky(S))
    w = (root @ e[..., None])[..., 0]
    g, slopes, spreads = np.empty(len(x)), [], []
    for i in range(len(x)):
        moved = x.copy()
        moved[i] += difference
        beside = look(moved)
        if beside is None:
            raise DataError("predictor", "score", "a failure beside the estimate", "parameters that it can run with")
        dw = (root @ ((beside.innovations - e) / difference)[..., None])[..., 0]
        dS = root @ ((beside.covariance - S) / difference) @ np.swapaxes(root, -1, -2)
        bent = ((dS @ w[..., None])[..., 0] * w).sum()
        g[i] = -np.sum(w * dw) + 0.5 * bent - 0.5 * repeats * np.einsum("rtii->", dS)
        slopes.append(dw.ravel())
        spreads.append(np.sqrt(0.5 * T) * dS.mean(axis=1).ravel())
    J, D = np.stack(slopes), np.stack(spreads)
    return g, J @ J.T + D @ D.T
