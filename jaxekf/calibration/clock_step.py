"""Steps between the clocks of a tracker and an IMU: the lag of the tracker before and after.

`find` measures the lag window by window, from the speeds of rotation. A step divides the windows in two
parts with a lag of their own, and the rotations must agree far better with two lags than with one; a steady
drift is no step.
"""

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from jaxekf._support.errors import RecordingError
from jaxekf.calibration._gyroscope_integral import GyroscopeIntegral
from jaxekf.calibration.clock_offset import AGREE, Speeds, correlations, fits_as_well, speeds
from jaxekf.calibration.motion_agreement import (
    compose,
    fit,
    relative_rotations,
    rotation_agreement,
    rotation_vectors,
)
from jaxekf.recordings.types import NANOSECONDS, Floats, Imu, Optical

_WINDOW_S, _MOST_WINDOWS = 8.0, 200
_REACH_S = 60.0
"""Largest lag, s, of a window."""
_TRACKED = 0.6
"""Least share of a window in which the tracker is seen."""
_CLEAR = 1.0
"""Windows with a clear lag in the length of one; they overlap by half, so that there are two."""
_APART_S = 0.5
_CORRELATION = 0.7
_SMALLEST_S, _FEWEST = 0.03, 2
"""Smallest step, s, and fewest windows on each side of one."""
_LARGEST_DRIFT = 1e-3
"""Drift, s/s, that could be taken for a step."""
_BETTER, _OUTLYING_S, _RESOLUTION_S = 0.5, 0.5, 0.003
"""Factor by which two lags must reduce the windows' residuals, their limit, s, and their noise, s."""
_GAIN, _NOISE = 4.0, 0.003
"""Factor by which two lags must reduce the unexplained share, and noise that is added to it."""
_BESIDE, _YEAR_S, _BY_CHANCE = 20, 365.25 * 86400.0, 0.1
"""Samples beside a jump, and the share of a run's attitudes that are near to one of them by chance."""
_SIZE_OFF, _NEAR_S = 0.2, 2.0
"""Relative error of a gap that is the step, and seconds from the step."""


class ClockStepError(RecordingError):
    """A run whose clocks step against each other, so that it has no one latency."""


class ClockStep(NamedTuple):
    """A step of the tracker's clock against the IMU's."""

    time_s: float
    """Time of the last sample before the step, s on the recording's clock."""
    since_s: float
    """The same since the IMU's first sample."""
    step_s: float
    """Growth of the tracker's lag, s."""
    stream: str
    """``tracker`` or ``IMU``, whose time stamps show a gap of this size there; empty if neither does."""
    explained: tuple[float, float]
    """Shares of the rotation that the gyroscope explains with one lag and with two."""

    def error(self, place: object) -> RecordingError:
        """The error of a run that cannot have one clock offset."""
        gained = " and ".join(f"{100.0 * share:.0f} %" for share in self.explained)
        return ClockStepError(
            str(place),
            f"{self.sentence()} (the gyroscope explains {gained} of the rotation without and with it)",
            "clocks that do not step",
            f"the parts before and after one by one (jaxekf crop, at {self.since_s:.2f} s)",
        )

    def sentence(self) -> str:
        """Size and time of the step, and whose it is if the time stamps show it."""
        when = f"after {self.since_s:.2f} s of the run (at {self.time_s:.2f} s)"
        if self.stream == "IMU":
            return (
                f"a step of the IMU's clock by {-self.step_s:+.3f} s against the tracker's {when}"
            )
        whose = "the tracker's clock" if self.stream else "the tracker's clock, or of the IMU's,"
        size = f"{self.step_s:+.3f} s" if self.stream else f"{abs(self.step_s):.3f} s"
        other = "IMU's" if self.stream else "other"
        return f"a step of {whose} by {size} against the {other} {when}"


