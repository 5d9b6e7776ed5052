"""How large the programs are, and that no built-in model falls out of plain arithmetic."""

import warnings

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxekf import robust
from jaxekf._support.errors import SlowModelWarning
from jaxekf.filtering import ekf
from jaxekf.filtering.interpolation import InputSample
from jaxekf.filtering.model import Belief, Model, Parameters, Sensor
from jaxekf.filtering.steps import Knots, Rows, Steps
from jaxekf.geometry import rotation
from jaxekf.geometry.manifold import SO3

RUNS, EPOCHS = 16, 32
LIMITS = {"loose": 8_000, "tight": 15_000, "marg": 18_000, "visual": 25_000}
WATCHFUL = 1.2
"""Largest size of a program with gates and resets, relative to one without."""


def problem(name, epochs):
    """A model without gates and resets, and samples at every step; images at every fourth."""
    model = robust(name, "none")
    substeps = 4 if name == "visual" else 1
    params = jax.tree.map(lambda a: jnp.asarray(a, float), model.parameters)
    x = model.initial_mean({})
    time = 0.01 * (1.0 + np.arange(epochs * substeps)).reshape(epochs, substeps)
    knots, u = None, None
    if model.input is not None:
        count = 6 if model.input.name == "imu" else 3
        at = np.arange(epochs * substeps + 1) * 0.01
        rate = np.full((len(at), count), 0.1)
        knots = Knots(time=at, value=rate, integral=at[:, None] * rate)
        u = InputSample(rate[0], rate[0], np.array(100.0))
    fast, slow = {}, {}
    for sensor in model.sensors:
        shape = (epochs,) if sensor.single_group is not None else (epochs, substeps)

        def every(leaf, shape=shape):
            return np.broadcast_to(leaf, (*shape, *np.shape(leaf))).astype(float)

        aux = None if sensor.typical_aux is None else sensor.typical_aux
        value = sensor.predict(x, u, params, aux)
        value, aux = jax.tree.map(every, (value, aux))
        rows = Rows(value, aux, np.ones((*shape, sensor.rows), bool), np.full(shape, 0.01))
        (slow if sensor.single_group is not None else fast)[sensor.name] = rows
    steps = Steps(time, np.full(time.shape, 0.01), np.ones(time.shape, bool), knots, fast, slow)
    belief = Belief(x, model.initial_covariance(params))
    return model, params, belief, jax.tree.map(jnp.asarray, steps)


def lowered_gradient(model, params, belief, steps):
    """The gradient of the likelihood of many runs to all parameters, lowered."""

    def spread(tree):
        return jax.tree.map(lambda a: jnp.broadcast_to(a, (RUNS, *jnp.shape(a))), tree)

    def value(params):
        output = ekf.run_filter_batch(model, *spread((params, belief, steps)), keep="means")
        return jnp.sum(output.instants.log_likelihood)

    return jax.jit(jax.grad(value)).lower(params)


@pytest.mark.parametrize("name", LIMITS)
def test_gradients_are_small_programs(name):
    """A change that takes derivatives through single numbers or a quaternion's four, or another copy
    of the step: minutes of compiling."""
    model, params, belief, steps = problem(name, EPOCHS)
    assert count(lowered_gradient(model, params, belief, steps)) <= LIMITS[name]


@pytest.mark.parametrize("method", ["gate", "huber"])
def test_resets_are_a_small_part_of_the_program(method):
    """A reset of the belief that carries derivatives along, or is computed for each entry by itself."""
    model, params, belief, steps = problem("loose", EPOCHS)
    watchful = lowered_gradient(robust("loose", method), params, belief, steps)
    assert count(watchful) <= WATCHFUL * count(lowered_gradient(model, params, belief, steps))


def count(lowered):
    """Number of operations of a program."""
    return sum(" = " in line for line in lowered.as_text().splitlines())


def test_only_what_is_free_is_differentiated():
    """A tuner of noise that carries the derivatives by a calibration it does not ask for along."""
    model, params, belief, steps = problem("loose", 4)

    def value(noise):
        output = ekf.run_filter(model, params._replace(noise=noise), belief, steps, keep="means")
        return jnp.sum(output.instants.log_likelihood)

    def every(params):
        output = ekf.run_filter(model, params, belief, steps, keep="means")
        return jnp.sum(output.instants.log_likelihood)

    def operations(function, at):
        return count(jax.jit(jax.grad(function)).lower(at))

    assert operations(value, params.noise) < 0.96 * operations(every, params)


def toy(transition):
    """Attitude alone, seen directly."""
    sensor = Sensor(
        "attitude",
        SO3(),
        lambda x, u, params, aux: x,
        lambda params, aux, dt: params.noise * jnp.eye(3),
    )
    return Model(
        name="toy",
        summary="",
        space=SO3(),
        transition=transition,
        process_noise=lambda params, dt: dt * jnp.eye(3),
        sensors=(sensor,),
        parameters=Parameters(1e-4, (), ()),
        units=Parameters("rad^2", (), ()),
        noise_dims=1,
        initial_mean=lambda first: rotation.identity(),
        initial_covariance=lambda params: 0.1 * jnp.eye(3),
    )


def run_toy(transition):
    model = toy(transition)
    time = np.arange(3.0)[:, None]
    value = np.broadcast_to(rotation.exp(jnp.array([0.1, 0.0, 0.2])), (3, 1, 4))
    rows = Rows(value, None, np.ones((3, 1, 3), bool), np.ones((3, 1)))
    steps = Steps(time, np.ones((3, 1)), np.ones((3, 1), bool), None, {"attitude": rows}, {})
    params = jax.tree.map(jnp.asarray, model.parameters)
    belief = Belief(rotation.identity(), model.initial_covariance(params))
    return ekf.run_filter(model, params, belief, steps, keep="means").instants.updated.mean


def turned(x, u, dt, w, params):
    return rotation.product(x, rotation.exp(0.1 * dt + w))


def taken_apart(x, u, dt, w, params):
    w_, x_, y_, z_ = x
    p = rotation.exp(0.1 * dt + w)
    return jnp.stack(
        [
            w_ * p[0] - x_ * p[1] - y_ * p[2] - z_ * p[3],
            w_ * p[1] + x_ * p[0] + y_ * p[3] - z_ * p[2],
            w_ * p[2] - x_ * p[3] + y_ * p[0] + z_ * p[1],
            w_ * p[3] + x_ * p[2] - y_ * p[1] + z_ * p[0],
        ]
    )


def summed(x, u, dt, w, params):
    return rotation.product(x, rotation.exp(0.1 * dt + jnp.cumsum(w) - jnp.cumsum(w) + w))


def test_a_slow_model_is_told_once_and_is_right():
    """A model of one's own that is slow without a word, or is told again at every run, or is wrong."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        expected = run_toy(turned)
    for transition, word in ((taken_apart, "quaternion"), (summed, "cumsum")):
        with pytest.warns(SlowModelWarning, match=word) as told:
            found = run_toy(transition)
        assert len(told) == 1
        np.testing.assert_allclose(found, expected, atol=1e-12)


def test_no_built_in_model_is_slow():
    """A built-in model with an operation that is not plain arithmetic; warnings are errors here."""
    for name in (
        "loose",
        "loose_rate",
        "loose_pose",
        "loose_additive",
        "tight",
        "triad",
        "marg",
        "visual",
    ):
        model, params, belief, steps = problem(name, 4)
        jax.eval_shape(
            lambda p, m=model, b=belief, s=steps: ekf.run_filter(m, p, b, s, keep="means"), params
        )
