"""What every model owes the filter, and the filter every model, the package's own or not."""

import dataclasses
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scenario
import toy_models
from scipy.stats import chi2

from jaxekf.estimation import timeline
from jaxekf.filtering import _linearisation as linearisation
from jaxekf.filtering import ekf, interpolation
from jaxekf.filtering.model import Belief, Model
from jaxekf.filtering.steps import Rows, Steps
from jaxekf.geometry import manifold
from jaxekf.models import REGISTRY

TOYS = {model.name: model for model in (toy_models.MARKERS,)}
MODELS = REGISTRY | TOYS


class Data(NamedTuple):
    """A start and the steps of a run: laid out in epochs, and flat, one substep an epoch."""

    mean: Any
    epochs: Steps
    flat: Steps


def parameters(model):
    return scenario.as_arrays(model.parameters)


def flattened(steps):
    """Only the last substep of each epoch, now one longer step."""
    last = jax.tree.map(lambda a: np.asarray(a)[:, -1:], (steps.time, steps.valid, steps.fast))
    time, valid, fast = last
    dt = np.diff(time, axis=0, prepend=0.0)
    return Steps(time, dt, valid, steps.knots, fast, steps.slow)


def data(model, seed, rest=False):
    """A run of the model; of a new registered one through the recording that its sources read."""
    if model.name in TOYS:
        belief, steps = toy_models.toy_run(model, parameters(model), seed, rest)
        return Data(scenario.as_arrays(belief.mean), steps, flattened(steps))
    recording = scenario.recording(seed, rest=rest)
    line = timeline.build(model, recording)
    mean = scenario.as_arrays(model.initial_mean(line.first))
    flat = timeline.build(model, recording, slow=()).steps
    return Data(mean, *(rested(steps) for steps in (line.steps, flat)))


def rested(steps):
    """The steps with some of the samples that only a tool at rest has shown as well."""
    for rows in [sensors["rest"] for sensors in (steps.fast, steps.slow) if "rest" in sensors]:
        rows.mask[2::4] = True
    return steps


def start(model, params, mean):
    return Belief(mean, model.initial_covariance(params))


def run_epochs(model, given):
    params = parameters(model)
    return scenario.run_filter(model, params, start(model, params, given.mean), given.epochs)


def masked(steps):
    """The steps with everything hidden."""

    def hide(sensors):
        return {k: rows._replace(mask=np.zeros_like(rows.mask)) for k, rows in sensors.items()}

    return steps._replace(fast=hide(steps.fast), slow=hide(steps.slow))


def assert_tree_close(actual, expected, atol):
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=0, atol=atol), actual, expected)


def moved(model, mean, seed, size=0.3):
    """A state some way off."""
    delta = size * np.random.default_rng([seed, 37]).standard_normal(model.error_dim)
    return manifold.retract(model.space, mean, jnp.asarray(delta))


def input_at(model, steps, k=1, s=-1):
    if model.input is None:
        return None
    time, dt = jnp.asarray(steps.time), jnp.asarray(steps.dt)
    knots = jax.tree.map(jnp.asarray, steps.knots)
    inputs = interpolation.sample(knots, time, dt)
    return jax.tree.map(lambda a: a[k, s], inputs)


every_model = pytest.mark.parametrize("model", MODELS.values(), ids=MODELS.keys())
every_filter = pytest.mark.parametrize(
    # The bilinear form shares all but its measurement with `visual`.
    "name",
    scenario.long_form(list(MODELS), {"visual_bilinear"}),
)


@every_model
def test_retract_and_local(model):
    """A space whose parts do not fit the state, or whose errors do not come back."""
    mean = data(model, 0).mean
    shapes = [leaf.shape for leaf in jax.tree.leaves(mean)]
    assert shapes == [part.manifold.shape for part in manifold.parts(model.space)]
    for seed, size in ((0, 0.0), (1, 1e-9), (2, 0.2)):
        delta = size * np.random.default_rng([seed, 41]).standard_normal(model.error_dim)
        there = manifold.retract(model.space, mean, jnp.asarray(delta))
        back = manifold.local(model.space, mean, there)
        np.testing.assert_allclose(back, delta, rtol=0, atol=1e-14)
    other = moved(model, mean, 5)
    reached = manifold.retract(model.space, mean, manifold.local(model.space, mean, other))
    assert_tree_close(reached, other, 1e-14)


