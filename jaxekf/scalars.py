"""A program evaluated number by number: every number of every array is a value of its own, on lanes.

Small geometry is mostly rearrangement, and mostly multiplication by numbers that are always zero or one.
Taken number by number the rearrangement costs nothing and those products are never made. What is left is
plain arithmetic on lanes: first written down as a graph, in which equal numbers are one, then computed,
numbers that are used often being kept and the others made where they are used.
"""

from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, core, lax

from jaxekf import lanes
from jaxekf.graph import Arithmetic, Node, Numbers, constants, elementwise, is_constant, leaves
from jaxekf.kernels import loop
from jaxekf.programs import Constant, Operation, Program
from jaxekf.rules import RULES

_WORTH_KEEPING = 10
_LONGEST = 64


def evaluate(program: Program, values: Sequence[Array]) -> Any:
    """The outputs of `program`, with lanes; each of `values` carries the lanes on its last axis."""
    outputs, sources = _graph(program, values)
    return jax.tree.unflatten(program.tree, _compute(outputs, sources, values[0].shape[-1]))


def numbers_of(program: Program) -> tuple[list[Numbers], bool]:
    """The numbers of the outputs, and whether they are arithmetic and rearrangements of inputs only."""
    blank = [jnp.zeros((*spec.shape, 1), spec.dtype) for spec in program.inputs]
    outputs, sources = _graph(program, blank)
    return outputs, len(sources) == len(blank)


def used(outputs: list[Numbers], count: int) -> list[list[tuple[int, ...]]]:
    """Which numbers of each of the first `count` inputs the outputs of a plain program depend on."""
    found: list[set[Any]] = [set() for _ in range(count)]
    for node in _order(outputs)[0]:
        if node.operation is None and node.inputs[0] < count:
            found[node.inputs[0]].add(node.inputs[1])
    return [sorted(indices) for indices in found]


def _graph(program: Program, values: Sequence[Array]) -> tuple[list[Numbers], list[Array]]:
    """The numbers of the outputs, and the arrays that they are computed from."""
    width = values[0].shape[-1]
    sources = list(values)
    made: dict[Any, Node] = {}
    known: dict[int, Numbers] = {
        i: leaves(i, spec.shape, spec.dtype) for i, spec in enumerate(program.inputs)
    }

    def read(operand: Any) -> Numbers:
        if not isinstance(operand, Constant):
            return known[operand]
        if isinstance(operand.value, core.Tracer):
            sources.append(lanes.spread(operand.value, width))
            return leaves(len(sources) - 1, operand.value.shape, operand.value.dtype)
        return constants(operand.value)

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
        if operation.primitive.name not in lanes.CHEAP or often or length[id(node)] > _LONGEST:
            kept[id(node)] = _kept([node], (), kept, sources, width)
    found = []
    for numbers in outputs:
        nodes = [n for n in numbers.ravel() if isinstance(n, Node)]
        whole = [n for n in nodes if n.operation is None]
        if nodes and len(whole) == numbers.size and _is_source(whole, sources, numbers.shape):
            found.append(sources[whole[0].inputs[0]])
        else:
            found.append(_kept(list(numbers.ravel()), numbers.shape, kept, sources, width))
    return found


def _is_source(nodes: list[Node], sources: list[Array], shape: tuple[int, ...]) -> bool:
    """Whether numbers are those of a given array, all of them in order."""
    at = nodes[0].inputs[0]
    return sources[at].shape[:-1] == shape and all(
        node.inputs == (at, index) for node, index in zip(nodes, np.ndindex(shape), strict=True)
    )


def _order(outputs: list[Numbers]) -> tuple[list[Node], dict[int, int]]:
    """Every node that is needed, operands first, and how often each is used."""
    order: list[Node] = []
    uses: dict[int, int] = {}
    stack = [(n, False) for numbers in outputs for n in numbers.ravel() if isinstance(n, Node)]
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
                if isinstance(i, Node):
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

    def gather(node: Any) -> None:
        if not isinstance(node, Node):
            return
        if id(node) in kept:
            arguments[id(node)] = kept[id(node)]
        elif node.operation is None:
            arguments["source", node.inputs[0]] = sources[node.inputs[0]]
        else:
            for i in node.inputs:
                gather(i)

    for number in numbers:
        gather(number)

    def compute(arguments: dict[Any, Array]) -> Array:
        done: dict[int, Array] = {}

        def value(node: Any) -> Any:
            if not isinstance(node, Node):
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


def _apply(
    operation: Operation, operands: list[Numbers], made: dict[Any, Node], sources: list[Array]
) -> list[Numbers]:
    name, params = operation.primitive.name, operation.params
    if name in lanes.ELEMENTWISE or _is_scalar_call(operation):
        return [elementwise(operation, operands, made)]
    rule = RULES.get(name)
    found = rule(Arithmetic(made), params, operands) if rule is not None else None
    return _whole(operation, operands, sources) if found is None else found


def _whole(operation: Operation, operands: list[Numbers], sources: list[Array]) -> list[Numbers]:
    """An operation that is not taken apart, on whole arrays."""
    width = sources[0].shape[-1]
    constant = [all(map(is_constant, o.ravel())) for o in operands]
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
            return [constants(v) for v in operation.bind(plain)]
    outputs = jax.vmap(lambda *v: operation.bind(v), in_axes=axes, out_axes=-1)(*plain)
    found = []
    for output in outputs:
        sources.append(output)
        found.append(leaves(len(sources) - 1, output.shape[:-1], output.dtype))
    return found


def _is_scalar_call(operation: Operation) -> bool:
    """A function with a derivative of its own, that acts on each number alone."""
    if operation.primitive.name != "custom_jvp_call":
        return False
    inner = operation.params["call_jaxpr"].jaxpr
    return len(operation.outputs) == 1 and all(
        eqn.primitive.name in lanes.ELEMENTWISE for eqn in inner.eqns
    )
