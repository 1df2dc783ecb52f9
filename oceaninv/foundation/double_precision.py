"""Functions that run in double precision, whatever JAX is set to where they are called."""

import copy
import dataclasses
import functools
from collections.abc import Callable
from typing import Any

import jax
import numpy as np
from jax.core import Tracer

_DOUBLE = {"float32": np.float64, "complex64": np.complex128}


def in_double_precision(function: Callable) -> Callable:
    """`function`, which runs in float64 whatever `jax_enable_x64` is where it is called.

    JAX computes in float32 unless it is told otherwise, in which searches stop at their step
    limit.  The setting is that of the call and its thread alone: programs of other precisions keep
    their own.  Arguments made in float32 are promoted, see `promoted`.
    """

    @functools.wraps(function)
    def call(*args, **kwargs):
        with jax.enable_x64(True):
            return function(*map(promoted, args), **{k: promoted(v) for k, v in kwargs.items()})

    return call


def promoted(value: Any) -> Any:
    """`value` with every float32 or complex64 array in it as float64 or complex128.

    Looks into trees of JAX and into dataclasses; whatever holds no such array is returned itself.
    JAX must be set to float64 (`jax.enable_x64`) where there are arrays of JAX.

    A number becomes the shortest decimal that rounds to it in float32, as it is printed: 0.1 that
    was kept in float32 is 0.1 again, not 0.100000001, so that numbers of a table or of a script
    are those that were written.  All others move by less than the rounding that they went through.

    >>> import numpy as np
    >>> promoted({"kd": np.float32(0.1), "name": "clear"})
    {'kd': np.float64(0.1), 'name': 'clear'}
    """
    # Dictionaries are leaves here: JAX would sort their keys.
    leaves, tree = jax.tree.flatten(value, is_leaf=lambda part: type(part) is dict)
    new = [_promoted_leaf(leaf) for leaf in leaves]
    if all(a is b for a, b in zip(leaves, new, strict=True)):
        return value
    return jax.tree.unflatten(tree, new)


def _promoted_leaf(leaf: Any) -> Any:
    if isinstance(leaf, Tracer):
        return leaf
    if type(leaf) is dict:
        new = {key: promoted(part) for key, part in leaf.items()}
        return new if any(new[key] is not leaf[key] for key in leaf) else leaf
    if isinstance(leaf, (jax.Array, np.ndarray, np.generic)):
        kind = _DOUBLE.get(str(leaf.dtype))
        if kind is None:
            return leaf
        numbers = _decimal(np.asarray(leaf))
        return jax.numpy.asarray(numbers) if isinstance(leaf, jax.Array) else numbers
    if dataclasses.is_dataclass(leaf) and not isinstance(leaf, type):
        given = {f.name: getattr(leaf, f.name) for f in dataclasses.fields(leaf)}
        new = {name: promoted(value) for name, value in given.items()}
        changed = {name: value for name, value in new.items() if value is not given[name]}
        if changed:
            leaf = copy.copy(leaf)
            for name, value in changed.items():
                object.__setattr__(leaf, name, value)
    return leaf


def _decimal(numbers: Any) -> Any:
    """The shortest decimals of float32 or complex64 numbers, as float64 or complex128."""
    if np.iscomplexobj(numbers):
        return _decimal(numbers.real) + 1j * _decimal(numbers.imag)
    return numbers.astype("U").astype(np.float64)[()]
