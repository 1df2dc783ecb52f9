"""Compiled functions whose traced program outlives the process."""

import contextlib
import hashlib
import pickle
from collections.abc import Callable
from functools import cache
from importlib.metadata import version
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.export
from jax.core import Tracer

import oceaninv
from fitting.report import whole

# JAX refuses to store these calls because a later version may change them; the key holds the
# version.
_SAME_VERSION = [
    jax.export.DisabledSafetyCheck.custom_call(f"lapack_{kind}ormqr_ffi") for kind in "sd"
]


def _folder() -> str | None:
    return jax.config.values["jax_compilation_cache_dir"]


@cache
def _house() -> bytes:
    """Digest of everything besides its arguments that a program depends on."""
    digest = hashlib.sha256()
    for root in (Path(oceaninv.__file__).parent, Path(__file__).parent):
        for path in sorted([*root.rglob("*.py"), *root.rglob("*.csv")]):
            digest.update(path.name.encode() + path.read_bytes())
    for package in ("jax", "jaxlib", "equinox", "optimistix", "lineax"):
        digest.update(version(package).encode())
    return digest.digest()


class _Program(eqx.Module):
    """One traced program: flat arrays in, flat arrays out, and the tree that these make."""

    call: Callable
    tree: Any = eqx.field(static=True)

    def __call__(self, leaves):
        return jax.tree.unflatten(self.tree, self.call(*leaves))


def kept(function: Callable) -> Callable:
    """`eqx.filter_jit(function)` that a later process need not trace again.

    Where JAX has a folder for its compilation cache, the traced program is stored there too (JAX
    itself only spares the compilation, which for these functions is the smaller half).  The key
    holds the source of the house, the versions of what it stands on and the static arguments, so
    that a stale program is never found.  Without such a folder, or under a transformation, this
    is `eqx.filter_jit`.
    """
    jitted = eqx.filter_jit(function)
    programs: dict[str, _Program] = {}

    def call(*args):
        folder = _folder()
        arrays, static = eqx.partition(args, eqx.is_array)
        leaves, tree = jax.tree.flatten(arrays)
        if folder is None or any(isinstance(leaf, Tracer) for leaf in leaves):
            return jitted(*args)
        shapes = [(leaf.shape, str(leaf.dtype)) for leaf in leaves]
        target = (jax.default_backend(), jax.config.values["jax_enable_x64"], function.__qualname__)
        key = hashlib.sha256(_house() + pickle.dumps((static, shapes, target))).hexdigest()
        if key not in programs:
            path = Path(folder) / f"{function.__name__.strip('_')}-{key}.traced"
            programs[key] = _load(path) or _trace(path, function, static, leaves, tree)
        return programs[key](leaves)

    return call


def _write(path: Path, content: bytes) -> None:
    with contextlib.suppress(OSError):  # a folder that cannot be written costs time, not the fit
        path.parent.mkdir(parents=True, exist_ok=True)
        with whole(path) as temporary:
            temporary.write_bytes(content)


def _load(path: Path) -> _Program | None:
    try:
        program, skeleton = pickle.loads(path.read_bytes())
    except (OSError, EOFError, pickle.UnpicklingError):
        return None
    exported = jax.export.deserialize(program)
    return _Program(jax.jit(exported.call), jax.tree.structure(skeleton))


def _trace(path: Path, function, static, leaves, tree) -> _Program:
    outputs = []

    def flat(*leaves):
        result = function(*eqx.combine(jax.tree.unflatten(tree, leaves), static))
        arrays, structure = jax.tree.flatten(result)
        outputs.append(structure)
        return tuple(arrays)

    exported = jax.export.export(jax.jit(flat), disabled_checks=_SAME_VERSION)(*leaves)
    skeleton = jax.tree.unflatten(outputs[0], range(outputs[0].num_leaves))
    _write(path, pickle.dumps((exported.serialize(), skeleton)))
    return _Program(jax.jit(exported.call), outputs[0])
