"""What a user brings: a URDF, logs of several formats, a first map, the published data of real machines."""

from __future__ import annotations

import re
import subprocess
import sys
import tomllib
from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest
import scipy.io
import scipy.signal

from ident.convert import convert_logs
from ident.convert.bags import JOINT_STATE
from ident.convert.guess import guess_map
from ident.convert.guess_names import words_of
from ident.dataset_io import load_dataset, save_dataset
from robot_assets.errors import DataError
from robot_assets.from_urdf import draft_robot, write_robot
from robot_assets.robot import load_robot

LINEAR = """<robot name="slide">
  <link name="rail"/>
  <link name="carriage"><inertial><origin xyz="0 0 0"/><mass value="12"/>
    <inertia ixx="0.1" iyy="0.1" izz="0.1" ixy="0" ixz="0" iyz="0"/></inertial></link>
  <joint name="x" type="prismatic"><parent link="rail"/><child link="carriage"/><axis xyz="{axis}"/>
    <limit lower="0" upper="0.4" {limit}/></joint>
</robot>"""


def simgap(*args):
    return subprocess.run(
        [sys.executable, "-m", "ident.cli", *map(str, args)], capture_output=True, text=True, timeout=300, check=False
    )


# --- a robot folder from a URDF


@pytest.mark.parametrize("name", ["ur10", "panda", "irb"])
def test_guesses_come_near_the_figures_of_the_shipped_arms(name):
    arm = load_robot(name)
    draft = draft_robot(arm.urdf, dict(arm.locked))
    assert tuple(g.joint.name for g in draft.guesses) == arm.joint_names
    for field in ("motor_inertia", "stiffness", "viscous_friction"):
        ratio = np.array([getattr(g.joint, field) for g in draft.guesses]) / arm.array(field)
        assert np.abs(np.log(ratio)).max() < np.log(5.0), (field, ratio)


def test_the_inertia_seen_is_that_of_the_rigid_body_algorithm():
    arm = load_robot("ur10")
    model = pin.buildModelFromUrdf(str(arm.urdf))
    data = model.createData()
    rng = np.random.default_rng(1)
    seen, weights = [], []
    for _ in range(300):
        q = rng.uniform(-np.pi, np.pi, 6)
        seen.append(np.diag(pin.crba(model, data, q)).copy())
        weights.append(np.abs(pin.computeGeneralizedGravity(model, data, q)))
    for j, guess in enumerate(draft_robot(arm.urdf).guesses):
        low, high = guess.inertia
        assert np.min(seen, axis=0)[j] <= 1.05 * low and high <= 1.05 * np.max(seen, axis=0)[j]
        assert guess.inertia == pytest.approx((np.min(seen, axis=0)[j], np.max(seen, axis=0)[j]), rel=0.3)
        assert guess.weight == pytest.approx(np.max(weights, axis=0)[j], rel=0.2, abs=1e-9)


@pytest.mark.parametrize("limit", ['effort="150" velocity="0.5"', "", 'effort="0" velocity="0"', 'effort="many"'])
@pytest.mark.parametrize("axis", ["1 0 0", "0 0 1"])
def test_a_linear_drive_has_guesses_in_kg_and_newtons(tmp_path, limit, axis):
    (tmp_path / "slide.urdf").write_text(LINEAR.format(axis=axis, limit=limit))
    robot, _ = write_robot(tmp_path / "slide.urdf", tmp_path / "slide")
    joint = robot.joints[0]
    assert joint.motor_inertia == pytest.approx(12.0) and joint.gear_ratio == 1.0
    assert np.sqrt(joint.stiffness / 12.0) / 2 / np.pi == pytest.approx(30.0, rel=0.01)
    assert (
        joint.torque_limit == 150.0 if "150" in limit else joint.torque_limit > (2 * 12 * 9.8 if axis[-1] == "1" else 0)
    )
    text = (tmp_path / "slide" / "robot.toml").read_text()
    assert "N s/m" in text and "GUESS" in text and "rad" not in text.split("[[joint]]")[1]


def test_the_command_writes_a_robot_that_loads_and_simulates(tmp_path):
    urdf = load_robot("panda").urdf
    run = simgap("robot", urdf, "--out", tmp_path / "arm", "--lock", "panda_finger_joint1=0.02")
    assert run.returncode == 0 and "GUESS" in run.stdout, run.stderr
    robot = load_robot(tmp_path / "arm")
    assert robot.n == 7 and robot.locked == {"panda_finger_joint1": 0.02, "panda_finger_joint2": 0.02}
    assert robot.array("torque_limit").tolist() == [87.0] * 4 + [12.0] * 3
    written = (tmp_path / "arm" / "robot.toml").read_text()
    assert tomllib.loads(written)["name"] == "arm"
    again = simgap("robot", urdf, "--out", tmp_path / "arm")
    assert again.returncode == 2 and len(again.stderr.splitlines()) == 1
    assert (tmp_path / "arm" / "robot.toml").read_text() == written

    from sim.plant import build_plant, link_inertia_diagonal

    assert np.all(link_inertia_diagonal(build_plant(robot), np.zeros(7)) > robot.array("motor_inertia"))


