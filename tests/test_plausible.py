"""Units, order of the quaternion, gravity and overlap: what is contradicted is named, no more."""

import os
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from jaxekf._support.constants import STANDARD_GRAVITY
from jaxekf._support.errors import RecordingError
from jaxekf.checks import plausibility
from jaxekf.io.importers import asl, broad
from jaxekf.pose_solvers.marker_pose import from_markers
from jaxekf.recordings.types import Imu, Optical, Recording, from_scipy, to_scipy
from jaxekf.simulation import attitude_runs, marker_runs

LONG = os.environ.get("JAXEKF_LONG") == "1"
CONJUGATE = np.array([1.0, -1.0, -1.0, -1.0])
DEGREES = np.rad2deg(1.0)


def tool_pose(seed, size=1.0):
    """Poses of a moved tool, an accelerometer, and a tracked frame that lies 60 deg turned in the IMU's."""
    motion = marker_runs.free_tool_motion(seed)
    motion = replace(motion, amplitude=size * motion.amplitude)
    run = marker_runs.tool_recording("run", motion, seed=seed, duration_s=30.0)
    pose = from_markers(run.markers)
    turn = Rotation.from_rotvec(np.deg2rad([20.0, 0.0, 56.0]))
    q = from_scipy(to_scipy(pose.q_ref_body) * turn)
    return run.replace(
        markers=None,
        optical=replace(pose, q_ref_body=q, position=pose.position + np.array([0.3, -0.2, -1.5])),
    )


def turned(run, how):
    return run.replace(optical=replace(run.optical, q_ref_body=how(run.optical.q_ref_body)))


def moved(run, factor):
    return run.replace(optical=replace(run.optical, position=factor * run.optical.position))


def scaled(run, rate=1.0, force=1.0):
    imu = run.imu
    force = imu.accelerometer if imu.accelerometer is None else force * imu.accelerometer
    return run.replace(imu=replace(imu, gyroscope=rate * imu.gyroscope, accelerometer=force))


def stated(run, quaternion):
    return run.replace(info={**run.info, "optical_about": {"quaternion": quaternion}})


def weightless(run):
    """The accelerometer without gravity."""
    q = to_scipy(run.encoder.q_ref_body)
    force = run.imu.accelerometer + q.inv().apply(run.info["gravity_ref"])
    return run.replace(imu=replace(run.imu, accelerometer=force))


def apart(run):
    return run.replace(imu=replace(run.imu, time_ns=run.imu.time_ns + 10**12))


