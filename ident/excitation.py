"""Experiments: random-phase multisines, operating points, plans.

Random-phase odd multisines with a random detection grid (Pintelon and Schoukens 2012), orthogonal
over the n_u experiments of a realization (Dobrowiecki, Schoukens and Guillaume 2006):
``R(k) = D_phi(k) T D_r(k)`` with the unitary DFT matrix ``T``, so that ``R R^H`` is diagonal.
"""

from __future__ import annotations

import os
import tempfile
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import tomlkit
from scipy.interpolate import CubicSpline

from robot_assets.errors import DataError
from robot_assets.robot import ASSETS, Robot, load_robot
from robot_assets.values import choice, number, read_toml, tables, text, vector, whole

DRAWS = 100  # random phases tried for the lowest crest factor
MOTION = 0.010  # rad rms, motor motion aimed at for level 1
TORQUE_SHARE = 0.6  # of the torque limit that gravity and excitation may take together
SPEED_SHARE = 0.5  # of the velocity limit
PLAN_FORMAT = "simgap-plan/1"
INJECTIONS = ("torque", "position")
GRIDS = ("detection", "odd", "all")
ROLES = ("identification", "validation")
MOST_NUMBERS = 2 * 10**8  # of all samples of a channel: beyond, a plan does not fit into memory
STRIDE = 10  # of the samples of a motion in a plan's file; the rest by cubic splines


@dataclass(frozen=True)
class Excitation:
    """Grid of a multisine.

    Attributes:
        sample_rate: Hz. period: samples. periods: recorded. transient_periods: to be discarded.
        lines: (F,) excited DFT lines. detection: lines of the odd grid left out on purpose.
    """

    sample_rate: float
    period: int
    periods: int
    transient_periods: int
    lines: np.ndarray
    detection: np.ndarray

    @property
    def frequency(self) -> np.ndarray:
        """(F,) Hz."""
        return self.lines * self.sample_rate / self.period


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


