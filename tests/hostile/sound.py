"""The sound files that hostile ones are made from: a robot of two joints, its log in every format, maps, a plan."""

from __future__ import annotations

import io
import sqlite3
import tempfile
from functools import cache
from pathlib import Path

import h5py
import numpy as np
import pyarrow as pa
import pyarrow.csv
import pyarrow.parquet
import scipy.io

from ident.convert.bags import JOINT_STATE
from robot_assets.from_urdf import write_robot

RATE, N = 500.0, 200
URDF = """<robot name="pair"><link name="a"/>
<link name="b"><inertial><mass value="3"/><inertia ixx="0.1" iyy="0.1" izz="0.1"/></inertial></link>
<link name="c"><inertial><origin xyz="0.2 0 0"/><mass value="1"/><inertia ixx="0.1" iyy="0.1" izz="0.1"/></inertial></link>
<joint name="one" type="revolute"><parent link="a"/><child link="b"/><axis xyz="0 0 1"/>
  <limit lower="-3" upper="3" effort="80" velocity="3"/></joint>
<joint name="two" type="revolute"><parent link="b"/><child link="c"/><origin xyz="0.4 0 0"/><axis xyz="0 0 1"/>
  <limit lower="-3" upper="3" effort="40" velocity="3"/></joint></robot>"""
MAP = """sample_rate = 500.0
[time]
source = "t"
[columns]
tau_1 = { source = "u1" }
tau_2 = { source = "u2" }
q_1 = { source = "x1" }
q_2 = { source = "x2" }
"""
BAG_MAP = """sample_rate = 500.0
[time]
source = "stamp"
[columns]
tau_1 = "effort.one"
tau_2 = "effort.two"
q_1 = "position.one"
q_2 = "position.two"
"""
TABLES = (".csv", ".txt", ".parquet", ".npz", ".mat", ".h5.mat")  # ".h5.mat": MATLAB 7.3
BAGS = (".mcap", ".db3")


def columns() -> dict[str, np.ndarray]:
    """The log: t, u1, u2, x1, x2."""
    t = np.arange(N) / RATE
    w = 2 * np.pi * np.array([2.0, 3.0])
    q = 0.5 * np.sin(w * t[:, None])
    tau = -0.3 * w**2 * q + 0.05 * np.random.default_rng(0).normal(size=q.shape)
    return {"t": t, "u1": tau[:, 0], "u2": tau[:, 1], "x1": q[:, 0], "x2": q[:, 1]}


def write_table(path: Path, signals: dict[str, np.ndarray]) -> None:
    """A log in the format of its suffix."""
    name = path.name
    if name.endswith(".h5.mat"):
        with h5py.File(path, "w", userblock_size=512) as file:
            for key, x in signals.items():
                text = x.dtype.kind == "U"
                file[key] = x.astype("S")[None] if text else x[None]
        with path.open("r+b") as raw:
            raw.write(b"MATLAB 7.3 MAT-file, Platform: GLNXA64".ljust(124, b" ") + b"\x00\x02IM")
    elif name.endswith(".mat"):
        scipy.io.savemat(path, signals, do_compression=True)
    elif name.endswith(".npz"):
        np.savez_compressed(path, **signals)
    elif name.endswith(".parquet"):
        pa.parquet.write_table(pa.table(signals), path)
    elif name.endswith(".csv"):
        pa.csv.write_csv(pa.table(signals), path)
    else:
        rows = zip(*(x.tolist() for x in signals.values()), strict=True)
        path.write_text("\n".join([" ".join(signals), *(" ".join(map(repr, row)) for row in rows)]) + "\n")


def messages() -> list[tuple[int, dict]]:
    """(stamp in ns, message) of the log as joint states."""
    x, out = columns(), []
    for k in range(N):
        stamp = 1_700_000_000_000_000_000 + round(x["t"][k] * 1e9)
        header = {"stamp": {"sec": stamp // 10**9, "nanosec": stamp % 10**9}, "frame_id": ""}
        q, tau = [float(x["x1"][k]), float(x["x2"][k])], [float(x["u1"][k]), float(x["u2"][k])]
        out.append((stamp, {"header": header, "name": ["one", "two"], "position": q, "velocity": [], "effort": tau}))
    return out


def write_mcap(path: Path, rows: list[tuple[int, dict]], definition: str = JOINT_STATE) -> None:
    """Joint states as MCAP."""
    from mcap_ros2.writer import Writer

    with path.open("wb") as file:
        writer = Writer(file)
        schema = writer.register_msgdef("sensor_msgs/msg/JointState", definition)
        for stamp, message in rows:
            writer.write_message("/joint_states", schema, message, log_time=stamp, publish_time=stamp)
        writer.finish()


def write_db3(path: Path, rows: list[tuple[int, dict]]) -> None:
    """Joint states as a rosbag2 SQLite file."""
    from mcap.reader import make_reader

    file = io.BytesIO(mcap_bytes(tuple(range(len(rows)))) if rows == messages() else b"")
    with sqlite3.connect(path) as db:
        db.execute("CREATE TABLE topics(id INTEGER PRIMARY KEY, name TEXT, type TEXT, serialization_format TEXT)")
        db.execute("CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INTEGER, timestamp INTEGER, data BLOB)")
        db.execute("INSERT INTO topics VALUES (1, '/joint_states', 'sensor_msgs/msg/JointState', 'cdr')")
        for _, _, message in make_reader(file).iter_messages():
            db.execute(
                "INSERT INTO messages(topic_id, timestamp, data) VALUES (1, ?, ?)", (message.log_time, message.data)
            )
    db.close()


@cache
def mcap_bytes(picked: tuple[int, ...]) -> bytes:
    """An MCAP file of some of the messages."""
    with tempfile.TemporaryDirectory() as folder:
        rows = messages()
        write_mcap(Path(folder) / "x.mcap", [rows[i] for i in picked])
        return (Path(folder) / "x.mcap").read_bytes()


@cache
def log_bytes(suffix: str) -> bytes:
    """The sound log in a format."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / f"log{suffix}"
        if suffix == ".mcap":
            return mcap_bytes(tuple(range(N)))
        if suffix == ".db3":
            write_db3(path, messages())
        else:
            write_table(path, columns())
        return path.read_bytes()


@cache
def robot_files() -> dict[str, bytes]:
    """robot.toml and URDF of the robot."""
    with tempfile.TemporaryDirectory() as folder:
        (Path(folder) / "pair.urdf").write_text(URDF)
        write_robot(Path(folder) / "pair.urdf", Path(folder) / "pair")
        return {p.name: p.read_bytes() for p in (Path(folder) / "pair").iterdir()}


def put_robot(folder: Path) -> Path:
    """The robot folder, written."""
    target = folder / "pair"
    target.mkdir()
    for name, data in robot_files().items():
        (target / name).write_bytes(data)
    return target


def convert(folder: Path, *logs: str | Path, map_text: str = MAP) -> list[str]:
    """Arguments of a conversion of logs into ``out``, robot and map written beside."""
    put_robot(folder)
    (folder / "map.toml").write_text(map_text, encoding="utf-8", errors="surrogateescape")
    files = [str(folder / x) for x in logs]
    return [
        "convert",
        *files,
        "--robot",
        str(folder / "pair"),
        "--map",
        str(folder / "map.toml"),
        "--out",
        str(folder / "out"),
        "--quiet",
    ]
