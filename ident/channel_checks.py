"""What looks wrong in the channels of one recording: units, clipping, freezes, lost samples, poor motion.

Each check is a function of one segment that gives sentences; none changes data. Thresholds are wide:
a warning is worth reading, silence proves nothing.
"""

from __future__ import annotations

import numpy as np
import pinocchio as pin
import scipy.signal

from ident.chain import build_structure
from ident.dataset import Dataset, Segment
from ident.lost_samples import resolution, runs_of, same_as_before
from ident.rest import difference_noise
from robot_assets.robot import Robot, linear_joints
from robot_assets.urdf import read_urdf

BELOW, MOSTLY = 0.3, 0.3  # of the lowest anti-resonance: below, links follow their motors; share of the motion there
ORDER, ENDS = 3, 0.3  # of the filter that leaves it, and s that it takes to forget the ends of the log
LIKE = (0.8, 1.25)  # a channel over what tells the same, of one unit and sign
FOLLOWED = (0.5, 2.0)  # the same of a reference over what follows it
FREEZE = 0.1  # s: a channel that stands still for longer while the joint moves
STEPS = 1.5  # counts: a position that takes smaller steps from sample to sample may wait for its next count
SAME = 1e-9  # of the largest value: signals that differ by less are one
CHANGES = 10  # of a signal, from which it can be known again
CLIPPED = 3e-3  # share of the samples at the very largest value, in runs of three or more
SMOOTH = 1e-5  # torque noise over torque rms, below which a log was filtered
BEYOND = 1.1  # largest torque over the limit of its drive, that noise and overshoot do not explain
MOVES = 3.0  # standard deviation of a position over its noise
LOW_SHARE = 0.1  # of the sample rate
ALIKE = 3  # samples in all channels, and times as many as are alike all along, that are a freeze in motion
ASIDE = 0.02  # s at most before and after such samples, in which the motion goes on,
ABRUPT = 2.0  # times as far as accelerations change it elsewhere
REGULAR = 0.8  # share of the samples that are alike in one number, where a log is faster than what it records


def velocity(s: Segment, rate: float) -> np.ndarray:
    """(N, n) velocity: differences of the position over about 10 ms."""
    half = max(1, round(0.005 * rate))
    if len(s.q) <= 2 * half:
        return np.zeros_like(s.q)
    v = (s.q[2 * half :] - s.q[: -2 * half]) * rate / (2 * half)
    return np.concatenate([np.repeat(v[:1], half, axis=0), v, np.repeat(v[-1:], half, axis=0)])


def filled_warnings(s: Segment, dataset: Dataset) -> list[str]:
    """Gaps of the log that its conversion has filled."""
    if s.filled is None:
        return []
    f, share = s.filled, s.filled.total * dataset.sample_rate / len(s.t)
    return [
        f"{f.gaps} gaps of the log, {f.longest:.3g} s the longest, {f.total:.3g} s in all ({share:.2g} of the segment), were filled by interpolation"
    ]


