"""One step of the filter on lanes: predict, compare, update."""

import operator
from functools import partial, reduce
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array, lax

from jaxekf.filtering import _covariance_algebra as covariance_algebra
from jaxekf.filtering import _gating as gating
from jaxekf.filtering import _repeated_groups as repeated_groups
from jaxekf.filtering._covariance_algebra import Gained
from jaxekf.filtering._gating import Judged, Linear
from jaxekf.filtering._lowered_model import Measurement, System
from jaxekf.filtering.lowering import structured_matrix
from jaxekf.filtering.lowering.structured_matrix import Bands, Pattern
from jaxekf.filtering.model import Belief
from jaxekf.filtering.steps import Rows
from jaxekf.geometry import linalg


class Moment(NamedTuple):
    """What a substep is given besides samples."""

    dt: Array
    u: Any


class Track(NamedTuple):
    """What is carried from one substep to the next."""

    belief: Belief
    refused: Array | None
    """(lanes,) seconds of samples that gates have refused since they last let one in; None without
    gates."""


class Outcome(NamedTuple):
    """What one substep leaves behind."""

    prior: Belief
    after: Track
    log_likelihood: Array
    healthy: Array
    used: dict[str, Array]
    """By sensor: (rows, lanes) rows that entered the update."""
    gated: dict[str, Array]
    recovered: Array | None
    """(lanes,) where the gates were opened and the belief widened; None without gates."""


def begin(system: System, belief: Belief, refused: Array | None) -> Track:
    """The track at the start of a run, `refused` seconds (lanes,) into refusing samples; None for 0."""
    if not system.is_gated:
        return Track(belief, None)
    if refused is None:
        refused = jnp.zeros(belief.cov.shape[-1], belief.cov.dtype)
    return Track(belief, refused)


def predict(
    system: System, prepared: Any, belief: Belief, moment: Moment, *, adjoint: bool
) -> Belief:
    """The belief at the end of the substep: ``P = F P F' + G Sigma G'``.

    With `adjoint` reverse derivatives are the closed forms of `jaxekf.filtering._covariance_algebra`;
    without, every derivative is JAX's own.
    """
    transition = system.transition
    mean, f, g = transition.piece(
        prepared["transition"], belief.mean, moment.u, moment.dt, adjoint=adjoint
    )
    (sigma,) = transition.sigma(prepared["process noise"], moment.dt, adjoint=adjoint)
    patterns = (transition.state, transition.noise)
    if adjoint:
        return Belief(
            mean, covariance_algebra.predicted_with_adjoint(*patterns)(f, g, belief.cov, sigma)
        )
    return Belief(mean, covariance_algebra.predicted(*patterns, f, g, belief.cov, sigma))


def update(
    system: System,
    prepared: Any,
    ahead: Track,
    u: Any,
    samples: dict[str, Rows],
    *,
    adjoint: bool,
) -> Outcome:
    """Take every sensor sampled at the end of a substep; `adjoint` as in `predict`."""
    prior = ahead.belief
    judged, cov = look(system, prepared, ahead, u, samples, adjoint=adjoint)
    linear = judged.linear
    used = {name: repeated_groups.flat(one.rows.mask) for name, one in linear.items()}
    gated = {name: repeated_groups.flat(mask) for name, mask in judged.gated.items()}
    lanes, dtype = prior.cov.shape[-1], prior.cov.dtype
    if not linear:
        nothing, sound = jnp.zeros(lanes, dtype), _is_sound(prior.cov)
        never = None if ahead.refused is None else jnp.zeros(lanes, bool)
        return Outcome(prior, ahead, nothing, sound, used, gated, never)
    gained = Gained(cov, jnp.zeros(cov.shape[1:], dtype), jnp.zeros(lanes, dtype))
    smallest = jnp.ones(lanes, dtype)
    for one in linear.values():
        gained, pivot = take_block(one.slope, gained, one.rows, adjoint)
        smallest = jnp.minimum(smallest, pivot)
    posterior = _correct(system, prepared["correction"], prior, gained, any_used(linear), adjoint)
    if system.again is not None:
        widened = Belief(prior.mean, cov)
        posterior, pivot = system.again(
            prepared["again"], widened, posterior, u, samples, linear, adjoint=adjoint
        )
        smallest = jnp.minimum(smallest, pivot)
    healthy = (smallest > 0.0) & _is_sound(posterior.cov)
    after = Track(posterior, judged.refused)
    told = (used, gated, judged.recovered)
    return Outcome(prior, after, gained.log_likelihood, healthy, *told)


