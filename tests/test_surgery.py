"""The simulated instrument in microsurgery, and the example that filters it."""

import importlib.util
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scenario import LONG
from scipy.signal import welch

from jaxekf._support import compilation
from jaxekf._support.constants import STANDARD_GRAVITY
from jaxekf.pose_solvers.accelerometer_array import AccelerometerArray, exact_readings
from jaxekf.pose_solvers.gyro_free_rate import track
from jaxekf.recordings.types import to_scipy
from jaxekf.simulation import gyro_free_runs as surgery
from jaxekf.simulation.attitude_runs import Motion, seconds
from jaxekf.simulation.marker_runs import GRAVITY_REF, ToolMotion

GRADE = surgery.SurgeryGrade()
ARRAY = jax.tree.map(np.asarray, surgery.handheld_array())
INTERVAL = 1.0 / GRADE.hertz


def random_array(axes):
    rng = np.random.default_rng(1)
    along = rng.normal(size=(axes, 3))
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    return AccelerometerArray(rng.uniform(-0.05, 0.05, (axes, 3)), along)


def resting():
    none = np.zeros((3, 1))
    return ToolMotion(Motion(), none, none, none)


def second_difference(path, t, h):
    """Second derivative of ``path(t)`` to sixth order."""
    weights = np.array([2, -27, 270, -490, 270, -27, 2]) / (180.0 * h * h)
    return sum(w * path(t + k * h) for w, k in zip(weights, range(-3, 4), strict=True))


def test_rigid_body_law():
    """A sign, frame or term that is wrong in what an axis feels; the angular acceleration not the rate's
    derivative. Places of nine axes anywhere, by second differences of their paths in the world, with
    rates of some rad/s, at which no term is small."""
    slow, array = surgery.surgical_motion(3), random_array(9)
    swing = 10.0 * slow.attitude.amplitude
    motion = ToolMotion(
        Motion(amplitude=swing, frequency=slow.attitude.frequency, phase=slow.attitude.phase),
        slow.amplitude,
        slow.frequency,
        slow.phase,
    )
    t = np.random.default_rng(2).uniform(1.0, 50.0, 200)

    def places(t):
        turn = to_scipy(motion.attitude.attitude(t)[0])
        arms = np.stack([turn.apply(p) for p in array.positions], axis=1)
        return motion.position(t)[:, None] + arms

    turn = to_scipy(motion.attitude.attitude(t)[0])
    force = second_difference(places, t, 1e-3) - GRAVITY_REF
    expected = [
        turn.inv().apply(force[:, i]) @ axis for i, axis in enumerate(np.asarray(array.axes))
    ]
    got = surgery.specific_forces(motion, array, t)
    np.testing.assert_allclose(got, np.stack(expected, axis=1), rtol=0, atol=2e-7)
    # All terms of the law are there to be wrong.
    _, rate = motion.attitude.attitude(t)
    assert np.abs(rate).max() > 1.0
    assert np.abs(surgery.angular_acceleration(motion.attitude, t)).max() > 10.0


def band_rms(values, hertz, low, high):
    """Root mean square (of the vector's length) of what lies between two frequencies."""
    frequency, density = welch(values, hertz, nperseg=4096, axis=0)
    inside = (frequency >= low) & (frequency <= high)
    return np.sqrt(density[inside].sum() * (frequency[1] - frequency[0]))


@pytest.mark.parametrize("seed", [0, 1])
def test_spectra_of_the_hand(seed):
    """Tremor or voluntary motion of another size, outside its band, or in one of translation and rotation
    only."""
    motion, hertz = surgery.surgical_motion(seed), 100.0
    t = np.arange(0.0, 600.0, 1.0 / hertz)
    for values, tremor, voluntary in (
        (motion.position(t), 50e-6, 1e-3),
        (motion.attitude.angles(t)[0], 0.5e-3, np.deg2rad(2.0)),
    ):
        centred = values - values.mean(axis=0)
        np.testing.assert_allclose(band_rms(centred, hertz, 7.9, 12.1), tremor, rtol=0.03)
        np.testing.assert_allclose(band_rms(centred, hertz, 0.0, 1.0), voluntary, rtol=0.05)
        assert band_rms(centred, hertz, 1.1, 7.7) < 1e-2 * tremor
        assert band_rms(centred, hertz, 12.3, 50.0) < 1e-2 * tremor


