"""Import of a large CSV log: speed against pyarrow alone, and memory.

A log of an arm with six joints (time, torque and position of each) is written, read by pyarrow and converted by
simgap in processes of their own.

    python benchmarks/bench_import.py --megabytes 1000
"""

from __future__ import annotations

import argparse
import resource
import tempfile
import time
from multiprocessing import get_context
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.csv
from provenance import commit

ROWS_AT_A_TIME = 100_000
RATE = 1000.0
JOINTS = 6
MAP = "sample_rate = 1000.0\n[time]\nsource = 't'\nunit = 's'\n[columns]\n" + "".join(
    f"tau_{j} = {{ source = 'torque {j}', unit = 'N m' }}\nq_{j} = {{ source = 'angle {j}', unit = 'deg' }}\n"
    for j in range(1, JOINTS + 1)
)


def write_log(path: Path, megabytes: float) -> int:
    """A CSV of at least that size; its number of rows."""
    rng, rows = np.random.default_rng(0), 0
    names = ["t", *(f"{kind} {j}" for j in range(1, JOINTS + 1) for kind in ("torque", "angle"))]
    schema = pa.schema([(n, pa.float64()) for n in names])
    with pyarrow.csv.CSVWriter(path, schema) as out:
        while path.stat().st_size < megabytes * 1e6:
            t = (rows + np.arange(ROWS_AT_A_TIME)) / RATE
            phase = 0.3 * t[:, None] + np.arange(2 * JOINTS)
            values = 30.0 * np.sin(phase) + 1e-3 * rng.normal(size=phase.shape)
            out.write_table(pa.table([t, *values.T], names=names))
            rows += len(t)
    return rows


def by_pyarrow(path: Path) -> int:
    return pyarrow.csv.read_csv(path).num_rows


def by_simgap(path: Path) -> int:
    from ident.convert import convert_logs

    (path.parent / "map.toml").write_text(MAP, encoding="utf-8")
    data = convert_logs([path], "ur10", path.parent / "map.toml")
    return sum(len(s.t) for s in data.segments)


def measured(job: tuple) -> tuple[float, float, int]:
    """Seconds, peak memory in GB and rows of a reader in this process."""
    function, path = job
    began = time.perf_counter()
    rows = function(path)
    return time.perf_counter() - began, resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6, rows


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--megabytes", type=float, default=1000.0)
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "log.csv"
        rows = write_log(path, args.megabytes)
        print(f"{path.stat().st_size / 1e6:.0f} MB, {rows} rows, commit {commit()}")
        seconds = {}
        for name, function in (("pyarrow", by_pyarrow), ("simgap", by_simgap)):
            # A process each, so that one's memory is not the other's; the second reading finds the file in memory too.
            with get_context("spawn").Pool(1) as pool:
                seconds[name], memory, found = pool.apply(measured, ((function, path),))
            print(
                f"{name:8s} {seconds[name]:6.2f} s, {path.stat().st_size / 1e6 / seconds[name]:5.0f} MB/s, peak {memory:.2f} GB, {found} rows"
            )
        print(f"speed over that of pyarrow: {seconds['pyarrow'] / seconds['simgap']:.2f}")


if __name__ == "__main__":
    main()
