"""Factorisations of small matrices; on a CPU, a map over them becomes a loop.

jaxlib up to 0.11.1 divides a batch of LAPACK factorisations among the threads that run the program,
and each such call waits for its parts: as many simultaneous calls as there are threads deadlock.  A
loop of single factorisations cannot deadlock.  On an accelerator batches stay batches.
"""

from collections.abc import Callable

import jax
import jax.numpy as jnp
from jax.custom_batching import custom_vmap


def _one_by_one(factorise: Callable) -> Callable:
    def looped(matrices):
        flat = matrices.reshape(-1, *matrices.shape[-2:])
        found = jax.lax.map(factorise, flat)
        leading = matrices.shape[:-2]
        return jax.tree.map(lambda leaf: leaf.reshape(*leading, *leaf.shape[1:]), found)

    def batched(matrices):
        function = factorise
        for _ in range(matrices.ndim - 2):
            function = jax.vmap(function)
        return function(matrices)

    @custom_vmap
    def apply(matrices):
        if matrices.ndim == 2:
            return factorise(matrices)
        return jax.lax.platform_dependent(matrices, cpu=looped, default=batched)

    # Nested maps become more leading axes and one loop: nested loops would need transposed
    # operands, and XLA crashes when it simplifies a transposed product.
    @apply.def_vmap
    def _(size, batched, matrices):
        found = apply(matrices)
        return found, jax.tree.map(lambda _: True, found)

    return apply


@_one_by_one
def eigenvectors(matrix):
    """Of a symmetric matrix (n, n), of which the lower triangle is read, as columns."""
    return jnp.linalg.eigh(matrix, symmetrize_input=False)[1]


def _square_root(matrix):
    root = jnp.linalg.cholesky(matrix, symmetrize_input=False)
    one = jnp.eye(matrix.shape[0], dtype=matrix.dtype)
    return root, jax.lax.linalg.triangular_solve(root, one, left_side=True, lower=True)


@_one_by_one
def square_root(matrix):
    """(C, C^-1) with C C' = matrix (n, n), symmetric positive definite, C lower triangular."""
    return _square_root(matrix)


@_one_by_one
def inverse_of_positive(matrix):
    """Of a symmetric positive definite matrix (n, n)."""
    inverse = _square_root(matrix)[1]
    return inverse.T @ inverse


@_one_by_one
def inverse(matrix):
    """Of any matrix (n, n)."""
    return jnp.linalg.inv(matrix)
