"""Attitude from two directions known in two frames, as gravity and the magnetic field are: TRIAD.

It is that of Ang, Khosla and Riviere, eqs. 7 to 13, its covariance their eqs. 41 to 46. For more than two
directions, or two that are equally trusted, see `wahba`.

What is wrong in the paper's print, and done otherwise here:

- Eq. 38 with eq. 13 gives the conjugate of the quaternion from body to world, divides by its real part,
  which fails at half a turn, and flips in sign. See `rotation.from_matrix` and the argument `near`.
- The vector of eq. 10 is what an accelerometer reads: specific force, **up** at rest. With gravity in
  its place the answer is half a turn off.
- The world of the paper is magnetic north, west, up; see `north_west_up`.
- The product of eq. 45 is a dot product; its error is a rotation vector in the body frame. The 4 by 4
  covariance of eq. 46 has rank 3, so that the error of three components is given here.

Every function is for one attitude; use ``jax.vmap`` for many. Derivatives are finite everywhere, and
zero where `Attitude.valid` is False.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jax import Array, lax

from jaxekf.geometry import linalg, rotation


class Attitude(NamedTuple):
    """An attitude, and whether the vectors told it."""

    q_ref_body: Array
    """(4,) unit quaternion w, x, y, z that takes body coordinates to reference coordinates."""
    valid: Array
    """() False where the vectors leave a turn open or are not finite; the quaternion is then the
    fallback."""


class References(NamedTuple):
    """Unit vectors of the world that an accelerometer at rest and a magnetometer measure."""

    up: Array
    """(3,) direction of specific force at rest: against gravity."""
    field: Array
    """(3,) direction of the Earth's magnetic field."""


def north_west_up(dip: Array | float) -> References:
    """References in the world of the paper: x to magnetic north, y west, z up.

    `dip`, radians, is the angle of the field below the horizontal, positive on the northern half.
    """
    dip = jnp.asarray(dip, float)
    zero, one = jnp.zeros_like(dip), jnp.ones_like(dip)
    return References(jnp.stack([zero, zero, one]), jnp.stack([jnp.cos(dip), zero, -jnp.sin(dip)]))


def east_north_up(dip: Array | float, declination: Array | float = 0.0) -> References:
    """References where x points east, y north, z up.

    `dip` as for `north_west_up`. `declination`, radians, is the angle from true to magnetic north,
    positive to the east; with 0 north is magnetic north.
    """
    dip, declination = jnp.asarray(dip, float), jnp.asarray(declination, float)
    zero, one = jnp.zeros_like(dip), jnp.ones_like(dip)
    level = jnp.cos(dip)
    north, east = level * jnp.cos(declination), level * jnp.sin(declination)
    return References(jnp.stack([zero, zero, one]), jnp.stack([east, north, -jnp.sin(dip)]))


def triad(
    first_body: Array,
    second_body: Array,
    first_ref: Array,
    second_ref: Array,
    *,
    near: Array | None = None,
    fallback: Array | None = None,
    least_sine: Array | float | None = None,
) -> Attitude:
    """Attitude from two vectors measured in the body and known in the reference (eqs. 7 to 13).

    The direction of the first is met exactly; of the second only the half-plane which it spans with
    the first. With ``*north_west_up(dip)`` as the last two, the first is the accelerometer's, the second
    the magnetometer's reading, and the dip angle does not matter.

    All vectors are (3,), of any length and unit. The sign of the quaternion is that nearer to `near`
    (4,), else the real part is not negative. Where a vector is zero or not finite, or the sine of
    the angle between the two of a pair is not above `least_sine` (by default the square root of the
    rounding error), `fallback` (4,) is returned, by default the identity.
    """
    body, body_told = _triad_axes(first_body, second_body, least_sine)
    reference, reference_told = _triad_axes(first_ref, second_ref, least_sine)
    matrix = sum(r[:, None] * b[None, :] for r, b in zip(reference, body, strict=True))
    return attitude_or(
        rotation.from_matrix(jnp.asarray(matrix)), body_told & reference_told, near, fallback
    )


