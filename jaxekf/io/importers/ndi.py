"""Importer of tools from CSV exports of NDI programs (Tool Tracker, ToolBox, Track) and API samples.

Every tool has a group of columns, or a line of its own::

    Tools,Port 1: Probe,Frame,Face,State,Q0,Qx,Qy,Qz,Tx,Ty,Tz,Error,Markers,...,Port 2: ...
    ToolCount,ToolInfo,Frame#,PortHandle,Face#,timespec_s,timespec_ns,TransformStatus,Q0,...,Error,#Markers,...
    Frame,Timestamp,Tool,Status,Q0,Qx,Qy,Qz,Tx,Ty,Tz,Error

Quaternions are in the order w, x, y, z; positions and errors are in millimetres unless the header states
another unit.
"""

import re
from collections.abc import Sequence
from datetime import UTC, datetime
from decimal import Decimal
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from jaxekf.io.csv_table import Table, times_or_blank, words
from jaxekf.io.importers._exports import (
    LARGEST,
    Export,
    HeaderLine,
    StampedRows,
    bare,
    chosen_tool,
    length_unit,
    pose_stream,
    read_export,
    stamped_rows,
    tracker_alone,
    unit_of,
)
from jaxekf.recordings import screening
from jaxekf.recordings.types import NANOSECONDS, Flags, Recording, Times

STATUS_OK = (*screening.STATUS_OK, "enabled", "valid", "visible")
"""States of a good pose, in lower case."""
RATE_HZ = 60.0
"""Frame rate of a Polaris."""
_EXPECTED = "a CSV export of NDI with columns Q0,Qx,Qy,Qz,Tx,Ty,Tz"
_POSE = ("q0", "qx", "qy", "qz", "tx", "ty", "tz")
_PORT = re.compile(r"port\s*\d+\b.*|toolinfo|tool ?info|tool ?name|tool ?id|tool", re.IGNORECASE)
_STATE = ("state", "status", "transformstatus", "transform status", "tool status")
_TICKS = {"s": 10**9, "ms": 10**6, "us": 10**3, "µs": 10**3, "ns": 1}


class _ToolColumns(NamedTuple):
    """The columns of one tool, or of several tools line by line."""

    title: str
    name: int | None
    """The column with the tool's name."""
    pose: list[int]
    state: int | None
    error: int | None
    frame: int | None
    time: int | None
    """Seconds, or a date, or whole seconds that `fraction` completes."""
    fraction: int | None
    """Nanoseconds."""


def load(
    path: Path | str,
    *,
    tool: str | None = None,
    rate_hz: float | None = None,
    status_ok: Sequence[str] = STATUS_OK,
    sort: bool = False,
) -> Recording:
    """Read the poses of one tool, as a run of a tracker alone.

    Poses of a lost tool (blank cells, a state, -3.7e28, the identity at the origin) are masked, by reason.

    Parameters
    ----------
    path : path
        A CSV export of an NDI program, or samples of the API.
    tool : str, optional
        Name or port of the tool (``Probe``, ``Port 1``); needed if there are several.
    rate_hz : float, optional
        Rate of the frame numbers in Hz, for files without time stamps; 60 by default.
    status_ok : sequence of str
        States of a good pose, words or numbers.
    sort : bool
        Sort rows by time that are out of order.

    Returns
    -------
    Recording
        Times in ns: the tracker's stamps, or frame numbers divided by `rate_hz`; attitude w, x, y, z, tool
        to tracker; position and error in metres.

    Raises
    ------
    RecordingError
        If the file is not such an export; names file, line and column.
    """
    export = read_export(path, _EXPECTED)
    header = export.find(_POSE, _EXPECTED)
    group, name, table = _chosen(export, header, tool)
    source, clock = _stamped(table, group, header, rate_hz)
    labels = [header.cells[i] for i in group.pose]
    unit = unit_of(labels[4]) or "mm"
    metres = length_unit(export, header, unit, labels[4])
    values = source.floats(group.pose, labels)
    options: dict[str, Any] = {}
    if group.error is not None:
        label = header.cells[group.error]
        error = source.floats([group.error], [label])[:, 0]
        scale = length_unit(export, header, unit_of(label) or unit, label)
        options["error"] = np.where(np.abs(error) < LARGEST, scale * error, np.nan)
    if group.state is not None:
        states = words(source.table.named({group.state: "state"}), "state")
        options |= {"status": states, "status_ok": status_ok}
    position = np.where(np.abs(values[:, 4:]) < LARGEST, metres * values[:, 4:], values[:, 4:])
    optical, account = pose_stream(source, values[:, :4], position, sort=sort, **options)
    info = {
        "dataset": "NDI CSV",
        "tool": name,
        "assumptions": [
            f"The body is the frame of the tool '{name}' as its definition file has it; the reference is"
            " the tracker's frame.",
            "Q0, Qx, Qy, Qz are a unit quaternion w, x, y, z (Hamilton) that turns the tool's coordinates"
            " into the tracker's.",
            f"Positions and errors are in units of {metres:g} m"
            + (": no unit is stated." if unit_of(labels[4]) is None else "."),
            f"Poses are good if their state is one of {', '.join(status_ok)}."
            if group.state is not None
            else "There is no column of states: every pose in the file is taken as good.",
            f"{clock}; a pose was taken at its stamp.",
            "The file does not state the direction of gravity: gravity_ref is not set.",
        ],
    }
    return tracker_alone(path, "ndi", optical, account, info)