linearise_quickly = scenario.quick_jit(linearisation.linearise_transition, static_argnums=0)


@partial(scenario.quick_jit, static_argnums=0)
def transition_errors(model, params, x, u, dt, deltas, noises):
    """Errors, seen from the prediction, of the transition from moved states with noise."""
    predicted = model.transition(x, u, dt, jnp.zeros(noises.shape[1]), params)

    def error(delta, w):
        there = model.transition(manifold.retract(model.space, x, delta), u, dt, w, params)
        return manifold.local(model.space, predicted, there)

    return jax.vmap(error)(deltas, noises)


@partial(scenario.quick_jit, static_argnums=(0, 1))
def sensor_errors(model, sensor, params, x, u, aux, deltas):
    """Errors of what the sensor is predicted to say, from moved states."""
    expected = sensor.predict(x, u, params, aux)

    def error(delta):
        there = sensor.predict(manifold.retract(model.space, x, delta), u, params, aux)
        return manifold.local(sensor.space, expected, there)

    return jax.vmap(error)(deltas)


def central(errors, step):
    """Columns of a Jacobian from errors at all steps ahead, then all steps behind."""
    ahead, behind = np.split(np.asarray(errors), 2)
    return (ahead - behind).T / (2.0 * step)


def assert_jacobian(actual, expected):
    scale = 1.0 + np.abs(expected).max()
    np.testing.assert_allclose(actual, expected, rtol=0, atol=1e-8 * scale)
    assert np.any(expected != 0.0)


@every_model
@pytest.mark.parametrize("seed", [0, 1])
def test_transition_jacobians(model, seed):
    """A lift or lower that loses part of a derivative, or a transition that jumps."""
    given, params = data(model, 0), parameters(model)
    x, u, dt = moved(model, given.mean, seed), input_at(model, given.flat), jnp.asarray(0.03)
    predicted, f, g = linearise_quickly(model, params, x, u, dt)
    n, m, step = model.error_dim, g.shape[1], 1e-5
    basis = step * np.concatenate([np.eye(n + m), -np.eye(n + m)])
    errors = transition_errors(model, params, x, u, dt, basis[:, :n], basis[:, n:])
    jacobian = central(errors, step)
    assert_jacobian(f, jacobian[:, :n])
    assert_jacobian(g, jacobian[:, n:])
    assert_tree_close(predicted, model.transition(x, u, dt, jnp.zeros(m), params), 1e-15)


@every_model
def test_process_noise_vanishes_with_the_step(model):
    """Padding by dt = 0 that adds noise or moves the state."""
    given, params = data(model, 0), parameters(model)
    np.testing.assert_array_equal(model.process_noise(params, jnp.asarray(0.0)), 0.0)
    x, u = moved(model, given.mean, 3), input_at(model, given.flat)
    predicted, f, _ = linearise_quickly(model, params, x, u, jnp.asarray(0.0))
    np.testing.assert_allclose(f, np.eye(model.error_dim), rtol=0, atol=1e-15)
    assert_tree_close(predicted, x, 1e-15)


@every_model
def test_sensor_jacobians(model):
    """An H that is not the derivative of what is predicted."""
    given, params = data(model, 0), parameters(model)
    x, u = moved(model, given.mean, 2, 0.1), input_at(model, given.flat)
    n, step = model.error_dim, 1e-5
    deltas = step * np.concatenate([np.eye(n), -np.eye(n)])
    seen = given.flat.slow | {
        name: jax.tree.map(lambda a: a[:, -1], rows) for name, rows in given.flat.fast.items()
    }
    for sensor in model.sensors:
        rows = jax.tree.map(lambda a: jnp.asarray(a[1]), seen[sensor.name])
        rows = rows._replace(mask=jnp.ones(sensor.rows, bool))
        _, h, noise = linearisation.linearise_sensor(model, sensor, params, x, u, rows)
        errors = sensor_errors(model, sensor, params, x, u, rows.aux, deltas)
        assert_jacobian(h, central(errors, step))
        assert np.linalg.eigvalsh(noise).min() > 0.0