def odd_random_grid(
    rng: np.random.Generator,
    period: int,
    sample_rate: float,
    band_hz: tuple[float, float],
    group: int = 4,
    per_decade: int | None = None,
) -> tuple[np.ndarray, np.ndarray]:
    """Odd lines of a band, one of every ``group`` left out at random: (excited, detection).

    Args:
        per_decade: about so many lines a decade, log-spaced and rounded to odd lines; all odd
            lines where None.
    """
    low, high = (f * period / sample_rate for f in band_hz)
    low, high = int(np.ceil(low - 1e-9)), int(np.floor(high + 1e-9))
    odd = np.arange(low | 1, high + 1, 2)
    if per_decade is not None and len(odd):
        wanted = np.geomspace(odd[0], odd[-1], max(2, round(per_decade * np.log10(odd[-1] / odd[0])) + 1))
        odd = np.unique(2 * (wanted.astype(int) // 2) + 1)
    n_groups = len(odd) // group
    left_out = np.arange(n_groups) * group + rng.integers(group, size=n_groups)
    return np.delete(odd, left_out), odd[left_out]


def orthogonal_multisines(
    rng: np.random.Generator, lines: np.ndarray, amplitudes: np.ndarray, period: int, draws: int = DRAWS
) -> np.ndarray:
    """Signals of the n_u experiments of one realization; (n_u, period, n).

    Args:
        lines: (F,) excited lines. amplitudes: (F, n) peak amplitude of each line and input.
        draws: random phases tried; the set of lowest crest factor is kept. The phases are not
            optimised beyond that, so that they stay random (theory.md 3.2).
    """
    n = amplitudes.shape[1]
    k = np.arange(n)
    T = np.exp(2j * np.pi * np.outer(k, k) / n) / np.sqrt(n)
    best, best_crest = np.empty((n, period, n)), np.inf
    for _ in range(max(1, draws // n)):
        phase_in = np.exp(2j * np.pi * rng.random((len(lines), n, 1)))
        phase_exp = np.exp(2j * np.pi * rng.random((len(lines), 1, n)))
        R = phase_in * T * phase_exp * amplitudes[:, :, None] * np.sqrt(n)
        X = np.zeros((n, period // 2 + 1, n), complex)
        X[:, lines] = 0.5 * R.transpose(2, 0, 1)
        r = np.fft.irfft(X, n=period, axis=1, norm="forward")
        crest = (np.abs(r).max(axis=1) / np.maximum(r.std(axis=1), 1e-300)).max()
        if crest < best_crest:
            best, best_crest = r, crest
    return best


def crest_factor(r: np.ndarray) -> float:
    """Largest peak over rms of the columns of (..., period, n)."""
    return float((np.abs(r).max(axis=-2) / r.std(axis=-2)).max())


def operating_points(
    robot: Robot, count: int, rng: np.random.Generator, effective_inertia: np.ndarray | None = None
) -> np.ndarray:
    """Postures spread over the joint range, (count, n) rad.

    The middle 60 % of each range, at most +-1.6 rad about its centre, filled by a latin hypercube.
    """
    center = 0.5 * (robot.q_min + robot.q_max)
    half = np.minimum(0.3 * (robot.q_max - robot.q_min), 1.6)
    cells = np.stack([rng.permutation(count) for _ in range(robot.n)], axis=1)
    return center + half * (2 * (cells + rng.random((count, robot.n))) / count - 1)


def shape_amplitudes(
    robot: Robot, frequency: np.ndarray, inertia: np.ndarray, injection: str, headroom: np.ndarray
) -> np.ndarray:
    """Amplitudes (F, n) of lines: torque that moves every motor alike up to a corner, then falls.

    Scaled so that the predicted motor motion is ``MOTION`` rad rms and speed and torque stay
    within their shares of the limits.

    Args:
        inertia: (n,) kg m2 that a motor moves, its own included.
        headroom: (n,) N m of the torque limit left over by gravity.
    """
    w = 2 * np.pi * frequency[:, None]
    corner = 2 * np.pi * 6.0
    shape = np.ones((len(frequency), robot.n)) / np.sqrt(1 + (w / corner) ** 2)
    if injection == "position":
        shape = shape / (1 + (w / corner) ** 2)
        size = MOTION / np.sqrt(0.5 * np.sum(shape**2, axis=0))
        return shape * size
    # Torque to motion of the loop: its stiffness below the corner, the inertia above.
    motion = shape / (inertia * np.hypot(w**2, (2 * np.pi * LOOP_HZ) ** 2))
    size = MOTION / np.sqrt(0.5 * np.sum(motion**2, axis=0))
    rms = size * np.sqrt(0.5 * np.sum(shape**2, axis=0))
    size = size * np.minimum(1.0, headroom / (3.5 * rms))
    speed = size * np.sqrt(0.5 * np.sum((motion * w) ** 2, axis=0))
    size = size * np.minimum(1.0, SPEED_SHARE * robot.array("velocity_limit") / (3.5 * speed))
    return shape * size


LOOP_HZ = 2.5  # bandwidth assumed of the position loop that holds a posture


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
    _check_size(runs * (experiments or robot.n) * period * periods, robot, "plan")
    if points < 1 or realizations < 1 or periods <= transient_periods or period < 64:
        raise DataError("plan", "points, realizations, periods, period", "a number too small", "at least one of each, and a steady period")
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
        raise DataError("band_hz", "plan", str(band_hz), f"a band that holds odd multiples of {sample_rate / period:g} Hz")
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


def plan_to_toml(plan: Plan, path: str | Path) -> None:
    """Write a plan: spectra of the excitation on its lines, motions by every ``STRIDE``-th sample."""
    x, target = plan.excitation, Path(path).absolute()
    experiments = []
    for e in plan.experiments:
        R = np.fft.rfft(e.r, axis=0, norm="forward")[x.lines]
        entry = {"operating_point": e.operating_point, "role": e.role, "q0": e.q0.tolist()}
        entry |= {"experiment": e.experiment, "realization": e.realization, "amplitude": float(e.amplitude)}
        experiments.append(entry | {"real": R.real.round(12).tolist(), "imag": R.imag.round(12).tolist()})
    motions = []
    for m in plan.trajectories:
        points = m.q_ref[_knots(len(m.q_ref))].round(12).tolist()
        motions.append({"name": m.name, "role": m.role, "samples": len(m.q_ref), "q_ref": points})
    known = plan.robot.folder.parent == ASSETS.resolve()
    head = {
        "format": PLAN_FORMAT,
        "robot": plan.robot.folder.name if known else str(plan.robot.folder),
        "injection": plan.injection,
        "seed": plan.seed,
        "sample_rate": float(x.sample_rate),
        "period": x.period,
        "periods": x.periods,
        "transient_periods": x.transient_periods,
        "lines": x.lines.tolist(),
        "detection": x.detection.tolist(),
        "trajectory": motions,
        "experiment": experiments,
    }
    content = tomlkit.dumps(head)
    target.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.NamedTemporaryFile("w", dir=target.parent, prefix=f".{target.name}-", delete=False, encoding="utf-8") as file:
        file.write(content)
    os.chmod(file.name, 0o644)
    os.replace(file.name, target)


def plan_from_toml(path: str | Path) -> Plan:
    """Read a plan.

    Raises:
        DataError: where the file is missing or is no plan.
    """
    where = str(path)
    head = read_toml(Path(path), "plan")
    choice(head, "format", where, (PLAN_FORMAT,))
    robot = load_robot(text(head, "robot", where), Path(path).parent)
    period = whole(head, "period", where, low=4, high=10**7)
    periods = whole(head, "periods", where, low=1, high=10**4)
    x = Excitation(
        number(head, "sample_rate", where, low=1e-3, high=1e7),
        period,
        periods,
        whole(head, "transient_periods", where, low=0, high=periods - 1),
        _lines(head, "lines", period, where),
        _lines(head, "detection", period, where),
    )
    entries, motions = tables(head, "experiment", where), tables(head, "trajectory", where)
    if not entries and not motions:
        raise DataError("[[experiment]]", where, "none, and no [[trajectory]]", "at least one to run")
    samples = len(entries) * period * periods + sum(whole(m, "samples", where, low=2 * STRIDE, high=10**7) for m in motions)
    _check_size(samples, robot, where)
    experiments = tuple(_experiment(e, x, robot, where) for e in entries)
    trajectories = tuple(_trajectory(m, robot, where) for m in motions)
    names = [*(e.name for e in experiments), *(m.name for m in trajectories)]
    if len(set(names)) < len(names):
        double = next(name for k, name in enumerate(names) if name in names[:k])
        raise DataError("[[experiment]]", where, f"{double} twice", "each experiment once")
    return Plan(
        robot=robot,
        excitation=x,
        experiments=experiments,
        trajectories=trajectories,
        injection=choice(head, "injection", where, INJECTIONS),
        seed=whole(head, "seed", where, low=0),
    )


def _check_size(samples: int, robot: Robot, where: str) -> None:
    if samples * robot.n > MOST_NUMBERS:
        raise DataError("plan", where, f"{samples:.3g} samples of {robot.n} joints", f"at most {MOST_NUMBERS:g} numbers")


def _knots(samples: int) -> np.ndarray:
    """Samples of a motion that are written: every ``STRIDE``-th and the last."""
    return np.unique(np.append(np.arange(0, samples, STRIDE), samples - 1))


def _lines(head: dict, key: str, period: int, where: str) -> np.ndarray:
    lines = head.get(key)
    if not isinstance(lines, list) or not all(isinstance(k, int) and 0 < k < period / 2 for k in lines):
        raise DataError(key, where, repr(lines), f"a list of lines from 1 to below Nyquist, {period / 2:g}")
    return np.asarray(lines, int)


def _experiment(entry: dict, x: Excitation, robot: Robot, where: str) -> Experiment:
    X = np.zeros((x.period // 2 + 1, robot.n), complex)
    for key, unit in (("real", 1.0), ("imag", 1j)):
        X[x.lines] += unit * _rows(entry, key, len(x.lines), robot.n, where)
    return Experiment(
        operating_point=_file_name(entry, "operating_point", where),
        q0=vector(entry.get("q0"), "q0", where, robot.n),
        experiment=whole(entry, "experiment", where, low=1),
        realization=whole(entry, "realization", where, low=1),
        amplitude=number(entry, "amplitude", where, low=1e-9, high=1e9),
        role=choice(entry, "role", where, ROLES),
        r=np.fft.irfft(X, n=x.period, axis=0, norm="forward"),
    )


def _file_name(entry: dict, key: str, where: str) -> str:
    """A text that can begin the name of a file."""
    value = text(entry, key, where)
    if not value.isprintable() or "/" in value or "\\" in value or len(value) > 50:
        raise DataError(key, where, ascii(value), "a name of at most 50 letters, without slashes")
    return value


def _trajectory(entry: dict, robot: Robot, where: str) -> Trajectory:
    samples = whole(entry, "samples", where, low=2 * STRIDE, high=10**7)
    at = _knots(samples)
    points = _rows(entry, "q_ref", len(at), robot.n, where)
    motion = CubicSpline(at, points)(np.arange(samples))
    return Trajectory(_file_name(entry, "name", where), motion, choice(entry, "role", where, ROLES))


def _rows(entry: dict, key: str, count: int, n: int, where: str) -> np.ndarray:
    rows = entry.get(key)
    if not isinstance(rows, list) or len(rows) != count:
        found = f"{len(rows)} rows" if isinstance(rows, list) else "no such key"
        raise DataError(key, where, found, f"{count} rows of {n} numbers")
    return np.array([vector(row, key, where, n) for row in rows]).reshape(count, n)
