"""The experiment as one long recording, and its cut."""

from __future__ import annotations

import json
import subprocess
import sys
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from ident.chain import build_structure
from ident.cutting import SETTLE, cut_recording, schedule_plan, usage
from ident.dataset_io import load_dataset
from ident.estimate import fit_frf
from ident.excitation import SPEED_SHARE
from ident.frf import estimate_frf
from ident.graybox import Parameters
from ident.plan import make_plan, point_to_point
from robot_assets.errors import DataError
from robot_assets.robot import load_robot
from sim import run_experiment
from sim.experiment import draw_drives
from sim.recording import run_recording
from tests.conftest import small_plan, through_files

pytestmark = pytest.mark.xdist_group("cutting")  # one worker makes what they share


@pytest.fixture(scope="module")
def recorded(ur10):
    """(schedule, recording, drives) of two points and a motion."""
    plan = small_plan(ur10, 3, levels=(1.0,), validation_points=0, trajectory=True, periods=2)
    drives = draw_drives(np.random.default_rng(1), ur10, 1.5)
    schedule = schedule_plan(plan)
    return schedule, run_recording(schedule, drives=drives, seed=1), drives


def test_a_move_keeps_its_limits_and_comes_to_rest(ur10):
    rate = 1000.0
    a, b = np.full(ur10.n, -0.8), np.linspace(-1.0, 2.0, ur10.n)
    q = point_to_point(ur10, a, b, rate)
    v = np.diff(np.append(q, b[None], axis=0), axis=0) * rate
    assert np.allclose(q[0], a) and np.abs(v[[0, -1]]).max() < 1e-4 * np.abs(v).max()
    share = np.abs(v).max(axis=0) / ur10.array("velocity_limit")
    assert 0.9 * SPEED_SHARE < share.max() < SPEED_SHARE
    assert np.all(np.diff(q, axis=0) * np.sign(b - a) >= -1e-15)


def test_parts_fill_the_recording_and_every_sample_is_counted(ur10):
    plan = make_plan(ur10, points=3, validation_points=1, levels=(1.0, 0.5), period=500, periods=3, transient_periods=1)
    schedule = schedule_plan(plan, settle=0.5)
    parts, spent = schedule.parts, usage(schedule)
    assert parts[0].start == 0 and all(a.stop == b.start for a, b in pairwise(parts))
    assert parts[-1].stop == len(schedule.q_ref) == len(schedule.r) == spent.total
    assert [p.source for p in parts if p.source is not None] == [*plan.experiments, *plan.trajectories]
    count = len(plan.experiments)
    assert spent.measured == 2 * spent.transients == count * 2 * 500
    assert spent.settling == 500 * sum(p.kind == "settle" for p in parts)
    # Four points and the way back to where the motion begins: one move less than rests.
    assert sum(p.kind == "move" for p in parts) == 4 and sum(p.kind == "settle" for p in parts) == 5
    assert np.abs(np.diff(schedule.q_ref, axis=0)).max() * 1000 < 0.5 * ur10.array("velocity_limit").max()
    quiet = np.concatenate([np.arange(p.start, p.stop) for p in parts if p.kind != "experiment"])
    assert not np.any(schedule.r[quiet])
    for p in parts:
        if p.kind == "experiment":
            assert np.array_equal(schedule.r[p.samples], np.tile(p.source.r, (3, 1)))
            assert np.array_equal(schedule.q_ref[p.stop - 1], p.source.q0)
    assert spent.text().splitlines()[0].split()[:2] == ["moves", str(spent.moves)]


@pytest.mark.slow
def test_a_cut_recording_is_an_ordinary_dataset(recorded, tmp_path):
    schedule, recording, _ = recorded
    data = through_files(cut_recording(recording, schedule), tmp_path)
    separate = run_experiment(schedule.plan)
    assert [s.name for s in data.segments] == [s.name for s in separate.segments]
    for a, b in zip(data.segments, separate.segments, strict=True):
        assert (a.kind, a.role, a.experiment, a.period, a.periods) == (
            b.kind,
            b.role,
            b.experiment,
            b.period,
            b.periods,
        )
        assert a.n_samples == b.n_samples and np.array_equal(a.excited_lines, b.excited_lines)
        assert (a.r is None) == (b.r is None) and (a.r is None or np.allclose(a.r, b.r))
        assert np.abs(np.mean(a.q - b.q, axis=0)).max() < 1e-2
    assert np.all(np.diff([s.t[0] for s in data.segments]) > 0)