def unit_warnings(s: Segment, dataset: Dataset) -> list[str]:
    """Values that no such robot can have, and channels that contradict each other."""
    robot, out = dataset.robot, []
    kinds, linear = read_urdf(robot.urdf).kinds, linear_joints(robot)
    v = velocity(s, dataset.sample_rate)
    limits, speeds = robot.array("torque_limit"), robot.array("velocity_limit")
    alike = robot.n > 1 and np.ptp(limits) == 0.0  # one limit of all joints was put in for none
    motors, links = _below_resonance(s, dataset)
    for j, name in enumerate(dataset.joints):
        m, newton = ("m", "N") if linear[j] else ("rad", "N m")
        q, tau = s.q[:, j], s.tau[:, j]
        room = robot.q_max[j] - robot.q_min[j]
        if kinds[name] != "continuous" and (
            q.max() > robot.q_max[j] + 0.02 * room or q.min() < robot.q_min[j] - 0.02 * room
        ):
            why = (
                "wrong unit, zero or side of the gear?"
                if np.ptp(q) <= 1.1 * room
                else "degrees, millimetres, or the motor side of the gear?"
            )
            out.append(
                f"q_{j + 1} ({name}) goes from {q.min():.4g} to {q.max():.4g} {m}, its limits are {robot.q_min[j]:.4g} and {robot.q_max[j]:.4g}: {why}"
            )
        fast = float(np.percentile(np.abs(v[:, j]), 99.5))
        if fast > 2 * speeds[j]:
            out.append(
                f"q_{j + 1} ({name}) moves at {fast:.4g} {m}/s, its limit is {speeds[j]:.4g}: wrong unit or sample rate?"
            )
        top = float(np.abs(tau).max())
        known = name not in robot.guessed["torque_limit"]
        if known and top > 3 * limits[j]:
            out.append(
                f"tau_{j + 1} ({name}) reaches {top:.4g} {newton}, its limit is {limits[j]:.4g}: wrong unit or side of the gear?"
            )
        elif known and top > BEYOND * limits[j]:
            out.append(
                f"tau_{j + 1} ({name}) reaches {top:.4g} {newton}, beyond its limit of {limits[j]:.4g}: does the drive saturate there, or has it another limit?"
            )
        elif known and 0 < top < 2e-3 * limits[j] and not alike:
            out.append(
                f"tau_{j + 1} ({name}) stays below {top:.3g} {newton}, its limit is {limits[j]:.4g}: current, or torque before the gear?"
            )
        # A loop follows a slow reference as it is, and one near its bandwidth more or less.
        compared = (("qd", s.qd, v, LIKE), ("q_link", links, motors, LIKE), ("q_ref", s.q_ref, s.q, FOLLOWED))
        for channel, x, reference, (low, high) in compared:
            if x is None or not np.all(np.isfinite(x[:, j])) or np.ptp(x[:, j]) == 0:
                continue
            a, b = x[:, j] - x[:, j].mean(), reference[:, j] - reference[:, j].mean()
            # Only where the two tell the same story can their sizes be compared.
            gain, alike = _gain(a, b)
            if alike > 0.9 and not low < gain < high:
                what = f"the derivative of q_{j + 1}" if channel == "qd" else f"q_{j + 1}"
                out.append(f"{channel}_{j + 1} ({name}) is {gain:.4g} times {what}: wrong unit or sign?")
    return out


def _below_resonance(s: Segment, dataset: Dataset) -> tuple[np.ndarray, np.ndarray | None]:
    """(N, n) positions of motors and links where these follow those: near its resonance a link swings further.

    A joint that hardly moves so slowly has none of its link.
    """
    if s.q_link is None:
        return s.q, None
    rate = dataset.sample_rate
    edge, cut = round(ENDS * rate), min(0.2 * rate, BELOW * float(anti_resonance(s, dataset.robot).min()))
    if len(s.q) < 3 * edge + 32 or not cut > 0:
        return s.q, None
    low = scipy.signal.butter(ORDER, cut / (rate / 2), output="sos")
    motors = scipy.signal.sosfiltfilt(low, s.q, axis=0)[edge : len(s.q) - edge]
    told = np.all(np.isfinite(s.q_link), axis=0) & (motors.std(axis=0) > MOSTLY * s.q.std(axis=0))
    links = scipy.signal.sosfiltfilt(low, np.where(told, s.q_link, 0.0), axis=0)[edge : len(s.q) - edge]
    return motors, np.where(told, links, np.nan)


def identical_warnings(s: Segment, dataset: Dataset) -> list[str]:
    """Joints of which a channel is that of another joint: no two joints tell the same, down to noise and rounding."""
    out = []
    for channel in ("tau", "q", "qd", "q_link"):
        x = getattr(s, channel)
        for i in range(dataset.n) if x is not None else ():
            for k in range(i):
                if _same(x[:, k], x[:, i]):
                    first, second = (f"{channel}_{j + 1} ({dataset.joints[j]})" for j in (k, i))
                    out.append(f"{first} and {second} are identical: one column for two joints?")
    return out


