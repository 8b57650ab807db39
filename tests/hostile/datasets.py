"""Datasets, results and plans, as every command that reads them meets them; options of the command line."""

from __future__ import annotations

import tomllib
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import tomlkit

from ident.dataset import Dataset, Segment
from ident.dataset_io import save_dataset
from ident.plan import make_plan
from ident.plan_file import plan_to_toml
from robot_assets.robot import load_robot
from tests.hostile.case import ACCEPTED, REFUSED, Case, flips

READERS = {
    "check": ["check", "DATA"],
    "frf": ["frf", "DATA", "--out", "OUT"],
    "identify": ["identify", "DATA", "--out", "OUT", "--quiet"],
    "diagnose": ["diagnose", "DATA", "--out", "OUT", "--quiet"],
}
WRONG = {
    "nothing": [], "a text": "x", "a negative": -3, "zero": 0, "NaN": float("nan"), "a huge number": 10**40,
    "a path": "../../evil", "a table": {"a": 1}, "control characters": "a\n\x1b[2Jb",
}  # fmt: skip


def cases() -> Iterator[Case]:
    """All of them."""
    yield from datasets()
    yield from results()
    yield from plans()
    yield from options()


def write_dataset(folder: Path) -> Path:
    """A sound dataset of a small multisine and a motion on ``twomass``."""
    robot, rng, N = load_robot("twomass"), np.random.default_rng(0), 128
    x = rng.normal(size=(2, N, 1))

    def segment(name: str, **kwargs) -> Segment:
        return Segment(name=name, role="identification", t=np.arange(N) / 1000.0, tau=x[0], q=x[1], **kwargs)

    labels = dict(
        operating_point="op01", q0=np.zeros(1), period=32, periods=4, transient_periods=1, experiment=1, realization=1
    )
    made = (
        segment("a", kind="multisine", amplitude=1.0, excited_lines=np.array([1, 3, 5]), **labels),
        segment("b", kind="trajectory"),
    )
    save_dataset(Dataset("small", robot, 1000.0, robot.joint_names, "zoh", None, None, None, made), folder)
    return folder


def table(change: Callable[[dict], None]) -> Callable[[Path], None]:
    """A change of the columns of the first segment."""

    def apply(folder: Path) -> None:
        read = pq.read_table(folder / "a.parquet")
        columns = {k: read.column(k).to_numpy().copy() for k in read.column_names}
        change(columns)
        pq.write_table(pa.table(columns), folder / "a.parquet")

    return apply


def head(key: str, value, segment: bool = False) -> Callable[[Path], None]:
    """A change of dataset.toml."""

    def apply(folder: Path) -> None:
        data = tomllib.loads((folder / "dataset.toml").read_text())
        (data["segment"][0] if segment else data)[key] = value
        (folder / "dataset.toml").write_text(tomlkit.dumps(data))

    return apply


def raw(change: Callable[[bytes], bytes], file: str = "a.parquet") -> Callable[[Path], None]:
    return lambda folder: (folder / file).write_bytes(change((folder / file).read_bytes())) and None


def many_rows(folder: Path) -> None:
    """A segment of 90 million rows in a small file."""
    zero = pa.DictionaryArray.from_arrays(pa.array(np.zeros(2**22, np.int32)), pa.array([0.0]))
    names = ("t", "tau_1", "q_1", "qd_1", "r_1", "q_ref_1", "q_link_1", "temp_1")
    schema = pa.schema([(k, zero.type) for k in names])
    with pq.ParquetWriter(folder / "a.parquet", schema, compression="zstd") as writer:
        rows = pa.table(dict.fromkeys(names, zero), schema)
        for _ in range(21):
            writer.write_table(rows)


