"""The exported model, simulated in closed loop along held-out motion, gains what the prediction says."""

import json
from types import SimpleNamespace

import numpy as np
import pytest

from benchmarks.bench_export import both_gains
from ident import simulated_gain
from ident.dataset_io import load_dataset
from ident.diagnosis import diagnose_fully
from ident.excitation import operating_points
from ident.extended import predict
from ident.identification import set_up
from ident.leftover import SHOWN_WEIGHT
from ident.model import Model
from ident.records import build_groups
from ident.reporting import torque_traces
from ident.show.export import write_mjcf
from ident.show.replay import equilibrium, load_arm, replay, sampled_impedance
from ident.show.simulated_gain import export_baseline, gain_beside, spread
from robot_assets.errors import DataError
from robot_assets.robot import load_robot
from sim.effects import make_effect
from sim.experiment import plan_experiment
from tests.conftest import quick_experiment, through_files

pytestmark = pytest.mark.xdist_group("replay")  # one worker makes what they share

CLOSE = 0.1  # of the gap, as the exported model is to agree


def drive_data(*effects, noise=0.1, trajectory=False, validation=1):
    """A two-inertia drive that moves far beyond its noise."""
    robot = load_robot("twomass")
    postures = operating_points(robot, 1 + validation, np.random.default_rng(1))
    options = {
        "points": 1,
        "validation_points": validation,
        "levels": (2.0, 0.8),
        "period": 1000,
        "trajectory": trajectory,
    }
    plan = plan_experiment(robot, postures, seed=1, **options)
    return quick_experiment(plan, effects, seed=1, noise=noise)


def arm_data(*effects):
    """The UR10 in two postures, one of them held out."""
    robot = load_robot("ur10")
    postures = operating_points(robot, 2, np.random.default_rng(2))
    options = {"points": 1, "validation_points": 1, "levels": (1.0,), "period": 2000, "trajectory": False}
    return quick_experiment(plan_experiment(robot, postures, seed=2, **options), effects, seed=2)


@pytest.fixture(scope="module")
def clean_drive():
    return drive_data(trajectory=True)


def test_the_impedance_of_the_file_is_that_of_the_model():
    """Differences of integration steps against the matrices of the gray-box, images of the hold apart."""
    robot = load_robot("ur10")
    posture = operating_points(robot, 1, np.random.default_rng(0))
    data = quick_experiment(
        plan_experiment(robot, posture, points=1, validation_points=0, levels=(1.0,), period=500, trajectory=False)
    )
    setup = set_up(data)
    model, group = Model(setup.problem.structure, setup.problem.nominal), setup.problem.groups[0]
    arm = load_arm(
        export_baseline(model, setup.problem.sampling), robot.joint_names, setup.problem.sampling.sample_time
    )
    rest, hold = equilibrium(arm, group.posture)
    got = sampled_impedance(arm, rest, hold, group.omega, 4)[1 : group.n_compared]
    prediction = predict(model, group, setup.problem.sampling)
    want = prediction.sampled_impedance[1 : group.n_compared]
    size = np.sqrt(np.einsum("kii,kjj->kij", abs(want), abs(want)))
    assert np.all(np.abs(got - want) <= 5e-3 * size)
    driven = setup.problem.structure.driven
    assert np.allclose(hold, prediction.plane.lin.g[driven], rtol=1e-6, atol=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["multisine", "trajectory"])
