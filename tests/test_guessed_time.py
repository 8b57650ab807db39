"""The time of a log in a guessed map: how it may be called and written, and why it is not used where it is not."""

import json
import tomllib
from datetime import datetime, timedelta

import numpy as np
import pytest

from ident.convert import convert_logs
from ident.convert.guess import guess_map
from robot_assets.errors import DataError
from tests.test_cli import simgap as run

RATE = 500.0
N = 1500
T = np.arange(N) / RATE
X, U = 0.5 * np.sin(4 * T) + 0.3 * np.cos(11 * T), np.cos(4 * T)


def written(folder, columns):
    rows = "\n".join(
        ";".join(x if isinstance(x, str) else f"{x:.12g}" for x in row) for row in zip(*columns.values(), strict=True)
    )
    (folder / "log.csv").write_text(";".join(columns) + "\n" + rows + "\n", encoding="utf-8")
    return folder / "log.csv"


def guessed(folder, times, t=T):
    x = {"pos_rad": 0.5 * np.sin(4 * t), "torque_Nm": np.cos(4 * t)}
    log = written(folder, times | x)
    found = guess_map([log], "twomass")
    (folder / "guessed.toml").write_text(found.text, encoding="utf-8")
    return log, found, tomllib.loads(found.text)


def damaged(kind):
    t = T.copy()
    if kind == "swapped":
        t[[700, 701]] = t[[701, 700]]
    elif kind == "no number":
        t[700] = np.nan
    else:
        t[700:] -= t[700]
    return t


@pytest.mark.parametrize(
    ("kind", "why", "error"),
    [
        ("swapped", r"goes back in row 702 (from 1.402 to 1.4)", "goes back by 0.002 s at sample 701"),
        ("no number", "has no number in row 701", "no stamp at sample 700"),
        ("restart", "goes back in row 701 (from 1.398 to 0)", "goes back by 1.398 s at sample 700"),
    ],
)
def test_a_time_that_cannot_be_used_is_told_and_marked(tmp_path, kind, why, error):
    log, found, read = guessed(tmp_path, {"t": damaged(kind)})
    assert found.warnings == (f"no time: t {why}",) and "time" not in found.found
    assert "time" not in read and read["sample_rate"] == RATE
    assert (
        "EDIT: Hz, by the median step of t" in found.text
        and f"# EDIT: t is not used as the time: it {why}" in found.text
    )
    convert_logs([log], "twomass", tmp_path / "guessed.toml")  # as if even
    (tmp_path / "map.toml").write_text(
        found.text.replace("# [time]\n# source", "[time]\nsource").replace('# unit = "s"', 'unit = "s"')
    )
    with pytest.raises(DataError) as caught:
        convert_logs([log], "twomass", tmp_path / "map.toml")
    assert error in str(caught.value)


@pytest.mark.parametrize(
    ("t", "why"),
    [(T[::-1], "falls"), (np.full(N, 5.0), "is the same in all rows"), (np.sin(40 * T), "goes back in row")],
)
def test_a_column_of_times_that_never_rises_is_told(tmp_path, t, why):
    _, found, read = guessed(tmp_path, {"timestamp": t})
    assert len(found.warnings) == 1 and found.warnings[0].startswith(f"no time: timestamp {why}")
    assert "time" not in read and f"# EDIT: timestamp is not used as the time: it {why}" in found.text


def test_the_command_tells_why_no_time_was_used(tmp_path):
    log = written(tmp_path, {"t": damaged("swapped"), "pos_rad": X, "torque_Nm": U})
    (tmp_path / "log.csv").write_text(log.read_text().replace(f"{U[900]:.12g}\n", "ERR\n", 1))
    result = run("convert", log, "--robot", "twomass", "--guess", "--map", tmp_path / "map.toml", "--json")
    warnings = json.loads(result.stdout)["warnings"]
    assert warnings[0] == "no time: t goes back in row 702 (from 1.402 to 1.4)"
    assert warnings[1] == "torque_Nm 'ERR' in row 901: the conversion will name it"
    assert "EDIT: torque_Nm has 'ERR' in row 901" in (tmp_path / "map.toml").read_text()


NAMES = {
    "seconds": 1.0, "Elapsed": 1.0, "duration": 1.0, "clock": 1.0, "Zeitstempel": 1.0, "ms": 1e3, "millis": 1e3, "elapsed_ms": 1e3, "micros": 1e6,
    "nanoseconds": 1e9, "IPOC": 1e3,
}  # fmt: skip


@pytest.mark.parametrize("name", NAMES)
def test_names_of_time(tmp_path, name):
    _, found, read = guessed(tmp_path, {name: T * NAMES[name]})
    assert read["time"]["source"] == name and read["sample_rate"] == RATE and not found.warnings
    assert {"s": 1.0, "ms": 1e3, "us": 1e6, "ns": 1e9}[read["time"]["unit"]] == NAMES[name]


