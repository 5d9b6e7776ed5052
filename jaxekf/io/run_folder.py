"""Recorded runs on disk: a folder with `recording.toml` and one CSV file a stream, of a camera two.

``optical.csv``  time,qw,qx,qy,qz[,x,y,z][,status][,error]
``markers.csv``  time,marker,x,y,z[,quality][,error]       (`marker_storage`)
``camera.csv``   time,landmark,u,v[,sigma], and ``landmarks.csv``  landmark,x,y,z  (`camera_storage`)
``imu.csv``      time,gx,gy,gz[,ax,ay,az][,mx,my,mz]
``encoder.csv``  time,angle[,scored]  or  time,qw,qx,qy,qz[,x,y,z][,scored]  (`encoder_storage`)

Times are decimal seconds, read exactly to the nanosecond. `recording.toml` says what the numbers are.
Folders are written whole or not at all.
"""

import hashlib
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np
import tomli_w

from jaxekf._support.errors import RecordingError
from jaxekf.checks import plausibility
from jaxekf.io import _camera as camera
from jaxekf.io import _encoder as encoder
from jaxekf.io import _markers as markers
from jaxekf.io import _stream_options as stream_options
from jaxekf.io import container, description
from jaxekf.io._encoder import joint_attitude
from jaxekf.io.atomic import whole_folder
from jaxekf.io.csv_table import (
    POSITION,
    QUATERNION,
    Sheet,
    Table,
    need_columns,
    numbers,
    read_table,
    reported,
    stamps,
    words,
    write_sheet,
)
from jaxekf.io.description import SCHEMA_VERSION, Source
from jaxekf.io.hashes import hashed
from jaxekf.recordings import facts, screening
from jaxekf.recordings.accounts import Intake, Reason
from jaxekf.recordings.frozen_poses import without_repeats
from jaxekf.recordings.types import Imu, Optical, Recording, Times

_GYROSCOPE, _FORCE, _FIELD = ("gx", "gy", "gz"), ("ax", "ay", "az"), ("mx", "my", "mz")
__all__ = ["SCHEMA_VERSION", "joint_attitude", "load", "load_imu", "save"]


