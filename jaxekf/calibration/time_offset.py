"""Time offset and rotation between a tracker and an IMU, from the angular rates that both measure.

The rotation of the tracker from sample to sample equals the integral of the gyroscope's rate over the same
time, in the same frame. A coarse lag search by correlation needs no frames; Gauss-Newton then estimates
latency, tracker-to-IMU rotation and gyroscope bias together. `attitude_alignment.refine` improves the
result.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from jaxekf._support.errors import RecordingError
from jaxekf.calibration._gyroscope_integral import GyroscopeIntegral
from jaxekf.calibration.motion_agreement import (
    Integral,
    best_lag,
    limiting_weights,
    wrapped,
)
from jaxekf.geometry.host_rotation import nearest_rotation
from jaxekf.recordings.types import NANOSECONDS, Flags, Floats, Imu, Optical, period_ns, to_scipy

_LARGEST_S = 0.5
"""Largest latency, s, that is accepted."""
_LONGEST_GAP = 2.5
"""Sampling periods between two samples up to which a relative rotation is used."""
_FEWEST = 50
"""Fewest relative rotations."""
_COARSE = 6000
"""Relative rotations that the coarse search uses."""
_OUTLIER_RATIO = 5.0
"""Residuals larger than the median by this factor are outliers."""
_ROUNDS, _CONVERGED = 12, 1e-6
"""Most iterations, and the step, rad and s, that ends them."""
_CORRELATED = 8
"""Samples over which residuals are taken to be correlated."""
_LARGEST_SIGMA_S = 0.005
"""Largest accepted standard deviation of the latency, s."""
_BLOCK_S, _LOCAL = 0.2, 20
"""Seconds over which rates are compared, and blocks whose mean is subtracted."""
_LARGEST_BLOCK = 1.0
"""Rotation, rad, in the tracker's median step rate, over which rates are compared at most."""
_LARGEST_CORRELATION = 1.0 - 1e-9
_SIGNIFICANT = 8.0
"""Standard deviations that the correlation of pure noise, with lag and frame fitted to it, does not
reach."""


@dataclass(frozen=True)
class Match:
    """Time offset and rotation of a tracker relative to an IMU."""

    latency_s: float
    """Seconds by which the tracker's samples are older than stamped, on the IMU's clock."""
    latency_sigma_s: float
    """Its standard deviation, s."""
    alignment: Floats
    """(3,) rotation vector, rad, from tool frame to IMU frame, as `calibration.alignment` of `loose_pose`
    and `tight`. The tracker's rate, in the tool frame, is ``exp(alignment)' (gyroscope - bias)``."""
    alignment_sigma: Floats
    """(3,) standard deviations, rad; large about an axis if all rotation was about that axis."""
    bias: Floats
    """(3,) rad/s, gyroscope bias, IMU frame."""
    turns: int
    """Relative rotations that were used, outliers excluded."""


class _Rotations(NamedTuple):
    """Rotations of the tracker from sample to sample."""

    begin: Floats
    """(N,) s from the IMU's first sample, as stamped."""
    end: Floats
    turn: Floats
    """(N, 3) rotation vectors, rad, tool frame."""


def match(optical: Optical, imu: Imu, place: object = "recording") -> Match:
    """Latency of a tracker relative to an IMU, up to half a second, and the rotation between their frames.

    Parameters
    ----------
    optical
        Attitudes of the tool.
    imu
        Rates of the IMU.
    place
        Name of the recording for error messages.

    Raises
    ------
    RecordingError
        If there are fewer than 50 relative rotations, if the motion determines the latency to no
        better than 5 ms, or if the latency is half a second or more.

    Examples
    --------
    >>> from dataclasses import replace
    >>> import jaxekf
    >>> from jaxekf.calibration import time_offset
    >>> run = jaxekf.load(jaxekf.demo.FOLDER / "free-5")
    >>> optical = run.need_optical()
    >>> late = replace(optical, time_ns=optical.time_ns + 20_000_000)
    >>> round(float(time_offset.match(late, run.need_imu()).latency_s), 2)
    0.02
    """
    linear = Integral(imu.time_ns, imu.gyroscope)
    turns = _relative_rotations(optical, imu, linear)
    if len(turns.turn) < _FEWEST:
        raise RecordingError(
            str(place),
            f"{len(turns.turn)} pairs of tracker samples within the IMU's time",
            f"{_FEWEST} or more to match the clocks by",
            "a longer recording, or one in which the tool is visible",
        )
    integral = GyroscopeIntegral(linear.t, imu.gyroscope)
    latency = _coarse_latency(turns, linear, period_ns(optical.time_ns) / NANOSECONDS)
    found = _gauss_newton(turns, integral, latency)
    if abs(found.latency_s) >= _LARGEST_S:
        raise RecordingError(
            str(place),
            f"a latency of {found.latency_s:+.2f} s between tracker and gyroscope",
            f"clocks within {_LARGEST_S:g} s of each other",
            "shifting the times of one stream first",
        )
    if not found.latency_sigma_s <= _LARGEST_SIGMA_S:
        raise RecordingError(
            str(place),
            "too little rotation of varying speed: the latency is"
            f" known to {1e3 * found.latency_sigma_s:.0f} ms only",
            f"{1e3 * _LARGEST_SIGMA_S:.0f} ms or better",
            "a recording in which the tool rotates about several axes at varying speed",
        )
    _require_rate_changes(turns, integral, found, place)
    return found


