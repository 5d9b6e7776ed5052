"""What makes the filter fast must not show: structure found, runs in lanes, the adjoint, padding."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scenario

import tuning
from jaxekf import estimate_many, jit, run_filter
from jaxekf._support.errors import ModelError
from jaxekf.estimation import batch, padding, timeline
from jaxekf.filtering import _recursion as recursion
from jaxekf.filtering import ekf
from jaxekf.filtering.lowering import batching, lanes, scalar_graph, sparsity, structured_matrix
from jaxekf.filtering.model import Belief
from jaxekf.models import get_model
from jaxekf.simulation import attitude_runs
from tuning.search import evaluation


def test_structure_is_found_where_it_is():
    """A row called the identity that is not, or a slope called constant that moves, is a wrong answer;
    one not found costs speed."""
    x = jnp.ones(3)

    def function(x):
        matrix = jnp.array([[1.0, 0.0, 2.0], [0.0, 0.0, 1.0], [0.0, 1.0, 0.0]])
        first = jnp.concatenate([x[:1], jnp.ones(2)])
        return matrix * first[:, None] + jnp.zeros((3, 3)) * x[None]

    found = sparsity.known_entries(scalar_graph.trace(function, x))
    expected = np.array([[False, True, False], [True] * 3, [True] * 3])
    np.testing.assert_array_equal(found.known, expected)
    np.testing.assert_array_equal(found.value[1:], [[0, 0, 1], [0, 1, 0]])
    form = structured_matrix.find_pattern(found)
    assert form.bands == (((0,), (0, 2)),)


def test_what_is_not_understood_is_not_called_known():
    """An operation without a rule that is taken for constant."""
    opaque = sparsity.known_entries(scalar_graph.trace(lambda x: jnp.sort(x) * 1.0, jnp.ones(3)))
    assert not opaque.known.any()
    mixed = sparsity.known_entries(
        scalar_graph.trace(lambda x: jnp.sort(x.at[1:].set(0.0)), jnp.ones(3))
    )
    assert not mixed.known.any()


@pytest.mark.parametrize("name", ["plain", "sort", "cumsum", "while", "cond", "solve"])
def test_values_on_lanes_are_those_of_the_function(name):
    """A rule that moves an axis to the wrong place, or an operation without one put back wrongly."""
    functions = {
        "plain": lambda x, m: (
            jnp.where(
                x > 0, jnp.einsum("ij,kj->ki", m, m[::-1]) @ x, jnp.cross(x, jnp.pad(x[1:], (1, 0)))
            )
            + jnp.max(m, axis=1) * jnp.sum(m[:, :2].T, axis=0) / jnp.arctan2(x, 2.0)
        ),
        "sort": lambda x, m: jnp.sort(x)[::-1] + m[0, 0] * 2.0,
        "cumsum": lambda x, m: jnp.cumsum(x) @ m,
        "while": lambda x, m: jax.lax.fori_loop(0, 3, lambda i, y: y @ m + 1.0, x),
        "cond": lambda x, m: jax.lax.cond(x[0] > 0, lambda: x * 2, lambda: x - 1) @ m,
        "solve": lambda x, m: jnp.linalg.solve(m, x) / jnp.max(jnp.abs(x)),
    }
    rng = np.random.default_rng(0)
    x, m = rng.normal(size=(5, 3)), np.eye(3) + 0.1 * rng.normal(size=(5, 3, 3))
    program = scalar_graph.trace(functions[name], x[0], m[0])
    values = [jnp.moveaxis(jnp.asarray(a), 0, -1) for a in (x, m)]
    found = jnp.moveaxis(lanes.evaluate(sparsity.simplify(program), values), -1, 0)
    np.testing.assert_allclose(found, jax.vmap(functions[name])(x, m), rtol=1e-13, atol=1e-14)


def moving(name, seed, seconds=1.0):
    motion = attitude_runs.free_motion(seed, speed_deg=60.0, rest_s=0.1)
    return attitude_runs.recording(name, motion, seed=seed, duration_s=seconds)


def problem(model, seed):
    """One short run of a registered model: parameters, belief, steps and timeline."""
    line = timeline.build(model, moving("run", seed))
    params = jax.tree.map(lambda a: jnp.asarray(a, float), model.parameters)
    belief = ekf.initial_belief(model, params, line.first)
    return params, belief, jax.tree.map(jnp.asarray, line.steps), line


def first_epochs(steps, count):
    """The first epochs; the input keeps its knots."""
    cut = jax.tree.map(lambda a: a[:count], steps._replace(knots=None))
    return cut._replace(knots=steps.knots)


def total(model, weights, adjoint, params, belief, steps):
    """A number that every kept output moves: means, covariances, innovations, S and likelihood."""
    output = run_filter(model, params, belief, steps, adjoint=adjoint)
    leaves = jax.tree.leaves((output.instants, output.innovations))
    floats = [a for a in leaves if jnp.issubdtype(a.dtype, jnp.floating)]
    rng = np.random.default_rng(weights)
    return sum(jnp.sum(a * rng.normal(size=a.shape)) / a.size for a in floats)


def assert_tree_close(found, expected, tolerance):
    for a, b in zip(jax.tree.leaves(found), jax.tree.leaves(expected), strict=True):
        scale = max(float(np.max(np.abs(b), initial=0.0)), 1e-300)
        np.testing.assert_allclose(a, b, rtol=0, atol=tolerance * scale)


@pytest.mark.parametrize("name", ["loose", "loose_additive"])
def test_adjoint_is_jax_own_gradient(name):
    """A cotangent that is lost or counted twice, on any output, to noise, calibration, belief or data."""
    model = get_model(name)
    params, belief, steps, _ = problem(model, 3)
    steps = first_epochs(steps, 6)

    def value(adjoint, params, belief):
        return total(model, 5, adjoint, params, belief, steps)

    found = scenario.quick_jit(jax.grad(partial(value, True), argnums=(0, 1)))(params, belief)
    expected = scenario.quick_jit(jax.grad(partial(value, False), argnums=(0, 1)))(params, belief)
    symmetric = expected[1]._replace(cov=0.5 * (expected[1].cov + expected[1].cov.T))
    found = found[0], found[1]._replace(cov=0.5 * (found[1].cov + found[1].cov.T))
    assert_tree_close(found, (expected[0], symmetric), 1e-9)


def small():
    """A model small enough to differentiate twice."""
    model = get_model("loose_additive")
    params, belief, steps, _ = problem(model, 1)
    return model, params, belief, first_epochs(steps, 4)


def test_adjoint_composes():
    """`vmap` of the gradient, the gradient of `vmap`, `vmap` in `vmap`, and forward over reverse."""
    model, params, belief, steps = small()
    scales = jnp.array([[0.5, 2.0], [1.5, 0.7]])

    def value(adjoint, scale):
        noise = jax.tree.map(lambda a: a * scale, params.noise)
        output = run_filter(
            model, params._replace(noise=noise), belief, steps, keep="means", adjoint=adjoint
        )
        return jnp.sum(output.instants.log_likelihood) + sum(
            jnp.sum(a**2) for a in jax.tree.leaves(output.instants.updated.mean)
        )

    own, plain = partial(value, True), scenario.quick_jit(jax.grad(partial(value, False)))
    slope = scenario.quick_jit(jax.vmap(jax.vmap(jax.grad(own))))(scales)
    expected = np.array([[plain(s) for s in row] for row in scales])
    np.testing.assert_allclose(slope, expected, rtol=1e-9)
    summed = scenario.quick_jit(jax.grad(lambda s: jnp.sum(jax.vmap(own)(s))))(scales[0])
    np.testing.assert_allclose(summed, expected[0], rtol=1e-9)
    twice = jax.jacrev(lambda s: jnp.stack([own(s), 2.0 * own(s)]))
    both = scenario.quick_jit(twice)(scales[0, 0])
    np.testing.assert_allclose(both, expected[0, 0] * np.array([1.0, 2.0]), rtol=1e-9)
    curvature = scenario.quick_jit(jax.vmap(jax.jacfwd(jax.grad(own))))(scales[0])
    step = 1e-4
    for at, found in zip(scales[0], curvature, strict=True):
        numeric = (plain(at + step) - plain(at - step)) / (2 * step)
        np.testing.assert_allclose(found, numeric, rtol=1e-5)


def test_forward_mode_names_the_way_out():
    """A forward derivative that fails with a message about JAX's inside, or is silently zero."""
    model, params, belief, steps = small()

    def value(scale, adjoint):
        noise = jax.tree.map(lambda a: a * scale, params.noise)
        output = run_filter(model, params._replace(noise=noise), belief, steps, adjoint=adjoint)
        return jnp.sum(output.instants.log_likelihood)

    with pytest.raises(ModelError, match="adjoint=False"):
        jax.jvp(lambda s: value(s, True), (1.0,), (1.0,))
    forward = jit(lambda s: jax.jvp(lambda s: value(s, False), (s,), (1.0,))[1])(1.0)
    reverse = jit(jax.grad(lambda s: value(s, True)))(1.0)
    np.testing.assert_allclose(forward, reverse, rtol=1e-9)
    with pytest.raises(ModelError, match="'nothing'"):
        run_filter(model, params, belief, steps, keep="nothing")