@every_filter
def test_masked_step_only_predicts(name):
    """A hidden sample that moves the state or scales the covariance, or a wrong prediction."""
    model = MODELS[name]
    given, params = data(model, 0), parameters(model)
    output = run_epochs(model, given._replace(epochs=masked(given.epochs)))
    instants = output.instants
    jax.tree.map(np.testing.assert_array_equal, instants.updated, instants.predicted)
    np.testing.assert_array_equal(instants.log_likelihood, 0.0)
    for innovation in output.innovations.values():
        assert not np.any(innovation.used | innovation.gated)
        np.testing.assert_array_equal(innovation.residual, 0.0)
    in_order = jax.tree.map(
        lambda a: a.reshape(-1, *a.shape[2:]), (instants.updated, output.inputs)
    )
    before, _ = jax.tree.map(lambda a: a[-2], in_order)
    after, u = jax.tree.map(lambda a: a[-1], in_order)
    dt = jnp.asarray(given.epochs.dt[-1, -1])
    assert dt > 0.0
    predicted, f, g = linearise_quickly(model, params, before.mean, u, dt)
    cov = f @ before.cov @ f.T + g @ model.process_noise(params, dt) @ g.T
    assert_tree_close(after, Belief(predicted, cov), 1e-13)


@every_filter
def test_partly_masked_run(name):
    """A covariance that is lopsided or not definite; instants without samples that are not pure
    prediction; samples that are there but not used."""
    model = MODELS[name]
    given = data(model, 1)
    for rows in (given.epochs.fast | given.epochs.slow).values():
        rows.mask[3] = False
    output = run_epochs(model, given)
    instants = output.instants
    cov = np.asarray(instants.updated.cov)
    np.testing.assert_array_equal(cov, np.swapaxes(cov, -1, -2))
    assert np.linalg.eigvalsh(cov).min() > 0.0
    assert np.all(instants.healthy)
    seen = np.zeros(given.epochs.dt.shape, bool)
    for name, rows in given.epochs.fast.items():
        seen |= rows.mask.any(axis=-1)
        used = output.innovations[name].used | output.innovations[name].gated
        np.testing.assert_array_equal(used, rows.mask)
    for name, rows in given.epochs.slow.items():
        seen[:, -1] |= rows.mask.any(axis=-1)
        used = output.innovations[name].used | output.innovations[name].gated
        np.testing.assert_array_equal(used, rows.mask)
    assert seen.any()
    assert not seen.all()
    jax.tree.map(
        lambda a, b: np.testing.assert_array_equal(np.asarray(a)[~seen], np.asarray(b)[~seen]),
        instants.updated,
        instants.predicted,
    )
    trace = np.trace(cov, axis1=-2, axis2=-1)
    before = np.trace(np.asarray(instants.predicted.cov), axis1=-2, axis2=-1)
    assert np.all(trace[seen] < before[seen])


@every_filter
def test_one_compilation(name):
    """A filter that is compiled again for other values, masks or parameters of the same shape."""
    model = MODELS[name]
    run_epochs(model, data(model, 0))
    compiled = scenario.run_filter._cache_size()
    first = run_epochs(model, data(model, 2)).instants.log_likelihood
    second = run_epochs(model, data(model, 3)).instants.log_likelihood
    run_epochs(model, data(model, 3, rest=True))
    assert scenario.run_filter._cache_size() == compiled
    assert first.shape == second.shape
    assert np.any(first != second)


# Of every model, `test_naive` holds runs filtered together against runs filtered one by one, and sensors
# that are all linearised at the prediction. Below: one model whose IMU is input, and one that has none.
CORE = {"markers", "loose_rate"}


