"""Up, rest and the Earth's field before any filter, and what a recording states of both."""

from dataclasses import replace
from typing import NamedTuple

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from jaxekf._support.constants import STANDARD_GRAVITY as GRAVITY
from jaxekf._support.errors import RecordingError
from jaxekf.models import _earth as earth
from jaxekf.pose_solvers import tilt
from jaxekf.recordings.types import NANOSECONDS, Imu, Recording, to_scipy
from jaxekf.simulation import attitude_runs

UP = np.array([0.0, 0.0, 1.0])
DIP = np.deg2rad(63.0)
FIELD = 48.0 * earth.dipping(UP, np.array([0.0, 1.0, 0.0]), DIP)
"""In microtesla, east, north, up."""
TO_OTHER = {
    "east, north, up": Rotation.identity(),
    "north, west, up": Rotation.from_rotvec([0.0, 0.0, -np.pi / 2.0]),
    "y up, z south": Rotation.from_rotvec([-np.pi / 2.0, 0.0, 0.0]),
    "upside down": Rotation.from_rotvec([np.pi, 0.0, 0.0]),
}
"""From east, north, up to another reference frame."""
MOUNT = Rotation.from_rotvec([0.7, 0.4, -0.2])
"""The body beside what moves: at rest it is askew."""


def times(hertz, duration_s):
    return attitude_runs.sample_times(hertz, duration_s, 0)


def shaken(t, strength):
    """Accelerations (N, 3) of a hand, m/s^2, of no mean."""
    frequency, phase = np.array([0.6, 0.9, 1.3]), np.array([0.3, 1.0, 2.0])
    return strength * np.sqrt(2.0) * np.sin(2.0 * np.pi * frequency * t[:, None] + phase)


def carried(motion, time_ns, strength=0.0, noise=(0.0, 0.0, 0.0), seed=0):
    """What an IMU reads in a motion (east, north, up), and its attitudes; noise of gyroscope, accelerometer
    and magnetometer as deviations of samples."""
    rng = np.random.default_rng(seed)
    t = attitude_runs.seconds(time_ns)
    q, rate = motion.attitude(t)
    truth = to_scipy(q) * MOUNT
    body = truth.inv()
    force = body.apply(shaken(t, strength) + GRAVITY * UP)
    clean = (MOUNT.inv().apply(rate), force, body.apply(FIELD))
    read = [x + s * rng.standard_normal(x.shape) for x, s in zip(clean, noise, strict=True)]
    return Imu(time_ns, *read), truth


def resting(count, noise=(2e-3, 0.02, 0.2), hertz=100.0, seed=0):
    """At rest."""
    return carried(attitude_runs.Motion(), times(hertz, (count - 1) / hertz), 0.0, noise, seed)[0]


def apart(one, other):
    """Largest angle between rotations, rad."""
    return (one.inv() * other).magnitude().max()


def angles(one, other):
    """Angles (N,) between unit vectors (N, 3), rad."""
    return 2.0 * np.arcsin(np.clip(0.5 * np.linalg.norm(one - other, axis=1), 0.0, 1.0))


@pytest.mark.parametrize("count", [1, 2, 3, 257])
def test_turned_is_the_product_of_all_turns(count):
    """A product in the wrong order, one turn too many or too few, or steps taken for even."""
    rng = np.random.default_rng(count)
    time_ns = np.cumsum(rng.integers(1_000_000, 20_000_000, count))
    rate = rng.normal(size=(count, 3)) * 5.0
    q, expected = Rotation.identity(), []
    for i in range(count):
        if i:
            mean = 0.5 * (rate[i] + rate[i - 1])
            q = q * Rotation.from_rotvec(mean * (time_ns[i] - time_ns[i - 1]) / NANOSECONDS)
        expected.append(q.as_quat())
    found = tilt.integrated_attitude(Imu(time_ns, rate))
    assert apart(Rotation.from_quat(expected), to_scipy(found)) < 1e-12
    np.testing.assert_allclose(np.linalg.norm(found, axis=1), 1.0, atol=1e-14)


