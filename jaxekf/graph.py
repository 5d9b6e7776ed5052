"""Numbers of arrays as a graph: constants, numbers that are given, and operations on numbers.

Equal numbers are made once, and a number that is known is a constant: zero times anything is zero.
"""

from collections.abc import Callable
from typing import Any

import jax
import numpy as np
from jax import lax
from numpy.typing import NDArray

from jaxekf.programs import Operation

Numbers = NDArray[Any]
"""Array of objects: constants (NumPy scalars) or `Node`."""


class Node:
    """One number: a primitive of other numbers, or (without one) a number of a given array."""

    __slots__ = ("dtype", "inputs", "operation")

    def __init__(self, operation: Operation | None, inputs: tuple[Any, ...], dtype: Any) -> None:
        self.operation, self.inputs, self.dtype = operation, inputs, dtype


def constants(value: Any) -> Numbers:
    """The numbers of an array that is known."""
    array = np.asarray(value)
    numbers = np.empty(array.shape, object)
    for index in np.ndindex(array.shape):
        numbers[index] = array[index]
    return numbers


def leaves(source: int, shape: tuple[int, ...], dtype: Any) -> Numbers:
    """The numbers of the given array number `source`."""
    numbers = np.empty(shape, object)
    for index in np.ndindex(numbers.shape):
        numbers[index] = Node(None, (source, index), dtype)
    return numbers


def is_constant(value: Any) -> bool:
    """Whether a number is known."""
    return not isinstance(value, Node)


def number(operation: Operation, values: list[Any], made: dict[Any, Node]) -> Any:
    """One number; made once for the same operands, and not at all where it is known."""
    name, dtype = operation.primitive.name, operation.shapes[0].dtype
    if all(map(is_constant, values)) and name in _ON_CONSTANTS:
        with np.errstate(all="ignore"):
            return np.asarray(_ON_CONSTANTS[name](*values)).astype(dtype)[()]
    short = _SHORT.get(name)
    known = short(dtype, *values) if short is not None else None
    if known is not None:
        return known
    # Operands are known by identity; the graph keeps them alive as long as the identities are used.
    operands = tuple(id(v) if isinstance(v, Node) else (v.dtype, v.item()) for v in values)
    call = name == "custom_jvp_call"
    key = (operation.primitive, operands, id(operation) if call else str(operation.params))
    if key not in made:
        made[key] = Node(operation, tuple(values), dtype)
    return made[key]


def elementwise(operation: Operation, operands: list[Numbers], made: dict[Any, Node]) -> Numbers:
    """An operation on each number alone."""
    shape = operation.shapes[0].shape
    found = np.empty(shape, object)
    spread = [np.broadcast_to(o, shape) for o in operands]
    for index in np.ndindex(shape):
        found[index] = number(operation, [o[index] for o in spread], made)
    return found


def _mul(dtype: Any, a: Any, b: Any) -> Any:
    for one, other in ((a, b), (b, a)):
        if is_constant(one):
            if one == 0:
                return np.zeros((), dtype)[()]
            if one == 1:
                return other
    return None


def _add(dtype: Any, a: Any, b: Any) -> Any:
    if is_constant(a) and a == 0:
        return b
    return a if is_constant(b) and b == 0 else None


def _sub(dtype: Any, a: Any, b: Any) -> Any:
    return a if is_constant(b) and b == 0 else None


def _div(dtype: Any, a: Any, b: Any) -> Any:
    if is_constant(b) and b == 1:
        return a
    return np.zeros((), dtype)[()] if is_constant(a) and a == 0 else None


def _select(dtype: Any, which: Any, *cases: Any) -> Any:
    if is_constant(which):
        return cases[int(which)]
    first = cases[0]
    same = all(c is first or (is_constant(c) and is_constant(first) and c == first) for c in cases)
    return first if same else None


def _convert(dtype: Any, value: Any) -> Any:
    return value if value.dtype == dtype else None


_SHORT: dict[str, Callable[..., Any]] = {
    "add": _add,
    "add_any": _add,
    "convert_element_type": _convert,
    "copy": lambda dtype, value: value,
    "copy_p": lambda dtype, value: value,
    "div": _div,
    "mul": _mul,
    "select_n": _select,
    "sub": _sub,
}

_ON_CONSTANTS: dict[str, Callable[..., Any]] = {
    "add": np.add,
    "add_any": np.add,
    "and": np.bitwise_and,
    "convert_element_type": lambda value: value,
    "div": np.divide,
    "eq": np.equal,
    "ge": np.greater_equal,
    "gt": np.greater,
    "le": np.less_equal,
    "lt": np.less,
    "max": np.maximum,
    "min": np.minimum,
    "mul": np.multiply,
    "ne": np.not_equal,
    "neg": np.negative,
    "not": np.invert,
    "or": np.bitwise_or,
    "select_n": lambda which, *cases: cases[int(which)],
    "sqrt": np.sqrt,
    "sub": np.subtract,
}


class Written:
    """A function of numbers in the place of a primitive, whose parameters differ between versions."""

    multiple_results = False

    def __init__(self, name: str, function: Callable[..., Any]) -> None:
        self.name, self.bind = name, function

    def get_bind_params(self, params: dict[str, Any]) -> dict[str, Any]:
        """None are needed."""
        return params


MULTIPLY, ADD = Written("mul", lax.mul), Written("add", lax.add)


class Arithmetic:
    """Sums and products of numbers, for operations that are written out."""

    def __init__(self, made: dict[Any, Node]) -> None:
        self._made = made

    def __call__(self, primitive: Any, a: Any, b: Any) -> Any:
        spec = jax.ShapeDtypeStruct((), a.dtype)
        return number(Operation(primitive, {}, (), (), (spec,)), [a, b], self._made)
