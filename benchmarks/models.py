"""Other models against the same models in plain textbook JAX: Jacobians by `jacfwd`, `@`, `cho_solve`."""

import sys
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from clock import timed
from jax import Array, lax
from textbook import correct, linearise, predict

from jaxekf import jit, manifold, robust, run_filter_batch
from jaxekf.ekf import inputs_of
from jaxekf.interpolation import InputSample
from jaxekf.model import Belief, Model, Parameters
from jaxekf.models import loose, marg, triad
from jaxekf.timeline import Knots, Rows, Steps

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))
import toy_models

_RUNS, _STEPS, _DT = 64, 500, 0.01


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


def _steps(model: Model, runs: int) -> Steps:
    """Plausible input and samples near the start; what they say does not change the work."""
    rng = np.random.default_rng(2)
    time = np.broadcast_to(_DT * np.arange(_STEPS)[:, None], (runs, _STEPS, 1))
    dt = np.full((runs, _STEPS, 1), _DT)
    dt[:, 0] = 0.0
    channels = 3 if model.name in ("loose", "triad") else 6
    values = 0.1 * rng.normal(size=(runs, _STEPS, channels))
    if channels == 6:
        # The toy's accelerometer stands before its gyroscope.
        values[..., 2 if model is toy_models.MARKERS else 5] += 9.81
    integral = np.concatenate(
        [np.zeros((runs, 1, channels)), np.cumsum(_DT * (values[:, 1:] + values[:, :-1]) / 2, 1)], 1
    )
    shape = (runs, _STEPS, 1)
    x, u = model.initial_mean({}), InputSample(values[0, 0], values[0, 0], 1.0)
    fast = {}
    for sensor in model.sensors:
        like = 1.0 if model is toy_models.MARKERS else sensor.aux_like
        params = jax.tree.map(lambda a: jnp.asarray(a, float), model.parameters)
        said = sensor.predict(x, u, params, like)
        noise = jnp.asarray(1e-4 * rng.normal(size=(*shape, sensor.rows)))
        put = jax.vmap(partial(manifold.retract, sensor.space, said))
        value = np.asarray(put(noise.reshape(-1, sensor.rows))).reshape(*shape, -1)
        aux = jax.tree.map(lambda a: np.broadcast_to(a, (*shape, *np.shape(a))), like)
        mask = np.ones((*shape, sensor.rows), bool)
        fast[sensor.name] = Rows(value, aux, mask, np.full(shape, _DT))
    knots = Knots(time[..., 0], values, integral)
    return Steps(time, dt, np.ones((runs, _STEPS, 1), bool), knots, fast, {})


CONTENDERS = {
    "loose": loose.MODEL,
    "tight": robust("tight", "none"),
    "triad": triad.MODEL,
    "marg": marg.MODEL,
    "markers": robust(toy_models.MARKERS, "none"),
}
"""Three markers in `tight`; 12 degrees of freedom and 9 rows in `marg`; a toy of 15 degrees of freedom."""


def race(seconds: float, names: Sequence[str] = tuple(CONTENDERS)) -> dict[str, dict[str, float]]:
    """Microseconds per step and run of both, forward and value with gradient to all parameters."""
    found = {}
    for name in names:
        model = CONTENDERS[name]
        params = jax.tree.map(lambda a: jnp.asarray(a, float), model.parameters)
        steps = jax.tree.map(jnp.asarray, _steps(model, _RUNS))
        x = model.initial_mean({})
        belief = Belief(x, model.initial_covariance(params))

        def own(params: Any, steps: Any, model: Model = model, belief: Belief = belief) -> Any:
            every = jax.tree.map(
                lambda a: jnp.broadcast_to(a, (_RUNS, *jnp.shape(a))), (params, belief)
            )
            devices = jax.devices() if len(jax.devices()) > 1 else ()
            output = run_filter_batch(model, *every, steps, keep="means", devices=devices)
            return jax.tree.leaves(output.instants.updated.mean), jnp.sum(
                output.instants.log_likelihood
            )

        def plain(params: Any, steps: Any, model: Model = model, belief: Belief = belief) -> Any:
            one = partial(textbook, model, params, belief)
            means, gained = jax.vmap(one)(steps)
            return jax.tree.leaves(means), jnp.sum(gained)

        np.testing.assert_allclose(
            jit(own)(params, steps)[1], jax.jit(plain)(params, steps)[1], rtol=1e-8
        )
        found[f"{name}, forward"] = _both(own, plain, (params, steps), seconds)
        slopes = [jax.value_and_grad(lambda p, s, f=f: f(p, s)[1]) for f in (own, plain)]
        found[f"{name}, gradient"] = _both(*slopes, (params, steps), seconds)
    return found


def _both(
    own: Callable[..., Any], plain: Callable[..., Any], args: tuple[Any, ...], seconds: float
) -> dict[str, float]:
    """Microseconds per step and run of both."""
    times = {}
    for name, function in (("jaxekf", jit(own)), ("textbook JAX", jax.jit(plain))):
        times[name] = timed(function, *args, seconds=seconds)[1] / (_RUNS * _STEPS) * 1e6
    return times
