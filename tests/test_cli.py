"""The command line as a user calls it."""

import json
import os
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import ident
from ident.dataset_io import load_dataset, save_dataset
from ident.plan_file import plan_to_toml
from robot_assets.robot import load_robot
from sim import run_experiment
from tests.conftest import small_plan

pytestmark = pytest.mark.xdist_group("cli")  # one worker makes what they share


def simgap(*args, timeout=300):
    return subprocess.run(
        [sys.executable, "-m", "ident.cli", *map(str, args)],
        capture_output=True,
        text=True,
        timeout=timeout,
        check=False,
    )


@pytest.fixture(scope="module")
def dataset(clean, tmp_path_factory):
    folder = tmp_path_factory.mktemp("cli") / "d"
    save_dataset(clean[0], folder)
    return folder


def test_check_says_what_a_dataset_holds(dataset):
    run = simgap("check", dataset)
    assert run.returncode == 0 and "elbow_joint" in run.stdout and not run.stderr
    report = json.loads(simgap("check", dataset, "--json").stdout)
    assert report["joints"][2] == "elbow_joint" and report["levels"] == [1.0, 0.4]


def test_frf_and_identify_write_their_files(dataset, tmp_path):
    run = simgap("frf", dataset, "--out", tmp_path / "frf", "--json")
    assert run.returncode == 0 and json.loads(run.stdout)["median_relative_std"] < 0.1
    assert (tmp_path / "frf" / "frf.npz").is_file()
    run = simgap("identify", dataset, "--out", tmp_path / "id", "--estimator", "ml", "--json")
    assert run.returncode == 0
    assert json.loads(run.stdout) == json.loads((tmp_path / "id" / "parameters.json").read_text())


def test_diagnose_writes_everything(dataset, tmp_path):
    run = simgap("diagnose", dataset, "--out", tmp_path / "out", "--json", "--quiet")
    assert run.returncode == 0 and not run.stderr
    assert json.loads(run.stdout) == json.loads((tmp_path / "out" / "verdict.json").read_text())
    assert {p.name for p in (tmp_path / "out").iterdir()} == {
        "verdict.json",
        "report.html",
        "recording.rrd",
        "model.toml",
        "model.xml",
    }


@pytest.fixture(scope="module")
def bench(tmp_path_factory):
    """(dataset of a drive with friction as the command writes it, what the command returned)."""
    folder = tmp_path_factory.mktemp("bench") / "d"
    return folder, simgap(
        "experiment",
        "twomass",
        "--out",
        folder,
        "--effect",
        "coulomb_friction@drive:torque=0.3",
        "--points",
        1,
        "--quiet",
    )


@pytest.mark.slow
def test_diagnose_takes_an_executor_and_a_time(bench, tmp_path):
    dataset, _ = bench
    run = simgap("diagnose", dataset, "--out", tmp_path / "out", "--executor", "cores")
    assert run.returncode == 2 and "--executor" in run.stderr and not (tmp_path / "out").exists()
    run = simgap(
        "diagnose",
        dataset,
        "--out",
        tmp_path / "out",
        "--executor",
        "processes:2",
        "--max-seconds",
        0,
        "--json",
        "--quiet",
    )
    assert run.returncode == 0, run.stderr
    assert "0 s for the search" in json.loads(run.stdout)["notes"][-1]


def test_experiment_writes_a_dataset_that_checks(bench):
    dataset, run = bench
    assert run.returncode == 0, run.stderr
    assert simgap("check", dataset).returncode == 0


@pytest.mark.parametrize(
    "args",
    [
        ("check", "no-such-folder"),
        ("diagnose", "no-such-folder", "--out", "out"),
        ("diagnose",),
        ("experiment", "ur99", "--out", "d"),
        ("experiment", "ur10", "--out", "d", "--effect", "magic@elbow_joint"),
        ("experiment", "ur10", "--out", "d", "--points", "0"),
        ("show", "no-such-folder"),
        ("demo", "--out", "d", "--real", "nothing"),
        ("demo", "--out", "d", "--real", "twomass", "--seed", "3"),
        ("experiment", "twomass", "--out", "d", "--plan", "plan.toml", "--points", "5"),
        ("experiment", "twomass", "--out", "d", "--plan", "plan.toml", "--realizations", "1"),
        ("merge", "no-such-folder", "--out", "d"),
        ("dance",),
    ],
    ids="-".join,
)
def test_bad_usage_is_one_line_and_status_two(args, tmp_path):
    run = subprocess.run(
        [sys.executable, "-m", "ident.cli", *args],
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
        cwd=tmp_path,
    )
    assert run.returncode == 2, run.stderr
    assert len(run.stderr.strip().splitlines()) == 1 and "Traceback" not in run.stderr
    assert not any(tmp_path.iterdir())


