"""The covariance algebra of the filter on lanes, each piece with its derivative in closed form.

Covariances are symmetric; a cotangent of one stands for its symmetric part. The derivatives of the
update are those of Parellier, Barrau and Bonnabel (2023), extended to a block of rows taken after
others, to the log-likelihood and to the slope of the measurement.
"""

from functools import lru_cache, partial
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


@lru_cache(maxsize=None)
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


class _Solved(NamedTuple):
    """What an update and its derivative share."""

    inverse: Array
    """Inverse of S, hidden rows as in the identity."""
    pivots: Array
    projected: Array
    """``H P``, hidden rows zero."""
    scaled: Array
    """``inv(S) e``."""
    gain: Array
    residual: Array
    noise: Array


def hide(matrix: Array, mask: Array) -> Array:
    """``matrix`` with hidden rows and columns as in the identity, (m, m, lanes), (m, lanes)."""
    eye = jnp.asarray(np.eye(mask.shape[0])[:, :, None], matrix.dtype)
    return jnp.where(mask[:, None] & mask[None], matrix, eye)


def innovation_covariance(p: Pattern, slope: Array | None, noise: Array, cov: Array) -> Any:
    """``H P`` and ``H P H' + R`` of all rows, hidden ones included."""
    projected = loop(partial(patterned.multiply, p), slope, cov)

    spread = loop(lambda s, h: patterned.multiply(p, s, h, axis=1), slope, projected)
    return projected, symmetric(spread) + (on_diagonal(noise) if noise.ndim == 2 else noise)


def invert(matrix: Array) -> tuple[Array, Array]:
    """Inverse and pivots of small positive definite matrices (m, m, lanes), by sweeping each row.

    The pivots are those of Cholesky's factor, squared: their logarithms add up to that of the
    determinant, and one that is not positive says that the matrix was not definite.
    """
    size = matrix.shape[0]
    index = np.arange(size)
    pivots = []

    def sweep(k: int, matrix: Array, pivot: Array) -> Array:
        inverse = 1.0 / pivot
        column = matrix[:, k]
        scaled = column * inverse[None]
        rest = matrix - outer(scaled, column)
        row, col = (index == k)[:, None, None], (index == k)[None, :, None]
        crossed = jnp.where(col, scaled[:, None], rest)
        crossed = jnp.where(row, scaled[None], crossed)
        return jnp.where(row & col, -inverse[None, None], crossed)

    for k in range(size):
        pivots.append(matrix[k, k])
        matrix = loop(partial(sweep, k), matrix, pivots[k])
    return -matrix, jnp.stack(pivots)


def _solve(p: Pattern, gained: Gained, rows: Rows) -> _Solved:
    mask = rows.mask
    projected, cov = innovation_covariance(p, rows.slope, rows.noise, gained.cov)
    projected = jnp.where(mask[:, None], projected, 0.0)
    inverse, pivots = invert(loop(hide, cov, mask))
    moved = patterned.multiply(p, rows.slope, gained.delta)
    residual = jnp.where(mask, rows.residual - moved, 0.0)
    scaled = loop(apply, inverse, residual)
    gain = loop(transposed_product, projected, inverse)
    if rows.noise.ndim == 2:
        noise = jnp.where(mask, rows.noise, 1.0)
    else:
        noise = hide(rows.noise, mask)
    return _Solved(inverse, pivots, projected, scaled, gain, residual, noise)