def test_turned_follows_a_known_motion():
    """Rates held over a period, of first order, where the trapezoid is of second: half the step, a
    quarter of the error."""
    motion, errors = attitude_runs.free_motion(0, rest_s=0.0), []
    for hertz in (125.0, 250.0):
        imu, truth = carried(motion, times(hertz, 60.0))
        errors.append(apart(truth[0].inv() * truth, to_scipy(tilt.integrated_attitude(imu))))
    assert errors[0] < np.deg2rad(0.02)
    assert errors[0] / errors[1] == pytest.approx(4.0, rel=0.1)


def test_up_is_found_in_motion():
    """A low-pass in the body, which lags behind the turns, or none: 2 m/s^2 rms tilt the specific force."""
    motion = replace(attitude_runs.free_motion(3, rest_s=0.0), rate=(1.5, 0.0, 0.7))
    imu, truth = carried(motion, times(100.0, 60.0), 2.0)
    up = truth.inv().apply(UP)
    late = attitude_runs.seconds(imu.time_ns) > 5.0
    found = tilt.up_in_body(imu)
    np.testing.assert_allclose(np.linalg.norm(found, axis=1), 1.0, atol=1e-12)
    raw = imu.accelerometer / np.linalg.norm(imu.accelerometer, axis=1, keepdims=True)
    off = [np.sqrt(np.mean(angles(x, up)[late] ** 2)) for x in (raw, found)]
    assert off[0] > np.deg2rad(10.0)
    assert off[1] < np.deg2rad(0.5)
    quick = tilt.up_in_body(imu, settling_s=0.3)
    assert 3.0 * off[1] < np.sqrt(np.mean(angles(quick, up)[late] ** 2)) < off[0]


def test_up_takes_as_long_as_it_says():
    """A corner in rad/s taken for Hz: of a step of the specific force half has come through after the time
    that is asked for."""
    time_ns = times(100.0, 30.0)
    t = attitude_runs.seconds(time_ns)[:, None]
    force = np.where(t < 10.0, GRAVITY * UP, GRAVITY * UP + [0.1, 0.0, 0.0])
    imu = Imu(time_ns, np.zeros((len(time_ns), 3)), force)
    for settling_s in (1.0, 3.0):
        lean = tilt.up_in_body(imu, settling_s)[:, 0] / (0.1 / GRAVITY)
        early, late = (np.argmax(lean > share) / 100.0 - 10.0 for share in (0.5, 0.9))
        assert 0.7 * settling_s < early < 1.3 * settling_s
        assert 1.3 * settling_s < late < 2.5 * settling_s


def test_up_starts_from_a_tenth_of_a_second():
    """A start from the first sample alone, which scatters, for as long as the low-pass takes."""
    off = []
    for seed in range(10):
        imu = resting(100, (0.0, 1.0, 0.0), seed=seed)
        up = np.tile(MOUNT.inv().apply(UP), (100, 1))
        off.append(angles(tilt.up_in_body(imu), up)[:5])
    assert np.sqrt(np.mean(np.square(off))) < 1.5 * np.sqrt(2.0 / 10.0) / GRAVITY


def test_up_knows_nothing_of_what_comes():
    """A filter that runs backwards as well: what an estimate at an instant is judged by may not use later
    samples."""
    imu, _ = carried(attitude_runs.free_motion(1), times(100.0, 10.0), 1.0)
    cut = Imu(*(a[:600] for a in (imu.time_ns, imu.gyroscope, imu.accelerometer)))
    whole = tilt.up_in_body(imu)[:600]
    np.testing.assert_allclose(tilt.up_in_body(cut), whole, atol=1e-12)


def test_rest_is_told_from_motion():
    """Rest missed, or a motion, a steady turn or a shake without turning taken for it."""
    noise = (2e-3, 0.02, 0.0)
    motion = attitude_runs.free_motion(0, rest_s=20.0)
    imu, _ = carried(motion, times(100.0, 60.0), 0.0, noise)
    t = attitude_runs.seconds(imu.time_ns)
    found = tilt.static_samples(imu)
    assert not found[t < 0.98].any()
    assert found[(t > 1.0) & (t < 20.0)].mean() > 0.95
    assert not found[t > 20.3].any()
    turning = attitude_runs.Motion(rate=(0.0, 0.0, np.deg2rad(3.0)), rest_s=20.0)
    steady, _ = carried(turning, times(100.0, 60.0), 0.0, noise)
    found = tilt.static_samples(steady)
    assert found[(t > 1.0) & (t < 20.0)].mean() > 0.95
    assert not found[t > 21.0].any()
    level = resting(len(t))
    force = level.accelerometer + np.where(t[:, None] > 20.0, shaken(t, 1.0), 0.0)
    found = tilt.static_samples(replace(level, accelerometer=force))
    assert found[(t > 1.0) & (t < 20.0)].mean() > 0.95
    assert not found[t > 21.0].any()


