"""Logs of several formats as named arrays."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Mapping, Set
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet

from ident.convert.cells import LABELLED, labels_of
from ident.convert.dates import as_dates, dates_of_texts, seconds
from ident.convert.layout import read_layout
from ident.convert.matlab import DEEPEST, MOST_ELEMENTS, read_matlab
from ident.convert.texts import MOST_CELLS, VALUES, alike, check_names, distinct, read_text, scan_text, text_names
from ident.unpacked import check_mcap, check_size, check_zip
from robot_assets.errors import DataError
from robot_assets.values import exists, instead_of_file

CHANGING = np.array([["a", "b"], ["b", "a"]])  # stands for a list of texts that is not the same in all rows
NUMBERS = (pa.types.is_integer, pa.types.is_floating, pa.types.is_decimal)
Signals = dict[str, np.ndarray]
T = TypeVar("T")
Reader = Callable[[Path, set[str] | None], dict[str, Any]]


@dataclass(frozen=True)
class Survey:
    """What a log holds.

    Attributes:
        signals: name -> numbers; of dates the seconds since the first.
        units: name -> unit as the log writes it, where it does.
        dates: names of those that are dates or times of the day.
        doubts: name -> what is doubtful about how it was read, in words; of those left out as well.
        cut: rows that were read of a log that is longer; else 0.
        labels: name -> distinct texts of a column that has few.
        lists: name -> strings of a list of them, which may name columns; empty where it changes from row to row.
        encoding: of a text, as stated or as its bytes tell; Latin-1 where they do not, and no name needs it; empty of
            UTF-8 without a mark.
    """

    signals: Signals
    units: dict[str, str]
    dates: frozenset[str]
    doubts: dict[str, str]
    cut: int = 0
    lists: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    labels: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    encoding: str = ""


NOTHING_TOLD = Survey({}, {}, frozenset(), {})


def read_log(path: Path, wanted: set[str], times: Set[str] = frozenset(), encoding: str = "") -> Signals:
    """The wanted signals of a log; a dot reaches into structures ("rec.act_pos").

    Args:
        times: those that may be dates, which come as datetime64 or timedelta64.
        encoding: of a text, as it is stated; empty where it is not.

    Raises:
        DataError: where the file is missing, of another format, unreadable, or lacks a signal.
    """
    text = is_text(path)
    data = _of(path, lambda p: read_text(p, wanted, encoding) if text else _reader(p)(p, wanted))
    out = {}
    for name in sorted(wanted):
        if name not in data:
            suffix = path.suffix.lower()
            known = sorted(text_names(path, encoding) if text else NAMES.get(suffix, list_signals)(path))
            if name in known:
                raise DataError("signal", str(path), f"{name} without a number in it", "numbers")
            raise DataError("signal", str(path), f"no {name}", f"one of {known[:30]}")
        x = _array(data[name])
        if x is None or x.dtype.kind not in ("fiuMm" if name in times else "fiu"):
            raise DataError("signal", str(path), f"{name} is no array of numbers{_instead(x)}", "numbers")
        out[name] = x if x.dtype.kind in "Mm" else x.astype(float)
    return out


def is_text(path: Path) -> bool:
    """Whether a log is a text, by its suffix."""
    return READERS.get(path.suffix.lower()) is read_text


def survey_log(path: Path, encoding: str = "") -> Survey:
    """All signals of a log that are numbers or dates, single numbers included.

    Args:
        encoding: as of ``read_log``.

    Raises:
        DataError: where the file is missing, of another format or unreadable.
    """
    found, told = _of(path, lambda p: _surveyed(p, encoding) if is_text(p) else (_reader(p)(p, None), NOTHING_TOLD))
    signals: Signals = {}
    dates, lists = set(), {}
    doubts, labels = dict(told.doubts), dict(told.labels)
    for name, value in found.items():
        if isinstance(value, np.ndarray) and value.dtype.kind in "OU" and value.ndim == 1:
            labels[name] = labels_of(value[:LABELLED].tolist())
        x = _array(value)
        if (strings := _strings(value)) is not None:
            lists[name] = strings
        if x is not None and x.dtype.kind == "V":
            doubts[name] = "structures or objects in place of numbers: save their fields as arrays"
        if x is None or x.ndim > 2 or x.dtype.kind not in "fiuMm":
            continue
        if x.dtype.kind in "Mm":
            dates.add(name)
            stamps = x.ravel()[~np.isnat(x.ravel())]
            x = seconds(x, stamps[0]) if len(stamps) else np.zeros(0)
        signals[name] = x.astype(float)
    return replace(told, signals=signals, dates=frozenset(dates), doubts=doubts, lists=lists, labels=labels)


def _surveyed(path: Path, encoding: str) -> tuple[dict[str, Any], Survey]:
    """Signals of a text, and what is to be told of them: units, doubts, texts of other columns, its encoding; rows read
    of one that is longer."""
    layout = read_layout(path, encoding)
    check_names(path, layout)
    told = replace(NOTHING_TOLD, encoding=encoding or ("" if layout.encoding == "utf-8" else layout.encoding))
    if not layout.names:
        return read_text(path, None, encoding), told
    cells = scan_text(path, None, layout)
    doubts = {}
    for c in cells:
        if c.fault is not None:
            doubts[c.name] = f"{c.fault[1][:40]!r} in row {c.fault[0]}"
        elif not c.kind:
            doubts[c.name] = "no numbers"
        elif c.order[1]:
            doubts[c.name] = f"{c.like!r} taken as {'month/day' if c.order[0] == 'mdy' else 'day-month'}"
    out: dict[str, np.ndarray] = {}
    for c in cells:
        x = c.array()
        if x is not None and not alike(out.setdefault(c.name, x), x):
            doubts[c.name] = "several columns that differ"
    units = {n: u for n, u in zip(layout.names, layout.units, strict=False) if u}
    cut = cells[0].rows if cells and cells[0].rows * len(cells) > MOST_CELLS else 0
    labels = {c.name: c.labels for c in cells if c.labels}
    return out, replace(told, units=units, doubts=doubts, cut=cut, labels=labels)


def list_signals(path: Path) -> Signals:
    """The signals of ``survey_log``."""
    return survey_log(path).signals


def _array(value: Any) -> np.ndarray | None:
    """An array, of dates where texts are dates; None where it is ragged."""
    try:
        x = np.asarray(value)
        return dates_of_texts(x) if x.ndim == 1 and x.dtype.kind in "UO" and isinstance(next(iter(x), None), str) else x
    except (TypeError, ValueError, pa.ArrowException):
        return None


def _strings(x: Any) -> tuple[str, ...] | None:
    """The strings of a short list, or of one a row where all are alike; () where they are not; None of all else."""
    if not isinstance(x, np.ndarray) or x.dtype.kind not in "US" or x.ndim not in (1, 2) or not x.size:
        return None
    if not 1 < x.shape[-1] <= MOST_ELEMENTS:
        return None
    rows = np.atleast_2d(x)
    names = rows[0].tolist() if np.all(rows == rows[0]) else ()
    return tuple((x.decode(errors="replace") if isinstance(x, bytes) else x).strip() for x in names)


def _instead(x: np.ndarray | None) -> str:
    """What stands there, in words, where that can be told."""
    kind = "" if x is None else x.dtype.kind
    if kind == "O" and x is not None and x.size == 1 and x.item() is None:  # as ``_lists`` gives them
        return " but of lists of several lengths"
    if kind == "O" and x is not None and all(isinstance(v, str) for v in x.ravel()[:10]):
        kind = "U"
    return {
        "b": " but of true and false", "M": " but of dates", "m": " but of times", "U": " but of texts", "S": " but of texts",
        "V": " but of structures or objects: save their fields as arrays", "c": " but of complex numbers", "O": " but of objects",
    }.get(kind, "")  # fmt: skip


def _of(path: Path, read: Callable[[Path], T]) -> T:
    """What is read of a file, whose faults become one line."""
    if not exists(path):
        raise DataError("log", str(path), instead_of_file(path), f"a file of {FORMATS}")
    if path.suffix.lower() not in READERS:
        raise DataError("log", str(path), path.suffix or "no suffix", f"one of {FORMATS}")
    try:
        return read(path)
    except DataError:
        raise
    except Exception as err:  # each reader raises types of its own for damaged files
        raise DataError("log", str(path), f"unreadable ({_reason(err)})", "a complete file") from err


def _reader(path: Path) -> Reader:
    return READERS[path.suffix.lower()]


def _reason(err: Exception) -> str:
    """The first line of an error, without the address of a Python object."""
    return (
        re.sub(r"<[^<>]* at 0x[0-9a-f]+>", "the file", str(err)).splitlines()[0][:160]
        if str(err).strip()
        else type(err).__name__
    )


def _parquet(path: Path, wanted: set[str] | None) -> dict[str, Any]:
    file = pa.parquet.ParquetFile(path)
    schema = file.schema_arrow
    distinct(schema.names, wanted, path)
    names = [n for n in schema.names if (wanted is None or n in wanted) and _holds_numbers(schema.field(n).type)]
    stored = 0
    for g in range(file.metadata.num_row_groups):
        columns = (file.metadata.row_group(g).column(k) for k in range(file.metadata.num_columns))
        stored += sum(
            c.num_values for c in columns if c.path_in_schema.split(".")[0] in names or c.path_in_schema in names
        )
    check_size(path, 8 * max(stored, file.metadata.num_rows * len(names)))
    table = file.read(columns=names)
    out = {
        n: _lists(table.column(n)) if _is_list(table.column(n).type) else as_dates(table.column(n))
        for n in table.column_names
    }
    if wanted is None:
        out |= {
            n: _names(file, n)
            for n in schema.names
            if _is_list(kind := schema.field(n).type) and _is_text(kind.value_type)
        }
    return {n: x for n, x in out.items() if x is not None or wanted is not None}


def _names(file: pa.parquet.ParquetFile, name: str) -> np.ndarray | None:
    """(k,) strings of a list of them that is the same in all rows, as messages name their joints; none where it
    changes; None where there are too many for joints."""
    first = None
    for batch in file.iter_batches(batch_size=1024, columns=[name]):
        column = batch.column(0)
        if column.null_count or pc.any(pc.not_equal(pc.list_value_length(column), len(column[0]))).as_py():
            return CHANGING
        k = len(column[0])
        if not 0 < k <= MOST_ELEMENTS:
            return None
        codes = pc.list_flatten(column).cast(pa.string()).dictionary_encode()
        names = np.array([str(v) for v in column[0].as_py()])
        first = names if first is None else first
        rows = codes.indices.to_numpy(zero_copy_only=False).reshape(-1, k)
        if not np.array_equal(names, first) or np.any(rows != rows[0]):
            return CHANGING
    return first


def _lists(column: pa.ChunkedArray) -> np.ndarray | None:
    """(N, k) of lists of k numbers each, as messages of all joints are kept; None where they are of several lengths."""
    lengths = pc.list_value_length(column)
    k = pc.min(lengths).as_py()
    if column.null_count or not k or pc.max(lengths).as_py() != k:
        return None
    return as_dates(pc.list_flatten(column)).reshape(-1, k)


def _is_list(kind: pa.DataType) -> bool:
    return pa.types.is_list(kind) or pa.types.is_large_list(kind) or pa.types.is_fixed_size_list(kind)


def _is_text(kind: pa.DataType) -> bool:
    return pa.types.is_string(kind.value_type if pa.types.is_dictionary(kind) else kind) or pa.types.is_large_string(
        kind
    )


def _holds_numbers(kind: pa.DataType) -> bool:
    """Whether values of a type are numbers, lists of them, dates, or texts that may be dates."""
    if pa.types.is_dictionary(kind):
        kind = kind.value_type
    if _is_list(kind):
        return any(test(kind.value_type) for test in NUMBERS)
    return any(
        test(kind)
        for test in (*NUMBERS, pa.types.is_boolean, pa.types.is_temporal, pa.types.is_string, pa.types.is_large_string)
    )


def _npz(path: Path, wanted: set[str] | None) -> dict[str, Any]:
    # A field of a structured array is array.field.
    members = None if wanted is None else {w.rsplit(".", k)[0] for w in wanted for k in range(w.count(".") + 1)}
    check_zip(path, members)
    out: dict[str, Any] = {}
    with np.load(path, allow_pickle=False) as file:
        distinct([name.removesuffix(".npy") for name in file.zip.namelist()], members, path)
        for name in file.files:
            if members is not None and name not in members:
                continue
            try:
                x = file[name]
                out |= _fields(name, x) | ({name: x} if name in (wanted or ()) else {})
            except ValueError as err:
                if wanted is None:  # one that no one may want
                    continue
                objects = "Object arrays" in str(err)
                found = f"{name} is an array of Python objects" if objects else f"{name} is unreadable ({_reason(err)})"
                raise DataError("signal", str(path), found, "an array of numbers") from err
    return out


def _npy(path: Path, wanted: set[str] | None) -> dict[str, Any]:
    x = np.load(path, mmap_mode="r", allow_pickle=False)  # a header may tell of more than the file has
    return _fields("", x) if x.dtype.names else {VALUES: x.reshape(len(x), -1) if x.ndim == 1 else x}


def _fields(name: str, x: np.ndarray, depth: int = 0) -> dict[str, np.ndarray]:
    """An array by its name; of a structured one each field as name.field."""
    if not x.dtype.names or depth > DEEPEST:
        return {name: np.squeeze(x) if depth and x.ndim > 2 else x}
    out: dict[str, np.ndarray] = {}
    for field_name in x.dtype.names:
        out |= _fields(f"{name}.{field_name}" if name else field_name, x[field_name], depth + 1)
    return out


def _mcap(path: Path, wanted: set[str] | None) -> dict[str, Any]:
    from ident.convert.bags import read_mcap

    check_mcap(path)

    return read_mcap(path, wanted)


def _db3(path: Path, wanted: set[str] | None) -> dict[str, Any]:
    from ident.convert.bags import read_db3

    return read_db3(path, wanted)


READERS: dict[str, Reader] = {
    ".csv": read_text, ".txt": read_text, ".dat": read_text, ".tsv": read_text, ".parquet": _parquet, ".mat": read_matlab, ".npz": _npz,
    ".npy": _npy, ".mcap": _mcap, ".db3": _db3,
}  # fmt: skip
FORMATS = tuple(READERS)
# Names of signals of formats that tell them without being read; of others ``list_signals``.
NAMES: dict[str, Callable[[Path], Iterable[str]]] = {".parquet": lambda path: pa.parquet.read_schema(path).names}
