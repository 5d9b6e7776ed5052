"""Clock offset, clock drift and rotation between a tracker and an IMU, from the attitudes themselves.

`time_offset.match` compares rotations from sample to sample. It needs no initial values but does not use
that many rotations add up to one attitude. `refine` starts from its result and compares the tracker's
attitude with the integral of the gyroscope over stretches of two seconds, each with a constant rotation of
its own,

    q_k  =  A_c  G(t_k - L - D (t_k - m))  F  exp(noise),

by Gauss-Newton on latency ``L``, drift ``D``, rotation ``F`` and the bias within ``G``. In the reference
frame ``A_c`` is removed with the mean of each stretch. Residuals may be correlated within a stretch, as
with a tracker that filters or a noisy gyroscope: the covariance is cluster-robust, one cluster a stretch.
"""

from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from jaxekf._support.errors import RecordingError
from jaxekf.calibration._gyroscope_integral import GyroscopeIntegral, RotationsAt
from jaxekf.calibration.time_offset import Match
from jaxekf.recordings.accounts import Indices
from jaxekf.recordings.types import NANOSECONDS, Flags, Floats, Imu, Optical, to_scipy

_STRETCH_S = 2.0
_FEWEST_STRETCHES = 20
_SHORTEST_S = 0.25
_LEAST_SAMPLES = 5
_LONGEST_IMU_GAP_S = 0.1
_SPARE_S = 0.1
_LEAST_STRETCHES = 10
_ROUNDS = 12
_OUTLIER_RATIO = 5.0
_CONVERGED = 0.01
"""A step smaller than this many standard deviations ends the iterations."""
_LEAST_DRIFT_S = 20.0
_EXPLAINED, _KEPT = 0.8, 0.8
_LARGEST_DRIFT = 1e-3
_UNKNOWN, _NOTHING = 0.15, 10.0
"""Standard deviation, rad, from which on an alignment about an axis is unobservable, and its value then."""
_PRIOR = np.array([1.0, 1.0, 1.0, 0.2, 0.2, 0.2, 0.1, 1e-3])
"""Prior standard deviations of alignment (rad), bias (rad/s), latency (s) and drift, wide enough to matter
only for unobservable parameters."""


class AttitudeMatch(NamedTuple):
    """Time offset, drift and rotation of a tracker relative to an IMU; see `time_offset.Match`."""

    latency_s: float
    """Latency in the middle of the run, s."""
    latency_sigma_s: float
    drift: float
    """Growth of the latency, s/s; NaN if the run is too short to estimate it."""
    drift_sigma: float
    alignment: Floats
    """(3,) rotation vector, rad, tool frame to IMU frame; without a turn about an unobservable axis."""
    alignment_cov: Floats
    """(3, 3) rad^2, of a small rotation in the tool frame, applied before the alignment."""
    bias: Floats
    """(3,) rad/s, gyroscope bias."""
    scatter: float
    """Root mean square of the residuals of one axis, rad."""
    middle_s: float
    """Seconds from the IMU's first sample to the middle of the run."""
    duration_s: float


def unobservable_axis(alignment_cov: Floats) -> Floats | None:
    """The axis, tool frame, about which the motion does not determine the alignment; None without one.

    Parameters
    ----------
    alignment_cov
        (3, 3) rad^2, of a small rotation in the tool frame.
    """
    values, axes = np.linalg.eigh(alignment_cov)
    if not values[2] > _UNKNOWN**2 or values[1] > _UNKNOWN**2:
        return None
    axis = axes[:, 2]
    return axis * np.sign(axis[np.argmax(np.abs(axis))])


def without_turn(frame: Rotation, axis: Floats, reference: Rotation | None = None) -> Rotation:
    """The rotation turned about an axis before it so as to be nearest to another one, or to none.

    Parameters
    ----------
    frame
        Tool frame to IMU frame.
    axis
        (3,) unit vector, tool frame.
    reference
        The rotation to come near to; identity without it.
    """
    x, y, z, w = (frame if reference is None else reference.inv() * frame).as_quat()
    turn = 2.0 * np.arctan2(axis @ np.array([x, y, z]), w)
    return frame * Rotation.from_rotvec(-turn * axis)


