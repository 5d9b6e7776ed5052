"""Jacobians of a function of a state by its error vector (docs/mathematics.md, section 1).

Forward-mode differentiation, operation by operation. The tangent of a rotation is a rotation vector in the
body frame instead of the four components of its quaternion. The functions of `jaxekf.geometry.rotation`
have their derivatives in closed form here,

- ``p q``: ``R(q)' theta_p + theta_q``; ``conj(q)``: ``-R(q) theta``,
- ``exp(delta)``: ``J_r(delta) d_delta``; ``log(q)``: ``J_r^-1(log q) theta``,
- ``a x b``: ``[a] d_b - [b] d_a``,
- ``R(q) v``: ``R(q) (d_v - [v] theta)``; ``R(q)' v``: ``R(q)' d_v + [R(q)' v] theta``

(Sola, Deray, Atchuthan 2018, section II and appendix B); JAX differentiates every other operation. From an
operation that takes a quaternion's components apart, the tangent has four components: the same result for
several times the arithmetic. Each part of the state has its own columns, so that an operation that does not
depend on a part costs nothing for it. `jaxekf.filtering._linearisation` calls `derivative`.
"""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxekf.filtering.lowering import lanes, scalar_graph
from jaxekf.filtering.lowering.lanes import Unbatched
from jaxekf.filtering.lowering.scalar_graph import Constant, Operation, Program
from jaxekf.geometry import rotation
from jaxekf.geometry.manifold import SO3, Euclidean, Manifold


class Tangent(NamedTuple):
    """Derivatives of one value by the parts of the state."""

    is_rotation: bool
    """Whether the value is a quaternion and its columns are rotation vectors (3, columns) in the body
    frame; otherwise they are derivatives of the value's own components, (..., columns)."""
    columns: dict[int, Any]
    """By part of the state; parts on which the value does not depend are not here."""


_NOTHING = Tangent(False, {})


class Derivative(NamedTuple):
    """A function's value and its Jacobian between tangent spaces, in blocks."""

    value: Any
    blocks: dict[tuple[int, int], Array]
    """By part of the value and part of the arguments; blocks that are zero are not here."""
    fallbacks: tuple[str, ...]
    """Operations from which a rotation's tangent had four components."""


def derivative(
    function: Callable[..., Any],
    args: Sequence[Any],
    manifolds: Sequence[Sequence[Manifold]],
    result: Sequence[Manifold],
) -> Derivative:
    """Value and Jacobian of ``function(*args)``.

    Parameters
    ----------
    function, args
        Of one run.
    manifolds
        For each argument the manifolds of its leaves.
    result
        The manifolds of the leaves of the value.
    """
    spec = jax.tree.map(
        lambda a: jax.ShapeDtypeStruct(jnp.shape(a), jnp.result_type(a)), list(args)
    )
    program = scalar_graph.trace(function, *spec, opaque_calls=frozenset(rotation.GROUP_CALLS))
    leaves = jax.tree.leaves(list(args))
    parts = [manifold for own in manifolds for manifold in own]
    seeds = [_seed(m, i, leaf) for i, (m, leaf) in enumerate(zip(parts, leaves, strict=True))]
    fallbacks: list[str] = []
    values, tangents = _propagate(program, leaves, seeds, fallbacks)
    blocks = {}
    for row, (manifold, value, tangent) in enumerate(zip(result, values, tangents, strict=True)):
        for part, block in _lower(manifold, value, tangent, fallbacks).items():
            blocks[row, part] = block
    value = jax.tree.unflatten(program.tree, values)
    return Derivative(value, blocks, tuple(dict.fromkeys(fallbacks)))


def _seed(manifold: Manifold, part: int, leaf: Any) -> Tangent:
    columns = np.eye(manifold.dim, dtype=leaf.dtype)
    if isinstance(manifold, Euclidean):
        return Tangent(False, {part: columns})
    if type(manifold) is SO3:
        return Tangent(True, {part: columns})
    lifted = jax.vmap(lambda c: manifold.lift(leaf, c), in_axes=-1, out_axes=-1)
    return Tangent(False, {part: lifted(jnp.asarray(columns))})


