"""Tables of numbers as text, read by columns in pieces: the memory is that of the numbers."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any, TextIO

import numpy as np
import pyarrow as pa
import pyarrow.csv

from ident.convert.cells import Cells
from ident.convert.encoding import unreadable
from ident.convert.layout import LONGEST_LINE, MOST_BROKEN, Layout, read_layout
from robot_assets.errors import DataError

VALUES = "values"  # name of the whole table of a text file without a header
MOST_CELLS = 8_000_000  # that a survey looks at: minutes of a log, and a bounded memory
PIECE = 1 << 20  # characters read at a time
SIGNS = "#% \t"  # before a header that is a comment
BLANKS = str.maketrans("\t\f\v", "   ")
UNEVEN = re.compile(r"(?:Row #(\d+): )?Expected (\d+) columns, got (\d+): (.*)", re.DOTALL)
COMMENT = re.compile(r"[#%].*")


def read_text(path: Path, wanted: set[str] | None, encoding: str = "") -> dict[str, Any]:
    """Columns (N,) by name, dates among them; one table ``VALUES`` (N, columns) where there is no header.

    Args:
        encoding: of the text, as it is stated; empty where it is not.

    Raises:
        DataError: where a signal that is wanted stands in two columns that differ, or a cell of it is none; with its
            row.
    """
    layout = read_layout(path, encoding)
    out: dict[str, np.ndarray] = {}
    for cells in scan_text(path, wanted, layout):
        x, name = cells.array(), wanted_name(cells.name, wanted)
        if x is None:
            continue
        if not alike(out.setdefault(name, x), x):
            found = f"{name} twice, and the columns differ"
            raise DataError("signal", str(path), found, "each signal once, with one time for all in the file")
    return out if layout.names else _table(out, layout)


def scan_text(path: Path, wanted: set[str] | None, layout: Layout) -> list[Cells]:
    """Columns as they were read. Where all are wanted (None), those of texts are left out, and a long log is read in
    part."""
    if layout.names:
        keep = {i: n for i, n in enumerate(layout.names) if n and (wanted is None or wanted_name(n, wanted) in wanted)}
    else:
        keep = {i: str(i) for i in range(layout.columns)} if wanted is None or VALUES in wanted else {}
    every = wanted is not None or not layout.names
    cells = {i: Cells(name, path, every, layout.delimiter == ",", layout.decimal) for i, name in keep.items()}
    for batch in _batches(path, layout, list(keep)) if keep else ():
        for i, column in cells.items():
            column.take(batch.column(str(i)))
        rows = next(iter(cells.values())).rows
        if wanted is None and (rows * len(cells) > MOST_CELLS or all(c.kind == "texts" for c in cells.values())):
            break
    for column in cells.values():
        column.end()
    return list(cells.values())


def alike(a: np.ndarray, b: np.ndarray) -> bool:
    """Whether two columns (N,) hold the same."""
    return a is b or (a.dtype == b.dtype and np.array_equal(a, b, equal_nan=True))


def wanted_name(name: str, wanted: set[str] | None) -> str:
    """A name as a map has it: "%time" of a header that is a comment may stand there with its sign."""
    return next((w for w in wanted or () if w != name and w.lstrip(SIGNS) == name and name not in (wanted or ())), name)


def text_names(path: Path, encoding: str = "") -> list[str]:
    """Names of the columns.

    Raises:
        DataError: where they can only be told by an encoding that is not stated.
    """
    layout = read_layout(path, encoding)
    check_names(path, layout)
    return [n for n in layout.names if n] or [VALUES]


def check_names(path: Path, layout: Layout) -> None:
    """Raise a DataError where names or units of columns are of an encoding that is not known."""
    strange = next((n for n in (*layout.names, *layout.units) if not n.isascii()), None)
    if layout.unsure and strange is not None:
        raise unreadable(path, strange)


def distinct(names: list[str], wanted: set[str] | None, path: Path) -> None:
    """Raise a DataError where a signal that is wanted stands in two columns."""
    double = sorted(n for n, times in Counter(names).items() if n and times > 1 and (wanted is None or n in wanted))
    if double:
        raise DataError("signal", str(path), f"{double[0]} twice", "each signal once")


def _table(columns: dict[str, np.ndarray], layout: Layout) -> dict[str, np.ndarray]:
    """All columns as one; a last one that is empty comes of a delimiter at the end of the rows."""
    if not columns:
        return {}
    x = [columns[k] for k in sorted(columns, key=int)]
    if any(c.dtype.kind in "Mm" for c in x):  # nothing names them
        raise ValueError("dates without a header")
    return {VALUES: np.stack(x, axis=1)}


def _batches(path: Path, layout: Layout, keep: list[int]) -> Iterator[pa.RecordBatch]:
    """Cells as texts: what a column holds is seen when it is read, not by its first rows.

    Piece by piece, and in this thread: one of Arrow's that still reads a Python object when all ends would abort.
    """
    options = {
        "parse_options": pa.csv.ParseOptions(delimiter=layout.delimiter or " "),
        "convert_options": pa.csv.ConvertOptions(
            include_columns=[str(i) for i in keep],
            column_types={str(i): pa.string() for i in keep},
            strings_can_be_null=True,
        ),
    }
    names = [str(i) for i in range(layout.columns)]
    for line, piece in _pieces(path, layout):
        read = pa.csv.ReadOptions(column_names=names, block_size=len(piece) + 1, use_threads=False)
        try:
            table = pa.csv.read_csv(pa.BufferReader(piece), read_options=read, **options)
        except pa.ArrowInvalid as err:
            uneven = UNEVEN.search(str(err))
            if uneven is None:
                raise
            at = f" in line {line + int(uneven[1])}" if uneven[1] else ""
            raise DataError(
                "row", str(path), f"{uneven[3]} columns{at}: {uneven[4][:60]!r}", f"{uneven[2]} as in the rows above"
            ) from err
        yield from table.to_batches()


def _pieces(path: Path, layout: Layout) -> Iterator[tuple[int, bytes]]:
    """Whole lines of the rows with the number of lines before them; of blanks only one between words, and comments left
    out."""
    with path.open(encoding=layout.encoding, errors="replace", newline=None) as file:
        for _ in range(layout.start):
            file.readline(LONGEST_LINE)
        line, ahead = layout.start, ""
        while text := ahead + file.read(PIECE):
            ahead = ""
            end = file.readline(LONGEST_LINE)
            if len(end) >= LONGEST_LINE:
                raise DataError("log", str(path), f"a line of more than {LONGEST_LINE / 2**20:g} MB", "rows of numbers")
            text += end
            if text.count('"') % 2:
                rest, ends = _rest_of_cell(file)
                text, ahead = (text + rest, "") if ends else (text, rest)
            lines = text.count("\n")
            if not layout.names:
                text = COMMENT.sub("", text)
            if layout.delimiter is None:
                text = _single_blanks(text)
            if text.strip():
                yield line, text.encode()
            line += lines


def _rest_of_cell(file: TextIO) -> tuple[str, bool]:
    """The next lines up to one that ends a cell in quotes, which may hold breaks, and whether one does soon: else the
    quotes above belong to no such cell."""
    rest = ""
    for _ in range(MOST_BROKEN):
        rest += file.readline(LONGEST_LINE)
        if rest.count('"') % 2:
            return rest, True
    return rest, False


def _single_blanks(text: str) -> str:
    """Lines with one blank between words and none about them; replacements are many times faster than a pattern."""
    text = text.translate(BLANKS) if any(chr(c) in text for c in BLANKS) else text
    while "  " in text:
        text = text.replace("  ", " ")
    return text.replace(" \n", "\n").replace("\n ", "\n").removeprefix(" ").removesuffix(" ")
