"""Evaluation of a traced program for many runs: every array carries the runs on its last axis, the lanes.

Like `jax.vmap` over the last axis, but fast for small arrays on a CPU. Small sums and products are unrolled
term by term, so that all arithmetic runs along the lanes. Values that XLA's fusions would compute again for
each of their readers are stored behind a barrier (`materialise`).
"""

import functools
import operator
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax
from jax.experimental.xla_metadata import set_xla_metadata

from jaxekf._support.compilation import KEEPS_BARRIERS
from jaxekf.filtering.lowering.scalar_graph import Constant, Operation, Program, inlined

_COSTLY = {"div": 6.0, "rsqrt": 6.0, "sqrt": 6.0} | dict.fromkeys(
    (
        *("acos", "acosh", "asin", "asinh", "atan", "atan2", "atanh", "cbrt", "cos", "cosh", "erf"),
        *("erfc", "exp", "exp2", "expm1", "log", "log1p", "logistic", "pow", "rem", "sin", "sinh"),
        *("tan", "tanh"),
    ),
    20.0,
)
"""Cost of one entry, in additions."""
ELEMENTWISE = frozenset(
    [
        *("abs", "add", "add_any", "and", "ceil", "clamp", "convert_element_type", "copy"),
        *("copy_p", "eq", "floor", "ge", "gt", "integer_pow", "is_finite", "le", "lt", "max"),
        *("min", "mul", "ne", "neg", "nextafter", "not", "or", "round", "select_n", "sign"),
        *("square", "stop_gradient", "sub", "xor", *_COSTLY),
    ]
)
"""Elementwise operations."""
_REARRANGING = frozenset(
    [
        *("broadcast_in_dim", "concatenate", "pad", "reshape", "rev", "slice", "split", "squeeze"),
        *("stack", "transpose", "unstack"),
    ]
)
_RECOMPUTATION_LIMIT = 24.0
"""Repeated arithmetic per lane, in additions, above which a value gets a loop of its own."""
_LOOP_LIMIT = 64.0
"""Largest arithmetic in one loop, in additions: compile time grows faster than the length of a loop."""


def materialise(tree: Any) -> Any:
    """The same tree, with each of its arrays computed once and stored: no fusion crosses it."""
    return jax.tree.map(_barrier, tree)


def _barrier(array: Array) -> Array:
    if KEEPS_BARRIERS:
        return lax.optimization_barrier(array)
    # A call that is not inlined stays.
    with set_xla_metadata(inlineable="false", xla_cpu_small_call="false"):
        return jax.jit(lax.optimization_barrier)(array)


def unrolled_sum(terms: Sequence[Array]) -> Array:
    """The sum of a few arrays, left to right."""
    return functools.reduce(operator.add, terms)


def pairwise_sum(x: Array, axis: int, keep: bool = False) -> Array:
    """The sum along one of the first axes, pairwise: few operations, all of them along the lanes.

    With `keep` the axis stays, with length 1.
    """
    rest, size = None, x.shape[axis]
    while size > 1:
        half = size // 2
        lower = lax.slice_in_dim(x, 0, half, axis=axis)
        upper = lax.slice_in_dim(x, half, 2 * half, axis=axis)
        if size % 2:
            last = lax.slice_in_dim(x, size - 1, size, axis=axis)
            rest = last if rest is None else rest + last
        x, size = lower + upper, half
    total = x if rest is None else x + rest
    return total if keep else lax.squeeze(total, (axis,))


def broadcast_axes(x: Array, shape: tuple[int, ...], *places: int) -> Array:
    """`x` broadcast to `shape` in one operation: its axes go to `places`, its lanes stay last."""
    return lax.broadcast_in_dim(x, shape, (*places, len(shape) - 1))


def broadcast_lanes(value: Any, lanes: int) -> Array:
    """A value without lanes, broadcast to all lanes."""
    value = jnp.asarray(value)
    return lax.broadcast_in_dim(value, (*value.shape, lanes), tuple(range(value.ndim)))


def evaluate(program: Program, values: Sequence[Array]) -> Any:
    """The outputs of `program`, lanes last; so are `values`, its inputs."""
    lanes = values[0].shape[-1]
    found = _evaluate(program, list(values), lanes)
    return jax.tree.unflatten(program.tree, [with_lanes(v, lanes) for v in found])


class Unbatched:
    """A value without lanes: a constant, or computed from constants only."""

    def __init__(self, value: Any) -> None:
        self.value = value


def with_lanes(value: Any, lanes: int) -> Array:
    """A value with lanes, broadcast if it is `Unbatched`."""
    return broadcast_lanes(value.value, lanes) if isinstance(value, Unbatched) else value


def _evaluate(program: Program, values: list[Any], lanes: int) -> list[Any]:
    known: dict[int, Any] = dict(enumerate(values))
    kept = _values_to_materialise(program)

    def read(operand: Any) -> Any:
        return Unbatched(operand.value) if isinstance(operand, Constant) else known[operand]

    for operation in program.operations:
        found = apply_operation(operation, [read(i) for i in operation.inputs], lanes)
        for output, value in zip(operation.outputs, found, strict=True):
            keep = output in kept and not isinstance(value, Unbatched)
            known[output] = materialise(value) if keep else value
    return [read(output) for output in program.outputs]


