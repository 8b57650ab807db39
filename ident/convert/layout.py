"""How a text with a table of numbers is laid out: comments, a header, a row of units, then rows; or rows alone."""

from __future__ import annotations

import csv
import itertools
import re
from collections import deque
from collections.abc import Iterable
from dataclasses import dataclass
from functools import cache
from pathlib import Path

from ident.convert.dates import is_date
from ident.convert.encoding import encoding_of, western
from ident.convert.numerals import SPACES, plain_number
from ident.convert.spelling import unit_of
from robot_assets.errors import DataError

LOOKED_AT = 100  # lines that say how the table is laid out
MOST_LOOKED_AT = 1 << 22  # characters of them
MOST_COMMENTS = 100_000  # lines before the header
LONGEST_LINE = 1 << 20  # characters of one
PAIRED_TIME = "Time"  # as columns of time before each channel are called, which have no name
BRACKETED = re.compile(r"\[(.+?)\]")
# A number with decimals, and the sign before them; and one whose sign may as well stand between thousands.
DECIMALS = re.compile(r"(?i)[+-]?(?:\d*([.,])\d+|\d+(?:[.,]\d{3})+([.,])\d*)(?:[ed][+-]?\d+)?$")
THREE = re.compile(r"[+-]?[1-9]\d{0,2}([.,])\d{3}(?:\1\d{3})*$")
QUOTED = re.compile(r'(?:^|[,;\t])[ ]*"')
WORD = re.compile(rf"\"([^\"]*)\"|'([^']*)'|((?:\S|[{SPACES}])+)")  # what stands between digits parts no words
NONE = ("na", "n/a", "#n/a", "null")
MOST_BROKEN = 20  # lines of one row, whose cells in quotes have breaks


@dataclass(frozen=True)
class Layout:
    """How a text is laid out.

    Attributes:
        encoding: of Python; Latin-1, which keeps all bytes, where ``unsure``: they do not tell it.
        delimiter: one character, or None for blanks.
        names: of the columns; empty where no line says them. units: as written below the names, or empty.
        start: lines before the first row. columns: of a row.
        decimal: sign of the decimals, "." or ","; empty where the first rows have both, or none that is plain.
    """

    encoding: str
    delimiter: str | None
    names: tuple[str, ...]
    units: tuple[str, ...]
    start: int
    columns: int
    decimal: str = ""
    unsure: bool = False


def read_layout(path: Path, encoding: str = "") -> Layout:
    """Look at the first lines of a text.

    Args:
        encoding: as it is stated; empty where it is not.

    Raises:
        DataError: where a line is too long for a table, or the text is none of the encoding.
    """
    told = encoding_of(path, encoding)
    layout = _read_layout(path, told or "latin-1", not told)
    # Read once more, as signs that Latin-1 lacks may have been lost about the names.
    return _read_layout(path, "cp1252", False) if not told and western(path, layout.names + layout.units) else layout


