"""The covariance algebra of the filter on lanes, each piece with its derivative in closed form.

Covariances are symmetric but for rounding, and so are their cotangents. The derivatives of the
update are those of Parellier, Barrau and Bonnabel (2023), extended to a block of rows taken after
others, to the log-likelihood and to the slope of the measurement.
"""

import operator
from functools import cache, partial, reduce
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax

from jaxekf import linalg, patterned
from jaxekf.kernels import loop
from jaxekf.lanes import written_sum
from jaxekf.patterned import Pattern

_LOG_2PI = float(np.log(2.0 * np.pi))
_PIVOTS_PER_LOG = 4


def product(left: Array, right: Array) -> Array:
    """Matrix product written out, (i, k, lanes), (k, j, lanes) to (i, j, lanes)."""
    return written_sum([left[:, k, None] * right[None, k] for k in range(right.shape[0])])


def product_transposed(left: Array, right: Array) -> Array:
    """``left @ right.T``, (i, k, lanes), (j, k, lanes) to (i, j, lanes)."""
    return written_sum([left[:, k, None] * right[None, :, k] for k in range(right.shape[1])])


def transposed_product(left: Array, right: Array) -> Array:
    """``left.T @ right``, (k, i, lanes), (k, j, lanes) to (i, j, lanes)."""
    return written_sum([left[k, :, None] * right[k, None] for k in range(right.shape[0])])


def apply(matrix: Array, vector: Array) -> Array:
    """Matrix times vector, (i, k, lanes), (k, lanes) to (i, lanes)."""
    return written_sum([matrix[:, k] * vector[k][None] for k in range(vector.shape[0])])


def outer(left: Array, right: Array) -> Array:
    """Outer product, (i, lanes), (j, lanes) to (i, j, lanes)."""
    return left[:, None] * right[None]


def on_diagonal(values: Array) -> Array:
    """Diagonal matrices, (n, lanes) to (n, n, lanes)."""
    # Row by row: the derivative of a broadcast would be a reduction, which `kernels.block` cannot hold.
    here = np.eye(values.shape[0], dtype=bool)[:, :, None]
    return jnp.stack([jnp.where(row, values, 0.0) for row in here])


def add_on_diagonal(matrix: Array, values: Array) -> Array:
    """``matrix + diag(values)``, (n, n, lanes), (n, lanes), in one pass."""
    here = np.eye(values.shape[0], dtype=bool)[:, :, None]
    return matrix + jnp.where(here, values[:, None], 0.0)


add_on_diagonal_with_adjoint = jax.custom_vjp(add_on_diagonal)
"""The same, its derivative without the reduction that JAX's own would be."""
add_on_diagonal_with_adjoint.defvjp(
    lambda matrix, values: (add_on_diagonal(matrix, values), None),
    lambda _, cotangent: (cotangent, linalg.diagonal(cotangent)),
)


# --- M P M' -------------------------------------------------------------------------------------------


def congruence(p: Pattern, block: Array | None, cov: Array) -> tuple[Array, Array]:
    """``M P M'`` and ``M P``."""
    half = loop(partial(patterned.multiply, p), block, cov)
    whole = loop(lambda b, h: patterned.multiply(p, b, h, axis=1), block, half)
    return linalg.symmetrise(whole), half


def _congruence_pullback(
    p: Pattern, block: Array | None, half: Array, cotangent: Array
) -> tuple[Array | None, Array]:
    """Cotangents of the block and of P: ``2 B M P`` where M is unknown, ``M' B M``."""
    back, turned = p.transposed, patterned.transpose(block)
    first = loop(partial(patterned.multiply, back), turned, cotangent)
    cov = loop(lambda t, f: patterned.multiply(back, t, f, axis=1), turned, first)
    if block is None:
        return None, cov

    def slope(cotangent: Array, half: Array) -> Array:
        rows = patterned.take(cotangent, p.rows, 0)
        return 2.0 * product(rows, patterned.take(half, p.cols, 1))

    return loop(slope, cotangent, half), cov


@cache
def congruence_with_adjoint(p: Pattern) -> Any:
    """`congruence` of (block, P) with its derivative; returns ``M P M'`` only."""

    @jax.custom_vjp
    def function(block: Array | None, cov: Array) -> Array:
        return congruence(p, block, cov)[0]

    def forward(block: Array | None, cov: Array) -> Any:
        whole, half = congruence(p, block, cov)
        return whole, (block, half)

    def backward(saved: Any, cotangent: Array) -> Any:
        block, half = saved
        return _congruence_pullback(p, block, half, cotangent)

    function.defvjp(forward, backward)
    return function