def unsupported(program: Program) -> list[str]:
    """Names of the operations without a rule here, which `vmap` batches."""
    names = []
    for operation in program.operations:
        name = operation.primitive.name
        if name == "custom_jvp_call":
            names += unsupported(inlined(operation))
        elif name not in ELEMENTWISE and name not in _RULES:
            names.append(name)
    return list(dict.fromkeys(names))


def apply_operation(operation: Operation, operands: list[Any], lanes: int) -> list[Any]:
    """The outputs of one operation; operands are arrays with lanes, or `Unbatched`."""
    name = operation.primitive.name
    if all(isinstance(o, Unbatched) for o in operands):
        return [Unbatched(v) for v in operation.bind([o.value for o in operands])]
    if name == "custom_jvp_call":
        return _evaluate(inlined(operation), operands, lanes)
    if name in ELEMENTWISE:
        shape = (*operation.shapes[0].shape, lanes)
        return operation.bind([_elementwise_operand(o, shape) for o in operands])
    rule = _RULES.get(name)
    found = None if rule is None else rule(operation, operands, lanes)
    return _apply_by_vmap(operation, operands) if found is None else found


def _elementwise_operand(operand: Any, shape: tuple[int, ...]) -> Any:
    """An operand of an elementwise operation, in the shape of its result."""
    if isinstance(operand, Unbatched):
        value = operand.value
        return lax.broadcast_in_dim(jnp.asarray(value), shape, tuple(range(np.ndim(value))))
    return fit_shape(operand, shape)


def fit_shape(array: Array, shape: tuple[int, ...]) -> Array:
    """A scalar with lanes, or an array with axes of length 1, broadcast to `shape`."""
    return array if array.shape == shape else broadcast_axes(array, shape, *range(array.ndim - 1))


def _apply_by_vmap(operation: Operation, operands: list[Any]) -> list[Any]:
    """An operation without a rule here, batched by JAX."""
    plain = [o.value if isinstance(o, Unbatched) else o for o in operands]
    axes = [None if isinstance(o, Unbatched) else -1 for o in operands]
    return jax.vmap(lambda *v: operation.bind(v), in_axes=axes, out_axes=-1)(*plain)


# --- which values to materialise ----------------------------------------------------------------------


def _values_to_materialise(program: Program) -> set[int]:
    """The values to store: those that fusions would compute again for many readers, or that are costly."""
    uses: dict[int, list[Operation]] = {}
    for operation in program.operations:
        for i in operation.inputs:
            if not isinstance(i, Constant):
                uses.setdefault(i, []).append(operation)
    cost: dict[int, float] = dict.fromkeys(range(len(program.inputs)), 0.0)
    kept: set[int] = set()
    results = {o for o in program.outputs if not isinstance(o, Constant)}
    for operation in program.operations:
        inside = [
            0.0 if i in kept else cost[i] for i in operation.inputs if not isinstance(i, Constant)
        ]
        own = _own_cost(operation) + sum(inside) * _reads_per_entry(operation)
        for output, spec in zip(operation.outputs, operation.shapes, strict=True):
            size = int(np.prod(spec.shape, dtype=int))
            reads = sum(map(_reads, uses.get(output, ()))) + (size if output in results else 0)
            cost[output] = own
            if own > 0.0 and ((reads - size) * own >= _RECOMPUTATION_LIMIT or own > _LOOP_LIMIT):
                kept.add(output)
    return kept


def _own_cost(operation: Operation) -> float:
    name = operation.primitive.name
    if name in _REARRANGING:
        return 0.0
    if name == "custom_jvp_call":
        return sum(map(_own_cost, inlined(operation).operations))
    if name == "dot_general" or name in _REDUCTIONS:
        return float(_reads_per_entry(operation))
    return _COSTLY.get(name, 1.0)


def _reads_per_entry(operation: Operation) -> int:
    """Number of entries of each operand that one entry of the result reads."""
    name, params = operation.primitive.name, operation.params
    if name == "dot_general":
        left = operation.operands[0].shape
        return max(1, _size([left[a] for a in params["dimension_numbers"][0][0]]))
    if name in _REDUCTIONS:
        return max(1, _size([operation.operands[0].shape[a] for a in params["axes"]]))
    return 1


def _reads(operation: Operation) -> int:
    """Number of reads of an operand's entries for the whole result."""
    return _size(operation.shapes[0].shape) * _reads_per_entry(operation)


def _size(shape: Sequence[int]) -> int:
    return int(np.prod(shape, dtype=int))


# --- batching rules: (operation, operands, lanes) to the outputs, or None to leave it to `vmap` ----------

Rule = Callable[[Operation, list[Any], int], list[Any] | None]


