"""The gray-box with effects: prediction of the recorded torque, and its derivatives."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial

import numpy as np
import scipy.fft

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
from ident.records import NOISE_LINES, POINTS_PER_LINE, Group, mean_over_lines

REACTION_STEPS = 8  # passes at most until torques and the motion that they cause agree
LOOP_REFINEMENT = 2  # time grid of a loop, in multiples of that of the laws of periodic data, at least
LOOP_MOST = 6  # the same, at most: modes far above the signals follow at once
LOOP_STEP = 0.25  # its step, at most, over the time scale of the fastest mode


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
    passes = 1 if len(inner) == 1 and _closes_itself(inner[0]) else REACTION_STEPS
    solution = solve(structure, par, plane, group, sampling, Q=Q, W=W, react=react, passes=passes, steps=steps)
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
    motor = np.zeros((S, L, n), complex)
    motion = Motion(group, solution, par)
    at_gear: dict[int, np.ndarray] = {}
    at_link: dict[int, np.ndarray] = {}
    loops = []
    for effect in effects:
        h, j = effect.hypothesis, effect.hypothesis.joint
        if _closes_itself(effect):
            loops.append(effect)
        elif h.options.get("kinematic"):
            error, torque = h.law(effect.p, motion, j, par.stiffness[j])
            at_gear[j] = at_gear.get(j, 0.0) + plane.C[:, j] * motion.lines(error)
            motor[..., j] += motion.lines(torque)
        else:
            view = _link_view(motion, j, structure.driven[j])
            at_link[j] = at_link.get(j, 0.0) + motion.lines(h.law(effect.p, view, j, par.stiffness[j]))
    old_gear = solution.torques.spring + np.zeros((S, L, n), complex)
    old_link = solution.torques.link + np.zeros((S, L, structure.n_coordinates), complex)
    for effect in loops:
        j, c = effect.hypothesis.joint, structure.driven[effect.hypothesis.joint]
        compliance = plane.A_inv[:, c, c]
        grid, modes = _modes(structure, par, plane, group, c)
        if effect.hypothesis.channel == "link":
            free = solution.Q_a[..., c] + compliance * (old_link[..., c] - at_link.get(j, 0.0))
            at_link[j] = at_link.get(j, 0.0) + _loop(effect.hypothesis.options["loop"](effect.p), grid, free, modes)
        else:
            free = solution.delta[..., j] + compliance * (old_gear[..., j] - at_gear.get(j, 0.0))
            law = effect.hypothesis.law(effect.p, None, par.stiffness[j])
            at_gear[j] = at_gear.get(j, 0.0) + _loop(law, grid, free, modes)
    for j, value in at_gear.items():
        old_gear[..., j] = value
    for j, value in at_link.items():
        old_link[..., structure.driven[j]] = value
    return Torques(spring=old_gear, link=old_link, motor=motor)


def _closes_itself(effect: Effect) -> bool:
    """Whether an effect's loop is solved in one pass."""
    h = effect.hypothesis
    return not h.options.get("kinematic") and (h.channel == "spring" or "loop" in h.options)


def _modes(
    structure: Structure, par: Parameters, plane: Plane, group: Group, column: int
) -> tuple[Group, tuple[np.ndarray, ...]]:
    """Time grid of a loop at a link coordinate, fine enough for the fastest mode, and the modes there."""
    D = np.diag(damping_diagonal(structure, par))
    K = np.diag(stiffness_diagonal(structure, par)) + plane.lin.Kg
    fastest = np.sqrt(np.abs(np.linalg.eigvals(np.linalg.solve(plane.lin.M, K))).max())
    least = LOOP_REFINEMENT * POINTS_PER_LINE * len(group.omega)
    points = int(np.clip(group.period_time * fastest / LOOP_STEP, least, LOOP_MOST * least))
    grid = replace(group, n_time=scipy.fft.next_fast_len(points, real=True))
    return grid, kernels.modal_compliance(plane.lin.M, D, K, int(column), group.period_time / grid.n_time)


def _loop(
    law: tuple[int, float, float, float], grid: Group, free: np.ndarray, modes: tuple[np.ndarray, ...]
) -> np.ndarray:
    """Spectrum (S, L) of the torque of a law in steady state with the arm, from where it would be without."""
    x = grid.to_time(free[..., None])[..., 0]
    rate = grid.to_time((1j * grid.omega * free)[..., None])[..., 0] if law[0] == kernels.LINK else x
    return grid.to_lines(kernels.steady_loop(*law, x, rate, *modes)[..., None])[..., 0]


def _link_view(motion: Motion, joint: int, column: int) -> Motion:
    """The motion with link coordinate ``joint`` moved to where laws look for it."""
    if joint == column:
        return motion
    Q_a = motion.solution.Q_a.copy()
    Q_a[..., joint] = motion.solution.Q_a[..., column]
    return replace(motion, solution=replace(motion.solution, Q_a=Q_a))
