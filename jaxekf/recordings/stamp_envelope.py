"""Stamps of receipt: the line below them that a regular sampling clock follows, and the delays above it.

A sample that is taken every period and received after a delay has a stamp on or above a line in the number
of the sample. The line is the lower envelope: none of the stamps is below it, and their mean distance from
it is smallest. It follows slow drift of the clock by windows that overlap.
"""

from typing import NamedTuple

import numpy as np

from jaxekf.recordings.types import NANOSECONDS, Floats, Times

_WINDOW_S = 60.0
_LEAST = 300
"""Fewest samples of a window."""
_ROUNDS = 8
_NEAR_S = 1.0


class Delays(NamedTuple):
    """Delays of stamps above their lower envelope."""

    period_s: float
    """Mean period of the envelope."""
    median_s: float
    largest_s: float
    spread_s: float
    """Difference of the quantiles 1 % and 99 %."""
    lost: int
    """Samples that are missing by steps of the envelope."""


def restamped(time_ns: Times) -> tuple[Times, Delays]:
    """Stamps (N,) on their lower envelope, to the nanosecond, and the delays that were taken off."""
    line, number = _envelope(time_ns)
    late = (time_ns - line) / NANOSECONDS
    period = float((line[-1] - line[0]) / max(number[-1] - number[0], 1)) / NANOSECONDS
    low, high = np.quantile(late, [0.01, 0.99])
    found = Delays(
        period,
        float(np.median(late)),
        float(late.max()),
        float(high - low),
        int(number[-1] - number[0] + 1 - len(number)),
    )
    return line, found


def delays(time_ns: Times) -> Delays:
    """Delays of stamps (N,) above their lower envelope."""
    return restamped(time_ns)[1]


def _envelope(time_ns: Times) -> tuple[Times, Times]:
    """The envelope (N,) at each stamp, and the number (N,) of each sample, with the lost ones counted."""
    stamp = (time_ns - time_ns[0]).astype(float)
    number = np.arange(len(stamp), dtype=np.int64)
    offset, period = _supporting_line(number.astype(float), stamp)
    for _ in range(_ROUNDS):
        missing = _missing(stamp - offset - period * number, period)
        if not missing.any():
            break
        number = number + np.cumsum(missing)
        offset, period = _supporting_line(number.astype(float), stamp)
    line = _followed(number.astype(float), stamp, period)
    count = np.arange(len(line))
    whole = np.round(line).astype(np.int64) + time_ns[0]
    return np.maximum.accumulate(whole - count) + count, number


def _supporting_line(number: Floats, stamp: Floats) -> tuple[float, float]:
    """Offset and slope of the line below all stamps with the smallest mean distance.

    It is the edge of the lower convex hull above the mean number.
    """
    hull: list[int] = []
    x, y = number.tolist(), stamp.tolist()
    for i in range(len(x)):
        while len(hull) > 1:
            a, b = hull[-2], hull[-1]
            if (y[b] - y[a]) * (x[i] - x[a]) < (y[i] - y[a]) * (x[b] - x[a]):
                break
            hull.pop()
        hull.append(i)
    at = int(np.searchsorted(number[hull], number.mean()))
    a, b = hull[max(at - 1, 0)], hull[max(at, 1)]
    slope = (y[b] - y[a]) / (x[b] - x[a])
    return y[a] - slope * x[a], slope


def _missing(late: Floats, period: float) -> Times:
    """Lost samples before each stamp (N,): rises of the smallest delay by whole periods that last."""
    window = max(10, round(_NEAR_S * NANOSECONDS / period)) if period > 0 else 10
    found = np.zeros(len(late), np.int64)
    if len(late) < 4 * window:
        return found
    views = np.lib.stride_tricks.sliding_window_view(late, window).min(axis=1)
    rise = views[window:] - views[: len(views) - window]
    while True:
        top = int(np.argmax(rise))
        count = round(float(rise[top]) / period)
        if rise[top] < 0.6 * period or count < 1:
            return found
        # The rise is after the last sample below it.
        near = late[top : top + 2 * window] - views[top]
        found[
            min(top + int(np.flatnonzero(near < (count - 0.5) * period)[-1]) + 1, len(late) - 1)
        ] += count
        rise[max(0, top - 2 * window) : top + 2 * window] = 0.0
    return found


def _followed(number: Floats, stamp: Floats, period: float) -> Floats:
    """The envelope of overlapping windows, blended, at each number."""
    half = max(_LEAST, round(_WINDOW_S * NANOSECONDS / max(period, 1.0))) / 2.0
    span = number[-1] - number[0]
    if span < 3.0 * half:
        offset, slope = _supporting_line(number, stamp)
        return offset + slope * number
    centres = np.linspace(number[0], number[-1], int(np.ceil(span / half)) + 1)
    gap = centres[1] - centres[0]
    total, weight = np.zeros((2, len(number)))
    for centre in centres:
        inside = np.abs(number - centre) <= gap
        if inside.sum() < 10:
            continue
        offset, slope = _supporting_line(number[inside], stamp[inside])
        share = np.maximum(1.0 - np.abs(number - centre) / gap, 0.0)[inside]
        total[inside] += share * (offset + slope * number[inside])
        weight[inside] += share
    known = weight > 1e-9
    return np.interp(number, number[known], total[known] / weight[known])
