"""Examples in docstrings are executed."""

import doctest
import importlib

import pytest

from tests.paths import ROOT


def modules():
    """Names of all modules with an example in a docstring."""
    paths = [*(ROOT / "oceaninv").rglob("*.py"), *(ROOT / "fitting").rglob("*.py")]
    found = [p for p in paths if ">>> " in p.read_text(encoding="utf-8")]
    return sorted(".".join(p.relative_to(ROOT).with_suffix("").parts) for p in found)


@pytest.mark.parametrize("name", modules())
def test_examples_run(name):
    result = doctest.testmod(importlib.import_module(name))
    assert result.attempted > 0
    assert result.failed == 0
