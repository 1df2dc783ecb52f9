"""Snippets and commands of the README and of the documentation."""

import re

from tests.paths import ROOT

_BLOCK = re.compile(r"^```(\w+)\n(.*?)^```", re.DOTALL | re.MULTILINE)
PAGES = {
    "README.md": ROOT / "README.md",
    "CONTRIBUTING.md": ROOT / "CONTRIBUTING.md",
    **{str(p.relative_to(ROOT / "docs")): p for p in sorted((ROOT / "docs").rglob("*.md"))},
}


def blocks(page, language):
    """The blocks of code of a page in one language, in order."""
    found = _BLOCK.findall(PAGES[page].read_text(encoding="utf-8"))
    return [text for name, text in found if name == language]


def with_code(language):
    """The pages that have code in a language."""
    return [page for page in PAGES if blocks(page, language)]


def commands(page):
    """Every command of a page's shell blocks; `a && b` are two."""
    lines = [line for text in blocks(page, "sh") for line in text.splitlines()]
    return [part.strip() for line in lines for part in line.split(" && ")]