class Stopping(NamedTuple):
    """A motion that ends at 40 s, all at once."""

    motion: attitude_runs.Motion

    def attitude(self, t):
        """As that of the motion."""
        q, rate = self.motion.attitude(np.minimum(t, 40.0))
        return q, np.where(t[:, None] < 40.0, rate, 0.0)


def test_rest_is_found_again():
    """A window that grows from the start of the run, in which the motion is for ever."""
    motion = Stopping(attitude_runs.free_motion(0, rest_s=20.0))
    imu, _ = carried(motion, times(100.0, 60.0), 0.0, (2e-3, 0.02, 0.0))
    t, found = attitude_runs.seconds(imu.time_ns), tilt.static_samples(imu)
    assert found[((t > 1.0) & (t < 20.0)) | (t > 41.2)].mean() > 0.95
    assert not found[(t > 20.5) & (t < 40.9)].any()


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_gentle_and_quick_motion_is_none(axis):
    """A bound that is not the sensor's own, or one that a tremor without rest sets itself; a motion about
    one axis of which the others do not tell."""
    time_ns = times(100.0, 60.0)
    t, rng = attitude_runs.seconds(time_ns), np.random.default_rng(axis)
    own = 2e-4 * rng.standard_normal((len(t), 3))
    moves = np.eye(3)[axis] * np.sqrt(2.0) * np.sin(2.0 * np.pi * 8.3 * t)[:, None]
    gentle = own + np.where(t[:, None] > 20.0, np.deg2rad(0.3) * moves, 0.0)
    found = tilt.static_samples(Imu(time_ns, gentle))
    assert found[(t > 1.0) & (t < 20.0)].mean() > 0.95
    assert not found[t > 20.5].any()
    assert not tilt.static_samples(Imu(time_ns, own + np.deg2rad(3.0) * moves)).any()


def test_a_run_that_never_rests():
    """The quietest seconds of a motion taken for rest, for want of better ones."""
    for seed in range(5):
        imu, _ = carried(attitude_runs.free_motion(seed, rest_s=0.0), times(100.0, 60.0))
        assert not tilt.static_samples(imu).any()
        assert not tilt.static_samples(Imu(imu.time_ns, imu.gyroscope)).any()


@pytest.mark.parametrize("gap_s", [0.5, 5.0])
def test_rest_over_a_gap(gap_s):
    """Rest that is lost for good where samples are missing: all of it is found again within a second."""
    imu = resting(3000)
    t = attitude_runs.seconds(imu.time_ns)
    there = (t < 10.0) | (t >= 10.0 + gap_s)
    there &= np.random.default_rng(0).random(len(t)) > 0.05
    kept = {key: getattr(imu, key)[there] for key in imu.per_sample}
    found = tilt.static_samples(Imu(imu.time_ns[there], **kept))
    late = (t[there] > 1.2) & ((t[there] < 10.0) | (t[there] > 11.2 + gap_s))
    assert found[late].mean() > 0.95


@pytest.mark.parametrize("count", [1, 2, 3, 50, 99, 100, 101])
def test_short_runs(count):
    """An error, or rest that nobody has seen for a second."""
    imu = resting(count)
    found = tilt.static_samples(imu)
    assert found.shape == (count,) and not found[:99].any()
    assert found[99:].all()
    up = tilt.up_in_body(imu)
    expected = np.tile(MOUNT.inv().apply(UP), (count, 1))
    assert np.rad2deg(angles(up, expected).max()) < 1.0
    assert np.isfinite(tilt.magnetic_field(imu).dip).all()


def test_readings_that_do_not_scatter():
    """No rest where readings repeat to the last bit, because none scatters less than the quietest: of a
    simulated sensor without noise, and of one that is rounded coarsely."""
    assert tilt.static_samples(resting(1000, (0.0, 0.0, 0.0)))[99:].all()
    fine = resting(6000, (3e-4, 5e-3, 0.0))
    coarse = replace(
        fine,
        gyroscope=1e-3 * np.round(fine.gyroscope / 1e-3),
        accelerometer=0.02 * np.round(fine.accelerometer / 0.02),
    )
    assert tilt.static_samples(coarse)[99:].mean() > 0.98


