"""Unit quaternions and rotation vectors, safe under differentiation.

Quaternions are ``w, x, y, z`` with the Hamilton product, of unit norm, and rotate body coordinates
to reference coordinates: ``v_ref = q * v_body * conj(q)``. ``q`` and ``-q`` are one rotation.
Rotation vectors are in radians. Every function works on the last axis and broadcasts nothing
silently; gradients, also second ones, are finite everywhere, the zero rotation included.
"""

import functools
import math
from collections.abc import Callable
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

_F = TypeVar("_F", bound=Callable[..., Any])

GROUP_CALLS: set[str] = set()
"""Names, in a traced program, of the functions with a derivative in
`jaxekf.filtering.lowering.group_derivative`."""


def _group(function: _F) -> _F:
    """The function as one named operation of a traced program."""
    name = f"jaxekf.geometry.rotation.{function.__name__}"
    GROUP_CALLS.add(name)

    def call(*args: Any) -> Any:
        return function(*args)

    call.__name__ = call.__qualname__ = name
    jitted: Any = jax.jit(call)

    @functools.wraps(function)
    def marked(*args: Any) -> Any:
        return jitted(*args)

    return marked  # pyright: ignore[reportReturnType]


_SKEW = np.cross(np.eye(3)[:, None], np.eye(3)[None]).swapaxes(1, 2)

# pi in two parts, the first with few enough digits that a million times it is exact.
_PI = 3.141592651605606
_PI_REST = 1.984187159361081e-09
# Taylor coefficients of cos(x) and sin(x) / (2 x) in powers of x * x. For x up to pi / 2 the error of
# truncation is below rounding.
_COSINE_AND_SINE = tuple(
    ((-1.0) ** k / math.factorial(2 * k), 0.5 * (-1.0) ** k / math.factorial(2 * k + 1))
    for k in range(11)
)

# Below these squared sizes the series are exact to rounding, value and two derivatives, so that the
# closed forms (which divide by the size) are never evaluated where they are 0/0.
_SMALL_ANGLE_SQUARED = 1e-2
_SMALL_TANGENT_SQUARED = 1e-3


@functools.partial(jax.custom_jvp, nondiff_argnums=(1,))
def _polynomial(x: Array, coefficients: tuple[Any, ...]) -> Array:
    """Horner evaluation of ``sum(c[i] * x**i)``.

    For several polynomials each ``c[i]`` has one coefficient for each on the last axis, where `x` has
    size 1.
    """

    def numbers(coefficient: Any) -> Array:
        value = jnp.asarray(coefficient, x.dtype)
        return value.reshape((1,) * (x.ndim - value.ndim) + value.shape) if value.ndim else value

    value = numbers(coefficients[-1])
    x = jnp.broadcast_to(x, jnp.broadcast_shapes(x.shape, value.shape))
    for coefficient in reversed(coefficients[:-1]):
        value = value * x + numbers(coefficient)
    return value


@_polynomial.defjvp
def _polynomial_jvp(
    coefficients: tuple[Any, ...], primals: tuple[Array], tangents: tuple[Array]
) -> tuple[Array, Array]:
    # A polynomial itself: a third of the operations of the derivative of Horner's way.
    (x,), (moved,) = primals, tangents
    derived = tuple(_times(k, c) for k, c in enumerate(coefficients))[1:]
    return _polynomial(x, coefficients), _polynomial(x, derived or (0.0,)) * moved


def _times(factor: int, coefficient: Any) -> Any:
    if isinstance(coefficient, tuple):
        return tuple(factor * c for c in coefficient)
    return factor * coefficient


def identity() -> Array:
    """The quaternion of no rotation, shape (4,)."""
    return jnp.array([1.0, 0.0, 0.0, 0.0])


@_group
def cross(a: Array, b: Array) -> Array:
    """Cross product of vectors, shapes (..., 3)."""
    return _rolled(a, 1) * _rolled(b, 2) - _rolled(a, 2) * _rolled(b, 1)


