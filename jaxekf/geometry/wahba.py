"""Attitude from many directions known in two frames: Davenport's solution of Wahba's problem.

The covariance is Shuster's for QUEST, which solves the same problem. Every function is for one attitude;
use ``jax.vmap`` for many. Derivatives are finite everywhere, and zero where `Attitude.valid` is False.
`host_rotation.nearest_rotation` solves the same problem in NumPy.
"""

import jax.numpy as jnp
from jax import Array, lax

from jaxekf._support.errors import ArgumentError
from jaxekf.geometry import linalg, rotation
from jaxekf.geometry.triad import Attitude, attitude_or, default_threshold, directions, float_type


def q_method(
    body: Array,
    reference: Array,
    weights: Array | None = None,
    *,
    near: Array | None = None,
    fallback: Array | None = None,
    least_gap: Array | float | None = None,
) -> Attitude:
    """Least-squares attitude from directions: Davenport's q-method.

    It maximises ``sum(weight * reference . (R @ body))`` over unit vectors. With weights of one over
    the variance (rad^2) of each direction this is the maximum-likelihood attitude. The solution is
    the eigenvector of the largest eigenvalue of a symmetric 4 by 4 matrix. First and second
    derivatives are those of the optimum, not of the unused eigenvectors.

    Parameters
    ----------
    body, reference
        (n, 3) vectors, n >= 2, any length; zero and non-finite ones are ignored.
    weights
        (n,), equal by default; a direction of weight 0 is ignored.
    near, fallback
        As in `triad.triad`.
    least_gap
        Smallest gap between the two largest eigenvalues, as a share of the total weight, by default
        the square root of the rounding error. A smaller gap leaves a rotation undetermined (collinear
        or contradictory directions), and the result is `fallback`.

    Examples
    --------
    >>> import jax, jaxekf, numpy as np
    >>> from jaxekf.geometry import rotation, wahba
    >>> jaxekf.set_up()
    >>> q_ref_body = rotation.exp(np.array([0.3, 0.0, 0.1]))
    >>> reference = np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.6, 0.0, 0.8]])
    >>> body = rotation.rotate_inverse(q_ref_body, reference)
    >>> np.allclose(jax.jit(wahba.q_method)(body, reference).q_ref_body, q_ref_body)
    True
    """
    b, r, share = _pairs(body, reference, weights)
    profile = jnp.sum(share[:, None, None] * r[:, :, None] * b[:, None, :], axis=0)
    values, columns = jnp.linalg.eigh(lax.stop_gradient(_davenport(profile)))
    valid = values[3] - values[2] > default_threshold(least_gap, profile.dtype)
    q = jnp.where(valid, columns[:, 3], rotation.identity().astype(profile.dtype))
    profile = jnp.where(valid, profile, jnp.eye(3, dtype=profile.dtype))
    q = _with_derivatives(q, profile)
    return attitude_or(jnp.where(q[:1] < 0.0, -q, q), valid, near, fallback)


def q_method_covariance(
    body: Array,
    deviations: Array,
    weights: Array | None = None,
    *,
    least_gap: Array | float | None = None,
) -> Array:
    """Covariance (3, 3), rad^2, of the attitude error of `q_method`, to first order.

    The error is a rotation vector in the body frame. With weights of one over the squared deviations,
    the default, this is Shuster's ``inv(sum((I - b b') / deviation^2))``; any other weights give the
    covariance of the estimate with these weights.

    Parameters
    ----------
    body
        (n, 3) measured vectors, any length.
    deviations
        (n,) rad, standard deviation of each direction perpendicular to itself, isotropic, body and
        reference combined (root of the sum of squares). A direction with a deviation that is not
        positive and finite is ignored.
    weights
        (n,), positive.
    least_gap
        As in `q_method`.

    Returns
    -------
    (3, 3); the identity, a standard deviation of one radian, if a rotation is undetermined.

    Examples
    --------
    >>> import jax, jaxekf, numpy as np
    >>> from jaxekf.geometry import wahba
    >>> jaxekf.set_up()
    >>> cov = jax.jit(wahba.q_method_covariance)(np.eye(3), np.full(3, 0.01))
    >>> np.sqrt(np.diagonal(cov)).round(6).tolist()  # 0.01 / sqrt(2): two directions see each axis
    [0.007071, 0.007071, 0.007071]
    """
    deviations = jnp.asarray(deviations, float_type(body, deviations))
    positive = (deviations > 0.0) & jnp.isfinite(deviations)
    variances = jnp.where(positive, deviations, 1.0) ** 2
    chosen = 1.0 / variances if weights is None else jnp.asarray(weights, variances.dtype)
    b, _, share = _pairs(body, body, jnp.where(positive, chosen, 0.0))
    across = jnp.eye(3, dtype=b.dtype)[None] - b[:, :, None] * b[:, None, :]
    information = jnp.sum(share[:, None, None] * across, axis=0)
    noise = jnp.sum((share * share * variances)[:, None, None] * across, axis=0)
    # Its eigenvalues add up to 2 and none exceeds 1: the determinant is about the smallest, which is
    # half the gap of `q_method`.
    valid = 2.0 * linalg.adjugate(information)[1] > default_threshold(least_gap, b.dtype)
    inverse = _inverse(jnp.where(valid, information, jnp.eye(3, dtype=b.dtype)))
    return jnp.where(valid, linalg.congruence(inverse, noise), jnp.eye(3, dtype=b.dtype))


