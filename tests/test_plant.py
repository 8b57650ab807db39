"""The plant against closed forms and against its own description."""

import dataclasses
import re
from dataclasses import replace
from pathlib import Path

import mujoco
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from robot_assets.errors import DataError
from robot_assets.robot import load_robot
from robot_assets.urdf import read_urdf
from sim import EFFECTS, draw_effect, parse_effect, run_experiment
from sim.effects import make_effect, parameters_of, valid_places
from sim.effects.dry import REVERSAL, resistance, turn
from sim.effects.effect import Dry, Run, State, carried
from sim.experiment import draw_drives
from sim.plant import SHORTEST_STEP, build_plant, fastest_rate, gravity_torque, rest, time_step
from tests.conftest import small_plan


def run_of(plant):
    """A run of one simulation in steps of 0.1 ms."""
    return Run(1, 1e-4, 1e-3, plant.robot, plant.drives, plant.model, np.zeros(1))


@pytest.mark.slow
@pytest.mark.parametrize("hidden", [None, "backlash@shoulder_pan_joint:gap=8e-4"])
def test_the_step_of_an_experiment_is_far_below_its_noise(ur10, hidden):
    """Of a step half as long the records differ by less than a fiftieth of the noise, at every joint."""
    effects = [] if hidden is None else [parse_effect(hidden, ur10)]
    plan = small_plan(ur10, 3, points=1, validation_points=0, levels=(1.0,), period=1000)
    drives = draw_drives(np.random.default_rng(3), ur10)
    assert time_step(build_plant(ur10, effects, drives=drives), 1000.0) == pytest.approx(2.5e-4)
    coarse, fine = (
        run_experiment(plan, effects, drives=drives, noise=0.0, timestep=h).segments for h in (None, 1.25e-4)
    )
    for a, b in zip(coarse, fine, strict=True):
        assert np.all(np.std(a.q - b.q, axis=0) < ur10.array("q_std") / 50.0)
        assert np.all(np.std(a.tau - b.tau, axis=0) < ur10.array("tau_std") / 50.0)


def test_the_step_suits_the_fastest_mode_and_divides_the_sample_time(ur10):
    """A drive alone: two inertias and a spring, in closed form; stiffer ones are stepped faster, up to a limit."""
    bench = load_robot("twomass")
    plant = build_plant(bench)
    k, d, J, v = (plant.drives[x][0] for x in ("stiffness", "damping", "motor_inertia", "viscous_friction"))
    link = build_plant(bench).model.dof_M0[plant.link[0]]
    roots = np.roots([J * link, (J + link) * d + link * v, (J + link) * k + v * d, v * k])
    assert fastest_rate(plant) == pytest.approx(np.abs(roots).max(), rel=1e-6)
    assert 1.0 / (3000.0 * time_step(plant, 3000.0)) == pytest.approx(2.0)  # of 3 kHz two steps a sample
    for rate, factor in ((250.0, 30.0), (1000.0, 100.0), (8000.0, 1000.0)):
        stiff = build_plant(ur10, drives={"stiffness": factor * ur10.array("stiffness")})
        step = time_step(stiff, rate)
        assert 1.0 / (rate * step) == pytest.approx(round(1.0 / (rate * step))) and step < 2.5e-4
        assert 0.5 < step * fastest_rate(stiff) < 1.0 + 1e-9
    frozen = build_plant(ur10, drives={"stiffness": 1e9 * ur10.array("stiffness")})
    assert time_step(frozen, 1000.0) == pytest.approx(SHORTEST_STEP)


def test_rest_sags_by_torque_over_stiffness(ur10):
    plant = build_plant(ur10)
    q = np.array([0.2, -1.2, 0.9, 0.1, 0.5, 0.3])
    x, hold = rest(plant, q)
    assert np.allclose(x[plant.motor], q)
    assert np.allclose(ur10.array("stiffness") * (q - x[plant.link]), hold, rtol=1e-6, atol=1e-6)
    assert np.abs(hold - gravity_torque(plant, q)).max() < 1.0


