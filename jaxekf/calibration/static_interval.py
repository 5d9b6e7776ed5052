"""Static interval at the start of a run, and the tracker's noise during it.

`static_head` returns the length of the interval, `tracker_noise` the standard deviations of the tracker.
"""

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from jaxekf._support import chi_square
from jaxekf._support.errors import RecordingError
from jaxekf.recordings.types import (
    NANOSECONDS,
    Flags,
    Floats,
    Imu,
    Markers,
    Optical,
    Recording,
    Times,
    period_ns,
    to_scipy,
)

_WINDOW_S = 0.5
_REMEMBERED = 120
"""Windows whose mean is the reference for the next one."""
_LOUDER = 2.0
_FLOOR = 1e-3
"""rad/s: slower motion cannot be distinguished from noise."""
_FASTEST_BIAS = np.deg2rad(10.0)
_QUIETEST = 0.05
"""Quantile over windows of their standard deviation, taken as the sensor's own noise."""
_LEAST_HEAD_S = 3.0
_LATE_S = 0.5
"""Largest error of the tracker's clock, s; this much is left out at the ends of the interval."""
_LONGEST_GAP = 1.5
_LEAST_SAMPLES = 20
_OUTLYING = 6.0
_MEDIAN = 0.6745
_WANDERS = 1.5
_TURNS_SIGMAS, _LEAST_TURN = 6.0, np.deg2rad(0.1)


class Scatter(NamedTuple):
    """Standard deviation of a tracker's static samples, three axes, with 95 % intervals."""

    value: Floats
    """(3,) rad in the body frame, or metres in the reference frame."""
    low: Floats
    high: Floats
    samples: int
    wander: float
    """Standard deviation about the mean over that from differences of neighbours: 1 for independent
    samples."""

    @property
    def wanders(self) -> bool:
        """Whether samples are clearly correlated, so that `value` is too small."""
        return self.wander > _WANDERS


class TrackerNoise(NamedTuple):
    """Noise of a static tracker; None for a quantity that it does not measure."""

    optical: Scatter | None
    position: Scatter | None
    marker: Scatter | None


def static_head(recording: Recording) -> float:
    """Seconds from the IMU's first sample during which the run is static.

    The gyroscope stays within its own scatter of a constant, half a second at a time.

    Raises
    ------
    RecordingError
        If the interval is shorter than 3 s, or if the tracker rotates steadily during it.

    Examples
    --------
    >>> import jaxekf
    >>> from jaxekf.calibration import static_interval
    >>> round(static_interval.static_head(jaxekf.load(jaxekf.demo.FOLDER / "constant-rate")))  # s
    6
    """
    place = str(recording.path or recording.name)
    imu = recording.need_imu()
    found = quiet_s(imu)
    if found < _LEAST_HEAD_S:
        begin, end = longest_rest(imu)
        hint = "a run that begins at rest, or --from and --to of a static interval"
        if end > begin:
            hint = f"--from {begin:g} --to {end:g}, the longest rest of the run"
        raise RecordingError(
            place,
            f"{found:.1f} s of rest at the start",
            f"{_LEAST_HEAD_S:.0f} s or more in which the gyroscope stays quiet",
            hint,
        )
    if recording.optical is not None:
        _require_no_rotation(recording.optical, imu, found, place)
    return found


def quiet_s(imu: Imu) -> float:
    """Seconds from the first sample during which the gyroscope is static; 0 if it moves from the start."""
    length = float(imu.time_ns[-1] - imu.time_ns[0]) / NANOSECONDS
    mean, own, quiet = _calm_windows(imu)
    if len(mean) < 2:
        return 0.0
    # The reference of a window is the mean of those before it, so that motion does not change its own
    # reference, and of a limited number, so that a bias may drift over hours.
    total, row = np.cumsum(mean, axis=0), np.arange(len(mean))
    far = np.where((row >= _REMEMBERED)[:, None], total[np.maximum(row - _REMEMBERED, 0)], 0.0)
    before = (total - far) / np.minimum(row + 1, _REMEMBERED)[:, None]
    quiet[1:] &= (np.abs(mean[1:] - before[:-1]) <= own).all(axis=1)
    moving = np.flatnonzero(~quiet)
    if moving.size == 0:
        return length
    # Slow motion may have begun in the window before.
    return max(0.0, float(moving[0] - 1) * _WINDOW_S)


