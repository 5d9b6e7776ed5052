"""Recorded runs on disk: a folder with `recording.toml` and one CSV file for each stream.

The files, their columns and the entries of `recording.toml` are those of the schemas in
`jaxekf.io.streams`. Times are decimal seconds, read exactly to the nanosecond. Folders are written
atomically.
"""

import hashlib
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import tomli_w

from jaxekf._support.errors import RecordingError
from jaxekf.checks import plausibility
from jaxekf.io import _section_entries as section_entries
from jaxekf.io import container, description
from jaxekf.io._unit_row import read_unit_row
from jaxekf.io.atomic import whole_folder
from jaxekf.io.csv_table import Table, read_table, write_sheet
from jaxekf.io.description import SCHEMA_VERSION, Source
from jaxekf.io.hashes import hashed
from jaxekf.io.schema import StreamSchema
from jaxekf.io.streams import SCHEMAS, run_keys, section_keys
from jaxekf.recordings import facts
from jaxekf.recordings.accounts import Intake, Reason
from jaxekf.recordings.frozen_poses import without_repeats
from jaxekf.recordings.types import STREAMS, Recording, Times

__all__ = ["SCHEMA_VERSION", "load", "load_imu", "read_log", "save"]


def load(path: Path | str, *, sort: bool = False) -> Recording:
    """Read a recorded run.

    Rows that must not be used are masked, and repeated rows are dropped; `Recording.intake` has the
    account.

    Parameters
    ----------
    path
        A run folder, or a run in one file (``.h5``, ``.hdf5``, ``.npz``).
    sort
        Sort rows that are out of order by time, instead of refusing the file.

    Returns
    -------
    Recording
        Streams in SI units, times in int64 nanoseconds. Further entries of `recording.toml` are in `info`
        (see `facts.known_entries`), the rest of a stream's section as ``optical_about`` and so on.

    Raises
    ------
    RecordingError
        For a fault in a file, with file, line and column; and if streams contradict each other in
        units, order of quaternions or times, unless `recording.toml` has ``trust_units = true``.

    Examples
    --------
    >>> import jaxekf
    >>> run = jaxekf.load(jaxekf.demo.FOLDER / "free-5")
    >>> run.name, run.need_optical().q_ref_body.shape, run.need_imu().gyroscope.shape
    ('free-5', (1501, 4), (3001, 3))
    """
    if container.is_container(path):
        made = container.load(path, sort=sort)
        made = made.replace(sources=made.sources or hashed(path))
    else:
        made = without_repeats(_load_folder(Path(path), sort))
    if made.info.get("trust_units") is not True:
        plausibility.require(made)
    return made


def _load_folder(folder: Path, sort: bool) -> Recording:
    about = description.read_description(folder)
    place = folder / facts.FILE
    section_entries.check_keys(about, "", place, run_keys())
    if not isinstance(trusted := about.get("trust_units", False), bool):
        hint = "correcting it"
        raise facts.wrong_entry(place, "trust_units", trusted, "true or false", hint)
    hashes = _hashes(about, place)
    read: dict[str, Any] = {}
    accounts: dict[str, Intake] = {}
    sources = hashed(place)
    known = section_keys()
    for label, schema in SCHEMAS.items():
        section = about.get(label, {})
        description.check_section(place, label, section, schema.described)
        section_entries.check_keys(section, label, place, known)
        how = section_entries.layout(label, section, place)
        file = folder / (how.file or f"{label}.csv")
        if file.exists() or label in about:
            table, section = read_unit_row(read_table(file, how), schema, section, place)
            tables = [table, *(_beside(folder / name, file.name) for name in schema.beside)]
            for one in tables:
                _check_hash(one, hashes)
                sources[one.path.name] = one.text.sha256
            stream, account = schema.read_table(table, Source(section, place, sort), *tables[1:])
            read[label], accounts[label] = stream, _completed(account, table, stream.time_ns)
    if not read:
        files = " or ".join(f"{label}.csv" for label in STREAMS)
        raise RecordingError(folder, "no stream", files, "another folder")
    info = {key: about[key] for key in about if key not in (*SCHEMAS, "sha256")}
    info |= facts.known_entries(info, place)
    info |= {f"{key}_about": _left(about[key], SCHEMAS[key]) for key in SCHEMAS if key in about}
    name = str(about.get("name", folder.resolve().name))
    made = Recording(name, info=info, path=folder, intake=accounts, sources=sources)
    return made.with_streams(read)


def _beside(path: Path, file: str) -> Table:
    """A second file of a stream, whose layout is fixed."""
    if not path.exists():
        raise RecordingError(path, "no such file", f"one beside {file}", "adding it")
    return read_table(path)


def _hashes(about: Mapping[str, Any], place: Path) -> dict[str, str]:
    """Hashes of a run's files in ``[sha256]``, by name."""
    hashes = about.get("sha256", {})
    if not isinstance(hashes, dict) or not all(isinstance(v, str) for v in hashes.values()):
        expected, hint = "a section with a hash for each file", "correcting or removing it"
        raise facts.wrong_entry(place, "sha256", hashes, expected, hint)
    for name in hashes:
        if not (place.parent / name).is_file():
            got = f"a hash of {name}, which is not there"
            raise RecordingError(place, got, "one of each file", "correcting its name")
    return hashes