def look(
    system: System,
    prepared: Any,
    ahead: Track,
    u: Any,
    samples: dict[str, Rows],
    *,
    adjoint: bool,
) -> tuple[Judged, Array]:
    """Every sensor linearised at the prediction and judged by gates and weights; and the predicted
    covariance, widened where the gates were opened."""
    prior = ahead.belief
    seen: dict[str, Linear] = {}
    for name, sample in samples.items():
        measurement = system.measurements[name]
        constants = prepared[f"sensor {name}"]
        found = measurement(constants, prior.mean, u, sample, adjoint=adjoint)
        seen[name] = hide(measurement, *found, sample.mask)
    judged = gating.judge(system, seen, samples, prior.cov, ahead.refused)
    cov = prior.cov if judged.widened is None else prior.cov * judged.widened[None, None]
    return judged, cov


def _is_sound(cov: Array) -> Array:
    """Whether all variances are finite and not negative."""
    smallest = largest = cov[0, 0]
    for i in range(1, cov.shape[0]):
        smallest = jnp.minimum(smallest, cov[i, i])
        largest = jnp.maximum(largest, cov[i, i])
    return (smallest >= 0.0) & (largest < jnp.inf)


def hide(
    measurement: Measurement, residual: Array, slope: Bands, noise: Array, mask: Array
) -> Linear:
    """Hidden rows made inert: no slope and no noise, whatever their numbers are."""
    if repeated_groups.are_many(residual):
        mask = mask.reshape(residual.shape)
        hidden = jax.vmap(partial(_hide, measurement))(residual, slope, noise, mask)
    else:
        hidden = _hide(measurement, residual, slope, noise, mask)
    return Linear(measurement.slope, hidden)


def _hide(
    measurement: Measurement, residual: Array, slope: Bands, noise: Array, mask: Array
) -> covariance_algebra.Rows:
    bands = [
        jnp.where(structured_matrix.take(mask, rows, 0)[:, None], band, 0.0)
        for band, (rows, _) in zip(slope, measurement.slope.bands, strict=True)
    ]
    both = mask if measurement.diagonal else mask[:, None] & mask[None]
    return covariance_algebra.Rows(residual, tuple(bands), jnp.where(both, noise, 0.0), mask)


def take_block(
    slope: Pattern, gained: Gained, rows: covariance_algebra.Rows, adjoint: bool
) -> tuple[Gained, Array]:
    """A block of rows taken, and the smallest variance of an innovation met."""
    if repeated_groups.are_many(rows.mask):

        def one(carry: tuple[Gained, Array], rows: covariance_algebra.Rows) -> tuple[Any, None]:
            gained, pivot = take_block(slope, carry[0], rows, adjoint)
            # Rounding that is not symmetric grows from one group to the next.
            gained = gained._replace(cov=linalg.symmetrise(gained.cov))
            return (gained, jnp.minimum(carry[1], pivot)), None

        return lax.scan(one, (gained, jnp.ones_like(gained.log_likelihood)), rows)[0]
    slope, rows, determinant = covariance_algebra.whitened(slope, rows)
    if determinant is not None:
        gained = gained._replace(log_likelihood=gained.log_likelihood + determinant)
    if adjoint:
        return covariance_algebra.update_with_adjoint(slope)(gained, rows)
    return covariance_algebra.update(slope, gained, rows)


def take_keeping(
    slope: Pattern, gained: Gained, rows: covariance_algebra.Rows
) -> tuple[Gained, Any]:
    """A block of rows taken, and what the way back through it needs."""
    if repeated_groups.are_many(rows.mask):
        return lax.scan(lambda gained, rows: take_keeping(slope, gained, rows), gained, rows)
    slope, rows, _ = covariance_algebra.whitened(slope, rows)
    gained, _, taken, _ = covariance_algebra.take(slope, gained, rows)
    return gained, (rows, taken)


def any_used(linear: dict[str, Linear]) -> Array:
    """(lanes,) where any row of any sensor counts."""
    return reduce(operator.or_, [repeated_groups.any_row(one.rows.mask) for one in linear.values()])


def _correct(
    system: System, constants: Any, prior: Belief, gained: Gained, used: Array, adjoint: bool
) -> Belief:
    """The mean moved by the error vector and the covariance counted from there, where rows were `used`."""
    correction = system.correction
    mean, reset, _ = correction.piece(constants, prior.mean, gained.delta, used, adjoint=adjoint)
    if correction.reset.is_identity:
        # Symmetric but for rounding, which the next prediction ends.
        return Belief(mean, gained.cov)
    turn = partial(covariance_algebra.congruence, correction.reset)
    if adjoint:
        turn = covariance_algebra.congruence_with_adjoint(correction.reset)
    return Belief(mean, turn(reset, gained.cov))
