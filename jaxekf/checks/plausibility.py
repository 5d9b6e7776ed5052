"""Plausibility of a recording's description: units, quaternion order, gravity, overlap in time.

`require` raises if the streams clearly contradict the description. A quantity that the streams do not
determine is NaN and passes.
"""

from typing import Any

import numpy as np

from jaxekf._support.constants import STANDARD_GRAVITY
from jaxekf._support.errors import RecordingError
from jaxekf.checks.sensor_agreement import (
    ALIKE,
    DEGREES,
    EXPLAINED,
    Evidence,
    evidence,
    overlap_s,
    tracker_label,
)
from jaxekf.recordings.facts import BODY_TO_REFERENCE, FILE
from jaxekf.recordings.types import Recording

__all__ = ["Evidence", "check", "evidence", "require"]

THOUSAND = 1000.0
_CLOSE = 0.15
"""Relative error of a rate ratio that is still taken for a unit factor."""
_NEAR = 0.35
"""The same for lengths, whose ratio a lever arm changes."""
_POOR, _BETTER = 0.95, 4.0
"""Explained share below which a reading of the quaternion is wrong, and the factor by which the right
reading reduces the unexplained rest. Noise leaves the same rest in every reading, so the factor is
significant."""
_TWO_AXES = 0.05
LEAST_RATE = np.deg2rad(2.0)
"""rad/s: at slower rotation noise dominates the correlation."""
_LEAST_ACCELERATION = 0.1
_NEARBY, FARTHEST_M = 0.02, 20.0
"""Metres: a tracker's tool is never always as near as the first, nor as far as the second."""
_G_WITHIN, _REMOVED_BELOW = 0.15, 0.5
_STEADY = 0.15
_SIZE_OFF, _TURNED = 0.5, np.deg2rad(30.0)


def require(recording: Recording) -> None:
    """Raise `RecordingError` if the streams clearly contradict the description.

    Faults are streams that do not overlap, a wrong unit of gyroscope, accelerometer or lengths, removed
    gravity, and a quaternion of another component order or direction.
    """
    check(recording, evidence(recording))


def check(recording: Recording, found: Evidence) -> None:
    """The same as `require`, for evidence that is already measured."""
    for label in (tracker_label(recording), "camera"):
        if overlap_s(found.ranges_s, label) < 0.0:
            raise _no_overlap(recording, found, label)
    _check_truth(recording)
    force = _force_unit(recording, found)
    rate = rates_unit(found)
    if rate is not None:
        raise rate_fault(
            recording, found, "tracker", f'"{rate}, {"m/s^2" if force is None else force[0]}"'
        )
    if force is not None:
        raise force[1]
    _check_length(recording, found)
    _check_order(recording, found)
    check_gravity(recording, found)


def rates_unit(found: Evidence) -> str | None:
    """The unit to state for the gyroscope; None if the stated one is plausible."""
    if not (found.rate > LEAST_RATE and found.rate_correlation > ALIKE):
        return None
    return _unit(found.rate_ratio, DEGREES, _CLOSE, ("deg/s", "rad/s"))


def rate_fault(recording: Recording, found: Evidence, reference: str, unit: str) -> RecordingError:
    """The error about the gyroscope's unit: the rate of `reference` is another one."""
    got = f"a gyroscope that rotates {found.rate_ratio:.4g} times as fast as the {reference}"
    correlation = f" (correlation {found.rate_correlation:.2f})"
    return fault(recording, "imu.unit", got + correlation, "the same rate", f"[imu] unit = {unit}")


def length_fault(recording: Recording, found: Evidence, stream: str, unit: str) -> RecordingError:
    """The error about the unit of positions of the stream ``optical`` or ``camera``."""
    name = "tracker" if stream == "optical" else stream
    got = f"a {name} that moves {found.length_ratio:.4g} times as far as the accelerometer"
    correlation = f" (correlation {found.length_correlation:.2f})"
    hint = f"[{stream}] unit = {unit}"
    return fault(recording, f"{stream}.unit", got + correlation, "the same distance", hint)


