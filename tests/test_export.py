"""Exports of an estimate: nothing lost, readable by others, and whole or not there."""

import re
from dataclasses import replace
from decimal import Decimal

import h5py
import numpy as np
import pytest
from click.testing import CliRunner
from hypothesis import given
from hypothesis import strategies as st

import jaxekf
from jaxekf.cli import main
from jaxekf.estimation.result import OutputEstimate
from jaxekf.io import atomic, csv_table, export
from jaxekf.recordings import truth
from jaxekf.simulation import demo

RUN = demo.FOLDER / "free-5"
QUARTER = [np.sqrt(0.5), 0.0, 0.0, np.sqrt(0.5)]


@pytest.fixture(scope="module")
def made():
    """An estimate at times that no float holds, with one number that is not finite."""
    estimate = jaxekf.estimate(RUN)
    value = np.array(estimate.rate.value)
    value[7, 1] = np.nan
    return replace(
        estimate,
        time_ns=estimate.time_ns + 1,
        outputs=estimate.outputs | {"rate": replace(estimate.rate, value=value)},
        notes=("one, of 12.5 µs",),
    )


def turned(made, q):
    """The estimate with the same attitude at every instant."""
    value = np.tile(np.asarray(q, float), (len(made.time_ns), 1))
    return replace(made, outputs=made.outputs | {"attitude": replace(made.attitude, value=value)})


def read_tum(path):
    """Comments, times in ns and numbers (N, 7) of a file in the TUM format, by its definition alone."""
    lines = path.read_text("utf-8").splitlines()
    head = [line for line in lines if line.startswith("#")]
    assert lines[: len(head)] == head
    cells = [line.split(" ") for line in lines[len(head) :]]
    assert {len(row) for row in cells} <= {8}
    stamps = [Decimal(row[0]) * 10**9 for row in cells]
    assert all(stamp == int(stamp) for stamp in stamps)
    return head, [int(stamp) for stamp in stamps], np.array([row[1:] for row in cells], float)


def same(found, expected):
    expected = np.asarray(expected)
    assert (found.dtype, found.shape) == (expected.dtype, expected.shape)
    assert found.tobytes() == expected.tobytes()


@pytest.mark.parametrize("suffix", [".npz", ".h5", ".hdf5"])
def test_everything_comes_back_to_the_last_bit(made, tmp_path, suffix):
    """Would catch times through a float, rounded numbers, a lost NaN, and anything left out."""
    file = made.export(tmp_path / f"run{suffix}")
    read = jaxekf.read_export(file)
    assert int(float(made.time_ns[0])) != made.time_ns[0]
    same(read["time_ns"], made.time_ns)
    same(read["state/q_ref_body"], made.state.q_ref_body)
    same(read["state/bias"], made.state.bias)
    same(read["covariance"], made.cov)
    assert read["covariance@labels"] == list(made.error_labels)
    assert read["covariance@units"] == ["rad"] * 3 + ["rad/s"] * 3
    for name, output in made.outputs.items():
        same(read[f"outputs/{name}/value"], output.value)
        same(read[f"outputs/{name}/covariance"], output.cov)
    assert np.isnan(read["outputs/rate/value"][7, 1])
    assert read["outputs/attitude/value@frame"] == "body to reference"
    assert read["outputs/attitude/value@labels"] == ["w", "x", "y", "z"]
    assert read["outputs/rate/covariance@unit"] == "(rad/s)^2"
    assert read["outputs/rate/covariance@frame"] == "body"
    record = made.sensors["optical"]
    for name in ("time_ns", "residual", "used", "gated", "nis"):
        same(read[f"sensors/optical/{name}"], getattr(record, name))
    same(read["sensors/optical/covariance"], record.cov)
    assert read["sensors/optical/residual@units"] == ["rad"] * 3
    assert read["parameters/noise/optical"] == float(made.params.noise.optical)
    assert read["parameters/noise/optical@unit"] == "rad"
    same(read["parameters/calibration/gyroscope_matrix"], made.params.calibration.gyroscope_matrix)
    assert {k: read[f"account/optical/{k}"] for k in made.account["optical"]} == made.account[
        "optical"
    ]
    assert read["notes"] == list(made.notes)
    assert read["provenance/versions/jax"] == made.provenance["versions"]["jax"]
    facts = ("schema_version", "run", "model", "smoothed", "log_likelihood")
    expected = [1, "free-5", "loose", False, made.log_likelihood]
    assert [read[name] for name in facts] == expected


