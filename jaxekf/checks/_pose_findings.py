"""Words on poses, and on truth, that are flipped against the gyroscope."""

from dataclasses import replace

import numpy as np

from jaxekf.checks._findings import Findings
from jaxekf.checks.pose_flips import Flips, find_flips
from jaxekf.checks.sensor_agreement import Evidence
from jaxekf.recordings.types import Optical, Recording

_OFTEN = 0.01
"""Share of single outliers from which on they are a warning."""


def pose_findings(recording: Recording, found: Evidence) -> Findings:
    """Warnings on poses that the gyroscope contradicts, and steps of the tracker's frame."""
    flips = tracker_flips(recording, found)
    if flips is None:
        return Findings()
    warnings, notes = [], []
    for first_s, angle in flips.steps:
        warnings.append(
            f"the tracker's attitude steps by {np.rad2deg(angle):.1f} deg at {first_s:.3f} s and does not"
            " return: the tracker, its reference, or the IMU on the tool was moved, or markers are swapped"
            " from there on; cut the run there (jaxekf crop)"
        )
    if flips.stretches:
        text = _contradicted(flips, len(flips.wrong))
        often = flips.fixed or flips.wrong.mean() > _OFTEN
        (warnings if often else notes).append(text)
    return Findings(tuple(warnings), tuple(notes))


def tracker_flips(recording: Recording, found: Evidence) -> Flips | None:
    """Flips among the tracker's valid poses, at the lag found."""
    tracker, imu = recording.optical, recording.imu
    if tracker is None or imu is None:
        return None
    rows = np.flatnonzero(tracker.valid)
    lag_s = found.lag_s if np.isfinite(found.lag_s) else 0.0
    taken = tracker.time_ns[rows] - tracker.latency_ns
    return find_flips(taken, tracker.q_ref_body[rows], imu, lag_s)


def without_flips(recording: Recording, found: Evidence) -> Optical | None:
    """The tracker's stream without its flipped poses; None without a tracker."""
    tracker, flips = recording.optical, tracker_flips(recording, found)
    if tracker is None or flips is None or not flips.wrong.any():
        return tracker
    valid = tracker.valid.copy()
    valid[np.flatnonzero(valid)[flips.wrong]] = False
    return replace(tracker, valid=valid)


def _contradicted(flips: Flips, count: int) -> str:
    bad, several = int(flips.wrong.sum()), flips.stretches > 1
    text = (
        f"the gyroscope contradicts {bad} of {count} poses ({100.0 * bad / count:.2g} %), in"
        f" {flips.stretches} stretch{'es' if several else ''}"
        f"{', the first' if several else ''} at {flips.first_s:.3f} s:"
    )
    if flips.fixed:
        return (
            f"{text} they are rotated by the same {np.rad2deg(flips.angle):.0f} deg and return; look for"
            " swapped markers of the tool, or a second solution of its pose"
        )
    angle = f"{np.rad2deg(flips.angle):.0f} deg in the median"
    return f"{text} each is rotated by another angle, {angle}: outliers"
