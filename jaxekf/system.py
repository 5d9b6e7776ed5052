"""A model made ready for the filter: its functions on lanes, and the structure of its matrices.

All of it is found from the model's functions when a program is traced; a model declares nothing.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache, partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax

from jaxekf import linalg, linearise, manifold, many, patterned, programs, scalars, structure
from jaxekf.model import Model, Sensor
from jaxekf.patterned import Pattern
from jaxekf.programs import Program
from jaxekf.timeline import Rows


class Piece:
    """A function of one run, split into what depends on the parameters only and what is done each step."""

    is_plain: bool
    """Whether the work of a step is arithmetic only."""

    def __init__(self, function: Callable[..., Any], params: Any, *rest: Any) -> None:
        program = programs.trace(function, params, *rest)
        self._head, body = programs.split(program, len(jax.tree.leaves(params)))
        count = len(self._head.outputs)
        numbers, self.is_plain = scalars.numbers_of(body)
        # Through an operation that is not taken apart anything may be used.
        every = [sorted(np.ndindex(*spec.shape)) for spec in body.inputs[:count]]
        self._used = scalars.used(numbers, count) if self.is_plain else every
        self._body = _compact(body, count, self._used)
        self._on_lanes = partial(_on_lanes, self._body)
        self._pullback: Program | None = None
        self._with_adjoint = jax.custom_vjp(self._on_lanes)
        self._with_adjoint.defvjp(lambda *values: (self._on_lanes(*values), values), self._pull)

    def prepare(self, params: Any) -> tuple[Array, ...]:
        """What the steps need of the parameters, for one run; differentiable and cheap."""
        values = self._head.evaluate(jax.tree.leaves(params))
        return tuple(
            jnp.stack([value[index] for index in used])
            for value, used in zip(values, self._used, strict=True)
            if used
        )

    def __call__(self, prepared: Any, *rest: Any, adjoint: bool = False) -> Any:
        """The function on lanes; with `adjoint` its reverse derivative is one on lanes too."""
        values = (*prepared, *jax.tree.leaves(rest))
        found = (self._with_adjoint if adjoint else self._on_lanes)(*values)
        return jax.tree.unflatten(self._body.tree, found)

    def _pull(self, values: tuple[Any, ...], cotangents: Any) -> tuple[Any, ...]:
        inexact = [jnp.issubdtype(spec.dtype, jnp.inexact) for spec in self._body.inputs]
        if self._pullback is None:
            self._pullback = _pullback(self._body, inexact)
        found = scalars.evaluate(self._pullback, [*values, *cotangents])
        found = iter(found)
        return tuple(
            next(found) if flag else np.zeros(value.shape, jax.dtypes.float0)
            for flag, value in zip(inexact, values, strict=True)
        )


def _compact(body: Program, count: int, used: list[list[tuple[int, ...]]]) -> Program:
    """The body with only the numbers that are used in place of each of its first `count` inputs."""
    specs = [
        jax.ShapeDtypeStruct((len(indices),), spec.dtype)
        for spec, indices in zip(body.inputs[:count], used, strict=True)
        if indices
    ]

    def function(*values: Any) -> Any:
        given = iter(values)
        full = []
        for spec, indices in zip(body.inputs[:count], used, strict=True):
            known: Any = next(given) if indices else ()
            numbers = [jnp.zeros((), spec.dtype)] * int(np.prod(spec.shape, dtype=int))
            for at, index in enumerate(indices):
                numbers[int(np.ravel_multi_index(index, spec.shape)) if index else 0] = known[at]
            full.append(jnp.stack(numbers).reshape(spec.shape))
        return body.evaluate([*full, *given])

    return programs.trace(function, *specs, *body.inputs[count:])


def _on_lanes(body: Program, *values: Array) -> list[Array]:
    return jax.tree.leaves(scalars.evaluate(body, values))


def _pullback(body: Program, inexact: list[bool]) -> Program:
    """The program that turns values and cotangents of outputs into cotangents of inexact inputs."""
    count = len(body.inputs)

    def pull(*given: Any) -> list[Any]:
        values, cotangents = given[:count], given[count:]

        def function(*moving: Any) -> list[Any]:
            moved = iter(moving)
            full = [next(moved) if f else v for f, v in zip(inexact, values, strict=True)]
            return jax.tree.leaves(body.evaluate(full))

        moving = [v for f, v in zip(inexact, values, strict=True) if f]
        return list(jax.vjp(function, *moving)[1](list(cotangents)))

    outputs = jax.eval_shape(lambda *v: jax.tree.leaves(body.evaluate(v)), *body.inputs)
    return programs.trace(pull, *body.inputs, *outputs)


class Transition(NamedTuple):
    """The transition's mean, Jacobians and noise, and what is known of them."""

    piece: Piece
    """``(params, x, u, dt)`` to the mean, the unknown blocks of F and G, and the noise."""
    state: Pattern
    noise: Pattern
    diagonal: bool
    """Whether the noise is diagonal; then it is given as its variances."""


