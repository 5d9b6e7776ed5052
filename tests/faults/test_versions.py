"""Every format says of which version it is, and no reader takes another version for its own."""

import json
from pathlib import Path

import h5py
import numpy as np
import pytest
from click.testing import CliRunner
from endless import estimate

import jaxekf
from jaxekf.cli import main
from jaxekf.estimation import parameters
from jaxekf.models.loose import MODEL
from jaxekf.reporting.report._saved import read_result
from jaxekf.reporting.report._tuned import read_tuning
from tuning.persistence import checkpoint


@pytest.fixture(scope="module")
def result(tmp_path_factory):
    folder = tmp_path_factory.mktemp("versions") / "result"
    return estimate(3).save(folder, exports=["npz", "hdf5", "tum"])


def text_of(version):
    return "" if version is None else f"schema_version = {version}\n"


@pytest.mark.parametrize("version", [None, 0, 2])
def test_text_files_of_another_version(result, tmp_path, version):
    """Would catch a file of an older or newer version that is read as if it were of this one."""

    def refused(read, *arguments):
        with pytest.raises(jaxekf.RecordingError, match=f"schema_version {version}, expected 1"):
            read(*arguments)

    (tmp_path / "recording.toml").write_text(text_of(version) + 'name = "a"\n')
    refused(jaxekf.load, tmp_path)
    for name in ("noise.toml", "calibration.toml"):
        text = (result / name).read_text().replace("schema_version = 1\n", text_of(version))
        (tmp_path / name).write_text(text)
        refused(parameters.load, MODEL, tmp_path / name)
    said = {} if version is None else {"schema_version": version}
    (tmp_path / "tuning.json").write_text(json.dumps(said))
    refused(read_tuning, tmp_path)
    (tmp_path / "result.json").write_text(json.dumps(said))
    refused(read_result, tmp_path)


@pytest.mark.parametrize("version", [None, 0, 2])
@pytest.mark.parametrize(
    "name",
    ["estimate.npz", "estimate.h5", "covariance.npz", "innovations.npz", "noise.toml"],
)
def test_parts_of_a_result_of_another_version(result, tmp_path, name, version):
    """Would catch an export, or one file of a result folder, of another version taken for this one's."""
    folder = tmp_path / "result"
    folder.mkdir()
    for file in result.iterdir():
        (folder / file.name).write_bytes(file.read_bytes())
    file = folder / name
    if name == "estimate.h5":
        with h5py.File(file, "a") as opened:
            del opened.attrs["schema_version"]
            if version is not None:
                opened.attrs["schema_version"] = version
    elif name == "noise.toml":
        text = file.read_text().replace("schema_version = 1\n", text_of(version))
        file.write_text(text)
    else:
        with np.load(file) as opened:
            arrays = {k: opened[k] for k in opened.files if k != "schema_version"}
        np.savez(file, **arrays | ({} if version is None else {"schema_version": version}))
    read = jaxekf.read_export if name.startswith("estimate") else read_result
    with pytest.raises(jaxekf.RecordingError, match=f"schema_version.*{version}"):
        read(file if read is jaxekf.read_export else folder)


def test_a_kept_tuning_of_another_version(tmp_path):
    """Would catch the state of a search that an older version wrote and this one goes on from."""
    np.savez(tmp_path / "state", kind="jaxekf tuning, version 2", mark="m")
    with pytest.raises(jaxekf.TuningError, match="another tuning"):
        checkpoint.read(tmp_path / "state.npz", "m")


def test_what_is_printed_and_written_for_others(tmp_path):
    """Would catch JSON without a version, on standard output or in a file that nobody here reads."""

    def call(*arguments):
        done = CliRunner().invoke(main, [*map(str, arguments), "--json"])
        assert done.exit_code == 0, done.output
        return json.loads(done.stdout)

    options = ["--duration", 15, "--rest", 4, "-o", tmp_path / "runs"]
    made = call("simulate", *options)
    run = Path(made["runs"][0])
    aligned = call("align", run, "-o", tmp_path / "aligned")
    found = call("allan", run, "-o", tmp_path / "static")
    written = json.loads((tmp_path / "aligned" / "align.json").read_text())
    assert [d["schema_version"] for d in (made, aligned, found, written)] == [1, 1, 1, 1]
    inputs = written["provenance"]["inputs"][run.name]
    assert set(inputs) == {"recording.toml", "optical.csv", "imu.csv", "encoder.csv"}
    assert written["provenance"]["versions"]["jaxekf"] == jaxekf.__version__
    noise = (tmp_path / "static" / "noise.toml").read_text()
    assert inputs["imu.csv"] in noise
