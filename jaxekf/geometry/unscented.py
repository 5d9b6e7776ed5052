"""The scaled unscented transform: mean and covariance of a function of a random vector.

The function is evaluated at ``2 n + 1`` points: the mean and, along each column of a factor of the
covariance, a step of ``sqrt(n + lambda)`` in both directions, ``lambda = alpha^2 (n + kappa) - n``. Means
of quadratic functions are exact, whereas a linearisation uses the linear part only.

Ang, Khosla and Riviere compute the covariance of an angular velocity in this way (eqs. 34 to 37), from
acceleration differences whose covariance is that of eq. 32. Corrections of the print: eqs. 34 and 35 give
the plain transform, not the scaled one, with the weight of the mean ``c_0 = kappa / (n + kappa)`` (``S_0``
is the point at distance 0, the measured differences) and all others ``1 / (2 (n + kappa))``. That is the
default here, ``alpha = 1, beta = 0``, and with ``n = 3`` the usual ``kappa = 3 - n`` is 0. In eq. 32 the
difference of two independent readings has twice the variance of one, not four times.

Covariances may be semidefinite. Derivatives with respect to mean and covariance are finite everywhere; a
direction without variance is left out, and a zero variance has zero gradient.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from jaxekf._support.errors import ArgumentError
from jaxekf.geometry import linalg, manifold


class Moments(NamedTuple):
    """Result of the transform.

    Examples
    --------
    >>> import jax, numpy as np
    >>> from jaxekf.geometry import unscented
    >>> @jax.jit
    ... def of_a_line(mean, cov):
    ...     return unscented.transform(lambda x: 2.0 * x + 1.0, mean, cov)
    >>> found = of_a_line(np.zeros(1), np.eye(1))
    >>> [round(np.asarray(part).item(), 4) for part in found]  # mean, cov, cross
    [1.0, 4.0, 2.0]
    """

    mean: Any
    """(m,); for `transform_on` a point of the output's space."""
    cov: Array
    """(m, m) covariance of the output, or of its error vector at `mean`."""
    cross: Array
    """(n, m) cross-covariance of the input, or of its error vector, with the output."""


