"""Logs as programs write them: dates, rows of units, comments, brackets, quotes, structures, wrapped angles."""

import time
import tomllib
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import scipy.io

from ident.convert import convert_logs
from ident.convert.guess import guess_map
from ident.convert.layout import _words
from ident.convert.reading import list_signals, read_log, survey_log
from ident.convert.spelling import split_unit, unit_of
from robot_assets.errors import DataError
from robot_assets.robot import load_robot
from tests.test_cli import simgap as run

RATE = 500.0
N = 1000
T = np.arange(N) / RATE
W = 2 * np.pi * np.array([0.7, 1.1, 0.5, 0.9, 1.3, 1.7])
Q = 0.4 * np.sin(W * T[:, None])
TAU = 20 * np.cos(W * T[:, None]) - 30 * Q
BENCH = '[columns]\ntau_1 = "u"\nq_1 = "x"\n'


def written(path: Path, columns: dict, delimiter: str = ",", above: str = "", below: str = "") -> Path:
    rows = "\n".join(
        delimiter.join(x if isinstance(x, str) else f"{x:.15g}" for x in row)
        for row in zip(*columns.values(), strict=True)
    )
    path.write_text(f"{above}{delimiter.join(columns)}\n{below}{rows}\n", encoding="utf-8")
    return path


def converted(log, robot="ur10_bare"):
    """Guessed map, and the dataset that it gives."""
    paths = log if isinstance(log, list) else [log]
    guessed = guess_map(paths, robot)
    given = paths[0].parent / "guessed.toml"
    given.write_text(guessed.text, encoding="utf-8")
    return guessed, convert_logs(paths, robot, given)


def whole(data, channel):
    return np.concatenate([getattr(s, channel) for s in data.segments])


def texts_of_dates(step=1 / RATE, zone=""):
    """As ``datetime.isoformat`` writes them: no fraction on a full second."""
    ns = np.datetime64("2026-03-01T10:00:00", "ns") + np.round(T / (T[1]) * step * 1e9).astype("timedelta64[ns]")
    return [(str(x).rstrip("0").rstrip(".") if "." in str(x) else str(x)) + zone for x in ns]


@pytest.mark.parametrize("kind", ["csv", "csv with zones", "time of day", "timestamps", "texts", "npz", "npz texts"])
def test_dates_need_no_unit_in_the_map(tmp_path, kind):
    texts, signals = texts_of_dates(zone="Z" if "zones" in kind else ""), {"u": TAU[:, 0], "x": Q[:, 0]}
    stamps = np.array([t.rstrip("Z") for t in texts], "datetime64[ns]")
    if kind.startswith("csv"):
        log = written(tmp_path / "log.csv", {"when": texts} | signals)
    elif kind == "time of day":
        log = written(tmp_path / "log.csv", {"when": [t.split("T")[1] for t in texts]} | signals)
    elif kind.startswith("npz"):
        log = tmp_path / "log.npz"
        np.savez(log, when=np.array(texts) if "texts" in kind else stamps, **signals)
    else:
        log = tmp_path / "log.parquet"
        pq.write_table(
            pa.table({"when": pa.array(texts) if kind == "texts" else pa.array(stamps, pa.timestamp("us"))} | signals),
            log,
        )
    for unit in ("", 'unit = "ms"\n'):  # one that does not fit dates is not asked
        (tmp_path / "map.toml").write_text(f'sample_rate = {RATE}\n[time]\nsource = "when"\n{unit}{BENCH}')
        (s,) = convert_logs([log], "twomass", tmp_path / "map.toml").segments
        assert (
            np.allclose(s.t, T, atol=1e-9)
            and np.allclose(s.q[:, 0], Q[:, 0], atol=1e-12)
            and np.allclose(s.tau[:, 0], TAU[:, 0])
        )
    (tmp_path / "map.toml").write_text(f"sample_rate = {RATE}\n{BENCH.replace('x', 'when')}")
    with pytest.raises(DataError, match="when is no array of numbers"):
        convert_logs([log], "twomass", tmp_path / "map.toml")


