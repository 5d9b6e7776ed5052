"""Does the gyroscope turn as the tracker does: another body's IMU, one that is frozen, mirrored axes."""

from typing import NamedTuple

import numpy as np

from jaxekf.calibration.motion_agreement import Integral, fit, rotation_vectors
from jaxekf.checks._findings import Findings
from jaxekf.checks._pose_findings import without_flips
from jaxekf.checks.sensor_agreement import EXPLAINED, Evidence
from jaxekf.recordings.types import NANOSECONDS, Floats, Imu, Optical, Recording

_WINDOW_S, _GRID_S = 0.2, 0.05
"""Turns are compared over windows of this length, at this spacing."""
_FEWEST_S = 10.0
"""Shortest overlap from which two motions are called different."""
_LONGEST_S = 1e5
"""Longer runs, and clocks that step by more, are not compared."""
_MOVING = np.deg2rad(5.0)
"""rad/s: rates below it are no motion."""
_UNLIKE, _ALIKE, _EXPLAINED, _MIRRORED, _NOTHING = 0.6, 0.8, 0.7, 0.95, 0.4
_JUMP = 0.3
"""Rotation between two poses, rad, that four times the usual ones must add to, to be left out as wrong."""
_OFTEN = 0.1
_FROZEN_S = 0.5
"""Shortest stretch of identical samples that is a frozen sensor."""


class _Match(NamedTuple):
    correlation: float
    """Largest correlation of the two rates' sizes, over all lags at which half of the run overlaps."""
    proper: float
    """Share of the tracker's turns that the gyroscope's explain, frames rotated."""
    mirrored: float
    """The same, frames rotated and mirrored."""
    rates: tuple[float, float]
    """Root mean square rates of tracker and gyroscope, rad/s."""


def rotation_findings(recording: Recording, found: Evidence) -> Findings:
    """Warnings on a gyroscope that does not measure the tracker's rotation, whatever the lag."""
    imu, tracker = recording.imu, recording.optical
    if imu is None:
        return Findings()
    frozen = _frozen(recording, imu)
    if frozen is not None or tracker is None:
        return Findings(() if frozen is None else (frozen,))
    tracker = without_flips(recording, found) or tracker
    if (share := _jumping(tracker, imu)) > _OFTEN:
        return Findings(
            (
                f"{100.0 * share:.0f} % of the tracker's turns from pose to pose are larger than any of the"
                " gyroscope's: wrong poses (swapped markers, outliers), wrong stamps, or the IMU of another"
                " body",
            )
        )
    match = _match(tracker, imu)
    if match is None or min(match.rates) < _MOVING:
        return Findings()
    tracked, read = (f"{np.rad2deg(rate):.3g} deg/s" for rate in match.rates)
    share = f"{100.0 * match.proper:.0f} %"
    left = 1.0 - match.mirrored
    if match.mirrored > _MIRRORED and match.proper < min(1.0 - 4.0 * left, _MIRRORED):
        others = [name for name, one in found.readings.items() if one.explained > EXPLAINED]
        also = f", or quaternions as '{others[0]}'" if others else ""
        text = (
            f"with one axis mirrored the gyroscope explains {100.0 * match.mirrored:.1f} % of the tracker's"
            f" rotation, as it is {share}: the sign of an axis is wrong, or two axes are exchanged{also};"
            " no rotation of the frames can correct a mirrored sensor"
        )
    elif match.proper > _EXPLAINED:
        return Findings()
    elif match.correlation < (_ALIKE if match.proper < _NOTHING else _UNLIKE):
        if _fits_in_part(tracker, imu):
            return Findings()
        text = (
            "the gyroscope does not follow the tracker's rotation at any lag (correlation"
            f" {match.correlation:.2f}; the tracker turns at {tracked}, the gyroscope at {read}): the"
            " IMU is on another body, of another run, or on a clock that differs by more than half of it"
        )
    elif match.correlation > _ALIKE:
        text = (
            "the gyroscope turns when the tracker does (correlation of the rates"
            f" {match.correlation:.2f}), but not about the same axes: it explains {share} of the rotation;"
            " its axes are scaled differently or exchanged, the quaternions have another order, or poses"
            " are flipped for a part of the run"
        )
    else:
        return Findings()
    return Findings((text,))


