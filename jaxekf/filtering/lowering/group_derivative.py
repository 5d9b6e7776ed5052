"""Derivatives of a function of a state by its error vector, on the manifold.

A rotation's change is followed as a rotation vector in the body frame, not as a change of the quaternion's
four numbers: the functions of `jaxekf.geometry.rotation` have their derivatives in closed form here,

- ``p q``: ``R(q)' theta_p + theta_q``; ``conj(q)``: ``-R(q) theta``,
- ``exp(delta)``: ``J_r(delta) d_delta``; ``log(q)``: ``J_r^-1(log q) theta``,
- ``a x b``: ``[a] d_b - [b] d_a``,
- ``R(q) v``: ``R(q) (d_v - [v] theta)``; ``R(q)' v``: ``R(q)' d_v + [R(q)' v] theta``

(Sola, Deray, Atchuthan 2018, section II and appendix B), and everything else is differentiated by JAX,
operation by operation. A function that takes a quaternion apart by itself is followed by its four numbers
from there on, which costs several times as much arithmetic and gives the same. Each part of the state is
differentiated with the others held, so that what does not depend on it costs nothing.
"""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxekf.filtering.lowering import lanes, scalar_graph
from jaxekf.filtering.lowering.lanes import Fixed
from jaxekf.filtering.lowering.scalar_graph import Constant, Operation, Program
from jaxekf.geometry import rotation
from jaxekf.geometry.manifold import SO3, Euclidean, Manifold


class Tangent(NamedTuple):
    """Derivatives of one value; an array of columns for each part that it depends on."""

    turn: bool
    """Whether the value is a quaternion and the columns are rotation vectors (3, columns) in the body
    frame; else they are changes of the value's own numbers (..., columns)."""
    by: dict[int, Any]


_NOTHING = Tangent(False, {})


class Derivative(NamedTuple):
    """A function's value and the blocks of its Jacobian in tangent spaces."""

    value: Any
    blocks: dict[tuple[int, int], Array]
    """By part of the value and part of what it was differentiated by; blocks that are zero are left out."""
    left: tuple[str, ...]
    """Operations at which a rotation was followed by its four numbers instead."""


def derivative(
    function: Callable[..., Any],
    args: Sequence[Any],
    manifolds: Sequence[Sequence[Manifold]],
    result: Sequence[Manifold],
) -> Derivative:
    """Value and Jacobian of ``function(*args)``, each leaf of the arguments on one of the `manifolds`, each
    leaf of the result on one of `result`."""
    spec = jax.tree.map(
        lambda a: jax.ShapeDtypeStruct(jnp.shape(a), jnp.result_type(a)), list(args)
    )
    program = scalar_graph.trace(function, *spec, closed_calls=frozenset(rotation.GROUP_CALLS))
    leaves = jax.tree.leaves(list(args))
    parts = [manifold for own in manifolds for manifold in own]
    seeds = [_seed(m, i, leaf) for i, (m, leaf) in enumerate(zip(parts, leaves, strict=True))]
    left: list[str] = []
    values, tangents = _followed(program, leaves, seeds, left)
    blocks = {}
    for row, (manifold, value, tangent) in enumerate(zip(result, values, tangents, strict=True)):
        for part, block in _lowered(manifold, value, tangent, left).items():
            blocks[row, part] = block
    value = jax.tree.unflatten(program.tree, values)
    return Derivative(value, blocks, tuple(dict.fromkeys(left)))


def _seed(manifold: Manifold, part: int, leaf: Any) -> Tangent:
    columns = np.eye(manifold.dim, dtype=leaf.dtype)
    if isinstance(manifold, Euclidean):
        return Tangent(False, {part: columns})
    if type(manifold) is SO3:
        return Tangent(True, {part: columns})
    lifted = jax.vmap(lambda c: manifold.lift(leaf, c), in_axes=-1, out_axes=-1)
    return Tangent(False, {part: lifted(jnp.asarray(columns))})


