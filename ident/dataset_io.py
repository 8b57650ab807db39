"""Reading, checking and writing of dataset folders (format 1)."""

from __future__ import annotations

import os
import shutil
import tempfile
import tomllib
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.csv
import pyarrow.parquet as pq
import tomlkit

from ident.dataset import Dataset, Segment
from robot_assets.errors import DataError
from robot_assets.robot import Robot, load_robot

FORMAT = "simgap-dataset/1"
KINDS = ("multisine", "trajectory")
ROLES = ("identification", "validation")
CHANNELS = ("tau", "q", "qd", "r", "q_ref", "q_link", "temp")
REQUIRED = ("tau", "q")
TIME_TOLERANCE = 0.05  # of a sample period, on every step of `t`
LARGEST = 1e12  # SI; anything above is no angle, torque or time
MAX_SEGMENTS = 100_000


def load_dataset(path: str | Path) -> Dataset:
    """Read and check a dataset folder.

    Raises:
        DataError: with the file, the key or column, what was found and what was expected.
    """
    folder = Path(path)
    toml = folder / "dataset.toml" if folder.is_dir() else folder
    if not toml.is_file():
        raise DataError("dataset", str(path), "no dataset.toml", "a dataset folder")
    folder = toml.parent
    try:
        head = tomllib.loads(toml.read_text(encoding="utf-8"))
    except UnicodeDecodeError as err:
        raise DataError("dataset.toml", str(toml), "bytes that are no UTF-8", "UTF-8 text") from err
    except (tomllib.TOMLDecodeError, RecursionError) as err:
        raise DataError("dataset.toml", str(toml), f"invalid TOML ({err})", "valid TOML") from err
    where = str(toml)
    if head.get("format") != FORMAT:
        raise DataError("format", where, repr(head.get("format")), repr(FORMAT))
    rate = _number(head, "sample_rate", where, low=1e-3, high=1e7)
    joints = head.get("joints")
    if not isinstance(joints, list) or not joints or not all(isinstance(j, str) for j in joints):
        raise DataError("joints", where, repr(joints)[:80], "a list of joint names")
    if len(set(joints)) < len(joints):
        raise DataError("joints", where, "a name twice", "distinct names")
    robot = match_joints(load_robot(_text(head, "robot", where), folder), joints, where)
    hold = head.get("input_hold", "zoh")
    if hold not in ("zoh", "none"):
        raise DataError("input_hold", where, repr(hold), '"zoh" or "none"')
    noise = head.get("noise", {})
    if not isinstance(noise, dict):
        raise DataError("[noise]", where, repr(noise), "a table")
    entries = head.get("segment", [])
    if not isinstance(entries, list) or not entries or not all(isinstance(e, dict) for e in entries):
        raise DataError("[[segment]]", where, "none", "at least one segment")
    if len(entries) > MAX_SEGMENTS:
        raise DataError("[[segment]]", where, f"{len(entries)} entries", f"at most {MAX_SEGMENTS}")
    seen: set[str] = set()
    segments = []
    for i, entry in enumerate(entries):
        segments.append(_segment(entry, i, folder, toml, len(joints), rate, seen))
    return Dataset(
        name=str(head.get("name", folder.resolve().name)),
        robot_ref=str(head["robot"]),
        robot=robot,
        sample_rate=rate,
        joints=tuple(joints),
        input_hold=hold,
        q_std=_std(noise, "q_std", len(joints), where),
        tau_std=_std(noise, "tau_std", len(joints), where),
        controller=head.get("controller"),
        segments=tuple(segments),
        path=folder,
    )


def match_joints(robot: Robot, joints: list[str], where: str) -> Robot:
    """The robot with its driven joints in the order of a dataset's columns."""
    by_name = {j.name: j for j in robot.joints}
    for name in joints:
        if name not in by_name:
            raise DataError("joints", where, name, f"joints of {robot.name}: {list(by_name)}")
    missing = [name for name in by_name if name not in joints]
    if missing:
        raise DataError("joints", where, f"no {missing[0]}", f"every driven joint of {robot.name}: {list(by_name)}")
    order = [robot.joint_names.index(name) for name in joints]
    return replace(
        robot,
        joints=tuple(robot.joints[i] for i in order),
        q_min=robot.q_min[order],
        q_max=robot.q_max[order],
    )


