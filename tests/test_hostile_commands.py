"""Hostile input to every command: one clear line and status 2, in bounded time and memory, and nothing left behind."""

from __future__ import annotations

import os
import subprocess
import sys
import time
import warnings
from pathlib import Path

import pytest

from ident.cli import main
from ident.dataset_io import load_dataset
from robot_assets.robot import load_robot
from tests.hostile import datasets, logs, maps, robots
from tests.hostile.case import ACCEPTED, REFUSED, Case

SECONDS = 10.0  # a command may take, with a machine that is busy
MEMORY = 2**30  # bytes that a process may hold
EVERY = 60  # one of so many cases is in the default suite
ROOT = Path(__file__).parent.parent
CASES = [*logs.cases(), *maps.cases(), *robots.cases(), *datasets.cases()]


def snapshot(folder: Path) -> set[str]:
    return {str(p.relative_to(folder)) for p in folder.rglob("*")}


def run_here(args: list[str], capfd, monkeypatch) -> tuple[int, str]:
    """Status and stderr of a command in this process; a fault of the program passes through."""
    monkeypatch.setattr(sys, "argv", ["simgap", *args])
    with warnings.catch_warnings():
        warnings.simplefilter("error", RuntimeWarning)  # would stand on stderr beside the line
        warnings.simplefilter("error", UserWarning)
        try:
            main()
            status = 0
        except SystemExit as err:
            status = int(err.code or 0)
    return status, capfd.readouterr().err


def run_alone(args: list[str], folder: Path) -> tuple[int, str]:
    """The same in a process of its own, whose memory is measured."""
    env = os.environ | {
        "OMP_NUM_THREADS": "1",
        "OPENBLAS_NUM_THREADS": "1",
        "SIMGAP_THREADS": "1",
        "PYTHONPATH": str(ROOT),
    }
    log = folder.parent / f"{folder.name}-stderr"
    with log.open("w") as stderr:
        process = subprocess.Popen(
            [sys.executable, "-m", "ident.cli", *args], stdout=subprocess.DEVNULL, stderr=stderr, env=env
        )
    pid, began = 0, time.monotonic()
    while not pid and time.monotonic() - began < 2 * SECONDS:
        pid, status, usage = os.wait4(process.pid, os.WNOHANG)
        time.sleep(0.02)
    if not pid:
        process.kill()
        process.wait()
        pytest.fail(f"no end after {2 * SECONDS:g} s")
    process.returncode = os.waitstatus_to_exitcode(status)
    assert usage.ru_maxrss * 1024 < MEMORY, f"{usage.ru_maxrss / 2**20:.1f} GB"
    return process.returncode, log.read_text()


def check_case(case: Case, folder: Path, capfd, monkeypatch) -> None:
    args = case.make(folder)
    before = snapshot(folder)
    monkeypatch.chdir(folder)
    began = time.monotonic()
    status, err = run_alone(args, folder) if case.alone else run_here(args, capfd, monkeypatch)
    seconds = time.monotonic() - began
    left = snapshot(folder) - before
    outside = {x for x in left if not x.startswith(("out", "dataset", "map.toml"))}
    assert not outside, outside
    assert seconds < SECONDS, f"{seconds:.1f} s"
    if case.outcome == ACCEPTED:
        assert status == 0, err
    if case.outcome == REFUSED:
        assert status == 2, f"passed with status {status}"
    if status == 0:
        if "--out" in args and (folder / "out" / "dataset.toml").exists():
            load_dataset(folder / "out")
        return
    assert status == 2
    lines = err.splitlines()
    assert len(lines) == 1 and "Traceback" not in err, err[-3000:]
    line = lines[0]
    assert len(line) < 2000 and line.isprintable(), line
    assert case.names in line, line
    # What the parser of the command line refuses it says in its own words.
    assert ("found" in line and "expected" in line) or "Invalid value" in line or case.id.startswith("options"), line
    assert not left, left


LONG = "n" * 300


@pytest.mark.parametrize(
    ("args", "found"),
    [
        (("convert", "log.csv", "--robot", "twomass", "--guess", "--map", f"{LONG}.toml"), "too long"),
        (("convert", f"{LONG}.csv", "--robot", "twomass", "--guess", "--map", "map.toml"), "no such file"),
        (("convert", "log.csv", "--robot", "twomass", "--map", "map.toml", "--out", LONG), "too long"),
        (("robot", "arm.urdf", "--out", LONG), "too long"),
        (("experiment", "twomass", "--out", LONG), "too long"),
        (("design", "twomass", "--out", LONG), "too long"),
        (("demo", "--out", LONG), "too long"),
        (("convert", "there", "--robot", "twomass", "--guess", "--map", "map.toml"), "found a folder"),
        (("convert", "log.csv", "--robot", "twomass", "--map", "there", "--out", "out"), "found a folder"),
        (("robot", "there", "--out", "out"), "found a folder"),
    ],
)
def test_a_name_that_no_file_can_have_and_a_folder_in_place_of_a_file(args, found, tmp_path, capfd, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "there").mkdir()
    (tmp_path / "log.csv").write_text("t,q,tau\n0,1,2\n1,2,3\n")
    (tmp_path / "arm.urdf").write_bytes(load_robot("twomass").urdf.read_bytes())
    before = snapshot(tmp_path)
    status, err = run_here(list(args), capfd, monkeypatch)
    assert status == 2 and found in err and "expected" in err and len(err.splitlines()) == 1, err
    assert snapshot(tmp_path) == before


def marked() -> list:
    """All cases, few of them in the default suite."""
    fast = {id(c) for c in [c for c in CASES if not c.alone and c.outcome == REFUSED][::EVERY]}
    return [pytest.param(c, marks=() if id(c) in fast else pytest.mark.slow, id=ascii(c.id)[1:-1]) for c in CASES]


@pytest.mark.parametrize("case", marked())
def test_hostile_input_is_one_line(case, tmp_path, capfd, monkeypatch):
    check_case(case, tmp_path, capfd, monkeypatch)
