"""Plans: which multisines are run at which operating points, which motions, and in which order."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np

from ident.excitation import (
    SPEED_SHARE,
    TORQUE_SHARE,
    Excitation,
    odd_random_grid,
    operating_points,
    orthogonal_multisines,
    shape_amplitudes,
)
from robot_assets.errors import DataError
from robot_assets.robot import Robot

INJECTIONS = ("torque", "position")
GRIDS = ("detection", "odd", "all")
MOST_NUMBERS = 2 * 10**8  # of all samples of a channel: beyond, a plan does not fit into memory


@dataclass(frozen=True)
class Experiment:
    """One periodic experiment: ``r`` (period, n) N m added to the torque, or rad to the reference."""

    operating_point: str
    q0: np.ndarray
    experiment: int
    realization: int
    amplitude: float
    role: str
    r: np.ndarray

    @property
    def name(self) -> str:
        """Name of its segment."""
        return f"{self.operating_point}-a{self.amplitude:g}-e{self.experiment}-r{self.realization}"

    def labels(self, x: Excitation) -> dict[str, Any]:
        """What its segment says of it, run with excitation ``x``, beside the samples."""
        return dict(
            name=self.name,
            kind="multisine",
            role=self.role,
            operating_point=self.operating_point,
            q0=self.q0,
            period=x.period,
            periods=x.periods,
            transient_periods=x.transient_periods,
            experiment=self.experiment,
            realization=self.realization,
            amplitude=self.amplitude,
            excited_lines=x.lines,
        )


@dataclass(frozen=True)
class Trajectory:
    """A motion: position reference (N, n) in rad, starting and ending at rest."""

    name: str
    q_ref: np.ndarray
    role: str


@dataclass(frozen=True)
class Plan:
    """What is to be measured, and how."""

    robot: Robot
    excitation: Excitation
    experiments: tuple[Experiment, ...]
    trajectories: tuple[Trajectory, ...]
    injection: str
    seed: int


@dataclass(frozen=True)
class Part:
    """Samples ``start`` to ``stop`` of a long recording, and the experiment or motion run in them.

    Attributes:
        kind: "move", "settle", "experiment" or "trajectory".
        source: what of the plan it is; None for what only leads there.
    """

    kind: str
    start: int
    stop: int
    source: Experiment | Trajectory | None = None

    @property
    def samples(self) -> slice:
        """Of the recording."""
        return slice(self.start, self.stop)


@dataclass(frozen=True)
class Schedule:
    """A whole plan as one recording of N samples (Wernholt and Moberg 2011, Figure 1); see ``ident.cutting``.

    Attributes:
        plan: what is run. parts: one after another, without gaps.
        q_ref: (N, n) rad, posture or motion held by the loop, without the excitation.
        r: (N, n) excitation, of the plan's ``injection``; zero where none runs.
    """

    plan: Plan
    parts: tuple[Part, ...]
    q_ref: np.ndarray
    r: np.ndarray


def make_plan(
    robot: Robot,
    *,
    points: int = 4,
    validation_points: int = 1,
    realizations: int = 1,
    levels: tuple[float, ...] = (1.0, 0.5, 0.25),
    levels_per_point: int | None = None,
    seed: int = 0,
    sample_rate: float = 1000.0,
    period: int = 4000,
    periods: int = 3,
    transient_periods: int = 1,
    band_hz: tuple[float, float] = (0.4, 70.0),
    per_decade: int | None = None,
    grid: str = "detection",
    experiments: int | None = None,
    injection: str = "torque",
    postures: np.ndarray | None = None,
    inertia: np.ndarray | None = None,
    gravity_torque: np.ndarray | None = None,
    trajectory: bool = True,
) -> Plan:
    """Multisines at operating points, and held-out segments.

    Every identification point is measured with n experiments per realization and level, or as many as given, a
    held-out one at the first level alone: two points at three levels are 36 segments of a
    six-axis arm.

    Args:
        levels: relative excitation levels, the largest first.
        levels_per_point: levels measured at each point, taking turns from point to point, to
            spread a budget over more points; all of them where None.
        band_hz, per_decade: see ``odd_random_grid``.
        grid: "detection": that grid; "odd": no odd line left out; "all": every line of the band, which
            local methods want, but which lets even distortion onto the excited lines.
        experiments: of each realization and level, the first of the n orthogonal ones; n where None. One
            excites all inputs at all lines, which is enough for local methods (``ident.local_frf``).
        inertia: (n,) kg m2 that each motor moves; three times its own where None.
        gravity_torque: (n,) largest static torque in the postures, N m.

    Raises:
        DataError: where a number cannot be used.
    """
    if injection not in INJECTIONS:
        raise DataError("injection", "plan", repr(injection), f"one of {INJECTIONS}")
    runs = (points * min(levels_per_point or len(levels), len(levels)) + validation_points) * realizations
    check_size(runs * (experiments or robot.n) * period * periods, robot, "plan")
    if points < 1 or realizations < 1 or periods <= transient_periods or period < 64:
        raise DataError(
            "plan",
            "points, realizations, periods, period",
            "a number too small",
            "at least one of each, and a steady period",
        )
    if not 0 < band_hz[0] < band_hz[1] < 0.5 * sample_rate:
        raise DataError("band_hz", "plan", str(band_hz), f"rising, below Nyquist {0.5 * sample_rate:g} Hz")
    if not levels or not all(0 < level <= 1e3 for level in levels):
        raise DataError("levels", "plan", str(levels), "at least one number above zero")
    if grid not in GRIDS:
        raise DataError("grid", "plan", repr(grid), f"one of {GRIDS}")
    count = robot.n if experiments is None else experiments
    if not 1 <= count <= robot.n:
        raise DataError("experiments", "plan", str(experiments), f"1 to {robot.n}")
    rng = np.random.default_rng(seed)
    lines, detection = odd_random_grid(rng, period, sample_rate, band_hz, per_decade=per_decade)
    if grid != "detection":
        lines, detection = np.union1d(lines, detection), detection[:0]
        lines = np.arange(lines[0], lines[-1] + 1) if grid == "all" and len(lines) else lines
    if not len(lines):
        raise DataError(
            "band_hz", "plan", str(band_hz), f"a band that holds odd multiples of {sample_rate / period:g} Hz"
        )
    excitation = Excitation(sample_rate, period, periods, transient_periods, lines, detection)
    if postures is None:
        postures = operating_points(robot, points + validation_points, rng)
    inertia = 3.0 * robot.array("motor_inertia") if inertia is None else inertia
    gravity = np.zeros(robot.n) if gravity_torque is None else np.abs(gravity_torque)
    headroom = np.maximum(TORQUE_SHARE * robot.array("torque_limit") - gravity, 0.1 * robot.array("torque_limit"))
    amplitudes = shape_amplitudes(robot, excitation.frequency, inertia, injection, headroom)
    planned = []
    for i, q0 in enumerate(postures):
        held_out = i >= len(postures) - validation_points
        role = "validation" if held_out else "identification"
        for m in range(realizations):
            r = orthogonal_multisines(rng, lines, amplitudes, period)
            for level in _levels_at(i, levels, levels_per_point) if not held_out else (levels[0],):
                for e in range(count):
                    planned.append(
                        Experiment(f"op{i + 1:02d}", np.asarray(q0, float), e + 1, m + 1, level, role, level * r[e])
                    )
    moves = (_validation_motion(robot, postures, rng, sample_rate),) if trajectory else ()
    return Plan(robot, excitation, tuple(planned), moves, injection, seed)


def _levels_at(point: int, levels: tuple[float, ...], count: int | None) -> tuple[float, ...]:
    """The levels of one operating point, largest first; every level is first in its turn."""
    if count is None or count >= len(levels):
        return levels
    chosen = {(point + k) % len(levels) for k in range(max(1, count))}
    return tuple(levels[k] for k in sorted(chosen))


def _validation_motion(robot: Robot, postures: np.ndarray, rng: np.random.Generator, rate: float) -> Trajectory:
    """A motion through three postures near the first, by fifth-order polynomials with rests."""
    first = postures[0]
    margin = 0.05 * (robot.q_max - robot.q_min)
    stops = [first]
    for _ in range(3):
        stop = first + rng.uniform(-0.35, 0.35, robot.n)
        stops.append(np.clip(stop, np.minimum(first, robot.q_min + margin), np.maximum(first, robot.q_max - margin)))
    stops.append(first)
    pieces = [np.repeat(first[None], int(0.5 * rate), axis=0)]
    for a, b in pairwise(stops):
        pieces.append(point_to_point(robot, a, b, rate))
        pieces.append(np.repeat(b[None], int(0.3 * rate), axis=0))
    return Trajectory("motion-1", np.concatenate(pieces), "validation")


def point_to_point(robot: Robot, a: np.ndarray, b: np.ndarray, rate: float) -> np.ndarray:
    """(N, n) rad from ``a`` to ``b`` (n,) by a fifth-order polynomial that keeps to ``SPEED_SHARE`` of the limits."""
    duration = max(1.2, float(np.max(1.9 * np.abs(b - a) / (SPEED_SHARE * robot.array("velocity_limit")))))
    u = np.linspace(0, 1, int(duration * rate), endpoint=False)[:, None]
    return a + (b - a) * (10 * u**3 - 15 * u**4 + 6 * u**5)


def check_size(samples: int, robot: Robot, where: str) -> None:
    """Refuse a record that would not fit into memory.

    Raises:
        DataError: where ``samples`` of all joints are more than ``MOST_NUMBERS``.
    """
    if samples * robot.n > MOST_NUMBERS:
        raise DataError(
            "plan", where, f"{samples:.3g} samples of {robot.n} joints", f"at most {MOST_NUMBERS:g} numbers"
        )
