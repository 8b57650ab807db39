"""Changes of the chain itself, made by effects on channel "model": ``Change`` says how; gears that turn two joints, and friction of a link."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pinocchio as pin

from ident.chain import LinkChange, Structure, build_structure
from ident.graybox import Parameters
from ident.hypotheses.hypothesis import Hypothesis, Parameter
from robot_assets.robot import Elasticity

DISTANT_NATS = 2.0  # against a gear that turns another joint than the next one


@dataclass(frozen=True)
class Change:
    """A change of the chain: what ``build_structure`` and ``Parameters`` take."""

    elasticities: tuple[Elasticity, ...] = ()
    loads: tuple[tuple[str, pin.Inertia], ...] = ()
    links: tuple[tuple[str, LinkChange], ...] = ()
    coupling: tuple[tuple[int, int, float], ...] = ()
    link_viscous: tuple[tuple[int, float], ...] = ()

    def __add__(self, other: Change) -> Change:
        return Change(
            self.elasticities + other.elasticities,
            self.loads + other.loads,
            self.links + other.links,
            self.coupling + other.coupling,
            self.link_viscous + other.link_viscous,
        )


def apply_change(structure: Structure, par: Parameters, change: Change) -> tuple[Structure, Parameters]:
    """The chain and parameters with a change made."""
    if change == Change():
        return structure, par
    if change.elasticities or change.loads or change.links:
        links = dict(structure.links)
        for link, how in change.links:
            links[link] = links.get(link, LinkChange()) + how
        structure = build_structure(
            structure.robot,
            elasticities=structure.hinges + change.elasticities,
            loads=structure.loads + change.loads,
            links=links,
            inertias=structure.inertias,
        )
    coupling = par.coupling.copy()
    for row, column, ratio in change.coupling:
        coupling[row, column] += ratio
    link_viscous = par.link_viscous.copy()
    for joint, coefficient in change.link_viscous:
        link_viscous[joint] += coefficient
    stiffness = [e.stiffness for e in change.elasticities]
    damping = [e.damping for e in change.elasticities]
    par = replace(
        par,
        coupling=coupling,
        link_viscous=link_viscous,
        elastic_stiffness=np.concatenate([par.elastic_stiffness, stiffness]),
        elastic_damping=np.concatenate([par.elastic_damping, damping]),
    )
    return structure, par


def joint_coupling(source: int, target: int, place: str, turned: str) -> Hypothesis:
    """Turning motor ``source``, at ``place``, turns joint ``target`` too, by ``ratio``; ``turned`` is that one's name.

    Gears of wrists and hollow arms lead past a joint as well; the next one is likelier.
    """

    def responses(structure, par, plane, group, solution, shape):
        # The gear of the target is wound up by the motor, and the motor bears its torque.
        wound = plane.C[:, target] * solution.Q[..., source]
        borne = solution.tau_s[..., target]
        return [
            plane.output_per_spring[:, :, target] * wound[..., None]
            + plane.output_per_motor[:, :, source] * borne[..., None]
        ]

    return Hypothesis(
        "joint_coupling",
        place,
        source,
        "model",
        (Parameter("ratio", "1", -2.0, 2.0, step=1e-4),),
        None,
        lambda scale: [()],
        None,
        "Turning the motor of {joint} turns {turned} too, by a ratio of {ratio:.4g}.",
        variable="q",
        options={
            "joints": (place, turned),
            "change": lambda p: Change(coupling=((target, source, float(p[0])),)),
            "responses": responses,
            "start": lambda c: np.array([np.clip(c[0], -1.5, 1.5)]),
            "nats": 0.0 if target == source + 1 else -DISTANT_NATS,
        },
    )


def link_friction(joint: int, place: str) -> Hypothesis:
    """Decoy: viscous friction of the link, behind the gear, which the catalogue lacks.

    It damps the anti-resonance of the motor, as no damper of the gear does. A model that needs it is extended by it.
    """

    def responses(structure, par, plane, group, solution, shape):
        c = structure.driven[joint]
        rate = plane.s * solution.Q_a[..., c]
        return [plane.output_per_load[:, :, c] * rate[..., None]]

    return Hypothesis(
        "unknown:link_friction",
        place,
        joint,
        "model",
        (Parameter("coefficient", "N m s/rad", 1e-9, 1e7, log=True, step=1e-3),),
        None,
        lambda scale: [()],
        None,
        "Viscous friction of {coefficient:.3g} N m s/rad on the link of {joint}, behind its gear, is part of the extended"
        " model: it explains most of the discrepancy, and the catalogue has no name for it.",
        options={
            "baseline": "link_friction",
            "change": lambda p: Change(link_viscous=((joint, float(p[0])),)),
            "responses": responses,
            "start": lambda c: np.array([c[0]]) if c[0] > 0 else None,
        },
    )
