"""Changes of the chain itself, made by effects on channel "model": ``Change`` says how; gears that turn two joints,
friction of a link, and a base that leans."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import pinocchio as pin
import scipy.linalg

from ident.chain import LinkChange, Structure, build_structure
from ident.graybox import Parameters
from ident.group import Group
from ident.hypotheses.hypothesis import Hypothesis, Parameter, no_law
from ident.inverse import Plane, coarse_group, inverse_dynamics
from ident.motion import Solution
from robot_assets.robot import Elasticity

TILT_STEP = 1e-3  # rad, for unit responses
DISTANT_NATS = 2.0  # against a gear that turns another joint than the next one


@dataclass(frozen=True)
class Change:
    """A change of the chain: what ``build_structure`` and ``Parameters`` take, and ``tilt`` of gravity as of
    ``leaning``, rad."""

    elasticities: tuple[Elasticity, ...] = ()
    loads: tuple[tuple[str, pin.Inertia], ...] = ()
    links: tuple[tuple[str, LinkChange], ...] = ()
    coupling: tuple[tuple[int, int, float], ...] = ()
    link_viscous: tuple[tuple[int, float], ...] = ()
    tilt: tuple[float, float] = (0.0, 0.0)

    def __add__(self, other: Change) -> Change:
        return Change(
            self.elasticities + other.elasticities,
            self.loads + other.loads,
            self.links + other.links,
            self.coupling + other.coupling,
            self.link_viscous + other.link_viscous,
            (self.tilt[0] + other.tilt[0], self.tilt[1] + other.tilt[1]),
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
    if any(change.tilt):
        structure = leaning(structure, change.tilt)
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


def torques_of_changes(
    structure: Structure, changed: Iterable[Structure], plane: Plane, group: Group, solution: Solution
) -> list[np.ndarray]:
    """Recorded torques and link positions (S, L, n + M) that other chains ask for along the motion of one."""
    coarse = coarse_group(group)
    slow = len(coarse.omega)
    motion = [coarse.to_time(plane.s[:slow, None] ** k * solution.Q_a[:, :slow]) for k in range(3)]
    without = inverse_dynamics(structure, *motion)
    out = []
    for chain in changed:
        lines = np.zeros_like(solution.Q_a)
        lines[:, :slow] = coarse.to_lines(inverse_dynamics(chain, *motion) - without)
        out.append(np.matmul(plane.output_per_load, lines[..., None])[..., 0])
    return out


def leaning(structure: Structure, tilt: Sequence[float]) -> Structure:
    """The chain on a base that leans, so that gravity is turned in its frame.

    Args:
        tilt: (2,) rad, of gravity towards two axes across it that are across each other.
    """
    model = structure.model.copy()
    gravity = model.gravity.linear
    size = float(np.linalg.norm(gravity))
    axes = scipy.linalg.null_space(gravity[None] / size)
    turned = gravity / size + axes @ np.tan(np.asarray(tilt, float))
    model.gravity.linear = size * turned / np.linalg.norm(turned)
    return replace(structure, model=model)


def leaning_base() -> Hypothesis:
    """Decoy: a base that is not level, or not mounted as the model says. It asks for gravity torques at all joints that
    bear any."""

    def responses(structure, par, plane, group, solution, shape):
        leant = [leaning(structure, tilt) for tilt in TILT_STEP * np.eye(2)]
        return [x / TILT_STEP for x in torques_of_changes(structure, leant, plane, group, solution)]

    return Hypothesis(
        "unknown:leaning_base",
        "base",
        -1,
        "model",
        tuple(Parameter(f"tilt_{i}", "rad", -1.0, 1.0, step=1e-3, center=0.0, spread=0.1, null=0.0) for i in "12"),
        no_law,
        lambda scale: [()],
        None,
        "Gravity torques are those of a base that leans, which the catalogue has no name for.",
        variable="posture",
        options={
            "change": lambda p: Change(tilt=(float(p[0]), float(p[1]))),
            "responses": responses,
            "start": lambda c: np.clip(c, -0.5, 0.5),
        },
    )


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

    ratio = Parameter("ratio", "1", -2.0, 2.0, step=1e-4)

    def winds(plane, solution):
        torque = np.zeros((*solution.Q[:, 0].shape, 1))
        torque[:, target, 0] = (plane.C[0, target] * solution.Q[:, 0, source]).real
        return torque

    return Hypothesis(
        "joint_coupling",
        place,
        source,
        "model",
        (ratio,),
        no_law,
        lambda scale: [()],
        None,
        "Turning the motor of {joint} turns {turned} too, by a ratio of {ratio:.4g}.",
        variable="q",
        options={
            "joints": (place, turned),
            "change": lambda p: Change(coupling=((target, source, float(p[0])),)),
            "winds": winds,
            # It may be of any size, as those effects are that have one alone.
            "of_size": lambda p: min(abs(float(p[0])) / ratio.expected_spread(0.0), 1.0),
            "responses": responses,
            "start": lambda c: np.array([np.clip(c[0], -1.5, 1.5)]),
            "nats": lambda p: 0.0 if target == source + 1 else -DISTANT_NATS,
        },
    )


def link_friction(joint: int, place: str) -> Hypothesis:
    """Decoy: viscous friction of the link, behind the gear, which the catalogue lacks.

    It damps the anti-resonance of the motor, as no damper of the gear does. A model that needs it is extended by it.
    """

    def responses(structure, par, plane, group, solution, shape):
        c = structure.driven[joint]
        rate = plane.differences[0] * solution.Q_a[..., c]
        return [plane.output_per_load[:, :, c] * rate[..., None]]

    return Hypothesis(
        "unknown:link_friction",
        place,
        joint,
        "model",
        (Parameter("coefficient", "N m s/rad", 1e-9, 1e7, log=True, step=1e-3),),
        no_law,
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