def _calm_windows(imu: Imu) -> tuple[Floats, Floats, Flags]:
    """For windows of half a second: mean rates (W, 3), the sensor's own scatter (3,), and which windows
    (W,) have no more scatter than that, and no fast turn."""
    t = (imu.time_ns - imu.time_ns[0]) / NANOSECONDS
    label = np.floor(t / _WINDOW_S).astype(int)
    count = np.bincount(label).astype(float)
    count[-1] = max(count[-1], 1.0)
    held = np.maximum(count, 1.0)[:, None]
    mean = np.stack([np.bincount(label, column) for column in imu.gyroscope.T], axis=1) / held
    off = imu.gyroscope - mean[label]
    scatter = np.sqrt(np.stack([np.bincount(label, c * c) for c in off.T], axis=1) / held)
    own = np.quantile(scatter[: max(len(scatter) - 1, 1)], _QUIETEST, axis=0) + _FLOOR
    calm = (scatter <= _LOUDER * own).all(axis=1) & (count > 0.0)
    return mean, own, calm & (np.abs(mean) <= _FASTEST_BIAS).all(axis=1)


def longest_rest(imu: Imu) -> tuple[float, float]:
    """Start and end of the longest interval in which the gyroscope is static, s after the first sample;
    equal if it never is for 3 s."""
    change = np.diff(_calm_windows(imu)[2].astype(int), prepend=0, append=0)
    begins, ends = np.flatnonzero(change == 1), np.flatnonzero(change == -1)
    best = (0.0, 0.0)
    for at in np.argsort(begins - ends):
        # Motion may reach into the first and last window.
        begin = _WINDOW_S * float(begins[at] + (begins[at] > 0))
        end = _WINDOW_S * float(ends[at] - 1)
        least = max(best[1] - best[0], _LEAST_HEAD_S)
        if end - begin <= least:
            break
        quiet = quiet_s(cut_imu(imu, begin, end))
        if quiet > least:
            best = (begin, begin + quiet)
    return best


def cut_imu(imu: Imu, begin_s: float, end_s: float) -> Imu:
    """The samples from `begin_s` to `end_s`, seconds after the first."""
    t = (imu.time_ns - imu.time_ns[0]) / NANOSECONDS
    chosen = (t >= begin_s) & (t <= end_s)
    columns = {name: getattr(imu, name) for name in ("time_ns", *imu.per_sample)}
    return replace(imu, **{k: None if v is None else v[chosen] for k, v in columns.items()})


def tracker_noise(
    recording: Recording, begin_s: float, end_s: float, last_s: float
) -> TrackerNoise:
    """Noise of the tracker while the run is static.

    The estimate uses differences of neighbours, so that slow drift does not count. Half a second is
    left out at ends that are not those of the run.

    Parameters
    ----------
    recording
        The run.
    begin_s, end_s
        Static interval, s from the IMU's first sample.
    last_s
        Length of the run, s.
    """
    start = recording.need_imu().time_ns[0]
    begin = begin_s + _LATE_S if begin_s > 0.0 else -np.inf
    end = end_s - _LATE_S if end_s < last_s else np.inf
    optical = position = marker = None
    if recording.optical is not None:
        stream = recording.optical
        t = (stream.time_ns - stream.latency_ns - start) / NANOSECONDS
        valid = stream.valid & (t >= begin) & (t <= end)
        optical = _attitude_scatter(stream, valid)
        if stream.position is not None:
            position = _scatter([stream.position], stream.time_ns, [valid])
    if recording.markers is not None:
        marker = _marker_scatter(recording.markers, start, begin, end)
    return TrackerNoise(optical, position, marker)


