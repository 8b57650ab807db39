"""Hostile input: whatever stands in a folder, it loads or gives one clear line."""

from __future__ import annotations

import os
import tomllib

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import tomlkit

from ident.dataset import Dataset, Segment
from ident.dataset_io import load_dataset, save_dataset
from robot_assets.errors import DataError
from robot_assets.robot import load_robot

ODD = (
    -1,
    0,
    2**70,
    10**400,
    1.5,
    1e308,
    float("inf"),
    float("nan"),
    True,
    "",
    "x",
    "\x00",
    "y" * 5000,
    "..",
    "²",
    [],
    [[]],
    ["x"],
    [10**400] * 6,
    [float("nan")] * 6,
    {},
    {"a": 1},
)


@pytest.fixture
def folder(tmp_path, ur10):
    rng = np.random.default_rng(0)
    N, n = 64, 6

    def segment(name, **kwargs):
        return Segment(
            name=name,
            role="identification",
            t=np.arange(N) / 1000.0,
            tau=rng.normal(size=(N, n)),
            q=rng.normal(size=(N, n)),
            **kwargs,
        )

    multisine = segment(
        "a",
        kind="multisine",
        operating_point="op01",
        q0=np.zeros(n),
        period=32,
        periods=2,
        transient_periods=1,
        experiment=1,
        realization=1,
        amplitude=0.5,
        excited_lines=np.array([3, 5]),
    )
    data = Dataset(
        "small",
        ur10,
        1000.0,
        ur10.joint_names,
        "zoh",
        np.full(n, 1e-6),
        np.full(n, 0.1),
        {"type": "pd"},
        (multisine, segment("b", kind="trajectory")),
    )
    save_dataset(data, tmp_path / "d")
    return tmp_path / "d"


def outcome(load, *args) -> str | None:
    """The line of the error, or None where it loads; any other exception passes through."""
    try:
        load(*args)
    except DataError as err:
        line = str(err)
        assert "\n" not in line and len(line) < 2000
        assert "found" in line and "expected" in line
        return line
    return None


def rewrite(path, change) -> None:
    head = tomllib.loads(path.read_text())
    change(head)
    path.write_text(tomlkit.dumps(head))


def set_odd(table, key, value) -> None:
    if value is None:
        table.pop(key, None)
    else:
        table[key] = value


REFUSED = {  # keys of which no odd value is sound
    "format",
    "robot",
    "sample_rate",
    "joints",
    "input_hold",
    "segment",
    "file",
    "kind",
    "role",
    "period",
    "periods",
}


@pytest.mark.parametrize(
    "key", ["format", "name", "robot", "sample_rate", "joints", "input_hold", "noise", "controller", "segment"]
)
def test_every_odd_header_value_loads_or_is_one_line(folder, key):
    original = (folder / "dataset.toml").read_text()
    for value in (None, *ODD):
        if key == "robot" and value == "..":
            continue
        (folder / "dataset.toml").write_text(original)
        rewrite(folder / "dataset.toml", lambda head, v=value: set_odd(head, key, v))
        line = outcome(load_dataset, folder)
        if (
            key in REFUSED
            and not (key == "input_hold" and value is None)
            and not (key == "sample_rate" and value == 1.0)
        ):
            assert line is not None, value


@pytest.mark.parametrize(
    "key",
    [
        "file",
        "kind",
        "role",
        "operating_point",
        "q0",
        "period",
        "periods",
        "transient_periods",
        "experiment",
        "realization",
        "amplitude",
        "excited_lines",
    ],
)
def test_every_odd_segment_value_loads_or_is_one_line(folder, key):
    original = (folder / "dataset.toml").read_text()
    for value in (None, *ODD):
        (folder / "dataset.toml").write_text(original)
        rewrite(folder / "dataset.toml", lambda head, v=value: set_odd(head["segment"][0], key, v))
        line = outcome(load_dataset, folder)
        if key in REFUSED and not (key == "role" and value is None):
            assert line is not None, value
        assert line is None or "dataset.toml" in line or "a.parquet" in line


@pytest.mark.parametrize("key", ["q_std", "tau_std"])
def test_every_odd_noise_level_loads_or_is_one_line(folder, key):
    original = (folder / "dataset.toml").read_text()
    for value in ODD:
        (folder / "dataset.toml").write_text(original)
        rewrite(folder / "dataset.toml", lambda head, v=value: set_odd(head["noise"], key, v))
        assert outcome(load_dataset, folder) is not None, value


