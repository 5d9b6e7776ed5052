"""`triad` and `marg`: signs and frames of what they are told, attitudes from gravity and field alone."""

from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import jaxekf
from jaxekf._support.constants import STANDARD_GRAVITY
from jaxekf._support.errors import RecordingError
from jaxekf.estimation.parameters import as_arrays
from jaxekf.evaluation import metrics
from jaxekf.filtering.interpolation import InputSample
from jaxekf.geometry import triad as vectors
from jaxekf.models import _earth as earth
from jaxekf.models import marg, triad
from jaxekf.recordings import truth
from jaxekf.recordings.types import from_scipy, to_scipy
from jaxekf.reporting import plots
from jaxekf.simulation import attitude_runs

GRADE = attitude_runs.SensorGrade(
    gyroscope_deg=0.02, bias_walk_deg=0.002, accelerometer=2e-3, magnetometer=0.005, imu_hz=100.0
)


@pytest.fixture(scope="module")
def runs():
    """Two runs of equal length that begin at rest."""
    return [
        attitude_runs.recording(
            f"run-{seed}", attitude_runs.free_motion(seed), seed=seed, duration_s=30.0, grade=GRADE
        )
        for seed in (1, 2)
    ]


def matched(model):
    """The model's parameters with the noise that the runs were made with."""
    noise = model.parameters.noise
    known = {
        "bias_walk": np.deg2rad(GRADE.bias_walk_deg),
        "gyroscope": np.deg2rad(GRADE.gyroscope_deg),
        "rate": np.deg2rad(GRADE.gyroscope_deg),
        "rest": np.deg2rad(GRADE.gyroscope_deg),
        "accelerometer": 2e-3 if model is marg.MODEL else 2e-3 * np.sqrt(GRADE.imu_hz),
        "magnetometer": 0.005 * (0.1 if model is marg.MODEL else 1.0),
        "velocity": 1e-3,
        "norm": 0.1,
        "dip": 0.1,
    }
    noise = noise._replace(**{k: v for k, v in known.items() if k in noise._fields})
    initial = model.parameters.initial._replace(bias=np.deg2rad(0.5))
    return model.parameters._replace(noise=noise, initial=initial)


@pytest.fixture(scope="module", params=["triad", "marg"])
def found(request, runs):
    """Estimates of the runs by each model."""
    model = jaxekf.get_model(request.param)
    return jaxekf.estimate_many(runs, model, matched(model))


def test_attitude_and_bias_are_found(found, runs):
    """Would catch a frame, a sign or a scale: the field's north, gravity's way, units of the field, and a
    bias that goes to the wrong place; and a covariance of another size."""
    estimates = found
    for made, run in zip(estimates, runs, strict=True):
        judged = metrics.score(made, run, burn_in_s=3.0)
        assert judged.attitude_rmse_deg < 0.15
        assert judged.rate_rmse_deg_s < 0.35
        assert 0.4 < judged.attitude_nees < 2.0
        raw = metrics.score_raw_rate(run)
        assert judged.rate_rmse_deg_s < 0.8 * raw


def test_other_worlds(runs):
    """Would catch a north or an up that is taken for granted: the same run in the paper's world, which is
    north, west, up, and in one whose y points up."""
    model, run = triad.MODEL, runs[0]
    plain = jaxekf.estimate(run, model, matched(model))
    for turn in (
        Rotation.from_euler("z", -90, degrees=True),
        Rotation.from_euler("xz", [-90, 30], degrees=True),
    ):
        info = {key: turn.apply(run.info[key]).tolist() for key in ("gravity_ref", "field_ref")}
        other = jaxekf.estimate(run.replace(info={**run.info, **info}), model, matched(model))
        expected = from_scipy(turn * to_scipy(plain.attitude.value))
        assert metrics.rms(metrics.attitude_error(other.attitude.value, expected)) < 1e-9


def test_noise_of_an_attitude_is_that_of_its_vectors():
    """Would catch the deviations of force and field exchanged, or readings of another sample."""
    params = as_arrays(triad.MODEL.parameters)
    aux = triad.Readings(jnp.array([0.3, -2.0, 9.5]), jnp.array([0.4, 0.3, -0.8]))
    force, field = float(params.noise.accelerometer), float(params.noise.magnetometer)
    expected = vectors.triad_covariance(*aux, force**2 * jnp.eye(3), field**2 * jnp.eye(3))
    np.testing.assert_allclose(
        triad.attitude_noise(params, aux, jnp.array(0.01)), expected, rtol=1e-12
    )


