"""The simulator: rates are derivatives of attitudes, noise is as large as asked, seeds are explicit."""

import filecmp

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import jaxekf
from jaxekf.evaluation.metrics import attitude_error
from jaxekf.simulation import attitude_runs, demo


@pytest.mark.parametrize(
    "motion", [attitude_runs.constant_rate_motion(rest_s=1.0), attitude_runs.free_motion(5)]
)
def test_rate_is_the_derivative_of_the_attitude(motion):
    """Would catch a rate in the wrong frame, or a jump in the attitude."""
    t = np.linspace(2.5, 12.0, 500)
    h = 1e-5
    _, rate = motion.attitude(t)
    before, after = (
        Rotation.from_quat(np.roll(motion.attitude(t + s)[0], -1, axis=1)) for s in (-h, h)
    )
    np.testing.assert_allclose((before.inv() * after).as_rotvec() / (2 * h), rate, atol=1e-7)


def test_motion_rests_first():
    """Would catch a run whose bias cannot be measured at rest."""
    q, rate = attitude_runs.constant_rate_motion(-9.0, 3.0).attitude(np.linspace(0.0, 2.99, 50))
    assert np.all(rate == 0.0)
    assert np.all(q == q[0])
    _, rate = attitude_runs.constant_rate_motion(-9.0, 3.0).attitude(np.array([5.0]))
    np.testing.assert_allclose(np.rad2deg(rate), [[-9.0, 0.0, 0.0]], atol=1e-12)


def test_noise_is_as_large_as_asked():
    """Would catch a density taken for a deviation: 0.05 deg/s/sqrt(Hz) is 0.56 deg/s at 125 Hz."""
    grade = attitude_runs.SensorGrade(bias_deg=0.0, bias_walk_deg=0.0)
    record = attitude_runs.recording(
        "run", attitude_runs.Motion(), seed=4, duration_s=200.0, grade=grade
    )
    white = np.rad2deg(record.need_imu().gyroscope.std())
    assert white == pytest.approx(0.05 * np.sqrt(125.0), rel=0.02)
    optical, encoder = record.need_optical(), record.need_encoder()
    error = np.rad2deg(
        attitude_error(encoder.q_ref_body[::2][: len(optical.time_ns)], optical.q_ref_body)
    )
    assert error.std() == pytest.approx(0.3, rel=0.02)


def test_occlusions_and_dropouts():
    """Would catch a tracker that sees through an occlusion, or rows that vanish instead of being hidden."""
    record = attitude_runs.recording(
        "run",
        attitude_runs.Motion(),
        seed=1,
        duration_s=60.0,
        occlusions=[(20.0, 21.0)],
        dropouts=0.1,
    )
    optical = record.need_optical()
    t = (optical.time_ns - optical.time_ns[0]) / 1e9
    assert not optical.valid[(t >= 20.0) & (t < 21.0)].any()
    assert np.mean(~optical.valid[t < 20.0]) == pytest.approx(0.1, abs=0.03)
    assert optical.valid[0]
    assert len(t) == 3751


def test_seeds_are_explicit():
    """Would catch a hidden global seed."""
    one, same, other = (
        attitude_runs.recording("run", attitude_runs.free_motion(1), seed=s, duration_s=1.0)
        for s in (1, 1, 2)
    )
    np.testing.assert_array_equal(one.imu.gyroscope, same.imu.gyroscope)
    assert not np.array_equal(one.imu.gyroscope, other.imu.gyroscope)


def test_bundled_runs_are_what_the_simulator_makes(tmp_path):
    """Would catch bundled recordings that no longer come from the code that is said to make them."""
    demo.write(tmp_path)
    names = demo.TRAINING + demo.VALIDATION + demo.TESTING
    assert len(names) >= 6
    for name in names:
        bundled, made = jaxekf.load(demo.FOLDER / name), jaxekf.load(tmp_path / name)
        np.testing.assert_allclose(bundled.imu.gyroscope, made.imu.gyroscope, rtol=1e-5, atol=1e-8)
        np.testing.assert_array_equal(bundled.optical.valid, made.optical.valid)
        assert filecmp.cmp(
            demo.FOLDER / name / "recording.toml", tmp_path / name / "recording.toml"
        )
