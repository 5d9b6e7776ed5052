"""Least squares with three unknowns and quadratic residuals, differentiable and usable inside a scan.

Steps are solved by orthogonalisation. Normal equations would square the condition number and lose half
the digits for badly placed sensors. All arithmetic is unrolled, without calls to LAPACK. `minimise` is the
solver, `descend` the same without derivatives.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array, lax

from jaxekf.geometry.linalg import adjugate, multiply

# A direction in which the Jacobian is below this part of its size counts as undetermined.
WEAK = 1e-7
_MOST_STEPS = 60


def _times(matrix: Array, vector: Array) -> Array:
    """``matrix @ vector`` as a sum, which on a CPU joins the arithmetic around it."""
    return jnp.sum(matrix * vector[None, :], axis=1)


class Quadratic(NamedTuple):
    """Residuals ``constant + linear @ x + x' curved x``, in units of their noise.

    Examples
    --------
    >>> import numpy as np
    >>> from jaxekf.geometry.quadratic_least_squares import Quadratic
    >>> problem = Quadratic(-np.ones(3), np.diag([1.0, 2.0, 4.0]), np.zeros((3, 3, 3)))
    >>> problem.residual(np.ones(3)).tolist()
    [0.0, 1.0, 3.0]
    """

    constant: Array
    """(n,)."""
    linear: Array
    """(n, 3)."""
    curved: Array
    """(n, 3, 3), each symmetric."""

    def residual(self, x: Array) -> Array:
        """Residuals (n,) at `x` (3,)."""
        return self.constant + _times(self.linear + self.curved_times(x), x)

    def jacobian(self, x: Array) -> Array:
        """Derivative (n, 3) of the residuals at `x` (3,)."""
        return self.linear + 2.0 * self.curved_times(x)

    def curved_times(self, x: Array) -> Array:
        """``curved @ x`` (n, 3)."""
        return jnp.sum(self.curved * x[None, None, :], axis=2)


class Factors(NamedTuple):
    """QR factors ``matrix = basis @ inv(inverse)`` of a matrix (n, 3), by modified Gram-Schmidt.

    Examples
    --------
    >>> import jax, jaxekf, numpy as np
    >>> from jaxekf.geometry import quadratic_least_squares
    >>> jaxekf.set_up()
    >>> flat = np.diag([1.0, 2.0, 0.0])  # nothing depends on the third number
    >>> factors = jax.jit(quadratic_least_squares.orthogonalise)(flat, np.ones(3))
    >>> bool(factors.weak), np.diagonal(factors.inverse).round(5).tolist()
    (True, [1.0, 0.5, 0.0])
    """

    basis: Array
    """Orthonormal columns (n, 3); zero for a column that depends on the previous ones."""
    inverse: Array
    """Inverse of the triangular factor (3, 3), dependent columns left out."""
    large: Array
    """The same with dependent columns replaced by small ones, so that an undetermined direction is
    large."""
    right: Array
    """``basis' right`` (3,) of the right-hand side, to the accuracy of the orthogonal factors."""
    weak: Array
    """Whether a direction is undetermined, ()."""


def _upper_inverse(r01: Array, r02: Array, r12: Array, diagonal: list[Array]) -> Array:
    """Inverse (3, 3) of an upper triangular matrix whose `diagonal` is already inverted."""
    i, j, k = diagonal
    zero = jnp.zeros_like(i)
    u01, u12 = -i * r01 * j, -j * r12 * k
    u02 = -i * (r01 * u12 + r02 * k)
    rows = [[i, u01, u02], [zero, j, u12], [zero, zero, k]]
    return jnp.stack([jnp.stack(row) for row in rows])