def _observable(frame: Rotation, cov: Floats) -> tuple[Rotation, Floats]:
    """Alignment without a turn about an unobservable axis, and its covariance with no knowledge of it."""
    axis = unobservable_axis(cov)
    if axis is None:
        return frame, cov
    rest = np.eye(3) - np.outer(axis, axis)
    return without_turn(frame, axis), rest @ cov @ rest + _NOTHING**2 * np.outer(axis, axis)


class _Stretches(NamedTuple):
    """Attitudes that are compared, in stretches."""

    t: Floats
    """(N,) seconds since the IMU's first sample, as stamped."""
    q: Rotation
    """N attitudes, tool to reference."""
    begin: Indices
    """(C,) first row of each stretch."""

    def to_rows(self, values: Floats) -> Floats:
        """Values of stretches (C, ...), repeated for their rows (N, ...)."""
        return np.repeat(values, np.diff(self.begin, append=len(self.t)), axis=0)

    def remove_mean(self, values: Floats, kept: Flags) -> Floats:
        """Values (N, ...) minus the mean over the kept rows of their stretch."""
        count = np.maximum(np.add.reduceat(kept.astype(float), self.begin), 1.0)
        weight = kept.reshape(-1, *[1] * (values.ndim - 1))
        total = np.add.reduceat(values * weight, self.begin, axis=0)
        return values - self.to_rows(total / count.reshape(-1, *[1] * (values.ndim - 1)))


def refine(optical: Optical, imu: Imu, start: Match, place: object = "recording") -> AttitudeMatch:
    """Latency, drift, alignment and bias of a stream of attitudes, from the result of `time_offset.match`.

    Parameters
    ----------
    optical
        Attitudes of the tool.
    imu
        Rates of the IMU.
    start
        Result of `time_offset.match`.
    place
        Name of the recording for error messages.

    Raises
    ------
    RecordingError
        If the gyroscope does not explain the rotation of the tracker, if too few stretches remain, or if
        the clocks drift by more than 1000 ppm.

    Examples
    --------
    >>> from dataclasses import replace
    >>> import jaxekf
    >>> from jaxekf.calibration import attitude_alignment, time_offset
    >>> run = jaxekf.load(jaxekf.demo.FOLDER / "free-5")
    >>> optical, imu = run.need_optical(), run.need_imu()
    >>> late = replace(optical, time_ns=optical.time_ns + 20_000_000)
    >>> found = attitude_alignment.refine(late, imu, time_offset.match(late, imu))
    >>> round(float(found.latency_s), 3), bool(found.latency_sigma_s < 1e-3)
    (0.02, True)
    """
    known = (imu.time_ns - imu.time_ns[0]) / NANOSECONDS
    stretches = _stretches(optical, imu, start.latency_s, place)
    middle = 0.5 * float(stretches.t[0] + stretches.t[-1])
    duration = float(stretches.t[-1] - stretches.t[0])
    free = slice(0, 8 if duration >= _LEAST_DRIFT_S else 7)
    frame, bias = Rotation.from_rotvec(start.alignment), start.bias
    clock = np.array([start.latency_s, 0.0])
    tracked = stretches.q.as_matrix()
    kept, elapsed = np.ones(len(stretches.t), bool), stretches.t - middle
    solution = _Solution(np.zeros(8), np.eye(8), np.zeros((len(stretches.t), 3)), 0.0)
    for _ in range(_ROUNDS):
        at = stretches.t - clock[0] - clock[1] * elapsed
        integral = GyroscopeIntegral(known, imu.gyroscope - bias)
        columns, off = _linearise(stretches, integral.at(at), frame, kept)
        columns = np.concatenate([columns, columns[:, :, 6:] * elapsed[:, None, None]], axis=2)
        columns = stretches.remove_mean(columns[:, :, free], kept)
        solution = _solve(stretches, columns, tracked, off, kept)
        frame = frame * Rotation.from_rotvec(np.clip(solution.step[:3], -0.5, 0.5))
        bias = bias + solution.step[3:6]
        clock = clock + np.clip(solution.step[6:], -0.05, 0.05)
        size = np.linalg.norm(solution.residual, axis=1)
        kept = size <= _OUTLIER_RATIO * max(float(np.median(size)), 1e-12)
        if np.all(np.abs(solution.step) < _CONVERGED * np.sqrt(np.diagonal(solution.cov))):
            break
    _require_agreement(stretches, solution.residual, kept, place)
    if abs(clock[1]) > _LARGEST_DRIFT:
        raise RecordingError(
            str(place),
            f"a clock drift of {1e6 * clock[1]:.0f} ppm between tracker and IMU",
            f"{1e6 * _LARGEST_DRIFT:.0f} ppm at most",
            "streams of one body, with clocks that do not jump",
        )
    sigma = np.sqrt(np.diagonal(solution.cov))
    frame, alignment_cov = _observable(frame, solution.cov[:3, :3])
    drifting = duration >= _LEAST_DRIFT_S
    return AttitudeMatch(
        float(clock[0]),
        float(sigma[6]),
        float(clock[1]) if drifting else np.nan,
        float(sigma[7]) if drifting else np.nan,
        frame.as_rotvec(),
        alignment_cov,
        bias,
        solution.scatter,
        middle,
        duration,
    )


