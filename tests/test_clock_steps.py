"""Clock offsets of any size, and clocks that step: found, named, and not confused with a drift."""

from dataclasses import replace

import numpy as np
import pytest
from rotating import motion, run

from jaxekf._support.errors import RecordingError
from jaxekf.calibration import clock_step
from jaxekf.calibration.alignment import align
from jaxekf.checks.inspection import inspect

ROTATING = motion(11, (60, 30, 60))


def stepping(t, size, at=17.0):
    return t + np.where(t >= at, size, 0.0)


@pytest.mark.parametrize("offset_s", [-3.5, 0.7, 25.0])
def test_an_offset_beyond_half_a_second_is_found(offset_s):
    """A search that ends at half a second and blames the motion."""
    late = run(ROTATING, duration_s=40.0, clock=lambda t: t + offset_s)
    found = align(late.optical, late.imu)
    assert abs(found.latency_s - offset_s) < 1e-3
    seen = inspect(late)
    assert seen.evidence.rate_ratio == pytest.approx(1.0, abs=0.01)
    age = "older" if offset_s > 0.0 else "newer"
    assert f" ms {age} than stamped" in " ".join(seen.warnings)


def test_streams_of_two_bodies_have_no_offset():
    """A peak of a correlation that is given as an offset, or motion that is called too slow."""
    one, other = run(ROTATING, duration_s=40.0), run(motion(12, (60, 30, 60)), duration_s=40.0)
    with pytest.raises(RecordingError, match="at any clock offset within"):
        align(one.optical, other.imu)
    assert inspect(one.replace(imu=other.imu)).evidence.searched_s > 10.0


def test_motion_that_repeats_has_several_offsets():
    """One of many equal peaks given as a fact."""
    again = run(
        lambda t: ROTATING(3.0 + np.sin(2.0 * np.pi * np.asarray(t) / 5.0)),
        duration_s=40.0,
        clock=lambda t: t + 7.0,
    )
    with pytest.raises(RecordingError, match="motion that repeats"):
        align(again.optical, again.imu)


def test_too_slow_motion_is_named_as_such():
    """An offset search in noise, or other causes named, where the gyroscope hardly rotates."""
    still = run(motion(13, (0.3, 0.3, 0.3)), clock=lambda t: t + 3.0)
    with pytest.raises(RecordingError, match="too little rotation"):
        align(still.optical, still.imu)


@pytest.mark.parametrize("size", [0.12, 0.8, 3.0])
def test_a_step_of_the_trackers_clock_is_named(size):
    """A step that becomes a wrong frame, scale or latency."""
    stepped = run(ROTATING, duration_s=40.0, clock=lambda t: stepping(t, size))
    found = clock_step.find(stepped.optical, stepped.imu)
    assert found is not None and found.stream == "tracker"
    assert found.step_s == pytest.approx(size, abs=0.02)
    assert found.since_s == pytest.approx(17.0, abs=0.05)
    with pytest.raises(RecordingError, match="step of the tracker's clock by"):
        align(stepped.optical, stepped.imu)
    seen = inspect(stepped)
    assert seen.evidence.clock_steps and np.isnan(seen.evidence.rate_ratio)
    assert "step of the tracker's clock" in " ".join(seen.warnings)


def test_a_step_of_the_imus_clock_is_named():
    """The wrong clock blamed: here the IMU's stamps have the gap."""
    good = run(ROTATING, duration_s=40.0)
    stamps = good.imu.time_ns + 800_000_000 * (good.imu.time_ns >= 1_017_000_000_000)
    found = clock_step.find(good.optical, replace(good.imu, time_ns=stamps))
    assert found is not None and found.stream == "IMU"
    assert found.step_s == pytest.approx(-0.8, abs=0.02)
    assert "step of the IMU's clock by +0.8" in found.sentence()


@pytest.mark.parametrize("drift", [1e-4, 1e-3, 5e-3])
def test_a_drift_is_no_step(drift):
    """A steady drift divided in two halves of one lag each."""
    drifting = run(ROTATING, duration_s=40.0, clock=lambda t: (1.0 + drift) * t)
    assert clock_step.find(drifting.optical, drifting.imu) is None


def test_a_gap_is_no_step():
    """A time in which the tool was hidden taken for a step, since the stamps look alike."""
    good = run(ROTATING, duration_s=40.0)
    optical = good.optical.take(np.abs(good.optical.time_ns - 1_020_000_000_000) > 400_000_000)
    assert clock_step.find(optical, good.imu) is None
    assert inspect(good.replace(optical=optical)).verdict == "fine"


def jumping(stream, size_s):
    late = stream.time_ns >= 1_020_000_000_000
    return replace(stream, time_ns=stream.time_ns + late * round(1e9 * size_s))


def test_both_clocks_jump_by_years():
    """A jump of both clocks shown as a gap in which the tracker sees nothing; a pause called a jump."""
    good = run(ROTATING, duration_s=40.0)
    years = 2e8
    jumped = good.replace(optical=jumping(good.optical, years), imu=jumping(good.imu, years))
    seen = " ".join(inspect(jumped).warnings)
    assert "a step of both clocks;" in seen and "6.34 years" in seen and "sees nothing" not in seen
    left = [np.abs(s.time_ns - 1_020_000_000_000) > 2_500_000_000 for s in (good.optical, good.imu)]
    paused = good.replace(
        optical=jumping(good.optical.take(left[0]), 600.0),
        imu=jumping(good.imu.take(left[1]), 600.0),
    )
    assert "both clocks or a pause" in " ".join(inspect(paused).warnings)


def test_one_clock_jumps_by_years():
    """The IMU's clock jumps: the tracker's later poses have no rates, which is no wrong frame."""
    good = run(ROTATING, duration_s=40.0)
    seen = inspect(good.replace(imu=jumping(good.imu, 2e8)))
    assert any("a step of the IMU's clock by +2000000" in text for text in seen.warnings)
    assert seen.alignment is not None and abs(seen.alignment.tracker.latency_s) < 1e-3
