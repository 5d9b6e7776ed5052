"""Landmarks in a camera's images on disk: images, places, the lens, and what becomes of every line."""

import tomllib
from dataclasses import fields, replace

import numpy as np
import pytest
from test_storage_markers import edit, entry, set_cell, swap_lines

import jaxekf
from jaxekf._support.errors import RecordingError
from jaxekf.recordings import gaps
from jaxekf.recordings.types import Camera, Imu, Recording

BIG = 1_700_000_000_123_456_789
NAMES = ("door", "B 2", 'the "left", upper', "012", "Ω")
"""In no alphabetic order, and with what CSV has to quote."""
FOLDER = ["camera.csv", "landmarks.csv", "recording.toml"]


def camera(images=6):
    """Landmarks that are not found at times, none of them in image 3, and deviations of those, too."""
    draw = np.random.default_rng(1)
    shape = (images, len(NAMES))
    visible = draw.random(shape) < 0.7
    visible[0, :2] = True
    visible[3] = False
    pixel, sigma = draw.uniform(0.0, 640.0, (*shape, 2)), draw.uniform(0.2, 2.0, shape)
    pixel[~visible] = np.nan
    pixel[0, 0] = -0.0, 5e-324
    sigma[0, 1] = sigma[3, 2] = np.nan
    q = draw.normal(size=4)
    return Camera(
        BIG + np.cumsum(draw.integers(1_000_000, 60_000_000, images)),
        pixel,
        visible,
        NAMES,
        draw.normal(size=(len(NAMES), 3)),
        np.array([458.654, 457.296]) * (1.0 + 1e-15),
        np.array([367.215, 248.375]),
        np.array([-0.28340811, 0.07395907]),
        draw.normal(size=3),
        q / np.linalg.norm(q),
        sigma,
        latency_ns=34_000_001,
    )


def run_of(stream):
    return Recording("run", camera=stream)


@pytest.fixture
def folder(tmp_path):
    return jaxekf.save(run_of(camera()), tmp_path / "run")


def assert_same(found, known):
    for field in fields(known):
        a, b = (np.asarray(getattr(stream, field.name)) for stream in (found, known))
        assert a.dtype == b.dtype and a.shape == b.shape, field.name
        assert a.tobytes() == b.tobytes(), field.name


def counts(account):
    """Rows, and of them used, masked and dropped."""
    masked, dropped = (
        sum(reason.count for reason in reasons.values())
        for reasons in (account.masked, account.dropped)
    )
    return account.rows, account.rows - masked - dropped, masked, dropped


def test_a_camera_comes_back_exactly(folder, tmp_path):
    """Would catch a lost bit, image or deviation, a landmark that comes back, or names sorted."""
    found = jaxekf.load(folder).need_camera()
    assert_same(found, camera())
    assert sorted(file.name for file in folder.iterdir()) == FOLDER
    again = jaxekf.load(jaxekf.save(run_of(found), tmp_path / "again"))
    assert_same(again.need_camera(), camera())


def test_turns_come_back_exactly(tmp_path):
    """Would catch a quaternion whose last digit changes when it is saved or read."""
    for i, drawn in enumerate(np.random.default_rng(3).normal(size=(10, 4))):
        known = replace(camera(), q_body_camera=drawn / np.linalg.norm(drawn))
        for name in (f"{i}", f"{i}.h5"):
            found = jaxekf.load(jaxekf.save(run_of(known), tmp_path / name)).need_camera()
            assert_same(found, known)


def test_a_turn_is_not_judged_again_in_one_file(tmp_path):
    """Would catch a quaternion of few digits that changes in a file that keeps every bit."""
    known = replace(camera(), q_body_camera=np.array([0.6, 0.0, 0.8000001, 0.0]))
    for suffix in (".h5", ".npz"):
        found = jaxekf.load(jaxekf.save(run_of(known), tmp_path / f"run{suffix}"))
        assert_same(found.need_camera(), known)


@pytest.mark.parametrize("suffix", ["", ".h5"])
def test_one_image_a_second(tmp_path, suffix):
    """Would catch a slow camera taken for one whose times are in another unit, or such times believed."""
    slow = replace(camera(), time_ns=BIG + np.arange(6) * 1_000_000_000)
    found = jaxekf.load(jaxekf.save(run_of(slow), tmp_path / f"slow{suffix}"))
    assert_same(found.need_camera(), slow)
    wrong = replace(camera(), time_ns=BIG + np.arange(6) * 33_000_000_000)
    with pytest.raises(RecordingError, match="a sample every 33 s, expected a rate"):
        jaxekf.load(jaxekf.save(run_of(wrong), tmp_path / f"wrong{suffix}"))


