"""The covariance algebra of the filter on lanes, each piece with its derivative in closed form.

Covariances are symmetric but for rounding, and so are their cotangents. Rows of a measurement are taken a
few at a time. The derivatives are those of Parellier, Barrau and Bonnabel (2023), block by block, extended
to the log-likelihood and to the slope of the measurement.
"""

import itertools
import operator
from functools import cache, reduce
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxekf.filtering.lowering import structured_matrix
from jaxekf.filtering.lowering.lanes import along, folded_sum, stage, written_sum
from jaxekf.filtering.lowering.structured_matrix import Bands, Pattern
from jaxekf.geometry import linalg

_ROWS_TOGETHER = 3
"""Rows of a measurement taken at once: a third of the loops of one by one, and their inverse is still
written out."""
_LOG_2PI = float(np.log(2.0 * np.pi))


def product(left: Array, right: Array) -> Array:
    """Matrix product written out, (i, k, lanes), (k, j, lanes) to (i, j, lanes)."""
    shape = (*left.shape[:2], *right.shape[1:])
    return folded_sum(along(left, shape, 0, 1) * along(right, shape, 1, 2), 1)


def product_transposed(left: Array, right: Array) -> Array:
    """``left @ right.T``, (i, k, lanes), (j, k, lanes) to (i, j, lanes)."""
    shape = (left.shape[0], *right.shape)
    return folded_sum(along(left, shape, 0, 2) * along(right, shape, 1, 2), 2)


def transposed_product(left: Array, right: Array) -> Array:
    """``left.T @ right``, (k, i, lanes), (k, j, lanes) to (i, j, lanes)."""
    shape = (*left.shape[:2], *right.shape[1:])
    return folded_sum(along(left, shape, 0, 1) * along(right, shape, 0, 2), 0)


def apply(matrix: Array, vector: Array) -> Array:
    """Matrix times vector, (i, k, lanes), (k, lanes) to (i, lanes)."""
    return folded_sum(matrix * along(vector, matrix.shape, 1), 1)


def transposed_apply(matrix: Array, vector: Array) -> Array:
    """Transposed matrix times vector, (k, i, lanes), (k, lanes) to (i, lanes)."""
    return folded_sum(matrix * along(vector, matrix.shape, 0), 0)


def dot(left: Array, right: Array) -> Array:
    """Scalar product, (n, lanes), (n, lanes) to (1, lanes)."""
    return folded_sum(left * right, 0, keep=True)


def outer(left: Array, right: Array) -> Array:
    """Outer product, (i, lanes), (j, lanes) to (i, j, lanes)."""
    shape = (left.shape[0], *right.shape)
    return along(left, shape, 0) * along(right, shape, 1)


def on_diagonal(values: Array) -> Array:
    """Diagonal matrices, (n, lanes) to (n, n, lanes)."""
    here = np.eye(values.shape[0], dtype=bool)[:, :, None]
    return jnp.where(here, values[:, None], 0.0)


# --- M P M' and the prediction ------------------------------------------------------------------------


def congruence(p: Pattern, bands: Bands, cov: Array) -> Array:
    """``M P M'``, symmetric but for rounding; of variances (n, lanes) instead of P, a diagonal one."""
    return _doubled(p, bands, _half(p, bands, cov))


def _half(p: Pattern, bands: Bands, cov: Array) -> Array:
    """``M P``."""
    if cov.ndim == 2:
        return stage(structured_matrix.dense(p, bands, cov.shape[-1], cov.dtype) * cov[None])
    return stage(structured_matrix.multiply(p, bands, cov))


def _doubled(p: Pattern, bands: Bands, half: Array) -> Array:
    """``M P M'`` from ``M P``."""
    return stage(structured_matrix.multiply(p, bands, half, axis=1))


