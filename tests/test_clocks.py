"""Time stamps of logs: gaps that are filled, other rates, files with clocks of their own."""

import json
import tomllib
from dataclasses import replace

import numpy as np
import pytest

from ident.checking import inspect_dataset
from ident.convert import convert_logs
from ident.convert.clock import check_stamps, resample, uniform_times
from ident.convert.guess import guess_map
from ident.dataset_io import load_dataset, save_dataset
from robot_assets.errors import DataError
from tests.test_cli import simgap as run

BENCH = '[columns]\ntau_1 = "u"\nq_1 = "x"\n'
CLOCK = '[time]\nsource = "t"\n'


def angle(t):
    return 0.5 * np.sin(2 * np.pi * 0.4 * t) + 0.2 * np.sin(2 * np.pi * 1.3 * t)


def torque(t):
    return 0.3 * np.cos(2 * np.pi * 0.4 * t) - 0.1 * np.sin(2 * np.pi * 1.3 * t)


def written(path, **columns):
    np.savetxt(
        path,
        np.stack(list(columns.values()), axis=1),
        header=",".join(columns),
        comments="",
        delimiter=",",
        fmt="%.12g",
    )
    return path


def mapped(folder, text):
    (folder / "map.toml").write_text(text)
    return folder / "map.toml"


@pytest.mark.slow
def test_gaps_that_were_filled_are_told_by_the_conversion_and_by_the_check(tmp_path):
    t = np.arange(4000) / 200.0
    keep = np.ones(4000, bool)
    keep[300:340] = keep[1000:1010] = keep[3500:3520] = False
    log = written(tmp_path / "log.csv", t=t[keep], u=torque(t[keep]), x=angle(t[keep]))
    given = mapped(tmp_path, f"sample_rate = 200.0\nsplit = 0.6\n{CLOCK}{BENCH}")
    result = run("convert", log, "--robot", "twomass", "--map", given, "--out", tmp_path / "d", "--json")
    (note,) = json.loads(result.stdout)["changed"]
    assert "3 gaps, 0.365 s in all, filled by interpolation, the longest 205 ms" in note
    first, second = load_dataset(tmp_path / "d").segments
    assert (first.filled.gaps, second.filled.gaps) == (2, 1)
    assert first.filled.longest == pytest.approx(0.205) and first.filled.total == pytest.approx(0.26)
    checked = run("check", tmp_path / "d").stdout
    assert "2 gaps of the log, 0.205 s the longest, 0.26 s in all" in checked
    whole = replace(load_dataset(tmp_path / "d"), segments=(replace(first, filled=None),))
    assert not any("gaps of the log" in w for w in inspect_dataset(whole).warnings)
    save_dataset(whole, tmp_path / "whole")
    assert "filled" not in (tmp_path / "whole" / "dataset.toml").read_text()
    toml = tmp_path / "d" / "dataset.toml"
    toml.write_text(toml.read_text().replace("gaps = 2", "gaps = 0"))
    with pytest.raises(DataError, match="gaps"):
        load_dataset(tmp_path / "d")


def test_a_log_of_another_even_rate_has_no_gaps(tmp_path):
    t = np.arange(1000) / 50.0
    log = written(tmp_path / "log.csv", t=t, u=torque(t), x=angle(t))
    said = []
    data = convert_logs([log], "twomass", mapped(tmp_path, f"sample_rate = 200.0\n{CLOCK}{BENCH}"), say=said.append)
    assert data.segments[0].filled is None and "0 gaps" in said[0]


