"""Byte-mutated CSV and TOML files: the typed error, or what an independent reader makes of the bytes."""

import csv
import io
import tomllib
from decimal import Decimal

import numpy as np
import pytest
from scenario import LONG

import jaxekf
from jaxekf._support.errors import RecordingError
from jaxekf.simulation import attitude_runs

FILES = ("imu.csv", "optical.csv", "recording.toml")
NUMBERS = {"imu.csv": ("gx", "gy", "gz"), "optical.csv": ("qw", "qx", "qy", "qz", "x", "y", "z")}


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """A short run on disk, with its bytes."""
    made = attitude_runs.recording(
        "run",
        attitude_runs.free_motion(1),
        seed=1,
        duration_s=0.4,
        start_ns=1_700_000_000_123_456_789,
        occlusions=[(0.1, 0.15)],
    )
    folder = jaxekf.save(made, tmp_path_factory.mktemp("fuzz") / "run", digits=7)
    return folder, {file.name: file.read_bytes() for file in folder.iterdir()}


def mutated(rng, data):
    """A few bytes flipped, replaced by telling ones, taken out, put in, or a block moved or cut off."""
    data = bytearray(data)
    for _ in range(int(rng.integers(1, 4))):
        at = int(rng.integers(0, max(len(data), 1)))
        kind = int(rng.integers(0, 7))
        if kind == 0 and data:
            data[at] ^= 1 << int(rng.integers(0, 8))
        elif kind == 1 and data:
            data[at] = int(rng.choice(np.frombuffer(b',;."\n\r\t -+e0159naif#[]=\0\xff', np.uint8)))
        elif kind == 2:
            del data[at : at + int(rng.integers(1, 12))]
        elif kind == 3:
            data[at:at] = bytes(rng.integers(0, 256, int(rng.integers(1, 4)), dtype=np.uint8))
        elif kind == 4:
            end = at + int(rng.integers(1, 200))
            data[at:at] = data[at:end]
        elif kind == 5:
            end = at + int(rng.integers(1, 80))
            other = int(rng.integers(0, max(len(data), 1)))
            block = data[at:end]
            del data[at:end]
            data[other:other] = block
        else:
            del data[int(rng.integers(0, len(data) + 1)) :]
    return bytes(data)


def independent(data, names):
    """Times and numbers by Python's own readers, rows by time; NaN for what is blank."""
    text = data.decode("utf-8-sig").replace("\r\n", "\n").replace("\r", "\n")
    head = text.strip("\n").split("\n")[0]
    delimiter = next((d for d in ";\t" if d in head), ",")
    rows = [
        row
        for row in csv.reader(io.StringIO(text), delimiter=delimiter)
        if any(c.strip() for c in row)
    ]
    columns = [cell.strip() for cell in rows[0]]
    if len(rows) > 2 and len(rows[-1]) < len(rows[1]):
        rows = rows[:-1]  # The last line is cut short.
    if delimiter != ",":
        rows = [[cell.replace(",", ".") for cell in row] for row in rows]
    found = {}
    for row in rows[1:]:
        cells = dict(zip(columns, row, strict=False))
        time = int((Decimal(cells["time"].strip()) * 10**9).to_integral_value())
        found[time] = [float(cells[name].strip() or "nan") for name in names]
    return found


def check(run, name, data):
    """Whether a spoilt file was read; what it was read as is right."""
    folder, whole = run
    (folder / name).write_bytes(data)
    try:
        made = jaxekf.load(folder)
    except RecordingError as error:
        fine = ": got " in str(error) and "\n" not in str(error)
    else:
        fine = None
    finally:
        (folder / name).write_bytes(whole[name])
    if fine is not None:
        assert fine
        return False
    if name == "recording.toml":
        assert made.name == str(tomllib.loads(data.decode("utf-8-sig")).get("name", folder.name))
        return True
    expected = independent(data, NUMBERS[name])
    stream = made.imu if name == "imu.csv" else made.optical
    for i, time in enumerate(stream.time_ns):
        numbers = np.array(expected[int(time)])
        if name == "imu.csv":
            np.testing.assert_array_equal(stream.gyroscope[i], numbers)
            continue
        norm = np.linalg.norm(numbers[:4])
        if not (abs(norm - 1.0) <= 0.1 and np.isfinite(numbers).all()):
            assert not stream.valid[i]
        if stream.valid[i]:
            np.testing.assert_allclose(stream.q_ref_body[i], numbers[:4] / norm, rtol=0, atol=1e-15)
            np.testing.assert_array_equal(stream.position[i], numbers[4:])
    account = made.intake[name.removesuffix(".csv")]
    gone = sum(reason.count for reason in account.dropped.values())
    outside = set(account.numbers.tolist())
    gone += sum(
        int(sum(n not in outside for n in reason.numbers.tolist()))
        for reason in account.masked.values()
    )
    assert account.rows == len(stream.time_ns) + gone
    return True


@pytest.mark.long
def test_spoilt_text(run):
    """Would catch a traceback, a hang, a row that shifts, and a number that is read as another."""
    count, read = (10_000 if LONG else 200), 0
    rng = np.random.default_rng(7)
    for i in range(count):
        name = FILES[i % 3]
        read += check(run, name, mutated(rng, run[1][name]))
    # Most mutations are noticed; some leave a file that is as good as before.
    assert 0.02 * count < read < 0.9 * count


def test_hashes_catch_the_rest(run, tmp_path):
    """Would catch a digit that was changed where hashes are kept."""
    folder = jaxekf.save(jaxekf.load(run[0]), tmp_path / "run", hashes=True)
    assert jaxekf.load(folder).imu is not None
    file = folder / "imu.csv"
    data = bytearray(file.read_bytes())
    at = data.rindex(b"1")
    data[at : at + 1] = b"2"
    file.write_bytes(data)
    with pytest.raises(RecordingError, match="sha256"):
        jaxekf.load(folder)
