"""Hinges that the model lacks: a bearing, a link or the base that bends."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ident.chain import Structure, build_structure
from ident.graybox import equilibrium, linearise
from ident.group import Group
from ident.hypotheses.hypothesis import Hypothesis, Parameter, no_law
from ident.hypotheses.structure import Change, apply_change
from ident.inverse import plane_at
from robot_assets.robot import Elasticity

STIFFEST = 1e12  # N m/rad, of a hinge
RESONANCES = 0.06, 0.12, 0.22, 0.35, 0.55, 0.85, 5.0  # of a hinge, over the highest line: far above it all answer alike
# of an elastic axis towards each other axis, in units of that along the one from which it is sought in a fit
MOST_TILT = 3.0
ON_BASE_NATS = 2.5  # against a hinge between base and first joint: of what bends there most is the foundation


def compliance(
    place: str,
    joint_index: int,
    axes: tuple[tuple[float, float, float], ...],
    effect: str,
    before: bool = False,
    on_base: bool = False,
) -> Hypothesis:
    """A spring-damper hinge across a joint (or under the base) that the model lacks.

    Args:
        axes: the one from which the axis is sought, and those towards which it may turn.
        before: hinge before the joint, at the end of the body that carries it; ``on_base``: which is the base.
    """
    name = f"{effect}:{place}"
    tilts = tuple(f"tilt_{i}" for i in range(1, len(axes)))

    def axis(p: Sequence[float]) -> np.ndarray:
        direction = np.array(axes[0]) + np.asarray(p)[2:] @ np.array(axes[1:])
        return direction / np.linalg.norm(direction)

    def nearer(p: np.ndarray) -> tuple[Hypothesis, np.ndarray] | None:
        """The same hinge sought from the axis that is nearest; None where it is already."""
        along = np.concatenate([[1.0], np.asarray(p)[2:]])
        i = int(np.argmax(np.abs(along)))
        others = np.roll(along, -i)[1:] / along[i]
        turned = compliance(place, joint_index, (*axes[i:], *axes[:i]), effect, before, on_base)
        return (turned, np.array([*p[:2], *others])) if i else None

    def hinge(p: Sequence[float]) -> Elasticity:
        x, y, z = (float(v) for v in axis(p))
        return Elasticity(name, place, (x, y, z), float(p[0]), float(p[1]), before)

    def at(structure: Structure, group: Group, frequency: float, ratio: float, softer: float = 1.0) -> np.ndarray:
        """Parameters with its own resonance at ``frequency`` (Hz), of that damping ``ratio``, its stiffness divided by
        ``softer``."""
        straight = np.zeros(len(tilts))
        own = hinge_inertia(structure, hinge([STIFFEST, 1.0, *straight]), group)
        stiffness = own * (2 * np.pi * frequency) ** 2 / softer
        return np.array([stiffness, 2 * ratio * np.sqrt(own * stiffness), *straight])

    def responses(structure, par, plane, group, solution, shape):
        wide, wide_par = apply_change(structure, par, Change(elasticities=(hinge(at(structure, group, *shape)),)))
        lin = linearise(wide, equilibrium(wide, wide_par, group.posture))
        there = plane_at(wide, wide_par, lin, group, plane.record)
        unit = np.matmul(there.output_per_position - plane.output_per_position, solution.Q[..., None])[..., 0]
        unit[:, 0] = 0.0
        return [unit]

    where = "before its own turn" if before else "after its own turn"
    return Hypothesis(
        effect,
        place,
        joint_index,
        "model",
        (
            Parameter("stiffness", "N m/rad", 1.0, STIFFEST, log=True, step=1e-3),
            Parameter("damping", "N m s/rad", 1e-6, 1e9, log=True, step=1e-2),
            *(Parameter(t, "1", -MOST_TILT, MOST_TILT, nuisance=True, step=1e-3, spread=1.0, null=0.0) for t in tilts),
        ),
        no_law,
        lambda scale: [(f * scale.highest_line, 0.03) for f in RESONANCES],
        None,
        f"The data hold a resonance that the model lacks: {{joint}} bends across its axis, {where}, with"
        " {stiffness:.3g} N m/rad."
        if effect == "transverse_elasticity"
        else "A resonance common to all axes: the foundation moves on {stiffness:.3g} N m/rad.",
        variable="frequency",
        options={
            "change": lambda p: Change(elasticities=(hinge(p),)),
            "responses": responses,
            "hinge": at,
            "axis": axis,
            "nearer": nearer,
            "before": before,
            "nats": lambda p: -ON_BASE_NATS * on_base,
            "trivial": lambda p, k: p[0] > 0.1 * STIFFEST,
        },
    )


def hinge_inertia(structure: Structure, hinge: Elasticity, group: Group) -> float:
    """Inertia about a new hinge with everything else held, kg m2."""
    wide = build_structure(structure.robot, elasticities=(hinge,), inertias=structure.inertias)
    q = np.zeros(wide.n_coordinates)
    q[wide.driven] = group.posture
    return float(linearise(wide, q).M[wide.elastic[-1], wide.elastic[-1]])
