"""Maximum-likelihood fit of the gray-box, with effects, to the torque residual.

Levenberg-Marquardt on ``sum e^H Lambda^-1 e`` with ``e = U - U_model(theta; q)`` over all compared
lines of all segments. A relative error added to the noise (``rho``) and taken away in steps makes
the first steps act as a logarithmic criterion does: from starting guesses off by a factor of two
the plain weighted criterion would stop in wrong minima.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from ident.columns import Columns, Products
from ident.errors_in_variables import (
    impedance_slopes,
    information_left,
    scatter_costs,
    scatter_information,
    scatter_slope,
    trusted_share,
)
from ident.extended import (
    Effect,
    Model,
    Prediction,
    beside,
    has_loop,
    is_along_record,
    joints_along_record,
    predict,
    predict_at,
    through_drives,
)
from ident.graybox import Parameters, Structure, parameter_names
from ident.inverse import REMAINDER_STEPS, Motion, Sampling, Torques, baseline_products
from ident.law_noise import law_noise, loop_noise, record_noise
from ident.noise import residual_covariance, white_covariance
from ident.parallel import map_threads
from ident.posture import moved_by_posture
from ident.records import Group
from ident.stiction import as_free, as_held, held, held_share

NOT_COMPUTED = (np.linalg.LinAlgError, ArithmeticError, ValueError, RuntimeError)  # a model that has no solution
PRIOR_LOG_STD = 1.5  # of a baseline parameter about its starting guess, natural logarithm
PRIOR_TIMING = 0.25  # of the common timing offset, samples
TIMING_STEP = 1e-6  # s, for differences
BASELINE_STEP = 1e-3  # of logarithms, for differences
TIMING_LIMIT = 0.6  # samples
HELD, HOLD = 0.1, 0.04  # error added to the noise from which drives are held, and how strongly
ANNEALING = (0.5, 0.1, 0.02, 0.0)
LOG_RANGE = 7.0  # of a baseline parameter about its starting guess: a factor of a thousand
STALE = 1e-3  # change of logarithmic coordinates after which the geometric remainder is made anew
LINK_ERROR = 0.01  # of the wind-up that link encoders show, up to which what a model leaves is an error of its law
GAP = 1e-6  # relative fall of the cost that ends a fit
LEAST_NOISE = 0.5  # of the noise of a linear arm, that is left in any direction of the residual
LEAST_INFORMATION = 1e-12  # on a coordinate: less counts as this
RIDGE = 1e-12  # relative, of a covariance
LEAK = 0.03  # of the largest share of that noise, that is in any direction too
LOST = 1.2  # rise of the cost, with a geometric remainder made anew, that takes steps back
SHORTER = 64.0  # factor on the damping of steps then
SLIGHT = 2.0  # fall of the cost that tells nothing
SHIFTS = "spring", "link", "position"  # channels of effects that move the arm to another posture
FORETOLD = 0.1  # error, relative, of the fall of the cost that columns foretell, up to which they serve the next step too


@dataclass(frozen=True)
class Problem:
    """Data and weights of a fit.

    Attributes:
        groups: records.
        sampling: how they were sampled.
        nominal: starting guesses, centre of the weak prior.
        tau_std, q_std: (n,) sample noise where single periods give no scatter.
        free_timing: whether a common timing offset is fitted.
        step_std: (n,) rounding error of position in steps, rad; it repeats with the motion and does
            not average out over periods.
        scatter_share: of what the scatter between periods says that noise adds to costs, that is taken off where these are
            compared; that which the baseline has borne, none before it is known.
    """

    structure: Structure
    groups: tuple[Group, ...]
    sampling: Sampling
    nominal: Parameters
    tau_std: np.ndarray
    q_std: np.ndarray
    free_timing: bool = True
    step_std: np.ndarray | float = 0.0
    scatter_share: float = 0.0

    @property
    def motions_alone(self) -> bool:
        return all(group.window is not None for group in self.groups)

    def samples(self, group: Group) -> int:
        return round(group.period_time / self.sampling.sample_time)


@dataclass(frozen=True)
class Weights:
    """(K, n + M, n + M) whitening per group: real and imaginary parts of residuals have unit variance under noise.

    ``by_noise``: (n,) what noise adds to the cost of the model that they were made with, by joint (``noise_of``); None
    where the scatter between periods says nothing of it.
    """

    whiten: tuple[np.ndarray, ...]
    covariance: tuple[np.ndarray, ...]
    by_noise: np.ndarray | None = None

    def apply(self, g: int, X: np.ndarray) -> np.ndarray:
        """Whiten outputs (S, K, n + M) or (S, K, n + M, p), complex as given."""
        if X.ndim == 4:
            return np.matmul(self.whiten[g], X)
        return np.matmul(self.whiten[g], X[..., None])[..., 0]


@dataclass(frozen=True)
class Fit:
    """Result of a fit.

    Attributes:
        model: chain, parameters and effects at the minimum.
        costs: (n,) whitened sum of squares by joint, prior excluded; of noise as much as the model of the weights has
            (``fair_costs``).
        counts: (n,) real data that entered.
        information: (p, p) of the data on the fitted coordinates, prior excluded; their normal matrix where the noise of the
            position counts for nothing.
        names: of the fitted coordinates.
        remainders: geometric remainder per group, for warm starts.
        weights: under which it was made.
        converged: whether the step criterion was met.
        softer: fits with more error added to the noise that led to this one, if they are known.
        share: of what noise adds to the cost, that was taken off on the way.
    """

    model: Model
    costs: np.ndarray
    counts: np.ndarray
    information: np.ndarray
    names: tuple[str, ...]
    remainders: tuple[np.ndarray, ...]
    weights: Weights
    converged: bool
    softer: tuple[Fit, ...] = ()
    share: float = 0.0

    @property
    def cost(self) -> float:
        return float(np.sum(self.costs))

    @property
    def count(self) -> int:
        return int(np.sum(self.counts))

    @property
    def chi2_per_dof(self) -> float:
        return self.cost / max(self.count - len(self.names), 1)

    def covariance(self) -> np.ndarray:
        """(p, p) of the fitted coordinates, scaled by the misfit where that exceeds one.

        With what is known before the data: a parameter that they do not feel keeps that spread.
        """
        m = len(self.model.par.to_log())
        known = [
            q.expected_spread(v) ** -2 if q.log or q.bounded else 0.0
            for effect in self.model.effects
            for q, v in zip(effect.hypothesis.parameters, effect.p, strict=True)
        ]
        prior = np.concatenate([np.full(m, PRIOR_LOG_STD**-2), [0.0], known])
        return inverse(self.information / max(1.0, self.chi2_per_dof) + np.diag(prior), RIDGE)


def inverse(H: np.ndarray, ridge: float) -> np.ndarray:
    """Inverse of an information matrix, each coordinate in its own scale, steadied by a relative ``ridge``."""
    size = np.sqrt(np.maximum(np.diag(H), LEAST_INFORMATION))
    return np.linalg.inv(H / np.outer(size, size) + ridge * np.eye(len(H))) / np.outer(size, size)


def noise_covariance(
    problem: Problem, group: Group, prediction: Prediction, of_laws: np.ndarray | None = None
) -> np.ndarray:
    """Covariance of the compared lines of the torque residual by noise alone; (K, n, n) N2 m2.

    Args:
        of_laws: of ``_of_laws``, where it is known already.
    """
    S = residual_covariance(
        group,
        prediction.sampled_impedance,
        tau_std=problem.tau_std,
        q_std=problem.q_std,
        samples=problem.samples(group),
    )
    of_record = record_noise(prediction, group)
    if of_record is None:
        S = S + (_of_laws(prediction, group) if of_laws is None else of_laws)[: group.n_compared]
    else:
        S = _with_record(S, of_record[: group.n_compared])
    if np.any(problem.step_std):
        variance = np.broadcast_to(np.square(problem.step_std) / problem.samples(group), S.shape[1:2])
        S += white_covariance(prediction.sampled_impedance[: group.n_compared], 0.0 * variance, variance)
    return S


def _of_laws(prediction: Prediction, group: Group) -> np.ndarray:
    """(L, n, n) covariance that laws which are not linear add to the noise, where none is along the record."""
    of_motors = law_noise(prediction, group)[:, :, None] * np.eye(prediction.U.shape[-1])
    of_loops = loop_noise(prediction, group)
    return of_motors if of_loops is None else of_motors + of_loops


def output_covariance(
    problem: Problem, group: Group, prediction: Prediction, of_laws: np.ndarray | None = None
) -> np.ndarray:
    """The same of all outputs: noise of a motor position is in the torque and in what a link encoder differs by; (K, n + M, n + M)."""
    S = noise_covariance(problem, group, prediction, of_laws)
    n, links, samples = S.shape[-1], list(group.links), problem.samples(group)
    if not links:
        return S
    position = (problem.q_std**2 + np.square(problem.step_std)) / samples
    recorded, true = prediction.filters
    per_position = prediction.plane.output_per_position[: len(S)] * true[: len(S), None]
    per_position[:, :n] *= recorded[: len(S), :, None]
    all_of_it = white_covariance(
        per_position,
        np.concatenate([np.zeros(n), group.link_std[links] ** 2 / samples]),
        position,
    )
    all_of_it[:, :n, :n] = S
    return all_of_it


def _with_record(S: np.ndarray, more: np.ndarray) -> np.ndarray:
    """A covariance (K, n, n) and what answers to the record add to it, by draws.

    At least ``LEAST_NOISE`` of the former in any direction, and ``LEAK`` of the largest: draws know directions to so much.
    """
    root = np.linalg.cholesky(S)
    half = np.linalg.solve(root, more)
    relative = np.linalg.solve(root, np.conj(np.swapaxes(half, 1, 2)))
    values, vectors = np.linalg.eigh(0.5 * (relative + np.conj(np.swapaxes(relative, 1, 2))))
    values = np.maximum(1.0 + values, LEAST_NOISE)
    spread = root @ vectors
    return (spread * np.maximum(values, LEAK * values[:, -1:])[:, None, :]) @ np.conj(np.swapaxes(spread, 1, 2))


def make_weights(problem: Problem, predictions: Sequence[Prediction], rho: float) -> Weights:
    """Weights at the current model; ``rho`` is a relative error added to the noise.

    Lines of a motion, seen through its window, count in units of the noise of a whole record: neighbours share theirs, and
    the sum of their squares is that of ``data_count`` independent numbers.
    """
    whiten, covariance = [], []
    known = has_scatter(problem, predictions[0].model)
    laws = [_of_laws(pred, group) if known else None for group, pred in zip(problem.groups, predictions, strict=True)]
    for group, pred, of_laws in zip(problem.groups, predictions, laws, strict=True):
        S = output_covariance(problem, group, pred, of_laws)
        k = np.arange(S.shape[1])
        S[0] *= 4.0
        links = k[problem.structure.n :]
        if rho > 0 or len(links):
            power = np.mean(np.abs(_signals(group, pred)[:, : group.n_compared]) ** 2, axis=0)
        if rho > 0:
            S[:, k, k] += rho**2 * power
            S[1:, k, k] += 1e-2 * rho**2 * power[1:].mean(axis=0)
        if len(links):
            left = np.mean(np.abs(output_error(group, pred)[:, 1:, links]) ** 2, axis=(0, 1)) - S[1:, links, links].real.mean(axis=0)
            S[:, links, links] += np.clip(left, 0.0, LINK_ERROR**2 * power[1:, links].mean(axis=0))
        root = np.linalg.inv(np.linalg.cholesky(S)) * np.sqrt(2.0)
        root[0] /= np.sqrt(2.0)
        whiten.append(root)
        covariance.append(S)
    weights = Weights(tuple(whiten), tuple(covariance))
    return replace(weights, by_noise=noise_of(problem, predictions, weights, laws)) if known else weights


def _signals(group: Group, prediction: Prediction) -> np.ndarray:
    """(S, L, n + M) what errors of a model are relative to: the torque, and the wind-up of the gears that link encoders show."""
    if not group.links:
        return group.U
    windup = group.Q_link[..., list(group.links)] - group.Q @ prediction.par.coupling[list(group.links)].T
    windup[:, 0] = 0.0
    return np.concatenate([group.U, windup], axis=-1)


def residual(group: Group, prediction: Prediction) -> np.ndarray:
    """Measured less predicted recorded torque at the compared lines; (S, K, n) complex, N m."""
    return group.observe(group.U - prediction.U)


def output_error(group: Group, prediction: Prediction) -> np.ndarray:
    """The same of all outputs; (S, K, n + M) complex, N m and rad."""
    return group.observe_outputs(group.outputs - prediction.outputs(group))


def data_counts(problem: Problem) -> np.ndarray:
    """Real numbers that are compared, by joint; (n,)."""
    n = problem.structure.n
    each = [np.full(n + len(g.links), _records(g) * (2 * g.n_compared - 1)) for g in problem.groups]
    return _by_joint(problem, each)


def _records(group: Group) -> float:
    """Records of a group, those seen through a window as the share that it leaves."""
    return len(group.segments) * group.window_share


def data_count(problem: Problem) -> int:
    """Real numbers that are compared."""
    return int(np.sum(data_counts(problem)))


def coordinate_names(model: Model) -> tuple[str, ...]:
    """Names of the fitted coordinates: baseline, timing, effects."""
    names = [*parameter_names(model.structure.robot), "timing"]
    for effect in model.effects:
        h = effect.hypothesis
        names += [h.coordinate(p.name) for p in h.parameters]
    return tuple(names)


def pack(model: Model) -> np.ndarray:
    """Fitted coordinates of a model."""
    parts = [model.par.to_log(), [model.par.timing]]
    for effect in model.effects:
        parts.append([q.to_internal(v) for q, v in zip(effect.hypothesis.parameters, effect.p, strict=True)])
    return np.concatenate([np.asarray(p, float) for p in parts])


def unpack(model: Model, x: np.ndarray, limit: float) -> Model:
    """The model at fitted coordinates ``x``."""
    m = len(model.par.to_log())
    par = replace(model.par.with_log(np.clip(x[:m], -40, 60)), timing=float(np.clip(x[m], -limit, limit)))
    effects, at = [], m + 1
    for effect in model.effects:
        ps = effect.hypothesis.parameters
        values = np.array([q.to_external(v) for q, v in zip(ps, x[at : at + len(ps)], strict=True)])
        effects.append(Effect(effect.hypothesis, values))
        at += len(ps)
    return Model(model.structure, par, tuple(effects))


def stepped(problem: Problem, model: Model, step: np.ndarray) -> Model:
    """The model after a step (p,) of its fitted coordinates, no longer than one of a fit."""
    m = len(model.par.to_log())
    step = np.concatenate([np.clip(step[:m], -1.0, 1.0), step[m : m + 1], _clip_effects(model, step[m + 1 :])])
    return unpack(model, pack(model) + step, TIMING_LIMIT * problem.sampling.sample_time)


def jacobian(
    problem: Problem, model: Model, group: Group, pred: Prediction, *, exact: bool = False, shifts: bool = False
) -> Columns:
    """Derivative of the predicted outputs by the fitted coordinates, at the lines that are compared.

    Args:
        exact: what moves the links moves the torques of all laws of the gears and the geometric remainder. Both are held
            without, which beside such laws ends short of the minimum, and tells of less spread than there is.
        shifts: what moves the arm to another posture moves all lines, to first order, where the remainder is held.
    """
    m = len(model.par.to_log())
    top = compared_lines(group)
    now = _again(problem, model, group, pred, 1) if exact else pred
    posture = moved_by_posture(pred)[:, :top] if shifts and not exact and group.window is None else None
    n, base = model.structure.n, _baseline(model, pred, top)
    late = np.zeros((len(pred.U), top, n + len(group.links)), complex)
    late[..., :n] = pred.plane.s[:top, None] * pred.solution.U[:, :top]
    baseline = Columns(base, np.arange(m), late[..., None], np.array([m]))
    if posture is not None:
        baseline = baseline.replaced(_sagging(baseline, pred, posture))
    baseline = baseline.replaced(_passed_on(baseline, model, group, pred))
    baseline = baseline.replaced(_differences(problem, model, group, pred, now, exact, posture))
    if not problem.free_timing:
        baseline.whole[..., baseline.whole_at == m] = 0.0
    effects = [
        column
        for i in range(len(model.effects))
        for column in _effect_columns(problem, model, group, pred, now, i, exact, posture)
    ]
    columns = baseline.replaced({m + 1 + i: column for i, column in enumerate(effects)})
    still = held(pred, group)
    if still is None:
        return columns
    # Differences of laws at the motors have it in them.
    dense, at_motors = columns.dense(), np.array([e.hypothesis.channel == "motor" for e in model.effects for _ in e.p])
    passed = np.concatenate([np.ones(m + 1, bool), ~at_motors])
    dense[..., passed] = as_free(dense[..., passed], still, group)
    return columns.made_whole(dense)


def _baseline(model: Model, pred: Prediction, top: int) -> Products:
    """Derivatives by the log-parameters of the model, without those of hinges that its effects add."""
    n, n_e = model.structure.n, len(model.structure.elastic)
    extra = len(pred.structure.elastic) - n_e
    keep = np.r_[: 4 * n + n_e, 4 * n + n_e + extra : 4 * n + extra + 2 * n_e]
    return baseline_products(pred.structure, pred.par, pred.plane, pred.solution, top).pick(keep)


def _again(problem: Problem, model: Model, group: Group, pred: Prediction, steps: int) -> Prediction:
    """What a model near that of ``pred`` predicts, from its geometric remainder, ``steps`` on, and its torques."""
    return predict(model, group, problem.sampling, W=pred.solution.W, steps=steps, torques=pred.solution.torques)


def _sagging(columns: Columns, pred: Prediction, posture: np.ndarray) -> dict[int, np.ndarray]:
    """Columns of the stiffness of gears that also let the arm sag to another posture."""
    sag = pred.plane.A_inv[0][:, pred.structure.driven].real * (pred.par.stiffness * pred.solution.delta[:, 0].real)[:, None]
    held = columns.products.pick(np.arange(sag.shape[-1])).dense()
    return dict(enumerate(np.moveaxis(held + posture @ sag[:, None], -1, 0)))


def _change(group: Group, there: Prediction, base: Prediction, posture: np.ndarray | None) -> np.ndarray:
    """(S, K, n + M) change of the compared outputs between predictions with one geometric remainder.

    Args:
        posture: of ``moved_by_posture`` at the compared lines, which stands for what the remainder would do; None holds it.
    """
    change = (there.outputs(group) - base.outputs(group))[:, : compared_lines(group)]
    if posture is None:
        return change
    # A plane of its own stands at another posture already.
    shift = (there.solution.Q_a[:, 0] - base.solution.Q_a[:, 0]).real - (there.plane.lin.q - base.plane.lin.q)
    return change + np.einsum("slon,sn->slo", posture, shift)


def _differences(
    problem: Problem,
    model: Model,
    group: Group,
    pred: Prediction,
    now: Prediction,
    exact: bool,
    posture: np.ndarray | None,
) -> dict[int, np.ndarray]:
    """Baseline columns (S, L, n + M) of what moves laws of the gear, or with ``exact`` the links, by differences from ``now``.

    These laws move with the gear's spring and damper; and where the recorded torque says its deflection, with what
    the motor takes of that, and with the timing.
    """
    n, m = model.structure.n, len(model.par.to_log())
    along = joints_along_record(model, group)
    gears = {e.hypothesis.joint for e in model.effects if e.hypothesis.gear_law}
    steps = {f * n + j: BASELINE_STEP for j in gears for f in range(4 if j in along else 2)}
    if exact:
        steps |= dict.fromkeys(np.flatnonzero(_moves_links(model)[:m]).tolist(), BASELINE_STEP)
    if along:
        steps[m] = TIMING_STEP
    x = pack(model)

    def column(c: int, step: float) -> np.ndarray:
        there = unpack(model, x + step * (np.arange(len(x)) == c), np.inf)
        return _change(group, _again(problem, there, group, pred, int(exact)), now, posture) / step

    return {c: column(c, step) for c, step in steps.items()}


def _passed_on(columns: Columns, model: Model, group: Group, pred: Prediction) -> dict[int, np.ndarray]:
    """Baseline columns of the torque that drives with effects pass on; none where there are no such drives."""
    drives = _drives(model)
    if not drives:
        return {}
    dense = columns.dense()
    for effect in drives:
        j, motion = effect.hypothesis.joint, pred.motion(group)
        full = np.zeros((dense.shape[-1], *pred.U.shape[:2]), complex)
        full[:, :, : dense.shape[1]] = np.moveaxis(dense[:, :, j], -1, 0)
        passed = _change_passed(effect, motion, full)
        dense[:, :, j] = np.moveaxis(passed[:, :, : dense.shape[1]], 0, -1)
    return dict(enumerate(np.moveaxis(dense, -1, 0)))


def _drives(model: Model) -> list[Effect]:
    """Effects of the drives, in the order in which they act."""
    return [e for e in model.effects if e.hypothesis.channel == "drive"]


def _change_passed(drive: Effect, motion: Motion, X: np.ndarray) -> np.ndarray:
    """A change (..., S, L) of the torque before a drive with an effect, as it is after it."""
    h, k = drive.hypothesis, motion.par.stiffness[drive.hypothesis.joint]
    return h.law(drive.p, motion, h.joint, k, X) - h.law(drive.p, motion, h.joint, k, 0 * X)


def compared_lines(group: Group) -> int:
    """Lines that enter a comparison: up to the band for periodic data, all for a motion."""
    return group.n_compared if group.window is None else len(group.omega)


def _effect_columns(
    problem: Problem,
    model: Model,
    group: Group,
    pred: Prediction,
    now: Prediction,
    i: int,
    exact: bool,
    posture: np.ndarray | None,
) -> list[np.ndarray]:
    """Derivatives (S, K, n + M) of the predicted outputs by the coordinates of effect ``i``, by differences from ``now``."""
    effect = model.effects[i]
    h, steps, top = effect.hypothesis, _steps(effect), compared_lines(group)
    if h.channel == "motor" and not joints_along_record(model, group):
        return [column[:, :top] for column in _motor_columns(model, group, pred, effect, steps)]
    if h.channel == "drive":
        return [column[:, :top] for column in _drive_columns(model, group, pred, effect, steps)]
    models = [
        Model(model.structure, model.par, tuple(Effect(h, p) if a == i else e for a, e in enumerate(model.effects)))
        for p, _ in steps
    ]
    if exact or h.channel == "model":
        base, posture = now if exact else _again(problem, model, group, pred, 1), None
        moved = [_again(problem, m, group, pred, 1) for m in models]
    else:
        base, held = pred, {"W": pred.solution.W, "torques": pred.solution.torques}
        moved = [predict_at(m, pred.structure, pred.par, pred.plane, group, problem.sampling, **held) for m in models]
    return [_change(group, there, base, posture) / step for there, (_, step) in zip(moved, steps, strict=True)]


def _steps(effect: Effect) -> list[tuple[np.ndarray, float]]:
    """Parameters of an effect after a step of each of its coordinates, and the step."""
    steps = []
    for c, q in enumerate(effect.hypothesis.parameters):
        x, p, step = q.to_internal(effect.p[c]), effect.p.copy(), q.step
        p[c] = q.to_external(x + step)
        if p[c] == effect.p[c]:
            step = -step
            p[c] = q.to_external(x + step)
        steps.append((p, step))
    return steps


def _motor_columns(
    model: Model, group: Group, pred: Prediction, effect: Effect, steps: Sequence[tuple[np.ndarray, float]]
) -> list[np.ndarray]:
    """Those of a law at the motor: the motion does not change, and only its own torque does."""
    h, j = effect.hypothesis, effect.hypothesis.joint
    motion = beside(model.effects, effect, pred.motion(group))
    k = pred.par.stiffness[j]
    now, columns = h.law(effect.p, motion, j, k), []
    drives = [e for e in _drives(model) if e.hypothesis.joint == j]
    for p, step in steps:
        X = pred.plane.record * motion.lines(h.law(p, motion, j, k) - now)
        for drive in drives:
            X = _change_passed(drive, motion, X)
        out = np.zeros((*pred.U.shape[:2], model.structure.n + len(group.links)), complex)
        out[..., j] = X / step
        columns.append(out)
    return columns


def _drive_columns(
    model: Model, group: Group, pred: Prediction, effect: Effect, steps: Sequence[tuple[np.ndarray, float]]
) -> list[np.ndarray]:
    """Those of a drive: what it is given does not change."""
    motion, n, columns = pred.motion(group), model.structure.n, []
    drives = _drives(model)
    for p, step in steps:
        out = np.zeros((*pred.U.shape[:2], n + len(group.links)), complex)
        out[..., :n] = through_drives([replace(e, p=p) if e is effect else e for e in drives], motion) - pred.U
        columns.append(out / step)
    return columns


def anneal(
    problem: Problem,
    model: Model,
    *,
    ladder: Sequence[float] = ANNEALING,
    iterations: int = 12,
    gap: float = GAP,
    remainders: Sequence[np.ndarray] | None = None,
    progress: Callable[[str], None] | None = None,
) -> Fit:
    """Fits under less and less error added to the noise (``ladder``), each from where the last one ended.

    With as much error as ``HELD`` the drives are held near their starting guesses: there the data say little, and a gear
    that once has lost its spring does not find it again.
    """
    stages: list[Fit] = []
    for i, rho in enumerate(ladder):
        stages.append(
            fit(
                problem,
                stages[-1].model if stages else model,
                rho=rho,
                hold=HOLD if rho >= HELD else 0.0,
                iterations=iterations,
                gap=gap,
                remainders=stages[-1].remainders if stages else remainders,
                progress=None if progress is None else lambda text, i=i: progress(f"{text}, stage {i + 1}/{len(ladder)}"),
            )
        )
    return replace(stages[-1], softer=tuple(stages[:-1]))


def fit(
    problem: Problem,
    model: Model,
    *,
    rho: float = 0.0,
    hold: float = 0.0,
    iterations: int = 12,
    gap: float = GAP,
    weights: Weights | None = None,
    remainders: Sequence[np.ndarray] | None = None,
    most: float = np.inf,
    exact: bool = False,
    progress: Callable[[str], None] | None = None,
) -> Fit:
    """Fit baseline parameters, timing and effects together.

    Args:
        model: start.
        rho: relative error added to the noise.
        hold: penalty on the drives by their squared distance from the starting guesses, natural logarithm, beyond the
            weak prior; in units of the data that are compared.
        iterations: at most.
        gap: relative fall of the cost in a step below which the fit ends.
        weights: those to fit under; of the start where None.
        remainders: geometric remainders to start from.
        most: cost of the start above which there is no fit.
        exact: beside laws of the gears the last steps, and the information, are by exact derivatives (``jacobian``), which
            take several times as long. Beside others, and in motions, which hardly show springs, these add nothing.

    Raises:
        ArithmeticError: where the start costs more.
    """
    limit = TIMING_LIMIT * problem.sampling.sample_time
    m = len(model.par.to_log())
    center, prior = prior_of(problem, model)
    Ws = list(remainders) if remainders is not None else [None] * len(problem.groups)
    count = data_count(problem)
    prior[:m] += hold * count
    x = pack(model)
    preds = predictions(problem, model, Ws, steps=REMAINDER_STEPS)
    Ws = [p.solution.W for p in preds]
    if weights is None:
        weights = make_weights(problem, preds, rho)
    cost = weighted_cost(problem, preds, weights)
    if np.isfinite(most) and not cost <= most:
        raise FloatingPointError(f"a start that costs {cost:.3g}, more than {most:.3g}")
    settled = model, preds, Ws, cost
    share: float | None = None if has_scatter(problem, model) else 0.0  # of what noise adds to the cost, that is taken off
    if problem.motions_alone:
        # Motions hardly show the gears. Where the model is far from the data their springs would follow its error.
        prior = prior * max(1.0, cost / count)
    # The remainder holds the gravity torque of the chain, at one posture: what changes either needs a new one.
    anew = (_shifts_posture(model) and not problem.motions_alone) or any(e.hypothesis.channel == "model" for e in model.effects)
    moves, drift = _moves_links(model), np.zeros(len(x))
    damping = 1e-3
    converged = False
    exact = exact and not problem.motions_alone and any(e.hypothesis.gear_law for e in model.effects)
    fine = False  # whether the steps are by exact derivatives already
    # Columns beside loops take most of the time: each is a periodic motion of its own.
    slow = any(has_loop(e) for e in model.effects)
    columns: list[Columns] = []
    for _ in range(iterations):
        fresh = not columns
        columns = columns or _jacobians(problem, model, preds, exact=fine)
        H, b = _normal(problem, columns, preds, weights)
        off = x - center
        if share is None:
            share = trusted_share(H, shared_information(problem, model, preds, weights))
        if share:
            b = b - share * shared_slope(problem, model, preds, weights)
        noise = share * np.sum(by_noise(problem, preds, weights)) if share else 0.0
        H_p, b_p = H + np.diag(prior), b - prior * off
        size = np.diag(H_p).copy()
        size[size <= 0] = 1.0
        for _ in range(6):
            step = np.linalg.solve(H_p + damping * np.diag(size), b_p)
            step[:m] = np.clip(step[:m], -1.0, 1.0)
            step[m + 1 :] = _clip_effects(model, step[m + 1 :])
            step[:m] = np.clip(x[:m] + step[:m], center[:m] - LOG_RANGE, center[:m] + LOG_RANGE) - x[:m]
            try:
                if not np.all(np.isfinite(step)):
                    raise FloatingPointError("a step without a size")
                trial = unpack(model, x + step, limit)
                new = predictions(problem, trial, Ws, steps=REMAINDER_STEPS if anew or fine else 0, near=preds)
                new_cost = weighted_cost(problem, new, weights)
                new_noise = share * np.sum(by_noise(problem, new, weights)) if share else 0.0
            except (np.linalg.LinAlgError, FloatingPointError, ValueError):
                new_cost = new_noise = np.inf
            gain = (cost - noise) - (new_cost - new_noise) if np.isfinite(new_cost) else -np.inf
            penalty = np.sum(prior * ((off + step) ** 2 - off**2))
            foretold = float(2.0 * b @ step - step @ H @ step)
            improved = bool(gain > penalty)
            # A step whose parts are cut to size may be foretold to lead uphill: a shorter one does not.
            if improved or (slow and abs(foretold) < SLIGHT):
                break
            damping = max(damping, 1e-4) * 8
        if not improved:
            converged = fresh and fine == exact
            if converged:
                break
            fine, damping, columns = fine if not fresh else True, 1e-3, []
            continue
        if not (slow and abs(gain - foretold) <= max(FORETOLD * foretold, SLIGHT)):
            columns = []
        drift += np.abs(pack(trial) - x)
        model, x = trial, pack(trial)
        damping = max(damping / 10, 1e-9)
        preds, cost = new, new_cost
        if np.max(np.where(moves, drift, 0.0)) > STALE:
            kept, settled = settled, _settled(problem, settled, model, weights)
            model, preds, Ws, cost = settled
            x, drift = pack(model), np.zeros(len(x))
            if settled is kept:
                damping, columns = max(damping, 1e-4) * SHORTER, []
                continue
        if progress is not None:
            progress(f"fit: chi2/dof {cost / count:.3g}")
        if gain < max(gap * cost, 0.02):
            converged = fine == exact
            if converged:
                break
            fine, columns = True, []
    if np.any(drift):
        model, preds, Ws, _ = _settled(problem, settled, model, weights)
    if fine != exact or not columns:
        columns = _jacobians(problem, model, preds, exact=exact)
    H, _ = _normal(problem, columns, preds, weights)
    if share:
        H = information_left(H, share * shared_information(problem, model, preds, weights))
    costs = fair_costs(problem, preds, weights)
    names = coordinate_names(model)
    return Fit(model, costs, data_counts(problem), H, names, tuple(Ws), weights, converged, share=share)


Settled = tuple[Model, list[Prediction], list[np.ndarray], float]
"""A model, its predictions, the geometric remainders that they were made with, and its cost."""


def _settled(problem: Problem, last: Settled, model: Model, weights: Weights) -> Settled:
    """``model`` with its own geometric remainders, else ``last``.

    Steps are taken with the remainder held. Where the links hang on gears that are far too soft the
    remainder answers them so strongly that a step which lowers the cost raises it in truth.
    """
    try:
        preds = predictions(problem, model, last[2], steps=REMAINDER_STEPS, near=last[1])
        cost = weighted_cost(problem, preds, weights)
    except (np.linalg.LinAlgError, FloatingPointError, ValueError):
        return last
    return (model, preds, [p.solution.W for p in preds], cost) if cost < LOST * last[3] else last


def _shifts_posture(model: Model) -> bool:
    """Whether effects move the arm to another posture; along the record that says what the gear carries."""
    return any(e.hypothesis.channel in SHIFTS and not is_along_record(e.hypothesis) for e in model.effects)


def _moves_links(model: Model) -> np.ndarray:
    """Which fitted coordinates change the motion of the links along given motor motion."""
    n, n_e = model.structure.n, len(model.structure.elastic)
    parts = [np.ones(2 * n, bool), np.zeros(2 * n, bool), np.ones(2 * n_e, bool), np.zeros(1, bool)]
    for effect in model.effects:
        inside = effect.hypothesis.channel not in ("motor", "drive")
        parts.append(np.full(len(effect.p), inside))
    return np.concatenate(parts)


def prior_of(problem: Problem, model: Model) -> tuple[np.ndarray, np.ndarray]:
    """Centre and weight (inverse variance) of the weak prior of each fitted coordinate."""
    ps = [q for effect in model.effects for q in effect.hypothesis.parameters]
    baseline = problem.nominal.to_log()
    centers = [
        q.prior_center(problem.nominal.stiffness[effect.hypothesis.joint])
        for effect in model.effects
        for q in effect.hypothesis.parameters
    ]
    center = np.concatenate([baseline, [0.0], centers])
    timing = (PRIOR_TIMING * problem.sampling.sample_time) ** -2
    return center, np.concatenate([np.full(len(baseline), PRIOR_LOG_STD**-2), [timing], [q.spread**-2 for q in ps]])


def _clip_effects(model: Model, step: np.ndarray) -> np.ndarray:
    """Logarithmic coordinates move by at most a factor e^1.5 in a step."""
    log = np.array([q.log for e in model.effects for q in e.hypothesis.parameters], bool)
    return np.where(log, np.clip(step, -1.5, 1.5), step) if len(step) else step


def predictions(
    problem: Problem,
    model: Model,
    remainders: Sequence[np.ndarray | None],
    steps: int | None = 0,
    near: Sequence[Prediction] = (),
) -> list[Prediction]:
    """What a model predicts for all records, from geometric remainders near their own.

    Args:
        near: predictions of a model with the same effects, with whose torques loops begin; from rest where empty.
    """
    torques = [p.solution.torques for p in near] or [Torques()] * len(problem.groups)
    return map_threads(
        lambda of: predict(model, of[0], problem.sampling, W=of[1], steps=steps, torques=of[2]),
        zip(problem.groups, remainders, torques, strict=True),
    )


def weighted_cost(problem: Problem, preds: Sequence[Prediction], weights: Weights) -> float:
    """Whitened sum of squares of the errors of all outputs."""
    return float(np.sum(joint_costs(problem, preds, weights)))


def joint_costs(problem: Problem, preds: Sequence[Prediction], weights: Weights) -> np.ndarray:
    """The same by joint, its link encoder included; (n,)."""
    each = [
        np.sum(np.abs(weights.apply(g, output_error(group, pred))) ** 2, axis=(0, 1))
        for g, (group, pred) in enumerate(zip(problem.groups, preds, strict=True))
    ]
    return _by_joint(problem, each)


def noise_costs(problem: Problem, noise: Weights, weights: Weights) -> np.ndarray:
    """Costs by joint that the noise which some weights stand for is expected to have under others; (n,).

    Under themselves that is ``data_counts``.
    """
    each = []
    for group, covariance, whiten in zip(problem.groups, noise.covariance, weights.whiten, strict=True):
        spread = np.matmul(whiten, np.linalg.cholesky(covariance))
        each.append(_records(group) * np.sum(np.abs(spread) ** 2, axis=(0, 2)))
    return _by_joint(problem, each)


def _by_joint(problem: Problem, each: Sequence[np.ndarray]) -> np.ndarray:
    """Sums over groups of figures of their outputs (n + M,), those of link encoders with their joints; (n,)."""
    total = np.zeros(problem.structure.n)
    for group, figures in zip(problem.groups, each, strict=True):
        total += figures[: len(total)]
        total[list(group.links)] += figures[len(total) :]
    return total


def _jacobians(problem: Problem, model: Model, preds: Sequence[Prediction], *, exact: bool) -> list[Columns]:
    """``jacobian`` of all groups."""
    of = partial(jacobian, problem, model, exact=exact, shifts=_shifts_posture(model))
    return map_threads(lambda x: of(*x), zip(problem.groups, preds, strict=True))


def _normal(
    problem: Problem, columns: Sequence[Columns], preds: Sequence[Prediction], weights: Weights
) -> tuple[np.ndarray, np.ndarray]:
    def of_group(g: int) -> tuple[np.ndarray, np.ndarray]:
        group = problem.groups[g]
        error = output_error(group, preds[g])
        if group.window is None:
            return columns[g].normal(weights.whiten[g], error)
        J = as_real(weights.apply(g, group.observe_outputs(columns[g].dense())))
        r = as_real(weights.apply(g, error)[..., None])[:, 0]
        return J.T @ J, J.T @ r

    H, b = zip(*map_threads(of_group, range(len(problem.groups))), strict=True)
    return sum(H), sum(b)


def has_scatter(problem: Problem, model: Model) -> bool:
    """Whether the scatter between periods tells what noise adds to the normal equations; along the record it does not."""
    return all(g.scatter is not None and not joints_along_record(model, g) for g in problem.groups)


def by_noise(
    problem: Problem, preds: Sequence[Prediction], weights: Weights, still: Sequence[np.ndarray | None] | None = None
) -> np.ndarray:
    """(n,) what noise adds to ``joint_costs`` (``errors_in_variables``).

    Args:
        still: of ``held_share``, of each group; of motors that nothing holds where None.
    """
    each = zip(problem.groups, preds, weights.whiten, still or [None] * len(preds), strict=True)
    return sum(scatter_costs(*of) for of in each)


def noise_of(problem: Problem, preds: Sequence[Prediction], weights: Weights, laws: Sequence[np.ndarray]) -> np.ndarray:
    """(n,) what noise adds to ``joint_costs``, by what is linear (``by_noise``) and by laws that are not.

    Args:
        laws: of ``_of_laws``, of each group.
    """
    each = []
    for group, of_laws, whiten in zip(problem.groups, laws, weights.whiten, strict=True):
        more = of_laws[: len(whiten)]
        each.append(_records(group) * np.einsum("kij,kjl,kil->i", whiten, more, whiten.conj(), optimize=True).real)
    still = [held_share(*of) for of in zip(preds, problem.groups, strict=True)]
    return by_noise(problem, preds, weights, still) + _by_joint(problem, each)


def fair_costs(problem: Problem, preds: Sequence[Prediction], weights: Weights) -> np.ndarray:
    """(n,) costs by joint as they would be with as much noise as the model of the weights passes on.

    A model that passes on less of the noise of the position, as one that is damped at its resonances does, costs less however wrong
    it is: that is no merit, and is made up for.
    """
    costs = joint_costs(problem, preds, weights)
    if not problem.scatter_share or weights.by_noise is None or not has_scatter(problem, preds[0].model):
        return costs + absorbed(problem, preds, weights)
    laws = [_of_laws(pred, group) for group, pred in zip(problem.groups, preds, strict=True)]
    more = noise_of(problem, preds, weights, laws) - weights.by_noise
    return np.maximum(costs - problem.scatter_share * more, 0.0)


def absorbed(problem: Problem, preds: Sequence[Prediction], weights: Weights) -> np.ndarray:
    """(n,) what noise would add to the costs at motors that dry friction holds, which takes it: no merit of the friction."""

    def of_group(of: tuple[Group, Prediction, np.ndarray]) -> np.ndarray:
        group, pred, whiten = of
        share, n = held_share(pred, group), problem.structure.n
        if share is None:
            return np.zeros(whiten.shape[1])
        noise = {"tau_std": problem.tau_std, "q_std": problem.q_std, "samples": problem.samples(group)}
        S = residual_covariance(group, pred.sampled_impedance, **noise)
        W = whiten[:, :, :n]
        return _records(group) * np.einsum("kij,kjl,kil->i", W, S - as_held(S, share), W.conj(), optimize=True).real

    return _by_joint(problem, map_threads(of_group, zip(problem.groups, preds, weights.whiten, strict=True)))


def shared_slope(problem: Problem, model: Model, preds: Sequence[Prediction], weights: Weights) -> np.ndarray:
    """The same to the right-hand side of ``_normal``."""
    m, count = len(model.par.to_log()), len(coordinate_names(model))

    def others(group: Group, pred: Prediction, K: int) -> Iterator[tuple[int, np.ndarray]]:
        if problem.free_timing:
            yield m, pred.plane.s[:K, None, None] * pred.sampled_impedance[:K]
        at = m + 1
        for i, effect in enumerate(model.effects):
            slopes = impedance_slopes(model, group, pred, problem.sampling, i, _steps(effect))
            yield from ((at + c, slope) for c, slope in enumerate(slopes))
            at += len(effect.p)

    def of_group(of: tuple[Group, Prediction, np.ndarray]) -> np.ndarray:
        group, pred, whiten = of
        K = len(whiten)
        return scatter_slope(group, pred, whiten, _baseline(model, pred, K), others(group, pred, K), count)

    return sum(map_threads(of_group, zip(problem.groups, preds, weights.whiten, strict=True)))


def shared_information(problem: Problem, model: Model, preds: Sequence[Prediction], weights: Weights) -> np.ndarray:
    """The same to the normal matrix of the baseline parameters."""
    each = zip(problem.groups, preds, weights.whiten, strict=True)
    return sum(scatter_information(g, pred, whiten, _baseline(model, pred, len(whiten))) for g, pred, whiten in each)


def as_real(X: np.ndarray) -> np.ndarray:
    """Complex (..., p) as real rows (2 x rows, p): real parts, then imaginary parts."""
    X = X.reshape(-1, X.shape[-1])
    out = np.empty((2 * len(X), X.shape[-1]))
    out[: len(X)], out[len(X) :] = X.real, X.imag
    return out