def find(optical: Optical, imu: Imu) -> ClockStep | None:
    """The largest step between the clocks; None if one lag, or one that drifts, explains the rotations.

    Parameters
    ----------
    optical
        Attitudes of the tool.
    imu
        Rates of the IMU.
    """
    rows = np.flatnonzero(optical.valid)
    t = (optical.time_ns[rows] - optical.latency_ns - imu.time_ns[0]) / NANOSECONDS
    q = optical.q_ref_body[rows]
    made = speeds(t, q.__getitem__, imu)
    if made is None:
        return None
    centres, lags = _window_lags(made, float(t[0]), _WINDOW_S)
    if len(lags) < _CLEAR * np.ptp(t) / _WINDOW_S:
        # Slow motion determines the lag of longer windows only.
        centres, lags = _window_lags(made, float(t[0]), 2.0 * _WINDOW_S)
    division = _division(centres, lags)
    if division is None:
        return None
    located = _located(t, q, imu, division)
    if located is None:
        return None
    split, step_s, explained = located
    return _attributed(optical, imu, float(t[split - 1]), step_s, explained)


def far_step(optical: Optical, imu: Imu) -> ClockStep | None:
    """A step of one clock by more than a minute, as if one stream had a gap; None without one.

    The rotations after the gap agree with the other stream at the times at which the stream would go on
    without the gap.

    Parameters
    ----------
    optical
        Attitudes of the tool.
    imu
        Rates of the IMU.
    """
    seen = optical.take(optical.valid)
    stamps = [(x - imu.time_ns[0]) / NANOSECONDS for x in (seen.time_ns, imu.time_ns)]
    stamps[0] = stamps[0] - optical.latency_ns / NANOSECONDS
    for which, stream in ((1, "IMU"), (0, "tracker")):
        steps = np.diff(stamps[which])
        at = int(np.argmax(steps)) if steps.size else 0
        if not steps.size or steps[at] < _REACH_S:
            continue
        gap = float(steps[at] - np.median(steps))
        others = np.diff(stamps[1 - which])
        if others.size and abs(np.max(others) - gap) < _SIZE_OFF * gap:
            continue
        times = [x.copy() for x in stamps]
        times[which][at + 1 :] -= gap
        end = times[which][at]
        joined = replace(imu, time_ns=np.round(times[1] * NANOSECONDS).astype(np.int64))
        shares = []
        for part in (times[0] <= end, times[0] > end):
            q = seen.q_ref_body[part]
            shares.append(rotation_agreement(times[0][part], q.__getitem__, joined, 0.0)[1])
        if min(shares) > AGREE:
            size = gap if which == 0 else -gap
            time_s = float(end) + float(imu.time_ns[0]) / NANOSECONDS
            return ClockStep(time_s, float(end), size, stream, (np.nan, min(shares)))
    return None


def common_jump(optical: Optical, imu: Imu) -> str | None:
    """A sentence on a gap of over a minute that both streams share; None without one.

    It is a step of both clocks if the motion goes on without a break across it, else a step or a pause.

    Parameters
    ----------
    optical
        Attitudes of the tool.
    imu
        Rates of the IMU.
    """
    seen = optical.take(optical.valid)
    if min(len(seen.time_ns), len(imu.time_ns)) < 2 * _BESIDE:
        return None
    at = [int(np.argmax(np.diff(x))) for x in (seen.time_ns, imu.time_ns)]
    gaps = [
        float(np.diff(x)[i]) / NANOSECONDS
        for x, i in zip((seen.time_ns, imu.time_ns), at, strict=True)
    ]
    apart = abs(int(seen.time_ns[at[0]]) - int(imu.time_ns[at[1]])) / NANOSECONDS
    if min(gaps) < _REACH_S or abs(gaps[0] - gaps[1]) > 1.0 or apart > 1.0:
        return None
    since = (imu.time_ns[at[1]] - imu.time_ns[0]) / NANOSECONDS
    when = f"after {since:.2f} s of the run (at {imu.time_ns[at[1]] / NANOSECONDS:.2f} s)"
    size = f"{gaps[1]:.0f} s" + (f" ({gaps[1] / _YEAR_S:.2f} years)" if gaps[1] > _YEAR_S else "")
    q = seen.q_ref_body
    beside = np.arange(max(1, at[0] - _BESIDE), min(len(q) - 2, at[0] + _BESIDE))
    turned = np.linalg.norm(rotation_vectors(q[beside], q[beside + 1]), axis=1)
    across = float(turned[beside == at[0]].sum())
    usual = float(np.quantile(turned[beside != at[0]], 0.95))
    whole = np.linalg.norm(rotation_vectors(q[: at[0]], np.tile(q[at[0]], (at[0], 1))), axis=1)
    # By chance an attitude after a pause is as near as this to the last one in few cases.
    if across < 3.0 * usual and np.mean(whole < 3.0 * usual) < _BY_CHANCE:
        return f"tracker and IMU jump together by {size} {when}: a step of both clocks"
    return f"tracker and IMU jump together by {size} {when}: a step of both clocks or a pause"