def save_dataset(dataset: Dataset, path: str | Path) -> None:
    """Write a dataset folder: beside the target first, then moved into place.

    Raises:
        DataError: where the target exists and is no dataset folder.
    """
    target = Path(path)
    if target.exists() and not (target / "dataset.toml").is_file() and (not target.is_dir() or any(target.iterdir())):
        raise DataError("output", str(path), "a file or folder that is no dataset", "a new folder or a dataset")
    target.parent.mkdir(parents=True, exist_ok=True)
    beside = Path(tempfile.mkdtemp(prefix=f".{target.name}-", dir=target.parent))
    try:
        for segment in dataset.segments:
            pq.write_table(_table(segment), beside / f"{segment.name}.parquet", compression="zstd")
        (beside / "dataset.toml").write_text(tomlkit.dumps(_head(dataset)), encoding="utf-8")
        os.chmod(beside, 0o755)
        if target.exists():
            old = Path(tempfile.mkdtemp(prefix=f".{target.name}-old-", dir=target.parent))
            target.rename(old / "d")
            beside.rename(target)
            shutil.rmtree(old)
        else:
            beside.rename(target)
    finally:
        if beside.exists():
            shutil.rmtree(beside)


def _head(dataset: Dataset) -> dict[str, Any]:
    head: dict[str, Any] = {
        "format": FORMAT,
        "name": dataset.name,
        "robot": dataset.robot_ref,
        "sample_rate": float(dataset.sample_rate),
        "joints": list(dataset.joints),
        "input_hold": dataset.input_hold,
    }
    noise = {}
    for key in ("q_std", "tau_std"):
        value = getattr(dataset, key)
        if value is not None:
            noise[key] = [float(v) for v in value]
    if noise:
        head["noise"] = noise
    if dataset.controller:
        head["controller"] = dataset.controller
    entries = []
    for s in dataset.segments:
        entry: dict[str, Any] = {"file": f"{s.name}.parquet", "kind": s.kind, "role": s.role}
        if s.operating_point is not None:
            entry["operating_point"] = s.operating_point
        if s.q0 is not None:
            entry["q0"] = [float(v) for v in s.q0]
        if s.kind == "multisine":
            entry |= {"period": s.period, "periods": s.periods, "transient_periods": s.transient_periods}
            entry |= {k: getattr(s, k) for k in ("experiment", "realization") if getattr(s, k) is not None}
            entry["amplitude"] = float(s.amplitude)
            entry["excited_lines"] = [int(k) for k in s.excited_lines]
        entries.append(entry)
    head["segment"] = entries
    return head


def _table(segment: Segment) -> pa.Table:
    columns: dict[str, np.ndarray] = {"t": segment.t}
    for channel in CHANNELS:
        x = getattr(segment, channel)
        if x is not None:
            columns |= {f"{channel}_{j + 1}": x[:, j] for j in range(x.shape[1])}
    return pa.table({k: np.ascontiguousarray(v, float) for k, v in columns.items()})


