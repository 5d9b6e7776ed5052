"""The update by rows of a measurement on the batch axis, with its closed-form derivative.

Section 3 of docs/mathematics.md. The rows of a sensor are applied a few at a time, in Joseph's form; the
derivative goes back through them, after Parellier, Barrau and Bonnabel (2023), extended to the
log-likelihood and to the Jacobian H. Covariances are symmetric but for rounding, and so are their
cotangents. `jaxekf.filtering._step` and `_smoother_pass` call this file.
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
from jaxekf.filtering.lowering.batched_products import (
    diagonal_matrix,
    dot,
    multiply,
    multiply_transposed,
    multiply_vector,
    outer,
    transposed_multiply,
    transposed_multiply_vector,
)
from jaxekf.filtering.lowering.lanes import (
    broadcast_axes,
    materialise,
    pairwise_sum,
    unrolled_sum,
)
from jaxekf.filtering.lowering.structured_matrix import Bands, Pattern
from jaxekf.geometry import linalg

_BLOCK_ROWS = 3
"""Rows applied at once: a third of the loops of one by one, and the inverse of their innovation covariance
is still written out entry by entry."""
_LOG_2PI = float(np.log(2.0 * np.pi))


class MeasurementRows(NamedTuple):
    """Linearised rows of one sensor; hidden rows have finite numbers."""

    residual: Array
    """(m, lanes)."""
    jacobian: Bands
    """The unknown bands of H."""
    noise: Array
    """R: a covariance (m, m, lanes), or variances (m, lanes) if it is diagonal."""
    mask: Array
    """(m, lanes) True where a row enters the update."""


class UpdateAccumulator(NamedTuple):
    """The state of an update while rows are applied."""

    cov: Array
    """P, (n, n, lanes)."""
    delta: Array
    """(n, lanes) error vector by which the rows so far move the mean."""
    log_likelihood: Array
    """(lanes,)."""


class AppliedBlock(NamedTuple):
    """The factors of a block of rows that its derivative and the smoother need; 0 in hidden rows."""

    gain: Array
    """Transposed gain ``K' = S^-1 H P``, (m, n, lanes)."""
    inverse: Array
    """Inverse of the innovation covariance S, (m, m, lanes)."""
    weighted_innovation: Array
    """``S^-1`` times the innovation, (m, lanes)."""


class RowBlock(NamedTuple):
    """Rows H that are applied together."""

    start: int
    stop: int
    pattern: Pattern
    bands: Bands
    visible: Array
    """(m, lanes) rows that enter the update."""

    def multiply(self, x: Array, axis: int = 0) -> Array:
        """``H x``; with ``axis=1`` ``x H'``."""
        return structured_matrix.multiply(self.pattern, self.bands, x, axis)

    def transposed_multiply(self, x: Array, axis: int = 0) -> Array:
        """``H' x``; with ``axis=1`` ``x H``."""
        transposed = structured_matrix.transpose_bands(self.bands)
        return structured_matrix.multiply(self.pattern.transposed, transposed, x, axis)

    def masked(self, x: Array) -> Array:
        """`x`, (m, ..., lanes), with 0 in hidden rows."""
        visible = self.visible if x.ndim == 2 else self.visible[:, None]
        return jnp.where(visible, x, 0.0)