@pytest.mark.parametrize("name", scenario.long_form(list(MODELS), set(MODELS) - CORE))
def test_many_runs(name):
    """Runs that leak into each other, or lanes that are transposed on the way in or out."""
    model = MODELS[name]
    params = parameters(model)
    runs = []
    for seed in (0, 1, 2):
        given = data(model, seed)
        scaled = jax.tree.map(lambda a, seed=seed: (1.0 + 0.1 * seed) * a, params)
        belief = start(model, scaled, given.mean)
        expected = scenario.run_filter(model, scaled, belief, given.epochs)
        runs.append((scaled, belief, given.epochs, expected))
    params, beliefs, steps, expected = (
        jax.tree.map(lambda *leaves: jnp.stack([jnp.asarray(a) for a in leaves]), *part)
        for part in zip(*runs, strict=True)
    )
    batch = scenario.quick_jit(partial(ekf.run_filter_batch, model))(params, beliefs, steps)
    mapped = scenario.quick_jit(jax.vmap(partial(ekf.run_filter, model)))(params, beliefs, steps)
    ends = [
        np.asarray(jax.tree.leaves(e.instants.updated.mean)[0])[-1] for e in (r[3] for r in runs)
    ]
    assert np.abs(ends[0] - ends[1]).max() > 1e-6
    assert_tree_close(batch, expected, 1e-9)
    assert_tree_close(mapped, expected, 1e-9)


def renamed(model):
    """The model with its sensors the other way round, in order and by name."""
    names = {s.name: f"{len(model.sensors) - i}_{s.name}" for i, s in enumerate(model.sensors)}
    sensors = tuple(dataclasses.replace(s, name=names[s.name]) for s in reversed(model.sensors))
    return dataclasses.replace(model, sensors=sensors), names


SEVERAL = [name for name, model in MODELS.items() if len(model.sensors) > 1]


@pytest.mark.parametrize("name", scenario.long_form(SEVERAL, set(SEVERAL) - CORE))
def test_order_of_sensors(name):
    """A sensor that is linearised at a state which another has already moved."""
    model, params = MODELS[name], parameters(MODELS[name])
    given = data(model, 0)
    expected = run_epochs(model, given)
    other, names = renamed(model)
    steps = given.epochs._replace(
        fast={names[k]: rows for k, rows in given.epochs.fast.items()},
        slow={names[k]: rows for k, rows in given.epochs.slow.items()},
    )
    assert sorted(names.values()) == [names[k] for k in reversed([s.name for s in model.sensors])]
    belief = start(model, params, given.mean)
    output = scenario.run_filter_quick(other, params, belief, steps)
    assert_tree_close(output.instants, expected.instants, 1e-10)
    for sensor in names:
        assert_tree_close(output.innovations[names[sensor]], expected.innovations[sensor], 1e-8)


@pytest.mark.parametrize(
    ("name", "sensor", "group", "error"),
    [("visual", "camera", (2, 3), 500.0), ("markers", "marker_1", (0, 1, 2), 5.0)],
)
def test_gate_rejects_one_group(name, sensor, group, error):
    """A gate that lets a gross error in, throws good groups out too, or leaves a trace of it."""
    model, rows = MODELS[name], list(group)
    given = data(model, 4)
    samples = given.epochs.slow[sensor]
    epoch = int(np.flatnonzero(samples.mask[1:, rows].all(axis=-1))[0]) + 1
    value, mask = samples.value.copy(), samples.mask.copy()
    value[epoch, rows] += error
    mask[epoch, rows] = False

    def with_rows(changed):
        slow = given.epochs.slow | {sensor: changed}
        return run_epochs(model, given._replace(epochs=given.epochs._replace(slow=slow)))

    gated, hidden = with_rows(samples._replace(value=value)), with_rows(samples._replace(mask=mask))
    expected = np.zeros_like(mask[epoch])
    expected[rows] = True
    np.testing.assert_array_equal(gated.innovations[sensor].gated[epoch], expected)
    np.testing.assert_array_equal(gated.innovations[sensor].used[epoch], mask[epoch])
    for other, innovation in gated.innovations.items():
        np.testing.assert_array_equal(innovation.used, hidden.innovations[other].used)
    assert sum(int(i.used.sum()) for i in gated.innovations.values()) > 20
    assert_tree_close(gated.instants, hidden.instants, 1e-12)