@pytest.mark.parametrize(
    "args",
    [
        ("robot", "ARM", "--out", "x", "--lock", "joint_1=nan"),
        ("robot", "ARM", "--out", "x", "--lock", "joint_1=left"),
        ("robot", "ARM", "--out", "log.csv"),
        ("robot", "ARM", "--out", "log.csv/x"),
        ("robot", "log.csv", "--out", "x"),
        ("robot", ".", "--out", "x"),
        ("convert", "log.csv", "--robot", "ur10", "--guess", "--map", "x"),
        ("convert", ".", "--robot", "ur10", "--guess", "--map", "x"),
        ("convert", "log.csv", "--robot", "ur10", "--map", "no_such_map", "--out", "x"),
        ("convert", "log.csv", "--robot", "ur10", "--map", "log.csv", "--out", "x"),
        ("convert", "log.csv", "--robot", "ur10", "--map", "emps_drive"),
    ],
    ids=" ".join,
)
def test_bad_usage_is_one_line_and_leaves_nothing(tmp_path, args):
    (tmp_path / "log.csv").write_text("a,b\n1,2\n")
    args = [str(load_robot("irb").urdf) if a == "ARM" else a for a in args]
    run = subprocess.run(
        [sys.executable, "-m", "ident.cli", *args],
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
        cwd=tmp_path,
    )
    assert run.returncode == 2 and len(run.stderr.strip().splitlines()) == 1, run.stderr
    assert [p.name for p in tmp_path.iterdir()] == ["log.csv"]


@pytest.mark.parametrize(
    ("urdf", "lock", "found"),
    [
        (None, {}, "no such file"),
        ("<robot", {}, "invalid XML"),
        ('<robot name="r"><link name="a"/></robot>', {}, "no movable joint"),
        (LINEAR.format(axis="1 0 0", limit=""), {"y": None}, "y"),
        (LINEAR.format(axis="1 0 0", limit=""), {"x": None}, "no movable joint"),
    ],
)
def test_a_urdf_that_cannot_be_used_is_one_clear_error(tmp_path, urdf, lock, found):
    path = tmp_path / "arm.urdf"
    if urdf is not None:
        path.write_text(urdf)
    with pytest.raises(DataError, match=found):
        write_robot(path, tmp_path / "arm", lock)
    assert not (tmp_path / "arm").exists() and not list(tmp_path.glob(".arm*"))


# --- logs by a map


@pytest.fixture
def slide(tmp_path):
    (tmp_path / "slide.urdf").write_text(LINEAR.format(axis="1 0 0", limit='effort="150" velocity="0.5"'))
    return write_robot(tmp_path / "slide.urdf", tmp_path / "slide")[0]


@pytest.fixture
def pair(tmp_path):
    """Two turning joints, gears 50 and 100."""
    (tmp_path / "pair.urdf").write_text(
        """<robot name="pair"><link name="a"/>
        <link name="b"><inertial><mass value="3"/><inertia ixx="0.1" iyy="0.1" izz="0.1"/></inertial></link>
        <link name="c"><inertial><origin xyz="0.2 0 0"/><mass value="1"/><inertia ixx="0.1" iyy="0.1" izz="0.1"/></inertial></link>
        <joint name="one" type="revolute"><parent link="a"/><child link="b"/><axis xyz="0 0 1"/>
          <limit lower="-3" upper="3" effort="80" velocity="3"/></joint>
        <joint name="two" type="revolute"><parent link="b"/><child link="c"/><origin xyz="0.4 0 0"/><axis xyz="0 0 1"/>
          <limit lower="-3" upper="3" effort="40" velocity="3"/></joint></robot>"""
    )
    write_robot(tmp_path / "pair.urdf", tmp_path / "pair")
    toml = tmp_path / "pair" / "robot.toml"
    toml.write_text(toml.read_text().replace("gear_ratio = 100.0", "gear_ratio = 50.0", 1))
    return load_robot(tmp_path / "pair")


def motion(n=2, N=1000, rate=500.0):
    """t (N,), q, qd, tau (N, n), SI, link side: torque with inertia, friction and noise."""
    t = np.arange(N) / rate
    w = 2 * np.pi * np.array([0.7, 1.1, 0.5, 0.9, 1.3, 1.7, 0.6][:n])
    q, qd, qdd = 0.8 * np.sin(w * t[:, None]), 0.8 * w * np.cos(w * t[:, None]), -0.8 * w**2 * np.sin(w * t[:, None])
    tau = 0.5 * qdd + 4 * np.tanh(qd / 0.05) + 2 * qd + 0.05 * np.random.default_rng(0).normal(size=q.shape)
    return t, q, qd, tau


MAP = """sample_rate = 500.0
[files]
pos = "pos*.txt"
cur = { name = "cur.dat", width = 2 }
[columns]
q_1 = { source = "pos:values", side = "motor" }
q_2 = { source = "pos:values", side = "motor", plus = [{ source = "pos:values", factor = -0.02, index = 0 }] }
tau_1 = { source = "cur:values", side = "motor", plus = [{ source = "cur:values", factor = 100.0, index = 1 }] }
tau_2 = { source = "cur:values", side = "motor" }
"""


