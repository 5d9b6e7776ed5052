"""Attitude from two directions known in two frames, such as gravity and the magnetic field: TRIAD.

The algorithm is that of Ang, Khosla and Riviere, eqs. 7 to 13, the covariance their eqs. 41 to 46. For more
directions, or two that are equally certain, see `wahba`.

Corrections of the paper's print:

- Eq. 38 with eq. 13 gives the conjugate of the body-to-world quaternion, divides by its real part, which
  fails at 180 degrees, and is ambiguous in sign. See `rotation.from_matrix` and the argument `near`.
- The vector of eq. 10 is the reading of an accelerometer: specific force, **up** at rest. Gravity in its
  place would give an error of 180 degrees.
- The world of the paper is magnetic north, west, up; see `north_west_up`.
- The product of eq. 45 is a dot product; its error is a rotation vector in the body frame. The 4 by 4
  covariance of eq. 46 has rank 3, so the error here has three components.

Every function is for one attitude; use ``jax.vmap`` for many. Derivatives are finite everywhere, and
zero where `Attitude.valid` is False.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jax import Array, lax

from jaxekf._support.errors import ArgumentError
from jaxekf.geometry import linalg, rotation


class Attitude(NamedTuple):
    """An attitude, and whether the vectors determine it.

    Examples
    --------
    >>> import jax, numpy as np
    >>> from jaxekf.geometry import triad
    >>> x, y, _ = np.eye(3)
    >>> found = jax.jit(triad.triad)(x, x, x, y)  # one direction only in the body frame
    >>> bool(found.valid), found.q_ref_body.tolist()
    (False, [1.0, 0.0, 0.0, 0.0])
    """

    q_ref_body: Array
    """(4,) unit quaternion w, x, y, z that takes body coordinates to reference coordinates."""
    valid: Array
    """() False if the vectors leave a rotation undetermined or are not finite; the quaternion is then the
    fallback."""


class References(NamedTuple):
    """Reference directions: unit vectors that an accelerometer at rest and a magnetometer measure.

    Examples
    --------
    >>> import numpy as np
    >>> from jaxekf.geometry import triad
    >>> horizontal = triad.References(up=np.array([0.0, 0.0, 1.0]), field=np.array([1.0, 0.0, 0.0]))
    >>> np.allclose(horizontal, triad.north_west_up(dip=0.0))
    True
    """

    up: Array
    """(3,) direction of specific force at rest, opposite to gravity."""
    field: Array
    """(3,) direction of the Earth's magnetic field."""


def north_west_up(dip: Array | float) -> References:
    """References in the world of the paper: x to magnetic north, y west, z up.

    Parameters
    ----------
    dip
        Angle of the field below the horizontal, rad, positive in the northern hemisphere.

    Examples
    --------
    >>> import jaxekf, numpy as np
    >>> from jaxekf.geometry import triad
    >>> jaxekf.set_up()
    >>> field = np.asarray(triad.north_west_up(np.deg2rad(60.0)).field)
    >>> field.round(4).tolist()  # to the north and down
    [0.5, 0.0, -0.866]
    """
    dip = jnp.asarray(dip, float)
    zero, one = jnp.zeros_like(dip), jnp.ones_like(dip)
    return References(jnp.stack([zero, zero, one]), jnp.stack([jnp.cos(dip), zero, -jnp.sin(dip)]))


