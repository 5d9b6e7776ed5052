"""Markers, latency, fit errors, positions of truth and the object's frame on disk."""

import tomllib
from dataclasses import replace

import numpy as np
import pytest
import tomli_w

import jaxekf
from jaxekf._support.errors import RecordingError
from jaxekf.recordings import facts
from jaxekf.recordings.types import Encoder, Imu, Markers, Optical, Recording, from_scipy, to_scipy

BIG = 1_700_000_000_123_456_789
NAMES = ("tip", "B 2", 'the "left", upper')
"""In no alphabetic order, and with what CSV and TOML have to quote."""


def identity(count):
    return np.tile([1.0, 0.0, 0.0, 0.0], (count, 1))


def markers(frames=6):
    """One marker hidden at times, all of them in frame 3, and numbers reported of hidden markers too."""
    draw = np.random.default_rng(1)
    shape = (frames, len(NAMES))
    visible = np.ones(shape, bool)
    visible[1, 0] = visible[2, 1] = False
    visible[3] = False
    quality, error = draw.random(shape), draw.random(shape) * 1e-3
    quality[0, 1] = error[4, 2] = np.nan
    return Markers(
        BIG + np.cumsum(draw.integers(1, 20_000_000, frames)),
        draw.normal(size=(*shape, 3)),
        visible,
        NAMES,
        draw.normal(size=(len(NAMES), 3)),
        quality,
        0.3,
        error,
        latency_ns=34_000_001,
    )


def recording():
    """A run with everything a folder can hold."""
    draw = np.random.default_rng(2)
    time_ns = BIG + np.arange(5) * 10_000_000
    valid = np.array([1, 1, 0, 1, 1], bool)
    error = np.array([1e-4, np.nan, 2e-3, 0.0, 3e-4])
    return Recording(
        "run",
        Optical(
            time_ns,
            identity(5),
            valid,
            draw.normal(size=(5, 3)),
            error,
            np.array([0.0, 0.1, 0.25]),
            latency_ns=16_600_003,
        ),
        Imu(time_ns, draw.normal(size=(5, 3))),
        Encoder(time_ns, identity(5), valid, valid, draw.normal(size=(5, 3))),
        info={
            "gravity_ref": [0.1, -0.2, -9.81],
            "p_body_object": [0.0, 0.0, 0.0],
            "q_body_object": from_scipy(to_scipy(np.array([0.3, 0.4, -0.1, 0.7]))).tolist(),
        },
        markers=markers(),
    )


@pytest.fixture
def folder(tmp_path):
    return jaxekf.save(recording(), tmp_path / "run")


def test_markers_come_back_exactly(folder):
    """Would catch a lost digit, frame or quality, a hidden marker that comes back, or names sorted."""
    found, known = jaxekf.load(folder).need_markers(), markers()
    assert found.names == NAMES
    assert (found.latency_ns, found.quality_min) == (known.latency_ns, known.quality_min)
    np.testing.assert_array_equal(found.position[known.visible], known.position[known.visible])
    assert np.isnan(found.position[~known.visible]).all()
    for key in ("time_ns", "visible", "p_body_marker", "quality", "error"):
        np.testing.assert_array_equal(getattr(found, key), getattr(known, key), err_msg=key)
    np.testing.assert_array_equal(found.usable, known.usable)


def test_what_was_not_recorded_stays_none(tmp_path):
    """Would catch a column of nothing, a latency or a threshold that nobody stated."""
    plain = replace(markers(), quality=None, error=None, quality_min=0.0, latency_ns=0)
    path = jaxekf.save(Recording("run", markers=plain), tmp_path / "run")
    found = jaxekf.load(path).need_markers()
    assert (found.quality, found.error, found.quality_min, found.latency_ns) == (None, None, 0.0, 0)
    assert (path / "markers.csv").read_text().startswith("time,marker,x,y,z\n")
    section = tomllib.loads((path / "recording.toml").read_text())["markers"]
    assert set(section) == {"kind", "unit", "geometry"}


