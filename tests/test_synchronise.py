"""Clock and frame of a tracker against an IMU, found from how both turn."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from jaxekf._support.errors import RecordingError
from jaxekf.calibration import time_offset
from jaxekf.io.importers import broad
from jaxekf.pose_solvers.marker_pose import from_markers
from jaxekf.recordings.types import Optical, from_scipy, to_scipy
from jaxekf.simulation import marker_runs

TURN = np.deg2rad([1.0, -2.0, 0.5])


def poses_and_imu(seed, latency_s=0.0, turn=(0.0, 0.0, 0.0), duration_s=40.0):
    """A simulated run's raw poses, stamped later than taken and in a frame turned in the body."""
    motion = marker_runs.free_tool_motion(seed)
    run = marker_runs.tool_recording("run", motion, seed=seed, duration_s=duration_s)
    raw = from_markers(run.markers)
    turned = from_scipy(to_scipy(raw.q_ref_body) * Rotation.from_rotvec(turn))
    stamps = raw.time_ns - raw.latency_ns + round(1e9 * latency_s)
    return replace(raw, time_ns=stamps, q_ref_body=turned, latency_ns=0), run.imu


@pytest.mark.parametrize("latency_s", [-0.2, 0.0, 0.034])
def test_latency_and_frame_are_found(latency_s):
    """A sign turned round, half a sample lost, or an alignment the wrong way; and a deviation that says
    less or more than the error over seeds."""
    scaled = []
    for seed in range(6):
        optical, imu = poses_and_imu(seed, latency_s, TURN)
        optical.q_ref_body[100:110] = [1.0, 0.0, 0.0, 0.0]
        found = time_offset.match(optical, imu)
        scaled.append((found.latency_s - latency_s) / found.latency_sigma_s)
        assert abs(found.latency_s - latency_s) < 3e-3
        np.testing.assert_allclose(found.alignment, TURN, atol=np.deg2rad(0.4))
    assert 0.2 < np.sqrt(np.mean(np.square(scaled))) < 2.5


def test_what_does_not_turn_is_refused():
    """A clock offset that is made up where nothing tells it."""
    optical, imu = poses_and_imu(0)
    still = replace(optical, q_ref_body=np.tile(optical.q_ref_body[0], (len(optical.time_ns), 1)))
    noisy = to_scipy(still.q_ref_body) * Rotation.from_rotvec(
        1e-3 * np.random.default_rng(1).standard_normal((len(optical.time_ns), 3))
    )
    at_rest = replace(
        imu, gyroscope=1e-3 * np.random.default_rng(2).standard_normal(imu.gyroscope.shape)
    )
    with pytest.raises(RecordingError, match="too little rotation"):
        time_offset.match(replace(still, q_ref_body=from_scipy(noisy)), at_rest)
    with pytest.raises(RecordingError, match="pairs of tracker samples"):
        time_offset.match(replace(optical, valid=np.zeros(len(optical.time_ns), bool)), imu)


def test_real_lag_of_the_gyroscope(data_dir):
    """BROAD's gyroscope lags its motion capture by 3.5 to 5 ms; found, also from the degraded tracker."""
    run = broad.load(broad.find(data_dir / "broad", "07"))
    truth = run.need_encoder()
    whole = Optical(truth.time_ns, truth.q_ref_body, truth.valid)
    for optical in (whole, broad.degrade(run, seed=0, trial=7).need_optical()):
        assert -0.005 < time_offset.match(optical, run.need_imu()).latency_s < -0.0035
