"""The problem that all filters of the benchmark solve: ten states, seven measurements, 2,000 steps.

It is Cheng's model without normalisation of the quaternion, which other packages do not support: rotation
by the rate, random walks, and additive errors. The constants are those of the two C++ programs.
"""

from dataclasses import replace
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

from jaxekf.filtering.model import Belief, Model, Parameters
from jaxekf.filtering.steps import Rows, Steps
from jaxekf.models import loose_additive

DT = 0.016
STEPS = 2000
MEAN = np.array([1.0] + [0.0] * 9)
VARIANCE = np.array([1e-4] * 4 + [0.1] * 3 + [0.01] * 3)
PROCESS = np.array([1e-8] * 4 + [1e-6] * 3 + [1e-10] * 3)
MEASUREMENT = np.array([4e-6] * 4 + [2.7e-5] * 3)

MODEL: Model = replace(loose_additive.MODEL, name="race", project=None)


class Noise(NamedTuple):
    """The variances of Q and R, with respect to which the gradient is taken."""

    process: Any
    measurement: Any


NOISE = Noise(PROCESS, MEASUREMENT)


def measurements(runs: int, steps: int = STEPS) -> np.ndarray:
    """Quaternion and rate of a rotation at a constant rate, with noise, (runs, steps, 7)."""
    rng = np.random.default_rng(1)
    angle = -np.deg2rad(9.0) * DT * np.arange(steps) / 2
    clean = np.zeros((steps, 7))
    clean[:, 0], clean[:, 1] = np.cos(angle), np.sin(angle)
    clean[:, 4:] = [-np.deg2rad(9.0) + 0.008, -0.005, 0.003]
    return clean + 1e-3 * (rng.random((runs, steps, 7)) - 0.5)


def parameters(noise: Noise) -> Parameters:
    """The variances as parameters of the model."""
    density = jnp.sqrt(jnp.asarray(noise.process) / DT)
    sigma = jnp.sqrt(jnp.asarray(noise.measurement))
    own = loose_additive.Noise(density[:4], density[4:7], density[7:], sigma[:4], sigma[4:])
    return Parameters(own, MODEL.parameters.calibration, MODEL.parameters.initial)


def steps(z: np.ndarray) -> Steps:
    """Measurements (runs, steps, 7) as steps of the filter; the first step has ``dt = 0``."""
    runs, count, _ = z.shape
    time = np.broadcast_to(DT * np.arange(count)[:, None], (runs, count, 1))
    dt = np.full((runs, count, 1), DT)
    dt[:, 0] = 0.0

    def rows(part: slice) -> Rows:
        value = z[:, :, None, part]
        return Rows(value, None, np.ones(value.shape, bool), np.full((runs, count, 1), DT))

    fast = {"optical": rows(np.s_[:4]), "gyroscope": rows(np.s_[4:])}
    return Steps(time, dt, np.ones((runs, count, 1), bool), None, fast, {})


def start(runs: int) -> Belief:
    """The initial belief of every run."""
    state = loose_additive.State(MEAN[:4], MEAN[4:7], MEAN[7:])
    belief = Belief(state, np.diag(VARIANCE))

    def repeat(a: Any) -> Any:
        return np.broadcast_to(a, (runs, *np.shape(a)))

    return Belief(type(state)(*map(repeat, belief.mean)), repeat(belief.cov))


def turn(x: Any, dt: Any) -> Any:
    """The transition in plain JAX, for the other packages: ``exp(rate dt) q``."""
    q, rate = x[:4], x[4:7]
    square = rate @ rate * dt**2 + 1e-30
    angle = jnp.sqrt(square)
    c, s = jnp.cos(angle / 2), jnp.sin(angle / 2) / angle * dt
    p = jnp.concatenate([c[None], s * rate])
    turned = jnp.array(
        [
            p[0] * q[0] - p[1] * q[1] - p[2] * q[2] - p[3] * q[3],
            p[0] * q[1] + p[1] * q[0] + p[2] * q[3] - p[3] * q[2],
            p[0] * q[2] - p[1] * q[3] + p[2] * q[0] + p[3] * q[1],
            p[0] * q[3] + p[1] * q[2] - p[2] * q[1] + p[3] * q[0],
        ]
    )
    return jnp.concatenate([turned, x[4:]])


def observe(x: Any) -> Any:
    """The measurement in plain JAX: quaternion, and rate plus bias."""
    return jnp.concatenate([x[:4], x[4:7] + x[7:]])
