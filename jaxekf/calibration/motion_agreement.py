"""Agreement of a tracker and an IMU in rotation and translation, from a subset of the samples.

`relative_rotations` pairs rotations of the tracker with the integrated rate of the gyroscope, `fit` finds
the rotation and scale between them, `acceleration_fit` compares the tracker's path with the accelerometer.
The functions measure and do not judge; a quantity that the data do not determine is NaN. They use NumPy and
SciPy only.
"""

from collections.abc import Callable, Mapping
from typing import NamedTuple

import numpy as np

from jaxekf._support.deprecations import renamed
from jaxekf.geometry.host_rotation import nearest_rotation
from jaxekf.recordings.accounts import Indices
from jaxekf.recordings.types import (
    NANOSECONDS,
    Flags,
    Floats,
    Imu,
    Optical,
    Times,
    period_ns,
    to_scipy,
)

LARGEST_LAG_S = 0.5
"""Largest lag, s, that the search covers."""
_FEWEST = 40
"""Fewest pairs of samples from which anything is estimated."""
_PAIRS = 4000
"""Pairs of samples that are compared, spread over the run."""
_SEARCHED = 1500
"""Pairs among them that the lag search uses."""
_SPANS_S = (0.1, 0.4, 1.0)
"""Time spans, s, of a relative rotation, tried in turn until the rotations are clear."""
_CLEAR_ROTATION = np.deg2rad(5.0)
"""A rotation well above a tracker's noise, rad; for slower motion the next longer span is tried."""
_OUTLIER_SHARE = 0.1
"""Share of the largest residuals that is left out: wrong poses."""
_OUTLYING_ROTATION = np.deg2rad(3.0)
_HALF_WIDTH_S = 0.2
"""Half the time span of a second difference of positions, s."""
_NODES = 13
"""Integration nodes over the span of a second difference."""
_CENTRES = 1500
"""Second differences that are compared."""

QuaternionReading = Callable[[Floats], Floats]
"""Takes quaternions (N, 4) as read to those of another component order or direction."""


class RelativeRotations(NamedTuple):
    """Rotations of the tracker between pairs of samples, and of the gyroscope over the same time."""

    tracker: Floats
    """(N, 3) rotation vectors, rad, frame of the tracked tool."""
    gyroscope: Floats
    """(N, 3) rad, integral of the rate at the lag found, IMU frame."""
    duration_s: Floats
    """(N,) s."""
    lag_s: float
    """Lag that was subtracted from the tracker's time stamps, s."""
    q_begin: Floats
    """(N, 4) attitudes at the beginning of each pair."""
    q_end: Floats
    """(N, 4) attitudes at the end of each pair."""
    begin_s: Floats
    """(N,) beginning of each pair, s from the IMU's first sample, lag subtracted."""


class MotionFit(NamedTuple):
    """Least-squares fit of the gyroscope's rotations, rotated and scaled, to the tracker's."""

    explained: float
    """Share of the tracker's squared rotation that the gyroscope explains, 0 to 1."""
    rate_ratio: float
    """Rate of the gyroscope over that of the tracker."""
    frame: Floats
    """(3, 3) rotation matrix, IMU frame to tool frame."""

    @property
    def angle(self) -> float:
        """Angle of `frame`, rad."""
        return float(np.arccos(np.clip(0.5 * (np.trace(self.frame) - 1.0), -1.0, 1.0)))


class Integral:
    """Integral over time of a stream of vectors, piecewise linear between the samples."""

    def __init__(self, time_ns: Times, values: Floats) -> None:
        self.t = (time_ns - time_ns[0]) / NANOSECONDS
        steps = 0.5 * (values[1:] + values[:-1]) * np.diff(self.t)[:, None]
        self.sums = np.concatenate([np.zeros((1, 3)), np.cumsum(steps, axis=0)])

    def between(self, begin: Floats, end: Floats) -> Floats:
        """Integral (N, 3) from times `begin` to `end` (N,), s from the first sample."""
        sums = self.sums.T
        return np.stack(
            [np.interp(end, self.t, s) - np.interp(begin, self.t, s) for s in sums], axis=1
        )


