"""Channels of one recording that come late after another, by what rigid bodies, friction and gears say they should
be."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pinocchio as pin
import scipy.signal

from ident.chain import Structure, build_structure
from ident.dataset import Dataset, Segment
from ident.recursion import chain_of, newton_euler
from ident.rest import difference_noise

LATEST = 0.03  # s: skews are looked for up to here from none,
FARTHEST = 1.0, 0.1  # s and share of the log: up to here, where torques are not explained so
GRID = 0.01  # s from one of these skews to the next
VALLEY = 0.1  # s about the best of them: it is unique where all beyond leave
UNIQUE = 8.0  # times as much as it does, at least,
FAR_GONE = 0.875  # and where so much of what was unexplained goes with it
ODD = 1.0  # samples: skews of less are common, and are said only where
SMALL = 0.25, 1e-4  # samples and s: they are larger than both, and what they differ by from usual is sure too
HELD = 0.5  # samples by which a torque that is held over a sample is recorded early
SETTLED = 0.3  # s: the filter of the band has forgotten the ends of the log
BAND = 12.0  # Hz: band in which skew is estimated; rigid bodies and friction explain torque there
BLOCKS = 8  # stretches of time, of which the jackknife leaves one out
LONGEST = 2000  # instants that an estimate of skew looks at
RANK = 1e-6  # of the largest singular value, below which columns tell the same
EXPLAINED = 0.9  # share of the torque that must be explained for its skew to mean anything
GONE = 0.3  # share of what is unexplained without a skew that must go with it,
# unless what the noise of the torque leaves in the band is left, within this factor: far less says that this is no noise
NOTHING = 1.5
SURE = 8.0  # deviations of a skew, of eight stretches of time: one in ten thousand by chance (Student's t)
ONE_JOINT = 0.5  # share of a skew that may go with one joint
AGREE = 0.3, 4.0  # share of a skew, and deviations, by which that of each joint may differ from that of all
STEPS, SETTLES = 10, 1e-5  # of a search for the skews of all joints, and s of its last one
MOVING = 0.1  # of the largest speed: slower samples are left out, where friction is of another kind


@dataclass(frozen=True)
class Skew:
    """How late one channel comes after another, s, with its standard deviation; NaN where it cannot be told."""

    late: float
    std: float

    @property
    def sure(self) -> bool:
        """Whether the shift is beyond the error of its estimate."""
        return bool(np.isfinite(self.late) and abs(self.late) > SURE * self.std)


UNKNOWN = Skew(np.nan, np.nan)


def torque_skew(s: Segment, dataset: Dataset) -> Skew:
    """How late the torques come after the positions, s: the shift at which rigid bodies explain them best.

    All joints together, as one channel of torques is sampled at one time: torque is a linear combination
    of the rigid-body regressor, of motor inertia and of friction. Samples of slow joints, where friction
    has memory, are left out. The deviation is that of a jackknife over ``BLOCKS`` stretches of time. A shift that
    leaves most of what was unexplained, and more than noise, stands for something else, such as a gear with lost
    motion, and one that is gone without one of the joints, or that is another one at each of them, is no skew of the
    channels, but an effect of that joint, or one that follows the motion otherwise. It is a cross-correlation in which
    inertia, gravity and friction have their place.
    """
    near = _fit(s, dataset, 0.0)
    return near if near is not None else _far_skew(s, dataset)


def joint_skews(s: Segment, dataset: Dataset) -> list[Skew]:
    """How late the torque of each joint comes after the positions, s, all rigid bodies in common; unknown where that
    does not take nearly all that is unexplained at the joint, and at any joint where some other skew leaves most: that
    stands for something else, as a floor that shakes."""
    sums = _sums(s, dataset, SETTLED)
    if sums is None or dataset.n < 2:
        return [UNKNOWN] * dataset.n
    found = _by_joint(sums, dataset.sample_rate, 0.0)
    taken = found.gone > FAR_GONE
    seems = [k.sure and abs(k.late) > ODD / dataset.sample_rate for k in found.skews]
    if np.any(seems & ~taken):
        return [UNKNOWN] * dataset.n
    return [k if gone else UNKNOWN for k, gone in zip(found.skews, taken, strict=True)]


@dataclass(frozen=True)
class _ByJoint:
    """Skews of the torques of all joints, each its own, and the share (n,) of what is unexplained that goes with it."""

    skews: tuple[Skew, ...]
    gone: np.ndarray


@dataclass(frozen=True)
class _Sums:
    """What the torques of a motion are a linear combination of.

    Attributes:
        A: (rows, columns) of those of the samples looked at that move. rows: which of ``pick`` x joints these are.
        tau: (N, n) in the low band, over ``scale`` (n,). pick: samples looked at. keep: (len(pick), n) that move.
    """

    A: np.ndarray
    rows: np.ndarray
    tau: np.ndarray
    scale: np.ndarray
    pick: np.ndarray
    keep: np.ndarray
    every: int

    def torque(self, late: float | np.ndarray, rate: float) -> np.ndarray:
        """(len(pick), n) torque of so many seconds later, of all joints or (n,) of each."""
        time = np.arange(len(self.tau)) / rate
        shifts = np.broadcast_to(late, self.tau.shape[1])
        return (
            np.stack([np.interp(time[self.pick] + k, time, x) for k, x in zip(shifts, self.tau.T)], axis=1) / self.scale
        )


def _sums(s: Segment, dataset: Dataset, margin: float) -> _Sums | None:
    """Torques and their columns, ``margin`` s from the ends at least; None where nothing can be told."""
    rate = dataset.sample_rate
    q, tau, v, a = _band(s, rate)
    every = max(1, int(rate / (5 * BAND)), len(q) // LONGEST)
    edge = int(rate * margin) + 1
    pick = np.arange(edge, len(q) - edge, every)
    if len(pick) < 40 * BLOCKS // 2 or not np.any(np.ptp(v, axis=0) > 0):
        return None
    structure = build_structure(dataset.robot)
    # Friction turns over within a sample, the torque in its band does not: both pass the same filter.
    turns = _low(np.sign(v), rate)
    B = _torque_columns(structure, q[pick], v[pick], a[pick], turns[pick])
    scale = np.maximum(tau.std(axis=0), 1e-300)
    keep = np.abs(v[pick]) > MOVING * np.maximum(np.abs(v).max(axis=0), 1e-300)
    size = np.linalg.norm(B.reshape(-1, B.shape[2]), axis=0)
    B = B[:, :, size > 1e-9 * size.max()] / size[size > 1e-9 * size.max()] / scale[:, None]
    return _Sums(B.reshape(-1, B.shape[2]), keep.ravel(), tau, scale, pick, keep, every)


def _fit(s: Segment, dataset: Dataset, start: float, margin: float = SETTLED, least: float = np.inf) -> Skew | None:
    """The skew found from ``start`` s on; None where none within ``LATEST`` of it explains the torques.

    ``least``: what it may leave unexplained at most, in squares of torques over their deviations.
    """
    rate, n = dataset.sample_rate, dataset.n
    sums = _sums(s, dataset, margin)
    if sums is None:
        return UNKNOWN
    A, rows, pick = sums.A, sums.rows, sums.pick
    block = np.repeat(np.arange(len(pick)) * BLOCKS // len(pick), n)[rows]
    late = start
    unexplained = []
    for _ in range(8):
        y = sums.torque(late, rate)
        x = np.linalg.lstsq(A[rows], y.ravel()[rows], rcond=RANK)[0]
        fit = (A @ x).reshape(y.shape)
        unexplained.append(float(np.sum((y - fit).ravel()[rows] ** 2)))
        slope = np.gradient(fit, sums.every / rate, axis=0).ravel()[rows]
        step = _shift(A[rows], slope, y.ravel()[rows])
        late = late - step
        if abs(late - start) > LATEST:
            return None
        if abs(step) < 1e-6:
            break
    if unexplained[-1] > min(least, (1.0 - EXPLAINED) * np.sum((y - y.mean(axis=0)).ravel()[rows] ** 2)):
        return None
    skew = Skew(float(late), _spread(A[rows], slope, y.ravel()[rows], block))
    noise = float(np.sum(sums.keep * (difference_noise(s.tau) / sums.scale) ** 2)) * _passed(rate)
    as_noise = noise / NOTHING <= unexplained[-1] <= NOTHING * noise
    if start == 0.0 and skew.sure and unexplained[-1] > (1.0 - GONE) * unexplained[0] and not as_noise:
        return UNKNOWN
    at = np.tile(np.arange(n), len(pick))[rows]
    for j in range(n) if skew.sure and n > 1 else ():
        others = at != j
        without = (
            late - _shift(A[rows][others], slope[others], y.ravel()[rows][others])
            if others.sum() > A.shape[1]
            else late
        )
        if not abs(without - late) < ONE_JOINT * abs(late):
            return UNKNOWN
    if skew.sure and n > 1 and not _agreed(skew, _by_joint(sums, rate, late).skews):
        return UNKNOWN
    return skew


def _agreed(skew: Skew, own: tuple[Skew, ...]) -> bool:
    """Whether the skew of all joints is that of each; one that is not known speaks against none."""
    off = [abs(k.late - skew.late) > max(AGREE[0] * abs(skew.late), AGREE[1] * k.std) for k in own]
    return not any(off)


def _by_joint(sums: _Sums, rate: float, start: float) -> _ByJoint:
    """Skews of all joints at once, searched for from ``start`` s on; unknown where the search does not settle."""
    n, rows, pick = sums.tau.shape[1], sums.rows, sums.pick
    at = np.tile(np.arange(n), len(pick))[rows]
    block = np.repeat(np.arange(len(pick)) * BLOCKS // len(pick), n)[rows]
    U, sv, Vt = np.linalg.svd(sums.A[rows], full_matrices=False)
    kept = sv > RANK * sv[0]
    U, back = U[:, kept], Vt[kept].T / sv[kept]
    late, step = np.full(n, start), np.full(n, np.inf)
    left: list[np.ndarray] = []
    for _ in range(STEPS):
        y = sums.torque(late, rate).ravel()[rows]
        fit = (sums.A @ (back @ (U.T @ y))).reshape(-1, n)
        slope = np.gradient(fit, sums.every / rate, axis=0).ravel()[rows]
        C = np.where(at[:, None] == np.arange(n), slope[:, None], 0.0)
        unexplained = y - U @ (U.T @ y)
        left.append(np.bincount(at, weights=unexplained**2, minlength=n))
        step = np.linalg.lstsq(C - U @ (U.T @ C), unexplained, rcond=RANK)[0]
        late = late - step
        if np.abs(step).max() < 1e-6 or np.abs(late - start).max() > 2 * LATEST:
            break
    whole = np.bincount(at, weights=y**2, minlength=n)
    W = np.concatenate([U, C], axis=1)
    squares = np.array([W[block == k].T @ W[block == k] for k in range(BLOCKS)])
    products = np.array([W[block == k].T @ y[block == k] for k in range(BLOCKS)])
    parts = np.array(
        [
            np.linalg.lstsq(squares.sum(axis=0) - squares[k], products.sum(axis=0) - products[k], rcond=RANK**2)[0][-n:]
            for k in range(BLOCKS)
        ]
    )
    std = np.sqrt((BLOCKS - 1) / BLOCKS * np.sum((parts - parts.mean(axis=0)) ** 2, axis=0))
    settled = (np.abs(step) < SETTLES) & (np.abs(late - start) < 1.5 * LATEST) & (left[-1] < (1.0 - EXPLAINED) * whole)
    skews = tuple(Skew(float(k), float(d)) if ok else UNKNOWN for k, d, ok in zip(late, std, settled, strict=True))
    return _ByJoint(skews, 1.0 - left[-1] / np.maximum(left[0], 1e-300))


def _far_skew(s: Segment, dataset: Dataset) -> Skew:
    """A skew of up to ``FARTHEST``, where one alone explains the torques; motions that repeat sooner tell none."""
    rate = dataset.sample_rate
    reach = min(FARTHEST[0], FARTHEST[1] * len(s.t) / rate)
    sums = _sums(s, dataset, SETTLED + reach)
    if sums is None or reach < VALLEY:
        return UNKNOWN
    lags = np.arange(-round(reach / GRID) + 3, round(reach / GRID) - 2) * GRID
    U, sv, _ = np.linalg.svd(sums.A[sums.rows], full_matrices=False)
    U = U[:, sv > RANK * sv[0]]
    left = []
    for late in lags:
        y = sums.torque(late, rate).ravel()[sums.rows]
        left.append(float(np.sum((y - U @ (U.T @ y)) ** 2)))
    k = int(np.argmin(left))
    others = np.array(left)[np.abs(lags - lags[k]) > VALLEY]
    least = min(float(others.min()) / UNIQUE, (1.0 - FAR_GONE) * left[int(np.argmin(np.abs(lags)))])
    if not 0 < k < len(lags) - 1 or abs(lags[k]) < GRID / 2:
        return UNKNOWN
    found = _fit(s, dataset, float(lags[k]), SETTLED + reach, least)
    return found if found is not None and abs(found.late) > LATEST else UNKNOWN


def _torque_columns(structure: Structure, q: np.ndarray, v: np.ndarray, a: np.ndarray, turns: np.ndarray) -> np.ndarray:
    """(N, n, columns) what joint torques are a linear combination of; ``turns``: direction of motion."""
    model, data, d = structure.model, structure.model.createData(), structure.driven
    N, n = q.shape
    full = np.zeros((3, N, model.nv))
    for k, x in enumerate((q, v, a)):
        full[k][:, d] = x
    rigid = np.array(
        [pin.computeJointTorqueRegressor(model, data, *full[:, i]).reshape(model.nv, -1)[d].copy() for i in range(N)]
    )
    own = np.zeros((N, n, 5 * n))
    for j in range(n):
        own[:, j, 5 * j : 5 * j + 5] = np.stack(
            [a[:, j], v[:, j], v[:, j] * np.abs(v[:, j]), turns[:, j], np.ones(N)], axis=1
        )
    return np.concatenate([rigid, own], axis=2)


def _shift(A: np.ndarray, slope: np.ndarray, y: np.ndarray) -> float:
    """Least-squares coefficient of ``slope`` beside the columns ``A``."""
    if not A.size:
        return 0.0
    U, sv, _ = np.linalg.svd(A, full_matrices=False)
    U = U[:, sv > RANK * sv[0]]
    own = slope - U @ (U.T @ slope)
    return float(own @ (y - U @ (U.T @ y)) / max(own @ own, 1e-300))


def _spread(A: np.ndarray, slope: np.ndarray, y: np.ndarray, block: np.ndarray) -> float:
    """Standard deviation of ``_shift`` by the jackknife over the ``BLOCKS`` that rows are of (Efron 1982)."""
    parts = np.array([_shift(A[block != k], slope[block != k], y[block != k]) for k in range(BLOCKS)])
    return float(np.sqrt((BLOCKS - 1) / BLOCKS * np.sum((parts - parts.mean()) ** 2)))


def link_skew(s: Segment, dataset: Dataset) -> list[Skew]:
    """How late the link encoder of each joint comes after its motor encoder, s.

    ``q - q_link = late q' + (T + damping T') / stiffness + lost motion sign(q') + offset``: the gear carries
    ``T = M q_link'' + c + g`` of the links as they move behind their gears, as the URDF has them, and not the friction
    of the motor. Where motors move in one direction, that their links swing would else look like a skew.
    """
    out, rate = [], dataset.sample_rate
    if s.q_link is None:
        return [UNKNOWN] * dataset.n
    _, _, v, _ = _band(s, rate)
    structure, edge = build_structure(dataset.robot), int(rate * SETTLED)
    # The zeros of link encoders are not known: the links swing about where the motors are.
    swing = s.q_link - s.q
    told = np.all(np.isfinite(swing), axis=0) & (np.ptp(s.q_link, axis=0) > 0)
    links = _low(s.q + np.where(told, swing - swing.mean(axis=0), 0.0), rate)
    speed = np.gradient(links, 1 / rate, axis=0)
    a = np.gradient(speed, 1 / rate, axis=0)
    full = np.zeros((3, len(v), structure.model.nv))
    for k, x in enumerate((links, speed, a)):
        full[k][:, structure.driven] = x
    carried = newton_euler(chain_of(structure.model), *full)[:, structure.driven]
    damped = np.gradient(carried, 1 / rate, axis=0)
    for j in range(dataset.n):
        link = s.q_link[:, j]
        keep = np.abs(v[:, j]) > MOVING * np.abs(v[:, j]).max()
        keep[:edge] = keep[len(keep) - edge :] = False
        if not np.all(np.isfinite(link)) or np.ptp(link) == 0 or keep.sum() < 10 * BLOCKS:
            out.append(UNKNOWN)
            continue
        y = _low(s.q[:, [j]] - link[:, None], rate)[keep, 0]
        columns = [carried[:, j], damped[:, j], a[:, j], np.sign(v[:, j]), np.ones(len(v))]
        A = np.stack(columns, axis=1)[keep]
        A = A / np.maximum(np.linalg.norm(A, axis=0), 1e-300)
        slope = v[keep, j]
        block = np.arange(len(y)) * BLOCKS // len(y)
        out.append(Skew(_shift(A, slope, y), _spread(A, slope, y, block)))
    return out


def _filter(rate: float) -> np.ndarray:
    return scipy.signal.butter(3, min(BAND, 0.2 * rate) / (rate / 2), output="sos")


def _low(x: np.ndarray, rate: float) -> np.ndarray:
    return scipy.signal.sosfiltfilt(_filter(rate), x, axis=0)


def _passed(rate: float) -> float:
    """Share of the variance of white noise that passes the low band, there and back."""
    _, H = scipy.signal.sosfreqz(_filter(rate), 1 << 14)
    return float(np.mean(np.abs(H) ** 4))


def _band(s: Segment, rate: float) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Position, torque, velocity and acceleration in the low band, (N, n) each."""
    q, tau = _low(s.q, rate), _low(s.tau, rate)
    v = np.gradient(q, 1 / rate, axis=0)
    return q, tau, v, np.gradient(v, 1 / rate, axis=0)


def skew_warnings(s: Segment, dataset: Dataset) -> list[str]:
    """Skews that are sure; of motions only, where rigid bodies rule."""
    rate = dataset.sample_rate
    held = HELD / rate if dataset.input_hold == "zoh" else 0.0
    if s.kind != "trajectory" or len(s.t) < 4 * rate * SETTLED + 100:
        return []
    whole = torque_skew(s, dataset)
    named = [("torque", "the positions", whole, -held)]
    # Of one joint alone a skew of less than a sample may be much else.
    named += [
        (f"tau_{j + 1} ({dataset.joints[j]})", f"q_{j + 1}", k, -held)
        for j, k in enumerate([] if whole.sure else joint_skews(s, dataset))
        if abs(k.late + held) > ODD / rate
    ]
    named += [
        (f"q_link_{j + 1} ({dataset.joints[j]})", f"q_{j + 1}", k, 0.0) for j, k in enumerate(link_skew(s, dataset))
    ]
    return [
        f"{what} comes {_ms(k.late)} ms {'after' if k.late > 0 else 'before'} {other} (± {k.std * 1e3:.1g} ms): {_reason(what, k.late, usual, rate)}"
        for what, other, k, usual in named
        if _said(k, usual, rate)
    ]


def _ms(late: float) -> str:
    """The size of a skew, s, in milliseconds."""
    return f"{abs(late) * 1e3:{'.3g' if abs(late) > LATEST else '.2g'}}"


def _said(skew: Skew, usual: float, rate: float) -> bool:
    """Whether a skew is beyond the usual one, s: by a sample, or by less that is sure as well."""
    off = abs(skew.late - usual)
    return skew.sure and (off > ODD / rate or off > max(SMALL[0] / rate, SMALL[1], SURE * skew.std))


def _reason(what: str, late: float, usual: float, rate: float) -> str:
    if what.startswith("tau_"):
        return "one of them sampled at another time or filtered, or the drive of this joint late?"
    if abs(late) > LATEST:
        return "channels of clocks that are not in step (shift in [files] of a map moves one)?"
    held = what == "torque" and usual == 0.0 and abs(late * rate + HELD) < SMALL[0]
    return 'held over a sample (input_hold = "zoh")?' if held else "channels sampled at different times?"
