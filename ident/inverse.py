"""Motor torque along measured motor motion: the nonlinear gray-box, inverted.

The elastic coordinates are solved from the measured motor motion: a stable problem that needs no
controller, because with the motors prescribed the link side hangs on its springs. Linear dynamics
are exact in the frequency domain; what is nonlinear enters as torques evaluated in time:

    A(s) Q_a = S (C T Q_m + H) - W - L,      tau_s = C (T Q_m - S^T Q_a) + H
    U        = (s^2 J + s f) Q_m + T^T tau_s + F

``W`` is what inverse dynamics along ``q_a(t)`` has beyond the linearised arm (geometry), ``H`` a
torque in parallel with a spring, ``L`` one on the link side, ``F`` one at the motor. Effects supply
``H``, ``L``, ``F``, a correction of the position signal, or a filter of the recorded torque.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import scipy.fft

from ident.chain import Structure
from ident.columns import Products
from ident.graybox import (
    Linearisation,
    Parameters,
    alias_response,
    damping_diagonal,
    equilibrium,
    hold_response,
    impedance,
    linearise,
    rotor_inertia,
    stiff_gear_images,
    stiffness_diagonal,
)
from ident.group import Group
from ident.mixing import mixed
from ident.motion import Solution, Torques
from ident.recursion import chain_of, newton_euler
from ident.time_steps import TimeSteps, differences
from ident.varying import Varying, along

REMAINDER_STEPS = 250  # fixed-point steps at most for the geometric remainder
REMAINDER_CHANGE = 1e-6  # change, relative to the largest remainder, that ends them from a cold start
PLAIN_STEPS = 4  # in which the change must halve, or the arm is linearised along the motion
NEWTON_STEPS = 12  # the same of steps with that: where no motion repeats the search for one does not end
ROOM = 1 << 29  # bytes for past steps
NEAR_CHANGE = 1e-4  # the same from that of a model near by: the next step of a contraction brings far less
LEAST_KEPT = 0.1  # of the torque, that its record keeps of any line
ROUNDING = 1e-12  # of the recorded torque, below which a remainder is none
REMAINDER_POINTS = 2.5  # time grid of the remainder, in points per line
REACTION_CHANGE = 1e-5  # relative change that ends them


@dataclass(frozen=True)
class Sampling:
    """How torque and position were sampled: sample time, s, the hold of the torque, what its record loses towards
    high frequencies at all joints alike, s2 (``roll_off``), and by how much later than recorded an excitation acts, s
    (``late_excitation``)."""

    sample_time: float
    hold: str
    roll_off: float = 0.0
    late_excitation: float = 0.0


@dataclass(frozen=True)
class Plane:
    """The arm linearised at a group's posture, at its lines.

    Attributes:
        lin: equilibrium and matrices.
        s: (L,) j omega. steps: of the group.
        Z: (L, n, n) motor torque per motor position, continuous.
        A_inv: (L, N, N); C: (L, n).
        record: (L,) recorded torque per continuous torque.
        spring_gain: (L, n, n) motor torque per torque in parallel with a spring.
        link_gain: (L, n, N) motor torque per opposing torque on a link coordinate.
        link_per_position: (L, M, n) motion of the links whose encoders are compared per motor position.
        link_per_spring: (L, M, n) rad per N m in parallel with a spring.
        link_per_load: (L, M, N) rad per N m that opposes on a link coordinate.
    """

    lin: Linearisation
    s: np.ndarray
    steps: TimeSteps | None
    Z: np.ndarray
    A_inv: np.ndarray
    C: np.ndarray
    record: np.ndarray
    spring_gain: np.ndarray
    link_gain: np.ndarray
    link_per_position: np.ndarray
    link_per_spring: np.ndarray
    link_per_load: np.ndarray

    @cached_property
    def differences(self) -> tuple[np.ndarray, np.ndarray]:
        """(L,) of a position its velocity and its acceleration, as dampers and inertias see them."""
        return differences(self.s, self.steps)

    def outputs(self, torque: np.ndarray, link: np.ndarray) -> np.ndarray:
        """Responses (L, n, ...) of the motor torque, as recorded, and below them (L, M, ...) those of the links."""
        return np.concatenate([self.record[:, None, None] * torque, link], axis=1)

    @cached_property
    def output_per_position(self) -> np.ndarray:
        """(L, n + M, n) recorded torque and link positions per motor position."""
        return self.outputs(self.Z, self.link_per_position)

    @cached_property
    def output_per_spring(self) -> np.ndarray:
        """(L, n + M, n) the same per torque in parallel with a spring."""
        return self.outputs(self.spring_gain, self.link_per_spring)

    @cached_property
    def output_per_load(self) -> np.ndarray:
        """(L, n + M, N) the same per torque that opposes on a link coordinate."""
        return self.outputs(self.link_gain, self.link_per_load)

    @cached_property
    def output_per_motor(self) -> np.ndarray:
        """(L, n + M, n) the same per torque at a motor."""
        return self.outputs(np.eye(self.Z.shape[-1])[None], np.zeros_like(self.link_per_position))


def make_plane(structure: Structure, par: Parameters, group: Group, sampling: Sampling) -> Plane:
    """Linearise a group at its own parameter-dependent equilibrium."""
    lin = linearise(structure, equilibrium(structure, par, group.posture))
    return plane_at(structure, par, lin, group, torque_record(par, group, sampling))


def torque_record(par: Parameters, group: Group, sampling: Sampling) -> np.ndarray:
    """Recorded torque per continuous torque of each line; (L,)."""
    hold = hold_response(group.omega, sampling.sample_time, sampling.hold)
    if group.steps is not None and sampling.hold == "zoh":  # such a step holds no torque itself
        hold = hold / np.abs(hold_response(group.omega, group.steps.length, "zoh"))
    return recorded_share(group.omega, par.timing, sampling.roll_off) / hold


def recorded_share(omega: np.ndarray, timing: float, roll_off: float) -> np.ndarray:
    """What a record holds of the torque of a line, beside how that is held; (L,)."""
    return np.exp(1j * omega * timing) * np.maximum(1.0 - roll_off * omega**2, LEAST_KEPT)


def plane_at(structure: Structure, par: Parameters, lin: Linearisation, group: Group, record: np.ndarray) -> Plane:
    """The linear arm at a given linearisation; ``record`` (L,) as in ``Plane``."""
    s = 1j * group.omega
    Z, A_inv, C = impedance(structure, par, lin, s, group.steps)
    driven = structure.driven
    link_gain = par.coupling.T @ (C[:, :, None] * A_inv[:, driven, :])
    spring_gain = par.coupling.T - link_gain[:, :, driven]
    rows = A_inv[:, driven[list(group.links)]]
    link_per_spring = rows[..., driven]
    link_per_position = (link_per_spring * C[:, None]) @ par.coupling
    gains = (spring_gain, link_gain, link_per_position, link_per_spring, -rows)
    return Plane(lin, s, group.steps, Z, A_inv, C, record, *gains)


def true_position(
    structure: Structure,
    par: Parameters,
    plane: Plane,
    group: Group,
    sampling: Sampling,
    filters: Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]] | None = None,
) -> np.ndarray:
    """Motor position without what the images of the held torque add; (S, L, n) rad, that of the group itself where none
    is held. ``filters`` as of ``stiff_gear_images``."""
    if sampling.hold == "none":
        return group.Q
    held = sampling.sample_time, sampling.hold
    passed = None if filters is None else lambda s: 1.0 / np.prod(filters(s), axis=0)
    alias = alias_response(group.omega, *held, passed).reshape(len(group.omega), -1)
    Q = group.Q - alias * group.U / par.inertia
    if group.steps is not None:  # such a step holds no torque itself
        return Q
    images = stiff_gear_images(structure, par, plane.lin, group.omega, *held, filters)
    return Q if images is None else Q - np.einsum("lij,slj->sli", images, group.U)


def drifting_torque(Z: np.ndarray, drift: np.ndarray) -> np.ndarray:
    """(S, L, n) torque along a line of the position, of lines ``drift`` (S, L, n), so slowly that the arm follows at rest.

    Args:
        Z: (L, n, n) torque per motor position, of which the first line above zero tells what a velocity takes.
    """
    out = drift @ Z[0].real.T
    out[:, 0] += drift[:, 1].imag @ Z[1].imag.T  # the mean velocity of a line is omega_1 Im X_1
    return out


def static_remainder(structure: Structure, par: Parameters, plane: Plane, group: Group) -> np.ndarray:
    """Remainder of the arm at rest: the gravity torque about which it is linearised; (S, L, N)."""
    S, L = group.U.shape[:2]
    W = np.zeros((S, L, structure.n_coordinates), complex)
    W[:, 0] = plane.lin.g - plane.lin.Kg @ plane.lin.q
    return W


def link_motion(
    structure: Structure, par: Parameters, plane: Plane, Q: np.ndarray, W: np.ndarray, torques: Torques
) -> np.ndarray:
    """Link coordinates (S, L, N) with the motors prescribed."""
    drive = plane.C * (Q @ par.coupling.T) + torques.spring
    load = -W - torques.link
    load[..., structure.driven] += drive
    # A line at a time, all records at once.
    return np.matmul(load.swapaxes(0, 1), plane.A_inv.swapaxes(1, 2)).swapaxes(0, 1)


def geometric_remainder(structure: Structure, plane: Plane, group: Group, Q_a: np.ndarray) -> np.ndarray:
    """Inverse dynamics along ``q_a`` less the linearised arm, in its slow lines; (S, L, N) N m.

    Faster than the modes of the links a fixed point of it need not be near; what is so fast there is a jump, and small.
    """
    coarse = coarse_group(group)
    slow = len(coarse.omega)
    q, v, a = (coarse.to_time(plane.s[:slow, None] ** k * Q_a[:, :slow]) for k in range(3))
    tau = inverse_dynamics(structure, q, v, a)
    linear = a @ plane.lin.M + q @ plane.lin.Kg.T
    out = np.zeros_like(Q_a)
    out[:, :slow] = coarse.to_lines(tau - linear)
    return out


def inverse_dynamics(structure: Structure, q: np.ndarray, v: np.ndarray, a: np.ndarray) -> np.ndarray:
    """Torques of the chain along arrays (..., N); (..., N) N m."""
    flat = [x.reshape(-1, q.shape[-1]) for x in (q, v, a)]
    return newton_euler(chain_of(structure.model), *flat).reshape(q.shape)


def solve(
    structure: Structure,
    par: Parameters,
    plane: Plane,
    group: Group,
    sampling: Sampling,
    *,
    Q: np.ndarray | None = None,
    W: np.ndarray | None = None,
    torques: Torques = Torques(),
    react: Callable[[Solution], Torques] | None = None,
    passes: int = 1,
    steps: int = 0,
) -> Solution:
    """Recorded motor torque that the model predicts along the measured motion.

    Args:
        Q: (S, L, n) motor position; ``true_position`` where None.
        W: (S, L, N) geometric remainder to start from; that of the arm at rest where None.
        torques: what effects add, at the start where they depend on the motion.
        react: torques that go with a solution; the result is consistent with them. None holds
            ``torques``.
        passes: of ``react`` at most until they do; one where it is exact by itself.
        steps: on the remainder, at most; a start that is near ends them sooner.

    Raises:
        FloatingPointError: the motion of the links runs away, beside steps enough to solve it.
    """
    if Q is None:
        Q = true_position(structure, par, plane, group, sampling)
    enough = NEAR_CHANGE
    if W is None:
        W, enough = static_remainder(structure, par, plane, group), REMAINDER_CHANGE

    def settled(W: np.ndarray, torques: Torques) -> Torques:
        return torques if react is None else _settle(structure, par, plane, Q, W, torques, react, passes)

    def motion(W: np.ndarray, torques: Torques) -> np.ndarray:
        return link_motion(structure, par, plane, Q, W, torques)

    def change(W: np.ndarray, torques: Torques) -> np.ndarray:
        return geometric_remainder(structure, plane, group, motion(W, torques)) - W

    search = _Search(change, settled, ROUNDING * np.abs(group.U).max(), enough)
    varying = torques.varying
    torques = settled(W, torques)
    step = plain_step if varying is None else varying.step
    W, torques, left = search.run(W, torques, np.arange(len(W)), step, steps, PLAIN_STEPS)
    if len(left) and steps > 2 * PLAIN_STEPS:  # so many tell that it creeps
        # Where links hang on lightly damped gears and move far, steps by the arm at rest lead away.
        varying = along_motion(structure, par, plane, group, left, motion(W, torques)[left])
        W, torques, _ = search.run(W, torques, left, varying.step, steps, NEWTON_STEPS)
        if not np.all(np.isfinite(change(W, torques)[left])):
            raise FloatingPointError("the motion of the links cannot be solved")
    return _solution(structure, par, plane, Q, W, replace(torques, varying=varying))


def along_motion(
    structure: Structure, par: Parameters, plane: Plane, group: Group, records: np.ndarray, Q_a: np.ndarray
) -> Varying:
    """The links linearised along motions (S, L, N) of some records of a group.

    Raises:
        FloatingPointError: no arm moves so.
    """
    springs = stiffness_diagonal(structure, par), damping_diagonal(structure, par)
    try:
        return along(chain_of(structure.model), *springs, (plane.lin.M, plane.lin.Kg), group, records, Q_a)
    except np.linalg.LinAlgError:
        raise FloatingPointError("the links cannot be linearised along their motion") from None


def plain_step(change: np.ndarray, records: np.ndarray) -> np.ndarray:
    """By how much to move the remainder of records, by the arm at rest."""
    return change


@dataclass(frozen=True)
class _Search:
    """For a remainder that the motion which it causes has.

    Attributes:
        change: of a remainder (S, L, N) with torques.
        settled: torques with a remainder, from those of one near by.
        rounding: N m, below which a remainder is none.
        enough: change, relative to the largest remainder, that ends it.
    """

    change: Callable[[np.ndarray, Torques], np.ndarray]
    settled: Callable[[np.ndarray, Torques], Torques]
    rounding: float
    enough: float

    def run(
        self,
        W: np.ndarray,
        torques: Torques,
        left: np.ndarray,
        step: Callable[[np.ndarray, np.ndarray], np.ndarray],
        steps: int,
        patience: int,
    ) -> tuple[np.ndarray, Torques, np.ndarray]:
        """The remainder after all steps, or the nearest one where they lead nowhere, torques with it, and the records
        that are not there yet.

        Args:
            left: records to solve.
            step: of the remainders of records, from their changes and which they are.
            steps: at most.
            patience: steps in which the change must halve.
        """
        nearest, begin, least = W.copy(), torques, np.full(len(W), np.inf)
        changes: list[float] = []
        past: list[tuple[np.ndarray, np.ndarray]] = []
        for _ in range(steps):
            change = self.change(W, torques)[left]
            off = np.abs(change).max(axis=(1, 2)) / max(np.abs(W).max(), self.rounding)
            if not np.all(np.isfinite(off)):
                break
            better = left[off < least[left]]
            nearest[better], least[left] = W[better], np.minimum(off, least[left])
            past = [*past, (W[left], step(change, left))][-max(PLAIN_STEPS, ROOM // (4 * W[left].nbytes)) :]
            W = W.copy()
            W[left] = mixed(past)
            torques = self.settled(W, torques)
            moving = off > self.enough
            nearest[left[~moving]] = W[left[~moving]]
            changes.append(float(off.max()))
            left, past = left[moving], [(x[moving], f[moving]) for x, f in past]
            if not len(left):
                return W, torques, left
            if stalled(changes, patience):
                break
        else:
            return W, torques, left  # all steps were asked for: what the last one brings is not looked at
        return nearest, self.settled(nearest, begin), left


def stalled(changes: Sequence[float], patience: int) -> bool:
    """Whether the last so many changes of a search for a fixed point have none below half of all before."""
    last, before = changes[-patience:], changes[:-patience]
    return len(before) >= patience and min(last) > 0.5 * min(before)


def _settle(
    structure: Structure,
    par: Parameters,
    plane: Plane,
    Q: np.ndarray,
    W: np.ndarray,
    torques: Torques,
    react: Callable[[Solution], Torques],
    passes: int,
) -> Torques:
    """Torques that are consistent with the motion that they cause, the remainder held."""
    last = np.inf
    for _ in range(passes):
        new = react(_solution(structure, par, plane, Q, W, torques))
        change = sum(float(np.sum(np.abs(np.asarray(x) - y) ** 2)) for x, y in _pairs(new, torques))
        size = sum(float(np.sum(np.abs(x) ** 2)) for x, _ in _pairs(new, torques))
        torques = new
        if change <= REACTION_CHANGE**2 * size or change > last:
            break
        last = change
    return torques


def _pairs(a: Torques, b: Torques) -> tuple:
    return (a.spring, b.spring), (a.link, b.link), (a.motor, b.motor)


def _solution(
    structure: Structure, par: Parameters, plane: Plane, Q: np.ndarray, W: np.ndarray, torques: Torques
) -> Solution:
    Q_a = link_motion(structure, par, plane, Q, W, torques)
    Q_driven = Q_a[..., structure.driven]
    delta = Q @ par.coupling.T - Q_driven
    tau_s = plane.C * delta + torques.spring
    rate, square = (x[:, None] for x in plane.differences)
    U = (square * rotor_inertia(par, plane.steps) + rate * par.viscous) * Q + tau_s @ par.coupling + torques.motor
    return Solution(Q, Q_a, Q_driven, delta, tau_s, plane.record[:, None] * U, W, torques)


def baseline_products(structure: Structure, par: Parameters, plane: Plane, solution: Solution, top: int) -> Products:
    """Derivative of the predicted outputs by the log-parameters, at lines 0..top-1.

    Torques of effects and the geometric remainder are held. Columns in the order of the parameters.
    """
    n, elastic = structure.n, np.asarray(structure.elastic, int)
    rate, square = (x[:top, None] for x in plane.differences)
    springs = plane.output_per_spring[:top]
    motors = plane.output_per_motor[:top]
    hinges = plane.output_per_load[:top, :, elastic]
    gains = np.concatenate(
        [
            springs * par.stiffness,
            springs * (par.damping * rate)[:, None],
            motors * (par.inertia * square)[:, None],
            motors * (par.viscous * rate)[:, None],
            hinges * par.elastic_stiffness,
            hinges * (par.elastic_damping * rate)[:, None],
        ],
        axis=-1,
    )
    signals = np.concatenate([solution.delta[:, :top], solution.Q[:, :top], solution.Q_a[:, :top, elastic]], axis=-1)
    k, e = np.arange(n), 2 * n + np.arange(len(elastic))
    return Products(gains, signals, np.concatenate([k, k, n + k, n + k, e, e]))


def coarse_group(group: Group) -> Group:
    """The slow lines of a group, on the grid of the geometric remainder.

    Products of two signals of the compared band stay below its Nyquist frequency; those of four
    fold to its edge.
    """
    slow = group.slow()
    return replace(slow, n_time=scipy.fft.next_fast_len(int(REMAINDER_POINTS * len(slow.omega)), real=True))
