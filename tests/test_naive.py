"""The fast filter against a naive one, for every model: values and gradients, rows hidden at random."""

import dataclasses
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import naive
import numpy as np
import pytest
import scenario
import toy_models
from test_contract import MODELS, data, masked, parameters, start

from jaxekf._support.errors import ModelError
from jaxekf.filtering import ekf
from jaxekf.filtering.model import Belief
from jaxekf.filtering.steps import Rows, Steps


def hidden_at_random(steps, seed):
    """The steps with a third of all rows hidden, each by itself."""
    rng = np.random.default_rng([seed, 41])

    def hide(sensors):
        return {
            name: rows._replace(mask=rows.mask & (rng.uniform(size=np.shape(rows.mask)) < 0.67))
            for name, rows in sensors.items()
        }

    return steps._replace(fast=hide(steps.fast), slow=hide(steps.slow))


def beliefs_of(output):
    """The package's beliefs and log-likelihoods in the order of the naive filter's."""
    at = output.instants
    return tuple(at.predicted), tuple(at.updated), at.log_likelihood


def with_outputs(model, params, inputs, made):
    """Beliefs and log-likelihoods of one run, and the model's outputs at the updated means."""

    def at_all(out):
        return jax.vmap(jax.vmap(lambda x, u: out.value(x, u, params)))(made[1][0], inputs)

    return *made, [at_all(out) for out in model.outputs]


def weighted(found, seed):
    """A number that moves with every output."""
    rng = np.random.default_rng(seed)
    leaves = jax.tree.leaves(found)
    scales = [jax.lax.stop_gradient(jnp.max(jnp.abs(a))) + 1e-300 for a in leaves]
    return sum(
        jnp.sum(a * rng.normal(size=a.shape)) / s for a, s in zip(leaves, scales, strict=True)
    )


def objective(found, plain):
    """All outputs, weighted; where `plain` is 1, log-likelihoods, means and the model's outputs alone."""
    _, (mean, _), log_likelihood, told = found
    seen = [jnp.sum(jnp.sin(leaf + 0.3)) for leaf in jax.tree.leaves((mean, told))]
    return plain * (jnp.sum(log_likelihood) + sum(seen)) + (1.0 - plain) * weighted(found, 5)


def by_package(model, params, means, steps, plain):
    """What the package makes of several runs at once, and the slope of the sum of their objectives. All
    but `plain` carries the runs on its first axis."""

    def total(params):
        belief = jax.vmap(partial(start, model))(params, means)
        output = ekf.run_filter_batch(model, params, belief, steps)
        given = params, output.inputs, beliefs_of(output)
        found = jax.vmap(partial(with_outputs, model))(*given)
        return jnp.sum(jax.vmap(lambda one: objective(one, plain))(found)), found

    slopes, found = jax.grad(total, has_aux=True)(params)
    return found, slopes


def by_hand(model, params, way, mean, steps):
    """The same by the naive filter, of one run, and the slope along one way by JAX's forward mode."""

    def total(params):
        made = naive.run(model, params, start(model, params, mean), steps)
        found = with_outputs(model, params, ekf.inputs_of(model, params, steps), made)
        return objective(found, 0.0), found

    _, slope, found = jax.jvp(total, (params,), (way,), has_aux=True)
    return found, slope


def slopes_by_hand(program, params, *given):
    """The naive filter's output and the slope to every parameter, one number after the other: a quarter of
    the time to compile that reverse mode takes."""
    leaves, tree = jax.tree.flatten(jax.tree.map(np.asarray, params))
    slopes = [np.zeros(leaf.shape) for leaf in leaves]
    for i, slope in enumerate(slopes):
        for at in np.ndindex(slope.shape):
            ways = [np.zeros(leaf.shape) for leaf in leaves]
            ways[i][at] = 1.0
            found, slope[at] = program(params, jax.tree.unflatten(tree, ways), *given)
    return found, jax.tree.unflatten(tree, slopes)


class Programs(NamedTuple):
    """A model and its two programs, for all that is asked of it here."""

    model: Any
    package: Any
    hand: Any


@pytest.fixture(scope="module", params=MODELS)
def programs(request):
    """One model after the other; the programs of the last are not kept."""
    model = MODELS[request.param]
    return Programs(model, *(scenario.quick_jit(partial(f, model)) for f in (by_package, by_hand)))


def together(*runs):
    """Runs on a new first axis."""
    return jax.tree.map(lambda *leaves: jnp.stack([jnp.asarray(a) for a in leaves]), *runs)


def test_fast_is_naive(programs):
    """Structure found that is not there, a block of rows taken wrongly, a cotangent lost: by a fast path
    that its own slow path shares. Runs that leak into each other, or lanes that are transposed on the way
    in or out. A sensor that is linearised at a state which another has already moved."""
    model, runs = programs.model, []
    # With seed 2 `loose_additive` would have a quaternion whose sign only a hidden number tells.
    for seed in (1, 3):
        given = data(model, seed)
        scaled = jax.tree.map(lambda a, seed=seed: (0.9 + 0.1 * seed) * a, parameters(model))
        runs.append((scaled, given.mean, hidden_at_random(given.epochs, seed)))
    both = programs.package(*together(*runs), 0.0)
    for i, run in enumerate(runs):
        found, slopes = jax.tree.map(lambda a, i=i: np.asarray(a[i]), both)
        wanted, expected = slopes_by_hand(programs.hand, *run)
        every = jax.tree.leaves(found), jax.tree.leaves(wanted)
        for a, b in zip(*every, strict=True):
            np.testing.assert_allclose(a, b, rtol=0, atol=1e-10 * float(np.max(np.abs(b))))
        got = dict(jax.tree_util.tree_leaves_with_path(slopes))
        for path, b in jax.tree_util.tree_leaves_with_path(expected):
            scale = float(np.max(np.abs(b)))
            where = jax.tree_util.keystr(path)
            np.testing.assert_allclose(got[path], b, rtol=0, atol=1e-9 * scale, err_msg=where)
    ends = np.asarray(jax.tree.leaves(both[0][1])[0])[:, -1]
    assert np.abs(ends[0] - ends[1]).max() > 1e-6


