"""The catalogue of effects as hypotheses that can be fitted."""

from __future__ import annotations

import itertools
from dataclasses import replace

import numpy as np

from ident.chain import Structure
from ident.hypotheses import (
    bodies,
    drifts,
    drive,
    friction,
    hinges,
    link_springs,
    sensing,
    slips,
    structure,
    transmission,
)
from ident.hypotheses.hypothesis import RIPPLE, Hypothesis, Parameter, Screen, SignalScale
from robot_assets.robot import Robot, linear_joints

MOST_IN_A_TURN = 4  # periods of a usual ripple in a turn of its motor
AT_ORIGIN = 1e-4  # m, from the base's origin
LEAST_DAMPING = 1e-6  # s, of a gear, over its stiffness
SHARPER = (  # with a parameter that motions do not show
    friction.coulomb_friction,
    friction.stribeck_friction,
    friction.load_dependent_friction,
    friction.friction_drift,
    link_springs.dress_pack,
    drive.torque_lag,
    sensing.sensor_lag,
)
PER_JOINT = (
    drive.cogging,
    drive.torque_constant,
    drive.torque_delay,
    drive.torque_saturation,
    transmission.hardening_stiffness,
    transmission.softening_stiffness,
    transmission.hysteresis,
    transmission.transmission_error,
    sensing.sensor_delay,
)


def catalogue(chain: Structure, *, motions_alone: bool = False, held: bool = True) -> tuple[Hypothesis, ...]:
    """Every hypothesis at every place of an arm, decoys included.

    Decoys describe what the catalogue lacks: one that explains the data better than every named
    effect says that the cause is unknown.

    Args:
        motions_alone: of records without multisines. Constant errors of the torque are part of the baseline there, and
            the bristles of a friction are not damped, and none turns before the velocity does.
        held: whether the recorded torque is known to be held from sample to sample; else its record may roll off.
    """
    robot = chain.robot
    names = robot.joint_names
    out: list[Hypothesis] = []
    linear = linear_joints(robot)
    for j, name in enumerate(names):
        out.append(drive.torque_saturation(j, name, wound_up=True))
        if not motions_alone:
            out.append(friction.bristled_stribeck(j, name))
        if not linear[j]:  # before the plain one, which has its name
            out.append(link_springs.spring_between_points(j, name))
        out.append(link_springs.gravity_spring(j, name, bool(linear[j])))
        out += [make(j, name, not motions_alone) for make in SHARPER]
        out += [make(j, name) for make in PER_JOINT]
        out.append(friction.presliding_friction(j, name, damped=not motions_alone))
        if not linear[j]:  # what errs once a turn
            out.append(sensing.encoder_eccentricity(j, name))
        out.append(
            transmission.backlash(j, name, max(robot.joints[j].damping / robot.joints[j].stiffness, LEAST_DAMPING))
        )
        out.append(link_springs.dress_pack(j, name, yields=True))
        out += [friction.velocity_power(j, name, power) for power in (2, 3)]
        out += [friction.rising_friction(j, name), friction.falling_drag(j, name)]
        out.append(friction.position_friction(j, name, not motions_alone))
        out.append(structure.link_friction(j, name))
        out += [drifts.torque_drift(j, name), sensing.position_scale(j, name)]
        out += [drive.torque_ripple(j, name), drive.torque_curve(j, name)]
        if not motions_alone:
            out.append(sensing.constant_torque(j, name))
            if not held:
                out.append(drive.record_roll_off(j, name))
        if robot.joints[j].gear_ratio != 1.0:
            out.append(sensing.encoder_eccentricity(j, name, robot.joints[j].gear_ratio))
    for j, k in itertools.permutations(range(len(names)), 2):
        out.append(structure.joint_coupling(j, k, names[j], names[k]))
        out.append(drive.crosstalk(j, names[j], k, names[k]))
    if robot.payload_link in chain.bodies:
        out.append(bodies.payload(robot.payload_link))
    seen: set[int] = set()
    known = {chain.carriers[joint] for joint in chain.inertias}  # with what they carry
    for link, (index, _) in chain.bodies.items():
        if index in seen or index == 0:
            continue
        seen.add(index)
        carries = index == chain.bodies.get(robot.payload_link, (0, None))[0]
        loaded = index not in known and any(chain.bodies[load.link][0] == index for load in robot.loads)
        for with_load in (False, True)[: 1 + loaded]:
            out.append(bodies.link_inertia(link, _joint_of_body(chain, index), carries, with_load))
    off_base = np.array([_off_base(chain, j) for j in range(len(names))])
    for j, name in enumerate(names):
        # Of an arm whose only joint on the base stands at its origin it would be the base that moves.
        same = off_base[j] <= AT_ORIGIN and np.sum(np.isfinite(off_base)) == 1
        for before in (False, True)[: 2 - same]:
            out += [
                hinges.compliance(
                    name, j, axes, "transverse_elasticity", before, before and bool(np.isfinite(off_base[j]))
                )
                for axes in _turned(_across(chain, j))
            ]
    if robot.n > 1 and np.any(robot.gravity):  # of a single joint it is a body whose centre is elsewhere
        out.append(structure.leaning_base())
    out += [hinges.compliance("base", -1, axes, "base_elasticity") for axes in _turned(np.eye(3))]
    return tuple(_turning_with_motor(h, robot) for h in out)