def test_the_other_streams_come_back_exactly(folder):
    """Would catch fit errors, the tool's point, latency or true positions that stay behind on disk."""
    found, known = jaxekf.load(folder), recording()
    optical, truth = found.need_optical(), known.need_optical()
    np.testing.assert_array_equal(optical.error, truth.error)
    np.testing.assert_array_equal(optical.p_body_tool, truth.p_body_tool)
    np.testing.assert_array_equal(optical.position[truth.valid], truth.position[truth.valid])
    assert optical.latency_ns == truth.latency_ns
    encoder, truth = found.need_encoder(), known.need_encoder()
    np.testing.assert_array_equal(encoder.position[truth.valid], truth.position[truth.valid])
    np.testing.assert_array_equal(encoder.valid, truth.valid)


def test_facts_come_back_exactly(folder, tmp_path):
    """Would catch gravity or the object's frame being lost, or drifting from one saving to the next."""
    again = jaxekf.load(folder)
    for key, value in recording().info.items():
        assert again.info[key] == value
    assert jaxekf.load(jaxekf.save(again, tmp_path / "again")).info == again.info


def test_scaling_to_unit_length_is_done_once():
    """Would catch a quaternion whose last digit changes each time that it is saved and read."""
    for drawn in np.random.default_rng(3).normal(size=(200, 4)):
        unit = facts.unit_vector(drawn, 4, "place", "key")
        again = facts.unit_vector(unit, 4, "place", "key")
        np.testing.assert_array_equal(again, unit)
        np.testing.assert_allclose(unit, drawn / np.linalg.norm(drawn), atol=1e-15)


def test_facts_are_lists_of_floats(folder, tmp_path):
    """Would catch integers, a quaternion that is not of unit length, or arrays that cannot be saved."""
    entry("gravity_ref", [0, 0, -10])(folder)
    entry("q_body_object", [0, 3, 0, 4])(folder)
    info = jaxekf.load(folder).info
    assert info["gravity_ref"] == [0.0, 0.0, -10.0]
    assert all(type(number) is float for number in info["gravity_ref"])
    np.testing.assert_allclose(info["q_body_object"], [0.0, 0.6, 0.0, 0.8], atol=1e-16)
    run = recording()
    arrays = run.replace(info={"gravity_ref": np.array([0.0, 0.0, -9.8])})
    path = jaxekf.save(arrays, tmp_path / "arrays")
    assert jaxekf.load(path).info["gravity_ref"] == [0.0, 0.0, -9.8]


def test_what_a_stream_holds_is_said_once(folder, tmp_path):
    """Would catch a latency changed in memory that is overruled by what the old file said of it."""
    run = jaxekf.load(folder)
    assert set(run.info["markers_about"]) == {"kind", "unit"}
    moved = replace(run.need_markers(), latency_ns=0, quality_min=0.0)
    again = jaxekf.load(jaxekf.save(run.replace(markers=moved), tmp_path / "moved"))
    assert (again.need_markers().latency_ns, again.need_markers().quality_min) == (0, 0.0)


def test_lines_in_another_order_and_lines_left_out(tmp_path):
    """Would catch the order of lines taken for that of markers, a lost frame, or blanks as data."""
    (tmp_path / "recording.toml").write_text(
        "schema_version = 1\n[markers.geometry]\nB = [0, 0, 1]\nA = [1, 0, 0]\n"
    )
    (tmp_path / "markers.csv").write_text(
        "marker,time,z,y,x\nA,0.01,3,2,1\nB,0.01,6,5,4\n B ,0.020,9,8,7\nA,0.03,,,\nB,0.030, , ,\n"
    )
    found = jaxekf.load(tmp_path).need_markers()
    assert found.names == ("B", "A")
    assert found.time_ns.tolist() == [10_000_000, 20_000_000, 30_000_000]
    assert found.visible.tolist() == [[True, True], [True, False], [False, False]]
    nan = [np.nan] * 3
    np.testing.assert_array_equal(
        found.position, [[[4, 5, 6], [1, 2, 3]], [[7, 8, 9], nan], [nan, nan]]
    )
    np.testing.assert_array_equal(found.p_body_marker, [[0, 0, 1], [1, 0, 0]])


