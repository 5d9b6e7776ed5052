"""A model compiled for the filter: its functions on the batch axis, the sparsity of its matrices.

`build` traces a model's functions and finds the sparsity of its Jacobians and covariances; a model
declares nothing. Inside a scan `LoweredModel.bind` gives a `BoundModel`, whose methods evaluate the
functions for a batch of runs, the last axis of every array being the batch axis (lanes).

A `Linearisation` chooses the point of linearisation. The filter linearises at its own estimates
(`AT_ESTIMATE`); the iterated smoother and the iterated update linearise everything about one given
path (`ABOUT_PATH`), and need the derivatives of the residuals themselves.
"""

import warnings
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property, lru_cache, partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax

from jaxekf._support.errors import SlowModelWarning
from jaxekf.filtering import _linearisation as linearisation
from jaxekf.filtering import _repeated_groups as repeated_groups
from jaxekf.filtering._belief_reset import ResetGroup, find_groups
from jaxekf.filtering._linearisation import Jacobian
from jaxekf.filtering.lowering import scalar_graph, sparsity, structured_matrix
from jaxekf.filtering.lowering.lowered_function import LoweredFunction
from jaxekf.filtering.lowering.structured_matrix import Bands, Pattern
from jaxekf.filtering.model import Model, Sensor
from jaxekf.filtering.steps import Rows
from jaxekf.geometry import manifold


class Linearisation(NamedTuple):
    """The point about which transitions and sensors are linearised, and how the state is corrected."""

    transition: Callable[..., linearisation.LinearTransition]
    sensor: Callable[..., linearisation.LinearSensor]
    is_about_path: bool
    """Whether transitions get the state and the process noise at their end as further arguments."""


AT_ESTIMATE = Linearisation(
    linearisation.transition_at_estimate, linearisation.sensor_at_estimate, is_about_path=False
)
ABOUT_PATH = Linearisation(
    linearisation.transition_about_path, linearisation.sensor_about_path, is_about_path=True
)


class LoweredTransition(NamedTuple):
    """The transition, its Jacobians F and G and its process noise."""

    function: LoweredFunction
    """``(params, x, u, dt)`` to the predicted mean and the bands of F and G; about a path
    ``(params, x, after, w, u, dt)`` to the defect and the same bands."""
    process_noise: LoweredFunction
    """``(params, dt)`` to the covariance of the process noise, as a list of one."""
    f_pattern: Pattern
    g_pattern: Pattern
    has_diagonal_noise: bool
    """Whether the process noise is diagonal; then it is given as its variances."""


class LoweredSensor(NamedTuple):
    """A sensor's residual, its Jacobian H and its noise R."""

    sensor: Sensor
    function: LoweredFunction
    """``(params, x, u, rows)`` to the residual, the bands of H, and R."""
    pattern: Pattern
    """Sparsity of H."""
    has_diagonal_noise: bool
    """Whether R is diagonal; then it is given as its variances."""


