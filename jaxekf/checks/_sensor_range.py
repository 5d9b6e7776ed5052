"""Samples of an IMU at the limit of its range: clipped values, which are too small."""

from collections.abc import Sequence

import numpy as np

from jaxekf._support.constants import STANDARD_GRAVITY
from jaxekf.calibration.motion_agreement import Integral, rotation_vectors
from jaxekf.checks._findings import Findings, from_to, listed
from jaxekf.checks.sensor_agreement import Evidence
from jaxekf.recordings.clipping import Limit, limits, sides
from jaxekf.recordings.types import NANOSECONDS, Floats, Recording

_UNITS = {
    "gyroscope": (180.0 / np.pi, "deg/s"),
    "accelerometer": (1.0 / STANDARD_GRAVITY, "g"),
    "magnetometer": (1.0, "(the file's unit)"),
}
_HINTS = {
    "gyroscope": "the true rate is larger, and an estimate adds the noise of an unknown rotation"
    " there; a sensor of a larger range, or slower motion, avoids it",
    "accelerometer": "the true specific force is larger, and estimates of velocity and position are"
    " wrong after it; a sensor of a larger range avoids it",
    "magnetometer": "the true field is larger: a magnet or iron is too near",
}
_SIGNIFICANT, _FASTER, _EQUAL = 5.0, 0.01, 0.01


def range_findings(recording: Recording, found: Evidence) -> Findings:
    """Warnings on sensors of the IMU that clip.

    Numbers alone show a limit where their noise excludes a constant value. Where it does not, the tracker
    decides: it turns faster than the gyroscope reads, or as fast.
    """
    imu, warnings = recording.imu, []
    if imu is None:
        return Findings()
    for name, (factor, unit) in _UNITS.items():
        values = getattr(imu, name)
        if values is None:
            continue
        for size, group in sides(limits(values)).items():
            if name == "gyroscope":
                faster = _tracker_is_faster(recording, found, group, size)
                group = group if faster is True else [o for o in group if o.noisy]
                group = [] if faster is False else group
            else:
                group = [one for one in group if one.noisy]
            if not group:
                continue
            rows = np.unique(np.concatenate([one.at for one in group]))
            warnings.append(
                f"the {name} is at the limit of its range, {_signs(group)}{factor * size:.4g} {unit},"
                f" in {len(rows)} of {len(values)} samples, on {_axes(group)},"
                f" {from_to(imu.time_ns, rows)}: {_HINTS[name]}"
            )
    return Findings(tuple(warnings))


def _signs(group: Sequence[Limit]) -> str:
    both = {one.value > 0.0 for one in group}
    return "±" if len(both) == 2 else "" if both == {True} else "-"


def _axes(group: Sequence[Limit]) -> str:
    return listed(dict.fromkeys("xyz"[one.axis] for one in group))


def _tracker_is_faster(
    recording: Recording, found: Evidence, group: Sequence[Limit], size: float
) -> bool | None:
    """Whether the tracker turns faster than the gyroscope while this is at its limit; None where the two
    cannot be compared there."""
    tracker, imu = recording.optical, recording.imu
    if tracker is None or imu is None or not np.isfinite(found.lag_s):
        return None
    rows = np.flatnonzero(tracker.valid)
    late = tracker.latency_ns + round(found.lag_s * NANOSECONDS)
    t: Floats = (tracker.time_ns[rows] - late - imu.time_ns[0]) / NANOSECONDS
    at_limit = np.zeros(len(imu.time_ns), bool)
    for one in group:
        at_limit[one.at] = True
    sums = np.r_[0, np.cumsum(at_limit)]
    stamps = (imu.time_ns - imu.time_ns[0]) / NANOSECONDS
    begin, end = np.searchsorted(stamps, t[:-1]), np.searchsorted(stamps, t[1:])
    near = (np.diff(t) < 0.1) & (end > begin)
    clipped = near & (sums[end] - sums[begin] == end - begin)
    free = near & (sums[end] == sums[begin])
    if clipped.sum() < 3 or free.sum() < 40:
        return None
    q = tracker.q_ref_body[rows]
    seen = np.linalg.norm(rotation_vectors(q[:-1], q[1:]), axis=1)
    read = np.linalg.norm(Integral(imu.time_ns, imu.gyroscope).between(t[:-1], t[1:]), axis=1)
    apart = seen - read
    sigma = 1.48 * float(np.median(np.abs(apart[free] - np.median(apart[free]))))
    # Noise lengthens a short turn; the turns at a limit are long.
    excess, turn = float(apart[clipped].mean()), float(read[clipped].mean())
    error = sigma / np.sqrt(clipped.sum())
    if excess > max(_SIGNIFICANT * error, _FASTER * turn):
        return True
    return False if abs(excess) + 2.0 * error < _EQUAL * turn else None