def test_a_visible_marker_without_a_position_is_hidden(tmp_path):
    """Would catch 'inf' or half a position on disk, which could not be read again."""
    spoilt = markers()
    spoilt.position[0, 0], spoilt.position[0, 1, 2] = np.inf, np.nan
    found = jaxekf.load(jaxekf.save(Recording("run", markers=spoilt), tmp_path / "run"))
    assert found.need_markers().visible[0].tolist() == [False, False, True]
    np.testing.assert_array_equal(found.need_markers().usable, spoilt.usable)


@pytest.mark.parametrize(
    ("seconds", "expected"), [(0.034, 34_000_000), (0.016600009, 16_600_009), (2, 2_000_000_000)]
)
def test_latency_is_exact(folder, seconds, expected):
    """Would catch a latency cut off instead of rounded: 0.016600009 * 1e9 lies below 16600009."""
    entry("markers.latency", seconds)(folder)
    entry("optical.latency", seconds)(folder)
    # So late that the tracker and the IMU of this short run do not meet.
    entry("trust_units", True)(folder)
    run = jaxekf.load(folder)
    assert (run.need_markers().latency_ns, run.need_optical().latency_ns) == (expected, expected)


def test_a_true_position_is_turned_to_the_trackers_frame(folder):
    """Would catch a robot's position taken for one in the tracker's frame, or moved before it is turned."""
    known = jaxekf.load(folder).need_encoder().position
    edit(
        folder / "recording.toml",
        "[encoder]",
        "[encoder]\nq_optical_encoder = [1, 0, 0, 1]\np_optical_encoder = [1, 2, 3]",
    )
    found = jaxekf.load(folder)
    x, y, z = known.T
    turned = found.need_encoder().position
    np.testing.assert_allclose(turned, np.c_[1.0 - y, 2.0 + x, 3.0 + z], atol=1e-15)
    again = jaxekf.load(jaxekf.save(found, folder.parent / "again"))
    np.testing.assert_array_equal(again.need_encoder().position, turned)


def test_an_unknown_true_position_is_blank(folder):
    """Would catch a row of truth that is thrown away, or zero, where only its position is not known."""
    encoder = jaxekf.load(folder).need_encoder()
    encoder.position[1, 2] = np.nan
    run = Recording("run", encoder=encoder)
    found = jaxekf.load(jaxekf.save(run, folder.parent / "again")).need_encoder()
    assert np.isnan(found.position[1]).all()
    assert np.isfinite(found.position[[0, 3, 4]]).all()
    assert found.valid[1]


def test_a_joint_keeps_what_an_angle_cannot_hold(tmp_path):
    """Would catch a position, or which samples are missing, lost because the run came from a joint."""
    run = recording()
    run = run.replace(info={"encoder_about": {"axis": [0.0, 0.0, 1.0], "acts_on": "reference"}})
    found = jaxekf.load(jaxekf.save(run, tmp_path / "run")).need_encoder()
    np.testing.assert_array_equal(found.valid, run.need_encoder().valid)
    assert found.position is not None
    whole = replace(run.need_encoder(), valid=np.ones(5, bool), scored=np.ones(5, bool))
    found = jaxekf.load(jaxekf.save(run.replace(encoder=whole), tmp_path / "whole")).need_encoder()
    np.testing.assert_array_equal(found.position, whole.position)
    bare = replace(run.need_encoder(), position=None)
    found = jaxekf.load(jaxekf.save(run.replace(encoder=bare), tmp_path / "bare")).need_encoder()
    np.testing.assert_array_equal(found.valid, bare.valid)


