"""Recorded runs on disk: a folder with `recording.toml` and one CSV file a stream.

``optical.csv``  time,qw,qx,qy,qz[,x,y,z][,status]
``imu.csv``      time,gx,gy,gz[,ax,ay,az][,mx,my,mz]
``encoder.csv``  time,angle[,scored]  or  time,qw,qx,qy,qz[,scored]

Times are decimal seconds, read exactly to the nanosecond. `recording.toml` says what the numbers are.
Folders are written whole or not at all.
"""

import tomllib
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import tomli_w
from scipy.spatial.transform import Rotation

from jaxekf.errors import RecordingError
from jaxekf.files import whole_folder
from jaxekf.recording import (
    Encoder,
    Floats,
    Imu,
    Optical,
    Recording,
    from_scipy,
    to_scipy,
    unit_quaternions,
)
from jaxekf.tables import (
    Table,
    finite_numbers,
    flags,
    need_columns,
    numbers,
    read_table,
    read_times,
    write_csv,
)

SCHEMA_VERSION = 1
_BODY_TO_REFERENCE = "w,x,y,z, body to reference"
_DESCRIBED = {
    "optical": {"kind": "pose", "quaternion": _BODY_TO_REFERENCE, "unit": "1, m"},
    "imu": {"kind": "imu", "frame": "body", "unit": "rad/s, m/s^2"},
    "encoder": {"quaternion": _BODY_TO_REFERENCE},
}
_QUATERNION = ("qw", "qx", "qy", "qz")


def load(path: Path | str) -> Recording:
    """Read a recorded run. Raises `RecordingError`, which names file, line and column."""
    folder = Path(path)
    about = _read_description(folder)
    for label, known in _DESCRIBED.items():
        _check_description(folder, label, about.get(label, {}), known)
    read: dict[str, Any] = {}
    readers: dict[str, Callable[[Table, Mapping[str, Any]], Any]] = {
        "optical": _optical,
        "imu": _imu,
        "encoder": _encoder,
    }
    for label, reader in readers.items():
        file = folder / f"{label}.csv"
        if file.exists() or label in about:
            read[label] = reader(read_table(file), about.get(label, {}))
    if not read:
        raise RecordingError(
            folder, "no stream", "optical.csv, imu.csv or encoder.csv", "another folder"
        )
    info = {key: about[key] for key in about if key not in readers}
    info |= {f"{key}_about": dict(about[key]) for key in readers if key in about}
    name = str(about.get("name", folder.resolve().name))
    return Recording(name, **read, info=info, path=folder)


def _check_description(folder: Path, label: str, section: Any, known: Mapping[str, str]) -> None:
    """What recording.toml says of a stream is what this version reads: nothing is taken for another."""
    file = folder / "recording.toml"
    if not isinstance(section, dict):
        raise RecordingError(
            file, f"{label} = {section!r}", "a section", f"[{label}]", column=label
        )
    for key, expected in known.items():
        if key in section and section[key] != expected:
            raise RecordingError(
                file,
                f"{label}.{key} = {section[key]!r}",
                f"'{expected}'",
                "converting the file",
                column=f"{label}.{key}",
            )


def _read_description(folder: Path) -> Mapping[str, Any]:
    file = folder / "recording.toml"
    if not folder.is_dir():
        raise RecordingError(folder, "no such folder", "a recorded run's folder", "another path")
    if not file.is_file():
        raise RecordingError(
            file, "no such file", "the description of the run", "writing one (see README)"
        )
    try:
        about = tomllib.loads(file.read_text("utf-8-sig"))
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise RecordingError(
            file, f"text that is not TOML ({error})", "TOML", "mending it"
        ) from error
    version = about.get("schema_version")
    if version != SCHEMA_VERSION:
        raise RecordingError(
            file,
            f"schema_version {version!r}",
            f"{SCHEMA_VERSION}",
            "a run written for this version",
            column="schema_version",
        )
    return about


def _optical(table: Table, about: Mapping[str, Any]) -> Optical:
    need_columns(table, [("time", *_QUATERNION)], ("x", "y", "z", "status", "error"))
    q, valid = unit_quaternions(numbers(table, _QUATERNION, blank=True))
    position = None
    if {"x", "y", "z"} <= set(table.columns):
        position = numbers(table, ("x", "y", "z"), blank=True)
    if "status" in table.columns:
        at = table.columns.index("status")
        words = about.get("status_ok", ["ok", "0"])
        words = words if isinstance(words, list) else [words]
        good = {str(word).strip().lower() for word in words}
        valid &= np.array([row[at].strip().lower() in good for row in table.rows])
    return Optical(read_times(table), q, valid, position)


def _imu(table: Table, about: Mapping[str, Any]) -> Imu:
    acceleration, field = ("ax", "ay", "az"), ("mx", "my", "mz")
    need_columns(table, [("time", "gx", "gy", "gz")], acceleration + field)

    def maybe(names: tuple[str, ...]) -> Floats | None:
        return finite_numbers(table, names) if set(names) <= set(table.columns) else None

    return Imu(
        read_times(table),
        finite_numbers(table, ("gx", "gy", "gz")),
        maybe(acceleration),
        maybe(field),
    )


