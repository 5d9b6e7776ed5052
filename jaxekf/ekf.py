"""The extended Kalman filter on a state space: one `lax.scan` over epochs, Jacobians by autodiff.

The covariance is that of the error vector, ``x_true = retract(x, error)``. All rows of all sensors
at one instant are linearised at the same predicted state, so that their order does not matter. After
whitening by the factor of the measurement noise the rows are taken one at a time, each by Joseph's
form, which needs no solve and keeps the covariance definite.

A model is written for one run. The step is written for many, the runs on the last axis of every array:
there they lie side by side in memory and the tiny matrices of one run become long vectors.
"""

from collections.abc import Mapping
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax
from scipy.stats import chi2

from jaxekf import linalg, manifold
from jaxekf.interpolation import InputSample, sample
from jaxekf.linearise import linearise_sensor, linearise_transition
from jaxekf.model import Belief, Model, Parameters, Sensor
from jaxekf.timeline import Rows, Steps

_LOG_2PI = float(np.log(2.0 * np.pi))
_LARGEST_UNROLLED_ROWS = 12
_LARGEST_UNROLLED_SUBSTEPS = 2


class Innovation(NamedTuple):
    """What one sensor said at each of its instants, against what was predicted."""

    residual: Array
    """(..., rows) measured minus predicted, in the sensor's error vector; 0 where not used."""
    cov: Array
    """(..., rows, rows) predicted covariance of the residual, hidden rows as in the identity."""
    used: Array
    """(..., rows) rows that entered the update."""
    gated: Array
    """(..., rows) visible rows that the chi-square gate kept out."""
    nis: Array
    """(...) normalised innovation squared of the visible rows, gated ones included."""


class Instant(NamedTuple):
    """The filter at the end of each substep; leading axes (K, S)."""

    predicted: Belief
    updated: Belief
    log_likelihood: Array
    """Log density of the rows used, given all rows before them."""
    healthy: Array
    """False where a covariance lost finiteness or definiteness."""


class FilterOutput(NamedTuple):
    """Everything a run of the filter produces."""

    instants: Instant
    inputs: InputSample | None
    """The input as each substep saw it, leading axes (K, S)."""
    innovations: dict[str, Innovation]
    """By sensor: leading axes (K, S) for fast sensors, (K,) for slow ones."""


def initial_belief(model: Model, params: Parameters, first: Mapping[str, Any]) -> Belief:
    """The belief a run starts from: mean from its first samples, covariance from the parameters."""
    return Belief(model.initial_mean(first), model.initial_covariance(params))


# Every array below carries the runs on its last axis: the lanes. Only the model's own functions see
# one run, through `vmap` over that axis.


class _White(NamedTuple):
    """Rows of one sensor that enter the update."""

    residual: Array
    jacobian: Array
    noise: Array
    used: Array


def _squared_distance(residual: Array, cov: Array) -> Array:
    """``r' inv(S) r`` of a few rows."""
    white = linalg.whiten(linalg.whitener(cov), residual)
    return jnp.sum(white * white, axis=0)


def _gate(sensor: Sensor, residual: Array, cov: Array, mask: Array) -> Array:
    """Visible rows whose group lies outside its chi-square bound."""
    if sensor.gate is None:
        return jnp.zeros_like(mask)
    outside: list[Any] = [None] * sensor.rows
    for members in sensor.group_rows:
        index = np.array(members)
        freedom = np.arange(1, len(members) + 1)
        bounds = np.concatenate([[np.inf], chi2.ppf(sensor.gate, freedom)])
        visible = jnp.sum(mask[index], axis=0)
        distance = _squared_distance(residual[index], cov[index][:, index])
        bound = jnp.asarray(bounds, distance.dtype)[visible]
        # A distance that is NaN is outside too: such a row must not enter the update.
        rejected = jnp.logical_not(distance <= bound)
        for row in members:
            outside[row] = rejected
    return jnp.stack(outside) & mask


def _innovate(
    sensor: Sensor, linear: tuple[Array, Array, Array], mask: Array, prior: Array
) -> tuple[_White, Innovation]:
    """The rows that pass the gate, and the sensor's innovation."""
    residual, jacobian, noise = linear
    spread = linalg.multiply_transposed(linalg.multiply(jacobian, prior), jacobian)
    cov = linalg.symmetrise(spread + noise)
    gated = _gate(sensor, residual, cov, mask)
    used = mask & ~gated
    kept = _White(
        jnp.where(used, residual, 0.0),
        jnp.where(used[:, None], jacobian, 0.0),
        linalg.mask_covariance(noise, used),
        used,
    )
    nis = _squared_distance(residual, cov)
    return kept, Innovation(kept.residual, cov, used, gated, nis)


