"""Segments reduced to what the torque equation needs: spectra of torque and position.

A record group holds the segments of one operating point that share a period. A motion without
periodicity is a group of its own: it is closed into a period by a smooth return, and a window
keeps the return and the first transient out of every comparison.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import scipy.fft
import scipy.ndimage

from ident.dataset import Dataset, Segment
from robot_assets.errors import DataError

RETURN_TIME = 8.0  # s, least time in which a motion is led back to its start: what still rings then has decayed
BRAKE_TIME = 1.0  # s, in which the acceleration at the ends of a motion fades in its return
END_TIME = 0.1  # s, over which slope and curvature of an end are taken
END_SAMPLES = 12  # at least
REST_TIME, REST_SAMPLES = 0.05, 5  # s, and samples at least, within which a motor that stands still does not move
REST_NOISE = 6.0  # beyond this many standard deviations of its noise
SURE, CREEPING = 3.0, 0.02  # standard deviations of a velocity, and share of its rms, below which a motor may as well rest
SETTLE_TIME = 0.5  # s, tapered at both ends of a motion
BORDER_SAMPLES = 8  # at either end of a period, from which it is told where it begins and ends
CREEP = 6.0  # standard deviations of their noise, by which both must differ
MOTION_RATE = 2000.0  # 1/s, of the time grid of motions, at most: enough for the ripple of a fast motor
POINTS_PER_LINE = 6  # time grid of nonlinear laws, in points per highest line
NOISE_LINES = 10  # lines on either side over which the noise of the position is averaged
SIGNAL_LEVEL = 2.0  # power over noise below which a line of the position counts as noise
FAST_LEVEL = 1.5  # the same of the mean power of lines near by: that of noise alone differs by less from its own mean
SIGNAL_BAND = 2.0  # band of the signals that laws see, in multiples of the compared band
MOTION_BAND = 1.5  # the same of motions
FAST_BAND = 6.0  # of motions whose link encoders are compared: jumps through lost motion are faster than the modes of the links


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
        temperature: (S, n) degC means, or None.
        period_time: s.
        periods: (S,) number of periods averaged.
        rest: (S, n_time, n) where motors stand still, or turn.
        Q_fast: (S, F, n) mean spectra of the position beyond lines 0..L-1, as far as they are signal and the time grid reaches;
            None of a motion.
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
    temperature: np.ndarray | None
    period_time: float
    periods: np.ndarray
    white_noise: np.ndarray
    white_torque_noise: np.ndarray
    rest: np.ndarray | None = None
    Q_fast: np.ndarray | None = None
    link_std: np.ndarray | None = None
    links: tuple[int, ...] = ()
    n_slow: int | None = None

    @property
    def outputs(self) -> np.ndarray:
        """(S, L, n + M) what is compared: recorded torque, N m, then link positions, rad."""
        return self.U if not self.links else np.concatenate([self.U, self.Q_link[..., list(self.links)]], axis=-1)

    @cached_property
    def scatter(self) -> tuple[np.ndarray, np.ndarray, np.ndarray] | None:
        """Covariances (K, n, n) of torque, of torque and position, and of position, of noise of the means; sums over records.

        By the scatter between periods; None where there is one period, and beside link encoders.
        """
        periods = self.U_periods.shape[1]
        if periods < 2 or self.links:
            return None
        U, Q = (
            (x - x.mean(axis=1, keepdims=True))[:, :, : self.n_compared].transpose(2, 3, 0, 1).reshape(self.n_compared, x.shape[-1], -1)
            for x in (self.U_periods, self.Q_periods)
        )
        scale = periods * (periods - 1)
        return tuple(a @ b.conj().swapaxes(1, 2) / scale for a, b in ((U, U), (U, Q), (Q, Q)))

    @cached_property
    def position_noise(self) -> np.ndarray:
        """(L, n) variance of a line of the mean position, rad2.

        By the scatter between periods; white where there is one period, by the noise of its samples.
        """
        return _line_noise(self.Q_periods, self.white_noise)

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

        By Stein's unbiased estimate (Stein 1981), in the mean over lines near by, which takes away most of its own scatter; what
        is below zero then counts as none.
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
        return np.sqrt(np.mean(self.velocity_error**2, axis=0))

    @cached_property
    def least_velocity(self) -> np.ndarray:
        """(S, n) below which a motor may as well rest: what its velocity is off by, or little, rad/s."""
        return np.maximum(SURE * self.velocity_error, CREEPING * np.sqrt(np.mean(self.slow_velocity**2, axis=1)))

    @cached_property
    def fast_velocity(self) -> np.ndarray | None:
        """(S, n_time, n) motor velocity in the lines beyond L, rad/s: where dry friction turns the acceleration jumps; None of a motion."""
        if self.Q_fast is None:
            return None
        L, count = len(self.omega), self.Q_fast.shape[1]
        V = np.zeros((len(self.Q_fast), L + count, self.Q_fast.shape[2]), complex)
        V[:, L:] = 2j * np.pi / self.period_time * np.arange(L, L + count)[:, None] * self.Q_fast
        return self.to_time(V)

    @cached_property
    def torque_share(self) -> np.ndarray:
        """(S, L, n) the same of the torque: a law that clips it would clip its noise, and so explain that."""
        return signal_share(self.U, self.torque_noise)

    @cached_property
    def torque_noise(self) -> np.ndarray:
        """(L, n) variance of a line of the mean torque, N2 m2, as that of the position."""
        return _line_noise(self.U_periods, self.white_torque_noise)

    @property
    def posture(self) -> np.ndarray:
        """(n,) mean motor position, rad."""
        return self.Q[:, 0].real.mean(axis=0)

    def pick(self, rows: np.ndarray) -> Group:
        """The group with some of its segments."""
        names = ("U", "Q", "U_periods", "Q_periods", "Q_link", "excited", "amplitude", "start", "temperature", "periods", "rest", "Q_fast")
        parts = {name: getattr(self, name) for name in names}
        kept = {name: None if x is None else x[rows] for name, x in parts.items()}
        return replace(self, segments=tuple(self.segments[i] for i in rows), **kept)

    def slow(self) -> Group:
        """The group with the lines of the geometry alone."""
        names = ("U", "Q", "U_periods", "Q_periods", "Q_link")
        parts = {name: getattr(self, name) for name in names}
        cut = {name: None if x is None else x[..., : self.n_slow, :] for name, x in parts.items()}
        return replace(self, omega=self.omega[: self.n_slow], excited=self.excited[:, : self.n_slow], n_slow=None, Q_fast=None, **cut)

    @property
    def window_share(self) -> float:
        """Share of the power of a record that its window leaves; 1 where there is none."""
        return 1.0 if self.window is None else float(np.mean(self.window**2))

    def to_time(self, X: np.ndarray) -> np.ndarray:
        """Spectrum (..., L, m) on the time grid (..., n_time, m)."""
        return scipy.fft.irfft(X, n=self.n_time, axis=-2, norm="forward")

    def to_lines(self, x: np.ndarray) -> np.ndarray:
        """Time grid (..., n_time, m) to spectrum (..., L, m)."""
        full = scipy.fft.rfft(x, axis=-2, norm="forward")
        return full[..., : len(self.omega), :]

    @cached_property
    def _seen(self) -> tuple[np.ndarray, np.ndarray]:
        """(K, L) of a line, and of its conjugate, that the window shows at each compared one."""
        W = scipy.fft.fft(self.window, norm="forward")
        k, l = np.arange(self.n_compared)[:, None], np.arange(len(self.omega))
        of_conjugate = W[(k + l) % len(W)]
        of_conjugate[:, 0] = 0.0  # the mean has no conjugate
        return W[(k - l) % len(W)], of_conjugate

    def observe(self, X: np.ndarray) -> np.ndarray:
        """What of a torque spectrum (..., L, m) is compared: its windowed lines (..., K, m).

        The window in time is a convolution of the few lines there are, far cheaper than two transforms.
        """
        if self.window is None:
            return X[..., : self.n_compared, :]
        of_line, of_conjugate = self._seen
        X = np.concatenate([X[..., :1, :].real, X[..., 1:, :]], axis=-2)  # as a time signal has it
        return of_line @ X + of_conjugate @ X.conj()

    def observe_outputs(self, X: np.ndarray) -> np.ndarray:
        """``observe`` for outputs (S, L, n + M, ...); (S, K, n + M, ...).

        The zero of a link encoder is not known: its mean over the window is left out.
        """
        flat = X.reshape(*X.shape[:2], -1)
        if self.links:
            first = self.U.shape[-1] * flat.shape[-1] // X.shape[2]
            share = self.window**2 / np.sum(self.window**2)
            flat = flat.copy()
            flat[:, 0, first:] -= np.einsum("t,stm->sm", share, self.to_time(flat[..., first:]))
        return self.observe(flat).reshape(len(X), self.n_compared, *X.shape[2:])


def _line_noise(X_periods: np.ndarray, white: np.ndarray) -> np.ndarray:
    """(L, n) variance of a line of the mean over periods (S, P, L, n)."""
    P = X_periods.shape[1]
    if P < 2:
        return np.ones((X_periods.shape[2], 1)) * white
    d = X_periods - X_periods.mean(axis=1, keepdims=True)
    power = np.sum(np.abs(d) ** 2, axis=(0, 1)) / (len(d) * (P - 1) * P)
    return mean_over_lines(power, NOISE_LINES)


def _signal(X_periods: np.ndarray, white: np.ndarray) -> np.ndarray:
    """Mean (S, L, n) over periods (S, P, L, n) of lines that hold little but noise, each by the share of signal near by (Wiener 1949)."""
    mean = X_periods.mean(axis=1)
    if not mean.shape[1]:
        return mean
    power = mean_over_lines((np.abs(mean) ** 2).swapaxes(0, 1), NOISE_LINES).swapaxes(0, 1)
    noise = _line_noise(X_periods, white)
    return np.maximum(1.0 - FAST_LEVEL * noise / np.maximum(power, 1e-300), 0.0) * mean


def signal_share(X: np.ndarray, noise: np.ndarray) -> np.ndarray:
    """Share of each line (S, L, ...) that is signal, of which ``noise`` (L, ...) is the variance; the mean is."""
    share = np.maximum(1.0 - SIGNAL_LEVEL * noise / np.maximum(np.abs(X) ** 2, 1e-300), 0.0)
    share[:, 0] = 1.0
    return share


def build_groups(
    dataset: Dataset,
    *,
    role: str | None = "identification",
    band_hz: float | None = None,
    motion_band_hz: float | None = None,
    fast: bool = False,
) -> tuple[Group, ...]:
    """Groups of all segments of a role.

    Args:
        dataset: the data.
        role: "identification", "validation", or None for all.
        band_hz: highest compared frequency of periodic data; the highest excited line where None.
        motion_band_hz: the same for motions; 10 Hz or a tenth of the sample rate where None.
        fast: whether signals of motions reach past the modes of the links, as link encoders see them.

    Raises:
        DataError: where no segment of the role is left.
    """
    groups: dict[tuple, list[Segment]] = {}
    for segment in dataset.segments:
        if role is not None and segment.role != role:
            continue
        if segment.kind == "multisine":
            key: tuple = (segment.operating_point, segment.period, segment.steady_periods)
        else:
            key = ("trajectory", segment.name)
        groups.setdefault(key, []).append(segment)
    if not groups:
        raise DataError("segments", str(dataset.path or dataset.name), f"none of role {role}", "at least one")
    top = band_hz or highest_line_hz(dataset)
    motion_top = motion_band_hz or min(10.0, dataset.sample_rate / 10)
    began = start_times(dataset)
    return tuple(
        _motion_group(dataset, members[0], motion_top, fast, began)
        if members[0].kind == "trajectory"
        else _periodic_group(dataset, members, top, began)
        for members in groups.values()
    )


def highest_line_hz(dataset: Dataset) -> float:
    """Highest excited frequency of the identification multisines, Hz; 0.4 of Nyquist without."""
    tops = [
        max(s.excited_lines) * dataset.sample_rate / s.period
        for s in dataset.segments
        if s.kind == "multisine" and len(s.excited_lines)
    ]
    return float(max(tops)) if tops else 0.2 * dataset.sample_rate


def start_times(dataset: Dataset) -> dict[str, float]:
    """When each segment began, s, by its name: as its time stamps say, or one after the other.

    Where the clock was set back for a segment its stamps say nothing of when it was recorded; then the order in the dataset does.
    """
    segments = dataset.segments
    if all(b.t[0] >= a.t[-1] for a, b in itertools.pairwise(sorted(segments, key=lambda s: s.t[0]))):
        return {s.name: float(s.t[0]) for s in segments}
    lengths = [s.n_samples / dataset.sample_rate for s in segments]
    return dict(zip((s.name for s in segments), np.cumsum([0.0, *lengths[:-1]]).tolist(), strict=True))


def _periodic_group(dataset: Dataset, members: list[Segment], band_hz: float, began: Mapping[str, float]) -> Group:
    first = members[0]
    fs, N = dataset.sample_rate, int(first.period)
    top = min(int(np.floor(band_hz * N / fs + 1e-9)), N // 2 - 1)
    n_lines = min(int(np.ceil(SIGNAL_BAND * top)) + 2, N // 2)
    q = [without_creep(s.periodic("q")) for s in members]
    U_p = np.stack([_lines(without_creep(s.periodic("tau")), n_lines) for s in members])
    Q_p = np.stack([_lines(x, n_lines) for x in q])
    link = None
    if all(s.q_link is not None for s in members):
        link = np.stack([_lines(without_creep(s.periodic("q_link")), n_lines).mean(axis=0) for s in members])
    excited = np.zeros((len(members), n_lines), bool)
    for i, s in enumerate(members):
        lines = np.asarray(s.excited_lines, int)
        excited[i, lines[lines < n_lines]] = True
    temps = [s.temp for s in members]
    n_time = scipy.fft.next_fast_len(POINTS_PER_LINE * n_lines, real=True)
    white_noise = np.mean([difference_noise(s.q) ** 2 for s in members], axis=0) / N
    fast = np.stack([_lines(x, min(N // 2, (n_time + 1) // 2))[:, n_lines:] for x in q])
    at = np.arange(n_time) * N // n_time
    group = Group(
        operating_point=str(first.operating_point),
        segments=tuple(s.name for s in members),
        U=U_p.mean(axis=1),
        Q=Q_p.mean(axis=1),
        U_periods=U_p,
        Q_periods=Q_p,
        Q_link=link,
        omega=2 * np.pi * np.arange(n_lines) * fs / N,
        n_compared=top + 1,
        excited=excited,
        n_time=n_time,
        window=None,
        amplitude=np.array([s.amplitude for s in members]),
        start=np.array([began[s.name] for s in members]) + _middle_periods(members) * N / fs,
        temperature=None if any(x is None for x in temps) else np.stack([x.mean(axis=0) for x in temps]),
        period_time=N / fs,
        periods=np.array([s.steady_periods for s in members]),
        white_noise=white_noise,
        white_torque_noise=np.mean([difference_noise(s.tau) ** 2 for s in members], axis=0) / N,
        Q_fast=_signal(fast, white_noise),
        rest=np.stack([_at_rest_in_period(x, fs, 0.5 * N / fs / n_lines)[at] for x in q]),
    )
    return replace(group, rest=group.rest | _turning(group))


def _middle_periods(members: list[Segment]) -> np.ndarray:
    """Periods from the start of a segment to that of the mean of its steady ones."""
    return np.array([s.transient_periods + 0.5 * (s.steady_periods - 1) for s in members])


def without_creep(x: np.ndarray) -> np.ndarray:
    """Periods (P, N, n) less the line that leads from where they begin to where they end, where that is elsewhere.

    What ends elsewhere than it began, as a motor that sticks and creeps does, has lines of its jump. A steady velocity is a motion
    of the arm too: less that, what is left repeats.
    """
    P, N, _ = x.shape
    if P < 2:
        return x
    width = min(BORDER_SAMPLES, N)
    # From the start of the first period to that of the second, and from the end of the first to that of the last.
    jump = (x[1] - x[0])[:width].mean(axis=0) + (x[-1] - x[0])[-width:].mean(axis=0)
    noise = 2.0 * difference_noise(x.reshape(P * N, -1)) / np.sqrt(width)
    at = np.arange(P * N).reshape(P, N, 1) - 0.5 * (P * N - 1)
    return x - at * np.where(np.abs(jump) > CREEP * noise, jump, 0.0) / (P * N)


def _lines(x: np.ndarray, n_lines: int) -> np.ndarray:
    """(P, N, n) time samples to (P, n_lines, n) spectra."""
    return scipy.fft.rfft(x, axis=1, norm="forward")[:, :n_lines]


def _motion_group(dataset: Dataset, segment: Segment, band_hz: float, fast: bool, began: Mapping[str, float]) -> Group:
    fs = dataset.sample_rate
    n_return = int(np.ceil(max(RETURN_TIME, 0.05 * len(segment.t) / fs) * fs))
    N = scipy.fft.next_fast_len(len(segment.t) + n_return, real=True)
    n_return = N - len(segment.t)
    q = close_motion(segment.q, n_return, fs, curvature=True)
    tau = close_motion(segment.tau, n_return, fs, curvature=False)
    top = min(int(band_hz * N / fs), N // 2 - 1)
    n_slow = min(int(MOTION_BAND * top) + 2, N // 2)
    n_lines = min(int(FAST_BAND * top) + 2, N // 2) if fast else n_slow
    # A ripple is fast along a motion that is slow: on a grid of the compared band alone it would fold into it.
    fine = min(N, scipy.fft.next_fast_len(int(MOTION_RATE * N / fs), real=True))
    n_time = max(fine, scipy.fft.next_fast_len(POINTS_PER_LINE * n_lines, real=True))
    time = np.arange(n_time) * N / fs / n_time
    ramp = min(SETTLE_TIME, 0.1 * len(segment.t) / fs)
    end = len(segment.t) / fs
    window = np.clip(time / ramp, 0, 1) * np.clip((end - time) / ramp, 0, 1)
    window = np.sin(0.5 * np.pi * window) ** 2
    U = _lines(tau[None], n_lines)
    Q = _lines(q[None], n_lines)
    link = None
    if segment.q_link is not None:
        link = _lines(close_motion(segment.q_link, n_return, fs, curvature=True)[None], n_lines)
    group = Group(
        operating_point=segment.operating_point or segment.name,
        segments=(segment.name,),
        U=U,
        Q=Q,
        U_periods=U[:, None],
        Q_periods=Q[:, None],
        Q_link=link,
        omega=2 * np.pi * np.arange(n_lines) * fs / N,
        n_compared=top + 1,
        excited=np.zeros((1, n_lines), bool),
        n_time=n_time,
        window=window,
        amplitude=np.ones(1),
        start=np.array([began[segment.name]]),
        temperature=None if segment.temp is None else segment.temp.mean(axis=0)[None],
        period_time=N / fs,
        periods=np.ones(1, int),
        white_noise=difference_noise(segment.q) ** 2 / N,
        white_torque_noise=difference_noise(segment.tau) ** 2 / N,
        link_std=None if segment.q_link is None else difference_noise(segment.q_link),
        n_slow=n_slow,
        rest=_at_rest(segment.q, fs, REST_TIME)[None, np.minimum((time * fs).astype(int), len(segment.t) - 1)],
    )
    return replace(group, rest=_lasting(group.rest & _slow(group), round(REST_TIME * fs * n_time / N)))


def _at_rest(q: np.ndarray, fs: float, span: float) -> np.ndarray:
    """Where motors stand still (N, n): samples in windows of ``span`` seconds that hold no more than noise, or a step of the encoder."""
    return _still(q, max(round(span * fs), REST_SAMPLES), _stillness(q, 1), "nearest")


def _at_rest_in_period(q: np.ndarray, fs: float, span: float) -> np.ndarray:
    """The same of the mean over periods (P, N, n)."""
    level = _stillness(q.reshape(-1, q.shape[-1]), len(q))
    return _still(q.mean(axis=0), max(round(span * fs), REST_SAMPLES), level, "wrap")


def _stillness(q: np.ndarray, count: int) -> np.ndarray:
    """(n,) what means over ``count`` positions (N, n) of motors that stand still differ by, rad: noise, or a step of the encoder."""
    steps = np.abs(np.diff(q, axis=0))
    least = np.min(np.where(steps > 0, steps, np.inf), axis=0)
    return np.maximum(REST_NOISE * difference_noise(q) / np.sqrt(count), np.where(np.isfinite(least), 1.5 * least, 0.0))


def _lasting(rest: np.ndarray, width: int) -> np.ndarray:
    """Where a motor rests (S, n_time, n) for ``width`` points at least: in a turn the velocity says more than the torque."""
    narrow = scipy.ndimage.minimum_filter1d(rest.astype(np.uint8), width, axis=1, mode="nearest")
    return scipy.ndimage.maximum_filter1d(narrow, width, axis=1, mode="nearest", origin=-1 if width % 2 == 0 else 0) > 0


def _slow(group: Group) -> np.ndarray:
    """(S, n_time, n) where the velocity that laws see of a motion is as that of a motor that rests.

    Positions may differ by no more than noise where a motor moves slowly, and its direction is known.
    """
    return np.abs(group.slow_velocity) < group.least_velocity[:, None]


def _turning(group: Group) -> np.ndarray:
    """(S, n_time, n) where the velocity of a periodic motion turns between two points of the grid.

    Dry friction jumps there, and with it the acceleration: in a motion whose lines end the velocity turns too late.
    """
    v = group.slow_velocity + group.fast_velocity
    turns = v * np.roll(v, -1, axis=1) <= 0.0
    return turns | np.roll(turns, 1, axis=1)


def _still(q: np.ndarray, width: int, level: np.ndarray, mode: str) -> np.ndarray:
    """Samples (N, n) in windows of ``width`` within which positions differ by no more than ``level``."""
    span = scipy.ndimage.maximum_filter1d(q, width, axis=0, mode=mode) - scipy.ndimage.minimum_filter1d(q, width, axis=0, mode=mode)
    # An even window reaches one sample further back than ahead: the windows that hold a sample reach the other way.
    origin = -1 if width % 2 == 0 else 0
    return scipy.ndimage.maximum_filter1d((span <= level).astype(np.uint8), width, axis=0, mode=mode, origin=origin) > 0


def close_motion(x: np.ndarray, n_return: int, fs: float, *, curvature: bool) -> np.ndarray:
    """Append a return from the last sample to the first; (N + n_return, n).

    A polynomial of fifth order with matching slopes, and none of higher order that end within ``BRAKE_TIME`` with
    matching ``curvature``: a motor whose acceleration ended at once would ask for a step of torque, which rings.

    Args:
        fs: samples per second.
    """
    width = min(max(round(END_TIME * fs), END_SAMPLES), len(x) // 2)
    v_end, a_end = _end_slope(x[-width:], -1)
    v_start, a_start = _end_slope(x[:width], 0)
    span = n_return + 1
    u = (np.arange(1, n_return + 1) / span)[:, None]
    s = u**3 * (10 - 15 * u + 6 * u**2)
    leave = u - 6 * u**3 + 8 * u**4 - 3 * u**5
    arrive = -4 * u**3 + 7 * u**4 - 3 * u**5
    back = x[-1] + (x[0] - x[-1]) * s + span * (v_end * leave + v_start * arrive)
    if curvature:
        brake = min(BRAKE_TIME * fs, span)
        back += brake**2 * (a_end * _bump(u * span / brake) + a_start * _bump((1.0 - u) * span / brake))
    return np.concatenate([x, back])


def _end_slope(x: np.ndarray, at: int) -> tuple[np.ndarray, np.ndarray]:
    """(n,) slope and curvature per sample at the first or last of samples (N, n), by a cubic through all of them."""
    t = np.arange(len(x), dtype=float)
    t = (t - t[at]) / max(len(x) - 1, 1)
    c = np.linalg.lstsq(np.vander(t, min(4, len(x)), increasing=True), x, rcond=None)[0]
    c = np.concatenate([c, np.zeros((3, x.shape[1]))])
    return c[1] / max(len(x) - 1, 1), 2.0 * c[2] / max(len(x) - 1, 1) ** 2


def _bump(u: np.ndarray) -> np.ndarray:
    """Unit curvature at 0, without value or slope there; none of the three from 1 on."""
    return np.where(u < 1.0, 0.5 * u**2 * (1.0 - np.minimum(u, 1.0)) ** 3, 0.0)


def mean_over_lines(x: np.ndarray, half: int) -> np.ndarray:
    """Mean of (L, ...) over lines l - half .. l + half."""
    total = np.cumsum(np.concatenate([np.zeros_like(x[:1]), x]), axis=0)
    at = np.arange(len(x))
    low, high = np.maximum(at - half, 0), np.minimum(at + half + 1, len(x))
    return (total[high] - total[low]) / (high - low).reshape(-1, *[1] * (x.ndim - 1))


def difference_noise(x: np.ndarray) -> np.ndarray:
    """Standard deviation of white noise on a smooth signal (N, n), from fourth differences; (n,).

    ``var(diff^4 x) = 70 var(x)`` for white noise; the median makes it blind to spikes.
    """
    d = np.diff(x, n=4, axis=0)
    return 1.4826 * np.median(np.abs(d - np.median(d, axis=0)), axis=0) / np.sqrt(70.0)
