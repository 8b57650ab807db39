"""Segments reduced to what the torque equation needs: spectra of torque and position.

A record group holds the segments of one operating point that share a period. A motion without
periodicity is a group of its own: it is closed into a period by a smooth return, and a window
keeps the return and the first transient out of every comparison.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
import scipy.fft
import scipy.ndimage

from ident.closing import close_motion
from ident.dataset import Dataset, Segment
from ident.group import FAST_LEVEL, NOISE_LINES, Group, mean_over_lines, signal_power
from ident.rest import REST_TIME, at_rest, at_rest_in_period, difference_noise, lasting, slow, turning
from ident.transients import ends_of_transients
from robot_assets.errors import DataError

RETURN_TIME = 8.0  # s, least time in which a motion is led back to its start: what still rings then has decayed
# tapered at both ends of a motion: s, and periods of the highest compared frequency, at least
SETTLE_TIME, SETTLE_PERIODS = 0.5, 2.0
FEWEST_SAMPLES = 100  # of a period that tells how it goes on from sample to sample
BORDER_SAMPLES = 8  # at either end of a period, from which it is told where it begins and ends
STEP_ORDER = 5  # of the polynomial that a signal is within these on both sides of a step
CORNERS = 2.0  # of the largest step that a signal seems to take elsewhere, by which it must at least
CREEP = 6.0  # standard deviations of their noise, by which both must differ
MOTION_RATE = 2000.0  # 1/s, of the time grid of motions, at most: enough for the ripple of a fast motor
POINTS_PER_LINE = 6  # time grid of nonlinear laws, in points per highest line
SIGNAL_BAND = 2.0  # band of the signals that laws see, in multiples of the compared band
# the same of motions: the taper at their ends mixes lines that lie half of their compared band apart and more
MOTION_BAND = 2.1
# of motions whose link encoders are compared: jumps through lost motion are faster than the modes of the links; and of
# fast motions, as far as they have more than a share of their acceleration, rms, beyond
FAST_BAND = 6.0
FAST_SHARE = 0.08


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


def with_turns_alike(groups: Sequence[Group], others: Sequence[Group]) -> tuple[tuple[Group, ...], tuple[Group, ...]]:
    """Periodic groups with one ``turn_noise``, the mean over all of them, and others of the same dataset with that too."""
    noise = [g.turn_noise for g in groups if g.window is None]
    if not noise:
        return tuple(groups), tuple(others)
    alike = np.sqrt(np.mean(np.square(noise), axis=0))
    one, other = (
        tuple(replace(g, alike_turn_noise=alike) if g.window is None else g for g in some) for some in (groups, others)
    )
    return one, other


def highest_line_hz(dataset: Dataset) -> float:
    """Highest excited frequency of the identification multisines, Hz; of held-out ones where there are no others, 0.4
    of Nyquist without."""
    excited = [s for s in dataset.select(kind="multisine") if len(s.excited_lines)]
    told = [s for s in excited if s.role == "identification"] or excited
    tops = [max(s.excited_lines) * dataset.sample_rate / s.period for s in told]
    return float(max(tops)) if tops else 0.2 * dataset.sample_rate


def start_times(dataset: Dataset) -> dict[str, float]:
    """When each segment began, s, by its name: as its time stamps say, or one after the other.

    Where the clock was set back for a segment its stamps say nothing of when it was recorded; then the order in the
    dataset does.
    """
    segments = dataset.segments
    if all(b.t[0] >= a.t[-1] for a, b in itertools.pairwise(sorted(segments, key=lambda s: s.t[0]))):
        return {s.name: float(s.t[0]) for s in segments}
    lengths = [s.n_samples / dataset.sample_rate for s in segments]
    return dict(zip((s.name for s in segments), np.cumsum([0.0, *lengths[:-1]]).tolist(), strict=True))


def _periodic_group(dataset: Dataset, members: list[Segment], band_hz: float, began: Mapping[str, float]) -> Group:
    first = members[0]
    fs, N = dataset.sample_rate, first.period
    assert N is not None  # of a multisine
    top = min(int(np.floor(band_hz * N / fs + 1e-9)), N // 2 - 1)
    n_lines = min(int(np.ceil(SIGNAL_BAND * top)) + 2, N // 2)
    q = [_steady(s, "q") for s in members]
    drifts = [drift(x[0]) if len(x) == 1 and s.transient_periods == 0 else 0.0 for s, x in zip(members, q, strict=True)]
    q = [x - d for x, d in zip(q, drifts, strict=True)]
    U_p = np.stack([_lines(_steady(s, "tau"), n_lines) for s in members])
    Q_p = np.stack([_lines(x, n_lines) for x in q])
    link = None
    if all(s.q_link is not None for s in members):
        link = np.stack([_lines(_steady(s, "q_link"), n_lines).mean(axis=0) for s in members])
    excitation = None
    if all(s.r is not None for s in members):
        excitation = np.stack([_lines(s.periodic("r"), n_lines).mean(axis=0) for s in members])
    excited = np.zeros((len(members), n_lines), bool)
    for i, s in enumerate(members):
        lines = np.asarray(s.excited_lines, int)
        excited[i, lines[lines < n_lines]] = True
    n_time = scipy.fft.next_fast_len(POINTS_PER_LINE * n_lines, real=True)
    white_noise = np.mean([difference_noise(s.q) ** 2 for s in members], axis=0) / N
    fast = np.stack([_lines(x, min(N // 2, (n_time + 1) // 2))[:, n_lines:] for x in q])
    at = np.arange(n_time) * N // n_time
    spacing, *noise = ends_of_transients(members, top) or (1, None, None)
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
        period_time=N / fs,
        periods=np.array([s.steady_periods for s in members]),
        white_noise=white_noise,
        white_torque_noise=np.mean([difference_noise(s.tau) ** 2 for s in members], axis=0) / N,
        Q_fast=signal_power(fast, white_noise),
        rest=np.stack([at_rest_in_period(x, fs, 0.5 * N / fs / n_lines)[at] for x in q]),
        noise_spacing=spacing,
        U_noise=noise[0],
        Q_noise=noise[1],
        R=excitation,
        drift=np.stack([_lines(np.broadcast_to(d, x.shape), n_lines)[0] for x, d in zip(q, drifts, strict=True)])
        if any(np.any(d) for d in drifts)
        else None,
        creeps=any(len(x) == 1 and np.any(x != s.periodic("q")) for x, s in zip(q, members, strict=True)),
    )
    return replace(group, rest=group.rest | turning(group))


def _middle_periods(members: list[Segment]) -> np.ndarray:
    """Periods from the start of a segment to that of the mean of its steady ones."""
    return np.array([s.transient_periods + 0.5 * (s.steady_periods - 1) for s in members])


def _steady(segment: Segment, channel: str) -> np.ndarray:
    """Steady periods (P, N, n) of a channel, less what they creep by."""
    N = segment.period
    assert N is not None  # of a multisine
    samples = getattr(segment, channel)[: segment.transient_periods * N]
    return without_creep(segment.periodic(channel), samples[-N:] if len(samples) >= N else None)


def without_creep(x: np.ndarray, before: np.ndarray | None = None) -> np.ndarray:
    """Periods (P, N, n) less the line that leads from where they begin to where they end, where that is elsewhere.

    What ends elsewhere than it began, as a motor that sticks and creeps does, has lines of its jump. A steady velocity
    is a motion of the arm too: less that, what is left repeats.

    Args:
        before: (N, n) the period before, of a transient, by whose end a single one is told where it begins; or None.
    """
    P, N, _ = x.shape
    if P < 2 and before is None:
        return x
    width = min(BORDER_SAMPLES, N)
    if P < 2:
        change = (x[0] - before)[N // 2 :]
        jump = change[-width:].mean(axis=0)
    else:
        # From the start of the first period to that of the second, and from the end of the first to that of the last.
        change = x[-1] - x[0]
        jump = (x[1] - x[0])[:width].mean(axis=0) + change[-width:].mean(axis=0)
    noise = np.maximum(2.0 * difference_noise(x.reshape(P * N, -1)) / np.sqrt(width), _change(change, width))
    at = np.arange(P * N).reshape(P, N, 1) - 0.5 * (P * N - 1)
    return x - at * np.where(np.abs(jump) > CREEP * noise, jump, 0.0) / (P * N)


def drift(x: np.ndarray) -> np.ndarray:
    """(N, n) the line about zero by which a single period (N, n) drifts, where its end leads elsewhere than to its
    beginning: as of a loop that has not settled yet, where no period before tells of it.

    There it steps by more than anywhere else, and by more than it bends from one sample to the next: a motion may begin
    with a corner.
    """
    if len(x) < FEWEST_SAMPLES:
        return np.zeros_like(x)
    steps, bends = _steps(x)
    elsewhere = np.abs(steps[2 * BORDER_SAMPLES : 1 - 2 * BORDER_SAMPLES])
    usual = np.maximum(CREEP * np.sqrt(np.mean(elsewhere**2, axis=0)), CORNERS * elsewhere.max(axis=0))
    share = (np.arange(len(x))[:, None] - 0.5 * (len(x) - 1)) / len(x)
    return -share * np.where(np.abs(steps[0]) > np.maximum(usual, np.abs(bends[0])), steps[0], 0.0)


def _steps(x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """By how much a signal (N, n) that repeats seems to step before each sample, and its slope to, per sample, beside a
    polynomial through the samples on either side; (N, n) each."""
    t = (np.arange(2 * BORDER_SAMPLES) - BORDER_SAMPLES + 0.5) / BORDER_SAMPLES
    bend = np.maximum(t, 0.0) * BORDER_SAMPLES
    weights = np.linalg.pinv(np.column_stack([t[:, None] ** np.arange(STEP_ORDER + 1), t > 0, bend]))
    steps, bends = (scipy.ndimage.correlate1d(x, w, axis=0, mode="wrap") for w in weights[-2:])
    return steps, bends


def _change(x: np.ndarray, width: int) -> np.ndarray:
    """(n,) rms of what the mean of so many samples of (N, n) changes by from each to the next: that of a drive that
    hunts
    between the steps of an encoder is far more than differences of single samples show, most of which are small."""
    means = x[: len(x) // width * width].reshape(-1, width, x.shape[1]).mean(axis=1)
    return np.sqrt(np.mean(np.diff(means, axis=0) ** 2, axis=0)) if len(means) > 1 else np.zeros(x.shape[1])


def _lines(x: np.ndarray, n_lines: int) -> np.ndarray:
    """(P, N, n) time samples to (P, n_lines, n) spectra."""
    return scipy.fft.rfft(x, axis=1, norm="forward")[:, :n_lines]


def lines_of_motion(lines: np.ndarray, white: np.ndarray, least: int, most: int) -> int:
    """How many lines of a motion are solved: as many as leave beyond no more than ``FAST_SHARE`` of the acceleration
    of all joints, ``least`` and ``most`` aside. What is faster reaches the slow lines by the geometry of the arm.

    Args:
        lines: (L, n) of the position, rad, all that there are.
        white: (n,) variance of a line by noise, rad2; what is near it is no motion.
    """
    power = np.abs(lines) ** 2
    moves = mean_over_lines(power, NOISE_LINES) > 2.0 * FAST_LEVEL * white
    signal = np.sum(np.where(moves, power, 0.0), axis=1) * np.arange(len(lines)) ** 4.0
    beyond = np.cumsum(signal[::-1])[::-1]
    more = beyond > FAST_SHARE**2 * beyond[0]
    return int(np.clip(np.count_nonzero(more), least, most))


def _motion_group(dataset: Dataset, segment: Segment, band_hz: float, fast: bool, began: Mapping[str, float]) -> Group:
    fs = dataset.sample_rate
    n_return = int(np.ceil(max(RETURN_TIME, 0.05 * len(segment.t) / fs) * fs))
    N = scipy.fft.next_fast_len(len(segment.t) + n_return, real=True)
    n_return = N - len(segment.t)
    q = close_motion(segment.q, n_return, fs, curvature=True)
    tau = close_motion(segment.tau, n_return, fs, curvature=False)
    top = min(int(band_hz * N / fs), N // 2 - 1)
    white_noise = difference_noise(segment.q) ** 2 / N
    least, most = (min(int(band * top) + 2, N // 2) for band in (MOTION_BAND, FAST_BAND))
    whole = _lines(q[None], N // 2)
    n_slow = lines_of_motion(whole[0], white_noise, least, most)
    n_lines = most if fast else n_slow
    # A ripple is fast along a motion that is slow: on a grid of the compared band alone it would fold into it.
    fine = min(N, scipy.fft.next_fast_len(int(MOTION_RATE * N / fs), real=True))
    n_time = max(fine, scipy.fft.next_fast_len(POINTS_PER_LINE * n_lines, real=True))
    time = np.arange(n_time) * N / fs / n_time
    # What is beyond the band at the ends, where the record breaks off, reaches as far into it as the band is narrow.
    ramp = min(max(SETTLE_TIME, SETTLE_PERIODS / band_hz), 0.1 * len(segment.t) / fs)
    end = len(segment.t) / fs
    window = np.clip(time / ramp, 0, 1) * np.clip((end - time) / ramp, 0, 1)
    window = np.sin(0.5 * np.pi * window) ** 2
    U = _lines(tau[None], n_lines)
    Q = whole[:, :n_lines].copy()  # not as a part of all lines, which would stay
    link = None
    if segment.q_link is not None:
        link = _lines(close_motion(segment.q_link, n_return, fs, curvature=True)[None], n_lines)
    # Dry friction turns where the velocity does: of that the compared lines alone know to hundredths of a second.
    beyond = whole[None, :, n_lines : (n_time + 1) // 2]
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
        period_time=N / fs,
        periods=np.ones(1, int),
        white_noise=white_noise,
        white_torque_noise=difference_noise(segment.tau) ** 2 / N,
        Q_fast=signal_power(beyond, white_noise),
        link_std=None if segment.q_link is None else difference_noise(segment.q_link),
        n_slow=n_slow,
        rest=at_rest(segment.q, fs, REST_TIME)[None, np.minimum((time * fs).astype(int), len(segment.t) - 1)],
    )
    return replace(group, rest=lasting(group.rest & slow(group), round(REST_TIME * fs * n_time / N)))