def _take(p: Pattern, gained: Gained, rows: Rows) -> tuple[Gained, Array, _Solved]:
    """The state after a block of rows, their smallest pivot, and what the derivative needs.

    The covariance is Joseph's ``(I - K H) P (I - K H)' + K R K'``, in the order ``half = P - K (H P)``,
    ``half + (K R - half H') K'``: a gain that is rounded then counts only to the second order.
    """
    solved = _solve(p, gained, rows)
    mask, noise = rows.mask, solved.noise

    def half_way(cov: Array, gain: Array, projected: Array) -> Array:
        return cov - product(gain, projected)

    def remainder(half: Array, slope: Array | None, gain: Array, noise: Array) -> Array:
        spread = gain * noise[None] if noise.ndim == 2 else product(gain, noise)
        missing = spread - patterned.multiply(p, slope, half, axis=1)
        return jnp.where(mask[None], missing, 0.0)

    def finish(half: Array, rest: Array, gain: Array) -> Array:
        return half + product_transposed(rest, gain)

    half = loop(half_way, gained.cov, solved.gain, solved.projected)
    rest = loop(remainder, half, rows.slope, solved.gain, noise)
    cov = loop(symmetric, loop(finish, half, rest, solved.gain))
    delta = gained.delta + loop(apply, solved.gain, solved.residual)
    pivots = [solved.pivots[i] for i in range(mask.shape[0])]
    log_likelihood = gained.log_likelihood - 0.5 * _surprise(solved, mask)
    smallest = pivots[0]
    for pivot in pivots[1:]:
        smallest = jnp.minimum(smallest, pivot)
    return Gained(cov, delta, log_likelihood), smallest, solved


def _surprise(solved: _Solved, mask: Array) -> Array:
    """``e' inv(S) e + log det (2 pi S)`` of the rows that count."""
    terms = solved.residual * solved.scaled
    terms = terms + jnp.where(mask, jnp.log(solved.pivots) + _LOG_2PI, 0.0)
    return written_sum([terms[i] for i in range(terms.shape[0])])


def update(p: Pattern, gained: Gained, rows: Rows) -> tuple[Gained, Array]:
    """Take a block of rows; also the smallest pivot, positive where all went well."""
    after, smallest, _ = _take(p, gained, rows)
    return after, smallest


def _update_pullback(
    p: Pattern, saved: tuple[Gained, Rows, _Solved], cotangent: Gained
) -> tuple[Gained, Rows]:
    """Cotangents of what went into `update` from those of what came out; DESIGN's section 6e."""
    after, rows, solved = saved
    mask, slope = rows.mask, rows.slope
    back, turned = p.transposed, patterned.transpose(slope)
    b = loop(symmetric, cotangent.cov)
    a, weight = cotangent.delta, cotangent.log_likelihood
    gain, scaled = solved.gain, solved.scaled
    lowered = loop(lambda gain, a: apply(gain.swapaxes(0, 1), a), gain, a)
    error = lowered - weight[None] * scaled

    def information(scaled: Array, inverse: Array, weight: Array) -> Array:
        whole = (0.5 * weight)[None, None] * (outer(scaled, scaled) - inverse)
        return jnp.where(mask[:, None] & mask[None], whole, 0.0)

    info = loop(information, scaled, solved.inverse, weight)
    turned_b = loop(transposed_product, gain, b)  # K' B

    def of_noise(turned_b: Array, gain: Array, lowered: Array, scaled: Array, info: Array) -> Array:
        if rows.noise.ndim == 2:
            spread = written_sum([turned_b[:, k] * gain[k] for k in range(gain.shape[0])])
            return spread - lowered * scaled + diagonal(info)
        return product(turned_b, gain) - symmetric(outer(lowered, scaled)) + info

    noise = loop(of_noise, turned_b, gain, lowered, scaled, info)
    noise = jnp.where(mask if noise.ndim == 2 else mask[:, None] & mask[None], noise, 0.0)
    # A = I - K H;  A' B A = B - H' (K' B) - (B K) H + H' (K' B K) H, taken as two rank-m steps.
    hb = loop(partial(patterned.multiply, back), turned, turned_b)  # H' K' B
    first = loop(lambda b, hb: b - hb, b, hb)  # A' B
    gathered = loop(product, first, gain)  # A' B K
    drawn = patterned.multiply(back, turned, scaled)  # H' s
    pulled = a - patterned.multiply(back, turned, lowered)  # A' a

    def of_cov(first: Array, gathered: Array, slope: Any, info: Array, pulled: Array, drawn: Array) -> Array:
        turned = patterned.transpose(slope)
        spread = patterned.multiply(back, turned, info)  # H' M
        both = patterned.multiply(back, turned, spread - gathered, axis=1)
        return symmetric(first + both + outer(pulled, drawn))

    cov = loop(of_cov, first, gathered, slope, info, pulled, drawn)
    delta = a - patterned.multiply(back, turned, error)
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


@lru_cache(maxsize=None)
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
