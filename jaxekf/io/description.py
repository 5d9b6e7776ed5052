"""`recording.toml`: what the numbers of a recorded run are."""

import math
import tomllib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from jaxekf._support.errors import RecordingError
from jaxekf.recordings.facts import FILE, as_number, finite_number, wrong_entry
from jaxekf.recordings.types import NANOSECONDS

SCHEMA_VERSION = 1
LANDMARKS = "landmarks.csv"
"""The places of what `camera.csv` names."""
_LONGEST_LATENCY_S = 3600.0


def read_description(folder: Path) -> dict[str, Any]:
    """The entries of a folder's `recording.toml`, of a version that is known."""
    file = folder / FILE
    if not folder.is_dir():
        raise RecordingError(folder, "no such folder", "a recorded run's folder", "another path")
    if not file.is_file():
        raise RecordingError(
            file, "no such file", "the description of the run", "writing one (see docs/formats.md)"
        )
    try:
        about = tomllib.loads(file.read_text("utf-8-sig"))
    except (tomllib.TOMLDecodeError, UnicodeDecodeError, RecursionError, OSError) as error:
        raise RecordingError(
            file, f"text that is not TOML ({error})", "TOML", "mending it"
        ) from error
    version = about.get("schema_version")
    if version != SCHEMA_VERSION:
        got = f"schema_version {version!r}"
        hint = "a run written for this version"
        raise RecordingError(file, got, f"{SCHEMA_VERSION}", hint, column="schema_version")
    return about


class Source(NamedTuple):
    """A stream's section of `recording.toml`, and whether its rows are sorted."""

    about: Mapping[str, Any]
    """Its section of `recording.toml`."""
    place: Path
    """That file."""
    sort: bool
    """Whether rows that are out of order are sorted."""


def check_section(file: Path, label: str, section: Any, known: Mapping[str, str]) -> None:
    """A stated kind and frame are those that this version reads."""
    if not isinstance(section, dict):
        raise wrong_entry(file, label, section, "a section", f"[{label}]")
    for key, expected in known.items():
        if key in ("unit", "quaternion"):
            continue  # `stated` reads these.
        if key in section and section[key] != expected:
            hint = "converting the file"
            raise wrong_entry(file, f"{label}.{key}", section[key], f"'{expected}'", hint)


def words(
    about: Mapping[str, Any], label: str, key: str, default: Sequence[str], place: Path | str
) -> Sequence[str]:
    """A word or a list of words or numbers."""
    value = about.get(key, list(default))
    value = value if isinstance(value, list) else [value]
    if not all(isinstance(word, str | int | float) for word in value) or not value:
        raise wrong_entry(place, f"{label}.{key}", value, "words", f'{key} = ["ok"]')
    return [str(word) for word in value]


def limit(about: Mapping[str, Any], label: str, key: str, place: Path | str) -> float:
    """A positive number that something may not exceed; infinite where none is stated."""
    if key not in about:
        return math.inf
    value = finite_number(about[key], place, f"{label}.{key}")
    if value <= 0.0:
        raise wrong_entry(place, f"{label}.{key}", value, "a positive number")
    return value


def latency_ns(about: Mapping[str, Any], label: str, place: Path | str) -> int:
    """The `latency` of a stream, seconds in the file, to the nanosecond; 0 where none is stated."""
    value = about.get("latency", 0.0)
    seconds = as_number(value)
    if seconds is None or not 0.0 <= seconds <= _LONGEST_LATENCY_S:
        expected = f"finite seconds, 0 or more, {_LONGEST_LATENCY_S:g} at most"
        hint = f"correcting {FILE}"
        if seconds is not None and seconds < 0.0:
            hint = f"time_shift = {-seconds:g} there, which is added to the stamps and has any sign"
        raise wrong_entry(place, f"{label}.latency", value, expected, hint)
    return round(seconds * NANOSECONDS)


def latency_entry(latency_ns: int) -> dict[str, float]:
    """The entry that is read as such a latency; none for none."""
    return {"latency": latency_ns / NANOSECONDS} if latency_ns else {}
