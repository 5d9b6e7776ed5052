"""A run as one file: every bit comes back, and what is wrong with a file is said in one line."""

import shutil
import zipfile
from dataclasses import fields, replace

import h5py
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import jaxekf
from jaxekf._support.errors import RecordingError
from jaxekf.io import container
from jaxekf.recordings.types import STREAMS, Camera, Encoder, Imu, Optical, Recording
from jaxekf.simulation import attitude_runs, marker_runs

BIG = 1_700_000_000_123_456_789
SUFFIXES = [".h5", ".npz"]


def pose_run():
    run = attitude_runs.recording(
        "pose",
        attitude_runs.free_motion(3),
        seed=2,
        duration_s=1.0,
        start_ns=BIG,
        occlusions=[(0.5, 0.6)],
    )
    count = len(run.optical.time_ns)
    error = np.where(np.arange(count) % 3 == 0, np.nan, 1e-4)
    arm = np.array([0.1, 0.0, -0.02])
    optical = replace(run.optical, error=error, p_body_tool=arm, latency_ns=12_345_678)
    field = np.where(np.arange(len(run.imu.time_ns))[:, None] % 4 == 0, run.imu.gyroscope, np.nan)
    return run.replace(optical=optical, imu=replace(run.imu, magnetometer=field))


def marker_run():
    run = marker_runs.tool_recording(
        "tool",
        marker_runs.sinusoidal_motion(),
        seed=1,
        duration_s=0.5,
        hidden=[("1", 0.2, 0.3)],
        start_ns=BIG,
    )
    markers = run.markers
    quality = np.where(markers.visible, 0.75, np.nan)
    return run.replace(markers=replace(markers, quality=quality, quality_min=0.5, error=quality))


def bare_run():
    run = pose_run()
    optical = replace(run.optical, position=None, error=None, p_body_tool=None, latency_ns=0)
    return run.replace(optical=optical, imu=Imu(run.imu.time_ns, run.imu.gyroscope), encoder=None)


def camera_run():
    """A camera beside the IMU: points of landmarks that are not found are NaN, as folders give them."""
    run = pose_run()
    draw, shape = np.random.default_rng(4), (9, 5)
    visible = draw.random(shape) < 0.6
    pixel = np.where(visible[..., None], draw.uniform(0.0, 640.0, (*shape, 2)), np.nan)
    turn = draw.normal(size=4)
    camera = Camera(
        BIG + np.arange(9) * 100_000_007,
        pixel,
        visible,
        ("a", 'b, "c"', "0", "Ω", "e f"),
        draw.normal(size=(5, 3)),
        np.array([458.654, 457.296]),
        np.array([367.215, 248.375]),
        np.array([-0.28340811, -0.0]),
        draw.normal(size=3),
        turn / np.linalg.norm(turn),
        np.where(draw.random(shape) < 0.5, 0.3, np.nan),
        latency_ns=7,
    )
    return run.replace(optical=None, camera=camera)


RUNS = [pose_run, marker_run, camera_run, bare_run]


def assert_same(one, other, *, hidden=True):
    """Every array has the same bits; with `hidden` those of poses that are not to be believed too."""
    for label in STREAMS:
        first, second = getattr(one, label), getattr(other, label)
        assert (first is None) == (second is None), label
        for key in () if first is None else [f.name for f in fields(first)]:
            a, b = getattr(first, key), getattr(second, key)
            assert (a is None) == (b is None), f"{label}.{key}"
            if a is None:
                continue
            a, b = np.asarray(a), np.asarray(b)
            if not hidden and label == "optical" and key in ("q_ref_body", "position"):
                a, b = a[first.valid], b[first.valid]
            assert a.dtype == b.dtype and a.shape == b.shape, f"{label}.{key}"
            assert a.tobytes() == b.tobytes(), f"{label}.{key}"


@pytest.mark.parametrize("make", RUNS)
def test_hdf5_folder_npz_round_trip(tmp_path, make):
    """Would catch a bit, nanosecond, hidden row or fact that is lost on the way through all formats."""
    run = make()
    one = jaxekf.load(jaxekf.save(run, tmp_path / "run.h5"))
    assert_same(run, one)
    assert (one.name, one.info) == (run.name, run.info)
    two = jaxekf.load(jaxekf.save(one, tmp_path / "run"))
    three = jaxekf.load(jaxekf.save(two, tmp_path / "run.npz"))
    assert_same(two, three)
    assert_same(run, three, hidden=False)
    assert three.info["seed"] == run.info["seed"]


