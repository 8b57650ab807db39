"""Dataset files: round trip, and one clear error for everything that breaks the format."""

import shutil
from dataclasses import replace

import numpy as np
import pyarrow as pa
import pyarrow.compute
import pyarrow.parquet as pq
import pytest

import ident
from ident.dataset import Dataset, Segment
from ident.dataset_io import load_dataset, save_dataset
from ident.format_checks import checked
from ident.merging import merged
from robot_assets.errors import DataError
from robot_assets.robot import load_robot


@pytest.fixture
def folder(tmp_path, ur10):
    rng = np.random.default_rng(0)
    N, n = 200, 6
    common = dict(t=3.0 + np.arange(N) / 1000.0, role="identification")
    multisine = Segment(
        name="a",
        kind="multisine",
        tau=rng.normal(size=(N, n)),
        q=rng.normal(size=(N, n)),
        r=rng.normal(size=(N, n)),
        operating_point="op01",
        q0=np.zeros(n),
        period=100,
        periods=2,
        transient_periods=1,
        experiment=1,
        realization=1,
        amplitude=0.5,
        excited_lines=np.array([3, 5]),
        **common,
    )
    motion = Segment(name="b", kind="trajectory", tau=rng.normal(size=(N, n)), q=rng.normal(size=(N, n)), **common)
    data = Dataset(
        "small",
        ur10,
        1000.0,
        ur10.joint_names,
        "zoh",
        np.full(n, 1e-6),
        np.full(n, 0.1),
        None,
        (multisine, motion),
    )
    save_dataset(data, tmp_path / "d")
    return tmp_path / "d", data


def test_round_trip(folder):
    path, data = folder
    again = load_dataset(path)
    for a, b in zip(data.segments, again.segments, strict=True):
        for field in ("t", "tau", "q", "r", "q0", "excited_lines"):
            x, y = getattr(a, field), getattr(b, field)
            assert (x is None) == (y is None) and (x is None or np.array_equal(x, y))
        assert (a.kind, a.role, a.period, a.periods, a.amplitude) == (b.kind, b.role, b.period, b.periods, b.amplitude)
    assert np.array_equal(again.q_std, data.q_std)


def test_csv_is_read(folder):
    path, data = folder
    table = pq.read_table(path / "b.parquet")
    pa.csv.write_csv(table, path / "b.csv")
    (path / "dataset.toml").write_text((path / "dataset.toml").read_text().replace("b.parquet", "b.csv"))
    assert np.allclose(load_dataset(path).segments[1].tau, data.segments[1].tau)


def _columns(path, change):
    table = pq.read_table(path / "a.parquet")
    data = {name: table.column(name).to_numpy().copy() for name in table.column_names}
    change(data)
    pq.write_table(pa.table(data), path / "a.parquet")


def _drop(data):
    del data["tau_4"]


def _nan(data):
    data["q_2"][[17, 40]] = np.nan


def _infinity(data):
    data["tau_1"][5] = np.inf


def _jitter(data):
    data["t"][50:] += 0.0004


def _rate(data):
    data["t"] *= 2.0


def _short(data):
    for k in data:
        data[k] = data[k][:150]


def _text(data):
    data["q_1"] = np.array(["x"] * len(data["t"]))


def _huge(data):
    data["tau_3"][0] = 1e300


@pytest.mark.parametrize(
    ("change", "what", "found"),
    [
        (_drop, "tau_4", "no such column"),
        (_nan, "q_2", "NaN at sample 17 (2"),
        (_infinity, "tau_1", "infinity at sample 5"),
        (_jitter, "column t", "sample 49"),
        (_rate, "column t", "500 Hz"),
        (_short, "samples", "150"),
        (_text, "q_1", "string"),
        (_huge, "tau_3", "1e+300"),
    ],
)
def test_a_broken_file_is_one_clear_error(folder, change, what, found):
    path, _ = folder
    _columns(path, change)
    with pytest.raises(DataError) as caught:
        load_dataset(path)
    text = str(caught.value)
    assert what in text and found in text and "a.parquet" in text and "\n" not in text


