"""Importer of rigid bodies from CSV exports of Vicon Nexus and Vicon Tracker.

A file has sections with blank lines between them. The section of rigid bodies is ``Objects`` (Tracker) or
``Segments`` (Nexus): a line with this word, one with the rate in Hz, one with names above their columns,
then ``Frame,Sub Frame,RX,RY,RZ[,RW],TX,TY,TZ``, a line of units, and the samples.
"""

import re
from decimal import Decimal, InvalidOperation
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from jaxekf._support.errors import RecordingError
from jaxekf.io.csv_table import times_or_blank
from jaxekf.io.importers._exports import (
    Export,
    HeaderLine,
    StampedRows,
    chosen_tool,
    length_unit,
    pose_stream,
    read_export,
    stamped_rows,
    tracker_alone,
)
from jaxekf.recordings.types import NANOSECONDS, Floats, Recording, from_scipy

_EXPECTED = "a CSV export of Vicon Nexus or Tracker with a section Objects or Segments"
_SECTION = re.compile(rb'^[ \t"]*(objects|segments)[ \t",;]*$', re.IGNORECASE | re.MULTILINE)
_NEXT_SECTION = re.compile(rb"\n[ \t,;]*\n(?=[\s,;]*[^\s,;])")
"""A blank line above other content."""
_VECTOR, _QUATERNION, _PLACE = ("rx", "ry", "rz"), ("rx", "ry", "rz", "rw"), ("tx", "ty", "tz")
_ANGLES = {"rad": 1.0, "deg": np.pi / 180.0}


def load(path: Path | str, *, tool: str | None = None, sort: bool = False) -> Recording:
    """Read the poses of one object or segment, as a run of a tracker alone.

    ``RX,RY,RZ`` is a rotation vector (helical angles), with ``RW`` a quaternion x, y, z, w. Blank cells are
    occlusions.

    Parameters
    ----------
    path : path
        A CSV export of Nexus or Tracker.
    tool : str, optional
        Name of the object or segment (``Subject:Segment``, or the part after the colon); needed if there
        are several.
    sort : bool
        Sort rows by time that are out of order.

    Returns
    -------
    Recording
        Times in ns: frame numbers divided by the section's rate; attitude w, x, y, z, body to Vicon's
        global frame; position in metres.

    Raises
    ------
    RecordingError
        If the file is not such an export; names file, line and column.
    """
    export = read_export(path, _EXPECTED)
    _, rate, names_line, header, units = _section(export)
    period = _period(export, rate)
    columns = _columns(export, header)
    names, groups = _groups(names_line, columns)
    at = chosen_tool(export, names_line, names, tool if tool is None else _full_name(names, tool))
    group = groups[at]
    quaternions = "rw" in group
    angle = 1.0 if quaternions else _angle(export, units, units.cell(group["rx"]))
    metres = length_unit(export, units, units.cell(group["tx"]) or "mm", "TX")
    following = _NEXT_SECTION.search(export.content.data, units.end - 1)
    end = None if following is None else following.start() + 1
    table = export.table(units, len(columns), end).named({0: "Frame"})
    source = stamped_rows(table, *times_or_blank(table, "Frame", period))
    optical, account = pose_stream(
        source,
        _attitude(source, group, angle),
        metres * source.floats([group[n] for n in _PLACE], [n.upper() for n in _PLACE]),
        sort=sort,
    )
    info = {
        "dataset": "Vicon CSV",
        "tool": names[at],
        "sampling_rate_hz": float(NANOSECONDS / period),
        "assumptions": [
            f"The body is the frame of the object or segment '{names[at]}'; the reference is Vicon's global"
            " frame.",
            "RX, RY, RZ, RW are a unit quaternion x, y, z, w (Hamilton) that turns the object's coordinates"
            " into the global ones."
            if quaternions
            else "RX, RY, RZ are a rotation vector (helical angles: axis times angle, in"
            f" {'degrees' if angle < 1.0 else 'radians'}, not Euler angles) that turns the object's"
            " coordinates into the global ones.",
            f"Positions are of the object's origin, in units of {metres:g} m.",
            f"Times are frame numbers over the section's rate of {float(NANOSECONDS / period):g} Hz:"
            " seconds on the tracker's own clock; a pose was taken at its frame.",
            "The file does not state the direction of gravity: gravity_ref is not set.",
        ],
    }
    return tracker_alone(path, "vicon", optical, account, info)


def _section(export: Export) -> list[HeaderLine]:
    """The section's first lines: its word, the rate, names, columns and units."""
    found = _SECTION.search(export.content.data)
    if found is None:
        first = export.head[0].cells[0]
        raise RecordingError(
            export.path, f"a file that begins with '{first}'", _EXPECTED, "exporting objects"
        )
    lines = export.lines(found.start(), 5)
    if len(lines) < 5:
        got = f"{len(lines) - 1} lines below '{lines[0].cells[0]}'"
        expected = "rate, names, columns, units and samples"
        raise export.error(lines[0], got, expected, "exporting again")
    return lines


def _period(export: Export, line: HeaderLine) -> Decimal:
    """Nanoseconds from frame to frame."""
    cell = line.cells[0]
    try:
        rate = Decimal(cell if export.delimiter == "," else cell.replace(",", "."))
    except InvalidOperation:
        rate = Decimal(0)
    if not (rate.is_finite() and 0 < rate <= 100_000):
        raise export.error(line, f"'{cell}'", "the rate in Hz", "exporting again")
    return NANOSECONDS / rate


def _columns(export: Export, line: HeaderLine) -> list[str]:
    columns = [cell.lower() for cell in line.cells]
    if columns[:1] != ["frame"]:
        got = f"columns {','.join(line.cells[:8])}"
        expected = "Frame,Sub Frame,RX,RY,RZ[,RW],TX,TY,TZ"
        raise export.error(line, got, expected, "exporting objects or segments")
    return columns


def _groups(line: HeaderLine, columns: list[str]) -> tuple[list[str], list[dict[str, int]]]:
    """Names above the columns, and the columns below each that has a rotation and a position."""
    begins = [i for i, title in enumerate(line.cells[: len(columns)]) if title]
    names, groups = [], []
    for begin, end in zip(begins, [*begins[1:], len(columns)], strict=True):
        below = {columns[i]: i for i in range(begin, end)}
        if {*_VECTOR, *_PLACE} <= set(below):
            names.append(line.cells[begin])
            groups.append(below)
    return names, groups


def _full_name(names: list[str], tool: str) -> str:
    """The whole name of a tool that may be given by the part after its colon."""
    short = [name for name in names if name.split(":")[-1].strip().lower() == tool.strip().lower()]
    return short[0] if len(short) == 1 else tool


def _angle(export: Export, line: HeaderLine, unit: str) -> float:
    """Radians in a unit."""
    if unit.lower() not in _ANGLES:
        raise export.error(
            line, f"the unit of rotation '{unit}'", "rad or deg", "exporting again", "RX"
        )
    return _ANGLES[unit.lower()]


def _attitude(source: StampedRows, group: dict[str, int], angle: float) -> Floats:
    """Quaternions (N, 4), w x y z; NaN for blank cells."""
    parts = _QUATERNION if "rw" in group else _VECTOR
    values = source.floats([group[n] for n in parts], [n.upper() for n in parts])
    if "rw" in group:
        return np.roll(values, 1, axis=1)
    vector = angle * values
    known = np.isfinite(vector).all(axis=1)
    quaternion = np.full((len(vector), 4), np.nan)
    if known.any():
        quaternion[known] = from_scipy(Rotation.from_rotvec(vector[known]))
    return quaternion
