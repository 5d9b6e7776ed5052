"""Small dense linear algebra for the filter: sizes are static and tiny, so loops are unrolled.

Inside a ``lax.scan`` on a CPU a call to LAPACK, or a tiny ``dot``, costs far more than its arithmetic;
these functions are plain arithmetic which XLA fuses. Matrix indices are the **first** axes; all further
axes are *lanes*: independent problems, usually runs, next to each other in memory. The products are for
model code, which is written for one run; the filter has those of
`jaxekf.filtering.lowering.batched_products`.
"""

from collections.abc import Sequence
from typing import Any

import jax.numpy as jnp
from jax import Array, lax

from jaxekf._support.errors import ArgumentError


def symmetrise(matrix: Array) -> Array:
    """The symmetric part, (n, n, ...).

    Examples
    --------
    >>> import jax.numpy as jnp
    >>> from jaxekf.geometry import linalg
    >>> linalg.symmetrise(jnp.array([[1.0, 2.0], [4.0, 3.0]])).tolist()
    [[1.0, 3.0], [3.0, 3.0]]
    """
    return 0.5 * (matrix + matrix.swapaxes(0, 1))


def diagonal(matrix: Array) -> Array:
    """Diagonal, shape (n, n, ...) to (n, ...).

    Examples
    --------
    >>> import numpy as np
    >>> from jaxekf.geometry import linalg
    >>> linalg.diagonal(np.array([[1.0, 2.0], [4.0, 3.0]])).tolist()
    [1.0, 3.0]
    >>> linalg.diagonal(np.zeros((2, 2, 16))).shape  # 16 runs on the last axis
    (2, 16)
    """
    return jnp.stack([matrix[i, i] for i in range(matrix.shape[0])])


def multiply(left: Array, right: Array) -> Array:
    """Matrix product, shapes (i, k, ...), (k, j, ...) to (i, j, ...).

    Examples
    --------
    >>> import numpy as np
    >>> from jaxekf.geometry import linalg
    >>> swap = np.array([[0.0, 1.0], [1.0, 0.0]])
    >>> linalg.multiply(swap, np.array([[1.0, 2.0], [3.0, 4.0]])).tolist()
    [[3.0, 4.0], [1.0, 2.0]]
    >>> linalg.multiply(np.zeros((2, 3, 16)), np.zeros((3, 4, 16))).shape  # 16 runs
    (2, 4, 16)
    """
    return jnp.sum(left[:, :, None] * right[None], axis=1)


def multiply_transposed(left: Array, right: Array) -> Array:
    """``left @ right.T``, shapes (i, k, ...), (j, k, ...) to (i, j, ...).

    Examples
    --------
    >>> import numpy as np
    >>> from jaxekf.geometry import linalg
    >>> left, right = np.arange(6.0).reshape(2, 3), np.ones((4, 3))
    >>> np.allclose(linalg.multiply_transposed(left, right), left @ right.T)
    True
    """
    return jnp.sum(left[:, None] * right[None], axis=2)


def congruence(left: Array, matrix: Array) -> Array:
    """``left @ matrix @ left.T`` of a symmetric matrix, (i, k, ...), (k, k, ...) to (i, i, ...).

    Examples
    --------
    >>> import numpy as np
    >>> from jaxekf.geometry import linalg
    >>> transition = np.array([[1.0, 0.5], [0.0, 1.0]])  # of position and velocity over 0.5 s
    >>> cov = np.diag([0.0, 4.0])
    >>> linalg.congruence(transition, cov).tolist()
    [[1.0, 2.0], [2.0, 4.0]]
    """
    return symmetrise(multiply_transposed(multiply(left, matrix), left))


def identity_like(matrix: Array) -> Array:
    """Identity matrix broadcast to the shape (n, n, ...) of `matrix`.

    Examples
    --------
    >>> import jaxekf, numpy as np
    >>> from jaxekf.geometry import linalg
    >>> jaxekf.set_up()
    >>> linalg.identity_like(np.zeros((2, 2))).tolist()
    [[1.0, 0.0], [0.0, 1.0]]
    >>> linalg.identity_like(np.zeros((2, 2, 16))).shape
    (2, 2, 16)
    """
    size = matrix.shape[0]
    eye = jnp.eye(size, dtype=matrix.dtype).reshape((size, size) + (1,) * (matrix.ndim - 2))
    return jnp.broadcast_to(eye, matrix.shape)


