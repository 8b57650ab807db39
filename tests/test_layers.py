"""The arrows of the architecture."""

import ast
import importlib
import subprocess
import sys
from graphlib import TopologicalSorter
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


def arrows() -> dict[str, set[str]]:
    """Modules of ``ident`` by name, and the modules of it that each imports."""
    modules = {".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__"): path for path in ROOT.glob("ident/**/*.py")}
    out = {}
    for name, path in modules.items():
        found = set()
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.Import):
                found |= {a.name for a in node.names}
            elif isinstance(node, ast.ImportFrom) and node.module:
                within = {f"{node.module}.{a.name}" for a in node.names} & set(modules)
                found |= within or {node.module}
        out[name] = (found & set(modules)) - {name}
    return out


def test_no_module_of_ident_hangs_on_itself():
    order = list(TopologicalSorter(arrows()).static_order())
    assert order.index("ident.graybox") < order.index("ident.torque_fit") < order.index("ident.attribute") < order.index("ident.cli")


@pytest.mark.parametrize(
    ("below", "above"),
    [
        ({"ident.graybox", "ident.inverse", "ident.extended"}, {"ident.problem", "ident.torque_fit", "ident.screening"}),
        ({"ident.problem", "ident.weights", "ident.costs", "ident.derivatives", "ident.torque_fit"}, {"ident.screening", "ident.evidence"}),
        ({"ident.screening", "ident.refits", "ident.search", "ident.strong", "ident.rounds"}, {"ident.attribute", "ident.trust", "ident.gain"}),
        ({"ident.attribute", "ident.conclude", "ident.diagnosis"}, {"ident.show", "ident.convert", "ident.cli"}),
        ({"ident.frf", "ident.estimate"}, {"ident.torque_fit", "ident.attribute"}),
    ],
)
def test_lower_layers_know_nothing_of_higher_ones(below, above):
    graph, known = arrows(), set(below)
    while more := set().union(*(graph[m] for m in known)) - known:
        known |= more
    assert not {m for m in known for a in above if m == a or m.startswith(f"{a}.")}


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