def test_data_may_be_constants():
    """A compiler that aborts where runs are written into the program instead of handed to it."""
    model = get_model("loose")
    data = tuning.prepare(model, [moving("a", 1, 20.0), moving("b", 2, 20.0)])
    params = jax.tree.map(lambda a: jnp.asarray(a, float), model.parameters)
    objective = tuning.innovation_likelihood()
    inside = jit(lambda params: tuning.evaluate(model, objective, params, data))(params)
    handed = jit(lambda params, data: tuning.evaluate(model, objective, params, data))(params, data)
    np.testing.assert_allclose(inside, handed, rtol=1e-12)


def test_segments_change_nothing(monkeypatch):
    """A belief kept at the wrong epoch, or the padding of the last segment that is not inert."""
    model = get_model("loose")
    params, belief, steps, _ = problem(model, 2)
    steps = first_epochs(steps, 23)

    def slopes():
        recursion._with_adjoint.cache_clear()
        return jit(
            jax.grad(lambda p: jnp.sum(run_filter(model, p, belief, steps).instants.log_likelihood))
        )(params)

    whole = slopes()
    monkeypatch.setattr(recursion, "segment_length", lambda *sizes: 5)
    assert_tree_close(slopes(), whole, 1e-12)
    recursion._with_adjoint.cache_clear()


