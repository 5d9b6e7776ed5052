"""`recording.toml`: what the numbers of a recorded run are, each entry checked and named by its key."""

import math
import tomllib
from collections.abc import Mapping, Sequence
from numbers import Real
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from jaxekf.errors import RecordingError
from jaxekf.recording import NANOSECONDS, Floats

SCHEMA_VERSION = 1
FILE = "recording.toml"
LANDMARKS = "landmarks.csv"
"""The places of what `camera.csv` names."""
BODY_TO_REFERENCE = "w,x,y,z, body to reference"
_MENDING = f"correcting {FILE}"
_LONGEST_LATENCY_S = 3600.0


def read_description(folder: Path) -> dict[str, Any]:
    """The entries of a folder's `recording.toml`, of a version that is known."""
    file = folder / FILE
    if not folder.is_dir():
        raise RecordingError(folder, "no such folder", "a recorded run's folder", "another path")
    if not file.is_file():
        raise RecordingError(
            file, "no such file", "the description of the run", "writing one (see README)"
        )
    try:
        about = tomllib.loads(file.read_text("utf-8-sig"))
    except (tomllib.TOMLDecodeError, UnicodeDecodeError, RecursionError, OSError) as error:
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


class Source(NamedTuple):
    """What is said of a stream, and how it is to be read."""

    about: Mapping[str, Any]
    """Its section of `recording.toml`."""
    place: Path
    """That file."""
    sort: bool
    """Whether rows that are out of order are sorted."""


def check_section(file: Path, label: str, section: Any, known: Mapping[str, str]) -> None:
    """What is said of a stream's kind and frame is what this version reads, not taken for it."""
    if not isinstance(section, dict):
        raise RecordingError(
            file, f"{label} = {section!r}", "a section", f"[{label}]", column=label
        )
    for key, expected in known.items():
        if key in ("unit", "quaternion"):
            continue  # `stated` reads these.
        if key in section and section[key] != expected:
            raise RecordingError(
                file,
                f"{label}.{key} = {section[key]!r}",
                f"'{expected}'",
                "converting the file",
                column=f"{label}.{key}",
            )


def finite_number(value: Any, place: Path | str, key: str) -> float:
    """A finite number."""
    number = _number(value)
    if number is None:
        raise RecordingError(place, f"{key} = {value!r}", "a finite number", _MENDING, column=key)
    return number


def finite_vector(value: Any, size: int, place: Path | str, key: str) -> Floats:
    """A vector (size,) of finite numbers."""
    vector = _vector(value, size)
    if vector is None:
        raise RecordingError(
            place, f"{key} = {value!r}", f"{size} finite numbers", _MENDING, column=key
        )
    return vector


def nonzero_vector(value: Any, size: int, place: Path | str, key: str) -> Floats:
    """A vector (size,) of finite numbers that has a length, and so a direction."""
    vector = _vector(value, size)
    if vector is None or np.linalg.norm(vector) < 1e-9:
        raise RecordingError(
            place,
            f"{key} = {value!r}",
            f"{size} finite numbers, not all 0",
            _MENDING,
            column=key,
        )
    return vector


def unit_vector(value: Any, size: int, place: Path | str, key: str) -> Floats:
    """A direction or quaternion (size,), scaled to unit length.

    One that has it to rounding is left as it is, so that what is saved is read again exactly.
    """
    vector = nonzero_vector(value, size, place, key)
    length = np.linalg.norm(vector)
    return vector if abs(length - 1.0) < 1e-15 else vector / length


def words(
    about: Mapping[str, Any], label: str, key: str, default: Sequence[str], place: Path | str
) -> Sequence[str]:
    """A word or a list of words or numbers."""
    value = about.get(key, list(default))
    value = value if isinstance(value, list) else [value]
    if not all(isinstance(word, str | int | float) for word in value) or not value:
        name = f"{label}.{key}"
        raise RecordingError(place, f"{name} = {value!r}", "words", f'{key} = ["ok"]', column=name)
    return [str(word) for word in value]


def limit(about: Mapping[str, Any], label: str, key: str, place: Path | str) -> float:
    """A positive number that something may not exceed; infinite where none is stated."""
    if key not in about:
        return math.inf
    value = finite_number(about[key], place, f"{label}.{key}")
    if value <= 0.0:
        name = f"{label}.{key}"
        raise RecordingError(
            place, f"{name} = {value!r}", "a positive number", _MENDING, column=name
        )
    return value


def latency_ns(about: Mapping[str, Any], label: str, place: Path | str) -> int:
    """The `latency` of a stream, seconds in the file, to the nanosecond; 0 where none is stated."""
    value = about.get("latency", 0.0)
    seconds = _number(value)
    if seconds is None or not 0.0 <= seconds <= _LONGEST_LATENCY_S:
        key = f"{label}.latency"
        raise RecordingError(
            place,
            f"{key} = {value!r}",
            f"finite seconds, 0 or more, {_LONGEST_LATENCY_S:g} at most",
            _MENDING,
            column=key,
        )
    return round(seconds * NANOSECONDS)


def latency_entry(latency_ns: int) -> dict[str, float]:
    """The entry that is read as such a latency; none for none."""
    return {"latency": latency_ns / NANOSECONDS} if latency_ns else {}


def facts(entries: Mapping[str, Any], place: Path | str) -> dict[str, list[float]]:
    """Those of a run's own entries whose meaning is fixed, as lists of floats.

    ``gravity_ref``    [x, y, z]     free fall in the reference frame, m/s^2, not 0
    ``field_ref``      [x, y, z]     of the magnetic field there, of which the horizontal direction counts
    ``p_body_object``  [x, y, z]     the point of the tool that is asked for, in the body, m
    ``q_body_object``  [w, x, y, z]  from its frame to the body's, scaled to unit length
    """
    known = {
        "gravity_ref": (nonzero_vector, 3),
        "field_ref": (nonzero_vector, 3),
        "p_body_object": (finite_vector, 3),
        "q_body_object": (unit_vector, 4),
    }
    return {
        key: read(entries[key], size, place, key).tolist()
        for key, (read, size) in known.items()
        if key in entries
    }


def _vector(value: Any, size: int) -> Floats | None:
    items = list(value) if isinstance(value, (list, tuple, np.ndarray)) else []
    found = [number for number in map(_number, items) if number is not None]
    return np.array(found) if len(found) == len(items) == size else None


def _number(value: Any) -> float | None:
    """A finite float of TOML's numbers; True and '1' are none."""
    if isinstance(value, bool) or not isinstance(value, Real):
        return None
    try:
        number = float(value)
    except OverflowError:
        return None
    return number if math.isfinite(number) else None