FLOATS = st.one_of(st.floats(-9e5, 9e5), st.sampled_from([5e-324, -0.0]))
"""What a sensor may read: beyond a million it is masked."""


@given(
    steps=st.lists(st.integers(50_000, 400_000_000), min_size=1, max_size=8),
    start=st.integers(-(2**61), 2**61),
    values=st.lists(FLOATS, min_size=4, max_size=4),
    hidden=st.lists(st.booleans(), min_size=9, max_size=9),
    suffix=st.sampled_from(SUFFIXES),
)
@settings(max_examples=30)
def test_any_run_comes_back(tmp_path_factory, steps, start, values, hidden, suffix):
    """Would catch odd numbers (subnormal, -0, NaN in hidden rows, far times) that change in a file."""
    time = start + np.cumsum([0, *steps]).astype(np.int64)
    count = len(time)
    rng = np.random.default_rng(steps)
    q = rng.standard_normal((count, 4))
    q /= np.linalg.norm(q, axis=1, keepdims=True)
    valid = ~np.array(hidden[:count])
    valid[0] = True
    q[~valid] = np.array([np.nan, np.inf, 0.0, values[3]])
    vectors = np.tile(values[:3], (count, 1)) * rng.choice([-1, 1], (count, 3))
    run = Recording(
        "any Ω",
        Optical(time, q, valid, np.where(valid[:, None], vectors, np.nan)),
        Imu(time, vectors, magnetometer=vectors),
        Encoder(time, q, valid, ~valid),
        {"note": "µ\t'\"\n", "n": 3, "list": [1.5, 2.0], "section": {"a": True}},
    )
    folder = tmp_path_factory.mktemp("any")
    again = container.load(container.save(run, folder / f"run{suffix}"))
    assert_same(run, again)
    assert (again.name, again.info) == (run.name, run.info)
    masked = again.intake["optical"].masked
    assert (masked["hidden"].count if masked else 0) == np.sum(~valid)
    shutil.rmtree(folder)


def arrays(run=None):
    """The data sets of a small run that another program might write, by path."""
    run = run or pose_run()
    return {
        "optical/time_ns": run.optical.time_ns[:20],
        "optical/q_ref_body": run.optical.q_ref_body[:20].copy(),
        "imu/time_ns": run.imu.time_ns[:50],
        "imu/gyroscope": run.imu.gyroscope[:50].copy(),
    }


def foreign(path, data, root=()):
    """Such a file, written by plain h5py or NumPy."""
    if path.suffix == ".npz":
        np.savez(path, **data, **dict(root))
    else:
        with h5py.File(path, "w") as file:
            for key, value in data.items():
                file[key] = value
            for key, value in dict(root).items():
                file.attrs[key] = value
    return path


def refusal(path):
    """The one line in which a file is refused; no exception of a library is its cause."""
    with pytest.raises(RecordingError) as caught:
        jaxekf.load(path)
    assert "\n" not in str(caught.value)
    return str(caught.value)


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_files_of_others(tmp_path, suffix):
    """Would catch a plain file that needs attributes of ours, or rows that end other than in CSV."""
    data, plain = arrays(), arrays()
    q = data["optical/q_ref_body"]
    q[3], q[4], q[5] = 0.0, np.nan, 3.0 * q[5]
    q[6] *= 1.01
    data["optical/valid"] = (np.arange(20) != 7).astype(np.uint8)
    data["imu/gyroscope"] = data["imu/gyroscope"].astype(np.float32)
    data["imu/gyroscope"][9] = np.inf
    data["imu/time_ns"] = data["imu/time_ns"].astype(np.uint64)
    data["photos/first"] = np.zeros(3)
    for key in ("imu/time_ns", "imu/gyroscope"):
        data[key] = np.insert(data[key], 12, data[key][12], axis=0)
    run = jaxekf.load(foreign(tmp_path / f"run{suffix}", data))
    assert run.name == "run" and run.info == {}
    masked = {name: list(r.numbers) for name, r in run.intake["optical"].masked.items()}
    assert masked == {
        "hidden": [7],
        "blank": [4],
        "missing tool (zero quaternion)": [3],
        "norm off by more than 0.1": [5],
    }
    assert list(np.flatnonzero(~run.optical.valid)) == [3, 4, 5, 7]
    np.testing.assert_allclose(
        run.optical.q_ref_body[6], plain["optical/q_ref_body"][6], atol=1e-15
    )
    assert [list(r.numbers) for r in run.intake["imu"].masked.values()] == [[9]]
    assert [list(r.numbers) for r in run.intake["imu"].dropped.values()] == [[13]]
    assert len(run.imu.time_ns) == 49
    notes = [*run.intake["optical"].notes, *run.intake["imu"].notes]
    assert "photos" in " ".join(notes) and "samples 6 to 6" in " ".join(notes)