def test_the_field_is_felt():
    """A dip above the horizontal, or one against the specific force of a shaken hand."""
    imu, _ = carried(attitude_runs.free_motion(2), times(100.0, 60.0), 2.0, (1e-3, 0.02, 0.3))
    late = attitude_runs.seconds(imu.time_ns) > 5.0
    norm, dip = tilt.magnetic_field(imu)
    assert np.median(norm) == pytest.approx(48.0, abs=0.1)
    assert np.median(dip[late]) == pytest.approx(DIP, abs=np.deg2rad(0.2))
    assert np.std(dip[late]) < np.deg2rad(1.0)


@pytest.mark.parametrize("blank", [np.nan, np.inf, 0.0])
def test_a_slower_magnetometer_spoils_no_other_sample(blank):
    """NaN that goes from samples that were not read to those that were, or zeros that stand for them taken
    for a field."""
    imu, _ = carried(attitude_runs.free_motion(2), times(100.0, 20.0), 2.0)
    whole = tilt.magnetic_field(imu)
    read = np.arange(len(imu.time_ns)) % 4 == 1
    slower = np.where(read[:, None], imu.magnetometer, blank)
    found = tilt.magnetic_field(replace(imu, magnetometer=slower))
    for a, b in zip(found, whole, strict=True):
        np.testing.assert_array_equal(a[read], b[read])
        assert np.isnan(a[~read]).all()
    half = imu.magnetometer.copy()
    half[7, 1] = np.nan
    found = tilt.magnetic_field(replace(imu, magnetometer=half))
    assert np.flatnonzero(np.isnan(found.dip)).tolist() == [7]


def recording(info, imu=None):
    """A hand-held run in east, north, up."""
    if imu is None:
        imu, _ = carried(attitude_runs.free_motion(2), times(100.0, 30.0), 1.0)
    return Recording("run", imu=imu, info=info)


@pytest.mark.parametrize("name", TO_OTHER)
def test_the_field_in_any_reference_frame(name):
    """Up taken for z or north for y, a dip that is added upwards, or the stated dip believed: only the
    horizontal direction of what is stated counts."""
    frame = TO_OTHER[name]
    up, north = frame.apply(UP), frame.apply([0.0, 1.0, 0.0])
    for steepness in (0.0, 0.3, -4.0):
        found = earth.setup(
            recording(
                {
                    "gravity_ref": (-9.81 * up).tolist(),
                    "field_ref": (20.0 * (north + steepness * up)).tolist(),
                }
            )
        )
        np.testing.assert_allclose(found.gravity_ref, -9.81 * up, atol=1e-12)
        np.testing.assert_allclose(np.linalg.norm(found.field_ref), 1.0, atol=1e-12)
        off = angles(found.field_ref[None], frame.apply(FIELD)[None] / 48.0)
        assert off[0] < np.deg2rad(1.0)


def test_without_a_word_the_reference_is_east_north_up():
    """A default that is not the one that is documented, or that differs from the model's own."""
    found = earth.setup(recording({}))
    assert angles(found.field_ref[None], FIELD[None] / 48.0)[0] < np.deg2rad(1.0)
    np.testing.assert_array_equal(found.gravity_ref, earth.GRAVITY_REF)
    np.testing.assert_array_equal(earth.SETUP.gravity_ref, earth.GRAVITY_REF)
    assert angles(earth.SETUP.field_ref[None], FIELD[None] / 48.0)[0] < np.deg2rad(3.1)


@pytest.mark.parametrize(
    ("info", "words"),
    [
        ({"field_ref": [0.0, 0.0, -1.0]}, "along gravity_ref"),
        ({"gravity_ref": [0.1, 0.0, -9.8], "field_ref": [-0.2, 0.0, 19.6]}, "along gravity_ref"),
        ({"gravity_ref": [0.0, -9.8, 0.0]}, "stating another field_ref"),
        ({"field_ref": [0.0, 0.0, 0.0]}, "not all 0"),
        ({"field_ref": [1.0, 0.0]}, "3 finite numbers"),
        ({"gravity_ref": [0.0, 0.0, np.nan]}, "gravity_ref"),
    ],
)
def test_a_field_without_a_north_is_refused(info, words):
    """North out of rounding errors, or NaN in all that follows."""
    with pytest.raises(RecordingError, match=words) as caught:
        earth.setup(recording(info))
    assert caught.value.column in ("field_ref", "gravity_ref")