def test_what_is_not_kept_changes_nothing():
    """Estimates that depend on what is recorded of them."""
    model, params, belief, steps = small()
    every = run_filter(model, params, belief, steps)
    some = run_filter(model, params, belief, steps, keep="estimates")
    means = run_filter(model, params, belief, steps, keep="means")
    assert_tree_close(some.instants.updated, every.instants.updated, 1e-14)
    assert_tree_close(means.instants.updated.mean, every.instants.updated.mean, 1e-14)
    assert means.instants.updated.cov is None and some.instants.predicted is None
    assert means.innovations == {}


def test_blocks_of_runs(monkeypatch):
    """A run that changes when it stands in another block, beside others, or beside filling."""
    monkeypatch.setattr(batching, "LANES", 2)
    recursion._with_adjoint.cache_clear()
    model, params, belief, steps = small()
    factors = jnp.linspace(0.5, 1.5, 5)
    every = jax.vmap(lambda f: jax.tree.map(lambda a: a * f, params))(factors)
    spread = jax.tree.map(lambda a: jnp.broadcast_to(a, (5, *a.shape)), (belief, steps))

    def value(params):
        output = ekf.run_filter_batch(model, params, *spread)
        return jnp.sum(output.instants.log_likelihood), output.instants.updated.cov

    (_, covs), slopes = jit(jax.value_and_grad(value, has_aux=True))(every)
    recursion._with_adjoint.cache_clear()
    monkeypatch.undo()

    def single(params):
        output = run_filter(model, params, belief, steps)
        return jnp.sum(output.instants.log_likelihood), output.instants.updated.cov

    alone = jit(jax.value_and_grad(single, has_aux=True))
    for i in range(5):
        (_, cov), slope = alone(jax.tree.map(lambda a, i=i: a[i], every))
        assert_tree_close(covs[i], cov, 1e-12)
        assert_tree_close(jax.tree.map(lambda a, i=i: a[i], slopes), slope, 1e-11)


def test_runs_of_many_lengths_compile_few_programs():
    """A program for each length, one more at each call, or padding that is not inert."""
    lengths = np.random.default_rng(4).uniform(0.86, 1.0, 6)
    runs = [moving(f"run{i}", i, length) for i, length in enumerate(lengths)]
    lines = timeline.build_many(get_model("loose"), runs)
    buckets = len(padding.groups(lines))
    assert buckets < len(runs)
    batch._run.clear_cache()
    found = estimate_many(runs, "loose")
    assert batch._run._cache_size() <= buckets
    compiled = batch._run._cache_size()
    estimate_many(runs, "loose")
    assert batch._run._cache_size() == compiled
    model = get_model("loose")
    params = jax.tree.map(jnp.asarray, model.parameters)
    for i in (0, 4):
        belief = ekf.initial_belief(model, params, lines[i].first)
        alone = run_filter(model, params, belief, jax.tree.map(jnp.asarray, lines[i].steps))
        cov = np.asarray(alone.instants.updated.cov)[lines[i].valid]
        assert_tree_close(found[i].cov, cov, 1e-12)
    evaluation._value_and_gradient.clear_cache()
    tuned = tuning.tune(runs, model="loose", objective="likelihood", iterations=2)
    assert evaluation._value_and_gradient._cache_size() <= buckets
    whole_data = tuning.prepare(model, runs)
    alone = tuning.evaluate(model, tuned.objective, tuned.start, whole_data)
    np.testing.assert_allclose(tuned.history[0].training, alone, rtol=1e-10)


def test_a_batch_larger_than_memory(monkeypatch):
    """Runs lost or mixed up where a group is taken in several batches, the last one filled."""
    runs = [moving(f"run{i}", i) for i in range(3)]
    expected = estimate_many(runs, "loose")
    monkeypatch.setattr(batch, "_BATCH_BYTES", 1)
    found = estimate_many(runs, "loose")
    for a, b in zip(found, expected, strict=True):
        assert a.run == b.run
        assert_tree_close(a.cov, b.cov, 1e-12)


def test_belief_is_named():
    """`Updated` and `Belief` are read alike."""
    assert ekf.Updated._fields == Belief._fields