def test_a_robot_that_does_not_match_is_one_line_and_overwrites_nothing(dataset, tmp_path):
    out = tmp_path / "out"
    out.mkdir()
    (out / "verdict.json").write_text("earlier")
    toml = dataset / "dataset.toml"
    text = toml.read_text()
    try:
        toml.write_text(text.replace('robot = "ur10"', 'robot = "twomass"'))
        run = simgap("diagnose", dataset, "--out", out)
    finally:
        toml.write_text(text)
    assert run.returncode == 2 and len(run.stderr.strip().splitlines()) == 1
    assert "shoulder_pan_joint" in run.stderr and "drive" in run.stderr
    assert (out / "verdict.json").read_text() == "earlier"


@pytest.mark.slow
def test_shipped_real_data_are_diagnosed(tmp_path):
    out = tmp_path / "out"
    run = simgap("demo", "--real", "twomass", "--out", out, "--json", "--quiet")
    assert run.returncode == 0, run.stderr
    verdict = json.loads((out / "verdict.json").read_text())
    assert json.loads(run.stdout)["sentence"] == verdict["sentence"]
    assert verdict["discrepancy"]["detected"]
    assert not [c for c in verdict["causes"] if c["probability"] > 0.5]
    found = verdict["baseline"]["parameters"]
    assert np.sqrt(found["stiffness.drive"]["value"] / 0.00477) / 2 / np.pi == pytest.approx(54.05, abs=1.5)
    assert 1 / found["motor_inertia.drive"]["value"] == pytest.approx(209, rel=0.08)
    assert "link_friction.drive" in found and verdict["gain"]["method"] == "validation segments"
    assert verdict["gain"]["after"] < 0.3 * verdict["gain"]["before"]
    assert {p.name for p in out.iterdir()} >= {"report.html", "recording.rrd", "model.xml", "model.toml"}


def test_shipped_real_data_have_source_and_licence_and_pass_the_check():
    folders = sorted(p for p in (Path(ident.__file__).parent / "real").iterdir() if p.is_dir())
    assert [f.name for f in folders] == ["kr300", "twomass"]
    for folder in folders:
        assert "Permission is hereby granted" in (folder / "LICENSE").read_text()
        assert "Origin:" in (folder / "SOURCE.md").read_text()
        assert simgap("check", folder).returncode == 0


def test_real_data_that_are_not_shipped_are_one_clear_error(tmp_path):
    run = simgap("demo", "--real", "atlantis", "--out", tmp_path / "out")
    assert run.returncode == 2 and len(run.stderr.strip().splitlines()) == 1
    assert "atlantis" in run.stderr and "twomass" in run.stderr


def test_the_search_ends_after_the_same_time_from_the_command_line_and_from_python():
    import inspect

    from ident.cli import diagnose as command
    from ident.diagnosis import MAX_SECONDS

    assert inspect.signature(command).parameters["max_seconds"].default == MAX_SECONDS


@pytest.mark.parametrize("there", ["file", "folder", "below"])
def test_an_output_that_cannot_be_is_refused_before_the_experiment_runs(tmp_path, monkeypatch, there):
    from ident.cli import experiment
    from robot_assets.errors import DataError

    (tmp_path / "file").touch()
    (tmp_path / "folder").mkdir()
    (tmp_path / "folder" / "mine.txt").touch()
    monkeypatch.setattr("sim.run_experiment", lambda *args, **rest: pytest.fail("run for nothing"))
    with pytest.raises(DataError, match=r"found (a file|mine.txt|.*file, which is a file)"):
        experiment("twomass", tmp_path / "file" / "d" if there == "below" else tmp_path / there, quiet=True)


