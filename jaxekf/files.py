"""Output that is written whole or not at all."""

import math
import os
import shutil
import tempfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from jaxekf.errors import RecordingError

_HEAD = 1000
"""Bytes of a file in which its marker must stand."""


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
            target, "a path that exists", "a new one", "another output or the overwrite option"
        )


@contextmanager
def whole_folder(path: Path | str, marker: str, *, overwrite: bool = False) -> Any:
    """A temporary folder beside `path` that becomes it when the block ends well, and is gone if not.

    With `overwrite` it replaces an older folder of the same kind: one that holds the file `marker`.
    """
    check_output(path, marker, overwrite=overwrite)
    target = Path(path).resolve()
    target.parent.mkdir(parents=True, exist_ok=True)
    temporary = Path(tempfile.mkdtemp(prefix=f".{target.name}-", dir=target.parent))
    try:
        yield temporary
        temporary.chmod(0o755)
        if target.is_dir():
            shutil.rmtree(target)
        temporary.rename(target)
    except BaseException:
        shutil.rmtree(temporary, ignore_errors=True)
        raise


@contextmanager
def whole_file(path: Path | str, *, overwrite: bool = False) -> Iterator[Path]:
    """A temporary file beside `path` that becomes it when the block ends well, and is gone if not.

    Raises `RecordingError` for a path that exists; with `overwrite` only where it is no file.
    """
    target = Path(path)
    if target.exists() and not (overwrite and target.is_file()):
        got, hint = "a folder", "the name of a file"
        if target.is_file():
            got, hint = "a file that exists", "another path or the overwrite option"
        raise RecordingError(target, got, "a new file", hint)
    target.parent.mkdir(parents=True, exist_ok=True)
    handle, name = tempfile.mkstemp(
        prefix=f".{target.name}-", suffix=target.suffix, dir=target.parent
    )
    os.close(handle)
    temporary = Path(name)
    try:
        yield temporary
        temporary.chmod(0o644)
        temporary.replace(target)
    except BaseException:
        temporary.unlink(missing_ok=True)
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
            target, "a file that exists", "a new one", "another output or the overwrite option"
        )


def finite_or_null(node: Any) -> Any:
    """A JSON document in which numbers that are not finite, of which JSON knows none, are null."""
    if isinstance(node, Mapping):
        return {key: finite_or_null(value) for key, value in node.items()}
    if isinstance(node, list | tuple):
        return [finite_or_null(value) for value in node]
    if isinstance(node, float) and not math.isfinite(node):
        return None
    return node


def write_whole(path: Path | str, text: str) -> None:
    """Write a text file by a temporary one and a rename, so that it is never half there."""
    with whole_file(path, overwrite=True) as temporary:
        temporary.write_text(text, "utf-8")