def test_old_recordings_still_load(tmp_path):
    """Would catch a new entry or column that runs from before would need."""
    (tmp_path / "recording.toml").write_text(
        'schema_version = 1\nname = "old"\nseed = 3\n'
        '[optical]\nkind = "pose"\nunit = "1, m"\nstatus_ok = ["0"]\n'
        "[encoder]\naxis = [0.0, 0.0, 1.0]\n"
    )
    (tmp_path / "optical.csv").write_text(
        "time,qw,qx,qy,qz,x,y,z,status\n0.1,1,0,0,0,1,2,3,0\n0.2,1,0,0,0,1,2,3,MISSING\n"
    )
    (tmp_path / "imu.csv").write_text("time,gx,gy,gz,ax,ay,az\n0.1,1,2,3,4,5,6\n")
    (tmp_path / "encoder.csv").write_text("time,angle,scored\n0.1,0,1\n0.2,0.5,0\n")
    run = jaxekf.load(tmp_path)
    optical, encoder = run.need_optical(), run.need_encoder()
    assert optical.valid.tolist() == [True, False]
    assert (optical.error, optical.p_body_tool, optical.latency_ns) == (None, None, 0)
    assert (encoder.position, run.markers) == (None, None)
    assert encoder.scored.tolist() == [True, False]
    assert run.info["seed"] == 3


def edit(file, old, new):
    text = file.read_text()
    assert text.count(old) == 1, f"{old!r} stands {text.count(old)} times in {file.name}"
    file.write_text(text.replace(old, new))


def swap_lines(file, first, second):
    lines = file.read_text().splitlines()
    lines[first], lines[second] = lines[second], lines[first]
    file.write_text("\n".join(lines))


def set_cell(name, row, column, value):
    """Changes one cell of a file; rows count from 0 below the header, so that its line is row + 2."""

    def change(folder):
        file = folder / f"{name}.csv"
        lines = file.read_text().splitlines()
        at = lines[0].split(",").index(column)
        cells = lines[row + 1].split(",")
        cells[at] = value
        file.write_text("\n".join([*lines[: row + 1], ",".join(cells), *lines[row + 2 :]]))

    return change


def entry(key, value):
    """Sets an entry of recording.toml, ``section.key`` or ``key``."""

    def change(folder):
        file = folder / "recording.toml"
        whole = tomllib.loads(file.read_text())
        *sections, last = key.split(".")
        part = whole
        for section in sections:
            part = part[section]
        if value is None:
            del part[last]
        else:
            part[last] = value
        file.write_text(tomli_w.dumps(whole))

    return change


def with_joint_angle(folder):
    (folder / "encoder.csv").write_text("time,angle,x,y,z\n0.1,0.5,1,2,3\n")
    edit(folder / "recording.toml", "[encoder]", "[encoder]\naxis = [0, 0, 1]")


