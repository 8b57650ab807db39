"""The arms that come with the project: their figures, and that both models describe the same bodies."""

import re
import xml.etree.ElementTree as ET
from dataclasses import replace

import mujoco
import numpy as np
import pinocchio as pin
import pytest
import scipy.linalg

from ident.candidates import build_body
from ident.chain import build_structure
from ident.excitation import operating_points
from ident.graybox import Parameters, equilibrium, linearise, stiffness_diagonal
from robot_assets.robot import Elasticity, load_robot
from sim import run_experiment
from sim.plant import build_plant, rest
from tests.conftest import small_plan


@pytest.fixture(scope="module")
def irb():
    return load_robot("irb")


def undamped_frequencies(structure, par, q_m):
    """Hz: (N,) with the motors held, and the upper N of those with the motors free (the lower n are rigid)."""
    lin = linearise(structure, equilibrium(structure, par, q_m))
    n, N = structure.n, structure.n_coordinates
    S = np.zeros((N, n))
    S[structure.driven, np.arange(n)] = par.stiffness
    link = np.diag(stiffness_diagonal(structure, par)) + lin.Kg
    held = scipy.linalg.eigh(link, lin.M, eigvals_only=True)
    K = np.block([[np.diag(par.stiffness), -S.T], [-S, link]])
    free = scipy.linalg.eigh(K, scipy.linalg.block_diag(np.diag(par.inertia), lin.M), eigvals_only=True)
    return np.sqrt(held) / 2 / np.pi, np.sqrt(np.maximum(free[n:], 0)) / 2 / np.pi


def test_links_may_bear_the_names_of_joints(irb, tmp_path):
    """Which Pinocchio cannot tell apart by itself."""
    for file in irb.folder.iterdir():
        if file.is_file():
            (tmp_path / file.name).write_text(re.sub(r"\blink_(\d)", r"joint_\1", file.read_text()))
    same = load_robot(tmp_path)
    ours, theirs = build_structure(irb), build_structure(same)
    q = np.linspace(-0.5, 0.5, ours.model.nq)
    assert np.array_equal(*(pin.crba(s.model, s.model.createData(), q) for s in (ours, theirs)))
    assert sorted(theirs.bodies) == ["base_link", *irb.joint_names]
    assert build_body(same, np.random.default_rng(0)).flange == build_body(irb, np.random.default_rng(0)).flange
    assert build_plant(same).model.nv == build_plant(irb).model.nv


@pytest.mark.parametrize(
    ("low", "high", "read"),
    [
        ("-1", "2", (-1.0, 2.0)),
        ("0", "0", (-np.pi, np.pi)),
        ("-inf", "inf", (-np.pi, np.pi)),
        ("4", "1e16", (4.0, 4.0 + 2.0 * np.pi)),
        ("-inf", "1", (1.0 - 2.0 * np.pi, 1.0)),
    ],
)
def test_limits_without_bound_are_those_of_a_turn(tmp_path, low, high, read):
    """Which Pinocchio reads too."""
    text = load_robot("twomass").urdf.read_text().replace('type="continuous"', 'type="revolute"')
    text = re.sub("<limit [^>]*/>", "", text)
    limit = f'<limit lower="{low}" upper="{high}" effort="1" velocity="1"/></joint>'
    for file in load_robot("twomass").folder.iterdir():
        if file.is_file():
            (tmp_path / file.name).write_text(file.read_text())
    (tmp_path / "twomass.urdf").write_text(text.replace("</joint>", limit, 1))
    robot = load_robot(tmp_path)
    assert (robot.q_min[0], robot.q_max[0]) == pytest.approx(read)
    assert build_structure(robot).n == 1


@pytest.mark.parametrize("kind", ["revolute", "continuous", "prismatic"])
@pytest.mark.parametrize("axis", ["1 0 0", "0 -1 0", "0 0 2", "1 -2 0.5"])
def test_joints_of_any_kind_turn_about_any_axis(tmp_path, kind, axis):
    """A URDF "continuous" joint has two coordinates in Pinocchio, under names of their own about most axes."""
    (tmp_path / "arm.urdf").write_text(f"""<robot name="arm"><link name="base"/><link name="beam"><inertial>
      <origin xyz="0.3 0.2 -0.1"/><mass value="2"/>
      <inertia ixx="0.1" iyy="0.2" izz="0.25" ixy="0" ixz="0.01" iyz="0"/></inertial></link>
      <joint name="axle" type="{kind}"><parent link="base"/><child link="beam"/><axis xyz="{axis}"/>
      <limit lower="-1" upper="1" effort="10" velocity="1"/></joint></robot>""")
    (tmp_path / "robot.toml").write_text("""name = "arm"
urdf = "arm.urdf"
[[joint]]
name = "axle"
gear_ratio = 50.0
motor_inertia = 1.0
stiffness = 1000.0
damping = 1.0
viscous_friction = 1.0
""")
    robot = load_robot(tmp_path)
    structure, plant = build_structure(robot), build_plant(robot)
    (q,) = equilibrium(structure, Parameters.nominal(robot), np.zeros(1))
    lin = linearise(structure, np.array([q]))
    assert structure.n_coordinates == 1
    data = mujoco.MjData(plant.model)
    data.qpos[:] = q
    mujoco.mj_forward(plant.model, data)
    M = np.zeros((plant.model.nv, plant.model.nv))
    mujoco.mj_fullM(plant.model, data, M)
    at = plant.link[0]
    assert lin.M[0, 0] == pytest.approx(M[at, at], rel=1e-9)
    assert lin.g[0] == pytest.approx(data.qfrc_bias[at], rel=1e-9, abs=1e-9)


