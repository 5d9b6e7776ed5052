"""The thirty faults of recordings and what a user gets for each, through Python and the command line.

E: an error of one line with its place, nothing written. M: masked, the run goes on, one warning for each
reason with the count and the first and last line. Of every run that goes on the account is exact.
"""

import json
import os
import re
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner
from scipy.spatial.transform import Rotation

import jaxekf
from jaxekf._support.constants import STANDARD_GRAVITY
from jaxekf._support.errors import RecordingError
from jaxekf.cli import main
from jaxekf.simulation import attitude_runs

ROOT = Path(__file__).parents[2]
pytestmark = pytest.mark.usefixtures("folder")


@pytest.fixture(scope="module")
def source(tmp_path_factory):
    """A run with accelerometer, 4 s long; the tracker is hidden for a while."""
    return jaxekf.save(made(), tmp_path_factory.mktemp("runs") / "run")


def made(duration_s=4.0):
    run = attitude_runs.recording(
        "run",
        attitude_runs.free_motion(4, speed_deg=60.0, rest_s=0.3),
        seed=4,
        duration_s=duration_s,
        start_ns=1_000 * 10**9,
        occlusions=[(2.0, 2.2)],
    )
    imu, truth = run.need_imu(), run.need_encoder()
    q = Rotation.from_quat(np.roll(truth.q_ref_body, -1, axis=1))
    at = np.clip(np.searchsorted(truth.time_ns, imu.time_ns), 0, len(truth.time_ns) - 1)
    force = q[at].inv().apply([0.0, 0.0, 9.81])
    imu = jaxekf.Imu(imu.time_ns, imu.gyroscope, force)
    return run.replace(imu=imu)


@pytest.fixture
def folder(source, tmp_path):
    """A copy to spoil."""
    copy = tmp_path / "run"
    copy.mkdir()
    for file in source.iterdir():
        (copy / file.name).write_bytes(file.read_bytes())
    return copy


def lines_of(file):
    return file.read_text("utf-8").splitlines()


def write(file, lines, end="\n"):
    file.write_bytes((end.join(lines) + end).encode())


def cell(file, line, column, text):
    """Change one cell; lines are counted from one, the header is the first."""
    lines = lines_of(file)
    cells = lines[line - 1].split(",")
    cells[lines[0].split(",").index(column)] = text
    lines[line - 1] = ",".join(cells)
    write(file, lines)


def column(file, names, change):
    """Change columns of numbers as arrays (N, names)."""
    lines = lines_of(file)
    head = lines[0].split(",")
    at = [head.index(name) for name in names]
    rows = [line.split(",") for line in lines[1:]]
    values = np.array([[float(row[i] or "nan") for i in at] for row in rows])
    for row, new in zip(rows, change(values), strict=True):
        for i, value in zip(at, new, strict=True):
            row[i] = "" if np.isnan(value) else f"{value:.17g}"
    write(file, [lines[0], *(",".join(row) for row in rows)])


def describe(folder, section, entry):
    """Add an entry to a section of recording.toml."""
    file = folder / "recording.toml"
    text = file.read_text("utf-8")
    key = entry.split("=")[0].strip()
    head, tail = text.split(f"[{section}]\n")
    own, *others = tail.split("\n[", 1)
    own = re.sub(rf"(?m)^{key} = .*(\n|$)", "", own)
    file.write_text("\n[".join([f"{head}[{section}]\n{entry}\n{own}", *others]), "utf-8")


def call(*arguments):
    return CliRunner().invoke(main, [str(part) for part in arguments])


def refused(folder, *words, line=None, column=None, path=None):
    """An error of one line, through Python and the command line, and no output."""
    with pytest.raises(RecordingError) as caught:
        jaxekf.load(folder)
    message = str(caught.value)
    assert "\n" not in message
    for word in (": got ", ", expected ", "; try ", *words):
        assert word in message, message
    if line is not None:
        assert caught.value.line == line
    if column is not None:
        assert caught.value.column == column
    if path is not None:
        assert caught.value.path.name == path
    output = folder.parent / "refused"
    result = call("estimate", folder, "-o", output)
    assert result.exit_code == 1
    assert isinstance(result.exception, SystemExit)
    assert result.stderr == f"Error: {message}\n"
    assert not output.exists()