def test_a_date_column_is_guessed_to_be_the_time(tmp_path):
    signals = {f"{k}_{j + 1}": x[:, j] for k, x in {"pos": Q, "torque": TAU}.items() for j in range(6)}
    guessed, data = converted(written(tmp_path / "log.csv", {"Datum": texts_of_dates()} | signals))
    assert guessed.found["time"] == "Datum, 500 Hz" and "unit" not in tomllib.loads(guessed.text)["time"]
    assert np.allclose(whole(data, "q"), Q) and data.segments[0].t[1] == pytest.approx(1 / RATE)


def test_a_date_that_is_missing_is_one_clear_error(tmp_path):
    texts = texts_of_dates()
    texts[7] = ""
    log = written(tmp_path / "log.csv", {"when": texts, "u": TAU[:, 0], "x": Q[:, 0]})
    (tmp_path / "map.toml").write_text(f'sample_rate = {RATE}\n[time]\nsource = "when"\n{BENCH}')
    with pytest.raises(DataError, match="not finite"):
        convert_logs([log], "twomass", tmp_path / "map.toml")


ABOVE = {"nothing": "", "comments": "# robot 7\n# rate: 500, Hz\n\n", "a spreadsheet": "sep=;\n", "a hash": "# "}


@pytest.mark.parametrize("above", ABOVE)
@pytest.mark.parametrize(
    ("suffix", "delimiter"), [(".csv", ";"), (".csv", ","), (".txt", "\t"), (".txt", " "), (".dat", ";")]
)
def test_comments_above_the_names_and_units_below_are_read(tmp_path, above, suffix, delimiter):
    if above == "a spreadsheet" and delimiter != ";":
        pytest.skip("the first line names another delimiter")
    units = ["ms", *["°"] * 6, *["mNm"] * 6]
    names = ["clock", *(f"a{j}" for j in range(6)), *(f"b{j}" for j in range(6))]
    signals = dict(zip(names, [1e3 * T, *np.rad2deg(Q).T, *(1e3 * TAU).T], strict=True))
    sign = "#" if above == "a hash" else ""
    for below in (delimiter.join(units), delimiter.join(f"[{u}]" for u in units)):
        log = written(tmp_path / f"log{suffix}", signals, delimiter, ABOVE[above], f"{sign}{below}\n")
        found = list_signals(log)
        assert list(found) == names and np.allclose(found["b3"], 1e3 * TAU[:, 3], rtol=1e-12)
        guessed, data = converted(log)
        columns = tomllib.loads(guessed.text)["columns"]
        assert (
            columns["q_2"]["unit"] == "deg"
            and columns["tau_6"]["unit"] == "mN m"
            and tomllib.loads(guessed.text)["time"]["unit"] == "ms"
        )
        assert np.allclose(whole(data, "q"), Q) and np.allclose(whole(data, "tau"), TAU)


def test_a_row_of_numbers_is_no_row_of_units(tmp_path):
    rows = "u,x,mode\n" + "1,2,A\n" * 30
    (tmp_path / "log.csv").write_text(rows)
    assert len(list_signals(tmp_path / "log.csv")["u"]) == 30
    (tmp_path / "bare.csv").write_text("# 30 rows\n" + "1.5;2,5\n".replace(".", ",") * 30)
    assert np.array_equal(list_signals(tmp_path / "bare.csv")["values"], [[1.5, 2.5]] * 30)


def test_fractions_after_a_megabyte_of_whole_numbers(tmp_path):
    rows = 300_000
    x = np.ones(rows)
    x[-1] = 0.25
    (tmp_path / "log.csv").write_text("u,x\n" + "\n".join(f"1,{v:g}" for v in x) + "\n")
    assert np.array_equal(list_signals(tmp_path / "log.csv")["x"], x)


@pytest.mark.parametrize(
    ("name", "stem", "unit"),
    [
        ("q1 [°]", "q1", "deg"), ("tau_1 (Nm)", "tau_1", "N m"), ("pos[deg]", "pos", "deg"), ("M_1 [N·m]", "M_1", "N m"),
        ("Winkel / °", "Winkel", "deg"), ("M [mNm]", "M", "mN m"), ("M [MNm]", "M [MNm]", None), ("v [°/s]", "v", "deg/s"),
        ("q(1)", "q(1)", None), ("pos[0]", "pos[0]", None), ("a [rad/s^2]", "a [rad/s^2]", None), ("n (1/min)", "n", "rpm"),
    ],
)  # fmt: skip
def test_units_at_the_end_of_a_name(name, stem, unit):
    assert split_unit(name) == (stem, unit)
    assert unit is None or unit_of(unit) == unit


