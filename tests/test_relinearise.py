"""The iterated update: the most probable state of one instant, given the prediction and its samples."""

import dataclasses
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scenario
import toy_models

from jaxekf._support.errors import ModelError
from jaxekf.filtering import ekf
from jaxekf.filtering.model import Belief
from jaxekf.filtering.steps import Rows, Steps
from jaxekf.geometry import manifold, rotation
from jaxekf.geometry.manifold import SO3, Euclidean

PRIOR, SPREAD, NOISE = 1.0, 0.5, 0.1


def problem(space, size, predict, rows_space, rows, value, cov, noise):
    """One prediction that changes nothing, and one sample."""
    plain = toy_models.linear_model(
        np.eye(size), 0.0 * np.eye(size), [np.eye(size)], [np.eye(size)]
    )
    sensor = dataclasses.replace(
        plain.sensors[0],
        space=rows_space,
        predict=lambda x, u, params, aux: predict(x),
        noise=lambda params, aux, dt: jnp.asarray(noise),
    )
    model = dataclasses.replace(
        plain, space=space, transition=lambda x, u, dt, w, params: x, sensors=(sensor,)
    )
    one = np.ones((2, 1))
    mask = np.array([True, False])[:, None, None] & np.ones((2, 1, rows), bool)
    sample = Rows(np.broadcast_to(value, (2, 1, *np.shape(value))), None, mask, one)
    steps = Steps(np.cumsum(one)[:, None], one, one > 0, None, {"sensor_0": sample}, {})
    return model, jnp.asarray(cov), jax.tree.map(jnp.asarray, steps)


def gauss_newton(start, residuals, move, size):
    """The minimum of a sum of squares, each step from where the last arrived, and the inverse of its
    normal matrix: dense, by differences of nothing but the residuals themselves."""

    @jax.jit
    def linear(x):
        return residuals(x), jax.jacfwd(lambda d: residuals(move(x, d)))(jnp.zeros(size))

    x = start
    for _ in range(40):
        e, j = linear(x)
        x = move(x, -jnp.linalg.solve(j.T @ j, j.T @ e))
    j = linear(x)[1]
    return x, jnp.linalg.inv(j.T @ j)


def scalar_problem():
    """A cube, seen far from where it was predicted."""
    model, cov, steps = problem(
        Euclidean(1), 1, lambda x: x**3, Euclidean(1), 1, [4.0], [[SPREAD]], [[NOISE]]
    )
    return model, Belief(jnp.array([PRIOR]), cov), steps


def test_scalar_with_a_known_answer():
    """An iteration with a posterior covariance for the prior's (dynamax 1.0.3), which draws far too near
    to the sample, or one that stops where the prediction was linearised."""
    model, belief, steps = scalar_problem()

    def residuals(x):
        return jnp.array([(x[0] - PRIOR) / np.sqrt(SPREAD), (x[0] ** 3 - 4.0) / np.sqrt(NOISE)])

    best, wanted = gauss_newton(belief.mean, residuals, lambda x, d: x + d, 1)
    once = ekf.run_filter(model, model.parameters, belief, steps).instants.updated.mean[0, 0]
    output = ekf.run_filter(model, model.parameters, belief, steps, relinearise=40)
    np.testing.assert_allclose(output.instants.updated.mean[0, 0], best, rtol=1e-10)
    np.testing.assert_allclose(output.instants.updated.cov[0, 0], wanted, rtol=1e-10)
    assert abs(once[0] - best[0]) > 0.05
    # What is hidden changes nothing.
    np.testing.assert_array_equal(
        output.instants.updated.mean[1], output.instants.predicted.mean[1]
    )


def attitude_problem():
    """An attitude far from where two directions are seen."""
    ends = jnp.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.3]])

    def predict(q):
        return jnp.concatenate([rotation.rotate(q, end) for end in ends])

    true = SO3().retract(jnp.array([1.0, 0.0, 0.0, 0.0]), jnp.array([0.9, -0.7, 0.5]))
    seen = np.asarray(predict(true)) + 0.02
    cov = np.diag([0.3, 0.5, 0.4])
    model, cov, steps = problem(SO3(), 3, predict, Euclidean(6), 6, seen, cov, 0.01 * np.eye(6))
    return model, Belief(jnp.array([1.0, 0.0, 0.0, 0.0]), cov), steps, predict, seen


def test_attitude_against_least_squares():
    """A prediction counted in the wrong chart once the state has moved away from it."""
    model, belief, steps, predict, seen = attitude_problem()
    root = np.linalg.cholesky(np.linalg.inv(np.asarray(belief.cov))).T

    def residuals(q):
        return jnp.concatenate(
            [root @ manifold.local(SO3(), belief.mean, q), (predict(q) - seen) / 0.1]
        )

    best, wanted = gauss_newton(belief.mean, residuals, SO3().retract, 3)
    run = scenario.quick_jit(partial(ekf.run_filter, model, relinearise=12))
    at = run(model.parameters, belief, steps).instants
    np.testing.assert_allclose(manifold.local(SO3(), best, at.updated.mean[0, 0]), 0, atol=1e-10)
    np.testing.assert_allclose(at.updated.cov[0, 0], wanted, rtol=1e-9, atol=1e-12)


def test_gradient():
    """A derivative that is the first linearisation's: the adjoint against JAX's own."""
    model, belief, steps = scalar_problem()

    def total(belief, adjoint):
        at = ekf.run_filter(
            model, model.parameters, belief, steps, relinearise=2, adjoint=adjoint
        ).instants
        return jnp.sum(jnp.sin(at.updated.mean)) + jnp.sum(jnp.cos(at.updated.cov))

    found, wanted = jax.grad(total)(belief, True), jax.grad(total)(belief, False)
    np.testing.assert_allclose(found.mean, wanted.mean, rtol=1e-10)
    np.testing.assert_allclose(found.cov, wanted.cov, rtol=1e-10)


def test_a_negative_number_is_refused():
    """A count that would silently be taken for none."""
    model, belief, steps = scalar_problem()
    with pytest.raises(ModelError, match="0 or more"):
        ekf.run_filter(model, model.parameters, belief, steps, relinearise=-1)
