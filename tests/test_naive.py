"""The fast filter against a naive one, for every model: values and gradients, rows hidden at random."""

import jax
import jax.numpy as jnp
import naive
import numpy as np
import pytest
import scenario
import toy_models
from test_contract import MODELS, data, parameters, start

from jaxekf import ekf


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


@pytest.mark.parametrize("name", MODELS)
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
    steps = hidden_at_random(data(toy_models.VISUAL, 1).epochs, 1)
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


@pytest.mark.parametrize("name", MODELS)
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
    assert "scan" in names
    assert not {n for n in names if n.startswith(("reduce_", "dot_general", "custom_call", "argm"))}