def masked(folder, stream, reason, count, first=None, last=None, *, kind="masked", options=()):
    """Rows are masked for a reason, the run goes on, a warning says so, and the account is exact."""
    run = jaxekf.load(folder, sort="--sort" in options)
    found = getattr(run.intake[stream], kind)
    assert [name for name in found if reason in name], found
    name = next(name for name in found if reason in name)
    assert found[name].count == count
    if first is not None:
        assert (found[name].numbers[0], found[name].numbers[-1]) == (first, last or first)
    warning = f"{stream}: {count} {'row is' if count == 1 else 'rows are'} {kind}, {name}"
    result = goes_on(folder, *options)
    assert warning in result.stderr
    return run


def goes_on(folder, *options):
    """The command line estimates the run, and every row of every file is accounted for."""
    output = folder.parent / "result"
    result = call("estimate", folder, "-o", output, "--json", "--overwrite", *options)
    assert result.exit_code == 0, result.output
    exact(json.loads(result.stdout)["runs"], folder)
    return result


def exact(summaries, folder):
    """read = used + masked + gated + dropped, in rows of the source file."""
    for sensor, file in (("optical", "optical.csv"), ("gyroscope", "imu.csv")):
        total = 0
        for summary in summaries:
            account = dict(summary["account"][sensor])
            read = account.pop("read")
            assert read == sum(account.values()), (sensor, account)
            total += read
        rows = [line for line in lines_of(folder / file)[1:] if line.strip()]
        assert total == len(rows)


def plain(folder):
    return jaxekf.load(folder)


def same(run, other):
    """The same samples to the last bit."""
    for label in ("optical", "imu", "encoder"):
        one, two = getattr(run, label), getattr(other, label)
        np.testing.assert_array_equal(one.time_ns, two.time_ns)
        for key in one.per_sample:
            if getattr(one, key) is not None:
                np.testing.assert_array_equal(getattr(one, key), getattr(two, key))


def test_01_missing_or_unreadable(folder):
    """Would catch a traceback for a path that is not there."""
    (folder / "imu.csv").unlink()
    refused(folder, "imu.csv", "no such file")
    os.mkdir(folder / "imu.csv")
    refused(folder, "imu.csv", "a folder")


def test_02_empty_file(folder):
    """Would catch an index error for 0 bytes."""
    (folder / "imu.csv").write_bytes(b"")
    refused(folder, "empty", path="imu.csv")


def test_03_header_only(folder):
    """Would catch arrays without a row."""
    write(folder / "optical.csv", lines_of(folder / "optical.csv")[:1])
    refused(folder, "0 samples", path="optical.csv", line=1)


def test_04_cut_short_or_ragged(folder):
    """Would catch a last line that is lost without a word, and a ragged one that shifts its cells."""
    file = folder / "imu.csv"
    lines = lines_of(file)
    file.write_text("\n".join([*lines[:-1], lines[-1][:25]]))
    masked(folder, "imu", "cut short", 1, len(lines))
    write(file, [*lines[:10], lines[10] + ",1", *lines[11:]])
    refused(folder, "8 cells", line=11, path="imu.csv")


