"""Exported models, reports and recordings."""

import json
import re
import subprocess
import sys
import tomllib
from dataclasses import replace
from types import SimpleNamespace

import mujoco
import numpy as np
import pytest

from ident.chain import build_structure
from ident.cli import _verdict_text
from ident.graybox import Parameters, equilibrium, linearise, parameter_names
from ident.hypotheses.friction import friction_drift
from ident.hypotheses.structure import Change, apply_change
from ident.model import Effect
from ident.notes import refitted_note, sentence
from ident.notes import told as told_of
from ident.plan import make_plan
from ident.plan_file import plan_from_toml
from ident.show.export import build_mjcf, write_model_toml
from ident.show.figures import rounded, shown_joints, trace_figure
from ident.show.outputs import write_outputs
from ident.show.recording import _log_torques, part
from ident.show.report import unbroken, write_report
from ident.simulable import not_simulated, not_simulated_note
from ident.verdict import (
    LEFT_OUT,
    Cause,
    Diagnosis,
    Discrepancy,
    EvidencePlot,
    FrfView,
    Gain,
    JointGain,
    SpectrumMap,
    TorqueTrace,
    Value,
    Verdict,
    Where,
)
from robot_assets.robot import Elasticity, load_robot
from sim.plant import build_plant


def cause(effect, joint, **values):
    return Cause(effect, joint, {k: Value(v, 0.01 * abs(v), "SI") for k, v in values.items()}, 0.97, "because", ())


def parameters(robot):
    x = np.exp(Parameters.nominal(robot).to_log())
    return dict(zip(parameter_names(robot), x, strict=True))


def test_the_exported_arm_has_the_inertia_and_gravity_of_the_model(ur10):
    model = build_mjcf(ur10, parameters(ur10)).compile()
    data = mujoco.MjData(model)
    q = np.array([0.3, -1.0, 0.8, 0.2, 0.6, -0.4])
    link = np.array([model.joint(f"link:{j}").qposadr[0] for j in ur10.joint_names])
    motor = np.array([model.joint(f"motor:{j}").qposadr[0] for j in ur10.joint_names])
    delta = np.linspace(-1e-3, 1e-3, 6)
    data.qpos[link], data.qpos[motor] = q, q + delta
    mujoco.mj_forward(model, data)
    M = np.zeros((model.nv, model.nv))
    mujoco.mj_fullM(model, data, M)
    lin = linearise(build_structure(ur10), q)
    assert np.allclose(M[np.ix_(link, link)], lin.M, rtol=1e-6, atol=1e-8)
    assert np.allclose(data.qfrc_bias[link], lin.g, rtol=1e-6, atol=1e-6)
    assert np.allclose(data.qfrc_passive[link], ur10.array("stiffness") * delta, rtol=1e-9)
    assert np.allclose(np.diag(M)[motor], ur10.array("motor_inertia"), rtol=1e-6)


def with_moments(folder, moments):
    """The irb in another folder, each link with these principal moments of inertia about axes drawn at random."""
    rng = np.random.default_rng(0)

    def inertia(_):
        R = np.linalg.qr(rng.normal(size=(3, 3)))[0]
        I = (R @ np.diag(moments) @ R.T).tolist()
        return f'<inertia ixx="{I[0][0]}" ixy="{I[0][1]}" ixz="{I[0][2]}" iyy="{I[1][1]}" iyz="{I[1][2]}" izz="{I[2][2]}"/>'

    for file in load_robot("irb").folder.iterdir():
        if file.is_file():
            (folder / file.name).write_text(re.sub("<inertia .*/>", inertia, file.read_text()))
    return load_robot(folder)


