"""Importer of RepoIMU's T-stick trials (Szczęsna et al. 2016, doi 10.1007/978-3-319-46418-3_45).

One CSV file a trial, plain or gzipped, cells separated by semicolons, a header of two lines: time in
seconds, Vicon's quaternion w, x, y, z, accelerometer, gyroscope and magnetometer.
"""

from dataclasses import replace
from pathlib import Path

import numpy as np

from jaxekf.io.csv_table import times_or_blank
from jaxekf.io.importers._exports import accounted, read_export, stamped_rows, stripped
from jaxekf.recordings import screening
from jaxekf.recordings.accounts import Intake
from jaxekf.recordings.types import NANOSECONDS, Recording

_EXPECTED = "a T-stick trial of RepoIMU"
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
    "The file does not state the direction of gravity in the reference (about z, to one or two degrees):"
    " gravity_ref is not set.",
)


def load(path: Path | str) -> Recording:
    """Read one trial: the IMU, and Vicon's attitude as the tracker.

    A static trial, whose quaternions are all zero, becomes a run of the IMU alone.

    Parameters
    ----------
    path : path
        A CSV file of a trial, plain or compressed with gzip.

    Returns
    -------
    Recording
        Times in ns; attitude w, x, y, z, body to reference; gyroscope in rad/s, accelerometer in m/s^2,
        magnetometer in the file's unit, in the frame of the IMU.

    Raises
    ------
    RecordingError
        If the file is not such a trial; names file, line and column.
    """
    export = read_export(path, _EXPECTED)
    titles = [title for title, parts in _HEADER for _ in parts]
    labels = [f"{title} {part}".strip() for title, parts in _HEADER for part in parts]
    above, below = (export.head + 2 * [export.head[0]])[:2]
    heads = [title if i == 0 or title != titles[i - 1] else "" for i, title in enumerate(titles)]
    if above.cells != stripped(heads) or below.cells != [x for _, parts in _HEADER for x in parts]:
        got = f"a header {export.delimiter.join(above.cells)}"
        expected = export.delimiter.join(stripped(heads))
        raise export.error(above, got, expected, "a file of RepoIMU as it is published")
    table = export.table(below, len(titles)).named({0: labels[0]})
    source = stamped_rows(table, *times_or_blank(table, labels[0], NANOSECONDS))
    values = source.floats(range(1, len(labels)), labels[1:])
    place, time_ns = source.table.place, source.time_ns
    imu, imu_account = screening.imu(
        place, time_ns, values[:, 7:10], values[:, 4:7], values[:, 10:]
    )
    assumptions: list[str] = list(_ASSUMPTIONS)
    optical = None
    if (values[:, :4] == 0.0).all():
        assumptions.append("Every quaternion of Vicon is zero: there is no tracker in this trial.")
        reason = screening.reasoned(place, np.arange(len(time_ns)), time_ns)
        account = Intake(len(time_ns), {"missing tool (zero quaternion)": reason}, unit=place.unit)
    else:
        optical, account = screening.optical(place, time_ns, values[:, :4])
    # Semicolons are this format's own delimiter and need no note.
    accounts = {
        label: replace(accounted(one, source.table, source.dropped), notes=one.notes)
        for label, one in (("imu", imu_account), ("optical", account))
    }
    return Recording(
        Path(path).name.split(".")[0] or "repoimu",
        optical=optical,
        imu=imu,
        info={"dataset": "RepoIMU", "assumptions": assumptions},
        path=Path(path),
        intake=accounts,
    )
