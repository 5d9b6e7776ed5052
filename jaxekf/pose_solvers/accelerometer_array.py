"""Accelerometer array: differences of single-axis accelerometers at known places of a rigid body.

An axis ``s`` at the place ``p`` reads ``s . (a + alpha x p + omega x (omega x p))``: ``a`` is the specific
force at the body's origin, the rest is rigid-body motion. A projection onto the orthogonal complement of
the axes removes ``a``. For the paper's three dual-axis chips it gives their three differences ``A_D``
(Ang, Khosla, Riviere, eqs. 1 to 6), and for other arrays as many as the axes allow.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from jaxekf._support.errors import ArgumentError
from jaxekf.geometry.linalg import standard_deviation_factor

# Singular values below this part of the largest count as zero.
_RANK = 1e-6


class AccelerometerArray(NamedTuple):
    """Places and directions of single accelerometer axes, body frame."""

    positions: Array
    """(n, 3) place of each axis, m."""
    axes: Array
    """(n, 3) sensitive direction of each axis, unit vectors."""


class Differences(NamedTuple):
    """Whitened readings without the specific force, as functions of the angular motion.

    ``whitening @ readings = linear @ alpha + (omega' quadratic omega)``, plus noise of unit covariance.
    """

    whitening: Array
    """(n, n), takes readings, m/s^2, to their whitened, projected form."""
    linear: Array
    """(n, 3) per rad/s^2, the paper's matrix M."""
    quadratic: Array
    """(n, 3, 3) per (rad/s)^2, symmetric matrices of the centripetal terms."""
    independent: Array
    """Number of independent differences, (): n minus the rank of the axes."""
    degenerate: Array
    """Whether the angular acceleration is not fully determined, (): rank of `linear` below 3."""


def three_dual_axis(first: Array, second: Array, third: Array) -> AccelerometerArray:
    """The paper's array of three dual-axis chips.

    Readings are in the order ``1x 1z 2y 2z 3x 3y``. With ``P_ij`` from chip i to chip j, the array is
    degenerate if ``det M = P13z P23x P12y - P13y P23z P12x`` is zero.

    Parameters
    ----------
    first, second, third
        (3,) m, places of the chips with the axes (x, z), (y, z) and (x, y), body frame.
    """
    x, y, z = jnp.eye(3)
    places = jnp.stack([first, first, second, second, third, third])
    return AccelerometerArray(places, jnp.stack([x, z, y, z, x, y]))


def exact_readings(
    array: AccelerometerArray, rate: Array, angular_acceleration: Array, force: Array
) -> Array:
    """Noise-free readings (n,), m/s^2.

    Parameters
    ----------
    array
        The array.
    rate
        (3,) rad/s, body frame.
    angular_acceleration
        (3,) rad/s^2, body frame.
    force
        (3,) m/s^2, specific force at the origin, body frame.
    """

    def read(position: Array, axis: Array) -> Array:
        turning = jnp.cross(angular_acceleration, position)
        centripetal = jnp.cross(rate, jnp.cross(rate, position))
        return jnp.dot(axis, force + turning + centripetal)

    return jax.vmap(read)(array.positions, array.axes)


@jax.custom_jvp
def _complement_projector(matrix: Array) -> tuple[Array, Array]:
    """Projector (n, n) onto the complement of the columns of `matrix` (n, 3), and the pseudo-inverse (3,
    n).

    Dependent columns are left out.
    """
    u, size, vt = jnp.linalg.svd(matrix, full_matrices=False)
    there = size > _RANK * size[0]
    u = jnp.where(there[None, :], u, 0.0)
    inverse = (vt.T * jnp.where(there, 1.0 / jnp.where(there, size, 1.0), 0.0)[None, :]) @ u.T
    return jnp.eye(matrix.shape[0], dtype=matrix.dtype) - u @ u.T, inverse


@_complement_projector.defjvp
def _complement_projector_jvp(
    primals: tuple[Array], tangents: tuple[Array]
) -> tuple[tuple[Array, Array], tuple[Array, Array]]:
    """Derivative by Golub and Pereyra (1973), without derivatives of singular vectors, which may not exist.

    A rank below three is kept: a direction of the force that no axis measures stays without effect.
    """
    (matrix,), (change,) = primals, tangents
    projector, inverse = _complement_projector(matrix)
    moved = projector @ change @ inverse
    unreached = jnp.eye(3, dtype=matrix.dtype) - inverse @ matrix
    slope = (
        -inverse @ change @ inverse
        + inverse @ inverse.T @ change.T @ projector
        + unreached @ change.T @ inverse.T @ inverse
    )
    return (projector, inverse), (-(moved + moved.T), slope)


def differences(array: AccelerometerArray, noise: Array | float) -> Differences:
    """Prepare an array for `gyro_free_rate.angular_rate`; once for all samples.

    The result is differentiable by all arguments. Any number of axes is allowed; an array with too few is
    flagged as degenerate.

    Parameters
    ----------
    array
        The array.
    noise
        Noise of one sample, m/s^2: standard deviation of all axes (), of each axis (n,), or a
        lower-triangular factor of the covariance (n, n).

    Raises
    ------
    ArgumentError
        If the shapes do not match.

    Examples
    --------
    >>> import jax, jaxekf
    >>> from jaxekf.pose_solvers import accelerometer_array
    >>> from jaxekf.simulation import gyro_free_runs
    >>> jaxekf.set_up()
    >>> array = gyro_free_runs.handheld_array()
    >>> prepared = jax.jit(accelerometer_array.differences)(array, 1e-3)
    >>> int(prepared.independent), bool(prepared.degenerate)  # six axes less the specific force
    (3, False)
    """
    positions, axes = jnp.asarray(array.positions), jnp.asarray(array.axes)
    if positions.ndim != 2 or positions.shape[1] != 3 or axes.shape != positions.shape:
        raise ArgumentError(
            f"got positions of shape {positions.shape} and axes of shape {axes.shape},"
            " expected (n, 3) for both; give a place and a direction for every axis"
        )
    n = axes.shape[0]
    factor = standard_deviation_factor(jnp.asarray(noise, axes.dtype), n)
    unprojected = jax.scipy.linalg.solve_triangular(
        factor, jnp.eye(n, dtype=axes.dtype), lower=True
    )
    projector, inverse = _complement_projector(unprojected @ axes)
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
