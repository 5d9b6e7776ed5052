"""Benchmarks and examples in their short form: each ends, and prints its last line."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
FOLDERS = ("benchmarks", "examples")
SCRIPTS = sorted(
    str(path.relative_to(ROOT))
    for folder in FOLDERS
    for path in (ROOT / folder).glob("*.py")
    if 'if __name__ == "__main__"' in path.read_text()
)


def test_scripts_are_found():
    """A list that is empty where folders have moved."""
    assert "benchmarks/speed.py" in SCRIPTS and "examples/own_model.py" in SCRIPTS


@pytest.mark.parametrize("script", SCRIPTS)
def test_script_ends(script, tmp_path):
    """A script without `--smoke`, one that ends in an error, or a last line that is not JSON."""
    command = [sys.executable, str(ROOT / script), "--smoke"]
    path = os.pathsep.join([str(ROOT), *filter(None, [os.environ.get("PYTHONPATH")])])
    done = subprocess.run(
        command, capture_output=True, text=True, cwd=tmp_path, env=os.environ | {"PYTHONPATH": path}
    )
    assert done.returncode == 0, done.stdout[-2000:] + done.stderr[-4000:]
    assert not list(tmp_path.iterdir()), "the short form leaves files behind"
    last = done.stdout.splitlines()[-1]
    if "JSON" not in (ROOT / script).read_text().split('"""')[1]:
        assert last.strip()
        return
    found = json.loads(last, parse_constant=lambda name: pytest.fail(f"{name} is not JSON"))
    assert found
    if "skipped" in found:
        pytest.skip(found["skipped"])
