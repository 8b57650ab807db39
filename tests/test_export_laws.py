"""Elements of the exported model against the laws that they stand for."""

from types import SimpleNamespace

import mujoco
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ident.hypotheses.link_springs import spring_between_points
from ident.hypotheses.ripple import ripple
from ident.hypotheses.slips import parallel_slips
from ident.hypotheses.yielding import along_path, bristle, dipping_bristle, elastoplastic
from ident.show.dips import square_dips
from ident.show.export import build_mjcf
from robot_assets.robot import load_robot
from tests.test_show import cause, parameters

JOINT = "drive"


@pytest.fixture(scope="module")
def bench():
    """Two inertias: one motor, gravity without effect."""
    return load_robot("twomass")


def exported(robot, *causes):
    """Model and data, through the text of the file."""
    spec = build_mjcf(robot, parameters(robot), causes)
    spec.compile()
    model = mujoco.MjModel.from_xml_string(spec.to_xml())
    return model, mujoco.MjData(model)


def forced(model, data, q, v):
    """Forces of the elements of a motor (T,) whose state is set to ``q``, ``v`` (T,), step by step; gear and damper
    taken off."""
    j, k = model.joint(f"motor:{JOINT}").dofadr[0], model.joint(f"link:{JOINT}").dofadr[0]
    model.tendon_stiffness[0], model.tendon_damping[0], model.dof_damping[j] = 0.0, 0.0, 0.0
    out = []
    for qi, vi in zip(q, v):
        data.qpos[j], data.qvel[j], data.qpos[k], data.qvel[k] = qi, vi, 0.0, 0.0
        mujoco.mj_forward(model, data)
        out.append(data.qfrc_actuator[j] + data.qfrc_passive[j] + data.qfrc_constraint[j])
        mujoco.mj_step(model, data)
    return np.array(out)


def swing(model, amplitude, frequency, turns=2.0):
    """Time, position and velocity of a slow swing on the grid of the model."""
    t = np.arange(0, turns / frequency, model.opt.timestep)
    w = 2 * np.pi * frequency
    return t, amplitude * np.sin(w * t), amplitude * w * np.cos(w * t)


def test_cogging_is_a_sine_of_the_motor_angle(bench):
    model, data = exported(bench, cause("cogging", JOINT, amplitude=0.5, periods_per_rev=101.3, phase=0.4))
    q = np.linspace(-3, 3, 50)
    assert np.allclose(forced(model, data, q, 0 * q), 0.5 * np.sin(101.3 * q + 0.4), atol=1e-12)


def test_cogging_has_the_second_harmonic_of_its_law(bench):
    p = {"amplitude": 0.5, "periods_per_rev": 101.3, "phase": 0.4}
    model, data = exported(bench, cause("cogging", JOINT, **p, second_sine=0.2, second_cosine=-0.1))
    q = np.linspace(-3, 3, 50)
    law, _ = ripple(0.5 * np.cos(0.4), 0.5 * np.sin(0.4), (0.2, -0.1), 101.3 * q)
    assert np.allclose(forced(model, data, q, 0 * q), law, atol=1e-6)


def test_coulomb_friction_is_asymmetric_and_turns_within_a_step(bench):
    model, data = exported(bench, cause("coulomb_friction", JOINT, torque=0.3, asymmetry=0.2))
    turn = 0.3 / parameters(bench)[f"motor_inertia.{JOINT}"] * model.opt.timestep
    v = np.array([-2.0, -1.0, 1.0, 2.0]) * 2 * turn
    assert np.allclose(forced(model, data, 0 * v, v), [0.24, 0.24, -0.36, -0.36], rtol=1e-3)
    _, data = exported(bench, cause("coulomb_friction", JOINT, torque=0.3))
    data.ctrl[0] = 0.29  # less than the friction: the motor creeps by a thousandth of what it would do
    model, _ = exported(bench, cause("coulomb_friction", JOINT, torque=0.3))
    model.tendon_stiffness[0] = model.tendon_damping[0] = 0.0
    for _ in range(400):
        mujoco.mj_step(model, data)
    j = model.joint(f"motor:{JOINT}").dofadr[0]
    assert abs(data.qvel[j]) < 0.29 / model.dof_M0[j] * model.opt.timestep * 1e-2


def test_presliding_friction_is_the_dahl_law(bench):
    model, data = exported(bench, cause("presliding_friction", JOINT, stiffness=100.0, coulomb=0.3))
    _, q, v = swing(model, 0.02, 2.0)
    law = 0.3 * bristle(v[None], model.opt.timestep, 0.3 / 100.0)[0]
    half = len(q) // 2
    assert np.abs(forced(model, data, q, v) + law)[half:].max() < 0.02 * 0.3


