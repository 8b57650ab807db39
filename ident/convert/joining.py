"""Files of one log whose clocks are their own, brought onto one."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np

from ident.convert.clock import (
    Stamps,
    at_times,
    changed,
    check_order,
    check_stamps,
    resample,
    stamp_seconds,
    uniform_times,
)
from ident.convert.mapping import LogMap
from ident.format_checks import SHORTEST
from robot_assets.errors import DataError


def on_one_clock(
    data: dict[str, np.ndarray], m: LogMap, paths: dict[str, Path], say: Callable[[str], None]
) -> tuple[dict[str, np.ndarray], list[Stamps], float]:
    """Signals of files with stamps of their own at the times that all of them have.

    Returns:
        data: signals (N, k). clocks: of each file. start: s, of the first sample on these clocks.
    """
    stamps = {f.prefix: data[f"{f.prefix}:{f.time}"].ravel() for f in m.files}
    first = m.files[0].prefix
    for f in m.files:
        if not stamps[f.prefix].size or stamps[f.prefix].dtype.kind != stamps[first].dtype.kind:
            kinds = {"M": "dates", "m": "times of the day"}
            found = kinds.get(stamps[f.prefix].dtype.kind, "numbers") if stamps[f.prefix].size else "no stamps"
            raise DataError(f"{f.prefix}:{f.time}", str(paths[f.prefix]), found, f"stamps like those of {first}")
    dates = stamps[first].dtype.kind in "Mm"
    clocks = {}
    own = {
        f.prefix: {k: x for k, x in data.items() if k.startswith(f"{f.prefix}:") and k != f"{f.prefix}:{f.time}"}
        for f in m.files
    }
    for f in m.files:
        x, origin = stamps[f.prefix], stamps[first][0]
        # Numbers may be of several units, and count from one origin.
        s = stamp_seconds(x, 1.0, origin) if dates else x * f.time_factor - origin * m.files[0].time_factor
        rows = list(own[f.prefix].values())
        check_order(s, paths[f.prefix])
        clocks[f.prefix] = clock = check_stamps(s + f.shift, m.sample_rate, paths[f.prefix], rows)
        if clock.rounded:
            say(f"{paths[f.prefix].name}: {clock.told()}")
    last = max(clocks, key=lambda k: clocks[k].t[0])
    soonest = min(clocks, key=lambda k: clocks[k].t[-1])
    start, end = float(clocks[last].t[0]), float(clocks[soonest].t[-1])
    if (end - start) * m.sample_rate < SHORTEST - 1:
        found = (
            f"{paths[soonest].name} ends {start - end:.4g} s before {paths[last].name} begins"
            if end < start
            else f"{end - start:.3g} s in common"
        )
        raise DataError(
            "time of [files]", str(paths[last]), found, "spans that overlap (shift = seconds in [files] moves one)"
        )
    t = uniform_times(start, end, m.sample_rate)
    out = dict(data)
    for f in m.files:
        clock = clocks[f.prefix]
        signals = {k: _by_time(x, len(clock.t), k, paths[f.prefix]) for k, x in own[f.prefix].items()}
        for c in m.columns:
            if c.turn is None or c.source not in signals:
                continue
            turns = signals[c.source]
            k = 0 if turns.shape[1] == 1 else c.joint if c.index is None else c.index
            if k < turns.shape[1]:
                # Before samples are put between: halfway between two ends of a turn is nowhere.
                signals[c.source] = np.concatenate(
                    [turns[:, :k], np.unwrap(turns[:, [k]], period=c.turn, axis=0), turns[:, k + 1 :]], axis=1
                )
        if signals and not at_times(clock, t, m.sample_rate):
            say(
                f"{paths[f.prefix].name}: {changed(clock, np.concatenate(list(signals.values()), axis=1), len(t), m.sample_rate)}"
            )
            signals = {k: resample(x, clock, t, m.sample_rate) for k, x in signals.items()}
        out |= signals
    return out, list(clocks.values()), start


def _by_time(x: np.ndarray, N: int, name: str, path: Path) -> np.ndarray:
    """(N, k) of a source that has a sample a stamp."""
    x = x.reshape(-1, 1) if x.ndim < 2 else x if len(x) == N else x.T
    if len(x) != N or x.ndim > 2:
        raise DataError(name, str(path), f"{len(x)} samples", f"one for each of {N} time stamps")
    return x
