"""First-order models of a transition and of a measurement, in tangent spaces, for one run."""

from typing import Any

import jax
import jax.numpy as jnp
from jax import Array

from jaxekf import linalg, manifold
from jaxekf.model import Model, Parameters, Sensor
from jaxekf.timeline import Rows


def linearise_transition(
    model: Model, params: Parameters, x: Any, u: Any, dt: Array
) -> tuple[Any, Array, Array]:
    """The predicted state and the Jacobians F (n, n) and G (n, n_w) of its error vector, for one run.

    ``F`` is with respect to the error of ``x``, ``G`` to the process noise; both in the tangent
    space at the prediction.
    """
    size = model.process_noise(params, dt).shape[0]
    dtype = manifold.dtype_of(x)
    still = jnp.zeros(size, dtype)
    predicted = model.transition(x, u, dt, still, params)

    def error(delta: Array, noise: Array) -> Array:
        def moved(x: Any, w: Array) -> Any:
            return model.transition(x, u, dt, w, params)

        changes = (manifold.lift(model.space, x, delta), noise)
        return manifold.lower(model.space, predicted, jax.jvp(moved, (x, still), changes)[1])

    n = model.error_dim
    basis = jnp.eye(n + size, dtype=dtype)
    both = jax.vmap(error, out_axes=1)(basis[:, :n], basis[:, n:])
    return predicted, both[:, :n], both[:, n:]


def linearise_sensor(
    model: Model, sensor: Sensor, params: Parameters, x: Any, u: Any, rows: Rows
) -> tuple[Array, Array, Array]:
    """Residual, Jacobian (rows, n) and noise (rows, rows) of one sample at the state ``x``, for one
    run; hidden rows are inert (no residual, no slope, unit noise)."""
    expected = sensor.predict(x, u, params, rows.aux)

    def error(delta: Array) -> Array:
        def moved(x: Any) -> Any:
            return sensor.predict(x, u, params, rows.aux)

        change = jax.jvp(moved, (x,), (manifold.lift(model.space, x, delta),))[1]
        return manifold.lower(sensor.space, expected, change)

    jacobian = jax.vmap(error, out_axes=1)(jnp.eye(model.error_dim, dtype=manifold.dtype_of(x)))
    value = _neutral(sensor.space, rows.value, rows.mask, expected)
    residual = jnp.where(rows.mask, manifold.local(sensor.space, expected, value), 0.0)
    noise = linalg.mask_covariance(sensor.noise(params, rows.aux, rows.dt), rows.mask)
    return residual, jnp.where(rows.mask[:, None], jacobian, 0.0), noise


def _neutral(space: Any, value: Any, mask: Array, predicted: Any) -> Any:
    """The sample with its hidden numbers replaced by the predicted ones, so that they are inert."""
    leaves, structure = jax.tree.flatten(predicted)
    values = structure.flatten_up_to(value)
    clean = []
    for part, seen, expected in zip(manifold.parts(space), values, leaves, strict=True):
        rows = mask[part.error]
        single = rows if part.manifold.shape == (part.manifold.dim,) else jnp.any(rows)
        clean.append(jnp.where(single, seen, expected))
    return jax.tree.unflatten(structure, clean)