def _lower(
    manifold: Manifold, value: Any, tangent: Tangent, fallbacks: list[str]
) -> dict[int, Array]:
    if type(manifold) is SO3 and tangent.is_rotation:
        return tangent.columns
    numbers = _components(value, tangent, fallbacks, "the result")
    if isinstance(manifold, Euclidean):
        return numbers
    lower = jax.vmap(lambda c: manifold.lower(value, c), in_axes=-1, out_axes=-1)
    return {part: lower(jnp.asarray(columns)) for part, columns in numbers.items()}


def _propagate(
    program: Program, leaves: list[Any], seeds: list[Tangent], fallbacks: list[str]
) -> tuple[list[Any], list[Tangent]]:
    values: dict[int, Any] = dict(enumerate(leaves))
    tangents: dict[int, Tangent] = dict(enumerate(seeds))

    def value(operand: Any) -> Any:
        return operand.value if isinstance(operand, Constant) else values[operand]

    def tangent(operand: Any) -> Tangent:
        return _NOTHING if isinstance(operand, Constant) else tangents.get(operand, _NOTHING)

    for operation in program.operations:
        operands = [value(i) for i in operation.inputs]
        own = [tangent(i) for i in operation.inputs]
        found, results = _step(operation, operands, own, fallbacks)
        values.update(zip(operation.outputs, found, strict=True))
        tangents.update(zip(operation.outputs, results, strict=True))
    return [value(o) for o in program.outputs], [tangent(o) for o in program.outputs]


def _step(
    operation: Operation, values: list[Any], tangents: list[Tangent], fallbacks: list[str]
) -> tuple[list[Any], list[Tangent]]:
    """The outputs of one operation and their tangents."""
    if not any(t.columns for t in tangents):
        return operation.bind(values), [_NOTHING] * len(operation.outputs)
    name = scalar_graph.call_name(operation)
    if name is None:
        numbers = [
            _components(v, t, fallbacks, operation.primitive.name)
            for v, t in zip(values, tangents, strict=True)
        ]
        found = operation.bind(values)
        return found, _differentiate(operation, values, numbers, found)
    rule = _RULES[name.removeprefix("jaxekf.geometry.rotation.")]
    single = all(np.ndim(v) == 1 for v in values)
    if single and all(
        t.is_rotation or not t.columns for t, q in zip(tangents, rule.rotations, strict=True) if q
    ):
        (found,) = operation.bind(values)
        return [found], [rule.function(found, values, [t.columns for t in tangents])]
    # With a quaternion of four free numbers, or with several rotations at once: four components.
    numbers = [
        Tangent(False, _components(v, t, [], name)) for v, t in zip(values, tangents, strict=True)
    ]
    inner = scalar_graph.inlined(operation, frozenset(rotation.GROUP_CALLS))
    return _propagate(inner, values, numbers, fallbacks)


def _components(value: Any, tangent: Tangent, fallbacks: list[str], name: str) -> dict[int, Any]:
    """The tangent of a value in its own components."""
    if not tangent.is_rotation or not tangent.columns:
        return tangent.columns
    fallbacks.append(name)
    w, x, y, z = (value[i] for i in range(4))
    rows = [[-x, -y, -z], [w, -z, y], [z, w, -x], [-y, x, w]]
    lift = 0.5 * jnp.stack([jnp.stack(row) for row in rows])
    return {part: _times(lift, columns) for part, columns in tangent.columns.items()}


def _times(matrix: Array, columns: Any) -> Array:
    """``matrix @ columns``; the matrix itself if the columns are the identity."""
    return matrix if _is_identity(columns) else matrix @ columns


def _is_identity(columns: Any) -> bool:
    """Whether columns are known to be the identity."""
    return isinstance(columns, np.ndarray) and np.array_equal(columns, np.eye(columns.shape[0]))


def _sum(*terms: dict[int, Any]) -> dict[int, Any]:
    total: dict[int, Any] = {}
    for term in terms:
        for part, columns in term.items():
            total[part] = total[part] + columns if part in total else columns
    return total


# --- rotations ----------------------------------------------------------------------------------------