# A random linear system shows the rest: here everything can be written down.

RNG = np.random.default_rng(43)
TURN = np.eye(4) + 0.1 * RNG.standard_normal((4, 4))
SLOPE = RNG.standard_normal((4, 4))
NOISE = scenario.factor(50, 4, 0.5) @ scenario.factor(50, 4, 0.5).T
PUSH = 0.1 * np.eye(4)
VALUES = RNG.standard_normal((5, 4))


def linear_run(model: Model, values, mask):
    count = len(values)
    time = np.arange(1.0, count + 1.0)[:, None]
    rows = Rows(values[:, None], None, mask[:, None], np.ones((count, 1)))
    steps = Steps(time, np.ones_like(time), time > 0.0, None, {"sensor_0": rows}, {})
    belief = Belief(jnp.zeros(4), jnp.eye(4))
    return scenario.run_filter_quick(model, model.parameters, belief, steps)


LINEAR = toy_models.linear_model(TURN, PUSH, [SLOPE], [NOISE])
GATED = toy_models.linear_model(TURN, PUSH, [SLOPE], [NOISE], gate=0.99)


@pytest.mark.parametrize("kept", [[0, 2], [3], [1, 2, 3]])
def test_hidden_rows_are_removed_rows(kept):
    """Whitening by the factor of the whole R, whose hidden rows are correlated with the others."""
    assert np.abs(NOISE - np.diag(np.diag(NOISE))).max() > 0.05
    mask = np.zeros((5, 4), bool)
    mask[:, kept] = True
    output = linear_run(LINEAR, VALUES, mask)
    smaller = toy_models.linear_model(TURN, PUSH, [SLOPE[kept]], [NOISE[np.ix_(kept, kept)]])
    expected = linear_run(smaller, VALUES[:, kept], mask[:, kept])
    assert_tree_close(output.instants, expected.instants, 1e-12)
    innovation, removed = output.innovations["sensor_0"], expected.innovations["sensor_0"]
    np.testing.assert_allclose(innovation.nis, removed.nis, rtol=1e-12)
    np.testing.assert_allclose(innovation.residual[..., kept], removed.residual, atol=1e-12)


def test_gate_bound_follows_the_visible_rows():
    """A bound for all rows of a group where some are hidden, or one of another probability."""
    cov = SLOPE @ (TURN @ TURN.T + PUSH) @ SLOPE.T + NOISE
    for visible in ([0, 1, 2, 3], [0, 1], [2]):
        bound = chi2.ppf(0.99, len(visible))
        mask = np.zeros((1, 4), bool)
        mask[0, visible] = True
        root = np.linalg.cholesky(cov[np.ix_(visible, visible)])
        for factor, passes in ((0.999, True), (1.001, False)):
            values = np.zeros((1, 4))
            direction = root @ np.ones(len(visible)) / np.sqrt(len(visible))
            values[0, visible] = np.sqrt(factor * bound) * direction
            innovation = linear_run(GATED, values, mask).innovations["sensor_0"]
            np.testing.assert_allclose(innovation.nis[0, 0], factor * bound, rtol=1e-10)
            np.testing.assert_array_equal(innovation.used[0, 0], mask[0] & passes)
            np.testing.assert_array_equal(innovation.gated[0, 0], mask[0] & (not passes))


def test_visible_nan():
    """A NaN that a gate lets in, or that without a gate passes for a healthy result."""
    values = VALUES.copy()
    values[2, 1] = np.nan
    mask = np.ones((5, 4), bool)
    gated = linear_run(GATED, values, mask)
    assert np.all(gated.innovations["sensor_0"].gated[2])
    assert np.isfinite(gated.instants.updated.mean).all()
    assert np.all(gated.instants.healthy)
