"""Accelerometers at known places of a rigid body, and what their differences tell of its rotation.

The axis ``s`` at the place ``p`` reads ``s . (a + alpha x p + omega x (omega x p))``: ``a`` is the
specific force at the body's origin, the rest is the rigid-body law. The three numbers of ``a`` are
removed by projection onto what no ``a`` can reach, which for the paper's three dual-axis chips are its
three differences ``A_D`` (Ang, Khosla, Riviere, eqs. 1 to 6) and else whatever the axes allow.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from jaxekf.geometry.linalg import standard_deviation_factor

# Singular values below this part of the largest count as zero.
_RANK = 1e-6


class AccelerometerArray(NamedTuple):
    """Places and directions of single accelerometer axes, all in the body frame."""

    positions: Array
    """Place of each axis (n, 3), m."""
    axes: Array
    """Sensitive direction of each axis (n, 3), unit vectors."""


class Differences(NamedTuple):
    """What is left of the rigid-body law once the specific force is gone, in units of the noise.

    ``whitening @ readings = linear @ alpha + (omega' quadratic omega)``, plus noise of covariance one.
    """

    whitening: Array
    """Takes n readings, m/s^2, to their whitened, projected form (n, n)."""
    linear: Array
    """The paper's matrix M (n, 3), per rad/s^2."""
    quadratic: Array
    """Symmetric matrix of the centripetal part of each row (n, 3, 3), per (rad/s)^2."""
    independent: Array
    """How many independent differences there are, (): n less the rank of the axes."""
    degenerate: Array
    """Whether they leave part of the angular acceleration unknown, (): rank of `linear` below 3."""


def three_dual_axis(first: Array, second: Array, third: Array) -> AccelerometerArray:
    """The paper's array: chips at `first` (x, z), `second` (y, z) and `third` (x, y), each (3,), m.

    Readings are in the order ``1x 1z 2y 2z 3x 3y``. With ``P_ij`` from chip i to chip j, the array is
    degenerate where ``det M = P13z P23x P12y - P13y P23z P12x`` is zero.
    """
    x, y, z = jnp.eye(3)
    places = jnp.stack([first, first, second, second, third, third])
    return AccelerometerArray(places, jnp.stack([x, z, y, z, x, y]))


def exact_readings(
    array: AccelerometerArray, rate: Array, angular_acceleration: Array, force: Array
) -> Array:
    """Readings (n,), m/s^2, without noise.

    `rate` (3,), rad/s, `angular_acceleration` (3,), rad/s^2, and the specific force at the origin
    `force` (3,), m/s^2, in the body frame.
    """

    def read(position: Array, axis: Array) -> Array:
        turning = jnp.cross(angular_acceleration, position)
        centripetal = jnp.cross(rate, jnp.cross(rate, position))
        return jnp.dot(axis, force + turning + centripetal)

    return jax.vmap(read)(array.positions, array.axes)


@jax.custom_jvp
def _left_out(matrix: Array) -> tuple[Array, Array]:
    """Projector (n, n) onto what the columns of `matrix` (n, 3) do not reach, and its inverse (3, n).

    Columns that depend on the others count as not there.
    """
    u, size, vt = jnp.linalg.svd(matrix, full_matrices=False)
    there = size > _RANK * size[0]
    u = jnp.where(there[None, :], u, 0.0)
    inverse = (vt.T * jnp.where(there, 1.0 / jnp.where(there, size, 1.0), 0.0)[None, :]) @ u.T
    return jnp.eye(matrix.shape[0], dtype=matrix.dtype) - u @ u.T, inverse


@_left_out.defjvp
def _left_out_jvp(
    primals: tuple[Array], tangents: tuple[Array]
) -> tuple[tuple[Array, Array], tuple[Array, Array]]:
    """Golub and Pereyra (1973): needs no derivative of singular vectors, which equal sizes do not have.

    A rank below three is kept: a direction of the force that no axis feels stays without effect.
    """
    (matrix,), (change,) = primals, tangents
    projector, inverse = _left_out(matrix)
    moved = projector @ change @ inverse
    unreached = jnp.eye(3, dtype=matrix.dtype) - inverse @ matrix
    slope = (
        -inverse @ change @ inverse
        + inverse @ inverse.T @ change.T @ projector
        + unreached @ change.T @ inverse.T @ inverse
    )
    return (projector, inverse), (-(moved + moved.T), slope)


def differences(array: AccelerometerArray, noise: Array | float) -> Differences:
    """Prepare an array for `differential`; once for all samples.

    `noise`, m/s^2, of one sample: one standard deviation (), one for each axis (n,), or a
    lower-triangular factor of the covariance (n, n). Differentiable by everything. Any n will do: what
    too few axes cannot tell is flagged.
    """
    positions, axes = jnp.asarray(array.positions), jnp.asarray(array.axes)
    if positions.ndim != 2 or positions.shape[1] != 3 or axes.shape != positions.shape:
        raise ValueError(
            f"got positions of shape {positions.shape} and axes of shape {axes.shape},"
            " expected (n, 3) for both; give a place and a direction for every axis"
        )
    n = axes.shape[0]
    factor = standard_deviation_factor(jnp.asarray(noise, axes.dtype), n)
    unprojected = jax.scipy.linalg.solve_triangular(
        factor, jnp.eye(n, dtype=axes.dtype), lower=True
    )
    projector, inverse = _left_out(unprojected @ axes)
    whitening = projector @ unprojected
    outer = axes[:, :, None] * positions[:, None, :]
    trace = jnp.sum(axes * positions, axis=1)[:, None, None]
    curved = 0.5 * (outer + outer.swapaxes(1, 2)) - trace * jnp.eye(3, dtype=axes.dtype)[None]
    linear = whitening @ jnp.cross(positions, axes)
    scale = jnp.max(jnp.abs(unprojected @ axes)) * jnp.max(jnp.abs(positions))
    size = jnp.linalg.svd(jax.lax.stop_gradient(linear), compute_uv=False)
    rank = jnp.sum(size > _RANK * jnp.maximum(size[0], jax.lax.stop_gradient(scale)))
    return Differences(
        whitening,
        linear,
        jnp.einsum("ij,jkl->ikl", whitening, curved),
        n - jnp.round(jnp.trace(inverse @ unprojected @ axes)).astype(int),
        rank < 3,
    )
