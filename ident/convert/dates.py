"""Dates and times of the day as NumPy has them, whatever a log calls them."""

from __future__ import annotations

import re
from typing import Any

import numpy as np
import pyarrow as pa

ISO = re.compile(r"\d{4}-\d\d-\d\d[T ]\d\d:\d\d(:\d\d(\.\d{1,9})?)?(Z|[+-]\d\d:?\d\d)?$")


def as_dates(column: pa.Array | pa.ChunkedArray) -> np.ndarray:
    """(N,) values of a column: dates as datetime64, times of the day and durations as timedelta64."""
    if isinstance(column, pa.ChunkedArray):
        parts = [as_dates(chunk) for chunk in column.chunks]
        return np.concatenate(parts) if parts else np.zeros(0)
    if pa.types.is_time(column.type):
        counts = column.cast(pa.int32() if column.type.bit_width == 32 else pa.int64())
        out = counts.fill_null(0).to_numpy(zero_copy_only=False).astype("int64").view(f"timedelta64[{column.type.unit}]")
        out = np.where(column.is_null().to_numpy(zero_copy_only=False), np.timedelta64("NaT"), out)
        return out
    if pa.types.is_string(column.type) or pa.types.is_large_string(column.type):
        return dates_of_texts(column)
    return column.to_numpy(zero_copy_only=False)


def dates_of_texts(texts: Any) -> np.ndarray:
    """(N,) datetime64 of texts such as "2026-01-31T10:00:00.125Z"; the texts themselves where they are none."""
    column = texts if isinstance(texts, pa.Array) else pa.array(texts)
    first = next((x.as_py() for x in column if x.is_valid), "")
    found = ISO.match(first) if isinstance(first, str) else None
    if found is not None:
        try:
            return column.cast(pa.timestamp("ns", "UTC" if found[3] else None)).to_numpy(zero_copy_only=False)
        except pa.ArrowInvalid:  # not all of them
            pass
    return column.to_numpy(zero_copy_only=False)


def seconds(stamps: np.ndarray, first: Any) -> np.ndarray:
    """(N,) s since ``first``, of dates or durations; NaN where there is none."""
    return (stamps - first) / np.timedelta64(1, "ns") * 1e-9