def test_irb_has_six_springs_along_its_axes_and_six_across(irb):
    assert irb.n == 6
    assert [e.joint for e in irb.elasticities] == [f"joint_{j}" for j in (1, 1, 2, 2, 3, 3)]
    axes = {
        j.get("name"): np.array([float(v) for v in j.find("axis").get("xyz").split()])
        for j in ET.parse(irb.urdf).getroot().findall("joint")
    }
    for e in irb.elasticities:
        assert abs(axes[e.joint] @ e.axis) < 1e-12 and np.isclose(np.linalg.norm(e.axis), 1)
    assert np.all((irb.array("gear_ratio") >= 50) & (irb.array("gear_ratio") <= 200))
    assert np.all(irb.array("motor_inertia") / irb.array("gear_ratio") ** 2 < 0.02)


def test_irb_inertias_are_those_of_its_capsules(irb):
    """Solid capsule of uniform density: a cylinder and two half balls moved out by its half length."""
    turned = {"0 0 0": 2, "1.5707963267948966 0 0": 1, "0 1.5707963267948966 0": 0}
    for link in ET.parse(irb.urdf).getroot().findall("link"):
        inertial, shape = link.find("inertial"), link.find("collision")
        assert inertial.find("origin").get("xyz") == shape.find("origin").get("xyz")
        capsule = shape.find("geometry/capsule")
        r, l = float(capsule.get("radius")), float(capsule.get("length"))
        balls = (4 / 3 * r) / (l + 4 / 3 * r) * float(inertial.find("mass").get("value"))
        tube = float(inertial.find("mass").get("value")) - balls
        along = tube * r**2 / 2 + balls * 0.4 * r**2
        across = tube * (r**2 / 4 + l**2 / 12) + balls * (0.4 * r**2 + l**2 / 4 + 3 / 8 * l * r)
        expected = np.full(3, across)
        expected[turned[shape.find("origin").get("rpy")]] = along
        I = inertial.find("inertia")
        assert np.allclose([float(I.get(k)) for k in ("ixx", "iyy", "izz")], expected, rtol=1e-5)


def test_irb_reaches_and_carries_what_its_class_does(irb):
    model = build_structure(irb).model
    data = model.createData()
    pin.forwardKinematics(model, data, pin.neutral(model))
    at = {name: data.oMi[i].translation for i, name in enumerate(model.names)}
    upper = np.linalg.norm(at["joint_3"] - at["joint_2"])
    forearm = np.linalg.norm(at["joint_5"] - at["joint_3"])
    assert at["joint_2"][0] + upper + forearm == pytest.approx(2.57, abs=0.01)
    moving = sum(I.mass for I in model.inertias)
    assert moving == pytest.approx(509 + 100, abs=1e-9)


def test_irb_resonates_where_documented(irb):
    """Figures of robot.toml: six resonances between 4 and 46 Hz (medians below 40), each above an anti-resonance."""
    structure, par = build_structure(irb), Parameters.nominal(irb)
    postures = operating_points(irb, 40, np.random.default_rng(0))
    held, free = (np.array(x) for x in zip(*(undamped_frequencies(structure, par, q) for q in postures)))
    assert structure.n_coordinates == 12
    assert np.allclose(np.median(held, axis=0)[:6], [4.8, 5.5, 15.5, 18.6, 23.8, 34.6], rtol=0.03)
    assert np.allclose(np.median(free, axis=0)[:6], [8.9, 13.2, 17.0, 23.0, 27.7, 37.4], rtol=0.03)
    assert free[:, 0].min() > 4.0 and free[:, :6].max() < 47.0
    assert np.all(held < free)


def test_irb_wrist_is_ruled_by_its_motors(irb):
    structure, par = build_structure(irb), Parameters.nominal(irb)
    for q in operating_points(irb, 10, np.random.default_rng(1)):
        M = linearise(structure, equilibrium(structure, par, q)).M
        assert np.all(irb.array("motor_inertia")[3:] > np.diag(M)[structure.driven][3:])