def test_a_plan_that_cannot_be_written_is_refused_before_it_is_made(tmp_path, monkeypatch):
    from ident.cli import design
    from robot_assets.errors import DataError

    (tmp_path / "file").touch()
    monkeypatch.setattr("ident.design_output.design_experiment", lambda *args, **rest: pytest.fail("made for nothing"))
    with pytest.raises(DataError, match=r"found .*file, which is a file|found a file"):
        design("twomass", tmp_path / "file" / "plan.toml", quiet=True)


def test_no_command_is_one_line_beside_the_help():
    run = simgap()
    assert run.returncode == 2 and "no command" in run.stderr and "experiment" in run.stdout


@pytest.mark.parametrize("command", ["experiment", "diagnose"])
def test_an_interrupted_command_ends_with_status_130_in_one_line_and_writes_nothing(dataset, tmp_path, command):
    args = {"experiment": ("twomass", "--realizations", 300), "diagnose": (dataset,)}[command]
    run = subprocess.Popen(
        [sys.executable, "-m", "ident.cli", command, *map(str, args), "--out", str(tmp_path / "out")],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        # A shell starts what runs behind it with interrupts ignored.
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
    )
    assert run.stderr.readline()  # of its progress: it is at work
    run.send_signal(signal.SIGINT)
    out, err = run.communicate(timeout=120)
    assert run.returncode == 130 and not out
    assert err.splitlines()[-1] == "simgap: interrupted" and "Traceback" not in err
    assert not any(tmp_path.iterdir())


def test_the_status_of_the_viewer_is_that_of_show(tmp_path, monkeypatch):
    from ident import cli

    monkeypatch.setattr("ident.show.recording.check_recording", lambda path: None)
    monkeypatch.setattr(subprocess, "call", lambda args: 3)
    monkeypatch.setattr(sys, "argv", ["simgap", "show", str(tmp_path)])
    with pytest.raises(SystemExit) as end:
        cli.main()
    assert end.value.code == 3


def test_what_a_plan_decides_is_not_asked_for_beside_it(tmp_path):
    from ident.cli import experiment
    from robot_assets.errors import DataError

    with pytest.raises(DataError, match="--realizations: command line: found 3 beside --plan, expected one of the two"):
        experiment("twomass", tmp_path / "d", plan=tmp_path / "plan.toml", realizations=3)


def test_the_data_of_a_plan_join_the_first_ones(tmp_path):
    plan = small_plan(load_robot("twomass"), 3, points=1, levels=(1.0,), period=1000)
    plan_to_toml(plan, tmp_path / "next_plan.toml")
    save_dataset(run_experiment(plan, seed=3), tmp_path / "first")
    run = simgap(
        "experiment", "twomass", "--plan", tmp_path / "next_plan.toml", "--seed", 5, "--out", tmp_path / "more"
    )
    assert run.returncode == 0, run.stderr
    run = simgap("merge", tmp_path / "first", tmp_path / "more", "--out", tmp_path / "both", "--json")
    assert (
        run.returncode == 0
        and json.loads(run.stdout)["segments"] == 4
        and json.loads(run.stdout)["operating_points"] == 4
    )
    assert simgap("check", tmp_path / "both").returncode == 0
    run = simgap("merge", tmp_path / "first", tmp_path / "first", "--out", tmp_path / "both")
    assert run.returncode == 2 and len(run.stderr.strip().splitlines()) == 1
    assert len(load_dataset(tmp_path / "both").segments) == 4
    # In the place of one of them, as it is read before it is written.
    assert simgap("merge", tmp_path / "first", tmp_path / "more", "--out", tmp_path / "first").returncode == 0
    assert len(load_dataset(tmp_path / "first").segments) == 4


def test_names_of_options_stand_in_full_in_a_narrow_terminal():
    run = subprocess.run(
        [sys.executable, "-m", "ident.cli", "diagnose", "--help"],
        capture_output=True,
        text=True,
        timeout=120,
        check=True,
        env=os.environ | {"COLUMNS": "40"},
    )
    assert "--max-causes" in run.stdout and "--max-seconds" in run.stdout