@pytest.mark.slow
def test_frfs_and_parameters_agree_with_those_of_separate_experiments(recorded, ur10):
    schedule, recording, drives = recorded
    cut = cut_recording(recording, schedule)
    separate = run_experiment(replace(schedule.plan, trajectories=()), drives=drives, seed=2)
    # Of single periods: what nothing excites there holds the geometry's distortion too, which is the same in both.
    noise = {"q_std": ur10.array("q_std"), "tau_std": ur10.array("tau_std")}
    one, other = (estimate_frf(replace(x, **noise)) for x in (cut, separate))
    z = np.abs(one.G - other.G) / np.hypot(one.total_std, other.total_std)
    # The mean square of |z| is 1 for a circular complex error; the transient left over adds a little.
    assert 0.8 < np.mean(z**2) < 1.5
    structure, nominal = build_structure(ur10), Parameters.nominal(ur10)
    fits = [fit_frf(structure, frf, nominal, sample_time=1e-3, hold="zoh") for frf in (one, other)]
    x, y = (f.parameters.to_log() for f in fits)
    std = np.hypot(*(np.sqrt(np.diag(f.covariance))[:-1] for f in fits))
    assert np.all(np.abs(x - y) < 5 * std) and np.sqrt(np.mean(((x - y) / std) ** 2)) < 2
    truth = np.log(np.concatenate([drives[f] for f in ("stiffness", "damping", "motor_inertia", "viscous_friction")]))
    assert np.abs(x - truth)[: ur10.n].max() < 0.01


def test_a_position_reference_carries_the_excitation_too(tmp_path):
    robot = load_robot("twomass")
    plan = make_plan(
        robot, points=1, validation_points=0, levels=(1.0,), period=1000, injection="position", trajectory=False
    )
    schedule = schedule_plan(plan, settle=0.2)
    data = cut_recording(run_recording(schedule), schedule)
    s = data.segments[0]
    swing = s.periodic("q")[0] - s.q0
    assert 0.3 < np.std(swing) / np.std(s.periodic("r")[0]) < 3


def shorter(recording):
    s = recording.segments[0]
    cut = {k: getattr(s, k)[:-1] for k in ("t", "tau", "q", "r", "q_ref")}
    return replace(recording, segments=(replace(s, **cut),))


def moved(recording):
    s = recording.segments[0]
    return replace(recording, segments=(replace(s, q=s.q + np.where(np.arange(s.q.shape[1]) == 2, 0.3, 0.0)),))


@pytest.mark.parametrize(
    "spoil, what",
    [
        (shorter, "samples"),
        (lambda d: replace(d, sample_rate=500.0), "sample_rate"),
        (lambda d: replace(d, segments=d.segments * 2), "segments"),
        (lambda d: replace(d, joints=d.joints[::-1]), "joints"),
        (moved, "posture"),
    ],
)
def test_a_recording_of_something_else_is_refused(recorded, spoil, what):
    schedule, recording, _ = recorded
    with pytest.raises(DataError) as err:
        cut_recording(spoil(recording), schedule)
    assert err.value.what == what


def test_a_plan_that_cannot_be_run_is_refused(recorded):
    plan = recorded[0].plan
    with pytest.raises(DataError, match="neither experiment nor motion"):
        schedule_plan(replace(plan, experiments=(), trajectories=()))
    with pytest.raises(DataError, match="settle"):
        schedule_plan(plan, settle=-1.0)


@pytest.mark.slow
def test_the_command_writes_a_dataset_and_counts_its_samples(tmp_path):
    args = ["experiment", "twomass", "--out", str(tmp_path / "d"), "--points", "1", "--one-recording", "--json"]
    run = subprocess.run(
        [sys.executable, "-m", "ident.cli", *args], capture_output=True, text=True, check=False, timeout=300
    )
    assert run.returncode == 0, run.stderr
    found, data = json.loads(run.stdout), load_dataset(tmp_path / "d")
    assert found["segments"] == len(data.segments)
    spent, rate = found["samples"], data.sample_rate
    periodic = data.select(kind="multisine")
    assert spent["measured"] == sum(s.steady_periods * s.period for s in periodic)
    assert spent["settling"] % (SETTLE * rate) == 0 and spent["moves"] > 0
    assert spent["total"] == sum(spent[k] for k in ("moves", "settling", "transients", "measured", "trajectories"))
