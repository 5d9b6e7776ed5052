"""Searches without gradients: they do what they are said to do, on the objective that the tuner has."""

import jax
import numpy as np
import pytest

import tuning
from jaxekf import get_model
from jaxekf._support.errors import TuningError
from jaxekf.estimation.parameters import as_arrays
from jaxekf.simulation import attitude_runs
from tuning.objective import covariance_scale, objectives
from tuning.search import derivative_free, descent


def quadratic(x):
    return float((x[0] - 3.0) ** 2 + 4.0 * (x[1] + 0.5) ** 2)


def as_described(start, sweeps):
    """Two numbers, 10 % of the first and 0.25 in the second, written out from the description."""
    (x, y), (share, step), best = start, (0.1, 0.25), quadratic(start)
    evaluations = 1
    for _ in range(sweeps):
        better = False
        for factor in (1.0 + share, 1.0 - share):
            evaluations += 1
            if quadratic((x * factor, y)) < best:
                x, better = x * factor, True
                best = quadratic((x, y))
                break
        share *= 1.1 if better else 0.5
        better = False
        for change in (step, -step):
            evaluations += 1
            if quadratic((x, y + change)) < best:
                y, better = y + change, True
                best = quadratic((x, y))
                break
        step *= 1.1 if better else 0.5
    return (x, y), evaluations


@pytest.mark.parametrize("sweeps", [1, 2, 20])
def test_coordinate_search_is_as_described(sweeps):
    """Would catch steps that grow or shrink otherwise, or a second trial that is not counted."""
    found = derivative_free.coordinate_search(
        quadratic,
        np.array([1.0, 0.0]),
        step=np.array([0.1, 0.25]),
        relative=np.array([True, False]),
        sweeps=sweeps,
    )
    expected, evaluations = as_described((1.0, 0.0), sweeps)
    np.testing.assert_allclose(found.best, expected, rtol=1e-12)
    assert found.evaluations == evaluations
    assert found.value == quadratic(found.best) == found.history[-1].value
    values = [step.value for step in found.history]
    assert values == sorted(values, reverse=True)
    if sweeps == 20:
        np.testing.assert_allclose(found.best, [3.0, -0.5], atol=0.05)


def test_a_value_that_is_not_finite_is_never_kept():
    """Would catch a search that walks into NaN: every second point is one."""
    calls = []

    def holes(x):
        calls.append(x)
        return float("nan") if len(calls) % 2 == 0 else quadratic(x)

    found = derivative_free.coordinate_search(
        holes, np.ones(2), step=np.full(2, 0.1), relative=np.zeros(2, bool), sweeps=5
    )
    assert found.value == quadratic(found.best) < quadratic(np.ones(2))


def test_nelder_mead_stays_within_its_evaluations():
    """Would catch evaluations that are not counted, or a best that is not the lowest one seen."""
    seen = []

    def watched(x):
        seen.append(quadratic(x))
        return seen[-1]

    found = derivative_free.nelder_mead(watched, np.ones(2), step=np.full(2, 0.3), evaluations=60)
    assert found.evaluations == len(seen) <= 60
    assert found.value == min(seen)
    np.testing.assert_allclose(found.best, [3.0, -0.5], atol=0.05)


@pytest.fixture(scope="module")
def runs():
    return [
        attitude_runs.recording(
            f"run-{i}", attitude_runs.free_motion(i, rest_s=0.2), seed=i, duration_s=3.0
        )
        for i in range(2)
    ]


@pytest.fixture(scope="module")
def start():
    base = as_arrays(get_model("loose").parameters)
    return base._replace(noise=jax.tree.map(lambda a: 5.0 * a, base.noise))


FREE = ("noise", "calibration.clock_offset")


@pytest.mark.parametrize("objective", ["likelihood", "map"])
@pytest.mark.parametrize(
    ("search", "limit"),
    [
        (tuning.tune_by_coordinates, {"sweeps": 3}),
        (tuning.tune_by_nelder_mead, {"evaluations": 40}),
    ],
    ids=["coordinates", "Nelder-Mead"],
)
def test_both_lower_the_objective_of_the_tuner(runs, start, search, limit, objective):
    """Would catch another objective than the tuner's, or parameters that are not the best."""
    found = search(runs, start=start, objective=objective, free=FREE, axes="full", **limit)
    assert len(found.free) == 19
    first, last = found.history[0], found.history[-1]
    assert first.evaluations == 1
    assert last.value == found.value < first.value - 0.02
    assert found.evaluations >= last.evaluations
    given, where = (get_model("loose"), objectives.parse(objective)), found.layout
    groups = tuning.objective.data.prepare_groups(given[0], runs, need_truth=False)
    tuner = descent.Descent(*given, where, found.start, groups, groups, iterations=1)
    off = (found.free - np.asarray(where.to_free(found.start))) / where.prior
    rows = int(objectives.visible_rows(groups[0]))
    prior = 0.5 * given[1].prior * float(off @ off) / rows
    assert found.value == pytest.approx(tuner.validation_value(found.free) + prior, rel=1e-12)
    np.testing.assert_allclose(where.to_free(found.params), found.free, atol=1e-12)
    assert (prior > 1e-7) == (objective == "map")


def test_an_error_alone_is_rescaled_as_the_tuner_does(runs, start):
    """Would catch covariances whose size nothing has fixed, a scale that moves the best, or a filtering for
    it that is not counted."""
    found = tuning.tune_by_coordinates(runs, start=start, objective="attitude", sweeps=1)
    groups = tuning.objective.data.prepare_groups(found.model, runs)
    assert covariance_scale.scale(found.model, found.params, groups, found.layout) == pytest.approx(
        1.0
    )
    assert found.filterings == found.evaluations + 1
    plain = tuning.tune_by_coordinates(
        runs, start=start, objective="attitude", sweeps=1, rescale=False
    )
    assert plain.scale == 1.0
    assert plain.filterings == plain.evaluations == found.evaluations
    assert plain.value == found.value
    factors = jax.tree.map(lambda a, b: a / b, found.params.noise, plain.params.noise)
    np.testing.assert_allclose(jax.tree.leaves(factors), np.sqrt(found.scale), rtol=1e-12)
    assert abs(found.scale - 1.0) > 0.05


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda runs: tuning.tune_by_coordinates(runs, sweeps=0), "0 sweeps"),
        (lambda runs: tuning.tune_by_nelder_mead(runs, evaluations=3), "3 evaluations"),
        (lambda runs: tuning.tune_by_coordinates([]), "no run"),
        (
            lambda runs: derivative_free.nelder_mead(
                lambda x: float("nan"), np.ones(1), step=np.ones(1), evaluations=9
            ),
            "not finite at the start",
        ),
    ],
)
def test_nonsense_is_refused_in_a_sentence(runs, call, words):
    """Would catch a stack trace where a sentence is due."""
    with pytest.raises(TuningError, match=words) as caught:
        call(runs)
    assert "expected" in str(caught.value)
