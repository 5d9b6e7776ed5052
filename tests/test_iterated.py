"""The iterated smoother: the most probable path, against least squares over a whole run at once."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scenario
from scipy.optimize import least_squares
from test_contract import MODELS, data, parameters, start
from test_naive import hidden_at_random
from test_smoother import linear_problem

from jaxekf.filtering import ekf, iterated_smoother, smoother
from jaxekf.geometry import manifold


def residuals_of(model, params, belief, steps, used):
    """What least squares makes small, and the path: both of the error of the start and of the process
    noise in units of its standard deviations, one after the other."""
    inputs = ekf.inputs_of(model, params, steps)
    epochs, substeps = steps.dt.shape
    size = model.error_dim
    count = model.process_noise(params, steps.dt[0, 0]).shape[0]

    last = jnp.arange(substeps) == substeps - 1

    def factor(cov):
        lower = jnp.linalg.cholesky(cov + 1e-300 * jnp.eye(len(cov)))
        return jnp.where(jnp.any(cov != 0.0), lower, 0.0)

    def seen(x, u, name, rows, mask):
        sensor = model.sensor(name)
        found = manifold.local(sensor.space, sensor.predict(x, u, params, rows.aux), rows.value)
        noise = sensor.noise(params, rows.aux, rows.dt)
        noise = jnp.where(mask[:, None] & mask[None], noise, jnp.eye(len(mask)))
        return jnp.linalg.solve(jnp.linalg.cholesky(noise), jnp.where(mask, found, 0.0))

    def everywhere(tree):
        return jax.tree.map(lambda a: jnp.repeat(a[:, None], substeps, axis=1), tree)

    samples = {name: (rows, used[name].used) for name, rows in steps.fast.items()}
    for name, rows in steps.slow.items():
        counted = used[name].used[:, None] & last[None, :, None]
        samples[name] = everywhere(rows), counted
    given = jax.tree.map(
        lambda a: a.reshape(epochs * substeps, *a.shape[2:]), (steps.dt, inputs, samples)
    )

    def step(x, at):
        drawn, (dt, u, samples) = at
        x = model.transition(x, u, dt, factor(model.process_noise(params, dt)) @ drawn, params)
        misfits = [seen(x, u, name, *sample) for name, sample in samples.items()]
        return x, (x, jnp.concatenate(misfits))

    def run(unknown):
        drawn = unknown[size:].reshape(epochs * substeps, count)
        first = jnp.linalg.cholesky(belief.cov) @ unknown[:size]
        x = manifold.retract(model.space, belief.mean, first)
        path, misfits = jax.lax.scan(step, x, (drawn, given))[1]
        return jnp.concatenate([unknown, misfits.reshape(-1)]), (x, path)

    return run, size + epochs * substeps * count


@pytest.mark.parametrize("name", ["triad"])
def test_most_probable_path(name):
    """A Jacobian that is not the residual's own, a prior counted from the wrong place, noise that is
    forgotten: a path that is nearly the most probable one."""
    model, params = MODELS[name], parameters(MODELS[name])
    given = data(model, 1)
    steps = jax.tree.map(jnp.asarray, hidden_at_random(given.epochs, 1))
    belief = start(model, params, given.mean)
    function = partial(iterated_smoother.run_iterated_smoother, model, iterations=6)
    found = scenario.quick_jit(function)(params, belief, steps)
    assert found.moved[0] > 1e-5 and found.moved[-1] < 1e-9
    run, size = residuals_of(model, params, belief, steps, found.filtered.innovations)
    values = scenario.quick_jit(lambda unknown: run(unknown)[0])
    slopes = scenario.quick_jit(jax.jacfwd(lambda unknown: run(unknown)[0]))
    least = least_squares(
        lambda unknown: np.asarray(values(unknown)),
        np.zeros(size),
        jac=lambda unknown: np.asarray(slopes(unknown)),
        xtol=1e-15,
        ftol=1e-15,
        gtol=1e-15,
    )
    first, path = scenario.quick_jit(lambda unknown: run(unknown)[1])(jnp.asarray(least.x))
    wanted = jax.tree.map(lambda a: a.reshape(*steps.dt.shape, *a.shape[1:]), path)
    both = (found.smoothed.mean, wanted), (found.start.mean, first)
    for ours, theirs in both:
        for a, b in zip(jax.tree.leaves(ours), jax.tree.leaves(theirs), strict=True):
            np.testing.assert_allclose(a, b, rtol=0, atol=1e-8)


def test_linear_is_the_smoother():
    """An iteration that moves what is at its best already, or whose derivative is another's."""
    model, _, belief, steps = linear_problem(6, epochs=12)

    def total(run, belief):
        found = run(model, model.parameters, belief, steps)
        values = jnp.sum(jnp.sin(found.smoothed.mean)), jnp.sum(found.smoothed.cov)
        return sum(values) + jnp.sum(found.start.mean), found

    several = partial(iterated_smoother.run_iterated_smoother, iterations=2)
    (_, found), slope = scenario.quick_jit(
        jax.value_and_grad(partial(total, several), has_aux=True)
    )(belief)
    (_, wanted), expected = scenario.quick_jit(
        jax.value_and_grad(partial(total, smoother.run_smoother), has_aux=True)
    )(belief)
    np.testing.assert_allclose(found.moved, 0.0, atol=1e-10)
    for a, b in zip(*map(jax.tree.leaves, (found.smoothed, wanted.smoothed)), strict=True):
        np.testing.assert_allclose(a, b, rtol=0, atol=1e-10)
    np.testing.assert_allclose(slope.mean, expected.mean, rtol=0, atol=1e-10)
    both = slope.cov + slope.cov.T, expected.cov + expected.cov.T
    np.testing.assert_allclose(*both, rtol=0, atol=1e-10)
