"""Agreement of tracker and IMU of a recording: units, quaternion order, time.

`evidence` measures and does not judge; `plausibility` judges. A quantity that the streams do not determine
is NaN.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from jaxekf.calibration import acceleration_agreement, clock_offset, motion_agreement
from jaxekf.calibration.motion_agreement import MotionFit, RelativeRotations
from jaxekf.pose_solvers.marker_pose import from_markers
from jaxekf.recordings.accounts import Indices
from jaxekf.recordings.facts import BODY_TO_REFERENCE
from jaxekf.recordings.types import NANOSECONDS, Floats, Imu, Markers, Optical, Recording

ALIKE = 0.8
"""Correlation from which on both streams measure the same motion, so that their ratio is meaningful."""
EXPLAINED = 0.9
"""Share of the rotation that the right reading of a quaternion explains."""
DEGREES = 180.0 / np.pi
_WINDOWS, _QUIETEST = 200, 5
_MARKER_PAIRS = 1500
_FRAMES = 2000
_NEAR_S = 0.45
"""Lag, s, beyond which it may be on the bound of the search without an offset."""
_ORDERS = {"w,x,y,z": "x,y,z,w", "x,y,z,w": "w,x,y,z"}


@dataclass(frozen=True)
class Evidence:
    """Measurements on a recording; NaN if the streams do not determine a quantity."""

    turns: int = 0
    """Relative rotations of the tracker that were compared with the gyroscope."""
    rate: float = np.nan
    """Root mean square rate of the tracker, rad/s."""
    second_axis: float = np.nan
    """Squared rotation about the second principal axis over that about the first, by the gyroscope: 0 to
    1."""
    lag_s: float = np.nan
    """Lag of the tracker to 5 ms, s; `jaxekf.calibration.alignment` estimates it precisely."""
    clock_steps: bool = False
    """Whether a clock steps, so that rates and rotations of the whole run cannot be compared."""
    searched_s: float = np.nan
    """Largest clock offset, s, up to which no offset fits; NaN if one fits, 0 for too little rotation."""
    rate_ratio: float = np.nan
    """Gyroscope's rate over tracker's rate: 1, or 57.3 if deg/s were taken for rad/s."""
    rate_correlation: float = np.nan
    """Correlation of the rotation vectors, for the best reading of the quaternion."""
    explained: float = np.nan
    """Share of the tracker's squared rotation that the gyroscope explains, frames aligned."""
    too_fast: bool = False
    """Whether the tool turns by about half a turn or more between samples: no `rate_ratio`."""
    readings: dict[str, MotionFit] = field(default_factory=dict)
    """The same for other readings of the quaternion (component order or direction)."""
    static_norm: float = np.nan
    """Norm of the specific force in the quietest seconds, m/s^2."""
    static_scatter: float = np.nan
    """Relative standard deviation of that norm."""
    mean_force_ref: tuple[float, ...] = (np.nan, np.nan, np.nan)
    """Mean specific force in the reference frame, m/s^2, valid for any motion."""
    length_ratio: float = np.nan
    """Tracker's acceleration over the accelerometer's, or markers' distances over the geometry's."""
    length_correlation: float = np.nan
    """Correlation of the accelerations; 1 for markers."""
    acceleration: float = np.nan
    """Root mean square of the tracker's acceleration over 0.2 s, m/s^2."""
    farthest: float = np.nan
    """95 % quantile of the tool's distance from the reference frame's origin, m."""
    ranges_s: dict[str, tuple[float, float]] = field(default_factory=dict)
    """First and last time of each stream, latency subtracted, s."""
    overlap_s: float = np.nan
    """Overlap of tracker and IMU, s; negative if one ends before the other begins."""

    @property
    def mean_force(self) -> float:
        """Norm of `mean_force_ref`."""
        return float(np.linalg.norm(self.mean_force_ref))

    def as_dict(self) -> dict[str, Any]:
        """For JSON; angles in degrees."""
        measured = {name: found.explained for name, found in self.readings.items()}
        return {
            "turns": self.turns,
            "rate_deg_s": self.rate * DEGREES,
            "second_axis": self.second_axis,
            "lag_s": self.lag_s,
            "clock_steps": self.clock_steps,
            "searched_s": self.searched_s,
            "rate_ratio": self.rate_ratio,
            "rate_correlation": self.rate_correlation,
            "explained": self.explained,
            "explained_otherwise": measured,
            "too_fast": self.too_fast,
            "static_norm": self.static_norm,
            "mean_force": self.mean_force,
            "mean_force_ref": list(self.mean_force_ref),
            "length_ratio": self.length_ratio,
            "length_correlation": self.length_correlation,
            "ranges_s": {name: list(ends) for name, ends in self.ranges_s.items()},
            "overlap_s": self.overlap_s,
        }


