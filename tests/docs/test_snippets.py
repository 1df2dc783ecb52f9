"""Snippets of the README and of the documentation are executed, and so are its commands."""

import shlex
import subprocess
import sys

import pytest

from fitting.files.cast_file import raw_casts
from tests.docs.blocks import blocks, commands, with_code
from tests.paths import ROOT, SCENES

# Those that fit photographs, or compile many programs.
SLOW = ("README.md 0", "start/photographs.md", "start/rendering.md")
# What snippets end with: variable, value, tolerance.
RESULTS = {"start/rendering.md": ("chlorophyll", 0.7, 1e-5)}
# Commands on shipped files that would take long: all models of a scene, 24 frames.
LONG = ("oceaninv trade", "--animate")


def cases():
    """Pages whose snippets follow one another, and the snippets of the README one by one."""
    texts = {}
    for page in with_code("python"):
        found = blocks(page, "python")
        if page == "README.md":
            texts |= {f"{page} {i}": [text] for i, text in enumerate(found)}
        else:
            texts[page] = found
    return [
        pytest.param(name, found, id=name, marks=[pytest.mark.slow] if name in SLOW else [])
        for name, found in texts.items()
    ]


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """A folder for results, with the shipped scenes in it."""
    (tmp_path / "scenes").symlink_to(SCENES)
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.mark.parametrize(("name", "texts"), cases())
def test_snippets_run(name, texts, folder):
    names = {"__name__": "snippet"}
    for text in texts:
        exec(compile(text, name, "exec"), names)
    if name in RESULTS:
        variable, value, tolerance = RESULTS[name]
        assert abs(float(names[variable]) - value) < tolerance


def test_the_example_of_a_cast_file_is_read(folder):
    path = folder / "cast.csv"
    path.write_text(blocks("files/index.md", "text")[0])
    (cast,) = raw_casts(path)
    assert list(cast.columns) == ["depth", "Ed_412", "Ed_490"]
    assert set(cast.units.values()) == {"m", "W m-2 nm-1"}
    assert (cast.solar_zenith, cast.latitude) == (32.0, 43.4)


def shipped():
    """Commands of all pages that read shipped files and write a result."""
    found = dict.fromkeys(c for page in with_code("sh") for c in commands(page))
    return [c for c in found if c.startswith("oceaninv ") and " scenes/" in c]


@pytest.mark.slow
@pytest.mark.parametrize("command", [c for c in shipped() if not any(part in c for part in LONG)])
def test_commands_run(command, folder):
    start = [sys.executable, "-c", "from fitting.commands.main import main; main()"]
    done = subprocess.run(
        [*start, *shlex.split(command)[1:]],
        env={"PYTHONPATH": str(ROOT), "PATH": "", "HOME": str(folder)},
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout.strip() or len(list(folder.iterdir())) > 1
