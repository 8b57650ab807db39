"""MATLAB files of all versions as named arrays: structures, cells, and signals as Simulink writes them."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ident.unpacked import check_matlab, check_size
from robot_assets.errors import DataError

DEEPEST = 8  # structures inside structures that are looked into
MOST_ITEMS = 2000  # groups and arrays of one file, each of which takes time to look at
MOST_REFERRED = 20_000  # of those that cells and arrays of structures refer to, 200 fields of each of the most elements
MOST_ELEMENTS = 100  # of an array of structures or cells, as many as joints or runs; more of them are samples
LONGEST_NAME = 200  # characters
OBJECT = np.zeros((), [("object", bool)])  # stands for one of a class, as of timeseries, which only MATLAB reads
SIGNALS = "signals"  # of a structure with time, as Simulink's To Workspace and Scope write it


def read_matlab(path: Path, wanted: set[str] | None) -> dict[str, Any]:
    """Arrays by name: ``rec.q`` of a structure, ``rec(2).q`` of an array of them, ``q{2}`` of cells, and
    ``out.LABEL`` of a structure with time of Simulink, beside ``out.signals(2).values`` where that is wanted.

    Args:
        wanted: names; None wants all arrays of numbers, and lists of texts.

    Raises:
        DataError: where a file would take more memory than a recording, or refers to others.
    """
    import h5py

    if h5py.is_hdf5(path):
        with h5py.File(path) as file:
            return _hdf5(path, file, wanted)
    return _matlab_5(path, wanted)


def _matlab_5(path: Path, wanted: set[str] | None) -> dict[str, Any]:
    import scipy.io

    check_matlab(path)
    out: dict[str, Any] = {}

    def walk(name: str, value: Any, depth: int) -> None:
        if hasattr(value, "_fieldnames"):
            for key in value._fieldnames if depth < DEEPEST else []:
                part = getattr(value, key)
                if key == SIGNALS and (signals := _simulink(part)):
                    labels = _distinct_labels([getattr(s, "label", "") for s in signals], value._fieldnames)
                    out.update((f"{name}.{x}", s.values) for x, s in zip(labels, signals, strict=True) if x)
                    if wanted is None:  # each once, by its label if it has one
                        others = _unlabelled(f"{name}.{key}", labels)
                        out.update((x, s.values) for x, s in zip(others, signals, strict=True) if x)
                        continue
                walk(f"{name}.{key}", part, depth + 1)
        elif _cells_of_texts(value):
            out[name] = value.ravel().astype(str)
        elif isinstance(value, np.ndarray) and value.dtype == object and value.size and depth < DEEPEST:
            for key, part in _elements(name, value.ravel()):
                walk(key, part, depth + 1)
        elif wanted is None or name in wanted:
            out[name] = value

    for name, value in scipy.io.loadmat(path, squeeze_me=True, struct_as_record=False).items():
        if isinstance(name, str) and not name.startswith("__"):
            walk(name, value, 0)
    return out


def _simulink(signals: Any) -> list[Any]:
    """The signals of a structure with time; empty where they are none."""
    parts = list(signals.ravel()) if isinstance(signals, np.ndarray) and signals.dtype == object else [signals]
    return parts if len(parts) <= MOST_ELEMENTS and all(hasattr(s, "values") for s in parts) else []


def _unlabelled(name: str, labels: Sequence[str]) -> list[str]:
    """Names of the values of signals without a label, and nothing for those that have one."""
    if len(labels) == 1:
        return ["" if labels[0] else f"{name}.values"]
    return ["" if label else f"{name}({k + 1}).values" for k, label in enumerate(labels)]


def _distinct_labels(labels: Sequence[Any], fields: Sequence[str]) -> list[str]:
    """Labels of the signals of a structure as names, all empty where two are alike or one is the name of a field; those
    that Simulink passes on along a line stand in angle brackets."""
    names = [" ".join(x.split()).strip("<>")[:LONGEST_NAME] if isinstance(x, str) else "" for x in labels]
    double = any(name and times > 1 for name, times in Counter([*names, *fields]).items())
    return [""] * len(names) if double else names


def _cells_of_texts(value: Any) -> bool:
    """Whether a value of a MATLAB file is a short list of texts, which may name columns."""
    cells = isinstance(value, np.ndarray) and value.dtype == object and 0 < value.size <= MOST_ELEMENTS
    return cells and all(isinstance(v, str) for v in value.ravel())


def _elements(name: str, array: np.ndarray) -> Iterator[tuple[str, Any]]:
    """Parts of an array of structures or cells, named as MATLAB does; a structure a sample is an array a field."""
    structures = hasattr(array[0], "_fieldnames")
    if len(array) <= MOST_ELEMENTS:
        brackets = "()" if structures else "{}"
        yield from ((f"{name}{brackets[0]}{k + 1}{brackets[1]}", part) for k, part in enumerate(array))
        return
    for key in array[0]._fieldnames if structures else ():
        parts = [np.asarray(getattr(part, key, None)) for part in array]
        if all(p.shape == parts[0].shape and p.dtype.kind in "fiu" for p in parts):
            yield f"{name}.{key}", np.stack(parts)


def _hdf5(path: Path, file: Any, wanted: set[str] | None) -> dict[str, Any]:
    """Arrays of numbers of a MATLAB 7.3 file."""
    import h5py

    found: dict[str, Any] = {}
    texts: dict[str, np.ndarray] = {}
    objects: dict[str, np.ndarray] = {}
    groups, items, followed = set(), 0, 0

    def referred(item: Any) -> list[Any] | None:
        nonlocal followed
        parts = None if followed >= MOST_REFERRED else _referred(file, item)
        followed += len(parts or ())
        return parts

    def look_at(item: Any, name: str, depth: int, within: bool) -> None:
        """``within``: what something refers to, of which only as much as is bound is looked at."""
        nonlocal items
        items += not within
        if items > MOST_ITEMS:
            raise DataError("log", str(path), f"more than {MOST_ITEMS} groups and arrays", "a recording")
        if isinstance(item, h5py.Group):
            walk(item, f"{name}.", depth + 1, within)
        elif not isinstance(item, h5py.Dataset):
            return
        elif "MATLAB_object_decode" in item.attrs:
            objects[name] = OBJECT
        elif item.dtype.kind in "fiu":
            text = item.attrs.get("MATLAB_class", b"") == b"char"
            if (wanted is None or name in wanted) and not text and not item.attrs.get("MATLAB_empty", 0):
                found[name] = item
        elif len(name) <= DEEPEST * LONGEST_NAME:  # else the names of all parts would take much memory
            # Cells say what they are; what does not is a field of an array of structures.
            start, _, key = name.rpartition(".")
            cell = item.attrs.get("MATLAB_class", b"") == b"cell" or not start
            before, after = (f"{name}{{", "}") if cell else (f"{start}(", f").{key}")
            if not _wanted_within(wanted, before, after) or (parts := referred(item)) is None:
                return
            if (cells := _texts(parts)) is not None:
                if wanted is None:
                    texts[name] = cells
            elif depth <= DEEPEST:
                for k, part in enumerate(parts):
                    look_at(part, f"{before}{k + 1}{after}", depth + 1, True)

    def walk(group: Any, start: str, depth: int, within: bool) -> None:
        nonlocal followed
        address = h5py.h5o.get_info(group.id).addr
        if depth > DEEPEST or address in groups:  # a group may hold itself
            return
        groups.add(address)
        labelled, others = _labelled(group, referred) if depth and _wanted_within(wanted, start) else ({}, {})
        for label, item in (labelled | (others if wanted is None else {})).items():
            look_at(item, f"{start}{label}", depth, True)
        for name in group:
            followed += within
            if within and followed > MOST_REFERRED:
                return
            # Where MATLAB keeps what cells hold; and links, which may lead out of the file.
            if (name.startswith("#") and not start) or not isinstance(group.get(name, getlink=True), h5py.HardLink):
                continue
            if wanted is None and name == SIGNALS and (labelled or others):
                continue  # each once, by its label if it has one
            look_at(group[name], f"{start}{name}", depth, within)

    walk(file, "", 0, False)
    for name, item in found.items():
        if item.external or item.is_virtual:
            raise DataError("signal", str(path), f"{name}, which stands in another file", "one in the file itself")
    check_size(path, sum(item.size * item.dtype.itemsize for item in found.values()))
    # MATLAB's first dimension is the file's last.
    return texts | objects | {name: _flat(np.asarray(item).T) for name, item in found.items()}


def _wanted_within(wanted: set[str] | None, before: str, after: str = "") -> bool:
    """Whether a name that is wanted can be that of a part: it begins with one text, and has another behind it."""
    return wanted is None or any(w.startswith(before) and after in w[len(before) :] for w in wanted)


def _flat(x: np.ndarray) -> np.ndarray:
    """An array without dimensions of one, where it has more than two: Simulink has time in the third."""
    return np.squeeze(x) if x.ndim > 2 else x


def _labelled(group: Any, referred: Callable[[Any], list[Any] | None]) -> tuple[dict[str, Any], dict[str, Any]]:
    """Label -> values of the signals of a structure with time, and name -> values of those without one; empty where it
    is none. ``referred``: what an array refers to."""
    import h5py

    signals = group.get(SIGNALS) if isinstance(group.get(SIGNALS, getlink=True), h5py.HardLink) else None
    if not isinstance(signals, h5py.Group) or not all(
        isinstance(signals.get(key, getlink=True), h5py.HardLink) and isinstance(signals[key], h5py.Dataset)
        for key in ("values", "label")
    ):
        return {}, {}
    values, texts = referred(signals["values"]), referred(signals["label"])
    if values is None or texts is None:  # one signal stands there itself
        values, texts = [signals["values"]], [signals["label"]]
    labels = _distinct_labels([_text(x) or "" for x in texts], list(group))
    if len(labels) != len(values):
        return {}, {}
    named = (dict(zip(names, values, strict=True)) for names in (labels, _unlabelled(SIGNALS, labels)))
    return tuple({k: x for k, x in of.items() if k} for of in named)  # type: ignore[return-value]


def _referred(file: Any, item: Any) -> list[Any] | None:
    """What the elements of an array of a MATLAB 7.3 file refer to; None where they are none, too many or nothing."""
    import h5py

    if item.dtype != h5py.ref_dtype or item.external or item.is_virtual or not 0 < item.size <= MOST_ELEMENTS:
        return None
    # MATLAB counts along its first dimension, the file's last.
    refs = np.asarray(item).ravel()
    return [file[ref] for ref in refs] if all(refs) else None


def _texts(parts: list[Any]) -> np.ndarray | None:
    """(k,) texts of cells; None where one is none."""
    found = [_text(p) for p in parts]
    return None if any(x is None for x in found) else np.array(found)


def _text(item: Any) -> str | None:
    """A text of a MATLAB 7.3 file; None where it is none, or too long for a name."""
    import h5py

    if not isinstance(item, h5py.Dataset) or item.attrs.get("MATLAB_class", b"") != b"char":
        return None
    if item.external or item.is_virtual or item.size > LONGEST_NAME or item.dtype != np.uint16:
        return None
    if item.attrs.get("MATLAB_empty", 0):  # holds the size of the text
        return ""
    return "".join(map(chr, np.asarray(item).ravel()))
