"""The gray-box with effects: prediction of the recorded torque, and its derivatives."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial

import numpy as np
import scipy.fft

from ident.chain import Structure
from ident.graybox import Parameters, damping_diagonal, impedance, stiffness_diagonal
from ident.group import Group, signal_share
from ident.hypotheses import kernels
from ident.hypotheses.hypothesis import Hypothesis
from ident.hypotheses.loop import modal_state, steady_loop
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
from ident.records import POINTS_PER_LINE

REACTION_STEPS = 8  # passes at most until torques and the motion that they cause agree
LOOP_REFINEMENT = 2  # time grid of a loop, in multiples of that of the laws of periodic data, at least
LOOP_MOST = 3  # the same, at most: modes far above the signals follow at once
RECORD_AGREED = 1e-5  # step over the deflection that ends them
RECORD_STEPS = 20  # towards the deflection that agrees with a record
RECORD_BISECTIONS = 30  # of its mean
LOOP_STEP = 0.5  # its step, at most, over the time scale of the fastest mode


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

    ``added_stiffness`` (n,): of effects in parallel with the gears, about the motion, N m/rad.
    """

    model: Model
    sampling: Sampling
    structure: Structure
    par: Parameters
    plane: Plane
    solution: Solution
    U: np.ndarray
    added_stiffness: np.ndarray

    def motion(self, group: Group) -> Motion:
        drives = [e for e in self.model.effects if e.hypothesis.channel == "drive"]
        told = joints_along_record(self.model, group)
        return Motion(group, self.solution, self.par, delivered=delivered(drives, group, self.plane), told=told)

    def outputs(self, group: Group) -> np.ndarray:
        """(S, L, n + M) predicted recorded torque, N m, and link positions, rad, as ``Group.outputs``."""
        if not group.links:
            return self.U
        return np.concatenate([self.U, self.solution.Q_driven[..., list(group.links)]], axis=-1)

    @cached_property
    def sampled_impedance(self) -> np.ndarray:
        """(L, n, n) recorded torque per motor position for small changes about the motion.

        What noise on the position becomes in the torque residual. Gears count with their
        mean slope: a hardening gear passes on more noise than a linear one. With filters of drives and sensors.
        """
        Z = self.plane.Z
        if np.any(self.added_stiffness):
            stiffness = np.maximum(self.par.stiffness + self.added_stiffness, 0.05 * self.par.stiffness)
            Z = impedance(self.structure, replace(self.par, stiffness=stiffness), self.plane.lin, self.plane.s)[0]
        Z = self.plane.record[:, None, None] * Z
        recorded, true = self.filters
        return recorded[:, :, None] * Z * true[:, None, :]

    @cached_property
    def filters(self) -> tuple[np.ndarray, np.ndarray]:
        """What linear drives record per torque that they deliver, and the true position per measured one; (L, n) each."""
        recorded, true = np.ones((2, len(self.plane.s), self.structure.n), complex)
        for effect in self.model.effects:
            h = effect.hypothesis
            if "filter" in h.options:
                (recorded if h.channel == "drive" else true)[:, h.joint] *= h.options["filter"](effect.p, self.plane.s)
        return recorded, true


def joints_along_record(model: Model, group: Group) -> frozenset[int]:
    """Joints whose gear is predicted along the record of a group.

    Not in a motion, and not where the drive has an effect: its record is not the torque of the motor.
    """
    if group.window is not None:
        return frozenset()
    drives = {e.hypothesis.joint for e in model.effects if e.hypothesis.channel == "drive"}
    return frozenset(e.hypothesis.joint for e in model.effects if is_along_record(e.hypothesis)) - drives


def predict(
    model: Model,
    group: Group,
    sampling: Sampling,
    *,
    W: np.ndarray | None = None,
    steps: int | None = None,
    torques: Torques = Torques(),
) -> Prediction:
    """Recorded motor torque along the measured motion of a group, effects included.

    Args:
        W: (S, L, N) geometric remainder to start from (of an earlier prediction with the same
            chain); None starts cold.
        steps: fixed-point steps on it; ``REMAINDER_STEPS`` cold and 0 warm where None.
        torques: of laws of the gear and the links, to start from (of a model near by with the same chain).
    """
    structure, par = model.built()
    plane = make_plane(structure, par, group, sampling)
    return predict_at(model, structure, par, plane, group, sampling, W=W, steps=steps, torques=torques)


