"""Output that is written whole or not at all."""

import os
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from jaxekf.errors import RecordingError


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


def write_whole(path: Path | str, text: str) -> None:
    """Write a text file by a temporary one and a rename, so that it is never half there."""
    with whole_file(path, overwrite=True) as temporary:
        temporary.write_text(text, "utf-8")