def _segment(
    entry: dict, i: int, folder: Path, toml: Path, n: int, rate: float, seen: set[str]
) -> Segment:
    where = f"{toml} segment {i + 1}"
    file = _text(entry, "file", where)
    pure = Path(file)
    if pure.is_absolute() or ".." in pure.parts or "\x00" in file or "\\" in file:
        raise DataError("file", where, repr(file), "a file inside the dataset folder")
    path = folder / pure
    if not path.resolve().is_relative_to(folder.resolve()):
        raise DataError("file", where, f"{file} (a link to outside)", "a file inside the dataset folder")
    if file in seen:
        raise DataError("file", where, f"{file} a second time", "each segment once")
    seen.add(file)
    kind = entry.get("kind")
    if kind not in KINDS:
        raise DataError("kind", where, repr(kind), f"one of {KINDS}")
    role = entry.get("role", "identification")
    if role not in ROLES:
        raise DataError("role", where, repr(role), f"one of {ROLES}")
    columns = _read(path, where)
    t = _column(columns, "t", path)
    if len(t) < 16:
        raise DataError("column t", str(path), f"{len(t)} samples", "at least 16")
    _check_time(t, rate, path)
    data = {channel: _channel(columns, channel, n, path) for channel in CHANNELS}
    q0 = entry.get("q0")
    if q0 is not None:
        q0 = _vector(q0, "q0", where, n)
    common = dict(
        name=pure.with_suffix("").as_posix().replace("/", "-"),
        kind=kind,
        role=role,
        t=t,
        q0=q0,
        operating_point=None if "operating_point" not in entry else str(entry["operating_point"]),
        amplitude=_number(entry, "amplitude", where, low=1e-9, high=1e9, default=1.0),
        **data,
    )
    if kind == "trajectory":
        return Segment(**common)
    if common["operating_point"] is None:
        raise DataError("operating_point", where, "none", "the name of the multisine's posture")
    period = _integer(entry, "period", where, low=4)
    periods = _integer(entry, "periods", where, low=1)
    transient = _integer(entry, "transient_periods", where, low=0, default=0)
    if transient >= periods:
        raise DataError("transient_periods", where, str(transient), f"less than periods = {periods}")
    if len(t) != period * periods:
        raise DataError("samples", str(path), f"{len(t)}", f"period * periods = {period} * {periods} = {period * periods}")
    lines = entry.get("excited_lines", [])
    if not isinstance(lines, list) or not all(isinstance(k, int) and not isinstance(k, bool) for k in lines):
        raise DataError("excited_lines", where, repr(lines)[:60], "a list of whole numbers")
    for k in lines:
        if not 1 <= k < period / 2:
            raise DataError("excited_lines", where, f"line {k}", f"lines from 1 to below Nyquist, {period / 2:g}")
    return Segment(
        **common,
        period=period,
        periods=periods,
        transient_periods=transient,
        experiment=_integer(entry, "experiment", where, low=1, default=None),
        realization=_integer(entry, "realization", where, low=1, default=None),
        excited_lines=np.unique(np.asarray(lines, int)),
    )


def _read(path: Path, where: str) -> dict[str, np.ndarray]:
    if not path.is_file():
        raise DataError("file", where, f"no {path.name}", "an existing Parquet or CSV file")
    try:
        if path.suffix.lower() == ".csv":
            table = pa.csv.read_csv(path)
        elif path.suffix.lower() == ".parquet":
            table = pq.read_table(path, partitioning=None)
        else:
            raise DataError("file", where, path.name, "a .parquet or .csv file")
    except (pa.ArrowException, OSError, ValueError) as err:
        reason = str(err).splitlines()[0][:160] if str(err) else type(err).__name__
        raise DataError("file", str(path), f"unreadable ({reason})", "a complete Parquet or CSV file") from err
    names = table.column_names
    double = sorted({c for c in names if names.count(c) > 1})
    if double:
        raise DataError(f"column {double[0]}", str(path), "it twice", "each column once")
    wanted = [c for c in names if c == "t" or c.rsplit("_", 1)[0] in CHANNELS]
    out = {}
    for name in wanted:
        column = table.column(name)
        if not (pa.types.is_floating(column.type) or pa.types.is_integer(column.type)):
            raise DataError(f"column {name}", str(path), f"type {column.type}", "numbers")
        out[name] = np.asarray(column.to_numpy(), float)
    return out


def _column(columns: dict[str, np.ndarray], name: str, path: Path) -> np.ndarray:
    if name not in columns:
        raise DataError(f"column {name}", str(path), "no such column", "a required column")
    x = columns[name]
    bad = np.flatnonzero(~np.isfinite(x))
    if len(bad):
        kind = "NaN" if np.isnan(x[bad[0]]) else "infinity"
        raise DataError(
            f"column {name}", str(path), f"{kind} at sample {bad[0]} ({len(bad)} not finite in all)", "finite numbers"
        )
    if len(x) and np.abs(x).max() > LARGEST:
        k = int(np.argmax(np.abs(x)))
        raise DataError(f"column {name}", str(path), f"{x[k]:.3g} at sample {k}", f"at most {LARGEST:g} in SI units")
    return x