@pytest.mark.parametrize(
    "hidden",
    [
        (),
        ("hardening_stiffness:cubic=2e9",),
        ("softening_stiffness:low_stiffness=8e3,transition=5e-4",),
        ("backlash:gap=1e-3",),
        ("joint_coupling:ratio=0.2", "softening_stiffness:low_stiffness=8e3,transition=5e-4", "backlash:gap=1e-3"),
    ],
)
def test_friction_by_load_sees_all_that_the_gear_carries(ur10, hidden):
    """The torque of the gear that friction by load grows with is the one that the simulator puts on the link, whatever
    law it has."""
    place, before = "elbow_joint", "shoulder_lift_joint"
    places = [(text.split(":"), before if "coupling" in text else place) for text in hidden]
    effects = [parse_effect(f"{name}@{where}:{values}", ur10) for (name, values), where in places]
    plant = build_plant(ur10, effects)
    j, data = ur10.joint_names.index(place), mujoco.MjData(plant.model)
    load = carried(run_of(plant), place)
    for wind_up, rate in ((2e-4, 0.0), (-3e-3, 0.2), (4e-3, -0.1)):
        data.qpos[plant.motor[j]], data.qvel[plant.motor[j]] = wind_up, rate
        data.qpos[plant.motor[j - 1]], data.qvel[plant.motor[j - 1]] = -0.5 * wind_up, 0.3 * rate
        mujoco.mj_forward(plant.model, data)
        on_link = data.qfrc_spring[plant.link[j]] + data.qfrc_damper[plant.link[j]]
        q, v, q_link, v_link = (
            x[None]
            for x in (data.qpos[plant.motor], data.qvel[plant.motor], data.qpos[plant.link], data.qvel[plant.link])
        )
        state = State(np.zeros(1), q, v, q_link, v_link, q, v, q_link)
        assert load(state) == pytest.approx([on_link], rel=1e-9, abs=1e-9)


def test_laws_of_one_gear_and_springs_of_one_link_add_up(ur10):
    """In any order: play, a soft middle beyond it, and a cubic term; two springs of which one rests elsewhere."""
    place, gap, low, edge, cubic = "elbow_joint", 1e-3, 8e3, 5e-4, 2e9
    effects = [
        make_effect("softening_stiffness", place, low_stiffness=low, transition=edge),
        make_effect("backlash", place, gap=gap),
        make_effect("hardening_stiffness", place, cubic=cubic),
        make_effect("gravity_spring", place, stiffness=100.0, rest_angle=0.8),
        make_effect("dress_pack", place, stiffness=50.0, friction=1.0),
    ]
    for some in (effects, effects[::-1]):
        plant = build_plant(ur10, some)
        j, data = ur10.joint_names.index(place), mujoco.MjData(plant.model)
        data.qpos[plant.motor[j]], data.qpos[plant.link[j]] = 4e-3 - 0.3, -0.3
        mujoco.mj_forward(plant.model, data)
        over = 4e-3 - gap / 2
        gear = low * over + cubic * over**3 + (plant.drives["stiffness"][j] - low) * (over - edge)
        assert data.qfrc_spring[plant.motor[j]] == pytest.approx(-gear, rel=1e-9)
        assert data.qfrc_spring[plant.link[j]] == pytest.approx(gear + 100.0 * 1.1 + 50.0 * 0.3, rel=1e-9)


def test_an_error_of_the_transmission_goes_through_the_law_of_the_gear(ur10):
    """Motor and link feel the law at the wind-up with the error in it, and the motor the slope of the error too
    (virtual work)."""
    place, cubic, size, n = "elbow_joint", 2e9, 2e-3, 40.0
    effects = (
        make_effect("hardening_stiffness", place, cubic=cubic),
        make_effect("transmission_error", place, amplitude=size, periods_per_rev=n, phase=0.3),
    )
    plant = build_plant(ur10, effects)
    j, rest_of = ur10.joint_names.index(place), np.zeros((1, ur10.n))
    q, v = rest_of.copy(), rest_of.copy()
    q[0, j], v[0, j] = 3e-3, 0.2
    torque = effects[1].torque(run_of(plant))(State(np.zeros(1), q, v, rest_of, rest_of, q, v, rest_of))
    k, d = (plant.drives[x][j] for x in ("stiffness", "damping"))
    error, slope = size * np.sin(n * 3e-3 + 0.3), size * n * np.cos(n * 3e-3 + 0.3)

    def law(wind_up: float, rate: float) -> float:
        return k * wind_up + cubic * wind_up**3 + d * rate

    whole, spring = law(3e-3 + error, 0.2 * (1.0 + slope)), law(3e-3, 0.2)
    assert torque.link == pytest.approx([whole - spring], rel=1e-9)
    assert torque.motor == pytest.approx([spring - whole - slope * whole], rel=1e-9)


