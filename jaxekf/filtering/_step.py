"""One step of the filter for a batch of runs: predict, linearise and gate, update.

Arrays carry the runs on the last axis (lanes). `jaxekf.filtering._recursion` scans these functions over
time.
"""

import operator
from functools import partial, reduce
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array, lax

from jaxekf.filtering import _covariance_prediction as covariance_prediction
from jaxekf.filtering import _covariance_update as covariance_update
from jaxekf.filtering import _gating as gating
from jaxekf.filtering import _repeated_groups as repeated_groups
from jaxekf.filtering._covariance_update import MeasurementRows, UpdateAccumulator
from jaxekf.filtering._gating import GatingResult, LinearisedRows
from jaxekf.filtering._lowered_model import BoundModel, LoweredModel, LoweredSensor
from jaxekf.filtering.lowering import structured_matrix
from jaxekf.filtering.lowering.batched_products import diagonal_matrix
from jaxekf.filtering.lowering.structured_matrix import Bands, Pattern
from jaxekf.filtering.model import Belief
from jaxekf.filtering.steps import Rows
from jaxekf.geometry import linalg


class SubstepInput(NamedTuple):
    """The inputs of a substep besides samples."""

    dt: Array
    """(lanes,) seconds."""
    u: Any
    """`InputSample`, or None for a model without input."""
    excess: Array | None = None
    """(n, lanes) as in `Steps`."""


class FilterCarry(NamedTuple):
    """The carry of the scan over substeps."""

    belief: Belief
    rejecting_s: Array | None
    """(groups, lanes) seconds of samples outside their bounds since the last one inside, for each of
    `LoweredModel.reset_groups`; None if the model is never reset."""


class StepOutput(NamedTuple):
    """The results of one substep."""

    prior: Belief
    """The prediction."""
    carry: FilterCarry
    """After the update."""
    log_likelihood: Array
    """(lanes,) of the rows that entered the update."""
    healthy: Array
    """(lanes,) False where a covariance is not finite or not definite."""
    used: dict[str, Array]
    """By sensor: (rows, lanes) rows that entered the update."""
    gated: dict[str, Array]
    """By sensor: (rows, lanes) visible rows that a gate rejected."""
    recovered: Array | None
    """(lanes,) where the belief was reset; None if the model is never reset."""


def initial_carry(lowered: LoweredModel, belief: Belief, rejecting_s: Array | None) -> FilterCarry:
    """The carry at the start of a run; `rejecting_s` as in `FilterCarry`, or (lanes,), or None for 0."""
    if not lowered.reset_groups:
        return FilterCarry(belief, None)
    if rejecting_s is None:
        rejecting_s = jnp.zeros((), belief.cov.dtype)
    shape = (len(lowered.reset_groups), belief.cov.shape[-1])
    return FilterCarry(belief, jnp.broadcast_to(rejecting_s, shape))


def predict(bound: BoundModel, belief: Belief, inputs: SubstepInput) -> Belief:
    """The prediction at the end of the substep (docs/mathematics.md, section 2)."""
    transition = bound.lowered.transition
    mean, f, g = bound.transition(belief.mean, inputs.u, inputs.dt)
    sigma = bound.process_noise(inputs.dt)
    patterns = (transition.f_pattern, transition.g_pattern)
    cov = covariance_prediction.predicted_covariance(
        patterns, f, g, belief.cov, sigma, adjoint=bound.adjoint
    )
    if inputs.excess is not None:
        cov = cov + diagonal_matrix(inputs.excess)
    return Belief(mean, cov)


def update(
    bound: BoundModel, predicted: FilterCarry, u: Any, samples: dict[str, Rows]
) -> StepOutput:
    """The update by every sensor sampled at the end of a substep (docs/mathematics.md, section 3)."""
    prior = predicted.belief
    result, cov = linearise_and_gate(bound, predicted, u, samples)
    linear = result.linear
    used = {name: repeated_groups.flatten_groups(one.rows.mask) for name, one in linear.items()}
    gated = {name: repeated_groups.flatten_groups(mask) for name, mask in result.gated.items()}
    lanes, dtype = prior.cov.shape[-1], prior.cov.dtype
    if not linear:
        zero, valid = jnp.zeros(lanes, dtype), _has_valid_variances(prior.cov)
        never = None if predicted.rejecting_s is None else jnp.zeros(lanes, bool)
        return StepOutput(prior, predicted, zero, valid, used, gated, never)
    accumulator = UpdateAccumulator(cov, jnp.zeros(cov.shape[1:], dtype), jnp.zeros(lanes, dtype))
    smallest = jnp.ones(lanes, dtype)
    for one in linear.values():
        accumulator, pivot = apply_sensor(one, accumulator, adjoint=bound.adjoint)
        smallest = jnp.minimum(smallest, pivot)
    posterior = _correct(bound, prior, accumulator, any_used(linear))
    if bound.lowered.iterated_update is not None:
        widened = Belief(prior.mean, cov)
        posterior, pivot = bound.lowered.iterated_update(
            bound.iterated_update(), widened, posterior, u, samples, linear
        )
        smallest = jnp.minimum(smallest, pivot)
    healthy = (smallest > 0.0) & _has_valid_variances(posterior.cov)
    rejecting_s = recovered = None
    if result.resets is not None:
        rejecting_s, recovered = result.resets.rejecting_s, result.resets.anywhere
    carry = FilterCarry(posterior, rejecting_s)
    log_likelihood = accumulator.log_likelihood
    return StepOutput(prior, carry, log_likelihood, healthy, used, gated, recovered)


