"""A program evaluated number by number: every number of every array is a value of its own, on lanes.

Small geometry is mostly rearrangement, and mostly multiplication by numbers that are always zero or one.
Taken number by number the rearrangement costs nothing and those products are never made. What is left is
plain arithmetic on lanes: first written down as a graph, in which equal numbers are one, then computed,
numbers that are used often being kept and the others made where they are used.
"""

import functools
import itertools
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, core, lax
from numpy.typing import NDArray

from jaxekf import lanes
from jaxekf.kernels import loop
from jaxekf.programs import Constant, Operation, Program

Numbers = NDArray[Any]
"""Array of objects: constants (NumPy scalars) or `_Node`."""

_WORTH_KEEPING = 10
_LONGEST = 64


class _Node:
    """One number: a primitive of other numbers, or (without one) a number of a given array."""

    __slots__ = ("dtype", "inputs", "operation")

    def __init__(self, operation: Operation | None, inputs: tuple[Any, ...], dtype: Any) -> None:
        self.operation, self.inputs, self.dtype = operation, inputs, dtype


def evaluate(program: Program, values: Sequence[Array]) -> Any:
    """The outputs of `program`, with lanes; each of `values` carries the lanes on its last axis."""
    outputs, sources = _graph(program, values)
    return jax.tree.unflatten(program.tree, _compute(outputs, sources, values[0].shape[-1]))


def used(program: Program, count: int) -> list[list[tuple[int, ...]]]:
    """Which numbers of each of the first `count` inputs the outputs depend on."""
    blank = [jnp.zeros((*spec.shape, 1), spec.dtype) for spec in program.inputs]
    outputs, _ = _graph(program, blank)
    found: list[set[Any]] = [set() for _ in range(count)]
    for node in _order(outputs)[0]:
        if node.operation is None and node.inputs[0] < count:
            found[node.inputs[0]].add(node.inputs[1])
    return [sorted(indices) for indices in found]


def _graph(program: Program, values: Sequence[Array]) -> tuple[list[Numbers], list[Array]]:
    """The numbers of the outputs, and the arrays that they are computed from."""
    width = values[0].shape[-1]
    sources = list(values)
    made: dict[Any, _Node] = {}
    known: dict[int, Numbers] = {
        i: _leaves(i, spec.shape, spec.dtype) for i, spec in enumerate(program.inputs)
    }

    def read(operand: Any) -> Numbers:
        if not isinstance(operand, Constant):
            return known[operand]
        if isinstance(operand.value, core.Tracer):
            sources.append(lanes.spread(operand.value, False, width))
            return _leaves(len(sources) - 1, operand.value.shape, operand.value.dtype)
        return _constants(operand.value)

    for operation in program.operations:
        operands = [read(i) for i in operation.inputs]
        found = _apply(operation, operands, made, sources)
        known.update(zip(operation.outputs, found, strict=True))
    return [read(o) for o in program.outputs], sources


def _compute(outputs: list[Numbers], sources: list[Array], width: int) -> list[Array]:
    """The arrays that the graph stands for."""
    order, uses = _order(outputs)
    kept: dict[int, Array] = {}
    length: dict[int, int] = {}
    for node in order:
        inside = sum(length.get(id(i), 0) for i in node.inputs if id(i) not in kept)
        length[id(node)] = 1 + inside
        operation = node.operation
        if operation is None:
            continue
        often = uses[id(node)] > 1 and length[id(node)] >= _WORTH_KEEPING
        if operation.primitive.name not in _CHEAP or often or length[id(node)] > _LONGEST:
            kept[id(node)] = _kept([node], (), kept, sources, width)
    found = []
    for numbers in outputs:
        nodes = [n for n in numbers.ravel() if isinstance(n, _Node)]
        whole = [n for n in nodes if n.operation is None]
        if nodes and len(whole) == numbers.size and _is_source(whole, sources, numbers.shape):
            found.append(sources[whole[0].inputs[0]])
        else:
            found.append(_kept(list(numbers.ravel()), numbers.shape, kept, sources, width))
    return found


def _is_source(nodes: list[_Node], sources: list[Array], shape: tuple[int, ...]) -> bool:
    """Whether numbers are those of a given array, all of them in order."""
    at = nodes[0].inputs[0]
    return sources[at].shape[:-1] == shape and all(
        node.inputs == (at, index) for node, index in zip(nodes, np.ndindex(shape), strict=True)
    )