# ---------------------------------------------------------------------------------------------
# Columns


def _chosen(
    export: Export, header: HeaderLine, tool: str | None
) -> tuple[_ToolColumns, str, Table]:
    """The tool's columns, its name, and its rows."""
    table = export.table(header, len(header.cells))
    names: list[str] = []
    found: list[tuple[_ToolColumns, list[str], Flags]] = []
    for group in _groups(export, header):
        column = np.full(len(table), "")
        if group.name is not None:
            column = words(table.named({group.name: "tool"}), "tool")
        own = [name for name in dict.fromkeys(column.tolist()) if name]
        if len(own) < 2:
            # A lost tool's name may be blank.
            title = group.title if not own or ":" in group.title else own[0]
            names.append(title)
            found.append((group, [*own, title], np.ones(len(table), bool)))
            continue
        names += own
        found += [(group, [name], column == name) for name in own]
    whole = names[0] if len(names) == 1 and tool is None else tool
    if tool is not None:
        wanted = tool.strip().lower()
        for i, (group, own, _) in enumerate(found):
            aliases = {alias for text in (*own, group.title) for alias in _aliases(text)}
            if wanted in aliases and names[i].lower() != wanted:
                whole = names[i]
                break
    i = chosen_tool(export, header, names, whole)
    return found[i][0], names[i], table.take(found[i][2])


def _aliases(text: str) -> list[str]:
    """Names by which a tool may be chosen: ``port 1: probe``, ``port 1`` and ``probe``."""
    return [part.strip().lower() for part in (text, *text.split(":", 1)) if part.strip()]


def _groups(export: Export, header: HeaderLine) -> list[_ToolColumns]:
    """The columns of every tool."""
    names = [bare(cell) for cell in header.cells]
    poses = [i for i, name in enumerate(names) if name == "q0"]
    ports = [
        i for i, cell in enumerate(header.cells) if _PORT.fullmatch(cell) and names[i] != "tools"
    ]
    # The last cell before each pose that begins a tool.
    begins = [max((p for p in ports if p < q), default=None) for q in poses]
    several = len(poses) > 1
    if several and (None in begins or len(set(begins)) < len(poses)):
        got = f"{len(poses)} poses with {len(ports)} names of tools (such as Port 1)"
        raise export.error(header, got, "one before each", "exporting one tool")
    shared = (begins[0] or 0) if several else 0
    groups = []
    for k, (begin, pose) in enumerate(zip(begins, poses, strict=True)):
        start = (begin or 0) if several else 0
        end = (begins[k + 1] or 0) if k + 1 < len(poses) else len(names)
        groups.append(_group(export, header, names, (start, pose, end), begin, shared))
    return groups