def _window_lags(made: Speeds, first_s: float, window_s: float) -> tuple[Floats, Floats]:
    """Centres of windows, s, and the lag of each that has a clear one."""
    length = len(made.tracker) * made.step_s
    size = int(max(window_s, 2.0 * length / _MOST_WINDOWS) / made.step_s)
    reach, ahead = int(_REACH_S / made.step_s), round(made.ahead_s / made.step_s)
    centres, found = [], []
    for begin in range(0, max(1, len(made.tracker) - size // 2), max(1, size // 2)):
        one = slice(begin, begin + size)
        low = max(0, begin + ahead - reach)
        other = slice(low, max(low, begin + ahead + size + reach))
        part = made._replace(
            tracker=made.tracker[one],
            tracked=made.tracked[one],
            gyroscope=made.gyroscope[other],
            covered=made.covered[other],
            ahead_s=made.ahead_s + (begin - low) * made.step_s,
        )
        if part.tracked.sum() < _TRACKED * size or not part.covered.any():
            continue
        lag = _clear_lag(*correlations(part)[:2])
        if lag is not None:
            centres.append(first_s + (begin + 0.5 * size) * made.step_s)
            found.append(lag)
    return np.array(centres), np.array(found)


def _clear_lag(lags: Floats, coefficient: Floats) -> float | None:
    """The lag of a correlation's peak, between the grid's points; None if another peak is as high."""
    if lags.size < 3:
        return None
    best = int(np.argmax(coefficient))
    top = float(coefficient[best])
    elsewhere = coefficient[np.abs(lags - lags[best]) > _APART_S]
    other = max(float(np.max(elsewhere, initial=0.0)), 0.0)
    if top < _CORRELATION or fits_as_well(other**2, top**2):
        return None
    if not 0 < best < len(lags) - 1:
        return float(lags[best])
    left, right = coefficient[best - 1], coefficient[best + 1]
    bend = left - 2.0 * top + right
    offset = 0.5 * (left - right) / bend if left > 0.0 < right and bend < 0.0 else 0.0
    return float(lags[best] + np.clip(offset, -0.5, 0.5) * (lags[1] - lags[0]))


class _Division(NamedTuple):
    """A time that divides the windows, and the lag of each part, s."""

    begin_s: float
    end_s: float
    before_s: float
    after_s: float


def _division(centres: Floats, lags: Floats) -> _Division | None:
    """The division with which two lags fit the windows best, if far better than a line does."""
    if len(lags) < 2 * _FEWEST:
        return None
    slopes = (lags[:, None] - lags) / np.where(
        centres[:, None] == centres, np.inf, centres[:, None] - centres
    )
    slope = np.median(slopes[np.triu_indices(len(lags), 1)])
    rest = lags - slope * centres
    line = min(_cost(rest - np.median(rest)), _cost(lags - np.median(lags)))
    found, least = None, np.inf
    for k in range(_FEWEST, len(lags) - _FEWEST + 1):
        before, after = np.median(lags[:k]), np.median(lags[k:])
        cost = _cost(lags[:k] - before) + _cost(lags[k:] - after)
        apart = centres[k:].mean() - centres[:k].mean()
        if cost < least and abs(after - before) > max(_SMALLEST_S, _LARGEST_DRIFT * apart):
            window = 2.0 * float(np.min(np.diff(centres)))
            least = cost
            found = _Division(
                float(centres[k - 1] - window),
                float(centres[k] + window),
                float(before),
                float(after),
            )
    return found if least < _BETTER * line else None


def _cost(rest: Floats) -> float:
    """Sum of absolute residuals of lags, s; a wrong lag counts no more than a limit."""
    return float(np.sum(np.minimum(np.abs(rest), _OUTLYING_S))) + _RESOLUTION_S * len(rest)


def _located(
    t: Floats, q: Floats, imu: Imu, division: _Division
) -> tuple[int, float, tuple[float, float]] | None:
    """First sample after the step, its size, s, and the shares that one lag and two explain.

    None unless two lags explain the rotations far better.
    """
    rotations = [
        relative_rotations(t[part], q[part].__getitem__, imu, offset_s=lag)
        for part, lag in (
            (t < division.begin_s, division.before_s),
            (t > division.end_s, division.after_s),
        )
    ]
    before, after = rotations
    if before is None or after is None:
        return None
    before, after = compose(before, imu, 1.0), compose(after, imu, 1.0)
    both = fit(
        np.concatenate([before.tracker, after.tracker]),
        np.concatenate([before.gyroscope, after.gyroscope]),
    )
    single = max(
        rotation_agreement(t, q.__getitem__, imu, lag)[1]
        for lag in (division.before_s, division.after_s)
    )
    if both.explained < AGREE or 1.0 - single + _NOISE < _GAIN * (1.0 - both.explained + _NOISE):
        return None
    step_s = after.lag_s - before.lag_s
    if abs(step_s) < _SMALLEST_S:
        return None
    # The sample from which on the later lag fits better.
    integral = GyroscopeIntegral((imu.time_ns - imu.time_ns[0]) / NANOSECONDS, imu.gyroscope)
    rows = np.flatnonzero((t[:-1] > division.begin_s) & (t[:-1] < division.end_s))
    turned = rotation_vectors(q[rows], q[rows + 1])
    misfit = []
    for lag in (before.lag_s, after.lag_s):
        predicted = integral.rotation(t[rows] - lag, t[rows + 1] - lag).as_rotvec()
        misfit.append(np.sum((turned - predicted @ both.frame.T) ** 2, axis=1))
    limit = 9.0 * np.median(np.minimum(*misfit))
    gain = np.minimum(misfit[0], limit) - np.minimum(misfit[1], limit)
    split = int(rows[np.argmin(np.cumsum(gain))] + 1)
    return split, step_s, (single, both.explained)


def _attributed(
    optical: Optical, imu: Imu, since_s: float, step_s: float, explained: tuple[float, float]
) -> ClockStep:
    """The step with the stream whose time stamps show a gap of its size, at that gap if there is one."""
    tracker = (optical.time_ns - optical.latency_ns - imu.time_ns[0]) / NANOSECONDS
    own = (imu.time_ns - imu.time_ns[0]) / NANOSECONDS
    stream = ""
    for name, stamps, size in (("tracker", tracker, step_s), ("IMU", own, -step_s)):
        steps = np.diff(stamps)
        off = np.abs(steps - np.median(steps) - size)
        near = np.abs(stamps[:-1] - since_s) < abs(step_s) + _NEAR_S
        shown = near & (off < _SIZE_OFF * size)
        if shown.any():
            stream, since_s = name, float(stamps[:-1][shown][np.argmin(off[shown])])
            break
    time_s = since_s + float(imu.time_ns[0]) / NANOSECONDS
    return ClockStep(time_s, since_s, step_s, stream, explained)