def _order(outputs: list[Numbers]) -> tuple[list[_Node], dict[int, int]]:
    """Every node that is needed, operands first, and how often each is used."""
    order: list[_Node] = []
    uses: dict[int, int] = {}
    stack = [(n, False) for numbers in outputs for n in numbers.ravel() if isinstance(n, _Node)]
    for node, _ in stack:
        uses[id(node)] = uses.get(id(node), 0) + 1
    seen: set[int] = set()
    while stack:
        node, finished = stack.pop()
        if finished:
            order.append(node)
            continue
        if id(node) in seen:
            continue
        seen.add(id(node))
        stack.append((node, True))
        if node.operation is not None:
            for i in node.inputs:
                if isinstance(i, _Node):
                    uses[id(i)] = uses.get(id(i), 0) + 1
                    stack.append((i, False))
    return order, uses


def _kept(
    numbers: list[Any],
    shape: tuple[int, ...],
    kept: dict[int, Array],
    sources: list[Array],
    width: int,
) -> Array:
    """Numbers as one array in memory, computed from given arrays and from numbers kept before."""
    arguments: dict[Any, Array] = {}

    def gather(node: Any, top: bool) -> None:
        if not isinstance(node, _Node):
            return
        if id(node) in kept:
            arguments[id(node)] = kept[id(node)]
        elif node.operation is None:
            arguments["source", node.inputs[0]] = sources[node.inputs[0]]
        else:
            for i in node.inputs:
                gather(i, False)

    for number in numbers:
        gather(number, True)

    def compute(arguments: dict[Any, Array]) -> Array:
        done: dict[int, Array] = {}

        def value(node: Any) -> Any:
            if not isinstance(node, _Node):
                return jnp.full((width,), node, node.dtype)
            if id(node) not in done:
                if id(node) in arguments:
                    done[id(node)] = arguments[id(node)]
                elif node.operation is None:
                    at, index = node.inputs
                    done[id(node)] = arguments["source", at][index]
                else:
                    done[id(node)] = node.operation.bind([value(i) for i in node.inputs])[0]
            return done[id(node)]

        if shape == ():
            return value(numbers[0])
        flat = [value(n)[None] for n in numbers]
        whole = lax.concatenate(flat, 0) if len(flat) > 1 else flat[0]
        return whole.reshape(*shape, width)

    if not numbers:
        return jnp.zeros((*shape, width))
    names = list(arguments)
    return loop(lambda *v: compute(dict(zip(names, v, strict=True))), *arguments.values())


def _constants(value: Any) -> Numbers:
    array = np.asarray(value)
    numbers = np.empty(array.shape, object)
    for index in np.ndindex(array.shape):
        numbers[index] = array[index]
    return numbers


def _leaves(source: int, shape: tuple[int, ...], dtype: Any) -> Numbers:
    numbers = np.empty(shape, object)
    for index in np.ndindex(numbers.shape):
        numbers[index] = _Node(None, (source, index), dtype)
    return numbers


def _is_constant(value: Any) -> bool:
    return not isinstance(value, _Node)


def _apply(
    operation: Operation, operands: list[Numbers], made: dict[Any, _Node], sources: list[Array]
) -> list[Numbers]:
    name, params = operation.primitive.name, operation.params
    if name in lanes.ELEMENTWISE or _is_scalar_call(operation):
        return [_elementwise(operation, operands, made)]
    rule = _RULES.get(name)
    found = rule(_Arithmetic(made), params, operands) if rule is not None else None
    return _whole(operation, operands, sources) if found is None else found


def _whole(operation: Operation, operands: list[Numbers], sources: list[Array]) -> list[Numbers]:
    """An operation that is not taken apart, on whole arrays."""
    width = sources[0].shape[-1]
    constant = [all(map(_is_constant, o.ravel())) for o in operands]
    plain = []
    for numbers, flag in zip(operands, constant, strict=True):
        if flag:
            dtype = numbers.ravel()[0].dtype if numbers.size else None
            plain.append(np.array(numbers.tolist(), dtype).reshape(numbers.shape))
        else:
            plain.append(_compute([numbers], sources, width)[0])
    axes = [None if flag else -1 for flag in constant]
    if all(constant):
        with jax.ensure_compile_time_eval():
            return [_constants(v) for v in operation.bind(plain)]
    outputs = jax.vmap(lambda *v: operation.bind(v), in_axes=axes, out_axes=-1)(*plain)
    found = []
    for output in outputs:
        sources.append(output)
        found.append(_leaves(len(sources) - 1, output.shape[:-1], output.dtype))
    return found


def _is_scalar_call(operation: Operation) -> bool:
    """A function with a derivative of its own, that acts on each number alone."""
    if operation.primitive.name != "custom_jvp_call":
        return False
    inner = operation.params["call_jaxpr"].jaxpr
    return len(operation.outputs) == 1 and all(
        eqn.primitive.name in lanes.ELEMENTWISE for eqn in inner.eqns
    )


