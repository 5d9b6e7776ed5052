"""Angular rate from the differences of accelerometers on one rigid body, without a gyroscope.

The method is that of Ang, Khosla, Riviere, eqs. 1 to 6, for any number and placement of axes
(`accelerometer_array`). The angular acceleration is eq. 3's backward difference with the previous rate,
``alpha = (omega(t) - omega(t - T)) / T``, so ``omega(t)`` is three unknowns with quadratic residuals.

The rate is an integral, and its error is integrated, too: each sample multiplies it by
`RateEstimate.transition`, which grows or decays with rate and geometry. With six axes and rates of 20 rad/s
it grows by many powers of ten within seconds, with twelve axes by far less. Another measurement, such as an
attitude, must bound the error, or the rate decays to zero with a time constant (`forget_s` of `track`).
`restored` adds the forgotten part again.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array, lax

from jaxekf._support.errors import ArgumentError
from jaxekf.geometry.linalg import multiply, multiply_transposed, symmetrise
from jaxekf.geometry.quadratic_least_squares import (
    Factors,
    Quadratic,
    descend,
    minimise,
    orthogonalise,
)
from jaxekf.pose_solvers.accelerometer_array import AccelerometerArray, Differences, differences

# Another solution counts as equally good if its squared residuals are larger by less: 3 sigma.
_DECIDED = 9.0
# Closer than this, relative, it is the same solution.
_SAME = 1e-5
# A solution is plausible if it is at most this many times as far from the previous rate as the nearest.
_AS_FAR = 10.0


class RateEstimate(NamedTuple):
    """Angular rate at one sample, body frame; `track` has samples on the first axis."""

    rate: Array
    """(3,) rad/s."""
    covariance: Array
    """(3, 3), (rad/s)^2, to first order; conditional on the previous rate unless its covariance was
    given."""
    transition: Array
    """Derivative (3, 3) of `rate` by the previous rate, for small residuals."""
    cost: Array
    """Sum of squared residuals in units of the noise, (); its mean is `Differences.independent` minus 3."""
    degenerate: Array
    """Whether the array does not determine the angular acceleration, at any rate, ()."""
    singular: Array
    """Whether the readings do not determine this rate to first order, ()."""
    ambiguous: Array
    """Whether another rate fits as well, (): the opposite one, if the angular acceleration is too small to
    determine the sign, or one not much farther from the previous rate."""
    converged: Array
    """Whether the search converged, ()."""

    @property
    def valid(self) -> Array:
        """Whether the search converged and no flag is set."""
        return self.converged & ~(self.degenerate | self.singular | self.ambiguous)


def angular_rate(
    prepared: Differences,
    readings: Array,
    rate_before: Array,
    interval: Array | float,
    covariance_before: Array | None = None,
) -> RateEstimate:
    """Angular rate that explains one sample of an array, nearest to the previous rate.

    The result is differentiable by all arguments, forward and reverse, and finite also if a flag is set.

    Parameters
    ----------
    prepared
        Result of `accelerometer_array.differences`.
    readings
        (n,) m/s^2, in the order of the array.
    rate_before
        (3,) rad/s, one interval earlier.
    interval
        () s. Infinity removes the angular acceleration: then two opposite rates fit, and `ambiguous`
        is set.
    covariance_before
        (3, 3) covariance of `rate_before`; None if it is exact.
    """
    rate_before = jnp.asarray(rate_before)
    linear = prepared.linear / interval
    problem = Quadratic(
        -linear @ rate_before - prepared.whitening @ readings, linear, prepared.quadratic
    )
    rate, converged = minimise(problem, lax.stop_gradient(rate_before))
    residual = problem.residual(rate)
    factors = orthogonalise(problem.jacobian(rate), residual)
    transition = multiply(factors.inverse, multiply(factors.basis.T, linear))
    cov = multiply_transposed(factors.large, factors.large)
    if covariance_before is not None:
        carried = multiply_transposed(covariance_before, transition)
        cov = cov + multiply(transition, carried)
    cost = jnp.sum(residual * residual)
    return RateEstimate(
        rate,
        symmetrise(cov),
        transition,
        cost,
        prepared.degenerate,
        factors.weak,
        _has_second_solution(*lax.stop_gradient((problem, rate, cost, rate_before, factors))),
        converged,
    )


def _has_second_solution(
    problem: Quadratic, rate: Array, cost: Array, before: Array, factors: Factors
) -> Array:
    """Whether another rate near enough fits as well, which in general only a search decides.

    The residuals at rates a and b differ by exactly ``J((a + b) / 2) @ (a - b)``, J the Jacobian. So
    if J stays regular as far as the opposite rate, and several times as far as the rate has changed,
    there is no other solution and no search. J stays regular if, in the coordinates in which J at
    `rate` is the identity, it changes by less than one.
    """
    moved = jnp.sqrt(jnp.sum((rate - before) ** 2))
    reach = jnp.maximum(jnp.sqrt(jnp.sum(rate * rate)), 0.5 * (1.0 + _AS_FAR) * moved)
    curved = problem.curved.reshape(-1, 9)
    projected = multiply(factors.basis.T, curved).reshape(3, 3, 3)
    change = multiply(factors.inverse.T, projected.swapaxes(0, 1).reshape(3, 9))
    regular = ~factors.weak & (2.0 * reach * jnp.sqrt(jnp.sum(change**2)) < 1.0)

    def search() -> Array:
        across = rate + _step_across(problem, rate, factors, reach)
        others, found = jax.vmap(lambda x: descend(problem, x))(jnp.stack([-rate, across]))
        costs = jax.vmap(lambda other: jnp.sum(problem.residual(other) ** 2))(others)
        apart = jnp.max(jnp.abs(others - rate[None]), axis=1)
        elsewhere = apart > _SAME * (1.0 + jnp.max(jnp.abs(rate)))
        distance = jnp.sqrt(jnp.sum((others - before[None]) ** 2, axis=1))
        # The first search may end anywhere, the second only at a plausible rate.
        plausible = jnp.stack([jnp.asarray(True), distance[1] <= _AS_FAR * moved])
        return jnp.any(found & elsewhere & plausible & (costs <= cost + _DECIDED))

    return lax.cond(regular, lambda: jnp.asarray(False), search)


def _step_across(problem: Quadratic, rate: Array, factors: Factors, reach: Array) -> Array:
    """Step (3,) from `rate` along the least determined direction to where the residuals are the same again.

    It is zero if that is out of `reach`.
    """
    spread = factors.large @ factors.large.T
    for _ in range(3):
        spread = spread / jnp.trace(spread)
        spread = spread @ spread
    weakest = spread[jnp.argmax(jnp.diagonal(spread))]
    weakest = weakest / jnp.sqrt(jnp.sum(weakest * weakest))
    slope = problem.jacobian(rate) @ weakest
    bend = jnp.dot(slope, jnp.einsum("ijk,j,k->i", problem.curved, weakest, weakest))
    length = -jnp.dot(slope, slope) / jnp.where(bend == 0.0, 1.0, bend)
    near = (bend != 0.0) & (jnp.abs(length) <= 4.0 * reach)
    return jnp.where(near, length, 0.0) * weakest


def track(
    array: AccelerometerArray,
    noise: Array | float,
    readings: Array,
    start_rate: Array,
    interval: Array | float,
    start_covariance: Array | None = None,
    forget_s: Array | float | None = None,
) -> RateEstimate:
    """Angular rate at every sample, each from the previous one.

    With `forget_s` the previous rate decays to zero with that time constant, so that errors do not
    accumulate: white noise of the angular acceleration of density ``d``, rad/s^2/sqrt(Hz), gives the
    rate a standard deviation of ``d sqrt(forget_s / 2)`` instead of ``d sqrt(time)``; `covariance` is
    of that noise alone. The slower part of the rate is lost; `restored` adds it again. Persistent
    rates and errors above about ``1 / forget_s`` still make the recursion diverge.

    Parameters
    ----------
    array
        The array.
    noise
        As in `accelerometer_array.differences`.
    readings
        (N, n) m/s^2.
    start_rate
        (3,) rad/s, one interval before the first sample.
    interval
        s, () or one for each sample (N,).
    start_covariance
        (3, 3) covariance of `start_rate`; with it, covariances accumulate, without it they are of
        each step.
    forget_s
        Time constant, s, ().

    Raises
    ------
    ArgumentError
        If the number of columns is not that of the axes.
    """
    readings, start_rate = jnp.asarray(readings), jnp.asarray(start_rate)
    n = jnp.shape(array.axes)[0]
    if readings.ndim != 2 or readings.shape[1] != n:
        raise ArgumentError(
            f"got readings of shape {readings.shape}, expected (N, {n}); give one column for each axis"
        )
    prepared = differences(array, noise)
    intervals = jnp.broadcast_to(jnp.asarray(interval, readings.dtype), readings.shape[:1])

    def advance(
        before: tuple[Array, Array | None], sample: tuple[Array, Array]
    ) -> tuple[tuple[Array, Array | None], RateEstimate]:
        rate, cov = before
        if forget_s is None:
            found = angular_rate(prepared, sample[0], rate, sample[1], cov)
        else:
            kept = jnp.exp(-sample[1] / forget_s)
            cov = None if cov is None else kept * kept * cov
            found = angular_rate(prepared, sample[0], kept * rate, sample[1], cov)
            found = found._replace(transition=kept * found.transition)
        return (found.rate, None if cov is None else found.covariance), found

    return jax.lax.scan(advance, (start_rate, start_covariance), (readings, intervals))[1]


def restored(
    rate: Array, start_rate: Array, interval: Array | float, forget_s: Array | float
) -> Array:
    """Rates (N, 3), rad/s, of `track` with the forgotten part added again.

    They are the sums of the measured angular accelerations, so slow motion is complete and noise is a
    random walk. The random walk does not enter the recursion: only the centripetal part of each
    sample uses the decayed rate. This suits a filter that estimates a random-walk bias.

    Parameters
    ----------
    rate
        (N, 3) rad/s, of `track`.
    start_rate, interval, forget_s
        As in `track`.
    """
    rate = jnp.asarray(rate)
    intervals = jnp.broadcast_to(jnp.asarray(interval, rate.dtype), rate.shape[:1])
    before = jnp.concatenate([jnp.asarray(start_rate, rate.dtype)[None], rate[:-1]])
    return rate - jnp.cumsum(jnp.expm1(-intervals / forget_s)[:, None] * before, axis=0)