def test_a_log_over_several_files_with_coupled_gears(tmp_path, pair):
    _, q, _, tau = motion()
    ratio = np.array([50.0, 100.0])
    # Motor 2 turns with both joints: q_m2 = 100 (q_2 + q_1), so torque of motor 2 also acts on joint 1.
    motor = np.stack([50 * q[:, 0], 100 * (q[:, 0] + q[:, 1])], axis=1)
    torque = np.stack([(tau[:, 0] - tau[:, 1]) / 50, tau[:, 1] / 100], axis=1)
    assert np.allclose((motor * ratio**-1)[:, 1] - q[:, 0], q[:, 1])
    for run in ("a", "b"):
        (tmp_path / run).mkdir()
        np.savetxt(tmp_path / run / "pos_1.txt", motor, fmt="%.12g")
        np.savetxt(tmp_path / run / "cur.dat", torque.ravel(), fmt="%.12g")
    (tmp_path / "map.toml").write_text(MAP)
    files = [tmp_path / run / f for run in ("a", "b") for f in ("cur.dat", "pos_1.txt")]
    data = convert_logs(files, pair.folder, tmp_path / "map.toml")
    assert [s.name for s in data.segments] == ["a", "b"]
    assert np.allclose(data.segments[1].q, q, atol=1e-9) and np.allclose(data.segments[1].tau, tau, atol=1e-9)
    with pytest.raises(DataError, match=r"none like cur\.dat"):
        convert_logs(files[1:2], pair.folder, tmp_path / "map.toml")


def test_roles_and_split(tmp_path, slide):
    t, q, _, tau = motion(1)
    for name in ("a", "b"):
        np.savetxt(tmp_path / f"{name}.txt", np.column_stack([t, tau, q]), header="t u x", comments="")
    (tmp_path / "map.toml").write_text(
        'sample_rate = 500.0\nsplit = 0.75\n[roles]\nb = "validation"\n[time]\nsource = "t"\n'
        '[columns]\ntau_1 = { source = "u", unit = "N" }\nq_1 = { source = "x", unit = "mm" }\n'
    )
    data = convert_logs([tmp_path / "a.txt", tmp_path / "b.txt"], slide.folder, tmp_path / "map.toml")
    assert [(s.name, s.role, s.n_samples) for s in data.segments] == [
        ("a-1", "identification", 750), ("a-2", "validation", 250), ("b", "validation", 1000),
    ]  # fmt: skip
    assert np.allclose(data.segments[2].q, q * 1e-3)


def test_a_csv_with_semicolons_and_decimal_commas(tmp_path, slide):
    (tmp_path / "log.csv").write_text("Kraft; Weg\n" + "1,5;0,25\n-2,5;0,50\n" * 8)
    (tmp_path / "map.toml").write_text(
        'sample_rate = 10.0\n[columns]\ntau_1 = { source = "Kraft", unit = "N" }\nq_1 = { source = "Weg", unit = "m" }\n'
    )
    s = convert_logs([tmp_path / "log.csv"], slide.folder, tmp_path / "map.toml").segments[0]
    assert s.tau[:, 0].tolist() == [1.5, -2.5] * 8 and s.q[:, 0].tolist() == [0.25, 0.5] * 8


def test_lost_samples_are_said_and_a_wrong_unit_of_time_is_an_error(tmp_path, slide):
    t, q, _, tau = motion(1)
    keep = np.r_[0:300, 340:1000]
    np.savetxt(tmp_path / "log.txt", np.column_stack([t, tau, q])[keep], header="t u x", comments="")
    text = 'sample_rate = 500.0\n[time]\nsource = "t"\nunit = "%s"\n[columns]\ntau_1 = { source = "u", unit = "N" }\nq_1 = { source = "x", unit = "m" }\n'
    (tmp_path / "map.toml").write_text(text % "s")
    said = []
    data = convert_logs([tmp_path / "log.txt"], slide.folder, tmp_path / "map.toml", say=said.append)
    assert len(data.segments[0].t) == 1000 and "1 gaps" in said[0] and "82 ms" in said[0]
    for unit in ("ns", "ms"):
        (tmp_path / "map.toml").write_text(text % unit)
        with pytest.raises(DataError, match="unit of time"):
            convert_logs([tmp_path / "log.txt"], slide.folder, tmp_path / "map.toml")


@pytest.mark.parametrize(
    ("change", "found"),
    [
        ('q_1 = { source = "x", sign = "minus" }', "minus"),
        ('q_1 = { source = "x", gear = 0 }', "zero"),
        ('q_1 = { source = "x", plus = [{ source = "u" }] }', "factor"),
        ('q_1 = { source = "x", unwrap = 1 }', "unwrap"),
        ('q_1 = { source = "x", index = -1 }', "index"),
        ('q_1 = { source = "x" }\n[multisine]\nperiod = 100', "multisine.part"),
        ('q_1 = { source = "x" }\n[multisine]\nperiod = 100\n[[multisine.part]]\nfirst = 2', "last"),
        ('q_1 = { source = "x" }\n[roles]\nlog = "test"', "test"),
        ('q_1 = { source = "x" }\n[sampling]\nrate = 3', "sampling"),
    ],
)
def test_a_map_that_is_wrong_is_one_clear_error(tmp_path, slide, change, found):
    (tmp_path / "log.txt").write_text("u x\n1 2\n3 4\n")
    (tmp_path / "map.toml").write_text('sample_rate = 500.0\n[columns]\ntau_1 = { source = "u" }\n' + change + "\n")
    with pytest.raises(DataError, match=found):
        convert_logs([tmp_path / "log.txt"], slide.folder, tmp_path / "map.toml")