def _turning_with_motor(hypothesis: Hypothesis, robot: Robot) -> Hypothesis:
    """A ripple, which is usually of what turns with the motor: a few times in each turn of it. Without a gear that would
    be what slow laws of the position look like too."""
    turns = robot.joints[hypothesis.joint].gear_ratio
    if not hypothesis.repeats or hypothesis.joint < 0 or turns == 1.0:
        return hypothesis
    at = [q.name for q in hypothesis.parameters].index(RIPPLE)

    def usual(p: np.ndarray) -> dict[str, float]:
        times = round(p[at] / turns)
        return {RIPPLE: times * turns} if 1 <= times <= MOST_IN_A_TURN else {}

    return replace(hypothesis, options=hypothesis.options | {"usual": usual})


def wider_forms(hypothesis: Hypothesis, leads: bool = True) -> list[Hypothesis]:
    """Laws with more parameters that hold another one, under its name or that of a law next to it; none of others.

    Of a lag or a delay the lag of second order; of an encoder out of centre the one that is oval too; of a balancing
    spring the one between two points; of that and of a bundle of cables the bundle with another rest; of a bristle the
    slips in parallel.

    Args:
        leads: as of ``link_springs.dress_pack``.
    """
    h = hypothesis
    if "holds" in h.options:
        return []
    if h.effect == "encoder_eccentricity":
        return [sensing.encoder_eccentricity(h.joint, h.place, h.options["turns"], oval=True)]
    if h.effect == "presliding_friction":
        return [slips.slipping_friction(h.joint, h.place)]
    if h.effect == "gravity_spring":
        between = [] if h.options["linear"] else [link_springs.spring_between_points(h.joint, h.place)]
        return [*between, link_springs.hung_dress_pack(h.joint, h.place, spring=True, leads=leads)]
    if h.effect == "dress_pack":
        return [link_springs.hung_dress_pack(h.joint, h.place, False, yields=h.options["yields"], leads=leads)]
    lags = [make(h.joint, h.place, second=True) for make in (drive.torque_lag, sensing.sensor_lag)]
    return [x for x in lags if h.effect in (x.effect, x.options["holds"])]


def _turned(axes: np.ndarray) -> list[tuple[tuple[float, float, float], ...]]:
    """Each of the axes first, the others behind it."""
    rows = [(float(x), float(y), float(z)) for x, y, z in axes]
    return [tuple(rows[i:] + rows[:i]) for i in range(len(rows))]


def _joint_of_body(chain: Structure, index: int) -> int:
    """Driven joint that carries a body, -1 where there is none."""
    column = chain.model.idx_vs[index]
    driven = list(chain.driven)
    below = [j for j, c in enumerate(driven) if c <= column]
    return below[-1] if below else -1


def _index(chain: Structure, joint: int) -> int:
    """Pinocchio's index of a driven joint."""
    return next(i for i in range(1, chain.model.njoints) if chain.model.idx_vs[i] == chain.driven[joint])


def _off_base(chain: Structure, joint: int) -> float:
    """Distance of a joint that the base carries, on hinges of its description or without, from the base's origin, m;
    infinite where another joint carries it."""
    model, index = chain.model, _index(chain, joint)
    place, parent = model.jointPlacements[index], model.parents[index]
    while parent and model.idx_vs[parent] in chain.elastic:
        place, parent = model.jointPlacements[parent] * place, model.parents[parent]
    return np.inf if parent else float(np.linalg.norm(place.translation))


def _across(chain: Structure, joint: int) -> np.ndarray:
    """(2, 3) axes of the joint's frame, across its own."""
    own = np.asarray(chain.model.joints[_index(chain, joint)].extract().axis)
    axes = np.stack(sorted(np.eye(3), key=lambda a: abs(a @ own))[:2])
    axes = axes - np.outer(axes @ own, own) / (own @ own)
    return axes / np.linalg.norm(axes, axis=1, keepdims=True)


__all__ = ["Hypothesis", "Parameter", "Screen", "SignalScale", "catalogue", "wider_forms"]
