"""Image points of known landmarks, from a camera that is fixed to the body.

In `camera.csv` each landmark of each image has a line. The lines of an image are consecutive and share
one time. A landmark without a line, or with blank u,v, was not found. `landmarks.csv` (landmark,x,y,z)
beside it has the landmarks' positions in the reference frame; ``unit`` in the section ``[camera]`` is
theirs.
"""

import csv
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from jaxekf._support.errors import RecordingError
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
from jaxekf.io.csv_table import (
    POSITION,
    Sheet,
    Table,
    finite_numbers,
    need_columns,
    numbers,
    reported,
    words,
)
from jaxekf.io.schema import FLAG, TEXT, Field, Option, StreamSchema, latency
from jaxekf.recordings import facts, screening
from jaxekf.recordings.accounts import Intake, Place
from jaxekf.recordings.types import Camera, Floats

LANDMARKS = "landmark,x,y,z"
_OPTICS = ("focal", "centre", "radial", "p_body_camera", "q_body_camera")
_SHOWN = 10
"""Names of landmarks that a message lists: a scene may have thousands."""


def _read(table: Table, source: description.Source, landmarks: Table) -> tuple[Camera, Intake]:
    """The images of `camera.csv`, landmarks in the order of `landmarks.csv`.

    Points of landmarks that were not found are NaN, as are deviations that were not reported. Raises
    `RecordingError` for a landmark without a place or twice in an image, for times that decrease, for what
    is not a finite number, and for a missing focal length or centre.
    """
    about, place = source.about, source.place
    length, _ = units.factors("camera", ("m", "px"), about, place)
    optics = _optics(about, place, "camera.")
    names, p_ref_landmark = _places(landmarks, length)
    pixel, sigma = numbers(table, ("u", "v"), blank=True), reported(table, "sigma")
    _check_sigma(table.place, sigma)
    file = landmarks.path.name
    listed = ", ".join(names[:_SHOWN]) + (", ..." if len(names) > _SHOWN else "")
    expected = f"one whose place is given in {file} ({listed})"
    hint = f"adding its line, {LANDMARKS}, to {file}"
    landmark = part_of_each_line(table, "landmark", names, expected, lambda _: hint)
    columns = [pixel] if sigma is None else [pixel, sigma]
    slowest_s = screening.SLOWEST_TRACKER_S
    made, account = frames(table, columns, landmark, names, sort=source.sort, slowest_s=slowest_s)
    found, account = screening.judge_points(
        table.place.take(made.lines), made.times, pixel[made.lines], account
    )
    pixel[made.lines[~found]] = np.nan
    pixel = made.spread(pixel)
    stream = Camera(
        made.time_ns,
        pixel,
        np.asarray(np.isfinite(pixel).all(axis=2)),
        names,
        p_ref_landmark,
        sigma=None if sigma is None else made.spread(sigma),
        latency_ns=description.latency_ns(about, "camera", place),
        **optics,
    )
    return stream, account


def _write(stream: Camera, about: dict[str, Any]) -> tuple[Sheet, dict[str, Any]]:
    """One line for every landmark of every image, so that no image and no deviation is lost.

    A landmark that is not visible, or has no finite point, gets blank cells. Raises `RecordingError` for
    what could not be read again.
    """
    check_names(Place("camera"), stream.names, "landmark")
    _check_sigma(Place("camera"), stream.sigma)
    seen = stream.usable
    if not seen.any():
        got = f"no landmark in any of {len(seen)} images"
        hint = "leaving the stream out where nothing is seen"
        raise RecordingError("camera", got, "at least one", hint)
    pixel = np.where(seen[..., None], stream.pixel, np.nan)
    entries = {key: getattr(stream, key) for key in _OPTICS}
    about |= {**SCHEMA.described} | description.latency_entry(stream.latency_ns)
    about |= {key: value.tolist() for key, value in _optics(entries, facts.FILE, "camera.").items()}
    return part_sheet(stream, "landmark", ("u", "v"), pixel, "sigma"), about


