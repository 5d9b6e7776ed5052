"""Recorded runs on disk: a folder with `recording.toml` and one CSV file a stream.

``optical.csv``  time,qw,qx,qy,qz[,x,y,z][,status][,error]
``markers.csv``  time,marker,x,y,z[,quality][,error]       (`marker_storage`)
``imu.csv``      time,gx,gy,gz[,ax,ay,az][,mx,my,mz]
``encoder.csv``  time,angle[,scored]  or  time,qw,qx,qy,qz[,x,y,z][,scored]  (`encoder_storage`)

Times are decimal seconds, read exactly to the nanosecond. `recording.toml` says what the numbers are.
Folders are written whole or not at all.
"""

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import tomli_w

from jaxekf import description, encoder_storage, marker_storage
from jaxekf.description import SCHEMA_VERSION
from jaxekf.encoder_storage import joint_attitude
from jaxekf.errors import RecordingError
from jaxekf.files import whole_folder
from jaxekf.recording import Floats, Imu, Optical, Recording, unit_quaternions
from jaxekf.tables import (
    POSITION,
    QUATERNION,
    Sheet,
    Table,
    finite_numbers,
    need_columns,
    numbers,
    read_table,
    read_times,
    reported,
    write_sheet,
)

__all__ = ["SCHEMA_VERSION", "joint_attitude", "load", "load_imu", "save"]


def load(path: Path | str) -> Recording:
    """Read a recorded run. Raises `RecordingError`, which names file, line and column.

    What `recording.toml` says besides becomes `Recording.info`: its own entries by their names (see
    `description.facts`), and what is left of a stream's section as ``optical_about`` and so on.
    """
    folder = Path(path)
    about = description.read_description(folder)
    place = folder / description.FILE
    for label, form in _FORMS.items():
        description.check_section(place, label, about.get(label, {}), form.described)
    read: dict[str, Any] = {}
    for label, form in _FORMS.items():
        file = folder / f"{label}.csv"
        if file.exists() or label in about:
            read[label] = form.read(read_table(file), about.get(label, {}))
    if not read:
        files = " or ".join(f"{label}.csv" for label in _FORMS)
        raise RecordingError(folder, "no stream", files, "another folder")
    info = {key: about[key] for key in about if key not in _FORMS}
    info |= description.facts(info, place)
    info |= {f"{key}_about": _left(about[key], _FORMS[key]) for key in _FORMS if key in about}
    name = str(about.get("name", folder.resolve().name))
    return Recording(name, **read, info=info, path=folder)


def load_imu(path: Path | str) -> Recording:
    """An IMU alone, from a CSV file with the columns of `imu.csv`."""
    file = Path(path)
    return Recording(file.stem, imu=_read_imu(read_table(file), {}), path=file)


def save(
    recording: Recording, path: Path | str, *, overwrite: bool = False, digits: int = 17
) -> Path:
    """Write a run as a folder; what is hidden becomes blank cells. Returns the folder.

    `load` gives the same run again; with fewer `digits`, its samples rounded. Raises `RecordingError`
    where the folder may not be written, or the run could not be read again.
    """
    about: dict[str, Any] = {"schema_version": SCHEMA_VERSION, "name": recording.name}
    about |= {
        k: v for k, v in recording.info.items() if not k.endswith("_about") and k not in about
    }
    about |= description.facts(about, description.FILE)
    with whole_folder(path, description.FILE, overwrite=overwrite) as folder:
        for label, form in _FORMS.items():
            stream = getattr(recording, label)
            if stream is None:
                continue
            section = _left(recording.info.get(f"{label}_about", {}), form)
            sheet, about[label] = form.write(stream, section)
            write_sheet(folder / f"{label}.csv", sheet, digits)
        (folder / description.FILE).write_text(tomli_w.dumps(about), "utf-8")
    return Path(path)


def _read_optical(table: Table, about: Mapping[str, Any]) -> Optical:
    need_columns(table, "time,qw,qx,qy,qz[,x,y,z][,status][,error]")
    place = table.path.with_name(description.FILE)
    q, valid = unit_quaternions(numbers(table, QUATERNION, blank=True))
    position = p_body_tool = None
    if set(POSITION) <= set(table.columns):
        position = numbers(table, POSITION, blank=True)
    if "status" in table.columns:
        at = table.columns.index("status")
        words = about.get("status_ok", ["ok", "0"])
        words = words if isinstance(words, list) else [words]
        good = {str(word).strip().lower() for word in words}
        valid &= np.array([row[at].strip().lower() in good for row in table.rows])
    if "p_body_tool" in about:
        p_body_tool = description.finite_vector(
            about["p_body_tool"], 3, place, "optical.p_body_tool"
        )
    return Optical(
        read_times(table),
        q,
        valid,
        position,
        error=reported(table, "error", least=0.0),
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
        about["p_body_tool"] = description.finite_vector(
            stream.p_body_tool, 3, description.FILE, "optical.p_body_tool"
        ).tolist()
    return Sheet(columns, stream.time_ns, np.concatenate(values, axis=1)), about


def _read_imu(table: Table, about: Mapping[str, Any]) -> Imu:
    need_columns(table, "time,gx,gy,gz[,ax,ay,az][,mx,my,mz]")

    def maybe(names: tuple[str, ...]) -> Floats | None:
        return finite_numbers(table, names) if set(names) <= set(table.columns) else None

    return Imu(
        read_times(table),
        finite_numbers(table, ("gx", "gy", "gz")),
        maybe(("ax", "ay", "az")),
        maybe(("mx", "my", "mz")),
    )


def _write_imu(stream: Imu, about: dict[str, Any]) -> tuple[Sheet, dict[str, Any]]:
    columns, values = ["gx", "gy", "gz"], [stream.gyroscope]
    if stream.accelerometer is not None:
        columns += ["ax", "ay", "az"]
        values.append(stream.accelerometer)
    if stream.magnetometer is not None:
        columns += ["mx", "my", "mz"]
        values.append(stream.magnetometer)
    about |= _FORMS["imu"].described
    return Sheet(columns, stream.time_ns, np.concatenate(values, axis=1)), about


class _Form(NamedTuple):
    """How a stream of `Recording` is held on disk."""

    read: Callable[[Table, Mapping[str, Any]], Any]
    write: Callable[[Any, dict[str, Any]], tuple[Sheet, dict[str, Any]]]
    described: Mapping[str, str]
    """What its section of `recording.toml` says, where it says it."""
    held: tuple[str, ...] = ()
    """Entries of its section that the stream itself holds once it is read."""


_FORMS = {
    "optical": _Form(
        _read_optical,
        _write_optical,
        {"kind": "pose", "quaternion": description.BODY_TO_REFERENCE, "unit": "1, m"},
        ("status_ok", "p_body_tool", "latency"),
    ),
    "markers": _Form(
        marker_storage.read,
        marker_storage.write,
        marker_storage.DESCRIBED,
        ("latency", "quality_min", "geometry"),
    ),
    "imu": _Form(_read_imu, _write_imu, {"kind": "imu", "frame": "body", "unit": "rad/s, m/s^2"}),
    "encoder": _Form(encoder_storage.read, encoder_storage.write, encoder_storage.DESCRIBED),
}


def _left(section: Mapping[str, Any], form: _Form) -> dict[str, Any]:
    """A section without what the stream holds: each is said in one place only."""
    return {key: value for key, value in section.items() if key not in form.held}
