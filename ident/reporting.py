"""What reports show, computed from fits: where the discrepancy sits, evidence, FRFs, traces."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import scipy.fft

from ident.dataset import Dataset, Segment
from ident.extended import Prediction, predict
from ident.frf import estimate_frf
from ident.group import Group
from ident.leftover import LABELS, SHOWN_WEIGHT, VARIABLES
from ident.model import Effect, Model
from ident.output_noise import noise_covariance
from ident.problem import Problem, output_error, residual
from ident.torque_fit import Fit
from ident.units import text_at
from ident.verdict import EvidencePlot, FrfView, SpectrumMap, TorqueTrace, Where
from robot_assets.errors import DataError
from robot_assets.robot import linear_joints

BANDS = 8
SHOWN_SECONDS = 6.0  # of a period


def where(problem: Problem, fit: Fit, predictions: Sequence[Prediction], least: float = 0.05) -> tuple[Where, ...]:
    """Shares of the whitened discrepancy beyond noise by joint and kind of line, largest first."""
    totals: dict[tuple[str, str, str], float] = {}
    joints = problem.structure.robot.joint_names
    for g, (group, pred) in enumerate(zip(problem.groups, predictions, strict=True)):
        e = fit.weights.apply(g, output_error(group, pred))
        rows = [(name, "tau") for name in joints] + [(joints[j], "q_link") for j in group.links]
        power = np.abs(e) ** 2 - 2.0
        power[:, 0] += 1.0
        line = np.arange(group.n_compared)[None, :]
        kinds = {
            "static torque": line == 0,
            "excited lines": group.excited[:, : group.n_compared],
            "even nonlinear lines": (line % 2 == 0) & (line > 0) & ~group.excited[:, : group.n_compared],
            "odd nonlinear lines": (line % 2 == 1) & ~group.excited[:, : group.n_compared],
        }
        if group.window is not None:
            kinds = {"motion": np.ones_like(line, bool)}
        for kind, mask in kinds.items():
            part = (power * np.broadcast_to(mask, power.shape[:2])[..., None]).sum(axis=(0, 1))
            for power_of_row, row in zip(part, rows, strict=True):
                totals[(*row, kind)] = totals.get((*row, kind), 0.0) + float(max(power_of_row, 0.0))
    whole = sum(totals.values()) or 1.0
    found = [Where(*key, v / whole) for key, v in totals.items() if v / whole >= least]
    return tuple(sorted(found, key=lambda w: -w.share))


def affected_joints(
    problem: Problem, fit: Fit, predictions: Sequence[Prediction], least: float = 0.1
) -> tuple[int, ...]:
    """Joints that carry at least a share ``least`` of the whitened discrepancy."""
    names = problem.structure.robot.joint_names
    total = dict.fromkeys(names, 0.0)
    for w in where(problem, fit, predictions, least=0.0):
        total[w.joint] += w.share
    return tuple(j for j, name in enumerate(names) if total[name] >= least)


def spectrum_map(problem: Problem, fit: Fit, before: Sequence[Prediction], after: Sequence[Prediction]) -> SpectrumMap:
    """Rms torque residual by operating point, joint and band."""
    top = max(g.omega[g.n_compared - 1] for g in problem.groups) / 2 / np.pi
    edges = np.geomspace(max(top / 200, 0.05), top * 1.0001, BANDS + 1)
    edges[0] = 0.0
    out = np.zeros((3, len(problem.groups), problem.structure.n, BANDS))
    for g, group in enumerate(problem.groups):
        frequency = group.omega[: group.n_compared] / 2 / np.pi
        band = np.clip(np.searchsorted(edges, frequency, side="right") - 1, 0, BANDS - 1)
        weight = np.where(frequency > 0, 2.0, 1.0)[:, None]
        pred = after[g]
        noise = np.einsum("kii->ki", noise_covariance(problem, group, pred)).real
        powers = [np.mean(np.abs(residual(group, p)) ** 2, axis=0) for p in (before[g], pred)]
        for i, power in enumerate([*powers, noise]):
            np.add.at(out[i, g].T, band, power * weight)
    rms_before, rms_after, rms_noise = np.sqrt(out)
    return SpectrumMap(edges, rms_before, rms_after, rms_noise, tuple(g.operating_point for g in problem.groups))


def frf_views(
    dataset: Dataset, problem: Problem, before: Sequence[Prediction], after: Sequence[Prediction]
) -> tuple[FrfView, ...]:
    """Measured FRFs with those of the baseline and extended models, where they can be formed.

    A model's FRF is what the same estimator makes of the torque that the model predicts along the
    measured motion, so that nonlinear effects count as they do in the measured one.
    """
    try:
        frf = estimate_frf(dataset)
        models = [
            estimate_frf(with_torque(dataset, problem, preds), estimator=frf.estimator) for preds in (before, after)
        ]
    except DataError:
        return ()
    return tuple(
        FrfView(point, frf.frequency, frf.G[i], frf.total_std[i], *(m.G[i] for m in models))
        for i, point in enumerate(frf.operating_points)
    )


def with_torque(dataset: Dataset, problem: Problem, predictions: Sequence[Prediction]) -> Dataset:
    """The dataset with the torque of its periodic records replaced by the predicted one."""
    spectra = {
        name: U
        for group, pred in zip(problem.groups, predictions, strict=True)
        if group.window is None
        for name, U in zip(group.segments, pred.U, strict=True)
    }

    def replaced(s: Segment) -> Segment:
        if s.name not in spectra:
            return s
        period = scipy.fft.irfft(spectra[s.name], n=s.period, axis=0, norm="forward")
        whole = np.tile(period, (s.transient_periods + s.steady_periods, 1))
        return replace(s, tau=whole)

    return replace(dataset, segments=tuple(replaced(s) for s in dataset.segments))


def torque_traces(groups: Sequence[Group], pairs: Sequence[tuple[Prediction, Prediction]]) -> tuple[TorqueTrace, ...]:
    """Measured and predicted torque in time as they are compared, for the first segment of each group; of a motion
    without its ends, which are not compared. What is there is taken away before the lines are cut, or it would ring."""
    out = []
    for group, (a, b) in zip(groups, pairs, strict=True):
        signals = [group.to_time(group.observe(X[:1]))[0] for X in (group.U, a.U, b.U, group.Q)]
        t = np.arange(group.n_time) * group.period_time / group.n_time
        show = t <= SHOWN_SECONDS
        if group.window is not None:
            show = group.window >= SHOWN_WEIGHT
        out.append(TorqueTrace(group.segments[0], t[show], *(s[show] for s in signals)))
    return tuple(out)


def evidence_plot(
    problem: Problem, fit: Fit, predictions: Sequence[Prediction], effect: Effect, cause: int
) -> EvidencePlot:
    """Residual torque without one effect, the ``cause`` of that number, against the variable that explains it, and with
    it.

    Of a gear whose link encoder is compared, what that shows beside the model: its torque hardly does.
    """
    h = effect.hypothesis
    rest = Model(fit.model.structure, fit.model.par, tuple(e for e in fit.model.effects if e is not effect))
    bare = [predict(rest, group, problem.sampling) for group in problem.groups]
    j, n = h.joint if h.joint >= 0 else most_affected(problem, bare), problem.structure.n
    by_link = h.channel == "spring" and all(j in group.links for group in problem.groups)
    xs: list[np.ndarray] = []
    ys: list[np.ndarray] = []
    ms: list[np.ndarray] = []
    for group, pred, without in zip(problem.groups, predictions, bare, strict=True):
        motion = pred.motion()
        band = slice(group.n_compared, None)
        curves = []
        row = n + group.links.index(j) if by_link else j
        for outputs in (group.outputs, pred.outputs()):
            X = (outputs - without.outputs())[..., row : row + 1]
            X[:, band] = 0.0
            curves.append(group.to_time(X)[..., 0])
        if h.variable in VARIABLES:
            variable = VARIABLES[h.variable](motion, j)
        elif h.variable == "swing":
            variable = motion.q(j) - motion.q(j).mean(axis=1, keepdims=True)
        else:
            variable = motion.time if h.variable == "time" else curves[1]
        # A motion is closed by a return that nobody recorded.
        recorded = slice(None) if group.window is None else group.window > 0.5
        if by_link:  # the zero of the encoder is not known
            curves[0] += (curves[1] - curves[0])[:, recorded].mean(axis=1, keepdims=True)
        step = max(1, variable.size // (1500 // max(len(problem.groups), 1) + 1))
        for store, signal in ((xs, variable), (ys, curves[0]), (ms, curves[1])):
            store.append(signal[:, recorded].ravel()[::step])
    x, y, m = (np.concatenate(v) for v in (xs, ys, ms))
    order = np.argsort(x)
    label = LABELS.get(h.variable, "fitted effect, N m")
    if h.variable in ("posture", "frequency"):
        label = "torque of the fitted effect, N m"
    joint, linear = problem.structure.robot.joint_names[j], linear_joints(problem.structure.robot)[j]
    shown = f"link encoder of {joint} beside the model, rad" if by_link else f"residual torque of {joint}, N m"
    title = f"{h.effect.replace('_', ' ')} at {h.place}"
    return EvidencePlot(cause, title, text_at(label, linear), text_at(shown, linear), x, y, x[order], m[order])


def most_affected(problem: Problem, bare: Sequence[Prediction]) -> int:
    """The joint at which predictions are furthest off, over the torque that moves it, all postures together."""
    pairs = list(zip(problem.groups, bare, strict=True))
    off = sum(np.sum(np.abs(group.U - pred.U) ** 2, axis=(0, 1)) for group, pred in pairs)
    moving = sum(np.sum(np.abs(group.U[:, 1:]) ** 2, axis=(0, 1)) for group, _ in pairs)
    return int(np.argmax(off / np.maximum(moving, 1e-300)))
