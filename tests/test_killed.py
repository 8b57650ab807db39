"""A run that is killed leaves the outputs of an earlier one whole, or its own."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from ident.dataset_io import load_dataset, save_dataset
from ident.outputs import outputs_into
from tests.conftest import small_plan
from tests.hostile import sound

ROOT = Path(__file__).parent.parent


OLD = b"of an earlier run"


def test_files_of_others_stay_and_those_of_an_earlier_run_do_not(tmp_path):
    out = tmp_path / "out"
    out.mkdir()
    for name in ("a", "b", "plan"):
        (out / name).write_text("old")
    with outputs_into(out, without=("plan",)) as folder:
        (folder / "a").write_text("new")
    assert {p.name: p.read_text() for p in out.iterdir()} == {"a": "new", "b": "old"}
    assert [p.name for p in tmp_path.iterdir()] == ["out"]


@pytest.mark.parametrize("where", ["inside", "with a folder", "by a link"])
def test_a_folder_that_others_use_stays_itself(tmp_path, monkeypatch, where):
    out = tmp_path / "out"
    out.mkdir()
    (out / "a").write_text("old")
    (out / "plan").write_text("old")
    given = out
    if where == "inside":
        monkeypatch.chdir(out)
    elif where == "with a folder":
        (out / "runs").mkdir()
        (out / "runs" / "notes").write_text("cold morning")
    else:
        given = tmp_path / "link"
        given.symlink_to(out)
    inode = out.stat().st_ino
    with outputs_into(given, without=("plan",)) as folder:
        (folder / "a").write_text("new")
    assert (out / "a").read_text() == "new" and not (out / "plan").exists()
    assert where == "by a link" or out.stat().st_ino == inode
    assert where != "with a folder" or (out / "runs" / "notes").read_text() == "cold morning"
    assert where != "by a link" or given.is_symlink()


def test_a_failing_run_leaves_everything(tmp_path):
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "a").write_text("old")
    with pytest.raises(ZeroDivisionError), outputs_into(tmp_path / "out") as folder:
        (folder / "a").write_text("new")
        raise ZeroDivisionError
    assert (tmp_path / "out" / "a").read_text() == "old"
    assert [p.name for p in tmp_path.iterdir()] == ["out"]


SWAP = """
import sys
from pathlib import Path
from ident.outputs import outputs_into
k = 0
while True:
    k += 1
    with outputs_into(sys.argv[1]) as folder:
        for name in range(30):
            (folder / f"{name:02d}").write_text(str(k))
"""


def test_whatever_the_moment_the_files_are_of_one_run(tmp_path):
    out, rng = tmp_path / "out", np.random.default_rng(0)
    seen = set()
    for _ in range(6):
        process = subprocess.Popen([sys.executable, "-c", SWAP, str(out)], env=os.environ | {"PYTHONPATH": str(ROOT)})
        while not out.exists() and process.poll() is None:
            time.sleep(0.01)
        time.sleep(0.25 + rng.uniform(0, 0.1))
        process.send_signal(signal.SIGKILL)
        process.wait()
        texts = {p.read_text() for p in out.iterdir()}
        assert len(texts) == 1 and len(list(out.iterdir())) == 30
        seen |= texts
    assert len(seen) > 1


@pytest.fixture(scope="module")
def inputs(tmp_path_factory):
    """A dataset, a log with its map and robot, and a plan."""
    from ident.plan_file import plan_to_toml
    from robot_assets.robot import load_robot
    from sim import run_experiment

    folder = tmp_path_factory.mktemp("inputs")
    plan = small_plan(load_robot("twomass"), 3, points=1, levels=(1.0, 0.5))
    save_dataset(run_experiment(plan, seed=3), folder / "d")
    plan_to_toml(plan, folder / "plan.toml")
    (folder / "log.csv").write_bytes(sound.log_bytes(".csv"))
    sound.convert(folder)
    return folder


COMMANDS = {
    "diagnose": ("diagnose", "d", "--max-causes", "1"),
    "identify": ("identify", "d"),
    "frf": ("frf", "d"),
    "convert": ("convert", "log.csv", "--robot", "pair", "--map", "map.toml"),
    "experiment": ("experiment", "twomass", "--plan", "plan.toml"),
}


@pytest.mark.slow
@pytest.mark.parametrize("command", COMMANDS)
def test_a_killed_command_leaves_whole_outputs(inputs, tmp_path, command):
    out, rng = tmp_path / "out", np.random.default_rng(len(command))
    env = os.environ | {
        "PYTHONPATH": str(ROOT),
        "SIMGAP_THREADS": "1",
        "OMP_NUM_THREADS": "1",
        "OPENBLAS_NUM_THREADS": "1",
    }
    args = [sys.executable, "-m", "ident.cli", *COMMANDS[command], "--out", str(out), "--quiet"]
    began = time.monotonic()
    subprocess.run(args, cwd=inputs, env=env, check=True, capture_output=True)
    whole = time.monotonic() - began
    names = {p.name for p in out.iterdir()}
    ends = set()
    # Half of the moments anywhere, half near the end, where files are put into place.
    for share in [*rng.uniform(0, 1, 5), *rng.uniform(0.85, 1.1, 7)]:
        for name in names:
            (out / name).write_bytes(OLD)
        process = subprocess.Popen(args, cwd=inputs, env=env, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        time.sleep(share * whole)
        process.send_signal(signal.SIGKILL)
        process.wait()
        assert {p.name for p in out.iterdir()} == names
        old = {name for name in names if (out / name).read_bytes() == OLD}
        assert old in (set(), names), old
        if not old and command in ("convert", "experiment"):
            load_dataset(out)
        ends.add(bool(old))
    assert True in ends
