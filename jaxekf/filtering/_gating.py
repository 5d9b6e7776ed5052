"""Outliers, on the batch axis: chi-square gates and robust weights (Huber, Student-t) for groups of rows.

`jaxekf.filtering._step.linearise_and_gate` calls `gate_and_weight`. A new kind of weight goes into
`noise_inflation`.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax

from jaxekf._support import chi_square
from jaxekf.filtering import _belief_reset as belief_reset
from jaxekf.filtering import _covariance_update as covariance_update
from jaxekf.filtering import _repeated_groups as repeated_groups
from jaxekf.filtering._belief_reset import Resets, ResetTally
from jaxekf.filtering._covariance_update import MeasurementRows
from jaxekf.filtering._lowered_model import BoundModel
from jaxekf.filtering.lowering.lanes import unrolled_sum
from jaxekf.filtering.lowering.structured_matrix import Pattern
from jaxekf.filtering.model import Sensor
from jaxekf.filtering.steps import Rows
from jaxekf.geometry import linalg

_HUBER_PROBABILITY = 0.95
"""Probability with which a Gaussian group keeps its full weight under Huber's law."""
_STUDENT_DOF = 4.0
"""Degrees of freedom of Student's t: heavy tails, finite variance."""
_PLAUSIBLE = 0.99
"""Without a gate: probability with which a Gaussian group agrees with the belief (see `_belief_reset`)."""
_REOPENED_RATIO = 7.0
"""After a gate reset, groups of a repeated sensor are accepted up to this multiple of the mean normalised
squared error. One Gaussian group in a thousand exceeds it."""


class LinearisedRows(NamedTuple):
    """One sensor linearised at one instant."""

    pattern: Pattern
    """Sparsity of H."""
    rows: MeasurementRows


class GatingResult(NamedTuple):
    """The samples of one instant after gates and weights."""

    linear: dict[str, LinearisedRows]
    """By sensor: gated rows hidden, noise of down-weighted rows inflated."""
    gated: dict[str, Array]
    """By sensor: (rows, lanes) visible rows that a gate rejected."""
    resets: Resets | None
    """None if the model is never reset."""


class _GroupDistance(NamedTuple):
    """One group of rows and its squared Mahalanobis distance from the prediction."""

    members: tuple[int, ...]
    """Row numbers."""
    visible: Array
    """(lanes,) number of visible rows."""
    distance: Array
    """(lanes,) ``e' S^-1 e`` of the visible rows."""


class _RepeatedDistances(NamedTuple):
    """The same for every group of a sensor with repeated groups, (groups, lanes)."""

    visible: Array
    distance: Array


_Distances = list[_GroupDistance] | _RepeatedDistances


def gate_and_weight(
    bound: BoundModel,
    linear: dict[str, LinearisedRows],
    samples: dict[str, Rows],
    prior_cov: Array,
    rejecting_s: Array | None,
) -> GatingResult:
    """Reject rows by gates, inflate the noise of others by weights, reset a belief that all contradict.

    At a reset (`jaxekf.filtering._belief_reset`) gates are open and all samples have full weight.

    Parameters
    ----------
    bound
        The model with its parameters.
    linear
        The sensors of this instant, linearised at the prediction.
    samples
        The same sensors' samples.
    prior_cov
        Predicted covariance, (n, n, lanes).
    rejecting_s
        (groups, lanes) as in `FilterCarry`; None if the model is never reset.
    """
    lowered = bound.lowered
    sensors = {name: lowered.sensors[name].sensor for name in linear}
    gated = {name: jnp.zeros_like(one.rows.mask) for name, one in linear.items()}
    distances: dict[str, _Distances] = {}
    ratios: dict[str, Array] = {}
    tallies: dict[str, ResetTally] = {}
    for name, one in linear.items():
        sensor = sensors[name]
        if sensor.gate is None and sensor.weighting is None:
            continue
        seen, cov = one, prior_cov
        if sensor.weighting is None:
            # Gates and resets have no derivative.
            seen = one._replace(rows=lax.stop_gradient(one.rows))
            cov = lax.stop_gradient(prior_cov)
        distances[name] = _innovation_distances(sensor, seen, cov)
        outside, ratios[name], tallies[name] = _compare_with_bounds(
            sensor, one.rows.mask, distances[name], samples[name].dt
        )
        if sensor.gate is not None:
            gated[name] = outside
    resets = None
    if rejecting_s is not None:
        resets = belief_reset.reset(
            lowered.reset_groups,
            tallies,
            rejecting_s,
            lowered.model.gate_reset_after_s,
            prior_cov,
            bound.prepared["initial variance"],
        )
        for name, here in resets.recovered.items():
            gated[name] &= ~_reopened(ratios[name], tallies[name].excess, here, distances[name])
    kept = {name: _hide_rows(one, gated[name]) for name, one in linear.items()}
    for name, distance in distances.items():
        if sensors[name].weighting is None:
            continue
        factor = _row_inflation(sensors[name], distance, kept[name].rows.mask.shape[-2])
        if resets is not None:
            factor = jnp.where(resets.recovered[name], 1.0, factor)
        kept[name] = _inflate_noise(kept[name], factor)
    return GatingResult(kept, gated, resets)