class Measurement(NamedTuple):
    """A sensor's residual, slope and noise, and what is known of them."""

    sensor: Sensor
    piece: Piece
    """``(params, x, u, rows)`` to the residual, the unknown block of H, and the noise."""
    slope: Pattern
    diagonal: bool

    def __call__(
        self, constants: Any, x: Any, u: Any, rows: Rows, *, adjoint: bool
    ) -> tuple[Array, Array | None, Array]:
        """Residual, unknown block of the slope, and noise of a sample on lanes.

        Of a sample that is made of like groups each of them has the groups on its first axis.
        """
        if self.sensor.alike is None:
            return self.piece(constants, x, u, rows, adjoint=adjoint)
        # One after the other: the derivative by what they share is then a sum, one term at a time.
        groups = many.apart(rows, self.sensor.copies)

        def one(_: None, group: Any) -> tuple[None, Any]:
            return None, self.piece(constants, x, u, rows._replace(**group), adjoint=adjoint)

        return lax.scan(one, None, groups)[1]


class Correction(NamedTuple):
    """How an error vector moves the mean, and how the covariance follows."""

    piece: Piece
    """``(params, x, delta, any_used)`` to the mean, the unknown block of the reset Jacobian, and how
    far, as an error vector, the model's constraint moved the mean; None without one."""
    reset: Pattern


@dataclass(frozen=True, eq=False)
class System:
    """A model made ready."""

    model: Model
    transition: Transition
    measurements: dict[str, Measurement]
    correction: Correction
    again: Any = None
    """What linearises updates again (`jaxekf.relinearise.Again`); None where once is enough."""

    def prepare(self, params: Any) -> dict[str, tuple[Array, ...]]:
        """What the steps need of the parameters, for one run."""
        found = {f"sensor {name}": m.piece.prepare(params) for name, m in self.measurements.items()}
        found["transition"] = self.transition.piece.prepare(params)
        found["correction"] = self.correction.piece.prepare(params)
        if self.again is not None:
            found["again"] = self.again.prepare(params)
        return found

    @property
    def is_gated(self) -> bool:
        """Whether any sensor has a gate."""
        return any(m.sensor.gate is not None for m in self.measurements.values())

    @property
    def is_plain(self) -> bool:
        """Whether all functions of the model are arithmetic only, so that all steps are one program."""
        pieces = [m.piece for m in self.measurements.values()]
        pieces += [self.transition.piece, self.correction.piece]
        return all(p.is_plain for p in pieces) and (self.again is None or self.again.is_plain)


def build(model: Model, params: Any, x: Any, u: Any, rows: dict[str, Any]) -> System:
    """The system of a model for one sample of everything: arrays, or their shapes and types."""
    return _build(model, *specified(params, x, u, rows))


def specified(*args: Any) -> tuple[Any, Any]:
    """Shapes and types of the leaves of the arguments, and their structure; hashable."""
    leaves, tree = jax.tree.flatten(args)
    return tuple((jnp.shape(leaf), jnp.result_type(leaf)) for leaf in leaves), tree