# --- update -------------------------------------------------------------------------------------------


class Rows(NamedTuple):
    """Rows taken together: residual (m, lanes), unknown block of the slope H, noise R, and which count.

    The noise is a covariance (m, m, lanes), or variances (m, lanes) where it is known to be diagonal.
    """

    residual: Array
    slope: Array | None
    noise: Array
    mask: Array


class Gained(NamedTuple):
    """State of an update while blocks of rows are taken."""

    cov: Array
    delta: Array
    log_likelihood: Array


class _Factor(NamedTuple):
    """``S = sum_k column_k column_k' / pivot_k`` of symmetric positive definite matrices on lanes.

    Column k holds rows k and later. The pivots are those of Cholesky's factor, squared.
    """

    columns: list[Array]
    inverses: list[Array]

    @property
    def pivots(self) -> list[Array]:
        """(lanes,) each; one that is not positive says that the matrix was not definite."""
        return [column[0] for column in self.columns]

    def ratio(self, row: int, k: int) -> Array:
        """Element (row, k) of the unit lower factor."""
        return self.columns[k][row - k] * self.inverses[k]


def factor(size: int, column: Any, *args: Any) -> _Factor:
    """Factor of symmetric positive definite matrices; no square root is taken.

    ``column(j, *args)`` gives rows j and later of the matrix's column j, (size - j, lanes).
    """
    found = _Factor([], [])
    for j in range(size):

        def eliminated(found: _Factor, *args: Any, j: int = j) -> Array:
            value = column(j, *args)
            for k, earlier in enumerate(found.columns):
                value = value - earlier[j - k :] * found.ratio(j, k)[None]
            return value

        found.columns.append(loop(eliminated, found, *args))
        found.inverses.append(loop(lambda column: 1.0 / column[0], found.columns[j]))
    return found


def solve(factored: _Factor, right: list[Array]) -> list[Array]:
    """Rows of ``inv(S) @ right``; rows are (n, lanes)."""
    lowered: list[Array] = []
    for i, row in enumerate(right):

        def eliminate(row: Array, factored: _Factor, lowered: list[Array], i: int = i) -> Array:
            for k, earlier in enumerate(lowered):
                row = row - factored.ratio(i, k)[None] * earlier
            return row

        lowered.append(row if i == 0 else loop(eliminate, row, factored, lowered))
    solved: list[Array] = []
    for i in reversed(range(len(right))):

        def substitute(row: Array, factored: _Factor, solved: list[Array], i: int = i) -> Array:
            row = factored.inverses[i][None] * row
            for k, later in zip(range(i + 1, len(right)), solved, strict=True):
                row = row - factored.ratio(k, i)[None] * later
            return row

        solved.insert(0, loop(substitute, lowered[i], factored, solved))
    return solved


class Solved(NamedTuple):
    """What an update and its derivative share; lists are over rows, each (columns, lanes)."""

    factored: _Factor
    right: list[Array]
    """``[H P | e]``, hidden rows zero; with one more unit row for each measured number for derivatives."""
    solved: list[Array]
    """``inv(S)`` times it: ``[K' | inv(S) e | inv(S)]``."""


def innovation_covariance(p: Pattern, slope: Array | None, noise: Array, cov: Array) -> Array:
    """``H P H' + R`` of all rows, hidden ones included."""
    projected = loop(partial(patterned.multiply, p), slope, cov)
    spread = loop(lambda s, h: patterned.multiply(p, s, h, axis=1), slope, projected)
    return spread + (on_diagonal(noise) if noise.ndim == 2 else noise)


def _right(
    p: Pattern, i: int, with_inverse: bool, slope: Array | None, gained: Gained, rows: Rows
) -> Array:
    """Row i of ``[H P | e]``, zero where hidden, and of the identity beside it."""
    row = patterned.row(p, slope, i, gained.cov)
    row = jnp.zeros_like(gained.cov[0]) if row is None else row
    moved = patterned.row(p, slope, i, gained.delta)
    residual = rows.residual[i] if moved is None else rows.residual[i] - moved
    seen = rows.mask[i][None]
    parts = [jnp.where(seen, row, 0.0), jnp.where(seen, residual[None], 0.0)]
    if with_inverse:
        unit = np.eye(rows.mask.shape[0])[i][:, None]
        parts.append(jnp.broadcast_to(jnp.asarray(unit, row.dtype), rows.mask.shape))
    return lax.concatenate(parts, 0)