# --- weights ------------------------------------------------------------------------------------------


def row_weights(sensor: Sensor, residual: Array, cov: Array, mask: Array) -> Array | None:
    """Weight of each row of a sample, (m,): the filter divided the row's noise by it.

    None for a sensor without weighting. `cov` is the innovation covariance (m, m), hidden rows as in the
    identity.
    """
    if sensor.weighting is None:
        return None
    groups = _squared_distances(sensor, jnp.where(mask, residual, 0.0), cov, mask)
    return 1.0 / noise_inflation(sensor, groups, residual.shape[0])


def noise_inflation(sensor: Sensor, groups: list[_GroupDistance], rows: int) -> Array:
    """Factor on the noise of each row, (rows, lanes), at least 1.

    For a group of m visible rows with squared distance d2: ``sqrt(d2 / c)`` beyond the chi-square quantile
    c (Huber), ``(v + d2) / (v + m)`` with v degrees of freedom (Student).
    """
    found: list[Any] = [None] * rows
    for members, visible, distance in groups:
        if sensor.weighting == "student":
            factor = jnp.maximum((_STUDENT_DOF + distance) / (_STUDENT_DOF + visible), 1.0)
        else:
            bound = _chi_square_bound(_HUBER_PROBABILITY, members, visible, distance)
            factor = jnp.sqrt(jnp.maximum(distance / bound, 1.0))
        for row in members:
            found[row] = factor
    return jnp.stack(found)


def _row_inflation(sensor: Sensor, distances: _Distances, rows: int) -> Array:
    """`noise_inflation` of any sensor; (groups, rows, lanes) with repeated groups."""
    if not isinstance(distances, _RepeatedDistances):
        return noise_inflation(sensor, distances, rows)
    single, members = _single_group(sensor), tuple(range(rows))
    return jax.vmap(lambda each: noise_inflation(single, [_GroupDistance(members, *each)], rows))(
        distances
    )


def _inflate_noise(linear: LinearisedRows, factor: Array) -> LinearisedRows:
    if repeated_groups.has_group_axis(linear.rows.mask):
        noise = jax.vmap(_inflated)(linear.rows.noise, factor)
    else:
        noise = _inflated(linear.rows.noise, factor)
    return linear._replace(rows=linear.rows._replace(noise=noise))


def _inflated(noise: Array, factor: Array) -> Array:
    """Variances (m, lanes), or a covariance (m, m, lanes), with each row's factor (m, lanes)."""
    if noise.ndim == factor.ndim:
        return noise * factor
    root = jnp.sqrt(factor)
    return noise * root[:, None] * root[None]


# --- gates --------------------------------------------------------------------------------------------


def _hide_rows(linear: LinearisedRows, gated: Array) -> LinearisedRows:
    return linear._replace(rows=linear.rows._replace(mask=linear.rows.mask & ~gated))


def _reopened(ratio: Array, excess: Array, recovered: Array, distances: _Distances) -> Array:
    """Rows whose gate a reset opens: all but those that are not finite."""
    reopened = ratio < jnp.inf
    if isinstance(distances, _RepeatedDistances):
        # Most points of an image are good and the others far off, also from a belief so widened.
        reopened &= ratio <= _REOPENED_RATIO * jnp.broadcast_to(excess, reopened.shape)
    return reopened & jnp.broadcast_to(recovered, reopened.shape)


def _compare_with_bounds(
    sensor: Sensor, mask: Array, distances: _Distances, dt: Array
) -> tuple[Array, Array, ResetTally]:
    """Visible rows outside their chi-square bound; for each row its group's ratio of squared error to
    expected squared error; and the tally of the sensor."""
    if isinstance(distances, _RepeatedDistances):
        return _compare_repeated(_single_group(sensor), mask, distances, dt)
    outside, ratio = _rows_outside(sensor, mask, distances)
    accepted = rejected = jnp.zeros(mask.shape[-1], bool)
    excess = jnp.ones_like(ratio[0])
    for row in range(mask.shape[0]):
        finite = outside[row] & (ratio[row] < jnp.inf)
        accepted = accepted | (mask[row] & ~outside[row])
        rejected = rejected | finite
        excess = jnp.where(finite, jnp.maximum(excess, ratio[row]), excess)
    tally = ResetTally(accepted, rejected, jnp.where(rejected, dt, 0.0), excess)
    return outside, jnp.stack(ratio), tally


