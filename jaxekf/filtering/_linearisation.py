"""First-order models of a transition and of a measurement, in tangent spaces, for one run."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxekf.filtering.lowering import lanes, scalar_graph
from jaxekf.filtering.lowering.group_derivative import derivative
from jaxekf.filtering.lowering.scalar_graph import Constant
from jaxekf.filtering.lowering.structured_matrix import Pattern, take
from jaxekf.filtering.model import Model, Parameters, Sensor
from jaxekf.filtering.steps import Rows
from jaxekf.geometry import manifold
from jaxekf.geometry.manifold import Euclidean, Manifold


class Jacobian(NamedTuple):
    """A Jacobian in tangent spaces as blocks, a row of blocks for each part of the function's result."""

    blocks: dict[tuple[int, int], Array]
    """By row and column of blocks; what is left out is zero."""
    rows: tuple[int, ...]
    """Height of each row of blocks."""
    columns: tuple[int, ...]
    """Width of each column of blocks."""
    dtype: Any

    def part(self, rows: range | tuple[int, ...], columns: range | tuple[int, ...]) -> Array:
        """The entries at the given rows and columns, in ascending order."""
        found = []
        for i, above in _cut(self.rows, rows):
            line = []
            for j, left in _cut(self.columns, columns):
                block = self.blocks.get((i, j))
                if block is None:
                    block = np.zeros((len(above), len(left)), self.dtype)
                else:
                    block = take(take(block, above, 0), left, 1)
                line.append(block)
            found.append(_joined(line, 1))
        return _joined(found, 0)

    def dense(self) -> Array:
        """The whole matrix."""
        return jnp.asarray(self.part(range(sum(self.rows)), range(sum(self.columns))))

    def bands(self, p: Pattern) -> tuple[Array, ...]:
        """The unknown bands of a pattern."""
        return tuple(jnp.asarray(self.part(rows, cols)) for rows, cols in p.bands)


def _joined(pieces: list[Any], axis: int) -> Any:
    return pieces[0] if len(pieces) == 1 else jnp.concatenate(pieces, axis)


def _cut(
    sizes: tuple[int, ...], index: range | tuple[int, ...]
) -> list[tuple[int, tuple[int, ...]]]:
    """The blocks that contain the given rows or columns, and which of theirs these are."""
    found, start = [], 0
    for i, size in enumerate(sizes):
        own = tuple(k - start for k in index if start <= k < start + size)
        if own:
            found.append((i, own))
        start += size
    return found


def _spaces(space: Any) -> list[Manifold]:
    return [part.manifold for part in manifold.parts(space)]


def _dims(manifolds: list[Manifold]) -> tuple[int, ...]:
    return tuple(m.dim for m in manifolds)


class LinearTransition(NamedTuple):
    """A transition linearised."""

    mean: Any
    """The predicted state."""
    f: Jacobian
    """(n, n) by the error of the state before."""
    g: Jacobian
    """(n, n_w) by the process noise."""
    left: tuple[str, ...]
    """As in `group_derivative.Derivative`."""


def transition_blocks(
    model: Model, params: Parameters, x: Any, u: Any, dt: Array
) -> LinearTransition:
    """The predicted state and its Jacobians, in the tangent space at the prediction, for one run."""
    size = model.process_noise(params, dt).shape[0]
    dtype = manifold.dtype_of(x)

    def moved(x: Any, w: Array) -> Any:
        return model.transition(x, u, dt, w, params)

    state, noise = _spaces(model.space), Euclidean(size)
    found = derivative(moved, (x, jnp.zeros(size, dtype)), (state, [noise]), state)
    dims, last = _dims(state), len(state)
    f = {at: block for at, block in found.blocks.items() if at[1] < last}
    g = {(i, 0): block for (i, j), block in found.blocks.items() if j == last}
    return LinearTransition(
        found.value, Jacobian(f, dims, dims, dtype), Jacobian(g, dims, (size,), dtype), found.left
    )


def linearise_transition(
    model: Model, params: Parameters, x: Any, u: Any, dt: Array
) -> tuple[Any, Array, Array]:
    """The predicted state and the Jacobians F (n, n) and G (n, n_w) of its error vector, for one run.

    ``F`` is with respect to the error of ``x``, ``G`` to the process noise; both in the tangent space at
    the prediction.
    """
    found = transition_blocks(model, params, x, u, dt)
    return found.mean, found.f.dense(), found.g.dense()