def test_acceleration_switched_off():
    """A body that is still pushed about, or whose turning changed with it."""
    t = np.arange(0.0, 5.0, 0.01)
    full, still = (surgery.surgical_motion(4, body_acceleration=on) for on in (True, False))
    assert not still.position(t).any() and not still.acceleration(t).any()
    np.testing.assert_array_equal(full.attitude.attitude(t)[0], still.attitude.attitude(t)[0])
    norm = np.linalg.norm(
        surgery.mean_force(ARRAY, surgery.specific_forces(still, ARRAY, t)), axis=1
    )
    assert np.abs(norm - STANDARD_GRAVITY).max() < 2e-3


def test_noise_densities():
    """Noise of another density than the data sheets', coloured, alike on two axes, or the same in each
    block of samples."""
    motion = surgery.surgical_motion(5)
    run = surgery.array_run(motion, ARRAY, seed=5, duration_s=120.0)
    t = seconds(run.time_ns)
    noise = run.readings - surgery.specific_forces(motion, ARRAY, t)
    # The density of a two-sided spectrum, as everywhere here: half the one-sided of `welch`.
    frequency, density = welch(noise, GRADE.hertz, nperseg=1024, axis=0)
    expected = (110e-6 * STANDARD_GRAVITY) ** 2
    for low, high in ((1.0, 30.0), (100.0, 150.0), (200.0, 249.0)):
        inside = (frequency > low) & (frequency < high)
        np.testing.assert_allclose(0.5 * density[inside].mean(axis=0), expected, rtol=0.06)
    unlike = np.corrcoef(noise.T) - np.eye(6)
    assert np.abs(unlike).max() < 5.0 / np.sqrt(len(t))
    half = len(t) // 3
    assert abs(np.corrcoef(noise[:half, 0], noise[half : 2 * half, 0])[0, 1]) < 5.0 / np.sqrt(half)
    size = surgery._BLOCK
    assert abs(np.corrcoef(noise[:size, 0], noise[size : 2 * size, 0])[0, 1]) < 5.0 / np.sqrt(size)
    turn = to_scipy(run.truth.q_ref_body)
    blur = turn.apply(run.field) - GRADE.field_ref
    np.testing.assert_allclose(blur.std(axis=0), 40e-6, rtol=0.02)


def test_mean_force():
    """An array on which angular acceleration is felt as a push, an axis left out of the mean."""
    rng = np.random.default_rng(6)
    force, acceleration, rate = rng.normal(size=(3, 50, 3))
    read = jax.vmap(exact_readings, (None, 0, 0, 0))
    got = surgery.mean_force(ARRAY, np.asarray(read(ARRAY, 0.0 * rate, acceleration, force)))
    np.testing.assert_allclose(got, force, rtol=0, atol=1e-12)
    # The centripetal part of the middle of two chips, 25 mm along an axis.
    got = surgery.mean_force(ARRAY, np.asarray(read(ARRAY, rate, acceleration, force)))
    inward = -0.025 * (np.sum(rate**2, axis=1)[:, None] - rate**2)
    np.testing.assert_allclose(got - force, inward, rtol=0, atol=1e-12)


def test_rate_of_exact_readings():
    """Readings that are not those `differential` expects; a rate that is early by another time than half an
    interval, which the filter is told."""
    motion = surgery.surgical_motion(7)
    t = INTERVAL * np.arange(1001)
    readings = surgery.specific_forces(motion, ARRAY, t)
    early, plain = (motion.attitude.attitude(t + ahead)[1] for ahead in (0.5 * INTERVAL, 0.0))
    got = compilation.jit(track)(ARRAY, GRADE.acceleration_sigma, readings[1:], early[0], INTERVAL)
    assert np.abs(got.rate - early[1:]).max() < 1e-4
    assert np.abs(got.rate - plain[1:]).max() > 1e-3


