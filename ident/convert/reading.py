"""Logs of several formats as named arrays."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.csv
import pyarrow.parquet

from robot_assets.errors import DataError

FORMATS = (".csv", ".parquet", ".mat", ".npz")


def read_log(path: Path, wanted: set[str]) -> dict[str, np.ndarray]:
    """The wanted signals of a log; a dot reaches into structures ("rec.act_pos").

    Raises:
        DataError: where the file is missing, of another format, unreadable, or lacks a signal.
    """
    if not path.is_file():
        raise DataError("log", str(path), "no such file", f"a file of {FORMATS}")
    try:
        data = _readers()[path.suffix.lower()](path, wanted)
    except KeyError as err:
        if path.suffix.lower() not in FORMATS:
            raise DataError("log", str(path), path.suffix or "no suffix", f"one of {FORMATS}") from err
        raise DataError("signal", str(path), f"no {err.args[0]}", "a signal that the map names") from err
    except (pa.ArrowException, OSError, ValueError, TypeError, NotImplementedError, EOFError) as err:
        reason = str(err).splitlines()[0][:160] if str(err) else type(err).__name__
        raise DataError("log", str(path), f"unreadable ({reason})", "a complete file") from err
    out = {}
    for name in sorted(wanted):
        if name not in data:
            raise DataError("signal", str(path), f"no {name}", f"one of {sorted(data)[:30]}")
        try:
            out[name] = np.asarray(data[name], float)
        except (TypeError, ValueError) as err:
            raise DataError("signal", str(path), f"{name} is no array of numbers", "numbers") from err
    return out


def _readers():
    return {".csv": _csv, ".parquet": _parquet, ".mat": _mat, ".npz": _npz}


def _csv(path: Path, wanted: set[str]) -> dict[str, np.ndarray]:
    with pa.csv.open_csv(path) as reader:
        names = reader.schema.names
        keep = [n for n in names if n in wanted]
        parts: dict[str, list[np.ndarray]] = {n: [] for n in keep}
        for batch in reader:
            for name in keep:
                parts[name].append(batch.column(name).to_numpy(zero_copy_only=False))
    return {n: np.concatenate(p) for n, p in parts.items()}


def _parquet(path: Path, wanted: set[str]) -> dict[str, np.ndarray]:
    names = pa.parquet.read_schema(path).names
    table = pa.parquet.read_table(path, columns=[n for n in names if n in wanted], partitioning=None)
    return {n: table.column(n).to_numpy() for n in table.column_names}


def _npz(path: Path, wanted: set[str]) -> dict[str, np.ndarray]:
    with np.load(path, allow_pickle=False) as file:
        return {n: file[n] for n in file.files if n in wanted}


def _mat(path: Path, wanted: set[str]) -> dict[str, np.ndarray]:
    import h5py
    import scipy.io

    if h5py.is_hdf5(path):
        with h5py.File(path) as file:
            return {n: np.asarray(file[n.replace(".", "/")]).T for n in wanted if n.replace(".", "/") in file}
    data = scipy.io.loadmat(path, squeeze_me=True, struct_as_record=False)
    out = {}
    for name in wanted:
        value = data
        for key in name.split("."):
            value = value.get(key) if isinstance(value, dict) else getattr(value, key, None)
            if value is None:
                break
        if value is not None:
            out[name] = value
    return out
