"""The end of a tuning: no number is left where the likelihood is lower, whatever it started from."""

from dataclasses import replace

import jax
import numpy as np
import pytest

import jaxekf
import tuning
from jaxekf.estimation.parameters import as_arrays
from jaxekf.evaluation.verdicts import Fault, judge_fault
from jaxekf.models.robust import outlier_method
from jaxekf.simulation import attitude_runs
from tuning.objective import objectives
from tuning.parametrisation import free_vector

MODEL = jaxekf.get_model("loose")


def noise(gyroscope_deg, walk_deg, optical_deg):
    params = as_arrays(MODEL.parameters)
    values = np.deg2rad([gyroscope_deg, walk_deg, optical_deg])
    return params._replace(noise=type(params.noise)(*values))


def with_tracker(sigma_deg):
    """The same motion and gyroscope, with another noise of the tracker."""
    grade = attitude_runs.SensorGrade(optical_deg=sigma_deg)
    return attitude_runs.recording(
        f"run-{sigma_deg}",
        attitude_runs.free_motion(5, rest_s=0.2),
        seed=5,
        duration_s=10.0,
        grade=grade,
    )


@pytest.mark.parametrize(("sigma_deg", "start_deg"), [(0.001, 1.0), (0.05, 0.001), (0.3, 0.001)])
def test_no_start_ends_below_the_planted_noise(sigma_deg, start_deg):
    """Would catch numbers that go back to a start which costs thousands of log-likelihood, since the
    curvature of a flat side looks like that of a number without any information, and a search that ends
    where a far too small deviation has no slope."""
    run = with_tracker(sigma_deg)
    data = tuning.prepare(MODEL, [run], need_truth=False)
    rows = int(objectives.visible_rows(data))

    def likelihood(params):
        aim = tuning.innovation_likelihood()
        return -rows * float(objectives.evaluate(MODEL, aim, as_arrays(params), data))

    tuned = tuning.tune(
        [run],
        objective="likelihood",
        start=noise(0.15, 0.005, start_deg),
        confidence_intervals=True,
    )
    planted = likelihood(noise(0.05, 1e-4, sigma_deg))
    assert likelihood(tuned.params) >= planted - 3.0
    assert "noise.optical" not in tuned.open and "noise.gyroscope" not in tuned.open
    value, low, high = tuned.intervals["noise.optical"]
    assert low <= value <= high
    # A tracker far better than what the gyroscope predicts has no lower limit, but an upper one.
    assert low == 0.0 if sigma_deg == 0.001 else low > 0.8 * np.deg2rad(sigma_deg)
    assert high < np.deg2rad(max(1.2 * sigma_deg, 0.01))


def test_a_step_follows_a_given_prior():
    """Would catch a parameter of unit 1 with a wide prior that hardly moves in a step of the search."""
    model = jaxekf.get_model("loose")
    name = "calibration.gyroscope_matrix"
    (plain,) = tuning.layout(model, model.parameters, [name]).leaves
    (wide,) = tuning.layout(model, model.parameters, [tuning.Free(name, prior=2.0)]).leaves
    (same,) = tuning.layout(model, model.parameters, [tuning.Free(name, prior=0.05)]).leaves
    assert same.step == pytest.approx(plain.step)
    assert wide.step == pytest.approx(40.0 * plain.step)
    assert wide.prior == pytest.approx(plain.prior)


def test_the_scale_does_not_shrink_what_a_run_begins_with():
    """Would catch an initial bias deviation that falls with the scale of all covariances: a run with a new
    bias is then estimated worse than untuned."""
    start = as_arrays(MODEL.parameters)
    found = free_vector.scaled(start, 1e-4, start)
    np.testing.assert_allclose(found.initial.bias, start.initial.bias)
    np.testing.assert_allclose(found.noise.optical, 0.01 * start.noise.optical)
    larger = free_vector.scaled(start, 4.0, start)
    np.testing.assert_allclose(larger.initial.bias, 2.0 * start.initial.bias)
    # A deviation that a tuning itself made smaller is not raised to the start.
    small = start._replace(initial=jax.tree.map(lambda a: 0.1 * a, start.initial))
    np.testing.assert_allclose(
        free_vector.scaled(small, 1e-4, start).initial.bias, small.initial.bias
    )


def test_a_verdict_names_the_significant_element():
    """Would catch an element of 100 % that nothing determines, named instead of the 1 % that is true."""
    size, sigma = np.zeros(9), np.full(9, 1e-4)
    size[4], size[2], sigma[2] = 0.01, 1.035, 0.9
    fault = Fault("gyroscope_matrix", tuple(size), tuple(sigma), "1", 1e-20, 1.0)
    estimate = jaxekf.diagnose(jaxekf.estimate(with_tracker(0.3)))
    verdict = judge_fault("optical", estimate.sensors["optical"].nis, fault)
    assert "1.00 ± 0.01 % in element yy" in str(verdict)
    assert verdict.size == pytest.approx(0.01)


def test_the_outlier_method_is_recorded():
    """Would catch a tuning that keeps silent about the treatment of outliers it was made with."""
    for method in ("gate", "huber", "student", "none"):
        assert {outlier_method(s) for s in jaxekf.robust(MODEL, method).sensors} == {method}


def test_gates_that_reject_at_the_start_are_off_during_the_search():
    """Would catch a tuning on the few samples that a wrong calibration lets through the gates."""
    run = with_tracker(0.3)
    gated = jaxekf.robust(MODEL, "gate")
    free = ["calibration.alignment"]
    optical = run.need_optical()
    turn = np.array([np.cos(0.2), 0.0, np.sin(0.2), 0.0])
    w, x, y, z = np.moveaxis(optical.q_ref_body, -1, 0)
    turned = np.stack(
        [
            w * turn[0] - y * turn[2],
            x * turn[0] - z * turn[2],
            y * turn[0] + w * turn[2],
            z * turn[0] + x * turn[2],
        ],
        axis=-1,
    )
    turned_run = run.replace(optical=replace(optical, q_ref_body=turned))
    options = {"model": gated, "objective": "likelihood", "free": free, "iterations": 40}
    found = tuning.tune([turned_run], **options)
    assert found.origin["gates_off"] is True
    np.testing.assert_allclose(found.params.calibration.alignment, [0.0, -0.4, 0.0], atol=0.02)
    used, visible = found.accepted["optical"]
    assert used > 0.98 * visible
    kept = tuning.tune([run], **options)
    assert "gates_off" not in kept.origin
    assert kept.origin["outlier_methods"] == ["optical: gate"]
