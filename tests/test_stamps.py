"""Stamps that need repair: shifts, counters, wraps, shared stamps and stamps of receipt in bursts."""

import numpy as np
import pytest

import jaxekf
from jaxekf._support.errors import RecordingError
from jaxekf.recordings import stamp_envelope

RATE_HZ, SAMPLES = 200.0, 3000


def write(folder, stamps, section="", name="run"):
    """A run of an IMU and a tracker of one sample in four; `stamps` are texts of the IMU's times."""
    folder.mkdir()
    count = np.arange(len(stamps))
    rows = [f"{t},{0.1 * np.sin(i):.6f},0.{i % 10},0.1" for t, i in zip(stamps, count, strict=True)]
    (folder / "imu.csv").write_text("\n".join(["time,gx,gy,gz", *rows]) + "\n")
    poses = [f"{t:.6f},1,0,0,0" for t in np.arange(0.0, len(stamps) / RATE_HZ, 0.02)]
    (folder / "optical.csv").write_text("\n".join(["time,qw,qx,qy,qz", *poses]) + "\n")
    text = f'schema_version = 1\nname = "{name}"\ntrust_units = true\n[imu]\n{section}\n[optical]\n'
    (folder / "recording.toml").write_text(text)
    return folder


def seconds(values):
    return [f"{v:.9f}" for v in values]


@pytest.fixture
def true():
    return np.arange(SAMPLES) / RATE_HZ


@pytest.mark.parametrize("shift", ["0.25", "-3.5", "1e3"])
def test_shift(tmp_path, true, shift):
    """A sign turned round, or a shift that is applied again after saving."""
    run = jaxekf.load(write(tmp_path / "run", seconds(true), f"time_shift = {shift}"))
    expected = np.round(1e9 * (true + float(shift))).astype(np.int64)
    np.testing.assert_array_equal(run.need_imu().time_ns, expected)
    again = jaxekf.load(jaxekf.save(run, tmp_path / "again"))
    np.testing.assert_array_equal(again.need_imu().time_ns, expected)


def test_negative_latency_names_the_shift(tmp_path, true):
    """A refusal that leaves the user with no way to move stamps that are early."""
    folder = write(tmp_path / "run", seconds(true))
    file = folder / "recording.toml"
    file.write_text(file.read_text() + "latency = -0.1\n")
    with pytest.raises(RecordingError, match=r"time_shift = 0\.1"):
        jaxekf.load(folder)


@pytest.mark.parametrize(
    ("bits", "unit", "stated", "entry"),
    [
        (32, "us", 'time_unit = "us"', "time_wrap = 32"),
        (24, "us", 'time_unit = "us"', "time_wrap = 24"),
        (16, "ms", 'time_unit = "ms"', "time_wrap = 16"),
        (32, "us", "", 'time_wrap = "32 us"'),
    ],
)
def test_a_counter_that_wraps(tmp_path, true, bits, unit, stated, entry):
    """A wrap of which the message says logs were put together; one unwrapped by a wrong length."""
    scale = {"us": 1e6, "ms": 1e3}[unit]
    counts = (np.round(true * scale).astype(np.int64) + 2**bits - round(4.2 * scale)) % 2**bits
    texts = [str(c) for c in counts] if stated else seconds(counts / scale)
    with pytest.raises(RecordingError) as caught:
        jaxekf.load(write(tmp_path / "bare", texts, stated))
    assert entry in str(caught.value) and f"2^{bits}" in str(caught.value)
    run = jaxekf.load(write(tmp_path / "run", texts, f"{stated}\n{entry}\ntime_shift = -1e-9"))
    steps = np.diff(run.need_imu().time_ns)
    assert steps.min() == steps.max() == round(1e9 / RATE_HZ)
    assert "wraps 1 times" in " ".join(run.intake["imu"].notes)


def test_logs_put_together_are_not_a_wrap(tmp_path, true):
    """A counter blamed for a jump back of another length."""
    stamps = seconds(np.concatenate([true[:1500] + 7.0, true[1500:]]))
    with pytest.raises(RecordingError, match="logs that were put together"):
        jaxekf.load(write(tmp_path / "run", stamps))


def test_packet_counter(tmp_path, true):
    """Counts taken for seconds; a wrap of 16 bits or lost packets that shorten the time."""
    counts = np.arange(SAMPLES) + 65000
    kept = np.ones(SAMPLES, bool)
    kept[[700, 701, 2000]] = False
    texts = [str(c) for c in (counts % 65536)[kept]]
    section = f"counter_rate = {RATE_HZ}\ntime_wrap = 16\ntime_shift = {-65000 / RATE_HZ}"
    run = jaxekf.load(write(tmp_path / "run", texts, section))
    np.testing.assert_array_equal(run.need_imu().time_ns, np.round(1e9 * true[kept]))
    notes = " ".join(run.intake["imu"].notes)
    assert "3 samples are missing by the counter, at 2 places" in notes