def _require_rate_changes(
    turns: _Rotations, integral: GyroscopeIntegral, found: Match, place: object
) -> None:
    """Raise `RecordingError` unless both streams share the same changes of rate.

    At constant rate the only changes are the gyroscope's noise. Some lag always fits that noise best,
    and as sharply as motion, so the changes must also be present in the tracker.
    """
    tracked, integrated, durations = _block_sums(turns, integral, found)
    size = np.linalg.norm(tracked / durations, axis=1)
    kept = size <= _OUTLIER_RATIO * max(float(np.quantile(size, 0.9)), 1e-12)
    one, other = (_remove_local_mean((s / durations)[kept]) for s in (tracked, integrated))
    shared = float(np.sum(one * other))
    squares = float(np.sum(one**2) * np.sum(other**2))
    correlation = shared / np.sqrt(squares) if squares > 0.0 else 0.0
    # Fisher's transform makes the bound right for few blocks, too.
    scale = np.sqrt(max(one.size - 3, 1))
    limited = np.clip(correlation, -_LARGEST_CORRELATION, _LARGEST_CORRELATION)
    if np.arctanh(limited) * scale < _SIGNIFICANT:
        raise RecordingError(
            str(place),
            "too little rotation of varying speed: tracker and gyroscope do not correlate"
            f" (correlation {correlation:.2f})",
            f"{np.tanh(_SIGNIFICANT / scale):.2f} or more",
            "a recording in which the tool rotates about several axes at varying speed",
        )


def _block_sums(
    turns: _Rotations, integral: GyroscopeIntegral, found: Match
) -> tuple[Floats, Floats, Floats]:
    """Rotations of tracker and gyroscope (N, 3), rad, tool frame, and durations (N, 1), s, of blocks.

    The rotations of a block are added, which no block is too long or too fast for. A rate that turns with
    a fast body averages out, so that blocks are shorter there.
    """
    span = turns.end - turns.begin
    rate = np.median(np.linalg.norm(turns.turn, axis=1) / span)
    length = min(_BLOCK_S, _LARGEST_BLOCK / max(float(rate), 1e-12))
    _, block = np.unique(np.floor(turns.begin / max(length, 1e-9)), return_inverse=True)
    predicted = integral.rotation(turns.begin - found.latency_s, turns.end - found.latency_s)
    predicted = Rotation.from_rotvec(found.alignment).inv().apply(predicted.as_rotvec())

    def summed(vectors: Floats) -> Floats:
        columns = [np.bincount(block, column).astype(float) for column in vectors.T]
        return np.stack(columns, axis=1)

    return summed(turns.turn), summed(predicted), summed(span[:, None])


def _remove_local_mean(rates: Floats) -> Floats:
    """Rates (N, 3) minus their local mean, which removes constant rotation and a drifting bias."""
    groups = np.arange(len(rates)) // _LOCAL
    count = np.bincount(groups)[:, None]
    total = np.stack([np.bincount(groups, rates[:, i]) for i in range(3)], axis=1)
    return rates - (total / count)[groups]


def _relative_rotations(optical: Optical, imu: Imu, integral: Integral) -> _Rotations:
    rows = np.flatnonzero(optical.valid)
    times = (optical.time_ns - optical.latency_ns - imu.time_ns[0])[rows] / NANOSECONDS
    attitude = to_scipy(optical.q_ref_body[rows])
    turn = (attitude[:-1].inv() * attitude[1:]).as_rotvec()
    span = np.diff(times)
    last = integral.t[-1]
    kept = span <= _LONGEST_GAP * period_ns(optical.time_ns) / NANOSECONDS
    kept &= (times[:-1] >= _LARGEST_S) & (times[1:] <= last - _LARGEST_S)
    kept &= integral.known(times[:-1], times[1:])
    return _Rotations(times[:-1][kept], times[1:][kept], turn[kept])


