"""The same work for many runs at once, the runs on the last axis of every array: the lanes.

`jax.vmap` may put the runs on any axis, and turns small matrix products into batches of small matrix
products. Here every operation keeps the axes it had and gains one at the end, and products and sums
over a few numbers are written out, so that the innermost loop is always over runs.
"""

import functools
import itertools
import operator
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax

from jaxekf.programs import Constant, Operation, Program

ELEMENTWISE = frozenset(
    """abs acos acosh add add_any and asin asinh atan atan2 atanh cbrt ceil clamp convert_element_type
    copy copy_p cos cosh div eq erf erfc exp exp2 expm1 floor ge gt integer_pow is_finite le log log1p
    logistic lt max min mul ne neg nextafter not or pow rem round rsqrt select_n sign sin sinh sqrt
    square sub tan tanh xor""".split()
)
_LARGEST_SUM = 64
_PLAIN = ELEMENTWISE | frozenset(
    """broadcast_in_dim concatenate dot_general iota pad reduce_and reduce_max reduce_min reduce_or
    reduce_sum reshape rev slice split squeeze stack transpose unstack""".split()
)


def evaluate(program: Program, values: Sequence[Any], lanes: int) -> Any:
    """The outputs of `program`, all with lanes; each of `values` carries the lanes on its last axis."""
    known: dict[int, tuple[Any, bool]] = {i: (value, True) for i, value in enumerate(values)}

    def read(operand: Any) -> tuple[Any, bool]:
        return (operand.value, False) if isinstance(operand, Constant) else known[operand]

    for operation in program.operations:
        operands = [read(i) for i in operation.inputs]
        on_lanes = any(flag for _, flag in operands)
        if on_lanes:
            found = _apply(operation, operands, lanes)
        else:
            found = operation.bind([value for value, _ in operands])
        known.update((o, (v, on_lanes)) for o, v in zip(operation.outputs, found, strict=True))
    outputs = [spread(*read(o), lanes) for o in program.outputs]
    return jax.tree.unflatten(program.tree, outputs)


def is_plain(program: Program) -> bool:
    """Whether the program is made of arithmetic and rearrangements only: no solver, no loop, no long sum."""
    specs = dict(enumerate(program.inputs))
    for operation in program.operations:
        specs.update(zip(operation.outputs, operation.shapes, strict=True))
        inner = operation.params.get("call_jaxpr")
        if operation.primitive.name == "custom_jvp_call" and inner is not None:
            if any(eqn.primitive.name not in ELEMENTWISE for eqn in inner.jaxpr.eqns):
                return False
        elif operation.primitive.name not in _PLAIN:
            return False
        operand = operation.inputs[0] if operation.inputs else None
        shape = np.shape(operand.value) if isinstance(operand, Constant) else None
        if shape is None and operand is not None:
            shape = specs[operand].shape
        if _terms(operation, shape or ()) > _LARGEST_SUM:
            return False
    return True


def spread(value: Any, on_lanes: bool, lanes: int) -> Array:
    """A value with the lanes axis, added where it was missing."""
    if on_lanes:
        return value
    value = jnp.asarray(value)
    return lax.broadcast_in_dim(value, (*value.shape, lanes), tuple(range(value.ndim)))


def _terms(operation: Operation, shape: Sequence[int]) -> int:
    """Number of terms of the sum that the operation is written out as; `shape` of its first operand."""
    if operation.primitive.name == "dot_general":
        return _count(shape, operation.params["dimension_numbers"][0][0])
    if operation.primitive.name in _REDUCTIONS:
        return _count(shape, operation.params["axes"])
    return 1


def _count(shape: Sequence[int], axes: Sequence[int]) -> int:
    total = 1
    for axis in axes:
        total *= shape[axis]
    return total


def _apply(operation: Operation, operands: list[tuple[Any, bool]], lanes: int) -> list[Any]:
    """One operation with at least one operand on lanes."""
    name, params = operation.primitive.name, operation.params
    if name in ELEMENTWISE:
        return [_elementwise(operation, operands, lanes)]
    if name == "pad" and not operands[1][1]:
        widths = (*params["padding_config"], (0, 0, 0))
        return [lax.pad(operands[0][0], jnp.asarray(operands[1][0]), widths)]
    rule = _RULES.get(name)
    if rule is not None:
        found = rule(params, [spread(value, flag, lanes) for value, flag in operands])
        if found is not None:
            return found
    axes = [-1 if flag else None for _, flag in operands]
    outputs = jax.vmap(lambda *values: operation.bind(values), in_axes=axes, out_axes=-1)(
        *[value for value, _ in operands]
    )
    return list(outputs)


def _elementwise(operation: Operation, operands: list[tuple[Any, bool]], lanes: int) -> Array:
    rank = max(jnp.ndim(value) - flag for value, flag in operands)
    shape = next(
        jnp.shape(value)[:-1] if flag else jnp.shape(value)
        for value, flag in operands
        if jnp.ndim(value) - flag == rank
    )
    full = []
    for value, flag in operands:
        # A scalar operand of `select_n` or `clamp` keeps its lanes and is repeated over the rest.
        value = spread(value, flag, lanes)
        if value.ndim - 1 < rank:
            value = lax.broadcast_in_dim(value, (*shape, lanes), (rank,))
        full.append(value)
    return operation.bind(full)[0]