@pytest.mark.parametrize("largest", [1.8, 1.82, 2.6])
def test_flat_links_are_exported_and_simulated(tmp_path, largest):
    """The largest moment of inertia of a flat body is the sum of the others, which the digits of a file pass, and some
    files by far: their nearest body is simulated."""
    robot = with_moments(tmp_path, [0.7, 1.1, largest])
    spec = build_mjcf(robot, parameters(robot))
    spec.compile()
    again = mujoco.MjModel.from_xml_string(spec.to_xml())
    moments = np.sort([again.body(i).inertia for i in range(again.nbody) if again.body(i).inertia.max() > 1.0])
    assert len(moments) == robot.n
    expected = np.array([0.7, 1.1, largest]) + (largest - 1.8) / 3.0 * np.array([1.0, 1.0, -1.0])
    assert np.allclose(moments[:-1], expected, rtol=2e-5)  # the last bears what is fixed to it
    assert build_plant(robot).model.nv > robot.n


HINGES = [
    cause("transverse_elasticity", "elbow_joint", stiffness=2e4, damping=20.0, axis_x=1.0, axis_y=0.0, axis_z=0.0),
    cause("base_elasticity", "base", stiffness=5e5, damping=500.0, axis_x=1.0, axis_y=0.0, axis_z=0.0),
    cause("base_elasticity", "base", stiffness=4e5, damping=400.0, axis_x=0.0, axis_y=1.0, axis_z=0.0),
]
BEFORE = cause(
    "transverse_elasticity", "elbow_joint", stiffness=2e4, damping=20.0, axis_x=0.6, axis_y=0.0, axis_z=0.8, before=1.0
)


@pytest.mark.parametrize(
    ("robot_name", "causes"),
    # A hinge along another with no mass between them has no inertia of its own: the irb gets one at joint_5 alone.
    [("ur10", []), ("ur10", HINGES), ("ur10", [BEFORE]), ("irb", []), ("irb", [replace(HINGES[0], joint="joint_5")])],
    ids=["ur10", "ur10-hinges", "ur10-hinge-before", "irb", "irb-hinge"],
)
def test_the_exported_arm_linearises_to_the_matrices_of_the_model(robot_name, causes):
    """d(acceleration)/d(position, velocity, drive) by central differences against the gray-box."""
    robot = load_robot(robot_name)
    model = mujoco.MjModel.from_xml_string(_xml(robot, causes))
    values = [{k: v.value for k, v in c.parameters.items()} for c in causes]
    hinges = tuple(
        Elasticity(f"h{i}", c.joint, tuple(v[f"axis_{a}"] for a in "xyz"), v["stiffness"], v["damping"], "before" in v)
        for i, (c, v) in enumerate(zip(causes, values, strict=True))
    )
    structure, par = apply_change(build_structure(robot), Parameters.nominal(robot), Change(elasticities=hinges))
    rng = np.random.default_rng(3)
    q_m = rng.uniform(-1, 1, robot.n)
    q = equilibrium(structure, par, q_m)
    lin = linearise(structure, q)
    chain = [
        mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_BODY, f"body:{_exported(n, causes)}")
        for n in structure.model.names[1:]
    ]
    coordinate = {structure.model.idx_vs[i + 1]: int(model.body_jntadr[b]) for i, b in enumerate(chain)}
    link = np.array([coordinate[c] for c in range(structure.n_coordinates)])
    motor = np.array([model.joint(f"motor:{j}").qposadr[0] for j in robot.joint_names])
    order = np.concatenate([motor, link])
    n, N = robot.n, structure.n_coordinates
    S = np.zeros((N, n))
    S[structure.driven, np.arange(n)] = 1.0
    E = np.vstack([np.eye(n), -S])
    mass = np.block([[np.diag(par.inertia), np.zeros((n, N))], [np.zeros((N, n)), lin.M]])
    elastic_k, elastic_d = np.zeros(n + N), np.zeros(n + N)
    elastic_k[n + structure.elastic], elastic_d[n + structure.elastic] = par.elastic_stiffness, par.elastic_damping
    stiffness = E @ np.diag(par.stiffness) @ E.T + np.diag(elastic_k)
    stiffness[n:, n:] += lin.Kg
    damping = E @ np.diag(par.damping) @ E.T + np.diag(elastic_d)
    damping[:n, :n] += np.diag(par.viscous)
    data = mujoco.MjData(model)
    hold = par.stiffness * (q_m - q[structure.driven])

    def acceleration(x, v, u):
        data.qpos[order], data.qvel[order], data.ctrl[:] = x, v, u
        mujoco.mj_forward(model, data)
        return data.qacc[order].copy()

    def slope(f, size, h):
        return np.stack([(f(h * e) - f(-h * e)) / (2 * h) for e in np.eye(size)], axis=1)

    x, zero = np.concatenate([q_m, q]), np.zeros(n + N)
    got = mass @ slope(lambda d: acceleration(x + d, zero, hold), n + N, 1e-6)
    scale = np.sqrt(np.outer(np.diag(stiffness), np.diag(stiffness)))
    assert np.all(np.abs(got + stiffness) <= 1e-4 * scale)
    got = mass @ slope(lambda d: acceleration(x, d, hold), n + N, 1e-5)
    assert np.allclose(got, -damping, rtol=1e-4, atol=1e-4 * np.abs(damping).max())
    got = mass @ slope(lambda d: acceleration(x, zero, hold + d), n, 1e-3)
    assert np.allclose(got, np.vstack([np.eye(n), np.zeros((N, n))]), atol=1e-4)
    assert np.allclose(mass @ acceleration(x, zero, hold), 0.0, atol=1e-3 * np.abs(lin.g).max())