def _same(a: np.ndarray, b: np.ndarray) -> bool:
    """Whether two signals are one that changes now and then; what stands still or is not there is nobody's."""
    if not (np.all(np.isfinite(a)) and np.all(np.isfinite(b))) or np.sum(np.diff(a) != 0) < CHANGES:
        return False
    return bool(np.all(np.abs(a - b) <= SAME * np.abs(a).max()))


def _gain(a: np.ndarray, b: np.ndarray) -> tuple[float, float]:
    """Slope of a on b, and the size of their correlation."""
    aa, bb, ab = float(a @ a), float(b @ b), float(a @ b)
    if aa <= 0 or bb <= 0:
        return 1.0, 0.0
    return ab / bb, abs(ab) / np.sqrt(aa * bb)


def stuck_warnings(s: Segment, dataset: Dataset) -> list[str]:
    """Channels that are constant, freeze in motion, or are cut off at a largest value."""
    out = []
    v, linear = velocity(s, dataset.sample_rate), linear_joints(dataset.robot)
    longest = max(3, round(FREEZE * dataset.sample_rate))
    for j, name in enumerate(dataset.joints):
        unit = "N" if linear[j] else "N m"
        for channel, x in (("tau", s.tau[:, j]), ("q", s.q[:, j])):
            if np.ptp(x) == 0:
                out.append(f"{channel}_{j + 1} ({name}) is frozen")
                continue
            runs = runs_of(x)
            starts, lengths = runs.starts, runs.lengths
            k = int(np.argmax(lengths))
            a, b = int(starts[k]), int(starts[k] + lengths[k])
            if channel == "tau":
                moving = np.abs(v[a:b, j]).mean() > 0.05 * np.abs(v[:, j]).max()
            else:
                # A position may rest; one that stops within a sample out of full motion did not.
                before = np.abs(np.diff(x[max(0, a - 4) : a + 1]))
                after = np.abs(np.diff(x[b - 1 : b + 4]))
                # Nor did one that moves by less than a count from sample to sample.
                least = max(0.3 * np.percentile(np.abs(np.diff(x)), 95), STEPS * resolution(np.diff(x)))
                moving = len(before) > 0 and len(after) > 0 and min(before.min(), after.max()) > least
            inside = a > 0 and b < len(x)
            if lengths[k] >= longest and moving and inside:
                out.append(
                    f"{channel}_{j + 1} ({name}) stands still for {lengths[k] / dataset.sample_rate:.3g} s from {s.t[a]:.4g} s on, in motion"
                )
            for top, word in ((x.max(), "above"), (x.min(), "below")):
                # Saturation comes in runs; a coarse signal meets its extremes here and there.
                ends = np.isclose(x[starts], top, rtol=0, atol=1e-9 * np.ptp(x)) & (lengths >= 3)
                share = float(lengths[ends].sum()) / len(x)
                if channel == "tau" and share > CLIPPED and len(starts) > 30:
                    out.append(f"tau_{j + 1} ({name}) is clipped {word} {top:.4g} {unit}, {share:.1%} of the time")
    return out


def freeze_warnings(s: Segment, dataset: Dataset) -> list[str]:
    """Stretches in which all positions and torques stand still at once amid a motion, and logs of repeated samples."""
    rate, rows = dataset.sample_rate, np.concatenate([s.q, s.tau], axis=1)
    if len(rows) < 64 or not np.any(np.ptp(s.q, axis=0) > 0):
        return []
    runs = runs_of(rows)
    starts, lengths = runs.starts, runs.lengths
    usual = int(np.median(lengths))
    out = []
    if usual > 1 and np.mean(np.abs(lengths - usual) <= 1) > REGULAR:
        out.append(
            f"all channels change every {usual} samples only: measured at {rate / usual:.4g} Hz and logged at {rate:.4g} Hz?"
        )
    long = lengths >= ALIKE * usual
    still = np.repeat(long & (lengths < len(rows)), lengths)
    found = [
        (int(a), int(k))
        for a, k in zip(starts[long], lengths[long], strict=True)
        if _amid_motion(s.q, a, a + k, still, rate)
    ]
    if found:
        a, k = max(found, key=lambda run: run[1])
        others = f"; {len(found)} such stretches, {sum(n for _, n in found)} samples in all" if len(found) > 1 else ""
        out.append(
            f"all channels stand still at once for {k} samples, {k / rate:.3g} s from {s.t[a]:.4g} s on, in motion: the log froze{others}"
        )
    return out


