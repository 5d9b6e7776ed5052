"""The smoother: against Rauch, Tung, Striebel, for every model; derivatives, masks, batches."""

from functools import partial

import jax
import jax.numpy as jnp
import naive
import numpy as np
import pytest
import scenario
import toy_models
from test_contract import MODELS, data, parameters, start
from test_naive import hidden_at_random

from jaxekf.filtering import smoother
from jaxekf.filtering.model import Belief
from jaxekf.filtering.steps import Rows, Steps


def linear_problem(seed, size=4, epochs=40):
    """A linear system with two sensors, one with correlated noise, and a third of the rows hidden."""
    rng = np.random.default_rng([seed, 23])
    transition = np.eye(size) + 0.1 * rng.normal(size=(size, size))
    factor = 0.3 * rng.normal(size=(size, size))
    slopes = [rng.normal(size=(2, size)), rng.normal(size=(1, size))]
    noises = [np.array([[0.3, 0.1], [0.1, 0.2]]), np.array([[0.1]])]
    model = toy_models.linear_model(transition, factor @ factor.T, slopes, noises)
    one = np.ones((epochs, 1))
    fast = {
        f"sensor_{i}": Rows(
            rng.normal(size=(epochs, 1, len(h))),
            None,
            rng.uniform(size=(epochs, 1, len(h))) < 0.67,
            one,
        )
        for i, h in enumerate(slopes)
    }
    steps = Steps(np.cumsum(one)[:, None], one, one > 0, None, fast, {})
    belief = Belief(jnp.asarray(rng.normal(size=size)), jnp.eye(size))
    return model, transition, belief, jax.tree.map(jnp.asarray, steps)


def test_linear_is_rauch_tung_striebel():
    """A sign, a transposed gain or a sample that counts twice: NumPy's own recursion, and a variance
    that grows where more is known."""
    model, transition, belief, steps = linear_problem(1)
    found = smoother.run_smoother(model, model.parameters, belief, steps)
    at = found.filtered.instants
    x, p, ahead, spread = (
        np.asarray(a)[:, 0] for a in (*at.updated, at.predicted.mean, at.predicted.cov)
    )
    mean, cov = [x[-1]], [p[-1]]
    for k in range(len(x) - 2, -1, -1):
        gain = p[k] @ transition.T @ np.linalg.inv(spread[k + 1])
        mean.insert(0, x[k] + gain @ (mean[0] - ahead[k + 1]))
        cov.insert(0, p[k] + gain @ (cov[0] - spread[k + 1]) @ gain.T)
    np.testing.assert_allclose(found.smoothed.mean[:, 0], mean, rtol=0, atol=1e-12)
    np.testing.assert_allclose(found.smoothed.cov[:, 0], cov, rtol=0, atol=1e-12)
    variances = np.diagonal(found.smoothed.cov[:, 0], axis1=1, axis2=2)
    assert np.all(variances <= np.diagonal(p, axis1=1, axis2=2) * (1 + 1e-12))


@pytest.mark.parametrize("name", ["loose", "loose_additive", "tight", "triad"])
def test_fast_is_naive(name):
    """The chart of an error lost on the way back, a substep skipped, a gate that opens, a constraint:
    models that have them, against a smoother that inverts what it must."""
    model, params = MODELS[name], parameters(MODELS[name])
    given = data(model, 1)
    steps = jax.tree.map(jnp.asarray, hidden_at_random(given.epochs, 1))
    belief = start(model, params, given.mean)
    found = scenario.quick_jit(partial(smoother.run_smoother, model))(params, belief, steps)
    wanted = scenario.quick_jit(partial(naive.smooth, model))(params, belief, steps)
    every = jax.tree.leaves((tuple(found.smoothed), tuple(found.start))), jax.tree.leaves(wanted)
    for a, b in zip(*every, strict=True):
        np.testing.assert_allclose(a, b, rtol=0, atol=1e-9 * float(np.max(np.abs(b))))


def loose_problem():
    """Some epochs of a moving run, at a clock offset where the objective is smooth."""
    model = MODELS["loose"]
    params = parameters(model)
    offset = params.calibration._replace(clock_offset=jnp.asarray(0.0013))
    params = params._replace(calibration=offset)
    given = data(model, 3)
    steps = jax.tree.map(jnp.asarray, given.epochs)
    cut = jax.tree.map(lambda a: a[:8], steps._replace(knots=None))
    return model, params, start(model, params, given.mean), cut._replace(knots=steps.knots)


def smoothed_total(model, adjoint, params, belief, steps):
    """A number that every smoothed mean and covariance moves, at the start too."""
    found = smoother.run_smoother(model, params, belief, steps, adjoint=adjoint)
    rng = np.random.default_rng(7)
    leaves = jax.tree.leaves((found.smoothed, found.start))
    return sum(jnp.sum(a * rng.normal(size=a.shape)) for a in leaves)


