"""Logs: every format damaged, every signal spoilt, bombs, tricks in names."""

from __future__ import annotations

import io
import pickle
import sqlite3
import struct
import zipfile
import zlib
from collections.abc import Iterator
from pathlib import Path

import h5py
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import scipy.io

from ident.convert.bags import JOINT_STATE
from tests.hostile import sound
from tests.hostile.case import ACCEPTED, EITHER, REFUSED, Case, flips

CUTS = (0, 1, 7, 64, 0.2, 0.5, 0.8, 0.97, -64, -9, -1)
FLIPS = 12
HUGE = 8 * 10**9  # bytes that a bomb would take


def cases() -> Iterator[Case]:
    """All of them."""
    yield from damaged()
    yield from spoilt()
    yield from tables()
    yield from text_files()
    yield from npz_files()
    yield from matlab_files()
    yield from bags()
    yield from bombs()
    yield from names()


def log(
    id_: str,
    suffix: str,
    write,
    outcome: str = REFUSED,
    names: str | None = None,
    map_text: str | None = None,
    alone: bool = False,
) -> Case:
    """A conversion of one log that ``write(path)`` makes."""

    def make(folder: Path) -> list[str]:
        write(folder / f"log{suffix}")
        text = map_text or (sound.BAG_MAP if suffix in sound.BAGS else sound.MAP)
        return sound.convert(folder, f"log{suffix}", map_text=text)

    return Case(f"{id_}{suffix}", make, f"log{suffix}" if names is None else names, outcome, alone)


def damaged() -> Iterator[Case]:
    for suffix in (*sound.TABLES, *sound.BAGS):
        whole = sound.log_bytes(suffix)
        text = suffix in (".csv", ".txt")
        for cut in CUTS:
            at = cut if isinstance(cut, int) else int(cut * len(whole))
            # A text cut at a line or a figure is a shorter log; the last bytes of a file may be filling.
            sure = abs(at) < 64 and at >= 0 if text or suffix in (".db3", ".h5.mat") else at != -1
            yield log(f"cut at {cut}", suffix, lambda p, b=whole[:at]: p.write_bytes(b), REFUSED if sure else EITHER)
        for seed in range(FLIPS):
            yield log(f"bits turned {seed}", suffix, lambda p, b=flips(whole, seed): p.write_bytes(b), EITHER)
        yield log("zeros", suffix, lambda p, n=len(whole): p.write_bytes(bytes(n)))
        noise = np.random.default_rng(7).bytes(4096)
        yield log("random bytes", suffix, lambda p, b=noise: p.write_bytes(b))
        other = sound.log_bytes(".npz" if suffix == ".parquet" else ".parquet")
        yield log("another format", suffix, lambda p, b=other: p.write_bytes(b))
        yield log("a folder", suffix, lambda p: p.mkdir())


def changed(**signals) -> dict[str, np.ndarray]:
    return sound.columns() | {k: np.asarray(v) for k, v in signals.items()}


def with_value(key: str, at: int, value: float) -> dict[str, np.ndarray]:
    x = sound.columns()
    x[key] = x[key].copy()
    x[key][at] = value
    return x


