"""The covariance algebra of the filter on lanes, each piece with its derivative in closed form.

Covariances are symmetric but for rounding, and so are their cotangents. Rows of a measurement are taken one
after the other: each is a division, and no matrix is factored. The derivatives are those of Parellier,
Barrau and Bonnabel (2023), row by row, extended to the log-likelihood and to the slope of the measurement.
"""

import operator
from functools import cache, reduce
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxekf import linalg, patterned
from jaxekf.lanes import along, folded_sum, stage, written_sum
from jaxekf.patterned import Bands, Pattern, Row

_VARIANCES_PER_LOG = 4
_LOG_2PI = float(np.log(2.0 * np.pi))


def product(left: Array, right: Array) -> Array:
    """Matrix product written out, (i, k, lanes), (k, j, lanes) to (i, j, lanes)."""
    shape = (*left.shape[:2], *right.shape[1:])
    return folded_sum(along(left, shape, 0, 1) * along(right, shape, 1, 2), 1)


def product_transposed(left: Array, right: Array) -> Array:
    """``left @ right.T``, (i, k, lanes), (j, k, lanes) to (i, j, lanes)."""
    shape = (left.shape[0], *right.shape)
    return folded_sum(along(left, shape, 0, 2) * along(right, shape, 1, 2), 2)


def apply(matrix: Array, vector: Array) -> Array:
    """Matrix times vector, (i, k, lanes), (k, lanes) to (i, lanes)."""
    return folded_sum(matrix * along(vector, matrix.shape, 1), 1)


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
        return stage(patterned.dense(p, bands, cov.shape[-1], cov.dtype) * cov[None])
    return stage(patterned.multiply(p, bands, cov))


def _doubled(p: Pattern, bands: Bands, half: Array) -> Array:
    """``M P M'`` from ``M P``."""
    return stage(patterned.multiply(p, bands, half, axis=1))


def _congruence_pullback(
    p: Pattern, bands: Bands, half: Array, diagonal: bool, cotangent: Array
) -> tuple[Bands, Array]:
    """Cotangents of the bands, ``2 B M P``, and of P, ``M' B M`` (or the diagonal of it)."""
    back, turned = p.transposed, patterned.transpose(bands)
    first = stage(patterned.multiply(back, turned, cotangent))
    if diagonal:
        matrix = patterned.dense(p, bands, half.shape[-1], half.dtype)
        cov = folded_sum(first * matrix.swapaxes(0, 1), 1)
    else:
        cov = patterned.multiply(back, turned, first, axis=1)

    def slope(rows: tuple[int, ...], cols: tuple[int, ...]) -> Array:
        above = patterned.take(cotangent, rows, 0)
        return stage(2.0 * product(above, patterned.take(half, cols, 1)))

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
    """A row that was taken, for whoever goes back through it; (1, lanes) but for the gain."""

    gain: Array
    """(n, lanes)."""
    inverse: Array
    """One over the innovation's variance."""
    scaled: Array
    """The innovation times that; 0 where the row does not count."""


def innovation_covariance(p: Pattern, bands: Bands, noise: Array, cov: Array) -> Array:
    """``H P H' + R`` of all rows, hidden ones included."""
    projected = stage(patterned.multiply(p, bands, cov))
    spread = stage(patterned.multiply(p, bands, projected, axis=1))
    return spread + (on_diagonal(noise) if noise.ndim == 2 else noise)


def whitened(p: Pattern, rows: Rows) -> tuple[Pattern, Rows, Array | None]:
    """The same rows with unit variances where their noise was not diagonal: multiplied by the inverse of
    the Cholesky factor of the visible rows' noise. Its log-determinant, (lanes,), is to be added to the
    log-likelihood; None where nothing was multiplied."""
    if rows.noise.ndim == 2:
        return p, rows, None
    white = stage(linalg.whitener(linalg.mask_covariance(rows.noise, rows.mask)))
    lanes, dtype = rows.mask.shape[-1], rows.noise.dtype
    full = patterned.whole(p)
    matrix = patterned.cut(patterned.dense(p, rows.slope, lanes, dtype), full)
    slope = tuple(stage(linalg.whiten(white, band)) for band in matrix)
    residual = stage(linalg.whiten(white, rows.residual))
    determinant = written_sum([jnp.log(inverse) for inverse in white[1]])
    return full, Rows(residual, slope, jnp.ones_like(residual), rows.mask), determinant


def pattern_taken(p: Pattern, rows: Rows) -> Pattern:
    """The pattern of the rows that `whitened` makes of these, whose own is `p`."""
    return p if rows.noise.ndim == rows.mask.ndim else patterned.whole(p)