def _xml(robot, causes):
    spec = build_mjcf(robot, parameters(robot), causes)
    spec.compile()
    return spec.to_xml()


def _exported(name, causes):
    """Name in the exported arm of a joint of the test's own chain."""
    for i, c in enumerate(causes):
        if name == f"elasticity:h{i}":
            return f"elasticity:{c.effect}:{c.joint}:{i}"
    return name


def test_effects_at_one_joint_add_up(ur10):
    """A spring's rest is in radians; a second effect leaves the first in place."""
    causes = [
        cause("gravity_spring", "elbow_joint", stiffness=60.0, rest_angle=0.3),
        cause("dress_pack", "elbow_joint", stiffness=30.0, friction=0.3),
        cause("coulomb_friction", "elbow_joint", torque=2.0, asymmetry=0.1),
        cause("presliding_friction", "elbow_joint", stiffness=1e3, coulomb=1.0),
        cause("hardening_stiffness", "elbow_joint", cubic=1e8),
        cause("softening_stiffness", "elbow_joint", low_stiffness=1e4, transition=1e-3),
        cause("joint_coupling", "shoulder_lift_joint", ratio=0.1),
    ]
    model = mujoco.MjModel.from_xml_string(_xml(ur10, causes))
    data = mujoco.MjData(model)
    link, motor = model.joint("link:elbow_joint"), model.joint("motor:elbow_joint")
    assert model.dof_frictionloss[motor.dofadr[0]] == pytest.approx(2.0)
    assert model.nu == 6 and model.nactuator == 8  # beside the drives: an offset of friction, a bristle
    data.qpos[link.qposadr[0]] = data.qpos[motor.qposadr[0]] = 0.5
    mujoco.mj_forward(model, data)
    assert data.qfrc_passive[link.dofadr[0]] == pytest.approx(-(60.0 * (0.5 - 0.3) + 30.0 * 0.5), rel=1e-5)
    for delta, slope in ((0.5e-3, 0.0), (3e-3, 1.0)):
        data.qpos[link.qposadr[0]], data.qpos[motor.qposadr[0]] = 0.0, 0.0
        data.qpos[model.joint("motor:shoulder_lift_joint").qposadr[0]] = 10 * delta
        mujoco.mj_forward(model, data)
        k = ur10.array("stiffness")[2]
        torque = 1e4 * delta + 1e8 * delta**3 + slope * (k - 1e4) * (delta - 1e-3)
        assert data.qfrc_passive[motor.dofadr[0]] == pytest.approx(-torque, rel=1e-5)