def east_north_up(dip: Array | float, declination: Array | float = 0.0) -> References:
    """References with x pointing east, y north, z up.

    Parameters
    ----------
    dip
        As in `north_west_up`, rad.
    declination
        Angle from true to magnetic north, rad, positive to the east; 0 for magnetic north.

    Examples
    --------
    >>> import jaxekf, numpy as np
    >>> from jaxekf.geometry import triad
    >>> jaxekf.set_up()
    >>> east_of_north = triad.east_north_up(np.deg2rad(60.0), np.deg2rad(30.0))
    >>> np.asarray(east_of_north.field).round(4).tolist()  # to the north-north-east and down
    [0.25, 0.433, -0.866]
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
    """Attitude from two vectors measured in the body frame and known in the reference frame (eqs. 7 to 13).

    The direction of the first vector is matched exactly; of the second only the half-plane that it
    spans with the first. With ``*north_west_up(dip)`` as references, the first is the accelerometer's
    and the second the magnetometer's reading, and the result does not depend on the dip.

    Parameters
    ----------
    first_body, second_body
        (3,) measured vectors, body frame, any length and unit.
    first_ref, second_ref
        (3,) the same vectors in the reference frame.
    near
        (4,) quaternion that selects the sign of the result; without it the real part is not negative.
    fallback
        (4,) result for invalid vectors, by default the identity.
    least_sine
        Smallest sine of the angle between two vectors of a pair; by default the square root of the rounding
        error.

    Examples
    --------
    >>> import jax, jaxekf, numpy as np
    >>> from jaxekf.geometry import rotation, triad
    >>> jaxekf.set_up()
    >>> up, field = triad.north_west_up(np.deg2rad(60.0))
    >>> q_ref_body = rotation.exp(np.array([0.3, 0.0, 0.1]))
    >>> force, flux = (rotation.rotate_inverse(q_ref_body, v) for v in (9.81 * up, field))
    >>> np.allclose(jax.jit(triad.triad)(force, flux, up, field).q_ref_body, q_ref_body)
    True
    """
    body, body_valid = _triad_axes(first_body, second_body, least_sine)
    reference, reference_valid = _triad_axes(first_ref, second_ref, least_sine)
    matrix = sum(r[:, None] * b[None, :] for r, b in zip(reference, body, strict=True))
    return attitude_or(
        rotation.from_matrix(jnp.asarray(matrix)), body_valid & reference_valid, near, fallback
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

    The error is a rotation vector in the body frame: ``estimate = truth * exp(error)``. With axes ``t1``
    along the first vector ``a``, ``t2`` along ``a x b`` and ``t3 = t1 x t2``, changes ``da`` and ``db`` of
    the vectors rotate the axes by::

        phi = t1 x da/|a| + t1 (t2.db - (b.t1) t2.da/|a|) / |t1 x b|

    The first part keeps ``t1`` on ``a``, the second keeps ``b`` in the plane of ``t1`` and ``t3``. The
    attitude rotates by ``-phi``.

    Parameters
    ----------
    first_body, second_body
        (3,) measured vectors, body frame.
    first_cov, second_cov
        (3, 3) their covariances, in their own units squared, independent of each other. To include errors
        of the references, add their covariances, rotated to the body frame and scaled to the body vectors.
    least_sine
        As in `triad`.

    Returns
    -------
    (3, 3); the identity, a standard deviation of one radian, if the body vectors leave the attitude open.

    Raises
    ------
    ArgumentError
        For a covariance of another shape.

    Examples
    --------
    >>> import jax, jaxekf, numpy as np
    >>> from jaxekf.geometry import triad
    >>> jaxekf.set_up()
    >>> (north, _, up), noise = np.eye(3), np.eye(3)
    >>> covariance = jax.jit(triad.triad_covariance)
    >>> cov = covariance(up, north, 0.01**2 * noise, 0.03**2 * noise)
    >>> np.sqrt(np.diagonal(cov)).round(6).tolist()  # rad: tilt from `up`, heading from `north`
    [0.01, 0.01, 0.03]
    """
    for cov in (first_cov, second_cov):
        # Any other shape would be broadcast, to a result that is no covariance.
        if jnp.shape(cov) != (3, 3):
            raise ArgumentError(
                f"got a covariance of shape {jnp.shape(cov)}, expected (3, 3); of a standard deviation it"
                " is sigma**2 * jnp.eye(3), and for many attitudes use jax.vmap"
            )
    dtype = float_type(first_body, second_body, first_cov, second_cov)
    (t1, t2, t3), valid = _triad_axes(first_body, second_body, least_sine)
    first = jnp.where(valid, jnp.asarray(first_body, dtype), t1)
    second = jnp.where(valid, jnp.asarray(second_body, dtype), -t3)
    length, along, across = jnp.sum(first * t1), jnp.sum(second * t1), -jnp.sum(second * t3)
    about_first = t1[:, None] * t2[None, :] / across
    by_first = (rotation.skew(t1) - along * about_first) / length
    # A reading that is not used may come with any covariance, NaN as well.
    noise = [
        jnp.where(valid, jnp.asarray(cov, dtype), jnp.eye(3, dtype=dtype))
        for cov in (first_cov, second_cov)
    ]
    total = linalg.congruence(by_first, noise[0]) + linalg.congruence(about_first, noise[1])
    return jnp.where(valid, total, jnp.eye(3, dtype=dtype))