def _broadcast(params: dict[str, Any], operands: list[Array]) -> list[Array]:
    (value,) = operands
    shape, axes = params["shape"], params["broadcast_dimensions"]
    return [lax.broadcast_in_dim(value, (*shape, value.shape[-1]), (*axes, len(shape)))]


def _reshape(params: dict[str, Any], operands: list[Array]) -> list[Array] | None:
    if params.get("dimensions") is not None:
        return None
    (value,) = operands
    return [value.reshape(*params["new_sizes"], value.shape[-1])]


def _concatenate(params: dict[str, Any], operands: list[Array]) -> list[Array]:
    return [lax.concatenate(operands, params["dimension"])]


def _squeeze(params: dict[str, Any], operands: list[Array]) -> list[Array]:
    return [lax.squeeze(operands[0], params["dimensions"])]


def _stack(params: dict[str, Any], operands: list[Array]) -> list[Array]:
    axis = params["axis"]
    return [lax.concatenate([lax.expand_dims(v, (axis,)) for v in operands], axis)]


def _unstack(params: dict[str, Any], operands: list[Array]) -> list[Array]:
    (value,), axis = operands, params["axis"]
    return [lax.index_in_dim(value, i, axis, False) for i in range(value.shape[axis])]


def _transpose(params: dict[str, Any], operands: list[Array]) -> list[Array]:
    order = params["permutation"]
    return [lax.transpose(operands[0], (*order, len(order)))]


def _slice(params: dict[str, Any], operands: list[Array]) -> list[Array]:
    (value,) = operands
    strides = params["strides"]
    return [
        lax.slice(
            value,
            (*params["start_indices"], 0),
            (*params["limit_indices"], value.shape[-1]),
            None if strides is None else (*strides, 1),
        )
    ]


def _split(params: dict[str, Any], operands: list[Array]) -> list[Array]:
    axis, start, pieces = params["axis"], 0, []
    for size in params["sizes"]:
        pieces.append(lax.slice_in_dim(operands[0], start, start + size, axis=axis))
        start += size
    return pieces


def _reverse(params: dict[str, Any], operands: list[Array]) -> list[Array]:
    return [lax.rev(operands[0], params["dimensions"])]


def _reduce(combine: Callable[[Any, Any], Any]) -> Any:
    """A reduction written out, left to right."""

    def rule(params: dict[str, Any], operands: list[Array]) -> list[Array] | None:
        (value,) = operands
        axes = tuple(params["axes"])
        if not 0 < _count(value.shape, axes) <= _LARGEST_SUM:
            return None
        for axis in sorted(axes, reverse=True):
            terms = [lax.index_in_dim(value, i, axis, False) for i in range(value.shape[axis])]
            value = functools.reduce(combine, terms)
        return [value]

    return rule


def _dot_general(params: dict[str, Any], operands: list[Array]) -> list[Array] | None:
    """A product written out over what it contracts: ``sum_k left[.., k] * right[k, ..]``."""
    left, right = operands
    (left_sum, right_sum), (left_batch, right_batch) = params["dimension_numbers"]
    if _count(left.shape, left_sum) > _LARGEST_SUM:
        return None
    left_free = [a for a in range(left.ndim - 1) if a not in (*left_sum, *left_batch)]
    right_free = [a for a in range(right.ndim - 1) if a not in (*right_sum, *right_batch)]
    sums = [left.shape[a] for a in left_sum]
    left = left.transpose(*left_sum, *left_batch, *left_free, left.ndim - 1)
    right = right.transpose(*right_sum, *right_batch, *right_free, right.ndim - 1)
    depth, batch = len(sums), len(left_batch)
    left = lax.expand_dims(left, range(left.ndim - 1, left.ndim - 1 + len(right_free)))
    right = lax.expand_dims(right, range(depth + batch, depth + batch + len(left_free)))
    terms = [left[i] * right[i] for i in itertools.product(*[range(s) for s in sums])]
    total = written_sum(terms) if terms else jnp.zeros(left.shape[depth:], left.dtype)
    kind = params.get("preferred_element_type")
    return [total if kind is None else total.astype(kind)]


def written_sum(terms: Sequence[Array]) -> Array:
    """The sum of a few arrays, left to right."""
    total = terms[0]
    for term in terms[1:]:
        total = total + term
    return total


_REDUCTIONS = {
    "reduce_and": operator.and_,
    "reduce_max": jnp.maximum,
    "reduce_min": jnp.minimum,
    "reduce_or": operator.or_,
    "reduce_sum": operator.add,
}

_RULES: dict[str, Callable[[dict[str, Any], list[Array]], list[Array] | None]] = {
    "broadcast_in_dim": _broadcast,
    "concatenate": _concatenate,
    "dot_general": _dot_general,
    "reshape": _reshape,
    "rev": _reverse,
    "slice": _slice,
    "split": _split,
    "squeeze": _squeeze,
    "stack": _stack,
    "transpose": _transpose,
    "unstack": _unstack,
} | {name: _reduce(combine) for name, combine in _REDUCTIONS.items()}