def orthogonalise(matrix: Array, right: Array) -> Factors:
    """Factors of `matrix` (n, 3) and the right-hand side (n,); finite for any matrix.

    Examples
    --------
    >>> import jax, numpy as np
    >>> from jaxekf.geometry import quadratic_least_squares
    >>> matrix, right = np.diag([1.0, 2.0, 4.0]), np.array([1.0, 2.0, 8.0])
    >>> factors = jax.jit(quadratic_least_squares.orthogonalise)(matrix, right)
    >>> (factors.inverse @ factors.right).round(5).tolist()  # the solution of matrix @ x = right
    [1.0, 1.0, 2.0]
    """
    total = jnp.sum(lax.stop_gradient(matrix) ** 2)
    scale = jnp.sqrt(jnp.where(total > 0.0, total, 1.0))
    columns = [matrix[:, 0], matrix[:, 1], matrix[:, 2], right]
    basis, small, large, r = [], [], [], {}
    for k in range(3):
        squared = jnp.sum(columns[k] * columns[k])
        there = squared > (WEAK * scale) ** 2
        inverse = lax.rsqrt(jnp.where(there, squared, 1.0))
        small.append(jnp.where(there, inverse, 0.0))
        large.append(jnp.where(there, inverse, 1.0 / (WEAK * scale)))
        basis.append(columns[k] * small[k])
        for j in range(k + 1, 4):
            r[k, j] = jnp.sum(basis[k] * columns[j])
            columns[j] = columns[j] - basis[k] * r[k, j]
    above = r[0, 1], r[0, 2], r[1, 2]
    unknown = _upper_inverse(*above, large)
    # The largest singular value of the inverse, hence the smallest of the matrix, to a factor of 2.
    weak = jnp.sum(lax.stop_gradient(unknown) ** 2) * (WEAK * scale) ** 2 >= 1.0
    rights = jnp.stack([r[0, 3], r[1, 3], r[2, 3]])
    return Factors(
        jnp.stack(basis, axis=1),
        _upper_inverse(*above, small),
        unknown,
        rights,
        weak | (total == 0.0),
    )


def _inverse_or_identity(matrix: Array) -> Array:
    """Inverse (3, 3) by cofactors; the identity if the matrix is nearly singular."""
    rows, determinant = adjugate(matrix)
    good = jnp.abs(determinant) > 1e-9
    scaled = rows / jnp.where(good, determinant, 1.0)
    return jnp.where(good, scaled, jnp.eye(3, dtype=matrix.dtype))


def _inverse_hessian(problem: Quadratic, residual: Array, factors: Factors) -> Array:
    """Inverse Hessian (3, 3) of half the cost, in the coordinates of `factors`.

    It is the identity if all residuals are zero.
    """
    second = 2.0 * jnp.sum(residual[:, None, None] * problem.curved, axis=0)
    inside = multiply(multiply(factors.inverse.T, second), factors.inverse)
    return _inverse_or_identity(jnp.eye(3, dtype=second.dtype) + inside)


def _damped_step(problem: Quadratic, x: Array, damping: Array) -> Array:
    """Levenberg-Marquardt step (3,), `damping` relative to the size of the Jacobian."""
    jacobian = problem.jacobian(x)
    total = jnp.sum(jacobian * jacobian)
    weight = jnp.sqrt(damping * jnp.where(total > 0.0, total, 1.0))
    rows = jnp.concatenate([jacobian, weight * jnp.eye(3, dtype=x.dtype)])
    right = jnp.concatenate([problem.residual(x), jnp.zeros(3, x.dtype)])
    factors = orthogonalise(rows, right)
    return -_times(factors.inverse, factors.right)


def tolerance(x: Array) -> float:
    """Relative step length at which the search has converged; a further step would be rounding.

    Examples
    --------
    >>> import numpy as np
    >>> from jaxekf.geometry import quadratic_least_squares
    >>> f"{quadratic_least_squares.tolerance(np.zeros(3)):.1e}"
    '1.5e-08'
    """
    return float(jnp.finfo(x.dtype).eps) ** 0.5