def _congruence_pullback(
    p: Pattern, bands: Bands, half: Array, diagonal: bool, cotangent: Array
) -> tuple[Bands, Array]:
    """Cotangents of the bands, ``2 B M P``, and of P, ``M' B M`` (or the diagonal of it)."""
    back, turned = p.transposed, structured_matrix.transpose(bands)
    first = stage(structured_matrix.multiply(back, turned, cotangent))
    if diagonal:
        matrix = structured_matrix.dense(p, bands, half.shape[-1], half.dtype)
        cov = folded_sum(first * matrix.swapaxes(0, 1), 1)
    else:
        cov = structured_matrix.multiply(back, turned, first, axis=1)

    def slope(rows: tuple[int, ...], cols: tuple[int, ...]) -> Array:
        above = structured_matrix.take(cotangent, rows, 0)
        parts = [
            stage(2.0 * product(above, part)) for part in structured_matrix.parts(half, cols, 1)
        ]
        return parts[0] if len(parts) == 1 else stage(jnp.concatenate(parts, 1))

    return tuple(slope(*band) for band in p.bands), stage(cov)


@cache
def congruence_with_adjoint(p: Pattern) -> Any:
    """`congruence` of (bands, P) with its derivative."""

    @jax.custom_vjp
    def function(bands: Bands, cov: Array) -> Array:
        return congruence(p, bands, cov)

    def forward(bands: Bands, cov: Array) -> Any:
        half = _half(p, bands, cov)
        return _doubled(p, bands, half), (bands, half)

    def backward(saved: Any, cotangent: Array) -> Any:
        bands, half = saved
        return _congruence_pullback(p, bands, half, False, cotangent)

    function.defvjp(forward, backward)
    return function


def predicted(
    state: Pattern, noise: Pattern, f: Bands, g: Bands, cov: Array, sigma: Array
) -> Array:
    """``F P F' + G Sigma G'``, symmetric; `sigma` is a covariance, or variances (n_w, lanes)."""
    return _predicted(state, noise, f, g, cov, sigma)[0]


def _predicted(
    state: Pattern, noise: Pattern, f: Bands, g: Bands, cov: Array, sigma: Array
) -> tuple[Array, tuple[Array, Array | None]]:
    """The prediction, and ``F P`` and ``G Sigma`` (None where G is the identity)."""
    half, spread = _half(state, f, cov), None
    total = _doubled(state, f, half)
    if not noise.is_identity:
        spread = _half(noise, g, sigma)
        total = total + _doubled(noise, g, spread)
    elif sigma.ndim == 2:
        total = total + on_diagonal(sigma)
    else:
        total = total + sigma
    return stage(linalg.symmetrise(stage(total))), (half, spread)


@cache
def predicted_with_adjoint(state: Pattern, noise: Pattern) -> Any:
    """`predicted` of (f, g, cov, sigma) with its derivative."""

    @jax.custom_vjp
    def function(f: Bands, g: Bands, cov: Array, sigma: Array) -> Array:
        return predicted(state, noise, f, g, cov, sigma)

    def forward(f: Bands, g: Bands, cov: Array, sigma: Array) -> Any:
        found, halves = _predicted(state, noise, f, g, cov, sigma)
        return found, (f, g, sigma, halves)

    def backward(saved: Any, cotangent: Array) -> Any:
        f, g, sigma, (half, spread) = saved
        diagonal = sigma.ndim == 2
        f_bar, cov = _congruence_pullback(state, f, half, False, cotangent)
        if spread is None:
            return f_bar, g, cov, linalg.diagonal(cotangent) if diagonal else cotangent
        g_bar, sigma_bar = _congruence_pullback(noise, g, spread, diagonal, cotangent)
        return f_bar, g_bar, cov, sigma_bar

    function.defvjp(forward, backward)
    return function


# --- update -------------------------------------------------------------------------------------------


class Rows(NamedTuple):
    """Rows taken together: residual (m, lanes), unknown bands of the slope H, noise R, and which count.

    The noise is a covariance (m, m, lanes), or variances (m, lanes) where it is known to be diagonal. Where
    a row does not count its residual, slope and noise are finite.
    """

    residual: Array
    slope: Bands
    noise: Array
    mask: Array