def _lowered(manifold: Manifold, value: Any, tangent: Tangent, left: list[str]) -> dict[int, Array]:
    if type(manifold) is SO3 and tangent.turn:
        return tangent.by
    numbers = _as_numbers(value, tangent, left, "the result")
    if isinstance(manifold, Euclidean):
        return numbers
    lower = jax.vmap(lambda c: manifold.lower(value, c), in_axes=-1, out_axes=-1)
    return {part: lower(jnp.asarray(columns)) for part, columns in numbers.items()}


def _followed(
    program: Program, leaves: list[Any], seeds: list[Tangent], left: list[str]
) -> tuple[list[Any], list[Tangent]]:
    values: dict[int, Any] = dict(enumerate(leaves))
    tangents: dict[int, Tangent] = dict(enumerate(seeds))

    def value(operand: Any) -> Any:
        return operand.value if isinstance(operand, Constant) else values[operand]

    def tangent(operand: Any) -> Tangent:
        return _NOTHING if isinstance(operand, Constant) else tangents.get(operand, _NOTHING)

    for operation in program.operations:
        operands = [value(i) for i in operation.inputs]
        given = [tangent(i) for i in operation.inputs]
        found, ends = _step(operation, operands, given, left)
        values.update(zip(operation.outputs, found, strict=True))
        tangents.update(zip(operation.outputs, ends, strict=True))
    return [value(o) for o in program.outputs], [tangent(o) for o in program.outputs]


def _step(
    operation: Operation, values: list[Any], tangents: list[Tangent], left: list[str]
) -> tuple[list[Any], list[Tangent]]:
    """Outputs of one operation and their tangents."""
    if not any(t.by for t in tangents):
        return operation.bind(values), [_NOTHING] * len(operation.outputs)
    name = scalar_graph.call_name(operation)
    if name is None:
        numbers = [
            _as_numbers(v, t, left, operation.primitive.name)
            for v, t in zip(values, tangents, strict=True)
        ]
        found = operation.bind(values)
        return found, _differentiated(operation, values, numbers, found)
    rule = _RULES[name.removeprefix("jaxekf.geometry.rotation.")]
    single = all(np.ndim(v) == 1 for v in values)
    if single and all(t.turn or not t.by for t, q in zip(tangents, rule.turns, strict=True) if q):
        (found,) = operation.bind(values)
        return [found], [rule.function(found, values, [t.by for t in tangents])]
    # Beside a quaternion that is four free numbers, and for many at once, rotations are followed by theirs.
    numbers = [
        Tangent(False, _as_numbers(v, t, [], name)) for v, t in zip(values, tangents, strict=True)
    ]
    inner = scalar_graph.opened(operation, frozenset(rotation.GROUP_CALLS))
    return _followed(inner, values, numbers, left)


def _as_numbers(value: Any, tangent: Tangent, left: list[str], name: str) -> dict[int, Any]:
    """Changes of a value's own numbers."""
    if not tangent.turn or not tangent.by:
        return tangent.by
    left.append(name)
    w, x, y, z = (value[i] for i in range(4))
    rows = [[-x, -y, -z], [w, -z, y], [z, w, -x], [-y, x, w]]
    lift = 0.5 * jnp.stack([jnp.stack(row) for row in rows])
    return {part: _times(lift, columns) for part, columns in tangent.by.items()}


def _times(matrix: Array, columns: Any) -> Array:
    """A matrix times columns; the matrix itself where they are those of the identity."""
    return matrix if _is_identity(columns) else matrix @ columns


def _is_identity(columns: Any) -> bool:
    """Whether columns are known to be those of the identity."""
    return isinstance(columns, np.ndarray) and np.array_equal(columns, np.eye(columns.shape[0]))


def _sum(*terms: dict[int, Any]) -> dict[int, Any]:
    total: dict[int, Any] = {}
    for term in terms:
        for part, columns in term.items():
            total[part] = total[part] + columns if part in total else columns
    return total


# --- rotations ----------------------------------------------------------------------------------------


