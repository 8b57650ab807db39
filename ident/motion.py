"""A solution of the arm along measured motion, and the time signals of it that laws ask for."""

from __future__ import annotations

from collections.abc import Callable, Hashable, Mapping
from dataclasses import dataclass, field

import numpy as np

from ident.graybox import Parameters, rotor_inertia
from ident.group import Group, signal_share
from ident.time_steps import differences
from ident.varying import Varying


@dataclass(frozen=True)
class Steady:
    """A law in steady state with the arm.

    Attributes:
        torque: (S, T) N m.
        start: (modes, S) complex state of the arm one step before the period; memory: (3, S) what the law remembers
            there.
    """

    torque: np.ndarray
    start: np.ndarray
    memory: np.ndarray


@dataclass(frozen=True)
class Torques:
    """What effects add to the linear arm, as spectra; each (S, L, n) or (S, L, N) for ``link``.

    ``steady``: of laws that the arm moves, by the ``key`` of their hypothesis, as they were solved, from which others go
    on; so they do from ``varying``, the links along a motion that was not found without.
    """

    spring: np.ndarray | float = 0.0
    link: np.ndarray | float = 0.0
    motor: np.ndarray | float = 0.0
    steady: Mapping[tuple[str, str], Steady] = field(default_factory=dict)
    varying: Varying | None = None


@dataclass(frozen=True)
class Solution:
    """A prediction and its parts; spectra of (S, L, .).

    ``Q_a`` holds all coordinates of the links, ``Q_driven`` those that the joints drive, in their order. ``signals``:
    in time, what was made of any of these but ``U`` already.
    """

    Q: np.ndarray
    Q_a: np.ndarray
    Q_driven: np.ndarray
    delta: np.ndarray
    tau_s: np.ndarray
    U: np.ndarray
    W: np.ndarray
    torques: Torques
    signals: dict[Hashable, np.ndarray] = field(default_factory=dict, repr=False, compare=False)


@dataclass(frozen=True)
class Recorded:
    """Time signals of records alone, for drives that are asked before a solution is known; each (S, T) on the group's
    grid."""

    group: Group

    def torque(self, joint: int) -> np.ndarray:
        """Recorded motor torque without lines of noise alone, N m."""
        return self._time(self.group.U, joint, share=self.group.torque_share[..., joint])

    def peak_torque(self, joint: int) -> float:
        """Largest recorded motor torque, N m."""
        return float(np.max(self.torque_sizes(joint)))

    def usual_torque(self, joint: int) -> float:
        """Recorded motor torque that is exceeded half of the time, N m."""
        return float(np.median(self.torque_sizes(joint)))

    def torque_sizes(self, joint: int) -> np.ndarray:
        """Sizes of the recorded motor torque, N m; the return that closes a motion was not recorded."""
        u = np.abs(self.torque(joint))
        return u if self.group.window is None else u[:, self.group.window > 0.0]

    @property
    def time(self) -> np.ndarray:
        """Time since the start of the recording, s."""
        T = self.group.n_time
        return self.group.start[:, None] + np.arange(T) * self.group.period_time / T

    @property
    def time_step(self) -> float:
        """Step of the grid, s."""
        return self.group.period_time / self.group.n_time

    def lines(self, x: np.ndarray) -> np.ndarray:
        """Time signal (S, T) to spectrum (S, L)."""
        return self.group.to_lines(x[..., None])[..., 0]

    def _time(self, X: np.ndarray, column: int, order: int = 0, share: np.ndarray | float = 1.0) -> np.ndarray:
        x = share * X[..., column]
        x = x * (1j * self.group.omega) ** order if order else x
        return self.group.to_time(x[..., None])[..., 0]