def test_markers_of_others(tmp_path):
    """Would catch a marker without a position that counts as seen, or frames that are counted as lines."""
    rng = np.random.default_rng(0)
    data = {
        "markers/time_ns": BIG + np.arange(6) * 20_000_000,
        "markers/position": rng.standard_normal((6, 2, 3)),
        "markers/names": ["A", "B"],
        "markers/p_body_marker": rng.standard_normal((2, 3)),
    }
    data["markers/position"][4, 1] = np.nan
    for name, count in (("time_ns", 6), ("position", 6)):
        again = data[f"markers/{name}"]
        data[f"markers/{name}"] = np.insert(again, 2, again[2], axis=0)
        assert len(data[f"markers/{name}"]) == count + 1
    for suffix in SUFFIXES:
        run = jaxekf.load(foreign(tmp_path / f"run{suffix}", data))
        assert run.markers.names == ("A", "B")
        assert run.markers.visible.sum() == 11 and not run.markers.visible[4, 1]
        account = run.intake["markers"]
        assert account.rows == 14 and account.dropped["repeated"].count == 2
        assert account.parts["A"].rows == 7 and len(account.parts["A"].dropped) == 1
        assert list(account.masked["blank"].numbers) == [5]


def test_markers_of_others_that_are_none(tmp_path):
    """Would catch places that stand for a lost marker taken for one, in a file that has no lines; and a
    resting marker that the file itself says is seen taken for a frozen one."""
    rng = np.random.default_rng(1)
    data = {
        "markers/time_ns": BIG + np.arange(8) * 20_000_000,
        "markers/position": rng.standard_normal((8, 2, 3)),
        "markers/names": ["A", "B"],
        "markers/p_body_marker": rng.standard_normal((2, 3)),
    }
    data["markers/position"][1, 0] = 0.0
    data["markers/position"][2, 1] = -3.7e28
    data["markers/position"][5, 1] = data["markers/position"][4, 1]
    for suffix in SUFFIXES:
        path = tmp_path / f"run{suffix}"
        run = jaxekf.load(foreign(path, data))
        assert {k: list(r.numbers) for k, r in run.intake["markers"].masked.items()} == {
            "missing marker (zeros)": [1],
            "beyond any tracker": [2],
            "suspicious (position repeated exactly)": [5],
        }
        run = jaxekf.load(foreign(path, data | {"markers/visible": np.ones((8, 2), bool)}))
        assert run.markers.visible[5, 1] and run.markers.visible.sum() == 14


def test_what_was_saved_is_not_judged_again(tmp_path):
    """Would catch a resting tool of a run that was made in Python masked once it is read again."""
    run = jaxekf.simulation.attitude_runs.recording(
        "run", jaxekf.simulation.attitude_runs.free_motion(1), seed=1, duration_s=2.0
    )
    for stream in (run.optical.q_ref_body, run.optical.position):
        if stream is not None:
            stream[20:40] = stream[20]
    for suffix in SUFFIXES:
        kept = jaxekf.save(run.replace(info={"trust_units": True}), tmp_path / f"run{suffix}")
        assert jaxekf.load(kept).optical.valid.all()


def changed(**changes):
    """Data sets of others with some replaced, ``optical__valid`` for ``optical/valid``; None removes."""
    data = arrays() | {key.replace("__", "/"): value for key, value in changes.items()}
    return {key: value for key, value in data.items() if value is not None}