def _rolled(vector: Array, by: int) -> Array:
    return jnp.concatenate([vector[..., by:], vector[..., :by]], axis=-1)


@_group
def product(p: Array, q: Array) -> Array:
    """Hamilton product ``p * q`` of quaternions, shapes (..., 4).

    Examples
    --------
    >>> import numpy as np
    >>> from jaxekf.geometry import rotation
    >>> _, i, j, _ = np.eye(4)
    >>> rotation.product(i, j).tolist()  # i * j = k
    [0.0, 0.0, 0.0, 1.0]
    """
    pw, pv, qw, qv = p[..., :1], p[..., 1:], q[..., :1], q[..., 1:]
    real = pw * qw - jnp.sum(pv * qv, axis=-1, keepdims=True)
    return jnp.concatenate([real, pw * qv + qw * pv + cross(pv, qv)], axis=-1)


@_group
def conjugate(q: Array) -> Array:
    """Inverse of a unit quaternion, shape (..., 4).

    Examples
    --------
    >>> import jaxekf, numpy as np
    >>> from jaxekf.geometry import rotation
    >>> jaxekf.set_up()
    >>> q = rotation.exp(np.array([0.1, -0.2, 0.3]))
    >>> np.allclose(rotation.product(rotation.conjugate(q), q), rotation.identity())
    True
    """
    return jnp.concatenate([q[..., :1], -q[..., 1:]], axis=-1)


@_group
def normalise(q: Array) -> Array:
    """``q`` scaled to unit norm, shape (..., 4); ``q`` must not be zero.

    Examples
    --------
    >>> import numpy as np
    >>> from jaxekf.geometry import rotation
    >>> rotation.normalise(np.array([0.0, 0.0, 0.0, 2.0])).tolist()
    [0.0, 0.0, 0.0, 1.0]
    """
    return q / jnp.sqrt(jnp.sum(q * q, axis=-1, keepdims=True))


@_group
def keep_unit(q: Array) -> Array:
    """``q``, of unit norm but for rounding, normalised by one Newton step without a division.

    Examples
    --------
    >>> import jaxekf, numpy as np
    >>> from jaxekf.geometry import rotation
    >>> jaxekf.set_up()
    >>> q = rotation.keep_unit(np.array([1.0 + 1e-8, 0.0, 0.0, 0.0]))
    >>> bool(abs(q[0] - 1.0) < 1e-15)  # an error e becomes -1.5 e^2
    True
    """
    return q * (1.5 - 0.5 * jnp.sum(q * q, axis=-1, keepdims=True))


def pure(vector: Array) -> Array:
    """The quaternion with zero real part, shapes (..., 3) to (..., 4)."""
    return jnp.concatenate([jnp.zeros_like(vector[..., :1]), vector], axis=-1)


@jax.custom_jvp
def _reciprocal(x: Array) -> Array:
    """``1 / x`` whose derivatives are products: on a CPU each division is a kernel of its own."""
    return 1.0 / x


@_reciprocal.defjvp
def _reciprocal_jvp(primals: tuple[Array], tangents: tuple[Array]) -> tuple[Array, Array]:
    inverse = _reciprocal(*primals)
    return inverse, -inverse * inverse * tangents[0]


def _half_angle(delta: Array) -> tuple[Array, Array]:
    """``cos(a / 2)`` and ``sin(a / 2) / a`` for ``a = |delta|``, shape (...).

    Up to half a turn both are series in the square, which is smooth at zero; beyond, whole turns are
    subtracted first. Many of these are evaluated together, and a CPU has no vectorised sine of its
    own.
    """
    square = 0.25 * jnp.sum(delta * delta, axis=-1)
    within = square < (0.5 * np.pi) ** 2
    half = jnp.sqrt(jnp.where(within, 1.0, square))
    turns = jnp.round(half * (1.0 / np.pi))
    rest = (half - turns * _PI) - turns * _PI_REST
    series = jnp.where(within, square, rest * rest)
    both = _polynomial(series[..., None], _COSINE_AND_SINE)
    cosine, sine = both[..., 0], both[..., 1]
    sign = 1.0 - 2.0 * (turns - 2.0 * jnp.floor(0.5 * turns))
    return (
        jnp.where(within, cosine, sign * cosine),
        jnp.where(within, sine, sign * rest * sine * _reciprocal(half)),
    )