def sample_pairs(
    t: Floats, span_s: float, last_s: float, most: int = _PAIRS
) -> tuple[Indices, Indices]:
    """Pairs of samples about one time span apart.

    Parameters
    ----------
    t
        (N,) sample times, s from the IMU's first sample.
    span_s
        Time span of a pair, s; pairs up to 1.5 times as long are accepted.
    last_s
        Last time of the IMU, s. Pairs keep a margin to both ends, for the lag.
    most
        Largest number of pairs, about.

    Returns
    -------
    Indices (M,) of the first and of the second sample of each pair.
    """
    room = min(LARGEST_LAG_S, 0.1 * last_s)
    begin = np.flatnonzero((t >= room) & (t <= last_s - room - span_s))
    begin = begin[:: max(1, -(-len(begin) // most))]
    end = np.searchsorted(t, t[begin] + 0.999 * span_s)
    good = end < len(t)
    begin, end = begin[good], end[good]
    good = t[end] - t[begin] <= 1.5 * span_s
    return begin[good], end[good]


def relative_rotations(
    t: Floats, attitude: Callable[[Indices], Floats], imu: Imu, most: int = _PAIRS
) -> RelativeRotations | None:
    """Relative rotations of tracker and gyroscope over pairs of samples, at the lag that fits best.

    Parameters
    ----------
    t
        (N,) times of the tracker's valid attitudes, s from the IMU's first sample.
    attitude
        Takes indices (n,) to quaternions (n, 4), tool to reference.
    imu
        The IMU's samples.
    most
        Largest number of pairs, about.

    Returns
    -------
    None if there are fewer than 40 pairs.
    """
    if len(t) < 2 or len(imu.time_ns) < 2:
        return None
    integral = Integral(imu.time_ns, imu.gyroscope)
    step, last = float(np.median(np.diff(t))), float(integral.t[-1])
    for span_s in _SPANS_S:
        # Whole steps: samples 80 ms apart are 160 ms apart next, no longer about 100 ms.
        whole = step * max(1.0, np.ceil(span_s / step - 1e-3))
        begin, end = sample_pairs(t, whole, last, most)
        if len(begin) < _FEWEST:
            return None
        rows, where = np.unique(np.concatenate([begin, end]), return_inverse=True)
        q = attitude(rows)[where]
        first, second = q[: len(begin)], q[len(begin) :]
        tracked = rotation_vectors(first, second)
        size = np.linalg.norm(tracked, axis=1)
        if span_s == _SPANS_S[-1] or np.quantile(size, 0.9) > _CLEAR_ROTATION:
            lag = _lag(t[begin], t[end], size, integral)
            integrated = integral.between(t[begin] - lag, t[end] - lag)
            return RelativeRotations(
                tracked, integrated, t[end] - t[begin], lag, first, second, t[begin] - lag
            )
    return None


def rotation_vectors(first: Floats, second: Floats) -> Floats:
    """Rotation vectors (N, 3), rad, from attitudes `first` to `second` (N, 4), in the body frame."""
    return (to_scipy(first).inv() * to_scipy(second)).as_rotvec()


def outlying_poses(q: Floats) -> Flags:
    """Mask (N,) of attitudes (N, 4) that differ from both neighbours while these agree with each other."""
    found = np.zeros(len(q), bool)
    if len(q) > 2:
        step = _angle(q[1:], q[:-1])
        over = _angle(q[2:], q[:-2])
        found[1:-1] = np.minimum(step[1:], step[:-1]) > _OUTLYING_ROTATION + 3.0 * over
    return found


def _angle(a: Floats, b: Floats) -> Floats:
    """Angle (N,), rad, between attitudes (N, 4)."""
    return 2.0 * np.arccos(np.minimum(np.abs(np.einsum("ni,ni->n", a, b)), 1.0))


def _lag(begin: Floats, end: Floats, size: Floats, integral: Integral) -> float:
    """Lag, s, at which the rotation angles correlate best, independent of frames and units."""
    few = slice(None, None, max(1, -(-len(size) // _SEARCHED)))
    begin, end = begin[few], end[few]
    # Wrong poses would dominate the correlation. The larger bound keeps motion that fills few pairs only.
    sizes = np.stack([np.minimum(size[few], np.quantile(size, most)) for most in (0.9, 0.98)])
    room = min(LARGEST_LAG_S, 0.1 * float(integral.t[-1]))

    def gyroscope_angle(lag: float) -> Floats:
        return np.linalg.norm(integral.between(begin - lag, end - lag), axis=1)

    coarse = best_lag(sizes, gyroscope_angle, np.arange(-room, room + 0.01, 0.02))
    return best_lag(sizes, gyroscope_angle, coarse + np.arange(-0.02, 0.021, 0.005))


def best_lag(signals: Floats, delayed: Callable[[float], Floats], lags: Floats) -> float:
    """Lag at which a delayed signal correlates best with one of some signals.

    Parameters
    ----------
    signals
        (K, N) versions of one signal, such as one for each bound on its outliers.
    delayed
        Takes a lag, s, to the other signal (N,) delayed by it.
    lags
        (L,) lags to try, s.

    Returns
    -------
    The lag of the largest correlation coefficient; the smallest lag where the other signal is constant.
    """
    signals = signals - signals.mean(axis=1, keepdims=True)
    signals /= np.maximum(np.linalg.norm(signals, axis=1, keepdims=True), 1e-12)

    def correlation(lag: float) -> float:
        other = delayed(lag)
        other = other - other.mean()
        norm = float(np.sqrt(np.sum(np.square(other))))
        return float(np.max(signals @ other)) / norm if norm > 0.0 else -np.inf

    return float(max(lags, key=lambda lag: (correlation(lag), -abs(lag))))


def fit(tracker: Floats, gyroscope: Floats) -> MotionFit:
    """Rotation (Wahba's problem) and scale from gyroscope to tracker, the worst tenth left out.

    Parameters
    ----------
    tracker, gyroscope
        (N, 3) relative rotations, rad, as in `RelativeRotations`.
    """
    weight = limiting_weights(tracker, 0.95)
    found = _motion_fit(tracker * weight, gyroscope * weight)
    off = np.linalg.norm(tracker - gyroscope @ found.frame.T / found.rate_ratio, axis=1)
    kept = off <= np.quantile(off, 1.0 - _OUTLIER_SHARE)
    return _motion_fit(tracker[kept], gyroscope[kept])


def limiting_weights(vectors: Floats, quantile: float) -> Floats:
    """Weights (N, 1) that limit the lengths of vectors (N, 3) to a quantile: wrong poses count less."""
    size = np.linalg.norm(vectors, axis=1, keepdims=True)
    return np.minimum(1.0, np.quantile(size, quantile) / np.maximum(size, 1e-12))


def _motion_fit(tracker: Floats, gyroscope: Floats) -> MotionFit:
    frame = nearest_rotation(tracker.T @ gyroscope)
    shared = float(np.sum(tracker * (gyroscope @ frame.T)))
    one, other = float(np.sum(np.square(tracker))), float(np.sum(np.square(gyroscope)))
    if shared <= 0.0:
        return MotionFit(0.0, np.inf, frame)
    return MotionFit(shared**2 / (one * other), other / shared, frame)


def fit_readings(
    rotations: RelativeRotations, others: Mapping[str, QuaternionReading]
) -> dict[str, MotionFit]:
    """The fit under each other reading of the quaternions, by the name of the reading."""
    return {
        name: fit(
            rotation_vectors(read(rotations.q_begin), read(rotations.q_end)), rotations.gyroscope
        )
        for name, read in others.items()
    }


def second_axis_share(vectors: Floats) -> float:
    """Squared rotation about the second principal axis over that about the first, 0 to 1."""
    values = np.linalg.eigvalsh(vectors.T @ vectors)
    return float(values[1] / values[2]) if values[2] > 0.0 else 0.0


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


__getattr__ = renamed(
    __name__,
    "Distance>AccelerationFit Fit>MotionFit Reading>QuaternionReading Turns>RelativeRotations "
    "distance>acceleration_fit pairs_of>sample_pairs readings>fit_readings "
    "second_axis>second_axis_share strays>outlying_poses turn_between>rotation_vectors "
    "turns>relative_rotations",
)
