"""The tuner: planted noise is found again (row 8), the best is kept, bad steps are refused."""

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
import scenario
from hypothesis import given
from hypothesis import strategies as st

import jaxekf
import tuning
from jaxekf._support.errors import TuningError
from jaxekf.estimation.parameters import as_arrays
from jaxekf.simulation import attitude_runs
from tuning.objective import objectives
from tuning.parametrisation import free_vector
from tuning.search import _line_search as line_search

PLANTED = {"gyroscope": 0.05, "optical": 0.3}


@pytest.fixture(scope="module")
def planted():
    """Six training runs of 120 s and three held out, with known noise."""
    return [
        attitude_runs.recording(
            f"run-{i}",
            attitude_runs.free_motion(i),
            seed=i,
            duration_s=120.0,
            occlusions=[(40.0, 41.0)],
        )
        for i in range(9)
    ]


@pytest.fixture(scope="module")
def short():
    """Two short runs for tests of the loop itself."""
    return [
        attitude_runs.recording(
            f"run-{i}", attitude_runs.free_motion(i, rest_s=0.2), seed=i, duration_s=3.0
        )
        for i in range(2)
    ]


def start_at(factor):
    params = as_arrays(jaxekf.get_model("loose").parameters)
    return params._replace(noise=jax.tree.map(lambda a: a * factor, params.noise))


@pytest.fixture(scope="module")
def full(short):
    """A tuning of one full matrix, the gyroscope's noise having one deviation for each axis."""
    base = start_at(1.0)
    base = base._replace(noise=base.noise._replace(gyroscope=jnp.asarray([1e-3, 2e-3, 4e-3])))
    return tuning.tune(
        short[:1],
        validate=short[1:],
        start=base,
        free=["noise.optical"],
        axes="full",
        iterations=2,
        rescale=False,
    )


@pytest.mark.parametrize(
    ("objective", "factor"),
    scenario.long_form(
        [(tuning.innovation_likelihood(), 10.0), (tuning.attitude_error(), 10.0)],
        [(tuning.attitude_error(), 10.0)],
    ),
)
def test_planted_noise_is_found(planted, objective, factor):
    """Would catch a wrong gradient, a density that depends on the rate, or a tuner that gives up."""
    tuned = tuning.tune(planted[:6], start=start_at(factor), objective=objective, iterations=40)
    if objective.likelihood:
        for name, value in PLANTED.items():
            assert np.rad2deg(getattr(tuned.params.noise, name)) == pytest.approx(value, rel=0.1)
    rows = tuning.compare("loose", planted[6:], {"true": start_at(1.0), "tuned": tuned.params}).rows
    mean = tuning.mean_by_variant(rows)
    assert mean["tuned"] <= 1.02 * mean["true"]
    # After an error-only fit the scale is fixed by the training errors: the uncertainty stays honest.
    assert 0.7 <= tuning.mean_by_variant(rows, "nees")["tuned"] <= 1.4


def test_planted_calibration_is_found():
    """Would catch a clock offset or gyroscope matrix of the wrong sign, frame or size."""
    record = attitude_runs.recording(
        "run", attitude_runs.free_motion(3, speed_deg=60.0), seed=3, duration_s=20.0
    )
    imu = record.need_imu()
    matrix = np.array([[1.01, 0.004, -0.006], [-0.003, 0.99, 0.005], [0.002, -0.004, 1.005]])
    # The IMU's clock is 5 ms late: what it stamps t + 5 ms happened at t.
    late = imu.__class__(imu.time_ns + 5_000_000, imu.gyroscope @ np.linalg.inv(matrix).T)
    record = record.replace(imu=late)
    tuned = tuning.tune(
        [record],
        objective=tuning.innovation_likelihood(),
        free=["calibration.clock_offset", "calibration.gyroscope_matrix"],
        iterations=30,
    )
    assert float(tuned.params.calibration.clock_offset) == pytest.approx(5e-3, abs=3e-4)
    np.testing.assert_allclose(tuned.params.calibration.gyroscope_matrix, matrix, atol=1.5e-3)
    np.testing.assert_array_equal(tuned.params.noise.optical, tuned.start.noise.optical)


