"""The notebooks run from top to bottom; what they state is asserted in their own cells."""

from __future__ import annotations

from pathlib import Path

import nbformat
import pytest
from nbclient import NotebookClient

FOLDER = Path(__file__).parent.parent / "notebooks"
NAMES = sorted(p.name for p in FOLDER.glob("*.ipynb"))
LONG = ("the_seed_paper.ipynb",)


@pytest.mark.parametrize("name", [pytest.param(n, marks=[pytest.mark.slow] * (n in LONG)) for n in NAMES])
def test_notebook_runs(name):
    notebook = nbformat.read(FOLDER / name, as_version=4)
    assert any("assert" in c.source for c in notebook.cells if c.cell_type == "code")
    NotebookClient(
        notebook, timeout=400, kernel_name="python3", resources={"metadata": {"path": str(FOLDER)}}
    ).execute()


@pytest.mark.parametrize("name", NAMES)
def test_notebook_is_kept_with_its_results(name):
    cells = [c for c in nbformat.read(FOLDER / name, as_version=4).cells if c.cell_type == "code"]
    assert any("image/png" in o.get("data", {}) for c in cells for o in c.outputs)
    assert not any(o.output_type == "error" for c in cells for o in c.outputs)
