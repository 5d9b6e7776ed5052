"""Which numbers of a matrix are the same whatever the state, found from the operations that make it.

A Jacobian is mostly zeros and ones: parts of a state that only walk, sensors that read one part of it.
Constants are carried through the operations number by number: zero times anything is zero, what an
operation is not understood to leave constant counts as unknown. So what is called known here is known
for every state, input and parameter; nothing is sampled and nothing needs to be declared.
"""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import numpy as np
from jax import core
from numpy.typing import NDArray

from jaxekf.programs import Constant, Program


class Known(NamedTuple):
    """What is known of an array: `value` where `known`, anything elsewhere."""

    value: NDArray[Any]
    known: NDArray[np.bool_]

    def is_zero(self) -> NDArray[np.bool_]:
        """Where the array is zero, whatever it was computed from."""
        return self.known & (self.value == 0)


def find(program: Program) -> Any:
    """The tree of outputs of `program`, each as `Known`."""
    values: dict[int, Known] = {i: _unknown(spec) for i, spec in enumerate(program.inputs)}

    def read(operand: Any) -> Known:
        if not isinstance(operand, Constant):
            return values[operand]
        if isinstance(operand.value, core.Tracer):
            return _unknown(operand.value.aval)
        value = np.asarray(operand.value)
        return Known(value, np.ones(value.shape, bool))

    for operation in program.operations:
        rule = _RULES.get(operation.primitive.name)
        operands = [read(i) for i in operation.inputs]
        found = None
        if rule is not None:
            with np.errstate(all="ignore"):
                found = rule(operation.params, operands)
        if found is None:
            found = [_unknown(spec) for spec in operation.shapes]
        for number, spec, one in zip(operation.outputs, operation.shapes, found, strict=True):
            values[number] = Known(
                np.broadcast_to(one.value, spec.shape), np.broadcast_to(one.known, spec.shape)
            )
    return jax.tree.unflatten(program.tree, [read(o) for o in program.outputs])


def _unknown(spec: Any) -> Known:
    return Known(np.zeros(spec.shape, spec.dtype), np.zeros(spec.shape, bool))


Rule = Callable[[dict[str, Any], list[Known]], list[Known] | None]


def _pointwise(function: Callable[..., Any]) -> Rule:
    """Known where all operands are."""

    def rule(params: dict[str, Any], operands: list[Known]) -> list[Known]:
        known = np.logical_and.reduce(np.broadcast_arrays(*[o.known for o in operands]))
        return [Known(np.asarray(function(*[o.value for o in operands])), known)]

    return rule


def _product(left: Known, right: Known) -> Known:
    zero = left.is_zero() | right.is_zero()
    return Known(np.where(zero, 0, left.value * right.value), (left.known & right.known) | zero)


def _mul(params: dict[str, Any], operands: list[Known]) -> list[Known]:
    return [_product(*operands)]


def _div(params: dict[str, Any], operands: list[Known]) -> list[Known] | None:
    over, under = operands
    if not np.issubdtype(over.value.dtype, np.floating):
        return None
    both = over.known & under.known & (under.value != 0)
    value = np.where(both, over.value / np.where(both, under.value, 1), 0)
    return [Known(value, both | over.is_zero())]


def _convert(params: dict[str, Any], operands: list[Known]) -> list[Known]:
    return [Known(operands[0].value.astype(params["new_dtype"]), operands[0].known)]


def _select(params: dict[str, Any], operands: list[Known]) -> list[Known] | None:
    which, *cases = operands
    if len(cases) != 2:
        return None
    no, yes = cases
    chosen = which.value.astype(bool)
    value = np.where(chosen, yes.value, no.value)
    known = np.where(chosen, yes.known, no.known) & which.known
    same = yes.known & no.known & (yes.value == no.value)
    return [Known(np.where(same, yes.value, value), np.asarray(known | same))]


def _moved(move: Callable[[dict[str, Any], NDArray[Any]], NDArray[Any]]) -> Rule:
    """An operation on one operand that only rearranges."""

    def rule(params: dict[str, Any], operands: list[Known]) -> list[Known]:
        return [Known(move(params, operands[0].value), move(params, operands[0].known))]

    return rule


def _broadcast(params: dict[str, Any], array: NDArray[Any]) -> NDArray[Any]:
    shape = [1] * len(params["shape"])
    for axis, place in enumerate(params["broadcast_dimensions"]):
        shape[place] = array.shape[axis]
    return np.broadcast_to(array.reshape(shape), params["shape"])


def _slice(params: dict[str, Any], array: NDArray[Any]) -> NDArray[Any]:
    strides = params["strides"] or (1,) * array.ndim
    starts, limits = params["start_indices"], params["limit_indices"]
    return array[tuple(slice(*part) for part in zip(starts, limits, strides, strict=True))]


