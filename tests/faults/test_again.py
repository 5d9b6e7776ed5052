"""A result says what it was made of, and the same again gives the same bytes."""

import datetime
import hashlib
import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner
from endless import estimate as stand_in
from endless import write

import jaxekf
from jaxekf.cli import main
from jaxekf.io.hashes import hashed, inputs
from jaxekf.recordings.types import Imu, Recording

LONG = os.environ.get("JAXEKF_LONG") == "1"
ROOT = Path(__file__).parents[2]
ONE_THREAD = "--xla_cpu_multi_thread_eigen=false intra_op_parallelism_threads=1"
SCRIPT = """
import sys
from jaxekf.cli import main
for line in sys.stdin.read().splitlines():
    main(line.split("|"), standalone_mode=False)
"""


def bytes_of(folder):
    return {p.relative_to(folder).as_posix(): p.read_bytes() for p in folder.rglob("*.*")}


def in_a_process(arguments, given, folder):
    """What a process on one thread writes into a folder, which is then taken away."""
    paths = os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")])
    environment = os.environ | {
        "PYTHONPATH": paths,
        "XLA_FLAGS": ONE_THREAD,
        "JAX_ENABLE_X64": "1",
        # Another order of sets each time.
        "PYTHONHASHSEED": "random",
    }
    command = [sys.executable, *map(str, arguments)]
    subprocess.run(
        command, input=given, stdout=subprocess.DEVNULL, text=True, env=environment, check=True
    )
    found = bytes_of(folder)
    shutil.rmtree(folder)
    return found


def same(first, second):
    """The files of two processes, which must be equal."""
    assert first.keys() == second.keys()
    assert [name for name in first if first[name] != second[name]] == []
    return first


def test_the_same_written_again_is_the_same_bytes(tmp_path):
    """Would catch clocks, random names and the order of sets in a file of any format."""
    out = tmp_path / "out"
    out.mkdir()
    write(out, 0)
    here = bytes_of(out)
    shutil.rmtree(out)
    writer = Path(__file__).with_name("endless.py")
    found = same(here, in_a_process([writer, out], "", out))
    exports = {f"result/{name}" for name in ("estimate.h5", "estimate.npz", "trajectory.tum")}
    folders = {"result/result.json", "run/imu.csv", "params/noise.toml", "tuned/calibration.toml"}
    assert exports | folders | {"report.html"} <= set(found)


@pytest.mark.long
@pytest.mark.skipif(not LONG, reason="long form: set JAXEKF_LONG=1")
def test_the_same_made_again_is_the_same_bytes(tmp_path):
    """Would catch an estimate, tuning or figure whose last bits are left to chance."""
    made = CliRunner().invoke(
        main, ["simulate", "--duration", "2", "--rest", "0.5", "-o", str(tmp_path / "runs")]
    )
    assert made.exit_code == 0, made.output
    run, out = tmp_path / "runs" / "free-0", tmp_path / "out"
    exports = [part for form in ("npz", "hdf5", "tum") for part in ("--export", form)]
    tune = ("tune", run, "--iterations", 3, "--objective", "map", "-o", out / "tuned")
    commands = [
        ("estimate", run, "-o", out / "result", *exports),
        tune,
        ("report", out / "result" / "free-0", out / "tuned", "-o", out / "report.html"),
        ("plot", run, "-o", out / "figures"),
    ]
    lines = "\n".join("|".join(map(str, command)) for command in commands)
    found = same(*(in_a_process(["-c", SCRIPT], lines, out) for _ in range(2)))
    # The date of a tuning stands in one known entry, nowhere else.
    today = datetime.date.today().isoformat().encode()
    dated = {name: found[name].count(today) for name in found if today in found[name]}
    assert set(dated) <= {
        "tuned/noise.toml",
        "tuned/calibration.toml",
        "tuned/tuning.json",
        "report.html",
    }
    assert dated["tuned/noise.toml"] == dated["tuned/tuning.json"] == 1


def test_what_a_result_was_made_of_is_in_every_format(tmp_path):
    """Would catch a result whose inputs, versions, precision, parameters or account nobody can tell."""
    imu = Imu(np.arange(5) * 10**7, np.ones((5, 3)))
    read = jaxekf.load(jaxekf.save(Recording("a", imu=imu), tmp_path / "a"))
    digest = hashlib.sha256((tmp_path / "a" / "imu.csv").read_bytes()).hexdigest()
    assert inputs(read)["imu.csv"] == digest
    assert set(inputs(read)) == {"recording.toml", "imu.csv"}
    made = stand_in(2)
    made.provenance["inputs"] = inputs(read)
    folder = made.save(tmp_path / "result", exports=["npz", "hdf5", "tum"])
    told = json.loads((folder / "result.json").read_text())
    assert told["provenance"]["inputs"]["imu.csv"] == digest
    assert told["provenance"]["dtype"] == "float64"
    assert told["account"] == made.account
    noise = told["parameters"]["noise"]["optical"]
    assert noise == {"value": float(made.params.noise.optical), "unit": "rad"}
    assert np.shape(told["parameters"]["calibration"]["gyroscope_matrix"]["value"]) == (3, 3)
    for name in ("estimate.npz", "estimate.h5"):
        found = jaxekf.read_export(folder / name)
        assert found["provenance/inputs/imu.csv"] == digest
        assert found["provenance/dtype"] == "float64"
        assert found["account/optical/used"] == made.account["optical"]["used"]
    head = [
        s[2:].split(" ", 1)
        for s in (folder / "trajectory.tum").read_text().split("\n")
        if s[:1] == "#"
    ]
    said = dict(head)
    assert json.loads(said["provenance"]) == told["provenance"]
    assert json.loads(said["parameters"]) == told["parameters"]
    assert json.loads(said["account"]) == told["account"]


def test_which_files_are_hashed(tmp_path):
    """Would catch camera images that are hashed for hours, a stranger's file in a run, and a file that is
    gone taken for a fault."""
    for name in ("cam0/1.png", "imu0/data.csv", "imu0/sensor.yaml"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text(name)
    assert list(hashed(tmp_path)) == ["imu0/data.csv", "imu0/sensor.yaml"]
    assert list(hashed(tmp_path / "cam0" / "1.png")) == ["1.png"]
    assert hashed(tmp_path / "gone.csv") == {}
    imu = Imu(np.arange(5) * 10**7, np.ones((5, 3)))
    assert inputs(Recording("a", imu=imu, path=tmp_path, sources={"a.bag": "00"})) == {
        "a.bag": "00"
    }
    assert inputs(Recording("a", imu=imu)) == {}