def _channel(columns: dict[str, np.ndarray], channel: str, n: int, path: Path) -> np.ndarray | None:
    """(N, n) of a channel; a partly given link encoder has NaN where a joint has none."""
    present = [j for j in range(n) if f"{channel}_{j + 1}" in columns]
    if not present and channel not in REQUIRED:
        return None
    if len(present) < n and channel != "q_link":
        missing = next(j for j in range(n) if j not in present)
        raise DataError(f"column {channel}_{missing + 1}", str(path), "no such column", f"{channel}_1 to {channel}_{n}")
    surplus = [c for c in columns if c.startswith(f"{channel}_") and c[len(channel) + 1 :].isdigit() and int(c[len(channel) + 1 :]) > n]
    if surplus:
        raise DataError(f"column {surplus[0]}", str(path), "a column beyond the joints", f"{channel}_1 to {channel}_{n}")
    out = np.full((len(columns["t"]), n), np.nan)
    for j in present:
        out[:, j] = _column(columns, f"{channel}_{j + 1}", path)
    return out


def _check_time(t: np.ndarray, rate: float, path: Path) -> None:
    step = np.diff(t)
    bad = np.flatnonzero(np.abs(step * rate - 1.0) > TIME_TOLERANCE)
    if len(bad) > 0.5 * len(step):
        raise DataError("column t", str(path), f"a rate of {1 / np.median(step):.6g} Hz" if np.median(step) else "no rate", f"sample_rate = {rate:g} Hz")
    if len(bad):
        k = int(bad[0])
        raise DataError(
            "column t", str(path), f"a step of {step[k]:.6g} s at sample {k} ({len(bad)} such)", f"uniform steps of {1 / rate:.6g} s"
        )
    if abs((t[-1] - t[0]) * rate / (len(t) - 1) - 1.0) > 1e-3:
        raise DataError("column t", str(path), f"a mean rate of {(len(t) - 1) / (t[-1] - t[0]):.6g} Hz", f"sample_rate = {rate:g} Hz")


def _text(entry: dict, key: str, where: str) -> str:
    value = entry.get(key)
    if not isinstance(value, str) or not value:
        raise DataError(key, where, repr(value), "a text")
    return value


_MISSING = object()


def _number(entry: dict, key: str, where: str, *, low: float, high: float, default: Any = _MISSING) -> float:
    value = entry.get(key, default)
    if isinstance(value, bool) or not isinstance(value, int | float) or not low <= value <= high:
        found = "no such key" if value is _MISSING else repr(value)
        raise DataError(key, where, found, f"a number from {low:g} to {high:g}")
    return float(value)


def _integer(entry: dict, key: str, where: str, *, low: int, default: Any = _MISSING) -> Any:
    value = entry.get(key, default)
    if value is default and default is not _MISSING:
        return value
    if isinstance(value, bool) or not isinstance(value, int) or value < low:
        found = "no such key" if value is _MISSING else repr(value)
        raise DataError(key, where, found, f"a whole number of at least {low}")
    return value


def _vector(value: Any, key: str, where: str, n: int) -> np.ndarray:
    try:
        out = np.asarray(value, float)
    except (TypeError, ValueError):
        out = np.empty(0)
    if out.shape != (n,) or not np.all(np.isfinite(out)) or np.any(np.abs(out) > LARGEST):
        raise DataError(key, where, repr(value)[:80], f"{n} finite numbers, one per joint")
    return out


def _std(noise: dict, key: str, n: int, where: str) -> np.ndarray | None:
    if key not in noise:
        return None
    out = _vector(noise[key], f"noise.{key}", where, n)
    if np.any(out < 0):
        raise DataError(f"noise.{key}", where, repr(noise[key]), "standard deviations of at least zero")
    return out
