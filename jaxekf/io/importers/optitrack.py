"""Importer of rigid bodies from CSV exports of OptiTrack's Motive (format versions 1.1 to 1.25).

The first line holds keys and values. A header of several lines then gives for each column the type, name
and identity of its object, the quantity (rotation or position) and the axis. The samples follow.
"""

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from jaxekf.io.csv_table import times_or_blank
from jaxekf.io.importers._exports import (
    METRES,
    Export,
    HeaderLine,
    chosen_tool,
    pose_stream,
    read_export,
    stamped_rows,
    tracker_alone,
)
from jaxekf.recordings.types import NANOSECONDS, Recording

_EXPECTED = "a CSV export of Motive with rigid bodies"
_BODY = "rigid body"
_COLUMNS = (
    *("rotation x", "rotation y", "rotation z", "rotation w"),
    *("position x", "position y", "position z"),
)


class _Header(NamedTuple):
    """The lines above the samples."""

    types: HeaderLine
    names: HeaderLine
    axes: HeaderLine
    """The last line of the header."""
    quantities: list[str]
    """Content of each column in lower case, such as ``rotation x`` or ``mean marker error``."""


def load(path: Path | str, *, tool: str | None = None, sort: bool = False) -> Recording:
    """Read the poses of one rigid body, as a run of a tracker alone.

    Blank cells are occlusions. The mean marker error, if it was exported, is the reported fit error.

    Parameters
    ----------
    path : path
        A CSV export of Motive.
    tool : str, optional
        Name of the rigid body; needed if there are several.
    sort : bool
        Sort rows by time that are out of order.

    Returns
    -------
    Recording
        Times in ns, exact, from the column ``Time (Seconds)``; attitude w, x, y, z, body to Motive's global
        frame; position and error in metres.

    Raises
    ------
    RecordingError
        If the file is not such an export, also for rotations that are not quaternions, units of length that
        are not metric and poses that are not global; names file, line and column.
    """
    export = read_export(path, _EXPECTED)
    facts = _facts(export)
    metres = _check(export, facts)
    header = _header(export)
    names, groups = _bodies(export, header)
    at = chosen_tool(export, header.names, names, tool)
    group = groups[at]
    time = next(i for i, cell in enumerate(header.axes.cells) if cell.lower()[:4] == "time")
    table = export.table(header.axes, len(header.quantities)).named({time: "Time"})
    source = stamped_rows(table, *times_or_blank(table, "Time", NANOSECONDS))
    values = source.floats([group[n] for n in _COLUMNS], [n.title() for n in _COLUMNS])
    error = next((i for quantity, i in group.items() if "error" in quantity), None)
    options: dict[str, Any] = {}
    if error is not None:
        options["error"] = metres * source.floats([error], ["Mean Marker Error"])[:, 0]
    optical, account = pose_stream(
        source, np.roll(values[:, :4], 1, axis=1), metres * values[:, 4:], sort=sort, **options
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
            + (
                ", as the first line states." if "length units" in facts else ": no unit is stated."
            ),
            "Times are seconds since the capture began, on the tracker's own clock; a pose was taken at"
            " its stamp.",
            "The file does not state the direction of gravity (Motive's default is -y): gravity_ref is not"
            " set.",
        ],
    }
    if "capture start time" in facts:
        info["capture_start_time"] = facts["capture start time"]
    if rate:
        info["export_frame_rate"] = rate
    return tracker_alone(path, "motive", optical, account, info)


def _facts(export: Export) -> dict[str, str]:
    """Keys, in lower case, and values of the first line."""
    first = export.head[0]
    if first.cells[0].lower() != "format version":
        got = f"a file that begins with '{first.cells[0]}'"
        expected = "Format Version, the first line of an export of Motive"
        raise export.error(first, got, expected, "exporting with header information")
    return {
        key.lower(): value for key, value in zip(first.cells[::2], first.cells[1::2], strict=False)
    }


def _check(export: Export, facts: dict[str, str]) -> float:
    """Metres in a unit of the file; raises for rotations, units or frames that are not supported."""
    unit = facts.get("length units", "meters")
    supported = {
        "rotation type": (facts.get("rotation type", "Quaternion"), ("quaternion",)),
        "length units": (unit, tuple(unit for unit in METRES if len(unit) > 2)),
        "coordinate space": (facts.get("coordinate space", "Global"), ("global",)),
    }
    for key, (value, known) in supported.items():
        if value.lower() not in known:
            got = f"{key.title()} {value}"
            expected = " or ".join(word.title() for word in known)
            hint = "exporting with that setting"
            raise export.error(export.head[0], got, expected, hint, key.title())
    return METRES[unit.lower()]


def _header(export: Export) -> _Header:
    head = export.head[:20]
    axes = next((i for i, line in enumerate(head) if line.cells[0].lower() == "frame"), None)
    types = next(
        (i for i, line in enumerate(head) if _BODY in {cell.lower() for cell in line.cells}), None
    )
    if axes is None or types is None or types + 2 > axes - 1 or axes < 4:
        got = "no column of the type Rigid Body above a line Frame,Time (Seconds)"
        hint = "exporting rigid bodies with header information"
        raise export.error(head[0], got, _EXPECTED, hint)
    if not any(cell.lower()[:4] == "time" for cell in head[axes].cells):
        raise export.error(head[axes], "no column Time (Seconds)", "one", "exporting again")
    width = max(len(line.cells) for line in head[types : axes + 1])
    quantities = [
        f"{head[axes - 1].cell(i)} {head[axes].cell(i)}".strip().lower() for i in range(width)
    ]
    return _Header(head[types], head[types + 1], head[axes], quantities)


def _bodies(export: Export, header: _Header) -> tuple[list[str], list[dict[str, int]]]:
    """Names of the rigid bodies with a rotation and a position, and the columns of their quantities."""
    found: dict[str, dict[str, int]] = {}
    for i, quantity in enumerate(header.quantities):
        if header.types.cell(i).lower() == _BODY and header.names.cell(i):
            found.setdefault(header.names.cell(i), {})[quantity] = i
    whole = {name: group for name, group in found.items() if set(_COLUMNS) <= set(group)}
    if found and not whole:
        lacking = sorted(set(_COLUMNS) - set(next(iter(found.values()))))
        got = f"a rigid body without {', '.join(lacking)}"
        expected = "rotation X, Y, Z, W and position X, Y, Z"
        raise export.error(header.axes, got, expected, "exporting both, rotations as quaternions")
    return list(whole), list(whole.values())