@pytest.mark.parametrize("suffix", [".csv", ".txt", ".mat", ".npz", ".parquet", ".xyz"])
@pytest.mark.parametrize("content", [b"", b"a b c\n1 2\n", b"\x00\xff" * 300, b"MATLAB 5.0 MAT-file" + b"\x01" * 500])
def test_a_damaged_log_is_one_clear_error(tmp_path, slide, suffix, content):
    (tmp_path / f"log{suffix}").write_bytes(content)
    (tmp_path / "map.toml").write_text(
        'sample_rate = 500.0\n[columns]\ntau_1 = { source = "u" }\nq_1 = { source = "x" }\n'
    )
    with pytest.raises(DataError) as caught:
        convert_logs([tmp_path / f"log{suffix}"], slide.folder, tmp_path / "map.toml")
    assert "\n" not in str(caught.value)


# --- a first map


def converted(files, robot, folder):
    guessed = guess_map(files, robot)
    assert not guessed.missing, guessed.text
    (folder / "guessed.toml").write_text(guessed.text)
    return guessed, convert_logs(files, robot, folder / "guessed.toml")


def whole(data, channel):
    return np.concatenate([getattr(s, channel) for s in data.segments])


@pytest.mark.parametrize("angle", [("deg", 180 / np.pi), ("rad", 1.0)])
@pytest.mark.parametrize("time", [("time_ms", 1e3), ("t", 1.0), ("stamp", 1e9)])
@pytest.mark.parametrize("first", [0, 1])
def test_a_guessed_map_brings_a_csv_to_si_units(tmp_path, pair, angle, time, first):
    t, q, qd, tau = motion()
    columns = {time[0]: t * time[1]}
    for j in range(2):
        columns |= {f"pos_{j + first}": q[:, j] * angle[1], f"vel_{j + first}": qd[:, j] * angle[1]}
        columns |= {
            f"pos_ref_{j + first}": q[:, j] * angle[1] + 0.01,
            f"torque_{j + first}": tau[:, j],
            f"temp_{j + first}": 30 + q[:, j],
        }
    np.savetxt(
        tmp_path / "log.csv",
        np.stack(list(columns.values()), axis=1),
        header=",".join(columns),
        comments="",
        delimiter=",",
        fmt="%.15g",
    )
    guessed, data = converted([tmp_path / "log.csv"], pair.folder, tmp_path)
    assert set(guessed.found) == {"time", "tau", "q", "qd", "q_ref", "temp"}
    assert data.sample_rate == 500.0 and [s.role for s in data.segments] == ["identification", "validation"]
    for channel, x in {"q": q, "qd": qd, "tau": tau, "q_ref": q + 0.01 / angle[1], "temp": 30 + q}.items():
        assert np.allclose(whole(data, channel), x, atol=1e-9), channel


def test_a_guessed_map_finds_side_sign_and_layout_of_a_mat_file(tmp_path, pair):
    _, q, qd, tau = motion()
    ratio = np.array([50.0, 100.0])
    sign = np.array([1.0, -1.0])
    rec = {
        "act_theta_mot": (q * ratio).T,
        "motor_torque": (sign * tau / ratio).T,
        "speed_rpm": (qd * ratio * 30 / np.pi).T,
        "encoder_link": q.T + 1e-4,
    }
    scipy.io.savemat(tmp_path / "log.mat", {"log": rec, "other": {"fs": 500.0, "kp": [1.0, 2.0]}, "name": "a text"})
    guessed, data = converted([tmp_path / "log.mat"], pair.folder, tmp_path)
    assert set(guessed.found) == {"tau", "q", "qd", "q_link"} and data.sample_rate == 500.0
    assert (
        np.allclose(whole(data, "q"), q)
        and np.allclose(whole(data, "qd"), qd)
        and np.allclose(whole(data, "q_link"), q + 1e-4)
    )
    assert np.allclose(whole(data, "tau"), tau)
    assert "sign = -1" in guessed.text and "joints 2" in guessed.text


def test_a_guessed_map_takes_columns_by_joint_names_and_runs_as_roles(tmp_path, pair):
    t, q, _, tau = motion()
    for run in ("b", "a"):
        names = ["position.two", "position.one", "effort.two", "effort.one"]
        values = {"stamp": t} | dict(zip(names, [q[:, 1], q[:, 0], tau[:, 1], tau[:, 0]]))
        np.savez(tmp_path / f"{run}.npz", **values)
    _, data = converted([tmp_path / "b.npz", tmp_path / "a.npz"], pair.folder, tmp_path)
    assert [(s.name, s.role) for s in data.segments] == [("b", "identification"), ("a", "validation")]
    assert np.allclose(data.segments[1].q, q) and np.allclose(data.segments[1].tau, tau)


