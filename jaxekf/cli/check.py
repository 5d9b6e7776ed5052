"""`jaxekf check`: contents of recorded runs, and whether they can be used."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import click
import numpy as np

from jaxekf._support.errors import RecordingError
from jaxekf.checks.inspection import Inspection, StreamSummary, inspect
from jaxekf.checks.sensor_agreement import Evidence
from jaxekf.cli.align import (
    aligned_row,
    aligned_rows,
    alignment_columns,
    match_document,
    run_document,
)
from jaxekf.cli.console import (
    json_option,
    note,
    overwrite_option,
    print_json,
    print_table,
    sort_option,
)
from jaxekf.io import run_folder
from jaxekf.io.atomic import check_output, whole_folder
from jaxekf.io.documents import codec
from jaxekf.io.documents.check import CameraCheck, CheckDocument, RunCheck, StreamCheck
from jaxekf.recordings.types import Recording
from jaxekf.reporting.plots.style import save
from jaxekf.reporting.plots.timeaxis import time_axis

STATUS = {"fine": 0, "faults": 1, "warnings": 3}
"""Exit status by verdict; 2 is a usage error."""


class Checked(NamedTuple):
    """A run that was inspected, or the error that prevents reading it."""

    path: Path
    recording: Recording | None
    found: Inspection | None
    error: str | None

    @property
    def verdict(self) -> str:
        """``fine``, ``warnings`` or ``faults``."""
        return "faults" if self.found is None else self.found.verdict


@click.command()
@click.argument("runs", nargs=-1, required=True, type=click.Path(path_type=Path))
@click.option(
    "-o",
    "--output",
    type=click.Path(path_type=Path),
    help="Folder for check.json and a picture of each run's time axis, check_NAME.png.",
)
@sort_option
@overwrite_option
@json_option
def check(
    runs: tuple[Path, ...], output: Path | None, sort: bool, overwrite: bool, as_json: bool
) -> None:
    """Samples, gaps, masked rows, clocks, frames and units of RUNS, with a verdict on each run.

    Gaps are steps of more than 1.5 times the median; lost is the sum of these. Clock and frame are those
    that jaxekf align finds. Exit status: 0 for fine, 1 for faults (a run that cannot be read, or whose
    streams contradict its description), 3 for warnings only.
    """
    if output is not None:
        check_output(output, "check.json", overwrite=overwrite)
    checked = [_check(path, sort=sort) for path in runs]
    verdicts = {one.verdict for one in checked}
    worst = next(v for v in ("faults", "warnings", "fine") if v in verdicts)
    document = CheckDocument(verdict=worst, runs=[_document(one) for one in checked])
    if output is not None:
        with whole_folder(output, "check.json", overwrite=overwrite) as folder:
            (folder / "check.json").write_text(codec.as_text(document), "utf-8")
            for name, one in _named(checked).items():
                if one.recording is not None and one.found is not None:
                    save(time_axis(one.recording, one.found), folder / f"check_{name}.png")
        note(f"wrote {output}")
    if as_json:
        print_json(codec.plain(document))
    for one in checked:
        _print_run(one, tables=not as_json)
    if worst != "fine":
        click.get_current_context().exit(STATUS[worst])


def _check(path: Path, *, sort: bool) -> Checked:
    try:
        recording = run_folder.load(path, sort=sort)
    except (RecordingError, OSError) as error:
        return Checked(path, None, None, str(error))
    return Checked(path, recording, inspect(recording), None)


def _named(checked: Sequence[Checked]) -> dict[str, Checked]:
    """Runs by unique names: a second run of a name is numbered."""
    found: dict[str, Checked] = {}
    for one in checked:
        name = one.path.stem if one.found is None else one.found.run
        number = 2
        unique = name
        while unique in found:
            unique, number = f"{name}-{number}", number + 1
        found[unique] = one
    return found


def _document(one: Checked) -> RunCheck:
    path, verdict, found = str(one.path), one.verdict, one.found
    if found is None:
        return RunCheck(path=path, verdict=verdict, faults=[one.error or ""], warnings=[], notes=[])
    streams = {name: StreamCheck(**stream.as_dict()) for name, stream in found.streams.items()}
    if found.markers:
        streams["markers"].each = {
            name: StreamCheck(**marker.as_dict()) for name, marker in found.markers.items()
        }
    if found.points is not None:
        camera = found.streams["camera"].as_dict() | found.points._asdict()
        if found.camera is not None:
            camera |= found.camera.as_dict()
            if found.camera.match is not None:
                camera["alignment"] = match_document(found.camera.match)
        streams["camera"] = CameraCheck(**camera)
    return RunCheck(
        path=path,
        verdict=verdict,
        run=found.run,
        streams=streams,
        alignment=None if found.alignment is None else run_document(found.alignment),
        evidence=found.evidence.as_dict(),
        faults=list(found.faults),
        warnings=list(found.warnings),
        notes=list(found.notes),
    )


def _print_run(one: Checked, *, tables: bool) -> None:
    """Print the tables of a run on standard output, and its faults on standard error."""
    found = one.found
    if found is None:
        note(f"Error: {one.error}")
        return
    for text in found.faults:
        note(f"Error: {text}")
    if not tables:
        return
    streams = dict(found.streams)
    streams |= {f"  {name}": stream for name, stream in found.markers.items()}
    columns = ["stream", "samples", "usable", "rate\n(Hz)", "from\n(s)", "lasts\n(s)"]
    columns += ["gaps", "longest\n(s)", "lost\n(s)", "hidden\n(s)", "dropped"]
    print_table(found.run, columns, [_row(label, stream) for label, stream in streams.items()])
    if rows := _aligned(found):
        columns = alignment_columns()[1:]
        print_table("Against the IMU, with standard deviations", columns, [r[1:] for r in rows])
    for text in (*_points(found), *_evidence(found.evidence)):
        click.echo(f"  {text}")
    for kind, texts in (("note", found.notes), ("warning", found.warnings)):
        for text in texts:
            click.echo(f"  {kind}: {text}")
    words = {"fine": "fine", "warnings": "usable, but see the warnings", "faults": "not usable"}
    click.echo(f"{found.run}: {words[found.verdict]}\n")


def _row(label: str, stream: StreamSummary) -> list[Any]:
    return [
        label,
        stream.samples,
        stream.usable,
        stream.rate_hz,
        f"{stream.begin_s:.3f}",
        stream.end_s - stream.begin_s,
        stream.gaps.count,
        stream.gaps.longest_s,
        stream.gaps.lost_s,
        stream.hidden.lost_s,
        sum(stream.dropped.values()),
    ]


def _aligned(found: Inspection) -> list[list[Any]]:
    """Rows of clock and frame against the IMU."""
    rows = [] if found.alignment is None else aligned_rows(found.alignment)
    if found.camera is not None and found.camera.match is not None:
        rows.append(aligned_row(found.run, "camera", found.camera.match))
    return rows


def _points(found: Inspection) -> list[str]:
    """Lines on the landmarks of a camera and its agreement with the IMU."""
    made, seen = found.points, found.camera
    if made is None:
        return []
    lines = [
        f"camera: {made.points_per_image:.1f} of {made.landmarks} landmarks in an image on average,"
        f" {made.images_without_points} of {made.images} images without any"
    ]
    if seen is None or seen.posed == 0:
        return lines
    posed = f"camera: {seen.posed} of {seen.images} images looked at fit a pose, points"
    lines.append(f"{posed} {seen.error_px:.2f} pixels about it")
    for text in _evidence(replace(seen.imu, static_norm=np.nan), "camera"):
        lines.append(text if text.startswith("camera") else f"camera, {text}")
    return lines


def _evidence(found: Evidence, tracker: str = "tracker") -> list[str]:
    """Lines on units and order of tracker and IMU; a camera's poses have a known order."""
    lines = []
    if found.rate_ratio == found.rate_ratio:
        lines.append(
            f"rate: the gyroscope turns {found.rate_ratio:.3f} times as fast as the {tracker} (correlation"
            f" {found.rate_correlation:.2f})"
        )
    elif found.clock_steps:
        lines.append("rate: not compared, since a clock steps")
    elif found.too_fast:
        lines.append(
            f"rate: about half a turn or more between the {tracker}'s samples: too fast for its rate to"
            " determine the gyroscope's unit"
        )
    elif found.searched_s > 0.0:
        lines.append(
            f"rate: the rotations of gyroscope and {tracker} agree at no clock offset within"
            f" ±{found.searched_s:.0f} s"
        )
    elif found.turns:
        lines.append("rate: too little turning to determine the gyroscope's unit")
    if found.readings and tracker == "tracker" and not found.clock_steps:
        others = max(made.explained for made in found.readings.values())
        lines.append(
            f"quaternion: the gyroscope explains {100.0 * found.explained:.1f} % of the turning, with"
            f" another order or direction {100.0 * others:.1f} %"
        )
    if found.static_norm == found.static_norm:
        lines.append(f"accelerometer: {found.static_norm:.2f} m/s^2 in the quietest seconds")
    if found.length_ratio == found.length_ratio:
        what = (
            f"path: the {tracker} moves {found.length_ratio:.3f} times as far as the accelerometer"
        )
        if not found.readings:
            what = f"markers: {found.length_ratio:.3f} times as far apart as in the geometry"
        lines.append(what)
    return lines