def test_gradient():
    """A cotangent lost between the pass back and the filter: noise, calibration and belief, against
    JAX's own derivatives (forward, along random ways: far less to compile) and central differences."""
    model, params, belief, steps = loose_problem()
    value = scenario.quick_jit(partial(smoothed_total, model, True))
    own = scenario.quick_jit(jax.grad(partial(smoothed_total, model, True), argnums=(0, 1)))
    found = own(params, belief, steps)

    def symmetric(a):
        return a + a.swapaxes(-1, -2) if a.shape[-2:] == (6, 6) else a

    @scenario.quick_jit
    def forward(way):
        given = (params, belief)
        return jax.jvp(lambda *g: smoothed_total(model, False, *g, steps), given, way)[1]

    for seed, which in enumerate((0, 1, None, None)):
        rng = np.random.default_rng(seed)
        way = jax.tree.map(
            lambda a, rng=rng: symmetric(jnp.asarray(rng.normal(size=np.shape(a)))),
            (params, belief),
        )
        if which is not None:
            still = jax.tree.map(jnp.zeros_like, way)
            way = (way[0], still[1]) if which == 0 else (still[0], way[1])
        pairs = zip(jax.tree.leaves(found), jax.tree.leaves(way), strict=True)
        each = [float(jnp.sum(g * w)) for g, w in pairs]
        expected = float(forward(way))
        assert abs(sum(each) - expected) <= 1e-9 * max(np.abs(each).max(), abs(expected))
    rng = np.random.default_rng(5)
    for section in ("noise", "calibration"):
        tree = getattr(params, section)
        way = jax.tree.map(lambda a: 0.03 * rng.normal(size=a.shape) * (jnp.abs(a) + 1e-3), tree)

        def moved(step, section=section, tree=tree, way=way):
            there = jax.tree.map(lambda a, w: a + step * w, tree, way)
            return float(value(params._replace(**{section: there}), belief, steps))

        h = 3e-3
        fourth = (8 * (moved(h) - moved(-h)) - (moved(2 * h) - moved(-2 * h))) / (12 * h)
        along = sum(
            float(jnp.sum(g * w))
            for g, w in zip(
                jax.tree.leaves(getattr(found[0], section)), jax.tree.leaves(way), strict=True
            )
        )
        np.testing.assert_allclose(along, fourth, rtol=1e-6)


def test_many_runs_are_single_runs():
    """Runs mixed up in their blocks, or a `vmap` that changes the answer."""
    model, _, belief, steps = linear_problem(4)
    many = jax.tree.map(lambda a: jnp.stack([a] * 3), (belief, steps))
    shifts = jnp.array([0.0, 0.5, -1.0])
    moved = many[0]._replace(mean=many[0].mean + shifts[:, None])
    batch = smoother.run_smoother_batch(model, model.parameters, moved, many[1])
    mapped = jax.vmap(lambda b, s: smoother.run_smoother(model, model.parameters, b, s))(
        moved, many[1]
    )

    def slope(b):
        found = smoother.run_smoother(model, model.parameters, b, steps)
        return jnp.sum(jnp.sin(found.smoothed.mean)) + jnp.sum(found.start.cov)

    slopes = scenario.quick_jit(jax.vmap(jax.grad(slope)))(moved)
    single_slope = scenario.quick_jit(jax.grad(slope))
    single_run = scenario.quick_jit(
        lambda b: smoother.run_smoother(model, model.parameters, b, steps)
    )
    for i in range(3):
        one = jax.tree.map(lambda a, i=i: a[i], moved)
        alone = single_run(one)
        for found in (batch, mapped):
            np.testing.assert_allclose(found.smoothed.mean[i], alone.smoothed.mean, atol=1e-12)
            np.testing.assert_allclose(found.smoothed.cov[i], alone.smoothed.cov, atol=1e-12)
        single = single_slope(one)
        np.testing.assert_allclose(slopes.mean[i], single.mean, atol=1e-11)


def test_hidden_numbers_are_inert():
    """A NaN or a huge number behind a mask that reaches the smoothed beliefs or their gradient."""
    model, _, belief, steps = linear_problem(5)

    def spoilt(value):
        fast = {
            name: rows._replace(value=jnp.where(rows.mask, rows.value, value))
            for name, rows in steps.fast.items()
        }
        return steps._replace(fast=fast)

    def total(b, s):
        found = smoother.run_smoother(model, model.parameters, b, s)
        return jnp.sum(found.smoothed.mean) + jnp.sum(found.smoothed.cov)

    both = jax.jit(jax.value_and_grad(total))
    clean = both(belief, spoilt(0.0))
    for value in (jnp.nan, 1e30):
        for a, b in zip(*map(jax.tree.leaves, (both(belief, spoilt(value)), clean)), strict=True):
            np.testing.assert_array_equal(a, b)