def test_walk_of_the_rate():
    """A walk that is not what the array's geometry and noise make of it: by its size, its correlation, or a
    factor of the interval; noise that rate and force share."""
    run = surgery.array_run(resting(), ARRAY, seed=8, duration_s=60.0)
    steps = np.diff(surgery.array_rate(ARRAY, run.readings, GRADE), axis=0)[100:]
    walk = surgery.rate_walk(ARRAY, GRADE)
    whitened = np.linalg.solve(walk * np.sqrt(INTERVAL), steps.T)
    count = whitened.shape[1]
    cov = np.cov(whitened)
    np.testing.assert_allclose(cov, np.eye(3), rtol=0, atol=5.0 * np.sqrt(2.0 / count))
    force = surgery.mean_force(ARRAY, run.readings)[101:]
    np.testing.assert_allclose(force.std(axis=0), GRADE.acceleration_sigma / np.sqrt(2), rtol=0.03)
    shared = np.corrcoef(whitened, force.T)[:3, 3:]
    assert np.abs(shared).max() < 5.0 / np.sqrt(count)


@pytest.mark.parametrize("seed", range(20) if LONG else [0])
@pytest.mark.long
def test_the_rate_does_not_run_away(seed):
    """A time constant so long that the recursion runs away: within a minute with 10 s and this seed, within
    half an hour with 5 s and others."""
    minutes = 30.0 if LONG else 1.0
    motion = surgery.surgical_motion(seed)
    run = surgery.array_run(motion, ARRAY, seed=seed, duration_s=60.0 * minutes)
    error = surgery.array_rate(ARRAY, run.readings, GRADE) - run.rate
    # Of a walk, over 20 s: some 0.2 rad/s.
    moved = error[10_000:] - error[:-10_000]
    assert np.abs(moved).max() < 1.0


@pytest.fixture(scope="module")
def example():
    file = Path(__file__).parents[1] / "examples" / "microsurgery.py"
    spec = importlib.util.spec_from_file_location("microsurgery", file)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="module")
def runs(example):
    minutes = 30.0 if LONG else 1.0
    return example.run(0, minutes), example.run(0, minutes, body_acceleration=False)


@pytest.mark.long
def test_claims_of_the_example(example, runs):
    """A filter that drifts, is little better than TRIAD, or does not know its own error; the whole is
    ``python examples/microsurgery.py``."""
    found = example.compare(*runs)
    missed = [text for text, passed in example.checks_of(found).items() if not passed]
    assert not missed, found
    assert found["filter_deg"] <= 0.2 * found["triad_deg"]
    assert 0.9 < found["no_acceleration"]["nees"] < 1.1
    # TRIAD takes the force for gravity: its error about a level axis is that of the other component.
    pushed = surgery.surgical_motion(0).acceleration(np.arange(0.0, 60.0, 0.01)).std(axis=0)
    expected = np.hypot(pushed, GRADE.acceleration_sigma / np.sqrt(2.0))[[1, 0]] / STANDARD_GRAVITY
    truth = to_scipy(runs[0].recording.need_encoder().q_ref_body)
    level = truth.apply(example.triad_error(runs[0].recording))[:, :2].std(axis=0)
    np.testing.assert_allclose(level, expected, rtol=0.05)
    assert example.table(found).count("\n") == 5


def test_picture_of_the_example(example, runs, tmp_path):
    """An axis without unit or curve, a picture that is not written."""
    figure = example.figure_of(runs[0])
    for axes in figure.axes:
        assert "(deg)" in axes.get_ylabel()
        assert len(axes.get_lines()) >= 2
    assert example.style.save(figure, tmp_path / "errors.png").stat().st_size > 20_000


def test_recording_says_where_it_is(runs):
    """A world other than the paper's: truth and references that do not fit each other."""
    recording = runs[0].recording
    imu, truth = recording.need_imu(), to_scipy(recording.need_encoder().q_ref_body)
    up = truth.apply(imu.accelerometer).mean(axis=0)
    north = truth.apply(imu.magnetometer).mean(axis=0)
    np.testing.assert_allclose(up, -np.array(recording.info["gravity_ref"]), rtol=0, atol=0.02)
    np.testing.assert_allclose(north / 0.53, recording.info["field_ref"], rtol=0, atol=1e-5)
    dip = np.deg2rad(67.0)
    np.testing.assert_allclose(
        recording.info["field_ref"], [np.cos(dip), 0.0, -np.sin(dip)], rtol=0, atol=1e-12
    )
    assert jnp.isfinite(imu.gyroscope).all()
