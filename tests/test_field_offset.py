"""Hard iron: a magnetometer's offset is found, named and corrected; other faults of a field are not called
one."""

import numpy as np
import pytest
from sensor_runs import Motion, ns

import jaxekf
from jaxekf.checks._field_offset import field_findings, fit_field
from jaxekf.io import run_folder
from jaxekf.recordings.types import Imu, Recording

FIELD = np.array([0.0, 20.0, -43.0])
T = np.arange(0.0, 60.0, 0.01)


def measured(seed=0, noise=0.3, amplitude_deg=(120.0, 40.0, 40.0)):
    """A magnetometer's samples while the body turns, and the attitudes."""
    path = Motion(seed, amplitude_deg=amplitude_deg).rotation(T)
    noise = noise * np.random.default_rng(seed).normal(size=(len(T), 3))
    return path.inv().apply(FIELD) + noise, path


def warned(field):
    run = Recording("mag", imu=Imu(ns(T), np.zeros((len(T), 3)), magnetometer=field))
    return field_findings(run, None).warnings


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("size", [4.0, 30.0])
def test_an_offset_is_found_with_its_uncertainty(seed, size):
    """Would catch an offset that is off by more than its uncertainty, or not named."""
    field, _ = measured(seed)
    offset = size * np.array([1.0, -0.5, 0.3])
    found = fit_field(field + offset)
    assert (np.abs(found.offset - offset) < 5.0 * found.sigma + 0.05).all()
    assert abs(found.size - np.linalg.norm(FIELD)) < 0.5
    (text,) = warned(field + offset)
    assert "hard iron" in text and "[imu] magnetometer_offset = [" in text


def test_rivals_are_not_called_hard_iron():
    """Would catch the blame where the strength is another, a part of the run is disturbed, or the body
    turned too little to know."""
    field, path = measured(1)
    assert warned(field) == () and warned(1.7 * field) == ()
    for begin, end in ((0, 2500), (2000, 3500), (3000, 6000)):
        disturbed = field.copy()
        disturbed[begin:end] += path[begin:end].inv().apply([12.0, -9.0, 8.0])
        assert warned(disturbed) == ()
    about_z, _ = measured(2, amplitude_deg=(170.0, 0.0, 0.0))
    assert warned(about_z + np.array([8.0, 2.0, 3.0])) == ()
    still, _ = measured(2, amplitude_deg=(0.0, 0.0, 0.0))
    assert warned(still) == () and warned(np.zeros_like(still)) == ()


def test_unequal_axes_are_named():
    """Would catch an ellipsoid that is called an offset, or passed over, where all directions are seen."""
    ways = np.random.default_rng(0).normal(size=(len(T), 3))
    ways *= 50.0 / np.linalg.norm(ways, axis=1, keepdims=True)
    (text,) = warned(ways @ np.diag([1.1, 0.95, 0.95]) + 0.2)
    assert "axes of 0.950, 0.950, 1.100" in text and "hard iron" not in text


def test_the_stated_offset_is_subtracted_once(tmp_path):
    """Would catch an entry that is not applied, applied again after saving, or taken in another form."""
    field, _ = measured(0)
    run = Recording(
        "mag", imu=Imu(ns(T), np.ones((len(T), 3)), magnetometer=field + np.array([9.0, 0.0, -3.0]))
    )
    path = run_folder.save(run, tmp_path / "run")
    text = (path / "recording.toml").read_text()
    entry = "[imu]\nmagnetometer_offset = [9, 0.0, -3.0]\n"
    (path / "recording.toml").write_text(text.replace("[imu]\n", entry))
    read = jaxekf.load(path)
    np.testing.assert_allclose(read.imu.magnetometer, field, atol=1e-12)
    again = jaxekf.load(run_folder.save(read, tmp_path / "again"))
    np.testing.assert_allclose(again.imu.magnetometer, field, atol=1e-12)
    (path / "recording.toml").write_text(text.replace("[imu]\n", entry.replace("9,", "'a',")))
    with pytest.raises(jaxekf.RecordingError, match=r"imu\.magnetometer_offset: got"):
        jaxekf.load(path)
