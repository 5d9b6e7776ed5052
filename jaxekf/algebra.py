"""The covariance algebra of the filter on lanes, each piece with its derivative in closed form.

Covariances are symmetric; a cotangent of one stands for its symmetric part. The derivatives of the
update are those of Parellier, Barrau and Bonnabel (2023), extended to a block of rows taken after
others, to the log-likelihood and to the slope of the measurement.
"""

import operator
from functools import cache, partial, reduce
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxekf import patterned
from jaxekf.kernels import loop
from jaxekf.lanes import written_sum
from jaxekf.patterned import Pattern

_LOG_2PI = float(np.log(2.0 * np.pi))
_PIVOTS_PER_LOG = 4


def symmetric(matrix: Array) -> Array:
    """The symmetric part, (n, n, lanes)."""
    return 0.5 * (matrix + matrix.swapaxes(0, 1))


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


def diagonal(matrix: Array) -> Array:
    """Diagonal, (n, n, lanes) to (n, lanes)."""
    return jnp.stack([matrix[i, i] for i in range(matrix.shape[0])])


def on_diagonal(values: Array) -> Array:
    """Diagonal matrices, (n, lanes) to (n, n, lanes)."""
    eye = np.eye(values.shape[0], dtype=bool)[:, :, None]
    return jnp.where(eye, values[None], jnp.zeros((), values.dtype))


# --- M P M' -------------------------------------------------------------------------------------------


def congruence(p: Pattern, block: Array | None, cov: Array) -> tuple[Array, Array]:
    """``M P M'`` and ``M P``."""
    half = loop(partial(patterned.multiply, p), block, cov)
    whole = loop(lambda b, h: patterned.multiply(p, b, h, axis=1), block, half)
    return symmetric(whole), half


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
        return _congruence_pullback(p, block, half, loop(symmetric, cotangent))

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


def forward(factored: _Factor, right: list[Array]) -> list[Array]:
    """Rows of ``inv(L) @ right``, L the unit lower factor; rows are (lanes,) or (n, lanes)."""
    solved: list[Array] = []
    for i, row in enumerate(right):

        def eliminate(row: Array, factored: _Factor, solved: list[Array], i: int = i) -> Array:
            for k, earlier in enumerate(solved):
                row = row - _scaled(factored.ratio(i, k), earlier)
            return row

        solved.append(row if i == 0 else loop(eliminate, row, factored, solved))
    return solved


def backward(factored: _Factor, right: list[Array]) -> list[Array]:
    """Rows of ``inv(S) @ right`` from what `forward` gave."""
    solved: list[Array] = []
    for i in reversed(range(len(right))):

        def substitute(row: Array, factored: _Factor, solved: list[Array], i: int = i) -> Array:
            row = _scaled(factored.inverses[i], row)
            for k, later in zip(range(i + 1, len(right)), solved, strict=True):
                row = row - _scaled(factored.ratio(k, i), later)
            return row

        solved.insert(0, loop(substitute, right[i], factored, solved))
    return solved


def _scaled(factor: Array, row: Array) -> Array:
    return factor * row if row.ndim == 1 else factor[None] * row


class _Solved(NamedTuple):
    """What an update and its derivative share; lists are over rows."""

    factored: _Factor
    projected: list[Array]
    """Rows of ``H P``, hidden ones zero, (n, lanes)."""
    gain: list[Array]
    """Columns of the gain K, (n, lanes)."""
    residual: list[Array]
    whitened: list[Array]
    """Rows of ``inv(L) e``."""


def hide(matrix: Array, mask: Array) -> Array:
    """``matrix`` with hidden rows and columns as in the identity, (m, m, lanes), (m, lanes)."""
    eye = jnp.asarray(np.eye(mask.shape[0])[:, :, None], matrix.dtype)
    return jnp.where(mask[:, None] & mask[None], matrix, eye)


def innovation_covariance(p: Pattern, slope: Array | None, noise: Array, cov: Array) -> Array:
    """``H P H' + R`` of all rows, hidden ones included."""
    projected = loop(partial(patterned.multiply, p), slope, cov)
    spread = loop(lambda s, h: patterned.multiply(p, s, h, axis=1), slope, projected)
    return spread + (on_diagonal(noise) if noise.ndim == 2 else noise)


def _projected(p: Pattern, i: int, slope: Array | None, cov: Array, mask: Array) -> Array:
    """Row i of ``H P``, zero where hidden."""
    row = patterned.row(p, slope, i, cov)
    return jnp.zeros_like(cov[0]) if row is None else jnp.where(mask[i][None], row, 0.0)