def test_what_was_not_recorded_stays_none(tmp_path):
    """Would catch a column of nothing, a latency that nobody stated, or a lens that is needed."""
    plain = replace(camera(), sigma=None, latency_ns=0)
    path = jaxekf.save(run_of(plain), tmp_path / "run")
    assert (path / "camera.csv").read_text().startswith("time,landmark,u,v\n")
    section = tomllib.loads((path / "recording.toml").read_text())["camera"]
    assert "latency" not in section
    for key in ("radial", "p_body_camera", "q_body_camera", "unit", "kind"):
        entry(f"camera.{key}", None)(path)
    found = jaxekf.load(path).need_camera()
    assert (found.sigma, found.latency_ns) == (None, 0)
    assert found.radial.tolist() == [0.0, 0.0]
    assert found.p_body_camera.tolist() == [0.0, 0.0, 0.0]
    assert found.q_body_camera.tolist() == [1.0, 0.0, 0.0, 0.0]


def test_what_a_stream_holds_is_said_once(folder, tmp_path):
    """Would catch a lens changed in memory that is overruled by what the old file said of it."""
    run = jaxekf.load(folder)
    assert set(run.info["camera_about"]) == {"kind", "unit"}
    other = replace(run.need_camera(), latency_ns=0, focal=np.array([1.0, 2.0]))
    again = jaxekf.load(jaxekf.save(run.replace(camera=other), tmp_path / "other"))
    assert_same(again.need_camera(), other)


def test_fewer_digits_are_of_samples_only(tmp_path):
    """Would catch the places of landmarks rounded with the samples."""
    path = jaxekf.save(run_of(camera()), tmp_path / "run", digits=5)
    found, known = jaxekf.load(path).need_camera(), camera()
    np.testing.assert_array_equal(found.p_ref_landmark, known.p_ref_landmark)
    assert (found.pixel[known.visible] != known.pixel[known.visible]).any()
    np.testing.assert_allclose(found.pixel, known.pixel, rtol=1e-4)


@pytest.mark.parametrize(
    ("unit", "factor"), [("mm", 1e-3), ("cm, px", 1e-2), ("m, px", 1.0), ("m", 1.0)]
)
def test_unit_is_that_of_the_places(folder, unit, factor):
    """Would catch pixels, or the camera's place in the body, scaled with the landmarks', or these not."""
    entry("camera.unit", unit)(folder)
    known = camera()
    scaled = replace(known, p_ref_landmark=factor * known.p_ref_landmark)
    assert_same(jaxekf.load(folder).need_camera(), scaled)


def test_quaternion_is_scaled_once(folder):
    """Would catch a camera turned by a quaternion that is not of unit length."""
    entry("camera.q_body_camera", [0, 3, 0, 4])(folder)
    found = jaxekf.load(folder).need_camera().q_body_camera
    np.testing.assert_allclose(found, [0.0, 0.6, 0.0, 0.8], atol=1e-16)


def small(tmp_path, lines, landmarks="landmark,x,y,z\nB,0,0,1\nA,1,0,0\nnever,9,9,9\n"):
    """A folder with these lines of `camera.csv`."""
    (tmp_path / "recording.toml").write_text(
        "schema_version = 1\n[camera]\nfocal = [400, 401]\ncentre = [320.5, 240]\n"
    )
    (tmp_path / "camera.csv").write_text(lines)
    (tmp_path / "landmarks.csv").write_text(landmarks)
    return tmp_path


def test_lines_in_another_order_and_lines_left_out(tmp_path):
    """Would catch the order of lines taken for that of landmarks, a lost image, or blanks as data."""
    lines = "landmark,time,v,u\nA,0.01,3,2\nB,0.01,6,5\n B ,0.020,9,8\nA,0.03,,\nB,0.030, , \n"
    run = jaxekf.load(small(tmp_path, lines))
    found, nan = run.need_camera(), [np.nan, np.nan]
    assert found.names == ("B", "A", "never")
    assert found.time_ns.tolist() == [10_000_000, 20_000_000, 30_000_000]
    assert found.visible.tolist() == [[True, True, False], [True, False, False], 3 * [False]]
    np.testing.assert_array_equal(
        found.pixel, [[[5, 6], [2, 3], nan], [[8, 9], nan, nan], [nan, nan, nan]]
    )
    np.testing.assert_array_equal(found.p_ref_landmark, [[0, 0, 1], [1, 0, 0], [9, 9, 9]])
    account = run.intake["camera"]
    assert account.masked["blank"].numbers.tolist() == [5, 6]
    assert counts(account) == (5, 3, 2, 0)
    assert [account.parts[name].rows for name in found.names] == [3, 2, 0]
    assert [len(account.parts[name].absent) for name in found.names] == [0, 1, 3]


