"""The arrows of the architecture."""

import ast
import importlib
import subprocess
import sys
from pathlib import Path

import pytest

import ident

ROOT = Path(__file__).parent.parent
SIM_MAY = {"ident.dataset", "ident.excitation"}


def imports(path: Path) -> set[str]:
    out = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            out |= {a.name for a in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            out.add(node.module)
    return out


@pytest.mark.parametrize("path", sorted(ROOT.glob("ident/**/*.py")), ids=str)
def test_ident_knows_nothing_of_sim(path):
    found = {m for m in imports(path) if m.split(".")[0] == "sim"}
    assert not found or path.name == "cli.py"


@pytest.mark.parametrize("path", sorted(ROOT.glob("sim/**/*.py")), ids=str)
def test_sim_knows_the_data_and_no_model_of_ident(path):
    found = {m for m in imports(path) if m.split(".")[0] == "ident"}
    assert found <= SIM_MAY
    assert "pinocchio" not in imports(path)


@pytest.mark.parametrize("path", sorted(ROOT.glob("robot_assets/**/*.py")), ids=str)
def test_assets_know_no_engine(path):
    assert not {m.split(".")[0] for m in imports(path)} & {"sim", "ident", "mujoco", "pinocchio"}


@pytest.mark.parametrize("path", sorted((ROOT / "benchmarks").glob("*.py")), ids=lambda p: p.stem)
def test_every_benchmark_can_be_imported(path, monkeypatch):
    monkeypatch.syspath_prepend(str(path.parent))
    importlib.import_module(path.stem)


def test_the_public_names_are_what_a_user_imports():
    """In a fresh process: a submodule of the same name would take the place of a function as soon as it is imported."""
    code = (
        "from ident import load_dataset, estimate_frf, identify, diagnose\n"
        "import ident, types\n"
        "again = [getattr(ident, name) for name in ident.__all__]\n"
        "assert all(callable(f) for f in [load_dataset, estimate_frf, identify, diagnose, *again])\n"
        "assert not any(isinstance(f, types.ModuleType) for f in again)\n"
    )
    subprocess.run([sys.executable, "-c", code], check=True, cwd=ROOT)


def test_no_public_name_is_that_of_a_submodule():
    modules = {path.stem for path in (ROOT / "ident").iterdir()}
    assert not modules & set(ident.__all__)
