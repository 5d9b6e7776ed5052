"""Clock, its drift, and frame of a tracker against an IMU, from the attitudes themselves.

`synchronise.match` compares turns from sample to sample, which finds clock and frame from nothing but loses
what the sum of many turns tells. Here the tracker's attitude is compared with the integral of the gyroscope
over two seconds at a time, each with a constant rotation of its own,

    q_k  =  A_c  G(t_k - L - D (t_k - m))  F  exp(noise),

Gauss and Newton on latency ``L``, drift ``D``, frame ``F`` and the bias within ``G``. In the reference
frame ``A_c`` leaves with the mean of each stretch. Residuals may be correlated within a stretch, as those
of a filtering tracker or a noisy gyroscope are: deviations are those of clusters.
"""

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from jaxekf._support.errors import RecordingError
from jaxekf.calibration.time_offset import Match
from jaxekf.geometry.host_rotation import running_product
from jaxekf.recordings.types import NANOSECONDS, Flags, Floats, Imu, Optical, from_scipy, to_scipy

Whole = NDArray[np.intp]

_STRETCH_S = 2.0
_FEWEST_STRETCHES = 20
_SHORTEST_S = 0.25
_LEAST_SAMPLES = 5
_LONGEST_IMU_GAP_S = 0.1
_SPARE_S = 0.1
_LEAST_STRETCHES = 10
_ROUNDS = 12
_OUTLYING = 5.0
_SETTLED = 0.01
"""Deviations within which a step ends the search."""
_LEAST_DRIFT_S = 20.0
_EXPLAINED, _KEPT = 0.8, 0.8
_LARGEST_DRIFT = 1e-3
_PRIOR = np.array([1.0, 1.0, 1.0, 0.2, 0.2, 0.2, 0.1, 1e-3])
"""Deviations of alignment (rad), bias (rad/s), latency (s) and drift that are believed beforehand: so wide
that they count only where nothing else tells."""


class AttitudeMatch(NamedTuple):
    """How a tracker lies to an IMU in time and frame; see `synchronise.Match`."""

    latency_s: float
    """In the middle of the run."""
    latency_sigma_s: float
    drift: float
    """Seconds by which the latency grows in a second; NaN where the run is too short to tell."""
    drift_sigma: float
    alignment: Floats
    """(3,) rotation vector, rad, that takes vectors of the tracked frame into the IMU's."""
    alignment_cov: Floats
    """(3, 3) rad^2, of a small turn in the tracked frame, applied before the alignment."""
    bias: Floats
    """(3,) rad/s, of the gyroscope."""
    scatter: float
    """Root mean square of the residuals of an axis, rad."""
    middle_s: float
    """Seconds from the IMU's first sample to the middle of the run."""
    duration_s: float


class _Seen(NamedTuple):
    """Attitudes that can be compared, stretch after stretch."""

    t: Floats
    """(N,) seconds since the IMU's first sample, as stamped."""
    q: Rotation
    """N of them, tracked frame to reference."""
    begin: Whole
    """(C,) row that each stretch begins with."""

    def spread(self, values: Floats) -> Floats:
        """What is said of stretches (C, ...), of their rows."""
        return np.repeat(values, np.diff(self.begin, append=len(self.t)), axis=0)

    def less_mean(self, values: Floats, kept: Flags) -> Floats:
        """Values (N, ...) less the mean over the rows of their stretch that are kept."""
        count = np.maximum(np.add.reduceat(kept.astype(float), self.begin), 1.0)
        weight = kept.reshape(-1, *[1] * (values.ndim - 1))
        total = np.add.reduceat(values * weight, self.begin, axis=0)
        return values - self.spread(total / count.reshape(-1, *[1] * (values.ndim - 1)))