@pytest.mark.parametrize(
    ("position", "torque"),
    [
        ("q{} [°]", "tau_{} (mNm)"), ('"pos {} [deg]"', '"Moment {}, Achse [mNm]"'), ("A{} / °", "B{} / mNm"),
        ("{name}_angle_deg", "{name}.torque[mN*m]"),
    ],
)  # fmt: skip
def test_a_map_is_guessed_from_units_in_brackets_and_names_in_quotes(tmp_path, position, torque):
    names = ["shoulder_pan", "shoulder_lift", "elbow", "wrist_1", "wrist_2", "wrist_3"]
    signals = {"t [ms]": 1e3 * T} | {position.format(j + 1, name=k): np.rad2deg(Q[:, j]) for j, k in enumerate(names)}
    signals |= {torque.format(j + 1, name=k): 1e3 * TAU[:, j] for j, k in enumerate(names)}
    _, data = converted(written(tmp_path / "log.csv", signals))
    assert data.sample_rate == RATE and np.allclose(whole(data, "q"), Q) and np.allclose(whole(data, "tau"), TAU)


def test_columns_of_other_stems_are_taken_in_their_order_and_said_to_be(tmp_path):
    names = ["base", "arm", "forearm", "roll", "pitch", "yaw"]
    signals = (
        {"t": T}
        | {f"{k}_angle": Q[:, j] for j, k in enumerate(names)}
        | {f"{k}_torque": TAU[:, j] for j, k in enumerate(names)}
    )
    guessed, data = converted(written(tmp_path / "log.csv", signals))
    assert np.allclose(whole(data, "q"), Q) and np.allclose(whole(data, "tau"), TAU)
    assert guessed.text.count("EDIT? joints in the order of the columns") == 2


@pytest.mark.parametrize(("unit", "turn"), [("rad", 2 * np.pi), ("deg", 360.0)])
@pytest.mark.parametrize("side", ["link", "motor"])
def test_wrapped_angles_are_guessed_to_be(tmp_path, unit, turn, side):
    arm = load_robot("ur10_bare")
    # A motor must not turn by half a turn from one sample to the next.
    slow = 0.25 if side == "motor" else 1.0
    q = slow * Q + (0.0 if side == "motor" else np.pi)
    ratio = arm.array("gear_ratio") if side == "motor" else np.ones(6)
    angle = q * ratio / (2 * np.pi) * turn
    wrapped = np.mod(angle + turn / 2, turn) - turn / 2
    assert np.any(np.abs(np.diff(wrapped, axis=0)) > 0.9 * turn)
    torque = TAU / ratio
    signals = {"t": T} | {f"{k}_{j + 1}": x[:, j] for k, x in {"q": wrapped, "tau": torque}.items() for j in range(6)}
    guessed, data = converted(written(tmp_path / "log.csv", signals))
    column = tomllib.loads(guessed.text)["columns"]["q_3"]
    assert column["unwrap"] is True and column["unit"] == unit and column.get("side", "link") == side, guessed.text
    # Halves of the log are unwrapped together: one offset each joint.
    found = whole(data, "q")
    assert np.allclose(found - found[0], q - q[0], atol=1e-9)


def test_angles_that_do_not_wrap_are_not_unwrapped(tmp_path):
    for k, q in {"smooth": 4 * Q, "one jump": Q + 2 * np.pi * (T > 0.5)[:, None] * (np.arange(6) == 2)}.items():
        signals = {"t": T} | {f"{c}_{j + 1}": x[:, j] for c, x in {"q": q, "tau": TAU}.items() for j in range(6)}
        assert "unwrap" not in guess_map([written(tmp_path / f"{k}.csv", signals)], "ur10_bare").text


