"""Small runs from known rotation, with NumPy and SciPy: any speed, any clock and any mounting."""

import numpy as np
from scipy.spatial.transform import Rotation

from jaxekf.recordings.types import Imu, Optical, Recording, from_scipy


def motion(seed, amplitude_deg, fastest_hz=0.8, spin_deg_s=(0.0, 0.0, 0.0)):
    """Attitude over time: Euler angles z, y, x that swing, and a constant rotation about a body axis."""
    rng = np.random.default_rng(seed)
    frequency = 2.0 * np.pi * rng.uniform(0.1, fastest_hz, (3, 3))
    phase = rng.uniform(0.0, 2.0 * np.pi, (3, 3))
    size = rng.dirichlet(np.ones(3), 3) * np.deg2rad(amplitude_deg)[:, None]

    def attitude(t):
        t = np.asarray(t, float)
        angles = np.sum(
            size[..., None] * np.sin(frequency[..., None] * t + phase[..., None]), axis=1
        )
        spin = Rotation.from_rotvec(t[:, None] * np.deg2rad(spin_deg_s))
        return Rotation.from_euler("ZYX", angles.T) * spin

    return attitude


def run(
    attitude,
    *,
    duration_s=20.0,
    tracker_hz=60.0,
    imu_hz=200.0,
    seed=0,
    mounting_deg=(0.0, 0.0, 0.0),
    gain=1.0,
    clock=None,
    name="run",
):
    """A run; `mounting_deg` rotates the tool frame into the IMU's, `clock` takes times to stamps."""
    rng = np.random.default_rng([seed, 7])
    t_imu, t = (
        np.arange(0.0, duration_s, 1.0 / imu_hz),
        np.arange(0.0, duration_s, 1.0 / tracker_hz),
    )
    rate = (attitude(t_imu - 1e-5).inv() * attitude(t_imu + 1e-5)).as_rotvec() / 2e-5
    rate = Rotation.from_rotvec(np.deg2rad(mounting_deg)).apply(rate) + np.deg2rad([0.4, -0.3, 0.5])
    rate += np.deg2rad(0.05) * np.sqrt(imu_hz) * rng.standard_normal(rate.shape)
    noise = Rotation.from_rotvec(np.deg2rad(0.3) * rng.standard_normal((len(t), 3)))
    q, stamps = from_scipy(attitude(t) * noise), t if clock is None else clock(t)
    kept = stamps > np.concatenate([[-np.inf], np.maximum.accumulate(stamps)[:-1]])
    ns = [np.round(1e9 * (1000.0 + x)).astype(np.int64) for x in (stamps[kept], t_imu)]
    return Recording(
        name,
        optical=Optical(ns[0], q[kept], np.ones(kept.sum(), bool)),
        imu=Imu(ns[1], gain * rate),
    )