def triad_covariance(
    first_body: Array,
    second_body: Array,
    first_cov: Array,
    second_cov: Array,
    *,
    least_sine: Array | float | None = None,
) -> Array:
    """Covariance (3, 3), rad^2, of the attitude error of `triad` (eqs. 41 to 46), to first order.

    The error is a rotation vector in the body frame: ``estimate = truth * exp(error)``. `first_cov` and
    `second_cov` (3, 3) are covariances of the two body vectors, in their own units squared, of any
    shape, independent of one another. Errors of the references count as well when their covariances,
    turned to the body frame and scaled to the length of the body vectors, are added to these.

    With axes ``t1`` along the first vector ``a``, ``t2`` along ``a x b`` and ``t3 = t1 x t2``, the axes
    turn by ``phi = t1 x da/|a| + t1 (t2.db - (b.t1) t2.da/|a|) / |t1 x b|`` when the vectors change by
    ``da`` and ``db``: their first part keeps ``t1`` on ``a``, the second keeps ``b`` in the plane of
    ``t1`` and ``t3``. The attitude turns by ``-phi``.

    Where `triad` is not valid for the sake of the body vectors, the identity is returned: about one
    radian, which is nothing known. The references are not looked at.
    """
    for cov in (first_cov, second_cov):
        # Anything else would be broadcast, to what is no covariance.
        if jnp.shape(cov) != (3, 3):
            raise ValueError(
                f"got a covariance of shape {jnp.shape(cov)}, expected (3, 3); of a standard deviation it"
                " is sigma**2 * jnp.eye(3), and for many attitudes use jax.vmap"
            )
    dtype = float_type(first_body, second_body, first_cov, second_cov)
    (t1, t2, t3), told = _triad_axes(first_body, second_body, least_sine)
    first = jnp.where(told, jnp.asarray(first_body, dtype), t1)
    second = jnp.where(told, jnp.asarray(second_body, dtype), -t3)
    length, along, across = jnp.sum(first * t1), jnp.sum(second * t1), -jnp.sum(second * t3)
    about_first = t1[:, None] * t2[None, :] / across
    by_first = (rotation.skew(t1) - along * about_first) / length
    # A reading that is not used may come with any covariance, NaN as well.
    noise = [
        jnp.where(told, jnp.asarray(cov, dtype), jnp.eye(3, dtype=dtype))
        for cov in (first_cov, second_cov)
    ]
    total = linalg.congruence(by_first, noise[0]) + linalg.congruence(about_first, noise[1])
    return jnp.where(told, total, jnp.eye(3, dtype=dtype))


def float_type(*arrays: Array) -> jnp.dtype:
    """The floating-point type in which to work on `arrays`."""
    dtype = jnp.result_type(*arrays)
    return dtype if jnp.issubdtype(dtype, jnp.floating) else jnp.result_type(float)


def default_threshold(least: Array | float | None, dtype: jnp.dtype) -> Array | float:
    """`least`, or the square root of the rounding error: half of all digits are left there."""
    return float(jnp.finfo(dtype).eps) ** 0.5 if least is None else least


def directions(vector: Array) -> tuple[Array, Array]:
    """Unit vectors (..., 3) and whether each could be made; x where it could not.

    The largest component is divided out first, so that squares neither overflow nor vanish. The
    result does not depend on that factor, so it may count as a constant under differentiation.
    """
    largest = lax.stop_gradient(jnp.max(jnp.abs(vector), axis=-1))
    # A comparison with NaN is False.
    usable = (largest > jnp.finfo(vector.dtype).tiny) & (largest < jnp.inf)
    x = jnp.broadcast_to(jnp.eye(3, dtype=vector.dtype)[0], vector.shape)
    safe = jnp.where(usable[..., None], vector, x)
    return rotation.normalise(safe / jnp.where(usable, largest, 1.0)[..., None]), usable


def attitude_or(q: Array, valid: Array, near: Array | None, fallback: Array | None) -> Attitude:
    """``q`` with the sign nearer to `near` where `valid`, else `fallback` or the identity."""
    if near is not None:
        q = rotation.align(q, jnp.asarray(near, q.dtype))
    other = rotation.identity() if fallback is None else fallback
    return Attitude(jnp.where(valid, q, jnp.asarray(other, q.dtype)), valid)


def _triad_axes(
    first: Array, second: Array, least_sine: Array | float | None
) -> tuple[tuple[Array, Array, Array], Array]:
    """The axes along `first`, across both, and their product; and whether the pair tells them."""
    dtype = float_type(first, second)
    first, first_usable = directions(jnp.asarray(first, dtype))
    second, second_usable = directions(jnp.asarray(second, dtype))
    squared_sine = jnp.sum(jnp.cross(first, second) ** 2)
    told = first_usable & second_usable & (squared_sine > default_threshold(least_sine, dtype) ** 2)
    eye = jnp.eye(3, dtype=dtype)
    first, second = jnp.where(told, first, eye[0]), jnp.where(told, second, eye[1])
    normal = rotation.normalise(jnp.cross(first, second))
    return (first, normal, jnp.cross(first, normal)), told