@np.errstate(over="ignore", invalid="ignore")  # of torques that run away: those who ask see that the result is not finite
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
        W, steps = None, max(steps, REMAINDER_STEPS)
    Q = true_position(group, par, sampling)
    by_channel: dict[str, list[Effect]] = {}
    for effect in model.effects:
        by_channel.setdefault(effect.hypothesis.channel, []).append(effect)
    for effect in by_channel.get("position", []):
        j = effect.hypothesis.joint
        bare = Solution(Q, Q, Q, Q, Q, Q, Q, Torques())
        Q = Q.copy()
        Q[..., j] += effect.hypothesis.law(effect.p, Motion(group, bare, par), j, par.stiffness[j])
    inner = by_channel.get("link", []) + by_channel.get("spring", [])
    motor = by_channel.get("motor", [])
    along = joints_along_record(model, group)
    inner.sort(key=lambda e: e.hypothesis.joint in along and is_along_record(e.hypothesis))  # after what else is at the gear
    drives = by_channel.get("drive", [])
    given = delivered(drives, group, plane) if any(is_dry(e) for e in motor) else None
    react = partial(_inner_torques, structure, par, plane, group, effects=inner, motors=motor, given=given, along=along) if inner else None
    passes = 1 if len(inner) == 1 and has_loop(inner[0]) else REACTION_STEPS
    start = torques if inner else Torques()
    solution = solve(structure, par, plane, group, sampling, Q=Q, W=W, torques=start, react=react, passes=passes, steps=steps)
    if motor:
        motion = Motion(group, solution, par, delivered=given, told=along)
        at_motors = plane.record[:, None] * _motor_torques(par, motion, motor)
        solution = replace(solution, U=solution.U + at_motors)
    U = through_drives(drives, Motion(group, solution, par))
    added = _added_stiffness(par, Motion(group, solution, par), by_channel.get("spring", []))
    return Prediction(model, sampling, structure, par, plane, solution, U, added)


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
    U, motion = group.U / plane.record[:, None], Motion(group, None, None)
    for effect in effects[::-1]:
        h, j = effect.hypothesis, effect.hypothesis.joint
        if "filter" in h.options:
            U[..., j] /= h.options["filter"](effect.p, plane.s)
        else:
            U[..., j] -= h.law(effect.p, motion, j, 0.0, np.zeros_like(U[..., j]))
    return U


def _added_stiffness(par: Parameters, motion: Motion, effects: Sequence[Effect]) -> np.ndarray:
    """(n,) mean slope of the torques of gear effects along the deflection, N m/rad."""
    out = np.zeros(len(par.stiffness))
    for effect in effects:
        if effect.hypothesis.gear_law:
            j = effect.hypothesis.joint
            law = effect.hypothesis.law(effect.p, None, par.stiffness[j])
            out[j] += np.mean(kernels.mean_slope(law, motion.delta(j)))
    return out


def _inner_torques(
    structure: Structure,
    par: Parameters,
    plane: Plane,
    group: Group,
    solution: Solution,
    *,
    effects: Sequence[Effect],
    motors: Sequence[Effect],
    given: np.ndarray | None,
    along: frozenset[int],
) -> Torques:
    """Spring and link torques of effects, solved together with the arm they act on.

    A law on the gear's deflection is solved as a scalar loop through the compliance of the arm at
    that gear, the torques of all others held; or taken along the deflection that the recorded torque says.

    Args:
        effects: in the gears and on the links; motors: at the motors; given: what the motors deliver, of ``delivered``;
            along: joints that are predicted along the record.
    """
    S, L, n = solution.Q.shape
    motor = np.zeros((S, L, n), complex)
    motion = Motion(group, solution, par, delivered=given, told=along)
    at_gear: dict[int, np.ndarray] = {}
    at_link: dict[int, np.ndarray] = {}
    loops = []
    for effect in effects:
        h, j = effect.hypothesis, effect.hypothesis.joint
        if has_loop(effect):
            loops.append(effect)
        elif h.options.get("kinematic"):
            error, torque = h.law(effect.p, motion, j, par.stiffness[j])
            at_gear[j] = at_gear.get(j, 0.0) + plane.C[:, j] * motion.lines(error)
            motor[..., j] += motion.lines(torque)
        else:
            at_link[j] = at_link.get(j, 0.0) + motion.lines(h.law(effect.p, motion, j, par.stiffness[j]))
    at_motors = _motor_torques(par, motion, motors) if motors else 0.0
    old_gear = solution.torques.spring + np.zeros((S, L, n), complex)
    old_link = solution.torques.link + np.zeros((S, L, structure.n_coordinates), complex)
    for effect in loops:
        j, c = effect.hypothesis.joint, structure.driven[effect.hypothesis.joint]
        compliance = plane.A_inv[:, c, c]
        grid, modes = _modes(structure, par, plane, group, c)
        if effect.hypothesis.channel == "link":
            others = at_link.get(j, 0.0)
            guess = old_link[..., c] - others
            noise = noise_of_motion(group, motion_per_position(structure, par, plane, j, gear=False))
            free = solution.Q_driven[..., j] + compliance * guess
            at_link[j] = others + _loop(effect.hypothesis.options["loop"](effect.p), grid, free, noise, compliance, modes, guess)
        else:
            others = at_gear.get(j, 0.0)
            law = effect.hypothesis.law(effect.p, None, par.stiffness[j])
            if j in along and is_along_record(effect.hypothesis):
                said, left = _along_record(law, par, plane, group, motion, j, c, others, motor + at_motors)
                at_gear[j] = others + said
                motor[..., j] += left
            else:
                guess = old_gear[..., j] - others
                noise = noise_of_motion(group, motion_per_position(structure, par, plane, j, gear=True))
                free = solution.delta[..., j] + compliance * guess
                at_gear[j] = others + _loop(law, grid, free, noise, compliance, modes, guess)
    for j, value in at_gear.items():
        old_gear[..., j] = value
    for j, value in at_link.items():
        old_link[..., structure.driven[j]] = value
    return Torques(spring=old_gear, link=old_link, motor=motor)