def transform(
    fn: Callable[[Array], Array],
    mean: Array,
    cov: Array,
    *,
    alpha: float = 1.0,
    beta: float = 0.0,
    kappa: float = 0.0,
) -> Moments:
    """Mean, covariance and cross-covariance of ``fn(x)`` for a random vector ``x``.

    The weights of the points are

        mean          lambda / (n + lambda)
        covariance    lambda / (n + lambda) + 1 - alpha^2 + beta     of the point at the mean
        both          1 / (2 (n + lambda))                          of every other point

    With ``n + lambda = 3`` the fourth moments along the axes are those of a Gaussian. The covariance is
    positive semidefinite for ``beta >= alpha^2``, or ``kappa >= 0`` with ``alpha = 1``. A small `alpha`
    costs no digits but those of the differences of `fn` themselves. A `cov` that is not semidefinite
    gives NaN.

    Parameters
    ----------
    fn
        Takes (n,) to (m,).
    mean
        (n,) mean of ``x``.
    cov
        (n, n) covariance of ``x``.
    alpha
        Positive scale of the distance of the points from the mean.
    beta
        Added weight of the mean in the covariance; 2 is best for a Gaussian.
    kappa
        Second parameter of the distance, above -n.

    Raises
    ------
    ArgumentError
        If ``alpha^2 (n + kappa)`` is not positive, or if the shapes do not match.

    Examples
    --------
    >>> import jax, jaxekf, numpy as np
    >>> from jaxekf.geometry import unscented
    >>> jaxekf.set_up()
    >>> @jax.jit
    ... def of_a_square(mean, cov):
    ...     return unscented.transform(lambda x: x**2, mean, cov, kappa=2.0)
    >>> found = of_a_square(np.array([3.0]), np.array([[0.25]]))
    >>> np.allclose(found.mean, 3.0**2 + 0.25), np.allclose(found.cov, 36.0 * 0.25 + 2.0 * 0.25**2)
    (True, True)
    """
    mean, cov = jnp.asarray(mean), jnp.asarray(cov)
    size = mean.shape[0] if mean.ndim == 1 else -1
    if cov.shape != (size, size):
        raise ArgumentError(
            f"got a mean of shape {mean.shape} and a covariance of shape {cov.shape}, expected (n,)"
            " and (n, n); for many of them use jax.vmap"
        )
    squared_distance = alpha**2 * (size + kappa)
    if not squared_distance > 0.0:
        raise ArgumentError(
            f"got alpha = {alpha} and kappa = {kappa} for {size} numbers, expected"
            " alpha^2 (n + kappa) > 0; try alpha = 1 and kappa = 0"
        )
    distance = squared_distance**0.5
    factor = linalg.semidefinite_factor(cov)
    centre = fn(mean)
    steps = distance * factor.T
    ahead = jax.vmap(lambda step: fn(mean + step))(steps) - centre[None]
    behind = jax.vmap(lambda step: fn(mean - step))(steps) - centre[None]
    # Sums over pairs of points, counted from the value at the mean: the large weights of opposite sign
    # that a small alpha brings never meet. With s the mean's shift from the centre, the usual sum over
    # deviations from the mean is that of squares about the centre plus (beta - alpha^2) s s'.
    odd, even = (ahead - behind) / (2.0 * distance), (ahead + behind) / (2.0 * distance)
    shift = jnp.sum(even, axis=0) / distance
    spread = linalg.multiply(odd.T, odd) + linalg.multiply(even.T, even)
    about_mean = (beta - alpha**2) * shift[:, None] * shift[None, :]
    return Moments(
        centre + shift, linalg.symmetrise(spread + about_mean), linalg.multiply(factor, odd)
    )


def transform_on(
    fn: Callable[[Any], Any],
    mean: Any,
    cov: Array,
    space: Any,
    output_space: Any,
    *,
    alpha: float = 1.0,
    beta: float = 0.0,
    kappa: float = 0.0,
) -> Moments:
    """The same as `transform` for an input or output on manifolds, such as an attitude.

    Errors of the output are relative to ``fn(mean)``; the mean is that point moved by their mean, and the
    covariance is transformed to the new mean by the reset Jacobian. The result agrees with the mean on the
    manifold to the order of the transform.

    Parameters
    ----------
    fn
        Takes points of `space` to points of `output_space`.
    mean
        Point of `space`.
    cov
        (n, n) covariance of its error vector.
    space, output_space
        Manifolds or NamedTuples of manifolds (`jaxekf.geometry.manifold`).
    alpha, beta, kappa
        As in `transform`.

    Examples
    --------
    >>> import jax, jaxekf, numpy as np
    >>> from jaxekf.geometry import rotation, unscented
    >>> jaxekf.set_up()
    >>> so3, cov = jaxekf.SO3(), np.diag([1e-4, 4e-4, 9e-4])  # rad^2, body frame
    >>> @jax.jit
    ... def of_the_inverse(q, cov):
    ...     return unscented.transform_on(rotation.conjugate, q, cov, so3, so3)
    >>> np.allclose(of_the_inverse(rotation.identity(), cov).cov, cov)
    True
    """
    centre = fn(mean)

    def error_of(delta: Array) -> Array:
        return manifold.local(output_space, centre, fn(manifold.retract(space, mean, delta)))

    cov = jnp.asarray(cov)
    none = jnp.zeros(manifold.error_dim(space), cov.dtype)
    found = transform(error_of, none, cov, alpha=alpha, beta=beta, kappa=kappa)
    turn = manifold.reset_jacobian(output_space, found.mean)
    return Moments(
        manifold.retract(output_space, centre, found.mean),
        linalg.congruence(turn, found.cov),
        linalg.multiply_transposed(found.cross, turn),
    )
