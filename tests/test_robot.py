"""Robot folders."""

import re
from dataclasses import replace

import numpy as np
import pytest

from robot_assets.errors import DataError
from robot_assets.from_urdf import draft_robot
from robot_assets.robot import load_robot
from robot_assets.spelling import OTHER_NAMES


def test_ur10_has_the_documented_figures(ur10):
    assert ur10.n == 6
    assert ur10.array("stiffness").tolist() == [5e4, 5e4, 2.5e4, 8e3, 8e3, 8e3]
    assert ur10.array("motor_inertia").tolist() == [2.0, 2.0, 0.9, 0.2, 0.2, 0.2]
    assert ur10.loads[0].mass == 8.0 and np.allclose(ur10.loads[0].com, [0.03, 0.17, 0.05])


def _folder(tmp_path, ur10, old="", new=""):
    text = (ur10.folder / "robot.toml").read_text()
    assert old in text
    (tmp_path / "robot.toml").write_text(text.replace(old, new, 1))
    return tmp_path


@pytest.mark.parametrize(
    ("old", "new", "found"),
    [
        ('name = "elbow_joint"', 'name = "knee"', "knee"),
        ("stiffness = 5.0e4", "stiffness = -1.0", "-1.0"),
        ("stiffness = 5.0e4", 'stiffness = "soft"', "soft"),
        ("motor_inertia = 2.0\n", "", "no such key"),
        ("ur10_robot.urdf", "none.urdf", "none.urdf"),
        ('link = "wrist_3_link"', 'link = "hand"', "hand"),
        ("damping = 30.0", "damping = 30.0\nspring_damping = 30.0", "damping beside it"),
        ("[urdf]", "[[[", "invalid TOML"),
    ],
)
def test_a_wrong_robot_is_one_clear_error(tmp_path, ur10, old, new, found):
    with pytest.raises(DataError) as caught:
        load_robot(_folder(tmp_path, ur10, old, new))
    assert found in str(caught.value) and "robot.toml" in str(caught.value) and "\n" not in str(caught.value)


def test_what_a_robot_may_leave_out_is_of_its_urdf_or_guessed(tmp_path):
    """Limits, noise and the link that bears a payload; a path alone for the URDF."""
    limits = ('<limit lower="-1" upper="1" effort="40" velocity="3"/>', '<limit lower="0" upper="0.2"/>')
    kinds = ("revolute", "prismatic")
    joints = "".join(
        f'<joint name="j{i}" type="{k}"><parent link="l{i}"/><child link="l{i + 1}"/><axis xyz="0 0 1"/>{limit}</joint>'
        for i, (k, limit) in enumerate(zip(kinds, limits, strict=True))
    )
    links = "".join(f'<link name="l{i}"/>' for i in range(3))
    (tmp_path / "arm.urdf").write_text(f'<robot name="arm">{links}{joints}</robot>')
    drive = "gear_ratio = 100\nmotor_inertia = 0.5\nstiffness = 1.5e4\ndamping = 3.0\nviscous_friction = 2.0\n"
    (tmp_path / "robot.toml").write_text(
        'urdf = "arm.urdf"\n' + "".join(f'[[joint]]\nname = "j{i}"\n{drive}' for i in range(2))
    )
    by_file = (tmp_path / "robot.toml").read_text()
    robot = load_robot(tmp_path)
    assert robot.array("torque_limit") == pytest.approx([40.0, 100.0])
    assert robot.array("velocity_limit") == pytest.approx([3.0, 1.0])
    assert robot.array("q_std") == pytest.approx([3e-6, 1e-6])
    assert robot.array("tau_std") == pytest.approx([4e-3, 1e-2])
    assert robot.payload_link == "l2"
    other = by_file.replace("\ndamping", "\nq_noise_std = 2e-5\ntorque_max = 9.0\nspring_damping")
    (tmp_path / "robot.toml").write_text('flange = "l1"\n' + other)
    same = load_robot(tmp_path)
    assert same.payload_link == "l1" and np.array_equal(same.array("damping"), robot.array("damping"))
    assert np.all(same.array("q_std") == 2e-5) and np.all(same.array("torque_limit") == 9.0)


@pytest.mark.parametrize(("key", "other"), [(key, other) for key, others in OTHER_NAMES.items() for other in others])
def test_a_figure_goes_by_its_other_names(tmp_path, ur10, key, other):
    """Each is read as the figure that it is another name of, which the text does not have then."""
    text = (ur10.folder / "robot.toml").read_text()
    head, *joints = text.split("[[joint]]\n")
    joints = [re.sub(rf"^{key} = .*\n", "", own, flags=re.M) for own in joints]
    (tmp_path / "robot.toml").write_text(head + "".join(f"[[joint]]\n{other} = 2.5\n{own}" for own in joints))
    assert np.all(load_robot(tmp_path).array(key) == 2.5)


