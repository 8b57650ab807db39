"""Units, sides of the gear and signs of signals, guessed from their sizes.

The robot's limits and the motion itself say them: a position must fit between the limits, a velocity
must be the derivative of the position, and friction must take energy out.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from ident.convert.quantities import UNITS
from ident.convert.spelling import share_of
from robot_assets.robot import Robot

NAMED_UNITS = {
    "deg": "deg", "degree": "deg", "degrees": "deg", "grad": "deg", "rad": "rad", "radians": "rad", "mrad": "mrad", "rpm": "rpm", "mm": "mm",
    "nm": "N m", "mnm": "mN m", "knm": "kN m", "kn": "kN", "ma": "mA", "amp": "A", "amps": "A", "volt": "V", "voltage": "V",
    **dict.fromkeys(("ns", "nsec", "nsecs", "nanos", "nanosec", "nanosecs", "nanosecond", "nanoseconds"), "ns"),
    **dict.fromkeys(("us", "usec", "usecs", "micros", "microsec", "microsecond", "microseconds"), "us"),
    **dict.fromkeys(("ms", "msec", "msecs", "millis", "millisec", "millisecond", "milliseconds"), "ms"),
    **dict.fromkeys(("s", "sec", "secs", "second", "seconds"), "s"),
}  # fmt: skip
TURNS = {"rad": 2 * np.pi, "deg": 360.0, "mrad": 2e3 * np.pi, "rev": 1.0}  # a full turn, in the units that logs wrap in
NEAR = 0.25  # of a turn, between two samples: a joint that is faster hides where it wraps
REVERSALS, SAMPLES = 3, 500  # of a motion, below which neither friction nor sizes tell a sign or a side
HYSTERESIS = 0.05  # of the range of a motion, by which it must go back to be turning round
LOOKED_AT = 4000  # samples in which turns are counted
ANGLES, LENGTHS = ("deg", "rad", "mrad", "rev"), ("m", "mm", "um")
TORQUE_UNITS = ("N m", "mN m", "kN m", "N", "kN", "A", "mA", "V")
# Objects of CiA 402 in per mille of the rated torque or current: target, demand, actual.
RATED_OBJECTS = re.compile(r"(?i)(?<![0-9a-f])(0x60(71|74|77|78)(?![0-9a-f])|60(71|74|77|78)h)")
ELECTRIC = ("A", "mA", "V")
CURRENTS = ("current", "currents", "curr", "cur", "strom", "iq")


@dataclass(frozen=True)
class Family:
    """One quantity of all joints.

    Attributes:
        words: lower-case parts of its names.
        sources: (n,) signal of each joint and its column, None for a signal of one column.
        x: (N, n) values as they stand in the log.
        unit: that the log says, of a map; None where it says none.
        note: what is doubtful about it.
        unread: unit as the log writes it, which is none of a map; empty where there is none.
        wraps: whether the log has its angles within one turn; ``x`` then goes on over it.
    """

    name: str
    words: tuple[str, ...]
    sources: tuple[tuple[str, int | None], ...]
    x: np.ndarray
    unit: str | None = None
    note: str = ""
    wraps: bool = False
    unread: str = ""

    def has(self, vocabulary: Sequence[str]) -> bool:
        """Whether a word of its name is one of the vocabulary, or begins with one of more than two letters."""
        return any(w in vocabulary or any(len(v) > 2 and w.startswith(v) for v in vocabulary) for w in self.words)


@dataclass(frozen=True)
class Scale:
    """How a family becomes SI: ``factor`` (n,) and the options of the map that say so; ``signs`` (n,) of torques."""

    factor: np.ndarray
    options: tuple[str, ...]
    note: str
    signs: np.ndarray | None = None


def guess_scales(chosen: dict[str, Family], arm: Robot, linear: np.ndarray, rate: float | None) -> dict[str, Scale]:
    """Units, sides of the gear and signs of the channels, from their names and from the sizes of their samples.

    Args:
        chosen: columns of each channel.
        linear: (n,) whether a joint is prismatic.
        rate: samples per second, where it is known: velocities are compared with differences of positions.
    """
    out: dict[str, Scale] = {}
    velocity = None
    # A drive that reports torque before the gear mostly reports its position there too.
    before = (
        "tau" in chosen
        and not _raw(chosen["tau"], TORQUE_UNITS)
        and _before_gear(chosen["tau"], _torque_unit(chosen["tau"], linear), arm)
        and bool(np.mean(_turned(chosen.get("q"))) >= 0.5)
    )
    for channel in ("q", "q_ref", "q_link"):
        if channel in chosen:
            out[channel] = _position(chosen[channel], arm, linear, rate, before and channel != "q_link")
    if "q" in chosen:
        velocity = np.gradient(chosen["q"].x * out["q"].factor, 1.0 / (rate or 1000.0), axis=0)
    if "qd" in chosen:
        out["qd"] = _velocity(chosen["qd"], velocity, arm, linear)
    if "tau" in chosen:
        out["tau"] = _torque(chosen["tau"], chosen.get("q"), out.get("q"), arm, linear, rate or 1000.0)
    if "temp" in chosen:
        out["temp"] = Scale(np.ones(arm.n), ('unit = "degC"',), _unread(chosen["temp"]))
    return out


def _before_gear(torque: Family, unit: str, arm: Robot) -> bool:
    """Whether torques are of the size that a motor has before its gear.

    Between three hundredths of the limit and a little more than it is where torques of a log lie.
    """
    ratio, share = (
        np.abs(arm.array("gear_ratio")),
        np.abs(torque.x * UNITS[unit]).max(axis=0) / arm.array("torque_limit"),
    )
    return bool(np.any(ratio > 3) and np.median(share) < 0.1 and 0.03 < np.median(share * ratio) < 3.0)


def _turned(position: Family | None) -> np.ndarray:
    """(n,) whether a motion turns round often enough to tell of its torque: one that goes one way shows friction as
    gravity."""
    if position is None or len(position.x) < SAMPLES:
        return np.zeros(1 if position is None else position.x.shape[1], bool)
    x = position.x[:: max(1, len(position.x) // LOOKED_AT)]
    return np.array([_reversals(column) >= REVERSALS for column in x.T])


def _reversals(x: np.ndarray) -> int:
    """How often a position (N,) turns round, by more than its noise."""
    size = HYSTERESIS * float(np.ptp(x))
    low = high = float(x[0])
    turns, up = 0, None
    for v in x.tolist() if size > 0 else ():
        low, high = min(low, v), max(high, v)
        if up is not False and v < high - size:
            turns, up, low = turns + (up is True), False, v
        elif up is not True and v > low + size:
            turns, up, high = turns + (up is False), True, v
    return turns


def _unit_of(family: Family, allowed: Sequence[str]) -> str | None:
    if family.unit in allowed:
        return family.unit
    return next((NAMED_UNITS[w] for w in family.words if NAMED_UNITS.get(w) in allowed), None)


def unwrapped(family: Family) -> Family:
    """Angles that jump by a full turn, going on over it; as they are where they do not, or where they jump otherwise
    too."""
    named = _unit_of(family, tuple(TURNS))
    for unit in (named,) if named else TURNS:
        turn, size = TURNS[unit], np.abs(np.diff(family.x, axis=0))
        jumps = np.abs(size - turn) < NEAR * turn
        within = np.ptp(family.x, axis=0) < 1.02 * turn
        if np.any(jumps) and np.all(within | ~np.any(jumps, axis=0)) and np.all(jumps | (size < NEAR * turn)):
            return replace(family, x=np.unwrap(family.x, period=turn, axis=0), unit=unit, wraps=True)
    return family


def _position(family: Family, arm: Robot, linear: np.ndarray, rate: float | None, before: bool) -> Scale:
    """The first unit and side with which the motion fits the limits of place and speed."""
    found = _fitting(family, arm, linear, rate, before)
    doubt = _unread(family)
    if not doubt and _raw(family, LENGTHS if np.all(linear) else ANGLES):
        meter, turn = ("m", "travel") if np.all(linear) else ("rad", "2 pi")
        doubt = (
            f'EDIT: whole numbers without a unit: counts? Then unit = "{meter}" and scale = {turn} / counts of a turn'
        )
    return replace(found, note="; ".join(note for note in (doubt, found.note) if note))


def _fitting(family: Family, arm: Robot, linear: np.ndarray, rate: float | None, before: bool) -> Scale:
    meter = "m" if np.all(linear) else "rad"
    if np.all(linear):
        named, choices = _unit_of(family, LENGTHS), [("m", "link"), ("mm", "link"), ("um", "link")]
    else:
        named = _unit_of(family, ANGLES)
        choices = [("rad", "link"), ("deg", "link"), ("rad", "motor"), ("deg", "motor"), ("rev", "motor")]
        if before:
            choices[1], choices[2] = choices[2], choices[1]
    if named:
        choices = [c for c in choices if c[0] == named] or [(named, "link"), (named, "motor")]
    wraps = ("unwrap = true",) if family.wraps else ()
    room = np.maximum(np.abs(arm.q_min), np.abs(arm.q_max))
    travel = np.ptp(family.x, axis=0)
    speed = np.percentile(np.abs(np.diff(family.x, axis=0)), 99, axis=0) * (rate or 0.0)
    fitting = []
    for unit, side in choices:
        factor = UNITS[unit] / (arm.array("gear_ratio") if side == "motor" else np.ones(arm.n))
        size = np.abs(factor)
        fits = (travel * size <= 2.2 * room) & (speed * size <= 2.0 * arm.array("velocity_limit"))
        fits &= np.abs(family.x * size).max(axis=0) <= 2 * room + np.pi * ~linear
        if np.all(fits):
            fitting.append((unit, side, factor))
    if not fitting:
        unit, side = choices[0]
        note = f"EDIT: no unit fits the limits of the joints; as it stands {range_text(family.x)}"
        return Scale(np.full(arm.n, UNITS[unit]), _options(unit, side) + wraps, note)
    unit, side, factor = fitting[0]
    note = f"{unit} by the {'name' if named else 'range'}; {range_text(family.x * factor)} {meter}"
    # Small units always fit; only a neighbour of nearly the same size is a doubt.
    rival = next((c for c in fitting[1:] if np.median(np.abs(factor / c[2])) < 4.0), None)
    if rival is not None:
        note += f"; EDIT? {rival[0]} on the {rival[1]} side fits as well"
    if family.wraps:
        note += (
            "; wraps at a full turn: EDIT? by an offset, if it began in another one"
            if side == "motor"
            else "; wraps at a full turn"
        )
    return Scale(factor, _options(unit, side) + wraps, note)


def _velocity(family: Family, velocity: np.ndarray | None, arm: Robot, linear: np.ndarray) -> Scale:
    """The unit, side and sign that make it the derivative of the position."""
    choices: tuple[str, ...] = ("m/s", "mm/s") if np.all(linear) else ("rad/s", "deg/s", "rpm")
    named = _unit_of(family, choices)
    choices = (named,) if named else choices
    if velocity is not None:
        slope = np.sum(velocity * family.x, axis=0) / np.maximum(np.sum(family.x**2, axis=0), 1e-300)
        moving = np.std(velocity, axis=0) > 1e-9
        for unit in choices:
            for side in ("link", "motor"):
                for sign in (1, -1):
                    factor = sign * UNITS[unit] / (arm.array("gear_ratio") if side == "motor" else np.ones(arm.n))
                    if np.any(moving) and np.all(np.abs(slope / factor - 1)[moving] < 0.15):
                        return Scale(factor, _options(unit, side, sign), "the derivative of q says so")
    doubt = "; ".join(
        note for note in (_unread(family), "EDIT: this is not the derivative of q in any usual unit") if note
    )
    return Scale(np.ones(arm.n), _options(choices[0], "link"), doubt)


def _unread(family: Family) -> str:
    """A note that quotes a unit which is none of a map; empty where there is none."""
    return f'EDIT: the unit "{family.unread[:40]}" of the log is not understood' if family.unread else ""


def _raw(family: Family, allowed: Sequence[str]) -> bool:
    """Whether a family may be raw numbers of a drive: whole ones without a unit, a share, or of a unit that is none of
    a map."""
    if _unit_of(family, allowed) is not None:
        return False
    return bool(family.unread or _share(family) is not None or np.all(family.x == np.round(family.x)))


def _share(family: Family) -> float | None:
    """Of the rated value, in which a family is given: by its unit, its name, or the object of a drive; else None."""
    return share_of(family.name, family.unread) or (1e-3 if RATED_OBJECTS.search(family.name) else None)


def _raw_torque(family: Family, unit: str) -> tuple[tuple[str, ...], str]:
    """Options and note of a torque, or a current, that is raw numbers of a drive."""
    share, what = _share(family), "current" if unit in ELECTRIC else "torque"
    if share is not None:
        each = "per cent" if share > 5e-3 else "per mille"
        quoted = f' ("{family.unread[:40]}")' if family.unread else ""
        note = f'EDIT: {each} of the rated {what}{quoted}, which the log does not tell: scale = {share:g} times it in {unit}; side = "motor" if it is that of the motor'
        return (f"scale = {share:g}",), note
    return (), _unread(family) or f"EDIT: whole numbers without a unit: raw ones of a drive? Scale gives {unit} of one"


def _torque_unit(family: Family, linear: np.ndarray) -> str:
    unit = _unit_of(family, TORQUE_UNITS)
    return unit or ("A" if family.has(CURRENTS) else "N" if np.all(linear) else "N m")


def _torque(
    family: Family, position: Family | None, scale: Scale | None, arm: Robot, linear: np.ndarray, rate: float
) -> Scale:
    unit, side = _torque_unit(family, linear), "link"
    factor = np.full(arm.n, UNITS[unit])
    share = float(np.median(np.abs(family.x * factor).max(axis=0) / arm.array("torque_limit")))
    options, notes = [], [range_text(family.x)]
    raw = _raw(family, TORQUE_UNITS)
    if raw:
        more, note = _raw_torque(family, unit)
        options, notes = [*more], [note, *notes]
    if unit in ELECTRIC:
        options.append("torque_constant = 1.0")
        notes.append(
            f"EDIT: the torque constant, the side that it is for, or the unit if this is a {'force' if np.all(linear) else 'torque'} after all"
        )
    turned = np.broadcast_to(_turned(position), arm.n)
    before = not raw and _before_gear(family, unit, arm)
    if before and np.mean(turned) < 0.5:
        notes.append(
            f'EDIT: {share:.2g} of the torque limit: before the gear (side = "motor")? The motion turns round too seldom to tell'
        )
    elif before:
        side, factor = "motor", factor * arm.array("gear_ratio")
        notes.append(f"EDIT? {share:.2g} of the torque limit: before the gear by its size")
    elif share > 3.0 and unit not in ELECTRIC and not raw:
        notes.append(f"EDIT: {share:.3g} times the torque limit")
    elif share < 0.03 and unit not in ELECTRIC and not raw:
        notes.append(f"EDIT? only {share:.2g} of the torque limit: is the unit right?")
    signs = np.ones(arm.n)
    if position is not None and scale is not None:
        signs = _friction_sign(position.x * scale.factor, family.x * factor, rate, turned)
        if not np.all(turned):
            which = (
                "all joints"
                if not np.any(turned)
                else "joints " + ", ".join(str(j + 1) for j in np.flatnonzero(~turned))
            )
            notes.append(f"EDIT? signs as they stand: {which} turn round too seldom for friction to tell")
    options = [*_options(unit, side), *options]
    if np.any(signs < 0):
        options.append("sign = -1")
        notes.append(
            "sign by friction, which must brake: joints " + ", ".join(str(j + 1) for j in np.flatnonzero(signs < 0))
        )
    return Scale(factor * signs, tuple(options), "; ".join(notes), signs)


def _friction_sign(q: np.ndarray, tau: np.ndarray, rate: float, turned: np.ndarray) -> np.ndarray:
    """(n,) -1 where friction would feed energy in, in both halves of the log: the sign of a torque is then wrong."""
    out = np.ones(q.shape[1])
    half = len(q) // 2
    for j in np.flatnonzero(turned):
        if all(_feeds(q[part, j], tau[part, j], rate) for part in (slice(None), slice(None, half), slice(half, None))):
            out[j] = -1.0
    return out


def _feeds(q: np.ndarray, tau: np.ndarray, rate: float) -> bool:
    """Whether friction that is fitted to a torque (N,) has the wrong sign, and is no small part of it."""
    v = np.gradient(q, 1 / rate)
    if np.std(v) < 1e-9:
        return False
    a = np.gradient(v, 1 / rate)
    slow = 0.1 * np.abs(v).max() + 1e-12
    step = max(1, len(q) // 20000)
    A = np.stack([np.tanh(v / slow), a, np.ones_like(v), q, np.sin(q), np.cos(q)], axis=1)[::step]
    A = A / np.maximum(np.linalg.norm(A, axis=0), 1e-300)
    y = tau[::step]
    x, *_ = np.linalg.lstsq(A, y, rcond=1e-9)
    # Friction as a share of what the other columns leave: too small a share decides nothing.
    rest = y - A[:, 1:] @ x[1:]
    return bool(x[0] < 0 and np.linalg.norm(x[0] * A[:, 0]) > 0.5 * np.linalg.norm(rest))


def _options(unit: str, side: str, sign: int = 1) -> tuple[str, ...]:
    out = [f'unit = "{unit}"']
    if side == "motor":
        out.append('side = "motor"')
    if sign < 0:
        out.append("sign = -1")
    return tuple(out)


def range_text(x: np.ndarray) -> str:
    """Least and greatest sample, for a comment in a map."""
    return f"{x.min():.3g} to {x.max():.3g}"