DAMAGE: dict[str, tuple[Callable[[Path], None], str]] = {
    "no toml": (lambda f: (f / "dataset.toml").unlink(), "d"),
    "an empty toml": (raw(lambda b: b"", "dataset.toml"), "dataset.toml"),
    "a toml of bytes": (raw(lambda b: bytes(range(256)), "dataset.toml"), "dataset.toml"),
    "a toml cut": (raw(lambda b: b[: len(b) // 2], "dataset.toml"), "dataset.toml"),
    "a segment missing": (lambda f: (f / "a.parquet").unlink(), "a.parquet"),
    "a segment empty": (raw(lambda b: b""), "a.parquet"),
    "a segment cut": (raw(lambda b: b[: len(b) // 2]), "a.parquet"),
    "a segment of zeros": (raw(lambda b: bytes(len(b))), "a.parquet"),
    "a segment with bits turned": (raw(lambda b: flips(b, 1, 40)), "a.parquet"),
    "NaN": (table(lambda c: c["q_1"].__setitem__(5, np.nan)), "q_1"),
    "infinity": (table(lambda c: c["tau_1"].__setitem__(5, np.inf)), "tau_1"),
    "huge": (table(lambda c: c["tau_1"].__imul__(1e200)), "tau_1"),
    "no torque": (table(lambda c: c.pop("tau_1")), "tau_1"),
    "words": (table(lambda c: c.update(q_1=np.array(["x"] * 128))), "q_1"),
    "time back": (table(lambda c: c.update(t=c["t"][::-1].copy())), "a.parquet"),
    "time constant": (table(lambda c: c.update(t=0 * c["t"])), "a.parquet"),
    "short": (table(lambda c: [c.update({k: v[:50]}) for k, v in list(c.items())]), "a.parquet"),
    "a rate that is absurd": (head("sample_rate", 1e300), "sample_rate"),
    "a rate of another size": (head("sample_rate", 1e7), "a.parquet"),
    "a robot unknown": (head("robot", "hal9000"), "hal9000"),
    "a robot by path": (head("robot", "../../.."), "robot"),
    "another robot": (head("robot", "ur10"), "joints"),
    "another format": (head("format", "simgap-dataset/9"), "format"),
    "a file outside": (head("file", "../secret.parquet", True), "segment 1"),
    "a file by an absolute path": (head("file", "/etc/passwd", True), "segment 1"),
    "a period too long": (head("period", 10**9, True), "a.parquet"),
    "a line beyond Nyquist": (head("excited_lines", [40], True), "segment 1"),
    "an amplitude of NaN": (head("amplitude", float("nan"), True), "segment 1"),
    "joints twice": (head("joints", ["drive", "drive"]), "joints"),
    "rows without end": (many_rows, "a.parquet"),
}


def datasets() -> Iterator[Case]:
    for command, template in READERS.items():
        for name, (damage, names) in DAMAGE.items():

            def make(folder: Path, template=template, damage=damage) -> list[str]:
                damage(write_dataset(folder / "d"))
                return [{"DATA": str(folder / "d"), "OUT": str(folder / "out")}.get(a, a) for a in template]

            yield Case(f"{command} {name}", make, names, alone=name == "rows without end")
        for kind in ("missing", "a file", "a device", "no name"):

            def bare(folder: Path, template=template, kind=kind) -> list[str]:
                (folder / "x").write_text("hello")
                data = {"missing": "nothing", "a file": "x", "a device": "/dev/zero", "no name": ""}[kind]
                return [{"DATA": data, "OUT": str(folder / "out")}.get(a, a) for a in template]

            yield Case(f"{command} {kind} for a dataset", bare, "")
        if command != "check":

            def over(folder: Path, template=template) -> list[str]:
                (folder / "x").write_text("hello")
                return [
                    {"DATA": str(write_dataset(folder / "d")), "OUT": str(folder / "x")}.get(a, a) for a in template
                ]

            def within(folder: Path, template=template) -> list[str]:
                (folder / "x").write_text("hello")
                return [
                    {"DATA": str(write_dataset(folder / "d")), "OUT": str(folder / "x" / "y")}.get(a, a)
                    for a in template
                ]

            yield Case(f"{command} out that is a file", over, "x")
            yield Case(f"{command} out inside a file", within, "x")


def results() -> Iterator[Case]:
    contents = {
        "empty": b"",
        "text": b"hello",
        "zeros": bytes(4000),
        "bits": bytes(range(256)) * 9,
        "a header alone": b"RRF2\x00\x22\x00\x00",
    }
    for name, data in contents.items():

        def make(folder: Path, data=data) -> list[str]:
            (folder / "r").mkdir()
            (folder / "r" / "recording.rrd").write_bytes(data)
            return ["show", str(folder / "r")]

        yield Case(f"show {name}", make, "recording.rrd")

    def nothing(folder: Path) -> list[str]:
        return ["show", str(folder / "nothing")]

    def a_folder(folder: Path) -> list[str]:
        (folder / "r" / "recording.rrd").mkdir(parents=True)
        return ["show", str(folder / "r")]

    yield Case("show nothing", nothing, "nothing")
    yield Case("show a folder", a_folder, "recording.rrd")


@cache
def plan_text() -> str:
    import tempfile

    robot = load_robot("twomass")
    plan = make_plan(
        robot,
        points=1,
        validation_points=0,
        levels=(1.0,),
        period=200,
        periods=2,
        transient_periods=1,
        sample_rate=1000.0,
        trajectory=True,
        band_hz=(5.0, 60.0),
    )
    plan = replace(plan, trajectories=tuple(replace(m, q_ref=m.q_ref[:200]) for m in plan.trajectories))
    with tempfile.TemporaryDirectory() as folder:
        plan_to_toml(plan, Path(folder) / "plan.toml")
        return (Path(folder) / "plan.toml").read_text()


PLAN_KEYS: dict[tuple, set[str]] = {
    ("format",): set(),
    ("robot",): set(),
    ("injection",): set(),
    ("seed",): {"zero"},
    ("sample_rate",): set(),
    ("period",): set(),
    ("periods",): set(),
    ("transient_periods",): {"zero"},
    ("lines",): set(),
    ("detection",): {"nothing"},
    ("trajectory",): {"nothing"},
    ("experiment",): {"nothing"},
    ("experiment", 0, "operating_point"): {"a text"},
    ("experiment", 0, "q0"): set(),
    ("experiment", 0, "experiment"): set(),
    ("experiment", 0, "realization"): set(),
    ("experiment", 0, "amplitude"): set(),
    ("experiment", 0, "role"): set(),
    ("experiment", 0, "real"): set(),
    ("experiment", 0, "imag"): set(),
    ("trajectory", 0, "name"): {"a text"},
    ("trajectory", 0, "samples"): set(),
    ("trajectory", 0, "q_ref"): set(),
    ("trajectory", 0, "role"): set(),
}


def plan_args(folder: Path, text: str | bytes) -> list[str]:
    (folder / "plan.toml").write_bytes(text if isinstance(text, bytes) else text.encode())
    return ["experiment", "twomass", "--plan", str(folder / "plan.toml"), "--out", str(folder / "out"), "--quiet"]


def plans() -> Iterator[Case]:
    for path, fine in PLAN_KEYS.items():
        for name, value in WRONG.items():

            def make(folder: Path, path=path, value=value) -> list[str]:
                data = tomllib.loads(plan_text())
                inner = data
                for key in path[:-1]:
                    inner = inner[key]
                inner[path[-1]] = value
                return plan_args(folder, tomlkit.dumps(data))

            yield Case(f"plan {'.'.join(map(str, path))} {name}", make, "", ACCEPTED if name in fine else REFUSED)

    def neither(folder: Path) -> list[str]:
        data = tomllib.loads(plan_text()) | {"experiment": [], "trajectory": []}
        return plan_args(folder, tomlkit.dumps(data))

    def forces(folder: Path) -> list[str]:
        data = tomllib.loads(plan_text())
        data["experiment"][0]["real"] = [[1e15]] * len(data["lines"])
        return plan_args(folder, tomlkit.dumps(data))

    def twice(folder: Path) -> list[str]:
        data = tomllib.loads(plan_text())
        data["experiment"] *= 2
        return plan_args(folder, tomlkit.dumps(data))

    def size(key: str, value) -> Callable[[Path], list[str]]:
        return lambda folder: plan_args(folder, tomlkit.dumps(tomllib.loads(plan_text()) | {key: value}))

    def many(folder: Path) -> list[str]:
        data = tomllib.loads(plan_text()) | {"periods": 10**4, "period": 10**5}
        return plan_args(folder, tomlkit.dumps(data))

    yield Case("plan of nothing", neither, "plan.toml")
    yield Case("plan of forces beyond all", forces, "")
    yield Case("plan of an experiment twice", twice, "")
    yield Case("plan of a huge period", size("period", 10**8), "", alone=True)
    yield Case("plan of ten thousand long periods", many, "", alone=True)
    yield Case("plan of a rate that no step divides", size("sample_rate", 777.7), "")
    yield Case("plan of a huge rate", size("sample_rate", 1e7), "")
    for name, text in {"empty": "", "bytes": bytes(range(256)), "cut": 400, "nested": "x = " + "[" * 9000}.items():
        yield Case(
            f"plan {name}", lambda f, t=text: plan_args(f, plan_text()[:t] if isinstance(t, int) else t), "plan.toml"
        )
    yield Case(
        "plan that is not there",
        lambda f: ["experiment", "twomass", "--plan", str(f / "no.toml"), "--out", str(f / "out")],
        "no.toml",
    )
    yield Case(
        "plan that is a folder", lambda f: ["experiment", "twomass", "--plan", str(f), "--out", str(f / "out")], ""
    )
    yield Case("plan for another robot", lambda f: ["experiment", "ur10", *plan_args(f, plan_text())[2:]], "plan.toml")


EXPERIMENT = ["experiment", "twomass", "--out", "out", "--quiet"]
OPTIONS = [
    [*EXPERIMENT, "--seed", "-5000"],
    [*EXPERIMENT, "--seed", "x"],
    [*EXPERIMENT, "--points", "1000000000"],
    [*EXPERIMENT, "--points", "1e3"],
    [*EXPERIMENT, "--realizations", "1000000000"],
    [*EXPERIMENT, "--drives", "fast"],
    [*EXPERIMENT, "--effect", ""],
    [*EXPERIMENT, "--effect", "coulomb_friction"],
    [*EXPERIMENT, "--effect", "coulomb_friction@moon"],
    [*EXPERIMENT, "--effect", "coulomb_friction@drive:torque"],
    [*EXPERIMENT, "--effect", "coulomb_friction@drive:torque=much"],
    [*EXPERIMENT, "--effect", "coulomb_friction@drive:torque=nan"],
    [*EXPERIMENT, "--effect", "coulomb_friction@drive:torque=inf"],
    [*EXPERIMENT, "--effect", "coulomb_friction@drive:torque=1e300"],
    [*EXPERIMENT, "--effect", "coulomb_friction@drive:torque=1 2 3"],
    [*EXPERIMENT, "--effect", "coulomb_friction@drive:torque=-1"],
    [*EXPERIMENT, "--effect", "coulomb_friction@drive:torque=1e10"],
    [*EXPERIMENT, "--effect", "coulomb_friction@drive:power=3"],
    [*EXPERIMENT, "--effect", "coulomb_friction@drive:torque=1,torque=2"],
    [*EXPERIMENT, "--effect", "torque_delay@drive:delay=-1"],
    [*EXPERIMENT, "--effect", "torque_delay@drive:delay=1e9"],
    [*EXPERIMENT, "--effect", "payload@flange:mass=-1"],
    [*EXPERIMENT, "--effect", "encoder_quantization@drive:resolution=0"],
    [*EXPERIMENT, "--effect", "cogging@drive:amplitude=1,periods_per_rev=nan,phase=0"],
    ["experiment", "../../etc", "--out", "out"],
    ["experiment", "", "--out", "out"],
    ["design", "twomass", "--out", "out.toml", "--points", "1000000000"],
    ["design", "twomass", "--out", "out.toml", "--candidates", "1000000000000"],
    ["design", "twomass", "--out", "out.toml", "--criterion", "Z", "--quiet"],
    ["design", "twomass", "--out", "out.toml", "--level", "nan"],
    ["design", "twomass", "--out", "out.toml", "--level", "0"],
    ["design", "twomass", "--out", "out.toml", "--draws", "0"],
    ["design", "twomass", "--out", "."],
    ["frf", "DATA", "--out", "out", "--estimator", "magic"],
    ["identify", "DATA", "--out", "out", "--estimator", "magic"],
    ["identify", "DATA", "--out", "out", "--frf", "magic", "--quiet"],
    ["diagnose", "DATA", "--out", "out", "--max-causes", "-1"],
    ["diagnose", "DATA", "--out", "out", "--max-seconds", "soon"],
    ["diagnose", "DATA", "--out", "out", "--max-seconds", "nan"],
    ["diagnose", "DATA", "--out", "out", "--executor", "processes:0"],
    ["diagnose", "DATA", "--out", "out", "--executor", "dask://nowhere"],
    ["demo", "--out", "out", "--seed", "-3"],
    ["demo", "--out", "out", "--real", "../../etc"],
    ["convert", "DATA/a.parquet", "--robot", "twomass", "--map", "x.toml", "--out", "out"],
    ["check"],
    ["check", "DATA", "DATA"],
    ["--frobnicate"],
]


def options() -> Iterator[Case]:
    for args in OPTIONS:

        def make(folder: Path, args=args) -> list[str]:
            write_dataset(folder / "d")
            return [a.replace("DATA", str(folder / "d")) for a in args]

        huge = any(a in ("1000000000", "1000000000000") for a in args)
        usage = not set(args) & {"--effect", "--seed", "--estimator", "--real"}
        yield Case(
            "options " + " ".join(args), make, "", alone=huge or (args[0] == "demo" and not usage and "-3" in args)
        )