def linearise_and_gate(
    bound: BoundModel, predicted: FilterCarry, u: Any, samples: dict[str, Rows]
) -> tuple[GatingResult, Array]:
    """Every sensor linearised at the prediction, after gates and weights; and the predicted covariance,
    with the noise of resets."""
    prior = predicted.belief
    linear = linearise(bound, prior.mean, u, samples)
    result = gating.gate_and_weight(bound, linear, samples, prior.cov, predicted.rejecting_s)
    return result, prior.cov if result.resets is None else prior.cov + result.resets.added_cov


def linearise(
    bound: BoundModel, x: Any, u: Any, samples: dict[str, Rows]
) -> dict[str, LinearisedRows]:
    """Every sensor linearised at the state `x`."""
    linear = {}
    for name, sample in samples.items():
        residual, jacobian, noise = bound.sensor(name, x, u, sample)
        linear[name] = mask_rows(
            bound.lowered.sensors[name], residual, jacobian, noise, sample.mask
        )
    return linear


def _has_valid_variances(cov: Array) -> Array:
    """(lanes,) whether all variances are finite and not negative."""
    smallest = largest = cov[0, 0]
    for i in range(1, cov.shape[0]):
        smallest = jnp.minimum(smallest, cov[i, i])
        largest = jnp.maximum(largest, cov[i, i])
    return (smallest >= 0.0) & (largest < jnp.inf)


def mask_rows(
    sensor: LoweredSensor, residual: Array, jacobian: Bands, noise: Array, mask: Array
) -> LinearisedRows:
    """Rows of a sensor, with Jacobian and noise 0 in hidden rows, whatever their numbers are."""
    if repeated_groups.has_group_axis(residual):
        mask = mask.reshape(residual.shape)
        rows = jax.vmap(partial(_masked, sensor))(residual, jacobian, noise, mask)
    else:
        rows = _masked(sensor, residual, jacobian, noise, mask)
    return LinearisedRows(sensor.pattern, rows)


def _masked(
    sensor: LoweredSensor, residual: Array, jacobian: Bands, noise: Array, mask: Array
) -> MeasurementRows:
    bands = [
        jnp.where(structured_matrix.take_slices(mask, rows, 0)[:, None], band, 0.0)
        for band, (rows, _) in zip(jacobian, sensor.pattern.bands, strict=True)
    ]
    both = mask if sensor.has_diagonal_noise else mask[:, None] & mask[None]
    return MeasurementRows(residual, tuple(bands), jnp.where(both, noise, 0.0), mask)


def apply_sensor(
    linear: LinearisedRows, accumulator: UpdateAccumulator, *, adjoint: bool
) -> tuple[UpdateAccumulator, Array]:
    """Apply the rows of one sensor; also the smallest pivot (lanes,) of the innovation covariances."""
    pattern, rows = linear
    if repeated_groups.has_group_axis(rows.mask):

        def one(carry: tuple[UpdateAccumulator, Array], rows: MeasurementRows) -> tuple[Any, None]:
            group = LinearisedRows(pattern, rows)
            accumulator, pivot = apply_sensor(group, carry[0], adjoint=adjoint)
            # Rounding that is not symmetric grows from one group to the next.
            accumulator = accumulator._replace(cov=linalg.symmetrise(accumulator.cov))
            return (accumulator, jnp.minimum(carry[1], pivot)), None

        carry = (accumulator, jnp.ones_like(accumulator.log_likelihood))
        return lax.scan(one, carry, rows)[0]
    pattern, rows, determinant = covariance_update.whiten_rows(pattern, rows)
    if determinant is not None:
        log_likelihood = accumulator.log_likelihood + determinant
        accumulator = accumulator._replace(log_likelihood=log_likelihood)
    return covariance_update.apply_rows(pattern, accumulator, rows, adjoint=adjoint)


class AppliedSensor(NamedTuple):
    """The rows of one sensor after they were applied, for the smoother's way back through them."""

    pattern: Pattern
    """Sparsity of H, whitened."""
    rows: MeasurementRows
    """Whitened; with repeated groups a leading axis more, as the next."""
    blocks: list[covariance_update.AppliedBlock]


def apply_sensor_saving(
    linear: LinearisedRows, accumulator: UpdateAccumulator
) -> tuple[UpdateAccumulator, AppliedSensor]:
    """Apply the rows of one sensor, and save what the smoother needs of them."""

    def one(accumulator: UpdateAccumulator, rows: MeasurementRows) -> tuple[Any, Any]:
        whitened, rows, _ = covariance_update.whiten_rows(linear.pattern, rows)
        accumulator, _, blocks, _ = covariance_update.apply_rows_saving(whitened, accumulator, rows)
        return accumulator, (rows, blocks)

    is_repeated = repeated_groups.has_group_axis(linear.rows.mask)
    scan = partial(lax.scan, one) if is_repeated else one
    accumulator, (rows, blocks) = scan(accumulator, linear.rows)
    pattern = covariance_update.whitened_pattern(linear.pattern, linear.rows)
    return accumulator, AppliedSensor(pattern, rows, blocks)


def any_used(linear: dict[str, LinearisedRows]) -> Array:
    """(lanes,) where any row of any sensor enters the update."""
    return reduce(operator.or_, [repeated_groups.any_row(one.rows.mask) for one in linear.values()])


def _correct(
    bound: BoundModel, prior: Belief, accumulator: UpdateAccumulator, used: Array
) -> Belief:
    """The mean moved by the error vector, and the reset of the covariance (docs/mathematics.md, section 4).

    Both only where `used`, (lanes,).
    """
    mean, reset, _ = bound.correction(prior.mean, accumulator.delta, used)
    pattern = bound.lowered.reset_pattern
    if pattern.is_identity:
        # Symmetric but for rounding, which the next prediction ends.
        return Belief(mean, accumulator.cov)
    cov = covariance_prediction.congruence(pattern, reset, accumulator.cov, adjoint=bound.adjoint)
    return Belief(mean, cov)
