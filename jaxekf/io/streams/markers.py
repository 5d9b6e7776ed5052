"""Single optical markers of one rigid tool.

In `markers.csv` each marker of each frame has a line. The lines of a frame are consecutive and share one
time. A marker without a line, or with blank x,y,z, is hidden.
"""

import json
import re
from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from jaxekf.io import description, units
from jaxekf.io._frame_rows import (
    NAMES,
    bad_name,
    check_names,
    dense_frames,
    frames,
    part_of_each_line,
    part_sheet,
)
from jaxekf.io.csv_table import POSITION, Sheet, Table, numbers, reported
from jaxekf.io.schema import FLAG, TEXT, Field, Option, StreamSchema, latency
from jaxekf.recordings import facts, screening
from jaxekf.recordings.accounts import Intake, Place
from jaxekf.recordings.types import Floats, Markers


def _read(table: Table, source: description.Source) -> tuple[Markers, Intake]:
    """The frames of `markers.csv`, markers in the order of the geometry.

    Hidden markers are NaN, as are qualities and errors that were not reported. Raises
    `RecordingError` for a marker without a place in the geometry or twice in a frame, for times that
    decrease, and for what is not a finite number.
    """
    about, place = source.about, source.place
    (length,) = units.factors("markers", ("m",), about, place)
    names, p_body_marker = _geometry(about.get("geometry"), place)
    position = length * numbers(table, POSITION, blank=True)
    error = reported(table, "error", least=0.0)
    error = None if error is None else length * error
    quality = reported(table, "quality")
    expected = f"one whose place in the body is given ({', '.join(names)})"
    marker = part_of_each_line(table, "marker", names, expected, _adding)
    columns = [a for a in (position, quality, error) if a is not None]
    made, account = frames(table, columns, marker, names, sort=source.sort)
    seen, account = screening.judge_markers(
        table.place.take(made.lines), made.times, position[made.lines], made.part, account
    )
    position[made.lines[~seen]] = np.nan
    position = made.spread(position)
    least = facts.finite_number(about.get("quality_min", 0.0), place, "markers.quality_min")
    stream = Markers(
        made.time_ns,
        position,
        np.asarray(np.isfinite(position).all(axis=2)),
        names,
        p_body_marker,
        quality=None if quality is None else made.spread(quality),
        quality_min=least,
        error=None if error is None else made.spread(error),
        latency_ns=description.latency_ns(about, "markers", place),
    )
    return stream, account


def _write(stream: Markers, about: dict[str, Any]) -> tuple[Sheet, dict[str, Any]]:
    """One line for every marker of every frame, so that no frame and no reported number is lost.

    A marker that is not visible, or has no finite position, gets blank cells.
    """
    _check_names(stream.names, facts.FILE)
    seen = stream.visible & np.isfinite(stream.position).all(axis=2)
    position = np.where(seen[..., None], stream.position, np.nan)
    about |= {**SCHEMA.described} | description.latency_entry(stream.latency_ns)
    if stream.quality_min:
        about["quality_min"] = float(stream.quality_min)
    about["geometry"] = {
        name: facts.finite_vector(p, 3, facts.FILE, f"markers.geometry.{name}").tolist()
        for name, p in zip(stream.names, stream.p_body_marker, strict=True)
    }
    return part_sheet(stream, "marker", POSITION, position, "quality", "error"), about


def _screen(place: Place, group: Mapping[str, Any], sort: bool) -> tuple[Markers, Intake]:
    """Frames from arrays. In the account each marker of each frame is a row, by the number of its frame."""
    position, names = group["position"], group["names"]
    check_names(place, names, "marker")
    for i, point in enumerate(group["p_body_marker"]):
        facts.finite_vector(point, 3, place.path, f"p_body_marker[{i}]")
    stated = group.get("visible", np.ones(position.shape[:2], bool))
    rows = [position, stated] + [group[key] for key in ("quality", "error") if key in group]
    time, order, account = dense_frames(place, group["time_ns"], rows, names, sort)
    each, count = np.repeat(np.arange(len(order)), len(names)), len(names)
    seen, account = screening.judge_markers(
        place.take(order).take(each),
        time[each],
        position[order].reshape(-1, 3),
        np.tile(np.arange(count), len(order)),
        account,
        seen=stated[order].reshape(-1) if "visible" in group else None,
    )
    quality = screening.check_reported(place, "quality", group.get("quality"))
    error = screening.check_reported(place, "error", group.get("error"), least=0.0)
    least = facts.finite_number(float(group.get("quality_min", 0.0)), place.path, "quality_min")
    return Markers(
        time,
        position[order],
        seen.reshape(len(order), count),
        names,
        group["p_body_marker"],
        quality=None if quality is None else quality[order],
        quality_min=least,
        error=None if error is None else error[order],
        latency_ns=int(group.get("latency_ns", 0)),
    ), account


def _geometry(geometry: Any, place: Path | str) -> tuple[tuple[str, ...], Floats]:
    """Names (M) and places in the body (M, 3)."""
    key = "markers.geometry"
    if geometry is not None and not isinstance(geometry, dict):
        raise facts.wrong_entry(place, key, geometry, "a section", f"writing it as [{key}]")
    geometry = geometry or {}
    _check_names(tuple(geometry), place)
    places = [facts.finite_vector(p, 3, place, f"{key}.{name}") for name, p in geometry.items()]
    return tuple(geometry), np.array(places)


def _check_names(names: tuple[str, ...], place: Path | str) -> None:
    """Names are what a cell of a CSV file can hold and give back, each once, and at least one."""
    error = partial(Place(place).error, None, "markers.geometry")
    if not names:
        hint = "adding NAME = [x, y, z], in metres, under [markers.geometry]"
        raise error("no marker's place in the body", "at least one", hint)
    bad = bad_name(names)
    if bad is not None:
        raise error(f"{names[bad]!r} as marker {bad + 1}", NAMES, "renaming the marker")


def _adding(name: str) -> str:
    """Remedy for a marker without a place in the body."""
    key = name if re.fullmatch(r"[A-Za-z0-9_-]+", name) else json.dumps(name)
    return f"adding {key} = [x, y, z], in metres, under [markers.geometry] in {facts.FILE}"


SCHEMA = StreamSchema(
    "markers",
    "Single optical markers of one rigid tool, each in the tracker's reference frame.",
    {
        "names": Field(TEXT, ("M",), needed=True, columns=("marker",), about="name of the marker"),
        "position": Field(
            shape=("N", "M", 3),
            unit="m",
            frame="reference",
            needed=True,
            columns=POSITION,
            about="position; blank where the marker is hidden",
        ),
        "visible": Field(FLAG, ("N", "M"), "1", about="whether the marker is visible"),
        "p_body_marker": Field(
            shape=("M", 3),
            unit="m",
            frame="body",
            needed=True,
            about="position of the marker in the body, in the order of `names`",
        ),
        "quality": Field(
            shape=("N", "M"), columns=("quality",), about="reported quality, larger is better"
        ),
        "quality_min": Field(
            shape=(),
            about="least quality of a marker that is used (default 0)",
            option="quality_min",
        ),
        "error": Field(
            shape=("N", "M"), unit="m", columns=("error",), about="reported fit error", least=0.0
        ),
        "latency_ns": latency(),
    },
    options={
        "geometry": Option(
            "NAME = [x, y, z] under [markers.geometry], m", "position of each marker in the body"
        )
    },
    described={"kind": "markers", "unit": "m"},
    read=_read,
    write=_write,
    screen=_screen,
)
