"""Recordings of a tracker and an IMU from known motion, by NumPy and SciPy alone, in which faults of a
sensor are planted."""

from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from jaxekf.recordings.types import Encoder, Imu, Optical, Recording


class Motion:
    """Sums of three sines about each of three axes, still at first, with bursts about z."""

    def __init__(self, seed=0, amplitude_deg=(60.0, 30.0, 60.0), spin_deg_s=0.0, bursts=()):
        random = np.random.default_rng(1000 + seed)
        self.frequency = random.uniform(0.1, 0.8, (3, 3, 1))
        self.phase = random.uniform(0.0, 2.0 * np.pi, (3, 3, 1))
        self.size = random.dirichlet(np.ones(3), 3)[..., None]
        self.size = self.size * np.deg2rad(amplitude_deg)[:, None, None]
        self.spin, self.bursts = np.deg2rad(spin_deg_s), bursts

    def rotation(self, t):
        """Attitudes at times (N,), s."""
        angles = (self.size * np.sin(2.0 * np.pi * self.frequency * t + self.phase)).sum(axis=1)
        start = (self.size * np.sin(self.phase)).sum(axis=1)
        angles = (angles - start) * (t**3 / (t**3 + 1.0))
        about_z = self.spin * t
        for begin, turn_deg in self.bursts:
            phase = np.clip((t - begin) / 0.6, 0.0, 1.0)
            about_z = about_z + np.deg2rad(turn_deg) * 0.5 * (1.0 - np.cos(np.pi * phase))
        own = Rotation.from_rotvec(about_z[:, None] * [0.0, 0.0, 1.0])
        return Rotation.from_euler("ZYX", angles.T) * own

    def rate(self, t, h=1e-5):
        """Body rates (N, 3), rad/s."""
        return (self.rotation(t - h).inv() * self.rotation(t + h)).as_rotvec() / (2.0 * h)


def wxyz(rotation):
    """Quaternions (N, 4) with the scalar first."""
    return np.roll(rotation.as_quat(), 1, axis=1)


def ns(t):
    """Times in nanoseconds."""
    return np.round(1e9 * t).astype(np.int64)


def pair(
    seed=0, *, duration_s=30.0, imu_hz=200.0, tracker_hz=60.0, noise_deg=0.2, gyro_deg=0.3, **motion
):
    """A run of a tracker and a gyroscope with a constant bias, white noise of a sample in deg and deg/s,
    and truth at 100 Hz; and the bias (3,)."""
    random, path = np.random.default_rng(seed), Motion(seed, **motion)
    imu, seen, known = (np.arange(1e-9, duration_s, 1.0 / hz) for hz in (imu_hz, tracker_hz, 100.0))
    bias = np.deg2rad([0.4, -0.3, 0.5])
    rate = path.rate(imu) + bias + np.deg2rad(gyro_deg) * random.normal(size=(len(imu), 3))
    error = Rotation.from_rotvec(np.deg2rad(noise_deg) * random.normal(size=(len(seen), 3)))
    every = np.ones(len(known), bool)
    run = Recording(
        f"pair-{seed}",
        optical=Optical(ns(seen), wxyz(path.rotation(seen) * error), np.ones(len(seen), bool)),
        imu=Imu(ns(imu), rate),
        encoder=Encoder(ns(known), wxyz(path.rotation(known)), every, every),
    )
    return run, bias


def with_stream(run, label, **changes):
    """The run with fields of one stream replaced."""
    return run.replace(**{label: replace(getattr(run, label), **changes)})