@pytest.mark.parametrize(
    "made",
    [
        cause("coulomb_friction", "elbow_joint", torque=3.0, asymmetry=0.1),
        cause("torque_constant", "elbow_joint", scale=1.1),
        cause("torque_delay", "elbow_joint", delay=0.002),
        cause("torque_lag", "elbow_joint", time_constant=0.002),
        cause("torque_saturation", "elbow_joint", limit=50.0),
        cause("hardening_stiffness", "elbow_joint", cubic=1e8),
        cause("backlash", "elbow_joint", gap=1e-3),
        cause("softening_stiffness", "elbow_joint", low_stiffness=1e4, transition=1e-3),
        cause("gravity_spring", "elbow_joint", stiffness=50.0, rest_angle=0.3),
        cause("dress_pack", "elbow_joint", stiffness=50.0, friction=0.3),
        cause("joint_coupling", "elbow_joint", ratio=0.1),
        cause("payload", "flange", mass=2.0, com_x=0.0, com_y=0.1, com_z=0.0),
        cause("link_inertia", "forearm_link", mass=1.2, com_x=0.0, com_y=0.01, com_z=0.0, inertia=1.1),
        cause("transverse_elasticity", "elbow_joint", stiffness=2e4, damping=20.0, axis_x=1.0, axis_y=0.0, axis_z=0.0),
        cause("base_elasticity", "base", stiffness=5e5, damping=500.0, axis_x=1.0, axis_y=0.0, axis_z=0.0),
        cause("cogging", "elbow_joint", amplitude=1.0, periods_per_rev=101.0, phase=0.2),
        cause("stribeck_friction", "elbow_joint", coulomb=2.0, static=3.0, stribeck_velocity=0.03),
        cause("presliding_friction", "elbow_joint", stiffness=1e3, coulomb=2.0),
        cause("hysteresis", "elbow_joint", stiffness=1e4, yield_torque=2.0),
        cause("sensor_delay", "elbow_joint", delay=0.002),
        cause("load_dependent_friction", "elbow_joint", coefficient=0.05),
    ],
    ids=lambda c: c.effect,
)
def test_every_effect_is_exported_into_a_model_that_compiles_and_runs(ur10, made):
    spec = build_mjcf(ur10, parameters(ur10), [made])
    model = mujoco.MjModel.from_xml_string(spec.to_xml()) if spec.compile() else None
    data = mujoco.MjData(model)
    for _ in range(20):
        mujoco.mj_step(model, data)
    assert np.all(np.isfinite(data.qpos))
    names = [model.numeric(i).name for i in range(model.nnumeric)]
    assert any(name.startswith(f"simgap.0.{made.effect}.{made.joint}.") for name in names)
    assert mujoco.mj_id2name(model, mujoco.mjtObj.mjOBJ_TEXT, 0) == "simgap.effect.0"
    note = bytes(model.text_data).decode()
    assert note.startswith(f"{made.effect} at {made.joint}, probability 0.970")
    assert ("not simulated" in note) == (made.effect == "load_dependent_friction")


@pytest.mark.parametrize(
    ("made", "told"),
    [
        (cause("coulomb_friction", "elbow_joint", torque=2.0), "frictionloss of motor:elbow_joint"),
        (
            cause("coulomb_friction", "elbow_joint", torque=2.0, asymmetry=0.1),
            "frictionloss of motor:elbow_joint, passive:0",
        ),
        (cause("presliding_friction", "elbow_joint", stiffness=1e3, coulomb=2.0, exponent=1.0), "passive:0"),
        (
            cause("presliding_friction", "elbow_joint", stiffness=1e3, coulomb=2.0, exponent=50.0),
            "friction:0.0",
        ),
        (cause("torque_lag", "elbow_joint", time_constant=0.002), "filter of first order of drive:elbow_joint"),
        (
            cause("dress_pack", "elbow_joint", stiffness=50.0, friction=0.3, yield_angle=0.01),
            "spring of link:elbow_joint, friction:0.0",
        ),
        (
            replace(cause("joint_coupling", "wrist_3_joint", ratio=0.1), joints=("wrist_3_joint", "wrist_2_joint")),
            "motor:wrist_3_joint in gear:wrist_2_joint",
        ),
        (
            cause("backlash", "elbow_joint", gap=1e-3, loose=2e-3),
            "springlength of gear:elbow_joint; not simulated: that the damper of elbow_joint is loose within its backlash too",
        ),
    ],
    ids=lambda x: x.effect if isinstance(x, Cause) else "",
)
def test_the_file_says_which_elements_it_has(ur10, made, told):
    text = build_mjcf(ur10, parameters(ur10), [made]).text("simgap.effect.0").data
    assert text.rpartition("; element: ")[2] == told