def spoilt() -> Iterator[Case]:
    x = sound.columns()
    t, n = x["t"], sound.N
    missing = {k: v for k, v in x.items() if k != "u2"}
    spoils = {
        "all NaN": changed(x1=np.full(n, np.nan)),
        "one NaN": with_value("u2", 17, np.nan),
        "one infinity": with_value("x1", 3, -np.inf),
        "huge": changed(x2=1e300 * x["x2"]),
        "above all angles": with_value("x1", 5, 1e13),
        "words": changed(u1=np.array(["high"] * n)),
        "no such column": missing,
        "one row": {k: v[:1] for k, v in x.items()},
        "fifteen rows": {k: v[:15] for k, v in x.items()},
        "time stands still": changed(t=np.zeros(n)),
        "time goes back": changed(t=t[::-1].copy()),
        "time jumps back": with_value("t", 100, 0.0),
        "time NaN": with_value("t", 9, np.nan),
        "time all NaN": changed(t=np.full(n, np.nan)),
        "time infinite": with_value("t", n - 1, np.inf),
        "time huge": changed(t=1e300 * t),
        "time in years": changed(t=1e8 * t),
        "time tiny": changed(t=1e-300 * t),
        "time far away": changed(t=t + 1e18),
        "one long gap": changed(t=np.where(np.arange(n) < n // 2, t, t + 1e6)),
    }
    for name, signals in spoils.items():

        def guessed(folder: Path, signals=signals) -> list[str]:
            sound.write_table(folder / "log.npz", signals)
            args = sound.convert(folder, "log.npz")
            (folder / "map.toml").unlink()
            return [*args[: args.index("--out")], "--guess"]

        yield Case(f"a map guessed of {name}", guessed, "log.npz", EITHER)
        for suffix in sound.TABLES:
            yield log(name, suffix, lambda p, s=signals: sound.write_table(p, s))
    for suffix in sound.TABLES:
        whole = {k: np.round(1000 * v).astype(int) for k, v in x.items() if k != "t"}
        yield log("whole numbers", suffix, lambda p, s=changed(**whole): sound.write_table(p, s), ACCEPTED)
        yield log(
            "zeros throughout",
            suffix,
            lambda p, s=changed(**dict.fromkeys(("u1", "u2", "x1", "x2"), np.zeros(n))): sound.write_table(p, s),
            ACCEPTED,
        )
        if suffix != ".mat":
            empty = {k: v[:0] for k, v in x.items()}
            yield log("no rows", suffix, lambda p, s=empty: sound.write_table(p, s))


def tables() -> Iterator[Case]:
    x = {k: pa.array(v) for k, v in sound.columns().items()}

    def table(id_: str, outcome: str = REFUSED, **kwargs) -> Case:
        return log(id_, ".parquet", lambda p: pq.write_table(pa.table(x | kwargs), p), outcome)

    n = sound.N
    yield table("lists of lengths", x1=pa.array([[1.0] * (1 + k % 2) for k in range(n)]))
    yield table("lists of texts", x1=pa.array([["a"]] * n))
    yield table("lists without numbers", x1=pa.array([[]] * n, pa.list_(pa.float64())))
    yield table("lists with a gap", x1=pa.array([None, *[[1.0]] * (n - 1)]))
    yield table("lists of nothing", x1=pa.array([[None]] * n, pa.list_(pa.float64())))
    yield table("lists of lists", x1=pa.array([[[1.0]]] * n))
    yield table("lists", x1=pa.array([[1.0]] * n), outcome=ACCEPTED)  # of as many joints as the arm has
    yield table("structures", x1=pa.array([{"a": 1.0}] * n))
    yield table("bytes", x1=pa.array([b"1"] * n))
    yield table("nulls", x1=pa.array([None] * n, pa.float64()))
    yield table("one null", x1=pa.array([None, *([0.1] * (n - 1))]))
    yield table("a null type", x1=pa.nulls(n))
    yield table("dates", x1=pa.array(np.arange(n), pa.timestamp("ns")), outcome=EITHER)
    yield table(
        "dates as time", t=pa.array((sound.columns()["t"] * 1e9).astype(int), pa.timestamp("ns")), outcome=EITHER
    )
    yield table("truth values", x1=pa.array([True, False] * (n // 2)))
    yield table("half floats", x1=pa.array(np.zeros(n, np.float16)), outcome=ACCEPTED)
    yield table("words of a dictionary", x1=pa.array(["a", "b"] * (n // 2)).dictionary_encode())
    twice = pa.Table.from_arrays([*x.values(), x["x1"]], [*x, "x1"])
    yield log("a column twice", ".parquet", lambda p: pq.write_table(twice, p))
    many = pa.table(x | {f"c{k}": x["t"] for k in range(3000)})
    yield log("3000 columns", ".parquet", lambda p: pq.write_table(many, p), ACCEPTED)
    odd = pa.table(x | {"a\nb": x["t"], "": x["t"], "\x1b[2J": x["t"]})
    yield log("odd column names", ".parquet", lambda p: pq.write_table(odd, p), ACCEPTED)
    lost = pa.table({k: v for k, v in x.items() if k != "x2"} | {"a\nb\x1b[2J" * 50: x["t"]})
    yield log("odd column names in the error", ".parquet", lambda p: pq.write_table(lost, p))


def text_files() -> Iterator[Case]:
    csv, txt = sound.log_bytes(".csv").decode(), sound.log_bytes(".txt").decode()
    lines = csv.replace('"', "").splitlines()
    head, rows = lines[0], lines[1:]

    def text(id_: str, content: str | bytes, suffix: str = ".csv", outcome: str = REFUSED) -> Case:
        data = content if isinstance(content, bytes) else content.encode()
        return log(id_, suffix, lambda p: p.write_bytes(data), outcome)

    yield text("only a header", head + "\n")
    yield text("no line end", head)
    yield text("a column twice", "\n".join([head + ",x1", *(r + ",0" for r in rows)]))
    yield text(
        "a column twice", "\n".join([txt.splitlines()[0] + " x1", *(r + " 0" for r in txt.splitlines()[1:])]), ".txt"
    )
    yield text("ragged", "\n".join([head, *rows[:50], "1,2", *rows[50:]]))
    yield text("ragged", "\n".join([*txt.splitlines()[:50], "1 2", *txt.splitlines()[50:]]), ".txt")
    yield text("an empty cell", "\n".join([head, *rows[:50], rows[50].rsplit(",", 1)[0] + ",", *rows[51:]]))
    yield text("a word", "\n".join([head, *rows[:50], rows[50].rsplit(",", 1)[0] + ",high", *rows[51:]]))
    yield text("a word", "\n".join([*txt.splitlines()[:50], "1 2 3 4 high", *txt.splitlines()[51:]]), ".txt")
    yield text("an open quote", "\n".join([head, '"' + rows[0], *rows[1:]]))
    yield text("UTF-16", csv.encode("utf-16"), outcome=ACCEPTED)
    yield text("UTF-16", txt.encode("utf-16"), ".txt", outcome=ACCEPTED)
    yield text("a byte order mark", b"\xef\xbb\xbf" + csv.encode(), outcome=ACCEPTED)
    yield text("a byte order mark", b"\xef\xbb\xbf" + txt.encode(), ".txt", outcome=ACCEPTED)
    yield text("line ends of Windows", csv.replace("\n", "\r\n"), outcome=ACCEPTED)
    yield text("line ends of old Macs", csv.replace("\n", "\r"), outcome=EITHER)
    yield text("null bytes", csv.replace(",", "\x00,", 40))
    yield text("a field of 5 MB", "\n".join([head, rows[0][:-1] + "1" * 5_000_000, *rows[1:]]))
    yield text("a line of 5 MB", "x," * 2_500_000)
    yield text("a line of 5 MB", "x " * 2_500_000, ".txt")
    yield text("hexadecimal", "\n".join([head, *(",".join(["0x1f"] * 5) for _ in rows)]))
    yield text("thousands by blanks", "\n".join([head, *(r.replace("0.", "1 000.") for r in rows)]))
    yield text("dates for times", "\n".join([head, *("2026-01-01T00:00:00," + r.split(",", 1)[1] for r in rows)]))
    yield text("numbers beyond floats", "\n".join([head, *rows[:9], ",".join(["1e999"] * 5), *rows[10:]]))
    yield text("comments inside", "\n".join([head, *rows[:9], "# a note", *rows[9:]]))
    yield text("blank lines", "\n\n".join([head, *rows]), outcome=ACCEPTED)


def npz_files() -> Iterator[Case]:
    x = sound.columns()

    class Trap:
        def __reduce__(self):
            return (open, ("/tmp/simgap-was-tricked", "w"))

    def saved(**arrays):
        return lambda p: np.savez_compressed(p, **(x | arrays))

    yield log("a pickle inside", ".npz", saved(x1=np.array([Trap()] * sound.N, object)))
    yield log("a bare pickle", ".npz", lambda p: p.write_bytes(pickle.dumps(Trap())))
    yield log("text", ".npz", saved(x1=np.array(["a"] * sound.N)))
    yield log("complex numbers", ".npz", saved(x1=x["x1"] + 1j))
    yield log("structured", ".npz", saved(x1=np.zeros(sound.N, [("a", float), ("b", int)])))
    yield log("dates", ".npz", saved(x1=np.arange(sound.N).astype("datetime64[s]")))
    yield log("durations", ".npz", saved(t=np.arange(sound.N).astype("timedelta64[ms]")), EITHER)
    yield log("three dimensions", ".npz", saved(x1=np.zeros((sound.N, 2, 2))))
    yield log("a single number", ".npz", saved(x1=np.array(0.5)))
    yield log("a wrong length", ".npz", saved(x1=np.zeros(sound.N - 1)))
    yield log("a wrong number of stamps", ".npz", saved(t=np.arange(sound.N + 5) / 500))
    yield log("no columns of two", ".npz", saved(x2=np.zeros((sound.N, 0))))
    yield log("a row for a column", ".npz", saved(x1=x["x1"][None]), ACCEPTED)

    def bare(p: Path) -> None:
        with p.open("wb") as file:
            np.save(file, x["x1"])

    yield log("one array", ".npz", bare)

    def paths(p: Path) -> None:
        with zipfile.ZipFile(p, "w") as file:
            for name, value in x.items():
                buffer = io.BytesIO()
                np.save(buffer, value)
                file.writestr(f"../../{name}.npy", buffer.getvalue())

    yield log("paths inside", ".npz", paths)

    def header(p: Path, text: bytes) -> None:
        with zipfile.ZipFile(p, "w") as file:
            for name in x:
                file.writestr(f"{name}.npy", b"\x93NUMPY\x01\x00" + struct.pack("<H", len(text)) + text)

    shape = b"{'descr': '<f8', 'fortran_order': False, 'shape': (%d,), }"
    yield log("a shape without end", ".npz", lambda p: header(p, shape % 10**15))
    yield log("a negative shape", ".npz", lambda p: header(p, shape % -5))
    yield log("a header that is code", ".npz", lambda p: header(p, b"__import__('os').system('true')"))
    yield log("a header nested deeply", ".npz", lambda p: header(p, b"[" * 9000))


def matlab_files() -> Iterator[Case]:
    x = sound.columns()

    def saved(**values):
        return lambda p: scipy.io.savemat(p, x | values)

    deep: dict = {"end": x["x1"]}
    for _ in range(60):
        deep = {"s": deep}
    import scipy.sparse

    yield log("text", ".mat", saved(x1="hello"))
    yield log("cells", ".mat", saved(x1=np.array([x["x1"], "a"], object)))
    yield log("structures", ".mat", saved(x1={"a": x["x1"]}))
    yield log("structures without end", ".mat", saved(x1=deep))
    yield log("sparse", ".mat", saved(x1=scipy.sparse.eye(sound.N)))
    yield log("complex", ".mat", saved(x1=x["x1"] + 1j))
    yield log("empty", ".mat", saved(x1=np.zeros((0, 0))))
    yield log("a wrong length", ".mat", saved(x1=np.zeros(7)))
    yield log("three dimensions", ".mat", saved(x1=np.zeros((sound.N, 2, 2))))

    def h5(change):
        def write(p: Path) -> None:
            sound.write_table(p, x)
            with h5py.File(p, "r+") as file:
                del file["x1"]
                change(file, p)

        return write

    def outside(file: h5py.File, p: Path) -> None:
        (p.parent / "secret.bin").write_bytes(np.zeros(sound.N).tobytes())
        file.create_dataset("x1", (1, sound.N), "<f8", external=[("secret.bin", 0, 8 * sound.N)])

    def linked(file: h5py.File, p: Path) -> None:
        with h5py.File(p.parent / "other.h5", "w") as other:
            other["x1"] = x["x1"][None]
        file["x1"] = h5py.ExternalLink("other.h5", "/x1")

    def virtual(file: h5py.File, p: Path) -> None:
        with h5py.File(p.parent / "other.h5", "w") as other:
            other["x1"] = x["x1"][None]
        layout = h5py.VirtualLayout((1, sound.N), "<f8")
        layout[:] = h5py.VirtualSource(str(p.parent / "other.h5"), "x1", (1, sound.N))
        file.create_virtual_dataset("x1", layout)

    def deeply(file: h5py.File, p: Path) -> None:
        group = file
        for _ in range(300):
            group = group.create_group("s")
        group["x1"] = x["x1"][None]

    yield log("an external file", ".h5.mat", h5(outside))
    yield log("an external link", ".h5.mat", h5(linked))
    yield log("a virtual dataset", ".h5.mat", h5(virtual))
    yield log("a link to itself", ".h5.mat", h5(lambda f, p: f.__setitem__("x1", h5py.SoftLink("/x1"))))
    yield log("groups in circles", ".h5.mat", h5(lambda f, p: f.__setitem__("x1", f["/"])))
    yield log("groups without end", ".h5.mat", h5(deeply))
    yield log("a compound", ".h5.mat", h5(lambda f, p: f.create_dataset("x1", data=np.zeros(sound.N, [("a", float)]))))
    yield log("text", ".h5.mat", h5(lambda f, p: f.create_dataset("x1", data=[b"a"] * sound.N)))
    yield log(
        "lists of lengths", ".h5.mat", h5(lambda f, p: f.create_dataset("x1", (sound.N,), h5py.vlen_dtype(float)))
    )
    yield log("no data", ".h5.mat", h5(lambda f, p: f.create_dataset("x1", data=h5py.Empty("f8"))))
    yield log("a single number", ".h5.mat", h5(lambda f, p: f.create_dataset("x1", data=1.0)))


def bags() -> Iterator[Case]:
    def rows(change, count: int = sound.N):
        out = []
        for k, (stamp, message) in enumerate(sound.messages()[:count]):
            new = {**message, "position": list(message["position"]), "effort": list(message["effort"])}
            out.append(change(k, stamp, new) or (stamp, new))
        return out

    def bag(id_: str, change, outcome: str = REFUSED, definition: str = JOINT_STATE) -> Case:
        return log(id_, ".mcap", lambda p: sound.write_mcap(p, rows(change), definition), outcome)

    def put(key: str, value, at: int | None = None):
        return lambda k, stamp, m: m.update({key: value}) if at is None or k == at else None

    def stamped(f):
        def change(k, stamp, m):
            new = f(k, stamp)
            m["header"] = {"stamp": {"sec": new // 10**9, "nanosec": new % 10**9}, "frame_id": ""}
            return stamp, m

        return change

    yield bag("no names", put("name", []))
    yield bag("a name twice", put("name", ["one", "one"]))
    yield bag("a joint missing", put("name", ["one", "three"]))
    yield bag("NaN", put("position", [float("nan"), 0.0], 7))
    yield bag("all NaN", put("effort", [float("nan")] * 2))
    yield bag("huge", put("position", [1e300, 1e300], 4))
    yield bag("too few positions", put("position", [0.1], 11))
    yield bag("too many positions", put("position", [0.1] * 50, 11))
    yield bag("no efforts", put("effort", []))
    yield bag("stamps stand still", stamped(lambda k, s: 10**18))
    yield bag("stamps go back", stamped(lambda k, s: 10**18 - 2_000_000 * k))
    yield bag("stamps in minutes", stamped(lambda k, s: 10**18 + 60_000_000_000 * k))
    yield log("no messages", ".mcap", lambda p: sound.write_mcap(p, []))
    yield log("one message", ".mcap", lambda p: sound.write_mcap(p, sound.messages()[:1]))
    loop = JOINT_STATE.replace("string[] name", "sensor_msgs/JointState inner\nstring[] name")
    yield log("a definition that holds itself", ".mcap", lambda p: _raw_mcap(p, loop))
    yield log("a definition of another kind", ".mcap", lambda p: _raw_mcap(p, "garbage \x00 here"))
    yield log(
        "a definition of endless arrays",
        ".mcap",
        lambda p: _raw_mcap(p, JOINT_STATE.replace("float64[] position", "float64[1000000000] position")),
    )
    yield log("no definition", ".mcap", lambda p: _raw_mcap(p, ""))
    yield log("another encoding", ".mcap", lambda p: _raw_mcap(p, JOINT_STATE, encoding="protobuf"))
    yield log(
        "messages that are cut", ".mcap", lambda p: _raw_mcap(p, JOINT_STATE, data=b"\x00\x01\x00\x00" + b"\x01" * 9)
    )
    yield log(
        "counts beyond the message",
        ".mcap",
        lambda p: _raw_mcap(p, JOINT_STATE, data=b"\x00\x01\x00\x00" + bytes(12) + b"\xff\xff\xff\x7f" * 4),
    )
    for name, script in DATABASES.items():
        yield log(name, ".db3", lambda p, s=script: _database(p, s), alone="without end" in name or "blobs" in name)


def _raw_mcap(path: Path, definition: str, encoding: str = "ros2msg", data: bytes = bytes(40)) -> None:
    from mcap.writer import Writer

    with path.open("wb") as file:
        writer = Writer(file)
        writer.start()
        schema = writer.register_schema("sensor_msgs/msg/JointState", encoding, definition.encode())
        channel = writer.register_channel("/joint_states", "cdr", schema)
        for k in range(20):
            writer.add_message(channel, k * 2_000_000, data, k * 2_000_000)
        writer.finish()


TOPICS = "CREATE TABLE topics(id INTEGER PRIMARY KEY, name TEXT, type TEXT, serialization_format TEXT);"
MESSAGES = "CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INTEGER, timestamp INTEGER, data BLOB);"
TOPIC = "INSERT INTO topics VALUES (1, '/joint_states', 'sensor_msgs/msg/JointState', 'cdr');"
DATABASES = {
    "no tables": "CREATE TABLE other(x);",
    "no messages table": TOPICS + TOPIC,
    "no topics": TOPICS + MESSAGES,
    "no rows": TOPICS + MESSAGES + TOPIC,
    "a column missing": TOPICS + TOPIC + "CREATE TABLE messages(id INTEGER, topic_id INTEGER, timestamp INTEGER);",
    "text for a stamp": TOPICS + MESSAGES + TOPIC + "INSERT INTO messages VALUES (1, 1, 'noon', x'00010000');",
    "null for a stamp": TOPICS + MESSAGES + TOPIC + "INSERT INTO messages VALUES (1, 1, NULL, x'00010000');",
    "text for a message": TOPICS + MESSAGES + TOPIC + "INSERT INTO messages VALUES (1, 1, 5, 'hello');",
    "a number for a message": TOPICS + MESSAGES + TOPIC + "INSERT INTO messages VALUES (1, 1, 5, 12);",
    "null for a message": TOPICS + MESSAGES + TOPIC + "INSERT INTO messages VALUES (1, 1, 5, NULL);",
    "a name that is no text": TOPICS + MESSAGES + "INSERT INTO topics VALUES (1, x'ff00', 'sensor_msgs/msg/JointState', 'cdr'); INSERT INTO messages VALUES (1, 1, 5, x'00010000');",
    "messages without end": TOPICS + TOPIC + "CREATE VIEW messages AS WITH RECURSIVE k(i) AS (SELECT 1 UNION ALL SELECT i + 1 FROM k) SELECT i AS id, 1 AS topic_id, i AS timestamp, x'00010000' AS data FROM k;",
    "topics without end": MESSAGES + "CREATE VIEW topics AS WITH RECURSIVE k(i) AS (SELECT 1 UNION ALL SELECT i + 1 FROM k) SELECT i AS id, 'a' AS name, 'b' AS type, 'cdr' AS serialization_format FROM k;",
    "blobs made up": TOPICS + TOPIC + "CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INTEGER, timestamp INTEGER, data BLOB GENERATED ALWAYS AS (zeroblob(900000000))); "
    + "".join(f"INSERT INTO messages(id, topic_id, timestamp) VALUES ({k}, 1, {k});" for k in range(20)),
}  # fmt: skip


def _database(path: Path, script: str) -> None:
    db = sqlite3.connect(path)
    db.executescript(script)
    db.close()


def bombs() -> Iterator[Case]:
    def zipped(p: Path) -> None:
        header = b"{'descr': '<f8', 'fortran_order': False, 'shape': (%d,), }" % (HUGE // 8)
        with zipfile.ZipFile(p, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as file:
            for name, value in sound.columns().items():
                if name == "x1":
                    with file.open("x1.npy", "w", force_zip64=True) as inner:
                        inner.write(b"\x93NUMPY\x01\x00" + struct.pack("<H", len(header)) + header)
                        for _ in range(HUGE // 2**26 // 4):
                            inner.write(bytes(2**26))
                else:
                    buffer = io.BytesIO()
                    np.save(buffer, value)
                    file.writestr(f"{name}.npy", buffer.getvalue())

    yield log("a zip bomb", ".npz", zipped, alone=True)

    def deflated(p: Path) -> None:
        scipy.io.savemat(p, {k: v for k, v in sound.columns().items() if k != "x1"})
        count = 2**31 - 2**20
        head = (
            struct.pack("<II", 14, count + 56)
            + struct.pack("<IIII", 6, 8, 6, 0)
            + struct.pack("<IIii", 5, 8, 1, count // 8)
        )
        head += struct.pack("<HHI", 1, 2, 0x3178) + struct.pack("<II", 9, count)
        packer, body = zlib.compressobj(1), []
        body.append(packer.compress(head))
        for _ in range(count // 2**20):
            body.append(packer.compress(bytes(2**20)))
        body.append(packer.flush())
        data = b"".join(body)
        with p.open("ab") as file:
            file.write(struct.pack("<II", 15, len(data)) + data)

    yield log("a deflate bomb", ".mat", deflated, alone=True)

    def dimensions(p: Path, kind: int) -> None:
        scipy.io.savemat(p, {k: v for k, v in sound.columns().items() if k != "x1"})
        body = (
            struct.pack("<IIII", 6, 8, kind, 0)
            + struct.pack("<IIii", 5, 8, 2**20, 2**10)
            + struct.pack("<HHI", 1, 2, 0x3178)
        )
        body += struct.pack("<HHi", 5, 4, 32) + struct.pack("<II", 1, 32) + b"a".ljust(32, b"\0") if kind == 2 else b""
        with p.open("ab") as file:
            file.write(struct.pack("<II", 14, len(body)) + body)

    yield log("cells without end", ".mat", lambda p: dimensions(p, 1), alone=True)
    yield log("a structure array without end", ".mat", lambda p: dimensions(p, 2), alone=True)

    def never_written(p: Path, count: int) -> None:
        sound.write_table(p, sound.columns())
        with h5py.File(p, "r+") as file:
            del file["x1"]
            file.create_dataset("x1", (1, count), "<f8", chunks=(1, 2**16))

    yield log("a dataset never written", ".h5.mat", lambda p: never_written(p, HUGE // 8), alone=True)
    yield log("a dataset larger than all memory", ".h5.mat", lambda p: never_written(p, 10**14), alone=True)

    def rows(p: Path, count: int) -> None:
        zero = pa.DictionaryArray.from_arrays(pa.array(np.zeros(2**22, np.int32)), pa.array([0.0]))
        schema = pa.schema([(k, zero.type) for k in sound.columns()])
        with pq.ParquetWriter(p, schema, compression="zstd") as writer:
            table = pa.table(dict.fromkeys(sound.columns(), zero), schema)
            for _ in range(count // 2**22):
                writer.write_table(table)

    yield log("rows without end", ".parquet", lambda p: rows(p, HUGE // 40), alone=True)

    for method in ("zstd", "lz4"):
        yield log(f"a {method} bomb", ".mcap", lambda p, m=method: _packed_mcap(p, m, 2 * 2**30), alone=True)


def _packed_mcap(path: Path, method: str, size: int) -> None:
    """An MCAP file of one chunk that unpacks to ``size`` zeros."""
    block = bytes(2**24)
    if method == "zstd":
        import zstandard

        packer = zstandard.ZstdCompressor(level=1).compressobj(size=size)
        data = b"".join([*(packer.compress(block) for _ in range(size // len(block))), packer.flush()])
    else:
        import lz4.frame

        packer = lz4.frame.LZ4FrameCompressor()
        parts = [packer.begin(), *(packer.compress(block) for _ in range(size // len(block))), packer.flush()]
        data = b"".join(parts)
    name = method.encode()
    body = (
        struct.pack("<QQQI", 0, 1, size, 0) + struct.pack("<I", len(name)) + name + struct.pack("<Q", len(data)) + data
    )
    header = struct.pack("<I", 0) * 2
    with path.open("wb") as file:
        file.write(b"\x89MCAP0\r\n" + b"\x01" + struct.pack("<Q", len(header)) + header)
        file.write(b"\x06" + struct.pack("<Q", len(body)) + body)
        file.write(b"\x0f" + struct.pack("<Q", 4) + bytes(4))
        file.write(b"\x02" + struct.pack("<Q", 20) + bytes(20) + b"\x89MCAP0\r\n")


NAMES = {  # name of the log -> whether it can be the name of a segment
    "a\\b.csv": False,
    "..\\..\\evil.csv": False,
    "a\nb.csv": False,
    "a\x1b[2Jb.csv": False,
    "x" * 251 + ".csv": False,
    "\udcff\udcfe.csv": False,
    "...csv": True,
    "--out.csv": True,
    'lo\'g "1".csv': True,
    "größe µ.csv": True,
    "dataset.toml.csv": True,
    "$(touch evil).csv": True,
}


def names() -> Iterator[Case]:
    for k, (name, sound_name) in enumerate(NAMES.items()):

        def make(folder: Path, name=name) -> list[str]:
            (folder / name).write_bytes(sound.log_bytes(".csv"))
            args = sound.convert(folder)
            return [*args[:1], *args[1:], "--", str(folder / name)]

        yield Case(
            f"name {k} of a log", make, "" if sound_name else "name of a segment", ACCEPTED if sound_name else REFUSED
        )

    def two(folder: Path) -> list[str]:
        for sub in ("m", "n"):
            (folder / sub).mkdir()
            (folder / sub / "log.csv").write_bytes(sound.log_bytes(".csv"))
        return sound.convert(folder, "m/log.csv", "n/log.csv")

    yield Case("two logs of one name", two, "map.toml")

    def through(folder: Path) -> list[str]:
        (folder / "log.csv").write_bytes(sound.log_bytes(".csv"))
        return sound.convert(folder, "pair/../log.csv")

    yield Case("a log by a path with dots", through, "", ACCEPTED)

    def itself(folder: Path) -> list[str]:
        (folder / "log.csv").symlink_to(folder / "log.csv")
        return sound.convert(folder, "log.csv")

    yield Case("a log that links to itself", itself, "log.csv")

    def device(folder: Path) -> list[str]:
        return [*sound.convert(folder), "--", "/dev/zero"]

    yield Case("a device for a log", device, "/dev/zero")

    def pipe(folder: Path) -> list[str]:
        import os

        os.mkfifo(folder / "log.csv")
        return sound.convert(folder, "log.csv")

    yield Case("a pipe for a log", pipe, "log.csv")