def test_the_best_by_validation_is_kept(short):
    """Would catch returning the last parameters instead of the best ones."""
    wild = optax.sgd(30.0)
    tuned = tuning.tune(
        short[:1], validate=short[1:], optimiser=wild, iterations=6, patience=6, rescale=False
    )
    judged = [step.validation for step in tuned.history if not step.rejected]
    assert tuned.best.validation == min(judged)
    held_out = tuning.prepare(tuned.model, short[1:])
    again = float(objectives.evaluate(tuned.model, tuned.objective, tuned.params, held_out))
    assert again == pytest.approx(tuned.best.validation, rel=1e-9)


def test_steps_that_are_not_finite_are_rejected_and_counted(short):
    """Would catch a tuner that walks on from NaN."""
    leap = optax.GradientTransformation(
        lambda params: jnp.zeros((), int),
        lambda g, n, params=None: (jnp.where(n == 0, 1e4, -0.05) * jnp.ones_like(g), n + 1),
    )
    tuned = tuning.tune(short[:1], optimiser=leap, iterations=12, patience=12)
    assert tuned.rejections >= 1
    assert tuned.history[1].rejected
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(tuned.params))


def test_early_stop(short):
    """Would catch patience being ignored: a step of nothing never improves."""
    still = optax.set_to_zero()
    tuned = tuning.tune(short[:1], optimiser=still, iterations=30, patience=4)
    assert len(tuned.history) == 5
    assert "no improvement" in tuned.stopped


def test_the_scale_of_all_covariances_leaves_the_estimate(short):
    """Would catch a rescaling that forgets Q, R or P0."""
    base = start_at(1.0)
    one, other = (
        jaxekf.estimate(short[0], "loose", p) for p in (base, free_vector.scaled(base, 7.0))
    )
    np.testing.assert_allclose(one.attitude.value, other.attitude.value, atol=1e-12)
    np.testing.assert_allclose(7.0 * one.cov, other.cov, rtol=1e-10, atol=1e-18)


def test_files_say_units_and_origin(full, tmp_path):
    """Would catch parameters that do not survive the round trip, or files that say nothing."""
    tuning.save(full, tmp_path)
    text = (tmp_path / "noise.toml").read_text()
    for word in (
        'unit = "rad/s/sqrt(Hz)"',
        "schema_version = 1",
        "run-0",
        "run-1",
        "attitude",
        "jax",
    ):
        assert word in text
    again = jaxekf.load_parameters(full.model, tmp_path)
    for a, b in zip(jax.tree.leaves(again), jax.tree.leaves(full.params), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-15)


@given(st.lists(st.floats(1e-6, 1e3), min_size=3, max_size=3), st.sampled_from(free_vector.AXES))
def test_free_vectors_round_trip(values, axes):
    """Would catch a parametrisation whose inverse is not its inverse."""
    model = jaxekf.get_model("loose")
    deviations = np.array(values)
    params = model.parameters._replace(noise=model.parameters.noise._replace(optical=deviations))
    base = free_vector.with_axes(model, params, axes)
    where = free_vector.layout(model, base, ["noise", "calibration", "initial"])
    free = where.to_free(base)
    assert len(where.labels()) == len(free)
    for a, b in zip(
        jax.tree.leaves(where.from_free(free, base)), jax.tree.leaves(base), strict=True
    ):
        np.testing.assert_allclose(a, b, rtol=1e-9, atol=1e-300)


@given(st.lists(st.floats(-5.0, 5.0), min_size=18, max_size=18))
def test_any_free_vector_is_a_positive_definite_covariance(values):
    """Would catch a full covariance that a step of the optimiser can make indefinite."""
    model = jaxekf.get_model("loose")
    base = free_vector.with_axes(model, model.parameters, "full")
    where = free_vector.layout(model, base)
    params = where.from_free(jnp.asarray(values), base)
    for leaf in params.noise:
        assert np.all(np.diagonal(leaf) > 0.0)
        assert np.all(np.triu(np.asarray(leaf), 1) == 0.0)


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda runs: tuning.tune([]), "no run"),
        (lambda runs: tuning.tune(runs, free=["noise.optcal"]), "noise.optcal"),
        (lambda runs: tuning.tune(runs, axes="some"), "axes 'some'"),
        (lambda runs: tuning.tune(runs, start=start_at(-1.0)), "positive"),
        (lambda runs: tuning.tune([runs[0].replace(encoder=None)]), "no scored encoder"),
        (lambda runs: objectives.parse("attitude+2*speed"), "2*speed"),
        (lambda runs: tuning.tune(runs, iterations=0), "0 iterations"),
        (lambda runs: tuning.tune(runs, free=[]), "nothing that is free"),
        (lambda runs: tuning.tune(runs, validate=runs[:1]), "run-0"),
        (lambda runs: tuning.tune(runs, objective="-1*attitude"), "negative weight"),
        (lambda runs: tuning.tune(runs, burn_in_s=100.0), "burn-in"),
        (
            lambda runs: tuning.tune(
                [runs[0].replace(encoder=None)],
                objective="likelihood",
                rescale=True,
                iterations=1,
                optimiser=tuning.FisherScoring(),
            ),
            "no scored encoder",
        ),
    ],
)
def test_ill_posed_problems_are_refused_in_a_sentence(short, call, words):
    """Would catch a stack trace where a sentence is due."""
    with pytest.raises(TuningError) as caught:
        call(short)
    assert words in str(caught.value)
    assert "expected" in str(caught.value)