@pytest.mark.parametrize("place", ["", "urdf", "locked", "joint", "elasticity", "load"])
def test_every_odd_value_of_a_robot_loads_or_is_one_line(tmp_path, place):
    irb = load_robot("irb")
    (tmp_path / "irb.urdf").write_text(irb.urdf.read_text())
    original = (irb.folder / "robot.toml").read_text()
    path = tmp_path / "robot.toml"
    head = tomllib.loads(original)
    tables = {"": head, "urdf": head["urdf"], "locked": {"joint_6": 0.0}}
    table = tables.get(place) or head[place][0]
    for key in table:
        for value in (None, *ODD):
            path.write_text(original)

            def change(h, key=key, value=value):
                inner = h if place == "" else h.setdefault(place, {})
                set_odd(inner[0] if isinstance(inner, list) else inner, key, value)

            rewrite(path, change)
            line = outcome(load_robot, tmp_path)
            if key in ("stiffness", "damping", "motor_inertia", "mass") and value not in (1.5, 1e308, 2**70):
                assert line is not None, (key, value)


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ('lower="-3.1416"', 'lower="low"'),
        ('lower="-3.1416"', 'lower="nan"'),
        ('lower="-3.1416"', 'lower="9"'),
        ('<child link="link_2"/>', ""),
        ('<child link="link_2"/>', '<child link="link_9"/>'),
        ('<child link="link_2"/>', '<child link="base_link"/>'),
        ('<mass value="180"/>', '<mass value="heavy"/>'),
        ('<mass value="180"/>', '<mass value="-180"/>'),
        ('<axis xyz="0 1 0"/>', '<axis xyz="0 0 0"/>'),
        ('<axis xyz="0 1 0"/>', '<axis xyz="0 1"/>'),
        ("</robot>", ""),
    ],
)
def test_a_broken_urdf_is_one_line(tmp_path, old, new):
    irb = load_robot("irb")
    text = irb.urdf.read_text()
    assert old in text
    (tmp_path / "irb.urdf").write_text(text.replace(old, new, 1))
    (tmp_path / "robot.toml").write_text((irb.folder / "robot.toml").read_text())
    assert "irb.urdf" in (outcome(load_robot, tmp_path) or "")


def test_corrupt_bytes_load_or_are_one_line(folder):
    file = folder / "a.parquet"
    original = file.read_bytes()
    rng = np.random.default_rng(1)
    refused = 0
    for _ in range(150):
        data = bytearray(original)
        for k in rng.integers(len(data), size=rng.integers(1, 6)):
            data[k] = rng.integers(256)
        file.write_bytes(bytes(data))
        line = outcome(load_dataset, folder)
        refused += line is not None
        assert line is None or "a.parquet" in line
    assert refused > 20


@pytest.mark.parametrize(
    "text",
    [
        "",
        "\n",
        "t\n",
        "\x00\x01\x02",
        "t,tau_1\n0,1\n0.001,1,2\n",
        "t;tau_1\n0;1\n",
        '"t\n',
        "\ufefft,tau_1\n",
        "t,t\n0,0\n",
        "t\n" + "0\n" * 20,
    ],
)
def test_a_broken_csv_is_one_line(folder, text):
    (folder / "a.csv").write_text(text)
    rewrite(folder / "dataset.toml", lambda head: set_odd(head["segment"][0], "file", "a.csv"))
    assert "a.csv" in (outcome(load_dataset, folder) or "")


def test_an_empty_cell_is_named_with_its_place(folder):
    table = pq.read_table(folder / "a.parquet").to_pydict()
    rows = [",".join(table), *(",".join(str(v[i]) for v in table.values()) for i in range(64))]
    cells = rows[10].split(",")
    cells[2] = ""
    rows[10] = ",".join(cells)
    (folder / "a.csv").write_text("\n".join(rows))
    rewrite(folder / "dataset.toml", lambda head: set_odd(head["segment"][0], "file", "a.csv"))
    line = outcome(load_dataset, folder)
    assert "tau_2" in line and "sample 9" in line


@pytest.mark.parametrize("file", [".", "./", "a.parquet/.."])
def test_a_segment_that_is_the_folder_itself_is_refused(folder, file):
    rewrite(folder / "dataset.toml", lambda head: set_odd(head["segment"][1], "file", file))
    assert "a file inside the dataset folder" in outcome(load_dataset, folder)


@pytest.mark.parametrize("second", ["./a.parquet", "c/../a.parquet", "a.csv", "A/../a.parquet"])
def test_the_same_segment_by_another_spelling_is_refused(folder, second):
    table = pq.read_table(folder / "a.parquet")
    pa.csv.write_csv(table, folder / "a.csv")
    rewrite(folder / "dataset.toml", lambda head: set_odd(head["segment"][1], "file", second))
    assert second in (outcome(load_dataset, folder) or "")


def test_links_out_of_the_folder_and_loops_are_refused(folder, tmp_path):
    (folder / "a.parquet").rename(tmp_path / "secret.parquet")
    os.symlink(tmp_path / "secret.parquet", folder / "a.parquet")
    assert "outside" in outcome(load_dataset, folder)
    (folder / "a.parquet").unlink()
    os.symlink(folder / "a.parquet", folder / "a.parquet")
    assert "a.parquet" in outcome(load_dataset, folder)


@pytest.mark.parametrize("kind", ["missing", "file", "folder", "directory instead of toml", "binary"])
def test_what_is_no_dataset_is_one_line(tmp_path, kind):
    path = tmp_path / "x"
    if kind == "file":
        path.write_text("hello")
    elif kind != "missing":
        path.mkdir()
    if kind == "directory instead of toml":
        (path / "dataset.toml").mkdir()
    if kind == "binary":
        (path / "dataset.toml").write_bytes(bytes(range(256)))
    assert outcome(load_dataset, path)


