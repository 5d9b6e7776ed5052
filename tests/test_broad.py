"""Real recordings: the importer, the tracker made from them, and the main job on them (row 10)."""

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from scipy.io import savemat

import jaxekf
import tuning
from jaxekf._support.errors import RecordingError
from jaxekf.evaluation.metrics import attitude_error
from jaxekf.io.importers import broad
from jaxekf.recordings.types import NANOSECONDS, Encoder, Imu, Optical

EXAMPLE = Path(__file__).parents[1] / "examples" / "broad_tracker.py"


@pytest.fixture(scope="module")
def folder(data_dir):
    if not (data_dir / "broad").is_dir():
        pytest.skip("no BROAD trials beside the project")
    return data_dir / "broad"


def cut(record, seconds):
    """The first seconds of a run."""
    end = record.need_optical().time_ns[0] + int(seconds * NANOSECONDS)
    optical, imu, encoder = record.optical, record.imu, record.encoder
    a, b, c = (stream.time_ns <= end for stream in (optical, imu, encoder))
    return record.replace(
        optical=Optical(optical.time_ns[a], optical.q_ref_body[a], optical.valid[a]),
        imu=Imu(imu.time_ns[b], imu.gyroscope[b]),
        encoder=Encoder(
            encoder.time_ns[c], encoder.q_ref_body[c], encoder.valid[c], encoder.scored[c]
        ),
    )


def test_importer(folder):
    """Would catch a wrong rate, order, frame, or NaN taken for a pose."""
    record = broad.load(broad.find(folder, "01"))
    optical, imu = record.need_optical(), record.need_imu()
    assert np.mean(np.diff(imu.time_ns)) == pytest.approx(NANOSECONDS / 285.7142857, rel=1e-6)
    assert 0.0 < np.mean(~optical.valid) < 0.1
    assert np.all(np.isfinite(optical.q_ref_body))
    # The optical attitude turns as the gyroscope says: the convention is body to reference.
    good = optical.valid[:-10] & optical.valid[10:]
    turned = attitude_error(optical.q_ref_body[:-10], optical.q_ref_body[10:])[good]
    mean = np.stack(
        [np.convolve(imu.gyroscope[:, i], np.full(10, 0.1), "valid") for i in range(3)], 1
    )
    rate = mean[: len(good)][good] * 10 / 285.7142857
    assert np.sqrt(np.mean((turned - rate) ** 2)) < 0.1 * np.sqrt(np.mean(turned**2))


def test_degraded_tracker(folder):
    """Would catch a tracker that is not the one described: rate, noise, gaps, first sample, seed."""
    record = broad.load(broad.find(folder, 2))
    made, again, other = (broad.degrade(record, seed=s, trial=2) for s in (0, 0, 1))
    np.testing.assert_array_equal(made.optical.q_ref_body, again.optical.q_ref_body)
    assert not np.array_equal(made.optical.valid, other.optical.valid)
    optical, encoder = made.need_optical(), made.need_encoder()
    assert optical.valid[0]
    assert np.median(np.diff(optical.time_ns)) == pytest.approx(
        5 * NANOSECONDS / 285.7142857, rel=1e-6
    )
    index = np.searchsorted(encoder.time_ns, optical.time_ns)
    error = attitude_error(encoder.q_ref_body[index], optical.q_ref_body)[optical.valid]
    assert np.rad2deg(error.std(axis=0)) == pytest.approx(np.full(3, 0.3), rel=0.05)
    edges = np.flatnonzero(np.diff(optical.valid.astype(int)))
    lengths = np.diff(optical.time_ns[edges])[::2] / NANOSECONDS
    assert lengths.max() < 2.1
    assert 0.05 < np.mean(~optical.valid) < 0.35
    moving = encoder.time_ns[np.flatnonzero(encoder.scored)[0]]
    assert moving - optical.time_ns[0] == pytest.approx(5 * NANOSECONDS, abs=0.1 * NANOSECONDS)


def test_tuning_on_real_recordings_helps_on_others(folder):
    """Would catch a tuner that only works on simulations: short stretches of real trials."""
    training, testing = (
        [
            cut(broad.degrade(broad.load(broad.find(folder, t)), seed=0, trial=t), 45.0)
            for t in trials
        ]
        for trials in ((1, 5), (2, 7))
    )
    params = jaxekf.get_model("loose").parameters
    start = params._replace(
        noise=params.noise._replace(
            gyroscope=np.deg2rad(0.02), bias_walk=np.deg2rad(0.005), optical=np.deg2rad(0.5)
        )
    )
    free = ["noise", "calibration.clock_offset", "calibration.gyroscope_matrix"]
    tuned = tuning.tune(training, start=start, free=free, iterations=12)
    rows = tuning.compare("loose", testing, {"initial": start, "tuned": tuned.params}).rows
    mean = tuning.mean_by_variant(rows)
    assert mean["tuned"] <= 0.9 * mean["initial"]
    assert mean["tuned"] <= 0.05 * mean["hold last"]
    assert 3e-3 < float(tuned.params.calibration.clock_offset) < 5.5e-3


@pytest.mark.long
@pytest.mark.skipif("JAXEKF_LONG" not in os.environ, reason="whole trials: set JAXEKF_LONG=1")
def test_example_on_whole_trials(folder):
    """Would catch an example that misses row 10."""
    trials = ["--train", "01", "05", "10", "16", "--test", "02", "07", "12", "24", "--seed", "0"]
    command = [sys.executable, str(EXAMPLE), str(folder), *trials]
    done = subprocess.run(command, capture_output=True, text=True, timeout=900, check=True)
    last = json.loads(done.stdout.splitlines()[-1])
    tuned, initial, held = (np.mean(last[k]) for k in ("tuned_deg", "initial_deg", "hold_last_deg"))
    assert tuned <= 0.9 * initial
    assert tuned <= 0.05 * held
    assert np.mean(last["smoothed_deg"]) <= 0.95 * tuned


def test_faults_are_named(tmp_path):
    """Would catch a library's own traceback for a file that is not a trial."""
    with pytest.raises(RecordingError, match="no file 03_"):
        broad.find(tmp_path, "3")
    file = tmp_path / "03_x.mat"
    file.write_bytes(b"not a matlab file, whatever its name says" * 10)
    with pytest.raises(RecordingError, match="cannot be read"):
        broad.load(broad.find(tmp_path, 3))
    savemat(file, {"imu_gyr": np.zeros((4, 3))})
    with pytest.raises(RecordingError, match="opt_quat"):
        broad.load(file)