def standard_deviation_factor(deviation: Array, dim: int) -> Array:
    """Lower-triangular factor ``L`` of the covariance ``L @ L.T`` that a noise parameter describes.

    Parameters
    ----------
    deviation
        Standard deviation of all axes, shape (); of each axis, shape (dim,); or a lower-triangular factor,
        shape (dim, dim), whose entries above the diagonal are ignored.
    dim
        Number of axes.

    Returns
    -------
    (dim, dim) lower-triangular factor.

    Raises
    ------
    ArgumentError
        For any other shape.

    Examples
    --------
    >>> import numpy as np
    >>> from jaxekf.geometry import linalg
    >>> linalg.standard_deviation_factor(np.array([0.5, 2.0]), 2).tolist()
    [[0.5, 0.0], [0.0, 2.0]]
    """
    deviation = jnp.asarray(deviation)
    if deviation.ndim == 0:
        return deviation * jnp.eye(dim, dtype=deviation.dtype)
    if deviation.shape == (dim,):
        return jnp.diag(deviation)
    if deviation.shape == (dim, dim):
        return jnp.tril(deviation)
    raise ArgumentError(
        f"got a noise parameter of shape {deviation.shape}, expected (), ({dim},) or ({dim}, {dim});"
        " give one standard deviation, one for each axis, or a lower-triangular factor"
    )


def covariance(deviation: Array, dim: int) -> Array:
    """Covariance (dim, dim) of a noise parameter; see `standard_deviation_factor`.

    Examples
    --------
    >>> import numpy as np
    >>> from jaxekf.geometry import linalg
    >>> linalg.covariance(3.0, 2).tolist()  # one deviation for both axes
    [[9.0, 0.0], [0.0, 9.0]]
    >>> linalg.covariance(np.array([[2.0, 0.0], [1.0, 1.0]]), 2).tolist()  # a triangular factor
    [[4.0, 2.0], [2.0, 2.0]]
    """
    factor = standard_deviation_factor(deviation, dim)
    return factor @ factor.T


def block_diagonal(blocks: Sequence[Array]) -> Array:
    """The block-diagonal matrix (n, n) of square matrices, in order.

    Examples
    --------
    >>> import numpy as np
    >>> from jaxekf.geometry import linalg
    >>> linalg.block_diagonal([np.ones((1, 1)), 2.0 * np.eye(2)]).tolist()
    [[1.0, 0.0, 0.0], [0.0, 2.0, 0.0], [0.0, 0.0, 2.0]]
    """
    return jnp.block(
        [
            [row if i == j else jnp.zeros((len(row), len(b))) for j, b in enumerate(blocks)]
            for i, row in enumerate(blocks)
        ]
    )


def block_covariance(deviations: Sequence[Any], dims: Sequence[int] | None = None) -> Array:
    """Block-diagonal covariance of independent noise parameters, of three axes each or of `dims`.

    Examples
    --------
    >>> import numpy as np
    >>> from jaxekf.geometry import linalg
    >>> gyroscope, walk = 2.0, np.array([1.0, 1.0, 3.0])
    >>> np.diagonal(linalg.block_covariance([gyroscope, walk])).tolist()
    [4.0, 4.0, 4.0, 1.0, 1.0, 9.0]
    """
    dims = dims or (3,) * len(deviations)
    return block_diagonal([covariance(d, dim) for d, dim in zip(deviations, dims, strict=True)])


def adjugate(matrix: Array) -> tuple[Array, Array]:
    """Adjugate (3, 3) and determinant () of a matrix (3, 3): the inverse is their ratio.

    Examples
    --------
    >>> import numpy as np
    >>> from jaxekf.geometry import linalg
    >>> adjugate, determinant = linalg.adjugate(np.diag([1.0, 2.0, 4.0]))
    >>> np.diagonal(adjugate).tolist(), float(determinant)
    ([8.0, 4.0, 2.0], 8.0)
    """
    a, b, c = matrix
    rows = jnp.stack([jnp.cross(b, c), jnp.cross(c, a), jnp.cross(a, b)], axis=1)
    return rows, jnp.sum(a * rows[:, 0])


def mask_covariance(matrix: Array, mask: Array) -> Array:
    """Covariance (m, m, ...) whose rows and columns outside `mask` (m, ...) are those of the identity.

    The visible sub-block is unchanged, so a factor of the result whitens the visible rows as if the masked
    ones did not exist, correlations included.

    Examples
    --------
    >>> import jaxekf, numpy as np
    >>> from jaxekf.geometry import linalg
    >>> jaxekf.set_up()
    >>> cov, visible = np.array([[4.0, 1.0], [1.0, 9.0]]), np.array([True, False])
    >>> linalg.mask_covariance(cov, visible).tolist()
    [[4.0, 0.0], [0.0, 1.0]]
    """
    both = mask[:, None] & mask[None, :]
    return jnp.where(both, matrix, identity_like(matrix))