def _group(
    export: Export,
    header: HeaderLine,
    names: Sequence[str],
    span: tuple[int, int, int],
    name: int | None,
    shared: int,
) -> _ToolColumns:
    """The columns of a tool, from its name to the next one's; the first `shared` ones are of all tools."""
    start, pose, end = span
    columns = []
    for wanted in _POSE:
        found = next((i for i in range(pose, end) if names[i] == wanted), None)
        if found is None:
            got = f"no column {wanted.title()} after {header.cells[pose]}"
            hint = "exporting again with quaternions and positions"
            raise export.error(header, got, "Q0,Qx,Qy,Qz,Tx,Ty,Tz", hint)
        columns.append(found)

    def before(*wanted: str, prefix: str = "\n") -> int | None:
        own = [*range(start, pose), *range(shared)]
        return next((i for i in own if names[i] in wanted or names[i].startswith(prefix)), None)

    seconds = before("timespec_s")
    return _ToolColumns(
        header.cells[name] if name is not None else "tool",
        name,
        columns,
        before(*_STATE),
        next((i for i in range(columns[-1], end) if names[i].startswith("error")), None),
        before("frame", "frame number", "frame no"),
        seconds if seconds is not None else before(prefix="time"),
        before("timespec_ns") if seconds is not None else None,
    )


# ---------------------------------------------------------------------------------------------
# Times


def _stamped(
    table: Table, group: _ToolColumns, header: HeaderLine, rate_hz: float | None
) -> tuple[StampedRows, str]:
    """Rows with their stamps, and a sentence about the clock."""
    clock = [i for i in (group.time, group.fraction, group.frame) if i is not None]
    table = table.named({i: header.cells[i] for i in clock})
    if group.time is not None and group.fraction is not None:
        seconds, known = times_or_blank(table, header.cells[group.time], NANOSECONDS)
        part, also = times_or_blank(table, header.cells[group.fraction], 1)
        known &= also & (seconds > 0)  # a lost tool's time may be 0
        stamped = stamped_rows(table, seconds + part, known)
        return stamped, "Times are the tracker's stamps, in nanoseconds"
    if group.time is not None:
        label = header.cells[group.time]
        first = next((c for row in range(len(table)) if (c := table.cell(row, label))), "")
        if ":" in first:
            sentence = "Times are the export's dates and times of day, assumed to be UTC"
            return stamped_rows(table, *_dates(table, label)), sentence
        unit = unit_of(label) or "s"
        if unit not in _TICKS:
            raise table.place.error(
                None, label, f"the unit of time '{unit}'", "s, ms, µs or ns", "exporting seconds"
            )
        stated = "as the header states" if unit_of(label) else "no unit is stated"
        sentence = f"Times are the column '{label}' in {unit} ({stated})"
        return stamped_rows(table, *times_or_blank(table, label, _TICKS[unit])), sentence
    if group.frame is None:
        got = f"columns {','.join(header.cells[:12])}"
        raise table.place.error(None, None, got, "a time or a frame number", "exporting it")
    rate = Decimal(repr(float(RATE_HZ if rate_hz is None else rate_hz)))
    if not (rate.is_finite() and rate > 0):
        raise table.place.error(None, None, f"a rate of {rate} Hz", "one over 0", "--rate 60")
    sentence = f"Times are frame numbers over {float(rate):g} Hz" + (
        ", the rate of a Polaris (none was given)" if rate_hz is None else ", as given"
    )
    times = times_or_blank(table, header.cells[group.frame], NANOSECONDS / rate)
    return stamped_rows(table, *times), sentence


def _dates(table: Table, label: str) -> tuple[Times, Flags]:
    """Stamps of dates with times of day (ISO 8601, or a space for the T), or of times of day alone."""
    cells = words(table, label).tolist()
    times, known = np.zeros(len(cells), np.int64), np.zeros(len(cells), bool)
    for i, cell in enumerate(cells):
        if not cell:
            continue
        whole, _, part = cell.replace(",", ".").partition(".")
        text = whole if re.match(r"\d{4}-", whole) else f"1970-01-01 {whole}"
        try:
            day = datetime.fromisoformat(text).replace(tzinfo=UTC)
            nanoseconds = int(part.ljust(9, "0")[:9] or 0)
        except ValueError:
            raise table.error(
                i, label, f"'{cell}'", "a time like 2026-01-31 12:34:56.789", "correcting the cell"
            ) from None
        times[i], known[i] = int(day.timestamp()) * NANOSECONDS + nanoseconds, True
    return times, known
