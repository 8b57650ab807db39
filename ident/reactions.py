"""Torques of effects that the arm moves by which they are moved: gears, cables, friction."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import scipy.fft

from ident.chain import Structure
from ident.graybox import Parameters, damping_diagonal, rotor_inertia, stiffness_diagonal
from ident.group import Group, signal_share
from ident.hypotheses import kernels
from ident.hypotheses.loop import modal_state, steady_loop
from ident.inverse import Plane
from ident.model import Effect, has_loop, is_along_record, is_dry
from ident.motion import Motion, Solution, Steady, Torques
from ident.records import POINTS_PER_LINE

LOOP_REFINEMENT = 2  # time grid of a loop, in multiples of that of the laws of periodic data, at least
LOOP_MOST = 3  # the same, at most: modes far above the signals follow at once
RECORD_AGREED = 1e-5  # step over the deflection that ends them
RECORD_STEPS = 20  # towards the deflection that agrees with a record
RECORD_BISECTIONS = 30  # of its mean
LOOP_STEP = 0.5  # its step, at most, over the time scale of the fastest mode


def inner_torques(
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
    by_record = [e.hypothesis.joint in along and is_along_record(e.hypothesis) for e in loops]
    at_motors = motor_torques(par, motion, motors) if any(by_record) and motors else 0.0
    old_gear = solution.torques.spring + np.zeros((S, L, n), complex)
    old_link = solution.torques.link + np.zeros((S, L, structure.n_coordinates), complex)
    alone, steady = len(effects) == 1, dict[tuple[str, str], Steady]()
    for effect, said_by_record in zip(loops, by_record, strict=True):
        key = effect.hypothesis.key
        near = solution.torques.steady.get(key)
        j, c = effect.hypothesis.joint, structure.driven[effect.hypothesis.joint]
        compliance = plane.A_inv[:, c, c]
        grid, modes = _modes(structure, par, plane, group, c)
        if effect.hypothesis.channel == "link":
            others = at_link.get(j, 0.0)
            guess = old_link[..., c] - others
            noise = noise_of_motion(group, motion_per_position(structure, par, plane, j, gear=False))
            free = solution.Q_driven[..., j] + compliance * guess
            free[:, 0] -= effect.hypothesis.options["rest"](effect.p)
            law = effect.hypothesis.options["loop"](effect.p)
            torque, steady[key] = _loop(law, grid, free, noise, compliance, modes, guess, near, alone)
            at_link[j] = others + torque
        else:
            others = at_gear.get(j, 0.0)
            law = effect.hypothesis.law(effect.p, None, par.stiffness[j])
            if said_by_record:
                said, left = _along_record(law, par, plane, group, motion, j, c, others, motor + at_motors)
                at_gear[j] = others + said
                motor[..., j] += left
            else:
                guess = old_gear[..., j] - others
                noise = noise_of_motion(group, motion_per_position(structure, par, plane, j, gear=True))
                free = solution.delta[..., j] + compliance * guess
                torque, steady[key] = _loop(law, grid, free, noise, compliance, modes, guess, near, alone)
                at_gear[j] = others + torque
    for j, value in at_gear.items():
        old_gear[..., j] = value
    for j, value in at_link.items():
        old_link[..., structure.driven[j]] = value
    return Torques(spring=old_gear, link=old_link, motor=motor, steady=steady)


def motor_torques(par: Parameters, motion: Motion, effects: Sequence[Effect]) -> np.ndarray:
    """Spectra (S, L, n) of the torques of effects at the motors; dry friction at rest balances what the others
    leave."""
    out = np.zeros_like(motion.solution.Q)
    for effect in sorted(effects, key=is_dry):
        h, j = effect.hypothesis, effect.hypothesis.joint
        seen = replace(motion, beside=out) if is_dry(effect) else motion
        out[..., j] += motion.lines(h.law(effect.p, seen, j, par.stiffness[j]))
    return out


def beside(effects: Sequence[Effect], of: Effect, motion: Motion) -> Motion:
    """The motion as a law at a motor sees it beside the other effects there."""
    if not is_dry(of) or motion.group.rest is None:
        return motion
    others = [e for e in effects if e is not of and e.hypothesis.channel == "motor" and not is_dry(e)]
    return replace(motion, beside=motor_torques(motion.par, motion, others)) if others else motion


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
    solution, (rate, square) = motion.solution, (x[:, None] for x in plane.differences)
    drive = (
        group.U / plane.record[:, None]
        - (square * rotor_inertia(par, plane.steps) + rate * par.viscous) * solution.Q
        - motor
    )
    carried = (drive @ np.linalg.inv(par.coupling))[..., j]
    more = (carried - solution.tau_s[..., j])[:, 1:]
    gain = 1.0 - plane.C[:, j] * plane.A_inv[:, c, c]
    link = plane.A_inv[1:, c, c] / gain[1:]
    carried = carried - others
    mean = carried[:, 0].real
    known = np.zeros_like(carried)
    known[:, 1:] = solution.delta[:, 1:, j] - link * more

    def torque_at(x: np.ndarray, bisections: int) -> np.ndarray:
        along = kernels.along_deflection(*law.shape, group.to_time(x[..., None])[..., 0], mean, bisections)
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


def _modes(structure: Structure, par: Parameters, plane: Plane, group: Group, column: int) -> tuple[Group, np.ndarray]:
    """Time grid of a loop at a link coordinate, fine enough for the fastest mode, and the modes there."""
    D = np.diag(damping_diagonal(structure, par))
    K = np.diag(stiffness_diagonal(structure, par)) + plane.lin.Kg
    fastest = np.sqrt(np.abs(np.linalg.eigvals(np.linalg.solve(plane.lin.M, K))).max())
    least = LOOP_REFINEMENT * POINTS_PER_LINE * len(group.omega)
    points = int(np.clip(group.period_time * fastest / LOOP_STEP, least, LOOP_MOST * least))
    grid = replace(group, n_time=scipy.fft.next_fast_len(points, real=True))
    return grid, kernels.modal_compliance(plane.lin.M, D, K, int(column), group.period_time / grid.n_time)


def motion_per_position(structure: Structure, par: Parameters, plane: Plane, joint: int, *, gear: bool) -> np.ndarray:
    """(L, n) deflection of the gear of a joint per motor position, without laws; of its link where not of the
    ``gear``."""
    link = (plane.A_inv[:, structure.driven[joint], structure.driven] * plane.C) @ par.coupling
    return par.coupling[joint] - link if gear else link


def noise_of_motion(group: Group, per_position: np.ndarray) -> np.ndarray:
    """(L,) variance that noise of the positions has in a motion, rad2; none of a motion whose lines are seen through a
    window.

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
    near: Steady | None,
    alone: bool,
) -> tuple[np.ndarray, Steady]:
    """Spectrum (S, L) of the torque of a law in steady state with the arm, and that state.

    A law turns noise of a motion into a bias, and passes that of each line on to all others. It is shown the lines that
    are signal; the others it answers with its mean slope.

    Args:
        free: (S, L) where the arm would be without; noise: (L,) variance of its lines; compliance: (L,) of the arm
            there; guess: (S, L) torque to begin with, where no steady state ``near`` serves;
            alone: whether no other law is solved with it.
    """
    share = signal_share(free, noise)
    shown = share * free
    x = grid.to_time(shown[..., None])[..., 0]
    rate = grid.to_time((1j * grid.omega * shown)[..., None])[..., 0] if kernels.sees_rate(law) else x
    step = grid.period_time / grid.n_time
    start = modal_state(guess, grid.omega, step, modes)
    made = steady_loop(law, x, rate, modes, start, near=near, alone=alone, returns=grid.recorded_share, step=step)
    torque = grid.to_lines(made.torque[..., None])[..., 0]
    slope = kernels.mean_slope(law, grid.to_time((shown - compliance * torque)[..., None])[..., 0])[:, None]
    # The mean is shown as it is, and a gear within its dead band has no stiffness there to answer with.
    torque[:, 1:] += slope / (1.0 + slope * compliance[1:]) * (free - shown)[:, 1:]
    return torque, made