@pytest.mark.parametrize("sensor", ["accelerometer", "magnetometer"])
def test_both_sensors_are_needed(sensor):
    """A traceback, or an attitude out of a sensor that is not there."""
    imu = resting(200)
    assert earth.require_marg_imu(recording({}, imu)) is imu
    for value in (None, np.full((200, 3), np.nan), np.zeros((200, 3))):
        with pytest.raises(RecordingError, match=f"an IMU without {sensor}"):
            earth.require_marg_imu(recording({}, replace(imu, **{sensor: value})))
    with pytest.raises(RecordingError, match="no imu stream"):
        earth.require_marg_imu(Recording("run"))


def test_samples_that_are_not_finite_are_left_out():
    """One NaN of a run made in memory, after which there is neither rest nor up."""
    imu = resting(1000)
    for key, row in (("gyroscope", 500), ("accelerometer", 600), ("magnetometer", 700)):
        spoilt = getattr(imu, key).copy()
        spoilt[row, 1] = np.nan
        imu = replace(imu, **{key: spoilt})
    left = earth.require_marg_imu(recording({}, imu))
    assert np.setdiff1d(imu.time_ns, left.time_ns).tolist() == imu.time_ns[[500, 600]].tolist()
    assert np.isnan(tilt.magnetic_field(left).dip).sum() == 1
    assert tilt.static_samples(left)[99:].mean() > 0.98
    assert earth.setup(recording({}, imu)).field_ref[2] == pytest.approx(-np.sin(DIP), abs=0.01)


def kept(time_ns, good=None):
    """Rows that are left of a sensor with these stamps."""
    imu = Imu(time_ns, np.zeros((len(time_ns), 3)))
    good = np.ones(len(time_ns), bool) if good is None else good
    rows = earth.thinned(imu, good)
    assert good[rows].all()
    return rows


@pytest.mark.parametrize(
    ("hertz", "nth"),
    [(1000.0, 10), (500.0, 5), (286.0, 3), (100.0, 1), (99.0, 1), (50.0, 1), (1.0, 1)],
)
def test_a_hundred_a_second_are_kept(hertz, nth):
    """Samples of a slow sensor lost, all of a fast one kept, or steps that are not even."""
    rows = kept(times(hertz, 20.0))
    assert rows.tolist() == list(range(0, int(20.0 * hertz) + 1, nth))


def test_thinning_looks_at_the_samples_that_are_good():
    """A magnetometer of 20 Hz beside a gyroscope of 286 Hz of which one sample in three is kept."""
    good = np.arange(5720) % 14 == 5
    np.testing.assert_array_equal(kept(times(286.0, 20.0)[:5720], good), np.flatnonzero(good))
    for few in ([], [7], [7, 400]):
        good = np.isin(np.arange(5720), few)
        assert kept(times(286.0, 20.0)[:5720], good).tolist() == few


@pytest.mark.parametrize("kind", ["jitter", "bunches", "gaps", "lost"])
def test_thinning_of_uneven_stamps(kind):
    """A rate read off one step in the middle: with stamps in bunches it is that within a bunch."""
    time_ns = times(1000.0, 20.0)
    if kind == "jitter":
        time_ns = time_ns + np.random.default_rng(0).integers(-400_000, 400_000, len(time_ns))
    elif kind == "bunches":
        number = np.arange(len(time_ns))
        time_ns = time_ns[number - number % 10] + number % 10 * 50_000
    elif kind == "gaps":
        t = attitude_runs.seconds(time_ns)
        time_ns = time_ns[(t < 2.0) | ((t > 9.0) & (t < 9.5)) | (t > 17.0)]
    else:
        time_ns = time_ns[np.random.default_rng(0).random(len(time_ns)) > 0.1]
    rows = kept(time_ns)
    steps = np.diff(time_ns[rows]) / NANOSECONDS
    assert np.median(steps) == pytest.approx(0.01, rel=0.15)
    assert steps[steps < 1.0].max() < 0.025