@lru_cache(maxsize=64)
def _build(model: Model, leaves: Any, tree: Any) -> System:
    spec = jax.tree.unflatten(tree, [jax.ShapeDtypeStruct(*leaf) for leaf in leaves])
    params, x, u, rows = spec
    measurements = {
        name: measurement(model, model.sensor(name), params, x, u, sample)
        for name, sample in rows.items()
    }
    return System(
        model, _transition(model, params, x, u), measurements, _correction(model, params, x)
    )


def cut(matrix: Array, p: Pattern) -> Array | None:
    """The unknown block of a whole matrix."""
    if not p.rows:
        return None
    return patterned.take(patterned.take(matrix, p.rows, 0), p.cols, 1)


def known(function: Callable[..., Any], *args: Any) -> Any:
    return structure.find(programs.trace(function, *args))


def is_diagonal(matrix: structure.Known) -> bool:
    return bool(np.all(matrix.is_zero() | np.eye(matrix.value.shape[0], dtype=bool)))


def _unknown_block(jacobian: Array, p: Pattern) -> Array | None:
    """Rows of the unknown block, of a Jacobian that has the block's columns only."""
    return patterned.take(jacobian, p.rows, 0) if p.rows else None


def _transition(model: Model, params: Any, x: Any, u: Any) -> Transition:
    dt = jax.ShapeDtypeStruct((), manifold.dtype_of(x))
    whole = known(partial(linearise.linearise_transition, model), params, x, u, dt)
    state, noise = patterned.pattern(whole[1]), patterned.pattern(whole[2])
    sigma = known(model.process_noise, params, dt)
    diagonal = is_diagonal(sigma)

    def step(params: Any, x: Any, u: Any, dt: Array) -> Any:
        predicted, f, g = linearise.linearise_transition(
            model, params, x, u, dt, state.cols, noise.cols
        )
        sigma = model.process_noise(params, dt)
        sigma = linalg.diagonal(sigma) if diagonal else sigma
        return predicted, _unknown_block(f, state), _unknown_block(g, noise), sigma

    return Transition(Piece(step, params, x, u, dt), state, noise, diagonal)


def measurement(
    model: Model,
    sensor: Sensor,
    params: Any,
    x: Any,
    u: Any,
    rows: Any,
    linearised: Callable[..., Any] = linearise.linearise_sensor,
) -> Measurement:
    one = sensor if sensor.alike is None else sensor.alike
    if sensor.alike is not None:
        rows = many.one_of(rows, sensor.copies)
    function = partial(linearised, model, one)
    whole = known(function, params, x, u, rows)
    slope = patterned.pattern(whole[1])
    diagonal = is_diagonal(whole[2])
    few = {"columns": slope.cols} if linearised is linearise.linearise_sensor else {}

    def sample(params: Any, x: Any, u: Any, rows: Any) -> Any:
        residual, h, noise = function(params, x, u, rows, **few)
        noise = linalg.diagonal(noise) if diagonal else noise
        return residual, _unknown_block(h, slope) if few else cut(h, slope), noise

    piece = Piece(sample, params, x, u, rows)
    return Measurement(sensor, piece, slope, diagonal)


def _correction(model: Model, params: Any, x: Any) -> Correction:
    delta = jax.ShapeDtypeStruct((model.error_dim,), manifold.dtype_of(x))
    used = jax.ShapeDtypeStruct((), jnp.bool_)
    reset = patterned.pattern(known(partial(manifold.reset_jacobian, model.space), delta))

    def move(params: Any, x: Any, delta: Array, any_used: Array) -> Any:
        moved = manifold.retract(model.space, x, delta)
        mean, shift, block = moved, None, None
        if model.project is not None:
            mean = model.project(moved)
            shift = manifold.local(model.space, moved, mean)
            shift = jnp.where(any_used, shift, 0.0)
        mean = manifold.copy_where(any_used, mean, x)
        if reset.rows:
            block = cut(manifold.reset_jacobian(model.space, delta), reset)
        return mean, block, shift

    return Correction(Piece(move, params, x, delta, used), reset)
