"""URDFs that no arm has: refused with the joint or link at fault, or told in a line of warning."""

import warnings

import numpy as np
import pytest

from ident.candidates import build_body
from ident.chain import build_structure
from ident.graybox import linearise
from robot_assets.errors import DataError
from robot_assets.from_urdf import write_robot
from robot_assets.robot import load_robot
from tests.test_cli import simgap as run

ARM = """<robot name="arm"><link name="base"/>
<link name="upper"><inertial><origin xyz="0.2 0 0"/><mass value="3"/><inertia ixx="0.01" iyy="0.05" izz="0.05"/></inertial></link>
<link name="hand"><inertial><origin xyz="0.1 0 0"/><mass value="1"/><inertia ixx="0.01" iyy="0.01" izz="0.01"/></inertial></link>
<joint name="shoulder" type="revolute"><parent link="base"/><child link="upper"/><axis xyz="0 1 0"/>
  <limit lower="-2" upper="2" effort="80" velocity="3"/></joint>
<joint name="wrist" type="revolute"><parent link="upper"/><child link="hand"/><origin xyz="0.4 0 0"/><axis xyz="0 0 1"/>
  <limit lower="-1" upper="1" effort="20" velocity="3"/></joint></robot>"""
UPPER = '<mass value="3"/><inertia ixx="0.01" iyy="0.05" izz="0.05"/>'


def written(folder, old="", new="", lock=None):
    assert old in ARM
    (folder / "arm.urdf").write_text(ARM.replace(old, new, 1))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        return write_robot(folder / "arm.urdf", folder / "out", lock)


@pytest.mark.parametrize(
    ("old", "new", "found"),
    [
        (
            '"0 1 0"',
            '"0 1e-300 0"',
            "axis of joint shoulder: .*arm.urdf: found a vector of 1e-300, expected a direction",
        ),
        ('"0 1 0"', '"0 1e-160 0"', "axis of joint shoulder"),
        (
            UPPER,
            '<mass value="9e14"/><inertia ixx="9e14" iyy="9e14" izz="9e14"/>',
            "joint shoulder: .*arm.urdf: found .* carried, which gives .* = ",
        ),
        (
            "</joint></robot>",
            '<mimic joint="shoulder" multiplier="nan"/></joint></robot>',
            "multiplier of the mimic of joint wrist: .*'nan'",
        ),
        (
            "</joint></robot>",
            '<mimic joint="shoulder" offset="left"/></joint></robot>',
            "offset of the mimic of joint wrist: .*'left'",
        ),
    ],
)
def test_what_no_robot_can_be_made_of_names_the_urdf_and_the_joint(tmp_path, old, new, found):
    with pytest.raises(DataError, match=found) as caught:
        written(tmp_path, old, new)
    assert "robot.toml" not in str(caught.value) and not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("old", "new", "told"),
    [
        (
            UPPER,
            '<mass value="3"/><inertia ixx="10000" iyy="30000" izz="30000"/>',
            "the inertia of link upper is 3e+04 kg m2 at 3 kg, as of a body of 100 m: in kg mm2 or g mm2?",
        ),
        ('"0.2 0 0"', '"200 0 0"', "the centre of mass of link upper is 200 m off: in mm?"),
        ('"0.4 0 0"', '"400 0 0"', "joint wrist is 400 m off its link: in mm?"),
        (
            'lower="-1" upper="1"',
            'lower="-170" upper="170"',
            "the limits of joint wrist are -170 to 170 rad: in degrees?",
        ),
        (
            UPPER,
            '<mass value="3"/><inertia ixx="0.1" iyy="0.1" izz="0.3"/>',
            "link upper has moments of inertia of 0.1, 0.1 and 0.3 kg m2: of a body the largest is no more than the others together",
        ),
        ('lower="-1" upper="1"', 'lower="0" upper="0.0"', "joint wrist has no limits in the URDF: a turn is taken"),
        (
            'lower="-1" upper="1"',
            'lower="-1e16" upper="inf"',
            "joint wrist has no limits in the URDF: a turn is taken",
        ),
        (
            'lower="-1" upper="1"',
            'lower="4" upper="1e16"',
            "joint wrist has a limit to one side alone in the URDF: a turn or more is taken",
        ),
        ('lower="-1" upper="1"', "", "joint wrist has no limits in the URDF: a turn is taken"),
        ('effort="20"', 'effort="many"', "effort of joint wrist is 'many', which is no limit: one is guessed"),
        ('velocity="3"', 'velocity="-3"', "velocity of joint shoulder is '-3', which is no limit: one is guessed"),
        ('effort="20"', 'effort="0"', None),
    ],
)
def test_what_is_hardly_so_is_told(tmp_path, old, new, told):
    _, found = written(tmp_path, old, new)
    assert found == (() if told is None else (told,))
    assert told is None or f"# CHECK: {told}" in (tmp_path / "out" / "robot.toml").read_text()