def _motor_torques(par: Parameters, motion: Motion, effects: Sequence[Effect]) -> np.ndarray:
    """Spectra (S, L, n) of the torques of effects at the motors; dry friction at rest balances what the others leave."""
    out = np.zeros_like(motion.solution.Q)
    for effect in sorted(effects, key=is_dry):
        h, j = effect.hypothesis, effect.hypothesis.joint
        seen = replace(motion, beside=out) if is_dry(effect) else motion
        out[..., j] += motion.lines(h.law(effect.p, seen, j, par.stiffness[j]))
    return out


def is_dry(effect: Effect) -> bool:
    """Whether an effect is a friction that at rest is what balances the drive."""
    return bool(effect.hypothesis.options.get("dry"))


def beside(effects: Sequence[Effect], of: Effect, motion: Motion) -> Motion:
    """The motion as a law at a motor sees it beside the other effects there."""
    if not is_dry(of) or motion.group.rest is None:
        return motion
    others = [e for e in effects if e is not of and e.hypothesis.channel == "motor" and not is_dry(e)]
    return replace(motion, beside=_motor_torques(motion.par, motion, others)) if others else motion


def is_along_record(h: Hypothesis) -> bool:
    """Whether a law of the gear is taken along the deflection that the recorded torque says."""
    return bool(h.options.get("along_record"))


def has_rough_law(model: Model) -> bool:
    """Whether a law along the record, or one under which single records may be in another steady motion, leaves more than noise itself."""
    return any(is_along_record(e.hypothesis) or "bends" in e.hypothesis.options for e in model.effects)


def along_record(h: Hypothesis) -> Hypothesis:
    """A law of the gear taken along the deflection that the recorded torque says.

    A gear that rattles in its dead band has more than one steady state, and which of them a recording shows depends
    on how it began: the loop solved from rest ends in another, though the model is right. The recorded torque, less
    that of the motor, moved the link, and the link's open compliance says where that took the gear. What the law
    leaves of that torque reaches the gear's own motor as through the linear gear: there a linear law leaves what the
    loop does. A motion, which is closed by a return that was not recorded, is predicted by the loop, and so is a joint
    with an effect of its drive (``joints_along_record``).
    """
    return replace(h, options={**h.options, "along_record": True})


def as_loop(h: Hypothesis) -> Hypothesis:
    """The law that ``along_record`` was made of."""
    return replace(h, options={k: v for k, v in h.options.items() if k != "along_record"})


def simulated_laws(model: Model) -> Model:
    """The model with all laws of the gear as loops."""
    return replace(model, effects=tuple(replace(e, hypothesis=as_loop(e.hypothesis)) for e in model.effects))