def test_a_true_model_needs_the_torque_that_was_recorded(clean_drive, kind):
    """Nothing hidden and the true parameters: what is left is the noise, of which the slow motion has more."""
    setup = set_up(clean_drive)
    groups = build_groups(clean_drive, role=None)
    group = next(g for g in groups if (g.window is None) == (kind == "multisine"))
    model = Model(setup.problem.structure, setup.problem.nominal)
    arm = load_arm(
        export_baseline(model, setup.problem.sampling), clean_drive.joints, setup.problem.sampling.sample_time
    )
    done = replay(arm, group, setup.problem.sampling)
    predicted = predict(model, group, setup.problem.sampling).U
    size = np.linalg.norm(group.observe(group.U)[:, 1:])
    assert np.linalg.norm(group.observe(done.U - predicted)[:, 1:]) < 2e-3 * size
    assert np.linalg.norm(group.observe(done.U - group.U)[:, 1:]) < (0.05 if kind == "multisine" else 0.2) * size
    assert np.all(done.tracking < 5e-3 * np.std(group.to_time(group.Q), axis=1))
    assert done.change < 0.02


def test_offset_timing_and_roll_off_of_the_record_are_no_part_of_the_motor(clean_drive):
    setup = set_up(clean_drive)
    group = setup.held_out[0]
    model = Model(setup.problem.structure, setup.problem.nominal)
    plain, late = (export_baseline(model, setup.problem.sampling) for _ in range(2))
    for key, value in {"timing": 2e-4, "roll_off": 1e-7, "torque_offset.drive": 0.5}.items():
        number = late.add_numeric(name=f"simgap.record.{key}")
        number.data, number.size = [value], 1
    a, b = (replay(load_arm(x, clean_drive.joints, 1e-3), group, setup.problem.sampling).U for x in (plain, late))
    a = a * (np.exp(2e-4j * group.omega) * (1.0 - 1e-7 * group.omega**2))[:, None]
    a[:, 0] += 0.5
    assert np.linalg.norm(group.observe(a - b)) < 1e-3 * np.linalg.norm(group.observe(a))


DRIVE = [
    make_effect("coulomb_friction", "drive", torque=0.3, asymmetry=0.1),
    make_effect("torque_delay", "drive", delay=1.07e-3),
    make_effect("hardening_stiffness", "drive", cubic=3e7),
    make_effect("gravity_spring", "drive", stiffness=5.0, rest_angle=0.3),
]
MORE_DRIVE = [
    make_effect("torque_lag", "drive", time_constant=1e-3),
    make_effect("presliding_friction", "drive", stiffness=100.0, coulomb=0.3),
    make_effect("cogging", "drive", amplitude=0.2, periods_per_rev=40.0, phase=0.3),
    make_effect("sensor_delay", "drive", delay=1e-3),
]
ARM = [
    make_effect("payload", "flange", mass=2.0, com_x=0.02, com_y=0.0, com_z=0.08),
    make_effect("coulomb_friction", "elbow_joint", torque=3.0, asymmetry=0.1),
    make_effect("torque_delay", "shoulder_lift_joint", delay=1.3e-3),
    make_effect("hardening_stiffness", "shoulder_lift_joint", cubic=5e9),
    make_effect("backlash", "shoulder_lift_joint", gap=3e-4),  # which the links' weight closes on one side
    make_effect("gravity_spring", "elbow_joint", stiffness=40.0, rest_angle=0.3),
    make_effect("hysteresis", "elbow_joint", stiffness=8e3, yield_torque=4.0),
    make_effect("torque_saturation", "shoulder_lift_joint", limit=95.0),  # which both postures reach
]


@pytest.mark.parametrize(
    "effect", [*DRIVE, *(pytest.param(e, marks=pytest.mark.slow) for e in MORE_DRIVE)], ids=lambda e: e.name
)
def test_the_simulated_gain_of_a_drive_is_the_predicted_one(effect):
    predicted, simulated = both_gains(drive_data(effect), effect)
    assert predicted.gap_closed > 0.9
    assert simulated.gap_closed == pytest.approx(predicted.gap_closed, abs=CLOSE)
    assert simulated.before == pytest.approx(predicted.before, rel=0.05)


@pytest.mark.slow
@pytest.mark.parametrize("effect", ARM, ids=lambda e: e.name)
def test_the_simulated_gain_of_an_arm_is_the_predicted_one(effect):
    predicted, simulated = both_gains(arm_data(effect), effect, segments=1)
    assert predicted.gap_closed > 0.85
    assert simulated.gap_closed == pytest.approx(predicted.gap_closed, abs=CLOSE)


