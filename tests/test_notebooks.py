"""Notebooks: executed from top to bottom without errors, on public names, with their pictures."""

import ast
import json

import pytest

from tests.paths import ROOT

NOTEBOOKS = sorted((ROOT / "notebooks").glob("*.ipynb"))


def cells(path):
    """Code cells in order: (source, outputs, execution count)."""
    notebook = json.loads(path.read_text(encoding="utf-8"))
    return [
        ("".join(cell["source"]), cell["outputs"], cell["execution_count"])
        for cell in notebook["cells"]
        if cell["cell_type"] == "code"
    ]


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda p: p.stem)
def test_a_notebook_is_executed_and_shows_pictures(path):
    found = cells(path)
    assert [count for _, _, count in found] == list(range(1, len(found) + 1))
    outputs = [output for _, part, _ in found for output in part]
    assert not [o for o in outputs if o["output_type"] == "error"]
    assert sum("image/png" in o.get("data", {}) for o in outputs) >= 1
    warned = "".join("".join(o.get("text", "")) for o in outputs if o.get("name") == "stderr")
    assert "Traceback" not in warned


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda p: p.stem)
def test_a_notebook_uses_public_names(path):
    for source, _, _ in cells(path):
        for node in ast.walk(ast.parse(source)):
            if isinstance(node, ast.ImportFrom) and (node.module or "").startswith(
                ("oceaninv", "fitting")
            ):
                names = [*str(node.module).split("."), *(alias.name for alias in node.names)]
                assert not [name for name in names if name.startswith("_")]
