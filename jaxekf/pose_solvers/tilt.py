"""Vertical, static intervals and magnetic field of an IMU, before any filter.

The functions use samples up to each instant, except for the noise and bias at rest, which come from the
whole run. The results weight a magnetometer; no estimate takes its attitude from them.
"""

from dataclasses import replace
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from jaxekf._support.deprecations import renamed
from jaxekf.geometry.host_rotation import running_product
from jaxekf.recordings.types import NANOSECONDS, Flags, Floats, Imu, from_scipy, period_ns, to_scipy

_SETTLING_S = 3.0
"""Time constant, s, of the low-pass in the non-rotating frame, which averages out accelerations of a
hand."""
_STILL_S = 1.0
_STILL_RATE, _STILL_FORCE = np.deg2rad(1.0), 0.3
"""Bounds on the noise of a static sensor, rad/s and m/s^2."""
_QUIETEST, _LOUDER = 0.02, 1.6
"""Share of seconds that are static at least, and the factor over their scatter that is still static."""
_LEAST = 0.05
"""Share of those bounds below which samples are always static: readings may repeat exactly."""
_SLOWEST_MEAN = np.deg2rad(2.0)
"""rad/s: a gyroscope with a larger mean rotates, whatever its scatter."""


def integrated_attitude(imu: Imu) -> Floats:
    """Quaternions (N, 4) from the body at each sample to the body at the first, by the gyroscope alone.

    Examples
    --------
    >>> import jaxekf, numpy as np
    >>> from jaxekf.pose_solvers import tilt
    >>> time_ns = np.arange(101) * 10_000_000  # 1 s
    >>> rate = np.tile([0.0, 0.0, np.pi / 2], (101, 1))
    >>> q_first_last = tilt.integrated_attitude(jaxekf.Imu(time_ns, rate))[-1]
    >>> np.allclose(q_first_last, np.sqrt([0.5, 0.0, 0.0, 0.5]))
    True
    """
    step = np.diff(imu.time_ns) / NANOSECONDS
    angle = 0.5 * (imu.gyroscope[1:] + imu.gyroscope[:-1]) * step[:, None]
    q = running_product(from_scipy(Rotation.from_rotvec(angle)))
    return q / np.linalg.norm(q, axis=1, keepdims=True)


def up_in_body(imu: Imu, settling_s: float = _SETTLING_S) -> Floats:
    """Unit vectors (N, 3) of the vertical in the body frame.

    The specific force is low-passed in a non-rotating frame. The gyroscope's bias at rest is subtracted if
    the run has static intervals; otherwise the frame would drift and the result lag by degrees.

    Parameters
    ----------
    imu
        Samples with specific forces.
    settling_s
        Time constant of the second-order Butterworth low-pass, s.

    Examples
    --------
    >>> import jaxekf, numpy as np
    >>> from jaxekf.pose_solvers import tilt
    >>> time_ns, rest = np.arange(201) * 10_000_000, np.zeros((201, 3))
    >>> imu = jaxekf.Imu(time_ns, rest, accelerometer=np.tile([0.0, 0.0, 9.81], (201, 1)))
    >>> np.allclose(tilt.up_in_body(imu)[-1], [0.0, 0.0, 1.0])
    True
    """
    # Slow to import, and every model is imported with this module.
    from scipy.signal import butter, sosfilt, sosfilt_zi

    assert imu.accelerometer is not None
    resting = static_samples(imu)
    bias = np.median(imu.gyroscope[resting], axis=0) if resting.any() else np.zeros(3)
    q = to_scipy(integrated_attitude(replace(imu, gyroscope=imu.gyroscope - bias)))
    force = q.apply(imu.accelerometer)
    if len(force) == 1:
        return force / np.maximum(np.linalg.norm(force, axis=1, keepdims=True), 1e-12)
    rate = NANOSECONDS / max(period_ns(imu.time_ns), 1)
    corner = min(np.sqrt(2.0) / (2.0 * np.pi * settling_s), 0.4 * rate)
    sos = butter(2, corner, fs=rate, output="sos")
    first = force[: max(1, int(0.1 * rate))].mean(axis=0)
    smooth, _ = sosfilt(sos, force, axis=0, zi=sosfilt_zi(sos)[:, :, None] * first)
    inside = q.inv().apply(smooth)
    return inside / np.maximum(np.linalg.norm(inside, axis=1, keepdims=True), 1e-12)


def static_samples(imu: Imu) -> Flags:
    """Mask (N,) of samples at the end of a static second.

    A second is static if its readings scatter as little as in the quietest seconds of the run, whose
    scatter is limited to a sensor's possible noise.
    """
    width = max(2, int(_STILL_S * NANOSECONDS / max(period_ns(imu.time_ns), 1)))
    quiet = _quiet(imu.gyroscope, width, _STILL_RATE)
    quiet &= np.linalg.norm(_trailing(imu.gyroscope, width), axis=1) < _SLOWEST_MEAN
    if imu.accelerometer is not None:
        quiet &= _quiet(imu.accelerometer, width, _STILL_FORCE)
    quiet[: width - 1] = False
    return quiet


class MagneticField(NamedTuple):
    """Magnetic field as measured."""

    norm: Floats
    """(N,) in the sensor's unit."""
    dip: Floats
    """(N,) rad below the horizontal."""


def magnetic_field(imu: Imu) -> MagneticField:
    """Norm and dip of the field at each sample of a magnetometer; NaN where it was not read."""
    assert imu.magnetometer is not None
    norm = np.linalg.norm(imu.magnetometer, axis=1)
    # Some loggers write zeros for missing readings.
    norm = np.where(np.isfinite(norm) & (norm > 0.0), norm, np.nan)
    with np.errstate(invalid="ignore"):
        down = -np.sum(imu.magnetometer * up_in_body(imu), axis=1) / norm
    return MagneticField(norm, np.arcsin(np.clip(down, -1.0, 1.0)))


def _quiet(values: Floats, width: int, most: float) -> Flags:
    """Whether the last `width` of values (N, 3) scatter about as the quietest, and less than `most`."""
    values = values - values.mean(axis=0)
    spread = _trailing(values**2, width) - _trailing(values, width) ** 2
    deviation = np.sqrt(np.maximum(spread.max(axis=1), 0.0))
    own = np.quantile(deviation[width - 1 :], _QUIETEST) if len(values) >= width else 0.0
    return deviation < np.clip(_LOUDER * own, _LEAST * most, most)


def _trailing(values: Floats, width: int) -> Floats:
    """Mean of the last `width` values, of fewer at the start."""
    total = np.concatenate([np.zeros((1, values.shape[1])), np.cumsum(values, axis=0)])
    end = np.arange(1, len(values) + 1)
    begin = np.maximum(end - width, 0)
    return (total[end] - total[begin]) / (end - begin)[:, None]


__getattr__ = renamed(
    __name__,
    "Field>MagneticField field>magnetic_field still>static_samples turned>integrated_attitude",
)
