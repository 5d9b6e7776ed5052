"""Importer of an IMU with a pose stream in the ASL layout: EuRoC, TUM-VI and similar data sets.

A recording is a folder ``FOLDER/mav0`` with one folder for each stream, each a ``data.csv`` and mostly a
``sensor.yaml`` (Burri et al. 2016, doi 10.1177/0278364915620033), or, flat, a pair of files
``NAME_imu.txt`` and ``NAME_mocap.csv``. Stamps are nanoseconds; quaternions are in the order w, x, y, z
unless the header states another.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from jaxekf._support.errors import RecordingError
from jaxekf.io.csv_table import finite_numbers, numbers
from jaxekf.io.importers._asl_columns import Samples, read_samples
from jaxekf.io.importers._asl_sensor_yaml import (
    IDENTITY,
    Transform,
    extrinsics,
    imu_noise,
    read_description,
)
from jaxekf.io.importers._asl_streams import (
    Stream,
    choose_streams,
    find,
    only_recording,
    recording_name,
)
from jaxekf.io.importers._exports import accounted
from jaxekf.pose_solvers.marker_pose import gravity
from jaxekf.recordings import screening
from jaxekf.recordings.accounts import Intake
from jaxekf.recordings.types import Imu, Optical, Recording, from_scipy, to_scipy

__all__ = ["find", "load"]
_RATE_AND_FORCE = ("wx", "wy", "wz", "ax", "ay", "az")
_POSE = ("px", "py", "pz", "qw", "qx", "qy", "qz")
_GRAVITY_REF = (0.0, 0.0, -9.81)
_FARTHEST_GRAVITY = 1.0
"""m/s^2: an accelerometer's bias is less, a wrong axis, unit or transform is more."""


def load(
    path: Path | str | None = None,
    *,
    imu: Path | str | None = None,
    pose: Path | str | None = None,
) -> Recording:
    """Read one recording: gyroscope and accelerometer, and the tracker's attitude and position.

    The body is the IMU's frame I. With the transforms ``T_BS`` of the two ``sensor.yaml`` (sensor to the
    data set's own body frame B; the identity by default)::

        T_I_S = inverse(T_B_I) T_B_S        S: the tracked frame, R: the reference
        q_ref_body = q_R_S conj(q_I_S)      unit quaternions (N, 4), w x y z
        p_body_tool = p_I_S                 (3,) m
        position = p_R_S                    (N, 3) m, not moved

    Parameters
    ----------
    path : path, optional
        A folder that holds ``mav0``, a ``mav0`` itself, the prefix of a flat pair of files (``.../room1``
        for ``room1_imu.txt`` and ``room1_mocap.csv``), or a folder with one recording in or below it; see
        `find`. May be left out if both `imu` and `pose` are given.
    imu, pose : path, optional
        Other streams: the name of a stream's folder in the recording, a folder, or a file. Measured poses
        are preferred to estimates: ``vicon0``, ``mocap0``, others of `sensor_type` pose,
        ``state_groundtruth_estimate0``, others of `sensor_type` visual-inertial.

    Returns
    -------
    Recording
        Rates in rad/s and specific forces in m/s^2, both (N, 3) in I. A pose is not valid if its quaternion
        is zero or not near unit norm, or if one of its numbers is missing. Exact duplicates and a truncated
        last line are dropped; `intake` accounts for them by line. `info` holds ``imu_stream``,
        ``pose_stream``, ``pose_kind`` (measured, estimate or unknown), ``duplicate_rows`` dropped,
        ``imu_noise`` from ``sensor.yaml`` (rad/s/√Hz, rad/s²/√Hz, m/s²/√Hz, m/s³/√Hz), ``gravity_ref``
        (approximate, m/s²) and, in sentences, all ``assumptions``.

    Raises
    ------
    RecordingError
        For a missing stream, cells that are not numbers, stamps that are not whole nanoseconds or do not
        increase, a ``T_BS`` that is not a rigid motion, and a gravity vector, found from both streams,
        other than assumed; names file, line and column.
    """
    place = None if path is None else Path(path)
    if place is not None and place.is_dir() and (imu is None or pose is None):
        place = only_recording(place)
    imu_stream, pose_stream = choose_streams(place, imu, pose)
    imu_source, pose_source = _read(imu_stream, _RATE_AND_FORCE), _read(pose_stream, _POSE)
    # A flat pair's name is its prefix, however it was given.
    unnamed = place is None or place == imu_stream.file.parent
    transform = imu_source.body_sensor.inverse().then(pose_source.body_sensor)
    optical, optical_account = _optical(pose_source, transform)
    inertial, imu_account = _imu(imu_source)
    recording = Recording(
        recording_name(imu_stream.file if place is None or unnamed else place),
        optical=optical,
        imu=inertial,
        info=_info(imu_source, pose_source),
        path=place or imu_stream.file,
        intake={"optical": optical_account, "imu": imu_account},
    )
    _check_gravity(recording, pose_stream)
    return recording


