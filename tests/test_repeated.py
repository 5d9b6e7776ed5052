"""Samples of many like groups, taken one group at a time: the same as all rows at once."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scenario
import toy_models

from jaxekf._support.errors import ModelError
from jaxekf.filtering import ekf, iterated_smoother, smoother
from jaxekf.filtering.model import Sensor, repeated
from jaxekf.filtering.steps import Rows
from jaxekf.geometry.manifold import SO3, Euclidean


def correlated(params, aux, dt):
    """Noise of a point whose two rows go together."""
    sigma = params.noise.camera_scale * aux.sigma
    return sigma * sigma * jnp.array([[1.0, 0.3], [0.3, 1.0]])


def with_camera(point, count=4, *, whole=False):
    """The small toy model with another camera; `whole` takes all rows of an image at once."""
    camera = repeated(point, count)
    camera = replace(camera, single_group=None) if whole else camera
    return replace(toy_models.POINTS, sensors=(camera,))


def a_run(model):
    """A run in which one point is a mismatch, and one image is wholly off."""
    belief, steps = toy_models.toy_run(model, model.parameters, 3)
    value = steps.slow["camera"].value.copy()
    value[2, 2] += 1.0
    value[4] += 5.0
    steps = steps._replace(slow={"camera": steps.slow["camera"]._replace(value=value)})
    return jax.tree.map(jnp.asarray, (belief, steps))


def assert_same(one, other, atol=1e-11):
    for a, b in zip(jax.tree.leaves(one), jax.tree.leaves(other), strict=True):
        scale = 1.0 + np.max(np.abs(b), initial=0.0)
        np.testing.assert_allclose(a, b, rtol=0, atol=atol * scale)


@pytest.mark.parametrize(
    "changes", scenario.long_form(["gate", "student", "both"], {"gate", "student"})
)
def test_groups_are_the_rows_of_one_sample(changes):
    """Would catch groups that are linearised where another moved the state, gates that look at another
    group's rows, weights that are another's, and a derivative that lacks a group."""
    kinds = {"gate": (0.99, None), "student": (None, "student"), "both": (0.99, "student")}
    gate, weighting = kinds[changes]
    point = replace(toy_models.POINT, gate=gate, weighting=weighting, noise=correlated)
    belief, steps = a_run(with_camera(point))

    def found(model):
        def total(params):
            output = ekf.run_filter(model, params, belief, steps)
            told = (output.instants.updated, output.instants.log_likelihood)
            return sum(jnp.sum(jnp.sin(a + 0.3)) for a in jax.tree.leaves(told)), output

        return scenario.quick_jit(jax.value_and_grad(total, has_aux=True))(model.parameters)

    one, other = (found(with_camera(point, whole=whole)) for whole in (False, True))
    assert_same(one, other)
    gated = np.asarray(one[0][1].innovations["camera"].gated)
    if gate is not None:
        assert gated[2, 2:4].all()
        assert gated.any(axis=1).sum() >= 2
    used = np.asarray(one[0][1].innovations["camera"].used)
    assert 10 < used.sum() < used.size


@pytest.mark.parametrize("kind", ["smoothed", "relinearised"])
def test_smoothers_go_back_through_groups(kind):
    """Would catch a way back that takes the groups in the order of the way there."""
    point = replace(toy_models.POINT, noise=correlated)
    belief, steps = a_run(with_camera(point))

    def found(model):
        def run(params):
            if kind == "relinearised":
                return ekf.run_filter(model, params, belief, steps, relinearise=1).instants
            back = smoother.run_smoother(model, params, belief, steps)
            return back.smoothed, back.start

        return scenario.quick_jit(run)(model.parameters)

    assert_same(*(found(with_camera(point, whole=whole)) for whole in (False, True)))


@pytest.mark.skipif(not scenario.LONG, reason="long form: set JAXEKF_LONG=1")
def test_the_iterated_smoother_takes_groups():
    """Would catch the same in the smoother that iterates."""
    belief, steps = a_run(with_camera(toy_models.POINT))

    def found(model):
        def run(params):
            return iterated_smoother.run_iterated_smoother(
                model, params, belief, steps, iterations=2
            )

        return scenario.quick_jit(run)(model.parameters)

    assert_same(*(found(with_camera(toy_models.POINT, whole=whole)) for whole in (False, True)))


def more_points(steps, times):
    """The steps with every point of an image so many times."""

    def many(a):
        return jnp.concatenate([a] * times, axis=1)

    rows = steps.slow["camera"]
    rows = Rows(many(rows.value), jax.tree.map(many, rows.aux), many(rows.mask), rows.dt)
    return steps._replace(slow={"camera": rows})


def operations(jaxpr):
    """Number of operations of a program, those of its parts included."""
    total = 0
    for eqn in jaxpr.eqns:
        total += 1
        for value in jax.tree.leaves(
            list(eqn.params.values()), is_leaf=lambda v: hasattr(v, "eqns")
        ):
            value = getattr(value, "jaxpr", value)
            if hasattr(value, "eqns"):
                total += operations(value)
    return total


def test_programs_do_not_grow_with_groups():
    """Would catch rows that are written out: sixty of them would take minutes to compile."""
    belief, steps = a_run(with_camera(toy_models.POINT))
    sizes = []
    for times in (1, 8):
        model = with_camera(toy_models.POINT, 4 * times)

        def total(params, model=model, times=times):
            output = ekf.run_filter(model, params, belief, more_points(steps, times), keep="means")
            return jnp.sum(output.instants.log_likelihood)

        sizes.append(operations(jax.make_jaxpr(total)(model.parameters).jaxpr))
    assert sizes[1] <= 1.01 * sizes[0]


def test_what_cannot_be_repeated_is_refused():
    """Would catch a sample that is no vector, put together as if it were one."""
    attitude = Sensor("attitude", SO3(), lambda *_: 0, lambda *_: 0)
    with pytest.raises(ModelError, match="expected one or more in Euclidean"):
        repeated(attitude, 3)
    with pytest.raises(ModelError, match="got 0 groups"):
        repeated(toy_models.POINT, 0)
    with pytest.raises(ModelError, match="got 2 labels, expected 6"):
        repeated(toy_models.POINT, 3, ["u", "v"])
    named = repeated(replace(toy_models.POINT, space=Euclidean(2, "px")), 2, ["a", "b", "c", "d"])
    assert named.space == Euclidean(4, "px", ("a", "b", "c", "d"))
    assert named.copies == 2
    assert named.group_rows == ((0, 1), (2, 3))
