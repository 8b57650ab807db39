"""Logs of several formats as named arrays."""

from __future__ import annotations

import codecs
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.csv
import pyarrow.parquet

from ident.unpacked import check_matlab, check_mcap, check_size, check_zip
from robot_assets.errors import DataError

VALUES = "values"  # name of the whole table of a text file without a header
LOOKED_AT = 40  # lines of a text that say its delimiter and decimal sign
LONGEST_LINE = 1 << 20  # characters of one
ENCODING_BYTES = 1 << 16  # of a text that say how it is encoded
DEEPEST = 8  # structures inside structures that are looked into
Signals = dict[str, np.ndarray]


def read_log(path: Path, wanted: set[str], time: str | None = None) -> Signals:
    """The wanted signals of a log; a dot reaches into structures ("rec.act_pos").

    Args:
        time: the one that may be dates.

    Raises:
        DataError: where the file is missing, of another format, unreadable, or lacks a signal.
    """
    data = _read(path, wanted)
    out = {}
    for name in sorted(wanted):
        if name not in data:
            known = sorted(list_signals(path))
            raise DataError("signal", str(path), f"no {name}", f"one of {known[:30]}")
        try:
            x = np.asarray(data[name])
        except ValueError as err:  # ragged
            raise DataError("signal", str(path), f"{name} is no array of numbers", "numbers") from err
        if x.dtype.kind not in ("fiubMm" if name == time else "fiub"):
            raise DataError("signal", str(path), f"{name} is no array of numbers", "numbers")
        out[name] = x.astype(float)
    return out


def list_signals(path: Path) -> Signals:
    """All signals of a log that are numbers, single numbers included.

    Raises:
        DataError: where the file is missing, of another format or unreadable.
    """
    out = {}
    for name, value in _read(path, None).items():
        try:
            x = np.asarray(value)
            if x.dtype.kind in "fiub" and x.ndim <= 2:
                out[name] = x.astype(float)
        except (TypeError, ValueError):  # ragged
            continue
    return out


def _read(path: Path, wanted: set[str] | None) -> dict[str, Any]:
    """Signals of a file; None wants them all."""
    if not path.is_file():
        raise DataError("log", str(path), "no such file", f"a file of {FORMATS}")
    reader = READERS.get(path.suffix.lower())
    if reader is None:
        raise DataError("log", str(path), path.suffix or "no suffix", f"one of {FORMATS}")
    try:
        return reader(path, wanted)
    except DataError:
        raise
    except Exception as err:  # each reader raises types of its own for damaged files
        reason = str(err).splitlines()[0][:160] if str(err) else type(err).__name__
        raise DataError("log", str(path), f"unreadable ({reason})", "a complete file") from err


def _csv(path: Path, wanted: set[str] | None) -> dict[str, Any]:
    encoding = _encoding(path)
    with path.open(encoding=encoding, errors="replace") as file:
        first, *rows = (file.readline(LONGEST_LINE) for _ in range(LOOKED_AT))
    if _numbers(first):
        return _text(path, wanted)
    delimiter = max(",;\t", key=first.count)
    comma = delimiter != "," and any("," in x for x in rows) and not any("." in x for x in rows)
    with pa.csv.open_csv(
        path,
        read_options=pa.csv.ReadOptions(encoding="utf8" if encoding == "utf-8-sig" else encoding),
        parse_options=pa.csv.ParseOptions(delimiter=delimiter),
        convert_options=pa.csv.ConvertOptions(decimal_point="," if comma else "."),
    ) as reader:
        names = [n.strip() for n in reader.schema.names]
        _distinct(names, wanted, path)
        keep = [i for i, n in enumerate(names) if wanted is None or n in wanted]
        parts: dict[str, list[np.ndarray]] = {names[i]: [] for i in keep}
        for batch in reader:
            for i in keep:
                parts[names[i]].append(batch.column(i).to_numpy(zero_copy_only=False))
    return {n: np.concatenate(p) for n, p in parts.items() if p}


def _encoding(path: Path) -> str:
    """Of a text: UTF-16 by its mark, else UTF-8, or Latin-1 where it is none."""
    with path.open("rb") as file:
        head = file.read(ENCODING_BYTES)
    if head[:2] in (codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE):
        return "utf-16"
    try:
        codecs.getincrementaldecoder("utf-8")().decode(head)
    except UnicodeDecodeError:
        return "latin-1"
    return "utf-8-sig"