def test_every_line_is_accounted_for(tmp_path):
    """Would catch a line that is lost or counted twice: repeated, without a number, or cut short."""
    lines = (
        "time,landmark,u,v,sigma\n0.1,A,1,2,0.5\n0.1,A,1,2,0.5\n0.1,B,inf,2,\n0.2,A,3,,0.5\n"
        "0.2,B,1e9,7,\n0.3,A,,,0.7\n0.3,B,1e9,7,0.1\n0.4,A,1,2"
    )
    run = jaxekf.load(small(tmp_path, lines))
    account = run.intake["camera"]
    assert {name: r.numbers.tolist() for name, r in account.masked.items()} == {
        "blank": [7],
        "not finite": [4, 5],
        "cut short": [9],
    }
    assert {name: r.numbers.tolist() for name, r in account.dropped.items()} == {"repeated": [3]}
    found = run.need_camera()
    # Huge or frozen points may be of a camera at rest, and of a strange one.
    assert found.visible.tolist() == [
        [False, True, False],
        [True, False, False],
        [True, False, False],
    ]
    assert counts(account) == (8, int(found.visible.sum()), 4, 1)
    np.testing.assert_array_equal(found.sigma[:, 1], [0.5, 0.5, 0.7])
    np.testing.assert_array_equal(found.sigma[:, 0], [np.nan, np.nan, 0.1])


def test_sorting(tmp_path):
    """Would catch lines out of order that are refused with `sort`, or sorted without being told."""
    lines = "time,landmark,u,v\n0.2,A,3,4\n0.1,B,5,6\n0.2,B,7,8\n0.1,A,1,2\n"
    path = small(tmp_path, lines)
    with pytest.raises(RecordingError, match="times that do not decrease"):
        jaxekf.load(path)
    run = jaxekf.load(path, sort=True)
    found, account = run.need_camera(), run.intake["camera"]
    assert found.pixel[:, :2].tolist() == [[[5, 6], [1, 2]], [[7, 8], [3, 4]]]
    assert counts(account) == (4, 4, 0, 0)
    assert "out of order" in account.notes[0]


@pytest.mark.parametrize("suffix", [".h5", ".npz"])
def test_files_of_others(tmp_path, suffix):
    """Would catch an image point without a number that counts as found, images counted as lines, or a
    camera that needs more than its focal lengths and centre."""
    h5py = pytest.importorskip("h5py")
    known = camera()
    pixel = np.nan_to_num(known.pixel, nan=7.0)
    pixel[4, 1], pixel[5, 0, 1] = np.nan, np.inf
    data = {
        "time_ns": np.insert(known.time_ns, 2, known.time_ns[2]),
        "pixel": np.insert(pixel, 2, pixel[2], axis=0),
        "names": list(NAMES),
        "p_ref_landmark": known.p_ref_landmark,
        "focal": np.array([400, 401], np.int32),
        "centre": known.centre.astype(np.float32),
        "q_body_camera": np.array([0.0, 3.0, 0.0, 4.0]),
    }
    path = tmp_path / f"run{suffix}"

    def load(**changes):
        path.unlink(missing_ok=True)
        content = {f"camera/{key}": value for key, value in (data | changes).items()}
        if suffix == ".npz":
            np.savez(path, **content)
            return jaxekf.load(path)
        with h5py.File(path, "w") as file:
            for key, value in content.items():
                file[key] = value
        return jaxekf.load(path)

    run = load()
    found, account = run.need_camera(), run.intake["camera"]
    assert counts(account) == (35, 28, 2, 5)
    assert found.visible.sum() == 28 and not found.visible[4, 1] and not found.visible[5, 0]
    masked = {name: r.numbers.tolist() for name, r in account.masked.items()}
    assert masked == {"blank": [5], "not finite": [6]}
    np.testing.assert_allclose(found.q_body_camera, [0.0, 0.6, 0.0, 0.8])
    assert found.radial.tolist() == [0.0, 0.0]
    hidden = np.ones((7, 5), bool)
    hidden[0, 3] = False
    masked = load(visible=hidden).intake["camera"].masked
    assert masked["hidden"].numbers.tolist() == [0]
    sigma = np.ones((7, 5))
    sigma[1, 2] = 0.0
    for changes, told in (
        ({"sigma": sigma}, r"camera/sigma\[1\]: got 0.0, expected a finite number of pixels, more"),
        ({"focal": np.array([400.0, -1.0])}, "focal = .* two positive"),
        ({"q_body_camera": np.zeros(4)}, "q_body_camera.* not all 0"),
        ({"names": ["A", "B", "C", "A", "D"]}, r"names\[3\].* each once"),
        ({"p_ref_landmark": np.full((5, 3), np.nan)}, r"p_ref_landmark\[0\].* 3 finite"),
        ({"pixel": np.zeros((7, 4, 2))}, r"shape \(7, 4, 2\).* L = 5"),
        ({"pixel": np.full((7, 5, 2), np.nan)}, "no usable sample among 35"),
    ):
        with pytest.raises(RecordingError, match=told):
            load(**changes)