FLAGS = np.ones(20, bool)
TIMES = arrays()["optical/time_ns"]
WRONG = {
    "float times": (changed(optical__time_ns=1e-9 * TIMES), "time_ns", "cannot hold nanoseconds"),
    "no times fit": (
        changed(optical__time_ns=TIMES.astype(np.uint64) << 3),
        "fits into int64",
        "[0]",
    ),
    "short times": (changed(optical__time_ns=TIMES[:5]), "q_ref_body", "shape (20, 4)", "N = 5"),
    "transposed": (changed(imu__gyroscope=np.zeros((3, 50))), "shape (3, 50)", "(N, 3)"),
    "no samples": (changed(imu__time_ns=TIMES[:0]), "0 samples", "imu/time_ns"),
    "missing": (changed(imu__gyroscope=None), "without gyroscope", "time_ns, gyroscope, [acc"),
    "unknown": (changed(imu__gyro=FLAGS), "unknown gyro", "time_ns, gyroscope, [acc"),
    "texts": (changed(imu__gyroscope=np.full((50, 3), b"1.0")), "gyroscope", "type |S3"),
    "complex": (changed(imu__gyroscope=np.zeros((50, 3), complex)), "complex128", "float64"),
    "flags": (changed(optical__valid=FLAGS + 1), "optical/valid[0]", "0 or 1"),
    "large": (changed(imu__gyroscope=np.full((50, 3), 2**60)), "gyroscope[0, 0]", "2^53"),
    "nothing": ({"photos/first": FLAGS}, "no stream", "optical, markers, camera, imu, encoder"),
    "twice": (changed(optical__time_ns=np.r_[TIMES[:1], TIMES[:-1]]), "twice with other numbers"),
    "backwards": (changed(imu__time_ns=np.roll(arrays()["imu/time_ns"], 1)), "imu/time[1]"),
    "all lost": (changed(optical__valid=~FLAGS), "no usable row", "20 hidden", "run.", ":optical"),
    "late": (changed(optical__latency_ns=-1), "latency_ns", "0 or more"),
    "seconds": (changed(imu__time_ns=np.arange(50) * 10**9), "a sample every 1 s"),
}


