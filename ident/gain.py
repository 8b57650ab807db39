"""Gain of an extended model: torque prediction on segments that no model was fitted to."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from ident.extended import Prediction, predict
from ident.group import Group
from ident.inverse import REMAINDER_STEPS
from ident.model import Model, along_record
from ident.motion import Torques
from ident.output_noise import noise_covariance
from ident.problem import NOT_COMPUTED, Problem
from ident.stiction import as_held, held_share
from ident.units import common_unit
from ident.verdict import Gain, JointGain

METRIC = "RMS motor-torque prediction error"
CLEARLY = 0.8  # of what one motion leaves of a record, that another must leave for it to be the recorded one
STRETCHES = 8  # of a motion
RESAMPLES = 2000


@dataclass(frozen=True)
class Errors:
    """Mean squared torque error of each segment, each stretch of a motion or each line, and joint, N2 m2; each (rows,
    n).

    ``segments``: of the rows, a motion as often as it has stretches, a single periodic record as often as it has lines.
    ``told_by_torque``: records whose steady motion after is one that their torque told. ``along``: as ``after`` and
    ``noise``, but along the record where laws of the gear are clearly nearer to that: what they are, whichever motion a
    loop settles in.
    """

    segments: tuple[str, ...]
    before: np.ndarray
    after: np.ndarray
    noise: np.ndarray
    told_by_torque: tuple[str, ...] = field(default=(), kw_only=True)
    along: tuple[np.ndarray, np.ndarray] | None = field(default=None, kw_only=True)

    def seen_along(self) -> Errors:
        """The same with the errors after that are left along the record, and their noise."""
        return self if self.along is None else replace(self, after=self.along[0], noise=self.along[1], along=None)


@dataclass(frozen=True)
class Told:
    """A prediction in which each record makes that of several steady motions which its torque tells.

    ``records`` (S,): whether one makes another than that which was predicted. ``rattles`` (S,): whether it makes none to
    which the model is led, so that a prediction ``along`` the record is clearly nearer.
    """

    prediction: Prediction
    records: np.ndarray
    rattles: np.ndarray
    along: Prediction


def in_recorded_motion(pred: Prediction) -> Told:
    """A prediction in the steady motion that the recorded torque tells.

    Under a law of the gear that bends, as a cubic one, the links may swing in two ways along one motion of the motors;
    begun from nothing the model may find the other. Where a gear rattles there are many, and the model need not be led
    to the one that was recorded.
    """
    model, group = pred.model, pred.group
    bent = [e.hypothesis.channel == "spring" and "bends" in e.hypothesis.options for e in model.effects]
    none = np.zeros(len(group.U), bool)
    as_it_is = Told(pred, none, none, pred)
    if group.window is not None or not any(bent):
        return as_it_is
    along = tuple(
        replace(e, hypothesis=along_record(e.hypothesis)) if bends else e
        for e, bends in zip(model.effects, bent, strict=True)
    )
    try:
        told = predict(replace(model, effects=along), group, pred.sampling)
        start = told.solution
        other = predict(model, group, pred.sampling, W=start.W, torques=start.torques, steps=REMAINDER_STEPS)
        nearer, chosen = _left_of(other) < CLEARLY * _left_of(pred), pred
        if np.any(nearer):
            a, b, here = pred.solution, other.solution, nearer[:, None, None]
            torques = Torques(  # from which loops begin
                np.where(here, b.torques.spring, a.torques.spring),
                np.where(here, b.torques.link, a.torques.link),
                np.where(here, b.torques.motor, a.torques.motor),
            )
            W = np.where(here, b.W, a.W)
            chosen = predict(model, group, pred.sampling, W=W, torques=torques, steps=REMAINDER_STEPS)
    except NOT_COMPUTED:
        return as_it_is
    rattles = _left_of(told) < CLEARLY * _left_of(chosen)
    return Told(chosen, nearer & ~rattles, rattles, told)


def _left_of(pred: Prediction) -> np.ndarray:
    """What a prediction leaves of each record, (S,) N2 m2."""
    return np.sum(np.abs(pred.group.observe(pred.group.U - pred.U)) ** 2, axis=(1, 2))


def segment_errors(
    problem: Problem, groups: Sequence[Group], before: Model, after: Model, *, alone: bool = True
) -> tuple[Errors, list[tuple[Prediction, Prediction]]]:
    """Prediction errors in the compared band, before and after, and the noise in it.

    Along a motion too large for a model its links cannot be solved; such a group is left out of the
    errors of both models, and of the pairs of predictions. Where there are motions alone, each is cut into
    ``STRETCHES``: one of them says by its parts how much chance there is in what is gained. A periodic record that
    stands alone says it by its lines: under random phases errors at different lines are independent (Pintelon and
    Schoukens 2012, ch. 3). Its periods do not: the error of the model is the same in each, and they would show noise
    alone.

    Args:
        alone: whether the groups are all that is held out.
    """
    motions = all(group.window is not None for group in groups)
    parts = STRETCHES if motions else 1
    by_line = alone and not motions and sum(len(group.segments) for group in groups) == 1
    names: list[str] = []
    out: list[list[np.ndarray]] = [[], [], [], [], []]
    pairs = []
    by_torque: tuple[str, ...] = ()
    for group in groups:
        try:
            a = predict(before, group, problem.sampling)
            told = in_recorded_motion(predict(after, group, problem.sampling))
        except FloatingPointError:
            continue
        b = told.prediction
        by_torque += tuple(group.segments[i] for i in np.flatnonzero(told.records))
        pairs.append((a, b))
        share, rattles = group.window_share, told.rattles[:, None, None]
        noise = share * _noise_of_lines(problem, b)[None].repeat(len(group.segments), axis=0)
        noise_along = noise
        if np.any(told.rattles):
            noise_along = np.where(rattles, share * _noise_of_lines(problem, told.along), noise)
        errors = [group.observe(group.U - U) for U in (a.U, b.U, np.where(rattles, told.along.U, b.U))]
        if by_line:
            names += group.segments * group.n_compared
            for store, lines in zip(out, (*(np.abs(e) ** 2 for e in errors), noise, noise_along), strict=True):
                store.append(line_squares(lines[0]))
            continue
        names += [name for name in group.segments for _ in range(parts)]
        for store, e in zip(out[:3], errors, strict=True):
            store.append((mean_squares(np.abs(e) ** 2) if parts == 1 else stretch_squares(group, e, parts)) / share)
        for store, lines in zip(out[3:], (noise, noise_along), strict=True):
            store.append(np.repeat(mean_squares(lines) / share, parts, axis=0))
    left, left_after, along, floor, floor_along = (
        np.concatenate(x) if x else np.zeros((0, len(problem.nominal.stiffness))) for x in out
    )
    told_along = along, floor_along
    return Errors(tuple(names), left, left_after, floor, told_by_torque=by_torque, along=told_along), pairs


def _noise_of_lines(problem: Problem, pred: Prediction) -> np.ndarray:
    """Variance (K, n) of the compared lines of a prediction by noise, N2 m2."""
    S = as_held(noise_covariance(problem, pred.group, pred), held_share(pred, pred.group))
    return np.einsum("kii->ki", S).real


def mean_squares(lines: np.ndarray) -> np.ndarray:
    """Mean squares (S, n) of signals from the squared moduli (S, K, n) of their lines, line 0 first."""
    return lines[:, 0] + 2 * lines[:, 1:].sum(axis=1)


def line_squares(lines: np.ndarray) -> np.ndarray:
    """Shares of lines (K, n) in a mean square, from their squared moduli (K, n), line 0 first; their mean over lines is
    that square."""
    return len(lines) * np.concatenate([lines[:1], 2.0 * lines[1:]])


def stretch_squares(group: Group, lines: np.ndarray, parts: int) -> np.ndarray:
    """Mean squares (parts, n) of a windowed motion from its lines (1, K, n), by stretches of time; their mean is that
    of the whole."""
    assert group.window is not None
    full = np.zeros((1, len(group.omega), lines.shape[2]), complex)
    full[:, : lines.shape[1]] = lines
    squares = group.to_time(full)[0] ** 2
    inside = int(np.flatnonzero(group.window).max()) + 1
    edges = np.linspace(0, inside, parts + 1).astype(int)
    edges[-1] = len(squares)
    return np.add.reduceat(squares, edges[:-1], axis=0) * parts / len(squares)


def measure_gain(
    errors: Errors,
    joints: Mapping[str, str],
    affected: Sequence[int],
    method: str,
    rng: np.random.Generator,
    metric: str = METRIC,
) -> Gain | None:
    """Rms errors, share of the gap to the noise floor that is closed, and its 95 % interval.

    The interval is a percentile bootstrap over segments, over stretches of motions, or over the lines of a single
    periodic record: what other phases of the same excitation would show in that posture, and nothing of other postures.
    It is as wide as errors of one size at all lines ask for, and wider than needed where few of them hold most; None
    where so many resamples have no gap that it has no end. The gain is None where no segment could be predicted.

    Args:
        joints: unit of the torque of each.
        affected: the joints over which errors are taken: those that carry the discrepancy in the
            identification data (all where there is none), so that the noise of a large joint does
            not hide what is gained at a small one. ``by_joint`` tells all of them.
        metric: what the errors are of, to which their unit is added.
    """
    if not errors.segments:
        return None
    rows = (errors.before, errors.after, errors.noise)
    by_joint = {name: JointGain(*(float(np.sqrt(np.mean(x[:, j]))) for x in rows)) for j, name in enumerate(joints)}
    pick_joints = list(affected) if len(affected) else list(range(len(joints)))
    n = len(pick_joints)
    errors = Errors(errors.segments, *(x[:, pick_joints].sum(axis=1) for x in rows))

    def rms(x: np.ndarray) -> float:
        return float(np.sqrt(np.mean(x) / n))

    before, after, noise = rms(errors.before), rms(errors.after), rms(errors.noise)
    gap = before - noise
    closed = (before - after) / gap if gap > 0.02 * noise else None
    interval, worse = None, False
    if closed is not None and len(errors.segments) > 1:
        pick = rng.integers(len(errors.segments), size=(RESAMPLES, len(errors.segments)))
        b, a, f = (np.sqrt(x[pick].mean(axis=1) / n) for x in (errors.before, errors.after, errors.noise))
        interval = _interval_of_ratio(b - a, b - f)
        worse = bool(np.mean(a > b) > 0.975)
    told, of = tuple(dict.fromkeys(errors.segments)), tuple(list(joints)[j] for j in pick_joints)
    unit = common_unit(joints[name] for name in of)
    return Gain(told, f"{metric}, {unit}", before, after, noise, closed, interval, method, of, by_joint, worse)


def _interval_of_ratio(gained: np.ndarray, gap: np.ndarray) -> tuple[float, float] | None:
    """95 % interval of what is gained over the gap, of resamples; None where it has no end.

    A resample without a gap says nothing of its share that is closed: it counts at either end.
    """
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio = gained / gap
    ends = [np.where(gap > 0.0, ratio, worst) for worst in (-np.inf, np.inf)]
    low, high = (float(np.quantile(x, q, method="inverted_cdf")) for x, q in zip(ends, (0.025, 0.975), strict=True))
    return (low, high) if np.isfinite([low, high]).all() else None


def ratio_interval(errors: Errors, rng: np.random.Generator, level: float) -> tuple[float, float]:
    """Interval of this level of the squares left after, over those left before, at each joint no less than noise;
    geometric mean over the joints.

    A percentile bootstrap over the rows of ``errors``; (0, inf) where there are too few for one.
    """
    if len(errors.segments) < 2:
        return 0.0, np.inf
    pick = rng.integers(len(errors.segments), size=(RESAMPLES, len(errors.segments)))
    before, after, noise = (x[pick].mean(axis=1) for x in (errors.before, errors.after, errors.noise))
    logs = np.log(np.maximum(after, noise)) - np.log(np.maximum(before, noise))
    low, high = np.quantile(np.exp(logs.mean(axis=1)), [0.5 - 0.5 * level, 0.5 + 0.5 * level])
    return float(low), float(high)
