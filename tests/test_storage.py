"""Recorded runs on disk: what is written is read again, and what is wrong is said in one line."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import jaxekf
from jaxekf._support.errors import RecordingError
from jaxekf.io import atomic, csv_table, run_folder
from jaxekf.io.description import Source
from jaxekf.io.streams import encoder as encoder_storage
from jaxekf.recordings.types import Encoder, Imu, Optical, Recording
from jaxekf.simulation import attitude_runs

BIG = 1_700_000_000_123_456_789


def constant(seed=1):
    return attitude_runs.recording(
        "run",
        attitude_runs.constant_rate_motion(rest_s=0.3),
        seed=seed,
        duration_s=1.0,
        start_ns=BIG,
        occlusions=[(0.5, 0.6)],
    )


@pytest.fixture
def folder(tmp_path):
    return run_folder.save(constant(), tmp_path / "run")


def edit(file, old, new, count=1):
    text = file.read_text()
    assert old in text
    file.write_text(text.replace(old, new, count))


@pytest.mark.parametrize(
    "motion", [attitude_runs.constant_rate_motion(), attitude_runs.free_motion(3)]
)
def test_round_trip(tmp_path, motion):
    """Would catch a lost digit of time, a hidden sample that comes back, or a joint on the wrong side."""
    record = attitude_runs.recording(
        "run", motion, seed=2, duration_s=12.0, start_ns=BIG, dropouts=0.1
    )
    again = jaxekf.load(jaxekf.save(record, tmp_path / "run"))
    assert again.name == "run"
    np.testing.assert_array_equal(again.imu.time_ns, record.imu.time_ns)
    np.testing.assert_array_equal(again.optical.valid, record.optical.valid)
    np.testing.assert_array_equal(again.imu.gyroscope, record.imu.gyroscope)
    seen = record.optical.valid
    np.testing.assert_allclose(
        again.optical.q_ref_body[seen], record.optical.q_ref_body[seen], atol=1e-15
    )
    np.testing.assert_array_equal(again.optical.position[seen], record.optical.position[seen])
    dot = np.abs(np.sum(again.encoder.q_ref_body * record.encoder.q_ref_body, axis=1))
    np.testing.assert_allclose(dot, 1.0, atol=1e-14)
    twice = jaxekf.load(jaxekf.save(again, tmp_path / "again"))
    assert twice.info == again.info


@given(st.integers(0, 2**62))
def test_times_are_exact(time_ns):
    """Would catch a time that passes through a float: 1.7e9 s has steps of 238 ns there."""
    assert csv_table.parse_seconds(csv_table.format_seconds(time_ns)) == time_ns


@pytest.mark.parametrize(
    ("text", "expected"),
    [("1.5", 1_500_000_000), ("-0.25", -250_000_000), ("1e-3", 1_000_000), ("2", 2_000_000_000)],
)
def test_times_in_other_writing(text, expected):
    """Would catch a parser that knows one way to write a number only."""
    assert csv_table.parse_seconds(text) == expected


def test_encoder_frames_and_sides(tmp_path):
    """Would catch the joint's axis, zero or frame applied on the wrong side."""
    from scipy.spatial.transform import Rotation

    zero, frame = Rotation.from_rotvec([0.3, 0.2, -0.1]), Rotation.from_rotvec([0.0, 0.5, 0.2])
    turn = Rotation.from_rotvec(0.7 * np.array([0.0, 0.0, 1.0]))

    def read(side):
        about = {
            "axis": [0.0, 0.0, 2.0],
            "acts_on": side,
            "q_zero": np.roll(zero.as_quat(), 1).tolist(),
            "q_optical_encoder": np.roll(frame.as_quat(), 1).tolist(),
        }
        (tmp_path / "encoder.csv").write_text("time,angle\n0,0.7\n")
        table = csv_table.read_table(tmp_path / "encoder.csv")
        stream, _ = encoder_storage.SCHEMA.read_table(table, Source(about, tmp_path, sort=False))
        return Rotation.from_quat(np.roll(stream.q_ref_body[0], -1))

    for side, expected in (("reference", frame * turn * zero), ("body", frame * zero * turn)):
        assert (read(side).inv() * expected).magnitude() < 1e-12


