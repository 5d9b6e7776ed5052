"""Agreement of a tracker's path and an accelerometer, from a subset of the samples.

`acceleration_fit` measures and does not judge; `mean_force` is the mean specific force in the
reference frame.
"""

from typing import NamedTuple

import numpy as np

from jaxekf.calibration.motion_agreement import Integral, RelativeRotations
from jaxekf.recordings.types import NANOSECONDS, Floats, Imu, Optical, period_ns, to_scipy

_FEWEST = 40
"""Fewest samples from which anything is estimated."""
_OUTLIER_SHARE = 0.1
"""Share of the largest differences that is left out: wrong poses."""
_HALF_WIDTH_S = 0.2
"""Half the time span of a second difference of positions, s."""
_NODES = 13
"""Integration nodes over the span of a second difference."""
_CENTRES = 1500
"""Second differences that are compared."""


class AccelerationFit(NamedTuple):
    """Agreement of the accelerations of a tracker and an accelerometer."""

    ratio: float
    """Acceleration of the tracker over that of the accelerometer."""
    correlation: float
    """Correlation coefficient of the two, all axes together."""
    acceleration: float
    """Root mean square of the tracker's acceleration, in its unit of length / s^2."""


def acceleration_fit(
    optical: Optical, imu: Imu, lag_s: float, frame: Floats
) -> AccelerationFit | None:
    """The tracker's second differences over 0.2 s against the accelerometer's double integral.

    ``p(t + T) - 2 p(t) + p(t - T)`` is the integral of ``(T - |s|) a(t + s)``; gravity is constant
    and cancels with the mean.

    Parameters
    ----------
    optical, imu
        Streams with positions and specific forces.
    lag_s
        Lag to subtract from the tracker's time stamps, s.
    frame
        (3, 3) rotation matrix, IMU frame to tool frame.

    Returns
    -------
    None if a stream lacks positions or specific forces, or if too few differences can be formed.
    """
    if optical.position is None or imu.accelerometer is None or len(imu.time_ns) < 2:
        return None
    usable = optical.valid & np.isfinite(optical.position).all(axis=1)
    rows = np.flatnonzero(usable)
    if len(rows) < _FEWEST:
        return None
    t = (optical.time_ns[rows] - optical.latency_ns - imu.time_ns[0]) / NANOSECONDS - lag_s
    integral = Integral(imu.time_ns, imu.accelerometer)
    inside = (t >= _HALF_WIDTH_S + 0.05) & (t <= integral.t[-1] - _HALF_WIDTH_S - 0.05)
    centre = t[inside][:: max(1, -(-int(inside.sum()) // _CENTRES))]
    nodes = np.linspace(-_HALF_WIDTH_S, _HALF_WIDTH_S, _NODES)
    at = centre[:, None] + nodes
    after = np.clip(np.searchsorted(t, at), 1, len(t) - 1)
    near = np.where(at - t[after - 1] < t[after] - at, after - 1, after)
    closed = t[after] - t[after - 1] <= 2.5 * period_ns(optical.time_ns) / NANOSECONDS
    good = closed.all(axis=1)
    if good.sum() < _FEWEST:
        return None
    at, near = at[good], near[good]
    width = 0.5 * (nodes[1] - nodes[0])
    flat = at.ravel()
    force = integral.between(flat - width, flat + width) / (2.0 * width) @ frame.T
    force = to_scipy(optical.q_ref_body[rows][near.ravel()]).apply(force).reshape(*at.shape, 3)
    weight = _HALF_WIDTH_S - np.abs(nodes)
    force = np.einsum("nji,j->ni", force, weight / weight.sum())
    path = optical.position[rows]
    where = np.stack([np.interp(at[:, [0, _NODES // 2, -1]], t, path[:, i]) for i in range(3)], 2)
    acceleration = (where[:, 2] - 2.0 * where[:, 1] + where[:, 0]) / _HALF_WIDTH_S**2
    return _fit_accelerations(acceleration, force)


def mean_force(rotations: RelativeRotations, imu: Imu, frame: Floats) -> Floats:
    """Mean specific force (3,), m/s^2, in the reference frame, opposite to gravity whatever the motion.

    Returns NaN without an accelerometer.
    """
    if imu.accelerometer is None:
        return np.full(3, np.nan)
    integral = Integral(imu.time_ns, imu.accelerometer)
    width = 0.05
    force = integral.between(rotations.begin_s - width, rotations.begin_s + width) / (2.0 * width)
    return to_scipy(rotations.q_begin).apply(force @ frame.T).mean(axis=0)


def _fit_accelerations(acceleration: Floats, force: Floats) -> AccelerationFit:
    one, other = acceleration - np.median(acceleration, axis=0), force - np.median(force, axis=0)
    # Wrong poses cause large differences.
    size = np.linalg.norm(one, axis=1)
    kept = size <= np.quantile(size, 1.0 - _OUTLIER_SHARE)
    one, other = one[kept] - one[kept].mean(axis=0), other[kept] - other[kept].mean(axis=0)
    shared = float(np.sum(one * other))
    squares = float(np.sum(one**2)), float(np.sum(other**2))
    if min(squares) <= 0.0:
        return AccelerationFit(np.nan, 0.0, 0.0)
    size = float(np.sqrt(squares[0] / len(one)))
    return AccelerationFit(shared / squares[1], shared / np.sqrt(squares[0] * squares[1]), size)
