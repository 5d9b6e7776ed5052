"""Entries that the section of every stream in `recording.toml` may have: its file, columns and units."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from difflib import get_close_matches
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from jaxekf._support.errors import RecordingError
from jaxekf.io._csv_text import DELIMITERS
from jaxekf.io._stamp_repair import ENTRIES
from jaxekf.io.csv_table import QUATERNION, TIME_UNITS, Layout
from jaxekf.recordings.facts import BODY_TO_REFERENCE, wrong_entry
from jaxekf.recordings.types import Floats

COMMON = {
    "kind": "kind of the stream, checked where it is stated",
    "frame": "frame of the numbers, checked where it is stated",
    "unit": 'units of the numbers in the order of the columns, such as "deg/s, g" (default: SI)',
    "quaternion": f'order and direction (default "{BODY_TO_REFERENCE}")',
    "file": "name of the CSV file in the run's folder (default: the stream's name)",
    "columns": 'our names of columns and the file\'s, `{ time = "Time [ms]" }`; for a file without a'
    ' header a list of our names in their order, "" for a column that is not read',
    "skip_lines": "number of lines before the header (default 0)",
    "delimiter": 'one of "," ";" and tab (default: as the header shows)',
    "time_unit": 'unit of the times: "s", "ms", "us" or "ns" (default "s")',
    **ENTRIES,
}
"""Entries of every stream's section, and what they mean."""
OF_THE_FILE = ("file", "columns", "skip_lines", "delimiter", "time_unit", *ENTRIES)
"""Entries that are of no more use once a file is read."""
_DIRECTIONS = ("body to reference", "reference to body")


class Turning(NamedTuple):
    """Order and direction of a quaternion's four numbers."""

    order: tuple[str, ...]
    inverse: bool

    def columns(self, columns: Sequence[str]) -> tuple[str, ...]:
        """Columns of a file that hold w, x, y and z.

        These are qw, qx, qy, qz, unless an order is stated that is neither the usual one nor that of the
        columns in the file.
        """
        there = [name for name in columns if name in QUATERNION]
        if self.order == tuple("wxyz") or [f"q{axis}" for axis in self.order] == there:
            return QUATERNION
        return tuple(there[self.order.index(axis)] for axis in "wxyz")

    def standard(self, values: Floats) -> Floats:
        """Numbers (N, 4), w, x, y, z, as from body to reference."""
        return values * np.array([1.0, -1.0, -1.0, -1.0]) if self.inverse else values


def check_keys(
    entries: Mapping[str, Any], label: str, place: Path | str, known: Iterable[str]
) -> None:
    """Raise `RecordingError` for an entry that is nearly one of those `known`; others are facts."""
    names = list(known)
    for key in entries:
        near = [] if key in names else get_close_matches(key, names, 1, 0.8)
        if near:
            head = f"{label}." if label else ""
            got = f"{head}{key}"
            hint = "correcting the name, or another one for a fact of your own"
            raise RecordingError(place, got, f"{head}{near[0]}", hint, column=f"{head}{key}")


def layout(label: str, about: Mapping[str, Any], place: Path | str) -> Layout:
    """Layout of a stream's file. Raises `RecordingError` for an entry of another form."""

    def stated(key: str, kind: type, good: Callable[[Any], bool], expected: str) -> Any:
        value = about.get(key)
        right = isinstance(value, kind) and not isinstance(value, bool) and good(value)
        if key in about and not right:
            raise wrong_entry(place, f"{label}.{key}", value, expected)
        return value

    a_file = "the name of a file in the run's folder"
    file = stated("file", str, lambda name: bool(name) and Path(name).name == name, a_file)
    skip = stated("skip_lines", int, lambda n: n >= 0, "a number of lines, 0 or more") or 0
    delimiter = stated("delimiter", str, lambda mark: mark in DELIMITERS, "one of , ; and tab")
    units = f"one of {', '.join(TIME_UNITS)}"
    unit = stated("time_unit", str, lambda unit: unit in TIME_UNITS, units) or "s"
    columns = about.get("columns")
    if isinstance(columns, list) and columns and all(isinstance(name, str) for name in columns):
        header = tuple(name.strip() for name in columns)
        return Layout(file, None, header, skip, delimiter, unit)
    if columns is not None and not _is_renaming(columns):
        expected = "our names and the file's, { time = 'theirs' }, or a list of our names"
        raise wrong_entry(place, f"{label}.columns", columns, expected)
    return Layout(file, dict(columns) if columns else None, None, skip, delimiter, unit)


def _is_renaming(columns: Any) -> bool:
    return (
        isinstance(columns, dict)
        and bool(columns)
        and all(isinstance(name, str) and name for name in columns.values())
    )


def turning(label: str, about: Mapping[str, Any], place: Path | str) -> Turning:
    """Order and direction of a stream's quaternions, ``quaternion = "w,x,y,z, body to reference"``."""
    value = about.get("quaternion", BODY_TO_REFERENCE)
    parts = [part.strip() for part in value.split(",")] if isinstance(value, str) else []
    if parts in ([d] for d in _DIRECTIONS):
        parts = [*"wxyz", *parts]
    order, direction = tuple(parts[:4]), parts[4:] or [_DIRECTIONS[0]]
    if sorted(order) != ["w", "x", "y", "z"] or direction not in ([d] for d in _DIRECTIONS):
        expected = f"'{BODY_TO_REFERENCE}', or another order, or 'reference to body'"
        raise wrong_entry(place, f"{label}.quaternion", value, expected)
    return Turning(order, direction == [_DIRECTIONS[1]])