def _encoder(table: Table, about: Mapping[str, Any]) -> Encoder:
    """Attitude of the tool from a joint angle or a quaternion, in the tracker's frame.

    With an angle: ``q = q_zero exp(axis angle)`` where the axis is fixed in the body
    (``acts_on = "body"``), ``exp(axis angle) q_zero`` where it is fixed in the reference.
    ``q_optical_encoder`` turns the encoder's frame into the tracker's.
    """
    need_columns(table, [("time", "angle"), ("time", *_QUATERNION)], ("scored",))
    scored = flags(table, "scored")
    if "angle" in table.columns:
        q = joint_attitude(finite_numbers(table, ("angle",))[:, 0], about, table.path)
        valid = np.ones(len(q), bool)
    else:
        q, valid = unit_quaternions(numbers(table, _QUATERNION, blank=True))
    frame = _fixed_rotation(about, "q_optical_encoder", table.path)
    return Encoder(read_times(table), from_scipy(frame * to_scipy(q)), valid, scored & valid)


def _vector(value: Any, size: int, place: Path | str, name: str) -> Floats:
    """A direction or quaternion from recording.toml, of unit length."""
    try:
        vector = np.asarray(value, float)
    except (TypeError, ValueError):
        vector = np.zeros(0)
    length = np.linalg.norm(vector)
    if vector.shape != (size,) or not np.isfinite(length) or length < 1e-9:
        raise RecordingError(
            place, f"{name} = {value!r}", f"{size} numbers, not all 0", "correcting recording.toml"
        )
    return vector / length


def _fixed_rotation(about: Mapping[str, Any], key: str, place: Path | str) -> Rotation:
    return to_scipy(_vector(about.get(key, [1.0, 0.0, 0.0, 0.0]), 4, place, f"encoder.{key}"))


def joint_attitude(angle: Floats, about: Mapping[str, Any], place: Path | str) -> Floats:
    """Quaternions (N, 4) of a joint's angles in radians, see `_encoder`."""
    if "axis" not in about:
        raise RecordingError(
            place, "a joint angle without an axis", "axis = [x, y, z]", "adding it under [encoder]"
        )
    axis = _vector(about["axis"], 3, place, "encoder.axis")
    turn = Rotation.from_rotvec(angle[:, None] * axis)
    zero = _fixed_rotation(about, "q_zero", place)
    side = about.get("acts_on", "reference")
    if side not in ("reference", "body"):
        raise RecordingError(
            place, f"acts_on = '{side}'", "'reference' or 'body'", "correcting recording.toml"
        )
    return from_scipy(turn * zero if side == "reference" else zero * turn)


# ---------------------------------------------------------------------------------------------
# Writing


def save(
    recording: Recording, path: Path | str, *, overwrite: bool = False, digits: int = 17
) -> Path:
    """Write a run as a folder; hidden tracker samples become blank cells. Returns the folder."""
    about: dict[str, Any] = {"schema_version": SCHEMA_VERSION, "name": recording.name}
    about |= {
        k: v for k, v in recording.info.items() if not k.endswith("_about") and k not in about
    }
    with whole_folder(path, "recording.toml", overwrite=overwrite) as folder:
        for label in ("optical", "imu", "encoder"):
            stream = getattr(recording, label)
            if stream is None:
                continue
            section = dict(recording.info.get(f"{label}_about", {}))
            columns, values, written = _STREAM_COLUMNS[label](stream, section)
            about[label] = written
            write_csv(folder / f"{label}.csv", columns, stream.time_ns, values, digits)
        (folder / "recording.toml").write_text(tomli_w.dumps(about), "utf-8")
    return Path(path)


def _optical_columns(stream: Optical, about: dict[str, Any]) -> Any:
    hidden = ~stream.valid[:, None]
    columns, values = list(_QUATERNION), [np.where(hidden, np.nan, stream.q_ref_body)]
    if stream.position is not None:
        columns += ["x", "y", "z"]
        values.append(np.where(hidden, np.nan, stream.position))
    about.pop("status_ok", None)
    about |= _DESCRIBED["optical"]
    return columns, np.concatenate(values, axis=1), about


def _imu_columns(stream: Imu, about: dict[str, Any]) -> Any:
    columns, values = ["gx", "gy", "gz"], [stream.gyroscope]
    if stream.accelerometer is not None:
        columns += ["ax", "ay", "az"]
        values.append(stream.accelerometer)
    if stream.magnetometer is not None:
        columns += ["mx", "my", "mz"]
        values.append(stream.magnetometer)
    about |= _DESCRIBED["imu"]
    return columns, np.concatenate(values, axis=1), about


def _encoder_columns(stream: Encoder, about: dict[str, Any]) -> Any:
    """A joint angle again where the description is of a joint, else quaternions."""
    if "axis" in about:
        frame = _fixed_rotation(about, "q_optical_encoder", "recording")
        zero = _fixed_rotation(about, "q_zero", "recording")
        q = frame.inv() * to_scipy(stream.q_ref_body)
        on_reference = about.get("acts_on", "reference") == "reference"
        turn = q * zero.inv() if on_reference else zero.inv() * q
        axis = np.asarray(about["axis"], float)
        vector = turn.as_rotvec() @ (axis / np.linalg.norm(axis))
        columns, values = ["angle"], np.unwrap(vector)[:, None]
        about |= {"kind": "joint", "unit": "rad"}
    else:
        columns = list(_QUATERNION)
        values = np.where(~stream.valid[:, None], np.nan, stream.q_ref_body)
        about |= {"kind": "attitude", "unit": "1"} | _DESCRIBED["encoder"]
        about.pop("q_optical_encoder", None)
    if not stream.scored.all():
        columns, values = [*columns, "scored"], np.c_[values, stream.scored.astype(float)]
    return columns, values, about


_STREAM_COLUMNS: dict[str, Callable[[Any, dict[str, Any]], Any]] = {
    "optical": _optical_columns,
    "imu": _imu_columns,
    "encoder": _encoder_columns,
}
