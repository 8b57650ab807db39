"""Plans as TOML files."""

from __future__ import annotations

import os
import tempfile
from pathlib import Path

import numpy as np
import tomlkit
from scipy.interpolate import CubicSpline

from ident.excitation import Excitation
from ident.plan import INJECTIONS, Experiment, Plan, Trajectory, check_size
from robot_assets.errors import DataError
from robot_assets.robot import Robot, load_robot, robot_reference
from robot_assets.values import choice, number, read_toml, tables, text, vector, whole

PLAN_FORMAT = "simgap-plan/1"
ROLES = ("identification", "validation")
STRIDE = 10  # of the samples of a motion in a plan's file; the rest by cubic splines


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
    head = {
        "format": PLAN_FORMAT,
        "robot": robot_reference(plan.robot, target.parent),
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
    with tempfile.NamedTemporaryFile(
        "w", dir=target.parent, prefix=f".{target.name}-", delete=False, encoding="utf-8"
    ) as file:
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
    samples = len(entries) * period * periods + sum(
        whole(m, "samples", where, low=2 * STRIDE, high=10**7) for m in motions
    )
    check_size(samples, robot, where)
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