def path_unit(found: Evidence) -> str | None:
    """The unit to state for positions; None if the stated one is plausible."""
    if not found.length_correlation > ALIKE:
        return None
    unit = _unit(found.length_ratio, THOUSAND, _NEAR, ("mm", "m"))
    if unit is None:
        return None
    if found.acceleration < _LEAST_ACCELERATION * (THOUSAND if unit == "mm" else 1.0 / THOUSAND):
        return None
    if found.farthest > _NEARBY if unit == "m" else found.farthest < FARTHEST_M:
        return None
    return unit


def _unit(ratio: float, factor: float, within: float, names: tuple[str, str]) -> str | None:
    """The unit to state for numbers that are a factor too large or too small; None if neither."""
    for size, name in ((ratio / factor, names[0]), (ratio * factor, names[1])):
        if 1.0 / (1.0 + within) <= size <= 1.0 + within:
            return name
    return None


def _force_unit(recording: Recording, found: Evidence) -> tuple[str, RecordingError] | None:
    """The unit to state for the accelerometer, and the error; None if the stated one is plausible."""
    gravity = float(np.linalg.norm(recording.info.get("gravity_ref", [STANDARD_GRAVITY])))
    norm = found.static_norm
    if not np.isfinite(norm) or not 0.5 < gravity / STANDARD_GRAVITY < 2.0:
        return None
    got = f"an accelerometer that reads {norm:.3g} m/s^2 when quietest"
    expected = f"about {gravity:.3g} m/s^2"
    if norm >= _REMOVED_BELOW and found.static_scatter > _STEADY:
        # Never at rest: the mean in the tracker's frame is free of motion.
        far = norm < 0.2 * gravity or norm > 3.0 * gravity
        norm = found.mean_force if far else np.nan
        got = f"an accelerometer whose readings average {norm:.2g} m/s^2 in the tracker's frame"
    if norm < _REMOVED_BELOW:
        hint = "recording with gravity in it, or leaving out the columns ax, ay, az"
        error = fault(recording, "imu.unit", got, f"{expected}; gravity is removed", hint)
        return "m/s^2", error
    for unit, size in (
        ("g", 1.0),
        ("m/s^2", STANDARD_GRAVITY**2),
        ("mm/s^2", 1e3 * STANDARD_GRAVITY),
    ):
        if abs(norm / size - 1.0) < _G_WITHIN:
            hint = f'[imu] unit = "rad/s, {unit}"'
            return unit, fault(recording, "imu.unit", got, expected, hint)
    return None


def check_gravity(recording: Recording, found: Evidence) -> None:
    """Raise `RecordingError` if the accelerometer contradicts size or direction of `gravity_ref`."""
    stated = recording.info.get("gravity_ref")
    if stated is None:
        return
    size, norm = float(np.linalg.norm(stated)), found.static_norm
    plain = found.static_scatter < _STEADY and 0.5 < norm / STANDARD_GRAVITY < 2.0
    if plain and abs(norm / max(size, 1e-12) - 1.0) > _SIZE_OFF:
        got, expected = f"gravity of {size:.3g} m/s^2", f"about {norm:.3g}, as measured at rest"
    elif (
        found.second_axis > _TWO_AXES and abs(found.mean_force / max(size, 1e-12) - 1.0) < _SIZE_OFF
    ):
        # Rotation about one axis only leaves the IMU's orientation about it undetermined.
        fall = -np.asarray(found.mean_force_ref)
        angle = np.arccos(np.clip(fall @ np.asarray(stated) / (found.mean_force * size), -1.0, 1.0))
        if angle < _TURNED:
            return
        near = f"[{', '.join(f'{value:.1f}' for value in fall)}]"
        got = f"a gravity vector {np.rad2deg(angle):.0f} deg off the accelerometer's"
        expected = f"about {near} m/s^2 in the reference frame (gravity points down)"
    else:
        return
    also = ", or the direction of the quaternions" if recording.optical is not None else ""
    raise fault(recording, "gravity_ref", got, expected, f"correcting gravity_ref{also}")


