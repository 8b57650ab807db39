"""What to measure next, where two hypotheses explain the data alike.

Both fitted models predict the torque along motions that were not made yet: those of the recorded
experiments, smaller, larger, and in other postures. An experiment tells them apart by what the
torque of one differs from that of the other after the other has been refitted to it, under the
information that the recorded data already hold (the T-criterion of Atkinson and Fedorov, Biometrika
62, 1975, to first order in the parameters).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from ident.attribute import Attribution
from ident.derivatives import jacobian
from ident.evidence import Candidate
from ident.extended import predict
from ident.graybox import Parameters, equilibrium, linearise
from ident.group import Group
from ident.information import motor_loads
from ident.model import simulated_laws
from ident.naming import told_name
from ident.parallel import map_threads
from ident.plan import Plan, make_plan
from ident.problem import NOT_COMPUTED, Problem
from ident.torque_fit import Fit
from ident.verdict import Cause
from ident.weights import make_weights
from robot_assets.robot import Robot, linear_joints

TIED = 0.1  # probability from which a second hypothesis is worth an experiment
ENOUGH = 5.0  # nats of expected evidence that settle a tie
FACTORS = (0.25, 0.5, 1.0, 2.0)  # on the motion of the largest level
SHIFTS = (-1.0, 0.0, 1.0)  # of the joint in question, in units of the longest
LONGEST_SHIFT, RANGE_SHARE = 0.6, 0.3  # rad or m, and of the range of the joint
RECORDS = 6  # of a posture that are looked at
TORQUE_SHARE = 0.65  # of the torque limit that a planned motion may take once it is steady: it begins with more
LEVELS = (1.0, 0.5, 0.25)  # of a planned experiment, in units of the largest
MANY = 1000.0  # nats above which their number says no more: it is of first order


ADVICE = {
    frozenset({"coulomb_friction", "stribeck_friction"}): "a slow sweep at constant speed in both directions",
    frozenset({"coulomb_friction", "presliding_friction"}): "the same excitation at a quarter of the amplitude",
    frozenset(
        {"backlash", "softening_stiffness"}
    ): "the same posture at three levels of amplitude, and one where gravity loads the joint",
    frozenset(
        {"backlash", "hardening_stiffness"}
    ): "the same posture at three levels of amplitude, and one where gravity loads the joint",
    frozenset({"torque_delay", "torque_lag"}): "a band up to a third of the sample rate",
    frozenset({"sensor_delay", "sensor_lag"}): "a band up to a third of the sample rate",
    frozenset(
        {"cogging", "transmission_error"}
    ): "the same posture with excitation near the resonance, over a whole period of the ripple",
    frozenset({"payload", "link_inertia"}): "static torques in postures that turn the last link against gravity",
}


@dataclass(frozen=True)
class NextExperiment:
    """The experiment that separates two hypotheses best, of those that were thought of.

    Attributes:
        text: what to measure, and what is expected of it.
        nats: expected evidence between the two, per operating point.
        plan: the same for ``simgap experiment --plan``; None where nothing separates them.
    """

    text: str
    nats: float
    plan: Plan | None


@dataclass(frozen=True)
class _Option:
    group: Group
    factor: float
    joint: int
    shift: float


def separating_experiment(problem: Problem, result: Attribution) -> NextExperiment | None:
    """For the least certain cause with a rival; None where there is none, or no periodic data."""
    pair = _rivals(result, problem.groups)
    groups = [g for g in problem.groups if g.window is None]
    if pair is None or not groups:
        return None
    a, b = pair
    options = list(_options(problem, groups, a.hypothesis.joint))
    nats = map_threads(lambda option: _separation(problem, option, a.fit, b.fit), options)
    most = max(nats, default=0.0)
    names = " from ".join(f"{told_name(c, problem.groups)} at {c.hypothesis.place}" for c in pair)
    if not most > ENOUGH:
        other = "A wider band or a slow sweep may."
        if any(c.hypothesis.effect == "torque_constant" for c in pair):
            other = "The same with a load of known mass may."
        text = (
            f"To tell {names}: no other amplitude or posture would; of {len(options)} experiments the best is expected"
            f" to give {max(most, 0.0):.1f} nats. {other}"
        )
        return NextExperiment(text, most, None)
    o = options[int(np.argmax(nats))]
    robot = problem.structure.robot
    unit = "m" if linear_joints(robot)[o.joint] else "rad"
    where = f"the posture of {o.group.operating_point}" + (
        f" with {robot.joint_names[o.joint]} moved by {o.shift:+.2g} {unit}" if o.shift else ""
    )
    size = "the same amplitude" if o.factor == 1.0 else f"{o.factor:g} times the amplitude"
    expected = f"{most:.0f}" if most < MANY else f"more than {MANY:.0f}"
    text = f"To tell {names}: {where}, at {size}; expected to give {expected} nats between them (next_plan.toml)."
    return NextExperiment(text, most, _plan(problem, o))


def _rivals(result: Attribution, groups: Sequence[Group]) -> tuple[Candidate, Candidate] | None:
    """The winner of the least certain round and its best rival of another name or place."""
    pairs = []
    for found in result.rounds:
        first = found.candidates[0]
        name = told_name(first, groups), first.hypothesis.place
        rivals = [
            c
            for c in found.candidates[1:]
            if not c.hypothesis.decoy and c.probability >= TIED and (told_name(c, groups), c.hypothesis.place) != name
        ]
        if rivals and not first.hypothesis.decoy:
            pairs.append((first, rivals[0]))
    return min(pairs, key=lambda p: p[0].probability, default=None)


def _options(problem: Problem, groups: Sequence[Group], joint: int) -> Iterator[_Option]:
    """Every amplitude and posture of a joint; postures alone, of every joint, for what has no joint (-1)."""
    robot = problem.structure.robot
    limit = TORQUE_SHARE * robot.array("torque_limit")
    for group in groups:
        rows = np.argsort(-group.amplitude, kind="stable")[:RECORDS]
        top = group.pick(rows[group.amplitude[rows] == group.amplitude.max()])
        for j in range(robot.n) if joint < 0 else (joint,):
            longest = min(LONGEST_SHIFT, RANGE_SHARE * (robot.q_max[j] - robot.q_min[j]))
            for factor in (1.0,) if joint < 0 else FACTORS:
                if factor > 1.0 and np.any(np.abs(top.U[:, 0]).max(axis=0) + factor * _peak(top) > limit):
                    continue
                for shift in longest * np.array(SHIFTS):
                    if (factor, shift) != (1.0, 0.0) and within_reach(robot, top, factor, j, shift):
                        yield _Option(moved(top, factor, j, shift), factor, j, float(shift))


def within_reach(robot: Robot, group: Group, factor: float, joint: int, shift: float) -> bool:
    """Whether the motion of ``moved`` keeps to range and speed of every joint that it makes move further."""
    Q = group.Q.copy()
    Q[:, 0] = 0.0
    peak, fastest = (factor * np.abs(group.to_time(x)).max(axis=(0, 1)) for x in (Q, 1j * group.omega[:, None] * Q))
    at = group.posture.copy()
    at[joint] += shift
    inside = (robot.q_min < at - peak) & (at + peak < robot.q_max) & (fastest < robot.array("velocity_limit"))
    return bool(np.all(inside) if factor > 1.0 else inside[joint] or shift == 0.0)


def moved(group: Group, factor: float, joint: int, shift: float) -> Group:
    """The same motion ``factor`` times as large, about a posture shifted at one joint."""
    scale = np.full((1, len(group.omega), 1), factor)
    scale[:, 0] = 1.0
    Q = scale * group.Q
    Q[:, 0, joint] += shift
    return replace(group, Q=Q, U=scale * group.U, amplitude=factor * group.amplitude, drift=None)


def _peak(group: Group) -> np.ndarray:
    U = group.U.copy()
    U[:, 0] = 0.0
    return np.abs(group.to_time(U)).max(axis=(0, 1))


def _separation(problem: Problem, option: _Option, a: Fit, b: Fit) -> float:
    """Expected evidence, nats, for ``a`` against ``b`` refitted, and the other way round; the smaller. None at all where
    one of them cannot be computed there."""
    pair = (replace(x, model=simulated_laws(x.model)) for x in (a, b))
    try:
        with np.errstate(invalid="ignore"):  # models that run away there separate nothing
            nats = _expected(problem, option.group, *pair)
    except NOT_COMPUTED:
        return 0.0
    return nats if np.isfinite(nats) else 0.0


def _expected(problem: Problem, group: Group, a: Fit, b: Fit) -> float:
    """``_separation`` of models of which there is no record yet."""
    by_a, by_b = (predict(x.model, group, problem.sampling) for x in (a, b))
    here = replace(problem, groups=(group,))
    weighted = [make_weights(here, [x], 0.0) for x in (by_a, by_b)]
    falls = []
    for fit, own, other, weights in ((a, by_a, by_b, weighted[0]), (b, by_b, by_a, weighted[1])):
        change = group.observe(other.U - own.U)
        H, moment = jacobian(here, fit.model, group, own).normal(weights.whiten[0], change)
        known = fit.information + H
        size = np.sqrt(np.maximum(np.diag(known), 1e-30))
        step = np.linalg.pinv(known / np.outer(size, size), rcond=1e-12, hermitian=True) @ (moment / size)
        left = np.sum(np.abs(weights.apply(0, change)) ** 2) - (moment / size) @ step
        falls.append(0.5 * float(left))
    return float(np.min(falls))


def _plan(problem: Problem, option: _Option) -> Plan:
    """Multisines at the operating point: the level in question, and smaller ones to compare with."""
    group, structure = option.group, problem.structure
    par = Parameters.nominal(structure.robot)
    lin = linearise(structure, equilibrium(structure, par, group.posture))
    rate = 1.0 / problem.sampling.sample_time
    band = group.omega[[1, group.n_compared - 1]] / 2 / np.pi
    return make_plan(
        structure.robot,
        points=1,
        validation_points=0,
        levels=tuple(float(share * group.amplitude.max()) for share in LEVELS),
        sample_rate=rate,
        period=problem.samples(group),
        band_hz=(float(band[0]), float(min(band[1], 0.45 * rate))),
        postures=group.posture[None],
        trajectory=False,
        **motor_loads(structure, par, [lin]),
    )


def advice(causes: Sequence[Cause], unknown: bool, axes: int) -> str | None:
    """What to measure where no experiment was computed: by the names of the causes alone.

    Args:
        axes: of the robot; a single one has positions, and no postures that change what it carries.
    """
    postures, load = ("two more postures", "load") if axes > 1 else ("two more positions of the axis", "position")
    for cause in causes:
        if cause.probability < 0.9 and cause.alternatives:
            other = cause.alternatives[0]
            what = ADVICE.get(frozenset({cause.effect, other.effect}), f"{postures} and a second level of amplitude")
            own = "" if cause.joint == other.joint else f" at {cause.joint}"
            return f"To tell {cause.effect}{own} from {other.effect} at {other.joint}: {what}."
    if unknown:
        return (
            f"Two more levels of amplitude and {postures}, to see how the unknown cause scales with motion and {load}."
        )
    return None
