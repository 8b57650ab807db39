"""What noise of the records becomes in the torque beyond the linear arm, where a model has laws that are not linear."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ident.extended import Prediction, predict_at
from ident.group import NOISE_LINES, Group, mean_over_lines, signal_share
from ident.hypotheses import kernels
from ident.model import Effect, has_loop, joints_along_record, simulated_laws
from ident.motion import Solution
from ident.reactions import motion_per_position, noise_of_motion

NOISE_DRAWS = 4  # of the noise that laws of the gear answer to
JUMP = 4.0  # power of what noise makes of a law, over that along the motion as it is, beyond which the arm jumps
LEAST_GAIN = 1e-3  # of a gear, torque at the motor per torque in parallel with its spring, that noise is divided by


def law_noise(pred: Prediction, group: Group) -> np.ndarray:
    """(L, n) power that the error of the motion shown to laws at the motors leaves in the torque, N2 m2.

    A friction that turns within a small velocity carries the noise of a motor that stands still
    with the slope of the turn. By one draw, over all records, of what the motion that laws see is off.
    """
    out = np.zeros(pred.U.shape[1:])
    at_motor = [e for e in pred.model.effects if e.hypothesis.channel == "motor"]
    if not at_motor:
        return out
    rng = np.random.default_rng(0)
    draw = rng.normal(size=(2, *pred.U.shape)) * np.sqrt(0.5 * group.shown_error)
    seen = pred.motion()
    motions = replace(seen, error=draw[0] + 1j * draw[1]), seen
    for effect in at_motor:
        j = effect.hypothesis.joint
        off, as_seen = (effect.hypothesis.law(effect.p, x, j, pred.par.stiffness[j]) for x in motions)
        change = pred.plane.record * seen.lines(off - as_seen)
        out[:, j] += mean_over_lines(np.mean(np.abs(change) ** 2, axis=0), NOISE_LINES)
    return out


def loop_noise(pred: Prediction, group: Group) -> np.ndarray | None:
    """(L, n, n) covariance beyond that of the linear arm of what laws leave that move the arm; None where there are
    none.

    A gear that is stiff now and loose then passes the noise of the position on with each in turn: what its mean slope
    passes on is less, and at other lines. By ``NOISE_DRAWS`` over all records, of the torque at the law; no more than
    ``JUMP`` times what it is along the motion as it is: a jump to another steady motion is no noise to bear with.
    """
    loops = [e for e in pred.model.effects if has_loop(e)]
    if not loops or group.window is not None or joints_along_record(pred.model, group):
        return None
    rng = np.random.default_rng(0)
    draws = rng.normal(size=(NOISE_DRAWS, 2, *pred.U.shape))
    positions = (draws[:, 0] + 1j * draws[:, 1]) * np.sqrt(0.5 * group.position_noise)
    arm = simulated_laws(pred.model)
    arm = replace(arm, effects=tuple(e for e in arm.effects if e.hypothesis.channel not in ("motor", "drive")))
    held: dict[str, Any] = {"W": pred.solution.W, "steps": 0, "torques": pred.solution.torques}
    at_hand = arm, pred.structure, pred.par, pred.plane
    moved = [predict_at(*at_hand, replace(group, Q=group.Q + x), pred.sampling, **held).solution for x in positions]
    out = np.zeros((*pred.U.shape[1:], pred.U.shape[2]), complex)
    for place in sorted({(e.hypothesis.joint, e.hypothesis.channel) for e in loops}):
        here = [e for e in loops if (e.hypothesis.joint, e.hypothesis.channel) == place]
        at = _place_of(here, pred, pred.solution)
        x = group.to_time(at.motion[..., None])[..., 0]
        slopes = sum((kernels.mean_slope(law, x) for law in at.laws), np.zeros(len(x)))
        slope, softened = slopes.mean(), np.ones_like(at.compliance)
        softened[1:] = 1.0 / (1.0 + at.compliance[1:] * slope)  # the mean has no noise
        free = at.motion + at.compliance * at.torque
        share = signal_share(free, noise_of_motion(group, at.per_position))
        there = share * free - at.compliance * at.torque
        answer, (held_still, as_it_moves) = _along(at.laws, group, there), np.zeros((2, len(softened)))
        for position, solution in zip(positions, moved, strict=True):
            step = softened * np.einsum("li,sli->sl", at.per_position, position)
            along = _along(at.laws, group, there + share * step) - answer + slopes[:, None] * (1.0 - share) * step
            new = _place_of(here, pred, solution).torque - at.torque
            held_still += np.mean(np.abs(along - slope * step) ** 2, axis=0) / NOISE_DRAWS
            as_it_moves += np.mean(np.abs((new - slope * step) / softened) ** 2, axis=0) / NOISE_DRAWS
        power = np.minimum(*(f * mean_over_lines(p, NOISE_LINES) for f, p in ((JUMP, held_still), (1.0, as_it_moves))))
        passed = (pred.plane.record * softened)[:, None] * pred.filters[0] * at.per_torque
        out += power[:, None, None] * passed[:, :, None] * passed[:, None, :].conj()
    return out


def record_noise(pred: Prediction, group: Group) -> np.ndarray | None:
    """(L, n, n) covariance beyond that of the linear arm where gears answer to the recorded torque; None where none
    does.

    Of all that noise leaves through laws, those at the motors too: by ``NOISE_DRAWS`` over all records.
    """
    joints = sorted(joints_along_record(pred.model, group))
    if not joints:
        return None
    rng = np.random.default_rng(0)
    # Taken off before the mean over lines, and put back: the gain of a gear is sharp at its resonance.
    passed: np.ndarray = np.ones(pred.U.shape[1:])
    for j in joints:
        passed[:, j] = np.maximum(np.abs(pred.plane.spring_gain[:, j, j]), LEAST_GAIN)
    more = np.zeros((*passed.shape, passed.shape[1]), complex)
    for _ in range(NOISE_DRAWS):
        draw = rng.normal(size=(4, *pred.U.shape))
        position = (draw[0] + 1j * draw[1]) * np.sqrt(0.5 * group.position_noise)
        torque = (draw[2] + 1j * draw[3]) * np.sqrt(0.5 * group.torque_noise)
        moved = replace(group, Q=group.Q + position, U=group.U + torque)
        there = predict_at(
            pred.model, pred.structure, pred.par, pred.plane, moved, pred.sampling, W=pred.solution.W, steps=0
        )
        linear = torque - np.einsum("lij,slj->sli", pred.sampled_impedance, position)
        for x, sign in ((torque + pred.U - there.U, 1.0), (linear, -1.0)):
            more += sign * np.einsum("sli,slj->lij", x / passed, x.conj() / passed) / len(x) / NOISE_DRAWS
    return passed[:, :, None] * mean_over_lines(more, NOISE_LINES) * passed[:, None, :]


@dataclass(frozen=True)
class _Place:
    """Where laws move the arm by which they are moved: a gear, or a link.

    Attributes:
        laws: that act there.
        motion, torque: (S, L) deflection of the gear or position of the link, rad, and torque of all laws there, N m.
        compliance: (L,) of the arm there, rad per N m; per_position: (L, n) motion there per motor position;
        per_torque: (L, n) motor torque per torque there.
    """

    laws: tuple[kernels.Law, ...]
    motion: np.ndarray
    torque: np.ndarray
    compliance: np.ndarray
    per_position: np.ndarray
    per_torque: np.ndarray


def _place_of(effects: Sequence[Effect], pred: Prediction, solution: Solution) -> _Place:
    """That of the effects at one place of a model, as it moves in a solution."""
    plane, h, j = pred.plane, effects[0].hypothesis, effects[0].hypothesis.joint
    c, gear = pred.structure.driven[j], h.channel != "link"
    compliance, moved = plane.A_inv[:, c, c], motion_per_position(pred.structure, pred.par, plane, j, gear=gear)
    torques = solution.torques.spring if gear else solution.torques.link
    assert isinstance(torques, np.ndarray)  # there are laws
    if gear:
        laws = tuple(e.hypothesis.law(e.p, None, pred.par.stiffness[j]) for e in effects)
        return _Place(laws, solution.delta[..., j], torques[..., j], compliance, moved, plane.spring_gain[:, :, j])
    laws = tuple(e.hypothesis.options["loop"](e.p) for e in effects)
    return _Place(laws, solution.Q_driven[..., j], torques[..., c], compliance, moved, plane.link_gain[:, :, c])


def _along(laws: Sequence[kernels.Law], group: Group, motion: np.ndarray) -> np.ndarray:
    """Spectrum (S, L) of the torque of laws along a motion (S, L) as it is."""
    x, rate, bend = (group.to_time((s * motion)[..., None])[..., 0] for s in (1.0, 1j * group.omega, -(group.omega**2)))
    torque = sum((kernels.along_motion(law, x, rate + law.lead * bend) for law in laws), np.zeros_like(x))
    return group.to_lines(torque[..., None])[..., 0]
