"""Imports point only to lower layers and run in no circles; importing is light."""

import ast
import graphlib
import subprocess
import sys

import pytest

from tests.paths import ROOT

# Lowest first; names in one row do not import each other.  Every module lies in one of these.
LAYERS = (
    ("oceaninv.foundation",),
    ("oceaninv.water",),
    ("oceaninv.mie",),
    ("oceaninv.scene",),
    ("oceaninv.transport.base",),
    ("oceaninv.transport.closed_form",),
    ("oceaninv.transport.plane_parallel", "oceaninv.transport.monte_carlo"),
    ("oceaninv.transport.objects",),
    ("oceaninv.transport.apparent", "oceaninv.transport.energy", "oceaninv.transport.front"),
    ("oceaninv.transport",),
    ("oceaninv.fidelity",),
    ("oceaninv.rendering",),
    ("oceaninv",),
    ("fitting.core",),
    ("fitting.water_model", "fitting.observations"),
    ("fitting.files",),
    ("fitting.images",),
    ("fitting.profile.kd",),
    ("fitting.profile.constituents",),
    ("fitting.profile",),
    ("fitting.photo", "fitting.bulk"),
    ("fitting.report",),
    ("fitting",),
    ("fitting.commands",),
)
MOST_MODULES = 14
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
PATHS = {}
for _path in [*(ROOT / "oceaninv").rglob("*.py"), *(ROOT / "fitting").rglob("*.py")]:
    _parts = _path.relative_to(ROOT).with_suffix("").parts
    PATHS[".".join(_parts[:-1] if _parts[-1] == "__init__" else _parts)] = _path


def layer_of(module):
    """The longest prefix of `module` among LAYERS, as (its layer, the prefix)."""
    rows = [(len(name), i, name) for i, names in enumerate(LAYERS) for name in names
            if module == name or module.startswith(f"{name}.")]  # fmt: skip
    assert rows, f"{module} lies in no layer: put it into LAYERS"
    return max(rows)[1:]


def imports(text, module, is_package=False):
    """Modules of the project that `text`, the source of `module`, imports anywhere in it.

    Imports within functions and for type checking count as all others do.
    """
    found = set()
    place = module.split(".") if is_package else module.split(".")[:-1]
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            above = place[: len(place) - node.level + 1] if node.level else []
            base = ".".join([*above, *([node.module] if node.module else [])])
            names = [f"{base}.{alias.name}" for alias in node.names]
        else:
            continue
        for name in names:
            while name and name not in PATHS:
                name = name.rpartition(".")[0]
            if name and name != module:
                found.add(name)
    return found


def graph():
    """Module -> modules that it imports; imports of a package's handed-on names count as such."""
    return {m: imports(p.read_text(), m, p.stem == "__init__") for m, p in PATHS.items()}


@pytest.mark.parametrize("module", sorted(PATHS))
def test_no_import_points_upwards(module):
    layer, name = layer_of(module)
    own_package = PATHS[module].stem == "__init__"
    for other in graph_of(module):
        theirs, their_name = layer_of(other)
        lower = theirs < layer or their_name == name
        # The __init__ of a package hands on names of its own modules, whatever their layer.
        assert lower or (own_package and other.startswith(f"{module}.")), f"{module} -> {other}"


def graph_of(module):
    return imports(PATHS[module].read_text(), module, PATHS[module].stem == "__init__")


def test_no_circles():
    """Among modules, over all imports; a package's __init__ only hands names on, and is none."""
    modules = {m: {o for o in others if PATHS[o].stem != "__init__"}
               for m, others in graph().items() if PATHS[m].stem != "__init__"}  # fmt: skip
    list(graphlib.TopologicalSorter(modules).static_order())  # CycleError names the circle


def test_no_module_imports_what_its_own_package_hands_on():
    """Such an import would be a circle that the test above does not see."""
    for module, others in graph().items():
        if PATHS[module].stem != "__init__":
            packages = {module.rsplit(".", n)[0] for n in range(1, module.count(".") + 1)}
            # The commands lie above the package that they are in, and use what it hands on.
            packages = {p for p in packages if layer_of(p)[0] >= layer_of(module)[0]}
            assert not packages & others, module


def test_the_forward_side_does_not_import_the_inverse_side():
    for module, others in graph().items():
        assert not (module.startswith("oceaninv") and any(o.startswith("fitting") for o in others))


def test_every_kind_of_import_is_seen():
    text = (
        "from oceaninv.scene import scene\nimport oceaninv.transport.base\nimport jax\n"
        "from typing import TYPE_CHECKING\n"
        "if TYPE_CHECKING:\n    from fitting.core.result import Fit\n"
        "def f():\n    from ..water import iops\n    from .front import radiance\n"
    )
    assert imports(text, "oceaninv.transport.energy") == {
        "oceaninv.scene.scene",
        "oceaninv.transport.base",
        "fitting.core.result",
        "oceaninv.water.iops",
        "oceaninv.transport.front",
    }
    assert layer_of("oceaninv.transport.base") < layer_of("oceaninv.transport.energy")


def test_packages_are_small_and_only_hand_names_on():
    for path in PATHS.values():
        if path.stem == "__init__":
            text = path.read_text()
            assert text.count("\n") < 40, path
            kinds = {type(node) for node in ast.parse(text).body}
            assert kinds <= {ast.Expr, ast.Import, ast.ImportFrom, ast.Assign}, path
            modules = [p for p in path.parent.glob("*.py") if p != path]
            assert len(modules) <= MOST_MODULES or path.parent.name == "commands", path.parent


def test_no_function_hides_a_module_of_its_name():
    """`import a.b` must not yield a function that a package hands on under a module's name."""
    for module, path in PATHS.items():
        if path.stem == "__init__":
            for node in ast.parse(path.read_text()).body:
                for alias in node.names if isinstance(node, ast.ImportFrom) else ():
                    handed, source = f"{module}.{alias.asname or alias.name}", node.module
                    if handed in PATHS:
                        assert f"{source}.{alias.name}" in PATHS, handed


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


@pytest.mark.parametrize("module", sorted(PATHS))
def test_file_style(module):
    """No deferred annotations, which would switch the shape checks off; no custom_vjp."""
    text = PATHS[module].read_text()
    assert "from __future__ import annotations" not in text
    assert "custom_vjp" not in text
