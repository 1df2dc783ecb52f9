"""Compiled functions that outlive the process."""

import contextlib
import hashlib
import hmac
import io
import os
import pickle
import platform
import secrets
import threading
from collections.abc import Callable
from concurrent.futures import Future
from functools import cache
from importlib.metadata import version
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.core import Tracer
from jax.experimental import serialize_executable

import oceaninv
from oceaninv.foundation.atomic_write import atomic_write

# Packages whose code the key of a program covers, and what their objects are made of.
_COVERED = {"oceaninv", "fitting", "jax", "jaxlib", "equinox", "optimistix", "lineax", "numpy",
            "builtins", "collections", "copyreg", "functools"}  # fmt: skip
# Bytes of a key and of a signature.
_DIGEST = 32


def program_folder() -> Path:
    """The folder of this user in which commands and Python keep their programs."""
    root = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    return root / "oceaninv" / "programs"


def _folder() -> str | None:
    """Where programs are stored: JAX's cache folder, unless JAX itself caches there;
    `program_folder` where JAX has none.  None where JAX is set to cache nothing.

    On a CPU a program that came out of JAX's own cache cannot be stored a second time: it would
    miss some of its functions (jaxlib 0.10).
    """
    own = jax.config.values["jax_enable_compilation_cache"]
    folder = jax.config.values["jax_compilation_cache_dir"]
    if own and folder is None:
        return str(program_folder())
    return None if own else folder


# A fit runs once for a tenth of a second, so its program is not worth optimising: level 0 halves
# the compile time, and so does the older of jaxlib 0.10's two code generators (measured).
QUICK: dict[str, str | bool] = {
    "xla_cpu_use_fusion_emitters": False,
    "xla_backend_optimization_level": "0",
}


def knows_quick_options() -> bool:
    """Whether `QUICK` are options of this compiler: an unknown one would be an error."""
    return version("jaxlib").startswith("0.10.")


def _options() -> dict[str, str | bool]:
    """Of the compiler, equal in commands and in Python, so that both share programs."""
    quick = knows_quick_options() and jax.default_backend() == "cpu"
    return QUICK if quick else {}


@cache
def _environment_fingerprint() -> bytes:
    """Hash of everything that a program depends on besides its arguments."""
    digest = hashlib.sha256()
    for root in (Path(oceaninv.__file__).parent, Path(__file__).parents[1]):
        for path in sorted([*root.rglob("*.py"), *root.rglob("*.csv")]):
            digest.update(path.name.encode() + path.read_bytes())
    for package in ("jax", "jaxlib", "equinox", "optimistix", "lineax"):
        digest.update(version(package).encode())
    flags = os.environ.get("XLA_FLAGS", "").split()
    given = [flag for flag in flags if flag.split("=")[0].removeprefix("--") not in _options()]
    digest.update(" ".join([*given, str(_options())]).encode())
    device = jax.devices()[0]
    digest.update(f"{device.device_kind} {device.client.platform_version}".encode())
    digest.update(_processor())
    return digest.digest()


def _processor() -> bytes:
    """Instruction sets of this processor: machines that share a folder may differ in them."""
    with contextlib.suppress(OSError):
        for line in Path("/proc/cpuinfo").read_bytes().splitlines():
            if line.startswith((b"flags", b"Features")):
                return line
    return f"{platform.machine()} {platform.processor()}".encode()


class _Program(eqx.Module):
    """One compiled program: flat arrays in, flat arrays out, and the tree that these make."""

    call: Callable
    tree: Any = eqx.field(static=True)

    def __call__(self, leaves):
        return jax.tree.unflatten(self.tree, self.call(*leaves))


class cached_jit:
    """`eqx.filter_jit(function)` that a later process need neither trace nor compile again.

    Where JAX has a folder for its compilation cache but does not use it, the program is stored
    there (JAX's own cache saves the compilation only, about half of the wait), and in
    `program_folder` where JAX has no folder.  The cache key hashes this project's source, its
    dependencies' versions, the machine, the precision and the static arguments, so that an outdated
    program is never loaded.  Where JAX caches for itself or is set to cache nothing
    (JAX_ENABLE_COMPILATION_CACHE=false), under a transformation, or with arrays on several devices,
    this is `eqx.filter_jit`.
    """

    def __init__(self, function: Callable):
        self.function = function
        self.jitted = eqx.filter_jit(function)
        self.programs: dict[str, Future[_Program]] = {}

    def __call__(self, *args):
        leaves = _leaves(args)
        found = None if leaves is None else self._program(args, leaves)
        if leaves is None or found is None:
            return self.jitted(*args)
        program, make = found
        make()
        return program.result()(leaves)

    def prepare(self, *args) -> None:
        """Start to compile for a call with such arguments, in a thread of its own.

        JAX traces one program at a time but compiles on another core.
        """
        leaves = _leaves(args)
        found = None if leaves is None else self._program(args, leaves)
        if found is not None:
            threading.Thread(target=found[1]).start()

    def _program(self, args, leaves) -> tuple[Future[_Program], Callable[[], None]] | None:
        """A future of the program, and the function that fulfils it: one that does nothing where
        another thread is at work on the same program.  None where it must not be stored."""
        arrays, static = eqx.partition(args, eqx.is_array)
        tree = jax.tree.structure(arrays)
        shapes = [(leaf.shape, str(leaf.dtype), leaf.weak_type) for leaf in leaves]
        settings: Any = jax.config
        name, x64 = self.function.__qualname__, bool(settings.jax_enable_x64)
        precision = str(settings.jax_default_matmul_precision)
        described = _described((static, shapes, name, x64, precision))
        if described is None:
            return None
        key = hashlib.sha256(_environment_fingerprint() + described).hexdigest()
        if key in self.programs:
            return self.programs[key], lambda: None
        future = self.programs[key] = Future()

        def make():
            path = Path(str(_folder())) / f"{self.function.__name__.strip('_')}-{key}.program"
            try:
                with jax.enable_x64(x64):  # of the caller, not of the thread that compiles
                    found = _load(path) or _compile(path, self.function, static, leaves, tree)
                future.set_result(found)
            except BaseException as error:
                del self.programs[key]
                future.set_exception(error)

        return future, make