def test_the_bending_of_a_bristle_is_damped(bench):
    """LuGre's second coefficient, in N m s/rad, is the relaxation time by the stiffness."""
    model, data = exported(bench, cause("presliding_friction", JOINT, stiffness=100.0, coulomb=0.3, relaxation=0.02))
    _, q, v = swing(model, 0.02, 2.0)
    z = 0.3 * bristle(v[None], model.opt.timestep, 0.3 / 100.0)[0]
    law = z + 0.02 * np.gradient(z, model.opt.timestep)
    half = len(q) // 2
    assert np.abs(forced(model, data, q, v) + law)[half:-1].max() < 0.02 * 0.3
    assert np.abs(law - z).max() > 0.3 * 0.3


@pytest.mark.parametrize("exponent", [2.0, 1.0, 0.7])
def test_stribeck_friction_falls_with_velocity(bench, exponent):
    dip = cause("stribeck_friction", JOINT, coulomb=0.2, static=0.5, stribeck_velocity=0.1, exponent=exponent)
    model, data = exported(bench, dip)
    t, q, v = swing(model, 0.05, 1.0)
    law = np.sign(v) * (0.2 + 0.3 * np.exp(-(np.abs(v / 0.1) ** exponent)))
    slides = (np.abs(v) > 0.02) & (t > 1.0)  # beyond the breakaway distance of the bristle
    assert np.allclose(forced(model, data, q, v)[slides], -law[slides], rtol=2e-3 if exponent == 2.0 else 1.5e-2)


def test_a_stribeck_friction_that_gives_does_so_as_its_bristle(bench):
    p = {"coulomb": 0.2, "static": 0.5, "stribeck_velocity": 0.05, "exponent": 2.0, "stiffness": 60.0}
    model, data = exported(bench, cause("stribeck_friction", JOINT, **p))
    _, q, v = swing(model, 0.02, 2.0)
    limits = 0.2 + 0.3 * np.exp(-((v / 0.05) ** 2))
    law = dipping_bristle(v[None], model.opt.timestep, 60.0, limits[None])[0]
    half = len(q) // 2
    assert np.abs(forced(model, data, q, v) + law)[half:].max() < 0.02 * 0.5


@given(st.floats(0.5, 2.0))
def test_falls_by_other_powers_are_mixtures_of_squares(exponent):
    shares, widths = np.transpose(square_dips(0.3, exponent))
    v = 0.3 * np.geomspace(0.01, 30.0, 50)
    mixture = np.exp(-((v[:, None] / widths) ** 2)) @ shares
    assert np.all(shares > 0.0) and np.sum(shares) == pytest.approx(1.0)
    assert np.abs(mixture - np.exp(-((v / 0.3) ** exponent))).max() < (0.025 if exponent > 0.7 else 0.07)


def test_hysteresis_is_maxwell_slip(bench):
    model, data = exported(bench, cause("hysteresis", JOINT, stiffness=80.0, yield_torque=0.2))
    _, q, v = swing(model, 0.01, 2.0)
    law = elastoplastic(q[None], 80.0, 0.2)[0]
    got = forced(model, data, q, v)
    # The state is set, so that a step that MuJoCo takes before the next one is not part of the path.
    half = len(q) // 2
    assert np.abs(got + law)[half:].max() < 0.02 * 0.2


@pytest.mark.parametrize(("exponent", "recoil"), [(1.0, 0.0), (2.0, 0.5), (8.0, 0.0)])
def test_hysteresis_that_yields_gradually_is_slips_near_to_it(bench, exponent, recoil):
    """Nearer than one slip of the same stiffness and torque, along swings far into yielding."""
    model, data = exported(
        bench, cause("hysteresis", JOINT, stiffness=80.0, yield_torque=0.2, exponent=exponent, recoil=recoil)
    )
    _, q, v = swing(model, 0.01, 2.0)
    steps = (q - np.roll(q, 1))[None]
    law = along_path(steps, 80.0, 0.2, exponent, recoil)[0]
    half = len(q) // 2
    off, of_one = (np.std((x - law)[half:]) for x in (-forced(model, data, q, v), elastoplastic(q[None], 80.0, 0.2)[0]))
    assert off < of_one and off < 0.12 * np.std(law)


