"""ROS 2 recordings: ``sensor_msgs/JointState`` in MCAP files and in the SQLite files of rosbag2.

Signals are named ``position.JOINT``, ``velocity.JOINT``, ``effort.JOINT``, ``stamp`` (of the message
header) and ``log_time``, both in s since the first message. Where a file holds more than one topic of
joint states, the topic stands before: ``/left/joint_states:position.JOINT``.
"""

from __future__ import annotations

import io
import sqlite3
from collections import Counter
from collections.abc import Iterator
from contextlib import closing, redirect_stderr, redirect_stdout
from pathlib import Path
from typing import Any

import numpy as np
from mcap.reader import make_reader
from mcap.records import Schema
from mcap.well_known import MessageEncoding, SchemaEncoding
from mcap_ros2.decoder import DecoderFactory

from robot_assets.errors import DataError

TYPES = ("sensor_msgs/msg/JointState", "sensor_msgs/JointState")
FIELDS = ("position", "velocity", "effort")
TIMES = ("stamp", "log_time")
LARGEST_VALUE = 2**24  # bytes of one message
# rosbag2 leaves the definition out of older SQLite files.
JOINT_STATE = "\n".join(
    [
        "std_msgs/Header header", "string[] name", "float64[] position", "float64[] velocity", "float64[] effort",
        "=" * 80, "MSG: std_msgs/Header", "builtin_interfaces/Time stamp", "string frame_id",
        "=" * 80, "MSG: builtin_interfaces/Time", "int32 sec", "uint32 nanosec",
    ]
)  # fmt: skip


def read_mcap(path: Path, wanted: set[str] | None) -> dict[str, np.ndarray]:
    """Signals of an MCAP file, (N,) each; None wants them all.

    Raises:
        DataError: where no topic holds joint states, or in an encoding other than CDR with a ros2msg schema.
    """
    with path.open("rb") as file:
        return _signals(path, _mcap_messages(path, file), wanted)


def read_db3(path: Path, wanted: set[str] | None) -> dict[str, np.ndarray]:
    """Signals of a rosbag2 SQLite file; as ``read_mcap``."""
    return _signals(path, _db3_messages(path), wanted)


def _mcap_messages(path: Path, file: Any) -> Iterator[tuple[str, int, Any]]:
    """(topic, log time in ns, message)."""
    factory = DecoderFactory()
    for schema, channel, message in make_reader(file).iter_messages():
        if schema is None or schema.name not in TYPES:
            continue
        # the parser of definitions prints its errors
        with redirect_stderr(io.StringIO()), redirect_stdout(io.StringIO()):
            decode = factory.decoder_for(channel.message_encoding, schema)
        if decode is None:
            found = f"{channel.message_encoding} with a {schema.encoding} schema"
            raise DataError(channel.topic, str(path), found, "cdr with a ros2msg schema")
        yield channel.topic, message.log_time, decode(message.data)


def _db3_messages(path: Path) -> Iterator[tuple[str, int, Any]]:
    schema = Schema(id=1, name=TYPES[0], encoding=SchemaEncoding.ROS2, data=JOINT_STATE.encode())
    decode = DecoderFactory().decoder_for(MessageEncoding.CDR, schema)
    uri = f"{path.absolute().as_uri()}?mode=ro&immutable=1"
    with closing(sqlite3.connect(uri, uri=True)) as bag:
        bag.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, LARGEST_VALUE)
        for name in ("topics", "messages"):  # a view or a column that is computed may go on without end
            kind = bag.execute("SELECT type FROM sqlite_master WHERE name = ?", (name,)).fetchone()
            computed = [c[1] for c in bag.execute(f"PRAGMA table_xinfo({name})") if c[6]]
            if kind != ("table",) or computed:
                found = (
                    "no such table"
                    if kind is None
                    else f"computed column {computed[0]}"
                    if computed
                    else f"a {kind[0]}"
                )
                raise DataError(name, str(path), found, "a table of rosbag2")
        topics = {
            key: name
            for key, name, kind, form in bag.execute("SELECT id, name, type, serialization_format FROM topics")
            if kind in TYPES and form == "cdr"
        }
        for key, stamp, data in bag.execute("SELECT topic_id, timestamp, data FROM messages ORDER BY timestamp, id"):
            if key in topics and decode is not None:
                yield topics[key], int(stamp), decode(data)


def _signals(path: Path, messages: Iterator[tuple[str, int, Any]], wanted: set[str] | None) -> dict[str, np.ndarray]:
    topics: dict[str, list[tuple[int, Any]]] = {}
    for topic, stamp, message in messages:
        topics.setdefault(topic, []).append((stamp, message))
    if not topics:
        raise DataError("topic", str(path), "no joint states", f"a topic of {TYPES[0]}")
    out: dict[str, np.ndarray] = {}
    for topic, rows in topics.items():
        start = "" if len(topics) == 1 else f"{topic}:"
        # With one topic its name may stand before as well, so that a map serves bags with and without others.
        asked = None if wanted is None else {_own(w, start, topic) for w in wanted}
        for name, x in _topic(rows, asked).items():
            out[f"{start}{name}"] = x
            if wanted is not None and f"{topic}:{name}" in wanted:
                out[f"{topic}:{name}"] = x
    return out


def _own(wanted: str, start: str, topic: str) -> str:
    for prefix in (f"{topic}:", start):
        if prefix and wanted.startswith(prefix):
            return wanted.removeprefix(prefix)
    return "" if start else wanted


def _topic(rows: list[tuple[int, Any]], wanted: set[str] | None) -> dict[str, np.ndarray]:
    """Signals of one topic, from the messages that hold all joints wanted of it.

    A topic may carry messages of an arm and others of its gripper: where all signals are wanted, they are
    those of the commonest set of joints.
    """
    sets = Counter(frozenset(message.name) for _, message in rows)
    if wanted is None:
        asked = max(sets, key=lambda s: (sets[s], len(s)))
    else:
        asked = frozenset(name for name in frozenset().union(*sets) if any(f"{f}.{name}" in wanted for f in FIELDS))
    rows = [row for row in rows if asked <= set(row[1].name)] or rows
    out: dict[str, np.ndarray] = {}
    stamps = {
        "stamp": [m.header.stamp.sec * 10**9 + m.header.stamp.nanosec for _, m in rows],
        "log_time": [t for t, _ in rows],
    }
    for name, values in stamps.items():
        out[name] = np.array([v - values[0] for v in values]) * 1e-9
    for field in FIELDS:
        # A field that a driver does not fill is left empty.
        full = all(len(getattr(m, field)) == len(m.name) for _, m in rows)
        for joint in sorted(asked) if full else []:
            if all(joint in m.name for _, m in rows):
                out[f"{field}.{joint}"] = np.array(
                    [getattr(m, field)[list(m.name).index(joint)] for _, m in rows], float
                )
    return out
