"""Where a recording holds what the sensors and inputs of the models read."""

import numpy as np

from jaxekf.recording import Recording, Samples


def optical_attitude(recording: Recording) -> Samples:
    """The tracker's attitude, quaternions (N, 4), hidden samples masked."""
    optical = recording.need_optical()
    return Samples(optical.time_ns, optical.q_ref_body, optical.valid)


def gyroscope(recording: Recording) -> Samples:
    """The gyroscope's rate (N, 3), rad/s, body frame."""
    imu = recording.need_imu()
    return Samples(imu.time_ns, imu.gyroscope, np.ones(len(imu.time_ns), bool))