@dataclass(frozen=True, eq=False)
class LoweredModel:
    """A model's functions on the batch axis. Build with `build`, use through `bind`."""

    model: Model
    transition: LoweredTransition
    sensors: dict[str, LoweredSensor]
    corrections: dict[str, LoweredFunction]
    """How an error vector moves the mean: "correction" at an estimate, "prior" and "retraction" about a
    path; see the methods of `BoundModel` with these names."""
    reset_pattern: Pattern
    """Sparsity of the reset Jacobian (section 4 of docs/mathematics.md)."""
    iterated_update: Any = None
    """`jaxekf.filtering._iterated_update.IteratedUpdate`, which linearises updates again; None where every
    update is linearised once."""

    def prepare(self, params: Any) -> dict[str, Any]:
        """Everything of the steps that depends on the parameters only, for one run."""
        functions = {f"sensor {name}": sensor.function for name, sensor in self.sensors.items()}
        functions["transition"] = self.transition.function
        functions["process noise"] = self.transition.process_noise
        functions |= self.corrections
        found: dict[str, Any] = {name: f.prepare(params) for name, f in functions.items()}
        if self.iterated_update is not None:
            found["iterated update"] = self.iterated_update.lowered.prepare(params)
        if self.reset_groups:
            cov = self.model.initial_covariance(params)
            found["initial variance"] = lax.stop_gradient(jnp.diagonal(cov))
        return found

    def bind(self, prepared: dict[str, Any], *, adjoint: bool) -> "BoundModel":
        """The model with what `prepare` returned, runs on the last axis.

        With `adjoint` reverse derivatives are those of the closed forms (docs/mathematics.md, sections 2
        and 3) and of `LoweredFunction`; without, every derivative is JAX's own.
        """
        return BoundModel(self, prepared, adjoint)

    @cached_property
    def reset_groups(self) -> tuple[ResetGroup, ...]:
        """Groups of the sensors with gates or weights; empty if the model is never reset."""
        if not self.model.gate_reset_after_s < np.inf:
            return ()
        robust = {
            name: lowered
            for name, lowered in self.sensors.items()
            if lowered.sensor.gate is not None or lowered.sensor.weighting is not None
        }
        patterns = {name: lowered.pattern for name, lowered in robust.items()}
        gated = {name: lowered.sensor.gate is not None for name, lowered in robust.items()}
        return find_groups(patterns, gated)


@dataclass(frozen=True, eq=False)
class BoundModel:
    """A lowered model with the parameters of a batch of runs; every array carries the lanes last."""

    lowered: LoweredModel
    prepared: dict[str, Any]
    adjoint: bool
    """Whether reverse derivatives are the closed forms."""

    def _call(self, name: str, function: LoweredFunction, *args: Any) -> Any:
        return function(self.prepared[name], *args, adjoint=self.adjoint)

    def transition(self, *args: Any) -> tuple[Any, Bands, Bands]:
        """Predicted mean (at an estimate) or defect (about a path), and the bands of F and G."""
        return self._call("transition", self.lowered.transition.function, *args)

    def process_noise(self, dt: Array) -> Array:
        """Covariance (n_w, n_w, lanes) of the process noise, or its variances (n_w, lanes) if diagonal."""
        (found,) = self._call("process noise", self.lowered.transition.process_noise, dt)
        return found

    def sensor(self, name: str, x: Any, u: Any, rows: Rows) -> tuple[Array, Bands, Array]:
        """Residual (m, lanes), bands of H, and noise R of a sample.

        The results of a sensor with repeated groups have the groups on a further, first axis.
        """
        sensor, function = self.lowered.sensors[name][:2]
        call = partial(self._call, f"sensor {name}", function, x, u)
        if sensor.single_group is None:
            return call(rows)
        # A scan over the groups: cotangents of their shared inputs are then summed one term at a time.
        groups = repeated_groups.split_groups(rows, sensor.copies)

        def one(_: None, group: Any) -> tuple[None, Any]:
            return None, call(rows._replace(**group))

        return lax.scan(one, None, groups)[1]

    def correction(self, x: Any, delta: Array, used: Array) -> tuple[Any, Bands, Array | None]:
        """The mean moved by the error vector `delta` (n, lanes) where `used` (lanes,).

        Returns the mean, the bands of the reset Jacobian, and the error vector by which the model's
        constraint (`Model.project`) moved the mean; None for a model without constraint.
        """
        return self._call("correction", self.lowered.corrections["correction"], x, delta, used)

    def prior(self, first: Any, x: Any) -> tuple[Array, Array]:
        """The error vector of `x` in the chart of `first`, and a Jacobian (n, n, lanes) that maps errors at
        `first` to errors at `x`."""
        return self._call("prior", self.lowered.corrections["prior"], first, x)

    def retraction(self, x: Any, delta: Array) -> tuple[Any, Array]:
        """`x` moved by `delta` (n, lanes), and the reset Jacobian (n, n, lanes)."""
        return self._call("retraction", self.lowered.corrections["retraction"], x, delta)

    def iterated_update(self) -> "BoundModel":
        """The model of the iterated update, linearised about a path."""
        lowered = self.lowered.iterated_update.lowered
        return BoundModel(lowered, self.prepared["iterated update"], self.adjoint)