class _Rule(NamedTuple):
    """Derivative of a function of `jaxekf.geometry.rotation`; which of its arguments must be followed
    as turns."""

    turns: tuple[bool, ...]
    function: Callable[[Any, list[Any], list[dict[int, Any]]], Tangent]


def _mapped(matrix: Any, by: dict[int, Any]) -> dict[int, Any]:
    return {part: _times(matrix, columns) for part, columns in by.items()}


def _product(found: Any, values: list[Any], by: list[dict[int, Any]]) -> Tangent:
    first = _mapped(rotation.to_matrix(values[1]).T, by[0]) if by[0] else {}
    return Tangent(True, _sum(first, by[1]))


def _conjugate(found: Any, values: list[Any], by: list[dict[int, Any]]) -> Tangent:
    return Tangent(True, _mapped(-rotation.to_matrix(values[0]), by[0]))


def _exp(found: Any, values: list[Any], by: list[dict[int, Any]]) -> Tangent:
    return Tangent(True, _mapped(rotation.right_jacobian(values[0]), by[0]))


def _log(found: Any, values: list[Any], by: list[dict[int, Any]]) -> Tangent:
    return Tangent(False, _mapped(rotation.inverse_right_jacobian(found), by[0]))


def _cross(found: Any, values: list[Any], by: list[dict[int, Any]]) -> Tangent:
    a, b = values
    first = {part: -_crossed(b, columns) for part, columns in by[0].items()}
    return Tangent(False, _sum(first, {p: _crossed(a, columns) for p, columns in by[1].items()}))


def _crossed(vector: Any, columns: Any) -> Array:
    """``[vector] columns``."""
    if _is_identity(columns):
        return rotation.skew(vector)
    return rotation.cross(jnp.broadcast_to(vector[:, None], columns.shape).T, columns.T).T


def _rotate(found: Any, values: list[Any], by: list[dict[int, Any]]) -> Tangent:
    matrix = rotation.to_matrix(values[0])
    turned = {}
    for part, columns in by[0].items():
        if _is_identity(columns):
            # A row r of R makes r' [v] = (r x v)'.
            turned[part] = -rotation.cross(matrix, jnp.broadcast_to(values[1], (3, 3)))
        else:
            turned[part] = -(matrix @ _crossed(values[1], columns))
    return Tangent(False, _sum(turned, _mapped(matrix, by[1])))


def _rotate_inverse(found: Any, values: list[Any], by: list[dict[int, Any]]) -> Tangent:
    turned = {part: _crossed(found, columns) for part, columns in by[0].items()}
    moved = _mapped(rotation.to_matrix(values[0]).T, by[1]) if by[1] else {}
    return Tangent(False, _sum(turned, moved))


def _to_matrix(found: Any, values: list[Any], by: list[dict[int, Any]]) -> Tangent:
    # Column j of R [theta] is R (theta x e_j).
    turned = jnp.stack([-(found @ rotation.skew(jnp.asarray(e))) for e in np.eye(3)], axis=1)
    return Tangent(False, {part: turned @ columns for part, columns in by[0].items()})


def _same(found: Any, values: list[Any], by: list[dict[int, Any]]) -> Tangent:
    return Tangent(True, by[0])


_RULES = {
    "align": _Rule((True, True), _same),
    "cross": _Rule((False, False), _cross),
    "conjugate": _Rule((True,), _conjugate),
    "exp": _Rule((False,), _exp),
    "keep_unit": _Rule((True,), _same),
    "log": _Rule((True,), _log),
    "normalise": _Rule((True,), _same),
    "product": _Rule((True, True), _product),
    "rotate": _Rule((True, False), _rotate),
    "rotate_inverse": _Rule((True, False), _rotate_inverse),
    "to_matrix": _Rule((True,), _to_matrix),
}


# --- all other operations -----------------------------------------------------------------------------

_LINEAR = frozenset(
    [
        *(
            "broadcast_in_dim",
            "concatenate",
            "convert_element_type",
            "copy",
            "copy_p",
            "neg",
            "reduce_sum",
        ),
        *("reshape", "rev", "slice", "split", "squeeze", "stack", "transpose", "unstack"),
    ]
)
_SUMS = {"add": (1, 1), "add_any": (1, 1), "sub": (1, -1)}