def test_a_guessed_map_joins_files_of_one_value_a_line(tmp_path, pair):
    t, q, _, tau = motion()
    for name, x in {"time": t, "positions": q, "torques": tau}.items():
        np.savetxt(tmp_path / f"run_{name}.txt", x.ravel(), fmt="%.15g")
    guessed, data = converted(sorted(tmp_path.glob("run_*.txt")), pair.folder, tmp_path)
    assert "width = 2" in guessed.text
    assert np.allclose(whole(data, "q"), q) and np.allclose(whole(data, "tau"), tau)


@pytest.mark.slow
def test_what_is_not_found_is_left_to_edit(tmp_path, pair):
    _, q, _, tau = motion()
    np.savez(tmp_path / "log.npz", position=q, alpha=tau, beta=tau)
    run = simgap("convert", tmp_path / "log.npz", "--robot", pair.folder, "--guess", "--map", tmp_path / "map.toml")
    assert run.returncode == 0 and "nothing looks like tau" in run.stdout, run.stderr
    text = (tmp_path / "map.toml").read_text()
    assert "# tau_1" in text and "alpha" in text and "EDIT: Hz" in text
    args = ("convert", tmp_path / "log.npz", "--robot", pair.folder, "--map", tmp_path / "map.toml")
    assert "tau_1" in simgap(*args, "--out", tmp_path / "d").stderr
    for more in ((), ("--guess",)):  # neither without a place for the dataset, nor over an edited map
        run = simgap(*args, *more)
        assert run.returncode == 2 and len(run.stderr.splitlines()) == 1
    assert (tmp_path / "map.toml").read_text() == text
    np.savez(tmp_path / "short.npz", position=q[:5])
    with pytest.raises(DataError, match="no signal of"):
        guess_map([tmp_path / "short.npz"], pair.folder)


def test_a_repeated_motion_is_said(tmp_path, pair):
    _, q, _, tau = motion(N=400)
    np.savez(tmp_path / "log.npz", time=np.arange(2000) / 500.0, q=np.tile(q, (5, 1)), tau=np.tile(tau, (5, 1)))
    guessed, _ = converted([tmp_path / "log.npz"], pair.folder, tmp_path)
    assert "# period = 400" in guessed.text


def test_a_motion_that_repeats_at_one_joint_only_is_none_that_repeats(tmp_path, pair):
    rng = np.random.default_rng(0)
    t = np.arange(3000) / 500.0
    slow = 0.5 * np.cumsum(rng.normal(size=3000)) / 500 + np.sin(1.3 * t)
    for q in (np.stack([np.sin(2 * np.pi * t), slow], axis=1), np.stack([slow, np.sin(2 * np.pi * t)], axis=1)):
        tau = q * [[30.0, 1.0]] + 0.1 * rng.normal(size=q.shape)
        np.savez(tmp_path / "log.npz", time=t, q=q, tau=tau)
        assert "[multisine]" not in guess_map([tmp_path / "log.npz"], pair.folder).text
    # A joint that stands, and shows noise alone, does not hinder.
    still = np.stack([np.sin(2 * np.pi * t), 1e-5 * rng.normal(size=3000)], axis=1)
    np.savez(tmp_path / "log.npz", time=t, q=still, tau=30 * still + 0.1 * rng.normal(size=q.shape))
    assert "# period = 500" in guess_map([tmp_path / "log.npz"], pair.folder).text


def test_a_proposed_multisine_of_several_files_can_be_used_as_written(tmp_path, pair):
    _, q, _, tau = motion(N=400)
    logs = [tmp_path / f"run_{k}.npz" for k in range(3)]
    for log in logs:
        np.savez(log, time=np.arange(2000) / 500.0, q=np.tile(q, (5, 1)), tau=np.tile(tau, (5, 1)))
    text = guess_map(logs, pair.folder).text
    head, proposed = text.split("# [multisine]")
    (tmp_path / "map.toml").write_text(head + "[multisine]" + re.sub("(?m)^# ", "", proposed))
    data = convert_logs(logs, pair.folder, tmp_path / "map.toml")
    assert [(s.name, s.kind, s.role) for s in data.segments] == [
        ("run_0-1", "multisine", "identification"), ("run_1-1", "multisine", "identification"), ("run_2-1", "multisine", "validation"),
    ]  # fmt: skip


# --- ROS 2 recordings and MATLAB 7.3


