"""Units as logs spell them."""

from __future__ import annotations

import re

SPELLED = {
    "rad": "rad", "radian": "rad", "radians": "rad", "mrad": "mrad", "deg": "deg", "degree": "deg", "degrees": "deg",
    "度": "deg", "弧度": "rad", "°": "deg", "º": "deg", "grad": "deg", "rev": "rev", "turn": "rev", "turns": "rev",
    "rad/s": "rad/s", "rads^1": "rad/s", "rads^-1": "rad/s", "deg/s": "deg/s", "degs^-1": "deg/s", "°/s": "deg/s", "º/s": "deg/s",
    "rpm": "rpm", "1/min": "rpm", "min^-1": "rpm", "u/min": "rpm", "r/min": "rpm", "rev/min": "rpm",
    "nm": "N m", "newtonmeter": "N m", "newtonmeters": "N m", "mnm": "mN m", "knm": "kN m", "n": "N", "kn": "kN",
    "a": "A", "amp": "A", "amps": "A", "ampere": "A", "arms": "A", "ma": "mA", "v": "V", "volt": "V", "volts": "V",
    "m": "m", "mm": "mm", "µm": "um", "μm": "um", "um": "um", "m/s": "m/s", "ms^-1": "m/s", "mm/s": "mm/s",
    "s": "s", "sec": "s", "secs": "s", "second": "s", "seconds": "s", "ms": "ms", "msec": "ms", "µs": "us", "μs": "us", "us": "us",
    "usec": "us", "ns": "ns", "nsec": "ns", "°c": "degC", "ºc": "degC", "degc": "degC", "celsius": "degC",
}  # fmt: skip
BRACKET = re.compile(r"^(.*\S)[\s_.]*[\[({<]\s*([^\[\](){}<>]+?)\s*[\])}>]\s*$|^(.*\S)\s+/\s+(\S+)\s*$")
INDEX = re.compile(r"[A-Za-z_ ]*\d+$")
SHARES = dict.fromkeys(("%", "percent", "pct", "prozent"), 1e-2) | dict.fromkeys(
    ("‰", "permille", "permil", "promille", "1/1000", "01%"), 1e-3
)  # without blanks and points: "0.1 %"
MEGA = ("MNm", "MN")  # not milli


def unit_of(text: str) -> str | None:
    """The unit of a map that a text spells: "Nm", "N·m" and "N*m" are "N m"; None where it spells none."""
    bare = re.sub(r"[\s·⋅*]|(?<=[A-Za-z])[.](?=[A-Za-z])|(?<=[Nn])-(?=m)", "", text)
    return None if bare in MEGA else SPELLED.get(bare.lower())


def unread_unit(name: str) -> str | None:
    """What stands at the end of a name as units do, but is none of a map: "%" of "torque (%)"; a number, as in "q(1)"
    or "q [A1]", is that of a joint."""
    match = BRACKET.match(name)
    text = (match[2] or match[4]) if match else None
    return text if text and not unit_of(text) and not INDEX.match(text) else None


def share_of(name: str, unit: str | None) -> float | None:
    """0.01 or 0.001 where a unit, or a word in a name, says per cent or per mille; else None."""
    words = (unit or "", *re.split(r"[^A-Za-z%‰]+", name))
    return next((SHARES[key] for w in words if (key := re.sub(r"[\s_.,-]", "", w.lower())) in SHARES), None)


def split_unit(name: str) -> tuple[str, str | None]:
    """A name without the unit at its end, and the unit: "q1 [°]" gives "q1" and "deg"; "q(1)" has none."""
    match = BRACKET.match(name)
    if match is None:
        return name, None
    unit = unit_of(match[2] or match[4])
    return ((match[1] or match[3]).rstrip("_. "), unit) if unit else (name, None)