def row_blocks(p: Pattern, rows: MeasurementRows) -> list[RowBlock]:
    """The rows in blocks of nearly equal size, at most `_BLOCK_ROWS`."""
    size = rows.mask.shape[0]
    count = -(-size // _BLOCK_ROWS)
    found = []
    for start, stop in itertools.pairwise(size * k // count for k in range(count + 1)):
        part = structured_matrix.select_rows(p, rows.jacobian, start, stop)
        found.append(RowBlock(start, stop, *part, rows.mask[start:stop]))
    return found


def innovation_covariance(p: Pattern, bands: Bands, noise: Array, cov: Array) -> Array:
    """``H P H' + R`` of all rows, hidden ones included, (m, m, lanes)."""
    projected = materialise(structured_matrix.multiply(p, bands, cov))
    spread = materialise(structured_matrix.multiply(p, bands, projected, axis=1))
    return spread + (diagonal_matrix(noise) if noise.ndim == 2 else noise)


def whiten_rows(p: Pattern, rows: MeasurementRows) -> tuple[Pattern, MeasurementRows, Array | None]:
    """Rows with unit variances in place of rows whose noise is not diagonal.

    Residual and Jacobian are multiplied by the inverse of the Cholesky factor of the visible rows' noise.
    Returns also the log-determinant of that inverse, (lanes,), to be added to the log-likelihood; None if
    the noise was diagonal and nothing changed.
    """
    if rows.noise.ndim == 2:
        return p, rows, None
    white = materialise(linalg.whitener(linalg.mask_covariance(rows.noise, rows.mask)))
    lanes, dtype = rows.mask.shape[-1], rows.noise.dtype
    mixed = structured_matrix.row_mixed_pattern(p)
    dense = structured_matrix.to_dense(p, rows.jacobian, lanes, dtype)
    bands = structured_matrix.extract_bands(dense, mixed)
    jacobian = tuple(materialise(linalg.whiten(white, band)) for band in bands)
    residual = materialise(linalg.whiten(white, rows.residual))
    determinant = unrolled_sum([jnp.log(inverse) for inverse in white[1]])
    noise = jnp.ones_like(residual)
    return mixed, MeasurementRows(residual, jacobian, noise, rows.mask), determinant


def whitened_pattern(p: Pattern, rows: MeasurementRows) -> Pattern:
    """The sparsity of H after `whiten_rows`, from `p` before."""
    return p if rows.noise.ndim == rows.mask.ndim else structured_matrix.row_mixed_pattern(p)


def _ldl_inverse(matrix: Array) -> tuple[Array, list[Array]]:
    """Inverse (m, m, lanes) of a small positive definite matrix, by its factors ``L D L'``.

    Reads the lower half. Returns also the pivots D, (1, lanes) each, which are not all positive where the
    matrix is not definite.
    """
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
            scaled.append(unrolled_sum([matrix[i, j : j + 1], *(-k for k in known)]))
        row = [s * inverse for s, inverse in zip(scaled, inverses, strict=True)]
        eliminated = [-(c * s) for c, s in zip(row, scaled, strict=True)]
        pivots.append(unrolled_sum([matrix[i, i : i + 1], *eliminated]))
        inverses.append(materialise(1.0 / pivots[i]))
        unit = jnp.broadcast_to(np.eye(size)[i][:, None], (size, lanes))
        if i:
            unit = materialise(
                unit - unrolled_sum([c * u for c, u in zip(row, units, strict=True)])
            )
        factor.append(row)
        units.append(unit)
    return unrolled_sum([outer(u, u * v) for u, v in zip(units, inverses, strict=True)]), pivots


def apply_block(
    block: RowBlock, cov: Array, delta: Array, rows: MeasurementRows
) -> tuple[Array, Array, AppliedBlock, Array, Array, list[Array]]:
    """Apply one block of rows with diagonal noise.

    Rows H with noise R make ``S = H P H' + R``, the gain ``K = P H' S^-1`` and Joseph's
    ``(I - K H) P (I - K H)' + K R K'``, in the order ``P - K H P + (K R - (P - K H P) H') K'``: a rounding
    error of the gain then counts only to the second order. The covariance stays symmetric but for rounding.

    Returns
    -------
    cov, delta
        P and the error vector after the block.
    applied
        The factors that derivative and smoother need.
    cross
        ``H P``, (m, n, lanes).
    smallest
        The smallest pivot of S, (1, lanes).
    terms
        The innovation's ``e' S^-1 e`` and ``log det S``, (1, lanes) each.
    """
    visible, noise = block.visible, rows.noise[block.start : block.stop]
    cross = materialise(block.masked(block.multiply(cov)))
    spread = block.multiply(cross, 1) + diagonal_matrix(noise)
    found, pivots = _ldl_inverse(materialise(linalg.mask_covariance(spread, visible)))
    inverse = materialise(jnp.where(visible[:, None] & visible[None], found, 0.0))
    gain = materialise(multiply(inverse, cross))
    innovation = rows.residual[block.start : block.stop] - block.multiply(delta)
    innovation = materialise(block.masked(innovation))
    weighted = materialise(multiply_vector(inverse, innovation))
    half = materialise(cov - transposed_multiply(gain, cross))
    rest = gain * broadcast_axes(noise, gain.shape, 0) - block.multiply(half)
    rest = materialise(block.masked(rest))
    cov = materialise(half + transposed_multiply(rest, gain))
    delta = materialise(delta + transposed_multiply_vector(cross, weighted))
    # One logarithm: the product of a few variances neither over- nor underflows.
    smallest = reduce(jnp.minimum, pivots)
    terms = [dot(innovation, weighted), jnp.log(reduce(operator.mul, pivots))]
    return cov, delta, AppliedBlock(gain, inverse, weighted), cross, smallest, terms


def apply_rows_saving(
    p: Pattern, accumulator: UpdateAccumulator, rows: MeasurementRows
) -> tuple[UpdateAccumulator, Array, list[AppliedBlock], list[Array]]:
    """Apply rows of diagonal noise, block by block.

    Returns the accumulator after them, the smallest pivot (lanes,) of the innovation covariances, the
    applied blocks, and ``H P`` of each.
    """
    cov, delta, log_likelihood = accumulator
    applied, crosses, smallest, terms = [], [], [], []
    for block in row_blocks(p, rows):
        cov, delta, one, cross, pivot, own_terms = apply_block(block, cov, delta, rows)
        applied.append(one)
        crosses.append(cross)
        smallest.append(pivot)
        terms += own_terms
    visible = pairwise_sum(rows.mask.astype(cov.dtype), 0, keep=True)
    minus_twice_log = unrolled_sum([*terms, visible * _LOG_2PI])
    log_likelihood = materialise(log_likelihood - 0.5 * minus_twice_log[0])
    after = UpdateAccumulator(cov, delta, log_likelihood)
    return after, reduce(jnp.minimum, smallest)[0], applied, crosses


def apply_rows(
    p: Pattern, accumulator: UpdateAccumulator, rows: MeasurementRows, *, adjoint: bool = False
) -> tuple[UpdateAccumulator, Array]:
    """The accumulator after rows of diagonal noise, and the smallest pivot (lanes,) of the innovation
    covariances, not positive where one of them is not definite.

    With `adjoint` the reverse derivative is the closed form; without, every derivative is JAX's own.
    """
    if adjoint:
        return _apply_rows_with_vjp(p)(accumulator, rows)
    return apply_rows_saving(p, accumulator, rows)[:2]


# --- derivative ---------------------------------------------------------------------------------------


def information_before_block(
    block: RowBlock, gain: Array, matrix: Array, inner: Array, side: Array | None
) -> tuple[Array, Array]:
    """``A' B A + H' N H + (H' t + t' H) / 2`` with ``A = I - K H``, and ``K' B``.

    The smoother takes an information matrix back through a block of rows with it, the derivative a
    cotangent of P.

    Parameters
    ----------
    block
        The rows H.
    gain
        ``K'``, (m, n, lanes).
    matrix
        B, (n, n, lanes), symmetric.
    inner
        N, (m, m, lanes), symmetric.
    side
        t, (m, n, lanes); None for 0.
    """
    image = materialise(multiply(gain, matrix))
    weight = materialise(0.5 * (multiply_transposed(image, gain) + inner))
    arm = block.transposed_multiply(weight, 1) - image
    if side is not None:
        arm = arm + 0.5 * side
    arms = materialise(block.transposed_multiply(materialise(block.masked(arm))))
    return materialise(matrix + (arms + arms.swapaxes(0, 1))), image


class _SavedUpdate(NamedTuple):
    """The residuals of the VJP of an update."""

    cov: Array
    """P after all rows."""
    delta: Array
    """The error vector after all rows."""
    applied: list[AppliedBlock]
    crosses: list[Array]
    """``H P`` of all blocks but the first, to find P before them; none where H is known."""
    rows: MeasurementRows


def _apply_rows_vjp(
    p: Pattern, saved: _SavedUpdate, cotangent: UpdateAccumulator
) -> tuple[UpdateAccumulator, MeasurementRows]:
    """Cotangents of the accumulator before the rows, and of the rows.

    Block by block, the last first. With ``a``, B and w the cotangents of delta, P and log-likelihood after
    the block, s the weighted innovation, ``d = K' a`` and ``N = w (s s' - S^-1) / 2``: the residual's is
    ``c = d - w s``, the noise's the diagonal of ``K' B K - s d' + N``, and the Jacobian's
    ``(s a' - 2 K' B) P - c delta' - w K'``.
    """
    b, a, weight = cotangent.cov, cotangent.delta, cotangent.log_likelihood[None]
    delta, cov, rows = saved.delta, saved.cov, saved.rows
    residuals: list[Array] = []
    noises: list[Array] = []
    jacobians: list[Array] = []
    for block in reversed(row_blocks(p, rows)):
        index = len(saved.applied) - 1 - len(residuals)
        gain, inverse, weighted = saved.applied[index]
        drawn = materialise(multiply_vector(gain, a))
        error = materialise(block.masked(drawn - weight * weighted))
        spread = materialise(0.5 * weight[None] * (outer(weighted, weighted) - inverse))
        side = outer(weighted, materialise(a - block.transposed_multiply(drawn)))
        before, image = information_before_block(block, gain, b, spread, side)
        noise = pairwise_sum(gain * image, 1) - weighted * drawn + linalg.diagonal(spread)
        noises.append(block.masked(noise))
        residuals.append(error)
        if p.bands:
            pulled = materialise(outer(weighted, a) - 2.0 * image)
            whole = multiply(pulled, cov) - outer(error, delta) - weight[None] * gain
            jacobians.append(materialise(block.masked(whole)))
        if p.bands and index:
            cross = saved.crosses[index - 1]
            cov = materialise(cov + transposed_multiply(gain, cross))
            delta = materialise(delta - transposed_multiply_vector(cross, weighted))
        a = materialise(a - block.transposed_multiply(error))
        b = before
    bands = (
        structured_matrix.extract_bands(jnp.concatenate(jacobians[::-1]), p) if jacobians else ()
    )
    noise, residual = (jnp.concatenate(v[::-1]) for v in (noises, residuals))
    bands, noise, residual = materialise((bands, noise, residual))
    before_rows = UpdateAccumulator(b, a, cotangent.log_likelihood)
    return before_rows, MeasurementRows(residual, bands, noise, rows.mask)


@cache
def _apply_rows_with_vjp(p: Pattern) -> Any:
    @jax.custom_vjp
    def function(
        accumulator: UpdateAccumulator, rows: MeasurementRows
    ) -> tuple[UpdateAccumulator, Array]:
        return apply_rows(p, accumulator, rows)

    def forward(accumulator: UpdateAccumulator, rows: MeasurementRows) -> Any:
        after, smallest, applied, crosses = apply_rows_saving(p, accumulator, rows)
        later = crosses[1:] if p.bands else []
        return (after, smallest), _SavedUpdate(after.cov, after.delta, applied, later, rows)

    def backward(saved: Any, cotangent: Any) -> Any:
        accumulator, rows = _apply_rows_vjp(p, saved, cotangent[0])
        return accumulator, rows._replace(mask=np.zeros(rows.mask.shape, jax.dtypes.float0))

    function.defvjp(forward, backward)
    return function