def _innovation_column(
    p: Pattern, j: int, slope: Array | None, right: list[Array], noise: Array, mask: Array
) -> Array:
    """Rows j and later of column j of ``H P H' + R``, hidden rows as in the identity."""
    value = patterned.multiply(p, slope, right[j][: p.shape[1]])[j:]
    first = np.arange(mask.shape[0] - j)[:, None] == 0
    value = (
        value + jnp.where(first, noise[j][None], 0.0) if noise.ndim == 2 else value + noise[j:, j]
    )
    return jnp.where(mask[j:] & mask[j][None], value, first.astype(value.dtype))


def _solve(p: Pattern, gained: Gained, rows: Rows, with_inverse: bool) -> Solved:
    count = range(rows.mask.shape[0])
    right = [loop(partial(_right, p, i, with_inverse), rows.slope, gained, rows) for i in count]
    column = partial(_innovation_column, p)
    factored = factor(len(count), column, rows.slope, right, rows.noise, rows.mask)
    return Solved(factored, right, solve(factored, right))


def sum_of_outer(left: list[Array], right: list[Array]) -> Array:
    """``sum_i left_i right_i'``, rows (n, lanes) to (n, n, lanes)."""
    return written_sum([outer(a, b) for a, b in zip(left, right, strict=True)])


def take(
    p: Pattern, gained: Gained, rows: Rows, with_inverse: bool = False
) -> tuple[Gained, Array, Solved]:
    """The state after a block of rows, their smallest pivot, and what the derivative needs.

    The covariance is symmetric but for rounding; its cotangent must be symmetric.

    The covariance is Joseph's ``(I - K H) P (I - K H)' + K R K'``, in the order ``half = P - K (H P)``,
    ``half + (K R - half H') K'``: a gain that is rounded then counts only to the second order.
    """
    found = _solve(p, gained, rows, with_inverse)
    mask, noise, size = rows.mask, rows.noise, p.shape[1]

    def half_way(cov: Array, solved: list[Array], right: list[Array]) -> Array:
        return cov - sum_of_outer([k[:size] for k in solved], [r[:size] for r in right])

    def remainder(half: Array, slope: Array | None, solved: list[Array], i: int) -> Array:
        gain = [k[:size] for k in solved]
        if noise.ndim == 2:
            spread = gain[i] * noise[i][None]
        else:
            spread = written_sum([g * noise[k, i][None] for k, g in enumerate(gain)])
        seen = patterned.row(p, slope, i, half, axis=1)
        return jnp.where(mask[i][None], spread if seen is None else spread - seen, 0.0)

    def finish(half: Array, rest: list[Array], solved: list[Array]) -> Array:
        return half + sum_of_outer(rest, [k[:size] for k in solved])

    half = loop(half_way, gained.cov, found.solved, found.right)
    count = range(mask.shape[0])
    rest = [loop(partial(remainder, i=i), half, rows.slope, found.solved) for i in count]
    cov = loop(finish, half, rest, found.solved)

    def move(delta: Array, solved: list[Array], right: list[Array]) -> Array:
        pairs = zip(solved, right, strict=True)
        return delta + written_sum([k[:size] * r[size][None] for k, r in pairs])

    delta = loop(move, gained.delta, found.solved, found.right)
    log_likelihood = gained.log_likelihood - 0.5 * loop(partial(_surprise, size), found, mask)
    smallest = loop(lambda pivots: reduce(jnp.minimum, pivots), found.factored.pivots)
    return Gained(cov, delta, log_likelihood), smallest, found


def _surprise(size: int, found: Solved, mask: Array) -> Array:
    """``e' inv(S) e + log det (2 pi S)`` of the rows that count; `size` columns before e."""
    squares = [s[size] * r[size] for s, r in zip(found.solved, found.right, strict=True)]
    # Few logarithms: pivots are multiplied first, few enough that no product over- or underflows.
    pivots = found.factored.pivots
    products = [
        reduce(operator.mul, pivots[i : i + _PIVOTS_PER_LOG])
        for i in range(0, len(pivots), _PIVOTS_PER_LOG)
    ]
    visible = written_sum([mask[i].astype(squares[0].dtype) for i in range(mask.shape[0])])
    return written_sum(squares) + written_sum([jnp.log(q) for q in products]) + visible * _LOG_2PI


def update(p: Pattern, gained: Gained, rows: Rows) -> tuple[Gained, Array]:
    """Take a block of rows; also the smallest pivot, positive where all went well.

    The covariance is symmetric but for rounding, and making it exactly so is left to the caller.
    """
    after, smallest, _ = take(p, gained, rows)
    return after, smallest