def _amid_motion(q: np.ndarray, a: int, b: int, still: np.ndarray, rate: float) -> bool:
    """Whether some joint moves on in one direction before sample ``a`` and after ``b - 1``, too fast to have stopped.

    Args:
        q: (N, n) rad or m, the same from ``a`` to ``b - 1``. still: (N,) samples of no change at all.
    """
    near = min(b - a, max(2, round(ASIDE * rate)))
    if a < near or b + near >= len(q):
        return False
    before, after = q[a] - q[a - near], q[b + near] - q[b]
    # What accelerations and noise change within as many samples, where the log runs.
    runs = ~(still[: -2 * near] | still[near:-near] | still[2 * near :])
    bend = np.abs(q[: -2 * near] - 2 * q[near:-near] + q[2 * near :])[runs]
    if len(bend) < 32:
        return False
    counts = np.array([resolution(x) for x in np.diff(q, axis=0).T])
    least = ABRUPT * np.maximum(np.percentile(bend, 99, axis=0), counts)
    return bool(np.any((before * after > 0) & (np.minimum(np.abs(before), np.abs(after)) > least)))


def lost_sample_warnings(s: Segment, dataset: Dataset) -> list[str]:
    """Samples that repeat the one before in all channels, and positions of all joints that take two steps in one."""
    rows = np.concatenate([s.q, s.tau], axis=1)
    step = np.diff(s.q, axis=0)
    noise = np.maximum(difference_noise(s.q), 1e-300) if len(s.q) > 8 else np.full(dataset.n, np.inf)
    usual = scipy.signal.medfilt(np.abs(step), (9, 1)) if len(step) > 9 else np.abs(step)
    # Where a joint moves so fast that a lost sample stands out of noise and resolution.
    counts = np.array([resolution(x) for x in step.T])
    fast = usual > 8 * np.maximum(noise, counts)
    moving = np.any(fast, axis=1)
    together = same_as_before(rows)
    repeated = int(np.sum(together[1:] & moving))
    # A lost sample is lost for all joints; one joint alone may stumble by itself.
    even = np.abs(np.abs(step) - usual) < 0.3 * usual
    around = np.pad(even, ((1, 1), (0, 0)))
    # A joint that speeds up takes longer and longer steps: about a sample that is lost they are as usual.
    double = (np.abs(np.abs(step) - 2 * usual) < 0.3 * usual) & fast & around[:-2] & around[2:]
    found = moving & (double.sum(axis=1) > 0.6 * fast.sum(axis=1))
    jumps = int(np.sum(found & ~_recurring(found, s.period)))
    out = []
    if repeated > max(1, 1e-4 * len(rows)):
        out.append(
            f"{repeated} samples ({repeated / len(rows):.1%}) repeat the one before in all channels, in motion: lost packets"
        )
    if jumps > max(2, 1e-3 * moving.sum()):
        out.append(f"{jumps} double steps of position between samples: dropped samples")
    return out


def _recurring(found: np.ndarray, period: int | None) -> np.ndarray:
    """(N,) whether what was found at a sample is found in most of the periods there: it is of the motion, not of the
    log."""
    periods = 0 if period is None else (len(found) + 1) // period  # found between samples
    if period is None or periods < 2:
        return np.zeros(len(found), bool)
    place = np.arange(len(found)) % period
    often = np.bincount(place, weights=found, minlength=period) > 0.5 * periods
    return often[place]


