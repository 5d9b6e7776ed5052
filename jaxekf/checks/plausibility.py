"""Whether a recording's numbers are what its description says: units, order of the quaternion, overlap.

Only what the streams contradict plainly is an error; what they do not tell is NaN and passes.
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
"""Share by which a ratio may miss that of a unit."""
_NEAR = 0.35
"""The same of lengths, whose ratio a lever arm changes."""
_POOR, _BETTER = 0.95, 4.0
"""Share of turning that a wrong reading does not explain, and by how much less a right one leaves: noise
leaves the same in every reading, so that a factor is no chance."""
_TWO_AXES = 0.05
LEAST_RATE = np.deg2rad(2.0)
"""rad/s: of slower turning noise decides how alike it is."""
_LEAST_ACCELERATION = 0.1
_NEARBY, FARTHEST_M = 0.02, 20.0
"""Metres: no tracker has its tool always as near as the first, or as far as the second."""
_G_WITHIN, _REMOVED_BELOW = 0.15, 0.5
_STEADY = 0.15
_SIZE_OFF, _TURNED = 0.5, np.deg2rad(30.0)


def require(recording: Recording) -> None:
    """Raise `RecordingError` where the streams plainly contradict what is said of them.

    Faults are streams that do not overlap, gyroscope, accelerometer or lengths in another unit than
    stated, gravity removed, and a quaternion in another order or of the other direction.
    """
    check(recording, evidence(recording))


def check(recording: Recording, found: Evidence) -> None:
    """As `require`, with the evidence at hand."""
    for label in (tracker_label(recording), "camera"):
        if overlap_s(found.ranges_s, label) < 0.0:
            raise _no_overlap(recording, found, label)
    _check_truth(recording)
    force = _force_unit(recording, found)
    rate = rates_unit(found)
    if rate is not None:
        raise fault(
            recording,
            "imu.unit",
            f"a gyroscope that turns {found.rate_ratio:.4g} times as fast as the tracker (correlation"
            f" {found.rate_correlation:.2f})",
            "the same rate",
            f'[imu] unit = "{rate}, {"m/s^2" if force is None else force[0]}"',
        )
    if force is not None:
        raise force[1]
    _check_length(recording, found)
    _check_order(recording, found)
    check_gravity(recording, found)


def rates_unit(found: Evidence) -> str | None:
    """The gyroscope's unit to state instead; None where turning does not tell that another is meant."""
    if not (found.rate > LEAST_RATE and found.rate_correlation > ALIKE):
        return None
    return _unit(found.rate_ratio, DEGREES, _CLOSE, ("deg/s", "rad/s"))


def path_unit(found: Evidence) -> str | None:
    """The unit of positions to state instead; None where the accelerometer does not tell that another is
    meant."""
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
    """The unit to state instead, of numbers a factor too large or too small; None where neither."""
    for size, name in ((ratio / factor, names[0]), (ratio * factor, names[1])):
        if 1.0 / (1.0 + within) <= size <= 1.0 + within:
            return name
    return None


def _force_unit(recording: Recording, found: Evidence) -> tuple[str, RecordingError] | None:
    """The accelerometer's unit to state instead, and the fault."""
    gravity = float(np.linalg.norm(recording.info.get("gravity_ref", [STANDARD_GRAVITY])))
    norm = found.static_norm
    if not np.isfinite(norm) or not 0.5 < gravity / STANDARD_GRAVITY < 2.0:
        return None
    got = f"an accelerometer that reads {norm:.3g} m/s^2 when quietest"
    expected = f"about {gravity:.3g} m/s^2"
    if norm >= _REMOVED_BELOW and found.static_scatter > _STEADY:
        # Never at rest: what is left besides motion is told by the tracker's attitudes.
        far = norm < 0.2 * gravity or norm > 3.0 * gravity
        norm = found.mean_force if far else np.nan
        got = f"an accelerometer whose readings average {norm:.2g} m/s^2 in the tracker's frame"
    if norm < _REMOVED_BELOW:
        hint = "recording with gravity in it, or leaving out the columns ax, ay, az"
        error = fault(recording, "imu.unit", got, f"{expected}: gravity is removed", hint)
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
    """Raise `RecordingError` where the accelerometer contradicts the `gravity_ref` that a run states: it is
    of another size, the other way round, or along another axis."""
    stated = recording.info.get("gravity_ref")
    if stated is None:
        return
    size, norm = float(np.linalg.norm(stated)), found.static_norm
    plain = found.static_scatter < _STEADY and 0.5 < norm / STANDARD_GRAVITY < 2.0
    if plain and abs(norm / max(size, 1e-12) - 1.0) > _SIZE_OFF:
        got, expected = f"free fall of {size:.3g} m/s^2", f"about {norm:.3g}, as at rest"
    elif (
        found.second_axis > _TWO_AXES and abs(found.mean_force / max(size, 1e-12) - 1.0) < _SIZE_OFF
    ):
        # Turns about one axis leave open how the IMU's frame lies about it.
        fall = -np.asarray(found.mean_force_ref)
        angle = np.arccos(np.clip(fall @ np.asarray(stated) / (found.mean_force * size), -1.0, 1.0))
        if angle < _TURNED:
            return
        near = f"[{', '.join(f'{value:.1f}' for value in fall)}]"
        got = f"free fall that is {np.rad2deg(angle):.0f} deg off what the accelerometer says"
        expected = f"about {near} m/s^2 in the reference frame (what falls accelerates downwards)"
    else:
        return
    also = ", or the direction of the quaternions" if recording.optical is not None else ""
    raise fault(recording, "gravity_ref", got, expected, f"correcting gravity_ref{also}")