def float_type(*arrays: Array) -> jnp.dtype:
    """Floating-point type for computations on `arrays`.

    Examples
    --------
    >>> import numpy as np
    >>> from jaxekf.geometry import triad
    >>> print(triad.float_type(np.zeros(3, np.float32), np.ones(3, np.float32)))
    float32
    """
    dtype = jnp.result_type(*arrays)
    return dtype if jnp.issubdtype(dtype, jnp.floating) else jnp.result_type(float)


def default_threshold(least: Array | float | None, dtype: jnp.dtype) -> Array | float:
    """`least`, or by default the square root of the rounding error, at which half the digits remain.

    Examples
    --------
    >>> import numpy as np
    >>> from jaxekf.geometry import triad
    >>> f"{triad.default_threshold(None, np.dtype('float64')):.1e}"
    '1.5e-08'
    >>> triad.default_threshold(0.1, np.dtype("float64"))
    0.1
    """
    return float(jnp.finfo(dtype).eps) ** 0.5 if least is None else least


def directions(vector: Array) -> tuple[Array, Array]:
    """Unit vectors (..., 3), and whether each could be normalised; x if not.

    The largest component is divided out first, so that squares neither overflow nor underflow. The
    result does not depend on that factor, which is therefore a constant under differentiation.

    Examples
    --------
    >>> import jax, numpy as np
    >>> from jaxekf.geometry import triad
    >>> unit, usable = jax.jit(triad.directions)(np.array([[0.0, 0.0, 9.81], [0.0, 0.0, 0.0]]))
    >>> np.allclose(unit, [[0.0, 0.0, 1.0], [1.0, 0.0, 0.0]]), usable.tolist()
    (True, [True, False])
    """
    largest = lax.stop_gradient(jnp.max(jnp.abs(vector), axis=-1))
    # A comparison with NaN is False.
    usable = (largest > jnp.finfo(vector.dtype).tiny) & (largest < jnp.inf)
    x = jnp.broadcast_to(jnp.eye(3, dtype=vector.dtype)[0], vector.shape)
    safe = jnp.where(usable[..., None], vector, x)
    return rotation.normalise(safe / jnp.where(usable, largest, 1.0)[..., None]), usable


def attitude_or(q: Array, valid: Array, near: Array | None, fallback: Array | None) -> Attitude:
    """``q`` with the sign nearer to `near` if `valid`, else `fallback` or the identity.

    Examples
    --------
    >>> import jaxekf, numpy as np
    >>> from jaxekf.geometry import triad
    >>> jaxekf.set_up()
    >>> half_turn_about_x = np.array([0.0, 1.0, 0.0, 0.0])
    >>> triad.attitude_or(half_turn_about_x, np.array(False), None, None).q_ref_body.tolist()
    [1.0, 0.0, 0.0, 0.0]
    """
    if near is not None:
        q = rotation.align(q, jnp.asarray(near, q.dtype))
    other = rotation.identity() if fallback is None else fallback
    return Attitude(jnp.where(valid, q, jnp.asarray(other, q.dtype)), valid)


def _triad_axes(
    first: Array, second: Array, least_sine: Array | float | None
) -> tuple[tuple[Array, Array, Array], Array]:
    """Axes along `first`, the cross product and their product, and whether the pair determines them."""
    dtype = float_type(first, second)
    first, first_usable = directions(jnp.asarray(first, dtype))
    second, second_usable = directions(jnp.asarray(second, dtype))
    squared_sine = jnp.sum(jnp.cross(first, second) ** 2)
    valid = (
        first_usable & second_usable & (squared_sine > default_threshold(least_sine, dtype) ** 2)
    )
    eye = jnp.eye(3, dtype=dtype)
    first, second = jnp.where(valid, first, eye[0]), jnp.where(valid, second, eye[1])
    normal = rotation.normalise(jnp.cross(first, second))
    return (first, normal, jnp.cross(first, normal)), valid