def _concatenate(params: dict[str, Any], operands: list[Known]) -> list[Known]:
    axis = params["dimension"]
    return [
        Known(
            np.concatenate([o.value for o in operands], axis),
            np.concatenate([o.known for o in operands], axis),
        )
    ]


def _stack(params: dict[str, Any], operands: list[Known]) -> list[Known]:
    axis = params["axis"]
    return [
        Known(
            np.stack([o.value for o in operands], axis), np.stack([o.known for o in operands], axis)
        )
    ]


def _unstack(params: dict[str, Any], operands: list[Known]) -> list[Known]:
    (whole,), axis = operands, params["axis"]
    return [
        Known(np.take(whole.value, i, axis), np.take(whole.known, i, axis))
        for i in range(whole.value.shape[axis])
    ]


def _split(params: dict[str, Any], operands: list[Known]) -> list[Known]:
    cuts = np.cumsum(params["sizes"])[:-1]
    values = np.split(operands[0].value, cuts, params["axis"])
    return [
        Known(v, k)
        for v, k in zip(values, np.split(operands[0].known, cuts, params["axis"]), strict=True)
    ]


def _pad(params: dict[str, Any], operands: list[Known]) -> list[Known] | None:
    widths = params["padding_config"]
    if any(low < 0 or high < 0 or inner for low, high, inner in widths):
        return None
    around = [(low, high) for low, high, _ in widths]
    array, filling = operands
    value = np.pad(array.value, around, constant_values=filling.value)
    return [Known(value, np.pad(array.known, around, constant_values=filling.known))]


def _reduce_sum(params: dict[str, Any], operands: list[Known]) -> list[Known]:
    axes = tuple(params["axes"])
    return [Known(operands[0].value.sum(axes), np.asarray(operands[0].known.all(axes)))]


def _dot_general(params: dict[str, Any], operands: list[Known]) -> list[Known]:
    left, right = operands
    (left_sum, right_sum), (left_batch, right_batch) = params["dimension_numbers"]

    def place(operand: Known, order: Sequence[int], at: int, count: int) -> Known:
        def move(array: NDArray[Any]) -> NDArray[Any]:
            array = array.transpose(order)
            return np.expand_dims(array, tuple(range(at, at + count)))

        return Known(move(operand.value), move(operand.known))

    left_free = [a for a in range(left.value.ndim) if a not in (*left_sum, *left_batch)]
    right_free = [a for a in range(right.value.ndim) if a not in (*right_sum, *right_batch)]
    inner = len(left_sum) + len(left_batch)
    wide = place(
        left, [*left_sum, *left_batch, *left_free], inner + len(left_free), len(right_free)
    )
    tall = place(right, [*right_sum, *right_batch, *right_free], inner, len(left_free))
    return _reduce_sum({"axes": range(len(left_sum))}, [_product(wide, tall)])


def _iota(params: dict[str, Any], operands: list[Known]) -> list[Known]:
    shape, axis = params["shape"], params["dimension"]
    line = np.arange(shape[axis], dtype=params["dtype"])
    value = np.broadcast_to(
        line.reshape([-1 if a == axis else 1 for a in range(len(shape))]), shape
    )
    return [Known(value, np.ones(shape, bool))]


_RULES: dict[str, Rule] = {
    "add": _pointwise(np.add),
    "add_any": _pointwise(np.add),
    "and": _pointwise(np.bitwise_and),
    "broadcast_in_dim": _moved(_broadcast),
    "concatenate": _concatenate,
    "convert_element_type": _convert,
    "copy": _moved(lambda params, array: array),
    "copy_p": _moved(lambda params, array: array),
    "div": _div,
    "dot_general": _dot_general,
    "eq": _pointwise(np.equal),
    "ge": _pointwise(np.greater_equal),
    "gt": _pointwise(np.greater),
    "iota": _iota,
    "le": _pointwise(np.less_equal),
    "lt": _pointwise(np.less),
    "mul": _mul,
    "ne": _pointwise(np.not_equal),
    "neg": _pointwise(np.negative),
    "not": _pointwise(np.invert),
    "or": _pointwise(np.bitwise_or),
    "pad": _pad,
    "reduce_sum": _reduce_sum,
    "reshape": _moved(lambda params, array: array.reshape(params["new_sizes"])),
    "rev": _moved(lambda params, array: np.flip(array, params["dimensions"])),
    "select_n": _select,
    "slice": _moved(_slice),
    "split": _split,
    "stack": _stack,
    "squeeze": _moved(lambda params, array: np.squeeze(array, tuple(params["dimensions"]))),
    "sub": _pointwise(np.subtract),
    "transpose": _moved(lambda params, array: array.transpose(params["permutation"])),
    "unstack": _unstack,
}
