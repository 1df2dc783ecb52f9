"""Files that docstrings, comments and documents name are there."""

import re

import pytest

from tests.paths import ROOT

NAMED = re.compile(r"`((?:oceaninv|fitting|tests|scenes|docs)/[\w./-]+)`")
# A pattern, not a file.
EXEMPT = {"tests/benchmarks/bench_NAME.py"}


@pytest.mark.parametrize("folder", ["oceaninv", "fitting", "tests", "docs", "."])
def test_named_files_are_there(folder):
    depth = "*" if folder == "." else "**/*"
    paths = [p for p in (ROOT / folder).glob(depth) if p.suffix in (".py", ".md")]
    texts = {p: p.read_text() for p in paths if p.name != "CHANGELOG.md"}
    named = {(p, name) for p, text in texts.items() for name in NAMED.findall(text)}
    missing = [
        f"{path.relative_to(ROOT)}: {name}"
        for path, name in sorted(named)
        if name not in EXEMPT and not (ROOT / name).exists()
    ]
    assert texts
    assert not missing