def _elementwise(operation: Operation, operands: list[Numbers], made: dict[Any, _Node]) -> Numbers:
    shape = operation.shapes[0].shape
    found = np.empty(shape, object)
    spread = [np.broadcast_to(o, shape) for o in operands]
    for index in np.ndindex(shape):
        found[index] = _number(operation, [o[index] for o in spread], made)
    return found


def _number(operation: Operation, values: list[Any], made: dict[Any, _Node]) -> Any:
    """One number; made once for the same operands, and not at all where it is known."""
    name, dtype = operation.primitive.name, operation.shapes[0].dtype
    if all(map(_is_constant, values)) and name in _ON_CONSTANTS:
        with np.errstate(all="ignore"):
            return np.asarray(_ON_CONSTANTS[name](*values)).astype(dtype)[()]
    short = _SHORT.get(name)
    known = short(dtype, *values) if short is not None else None
    if known is not None:
        return known
    # Operands are known by identity; the graph keeps them alive as long as the identities are used.
    operands = tuple(id(v) if isinstance(v, _Node) else (v.dtype, v.item()) for v in values)
    call = name == "custom_jvp_call"
    key = (operation.primitive, operands, id(operation) if call else str(operation.params))
    if key not in made:
        made[key] = _Node(operation, tuple(values), dtype)
    return made[key]


def _mul(dtype: Any, a: Any, b: Any) -> Any:
    for one, other in ((a, b), (b, a)):
        if _is_constant(one):
            if one == 0:
                return np.zeros((), dtype)[()]
            if one == 1:
                return other
    return None


def _add(dtype: Any, a: Any, b: Any) -> Any:
    if _is_constant(a) and a == 0:
        return b
    return a if _is_constant(b) and b == 0 else None


def _sub(dtype: Any, a: Any, b: Any) -> Any:
    return a if _is_constant(b) and b == 0 else None


def _div(dtype: Any, a: Any, b: Any) -> Any:
    if _is_constant(b) and b == 1:
        return a
    return np.zeros((), dtype)[()] if _is_constant(a) and a == 0 else None


def _select(dtype: Any, which: Any, *cases: Any) -> Any:
    if _is_constant(which):
        return cases[int(which)]
    return cases[0] if all(c is cases[0] for c in cases) else None


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