class LinearSample(NamedTuple):
    """A sample linearised at a state."""

    residual: Array
    """(rows,) measured minus expected, in the sensor's error vector; 0 where hidden."""
    slope: Jacobian
    """(rows, n) of the expected sample; of hidden rows too, which the caller leaves out."""
    left: tuple[str, ...]
    """As in `group_derivative.Derivative`."""


def sample_blocks(
    model: Model, sensor: Sensor, params: Parameters, x: Any, u: Any, rows: Rows
) -> LinearSample:
    """Residual and Jacobian of one sample at the state ``x``, for one run."""

    def predict(x: Any) -> Any:
        return sensor.predict(x, u, params, rows.aux)

    state, seen = _spaces(model.space), _spaces(sensor.space)
    found = derivative(predict, (x,), (state,), seen)
    value = _neutral(sensor.space, rows.value, rows.mask, found.value)
    residual = jnp.where(rows.mask, manifold.local(sensor.space, found.value, value), 0.0)
    slope = Jacobian(found.blocks, _dims(seen), _dims(state), manifold.dtype_of(x))
    return LinearSample(residual, slope, found.left)


def linearise_sensor(
    model: Model, sensor: Sensor, params: Parameters, x: Any, u: Any, rows: Rows
) -> tuple[Array, Array, Array]:
    """Residual, Jacobian (rows, n) and noise (rows, rows) of one sample at the state ``x``, for one run.

    Hidden rows have no residual; their slope and noise are left to the caller.
    """
    found = sample_blocks(model, sensor, params, x, u, rows)
    return found.residual, found.slope.dense(), sensor.noise(params, rows.aux, rows.dt)


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


class LinearBetween(NamedTuple):
    """A transition linearised about a path that may miss it."""

    missed: Array
    """(n,) the error of the transition's end counted from the path's."""
    f: Jacobian
    g: Jacobian


def between_blocks(
    model: Model, params: Parameters, x: Any, after: Any, w: Array, u: Any, dt: Array
) -> LinearBetween:
    """How far the transition from ``x`` with process noise ``w`` misses ``after``, for one run.

    The Jacobians are those of the error vector counted from ``after``: exact, whatever the distance.
    """
    state, noise = _spaces(model.space), Euclidean(w.shape[0])

    def missed(x: Any, w: Array) -> Any:
        return manifold.local(model.space, after, model.transition(x, u, dt, w, params))

    vector = Euclidean(model.error_dim)
    found = derivative(missed, (x, w), (state, [noise]), [vector])
    dims, last, dtype = _dims(state), len(state), manifold.dtype_of(x)
    f = {at: block for at, block in found.blocks.items() if at[1] < last}
    g = {(i, 0): block for (i, j), block in found.blocks.items() if j == last}
    return LinearBetween(
        found.value,
        Jacobian(f, (model.error_dim,), dims, dtype),
        Jacobian(g, (model.error_dim,), (noise.dim,), dtype),
    )


def residual_blocks(
    model: Model, sensor: Sensor, params: Parameters, x: Any, u: Any, rows: Rows
) -> LinearSample:
    """As `sample_blocks`, but with the Jacobian of the residual itself, its sign turned: where a
    sample is curved the two differ by how far it is away."""

    here = sensor.predict(x, u, params, rows.aux)
    value = _neutral(sensor.space, rows.value, rows.mask, here)

    def residual(x: Any) -> Array:
        found = manifold.local(sensor.space, sensor.predict(x, u, params, rows.aux), value)
        return jnp.where(rows.mask, found, 0.0)

    state = _spaces(model.space)
    found = derivative(residual, (x,), (state,), [Euclidean(sensor.rows)])
    blocks = {at: -block for at, block in found.blocks.items()}
    slope = Jacobian(blocks, (sensor.rows,), _dims(state), manifold.dtype_of(x))
    return LinearSample(found.value, slope, found.left)


def variances(function: Callable[..., Array], *args: Any) -> Array:
    """The diagonal of the square matrix ``function(*args)``, made without the rest where its operations
    allow that."""
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
