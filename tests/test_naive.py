"""The fast filter against a naive one, for every model: values and gradients, rows hidden at random."""

import dataclasses
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import naive
import numpy as np
import pytest
import scenario
import toy_models
from test_contract import MODELS, data, parameters, start

from jaxekf import ekf
from jaxekf.errors import ModelError
from jaxekf.model import Belief
from jaxekf.timeline import Rows, Steps


def hidden_at_random(steps, seed):
    """The steps with a third of all rows hidden, each by itself."""
    rng = np.random.default_rng([seed, 41])

    def hide(sensors):
        return {
            name: rows._replace(mask=rows.mask & (rng.uniform(size=np.shape(rows.mask)) < 0.67))
            for name, rows in sensors.items()
        }

    return steps._replace(fast=hide(steps.fast), slow=hide(steps.slow))


def outputs_of(output):
    """The package's outputs in the order of the naive filter's."""
    at = output.instants
    return tuple(at.predicted), tuple(at.updated), at.log_likelihood


def weighted(found, seed):
    """A number that moves with every output."""
    rng = np.random.default_rng(seed)
    leaves = jax.tree.leaves(found)
    scales = [jax.lax.stop_gradient(jnp.max(jnp.abs(a))) + 1e-300 for a in leaves]
    return sum(
        jnp.sum(a * rng.normal(size=a.shape)) / s for a, s in zip(leaves, scales, strict=True)
    )


@pytest.mark.parametrize(
    "name",
    scenario.long_form(list(MODELS), set(MODELS) - {"loose", "loose_additive"}),
)
def test_fast_is_naive(name):
    """Structure found that is not there, a block of rows taken wrongly, a cotangent lost: by a fast path
    that its own slow path shares."""
    model, params = MODELS[name], parameters(MODELS[name])
    given = data(model, 1)
    steps = jax.tree.map(jnp.asarray, hidden_at_random(given.epochs, 1))
    mean = given.mean

    def fast(params):
        output = ekf.run_filter(model, params, start(model, params, mean), steps)
        found = outputs_of(output)
        return weighted(found, 5), found

    def slow(params):
        found = naive.run(model, params, start(model, params, mean), steps)
        return weighted(found, 5), found

    (_, found), slopes = scenario.quick_jit(jax.value_and_grad(fast, has_aux=True))(params)
    (_, wanted), expected = scenario.quick_jit(jax.value_and_grad(slow, has_aux=True))(params)
    every = jax.tree.leaves(found), jax.tree.leaves(wanted)
    for a, b in zip(*every, strict=True):
        np.testing.assert_allclose(a, b, rtol=0, atol=1e-10 * float(np.max(np.abs(b))))
    for path, b in jax.tree_util.tree_leaves_with_path(expected):
        a = dict(jax.tree_util.tree_leaves_with_path(slopes))[path]
        scale = float(np.max(np.abs(b)))
        where = jax.tree_util.keystr(path)
        np.testing.assert_allclose(a, b, rtol=0, atol=1e-9 * scale, err_msg=where)


def test_the_data_gate_and_hide():
    """A comparison that never meets a hidden row, a gated one, or a slow sensor."""
    steps = hidden_at_random(data(MODELS["visual"], 1).epochs, 1)
    assert steps.slow
    assert not all(rows.mask.all() for rows in (steps.fast | steps.slow).values())


def inside_blocks(jaxpr, within=False):
    """Names of the primitives in what is compiled into one piece of code."""
    for eqn in jaxpr.eqns:
        inner = within or eqn.params.get("name") == "inner"
        sizes = [eqn.invars[0].aval.shape[a] for a in eqn.params.get("axes", ())]
        if within and (not sizes or np.prod(sizes) > 1):
            yield eqn.primitive.name
        for value in jax.tree.leaves(
            list(eqn.params.values()), is_leaf=lambda v: hasattr(v, "eqns")
        ):
            value = getattr(value, "jaxpr", value)
            if hasattr(value, "eqns"):
                yield from inside_blocks(value, inner)


@pytest.mark.parametrize(
    "name", scenario.long_form(list(MODELS), set(MODELS) - {"loose_additive", "triad", "visual"})
)
def test_blocks_hold_arithmetic_only(name):
    """A sum over an axis where the compiler knows none: it refuses larger models with
    "Fusion kind not implemented"."""
    model, params = MODELS[name], parameters(MODELS[name])
    given = data(model, 1)
    steps = jax.tree.map(jnp.asarray, given.epochs)

    def total(params):
        belief = start(model, params, given.mean)
        output = ekf.run_filter(model, params, belief, steps, keep="means")
        return jnp.sum(output.instants.log_likelihood)

    names = set(inside_blocks(jax.make_jaxpr(jax.grad(total))(params).jaxpr))
    assert {"mul", "sqrt"} <= names
    assert not {n for n in names if n.startswith(("reduce_", "dot_general", "custom_call", "argm"))}


class Tuned(NamedTuple):
    """One number that the transition or the sensor takes from the parameters."""

    c: Any


WHOLE = {
    "scatter": lambda x, c: x.at[1].set(x[2] * c),
    "cond": lambda x, c: jax.lax.cond(x[0] > 0.0, lambda: x * c, lambda: x - c),
    "loop": lambda x, c: jax.lax.fori_loop(0, 3, lambda i, y: y + 0.1 * jnp.sin(y) * c, x),
    "solve": lambda x, c: jnp.linalg.solve(2.0 * jnp.eye(3) + c * jnp.outer(x, x), x),
}


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
    )
    params = model.parameters._replace(calibration=Tuned(jnp.asarray(0.7)))
    belief = Belief(jnp.array([0.4, 0.5, 0.6]), jnp.eye(3))
    value = np.random.default_rng(2).uniform(0.2, 1.0, (5, 1, 3))
    one = np.ones((5, 1))
    rows = Rows(value, None, np.ones((5, 1, 3), bool), one)
    steps = Steps(np.cumsum(one)[:, None], one, one > 0, None, {"sensor_0": rows}, {})
    steps = jax.tree.map(jnp.asarray, steps)

    def fast(params):
        found = outputs_of(ekf.run_filter(model, params, belief, steps))
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