def take(p: Pattern, gained: Gained, rows: Rows) -> tuple[Gained, Array, list[Taken]]:
    """The state after rows of diagonal noise, the smallest variance of an innovation, and each row taken.

    A row h of variance r with ``S = h' P h + r`` and gain ``k = P h / S`` makes Joseph's
    ``(I - k h') P (I - k h')' + k r k'``, in the order ``P - k (P h)' + (k r - (P - k (P h)') h) k'``: a
    gain that is rounded then counts only to the second order. The covariance stays symmetric but for
    rounding.
    """
    cov, delta, log_likelihood = gained
    taken, variances, squares = [], [], []
    for i in range(rows.mask.shape[0]):
        row, seen = Row(p, rows.slope, i), rows.mask[i : i + 1]
        noise, residual = rows.noise[i : i + 1], rows.residual[i : i + 1]
        ph = stage(jnp.where(seen, row.times(cov), 0.0))
        variance = stage(jnp.where(seen, row.dot(ph) + noise, 1.0))
        inverse = stage(1.0 / variance)
        residual = jnp.where(seen, residual - row.dot(delta), 0.0)
        scaled = stage(residual * inverse)
        gain = stage(ph * inverse)
        half = cov - outer(gain, ph)
        rest = stage(jnp.where(seen, gain * noise - row.times(half), 0.0))
        cov = stage(half + outer(rest, gain))
        delta = stage(delta + ph * scaled)
        taken.append(Taken(gain, inverse, scaled))
        variances.append(variance)
        squares.append(residual * scaled)
    # Few logarithms: variances are multiplied first, few enough that no product over- or underflows.
    products = [
        reduce(operator.mul, variances[i : i + _VARIANCES_PER_LOG])
        for i in range(0, len(variances), _VARIANCES_PER_LOG)
    ]
    visible = folded_sum(rows.mask.astype(cov.dtype), 0, keep=True)
    surprise = written_sum([*squares, *map(jnp.log, products), visible * _LOG_2PI])
    log_likelihood = stage(log_likelihood - 0.5 * surprise[0])
    return Gained(cov, delta, log_likelihood), reduce(jnp.minimum, variances)[0], taken


def update(p: Pattern, gained: Gained, rows: Rows) -> tuple[Gained, Array]:
    """The state after rows of diagonal noise, and the smallest variance of an innovation."""
    after, smallest, _ = take(p, gained, rows)
    return after, smallest


def back_through(
    row: Array, seen: Array, gain: Array, matrix: Array, inner: Array, side: Array | None
) -> tuple[Array, Array]:
    """``A' B A + c h h' + (h t' + t h') / 2`` with ``A = I - k h'``, and ``B k``.

    For the whole row h, a matrix B, ``c = inner``, (1, lanes), and a vector ``t = side``; None for 0.
    """
    image = stage(apply(matrix, gain))
    arm = 0.5 * (dot(gain, image) + inner) * row - image
    if side is not None:
        arm = arm + 0.5 * side
    arm = stage(jnp.where(seen, arm, 0.0))
    return stage(matrix + outer(row, arm) + outer(arm, row)), image


class _Saved(NamedTuple):
    """What the derivative of an update needs of it."""

    cov: Array
    """P after it."""
    delta: Array
    """After it."""
    taken: list[Taken]
    rows: Rows


def _update_pullback(p: Pattern, saved: _Saved, cotangent: Gained) -> tuple[Gained, Rows]:
    """Cotangents of what went into `update` from those of what came out.

    Row by row, the last first, with ``a``, B and w the cotangents of delta, P and log-likelihood after the
    row: ``c = k' a - w s`` is the residual's, ``k' B k - s k' a + w (s^2 - 1 / S) / 2`` the noise's and
    ``s P a - c delta - 2 P B k - w k`` the slope's.
    """
    b, a, weight = cotangent.cov, cotangent.delta, cotangent.log_likelihood[None]
    delta, cov, rows = saved.delta, saved.cov, saved.rows
    residuals: list[Array] = []
    noises: list[Array] = []
    slopes: list[list[Array]] = []
    for i in reversed(range(rows.mask.shape[0])):
        row, seen, (gain, inverse, scaled) = (
            Row(p, rows.slope, i),
            rows.mask[i : i + 1],
            saved.taken[i],
        )
        whole = stage(row.dense(gain))
        drawn = stage(dot(gain, a))
        error = stage(jnp.where(seen, drawn - weight * scaled, 0.0))
        spread = stage(0.5 * weight * (scaled * scaled - inverse))
        side = scaled * (a - whole * drawn)
        before, image = back_through(whole, seen, gain, b, spread, side)
        noises.append(jnp.where(seen, dot(gain, image) - scaled * drawn + spread, 0.0))
        residuals.append(error)
        slopes.append([])
        ph = gain / inverse
        for cols in row.unknown:
            pulled = stage(scaled * a - 2.0 * image)
            found = apply(patterned.take(cov, cols, 0), pulled)
            found = found - error * patterned.take(delta, cols, 0)
            found = found - weight * patterned.take(gain, cols, 0)
            slopes[-1].append(jnp.where(seen, found, 0.0))
        if p.bands and i:
            cov = stage(cov + outer(gain, ph))
            delta = stage(delta - ph * scaled)
        a = stage(a - whole * error)
        b = before
    slopes.reverse()
    places = [[rows for rows, _ in p.bands if i in rows] for i in range(len(slopes))]
    bands = tuple(
        stage(jnp.stack([slopes[r][places[r].index(band_rows)] for r in band_rows]))
        for band_rows, _ in p.bands
    )
    noise, residual = (stage(jnp.concatenate(v[::-1])) for v in (noises, residuals))
    return Gained(b, a, cotangent.log_likelihood), Rows(residual, bands, noise, rows.mask)


@cache
def update_with_adjoint(p: Pattern) -> Any:
    """`update` of (gained, rows) with its derivative in closed form."""

    @jax.custom_vjp
    def function(gained: Gained, rows: Rows) -> tuple[Gained, Array]:
        return update(p, gained, rows)

    def forward(gained: Gained, rows: Rows) -> Any:
        after, smallest, taken = take(p, gained, rows)
        return (after, smallest), _Saved(after.cov, after.delta, taken, rows)

    def backward(saved: Any, cotangent: Any) -> Any:
        gained, rows = _update_pullback(p, saved, cotangent[0])
        return gained, rows._replace(mask=np.zeros(rows.mask.shape, jax.dtypes.float0))

    function.defvjp(forward, backward)
    return function