WAYS = {
    "DD.MM.YYYY": "%d.%m.%Y %H:%M:%S.%f", "M/D/YYYY": "%m/%d/%Y %H:%M:%S.%f", "YYYY/MM/DD": "%Y/%m/%d %H:%M:%S.%f",
    "comma": "%Y-%m-%d %H:%M:%S,%f", "DD-MM-YYYY": "%d-%m-%YT%H:%M:%S.%f", "half days": "%m/%d/%Y %I:%M:%S.%f %p", "time of the day": "%H:%M:%S.%f",
    "with a comma": "%H:%M:%S,%f",
}  # fmt: skip


@pytest.mark.parametrize("way", WAYS)
def test_dates_of_several_ways_over_midnight(tmp_path, way):
    start = datetime(2026, 11, 30, 23, 59, 58)
    log, found, read = guessed(tmp_path, {"Datum": [(start + timedelta(seconds=x)).strftime(WAYS[way]) for x in T]})
    assert read["sample_rate"] == RATE and read["time"] == {"source": "Datum"} and "EDIT" not in found.found["time"]
    segments = convert_logs([log], "twomass", tmp_path / "guessed.toml").segments
    assert np.allclose(np.concatenate([s.q for s in segments])[:, 0], 0.5 * np.sin(4 * T), atol=1e-9)


def test_a_month_that_may_be_a_day_is_said(tmp_path):
    for day, doubt in ((3, True), (23, False)):
        start = datetime(2026, 4, day, 10)
        _, found, read = guessed(
            tmp_path, {"Date": [(start + timedelta(seconds=x)).strftime("%m/%d/%Y %H:%M:%S.%f") for x in T]}
        )
        assert ("EDIT? '04/03/2026 10:00:00.000000' taken as month/day" in found.found["time"]) == doubt and read[
            "sample_rate"
        ] == RATE


@pytest.mark.parametrize("way", ["%d/%m/%Y %H:%M:%S.%f", "%m/%d/%Y %H:%M:%S.%f", "%m-%d-%Y %H:%M:%S.%f"])
@pytest.mark.parametrize("piece", [1000, 1 << 20])
@pytest.mark.parametrize("day", [2, 12])
def test_midnight_tells_which_number_is_the_day(tmp_path, monkeypatch, way, piece, day):
    monkeypatch.setattr("ident.convert.texts.PIECE", piece)
    start = datetime(2026, 11, day, 23, 59, 58)
    log, found, read = guessed(tmp_path, {"Date": [(start + timedelta(seconds=x)).strftime(way) for x in T]})
    assert read["sample_rate"] == RATE and "EDIT" not in found.found["time"] and not found.warnings
    segments = convert_logs([log], "twomass", tmp_path / "guessed.toml").segments
    assert np.allclose(np.concatenate([s.q for s in segments])[:, 0], 0.5 * np.sin(4 * T), atol=1e-9)


def test_a_long_pause_is_no_wrong_unit_of_time(tmp_path):
    log, _, _ = guessed(tmp_path, {"t": T + 36000.0 * (np.arange(N) >= 700)})
    with pytest.raises(DataError, match=r"3\.6e\+04 s without a sample after 1\.398 s.*cut the log into two"):
        convert_logs([log], "twomass", tmp_path / "guessed.toml")


@pytest.mark.parametrize(
    ("rate", "unit", "marked"), [(10.0, "s", True), (4.0, "s", True), (1000.0, "ms", True), (250.0, "s", False)]
)
def test_a_slow_log_is_no_fast_one_in_another_unit(tmp_path, rate, unit, marked):
    t = np.arange(4000 if unit == "ms" else 600) / rate
    column = {"t": t * (1e3 if unit == "ms" else 1) + (0.013 * np.sin(np.arange(4000)) if unit == "ms" else 0)}
    _, found, read = guessed(tmp_path, column, t)
    assert read["time"]["unit"] == unit and read["sample_rate"] == rate
    assert ("EDIT" in found.found["time"]) == marked and ("EDIT" in found.text.split("\n")[2]) == marked


@pytest.mark.parametrize(
    "names", [("header.stamp.sec", "header.stamp.nanosec", 1e9), ("secs", "nsecs", 1e9), ("tv_sec", "tv_usec", 1e6)]
)
def test_seconds_with_their_fraction_in_another_column(tmp_path, names):
    at = T + 1.73e9 + 0.4
    full = np.floor(at)
    columns = {names[0]: [str(int(x)) for x in full], names[1]: [str(round((t + 0.4) % 1 * names[2])) for t in T]}
    log, found, read = guessed(tmp_path, columns)
    unit = "ns" if names[2] == 1e9 else "us"
    assert (
        read["time"] == {"source": names[0], "unit": "s", "plus": [{"source": names[1], "unit": unit}]}
        and read["sample_rate"] == RATE
    )
    segments = convert_logs([log], "twomass", tmp_path / "guessed.toml").segments
    assert np.allclose(np.concatenate([s.q for s in segments])[:, 0], 0.5 * np.sin(4 * T), atol=1e-9)
    (tmp_path / "map.toml").write_text(found.text.replace("plus", "plsu"))
    with pytest.raises(DataError, match=r"time\.plsu"):
        convert_logs([log], "twomass", tmp_path / "map.toml")
