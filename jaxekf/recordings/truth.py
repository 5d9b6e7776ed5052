"""Truth at other times than it was recorded at; nothing is invented in gaps."""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Slerp

from jaxekf.recordings.types import NANOSECONDS, Encoder, Floats, Times, from_scipy, to_scipy


def encoder_at(encoder: Encoder, time_ns: Times, longest_gap_s: float = 0.1) -> Encoder:
    """The encoder's attitude at other times, along the shorter arc between its valid samples, and its
    position on the straight line.

    Outside the recorded span, and inside gaps longer than `longest_gap_s`, the result is not valid:
    interpolation never invents truth.
    """
    encoder = _as_taken(encoder)
    kept = np.flatnonzero(encoder.valid)
    if kept.size < 2:
        unknown = np.tile([1.0, 0.0, 0.0, 0.0], (len(time_ns), 1))
        no = np.zeros(len(time_ns), bool)
        nowhere = None if encoder.position is None else np.full((len(time_ns), 3), np.nan)
        return Encoder(time_ns, unknown, no, no, nowhere)
    times = encoder.time_ns[kept]
    after = _bracket(times, time_ns)
    gap = (times[after] - times[after - 1]) / NANOSECONDS
    exact = (times[after] == time_ns) | (times[after - 1] == time_ns)
    inside = (time_ns >= times[0]) & (time_ns <= times[-1])
    valid = inside & (exact | (gap <= longest_gap_s))
    seconds = (times - times[0]) / NANOSECONDS
    asked = np.clip((time_ns - times[0]) / NANOSECONDS, 0.0, seconds[-1])
    q = from_scipy(Slerp(seconds, to_scipy(encoder.q_ref_body[kept]))(asked))
    upper = _bracket(encoder.time_ns, time_ns)
    nearest = upper - (time_ns - encoder.time_ns[upper - 1] < encoder.time_ns[upper] - time_ns)
    position = None
    if encoder.position is not None:
        known = encoder.position[kept]
        position = np.stack([np.interp(asked, seconds, known[:, i]) for i in range(3)], axis=1)
    scored = valid & (encoder.scored & encoder.valid)[nearest]
    return Encoder(time_ns, q, valid, scored, position)


def encoder_rate_at(encoder: Encoder, time_ns: Times, longest_gap_s: float = 0.1) -> Floats:
    """Body rate (N, 3), rad/s, at other times; NaN where the encoder has no value.

    Central differences of the encoder's attitude, interpolated linearly, neither of them over gaps
    longer than `longest_gap_s`.
    """
    encoder = _as_taken(encoder)
    if len(encoder.time_ns) < 3:
        return np.full((len(time_ns), 3), np.nan)
    before, after = to_scipy(encoder.q_ref_body[:-2]), to_scipy(encoder.q_ref_body[2:])
    return _per_second((before.inv() * after).as_rotvec(), encoder, time_ns, longest_gap_s)


def encoder_velocity_at(encoder: Encoder, time_ns: Times, longest_gap_s: float = 0.1) -> Floats:
    """Velocity (N, 3), m/s, reference frame, at other times; NaN where the encoder has no value.

    Central differences of the encoder's position; gaps as in `encoder_rate_at`.
    """
    encoder = _as_taken(encoder)
    if len(encoder.time_ns) < 3 or encoder.position is None:
        return np.full((len(time_ns), 3), np.nan)
    moved = encoder.position[2:] - encoder.position[:-2]
    return _per_second(moved, encoder, time_ns, longest_gap_s)


def _as_taken(encoder: Encoder) -> Encoder:
    """The encoder with the times at which its samples were taken as its stamps."""
    if encoder.latency_ns == 0:
        return encoder
    return replace(encoder, time_ns=encoder.time_ns - encoder.latency_ns, latency_ns=0)


def _per_second(change: Floats, encoder: Encoder, time_ns: Times, longest_gap_s: float) -> Floats:
    """Changes (N - 2, 3) over two steps as rates of change at other times."""
    rate = change / ((encoder.time_ns[2:] - encoder.time_ns[:-2])[:, None] / NANOSECONDS)
    rate[~(encoder.valid[:-2] & encoder.valid[1:-1] & encoder.valid[2:])] = np.nan
    wide = np.diff(encoder.time_ns) > longest_gap_s * NANOSECONDS
    rate[wide[:-1] | wide[1:]] = np.nan
    middle = encoder.time_ns[1:-1]
    seconds = (middle - middle[0]) / NANOSECONDS
    asked = (time_ns - middle[0]) / NANOSECONDS
    columns = [np.interp(asked, seconds, rate[:, i], left=np.nan, right=np.nan) for i in range(3)]
    found = np.stack(columns, axis=1)
    upper = _bracket(encoder.time_ns, time_ns)
    found[wide[upper - 1] & (encoder.time_ns[upper] != time_ns)] = np.nan
    return found


def _bracket(times: Times, asked: Times) -> NDArray[np.intp]:
    """Index of the sample at or after each asked time, so that it and the one before bracket it."""
    return np.clip(np.searchsorted(times, asked, side="left"), 1, len(times) - 1)