def build(
    model: Model,
    params: Any,
    x: Any,
    u: Any,
    rows: dict[str, Any],
    linearise: Linearisation = AT_ESTIMATE,
) -> LoweredModel:
    """The lowered model for one sample of everything: arrays, or their shapes and types.

    The same object for the same arguments. Warns with `SlowModelWarning` of functions that need more than
    plain arithmetic.
    """
    leaves, tree = jax.tree.flatten((params, x, u, rows))
    spec = tuple((jnp.shape(leaf), jnp.result_type(leaf)) for leaf in leaves)
    return _build(model, linearise, spec, tree)


@lru_cache(maxsize=128)
def _build(model: Model, linearise: Linearisation, leaves: Any, tree: Any) -> LoweredModel:
    spec = jax.tree.unflatten(tree, [jax.ShapeDtypeStruct(*leaf) for leaf in leaves])
    params, x, u, rows = spec
    sensors = {
        name: _lower_sensor(model, model.sensor(name), linearise, params, x, u, sample)
        for name, sample in rows.items()
    }
    transition = _lower_transition(model, linearise, params, x, u)
    lower_corrections = _path_corrections if linearise.is_about_path else _estimate_correction
    return LoweredModel(model, transition, sensors, *lower_corrections(model, params, x))


def _lower_transition(
    model: Model, linearise: Linearisation, params: Any, x: Any, u: Any
) -> LoweredTransition:
    dt = jax.ShapeDtypeStruct((), manifold.dtype_of(x))
    linearised = partial(linearise.transition, model)
    spec = (params, x, u, dt)
    if linearise.is_about_path:
        w = jax.ShapeDtypeStruct(
            jax.eval_shape(model.process_noise, params, dt).shape[:1], dt.dtype
        )
        spec = (params, x, x, w, u, dt)
    f_pattern, g_pattern = _find_patterns(lambda *args: linearised(*args)[1:3], *spec)
    fallbacks: list[tuple[str, ...]] = []

    def step(*args: Any) -> Any:
        found = linearised(*args)
        fallbacks.append(found.fallbacks)
        return found.end, found.f.bands(f_pattern), found.g.bands(g_pattern)

    noise, is_diagonal = _noise_function(model.process_noise, params, dt)
    function = LoweredFunction(step, *spec)
    process_noise = LoweredFunction(lambda *args: [noise(*args)], params, dt)
    if not linearise.is_about_path:
        _warn_if_slow(model, "transition", fallbacks[-1], function)
        _warn_if_slow(model, "process_noise", (), process_noise)
    return LoweredTransition(function, process_noise, f_pattern, g_pattern, is_diagonal)


def _lower_sensor(
    model: Model, sensor: Sensor, linearise: Linearisation, params: Any, x: Any, u: Any, rows: Any
) -> LoweredSensor:
    single = sensor if sensor.single_group is None else sensor.single_group
    if sensor.single_group is not None:
        rows = repeated_groups.single_group_spec(rows, sensor.copies)
    linearised = partial(linearise.sensor, model, single)
    (pattern,) = _find_patterns(lambda *args: [linearised(*args).jacobian], params, x, u, rows)
    noise, is_diagonal = _noise_function(single.noise, params, rows.aux, rows.dt)
    fallbacks: list[tuple[str, ...]] = []

    def sample(params: Any, x: Any, u: Any, rows: Any) -> Any:
        found = linearised(params, x, u, rows)
        fallbacks.append(found.fallbacks)
        return found.residual, found.jacobian.bands(pattern), noise(params, rows.aux, rows.dt)

    function = LoweredFunction(sample, params, x, u, rows)
    _warn_if_slow(model, f"sensor '{sensor.name}'", fallbacks[-1], function)
    return LoweredSensor(sensor, function, pattern, is_diagonal)


