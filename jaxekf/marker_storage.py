"""Single optical markers on disk: one line for each marker and frame, the geometry in `recording.toml`.

``markers.csv``  time,marker,x,y,z[,quality][,error]

The lines of a frame share exactly one time and stand together. A marker whose x,y,z are blank, or that
has no line, is hidden. The section ``[markers]`` holds `latency` (s), `quality_min`, and
``[markers.geometry]`` with ``NAME = [x, y, z]``: each marker's place in the body frame, in metres.
"""

import json
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from jaxekf import description
from jaxekf.errors import RecordingError
from jaxekf.recording import Floats, Markers
from jaxekf.tables import (
    POSITION,
    Sheet,
    Table,
    need_columns,
    read_times,
    reported,
    whole_or_blank,
)

DESCRIBED = {"kind": "markers", "unit": "m"}
LAYOUT = "time,marker,x,y,z[,quality][,error]"

Indices = NDArray[np.intp]


def read(table: Table, about: Mapping[str, Any]) -> Markers:
    """The frames of `markers.csv`, markers in the order of the geometry.

    Hidden markers are NaN, as are qualities and errors that were not reported. Raises
    `RecordingError` for a marker without a place in the geometry or twice in a frame, for times that
    decrease, and for what is not a finite number.
    """
    need_columns(table, LAYOUT)
    place = table.path.with_name(description.FILE)
    names, p_body_marker = _geometry(about.get("geometry"), place)
    times = read_times(table, repeated=True)
    first = np.concatenate([[True], np.diff(times) > 0])
    frame, marker = np.cumsum(first) - 1, _marker_of_each_line(table, names)
    _check_once_a_frame(table, frame, marker)

    def by_frame(lines: Floats | None) -> Any:
        if lines is None:
            return None
        spread = np.full((frame[-1] + 1, len(names), *lines.shape[1:]), np.nan)
        spread[frame, marker] = lines
        return spread

    position = by_frame(whole_or_blank(table, POSITION))
    return Markers(
        times[first],
        position,
        np.isfinite(position).all(axis=2),
        names,
        p_body_marker,
        quality=by_frame(reported(table, "quality")),
        quality_min=description.finite_number(
            about.get("quality_min", 0.0), place, "markers.quality_min"
        ),
        error=by_frame(reported(table, "error", least=0.0)),
        latency_ns=description.latency_ns(about, "markers", place),
    )


def write(stream: Markers, about: dict[str, Any]) -> tuple[Sheet, dict[str, Any]]:
    """One line for every marker of every frame, so that no frame and no reported number is lost.

    A marker that is not visible, or has no finite position, gets blank cells.
    """
    _check_names(stream.names, description.FILE)
    frames, count = stream.visible.shape
    seen = stream.visible & np.isfinite(stream.position).all(axis=2)
    columns = ["marker", *POSITION]
    values = [np.where(seen[..., None], stream.position, np.nan).reshape(-1, 3)]
    for key in ("quality", "error"):
        numbers = getattr(stream, key)
        if numbers is not None:
            columns.append(key)
            values.append(numbers.reshape(-1, 1))
    about |= DESCRIBED | description.latency_entry(stream.latency_ns)
    if stream.quality_min:
        about["quality_min"] = float(stream.quality_min)
    about["geometry"] = {
        name: description.finite_vector(p, 3, description.FILE, f"markers.geometry.{name}").tolist()
        for name, p in zip(stream.names, stream.p_body_marker, strict=True)
    }
    times = np.repeat(stream.time_ns, count)
    return Sheet(columns, times, np.concatenate(values, axis=1), stream.names * frames), about


def _geometry(geometry: Any, place: Path | str) -> tuple[tuple[str, ...], Floats]:
    """Names (M) and places in the body (M, 3)."""
    key = "markers.geometry"
    if geometry is not None and not isinstance(geometry, dict):
        raise RecordingError(
            place, f"{key} = {geometry!r}", "a section", f"writing it as [{key}]", column=key
        )
    geometry = geometry or {}
    _check_names(tuple(geometry), place)
    places = [
        description.finite_vector(p, 3, place, f"{key}.{name}") for name, p in geometry.items()
    ]
    return tuple(geometry), np.array(places)


def _check_names(names: tuple[str, ...], place: Path | str) -> None:
    """Names are what a cell of a CSV file can hold and give back, each once, and at least one."""
    key = "markers.geometry"
    if not names:
        raise RecordingError(
            place,
            "no marker's place in the body",
            "at least one",
            f"adding NAME = [x, y, z], in metres, under [{key}]",
            column=key,
        )
    for i, name in enumerate(names):
        if not name or name != name.strip() or not name.isprintable() or name in names[:i]:
            raise RecordingError(
                place,
                f"{name!r} as marker {i + 1}",
                "printable names, without blanks at their ends, each once",
                "renaming the marker",
                column=key,
            )


def _marker_of_each_line(table: Table, names: tuple[str, ...]) -> Indices:
    """Index (N,) into `names` of the marker that each line is of."""
    at, index = table.columns.index("marker"), {name: i for i, name in enumerate(names)}
    cells = [row[at].strip() for row in table.rows]
    marker = np.array([index.get(cell, -1) for cell in cells], np.intp)
    unknown = np.flatnonzero(marker < 0)
    if unknown.size:
        row = int(unknown[0])
        name = cells[row]
        key = name if re.fullmatch(r"[A-Za-z0-9_-]+", name) else json.dumps(name)
        raise RecordingError(
            table.path,
            f"marker '{name}'",
            f"one whose place in the body is given ({', '.join(names)})",
            f"adding {key} = [x, y, z], in metres, under [markers.geometry] in {description.FILE}"
            if name
            else "naming the marker or removing the line",
            line=table.lines[row],
            column="marker",
        )
    return marker


def _check_once_a_frame(table: Table, frame: Indices, marker: Indices) -> None:
    place_in_frames = frame * (marker.max() + 1) + marker
    _, first = np.unique(place_in_frames, return_index=True)
    if len(first) < len(marker):
        row = int(np.setdiff1d(np.arange(len(marker)), first)[0])
        cells = dict(zip(table.columns, table.rows[row], strict=True))
        raise RecordingError(
            table.path,
            f"marker '{cells['marker'].strip()}' twice at {cells['time'].strip()} s",
            "each marker once a frame",
            "removing one of the lines, or giving each frame its own time",
            line=table.lines[row],
            column="marker",
        )