def turning(rate):
    """An input that turns at a constant rate (3,) and feels gravity."""
    value = jnp.concatenate([jnp.asarray(rate), jnp.array([0.0, 0.0, STANDARD_GRAVITY])])
    return InputSample(value, value, jnp.array(100.0))


def test_lag_and_declination_have_their_signs():
    """Would catch a lag that makes samples newer, and a declination to the west."""
    params = as_arrays(marg.MODEL.parameters)
    rate, lag = np.array([0.3, -0.8, 1.1]), 0.02
    q = Rotation.from_rotvec([0.2, -0.4, 0.9])
    before = q * Rotation.from_rotvec(-lag * rate)
    x = marg.initial_mean({"q_ref_body": from_scipy(q)})
    late = params.calibration._replace(magnetometer_lag=jnp.array(lag))
    got = marg.predict_magnetometer(x, turning(rate), params._replace(calibration=late), None)
    field = np.asarray(earth.SETUP.field_ref)
    np.testing.assert_allclose(got, before.inv().apply(field), atol=1e-12)
    east = params.calibration._replace(declination=jnp.array(0.1))
    x = marg.initial_mean({})
    got = marg.predict_magnetometer(x, turning(rate), params._replace(calibration=east), None)
    np.testing.assert_allclose(np.arctan2(got[0], got[1]), 0.1, atol=1e-12)
    np.testing.assert_allclose(got[2], field[2], atol=1e-12)


def test_transition_is_that_of_a_rigid_body():
    """Would catch a specific force that does not turn with the body, or gravity of the other sign: against
    many short steps of SciPy's rotations."""
    params = as_arrays(marg.MODEL.parameters)
    params = params._replace(
        calibration=params.calibration._replace(accelerometer_bias=jnp.array([0.02, -0.01, 0.03]))
    )
    rate, force, dt = np.array([1.0, -2.0, 0.5]), np.array([1.0, 2.0, 9.0]), 0.01
    value = jnp.asarray(np.concatenate([rate, force]))
    q, bias, scale = Rotation.from_rotvec([0.3, 0.2, -0.5]), np.full(3, 0.01), np.full(3, 0.02)
    x = marg.State(*map(jnp.asarray, (from_scipy(q), np.array([0.1, 0.2, 0.3]), bias, scale)))
    got = marg.transition(x, InputSample(value, value, 1.0), dt, jnp.zeros(9), params)
    true_rate, true_force = (1.0 + scale) * (rate - bias), force - [0.02, -0.01, 0.03]
    velocity, count = np.array([0.1, 0.2, 0.3]), 2000
    for i in range(count):
        at = q * Rotation.from_rotvec(true_rate * dt * (i + 0.5) / count)
        velocity = velocity + (at.apply(true_force) + np.array(earth.GRAVITY_REF)) * dt / count
    np.testing.assert_allclose(got.velocity, velocity, atol=1e-7)
    end = from_scipy(q * Rotation.from_rotvec(true_rate * dt))
    np.testing.assert_allclose(got.q_ref_body, end, atol=1e-12)


def test_disturbed_field_counts_less():
    """Would catch noise that does not grow with norm and dip, or in units of degrees."""
    params = as_arrays(marg.MODEL.parameters)
    plain, *others = (
        marg.magnetometer_noise(params, jnp.array(off), jnp.array(0.01))[0, 0]
        for off in ([0.0, 0.0], [0.3, 0.0], [0.0, 0.3])
    )
    noise = params.noise
    assert plain == pytest.approx(float(noise.magnetometer) ** 2 / 0.01)
    for more, factor in zip(others, (noise.norm, noise.dip), strict=True):
        assert more - plain == pytest.approx((0.3 * float(factor)) ** 2 / 0.01)


def test_magnet_beside_the_tool(runs):
    """Would catch samples of a disturbed field that pull the heading as undisturbed ones do: a magnet for
    4 s doubles the field and turns it."""
    run = runs[0]
    imu = run.need_imu()
    t = (imu.time_ns - imu.time_ns[0]) * 1e-9
    near = (t > 12.0) & (t < 16.0)
    field = imu.magnetometer.copy()
    away = to_scipy(run.need_encoder().q_ref_body)
    at = np.searchsorted(run.need_encoder().time_ns, imu.time_ns[near])
    field[near] += away[at].inv().apply([1.0, 0.0, 0.0])
    spoilt = run.replace(imu=replace(imu, magnetometer=field))
    model, params = marg.MODEL, matched(marg.MODEL)
    blind = params._replace(noise=params.noise._replace(norm=1e-9, dip=1e-9))
    errors = []
    for chosen in (params, blind):
        made = jaxekf.estimate_many([spoilt, runs[1]], model, chosen)[0]
        real = truth.encoder_at(run.need_encoder(), made.time_ns)
        later = made.time > 5.0
        off = metrics.orientation_error(made.attitude.value[later], real.q_ref_body[later])
        errors.append(off.heading_deg)
    assert errors[1] > 5.0 and errors[0] < 0.2 * errors[1]


