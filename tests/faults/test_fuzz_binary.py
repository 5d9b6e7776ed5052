"""Damaged HDF5 and NPZ files: each is refused in one line, or read as an independent reader reads it.

HDF5 files are read by a process of their own, for the HDF5 library might crash or never come back.
"""

import os
import random
import subprocess
import sys
import threading
import warnings
import zipfile
from pathlib import Path

import h5py
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from jaxekf._support.errors import RecordingError
from jaxekf.io import container
from jaxekf.recordings.types import Encoder, Imu, Markers, Optical, Recording

COUNT = 10_000 if os.environ.get("JAXEKF_LONG") == "1" else 300
PATIENCE_S = 20.0
WITHOUT_JAX = """
import pathlib, runpy, sys, types
package = types.ModuleType("jaxekf")
package.__path__ = [str(pathlib.Path(sys.argv[1]).parents[1])]
sys.modules["jaxekf"] = package
runpy.run_path(sys.argv[2], run_name="__main__")
"""
"""Starts this file without the rest of the package, which takes seconds to import."""


def small_run():
    """All streams, with hidden rows, and none of the numbers like another."""
    rng = np.random.default_rng(4)
    time = 1_700_000_000_123_456_789 + np.cumsum(rng.integers(10**6, 10**7, 12))
    q = np.roll(Rotation.random(12, rng=4).as_quat(), 1, axis=1)
    valid, two = rng.uniform(size=12) < 0.8, rng.uniform(size=(12, 2)) < 0.8
    vectors = rng.standard_normal((12, 3))
    return Recording(
        "small",
        Optical(time, q, valid, vectors, rng.uniform(size=12), vectors[0], 5_000_000),
        Imu(time + 7, vectors, vectors, np.where(valid[:, None], vectors, np.nan)),
        Encoder(time + 9, q, valid, valid, vectors),
        {"gravity_ref": [0.0, 0.0, -9.81]},
        markers=Markers(time, rng.standard_normal((12, 2, 3)), two, ("A", "B"), vectors[:2]),
    )


def write_seeds(folder, suffix):
    """Half of the run as `save` writes it, the other half as another program might: plain, not packed."""
    run = small_run()
    ours = container.save(run.replace(encoder=None, markers=None), folder / f"ours{suffix}")
    other = container.save(run.replace(imu=None, optical=None), folder / f"other{suffix}")
    plain = folder / f"plain{suffix}"
    data = dict(arrays_of(other))
    if suffix == ".npz":
        np.savez(plain, **data)
    else:
        with h5py.File(plain, "w") as file:
            for key, value in data.items():
                file[key] = value
            file.attrs["name"] = "plain"
    return [ours.read_bytes(), plain.read_bytes()]


def arrays_of(path):
    """Data sets of a file by path, by plain h5py or NumPy; of NPZ without what is said of them."""
    if path.suffix == ".npz":
        with np.load(path, allow_pickle=False) as file:
            return {key: file[key] for key in file.files if "/" in key and "@" not in key}
    found = {}
    with h5py.File(path, "r") as file:
        for label in sorted(set(file) & {"optical", "markers", "imu", "encoder"}):
            for name, data in file[label].items():
                text = h5py.check_string_dtype(data.dtype)
                found[f"{label}/{name}"] = data.asstr()[()] if text else data[()]
    return found


def mutate(data, seed):
    """The bytes with some bits flipped, bytes put in, taken out or set, blocks swapped, or cut off."""
    rng, data = random.Random(seed), bytearray(data)
    for _ in range(rng.choice([1, 1, 1, 2, 4, 16])):
        at, size = rng.randrange(len(data)), rng.choice([1, 2, 8, 64])
        kind = rng.choice("fffsssdiwc")
        if kind == "f":
            data[at] ^= 1 << rng.randrange(8)
        elif kind == "s":
            data[at] = rng.choice([0, 1, 127, 128, 255, rng.randrange(256)])
        elif kind == "d" and len(data) > 200:
            del data[at : at + size]
        elif kind == "i":
            data[at:at] = rng.randbytes(size)
        elif kind == "w":
            other = rng.randrange(len(data))
            size = min(8 * size, len(data) - at, len(data) - other)
            block = data[at : at + size]
            data[at : at + size] = data[other : other + size]
            data[other : other + size] = block
        elif kind == "c" and rng.random() < 0.3:
            del data[max(at, 100) :]
    return bytes(data)


def difference(path, run):
    """Where a run is not what is in the file, read independently and masked as documented; or None."""
    data = arrays_of(path)
    for label in {key.split("/")[0] for key in data} & {"optical", "markers", "imu", "encoder"}:
        stream = getattr(run, label)
        there = {
            key.split("/")[1]: np.asarray(value) for key, value in data.items() if label in key
        }
        rows = expected_rows(label, there)
        times = there["time_ns"][rows]
        if not np.array_equal(stream.time_ns, times) or len(times) == 0:
            return f"{label}: times"
        for key, values in there.items():
            got = getattr(stream, key)
            if key == "names":
                same = list(got) == [str(v) for v in values.tolist()]
            elif (
                values.ndim == 0 or len(values) != len(there["time_ns"]) or key.startswith("p_body")
            ):
                same = np.array_equal(got, values)
            elif key in ("valid", "visible", "scored"):
                same = np.array_equal(got & ~values.astype(bool)[rows], np.zeros_like(got))
            elif key == "q_ref_body":
                seen = stream.valid
                norm = np.linalg.norm(values[rows][seen], axis=1, keepdims=True)
                same = np.all(np.abs(norm - 1.0) <= 0.1) and np.allclose(
                    got[seen], values[rows][seen] / norm, rtol=0.0, atol=1e-3
                )
                exact = np.abs(norm[:, 0] - 1.0) < 1e-15
                same &= np.array_equal(got[seen][exact], values[rows][seen][exact])
            else:
                same = np.array_equal(got, values[rows], equal_nan=True)
            if not same:
                return f"{label}/{key}"
        if label in ("optical", "encoder") and not np.array_equal(
            stream.valid, expected_valid(label, there, rows)
        ):
            return f"{label}: rows that are valid"
    return None


