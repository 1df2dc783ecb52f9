"""Factorisations of small matrices, of which a map makes a loop on a CPU.

jaxlib up to 0.11.1 shares a batch of LAPACK's factorisations among the threads that run the program,
and each such call waits for its shares: as many calls at once as there are threads wait for each
other for ever.  A loop of single factorisations cannot; on an accelerator batches stay batches.
"""

from collections.abc import Callable

import jax
import jax.numpy as jnp
from jax.custom_batching import sequential_vmap


def _one_by_one(factorise: Callable) -> Callable:
    looped = sequential_vmap(factorise)

    def apply(matrix):
        return jax.lax.platform_dependent(matrix, cpu=looped, default=factorise)

    return apply


@_one_by_one
def eigenvectors(matrix):
    """Of a symmetric matrix (n, n), as columns."""
    return jnp.linalg.eigh(matrix, symmetrize_input=False)[1]


@_one_by_one
def square_root(matrix):
    """(C, C^-1) with C C' = matrix (n, n), symmetric positive definite, C lower triangular."""
    root = jnp.linalg.cholesky(matrix, symmetrize_input=False)
    one = jnp.eye(matrix.shape[0], dtype=matrix.dtype)
    return root, jax.lax.linalg.triangular_solve(root, one, left_side=True, lower=True)


@_one_by_one
def inverse(matrix):
    """Of any matrix (n, n)."""
    return jnp.linalg.inv(matrix)
