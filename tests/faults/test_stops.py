"""What stops a command from outside ends in one line: Ctrl-C, a closed pipe, a full disk, no memory."""

import errno
import importlib
import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest
from click.testing import CliRunner
from endless import estimate as stand_in

import jaxekf
from jaxekf._support import memory
from jaxekf._support.errors import MissingPackageError, ResourceError
from jaxekf._support.optional import need
from jaxekf.cli import main
from jaxekf.io import run_folder
from jaxekf.io.export import read_export
from jaxekf.recordings.types import Imu, Recording
from jaxekf.reporting.report._saved import read_result

ROOT = Path(__file__).parents[2]
# The package has the command under the name of its module.
estimate_command = importlib.import_module("jaxekf.cli.estimate")
POSIX = pytest.mark.skipif(os.name != "posix", reason="signals and pipes are POSIX's")


@pytest.fixture(autouse=True)
def _can_be_interrupted():
    """Ctrl-C as at a terminal, here and in what is started: a job in the background ignores it."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


def call(*arguments):
    return CliRunner().invoke(main, [str(a) for a in arguments])


def start(*arguments, **options):
    """The command in a process of its own."""
    paths = os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")])
    environment = os.environ | {"PYTHONPATH": paths, "JAXEKF_CACHE": ""}
    command = [sys.executable, "-m", "jaxekf", *map(str, arguments)]
    return subprocess.Popen(command, env=environment, text=True, **options)


@POSIX
def test_ctrl_c_keeps_what_is_finished(tmp_path):
    """Would catch a traceback, another exit status than shells know, and half a run that stays."""
    simulate = ["simulate", "--runs", 500, "--duration", 20, "-o", tmp_path]
    with start(*simulate, stderr=subprocess.PIPE) as process:
        first = process.stderr.readline()
        process.send_signal(signal.SIGINT)
        told = [first, *process.stderr.read().splitlines()]
    assert process.returncode == 130
    assert first.startswith("wrote")
    assert all(line.startswith("wrote") for line in told[:-1])
    assert told[-1].startswith(f"interrupted: {tmp_path / 'free-0'}")
    assert told[-1].endswith("finished and kept")
    kept = sorted(tmp_path.iterdir())
    assert len(kept) == len(told) - 1
    for folder in kept:
        jaxekf.load(folder)


def test_a_pipe_that_is_closed(tmp_path, monkeypatch):
    """Would catch a closed pipe told as a fault of the output; the long form closes a real one."""

    def breaks(*arguments):
        raise BrokenPipeError(errno.EPIPE, "Broken pipe")

    monkeypatch.setattr(importlib.import_module("jaxekf.cli.simulate"), "print_json", breaks)
    done = call("simulate", "--duration", 1, "--rest", 0.2, "-o", tmp_path, "--json")
    assert done.exit_code == 1
    assert done.output.splitlines() == [f"wrote {tmp_path / 'free-0'}"]


@POSIX
@pytest.mark.skipif(os.environ.get("JAXEKF_LONG") != "1", reason="long form: set JAXEKF_LONG=1")
def test_a_reader_that_has_heard_enough(tmp_path):
    """Would catch a traceback or a complaint where a command's output is piped into head."""
    simulate = ["simulate", "--duration", 1, "--rest", 0.2, "-o", tmp_path, "--json"]
    with start(*simulate, stdout=subprocess.PIPE, stderr=subprocess.PIPE) as process:
        process.stdout.close()
        told = process.stderr.read()
    assert told.splitlines() == [f"wrote {tmp_path / 'free-0'}"]
    assert process.returncode == 1


@pytest.fixture
def three(tmp_path, monkeypatch):
    """Three runs whose estimates are made in no time."""
    paths = []
    for i in range(3):
        imu = Imu(stand_in(0).time_ns, stand_in(0).outputs["rate"].value)
        paths.append(run_folder.save(Recording(f"run-{i}", imu=imu), tmp_path / f"run-{i}"))
    monkeypatch.setattr(
        estimate_command, "estimate_many", lambda runs, *a, **o: [stand_in(i) for i in range(3)]
    )
    monkeypatch.setattr(estimate_command, "describe", lambda *a: {})
    monkeypatch.setattr(estimate_command, "warn", lambda *a: None)
    return paths


class Silent:
    """A diagnosis of nothing."""

    def as_dict(self, curves=False):
        return {"verdicts": [], "notes": [], "sensors": {}, "parts": {}}


