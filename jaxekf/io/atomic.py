"""Output that is written atomically."""

import os
import re
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from jaxekf._support.errors import RecordingError
from jaxekf.io import _temporary as temporary

_OVERWRITE = "--overwrite (in Python overwrite=True)"
_HEAD = 1000
"""Bytes at the beginning of a file that must contain its marker."""


def check_output(path: Path | str, marker: str, *, overwrite: bool = False) -> None:
    """Raise `RecordingError` where an output folder may not be written: see `whole_folder`."""
    target = Path(path)
    if not target.exists() or (target.is_dir() and not any(target.iterdir())):
        return
    if not (target / marker).is_file():
        raise RecordingError(
            target, f"a path that exists and holds no {marker}", "a new one", "another output"
        )
    if not overwrite:
        raise RecordingError(
            target, "a path that exists", "a new one", f"another output or {_OVERWRITE}"
        )


@contextmanager
def whole_folder(path: Path | str, marker: str, *, overwrite: bool = False) -> Any:
    """A temporary folder beside `path` that becomes it when the block ends well, and is gone if not.

    With `overwrite` it replaces an older folder of the same kind: one that holds the file `marker`. The
    older one is renamed aside, the new one into its place, and only then is the older one removed: a kill
    at any moment leaves one of them whole, or for the instant between two renames none; the next write of
    the same folder then puts the older one back and goes on from there.
    """
    target = Path(path).resolve()
    temporary.sweep(target)
    check_output(path, marker, overwrite=overwrite)
    made = temporary.beside(target)
    with _new_folder(made, path):
        yield made
        temporary.sync(made)
        _put_folder(made, target)


@contextmanager
def _new_folder(made: Path, path: Path | str) -> Iterator[None]:
    """The temporary folder `made` for the output `path`; what has not been moved at the end is gone."""
    with _named(made, Path(path)):
        made.parent.mkdir(parents=True, exist_ok=True)
        try:
            made.mkdir()
            yield
        finally:
            shutil.rmtree(made, ignore_errors=True)


def _put_folder(made: Path, target: Path) -> None:
    """A finished folder in the place of an older one, or of none."""
    old, gone = temporary.beside(target, temporary.OLD), temporary.beside(target)
    try:
        if target.is_dir():
            target.rename(old)
        made.rename(target)
    except BaseException:
        if old.exists() and not target.exists():
            old.rename(target)
        raise
    temporary.sync_folder(target.parent)
    if old.exists():
        # Half removed it must not be taken for what can be put back.
        old.rename(gone)
        shutil.rmtree(gone, ignore_errors=True)


@contextmanager
def whole_set(path: Path | str) -> Iterator[Path]:
    """A temporary folder whose files are moved into the folder `path` when the block ends well; what
    else is in that stays.

    Where there is no such folder, or an empty one, they appear there all at once. In another one
    each replaces the file of its name, one rename after the other when all are safely written: a kill
    between two renames leaves files of two sets, each whole, which must identify their set.
    """
    target = Path(path).resolve()
    fresh = not target.exists() or (target.is_dir() and not any(target.iterdir()))
    if not fresh and not target.is_dir():
        raise RecordingError(path, "a file", "a folder", "another output")
    inside = None if fresh else target
    temporary.sweep(target, inside)
    made = temporary.beside(target, folder=inside)
    with _new_folder(made, path):
        yield made
        temporary.sync(made)
        if fresh:
            _put_folder(made, target)
            return
        for file in sorted(made.rglob("*")):
            place = target / file.relative_to(made)
            if file.is_dir():
                place.mkdir(exist_ok=True)
            else:
                file.replace(place)
        temporary.sync_folder(target)


@contextmanager
def whole_file(path: Path | str, *, overwrite: bool = False) -> Iterator[Path]:
    """A temporary file beside `path` that becomes it when the block ends well, and is gone if not.

    Raises `RecordingError` for a path that exists; with `overwrite` only where it is no file.
    """
    target = Path(path)
    if target.exists() and not (overwrite and target.is_file()):
        got, hint = "something else than a file", "the name of a file"
        if target.is_dir():
            got = "a folder"
        elif target.is_file():
            got, hint = "a file that exists", f"another path or {_OVERWRITE}"
        raise RecordingError(target, got, "a new file", hint)
    temporary.sweep(target)
    made = temporary.beside(target, target.suffix)
    with _named(made, target):
        target.parent.mkdir(parents=True, exist_ok=True)
        try:
            made.touch(exist_ok=False)
            yield made
            temporary.sync(made)
            made.replace(target)
        except BaseException:
            made.unlink(missing_ok=True)
            raise
        temporary.sync_folder(target.parent)


@contextmanager
def _named(made: Path, target: Path) -> Iterator[None]:
    """Errors of the system name the final path instead of the temporary one."""
    try:
        yield
    except OSError as error:
        named, inner = error.filename, re.search(r"errno = (\d+)", str(error))
        if error.errno is None and inner:  # HDF5 has the number in its message only.
            error.errno, error.strerror = int(inner[1]), os.strerror(int(inner[1]))
        if isinstance(named, str | Path) and Path(named).is_relative_to(made):
            error.filename = str(target / Path(named).relative_to(made))
        elif named is None and error.errno is not None:
            error.filename = str(target)
        raise


def check_file(path: Path | str, marker: str, *, overwrite: bool = False) -> None:
    """Raise `RecordingError` where an output file may not be written.

    With `overwrite` it may replace an older file of the same kind: one whose head holds `marker`.
    """
    target = Path(path)
    if not target.exists():
        return
    if target.is_dir():
        raise RecordingError(target, "a folder", "the name of a file", "another output")
    with target.open("rb") as file:
        same = marker.encode() in file.read(_HEAD)
    if not same:
        raise RecordingError(
            target, f"a file that holds no {marker}", "a new one", "another output"
        )
    if not overwrite:
        raise RecordingError(
            target, "a file that exists", "a new one", f"another output or {_OVERWRITE}"
        )


def write_whole(path: Path | str, text: str) -> None:
    """Write a text file by a temporary one and a rename, so that it is never half there."""
    with whole_file(path, overwrite=True) as made:
        made.write_text(text, "utf-8")