def excitation_warnings(s: Segment, dataset: Dataset) -> list[str]:
    """Motions that tell too little: joints at rest, one direction only, or slower than the gears."""
    robot, rate, out = dataset.robot, dataset.sample_rate, []
    if len(s.t) < 64:
        return [f"{len(s.t)} samples are too few"]
    tau_rms = np.maximum(s.tau.std(axis=0), 1e-300)
    smooth = np.flatnonzero((difference_noise(s.tau) < SMOOTH * tau_rms) & (np.ptp(s.tau, axis=0) > 0))
    if len(smooth):
        out.append(
            f"no noise is left on the torque of joints {_list(smooth)}: the log was filtered, deviations will come out too small"
        )
    if s.kind != "trajectory":
        # Differences of samples show noise alone where the excitation stays far below the sample rate.
        low = s.period is not None and not np.any(np.asarray(s.excited_lines) > LOW_SHARE * s.period)
        still = np.flatnonzero(s.q.std(axis=0) < MOVES * difference_noise(s.q)) if low else np.zeros(0, int)
        if len(still):
            out.append(
                f"joints {_list(still)} hardly move beyond the noise of their position: nothing is learnt of them"
            )
        return out
    v = velocity(s, rate)
    speeds = robot.array("velocity_limit")
    slow = np.flatnonzero(np.percentile(np.abs(v), 99, axis=0) < 0.01 * speeds)
    if len(slow):
        out.append(f"joints {_list(slow)} hardly move (below 1 % of their velocity limit): nothing is learnt of them")
    turns = np.array([_reversals(v[:, j], 0.05 * np.abs(v[:, j]).max()) for j in range(dataset.n)])
    few = np.flatnonzero((turns < 1) & ~np.isin(np.arange(dataset.n), slow))
    if len(few):
        out.append(
            f"joints {_list(few)} move in one direction only: their friction cannot be told from gravity and offsets"
        )
    top, anti = highest_frequency(s, rate), anti_resonance(s, robot)
    still = np.flatnonzero(top < 0.3 * anti)
    if len(still):
        j = int(still[np.argmin(top[still] / anti[still])])
        out.append(
            f"the motion of joints {_list(still)} has nothing near their anti-resonance (joint {j + 1}: up to {top[j]:.2g} Hz of about "
            f"{anti[j]:.2g} Hz): stiffness and damping of the gears will rest on their starting guesses"
        )
    return out


def highest_frequency(s: Segment, rate: float) -> np.ndarray:
    """(n,) highest frequency, Hz, at which the position stands ten times above its noise."""
    n = min(len(s.q), 1 << int(np.log2(len(s.q))), 8192)
    f, P = scipy.signal.welch(
        s.q - s.q.mean(axis=0), rate, nperseg=n, axis=0, detrend="linear", window="blackmanharris"
    )
    floor = 10 * np.maximum(2 * difference_noise(s.q) ** 2 / rate, np.median(P[-max(4, len(f) // 10) :], axis=0))
    out = []
    for j in range(P.shape[1]):
        low = P[:, j] < floor[j]
        gone = np.flatnonzero(low[:-2] & low[1:-1] & low[2:])
        out.append(f[gone[0]] if len(gone) else f[-1])
    return np.array(out)


def anti_resonance(s: Segment, robot: Robot) -> np.ndarray:
    """(n,) frequency, Hz, at which each link swings on its gear of ``robot.toml`` with all motors held."""
    structure = build_structure(robot)
    q = np.zeros(structure.model.nq)
    q[structure.driven] = np.median(s.q, axis=0)
    M = np.diag(pin.crba(structure.model, structure.model.createData(), q))[structure.driven]
    return np.sqrt(robot.array("stiffness") / np.maximum(M, 1e-9)) / (2 * np.pi)


def _reversals(v: np.ndarray, threshold: float) -> int:
    signs = np.sign(v[np.abs(v) > threshold])
    return int(np.sum(np.diff(signs) != 0))


def _list(joints: np.ndarray) -> str:
    return ", ".join(str(int(j) + 1) for j in joints)