TWO = ("shoulder", "elbow")
FIGURES = {"gear_ratio": (100.0, 50.0), "motor_inertia": (2.0, 1.0), "stiffness": (4e4, 1e4), "damping": (30.0, 8.0)}
FIGURES |= {"viscous_friction": (15.0, 6.0)}
LISTS = "".join(f"{key} = {list(values)}\n" for key, values in FIGURES.items())
EACH = tuple("".join(f"{key} = {values[i]}\n" for key, values in FIGURES.items()) for i in range(2))
LISTED = 'joints = ["shoulder", "elbow"]\n'
NAMED = 'names = ["shoulder", "elbow"]\n'


def planar(folder, drives, efforts=(40.0, 40.0)):
    """An arm of two joints whose drives are written in some way; ``efforts`` are limits of their torques, N m."""
    joints = "".join(
        f'<joint name="{name}" type="revolute"><parent link="l{i}"/><child link="l{i + 1}"/><axis xyz="0 0 1"/>'
        f'<limit lower="-1" upper="1" effort="{efforts[i]}" velocity="3"/></joint>'
        for i, name in enumerate(TWO)
    )
    inertia = '<inertia ixx="0.1" iyy="0.1" izz="0.1" ixy="0" ixz="0" iyz="0"/>'
    links = "".join(f'<link name="l{i}"><inertial><mass value="3"/>{inertia}</inertial></link>' for i in range(3))
    (folder / "arm.urdf").write_text(f'<robot name="arm">{links}{joints}</robot>')
    (folder / "robot.toml").write_text(f'urdf = "arm.urdf"\n{drives}')
    return folder


@pytest.mark.parametrize(
    "drives",
    [
        "".join(f'[[joint]]\nname = "{name}"\n{own}' for name, own in zip(TWO, EACH, strict=True)),
        "".join(f'[[drives]]\njoint = "{name}"\n{own}' for name, own in zip(TWO, EACH, strict=True)),
        "".join(f"[joints.{name}]\n{own}" for name, own in zip(TWO, EACH, strict=True)),
        f"[drives]\n{NAMED}{LISTS}",
        f'joints = ["shoulder", "elbow"]\n[drives]\n{LISTS}',
        LISTED + "".join(f'[[drive]]\njoint = "{TWO[i]}"\n{EACH[i]}' for i in (1, 0)),
        LISTED + "".join(f"[[drive]]\n{own}" for own in EACH),
        LISTED + "".join(f"[drives.{name}]\n{own}" for name, own in zip(TWO, EACH, strict=True)),
    ],
)
def test_drives_are_read_in_each_way_of_writing_them_down(tmp_path, drives):
    robot = load_robot(planar(tmp_path, f"{drives}[noise]\nq_std = 2e-6\ntau_std = [0.1, 0.02]\n"))
    assert robot.joint_names == TWO
    assert {key: tuple(robot.array(key)) for key in FIGURES} == FIGURES
    assert robot.array("q_std").tolist() == [2e-6, 2e-6] and robot.array("tau_std").tolist() == [0.1, 0.02]


DRIVES = f"[drives]\n{NAMED}{LISTS}"
LOAD = "mass = 3.0\ncom = [0.0, 0.1, 0.0]\n"


@pytest.mark.parametrize(
    "loads",
    [f'[[load]]\nlink = "l1"\n{LOAD}', f'[load]\nlink = "l1"\n{LOAD}', f"payload_link = 'l1'\n[payload]\n{LOAD}"],
)
def test_a_load_is_read_in_each_way_of_writing_it_down(tmp_path, loads):
    """That of a link or, where none is said, at the flange."""
    (load,) = load_robot(planar(tmp_path, loads + DRIVES)).loads
    assert (load.link, load.mass, load.com.tolist()) == ("l1", 3.0, [0.0, 0.1, 0.0])


def test_limits_for_all_joints_give_way_to_those_of_one(tmp_path):
    limits = "payload = 150\n[limits]\neffort = [9.0, 8.0]\nvelocity = 2.0\n"
    robot = load_robot(
        planar(
            tmp_path,
            f'{limits}[[joint]]\nname = "shoulder"\ntorque_max = 7.0\n{EACH[0]}[[joint]]\nname = "elbow"\n{EACH[1]}',
        )
    )
    assert robot.array("torque_limit").tolist() == [7.0, 8.0] and robot.array("velocity_limit").tolist() == [2.0, 2.0]
    assert not robot.loads and not robot.guessed["torque_limit"]


def test_limits_and_noise_may_have_a_table_of_each_joint(tmp_path):
    limits = "[limits.shoulder]\ntorque = 7.0\nvelocity = 1.5\n[limits.elbow]\neffort_limit = 8.0\n"
    robot = load_robot(planar(tmp_path, f"{DRIVES}{limits}[noise.elbow]\nq_std = 4e-6\n"))
    assert robot.array("torque_limit").tolist() == [7.0, 8.0] and robot.array("velocity_limit").tolist() == [1.5, 3.0]
    assert robot.array("q_std").tolist() == [3e-6, 4e-6]


