"""What the names of signals say: which quantity, which joint, which role, which unit."""

from __future__ import annotations

import re
from collections.abc import Mapping
from types import MappingProxyType

import numpy as np

from ident.convert.guess_order import Names, called, columns_by_names
from ident.convert.guess_units import Family
from ident.convert.spelling import split_unit, unread_unit
from robot_assets.robot import Robot

CHANNELS = ("tau", "q", "qd", "q_ref", "q_link", "temp")
# Words in names, and how surely each tells. One letter tells little.
WORDS: dict[str, dict[str, float]] = {
    "torque": dict.fromkeys(("tau", "torque", "torques", "trq", "effort", "efforts", "moment", "force", "current", "currents", "curr", "iq", "drehmoment", "strom", "kraft"), 3.0)
    | dict.fromkeys(("cur", "voltage", "volt"), 2.0)
    | dict.fromkeys(("u", "i", "f", "m"), 0.5),
    "velocity": dict.fromkeys(("dq", "qd", "qdot", "qp", "vel", "velocity", "velocities", "omega", "speed", "rpm", "geschwindigkeit"), 3.0)
    | dict.fromkeys(("v", "w"), 0.5),
    "position": dict.fromkeys(("pos", "position", "positions", "theta", "phi", "angle", "angles", "encoder", "enc", "qm", "winkel", "weg"), 3.0)
    | {"q": 2.5, "x": 0.5, "ql": 2.5, "qg": 2.5},
    "temperature": dict.fromkeys(("temp", "temperature", "temperatur"), 3.0),
}  # fmt: skip
REFERENCE = ("ref", "cmd", "des", "desired", "command", "target", "setpoint", "goal", "soll", "qg")
LINK = ("link", "load", "se", "secondary", "output", "arm", "abtrieb", "ql", "external")
MOTOR = ("motor", "mot", "qm")
ACTUAL = ("act", "actual", "meas", "measured", "ist", "rec", "state", "states", "read")
DERIVED = (
    "err",
    "error",
    "ff",
    "feedforward",
    "acc",
    "acceleration",
    "ddq",
    "qdd",
    "model",
    "est",
    "sim",
    "init",
    "limit",
    "residual",
    "std",
)
# What a unit says; a length may as well be of a tool as of a linear drive, and needs a name beside it.
QUANTITIES = (
    dict.fromkeys(("N m", "mN m", "kN m", "N", "kN", "A", "mA", "V"), "torque")
    | dict.fromkeys(("rad", "deg", "mrad", "rev", "m", "mm", "um"), "position")
    | dict.fromkeys(("rad/s", "deg/s", "rpm", "m/s", "mm/s"), "velocity")
    | {"degC": "temperature"}
)
LENGTHS = ("m", "mm", "um")
PREFIXED = ("mNm", "kNm", "mN", "kN", "mA")  # units that a capital does not part
# Names of KUKA's Robot Sensor Interface.
CALLED = {
    "aipos": ("act", "pos"),
    "aspos": ("soll", "pos"),
    "eipos": ("external", "pos"),
    "macur": ("act", "cur"),
    "mecur": ("external", "cur"),
}
TOLD = 3.0  # as surely as a name at its best


def oriented(x: np.ndarray) -> np.ndarray:
    """(N, k) with time first."""
    if x.ndim < 2:
        return x.reshape(-1, 1)
    return x if x.shape[0] >= x.shape[1] else x.T


def words_of(name: str) -> tuple[str, ...]:
    """Parts of a name: "rec.actPos_mot1" gives rec, act, pos, mot; "Istposition" gives ist, position."""
    words: list[str] = []
    for word in re.findall(r"[A-Za-zµ]+", name):
        words += [word] if word in PREFIXED else re.sub(r"([a-z0-9])([A-Z])", r"\1 \2", word).split()
    return tuple(part for w in words for part in _split(w.lower()))