CASES = {
    "missing folder": (lambda f: f.rename(f.parent / "gone"), "no such folder", None),
    "missing description": (lambda f: (f / "recording.toml").unlink(), "no such file", None),
    "missing stream": (lambda f: (f / "imu.csv").unlink(), "no such file", None),
    "missing column": (lambda f: edit(f / "imu.csv", "gz", "gw"), "time,gx,gy,gw", None),
    "repeated column": (lambda f: edit(f / "imu.csv", "gz", "gy"), "each once", None),
    "unequal lengths": (
        lambda f: edit(f / "imu.csv", ".131456789,", ".131456789,1,"),
        "5 cells",
        3,
    ),
    "text cell": (lambda f: edit(f / "encoder.csv", ".131456789,0", ".131456789,abc"), "'abc'", 3),
    "text time": (lambda f: edit(f / "imu.csv", "1700000000.131456789", "noon"), "'noon'", 3),
    "time backwards": (
        lambda f: edit(f / "imu.csv", "1700000000.139", "1600000000.139"),
        "increase",
        4,
    ),
    "empty file": (lambda f: (f / "imu.csv").write_text(""), "empty", None),
    "header only": (lambda f: (f / "imu.csv").write_text("time,gx,gy,gz\n"), "0 samples", None),
    "no axis": (lambda f: edit(f / "recording.toml", "axis =", "axes ="), "axis = [x, y, z]", None),
    "not TOML": (lambda f: (f / "recording.toml").write_text("a = = 1"), "not TOML", None),
    "axis of nothing": (lambda f: edit(f / "recording.toml", "1.0,", "0.0,"), "encoder.axis", None),
    "other unit": (lambda f: edit(f / "recording.toml", "rad/s, m/s^2", "rpm"), "'rpm'", None),
    "other order": (lambda f: edit(f / "recording.toml", "w,x,y,z,", "x,y,z,x,"), "x,y,z,x", None),
    "name of a path": (
        lambda f: edit(f / "recording.toml", 'name = "run"', 'name = "../x"'),
        "../x",
        None,
    ),
    "later version": (
        lambda f: edit(f / "recording.toml", "version = 1", "version = 9"),
        "9",
        None,
    ),
}


@pytest.mark.parametrize("case", CASES)
def test_faults_are_named(folder, case):
    """Would catch a traceback, a message without its place, or a fault that is read as data."""
    spoil, words, line = CASES[case]
    spoil(folder)
    with pytest.raises(RecordingError) as caught:
        jaxekf.load(folder)
    message = str(caught.value)
    assert words in message
    for word in (": got ", ", expected ", "; try "):
        assert word in message
    assert "\n" not in message
    if line is not None:
        assert caught.value.line == line


def test_zero_quaternion_is_a_missing_tool(folder):
    """Would catch a lost tool that is taken for a pose."""
    file = folder / "optical.csv"
    lines = file.read_text().splitlines()
    cells = lines[3].split(",")
    lines[3] = ",".join([cells[0], "0", "0", "0", "0", *cells[5:]])
    file.write_text("\n".join(lines))
    optical = jaxekf.load(folder).need_optical()
    assert not optical.valid[2]
    assert optical.valid[[0, 1, 3]].all()


def test_status_column_masks(folder):
    """Would catch a tracker's own word for 'missing' being ignored."""
    file = folder / "optical.csv"
    lines = file.read_text().splitlines()
    status = ["OK", "MISSING"] * len(lines)
    file.write_text(
        "\n".join(
            [lines[0] + ",status", *[f"{a},{b}" for a, b in zip(lines[1:], status, strict=False)]]
        )
    )
    valid = jaxekf.load(folder).need_optical().valid
    assert valid[0]
    assert not valid[1::2].any()


