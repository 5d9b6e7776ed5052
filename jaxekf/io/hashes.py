"""Identity of the files that a recording was read from: a SHA-256 of each."""

import hashlib
from collections.abc import Mapping
from pathlib import Path

from jaxekf.io.streams import SCHEMAS
from jaxekf.recordings.facts import FILE
from jaxekf.recordings.types import Recording

_READ = (".csv", ".json", ".toml", ".txt", ".yaml", ".yml")
"""Suffixes that readers of other layouts look at; a folder of camera images is not worth its hours."""


def hashed(folder_or_file: Path | str) -> dict[str, str]:
    """Name and SHA-256, in hex, of each file that a recording is read from, in order of the names.

    Of a recorded run's folder these are `recording.toml` and the CSV files of streams and landmarks; of a
    folder in another layout all tables and descriptions in it, by their paths in there; of a file that
    file. What cannot be read is left out.

    Examples
    --------
    >>> import jaxekf
    >>> from jaxekf.io import hashes
    >>> list(hashes.hashed(jaxekf.demo.FOLDER / "free-5"))
    ['encoder.csv', 'imu.csv', 'optical.csv', 'recording.toml']
    """
    path = Path(folder_or_file)
    if not path.is_dir():
        files = [path]
    elif (path / FILE).is_file():
        beside = (name for schema in SCHEMAS.values() for name in schema.beside)
        files = [path / name for name in (FILE, *(f"{label}.csv" for label in SCHEMAS), *beside)]
    else:
        files = [file for file in path.rglob("*") if file.suffix.lower() in _READ]
    found = {}
    for file in files:
        name = file.name if file == path else file.relative_to(path).as_posix()
        try:
            with file.open("rb") as stream:
                found[name] = hashlib.file_digest(stream, "sha256").hexdigest()
        except OSError:
            continue
    return dict(sorted(found.items()))


def inputs(recording: Recording) -> dict[str, str]:
    """Hashes of a recording's files: those of its reader, else of the files at its path now.

    Empty for a run that was made in memory.
    """
    if recording.sources:
        return dict(recording.sources)
    return {} if recording.path is None else hashed(recording.path)


def inputs_of(recordings: list[Recording]) -> Mapping[str, dict[str, str]]:
    """`inputs` of several recordings, by their names."""
    return {recording.name: inputs(recording) for recording in recordings}