def _jumping(tracker: Optical, imu: Imu) -> float:
    """Share of the turns between consecutive poses that exceed three times the largest of the gyroscope."""
    rows = np.flatnonzero(tracker.valid)
    if len(rows) < 40:
        return 0.0
    q = tracker.q_ref_body[rows]
    size = np.linalg.norm(rotation_vectors(q[:-1], q[1:]), axis=1)
    fastest = float(np.linalg.norm(imu.gyroscope, axis=1).max())
    apart = np.diff(tracker.time_ns[rows]) / NANOSECONDS
    return float(np.mean(size > _JUMP + 3.0 * fastest * np.maximum(apart, np.median(apart))))


def _fits_in_part(tracker: Optical, imu: Imu) -> bool:
    """Whether the rates agree over a part of the run, as they do where a clock steps."""
    parts = [np.array_split(np.arange(len(tracker.time_ns)), count) for count in (2, 3)]
    for rows in (part for some in parts for part in some):
        found = _match(tracker.take(rows), imu)
        if found is not None and found.proper > _EXPLAINED and found.correlation > _ALIKE:
            return True
    return False


def _frozen(recording: Recording, imu: Imu) -> str | None:
    """A warning on a gyroscope of which all axes repeat for long, between samples that do not."""
    same = np.r_[False, (np.diff(imu.gyroscope, axis=0) == 0.0).all(axis=1)]
    edges = np.flatnonzero(np.diff(np.r_[False, same, False].astype(int)))
    begin, end = edges[::2] - 1, edges[1::2] - 1
    lasts = (imu.time_ns[end] - imu.time_ns[begin]) / NANOSECONDS
    long = np.flatnonzero(lasts > _FROZEN_S)
    span = (imu.time_ns[-1] - imu.time_ns[0]) / NANOSECONDS
    if not long.size:
        return None
    moves = [k for k in long if _tracker_turns(recording, *imu.time_ns[[begin[k], end[k]]])]
    if not moves:
        return None
    total = float(lasts[moves].sum())
    if total > 0.9 * span:
        return (
            "the gyroscope is frozen: all its samples are the same while the tracker turns; record the"
            " IMU again"
        )
    first = imu.time_ns[begin[moves[0]]] / NANOSECONDS
    stretches = f"{len(moves)} stretch{'es' if len(moves) > 1 else ''}"
    return (
        f"the gyroscope is frozen for {total:.2f} s in {stretches}, first at {first:.3f} s: its samples"
        " repeat exactly while the tracker turns; remove these rows, and the run is cut there"
    )


def _tracker_turns(recording: Recording, begin: int, end: int) -> bool:
    """Whether the tracker turns by several degrees between two times, ns."""
    tracker = recording.optical
    if tracker is None:
        return False
    taken = tracker.time_ns - tracker.latency_ns
    q = tracker.q_ref_body[tracker.valid & (taken >= begin) & (taken <= end)]
    if len(q) < 5:
        return False
    # A median over the beginning and the end is free of single wrong poses.
    far = np.linalg.norm(rotation_vectors(np.repeat(q[:1], len(q), axis=0), q), axis=1)
    return float(np.quantile(far, 0.75)) > np.deg2rad(3.0) and float(np.median(far)) > 0.01