@pytest.mark.parametrize("size", [2, 3, 5])
def test_shared_stamps(tmp_path, true, size):
    """Samples in groups with one stamp that cannot be read at all, or are spread to the wrong side."""
    shared = true[np.minimum((np.arange(SAMPLES) // size + 1) * size - 1, SAMPLES - 1)]
    with pytest.raises(RecordingError, match="spread_stamps = true"):
        jaxekf.load(write(tmp_path / "bare", seconds(shared)))
    run = jaxekf.load(write(tmp_path / "run", seconds(shared), "spread_stamps = true"))
    np.testing.assert_allclose(run.need_imu().time_ns, 1e9 * true, atol=2.0)


def received(true, kind, seed):
    """Stamps of receipt: in bursts of a timer, or held back by a network now and then."""
    rng = np.random.default_rng(seed)
    if kind == "timer":
        late = np.ceil(true / 0.016) * 0.016 + 3e-4 + 2e-5 * (np.arange(len(true)) % 4)
        return np.maximum.accumulate(late) + 1e-7 * np.arange(len(true))
    stamps = true + 1e-5 * rng.uniform(size=len(true))
    for start in rng.integers(0, len(true) - 20, len(true) // 12):
        stop = start + rng.integers(2, 15)
        stamps[start:stop] = np.maximum(
            stamps[start:stop], true[stop] + 1e-5 * np.arange(stop - start)
        )
    return np.maximum.accumulate(stamps) + 1e-7 * np.arange(len(true))


@pytest.mark.parametrize("kind", ["timer", "network"])
@pytest.mark.parametrize("lost", [0, 4])
@pytest.mark.parametrize("seed", range(3))
def test_bursts(tmp_path, true, kind, lost, seed):
    """Stamps of receipt taken for times of measurement without a word; a line that lost samples bend."""
    stamps = received(true, kind, seed)
    kept = np.ones(SAMPLES, bool)
    if lost:
        kept[1000 : 1000 + lost] = False
    texts = seconds(stamps[kept])
    plain = jaxekf.load(write(tmp_path / "bare", texts))
    assert "stamps come in bursts" in " ".join(plain.intake["imu"].notes)
    run = jaxekf.load(write(tmp_path / "run", texts, "restamp = true"))
    notes = " ".join(run.intake["imu"].notes)
    assert f"{lost} samples taken for lost" in notes and "bursts" not in notes
    off = run.need_imu().time_ns / 1e9 - true[kept]
    # Samples held back at the loss may be on either side of it.
    off = np.delete(off, np.s_[980:1020])
    assert np.ptp(off) < 1.5e-3
    assert abs(np.median(off)) < 1e-3


def test_regular_stamps_are_not_bursts(tmp_path, true):
    """An alarm for jitter, lost samples, digits that were cut off, or the rows of two sensors together."""
    rng = np.random.default_rng(0)
    both = np.unique(np.concatenate([true, 0.0007 + np.arange(0.0, 15.0, 1 / 125.0)]))
    cases = {
        "jitter": true + 1e-3 * rng.uniform(size=SAMPLES),
        "lost": true[rng.uniform(size=SAMPLES) > 0.2],
        "digits": np.floor(true * 1e3) / 1e3,
        "two": both,
    }
    for name, stamps in cases.items():
        run = jaxekf.load(write(tmp_path / name, seconds(stamps)))
        assert run.intake["imu"].notes == (), name


def test_long_run_follows_the_drift():
    """One line for an hour whose clock wanders by milliseconds."""
    rng = np.random.default_rng(1)
    count = np.arange(100_000)
    true = 0.02 * count + 5e-3 * np.sin(count / 15_000.0)
    late = np.where(rng.uniform(size=len(count)) < 0.3, 0.0, 0.01 * rng.uniform(size=len(count)))
    line, _ = stamp_envelope.restamped(np.round(1e9 * (true + late)).astype(np.int64))
    assert np.abs(line / 1e9 - true).max() < 5e-4


WRONG = {
    "time_shift = true": "finite seconds",
    'time_wrap = "x"': "number of bits",
    "counter_rate = -1": "positive rate",
    "restamp = 1": "true or false",
}


@pytest.mark.parametrize("entry", WRONG)
def test_entries_of_another_form(tmp_path, true, entry):
    """An entry that is ignored, or ends in a traceback."""
    with pytest.raises(RecordingError, match=WRONG[entry]):
        jaxekf.load(write(tmp_path / "run", seconds(true), entry))