Corrections = tuple[dict[str, LoweredFunction], Pattern]


def _estimate_correction(model: Model, params: Any, x: Any) -> Corrections:
    delta = jax.ShapeDtypeStruct((model.error_dim,), manifold.dtype_of(x))
    used = jax.ShapeDtypeStruct((), jnp.bool_)
    reset = _reset_pattern(model, delta)

    def correct(params: Any, x: Any, delta: Array, any_used: Array) -> Any:
        moved = manifold.retract(model.space, x, delta)
        mean, shift = moved, None
        if model.project is not None:
            mean = model.project(moved)
            shift = manifold.local(model.space, moved, mean)
            shift = jnp.where(any_used, shift, 0.0)
        mean = manifold.copy_where(any_used, mean, x)
        jacobian = manifold.reset_jacobian(model.space, delta)
        return mean, structured_matrix.extract_bands(jacobian, reset), shift

    function = LoweredFunction(correct, params, x, delta, used)
    _warn_if_slow(model, "state space", (), function)
    return {"correction": function}, reset


def _path_corrections(model: Model, params: Any, x: Any) -> Corrections:
    delta = jax.ShapeDtypeStruct((model.error_dim,), manifold.dtype_of(x))

    def prior(params: Any, first: Any, x: Any) -> Any:
        error = manifold.local(model.space, first, x)
        return error, manifold.reset_jacobian(model.space, error)

    def retraction(params: Any, x: Any, delta: Array) -> Any:
        moved = manifold.retract(model.space, x, delta)
        if model.project is not None:
            moved = model.project(moved)
        return moved, manifold.reset_jacobian(model.space, delta)

    functions = {
        "prior": LoweredFunction(prior, params, x, x),
        "retraction": LoweredFunction(retraction, params, x, delta),
    }
    return functions, _reset_pattern(model, delta)


def _reset_pattern(model: Model, delta: Any) -> Pattern:
    traced = scalar_graph.trace(partial(manifold.reset_jacobian, model.space), delta)
    return structured_matrix.find_pattern(sparsity.known_entries(traced))


def _find_patterns(jacobians: Callable[..., Any], *spec: Any) -> list[Pattern]:
    """The sparsity patterns of the Jacobians that a function makes."""

    def dense(*args: Any) -> list[Array]:
        found: list[Jacobian] = list(jacobians(*args))
        return [one.dense() for one in found]

    known = sparsity.known_entries(scalar_graph.trace(dense, *spec))
    return [structured_matrix.find_pattern(one) for one in known]


def _noise_function(
    function: Callable[..., Array], *spec: Any
) -> tuple[Callable[..., Array], bool]:
    """A covariance function, returning only the variances where it is diagonal; and whether it is."""
    known = sparsity.known_entries(scalar_graph.trace(function, *spec))
    diagonal = np.all(known.is_zero() | np.eye(known.value.shape[0], dtype=bool))
    return (partial(linearisation.variances, function), True) if diagonal else (function, False)


def _warn_if_slow(
    model: Model, source: str, fallbacks: tuple[str, ...], function: LoweredFunction
) -> None:
    """Warn of the operations that make a function of the model slow."""
    if fallbacks:
        warnings.warn(
            SlowModelWarning(
                f"model '{model.name}', {source}: a quaternion of the state goes through"
                f" {', '.join(fallbacks)}, so that its derivative is taken by its four numbers, which is"
                " slower; use the functions of jaxekf.geometry.rotation"
            ),
            stacklevel=2,
        )
    if function.unsupported:
        warnings.warn(
            SlowModelWarning(
                f"model '{model.name}', {source}: got the operations {', '.join(function.unsupported)},"
                " expected arithmetic, small products and rearrangements; each run takes them by itself,"
                " which is slower"
            ),
            stacklevel=2,
        )
