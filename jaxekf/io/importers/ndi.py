"""Importer of tools from CSV exports of NDI programs (Tool Tracker, ToolBox, Track) and API samples.

Every tool has a group of columns, or a line of its own::

    Tools,Port 1: Probe,Frame,Face,State,Q0,Qx,Qy,Qz,Tx,Ty,Tz,Error,Markers,...,Port 2: ...
    ToolCount,ToolInfo,Frame#,PortHandle,Face#,timespec_s,timespec_ns,TransformStatus,Q0,...,Error,#Markers,...
    Frame,Timestamp,Tool,Status,Q0,Qx,Qy,Qz,Tx,Ty,Tz,Error

Quaternions stand in the order w, x, y, z; positions and errors are millimetres unless the header says
another unit.
"""

import re
from collections.abc import Sequence
from datetime import UTC, datetime
from decimal import Decimal
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from jaxekf._support.errors import RecordingError
from jaxekf.io.importers._exports import (
    LARGEST,
    Lines,
    Rows,
    Timed,
    bare,
    chosen_tool,
    length_unit,
    pose_stream,
    read_lines,
    stripped,
    timed,
    tracker_alone,
    unit_of,
)
from jaxekf.recordings import screening
from jaxekf.recordings.types import NANOSECONDS, Flags, Recording, Times

STATUS_OK = (*screening.STATUS_OK, "enabled", "valid", "visible")
"""Words of a state that mean a good pose, in lower case."""
RATE_HZ = 60.0
"""At which a Polaris counts its frames."""
_WHAT = "a CSV export of NDI with columns Q0,Qx,Qy,Qz,Tx,Ty,Tz"
_POSE = ("q0", "qx", "qy", "qz", "tx", "ty", "tz")
_PORT = re.compile(r"port\s*\d+\b.*|toolinfo|tool ?info|tool ?name|tool ?id|tool", re.IGNORECASE)
_STATE = ("state", "status", "transformstatus", "transform status", "tool status")
_TICKS = {"s": 10**9, "ms": 10**6, "us": 10**3, "µs": 10**3, "ns": 1}


class _Group(NamedTuple):
    """The columns of one tool, or of tools line by line."""

    title: str
    name: int | None
    """Where each line says which tool it is of."""
    pose: list[int]
    state: int | None
    error: int | None
    frame: int | None
    time: int | None
    """Seconds, or a date, or whole seconds beside `fraction`."""
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
    """The poses of one tool, as a run of a tracker alone.

    `tool` is its name or its port (``Probe``, ``Port 1``); it may be left out where there is only one.
    Times are the tracker's stamps; without any they are frame numbers over `rate_hz` (60 Hz unless given).
    `status_ok` are words or numbers of the state that mean a good pose. A lost tool (blank cells, a state,
    -3.7e28, the identity at the origin) is masked by what it was lost for. With `sort` rows that are out of
    order are put in order of time. Raises `RecordingError`, which names file, line and column.
    """
    lines = read_lines(path, _WHAT)
    at = lines.find(_POSE, _WHAT)
    header = stripped(lines.cells[at])
    rows = lines.body(at, len(header))
    group, name, chosen = _chosen(lines, at, header, rows, tool)
    rows = rows.take(chosen)
    source, clock = _stamped(rows, group, header, rate_hz)
    labels = [header[i] for i in group.pose]
    unit = unit_of(header[group.pose[4]]) or "mm"
    metres = length_unit(lines, at, unit, labels[4])
    values = source.rows.floats(group.pose, labels)
    said: dict[str, Any] = {}
    if group.error is not None:
        error = source.rows.floats([group.error], [header[group.error]])[:, 0]
        scale = length_unit(lines, at, unit_of(header[group.error]) or unit, header[group.error])
        said["error"] = np.where(np.abs(error) < LARGEST, scale * error, np.nan)
    if group.state is not None:
        said |= {"status": source.rows.words(group.state), "status_ok": status_ok}
    position = np.where(np.abs(values[:, 4:]) < LARGEST, metres * values[:, 4:], values[:, 4:])
    optical, account = pose_stream(source, values[:, :4], position, sort=sort, **said)
    words = ", ".join(status_ok)
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
            f"A state is good where it is one of {words}."
            if group.state is not None
            else "There is no column of a state: every pose that is there is taken as good.",
            f"{clock}; a pose was taken at its stamp.",
            "Which way is up is not in the file: gravity_ref is not set.",
        ],
    }
    return tracker_alone(path, "ndi", optical, account, info)


# ---------------------------------------------------------------------------------------------
# Which columns


def _chosen(
    lines: Lines, at: int, header: Sequence[str], rows: Rows, tool: str | None
) -> tuple[_Group, str, Flags]:
    """The tool's columns, its name, and its rows."""
    names, found = [], []
    for group in _groups(lines, at, header):
        words = [""] * len(rows.cells) if group.name is None else rows.words(group.name)
        told = [word for word in dict.fromkeys(words) if word]
        if len(told) < 2:
            # A blank name is that of a tool that was lost.
            title = group.title if not told or ":" in group.title else told[0]
            names.append(title)
            found.append((group, [*told, title], np.ones(len(words), bool)))
            continue
        for word in told:
            names.append(word)
            found.append((group, [word], np.array([other == word for other in words])))
    whole = names[0] if len(names) == 1 and tool is None else tool
    if tool is not None:
        wanted = tool.strip().lower()
        for i, (group, told, _) in enumerate(found):
            calls = {part for text in (*told, group.title) for part in _calls(text)}
            if wanted in calls and names[i].lower() != wanted:
                whole = names[i]
                break
    i = chosen_tool(lines, at, names, whole)
    return found[i][0], names[i], found[i][2]