def _split(word: str) -> tuple[str, ...]:
    """A word, or the two that it is put together of: a role and a quantity."""
    if word in CALLED:
        return CALLED[word]
    quantities = [q for table in WORDS.values() for q in table if len(q) > 2]
    for role in (*REFERENCE, *LINK, *MOTOR, *ACTUAL):
        rest = word.removeprefix(role)
        if len(role) > 2 and rest != word and any(rest.startswith(q) for q in quantities):
            return role, rest
    return (word,)


def families_of(
    signals: dict[str, np.ndarray],
    units: dict[str, str],
    arm: Robot,
    lists: Names = MappingProxyType({}),
    unread: Mapping[str, str] = MappingProxyType({}),
) -> list[Family]:
    """Arrays of a column a joint, single columns numbered or named by joint, and what is left alone.

    Args:
        units: name -> unit, of those for which the log says it apart from the name.
        lists: lists of strings in the log, which may name the columns of its arrays.
        unread: name -> unit as the log writes it, of those that are none of a map.
    """
    n, out, single = arm.n, [], {}
    stems, own = {}, dict(units)

    def strange(*names: str) -> str:
        rows = " or ".join(dict.fromkeys(unread[k] for k in names if k in unread))
        # Where it sets the columns of a quantity apart it is no unit.
        told = {"" if k in own else _strange(k, arm) for k in names}
        return rows or (told.pop() if len(told) == 1 else "")

    for name, x in signals.items():
        stems[name], unit = split_unit(name)
        if unit is not None:
            own.setdefault(name, unit)
        x = oriented(x)
        if x.shape[1] == 1:
            single[name] = x[:, 0]
        elif x.shape[1] >= n:
            columns, note = columns_by_names(name, x.shape[1], lists, arm.joint_names)
            sources = tuple((name, k) for k in columns)
            out.append(
                Family(
                    name, words_of(stems[name]), sources, x[:, list(columns)], own.get(name), note, unread=strange(name)
                )
            )

    def alone(name: str) -> Family:
        words, source = words_of(stems[name]), ((name, None),)
        return Family(name, words, source, single[name][:, None], own.get(name), unread=strange(name))

    if n == 1:
        return out + [alone(k) for k in single]
    sets: dict[tuple[str, str | None], dict[int, str]] = {}
    for name in single:
        stem, unit = stems[name], own.get(name)
        for joint, name_of in called(arm.joint_names):
            if name_of in stem:
                sets.setdefault((stem.replace(name_of, "{}", 1), unit), {})[arm.joint_names.index(joint)] = name
                break
        for m in re.finditer(r"\d+", stem):
            sets.setdefault((stem[: m.start()] + "{#}" + stem[m.end() :], unit), {})[int(m[0])] = name
    used: set[str] = set()

    def joined(name: str, words: tuple[str, ...], members: list[str], note: str = "") -> None:
        used.update(members)
        columns = np.stack([single[k] for k in members], axis=1)
        out.append(
            Family(
                name,
                words,
                tuple((k, None) for k in members),
                columns,
                own.get(members[0]),
                note,
                unread=strange(*members),
            )
        )

    for (stem, _), members in sets.items():
        first = 0 if 0 in members or "{#}" not in stem else 1
        names = [members[first + j] for j in range(n) if first + j in members]
        if len(names) == n and not used & set(names):
            joined(stem.replace("{#}", "#").replace("{}", "JOINT"), words_of(stem), names)
    for names in _alike([k for k in single if k not in used], stems, own, n):
        if used & set(names):
            continue
        own_words = [words_of(stems[k]) for k in names]
        words = tuple(w for w in own_words[0] if all(w in other for other in own_words))
        words = words or tuple(dict.fromkeys(w for other in own_words for w in other))
        joined(f"{names[0]} .. {names[-1]}", words, names, "EDIT? joints in the order of the columns")
    return out + [alone(k) for k in single if k not in used]


