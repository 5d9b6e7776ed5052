"""Transitions and sensors linearised in tangent spaces, for one run (docs/mathematics.md, section 1).

`jaxekf.filtering._lowered_model` compiles these functions for the batch axis. Each comes in two kinds: at
an estimate, as the extended Kalman filter needs it, and about a path, as Gauss-Newton needs it.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxekf.filtering.lowering import lanes, scalar_graph
from jaxekf.filtering.lowering.group_derivative import Derivative, derivative
from jaxekf.filtering.lowering.scalar_graph import Constant
from jaxekf.filtering.lowering.structured_matrix import Bands, Pattern, take_slices
from jaxekf.filtering.model import Model, Parameters, Sensor
from jaxekf.filtering.steps import Rows
from jaxekf.geometry import manifold
from jaxekf.geometry.manifold import Euclidean, Manifold


class Jacobian(NamedTuple):
    """A Jacobian between tangent spaces, in blocks.

    One row of blocks for each part of the function's value, one column for each part of its arguments.
    """

    blocks: dict[tuple[int, int], Array]
    """By row and column of blocks; blocks that are not here are zero."""
    heights: tuple[int, ...]
    """Number of matrix rows of each row of blocks."""
    widths: tuple[int, ...]
    """Number of matrix columns of each column of blocks."""
    dtype: Any

    def submatrix(self, rows: range | tuple[int, ...], columns: range | tuple[int, ...]) -> Array:
        """The entries at the given rows and columns, in ascending order."""
        found = []
        for i, above in _blocks_at(self.heights, rows):
            line = []
            for j, left in _blocks_at(self.widths, columns):
                block = self.blocks.get((i, j))
                if block is None:
                    block = np.zeros((len(above), len(left)), self.dtype)
                else:
                    block = take_slices(take_slices(block, above, 0), left, 1)
                line.append(block)
            found.append(_concatenated(line, 1))
        return _concatenated(found, 0)

    def dense(self) -> Array:
        """The whole matrix."""
        return jnp.asarray(self.submatrix(range(sum(self.heights)), range(sum(self.widths))))

    def bands(self, p: Pattern) -> Bands:
        """The unknown bands of the matrix, whose sparsity is `p`."""
        return tuple(jnp.asarray(self.submatrix(rows, cols)) for rows, cols in p.bands)


def _concatenated(arrays: list[Any], axis: int) -> Any:
    return arrays[0] if len(arrays) == 1 else jnp.concatenate(arrays, axis)


def _blocks_at(
    sizes: tuple[int, ...], index: range | tuple[int, ...]
) -> list[tuple[int, tuple[int, ...]]]:
    """The blocks that contain the given rows (or columns), and the numbers of these rows inside each."""
    found, start = [], 0
    for i, size in enumerate(sizes):
        own = tuple(k - start for k in index if start <= k < start + size)
        if own:
            found.append((i, own))
        start += size
    return found


def _manifolds(space: Any) -> list[Manifold]:
    return [part.manifold for part in manifold.parts(space)]


def _dims(manifolds: list[Manifold]) -> tuple[int, ...]:
    return tuple(m.dim for m in manifolds)


# --- transitions --------------------------------------------------------------------------------------


class LinearTransition(NamedTuple):
    """A transition linearised."""

    end: Any
    """At an estimate the predicted state; about a path the defect, (n,): the error vector of the
    transition's end in the chart of the path's state there."""
    f: Jacobian
    """(n, n) by the error vector of the state before."""
    g: Jacobian
    """(n, n_w) by the process noise."""
    fallbacks: tuple[str, ...]
    """As in `group_derivative.Derivative`."""


def transition_at_estimate(
    model: Model, params: Parameters, x: Any, u: Any, dt: Array
) -> LinearTransition:
    """The predicted state and its Jacobians, in the tangent space at the prediction, for one run."""
    size = model.process_noise(params, dt).shape[0]
    dtype = manifold.dtype_of(x)

    def predict(x: Any, w: Array) -> Any:
        return model.transition(x, u, dt, w, params)

    state = _manifolds(model.space)
    found = derivative(predict, (x, jnp.zeros(size, dtype)), (state, [Euclidean(size)]), state)
    return _linear_transition(found, state, _dims(state), size, dtype)


def transition_about_path(
    model: Model, params: Parameters, x: Any, after: Any, w: Array, u: Any, dt: Array
) -> LinearTransition:
    """The defect of the transition from ``x`` with process noise ``w`` to ``after``, for one run.

    The Jacobians are those of the error vector in the chart of ``after``: exact for a defect of any size.
    """
    state, size = _manifolds(model.space), w.shape[0]

    def defect(x: Any, w: Array) -> Any:
        return manifold.local(model.space, after, model.transition(x, u, dt, w, params))

    vector = Euclidean(model.error_dim)
    found = derivative(defect, (x, w), (state, [Euclidean(size)]), [vector])
    return _linear_transition(found, state, (model.error_dim,), size, manifold.dtype_of(x))


def _linear_transition(
    found: Derivative, state: list[Manifold], heights: tuple[int, ...], noise_dim: int, dtype: Any
) -> LinearTransition:
    """The derivative by state and process noise, taken apart."""
    last = len(state)
    f = {at: block for at, block in found.blocks.items() if at[1] < last}
    g = {(i, 0): block for (i, j), block in found.blocks.items() if j == last}
    return LinearTransition(
        found.value,
        Jacobian(f, heights, _dims(state), dtype),
        Jacobian(g, heights, (noise_dim,), dtype),
        found.fallbacks,
    )


def linearise_transition(
    model: Model, params: Parameters, x: Any, u: Any, dt: Array
) -> tuple[Any, Array, Array]:
    """The predicted state and the Jacobians F (n, n) and G (n, n_w) of its error vector, for one run.

    ``F`` is by the error of ``x``, ``G`` by the process noise; both in the tangent space at the prediction.
    """
    found = transition_at_estimate(model, params, x, u, dt)
    return found.end, found.f.dense(), found.g.dense()


# --- sensors ------------------------------------------------------------------------------------------


class LinearSensor(NamedTuple):
    """One sample of a sensor linearised at a state."""

    residual: Array
    """(m,) measured minus predicted, in the sensor's error vector; 0 in hidden rows."""
    jacobian: Jacobian
    """H, (m, n), of the predicted sample; hidden rows are not cleared."""
    fallbacks: tuple[str, ...]
    """As in `group_derivative.Derivative`."""


