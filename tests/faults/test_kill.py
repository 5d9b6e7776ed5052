"""Writers killed at random moments: whatever stands under a final name is whole."""

import json
import os
import subprocess
import sys
import tomllib
from pathlib import Path

import numpy as np
import pytest

import jaxekf
from jaxekf._support.errors import RecordingError
from jaxekf.io import _temporary as temporary
from jaxekf.models.loose import MODEL
from jaxekf.reporting.report._saved import read_result

LONG = os.environ.get("JAXEKF_LONG") == "1"
ROOT = Path(__file__).parents[2]
COUNT = 400
FOLDERS, FILES = ("run", "result"), ("one.npz", "one.h5", "one.tum", "one.csv", "report.html")

pytestmark = pytest.mark.skipif(not hasattr(os, "fork"), reason="kills and forks are POSIX's")


@pytest.fixture
def writers(tmp_path):
    """A process that writes into a folder and is killed as often as it is asked."""
    command = [sys.executable, str(Path(__file__).with_name("endless.py")), str(tmp_path)]
    paths = os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")])
    process = subprocess.Popen(
        command,
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
        env=os.environ | {"PYTHONPATH": paths, "JAX_ENABLE_X64": "1"},
    )
    with process:
        yield process
        process.stdin.close()


def check_exports(folder):
    """Files of one name each: every number in them says which writing they are of."""
    for name in ("one.npz", "one.h5"):
        read = jaxekf.read_export(folder / name)
        assert read["time_ns"].shape == (COUNT,)
        assert (read["state/bias"] == read["log_likelihood"]).all(), name
        assert read["covariance"][0, 0, 0] == read["log_likelihood"] + 1.0, name
    lines = (folder / "one.tum").read_text().splitlines()
    assert len([line for line in lines if not line.startswith("#")]) == COUNT
    assert (folder / "one.tum").read_text().endswith("\n")
    assert len((folder / "one.csv").read_text().splitlines()) == COUNT + 1
    assert (folder / "report.html").read_text("utf-8").rstrip().endswith("</html>")


def check_result(folder):
    """A result folder: all its files are of one writing."""
    read = read_result(folder)
    number = read.document.log_likelihood
    assert len(read.time_ns) == COUNT
    assert (read.columns["bias_x"] == number).all()
    assert (read.cov[:, 0, 0] == number + 1.0).all()
    assert (read.sensors["optical"].nis == number).all()
    for name in ("estimate.npz", "estimate.h5"):
        assert jaxekf.read_export(folder / name)["log_likelihood"] == number


def check_tuned(folder):
    """Parameters replaced one file after the other: of one tuning, or refused."""
    noise, turn = (
        tomllib.loads((folder / f).read_text()) for f in ("noise.toml", "calibration.toml")
    )
    if noise["origin"] != turn["origin"]:
        with pytest.raises(RecordingError, match="of the tunings"):
            jaxekf.load_parameters(MODEL, folder)
        return False
    read = jaxekf.load_parameters(MODEL, folder)
    number = float(read.noise.optical) - 1.0
    np.testing.assert_allclose(read.calibration.alignment, 1e-6 * number)
    return True


@pytest.mark.long
def test_a_kill_leaves_nothing_half_written(writers, tmp_path):
    """Would catch a folder removed before its successor is in place, a file written under its final name,
    files of two writings taken for one, and leftovers that pile up."""
    seconds = json.loads(writers.stdout.readline())["seconds"]
    rng = np.random.default_rng(7)
    none = torn = left = 0
    for _ in range(50 if LONG else 5):
        writers.stdin.write(f"{rng.uniform(0.02, 2.0 * seconds + 0.05)}\n")
        writers.stdin.flush()
        assert json.loads(writers.stdout.readline()) == {}
        for name in FOLDERS:
            if not (tmp_path / name).exists():
                # Between two renames: the older one stands beside it, whole.
                none += 1
                temporary.sweep(tmp_path / name)
        run = jaxekf.load(tmp_path / "run")
        assert "number" in run.info
        assert len(run.need_imu().time_ns) == COUNT
        check_result(tmp_path / "result")
        check_exports(tmp_path)
        jaxekf.load_parameters(MODEL, tmp_path / "params")
        torn += not check_tuned(tmp_path / "tuned")
        hidden = [p.name for p in tmp_path.rglob(".*")]
        left += len(hidden)
        # Each life clears what the one before left, as far as it comes to write the same again.
        assert len(hidden) < 12, hidden
    print(f"none under the name {none}, of two tunings {torn}, leftovers seen {left}")
    for name in (*FOLDERS, *FILES, "tuned", "params/noise.toml", "params/calibration.toml"):
        temporary.sweep(tmp_path / name)
    temporary.sweep(tmp_path / "tuned", tmp_path / "tuned")
    assert not list(tmp_path.rglob(".*"))