class _Rule(NamedTuple):
    """Derivative of a function of `jaxekf.geometry.rotation` in closed form."""

    rotations: tuple[bool, ...]
    """For each argument whether its tangent must be a rotation vector."""
    function: Callable[[Any, list[Any], list[dict[int, Any]]], Tangent]


def _multiply_columns(matrix: Any, by: dict[int, Any]) -> dict[int, Any]:
    return {part: _times(matrix, columns) for part, columns in by.items()}


def _product(found: Any, values: list[Any], by: list[dict[int, Any]]) -> Tangent:
    first = _multiply_columns(rotation.to_matrix(values[1]).T, by[0]) if by[0] else {}
    return Tangent(True, _sum(first, by[1]))


def _conjugate(found: Any, values: list[Any], by: list[dict[int, Any]]) -> Tangent:
    return Tangent(True, _multiply_columns(-rotation.to_matrix(values[0]), by[0]))


def _exp(found: Any, values: list[Any], by: list[dict[int, Any]]) -> Tangent:
    return Tangent(True, _multiply_columns(rotation.right_jacobian(values[0]), by[0]))


def _log(found: Any, values: list[Any], by: list[dict[int, Any]]) -> Tangent:
    return Tangent(False, _multiply_columns(rotation.inverse_right_jacobian(found), by[0]))


def _cross(found: Any, values: list[Any], by: list[dict[int, Any]]) -> Tangent:
    a, b = values
    first = {part: -_skew_times(b, columns) for part, columns in by[0].items()}
    return Tangent(False, _sum(first, {p: _skew_times(a, columns) for p, columns in by[1].items()}))


def _skew_times(vector: Any, columns: Any) -> Array:
    """``[vector] columns``: the cross product with each column."""
    if _is_identity(columns):
        return rotation.skew(vector)
    return rotation.cross(jnp.broadcast_to(vector[:, None], columns.shape).T, columns.T).T


def _rotate(found: Any, values: list[Any], by: list[dict[int, Any]]) -> Tangent:
    matrix = rotation.to_matrix(values[0])
    by_rotation = {}
    for part, columns in by[0].items():
        if _is_identity(columns):
            # A row r of R makes r' [v] = (r x v)'.
            by_rotation[part] = -rotation.cross(matrix, jnp.broadcast_to(values[1], (3, 3)))
        else:
            by_rotation[part] = -(matrix @ _skew_times(values[1], columns))
    return Tangent(False, _sum(by_rotation, _multiply_columns(matrix, by[1])))


def _rotate_inverse(found: Any, values: list[Any], by: list[dict[int, Any]]) -> Tangent:
    by_rotation = {part: _skew_times(found, columns) for part, columns in by[0].items()}
    by_vector = _multiply_columns(rotation.to_matrix(values[0]).T, by[1]) if by[1] else {}
    return Tangent(False, _sum(by_rotation, by_vector))


def _to_matrix(found: Any, values: list[Any], by: list[dict[int, Any]]) -> Tangent:
    # Column j of R [theta] is R (theta x e_j).
    by_rotation = jnp.stack([-(found @ rotation.skew(jnp.asarray(e))) for e in np.eye(3)], axis=1)
    return Tangent(False, {part: by_rotation @ columns for part, columns in by[0].items()})


def _pass_through(found: Any, values: list[Any], by: list[dict[int, Any]]) -> Tangent:
    return Tangent(True, by[0])


_RULES = {
    "align": _Rule((True, True), _pass_through),
    "cross": _Rule((False, False), _cross),
    "conjugate": _Rule((True,), _conjugate),
    "exp": _Rule((False,), _exp),
    "keep_unit": _Rule((True,), _pass_through),
    "log": _Rule((True,), _log),
    "normalise": _Rule((True,), _pass_through),
    "product": _Rule((True, True), _product),
    "rotate": _Rule((True, False), _rotate),
    "rotate_inverse": _Rule((True, False), _rotate_inverse),
    "to_matrix": _Rule((True,), _to_matrix),
}


# --- all other operations -----------------------------------------------------------------------------

_LINEAR = frozenset(
    [
        *("broadcast_in_dim", "concatenate", "convert_element_type", "copy", "copy_p", "neg"),
        "reduce_sum",
        *("reshape", "rev", "slice", "split", "squeeze", "stack", "transpose", "unstack"),
    ]
)
_SUMS = {"add": (1, 1), "add_any": (1, 1), "sub": (1, -1)}


