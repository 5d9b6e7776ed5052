"""A model made ready for the filter: its functions on lanes, and the structure of its matrices.

All of it is found from the model's functions when a program is traced; a model declares nothing.
"""

import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache, partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax

from jaxekf._support.errors import SlowModelWarning
from jaxekf.filtering import _linearisation as linearisation
from jaxekf.filtering import _repeated_groups as repeated_groups
from jaxekf.filtering._linearisation import Jacobian
from jaxekf.filtering.lowering import lanes, scalar_graph, sparsity, structured_matrix
from jaxekf.filtering.lowering.scalar_graph import Program
from jaxekf.filtering.lowering.structured_matrix import Bands, Pattern
from jaxekf.filtering.model import Model, Sensor
from jaxekf.filtering.steps import Rows
from jaxekf.geometry import manifold


class Piece:
    """A function of one run, split into what depends on the parameters only and what is done each step."""

    def __init__(self, function: Callable[..., Any], params: Any, *rest: Any) -> None:
        program = sparsity.simplified(scalar_graph.trace(function, params, *rest))
        self._head, self._body = scalar_graph.split(program, len(jax.tree.leaves(params)))
        self.unlisted = lanes.unlisted(self._body)
        """Operations of a step that are not plain arithmetic."""
        self._on_lanes = partial(_on_lanes, self._body)
        self._pullback: Program | None = None
        self._with_adjoint = jax.custom_vjp(self._on_lanes)
        self._with_adjoint.defvjp(lambda *values: (self._on_lanes(*values), values), self._pull)

    def prepare(self, params: Any) -> tuple[Array, ...]:
        """What the steps need of the parameters, for one run; differentiable and cheap."""
        return tuple(self._head.evaluate(jax.tree.leaves(params)))

    def __call__(self, prepared: Any, *rest: Any, adjoint: bool = False) -> Any:
        """The function on lanes; with `adjoint` its reverse derivative is one on lanes too."""
        values = (*prepared, *jax.tree.leaves(rest))
        found = (self._with_adjoint if adjoint else self._on_lanes)(*values)
        return jax.tree.unflatten(self._body.tree, found)

    def _pull(self, values: tuple[Any, ...], cotangents: Any) -> tuple[Any, ...]:
        inexact = [jnp.issubdtype(spec.dtype, jnp.inexact) for spec in self._body.inputs]
        if self._pullback is None:
            self._pullback = _pullback(self._body, inexact)
        found = iter(lanes.stage(lanes.evaluate(self._pullback, [*values, *cotangents])))
        return tuple(
            next(found) if flag else np.zeros(value.shape, jax.dtypes.float0)
            for flag, value in zip(inexact, values, strict=True)
        )


def _on_lanes(body: Program, *values: Array) -> list[Array]:
    return lanes.stage(jax.tree.leaves(lanes.evaluate(body, values)))


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
    return sparsity.simplified(scalar_graph.trace(pull, *body.inputs, *outputs))


class Transition(NamedTuple):
    """The transition's mean, Jacobians and noise, and what is known of them."""

    piece: Piece
    """``(params, x, u, dt)`` to the mean and the unknown bands of F and G."""
    sigma: Piece
    """``(params, dt)`` to the process noise, as a list of one."""
    state: Pattern
    noise: Pattern
    diagonal: bool
    """Whether the noise is diagonal; then it is given as its variances."""


class Measurement(NamedTuple):
    """A sensor's residual, slope and noise, and what is known of them."""

    sensor: Sensor
    piece: Piece
    """``(params, x, u, rows)`` to the residual, the unknown bands of H, and the noise."""
    slope: Pattern
    diagonal: bool

    def __call__(
        self, constants: Any, x: Any, u: Any, rows: Rows, *, adjoint: bool
    ) -> tuple[Array, Bands, Array]:
        """Residual, unknown bands of the slope, and noise of a sample on lanes.

        Of a sample that is made of like groups each of them has the groups on its first axis.
        """
        if self.sensor.alike is None:
            return self.piece(constants, x, u, rows, adjoint=adjoint)
        # One after the other: the derivative by what they share is then a sum, one term at a time.
        groups = repeated_groups.apart(rows, self.sensor.copies)

        def one(_: None, group: Any) -> tuple[None, Any]:
            return None, self.piece(constants, x, u, rows._replace(**group), adjoint=adjoint)

        return lax.scan(one, None, groups)[1]


