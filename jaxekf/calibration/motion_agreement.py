"""Agreement of a tracker and an IMU in rotation, from a subset of the samples.

`relative_rotations` pairs rotations of the tracker with the integrated rate of the gyroscope, `fit` finds
the rotation and scale between them; `acceleration_agreement` does the same for translation.
The functions measure and do not judge; a quantity that the data do not determine is NaN. They use NumPy and
SciPy only.
"""

from collections.abc import Callable, Mapping
from typing import NamedTuple

import numpy as np

from jaxekf._support.deprecations import renamed
from jaxekf.calibration._gyroscope_integral import GyroscopeIntegral
from jaxekf.geometry.host_rotation import nearest_rotation
from jaxekf.recordings.accounts import Indices
from jaxekf.recordings.types import (
    NANOSECONDS,
    Flags,
    Floats,
    Imu,
    Times,
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
SPANS_S = (0.1, 0.4, 1.0)
"""Time spans, s, of a relative rotation, tried in turn until the rotations are clear."""
CLEAR_ROTATION = np.deg2rad(5.0)
"""A rotation well above a tracker's noise, rad; for slower motion the next longer span is tried."""
_LARGEST_ROTATION = np.deg2rad(115.0)
"""Rotation, rad, up to which a pair is plainly below half a turn: fast motion is compared over shorter
spans, down to neighbouring samples."""
_HALF_TURN = np.deg2rad(165.0)
"""Rotation, rad, from which on a pair may have turned by half a turn, which shows as less."""
_ADDED = np.deg2rad(30.0)
"""Rotation, rad, up to which the sum of the rates is near enough to their ordered product."""
_DEGREES = 180.0 / np.pi
_SAME, _RIGHT = 0.1, 0.9
"""Relative error of a rate ratio, and explained share, up to which both rotate alike."""
_LONGEST_GAP_S = 0.1
"""Longest step of the IMU's samples, s, over which rates are interpolated."""
_OUTLIER_SHARE = 0.1
"""Share of the largest residuals that is left out: wrong poses."""
_OUTLYING_ROTATION = np.deg2rad(3.0)

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
    too_fast: bool = False
    """Whether most pairs turn by about half a turn or more, so that the tracker does not show how fast."""


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
        step = np.diff(self.t)
        longest = max(_LONGEST_GAP_S, 3.0 * float(np.median(step)) if step.size else 0.0)
        self.gaps = np.concatenate([[0.0], np.cumsum(np.where(step > longest, step, 0.0))])

    def known(self, begin: Floats, end: Floats) -> Flags:
        """Mask (N,) of intervals from `begin` to `end` (N,), s, without a gap of the stream."""
        return np.interp(end, self.t, self.gaps) == np.interp(begin, self.t, self.gaps)

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
    t: Floats,
    attitude: Callable[[Indices], Floats],
    imu: Imu,
    most: int = _PAIRS,
    offset_s: float = 0.0,
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
    offset_s
        Offset of the tracker's clock about which lags are searched, s.

    Returns
    -------
    None if there are fewer than 40 pairs.
    """
    if len(t) < 2 or len(imu.time_ns) < 2:
        return None
    integral = Integral(imu.time_ns, imu.gyroscope)
    t = t - offset_s
    step, last = float(np.median(np.diff(t))), float(integral.t[-1])
    slow = pair_steps(t, attitude, SPANS_S[-1])
    for span_s in SPANS_S:
        # Whole steps: samples 80 ms apart are 160 ms apart next, no longer about 100 ms.
        steps = max(1.0, np.ceil(span_s / step - 1e-3))
        begin, end = sample_pairs(t, step * min(steps, slow), last, most)
        known = integral.known(t[begin], t[end])
        begin, end = begin[known], end[known]
        if len(begin) < _FEWEST:
            return None
        rows, where = np.unique(np.concatenate([begin, end]), return_inverse=True)
        q = attitude(rows)[where]
        first, second = q[: len(begin)], q[len(begin) :]
        tracked = rotation_vectors(first, second)
        size = np.linalg.norm(tracked, axis=1)
        longest = span_s == SPANS_S[-1] or steps >= slow
        if longest or np.quantile(size, 0.9) > CLEAR_ROTATION:
            lag = _lag(t[begin], t[end], size, integral)
            integrated = integral.between(t[begin] - lag, t[end] - lag)
            duration = t[end] - t[begin]
            lag_s = offset_s + lag
            return RelativeRotations(
                tracked, integrated, duration, lag_s, first, second, t[begin] - lag
            )
    return None


def pair_steps(t: Floats, attitude: Callable[[Indices], Floats], span_s: float) -> int:
    """Sampling periods of a time span, but few enough that nearly all rotations stay below half a turn.

    Parameters
    ----------
    t, attitude
        As for `relative_rotations`.
    span_s
        Time span, s.
    """
    step = float(np.median(np.diff(t)))
    # Whole steps: samples 80 ms apart are 160 ms apart next, no longer about 100 ms.
    steps = max(1, int(np.ceil(span_s / step - 1e-3)))
    begin = np.flatnonzero(np.diff(t) <= 1.5 * step)
    begin = begin[:: max(1, -(-len(begin) // _SEARCHED))]
    if len(begin) < _FEWEST:
        return steps
    size = np.linalg.norm(rotation_vectors(attitude(begin), attitude(begin + 1)), axis=1)
    return min(steps, max(1, int(_LARGEST_ROTATION / max(np.quantile(size, 0.98), 1e-6))))


def compose(rotations: RelativeRotations, imu: Imu, rate_ratio: float) -> RelativeRotations:
    """The gyroscope's rotations as ordered products of its small rotations, for fast motion.

    The sum of the rates differs from the rotation where the axis of fast rotation changes. A product needs
    the right unit: the stated one, or degrees and radians exchanged, is taken where its products are the
    tracker's rotations, which holds beyond half a turn, too; else the rates over `rate_ratio`.

    Parameters
    ----------
    rotations
        Result of `relative_rotations`.
    imu
        The IMU's samples.
    rate_ratio
        Rate of the gyroscope over that of the tracker, from the sums.

    Returns
    -------
    Without the pairs of half a turn or more, if others remain; the same rotations if they are small.
    """
    turned = np.linalg.norm(rotations.tracker, axis=1)
    if np.quantile(turned, 0.98) < _ADDED:
        return rotations
    for ratio in (1.0, _DEGREES, 1.0 / _DEGREES):
        product = _products(rotations, imu, ratio)
        found = fit(rotations.tracker, product)
        if found.explained > _RIGHT and abs(found.rate_ratio / ratio - 1.0) < _SAME:
            break
    else:
        if np.median(turned) > _HALF_TURN / 3.0:
            return rotations._replace(too_fast=True)
        if not 0.0 < rate_ratio < np.inf:
            return rotations
        product, ratio = _products(rotations, imu, rate_ratio), rate_ratio
    clear = np.linalg.norm(rotations.gyroscope, axis=1) < ratio * _HALF_TURN
    made = rotations._replace(gyroscope=product)
    if np.mean(clear) < 0.5 or clear.sum() < _FEWEST:
        return made._replace(too_fast=ratio == 1.0)
    fields = {name: value[clear] for name, value in made._asdict().items() if np.ndim(value) > 0}
    return made._replace(**fields)


def _products(rotations: RelativeRotations, imu: Imu, ratio: float) -> Floats:
    known = (imu.time_ns - imu.time_ns[0]) / NANOSECONDS
    begin, duration = rotations.begin_s, rotations.duration_s
    made = GyroscopeIntegral(known, imu.gyroscope / ratio).rotation(begin, begin + duration)
    return made.as_rotvec() * ratio


def rotation_vectors(first: Floats, second: Floats) -> Floats:
    """Rotation vectors (N, 3), rad, from attitudes `first` to `second` (N, 4), in the body frame."""
    return (to_scipy(first).inv() * to_scipy(second)).as_rotvec()


def wrapped(angle: Floats) -> Floats:
    """Angles (N,), rad, of one turn or more as a rotation shows them: 0 to pi."""
    return np.abs((angle + np.pi) % (2.0 * np.pi) - np.pi)


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

    def correlation(lag: float, *, turned: bool) -> float:
        angle = np.linalg.norm(integral.between(begin - lag, end - lag), axis=1)
        return correlate(sizes, wrapped(angle) if turned else angle)

    def search(lags: Floats, *, turned: bool) -> tuple[float, float]:
        best = max((correlation(lag, turned=turned), -abs(lag), lag) for lag in lags)
        return best[0], float(best[2])

    coarse = np.arange(-room, room + 0.01, 0.02)
    best, turned = search(coarse, turned=False), False
    if np.quantile(np.linalg.norm(integral.between(begin, end), axis=1), 0.9) > _HALF_TURN:
        # Either the unit is wrong or the tracker shows more than half a turn as less.
        other = search(coarse, turned=True)
        best, turned = (other, True) if other[0] > best[0] else (best, False)
    return float(search(best[1] + np.arange(-0.02, 0.021, 0.005), turned=turned)[1])


def correlate(signals: Floats, other: Floats) -> float:
    """Largest correlation coefficient of signals (K, N) with another one (N,); -inf for a constant one."""
    signals = signals - signals.mean(axis=1, keepdims=True)
    signals /= np.maximum(np.linalg.norm(signals, axis=1, keepdims=True), 1e-12)
    other = other - other.mean()
    norm = float(np.sqrt(np.sum(np.square(other))))
    return float(np.max(signals @ other)) / norm if norm > 0.0 else -np.inf


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
    return float(max(lags, key=lambda lag: (correlate(signals, delayed(lag)), -abs(lag))))


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


def rotation_agreement(
    t: Floats, attitude: Callable[[Indices], Floats], imu: Imu, offset_s: float
) -> tuple[float, float]:
    """Lag near a clock offset, s, and the share of the rotation that the gyroscope explains there.

    Parameters
    ----------
    t, attitude, imu, offset_s
        As for `relative_rotations`.
    """
    rotations = relative_rotations(t, attitude, imu, _SEARCHED, offset_s)
    if rotations is None:
        return offset_s, 0.0
    rotations = compose(rotations, imu, 1.0)
    return rotations.lag_s, fit(rotations.tracker, rotations.gyroscope).explained


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


__getattr__ = renamed(
    __name__,
    "Fit>MotionFit Reading>QuaternionReading Turns>RelativeRotations "
    "pairs_of>sample_pairs readings>fit_readings "
    "second_axis>second_axis_share strays>outlying_poses turn_between>rotation_vectors "
    "turns>relative_rotations",
)
