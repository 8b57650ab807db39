"""Structured arrays of NumPy, and structures of MATLAB and Simulink, as columns."""

import time

import h5py
import numpy as np
import pytest
import scipy.io

from ident.convert import convert_logs
from ident.convert.guess import guess_map
from ident.convert.reading import list_signals, read_log, survey_log
from robot_assets.errors import DataError

N = 400
T = np.arange(N) / 100.0
Q = np.sin(3 * T)
TAU = 2 * np.cos(3 * T)


def through_a_guess(log, folder):
    """q and tau (N,) that a guessed map, used as written, brings into a dataset."""
    (folder / "map.toml").write_text(guess_map([log], "twomass").text.replace("split", "# split"))
    (s,) = convert_logs([log], "twomass", folder / "map.toml").segments
    return s.q[:, 0], s.tau[:, 0]


def records(shape):
    out = np.zeros(N, [("t", float), ("q", float), ("tau", "f4"), ("pair", float, (2,)), ("imu", [("x", float)])])
    out["t"], out["q"], out["tau"], out["pair"], out["imu"]["x"] = T, Q, TAU, np.stack([Q, T], axis=1), TAU
    return out.reshape(shape)


@pytest.mark.parametrize("shape", [(N,), (N, 1)])
@pytest.mark.parametrize("kind", ["npz", "npy"])
def test_fields_of_structured_arrays_are_columns(tmp_path, shape, kind):
    log, start = tmp_path / f"log.{kind}", "log." if kind == "npz" else ""
    np.savez(log, log=records(shape)) if kind == "npz" else np.save(log, records(shape))
    found = list_signals(log)
    assert sorted(found) == sorted(start + k for k in ("t", "q", "tau", "pair", "imu.x"))
    assert np.array_equal(found[f"{start}pair"][:, 0].ravel(), Q) and np.array_equal(
        found[f"{start}imu.x"].ravel(), TAU
    )
    q, tau = through_a_guess(log, tmp_path)
    assert np.array_equal(q, Q) and np.allclose(tau, TAU)
    with pytest.raises(DataError, match=rf"no {start}x, expected one of .*{start}imu\.x"):
        read_log(log, {f"{start}x"})


def test_arrays_of_npy_files(tmp_path):
    np.save(tmp_path / "log.npy", np.stack([Q, TAU], axis=1))
    assert np.array_equal(read_log(tmp_path / "log.npy", {"values"})["values"][:, 1], TAU)
    np.save(tmp_path / "log.npy", Q)
    assert list_signals(tmp_path / "log.npy")["values"].shape == (N, 1)
    content = (tmp_path / "log.npy").read_bytes()
    for damaged in (content[:-9], content[:40], content.replace(b"(400,)", b"(9**9)"), b""):
        (tmp_path / "log.npy").write_bytes(damaged)
        with pytest.raises(DataError, match=r"log\.npy: found unreadable \(.*expected a complete file"):
            list_signals(tmp_path / "log.npy")
    np.save(tmp_path / "log.npy", np.array([{}, None]), allow_pickle=True)
    with pytest.raises(DataError, match="unreadable"):
        list_signals(tmp_path / "log.npy")


# --- Simulink: (name of the label, values in MATLAB's dimensions)


def matlab_5(path, signals):
    sig = np.zeros((1, len(signals)), [("values", object), ("dimensions", object), ("label", object)])
    for k, (label, x) in enumerate(signals):
        sig[0, k] = (x, 1.0, label)
    scipy.io.savemat(path, {"out": {"time": T[:, None], "signals": sig, "blockName": "model/Scope"}})


def char(file, name, text):
    """A text as MATLAB writes it; of an empty one its size."""
    item = file.create_dataset(
        name, data=np.frombuffer(text.encode("utf-16-le"), np.uint16)[:, None] if text else [0, 0]
    )
    item.attrs["MATLAB_class"] = np.bytes_("char")
    if not text:
        item.attrs["MATLAB_empty"] = 1
    return item


def matlab_73(path, signals):
    with h5py.File(path, "w") as file:
        file["out/time"] = T[None, :]
        parts = {"values": [], "label": []}
        for k, (label, x) in enumerate(signals):
            parts["values"].append(file.create_dataset(f"#refs#/v{k}", data=x.T))
            parts["label"].append(char(file, f"#refs#/l{k}", label))
        if len(signals) == 1:
            for key, (item,) in parts.items():
                file[f"out/signals/{key}"] = item
        else:
            for key, items in parts.items():
                refs = np.array([[x.ref] for x in items], h5py.ref_dtype)
                file.create_dataset(f"out/signals/{key}", data=refs, dtype=h5py.ref_dtype)


WAYS = {"5": matlab_5, "7.3": matlab_73}


@pytest.mark.parametrize("version", WAYS)
def test_signals_of_a_structure_with_time_go_by_their_labels(tmp_path, version):
    log = tmp_path / "log.mat"
    WAYS[version](log, [("motor position [rad]", Q[:, None]), ("<tau>", TAU.reshape(1, 1, -1))])
    assert {"out.time", "out.motor position [rad]", "out.tau"} <= set(list_signals(log))
    q, tau = through_a_guess(log, tmp_path)
    assert np.array_equal(q, Q) and np.array_equal(tau, TAU)
    # As MATLAB calls them, too.
    assert np.array_equal(read_log(log, {"out.signals(2).values"})["out.signals(2).values"].ravel(), TAU)