def evidence(recording: Recording) -> Evidence:
    """Measure the agreement of tracker and IMU; fast for a run of any length."""
    tracker, imu = recording.optical or recording.markers, recording.imu
    measured: dict[str, Any] = {"ranges_s": _ranges(recording)}
    if imu is not None:
        measured["static_norm"], measured["static_scatter"] = static_norm(imu)
    if isinstance(tracker, Markers):
        measured["length_ratio"] = marker_ratio(tracker)
        measured["length_correlation"] = 1.0 if np.isfinite(measured["length_ratio"]) else np.nan
    if tracker is None or imu is None:
        return Evidence(**measured)
    measured["overlap_s"] = overlap_s(measured["ranges_s"], tracker_label(recording))
    if isinstance(tracker, Optical):
        rows = np.flatnonzero(tracker.valid)
        valid = tracker.valid.copy()
        valid[rows[motion_agreement.outlying_poses(tracker.q_ref_body[rows])]] = False
        tracker = replace(tracker, valid=valid)
    rotations, searched_s = _rotations(recording, tracker, imu)
    measured["searched_s"] = searched_s
    if rotations is None:
        return Evidence(**measured)
    stated, others = _fits(recording, rotations)
    best = max([stated, *others.values()], key=lambda found: found.explained)
    alike = np.sqrt(best.explained) > ALIKE and not rotations.too_fast
    measured |= {
        "turns": len(rotations.duration_s),
        "rate": float(
            np.sqrt(np.mean(np.sum(rotations.tracker**2, axis=1) / rotations.duration_s**2))
        ),
        "second_axis": motion_agreement.second_axis_share(rotations.gyroscope),
        "lag_s": rotations.lag_s,
        "rate_ratio": best.rate_ratio if alike else np.nan,
        "rate_correlation": float(np.sqrt(best.explained)),
        "explained": stated.explained,
        "readings": others,
        "too_fast": rotations.too_fast,
    }
    if stated.explained > EXPLAINED:
        measured["mean_force_ref"] = tuple(
            acceleration_agreement.mean_force(rotations, imu, stated.frame).tolist()
        )
    if isinstance(tracker, Optical):
        measured |= _lengths(tracker, imu, rotations, stated)
    return Evidence(**measured)


def _ranges(recording: Recording) -> dict[str, tuple[float, float]]:
    found = {}
    for label, stream in recording.streams.items():
        first, last = (int(t) - stream.latency_ns for t in stream.time_ns[[0, -1]])
        found[label] = (first / NANOSECONDS, last / NANOSECONDS)
    return found


def overlap_s(ranges_s: Mapping[str, tuple[float, float]], label: str) -> float:
    """Overlap of a stream and the IMU, s.

    Negative if one ends before the other begins, NaN if one is missing.
    """
    if label not in ranges_s or "imu" not in ranges_s:
        return np.nan
    one, other = ranges_s["imu"], ranges_s[label]
    return min(one[1], other[1]) - max(one[0], other[0])


def tracker_label(recording: Recording) -> str:
    """Name of the tracker's stream."""
    return "optical" if recording.optical is not None else "markers"


def _rotations(
    recording: Recording, tracker: Optical | Markers, imu: Imu
) -> tuple[RelativeRotations | None, float]:
    """Rotations at the clock offset that fits, and the largest offset that was searched without success."""
    posed = isinstance(tracker, Optical)
    rows = np.flatnonzero(tracker.valid if posed else tracker.usable.sum(axis=1) >= 3)
    t = (tracker.time_ns[rows] - tracker.latency_ns - imu.time_ns[0]) / NANOSECONDS

    def attitude(chosen: Indices) -> Floats:
        if isinstance(tracker, Optical):
            return tracker.q_ref_body[rows[chosen]]
        return from_markers(tracker.take(rows[chosen])).q_ref_body

    pairs = {} if posed else {"most": _MARKER_PAIRS}

    def at(offset_s: float) -> tuple[RelativeRotations | None, float]:
        found = motion_agreement.relative_rotations(t, attitude, imu, **pairs, offset_s=offset_s)
        if found is None:
            return None, 0.0
        found = motion_agreement.compose(found, imu, _best(recording, found).rate_ratio)
        return found, _best(recording, found).explained

    def agreement(offset_s: float) -> tuple[float, float]:
        found, explained = at(offset_s)
        return (offset_s if found is None else found.lag_s), explained

    near, explained = at(0.0)
    if explained > EXPLAINED and near is not None and abs(near.lag_s) < _NEAR_S:
        return near, np.nan
    search = clock_offset.find(t, attitude, imu, agreement)
    if search.explained > explained and not np.isnan(search.offset_s):
        return at(search.offset_s)[0], np.nan
    return near, np.nan if explained > ALIKE**2 else search.within_s