def whitener(matrix: Array) -> tuple[Array, Array]:
    """Lower Cholesky factor of a small positive definite matrix, and the reciprocals of its diagonal.

    Shapes (m, m, ...) to (m, m, ...) and (m, ...). The result is NaN if the matrix is not definite.

    Examples
    --------
    >>> import jax, numpy as np
    >>> from jaxekf.geometry import linalg
    >>> factor, reciprocals = jax.jit(linalg.whitener)(np.array([[4.0, 2.0], [2.0, 5.0]]))
    >>> np.allclose(factor, [[2.0, 0.0], [1.0, 2.0]]), np.allclose(reciprocals, 0.5)
    (True, True)
    """
    size = matrix.shape[0]
    rows: list[list[Array]] = []
    inverses: list[Array] = []
    for i in range(size):
        row: list[Array] = []
        for j in range(i + 1):
            value = matrix[i, j]
            for k in range(j):
                value = value - row[k] * (row[k] if j == i else rows[j][k])
            if j < i:
                row.append(value * inverses[j])
                continue
            inverses.append(lax.rsqrt(value))
            row.append(value * inverses[i])
        rows.append(row)
    zero = jnp.zeros_like(matrix[0, 0])
    factor = jnp.stack([jnp.stack(row + [zero] * (size - len(row))) for row in rows])
    return factor, jnp.stack(inverses)


def semidefinite_factor(matrix: Array) -> Array:
    """Lower factor ``L``, ``L @ L.T == matrix``, of a positive semidefinite matrix (n, n, ...).

    A variance that is zero up to rounding gives a zero column with zero derivative. The result is NaN
    if the matrix is not semidefinite.

    Examples
    --------
    >>> import jax, numpy as np
    >>> from jaxekf.geometry import linalg
    >>> factor = jax.jit(linalg.semidefinite_factor)(np.array([[4.0, 0.0], [0.0, 0.0]]))
    >>> np.allclose(factor, [[2.0, 0.0], [0.0, 0.0]])  # a variance of zero is no failure
    True
    """
    size = matrix.shape[0]
    index = jnp.arange(size).reshape((size,) + (1,) * (matrix.ndim - 2))
    scale = diagonal(lax.stop_gradient(matrix))
    deviation = jnp.sqrt(jnp.maximum(scale, 0.0))
    # Root of the rounding error of each variance; eliminating a small variance makes it larger.
    slack = jnp.sqrt(8.0 * size * jnp.finfo(matrix.dtype).eps) * deviation
    columns: list[Array] = []
    for j in range(size):
        rest = matrix[:, j]
        for column in columns:
            rest = rest - column * column[j][None]
        positive = rest[j] > slack[j] * slack[j]
        # By Schwarz' inequality the covariances of a zero variance are small, too.
        much = (index > j) & (jnp.abs(rest) > 2.0 * slack[j][None] * deviation)
        empty = (rest[j] >= -slack[j] * slack[j]) & (scale[j] >= 0.0) & ~jnp.any(much, axis=0)
        inverse = lax.rsqrt(jnp.where(positive, rest[j], 1.0))
        column = jnp.where((index >= j) & positive[None], rest * inverse[None], 0.0)
        columns.append(jnp.where((positive | empty)[None], column, jnp.nan))
        ratio = lax.stop_gradient(jnp.abs(column) * inverse[None])
        slack = slack + jnp.where(index > j, ratio * slack[j][None], 0.0)
    return jnp.stack(columns, axis=1)


def whiten(white: tuple[Array, Array], right: Array) -> Array:
    """``inv(factor) @ right`` with the result of `whitener`, right (m, ...) or (m, n, ...).

    Examples
    --------
    >>> import jax, numpy as np
    >>> from jaxekf.geometry import linalg
    >>> white = jax.jit(linalg.whitener)(np.array([[4.0, 0.0], [0.0, 9.0]]))  # deviations 2 and 3
    >>> np.asarray(linalg.whiten(white, np.array([2.0, 6.0]))).round(5).tolist()
    [1.0, 2.0]
    """
    factor, inverses = white
    if right.ndim == factor.ndim:
        factor, inverses = factor[:, :, None], inverses[:, None]
    solved: list[Array] = []
    for i in range(factor.shape[0]):
        value = right[i]
        for k in range(i):
            value = value - factor[i, k] * solved[k]
        solved.append(value * inverses[i])
    return jnp.stack(solved)


def squared_distance(residual: Array, cov: Array) -> Array:
    """Squared Mahalanobis distance ``r' inv(S) r``, shapes (m, ...), (m, m, ...) to (...).

    Examples
    --------
    >>> import jax, numpy as np
    >>> from jaxekf.geometry import linalg
    >>> innovation, cov = np.array([2.0, 6.0]), np.diag([4.0, 9.0])
    >>> round(float(jax.jit(linalg.squared_distance)(innovation, cov)), 4)  # 1^2 + 2^2
    5.0
    """
    white = whiten(whitener(cov), residual)
    total = white[0] * white[0]
    for w in white[1:]:
        total = total + w * w
    return total