def test_both_formats_hold_the_same(made, tmp_path):
    """Would catch an entry or a note that only one of the formats has."""
    bare = replace(made, notes=(), provenance={"settings": {"seed": None, "list": [1, 2]}})
    npz, hdf5 = (jaxekf.read_export(bare.export(tmp_path / name)) for name in ("a.npz", "a.h5"))
    assert npz.keys() == hdf5.keys()
    for name, value in npz.items():
        assert type(value) is type(hdf5[name]), name
        assert np.array_equal(value, hdf5[name], equal_nan=isinstance(value, np.ndarray)), name
    assert (npz["notes"], npz["provenance/settings/seed"]) == ([], "null")


def test_hdf5_is_plain_to_other_readers(made, tmp_path):
    """Would catch attributes that are not where units belong, and arrays that are not compressed."""
    with h5py.File(made.export(tmp_path / "run.h5")) as file:
        assert set(file) == {
            *("time_ns", "state", "covariance", "outputs", "sensors"),
            *("parameters", "account", "notes", "provenance"),
        }
        assert file.attrs["model"] == "loose"
        bias = file["state/bias"]
        assert (bias.attrs["unit"], bias.attrs["frame"]) == ("rad/s", "body")
        assert (bias.compression, file["covariance"].compression) == ("gzip", "gzip")
        assert file["time_ns"].dtype == np.int64


def test_csv_is_that_of_the_result_folder(made, tmp_path):
    """Would catch two kinds of estimate.csv."""
    folder = made.save(tmp_path / "result")
    file = made.export(tmp_path / "one.csv")
    assert file.read_bytes() == (folder / "estimate.csv").read_bytes()


def test_tum_is_exact(made, tmp_path):
    """Would catch times from the run's start or through a float, digits lost, or the scalar first."""
    head, times, numbers = read_tum(made.export(tmp_path / "run.tum"))
    assert times == made.time_ns.tolist()
    same(numbers[:, 3:], made.attitude.value[:, [1, 2, 3, 0]])
    assert not numbers[:, :3].any()
    assert any("zero" in line for line in head)
    assert re.fullmatch(
        r"\d{10}\.\d{9} 0 0 0 .*", (tmp_path / "run.tum").read_text().splitlines()[len(head)]
    )


def test_tum_rotates_body_to_reference(made, tmp_path):
    """Would catch the inverse rotation: the body is turned by +90 degrees about z."""
    file = turned(made, QUARTER).export(tmp_path / "run.tum")
    *vector, w = read_tum(file)[2][0, 3:]
    forward = np.array([1.0, 0.0, 0.0])
    seen = forward + 2.0 * np.cross(vector, np.cross(vector, forward) + w * forward)
    np.testing.assert_allclose(seen, [0.0, 1.0, 0.0], atol=1e-15)


def test_tum_has_the_position_and_leaves_out_what_is_not_finite(made, tmp_path):
    """Would catch a position that is dropped, and nan in a file whose readers take every line as a pose."""
    place = np.random.default_rng(0).normal(size=(len(made.time_ns), 3)) / 3.0
    place[[0, 5], 1] = np.nan
    held = OutputEstimate(place, np.zeros((len(place), 3, 3)), "reference", "m")
    moved = replace(made, run="two\nlines", outputs=made.outputs | {"position": held})
    head, times, numbers = read_tum(moved.export(tmp_path / "run.tum"))
    known = np.isfinite(place).all(axis=1)
    assert times == made.time_ns[known].tolist()
    same(numbers[:, :3], place[known])
    assert any(f"left out: 2 of {len(place)}" in line for line in head)
    assert not any("zero" in line for line in head)


@given(st.integers(-(2**63), 2**63 - 1))
def test_times_have_nine_decimals_and_are_exact(time_ns):
    """Would catch a time that passes through a float, or loses its sign below one second."""
    text = csv_table.format_seconds(time_ns, decimals=9)
    assert re.fullmatch(r"-?\d+\.\d{9}", text)
    assert Decimal(text) == Decimal(time_ns).scaleb(-9)
    assert csv_table.parse_seconds(text) == csv_table.parse_seconds(
        csv_table.format_seconds(time_ns)
    )


def test_evo_reads_the_trajectory_and_finds_the_same_error(tmp_path):
    """Would catch a file that evo refuses, or reads as another rotation than it was."""
    pytest.importorskip("evo")
    from evo.core import metrics
    from evo.tools.file_interface import read_tum_trajectory_file

    run = jaxekf.load(RUN)
    estimate = jaxekf.estimate(run)
    true = truth.encoder_at(run.need_encoder(), estimate.time_ns)
    estimate.export(tmp_path / "estimate.tum")
    export.write_tum(tmp_path / "truth.tum", estimate.time_ns, true.q_ref_body)
    found, known = (
        read_tum_trajectory_file(str(tmp_path / f"{name}.tum")) for name in ("estimate", "truth")
    )
    assert found.check()[0], found.check()[1]
    for path in (found, known):
        path.reduce_to_ids(np.flatnonzero(true.scored))
    error = metrics.APE(metrics.PoseRelation.rotation_angle_deg)
    error.process_data((known, found))
    theirs = error.get_statistic(metrics.StatisticsType.rmse)
    assert theirs == pytest.approx(jaxekf.score(estimate, run).attitude_rmse_deg, rel=1e-9)


