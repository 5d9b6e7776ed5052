"""How a tracker and an IMU agree in turning and distance: thinned out, in NumPy alone.

Nothing here judges. What the streams cannot tell is NaN.
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
_FEWEST = 40
_PAIRS = 4000
"""RelativeRotations that are looked at, spread over the run."""
_SEARCHED = 1500
"""Of them, those by which the lag is searched for."""
_SPANS_S = (0.1, 0.4, 1.0)
_CLEAR_ROTATION = np.deg2rad(5.0)
"""A turn that is well above a tracker's noise: a slower tool is watched for longer."""
_OUTLIER_SHARE = 0.1
"""Share of the worst turns that is left out: wrong poses."""
_OUTLYING_ROTATION = np.deg2rad(3.0)
_HALF_WIDTH_S = 0.2
_NODES = 13
_CENTRES = 1500

QuaternionReading = Callable[[Floats], Floats]
"""Quaternions (N, 4) as read to those that another order or direction would give."""


class RelativeRotations(NamedTuple):
    """How the tracker tracked, and the gyroscope meanwhile."""

    tracker: Floats
    """(N, 3) rotation vectors, rad."""
    gyroscope: Floats
    """(N, 3) rad, integral of the rate at the lag found."""
    duration_s: Floats
    """(N,) s."""
    lag_s: float
    """To be taken from the tracker's stamps."""
    q_begin: Floats
    """(N, 4) quaternions at which the turns begin."""
    q_end: Floats
    begin_s: Floats
    """(N,) seconds from the IMU's first sample at which they begin, lag taken off."""


class MotionFit(NamedTuple):
    """How well the gyroscope's turns, rotated and scaled, are the tracker's."""

    explained: float
    """Of the tracker's turning that is explained, in squares; 0 to 1."""
    rate_ratio: float
    """Gyroscope's rate to the tracker's."""
    frame: Floats
    """(3, 3) that takes vectors of the IMU's frame into the tracked one."""

    @property
    def angle(self) -> float:
        """Of the frames' rotation, rad."""
        return float(np.arccos(np.clip(0.5 * (np.trace(self.frame) - 1.0), -1.0, 1.0)))


class Integral:
    """The integral over time of a stream of vectors, linear between samples."""

    def __init__(self, time_ns: Times, values: Floats) -> None:
        self.t = (time_ns - time_ns[0]) / NANOSECONDS
        steps = 0.5 * (values[1:] + values[:-1]) * np.diff(self.t)[:, None]
        self.sums = np.concatenate([np.zeros((1, 3)), np.cumsum(steps, axis=0)])

    def between(self, begin: Floats, end: Floats) -> Floats:
        """(N, 3) from one time to another, seconds from the first sample."""
        sums = self.sums.T
        return np.stack(
            [np.interp(end, self.t, s) - np.interp(begin, self.t, s) for s in sums], axis=1
        )


def sample_pairs(
    t: Floats, span_s: float, last_s: float, most: int = _PAIRS
) -> tuple[Indices, Indices]:
    """Rows (N,) of times, about a span apart, within 0 and the last second with room for a lag."""
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
    """RelativeRotations between attitudes that are valid at times t (N,), seconds from the IMU's first sample.

    `attitude` gives quaternions (n, 4) of rows. None where there are too few of them.
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
    """Rotation vectors (N, 3), in the body, that take one attitude (N, 4) to the next."""
    return (to_scipy(first).inv() * to_scipy(second)).as_rotvec()


def outlying_poses(q: Floats) -> Flags:
    """Which attitudes (N, 4) are of another pose than those before and after, which are alike."""
    found = np.zeros(len(q), bool)
    if len(q) > 2:
        step = _angle(q[1:], q[:-1])
        over = _angle(q[2:], q[:-2])
        found[1:-1] = np.minimum(step[1:], step[:-1]) > _OUTLYING_ROTATION + 3.0 * over
    return found


def _angle(a: Floats, b: Floats) -> Floats:
    return 2.0 * np.arccos(np.minimum(np.abs(np.einsum("ni,ni->n", a, b)), 1.0))


def _lag(begin: Floats, end: Floats, size: Floats, integral: Integral) -> float:
    """The lag at which both turn alike far, whatever their frames and units."""
    few = slice(None, None, max(1, -(-len(size) // _SEARCHED)))
    begin, end = begin[few], end[few]
    # Wrong poses would outweigh all motion; where there is little of it, it is not to be cut short itself.
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
    """Rotation (Wahba) and ratio from the gyroscope's turns (N, 3) to the tracker's, outlying_poses left out."""
    size = np.linalg.norm(tracker, axis=1)
    weight = np.minimum(1.0, np.quantile(size, 0.95) / np.maximum(size, 1e-12))
    found = _motion_fit(tracker * weight[:, None], gyroscope * weight[:, None])
    off = np.linalg.norm(tracker - gyroscope @ found.frame.T / found.rate_ratio, axis=1)
    kept = off <= np.quantile(off, 1.0 - _OUTLIER_SHARE)
    return _motion_fit(tracker[kept], gyroscope[kept])


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
    """The fit that each other reading of the quaternions would give."""
    return {
        name: fit(
            rotation_vectors(read(rotations.q_begin), read(rotations.q_end)), rotations.gyroscope
        )
        for name, read in others.items()
    }


def second_axis_share(vectors: Floats) -> float:
    """How much there is about a second axis beside the first, in squares, 0 to 1."""
    values = np.linalg.eigvalsh(vectors.T @ vectors)
    return float(values[1] / values[2]) if values[2] > 0.0 else 0.0


class AccelerationFit(NamedTuple):
    """How a tracker's path and the accelerometer's agree."""

    rate_ratio: float
    """Of the tracker's acceleration to the accelerometer's."""
    correlation: float
    acceleration: float
    """Root mean square of the tracker's, in its unit / s^2."""


def acceleration_fit(
    optical: Optical, imu: Imu, lag_s: float, frame: Floats
) -> AccelerationFit | None:
    """The tracker's second differences over 0.2 s against the accelerometer's double integral.

    ``p(t + T) - 2 p(t) + p(t - T)`` is the integral of ``(T - |s|) a(t + s)``; gravity, which is constant,
    leaves with the mean. `frame` (3, 3) takes vectors of the IMU into the tracked frame. None where there
    is too little to compare.
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
    """Mean of the accelerometer's readings (3,) in the reference frame, m/s^2: opposite to free fall,
    whatever the motion. NaN without an accelerometer."""
    if imu.accelerometer is None:
        return np.full(3, np.nan)
    integral = Integral(imu.time_ns, imu.accelerometer)
    width = 0.05
    force = integral.between(rotations.begin_s - width, rotations.begin_s + width) / (2.0 * width)
    return to_scipy(rotations.q_begin).apply(force @ frame.T).mean(axis=0)


def _fit_accelerations(acceleration: Floats, force: Floats) -> AccelerationFit:
    one, other = acceleration - np.median(acceleration, axis=0), force - np.median(force, axis=0)
    # Wrong poses leave huge differences.
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
    {
        "Distance": "AccelerationFit",
        "Fit": "MotionFit",
        "Reading": "QuaternionReading",
        "Turns": "RelativeRotations",
        "distance": "acceleration_fit",
        "pairs_of": "sample_pairs",
        "readings": "fit_readings",
        "second_axis": "second_axis_share",
        "strays": "outlying_poses",
        "turn_between": "rotation_vectors",
        "turns": "relative_rotations",
    },
)