def _read_layout(path: Path, encoding: str, unsure: bool) -> Layout:
    """As ``read_layout``, of an encoding that is known, or taken until names tell it."""
    comments: deque[str] = deque(maxlen=2)
    skipped, looked_at = 0, 0
    with path.open(encoding=encoding, errors="replace", newline=None) as file:
        line = file.readline(LONGEST_LINE)
        while line and _comment(line) and skipped < MOST_COMMENTS:
            comments.append(line)
            skipped += 1
            line = file.readline(LONGEST_LINE)
        rows = [line]
        while line and len(rows) <= LOOKED_AT and looked_at < MOST_LOOKED_AT:
            line = file.readline(LONGEST_LINE)
            looked_at += len(line)
            rows.append(line)
    rows = [r for r in rows if r]
    if any(len(r) >= LONGEST_LINE for r in (*comments, *rows)):
        raise DataError("log", str(path), f"a line of more than {LONGEST_LINE / 2**20:g} MB", "rows of numbers")
    rows = _whole_rows(rows)
    # Before each row; the last of all may have no break at its end.
    lines = list(itertools.accumulate((max(r.count("\n"), 1) for r in rows), initial=skipped))
    pairs = _pairs(rows)
    if pairs is not None:
        names, units, start = pairs
        decimal = _decimal(w for r in rows[start:] for w in _words(r, "\t"))
        return Layout(encoding, "\t", names, units, lines[start], len(names), decimal, unsure)
    above = _header(rows)
    comments.extend(r for r in rows[:above] if _comment(r))
    rows = rows[above:]
    first = rows[0] if rows else ""
    delimiter = _delimiter(first, rows[1] if len(rows) > 1 else first)
    words = _words(first, delimiter)
    names, units, start = words, (), 0
    # A header may be a comment itself: "# t q tau", above "# s rad Nm"; its row may hold texts, "%time,name,q" those of
    # ROS.
    said = [
        w
        for w in (_words(c.lstrip("#% \t"), delimiter) for c in comments)
        if len(w) == len(words) and not any(map(_value, w))
    ]
    if _row(words) or (said and len(words) > 1 and any(map(_value, words))):
        units = said.pop() if len(said) == 2 and _units(said[1]) else ()
        names = said[-1] if said else ()
    else:
        below, first_row = (_words(r, delimiter) for r in rows[1:3]) if len(rows) > 2 else ((), ())
        units = below if len(below) == len(words) and _units(below) and _units_above(below, first_row) else ()
        start += 1 + bool(units)
    columns = len(words)
    written = [w for r in rows[start:][:-1] if not _comment(r) and any(w := _words(r, delimiter))]
    if names and written and all(_as_many(len(names), w) for w in written):
        columns = len(written[0])  # a delimiter may stand at the end of rows, or of the header, alone
        names = (*names, "")[:columns]
    begins = lines[min(above + start, len(lines) - 1)]
    decimal = _decimal(w for row in written for w in row)
    return Layout(encoding, delimiter, names, units, begins, columns, decimal, unsure)


def _whole_rows(lines: list[str]) -> list[str]:
    """Rows of lines: a cell in quotes may hold breaks. One that does not end stands by itself, as such quotes are none;
    one that is cut at the last line is left out."""
    out, k = [], 0
    while k < len(lines):
        end, row = k + 1, lines[k]
        if _open(row):
            while end < min(k + MOST_BROKEN, len(lines)) and _open(row):
                row, end = row + lines[end], end + 1
            if _open(row):
                if end == len(lines) and k:
                    break
                end, row = k + 1, lines[k]
        out.append(row)
        k = end
    return out


def _open(row: str) -> bool:
    """Whether a row ends within a cell in quotes."""
    return row.count('"') % 2 == 1 and not _comment(row) and QUOTED.search(row) is not None


def _header(rows: list[str]) -> int:
    """The line from which on all lines have as many words: programs write a preamble of lines of their own above it."""

    @cache
    def words(k: int, delimiter: str | None) -> tuple[str, ...]:
        return _words(rows[k], delimiter)

    full = [k for k, r in enumerate(rows) if not _comment(r)]
    for i, (k, below) in enumerate(itertools.pairwise(full)):
        delimiter = _delimiter(rows[k], rows[below])
        names, rest = words(k, delimiter), [words(m, delimiter) for m in full[i + 1 :]]
        if len(names) < 2 or (i and any(map(_value, names))) or not all(_as_many(len(names), w) for w in rest):
            continue
        head = rest[1] if _units(rest[0]) and len(rest) > 1 else rest[0]
        if any(map(_value, head)) and all(
            _value(a) or not a for a, z in zip(head, rest[-1], strict=False) if _value(z)
        ):
            return k
    return 0