def _calls(text: str) -> list[str]:
    """What a tool may be called by: ``port 1: probe``, ``port 1`` and ``probe``."""
    return [part.strip().lower() for part in (text, *text.split(":", 1)) if part.strip()]


def _groups(lines: Lines, at: int, header: Sequence[str]) -> list[_Group]:
    names = [bare(cell) for cell in header]
    poses = [i for i, name in enumerate(names) if name == "q0"]
    ports = [i for i, cell in enumerate(header) if _PORT.fullmatch(cell) and names[i] != "tools"]
    # The last cell before each pose that begins a tool.
    begins = [max((p for p in ports if p < q), default=None) for q in poses]
    if len(poses) > 1 and (None in begins or len(set(begins)) < len(poses)):
        raise RecordingError(
            lines.path,
            f"{len(poses)} poses with {len(ports)} names of tools (such as Port 1)",
            "one before each",
            "exporting one tool",
            line=lines.numbers[at],
        )
    first = begins[0] if len(poses) > 1 and begins[0] is not None else 0
    groups = []
    for k, (begin, pose) in enumerate(zip(begins, poses, strict=True)):
        start = begin if begin is not None and len(poses) > 1 else 0
        end = begins[k + 1] if k + 1 < len(poses) else len(header)
        assert end is not None
        groups.append(_group(lines, at, header, names, (start, pose, end), begin, first))
    return groups


def _group(
    lines: Lines,
    at: int,
    header: Sequence[str],
    names: Sequence[str],
    span: tuple[int, int, int],
    name: int | None,
    shared: int,
) -> _Group:
    """The columns of a tool, from its name to the next one's; a clock may stand before all tools."""
    start, pose, end = span
    columns = []
    for wanted in _POSE:
        found = next((i for i in range(pose, end) if names[i] == wanted), None)
        if found is None:
            raise RecordingError(
                lines.path,
                f"no column {wanted.title()} after {header[pose]}",
                "Q0,Qx,Qy,Qz,Tx,Ty,Tz",
                "exporting again with quaternions and positions",
                line=lines.numbers[at],
            )
        columns.append(found)

    def before(*wanted: str, text: str = "") -> int | None:
        own = [*range(start, pose), *range(shared)]
        return next(
            (i for i in own if names[i] in wanted or (text and names[i].startswith(text))), None
        )

    seconds = before("timespec_s")
    title = header[name] if name is not None else "tool"
    return _Group(
        title,
        name,
        columns,
        before(*_STATE),
        next((i for i in range(columns[-1], end) if names[i].startswith("error")), None),
        before("frame", "frame number", "frame no"),
        seconds if seconds is not None else before(text="time"),
        before("timespec_ns") if seconds is not None else None,
    )


# ---------------------------------------------------------------------------------------------
# When


def _stamped(
    rows: Rows, group: _Group, header: Sequence[str], rate_hz: float | None
) -> tuple[Timed, str]:
    """Rows with their stamps, and a sentence about the clock."""
    if group.time is not None and group.fraction is not None:
        seconds, known = rows.times(group.time, header[group.time], NANOSECONDS)
        part, also = rows.times(group.fraction, header[group.fraction], 1)
        known &= also & (seconds > 0)  # a lost tool's time may be 0
        return timed(rows, seconds + part, known), "Times are the tracker's stamps, in nanoseconds"
    if group.time is not None:
        label = header[group.time]
        if any(":" in word for word in rows.words(group.time)):
            told = "Times are the export's dates and times of day, taken for UTC"
            return timed(rows, *_dates(rows, group.time, label)), told
        unit = unit_of(label) or "s"
        if unit not in _TICKS:
            raise rows.place.error(
                None, label, f"the unit of time '{unit}'", "s, ms, µs or ns", "exporting seconds"
            )
        stated = "as the header says" if unit_of(label) else "no unit is stated"
        told = f"Times are the column '{label}' in {unit} ({stated})"
        return timed(rows, *rows.times(group.time, label, _TICKS[unit])), told
    if group.frame is None:
        raise rows.place.error(
            None,
            None,
            f"columns {','.join(header[:12])}",
            "a time or a frame number",
            "exporting it",
        )
    rate = Decimal(repr(float(RATE_HZ if rate_hz is None else rate_hz)))
    if not (rate.is_finite() and rate > 0):
        raise rows.place.error(None, None, f"a rate of {rate} Hz", "one over 0", "--rate 60")
    told = f"Times are frame numbers over {float(rate):g} Hz" + (
        ", at which a Polaris counts (none was given)" if rate_hz is None else ", as was given"
    )
    return timed(rows, *rows.times(group.frame, header[group.frame], NANOSECONDS / rate)), told


def _dates(rows: Rows, column: int, label: str) -> tuple[Times, Flags]:
    """Stamps of dates with times of day (ISO 8601, a blank for the T), or of times of day alone."""
    words = rows.words(column)
    times, known = np.zeros(len(words), np.int64), np.zeros(len(words), bool)
    for i, word in enumerate(words):
        if not word:
            continue
        whole, _, part = word.replace(",", ".").partition(".")
        text = whole if re.match(r"\d{4}-", whole) else f"1970-01-01 {whole}"
        try:
            day = datetime.fromisoformat(text).replace(tzinfo=UTC)
            nanoseconds = int(part.ljust(9, "0")[:9] or 0)
        except ValueError:
            raise rows.place.error(
                i, label, f"'{word}'", "a time like 2026-01-31 12:34:56.789", "correcting the cell"
            ) from None
        times[i], known[i] = int(day.timestamp()) * NANOSECONDS + nanoseconds, True
    return times, known
