"""One step of the filter on lanes: predict, compare, update."""

import operator
from functools import partial, reduce
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array, lax

from jaxekf import algebra, linalg, many, outliers, patterned
from jaxekf.algebra import Gained
from jaxekf.model import Belief
from jaxekf.outliers import Judged, Linear
from jaxekf.patterned import Pattern
from jaxekf.system import Measurement, System
from jaxekf.timeline import Rows

_LARGEST_BLOCK = 7


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

    With `adjoint` reverse derivatives are the closed forms of `jaxekf.algebra`; without, every
    derivative is JAX's own.
    """
    transition = system.transition
    mean, f, g, sigma = transition.piece(
        prepared["transition"], belief.mean, moment.u, moment.dt, adjoint=adjoint
    )
    cov = _congruence(transition.state, f, belief.cov, adjoint)
    if not transition.noise.is_identity:
        sigma = algebra.on_diagonal(sigma) if transition.diagonal else sigma
        return Belief(mean, cov + _congruence(transition.noise, g, sigma, adjoint))
    if transition.diagonal:
        add = algebra.add_on_diagonal_with_adjoint if adjoint else algebra.add_on_diagonal
        return Belief(mean, add(cov, sigma))
    return Belief(mean, cov + linalg.symmetrise(sigma))


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
    used = {name: many.flat(one.rows.mask) for name, one in linear.items()}
    gated = {name: many.flat(mask) for name, mask in judged.gated.items()}
    lanes, dtype = prior.cov.shape[-1], prior.cov.dtype
    if not linear:
        nothing, sound = jnp.zeros(lanes, dtype), _is_sound(prior.cov)
        never = None if ahead.refused is None else jnp.zeros(lanes, bool)
        return Outcome(prior, ahead, nothing, sound, used, gated, never)
    gained = Gained(cov, jnp.zeros(cov.shape[1:], dtype), jnp.zeros(lanes, dtype))
    smallest = jnp.ones(lanes, dtype)
    for slope, rows in blocks_of_rows(system.measurements, linear):
        gained, pivot = take_block(slope, gained, rows, adjoint)
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
    judged = outliers.judge(system, seen, samples, prior.cov, ahead.refused)
    cov = prior.cov if judged.widened is None else prior.cov * judged.widened[None, None]
    return judged, cov


def _is_sound(cov: Array) -> Array:
    """Whether all variances are finite and not negative."""
    smallest = largest = cov[0, 0]
    for i in range(1, cov.shape[0]):
        smallest = jnp.minimum(smallest, cov[i, i])
        largest = jnp.maximum(largest, cov[i, i])
    return (smallest >= 0.0) & (largest < jnp.inf)


def _congruence(p: Pattern, block: Array | None, cov: Array, adjoint: bool) -> Array:
    if adjoint:
        return algebra.congruence_with_adjoint(p)(block, cov)
    return algebra.congruence(p, block, cov)[0]


def hide(
    measurement: Measurement, residual: Array, slope: Array | None, noise: Array, mask: Array
) -> Linear:
    """Hidden rows made inert: no slope and no noise, whatever their numbers are."""
    if many.are_many(residual):
        mask = mask.reshape(residual.shape)
        hidden = jax.vmap(partial(_hide, measurement))(residual, slope, noise, mask)
    else:
        hidden = _hide(measurement, residual, slope, noise, mask)
    return Linear(measurement.slope, hidden)


def _hide(
    measurement: Measurement, residual: Array, slope: Array | None, noise: Array, mask: Array
) -> algebra.Rows:
    if slope is not None:
        rows = patterned.take(mask, measurement.slope.rows, 0)
        slope = jnp.where(rows[:, None], slope, 0.0)
    both = mask if measurement.diagonal else mask[:, None] & mask[None]
    noise = jnp.where(both, noise, 0.0)
    return algebra.Rows(residual, slope, noise, mask)


def take_block(
    slope: Pattern, gained: Gained, rows: algebra.Rows, adjoint: bool
) -> tuple[Gained, Array]:
    """A block of rows taken at once, and the smallest pivot met."""
    if many.are_many(rows.mask):

        def one(carry: tuple[Gained, Array], rows: algebra.Rows) -> tuple[Any, None]:
            gained, pivot = take_block(slope, carry[0], rows, adjoint)
            # Rounding that is not symmetric grows from one group to the next.
            gained = gained._replace(cov=linalg.symmetrise(gained.cov))
            return (gained, jnp.minimum(carry[1], pivot)), None

        return lax.scan(one, (gained, jnp.ones_like(gained.log_likelihood)), rows)[0]
    if adjoint:
        return algebra.update_with_adjoint(slope, rows.noise.ndim == 2)(gained, rows)
    return algebra.update(slope, gained, rows)


def take_keeping(slope: Pattern, gained: Gained, rows: algebra.Rows) -> tuple[Gained, Any]:
    """A block of rows taken at once, and what the way back through it needs."""
    if many.are_many(rows.mask):
        return lax.scan(lambda gained, rows: take_keeping(slope, gained, rows), gained, rows)
    gained, _, solved = algebra.take(slope, gained, rows, with_inverse=True)
    return gained, solved


def blocks_of_rows(
    measurements: dict[str, Measurement], linear: dict[str, Linear]
) -> list[tuple[Pattern, algebra.Rows]]:
    """Rows in blocks that are taken at once: whole sensors together while they are small."""
    groups: list[list[str]] = []
    size = 0
    for name, one in linear.items():
        rows = one.slope.shape[0]
        if many.are_many(one.rows.mask):
            rows = _LARGEST_BLOCK + 1  # Groups that are taken one after the other stand alone.
        if groups and size + rows <= _LARGEST_BLOCK:
            groups[-1].append(name)
            size += rows
        else:
            groups.append([name])
            size = rows
    return [_joined(measurements, [linear[name] for name in names], names) for names in groups]


def _joined(
    measurements: dict[str, Measurement], parts: list[Linear], names: list[str]
) -> tuple[Pattern, algebra.Rows]:
    """Rows of several sensors as one block."""
    if len(parts) == 1:
        return parts[0].slope, parts[0].rows
    slope = patterned.stack([part.slope for part in parts])
    residual = jnp.concatenate([part.rows.residual for part in parts])
    mask = jnp.concatenate([part.rows.mask for part in parts])
    lanes, dtype = residual.shape[-1], residual.dtype
    unknown = None
    if slope.rows:
        whole = [patterned.dense(p.slope, p.rows.slope, lanes, dtype) for p in parts]
        stacked = patterned.take(jnp.concatenate(whole), slope.rows, 0)
        unknown = patterned.take(stacked, slope.cols, 1)
    if all(measurements[name].diagonal for name in names):
        noise = jnp.concatenate([part.rows.noise for part in parts])
    else:
        noise = _block_diagonal([part.rows.noise for part in parts])
    return slope, algebra.Rows(residual, unknown, noise, mask)


def _block_diagonal(matrices: list[Array]) -> Array:
    whole = [algebra.on_diagonal(m) if m.ndim == 2 else m for m in matrices]
    size, start, rows = sum(m.shape[0] for m in whole), 0, []
    for m in whole:
        before = jnp.zeros((m.shape[0], start, m.shape[-1]), m.dtype)
        after = jnp.zeros((m.shape[0], size - start - m.shape[0], m.shape[-1]), m.dtype)
        rows.append(jnp.concatenate([before, m, after], axis=1))
        start += m.shape[0]
    return jnp.concatenate(rows)


def any_used(linear: dict[str, Linear]) -> Array:
    """(lanes,) where any row of any sensor counts."""
    return reduce(operator.or_, [many.any_row(one.rows.mask) for one in linear.values()])


def _correct(
    system: System, constants: Any, prior: Belief, gained: Gained, used: Array, adjoint: bool
) -> Belief:
    """The mean moved by the error vector and the covariance counted from there, where rows were `used`."""
    correction = system.correction
    mean, reset, _ = correction.piece(constants, prior.mean, gained.delta, used, adjoint=adjoint)
    if correction.reset.is_identity:
        # Symmetric but for rounding, which the next prediction ends.
        return Belief(mean, gained.cov)
    cov = _congruence(correction.reset, reset, gained.cov, adjoint)
    return Belief(mean, cov)
