"""Importer of rigid bodies from CSV exports of Vicon Nexus and Vicon Tracker.

Sections follow one another, parted by blank lines. That of rigid bodies is ``Objects`` (Tracker) or
``Segments`` (Nexus): a line with this word, one with the rate in Hz, one with names over their columns,
then ``Frame,Sub Frame,RX,RY,RZ[,RW],TX,TY,TZ``, a line of units, and the samples.
"""

from decimal import Decimal, InvalidOperation
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from jaxekf._support.errors import RecordingError
from jaxekf.io.importers._exports import (
    Lines,
    Rows,
    chosen_tool,
    length_unit,
    pose_stream,
    read_lines,
    stripped,
    timed,
    tracker_alone,
)
from jaxekf.recordings.types import NANOSECONDS, Floats, Recording, from_scipy

_WHAT = "a CSV export of Vicon Nexus or Tracker with a section Objects or Segments"
_SECTIONS = ("objects", "segments")
_VECTOR, _QUATERNION, _PLACE = ("rx", "ry", "rz"), ("rx", "ry", "rz", "rw"), ("tx", "ty", "tz")
_ANGLES = {"rad": 1.0, "deg": np.pi / 180.0}


def load(path: Path | str, *, tool: str | None = None, sort: bool = False) -> Recording:
    """The poses of one object or segment, as a run of a tracker alone.

    `tool` is its name in the export (``Subject:Segment``, or the part behind the colon); it may be left out
    where there is only one. Times are frame numbers over the section's rate, in seconds. ``RX,RY,RZ`` is a
    rotation vector (helical angles), with ``RW`` a quaternion x, y, z, w. Blank cells are occlusions.
    With `sort` rows that are out of order are put in order of time.
    Raises `RecordingError`, which names file, line and column.
    """
    lines = read_lines(path, _WHAT)
    top = _section(lines)
    period = _period(lines, top + 1)
    header = top + 3
    columns = _columns(lines, header)
    names, groups = _groups(lines, top + 2, columns)
    at = chosen_tool(lines, top + 2, names, tool if tool is None else _full(names, tool))
    group = groups[at]
    units = lines.cells[header + 1] + [""] * len(columns)
    turned = "rw" in group
    angle = 1.0 if turned else _angle(lines, header + 1, units[group["rx"]])
    metres = length_unit(lines, header + 1, units[group["tx"]] or "mm", "TX")
    rows = lines.until_blank(header + 1, len(columns))
    source = timed(rows, *rows.times(0, "Frame", period))
    optical, account = pose_stream(
        source,
        _attitude(source.rows, group, angle),
        metres * source.rows.floats([group[n] for n in _PLACE], [n.upper() for n in _PLACE]),
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
            if turned
            else "RX, RY, RZ are a rotation vector (helical angles: axis times angle, in"
            f" {'degrees' if angle < 1.0 else 'radians'}, not Euler angles) that turns the object's"
            " coordinates into the global ones.",
            f"Positions are of the object's origin, in units of {metres:g} m.",
            f"Times are frame numbers over the section's rate of {float(NANOSECONDS / period):g} Hz:"
            " seconds on the tracker's own clock; a pose was taken at its frame.",
            "Which way is up is not in the file: gravity_ref is not set.",
        ],
    }
    return tracker_alone(path, "vicon", optical, account, info)


def _section(lines: Lines) -> int:
    for i, row in enumerate(lines.cells):
        if row[0].lower() in _SECTIONS and not any(row[1:]):
            if i + 5 > len(lines.cells):
                raise RecordingError(
                    lines.path,
                    f"{len(lines.cells) - i - 1} lines below '{row[0]}'",
                    "rate, names, columns, units and samples",
                    "exporting again",
                    line=lines.numbers[i],
                )
            return i
    raise RecordingError(
        lines.path, f"a file that begins with '{lines.cells[0][0]}'", _WHAT, "exporting objects"
    )


def _period(lines: Lines, at: int) -> Decimal:
    """Nanoseconds from frame to frame."""
    cell = lines.cells[at][0]
    try:
        rate = Decimal(cell if lines.delimiter == "," else cell.replace(",", "."))
    except InvalidOperation:
        rate = Decimal(0)
    if not (rate.is_finite() and 0 < rate <= 100_000):
        raise RecordingError(
            lines.path, f"'{cell}'", "the rate in Hz", "exporting again", line=lines.numbers[at]
        )
    return NANOSECONDS / rate


def _columns(lines: Lines, at: int) -> list[str]:
    columns = [cell.lower() for cell in stripped(lines.cells[at])]
    if columns[:1] != ["frame"]:
        raise RecordingError(
            lines.path,
            f"columns {','.join(lines.cells[at][:8])}",
            "Frame,Sub Frame,RX,RY,RZ[,RW],TX,TY,TZ",
            "exporting objects or segments",
            line=lines.numbers[at],
        )
    return columns


def _groups(lines: Lines, at: int, columns: list[str]) -> tuple[list[str], list[dict[str, int]]]:
    """Names over the columns, and the columns below each that has a rotation and a position."""
    titles = lines.cells[at][: len(columns)]
    begins = [i for i, title in enumerate(titles) if title]
    names, groups = [], []
    for begin, end in zip(begins, [*begins[1:], len(columns)], strict=True):
        below = {columns[i]: i for i in range(begin, end)}
        if {*_VECTOR, *_PLACE} <= set(below):
            names.append(titles[begin])
            groups.append(below)
    return names, groups


def _full(names: list[str], tool: str) -> str:
    """The whole name of what may be called by the part behind its colon."""
    short = [name for name in names if name.split(":")[-1].strip().lower() == tool.strip().lower()]
    return short[0] if len(short) == 1 else tool


def _angle(lines: Lines, at: int, unit: str) -> float:
    if unit.lower() not in _ANGLES:
        raise RecordingError(
            lines.path,
            f"the unit of rotation '{unit}'",
            "rad or deg",
            "exporting again",
            line=lines.numbers[at],
            column="RX",
        )
    return _ANGLES[unit.lower()]


def _attitude(rows: Rows, group: dict[str, int], angle: float) -> Floats:
    """Quaternions (N, 4), w x y z; NaN where cells are blank."""
    if "rw" in group:
        values = rows.floats([group[n] for n in _QUATERNION], [n.upper() for n in _QUATERNION])
        return np.roll(values, 1, axis=1)
    vector = angle * rows.floats([group[n] for n in _VECTOR], [n.upper() for n in _VECTOR])
    known = np.isfinite(vector).all(axis=1)
    quaternion = np.full((len(vector), 4), np.nan)
    if known.any():
        quaternion[known] = from_scipy(Rotation.from_rotvec(vector[known]))
    return quaternion
