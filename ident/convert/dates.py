"""Dates and times of the day as NumPy has them, however a log writes them."""

from __future__ import annotations

import re
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

CLOCK = r"\d\d?:\d\d(:\d\d([.,]\d{1,9})?)?( ?[AaPp][Mm])?"
ZONE = r"(Z|[+-]\d\d:?\d\d)$"
DATE = re.compile(
    rf"(?P<a>\d{{1,4}})(?P<sign>[-./])(?P<b>\d\d?)(?P=sign)(?P<c>\d{{1,4}})([T ] ?{CLOCK}(Z|[+-]\d\d:?\d\d)?)?$"
)
TIME = re.compile(rf"{CLOCK}$")
DAY = 86400.0  # s


def is_date(text: str) -> bool:
    """Whether a text is a date, or a time of the day."""
    found = DATE.match(text)
    return TIME.match(text) is not None if found is None else (len(found["a"]) == 4) != (len(found["c"]) == 4)


def as_dates(column: pa.Array | pa.ChunkedArray) -> np.ndarray:
    """(N,) values of a column: dates as datetime64, times of the day and durations as timedelta64."""
    if isinstance(column, pa.ChunkedArray):
        column = column.combine_chunks()  # texts of dates are told by all of them
        if isinstance(column, pa.ChunkedArray):
            return np.concatenate([as_dates(chunk) for chunk in column.chunks]) if column.num_chunks else np.zeros(0)
    if pa.types.is_time(column.type):
        counts = column.cast(pa.int32() if column.type.bit_width == 32 else pa.int64())
        out = (
            counts.fill_null(0).to_numpy(zero_copy_only=False).astype("int64").view(f"timedelta64[{column.type.unit}]")
        )
        out = np.where(column.is_null().to_numpy(zero_copy_only=False), np.timedelta64("NaT"), out)
        return out
    if pa.types.is_decimal(column.type):
        return column.cast(pa.float64()).to_numpy(zero_copy_only=False)
    if pa.types.is_string(column.type) or pa.types.is_large_string(column.type):
        return dates_of_texts(column)
    return column.to_numpy(zero_copy_only=False)


def dates_of_texts(texts: Any) -> np.ndarray:
    """(N,) datetime64 of texts such as "2026-01-31T10:00:00.125Z" or "31.01.2026 10:00:00,125", timedelta64 of times of
    the
    day; the texts themselves where they are none.
    """
    column = texts if isinstance(texts, pa.Array) else pa.array(texts)
    first = next((x.as_py() for x in column if x.is_valid and x.as_py()), "")
    if isinstance(first, str) and is_date(first.strip()):
        try:
            return parse_dates(column, first.strip(), date_order(column))
        except pa.ArrowInvalid:  # not all of them
            pass
    return column.to_numpy(zero_copy_only=False)


def date_order(column: pa.Array, before: str = "") -> tuple[str, bool]:
    """The order of year, month and day in texts of dates, and whether it is a guess: "3/4/2026" may be of April or of
    March, as long as no number is above 12 and no midnight tells which of them is the day.

    Args:
        before: the date above them.
    """
    first = next((x.as_py() for x in column if x.is_valid and x.as_py()), "").strip()
    found = DATE.match(first)
    if found is None or len(found["a"]) == 4:
        return "ymd", False
    if found["sign"] == ".":
        return "dmy", False
    above = [DATE.match(before.strip()) or found]
    numbers = pc.extract_regex(column, r"^\s*(?P<a>\d\d?)[-/](?P<b>\d\d?)[-/]").drop_null()
    a, b = (
        np.append([int(m[k]) for m in above], pc.cast(pc.struct_field(numbers, k), pa.int32()).to_numpy(False))
        for k in ("a", "b")
    )
    if max(a.max(), b.max()) > 12:
        return ("dmy" if a.max() > 12 else "mdy"), False
    first_moves, second_moves = np.diff(a) != 0, np.diff(b) != 0
    days_first, days_second = np.any(first_moves & ~second_moves), np.any(second_moves & ~first_moves)
    if days_first != days_second:
        return ("dmy" if days_first else "mdy"), False
    return ("dmy" if found["sign"] == "-" else "mdy"), True


def day_and_month_swapped(dates: np.ndarray) -> np.ndarray:
    """(N,) datetime64 of dates whose month was taken for the day; both are 12 at most."""
    month, day = dates.astype("datetime64[M]"), dates.astype("datetime64[D]")
    year = dates.astype("datetime64[Y]")
    swapped = year.astype("datetime64[M]") + (day - month.astype("datetime64[D]")).astype(int)
    return (swapped.astype("datetime64[D]") + (month - year.astype("datetime64[M]")).astype(int)) + (dates - day)


def parse_dates(column: pa.Array, like: str, order: tuple[str, bool]) -> np.ndarray:
    """(N,) datetime64 or timedelta64 of texts that are written as ``like``; NaT where there is none.

    Raises:
        pyarrow.ArrowInvalid: where a text is written in another way.
    """
    texts = pc.utf8_trim_whitespace(column)
    texts = pc.if_else(pc.equal(texts, ""), pa.scalar(None, texts.type), texts)
    half = re.search(r" ?[AaPp][Mm]$", like) is not None
    after_noon = pc.match_substring_regex(texts, r"[Pp][Mm]$").fill_null(False).to_numpy(zero_copy_only=False)
    if half:
        texts = pc.replace_substring_regex(texts, r" ?[AaPp][Mm]$", "")
    texts = pc.replace_substring_regex(texts, r",(\d{1,9})", r".\1")
    on_a_day = DATE.match(like) is not None
    if not on_a_day:
        texts = pc.binary_join_element_wise("1970-01-01 ", texts, "")
    elif order[0] == "ymd":
        texts = pc.replace_substring_regex(texts, r"^(\d{4})[-./](\d\d?)[-./](\d\d?)", r"\1-\2-\3")
    else:
        texts = pc.replace_substring_regex(
            texts, r"^(\d\d?)[-./](\d\d?)[-./](\d{4})", r"\3-\2-\1" if order[0] == "dmy" else r"\3-\1-\2"
        )
    for one_digit in (r"^(\d{4}-)(\d)-", r"^(\d{4}-\d\d-)(\d)([T ]|$)", r"^(\d{4}-\d\d-\d\d[T ])\s*(\d):"):
        tail = {"-": "-", ")": r"\3", ":": ":"}[one_digit[-1]]
        texts = pc.replace_substring_regex(texts, one_digit, r"\10\2" + tail)
    out = texts.cast(pa.timestamp("ns", "UTC" if re.search(ZONE, like) else None)).to_numpy(zero_copy_only=False)
    out = out.astype("datetime64[ns]")
    if half:
        twelve, hour = np.timedelta64(12, "h"), (out - out.astype("datetime64[D]")) // np.timedelta64(1, "h")
        out = np.where(after_noon & (hour != 12), out + twelve, np.where(~after_noon & (hour == 12), out - twelve, out))
    return out if on_a_day else out - np.datetime64("1970-01-01", "ns")


def seconds(stamps: np.ndarray, first: Any) -> np.ndarray:
    """(N,) s since ``first``, of dates or times; NaN where there is none. Times of the day go on over midnight."""
    out = (stamps - first) / np.timedelta64(1, "ns") * 1e-9
    if stamps.dtype.kind == "m" and out.size > 1:
        out = out + DAY * np.concatenate([[0.0], np.cumsum(np.diff(out) < -DAY / 2)])
    return out