def broken_at(number, breaks):
    """What `diagnose` is replaced by: it breaks at the n-th run."""
    count = []

    def diagnose(*arguments):
        count.append(1)
        if len(count) == number:
            breaks()
        return Silent()

    return diagnose


def test_ctrl_c_among_several_estimates(three, tmp_path, monkeypatch):
    """Would catch finished results that are lost, and unfinished ones that stay."""
    stop = broken_at(3, lambda: signal.raise_signal(signal.SIGINT))
    monkeypatch.setattr(estimate_command, "diagnose", stop)
    done = call("estimate", *three, "-o", tmp_path / "out", "--export", "hdf5")
    assert done.exit_code == 130
    said = f"interrupted: {tmp_path / 'out/run-0'}, {tmp_path / 'out/run-1'} were finished and kept"
    assert done.output.splitlines()[-1] == said
    assert sorted(p.name for p in (tmp_path / "out").iterdir()) == ["run-0", "run-1"]
    read_result(tmp_path / "out" / "run-1")
    read_export(tmp_path / "out" / "run-1" / "estimate.h5")


def test_too_little_memory_names_the_run(three, tmp_path, monkeypatch):
    """Would catch a traceback, and a line that leaves open which of many runs is too long."""

    def breaks():
        raise MemoryError("Unable to allocate 7 TiB")

    monkeypatch.setattr(estimate_command, "diagnose", broken_at(2, breaks))
    done = call("estimate", *three, "-o", tmp_path / "out")
    assert done.exit_code == 1
    assert "run 'run-1': got too little memory (Unable to allocate 7 TiB)" in done.output
    assert "Traceback" not in done.output
    monkeypatch.setattr(run_folder, "load", lambda path, **_: breaks())
    assert "run 'run-0': got too little memory" in call("estimate", *three).output


def test_the_compilers_own_words_for_it():
    """Would catch XLA's error passed on raw, and others taken for it."""
    with (
        pytest.raises(ResourceError, match=r"2 runs from 'a' on: .*RESOURCE_EXHAUSTED"),
        memory.for_runs("ab"),
    ):
        raise RuntimeError("RESOURCE_EXHAUSTED: Out of memory allocating 8 bytes.")
    with pytest.raises(RuntimeError, match="another"), memory.for_runs(["a"]):
        raise RuntimeError("another")


@pytest.mark.parametrize(
    "error",
    [
        OSError(errno.ENOSPC, "No space left on device"),
        OSError("Unable to write (errno = 28, error message = 'No space left on device')"),
    ],
)
def test_a_full_disk(tmp_path, monkeypatch, error):
    """Would catch a traceback, half a run, and a line that names a temporary file or sends one to look at
    permissions; HDF5 tells of the number in words."""

    def breaks(*arguments):
        raise error

    monkeypatch.setattr(run_folder, "write_sheet", breaks)
    done = call("simulate", "--duration", 1, "--rest", 0.2, "-o", tmp_path)
    assert done.exit_code == 1
    expected = f"Error: {tmp_path / 'free-0'}: got 'No space left on device', expected free space"
    assert done.output.startswith(expected)
    assert len(done.output.splitlines()) == 1
    assert not list(tmp_path.iterdir())


def test_an_output_that_cannot_be(tmp_path):
    """Would catch a traceback, and the name of a temporary file that the user never chose."""
    (tmp_path / "file").write_text("mine")
    done = call("simulate", "--duration", 1, "--rest", 0.2, "-o", tmp_path / "file" / "runs")
    assert done.exit_code == 1
    assert done.output.startswith(f"Error: {tmp_path / 'file'}")
    assert "expected to read or write there" in done.output
    assert len(done.output.splitlines()) == 1


def test_a_package_that_only_an_extra_brings(tmp_path, monkeypatch):
    """Would catch a bare ModuleNotFoundError, and a broken package told to be missing."""
    assert need("json", "any").dumps(1) == "1"
    with pytest.raises(MissingPackageError, match=r'no package .no_such_thing.*"jaxekf\[ros\]"'):
        need("no_such_thing.inner", "ros")
    (tmp_path / "half_there.py").write_text("from json import no_such_name\n")
    monkeypatch.syspath_prepend(tmp_path)
    with pytest.raises(MissingPackageError, match=r"does not load .*no_such_name"):
        need("half_there", "ros")