def _check_length(recording: Recording, found: Evidence) -> None:
    """Raise `RecordingError` if millimetres are taken for metres or the reverse."""
    if recording.optical is None:
        unit = _unit(found.length_ratio, THOUSAND, _NEAR, ("mm", "m"))
        if unit is None:
            return
        stated = recording.info.get("markers_about", {}).get("unit", "m")
        hint = "[markers.geometry] in metres" if stated == unit else f'[markers] unit = "{unit}"'
        got = f"markers {found.length_ratio:.4g} times as far apart as in the geometry"
        raise fault(recording, "markers.unit", got, "the same distances", hint)
    unit = path_unit(found)
    if unit is not None:
        raise length_fault(recording, found, "optical", f'"1, {unit}"')


def _check_order(recording: Recording, found: Evidence) -> None:
    """Raise `RecordingError` if the quaternion's component order or direction is not as stated."""
    left = 1.0 - found.explained
    fits = {
        name: fit
        for name, fit in found.readings.items()
        if fit.explained > EXPLAINED and left > _BETTER * (1.0 - fit.explained)
    }
    enough = found.second_axis > _TWO_AXES and found.rate > LEAST_RATE
    if not fits or not enough or not found.explained < _POOR:
        return
    # Rotations alone cannot distinguish some readings, which differ by a rotation of the frames: the one
    # with the smaller rotation between IMU and tool is the more likely mounting.
    names = sorted(fits, key=lambda name: fits[name].angle)
    entries = " or ".join(f'quaternion = "{name}"' for name in names)
    also = ""
    if len(names) > 1:
        angles = " and ".join(f"{np.rad2deg(fits[name].angle):.0f}" for name in names)
        also = f", which rotate the IMU's axes by {angles} deg relative to the tool's"
    about = recording.info.get("optical_about", {}).get("quaternion", BODY_TO_REFERENCE)
    raise fault(
        recording,
        "optical.quaternion",
        f"quaternions of which, as '{about}', the gyroscope explains"
        f" {100.0 * found.explained:.0f} % of the rotation",
        f"more; in another reading it explains {100.0 * fits[names[0]].explained:.0f} %",
        f"[optical] {entries}{also}; where a header names the columns, naming them as they are",
    )


def _no_overlap(recording: Recording, found: Evidence, label: str) -> RecordingError:
    words = [
        f"{name} from {_seconds(found.ranges_s[name][0])} to {_seconds(found.ranges_s[name][1])} s"
        for name in (label, "imu")
    ]
    expected = "streams that overlap in time"
    hint = "putting both on one clock, or the IMU's log of the same run"
    return RecordingError(recording.path or recording.name, " and ".join(words), expected, hint)


def _check_truth(recording: Recording) -> None:
    """Raise `RecordingError` if the ground truth does not overlap the other streams."""
    truth = recording.encoder
    streams = (recording.optical, recording.markers, recording.camera, recording.imu)
    others = [stream for stream in streams if stream is not None]
    if truth is None or not others:
        return
    first = min(int(stream.time_ns[0]) for stream in others)
    last = max(int(stream.time_ns[-1]) for stream in others)
    if truth.time_ns[0] <= last and truth.time_ns[-1] >= first:
        return
    ends = (truth.time_ns[0], truth.time_ns[-1], first, last)
    a, b, c, d = (_seconds(1e-9 * t) for t in ends)
    got = f"encoder from {a} to {b} s and the other streams from {c} to {d} s"
    expected = "streams that overlap in time"
    hint = "putting them on one clock, or stating the unit of its times (time_unit)"
    raise RecordingError(recording.path or recording.name, got, expected, hint)


def _seconds(value: float) -> str:
    return f"{value:.3f}"


def fault(recording: Recording, entry: str, got: str, expected: str, hint: str) -> RecordingError:
    """An error about an entry of `recording.toml`, or about a run without one."""
    place: Any = recording.path or recording.name
    column = None
    if recording.path is not None and (recording.path / FILE).is_file():
        place, column = recording.path / FILE, entry
    return RecordingError(
        place, got, expected, f"stating {hint}" if hint.startswith("[") else hint, column=column
    )