def load(path: Path | str, *, sort: bool = False) -> Recording:
    """Read a recorded run. Raises `RecordingError`, which names file, line and column.

    What `recording.toml` says besides becomes `Recording.info`: its own entries by their names (see
    `facts.known_entries`), and what is left of a stream's section as ``optical_about`` and so on. Rows that
    are not to be believed are masked and those that are none dropped: `Recording.intake` has the account.
    With `sort` rows that are out of order are put in order of time.

    What streams say of each other must fit: units, order of quaternions, times that overlap
    (`plausible.require`); ``trust_units = true`` in `recording.toml` leaves that out.

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
    stream_options.check_keys(about, "", place)
    if not isinstance(about.get("trust_units", False), bool):
        raise RecordingError(
            place,
            f"trust_units = {about['trust_units']!r}",
            "true or false",
            "correcting it",
            column="trust_units",
        )
    hashes = _hashes(about, place)
    read: dict[str, Any] = {}
    accounts: dict[str, Intake] = {}
    sources = hashed(place)
    for label, form in _FORMS.items():
        section = about.get(label, {})
        description.check_section(place, label, section, form.described)
        stream_options.check_keys(section, label, place)
        how = stream_options.layout(label, section, place)
        file = folder / (how.file or f"{label}.csv")
        if file.exists() or label in about:
            table = read_table(file, how)
            tables = [table, *(_beside(folder / name, file.name) for name in form.beside)]
            for one in tables:
                _check_hash(one, hashes)
                sources[one.path.name] = one.text.sha256
            stream, account = form.read(table, Source(section, place, sort), *tables[1:])
            read[label], accounts[label] = stream, _completed(account, table, stream.time_ns)
    if not read:
        files = " or ".join(f"{label}.csv" for label in _FORMS)
        raise RecordingError(folder, "no stream", files, "another folder")
    info = {key: about[key] for key in about if key not in (*_FORMS, "sha256")}
    info |= facts.known_entries(info, place)
    info |= {f"{key}_about": _left(about[key], _FORMS[key]) for key in _FORMS if key in about}
    name = str(about.get("name", folder.resolve().name))
    return Recording(name, **read, info=info, path=folder, intake=accounts, sources=sources)


def _beside(path: Path, file: str) -> Table:
    """A second file of a stream, whose layout is fixed."""
    if not path.exists():
        raise RecordingError(path, "no such file", f"one beside {file}", "adding it")
    return read_table(path)


def _hashes(about: Mapping[str, Any], place: Path) -> dict[str, str]:
    """What ``[sha256]`` says of the files of a run, by their names."""
    said = about.get("sha256", {})
    if not isinstance(said, dict) or not all(isinstance(v, str) for v in said.values()):
        raise RecordingError(
            place,
            f"sha256 = {said!r}",
            "a section with a hash for each file",
            "correcting or removing it",
            column="sha256",
        )
    for name in said:
        if not (place.parent / name).is_file():
            raise RecordingError(
                place,
                f"a hash of {name}, which is not there",
                "one of each file",
                "correcting its name",
            )
    return said


def _check_hash(table: Table, hashes: Mapping[str, str]) -> None:
    expected = hashes.get(table.path.name)
    if expected is not None and expected.lower() != table.text.sha256:
        raise RecordingError(
            table.path,
            f"content of sha256 {table.text.sha256[:12]}...",
            f"{expected[:12]}... as recording.toml says",
            "restoring the file, or removing its hash under [sha256] where it was changed on purpose",
        )


def load_imu(path: Path | str) -> Recording:
    """An IMU alone, from a CSV file with the columns of `imu.csv`."""
    file = Path(path)
    table = read_table(file)
    imu, account = _read_imu(table, Source({}, file, False))
    account = _completed(account, table, imu.time_ns)
    return Recording(file.stem, imu=imu, path=file, intake={"imu": account})


def read_log(path: Path | str) -> Recording:
    """A recorded run, or a CSV file with the columns of `imu.csv`."""
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

    `load` gives the same run again; with fewer `digits`, its samples rounded. With `hashes` the SHA-256 of
    every file is in `recording.toml`, and `load` refuses files that were changed since. Raises
    `RecordingError`
    where the folder may not be written, or the run could not be read again.

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
    stream_options.check_keys(about, "", facts.FILE)
    about |= facts.known_entries(about, facts.FILE)
    with whole_folder(path, facts.FILE, overwrite=overwrite) as folder:
        for label, form in _FORMS.items():
            stream = getattr(recording, label)
            if stream is None:
                continue
            section = _left(recording.info.get(f"{label}_about", {}), form)
            sheet, about[label] = form.write(stream, section)
            write_sheet(folder / f"{label}.csv", sheet, digits)
            for name, write_beside in form.beside.items():
                write_beside(stream, folder / name)
        if hashes:
            about["sha256"] = {
                file.name: hashlib.sha256(file.read_bytes()).hexdigest()
                for file in sorted(folder.glob("*.csv"))
            }
        (folder / facts.FILE).write_text(tomli_w.dumps(about), "utf-8")
    return Path(path)


def _read_optical(table: Table, source: Source) -> tuple[Optical, Intake]:
    need_columns(table, "time,qw,qx,qy,qz[,x,y,z][,status][,error]")
    about, place = source.about, source.place
    turning = stream_options.turning("optical", about, place)
    _, length = stream_options.factors("optical", about, place)
    position = p_body_tool = status = None
    names = list(turning.columns(table.columns))
    if set(POSITION) <= set(table.columns):
        names += POSITION
    pose = numbers(table, names, blank=True)
    if len(names) > 4:
        position = length * pose[:, 4:]
    if "status" in table.columns:
        status = words(table, "status")
    if "p_body_tool" in about:
        p_body_tool = facts.finite_vector(about["p_body_tool"], 3, place, "optical.p_body_tool")
    error = reported(table, "error", least=0.0)
    return screening.optical(
        table.place,
        stamps(table),
        turning.standard(pose[:, :4]),
        position,
        status=status,
        status_ok=description.words(about, "optical", "status_ok", screening.STATUS_OK, place),
        error=None if error is None else length * error,
        error_max=description.limit(about, "optical", "error_max", place),
        sort=source.sort,
        p_body_tool=p_body_tool,
        latency_ns=description.latency_ns(about, "optical", place),
    )


def _write_optical(stream: Optical, about: dict[str, Any]) -> tuple[Sheet, dict[str, Any]]:
    hidden = ~stream.valid[:, None]
    columns, values = list(QUATERNION), [np.where(hidden, np.nan, stream.q_ref_body)]
    if stream.position is not None:
        columns += POSITION
        values.append(np.where(hidden, np.nan, stream.position))
    if stream.error is not None:
        columns.append("error")
        values.append(stream.error[:, None])
    about |= {**_FORMS["optical"].described, **description.latency_entry(stream.latency_ns)}
    if stream.p_body_tool is not None:
        about["p_body_tool"] = facts.finite_vector(
            stream.p_body_tool, 3, facts.FILE, "optical.p_body_tool"
        ).tolist()
    return Sheet(columns, stream.time_ns, np.concatenate(values, axis=1)), about


def _read_imu(table: Table, source: Source) -> tuple[Imu, Intake]:
    need_columns(table, "time,gx,gy,gz[,ax,ay,az][,mx,my,mz]")
    rate, force = stream_options.factors("imu", source.about, source.place)

    parts = [_GYROSCOPE, *(p for p in (_FORCE, _FIELD) if set(p) <= set(table.columns))]
    # All at once: a file is taken apart only once for them.
    every = numbers(table, [name for part in parts for name in part], blank=True)
    read = {p: np.ascontiguousarray(every[:, 3 * i : 3 * i + 3]) for i, p in enumerate(parts)}
    del every
    accelerometer = read.get(_FORCE)
    return screening.imu(
        table.place,
        stamps(table),
        stream_options.scaled(read[_GYROSCOPE], rate),
        None if accelerometer is None else stream_options.scaled(accelerometer, force),
        read.get(_FIELD),
        sort=source.sort,
    )


def _write_imu(stream: Imu, about: dict[str, Any]) -> tuple[Sheet, dict[str, Any]]:
    columns, values = list(_GYROSCOPE), [stream.gyroscope]
    if stream.accelerometer is not None:
        columns += _FORCE
        values.append(stream.accelerometer)
    if stream.magnetometer is not None:
        columns += _FIELD
        values.append(stream.magnetometer)
    about |= _FORMS["imu"].described
    return Sheet(columns, stream.time_ns, np.concatenate(values, axis=1)), about


class _Form(NamedTuple):
    """How a stream of `Recording` is held on disk."""

    read: Callable[..., tuple[Any, Intake]]
    """Of its table, its source and the tables of the files `beside`: the stream and its account."""
    write: Callable[[Any, dict[str, Any]], tuple[Sheet, dict[str, Any]]]
    described: Mapping[str, str]
    """What its section of `recording.toml` says, where it says it."""
    held: tuple[str, ...] = ()
    """Entries of its section that the stream itself holds once it is read."""
    beside: Mapping[str, Callable[[Any, Path], None]] = MappingProxyType({})
    """Names of further files that it needs, and what writes them."""


_FORMS = {
    "optical": _Form(
        _read_optical,
        _write_optical,
        {"kind": "pose", "quaternion": facts.BODY_TO_REFERENCE, "unit": "1, m"},
        ("status_ok", "error_max", "p_body_tool", "latency"),
    ),
    "markers": _Form(
        markers.read,
        markers.write,
        markers.DESCRIBED,
        ("latency", "quality_min", "geometry"),
    ),
    "camera": _Form(
        camera.read,
        camera.write,
        camera.DESCRIBED,
        camera.HELD,
        {description.LANDMARKS: camera.write_landmarks},
    ),
    "imu": _Form(_read_imu, _write_imu, {"kind": "imu", "frame": "body", "unit": "rad/s, m/s^2"}),
    "encoder": _Form(encoder.read, encoder.write, encoder.DESCRIBED),
}


def _left(section: Mapping[str, Any], form: _Form) -> dict[str, Any]:
    """A section without what the stream holds: each is said in one place only."""
    held = (*form.held, *stream_options.HELD)
    return {key: value for key, value in section.items() if key not in held}