@pytest.mark.parametrize("kind", ["structures of joints", "structures of samples", "cells"])
def test_arrays_of_structures_and_cells_of_matlab(tmp_path, kind):
    if kind == "cells":
        cells = {k: np.empty(6, object) for k in ("q", "tau")}
        for j in range(6):
            cells["q"][j], cells["tau"][j] = Q[:, j], TAU[:, j]
        content = cells
    else:
        rows = [(Q[:, j], TAU[:, j]) for j in range(6)] if "joints" in kind else list(zip(Q, TAU, strict=True))
        joints = np.empty(len(rows), [("q", object), ("tau", object)])
        for k, row in enumerate(rows):
            joints[k] = row
        content = {"log": joints}
    scipy.io.savemat(tmp_path / "log.mat", content | {"fs": RATE})
    found = list_signals(tmp_path / "log.mat")
    name = {"cells": "q{3}", "structures of joints": "log(3).q", "structures of samples": "log.q"}[kind]
    assert np.allclose(found[name], Q if "samples" in kind else Q[:, 2])
    _, data = converted(tmp_path / "log.mat")
    assert np.allclose(whole(data, "q"), Q) and np.allclose(whole(data, "tau"), TAU)
    (tmp_path / "map.toml").write_text(
        f"sample_rate = {RATE}\n{BENCH.replace('x', name.split('(')[0].split('{')[0].split('.')[0])}"
    )
    with pytest.raises(DataError) as caught:
        convert_logs([tmp_path / "log.mat"], "twomass", tmp_path / "map.toml")
    assert name in str(caught.value).replace("(1)", "(3)").replace("{1}", "{3}")


@pytest.mark.parametrize("damaged", [False, True])
def test_files_of_a_joint_each_with_clocks_of_their_own(tmp_path, damaged):
    files = []
    for j in range(6):
        t = 1e3 * T
        if damaged and j == 4:
            t[[500, 501]] = t[[501, 500]]
        files.append(
            written(
                tmp_path / f"joint{j + 1}.csv", {"time_ms": t, "pos_deg": np.rad2deg(Q[:, j]), "torque_Nm": TAU[:, j]}
            )
        )
    guessed, data = converted(files)
    assert np.allclose(whole(data, "q"), Q, atol=1e-9) and np.allclose(whole(data, "tau"), TAU, atol=1e-6)
    assert ("time" in guessed.found) != damaged
    assert guessed.warnings == (
        ("no time: joint5:time_ms goes back in row 502 (from 1002 to 1000)",) if damaged else ()
    )


@pytest.mark.parametrize("kind", ["list", "fixed list", "decimal", "list of decimals"])
def test_lists_and_decimals_of_parquet(tmp_path, kind):
    q, tau = np.round(Q, 6), np.round(TAU, 6)
    number = pa.decimal128(18, 6)
    if kind == "decimal":
        columns = {
            f"{k}_{j + 1}": pa.array(x[:, j]).cast(number)
            for k, x in {"pos": q, "torque": tau}.items()
            for j in range(6)
        }
    else:
        of = {
            "list": pa.list_(pa.float64()),
            "fixed list": pa.list_(pa.float64(), 6),
            "list of decimals": pa.list_(number),
        }[kind]
        columns = {k: pa.array(list(x)).cast(of) for k, x in {"position": q, "effort": tau}.items()}
    pq.write_table(
        pa.table(
            {"timestamp": T, "name": [["a", "b"]] * N, "empty": pa.array([[]] * N, pa.list_(pa.float64()))} | columns
        ),
        tmp_path / "log.parquet",
    )
    _, data = converted(tmp_path / "log.parquet")
    assert np.allclose(whole(data, "q"), q, atol=1e-12) and np.allclose(whole(data, "tau"), tau, atol=1e-12)


def test_lists_of_several_lengths_are_no_signal(tmp_path):
    lists = [list(x) for x in Q]
    lists[700] = lists[700][:5]
    pq.write_table(pa.table({"x": pa.array(lists), "u": TAU[:, 0]}), tmp_path / "log.parquet")
    assert list(list_signals(tmp_path / "log.parquet")) == ["u"]
    (tmp_path / "map.toml").write_text(f"sample_rate = {RATE}\n{BENCH}")
    with pytest.raises(DataError, match="x is no array of numbers but of lists of several lengths"):
        convert_logs([tmp_path / "log.parquet"], "twomass", tmp_path / "map.toml")


