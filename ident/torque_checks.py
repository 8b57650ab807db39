"""Whether the torques of a recording are those that its motion asks for: signs, sizes, order of columns, units of time.

The torque that the bodies of the description, the motors and gravity need along the measured motion is compared with
the one recorded, joint by joint and across joints, friction and an offset of each joint left free. Descriptions are
wrong by some ten per cent and drives by a factor of two, so only what is far outside is said.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass

import numpy as np
import scipy.signal

from ident.chain import build_structure
from ident.channel_checks import anti_resonance
from ident.dataset import Dataset, Segment
from ident.label_fits import Motion, Reading, correlation, other_readings, other_zero, said_of, without
from ident.rest import difference_noise
from robot_assets.robot import linear_joints

SEGMENTS = 6  # of a dataset, that a diagnosis looks at
BAND = 12.0  # Hz, at most: below, links follow their motors
BELOW = 0.5  # of the lowest anti-resonance
SETTLED = 0.3  # s: the filter of the band has forgotten the ends of the log
LONGEST = 1000  # instants compared
LEAST = 160  # the same
ALIKE = 0.7  # correlation above which sizes are compared
APART = 0.6  # correlation below which two torques have little to do with each other
FAR = 8.0  # ratio of sizes that no error of a drive or a body explains
ALL = 2.5  # the same, of the middle joint
SEEN = 0.3  # size of what is needed over what was recorded, from which a joint tells that signs are wrong
LARGE = 0.6, 2.0  # size of what is needed over what was recorded, at two joints or more, or at one
NOTHING = 0.3  # correlation below which, at all joints, torques have nothing to do with the motion
AGAINST = -0.2, 0.5  # correlation below and size above which one joint is enough
BETTER = 0.5  # of the part of a torque not explained by its own joint, that another must leave at most


@dataclass(frozen=True)
class Match:
    """Recorded torques against needed ones.

    Attributes:
        correlation: (n, n) of the torque recorded at i with the one needed at j, friction and offset removed.
        slope: (n,) recorded torque over the needed one. size: (n,) rms needed over rms recorded.
        beside_spring: (n,) correlation of the torques of each joint, what is linear in its position removed too.
        telling: (n,) joints whose torque can tell whether it fits.
        readings: joint -> (joint, signs and zero) that explain the torques, where those recorded do not.
    """

    correlation: np.ndarray
    slope: np.ndarray
    size: np.ndarray
    beside_spring: np.ndarray
    telling: np.ndarray
    readings: dict[int, tuple[tuple[int, Reading], ...]]


def match_torques(s: Segment, dataset: Dataset) -> Match | None:
    """None where the segment is too short or nothing moves."""
    m = _motion(s, dataset)
    return None if m is None else _match(m)


def _motion(s: Segment, dataset: Dataset) -> Motion | None:
    """Positions and torques of a segment in the band in which links follow their motors."""
    rate = dataset.sample_rate
    edge = int(rate * SETTLED) + 1
    every = max(1, (len(s.q) - 2 * edge) // LONGEST)
    pick = np.arange(edge, len(s.q) - edge, every)
    if len(pick) < LEAST or not np.any(np.ptp(s.q, axis=0) > 0):
        return None
    cut = min(BAND, 0.2 * rate, BELOW * float(anti_resonance(s, dataset.robot).min()))
    low = scipy.signal.butter(3, cut / (rate / 2), output="sos")
    q, tau = (scipy.signal.sosfiltfilt(low, x, axis=0) for x in (s.q, s.tau))
    v = np.gradient(q, 1 / rate, axis=0)
    turns = scipy.signal.sosfiltfilt(low, np.sign(v), axis=0)[pick]
    a = np.gradient(v, 1 / rate, axis=0)[pick]
    q, tau, v = q[pick], tau[pick], v[pick]
    robot = dataset.robot
    linear, inertia = np.array(linear_joints(robot)), robot.array("motor_inertia")
    noise = difference_noise(s.tau) * np.sqrt(2 * cut / rate)  # in the band
    return Motion(q, v, a, tau, turns, build_structure(robot), linear, inertia, noise)


def _match(m: Motion) -> Match:
    n, tau, needed = m.q.shape[1], m.tau, m.needed(m.q, m.v, m.a)
    C, slope, size, beside = np.zeros((n, n)), np.zeros(n), np.zeros(n), np.zeros(n)
    for j in range(n):
        need, got = without(m.own(j), needed[:, j]), without(m.own(j), tau)
        sprung = m.own(j, spring=True)
        beside[j] = correlation(without(sprung, needed[:, j]), without(sprung, tau[:, j]))
        lengths = np.maximum(np.linalg.norm(got, axis=0), 1e-300)
        length = max(float(np.linalg.norm(need)), 1e-300)
        C[:, j] = need @ got / lengths / length
        slope[j], size[j] = C[j, j] * lengths[j] / length, length / lengths[j]
    telling = m.telling()
    doubtful = np.any((beside < APART) & (size > SEEN) & telling) and not _crossed(C)
    return Match(C, slope, size, beside, telling, other_readings(m) if doubtful else {})


def _crossed(C: np.ndarray) -> list[tuple[int, int]]:
    """Pairs of joints whose torques follow each what the other needs; a joint is in one pair."""
    own, out = np.diag(C), []
    said: set[int] = set()
    for i in range(len(C)):
        for k in range(i):
            crossed = min(C[i, k], C[k, i]) > ALIKE and all(
                1 - c**2 < BETTER * (1 - o**2) for c, o in ((C[i, k], own[i]), (C[k, i], own[k]))
            )
            if crossed and not said & {i, k}:
                said |= {i, k}
                out.append((k, i))
    return out


def mislabelled(dataset: Dataset) -> list[str]:
    """What is surely wrong in the labels of torques: said of more than half of the segments that were looked at."""
    pick = np.unique(np.linspace(0, len(dataset.segments) - 1, SEGMENTS).round().astype(int))
    found = [m for k in pick if (m := match_torques(dataset.segments[k], dataset)) is not None]
    said = [contradictions(m, dataset.joints) for m in found]
    kinds = Counter(key for one in said for key in one)
    first = {key: text for one in reversed(said) for key, text in one.items()}
    return [first[key] for key in sorted(kinds) if kinds[key] > len(found) / 2]


def torque_warnings(s: Segment, dataset: Dataset) -> list[str]:
    """Signs, sizes and order of torques that the motion cannot have asked for."""
    m = _motion(s, dataset)
    if m is None:
        return []
    found = _match(m)
    return list(contradictions(found, dataset.joints).values()) or _zero(m, s, dataset.joints) or _doubts(found)


def _zero(m: Motion, s: Segment, joints: tuple[str, ...]) -> list[str]:
    """Another zero of one joint; of motions only, along which gravity changes."""
    found = other_zero(m) if s.kind == "trajectory" else None
    if found is None:
        return []
    j, added = found
    return [
        f"the torques do not fit what bodies and motors need, which they do with {added:.2g} rad added to q_{j + 1} ({joints[j]}):"
        " another zero, or a centre of mass elsewhere in its links?"
    ]


def contradictions(found: Match, joints: tuple[str, ...]) -> dict[tuple[int, str], str]:
    """(Joint, kind) -> what no error of a model explains: swapped columns, a wrong sign, another size."""
    C, slope, own = found.correlation, found.slope, np.diag(found.correlation)
    named = [f"tau_{j + 1} ({name})" for j, name in enumerate(joints)]
    out: dict[tuple[int, str], str] = {}
    said: set[int] = set()
    for k, i in _crossed(C):
        said |= {i, k}
        out[k, "swapped"] = (
            f"{named[k]} follows what joint {i + 1} needs and tau_{i + 1} what joint {k + 1} needs: columns swapped?"
        )
    for j, ways in found.readings.items():
        out[j, "sign"] = said_of(j, joints, ways, float(slope[j]))
    if found.readings:  # with these, the torques of the other joints are what they should be
        said |= set(range(len(joints)))
    for j in range(len(joints)):
        if j in said or abs(own[j]) < ALIKE:
            continue
        if own[j] < 0 and found.beside_spring[j] > -ALIKE:
            continue  # a spring that balances gravity turns its torque over, and leaves that of inertia
        if own[j] < 0:
            out[j, "sign"] = f"{named[j]} runs against what bodies and motor need, {slope[j]:.3g} times it: wrong sign?"
        elif not 1 / FAR < slope[j] < FAR:
            out[j, "size"] = (
                f"{named[j]} is {slope[j]:.3g} times what bodies and motor need: wrong unit, torque constant or side of the gear?"
            )
    if not out and np.all(np.abs(own) < NOTHING) and np.all(found.size > LARGE[0]):
        out[0, "noise"] = (
            f"the torques have nothing to do with what the motion needs (correlation {np.abs(own).max():.2g} at most): noise, or of another run?"
        )
    return out


def _doubts(found: Match) -> list[str]:
    """What speaks against the labels, and may be an error of the model or poor data as well."""
    out, slope, own = [], found.slope, np.diag(found.correlation)
    sure = slope[own > ALIKE]
    if len(sure) >= 3 and not 1 / ALL < np.median(sure) < ALL:
        out.append(
            f"torques are about {np.median(sure):.2g} times what bodies and motors need: wrong unit, or sample rate?"
        )
    unlike = (found.beside_spring < APART) & found.telling
    strange = (own < APART) & unlike & (found.size > LARGE[0])
    against = (own < AGAINST[0]) & unlike & (found.size > AGAINST[1])
    if np.sum(strange) > 1 or np.any(strange & (found.size > LARGE[1])) or np.any(against):
        strange |= against
        joints = ", ".join(str(j + 1) for j in np.flatnonzero(strange))
        out.append(
            f"the torque of joints {joints} has little to do with what their motion needs (correlation {own[strange].min():.2g}):"
            " joints in another order, a wrong sign or zero of a position, strong friction, noise, or another robot?"
        )
    return out
