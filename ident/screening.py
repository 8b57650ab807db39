"""Cheap scores of every hypothesis: how much of the residual its unit responses explain.

For unit responses ``X`` of a hypothesis, whitened, with the fitted coordinates projected out:
``gain = (X^T P r)^T (X^T P X)^{-1} (X^T P r)``, the fall of the cost that a linear step in its
weights gives (score test, Rao 1948; theory.md 9.3). Only normal matrices are kept.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from ident.coordinates import prior_of
from ident.derivatives import as_real, jacobian
from ident.extended import Prediction, predict
from ident.hypotheses import Hypothesis, SignalScale
from ident.motion import Motion
from ident.parallel import map_threads, one_thread_each
from ident.position_lines import motor_orders, wave_numbers
from ident.posture import moved_by_gears
from ident.problem import Problem, output_error
from ident.torque_fit import RIDGE, Fit
from ident.torque_fit import inverse as steadied_inverse

MOST_WAVES = 2  # of a ripple, beside the best, of those found and of those that motors have
NEAR_WAVE = 0.9  # of the gain of the best
NEAR_ORDER = 0.5  # the same of a wave that a motor has: several of any length fit a few postures by chance
SAME_WAVE = 0.02  # relative, of two
RIPPLES = 0.5  # of the excess at its joint, from which a ripple is also begun at what motors have
MISSING = 0.05  # of a unit resonance, from which one is missing
SHIFT = 1e-4  # rad or m, of a position along which a motion is predicted once more


@dataclass(frozen=True)
class Score:
    """Best unit response of a hypothesis: fall of the cost, its degrees of freedom, a start.

    ``step`` (p,) is what the coordinates that are fitted already do in the same linear step, as a gear does that has
    taken the place of a spring beside it; None where it is not known. ``near``: scores at other wave numbers of a
    ripple, best first, that come near the best: a motion of a few turns hardly tells them, and no step of a fit leads
    from one to another.
    """

    hypothesis: Hypothesis
    gain: float
    dof: int
    start: np.ndarray | None
    weights: np.ndarray
    shape: tuple[float, ...]
    step: np.ndarray | None = None
    near: tuple[Score, ...] = ()


def signal_scale(
    problem: Problem, predictions: Sequence[Prediction], joint: int, wave_numbers: tuple[float, ...]
) -> SignalScale:
    """Sizes of a joint's signals over all records."""
    v, q, delta, torque, sizes = [], [], [], [], []
    starts, tops = [], []
    for group, pred in zip(problem.groups, predictions, strict=True):
        motion = pred.motion()
        v.append(np.mean(motion.v(joint) ** 2))
        x = motion.q(joint)
        q.append(np.mean((x - x.mean(axis=1, keepdims=True)) ** 2))
        delta.append(np.abs(motion.delta(joint)).ravel()[::7])
        u = motion.torque(joint)
        torque.append(np.mean((u - u.mean(axis=1, keepdims=True)) ** 2))
        sizes.append(motion.torque_sizes(joint).ravel())
        starts += [*group.start, *(group.start + group.period_time)]
        tops.append(group.omega[group.n_compared - 1] / 2 / np.pi)
    all_delta, all_sizes = np.concatenate(delta), np.concatenate(sizes)
    return SignalScale(
        v=float(np.sqrt(np.mean(v))),
        q=float(np.sqrt(np.mean(q))),
        delta=np.quantile(all_delta, [0.1, 0.5, 0.9, 0.995]),
        delta_rms=float(np.sqrt(np.mean(all_delta**2))),
        torque=float(np.sqrt(np.mean(torque))),
        stiffness=float(predictions[0].par.stiffness[joint]),
        wave_numbers=wave_numbers,
        peak_torque=float(np.max(all_sizes)),
        exceeded_torque=np.inf if any(g.window is None for g in problem.groups) else float(np.quantile(all_sizes, 0.8)),
        duration=float(max(starts) - min(starts)) if len(set(np.round(starts, 3))) > 2 else 0.0,
        highest_line=float(np.median(tops)),
    )


@one_thread_each
def screen(
    problem: Problem, fit: Fit, predictions: Sequence[Prediction], hypotheses: Sequence[Hypothesis]
) -> list[Score]:
    """Score every hypothesis, best first."""
    stage = _Stage.build(problem, fit, predictions)
    scales = map_threads(
        lambda j: signal_scale(problem, predictions, j, wave_numbers(problem, predictions, j)),
        range(problem.structure.n),
    )
    found = map_threads(lambda members: _best_scores(stage, members, scales), side_by_side(hypotheses))
    return sorted((score for part in found for score in part), key=lambda s: -s.gain)


