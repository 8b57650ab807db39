"""The columns of one segment's file, Parquet or CSV, read and checked."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.csv
import pyarrow.parquet as pq

from ident.dataset import CHANNELS
from ident.format_checks import REQUIRED, check_column, check_time
from ident.unpacked import check_size
from robot_assets.errors import DataError
from robot_assets.values import exists

LONGEST = 100_000_000  # samples; more is no recording but a broken or hostile header


def read_segment(path: Path, where: str, n: int, rate: float) -> tuple[np.ndarray, dict[str, np.ndarray | None]]:
    """Read a file.

    Args:
        where: the entry that names it, for errors. n: number of joints. rate: Hz.

    Returns:
        t: (N,) s. channels: name of each of ``CHANNELS`` -> (N, n), or None where absent.

    Raises:
        DataError: with the column, what was found and what was expected.
    """
    columns = _columns(path, where)
    t = _column(columns, "t", path)
    check_time(t, rate, "column t", str(path))
    return t, {channel: _channel(columns, channel, n, path) for channel in CHANNELS}


def is_ours(name: str) -> bool:
    """Whether a column belongs to the format; others are left alone."""
    channel, _, number = name.rpartition("_")
    return name == "t" or (channel in CHANNELS and number.isascii() and number.isdecimal())


def _columns(path: Path, where: str) -> dict[str, np.ndarray]:
    if not exists(path):
        raise DataError("file", where, f"no {path.name}", "an existing Parquet or CSV file")
    kind = path.suffix.lower()
    if kind not in (".csv", ".parquet"):
        raise DataError("file", where, path.name, "a .parquet or .csv file")
    try:
        if kind == ".parquet":
            file = pq.ParquetFile(path)
            names = file.schema_arrow.names
            ours = [n for n in dict.fromkeys(names) if is_ours(n)]
            rows = file.metadata.num_rows
            if rows > LONGEST:
                raise DataError("samples", str(path), f"{rows}", f"at most {LONGEST}")
            check_size(path, 8 * rows * len(ours))
            table = file.read(columns=ours)
        else:
            table = pa.csv.read_csv(path)
            names = table.column_names
    except (pa.ArrowException, OSError, ValueError, MemoryError) as err:
        reason = str(err).strip().splitlines()[0] if str(err).strip() else type(err).__name__
        raise DataError("file", str(path), f"unreadable ({reason})", "a complete Parquet or CSV file") from err
    out = {}
    for name in filter(is_ours, names):
        if names.count(name) > 1:
            raise DataError(f"column {name}", str(path), "it twice", "each column once")
        column = table.column(name)
        if not (pa.types.is_floating(column.type) or pa.types.is_integer(column.type)):
            raise DataError(f"column {name}", str(path), f"type {column.type}", "numbers")
        try:
            out[name] = np.asarray(column.to_numpy(), float)
        except (pa.ArrowException, ValueError, MemoryError) as err:
            raise DataError(f"column {name}", str(path), f"unreadable ({err})", "numbers") from err
    return out


def _column(columns: dict[str, np.ndarray], name: str, path: Path) -> np.ndarray:
    if name not in columns:
        raise DataError(f"column {name}", str(path), "no such column", "a required column")
    x = columns[name]
    check_column(x, f"column {name}", str(path))
    return x


def _channel(columns: dict[str, np.ndarray], channel: str, n: int, path: Path) -> np.ndarray | None:
    """(N, n) of a channel; a partly given link encoder has NaN where a joint has none."""
    own = {c for c in columns if c.rpartition("_")[0] == channel}
    wanted = [f"{channel}_{j + 1}" for j in range(n)]
    surplus = sorted(own - set(wanted))
    if surplus:
        raise DataError(
            f"column {surplus[0]}", str(path), "a column beyond the joints", f"{channel}_1 to {channel}_{n}"
        )
    if not own and channel not in REQUIRED:
        return None
    missing = [c for c in wanted if c not in own]
    if missing and channel != "q_link":
        raise DataError(f"column {missing[0]}", str(path), "no such column", f"{channel}_1 to {channel}_{n}")
    out = np.full((len(columns["t"]), n), np.nan)
    for j, name in enumerate(wanted):
        if name in own:
            out[:, j] = _column(columns, name, path)
    return out