def test_the_file_of_a_diagnosis_gains_what_its_verdict_says(tmp_path):
    data = through_files(drive_data(make_effect("gravity_spring", "drive", stiffness=5.0, rest_angle=0.3)), tmp_path)
    diagnosis = diagnose_fully(data)
    assert [c.effect for c in diagnosis.verdict.causes] == ["gravity_spring"]
    write_mjcf(diagnosis, tmp_path / "model.xml")
    diagnosis.verdict.save(tmp_path)
    gain = simulated_gain(load_dataset(tmp_path / "dataset"), tmp_path / "model.xml")
    assert gain.noise_floor == pytest.approx(diagnosis.verdict.gain.noise_floor, rel=1e-12)
    assert gain.gap_closed == pytest.approx(diagnosis.verdict.gain.gap_closed, abs=CLOSE)
    assert "simulated" in gain.metric and gain.joints == diagnosis.verdict.gain.joints


def test_without_held_out_segments_there_is_nothing_to_simulate(tmp_path, monkeypatch):
    monkeypatch.setattr("ident.show.simulated_gain.identify", lambda *a, **k: pytest.fail("identified for nothing"))
    with pytest.raises(DataError, match="validation"):
        simulated_gain(drive_data(validation=0), tmp_path / "model.xml")


def test_a_few_segments_of_a_group_keep_their_order(clean_drive):
    group = build_groups(clean_drive, role="identification")[0]
    chosen = group.pick(spread(len(group.segments), 1))
    assert chosen.segments == group.segments[:1] and chosen.U.shape[0] == chosen.excited.shape[0] == 1
    assert list(spread(6, 3)) == [0, 2, 5] and list(spread(2, 4)) == [0, 1]


def test_joints_and_noise_are_those_of_the_verdict_beside_the_file(tmp_path):
    """Of the segments that it speaks of, and on no others."""
    gain = {"segments": ["a", "b"], "joints": ["x"], "by_joint": {"x": {"noise_floor": 0.5}, "y": {"noise_floor": 2.0}}}
    (tmp_path / "verdict.json").write_text(json.dumps({"dataset": "d", "gain": gain}))
    file = tmp_path / "model.xml"
    assert gain_beside(file, "d", ("x", "y"), ["b"]) == gain
    assert gain_beside(file, "another", ("x", "y"), ["b"]) is None
    assert gain_beside(file, "d", ("x", "y"), ["c"]) is None and gain_beside(file, "d", ("x", "z"), ["a"]) is None
    for other in (None, {k: v for k, v in gain.items() if k != "joints"}, {**gain, "by_joint": {"x": {}, "y": {}}}):
        (tmp_path / "verdict.json").write_text(json.dumps({"dataset": "d", "gain": other}))
        assert gain_beside(file, "d", ("x", "y"), ["a"]) is None
    assert gain_beside(tmp_path / "elsewhere" / "model.xml", "d", ("x", "y"), ["a"]) is None


def test_what_a_window_leaves_out_is_not_drawn(clean_drive):
    """A torque of the return of a motion, which nobody recorded, neither shows nor rings where the motion is shown."""
    group = next(g for g in build_groups(clean_drive, role=None) if g.window is not None)
    wrong = np.zeros((1, group.n_time, 1))
    wrong[:, group.window == 0.0] = 1.0
    before, after = (SimpleNamespace(U=U) for U in (group.U + group.to_lines(wrong), group.U))
    (trace,) = torque_traces([group], [(before, after)])
    assert len(trace.t) > 0.5 * np.sum(group.window > 0.0)
    assert np.abs(trace.before - trace.after).max() < 2e-3
    assert np.std(trace.q) == pytest.approx(np.std(group.to_time(group.Q)[0, group.window >= SHOWN_WEIGHT]), rel=0.05)
