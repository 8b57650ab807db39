"""Logs that list the names of the columns of their arrays: the names say which column is of which joint."""

import h5py
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import scipy.io

from ident.convert.guess import guess_map
from ident.convert.guess_order import columns_of_joints
from robot_assets.robot import load_robot
from tests.test_log_layouts import TAU, N, Q, T, converted, whole

ROBOT = "ur10_bare"
NAMES = load_robot(ROBOT).joint_names
ORDER = [3, 0, 5, 2, 1, 4]
SHUFFLED = [NAMES[k] for k in ORDER]


def parquet(path, names, q=Q, tau=TAU):
    rows = names if isinstance(names[0], list) else [names] * len(q)
    columns = {"t": T, "name": rows, "position": q.tolist(), "effort": tau.tolist(), "velocity": (0 * q).tolist()}
    pq.write_table(pa.table(columns), path)
    return path


def npz(path, names, q=Q, tau=TAU):
    np.savez(path, joint_names=np.array(names), t=T, q=q.T, tau=tau.T)
    return path


def mat(path, names, q=Q, tau=TAU):
    cells = np.array(names, object)
    scipy.io.savemat(path, {"rec": {"names": cells, "q": q, "tau": tau, "t": T}})
    return path


def mat73(path, names, q=Q, tau=TAU):
    """As MATLAB writes cells: references to texts that stand elsewhere in the file."""
    with h5py.File(path, "w") as file:
        cells = file.create_dataset("names", (len(names), 1), h5py.ref_dtype)
        for k, name in enumerate(names):
            text = file.create_dataset(f"#refs#/{k}", data=np.array([[ord(c)] for c in name], np.uint16))
            text.attrs["MATLAB_class"] = np.bytes_("char")
            cells[k, 0] = text.ref
        for key, x in {"t": T[:, None], "q": q, "tau": tau}.items():
            file[key] = x.T
    return path


WRITERS = {"log.parquet": parquet, "log.npz": npz, "log.mat": mat, "log73.mat": mat73}


@pytest.mark.parametrize("file", WRITERS)
@pytest.mark.parametrize("spelled", ["{}", "left/{}"])
def test_columns_are_those_that_the_log_names(tmp_path, file, spelled):
    names = [spelled.format(name) for name in SHUFFLED]
    guessed, data = converted(WRITERS[file](tmp_path / file, names, Q[:, ORDER], TAU[:, ORDER]))
    assert np.allclose(whole(data, "q"), Q) and np.allclose(whole(data, "tau"), TAU)
    assert guessed.text.count("columns by their names in ") >= 2 and "EDIT: joints" not in guessed.text


@pytest.mark.parametrize("file", WRITERS)
def test_columns_of_a_gripper_are_left_out(tmp_path, file):
    def wider(x):
        return np.concatenate([np.zeros((N, 2)), x[:, ORDER]], axis=1)

    _, data = converted(WRITERS[file](tmp_path / file, ["finger_1", "finger_2", *SHUFFLED], wider(Q), wider(TAU)))
    assert np.allclose(whole(data, "q"), Q) and np.allclose(whole(data, "tau"), TAU)


@pytest.mark.parametrize("file", WRITERS)
def test_names_that_are_of_no_joint_are_marked(tmp_path, file):
    text = guess_map([WRITERS[file](tmp_path / file, list("abcdef"))], ROBOT).text
    assert text.count("EDIT: joints in the order of the columns, which ") >= 2 and "calls a, b, c, d, e, f" in text
    assert "index" not in text


def test_names_that_change_from_row_to_row_are_marked(tmp_path):
    rows = [list(NAMES)] * (N - 1) + [SHUFFLED]
    text = guess_map([parquet(tmp_path / "log.parquet", rows)], ROBOT).text
    assert "EDIT: joints in the order of the columns, whose names in name change from row to row" in text