def test_numbers_of_hidden_points_in_one_file(tmp_path):
    """Would catch numbers of points that were not found lost in a file that keeps every bit."""
    known = camera()
    known.pixel[3] = np.arange(10.0).reshape(5, 2)
    for suffix in (".h5", ".npz"):
        run = jaxekf.load(jaxekf.save(run_of(known), tmp_path / f"run{suffix}"))
        assert_same(run.need_camera(), known)
        rows, used, masked, _ = counts(run.intake["camera"])
        assert (rows, used, masked) == (30, known.visible.sum(), 30 - known.visible.sum())


def test_places_are_covered_by_hashes(tmp_path):
    """Would catch landmarks moved since the run was saved, or a run told apart by its points only."""
    path = jaxekf.save(run_of(camera()), tmp_path / "run", hashes=True)
    assert set(jaxekf.load(path).sources) == set(FOLDER)
    before = jaxekf.io.hashes.hashed(path)
    assert before == jaxekf.load(path).sources
    edit(path / "landmarks.csv", "\n012,", "\n012,0")
    with pytest.raises(RecordingError, match=r"landmarks\.csv: got content of sha256"):
        jaxekf.load(path)
    assert {k for k, v in jaxekf.io.hashes.hashed(path).items() if v != before[k]} == {
        "landmarks.csv"
    }


def test_places_go_with_the_run(folder):
    """Would catch places of an older run that stay behind when it is overwritten."""
    other = replace(camera(), p_ref_landmark=np.eye(5, 3))
    jaxekf.save(run_of(other), folder, overwrite=True)
    assert_same(jaxekf.load(folder).need_camera(), other)
    imu = Imu(BIG + np.arange(5) * 10_000_000, np.zeros((5, 3)))
    jaxekf.save(Recording("run", imu=imu), folder, overwrite=True)
    assert sorted(file.name for file in folder.iterdir()) == ["imu.csv", "recording.toml"]


def append(name, text):
    def change(folder):
        with (folder / name).open("a") as file:
            file.write(text)

    return change


