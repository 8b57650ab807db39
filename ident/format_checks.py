"""What every dataset must be, whether it is read from files or made in memory: each breach is a single ``DataError``."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from ident.dataset import CHANNELS, Dataset, Segment
from robot_assets.errors import DataError
from robot_assets.robot import Robot
from robot_assets.values import choice, number, show, text, whole

REQUIRED = ("tau", "q")
KINDS = ("multisine", "trajectory")
ROLES = ("identification", "validation")
HOLDS = ("zoh", "none")
MAX_SEGMENTS = 100_000
TIME_TOLERANCE = 0.05  # of a sample period, on every step of `t`
LARGEST = 1e12  # SI; anything above is no angle, torque or time
SHORTEST = 16  # samples


def checked(dataset: Dataset) -> Dataset:
    """The dataset itself where it is as the format says; with arrays of float64 where these have other numbers, and
    Python's numbers for single ones of NumPy.

    Raises:
        DataError: where it breaks the format, with the segment, what was found and what was expected.
    """
    if not isinstance(dataset, Dataset):
        raise DataError("dataset", "argument", f"a {type(dataset).__name__}", "a Dataset, as of load_dataset")
    where = f"dataset {dataset.name}"
    if not isinstance(dataset.robot, Robot):
        raise DataError("robot", where, f"a {type(dataset.robot).__name__}", "a Robot, as of load_robot")
    names = dataset.joints
    if not isinstance(names, (tuple, list)) or tuple(names) != dataset.robot.joint_names:
        raise DataError("joints", where, show(names), f"those of the robot: {show(dataset.robot.joint_names)}")
    head = _plain(vars(dataset))
    rate = sample_rate(head, where)
    choice(head, "input_hold", where, HOLDS)
    renewed = _other_than(dataset, head)
    for key in ("q_std", "tau_std"):
        value = getattr(dataset, key)
        if value is not None:
            std = _numbers(value, key, where, (len(names),), "(n,), one of each joint")
            if np.any(std < 0):
                raise DataError(key, where, show(std.min().item()), "standard deviations of at least zero")
            renewed[key] = std
    if not isinstance(dataset.segments, tuple | list):
        raise DataError("segments", where, f"a {type(dataset.segments).__name__}", "a tuple of segments")
    check_count(len(dataset.segments), where)
    taken: set[str] = set()
    segments = tuple(_segment(s, i, taken, len(names), rate, where) for i, s in enumerate(dataset.segments))
    if any(new is not old for new, old in zip(segments, dataset.segments, strict=True)):
        renewed["segments"] = segments
    return _with(dataset, renewed)


def check_limits(max_causes: int, max_seconds: float) -> None:
    """Raise a DataError where a search for causes cannot be limited so."""
    given = _plain({"max_causes": max_causes, "max_seconds": max_seconds})
    whole(given, "max_causes", "diagnose", low=0)
    number(given, "max_seconds", "diagnose", low=0.0, high=np.inf)


def sample_rate(table: Mapping[str, Any], where: str) -> float:
    """The rate of a dataset, Hz."""
    return number(dict(table), "sample_rate", where, low=1e-3, high=1e7)


def check_count(segments: int, where: str) -> None:
    """Raise a DataError where a dataset has no segments, or too many."""
    if not 0 < segments <= MAX_SEGMENTS:
        raise DataError("[[segment]]", where, f"{segments} entries", f"1 to {MAX_SEGMENTS}")


def check_column(x: np.ndarray, what: str, where: str) -> None:
    """Raise a DataError where samples (N,) are not finite, or no SI numbers."""
    if not len(x) or max(abs(x.max()), abs(x.min())) <= LARGEST:  # false beside NaN too, and nothing is copied
        return
    bad = np.flatnonzero(~np.isfinite(x))
    if len(bad):
        kind = "NaN" if np.isnan(x[bad[0]]) else "infinity"
        raise DataError(what, where, f"{kind} at sample {bad[0]} ({len(bad)} not finite in all)", "finite numbers")
    k = int(np.argmax(np.abs(x)))
    raise DataError(what, where, f"{x[k]:.3g} at sample {k}", f"at most {LARGEST:g} in SI units")


def check_time(t: np.ndarray, rate: float, what: str, where: str) -> None:
    """Raise a DataError where times (N,) are too few or not those of a rate, Hz."""
    if len(t) < SHORTEST:
        raise DataError(what, where, f"{len(t)} samples", f"at least {SHORTEST}")
    step = np.diff(t)
    bad = np.flatnonzero(np.abs(step * rate - 1.0) > TIME_TOLERANCE)
    if len(bad) > 0.5 * len(step):
        middle = float(np.median(step))
        found = f"a rate of {1 / middle:.6g} Hz" if middle else "a time that stands still"
        raise DataError(what, where, found, f"sample_rate = {rate:g} Hz")
    if len(bad):
        k = int(bad[0])
        raise DataError(
            what,
            where,
            f"a step of {step[k]:.6g} s at sample {k} ({len(bad)} such)",
            f"uniform steps of {1 / rate:.6g} s",
        )
    if abs((t[-1] - t[0]) * rate / (len(t) - 1) - 1.0) > 1e-3:
        raise DataError(
            what, where, f"a mean rate of {(len(t) - 1) / (t[-1] - t[0]):.6g} Hz", f"sample_rate = {rate:g} Hz"
        )


def periods_of(table: dict[str, Any], samples: int, where: str, record: str) -> dict[str, Any]:
    """What says how a multisine repeats: period, periods, transient_periods, experiment and realization.

    Args:
        samples: of its record, which ``record`` names.
    """
    text(table, "operating_point", where)
    period = whole(table, "period", where, low=4)
    periods = whole(table, "periods", where, low=1)
    transient = whole(table, "transient_periods", where, low=0, default=0)
    if transient >= periods:
        raise DataError("transient_periods", where, str(transient), f"less than periods = {periods}")
    if samples != period * periods:
        raise DataError(
            "samples", record, f"{samples}", f"period * periods = {period} * {periods} = {period * periods}"
        )
    columns = {k: whole(table, k, where, low=1, default=None) for k in ("experiment", "realization")}
    return {"period": period, "periods": periods, "transient_periods": transient, **columns}


def check_lines(lines: Sequence[int], period: int, where: str) -> None:
    """Raise a DataError where whole numbers are no lines of a period below Nyquist."""
    for k in lines:
        if not 1 <= k < period / 2:
            raise DataError("excited_lines", where, f"line {show(k)}", f"lines from 1 to below Nyquist, {period / 2:g}")


def amplitude(table: dict[str, Any], where: str) -> float:
    """The relative excitation level of a segment."""
    return number(table, "amplitude", where, low=1e-9, high=1e9, default=1.0)


def _segment(segment: Segment, i: int, taken: set[str], n: int, rate: float, whole_of: str) -> Segment:
    """The segment, with numbers as of ``checked``; its name joins those that are ``taken``."""
    if not isinstance(segment, Segment):
        raise DataError("segments", whole_of, f"a {type(segment).__name__}", "each a Segment")
    head = _plain(vars(segment))
    where = f"{whole_of} segment {text(head, 'name', f'{whole_of} segment {i + 1}')}"
    if segment.name in taken:
        raise DataError("name", where, "it a second time", "each segment once")
    taken.add(segment.name)
    choice(head, "kind", where, KINDS)
    choice(head, "role", where, ROLES)
    renewed = _other_than(segment, head) | {"t": _numbers(segment.t, "t", where, (None,), "(N,), s")}
    check_time(renewed["t"], rate, "t", where)
    shape = (len(renewed["t"]), n)
    for channel in CHANNELS:
        x = getattr(segment, channel)
        if x is not None or channel in REQUIRED:
            renewed[channel] = _numbers(
                x, channel, where, shape, "(N, n), a row for each of t and a column for each joint"
            )
    if segment.q0 is not None:
        renewed["q0"] = _numbers(segment.q0, "q0", where, (n,), "(n,), one of each joint")
    amplitude(head, where)
    if segment.kind == "multisine":
        periods_of({k: v for k, v in head.items() if v is not None}, shape[0], where, where)
        renewed["excited_lines"] = _lines(segment.excited_lines, int(segment.period or 0), where)
    return _with(segment, renewed)


def _numbers(x: Any, what: str, where: str, shape: tuple[int | None, ...], expected: str) -> np.ndarray:
    """An array as float64, itself where it is that; refused where it has no finite numbers or another shape.

    Joints without a link encoder have a column of NaN.
    """
    if not isinstance(x, np.ndarray) or isinstance(x, np.ma.MaskedArray):
        raise DataError(what, where, f"a {type(x).__name__}", f"an array of numbers {expected}")
    if x.dtype.kind not in "fiu":
        raise DataError(what, where, f"an array of {x.dtype}", f"real numbers {expected}")
    if x.ndim != len(shape) or any(length not in (None, size) for length, size in zip(shape, x.shape, strict=True)):
        size = ", ".join("N" if length is None else str(length) for length in shape)
        raise DataError(what, where, f"shape {x.shape}", f"({size}{',' * (len(shape) == 1)}): {expected}")
    x = np.asarray(x, float)
    if x.ndim == 1:
        check_column(x, what, where)
    else:
        for j, column in enumerate(x.T):
            if what != "q_link" or not np.isnan(column).all():
                check_column(column, f"{what} of joint {j + 1}", where)
    return x


def _lines(lines: Any, period: int, where: str) -> np.ndarray:
    """Lines of an excitation, in order and each once."""
    sound = isinstance(lines, np.ndarray) and lines.ndim == 1 and (lines.dtype.kind in "iu" or not lines.size)
    listed = lines.tolist() if sound else lines
    whole_numbers = isinstance(listed, list | tuple) and all(
        isinstance(k, int | np.integer) and not isinstance(k, bool) for k in listed
    )
    if not whole_numbers:
        raise DataError("excited_lines", where, show(lines), "an array (F,) of whole numbers")
    check_lines(listed, period, where)
    rising = sound and lines.dtype == int and bool(np.all(np.diff(lines) > 0))
    return lines if rising else np.unique(np.array(listed, int))


def _plain(table: Mapping[str, Any]) -> dict[str, Any]:
    """A table with numbers of NumPy as those of Python."""
    return {k: v.item() if isinstance(v, np.generic) else v for k, v in table.items()}


def _other_than(x: Any, table: dict[str, Any]) -> dict[str, Any]:
    """What of a table is another object than the attribute of that name."""
    return {k: v for k, v in table.items() if v is not getattr(x, k)}


def _with(x: Any, renewed: dict[str, Any]) -> Any:
    """A dataclass with some attributes, itself where they are what it has."""
    other = _other_than(x, renewed)
    return replace(x, **other) if other else x