@pytest.mark.parametrize(
    ("old", "new", "found"),
    [
        ("simgap-dataset/1", "simgap-dataset/9", "simgap-dataset/9"),
        ("excited_lines = [3, 5]", "excited_lines = [3, 50]", "line 50"),
        ("wrist_3_joint", "wrist_9_joint", "wrist_9_joint"),
        ('file = "b.parquet"', 'file = "a.parquet"', "second time"),
        ('file = "b.parquet"', 'file = "../b.parquet"', "../b.parquet"),
        ('file = "b.parquet"', 'file = "/etc/passwd"', "/etc/passwd"),
        ('file = "b.parquet"', 'file = "c.parquet"', "no c.parquet"),
        ("sample_rate = 1000.0", "sample_rate = -1.0", "-1.0"),
        ("sample_rate = 1000.0", 'sample_rate = "fast"', "fast"),
        ("period = 100", "period = 90", "200"),
        ("transient_periods = 1", "transient_periods = 2", "2"),
        ('kind = "trajectory"', 'kind = "dance"', "dance"),
        ('robot = "ur10"', 'robot = "ur99"', "no robot.toml"),
        ('input_hold = "zoh"', 'input_hold = "foh"', "foh"),
        ("[[segment]]", "[[segment", "invalid TOML"),
    ],
)
def test_a_broken_header_is_one_clear_error(folder, old, new, found):
    path, _ = folder
    text = (path / "dataset.toml").read_text()
    assert old in text
    (path / "dataset.toml").write_text(text.replace(old, new, 1))
    with pytest.raises(DataError) as caught:
        load_dataset(path)
    assert found in str(caught.value) and "\n" not in str(caught.value)


@pytest.mark.parametrize("keep", [0, 3, 100, 2000])
def test_a_truncated_parquet_file_is_one_clear_error(folder, keep):
    path, _ = folder
    file = path / "a.parquet"
    file.write_bytes(file.read_bytes()[:keep])
    with pytest.raises(DataError, match=r"a\.parquet"):
        load_dataset(path)


def test_a_duplicate_column_is_refused(folder):
    path, _ = folder
    table = pq.read_table(path / "a.parquet")
    pa.csv.write_csv(table, path / "a.csv")
    text = (path / "a.csv").read_text().replace('"q_2"', '"q_1"', 1)
    (path / "a.csv").write_text(text)
    (path / "dataset.toml").write_text((path / "dataset.toml").read_text().replace("a.parquet", "a.csv"))
    with pytest.raises(DataError, match="q_1"):
        load_dataset(path)


def test_saving_leaves_a_foreign_folder_alone(folder, tmp_path):
    _, data = folder
    other = tmp_path / "other"
    other.mkdir()
    (other / "thesis.txt").write_text("years of work")
    with pytest.raises(DataError):
        save_dataset(data, other)
    assert (other / "thesis.txt").read_text() == "years of work"


def test_a_failing_save_harms_no_earlier_dataset(folder):
    path, data = folder
    broken = replace(data, controller={"gain": object()})  # known when it is written
    with pytest.raises(ValueError):
        save_dataset(broken, path)
    assert len(load_dataset(path).segments) == 2
    assert not [p for p in path.parent.iterdir() if p.name.startswith(".")]


def test_files_of_one_name_are_segments_of_their_own(folder):
    path, data = folder
    (path / "b").mkdir()
    shutil.copy(path / "b.parquet", path / "b" / "c.parquet")
    shutil.copy(path / "b.parquet", path / "b-c.parquet")
    table = pq.read_table(path / "b.parquet")
    pa.csv.write_csv(table.set_column(1, "tau_1", pa.compute.add(table["tau_1"], 1.0)), path / "b.csv")
    more = "".join(
        f'[[segment]]\nfile = "{file}"\nkind = "trajectory"\n' for file in ("b.csv", "b/c.parquet", "b-c.parquet")
    )
    (path / "dataset.toml").write_text((path / "dataset.toml").read_text() + more)
    again = load_dataset(path)
    assert [s.name for s in again.segments] == ["a", "b", "b-csv", "b-c", "b-c-parquet"]
    assert all(np.allclose(s.q, data.segments[1].q) for s in again.segments[1:])


def test_a_robot_of_the_users_own_is_found_from_the_dataset_wherever_both_are(folder, ur10, tmp_path):
    _, data = folder
    shutil.copytree(ur10.folder, tmp_path / "lab" / "arms" / "mine")
    mine = replace(data, robot=load_robot(tmp_path / "lab" / "arms" / "mine"))
    save_dataset(mine, tmp_path / "lab" / "run" / "d")
    assert 'robot = "../../arms/mine"' in (tmp_path / "lab" / "run" / "d" / "dataset.toml").read_text()
    shutil.move(tmp_path / "lab", tmp_path / "elsewhere")
    there = tmp_path / "elsewhere"
    assert load_dataset(there / "run" / "d").robot.folder == (there / "arms" / "mine").resolve()