_CHEAP = frozenset(
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
"""What is rather computed again than kept."""

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


class _Written:
    """A function of numbers in the place of a primitive, whose parameters differ between versions."""

    multiple_results = False

    def __init__(self, name: str, function: Callable[..., Any]) -> None:
        self.name, self.bind = name, function

    def get_bind_params(self, params: dict[str, Any]) -> dict[str, Any]:
        """None are needed."""
        return params


_MULTIPLY, _ADD = _Written("mul", lax.mul), _Written("add", lax.add)


class _Arithmetic:
    """Sums and products of numbers, for operations that are written out."""

    def __init__(self, made: dict[Any, _Node]) -> None:
        self._made = made

    def __call__(self, primitive: Any, a: Any, b: Any) -> Any:
        spec = jax.ShapeDtypeStruct((), a.dtype)
        return _number(Operation(primitive, {}, (), (), (spec,)), [a, b], self._made)


Rule = Callable[[_Arithmetic, dict[str, Any], list[Numbers]], list[Numbers] | None]


def _moved(move: Callable[[dict[str, Any], Numbers], Numbers]) -> Rule:
    """An operation on one operand that only rearranges."""
    return lambda arithmetic, params, operands: [move(params, operands[0])]


def _broadcast(params: dict[str, Any], numbers: Numbers) -> Numbers:
    shape = [1] * len(params["shape"])
    for axis, place in enumerate(params["broadcast_dimensions"]):
        shape[place] = numbers.shape[axis]
    return np.broadcast_to(numbers.reshape(shape), params["shape"])


def _slice(params: dict[str, Any], numbers: Numbers) -> Numbers:
    strides = params["strides"] or (1,) * numbers.ndim
    starts, limits = params["start_indices"], params["limit_indices"]
    return numbers[tuple(slice(*part) for part in zip(starts, limits, strides, strict=True))]


def _concatenate(arithmetic: Any, params: dict[str, Any], operands: list[Numbers]) -> list[Numbers]:
    return [np.concatenate(operands, params["dimension"])]


def _stack(arithmetic: Any, params: dict[str, Any], operands: list[Numbers]) -> list[Numbers]:
    return [np.stack(operands, params["axis"])]


def _unstack(arithmetic: Any, params: dict[str, Any], operands: list[Numbers]) -> list[Numbers]:
    whole = np.moveaxis(operands[0], params["axis"], 0)
    return [whole[i, ...] for i in range(whole.shape[0])]


def _split(arithmetic: Any, params: dict[str, Any], operands: list[Numbers]) -> list[Numbers]:
    return list(np.split(operands[0], np.cumsum(params["sizes"])[:-1], params["axis"]))


def _pad(arithmetic: Any, params: dict[str, Any], operands: list[Numbers]) -> list[Numbers] | None:
    numbers, filling = operands
    if any(inner for _, _, inner in params["padding_config"]):
        return None
    for axis, (low, high, _) in enumerate(params["padding_config"]):
        cut = slice(max(-low, 0), numbers.shape[axis] - max(-high, 0))
        numbers = numbers[(slice(None),) * axis + (cut,)]
        pieces = []
        for count in (max(low, 0), max(high, 0)):
            shape = [*numbers.shape]
            shape[axis] = count
            piece = np.empty(shape, object)
            piece[...] = filling[()]
            pieces.append(piece)
        numbers = np.concatenate([pieces[0], numbers, pieces[1]], axis)
    return [numbers]


def _reduce(primitive: Any) -> Rule:
    def rule(
        arithmetic: _Arithmetic, params: dict[str, Any], operands: list[Numbers]
    ) -> list[Numbers] | None:
        (numbers,) = operands
        axes = tuple(params["axes"])
        if params.get("out_sharding") is not None or not numbers.size:
            return None
        rest = [a for a in range(numbers.ndim) if a not in axes]
        flat = numbers.transpose([*axes, *rest])
        flat = flat.reshape(-1, *flat.shape[len(axes) :])
        found = np.empty(flat.shape[1:], object)
        for index in np.ndindex(found.shape):
            terms = [flat[(k, *index)] for k in range(flat.shape[0])]
            found[index] = functools.reduce(functools.partial(arithmetic, primitive), terms)
        return [found]

    return rule


def _dot_general(
    arithmetic: _Arithmetic, params: dict[str, Any], operands: list[Numbers]
) -> list[Numbers]:
    left, right = operands
    (left_sum, right_sum), (left_batch, right_batch) = params["dimension_numbers"]
    left_free = [a for a in range(left.ndim) if a not in (*left_sum, *left_batch)]
    right_free = [a for a in range(right.ndim) if a not in (*right_sum, *right_batch)]
    sums = [range(left.shape[a]) for a in left_sum]
    batch = [range(left.shape[a]) for a in left_batch]
    left = left.transpose([*left_sum, *left_batch, *left_free])
    right = right.transpose([*right_sum, *right_batch, *right_free])
    inner = len(sums) + len(batch)
    found = np.empty(
        [len(r) for r in batch] + [*left.shape[inner:]] + [*right.shape[inner:]], object
    )
    for b in itertools.product(*batch):
        for i in np.ndindex(left.shape[inner:]):
            for j in np.ndindex(right.shape[inner:]):
                terms = [
                    arithmetic(_MULTIPLY, left[(*k, *b, *i)], right[(*k, *b, *j)])
                    for k in itertools.product(*sums)
                ]
                add = functools.partial(arithmetic, _ADD)
                found[(*b, *i, *j)] = functools.reduce(add, terms)
    return [found]


def _iota(arithmetic: Any, params: dict[str, Any], operands: list[Numbers]) -> list[Numbers]:
    shape, axis = params["shape"], params["dimension"]
    line = np.arange(shape[axis], dtype=params["dtype"])
    whole = np.broadcast_to(
        line.reshape([-1 if a == axis else 1 for a in range(len(shape))]), shape
    )
    return [_constants(whole)]


_RULES: dict[str, Rule] = {
    "broadcast_in_dim": _moved(_broadcast),
    "concatenate": _concatenate,
    "dot_general": _dot_general,
    "iota": _iota,
    "pad": _pad,
    "reduce_and": _reduce(_Written("and", lax.bitwise_and)),
    "reduce_max": _reduce(_Written("max", lax.max)),
    "reduce_min": _reduce(_Written("min", lax.min)),
    "reduce_or": _reduce(_Written("or", lax.bitwise_or)),
    "reduce_sum": _reduce(_ADD),
    "reshape": _moved(lambda params, numbers: numbers.reshape(params["new_sizes"])),
    "rev": _moved(lambda params, numbers: np.flip(numbers, params["dimensions"])),
    "slice": _moved(_slice),
    "split": _split,
    "squeeze": _moved(lambda params, numbers: np.squeeze(numbers, tuple(params["dimensions"]))),
    "stack": _stack,
    "transpose": _moved(lambda params, numbers: numbers.transpose(params["permutation"])),
    "unstack": _unstack,
}
