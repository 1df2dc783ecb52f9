"""Compiled functions whose traced program outlives the process."""

import contextlib
import hashlib
import pickle
import threading
from collections.abc import Callable
from concurrent.futures import Future
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
    """One compiled program: flat arrays in, flat arrays out, and the tree that these make."""

    call: Callable
    tree: Any = eqx.field(static=True)

    def __call__(self, leaves):
        return jax.tree.unflatten(self.tree, self.call(*leaves))


class kept:  # noqa: N801 (a decorator)
    """`eqx.filter_jit(function)` that a later process need not trace again.

    Where JAX has a folder for its compilation cache, the traced program is stored there too (JAX
    itself only spares the compilation, which for these functions is the smaller half).  The key
    holds the source of the house, the versions of what it stands on and the static arguments, so
    that a stale program is never found.  Without such a folder, or under a transformation, this
    is `eqx.filter_jit`.
    """

    def __init__(self, function: Callable):
        self.function = function
        self.jitted = eqx.filter_jit(function)
        self.programs: dict[str, Future[_Program]] = {}

    def __call__(self, *args):
        leaves = _leaves(args)
        if leaves is None:
            return self.jitted(*args)
        program, make = self._program(args, leaves)
        make()
        return program.result()(leaves)

    def prepare(self, *args) -> None:
        """Begin to compile for a call with such arguments, beside what the caller does next.

        JAX traces one program at a time but compiles on another core.
        """
        leaves = _leaves(args)
        if leaves is not None:
            threading.Thread(target=self._program(args, leaves)[1]).start()

    def _program(self, args, leaves) -> tuple[Future[_Program], Callable[[], None]]:
        """The program, promised, and what keeps the promise (nothing, if somebody is at it)."""
        arrays, static = eqx.partition(args, eqx.is_array)
        tree = jax.tree.structure(arrays)
        shapes = [(leaf.shape, str(leaf.dtype), leaf.weak_type) for leaf in leaves]
        name = self.function.__qualname__
        target = (jax.default_backend(), jax.config.values["jax_enable_x64"], name)
        key = hashlib.sha256(_house() + pickle.dumps((static, shapes, target))).hexdigest()
        if key in self.programs:
            return self.programs[key], lambda: None
        promised = self.programs[key] = Future()

        def make():
            path = Path(str(_folder())) / f"{self.function.__name__.strip('_')}-{key}.traced"
            try:
                call, tree_out = _load(path) or _trace(path, self.function, static, leaves, tree)
                compiled = jax.jit(call).lower(*leaves).compile()
                promised.set_result(_Program(compiled, tree_out))
            except BaseException as error:
                del self.programs[key]
                promised.set_exception(error)

        return promised, make


def _leaves(args) -> list | None:
    """The arrays among arguments; None where a program is not to be stored."""
    leaves = jax.tree.leaves(eqx.filter(args, eqx.is_array))
    if _folder() is None or any(isinstance(leaf, Tracer) for leaf in leaves):
        return None
    return leaves


def _write(path: Path, content: bytes) -> None:
    with contextlib.suppress(OSError):  # a folder that cannot be written costs time, not the fit
        path.parent.mkdir(parents=True, exist_ok=True)
        with whole(path) as temporary:
            temporary.write_bytes(content)


def _load(path: Path) -> tuple[Callable, Any] | None:
    try:
        program, skeleton = pickle.loads(path.read_bytes())
    except (OSError, EOFError, pickle.UnpicklingError):
        return None
    return jax.export.deserialize(program).call, jax.tree.structure(skeleton)


def _trace(path: Path, function, static, leaves, tree) -> tuple[Callable, Any]:
    outputs = []

    def flat(*leaves):
        result = function(*eqx.combine(jax.tree.unflatten(tree, leaves), static))
        arrays, structure = jax.tree.flatten(result)
        outputs.append(structure)
        return tuple(arrays)

    exported = jax.export.export(jax.jit(flat), disabled_checks=_SAME_VERSION)(*leaves)
    skeleton = jax.tree.unflatten(outputs[0], range(outputs[0].num_leaves))
    _write(path, pickle.dumps((exported.serialize(), skeleton)))
    return exported.call, outputs[0]