def sensor_at_estimate(
    model: Model, sensor: Sensor, params: Parameters, x: Any, u: Any, rows: Rows
) -> LinearSensor:
    """Residual of one sample at the state ``x``, and the Jacobian of the predicted sample, for one run."""

    def predict(x: Any) -> Any:
        return sensor.predict(x, u, params, rows.aux)

    state, sample = _manifolds(model.space), _manifolds(sensor.space)
    found = derivative(predict, (x,), (state,), sample)
    value = _replace_hidden(sensor.space, rows.value, rows.mask, found.value)
    residual = jnp.where(rows.mask, manifold.local(sensor.space, found.value, value), 0.0)
    jacobian = Jacobian(found.blocks, _dims(sample), _dims(state), manifold.dtype_of(x))
    return LinearSensor(residual, jacobian, found.fallbacks)


def sensor_about_path(
    model: Model, sensor: Sensor, params: Parameters, x: Any, u: Any, rows: Rows
) -> LinearSensor:
    """As `sensor_at_estimate`, with the Jacobian of the residual itself, its sign changed.

    The two Jacobians differ where the sample's space is curved, by an amount that grows with the residual.
    """
    predicted = sensor.predict(x, u, params, rows.aux)
    value = _replace_hidden(sensor.space, rows.value, rows.mask, predicted)

    def residual(x: Any) -> Array:
        found = manifold.local(sensor.space, sensor.predict(x, u, params, rows.aux), value)
        return jnp.where(rows.mask, found, 0.0)

    state = _manifolds(model.space)
    found = derivative(residual, (x,), (state,), [Euclidean(sensor.rows)])
    blocks = {at: -block for at, block in found.blocks.items()}
    jacobian = Jacobian(blocks, (sensor.rows,), _dims(state), manifold.dtype_of(x))
    return LinearSensor(found.value, jacobian, found.fallbacks)


def linearise_sensor(
    model: Model, sensor: Sensor, params: Parameters, x: Any, u: Any, rows: Rows
) -> tuple[Array, Array, Array]:
    """Residual (m,), Jacobian (m, n) and noise (m, m) of one sample at the state ``x``, for one run.

    The residual is 0 in hidden rows; their Jacobian and noise are not cleared.
    """
    found = sensor_at_estimate(model, sensor, params, x, u, rows)
    return found.residual, found.jacobian.dense(), sensor.noise(params, rows.aux, rows.dt)


def _replace_hidden(space: Any, value: Any, mask: Array, predicted: Any) -> Any:
    """The sample with its hidden numbers, NaN perhaps, replaced by the predicted ones."""
    leaves, structure = jax.tree.flatten(predicted)
    values = structure.flatten_up_to(value)
    clean = []
    for part, measured, expected in zip(manifold.parts(space), values, leaves, strict=True):
        rows = mask[part.error]
        visible = rows if part.manifold.shape == (part.manifold.dim,) else jnp.any(rows)
        clean.append(jnp.where(visible, measured, expected))
    return jax.tree.unflatten(structure, clean)


# --- noise --------------------------------------------------------------------------------------------


def variances(function: Callable[..., Array], *args: Any) -> Array:
    """The diagonal (n,) of the square matrix ``function(*args)``.

    Entries off the diagonal are not computed where the function's operations allow that.
    """
    leaves, structure = jax.tree.flatten(args)
    flat = scalar_graph.trace(lambda *v: function(*jax.tree.unflatten(structure, v)), *leaves)
    values: dict[Any, Any] = dict(enumerate(leaves))
    makers: dict[Any, scalar_graph.Operation] = {}

    def value(operand: Any) -> Any:
        return operand.value if isinstance(operand, Constant) else values[operand]

    for operation in flat.operations:
        found = operation.bind([value(i) for i in operation.inputs])
        values.update(zip(operation.outputs, found, strict=True))
        makers.update(dict.fromkeys(operation.outputs, operation))

    def diagonal(operand: Any) -> Any:
        maker = None if isinstance(operand, Constant) else makers.get(operand)
        size = np.shape(value(operand))[0]
        if maker is not None and maker.primitive.name in lanes.ELEMENTWISE:
            return maker.bind(
                [diagonal(i) if np.ndim(value(i)) else value(i) for i in maker.inputs]
            )[0]
        if maker is not None and maker.primitive.name == "broadcast_in_dim":
            (source,) = maker.inputs
            if np.ndim(value(source)) == 0:
                return jnp.broadcast_to(value(source), (size,))
        return jnp.stack([value(operand)[i, i] for i in range(size)])

    return diagonal(flat.outputs[0])
