"""Derivatives of the compared outputs by the fitted coordinates, and the normal equations that they make."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import Any

import numpy as np

from ident.columns import Columns, Products
from ident.coordinates import coordinate_names, moves_geometry, moves_links, pack, shifts_posture, unpack
from ident.errors_in_variables import impedance_slopes, scatter_information, scatter_slope
from ident.extended import Prediction, of_channel, predict, predict_at, through_drives
from ident.group import Group
from ident.inverse import Plane, along_motion, baseline_products
from ident.model import Effect, Model, is_dry, joints_along_record
from ident.motion import Motion
from ident.parallel import map_threads
from ident.posture import moved_by_posture
from ident.problem import Problem, Weights, compared_lines, output_error
from ident.reactions import beside
from ident.stiction import as_free, held

TIMING_STEP = 1e-6  # s, for differences
BASELINE_STEP = 1e-3  # of logarithms, for differences
STEPS_ALONG_MOTION = 4  # of the links beside a model near by: what they move beyond the solved lines is not in one


def jacobian(
    problem: Problem, model: Model, group: Group, pred: Prediction, *, exact: bool = False, shifts: bool = False
) -> Columns:
    """Derivative of the predicted outputs by the fitted coordinates, at the lines that are compared.

    Args:
        exact: what moves the links moves the torques of all laws of the gears and the geometric remainder. Both are
            held without, which beside such laws ends short of the minimum, and tells of less spread than there is.
        shifts: what moves the arm to another posture moves all lines, to first order, where the remainder is held.
    """
    # With the remainder held derivatives point elsewhere where it took the links along their motion to find it.
    pred = along_its_motion(pred)
    exact = exact or pred.solution.torques.varying is not None
    m = len(model.par.to_log())
    top = compared_lines(group)
    motion = group.window is not None
    # Along a motion softer gears move gravity and inertia too; link encoders show the links themselves.
    sway = range(model.structure.n) if motion and not group.links else ()
    near = _Near(problem, model, group, pred)
    posture = moved_by_posture(pred)[:, :top] if shifts and not exact and not motion else None
    n, base = model.structure.n, _baseline(model, pred, pred.plane, top)
    late = np.zeros((len(pred.U), top, n + len(group.links)), complex)
    late[..., :n] = pred.plane.s[:top, None] * pred.solution.U[:, :top]
    baseline = Columns(base, np.arange(m), late[..., None], np.array([m]))
    if posture is not None:
        baseline = baseline.replaced(_sagging(baseline, pred, posture))
    baseline = baseline.replaced(_passed_on(baseline, model, pred))
    baseline = baseline.replaced(_differences(near, sway, exact, posture))
    if not problem.free_timing:
        baseline.whole[..., baseline.whole_at == m] = 0.0
    effects = [column for i in range(len(model.effects)) for column in _effect_columns(near, i, exact, posture)]
    columns = baseline.replaced({m + 1 + i: column for i, column in enumerate(effects)})
    still = held(pred, group)
    if still is None:
        return columns
    # Differences of laws at the motors have it in them.
    dense, at_motors = columns.dense(), np.array([e.hypothesis.channel == "motor" for e in model.effects for _ in e.p])
    passed = np.flatnonzero(np.concatenate([np.ones(m + 1, bool), ~at_motors]))
    for j in np.flatnonzero(np.any(still, axis=(0, 1))):
        dense[:, :, j, passed] = as_free(dense[:, :, j, passed], still[..., j], group)
    return columns.made_whole(dense)


def _baseline(model: Model, pred: Prediction, plane: Plane, top: int) -> Products:
    """Derivatives by the log-parameters of the model, without those of hinges that its effects add, of a linear
    arm."""
    n, n_e = model.structure.n, len(model.structure.elastic)
    extra = len(pred.structure.elastic) - n_e
    keep = np.r_[: 4 * n + n_e, 4 * n + n_e + extra : 4 * n + extra + 2 * n_e]
    return baseline_products(pred.structure, pred.par, plane, pred.solution, top).pick(keep)


@dataclass(frozen=True)
class _Near:
    """Differences of predictions to those of models near by, from the geometric remainder and torques of ``pred``."""

    problem: Problem
    model: Model
    group: Group
    pred: Prediction

    def again(self, model: Model, steps: int) -> Prediction:
        """What a model near by predicts, with the geometric remainder ``steps`` on; more of them along the motion."""
        W, torques = self.pred.solution.W, self.pred.solution.torques
        if torques.varying is not None:
            steps *= STEPS_ALONG_MOTION
        return predict(model, self.group, self.problem.sampling, W=W, steps=steps, torques=torques, near=self.pred)

    @cached_property
    def remade(self) -> Prediction:
        """The model itself, with the remainder one step on."""
        return self.again(self.model, 1)

    @cached_property
    def remade_bare(self) -> Prediction:
        """The same ``without_friction``."""
        return self.again(without_friction(self.model, self.group), 1)

    def change_of_links(self, there: Model) -> np.ndarray:
        """(S, K, n + M) change of the compared outputs, one step on, to a model whose links move otherwise along the
        same motion of the motors."""
        return _change(self.group, self.again(without_friction(there, self.group), 1), self.remade_bare, None)


def along_its_motion(pred: Prediction) -> Prediction:
    """A prediction with the links linearised along the very motion that it found, where that took such and an arm can
    move so."""
    solution = pred.solution
    varying = solution.torques.varying
    if varying is None:
        return pred
    records = varying.records
    try:
        varying = along_motion(pred.structure, pred.par, pred.plane, pred.group, records, solution.Q_a[records])
    except FloatingPointError:
        return pred
    return replace(pred, solution=replace(solution, torques=replace(solution.torques, varying=varying)))


def without_friction(model: Model, group: Group) -> Model:
    """A model without dry friction that only the motion of its motor moves.

    What moves the links changes that at rest alone, where ``stiction.held`` says so; elsewhere it is in both sides of a
    difference, and takes most of the time.
    """
    if joints_along_record(model, group):
        return model  # what is at the motor tells the deflection
    laws = [e.hypothesis for e in model.effects]
    moved = {h.joint for h in laws if h.channel == "drive" or h.options.get("sees_load")}
    kept = tuple(e for e in model.effects if not is_dry(e) or e.hypothesis.joint in moved)
    return model if len(kept) == len(model.effects) else replace(model, effects=kept)


def _sagging(columns: Columns, pred: Prediction, posture: np.ndarray) -> dict[int, np.ndarray]:
    """Columns of the stiffness of gears that also let the arm sag to another posture."""
    sag = (
        pred.plane.A_inv[0][:, pred.structure.driven].real
        * (pred.par.stiffness * pred.solution.delta[:, 0].real)[:, None]
    )
    held = columns.products.pick(np.arange(sag.shape[-1])).dense()
    return dict(enumerate(np.moveaxis(held + posture @ sag[:, None], -1, 0)))


def _change(group: Group, there: Prediction, base: Prediction, posture: np.ndarray | None) -> np.ndarray:
    """(S, K, n + M) change of the compared outputs between predictions with one geometric remainder.

    Args:
        posture: of ``moved_by_posture`` at the compared lines, which stands for what the remainder would do; None holds
            it.
    """
    change = (there.outputs() - base.outputs())[:, : compared_lines(group)]
    if posture is None:
        return change
    # A plane of its own stands at another posture already.
    shift = (there.solution.Q_a[:, 0] - base.solution.Q_a[:, 0]).real - (there.plane.lin.q - base.plane.lin.q)
    return change + np.einsum("slon,sn->slo", posture, shift)


def _differences(near: _Near, sway: Iterable[int], exact: bool, posture: np.ndarray | None) -> dict[int, np.ndarray]:
    """Baseline columns (S, L, n + M) of what moves laws of the gear, or with ``exact`` and along motions the links, by
    differences.

    These laws move with the gear's spring and damper; and where the recorded torque says its deflection, with what
    the motor takes of that, and with the timing.

    Args:
        sway: coordinates that move the links along a motion.
    """
    model = near.model
    n, m = model.structure.n, len(model.par.to_log())
    along = joints_along_record(model, near.group)
    gears = {e.hypothesis.joint for e in model.effects if e.hypothesis.gear_law}
    steps = {f * n + j: BASELINE_STEP for j in gears for f in range(4 if j in along else 2)}
    anew = set(np.flatnonzero(moves_links(model)[:m]).tolist() if exact else sway)
    steps |= dict.fromkeys(anew, BASELINE_STEP)
    if along:
        steps[m] = TIMING_STEP
    x = pack(model)

    def column(c: int, step: float) -> np.ndarray:
        there = unpack(model, x + step * (np.arange(len(x)) == c), np.inf)
        if c in anew:
            return near.change_of_links(there) / step
        base = near.remade if exact else near.pred
        return _change(near.group, near.again(there, int(exact)), base, posture) / step

    return {c: column(c, step) for c, step in steps.items()}


def _passed_on(columns: Columns, model: Model, pred: Prediction) -> dict[int, np.ndarray]:
    """Baseline columns of the torque that drives with effects pass on; none where there are no such drives."""
    drives = of_channel(model, "drive")
    if not drives:
        return {}
    dense = columns.dense()
    for effect in drives:
        j, motion = effect.hypothesis.joint, pred.motion()
        full = np.zeros((dense.shape[-1], *pred.U.shape[:2]), complex)
        full[:, :, : dense.shape[1]] = np.moveaxis(dense[:, :, j], -1, 0)
        passed = _change_passed(effect, motion, full)
        dense[:, :, j] = np.moveaxis(passed[:, :, : dense.shape[1]], 0, -1)
    return dict(enumerate(np.moveaxis(dense, -1, 0)))


def _change_passed(drive: Effect, motion: Motion, X: np.ndarray) -> np.ndarray:
    """A change (..., S, L) of the torque before a drive with an effect, as it is after it."""
    h, k = drive.hypothesis, motion.par.stiffness[drive.hypothesis.joint]
    return h.law(drive.p, motion, h.joint, k, X) - h.law(drive.p, motion, h.joint, k, 0 * X)


def _effect_columns(near: _Near, i: int, exact: bool, posture: np.ndarray | None) -> list[np.ndarray]:
    """Derivatives (S, K, n + M) of the predicted outputs by the coordinates of effect ``i``: none by those that the
    group does not feel."""
    model, group, effect = near.model, near.group, near.model.effects[i]
    felt = [group.window is not None or not q.at_start for q in effect.hypothesis.parameters]
    steps = [s for s, f in zip(model.stepped[i], felt, strict=True) if f]
    columns = iter(_effect_differences(near, i, steps, exact, posture))
    none = np.zeros((len(near.pred.U), compared_lines(group), model.structure.n + len(group.links)), complex)
    return [next(columns) if f else none for f in felt]


def _effect_differences(
    near: _Near, i: int, steps: Sequence[tuple[Model, float]], exact: bool, posture: np.ndarray | None
) -> list[np.ndarray]:
    """Change (S, K, n + M) of the predicted outputs by each of some ``steps`` of effect ``i``, over its size; else as
    ``_effect_columns``."""
    model, group, pred = near.model, near.group, near.pred
    effect, top = model.effects[i], compared_lines(group)
    h, moves = effect.hypothesis, [(there.effects[i].p, step) for there, step in steps]
    if h.channel == "motor" and not joints_along_record(model, group):
        return [column[:, :top] for column in _motor_columns(model, group, pred, effect, moves)]
    if h.channel == "drive":
        return [column[:, :top] for column in _drive_columns(model, group, pred, effect, moves)]
    if exact or moves_geometry(effect, group.window is not None):
        if h.channel != "position":
            return [near.change_of_links(there) / step for there, step in steps]
        base, posture = near.remade, None
        moved = [near.again(there, 1) for there, _ in steps]
    else:
        base = pred
        held: dict[str, Any] = {"W": pred.solution.W, "torques": pred.solution.torques}
        moved = [
            predict_at(there, pred.structure, pred.par, pred.plane, group, near.problem.sampling, **held)
            for there, _ in steps
        ]
    return [_change(group, there, base, posture) / step for there, (_, step) in zip(moved, steps, strict=True)]


def _motor_columns(
    model: Model, group: Group, pred: Prediction, effect: Effect, steps: Sequence[tuple[np.ndarray, float]]
) -> list[np.ndarray]:
    """Derivatives by a law at the motor: the motion does not change, and only its own torque does."""
    h, j = effect.hypothesis, effect.hypothesis.joint
    motion = beside(model.effects, effect, pred.motion())
    k = pred.par.stiffness[j]
    now, columns = h.law(effect.p, motion, j, k), []
    drives = [e for e in of_channel(model, "drive") if e.hypothesis.joint == j]
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
    """Derivatives by a drive with an effect: what it is given does not change."""
    motion, n, columns = pred.motion(), model.structure.n, []
    drives = of_channel(model, "drive")
    for p, step in steps:
        out = np.zeros((*pred.U.shape[:2], n + len(group.links)), complex)
        out[..., :n] = through_drives([replace(e, p=p) if e is effect else e for e in drives], motion) - pred.U
        columns.append(out / step)
    return columns


def jacobians(problem: Problem, model: Model, preds: Sequence[Prediction], *, exact: bool) -> list[Columns]:
    """``jacobian`` of all groups."""
    of = partial(jacobian, problem, model, exact=exact, shifts=shifts_posture(model))
    return map_threads(lambda x: of(*x), zip(problem.groups, preds, strict=True))


def normal_equations(
    problem: Problem, columns: Sequence[Columns], preds: Sequence[Prediction], weights: Weights
) -> tuple[np.ndarray, np.ndarray]:
    """``J^T J`` (p, p) and ``J^T r`` (p,) of the whitened residual, summed over groups.

    Args:
        columns: derivatives of the outputs of each group by the coordinates of the fit.
    """

    def of_group(g: int) -> tuple[np.ndarray, np.ndarray]:
        group = problem.groups[g]
        error = output_error(group, preds[g])
        if group.window is None:
            return columns[g].normal(weights.whiten[g], error)
        J = as_real(weights.apply(g, group.observe_outputs(columns[g].dense())))
        r = as_real(weights.apply(g, error)[..., None])[:, 0]
        return J.T @ J, J.T @ r

    H, b = zip(*map_threads(of_group, range(len(problem.groups))), strict=True)
    return sum(H, np.zeros_like(H[0])), sum(b, np.zeros_like(b[0]))


def shared_slope(problem: Problem, model: Model, preds: Sequence[Prediction], weights: Weights) -> np.ndarray:
    """What noise adds to the right-hand side of ``normal_equations`` (``errors_in_variables``)."""
    m, count = len(model.par.to_log()), len(coordinate_names(model))

    def others(group: Group, pred: Prediction, K: int) -> Iterator[tuple[int, np.ndarray]]:
        if problem.free_timing:
            yield m, pred.plane.s[:K, None, None] * pred.sampled_impedance[:K]
        at = m + 1
        for i, effect in enumerate(model.effects):
            slopes = impedance_slopes(model, group, pred, problem.sampling, i)
            yield from ((at + c, slope) for c, slope in enumerate(slopes))
            at += len(effect.p)

    def of_group(of: tuple[Group, Prediction, np.ndarray]) -> np.ndarray:
        group, pred, whiten = of
        K = len(whiten)
        return scatter_slope(group, pred, whiten, _baseline(model, pred, pred.about, K), others(group, pred, K), count)

    return sum(map_threads(of_group, zip(problem.groups, preds, weights.whiten, strict=True)), np.zeros(count))


def shared_information(problem: Problem, model: Model, preds: Sequence[Prediction], weights: Weights) -> np.ndarray:
    """What noise adds to the normal matrix of the baseline parameters."""
    each = [
        scatter_information(g, pred, whiten, _baseline(model, pred, pred.about, len(whiten)))
        for g, pred, whiten in zip(problem.groups, preds, weights.whiten, strict=True)
    ]
    return sum(each, np.zeros_like(each[0]))


def as_real(X: np.ndarray) -> np.ndarray:
    """Complex (..., p) as real rows (2 x rows, p): real parts, then imaginary parts."""
    X = X.reshape(-1, X.shape[-1])
    out = np.empty((2 * len(X), X.shape[-1]))
    out[: len(X)], out[len(X) :] = X.real, X.imag
    return out
