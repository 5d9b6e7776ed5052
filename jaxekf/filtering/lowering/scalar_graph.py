"""A traced function of one run as a flat list of operations: trace, split, evaluate.

The filter needs to know which entries of a Jacobian are always zero or one (`sparsity`), which operations
depend on the parameters only (`split_by_inputs`), and how to evaluate a function for many runs (`lanes`).
All three work on the list of operations, a `Program`.
"""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import numpy as np
from jax.extend import core

_REARRANGED = {"broadcast_in_dim", "reshape", "slice", "squeeze", "stack", "transpose", "unstack"}
_JITTED = {"jit", "pjit"}
_INLINED = _JITTED | {"closed_call", "core_call", "checkpoint", "remat"}


class Constant(NamedTuple):
    """An operand that is a constant."""

    value: Any


class Operation(NamedTuple):
    """One JAX primitive applied to constants and numbered values."""

    primitive: Any
    params: dict[str, Any]
    inputs: tuple[Any, ...]
    outputs: tuple[int, ...]
    shapes: tuple[Any, ...]
    """Shape and dtype of each output."""
    operands: tuple[Any, ...] = ()
    """Shape and dtype of each input."""

    def bind(self, values: Sequence[Any]) -> list[Any]:
        """The outputs for the given operands."""
        # Until JAX 0.7 functions among the parameters were returned separately.
        bound = self.primitive.get_bind_params(self.params)
        functions, params = bound if isinstance(bound, tuple) else ((), bound)
        found = self.primitive.bind(*functions, *values, **params)
        return list(found) if self.primitive.multiple_results else [found]


class Program(NamedTuple):
    """Operations in order of evaluation; values are numbered, inputs first."""

    inputs: tuple[Any, ...]
    """Shape and dtype of each input."""
    operations: tuple[Operation, ...]
    outputs: tuple[Any, ...]
    """Numbers of values, or constants."""
    tree: Any
    """Structure of the outputs."""

    def evaluate(self, values: Sequence[Any]) -> Any:
        """The outputs for one run."""
        known = dict(enumerate(values))

        def read(operand: Any) -> Any:
            return operand.value if isinstance(operand, Constant) else known[operand]

        for operation in self.operations:
            found = operation.bind([read(i) for i in operation.inputs])
            known.update(zip(operation.outputs, found, strict=True))
        return jax.tree.unflatten(self.tree, [read(o) for o in self.outputs])


def trace(
    function: Callable[..., Any], *args: Any, opaque_calls: frozenset[str] = frozenset()
) -> Program:
    """The program of ``function(*args)``; its inputs are the leaves of `args` in order.

    Calls are inlined, except those of jitted functions with a name in `opaque_calls`.
    """
    closed, shapes = jax.make_jaxpr(function, return_shape=True)(*args)
    tree = jax.tree.structure(shapes)
    return _program(closed.jaxpr, closed.consts, tree, opaque_calls)


def inlined(operation: Operation, opaque_calls: frozenset[str] = frozenset()) -> Program:
    """The program of a call; its outputs are a list."""
    tree = jax.tree.structure([0] * len(operation.outputs))
    return _program(*_called(operation.params), tree, opaque_calls)


def call_name(operation: Operation) -> str | None:
    """Name of the jitted function that an operation calls; None for any other operation."""
    return operation.params.get("name") if operation.primitive.name in _JITTED else None


def _called(params: dict[str, Any]) -> tuple[Any, list[Any]]:
    """The jaxpr of a call, and its constants."""
    found = params["jaxpr"] if "jaxpr" in params else params["call_jaxpr"]
    return getattr(found, "jaxpr", found), list(getattr(found, "consts", ()))


def _program(jaxpr: Any, consts: Any, tree: Any, opaque_calls: frozenset[str]) -> Program:
    operations: list[Operation] = []
    inputs = tuple(_spec(v) for v in jaxpr.invars)
    counter = [len(inputs)]
    constants = [Constant(value) for value in consts]
    numbers = list(range(len(inputs)))
    outputs = _flatten(jaxpr, constants, numbers, operations, counter, opaque_calls)
    return eliminate_dead_code(Program(inputs, tuple(operations), tuple(outputs), tree))