def write_bag(path, topics):
    """``topics``: name -> list of (stamp ns, joint names, position, velocity, effort)."""
    from mcap_ros2.writer import Writer

    with path.open("wb") as file:
        writer = Writer(file)
        schema = writer.register_msgdef("sensor_msgs/msg/JointState", JOINT_STATE)
        other = writer.register_msgdef("std_msgs/msg/Float64", "float64 data")
        for topic, rows in topics.items():
            for stamp, names, position, velocity, effort in rows:
                header = {"stamp": {"sec": stamp // 10**9, "nanosec": stamp % 10**9}, "frame_id": ""}
                message = {
                    "header": header,
                    "name": names,
                    "position": position,
                    "velocity": velocity,
                    "effort": effort,
                }
                writer.write_message(topic, schema, message, log_time=stamp + 1000, publish_time=stamp)
                writer.write_message("/load", other, {"data": 1.0}, log_time=stamp, publish_time=stamp)
        writer.finish()


@pytest.fixture
def bag(tmp_path):
    """Two joints in an order of their own, and now and then a message of a gripper on the same topic."""
    t, q, qd, tau = motion()
    start = 1_700_000_000_123_456_789
    rows = []
    for k in range(len(t)):
        rows.append(
            (
                start + round(t[k] * 1e9),
                ["two", "one"],
                q[k, ::-1].tolist(),
                qd[k, ::-1].tolist(),
                tau[k, ::-1].tolist(),
            )
        )
        if k % 10 == 5:
            rows.append((start + round(t[k] * 1e9), ["finger"], [0.01], [], []))
    write_bag(tmp_path / "log.mcap", {"/joint_states": rows})
    return tmp_path / "log.mcap", rows


BAG_MAP = """sample_rate = 500.0
[time]
source = "stamp"
[columns]
tau_1 = "effort.one"
tau_2 = "effort.two"
q_1 = "position.one"
q_2 = "position.two"
qd_1 = "velocity.one"
qd_2 = "velocity.two"
"""


def test_joint_states_of_mcap_and_rosbag2_files(tmp_path, pair, bag):
    import sqlite3

    from mcap.reader import make_reader

    _, q, qd, tau = motion()
    with sqlite3.connect(tmp_path / "log.db3") as db, bag[0].open("rb") as file:
        db.execute("CREATE TABLE topics(id INTEGER PRIMARY KEY, name TEXT, type TEXT, serialization_format TEXT)")
        db.execute("CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INTEGER, timestamp INTEGER, data BLOB)")
        db.execute("INSERT INTO topics VALUES (1, '/joint_states', 'sensor_msgs/msg/JointState', 'cdr')")
        for _, _, message in make_reader(file).iter_messages(topics=["/joint_states"]):
            db.execute(
                "INSERT INTO messages(topic_id, timestamp, data) VALUES (1, ?, ?)", (message.log_time, message.data)
            )
    db.close()
    (tmp_path / "map.toml").write_text(BAG_MAP)
    for name in ("log.mcap", "log.db3"):
        s = convert_logs([tmp_path / name], pair.folder, tmp_path / "map.toml").segments[0]
        assert len(s.t) == 1000
        assert np.array_equal(s.q, q) and np.array_equal(s.qd, qd) and np.array_equal(s.tau, tau)


def test_a_guessed_map_of_a_bag(tmp_path, pair, bag):
    _, q, qd, tau = motion()
    guessed, data = converted([bag[0]], pair.folder, tmp_path)
    assert 'source = "stamp"' in guessed.text and data.sample_rate == 500.0
    assert (
        np.allclose(whole(data, "q"), q) and np.allclose(whole(data, "tau"), tau) and np.allclose(whole(data, "qd"), qd)
    )


def test_topics_of_two_arms_and_fields_left_empty(tmp_path, pair, bag):
    rows = bag[1]
    empty = [(stamp, names, position, velocity, []) for stamp, names, position, velocity, _ in rows]
    write_bag(tmp_path / "two.mcap", {"/left/joint_states": rows, "/right/joint_states": empty})
    (tmp_path / "map.toml").write_text(BAG_MAP)
    with pytest.raises(DataError, match="/left/joint_states:"):
        convert_logs([tmp_path / "two.mcap"], pair.folder, tmp_path / "map.toml")
    (tmp_path / "map.toml").write_text(
        re.sub(r'= "(effort|position|velocity|stamp)', r'= "/left/joint_states:\1', BAG_MAP)
    )
    s = convert_logs([tmp_path / "two.mcap"], pair.folder, tmp_path / "map.toml").segments[0]
    assert np.array_equal(s.q, motion()[1])
    (tmp_path / "map.toml").write_text(
        re.sub(r'= "(effort|position|velocity|stamp)', r'= "/right/joint_states:\1', BAG_MAP)
    )
    with pytest.raises(DataError, match=r"no /right/joint_states:effort\.one"):
        convert_logs([tmp_path / "two.mcap"], pair.folder, tmp_path / "map.toml")


@pytest.mark.parametrize("keep", [0, 10, 3000, -200])
@pytest.mark.parametrize("suffix", [".mcap", ".db3"])
def test_a_truncated_bag_is_one_clear_error(tmp_path, pair, bag, keep, suffix):
    (tmp_path / f"cut{suffix}").write_bytes(bag[0].read_bytes()[:keep])
    (tmp_path / "map.toml").write_text(BAG_MAP)
    with pytest.raises(DataError) as caught:
        convert_logs([tmp_path / f"cut{suffix}"], pair.folder, tmp_path / "map.toml")
    assert "\n" not in str(caught.value)


def test_a_bag_without_joint_states_says_so(tmp_path, pair):
    from mcap_ros2.writer import Writer

    with (tmp_path / "log.mcap").open("wb") as file:
        writer = Writer(file)
        schema = writer.register_msgdef("std_msgs/msg/Float64", "float64 data")
        writer.write_message("/load", schema, {"data": 1.0}, log_time=0)
        writer.finish()
    with pytest.raises(DataError, match="no joint states"):
        guess_map([tmp_path / "log.mcap"], pair.folder)


def test_matlab_7_3_files(tmp_path, pair):
    import h5py

    _, q, _, tau = motion()
    with h5py.File(tmp_path / "log.mat", "w", userblock_size=512) as file:
        # As MATLAB writes them: its (N, n) arrays have the shape (n, N) in the file, texts are codes.
        file["rec/position"], file["rec/torque"] = q.T, tau.T
        file["rec/rate"] = np.array([[500.0]])
        file["rec/robot"] = np.frombuffer("pair".encode("utf-16-le"), np.uint16)[:, None]
        file["rec/robot"].attrs["MATLAB_class"] = np.bytes_("char")
        cells = file.create_dataset("#refs#/a", data=np.arange(1000.0))
        file.create_dataset("cell", data=np.array([[cells.ref]], h5py.ref_dtype), dtype=h5py.ref_dtype)
    with (tmp_path / "log.mat").open("r+b") as raw:
        raw.write(b"MATLAB 7.3 MAT-file, Platform: GLNXA64".ljust(124, b" ") + b"\x00\x02IM")
    guessed, data = converted([tmp_path / "log.mat"], pair.folder, tmp_path)
    assert set(guessed.found) == {"tau", "q"} and data.sample_rate == 500.0
    assert np.array_equal(whole(data, "q"), q) and np.array_equal(whole(data, "tau"), tau)
    text = guessed.text.replace("rec.torque", "rec.robot")
    (tmp_path / "map.toml").write_text(text)
    with pytest.raises(DataError, match=r"no rec\.robot"):
        convert_logs([tmp_path / "log.mat"], pair.folder, tmp_path / "map.toml")


# --- published data of real machines, where they stand beside the project


DATA = Path(__file__).parent.parent.parent / "shared" / "data"


def machine(folder, files, robot, tmp_path):
    """The dataset as it is read back from its folder."""
    if not (DATA / folder).is_dir():
        pytest.skip(f"the real data of {folder} are not here")
    paths = [DATA / folder / "raw" / f for f in files]
    save_dataset(convert_logs(paths, robot, folder, name=robot), tmp_path / "d")
    run = simgap("check", tmp_path / "d")
    assert run.returncode == 0 and robot in run.stdout, run.stderr
    return load_dataset(tmp_path / "d")


def roles(data):
    return [(s.name, s.role) for s in data.segments]


def test_the_kr300_agrees_with_its_published_si_signals(tmp_path):
    data = machine("kuka_kr300_dual_encoder", ["FF_A.mat", "FF_B.mat"], "kr300", tmp_path)
    assert roles(data) == [("FF_A", "identification"), ("FF_B", "validation")]
    for s, name in zip(data.segments, "AB"):
        std = np.load(DATA / "kuka_kr300_dual_encoder" / f"std_{name}.npz")
        assert (
            np.array_equal(s.q, std["q_motor"])
            and np.array_equal(s.qd, std["dq_motor"])
            and np.array_equal(s.q_ref, std["q_ref"])
        )
        assert np.array_equal(s.q_link[:, :3], std["q_link"][:, :3]) and np.all(np.isnan(s.q_link[:, 3:]))
        assert np.allclose(s.tau, std["tau_motor"] * std["gear"], rtol=1e-8)
        assert np.all(s.q > data.robot.q_min) and np.all(s.q < data.robot.q_max)


def test_the_emps_agrees_with_its_published_si_signals(tmp_path):
    data = machine("emps_drive", ["DATA_EMPS.mat"], "emps", tmp_path)
    assert [r for _, r in roles(data)] == ["identification", "validation"]
    std = np.load(DATA / "emps_drive" / "std_DATA_EMPS.npz")
    q, force = whole(data, "q")[:, 0], whole(data, "tau")[:, 0]
    assert (
        np.array_equal(q, std["q"])
        and np.allclose(force, std["force"], rtol=1e-12)
        and np.array_equal(whole(data, "q_ref")[:, 0], std["q_ref"])
    )
    # The published model: M = 95.109 kg, Fv = 203.50 N s/m, Fc = 20.394 N, offset -3.165 N.
    b, a = scipy.signal.butter(4, 50 / 500)
    smooth = scipy.signal.filtfilt(b, a, q)
    v = np.gradient(smooth, 1e-3)
    A = np.stack([np.gradient(v, 1e-3), v, np.sign(v), np.ones_like(v)], axis=1)
    both = scipy.signal.decimate(np.column_stack([A, force]), 20, axis=0)[20:-20]
    x = np.linalg.lstsq(both[:, :4], both[:, 4])[0]
    assert x == pytest.approx([95.11, 203.5, 20.39, -3.165], rel=0.02)


def test_the_tx40_agrees_with_its_published_si_signals(tmp_path):
    data = machine("staubli_tx40", ["curr_data.csv", "pos_read_data.csv"], "tx40", tmp_path)
    assert [r for _, r in roles(data)] == ["identification", "validation"]
    std = np.load(DATA / "staubli_tx40" / "std.npz")
    # The map keeps what the motors do; the published signals are those of the joints, motor 6 turns with both.
    q, tau = whole(data, "q"), whole(data, "tau")
    q[:, 5] -= q[:, 4]
    tau[:, 4] += tau[:, 5]
    assert np.allclose(q, std["q"], atol=1e-9) and np.allclose(tau, std["tau"], atol=1e-9)


def test_the_ur10_agrees_with_its_published_si_signals(tmp_path):
    data = machine("ur10_unisa", ["ur10_exciting_trajectory.db3"], "ur10_bare", tmp_path)
    std = np.load(DATA / "ur10_unisa" / "std.npz")
    assert (
        np.array_equal(whole(data, "q"), std["q"])
        and np.array_equal(whole(data, "qd"), std["dq"])
        and np.array_equal(whole(data, "tau"), std["tau"])
    )


def test_the_panda_agrees_with_its_published_si_signals(tmp_path):
    files = [f"exciting_traj_{kind}.txt" for kind in ("time", "positions", "velocity", "torques")]
    data = machine("panda_gaz_ral2019", files, "panda_bare", tmp_path)
    std = np.load(DATA / "panda_gaz_ral2019" / "std.npz")
    t = np.concatenate([s.t - s.t[0] + k * len(data.segments[0].t) * 1e-3 for k, s in enumerate(data.segments)])
    for channel, source in (("q", "q"), ("qd", "dq"), ("tau", "tau_J")):
        expected = np.stack([np.interp(t, std["t"], x) for x in std[source].T], axis=1)
        assert np.allclose(whole(data, channel), expected, atol=1e-9)


def rigid_r2(data, coulomb):
    """(n,) share of the validation torque that rigid bodies, motor inertia and fitted friction explain."""
    robot = data.robot
    model = pin.buildModelFromUrdf(str(robot.urdf))
    J, rate, rows = robot.array("motor_inertia"), data.sample_rate, {}
    b, a = scipy.signal.butter(3, 8 / (rate / 2))
    for s in data.segments:
        q, tau = scipy.signal.filtfilt(b, a, s.q, axis=0), scipy.signal.filtfilt(b, a, s.tau, axis=0)
        v = np.gradient(q, 1 / rate, axis=0)
        acc = np.gradient(v, 1 / rate, axis=0)
        pick = slice(int(0.2 * rate), -int(0.2 * rate), max(1, int(rate / 100)))
        q, v, acc, tau = q[pick], v[pick], acc[pick], tau[pick]
        rigid = np.array([pin.rnea(model, model.createData(), *x) for x in zip(q, v, acc)]) + J * acc
        rows[s.role] = (v, q, tau - rigid, tau)
    out = []
    for j in range(robot.n):
        columns = [
            np.stack([np.tanh(v[:, j] / coulomb), v[:, j], np.ones(len(v)), np.sin(q[:, j])], axis=1)
            for v, q, _, _ in rows.values()
        ]
        x = np.linalg.lstsq(columns[0], rows["identification"][2][:, j])[0]
        rest = rows["validation"][2][:, j] - columns[1] @ x
        out.append(1 - np.var(rest) / np.var(rows["validation"][3][:, j]))
    return np.array(out)


@pytest.mark.parametrize(
    ("folder", "files", "robot", "least"),
    [
        ("kuka_kr300_dual_encoder", ["FF_A.mat", "FF_B.mat"], "kr300", 0.75),
        ("staubli_tx40", ["curr_data.csv", "pos_read_data.csv"], "tx40", 0.85),
        ("ur10_unisa", ["ur10_exciting_trajectory.db3"], "ur10_bare", 0.85),
        (
            "panda_gaz_ral2019",
            [f"exciting_traj_{k}.txt" for k in ("time", "positions", "velocity", "torques")],
            "panda_bare",
            0.9,
        ),
    ],
)
def test_the_robot_of_each_machine_explains_its_torque(tmp_path, folder, files, robot, least):
    """Signs, zeros, axes, units and sides are right: any one wrong leaves next to nothing explained."""
    r2 = rigid_r2(machine(folder, files, robot, tmp_path), 0.02)
    assert np.all(r2 > least), r2


@pytest.mark.parametrize("name", ["kr300", "tx40", "emps", "ur10_bare", "panda_bare"])
def test_both_engines_build_the_robots_of_the_real_data(name):
    from ident.chain import build_structure
    from sim.plant import build_plant, link_inertia_diagonal

    robot = load_robot(name)
    q = np.clip(np.zeros(robot.n), robot.q_min, robot.q_max)
    model = build_structure(robot).model
    ours = np.diag(pin.crba(model, model.createData(), q)) + robot.array("motor_inertia")
    assert ours == pytest.approx(link_inertia_diagonal(build_plant(robot), q), rel=1e-6)


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("rec.actPos_mot1", ("rec", "act", "pos", "mot")),
        ("Achse3_Istpos_Motor", ("achse", "ist", "pos", "motor")),
        ("Sollposition_A2", ("soll", "position", "a")),
        ("Motormoment", ("motor", "moment")),
        ("history", ("history",)),
    ],
)
def test_words_of_a_column_are_taken_apart(name, words):
    assert words_of(name) == words
