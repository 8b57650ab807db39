"""Real logs into the dataset format."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from ident.convert.mapping import LogMap, read_map
from ident.convert.reading import read_log
from ident.dataset import Dataset, Segment
from robot_assets.errors import DataError
from robot_assets.robot import ASSETS, load_robot

JITTER = 0.05  # of a sample, above which time stamps are resampled


def convert_logs(
    files: Sequence[Path], robot: str | Path, map_path: str | Path, *, name: str = "log"
) -> Dataset:
    """Read logs by a map; each file gives one segment, or one for each part of a multisine.

    Raises:
        DataError: for a log, map or robot that cannot be used.
    """
    arm = load_robot(robot)
    log_map = read_map(map_path, arm.array("gear_ratio"))
    segments: list[Segment] = []
    for path in files:
        segments += _segments(Path(path), log_map, arm.n)
    if len({s.name for s in segments}) < len(segments):
        raise DataError("files", str(map_path), "two logs of one name", "distinct names")
    own = (ASSETS / arm.name).resolve() == arm.folder
    return Dataset(
        name=name,
        robot_ref=arm.name if own else str(arm.folder),
        robot=arm,
        sample_rate=log_map.sample_rate,
        joints=arm.joint_names,
        input_hold=log_map.input_hold,
        q_std=None,
        tau_std=None,
        controller=None,
        segments=tuple(segments),
    )


def _segments(path: Path, m: LogMap, n: int) -> list[Segment]:
    wanted = {c.source for c in m.columns} | ({m.time} if m.time else set())
    if m.excited_from:
        wanted.add(m.excited_from)
    data = read_log(path, wanted)
    channels = _channels(data, m, n, path)
    N = len(channels["q"])
    t = np.arange(N) / m.sample_rate
    if m.time is not None:
        stamps = data[m.time].ravel() * m.time_factor
        channels, t = _resample(channels, stamps - stamps[0], m.sample_rate, path)
        N = len(t)
    if m.period is None:
        return _motions(path, m, t, channels)
    lines = np.array(m.excited_lines, int)
    if m.excited_from is not None:
        X = np.abs(np.fft.rfft(data[m.excited_from].ravel()[: m.period]))
        lines = np.flatnonzero(X > m.excited_threshold * X[1:].max())
        lines = lines[(lines > 0) & (lines < m.period / 2)]
    out = []
    for i, part in enumerate(m.parts):
        if not 1 <= part.first <= part.last or part.last * m.period > N:
            raise DataError("multisine.part", str(path), f"periods {part.first} to {part.last}", f"within the {N // m.period} of the log")
        pick = slice((part.first - 1) * m.period, part.last * m.period)
        out.append(
            Segment(
                name=f"{path.stem}-{i + 1}",
                kind="multisine",
                role=part.role,
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


def _motions(path: Path, m: LogMap, t: np.ndarray, channels: dict[str, np.ndarray]) -> list[Segment]:
    role = m.roles.get(path.stem, m.roles.get(path.name, "identification"))
    if m.split is None:
        return [Segment(name=path.stem, kind="trajectory", role=role, t=t, **channels)]
    cut = int(m.split * len(t))
    return [
        Segment(name=f"{path.stem}-{k + 1}", kind="trajectory", role=r, t=t[s], **{c: v[s] for c, v in channels.items()})
        for k, (r, s) in enumerate((("identification", slice(0, cut)), ("validation", slice(cut, None))))
    ]


def _channels(data: dict[str, np.ndarray], m: LogMap, n: int, path: Path) -> dict[str, np.ndarray]:
    lengths = {len(data[c.source]) for c in m.columns}
    if len(lengths) > 1:
        raise DataError("signals", str(path), f"lengths {sorted(lengths)}", "one length")
    N = lengths.pop()
    out: dict[str, np.ndarray] = {}
    for c in m.columns:
        x = data[c.source]
        if x.ndim == 2 and min(x.shape) > 1:
            if c.index >= x.shape[1]:
                raise DataError(c.source, str(path), f"{x.shape[1]} columns", f"column {c.index}")
            x = x[:, c.index]
        x = x.ravel()
        x = x * c.factor
        if c.unwrap:
            x = np.unwrap(x)
        target = out.setdefault(c.channel, np.full((N, n), np.nan if c.channel == "q_link" else 0.0))
        target[:, c.joint] = x + c.offset
    bad = [k for k, v in out.items() if k != "q_link" and not np.all(np.isfinite(v))]
    if bad:
        k = int(np.flatnonzero(~np.isfinite(out[bad[0]]).all(axis=1))[0])
        raise DataError(bad[0], str(path), f"a value that is not finite at sample {k}", "finite numbers")
    return out


def _resample(
    channels: dict[str, np.ndarray], stamps: np.ndarray, rate: float, path: Path
) -> tuple[dict[str, np.ndarray], np.ndarray]:
    """Signals on a uniform grid; untouched where the stamps are uniform already."""
    step = np.diff(stamps)
    if not np.all(np.isfinite(stamps)) or np.any(step < 0):
        raise DataError("time", str(path), "stamps that are not finite or go back", "rising time stamps")
    t = np.arange(int(np.floor(stamps[-1] * rate + 1e-6)) + 1) / rate
    if len(t) == len(stamps) and np.all(np.abs(step * rate - 1) < JITTER):
        return channels, t
    keep = np.concatenate([[True], step > 0])
    return {
        k: np.stack([np.interp(t, stamps[keep], c[keep]) for c in v.T], axis=1) for k, v in channels.items()
    }, t
