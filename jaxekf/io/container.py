"""A recorded run as one HDF5 or NPZ file: the same paths in both, to the last bit.

The root has the attributes ``kind``, ``schema_version``, ``name``, ``info`` (TOML text) and ``sha256``
(of all values). Each stream is a group of its name; its data sets are the fields of its schema
(`jaxekf.io.streams`).
``unit`` and ``frame`` of a data set are attributes in HDF5, and entries ``optical/time_ns@unit`` in NPZ.

In a file without ``sha256``, which any program may write, rows are screened like those of a CSV file. All
attributes of the root may then be missing.
"""

import tomllib
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import tomli_w

from jaxekf._support.errors import RecordingError
from jaxekf.io import _container_schema as layout
from jaxekf.io import export
from jaxekf.io._container_arrays import SUFFIXES, of_fixed_length, open_container
from jaxekf.io.atomic import whole_file
from jaxekf.io.description import SCHEMA_VERSION
from jaxekf.io.schema import TEXT, Field
from jaxekf.io.streams import SCHEMAS
from jaxekf.recordings import facts
from jaxekf.recordings.accounts import Intake, Place
from jaxekf.recordings.frozen_poses import without_repeats
from jaxekf.recordings.quaternion_norms import NORM_ROUNDED
from jaxekf.recordings.types import STREAMS, Recording

_ROOT = ("kind", "schema_version", "name", "info", "sha256")
_LONGEST_INFO = 60_000
"""Bytes that an attribute of HDF5 may have, with room for the others."""


def is_container(path: Path | str) -> bool:
    """Whether a path is by its suffix (.h5, .hdf5, .npz) that of a run in one file.

    Examples
    --------
    >>> from jaxekf.io import container
    >>> container.is_container("run.h5"), container.is_container("run")
    (True, False)
    """
    return Path(path).suffix.lower() in SUFFIXES


def save(recording: Recording, path: Path | str, *, overwrite: bool = False) -> Path:
    """Write a run as one file, HDF5 or NPZ by its suffix. Returns its path.

    `load` gives every number again to the last bit, those of hidden rows too. Raises `RecordingError` where
    the file may not be written, or the run could not be read again.

    Examples
    --------
    >>> import tempfile
    >>> from pathlib import Path
    >>> import jaxekf
    >>> from jaxekf.io import container
    >>> run = jaxekf.load(jaxekf.demo.FOLDER / "free-5")
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     file = container.save(run, Path(folder) / "free-5.npz")
    ...     again = jaxekf.load(file)
    >>> bool((again.need_imu().gyroscope == run.need_imu().gyroscope).all())
    True
    """
    path = _known(path)
    entries = _entries(recording, path)
    data = {key: entry.value for key, entry in entries.items() if key}
    # Whatever `load` would refuse is refused now, by the same code.
    _check_declared(path, {key: np.asarray(value) for key, value in data.items()}, {})
    _assemble(path, entries[""].about, data, sort=False, own=True)
    write = export.write_npz
    if SUFFIXES[path.suffix.lower()] == "hdf5":
        write = export.write_hdf5
        for key, (value, about) in entries.items():
            about = {name: of_fixed_length(attribute) for name, attribute in about.items()}
            entries[key] = export.Entry(of_fixed_length(value), about)
    with whole_file(path, overwrite=overwrite) as temporary:
        write(temporary, entries)
    return path


def load(path: Path | str, *, sort: bool = False) -> Recording:
    """Read a run from an HDF5 or NPZ file that `save`, or another program, wrote.

    The data sets that a schema needs must be there, and no unknown ones; other groups are not read. A
    type is read where no value changes by it: float32, small integers, any integer times that fit,
    never times as floats. If the file has ``sha256``, it must be that of the content, which is then
    taken without screening: only rows hidden by ``valid`` (or ``visible``) and numbers that are not finite
    are masked. Without it rows are screened like those of a CSV file (`screening`), and with `sort` sorted
    by time. `Recording.intake` has the account. Raises `RecordingError`.
    """
    path = _known(path)
    data: dict[str, Any] = {}
    with open_container(path, tuple(SCHEMAS), _ROOT) as content:
        attributes = {key: content.attributes[key] for key in _ROOT if key in content.attributes}
        _check_root(path, attributes)
        for label, schema in SCHEMAS.items():
            names = {k.split("/", 1)[1] for k in content.arrays if k.startswith(f"{label}/")}
            if names:
                layout.check_names(str(path), label, names, schema.stored)
        _check_declared(path, content.arrays, content.attributes)
        for key, stored in content.arrays.items():
            data[key] = layout.exact(str(path), key, stored.read(), _field(key))
    own = "sha256" in attributes
    if own and attributes["sha256"] != (found := layout.content_hash(attributes, data)):
        expected = f"{attributes['sha256']}, the attribute sha256 of the file"
        hint = "copying the file again; after a change on purpose delete the attribute"
        raise RecordingError(path, f"content whose SHA-256 is {found}", expected, hint)
    recording = _assemble(path, attributes, data, sort=sort, own=own)
    if not own:
        recording = without_repeats(recording)
    return _noted(recording, content.others)


def _known(path: Path | str) -> Path:
    if not is_container(path):
        raise RecordingError(
            path, f"the suffix '{Path(path).suffix}'", ".h5, .hdf5 or .npz", "one of these"
        )
    return Path(path)


def _field(key: str) -> Field:
    label, name = key.split("/", 1)
    return SCHEMAS[label].fields[name]


