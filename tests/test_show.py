"""Exported models, reports and recordings."""

import json
import tomllib

import mujoco
import numpy as np
import pytest

from ident.graybox import Parameters, build_structure, linearise, parameter_names
from ident.show.export import build_mjcf
from ident.show.outputs import write_outputs
from ident.verdict import Cause, Diagnosis, Discrepancy, EvidencePlot, Gain, SpectrumMap, TorqueTrace, Value, Verdict


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
        cause("link_inertia", "forearm_link", scale=1.2),
        cause("transverse_elasticity", "elbow_joint", stiffness=2e4, damping=20.0, axis_x=1.0, axis_y=0.0, axis_z=0.0),
        cause("base_elasticity", "base", stiffness=5e5, damping=500.0, axis_x=1.0, axis_y=0.0, axis_z=0.0),
        cause("cogging", "elbow_joint", amplitude=1.0, periods_per_rev=101.0, phase=0.2),
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


@pytest.fixture
def diagnosis(ur10):
    rng = np.random.default_rng(0)
    t = np.arange(0, 2, 0.01)
    q = np.cumsum(rng.normal(size=(len(t), 6)), axis=0) * 1e-3
    trace = TorqueTrace("op03", t, *(rng.normal(size=(len(t), 6)) for _ in range(3)), q)
    values = {k: Value(v, 0.01 * v, "SI") for k, v in parameters(ur10).items()}
    verdict = Verdict(
        "a<b", values, Discrepancy(True, 0.0, 12.0, ()), (cause("coulomb_friction", "elbow_joint", torque=3.0),), 0.01,
        "noise floor reached", Gain(("op03",), "RMS", 1.0, 0.1, 0.09, 0.98, (0.9, 0.99), "validation segments"), None, "It misses friction.",
    )
    spectrum = SpectrumMap(np.linspace(0, 70, 9), *(rng.random((1, 6, 8)) + 0.1 for _ in range(3)), ("op01",))
    plot = EvidencePlot(0, "friction", "v", "tau", *(rng.normal(size=50) for _ in range(4)))
    return Diagnosis(verdict, ur10, ur10.joint_names, (), spectrum, (plot,), (trace,), parameters(ur10), 1.0)


def test_all_outputs_are_written_whole(diagnosis, tmp_path):
    write_outputs(diagnosis, tmp_path / "out")
    verdict = json.loads((tmp_path / "out" / "verdict.json").read_text())
    assert verdict["schema"] == "simgap-verdict/1" and verdict["causes"][0]["parameters"]["torque"]["value"] == 3.0
    assert set(verdict) >= {"dataset", "baseline", "discrepancy", "causes", "unexplained", "gain", "next_experiment"}
    html = (tmp_path / "out" / "report.html").read_text()
    assert "It misses friction." in html and "a&lt;b" in html and "<svg" in html and "http://" not in html.replace("http://www.w3.org", "").replace("http://purl.org", "").replace("http://creativecommons.org", "")
    toml = tomllib.loads((tmp_path / "out" / "model.toml").read_text())
    assert toml["effect"][0]["name"] == "coulomb_friction"
    assert mujoco.MjModel.from_xml_path(str(tmp_path / "out" / "model.xml")).nu == 6
    assert (tmp_path / "out" / "recording.rrd").stat().st_size > 10_000


def test_a_failing_run_harms_no_earlier_output(diagnosis, tmp_path, monkeypatch):
    write_outputs(diagnosis, tmp_path / "out")
    before = {p.name: p.read_bytes() for p in (tmp_path / "out").iterdir()}
    monkeypatch.setattr("ident.show.outputs.write_mjcf", lambda *a: (_ for _ in ()).throw(OSError("disk full")))
    with pytest.raises(OSError, match="disk full"):
        write_outputs(diagnosis, tmp_path / "out")
    assert {p.name: p.read_bytes() for p in (tmp_path / "out").iterdir()} == before
    assert [p.name for p in tmp_path.iterdir()] == ["out"]