def varied(data, i=0, **changes):
    """A dataset of which one segment is another."""
    segments = list(data.segments)
    segments[i] = replace(segments[i], **changes)
    return replace(data, segments=tuple(segments))


def with_nan(x):
    x = x.copy()
    x[50, 1] = np.nan
    return x


BREACHES = {
    "nan": (lambda d, s: varied(d, tau=with_nan(s.tau)), "tau of joint 2: .* segment a: found NaN at sample 50"),
    "infinite": (lambda d, s: varied(d, q=np.full_like(s.q, np.inf)), "q of joint 1: .*infinity at sample 0"),
    "huge": (lambda d, s: varied(d, q=1e13 * s.q), "q of joint 1: .*at most 1e"),
    "transposed": (lambda d, s: varied(d, tau=s.tau.T), r"tau: .*shape \(6, 200\), expected \(200, 6\)"),
    "one-dimensional": (lambda d, s: varied(d, q=s.q[:, 0]), r"q: .*shape \(200,\)"),
    "short": (lambda d, s: varied(d, r=s.r[:-10]), r"r: .*shape \(190, 6\), expected \(200, 6\)"),
    "a joint less": (lambda d, s: varied(d, q=s.q[:, 1:]), r"q: .*shape \(200, 5\)"),
    "list": (lambda d, s: varied(d, tau=s.tau.tolist()), "tau: .*found a list, expected an array of numbers"),
    "objects": (lambda d, s: varied(d, tau=s.tau.astype(object)), "tau: .*an array of object, expected real"),
    "complex": (lambda d, s: varied(d, tau=s.tau + 0j), "tau: .*complex128"),
    "masked": (lambda d, s: varied(d, tau=np.ma.masked_array(s.tau)), "tau: .*MaskedArray"),
    "none": (lambda d, s: varied(d, q=None), "q: .*NoneType"),
    "kind": (lambda d, s: varied(d, kind="multi"), 'kind: .*\'multi\', expected "multisine" or "trajectory"'),
    "role": (lambda d, s: varied(d, role="train"), "role: .*'train'"),
    "no period": (lambda d, s: varied(d, period=None), "period: .*no such key"),
    "other period": (lambda d, s: varied(d, period=99), r"samples: .*200, expected period \* periods = 99 \* 2"),
    "no steady one": (lambda d, s: varied(d, transient_periods=2), "transient_periods: .*less than periods = 2"),
    "lines": (lambda d, s: varied(d, excited_lines=np.array([3, 50])), "excited_lines: .*line 50, .*below Nyquist, 50"),
    "lines no numbers": (lambda d, s: varied(d, excited_lines=["3"]), "excited_lines: .*an array"),
    "broken lines": (lambda d, s: varied(d, excited_lines=np.array([3.5])), "excited_lines: .*an array"),
    "amplitude": (lambda d, s: varied(d, amplitude=np.nan), "amplitude: .*nan"),
    "posture": (lambda d, s: varied(d, q0=np.zeros(5)), r"q0: .*shape \(5,\), expected \(6,\)"),
    "name": (lambda d, s: varied(d, name="b"), "name: .*segment b: found it a second time"),
    "rate": (lambda d, s: replace(d, sample_rate=0.0), "sample_rate: dataset d: found 0.0"),
    "other rate": (lambda d, s: replace(d, sample_rate=500.0), "t: .*a rate of 1000 Hz"),
    "hold": (lambda d, s: replace(d, input_hold="foh"), "input_hold: .*'foh'"),
    "noise": (lambda d, s: replace(d, q_std=-d.q_std), "q_std: .*at least zero"),
    "joints": (lambda d, s: replace(d, joints=d.joints[::-1]), "joints: .*expected those of the robot"),
    "nothing": (lambda d, s: replace(d, segments=()), "segment.*: found 0 entries"),
    "no dataset": (lambda d, s: "d", "dataset: argument: found a str"),
}


@pytest.mark.parametrize("breach", BREACHES)
def test_a_dataset_made_in_memory_that_breaks_the_format_is_one_clear_error(folder, tmp_path, breach):
    made, message = BREACHES[breach]
    data = replace(folder[1], name="d")
    with pytest.raises(DataError, match=message):
        save_dataset(made(data, data.segments[0]), tmp_path / "new")
    assert not (tmp_path / "new").exists()


