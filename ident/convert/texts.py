"""Tables of numbers as text: comments, a header, a row of units, then rows; or rows alone."""

from __future__ import annotations

import codecs
import csv
import re
import warnings
from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.csv

from ident.convert.dates import as_dates
from ident.convert.spelling import unit_of
from robot_assets.errors import DataError

VALUES = "values"  # name of the whole table of a text file without a header
LOOKED_AT = 40  # rows that say how numbers are written
MOST_COMMENTS = 1000  # lines before the header
LONGEST_LINE = 1 << 20  # characters of one
ENCODING_BYTES = 1 << 16  # of a text that say how it is encoded
DATE = re.compile(r"\d{4}-\d\d-\d\d([T ]|$)|\d\d?:\d\d:\d\d([.,]\d+)?$")


@dataclass(frozen=True)
class Layout:
    """How a text is laid out.

    Attributes:
        encoding: of Python. delimiter: one character, or None for blanks.
        comma: whether a comma is the decimal sign.
        names: of the columns; empty where no line says them. units: as written below the names, or empty.
        start: lines before the first row.
    """

    encoding: str
    delimiter: str | None
    comma: bool
    names: tuple[str, ...]
    units: tuple[str, ...]
    start: int


def read_layout(path: Path) -> Layout:
    """Look at the first lines of a text.

    Raises:
        DataError: where a line is too long for a table.
    """
    encoding = _encoding(path)
    comments: list[str] = []
    with path.open(encoding=encoding, errors="replace", newline=None) as file:
        line = file.readline(LONGEST_LINE)
        while line and _comment(line) and len(comments) < MOST_COMMENTS:
            comments.append(line)
            line = file.readline(LONGEST_LINE)
        rows = [line, *(file.readline(LONGEST_LINE) for _ in range(LOOKED_AT))]
    rows = [r for r in rows if r]
    if any(len(r) >= LONGEST_LINE for r in (*comments, *rows)):
        raise DataError("log", str(path), f"a line of more than {LONGEST_LINE / 2**20:g} MB", "rows of numbers")
    first = rows[0] if rows else ""
    delimiter = _delimiter(first, rows[1] if len(rows) > 1 else first)
    words = _words(first, delimiter)
    names, units, start = words, (), len(comments)
    if _row(words):
        # A header may be a comment itself: "# t q tau", above "# s rad Nm".
        above = [w for w in (_words(c.lstrip("#% \t"), delimiter) for c in comments[-2:]) if len(w) == len(words) and not _row(w)]
        units = above.pop() if len(above) == 2 and _units(above[1]) else ()
        names = above[-1] if above else ()
    else:
        below = _words(rows[1], delimiter) if len(rows) > 2 and _row(_words(rows[2], delimiter)) else ()
        units = below if len(below) == len(words) and _units(below) else ()
        start += 1 + bool(units)
    written = rows[start - len(comments) :]
    comma = delimiter != "," and any("," in r for r in written) and not any("." in r for r in written)
    return Layout(encoding, delimiter, comma, names, units, start)


def read_text(path: Path, wanted: set[str] | None) -> dict[str, Any]:
    """Columns (N,) by name, dates among them; one table ``VALUES`` (N, columns) where there is no header.

    Raises:
        DataError: where a signal that is wanted stands in two columns.
    """
    layout = read_layout(path)
    distinct(list(layout.names), wanted, path)
    if layout.delimiter is None or not layout.names:
        return _plain(path, layout)
    keep = [i for i, n in enumerate(layout.names) if n and (wanted is None or n in wanted)]
    if not keep:
        return {}
    parts: dict[int, list[np.ndarray]] = {i: [] for i in keep}
    with _rows(path, layout, keep, _types(path, layout, keep, wanted is not None)) as reader:
        for batch in reader:
            for i in keep:
                parts[i].append(as_dates(batch.column(str(i))))
    return {layout.names[i]: np.concatenate(p) for i, p in parts.items() if p}


def text_units(path: Path) -> dict[str, str]:
    """Name -> unit as written in a row below the header; empty where there is none."""
    layout = read_layout(path)
    return {n: u for n, u in zip(layout.names, layout.units, strict=False) if u}


def distinct(names: list[str], wanted: set[str] | None, path: Path) -> None:
    """Raise a DataError where a signal that is wanted stands in two columns."""
    double = sorted(n for n, times in Counter(names).items() if times > 1 and (wanted is None or n in wanted))
    if double:
        raise DataError("signal", str(path), f"{double[0]} twice", "each signal once")