@pytest.mark.parametrize(
    ("drives", "found"),
    [
        ("", "none"),
        (f"[drives]\n{LISTS}", "gear_ratio"),
        (f"[drives]\n{NAMED}{LISTS.replace('[2.0, 1.0]', '[2.0]')}", "[2.0]"),
        (f"[drives]\n{NAMED}{LISTS.replace('[2.0, 1.0]', '2.0')}", "2.0"),
        (f"[drives]\n{NAMED}{LISTS}[noise]\nq_std = [1e-6]", "1e-06"),
        ('joints = ["shoulder", "elbow"]\ndrives = 3', "3"),
        (f'[[joint]]\nname = "shoulder"\n{EACH[0]}[[drive]]\njoint = "elbow"\n{EACH[1]}', "[[joint]] beside it"),
        (f"[[drive]]\n{EACH[0]}", "no such key"),
        (f"[[drive]]\njoint = 3\n{EACH[0]}", "3"),
        ("joint = 3", "3"),
        (f"{DRIVES}[load]\n{LOAD}[[loads]]\n{LOAD}", "[[load]] beside it"),
        (f"{DRIVES}[limits]\neffort = [1.0]", "[1.0]"),
        (f"{DRIVES}[limits]\neffort = 1.0\ntorque_max = 1.0", "torque_max beside it"),
        (f"{DRIVES}[limits.elbow]\neffort = 1.0\n[limits.wrist]\neffort = 1.0", "[limits.wrist]"),
        (f'{LISTED}[[drive]]\njoint = "shoulder"\n{EACH[0]}', "drives of ['shoulder']"),
        (LISTED + f'[[drive]]\njoint = "elbow"\n{EACH[0]}' * 2, "drives of ['elbow', 'elbow']"),
        (f"{LISTED}[[drive]]\n{EACH[0]}[[joint]]\n{EACH[1]}", "[[joint]] beside it"),
        (f'[[joint]]\nname = "shoulder"\n{EACH[0]}[[joint]]\nname = "elbow"\ndamping = 3.0', "no such key"),
    ],
)
def test_drives_written_otherwise_are_one_clear_error(tmp_path, drives, found):
    with pytest.raises(DataError) as caught:
        load_robot(planar(tmp_path, drives))
    assert found in str(caught.value) and "robot.toml" in str(caught.value) and "\n" not in str(caught.value)


def test_drives_of_which_nothing_is_said_are_guessed_from_the_bodies(tmp_path):
    """As ``simgap robot`` would, of those joints alone, and beside what is said."""
    folder = planar(tmp_path, f"{LISTED}[[drive]]\ngear_ratio = 80.0\ntorque_limit = 25.0\n[[drive]]\n{EACH[1]}")
    robot, (guess, _) = load_robot(folder), (g.joint for g in draft_robot(folder / "arm.urdf").guesses)
    assert robot.guessed["stiffness"] == ("shoulder",) and robot.guessed["gear_ratio"] == ()
    assert robot.joints[0] == replace(guess, gear_ratio=80.0, torque_limit=25.0)
    assert robot.joints[1].stiffness == FIGURES["stiffness"][1]
    (folder / "robot.toml").write_text(f'urdf = "arm.urdf"\n{LISTED}')
    assert [j.stiffness for j in load_robot(folder).joints] == [
        g.joint.stiffness for g in draft_robot(folder / "arm.urdf").guesses
    ]


@pytest.mark.parametrize(("efforts", "believed"), [((1e4, 1e4), False), ((1e4, 2e3), True), ((4.0, 4.0), True)])
def test_one_limit_of_all_torques_that_is_far_too_high_is_a_placeholder(tmp_path, efforts, believed):
    folder = planar(tmp_path, LISTED, efforts)
    torques = load_robot(folder).array("torque_limit")
    assert np.array_equal(torques, efforts) == believed
    assert believed or np.all(torques < 100.0)


def test_an_unknown_robot_lists_the_known_ones():
    with pytest.raises(DataError, match="ur10"):
        load_robot("no-such-arm")


def test_a_robot_beside_the_file_that_names_it_is_meant(tmp_path, ur10):
    """Though a robot of the project has its name: this one hangs on a wall."""
    assert load_robot("ur10", tmp_path).gravity == ur10.gravity
    (tmp_path / "ur10").mkdir()
    _folder(tmp_path / "ur10", ur10, "gravity = [0.0, 0.0, -9.81]", "gravity = [0.0, -9.81, 0.0]")
    assert load_robot("ur10", tmp_path).gravity == (0.0, -9.81, 0.0)
    assert load_robot("ur10").gravity == ur10.gravity


def test_entities_in_a_urdf_are_refused(tmp_path, ur10):
    folder = _folder(tmp_path, ur10, 'package = "example-robot-data"\n', "")
    text = (folder / "robot.toml").read_text().replace("robots/ur_description/urdf/ur10_robot.urdf", "bomb.urdf")
    (folder / "robot.toml").write_text(text)
    (folder / "bomb.urdf").write_text('<!DOCTYPE r [<!ENTITY a "aa">]><robot name="&a;"/>')
    with pytest.raises(DataError, match="entity"):
        load_robot(folder)