def test_lists_that_are_damaged_are_no_fault(tmp_path):
    np.savez(tmp_path / "log.npz", names=np.array([b"\xff", *b"abcde".split()] * 3), t=T, q=Q, tau=TAU)
    assert guess_map([tmp_path / "log.npz"], ROBOT).warnings == ()
    log = mat73(tmp_path / "log.mat", list(NAMES))
    with h5py.File(log, "a") as file:
        text = file.create_dataset("#refs#/x", data=np.array([2**32 - 1, 5], np.uint32))
        text.attrs["MATLAB_class"] = np.bytes_("char")
        file["names"][0, 0] = text.ref
    assert "columns by their names" not in guess_map([log], ROBOT).text
    file_of_empty = parquet(tmp_path / "log.parquet", [[None, *NAMES[1:]]] * N)
    assert "whose names in name change from row to row" in guess_map([file_of_empty], ROBOT).text


def test_a_column_of_texts_is_no_list_of_names(tmp_path):
    state = np.where(T < 1, "a", "b")[:, None]
    np.savez(tmp_path / "log.npz", state=state, none=np.array([], str), t=T, q=Q, tau=TAU)
    assert "EDIT" not in guess_map([tmp_path / "log.npz"], ROBOT).text.split("[columns]")[1].replace("EDIT? signs", "")


def test_lists_that_contradict_each_other_are_marked(tmp_path):
    np.savez(tmp_path / "log.npz", a=np.array(SHUFFLED), b=np.array(NAMES), t=T, q=Q, tau=TAU)
    text = guess_map([tmp_path / "log.npz"], ROBOT).text
    assert "EDIT: joints in the order of the columns, as a and b name them differently" in text


def test_the_list_beside_a_signal_names_it(tmp_path):
    log = {"left": {"names": np.array(SHUFFLED, object), "q": Q[:, ORDER], "tau": TAU[:, ORDER]}, "t": T}
    other = {"right": {"names": np.array(NAMES, object), "speed": Q}}
    scipy.io.savemat(tmp_path / "log.mat", log | other)
    _, data = converted(tmp_path / "log.mat")
    assert np.allclose(whole(data, "q"), Q) and np.allclose(whole(data, "tau"), TAU)


def test_columns_without_names_that_are_more_than_joints_are_marked(tmp_path):
    np.savez(tmp_path / "log.npz", t=T, q=np.concatenate([Q, Q[:, :2]], axis=1), tau=TAU)
    text = guess_map([tmp_path / "log.npz"], ROBOT).text
    assert "# q: EDIT? the first 6 of 8 columns" in text


def test_a_log_that_names_its_columns_otherwise_than_the_first_is_told(tmp_path):
    logs = [npz(tmp_path / "a.npz", list(NAMES)), npz(tmp_path / "b.npz", SHUFFLED, Q[:, ORDER], TAU[:, ORDER])]
    assert guess_map(logs, ROBOT).warnings == (
        "b.npz: joint_names lists other names than in a.npz: it needs a map of its own",
    )
    assert guess_map([logs[0], npz(tmp_path / "c.npz", list(NAMES))], ROBOT).warnings == ()


@pytest.mark.parametrize(
    ("names", "joints", "columns"),
    [
        (("A3", "a1", "A2"), ("A1", "A2", "A3"), (1, 2, 0)),
        (("r/joint_10", "r/joint_1"), ("joint_1", "joint_10"), (1, 0)),
        (("joint2", "joint1"), ("panda_joint1", "panda_joint2"), (1, 0)),
        (("fr3_joint2", "fr3_joint1"), ("panda_joint1", "panda_joint2"), (1, 0)),
        (("joint1", "joint2", "finger_joint1"), ("joint1", "joint2"), (0, 1)),
        (("left/a", "right/a", "left/b"), ("a", "b"), None),  # two of one joint
        (("joint11", "joint12"), ("joint1", "joint2"), None),
        (("a", "b"), ("a", "c"), None),
    ],
)
def test_a_name_is_that_of_a_joint_or_one_begins_or_ends_with_the_other(names, joints, columns):
    assert columns_of_joints(names, joints) == columns
