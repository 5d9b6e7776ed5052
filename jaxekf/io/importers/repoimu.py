"""Importer of RepoIMU's T-stick trials (Szczęsna et al. 2016, doi 10.1007/978-3-319-46418-3_45).

One CSV file a trial, plain or gzipped, cells separated by semicolons, a header of two lines: time in
seconds, Vicon's quaternion w, x, y, z, accelerometer, gyroscope and magnetometer.
"""

from dataclasses import replace
from pathlib import Path

import numpy as np

from jaxekf._support.errors import RecordingError
from jaxekf.io.importers._exports import accounted, read_lines, stripped, timed
from jaxekf.recordings import screening
from jaxekf.recordings.accounts import Intake
from jaxekf.recordings.types import NANOSECONDS, Recording

_WHAT = "a T-stick trial of RepoIMU"
_HEADER = (
    ("Time (s)", ("",)),
    ("Vicon Orientation", ("W", "X", "Y", "Z")),
    ("IMU Acceleration", ("X", "Y", "Z")),
    ("IMU Gyroscope", ("X", "Y", "Z")),
    ("IMU Magnetometer", ("X", "Y", "Z")),
)
_ASSUMPTIONS = (
    "The body is the frame of the IMU; Vicon's markers are taken to have the same axes (jaxekf align finds"
    " by how much they are off).",
    "Vicon Orientation is a unit quaternion w, x, y, z (Hamilton) that turns the stick's coordinates into"
    " the reference's.",
    "The gyroscope is in rad/s, the accelerometer in m/s^2, the magnetometer in a unit that is not stated.",
    "Vicon and the IMU share one clock, in seconds; a pose was taken at its stamp.",
    "Which way is up in the reference is not in the file (about z, to one or two degrees): gravity_ref is"
    " not set.",
)


def load(path: Path | str) -> Recording:
    """One trial: the IMU, and Vicon's attitude as the tracker.

    A static trial, whose quaternions are all zero, is a run of the IMU alone. Raises `RecordingError`,
    which names file, line and column.
    """
    lines = read_lines(path, _WHAT)
    titles = [title for title, parts in _HEADER for _ in parts]
    labels = [f"{title} {part}".strip() for title, parts in _HEADER for part in parts]
    above, below = (stripped(lines.cells[i]) if i < len(lines.cells) else [] for i in range(2))
    heads = [title if i == 0 or title != titles[i - 1] else "" for i, title in enumerate(titles)]
    if above != stripped(heads) or below != [part for _, parts in _HEADER for part in parts]:
        raise RecordingError(
            lines.path,
            f"a header {lines.delimiter.join(above)}",
            lines.delimiter.join(stripped(heads)),
            "a file of RepoIMU as it is published",
            line=lines.numbers[0],
        )
    rows = lines.body(1, len(titles))
    source = timed(rows, *rows.times(0, labels[0], NANOSECONDS))
    values = source.rows.floats(range(1, len(labels)), labels[1:])
    place, time_ns = source.rows.place, source.time_ns
    imu, told = screening.imu(place, time_ns, values[:, 7:10], values[:, 4:7], values[:, 10:])
    # The semicolons are the format's own.
    account = {"imu": replace(accounted(told, source), notes=told.notes)}
    assumptions: list[str] = list(_ASSUMPTIONS)
    optical = None
    if (values[:, :4] == 0.0).all():
        assumptions.append("Every quaternion of Vicon is zero: there is no tracker in this trial.")
        reason = screening.reasoned(place, np.arange(len(time_ns)), time_ns)
        told = Intake(len(time_ns), {"missing tool (zero quaternion)": reason}, unit=place.unit)
    else:
        optical, told = screening.optical(place, time_ns, values[:, :4])
    account["optical"] = replace(accounted(told, source), notes=told.notes)
    return Recording(
        Path(path).name.split(".")[0] or "repoimu",
        optical=optical,
        imu=imu,
        info={"dataset": "RepoIMU", "assumptions": assumptions},
        path=Path(path),
        intake=account,
    )