@one_thread_each
def most_explained(
    problem: Problem,
    fit: Fit,
    predictions: Sequence[Prediction],
    hypotheses: Sequence[Hypothesis],
    others: Sequence[Problem],
) -> np.ndarray:
    """Gain of the best of all hypotheses in each of ``others``: the same motions with other torques; (R,).

    The unit responses are those of the motions, and made once for all of them; ripples are asked at the wave numbers
    that any of them shows.
    """
    stage = _Stage.build(problem, fit, predictions, others)

    def scale(joint: int) -> SignalScale:
        waves = (wave_numbers(other, predictions, joint) for other in others)
        return signal_scale(problem, predictions, joint, tuple(dict.fromkeys(n for each in waves for n in each)))

    scales = map_threads(scale, range(problem.structure.n))
    each = map_threads(lambda members: _best_gains(stage, members, scales), side_by_side(hypotheses))
    return np.max(each, axis=0)


def side_by_side(hypotheses: Sequence[Hypothesis]) -> list[list[Hypothesis]]:
    """Hypotheses by what they are scored with: all of one channel and joint, or a single one of the chain."""
    together: dict[tuple, list[Hypothesis]] = {}
    for h in hypotheses:
        together.setdefault(h.key if h.channel == "model" else (h.channel, h.joint), []).append(h)
    return list(together.values())


@dataclass(frozen=True)
class _Stage:
    """What all hypotheses are held against: whitened residuals, fitted coordinates, inverse of their normal matrix.

    ``damped`` is that inverse with what is known of the coordinates beforehand, for steps.

    ``residuals`` (S, K, n, R), ``columns`` (S, K, n, p) and ``moved`` (S, K, n, joints) per group, complex; the last is
    what a constant unit torque in a gear does by the posture to which it moves the arm, none for motions. ``moment``
    (p, R). There are R records of the same motions, one where they are not drawn anew.
    """

    problem: Problem
    fit: Fit
    predictions: Sequence[Prediction]
    motions: tuple[Motion, ...]
    residuals: tuple[np.ndarray, ...]
    columns: tuple[np.ndarray, ...]
    moved: tuple[np.ndarray | None, ...]
    inverse: np.ndarray
    moment: np.ndarray
    damped: np.ndarray

    @classmethod
    def build(
        cls, problem: Problem, fit: Fit, predictions: Sequence[Prediction], others: Sequence[Problem] = ()
    ) -> _Stage:
        """Args: others: records of the same motions that take the place of those of ``problem``."""

        def whitened(g: int) -> tuple[np.ndarray, np.ndarray, np.ndarray | None]:
            group, pred = problem.groups[g], predictions[g]
            J = fit.weights.apply(
                g, group.observe_outputs(jacobian(problem, fit.model, group, pred, shifts=True).dense())
            )
            moved = None
            if group.window is None:
                moved = fit.weights.apply(g, group.observe_outputs(moved_by_gears(pred)))
            errors = [output_error(of.groups[g], pred) for of in others or (problem,)]
            return np.stack([fit.weights.apply(g, error) for error in errors], axis=-1), J, moved

        residuals, columns, moved = zip(*map_threads(whitened, range(len(problem.groups))), strict=True)
        real = [as_real(J) for J in columns]
        H = sum(J.T @ J for J in real)
        moment = sum(J.T @ as_real(r) for J, r in zip(real, residuals, strict=True))
        size = np.sqrt(np.maximum(np.diag(H), 1e-30))
        inverse = np.linalg.pinv(H / np.outer(size, size), rcond=1e-10, hermitian=True) / np.outer(size, size)
        _, prior = prior_of(problem, fit.model)
        damped = steadied_inverse(H + np.diag(prior), RIDGE)
        motions = tuple(pred.motion() for g, pred in zip(problem.groups, predictions, strict=True))
        return cls(problem, fit, predictions, motions, residuals, columns, moved, inverse, moment, damped)


@dataclass(frozen=True)
class _Sums:
    """Inner products of unit responses among themselves (m, m), with the residuals (m, R) and with the
    fitted coordinates (p, m)."""

    own: np.ndarray
    residuals: np.ndarray
    columns: np.ndarray

    def __add__(self, other: _Sums) -> _Sums:
        return _Sums(self.own + other.own, self.residuals + other.residuals, self.columns + other.columns)