def _take_row(carry: tuple[Array, Array, Array], row: tuple[Array, Array, Array]) -> Any:
    """One whitened scalar row: the error vector, the covariance and the log-likelihood after it.

    ``(I - k h') P (I - k h')' + k k'``, which stays definite however the gain was rounded.
    """
    delta, cov, log_likelihood = carry
    residual, h, used = row
    ph = linalg.apply(cov, h)
    variance = jnp.sum(h * ph, axis=0) + 1.0
    inverse = 1.0 / variance
    gain = ph * inverse[None]
    error = residual - jnp.sum(h * delta, axis=0)
    half = cov - linalg.outer(gain, ph)
    rest = gain - linalg.apply(half, h)
    cov = half + linalg.outer(rest, gain)
    gained = -0.5 * (error * error * inverse + jnp.log(variance) + _LOG_2PI)
    carry = (delta + gain * error[None], cov, log_likelihood + jnp.where(used, gained, 0.0))
    return carry, variance > 0.0


def _update(model: Model, prior: Belief, rows: list[_White]) -> tuple[Belief, Array, Array]:
    """The belief after the given rows, their log-likelihood, and whether all variances were sound.

    The rows of each sensor are whitened by the factor of their noise; the error vector is gathered in
    the tangent space at the prior mean and applied once.
    """
    lanes = prior.cov.shape[-1]
    log_likelihood = jnp.zeros(lanes, prior.cov.dtype)
    residuals, jacobians = [], []
    for sensor_rows in rows:
        white = linalg.whitener(sensor_rows.noise)
        residuals.append(linalg.whiten(white, sensor_rows.residual))
        jacobians.append(linalg.whiten(white, sensor_rows.jacobian))
        log_likelihood = log_likelihood + jnp.sum(jnp.log(white[1]), axis=0)
    used = jnp.concatenate([r.used for r in rows])
    stacked = (jnp.concatenate(residuals), jnp.concatenate(jacobians), used)
    carry = (jnp.zeros((model.error_dim, lanes), prior.cov.dtype), prior.cov, log_likelihood)
    if used.shape[0] <= _LARGEST_UNROLLED_ROWS:
        sound = jnp.ones(lanes, bool)
        for i in range(used.shape[0]):
            carry, positive = _take_row(carry, (stacked[0][i], stacked[1][i], used[i]))
            sound = sound & positive
    else:
        carry, positive = lax.scan(_take_row, carry, stacked)
        sound = jnp.all(positive, axis=0)
    delta, cov, log_likelihood = carry
    any_used = jnp.any(used, axis=0)
    mean = _on_lanes(partial(_move_mean, model))(prior.mean, delta, any_used)
    if manifold.is_curved(model.space):
        reset = _on_lanes(partial(manifold.reset_jacobian, model.space))(delta)
        cov = linalg.multiply_transposed(linalg.multiply(reset, cov), reset)
    cov = jnp.where(any_used[None, None], linalg.symmetrise(cov), prior.cov)
    return Belief(mean, cov), log_likelihood, sound


def _move_mean(model: Model, x: Any, delta: Array, any_used: Array) -> Any:
    """The mean moved by the error vector, for one run; untouched where no row was used."""
    mean = manifold.retract(model.space, x, delta)
    if model.project is not None:
        mean = model.project(mean)
    return manifold.copy_where(any_used, mean, x)


def _on_lanes(function: Any, in_axes: Any = -1) -> Any:
    """A function of one run applied to all lanes."""
    return jax.vmap(function, in_axes=in_axes, out_axes=-1)


class _Moment(NamedTuple):
    """What the scan is given for one substep."""

    dt: Array
    u: Any


def _predict(model: Model, params: Parameters, belief: Belief, moment: _Moment) -> Belief:
    """The belief at the end of the substep: ``P = F P F' + G Sigma G'``."""

    def linearise(params: Parameters, x: Any, u: Any, dt: Array) -> Any:
        return (
            *linearise_transition(model, params, x, u, dt),
            model.process_noise(params, dt),
        )

    mean, f, g, sigma = _on_lanes(linearise)(params, belief.mean, moment.u, moment.dt)
    cov = linalg.multiply_transposed(linalg.multiply(f, belief.cov), f)
    cov = cov + linalg.multiply_transposed(linalg.multiply(g, sigma), g)
    return Belief(mean, linalg.symmetrise(cov))


