"""Angular velocity from the differences of accelerometers on one rigid body, without a gyroscope.

Ang, Khosla, Riviere, eqs. 1 to 6, for any number and placement of axes (`placement`). The angular
acceleration is eq. 3's backward difference with the rate before known, ``alpha = (omega(t) -
omega(t - T)) / T``, which leaves ``omega(t)`` as three unknowns whose residuals are quadratic.

The rate is integrated, so its error is too: it goes on by `RateEstimate.transition` at each sample,
which grows or decays with rate and geometry: with six axes and rates of 20 rad/s by many powers of
ten in seconds, with twelve by far less. Something else, such as an attitude, must bound it, or
the rate is led back to zero as it goes (`forget_s` of `track`).
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array, lax

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
# A solution is meant if it is at most this many times as far from the rate before as the nearest one.
_AS_FAR = 10.0


class RateEstimate(NamedTuple):
    """Angular velocity at one sample, in the body frame; `track` puts samples on the first axis."""

    rate: Array
    """Angular velocity (3,), rad/s."""
    covariance: Array
    """Its covariance (3, 3), (rad/s)^2, to first order; of `rate` given the one before, unless that
    one's covariance was given."""
    transition: Array
    """Derivative (3, 3) of `rate` by the rate one interval before, for small residuals."""
    cost: Array
    """Sum of squared residuals in units of the noise, (); `Differences.independent` less 3 on average."""
    degenerate: Array
    """The array cannot tell all of the angular acceleration, wherever it is at, ()."""
    singular: Array
    """At this rate the readings do not determine it, to first order, ()."""
    ambiguous: Array
    """Another rate fits as well, (): the opposite one, where the angular acceleration is too small a
    part of the readings to tell their sign, or one not much further from the rate before."""
    converged: Array
    """Whether the search came to an end, ()."""

    @property
    def valid(self) -> Array:
        """Whether none of the flags speaks against the rate."""
        return self.converged & ~(self.degenerate | self.singular | self.ambiguous)


def angular_rate(
    prepared: Differences,
    readings: Array,
    rate_before: Array,
    interval: Array | float,
    covariance_before: Array | None = None,
) -> RateEstimate:
    """The angular velocity that explains one sample of an array, nearest to the one before.

    `readings` (n,), m/s^2, of the axes in the order of the array; `rate_before` (3,), rad/s, one
    `interval` () in s earlier, with its covariance (3, 3) or None for exactly known. Differentiable by
    every number given, forward and reverse, and finite also where flags are raised. An `interval` of
    infinity leaves the angular acceleration out: then two opposite rates fit and `ambiguous` is set.
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
        _has_rival(*lax.stop_gradient((problem, rate, cost, rate_before, factors))),
        converged,
    )


def _has_rival(
    problem: Quadratic, rate: Array, cost: Array, before: Array, factors: Factors
) -> Array:
    """Whether another rate near enough to be meant fits as well, which only searches can tell.

    The residuals at rates a and b differ by exactly ``J((a + b) / 2) @ (a - b)``, J the Jacobian. So
    where J stays regular, all the way to the opposite rate and several times as far as the rate moved,
    there is no other, and nothing is searched. It does where, in the coordinates in which J at `rate` is
    the identity, it changes by less than one.
    """
    moved = jnp.sqrt(jnp.sum((rate - before) ** 2))
    reach = jnp.maximum(jnp.sqrt(jnp.sum(rate * rate)), 0.5 * (1.0 + _AS_FAR) * moved)
    curved = problem.curved.reshape(-1, 9)
    seen = multiply(factors.basis.T, curved).reshape(3, 3, 3)
    change = multiply(factors.inverse.T, seen.swapaxes(0, 1).reshape(3, 9))
    regular = ~factors.weak & (2.0 * reach * jnp.sqrt(jnp.sum(change**2)) < 1.0)

    def search() -> Array:
        across = rate + _across(problem, rate, factors, reach)
        others, found = jax.vmap(lambda x: descend(problem, x))(jnp.stack([-rate, across]))
        costs = jax.vmap(lambda other: jnp.sum(problem.residual(other) ** 2))(others)
        apart = jnp.max(jnp.abs(others - rate[None]), axis=1)
        elsewhere = apart > _SAME * (1.0 + jnp.max(jnp.abs(rate)))
        gone = jnp.sqrt(jnp.sum((others - before[None]) ** 2, axis=1))
        # The first search may end anywhere, the second only at a rate that may be meant.
        meant = jnp.stack([jnp.asarray(True), gone[1] <= _AS_FAR * moved])
        return jnp.any(found & elsewhere & meant & (costs <= cost + _DECIDED))

    return lax.cond(regular, lambda: jnp.asarray(False), search)


def _across(problem: Quadratic, rate: Array, factors: Factors, reach: Array) -> Array:
    """From `rate` to where, along the least determined direction, the residuals are the same again (3,).

    Zero where that is out of `reach`.
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
    """Angular velocity at every sample of `readings` (N, n), m/s^2, each from the one before.

    `noise` as in `placement.differences`. `start_rate` (3,), rad/s, is the one an `interval` before the
    first sample; `interval`, s, is one number () or one for each sample (N,). With `start_covariance`
    (3, 3) the covariances are those of the whole way; without it, of each step.

    With `forget_s`, (), s, the rate before is led back to zero with that time constant, so that error
    does not add up for ever: white noise of the angular acceleration of density ``d``, rad/s^2/sqrt(Hz),
    leaves ``d sqrt(forget_s / 2)`` in place of ``d sqrt(time)``; `covariance` is of that noise alone. The
    part of the rate that is slower is missing; `restored` adds it again. Rates and errors of more than
    some ``1 / forget_s`` that last make the recursion run away all the same.
    """
    readings, start_rate = jnp.asarray(readings), jnp.asarray(start_rate)
    n = jnp.shape(array.axes)[0]
    if readings.ndim != 2 or readings.shape[1] != n:
        raise ValueError(
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
    """Rates (N, 3), rad/s, of `track` with what it forgot added again; the other arguments as there.

    They are the sums of the angular accelerations that the readings told, so that slow motion is whole
    and noise is a random walk again. But the walk does not go back into the recursion: only the
    centripetal part of each sample uses the rate that was led back. This is what suits a filter
    that estimates a bias which walks.
    """
    rate = jnp.asarray(rate)
    intervals = jnp.broadcast_to(jnp.asarray(interval, rate.dtype), rate.shape[:1])
    before = jnp.concatenate([jnp.asarray(start_rate, rate.dtype)[None], rate[:-1]])
    return rate - jnp.cumsum(jnp.expm1(-intervals / forget_s)[:, None] * before, axis=0)