@_group
def exp(delta: Array) -> Array:
    """Quaternion of the rotation vector ``delta`` in radians, shapes (..., 3) to (..., 4).

    Examples
    --------
    >>> import jaxekf, numpy as np
    >>> from jaxekf.geometry import rotation
    >>> jaxekf.set_up()
    >>> quarter_turn_about_z = rotation.exp(np.array([0.0, 0.0, np.pi / 2]))
    >>> np.allclose(quarter_turn_about_z, np.sqrt([0.5, 0.0, 0.0, 0.5]))
    True
    """
    cosine, sine = _half_angle(delta)
    return jnp.concatenate([cosine[..., None], sine[..., None] * delta], axis=-1)


@_group
def log(q: Array) -> Array:
    """Rotation vector in radians, of length at most pi, shapes (..., 4) to (..., 3).

    ``q`` and ``-q`` give the same vector: the one with ``w >= 0`` is used.

    Examples
    --------
    >>> import jaxekf, numpy as np
    >>> from jaxekf.geometry import rotation
    >>> jaxekf.set_up()
    >>> quarter_turn_about_z = np.sqrt([0.5, 0.0, 0.0, 0.5])
    >>> np.rad2deg(rotation.log(quarter_turn_about_z)).round(9).tolist()
    [0.0, 0.0, 90.0]
    """
    flip = jnp.where(q[..., :1] < 0.0, -1.0, 1.0)
    q = q * flip
    w, vector = q[..., 0], q[..., 1:]
    squared = jnp.sum(vector * vector, axis=-1)
    small = squared < _SMALL_TANGENT_SQUARED * w * w
    w_series = jnp.where(small, w, 1.0)
    w_inverse = _reciprocal(w_series)
    tangent = jnp.where(small, squared, 0.0) * w_inverse * w_inverse
    series = _polynomial(tangent, (1.0, -1 / 3, 1 / 5, -1 / 7, 1 / 9, -1 / 11, 1 / 13, -1 / 15))
    length = jnp.sqrt(jnp.where(small, 1.0, squared))
    factor = jnp.where(
        small, 2.0 * series * w_inverse, 2.0 * jnp.arctan2(length, w) * _reciprocal(length)
    )
    return factor[..., None] * vector


@_group
def rotate(q: Array, vector: Array) -> Array:
    """``vector`` rotated by ``q``, body to reference coordinates, shapes (..., 4), (..., 3) to (..., 3).

    Examples
    --------
    >>> import jaxekf, numpy as np
    >>> from jaxekf.geometry import rotation
    >>> jaxekf.set_up()
    >>> q_ref_body = np.sqrt([0.5, 0.0, 0.0, 0.5])  # a quarter turn about z
    >>> x_of_body = np.array([1.0, 0.0, 0.0])
    >>> np.allclose(rotation.rotate(q_ref_body, x_of_body), [0.0, 1.0, 0.0])  # y of the reference
    True
    """
    imaginary = q[..., 1:]
    twice_cross = 2.0 * cross(imaginary, vector)
    return vector + q[..., :1] * twice_cross + cross(imaginary, twice_cross)


