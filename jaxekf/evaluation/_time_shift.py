"""The time shift at which an estimate agrees best with the encoder."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from jaxekf.evaluation.consistency import inflation
from jaxekf.recordings.truth import encoder_at, encoder_rate_at
from jaxekf.recordings.types import NANOSECONDS, Encoder, Floats, Times, to_scipy

_MOST = 2000
"""Instants that are compared: the shift needs no more."""
_FEWEST = 50
_STEPS = 8
_LONGEST_S = 0.5
_GRID_S = 0.02
_FAR_RAD = 0.02
"""Error, rad, from which on the shift may be too long to be found from zero."""
_LEAST_RATE = 0.05
"""Root mean square, rad/s or rad/s^2, of a motion that differs from a constant error."""
_SLOPE_NS = 5_000_000
_SMALL_S = 5e-4
"""A step of Gauss-Newton below which the next one changes nothing that counts."""
_COARSE = 300
"""Instants that are compared at each shift of the grid."""

Residual = Callable[[float], tuple[Floats, Floats]]


class TimeShift(NamedTuple):
    """A shift, s, to be added to the estimate's times; NaN where the motion does not show it."""

    shift_s: float
    sigma_s: float


UNKNOWN = TimeShift(float("nan"), float("nan"))


def attitude_shift(encoder: Encoder, time_ns: Times, q: Floats) -> TimeShift:
    """Shift of attitudes (N, 4) at times (N,) of the encoder's clock, constant rotations apart."""
    time_ns, q = _thinned(time_ns, q)

    def residual(shift_s: float) -> tuple[Floats, Floats]:
        at = time_ns + round(shift_s * NANOSECONDS)
        truth, rate = encoder_at(encoder, at), encoder_rate_at(encoder, at)
        seen = truth.scored & np.isfinite(rate).all(axis=1)
        body = to_scipy(q[seen])
        off = (to_scipy(truth.q_ref_body[seen]).inv() * body).as_rotvec()
        # A wrong frame of the reference turns with the body, one of the body does not.
        turned = body.as_matrix().transpose(0, 2, 1)
        both = np.concatenate([rate[seen][:, :, None], _eyes(len(off)), turned], axis=2)
        return off, both

    found, error = _descent(residual, 0.0)
    if error < _FAR_RAD:
        return found
    few, few_q = _thinned(time_ns, q, _COARSE)
    grid = np.arange(-_LONGEST_S, _LONGEST_S + _GRID_S / 2, _GRID_S)
    costs = []
    for shift in grid:
        truth = encoder_at(encoder, few + round(shift * NANOSECONDS))
        off = (to_scipy(truth.q_ref_body).inv() * to_scipy(few_q)).magnitude()[truth.scored]
        costs.append(float(np.mean(off**2)) if len(off) >= _FEWEST else np.inf)
    other, left = _descent(residual, float(grid[int(np.argmin(costs))]))
    return other if left < error else found


def rate_shift(encoder: Encoder, time_ns: Times, rate: Floats, near_s: float = 0.0) -> TimeShift:
    """Shift of rates (N, 3) at times (N,) of the encoder's clock, a constant bias apart.

    The search starts from zero and from `near_s`.
    """
    time_ns, rate = _thinned(time_ns, rate)
    times = encoder.time_ns - encoder.latency_ns

    def residual(shift_s: float) -> tuple[Floats, Floats]:
        at = time_ns + round(shift_s * NANOSECONDS)
        true = encoder_rate_at(encoder, at)
        half = _SLOPE_NS
        slope = encoder_rate_at(encoder, at + half) - encoder_rate_at(encoder, at - half)
        slope /= 2 * half / NANOSECONDS
        judged = np.interp(at, times, encoder.scored & encoder.valid) > 0.99
        seen = judged & np.isfinite(true + slope).all(axis=1)
        off = (rate - true)[seen]
        return off, np.concatenate([slope[seen][:, :, None], _eyes(len(off))], axis=2)

    found, error = _descent(residual, 0.0)
    if abs(near_s) > _SMALL_S:
        other, left = _descent(residual, near_s)
        found = other if left < error else found
    return found


def _eyes(count: int) -> Floats:
    return np.broadcast_to(np.eye(3), (count, 3, 3))


def _thinned(time_ns: Times, values: Floats, most: int = _MOST) -> tuple[Times, Floats]:
    step = -(-len(time_ns) // most)
    return time_ns[::step], values[::step]


def _descent(residual: Residual, shift: float) -> tuple[TimeShift, float]:
    """The shift by Gauss-Newton steps, and the root mean square of its residuals."""
    nothing = UNKNOWN, float("inf")
    for _ in range(_STEPS):
        off, columns = residual(shift)
        if len(off) < _FEWEST or np.sqrt(np.mean(columns[:, :, 0] ** 2)) < _LEAST_RATE:
            return nothing
        rows = columns.reshape(-1, columns.shape[2])
        information = rows.T @ rows
        inverse = np.linalg.pinv(information, rcond=1e-9, hermitian=True)
        size = inverse @ (rows.T @ off.ravel())
        shift += float(np.clip(size[0], -0.1, 0.1))
        if abs(size[0]) < _SMALL_S:
            break
    else:
        return nothing
    left = off - (columns @ size)
    variance = float(np.mean(left**2)) * inflation([left])
    return TimeShift(shift, float(np.sqrt(variance * inverse[0, 0]))), float(
        np.sqrt(np.mean(left**2))
    )