def _stretches(optical: Optical, imu: Imu, latency_s: float, place: object) -> _Stretches:
    """Valid attitudes within the IMU's time, in stretches without a gap of the IMU."""
    known = (imu.time_ns - imu.time_ns[0]) / NANOSECONDS
    t = (optical.time_ns - optical.latency_ns - imu.time_ns[0]) / NANOSECONDS
    inside = (t - latency_s >= known[0] + _SPARE_S) & (t - latency_s <= known[-1] - _SPARE_S)
    at = np.clip(np.searchsorted(known, t - latency_s), 1, len(known) - 1)
    step = np.diff(known)
    longest = max(_LONGEST_IMU_GAP_S, 3.0 * float(np.median(step)))
    rows = np.flatnonzero(optical.valid & inside & (step[at - 1] <= longest))
    span = float(np.ptp(t[rows])) if rows.size else 0.0
    length = float(np.clip(span / _FEWEST_STRETCHES, _SHORTEST_S, _STRETCH_S))
    # A gap of the IMU ends a stretch.
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
            "a longer recording, or one in which the tool is visible",
        )
    begin = np.flatnonzero(np.diff(number, prepend=-1))
    return _Stretches(t[rows], to_scipy(optical.q_ref_body[rows]), begin)


def _linearise(
    stretches: _Stretches, integral: RotationsAt, frame: Rotation, kept: Flags
) -> tuple[Floats, Floats]:
    """Derivatives (N, 3, 7) of the residuals by alignment, bias and latency, and the residuals (N, 3), rad.

    Both are in the reference frame; the mean of each stretch is removed from the residuals.
    """
    body = integral.q * frame
    constant = _mean_rotation(stretches, stretches.q * body.inv(), kept)
    expected = constant * body
    off = expected.apply((stretches.q.inv() * expected).as_rotvec())
    d_bias = -np.einsum("nij,njk->nik", constant.as_matrix(), integral.q_integral)
    d_latency = -(constant * integral.q).apply(integral.rate)
    columns = np.concatenate([expected.as_matrix(), d_bias, d_latency[:, :, None]], axis=2)
    return columns, stretches.remove_mean(off, kept)


