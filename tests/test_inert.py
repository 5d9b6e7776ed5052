"""What is hidden, and what only fills up a batch, leaves no trace in results or gradients."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scenario

from jaxekf.estimation import padding, timeline
from jaxekf.filtering import ekf
from jaxekf.geometry import rotation
from jaxekf.models import REGISTRY

NAMES = ("loose", "loose_rate", "loose_additive")
COUNT = 18


@partial(scenario.quick_jit, static_argnums=0)
def evaluate(model, params, first, steps, truth):
    """The gradient, to all parameters, of attitude error and log-likelihood; and the output."""

    def loss(params):
        belief = ekf.initial_belief(model, params, first)
        output = ekf.run_filter(model, params, belief, steps)
        error = rotation.difference(truth, output.instants.updated.mean.q_ref_body)
        squared = jnp.where(steps.valid, jnp.sum(error * error, axis=-1), 0.0)
        return jnp.sum(squared) - jnp.sum(output.instants.log_likelihood), output

    return jax.grad(loss, has_aux=True)(params)


def prepared(name):
    """A run in which whole samples and single rows are hidden, one step an epoch."""
    run = scenario.make_run(3, COUNT)
    mask = scenario.optical_mask(run, name)
    if name == "loose_additive":
        mask[4, 2] = False
    run.gyroscope_seen[2] = False
    run.gyroscope_seen[6, 1] = False
    steps, index = scenario.epoch_steps(run, name, 1, mask)
    first = {"optical": run.optical[0], "gyroscope": run.gyroscope[0]}
    return run, scenario.parameters(name), first, steps, run.truth[index]


def replaced(rows, junk):
    """The samples with every hidden number replaced; a rotation is hidden only whole."""
    value, mask = np.array(rows.value), np.asarray(rows.mask)
    if value.shape != mask.shape:
        mask = np.repeat(mask.any(axis=-1, keepdims=True), value.shape[-1], axis=-1)
    assert not mask.all()
    value[~mask] = junk
    return rows._replace(value=value)


def assert_identical(actual, expected):
    jax.tree.map(np.testing.assert_array_equal, actual, expected)


@pytest.mark.parametrize("name", scenario.long_form(NAMES, {"loose_rate"}))
def test_masked_values_are_inert(name):
    """A hidden NaN or huge number that reaches an output, or a gradient by the branch not taken."""
    _, params, first, steps, truth = prepared(name)
    model = REGISTRY[name]
    expected = evaluate(model, params, first, steps, truth)
    for leaf in jax.tree.leaves(expected):
        assert np.isfinite(leaf).all()
    for leaf in jax.tree.leaves(expected[0]):
        assert np.any(leaf != 0.0)
    for junk in (np.nan, 1e30, -np.inf):
        changed = steps._replace(
            fast={key: replaced(rows, junk) for key, rows in steps.fast.items()},
            slow={key: replaced(rows, junk) for key, rows in steps.slow.items()},
        )
        assert_identical(evaluate(model, params, first, changed, truth), expected)


def assert_close(actual, expected):
    """Equal to 1e-12 of the largest number in each array."""

    def close(a, b):
        np.testing.assert_allclose(a, b, rtol=0, atol=1e-12 * max(1.0, np.abs(b).max()))

    jax.tree.map(close, actual, expected)


@pytest.mark.parametrize("name", scenario.long_form(NAMES, {"loose_rate"}))
def test_padding_is_inert(name):
    """Padding that moves the state, adds noise or likelihood, or sends NaN back through dt = 0."""
    _, params, first, steps, truth = prepared(name)
    model = REGISTRY[name]
    epochs = len(steps.dt)
    padded = padding.pad(steps, epochs + 3, 2)
    if padded.knots is not None:
        more = timeline.Knots(
            *(
                np.concatenate([k, k[-1:] + [[1.0]] * 2])
                if k.ndim == 2
                else np.concatenate([k, k[-1] + [1.0, 2.0]])
                for k in padded.knots
            )
        )
        padded = padded._replace(knots=more)
    assert padded.valid.sum() == steps.valid.sum()
    whole = np.tile(np.array([1.0, 0.0, 0.0, 0.0]), (epochs + 3, 2, 1))
    whole[:epochs, 1:] = truth
    gradient, output = evaluate(model, params, first, steps, truth)
    padded_gradient, padded_output = evaluate(model, params, first, padded, whole)
    real = jax.tree.map(lambda a: a[:epochs, 1:], padded_output.instants)
    assert_close(real, output.instants)
    for sensor, innovation in padded_output.innovations.items():
        at = np.s_[:epochs, 1:] if sensor in steps.fast else np.s_[:epochs]
        assert_close(jax.tree.map(lambda a: a[at], innovation), output.innovations[sensor])
    assert_close(padded_gradient, gradient)
    filling = np.asarray(padded_output.instants.log_likelihood)[~padded.valid]
    np.testing.assert_array_equal(filling, 0.0)


def test_stacked_runs_of_unequal_length():
    """A shorter run that changes because a longer one stands beside it."""
    model, params = REGISTRY["loose_rate"], scenario.parameters("loose_rate")
    lines, beliefs = [], []
    for seed, count in ((3, COUNT), (4, COUNT - 5)):
        run = scenario.make_run(seed, count)
        steps, _ = scenario.epoch_steps(run, "loose_rate", 1)
        first = {"optical": run.optical[0], "gyroscope": run.gyroscope[0]}
        lines.append(timeline.from_steps(str(seed), steps, first))
        beliefs.append(ekf.initial_belief(model, params, first))
    stacked = padding.stack(lines)
    last = scenario.run_filter_quick(
        model, params, beliefs[1], jax.tree.map(lambda a: a[1], stacked)
    ).instants
    alone = scenario.run_filter_quick(model, params, beliefs[1], lines[1].steps).instants
    assert_close(jax.tree.map(lambda a: a[: COUNT - 5], last), alone)
    end = jax.tree.map(lambda a: a[-1], (last.updated, alone.updated))
    assert_close(*end)