def expected_rows(label, there):
    """Samples that a stream has: each time once, and of an IMU those that are finite."""
    time = there["time_ns"]
    rows = np.concatenate([[True], np.diff(time) > 0])
    if label == "imu":
        for key in {"gyroscope", "accelerometer"} & set(there):
            rows &= np.isfinite(there[key]).all(axis=1)
    return rows


def expected_valid(label, there, rows):
    """Rows that are said to be valid and hold a quaternion, and of a tracker a position."""
    with np.errstate(all="ignore"):
        norm = np.linalg.norm(there["q_ref_body"], axis=1)
    valid = np.abs(norm - 1.0) <= 0.1
    # Of a plain file the name of a data set may be what is damaged: then it is not there.
    if "valid" in there:
        valid &= there["valid"].astype(bool)
    if label == "optical" and "position" in there:
        valid &= np.isfinite(there["position"]).all(axis=1)
    return valid[rows]


def judge(path):
    """``refused``, ``read``, or what is wrong."""
    try:
        run = container.load(path)
    except RecordingError as error:
        return "refused" if "\n" not in str(error) else f"two lines: {error}"
    except Exception as error:
        return f"{type(error).__name__}: {error}"
    try:
        with warnings.catch_warnings(action="ignore"):
            wrong = difference(path, run)
    except Exception as error:
        return f"read, but not by others: {type(error).__name__}: {error}"
    return "read" if wrong is None else f"another run: {wrong}"


class Worker:
    """A process that judges files one after the other, and is started again where it crashed."""

    def __init__(self):
        self.process = None

    def judge(self, path):
        if self.process is None:
            self.process = subprocess.Popen(
                [sys.executable, "-c", WITHOUT_JAX, container.__file__, __file__],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=subprocess.DEVNULL,
                text=True,
            )
            assert self.process.stdout.readline() == "ready\n"
        process = self.process
        timer = threading.Timer(PATIENCE_S, process.kill)
        timer.start()
        process.stdin.write(f"{path}\n")
        process.stdin.flush()
        answer = process.stdout.readline().rstrip("\n")
        timer.cancel()
        if not answer:
            self.close()
            return f"crashed or hung (status {process.returncode})"
        return answer

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.close()

    def close(self):
        if self.process is not None:
            self.process.stdin.close()
            self.process.wait()
            self.process.stdout.close()
            self.process = None


@pytest.mark.long
@pytest.mark.parametrize("suffix", [".npz", ".h5"])
def test_damaged_files(tmp_path, suffix):
    """Would catch a damaged file that ends in a traceback, a crash or a hang, or that is read as other
    numbers than stand in it."""
    seeds, found = write_seeds(tmp_path, suffix), {}
    path = tmp_path / f"damaged{suffix}"
    with Worker() as worker:
        for seed in range(COUNT):
            path.write_bytes(mutate(seeds[seed % 2], seed))
            answer = worker.judge(path) if suffix == ".h5" else judge(path)
            found.setdefault(answer, []).append(seed)
    told = {answer: len(which) for answer, which in found.items()}
    print(suffix, told)
    assert set(found) <= {"read", "refused"}, {a: s[:5] for a, s in found.items()}
    # Both ends are met, of both seeds.
    for answer in ("read", "refused"):
        assert len({seed % 2 for seed in found[answer]}) == 2, told


@pytest.mark.parametrize("suffix", [".npz", ".h5"])
def test_the_independent_reader_tells_a_difference(tmp_path, suffix):
    """Would catch a comparison that never fails: files of other numbers, times and flags differ."""
    run = small_run()
    path = container.save(run, tmp_path / f"run{suffix}")
    assert judge(path) == "read"
    flags = ~run.optical.valid
    for other in (
        Imu(run.imu.time_ns + 1, run.imu.gyroscope, run.imu.accelerometer, run.imu.magnetometer),
        Imu(run.imu.time_ns, 2 * run.imu.gyroscope, run.imu.accelerometer, run.imu.magnetometer),
    ):
        assert difference(path, run.replace(imu=other)).startswith("imu")
    optical = Optical(run.optical.time_ns, run.optical.q_ref_body, flags, run.optical.position)
    assert difference(path, run.replace(optical=optical)).startswith("optical")
    assert zipfile.is_zipfile(path) == (suffix == ".npz")


if __name__ == "__main__":
    print("ready", flush=True)
    for line in sys.stdin:
        print(judge(Path(line.rstrip("\n"))).replace("\n", " "), flush=True)