@_group
def rotate_inverse(q: Array, vector: Array) -> Array:
    """``vector`` rotated by the inverse of ``q``, reference to body coordinates.

    Examples
    --------
    >>> import jaxekf, numpy as np
    >>> from jaxekf.geometry import rotation
    >>> jaxekf.set_up()
    >>> q_ref_body = np.sqrt([0.5, 0.5, 0.0, 0.0])  # a quarter turn about x
    >>> up_ref = np.array([0.0, 0.0, 1.0])
    >>> np.allclose(rotation.rotate_inverse(q_ref_body, up_ref), [0.0, 1.0, 0.0])  # y of the body
    True
    """
    return rotate(conjugate(q), vector)


@_group
def to_matrix(q: Array) -> Array:
    """Rotation matrix ``R`` with ``v_ref = R @ v_body``, shapes (..., 4) to (..., 3, 3).

    Examples
    --------
    >>> import jaxekf, numpy as np
    >>> from jaxekf.geometry import rotation
    >>> jaxekf.set_up()
    >>> quarter_turn_about_z = np.sqrt([0.5, 0.0, 0.0, 0.5])
    >>> matrix = rotation.to_matrix(quarter_turn_about_z)
    >>> np.allclose(matrix, [[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    True
    """
    w, v = q[..., :1, None], q[..., 1:]
    outer = v[..., :, None] * v[..., None, :]
    real = 1.0 - 2.0 * jnp.sum(v * v, axis=-1)[..., None, None]
    identity = jnp.eye(3, dtype=q.dtype).reshape((1,) * (q.ndim - 1) + (3, 3))
    return real * identity + 2.0 * (outer + w * skew(v))


def from_matrix(matrix: Array) -> Array:
    """Quaternion with ``w >= 0`` of the rotation matrix ``R``, shapes (..., 3, 3) to (..., 4).

    Shepperd's method: the entries of ``R`` give ``4 q q'``, and the row of the largest component is
    used, so that no small number is a divisor, not even at 180 degrees. `matrix` is not checked for
    being a rotation.

    Examples
    --------
    >>> import jax, numpy as np
    >>> from jaxekf.geometry import rotation
    >>> half_turn_about_x = np.diag([1.0, -1.0, -1.0])
    >>> jax.jit(rotation.from_matrix)(half_turn_about_x).tolist()
    [0.0, 1.0, 0.0, 0.0]
    """
    (a, b, c), (d, e, f), (g, h, i) = (tuple(matrix[..., j, k] for k in range(3)) for j in range(3))
    rows = [
        [1 + a + e + i, h - f, c - g, d - b],
        [h - f, 1 + a - e - i, d + b, c + g],
        [c - g, d + b, 1 - a + e - i, h + f],
        [d - b, c + g, h + f, 1 - a - e + i],
    ]
    best, chosen = rows[0][0], jnp.stack(rows[0], axis=-1)
    for j in range(1, 4):
        larger = rows[j][j] > best
        best = jnp.where(larger, rows[j][j], best)
        chosen = jnp.where(larger[..., None], jnp.stack(rows[j], axis=-1), chosen)
    q = normalise(chosen)
    return jnp.where(q[..., :1] < 0.0, -q, q)


@_group
def align(q: Array, near: Array) -> Array:
    """``q`` or ``-q``, whichever is nearer to the quaternion `near`, shapes (..., 4).

    Examples
    --------
    >>> import numpy as np
    >>> from jaxekf.geometry import rotation
    >>> measured = np.array([-1.0, 0.0, 0.0, 0.0])  # the same rotation as the identity
    >>> np.allclose(rotation.align(measured, rotation.identity()), [1.0, 0.0, 0.0, 0.0])
    True
    """
    return jnp.where(jnp.sum(q * near, axis=-1, keepdims=True) < 0.0, -q, q)


def difference(q: Array, r: Array) -> Array:
    """Rotation vector from ``q`` to ``r`` in the body frame of ``q``: ``log(conj(q) * r)``.

    Examples
    --------
    >>> import jaxekf, numpy as np
    >>> from jaxekf.geometry import rotation
    >>> jaxekf.set_up()
    >>> q, delta = rotation.exp(np.array([0.5, 0.0, -1.0])), np.array([0.0, 0.2, 0.0])
    >>> r = rotation.product(q, rotation.exp(delta))
    >>> np.allclose(rotation.difference(q, r), delta)
    True
    """
    return log(product(conjugate(q), r))