def refine(optical: Optical, imu: Imu, start: Match, place: object = "recording") -> AttitudeMatch:
    """Latency, drift, alignment and bias of a stream of attitudes, from what `match` found.

    Raises `RecordingError` where the gyroscope does not explain how the attitude turns.
    """
    known = (imu.time_ns - imu.time_ns[0]) / NANOSECONDS
    seen = _seen(optical, imu, start.latency_s, place)
    middle = 0.5 * float(seen.t[0] + seen.t[-1])
    duration = float(seen.t[-1] - seen.t[0])
    free = slice(0, 8 if duration >= _LEAST_DRIFT_S else 7)
    frame, bias = Rotation.from_rotvec(start.alignment), start.bias
    clock = np.array([start.latency_s, 0.0])
    kept, elapsed = np.ones(len(seen.t), bool), seen.t - middle
    made = _Solved(np.zeros(8), np.eye(8), np.zeros((len(seen.t), 3)), 0.0)
    for _ in range(_ROUNDS):
        at = seen.t - clock[0] - clock[1] * elapsed
        columns, off = _linear(seen, _integral(known, imu.gyroscope - bias, at), frame, kept)
        columns = np.concatenate([columns, columns[:, :, 6:] * elapsed[:, None, None]], axis=2)
        columns = seen.less_mean(columns[:, :, free], kept)
        made = _solve(seen, columns, off, kept)
        frame = frame * Rotation.from_rotvec(made.step[:3])
        bias = bias + made.step[3:6]
        clock = clock + np.clip(made.step[6:], -0.05, 0.05)
        size = np.linalg.norm(made.residual, axis=1)
        kept = size <= _OUTLYING * max(float(np.median(size)), 1e-12)
        if np.all(np.abs(made.step) < _SETTLED * np.sqrt(np.diagonal(made.cov))):
            break
    _need_likeness(seen, made.residual, kept, place)
    if abs(clock[1]) > _LARGEST_DRIFT:
        raise RecordingError(
            str(place),
            f"a tracker's clock that gains {1e6 * clock[1]:.0f} ppm on the IMU's",
            f"{1e6 * _LARGEST_DRIFT:.0f} ppm at most",
            "streams that belong together, with clocks that do not jump",
        )
    sigma = np.sqrt(np.diagonal(made.cov))
    drifting = duration >= _LEAST_DRIFT_S
    return AttitudeMatch(
        float(clock[0]),
        float(sigma[6]),
        float(clock[1]) if drifting else np.nan,
        float(sigma[7]) if drifting else np.nan,
        frame.as_rotvec(),
        made.cov[:3, :3],
        bias,
        made.scatter,
        middle,
        duration,
    )


def _seen(optical: Optical, imu: Imu, latency_s: float, place: object) -> _Seen:
    """Valid attitudes within the IMU's time, in stretches in which the IMU has no gap."""
    known = (imu.time_ns - imu.time_ns[0]) / NANOSECONDS
    t = (optical.time_ns - optical.latency_ns - imu.time_ns[0]) / NANOSECONDS
    inside = (t - latency_s >= known[0] + _SPARE_S) & (t - latency_s <= known[-1] - _SPARE_S)
    rows = np.flatnonzero(optical.valid & inside)
    span = float(np.ptp(t[rows])) if rows.size else 0.0
    length = float(np.clip(span / _FEWEST_STRETCHES, _SHORTEST_S, _STRETCH_S))
    # A gap of the IMU ends a stretch, too.
    gaps = known[1:][np.diff(known) > _LONGEST_IMU_GAP_S]
    label = np.floor(t[rows] / length) + np.searchsorted(gaps, t[rows] - latency_s)
    _, number, count = np.unique(label, return_inverse=True, return_counts=True)
    many = (count >= _LEAST_SAMPLES)[number]
    rows, number = rows[many], number[many]
    if np.unique(number).size < _LEAST_STRETCHES:
        raise RecordingError(
            str(place),
            f"{rows.size} attitudes in {span:.1f} s within the IMU's time",
            f"{_LEAST_STRETCHES} stretches of {length:g} s or more to match the clocks by",
            "a longer recording, or one in which the tool is seen",
        )
    begin = np.flatnonzero(np.diff(number, prepend=-1))
    return _Seen(t[rows], to_scipy(optical.q_ref_body[rows]), begin)


class _Turned(NamedTuple):
    """The gyroscope's integral at some times."""

    q: Rotation
    """From the IMU's frame to one that is fixed, whatever it is."""
    rate: Floats
    """(N, 3) rad/s."""
    swept: Floats
    """(N, 3, 3) s: the integral of `q` as a matrix: what a bias does."""


def _integral(known: Floats, rate: Floats, at: Floats) -> _Turned:
    """Rates that are linear between samples, each step turned by their mean."""
    step = np.diff(known)
    steps = Rotation.from_rotvec(0.5 * (rate[1:] + rate[:-1]) * step[:, None])
    turn = to_scipy(running_product(from_scipy(steps)))
    matrix = turn.as_matrix()
    slabs = 0.5 * (matrix[1:] + matrix[:-1]) * step[:, None, None]
    swept = np.concatenate([np.zeros((1, 3, 3)), np.cumsum(slabs, axis=0)])
    low: Any = np.clip(np.searchsorted(known, at, side="right") - 1, 0, len(step) - 1)
    since = (at - known[low])[:, None]
    slope = (rate[low + 1] - rate[low]) / step[low, None]
    q = turn[low] * Rotation.from_rotvec((rate[low] + 0.5 * slope * since) * since)
    half = 0.5 * (matrix[low] + q.as_matrix()) * since[:, :, None]
    return _Turned(q, rate[low] + slope * since, swept[low] + half)


