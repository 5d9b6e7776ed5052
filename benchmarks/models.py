"""Models compared with the same models in textbook JAX: Jacobians by `jacfwd`, `@`, `cho_solve`.

The work is the likelihood of `RUNS` runs and its gradient with respect to all parameters, with
``keep="means"``. Operations are counted for `COUNTED` runs; those of textbook JAX do not depend on
the number of runs.
"""

import sys
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import landmarks
import numpy as np
from clock import Build, build, operations, timed
from jax import Array, lax
from textbook import correct, linearise, predict

from jaxekf import get_model, jit, robust, run_filter_batch
from jaxekf.filtering.ekf import inputs_of
from jaxekf.filtering.interpolation import InputSample
from jaxekf.filtering.model import Belief, Model, Parameters
from jaxekf.filtering.steps import Knots, Rows, Steps
from jaxekf.geometry import manifold

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))
import toy_models

RUNS, COUNTED = 64, 16
KINDS = ("forward", "gradient")
OWN, TEXTBOOK = "jaxekf", "textbook JAX"
VISUAL = "visual"
_DT = 0.01


def _markers() -> Model:
    """A test model with an accelerometer and a gyroscope, and the quality of a marker in `aux`."""
    sensors = tuple(replace(sensor, typical_aux=1.0) for sensor in toy_models.MARKERS.sensors)
    return replace(toy_models.MARKERS, sensors=sensors)


CONTENDERS: dict[str, Callable[[], Model]] = {
    **{
        name: partial(get_model, name)
        for name in ("loose", "loose_rate", "loose_pose", "tight", "triad", "marg", VISUAL)
    },
    "markers": _markers,
}
"""`tight` has three markers; `marg` 12 degrees of freedom and 9 rows; `visual` is that of `vision.py`; the
test model has 15 degrees of freedom. They have no gates, since textbook JAX has none."""
MAIN = tuple(name for name in CONTENDERS if name != "markers")
"""The models of the package."""


class Measured(NamedTuple):
    """Build time, operations and run time of one program."""

    build: Build
    operations: int
    us: float
    """Microseconds per step and run."""


class Work(NamedTuple):
    """The same work for both: functions from parameters and data to means and likelihood."""

    own: Callable[[Any, Any], tuple[Any, Array]]
    plain: Callable[[Any, Any], tuple[Any, Array]]
    params: Any
    own_data: Any
    plain_data: Any
    steps: int
    """Steps of all runs together."""


def textbook(model: Model, params: Parameters, belief: Belief, steps: Steps) -> tuple[Any, Array]:
    """One run of a model whose sensors are all sampled at every step, without gates."""
    inputs = inputs_of(model, params, steps)

    def step(belief: Belief, given: Any) -> Any:
        u, dt, samples = given
        ahead = predict(model, params, belief, u, dt)
        h, e, r = linearise(model, params, ahead.mean, u, samples)
        found, gained = correct(model, ahead, h, e, r, len(e))
        return found, (found.mean, gained)

    given = jax.tree.map(lambda a: a[:, 0], (inputs, steps.dt, steps.fast))
    _, (means, gained) = lax.scan(step, belief, given)
    return means, jnp.sum(gained)


def _knots(model: Model, runs: int, count: int, time: np.ndarray) -> Knots | None:
    """Plausible input at each step; None for a model without one."""
    if model.input is None:
        return None
    channels = 6 if model.input.name == "imu" else 3
    values = 0.1 * np.random.default_rng(2).normal(size=(runs, count, channels))
    if channels == 6:
        values[..., 2 if model.name == "markers" else 5] += 9.81
    areas = _DT * (values[:, 1:] + values[:, :-1]) / 2
    integral = np.concatenate([np.zeros((runs, 1, channels)), np.cumsum(areas, axis=1)], axis=1)
    return Knots(time[..., 0], values, integral)