def _check_hash(table: Table, hashes: Mapping[str, str]) -> None:
    expected = hashes.get(table.path.name)
    if expected is not None and expected.lower() != table.text.sha256:
        raise RecordingError(
            table.path,
            f"content of sha256 {table.text.sha256[:12]}...",
            f"{expected[:12]}... as in recording.toml",
            "restoring the file, or removing its hash under [sha256] where it was changed on purpose",
        )


def load_imu(path: Path | str) -> Recording:
    """An IMU alone, from a CSV file with the columns of `imu.csv`.

    Examples
    --------
    >>> import jaxekf, jaxekf.io
    >>> run = jaxekf.io.load_imu(jaxekf.demo.FOLDER / "free-5" / "imu.csv")
    >>> list(run.streams), run.need_imu().gyroscope.shape  # rad/s
    (['imu'], (3001, 3))
    """
    file = Path(path)
    table, section = read_unit_row(read_table(file), SCHEMAS["imu"], {}, file)
    imu, account = SCHEMAS["imu"].read_table(table, Source(section, file, False))
    account = _completed(account, table, imu.time_ns)
    return Recording(file.stem, imu=imu, path=file, intake={"imu": account})


def read_log(path: Path | str) -> Recording:
    """A recorded run, or a CSV file with the columns of `imu.csv`.

    Examples
    --------
    >>> import jaxekf
    >>> from jaxekf.io import run_folder
    >>> folder = jaxekf.demo.FOLDER / "free-5"
    >>> [list(run_folder.read_log(path).streams) for path in (folder, folder / "imu.csv")]
    [['optical', 'imu', 'encoder'], ['imu']]
    """
    alone = Path(path).is_file() and not container.is_container(path)
    return load_imu(path) if alone else load(path)


def _completed(account: Intake, table: Table, time_ns: Times) -> Intake:
    """With the rows that the file ends in the middle of, and how it was read."""
    account = replace(account, notes=(*table.text.notes, *account.notes))
    if not table.text.cut:
        return account
    lines = np.array(table.text.cut, np.intp)
    reason = Reason(lines, np.repeat(time_ns[-1:], len(lines)))
    return replace(account, rows=account.rows + len(lines)).with_masked("cut short", reason)


def save(
    recording: Recording,
    path: Path | str,
    *,
    overwrite: bool = False,
    digits: int = 17,
    hashes: bool = False,
) -> Path:
    """Write a run as a folder; what is hidden becomes blank cells. Returns the folder.

    Parameters
    ----------
    recording
        The run. `load` gives the same run again.
    path
        The folder, or one file by its suffix (``.h5``, ``.hdf5``, ``.npz``), which keeps every bit.
    overwrite
        Replace an earlier run.
    digits
        Significant digits of samples in a folder.
    hashes
        Write the SHA-256 of every file into `recording.toml`; `load` then refuses files that were changed.

    Raises
    ------
    RecordingError
        If the folder cannot be written, or if the run could not be read again.

    Examples
    --------
    >>> import tempfile
    >>> import jaxekf
    >>> run = jaxekf.load(jaxekf.demo.FOLDER / "free-5")
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     path = jaxekf.save(run, folder + "/run.h5")
    ...     again = jaxekf.load(path)
    >>> bool((again.need_imu().gyroscope == run.need_imu().gyroscope).all())
    True
    """
    if container.is_container(path):
        return container.save(recording, path, overwrite=overwrite)
    about: dict[str, Any] = {"schema_version": SCHEMA_VERSION, "name": recording.name}
    about |= {
        k: v for k, v in recording.info.items() if not k.endswith("_about") and k not in about
    }
    section_entries.check_keys(about, "", facts.FILE, run_keys())
    about |= facts.known_entries(about, facts.FILE)
    with whole_folder(path, facts.FILE, overwrite=overwrite) as folder:
        for label, stream in recording.streams.items():
            schema = SCHEMAS[label]
            section = _left(recording.info.get(f"{label}_about", {}), schema)
            sheet, about[label] = schema.write_table(stream, section)
            write_sheet(folder / f"{label}.csv", sheet, digits)
            for name, write_beside in schema.beside.items():
                write_beside(stream, folder / name)
        if hashes:
            about["sha256"] = {
                file.name: hashlib.sha256(file.read_bytes()).hexdigest()
                for file in sorted(folder.glob("*.csv"))
            }
        (folder / facts.FILE).write_text(tomli_w.dumps(about), "utf-8")
    return Path(path)


def _left(section: Mapping[str, Any], schema: StreamSchema) -> dict[str, Any]:
    """A section without the entries that the stream holds: each is in one place only."""
    return {key: value for key, value in section.items() if key not in schema.held}