def _pairs(body: Array, reference: Array, weights: Array | None) -> tuple[Array, Array, Array]:
    """Unit vectors (n, 3) of both frames, and the relative weight (n,) of each pair."""
    dtype = float_type(body, reference)
    body, reference = jnp.asarray(body, dtype), jnp.asarray(reference, dtype)
    if body.ndim != 2 or body.shape[1] != 3 or body.shape != reference.shape:
        raise ArgumentError(
            f"got vectors of shapes {body.shape} and {reference.shape}, expected (n, 3) for both;"
            " for many attitudes use jax.vmap"
        )
    b, body_usable = directions(body)
    r, reference_usable = directions(reference)
    weight = jnp.ones(len(b), dtype) if weights is None else jnp.asarray(weights, dtype)
    used = body_usable & reference_usable & (weight > 0.0) & jnp.isfinite(weight)
    weight = jnp.where(used, weight, 0.0)
    total = jnp.sum(weight)
    return b, r, weight / jnp.where(total > 0.0, total, 1.0)


def _davenport(profile: Array) -> Array:
    """The matrix ``K`` (4, 4), w first, with ``q' K q = sum(share * r . (R(q) @ b))``.

    `profile` is ``sum(share * r b')`` (3, 3).
    """
    trace = jnp.trace(profile)
    z = _axial(profile)
    lower = profile + profile.T - trace * jnp.eye(3, dtype=profile.dtype)
    top = jnp.concatenate([trace[None], z])[None]
    return jnp.concatenate([top, jnp.concatenate([z[:, None], lower], axis=1)])


def _axial(profile: Array) -> Array:
    """``sum(share * cross(b, r))`` of ``sum(share * r b')``."""
    return jnp.stack(
        [
            profile[2, 1] - profile[1, 2],
            profile[0, 2] - profile[2, 0],
            profile[1, 0] - profile[0, 1],
        ]
    )


def _with_derivatives(q: Array, profile: Array) -> Array:
    """``q``, a constant, as a function of the `profile` that it solves.

    For a rotation by ``d``, with ``S = R' profile``, the objective grows by

        d . axial(S) - d' M d / 2

    with ``M`` being ``trace(S) I`` minus the symmetric part of ``S``. Steps ``inv(M) axial(S)`` change the
    value by rounding only. For a small change of `profile` with constant q, each step makes the solution
    right to one more order in that change, with ``M`` constant as well: two steps give first and second
    derivatives.
    """
    now = linalg.multiply(rotation.to_matrix(q).T, lax.stop_gradient(profile))
    curvature = jnp.trace(now) * jnp.eye(3, dtype=q.dtype) - linalg.symmetrise(now)
    inverse = _inverse(curvature)
    for _ in range(2):
        rotated = linalg.multiply(rotation.to_matrix(q).T, profile)
        half_step = 0.5 * jnp.sum(inverse * _axial(rotated)[None, :], axis=1)
        q = rotation.normalise(q + rotation.product(q, rotation.pure(half_step)))
    return q


def _inverse(matrix: Array) -> Array:
    """Inverse (3, 3), without a call to LAPACK."""
    adjugate, determinant = linalg.adjugate(matrix)
    return adjugate / determinant
