"""An IMU whose accelerometer and magnetometer have rates of their own: what becomes of every row."""

import numpy as np
import pytest

import jaxekf
from jaxekf.models import sources

RATE_HZ, DURATION_S = 200.0, 15.0


def force(t):
    """A specific force (N, 3) that a straight line between samples at 50 Hz follows to 0.02 m/s^2."""
    return np.stack([2.0 * np.sin(2 * t), 9.8 + 0.5 * np.cos(3 * t), 0.3 * t], axis=1)


def field(t):
    return np.stack([20.0 * np.cos(t), 20.0 * np.sin(t), 40.0 + 0.0 * t], axis=1)


def write(folder, t, gyroscope, accelerometer=None, magnetometer=None):
    """A run with an IMU alone; NaN is a blank cell."""
    folder.mkdir()
    columns, heads = [t[:, None], gyroscope], ["time,gx,gy,gz"]
    for head, values in (("ax,ay,az", accelerometer), ("mx,my,mz", magnetometer)):
        if values is not None:
            columns.append(values)
            heads.append(head)
    rows = (",".join("" if np.isnan(v) else f"{v:.9f}" for v in row) for row in np.hstack(columns))
    (folder / "imu.csv").write_text("\n".join([",".join(heads), *rows]) + "\n")
    (folder / "recording.toml").write_text("schema_version = 1\ntrust_units = true\n[imu]\n")
    return jaxekf.load(folder)


def accelerometer_of(run):
    """The accelerometer (N, 3) of a run."""
    found = run.need_imu().accelerometer
    assert found is not None
    return found


def turning(t):
    return np.stack([np.sin(t), np.cos(2 * t), 0.1 * t], axis=1)


@pytest.mark.parametrize("every", [2, 4, 10])
def test_blank_between(tmp_path, every):
    """Rows of the gyroscope lost where the accelerometer is slower; a value that is held."""
    t = np.arange(0.0, DURATION_S, 1.0 / RATE_HZ)
    slow = np.full((len(t), 3), np.nan)
    slow[::every] = force(t[::every])
    run = write(tmp_path / "run", t, turning(t), slow)
    imu, found = run.need_imu(), accelerometer_of(run)
    last = ((len(t) - 1) // every) * every + 1
    assert len(imu.time_ns) == len(t)
    np.testing.assert_array_equal(found[::every], np.round(force(t[::every]), 9))
    np.testing.assert_allclose(found[:last], force(t[:last]), atol=0.02)
    assert sources.imu(run).mask.all()
    assert run.intake["imu"].masked == {}
    (note,) = run.intake["imu"].notes
    assert f"{RATE_HZ / every:g} Hz" in note and f"{RATE_HZ:g} Hz" in note


@pytest.mark.parametrize(("rate_hz", "offset_s"), [(125.0, 7e-4), (73.0, 2e-3), (400.0, 1e-4)])
def test_rows_of_two_sensors(tmp_path, rate_hz, offset_s):
    """Two logs joined by time of which nothing is left; other rows counted as faults of the gyroscope."""
    t = np.arange(0.0, DURATION_S, 1.0 / RATE_HZ)
    other = offset_s + np.arange(0.0, DURATION_S, 1.0 / rate_hz)
    merged = np.union1d(np.round(t, 9), np.round(other, 9))
    gyroscope, accelerometer = np.full((2, len(merged), 3), np.nan)
    gyroscope[np.isin(merged, np.round(t, 9))] = turning(t)
    accelerometer[np.isin(merged, np.round(other, 9))] = force(other)
    run = write(tmp_path / "run", merged, gyroscope, accelerometer)
    imu = run.need_imu()
    np.testing.assert_array_equal(imu.time_ns, np.round(1e9 * t))
    inside = (t >= other[0]) & (t <= other[-1])
    np.testing.assert_allclose(accelerometer_of(run)[inside], force(t[inside]), atol=0.02)
    (reason,) = run.intake["imu"].masked
    assert reason == "of another sensor, without gyroscope"


def test_magnetometer_in_rows_of_its_own(tmp_path):
    """Magnetometer samples that vanish with their rows, or that are moved without their time."""
    t = np.arange(0.0, DURATION_S, 1.0 / RATE_HZ)
    other = 1e-3 + np.arange(0.0, DURATION_S - 0.1, 0.05)
    merged = np.union1d(np.round(t, 9), np.round(other, 9))
    gyroscope, magnetometer = np.full((2, len(merged), 3), np.nan)
    gyroscope[np.isin(merged, np.round(t, 9))] = turning(t)
    magnetometer[np.isin(merged, np.round(other, 9))] = field(other)
    imu = write(tmp_path / "run", merged, gyroscope, None, magnetometer).need_imu()
    assert imu.magnetometer is not None
    seen = np.isfinite(imu.magnetometer).all(axis=1)
    assert len(imu.time_ns) == len(t) and seen.sum() == len(other)
    within = seen & (t >= other[0])
    np.testing.assert_allclose(imu.magnetometer[within], field(t[within]), atol=0.02)


def test_missing_samples_stay_missing(tmp_path):
    """A few cells that were lost, or a long gap, filled in as if the sensor were slower."""
    t = np.arange(0.0, DURATION_S, 1.0 / RATE_HZ)
    few = force(t)
    few[[100, 101, 700]] = np.nan
    run = write(tmp_path / "few", t, turning(t), few)
    assert run.intake["imu"].masked["not finite"].count == 3 and run.intake["imu"].notes == ()
    slow = np.full((len(t), 3), np.nan)
    slow[::4] = force(t[::4])
    slow[1000:1400] = np.nan
    imu = write(tmp_path / "gap", t, turning(t), slow).need_imu()
    assert not np.isin(np.round(1e9 * t[1010:1390]), imu.time_ns).any()
    assert len(imu.time_ns) > len(t) - 420


def test_held_values_are_named(tmp_path):
    """A message for each event with the other sensor's value held, taken for samples of the gyroscope."""
    t = np.arange(0.0, DURATION_S, 1.0 / RATE_HZ)
    other = 7e-4 + np.arange(0.0, DURATION_S, 1.0 / 125.0)
    merged = np.union1d(np.round(t, 9), np.round(other, 9))
    at = np.searchsorted(t, merged, side="right") - 1
    run = write(tmp_path / "run", merged, turning(t)[at])
    (note,) = run.intake["imu"].notes
    assert "% of the rows repeat the gyroscope" in note


@pytest.mark.parametrize("resolution", [1e-3, 0.02, 0.3])
def test_coarse_values_are_not_held(tmp_path, resolution):
    """Rows that repeat because the sensor rests, or turns by less than its resolution between samples."""
    t = np.arange(0.0, DURATION_S, 1.0 / RATE_HZ)
    rng = np.random.default_rng(3)
    rate = turning(np.maximum(t - 5.0, 0.0)) + 1e-3 * rng.standard_normal((len(t), 3))
    run = write(tmp_path / "run", t, resolution * np.round(rate / resolution))
    assert run.intake["imu"].notes == ()