def test_a_suffix_that_is_none(made, tmp_path):
    """Would catch a format guessed, or an error that does not name those there are."""
    with pytest.raises(jaxekf.RecordingError, match=r"'\.mat'.*\.csv, \.npz, \.h5.*\.hdf5.*\.tum"):
        made.export(tmp_path / "run.mat")
    with pytest.raises(jaxekf.RecordingError, match="npz, hdf5, tum"):
        made.save(tmp_path / "result", exports=["mat"])
    bare = replace(made, outputs={"rate": made.rate})
    with pytest.raises(jaxekf.ModelError, match="attitude"):
        bare.export(tmp_path / "run.tum")
    assert not list(tmp_path.iterdir())


def test_a_file_is_replaced_only_when_asked(made, tmp_path):
    """Would catch an export over a user's file, or over a folder."""
    file = tmp_path / "run.tum"
    file.write_text("mine")
    with pytest.raises(jaxekf.RecordingError, match="overwrite"):
        made.export(file)
    assert file.read_text() == "mine"
    made.export(file, overwrite=True)
    assert len(read_tum(file)[1]) == len(made.time_ns)
    (tmp_path / "folder.h5").mkdir()
    with pytest.raises(jaxekf.RecordingError, match="folder"):
        made.export(tmp_path / "folder.h5", overwrite=True)


def test_nothing_is_left_half_written(made, tmp_path, monkeypatch):
    """Would catch half a file, a temporary one left behind, or an older one lost, when a writer breaks."""
    old = tmp_path / "run.h5"
    old.write_bytes(b"older")
    create = h5py.Group.create_dataset

    def breaks(group, name, *arguments, **options):
        if name == "covariance":
            raise OSError("disk full")
        return create(group, name, *arguments, **options)

    monkeypatch.setattr(h5py.Group, "create_dataset", breaks)
    with pytest.raises(OSError, match="disk full"):
        made.export(old, overwrite=True)
    assert old.read_bytes() == b"older"
    with pytest.raises(OSError, match="disk full"):
        made.save(tmp_path / "result", exports=["tum", "hdf5"])
    with pytest.raises(KeyError), atomic.whole_file(tmp_path / "new.txt") as file:
        file.write_text("half")
        raise KeyError
    assert list(tmp_path.iterdir()) == [old]


def test_what_is_no_export_is_said(made, tmp_path):
    """Would catch a traceback from zip or HDF5, or another program's file taken for ours."""
    for name in ("broken.npz", "broken.h5"):
        (tmp_path / name).write_bytes(b"PK\x03\x04 but no archive")
        with pytest.raises(jaxekf.RecordingError, match="exporting again"):
            jaxekf.read_export(tmp_path / name)
    np.savez(tmp_path / "other.npz", time_ns=made.time_ns)
    with pytest.raises(jaxekf.RecordingError, match="schema_version"):
        jaxekf.read_export(tmp_path / "other.npz")
    with pytest.raises(jaxekf.RecordingError, match="no such file"):
        jaxekf.read_export(tmp_path / "nowhere.h5")
    with pytest.raises(jaxekf.RecordingError, match="NPZ or HDF5"):
        jaxekf.read_export(made.export(tmp_path / "run.tum"))


def test_the_command_line_adds_exports(tmp_path):
    """Would catch --export that writes nothing, takes one only, or writes another estimate."""
    arguments = ["estimate", str(RUN), "-o", str(tmp_path)]
    asked = ["--export", "tum", "--export", "hdf5", "--export", "npz"]
    done = CliRunner().invoke(main, [*arguments, *asked])
    assert done.exit_code == 0, done.output
    folder = tmp_path / "free-5"
    assert {"estimate.csv", "trajectory.tum", "estimate.h5", "estimate.npz", "result.json"} <= {
        file.name for file in folder.iterdir()
    }
    with np.load(folder / "covariance.npz") as arrays:
        cov = dict(arrays)
    for name in ("estimate.h5", "estimate.npz"):
        same(jaxekf.read_export(folder / name)["covariance"], cov["cov"])
    assert read_tum(folder / "trajectory.tum")[1] == cov["time_ns"].tolist()
    again = CliRunner().invoke(main, [*arguments, "--overwrite"])
    assert again.exit_code == 0, again.output
    assert not (folder / "trajectory.tum").exists()
    refused = CliRunner().invoke(main, [*arguments, "--export", "csv"])
    assert refused.exit_code == 2