@dataclass(frozen=True)
class _Field:
    """How a torque signal of one channel shows in a group: whitened torque per signal, (K, n).

    ``residuals`` (S, K, R) and ``columns`` (S, K, p) are the stage seen along it, so that a signal costs
    no more than its own lines. Its mean also moves the arm to another posture, where it answers all lines otherwise:
    ``moved`` (S, K, n) per unit of the mean, ``moved_residuals`` (S, R) and ``moved_columns`` (S, p) the stage seen
    along that; nothing of motors and drives.
    """

    torque: np.ndarray
    residuals: np.ndarray
    columns: np.ndarray
    moved: np.ndarray
    moved_residuals: np.ndarray
    moved_columns: np.ndarray

    @classmethod
    def build(cls, stage: _Stage, g: int, channel: str, joint: int) -> _Field:
        group, pred = stage.problem.groups[g], stage.predictions[g]
        torque = stage.fit.weights.apply(g, _gain(pred, channel, joint)[None, : group.n_compared])[0]
        residuals, columns = (
            np.matmul(torque.conj()[:, None, :], x)[..., 0, :] for x in (stage.residuals[g], stage.columns[g])
        )
        moved = stage.moved[g] @ _share_of_gears(pred, channel, joint)
        seen = moved.conj().reshape(len(moved), 1, -1)
        moved_residuals, moved_columns = (
            np.matmul(seen, x.reshape(len(moved), -1, x.shape[-1]))[:, 0].real
            for x in (stage.residuals[g], stage.columns[g])
        )
        return cls(torque, residuals, columns, moved, moved_residuals, moved_columns)


def _fields(stage: _Stage, hypotheses: Sequence[Hypothesis]) -> list[dict[str, _Field]]:
    """By group and channel, of hypotheses of ``side_by_side``; none of motions."""
    channels = {hypotheses[0].channel, "motor"} - {"model"}
    joint = hypotheses[0].joint
    return [
        {c: _Field.build(stage, g, c, joint) for c in channels} if group.window is None else {}
        for g, group in enumerate(stage.problem.groups)
    ]


def _best_gains(stage: _Stage, hypotheses: Sequence[Hypothesis], scales: Sequence[SignalScale]) -> np.ndarray:
    """Gain (R,) of the best shape of all hypotheses of ``side_by_side``."""
    fields, best = _fields(stage, hypotheses), np.zeros(stage.moment.shape[1])
    for h in hypotheses:
        of_any, of_missing = np.zeros_like(best), np.zeros_like(best)
        for shape in h.shapes(scales[max(h.joint, 0)]):
            explained = _explained(stage, _unit_responses(stage, fields, h, shape)[0])
            if explained is not None:
                c, gains = explained
                of_any = np.maximum(of_any, gains)
                missing = "hinge" in h.options and c[0] >= MISSING
                of_missing = np.maximum(of_missing, np.where(missing, gains, 0.0))
        best = np.maximum(best, np.where(of_missing > 0.0, of_missing, of_any))
    return best


def _best_scores(stage: _Stage, hypotheses: Sequence[Hypothesis], scales: Sequence[SignalScale]) -> list[Score]:
    """The best shape of each of the hypotheses of ``side_by_side``."""
    fields = _fields(stage, hypotheses)
    best = []
    for h in hypotheses:
        tried = [_score(stage, fields, h, shape) for shape in h.shapes(scales[max(h.joint, 0)])]
        scores = [s for s in tried if s is not None]
        if scores:
            # A resonance that is taken away says nothing of one that is missing elsewhere.
            hinge = "hinge" in h.options
            first, *others = sorted(scores, key=lambda s: (hinge and s.start is None, -s.gain))
            near = other_waves(first, others, likely_orders(stage, first)) if h.repeats else ()
            best.append(replace(first, near=near))
    return best


def likely_orders(stage: _Stage, ripple: Score) -> tuple[float, ...]:
    """``motor_orders`` of the joint of a ripple that explains most of what is left there."""
    j = ripple.hypothesis.joint
    excess = stage.fit.costs[j] - stage.fit.counts[j]
    return motor_orders(stage.problem.structure.robot.joints[j].gear_ratio) if ripple.gain > RIPPLES * excess else ()


