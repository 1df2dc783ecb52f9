"""The floor plan: a room imports only from lower floors; importing is light and makes no array."""

import ast
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
# Lowest first.  A room on no list is an error, so that a new one gets its floor; private rooms
# (leading underscore) are tools and lie at the bottom.
FLOORS = (
    {"tables"},
    {"phase", "mie"},
    {"iops", "particles", "water", "spectrum", "attenuation", "waves"},
    {"bio_optics", "media", "inelastic", "light", "optics", "camera", "objects", "mitsuba"},
    {"scene", "range_map", "scene_file", "water_file"},
    {"transport"},
    {"fidelity"},
    {"__init__"},
)
HEAVY = (
    "colour",
    "OpenImageIO",
    "matplotlib",
    "optimistix",
    "xarray",
    "scipy",
    "jaxopt",
    "skimage",
    "typer",
    "rich",
    "pvlib",
)


def _floor(room):
    if room.startswith("_") and room != "__init__":
        return 0
    return next((i for i, rooms in enumerate(FLOORS) if room in rooms), None)


def _imports(text, place, package):
    """Names of all that a file imports from `package`; `place`: its folders, for relative ones."""
    for node in ast.walk(ast.parse(text)):
        names = []
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            above = place[: len(place) - node.level + 1] if node.level else ()
            base = ".".join([*above, *([node.module] if node.module else [])])
            names = [f"{base}.{alias.name}" for alias in node.names]
        yield from (name for name in names if name.split(".")[0] == package)


def _of(path, package):
    return _imports(path.read_text(), path.relative_to(ROOT).parts[:-1], package)


def _sources(package):
    return sorted((ROOT / package).rglob("*.py"))


@pytest.mark.parametrize("path", _sources("oceaninv"), ids=lambda p: str(p.relative_to(ROOT)))
def test_no_rising_import(path):
    own = _floor(path.relative_to(ROOT / "oceaninv").with_suffix("").parts[0])
    assert own is not None, f"{path.name} stands on no floor: put it into FLOORS"
    for name in _of(path, "oceaninv"):
        parts = name.split(".")
        room = parts[1] if len(parts) > 1 else "__init__"
        floor = _floor(room)
        assert floor is not None, f"{path.name} imports {name}, which stands on no floor"
        assert floor <= own, f"{path.name} imports {name} from a higher floor"


@pytest.mark.parametrize("path", _sources("oceaninv"), ids=lambda p: str(p.relative_to(ROOT)))
def test_forward_side_ignores_the_inverse_side(path):
    assert not list(_of(path, "fitting"))


def test_the_walk_sees_every_kind_of_import():
    text = (
        "from oceaninv import scene\nimport oceaninv.transport.kd\nimport jax\n"
        "def f():\n    from .. import iops\n    from .base import Estimate\n"
    )
    assert set(_imports(text, ("oceaninv", "transport"), "oceaninv")) == {
        "oceaninv.scene",
        "oceaninv.transport.kd",
        "oceaninv.iops",
        "oceaninv.transport.base.Estimate",
    }
    assert _floor("transport") > _floor("scene") > _floor("phase") > _floor("_numerics")


def test_command_line_is_the_roof():
    """Only the command line imports the commands; the rest of the inverse side does not."""
    for path in _sources("fitting"):
        if path.name != "cli.py" and path.parent.name != "commands":
            roof = (".cli", ".commands")
            assert not [name for name in _of(path, "fitting") if any(r in name for r in roof)]


def test_import_is_light():
    """Nothing heavy, no array, and the configuration untouched."""
    code = (
        "import jax, sys\n"
        "before = dict(jax.config.values)\n"
        "others = set(sys.modules)\n"
        "import oceaninv\n"
        "assert dict(jax.config.values) == before, 'jax.config changed'\n"
        "assert not jax.live_arrays(), 'importing made an array'\n"
        f"heavy = [m for m in {HEAVY!r} if m in sys.modules and m not in others]\n"
        "assert not heavy, heavy\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr[-2000:]


@pytest.mark.parametrize(
    "path", _sources("oceaninv") + _sources("fitting"), ids=lambda p: str(p.relative_to(ROOT))
)
def test_file_style(path):
    """No file over 450 lines; no deferred annotations, which would switch the shape checks off."""
    text = path.read_text()
    assert text.count("\n") <= 450
    assert "from __future__ import annotations" not in text
    assert "custom_vjp" not in text