def _differentiated(
    operation: Operation, values: list[Any], by: list[dict[int, Any]], found: list[Any]
) -> list[Tangent]:
    parts = list(dict.fromkeys(part for one in by for part in one))
    ends: list[dict[int, Any]] = [{} for _ in operation.outputs]
    for part in parts:
        columns = [one.get(part) for one in by]
        for end, tangent in zip(ends, _columns(operation, values, columns, found), strict=True):
            if tangent is not None:
                end[part] = tangent
    return [Tangent(False, end) for end in ends]


def _columns(
    operation: Operation, values: list[Any], columns: list[Any], found: list[Any]
) -> Sequence[Any]:
    """Columns of the outputs by those of the operands, None for an operand without."""
    name = operation.primitive.name
    if not any(jnp.issubdtype(spec.dtype, jnp.inexact) for spec in operation.shapes):
        return [None] * len(operation.outputs)
    count = next(c.shape[-1] for c in columns if c is not None)
    if name in _LINEAR:
        given = [
            Fixed(np.zeros(spec.shape, spec.dtype)) if c is None else c
            for c, spec in zip(columns, operation.operands, strict=True)
        ]
        return lanes.apply(operation, given, count)
    if name in _SUMS:
        terms = [
            c if sign == 1 else -c
            for c, sign in zip(columns, _SUMS[name], strict=True)
            if c is not None
        ]
        return [lanes.written_sum([_fitted(t, operation, count) for t in terms])]
    if name in ("mul", "dot_general"):
        a, b = columns
        terms = []
        if a is not None:
            terms += lanes.apply(operation, [a, Fixed(values[1])], count)
        if b is not None:
            terms += lanes.apply(operation, [Fixed(values[0]), b], count)
        return [lanes.written_sum(terms)]
    if name == "select_n":
        zero = Fixed(np.zeros(operation.shapes[0].shape, operation.shapes[0].dtype))
        cases = [zero if c is None else c for c in columns[1:]]
        return lanes.apply(operation, [Fixed(values[0]), *cases], count)
    if _is_elementwise(operation):
        return [_chained(operation, values, columns, count)]
    return _by_vmap(operation, values, columns)


def _fitted(columns: Any, operation: Operation, count: int) -> Any:
    """Columns of a scalar or one wide operand in the shape of the result."""
    return lanes.fitted(columns, (*operation.shapes[0].shape, count))


def _is_elementwise(operation: Operation) -> bool:
    if operation.primitive.name == "custom_jvp_call":
        inner = scalar_graph.opened(operation).operations
        return len(operation.outputs) == 1 and all(map(_is_elementwise, inner))
    return operation.primitive.name in lanes.ELEMENTWISE


def _chained(operation: Operation, values: list[Any], columns: list[Any], count: int) -> Any:
    """Sum of the derivative by each operand, a number for each number, times its columns."""
    moving = [i for i, c in enumerate(columns) if c is not None]
    terms = []
    for i in moving:

        def one(value: Any, i: int = i) -> Any:
            return operation.bind([*values[:i], value, *values[i + 1 :]])[0]

        slope = jax.jvp(one, (values[i],), (jnp.ones_like(values[i]),))[1]
        terms.append(slope[..., None] * _fitted(columns[i], operation, count))
    return lanes.written_sum(terms)


def _by_vmap(operation: Operation, values: list[Any], columns: list[Any]) -> Sequence[Any]:
    moving = [i for i, c in enumerate(columns) if c is not None]

    def one(*changes: Any) -> Any:
        def function(*moved: Any) -> Any:
            full = list(values)
            for i, value in zip(moving, moved, strict=True):
                full[i] = value
            return operation.bind(full)

        return jax.jvp(function, tuple(values[i] for i in moving), changes)[1]

    given = [jnp.asarray(columns[i]) for i in moving]
    return jax.vmap(one, in_axes=-1, out_axes=-1)(*given)