@dataclass(frozen=True)
class Motion(Recorded):
    """Time signals of a solution, made where they are first asked for; each (S, T) on the group's grid, not to be
    written to.

    ``beside``: spectra (S, L, n) of what else acts at the motors, N m. ``error``: the same, rad, by which the position
    that laws see is taken off. ``delivered``: the same, N m, what the motors deliver by the record; the record itself
    where None. ``told``: joints at which the record says another torque already, and none of a friction at rest.
    """

    solution: Solution
    par: Parameters
    beside: np.ndarray | float = 0.0
    error: np.ndarray | float = 0.0
    delivered: np.ndarray | None = None
    told: frozenset[int] = frozenset()
    asked_of: dict[int, np.ndarray] = field(default_factory=dict, init=False, repr=False, compare=False)

    def kept(self, key: Hashable, make: Callable[[], np.ndarray]) -> np.ndarray:
        """A signal (S, T) of the solution, which is made once: laws ask for it again with every step of their
        parameters."""
        if isinstance(self.error, np.ndarray):
            return make()
        signals = self.solution.signals
        if key not in signals:
            signals[key] = make()
        return signals[key]

    def q(self, joint: int) -> np.ndarray:
        """Motor position without lines of noise alone, rad."""
        return self.kept(("q", joint), lambda: self._shown(joint, 0))

    def v(self, joint: int) -> np.ndarray:
        """Motor velocity without lines of noise alone, rad/s."""
        if self.solution.Q is self.group.Q and not isinstance(self.error, np.ndarray):
            return self.group.velocity_of[joint]
        fast = 0.0 if self.group.fast_velocity is None else self.group.fast_velocity[..., joint]
        return self.kept(("v", joint), lambda: self._shown(joint, 1) + fast)

    def unseen(self, joint: int) -> np.ndarray:
        """Spectrum (S, L) of the motor position that laws are not shown: its noise, rad."""
        return (1.0 - self.group.signal_share[..., joint]) * self.solution.Q[..., joint]

    def acceleration(self, joint: int) -> np.ndarray:
        """Motor acceleration, rad/s2."""
        return self._time(self.solution.Q, joint, 2)

    def delta(self, joint: int) -> np.ndarray:
        """Deflection of the gear, rad."""
        return self.kept(("delta", joint), lambda: self._time(self.solution.delta, joint))

    def delta_rate(self, joint: int) -> np.ndarray:
        """Its rate, rad/s."""
        return self.kept(("delta_rate", joint), lambda: self._time(self.solution.delta, joint, 1))

    def tau_s(self, joint: int) -> np.ndarray:
        """Torque that the gear carries, N m."""
        return self.kept(("tau_s", joint), lambda: self._time(self.solution.tau_s, joint))

    def q_link(self, joint: int) -> np.ndarray:
        """Position of the link behind the gear, rad."""
        return self.kept(("q_link", joint), lambda: self._time(self.solution.Q_driven, joint))

    def v_link(self, joint: int) -> np.ndarray:
        """Its velocity, rad/s."""
        return self.kept(("v_link", joint), lambda: self._time(self.solution.Q_driven, joint, 1))

    def asked(self, joint: int) -> np.ndarray:
        """Torque that the record leaves to a friction of the motor, N m."""
        if joint not in self.asked_of:
            self.asked_of[joint] = self._asked(joint)
        return self.asked_of[joint]

    def _asked(self, joint: int) -> np.ndarray:
        rate, square = differences(1j * self.group.omega, self.group.steps)
        x = self.solution
        linear = (square * rotor_inertia(self.par, self.group.steps)[joint] + rate * self.par.viscous[joint]) * x.Q[
            ..., joint
        ]
        carried = x.tau_s @ self.par.coupling[:, joint]
        others = self.beside[..., joint] if isinstance(self.beside, np.ndarray) else self.beside
        given = self.group.U if self.delivered is None else self.delivered
        left = given[..., joint] - linear - carried - others
        # What is cut off at the size of a friction mixes the noise of fast lines, where it is largest, into all.
        left = signal_share(left, self._asked_noise(joint)) * left
        return self.group.to_time(left[..., None])[..., 0]

    def asked_noise(self, joint: int) -> float:
        """Standard deviation of what is asked by noise of the samples of motor position and torque, N m; in the mean
        over records."""
        return float(np.sqrt(2.0 * np.sum(self._asked_noise(joint))))

    def _asked_noise(self, joint: int) -> np.ndarray:
        """(L,) its variance, N2 m2."""
        group, s = self.group, 1j * self.group.omega
        gain = np.abs(s**2 * self.par.inertia[joint] + s * self.par.viscous[joint]) ** 2
        return (gain * group.white_noise[joint] + group.white_torque_noise[joint]) * np.mean(1.0 / group.periods)

    def _shown(self, joint: int, order: int) -> np.ndarray:
        x = self.group.signal_share[..., joint] * self.solution.Q[..., joint]
        if isinstance(self.error, np.ndarray):
            x = x + self.error[..., joint]
        return self._time(x[..., None], 0, order)