def _types(path: Path, layout: Layout, keep: list[int], wanted: bool) -> dict[str, pa.DataType]:
    """Of columns whose first rows do not show what later ones hold: fractions after whole numbers, or of a second."""
    with _rows(path, layout, keep, {}) as reader:
        schema = reader.schema
        start = reader.read_next_batch() if any(pa.types.is_string(f.type) for f in schema) else None
    out: dict[str, pa.DataType] = {}
    for field in schema:
        if pa.types.is_integer(field.type) or (wanted and pa.types.is_null(field.type)):
            out[field.name] = pa.float64()
        elif pa.types.is_timestamp(field.type):
            out[field.name] = pa.timestamp("ns", field.type.tz)
        elif pa.types.is_time(field.type) or (start is not None and _times_of_day(start.column(field.name))):
            out[field.name] = pa.time64("ns")
    return out


def _times_of_day(column: pa.Array) -> bool:
    return pa.types.is_string(column.type) and len(column) > 0 and all(
        ":" in x and DATE.match(x) is not None and "," not in x for x in column.slice(0, LOOKED_AT).to_pylist() if x
    )


def _rows(path: Path, layout: Layout, keep: list[int], types: dict[str, pa.DataType]) -> pa.csv.CSVStreamingReader:
    return pa.csv.open_csv(
        path,
        read_options=pa.csv.ReadOptions(
            encoding="utf8" if layout.encoding == "utf-8-sig" else layout.encoding,
            column_names=[str(i) for i in range(len(layout.names))],
            skip_rows=layout.start,
        ),
        parse_options=pa.csv.ParseOptions(delimiter=layout.delimiter),
        convert_options=pa.csv.ConvertOptions(
            decimal_point="," if layout.comma else ".", include_columns=[str(i) for i in keep], column_types=types
        ),
    )


def _plain(path: Path, layout: Layout) -> dict[str, Any]:
    """Numbers alone, which need no types."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")  # NumPy only warns of a file without numbers
        x = np.loadtxt(
            path,
            delimiter=layout.delimiter,
            skiprows=layout.start,
            ndmin=2,
            comments=None if layout.names else ("#", "%"),
            encoding=layout.encoding,
            converters=(lambda word: float(word.replace(",", "."))) if layout.comma else None,
        )
    if not layout.names:
        return {VALUES: x}
    if len(layout.names) != x.shape[1]:
        raise ValueError(f"{len(layout.names)} names over {x.shape[1]} columns")
    return {n: x[:, i] for i, n in enumerate(layout.names)}


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


def _comment(line: str) -> bool:
    """Whether a line before the header says nothing: a comment, a blank one, or the delimiter, as spreadsheets have it."""
    start = line.lstrip()
    return not start or start[0] in "#%" or start.lower().startswith("sep=")


def _delimiter(first: str, second: str) -> str | None:
    """Of a header and the row below; None for blanks."""
    there = [c for c in ";\t," if c in first]
    if there:
        # A name may hold a comma, in the quotes that spreadsheets put about it, and so may numbers without names.
        return max(there, key=lambda c: (len(_words(first, c)) == len(_words(second, c)), c != ",", first.count(c)))
    return None if second.split()[1:] or first.split()[1:] else ","


def _words(line: str, delimiter: str | None) -> tuple[str, ...]:
    """Of one line, without quotes; a comment that is a header loses its sign."""
    line = line.strip(" \r\n") if delimiter == "\t" else line.strip()
    if delimiter is None:
        words = [m[1] or m[2] or m[3] or "" for m in re.finditer(r"\"([^\"]*)\"|'([^']*)'|(\S+)", line)]
    else:
        words = next(csv.reader([line], delimiter=delimiter, skipinitialspace=True), [])
    return tuple(w.strip().strip("\"'").strip() for w in words)


def _row(words: tuple[str, ...]) -> bool:
    """Whether words are a row of numbers, and dates, rather than names."""
    return any(words) and all(_value(w) for w in words if w)


def _value(word: str) -> bool:
    try:
        float(word.replace(",", "."))
    except ValueError:
        return DATE.match(word) is not None
    return True


def _units(words: tuple[str, ...]) -> bool:
    """Whether words are units: one is known, and none is a number."""
    return any(unit_of(w.strip("[](){}<> ")) for w in words) and not any(_value(w) for w in words if w)