def test_a_log_in_which_nothing_is_recognised_is_an_error_and_leaves_no_map(tmp_path):
    log = written(tmp_path / "log.csv", {"t": T} | {f"thing {k}": TAU[:, k] for k in range(4)})
    result = run("convert", log, "--robot", "ur10_bare", "--guess", "--map", tmp_path / "map.toml")
    (line,) = result.stderr.strip().splitlines()
    assert result.returncode == 2 and "nothing that looks like" in line and "thing 2" in line
    assert not (tmp_path / "map.toml").exists() and not result.stdout


@pytest.mark.parametrize("state", ["OK", "run / hold", "", "m"])
@pytest.mark.parametrize("below", ["ms;°;mNm;", "[ms];[°];[mNm];-", "ms;°;mNm;text", ";°;mNm;"])
def test_units_are_read_below_a_header_where_a_column_holds_texts(tmp_path, state, below):
    log = written(
        tmp_path / "log.csv", {"t": T, "a": Q[:, 0], "b": TAU[:, 0], "Status": [state] * N}, ";", "", f"{below}\n"
    )
    survey = survey_log(log)
    assert np.allclose(survey.signals["a"], Q[:, 0]) and len(survey.signals["a"]) == N
    assert survey.units["a"] == below.split(";")[1] and survey.units["b"] == below.split(";")[2]


def test_a_first_row_of_a_text_alone_is_no_row_of_units(tmp_path):
    log = written(tmp_path / "log.csv", {"t": T, "a": Q[:, 0], "mode": ["A"] * N}, below=",,A\n")
    survey = survey_log(log)
    assert not survey.units and len(survey.signals["a"]) == N + 1


def scope(path, times, end=""):
    """As TwinCAT's Scope writes tables: a time before each channel, and a key before each word above them."""
    channels = {
        f"GVL.Axis{j + 1}.{k}": x[:, j]
        for k, x in {"ActPos": np.rad2deg(Q), "ActTorque": TAU}.items()
        for j in range(6)
    }
    units = ["deg"] * 6 + ["Nm"] * 6
    above = ["Name\tScope Project", "File\tC:\\run.svdx", "Starttime of export\t133765432100000000", ""]
    above.append("\t".join(f"Name\t{name}" for name in channels) + end)
    above.append("SymbolComment" + "\t" * 23)
    above.append("\t".join(f"Unit\t{unit}" for unit in units))
    above += ["\t".join(["SampleTime[ms]\t2"] * 12), ""]
    cells = np.stack([x for pair in zip(times, channels.values(), strict=True) for x in pair], axis=1)
    rows = ["\t".join(f"{x:.15g}" for x in row) + end for row in cells]
    path.write_text("\n".join([*above, *rows]) + "\n")
    return path


@pytest.mark.parametrize("end", ["", "\t"])
def test_a_table_with_a_time_before_each_channel_is_read(tmp_path, end):
    guessed, data = converted(scope(tmp_path / "scope.csv", [1e3 * T] * 12, end))
    assert guessed.found["time"] == "Time, 500 Hz" and tomllib.loads(guessed.text)["time"]["unit"] == "ms"
    assert tomllib.loads(guessed.text)["columns"]["tau_2"] == {"source": "GVL.Axis2.ActTorque", "unit": "N m"}
    assert np.allclose(whole(data, "q"), Q) and np.allclose(whole(data, "tau"), TAU)


def test_times_of_channels_that_differ_are_refused(tmp_path):
    log = scope(tmp_path / "scope.csv", [1e3 * T] * 11 + [1e3 * T + 1])
    assert "EDIT? several columns that differ" in guess_map([log], "ur10_bare").text
    with pytest.raises(DataError, match=r"Time twice, and the columns differ.*one time for all"):
        converted(log)