INF, NAN = float("inf"), float("nan")
LINE = "1700000001,door,1,2"
# What is spoilt; words of the message; and the line and column (or key) that it names.
FAULTS = {
    "unknown landmark": (
        set_cell("camera", 5, "landmark", "D"),
        ["camera.csv", "landmark 'D'", "given in landmarks.csv (door, B 2, ", "adding its line"],
        (7, "landmark"),
    ),
    "nameless point": (
        set_cell("camera", 5, "landmark", " "),
        ["landmark ''", "naming the landmark"],
        (7, "landmark"),
    ),
    "landmark without a place": (
        lambda f: edit(f / "landmarks.csv", "\n012,", "\n12,"),
        ["camera.csv", "landmark '012'"],
        (5, "landmark"),
    ),
    "landmark with two places": (
        append("landmarks.csv", "B 2,1,2,3\n"),
        ["landmarks.csv", "'B 2' again", "each once"],
        (7, "landmark"),
    ),
    "nameless landmark": (
        append("landmarks.csv", ",1,2,3\n"),
        ["landmarks.csv", "''", "printable names"],
        (7, "landmark"),
    ),
    "place in words": (
        set_cell("landmarks", 1, "y", "there"),
        ["landmarks.csv", "'there'", "a number"],
        (3, "y"),
    ),
    "no place": (set_cell("landmarks", 1, "y", ""), ["landmarks.csv", "''"], (3, "y")),
    "place nowhere": (
        set_cell("landmarks", 3, "z", "inf"),
        ["landmarks.csv", "inf", "a finite number"],
        (5, "z"),
    ),
    "place cut short": (
        append("landmarks.csv", "last,1,2"),
        ["landmarks.csv", "cut short", "landmark,x,y,z"],
        (7, None),
    ),
    "a column too many of places": (
        lambda f: edit(f / "landmarks.csv", "landmark,x,y,z", "landmark,x,y,w"),
        ["landmarks.csv", "columns landmark,x,y,w", "landmark,x,y,z"],
        (1, None),
    ),
    "no landmarks.csv": (
        lambda f: (f / "landmarks.csv").unlink(),
        ["landmarks.csv", "no such file", "one beside camera.csv"],
        (None, None),
    ),
    "no camera.csv": (
        lambda f: (f / "camera.csv").unlink(),
        ["camera.csv", "no such file"],
        (None, None),
    ),
    "no landmarks": (
        lambda f: (f / "landmarks.csv").write_text("landmark,x,y,z\n"),
        ["landmarks.csv", "0 samples"],
        (1, None),
    ),
    "landmark twice in an image": (
        set_cell("camera", 1, "landmark", "door"),
        ["'door' at 1700000000.1", "twice with other numbers", "once a frame"],
        (3, "time"),
    ),
    "image torn apart": (
        lambda f: swap_lines(f / "camera.csv", 5, 6),
        ["times that do not decrease"],
        (7, "time"),
    ),
    "too few cells": (
        append("camera.csv", f"{LINE}\n{LINE},0.5\n"),
        ["camera.csv", "4 cells", "5 as in the header"],
        (32, None),
    ),
    "too many cells": (
        append("camera.csv", f"{LINE},0.5,7\n"),
        ["camera.csv", "6 cells", "5 as in the header"],
        (32, None),
    ),
    "no landmark column": (
        lambda f: edit(f / "camera.csv", "time,landmark", "time,marker"),
        ["time,marker", "time,landmark,u,v[,sigma]"],
        (1, None),
    ),
    "text for a point": (set_cell("camera", 0, "u", "left"), ["'left'", "a number"], (2, "u")),
    "infinite deviation": (set_cell("camera", 0, "sigma", "inf"), ["finite"], (2, "sigma")),
    "negative deviation": (
        set_cell("camera", 0, "sigma", "-1"),
        ["-1", "more than 0", "blanking"],
        (2, "sigma"),
    ),
    "no deviation at all": (set_cell("camera", 0, "sigma", "0"), ["more than 0"], (2, "sigma")),
    "no focal length": (
        entry("camera.focal", None),
        ["no camera.focal", "adding focal = [fx, fy] under [camera]"],
        (None, "camera.focal"),
    ),
    "no centre": (
        entry("camera.centre", None),
        ["no camera.centre", "adding centre = [cx, cy] under [camera]"],
        (None, "camera.centre"),
    ),
    "one focal length": (
        entry("camera.focal", 400.0),
        ["400.0", "2 finite numbers"],
        (None, "camera.focal"),
    ),
    "negative focal length": (
        entry("camera.focal", [400.0, -400.0]),
        ["-400.0", "two positive numbers"],
        (None, "camera.focal"),
    ),
    "centre in words": (
        entry("camera.centre", ["320", "240"]),
        ["2 finite numbers"],
        (None, "camera.centre"),
    ),
    "three of a lens": (
        entry("camera.radial", [0.1, 0.2, 0.3]),
        ["2 finite numbers"],
        (None, "camera.radial"),
    ),
    "camera nowhere": (
        entry("camera.p_body_camera", [0.0, NAN, 0.0]),
        ["3 finite numbers"],
        (None, "camera.p_body_camera"),
    ),
    "camera without a direction": (
        entry("camera.q_body_camera", [0.0, 0.0, 0.0, 0.0]),
        ["4 finite numbers, not all 0"],
        (None, "camera.q_body_camera"),
    ),
    "misspelt": (
        entry("camera.center", [320.0, 240.0]),
        ["camera.center", "camera.centre"],
        (None, "camera.center"),
    ),
    "other kind": (entry("camera.kind", "pose"), ["'pose'", "'camera'"], (None, "camera.kind")),
    "other unit": (
        entry("camera.unit", "px, m"),
        ["'px, m'", "m or cm or mm, then px"],
        (None, "camera.unit"),
    ),
    "negative latency": (
        entry("camera.latency", -0.01),
        ["-0.01", "0 or more"],
        (None, "camera.latency"),
    ),
    "infinite latency": (entry("camera.latency", INF), ["finite"], (None, "camera.latency")),
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
    assert (caught.value.line, caught.value.column) == place
    assert caught.value.path.parent == folder


def changed(**changes):
    return lambda: replace(camera(), **changes)


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (changed(names=("A", "B", "A", "C", "D")), "each once"),
        (changed(names=("A", "B", "C\nD", "E", "F")), "printable"),
        (changed(visible=np.zeros((6, 5), bool)), "no (landmark in any|usable)"),
        (changed(p_ref_landmark=np.full((5, 3), NAN)), "3 finite numbers"),
        (changed(sigma=np.zeros((6, 5))), "more than 0"),
        (changed(focal=np.array([0.0, 1.0])), "two positive numbers"),
        (changed(centre=np.array([NAN, 1.0])), "2 finite numbers"),
        (changed(q_body_camera=np.zeros(4)), "not all 0"),
    ],
    ids=["twice", "two lines", "unseen", "no place", "sigma", "focal", "centre", "turn"],
)
def test_nothing_is_saved_that_could_not_be_read_again(tmp_path, make, words):
    """Would catch two landmarks that become one on disk, or a folder that is left half written."""
    for name in ("run", "run.h5", "run.npz"):
        with pytest.raises(RecordingError, match=words):
            jaxekf.save(run_of(make()), tmp_path / name)
    assert list(tmp_path.iterdir()) == []