def _pairs(rows: list[str]) -> tuple[tuple[str, ...], tuple[str, ...], int] | None:
    """(names, units, line of the first row) of a table with a time column before that of each channel, as TwinCAT's
    Scope writes it: above the numbers each line has a key in the place of each time; None where it is none."""
    table = [_words(r, "\t") for r in rows]
    k = next((k for k, w in enumerate(table) if len(w) > 3 and {x.lower() for x in w[::2]} - {""} == {"name"}), None)
    first = next((m for m, w in enumerate(table) if k is not None and m > k and len(w) > 3 and _row(w)), None)
    if k is None or first is None:
        return None
    columns = len(table[first])
    channels = table[k][1::2][: columns // 2]
    told = {w[0].split("[")[0].strip().lower(): w for w in table[k + 1 : first] if len(w) > 1}
    step = BRACKETED.search(told.get("sampletime", ("",))[0])
    units = (*told.get("unit", ())[1::2], *[""] * len(channels))[: len(channels)]
    if columns not in (2 * len(channels), 2 * len(channels) + 1) or not all(channels):
        return None
    rest = ("",) * (columns - 2 * len(channels))
    names = tuple(name for channel in channels for name in (PAIRED_TIME, channel))
    return names + rest, tuple(u for unit in units for u in (step[1] if step else "", unit)) + rest, first


def _as_many(n: int, words: tuple[str, ...]) -> bool:
    """Whether a row has ``n`` words, or one more or less that is empty: a delimiter may stand at the end of either."""
    return len(words) == n or (len(words) == n + 1 and not words[-1]) or len(words) == n - 1


def _decimal(words: Iterable[str]) -> str:
    """The only sign behind which decimals stand for sure in words: no three digits that may be thousands do."""
    found = {m[1] or m[2] for w in map(plain_number, words) if (m := DECIMALS.match(w)) and not THREE.match(w)}
    return found.pop() if len(found) == 1 else ""


def _comment(line: str) -> bool:
    """Whether a line before the header says nothing: a comment, a blank one, or the delimiter, as spreadsheets have
    it."""
    start = line.lstrip()
    return not start or start[0] in "#%" or start.lower().startswith("sep=")


def _delimiter(first: str, second: str) -> str | None:
    """Of a header and the row below; None for blanks."""
    there = [c for c in ";\t," if c in first]
    if there:
        # A name may hold a comma, in the quotes that spreadsheets put about it, and so may numbers without names.
        return max(there, key=lambda c: (len(_words(first, c)) == len(_words(second, c)), c != ",", first.count(c)))
    return None if _words(second, None)[1:] or _words(first, None)[1:] else ","


def _words(line: str, delimiter: str | None) -> tuple[str, ...]:
    """Of one row, without quotes and breaks; a comment that is a header loses its sign."""
    line = line.strip(" \r\n") if delimiter == "\t" else line.strip()
    if "\n" in line:  # of a cell in quotes; no pattern, which would look through long runs of blanks time and again
        line = " ".join(p for part in line.split("\n") if (p := part.strip()))
    if delimiter is None:
        words = [m[1] or m[2] or m[3] or "" for m in WORD.finditer(line)]
    else:
        words = next(csv.reader([line], delimiter=delimiter, skipinitialspace=True), [])
    return tuple(w.strip().strip("\"'").strip() for w in words)


def _row(words: tuple[str, ...]) -> bool:
    """Whether words are a row of numbers, and dates, rather than names."""
    return any(words) and all(_value(w) for w in words if w)


def _value(word: str) -> bool:
    """Whether a word is a number, a date, or says that there is none."""
    try:
        float(plain_number(word).replace(",", ".").lower().replace("d", "e"))  # of Fortran as well
    except ValueError:
        return is_date(word) or word.lower() in NONE
    return True


def _units(words: tuple[str, ...]) -> bool:
    """Whether words are units: one is known, and none is a number."""
    return any(unit_of(w.strip("[](){}<> ")) for w in words) and not any(_value(w) for w in words if w)


def _units_above(units: tuple[str, ...], row: tuple[str, ...]) -> bool:
    """Whether a row of numbers, some of which may be texts, stands below units: one that is known is above a number."""
    return _row(row) or any(unit_of(u.strip("[](){}<> ")) and _value(x) for u, x in zip(units, row, strict=False))
