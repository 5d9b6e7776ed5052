"""What a section of `recording.toml` states of a stream's file: its columns, units and frames.

``file``        name of the CSV file in the run's folder
``columns``     our names of columns and the file's, ``{ time = "Time [ms]", qw = "Rot W" }``; or, of a file
                without a header, a list of our names in their order, "" for what is not read
``skip_lines``  lines before the header
``delimiter``   ",", ";" or a tab, where the header does not tell
``time_unit``   "s", "ms", "us" or "ns"
``unit``        of the numbers, such as "deg/s, g" or "1, mm"
``quaternion``  order and direction, such as "x,y,z,w, body to reference"
"""

from collections.abc import Mapping, Sequence
from difflib import get_close_matches
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from jaxekf._support.errors import RecordingError
from jaxekf.io._csv_text import DELIMITERS
from jaxekf.io.csv_table import QUATERNION, TIME_UNITS, Layout
from jaxekf.recordings.facts import BODY_TO_REFERENCE, FILE
from jaxekf.recordings.types import STREAMS, Floats

RUN_KEYS = (
    *STREAMS,
    "schema_version",
    "name",
    "sha256",
    "trust_units",
    "gravity_ref",
    "field_ref",
    "p_body_object",
    "q_body_object",
)
SECTION_KEYS = (
    "kind",
    "frame",
    "unit",
    "quaternion",
    "file",
    "columns",
    "skip_lines",
    "delimiter",
    "time_unit",
    "latency",
    "status_ok",
    "error_max",
    "p_body_tool",
    "quality_min",
    "geometry",
    "focal",
    "centre",
    "radial",
    "p_body_camera",
    "q_body_camera",
    "axis",
    "acts_on",
    "q_zero",
    "q_optical_encoder",
    "p_optical_encoder",
)
HELD = ("file", "columns", "skip_lines", "delimiter", "time_unit")
"""Entries that are of no more use once a file is read."""
_LENGTH = {"m": 1.0, "cm": 1e-2, "mm": 1e-3}
_RATE = {"rad/s": 1.0, "deg/s": np.pi / 180.0}
_FORCE = {"m/s^2": 1.0, "g": 9.80665, "mm/s^2": 1e-3}
_ANGLE = {"rad": 1.0, "deg": np.pi / 180.0}
_ONE = {"1": 1.0}
_PIXEL = {"px": 1.0}
_UNITS: dict[str, tuple[dict[str, float], ...]] = {
    "imu": (_RATE, _FORCE),
    "optical": (_ONE, _LENGTH),
    "markers": (_LENGTH,),
    "camera": (_LENGTH, _PIXEL),
    "joint": (_ANGLE,),
    "encoder": (_ONE, _LENGTH),
}
_DIRECTIONS = ("body to reference", "reference to body")


class Turning(NamedTuple):
    """How a quaternion's four numbers stand."""

    order: tuple[str, ...]
    inverse: bool

    def columns(self, columns: Sequence[str]) -> tuple[str, ...]:
        """Which of the columns qw, qx, qy, qz, as they stand in a file, hold w, x, y and z.

        Their names say so, unless an order is stated that is neither the usual one nor theirs.
        """
        there = [name for name in columns if name in QUATERNION]
        if self.order == tuple("wxyz") or [f"q{axis}" for axis in self.order] == there:
            return QUATERNION
        return tuple(there[self.order.index(axis)] for axis in "wxyz")

    def standard(self, values: Floats) -> Floats:
        """Numbers (N, 4), w, x, y, z, as from body to reference."""
        return values * np.array([1.0, -1.0, -1.0, -1.0]) if self.inverse else values


def check_keys(entries: Mapping[str, Any], label: str, place: Path | str) -> None:
    """Raise `RecordingError` for an entry that is nearly one that means something; others are facts."""
    known = SECTION_KEYS if label else RUN_KEYS
    for key in entries:
        near = [] if key in known else get_close_matches(key, known, 1, 0.8)
        if near:
            head = f"{label}." if label else ""
            raise RecordingError(
                place,
                f"{head}{key}",
                f"{head}{near[0]}",
                "correcting the name, or another one for a fact of your own",
                column=f"{head}{key}",
            )