@given(st.floats(-1e4, 1e4), st.floats(0.0, 1e4))
def test_the_turn_of_a_dry_friction_is_solved(asked, size):
    x = turn(np.array([asked]), np.array([size]))
    assert x + size * np.tanh(x) == pytest.approx(asked, rel=1e-6, abs=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize(
    "hidden",
    ["coulomb_friction@wrist_2_joint:torque=4,asymmetry=0.2", "dress_pack@wrist_2_joint:stiffness=5,friction=4"],
)
def test_dry_friction_does_not_depend_on_the_step(ur10, hidden):
    """A wrist that creeps within the turn of its friction, which the step passes many times: a fine step says the
    same."""
    plan = small_plan(ur10, 1, points=1, levels=(0.2,), validation_points=0, period=300, periods=2, band_hz=(4.0, 40.0))
    free, coarse, fine = (
        np.stack([s.q[:, 4] for s in run_experiment(plan, effects, noise=0.0, timestep=step).segments])
        for effects, step in (
            ([], 1e-4),
            ([parse_effect(hidden, ur10)], 2.5e-4),
            ([parse_effect(hidden, ur10)], 2.5e-5),
        )
    )
    assert np.std(coarse - fine) < 0.01 * np.std(free - fine)
    assert np.std(np.diff(coarse) * 1e3) < 0.05  # rad/s


def test_a_motor_thrown_into_friction_comes_to_rest(ur10):
    """Without other torque: the friction of a step is twenty times what turns its sign, and no velocity is left but of
    the turn."""
    h, start = 1e-4, 0.01
    inertia = np.ones((1, ur10.n))
    size = 20.0 * REVERSAL * 2.0 / h
    resist = resistance(h, [lambda x: Dry(0, size, size)], inertia, inertia)
    v, old = np.full((1, ur10.n), start), np.full((1, ur10.n), start)
    for _ in range(40):
        mid = 1.5 * v - 0.5 * old
        ((_, torque),) = resist(State(np.zeros(1), v, mid, v, mid, v, v, v))
        old = v.copy()
        v[:, 0] += h * torque
    assert abs(v[0, 0]) < 1e-6 * start


def test_two_masses_resonate_where_they_should():
    robot = load_robot("twomass")
    plan = small_plan(
        robot,
        0,
        points=1,
        levels=(1.0,),
        validation_points=0,
        sample_rate=2500.0,
        period=2500,
        band_hz=(20.0, 120.0),
        periods=4,
        transient_periods=2,
    )
    drives = {"damping": np.array([2e-3]), "viscous_friction": np.array([1e-3])}
    s = run_experiment(plan, drives=drives, noise=0.0, timestep=1e-4).segments[0]
    U, Y = (np.fft.rfft(s.periodic(c)[0, :, 0])[s.excited_lines] for c in ("tau", "q"))
    f = s.excited_lines * 1.0
    gain = np.abs(Y / U) * f**2
    k, J_m, J_l = 400.0, 0.004, 0.00477
    assert f[np.argmin(gain)] == pytest.approx(np.sqrt(k / J_l) / 2 / np.pi, abs=2.0)
    assert f[np.argmax(gain)] == pytest.approx(np.sqrt(k * (1 / J_m + 1 / J_l)) / 2 / np.pi, abs=2.0)


def test_seeds_repeat_and_differ():
    robot = load_robot("twomass")
    plan = small_plan(robot, 0, points=1, levels=(1.0,), validation_points=0, period=500)
    a, b, c = (run_experiment(plan, seed=s).segments[0].tau for s in (1, 1, 2))
    assert np.array_equal(a, b) and not np.array_equal(a, c)


def test_steady_state_is_reached_after_the_transient(clean):
    data, _ = clean
    s = data.segments[0]
    periods = s.q.reshape(s.periods, s.period, -1)
    scatter = np.abs(periods[1] - periods[2]).max(axis=0)
    assert np.all(scatter < 60 * data.robot.array("q_std"))


@pytest.mark.parametrize("name", sorted(EFFECTS))
def test_every_effect_changes_the_data_and_stays_bounded(name):
    robot = load_robot("ur10")
    plan = small_plan(
        robot, 1, points=1, levels=(1.0,), validation_points=0, period=500, periods=2, band_hz=(2.0, 60.0)
    )
    peak = np.max([np.abs(e.r).max(axis=0) for e in plan.experiments], axis=0)
    effect = draw_effect(
        np.random.default_rng(3), robot, names=(name,), place=valid_places(name, robot)[0], peak_torque=peak
    )
    still = run_experiment(plan, noise=0.0)
    moved = run_experiment(plan, [effect], noise=0.0)
    change = max(np.abs(a.q - b.q).max() for a, b in zip(still.segments, moved.segments, strict=True))
    assert 1e-6 < change < 1.0


def test_an_effect_is_read_from_text(ur10):
    effect = parse_effect("coulomb_friction@elbow_joint:torque=3,asymmetry=0.1", ur10)
    assert effect.place == "elbow_joint" and parameters_of(effect) == {"torque": 3.0, "asymmetry": 0.1}
    heavy = parse_effect("hardening_stiffness@elbow_joint:cubic=7.6e12", ur10)
    assert parameters_of(heavy) == {"cubic": 7.6e12}


@pytest.mark.parametrize(
    ("text", "found"),
    [
        ("magic@elbow_joint:torque=3", "magic"),
        ("cogging@knee:amplitude=1", "knee"),
        ("cogging@elbow_joint:size=1", "size"),
        ("cogging@elbow_joint:amplitude=big", "big"),
        ("cogging@elbow_joint:amplitude=1e16", "at most 1e"),
        ("sensor_delay@elbow_joint:delay=1e-3,channel=tau", "tau"),
        ("base_elasticity@base:stiffness=1e5,damping=1e2,axis=0 0 0", "a direction"),
        ("payload@flange:mass=2,com=0 0 0.1,com_x=0.1", "one of the two"),
        ("coulomb_friction@elbow_joint:torque=3,asymmetry=5", "from -1 to 1"),
        ("friction_drift@elbow_joint:relative_change=-3,time_constant=9", "from -1 to"),
        ("torque_constant@elbow_joint:scale=0", "scale"),
        ("stribeck_friction@elbow_joint:coulomb=3,static=2,stribeck_velocity=0.1", "at least coulomb"),
        ("torque_delay@elbow_joint", None),
        ("nonsense", "nonsense"),
    ],
)
def test_a_wrong_effect_is_one_clear_error(ur10, text, found):
    if found is None:
        assert parse_effect(text, ur10).delay > 0
        return
    with pytest.raises(DataError, match=found):
        parse_effect(text, ur10)


def test_an_effect_that_there_is_not_is_told_all_that_there_are(ur10):
    with pytest.raises(DataError) as refused:
        parse_effect("magic@elbow_joint", ur10)
    assert all(name in str(refused.value) for name in EFFECTS) and "..." not in str(refused.value)


def test_the_page_of_effects_has_every_effect_with_its_keys(ur10):
    page = (Path(__file__).parent.parent / "docs" / "effects.md").read_text()
    rows = [row.split(" | ") for row in re.findall(r"^\| (`.*) \|$", page, re.MULTILINE)]
    told = {
        name.strip("`"): (place, re.findall(r"`(\w+)(?:=([^`]*))?` \(|`(channel)=(q)`", keys))
        for name, place, keys, _ in rows
    }
    assert list(told) == list(EFFECTS)
    for name, cls in EFFECTS.items():
        place, keys = told[name]
        found = {key or channel: default or q for key, default, channel, q in keys}
        fields = [f for f in dataclasses.fields(cls) if f.name != "place"]
        assert list(found) == [f.name.rstrip("_") for f in fields], name
        for f, default in zip(fields, found.values(), strict=True):
            if f.default is dataclasses.MISSING:
                assert default == "", name
            elif isinstance(f.default, tuple):
                assert tuple(map(float, default.split())) == f.default, name
            else:
                assert type(f.default)(default) == f.default, name
        where = valid_places(name, ur10)
        kind = {"joint": list(ur10.joint_names), "joint, not the last": list(ur10.joint_names)[:-1]}
        assert place in ("link", f"`{where[0]}`") or set(where) <= set(kind[place]), name


def test_a_centre_of_mass_is_read_as_three_numbers_or_in_parts(ur10):
    for name, place in (("payload", "flange"), ("link_inertia", "forearm_link")):
        one = parse_effect(f"{name}@{place}:mass=2,com=0 0.02 0.1", ur10)
        assert one == parse_effect(f"{name}@{place}:mass=2,com_y=0.02,com_z=0.1", ur10)


def test_a_gear_is_softer_around_zero_and_is_so_once(ur10):
    soft = make_effect("softening_stiffness", "elbow_joint", low_stiffness=8e3, transition=5e-4)
    for effects, found in (([soft, soft], "twice"), ([replace(soft, low_stiffness=1e6)], "low_stiffness 1e\\+06")):
        with pytest.raises(DataError, match=found):
            build_plant(ur10, effects)


@pytest.mark.parametrize("name", ["ur10", "irb", "panda"])
def test_an_elasticity_across_is_drawn_across(name):
    robot = load_robot(name)
    axes = read_urdf(robot.urdf).axes
    for seed in range(30):
        effect = draw_effect(np.random.default_rng(seed), robot, names=("transverse_elasticity",))
        assert abs(np.dot(effect.axis, axes[effect.place])) < 0.9
        for hinge in robot.elasticities:
            assert hinge.joint != effect.place or abs(np.dot(effect.axis, hinge.axis)) < 0.9


def test_two_hinges_about_one_axis_are_an_error():
    """Of the arm's own and a hidden one: what turns between them has no inertia."""
    irb = load_robot("irb")
    own = irb.elasticities[0]
    second = make_effect("transverse_elasticity", own.joint, stiffness=1e6, damping=1e3, axis=own.axis)
    with pytest.raises(DataError, match=own.name):
        build_plant(irb, [second])


def test_an_effect_of_the_users_own_needs_no_name(ur10):
    class Heavy:
        def edit(self, spec, robot, drives):
            spec.joint("motor:elbow_joint").armature += 1.0

    plain, heavy = (build_plant(ur10, effects).model.dof_armature for effects in ([], [Heavy()]))
    assert np.sum(heavy - plain) == pytest.approx(1.0)


def test_a_simulation_that_diverges_is_an_error(ur10):
    """A hinge without mass between, along the joint's own axis, has a singular inertia."""
    axis = read_urdf(ur10.urdf).axes["shoulder_pan_joint"]
    broken = make_effect("transverse_elasticity", "shoulder_pan_joint", stiffness=2e4, damping=30.0, axis=axis)
    with pytest.raises(DataError, match="diverged"):
        run_experiment(small_plan(ur10, 1, points=1, levels=(1.0,), period=200), [broken])


@pytest.mark.parametrize(
    "hidden", ["joint_coupling@wrist_2_joint:ratio=0.3", "gravity_spring@elbow_joint:stiffness=300,rest_angle=1.0"]
)
def test_motions_are_followed_whatever_is_hidden(ur10, hidden):
    plan = small_plan(ur10, 1, points=1, levels=(1.0,), validation_points=0, period=500, periods=2, trajectory=True)
    data = run_experiment(plan, [parse_effect(hidden, ur10)], noise=0.0)
    (motion,) = data.select(kind="trajectory")
    assert np.allclose(motion.q[:20], motion.q_ref[:20], atol=1e-9)
    assert np.abs(motion.q - motion.q_ref).max() < 0.1