def test_objectives_add_and_scale():
    """Would catch weights that get lost when objectives are combined."""
    both = 2.0 * tuning.attitude_error() + tuning.innovation_likelihood() * 0.5
    assert both == objectives.parse("2*attitude+0.5*likelihood")
    assert "0.5" in both.describe()


def test_line_search_stops_when_it_has_converged():
    """Would catch a line search that never ends at a minimum."""
    steps = line_search.LineSearch(jnp.array([3.0, -2.0]), None)
    for _ in range(60):
        value = float(jnp.sum(steps.candidate**2) + 1.0)
        if steps.move(value, 2.0 * steps.candidate, True):
            break
    else:
        pytest.fail("no stop")
    np.testing.assert_allclose(steps.accepted, 0.0, atol=1e-2)


def test_what_is_not_free_is_not_touched(full):
    """Would catch frozen noise that is reshaped or averaged on the way."""
    each = full.start.noise.gyroscope
    np.testing.assert_array_equal(full.params.noise.gyroscope, each)
    assert each.shape == (3,)
    assert full.params.noise.optical.shape == (3, 3)
    where = free_vector.layout(full.model, full.start)
    kept = where.from_free(where.to_free(full.start), full.start)
    np.testing.assert_allclose(kept.noise.gyroscope, each, rtol=1e-14)


def test_an_interrupted_tuning_keeps_the_best(short):
    """Would catch work lost to Ctrl-C."""

    def stop(step, total):
        if step.number == 3:
            raise KeyboardInterrupt

    tuned = tuning.tune(short[:1], iterations=20, progress=stop)
    assert "interrupted" in tuned.stopped
    assert tuned.best.training == min(step.training for step in tuned.history[:3])


def test_calibration_of_another_model_does_not_stay(tmp_path):
    """Would catch an old calibration.toml next to new noise."""
    for name in ("loose", "loose_rate"):
        model = jaxekf.get_model(name)
        jaxekf.save_parameters(tmp_path, model, model.parameters, {})
        jaxekf.load_parameters(model, tmp_path)
    assert not (tmp_path / "calibration.toml").exists()


NOISE_FILES = {
    "other unit": ('unit = "rad"', 'unit = "deg"', "converting"),
    "not positive": ("value = 0.00523", "value = -0.00523", "positive"),
    "not a number": ("value = 0.005235987755982988", 'value = "a"', "finite numbers"),
    "wrong shape": ("value = 0.005235987755982988", "value = [0.1, 0.2]", "finite numbers"),
    "unknown leaf": ("[noise.optical]", "[noise.optcal]", "optcal"),
    "unknown section": ("[noise.optical]", "[nois.optical]", "nois"),
    "other model": ('model = "loose"', 'model = "loose_rate"', "loose_rate"),
}


@pytest.mark.parametrize("case", NOISE_FILES)
def test_faulty_noise_files_are_refused(tmp_path, case):
    """Would catch a noise file that is read as something else, or half."""
    model = jaxekf.get_model("loose")
    jaxekf.save_parameters(tmp_path, model, model.parameters, {})
    old, new, words = NOISE_FILES[case]
    text = (tmp_path / "noise.toml").read_text()
    assert old in text
    (tmp_path / "noise.toml").write_text(text.replace(old, new))
    with pytest.raises(jaxekf.JaxekfError, match=words):
        jaxekf.load_parameters(model, tmp_path)