def split_by_inputs(program: Program, first: int) -> tuple[Program, Program]:
    """Split off the operations that depend on the first `first` inputs only.

    Returns the program of these operations (its outputs are a list), and the program of the others, whose
    inputs are those outputs followed by the remaining inputs.
    """
    early, fixed, producers = set(range(first)), set(), {}
    before, after = [], []
    for operation in program.operations:
        operands = [i for i in operation.inputs if not isinstance(i, Constant)]
        producers.update((o, operation) for o in operation.outputs)
        if fixed.issuperset(operands):
            # Made of constants only: evaluated on both sides if needed, nothing is handed over.
            fixed.update(operation.outputs)
            before.append(operation)
            after.append(operation)
        elif (early | fixed).issuperset(operands):
            early.update(operation.outputs)
            before.append(operation)
        else:
            after.append(operation)
    late = eliminate_dead_code(program._replace(operations=tuple(after))).operations
    specs = dict(enumerate(program.inputs))
    for operation in before:
        specs.update(zip(operation.outputs, operation.shapes, strict=True))
    wanted = _numbers([i for operation in late for i in operation.inputs] + list(program.outputs))
    needed, moved = _frontier(
        [i for i in dict.fromkeys(wanted) if i in early], early, producers, specs
    )
    places = {o.outputs[0] for o in after} | moved
    after = [o for o in program.operations if o.outputs[0] in places]
    tree = jax.tree.structure([0] * len(needed))
    head = eliminate_dead_code(Program(program.inputs[:first], tuple(before), tuple(needed), tree))
    number = {old: new for new, old in enumerate(needed)}
    rest = range(first, len(program.inputs))
    number |= {old: len(needed) + i for i, old in enumerate(rest)}
    inputs = (*[specs[i] for i in needed], *program.inputs[first:])
    count = len(inputs)
    renumbered = []
    for operation in after:
        operands = tuple(i if isinstance(i, Constant) else number[i] for i in operation.inputs)
        for output in operation.outputs:
            number[output], count = count, count + 1
        outputs = tuple(number[o] for o in operation.outputs)
        renumbered.append(operation._replace(inputs=operands, outputs=outputs))
    outputs = tuple(o if isinstance(o, Constant) else number[o] for o in program.outputs)
    return head, eliminate_dead_code(Program(inputs, tuple(renumbered), outputs, program.tree))


def _frontier(
    wanted: Sequence[int], early: set[int], producers: dict[int, Operation], specs: dict[int, Any]
) -> tuple[list[int], set[int]]:
    """The early values to hand over for the `wanted` ones, and the operations to move to the late side.

    Rearrangements of early values are moved if that hands over fewer numbers.
    """
    needed: list[int] = []
    moved: set[int] = set()
    for value in sorted(wanted, key=lambda i: -specs[i].size):
        sources, between = _sources(value, early, producers)
        fresh = [i for i in sources if i not in needed]
        if sum(specs[i].size for i in fresh) <= specs[value].size:
            needed += fresh
            moved |= between
        elif value not in needed:
            needed.append(value)
    return needed, moved


def _sources(
    value: int, early: set[int], producers: dict[int, Operation]
) -> tuple[list[int], set[int]]:
    """The values that a value is rearranged from, and those in between."""
    sources: list[int] = []
    between: set[int] = set()
    left = [value]
    while left:
        i = left.pop()
        operation = producers.get(i)
        if operation is not None and operation.primitive.name in _REARRANGED:
            between.add(operation.outputs[0])
            left += [k for k in _numbers(operation.inputs) if k in early and k not in between]
        elif i not in sources:
            sources.append(i)
    return sources, between


def _numbers(operands: Sequence[Any]) -> list[int]:
    return [i for i in operands if not isinstance(i, Constant)]


def _spec(variable: Any) -> jax.ShapeDtypeStruct:
    return jax.ShapeDtypeStruct(variable.aval.shape, variable.aval.dtype)


def _flatten(
    jaxpr: Any,
    constants: list[Any],
    values: list[Any],
    operations: list[Operation],
    counter: list[int],
    opaque_calls: frozenset[str],
) -> list[Any]:
    """Append the operations of `jaxpr`, nested calls inlined; returns the operands that are its outputs."""
    number = dict(zip([*jaxpr.constvars, *jaxpr.invars], [*constants, *values], strict=True))

    def read(atom: Any) -> Any:
        if isinstance(atom, core.Literal):
            return Constant(np.asarray(atom.val, atom.aval.dtype))  # pyright: ignore[reportAttributeAccessIssue]
        return number[atom]

    for eqn in jaxpr.eqns:
        operands = [read(atom) for atom in eqn.invars]
        name = eqn.primitive.name
        closed = name in _JITTED and eqn.params.get("name") in opaque_calls
        if name in _INLINED and not closed:
            inner, consts = _called(eqn.params)
            fixed = [Constant(c) for c in consts]
            found = _flatten(inner, fixed, operands, operations, counter, opaque_calls)
        else:
            found = list(range(counter[0], counter[0] + len(eqn.outvars)))
            counter[0] += len(found)
            shapes = tuple(_spec(v) for v in eqn.outvars)
            operand_specs = tuple(_spec(atom) for atom in eqn.invars)
            fields = (tuple(operands), tuple(found), shapes, operand_specs)
            operations.append(Operation(eqn.primitive, dict(eqn.params), *fields))
        number.update(zip(eqn.outvars, found, strict=True))
    return [read(atom) for atom in jaxpr.outvars]


def eliminate_dead_code(program: Program) -> Program:
    """The program without operations that no output needs."""
    needed = {o for o in program.outputs if not isinstance(o, Constant)}
    kept = []
    for operation in reversed(program.operations):
        if needed.intersection(operation.outputs):
            kept.append(operation)
            needed.update(i for i in operation.inputs if not isinstance(i, Constant))
    return program._replace(operations=tuple(reversed(kept)))
