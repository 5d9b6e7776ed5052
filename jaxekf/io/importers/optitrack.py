"""Importer of rigid bodies from CSV exports of OptiTrack's Motive (format versions 1.1 to 1.25).

The first line holds keys and values; then a header over several lines says of every column what it is of
(type, name, identity) and what it holds (rotation or position, and the axis); then the samples.
"""

from decimal import Decimal
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from jaxekf._support.errors import RecordingError
from jaxekf.io.importers._exports import (
    METRES,
    Lines,
    chosen_tool,
    pose_stream,
    read_lines,
    stripped,
    timed,
    tracker_alone,
)
from jaxekf.recordings.types import NANOSECONDS, Recording

_WHAT = "a CSV export of Motive with rigid bodies"
_BODY = "rigid body"
_COLUMNS = (
    *("rotation x", "rotation y", "rotation z", "rotation w"),
    *("position x", "position y", "position z"),
)


class _Header(NamedTuple):
    """What the lines above the samples say of every column."""

    axes: int
    """The line just above the samples."""
    types: int
    width: int
    parts: list[str]
    """Such as ``rotation x`` or ``mean marker error``, in lower case."""


def load(path: Path | str, *, tool: str | None = None, sort: bool = False) -> Recording:
    """The poses of one rigid body, as a run of a tracker alone.

    `tool` is its name; it may be left out where there is only one. Times are those of the column
    ``Time (Seconds)``, exactly. Blank cells are occlusions. The mean marker error, where it was exported,
    is the reported fit error. With `sort` rows that are out of order are put in order of time. Raises
    `RecordingError`, which names file, line and column, also for rotations that are not quaternions, units
    of length that are not metric, and poses that are not global.
    """
    lines = read_lines(path, _WHAT)
    facts = _facts(lines)
    metres = _check(lines, facts)
    header = _header(lines)
    names, groups = _bodies(lines, header)
    at = chosen_tool(lines, header.types + 1, names, tool)
    group = groups[at]
    rows = lines.body(header.axes, header.width)
    time = next(i for i, cell in enumerate(lines.cells[header.axes]) if cell.lower()[:4] == "time")
    source = timed(rows, *rows.times(time, "Time", Decimal(NANOSECONDS)))
    values = source.rows.floats([group[n] for n in _COLUMNS], [n.title() for n in _COLUMNS])
    error = next((i for part, i in group.items() if "error" in part), None)
    said: dict[str, Any] = {}
    if error is not None:
        said["error"] = metres * source.rows.floats([error], ["Mean Marker Error"])[:, 0]
    optical, account = pose_stream(
        source, np.roll(values[:, :4], 1, axis=1), metres * values[:, 4:], sort=sort, **said
    )
    rate = facts.get("export frame rate", facts.get("capture frame rate", ""))
    info: dict[str, Any] = {
        "dataset": "Motive CSV",
        "tool": names[at],
        "assumptions": [
            f"The body is the frame of the rigid body '{names[at]}' (its pivot); the reference is Motive's"
            " global frame.",
            "Rotations are unit quaternions x, y, z, w (Hamilton) that turn the rigid body's coordinates"
            " into the global ones.",
            f"Positions and marker errors are in units of {metres:g} m"
            + (", as the first line says." if "length units" in facts else ": no unit is stated."),
            "Times are seconds since the capture began, on the tracker's own clock; a pose was taken at"
            " its stamp.",
            "Which way is up is not in the file (Motive's default is y): gravity_ref is not set.",
        ],
    }
    if "capture start time" in facts:
        info["capture_start_time"] = facts["capture start time"]
    if rate:
        info["export_frame_rate"] = rate
    return tracker_alone(path, "motive", optical, account, info)


def _facts(lines: Lines) -> dict[str, str]:
    """Keys, in lower case, and values of the first line."""
    first = lines.cells[0]
    if first[0].lower() != "format version":
        raise RecordingError(
            lines.path,
            f"a file that begins with '{first[0]}'",
            "Format Version, the first line of an export of Motive",
            "exporting with header information",
            line=lines.numbers[0],
        )
    return {key.lower(): value for key, value in zip(first[::2], first[1::2], strict=False)}


def _check(lines: Lines, facts: dict[str, str]) -> float:
    """Metres in a unit of the file; raise where rotations, units or space are others than are read."""
    unit = facts.get("length units", "meters")
    wanted = {
        "rotation type": (facts.get("rotation type", "Quaternion"), ("quaternion",)),
        "length units": (unit, tuple(unit for unit in METRES if len(unit) > 2)),
        "coordinate space": (facts.get("coordinate space", "Global"), ("global",)),
    }
    for key, (value, known) in wanted.items():
        if value.lower() not in known:
            raise RecordingError(
                lines.path,
                f"{key.title()} {value}",
                " or ".join(word.title() for word in known),
                "exporting with that setting",
                line=lines.numbers[0],
                column=key.title(),
            )
    return METRES[unit.lower()]


def _header(lines: Lines) -> _Header:
    axes = next((i for i, row in enumerate(lines.cells[:20]) if row[0].lower() == "frame"), None)
    types = next(
        (i for i, row in enumerate(lines.cells[:20]) if _BODY in {cell.lower() for cell in row}),
        None,
    )
    if axes is None or types is None or types + 2 > axes - 1 or axes < 4:
        raise RecordingError(
            lines.path,
            "no column of the type Rigid Body above a line Frame,Time (Seconds)",
            _WHAT,
            "exporting rigid bodies with header information",
            line=lines.numbers[0],
        )
    if not any(cell.lower()[:4] == "time" for cell in lines.cells[axes]):
        raise RecordingError(
            lines.path, "no column Time (Seconds)", "one", "exporting again",
            line=lines.numbers[axes],
        )  # fmt: skip
    width = max(len(stripped(row)) for row in lines.cells[types : axes + 1])
    whole = [row + [""] * width for row in (lines.cells[axes - 1], lines.cells[axes])]
    parts = [f"{whole[0][i]} {whole[1][i]}".strip().lower() for i in range(width)]
    return _Header(axes, types, width, parts)


def _bodies(lines: Lines, header: _Header) -> tuple[list[str], list[dict[str, int]]]:
    """Names of the rigid bodies with a rotation and a position, and their columns by what they hold."""
    kinds, titles = (
        row + [""] * header.width for row in lines.cells[header.types : header.types + 2]
    )
    found: dict[str, dict[str, int]] = {}
    for i in range(header.width):
        if kinds[i].lower() == _BODY and titles[i]:
            found.setdefault(titles[i], {})[header.parts[i]] = i
    whole = {name: group for name, group in found.items() if set(_COLUMNS) <= set(group)}
    if found and not whole:
        lacking = sorted(set(_COLUMNS) - set(next(iter(found.values()))))
        raise RecordingError(
            lines.path,
            f"a rigid body without {', '.join(lacking)}",
            "rotation X, Y, Z, W and position X, Y, Z",
            "exporting both, rotations as quaternions",
            line=lines.numbers[header.axes],
        )
    return list(whole), list(whole.values())