def test_errors_are_parted_about_the_vertical():
    """Would catch a heading that inclination leaks into, or a vertical of another axis."""
    real = Rotation.random(50, random_state=1)
    tilt = Rotation.from_rotvec(np.deg2rad([3.0, 0.0, 0.0]))
    turn = Rotation.from_rotvec(np.deg2rad([0.0, 0.0, 5.0]))
    found = metrics.orientation_error(from_scipy(turn * tilt * real), from_scipy(real))
    assert found.heading_deg == pytest.approx(5.0) and found.inclination_deg == pytest.approx(3.0)
    both = (turn * tilt).magnitude()
    assert found.total_deg == pytest.approx(np.rad2deg(both))
    swapped = metrics.orientation_error(
        from_scipy(turn * real), from_scipy(real), up=(1.0, 0.0, 0.0)
    )
    assert swapped.heading_deg == pytest.approx(0.0, abs=1e-9)
    assert swapped.inclination_deg == pytest.approx(5.0)


def test_no_start_without_two_directions(runs):
    """Would catch a start in any heading where field and gravity are parallel, and an IMU that lacks a
    sensor taken for one of zeros."""
    run, model = runs[0], marg.MODEL
    imu = run.need_imu()
    plumb = run.replace(imu=replace(imu, magnetometer=-imu.accelerometer))
    with pytest.raises(RecordingError, match="no instant at which 'marg' can start"):
        jaxekf.estimate(plumb, model)
    with pytest.raises(RecordingError, match=r"without magnetometer.*mx,my,mz"):
        jaxekf.estimate(run.replace(imu=replace(imu, magnetometer=None)), model)
    steep = run.replace(info={**run.info, "field_ref": [0.0, 0.0, -1.0]})
    with pytest.raises(RecordingError, match=r"field_ref.*horizontal"):
        jaxekf.estimate(steep, "triad")


def test_figures_without_a_tracker(found, runs, tmp_path):
    """Would catch models of which nothing is drawn, or whose figures need what a run has not."""
    run = runs[0].replace(optical=None)
    names = plots.available_figures(found[0], run)
    assert {"attitude", "rate", "bias"} <= set(names) and "occlusion" not in names
    for name in names:
        for seen in (run, run.replace(encoder=None)):
            plots.save(plots.figure_functions()[name](found[0], seen), tmp_path / f"{name}.png")


def test_a_gyroscope_that_breaks_off(runs):
    """Would catch a rate that is not finite in a prediction, which makes all that follows so."""
    run = runs[0]
    imu = run.need_imu()
    rate = imu.gyroscope.copy()
    rate[1000:1003] = np.nan
    broken = run.replace(imu=replace(imu, gyroscope=rate))
    for model in ("triad", "marg"):
        made, whole = (jaxekf.estimate(r, model) for r in (broken, run))
        if model == "triad":
            assert made.account["gyroscope"]["masked"] == 3
        assert np.isfinite(made.attitude.value).all()
        ends = [e.attitude.value[-1] for e in (made, whole)]
        assert abs(ends[0] @ ends[1]) == pytest.approx(1.0, abs=1e-6)


def test_too_little_to_tell_an_attitude(runs):
    """Would catch a sampling period of 0, whose noise is infinite, and what the IMU of another time or of
    other samples reads beside the field."""
    run = runs[0]
    imu = run.need_imu()
    one = replace(imu, **{k: getattr(imu, k)[:1] for k in ("time_ns", *imu.per_sample)})
    rate = imu.gyroscope.copy()
    rate[::2] = np.nan
    field = imu.magnetometer.copy()
    field[1::2] = np.nan
    for changed in (one, replace(imu, gyroscope=rate, magnetometer=field)):
        for model in ("triad", "marg"):
            with pytest.raises(RecordingError, match="samples of finite rate and specific force"):
                jaxekf.estimate(run.replace(imu=changed, encoder=None), model)
