"""Effects of the chain: loads, springs to the link side, compliance and coupling.

Those on channel "model" change the gray-box itself; ``Change`` says how.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import pinocchio as pin

from ident.chain import LinkChange, Structure, build_structure
from ident.graybox import Parameters, equilibrium, linearise
from ident.group import Group
from ident.hypotheses import kernels
from ident.hypotheses.friction import SMOOTHING, direction
from ident.hypotheses.hypothesis import Hypothesis, Parameter, Screen
from ident.hypotheses.yielding import elastoplastic
from ident.inverse import (
    Motion,
    Plane,
    Solution,
    coarse_group,
    inverse_dynamics,
    plane_at,
    solve,
)
from robot_assets.robot import Elasticity

LOAD_NATS = 2.0  # log odds of a load against a wrong last body: loads come and go
SMALL_LOAD = 0.03  # m, radius of gyration of a load from which its fit starts
STIFFEST = 1e12  # N m/rad, of a hinge
RESONANCES = 0.06, 0.12, 0.22, 0.35, 0.55, 0.85, 5.0  # of a hinge, over the highest line: far above it all answer alike
FARTHEST_REST = 10.0  # of a balancing spring, rad or m
MOST_TILT = 3.0  # of an elastic axis towards each other axis, in units of that along the one from which it is sought in a fit
YIELDS = 0.1  # of the rms motion, over which a cable gives before it slips, to begin with
LINK_STEPS = (1e-3, 1e-4, 1e-4, 1e-4, 1e-3)  # of mass, com and inertia of a link, for unit responses


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


def gravity_spring(joint: int, place: str) -> Hypothesis:
    """Balancing spring on the link: ``stiffness (q_link - rest_angle)`` against it."""

    def screen(motion: Motion, j: int, k: float, shape) -> Screen:
        q = motion.q_link(j)
        return Screen(
            (q, np.ones_like(q)),
            lambda c: np.array([c[0], np.clip(-c[1] / c[0], -9.0, 9.0)]) if c[0] > 0 else None,
        )

    return Hypothesis(
        "gravity_spring",
        place,
        joint,
        "link",
        (Parameter("stiffness", "N m/rad", 1e-6, 1e9, log=True), Parameter("rest_angle", "rad", -FARTHEST_REST, FARTHEST_REST, step=1e-3)),
        lambda p, motion, j, k: p[0] * (motion.q_link(j) - p[1]),
        lambda scale: [()],
        screen,
        "A spring of {stiffness:.3g} N m/rad with rest at {rest_angle:.3g} rad pulls on the link of {joint}: static"
        " torque that is linear in posture.",
        variable="q",
        options={"trivial": lambda p, k: abs(p[1]) > 0.95 * FARTHEST_REST},  # a constant torque
    )


def dress_pack(joint: int, place: str, yields: bool = False) -> Hypothesis:
    """Cable bundle on the link side: ``stiffness q_link + friction sign(q_link')``.

    Args:
        yields: whether the friction turns over with the path, as of cables that give before they slip (Dahl 1968), in
            place of the velocity.
    """

    def screen(motion: Motion, j: int, k: float, shape) -> Screen:
        v, q = motion.v_link(j), motion.q_link(j)
        turn = 0.02 * float(np.sqrt(np.mean(v**2)))
        give = YIELDS * float(np.std(q))

        def start(c):
            return np.array([max(c[0], 1e-3), max(c[1], 1e-3), give if yields else turn]) if max(c[0], c[1]) > 0 else None

        if not yields:
            return Screen((q, direction(v, turn)), start)
        return Screen((q, elastoplastic(q, 1.0 / max(give, 1e-12), 1.0)), start)

    return Hypothesis(
        "dress_pack",
        place,
        joint,
        "link",
        (
            Parameter("stiffness", "N m/rad", 1e-6, 1e9, log=True, step=1e-3),
            Parameter("friction", "N m", 1e-9, 1e7, log=True, step=1e-3),
            Parameter("yield_angle", "rad", 1e-7, 1.0, log=True, nuisance=True, step=0.02) if yields else SMOOTHING,
        ),
        None,
        lambda scale: [()],
        screen,
        "A bundle of {stiffness:.3g} N m/rad with {friction:.3g} N m of friction pulls on the link of {joint}.",
        variable="q",
        options={
            "loop": lambda p: kernels.Law(kernels.CABLE, p[0], p[1], p[1] / p[2]) if yields else kernels.Law(kernels.LINK, p[0], p[1], p[2]),
            # Without a spring to speak of it is a second friction, which a stiff gear hardly tells from that of the motor.
            "trivial": lambda p, k: p[0] < 0.2 * p[1],
            "absorbs": "gravity_spring",
            "absorb": lambda p, weights, old: np.array([old[0], p[1], p[2]]),
        },
    )


def payload(link: str) -> Hypothesis:
    """Unknown load with its centre of mass at ``com`` in the frame of the flange's link.

    Its inertia about the centre is that of a body along the axes of the frame: what a ball would leave, a wrong link takes up.
    """

    def change(p) -> Change:
        return Change(loads=((link, pin.Inertia(float(p[0]), np.asarray(p[1:4], float), np.diag(p[4:7]))),))

    def responses(structure, par, plane, group, solution, shape):
        joint, placement = structure.bodies[link]
        columns = [_move(np.append(unit, np.zeros(6)), placement) for unit in np.eye(4)]
        return _inertial_responses(structure, joint, columns, plane, group, solution)

    def start(c):
        if c[0] <= 0:
            return None
        return np.concatenate([[c[0]], np.clip(c[1:] / c[0], -0.4, 0.4), np.full(3, c[0] * SMALL_LOAD**2)])

    return Hypothesis(
        "payload",
        "flange",
        -1,
        "model",
        (
            Parameter("mass", "kg", 1e-6, 1e4, log=True, step=1e-3),
            Parameter("com_x", "m", -2.0, 2.0, step=1e-3, center=0.0, spread=0.2),
            Parameter("com_y", "m", -2.0, 2.0, step=1e-3, center=0.0, spread=0.2),
            Parameter("com_z", "m", -2.0, 2.0, step=1e-3, center=0.0, spread=0.2),
            *(Parameter(f"inertia_{i}", "kg m2", 1e-9, 1e4, log=True, step=1e-1) for i in "xyz"),
        ),
        None,
        lambda scale: [()],
        None,
        "An unknown load of {mass:.3g} kg hangs at the flange: anti-resonances fall at every posture and the gravity"
        " torque changes with them.",
        variable="posture",
        options={"body": link, "change": change, "responses": responses, "start": start, "shown": "mass"},
    )


def link_inertia(link: str, joint_index: int, carries_load: bool = False, with_load: bool = False) -> Hypothesis:
    """Mass, centre of mass and inertia of a link are not those of the model.

    ``mass`` and ``inertia`` (about the centre of mass) are factors, ``com`` is a shift in the frame of
    the link's joint. The data seldom determine all of them: what they leave open stays near the model.

    Args:
        carries_load: whether a payload would be part of the same body.
        with_load: whether the loads that the robot names on it are.
    """

    def how(p) -> LinkChange:
        return LinkChange(float(p[0]), (float(p[1]), float(p[2]), float(p[3])), float(p[4]), with_load)

    def responses(structure, par, plane, group, solution, shape):
        joint, _ = structure.bodies[link]
        robot = structure.robot if with_load else replace(structure.robot, loads=())
        bare = build_structure(robot, links=structure.links, inertias=structure.inertias)
        own = bare.model.inertias[bare.bodies[link][0]]
        base = own.toDynamicParameters()
        changed = np.array([1.0, 0.0, 0.0, 0.0, 1.0]) + np.diag(LINK_STEPS)
        columns = [(how(p).of(own).toDynamicParameters() - base) / h for p, h in zip(changed, LINK_STEPS, strict=True)]
        return _inertial_responses(structure, joint, columns, plane, group, solution)

    return Hypothesis(
        "link_inertia",
        link,
        joint_index,
        "model",
        (
            Parameter("mass", "1", 0.05, 20.0, log=True, step=1e-4, center=1.0, spread=0.5, null=1.0),
            Parameter("com_x", "m", -1.0, 1.0, step=1e-4, center=0.0, spread=0.1, null=0.0),
            Parameter("com_y", "m", -1.0, 1.0, step=1e-4, center=0.0, spread=0.1, null=0.0),
            Parameter("com_z", "m", -1.0, 1.0, step=1e-4, center=0.0, spread=0.1, null=0.0),
            Parameter("inertia", "1", 0.02, 50.0, log=True, step=1e-3, center=1.0, spread=0.5, null=1.0),
        ),
        None,
        lambda scale: [()],
        None,
        f"The body of {{joint}}{', with the load on it,' if with_load else ''} is not that of the model:"
        " its mass is {mass:.3g} times, its inertia {inertia:.3g} times"
        " what the model says, its centre of mass off by ({com_x:.3g}, {com_y:.3g}, {com_z:.3g}) m.",
        variable="posture",
        options={
            "body": link,
            "nats": -LOAD_NATS if carries_load else 0.0,
            "with_load": with_load,
            "carries_load": carries_load,  # what it carries and its own body are one to the data
            "change": lambda p: Change(links=((link, how(p)),)),
            "responses": responses,
            "start": lambda c: np.array(
                [np.clip(1.0 + c[0], 0.3, 4.0), *np.clip(c[1:4], -0.2, 0.2), np.clip(1.0 + c[4], 0.3, 4.0)]
            ),
        },
    )


def joint_coupling(source: int, target: int, place: str, turned: str) -> Hypothesis:
    """Turning motor ``source``, at ``place``, turns joint ``target`` too, by ``ratio``; ``turned`` is that one's name."""

    def responses(structure, par, plane, group, solution, shape):
        step = 1e-4
        coupling = par.coupling.copy()
        coupling[target, source] += step
        coupled = replace(par, coupling=coupling)
        wide = plane_at(structure, coupled, plane.lin, group, plane.record)
        moved = solve(structure, coupled, wide, group, None, Q=solution.Q, W=solution.W)
        still = solve(structure, par, plane, group, None, Q=solution.Q, W=solution.W)
        seen = structure.driven[list(group.links)]
        return [np.concatenate([moved.U - still.U, (moved.Q_a - still.Q_a)[..., seen]], axis=-1) / step]

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


def compliance(
    place: str, joint_index: int, axes: tuple[tuple[float, float, float], ...], effect: str, before: bool = False
) -> Hypothesis:
    """A spring-damper hinge across a joint (or under the base) that the model lacks.

    Args:
        axes: the one from which the axis is sought, and those towards which it may turn.
        before: hinge before the joint, at the end of the body that carries it.
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
        return (compliance(place, joint_index, (*axes[i:], *axes[:i]), effect, before), np.array([*p[:2], *others])) if i else None

    def hinge(p: Sequence[float]) -> Elasticity:
        x, y, z = (float(v) for v in axis(p))
        return Elasticity(name, place, (x, y, z), float(p[0]), float(p[1]), before)

    def at(structure: Structure, group: Group, frequency: float, ratio: float, softer: float = 1.0) -> np.ndarray:
        """Parameters with its own resonance at ``frequency`` (Hz), of that damping ``ratio``, its stiffness divided by ``softer``."""
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
        None,
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
            "trivial": lambda p, k: p[0] > 0.1 * STIFFEST,
        },
    )


def hinge_inertia(structure: Structure, hinge: Elasticity, group: Group) -> float:
    """Inertia about a new hinge with everything else held, kg m2."""
    wide = build_structure(structure.robot, elasticities=(hinge,), inertias=structure.inertias)
    q = np.zeros(wide.n_coordinates)
    q[wide.driven] = group.posture
    return float(linearise(wide, q).M[wide.elastic[-1], wide.elastic[-1]])


def _inertial_responses(
    structure: Structure,
    joint: int,
    columns: Sequence[np.ndarray],
    plane: Plane,
    group: Group,
    solution: Solution,
) -> list[np.ndarray]:
    """Recorded torques and link positions (S, L, n + M) per unit of inertial parameters added to a body.

    ``columns`` hold dynamic parameters [m, m c, I] (10,) in the frame of the joint; inverse dynamics is
    linear in them, so that a response is a difference of two inverse dynamics.
    """
    coarse = coarse_group(group)
    slow = len(coarse.omega)
    motion = [coarse.to_time(plane.s[:slow, None] ** k * solution.Q_a[:, :slow]) for k in range(3)]
    without = inverse_dynamics(structure, *motion)
    out = []
    for column in columns:
        model = structure.model.copy()
        model.inertias[joint] = pin.Inertia.FromDynamicParameters(
            model.inertias[joint].toDynamicParameters() + column
        )
        lines = np.zeros_like(solution.Q_a)
        lines[:, :slow] = coarse.to_lines(inverse_dynamics(replace(structure, model=model), *motion) - without)
        out.append(np.matmul(plane.output_per_load, lines[..., None])[..., 0])
    return out


def _move(parameters: np.ndarray, placement: pin.SE3) -> np.ndarray:
    """Dynamic parameters (10,) of a body given in a frame at ``placement`` of its joint.

    Works for parameters that are no body by themselves (a first moment without mass).
    """
    if np.allclose(placement.homogeneous, np.eye(4)):
        return parameters
    big = pin.Inertia(1e3, np.zeros(3), 1e3 * np.eye(3)).toDynamicParameters()

    def moved(x: np.ndarray) -> np.ndarray:
        return placement.act(pin.Inertia.FromDynamicParameters(x)).toDynamicParameters()

    return moved(big + parameters) - moved(big)