def _check_gravity(recording: Recording, stream: Stream) -> None:
    """Raise if accelerometer and poses together contradict the gravity vector that the layout assumes."""
    try:
        found = gravity(recording.need_optical(), recording.need_imu(), stream.file)
    except RecordingError:
        return
    if np.linalg.norm(found - _GRAVITY_REF) > _FARTHEST_GRAVITY:
        raise RecordingError(
            stream.file,
            f"a gravity vector of {np.round(found, 2).tolist()} m/s^2 by accelerometer and poses together",
            f"about {list(_GRAVITY_REF)}",
            "checking that the reference's z points up, the units (m/s^2, m, ns), the order of the"
            " quaternion, T_BS and that both streams have one clock",
        )


class _Source(NamedTuple):
    """A stream with its description and its rows."""

    stream: Stream
    description: Mapping[str, Any]
    body_sensor: Transform
    samples: Samples


def _read(stream: Stream, wanted: Sequence[str]) -> _Source:
    file, description, body_sensor = stream.sensor_yaml, {}, IDENTITY
    if file is not None:
        description = read_description(file)
        body_sensor = extrinsics(file, description)
    return _Source(stream, description, body_sensor, read_samples(stream.file, wanted))


def _imu(source: _Source) -> tuple[Imu, Intake]:
    table, time_ns, labels = source.samples[:3]
    values = finite_numbers(table, labels)
    imu, account = screening.imu(table.place, time_ns, values[:, :3].copy(), values[:, 3:].copy())
    return imu, accounted(account, table, source.samples.dropped)


def _optical(source: _Source, body_sensor: Transform) -> tuple[Optical, Intake]:
    """The body's attitude and the tracked point's position, given the tracked frame in the body."""
    table, time_ns, labels = source.samples[:3]
    values = numbers(table, labels, blank=True)
    sensor, account = screening.optical(
        table.place,
        time_ns,
        values[:, 3:],
        values[:, :3].copy(),
        p_body_tool=body_sensor.translation.copy(),
    )
    q_ref_body = from_scipy(to_scipy(sensor.q_ref_body) * body_sensor.rotation.inv())
    q_ref_body[~sensor.valid] = (1.0, 0.0, 0.0, 0.0)
    account = accounted(account, table, source.samples.dropped)
    return replace(sensor, q_ref_body=q_ref_body), account


def _info(imu: _Source, pose: _Source) -> dict[str, Any]:
    duplicates = {
        label: one.samples.dropped["repeated"].count if "repeated" in one.samples.dropped else 0
        for label, one in (("imu", imu), ("optical", pose))
    }
    info: dict[str, Any] = {
        "dataset": "ASL",
        "imu_stream": imu.stream.label,
        "pose_stream": pose.stream.label,
        "pose_kind": pose.stream.kind,
        "duplicate_rows": duplicates,
        "gravity_ref": list(_GRAVITY_REF),
        "assumptions": list(_assumptions(imu, pose)),
    }
    noise = imu_noise(imu.stream.sensor_yaml, imu.description) if imu.stream.sensor_yaml else {}
    return info | ({"imu_noise": noise} if noise else {})


def _assumptions(imu: _Source, pose: _Source) -> Iterator[str]:
    """Assumptions of the importer, in sentences."""
    yield f"The body is the frame of the IMU ({imu.stream.label})."
    for source, frame in ((imu, "the IMU's"), (pose, "the tracked")):
        label = source.stream.label
        if "T_BS" not in source.description:
            lack = "T_BS in the sensor.yaml" if source.stream.sensor_yaml else "sensor.yaml"
            yield (
                f"Extrinsics of {label}: no {lack}, so {frame} frame is assumed to be the data set's "
                "body frame (T_BS = identity)."
            )
        named = source.samples.named
        how = "as its header names them" if named else "no header names them; assumed to be time"
        yield f"Columns of {label}: {how}, {' '.join(source.samples.labels)}."
    yield "Quaternions are Hamilton and turn the tracked frame's coordinates into the reference's."
    yield "Stamps of both streams are nanoseconds of one clock; a pose was taken at its stamp."
    yield "Units are rad/s, m/s^2 and m."
    yield f"z of the reference points up; gravity_ref = {list(_GRAVITY_REF)} m/s^2 is approximate."
    if pose.stream.kind == "estimate":
        yield (
            f"{pose.stream.label} is an estimate made with this very IMU: "
            "its errors are correlated with the IMU's."
        )
