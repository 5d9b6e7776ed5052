"""What is on lanes: arrays that carry many runs on their last axis, side by side in memory."""

import functools
import operator
from collections.abc import Sequence
from typing import Any

import jax.numpy as jnp
import numpy as np
from jax import Array, lax

from jaxekf.programs import Constant, Operation, Program

ELEMENTWISE = frozenset(
    [
        "abs",
        "acos",
        "acosh",
        "add",
        "add_any",
        "and",
        "asin",
        "asinh",
        "atan",
        "atan2",
        "atanh",
        "cbrt",
        "ceil",
        "clamp",
        "convert_element_type",
        "copy",
        "copy_p",
        "cos",
        "cosh",
        "div",
        "eq",
        "erf",
        "erfc",
        "exp",
        "exp2",
        "expm1",
        "floor",
        "ge",
        "gt",
        "integer_pow",
        "is_finite",
        "le",
        "log",
        "log1p",
        "logistic",
        "lt",
        "max",
        "min",
        "mul",
        "ne",
        "neg",
        "nextafter",
        "not",
        "or",
        "pow",
        "rem",
        "round",
        "rsqrt",
        "select_n",
        "sign",
        "sin",
        "sinh",
        "sqrt",
        "square",
        "sub",
        "tan",
        "tanh",
        "xor",
    ]
)
_LARGEST_SUM = 64
_PLAIN = ELEMENTWISE | frozenset(
    [
        "broadcast_in_dim",
        "concatenate",
        "dot_general",
        "iota",
        "pad",
        "reduce_and",
        "reduce_max",
        "reduce_min",
        "reduce_or",
        "reduce_sum",
        "reshape",
        "rev",
        "slice",
        "split",
        "squeeze",
        "stack",
        "transpose",
        "unstack",
    ]
)


def is_plain(program: Program) -> bool:
    """Whether the program is arithmetic and rearrangements only: no solver, no loop, no long sum."""
    specs: dict[Any, Any] = dict(enumerate(program.inputs))
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
    if operation.primitive.name.startswith("reduce_"):
        return _count(shape, operation.params["axes"])
    return 1


def _count(shape: Sequence[int], axes: Sequence[int]) -> int:
    total = 1
    for axis in axes:
        total *= shape[axis]
    return total


def written_sum(terms: Sequence[Array]) -> Array:
    """The sum of a few arrays, written out, left to right."""
    return functools.reduce(operator.add, terms)
