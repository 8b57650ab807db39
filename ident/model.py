"""The gray-box with effects, as a description: which, where, with which values."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from functools import cached_property
from typing import Any

import numpy as np

from ident.chain import Structure
from ident.graybox import Parameters
from ident.group import Group
from ident.hypotheses.hypothesis import Hypothesis
from ident.hypotheses.structure import Change, apply_change


@dataclass(frozen=True)
class Effect:
    """A hypothesis with values for its parameters (external units)."""

    hypothesis: Hypothesis
    p: np.ndarray

    def value(self, name: str) -> float:
        """A parameter by its name, SI."""
        return float(self.p[[q.name for q in self.hypothesis.parameters].index(name)])

    def stepped(self) -> list[tuple[np.ndarray, float]]:
        """Parameters after a step of each coordinate, and the step."""
        steps = []
        for c, q in enumerate(self.hypothesis.parameters):
            x, p, step = q.to_internal(self.p[c]), self.p.copy(), q.step
            p[c] = q.to_external(x + step)
            if p[c] == self.p[c]:
                step = -step
                p[c] = q.to_external(x + step)
            steps.append((p, step))
        return steps


@dataclass(frozen=True)
class Model:
    """A chain, baseline parameters and effects."""

    structure: Structure
    par: Parameters
    effects: tuple[Effect, ...] = ()

    def __getstate__(self) -> dict[str, Any]:
        return {f.name: getattr(self, f.name) for f in fields(self)}  # what is made of them is made again elsewhere

    @cached_property
    def stepped(self) -> tuple[tuple[tuple[Model, float], ...], ...]:
        """For each effect, the models after a step of each of its coordinates, and the steps."""

        def with_effect(i: int, p: np.ndarray) -> Model:
            effects = tuple(replace(e, p=p) if k == i else e for k, e in enumerate(self.effects))
            return replace(self, effects=effects)

        return tuple(
            tuple((with_effect(i, p), step) for p, step in effect.stepped()) for i, effect in enumerate(self.effects)
        )

    @cached_property
    def built(self) -> tuple[Structure, Parameters]:
        """Chain and parameters with the effects that change them."""
        change = Change()
        for effect in self.effects:
            if effect.hypothesis.channel == "model":
                change = change + effect.hypothesis.options["change"](effect.p)
        return apply_change(self.structure, self.par, change)


def joints_along_record(model: Model, group: Group) -> frozenset[int]:
    """Joints whose gear is predicted along the record of a group.

    Not in a motion, and not where the drive has an effect: its record is not the torque of the motor.
    """
    if group.window is not None:
        return frozenset()
    drives = {e.hypothesis.joint for e in model.effects if e.hypothesis.channel == "drive"}
    return frozenset(e.hypothesis.joint for e in model.effects if is_along_record(e.hypothesis)) - drives


def is_dry(effect: Effect) -> bool:
    """Whether an effect is a friction that at rest is what balances the drive."""
    return bool(effect.hypothesis.options.get("dry"))


def is_along_record(h: Hypothesis) -> bool:
    """Whether a law of the gear is taken along the deflection that the recorded torque says."""
    return bool(h.options.get("along_record"))


def has_rough_law(model: Model) -> bool:
    """Whether a law along the record, or one under which single records may be in another steady motion, leaves more
    than noise itself."""
    return any(is_along_record(e.hypothesis) or "bends" in e.hypothesis.options for e in model.effects)


def along_record(h: Hypothesis) -> Hypothesis:
    """A law of the gear taken along the deflection that the recorded torque says.

    A gear that rattles in its dead band has more than one steady state, and which of them a recording shows depends
    on how it began: the loop solved from rest ends in another, though the model is right. The recorded torque, less
    that of the motor, moved the link, and the link's open compliance says where that took the gear. What the law
    leaves of that torque reaches the gear's own motor as through the linear gear: there a linear law leaves what the
    loop does. A motion, which is closed by a return that was not recorded, is predicted by the loop, and so is a joint
    with an effect of its drive (``joints_along_record``).
    """
    return replace(h, options={**h.options, "along_record": True})


def as_loop(h: Hypothesis) -> Hypothesis:
    """The law that ``along_record`` was made of."""
    return replace(h, options={k: v for k, v in h.options.items() if k != "along_record"})


def simulated_laws(model: Model) -> Model:
    """The model with all laws of the gear as loops."""
    return replace(model, effects=tuple(replace(e, hypothesis=as_loop(e.hypothesis)) for e in model.effects))


def is_linear(hypothesis: Hypothesis) -> bool:
    """Whether small motions answer an effect line by line: a change of the chain, a filter of a drive or a sensor."""
    return hypothesis.channel == "model" or "filter" in hypothesis.options


def has_loop(effect: Effect) -> bool:
    """Whether an effect moves the arm by which it is moved: a loop, solved in one pass."""
    return effect.hypothesis.gear_law or "loop" in effect.hypothesis.options
