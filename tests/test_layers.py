"""The arrows of the architecture."""

import ast
import importlib
from pathlib import Path

import pytest

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
