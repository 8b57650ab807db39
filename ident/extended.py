"""The gray-box with effects: prediction of the recorded torque."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial

import numpy as np

from ident.chain import Structure
from ident.graybox import Parameters, impedance, linearise
from ident.group import Group
from ident.hypotheses import kernels
from ident.hypotheses.hypothesis import Hypothesis
from ident.inverse import (
    REMAINDER_STEPS,
    Plane,
    Sampling,
    drifting_torque,
    make_plane,
    plane_at,
    solve,
    true_position,
)
from ident.model import Effect, Model, has_loop, is_along_record, is_dry, joints_along_record
from ident.motion import Motion, Recorded, Solution, Torques
from ident.reactions import inner_torques, motor_torques

REACTION_STEPS = 8  # passes at most until torques and the motion that they cause agree


@dataclass(frozen=True)
class Prediction:
    """What a model predicts for a group, and what it was computed with.

    Attributes:
        plane: the linear arm that it was computed with.
    """

    model: Model
    group: Group
    sampling: Sampling
    structure: Structure
    par: Parameters
    plane: Plane
    solution: Solution
    U: np.ndarray

    def motion(self) -> Motion:
        """The predicted motion in time, with the torque that its drives deliver."""
        given = delivered(of_channel(self.model, "drive"), self.group, self.plane)
        return replace(self.bare_motion, delivered=given, told=joints_along_record(self.model, self.group))

    def outputs(self) -> np.ndarray:
        """(S, L, n + M) predicted recorded torque, N m, and link positions, rad, as ``Group.outputs``."""
        if not self.group.links:
            return self.U
        return np.concatenate([self.U, self.solution.Q_driven[..., list(self.group.links)]], axis=-1)

    @property
    def bare_motion(self) -> Motion:
        """The predicted motion in time, as laws of the gear and of encoders see it."""
        return Motion(self.group, self.solution, self.par)

    @cached_property
    def about(self) -> Plane:
        """The linear arm for small changes about the motion: in the posture that it has, where an encoder that is out
        of centre tells another one, and with springs to the links."""
        return _about_motion(self.model, self.bare_motion, self.structure, self.plane)

    @cached_property
    def added_stiffness(self) -> np.ndarray:
        """(n,) of effects in parallel with the gears, about the motion, N m/rad."""
        return _added_stiffness(self.par, self.bare_motion, of_channel(self.model, "spring"))

    @cached_property
    def position_slopes(self) -> np.ndarray:
        """(n,) true position per measured one of encoders that err with it, about the motion."""
        return _position_slopes(self.bare_motion, of_channel(self.model, "position"))

    @cached_property
    def sampled_impedance(self) -> np.ndarray:
        """(L, n, n) recorded torque per motor position for small changes about the motion.

        What noise on the position becomes in the torque residual. Gears and encoders count with their
        mean slope: a hardening gear passes on more noise than a linear one. With filters of drives and sensors.
        """
        Z = self.about.Z
        if np.any(self.added_stiffness):
            stiffness = np.maximum(self.par.stiffness + self.added_stiffness, 0.05 * self.par.stiffness)
            Z = impedance(
                self.structure, replace(self.par, stiffness=stiffness), self.about.lin, self.about.s, self.about.steps
            )[0]
        Z = self.plane.record[:, None, None] * Z
        recorded, true = self.filters
        return recorded[:, :, None] * Z * true[:, None, :]

    @cached_property
    def filters(self) -> tuple[np.ndarray, np.ndarray]:
        """What linear drives record per torque that they deliver, and the true position per measured one; (L, n)
        each."""
        recorded, true = linear_filters(self.model, self.plane.s)
        return recorded, true * self.position_slopes


def linear_filters(model: Model, s: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """What linear drives record per torque that they deliver, and the true position per measured one; (F, n) each.

    Args:
        s: (F,) complex frequencies, rad/s.
    """
    recorded, true = np.ones((2, len(s), model.structure.n), complex)
    for effect in model.effects:
        h = effect.hypothesis
        if "filter" in h.options:
            (recorded if h.channel == "drive" else true)[:, h.joint] *= h.options["filter"](effect.p, s)
    return recorded, true


def predict(
    model: Model,
    group: Group,
    sampling: Sampling,
    *,
    W: np.ndarray | None = None,
    steps: int | None = None,
    torques: Torques = Torques(),
    near: Prediction | None = None,
) -> Prediction:
    """Recorded motor torque along the measured motion of a group, effects included.

    Args:
        W: (S, L, N) geometric remainder to start from (of an earlier prediction with the same
            chain); None starts cold.
        steps: fixed-point steps on it; ``REMAINDER_STEPS`` cold and 0 warm where None.
        torques: of laws of the gear and the links, to start from (of a model near by with the same chain).
        near: of a model with the same effects or some of them; its linear arm is not made anew where the records, and
            the chain and drives of the model, are the very same.
    """
    structure, par = model.built
    if near is not None and _same_arm(near, structure, par, group, sampling):
        plane = near.plane
    else:
        plane = make_plane(structure, par, group, sampling)
    return predict_at(model, structure, par, plane, group, sampling, W=W, steps=steps, torques=torques)


def _same_arm(near: Prediction, structure: Structure, par: Parameters, group: Group, sampling: Sampling) -> bool:
    """Whether the linear arm of a prediction is that of a chain and drives, for records of a group."""
    same = near.group is group and near.sampling == sampling and near.structure is structure
    return same and near.par.same_as(par)


# of torques that run away: those who ask see that the result is not finite
@np.errstate(over="ignore", invalid="ignore")
def predict_at(
    model: Model,
    structure: Structure,
    par: Parameters,
    plane: Plane,
    group: Group,
    sampling: Sampling,
    *,
    W: np.ndarray | None = None,
    steps: int | None = None,
    torques: Torques = Torques(),
) -> Prediction:
    """``predict`` with the linear arm already at hand."""
    if steps is None:
        steps = REMAINDER_STEPS if W is None else 0
    if W is not None and W.shape[-1] != structure.n_coordinates:
        W, steps, torques = None, max(steps, REMAINDER_STEPS), Torques()
    filtered = any("filter" in e.hypothesis.options for e in model.effects)
    Q = true_position(structure, par, plane, group, sampling, partial(linear_filters, model) if filtered else None)
    by_channel: dict[str, list[Effect]] = {}
    for effect in model.effects:
        by_channel.setdefault(effect.hypothesis.channel, []).append(effect)
    for effect in by_channel.get("position", []):
        j = effect.hypothesis.joint
        seen = Motion(group, Solution(Q, Q, Q, Q, Q, Q, Q, Torques()), par)
        error = effect.hypothesis.law(effect.p, seen, j, par.stiffness[j])
        # Laws see the motion without lines of noise, which they pass on with their slope nonetheless: a model in which
        # they did not would gain by another inertia that leaves less of that noise.
        passed_on = (_position_slopes(seen, [effect])[j] - 1.0) * seen.unseen(j)
        Q = Q.copy()
        Q[..., j] += error + passed_on
    inner = by_channel.get("link", []) + by_channel.get("spring", [])
    motor = by_channel.get("motor", [])
    along = joints_along_record(model, group)
    # after what else is at the gear
    inner.sort(key=lambda e: e.hypothesis.joint in along and is_along_record(e.hypothesis))
    drives = by_channel.get("drive", [])
    given = delivered(drives, group, plane) if any(is_dry(e) for e in motor) else None
    react = (
        partial(inner_torques, structure, par, plane, group, effects=inner, motors=motor, given=given, along=along)
        if inner
        else None
    )
    passes = 1 if len(inner) == 1 and has_loop(inner[0]) else REACTION_STEPS
    start = torques if inner else Torques(varying=torques.varying)
    solution = solve(
        structure,
        par,
        plane,
        group,
        sampling,
        Q=Q,
        W=W,
        torques=start,
        react=react,
        passes=passes,
        steps=steps,
    )
    if group.drift is not None:
        drifting = plane.record[:, None] * drifting_torque(plane.Z, group.drift)
        solution = replace(solution, U=solution.U + drifting)
    if motor:
        motion = Motion(group, solution, par, delivered=given, told=along)
        at_motors = plane.record[:, None] * motor_torques(par, motion, motor)
        solution = replace(solution, U=solution.U + at_motors)
    U = through_drives(drives, Motion(group, solution, par))
    return Prediction(model, group, sampling, structure, par, plane, solution, U)


def of_channel(model: Model, channel: str) -> list[Effect]:
    """Effects of a model that act there."""
    return [e for e in model.effects if e.hypothesis.channel == channel]


def through_drives(effects: Sequence[Effect], motion: Motion) -> np.ndarray:
    """(S, L, n) torque of a motion as drives with effects record it, N m."""
    U = motion.solution.U.copy()
    for effect in effects:
        h, j = effect.hypothesis, effect.hypothesis.joint
        U[..., j] = h.law(effect.p, motion, j, motion.par.stiffness[j], U[..., j])
    return U


def delivered(effects: Sequence[Effect], group: Group, plane: Plane) -> np.ndarray | None:
    """(S, L, n) torque that motors deliver by the record of a group, N m; None where none of them stands still.

    That alone is what a friction at rest balances: ``through_drives``, backwards.

    Args:
        effects: of the drives.
    """
    if group.rest is None or not np.any(group.rest):
        return None
    U, recorded = group.U / plane.record[:, None], Recorded(group)
    for effect in effects[::-1]:
        h, j = effect.hypothesis, effect.hypothesis.joint
        if "filter" in h.options:
            U[..., j] /= h.options["filter"](effect.p, plane.s)
        else:
            U[..., j] -= h.law(effect.p, recorded, j, 0.0, np.zeros_like(U[..., j]))
    return U


def _added_stiffness(par: Parameters, motion: Motion, effects: Sequence[Effect]) -> np.ndarray:
    """(n,) mean slope of the torques of gear effects along the deflection, N m/rad."""
    out = np.zeros(len(par.stiffness))
    for effect in effects:
        if effect.hypothesis.gear_law:
            j = effect.hypothesis.joint
            law: kernels.Law = effect.hypothesis.law(effect.p, None, par.stiffness[j])
            out[j] += np.mean(kernels.mean_slope(law, motion.delta(j)))
    return out


def _about_motion(model: Model, motion: Motion, structure: Structure, plane: Plane) -> Plane:
    """The linear arm for small changes about a motion: in its mean posture, with the mean slopes of laws at the
    links."""
    effects = [e for e in model.effects if moves_plane(e.hypothesis)]
    if not effects:
        return plane
    lin = linearise(structure, motion.solution.Q_a[:, 0].real.mean(axis=0))
    for h, p in ((e.hypothesis, e.p) for e in effects if e.hypothesis.channel == "link"):
        loop, q = h.options.get("loop"), motion.q_link(h.joint)
        slope = kernels.mean_slope(loop(p), q) if loop else h.options["slope"](p, q)
        lin.Kg[structure.driven[h.joint], structure.driven[h.joint]] += np.mean(slope)
    return plane_at(structure, motion.par, lin, motion.group, plane.record)


def moves_plane(hypothesis: Hypothesis) -> bool:
    """Whether small changes about the motion are those of another linear arm than the one that predictions are computed
    with."""
    h = hypothesis
    return h.channel == "position" or (h.channel == "link" and ("loop" in h.options or "slope" in h.options))


def _position_slopes(motion: Motion, effects: Sequence[Effect]) -> np.ndarray:
    """(n,) mean slope of the true position by the measured one, of encoders whose error is a law of the position."""
    out = np.ones(len(motion.par.stiffness))
    for effect in effects:
        if "slope" in effect.hypothesis.options:
            j = effect.hypothesis.joint
            out[j] *= np.mean(effect.hypothesis.options["slope"](effect.p, motion.q(j)))
    return out