def test_gradients(programs):
    """A NaN under differentiation, with data, without and at rest; a parameter that is cut off."""
    model = programs.model
    usual, rest = data(model, 0), data(model, 0, rest=True)
    params, means = together(*[parameters(model)] * 2), together(usual.mean, rest.mean)
    _, slopes = programs.package(params, means, together(usual.epochs, rest.epochs), 1.0)
    unseen = together(masked(usual.epochs), masked(rest.epochs))
    _, without = programs.package(params, means, unseen, 1.0)
    for gradient in (slopes, without):
        for path, leaf in jax.tree_util.tree_leaves_with_path(gradient):
            assert np.isfinite(leaf).all(), jax.tree_util.keystr(path)
    for path, leaf in jax.tree_util.tree_leaves_with_path(slopes):
        assert np.any(leaf[0] != 0.0), jax.tree_util.keystr(path)


def test_the_data_gate_and_hide():
    """A comparison that never meets a hidden row, a gated one, or a slow sensor."""
    steps = hidden_at_random(data(MODELS["visual"], 1).epochs, 1)
    assert steps.slow
    assert not all(rows.mask.all() for rows in (steps.fast | steps.slow).values())


class Tuned(NamedTuple):
    """One number that the transition or the sensor takes from the parameters."""

    c: Any


WHOLE = {
    "scatter": lambda x, c: x.at[1].set(x[2] * c),
    "cond": lambda x, c: jax.lax.cond(x[0] > 0.0, lambda: x * c, lambda: x - c),
    "loop": lambda x, c: jax.lax.fori_loop(0, 3, lambda i, y: y + 0.1 * jnp.sin(y) * c, x),
    "solve": lambda x, c: jnp.linalg.solve(2.0 * jnp.eye(3) + c * jnp.outer(x, x), x),
}


@pytest.mark.filterwarnings("ignore::jaxekf._support.errors.SlowModelWarning")
@pytest.mark.parametrize("where", ["transition", "sensor"])
@pytest.mark.parametrize("name", WHOLE)
def test_parameters_inside_whole_operations(name, where):
    """A parameter taken for unused, with zero in its place, where an operation is not taken apart."""
    move = WHOLE[name]
    plain = {"transition": lambda x, c: x, "sensor": lambda x, c: x} | {where: move}
    linear = toy_models.linear_model(np.eye(3), 0.1 * np.eye(3), [np.eye(3)], [0.2 * np.eye(3)])
    sensor = dataclasses.replace(
        linear.sensors[0],
        predict=lambda x, u, params, aux: plain["sensor"](x, params.calibration.c),
    )
    model = dataclasses.replace(
        linear,
        transition=lambda x, u, dt, w, params: plain["transition"](x, params.calibration.c) + w,
        sensors=(sensor,),
        parameters=linear.parameters._replace(calibration=Tuned(0.7)),
        units=linear.units._replace(calibration=Tuned("1")),
    )
    params = jax.tree.map(jnp.asarray, model.parameters)
    belief = Belief(jnp.array([0.4, 0.5, 0.6]), jnp.eye(3))
    value = np.random.default_rng(2).uniform(0.2, 1.0, (5, 1, 3))
    one = np.ones((5, 1))
    rows = Rows(value, None, np.ones((5, 1, 3), bool), one)
    steps = Steps(np.cumsum(one)[:, None], one, one > 0, None, {"sensor_0": rows}, {})
    steps = jax.tree.map(jnp.asarray, steps)

    def fast(params):
        found = beliefs_of(ekf.run_filter(model, params, belief, steps))
        return weighted(found, 3), found

    def slow(params):
        found = naive.run(model, params, belief, steps)
        return weighted(found, 3), found

    (_, found), slope = jax.value_and_grad(fast, has_aux=True)(params)
    (_, wanted), expected = jax.value_and_grad(slow, has_aux=True)(params)
    for a, b in zip(jax.tree.leaves(found), jax.tree.leaves(wanted), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-10, atol=1e-12)
    np.testing.assert_allclose(slope.calibration.c, expected.calibration.c, rtol=1e-9)


def test_no_steps_are_refused():
    """A division by zero instead of a sentence."""
    model, params = MODELS["triad"], parameters(MODELS["triad"])
    given = data(model, 1)
    none = jax.tree.map(lambda a: a[:0], given.epochs._replace(knots=None))
    none = none._replace(knots=given.epochs.knots)
    with pytest.raises(ModelError, match="at least one"):
        ekf.run_filter(model, params, start(model, params, given.mean), none)
