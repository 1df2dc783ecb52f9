"""The README and the documentation: short, with names that exist and commands that parse."""

import ast
import importlib
import inspect
import re
import shlex
import tomllib

import pytest
from typer.main import get_command

import fitting
import oceaninv
from fitting.commands.main import app
from tests.docs.blocks import PAGES, blocks, commands, with_code
from tests.paths import ROOT

MOST_WORDS = {"README.md": 500}
TEST_COMMAND = 'pip install ".[test]" && python -m pytest -n 2 -m "not slow"'


@pytest.mark.parametrize("page", PAGES)
def test_a_page_is_short(page):
    words = len(PAGES[page].read_text(encoding="utf-8").split())
    assert words <= MOST_WORDS.get(page, 1200)


def test_readme_holds_the_test_command_alone_on_its_line():
    assert TEST_COMMAND in "\n".join(blocks("README.md", "sh")).splitlines()


@pytest.mark.parametrize("page", ["README.md", "CONTRIBUTING.md"])
def test_links_lead_to_files(page):
    targets = re.findall(r"\]\(([^)#]+)", PAGES[page].read_text(encoding="utf-8"))
    assert targets
    assert not [t for t in targets if not t.startswith("http") and not (ROOT / t).exists()]


def test_names_in_backquotes_lead_to_files():
    """Files of the repository that pages name."""
    pattern = re.compile(r"`((?:oceaninv|fitting|tests|notebooks|scenes|docs)/[\w./]+)`")
    for page, path in PAGES.items():
        for name in pattern.findall(path.read_text(encoding="utf-8")):
            assert (ROOT / name).exists(), f"{page} names {name}"


def dotted(node):
    """`a.b.c` of an attribute as its parts; None where it does not begin with a name."""
    parts = []
    while isinstance(node, ast.Attribute):
        parts.insert(0, node.attr)
        node = node.value
    return [node.id, *parts] if isinstance(node, ast.Name) else None


@pytest.mark.parametrize("page", with_code("python"))
def test_names_in_snippets_exist(page):
    """What is imported, and what is taken from `oi` and `fitting`."""
    for text in blocks(page, "python"):
        for node in ast.walk(ast.parse(text)):
            if isinstance(node, ast.ImportFrom):
                module = importlib.import_module(str(node.module))
                assert all(hasattr(module, alias.name) for alias in node.names)
            parts = dotted(node)
            if parts and parts[0] in ("oi", "fitting"):
                found = oceaninv if parts[0] == "oi" else fitting
                for name in parts[1:]:
                    assert hasattr(found, name), ".".join(parts)
                    found = getattr(found, name)


def check_pip(words):
    """`pip install` of this project with extras that it has, or of pre-commit."""
    extras = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"][
        "optional-dependencies"
    ]
    target = words[-1]
    named = re.fullmatch(r"\.(?:\[([\w,]+)\])?", target)
    assert target == "pre-commit" or named, target
    if named and named[1]:
        assert set(named[1].split(",")) <= set(extras)


def check_oceaninv(words):
    """A command that exists, with options that it has; shipped files are there."""
    command = get_command(app).commands[words[1]]
    command.make_context(words[1], words[2:])
    for word in words:
        if word.startswith("scenes/"):
            assert list(ROOT.glob(word)), word


def check_python(words):
    """A module of the project, or pytest on folders that are there."""
    assert words[1] == "-m"
    if words[2] == "pytest":
        assert all((ROOT / word).exists() for word in words[3:] if "/" in word)
    else:
        assert (ROOT / words[2].replace(".", "/")).with_suffix(".py").exists()


CHECKS = {"pip": check_pip, "oceaninv": check_oceaninv, "python": check_python}
AS_THEY_STAND = (
    "mkdocs build --strict",
    "pre-commit install",
    "ruff check .",
    "ruff format --check .",
    "pyright",
)


@pytest.mark.parametrize("page", with_code("sh"))
def test_commands_parse(page):
    for command in commands(page):
        words = shlex.split(command)
        if words[0] in CHECKS:
            CHECKS[words[0]](words)
        else:
            assert command in AS_THEY_STAND


def test_a_command_that_does_not_parse_is_found():
    with pytest.raises(Exception, match="No such option"):
        check_oceaninv(shlex.split("oceaninv fit-profile cast.csv --no-such-option"))


@pytest.mark.parametrize(
    ("package", "name"), [(p, n) for p in (oceaninv, fitting) for n in p.__all__]
)
def test_every_public_name_has_a_reference_page(package, name):
    """The module that defines it, or that it is, is on a page of the folder api."""
    pages = "".join((ROOT / "docs" / "api" / f).read_text() for f in API_PAGES)
    listed = re.findall(r"^::: ([\w.]+)$", pages, re.MULTILINE)
    found = getattr(package, name)
    module = found.__name__ if inspect.ismodule(found) else found.__module__
    assert any(m == module or m.startswith(f"{module}.") for m in listed), module


API_PAGES = sorted(p.name for p in (ROOT / "docs" / "api").glob("*.md"))