def _write_landmarks(stream: Camera, path: Path) -> None:
    """`landmarks.csv`, to the last bit whatever the digits of samples: a place is no sample."""
    _check_places(Place(path.name), stream.p_ref_landmark)
    with path.open("w", encoding="utf-8", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(LANDMARKS.split(","))
        for name, point in zip(stream.names, stream.p_ref_landmark, strict=True):
            writer.writerow([name, *(f"{value:.17g}" for value in point)])


def _optics(entries: Mapping[str, Any], place: Path | str, head: str = "") -> dict[str, Floats]:
    """Fields of `Camera` that describe lens and mounting, as far as `entries` has them.

    Raises `RecordingError`, which names the entry with `head` before it, for a focal length or centre that
    is missing or invalid, and a quaternion of zeros; others are scaled to unit length.
    """
    found = {}
    for key in ("focal", "centre"):
        if key not in entries:
            hint = f"adding {key} = [{key[0]}x, {key[0]}y] under [camera]"
            whole = f"{head}{key}"
            raise RecordingError(place, f"no {whole}", "two numbers of pixels", hint, column=whole)
        found[key] = facts.finite_vector(entries[key], 2, place, f"{head}{key}")
    if (found["focal"] <= 0.0).any():
        focal, hint = found["focal"].tolist(), "turning the image, not the focal length"
        expected = "two positive numbers of pixels"
        raise facts.wrong_entry(place, f"{head}focal", focal, expected, hint)
    for key, size in (("radial", 2), ("p_body_camera", 3)):
        if key in entries:
            found[key] = facts.finite_vector(entries[key], size, place, f"{head}{key}")
    if "q_body_camera" in entries:
        key = "q_body_camera"
        found[key] = facts.unit_vector(entries[key], 4, place, f"{head}{key}")
    return found


def _check_sigma(place: Place, sigma: Floats | None) -> None:
    """Deviations (N, ...) are positive, finite, or NaN where none was reported: a point without any error
    would overrule all else."""
    if sigma is None:
        return
    bad = np.argwhere(np.isinf(sigma) | (sigma <= 0.0))
    if bad.size:
        at = tuple(int(i) for i in bad[0])
        hint = "blanking the cell" if place.unit == "line" else "writing NaN"
        hint += ", which means that none was reported"
        expected = "a finite number of pixels, more than 0"
        raise place.error(at[0], "sigma", f"{sigma[at]}", expected, hint)


def _screen(place: Place, group: Mapping[str, Any], sort: bool) -> tuple[Camera, Intake]:
    """Images from arrays. In the account each landmark of each image is a row, by the number of its
    image."""
    pixel, names, sigma = group["pixel"], group["names"], group.get("sigma")
    check_names(place, names, "landmark")
    _check_places(place, group["p_ref_landmark"])
    _check_sigma(place, sigma)
    optics = _optics(group, place.path)
    stated = group.get("visible", np.ones(pixel.shape[:2], bool))
    rows = [pixel, stated] if sigma is None else [pixel, stated, sigma]
    slowest = screening.SLOWEST_TRACKER_S
    time, order, account = dense_frames(place, group["time_ns"], rows, names, sort, slowest)
    each = np.repeat(np.arange(len(order)), len(names))
    found, account = screening.judge_points(
        place.take(order).take(each),
        time[each],
        pixel[order].reshape(-1, 2),
        account,
        seen=stated[order].reshape(-1) if "visible" in group else None,
    )
    return Camera(
        time,
        pixel[order],
        found.reshape(len(order), len(names)),
        names,
        group["p_ref_landmark"],
        sigma=None if sigma is None else sigma[order],
        latency_ns=int(group.get("latency_ns", 0)),
        **optics,
    ), account


def _check_places(place: Place, places: Floats) -> None:
    """Every landmark (L, 3) is somewhere."""
    bad = np.flatnonzero(~np.isfinite(places).all(axis=1))
    if bad.size:
        at = int(bad[0])
        got, hint = f"{places[at].tolist()}", "giving the landmark its place, or leaving it out"
        raise place.error(at, "p_ref_landmark", got, "3 finite numbers", hint)


def _places(table: Table, length: float) -> tuple[tuple[str, ...], Floats]:
    """Names (L) and places (L, 3), metres, of `landmarks.csv`."""
    need_columns(table, LANDMARKS)
    if table.text.cut:
        got, hint = "a last line that is cut short", "completing the line or removing it"
        raise RecordingError(table.path, got, LANDMARKS, hint, line=table.text.cut[0])
    names = tuple(str(name) for name in words(table, "landmark"))
    bad = bad_name(names)
    if bad is not None:
        got = f"{names[bad]!r}" + (" again" if names[bad] in names[:bad] else "")
        hint = "renaming the landmark, or removing the line"
        raise table.error(bad, "landmark", got, NAMES, hint)
    return names, units.scaled(finite_numbers(table, POSITION), length)


def _optic(size: int, unit: str, about: str, *, frame: str = "", needed: bool = False) -> Field:
    return Field(shape=(size,), unit=unit, frame=frame, needed=needed, about=about)


SCHEMA = StreamSchema(
    "camera",
    "Image points of landmarks whose positions are known, from a camera that is fixed to the body.",
    {
        "names": Field(
            TEXT, ("L",), needed=True, columns=("landmark",), about="name of the landmark"
        ),
        "pixel": Field(
            shape=("N", "L", 2),
            unit="px",
            frame="image, u to the right, v down",
            needed=True,
            columns=("u", "v"),
            about="image point; blank where the landmark was not found",
        ),
        "visible": Field(FLAG, ("N", "L"), "1", about="whether the landmark was found"),
        "p_ref_landmark": Field(
            shape=("L", 3),
            unit="m",
            frame="reference",
            needed=True,
            about="position of the landmark, in `landmarks.csv`",
        ),
        "focal": _optic(2, "px", "focal lengths", needed=True),
        "centre": _optic(2, "px", "image point of the optical axis", needed=True),
        "radial": _optic(2, "1", "radial distortion (default 0, 0)"),
        "p_body_camera": _optic(3, "m", "centre of the camera (default 0, 0, 0)", frame="body"),
        "q_body_camera": _optic(
            4,
            "1",
            "orientation of the camera (default 1, 0, 0, 0)",
            frame="w,x,y,z, camera to body",
        ),
        "sigma": Field(
            shape=("N", "L"),
            unit="px",
            columns=("sigma",),
            about="reported standard deviation of the image point",
        ),
        "latency_ns": latency(),
    },
    options={
        "focal": Option("[fx, fy], px", "focal lengths"),
        "centre": Option("[cx, cy], px", "image point of the optical axis"),
        "radial": Option("[k1, k2]", "radial distortion (default 0, 0)"),
        "p_body_camera": Option("[x, y, z], m", "centre of the camera in the body (default 0)"),
        "q_body_camera": Option("[w, x, y, z]", "rotation from camera to body (default: identity)"),
    },
    described={"kind": "camera", "unit": "m, px"},
    units=("m", "px"),
    read=_read,
    write=_write,
    beside={description.LANDMARKS: _write_landmarks},
    screen=_screen,
)