def _best(recording: Recording, rotations: RelativeRotations) -> MotionFit:
    stated, others = _fits(recording, rotations)
    return max([stated, *others.values()], key=lambda found: found.explained)


def _fits(
    recording: Recording, rotations: RelativeRotations
) -> tuple[MotionFit, dict[str, MotionFit]]:
    """The fit of the quaternions as stated, and those of their other readings."""
    stated, others = motion_agreement.fit(rotations.tracker, rotations.gyroscope), {}
    if recording.optical is not None:
        others = motion_agreement.fit_readings(rotations, _other_readings(recording))
    return stated, others


def _other_readings(recording: Recording) -> dict[str, motion_agreement.QuaternionReading]:
    """Other readings of the quaternion, by the entry of `recording.toml` that would state them."""
    about = recording.info.get("optical_about", {})
    stated_parts = [
        part.strip() for part in str(about.get("quaternion", BODY_TO_REFERENCE)).split(",")
    ]
    order = ",".join([part for part in stated_parts if len(part) == 1] or "wxyz")
    direction = next((part for part in stated_parts if len(part) > 1), "body to reference")
    opposite = "reference to body" if direction == "body to reference" else "body to reference"
    found: dict[str, motion_agreement.QuaternionReading] = {
        f"{order}, {opposite}": lambda q: q * np.array([1.0, -1.0, -1.0, -1.0])
    }
    if order in _ORDERS:
        # Stated scalar first, actually scalar last: the components are shifted by one; or the reverse.
        shift = 1 if order == "w,x,y,z" else -1
        sign = np.array([1.0, -1.0, -1.0, -1.0]) if direction == "reference to body" else 1.0
        found[f"{_ORDERS[order]}, {direction}"] = lambda q: np.roll(q * sign, shift, axis=1) * sign
    return found


def static_norm(imu: Imu) -> tuple[float, float]:
    """Median norm of the specific force in the quietest seconds, m/s^2, and its relative deviation."""
    if imu.accelerometer is None or len(imu.time_ns) < 2:
        return np.nan, np.nan
    span = (imu.time_ns[-1] - imu.time_ns[0]) / NANOSECONDS
    width = int(np.clip(len(imu.time_ns) / max(span, 1e-9), 2, len(imu.time_ns)))
    count = len(imu.time_ns) // width
    chosen = np.unique(np.linspace(0, count - 1, min(count, _WINDOWS)).astype(int))
    windows = imu.accelerometer[: count * width].reshape(count, width, 3)[chosen]
    scatter = windows.std(axis=1).sum(axis=1)
    quiet = windows[np.argsort(scatter)[:_QUIETEST]]
    norm = np.linalg.norm(quiet, axis=2)
    middle = float(np.median(norm))
    return middle, float(norm.std()) / max(middle, 1e-12)


def marker_ratio(markers: Markers) -> float:
    """Median ratio of the markers' measured distances to those of the geometry."""
    rows = np.arange(0, len(markers.time_ns), max(1, -(-len(markers.time_ns) // _FRAMES)))
    usable, position = markers.usable[rows], markers.position[rows]
    ratios = []
    for i in range(len(markers.names)):
        for j in range(i):
            length = float(np.linalg.norm(markers.p_body_marker[i] - markers.p_body_marker[j]))
            both = usable[:, i] & usable[:, j]
            if length > 0.0 and both.any():
                apart = np.linalg.norm(position[both, i] - position[both, j], axis=1)
                ratios.append(apart / length)
    return float(np.median(np.concatenate(ratios))) if ratios else np.nan


def _lengths(
    tracker: Optical, imu: Imu, rotations: RelativeRotations, stated: MotionFit
) -> dict[str, float]:
    found = acceleration_agreement.acceleration_fit(tracker, imu, rotations.lag_s, stated.frame)
    if found is None or tracker.position is None:
        return {}
    far = np.linalg.norm(tracker.position[tracker.valid], axis=1)
    return {
        "length_ratio": found.ratio if found.correlation > ALIKE else np.nan,
        "length_correlation": found.correlation,
        "acceleration": found.acceleration,
        "farthest": float(np.nanquantile(far, 0.95)),
    }
