"""The steps of an extended Kalman filter as in a textbook, in plain JAX: `jacfwd`, `@`, `cho_solve`.

They use the package's models, but none of its filter.
"""

from typing import Any

import jax
import jax.numpy as jnp
from jax import Array

from jaxekf.filtering.model import Belief, Model, Parameters
from jaxekf.filtering.steps import Rows
from jaxekf.geometry import manifold


def predict(model: Model, params: Parameters, belief: Belief, u: Any, dt: Array) -> Belief:
    """The predicted belief after a step."""
    x, p = belief
    q = model.process_noise(params, dt)
    still = jnp.zeros(q.shape[0])
    ahead = model.transition(x, u, dt, still, params)

    def moved(delta: Array, w: Array) -> Array:
        y = model.transition(manifold.retract(model.space, x, delta), u, dt, w, params)
        return manifold.local(model.space, ahead, y)

    f, g = jax.jacfwd(moved, (0, 1))(jnp.zeros(model.error_dim), still)
    return Belief(ahead, f @ p @ f.T + g @ q @ g.T)


def linearise(
    model: Model, params: Parameters, x: Any, u: Any, samples: dict[str, Rows]
) -> tuple[Array, Array, Array]:
    """Jacobian, innovations and noise of all rows of all samples of an instant, also the masked ones."""
    slopes, errors, noises = [], [], []
    for name, rows in samples.items():
        sensor = model.sensor(name)
        expected = sensor.predict(x, u, params, rows.aux)

        def seen(
            delta: Array, sensor: Any = sensor, rows: Any = rows, expected: Any = expected
        ) -> Any:
            y = manifold.retract(model.space, x, delta)
            return manifold.local(sensor.space, expected, sensor.predict(y, u, params, rows.aux))

        slopes.append(jax.jacfwd(seen)(jnp.zeros(model.error_dim)))
        errors.append(manifold.local(sensor.space, expected, rows.value))
        noises.append(sensor.noise(params, rows.aux, rows.dt))
    return jnp.concatenate(slopes), jnp.concatenate(errors), jax.scipy.linalg.block_diag(*noises)


def correct(
    model: Model, belief: Belief, h: Array, e: Array, r: Array, count: Any
) -> tuple[Belief, Array]:
    """The updated belief in Joseph's form, and the log-likelihood of its `count` unmasked rows."""
    x, p = belief
    s = h @ p @ h.T + r
    factor = jax.scipy.linalg.cho_factor(s, lower=True)
    gain = jax.scipy.linalg.cho_solve(factor, h @ p).T
    fit = e @ jax.scipy.linalg.cho_solve(factor, e)
    logdet = 2.0 * jnp.sum(jnp.log(jnp.diag(factor[0])))
    gained = -0.5 * (fit + logdet + count * jnp.log(2 * jnp.pi))
    delta = gain @ e
    a = jnp.eye(model.error_dim) - gain @ h
    p = a @ p @ a.T + gain @ r @ gain.T
    reset = manifold.reset_jacobian(model.space, delta)
    p = reset @ p @ reset.T
    return Belief(manifold.retract(model.space, x, delta), 0.5 * (p + p.T)), gained
