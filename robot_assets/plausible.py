"""What a URDF says that is sound, and yet hardly so of an arm: units of CAD programs, degrees, texts for numbers."""

from __future__ import annotations

import xml.etree.ElementTree as ET

import numpy as np

from robot_assets.urdf import BOUNDLESS, MOMENTS, principal

FARTHEST = 10.0  # m: a centre of mass or a joint, from the frame it is given in
WIDEST = 3.0  # m: radius of gyration of a link
TURNS = 4 * np.pi  # rad: limit of a turning joint
EXCESS = 0.02  # of the largest moment, by which it may exceed the other two together: rounding in a file
SLIGHT = 1e-5  # kg m2, the same: placeholders of links that weigh nothing


def doubts(root: ET.Element) -> tuple[str, ...]:
    """A sentence for each figure of a URDF that ``read_urdf`` has passed and a person should look at."""
    out = []
    for link in root.findall("link"):
        out += _of_link(link, f"link {link.get('name')}")
    for joint in root.findall("joint"):
        out += _of_joint(joint, f"joint {joint.get('name')}")
    return tuple(out)


def _of_link(link: ET.Element, name: str) -> list[str]:
    inertial = link.find("inertial")
    if inertial is None:
        return []
    mass, tensor = inertial.find("mass"), inertial.find("inertia")
    m = 0.0 if mass is None else float(mass.get("value", 0))
    moments = [float("0" if tensor is None else tensor.get(k, "0")) for k in MOMENTS]
    largest = max(moments[:3])
    out = [] if (far := _far(inertial)) is None else [f"the centre of mass of {name} is {far:.3g} m off: in mm?"]
    if m > 0 and np.sqrt(largest / m) > WIDEST:
        out.append(
            f"the inertia of {name} is {largest:.3g} kg m2 at {m:.3g} kg, as of a body of {np.sqrt(largest / m):.3g} m: in kg mm2 or g mm2?"
        )
    elif m == 0 and largest > 1.0:
        out.append(f"the inertia of {name} is {largest:.3g} kg m2 without a mass")
    a, b, c = principal(moments)
    if c - a - b > max(EXCESS * c, SLIGHT):
        out.append(
            f"{name} has moments of inertia of {a:.3g}, {b:.3g} and {c:.3g} kg m2: of a body the largest is no more than the others together"
        )
    return out


def _of_joint(joint: ET.Element, name: str) -> list[str]:
    out = [] if (far := _far(joint)) is None else [f"{name} is {far:.3g} m off its link: in mm?"]
    limit = joint.find("limit")
    if joint.get("type") == "revolute":
        ends = [] if limit is None else [float(limit.get(k, "0")) for k in ("lower", "upper")]
        unsaid = limit is not None and not {"lower", "upper"} <= set(limit.keys())
        if not ends or unsaid or not any(ends) or min(map(abs, ends)) > BOUNDLESS:
            out.append(f"{name} has no limits in the URDF: a turn is taken")
        elif max(map(abs, ends)) > BOUNDLESS:
            out.append(f"{name} has a limit to one side alone in the URDF: a turn or more is taken")
        elif max(map(abs, ends)) > TURNS:
            out.append(f"the limits of {name} are {ends[0]:g} to {ends[1]:g} rad: in degrees?")
    for key in ("effort", "velocity"):
        word = None if limit is None else limit.get(key)
        if word is not None and not _number(word):
            out.append(f"{key} of {name} is {word!r}, which is no limit: one is guessed")
    return out


def _far(element: ET.Element) -> float | None:
    """Distance of an origin, m, where it is beyond an arm."""
    origin = element.find("origin")
    words = "0 0 0" if origin is None else origin.get("xyz", "0 0 0")
    far = float(np.linalg.norm([float(w) for w in words.split()]))
    return far if far > FARTHEST else None


def _number(word: str) -> bool:
    """Whether a word is a number that a limit may be, or zero, which says that there is none."""
    try:
        return 0 <= float(word) < np.inf
    except ValueError:
        return False