def other_waves(best: Score, others: Sequence[Score], orders: Sequence[float] = ()) -> tuple[Score, ...]:
    """Scores of a ripple, best first, at wave numbers that none before has, and that come near the best.

    Args:
        orders: wave numbers that parts of the motor have.
    """
    kept, left = [best], {True: MOST_WAVES, False: MOST_WAVES}
    for s in others:
        of_motor = s.shape[0] in orders
        if (
            s.start is not None
            and left[of_motor]
            and s.gain >= (NEAR_ORDER if of_motor else NEAR_WAVE) * best.gain
            and all(abs(s.shape[0] / k.shape[0] - 1.0) > SAME_WAVE for k in kept)
        ):
            kept.append(s)
            left[of_motor] -= 1
    return tuple(kept[1:])


def _score(stage: _Stage, fields: Sequence[dict[str, _Field]], h: Hypothesis, shape: tuple[float, ...]) -> Score | None:
    sums, start = _unit_responses(stage, fields, h, shape)
    explained = _explained(stage, sums)
    if explained is None:
        return None
    c, gain = explained[0][:, 0], float(explained[1][0])
    step = stage.damped @ (stage.moment[:, 0] - sums.columns @ c)
    return Score(h, gain, len(c), _start(start, c, h, shape, stage.problem), c, shape, step)


def _explained(stage: _Stage, sums: _Sums) -> tuple[np.ndarray, np.ndarray] | None:
    """Weights (m, R) of unit responses in a linear step, and the fall of the cost (R,); None where they are not
    finite."""
    size = np.sqrt(np.maximum(np.diag(sums.own), 1e-300))
    P = (sums.own - sums.columns.T @ stage.inverse @ sums.columns) / np.outer(size, size)
    y = (sums.residuals - sums.columns.T @ stage.inverse @ stage.moment) / size[:, None]
    if not (np.all(np.isfinite(P)) and np.all(np.isfinite(y))):
        return None
    weights = np.linalg.pinv(P, rcond=1e-9, hermitian=True) @ y
    return weights / size[:, None], np.sum(y * weights, axis=0)


def _unit_responses(
    stage: _Stage, fields: Sequence[dict[str, _Field]], h: Hypothesis, shape: tuple[float, ...]
) -> tuple[_Sums, Callable[[np.ndarray], np.ndarray | None]]:
    """Sums of the unit responses of a hypothesis over all groups, and what makes a start of their weights."""
    total = None
    start: Callable[[np.ndarray], np.ndarray | None] = h.options.get("start", lambda c: None)
    for g, (group, pred) in enumerate(zip(stage.problem.groups, stage.predictions, strict=True)):
        if h.channel == "model":
            units = h.options["responses"](pred.structure, pred.par, pred.plane, group, pred.solution, shape)
            wound = h.options["winds"](pred.plane, pred.solution) if "winds" in h.options else None
            sums = _whole_sums(stage, g, np.stack(units, axis=-1), wound)
        else:
            motion = stage.motions[g]
            assert h.screen is not None  # beside the chain there is one
            made = h.screen(motion, h.joint, pred.par.stiffness[h.joint], shape)
            start = made.start
            parts = [(h.channel, _lines(motion, made.signals))]
            if made.motor:
                parts.append(("motor", _lines(motion, made.motor)))
            if group.window is None:
                sums = _line_sums([(fields[g][c], X[:, : group.n_compared]) for c, X in parts])
            else:
                along = [_along_motion(stage, g, c, h.joint, X) for c, X in parts]
                sums = _whole_sums(stage, g, sum(along, np.zeros_like(along[0])))
        total = sums if total is None else total + sums
    assert total is not None  # there is a group
    return total, start


def _along_motion(stage: _Stage, g: int, channel: str, joint: int, signals: np.ndarray) -> np.ndarray:
    """Outputs (S, L, n + M, m) of a motion by signals (S, L, m) of a channel at a joint; those of the position move
    gravity and inertia."""
    group, pred, problem = stage.problem.groups[g], stage.predictions[g], stage.problem
    if channel != "position":
        return _gain(pred, channel, joint)[None, :, :, None] * signals[:, :, None]

    def outputs(Q: np.ndarray) -> np.ndarray:
        of = replace(group, Q=Q)
        return predict(
            stage.fit.model, of, problem.sampling, W=pred.solution.W, steps=1, torques=pred.solution.torques
        ).outputs()

    before, out = outputs(group.Q), []
    for X in np.moveaxis(signals, -1, 0):
        Y = np.zeros_like(group.Q)
        Y[..., joint] = X
        step = SHIFT / max(np.abs(group.to_time(Y)).max(), 1e-300)
        out.append((outputs(group.Q + step * Y) - before) / step)
    return np.stack(out, axis=-1)