def _along_record(
    law: kernels.Law,
    par: Parameters,
    plane: Plane,
    group: Group,
    motion: Motion,
    j: int,
    c: int,
    others: np.ndarray | float,
    motor: np.ndarray | float,
) -> tuple[np.ndarray, np.ndarray]:
    """Spectra (S, L) of the torque in parallel with a gear that the record says, and of what a law leaves of it.

    The former moves the links; the latter is as it reaches the motor. The law is asked at the deflection that agrees
    best with two measurements: the one that the recorded torque gives through the open compliance of the link, whose
    noise is large where that is, and the one at which the law gives this torque, whose noise is large where the
    gear is soft. Steps of least squares, with the largest slope of the law and the gear's damper for its slope.

    Args:
        j, c: joint, and its link coordinate; others: (S, L) torque of other laws of the same gear; motor: (S, L, n)
            torque of effects at the motors.
    """
    solution, s = motion.solution, plane.s[:, None]
    drive = group.U / plane.record[:, None] - (s**2 * par.inertia + s * par.viscous) * solution.Q - motor
    carried = (drive @ np.linalg.inv(par.coupling))[..., j]
    more = (carried - solution.tau_s[..., j])[:, 1:]
    gain = 1.0 - plane.C[:, j] * plane.A_inv[:, c, c]
    link = plane.A_inv[1:, c, c] / gain[1:]
    carried = carried - others
    mean = carried[:, 0].real
    known = np.zeros_like(carried)
    known[:, 1:] = solution.delta[:, 1:, j] - link * more

    def torque_at(x: np.ndarray, bisections: int) -> np.ndarray:
        along = kernels.along_deflection(*law, group.to_time(x[..., None])[..., 0], mean, bisections)
        return group.to_lines(along[..., None])[..., 0]

    # What the damper adds at high frequency belongs to it: steps over the spring alone would run away there.
    slope = plane.C[:, j] - law.k + kernels.largest_slope(law, float(np.abs(group.to_time(known[..., None])).max()))
    trust = np.ones(len(gain))  # of the law's measurement, against that through the link
    trust[1:] = np.abs(link * slope[1:]) ** 2 / (1.0 + np.abs(link * slope[1:]) ** 2)
    x = known
    for _ in range(RECORD_STEPS):
        miss = carried - plane.C[:, j] * x - torque_at(x, 0)
        step = (1.0 - trust) * (known - x) + trust * miss / slope
        x = x + step
        if np.linalg.norm(step) <= RECORD_AGREED * np.linalg.norm(x):
            break
    torque = torque_at(x, RECORD_BISECTIONS)
    said = torque.copy()
    said[:, 1:] = (carried - plane.C[:, j] * known)[:, 1:]
    return said, gain * (torque - said)


def has_loop(effect: Effect) -> bool:
    """Whether an effect moves the arm by which it is moved: a loop, solved in one pass."""
    return effect.hypothesis.gear_law or "loop" in effect.hypothesis.options


def _modes(
    structure: Structure, par: Parameters, plane: Plane, group: Group, column: int
) -> tuple[Group, np.ndarray]:
    """Time grid of a loop at a link coordinate, fine enough for the fastest mode, and the modes there."""
    D = np.diag(damping_diagonal(structure, par))
    K = np.diag(stiffness_diagonal(structure, par)) + plane.lin.Kg
    fastest = np.sqrt(np.abs(np.linalg.eigvals(np.linalg.solve(plane.lin.M, K))).max())
    least = LOOP_REFINEMENT * POINTS_PER_LINE * len(group.omega)
    points = int(np.clip(group.period_time * fastest / LOOP_STEP, least, LOOP_MOST * least))
    grid = replace(group, n_time=scipy.fft.next_fast_len(points, real=True))
    return grid, kernels.modal_compliance(plane.lin.M, D, K, int(column), group.period_time / grid.n_time)


def motion_per_position(structure: Structure, par: Parameters, plane: Plane, joint: int, *, gear: bool) -> np.ndarray:
    """(L, n) deflection of the gear of a joint per motor position, without laws; of its link where not of the ``gear``."""
    link = (plane.A_inv[:, structure.driven[joint], structure.driven] * plane.C) @ par.coupling
    return par.coupling[joint] - link if gear else link


def noise_of_motion(group: Group, per_position: np.ndarray) -> np.ndarray:
    """(L,) variance that noise of the positions has in a motion, rad2; none of a motion whose lines are seen through a window.

    Args:
        per_position: (L, n) of ``motion_per_position``.
    """
    if group.window is not None:
        return np.zeros(len(per_position))
    return np.einsum("li,li->l", np.abs(per_position) ** 2, group.position_noise)


def _loop(
    law: kernels.Law,
    grid: Group,
    free: np.ndarray,
    noise: np.ndarray,
    compliance: np.ndarray,
    modes: np.ndarray,
    guess: np.ndarray,
) -> np.ndarray:
    """Spectrum (S, L) of the torque of a law in steady state with the arm.

    A law turns noise of a motion into a bias, and passes that of each line on to all others. It is shown the lines that
    are signal; the others it answers with its mean slope.

    Args:
        free: (S, L) where the arm would be without; noise: (L,) variance of its lines; compliance: (L,) of the arm there;
            guess: (S, L) torque to begin with.
    """
    share = signal_share(free, noise)
    shown = share * free
    x = grid.to_time(shown[..., None])[..., 0]
    rate = grid.to_time((1j * grid.omega * shown)[..., None])[..., 0] if kernels.sees_rate(law) else x
    start = modal_state(guess, grid.omega, grid.period_time / grid.n_time, modes)
    torque = grid.to_lines(steady_loop(law, x, rate, modes, start)[..., None])[..., 0]
    slope = kernels.mean_slope(law, grid.to_time((shown - compliance * torque)[..., None])[..., 0])[:, None]
    # The mean is shown as it is, and a gear within its dead band has no stiffness there to answer with.
    torque[:, 1:] += slope / (1.0 + slope * compliance[1:]) * (free - shown)[:, 1:]
    return torque