def skew(vector: Array) -> Array:
    """Matrix of the cross product, ``skew(a) @ b == cross(a, b)``, shapes (..., 3) to (..., 3, 3)."""
    return jnp.tensordot(vector, jnp.asarray(_SKEW, vector.dtype), axes=1)


def right_jacobian(delta: Array) -> Array:
    """``J`` with ``exp(delta + e) ~ exp(delta) * exp(J @ e)``, shapes (3,) to (3, 3).

    ``I - (1 - cos a) / a^2 [delta] + (a - sin a) / a^3 [delta]^2`` (Sola, Deray, Atchuthan 2018, eq. 143),
    by half the angle, as `exp` has it: ``1 - cos a = 2 sin^2(a / 2)``, ``sin a = 2 sin(a / 2) cos(a / 2)``.

    Examples
    --------
    >>> import jax, jaxekf, numpy as np
    >>> from jaxekf.geometry import rotation
    >>> jaxekf.set_up()
    >>> delta, e = np.array([0.3, -0.2, 0.5]), np.array([1e-6, 2e-6, -1e-6])
    >>> moved = rotation.difference(rotation.exp(delta), rotation.exp(delta + e))
    >>> np.allclose(moved, jax.jit(rotation.right_jacobian)(delta) @ e, rtol=1e-5, atol=0.0)
    True
    """
    cosine, sine = _half_angle(delta)
    squared = jnp.sum(delta * delta)
    small = squared < _SMALL_ANGLE_SQUARED
    series = jnp.where(small, squared, 0.0)
    second = jnp.where(
        small,
        _polynomial(series, (1 / 6, -1 / 120, 1 / 5040, -1 / 362880, 1 / 39916800)),
        (1.0 - 2.0 * sine * cosine) * _reciprocal(jnp.where(small, 1.0, squared)),
    )
    return _with_skew(delta, -2.0 * sine * sine, second)


def inverse_right_jacobian(delta: Array) -> Array:
    """Inverse of `right_jacobian`, for vectors up to half a turn, shapes (3,) to (3, 3).

    ``I + [delta] / 2 + (1 - (a / 2) cot(a / 2)) / a^2 [delta]^2`` (Sola, Deray, Atchuthan 2018, eq. 144).

    Examples
    --------
    >>> import jax, jaxekf, numpy as np
    >>> from jaxekf.geometry import rotation
    >>> jaxekf.set_up()
    >>> delta = np.array([0.3, -0.2, 0.5])
    >>> jacobian = jax.jit(rotation.right_jacobian)(delta)
    >>> inverse = jax.jit(rotation.inverse_right_jacobian)(delta)
    >>> np.allclose(inverse @ jacobian, np.eye(3))
    True
    """
    cosine, sine = _half_angle(delta)
    squared = jnp.sum(delta * delta)
    small = squared < _SMALL_ANGLE_SQUARED
    series = jnp.where(small, squared, 0.0)
    second = jnp.where(
        small,
        _polynomial(series, (1 / 12, 1 / 720, 1 / 30240, 1 / 1209600, 1 / 47900160)),
        (1.0 - 0.5 * cosine * _reciprocal(sine)) * _reciprocal(jnp.where(small, 1.0, squared)),
    )
    return _with_skew(delta, 0.5 * jnp.ones_like(squared), second)


def _with_skew(delta: Array, first: Array, second: Array) -> Array:
    """``I + first [delta] + second [delta]^2``, where ``[delta]^2 = delta delta' - |delta|^2 I``."""
    real = 1.0 - second * jnp.sum(delta * delta)
    outer = delta[:, None] * delta[None]
    return real * jnp.eye(3, dtype=delta.dtype) + second * outer + first * skew(delta)
