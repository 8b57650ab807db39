"""Reading, checking and writing of dataset folders (format 1)."""

from __future__ import annotations

import os
import shutil
import tempfile
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import tomlkit

from ident.dataset import CHANNELS, Dataset, Filled, Segment
from ident.format_checks import (
    HOLDS,
    KINDS,
    MAX_SEGMENTS,
    ROLES,
    amplitude,
    check_count,
    check_lines,
    checked,
    periods_of,
    sample_rate,
)
from ident.outputs import take_place
from ident.segment_file import read_segment
from robot_assets.errors import DataError
from robot_assets.robot import Robot, load_robot, robot_reference
from robot_assets.values import choice, exists, number, read_toml, show, subtable, tables, text, vector, whole

FORMAT = "simgap-dataset/1"
LONGEST_NAME = 240  # bytes of the name of a file


def load_dataset(path: str | Path) -> Dataset:
    """Read and check a dataset folder.

    Raises:
        DataError: with the file, the key or column, what was found and what was expected.
    """
    given = Path(path)
    toml = given if exists(given) else given / "dataset.toml"
    if not exists(toml):
        raise DataError("dataset", str(path), "no dataset.toml", "a dataset folder")
    folder, where = toml.parent, str(toml)
    head = read_toml(toml, "dataset.toml")
    choice(head, "format", where, (FORMAT,))
    rate = sample_rate(head, where)
    joints = head.get("joints")
    if not isinstance(joints, list) or not joints or not all(isinstance(j, str) for j in joints):
        raise DataError("joints", where, show(joints), "a list of joint names")
    if len(set(joints)) < len(joints):
        raise DataError("joints", where, "a name twice", "distinct names")
    robot = match_joints(load_robot(text(head, "robot", where), folder), joints, where)
    hold = choice(head, "input_hold", where, HOLDS, "zoh")
    noise = subtable(head, "noise", where)
    levels = {key: _std(noise, key, len(joints), where) for key in ("q_std", "tau_std")}
    entries = tables(head, "segment", where)
    check_count(len(entries), where)
    seen: dict[str, str] = {}
    names: set[str] = set()
    segments = tuple(_segment(e, i, folder, where, len(joints), rate, seen, names) for i, e in enumerate(entries))
    _refuse_copies(segments, list(seen), where)
    return Dataset(
        name=str(head.get("name") or folder.resolve().name),
        robot=robot,
        sample_rate=rate,
        joints=tuple(joints),
        input_hold=hold,
        q_std=levels["q_std"],
        tau_std=levels["tau_std"],
        controller=subtable(head, "controller", where) or None,
        segments=segments,
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


def check_target(path: str | Path) -> Path:
    """Where a dataset can be written, resolved.

    Raises:
        DataError: as of ``save_dataset``.
    """
    target = Path(path).resolve()
    if target.exists() and not target.is_dir():
        raise DataError("output", str(path), "a file", "a new folder or a dataset")
    foreign = [p.name for p in target.iterdir() if not _of_dataset(p)] if target.is_dir() else []
    if foreign:
        raise DataError(
            "output", str(path), f"{min(foreign)}, which is no part of a dataset", "a new folder or a dataset"
        )
    return target


def save_dataset(dataset: Dataset, path: str | Path) -> None:
    """Write a dataset folder: beside the target first, then moved into place.

    Raises:
        DataError: where the target exists and holds anything that is no part of a dataset, or the dataset breaks the
            format.
    """
    dataset = checked(dataset)
    target = check_target(path)
    for segment in dataset.segments:
        check_segment_name(segment.name, str(path))
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        beside = Path(tempfile.mkdtemp(prefix=f".{target.name}-", dir=target.parent))
    except OSError as err:
        raise DataError(
            "output", str(path), err.strerror or "a place that cannot be made", "a folder that can be written"
        ) from err
    try:
        for segment in dataset.segments:
            pq.write_table(_table(segment), beside / f"{segment.name}.parquet", compression="zstd")
        (beside / "dataset.toml").write_text(tomlkit.dumps(_head(dataset, target)), encoding="utf-8")
        take_place(beside, target)
    finally:
        shutil.rmtree(beside, ignore_errors=True)


def check_segment_name(name: str, where: str) -> None:
    """Raise a DataError where a segment could not be a file of its name inside a folder."""
    file = f"{name}.parquet"
    if not name.isprintable() or "/" in name or "\\" in name or len(file.encode(errors="replace")) > LONGEST_NAME:
        raise DataError(
            "name of a segment", where, ascii(name), f"printable, without slashes, at most {LONGEST_NAME - 8} bytes"
        )


def _of_dataset(path: Path) -> bool:
    return path.is_file() and (path.name == "dataset.toml" or path.suffix.lower() in (".parquet", ".csv"))


def _head(dataset: Dataset, target: Path) -> dict[str, Any]:
    head: dict[str, Any] = {
        "format": FORMAT,
        "name": dataset.name,
        "robot": robot_reference(dataset.robot, target),
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
        if s.filled is not None:
            entry["filled"] = asdict(s.filled)
        entries.append(entry)
    head["segment"] = entries
    return head


def _table(segment: Segment) -> pa.Table:
    columns: dict[str, np.ndarray] = {"t": segment.t}
    for channel in CHANNELS:
        x = getattr(segment, channel)
        if x is not None:
            columns |= {
                f"{channel}_{j + 1}": x[:, j]
                for j in range(x.shape[1])
                if channel != "q_link" or not np.all(np.isnan(x[:, j]))
            }
    return pa.table({k: np.ascontiguousarray(v, float) for k, v in columns.items()})


def _segment(
    entry: dict, i: int, folder: Path, toml: str, n: int, rate: float, seen: dict[str, str], names: set[str]
) -> Segment:
    where = f"{toml} segment {i + 1}"
    file = text(entry, "file", where)
    path = _inside(folder, file, where)
    real = os.path.normpath(file)
    if real in seen:
        raise DataError("file", where, f"{file} a second time (first as {seen[real]})", "each segment once")
    seen[real], name = file, _name_of(Path(real), names)
    names.add(name)
    kind = choice(entry, "kind", where, KINDS)
    role = choice(entry, "role", where, ROLES, "identification")
    t, channels = read_segment(path, where, n, rate)
    common: dict[str, Any] = dict(
        name=name,
        kind=kind,
        role=role,
        t=t,
        q0=None if "q0" not in entry else vector(entry["q0"], "q0", where, n, f"{n} finite numbers, one per joint"),
        operating_point=None if "operating_point" not in entry else text(entry, "operating_point", where),
        amplitude=amplitude(entry, where),
        filled=_filled(entry, where),
        **channels,
    )
    if kind == "trajectory":
        return Segment(**common)
    repeats = periods_of(entry, len(t), where, str(path))
    lines = _lines(entry.get("excited_lines", []), repeats["period"], where)
    return Segment(**common, **repeats, excited_lines=lines)


def _refuse_copies(segments: tuple[Segment, ...], files: list[str], where: str) -> None:
    """Raise a DataError where one segment stands there in two formats."""
    known: dict[str, tuple[Segment, str]] = {}
    for segment, file in zip(segments, files, strict=True):
        first, other = known.setdefault(os.path.splitext(file)[0], (segment, file))
        if first is not segment and all(np.array_equal(getattr(first, c), getattr(segment, c)) for c in ("tau", "q")):
            raise DataError("file", where, f"{file} with the samples of {other}", "each segment once")


def _name_of(file: Path, taken: set[str]) -> str:
    """Name of a segment by its file; by more of it where another has that name."""
    first = file.with_suffix("").as_posix().replace("/", "-")
    names = (first, f"{first}-{file.suffix[1:]}", *(f"{first}-{k}" for k in range(2, MAX_SEGMENTS + 2)))
    return next(name for name in names if name not in taken)


def _filled(entry: dict, where: str) -> Filled | None:
    if "filled" not in entry:
        return None
    filled = subtable(entry, "filled", where)
    here = f"{where} filled"
    gaps = whole(filled, "gaps", here, low=1)
    return Filled(gaps, number(filled, "longest", here, low=0.0), number(filled, "total", here, low=0.0))


def _inside(folder: Path, file: str, where: str) -> Path:
    """The path of a segment's file, which must not leave the dataset folder."""
    pure = Path(file)
    if not pure.name or pure.is_absolute() or ".." in pure.parts or "\x00" in file or "\\" in file:
        raise DataError("file", where, show(file), "a file inside the dataset folder")
    path = folder / pure
    try:
        inside = path.resolve().is_relative_to(folder.resolve())
    except (OSError, RuntimeError) as err:
        raise DataError("file", where, f"{file} ({err})", "a file inside the dataset folder") from err
    if not inside:
        raise DataError("file", where, f"{file} (a link to outside)", "a file inside the dataset folder")
    return path


def _lines(lines: Any, period: int, where: str) -> np.ndarray:
    if not isinstance(lines, list) or not all(isinstance(k, int) and not isinstance(k, bool) for k in lines):
        raise DataError("excited_lines", where, show(lines), "a list of whole numbers")
    check_lines(lines, period, where)
    return np.unique(np.asarray(lines, int))


def _std(noise: dict, key: str, n: int, where: str) -> np.ndarray | None:
    if key not in noise:
        return None
    out = vector(noise[key], f"noise.{key}", where, n, f"{n} standard deviations, one per joint")
    if np.any(out < 0):
        raise DataError(f"noise.{key}", where, show(noise[key]), "standard deviations of at least zero")
    return out