def _differentiate(
    operation: Operation, values: list[Any], by: list[dict[int, Any]], found: list[Any]
) -> list[Tangent]:
    parts = list(dict.fromkeys(part for one in by for part in one))
    columns_of: list[dict[int, Any]] = [{} for _ in operation.outputs]
    for part in parts:
        columns = [one.get(part) for one in by]
        for end, tangent in zip(
            columns_of, _output_columns(operation, values, columns, found), strict=True
        ):
            if tangent is not None:
                end[part] = tangent
    return [Tangent(False, columns) for columns in columns_of]


def _output_columns(
    operation: Operation, values: list[Any], columns: list[Any], found: list[Any]
) -> Sequence[Any]:
    """Columns of the outputs from those of the operands; None for an operand without any."""
    name = operation.primitive.name
    if not any(jnp.issubdtype(spec.dtype, jnp.inexact) for spec in operation.shapes):
        return [None] * len(operation.outputs)
    count = next(c.shape[-1] for c in columns if c is not None)
    if name in _LINEAR:
        operands = [
            Unbatched(np.zeros(spec.shape, spec.dtype)) if c is None else c
            for c, spec in zip(columns, operation.operands, strict=True)
        ]
        return lanes.apply_operation(operation, operands, count)
    if name in _SUMS:
        terms = [
            c if sign == 1 else -c
            for c, sign in zip(columns, _SUMS[name], strict=True)
            if c is not None
        ]
        return [lanes.unrolled_sum([_fit(t, operation, count) for t in terms])]
    if name in ("mul", "dot_general"):
        a, b = columns
        terms = []
        if a is not None:
            terms += lanes.apply_operation(operation, [a, Unbatched(values[1])], count)
        if b is not None:
            terms += lanes.apply_operation(operation, [Unbatched(values[0]), b], count)
        return [lanes.unrolled_sum(terms)]
    if name == "select_n":
        zero = Unbatched(np.zeros(operation.shapes[0].shape, operation.shapes[0].dtype))
        cases = [zero if c is None else c for c in columns[1:]]
        return lanes.apply_operation(operation, [Unbatched(values[0]), *cases], count)
    if _is_elementwise(operation):
        return [_chain_rule(operation, values, columns, count)]
    return _by_vmap(operation, values, columns)


def _fit(columns: Any, operation: Operation, count: int) -> Any:
    """Columns of an operand, broadcast to the shape of the result."""
    return lanes.fit_shape(columns, (*operation.shapes[0].shape, count))


def _is_elementwise(operation: Operation) -> bool:
    if operation.primitive.name == "custom_jvp_call":
        inner = scalar_graph.inlined(operation).operations
        return len(operation.outputs) == 1 and all(map(_is_elementwise, inner))
    return operation.primitive.name in lanes.ELEMENTWISE


def _chain_rule(operation: Operation, values: list[Any], columns: list[Any], count: int) -> Any:
    """An elementwise operation: its derivative by each operand times the operand's columns, summed."""
    moving = [i for i, c in enumerate(columns) if c is not None]
    terms = []
    for i in moving:

        def one(value: Any, i: int = i) -> Any:
            return operation.bind([*values[:i], value, *values[i + 1 :]])[0]

        slope = jax.jvp(one, (values[i],), (jnp.ones_like(values[i]),))[1]
        terms.append(slope[..., None] * _fit(columns[i], operation, count))
    return lanes.unrolled_sum(terms)


def _by_vmap(operation: Operation, values: list[Any], columns: list[Any]) -> Sequence[Any]:
    moving = [i for i, c in enumerate(columns) if c is not None]

    def one(*changes: Any) -> Any:
        def function(*moved: Any) -> Any:
            full = list(values)
            for i, value in zip(moving, moved, strict=True):
                full[i] = value
            return operation.bind(full)

        return jax.jvp(function, tuple(values[i] for i in moving), changes)[1]

    operands = [jnp.asarray(columns[i]) for i in moving]
    return jax.vmap(one, in_axes=-1, out_axes=-1)(*operands)