@pytest.mark.parametrize(("at", "refused"), [(0.5, False), (1.0, False), (1.2, True), (-9.0, True)])
def test_a_joint_is_locked_within_its_limits(tmp_path, at, refused):
    if refused:
        with pytest.raises(
            DataError, match=f"--lock: .*arm.urdf: found wrist={at:g}, expected a position within its limits, -1 to 1"
        ):
            written(tmp_path, lock={"wrist": at})
    else:
        assert written(tmp_path, lock={"wrist": at})[0].locked == {"wrist": at}


def test_the_command_prints_what_is_hardly_so(tmp_path):
    (tmp_path / "arm.urdf").write_text(ARM.replace('"0.2 0 0"', '"200 0 0"'))
    result = run("robot", tmp_path / "arm.urdf", "--out", tmp_path / "out")
    assert (
        result.returncode == 0
        and "warning: the centre of mass of link upper is 200 m off" in result.stdout
        and not result.stderr
    )
    assert load_robot(tmp_path / "out").n == 2


@pytest.mark.parametrize("kind", ["revolute", "prismatic"])
@pytest.mark.parametrize("limit", ["", '<limit effort="80"/>', '<limit lower="-2" upper="2"/>'])
def test_a_joint_that_says_nothing_of_its_limits_is_like_any_other(tmp_path, capfd, kind, limit):
    """Some readers refuse a joint without a limit, or without its effort or velocity."""
    given = '<limit lower="-2" upper="2" effort="80" velocity="3"/>'
    chains, postures = [], np.array([0.3, -0.2])
    for name, text in (("with", given), ("without", limit)):
        (tmp_path / name).mkdir()
        of = ARM.replace('name="shoulder" type="revolute"', f'name="shoulder" type="{kind}"').replace(given, text)
        (tmp_path / name / "arm.urdf").write_text(of)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            write_robot(tmp_path / name / "arm.urdf", tmp_path / name / "out", None)
        robot = load_robot(tmp_path / name / "out")
        chains.append(linearise(build_structure(robot), postures))
        build_body(robot, np.random.default_rng(0))
    assert np.array_equal(chains[0].M, chains[1].M) and np.array_equal(chains[0].g, chains[1].g)
    assert capfd.readouterr().err == ""


def test_products_of_inertia_that_are_not_said_are_none(tmp_path, capfd):
    """A reader that misses one of them leaves out the whole tensor."""
    given = ARM.replace("ixx=", 'ixy="0" ixz="0" iyz="0" ixx=')
    tensors = []
    for name, text in (("with", given), ("without", ARM)):
        (tmp_path / name).mkdir()
        (tmp_path / name / "arm.urdf").write_text(text)
        write_robot(tmp_path / name / "arm.urdf", tmp_path / name / "out", None)
        structure = build_structure(load_robot(tmp_path / name / "out"))
        tensors.append([i.inertia for i in structure.model.inertias])
    assert np.array_equal(tensors[0], tensors[1]) and np.trace(tensors[1][1]) == pytest.approx(0.11)
    assert capfd.readouterr().err == ""