class Gained(NamedTuple):
    """State of an update while rows are taken."""

    cov: Array
    delta: Array
    log_likelihood: Array


class Taken(NamedTuple):
    """A block of rows that was taken, for whoever goes back through it; 0 where a row does not count."""

    gain: Array
    """``S^-1 H P``, (m, n, lanes)."""
    inverse: Array
    """Inverse of the innovation's covariance S, (m, m, lanes)."""
    scaled: Array
    """``S^-1`` times the innovation, (m, lanes)."""


class Block(NamedTuple):
    """Rows H that are taken together."""

    start: int
    stop: int
    pattern: Pattern
    bands: Bands
    seen: Array
    """(m, lanes) rows that count."""

    def times(self, x: Array, axis: int = 0) -> Array:
        """``H x``; with ``axis=1`` ``x H'``."""
        return structured_matrix.multiply(self.pattern, self.bands, x, axis)

    def back(self, x: Array, axis: int = 0) -> Array:
        """``H' x``; with ``axis=1`` ``x H``."""
        turned = structured_matrix.transpose(self.bands)
        return structured_matrix.multiply(self.pattern.transposed, turned, x, axis)

    def shown(self, x: Array) -> Array:
        """`x`, (m, ..., lanes), with 0 in rows that do not count."""
        seen = self.seen if x.ndim == 2 else self.seen[:, None]
        return jnp.where(seen, x, 0.0)