def _strange(name: str, arm: Robot) -> str:
    """What stands in the place of a unit in a name, is none of a map and says nothing else; empty where there is none."""
    text = unread_unit(name) or ""
    vocabulary = {w for table in WORDS.values() for w in table} | {*REFERENCE, *LINK, *MOTOR, *ACTUAL, *DERIVED}
    told = {text.lower(), *words_of(text)} & (vocabulary | {short.lower() for _, short in called(arm.joint_names)})
    return "" if told else text


def _alike(names: list[str], stems: dict[str, str], units: dict[str, str], n: int) -> list[list[str]]:
    """Columns of one quantity, role and unit that are as many as joints, whatever sets their names apart."""
    groups: dict[tuple, list[str]] = {}
    for name in names:
        words = words_of(stems[name])
        fit = _fit(words, units.get(name))
        kind = max(fit, key=lambda k: fit[k])
        if fit[kind] > 1.0:
            family = Family("", words, (), np.empty((0, 0)))
            roles = tuple(family.has(role) for role in (REFERENCE, LINK, MOTOR, ACTUAL, DERIVED))
            # What sets names apart may look like a role: that of an arm.
            groups.setdefault((kind, units.get(name)), []).append(name)
            groups.setdefault((kind, units.get(name), roles), []).append(name)
    return [group for group in groups.values() if len(group) == n]


def _fit(words: tuple[str, ...], unit: str | None) -> dict[str, float]:
    """Quantity -> how surely words and unit tell of it."""
    fit = {
        k: max(
            (v for w in words for word, v in table.items() if w == word or (len(word) > 3 and w.startswith(word))),
            default=0.0,
        )
        for k, table in WORDS.items()
    }
    kind = QUANTITIES.get(unit or "")
    if kind is not None and (fit[kind] > 0 or unit not in LENGTHS):
        fit[kind] += TOLD
    return fit


def score(words: tuple[str, ...], channel: str, unit: str | None = None) -> float:
    """How well a name and its unit fit a channel; at most 0 where they do not."""
    kind = {"tau": "torque", "qd": "velocity", "temp": "temperature"}.get(channel, "position")
    fit = _fit(words, unit)
    sure = fit[kind]
    if sure <= 0 or any(fit[k] > sure for k in fit):
        return 0.0
    family = Family("", words, (), np.empty((0, 0)))
    reference, link = family.has(REFERENCE), family.has(LINK)
    if channel == "q_ref":
        return sure if reference and not family.has(DERIVED) else 0.0
    if channel == "q_link":
        return sure if link and not reference and not family.has(DERIVED) else 0.0
    sure += family.has(ACTUAL) + 0.5 * family.has(MOTOR)
    sure -= 2.0 * reference + 2.4 * family.has(DERIVED) + (channel in ("q", "qd")) * 1.5 * link
    return sure


def choose(families: list[Family], arm: Robot) -> tuple[dict[str, Family], dict[str, list[Family]]]:
    """The best family of each channel, and what else might be meant."""
    moving = [f for f in families if np.all(np.isfinite(f.x)) and np.any(np.ptp(f.x, axis=0) > 0)]
    chosen: dict[str, Family] = {}
    others: dict[str, list[Family]] = {}
    taken: set[str] = set()
    for channel in CHANNELS:
        ranked = sorted(
            (f for f in moving if f.name not in taken and score(f.words, channel, f.unit) > 0),
            key=lambda f: -score(f.words, channel, f.unit),
        )
        if ranked:
            chosen[channel] = ranked[0]
            others[channel] = ranked[1:5]
            taken.add(ranked[0].name)
    left = [f for f in moving if f.name not in taken]
    if "tau" not in chosen and "q" in chosen and len(left) == 1:
        # A log for identification has a torque: it is the one that is left.
        chosen["tau"], others["tau"] = left[0], []
    return chosen, others