def test_a_run_is_cut_with_its_camera(tmp_path):
    """Would catch points that stay in both parts of a run, or in none, and lines that go uncounted."""
    time_ns = BIG + np.arange(300) * 10_000_000
    imu = Imu(time_ns[(time_ns < time_ns[100]) | (time_ns > time_ns[150])], np.zeros((249, 3)))
    images = replace(camera(30), time_ns=BIG + np.arange(30) * 100_000_000)
    path = jaxekf.save(run_of(images).replace(imu=imu), tmp_path / "run")
    lines = (path / "camera.csv").read_text().splitlines(keepends=True)
    # One line twice, one without a number, and landmarks of the last image left out.
    at = next(i for i in range(1, 40) if images.visible.reshape(-1)[i])
    lines[2] = ",".join([*lines[2].split(",")[:2], "inf", "1", "\n"])
    text = "".join([*lines[: at + 2], lines[at + 1], *lines[at + 2 : -3]])
    (path / "camera.csv").write_text(text)
    run = jaxekf.load(path)
    parts, left = gaps.split_at_gaps(run)
    assert [len(part.need_camera().time_ns) for part in parts] == [16, 14] and not left
    for key in ("pixel", "visible", "sigma"):
        joined = np.concatenate([getattr(part.camera, key) for part in parts])
        np.testing.assert_array_equal(joined, getattr(run.camera, key))
    whole = counts(run.intake["camera"])
    each = [counts(part.intake["camera"]) for part in parts]
    assert whole == tuple(np.sum(each, axis=0)) and whole[0] == 148 and whole[3] == 1
    for part, account in zip(parts, each, strict=True):
        assert account[1] == part.camera.visible.sum()
        np.testing.assert_array_equal(part.camera.p_ref_landmark, images.p_ref_landmark)
    blind = replace(images, visible=images.visible & (np.arange(30) < 12)[:, None])
    parts, left = gaps.split_at_gaps(run.replace(camera=blind))
    assert [part.name for part in (*parts, *left)] == ["run-part1", "run-part2"]
    assert len(left) == 1


def test_another_clock_is_told(folder):
    """Would catch a camera whose times are not the IMU's, or truth that is not the camera's."""
    run = jaxekf.load(folder)
    imu = Imu(BIG - 10_000_000_000 + np.arange(50) * 10_000_000, np.zeros((50, 3)))
    path = jaxekf.save(run.replace(imu=imu), folder.parent / "apart")
    with pytest.raises(RecordingError, match=r"camera from .* and imu from .* overlap"):
        jaxekf.load(path)
    q = np.tile([1.0, 0.0, 0.0, 0.0], (50, 1))
    truth = jaxekf.Encoder(imu.time_ns, q, np.ones(50, bool), np.ones(50, bool))
    path = jaxekf.save(run.replace(encoder=truth), folder.parent / "truth")
    with pytest.raises(RecordingError, match=r"encoder from .* overlap"):
        jaxekf.load(path)
