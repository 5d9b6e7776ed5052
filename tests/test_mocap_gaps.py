"""The example that hides stretches of real motion capture."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

EXAMPLE = Path(__file__).parents[1] / "examples" / "mocap_gaps.py"


@pytest.mark.long
def test_one_room(data_dir):
    """Poses that drift while they are hidden, or real outliers that lead the filter astray; the whole is
    ``python examples/mocap_gaps.py DIR --rooms 1 3 4 --hide 0.5 1 2``."""
    command = [sys.executable, str(EXAMPLE), str(data_dir / "tumvi"), "--rooms", "4", "--hide"]
    done = subprocess.run([*command, "0.5", "1"], capture_output=True, text=True, timeout=900)
    assert done.returncode == 0, done.stdout + done.stderr
    found = json.loads(done.stdout.splitlines()[-1])
    assert found["median"]["1"]["stretches"] >= 15
    assert all(found["checks"].values())
    assert len(found["checks"]) == 4
    outliers = found["outliers"]["room4"]
    assert 100 < outliers["outlier_steps"] < 200
    assert 100 < outliers["refused"] < 500
