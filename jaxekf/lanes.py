"""What is on lanes: arrays that carry many runs on their last axis, side by side in memory."""

import functools
import operator
from collections.abc import Sequence
from typing import Any

import jax.numpy as jnp
from jax import Array, lax

CHEAP = frozenset(
    [
        "abs",
        "add",
        "add_any",
        "and",
        "clamp",
        "convert_element_type",
        "copy",
        "copy_p",
        "eq",
        "floor",
        "ge",
        "gt",
        "integer_pow",
        "is_finite",
        "le",
        "lt",
        "max",
        "min",
        "mul",
        "ne",
        "neg",
        "not",
        "or",
        "round",
        "select_n",
        "sign",
        "square",
        "sub",
        "xor",
    ]
)
"""Operations on each number alone that are rather done again than kept."""

ELEMENTWISE = CHEAP | frozenset(
    [
        "acos",
        "acosh",
        "asin",
        "asinh",
        "atan",
        "atan2",
        "atanh",
        "cbrt",
        "ceil",
        "cos",
        "cosh",
        "div",
        "erf",
        "erfc",
        "exp",
        "exp2",
        "expm1",
        "log",
        "log1p",
        "logistic",
        "nextafter",
        "pow",
        "rem",
        "rsqrt",
        "sin",
        "sinh",
        "sqrt",
        "tan",
        "tanh",
    ]
)
"""Operations on each number alone."""


def spread(value: Any, lanes: int) -> Array:
    """A value that is the same on all lanes, with the lanes axis."""
    value = jnp.asarray(value)
    return lax.broadcast_in_dim(value, (*value.shape, lanes), tuple(range(value.ndim)))


def written_sum(terms: Sequence[Array]) -> Array:
    """The sum of a few arrays, written out, left to right."""
    return functools.reduce(operator.add, terms)
