"""Samples that the sensors and inputs of the models read from a recording."""

import numpy as np
from jax import Array

from jaxekf._support.deprecations import renamed
from jaxekf._support.errors import RecordingError
from jaxekf.filtering.model import Parameters
from jaxekf.recordings.clipping import clipped
from jaxekf.recordings.types import Floats, Markers, Optical, Recording, Samples, to_scipy


def optical_attitude(recording: Recording) -> Samples:
    """The tracker's attitude, quaternions (N, 4), body to reference; invisible samples are masked."""
    if recording.optical is None and recording.markers is not None:
        raise RecordingError(
            recording.path or recording.name,
            "single markers and no optical stream",
            "the tracker's attitude for this model",
            "the model tight (--model tight), which takes single markers",
        )
    optical = recording.need_optical()
    taken = optical.time_ns - optical.latency_ns
    late = optical.latency_ns
    return Samples(taken, optical.q_ref_body, optical.valid, latency_ns=late, origin=("optical",))


def single_markers(recording: Recording) -> Markers:
    """The markers; the error without any names the model for the stream that the run has instead."""
    if recording.markers is None and recording.optical is not None:
        raise RecordingError(
            recording.path or recording.name,
            "an optical stream and no single markers",
            "markers for this model",
            "the model loose, or loose_pose if the tracker reports positions",
        )
    return recording.need_markers()


def gyroscope(recording: Recording) -> Samples:
    """The gyroscope's rate (N, 3), rad/s, body frame; samples that are not finite are masked."""
    imu = recording.need_imu()
    finite = np.asarray(np.isfinite(imu.gyroscope).all(axis=1))
    beyond = clipped(imu.gyroscope)
    return Samples(imu.time_ns, imu.gyroscope, finite, origin=("imu",), at_limit=beyond)


def imu(recording: Recording) -> Samples:
    """Gyroscope and accelerometer (N, 6), rad/s and m/s^2, body frame."""
    stream = recording.need_imu()
    if stream.accelerometer is None:
        raise RecordingError(
            recording.path or recording.name,
            "an IMU without accelerometer",
            "one for a model of position",
            "adding ax,ay,az to imu.csv, or the model loose",
        )
    both = np.concatenate([stream.gyroscope, stream.accelerometer], axis=1)
    finite = np.asarray(np.isfinite(both).all(axis=1))
    beyond = clipped(stream.gyroscope)
    return Samples(stream.time_ns, both, finite, origin=("imu",), at_limit=beyond)


def clock_offset(params: Parameters) -> Array:
    """Offset of the IMU's clock, s, of a model that has it among its parameters."""
    return params.calibration.clock_offset


def clock_drift(params: Parameters) -> Array:
    """Its growth, s/s."""
    return params.calibration.clock_drift


def tracked_position(optical: Optical, recording: Recording) -> Floats:
    """The tracker's position (N, 3), m, reference frame; an error if it reports attitude only."""
    if optical.position is None:
        raise RecordingError(
            recording.path or recording.name,
            "a tracker without position",
            "one for a model of position",
            "adding x,y,z to optical.csv, or the model loose",
        )
    return optical.position


def rotated_to_reference(q_ref_body: Floats, vector: Floats) -> Floats:
    """A body vector (3,) in the reference frame at each of the attitudes (N, 4)."""
    return to_scipy(q_ref_body).apply(vector)


__getattr__ = renamed(__name__, "turned>rotated_to_reference")
