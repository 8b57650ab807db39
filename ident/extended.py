"""The gray-box with effects: prediction of the recorded torque, and its derivatives."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial

import numpy as np

from ident.graybox import Parameters, Structure, damping_diagonal, impedance, stiffness_diagonal
from ident.hypotheses import kernels
from ident.hypotheses.hypothesis import Hypothesis
from ident.hypotheses.structure import Change, apply_change
from ident.inverse import (
    REMAINDER_STEPS,
    Motion,
    Plane,
    Sampling,
    Solution,
    Torques,
    make_plane,
    solve,
    true_position,
)
from ident.records import NOISE_LINES, Group, mean_over_lines

LOOP_REFINEMENT = 2  # time grid of a gear's loop, in multiples of that of other laws


@dataclass(frozen=True)
class Effect:
    """A hypothesis with values for its parameters (external units)."""

    hypothesis: Hypothesis
    p: np.ndarray

    def value(self, name: str) -> float:
        return float(self.p[[q.name for q in self.hypothesis.parameters].index(name)])


@dataclass(frozen=True)
class Model:
    """A chain, baseline parameters and effects."""

    structure: Structure
    par: Parameters
    effects: tuple[Effect, ...] = ()

    def built(self) -> tuple[Structure, Parameters]:
        """Chain and parameters with the effects that change them."""
        change = Change()
        for effect in self.effects:
            if effect.hypothesis.channel == "model":
                change = change + effect.hypothesis.options["change"](effect.p)
        return apply_change(self.structure, self.par, change)


@dataclass(frozen=True)
class Prediction:
    """What a model predicts for a group, and what it was computed with.

    ``added_stiffness`` (n,): of effects in parallel with the gears, about the motion, N m/rad;
    ``at_motor``: effects at the motors.
    """

    structure: Structure
    par: Parameters
    plane: Plane
    solution: Solution
    U: np.ndarray
    added_stiffness: np.ndarray
    at_motor: tuple[Effect, ...]

    def motion(self, group: Group) -> Motion:
        return Motion(group, self.solution, self.par)

    @cached_property
    def sampled_impedance(self) -> np.ndarray:
        """(L, n, n) recorded torque per motor position for small changes about the motion.

        What noise on the position becomes in the torque residual. Gears count with their
        equivalent stiffness: a hardening gear passes on more noise than a linear one.
        """
        Z = self.plane.Z
        if np.any(self.added_stiffness):
            stiffness = np.maximum(self.par.stiffness + self.added_stiffness, 0.05 * self.par.stiffness)
            Z = impedance(self.structure, replace(self.par, stiffness=stiffness), self.plane.lin, self.plane.s)[0]
        return self.plane.record[:, None, None] * Z


    def law_noise(self, group: Group) -> np.ndarray:
        """(L, n) power that position noise leaves in the torque through laws at the motors, N2 m2.

        A friction that turns within a small velocity carries the noise of a motor that stands still
        with the slope of the turn. By one draw of the noise over all records.
        """
        out = np.zeros(self.U.shape[1:])
        if not self.at_motor:
            return out
        rng = np.random.default_rng(0)
        draw = rng.normal(size=(2, *self.U.shape)) * np.sqrt(0.5 * group.position_noise)
        noisy = replace(self.solution, Q=self.solution.Q + draw[0] + 1j * draw[1])
        for effect in self.at_motor:
            j = effect.hypothesis.joint
            k = self.par.stiffness[j]
            with_noise, without = (
                effect.hypothesis.law(effect.p, Motion(group, x, self.par), j, k) for x in (noisy, self.solution)
            )
            change = self.plane.record * self.motion(group).lines(with_noise - without)
            out[:, j] += mean_over_lines(np.mean(np.abs(change) ** 2, axis=0), NOISE_LINES)
        return out


def predict(
    model: Model, group: Group, sampling: Sampling, *, W: np.ndarray | None = None, steps: int | None = None
) -> Prediction:
    """Recorded motor torque along the measured motion of a group, effects included.

    Args:
        W: (S, L, N) geometric remainder to start from (of an earlier prediction with the same
            chain); None starts cold.
        steps: fixed-point steps on it; ``REMAINDER_STEPS`` cold and 0 warm where None.
    """
    structure, par = model.built()
    plane = make_plane(structure, par, group, sampling)
    return predict_at(model, structure, par, plane, group, sampling, W=W, steps=steps)


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
) -> Prediction:
    """``predict`` with the linear arm already at hand."""
    if steps is None:
        steps = REMAINDER_STEPS if W is None else 0
    if W is not None and W.shape[-1] != structure.n_coordinates:
        W, steps = None, max(steps, REMAINDER_STEPS)
    Q = true_position(group, par, sampling)
    by_channel: dict[str, list[Effect]] = {}
    for effect in model.effects:
        by_channel.setdefault(effect.hypothesis.channel, []).append(effect)
    for effect in by_channel.get("position", []):
        j = effect.hypothesis.joint
        bare = Solution(Q, Q, Q, Q, Q, Q, Torques())
        Q = Q.copy()
        Q[..., j] += effect.hypothesis.law(effect.p, Motion(group, bare, par), j, par.stiffness[j])
    inner = by_channel.get("link", []) + by_channel.get("spring", [])
    react = partial(_inner_torques, structure, par, plane, group, effects=inner) if inner else None
    solution = solve(structure, par, plane, group, sampling, Q=Q, W=W, react=react, steps=steps)
    U = solution.U
    motor = by_channel.get("motor", [])
    if motor:
        motion = Motion(group, solution, par)
        U = U.copy()
        for effect in motor:
            j = effect.hypothesis.joint
            U[..., j] += plane.record * motion.lines(
                effect.hypothesis.law(effect.p, motion, j, par.stiffness[j])
            )
        solution = replace(solution, U=U)
    for effect in by_channel.get("drive", []):
        j = effect.hypothesis.joint
        U = U.copy()
        U[..., j] = effect.hypothesis.law(
            effect.p, Motion(group, solution, par), j, par.stiffness[j], U[..., j]
        )
    return Prediction(structure, par, plane, solution, U, _added_stiffness(solution, by_channel.get("spring", [])), tuple(motor))


def _added_stiffness(solution: Solution, effects: Sequence[Effect]) -> np.ndarray:
    """(n,) regression of the torques of gear effects on the deflection, lines above zero, N m/rad."""
    out = np.zeros(solution.delta.shape[-1])
    for j in {e.hypothesis.joint for e in effects if not e.hypothesis.options.get("kinematic")}:
        delta, torque = solution.delta[:, 1:, j], solution.torques.spring[:, 1:, j]
        out[j] = np.sum(torque * delta.conj()).real / max(np.sum(np.abs(delta) ** 2), 1e-300)
    return out


def _inner_torques(
    structure: Structure,
    par: Parameters,
    plane: Plane,
    group: Group,
    solution: Solution,
    *,
    effects: Sequence[Effect],
) -> Torques:
    """Spring and link torques of effects, solved together with the arm they act on.

    A law on the gear's deflection is solved as a scalar loop through the compliance of the arm at
    that gear, the torques of all others held.
    """
    S, L, n = solution.Q.shape
    spring = np.zeros((S, L, n), complex)
    link = np.zeros((S, L, structure.n_coordinates), complex)
    motor = np.zeros((S, L, n), complex)
    spring += solution.torques.spring
    link += solution.torques.link
    motion = Motion(group, solution, par)
    per_joint: dict[int, np.ndarray] = {}
    for effect in effects:
        h, j = effect.hypothesis, effect.hypothesis.joint
        if h.channel == "link":
            column = structure.driven[j]
            per_joint[1000 + j] = per_joint.get(1000 + j, 0.0) + motion.lines(
                h.law(effect.p, _link_view(motion, j, column), j, par.stiffness[j])
            )
        elif h.options.get("kinematic"):
            error, torque = h.law(effect.p, motion, j, par.stiffness[j])
            per_joint[j] = per_joint.get(j, 0.0) + plane.C[:, j] * motion.lines(error)
            motor[..., j] += motion.lines(torque)
    for effect in effects:
        h, j = effect.hypothesis, effect.hypothesis.joint
        if h.channel == "spring" and not h.options.get("kinematic"):
            compliance = plane.A_inv[:, structure.driven[j], structure.driven[j]]
            linear = solution.delta[..., j] + compliance * (spring[..., j] - per_joint.get(j, 0.0))
            per_joint[j] = per_joint.get(j, 0.0) + _spring_loop(structure, par, plane, group, effect, linear)
    for j, value in per_joint.items():
        if j >= 1000:
            link[..., structure.driven[j - 1000]] = value
        else:
            spring[..., j] = value
    return Torques(spring=spring, link=link, motor=motor)


def _spring_loop(
    structure: Structure, par: Parameters, plane: Plane, group: Group, effect: Effect, linear: np.ndarray
) -> np.ndarray:
    """Spectrum (S, L) of the torque of a gear's law, in steady state with the arm."""
    j = effect.hypothesis.joint
    group = replace(group, n_time=LOOP_REFINEMENT * group.n_time)
    code, a, b, k = effect.hypothesis.law(effect.p, None, par.stiffness[j])
    D = np.diag(damping_diagonal(structure, par))
    K = np.diag(stiffness_diagonal(structure, par)) + plane.lin.Kg
    dt = group.period_time / group.n_time
    modes = kernels.modal_compliance(plane.lin.M, D, K, int(structure.driven[j]), dt)
    torque = kernels.spring_loop(code, a, b, k, group.to_time(linear[..., None])[..., 0], *modes)
    return group.to_lines(torque[..., None])[..., 0]


def _link_view(motion: Motion, joint: int, column: int) -> Motion:
    """The motion with link coordinate ``joint`` moved to where laws look for it."""
    if joint == column:
        return motion
    Q_a = motion.solution.Q_a.copy()
    Q_a[..., joint] = motion.solution.Q_a[..., column]
    return replace(motion, solution=replace(motion.solution, Q_a=Q_a))
