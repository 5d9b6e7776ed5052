"""Planted clock offsets and drifts are found in noise and gaps, and refused where no motion tells them."""

import os
from dataclasses import replace

import numpy as np
import pytest

from jaxekf._support.errors import RecordingError
from jaxekf.calibration.alignment import align
from jaxekf.simulation import attitude_runs

LONG = os.environ.get("JAXEKF_LONG") == "1"
MINUTES = 10.0 if LONG else 2.0


def planted(seed):
    """A run with gaps in both streams, an offset of 200 ms at most and a drift of 100 ppm at most, in its
    middle."""
    rng = np.random.default_rng([seed, 31])
    offset, drift = rng.uniform(-0.2, 0.2), rng.uniform(-1e-4, 1e-4)
    if seed < 4:
        offset, drift = 0.2 * (-1) ** seed, 1e-4 * (-1) ** (seed // 2)
    duration = 60.0 * MINUTES
    hidden = [
        (t, t + rng.uniform(0.2, 3.0)) for t in rng.uniform(0.0, duration, int(duration / 20))
    ]
    run = attitude_runs.recording(
        "run",
        attitude_runs.free_motion(seed),
        seed=seed,
        duration_s=duration,
        grade=attitude_runs.SensorGrade(gyroscope_deg=0.1),
        occlusions=hidden,
        dropouts=0.02,
    )
    optical, imu = run.need_optical(), run.need_imu()
    since = optical.time_ns - (optical.time_ns[0] + optical.time_ns[-1]) // 2
    stamps = optical.time_ns + np.round(1e9 * offset + drift * since).astype(np.int64)
    lost = rng.random(len(imu.time_ns)) < 0.005
    for begin in rng.choice(len(lost), 3):
        lost[begin : begin + 100] = True
    kept = np.flatnonzero(~lost)
    gaps = replace(imu, time_ns=imu.time_ns[kept], gyroscope=imu.gyroscope[kept])
    return replace(optical, time_ns=stamps), gaps, offset, drift


@pytest.mark.parametrize("seed", range(20) if LONG else range(2))
def test_offset_and_drift_are_found(seed):
    """An offset off by more than 1 ms, or a drift by more than 5 ppm over ten minutes."""
    optical, imu, offset, drift = planted(seed)
    found = align(optical, imu)
    print(f"{1e3 * (found.latency_s - offset):+.3f} ms, {1e6 * (found.drift - drift):+.2f} ppm")
    assert abs(found.latency_s - offset) < 1e-3
    # A drift is known by the length of the run to the power of 3/2.
    assert abs(found.drift - drift) < 5e-6 * (10.0 / MINUTES) ** 1.5


def unexcited(seed):
    """At rest, or turning slowly and steadily about one axis or another."""
    rng = np.random.default_rng([seed, 32])
    rate = np.zeros(3)
    if seed % 2:
        rate[seed % 3] = np.deg2rad(rng.uniform(1.0, 15.0)) * rng.choice([-1.0, 1.0])
    grade = attitude_runs.SensorGrade(
        gyroscope_deg=10 ** rng.uniform(-2.0, 0.0), optical_deg=10 ** rng.uniform(-2.0, 0.0)
    )
    motion = attitude_runs.Motion(rate=(float(rate[0]), float(rate[1]), float(rate[2])))
    return attitude_runs.recording("run", motion, seed=seed, duration_s=60.0, grade=grade)


@pytest.mark.parametrize("seed", range(50) if LONG else range(3))
def test_what_does_not_move_is_refused(seed):
    """A clock that is made up from noise."""
    run = unexcited(seed)
    optical = run.need_optical()
    late = replace(optical, time_ns=optical.time_ns + 50_000_000)
    with pytest.raises(RecordingError):
        align(late, run.need_imu())