def rough(run, seed):
    """200 ms off, every fiftieth pose wrong, and gaps."""
    rng = np.random.default_rng(seed)
    optical = run.optical
    q, valid = optical.q_ref_body.copy(), optical.valid.copy()
    bad = rng.choice(len(q), len(q) // 50, replace=False)
    q[bad] = from_scipy(Rotation.random(len(bad), random_state=seed))
    for begin in rng.choice(len(q), 5):
        valid[begin : begin + 50] = False
    time_ns = optical.time_ns + int(rng.choice([-1, 1])) * 200_000_000
    return run.replace(optical=replace(optical, q_ref_body=q, valid=valid, time_ns=time_ns))


FAULTS = {
    "scalar last": (
        lambda run: turned(run, lambda q: np.roll(q, -1, axis=1)),
        'quaternion = "x,y,z,w, body to reference"',
    ),
    "scalar first": (
        lambda run: stated(turned(run, lambda q: np.roll(q, 1, axis=1)), "x,y,z,w"),
        'quaternion = "w,x,y,z, body to reference"',
    ),
    "conjugate": (
        lambda run: turned(run, lambda q: q * CONJUGATE),
        'quaternion = "w,x,y,z, reference to body"',
    ),
    "deg/s": (lambda run: scaled(run, rate=DEGREES), r'57\..*unit = "deg/s, m/s\^2"'),
    "rad/s": (lambda run: scaled(run, rate=1 / DEGREES), r'0\.017.*unit = "rad/s, m/s\^2"'),
    "mm": (lambda run: moved(run, 1e3), r'\d{3,4}(\.\d)? times as far .*unit = "1, mm"'),
    "m": (lambda run: moved(run, 1e-3), r'0\.00\d+ times as far.*unit = "1, m"'),
    "g": (lambda run: scaled(run, force=1 / STANDARD_GRAVITY), 'unit = "rad/s, g"'),
    "not g": (lambda run: scaled(run, force=STANDARD_GRAVITY), r'unit = "rad/s, m/s\^2"'),
    "deg/s and g": (lambda run: scaled(run, DEGREES, 1 / STANDARD_GRAVITY), 'unit = "deg/s, g"'),
    "no gravity": (weightless, "gravity is removed"),
    "apart": (apart, r"optical from .* to .* imu from 1000\.000 to 1030\.000 s.*overlap"),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_what_is_contradicted_is_named(fault):
    """A wrong unit, order or direction that is taken as it stands, or another entry named for it; also
    where the clocks are 200 ms apart and poses are wrong."""
    make, message = FAULTS[fault]
    for seed in range(6 if LONG else 2):
        run = tool_pose(seed)
        plausibility.require(run)
        plausibility.require(rough(run, seed))
        for wrong in (make(run), make(rough(run, seed))):
            with pytest.raises(RecordingError, match=message):
                plausibility.require(wrong)


def test_the_likelier_reading_is_named_first():
    """Of order and direction, which turns alone do not part, the one that turns axes for nothing."""
    run = attitude_runs.recording("run", attitude_runs.free_motion(1), seed=1, duration_s=30.0)
    plausibility.require(run)
    for fault in ("scalar last", "scalar first", "conjugate"):
        make, message = FAULTS[fault]
        with pytest.raises(RecordingError, match=r"\[optical\] " + message + " or quaternion"):
            plausibility.require(make(run))


@pytest.mark.parametrize("said", ["w,x,y,z,reference to body", "reference to body"])
def test_advice_says_order_and_direction_however_they_were_written(said):
    """Would catch advice that leaves a word of what was stated in the order's place."""
    run = tool_pose(1)
    with pytest.raises(RecordingError, match='quaternion = "w,x,y,z, body to reference"'):
        plausibility.require(
            stated(run, said).replace(optical=turned(run, lambda q: q * CONJUGATE).optical)
        )


def test_markers_in_millimetres():
    """A geometry that is called another tool's where only the unit is another."""
    motion = marker_runs.free_tool_motion(1)
    run = marker_runs.tool_recording("run", motion, seed=1, duration_s=10.0)
    plausibility.require(run)
    found = plausibility.evidence(run)
    assert found.explained > 0.95 and 0.95 < found.rate_ratio < 1.05
    for factor, message in ((1e3, r'1000 times.*\[markers\] unit = "mm"'), (1e-3, "geometry")):
        markers = replace(run.markers, position=factor * run.markers.position)
        with pytest.raises(RecordingError, match=message):
            plausibility.require(run.replace(markers=markers))
    with pytest.raises(RecordingError, match=r'57.*"deg/s, m/s'):
        plausibility.require(scaled(run, rate=DEGREES))


def test_the_file_and_entry_are_named(tmp_path):
    """An error that does not say where to mend it."""
    run = FAULTS["deg/s"][0](tool_pose(0))
    (tmp_path / "recording.toml").write_text("schema_version = 1\n")
    with pytest.raises(RecordingError, match=r"recording.toml:imu\.unit: got") as caught:
        plausibility.require(run.replace(path=tmp_path))
    assert caught.value.column == "imu.unit"


def weak_motions():
    """What tells little or nothing: rest, slow and constant turns, turns about one axis."""
    yield attitude_runs.Motion()
    yield attitude_runs.Motion(rate=(0.01, 0.0, -0.02))
    yield attitude_runs.constant_rate_motion(rest_s=5.0)
    yield attitude_runs.free_motion(3, speed_deg=2.0)
    one = attitude_runs.free_motion(4)
    yield replace(one, amplitude=one.amplitude * np.array([[1.0], [0.0], [0.0]]))


@pytest.mark.parametrize("seed", range(20 if LONG else 2))
def test_no_false_alarm_of_weak_motion(seed):
    """An alarm where nothing is told, or an answer made up from noise."""
    rng = np.random.default_rng(seed)
    for motion in weak_motions():
        grade = attitude_runs.SensorGrade(
            gyroscope_deg=10 ** rng.uniform(-2, 0),
            bias_deg=3.0,
            optical_deg=10 ** rng.uniform(-2, 0),
        )
        run = attitude_runs.recording("run", motion, seed=seed, duration_s=20.0, grade=grade)
        plausibility.require(run)
        plausibility.require(rough(run, seed))
    rest = attitude_runs.recording("run", attitude_runs.Motion(), seed=seed, duration_s=20.0)
    assert np.isnan(plausibility.evidence(rest).rate_ratio)
    plausibility.require(tool_pose(seed, size=0.0))


def test_one_axis_does_not_tell_the_order():
    """An order made up where turns about one axis fit every reading."""
    run = attitude_runs.recording(
        "run", attitude_runs.constant_rate_motion(), seed=0, duration_s=30.0
    )
    plausibility.require(turned(run, lambda q: q * CONJUGATE))
    assert plausibility.evidence(run).second_axis < 0.05


def test_one_axis_does_not_tell_where_gravity_is():
    """Would catch a direction made up about the one axis that a tool on a spindle turns about."""
    rng = np.random.default_rng(0)
    time_ns = np.arange(0, 30_000_000_000, 10_000_000)
    t = 1e-9 * time_ns
    angle, rate = np.sin(2.0 * t), 2.0 * np.cos(2.0 * t)
    along = Rotation.from_euler("y", 90.0, degrees=True)
    attitude = along * Rotation.from_rotvec(angle[:, None] * [0.0, 0.0, 1.0])
    seen = attitude * Rotation.from_rotvec(2e-3 * rng.standard_normal((len(t), 3)))
    # The IMU lies the other way round on the spindle, which its rate does not tell.
    about = Rotation.from_euler("z", 180.0, degrees=True)
    force = about.apply(attitude.inv().apply([0.0, 0.0, 9.81]))
    gyroscope = rate[:, None] * [0.0, 0.0, 1.0] + 1e-3 * rng.standard_normal((len(t), 3))
    spindle = Recording(
        "spindle",
        optical=Optical(time_ns, from_scipy(seen), np.ones(len(t), bool)),
        imu=Imu(time_ns, gyroscope, force),
        info={"gravity_ref": [0.0, 0.0, -9.81]},
    )
    found = plausibility.evidence(spindle)
    assert found.explained > 0.95 and found.mean_force > 5.0
    plausibility.require(spindle)


def test_gravity_the_other_way_round():
    """Would catch gravity_ref that is what an accelerometer at rest reads, of another axis or in g, which a
    filter takes for an acceleration; or a true one, a few degrees off, that is refused."""
    run = tool_pose(3)
    assert "gravity_ref" in run.info
    fall = np.asarray(run.info["gravity_ref"])

    def require(gravity):
        plausibility.require(run.replace(info={**run.info, "gravity_ref": list(gravity)}))

    require(fall)
    require(Rotation.from_rotvec([0.3, 0.0, 0.0]).apply(fall))
    for wrong, said in ((-fall, "1[78]. deg off"), (np.roll(fall, 1), "[89]. deg off")):
        with pytest.raises(RecordingError, match=f"{said}.*in the reference frame.*gravity_ref"):
            require(wrong)
    still = scaled(run, rate=0.0)
    still = still.replace(
        optical=None,
        imu=replace(still.imu, accelerometer=np.tile(-fall, (len(run.imu.time_ns), 1))),
    )
    for size, said in ((1.0 / STANDARD_GRAVITY, "gravity of 1 m/s"), (1e3, "gravity of 9.8")):
        with pytest.raises(RecordingError, match=f"{said}.*about 9.8"):
            plausibility.require(still.replace(info={"gravity_ref": list(size * fall)}))


def test_what_is_missing_is_not_judged():
    """A crash on a run without IMU, tracker, position or accelerometer, or of a few samples."""
    run = tool_pose(0)
    bare = replace(run.optical, position=None)
    force = replace(run.imu, accelerometer=None)
    hidden = replace(run.optical, valid=np.zeros(len(run.optical.time_ns), bool))
    for less in (
        run.replace(imu=None),
        run.replace(optical=None),
        run.replace(optical=bare),
        run.replace(imu=force),
        run.replace(optical=hidden),
        run.replace(imu=replace(force, time_ns=force.time_ns[:1], gyroscope=force.gyroscope[:1])),
    ):
        plausibility.require(less)
        assert plausibility.evidence(less).as_dict()["explained"] is not None


def real_runs(data_dir):
    trials = sorted((data_dir / "broad").glob("*.mat"))
    rooms = [data_dir / "tumvi" / f"room{i}" for i in (1, 3, 4)]
    chosen = (trials, rooms) if LONG else ([broad.find(data_dir / "broad", 7)], rooms[2:])
    for i, trial in enumerate(chosen[0]):
        run = broad.load(trial)
        yield run
        yield broad.degrade(run, seed=0, trial=i)
    yield from (asl.load(room) for room in chosen[1])


def test_real_runs(data_dir):
    """False alarms on real recordings, or a wrong order in them that passes."""
    for i, run in enumerate(real_runs(data_dir)):
        found = plausibility.evidence(run)
        plausibility.check(run, found)
        assert found.explained > 0.95 and abs(found.rate_ratio - 1.0) < 0.01
        assert abs(found.static_norm - 9.81) < 0.15
        plausibility.require(rough(run, i))
        for fault in ("scalar last", "scalar first", "conjugate", "deg/s", "rad/s", "g", "mm", "m"):
            make, message = FAULTS[fault]
            with pytest.raises(RecordingError, match=message):
                plausibility.require(make(run))