def _match(tracker: Optical, imu: Imu) -> _Match | None:
    """Agreement of the rates at the lag at which their sizes correlate best; None for too short a run."""
    rows = np.flatnonzero(tracker.valid)
    if len(rows) < 40 or len(imu.time_ns) < 40:
        return None
    spans_s = [(one.time_ns[-1] - one.time_ns[0]) / NANOSECONDS for one in (tracker, imu)]
    if max(spans_s) > _LONGEST_S:
        return None
    start = imu.time_ns[0]
    t = (tracker.time_ns[rows] - tracker.latency_ns - start) / NANOSECONDS
    q = tracker.q_ref_body[rows]
    steps = rotation_vectors(q[:-1], q[1:])
    size = np.linalg.norm(steps, axis=1)
    near = np.diff(t) < 5.0 * np.median(np.diff(t))
    near &= size < _JUMP + 4.0 * np.quantile(size, 0.8)
    steps = np.where(near[:, None], steps, 0.0)
    path = np.concatenate([np.zeros((1, 3)), np.cumsum(steps, axis=0)])
    grid = np.arange(t[0], t[-1] - _WINDOW_S, _GRID_S)
    integral = Integral(imu.time_ns, imu.gyroscope)
    ticks = np.arange(0.0, integral.t[-1] - _WINDOW_S, _GRID_S)
    least = round(_FEWEST_S / _GRID_S)
    if min(len(grid), len(ticks)) < least:
        return None

    def at(times: Floats) -> Floats:
        return np.stack([np.interp(times, t, one) for one in path.T], axis=1)

    tracked, read = at(grid + _WINDOW_S) - at(grid), integral.between(ticks, ticks + _WINDOW_S)
    upper = np.searchsorted(t, grid + _WINDOW_S)
    lower = np.searchsorted(t, grid, side="right") - 1
    gaps = np.r_[0, np.cumsum(~near)]
    seen = gaps[np.minimum(upper, len(t) - 1)] == gaps[np.maximum(lower, 0)]
    one, other = np.linalg.norm(tracked, axis=1), np.linalg.norm(read, axis=1)
    one = np.minimum(one, np.quantile(one[seen], 0.98)) if seen.sum() >= least else one
    shift, correlation = _best_shift(one, seen, other, max(least, min(len(one), len(other)) // 2))
    if correlation < -1.0:
        return None
    # The whole number of steps is refined about the best one, for fast motion.
    first = grid - t[0] + (shift * _GRID_S)
    best = (-1.0, -1.0)
    for fine in np.arange(-_GRID_S, 1.01 * _GRID_S, 0.2 * _GRID_S):
        begin = first + fine
        inside = seen & (begin >= 0.0) & (begin + _WINDOW_S <= integral.t[-1])
        if inside.sum() < least // 2:
            continue
        there = integral.between(begin[inside], begin[inside] + _WINDOW_S)
        here = tracked[inside]
        found = fit(here, there).explained, fit(here, -there).explained
        best = max(best, found, key=max)
    speeds = tuple(float(np.sqrt(np.mean(x**2))) / _WINDOW_S for x in (one[seen], other))
    return _Match(correlation, *best, (speeds[0], speeds[1]))


def _best_shift(one: Floats, seen: Floats, other: Floats, least: int) -> tuple[int, float]:
    """Shift s, and the correlation there, at which ``one[i]`` is most like ``other[i + s]``; where seen.

    All shifts at which `least` samples overlap are tried, by sums that are correlations of sequences.
    """
    size = 1 << int(np.ceil(np.log2(len(one) + len(other))))

    def sums(a: Floats, b: Floats) -> Floats:
        made = np.fft.irfft(np.conj(np.fft.rfft(a, size)) * np.fft.rfft(b, size), size)
        return np.r_[made[size - len(one) + 1 :], made[: len(other)]]

    weight = seen.astype(float)
    one, every = one * weight, np.ones(len(other))
    count = sums(weight, every)
    mean, square = sums(one, every), sums(one**2, every)
    of_mean, of_square = sums(weight, other), sums(weight, other**2)
    enough = count >= least - 0.5
    count = np.maximum(count, 1.0)
    shared = sums(one, other) - mean * of_mean / count
    norms = (square - mean**2 / count) * (of_square - of_mean**2 / count)
    floor = 1e-12 * max(float(np.max(square) * np.max(of_square)), 1e-30)
    found = np.where(enough & (norms > floor), shared / np.sqrt(np.maximum(norms, floor)), -2.0)
    best = int(np.argmax(found))
    return best - len(one) + 1, float(found[best])
