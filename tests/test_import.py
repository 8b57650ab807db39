"""What a user brings: a URDF, logs of several formats, a first map, the published data of real machines."""

from __future__ import annotations

import subprocess
import sys
import tomllib

import numpy as np
import pinocchio as pin
import pytest

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
    assert joint.torque_limit == 150.0 if "150" in limit else joint.torque_limit > (2 * 12 * 9.8 if axis[-1] == "1" else 0)
    text = (tmp_path / "slide" / "robot.toml").read_text()
    assert "N s/m" in text and "GUESS" in text and "rad" not in text.split("[[joint]]")[1]


def test_the_command_writes_a_robot_that_loads_and_simulates(tmp_path):
    urdf = load_robot("panda").urdf
    run = simgap("robot", urdf, "--out", tmp_path / "arm", "--lock", "panda_finger_joint1=0.02")
    assert run.returncode == 0 and "GUESS" in run.stdout, run.stderr
    robot = load_robot(tmp_path / "arm")
    assert robot.n == 7 and robot.locked == {"panda_finger_joint1": 0.02, "panda_finger_joint2": 0.0}
    assert robot.array("torque_limit").tolist() == [87.0] * 4 + [12.0] * 3
    written = (tmp_path / "arm" / "robot.toml").read_text()
    assert tomllib.loads(written)["name"] == "arm"
    again = simgap("robot", urdf, "--out", tmp_path / "arm")
    assert again.returncode == 2 and len(again.stderr.splitlines()) == 1
    assert (tmp_path / "arm" / "robot.toml").read_text() == written

    from sim.plant import build_plant, link_inertia_diagonal

    assert np.all(link_inertia_diagonal(build_plant(robot), np.zeros(7)) > robot.array("motor_inertia"))


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