def test_a_bristle_that_goes_by_the_name_of_coulomb_friction_is_one(bench):
    p = {"stiffness": 300.0, "exponent": 1.0, "relaxation": 0.0}
    (model, data), (other, same) = (
        exported(bench, cause(effect, JOINT, **size, **p))
        for effect, size in (("coulomb_friction", {"torque": 0.3}), ("presliding_friction", {"coulomb": 0.3}))
    )
    _, q, v = swing(model, 8e-3, 2.0)
    torque = forced(model, data, q, v)
    assert np.abs(torque).max() == pytest.approx(0.3, rel=0.02)
    assert torque == pytest.approx(forced(other, same, q, v), abs=1e-9)


def test_presliding_friction_of_slips_is_these_slips(bench):
    p = {"stiffness": 120.0, "coulomb": 0.3, "spread": 0.8}
    model, data = exported(bench, cause("presliding_friction", JOINT, **p))
    _, q, v = swing(model, 8e-3, 2.0)
    each, limits = parallel_slips(*p.values())
    law = sum(elastoplastic(q[None], each, x, begins=True)[0] for x in limits)
    half = len(q) // 2
    assert np.abs(forced(model, data, q, v) + law)[half:].max() < 0.02 * 0.3


def test_sharp_presliding_friction_is_slips(bench):
    model, data = exported(bench, cause("presliding_friction", JOINT, stiffness=100.0, coulomb=0.3, exponent=50.0))
    _, q, v = swing(model, 0.02, 2.0)
    law = elastoplastic(q[None], 100.0, 0.3)[0]
    half = len(q) // 2
    assert np.abs(forced(model, data, q, v) + law)[half:].max() < 0.02 * 0.3


def test_cables_that_give_before_they_slip_are_a_slip_on_the_link(bench):
    """Beside their spring, and no dry friction in its place."""
    p = {"stiffness": 4.0, "friction": 0.3, "yield_angle": 5e-3, "rest_angle": 0.1}
    model, data = exported(bench, cause("dress_pack", JOINT, **p))
    at, motor = model.joint(f"link:{JOINT}"), model.joint(f"motor:{JOINT}")
    _, q, v = swing(model, 0.02, 2.0)
    model.tendon_stiffness[0], model.tendon_damping[0] = 0.0, 0.0
    out = []
    for x, rate in zip(q, v, strict=True):
        data.qpos[at.qposadr], data.qvel[at.dofadr], data.qvel[motor.dofadr] = x, rate, 0.0
        mujoco.mj_forward(model, data)
        out.append(data.qfrc_passive[at.dofadr[0]])
        mujoco.mj_step(model, data)
    law = 4.0 * (q - 0.1) + elastoplastic(q[None], 0.3 / 5e-3, 0.3)[0]
    half = len(q) // 2
    assert np.abs(np.array(out) + law)[half:].max() < 0.02 * 0.3
    assert model.dof_frictionloss[at.dofadr[0]] == 0.0


@pytest.mark.parametrize(
    ("slips", "integrator"),
    [
        (cause("hysteresis", JOINT, stiffness=80.0, yield_torque=0.2), mujoco.mjtIntegrator.mjINT_RK4),
        (
            cause("presliding_friction", JOINT, stiffness=100.0, coulomb=0.3, spread=0.4),
            mujoco.mjtIntegrator.mjINT_IMPLICITFAST,
        ),
        (
            cause("dress_pack", JOINT, stiffness=4.0, friction=0.3, yield_angle=5e-3),
            mujoco.mjtIntegrator.mjINT_IMPLICITFAST,
        ),
    ],
    ids=lambda x: x.effect if hasattr(x, "effect") else "",
)
def test_what_yields_is_stepped_finely(bench, slips, integrator):
    """A rotor that swings freely against the element takes the path of one in steps four times finer."""
    spec = build_mjcf(bench, parameters(bench), [slips])
    ends = []
    for finer in (1.0, 4.0):
        model = spec.compile()
        model.opt.timestep /= finer
        data = mujoco.MjData(model)
        data.qvel[:] = 0.5
        while data.time < 0.3:
            mujoco.mj_step(model, data)
        ends.append(data.qpos.copy())
    assert (spec.option.timestep, spec.option.integrator) == (pytest.approx(5e-5), integrator)
    assert np.allclose(*ends, atol=2e-5)


@pytest.mark.parametrize("delay", [1e-4, 4e-4, 1.07e-3])
def test_a_delayed_drive_acts_late_by_the_delay(bench, delay):
    """A unit step of torque on the bare rotor: it lags the undelayed one by the delay times the acceleration."""
    model, data = exported(bench, cause("torque_delay", JOINT, delay=delay))
    lag = lost_time(model, data)
    assert lag == pytest.approx(delay, rel=1e-3)