def _compare_repeated(
    single: Sensor, mask: Array, distances: _RepeatedDistances, dt: Array
) -> tuple[Array, Array, ResetTally]:
    """`_compare_with_bounds` of a sensor with repeated groups, `single` being one of them as a sensor.

    The sensor counts as accepted if most of its visible groups were: a few points fit by chance.
    """
    rows = tuple(range(mask.shape[1]))
    zero = jnp.zeros_like(dt)

    def one(carry: tuple[Array, Array, Array, Array], at: Any) -> tuple[Any, Any]:
        balance, rejected, number, logs = carry
        mask, each = at
        outside, ratio = _rows_outside(single, mask, [_GroupDistance(rows, *each)])
        group_outside, visible = outside[0], mask[0]
        for row in rows[1:]:
            group_outside, visible = group_outside | outside[row], visible | mask[row]
        finite = group_outside & (ratio[0] < jnp.inf)
        balance = balance + jnp.where(group_outside, -1.0, jnp.where(visible, 1.0, 0.0))
        log = jnp.log(jnp.where(finite, jnp.maximum(ratio[0], 1.0), 1.0))
        carry = (balance, rejected | finite, number + finite.astype(dt.dtype), logs + log)
        return carry, (outside, jnp.stack(ratio))

    begin = (zero, jnp.zeros(dt.shape, bool), zero, zero)
    (balance, rejected, number, logs), (outside, ratio) = lax.scan(one, begin, (mask, distances))
    excess = jnp.where(rejected, jnp.exp(logs / jnp.maximum(number, 1.0)), 1.0)
    tally = ResetTally(balance > 0.0, rejected, jnp.where(rejected, dt, 0.0), excess)
    return outside, lax.stop_gradient(ratio), tally


def _rows_outside(
    sensor: Sensor, mask: Array, groups: list[_GroupDistance]
) -> tuple[Array, list[Array]]:
    """Visible rows (m, lanes) whose group is outside its chi-square bound, and for each row its group's
    ratio of squared error to expected squared error, (lanes,)."""
    outside: list[Any] = [None] * sensor.rows
    ratios: list[Any] = [None] * sensor.rows
    for members, visible, distance in groups:
        bound = _chi_square_bound(sensor.gate or _PLAUSIBLE, members, visible, distance)
        # A distance that is NaN is outside too: such a row must not enter the update.
        rejected = jnp.logical_not(distance <= bound)
        ratio = distance / jnp.maximum(visible, 1).astype(distance.dtype)
        for row in members:
            outside[row], ratios[row] = rejected, lax.stop_gradient(ratio)
    return lax.stop_gradient(jnp.stack(outside) & mask), ratios


def _chi_square_bound(
    probability: Any, members: tuple[int, ...], visible: Array, like: Array
) -> Array:
    """Chi-square quantile for the number of visible rows (at least one), in the shape of `like`."""
    bounds = chi_square.ppf(probability, np.arange(1, len(members) + 1))
    found = jnp.full_like(like, bounds[0])
    for count in range(2, len(bounds) + 1):
        found = jnp.where(visible == count, bounds[count - 1], found)
    return found


# --- distances ----------------------------------------------------------------------------------------


def _innovation_distances(sensor: Sensor, linear: LinearisedRows, prior_cov: Array) -> _Distances:
    """Squared distances of the groups of a sensor from the prediction."""
    if repeated_groups.has_group_axis(linear.rows.mask):

        def one(_: None, rows: MeasurementRows) -> tuple[None, Any]:
            own = linear._replace(rows=rows)
            found: Any = _innovation_distances(_single_group(sensor), own, prior_cov)
            return None, _RepeatedDistances(found[0].visible, found[0].distance)

        return lax.scan(one, None, linear.rows)[1]
    rows = linear.rows
    # The closed-form derivatives of the filter need symmetric cotangents of covariances.
    cov = linalg.symmetrise(
        covariance_update.innovation_covariance(
            linear.pattern, rows.jacobian, rows.noise, prior_cov
        )
    )
    masked = linalg.mask_covariance(cov, rows.mask)
    return _squared_distances(sensor, rows.residual, masked, rows.mask)


def _squared_distances(
    sensor: Sensor, residual: Array, cov: Array, mask: Array
) -> list[_GroupDistance]:
    found = []
    for members in sensor.group_rows:
        part = jnp.stack([residual[i] for i in members])
        shared = jnp.stack([jnp.stack([cov[i, j] for j in members]) for i in members])
        visible = unrolled_sum([mask[i].astype(int) for i in members])
        found.append(_GroupDistance(members, visible, linalg.squared_distance(part, shared)))
    return found


def _single_group(sensor: Sensor) -> Sensor:
    """One of the repeated groups of a sensor, as a sensor."""
    assert sensor.single_group is not None
    return sensor.single_group
