"""The prediction ``F P F' + G Sigma G'`` and ``M P M'`` on the batch axis, with closed-form derivatives.

Section 2 of docs/mathematics.md, after Parellier, Barrau and Bonnabel (2023). F, G and M have known
sparsity (`Pattern`) and are given by their unknown bands. Covariances are symmetric but for rounding, and
so are their cotangents. `jaxekf.filtering._step` calls this file.
"""

from functools import cache
from typing import Any

import jax
import jax.numpy as jnp
from jax import Array

from jaxekf.filtering.lowering import batched_products, structured_matrix
from jaxekf.filtering.lowering.lanes import materialise, pairwise_sum
from jaxekf.filtering.lowering.structured_matrix import Bands, Pattern
from jaxekf.geometry import linalg


def congruence(p: Pattern, bands: Bands, cov: Array, *, adjoint: bool = False) -> Array:
    """``M P M'``, (n, n, lanes), symmetric but for rounding.

    With `adjoint` its reverse derivative is the closed form; without, every derivative is JAX's own.
    """
    if adjoint:
        return _congruence_with_vjp(p)(bands, cov)
    return _right_product(p, bands, _left_product(p, bands, cov))


def predicted_covariance(
    patterns: tuple[Pattern, Pattern],
    f: Bands,
    g: Bands,
    cov: Array,
    sigma: Array,
    *,
    adjoint: bool = False,
) -> Array:
    """``F P F' + G Sigma G'``, (n, n, lanes), symmetric.

    Parameters
    ----------
    patterns
        Sparsity of F and of G.
    f, g
        Their bands.
    cov
        P, (n, n, lanes).
    sigma
        Covariance of the process noise (n_w, n_w, lanes), or its variances (n_w, lanes).
    adjoint
        As in `congruence`.
    """
    if adjoint:
        return _predicted_with_vjp(*patterns)(f, g, cov, sigma)
    return _predicted(*patterns, f, g, cov, sigma)[0]


def _left_product(p: Pattern, bands: Bands, cov: Array) -> Array:
    """``M P``; P is a covariance, or variances (n, lanes)."""
    if cov.ndim == 2:
        matrix = structured_matrix.to_dense(p, bands, cov.shape[-1], cov.dtype)
        return materialise(matrix * cov[None])
    return materialise(structured_matrix.multiply(p, bands, cov))


def _right_product(p: Pattern, bands: Bands, half: Array) -> Array:
    """``M P M'`` from ``M P``."""
    return materialise(structured_matrix.multiply(p, bands, half, axis=1))


def _congruence_vjp(
    p: Pattern, bands: Bands, half: Array, diagonal: bool, cotangent: Array
) -> tuple[Bands, Array]:
    """Cotangents of the bands, ``2 B M P``, and of P, ``M' B M`` (or the diagonal of it).

    `half` is ``M P`` and `cotangent` is B.
    """
    back, transposed = p.transposed, structured_matrix.transpose_bands(bands)
    first = materialise(structured_matrix.multiply(back, transposed, cotangent))
    if diagonal:
        matrix = structured_matrix.to_dense(p, bands, half.shape[-1], half.dtype)
        cov = pairwise_sum(first * matrix.swapaxes(0, 1), 1)
    else:
        cov = structured_matrix.multiply(back, transposed, first, axis=1)

    def band_cotangent(rows: tuple[int, ...], cols: tuple[int, ...]) -> Array:
        above = structured_matrix.take_slices(cotangent, rows, 0)
        products = [
            materialise(2.0 * batched_products.multiply(above, part))
            for part in structured_matrix.split_slices(half, cols, 1)
        ]
        return products[0] if len(products) == 1 else materialise(jnp.concatenate(products, 1))

    return tuple(band_cotangent(*band) for band in p.bands), materialise(cov)


@cache
def _congruence_with_vjp(p: Pattern) -> Any:
    @jax.custom_vjp
    def function(bands: Bands, cov: Array) -> Array:
        return congruence(p, bands, cov)

    def forward(bands: Bands, cov: Array) -> Any:
        half = _left_product(p, bands, cov)
        return _right_product(p, bands, half), (bands, half)

    def backward(saved: Any, cotangent: Array) -> Any:
        bands, half = saved
        return _congruence_vjp(p, bands, half, False, cotangent)

    function.defvjp(forward, backward)
    return function


def _predicted(
    f_pattern: Pattern, g_pattern: Pattern, f: Bands, g: Bands, cov: Array, sigma: Array
) -> tuple[Array, tuple[Array, Array | None]]:
    """The prediction, and ``F P`` and ``G Sigma`` (None where G is the identity)."""
    half, noise_half = _left_product(f_pattern, f, cov), None
    total = _right_product(f_pattern, f, half)
    if not g_pattern.is_identity:
        noise_half = _left_product(g_pattern, g, sigma)
        total = total + _right_product(g_pattern, g, noise_half)
    elif sigma.ndim == 2:
        total = total + batched_products.diagonal_matrix(sigma)
    else:
        total = total + sigma
    return materialise(linalg.symmetrise(materialise(total))), (half, noise_half)


@cache
def _predicted_with_vjp(f_pattern: Pattern, g_pattern: Pattern) -> Any:
    @jax.custom_vjp
    def function(f: Bands, g: Bands, cov: Array, sigma: Array) -> Array:
        return _predicted(f_pattern, g_pattern, f, g, cov, sigma)[0]

    def forward(f: Bands, g: Bands, cov: Array, sigma: Array) -> Any:
        found, halves = _predicted(f_pattern, g_pattern, f, g, cov, sigma)
        return found, (f, g, sigma, halves)

    def backward(saved: Any, cotangent: Array) -> Any:
        f, g, sigma, (half, noise_half) = saved
        diagonal = sigma.ndim == 2
        f_bar, cov_bar = _congruence_vjp(f_pattern, f, half, False, cotangent)
        if noise_half is None:
            sigma_bar = linalg.diagonal(cotangent) if diagonal else cotangent
            return f_bar, g, cov_bar, sigma_bar
        g_bar, sigma_bar = _congruence_vjp(g_pattern, g, noise_half, diagonal, cotangent)
        return f_bar, g_bar, cov_bar, sigma_bar

    function.defvjp(forward, backward)
    return function