def test_what_mujoco_cannot_simulate_is_said():
    friction = cause("load_dependent_friction", "elbow_joint", coefficient=0.05)
    loose = cause("backlash", "wrist_1_joint", gap=1e-3, loose=2e-3)
    slips = cause("presliding_friction", "elbow_joint", stiffness=1e3, coulomb=2.0, spread=0.4)
    damped = replace(slips, parameters=slips.parameters | {"relaxation": Value(1e-6, 1e-5, "s")})
    assert not_simulated_note([slips, damped, cause("coulomb_friction", "elbow_joint", torque=1.0)]) == ()
    (note,) = not_simulated_note([friction, slips, loose])
    assert "load dependent friction at elbow_joint; " in note and "loose within its backlash" in note
    for knee, lost in ((0.01, False), (0.1, True)):
        assert bool(not_simulated(cause("torque_saturation", "elbow_joint", limit=50.0, knee=knee))) == lost


def test_the_parameter_file_says_what_is_of_which_channel_and_joints(diagnosis, tmp_path):
    causes = (
        replace(cause("sensor_delay", "elbow_joint", delay=1e-3), channel="q_link"),
        replace(cause("joint_coupling", "wrist_3_joint", ratio=0.1), joints=("wrist_3_joint", "wrist_2_joint")),
        cause("transmission_error", "elbow_joint", amplitude=1e-4, periods_per_rev=50.0, phase=0.1),
    )
    write_model_toml(replace(diagnosis, verdict=replace(diagnosis.verdict, causes=causes)), tmp_path / "model.toml")
    toml = tomllib.loads((tmp_path / "model.toml").read_text(encoding="utf-8"))
    late, coupled, error = toml["effect"]
    assert late["channel"] == "q_link" and coupled["joints"] == ["wrist_3_joint", "wrist_2_joint"]
    assert "channel" not in coupled and "joints" not in error
    assert [x["simulated"] for x in toml["effect"]] == [True, True, False]
    assert toml["not_simulated"] == ["transmission error at elbow_joint"]


@pytest.fixture
def diagnosis(ur10):
    rng = np.random.default_rng(0)
    t = np.arange(0, 2, 0.01)
    q = np.cumsum(rng.normal(size=(len(t), 6)), axis=0) * 1e-3
    trace = TorqueTrace("op03", t, *(rng.normal(size=(len(t), 6)) for _ in range(3)), q)
    values = {k: Value(v, 0.01 * v, "SI") for k, v in parameters(ur10).items()}
    verdict = Verdict(
        "a<b",
        values,
        Discrepancy(True, 0.0, 12.0, ()),
        (cause("coulomb_friction", "elbow_joint", torque=3.0),),
        0.01,
        "noise floor reached",
        Gain(("op03",), "RMS", 1.0, 0.1, 0.09, 0.98, (0.9, 0.99), "validation segments"),
        None,
        "It misses friction.",
    )
    spectrum = SpectrumMap(np.linspace(0, 70, 9), *(rng.random((1, 6, 8)) + 0.1 for _ in range(3)), ("op01",))
    plot = EvidencePlot(0, "friction", "v", "tau", *(rng.normal(size=50) for _ in range(4)))
    f = np.geomspace(1, 70, 40)
    views = tuple(FrfView(f"op0{i}", f, *(rng.random((40, 6, 6)) + 0.1 for _ in range(4))) for i in (1, 2))
    return Diagnosis(verdict, ur10, ur10.joint_names, views, spectrum, (plot,), (trace,), parameters(ur10), 1.0)


def test_the_report_shows_what_is_left_over(diagnosis, tmp_path):
    (plot,) = diagnosis.evidence
    verdict = replace(diagnosis.verdict, residual_description="The residual torque sits mostly at elbow_joint.")
    left = replace(diagnosis, verdict=verdict, evidence=(plot, replace(plot, cause=None)))
    for shown, told in ((diagnosis, 0), (left, 1)):
        write_report(shown, tmp_path / "report.html")
        html = (tmp_path / "report.html").read_text(encoding="utf-8")
        assert html.count("What is left over") == html.count("sits mostly at elbow_joint.") == told
        assert html.count("residual without the cause") == 1 and html.count("law that explains most of it") == told