def _with_lane_axis(change: Callable[[dict[str, Any], int, int], dict[str, Any]]) -> Rule:
    """Rule of an operation with one operand, whose parameters are extended by the lanes axis.

    ``change(params, rank, lanes)`` gives the new parameters; `rank` is that of the operand without lanes.
    """

    def rule(operation: Operation, operands: list[Any], lanes: int) -> list[Any]:
        params = operation.params | change(operation.params, operands[0].ndim - 1, lanes)
        return operation._replace(params=params).bind(operands)

    return rule


def _broadcast(operation: Operation, operands: list[Any], lanes: int) -> list[Any]:
    shape, places = operation.params["shape"], operation.params["broadcast_dimensions"]
    return [broadcast_axes(operands[0], (*shape, lanes), *places)]


def _pad(operation: Operation, operands: list[Any], lanes: int) -> list[Any] | None:
    array, filling = operands
    if isinstance(array, Unbatched) or not isinstance(filling, Unbatched):
        return None
    return [lax.pad(array, filling.value, (*operation.params["padding_config"], (0, 0, 0)))]


def _concatenate(operation: Operation, operands: list[Any], lanes: int) -> list[Any]:
    """Concatenation or stacking of several operands."""
    return operation.bind([with_lanes(o, lanes) for o in operands])


def _reduction_rule(function: Callable[[Any, Any], Any]) -> Rule:
    def rule(operation: Operation, operands: list[Any], lanes: int) -> list[Any] | None:
        (array,) = operands
        axes = operation.params["axes"]
        if not _size([array.shape[a] for a in axes]):
            return None
        for axis in sorted(axes, reverse=True):
            if function is lax.add:
                array = pairwise_sum(array, axis)
                continue
            parts = [lax.index_in_dim(array, k, axis, False) for k in range(array.shape[axis])]
            array = functools.reduce(function, parts)
        return [array]

    return rule


def _dot_general(operation: Operation, operands: list[Any], lanes: int) -> list[Any]:
    (left_sum, right_sum), (left_batch, right_batch) = operation.params["dimension_numbers"]
    left, right = (
        jnp.asarray(o.value)[..., None] if isinstance(o, Unbatched) else o for o in operands
    )
    left_free = [a for a in range(left.ndim - 1) if a not in (*left_sum, *left_batch)]
    right_free = [a for a in range(right.ndim - 1) if a not in (*right_sum, *right_batch)]
    # All products, (batch, left, right, sums, lanes), and then the sums.
    order = [*left_batch, *left_free, *left_sum]
    sizes = [left.shape[a] for a in (*left_batch, *left_free)]
    sizes += [right.shape[a] for a in right_free]
    shape = (*sizes, *[left.shape[a] for a in left_sum], lanes)
    batch, free, end = len(left_batch), len(left_free), len(sizes)
    places = dict(zip(order, [*range(batch + free), *range(end, len(shape) - 1)], strict=True))
    order = [*right_batch, *right_free, *right_sum]
    others = [*range(batch), *range(batch + free, end), *range(end, len(shape) - 1)]
    other_places = dict(zip(order, others, strict=True))
    found = _broadcast_operand(left, shape, places) * _broadcast_operand(right, shape, other_places)
    for axis in reversed(range(end, len(shape) - 1)):
        found = pairwise_sum(found, axis)
    return [found]


def _broadcast_operand(array: Array, shape: tuple[int, ...], places: dict[int, int]) -> Array:
    """`array` broadcast to `shape`, its axes at `places` and the lanes last."""
    axes = sorted(range(array.ndim - 1), key=lambda a: places[a])
    if axes != list(range(array.ndim - 1)):
        array = lax.transpose(array, (*axes, array.ndim - 1))
    return broadcast_axes(array, shape, *sorted(places.values()))


_REDUCTIONS = {
    "reduce_and": lax.bitwise_and,
    "reduce_max": lax.max,
    "reduce_min": lax.min,
    "reduce_or": lax.bitwise_or,
    "reduce_sum": lax.add,
}


def _slice_params(params: dict[str, Any], rank: int, lanes: int) -> dict[str, Any]:
    strides = params["strides"]
    return {
        "start_indices": (*params["start_indices"], 0),
        "limit_indices": (*params["limit_indices"], lanes),
        "strides": None if strides is None else (*strides, 1),
    }


_RULES: dict[str, Rule] = {
    "broadcast_in_dim": _broadcast,
    "concatenate": _concatenate,
    "dot_general": _dot_general,
    "pad": _pad,
    "reshape": _with_lane_axis(
        lambda params, rank, lanes: {"new_sizes": (*params["new_sizes"], lanes)}
    ),
    "rev": _with_lane_axis(lambda params, rank, lanes: {}),
    "slice": _with_lane_axis(_slice_params),
    "split": _with_lane_axis(lambda params, rank, lanes: {}),
    "squeeze": _with_lane_axis(lambda params, rank, lanes: {}),
    "stack": _concatenate,
    "transpose": _with_lane_axis(
        lambda params, rank, lanes: {"permutation": (*params["permutation"], rank)}
    ),
    "unstack": _with_lane_axis(lambda params, rank, lanes: {}),
} | {name: _reduction_rule(function) for name, function in _REDUCTIONS.items()}