def descend(problem: Quadratic, start: Array) -> tuple[Array, Array]:
    """Damped steps from `start` (3,), and whether they converged; without derivatives.

    Examples
    --------
    >>> import jax, jaxekf, numpy as np
    >>> from jaxekf.geometry.quadratic_least_squares import Quadratic, descend
    >>> jaxekf.set_up()
    >>> problem = Quadratic(-np.ones(3), np.diag([1.0, 2.0, 4.0]), np.zeros((3, 3, 3)))
    >>> x, converged = jax.jit(descend)(problem, np.zeros(3))
    >>> np.allclose(x, [1.0, 0.5, 0.25]), bool(converged)
    (True, True)
    """
    least = tolerance(start)

    def cost(x: Array) -> Array:
        return jnp.sum(problem.residual(x) ** 2)

    def unfinished(carry: tuple[Array, Array, Array, Array, Array]) -> Array:
        return ~carry[3] & (carry[4] < _MOST_STEPS)

    def advance(
        carry: tuple[Array, Array, Array, Array, Array],
    ) -> tuple[Array, Array, Array, Array, Array]:
        x, now, damping, _, count = carry
        step = _damped_step(problem, x, damping)
        then = cost(x + step)
        better = then <= now
        short = jnp.sum(step * step) <= (least * (1.0 + jnp.sum(jnp.abs(x)))) ** 2
        damping = jnp.clip(jnp.where(better, 0.1 * damping, 10.0 * damping), 1e-12, 1e12)
        return (
            jnp.where(better, x + step, x),
            jnp.where(better, then, now),
            damping,
            short,
            count + 1,
        )

    first = jnp.asarray(1e-6, start.dtype)
    begin = (start, cost(start), first, jnp.asarray(False), jnp.asarray(0))
    x, _, _, short, _ = lax.while_loop(unfinished, advance, begin)
    return x, short


@jax.custom_jvp
def minimise(problem: Quadratic, start: Array) -> tuple[Array, Array]:
    """Minimum of the sum of squares that is reached from `start`.

    Derivatives of any order, forward and reverse, follow from the implicit function theorem; there is
    none by `start`. A direction that the residuals do not determine stays near `start` and has
    derivative zero.

    Parameters
    ----------
    problem
        Residuals.
    start
        (3,) initial value.

    Returns
    -------
    The minimum (3,), and whether the search converged, ().

    Examples
    --------
    >>> import jax, jaxekf, numpy as np
    >>> from jaxekf.geometry.quadratic_least_squares import Quadratic, minimise
    >>> jaxekf.set_up()
    >>> problem = Quadratic(-np.ones(3), np.diag([1.0, 2.0, 4.0]), np.zeros((3, 3, 3)))
    >>> x, converged = jax.jit(minimise)(problem, np.zeros(3))
    >>> np.asarray(x).round(9).tolist(), bool(converged)
    ([1.0, 0.5, 0.25], True)
    """
    x, _ = descend(problem, start)
    # Undamped and with the full Hessian: exact to rounding, and a reliable test of convergence.
    residual = problem.residual(x)
    factors = orthogonalise(problem.jacobian(x), residual)
    step = -_times(
        factors.inverse, _times(_inverse_hessian(problem, residual, factors), factors.right)
    )
    length = jnp.sqrt(jnp.sum(step * step)) / (1.0 + jnp.sum(jnp.abs(x)))
    x = jnp.where(length <= 1e4 * tolerance(x), x + step, x)
    return x, length <= tolerance(x)


@minimise.defjvp
def _minimise_jvp(
    primals: tuple[Quadratic, Array], tangents: tuple[Quadratic, Array]
) -> tuple[tuple[Array, Array], tuple[Array, Array]]:
    problem, start = primals
    change, _ = tangents
    x, converged = minimise(problem, start)
    residual = problem.residual(x)
    factors = orthogonalise(problem.jacobian(x), change.residual(x))
    towards = factors.right + _times(factors.inverse.T, _times(change.jacobian(x).T, residual))
    moved = -_times(factors.inverse, _times(_inverse_hessian(problem, residual, factors), towards))
    return (x, converged), (moved, jnp.zeros(converged.shape, jax.dtypes.float0))  # pyright: ignore