def _advance(
    model: Model, params: Parameters, belief: Belief, moment: _Moment, rows: dict[str, Rows]
) -> tuple[Belief, tuple[Instant, dict[str, Innovation]]]:
    """Predict to the end of one substep and take every sensor sampled there."""
    prior = _predict(model, params, belief, moment)
    kept: list[_White] = []
    innovations: dict[str, Innovation] = {}
    for name, sample_rows in rows.items():
        sensor = model.sensor(name)
        linearise = _on_lanes(partial(linearise_sensor, model, sensor))
        linear = linearise(params, prior.mean, moment.u, sample_rows)
        used, innovations[name] = _innovate(sensor, linear, sample_rows.mask, prior.cov)
        kept.append(used)
    lanes = prior.cov.shape[-1]
    posterior, log_likelihood = prior, jnp.zeros(lanes, prior.cov.dtype)
    sound = jnp.ones(lanes, bool)
    if kept:
        posterior, log_likelihood, sound = _update(model, prior, kept)
    variances = linalg.diagonal(posterior.cov)
    healthy = sound & jnp.all(jnp.isfinite(variances) & (variances >= 0.0), axis=0)
    instant = Instant(prior, posterior, log_likelihood, healthy)
    return posterior, (instant, innovations)


def _epoch(
    model: Model, params: Parameters, belief: Belief, given: Any
) -> tuple[Belief, tuple[Instant, dict[str, Innovation]]]:
    """All substeps of one epoch; slow sensors are taken at the last."""
    moments, fast, slow = given
    every = (moments, fast)
    before = jax.tree.map(lambda a: a[:-1], every)
    moment, rows = jax.tree.map(lambda a: a[-1], every)

    def inner(belief: Belief, given: Any) -> Any:
        return _advance(model, params, belief, *given)

    count = moments.dt.shape[0] - 1
    belief, earlier = lax.scan(inner, belief, before, unroll=count <= _LARGEST_UNROLLED_SUBSTEPS)
    belief, (instant, innovations) = _advance(model, params, belief, moment, rows | slow)
    ended = {name: innovations.pop(name) for name in slow}
    instants, fast_innovations = jax.tree.map(
        lambda a, b: jnp.concatenate([a, b[None]]), earlier, (instant, innovations)
    )
    return belief, (instants, fast_innovations | ended)


def run_filter(
    model: Model, params: Parameters, belief: Belief, steps: Steps, *, checkpoint: bool = True
) -> FilterOutput:
    """Filter one run from an initial belief; differentiable in everything, and works under `vmap`.

    With `checkpoint` the reverse pass keeps only the belief of each epoch and computes the rest again,
    which saves memory and, on small states, time. For many runs `run_filter_batch` is faster.
    """
    one = jax.tree.map(lambda a: jnp.asarray(a)[None], (params, belief, steps))
    output = run_filter_batch(model, *one, checkpoint=checkpoint)
    return jax.tree.map(lambda a: a[0], output)


def run_filter_batch(
    model: Model, params: Parameters, belief: Belief, steps: Steps, *, checkpoint: bool = True
) -> FilterOutput:
    """Filter many runs side by side: every leaf of every argument carries the runs on its first axis.

    Equal to `vmap` of `run_filter`, but with the runs innermost in memory, where the small
    matrices of the filter become long vectors.
    """
    params, belief, steps = jax.tree.map(jnp.asarray, (params, belief, steps))
    inputs = jax.vmap(partial(_inputs, model))(params, steps)
    body = partial(_epoch, model, _lanes_last(params))
    if checkpoint:
        body = jax.checkpoint(body)
    given = _lanes_last((_Moment(steps.dt, inputs), steps.fast, steps.slow))
    _, (instants, innovations) = lax.scan(body, _lanes_last(belief), given)
    instants, innovations = jax.tree.map(lambda a: jnp.moveaxis(a, -1, 0), (instants, innovations))
    return FilterOutput(instants, inputs, innovations)


def _lanes_last(tree: Any) -> Any:
    return jax.tree.map(lambda a: jnp.moveaxis(a, 0, -1), tree)


def _inputs(model: Model, params: Parameters, steps: Steps) -> InputSample | None:
    """The input of every substep of one run, its clock shifted as the calibration says."""
    if model.input is None or steps.knots is None:
        return None
    shift = model.input.clock_offset
    offset = shift(params) if shift is not None else jnp.zeros((), steps.time.dtype)
    return sample(steps.knots, steps.time, steps.dt, offset)