def _mean_rotation(stretches: _Stretches, each: Rotation, kept: Flags) -> Rotation:
    """Mean of nearly equal rotations over the kept rows of each stretch, repeated for every row."""
    q = each.as_quat()
    first = stretches.to_rows(q[stretches.begin])
    q = q * np.where(np.sum(q * first, axis=1) < 0.0, -1.0, 1.0)[:, None]
    total = np.add.reduceat(q * kept[:, None], stretches.begin, axis=0)
    lost = np.linalg.norm(total, axis=1) < 1e-6
    total[lost] = q[stretches.begin][lost]
    return Rotation.from_quat(stretches.to_rows(total))


class _Solution(NamedTuple):
    """Step of Gauss-Newton with its covariance."""

    step: Floats
    """(8,); zero for a drift that is not estimated."""
    cov: Floats
    """(8, 8)."""
    residual: Floats
    """(N, 3)."""
    scatter: float


def _solve(
    stretches: _Stretches, columns: Floats, tracked: Floats, off: Floats, kept: Flags
) -> _Solution:
    """Least squares with the prior, and its cluster-robust covariance, one cluster a stretch.

    The derivatives by the alignment are rotations by the gyroscope, whose noise looks like information
    about an axis that the motion leaves open. The covariance has those by the tracker, `tracked`
    (N, 3, 3), as instruments: the noise of both is independent and cancels in their product.
    """
    width = columns.shape[2]
    prior = 1.0 / np.square(_PRIOR[:width])
    used = columns * kept[:, None, None]
    count = 3.0 * (kept.sum() - len(stretches.begin)) - width
    square, rhs = np.einsum("nij,nik->jk", used, columns), np.einsum("nij,ni->j", used, off)

    def solved(about: Floats) -> tuple[float, Floats]:
        """Variance of the residuals, and step."""
        variance = max(float(np.sum(np.square(about[kept]))) / max(count, 1.0), 1e-20)
        return variance, -np.linalg.solve(square / variance + np.diag(prior), rhs / variance)

    # The initial values may be far off, so the variance is that after a first step.
    residual = off + columns @ solved(off)[1]
    variance, step = solved(residual)
    residual = off + columns @ step
    instruments = used.copy()
    instruments[:, :, :3] = stretches.remove_mean(tracked, kept) * kept[:, None, None]
    inverse = np.linalg.inv(
        np.einsum("nij,nik->jk", instruments, columns) / variance + np.diag(prior)
    )
    score = np.einsum("nij,ni->nj", instruments, residual) / variance
    score = np.add.reduceat(score, stretches.begin, axis=0)
    clusters = len(stretches.begin)
    middle = score.T @ score * clusters / max(clusters - width, 1) + np.diag(prior)
    cov = np.diag(np.square(_PRIOR))
    cov[:width, :width] = inverse @ middle @ inverse.T
    whole = np.zeros(8)
    whole[:width] = step
    return _Solution(whole, cov, residual, float(np.sqrt(variance)))


def _require_agreement(stretches: _Stretches, residual: Floats, kept: Flags, place: object) -> None:
    """Raise `RecordingError` unless the gyroscope explains most of the rotation in most stretches.

    Otherwise the streams are from different bodies, or a clock jumps.
    """
    mean = _mean_rotation(stretches, stretches.q, kept)
    rotated = np.sum(np.square((mean.inv() * stretches.q).as_rotvec()[kept]))
    left = np.sum(np.square(residual[kept]))
    if np.mean(kept) < _KEPT:
        raise RecordingError(
            str(place),
            f"a gyroscope that agrees with {100.0 * np.mean(kept):.0f} % of the tracker's samples",
            f"{100.0 * _KEPT:.0f} % or more",
            "streams of one body, with clocks that do not jump",
        )
    if left > (1.0 - _EXPLAINED) * rotated:
        raise RecordingError(
            str(place),
            f"a gyroscope that explains {100.0 * max(0.0, 1.0 - left / rotated):.0f} % of the tracker's"
            " rotation",
            f"{100.0 * _EXPLAINED:.0f} % or more",
            "streams of one body, with clocks that do not jump",
        )