def _attitude_scatter(stream: Optical, valid: Flags) -> Scatter | None:
    """Scatter of the rotation vectors from the mean attitude, body frame."""
    if valid.sum() < _LEAST_SAMPLES:
        return None
    attitude = to_scipy(stream.q_ref_body)
    middle = to_scipy(stream.q_ref_body[valid]).mean()
    return _scatter([(middle.inv() * attitude).as_rotvec()], stream.time_ns, [valid])


def _marker_scatter(markers: Markers, start: int, begin: float, end: float) -> Scatter | None:
    t = (markers.time_ns - markers.latency_ns - start) / NANOSECONDS
    inside = (t >= begin) & (t <= end)
    count = len(markers.names)
    places = [markers.position[:, i] for i in range(count)]
    return _scatter(places, markers.time_ns, [markers.usable[:, i] & inside for i in range(count)])


def _scatter(values: list[Floats], time_ns: Times, valid: list[Flags]) -> Scatter | None:
    """Scatter of series (N, 3) that share one deviation: half the mean square of differences of neighbours.

    The estimate from ``n`` differences has ``2 n^2 / (3 n - 1)`` degrees of freedom (von Neumann). Outliers
    among the differences are left out.
    """
    steps, about = [], []
    for value, mask in zip(values, valid, strict=True):
        rows = np.flatnonzero(mask)
        near = np.diff(time_ns[rows]) <= _LONGEST_GAP * period_ns(time_ns)
        steps.append(np.diff(value[rows], axis=0)[near])
        if rows.size:
            about.append(value[rows] - np.median(value[rows], axis=0))
    step = np.concatenate(steps)
    if len(step) < _LEAST_SAMPLES:
        return None
    size = np.median(np.abs(step), axis=0) / _MEDIAN
    step = step[(np.abs(step) <= _OUTLYING * np.maximum(size, 1e-12)).all(axis=1)]
    if len(step) < _LEAST_SAMPLES:
        return None
    found = np.sqrt(0.5 * np.mean(np.square(step), axis=0))
    freedom = 2.0 * len(step) ** 2 / (3.0 * len(step) - 1.0)
    whole = np.median(np.abs(np.concatenate(about)), axis=0) / _MEDIAN
    return Scatter(
        found,
        *chi_square.deviation_interval(found, freedom),
        len(step),
        float(np.max(whole / np.maximum(found, 1e-15))),
    )


def _require_no_rotation(optical: Optical, imu: Imu, end_s: float, place: str) -> None:
    """Raise `RecordingError` if the tracker rotates steadily, which looks like a bias to the gyroscope."""
    t = (optical.time_ns - optical.latency_ns - imu.time_ns[0]) / NANOSECONDS
    thirds = [
        optical.valid & (t >= share * end_s) & (t <= (share + 1.0 / 3.0) * end_s - _LATE_S / 2.0)
        for share in (0.0, 0.6)
    ]
    if min(third.sum() for third in thirds) < _LEAST_SAMPLES:
        return
    first, last = (to_scipy(optical.q_ref_body[third]) for third in thirds)
    rotated = float((first.mean().inv() * last.mean()).magnitude())
    own = float(np.sqrt(np.mean((first.mean().inv() * first).magnitude() ** 2)))
    bound = max(_TURNS_SIGMAS * own / np.sqrt(_LEAST_SAMPLES), _LEAST_TURN)
    if rotated > bound:
        raise RecordingError(
            place,
            f"a tracker that rotates by {np.rad2deg(rotated):.2f} deg in the first {end_s:.1f} s",
            "a static run at its start",
            "--from and --to of a static interval",
        )
