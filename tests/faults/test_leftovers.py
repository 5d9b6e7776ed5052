"""Temporary names: what is cleaned, what is put back, and what is left alone."""

import errno
import os
import subprocess
import sys
from pathlib import Path

import pytest

from jaxekf._support.errors import RecordingError
from jaxekf.estimation import parameters
from jaxekf.io import _temporary as temporary
from jaxekf.io.atomic import whole_file, whole_folder, whole_set
from jaxekf.models.loose import MODEL
from jaxekf.reporting.report._tuned import _check_noise


def dead():
    """The id of a process that has ended."""
    process = subprocess.Popen([sys.executable, "-c", ""])
    process.wait()
    return process.pid


def of_process(target, pid, suffix=""):
    """The temporary name that another process would have chosen."""
    name = temporary.beside(target, suffix).name
    return target.with_name(name.replace(f"-{os.getpid()}-", f"-{pid}-"))


def write(folder, text="new", **options):
    with whole_folder(folder, "mark", **options) as made:
        (made / "mark").write_text(text)


def test_only_what_killed_writers_left_is_removed(tmp_path):
    """Would catch the user's hidden files taken for ours, a live write removed, and leftovers that stay."""
    target = tmp_path / "out"
    alive, gone = of_process(target, os.getppid()), of_process(target, dead())
    elsewhere = tmp_path / gone.name.replace(temporary._HOST, "0" * 6)
    kept = [tmp_path / ".out-backup", tmp_path / ".out-a1b2c3-7-notours1", alive, elsewhere]
    for path in (*kept, gone):
        path.mkdir()
        (path / "mark").write_text("half")
    write(target)
    assert {p.name for p in tmp_path.iterdir()} == {"out", *(p.name for p in kept)}


def test_a_day_makes_it_abandoned(tmp_path, monkeypatch):
    """Would catch leftovers of other machines and of process numbers given anew that stay for ever."""
    left = of_process(tmp_path / "out", os.getpid())
    left.mkdir()
    assert not temporary._abandoned(left, temporary._HOST, os.getpid())
    assert not temporary._abandoned(left, "0" * 6, dead())
    assert temporary._abandoned(left, temporary._HOST, dead())
    now = temporary.time.time()
    monkeypatch.setattr(temporary.time, "time", lambda: now + 90_000.0)
    assert temporary._abandoned(left, "0" * 6, os.getpid())


def test_what_was_set_aside_is_put_back(tmp_path):
    """Would catch an older result that is lost because its writer was killed between two renames."""
    target = tmp_path / "out"
    write(target, "older")
    target.rename(of_process(target, dead(), temporary.OLD))
    with pytest.raises(RuntimeError), whole_folder(target, "mark", overwrite=True):
        raise RuntimeError
    assert (target / "mark").read_text() == "older"
    assert list(tmp_path.iterdir()) == [target]


def test_a_rename_that_fails_leaves_the_older_one(tmp_path, monkeypatch):
    """Would catch an older result that is lost where the new one cannot be put in its place."""
    target = tmp_path / "out"
    write(target, "older")
    rename = Path.rename

    def refuses(path, to):
        if Path(to).name == "out" and not path.name.endswith(temporary.OLD):
            raise OSError(errno.EACCES, "Permission denied", str(path))
        return rename(path, to)

    monkeypatch.setattr(Path, "rename", refuses)
    with pytest.raises(PermissionError) as caught:
        write(target, overwrite=True)
    assert caught.value.filename == str(target)
    assert (target / "mark").read_text() == "older"
    assert list(tmp_path.iterdir()) == [target]


def test_what_was_written_is_synced_before_its_name(tmp_path, monkeypatch):
    """Would catch a rename that reaches the disk before the bytes do."""
    seen = []
    real_sync, real_rename, real_replace = os.fsync, Path.rename, Path.replace

    def sync(handle):
        seen.append(("sync", Path(os.readlink(f"/proc/self/fd/{handle}")).name))
        real_sync(handle)

    def moved(real):
        return lambda path, to: (seen.append(("name", Path(to).name)), real(path, to))[1]

    if not Path("/proc/self/fd").is_dir():
        pytest.skip("there is no /proc that tells which file a handle is of")
    monkeypatch.setattr(os, "fsync", sync)
    monkeypatch.setattr(Path, "rename", moved(real_rename))
    monkeypatch.setattr(Path, "replace", moved(real_replace))
    write(tmp_path / "out")
    assert seen.index(("sync", "mark")) < seen.index(("name", "out"))
    assert seen[-1] == ("sync", tmp_path.name)
    del seen[:]
    with whole_file(tmp_path / "one.txt") as made:
        made.write_text("text")
    assert [kind for kind, _ in seen] == ["sync", "name", "sync"]


def test_a_set_leaves_the_rest_of_its_folder(tmp_path):
    """Would catch a user's file removed with an earlier tuning, and a set that is put half in place."""
    folder = tmp_path / "tuned"
    for number in (1, 2):
        with whole_set(folder) as made:
            (made / "runs").mkdir()
            for name in ("noise.toml", "runs/a.toml"):
                (made / name).write_text(str(number))
        (folder / "mine.txt").write_text("mine")
    with pytest.raises(RuntimeError), whole_set(folder) as made:
        (made / "noise.toml").write_text("3")
        raise RuntimeError
    found = {p.relative_to(folder).as_posix(): p.read_text() for p in folder.rglob("*.*")}
    assert found == {"noise.toml": "2", "runs/a.toml": "2", "mine.txt": "mine"}


def test_files_of_two_tunings_are_refused(tmp_path):
    """Would catch what a kill between two renames left of two tunings taken for one by filter or report."""
    for number in (1, 2):
        parameters.save(tmp_path / f"{number}", MODEL, MODEL.parameters, {"tuning": f"t{number}"})
    mixed = tmp_path / "1"
    parameters.load(MODEL, mixed)
    (tmp_path / "2" / "noise.toml").replace(mixed / "noise.toml")
    with pytest.raises(RecordingError, match=r"of the tunings .*naming both files"):
        parameters.load(MODEL, mixed)
    parameters.load(MODEL, mixed / "noise.toml", mixed / "calibration.toml")
    with pytest.raises(
        RecordingError, match=r"the record of the tuning t1 beside noise.toml of t2"
    ):
        _check_noise(mixed, "t1")
    _check_noise(mixed, "t2")