INF, NAN = float("inf"), float("nan")
# What is spoilt; words of the message; and the line and column (or key) that it names.
FAULTS = {
    "unknown marker": (
        set_cell("markers", 4, "marker", "D"),
        ["markers.csv", "'D'", "adding D = [x, y, z]", "[markers.geometry]"],
        (6, "marker"),
    ),
    "unknown marker, odd name": (
        set_cell("markers", 4, "marker", "D.1"),
        ['adding "D.1" = [x, y, z]'],
        (6, "marker"),
    ),
    "nameless marker": (
        set_cell("markers", 4, "marker", " "),
        ["''", "naming the marker"],
        (6, "marker"),
    ),
    "marker twice": (
        set_cell("markers", 1, "marker", "tip"),
        ["'tip' at 1700000000.1", "twice with other numbers", "once a frame"],
        (3, "time"),
    ),
    "frame torn apart": (
        lambda f: swap_lines(f / "markers.csv", 3, 4),
        ["times that do not decrease"],
        (5, "time"),
    ),
    "text position": (set_cell("markers", 6, "y", "abc"), ["'abc'", "a number"], (8, "y")),
    "infinite quality": (set_cell("markers", 6, "quality", "inf"), ["finite"], (8, "quality")),
    "negative error": (
        set_cell("markers", 6, "error", "-1"),
        ["-1", "0 or more", "blanking"],
        (8, "error"),
    ),
    "one time twice in another stream": (
        lambda f: edit(f / "optical.csv", "1700000000.143456789", "1700000000.133456789"),
        ["optical.csv", "twice with other numbers", "each time once"],
        (4, "time"),
    ),
    "no marker column": (
        lambda f: edit(f / "markers.csv", "time,marker", "time,name"),
        ["time,name", "time,marker,x,y,z[,quality][,error]"],
        (1, None),
    ),
    "half the columns": (
        lambda f: edit(f / "optical.csv", ",x,y,z,error", ",x,y,status,error"),
        ["time,qw,qx,qy,qz[,x,y,z][,status][,error]"],
        (1, None),
    ),
    "no markers.csv": (
        lambda f: (f / "markers.csv").unlink(),
        ["no such file", "recording.toml"],
        None,
    ),
    "no geometry": (
        entry("markers.geometry", None),
        ["NAME = [x, y, z]", "[markers.geometry]"],
        (None, "markers.geometry"),
    ),
    "no marker in the geometry": (
        entry("markers.geometry", {}),
        ["at least one"],
        (None, "markers.geometry"),
    ),
    "geometry in a list": (
        entry("markers.geometry", [[0.0, 0.0, 0.0]]),
        ["a section"],
        (None, "markers.geometry"),
    ),
    "place of two numbers": (
        entry("markers.geometry.tip", [1.0, 2.0]),
        ["3 finite numbers"],
        (None, "markers.geometry.tip"),
    ),
    "infinite place": (
        entry("markers.geometry.tip", [1.0, 2.0, INF]),
        ["3 finite numbers"],
        (None, "markers.geometry.tip"),
    ),
    "place in words": (
        entry("markers.geometry.tip", ["1", "2", "3"]),
        ["3 finite numbers"],
        (None, "markers.geometry.tip"),
    ),
    "name with blanks": (
        entry("markers.geometry. tip", [1.0, 2.0, 3.0]),
        ["' tip'"],
        (None, "markers.geometry"),
    ),
    "threshold in words": (
        entry("markers.quality_min", "high"),
        ["'high'", "a finite number"],
        (None, "markers.quality_min"),
    ),
    "other kind": (
        entry("markers.kind", "pose"),
        ["'pose'", "'markers'"],
        (None, "markers.kind"),
    ),
    "other unit": (entry("markers.unit", "ft"), ["'ft'", "m or cm or mm"], (None, "markers.unit")),
    "negative latency": (
        entry("markers.latency", -0.01),
        ["-0.01", "0 or more"],
        (None, "markers.latency"),
    ),
    "infinite latency": (
        entry("optical.latency", INF),
        ["inf", "finite seconds"],
        (None, "optical.latency"),
    ),
    "latency of nothing": (entry("optical.latency", NAN), ["nan"], (None, "optical.latency")),
    "latency yes": (entry("optical.latency", True), ["True"], (None, "optical.latency")),
    "latency beyond floats": (
        entry("optical.latency", 10**400),
        ["finite"],
        (None, "optical.latency"),
    ),
    "negative fit error": (
        set_cell("optical", 1, "error", "-0.1"),
        ["-0.1", "0 or more"],
        (3, "error"),
    ),
    "no point of the tool": (
        entry("optical.p_body_tool", [0.0, NAN, 0.0]),
        ["3 finite numbers"],
        (None, "optical.p_body_tool"),
    ),
    "position of a joint": (
        with_joint_angle,
        ["time,angle,x,y,z", "time,angle[,scored] or", "[,x,y,z]"],
        (1, None),
    ),
    "half a true position": (
        set_cell("encoder", 1, "y", ""),
        ["encoder.csv", "3 blank cells"],
        (3, "x,y,z"),
    ),
    "encoder's origin": (
        entry("encoder.p_optical_encoder", 1.0),
        ["3 finite numbers"],
        (None, "encoder.p_optical_encoder"),
    ),
    "no gravity": (
        entry("gravity_ref", [0.0, 0.0, 0.0]),
        ["3 finite numbers, not all 0"],
        (None, "gravity_ref"),
    ),
    "gravity downwards": (entry("gravity_ref", -9.81), ["-9.81"], (None, "gravity_ref")),
    "infinite gravity": (entry("gravity_ref", [0.0, 0.0, -INF]), ["inf"], (None, "gravity_ref")),
    "object nowhere": (
        entry("p_body_object", [0.0, 0.0]),
        ["3 finite numbers"],
        (None, "p_body_object"),
    ),
    "object without a frame": (
        entry("q_body_object", [0.0, 0.0, 0.0, 0.0]),
        ["4 finite numbers, not all 0"],
        (None, "q_body_object"),
    ),
    "object turned by three": (
        entry("q_body_object", [0.0, 0.0, 1.0]),
        ["4 finite numbers"],
        (None, "q_body_object"),
    ),
}