def test_foreign_columns_are_left_alone(folder):
    """The format may be extended by optional columns: text among them, and names close to ours."""
    table = pq.read_table(folder / "a.parquet")
    for name in ("note", "q_note", "tau_²", "q_1_raw", "current_1"):
        table = table.append_column(name, pa.array(["x"] * len(table)))
    pq.write_table(table, folder / "a.parquet")
    assert outcome(load_dataset, folder) is None


def test_link_encoders_at_some_joints_survive_a_round_trip(folder, tmp_path):
    table = pq.read_table(folder / "a.parquet")
    pq.write_table(table.append_column("q_link_2", table.column("q_2")), folder / "a.parquet")
    once = load_dataset(folder)
    save_dataset(once, tmp_path / "again")
    q_link = load_dataset(tmp_path / "again").segments[0].q_link
    assert np.array_equal(q_link, once.segments[0].q_link, equal_nan=True)
    assert np.isnan(q_link[:, 0]).all() and not np.isnan(q_link[:, 1]).any()


def test_a_robot_by_relative_path_is_found_from_where_the_dataset_is_saved(folder, tmp_path):
    irb = load_robot("ur10")
    (tmp_path / "arm").mkdir()
    (tmp_path / "arm" / "robot.toml").write_text((irb.folder / "robot.toml").read_text())
    rewrite(folder / "dataset.toml", lambda head: set_odd(head, "robot", "../arm"))
    save_dataset(load_dataset(folder), tmp_path / "deep" / "er" / "copy")
    assert load_dataset(tmp_path / "deep" / "er" / "copy").robot.folder == tmp_path / "arm"


@pytest.mark.parametrize("text", ["period = " + "9" * 6000, "x = " + "[" * 5000, "period = 1_", "a.b = 1\na = 2"])
def test_toml_that_breaks_its_parser_is_one_line(folder, tmp_path, text):
    (folder / "dataset.toml").write_text(text + "\n" + (folder / "dataset.toml").read_text())
    assert "dataset.toml" in outcome(load_dataset, folder)
    (tmp_path / "robot.toml").write_text(text)
    assert "robot.toml" in outcome(load_robot, tmp_path)


def test_notes_beside_a_dataset_are_not_lost(folder):
    data = load_dataset(folder)
    (folder / "notes.txt").write_text("cold morning")
    assert "notes.txt" in outcome(save_dataset, data, folder)
    assert (folder / "notes.txt").read_text() == "cold morning"
    (folder / "notes.txt").unlink()
    assert outcome(save_dataset, data, folder) is None


def bare_motion(robot, q, tau):
    t = np.arange(len(q)) / 250.0
    segment = Segment(name="m", kind="trajectory", role="identification", t=t, tau=tau, q=q)
    return Dataset("poor", robot, 250.0, robot.joint_names, "none", None, None, None, (segment,))


@pytest.mark.parametrize("name", ["twomass", "ur10"])
@pytest.mark.parametrize("kind", ["short", "zeros", "still", "noise"])
def test_a_log_that_can_decide_nothing_is_one_line(name, kind):
    from ident.diagnosis import diagnose

    robot, rng = load_robot(name), np.random.default_rng(0)
    N = 60 if kind == "short" else 1500
    wave = np.sin(np.arange(N) / 80.0)[:, None] * np.ones(robot.n)
    noise = rng.normal(size=(2, N, robot.n))
    q, tau = {
        "short": (wave, 5 * wave),
        "zeros": (0 * wave, 0 * wave),
        "still": (1e-6 * noise[0], noise[1]),
        "noise": (noise[0], noise[1]),
    }[kind]
    assert outcome(diagnose, bare_motion(robot, q, tau)) is not None


def test_positions_in_a_unit_that_cannot_be_are_one_line(ur10):
    from ident.diagnosis import diagnose

    wave = np.sin(np.arange(1500) / 80.0)[:, None] * np.ones(6)
    assert "positions" in outcome(diagnose, bare_motion(ur10, 1e6 * wave, wave))


@pytest.mark.slow
def test_a_log_of_mislabelled_torques_names_no_cause(tmp_path):
    """Its torques are those of another sign: what is left then fits many an effect well."""
    from dataclasses import replace

    from ident.diagnosis import diagnose
    from sim import run_experiment
    from tests.conftest import small_plan

    data = run_experiment(small_plan(load_robot("twomass"), 3, points=1, levels=(1.0,)), seed=3)
    wrong = replace(data, segments=tuple(replace(s, tau=-s.tau) for s in data.segments))
    verdict = diagnose(wrong, max_causes=1, max_seconds=5)
    assert all(c.probability < 0.5 for c in verdict.causes)
    assert not verdict.causes and "labels" in verdict.next_experiment
    assert "mislabelled" in verdict.sentence and "wrong sign" in verdict.notes[-1]
    assert verdict.unexplained_verdict == "unknown cause remains"
    assert "mislabelled" not in diagnose(data, max_causes=1, max_seconds=5).sentence