def _check_root(path: Path, attributes: Mapping[str, Any]) -> None:
    for key, expected in (("kind", layout.KIND), ("schema_version", SCHEMA_VERSION)):
        if key in attributes and attributes[key] != expected:
            got, hint = f"{attributes[key]!r}", "a run written for this version"
            raise RecordingError(f"{path}@{key}", got, f"{expected!r}", hint)
    for key in ("name", "info", "sha256"):
        if not isinstance(attributes.get(key, ""), str):
            got = f"{attributes[key]!r}"
            raise RecordingError(f"{path}@{key}", got, "a text", "writing it as one")


def _check_declared(path: Path, arrays: Mapping[str, Any], attributes: Mapping[str, Any]) -> None:
    """Types, shapes, units and frames are as documented, before any of it is read."""
    for label, schema in SCHEMAS.items():
        sizes: dict[str, int] = {}
        # Times and names first: they have as many entries as there are samples, markers and landmarks.
        keys = [f"{label}/{name}" for name in schema.stored]
        for key in (key for key in keys if key in arrays):
            field, stored = _field(key), arrays[key]
            layout.check_type(str(path), key, stored.dtype, field)
            layout.check_shape(str(path), key, stored.shape, field, sizes)
            layout.check_described(str(path), key, attributes, field)


def _assemble(
    path: Path, attributes: Mapping[str, Any], data: Mapping[str, Any], *, sort: bool, own: bool
) -> Recording:
    """A run of arrays in their types, its rows judged."""
    streams: dict[str, Any] = {}
    accounts: dict[str, Intake] = {}
    for label, schema in SCHEMAS.items():
        group = {k.split("/", 1)[1]: v for k, v in data.items() if k.startswith(f"{label}/")}
        if group:
            stream, account = schema.make(Place(f"{path}:{label}"), group, sort)
            if own:
                stream = _as_stored(stream, group)
            streams[label], accounts[label] = stream, account
    if not streams:
        expected = f"one of the groups {', '.join(STREAMS)}"
        raise RecordingError(path, "no stream", expected, "another file")
    info = _info(path, attributes.get("info", ""))
    made = Recording(str(attributes.get("name", path.stem)), info=info, path=path, intake=accounts)
    return made.with_streams(streams)


def _as_stored(stream: Any, group: Mapping[str, Any]) -> Any:
    """The stream with the numbers that `save` wrote, where screening has scaled or replaced them.

    A pose that was screened when the run was first read keeps its last bits.
    """
    if len(stream.time_ns) != len(group["time_ns"]):
        return stream
    kept: dict[str, Any] = {}
    if "q_ref_body" in group:
        stored = group["q_ref_body"]
        with np.errstate(invalid="ignore", over="ignore"):
            near = np.abs(np.linalg.norm(stored, axis=1) - 1.0) <= NORM_ROUNDED
        as_it_is = near | ~group["valid"] if "valid" in group else near
        kept["q_ref_body"] = np.where(as_it_is[:, None], stored, stream.q_ref_body)
    if "q_body_camera" in group:
        stored = group["q_body_camera"]
        if abs(np.linalg.norm(stored) - 1.0) <= NORM_ROUNDED:
            kept["q_body_camera"] = stored
    if "scored" in group:
        kept["scored"] = group["scored"]
    return replace(stream, **kept)


def _info(path: Path, text: str) -> dict[str, Any]:
    try:
        info = tomllib.loads(text)
    except (tomllib.TOMLDecodeError, RecursionError) as error:
        raise RecordingError(
            f"{path}@info", f"text that is not TOML ({error})", "TOML", "mending it"
        ) from None
    return info | facts.known_entries(info, path)


def _noted(recording: Recording, others: list[str]) -> Recording:
    """With a note of what else is in the file, in the account of its first stream."""
    if not others:
        return recording
    first = next(iter(recording.intake))
    account = recording.intake[first]
    listed = ", ".join(sorted(others)[:10]) + (", ..." if len(others) > 10 else "")
    note = f"other contents of the file are not read: {listed}"
    account = replace(account, notes=(*account.notes, note))
    return recording.replace(intake={**recording.intake, first: account})


def _entries(recording: Recording, path: Path) -> dict[str, export.Entry]:
    """Entries to write, by path; the root first."""
    info = dict(recording.info)
    info |= facts.known_entries(info, path)
    try:
        text = tomli_w.dumps(info)
        size = len(f"{recording.name}{text}".encode())
    except (TypeError, ValueError, AttributeError) as error:
        raise RecordingError(
            path, f"info that is no TOML ({error})", "texts, numbers and lists", "changing it"
        ) from None
    if size > _LONGEST_INFO:
        expected = f"at most {_LONGEST_INFO}, which one file has room for"
        hint = "a folder, which has room for more"
        raise RecordingError(path, f"info of {size} bytes", expected, hint)
    attributes = {"kind": layout.KIND, "schema_version": SCHEMA_VERSION}
    attributes |= {"name": recording.name, "info": text}
    entries: dict[str, export.Entry] = {}
    for label, stream in recording.streams.items():
        schema = SCHEMAS[label]
        for name, field in schema.stored.items():
            value = schema.value(stream, name)
            if value is not None:
                key = f"{label}/{name}"
                raw = np.array(value, object if field.kind == TEXT else None)
                layout.check_type(str(path), key, raw.dtype, field)
                exact = layout.exact(str(path), key, raw, field)
                entries[key] = export.Entry(exact, field.described)
    data = {key: entry.value for key, entry in entries.items()}
    attributes["sha256"] = layout.content_hash(attributes, data)
    return {"": export.Entry(None, attributes)} | entries