def _text(path: Path, wanted: set[str] | None) -> dict[str, Any]:
    """Numbers in rows, by blanks, commas, semicolons or tabs; names in a first line, or none."""
    with path.open(encoding="utf-8-sig", errors="replace") as file:
        first = file.readline()
    words = _words(first)
    delimiter = next((c for c in ",;" if c in first), None)
    header = not _numbers(first)
    comments = None if header else ("#", "%")
    with warnings.catch_warnings():
        warnings.simplefilter("error")  # NumPy only warns of a file without numbers
        x = np.loadtxt(path, delimiter=delimiter, skiprows=int(header), ndmin=2, comments=comments)
    if not header:
        return {VALUES: x}
    if len(words) != x.shape[1]:
        raise ValueError(f"{len(words)} names over {x.shape[1]} columns")
    _distinct(words, wanted, path)
    return {n: x[:, i] for i, n in enumerate(words)}


def _distinct(names: list[str], wanted: set[str] | None, path: Path) -> None:
    """Raise a DataError where a signal that is wanted stands in two columns."""
    double = sorted({n for n in names if names.count(n) > 1 and (wanted is None or n in wanted)}) if len(set(names)) < len(names) else []
    if double:
        raise DataError("signal", str(path), f"{double[0]} twice", "each signal once")


def _words(line: str) -> list[str]:
    for c in ",;\t":
        if c in line:
            return [w.strip() for w in line.strip().strip("#%").split(c)]
    return line.strip("#% \n").split()


def _numbers(line: str) -> bool:
    """Whether a line holds numbers alone."""
    try:
        return len([float(w) for w in _words(line)]) > 0
    except ValueError:
        return False


def _parquet(path: Path, wanted: set[str] | None) -> dict[str, Any]:
    file = pa.parquet.ParquetFile(path)
    schema = file.schema_arrow
    _distinct(schema.names, wanted, path)
    names = [n for n in schema.names if (wanted is None or n in wanted) and _holds_numbers(schema.field(n).type)]
    check_size(path, 8 * file.metadata.num_rows * len(names))
    table = file.read(columns=names)
    return {n: table.column(n).to_numpy() for n in table.column_names}


def _holds_numbers(kind: pa.DataType) -> bool:
    """Whether values of a type are numbers or dates."""
    if pa.types.is_dictionary(kind):
        kind = kind.value_type
    tests = (pa.types.is_integer, pa.types.is_floating, pa.types.is_boolean, pa.types.is_temporal)
    return any(test(kind) for test in tests)


def _npz(path: Path, wanted: set[str] | None) -> dict[str, Any]:
    check_zip(path, wanted)
    with np.load(path, allow_pickle=False) as file:
        return {n: file[n] for n in file.files if wanted is None or n in wanted}


def _mat(path: Path, wanted: set[str] | None) -> dict[str, Any]:
    import h5py
    import scipy.io

    if h5py.is_hdf5(path):
        with h5py.File(path) as file:
            return _hdf5(path, file, wanted)
    check_matlab(path)
    out: dict[str, Any] = {}

    def walk(name: str, value: Any, depth: int) -> None:
        if hasattr(value, "_fieldnames"):
            for key in value._fieldnames if depth < DEEPEST else []:
                walk(f"{name}.{key}", getattr(value, key), depth + 1)
        elif wanted is None or name in wanted:
            out[name] = value

    for name, value in scipy.io.loadmat(path, squeeze_me=True, struct_as_record=False).items():
        if isinstance(name, str) and not name.startswith("__"):
            walk(name, value, 0)
    return out


def _hdf5(path: Path, file: Any, wanted: set[str] | None) -> dict[str, Any]:
    """Arrays of numbers of a MATLAB 7.3 file."""
    import h5py

    found: dict[str, Any] = {}

    def visit(name: str, item: Any) -> None:
        dotted = name.replace("/", ".")
        if isinstance(item, h5py.Dataset) and item.dtype.kind in "fiu" and not name.startswith("#"):
            text = item.attrs.get("MATLAB_class", b"") == b"char"
            if not text and not item.attrs.get("MATLAB_empty", 0) and (wanted is None or dotted in wanted):
                found[dotted] = item

    file.visititems(visit)
    for name, item in found.items():
        if item.external or item.is_virtual:
            raise DataError("signal", str(path), f"{name}, which stands in another file", "one in the file itself")
    check_size(path, sum(item.size * item.dtype.itemsize for item in found.values()))
    # MATLAB's first dimension is the file's last.
    return {name: np.asarray(item).T for name, item in found.items()}


def _mcap(path: Path, wanted: set[str] | None) -> dict[str, Any]:
    from ident.convert.bags import read_mcap

    check_mcap(path)

    return read_mcap(path, wanted)


def _db3(path: Path, wanted: set[str] | None) -> dict[str, Any]:
    from ident.convert.bags import read_db3

    return read_db3(path, wanted)


READERS: dict[str, Callable[[Path, set[str] | None], dict[str, Any]]] = {
    ".csv": _csv, ".txt": _text, ".dat": _text, ".tsv": _text, ".parquet": _parquet, ".mat": _mat, ".npz": _npz,
    ".mcap": _mcap, ".db3": _db3,
}  # fmt: skip
FORMATS = tuple(READERS)