def _linear(seen: _Seen, turned: _Turned, frame: Rotation, kept: Flags) -> tuple[Floats, Floats]:
    """How the residuals, in the reference frame, change with alignment, bias and latency (N, 3, 7), and the
    residuals (N, 3); of each stretch but for a constant."""
    body = turned.q * frame
    constant = _constant(seen, seen.q * body.inv(), kept)
    expected = constant * body
    off = expected.apply((seen.q.inv() * expected).as_rotvec())
    of_bias = -np.einsum("nij,njk->nik", constant.as_matrix(), turned.swept)
    of_latency = -(constant * turned.q).apply(turned.rate)
    columns = np.concatenate([expected.as_matrix(), of_bias, of_latency[:, :, None]], axis=2)
    return columns, seen.less_mean(off, kept)


def _constant(seen: _Seen, each: Rotation, kept: Flags) -> Rotation:
    """The mean over each stretch of rotations that are nearly one, for every row."""
    q = each.as_quat()
    first = seen.spread(q[seen.begin])
    q = q * np.where(np.sum(q * first, axis=1) < 0.0, -1.0, 1.0)[:, None]
    total = np.add.reduceat(q * kept[:, None], seen.begin, axis=0)
    lost = np.linalg.norm(total, axis=1) < 1e-6
    total[lost] = q[seen.begin][lost]
    return Rotation.from_quat(seen.spread(total))


class _Solved(NamedTuple):
    step: Floats
    """(8,); a drift that is not free is 0."""
    cov: Floats
    """(8, 8)."""
    residual: Floats
    """(N, 3)."""
    scatter: float


def _solve(seen: _Seen, columns: Floats, off: Floats, kept: Flags) -> _Solved:
    """Least squares with what is believed beforehand, and its covariance by clusters, a stretch each."""
    width = columns.shape[2]
    prior = 1.0 / np.square(_PRIOR[:width])
    used = columns * kept[:, None, None]
    count = 3.0 * (kept.sum() - len(seen.begin)) - width
    square, rhs = np.einsum("nij,nik->jk", used, columns), np.einsum("nij,ni->j", used, off)

    def solved(about: Floats) -> tuple[float, Floats, Floats]:
        """By the variance of some residuals."""
        variance = max(float(np.sum(np.square(about[kept]))) / max(count, 1.0), 1e-20)
        inverse = np.linalg.inv(square / variance + np.diag(prior))
        return variance, inverse, -inverse @ rhs / variance

    # The first residuals are those of a start, which may be far off.
    residual = off + columns @ solved(off)[2]
    variance, inverse, step = solved(residual)
    residual = off + columns @ step
    score = np.einsum("nij,ni->nj", used, residual) / variance
    score = np.add.reduceat(score, seen.begin, axis=0)
    clusters = len(seen.begin)
    middle = score.T @ score * clusters / max(clusters - width, 1) + np.diag(prior)
    cov = np.diag(np.square(_PRIOR))
    cov[:width, :width] = inverse @ middle @ inverse
    whole = np.zeros(8)
    whole[:width] = step
    return _Solved(whole, cov, residual, float(np.sqrt(variance)))


def _need_likeness(seen: _Seen, residual: Floats, kept: Flags, place: object) -> None:
    """The gyroscope explains most of how the attitude turns within a stretch, and in most stretches, or it
    is of another body, or of another clock half of the time."""
    mean = _constant(seen, seen.q, kept)
    turned = np.sum(np.square((mean.inv() * seen.q).as_rotvec()[kept]))
    left = np.sum(np.square(residual[kept]))
    if np.mean(kept) < _KEPT:
        raise RecordingError(
            str(place),
            f"a gyroscope that turns as {100.0 * np.mean(kept):.0f} % of the tracker's samples do",
            f"{100.0 * _KEPT:.0f} % or more",
            "streams that belong together, with clocks that do not jump",
        )
    if left > (1.0 - _EXPLAINED) * turned:
        raise RecordingError(
            str(place),
            f"a gyroscope that explains {100.0 * max(0.0, 1.0 - left / turned):.0f} % of how the tracker"
            " turns",
            f"{100.0 * _EXPLAINED:.0f} % or more of one body's",
            "streams that belong together, with clocks that do not jump",
        )
