"""Experiments: random-phase multisines, operating points, plans.

Random-phase odd multisines with a random detection grid (Pintelon and Schoukens 2012), orthogonal
over the n_u experiments of a realization (Dobrowiecki, Schoukens and Guillaume 2006):
``R(k) = D_phi(k) T D_r(k)`` with the unitary DFT matrix ``T``, so that ``R R^H`` is diagonal.
"""

from __future__ import annotations

import tomllib
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import tomlkit

from robot_assets.errors import DataError
from robot_assets.robot import Robot, load_robot

DRAWS = 100  # random phases tried for the lowest crest factor
MOTION = 0.010  # rad rms, motor motion aimed at for level 1
TORQUE_SHARE = 0.6  # of the torque limit that gravity and excitation may take together
SPEED_SHARE = 0.5  # of the velocity limit


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


def odd_random_grid(
    rng: np.random.Generator, period: int, sample_rate: float, band_hz: tuple[float, float], group: int = 4
) -> tuple[np.ndarray, np.ndarray]:
    """Odd lines of a band, one of every ``group`` left out at random: (excited, detection)."""
    low, high = (int(np.ceil(f * period / sample_rate)) for f in band_hz)
    odd = np.arange(low | 1, high + 1, 2)
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
    best, best_crest = None, np.inf
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
    seed: int = 0,
    sample_rate: float = 1000.0,
    period: int = 4000,
    periods: int = 3,
    transient_periods: int = 1,
    band_hz: tuple[float, float] = (0.4, 70.0),
    injection: str = "torque",
    postures: np.ndarray | None = None,
    inertia: np.ndarray | None = None,
    gravity_torque: np.ndarray | None = None,
    trajectory: bool = True,
) -> Plan:
    """Multisines at operating points, and held-out segments.

    Every identification point is measured at one level of ``levels`` in turn when there are at
    least as many points as levels; with fewer points every point is measured at every level.

    Args:
        inertia: (n,) kg m2 that each motor moves; three times its own where None.
        gravity_torque: (n,) largest static torque in the postures, N m.

    Raises:
        DataError: where a number cannot be used.
    """
    if injection not in ("torque", "position"):
        raise DataError("injection", "plan", repr(injection), '"torque" or "position"')
    if points < 1 or realizations < 1 or periods <= transient_periods or period < 64:
        raise DataError("plan", "points, realizations, periods, period", "a number too small", "at least one of each, and a steady period")
    if not 0 < band_hz[0] < band_hz[1] < 0.5 * sample_rate:
        raise DataError("band_hz", "plan", str(band_hz), f"rising, below Nyquist {0.5 * sample_rate:g} Hz")
    rng = np.random.default_rng(seed)
    lines, detection = odd_random_grid(rng, period, sample_rate, band_hz)
    excitation = Excitation(sample_rate, period, periods, transient_periods, lines, detection)
    if postures is None:
        postures = operating_points(robot, points + validation_points, rng)
    inertia = 3.0 * robot.array("motor_inertia") if inertia is None else inertia
    gravity = np.zeros(robot.n) if gravity_torque is None else np.abs(gravity_torque)
    headroom = np.maximum(TORQUE_SHARE * robot.array("torque_limit") - gravity, 0.1 * robot.array("torque_limit"))
    amplitudes = shape_amplitudes(robot, excitation.frequency, inertia, injection, headroom)
    experiments = []
    for i, q0 in enumerate(postures):
        held_out = i >= len(postures) - validation_points
        role = "validation" if held_out else "identification"
        for m in range(realizations):
            r = orthogonal_multisines(rng, lines, amplitudes, period)
            for level in levels if not held_out else (levels[0],):
                for e in range(robot.n):
                    experiments.append(
                        Experiment(f"op{i + 1:02d}", np.asarray(q0, float), e + 1, m + 1, level, role, level * r[e])
                    )
    moves = (_validation_motion(robot, postures, rng, sample_rate),) if trajectory else ()
    return Plan(robot, excitation, tuple(experiments), moves, injection, seed)