def _steps(model: Model, runs: int, count: int) -> Steps:
    """Plausible input and samples near the start; their values have no effect on the work."""
    shape = (runs, count, 1)
    time = np.broadcast_to(_DT * np.arange(count)[:, None], shape)
    dt = np.full(shape, _DT)
    dt[:, 0] = 0.0
    knots = _knots(model, runs, count, time)
    u = None
    if knots is not None:
        u = InputSample(knots.value[0, 0], knots.value[0, 0], 1.0)
    x = model.initial_mean({})
    params = _arrays(model.parameters)
    rng = np.random.default_rng(3)
    fast = {}
    for sensor in model.sensors:
        like = sensor.typical_aux
        expected = sensor.predict(x, u, params, like)
        noise = jnp.asarray(1e-4 * rng.normal(size=(*shape, sensor.rows)))
        put = jax.jit(jax.vmap(partial(manifold.retract, sensor.space, expected)))
        value = jax.tree.map(
            lambda a: np.asarray(a).reshape(*shape, *a.shape[1:]),
            put(noise.reshape(-1, sensor.rows)),
        )
        aux = jax.tree.map(lambda a: np.broadcast_to(a, (*shape, *np.shape(a))), like)
        mask = np.ones((*shape, sensor.rows), bool)
        fast[sensor.name] = Rows(value, aux, mask, np.full(shape, _DT))
    return Steps(time, dt, np.ones(shape, bool), knots, fast, {})


def _arrays(tree: Any) -> Any:
    return jax.tree.map(lambda a: jnp.asarray(a, float), tree)


def _repeated(tree: Any, runs: int) -> Any:
    return jax.tree.map(lambda a: jnp.broadcast_to(a, (runs, *jnp.shape(a))), tree)


def work(name: str, runs: int, count: int) -> Work:
    """The work of `runs` runs of a model, each of about `count` steps."""
    if name == VISUAL:
        # Its IMU has 100 Hz.
        one = landmarks.prepare(landmarks.recorded(count * _DT))
        model, params, belief = one.plain, one.params, one.belief
        steps = _repeated(one.steps, runs)
        plain_data, axes = landmarks.of_many(one.flat, runs)
        filtered = landmarks.textbook
        total = runs * int(np.sum(one.steps.valid))
    else:
        model = robust(CONTENDERS[name](), "none")
        params = _arrays(model.parameters)
        belief = Belief(model.initial_mean({}), model.initial_covariance(params))
        steps = plain_data = jax.tree.map(jnp.asarray, _steps(model, runs, count))
        filtered, axes = textbook, 0
        total = runs * count
    devices = jax.devices() if runs >= RUNS and len(jax.devices()) > 1 else ()

    def own(params: Any, steps: Any) -> Any:
        every = _repeated((params, belief), runs)
        output = run_filter_batch(model, *every, steps, keep="means", devices=devices)
        means = jax.tree.leaves(output.instants.updated.mean)
        return means, jnp.sum(output.instants.log_likelihood)

    def plain(params: Any, steps: Any) -> Any:
        means, gained = jax.vmap(partial(filtered, model, params, belief), (axes,))(steps)
        return jax.tree.leaves(means), jnp.sum(gained)

    return Work(own, plain, params, steps, plain_data, total)


def programs(made: Work, kinds: Sequence[str]) -> Iterator[tuple[str, str, Any, Any]]:
    """Kind, implementation, jitted function and data of each program of some work."""
    for kind in kinds:
        for whose, function, data in (
            (OWN, made.own, made.own_data),
            (TEXTBOOK, made.plain, made.plain_data),
        ):
            compiled = jit if whose == OWN else jax.jit
            if kind == "forward":
                yield kind, whose, compiled(function), data
            else:
                slope = jax.value_and_grad(lambda p, s, f=function: f(p, s)[1])
                yield kind, whose, compiled(slope), data


def race(
    names: Sequence[str],
    seconds: float,
    count: int,
    *,
    runs: int = RUNS,
    kinds: Sequence[str] = KINDS,
    report: Callable[[str], None] = lambda text: None,
) -> dict[str, dict[str, dict[str, Measured]]]:
    """Time both implementations of each model, by name, kind and implementation; they must agree."""
    found: dict[str, dict[str, dict[str, Measured]]] = {}
    for name in names:
        made, counted = work(name, runs, count), work(name, COUNTED, count)
        for (kind, whose, function, data), (*_, small, few) in zip(
            programs(made, kinds), programs(counted, kinds), strict=True
        ):
            report(f"{name}, {kind}, {whose}")
            built = build(function, made.params, data)
            time = timed(built.program, made.params, data, seconds=seconds)
            value = float(time.result[1] if kind == "forward" else time.result[0])
            number = built.operations
            if whose == OWN:
                number = operations(small, counted.params, few)
            of_kind = found.setdefault(name, {}).setdefault(kind, {})
            us = time.median_s / made.steps * 1e6
            of_kind[whose] = Measured(built._replace(program=None), number, us)
            if whose == OWN:
                expected = value
            np.testing.assert_allclose(value, expected, rtol=1e-8, err_msg=f"{name}, {kind}")
    return found