def _innovation_column(
    p: Pattern, j: int, slope: Array | None, projected: list[Array], noise: Array, mask: Array
) -> Array:
    """Rows j and later of column j of ``H P H' + R``, hidden rows as in the identity."""
    value = patterned.multiply(p, slope, projected[j])[j:]
    first = np.arange(mask.shape[0] - j)[:, None] == 0
    value = (
        value + jnp.where(first, noise[j][None], 0.0) if noise.ndim == 2 else value + noise[j:, j]
    )
    return jnp.where(mask[j:] & mask[j][None], value, first.astype(value.dtype))


def _solve(p: Pattern, gained: Gained, rows: Rows) -> _Solved:
    mask, slope = rows.mask, rows.slope
    count = range(mask.shape[0])
    projected = [loop(partial(_projected, p, i), slope, gained.cov, mask) for i in count]
    column = partial(_innovation_column, p)
    factored = factor(len(count), column, slope, projected, rows.noise, mask)
    moved = patterned.multiply(p, slope, gained.delta)
    residual = jnp.where(mask, rows.residual - moved, 0.0)
    gain = backward(factored, forward(factored, projected))
    residuals = [residual[i] for i in count]
    return _Solved(factored, projected, gain, residuals, forward(factored, residuals))


def sum_of_outer(left: list[Array], right: list[Array]) -> Array:
    """``sum_i left_i right_i'``, rows (n, lanes) to (n, n, lanes)."""
    return written_sum([outer(a, b) for a, b in zip(left, right, strict=True)])


def _take(p: Pattern, gained: Gained, rows: Rows) -> tuple[Gained, Array, _Solved]:
    """The state after a block of rows, their smallest pivot, and what the derivative needs.

    The covariance is symmetric but for rounding; its cotangent must be symmetric.

    The covariance is Joseph's ``(I - K H) P (I - K H)' + K R K'``, in the order ``half = P - K (H P)``,
    ``half + (K R - half H') K'``: a gain that is rounded then counts only to the second order.
    """
    solved = _solve(p, gained, rows)
    mask, noise, gain = rows.mask, rows.noise, solved.gain

    def half_way(cov: Array, gain: list[Array], projected: list[Array]) -> Array:
        return cov - sum_of_outer(gain, projected)

    def remainder(half: Array, slope: Array | None, gain: list[Array], i: int) -> Array:
        if noise.ndim == 2:
            spread = gain[i] * noise[i][None]
        else:
            spread = written_sum([g * noise[k, i][None] for k, g in enumerate(gain)])
        seen = patterned.row(p, slope, i, half, axis=1)
        return jnp.where(mask[i][None], spread if seen is None else spread - seen, 0.0)

    def finish(half: Array, rest: list[Array], gain: list[Array]) -> Array:
        return half + sum_of_outer(rest, gain)

    half = loop(half_way, gained.cov, gain, solved.projected)
    rest = [loop(partial(remainder, i=i), half, rows.slope, gain) for i in range(mask.shape[0])]
    cov = loop(finish, half, rest, gain)

    def move(delta: Array, gain: list[Array], residual: list[Array]) -> Array:
        return delta + written_sum([g * r[None] for g, r in zip(gain, residual, strict=True)])

    delta = loop(move, gained.delta, gain, solved.residual)
    log_likelihood = gained.log_likelihood - 0.5 * loop(_surprise, solved, mask)
    smallest = loop(lambda pivots: reduce(jnp.minimum, pivots), solved.factored.pivots)
    return Gained(cov, delta, log_likelihood), smallest, solved


def _surprise(solved: _Solved, mask: Array) -> Array:
    """``e' inv(S) e + log det (2 pi S)`` of the rows that count."""
    factored = solved.factored
    squares = [w * w * i for w, i in zip(solved.whitened, factored.inverses, strict=True)]
    # Few logarithms: pivots are multiplied first, few enough that no product over- or underflows.
    pivots = factored.pivots
    products = [
        reduce(operator.mul, pivots[i : i + _PIVOTS_PER_LOG])
        for i in range(0, len(pivots), _PIVOTS_PER_LOG)
    ]
    visible = written_sum([mask[i].astype(squares[0].dtype) for i in range(mask.shape[0])])
    return written_sum(squares) + written_sum([jnp.log(q) for q in products]) + visible * _LOG_2PI


def update(p: Pattern, gained: Gained, rows: Rows) -> tuple[Gained, Array]:
    """Take a block of rows; also the smallest pivot, positive where all went well.

    The covariance is symmetric but for rounding, and `symmetric` is left to the caller.
    """
    after, smallest, _ = _take(p, gained, rows)
    return after, smallest