def test_a_column_that_is_repeated_is_read_once_and_others_of_one_name_are_refused(tmp_path):
    log, given = tmp_path / "log.csv", tmp_path / "map.toml"
    given.write_text(f'sample_rate = {RATE}\n[time]\nsource = "t"\n{BENCH}')
    for second, good in ((T, True), (T + 1e-3, False)):
        rows = "\n".join(
            f"{a:.9g},{b:.9g},{c:.9g},{d:.9g}" for a, b, c, d in zip(T, TAU[:, 0], second, Q[:, 0], strict=True)
        )
        log.write_text(f"t,u,t,x\n{rows}\n")
        if good:
            assert np.allclose(whole(convert_logs([log], "twomass", given), "q")[:, 0], Q[:, 0])
        else:
            with pytest.raises(DataError, match="t twice, and the columns differ"):
                convert_logs([log], "twomass", given)


ROWS_OF = {"names": load_robot("ur10_bare").joint_names, "counted": range(1, 7), "counted from 0": range(6)}


def long(folder, kind, names, by_joint=False):
    """A table with a row for each joint and time."""
    at = np.arange(6 * N)
    j, k = (at // N, at % N) if by_joint else (at % 6, at // 6)
    cells = [str(names[i]) for i in j]
    if kind == "csv":
        return written(folder / "log.csv", {"t": T[k], "joint": cells, "position": Q[k, j], "torque": TAU[k, j]})
    joint = pa.array(cells).dictionary_encode() if kind == "parquet categories" else pa.array(cells)
    joint = joint if isinstance(names, tuple) else joint.cast(pa.int64())
    pq.write_table(
        pa.table({"t": T[k], "joint": joint, "position": Q[k, j], "torque": TAU[k, j]}), folder / "log.parquet"
    )
    return folder / "log.parquet"


@pytest.mark.parametrize("by_joint", [True, False])
@pytest.mark.parametrize(
    ("kind", "rows"),
    [("csv", "names"), ("csv", "counted"), ("csv", "counted from 0"), ("parquet", "names"), ("parquet categories", "names"), ("parquet", "counted")],
)  # fmt: skip
def test_rows_of_one_joint_each_are_refused_with_the_column_that_names_it(tmp_path, kind, rows, by_joint):
    log = long(tmp_path, kind, ROWS_OF[rows], by_joint)
    with pytest.raises(DataError, match=r"rows of one joint each: joint holds .*pivot the table by joint"):
        guess_map([log], "ur10_bare")
    columns = "".join(f'q_{j + 1} = "position"\ntau_{j + 1} = "torque"\n' for j in range(6))
    (tmp_path / "map.toml").write_text(f'sample_rate = {RATE}\n[time]\nsource = "t"\n[columns]\n{columns}')
    with pytest.raises(DataError, match="a stamp that goes back" if by_joint else "pivot a table of one joint a row"):
        convert_logs([log], "ur10_bare", tmp_path / "map.toml")


def test_a_coarse_clock_is_no_table_of_rows_of_one_joint(tmp_path):
    log, given = (
        written(tmp_path / "log.csv", {"t": np.floor(T * 250) / 250, "u": TAU[:, 0], "x": Q[:, 0]}),
        tmp_path / "m.toml",
    )
    given.write_text(f'sample_rate = 250.0\n[time]\nsource = "t"\n{BENCH}')
    (s,) = convert_logs([log], "twomass", given).segments
    assert np.allclose(s.q[:, 0], Q[::2, 0], atol=1e-9)


def test_a_log_without_signals_of_joints_is_told_as_before(tmp_path):
    log = written(tmp_path / "log.csv", {"t": T, "state": ["run"] * N, "position": Q[:, 0]})
    with pytest.raises(DataError, match="nothing that looks like a position or a torque of 6 joints"):
        guess_map([log], "ur10_bare")


@pytest.mark.parametrize("delimiter", [None, "\t", ","])
def test_long_runs_of_blanks_are_split_at_once(delimiter):
    row = f"1{' ' * 200_000}2\n" if delimiter is None else f"1{delimiter}{' ' * 200_000}2\n"
    start = time.perf_counter()
    assert _words(row, delimiter) == ("1", "2")
    assert time.perf_counter() - start < 1.0  # hundreds, if each blank is looked at from each


@pytest.mark.parametrize("below", ["", "\n"])
def test_a_header_alone_has_no_numbers(tmp_path, below):
    (tmp_path / "log.csv").write_text(f"t,q{below}")
    with pytest.raises(DataError, match="q without a number in it"):
        read_log(tmp_path / "log.csv", {"q"})