@pytest.mark.slow
def test_all_outputs_are_written_whole(diagnosis, tmp_path):
    write_outputs(diagnosis, tmp_path / "out")
    verdict = json.loads((tmp_path / "out" / "verdict.json").read_text())
    assert verdict["schema"] == "simgap-verdict/1" and verdict["causes"][0]["parameters"]["torque"]["value"] == 3.0
    assert set(verdict) >= {"dataset", "baseline", "discrepancy", "causes", "unexplained", "gain", "next_experiment"}
    html = (tmp_path / "out" / "report.html").read_text()
    assert len(html) < 3e6 and not re.search("#0a0b[01]", html)
    assert (
        "It misses friction." in html
        and "a&lt;b" in html
        and "<svg" in html
        and "http://"
        not in html.replace("http://www.w3.org", "")
        .replace("http://purl.org", "")
        .replace("http://creativecommons.org", "")
    )
    toml = tomllib.loads((tmp_path / "out" / "model.toml").read_text())
    assert toml["effect"][0]["name"] == "coulomb_friction"
    assert mujoco.MjModel.from_xml_path(str(tmp_path / "out" / "model.xml")).nu == 6
    assert (tmp_path / "out" / "recording.rrd").stat().st_size > 10_000


@pytest.mark.slow
def test_the_next_plan_is_written_and_an_old_one_taken_away(diagnosis, ur10, tmp_path):
    plan = make_plan(ur10, points=1, validation_points=0, period=500, trajectory=False)
    write_outputs(replace(diagnosis, next_plan=plan), tmp_path / "out")
    again = plan_from_toml(tmp_path / "out" / "next_plan.toml")
    assert len(again.experiments) == len(plan.experiments)
    assert np.allclose(again.experiments[3].r, plan.experiments[3].r, atol=1e-9)
    write_outputs(diagnosis, tmp_path / "out")
    assert not (tmp_path / "out" / "next_plan.toml").exists()


def test_torques_are_shown_at_the_joints_of_causes_first(diagnosis):
    """Then where the discrepancy is, then of the gain, then where the baseline errs most relative to the torque."""
    joints = tuple("abcdef")
    measured = np.tile(np.sin(np.arange(50.0))[:, None], 6)
    errors = np.array([0.01, 0.5, 0.02, 0.4, 0.3, 0.03]) * measured
    errors[:, 5] = 0.6  # a static one
    trace = TorqueTrace("s", np.arange(50.0), measured, measured - errors, measured, measured)
    gain = replace(diagnosis.verdict.gain, joints=("c",))
    verdict = replace(diagnosis.verdict, causes=(), gain=None)
    coupled = replace(cause("joint_coupling", "c", ratio=0.1), joints=("c", "a"))
    where = replace(verdict.discrepancy, where=(Where("d", "tau", "motion", 0.2), Where("e", "tau", "motion", 0.7)))
    for told, shown in (
        (verdict, "fbd"),
        (replace(verdict, gain=gain), "cfb"),
        (replace(verdict, gain=gain, discrepancy=where), "edc"),
        (replace(verdict, discrepancy=where, causes=(coupled, cause("payload", "flange", mass=1.0))), "cae"),
    ):
        assert shown_joints(told, trace, joints) == list(shown)
    figure = trace_figure(trace, joints, ("N m",) * 6, ["e", "a"])
    assert [j for j in joints if f"<!-- {j} -->" in figure] == ["a", "e"]


