"""What is left of parts of motions that a model was not fitted to, and fits beside an error that is no noise."""

from dataclasses import replace

import numpy as np
import pinocchio as pin
import pytest

from ident.attribute import attribute
from ident.chain import build_structure
from ident.dataset import Segment
from ident.hypotheses import catalogue
from ident.identification import identify
from ident.left_out import carries_over
from ident.model import Effect
from ident.parallel import Workers
from ident.refits import beside_its_error, polish
from robot_assets.robot import load_robot
from tests.conftest import of_motions, through_postures

pytestmark = pytest.mark.xdist_group("left_out")  # one worker makes what they share

RATE, SECONDS, COULOMB = 100.0, 60.0, 20.0
SPRING = 3.0  # N m/rad
WANDER = 8.0  # N, of a force that follows nothing


def wandering(rng, t):
    """A force that drifts along, of as many turns in the record as noise has that is averaged over two seconds."""
    steps = rng.normal(size=len(t))
    width = int(2.0 * RATE)
    slow = np.convolve(steps, np.hanning(width), mode="same")
    return WANDER * slow / slow.std()


def recorded(robot, torques, scale=1.0):
    """Motions with torques of their own and a force at the first joint that nothing of the model explains; the problem
    and the fit without any cause."""
    segments = []
    for i, role in enumerate(("identification", "validation")):
        rng = np.random.default_rng(40 + i)
        t, *motion = through_postures(rng, robot.n, RATE, SECONDS)
        q, v, a = (scale * x for x in motion)
        tau = torques(q, v, a)
        tau[:, 0] += wandering(rng, t)
        tau += 0.01 * rng.normal(size=tau.shape)
        segments.append(Segment(name=f"m{i}", role=role, kind="trajectory", t=t, tau=tau, q=q))
    data = of_motions(robot, RATE, segments, q_std=1e-7, tau_std=0.01)
    setup, first = identify(data)
    return setup.problem, first


@pytest.fixture(scope="module")
def wandered():
    """One linear drive with friction."""
    return recorded(load_robot("emps"), lambda q, v, a: 95.1 * a + 203.5 * v + COULOMB * np.sign(v), 0.3)


@pytest.fixture(scope="module")
def wandered_arm(tmp_path_factory):
    """Two joints on upright axes with friction, and a spring at the second one."""
    folder = tmp_path_factory.mktemp("planar")
    bodies = "".join(
        f'<link name="l{i}"><inertial><origin xyz="0.2 0 0"/><mass value="{5 * i}"/>'
        '<inertia ixx="0.1" iyy="0.1" izz="0.1" ixy="0" ixz="0" iyz="0"/></inertial></link>'
        for i in (1, 2)
    )
    joints = "".join(
        f'<joint name="j{i}" type="revolute"><parent link="l{i - 1}"/><child link="l{i}"/><axis xyz="0 0 1"/>'
        f'<origin xyz="{0.4 * (i - 1)} 0 0"/><limit lower="-9" upper="9" effort="90" velocity="9"/></joint>'
        for i in (1, 2)
    )
    (folder / "arm.urdf").write_text(f'<robot name="arm"><link name="l0"/>{bodies}{joints}</robot>')
    drives = {"gear_ratio": 100.0, "motor_inertia": 2.0, "stiffness": 4e4, "damping": 30.0, "viscous_friction": 15.0}
    own = "".join(f"{key} = {value}\n" for key, value in drives.items())
    (folder / "robot.toml").write_text(
        'urdf = "arm.urdf"\n' + "".join(f'[[joint]]\nname = "j{i}"\n{own}' for i in (1, 2))
    )
    robot = load_robot(folder)
    model = build_structure(robot).model
    data = model.createData()

    def torques(q, v, a):
        rigid = np.array([pin.rnea(model, data, *x) for x in zip(q, v, a, strict=True)])
        return rigid + 2.0 * a + 15.0 * v + [COULOMB, 5.0] * np.sign(v) + np.outer(q[:, 1], [0.0, SPRING])

    return recorded(robot, torques)


def beside(problem, fit, name, *p):
    h = next(h for h in catalogue(problem.structure, motions_alone=True) if h.effect == name)
    size = len(h.parameters)
    effect = Effect(h, np.array([*p, *(q.center or 1.0 for q in h.parameters[len(p) :])][:size]))
    return polish(problem, replace(fit, model=replace(fit.model, effects=(*fit.model.effects, effect))))


def test_a_law_that_is_there_lowers_what_is_left_of_parts_left_out_and_one_that_is_not_does_not(wandered):
    problem, first = wandered
    friction = beside(problem, first, "coulomb_friction", 10.0, 0.0)
    assert friction.chi2_per_dof > 1e3  # far from the noise with the right law
    assert carries_over(problem, first, friction, 0, Workers())
    cogging = beside(problem, friction, "cogging", 1.0, 1.0, 40.0)
    assert friction.cost - cogging.cost > 25.0 * friction.chi2_per_dof  # more than chance, were what is left noise
    assert not carries_over(problem, friction, cogging, 0, Workers())


def test_the_search_in_motions_stops_where_laws_follow_what_was_driven_alone(wandered):
    problem, first = wandered
    some = {"coulomb_friction", "load_dependent_friction", "cogging", "gravity_spring", "torque_constant"}
    some = [h for h in catalogue(problem.structure, motions_alone=True) if h.effect in some]
    found = attribute(problem, first, hypotheses=some)
    assert [e.hypothesis.effect for e in found.final.model.effects] == ["coulomb_friction"]
    assert found.left_share > 0.0 and found.final.chi2_per_dof > 1e3


@pytest.mark.slow
def test_what_follows_no_law_at_one_joint_hides_no_cause_at_another(wandered_arm):
    problem, first = wandered_arm
    some = {"coulomb_friction", "cogging", "gravity_spring"}
    some = [h for h in catalogue(problem.structure, motions_alone=True) if h.effect in some]
    found = attribute(problem, first, hypotheses=some)
    effects = {e.hypothesis.key: e.p for e in found.final.model.effects}
    assert [effect for effect, joint in effects if joint == "j1"] == ["coulomb_friction"]
    assert effects["coulomb_friction", "j2"][0] == pytest.approx(5.0, rel=0.02)
    assert effects["gravity_spring", "j2"][0] == pytest.approx(SPRING, rel=0.05)


def test_what_is_found_beside_an_error_of_the_model_is_known_as_well_as_that_lets_it(wandered):
    problem, first = wandered
    friction = beside(problem, first, "coulomb_friction", 10.0, 0.0)
    last = beside_its_error(problem, friction)
    at = last.names.index(last.model.effects[-1].hypothesis.coordinate("torque"))
    std = np.sqrt(last.covariance()[at, at])
    assert abs(np.log(last.model.effects[-1].p[0] / COULOMB)) < 3.0 * std and std < 0.1
    assert last.cost == pytest.approx(friction.cost, rel=0.1)  # in units of the noise
    near = replace(friction, costs=friction.counts)
    assert beside_its_error(problem, near) is near
