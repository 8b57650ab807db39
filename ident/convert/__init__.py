"""Real logs into the dataset format."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Any

import numpy as np

from ident.convert.clock import (
    Stamps,
    at_times,
    changed,
    check_order,
    check_rows,
    check_stamps,
    resample,
    stamp_seconds,
    uniform_times,
)
from ident.convert.joining import on_one_clock
from ident.convert.mapping import Column, LogMap, read_map
from ident.convert.reading import read_log
from ident.dataset import Dataset, Filled, Segment
from ident.dataset_io import check_segment_name
from ident.format_checks import LARGEST, SHORTEST
from robot_assets.errors import DataError
from robot_assets.robot import Robot, linear_joints, load_robot


def convert_logs(
    files: Sequence[Path],
    robot: str | Path,
    map_path: str | Path,
    *,
    name: str = "log",
    say: Callable[[str], None] = lambda text: None,
    progress: Callable[[str], None] = lambda text: None,
) -> Dataset:
    """Read logs by a map; each log gives one segment, one for each part of a multisine, or two by a split.

    Args:
        files: one log each, or by ``[files]`` of the map several a log (those of one folder).
        say: told in words what was changed on the way (resampling, gaps). progress: what is being done.

    Raises:
        DataError: for a log, map or robot that cannot be used.
    """
    arm = load_robot(robot)
    log_map = read_map(map_path, arm.array("gear_ratio"), linear_joints(arm))
    segments: list[Segment] = []
    logs = _logs([Path(f) for f in files], log_map, str(map_path))
    _check_roles(logs, log_map, str(map_path))
    _tell_guessed_ratios(log_map, arm, say)
    for log_name, paths in logs:
        progress(f"reading {', '.join(p.name for p in paths.values())}")
        found = _segments(log_name, paths, log_map, arm.n, say)
        short = [s for s in found if s.n_samples < SHORTEST]
        if short:
            path = next(iter(paths.values()))
            raise DataError(
                "samples", str(path), f"{short[0].n_samples} of {short[0].name}", f"at least {SHORTEST} a segment"
            )
        segments += found
    if len({s.name for s in segments}) < len(segments):
        raise DataError("files", str(map_path), "two logs of one name", "distinct names")
    return Dataset(
        name=name,
        robot=arm,
        sample_rate=log_map.sample_rate,
        joints=arm.joint_names,
        input_hold=log_map.input_hold,
        q_std=None,
        tau_std=None,
        controller=None,
        segments=tuple(segments),
    )


def _logs(files: list[Path], m: LogMap, where: str) -> list[tuple[str, dict[str, Path]]]:
    """Logs as (name, prefix -> file); the prefix is empty where a log is one file."""
    if not m.files:
        for path in files:
            check_segment_name(path.stem, str(path))
        return [(path.stem, {"": path}) for path in files]
    folders: dict[Path, dict[str, Path]] = {}
    for path in files:
        fits = [f.prefix for f in m.files if fnmatchcase(path.name, f.pattern)]
        if len(fits) != 1:
            raise DataError("[files]", where, f"{len(fits)} entries for {path.name}", "one entry for each file given")
        log = folders.setdefault(path.parent, {})
        if fits[0] in log:
            raise DataError(
                "[files]", where, f"{path.name} and {log[fits[0]].name} for {fits[0]}", "one file of a kind a folder"
            )
        log[fits[0]] = path
    for folder, log in folders.items():
        missing = [f.pattern for f in m.files if f.prefix not in log]
        if missing:
            raise DataError("files", str(folder), f"none like {missing[0]}", "every file that [files] of the map names")
    if len(folders) == 1:
        (log,) = folders.values()
        return [(log[m.files[0].prefix].stem, log)]
    return [(folder.name or "log", log) for folder, log in folders.items()]


def _called(name: str, path: Path) -> tuple[str, ...]:
    """How [roles] may call a log."""
    return name, path.stem, path.name


def _role(name: str, path: Path, m: LogMap) -> str | None:
    """What [roles] says of a log; None where it says nothing."""
    return next((m.roles[k] for k in _called(name, path) if k in m.roles), None)


def _check_roles(logs: list[tuple[str, dict[str, Path]]], m: LogMap, where: str) -> None:
    """Raise a DataError where a role is that of no log: what was to be held out would be fitted to."""
    names = {called for name, paths in logs for called in _called(name, next(iter(paths.values())))}
    stray = sorted(set(m.roles) - names)
    if stray and m.whole:
        raise DataError("[roles]", where, f"{stray[0]}, which is none of the files given", f"one of {sorted(names)}")
    for name, paths in logs:
        own = {called: m.roles[called] for called in _called(name, next(iter(paths.values()))) if called in m.roles}
        if len(set(own.values())) > 1:
            raise DataError("[roles]", where, f"two roles of one log: {own}", "one")


def _tell_guessed_ratios(m: LogMap, arm: Robot, say: Callable[[str], None]) -> None:
    """Say where figures of a drive that are guesses scale what is converted."""
    scaled = [c for c in m.columns if c.geared and arm.joint_names[c.joint] in arm.guessed["gear_ratio"]]
    if scaled:
        channels = ", ".join(dict.fromkeys(c.channel for c in scaled))
        joints = ", ".join(name for j, name in enumerate(arm.joint_names) if j in {c.joint for c in scaled})
        say(
            f"{channels} of {joints} scaled by a gear_ratio that is a guess, not given or marked GUESS in robot.toml: give it, and take the mark away, where it is known"
        )


def _read(paths: dict[str, Path], m: LogMap) -> dict[str, np.ndarray]:
    if not m.files:
        return read_log(paths[""], m.sources, {m.time} if m.time else frozenset(), m.encoding)
    data = {}
    for part in m.files:
        start = f"{part.prefix}:"
        wanted = {s.removeprefix(start) for s in m.sources if s.startswith(start)}
        times = {part.time or (m.time or "").removeprefix(start)}
        for key, x in (
            read_log(paths[part.prefix], wanted, times, part.encoding or m.encoding) if wanted else {}
        ).items():
            if part.width is not None and key != part.time:
                if x.size % part.width:
                    raise DataError(
                        key, str(paths[part.prefix]), f"{x.size} values", f"a multiple of width = {part.width}"
                    )
                x = x.reshape(-1, part.width)
            data[start + key] = x
    lost = sorted(m.sources - set(data))
    if lost:
        raise DataError(
            "source",
            str(next(iter(paths.values()))),
            lost[0],
            f"a name that starts with one of {[f.prefix + ':' for f in m.files]}",
        )
    return data


def _segments(name: str, paths: dict[str, Path], m: LogMap, n: int, say: Callable[[str], None]) -> list[Segment]:
    path = next(iter(paths.values()))
    data = _read(paths, m)
    clocks: list[Stamps] = []
    start = 0.0
    if any(f.time is not None for f in m.files):
        data, clocks, start = on_one_clock(data, m, paths, say)
    channels = _channels(data, m, n, path)
    without = sorted(set(range(n)) - {c.joint for c in m.columns if c.channel == "r"})
    if "r" in channels and without:
        say(f"{path.name}: {', '.join(f'r_{j + 1}' for j in without)} taken as zero: the map does not have it")
    N = len(channels["q"])
    t = np.arange(N) / m.sample_rate
    if m.time is not None:
        x = data[m.time].ravel()
        if len(x) != N:
            raise DataError(m.time, str(path), f"{len(x)} time stamps", f"one for each of {N} samples")
        seconds = stamp_seconds(x, m.time_factor, x[0])
        for source, factor in m.time_plus:
            other = data[source].ravel()
            if len(other) != N:
                raise DataError(source, str(path), f"{len(other)} values", f"one for each of {N} samples")
            seconds = seconds + stamp_seconds(other, factor, other[0])
        check_order(seconds, path)  # before what it would look like: rows of several joints
        check_rows(seconds, channels["q"], path)
        clock = check_stamps(seconds, m.sample_rate, path, [v for k, v in channels.items() if k != "q_link"])
        if clock.rounded:
            say(f"{path.name}: {clock.told()}")
        clocks, start = [clock], float(clock.t[0])
        at = uniform_times(start, float(clock.t[-1]), m.sample_rate)
        t = np.arange(len(at)) / m.sample_rate
        if not at_times(clock, at, m.sample_rate):
            rows = np.concatenate([v for k, v in channels.items() if k != "q_link"], axis=1)
            say(f"{path.name}: {changed(clock, rows, len(t), m.sample_rate)}")
            channels = {k: resample(v, clock, at, m.sample_rate) for k, v in channels.items()}
    return [
        replace(s, filled=_filled(clocks, start + s.t[0], start + s.t[-1]))
        for s in _cut(name, path, m, t, channels, data)
    ]


def _filled(clocks: list[Stamps], start: float, end: float) -> Filled | None:
    found = [f for clock in clocks if (f := clock.filled(start, end)) is not None]
    return (
        Filled(sum(f.gaps for f in found), max(f.longest for f in found), sum(f.total for f in found))
        if found
        else None
    )


def _cut(
    name: str, path: Path, m: LogMap, t: np.ndarray, channels: dict[str, Any], data: dict[str, np.ndarray]
) -> list[Segment]:
    """Segments of one log: parts of a multisine, or a motion."""
    N = len(t)
    if m.period is None:
        return _motions(name, path, m, t, channels)
    lines = np.array(m.excited_lines, int)
    if m.excited_from is not None:
        X = np.abs(np.fft.rfft(data[m.excited_from].ravel()[: m.period]))
        lines = np.flatnonzero(X > m.excited_threshold * X[1:].max())
        lines = lines[(lines > 0) & (lines < m.period / 2)]
    out = []
    for i, part in enumerate(m.parts):
        if part.last * m.period > N:
            raise DataError(
                "multisine.part",
                str(path),
                f"periods {part.first} to {part.last}",
                f"within the {N // m.period} of the log",
            )
        pick = slice((part.first - 1) * m.period, part.last * m.period)
        out.append(
            Segment(
                name=f"{name}-{i + 1}",
                kind="multisine",
                role=part.role or _role(name, path, m) or "identification",
                t=t[pick],
                operating_point=m.operating_point,
                period=m.period,
                periods=part.last - part.first + 1,
                experiment=1,
                realization=1,
                excited_lines=lines,
                **{k: v[pick] for k, v in channels.items()},
            )
        )
    return out


def _motions(name: str, path: Path, m: LogMap, t: np.ndarray, channels: dict[str, Any]) -> list[Segment]:
    role = _role(name, path, m)
    if m.split is None or role is not None:
        return [Segment(name=name, kind="trajectory", role=role or "identification", t=t, **channels)]
    cut = int(m.split * len(t))
    return [
        Segment(name=f"{name}-{k + 1}", kind="trajectory", role=r, t=t[s], **{c: v[s] for c, v in channels.items()})
        for k, (r, s) in enumerate((("identification", slice(0, cut)), ("validation", slice(cut, None))))
    ]


def _channels(data: dict[str, np.ndarray], m: LogMap, n: int, path: Path) -> dict[str, np.ndarray]:
    out: dict[str, np.ndarray] = {}
    length = None
    for c in m.columns:
        x = _signal(data[c.source], c.source, c.index, c.joint, path)
        if c.turn is not None:
            x = np.unwrap(x, period=c.turn)  # before the gear: a motor's encoder wraps once a turn of the motor
        x = x * c.factor + c.offset
        for source, factor, index in c.plus:
            other = _signal(data[source], source, index, c.joint, path)
            if len(other) != len(x):
                raise DataError(source, str(path), f"{len(other)} samples", f"{len(x)} as in {c.source}")
            x = x + factor * other
        if length is not None and len(x) != length:
            raise DataError(c.source, str(path), f"{len(x)} samples", f"{length} as in {m.columns[0].source}")
        length = len(x)
        target = out.setdefault(c.channel, np.full((length, n), np.nan if c.channel == "q_link" else 0.0))
        target[:, c.joint] = x
        _check_values(x, c, path)
    if not length:
        raise DataError("signals", str(path), "no samples", "at least one")
    return out


def _check_values(x: np.ndarray, c: Column, path: Path) -> None:
    """Raise a DataError where a column (N,) of the dataset has a value that it cannot hold; a link encoder may have
    none."""
    bad = np.flatnonzero(~np.isfinite(x) & ~(np.isnan(x) & (c.channel == "q_link")))
    name = f"{c.channel}_{c.joint + 1}"
    if len(bad):
        kind = "NaN" if np.isnan(x[bad[0]]) else "infinity"
        found = f"{kind} of {c.source} at sample {bad[0]} ({len(bad)} not finite in all)"
        expected = "finite numbers (rows without may be left out of a log with a time, as samples that were lost)"
        raise DataError(name, str(path), found, expected)
    large = np.flatnonzero(np.abs(x) > LARGEST)
    if len(large):
        raise DataError(
            name, str(path), f"{x[large[0]]:.3g} of {c.source} at sample {large[0]}", f"at most {LARGEST:g} in SI units"
        )


def _signal(x: np.ndarray, name: str, index: int | None, joint: int, path: Path) -> np.ndarray:
    """One signal (N,) of a source; of two dimensions the longer is time. Without an index it is the column of the
    joint."""
    if x.ndim > 2:
        raise DataError(name, str(path), f"{x.ndim} dimensions, {' x '.join(map(str, x.shape))}", "one or two")
    if x.ndim < 2 or min(x.shape) == 1:
        if index:
            raise DataError(name, str(path), f"index = {index}", "no index, or 0: it has one column")
        return x.ravel()
    if x.shape[0] < x.shape[1]:
        x = x.T
    column = joint if index is None else index
    if column >= x.shape[1]:
        raise DataError(name, str(path), f"{x.shape[1]} columns", f"column {column} (index counts from 0)")
    return x[:, column]