@pytest.mark.parametrize("case", FAULTS)
def test_faults_are_named(folder, case):
    """Would catch a traceback, a message without its place, or a fault that is read as data."""
    spoil, words, place = FAULTS[case]
    spoil(folder)
    with pytest.raises(RecordingError) as caught:
        jaxekf.load(folder)
    message = str(caught.value)
    for word in (*words, ": got ", ", expected ", "; try "):
        assert word in message
    assert "\n" not in message
    if place is not None:
        assert (caught.value.line, caught.value.column) == place
        assert caught.value.line is not None or caught.value.path == folder / "recording.toml"


def none_of_them():
    bare = np.zeros((6, 0))
    return replace(
        markers(),
        position=np.zeros((6, 0, 3)),
        visible=bare.astype(bool),
        names=(),
        p_body_marker=np.zeros((0, 3)),
        quality=None,
        error=None,
    )


@pytest.mark.parametrize(
    ("run", "words"),
    [
        (lambda: Recording("r", markers=replace(markers(), names=("A", "B", "A"))), "each once"),
        (lambda: Recording("r", markers=replace(markers(), names=("A", "B", "C\nD"))), "printable"),
        (lambda: Recording("r", markers=replace(markers(), names=("A", "B", ""))), "printable"),
        (lambda: Recording("r", markers=none_of_them()), "at least one"),
        (
            lambda: Recording("r", markers=replace(markers(), p_body_marker=np.full((3, 3), NAN))),
            "markers.geometry.tip",
        ),
        (
            lambda: recording().replace(info={"gravity_ref": [0.0, 0.0, 0.0]}),
            "gravity_ref",
        ),
    ],
    ids=["twice", "two lines", "nameless", "none", "no place", "no gravity"],
)
def test_nothing_is_saved_that_could_not_be_read_again(tmp_path, run, words):
    """Would catch two markers that become one on disk, or a folder that is left half written."""
    with pytest.raises(RecordingError, match=words):
        jaxekf.save(run(), tmp_path / "run")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        ({"y": ""}, "not finite"),
        ({"y": "inf"}, "not finite"),
        ({"x": "0", "y": "0", "z": "0"}, "missing marker (zeros)"),
        ({"x": "-3.697314e28"}, "beyond any tracker"),
    ],
)
def test_markers_that_are_none_are_masked(folder, change, reason):
    """Would catch half a position, or a place that stands for a lost marker, taken for one."""
    before = jaxekf.load(folder).markers.visible
    for name, text in change.items():
        set_cell("markers", 6, name, text)(folder)
    run = jaxekf.load(folder)
    assert run.intake["markers"].masked[reason].numbers.tolist() == [8]
    assert before.sum() - run.markers.visible.sum() == 1


def test_markers_that_stand_still_to_the_last_bit(folder):
    """Would catch markers frozen where they were last seen."""
    lines = (folder / "markers.csv").read_text().splitlines()
    cells = [line.split(",") for line in lines[1:]]
    name = cells[0][1]
    at = [i for i, row in enumerate(cells) if row[1] == name and row[2]][:3]
    # With four decimals or fewer a resting marker repeats itself.
    cells[at[0]][2:5] = ["0.123456789", "0.2", "0.3"]
    for i in at[1:]:
        cells[i][2:5] = cells[at[0]][2:5]
    (folder / "markers.csv").write_text("\n".join([lines[0], *map(",".join, cells)]) + "\n")
    masked = jaxekf.load(folder).intake["markers"].masked
    assert masked["suspicious (position repeated exactly)"].numbers.tolist() == [
        i + 2 for i in at[1:]
    ]