def _lines(motion: Motion, signals: Sequence[np.ndarray]) -> np.ndarray:
    """Time signals or spectra as spectra (S, L, m)."""
    return np.stack([x if np.iscomplexobj(x) else motion.lines(x) for x in signals], axis=-1)


def _whole_sums(stage: _Stage, g: int, units: np.ndarray, wound: np.ndarray | None = None) -> _Sums:
    """Sums of output spectra (S, L, n + M, m).

    Args:
        wound: (S, joints, m) constant torques in the gears that go with them and move the arm to another posture.
    """
    X = stage.fit.weights.apply(g, stage.problem.groups[g].observe_outputs(units))
    moved = stage.moved[g]
    if wound is not None and moved is not None:
        X = X + np.einsum("skoj,sjm->skom", moved, wound)
    X = X.reshape(-1, units.shape[-1])
    J, r = (x.reshape(-1, x.shape[-1]) for x in (stage.columns[g], stage.residuals[g]))
    return _Sums((X.conj().T @ X).real, (X.conj().T @ r).real, (J.conj().T @ X).real)


def _line_sums(parts: Sequence[tuple[_Field, np.ndarray]]) -> _Sums:
    """Sums of signals (S, K, m) that act through fields at the same time, line by line."""
    first, m = parts[0][0], parts[0][1].shape[-1]
    p, R = first.columns.shape[-1], first.residuals.shape[-1]
    own, with_residuals, with_columns = np.zeros((m, m)), np.zeros((m, R)), np.zeros((p, m))
    for field, X in parts:
        flat, mean = X.reshape(-1, X.shape[-1]), X[:, 0].real
        for other, Y in parts:
            weight = np.sum(field.torque.conj() * other.torque, axis=-1)[:, None]
            own = own + (flat.conj().T @ (weight * Y).reshape(flat.shape)).real
            if np.any(other.moved):
                along = np.einsum("kn,skn->sk", field.torque.conj(), other.moved)
                across = np.einsum("skm,sk->sm", X.conj(), along).real.T @ Y[:, 0].real
                both = np.sum(field.moved.conj() * other.moved, axis=(1, 2)).real
                own = own + across + across.T + mean.T @ (both[:, None] * Y[:, 0].real)
        residuals, columns = (x.reshape(len(flat), -1) for x in (field.residuals, field.columns))
        with_residuals = with_residuals + (flat.conj().T @ residuals).real + mean.T @ field.moved_residuals
        with_columns = with_columns + (columns.conj().T @ flat).real + field.moved_columns.T @ mean
    return _Sums(own, with_residuals, with_columns)


def _start(start, c, h: Hypothesis, shape, problem: Problem) -> np.ndarray | None:
    if "hinge" in h.options:
        return (
            None
            if c[0] < MISSING
            else h.options["hinge"](problem.structure, problem.groups[0], *shape, softer=float(np.clip(c[0], 0.2, 3.0)))
        )
    p = start(c)
    return None if p is None or not np.all(np.isfinite(p)) else np.asarray(p, float)


def _gain(pred: Prediction, channel: str, joint: int) -> np.ndarray:
    """Recorded torque and link positions per unit of a signal of a channel at a joint; (L, n + M)."""
    plane = pred.plane
    if channel == "motor":
        return plane.output_per_motor[:, :, joint]
    if channel == "spring":
        return plane.output_per_spring[:, :, joint]
    if channel == "link":
        return plane.output_per_load[:, :, pred.structure.driven[joint]]
    if channel == "position":
        return plane.output_per_position[:, :, joint]
    lines, outputs, _ = plane.output_per_motor.shape
    return np.broadcast_to(np.eye(outputs, dtype=complex)[joint], (lines, outputs))


def _share_of_gears(pred: Prediction, channel: str, joint: int) -> np.ndarray:
    """(joints,) constant torques in the gears that move the arm as the mean of a signal of a channel at a joint
    does."""
    each = np.eye(pred.structure.n)[joint]
    if channel == "spring":
        return each
    if channel == "link":
        return -each
    if channel == "position":
        return pred.plane.C[0].real * pred.par.coupling[:, joint]
    return 0.0 * each