def _coarse_latency(turns: _Rotations, integral: Integral, period_s: float) -> float:
    """The latency, s, at which the rotation speeds correlate best; independent of the frames."""
    # A subset is enough for a rough estimate.
    turns = _Rotations(*(field[:: max(1, len(field) // _COARSE)] for field in turns))
    span = turns.end - turns.begin
    speed = np.linalg.norm(turns.turn, axis=1) / span
    # A wrong pose is a spike of speed, which would dominate the correlation.
    speed = np.minimum(speed, np.quantile(speed, 0.98))

    def gyroscope_speed(lag: float) -> Floats:
        integrated = integral.between(turns.begin - lag, turns.end - lag)
        return wrapped(np.linalg.norm(integrated, axis=1)) / span

    step = max(0.01, min(0.5 * period_s, 0.02))
    lags = np.arange(-_LARGEST_S, _LARGEST_S + step, step)
    return best_lag(speed[None], gyroscope_speed, lags)


def _gauss_newton(turns: _Rotations, integral: GyroscopeIntegral, latency: float) -> Match:
    """Latency, alignment and bias by Gauss-Newton, outliers left out.

    The residual of a step is the rotation that the gyroscope's leaves of the tracker's, so that a step may
    turn by any angle.
    """
    tracked = Rotation.from_rotvec(turns.turn)
    weight = limiting_weights(turns.turn, 0.98)
    integrated = integral.rotation(turns.begin - latency, turns.end - latency).as_rotvec()
    turn = Rotation.from_matrix(nearest_rotation((weight * turns.turn).T @ integrated))
    kept = np.ones(len(turns.turn), bool)
    design, solution, residual = np.zeros((len(kept), 3, 7)), np.zeros(7), turns.turn
    for _ in range(_ROUNDS):
        begin, end = integral.at(turns.begin - latency), integral.at(turns.end - latency)
        into = turn * end.q.inv()
        expected = into * begin.q * turn.inv()
        design[:, :, :3] = expected.as_matrix() - np.eye(3)
        design[:, :, 3:6] = -(into.as_matrix() @ (end.q_integral - begin.q_integral))
        design[:, :, 6] = into.apply(begin.q.apply(begin.rate)) - turn.apply(end.rate)
        flat, missed = design[kept].reshape(-1, 7), (expected * tracked).as_rotvec()
        solution = np.linalg.lstsq(flat, missed[kept].ravel(), rcond=None)[0]
        residual = missed - np.einsum("nij,j->ni", design, solution)
        turn = Rotation.from_rotvec(solution[:3]) * turn
        latency = float(np.clip(latency + np.clip(solution[6], -0.02, 0.02), -1.0, 1.0))
        size = np.linalg.norm(residual, axis=1)
        kept = size <= _OUTLIER_RATIO * max(float(np.median(size)), 1e-12)
        if np.max(np.abs(solution[[0, 1, 2, 6]])) < _CONVERGED:
            break
    sigma = np.sqrt(np.diagonal(_robust_covariance(design, residual, kept)))
    return Match(
        latency,
        float(sigma[6]),
        turn.inv().as_rotvec(),
        sigma[:3],
        solution[3:6],
        int(kept.sum()),
    )


def _robust_covariance(design: Floats, residual: Floats, kept: Flags) -> Floats:
    """Covariance of a least-squares solution with autocorrelated residuals (Newey-West).

    The noise of one sample enters two relative rotations with opposite sign, so most of it cancels.
    """
    score = np.einsum("nij,ni->nj", design, residual) * kept[:, None]
    middle = score.T @ score
    for lag in range(1, min(_CORRELATED, len(score) - 1) + 1):
        cross = score[lag:].T @ score[:-lag]
        middle += (1.0 - lag / (_CORRELATED + 1.0)) * (cross + cross.T)
    flat = design[kept].reshape(-1, design.shape[2])
    inverse = np.linalg.pinv(flat.T @ flat)
    # Lower bound for the case that the correlated noise cancels almost completely.
    naive = inverse * float(np.sum(residual[kept] ** 2)) / max(flat.shape[0] - flat.shape[1], 1)
    cov = inverse @ middle @ inverse
    short = np.diagonal(cov) < 0.05 * np.diagonal(naive)
    cov[short, short] = 0.05 * np.diagonal(naive)[short]
    return cov