def test_forces_and_torques_are_told_in_their_own_units(diagnosis, monkeypatch, tmp_path):
    """And no number stands for joints of both kinds."""
    names = diagnosis.joints
    gain = replace(
        diagnosis.verdict.gain, joints=names[:1], by_joint={name: JointGain(1.0, 0.1, 0.09) for name in names}
    )
    shown = replace(diagnosis, verdict=replace(diagnosis.verdict, gain=gain), frf=(), spectrum=None)
    for linear, told in (((False,) * 6, True), ((True, *(False,) * 5), False)):
        monkeypatch.setattr("ident.units.linear_joints", lambda robot, linear=linear: linear)
        write_report(shown, tmp_path / "report.html")
        html = (tmp_path / "report.html").read_text(encoding="utf-8").replace("\N{NO-BREAK SPACE}", " ")
        html = html.replace("&nbsp;", " ")
        first, second = ("N m", "N m") if told else ("N", "N m")
        assert f"{names[0]} 1 → 0.1 {first} (noise" in html and f"{names[1]} 1 → 0.1 {second} (noise" in html
        assert ("of all joints" in html) == ("of all joints" in _verdict_text(shown, tmp_path)) == told


def test_the_report_says_which_segments_were_fitted(diagnosis, tmp_path):
    for method, told in (
        ("validation segments", "op03, held out"),
        (LEFT_OUT, "op03, to which the models were fitted"),
    ):
        gain = replace(diagnosis.verdict.gain, method=method)
        write_report(replace(diagnosis, verdict=replace(diagnosis.verdict, gain=gain)), tmp_path / "report.html")
        assert told in (tmp_path / "report.html").read_text(encoding="utf-8")


def test_the_same_data_are_the_same_picture():
    t = np.arange(50.0)
    measured = np.sin(t)[:, None]
    trace = TorqueTrace("s", t, measured, 0.9 * measured, measured, measured)
    first, again = (trace_figure(trace, ("a",), ("N m",), ("a",)) for _ in range(2))
    assert "url(#" in first and first == again


def test_recordings_draw_what_the_extended_model_leaves_on_top(diagnosis):
    """The viewer draws curves in the order of their paths."""
    paths = []
    stream = SimpleNamespace(log=lambda path, *a, **k: paths.append(path), send_columns=lambda *a: None)
    _log_torques(stream, diagnosis.traces[0], diagnosis.joints)
    for what, kinds in (("torque", ["measured", "before", "after"]), ("error", ["before", "after"])):
        of_joint = sorted(p for p in paths if p.startswith(f"{what}/{part(diagnosis.joints[0])}/"))
        assert [p.rpartition("_")[2] for p in of_joint] == kinds


def test_pictures_have_plain_colours_before_those_of_the_page():
    """For programs that know no variables."""
    t = np.arange(50.0)
    trace = TorqueTrace("s", t, *(np.sin(t + x)[:, None] for x in range(4)))
    figure = trace_figure(trace, ("a",), ("N m",), ("a",))
    assert "stroke: #c8553d; stroke: var(--before)" in figure and "#0a0b" not in figure
    assert figure.count("var(--") == len(re.findall(r"([a-z-]+): #\w{6}; \1: var\(--", figure))


def test_no_more_than_the_whole_gap_is_told(diagnosis, tmp_path):
    """By the sentence and the tile alike; verdict.json has what was computed."""
    gain = replace(diagnosis.verdict.gain, gap_closed=1.044, ci95=(0.18, 1.557))
    verdict = replace(diagnosis.verdict, gain=gain)
    assert "closes 100.0% of the gap" in sentence(verdict.causes, False, True, gain)
    write_report(replace(diagnosis, verdict=verdict), tmp_path / "report.html")
    html = (tmp_path / "report.html").read_text(encoding="utf-8")
    assert "<b>100.0 %</b>" in html and "95 % interval 18.0 to 100.0 %" in html
    assert verdict.to_dict()["gain"]["gap_closed"] == 1.044
    assert replace(gain, gap_closed=-0.09, ci95=(0.0, 0.0)).closed_told == -0.09
    assert replace(gain, ci95=(0.0, 0.0)).interval_told is None


