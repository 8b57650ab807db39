"""Datasets of one robot put together: the first data, and those of the experiment that a diagnosis asked for."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import replace

import numpy as np

from ident.dataset import Dataset, Segment
from robot_assets.errors import DataError

ALIKE = ("sample_rate", "joints", "input_hold", "q_std", "tau_std")


def merged(datasets: Sequence[Dataset], name: str) -> Dataset:
    """One dataset with all segments, in order.

    Segments and operating points of a later dataset that are called as some of an earlier one get a number behind
    their name: two experiments begin to count anew, and even at one posture they are records of their own.

    Raises:
        DataError: where the datasets are fewer than two, differ in robot, joints, rate, hold or noise, or hold a record
            twice.
    """
    if len(datasets) < 2:
        raise DataError("datasets", "merge", str(len(datasets)), "at least two")
    first, *others = datasets
    segments, points = list(first.segments), _points(first.segments)
    for other in others:
        _check_alike(first, other)
        _check_new(segments, other)
        names = {s.name for s in segments}
        own_points = _points(other.segments)
        called = {point: _free(point, points | (own_points - {point})) for point in sorted(own_points)}
        points |= set(called.values())
        theirs = {s.name for s in other.segments}
        for s in other.segments:
            new = _free(s.name, names | (theirs - {s.name}))
            names.add(new)
            point = None if s.operating_point is None else called[s.operating_point]
            segments.append(replace(s, name=new, operating_point=point))
    controllers = [d.controller for d in datasets]
    controller = first.controller if all(c == first.controller for c in controllers) else None
    return replace(first, name=name, segments=tuple(segments), controller=controller, path=None)


def _points(segments: Sequence[Segment]) -> set[str]:
    return {s.operating_point for s in segments if s.operating_point is not None}


def _free(name: str, taken: Collection[str]) -> str:
    """A name that is not taken: itself, or with the first number behind it that is free."""
    if name not in taken:
        return name
    return next(other for k in range(2, len(taken) + 3) if (other := f"{name}-{k}") not in taken)


def _check_alike(first: Dataset, other: Dataset) -> None:
    """Raise a DataError where two datasets are not recordings of one robot in one way."""
    if first.robot.folder.resolve() != other.robot.folder.resolve():
        raise DataError(
            "robot", f"dataset {other.name}", str(other.robot.folder), f"that of {first.name}: {first.robot.folder}"
        )
    for key in ALIKE:
        one, two = getattr(first, key), getattr(other, key)
        if not (one is two or np.array_equal(one, two)):
            raise DataError(key, f"dataset {other.name}", _told(two), f"{_told(one)}, as in {first.name}")


def _told(value: object) -> str:
    return "none" if value is None else str(value)


def _check_new(segments: Sequence[Segment], other: Dataset) -> None:
    """Raise a DataError where a record of a dataset is among segments already."""
    by_start: dict[bytes, list[Segment]] = {}
    for s in segments:
        by_start.setdefault(s.tau[0].tobytes(), []).append(s)
    for s in other.segments:
        for known in by_start.get(s.tau[0].tobytes(), []):
            if np.array_equal(known.tau, s.tau) and np.array_equal(known.q, s.q):
                raise DataError(
                    "segment", f"dataset {other.name}", f"{s.name} with the samples of {known.name}", "each record once"
                )