def layout(label: str, about: Mapping[str, Any], place: Path | str) -> Layout:
    """Where a stream's numbers are. Raises `RecordingError` for an entry that says nothing."""

    def stated(key: str, kind: type, expected: str, default: Any) -> Any:
        value = about.get(key, default)
        if value is not default and (not isinstance(value, kind) or isinstance(value, bool)):
            raise _wrong(place, label, key, value, expected)
        return value

    file = stated("file", str, "the name of a file in the run's folder", None)
    if file is not None and (not file or Path(file).name != file):
        raise _wrong(place, label, "file", file, "the name of a file in the run's folder")
    skip = stated("skip_lines", int, "a number of lines, 0 or more", 0)
    if skip < 0:
        raise _wrong(place, label, "skip_lines", skip, "a number of lines, 0 or more")
    delimiter = stated("delimiter", str, "one of , ; and tab", None)
    if delimiter is not None and delimiter not in DELIMITERS:
        raise _wrong(place, label, "delimiter", delimiter, "one of , ; and tab")
    unit = stated("time_unit", str, f"one of {', '.join(TIME_UNITS)}", "s")
    if unit not in TIME_UNITS:
        raise _wrong(place, label, "time_unit", unit, f"one of {', '.join(TIME_UNITS)}")
    columns = about.get("columns")
    if isinstance(columns, list) and columns and all(isinstance(name, str) for name in columns):
        header = tuple(name.strip() for name in columns)
        return Layout(file, None, header, skip, delimiter, unit)
    if columns is not None and not _is_renaming(columns):
        expected = "our names and the file's, { time = 'theirs' }, or a list of our names"
        raise _wrong(place, label, "columns", columns, expected)
    return Layout(file, dict(columns) if columns else None, None, skip, delimiter, unit)


def _is_renaming(columns: Any) -> bool:
    return (
        isinstance(columns, dict)
        and bool(columns)
        and all(isinstance(name, str) and name for name in columns.values())
    )


def factors(label: str, about: Mapping[str, Any], place: Path | str) -> tuple[float, ...]:
    """What each of a stream's units, ``unit = "deg/s, g"``, is in SI; those that are not stated are."""
    known = _UNITS[label]
    section = "encoder" if label == "joint" else label
    value = about.get("unit")
    parts = [part.strip() for part in value.split(",")] if isinstance(value, str) else []
    good = all(part in units for part, units in zip(parts, known, strict=False))
    # What is beyond, such as a magnetometer's, is not used.
    if value is not None and (not parts or not good):
        expected = ", then ".join(" or ".join(units) for units in known)
        raise _wrong(place, section, "unit", value, expected)
    told = [units[part] for part, units in zip(parts, known, strict=False)]
    return (*told, *[1.0] * (len(known) - len(told)))


def scaled(values: Floats, factor: float) -> Floats:
    """Numbers in SI; the same array, no copy, where they are."""
    return values if factor == 1.0 else factor * values


def turning(label: str, about: Mapping[str, Any], place: Path | str) -> Turning:
    """Order and direction of a stream's quaternions, ``quaternion = "w,x,y,z, body to reference"``."""
    value = about.get("quaternion", BODY_TO_REFERENCE)
    parts = [part.strip() for part in value.split(",")] if isinstance(value, str) else []
    if parts in ([d] for d in _DIRECTIONS):
        parts = [*"wxyz", *parts]
    order, direction = tuple(parts[:4]), parts[4:] or [_DIRECTIONS[0]]
    if sorted(order) != ["w", "x", "y", "z"] or direction not in ([d] for d in _DIRECTIONS):
        expected = f"'{BODY_TO_REFERENCE}', or another order, or 'reference to body'"
        raise _wrong(place, label, "quaternion", value, expected)
    return Turning(order, direction == [_DIRECTIONS[1]])


def _wrong(place: Path | str, label: str, key: str, value: Any, expected: str) -> RecordingError:
    name = f"{label}.{key}"
    return RecordingError(place, f"{name} = {value!r}", expected, f"correcting {FILE}", column=name)