def blocks(p: Pattern, rows: Rows) -> list[Block]:
    """The rows in blocks of much the same size."""
    size = rows.mask.shape[0]
    count = -(-size // _ROWS_TOGETHER)
    found = []
    for start, stop in itertools.pairwise(size * k // count for k in range(count + 1)):
        part = structured_matrix.rows_of(p, rows.slope, start, stop)
        found.append(Block(start, stop, *part, rows.mask[start:stop]))
    return found


def innovation_covariance(p: Pattern, bands: Bands, noise: Array, cov: Array) -> Array:
    """``H P H' + R`` of all rows, hidden ones included."""
    projected = stage(structured_matrix.multiply(p, bands, cov))
    spread = stage(structured_matrix.multiply(p, bands, projected, axis=1))
    return spread + (on_diagonal(noise) if noise.ndim == 2 else noise)


def whitened(p: Pattern, rows: Rows) -> tuple[Pattern, Rows, Array | None]:
    """The same rows with unit variances where their noise was not diagonal: multiplied by the inverse of
    the Cholesky factor of the visible rows' noise. Its log-determinant, (lanes,), is to be added to the
    log-likelihood; None where nothing was multiplied."""
    if rows.noise.ndim == 2:
        return p, rows, None
    white = stage(linalg.whitener(linalg.mask_covariance(rows.noise, rows.mask)))
    lanes, dtype = rows.mask.shape[-1], rows.noise.dtype
    full = structured_matrix.whole(p)
    matrix = structured_matrix.cut(structured_matrix.dense(p, rows.slope, lanes, dtype), full)
    slope = tuple(stage(linalg.whiten(white, band)) for band in matrix)
    residual = stage(linalg.whiten(white, rows.residual))
    determinant = written_sum([jnp.log(inverse) for inverse in white[1]])
    return full, Rows(residual, slope, jnp.ones_like(residual), rows.mask), determinant


def pattern_taken(p: Pattern, rows: Rows) -> Pattern:
    """The pattern of the rows that `whitened` makes of these, whose own is `p`."""
    return p if rows.noise.ndim == rows.mask.ndim else structured_matrix.whole(p)


def _inverse(matrix: Array) -> tuple[Array, list[Array]]:
    """Inverse (m, m, lanes) of a small positive definite matrix, of which the lower half is read, and the
    pivots of its factors ``L D L'``, (1, lanes) each: not positive where it is not definite."""
    size, lanes = matrix.shape[1:]
    pivots: list[Array] = []
    inverses: list[Array] = []
    factor: list[list[Array]] = []
    units: list[Array] = []
    """Rows of the inverse of L."""
    for i in range(size):
        scaled: list[Array] = []
        for j in range(i):
            known = [c * s for c, s in zip(factor[j], scaled, strict=True)]
            scaled.append(written_sum([matrix[i, j : j + 1], *(-k for k in known)]))
        row = [s * inverse for s, inverse in zip(scaled, inverses, strict=True)]
        gone = [-(c * s) for c, s in zip(row, scaled, strict=True)]
        pivots.append(written_sum([matrix[i, i : i + 1], *gone]))
        inverses.append(stage(1.0 / pivots[i]))
        unit = jnp.broadcast_to(np.eye(size)[i][:, None], (size, lanes))
        if i:
            unit = stage(unit - written_sum([c * u for c, u in zip(row, units, strict=True)]))
        factor.append(row)
        units.append(unit)
    return written_sum([outer(u, u * v) for u, v in zip(units, inverses, strict=True)]), pivots


def take(p: Pattern, gained: Gained, rows: Rows) -> tuple[Gained, Array, list[Taken], list[Array]]:
    """The state after rows of diagonal noise, the smallest pivot of the innovations' covariances, the
    blocks of rows taken, and ``H P`` of each.

    Rows H with noise R make ``S = H P H' + R``, the gain ``K = P H' S^-1`` and Joseph's
    ``(I - K H) P (I - K H)' + K R K'``, in the order ``P - K H P + (K R - (P - K H P) H') K'``: a gain that
    is rounded then counts only to the second order. The covariance stays symmetric but for rounding.
    """
    cov, delta, log_likelihood = gained
    taken, crosses, smallest, terms = [], [], [], []
    for block in blocks(p, rows):
        seen, noise = block.seen, rows.noise[block.start : block.stop]
        cross = stage(block.shown(block.times(cov)))
        spread = block.times(cross, 1) + on_diagonal(noise)
        found, pivots = _inverse(stage(linalg.mask_covariance(spread, seen)))
        inverse = stage(jnp.where(seen[:, None] & seen[None], found, 0.0))
        gain = stage(product(inverse, cross))
        residual = rows.residual[block.start : block.stop] - block.times(delta)
        residual = stage(block.shown(residual))
        scaled = stage(apply(inverse, residual))
        half = stage(cov - transposed_product(gain, cross))
        rest = stage(block.shown(gain * along(noise, gain.shape, 0) - block.times(half)))
        cov = stage(half + transposed_product(rest, gain))
        delta = stage(delta + transposed_apply(cross, scaled))
        taken.append(Taken(gain, inverse, scaled))
        crosses.append(cross)
        smallest.append(reduce(jnp.minimum, pivots))
        # One logarithm: the product of so few variances neither over- nor underflows.
        terms += [dot(residual, scaled), jnp.log(reduce(operator.mul, pivots))]
    visible = folded_sum(rows.mask.astype(cov.dtype), 0, keep=True)
    surprise = written_sum([*terms, visible * _LOG_2PI])
    log_likelihood = stage(log_likelihood - 0.5 * surprise[0])
    after = Gained(cov, delta, log_likelihood)
    return after, reduce(jnp.minimum, smallest)[0], taken, crosses


def update(p: Pattern, gained: Gained, rows: Rows) -> tuple[Gained, Array]:
    """The state after rows of diagonal noise, and the smallest pivot of the innovations' covariances."""
    return take(p, gained, rows)[:2]


def back_through(
    block: Block, gain: Array, matrix: Array, inner: Array, side: Array | None
) -> tuple[Array, Array]:
    """``A' B A + H' N H + (H' t + t' H) / 2`` with ``A = I - K H``, and ``K' B``.

    For the block of rows H, symmetric matrices B and ``N = inner``, (m, m, lanes), and ``t = side``,
    (m, n, lanes); None for 0.
    """
    image = stage(product(gain, matrix))
    weight = stage(0.5 * (product_transposed(image, gain) + inner))
    arm = block.back(weight, 1) - image
    if side is not None:
        arm = arm + 0.5 * side
    arms = stage(block.back(stage(block.shown(arm))))
    return stage(matrix + (arms + arms.swapaxes(0, 1))), image


class _Saved(NamedTuple):
    """What the derivative of an update needs of it."""

    cov: Array
    """P after it."""
    delta: Array
    """After it."""
    taken: list[Taken]
    crosses: list[Array]
    """``H P`` of all blocks but the first, to find P before them; none where H is known."""
    rows: Rows


def _update_pullback(p: Pattern, saved: _Saved, cotangent: Gained) -> tuple[Gained, Rows]:
    """Cotangents of what went into `update` from those of what came out.

    Block by block, the last first, with ``a``, B and w the cotangents of delta, P and log-likelihood after
    the block, ``d = K' a`` and ``N = w (s s' - S^-1) / 2``: ``c = d - w s`` is the residual's, the diagonal
    of ``K' B K - s d' + N`` the noise's and ``(s a' - 2 K' B) P - c delta' - w K'`` the slope's.
    """
    b, a, weight = cotangent.cov, cotangent.delta, cotangent.log_likelihood[None]
    delta, cov, rows = saved.delta, saved.cov, saved.rows
    residuals: list[Array] = []
    noises: list[Array] = []
    slopes: list[Array] = []
    for block in reversed(blocks(p, rows)):
        index = len(saved.taken) - 1 - len(residuals)
        gain, inverse, scaled = saved.taken[index]
        drawn = stage(apply(gain, a))
        error = stage(block.shown(drawn - weight * scaled))
        spread = stage(0.5 * weight[None] * (outer(scaled, scaled) - inverse))
        side = outer(scaled, stage(a - block.back(drawn)))
        before, image = back_through(block, gain, b, spread, side)
        noise = folded_sum(gain * image, 1) - scaled * drawn + linalg.diagonal(spread)
        noises.append(block.shown(noise))
        residuals.append(error)
        if p.bands:
            pulled = stage(outer(scaled, a) - 2.0 * image)
            whole = product(pulled, cov) - outer(error, delta) - weight[None] * gain
            slopes.append(stage(block.shown(whole)))
        if p.bands and index:
            cross = saved.crosses[index - 1]
            cov = stage(cov + transposed_product(gain, cross))
            delta = stage(delta - transposed_apply(cross, scaled))
        a = stage(a - block.back(error))
        b = before
    bands = structured_matrix.cut(jnp.concatenate(slopes[::-1]), p) if slopes else ()
    noise, residual = (jnp.concatenate(v[::-1]) for v in (noises, residuals))
    bands, noise, residual = stage((bands, noise, residual))
    return Gained(b, a, cotangent.log_likelihood), Rows(residual, bands, noise, rows.mask)


@cache
def update_with_adjoint(p: Pattern) -> Any:
    """`update` of (gained, rows) with its derivative in closed form."""

    @jax.custom_vjp
    def function(gained: Gained, rows: Rows) -> tuple[Gained, Array]:
        return update(p, gained, rows)

    def forward(gained: Gained, rows: Rows) -> Any:
        after, smallest, taken, crosses = take(p, gained, rows)
        later = crosses[1:] if p.bands else []
        return (after, smallest), _Saved(after.cov, after.delta, taken, later, rows)

    def backward(saved: Any, cotangent: Any) -> Any:
        gained, rows = _update_pullback(p, saved, cotangent[0])
        return gained, rows._replace(mask=np.zeros(rows.mask.shape, jax.dtypes.float0))

    function.defvjp(forward, backward)
    return function
