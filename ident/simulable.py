"""What of a verdict's causes the exported MJCF cannot simulate: MuJoCo has no element for some, or for a part of some."""

from __future__ import annotations

from collections.abc import Sequence

from ident.evidence import ABSENT
from ident.verdict import Cause

WITHOUT_ELEMENT = frozenset(
    {
        "load_dependent_friction",
        "friction_drift",
        "transmission_error",
        "encoder_eccentricity",
        "encoder_quantization",
        "sensor_lag",
    }
)
MOST_ROUNDED = 2.0  # exponent of a presliding friction below which it is the bristle that MuJoCo has, and damps
SHARP_KNEE = 0.02  # of a saturation that bends, which as a sharp one is 1.4 % off at its limit
PARTS = {
    ("backlash", "loose"): "that the damper of {joint} is loose within its backlash too",
    ("torque_saturation", "knee"): "that the torque of {joint} bends before it reaches its limit",
    ("stribeck_friction", "lead"): "that the friction of {joint} turns before its velocity does",
    ("presliding_friction", "relaxation"): "the damping of what yields in the friction of {joint}",
    ("coulomb_friction", "relaxation"): "the damping of what yields in the friction of {joint}",
}
"""What is lost of an effect by a parameter that it may have."""


def not_simulated(cause: Cause) -> str:
    """What of a cause model.xml does not simulate, in words; empty where it simulates all."""
    if cause.effect in WITHOUT_ELEMENT:
        return f"{cause.effect.replace('_', ' ')} at {cause.joint}"
    lost = [
        text.format(joint=cause.joint)
        for (effect, name), text in PARTS.items()
        if effect == cause.effect and name in cause.parameters and _matters(cause, name)
    ]
    return " and ".join(lost)


def not_simulated_note(causes: Sequence[Cause]) -> tuple[str, ...]:
    """What model.xml does not simulate of what was found, in a sentence; nothing where it simulates all."""
    lost = [text for text in map(not_simulated, causes) if text]
    return (f"model.xml cannot simulate: {'; '.join(lost)}. MuJoCo has no element for that.",) if lost else ()


def is_sum_of_slips(cause: Cause) -> bool:
    """Whether a friction that yields is more than one bristle, so that springs that yield stand for it."""
    p = cause.parameters
    return "spread" in p or ("exponent" in p and p["exponent"].value >= MOST_ROUNDED)


def _matters(cause: Cause, name: str) -> bool:
    """Whether a parameter that MuJoCo has no place for makes a difference."""
    x = cause.parameters[name]
    if name == "knee":
        return x.value > SHARP_KNEE
    if name == "relaxation" and not is_sum_of_slips(cause):
        return False
    return abs(x.value) > ABSENT * x.std
