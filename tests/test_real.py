"""Real data of a two-inertia bench through the whole path."""

from pathlib import Path

import numpy as np
import pytest

from benchmarks.published import references
from ident.checking import inspect_dataset
from ident.convert import convert_logs
from ident.dataset_io import load_dataset, save_dataset
from ident.diagnosis import diagnose_fully
from robot_assets.errors import DataError

ROOT = Path(__file__).parent.parent
DATA = ROOT.parent / "shared" / "data" / "twomass_multisine_fditools"
MAP = ROOT / "ident" / "convert" / "maps" / "twomass_multisine_fditools.toml"


@pytest.fixture(scope="module")
def bench(tmp_path_factory):
    if not DATA.is_dir():
        pytest.skip("the real data of twomass_multisine_fditools are not here")
    data = convert_logs([DATA / "raw" / "MultisineTypeB.mat"], "twomass", MAP, name="bench")
    folder = tmp_path_factory.mktemp("real") / "d"
    save_dataset(data, folder)
    return load_dataset(folder)


def test_the_import_agrees_with_the_published_si_signals(bench):
    std = np.load(DATA / "std_B.npz")
    s = bench.segments[0]
    assert np.allclose(s.tau[:, 0], std["i_q"][2500 : 2500 * 11], atol=1e-6)
    motion = s.q[:, 0] - std["theta_motor"][2500 : 2500 * 11]
    assert np.ptp(motion) < 1e-4
    assert len(s.excited_lines) == 60 and s.excited_lines[0] == 13 and s.excited_lines[-1] == 249


@pytest.mark.slow
def test_the_whole_path_on_real_data(bench):
    result = diagnose_fully(bench)
    p, verdict = result.parameters, result.verdict
    f_anti = np.sqrt(p["stiffness.drive"] / 0.00477) / 2 / np.pi
    assert f_anti == pytest.approx(54.05, abs=1.5)
    assert 1 / p["motor_inertia.drive"] == pytest.approx(209, rel=0.08)
    assert verdict.gain.method == "validation segments"
    assert "link_friction.drive" in verdict.baseline and not named(verdict)
    assert verdict.gain.after < 0.3 * verdict.gain.before
    assert verdict.discrepancy.detected


def test_a_map_or_log_that_does_not_fit_is_one_clear_error(tmp_path):
    log = tmp_path / "log.csv"
    log.write_text("a,b\n" + "1,2\n3,4\n" * 8)
    text = (
        'sample_rate = 100.0\n[columns]\ntau_1 = { source = "a", unit = "N m" }\nq_1 = { source = "%s", unit = "%s" }\n'
    )
    for source, unit, found in (("c", "rad", "no c"), ("b", "parsec", "parsec")):
        (tmp_path / "map.toml").write_text(text % (source, unit))
        with pytest.raises(DataError, match=found):
            convert_logs([log], "twomass", tmp_path / "map.toml")
    (tmp_path / "map.toml").write_text(text % ("b", "deg"))
    data = convert_logs([log], "twomass", tmp_path / "map.toml")
    assert np.allclose(data.segments[0].q[:, 0], np.deg2rad([2.0, 4.0] * 8))


def test_time_stamps_are_resampled_on_a_uniform_grid(tmp_path):
    t = np.sort(np.random.default_rng(0).uniform(0, 2, 400))
    t[0], t[-1] = 0.0, 2.0
    rows = "\n".join(f"{x},{np.sin(x)},{x}" for x in t)
    (tmp_path / "log.csv").write_text("time,tau,q\n" + rows + "\n")
    (tmp_path / "map.toml").write_text(
        'sample_rate = 200.0\n[time]\nsource = "time"\nunit = "s"\n[columns]\ntau_1 = "tau"\nq_1 = "q"\n'
    )
    s = convert_logs([tmp_path / "log.csv"], "twomass", tmp_path / "map.toml").segments[0]
    assert np.allclose(np.diff(s.t), 1 / 200) and np.abs(s.q[:, 0] - s.t).max() < 1e-9
    assert np.abs(s.tau[:, 0] - np.sin(s.t)).max() < 1e-3


def named(verdict):
    return {(c.effect, c.joint) for c in verdict.causes if c.probability > 0.5}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("folder", "robot", "files", "max_causes", "left"),
    [
        ("emps_drive", "emps", ["DATA_EMPS.mat"], 2, 0.25),
        ("kuka_kr300_dual_encoder", "kr300", None, 2, 0.45),
        ("ur10_unisa", "ur10_bare", None, 2, 0.35),
        (
            "panda_gaz_ral2019",
            "panda_bare",
            [f"exciting_traj_{x}.txt" for x in ("positions", "time", "torques", "velocity")],
            1,
            0.5,
        ),
        ("staubli_tx40", "tx40", None, 2, 0.4),
    ],
)
def test_real_motions_get_causes_that_their_publishers_know(folder, robot, files, max_causes, left, tmp_path):
    """From the logs to the verdict; ``left`` is the held-out error of the extended model over that of the first."""
    raw = DATA.parent / folder / "raw"
    if not raw.is_dir():
        pytest.skip(f"the real data of {folder} are not here")
    logs = sorted(p for p in raw.iterdir() if p.is_file()) if files is None else [raw / f for f in files]
    data = convert_logs(logs, robot, folder)
    save_dataset(data, tmp_path / "d")
    data = load_dataset(tmp_path / "d")
    assert inspect_dataset(data).joints == data.joints
    verdict = diagnose_fully(data, max_causes=max_causes).verdict
    assert verdict.gain.after < left * verdict.gain.before
    assert verdict.unexplained_verdict == "unknown cause remains"
    assert verdict.gain.over_all[1] < references(data, DATA.parent / folder).best.over_all
    frictions = {"coulomb_friction", "presliding_friction", "stribeck_friction"}
    rubbing = {j for e, j in named(verdict) if e in frictions}
    others = {(e, j) for e, j in named(verdict) if e not in frictions}
    if folder == "emps_drive":
        torque = next(c for c in verdict.causes if c.effect == "coulomb_friction").parameters["torque"].value
        assert rubbing == {"screw"} and torque == pytest.approx(20.39, rel=0.1)
    if folder == "kuka_kr300_dual_encoder":
        late = {c.joint: c.parameters["delay"].value for c in verdict.causes if c.effect == "sensor_delay"}
        assert all(late[j] == pytest.approx(3e-3, abs=0.2e-3) for j in ("axis_2", "axis_3"))
        assert ("gravity_spring", "axis_2") in others
        assert others <= {("gravity_spring", "axis_2"), *(("sensor_delay", f"axis_{j}") for j in (1, 2, 3))}
    else:
        assert not others
    if folder == "ur10_unisa":
        assert len(rubbing) >= 4
    if folder == "panda_gaz_ral2019":
        assert rubbing and "mass.panda_joint4" in verdict.baseline
