"""The cells of one column of a text as numbers or dates, taken batch by batch as the text is read."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from ident.convert.dates import DATE, date_order, day_and_month_swapped, is_date, parse_dates
from ident.convert.numerals import plain_numbers
from robot_assets.errors import DataError

NUMBER = r"(?i)^\s*([+-]?(\d+\.?\d*|\.\d+)([ed][+-]?\d+)?|[+-]?inf(inity)?|[+-]?nan|)\s*$"
THOUSANDS = r"^\s*[+-]?[1-9]\d?\d?(,\d\d\d)+\s*$"
FORTRAN = r"^([+-]?[0-9.]+)[dD]([+-]?[0-9]+)$"  # an exponent of its double precision
LABELLED, MOST_LABELS = 10_000, 100  # cells that tell what a column of texts holds, as many kinds as joints
SEVERAL_COMMAS = r",.*,"
OTHER = {",": ".", ".": ","}
# By the decimal sign of a text: numbers with the other sign between their thousands; and what shows that it stands
# there: two of them, a decimal sign behind one, or a number below a thousand without one.
GROUPED = {
    ",": r"^\s*[+-]?[1-9]\d?\d?(\.\d\d\d)+(,\d*)?\s*$",
    ".": r"^\s*[+-]?[1-9]\d?\d?(,\d\d\d)+(\.\d*)?\s*$",
}
SHOWN = {
    ",": r"^\s*[+-]?(\d+\.\d+\.[\d.]+(,\d*)?|[\d.]+,\d*|\d{1,3})\s*$",
    ".": r"^\s*[+-]?(\d+,\d+,[\d,]+(\.\d*)?|[\d,]+\.\d*|\d{1,3})\s*$",
}


class Cells:
    """One column while it is read; what is kept of it is numbers, however long its texts are.

    Attributes:
        kind: "numbers", "dates" or "texts"; empty as long as all cells were. rows: taken.
        order: of year, month and day in its dates, and whether it is a guess.
        fault: (row from 1, text) of the first that is none like those above it.
        labels: distinct texts of its first cells, where they are no numbers and few.
    """

    def __init__(self, name: str, path: Path, wanted: bool, quoted: bool, decimal: str = "") -> None:
        """``wanted``: whether a text is an error. ``quoted``: whether a comma within a cell stood in quotes.
        ``decimal``: sign of the decimals of the whole text; empty where that is not plain."""
        self.name, self.path, self.wanted, self.quoted, self.decimal = name, path, wanted, quoted, decimal
        self.kind, self.rows, self.like, self.order = "", 0, "", ("ymd", False)
        self.comma = self.dot = self.typeset = False
        self.fault: tuple[int, str] | None = None
        self.labels: tuple[str, ...] = ()
        self._parts: list[np.ndarray] = []
        self._grouped: tuple[int, str] | None = None  # (row, text) of the first with a sign between its thousands
        self._above = ""  # the last date, as long as the order of day and month is a guess
        self._shown = self._pointed = False  # whether a cell shows that these are thousands; that they are none

    def take(self, column: pa.Array) -> None:
        """Take the next cells.

        Raises:
            DataError: where one that is wanted is no number and no date, with its row.
        """
        if not self.kind and column.null_count < len(column):
            self.like = _text(column.drop_null()[0]).strip()
            self.kind = "dates" if is_date(self.like) else "numbers"
            self.order = date_order(column) if self.kind == "dates" else self.order
        if self.kind != "texts":
            try:
                part = self._dates(column) if self.kind == "dates" else self._any_numbers(column)
                self._parts.append(part)
            except (pa.ArrowInvalid, ValueError):
                self._refuse(column)
        self.rows += len(column)

    def end(self) -> None:
        """Say, of all cells, whether signs between their digits may be decimal ones as well as between thousands.

        Raises:
            DataError: where they may, and are wanted.
        """
        if self._grouped is None or self._shown or self.kind != "numbers":
            return
        if any(np.any(np.abs(part) < 1000) for part in self._parts):
            return
        row, text = self.fault = self._grouped
        if self.wanted:
            found = f"{self.name} = {text[:60]!r} in row {row}, where decimals stand behind {self.decimal!r} elsewhere"
            raise DataError("signal", str(self.path), found, "one decimal sign, and no sign between thousands")

    def array(self) -> np.ndarray | None:
        """(N,) what was taken; None where it was texts, or nothing."""
        if not self.kind or self.kind == "texts":
            return None
        parts, self._parts = self._parts, []
        if self.kind == "dates":  # empty cells above the first
            other = next(p.dtype for p in parts if p.dtype.kind in "Mm")
            parts = [p if p.dtype.kind in "Mm" else np.full(len(p), "NaT", other) for p in parts]
        return np.concatenate(parts)

    def _dates(self, column: pa.Array) -> np.ndarray:
        written = column.null_count < len(column) and pc.any(pc.not_equal(column, "")).as_py()
        order = date_order(column, self._above) if self.order[1] and written else self.order
        if order[0] != self.order[0]:  # above it was a guess
            self._parts = [day_and_month_swapped(p) if p.dtype.kind == "M" else p for p in self._parts]
        self.order = order
        if order[1] and written:
            self._above = _text(column.drop_null()[-1])
        return parse_dates(column, self.like, self.order)

    def _any_numbers(self, column: pa.Array) -> np.ndarray:
        """Numbers, typeset ones too: these are asked for where the first is met, as it takes time."""
        if not self.typeset:
            state = self.comma, self.dot, self._grouped, self._shown, self._pointed
            try:
                return self._numbers(column)
            except (pa.ArrowInvalid, ValueError):
                if plain_numbers(column) is column:
                    raise
                # What the first try took for decimals may be thousands behind a minus that it did not know.
                self.comma, self.dot, self._grouped, self._shown, self._pointed = state
                self.typeset = True
        return self._numbers(plain_numbers(column))

    def _numbers(self, column: pa.Array) -> np.ndarray:
        column = self._without_thousands(column) if self.decimal == "," else column
        if not self.comma:
            try:
                out = _cast(column)
                self.dot = self.dot or bool(pc.any(pc.match_substring(column, ".")).as_py())
                return out
            except pa.ArrowInvalid:
                if self.decimal == "." and (plain := self._without_thousands(column)) is not column:
                    return _cast(plain)
        # A comma is the decimal sign where no point is; in quotes it may also part thousands.
        if (
            self.dot
            or pc.any(pc.match_substring(column, ".")).as_py()
            or pc.any(pc.match_substring_regex(column, SEVERAL_COMMAS)).as_py()
        ):
            raise ValueError("both signs")
        commas = column.filter(pc.match_substring(column, ",").fill_null(False))
        if (
            self.quoted
            and self.decimal != ","
            and not self.comma
            and len(commas)
            and pc.all(pc.match_substring_regex(commas, THOUSANDS)).as_py()
        ):
            raise ValueError("thousands")
        out = _cast(pc.replace_substring(column, ",", "."))
        self.comma = True
        return out

    def _without_thousands(self, column: pa.Array) -> pa.Array:
        """Cells without the sign between thousands, where all that have another sign than that of the decimals of the
        text are written so; else as they are.

        Raises:
            ValueError: where some are and others are not.
        """
        other = OTHER[self.decimal]
        signed = column.filter(pc.match_substring(column, other).fill_null(False))
        if not len(signed) or self._pointed:
            return column
        if not pc.all(pc.match_substring_regex(signed, GROUPED[self.decimal])).as_py():
            if self._grouped is not None:
                raise ValueError("thousands above, but not here")
            self._pointed = True  # a column with decimals of its own
            return column
        self._grouped = self._grouped or (self.rows + pc.index(column, signed[0]).as_py() + 1, _text(signed[0]).strip())
        self._shown = self._shown or bool(pc.any(pc.match_substring_regex(column, SHOWN[self.decimal])).as_py())
        return pc.replace_substring(column, other, "")

    def _refuse(self, column: pa.Array) -> None:
        """Of cells that are not all like those above: an error, or texts; a few among numbers are none, and told."""
        if self.kind == "dates":
            cells = [_text(x).strip() for x in column]
            bad = np.array(
                [c != "" and (not is_date(c) or bool(DATE.match(c)) != bool(DATE.match(self.like))) for c in cells]
            )
            if not np.any(bad):
                bad[self._no_date(column)] = True
        else:
            plain = read = plain_numbers(column)
            if self._grouped is not None:
                grouped = pc.match_substring_regex(read, GROUPED[self.decimal])
                plain = pc.if_else(grouped, pc.replace_substring(read, OTHER[self.decimal], ""), read)
            if self.comma or (not self.dot and not self.quoted):
                plain = pc.replace_substring(plain, ",", ".")
            bad = ~pc.match_substring_regex(plain, NUMBER).fill_null(True).to_numpy(zero_copy_only=False)
            if self._grouped is not None and not np.any(bad):
                bad = pc.match_substring(read, OTHER[self.decimal]).fill_null(False).to_numpy(zero_copy_only=False)
                bad &= ~grouped.fill_null(True).to_numpy(zero_copy_only=False)
        index = int(np.argmax(bad))
        row, text = self.rows + index + 1, _text(column[index]).strip()
        first = text == self.like and not any(np.any(~np.isnan(p)) for p in self._parts)
        self.fault = self.fault or (row, text)
        if not self.wanted and self.kind == "numbers" and not first and 2 * bad.sum() < len(column) - column.null_count:
            self._parts.append(_cast(pc.if_else(pa.array(~bad), plain, pa.scalar(None, plain.type))))
            return
        kind, self.kind = self.kind, "texts"
        self._parts = []
        if not self.wanted:
            self.labels = () if self.rows else labels_of(_text(x) for x in column.slice(0, LABELLED))
            return
        if kind == "dates":
            raise DataError(
                "signal",
                str(self.path),
                f"{self.name} = {text[:60]!r} in row {row}",
                "dates that exist, all written in one way",
            )
        if first:
            what = "true and false" if text.lower() in ("true", "false") else f"texts: {text[:60]!r} in row {row}"
            raise DataError("signal", str(self.path), f"{self.name} is no array of numbers but of {what}", "numbers")
        if text == self.name:
            raise DataError(
                "signal", str(self.path), f"the header again in row {row}", "one log: cut the file in two there"
            )
        lost = (
            ", and the encoding of the log where it is none of UTF-8 (encoding in the map)" if "\ufffd" in text else ""
        )
        raise DataError("signal", str(self.path), f"{self.name} = {text[:60]!r} in row {row}", f"numbers{lost}")

    def _no_date(self, column: pa.Array) -> int:
        """The first that is written as a date, but is none of the calendar: the first half with one, halved again."""
        low, high = 0, len(column)
        while high - low > 1:
            middle = (low + high) // 2
            try:
                parse_dates(column.slice(low, middle - low), self.like, self.order)
                low = middle
            except pa.ArrowInvalid:
                high = middle
        return low


def labels_of(texts: Iterable[Any]) -> tuple[str, ...]:
    """Distinct texts, where they are few and nothing else stands among them; else none."""
    found = dict.fromkeys(texts)
    few = 0 < len(found) <= MOST_LABELS and all(isinstance(x, str) for x in found)
    return tuple(str(x).strip() for x in found) if few else ()


def _cast(column: pa.Array) -> np.ndarray:
    try:
        out = column.cast(pa.float64())
    except pa.ArrowInvalid:
        texts = pc.replace_substring_regex(pc.utf8_trim_whitespace(column), FORTRAN, r"\1e\2")
        out = pc.if_else(pc.equal(texts, ""), pa.scalar(None, texts.type), texts).cast(pa.float64())
    return out.to_numpy(zero_copy_only=False)


def _text(cell: pa.Scalar) -> str:
    """A cell whose bytes may be those of another encoding."""
    return "" if not cell.is_valid else cell.cast(pa.binary()).as_py().decode("utf-8", errors="replace")
