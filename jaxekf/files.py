"""Output that is written whole or not at all."""

import shutil
import tempfile
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


def write_whole(path: Path | str, text: str) -> None:
    """Write a text file by a temporary one and a rename, so that it is never half there."""
    target = Path(path)
    target.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.NamedTemporaryFile(
        "w", encoding="utf-8", dir=target.parent, prefix=f".{target.name}-", delete=False
    ) as file:
        temporary = Path(file.name)
        file.write(text)
    temporary.chmod(0o644)
    temporary.replace(target)