class _CoveredPickler(pickle.Pickler):
    """Refuses what is defined in code that the key of a program does not cover."""

    def reducer_override(self, value):
        kind = value if hasattr(value, "__qualname__") else type(value)
        if str(kind.__module__).partition(".")[0] not in _COVERED:
            raise pickle.PicklingError(f"{kind} may change without notice.")
        return NotImplemented


def _described(value) -> bytes | None:
    """`value` as bytes; None where it holds code of others, such as a transport of their own: the
    next process may have changed it."""
    written = io.BytesIO()
    try:
        _CoveredPickler(written).dump(value)
    except (pickle.PicklingError, AttributeError, TypeError):
        return None
    return written.getvalue()


def _leaves(args) -> list | None:
    """The arrays among the arguments; None where their program must not be stored."""
    leaves = jax.tree.leaves(eqx.filter(args, eqx.is_array))
    if _folder() is None or any(isinstance(leaf, Tracer) for leaf in leaves):
        return None
    return None if any(len(leaf.devices()) > 1 for leaf in leaves) else leaves


def _secret(folder: Path) -> bytes | None:
    """Key by which this user's programs in a folder are signed; made with the folder.

    Unpickling a file runs what is in it, and the folder's name is known to all.  So programs are
    neither stored nor read where somebody else owns or may write the folder or its key.
    """
    with contextlib.suppress(OSError):
        folder.mkdir(parents=True, exist_ok=True, mode=0o700)
        path = folder / "key"
        with contextlib.suppress(FileExistsError):
            handle = os.open(path, os.O_CREAT | os.O_EXCL | os.O_WRONLY, 0o600)
            with os.fdopen(handle, "wb") as file:
                file.write(secrets.token_bytes(_DIGEST))
        for place, forbidden in ((folder, 0o022), (path, 0o077)):
            status = place.stat()
            if hasattr(os, "getuid") and (
                status.st_uid != os.getuid() or status.st_mode & forbidden
            ):
                return None
        key = path.read_bytes()
        return key if len(key) == _DIGEST else None
    return None


def _signature(key: bytes, path: Path, content: bytes) -> bytes:
    """Of a program under its own name: another program's file does not pass for it."""
    return hmac.digest(key, path.name.encode() + b"\0" + content, "sha256")


def _write(path: Path, content: bytes) -> None:
    with contextlib.suppress(OSError):  # a folder that cannot be written costs time, not the fit
        key = _secret(path.parent)
        if key is not None:
            with atomic_write(path, overwrite=True) as temporary:
                temporary.write_bytes(_signature(key, path, content) + content)


@cache
def _register_lapack() -> None:
    """Register LAPACK with XLA: a stored program calls its functions by name, and JAX registers
    these names only when it lowers such a call."""
    jax.jit(jnp.linalg.qr).lower(jax.ShapeDtypeStruct((1, 1), jnp.float32))


def _load(path: Path) -> _Program | None:
    """The stored program; None where there is none, or none that this user signed."""
    try:
        stored = path.read_bytes()
    except OSError:
        return None
    key, content = _secret(path.parent), stored[_DIGEST:]
    signed = key is not None and hmac.compare_digest(
        stored[:_DIGEST], _signature(key, path, content)
    )
    if not signed:
        return None
    program, skeleton = pickle.loads(content)
    _register_lapack()
    call = serialize_executable.deserialize_and_load(*program)
    return _Program(call, jax.tree.structure(skeleton))


def _compile(path: Path, function, static, leaves, tree) -> _Program:
    outputs = []

    def flat(*leaves):
        result = function(*eqx.combine(jax.tree.unflatten(tree, leaves), static))
        arrays, structure = jax.tree.flatten(result)
        outputs.append(structure)
        return tuple(arrays)

    compiled = jax.jit(flat).lower(*leaves).compile(compiler_options=_options())
    skeleton = jax.tree.unflatten(outputs[0], range(outputs[0].num_leaves))
    with contextlib.suppress(ValueError):  # a backend without serialisation
        _write(path, pickle.dumps((serialize_executable.serialize(compiled), skeleton)))
    return _Program(compiled, outputs[0])