def _update_pullback(
    p: Pattern, saved: tuple[Gained, Rows, _Solved], cotangent: Gained
) -> tuple[Gained, Rows]:
    """Cotangents of what went into `update` from those of what came out."""
    after, rows, solved = saved
    mask, slope, factored = rows.mask, rows.slope, solved.factored
    count = mask.shape[0]
    back, turned = p.transposed, patterned.transpose(slope)
    b = cotangent.cov
    a, weight = cotangent.delta, cotangent.log_likelihood
    gain = jnp.stack(solved.gain, axis=1)
    scaled = jnp.stack(backward(factored, solved.whitened))
    eye = np.eye(count)[:, :, None]
    unit = [jnp.broadcast_to(jnp.asarray(eye[i]), mask.shape) for i in range(count)]
    inverse = jnp.stack(backward(factored, forward(factored, unit)))
    lowered = loop(lambda gain, a: apply(gain.swapaxes(0, 1), a), gain, a)
    error = lowered - weight[None] * scaled

    def information(scaled: Array, inverse: Array, weight: Array) -> Array:
        whole = (0.5 * weight)[None, None] * (outer(scaled, scaled) - inverse)
        return jnp.where(mask[:, None] & mask[None], whole, 0.0)

    info = loop(information, scaled, inverse, weight)
    turned_b = loop(transposed_product, gain, b)  # K' B

    def of_noise(turned_b: Array, gain: Array, lowered: Array, scaled: Array, info: Array) -> Array:
        if rows.noise.ndim == 2:
            spread = written_sum([turned_b[:, k] * gain[k] for k in range(gain.shape[0])])
            return spread - lowered * scaled + diagonal(info)
        return product(turned_b, gain) - symmetric(outer(lowered, scaled)) + info

    noise = loop(of_noise, turned_b, gain, lowered, scaled, info)
    noise = jnp.where(mask if noise.ndim == 2 else mask[:, None] & mask[None], noise, 0.0)
    pulled = a - loop(partial(patterned.multiply, back), turned, lowered)  # A' a

    # With N = K' B K + M the whole is B - H' T - T' H,  T = K' B - N H / 2 - s (A' a)' / 2.
    def half(
        slope: Array | None, inner: Array, turned_b: Array, scaled: Array, pulled: Array
    ) -> Array:
        drawn = patterned.multiply(p.transposed, patterned.transpose(slope), inner, axis=1)
        return turned_b - 0.5 * (drawn + outer(scaled, pulled))

    inner = loop(lambda turned_b, gain, info: product(turned_b, gain) + info, turned_b, gain, info)
    spread = loop(half, slope, inner, turned_b, scaled, pulled)
    whole = loop(partial(patterned.multiply, back), turned, spread)
    cov = loop(lambda b, w: b - w - w.swapaxes(0, 1), b, whole)
    delta = a - loop(partial(patterned.multiply, back), turned, error)
    slope_bar = None
    if slope is not None:

        def of_slope(scaled: Array, a: Array, error: Array, turned_b: Array, gain: Array) -> Array:
            used = patterned.take(after.cov, p.cols, 1)
            pa = apply(used.swapaxes(0, 1), a)
            moved = patterned.take(after.delta, p.cols, 0)
            whole = outer(scaled, pa) - outer(error, moved) - 2.0 * product(turned_b, used)
            whole = whole - weight[None, None] * patterned.take(gain, p.cols, 0).swapaxes(0, 1)
            whole = jnp.where(mask[:, None], whole, 0.0)
            return patterned.take(whole, p.rows, 0)

        slope_bar = loop(of_slope, scaled, a, error, turned_b, gain)
    return Gained(cov, delta, weight), Rows(error, slope_bar, noise, mask)


@cache
def update_with_adjoint(p: Pattern) -> Any:
    """`update` of (gained, rows) with its derivative in closed form."""

    @jax.custom_vjp
    def function(gained: Gained, rows: Rows) -> tuple[Gained, Array]:
        return update(p, gained, rows)

    def forward(gained: Gained, rows: Rows) -> Any:
        after, smallest, solved = _take(p, gained, rows)
        return (after, smallest), (after, rows, solved)

    def backward(saved: Any, cotangent: Any) -> Any:
        gained, rows = _update_pullback(p, saved, cotangent[0])
        return gained, rows._replace(mask=np.zeros(rows.mask.shape, jax.dtypes.float0))

    function.defvjp(forward, backward)
    return function
