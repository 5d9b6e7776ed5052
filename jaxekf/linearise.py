"""First-order models of a transition and of a measurement, in tangent spaces, for one run."""

from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxekf import manifold
from jaxekf.model import Model, Parameters, Sensor
from jaxekf.timeline import Rows


def linearise_transition(
    model: Model,
    params: Parameters,
    x: Any,
    u: Any,
    dt: Array,
    state_columns: Sequence[int] | None = None,
    noise_columns: Sequence[int] | None = None,
) -> tuple[Any, Array, Array]:
    """The predicted state and the Jacobians F (n, n) and G (n, n_w) of its error vector, for one run.

    ``F`` is with respect to the error of ``x``, ``G`` to the process noise; both in the tangent
    space at the prediction. Of each, only the columns named are made (None for all).
    """
    size = model.process_noise(params, dt).shape[0]
    dtype = manifold.dtype_of(x)
    still = jnp.zeros(size, dtype)

    def moved(x: Any, w: Array) -> Any:
        return model.transition(x, u, dt, w, params)

    predicted = moved(x, still)

    def by_noise(noise: Array) -> Array:
        found = jax.jvp(lambda w: moved(x, w), (still,), (noise,))[1]
        return manifold.lower(model.space, predicted, found)

    f = _by_parts(
        model, lambda x: moved(x, still), x, lambda change: manifold.lower(model.space, predicted, change),
        model.error_dim, state_columns,
    )  # fmt: skip
    return predicted, f, _columns(by_noise, size, dtype, model.error_dim, noise_columns)


def linearise_sensor(
    model: Model,
    sensor: Sensor,
    params: Parameters,
    x: Any,
    u: Any,
    rows: Rows,
    columns: Sequence[int] | None = None,
) -> tuple[Array, Array, Array]:
    """Residual, Jacobian (rows, n) and noise (rows, rows) of one sample at the state ``x``, for one run.

    Hidden rows have no residual; their slope and noise are left to the caller. Of the Jacobian only the
    columns named are made (None for all).
    """
    expected = sensor.predict(x, u, params, rows.aux)

    def predict(x: Any) -> Any:
        return sensor.predict(x, u, params, rows.aux)

    def lower(change: Any) -> Array:
        return manifold.lower(sensor.space, expected, change)

    jacobian = _by_parts(model, predict, x, lower, sensor.rows, columns)
    value = _neutral(sensor.space, rows.value, rows.mask, expected)
    residual = jnp.where(rows.mask, manifold.local(sensor.space, expected, value), 0.0)
    return residual, jacobian, sensor.noise(params, rows.aux, rows.dt)


def _by_parts(
    model: Model,
    function: Callable[[Any], Any],
    x: Any,
    lower: Callable[[Any], Array],
    rows: int,
    columns: Sequence[int] | None,
) -> Array:
    """The Jacobian of a function of the state, its columns part by part of the state.

    A part is differentiated with the others held, so that their derivatives need no arithmetic.
    """
    leaves, structure = jax.tree.flatten(x)
    dtype = manifold.dtype_of(x)
    found = []
    for i, part in enumerate(manifold.parts(model.space)):
        chosen = [
            c - part.error.start for c in columns or () if c in range(model.error_dim)[part.error]
        ]

        def derivative(delta: Array, i: int = i, part: manifold.Part = part) -> Array:
            def moved(leaf: Array) -> Any:
                return function(
                    jax.tree.unflatten(structure, [*leaves[:i], leaf, *leaves[i + 1 :]])
                )

            change = part.manifold.lift(leaves[i], delta)
            return lower(jax.jvp(moved, (leaves[i],), (change,))[1])

        wanted = None if columns is None else chosen
        found.append(_columns(derivative, part.manifold.dim, dtype, rows, wanted))
    return jnp.concatenate(found, axis=1)


def _columns(
    derivative: Any, size: int, dtype: Any, rows: int, columns: Sequence[int] | None
) -> Array:
    """The chosen columns of a Jacobian, (rows, columns)."""
    basis = np.eye(size)
    basis = basis if columns is None else basis[list(columns)]
    if basis.shape[0] == 0:
        return jnp.zeros((rows, 0), dtype)
    return jax.vmap(derivative, out_axes=1)(jnp.asarray(basis, dtype))


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


def linearise_between(
    model: Model, params: Parameters, x: Any, after: Any, w: Array, u: Any, dt: Array
) -> tuple[Array, Array, Array]:
    """How far the transition from ``x`` with process noise ``w`` misses ``after``, for one run.

    The error vector (n,) counted from ``after``, and its Jacobians F (n, n) and G (n, n_w) by the error of
    ``x`` and by ``w``: exact, whatever the distance.
    """

    def missed(delta: Array, w: Array) -> Array:
        moved = model.transition(manifold.retract(model.space, x, delta), u, dt, w, params)
        return manifold.local(model.space, after, moved)

    here = jnp.zeros(model.error_dim, manifold.dtype_of(x))
    f, g = jax.jacfwd(missed, (0, 1))(here, w)
    return missed(here, w), f, g


def linearise_residual(
    model: Model, sensor: Sensor, params: Parameters, x: Any, u: Any, rows: Rows
) -> tuple[Array, Array, Array]:
    """As `linearise_sensor`, but with the Jacobian of the residual itself, its sign turned: where a
    sample is curved the two differ by how far it is away."""

    def residual(delta: Array) -> Array:
        expected = sensor.predict(manifold.retract(model.space, x, delta), u, params, rows.aux)
        value = _neutral(sensor.space, rows.value, rows.mask, expected)
        found = manifold.local(sensor.space, expected, value)
        return jnp.where(rows.mask, found, 0.0)

    here = jnp.zeros(model.error_dim, manifold.dtype_of(x))
    slope = -jax.jacfwd(residual)(here)
    return residual(here), slope, sensor.noise(params, rows.aux, rows.dt)