def _check_length(recording: Recording, found: Evidence) -> None:
    """Millimetres taken for metres, or the other way round."""
    if recording.optical is None:
        unit = _unit(found.length_ratio, THOUSAND, _NEAR, ("mm", "m"))
        if unit is None:
            return
        stated = recording.info.get("markers_about", {}).get("unit", "m")
        hint = f'[markers] unit = "{unit}"'
        if stated == unit:
            hint = "[markers.geometry] in metres"
        raise fault(
            recording,
            "markers.unit",
            f"markers {found.length_ratio:.4g} times as far apart as in the geometry",
            "the same distances",
            hint,
        )
    unit = path_unit(found)
    if unit is None:
        return
    raise fault(
        recording,
        "optical.unit",
        f"a tracker that moves {found.length_ratio:.4g} times as far as the accelerometer (correlation"
        f" {found.length_correlation:.2f})",
        "the same way",
        f'[optical] unit = "1, {unit}"',
    )


def _check_order(recording: Recording, found: Evidence) -> None:
    """A quaternion whose order, or whose direction, is not as stated."""
    left = 1.0 - found.explained
    fits = {
        name: fit
        for name, fit in found.readings.items()
        if fit.explained > EXPLAINED and left > _BETTER * (1.0 - fit.explained)
    }
    enough = found.second_axis > _TWO_AXES and found.rate > LEAST_RATE
    if not fits or not enough or not found.explained < _POOR:
        return
    # By turns alone the one is the other with the frames aligned otherwise: the smaller turn between the
    # IMU's axes and the tool's is what was built.
    names = sorted(fits, key=lambda name: fits[name].angle)
    entries = " or ".join(f'quaternion = "{name}"' for name in names)
    also = ""
    if len(names) > 1:
        angles = " and ".join(f"{np.rad2deg(fits[name].angle):.0f}" for name in names)
        also = f", which turn the IMU's axes by {angles} deg against the tool's"
    about = recording.info.get("optical_about", {}).get("quaternion", BODY_TO_REFERENCE)
    raise fault(
        recording,
        "optical.quaternion",
        f"quaternions of which, as '{about}', the gyroscope explains"
        f" {100.0 * found.explained:.0f} % of the turning",
        f"more; read otherwise it explains {100.0 * fits[names[0]].explained:.0f} %",
        f"[optical] {entries}{also}; where a header names the columns, naming them as they are",
    )


def _no_overlap(recording: Recording, found: Evidence, label: str) -> RecordingError:
    words = [
        f"{name} from {_seconds(found.ranges_s[name][0])} to {_seconds(found.ranges_s[name][1])} s"
        for name in (label, "imu")
    ]
    return RecordingError(
        recording.path or recording.name,
        " and ".join(words),
        "streams that overlap in time",
        "putting both on one clock, or the IMU's log of the same run",
    )


def _check_truth(recording: Recording) -> None:
    """Truth of another time than what it is the truth of."""
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
    raise RecordingError(
        recording.path or recording.name,
        f"encoder from {a} to {b} s and the other streams from {c} to {d} s",
        "streams that overlap in time",
        "putting them on one clock, or stating the unit of its times (time_unit)",
    )


def _seconds(value: float) -> str:
    return f"{value:.3f}"


def fault(recording: Recording, entry: str, got: str, expected: str, hint: str) -> RecordingError:
    """A fault of what `recording.toml` says, or of a run that has none."""
    place: Any = recording.path or recording.name
    column = None
    if recording.path is not None and (recording.path / FILE).is_file():
        place, column = recording.path / FILE, entry
    return RecordingError(
        place, got, expected, f"stating {hint}" if hint.startswith("[") else hint, column=column
    )