def test_a_model_without_causes_that_predicts_worse_says_what_it_changed(diagnosis):
    names = tuple(diagnosis.parameters)
    before = np.zeros(len(names))
    after = before.copy()
    after[2], after[5] = np.log(1.5), np.log(0.9)
    fits = [
        SimpleNamespace(names=names, model=SimpleNamespace(par=SimpleNamespace(to_log=lambda x=x: x), effects=()))
        for x in (before, after)
    ]
    gain = replace(diagnosis.verdict.gain, before=5.29, after=5.78, metric="RMS error, N m")
    (note,) = refitted_note(*fits, gain)
    assert f"({names[2]} by +0.5 times its value, {names[5]} by -0.1 times its value)" in note
    assert "5.78 in place of 5.29 N m" in note
    assert refitted_note(*fits, replace(gain, after=5.2)) == () == refitted_note(*fits, None)


def test_a_drift_of_a_friction_that_is_all_viscous_tells_no_dry_part():
    h = friction_drift(0, "drive")
    structure = SimpleNamespace(robot=load_robot("twomass"))
    for coulomb, told in ((1e-9, False), (0.2, True)):
        effect = Effect(h, np.array([0.3, 50.0, coulomb, 1e-3]))
        numbers = {"relative_change": 0.3, "time_constant": 50.0, "coulomb": coulomb}
        assert ("Coulomb" in told_of(effect, structure, numbers)) == told


def test_figures_leave_the_callers_matplotlib_alone():
    code = "import matplotlib as m; m.use('svg'); import ident.show.figures; assert m.get_backend() == 'svg'"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


@pytest.mark.slow
def test_a_failing_run_harms_no_earlier_output(diagnosis, tmp_path, monkeypatch):
    write_outputs(diagnosis, tmp_path / "out")
    before = {p.name: p.read_bytes() for p in (tmp_path / "out").iterdir()}
    monkeypatch.setattr("ident.show.outputs.write_mjcf", lambda *a: (_ for _ in ()).throw(OSError("disk full")))
    with pytest.raises(OSError, match="disk full"):
        write_outputs(diagnosis, tmp_path / "out")
    assert {p.name: p.read_bytes() for p in (tmp_path / "out").iterdir()} == before
    assert [p.name for p in tmp_path.iterdir()] == ["out"]


def test_numbers_are_rounded_to_their_standard_deviation():
    assert rounded(5.27081, 0.0036) == "5.2708 ± 0.0036"
    assert rounded(2.9e-05, 3.8e-05) == "(2.9 ± 3.8)·10⁻⁵"
    assert rounded(1.0, 0.0) == "1"
    assert rounded(1.5, float("nan")) == "1.5 ± nan"


def test_numbers_have_no_sign_of_zero_and_no_more_digits_than_anyone_reads():
    assert rounded(-1e-6, 9.3e-4) == "(0.0 ± 9.3)·10⁻⁴"
    assert rounded(-3.983e-43, 0.2) == "0.00 ± 0.20"
    assert rounded(-0.0, 0.0) == "0"
    assert rounded(4.836365824305e-5, 4.4e-16) == "4.83637·10⁻⁵ ± 4.4·10⁻¹⁶"
    assert rounded(-20123.456789, 1e-7) == "-20123.5 ± 1·10⁻⁷"
    assert rounded(1.23456789e9, 360.0) == "1.23457·10⁹ ± 360"
    assert rounded(1.2e7, 150.0) == "1.2·10⁷ ± 150" and rounded(999999.7, 1e-3) == "1·10⁶ ± 0.0010"
    assert rounded(9.99999999e-5, 1e-14) == "1·10⁻⁴ ± 1·10⁻¹⁴"
    assert rounded(20123.456, 0.36) == "20123.5 ± 0.36" and rounded(2012.345, 0.36) == "2012.35 ± 0.36"


def test_a_value_far_below_its_deviation_is_told_as_zero():
    assert Value(3.0, np.inf, "m").told == 3.0
    assert Value(-3.983e-43, 0.2, "m").told == 0.0 and str(Value(-0.0, 0.0, "m").told) == "0.0"
    assert Value(-0.1, 0.2, "m").told == -0.1 and Value(1.5, float("nan"), "m").told == 1.5


def test_units_of_the_report_do_not_break():
    assert unbroken(" N m/rad") == "\N{NO-BREAK SPACE}N\N{NO-BREAK SPACE}m/rad"