@pytest.mark.parametrize("name", ["ur10", *(pytest.param(x, marks=pytest.mark.slow) for x in ("irb", "panda"))])
def test_experiments_stay_within_the_limits_of_the_arm(name):
    robot = load_robot(name)
    plan = small_plan(robot, 2, points=2, levels=(1.0,), period=1000, periods=2, band_hz=(1.0, 60.0), trajectory=True)
    for s in run_experiment(plan).segments:
        speed = np.gradient(s.q_ref, s.t, axis=0) if s.kind == "trajectory" else np.gradient(s.q, s.t, axis=0)
        assert np.all(np.abs(s.tau).max(axis=0) < robot.array("torque_limit"))
        assert np.all(np.abs(speed).max(axis=0) < robot.array("velocity_limit"))
        assert np.all(s.q.min(axis=0) > robot.q_min) and np.all(s.q.max(axis=0) < robot.q_max)
        if s.kind == "multisine":
            motion = s.periodic("q").std(axis=1).mean(axis=0)
            assert np.all(motion > 100 * robot.array("q_std")) and np.all(motion < 0.03)


@pytest.mark.parametrize("foundation", [False, True])
@pytest.mark.parametrize("name", ["ur10", "irb", "panda", "twomass"])
def test_plant_and_gray_box_are_the_same_bodies(name, foundation):
    """Inertia matrix and gravity of the MuJoCo plant and of the Pinocchio model, elastic hinges deflected too.

    On a foundation that moves the link that stands on it moves as well.
    """
    robot = load_robot(name)
    if foundation:
        robot = replace(robot, elasticities=(*robot.elasticities, Elasticity("b", "base", (0.6, 0.8, 0.0), 1e6, 100.0)))
    structure, plant = build_structure(robot), build_plant(robot)
    model, data = structure.model, structure.model.createData()
    coordinates = np.empty(structure.n_coordinates, int)
    coordinates[structure.driven], coordinates[structure.elastic] = plant.link, plant.hinges
    mj = mujoco.MjData(plant.model)
    rng = np.random.default_rng(3)
    for _ in range(5):
        q = np.empty(structure.n_coordinates)
        q[structure.driven] = rng.uniform(robot.q_min, robot.q_max)
        q[structure.elastic] = rng.uniform(-0.1, 0.1, len(structure.elastic))
        v = rng.uniform(-1, 1, len(q))
        mj.qpos[coordinates], mj.qvel[coordinates] = q, v
        mujoco.mj_forward(plant.model, mj)
        M = np.zeros((plant.model.nv, plant.model.nv))
        mujoco.mj_fullM(plant.model, mj, M)
        other = pin.crba(model, data, q)
        other = np.triu(other) + np.triu(other, 1).T
        assert np.allclose(M[np.ix_(coordinates, coordinates)], other, rtol=1e-6, atol=1e-8 * np.abs(other).max())
        bias = pin.rnea(model, data, q, v, np.zeros(len(q)))
        assert np.allclose(mj.qfrc_bias[coordinates], bias, rtol=1e-6, atol=1e-8 * np.abs(bias).max() + 1e-12)


@pytest.mark.parametrize("name", ["irb", "panda"])
def test_plant_and_gray_box_sag_alike(name):
    robot = load_robot(name)
    structure, plant, par = build_structure(robot), build_plant(robot), Parameters.nominal(robot)
    for q_m in operating_points(robot, 3, np.random.default_rng(4)):
        x, hold = rest(plant, q_m)
        q = equilibrium(structure, par, q_m)
        assert np.allclose(x[plant.link], q[structure.driven], atol=1e-8)
        assert np.allclose(x[plant.hinges], q[structure.elastic], atol=1e-8)
        assert np.allclose(hold, par.stiffness * (q_m - q[structure.driven]), rtol=1e-5, atol=1e-3)


@pytest.mark.parametrize("before", [False, True])
def test_a_hinge_lies_on_the_same_side_of_its_joint_in_plant_and_model(before):
    robot = load_robot("ur10")
    robot = replace(robot, elasticities=(Elasticity("h", "elbow_joint", (1.0, 0.0, 0.5), 1e4, 10.0, before),))
    q = np.array([0.2, -1.2, 0.9, 0.1, 0.5, 0.3])
    plant, structure = build_plant(robot), build_structure(robot)
    data, M = mujoco.MjData(plant.model), np.zeros((plant.model.nv, plant.model.nv))
    data.qpos[plant.link] = q
    mujoco.mj_forward(plant.model, data)
    mujoco.mj_fullM(plant.model, data, M)
    x = np.zeros(structure.n_coordinates)
    x[structure.driven] = q
    own = np.r_[structure.driven, structure.elastic]
    there = np.r_[plant.link, plant.hinges].astype(int)
    assert M[np.ix_(there, there)] == pytest.approx(linearise(structure, x).M[np.ix_(own, own)], abs=1e-5)