def test_no_overlap_prints_both_ranges(folder):
    """Would catch an estimate from streams of two different days."""
    record = jaxekf.load(folder)
    imu = record.need_imu()
    moved = record.replace(imu=Imu(imu.time_ns + 10**12, imu.gyroscope))
    with pytest.raises(RecordingError, match=r"overlap.*") as caught:
        jaxekf.estimate(moved)
    assert "1700000000.1" in str(caught.value)
    assert "1700001000.1" in str(caught.value)


def test_never_seen_is_an_error(folder):
    """Would catch a run that starts from a made-up attitude."""
    record = jaxekf.load(folder)
    optical = record.need_optical()
    hidden = Optical(optical.time_ns, optical.q_ref_body, np.zeros(len(optical.time_ns), bool))
    with pytest.raises(RecordingError, match="no visible sample"):
        jaxekf.estimate(record.replace(optical=hidden))


@pytest.mark.parametrize(
    "make",
    [
        lambda t: Imu(t, np.zeros((4, 3))),
        lambda t: Imu(t[::-1].copy(), np.zeros((5, 3))),
        lambda t: Imu(t.astype(float), np.zeros((5, 3))),
        lambda t: Imu(t[:0], np.zeros((0, 3))),
    ],
    ids=["lengths", "order", "float time", "empty"],
)
def test_recordings_in_memory_are_checked(make):
    """Would catch arrays that do not fit together reaching the filter."""
    with pytest.raises(RecordingError):
        Recording("run", imu=make(np.arange(5, dtype=np.int64)))


def test_output_is_whole_or_not_there(tmp_path):
    """Would catch a half-written folder, or an old result lost to a failed new one."""
    target = tmp_path / "out"
    with pytest.raises(ZeroDivisionError), atomic.whole_folder(target, "recording.toml") as folder:
        (folder / "a").write_text("half")
        raise ZeroDivisionError
    assert list(tmp_path.iterdir()) == []
    run_folder.save(constant(), target)
    with pytest.raises(RecordingError, match="exists"):
        run_folder.save(constant(), target)
    before = sorted(p.name for p in target.iterdir())
    with (
        pytest.raises(ZeroDivisionError),
        atomic.whole_folder(target, "recording.toml", overwrite=True),
    ):
        raise ZeroDivisionError
    assert sorted(p.name for p in target.iterdir()) == before


def test_encoder_interpolation_invents_nothing():
    """Would catch truth made up over gaps, outside the run, or scored where it was unknown."""
    from jaxekf.recordings.truth import encoder_at

    times = np.array([0, 10, 20, 400, 410], np.int64) * 1_000_000
    q = np.tile([1.0, 0.0, 0.0, 0.0], (5, 1))
    encoder = Encoder(times, q, np.array([1, 1, 0, 1, 1], bool), np.ones(5, bool))
    at = encoder_at(encoder, np.array([-5, 0, 5, 20, 200, 405, 500], np.int64) * 1_000_000)
    assert at.valid.tolist() == [False, True, True, False, False, True, False]
    assert at.scored.tolist() == [False, True, True, False, False, True, False]


def test_overwriting_replaces_only_its_own_kind(tmp_path):
    """Would catch a result that replaces the recording it came from."""
    target = run_folder.save(constant(), tmp_path / "run")
    with pytest.raises(RecordingError, match=r"holds no result.json"):
        atomic.check_output(target, "result.json", overwrite=True)
    (tmp_path / "empty").mkdir()
    atomic.check_output(tmp_path / "empty", "result.json")
    (tmp_path / "link").symlink_to(target)
    run_folder.save(constant(2), tmp_path / "link", overwrite=True)
    assert (tmp_path / "link").is_symlink()
    assert jaxekf.load(target).info["seed"] == 2