def _validation_motion(robot: Robot, postures: np.ndarray, rng: np.random.Generator, rate: float) -> Trajectory:
    """A motion through three postures near the first, by fifth-order polynomials with rests."""
    first = postures[0]
    stops = [first]
    for _ in range(3):
        stops.append(first + rng.uniform(-0.35, 0.35, robot.n))
    stops.append(first)
    pieces = [np.repeat(first[None], int(0.5 * rate), axis=0)]
    for a, b in zip(stops[:-1], stops[1:], strict=True):
        duration = max(1.2, float(np.max(1.9 * np.abs(b - a) / (SPEED_SHARE * robot.array("velocity_limit")))))
        u = np.linspace(0, 1, int(duration * rate), endpoint=False)[:, None]
        pieces.append(a + (b - a) * (10 * u**3 - 15 * u**4 + 6 * u**5))
        pieces.append(np.repeat(b[None], int(0.3 * rate), axis=0))
    return Trajectory("motion-1", np.concatenate(pieces), "validation")


def plan_to_toml(plan: Plan, path: str | Path) -> None:
    """Write a plan; the excitation signals are drawn anew from its phases when it is read."""
    x = plan.excitation
    spectra = []
    for e in plan.experiments:
        R = np.fft.rfft(e.r, axis=0, norm="forward")[x.lines]
        spectra.append(
            {
                "operating_point": e.operating_point,
                "q0": e.q0.tolist(),
                "experiment": e.experiment,
                "realization": e.realization,
                "amplitude": e.amplitude,
                "role": e.role,
                "real": R.real.round(12).tolist(),
                "imag": R.imag.round(12).tolist(),
            }
        )
    head = {
        "format": "simgap-plan/1",
        "robot": plan.robot.name if (Path(__file__).parent.parent / "robot_assets" / plan.robot.name).is_dir() else str(plan.robot.folder),
        "injection": plan.injection,
        "seed": plan.seed,
        "sample_rate": x.sample_rate,
        "period": x.period,
        "periods": x.periods,
        "transient_periods": x.transient_periods,
        "lines": x.lines.tolist(),
        "detection": x.detection.tolist(),
        "trajectory": [{"name": t.name, "role": t.role, "q_ref": t.q_ref[::10].round(9).tolist(), "stride": 10, "samples": len(t.q_ref)} for t in plan.trajectories],
        "experiment": spectra,
    }
    Path(path).write_text(tomlkit.dumps(head), encoding="utf-8")


def plan_from_toml(path: str | Path) -> Plan:
    """Read a plan.

    Raises:
        DataError: where the file is missing or is no plan.
    """
    try:
        head = tomllib.loads(Path(path).read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError, tomllib.TOMLDecodeError) as err:
        raise DataError("plan", str(path), str(err), "a readable plan") from err
    if head.get("format") != "simgap-plan/1":
        raise DataError("format", str(path), repr(head.get("format")), "'simgap-plan/1'")
    try:
        lines = np.asarray(head["lines"], int)
        x = Excitation(
            float(head["sample_rate"]), int(head["period"]), int(head["periods"]),
            int(head["transient_periods"]), lines, np.asarray(head["detection"], int),
        )
        experiments = []
        for e in head["experiment"]:
            X = np.zeros((x.period // 2 + 1, len(e["q0"])), complex)
            X[lines] = np.asarray(e["real"]) + 1j * np.asarray(e["imag"])
            r = np.fft.irfft(X, n=x.period, axis=0, norm="forward")
            experiments.append(
                Experiment(e["operating_point"], np.asarray(e["q0"], float), e["experiment"], e["realization"], e["amplitude"], e["role"], r)
            )
        moves = []
        for t in head.get("trajectory", []):
            coarse = np.asarray(t["q_ref"], float)
            at = np.arange(len(coarse)) * t["stride"]
            fine = np.stack([np.interp(np.arange(t["samples"]), at, c) for c in coarse.T], axis=1)
            moves.append(Trajectory(t["name"], fine, t["role"]))
    except (KeyError, TypeError, ValueError, IndexError) as err:
        raise DataError("plan", str(path), f"{type(err).__name__} {err}", "a complete plan") from err
    return Plan(load_robot(head["robot"], Path(path).parent), x, tuple(experiments), tuple(moves), head["injection"], int(head["seed"]))