class _Saved(NamedTuple):
    """What the derivative of an update needs of it."""

    cov: Array
    """P after it."""
    delta: Array
    solved: Array
    """``[K' | inv(S) e | inv(S)]``, (rows, columns, lanes)."""
    slope: Array | None
    mask: Array


def _update_pullback(
    p: Pattern, diagonal: bool, saved: _Saved, cotangent: Gained
) -> tuple[Gained, Rows]:
    """Cotangents of what went into `update` from those of what came out."""
    mask, slope, solved, size = saved.mask, saved.slope, saved.solved, p.shape[1]
    back, turned = p.transposed, patterned.transpose(slope)
    b, a, weight = cotangent.cov, cotangent.delta, cotangent.log_likelihood
    both = mask[:, None] & mask[None]
    lowered = loop(lambda solved, a: apply(solved[:, :size], a), solved, a)  # K' a

    def error_of(lowered: Array, solved: Array, weight: Array) -> Array:
        return lowered - weight[None] * solved[:, size]

    error = loop(error_of, lowered, solved, weight)
    turned_b = loop(lambda solved, b: product(solved[:, :size], b), solved, b)  # K' B

    # N = K' B K + M, M the information: w / 2 (s s' - inv(S)).
    def inner_of(turned_b: Array, solved: Array, weight: Array, both: Array) -> Array:
        scaled = solved[:, size]
        info = (0.5 * weight)[None, None] * (outer(scaled, scaled) - solved[:, size + 1 :])
        return product_transposed(turned_b, solved[:, :size]) + jnp.where(both, info, 0.0)

    inner = loop(inner_of, turned_b, solved, weight, both)

    def of_noise(inner: Array, lowered: Array, solved: Array, mask: Array, both: Array) -> Array:
        if diagonal:
            return jnp.where(mask, linalg.diagonal(inner) - lowered * solved[:, size], 0.0)
        return jnp.where(both, inner - linalg.symmetrise(outer(lowered, solved[:, size])), 0.0)

    noise = loop(of_noise, inner, lowered, solved, mask, both)
    pulled = a - loop(partial(patterned.multiply, back), turned, lowered)  # A' a

    # The whole is B - H' T - T' H,  T = K' B - N H / 2 - s (A' a)' / 2.
    def half(
        slope: Array | None, inner: Array, turned_b: Array, solved: Array, pulled: Array
    ) -> Array:
        drawn = patterned.multiply(p.transposed, patterned.transpose(slope), inner, axis=1)
        return turned_b - 0.5 * (drawn + outer(solved[:, size], pulled))

    spread = loop(half, slope, inner, turned_b, solved, pulled)
    whole = loop(partial(patterned.multiply, back), turned, spread)
    cov = loop(lambda b, w: b - w - w.swapaxes(0, 1), b, whole)
    delta = a - loop(partial(patterned.multiply, back), turned, error)
    slope_bar = None
    if slope is not None:

        def of_slope(saved: _Saved, a: Array, error: Array, turned_b: Array) -> Array:
            used = patterned.take(saved.cov, p.cols, 1)
            pa = apply(used.swapaxes(0, 1), a)
            moved = patterned.take(saved.delta, p.cols, 0)
            gain = patterned.take(saved.solved, p.cols, 1)
            whole = outer(saved.solved[:, size], pa) - outer(error, moved)
            whole = whole - 2.0 * product(turned_b, used) - weight[None, None] * gain
            whole = jnp.where(mask[:, None], whole, 0.0)
            return patterned.take(whole, p.rows, 0)

        slope_bar = loop(of_slope, saved, a, error, turned_b)
    return Gained(cov, delta, weight), Rows(error, slope_bar, noise, mask)


@cache
def update_with_adjoint(p: Pattern, diagonal: bool) -> Any:
    """`update` of (gained, rows) with its derivative in closed form; whether the noise is diagonal."""

    @jax.custom_vjp
    def function(gained: Gained, rows: Rows) -> tuple[Gained, Array]:
        return update(p, gained, rows)

    def forward(gained: Gained, rows: Rows) -> Any:
        after, smallest, found = take(p, gained, rows, with_inverse=True)
        solved = loop(jnp.stack, found.solved)
        return (after, smallest), _Saved(after.cov, after.delta, solved, rows.slope, rows.mask)

    def backward(saved: Any, cotangent: Any) -> Any:
        gained, rows = _update_pullback(p, diagonal, saved, cotangent[0])
        return gained, rows._replace(mask=np.zeros(rows.mask.shape, jax.dtypes.float0))

    function.defvjp(forward, backward)
    return function
