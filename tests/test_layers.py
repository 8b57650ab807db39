"""The arrows of the architecture."""

import ast
import importlib
import re
import subprocess
import sys
from graphlib import TopologicalSorter
from pathlib import Path

import pytest

import ident

ROOT = Path(__file__).parent.parent
SIM_MAY = {"ident.dataset", "ident.excitation", "ident.plan"}


def statements(path: Path) -> list[tuple[str, tuple[str, ...]]]:
    """Modules that a file imports from, and the names it takes from each; none of a plain import."""
    out = []
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            out += [(a.name, ()) for a in node.names]
        elif isinstance(node, ast.ImportFrom) and node.module:
            out.append((node.module, tuple(a.name for a in node.names)))
    return out


def imports(path: Path) -> set[str]:
    return {module for module, _ in statements(path)}


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
    modules = {
        ".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__"): path
        for path in ROOT.glob("ident/**/*.py")
    }
    out = {}
    for name, path in modules.items():
        found = [({f"{module}.{x}" for x in names} & set(modules)) or {module} for module, names in statements(path)]
        out[name] = (set().union(*found) & set(modules)) - {name}
    return out


def test_no_module_of_ident_hangs_on_itself():
    order = list(TopologicalSorter(arrows()).static_order())
    assert (
        order.index("ident.graybox")
        < order.index("ident.torque_fit")
        < order.index("ident.attribute")
        < order.index("ident.cli")
    )


@pytest.mark.parametrize(
    ("below", "above"),
    [
        (
            {"ident.graybox", "ident.inverse", "ident.extended"},
            {"ident.problem", "ident.torque_fit", "ident.screening"},
        ),
        (
            {"ident.problem", "ident.weights", "ident.costs", "ident.derivatives", "ident.torque_fit"},
            {"ident.screening", "ident.evidence"},
        ),
        (
            {"ident.screening", "ident.refits", "ident.search", "ident.strong", "ident.rounds"},
            {"ident.attribute", "ident.trust", "ident.gain"},
        ),
        ({"ident.attribute", "ident.conclude", "ident.diagnosis"}, {"ident.show", "ident.convert", "ident.cli"}),
        ({"ident.frf", "ident.estimate"}, {"ident.torque_fit", "ident.attribute"}),
    ],
)
def test_lower_layers_know_nothing_of_higher_ones(below, above):
    graph, known = arrows(), set(below)
    assert below | above <= set(graph)
    while more := set().union(*(graph[m] for m in known)) - known:
        known |= more
    assert not {m for m in known for a in above if m == a or m.startswith(f"{a}.")}


def test_every_module_stands_in_a_table_and_imports_none_of_a_later_one():
    text = (ROOT / "ARCHITECTURE.md").read_text().split("## Import rules")[0]
    tables = text.split("| module | content |")[1:]
    rows = [
        (i, row.split("|")[1]) for i, table in enumerate(tables) for row in table.splitlines() if row.startswith("| `")
    ]
    place = {f"ident.{name.rstrip('/')}": i for i, cell in rows for name in re.findall(r"`([\w/]+)`", cell)}

    def at(module: str) -> int:
        return place[".".join(module.split(".")[:2])]

    graph = {m: found - {"ident"} for m, found in arrows().items() if m != "ident"}
    assert not [(m, x) for m, found in graph.items() for x in found if at(x) > at(m)]


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
