"""A group of records at one operating point as spectra, and what of them is signal."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
import scipy.fft

from ident.time_steps import TimeSteps

# standard deviations of a velocity, and share of its rms, below which a motor may as well rest
SURE, CREEPING = 3.0, 0.02
NOISE_LINES = 10  # lines on either side over which the noise of the position is averaged
SIGNAL_LEVEL = 2.0  # power over noise below which a line of the position counts as noise
FAST_LEVEL = 1.5  # the same of the mean power of lines near by: that of noise alone differs by less from its own mean


@dataclass(frozen=True)
class Group:
    """Periodic records that share posture and frequency grid.

    Spectra are ``rfft(x) / period``: ``x(t) = X_0 + 2 Re sum_k X_k exp(j k 2 pi t / T)``.

    Attributes:
        operating_point: name of the posture, or of the segment for a motion.
        segments: names, S of them.
        U, Q: (S, L, n) mean spectra of torque (N m) and motor position (rad), lines 0..L-1.
        U_periods, Q_periods: (S, P, L, n) single periods, P >= 1.
        Q_link: (S, L, n) of the link encoders, or None.
        R: (S, L, n) of the excitation, in its own unit; None of a motion, and where it is not recorded.
        link_std: (n,) sample noise of the link encoders of a motion, rad, NaN where a joint has none; or None.
        links: joints whose link encoder is compared, M of them.
        n_slow: lines of the motion along which the geometry of the arm is solved, all where None.
        omega: (L,) rad/s.
        n_compared: lines that are compared, K of them: 0..K-1.
        excited: (S, L) True where a segment excites.
        n_time: points of the time grid over one period.
        window: (n_time,) weight of a motion in the time domain, or None for periodic data.
        amplitude: (S,) relative level.
        start: (S,) s, time of the first sample of the middle period, for drift over the recording.
        period_time: s.
        periods: (S,) number of periods averaged.
        rest: (S, n_time, n) where motors stand still, or turn.
        Q_fast: (S, F, n) mean spectra of the position beyond lines 0..L-1, as far as they are signal and the time grid
            reaches; None where laws along them are not asked for.
        noise_spacing, U_noise, Q_noise: (S, J, n) spectra of noise alone, every so many lines of the period, where a
            single period has no scatter (``ends_of_transients``); or None.
        known_noise: (n,) variances of a line of torque and position by white noise, N2 m2 and rad2, of a single period
            of which they are measured; or None.
        rounding: (K, n) variance of a line of the mean position by the steps of its encoder, rad2, which repeats with
            the motion and does not average out over periods; or None.
        steps: of a simulation that made the records; None of a machine.
        alike_turn_noise: (n,) as ``turn_noise``, in the mean over the periodic groups of a dataset that models are fitted
            to: friction must not turn otherwise in one posture than in another; that of the group where None.
        creeps: whether single periods end elsewhere than the one before, of a transient, or than they began.
        drift: (S, L, n) rad, lines of what single periods drift by, which ``Q`` is without and ``U`` is not; or None.
        white_noise, white_torque_noise: (n,) variance of a line of one period by the noise of its samples,
            rad2 and N2 m2.
    """

    operating_point: str
    segments: tuple[str, ...]
    U: np.ndarray
    Q: np.ndarray
    U_periods: np.ndarray
    Q_periods: np.ndarray
    Q_link: np.ndarray | None
    omega: np.ndarray
    n_compared: int
    excited: np.ndarray
    n_time: int
    window: np.ndarray | None
    amplitude: np.ndarray
    start: np.ndarray
    period_time: float
    periods: np.ndarray
    white_noise: np.ndarray
    white_torque_noise: np.ndarray
    rest: np.ndarray | None = None
    Q_fast: np.ndarray | None = None
    link_std: np.ndarray | None = None
    links: tuple[int, ...] = ()
    n_slow: int | None = None
    noise_spacing: int = 1
    U_noise: np.ndarray | None = None
    Q_noise: np.ndarray | None = None
    known_noise: tuple[np.ndarray, np.ndarray] | None = None
    rounding: np.ndarray | None = None
    alike_turn_noise: np.ndarray | None = None
    creeps: bool = False
    drift: np.ndarray | None = None
    steps: TimeSteps | None = None
    R: np.ndarray | None = None

    @property
    def shows_noise(self) -> bool:
        """Whether its noise is measured: by the scatter between periods, or by the end of the transient before a single
        one."""
        return self.window is None and (self.U_periods.shape[1] > 1 or self.U_noise is not None)

    @property
    def outputs(self) -> np.ndarray:
        """(S, L, n + M) what is compared: recorded torque, N m, then link positions, rad."""
        if not self.links:
            return self.U
        assert self.Q_link is not None  # of which links are compared
        return np.concatenate([self.U, self.Q_link[..., list(self.links)]], axis=-1)

    @cached_property
    def scatter(self) -> tuple[np.ndarray, np.ndarray, np.ndarray] | None:
        """Covariances (K, n, n) of torque, of torque and position, and of position, of noise of the means; sums over
        records.

        By the scatter between periods, or noise that is known of a single one; None where neither is, and beside link
        encoders.
        """
        periods = self.U_periods.shape[1]
        if self.links:
            return None
        if periods < 2:
            if self.known_noise is None:
                return None
            torque, position = (
                len(self.U) * np.tile(np.diag(x).astype(complex), (self.n_compared, 1, 1)) for x in self.known_noise
            )
            return torque, np.zeros_like(torque), position
        U, Q = (
            (x - x.mean(axis=1, keepdims=True))[:, :, : self.n_compared]
            .transpose(2, 3, 0, 1)
            .reshape(self.n_compared, x.shape[-1], -1)
            for x in (self.U_periods, self.Q_periods)
        )
        scale = periods * (periods - 1)
        return tuple(a @ b.conj().swapaxes(1, 2) / scale for a, b in ((U, U), (U, Q), (Q, Q)))

    @cached_property
    def position_noise(self) -> np.ndarray:
        """(L, n) variance of a line of the mean position, rad2.

        By the scatter between periods; white where there is one period, by the noise of its samples.
        """
        return line_noise(self.Q_periods, self.white_noise)

    @cached_property
    def signal_share(self) -> np.ndarray:
        """(S, L, n) share of each line of the position that is signal, 0 to 1.

        Laws that turn on a reversal see a noisy position reverse where the joint stands still; they
        are shown the motion without the lines that hold noise alone.
        """
        return signal_share(self.Q, self.position_noise)

    @cached_property
    def shown_error(self) -> np.ndarray:
        """(S, L, n) power by which that motion is off, rad2: the noise it holds, and the signal it has lost.

        By Stein's unbiased estimate (Stein 1981), in the mean over lines near by, which takes away most of its own
        scatter; what is below zero then counts as none.
        """
        noise, power = self.position_noise, np.abs(self.Q) ** 2
        least = SIGNAL_LEVEL * noise
        risk = np.where(power > least, noise + least**2 / np.maximum(power, 1e-300), power - noise)
        risk[:, 0] = noise[0]  # the mean is shown as it is
        mean = mean_over_lines(risk.swapaxes(0, 1), NOISE_LINES).swapaxes(0, 1)
        mean[:, 0] = 0.0
        return np.maximum(mean, 0.0)

    @cached_property
    def slow_velocity(self) -> np.ndarray:
        """(S, n_time, n) motor velocity in lines 0..L-1, without those of noise alone, rad/s."""
        return self.to_time(1j * self.omega[:, None] * self.signal_share * self.Q)

    @cached_property
    def velocity_error(self) -> np.ndarray:
        """(S, n) by which that is off, rad/s rms."""
        return np.sqrt(2.0 * np.sum(self.omega[:, None] ** 2 * self.shown_error, axis=1))

    @cached_property
    def turn_noise(self) -> np.ndarray:
        """(n,) the same in the mean over records."""
        if self.alike_turn_noise is not None:
            return self.alike_turn_noise
        return np.sqrt(np.mean(self.velocity_error**2, axis=0))

    @cached_property
    def least_velocity(self) -> np.ndarray:
        """(S, n) below which a motor may as well rest: what its velocity is off by, or little, rad/s."""
        return np.maximum(SURE * self.velocity_error, CREEPING * np.sqrt(np.mean(self.slow_velocity**2, axis=1)))

    @cached_property
    def fast_velocity(self) -> np.ndarray | None:
        """(S, n_time, n) motor velocity in the lines beyond L, rad/s: where dry friction turns the acceleration jumps."""
        if self.Q_fast is None:
            return None
        L, count = len(self.omega), self.Q_fast.shape[1]
        V = np.zeros((len(self.Q_fast), L + count, self.Q_fast.shape[2]), complex)
        V[:, L:] = 2j * np.pi / self.period_time * np.arange(L, L + count)[:, None] * self.Q_fast
        return self.to_time(V)

    @cached_property
    def velocity(self) -> np.ndarray:
        """(S, n_time, n) motor velocity in all lines that are known, without those of noise alone, rad/s."""
        return self.slow_velocity if self.fast_velocity is None else self.slow_velocity + self.fast_velocity

    @cached_property
    def velocity_of(self) -> np.ndarray:
        """(n, S, n_time) the same by motor."""
        return np.ascontiguousarray(np.moveaxis(self.velocity, -1, 0))

    @cached_property
    def torque_share(self) -> np.ndarray:
        """(S, L, n) the same of the torque: a law that clips it would clip its noise, and so explain that."""
        return signal_share(self.U, self.torque_noise)

    @cached_property
    def torque_noise(self) -> np.ndarray:
        """(L, n) variance of a line of the mean torque, N2 m2, as that of the position."""
        return line_noise(self.U_periods, self.white_torque_noise)

    @property
    def posture(self) -> np.ndarray:
        """(n,) mean motor position, rad."""
        return self.Q[:, 0].real.mean(axis=0)

    def pick(self, rows: np.ndarray) -> Group:
        """The group with some of its segments."""
        names = (
            "U",
            "Q",
            "U_periods",
            "Q_periods",
            "Q_link",
            "R",
            "excited",
            "amplitude",
            "start",
            "periods",
            "rest",
            "Q_fast",
            "U_noise",
            "Q_noise",
            "drift",
        )
        parts = {name: getattr(self, name) for name in names}
        kept: dict[str, Any] = {name: None if x is None else x[rows] for name, x in parts.items()}
        return replace(self, segments=tuple(self.segments[i] for i in rows), **kept)

    def slow(self) -> Group:
        """The group with the lines of the geometry alone."""
        names = ("U", "Q", "U_periods", "Q_periods", "Q_link", "R", "drift")
        parts = {name: getattr(self, name) for name in names}
        cut: dict[str, Any] = {name: None if x is None else x[..., : self.n_slow, :] for name, x in parts.items()}
        return replace(
            self,
            omega=self.omega[: self.n_slow],
            excited=self.excited[:, : self.n_slow],
            n_slow=None,
            Q_fast=None,
            **cut,
        )

    @property
    def recorded_share(self) -> float:
        """Share of a period that was recorded; of a motion the rest is the return that closes it."""
        return 1.0 if self.window is None else float(np.flatnonzero(self.window)[-1] + 1) / len(self.window)

    @property
    def window_share(self) -> float:
        """Share of the power of a record that its window leaves; 1 where there is none."""
        return 1.0 if self.window is None else float(np.mean(self.window**2))

    def to_time(self, X: np.ndarray) -> np.ndarray:
        """Spectrum (..., L, m) on the time grid (..., n_time, m)."""
        return to_time(X, self.n_time)

    def to_lines(self, x: np.ndarray) -> np.ndarray:
        """Time grid (..., n_time, m) to spectrum (..., L, m)."""
        return to_lines(x, len(self.omega))

    @cached_property
    def _coarse_window(self) -> np.ndarray:
        """The window on the coarsest grid of time on which its product with a signal has the compared lines right."""
        assert self.window is not None
        reach = self.n_compared + len(self.omega)  # from a line of a signal to a compared one, or to its conjugate
        n = scipy.fft.next_fast_len(2 * reach, real=True)
        return self.window if n >= self.n_time else to_time(to_lines(self.window[:, None], reach), n)[:, 0]

    def observe(self, X: np.ndarray) -> np.ndarray:
        """What of a torque spectrum (..., L, m) is compared: its windowed lines (..., K, m).

        The grid of time of the group is far finer than the compared lines need: the window has a grid of its own.
        """
        if self.window is None:
            return X[..., : self.n_compared, :]
        window = self._coarse_window
        return to_lines(to_time(X, len(window)) * window[:, None], self.n_compared)

    def observe_outputs(self, X: np.ndarray) -> np.ndarray:
        """``observe`` for outputs (S, L, n + M, ...); (S, K, n + M, ...).

        The zero of a link encoder is not known: its mean over the window is left out.
        """
        flat = X.reshape(*X.shape[:2], -1)
        if self.links:
            assert self.window is not None  # link encoders are compared along motions
            first = self.U.shape[-1] * flat.shape[-1] // X.shape[2]
            share = self.window**2 / np.sum(self.window**2)
            flat = flat.copy()
            flat[:, 0, first:] -= np.einsum("t,stm->sm", share, self.to_time(flat[..., first:]))
        return self.observe(flat).reshape(len(X), self.n_compared, *X.shape[2:])


def to_time(X: np.ndarray, n_time: int) -> np.ndarray:
    """Spectrum (..., L, m) on a grid of time (..., n_time, m)."""
    return scipy.fft.irfft(X, n=n_time, axis=-2, norm="forward")


def to_lines(x: np.ndarray, lines: int) -> np.ndarray:
    """The first lines (..., lines, m) of a signal on a grid of time (..., T, m)."""
    return scipy.fft.rfft(x, axis=-2, norm="forward")[..., :lines, :]


def line_noise(X_periods: np.ndarray, white: np.ndarray) -> np.ndarray:
    """(L, n) variance of a line of the mean over periods (S, P, L, n)."""
    P = X_periods.shape[1]
    if P < 2:
        return np.ones((X_periods.shape[2], 1)) * white
    d = X_periods - X_periods.mean(axis=1, keepdims=True)
    power = np.sum(np.abs(d) ** 2, axis=(0, 1)) / (len(d) * (P - 1) * P)
    return mean_over_lines(power, NOISE_LINES)


def signal_power(X_periods: np.ndarray, white: np.ndarray) -> np.ndarray:
    """Mean (S, L, n) over periods (S, P, L, n) of lines that hold little but noise, each by the share of signal near by
    (Wiener 1949)."""
    mean = X_periods.mean(axis=1)
    if not mean.shape[1]:
        return mean
    power = mean_over_lines((np.abs(mean) ** 2).swapaxes(0, 1), NOISE_LINES).swapaxes(0, 1)
    noise = line_noise(X_periods, white)
    return np.maximum(1.0 - FAST_LEVEL * noise / np.maximum(power, 1e-300), 0.0) * mean


def signal_share(X: np.ndarray, noise: np.ndarray) -> np.ndarray:
    """Share of each line (S, L, ...) that is signal, of which ``noise`` (L, ...) is the variance; the mean is."""
    share = np.maximum(1.0 - SIGNAL_LEVEL * noise / np.maximum(np.abs(X) ** 2, 1e-300), 0.0)
    share[:, 0] = 1.0
    return share


def mean_over_lines(x: np.ndarray, half: int) -> np.ndarray:
    """Mean of (L, ...) over lines l - half .. l + half."""
    total = np.cumsum(np.concatenate([np.zeros_like(x[:1]), x]), axis=0)
    at = np.arange(len(x))
    low, high = np.maximum(at - half, 0), np.minimum(at + half + 1, len(x))
    return (total[high] - total[low]) / (high - low).reshape(-1, *[1] * (x.ndim - 1))
