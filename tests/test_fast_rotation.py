"""Rotation by more than half a turn within the spans of a comparison: units, lag and frame all the same."""

import numpy as np
import pytest
from rotating import motion, run

from jaxekf._support.errors import RecordingError
from jaxekf.calibration.alignment import align
from jaxekf.checks.inspection import inspect
from jaxekf.checks.plausibility import evidence, require

SPINS = {
    "1000 deg/s": motion(1, (15, 15, 15), spin_deg_s=(0, 0, 1000)),
    "3540 deg/s": motion(2, (15, 15, 15), spin_deg_s=(2044, 2044, 2044)),
    "tumbling": motion(3, (500, 80, 500), fastest_hz=1.5),
}
DEGREES = 180.0 / np.pi


@pytest.mark.parametrize("name", SPINS)
def test_a_fast_run_is_accepted(name):
    """Aliased rotations over 0.1 s that become a wrong ratio of rates or a refusal as degrees."""
    fast = run(SPINS[name], imu_hz=1000.0, seed=1)
    require(fast)
    found = evidence(fast)
    assert found.rate_ratio == pytest.approx(1.0, abs=2e-3) and not found.too_fast
    assert found.explained > 0.99


@pytest.mark.parametrize("name", SPINS)
@pytest.mark.parametrize(("gain", "unit"), [(DEGREES, "deg/s"), (1.0 / DEGREES, "rad/s")])
def test_a_wrong_unit_is_found_at_any_speed(name, gain, unit):
    """Aliasing that hides a unit, or spans that a wrong unit makes too short or too long."""
    with pytest.raises(RecordingError, match=unit):
        require(run(SPINS[name], imu_hz=400.0, gain=gain))


def test_a_wrong_unit_of_slow_rotation_is_found():
    """Spans that are short for fast motion and lose slow motion in the tracker's noise."""
    with pytest.raises(RecordingError, match="deg/s"):
        require(run(motion(4, (6, 4, 6), fastest_hz=0.4), gain=DEGREES))


@pytest.mark.parametrize("name", ["1000 deg/s", "tumbling"])
def test_the_lag_of_a_fast_run_is_found(name):
    """A lag search in rates that alias, and sums of rates taken for rotations."""
    fast = run(SPINS[name], imu_hz=400.0, clock=lambda t: t + 0.03, mounting_deg=(5.0, 3.0, -20.0))
    found = align(fast.optical, fast.imu)
    assert abs(found.latency_s - 0.03) < max(1e-3, 4.0 * found.latency_sigma_s)
    np.testing.assert_allclose(np.rad2deg(found.alignment), [5.0, 3.0, -20.0], atol=1.0)


def test_more_than_half_a_turn_between_samples_is_stated():
    """A rate ratio made of aliased rotations where the tracker is too slow, or a unit that is blamed."""
    slow = run(motion(5, (15, 10, 15), spin_deg_s=(0, 0, 3000)), tracker_hz=10.0, imu_hz=400.0)
    require(slow)
    found = evidence(slow)
    assert found.too_fast and np.isnan(found.rate_ratio)
    assert not any("times as fast" in text for text in inspect(slow).warnings)