@pytest.mark.parametrize("suffix", SUFFIXES)
@pytest.mark.parametrize("name", WRONG)
def test_wrong_content(tmp_path, name, suffix):
    """Would catch a fault that is read all the same, or one whose message does not name the data set."""
    data, *told = WRONG[name]
    message = refusal(foreign(tmp_path / f"run{suffix}", data))
    assert all(part in message for part in told), message


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_root_is_believed_only_where_it_fits(tmp_path, suffix):
    """Would catch an estimate, another version, another unit or changed content taken for a run."""
    path = tmp_path / f"run{suffix}"
    for root, told in (
        ({"kind": "jaxekf estimate"}, "'jaxekf estimate'"),
        ({"schema_version": 7}, "7"),
        ({"info": "a = "}, "not TOML"),
        ({"name": 3}, "a text"),
        ({"sha256": 64 * "0"}, "sha256"),
    ):
        assert told in refusal(foreign(path, arrays(), root))
    container.save(pose_run(), path, overwrite=True)
    if suffix == ".h5":
        with h5py.File(path, "a") as file:
            file["imu/gyroscope"].attrs["unit"] = "deg/s"
        assert "'deg/s', expected 'rad/s'" in refusal(path)
        with h5py.File(path, "a") as file:
            file["imu/gyroscope"].attrs["unit"] = "rad/s"
            file["imu/gyroscope"][7, 1] += 1e-9
    else:
        with np.load(path) as file:
            data = dict(file)
        np.savez(path, **(data | {"imu/gyroscope@unit": "deg/s"}))
        assert "'deg/s', expected 'rad/s'" in refusal(path)
        data["imu/gyroscope"][7, 1] += 1e-9
        np.savez(path, **data)
    assert "SHA-256" in refusal(path)


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_no_file(tmp_path, suffix):
    """Would catch a traceback where there is nothing to read, or the wrong thing."""
    path = tmp_path / f"run{suffix}"
    assert "no such file" in refusal(path)
    path.write_bytes(b"")
    assert "empty file (0 bytes)" in refusal(path)
    path.write_text("time,qw,qx,qy,qz\n" * 100)
    assert "that is not" in refusal(path)
    other = {".h5": ".npz", ".npz": ".h5"}[suffix]
    shutil.copy(container.save(pose_run(), tmp_path / f"other{other}"), path)
    assert f"the suffix {other}" in refusal(path)
    path.unlink()
    path.mkdir()
    assert "a folder" in refusal(path)


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_truncated(tmp_path, suffix):
    """Would catch a file cut off anywhere that is read, or whose message lacks its sizes."""
    path = container.save(pose_run(), tmp_path / f"run{suffix}")
    whole = path.read_bytes()
    told = []
    for size in (1, 5, 20, 100, len(whole) // 3, len(whole) // 2, len(whole) - 1):
        path.write_bytes(whole[:size])
        message = refusal(path)
        assert "truncated" in message and f"{size} bytes" in message
        if suffix == ".h5" and size >= 100:
            assert f"{len(whole)} bytes, as its superblock states" in message
        if suffix == ".npz" and 100 <= size < len(whole) - 1:
            told.append("ends at byte" in message)
    assert suffix == ".h5" or any(told)


def test_endless_heap(tmp_path):
    """Would catch a damaged heap of texts, over which the HDF5 library does not come back."""
    path = foreign(tmp_path / "run.h5", arrays(), {"name": "of another program"})
    data = bytearray(path.read_bytes())
    assert jaxekf.load(path).name == "of another program"
    # After the heap's head and the one text, which takes 16 + 24 bytes, stands what is free.
    at = data.index(b"GCOL") + 16 + 16 + 24
    assert int.from_bytes(data[at : at + 2], "little") == 0
    for where, size in ((at, 0), (at - 40, 2**64 - 1)):
        damaged = data.copy()
        damaged[where + 8 : where + 16] = size.to_bytes(8, "little")
        path.write_bytes(damaged)
        assert f"heap of texts at byte {where}" in refusal(path)


def test_nothing_is_run_or_fetched(tmp_path):
    """Would catch pickled objects that are loaded, and links or filters that end in a traceback."""
    path = foreign(tmp_path / "run.npz", changed(imu__gyroscope=np.array([[1, None]], object)))
    assert "never loaded" in refusal(path)
    path = foreign(tmp_path / "run.h5", arrays())
    with h5py.File(path, "a") as file:
        file["other"] = h5py.ExternalLink("elsewhere.h5", "/imu")
    assert "other" in " ".join(jaxekf.load(path).intake["optical"].notes)
    with h5py.File(path, "a") as file:
        file["encoder"] = h5py.ExternalLink("elsewhere.h5", "/imu")
    assert "a link (ExternalLink)" in refusal(path)
    with h5py.File(path, "a") as file:
        del file["encoder"], file["imu/gyroscope"]
        file["imu/gyroscope"] = h5py.SoftLink("/optical/q_ref_body")
    assert "a link (SoftLink)" in refusal(path)
    with h5py.File(path, "a") as file:
        del file["imu/gyroscope"]
        file.create_dataset("imu/gyroscope", (50, 3), "f8", external=[("other.bin", 0, 1200)])
    assert "other files" in refusal(path)
    with h5py.File(path, "a") as file:
        del file["imu/gyroscope"]
        plan = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
        plan.set_chunk((50, 3))
        plan.set_filter(32_999, h5py.h5z.FLAG_OPTIONAL)
        space = h5py.h5s.create_simple((50, 3))
        h5py.h5d.create(file["imu"].id, b"gyroscope", h5py.h5t.IEEE_F64LE, space, plan)
    assert "filter 32999" in refusal(path)


def test_declared_sizes(tmp_path):
    """Would catch a small file that fills the memory before anything is judged."""
    path = foreign(tmp_path / "run.h5", changed(imu__gyroscope=None))
    with h5py.File(path, "a") as file:
        file.create_dataset("imu/gyroscope", (2**40, 3), "f8", chunks=(1024, 3))
    assert f"declared size of {2**40 * 24} bytes" in refusal(path)
    path = foreign(tmp_path / "run.npz", changed(imu__gyroscope=None))
    with (
        zipfile.ZipFile(path, "a", zipfile.ZIP_LZMA) as file,
        file.open("imu/gyroscope.npy", "w", force_zip64=True) as member,
    ):
        np.save(member, np.zeros((2**20, 3)))
    assert f"a declared size of {2**20 * 24} bytes" in refusal(path)


def test_what_cannot_be_saved(tmp_path):
    """Would catch a file that could not be read again, or one of a failed save left behind."""
    run = pose_run()
    for wrong in (
        run.replace(info={"what": None}),
        run.replace(info={"what": 70_000 * "x"}),
        run.replace(optical=replace(run.optical, valid=np.zeros_like(run.optical.valid))),
    ):
        for suffix in SUFFIXES:
            with pytest.raises(RecordingError):
                container.save(wrong, tmp_path / f"run{suffix}")
    assert list(tmp_path.iterdir()) == []
    path = container.save(run, tmp_path / "run.h5")
    with pytest.raises(RecordingError, match="exists"):
        container.save(run, path)
    with pytest.raises(RecordingError, match="suffix"):
        container.save(run, tmp_path / "run.mat")
    assert container.save(run, path, overwrite=True) == path