def test_one_word_for_a_good_status(folder):
    """Would catch a string that is read letter by letter."""
    file = folder / "optical.csv"
    lines = file.read_text().splitlines()
    status = ["ok" if i % 2 else "o" for i in range(len(lines))]
    status[0] = "status"
    file.write_text("\n".join(f"{a},{b}" for a, b in zip(lines, status, strict=True)))
    edit(folder / "recording.toml", "[optical]", '[optical]\nstatus_ok = "ok"')
    valid = jaxekf.load(folder).need_optical().valid
    assert valid[0]
    assert not valid[1::2].any()


def without(stream, hidden):
    """A stream with some rows taken away."""
    return stream.take(~hidden)


def test_a_gap_in_the_input_is_not_bridged():
    """Would catch motion made up while nothing was measured: attitude wrong by degrees, unnoticed."""
    record = attitude_runs.recording("run", attitude_runs.free_motion(1), seed=1, duration_s=6.0)
    t = (record.imu.time_ns - record.imu.time_ns[0]) / 1e9
    gap = record.replace(imu=without(record.imu, (t > 3.0) & (t < 3.5)))
    with pytest.raises(RecordingError, match=r"gap of 0\.5.* s in gyroscope"):
        jaxekf.estimate(gap)
    assert jaxekf.score(jaxekf.estimate(gap, "loose_rate"), gap).attitude_rmse_deg < 1.0
    short = record.replace(imu=without(record.imu, (t > 3.0) & (t < 3.05)))
    assert jaxekf.score(jaxekf.estimate(short), short).attitude_rmse_deg < 0.3
    one = record.replace(imu=without(record.imu, t > 0.0))
    with pytest.raises(RecordingError, match="1 samples of gyroscope"):
        jaxekf.estimate(one)


def test_rate_truth_is_not_made_up_over_gaps():
    """Would catch a rate by differences over a hole in the encoder."""
    from jaxekf.recordings.truth import encoder_rate_at

    record = attitude_runs.recording("run", attitude_runs.free_motion(1), seed=1, duration_s=6.0)
    encoder = record.need_encoder()
    t = (encoder.time_ns - encoder.time_ns[0]) / 1e9
    known = encoder_rate_at(encoder, encoder.time_ns)
    holed = encoder_rate_at(without(encoder, (t > 3.0) & (t < 4.0)), encoder.time_ns)
    assert np.isnan(holed[(t > 3.0) & (t < 4.0)]).all()
    told = np.isfinite(holed).all(axis=1)
    np.testing.assert_allclose(holed[told], known[told], atol=1e-9)
    assert told.mean() > 0.8


def test_held_samples_go_stale(tmp_path):
    """Would catch a gyroscope that has stopped being held for the rest of the run."""
    record = attitude_runs.recording(
        "run", attitude_runs.constant_rate_motion(rest_s=0.5), seed=1, duration_s=4.0
    )
    t = (record.imu.time_ns - record.imu.time_ns[0]) / 1e9
    made = jaxekf.estimate(record.replace(imu=without(record.imu, t > 2.0)), "loose_additive")
    account = made.account["gyroscope"]
    assert account["used"] == 126
    assert account["dropped_by_holding"] == 125
    used = made.sensors["gyroscope"].used.any(axis=1)
    assert used.sum() <= 128


def test_aux_of_hidden_samples_is_made_finite():
    """Would catch a NaN beside a hidden sample that reaches the gradient of the noise."""
    from dataclasses import replace

    from jaxekf import get_model
    from jaxekf.estimation import timeline
    from jaxekf.recordings.types import Samples

    loose = get_model("loose")
    source = loose.sensors[0].source

    def with_quality(visible):
        def read(record):
            samples = source(record)
            quality = np.where(visible & samples.mask, 2.0, np.nan)
            return Samples(samples.time_ns, samples.value, samples.mask, quality)

        return replace(loose, sensors=(replace(loose.sensors[0], source=read),))

    rows = timeline.build(with_quality(True), constant()).steps.slow["optical"]
    assert not rows.mask.all()
    np.testing.assert_array_equal(rows.aux, 2.0)
    with pytest.raises(RecordingError, match="auxiliary data of optical"):
        timeline.build(with_quality(False), constant())