@pytest.mark.parametrize("version", WAYS)
@pytest.mark.parametrize(
    ("labels", "names"),
    [
        (("q", ""), ("out.q", "out.signals(2).values")),
        (("q", "q"), ("out.signals(1).values", "out.signals(2).values")),
        (("time", "tau"), ("out.signals(1).values", "out.signals(2).values")),
        (("q",), ("out.q",)),
        (("",), ("out.signals.values",)),
    ],
)
def test_signals_without_a_label_of_their_own_go_by_their_number(tmp_path, version, labels, names):
    WAYS[version](tmp_path / "log.mat", [(label, x[:, None]) for label, x in zip(labels, (Q, TAU), strict=False)])
    found = {k: x for k, x in list_signals(tmp_path / "log.mat").items() if x.size == N and k != "out.time"}
    assert list(found) == list(names)
    assert all(np.array_equal(x.ravel(), y) for x, y in zip(found.values(), (Q, TAU), strict=False))


@pytest.mark.parametrize("version", WAYS)
def test_structures_like_timeseries_with_a_time_each(tmp_path, version):
    log = tmp_path / "log.mat"
    series = {"tau_m": TAU[:, None], "q_m": Q.reshape(1, 1, -1)}
    if version == "5":
        scipy.io.savemat(log, {k: {"Name": k, "Time": T[:, None], "Data": x} for k, x in series.items()})
    else:
        with h5py.File(log, "w") as file:
            for k, x in series.items():
                file[f"{k}/Time"], file[f"{k}/Data"] = T[None, :], x.T
    assert "tau_m.Data" in guess_map([log], "twomass").found["tau"]  # not the time beside it
    q, tau = through_a_guess(log, tmp_path)
    assert np.array_equal(q, Q) and np.array_equal(tau, TAU)


def test_structures_and_cells_of_matlab_7_3_are_named_as_those_of_5(tmp_path):
    with h5py.File(tmp_path / "log.mat", "w") as file:
        parts = [file.create_dataset(f"#refs#/{k}", data=x[None, :]) for k, x in enumerate((Q, TAU))]
        refs = np.array([[x.ref] for x in parts], h5py.ref_dtype)
        file.create_dataset("runs/q", data=refs, dtype=h5py.ref_dtype)
        cells = file.create_dataset("c", data=refs, dtype=h5py.ref_dtype)
        cells.attrs["MATLAB_class"] = np.bytes_("cell")
        itself = file.create_dataset("loop", shape=(1, 1), dtype=h5py.ref_dtype)
        itself[0, 0] = itself.ref
    found = list_signals(tmp_path / "log.mat")
    assert set(found) == {"runs(1).q", "runs(2).q", "c{1}", "c{2}"}
    assert np.array_equal(found["c{2}"].ravel(), TAU) and np.array_equal(found["runs(1).q"].ravel(), Q)


def test_objects_of_a_class_are_said_to_be(tmp_path):
    log = tmp_path / "log.mat"
    with h5py.File(log, "w") as file:
        file["tau"] = TAU[None, :]
        item = file.create_dataset("q_ts", data=np.arange(6, dtype=np.uint32)[None])
        item.attrs["MATLAB_class"], item.attrs["MATLAB_object_decode"] = np.bytes_("timeseries"), 3
    assert "q_ts" not in list_signals(log) and "objects" in survey_log(log).doubts["q_ts"]
    with pytest.raises(DataError, match="q_ts is no array of numbers but of structures or objects: save their fields"):
        read_log(log, {"q_ts"})


def test_large_arrays_of_structures_stand_beside_signals(tmp_path):
    log = tmp_path / "log.mat"
    with h5py.File(log, "w") as file:
        file["q"] = Q[None, :]
        part = file.create_dataset("#refs#/x", data=np.zeros((1, 5)))
        group = file.create_group("#refs#/inner")
        for k in range(25):
            group[f"g{k}"] = TAU[None, :]
            refs = np.array([[part.ref]] * 99 + [[group.ref]], h5py.ref_dtype)
            file.create_dataset(f"runs/f{k}", data=refs, dtype=h5py.ref_dtype)
    assert list(read_log(log, {"q"})) == ["q"]
    assert np.array_equal(read_log(log, {"runs(100).f0.g24"})["runs(100).f0.g24"].ravel(), TAU)
    assert {"q", "runs(1).f0", "runs(99).f24", "runs(100).f0.g24"} <= set(list_signals(log))


def test_references_are_followed_up_to_a_bound(tmp_path, monkeypatch):
    monkeypatch.setattr("ident.convert.matlab.MOST_REFERRED", 2000)
    log = tmp_path / "log.mat"
    with h5py.File(log, "w") as file:
        file["z"] = Q[None, :]
        wide = file.create_group("#refs#/wide")
        for k in range(5000):
            wide[f"g{k}"] = h5py.SoftLink("/z")
        for k in range(4):  # each leads to all of the next, and so to 100 million
            name = "c" if k == 3 else f"#refs#/{k}"
            below = wide if k == 0 else file[f"#refs#/{k - 1}"]
            item = file.create_dataset(name, data=np.array([[below.ref]] * 100, h5py.ref_dtype), dtype=h5py.ref_dtype)
            item.attrs["MATLAB_class"] = np.bytes_("cell")
    start = time.perf_counter()
    assert list(list_signals(log)) == ["z"] and list(read_log(log, {"z"})) == ["z"]
    assert time.perf_counter() - start < 5.0