@pytest.mark.parametrize("rate", [1000.0, 700.0, 1300.0])
@pytest.mark.parametrize("jitter", [0.0, 0.02])
def test_tones_above_the_new_band_do_not_fold_and_those_within_keep_size_and_phase(rate, jitter):
    new, rng = 250.0, np.random.default_rng(0)
    at = (np.arange(int(8 * rate)) + jitter * rng.uniform(-1, 1, int(8 * rate))) / rate
    at[0] = 0.0
    stamps = check_stamps(at, new, "log")
    t = uniform_times(0.0, float(at[-1]), new)
    inside, inner = slice(100, -100), (10.0, 31.0)
    # Above: left alone it would be seen at 250 - 180 = 70 Hz.
    tones = np.stack([np.sin(2 * np.pi * f * at + 0.3) for f in (*inner, 180.0)], axis=1)
    out = resample(tones, stamps, t, new)
    assert out.shape == (len(t), 3)
    for k, f in enumerate(inner):
        expected = np.sin(2 * np.pi * f * t + 0.3)
        c = np.exp(-2j * np.pi * f * t)[inside]
        ratio = (c @ out[inside, k]) / (c @ expected[inside])
        assert abs(np.abs(ratio) - 1) < 2e-2 and abs(np.angle(ratio)) < 1e-3, (f, ratio)
    left = 1e-3 if rate == 1000.0 and jitter == 0.0 else 5e-2  # between samples values are made up by a cubic
    assert np.std(out[inside, 2]) < left * np.std(tones[:, 2])


def test_samples_that_meet_the_new_ones_are_filtered_to_a_ten_thousandth():
    at = np.arange(8000) / 1000.0
    t = uniform_times(0.0, at[-1], 250.0)
    for f in (5.0, 40.0, 90.0):
        x = np.cos(2 * np.pi * f * at)
        out = resample(np.stack([x, -x], axis=1), check_stamps(at, 250.0, "log"), t, 250.0)
        assert np.allclose(out[100:-100, 0], np.cos(2 * np.pi * f * t)[100:-100], atol=3e-4)
        assert np.array_equal(out[:, 0], -out[:, 1])


def test_a_faster_log_is_filtered_and_said_to_be(tmp_path):
    t = np.arange(8000) / 1000.0
    hum = np.sin(2 * np.pi * 180.0 * t)
    log = written(tmp_path / "log.csv", t=t, u=torque(t) + hum, x=angle(t))
    said = []
    data = convert_logs([log], "twomass", mapped(tmp_path, f"sample_rate = 250.0\n{CLOCK}{BENCH}"), say=said.append)
    s = data.segments[0]
    assert np.allclose(s.tau[100:-100, 0], torque(s.t)[100:-100], atol=2e-3) and np.allclose(
        s.q[:, 0], angle(s.t), atol=1e-3
    )
    assert "it has 1000 Hz: filtered below 125 Hz" in said[0] and s.filled is None


OWN = '[columns]\ntau_1 = "cur:u"\nq_1 = {{ source = "pos:x", unit = "deg"{more} }}\n'
WAYS = {
    "each its own": '[files]\npos = { name = "pos.csv", time = "ms", unit = "ms" }\ncur = { name = "cur.csv", time = "t" }\n',
    "one name": '[time]\nsource = "t"\n[files]\npos = "pos.csv"\ncur = "cur.csv"\n',
}


@pytest.mark.parametrize("way", WAYS)
@pytest.mark.parametrize("wraps", [False, True])
def test_files_with_clocks_of_their_own_are_joined_where_both_have_samples(tmp_path, way, wraps):
    at, later = 100.0 + np.arange(4000) / 200.0, 101.003 + np.arange(9000) / 500.0
    x = np.rad2deg(angle(at)) + 170.0
    written(tmp_path / "pos.csv", t=at, ms=1e3 * at, x=np.mod(x + 180, 360) - 180 if wraps else x)
    written(tmp_path / "cur.csv", t=later, u=torque(later))
    text = "sample_rate = 200.0\n" + WAYS[way] + OWN.format(more=", unwrap = true" if wraps else "")
    said = []
    data = convert_logs(
        [tmp_path / "cur.csv", tmp_path / "pos.csv"], "twomass", mapped(tmp_path, text), say=said.append
    )
    (s,) = data.segments
    assert s.t[0] == 0.0 and s.t[-1] == pytest.approx(119.001 - 101.003, abs=0.01) and len(said) == 2
    on = 101.003 + s.t
    assert np.allclose(s.q[:, 0] - np.deg2rad(170.0), angle(on), atol=1e-4)
    assert np.allclose(s.tau[50:-50, 0], torque(on)[50:-50], atol=1e-4)


