"""Dense matrix products on the batch axis: every array carries the runs on its last axis, the lanes.

The only dense products of the filter. `jaxekf.filtering.lowering.structured_matrix` multiplies matrices
with known entries; `jaxekf.geometry.linalg` serves model code, which is written for one run.
"""

import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxekf.filtering.lowering.lanes import broadcast_axes, materialise, pairwise_sum
from jaxekf.geometry import linalg


def multiply(left: Array, right: Array) -> Array:
    """``left @ right``, (i, k, lanes), (k, j, lanes) to (i, j, lanes)."""
    shape = (*left.shape[:2], *right.shape[1:])
    return pairwise_sum(broadcast_axes(left, shape, 0, 1) * broadcast_axes(right, shape, 1, 2), 1)


def multiply_transposed(left: Array, right: Array) -> Array:
    """``left @ right.T``, (i, k, lanes), (j, k, lanes) to (i, j, lanes)."""
    shape = (left.shape[0], *right.shape)
    return pairwise_sum(broadcast_axes(left, shape, 0, 2) * broadcast_axes(right, shape, 1, 2), 2)


def transposed_multiply(left: Array, right: Array) -> Array:
    """``left.T @ right``, (k, i, lanes), (k, j, lanes) to (i, j, lanes)."""
    shape = (*left.shape[:2], *right.shape[1:])
    return pairwise_sum(broadcast_axes(left, shape, 0, 1) * broadcast_axes(right, shape, 0, 2), 0)


def multiply_vector(matrix: Array, vector: Array) -> Array:
    """``matrix @ vector``, (i, k, lanes), (k, lanes) to (i, lanes)."""
    return pairwise_sum(matrix * broadcast_axes(vector, matrix.shape, 1), 1)


def transposed_multiply_vector(matrix: Array, vector: Array) -> Array:
    """``matrix.T @ vector``, (k, i, lanes), (k, lanes) to (i, lanes)."""
    return pairwise_sum(matrix * broadcast_axes(vector, matrix.shape, 0), 0)


def dot(left: Array, right: Array) -> Array:
    """Scalar product, (n, lanes), (n, lanes) to (1, lanes)."""
    return pairwise_sum(left * right, 0, keep=True)


def outer(left: Array, right: Array) -> Array:
    """Outer product, (i, lanes), (j, lanes) to (i, j, lanes)."""
    shape = (left.shape[0], *right.shape)
    return broadcast_axes(left, shape, 0) * broadcast_axes(right, shape, 1)


def diagonal_matrix(values: Array) -> Array:
    """Diagonal matrices, (n, lanes) to (n, n, lanes)."""
    here = np.eye(values.shape[0], dtype=bool)[:, :, None]
    return jnp.where(here, values[:, None], 0.0)


def congruence(matrix: Array, cov: Array) -> Array:
    """``M P M'``, symmetrised, (m, n, lanes), (n, n, lanes) to (m, m, lanes)."""
    half = materialise(multiply(matrix, cov))
    return materialise(linalg.symmetrise(multiply_transposed(half, matrix)))
