"""What a fit found, in the words and units of verdict.json: parameters with their standard deviations."""

from __future__ import annotations

import numpy as np

from ident.baseline import UNDETERMINED
from ident.chain import INERTIAL, Structure
from ident.evidence import ABSENT
from ident.hypotheses import Hypothesis
from ident.hypotheses.ripple import SECOND
from ident.model import Effect
from ident.rigid import RigidFit
from ident.torque_fit import Fit
from ident.units import linear_names, parameter_unit, unit_at
from ident.verdict import Value

AXIS_STEP = 1e-6  # of a tilt
HARMONIC = frozenset(q.name for q in SECOND)


def named_effects(final: Fit) -> tuple[Effect, ...]:
    """The effects of a model that are causes, and no part of its baseline."""
    return tuple(e for e in final.model.effects if not e.hypothesis.options.get("baseline"))


def baseline_values(result: Fit) -> tuple[dict[str, Value], tuple[str, ...]]:
    """Baseline parameters with standard deviations, and those the data do not determine."""
    m = len(result.model.par.to_log())
    x = np.exp(result.model.par.to_log())
    std = np.sqrt(np.maximum(np.diag(result.covariance())[:m], 0.0))
    names = result.names[:m]
    linear = linear_names(result.model.structure.robot)
    values = {
        n: Value(float(v), float(v * s), parameter_unit(n, linear)) for n, v, s in zip(names, x, std, strict=True)
    }
    return values, tuple(n for n, s in zip(names, std, strict=True) if not s < UNDETERMINED)


def extended_baseline(final: Fit, covariance: np.ndarray) -> dict[str, Value]:
    """What the baseline holds beyond the drives: offsets of the torque records, friction of links; each of one
    parameter."""
    return {
        f"{e.hypothesis.options['baseline']}.{e.hypothesis.place}": value
        for e in final.model.effects
        if e.hypothesis.options.get("baseline")
        for value in reported_parameters(e, final, covariance).values()
    }


def inertia_values(rigid: RigidFit) -> dict[str, Value]:
    """Mass, first moment and inertia about the joint of every body, with standard deviations."""
    out = {}
    for body, std in zip(rigid.bodies, rigid.std, strict=True):
        model = rigid.structure.model
        p = model.inertias[rigid.structure.carriers[body]].toDynamicParameters()
        for kind, v, s in zip(INERTIAL, p, std, strict=True):
            name = f"{kind}.{body}"
            out[name] = Value(float(v), float(s), parameter_unit(name))
    return out


def reported_parameters(effect: Effect, final: Fit, covariance: np.ndarray) -> dict[str, Value]:
    """Parameters under their catalogue names, SI, with standard deviations."""
    h = effect.hypothesis
    index = {name: i for i, name in enumerate(final.names)}
    linear = at_linear_joint(effect, final.model.structure)
    out: dict[str, Value] = {}
    std, found = {}, set()
    for q, v in zip(h.parameters, effect.p, strict=True):
        i = index[h.coordinate(q.name)]
        s = float(np.sqrt(max(covariance[i, i], 0.0)))
        std[q.name] = s * abs(v) if q.log else s
        if q.null is not None and not q.at_start and abs(v - q.null) > ABSENT * std[q.name]:
            found.add(q.name)
    if found & HARMONIC:  # neither part of it says anything without the other
        found |= HARMONIC
    for q, v in zip(h.parameters, effect.p, strict=True):
        if q.reported or not q.nuisance or q.name in found:
            out[q.name] = Value(float(v), std[q.name], unit_at(q.unit, linear))
    if "sine" in out:
        a, b = out.pop("sine"), out.pop("cosine")
        amplitude = float(np.hypot(a.value, b.value))
        sigma = float(np.hypot(a.std, b.std) / np.sqrt(2))
        phase = float(np.arctan2(b.value, a.value))
        out = {
            "amplitude": Value(amplitude, sigma, a.unit),
            **out,
            "phase": Value(phase, sigma / max(amplitude, 1e-300), "rad"),
        }
    if h.effect in ("transverse_elasticity", "base_elasticity"):
        axis = h.options["axis"](effect.p)
        spread = axis_std(h, effect.p, np.array([std[q.name] for q in h.parameters]))
        out = {name: value for name, value in out.items() if not name.startswith("tilt_")}
        out |= {f"axis_{n}": Value(float(a), float(s), "1") for n, a, s in zip("xyz", axis, spread, strict=True)}
        if h.options["before"]:
            out["before"] = Value(1.0, 0.0, "1")
    return out


def axis_std(h: Hypothesis, p: np.ndarray, std: np.ndarray) -> np.ndarray:
    """(3,) standard deviations of an elastic axis, to first order in those of its tilts."""
    axis, out = h.options["axis"], np.zeros(3)
    for i in range(2, len(p)):
        moved = p.copy()
        moved[i] += AXIS_STEP
        out += ((axis(moved) - axis(p)) / AXIS_STEP * std[i]) ** 2
    return np.sqrt(out)


def at_linear_joint(effect: Effect, structure: Structure) -> bool:
    """Whether the parameters of an effect are those of a linear joint."""
    h = effect.hypothesis
    of_joint = h.channel != "model" or bool(h.options.get("baseline"))
    return of_joint and h.place in linear_names(structure.robot)
