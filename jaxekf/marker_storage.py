"""Single optical markers on disk: one line for each marker and frame, the geometry in `recording.toml`.

``markers.csv``  time,marker,x,y,z[,quality][,error]

The lines of a frame share exactly one time and stand together. A marker whose x,y,z are blank, or that
has no line, is hidden. The section ``[markers]`` holds `latency` (s), `quality_min`, and
``[markers.geometry]`` with ``NAME = [x, y, z]``: each marker's place in the body frame, in metres.
"""

import json
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from jaxekf import description, intake, stated
from jaxekf.errors import RecordingError
from jaxekf.recording import Floats, Markers
from jaxekf.rows import Intake, Part
from jaxekf.tables import (
    POSITION,
    Sheet,
    Table,
    need_columns,
    numbers,
    reported,
    stamps,
    words,
)

DESCRIBED = {"kind": "markers", "unit": "m"}
LAYOUT = "time,marker,x,y,z[,quality][,error]"

Indices = NDArray[np.intp]


def read(table: Table, source: description.Source) -> tuple[Markers, Intake]:
    """The frames of `markers.csv`, markers in the order of the geometry.

    Hidden markers are NaN, as are qualities and errors that were not reported. Raises
    `RecordingError` for a marker without a place in the geometry or twice in a frame, for times that
    decrease, and for what is not a finite number.
    """
    need_columns(table, LAYOUT)
    about, place = source.about, source.place
    (length,) = stated.factors("markers", about, place)
    names, p_body_marker = _geometry(about.get("geometry"), place)
    position = length * numbers(table, POSITION, blank=True)
    error = reported(table, "error", least=0.0)
    error = None if error is None else length * error
    quality, marker = reported(table, "quality"), _marker_of_each_line(table, names)
    columns = [a for a in (position, quality, error) if a is not None]
    every = stamps(table)
    order, account = intake.in_order(
        table.place, every, columns, sort=source.sort, part=marker, parts=names
    )
    all_marker, times, marker = marker, every[order], marker[order]
    intake.check_rate(table.place, np.unique(times))
    first = np.concatenate([[True], np.diff(times) > 0])
    frame = np.cumsum(first) - 1

    def by_frame(lines: Floats | None) -> Any:
        if lines is None:
            return None
        spread = np.full((frame[-1] + 1, len(names), *lines.shape[1:]), np.nan)
        spread[frame, marker] = lines[order]
        return spread

    place_of_kept = table.place.take(order)
    lines = np.bincount(all_marker, minlength=len(names))
    there = np.zeros((frame[-1] + 1, len(names)), bool)
    there[frame, marker] = True
    gone = np.setdiff1d(np.arange(len(all_marker)), order)
    parts = {
        name: Part(int(lines[m]), every[gone[all_marker[gone] == m]], times[first][~there[:, m]])
        for m, name in enumerate(names)
    }
    seen, account = intake.judge_markers(place_of_kept, times, position[order], marker, account)
    account = replace(account, parts=parts)
    position[order[~seen]] = np.nan
    position = by_frame(position)
    stream = Markers(
        times[first],
        position,
        np.isfinite(position).all(axis=2),
        names,
        p_body_marker,
        quality=by_frame(quality),
        quality_min=description.finite_number(
            about.get("quality_min", 0.0), place, "markers.quality_min"
        ),
        error=by_frame(error),
        latency_ns=description.latency_ns(about, "markers", place),
    )
    return stream, account


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
    index = {name: i for i, name in enumerate(names)}
    cells = words(table, "marker")
    kinds, which = np.unique(cells, return_inverse=True)
    marker = np.array([index.get(str(kind), -1) for kind in kinds], np.intp)[which]
    unknown = np.flatnonzero(marker < 0)
    if unknown.size:
        row = int(unknown[0])
        name = str(cells[row])
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