class Correction(NamedTuple):
    """How an error vector moves the mean, and how the covariance follows."""

    piece: Piece
    """``(params, x, delta, any_used)`` to the mean, the unknown bands of the reset Jacobian, and how
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
    """What linearises updates again (`jaxekf.filtering._iterated_update.Again`); None where once is
    enough."""

    def prepare(self, params: Any) -> dict[str, tuple[Array, ...]]:
        """What the steps need of the parameters, for one run."""
        found = {f"sensor {name}": m.piece.prepare(params) for name, m in self.measurements.items()}
        found["transition"] = self.transition.piece.prepare(params)
        found["process noise"] = self.transition.sigma.prepare(params)
        found["correction"] = self.correction.piece.prepare(params)
        if self.again is not None:
            found["again"] = self.again.prepare(params)
        return found

    @property
    def is_gated(self) -> bool:
        """Whether any sensor has a gate."""
        return any(m.sensor.gate is not None for m in self.measurements.values())


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


def warn_of(model: Model, what: str, left: tuple[str, ...], piece: Piece) -> None:
    """Tell, once, which operations of a model's function make it slow."""
    if left:
        warnings.warn(
            SlowModelWarning(
                f"model '{model.name}', {what}: a quaternion of the state goes through {', '.join(left)},"
                " so that its derivative is taken by its four numbers, which is slower; use the functions"
                " of jaxekf.geometry.rotation"
            ),
            stacklevel=2,
        )
    if piece.unlisted:
        warnings.warn(
            SlowModelWarning(
                f"model '{model.name}', {what}: got the operations {', '.join(piece.unlisted)}, expected"
                " arithmetic, small products and rearrangements; each run takes them by itself, which is"
                " slower"
            ),
            stacklevel=2,
        )


def is_diagonal(matrix: sparsity.Known) -> bool:
    return bool(np.all(matrix.is_zero() | np.eye(matrix.value.shape[0], dtype=bool)))


def noise_of(function: Callable[..., Array], *spec: Any) -> tuple[Callable[..., Array], bool]:
    """A function that makes a covariance, as one of variances where it is diagonal; and whether it is."""
    diagonal = is_diagonal(sparsity.find(scalar_graph.trace(function, *spec)))
    return (partial(linearisation.variances, function) if diagonal else function), diagonal


def patterns_of(jacobians: Callable[..., Sequence[Jacobian]], *spec: Any) -> list[Pattern]:
    """The patterns of the Jacobians that a function makes."""
    dense = scalar_graph.trace(lambda *args: [one.dense() for one in jacobians(*args)], *spec)
    return [structured_matrix.pattern(one) for one in sparsity.find(dense)]


def both_jacobians(
    found: linearisation.LinearTransition | linearisation.LinearBetween,
) -> list[Jacobian]:
    """F and G of a transition."""
    return [found.f, found.g]


def _transition(model: Model, params: Any, x: Any, u: Any) -> Transition:
    dt = jax.ShapeDtypeStruct((), manifold.dtype_of(x))
    linearised = partial(linearisation.transition_blocks, model)
    spec = (params, x, u, dt)
    state, noise = patterns_of(lambda *args: both_jacobians(linearised(*args)), *spec)
    left: list[tuple[str, ...]] = []

    def step(*args: Any) -> Any:
        found = linearised(*args)
        left.append(found.left)
        return found.mean, found.f.bands(state), found.g.bands(noise)

    sigma, diagonal = noise_of(model.process_noise, params, dt)
    piece = Piece(step, *spec)
    warn_of(model, "transition", left[-1], piece)
    density = Piece(lambda *args: [sigma(*args)], params, dt)
    warn_of(model, "process_noise", (), density)
    return Transition(piece, density, state, noise, diagonal)


def measurement(
    model: Model,
    sensor: Sensor,
    params: Any,
    x: Any,
    u: Any,
    rows: Any,
    linearised: Callable[..., linearisation.LinearSample] = linearisation.sample_blocks,
) -> Measurement:
    one = sensor if sensor.alike is None else sensor.alike
    if sensor.alike is not None:
        rows = repeated_groups.one_of(rows, sensor.copies)
    function = partial(linearised, model, one)
    (slope,) = patterns_of(lambda *args: [function(*args).slope], params, x, u, rows)
    noise, diagonal = noise_of(one.noise, params, rows.aux, rows.dt)
    left: list[tuple[str, ...]] = []

    def sample(params: Any, x: Any, u: Any, rows: Any) -> Any:
        found = function(params, x, u, rows)
        left.append(found.left)
        return found.residual, found.slope.bands(slope), noise(params, rows.aux, rows.dt)

    piece = Piece(sample, params, x, u, rows)
    warn_of(model, f"sensor '{sensor.name}'", left[-1], piece)
    return Measurement(sensor, piece, slope, diagonal)


def _correction(model: Model, params: Any, x: Any) -> Correction:
    delta = jax.ShapeDtypeStruct((model.error_dim,), manifold.dtype_of(x))
    used = jax.ShapeDtypeStruct((), jnp.bool_)
    known = sparsity.find(scalar_graph.trace(partial(manifold.reset_jacobian, model.space), delta))
    reset = structured_matrix.pattern(known)

    def move(params: Any, x: Any, delta: Array, any_used: Array) -> Any:
        moved = manifold.retract(model.space, x, delta)
        mean, shift = moved, None
        if model.project is not None:
            mean = model.project(moved)
            shift = manifold.local(model.space, moved, mean)
            shift = jnp.where(any_used, shift, 0.0)
        mean = manifold.copy_where(any_used, mean, x)
        bands = structured_matrix.cut(manifold.reset_jacobian(model.space, delta), reset)
        return mean, bands, shift

    piece = Piece(move, params, x, delta, used)
    warn_of(model, "state space", (), piece)
    return Correction(piece, reset)