@pytest.mark.parametrize("suffix", [".h5", ".npz"])
def test_05_truncated_binary(folder, suffix):
    """Would catch a library's traceback for half a file."""
    file = jaxekf.save(plain(folder), folder.parent / f"whole{suffix}")
    size = file.stat().st_size
    cut = folder.parent / f"cut{suffix}"
    cut.write_bytes(file.read_bytes()[: size // 2])
    refused(cut, str(size // 2))


def test_06_byte_order_mark(folder):
    """Would catch a first column called '\\ufefftime'."""
    before = plain(folder)
    for name in ("optical.csv", "imu.csv", "recording.toml"):
        file = folder / name
        file.write_bytes(b"\xef\xbb\xbf" + file.read_bytes())
    same(plain(folder), before)
    goes_on(folder)


def test_07_utf16(folder):
    """Would catch an error that does not say what the file is."""
    file = folder / "imu.csv"
    file.write_bytes(file.read_text().encode("utf-16"))
    refused(folder, "UTF-16", path="imu.csv")


def test_08_line_ends(folder):
    """Would catch a carriage return in the last column, and lines counted twice."""
    before = plain(folder)
    lines = lines_of(folder / "imu.csv")
    write(folder / "imu.csv", lines, "\r\n")
    mixed = "".join(line + ("\r\n", "\n", "\r")[i % 3] for i, line in enumerate(lines))
    write(folder / "optical.csv", lines_of(folder / "optical.csv"), "\r\n")
    same(plain(folder), before)
    (folder / "imu.csv").write_bytes(mixed.encode())
    same(plain(folder), before)
    goes_on(folder)


def test_09_semicolons_and_decimal_commas(folder):
    """Would catch 0,5 read as two cells, and a mixture that is guessed at."""
    before = plain(folder)
    file = folder / "imu.csv"
    text = file.read_text()
    file.write_text(text.replace(",", ";").replace(".", ","))
    run = plain(folder)
    same(run, before)
    assert any("decimal commas" in note for note in run.intake["imu"].notes)
    assert "decimal commas" in goes_on(folder).stderr
    head, rest = text.replace(",", ";").split("\n", 1)
    file.write_text(head + "\n" + rest.replace(".", ",", 40))
    refused(folder, "decimal commas beside points", path="imu.csv")


def test_10_trailing_delimiter(folder):
    """Would catch a nameless column that is an error."""
    before = plain(folder)
    lines = lines_of(folder / "imu.csv")
    write(folder / "imu.csv", [line + "," for line in lines])
    same(plain(folder), before)
    write(folder / "imu.csv", [lines[0], *(line + "," for line in lines[1:])])
    same(plain(folder), before)
    goes_on(folder)


def test_11_text_in_a_number(folder):
    """Would catch a cell that becomes NaN."""
    cell(folder / "imu.csv", 6, "ay", "abc")
    refused(folder, "'abc'", line=6, column="ay", path="imu.csv")


@pytest.mark.parametrize(
    ("old", "new"), [("gz", "gy"), (",gz", ",gw"), ("gz,ax", "gz,temperature,ax")]
)
def test_12_columns(folder, old, new):
    """Would catch a column that is taken for another, twice there, or ignored."""
    lines = lines_of(folder / "imu.csv")
    extra = ",0" if "temperature" in new else ""
    head = lines[0].replace(old, new)
    write(folder / "imu.csv", [head, *(line + extra for line in lines[1:])])
    listed = "each once" if new == "gy" else "time,gx,gy,gz[,ax,ay,az]"
    refused(folder, head, listed, line=1, path="imu.csv")


def test_13_types_of_binary_files(folder):
    """Would catch strings and floating times that are cast in silence."""
    file = jaxekf.save(plain(folder), folder.parent / "run.npz")
    with np.load(file) as arrays:
        held = dict(arrays)
    name = next(key for key in held if key.endswith("imu/gyroscope"))
    held.pop("sha256", None)
    for bad in (held[name].astype(str), held[name].astype(object)):
        np.savez(file, **{**held, name: bad})
        refused(file, "gyroscope")
    np.savez(file, **{**held, name: held[name].astype(np.float32)})
    found = jaxekf.load(file).need_imu().gyroscope
    np.testing.assert_array_equal(found, held[name].astype(np.float32).astype(float))
    time = next(key for key in held if key.endswith("imu/time_ns"))
    np.savez(file, **{**held, time: held[time] * 1e-9})
    refused(file, "time_ns")


def test_14_blank_poses(folder):
    """Would catch an occlusion that is read as zeros."""
    text = lines_of(folder / "optical.csv")
    blank = [i for i, line in enumerate(text, 1) if ",,,," in line]
    assert len(blank) > 5
    masked(folder, "optical", "blank", len(blank), blank[0], blank[-1])


def test_15_not_finite_poses(folder):
    """Would catch a NaN that reaches the filter, and a run without any pose."""
    before = plain(folder).intake["optical"].masked["blank"].count
    for line, text in ((5, "nan"), (9, "inf"), (12, "-Infinity")):
        cell(folder / "optical.csv", line, "qx", text)
    masked(folder, "optical", "not finite", 3, 5, 12)
    column(folder / "optical.csv", ["qw", "qx"], lambda v: np.full_like(v, np.nan))
    total = len(lines_of(folder / "optical.csv")) - 1
    refused(folder, f"no usable row among {total}", f"{before} blank", path="optical.csv")


def test_16_not_finite_imu(folder):
    """Would catch a NaN that is integrated, and a long hole that is bridged by invention."""
    for line in (20, 21, 25):
        cell(folder / "imu.csv", line, "gy", "nan")
    run = masked(folder, "imu", "not finite", 3, 20, 25)
    assert np.isfinite(run.need_imu().gyroscope).all()
    time = run.need_imu().time_ns
    lost = np.flatnonzero((time >= time[0] + 10**9) & (time < time[0] + 1_200_000_000)) + 2
    for line in lost + 3:
        cell(folder / "imu.csv", line, "gy", "")
    result = goes_on(folder)
    assert "2 of 2 parts are estimated" in result.stderr
    assert [s["run"] for s in json.loads(result.stdout)["runs"]] == ["run-part1", "run-part2"]


def test_17_zero_quaternion(folder):
    """Would catch a lost tool that is taken for a pose."""
    for line in (7, 8):
        for name in ("qw", "qx", "qy", "qz"):
            cell(folder / "optical.csv", line, name, "0")
    masked(folder, "optical", "missing tool", 2, 7, 8)


@pytest.mark.parametrize("status", [True, False])
def test_18_poses_that_only_look_valid(folder, status):
    """Would catch the identity at the origin, or the last pose over and over, believed for a second."""
    file = folder / "optical.csv"
    lines = lines_of(file)
    rows = range(60, 90)
    if status:
        lines = [line + (",status" if i == 0 else ",OK") for i, line in enumerate(lines)]
    for i in rows:
        time = lines[i].split(",")[0]
        lines[i] = f"{time},1,0,0,0,0,0,0" + (",MISSING" if status else "")
    write(file, lines)
    if status:
        masked(folder, "optical", "status missing", 30, 61, 90)
        return
    masked(folder, "optical", "frozen while the IMU moves", 30, 61, 90)
    (folder / "imu.csv").unlink()
    text = (folder / "recording.toml").read_text()
    (folder / "recording.toml").write_text(re.sub(r"\[imu\]\n(.+\n)+", "", text))
    found = jaxekf.load(folder).intake["optical"].masked
    assert next(v for k, v in found.items() if "suspicious" in k).count == 30


def test_19_norms(folder):
    """Would catch columns that are no quaternion, scaled until they look like one."""
    names = ["qw", "qx", "qy", "qz"]

    def scale(rows, factor):
        def change(values):
            values[rows] *= factor
            return values

        column(folder / "optical.csv", names, change)

    scale([3, 5], 1.05)
    note = plain(folder).intake["optical"].notes
    assert any("2 quaternions are scaled to norm 1, off by up to 0.05" in text for text in note)
    assert "2 quaternions are scaled" in goes_on(folder).stderr
    scale([8], 1.5)
    masked(folder, "optical", "norm off by more than 0.1", 1, 10)
    scale(slice(10, 40), 1.5)
    refused(folder, "a norm of 1.5", line=10, path="optical.csv")


def test_20_signs(folder):
    """Would catch q and -q taken for different attitudes."""
    names = ["qw", "qx", "qy", "qz"]
    one = call("estimate", folder, "-o", folder.parent / "one")
    assert one.exit_code == 0, one.output
    column(
        folder / "optical.csv", names, lambda v: v * np.where(np.arange(len(v)) % 3, 1, -1)[:, None]
    )
    two = call("estimate", folder, "-o", folder.parent / "two")
    assert two.exit_code == 0, two.output
    first, second = (
        np.genfromtxt(folder.parent / name / "run" / "estimate.csv", delimiter=",", skip_header=1)
        for name in ("one", "two")
    )
    np.testing.assert_allclose(np.abs(first), np.abs(second), rtol=0.0, atol=1e-12)
    goes_on(folder)


def test_21_swapped_order(folder):
    """Would catch an estimate from x, y, z, w read as w, x, y, z, and one that is swapped in silence."""
    names = ["qw", "qx", "qy", "qz"]
    before = plain(folder)
    column(folder / "optical.csv", names, lambda v: v[:, [1, 2, 3, 0]])
    refused(folder, "x,y,z,w", "quaternion")
    describe(folder, "optical", 'quaternion = "x,y,z,w, body to reference"')
    same(plain(folder), before)


def test_22_other_units(folder):
    """Would catch a gyroscope in deg/s or a tracker in mm."""
    before = plain(folder)
    column(folder / "imu.csv", ["gx", "gy", "gz"], np.rad2deg)
    refused(folder, "57", "deg/s")
    describe(folder, "imu", 'unit = "deg/s, m/s^2"')
    run = plain(folder)
    np.testing.assert_allclose(run.imu.gyroscope, before.imu.gyroscope, rtol=1e-14)


@pytest.mark.parametrize(
    ("factor", "word"), [(1.0 / 9.81, "rad/s, g"), (0.0, "gravity is removed")]
)
def test_23_accelerations(folder, factor, word):
    """Would catch 1 g taken for 1 m/s^2, and gravity that is not there."""
    column(folder / "imu.csv", ["ax", "ay", "az"], lambda v: factor * v)
    refused(folder, word)


def test_24_times_twice(folder):
    """Would catch the same row counted twice, and two different ones at one time."""
    lines = lines_of(folder / "imu.csv")
    write(folder / "imu.csv", [*lines[:8], lines[7], *lines[8:]])
    masked(folder, "imu", "repeated", 1, 9, kind="dropped")
    other = lines[7].split(",")
    other[1] = "0.5"
    write(folder / "imu.csv", [*lines[:8], ",".join(other), *lines[8:]])
    refused(folder, "twice with other numbers", line=9, column="time", path="imu.csv")


def test_25_time_backwards(folder):
    """Would catch logs put together, and rows sorted without being asked."""
    before = plain(folder)
    lines = lines_of(folder / "imu.csv")
    write(folder / "imu.csv", [lines[0], *lines[201:], *lines[1:201]])
    refused(folder, "times that increase", "--sort", line=len(lines) - 199, column="time")
    run = jaxekf.load(folder, sort=True)
    same(run, before)
    assert "200 rows were out of order" in run.intake["imu"].notes[0]
    assert "200 rows were out of order" in goes_on(folder, "--sort").stderr


@pytest.mark.parametrize(("unit", "factor"), [("ms", 1e3), ("us", 1e6), ("ns", 1e9)])
def test_26_units_of_time(folder, unit, factor):
    """Would catch an estimate over months, and a unit that is stated and not read exactly."""
    before = plain(folder)
    for name in ("imu.csv", "optical.csv", "encoder.csv"):
        lines = lines_of(folder / name)
        for i, line in enumerate(lines[1:], 1):
            time, rest = line.split(",", 1)
            whole, _, part = time.partition(".")
            digits = {"ms": 3, "us": 6, "ns": 9}[unit]
            part = part.ljust(9, "0")
            lines[i] = (
                f"{whole}{part[:digits]}.{part[digits:]}0".rstrip("0").rstrip(".") + f",{rest}"
            )
        write(folder / name, lines)
    shown = "µs" if unit == "us" else unit
    words = [f'time_unit = "{shown}"']
    # 1000 s are beyond 64 bits as nanoseconds that are taken for seconds.
    words += [] if unit == "ns" else ["a sample every", f"in {shown} it would be"]
    refused(folder, *words)
    for section in ("imu", "optical", "encoder"):
        describe(folder, section, f'time_unit = "{unit}"')
    same(plain(folder), before)
    goes_on(folder)


def test_27_no_overlap(folder):
    """Would catch an estimate from streams of two different days."""
    column(folder / "optical.csv", ["time"], lambda v: v + 5000.0)
    refused(folder, "1000.", "6000.", "overlap")


def test_28_clock_offset(folder):
    """Would catch an offset that is not told, or made up where nothing turns."""
    late = plain(folder).optical.time_ns + 40_000_000
    lines = lines_of(folder / "optical.csv")
    rest = [line.split(",", 1)[1] for line in lines[1:]]
    times = [f"{t // 10**9}.{t % 10**9:09d}" for t in late]
    write(folder / "optical.csv", [lines[0], *map(",".join, zip(times, rest, strict=True))])
    result = call("align", folder, "-o", folder.parent / "aligned", "--json")
    assert result.exit_code == 0, result.output
    latency = json.loads(result.stdout)["runs"][0]["tracker"]["latency_s"]
    assert latency == pytest.approx(0.04, abs=2e-3)
    column(
        folder / "imu.csv",
        ["gx", "gy", "gz"],
        lambda v: 1e-5 * v,
    )
    result = call("align", folder, "-o", folder.parent / "other")
    assert result.exit_code == 1
    assert not (folder.parent / "other").exists()


def test_29_gaps(folder):
    """Would catch a gap that is bridged by a held rate, and lost samples that shift time."""
    lines = lines_of(folder / "imu.csv")
    rate = 1e-9 * np.median(np.diff(plain(folder).need_imu().time_ns))
    few = [*lines[:100], *lines[103:]]
    write(folder / "imu.csv", few)
    steps = np.diff(plain(folder).need_imu().time_ns) * 1e-9
    assert steps.max() == pytest.approx(4 * rate, rel=1e-6)
    goes_on(folder)
    lost = int(0.6 / rate)
    write(folder / "imu.csv", [*lines[:300], *lines[300 + lost :]])
    result = goes_on(folder)
    assert "the IMU has gaps" in result.stderr
    runs = json.loads(result.stdout)["runs"]
    assert len(runs) == 2
    assert any("cut at gaps of the IMU" in note for note in runs[0]["notes"])


def test_30_status_and_fit_error(folder):
    """Would catch a pose that is frozen, out of volume or badly fitted and believed."""
    file = folder / "optical.csv"
    lines = lines_of(file)
    shape = [",status,error", *[",0,0.0002"] * (len(lines) - 1)]
    told = {5: 3, 6: 5, 7: 9, 8: 17, 9: 20, 10: 31, 11: 9}
    for line, status in told.items():
        shape[line - 1] = f",{status},0.0002"
    shape[19] = ",0,0.004"
    write(file, [a + b for a, b in zip(lines, shape, strict=True)])
    describe(folder, "optical", "error_max = 0.001")
    masked(folder, "optical", "status 9 (out of volume)", 2, 7, 11)
    masked(folder, "optical", "fit error over 0.001 m", 1, 20)
    found = plain(folder).intake["optical"].masked
    assert sum("status" in name for name in found) == 6
    frozen = lines[70].split(",", 1)[1]
    for i in range(71, 90):
        lines[i] = f"{lines[i].split(',')[0]},{frozen}"
    write(file, [a + b for a, b in zip(lines, shape, strict=True)])
    masked(folder, "optical", "frozen while the IMU moves", 19, 72, 90)


def test_an_export_is_described_not_rewritten(folder):
    """Would catch the manual's own example not working: columns, degrees, g, ms, mm, no header."""
    before = plain(folder)
    rows = ["Logger 7", "calibrated", "Frame;Acc X;Acc Y;Acc Z;Rot Z;Rot Y;Rot X;Stamp"]
    imu, optical = before.need_imu(), before.need_optical()
    for i, (t, w, a) in enumerate(zip(imu.time_ns, imu.gyroscope, imu.accelerometer, strict=True)):
        numbers = [*(a / STANDARD_GRAVITY), *np.rad2deg(w[::-1])]
        rows.append(";".join([str(i), *(f"{v:.12g}" for v in numbers), f"{t / 1e6:.6f}"]))
    write(folder / "export.csv", rows)
    rows = []
    for i, t in enumerate(optical.time_ns):
        pose = [*(1e3 * optical.position[i]), *np.roll(optical.q_ref_body[i], -1)]
        cells = [f"{v:.12g}" if optical.valid[i] else "" for v in pose]
        rows.append(",".join([f"{t / 1e9:.9f}", str(i), *cells, "OK", "0.2"]))
    write(folder / "tracker.csv", rows)
    for name in ("imu.csv", "optical.csv"):
        (folder / name).unlink()
    text = (folder / "recording.toml").read_text()
    text = re.sub(r"\[(imu|optical)\]\n(?:(?!\[).*\n)*", "", text)
    page = (ROOT / "docs" / "recordings.md").read_text("utf-8")
    told = page[page.index("schema_version = 1\n\n[imu]") :].split("```")[0]
    (folder / "recording.toml").write_text(f"{text}\n{told.split('schema_version = 1')[1]}")
    run = plain(folder)
    np.testing.assert_array_equal(run.imu.time_ns, imu.time_ns)
    np.testing.assert_allclose(run.imu.gyroscope, imu.gyroscope, atol=1e-10)
    np.testing.assert_allclose(run.imu.accelerometer, imu.accelerometer, atol=1e-9)
    np.testing.assert_array_equal(run.optical.valid, optical.valid)
    seen = optical.valid
    np.testing.assert_allclose(run.optical.position[seen], optical.position[seen], atol=1e-10)
    np.testing.assert_allclose(run.optical.q_ref_body[seen], optical.q_ref_body[seen], atol=1e-11)
    result = call("estimate", folder, "-o", folder.parent / "own")
    assert result.exit_code == 0, result.output


def test_a_lost_tool_at_rest(folder):
    """Would catch the origin, or the last pose, believed because the gyroscope is quiet meanwhile."""
    column(folder / "imu.csv", ["gx", "gy", "gz"], lambda v: 1e-5 * v)
    lines = lines_of(folder / "optical.csv")
    rng = np.random.default_rng(0)
    q = np.roll(
        Rotation.from_rotvec([0.5, 0.3, 0.1] + 1e-3 * rng.normal(size=(len(lines), 3))).as_quat(),
        1,
        axis=1,
    )
    for i in range(1, len(lines)):
        pose = (
            "1,0,0,0,0,0,0"
            if 60 <= i < 90
            else ",".join(f"{v:.9g}" for v in [*q[i], 0.1, 0.2, 0.3])
        )
        lines[i] = f"{lines[i].split(',')[0]},{pose}"
    write(folder / "optical.csv", lines)
    found = plain(folder).intake["optical"].masked
    assert found["suspicious (identity at the origin, repeated)"].count == 30
    # An export of four decimals repeats itself while the tool rests, and is believed.
    for i in range(1, len(lines)):
        time = lines[i].split(",")[0]
        lines[i] = f"{time},{','.join(f'{v:.4f}' for v in q[1])},0.1000,0.2000,0.3000"
    write(folder / "optical.csv", lines)
    assert not plain(folder).intake["optical"].masked


def test_a_slow_freeze(folder):
    """Would catch a pose frozen for seconds while the tool turns slowly: 2 deg/s are 20 deg in ten."""
    imu = plain(folder).need_imu()
    slow = np.deg2rad([2.0, 0.0, 0.0])
    column(folder / "imu.csv", ["gx", "gy", "gz"], lambda v: np.broadcast_to(slow, v.shape))
    lines = lines_of(folder / "optical.csv")
    start = 1e-9 * imu.time_ns[0]
    for i in range(1, len(lines)):
        time = lines[i].split(",")[0]
        turned = Rotation.from_rotvec((min(float(time) - start, 1.0)) * slow).as_quat()
        pose = [*np.roll(turned, 1), 0.1, 0.2, 0.3]
        lines[i] = ",".join([time, *(f"{v:.17g}" for v in pose), "OK"])
    write(folder / "optical.csv", [lines[0] + ",status", *lines[1:]])
    found = plain(folder).intake["optical"].masked["frozen while the IMU moves"]
    assert found.count > 40


@pytest.mark.parametrize("ending", ["-", "1.5e-", "0.", "+"])
def test_a_last_line_that_ends_within_a_number(folder, ending):
    """Would catch half a number read as one, or refused as text."""
    lines = lines_of(folder / "imu.csv")
    cells = lines[-1].split(",")
    (folder / "imu.csv").write_text("\n".join([*lines[:-1], ",".join([*cells[:-1], ending])]))
    run = plain(folder)
    if ending != "0.":
        assert run.intake["imu"].masked["cut short"].numbers.tolist() == [len(lines)]


@pytest.mark.parametrize(
    ("section", "entry", "words"),
    [
        ("optical", "latencey = 0.01", ["optical.latencey", "optical.latency"]),
        ("imu", 'time_units = "ms"', ["imu.time_units", "imu.time_unit"]),
        ("imu", "latency = 0.0\n[optcal]", ["optcal", "optical"]),
        ("imu", "skip_lines = 0\n[sha256]\n'imu.cvs' = 'aa'", ["imu.cvs", "not there"]),
        ("optical", "latency = 1e300", ["3600 at most"]),
    ],
)
def test_entries_that_would_be_ignored(folder, section, entry, words):
    """Would catch a misspelt entry that changes nothing and says nothing."""
    file = folder / "recording.toml"
    head, tail = file.read_text().split(f"[{section}]\n")
    own, *others = tail.split("\n[", 1)
    file.write_text("\n[".join([f"{head}[{section}]\n{own.rstrip()}\n{entry}\n", *others]))
    refused(folder, *words)


def test_a_status_decides_between_rows_of_one_time(folder):
    """Would catch a row that is called missing dropped as a repeat of one that is OK."""
    lines = [
        line + (",status" if i == 0 else ",OK")
        for i, line in enumerate(lines_of(folder / "optical.csv"))
    ]
    write(folder / "optical.csv", [*lines[:6], lines[5].replace(",OK", ",Missing"), *lines[6:]])
    refused(folder, "twice with other numbers", line=7)