@pytest.mark.parametrize("lag", [1e-4, 1e-3])
def test_a_lagging_drive_loses_its_time_constant(bench, lag):
    model, data = exported(bench, cause("torque_lag", JOINT, time_constant=lag))
    assert lost_time(model, data) == pytest.approx(lag, rel=1e-2)


@pytest.mark.parametrize("stepped", [-0.25, 0.01, 0.05, 0.25, 0.4])
def test_a_lag_that_is_stepped_in_time_loses_as_much_more_or_less(bench, stepped):
    model, data = exported(bench, cause("torque_lag", JOINT, time_constant=1e-3, stepped=stepped))
    assert lost_time(model, data) == pytest.approx(1e-3 * (1.0 + stepped), rel=1e-2)


@pytest.mark.parametrize("square", [0.2, 0.39, 0.499, 0.6])
def test_a_lag_of_second_order_loses_its_time_constant_too(bench, square):
    """As a filter and a delay, or where it hardly loses gain as a delay."""
    model, data = exported(bench, cause("torque_lag", JOINT, time_constant=1e-3, square=square))
    assert lost_time(model, data) == pytest.approx(1e-3, rel=1e-2)
    assert model.actuator_delay[0] > 0.0


@pytest.mark.parametrize("lead", [2e-3, 9.5e-3])
def test_a_friction_that_leads_slows_its_motor_within_that_time(bench, lead):
    """A soft constraint asks for ``v' = -v / lead`` as far as its size reaches."""
    model, data = exported(bench, cause("coulomb_friction", JOINT, torque=0.3, lead=lead))
    j = model.joint(f"motor:{JOINT}").dofadr[0]
    model.tendon_stiffness[0], model.tendon_damping[0], model.dof_damping[j] = 0.0, 0.0, 0.0
    first = data.qvel[j] = 0.5 * lead * 0.3 / model.dof_M0[j]
    while data.time < lead - 0.5 * model.opt.timestep:
        mujoco.mj_step(model, data)
    assert data.qvel[j] / first == pytest.approx(np.exp(-data.time / lead), rel=0.02)


def lost_time(model, data):
    """Time by which the velocity of the free rotor is behind that of an immediate unit step of torque."""
    j = model.joint(f"motor:{JOINT}").dofadr[0]
    model.tendon_stiffness[0], model.tendon_damping[0], model.dof_damping[j] = 0.0, 0.0, 0.0
    data.ctrl[0] = 1.0
    while data.time < 0.02:
        mujoco.mj_step(model, data)
    return data.time - data.qvel[j] * model.dof_M0[j]


def test_a_delayed_encoder_shows_an_earlier_position(bench):
    model, data = exported(bench, cause("sensor_delay", JOINT, delay=1.1e-3))
    j = model.joint(f"motor:{JOINT}").qposadr[0]
    data.ctrl[0] = 1.0
    shown, true, time = [], [], []
    while data.time < 0.05:
        mujoco.mj_forward(model, data)
        shown.append(data.sensordata[0])
        true.append(data.qpos[j])
        time.append(data.time)
        mujoco.mj_step(model, data)
    shown, true, time = map(np.array, (shown, true, time))
    late = time > 0.01
    assert np.allclose(shown[late], np.interp(time[late] - 1.1e-3, time, true), rtol=1e-6)


@pytest.mark.parametrize(("share", "stretch"), [(-1.5, 0.83), (0.0, 3.0), (0.7, 2.0)])
@pytest.mark.parametrize(("arm", "joint"), [("twomass", JOINT), ("ur10", "elbow_joint"), ("ur10", "wrist_2_joint")])
def test_a_spring_between_two_points_pulls_as_its_law(arm, joint, share, stretch):
    """A slack one, one without a length of its own, and one that is nearly a gas spring."""
    p = {"stiffness": 4.0, "rest_angle": 0.4, "constant_share": share, "stretch": stretch}
    model, data = exported(load_robot(arm), cause("gravity_spring", joint, **p))
    at = model.joint(f"link:{joint}")
    q = np.linspace(-1.5, 2.0, 15)
    out = []
    for x in q:
        data.qpos[at.qposadr], data.qpos[model.joint(f"motor:{joint}").qposadr] = x, x
        mujoco.mj_forward(model, data)
        out.append(data.qfrc_passive[at.dofadr[0]])
    moving = SimpleNamespace(q_link=lambda j: q)
    law = spring_between_points(0, joint).law(np.array(list(p.values())), moving, 0, 1.0)
    assert -np.array(out) == pytest.approx(law, rel=1e-5, abs=1e-5)
