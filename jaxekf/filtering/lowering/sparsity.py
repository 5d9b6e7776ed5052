"""Sparsity: entries of arrays that are constant for every state, input and parameter.

A Jacobian is mostly zeros and ones: random walks, sensors that read one part of the state. Constants are
propagated through the operations of a program entry by entry: zero times anything is zero, and an
operation without a rule here makes unknown entries. So a known entry always has its value; nothing is
sampled, and a model declares nothing.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import numpy as np
from jax import core
from numpy.typing import NDArray

from jaxekf.filtering.lowering.scalar_graph import (
    Constant,
    Operation,
    Program,
    eliminate_dead_code,
    inlined,
)


class KnownEntries(NamedTuple):
    """An array with some entries known at trace time: `value` where `known`, zero elsewhere."""

    value: NDArray[Any]
    known: NDArray[np.bool_]

    def is_zero(self) -> NDArray[np.bool_]:
        """Which entries are known to be zero."""
        return self.known & (self.value == 0)


def known_entries(program: Program) -> Any:
    """The tree of outputs of `program`, each as `KnownEntries`."""
    values = _propagate(program)
    found = [_read(output, values) for output in program.outputs]
    return jax.tree.unflatten(program.tree, found)


def simplify(program: Program) -> Program:
    """The program with known arrays as constants and without repeated operations."""
    values = _propagate(program)
    same: dict[Any, Any] = {}
    made: dict[Any, tuple[int, ...]] = {}

    def resolve(operand: Any) -> Any:
        if isinstance(operand, Constant):
            return operand
        known = values.get(operand)
        if known is not None and known.known.all():
            return Constant(known.value)
        return same.get(operand, operand)

    operations = []
    for operation in program.operations:
        if all(values[o].known.all() for o in operation.outputs):
            continue
        operation = operation._replace(inputs=tuple(map(resolve, operation.inputs)))
        alias = _unchanged_operand(operation, values)
        key = (operation.primitive, str(operation.params), tuple(map(_identity, operation.inputs)))
        if alias is not None:
            same[operation.outputs[0]] = alias
        elif key in made:
            same.update(zip(operation.outputs, made[key], strict=True))
        else:
            made[key] = operation.outputs
            operations.append(operation)
    outputs = tuple(map(resolve, program.outputs))
    return eliminate_dead_code(program._replace(operations=tuple(operations), outputs=outputs))


def _identity(operand: Any) -> Any:
    if isinstance(operand, Constant):
        value = np.asarray(operand.value)
        return value.dtype.str, value.shape, value.tobytes()
    return operand


def _unchanged_operand(operation: Operation, values: dict[int, KnownEntries]) -> Any:
    """The operand that an operation returns unchanged, such as x of ``x + 0``; None for any other."""
    name, inputs = operation.primitive.name, operation.inputs
    neutral = {"add": 0, "add_any": 0, "mul": 1, "sub": 0, "div": 1}.get(name)
    if neutral is None:
        return None
    one_sided = name in ("sub", "div")
    for one, other in ((inputs[0], inputs[1]), (inputs[1], inputs[0]))[: 1 if one_sided else 2]:
        if isinstance(other, Constant) and not isinstance(one, Constant):
            fits = values[one].value.shape == operation.shapes[0].shape
            if fits and np.all(np.asarray(other.value) == neutral):
                return one
    return None


def _propagate(program: Program) -> dict[int, KnownEntries]:
    values = {i: _unknown(spec) for i, spec in enumerate(program.inputs)}
    for operation in program.operations:
        operands = [_read(i, values) for i in operation.inputs]
        found = _apply(operation, operands)
        values.update(zip(operation.outputs, found, strict=True))
    return values


def _read(operand: Any, values: dict[int, KnownEntries]) -> KnownEntries:
    if not isinstance(operand, Constant):
        return values[operand]
    if isinstance(operand.value, core.Tracer):
        return _unknown(operand.value)
    value = np.asarray(operand.value)
    return KnownEntries(value, np.ones(value.shape, bool))


def _unknown(spec: Any) -> KnownEntries:
    # Keys and other extended types hold no numbers: they are unknown as a whole.
    dtype = spec.dtype if isinstance(spec.dtype, np.dtype) else np.dtype(bool)
    return KnownEntries(np.zeros(spec.shape, dtype), np.zeros(spec.shape, bool))


def _apply(operation: Operation, operands: list[KnownEntries]) -> list[KnownEntries]:
    name, params = operation.primitive.name, operation.params
    if name == "custom_jvp_call":
        inner = inlined(operation)
        values = dict(enumerate(operands))
        for each in inner.operations:
            found = _apply(each, [_read(i, values) for i in each.inputs])
            values.update(zip(each.outputs, found, strict=True))
        return [_read(o, values) for o in inner.outputs]
    if name in _RULES:
        found = _RULES[name](params, operands)
    elif name in _REARRANGEMENTS:
        found = _rearrange(_REARRANGEMENTS[name], params, operands)
    elif name in _ELEMENTWISE:
        found = _elementwise(_ELEMENTWISE[name], operands)
    else:
        return [_unknown(spec) for spec in operation.shapes]
    return [
        KnownEntries(np.where(one.known, one.value, 0).astype(spec.dtype), one.known)
        for one, spec in zip(found, operation.shapes, strict=True)
    ]


# --- elementwise --------------------------------------------------------------------------------------


def _elementwise(function: Callable[..., Any], operands: list[KnownEntries]) -> list[KnownEntries]:
    known = np.broadcast_arrays(*[o.known for o in operands])
    with np.errstate(all="ignore"):
        return [
            KnownEntries(np.asarray(function(*[o.value for o in operands])), np.all(known, axis=0))
        ]


def _product(params: dict[str, Any], operands: list[KnownEntries]) -> list[KnownEntries]:
    a, b = operands
    known = (a.known & b.known) | a.is_zero() | b.is_zero()
    with np.errstate(all="ignore"):
        return [KnownEntries(np.where(known, a.value * b.value, 0), known)]


def _quotient(params: dict[str, Any], operands: list[KnownEntries]) -> list[KnownEntries]:
    a, b = operands
    zero = a.is_zero()
    known = (a.known & b.known) | zero
    with np.errstate(all="ignore"):
        return [KnownEntries(np.where(zero, 0, np.divide(a.value, b.value)), known)]


def _select(params: dict[str, Any], operands: list[KnownEntries]) -> list[KnownEntries]:
    which, *cases = operands
    index = np.broadcast_to(which.value.astype(int), cases[0].value.shape)[None]
    values, flags = np.stack([c.value for c in cases]), np.stack([c.known for c in cases])
    chosen = np.take_along_axis(values, index, 0)[0]
    known = which.known & np.take_along_axis(flags, index, 0)[0]
    same = flags.all(axis=0) & np.all(values == values[:1], axis=0)
    return [KnownEntries(np.where(known, chosen, values[0]), known | same)]


_ELEMENTWISE: dict[str, Callable[..., Any]] = {
    "abs": np.abs,
    "add": np.add,
    "add_any": np.add,
    "and": np.bitwise_and,
    "atan2": np.arctan2,
    "convert_element_type": lambda value: value,
    "copy": lambda value: value,
    "copy_p": lambda value: value,
    "cos": np.cos,
    "eq": np.equal,
    "ge": np.greater_equal,
    "gt": np.greater,
    "le": np.less_equal,
    "lt": np.less,
    "max": np.maximum,
    "min": np.minimum,
    "ne": np.not_equal,
    "neg": np.negative,
    "not": np.invert,
    "or": np.bitwise_or,
    "sin": np.sin,
    "sqrt": np.sqrt,
    "square": np.square,
    "sub": np.subtract,
}


# --- rearrangements -----------------------------------------------------------------------------------


def _rearrange(
    move: Callable[[dict[str, Any], list[NDArray[Any]]], Any],
    params: dict[str, Any],
    operands: list[KnownEntries],
) -> list[KnownEntries]:
    values = move(params, [o.value for o in operands])
    flags = move(params, [o.known for o in operands])
    return [KnownEntries(np.asarray(v), np.asarray(f)) for v, f in zip(values, flags, strict=True)]


def _broadcast(params: dict[str, Any], arrays: list[NDArray[Any]]) -> Any:
    shape = [1] * len(params["shape"])
    for axis, place in enumerate(params["broadcast_dimensions"]):
        shape[place] = arrays[0].shape[axis]
    return [np.broadcast_to(arrays[0].reshape(shape), params["shape"])]


def _slice(params: dict[str, Any], arrays: list[NDArray[Any]]) -> Any:
    strides = params["strides"] or (1,) * arrays[0].ndim
    bounds = zip(params["start_indices"], params["limit_indices"], strides, strict=True)
    return [arrays[0][tuple(slice(*part) for part in bounds)]]


def _split(params: dict[str, Any], arrays: list[NDArray[Any]]) -> Any:
    return np.split(arrays[0], np.cumsum(params["sizes"])[:-1], params["axis"])


def _unstack(params: dict[str, Any], arrays: list[NDArray[Any]]) -> Any:
    return list(np.moveaxis(arrays[0], params["axis"], 0))


_REARRANGEMENTS: dict[str, Callable[[dict[str, Any], list[NDArray[Any]]], Any]] = {
    "broadcast_in_dim": _broadcast,
    "concatenate": lambda params, arrays: [np.concatenate(arrays, params["dimension"])],
    "reshape": lambda params, arrays: [arrays[0].reshape(params["new_sizes"])],
    "rev": lambda params, arrays: [np.flip(arrays[0], params["dimensions"])],
    "slice": _slice,
    "split": _split,
    "squeeze": lambda params, arrays: [np.squeeze(arrays[0], tuple(params["dimensions"]))],
    "stack": lambda params, arrays: [np.stack(arrays, params["axis"])],
    "transpose": lambda params, arrays: [arrays[0].transpose(params["permutation"])],
    "unstack": _unstack,
}


# --- sums and products --------------------------------------------------------------------------------


def _reduced(function: Callable[..., Any]) -> Callable[..., list[KnownEntries]]:
    def rule(params: dict[str, Any], operands: list[KnownEntries]) -> list[KnownEntries]:
        axes = tuple(params["axes"])
        known = np.asarray(operands[0].known.all(axis=axes))
        return [KnownEntries(np.asarray(function(operands[0].value, axis=axes)), known)]

    return rule


def _dot_general(params: dict[str, Any], operands: list[KnownEntries]) -> list[KnownEntries]:
    """An entry is known where every product in its sum is: of known factors, or with a zero."""
    (left_sum, right_sum), (left_batch, right_batch) = params["dimension_numbers"]
    left, right = operands
    names = iter("abcdefghijklmnopqrstuvwxyz")
    first = [next(names) for _ in range(left.value.ndim)]
    second = [next(names) for _ in range(right.value.ndim)]
    pairs = zip((*left_sum, *left_batch), (*right_sum, *right_batch), strict=True)
    for a, b in pairs:
        second[b] = first[a]
    free = [first[i] for i in range(len(first)) if i not in (*left_sum, *left_batch)]
    free += [second[i] for i in range(len(second)) if i not in (*right_sum, *right_batch)]
    result = "".join([first[i] for i in left_batch] + free)
    path = f"{''.join(first)},{''.join(second)}->{result}"

    def count(a: NDArray[np.bool_], b: NDArray[np.bool_]) -> Any:
        return np.einsum(path, a.astype(int), b.astype(int))

    unknown = count(~left.known, ~right.is_zero()) + count(~left.is_zero(), ~right.known)
    return [KnownEntries(np.einsum(path, left.value, right.value), np.asarray(unknown == 0))]


def _padded(params: dict[str, Any], operands: list[KnownEntries]) -> list[KnownEntries]:
    array, filling = operands
    found = []
    for values, fill in ((array.value, filling.value), (array.known, filling.known)):
        shape, here = [], []
        for size, (low, high, inner) in zip(values.shape, params["padding_config"], strict=True):
            places = low + (inner + 1) * np.arange(size)
            shape.append(low + high + size + inner * max(size - 1, 0))
            here.append((np.flatnonzero((places >= 0) & (places < shape[-1])), places))
        whole = np.full(shape, fill)
        whole[np.ix_(*[p[i] for i, p in here])] = values[np.ix_(*[i for i, _ in here])]
        found.append(whole)
    return [KnownEntries(*found)]


def _iota(params: dict[str, Any], operands: list[KnownEntries]) -> list[KnownEntries]:
    shape, axis = params["shape"], params["dimension"]
    line = np.arange(shape[axis]).reshape([-1 if a == axis else 1 for a in range(len(shape))])
    value = np.broadcast_to(line, shape)
    return [KnownEntries(value, np.ones(shape, bool))]


_RULES: dict[str, Callable[[dict[str, Any], list[KnownEntries]], list[KnownEntries]]] = {
    "div": _quotient,
    "dot_general": _dot_general,
    "integer_pow": lambda params, operands: _elementwise(
        lambda value: np.power(value.astype(float), params["y"]), operands
    ),
    "iota": _iota,
    "mul": _product,
    "pad": _padded,
    "reduce_and": _reduced(np.all),
    "reduce_max": _reduced(np.max),
    "reduce_min": _reduced(np.min),
    "reduce_or": _reduced(np.any),
    "reduce_sum": _reduced(np.sum),
    "select_n": _select,
}