@pytest.mark.parametrize("entrance", ["estimate_frf", "identify", "diagnose", "diagnose_fully"])
def test_every_entrance_refuses_what_breaks_the_format(folder, entrance):
    data = folder[1]
    with pytest.raises(DataError, match=r"tau of joint 2: .*NaN at sample 50"):
        getattr(ident, entrance)(varied(data, tau=with_nan(data.segments[0].tau)))


@pytest.mark.parametrize(
    "limit", [{"max_causes": -1}, {"max_causes": 1.5}, {"max_seconds": np.nan}, {"max_seconds": -1}]
)
def test_limits_of_a_search_are_refused_as_the_command_line_does(folder, limit):
    with pytest.raises(DataError, match=f"{next(iter(limit))}: diagnose: found"):
        ident.diagnose(folder[1], **limit)


def test_arrays_of_other_numbers_and_orders_are_a_dataset_as_good(folder, tmp_path):
    data = folder[1]
    assert checked(data) is data
    s = data.segments[0]
    q = np.asfortranarray(s.q)
    q.flags.writeable = False
    link = s.q.copy()
    link[:, 2] = np.nan  # a joint without a link encoder
    other = varied(
        data,
        tau=np.round(s.tau).astype(int),
        q=q,
        r=s.r.astype(np.float32),
        q_link=link,
        period=np.int64(s.period),
        amplitude=np.float32(0.5),
        excited_lines=list(np.array([5, 3, 3], np.int32)),
    )
    found = checked(replace(other, sample_rate=np.int64(1000))).segments[0]
    assert found.q is q and found.q_link is link
    assert found.tau.dtype == found.r.dtype == float and found.excited_lines.tolist() == [3, 5]
    save_dataset(other, tmp_path / "other")
    assert np.array_equal(load_dataset(tmp_path / "other").segments[0].tau, np.round(s.tau))


def test_a_dataset_of_other_numbers_has_the_same_frf(clean):
    def single(s):
        return replace(s, tau=s.tau.astype(np.float32), q=np.asfortranarray(s.q), excited_lines=s.excited_lines[::-1])

    data = clean[0]
    single_ones = replace(data, segments=tuple(map(single, data.segments)))
    np.testing.assert_allclose(ident.estimate_frf(single_ones).G, ident.estimate_frf(data).G, rtol=1e-4)


def test_two_datasets_become_one_in_which_every_experiment_keeps_its_own_name(folder, tmp_path):
    data = folder[1]
    a, b = data.segments
    more = replace(data, name="more", segments=(replace(a, q=a.q + 1.0), replace(b, name="c", q=b.q + 1.0)))
    both = merged([data, more, replace(more, segments=(replace(a, q=a.q + 2.0),))], "both")
    assert [s.name for s in both.segments] == ["a", "b", "a-2", "c", "a-3"]
    assert [s.operating_point for s in both.segments] == ["op01", None, "op01-2", None, "op01-3"]
    save_dataset(both, tmp_path / "both")
    again = load_dataset(tmp_path / "both")
    assert again.name == "both" and np.array_equal(again.segments[2].q, a.q + 1.0)


def test_a_name_with_a_number_that_is_there_already_is_left_alone(folder):
    data = folder[1]
    a = data.segments[0]
    named = tuple(
        replace(a, name=n, operating_point=p, q=a.q + k)
        for k, (n, p) in enumerate([("a-2", "op01-2"), ("a", "op01")], 1)
    )
    both = merged([replace(data, segments=(a,)), replace(data, segments=named)], "both")
    assert [s.name for s in both.segments] == ["a", "a-2", "a-3"]
    assert [s.operating_point for s in both.segments] == ["op01", "op01-2", "op01-3"]


@pytest.mark.parametrize(
    ("other", "message"),
    [
        (lambda d: replace(d, sample_rate=500.0), "sample_rate: .*found 500.0, expected 1000.0, as in small"),
        (lambda d: replace(d, tau_std=None), "tau_std: .*found none"),
        (lambda d: replace(d, robot=load_robot("twomass")), "robot: .*twomass, expected that of small"),
        (lambda d: d, "segment: .*a with the samples of a"),
    ],
)
def test_datasets_that_do_not_belong_together_are_refused(folder, other, message):
    with pytest.raises(DataError, match=message):
        merged([folder[1], replace(other(folder[1]), name="second")], "both")
    with pytest.raises(DataError, match="found 1, expected at least two"):
        merged([folder[1]], "both")