def test_files_whose_spans_do_not_overlap_are_one_clear_error(tmp_path):
    at = np.arange(2000) / 200.0
    written(tmp_path / "pos.csv", t=at, x=angle(at))
    written(tmp_path / "cur.csv", t=at + 500.0, u=torque(at))
    files = [tmp_path / "cur.csv", tmp_path / "pos.csv"]
    text = 'sample_rate = 200.0\n[files]\npos = { name = "pos.csv", time = "t"%s }\ncur = { name = "cur.csv", time = "t" }\n'
    columns = '[columns]\ntau_1 = "cur:u"\nq_1 = "pos:x"\n'
    with pytest.raises(DataError, match=r"pos\.csv ends 490 s before cur\.csv begins"):
        convert_logs(files, "twomass", mapped(tmp_path, text % "" + columns))
    (s,) = convert_logs(files, "twomass", mapped(tmp_path, text % ", shift = 500.0" + columns)).segments
    assert np.allclose(s.q[:, 0], angle(at)) and np.allclose(s.tau[:, 0], torque(at))
    with pytest.raises(DataError, match="a time for each of the files"):
        convert_logs(
            files, "twomass", mapped(tmp_path, (text % "" + columns).replace('"cur.csv", time = "t"', '"cur.csv"'))
        )


def test_a_map_is_guessed_for_files_with_clocks_of_their_own(tmp_path):
    at, later = 5.0 + np.arange(2000) / 100.0, 5.3 + np.arange(9000) / 500.0
    pair = (
        {f"pos_{j + 1}": angle(at + j) for j in range(6)},
        {f"torque_{j + 1}": 50 * torque(later + j) for j in range(6)},
    )
    written(tmp_path / "pos.csv", stamp_ms=1e3 * at, **pair[0])
    written(tmp_path / "cur.csv", t=later, **pair[1])
    files = [tmp_path / "cur.csv", tmp_path / "pos.csv"]
    guessed = guess_map(files, "ur10_bare")
    assert tomllib.loads(guessed.text)["files"]["pos"] == {"name": "pos.csv", "time": "stamp_ms", "unit": "ms"}
    data = convert_logs(files, "ur10_bare", mapped(tmp_path, guessed.text))
    assert data.sample_rate == 100.0
    t = 5.3 + np.arange(sum(len(s.t) for s in data.segments)) / 100.0
    q, tau = (np.concatenate([getattr(s, c) for s in data.segments]) for c in ("q", "tau"))
    for j in range(6):
        assert np.allclose(q[:, j], angle(t + j), atol=2e-3) and np.allclose(
            tau[50:-50, j], 50 * torque(t + j)[50:-50], atol=1e-2
        )


@pytest.mark.parametrize("files", [1, 2])
def test_the_order_of_stamps_is_looked_at_once(tmp_path, monkeypatch, files):
    looked = []
    for module in ("ident.convert", "ident.convert.clock", "ident.convert.joining"):
        monkeypatch.setattr(f"{module}.check_order", lambda t, path: looked.append(path), raising=False)
    t = np.arange(1000) / 100
    logs = [written(tmp_path / f"{n}.csv", t=t, u=torque(t), x=angle(t)) for n in "ab"[:files]]
    several = '[files]\na = "a.csv"\nb = "b.csv"\n' + CLOCK + BENCH.replace('"u', '"a:u').replace('"x', '"b:x')
    (tmp_path / "map.toml").write_text("sample_rate = 100.0\n" + (several if files == 2 else CLOCK + BENCH))
    convert_logs(logs, "twomass", tmp_path / "map.toml")
    assert looked == logs
