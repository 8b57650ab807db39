"""Signs and zeros of positions and torques with which the bodies of a description explain a motion.

A position that counts the other way turns over gravity at its joint and the forces between joints, so that torques of
all joints together tell it from a torque of the wrong sign, unless the axis bears no gravity and moves no other.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from ident.chain import Structure
from ident.recursion import chain_of, newton_euler

INSTANTS = 300  # of a motion compared
TELLS = 0.5  # share of a torque left unexplained, above which its joint tells nothing
SURE = 4.0  # times as much must be unexplained as recorded,
AS_GOOD = 2.0  # and with so many times what is left another reading is possible too,
CLOSE = 0.02  # or with so much more
LEFT = 0.3  # of the larger one of its parts, that a needed torque must be to tell: descriptions err by less,
OVER = 4.0  # and times the noise of the recorded torque
STEP = 0.8  # of what was unexplained, that one more joint read otherwise must leave at most
ZEROS = np.linspace(-1.2, 1.2, 17)  # rad, about which another zero of a joint is looked for,
CUTS, FEW = 10, 100  # cuts of such a step by a third, and instants looked at
MOVED = 0.1  # rad by which it must differ,
OF_WHOLE = 0.02  # share of their torques, summed over joints, that must be unexplained as recorded,
ONLY = 0.1, 3.0  # share of that which it may leave, and times as much that any other joint leaves at least

Reading = tuple[int, int, int]  # sign of the position, sign of the torque, quarter turns added to the position
RECORDED: Reading = (1, 1, 0)
MIRRORED: Reading = (-1, -1, 0)
TORQUE: Reading = (1, -1, 0)
POSITION: Reading = (-1, 1, 0)


@dataclass(frozen=True)
class Motion:
    """Positions, velocities, accelerations, torques and filtered directions of motion at some instants, (N, n) each.

    Attributes:
        linear: (n,) joints whose position is in m. inertia: (n,) kg m2 or kg of the motors, link side.
        noise: (n,) of the torques, N m or N.
    """

    q: np.ndarray
    v: np.ndarray
    a: np.ndarray
    tau: np.ndarray
    turns: np.ndarray
    structure: Structure
    linear: np.ndarray
    inertia: np.ndarray
    noise: np.ndarray

    def telling(self) -> np.ndarray:
        """(n,) joints whose torque can tell whether it fits.

        A joint that is held while others move needs the difference of what they do to it and of what it yields, and
        the spring and damper by which its controller holds it take up most: what they leave is the error of a
        description, or noise.
        """
        whole = self.needed(self.q, self.v, self.a)
        itself = self.of_itself()
        parts = np.maximum(itself.std(axis=0), (whole - itself).std(axis=0))
        n = self.q.shape[1]
        left = np.array([np.std(without(self.own(j, spring=True), whole[:, j])) for j in range(n)])
        return np.asarray(left > np.maximum(LEFT * parts, OVER * self.noise))

    def of_itself(self) -> np.ndarray:
        """(N, n) torque that each joint needs for its own acceleration."""
        still = np.zeros_like(self.q)
        held = self.needed(self.q, still, still)
        alone = [self.needed(self.q, still, self.a * unit)[:, j] for j, unit in enumerate(np.eye(self.q.shape[1]))]
        return np.stack(alone, axis=1) - held

    def needed(self, q: np.ndarray, v: np.ndarray, a: np.ndarray) -> np.ndarray:
        """(N, n) torque that bodies, gravity and motors need."""
        model, driven = self.structure.model, self.structure.driven
        full = np.zeros((3, len(q), model.nv))
        for k, x in enumerate((q, v, a)):
            full[k][:, driven] = x
        return newton_euler(chain_of(model), *full)[:, driven] + a * self.inertia

    def own(self, j: int, spring: bool = False) -> np.ndarray:
        """(N, k) friction and offset of a joint, and a spring at it."""
        columns = [self.v[:, j], self.turns[:, j], np.ones(len(self.v))]
        return np.stack([*columns, self.q[:, j]] if spring else columns, axis=1)


def without(columns: np.ndarray, x: np.ndarray) -> np.ndarray:
    """What the columns (N, k) leave of x (N,) or (N, m)."""
    Q = np.linalg.qr(columns / np.maximum(np.linalg.norm(columns, axis=0), 1e-300))[0]
    return x - Q @ (Q.T @ x)


def correlation(a: np.ndarray, b: np.ndarray) -> float:
    """Of two signals (N,) without a mean."""
    return float(a @ b / max(float(np.linalg.norm(a) * np.linalg.norm(b)), 1e-300))


def _agreement(m: Motion, readings: list[Reading]) -> np.ndarray:
    """(n,) correlation of torques needed and recorded, friction, offset and spring removed, as positions are read.

    Signs of torques do not count here.
    """
    sign = np.array([r[0] for r in readings])
    zero = np.array([r[2] for r in readings]) * np.pi / 2
    needed = m.needed(sign * m.q + zero, sign * m.v, sign * m.a)
    out = []
    for j in range(len(readings)):
        own = m.own(j, spring=True)
        out.append(correlation(without(own, needed[:, j]), without(own, m.tau[:, j])))
    return np.array(out)


def _left(agreement: np.ndarray, readings: list[Reading]) -> np.ndarray:
    """(n,) share of each torque that is unexplained: all of one that runs against what is needed."""
    c = agreement * np.array([r[1] for r in readings])
    return np.where(c > 0, 1.0 - c**2, 1.0)


def _others(m: Motion, readings: list[Reading], j: int) -> Iterator[tuple[Reading, np.ndarray]]:
    """Readings of joint j beside those of the others, with the share of each torque that is left."""
    turned = () if m.linear[j] else (1, 2, 3)
    for q, zero in ((1, 0), (-1, 0), *((1, k) for k in turned)):
        agreement = _agreement(m, [*readings[:j], (q, 1, zero), *readings[j + 1 :]])
        for tau in (1, -1) if zero == 0 else (1,):
            one = (q, tau, zero)
            yield one, _left(agreement, [*readings[:j], one, *readings[j + 1 :]])


def _search(m: Motion, start: Reading, left: np.ndarray) -> tuple[list[Reading], np.ndarray]:
    """Readings of all joints and the share of each torque that they leave, from ``start`` on joint after joint."""
    n = m.q.shape[1]
    readings = [start] * n
    for _ in range(n):
        found = [(x.sum(), j, one, x) for j in range(n) for one, x in _others(m, readings, j)]
        total, j, one, x = min(found, key=lambda f: f[0])
        if total > STEP * left.sum():
            break
        readings[j], left = one, x
    return readings, left


def other_readings(motion: Motion) -> dict[int, tuple[tuple[int, Reading], ...]]:
    """Joint read otherwise -> (joint, reading) of which any one explains the torques, where those recorded do not, signs first.

    Empty where the recorded readings explain them, or none does for sure. Of several joints that are read otherwise
    each has its own; one alone may stand for another joint: to turn the axis before and the axis after by half a turn
    is to mirror the one between.
    """
    m = motion_of(motion, slice(None, None, max(1, len(motion.q) // INSTANTS)))
    n = m.q.shape[1]
    uniform = {one: _left(_agreement(m, [one] * n), [one] * n) for one in (RECORDED, TORQUE, POSITION, MIRRORED)}
    recorded, start = uniform[RECORDED], min(uniform, key=lambda one: uniform[one].sum())
    ends = [_search(m, one, uniform[one]) for one in dict.fromkeys((RECORDED, start))]
    good = AS_GOOD * min(x.sum() for _, x in ends) + CLOSE
    # Of what explains torques alike the fewest faults are likeliest.
    readings, left = min(
        (end for end in ends if end[1].sum() <= good), key=lambda end: (n - end[0].count(RECORDED), end[1].sum())
    )
    tells = (left < TELLS) & motion.telling()
    if not np.any(tells) or recorded[tells].sum() < SURE * left[tells].sum():
        return {}
    most = AS_GOOD * left[tells].sum() + CLOSE
    changed = [j for j in range(n) if readings[j] != RECORDED]
    out = {}
    for j in changed:
        rest = [*readings[:j], RECORDED, *readings[j + 1 :]]
        joints = range(n) if changed == [j] else [j]
        ranked = sorted((x[tells].sum(), k, one) for k in joints for one, x in _others(m, rest, k))
        good = sorted(((k, one) for total, k, one in ranked if total <= most), key=lambda way: way[1][2] != 0)
        if all(one != RECORDED for _, one in good):
            whole = [(j, one) for one, x in uniform.items() if len(set(readings)) == 1 and x[tells].sum() <= most]
            out[j] = tuple(dict.fromkeys([*good, *whole]))
    return out


def other_zero(motion: Motion) -> tuple[int, float] | None:
    """The joint of which another zero explains the torques, which those recorded do not, and rad to add to its position.

    Friction, an offset and the inertia of the motor of each joint are left free; what is known of the bodies is not.
    """
    m = motion_of(motion, slice(None, None, max(1, len(motion.q) // FEW)))
    recorded = _unlike(m, 0, 0.0)
    if recorded.sum() < OF_WHOLE:
        return None
    found = {j: _best_zero(m, j) for j in range(m.q.shape[1]) if not m.linear[j]}
    left = {j: _unlike(m, j, added) for j, added in found.items()}
    if not found:
        return None
    best = min(left, key=lambda j: left[j].sum())
    tells = left[best] < TELLS
    rest = float(left[best][tells].sum())
    alone = all(left[j][tells].sum() > ONLY[1] * rest for j in left if j != best)
    sure = alone and abs(found[best]) > MOVED and rest < ONLY[0] * recorded[tells].sum()
    return (best, found[best]) if sure else None


def _best_zero(m: Motion, j: int) -> float:
    """What to add to the position of joint j, rad, for the least to be unexplained."""

    def unlike(added: float) -> float:
        return float(_unlike(m, j, added).sum())

    k = int(np.argmin([unlike(x) for x in ZEROS]))
    low, high = ZEROS[max(k - 1, 0)], ZEROS[min(k + 1, len(ZEROS) - 1)]
    for _ in range(CUTS):
        a, b = low + (high - low) / 3, high - (high - low) / 3
        low, high = (low, b) if unlike(a) < unlike(b) else (a, high)
    return float(low + high) / 2


def _unlike(m: Motion, j: int, added: float) -> np.ndarray:
    """(n,) share of each torque that is unexplained with so many rad added to the position of joint j."""
    q = m.q.copy()
    q[:, j] += added
    needed, out = m.needed(q, m.v, m.a), []
    for i in range(q.shape[1]):
        free = np.column_stack([m.own(i), m.a[:, i]])
        got = without(free, m.tau[:, i])
        out.append(np.sum((got - without(free, needed[:, i])) ** 2) / max(float(np.sum(got**2)), 1e-300))
    return np.array(out)


def motion_of(m: Motion, pick: slice) -> Motion:
    """A motion at some of its instants."""
    q, v, a, tau, turns = (x[pick] for x in (m.q, m.v, m.a, m.tau, m.turns))
    return Motion(q, v, a, tau, turns, m.structure, m.linear, m.inertia, m.noise)


def said_of(j: int, joints: tuple[str, ...], ways: tuple[tuple[int, Reading], ...], slope: float) -> str:
    """A sentence on what explains the torques; ``slope``: recorded over needed torque of joint ``j``."""
    first, reading = ways[0]
    q, tau = f"q_{j + 1}", f"tau_{j + 1}"
    if set(ways) <= {(j, TORQUE), (j, POSITION)} and (j, TORQUE) in ways and slope < 0:
        which = "" if len(ways) == 1 else f" of {tau}, or of {q}"
        return f"{tau} ({joints[j]}) runs against what bodies and motor need, {slope:.3g} times it: wrong sign{which}?"
    what = f"{'tau' if reading == TORQUE else 'q'}_{first + 1} ({joints[first]})"
    words = ", or with ".join(_words(*way) for way in ways)
    turned = [one[2] != 0 for _, one in ways]
    why = " or ".join(["wrong sign"] * (not all(turned)) + ["another zero"] * any(turned))
    return f"{what} does not fit what bodies and motors need, which the torques do with {words}: {why}?"


def _words(j: int, reading: Reading) -> str:
    q, tau = f"q_{j + 1}", f"tau_{j + 1}"
    signs = {TORQUE: f"{tau} reversed", POSITION: f"{q} reversed", MIRRORED: f"both {q} and {tau} reversed"}
    return signs.get(reading, f"{90 * reading[2]} degrees added to {q}")
