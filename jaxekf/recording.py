"""A recorded run in memory: streams of samples with exact times, on the host, in NumPy.

Times are int64 nanoseconds and never pass through a float. Values are SI. A sample that is there but
not to be believed (a hidden tracker, a zero quaternion) is invalid, not removed.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation, Slerp

from jaxekf.errors import RecordingError

Times = NDArray[np.int64]
Floats = NDArray[np.float64]
Flags = NDArray[np.bool_]

NANOSECONDS = 1_000_000_000


@dataclass(frozen=True)
class Samples:
    """What one sensor or input of a model reads from a recording.

    Each sample holds the value at its own time (the end of the interval since the sample before).
    """

    time_ns: Times
    value: Any
    """Array (N, ...) or a pytree of such."""
    mask: Flags
    """True where a row is visible: (N,) for whole samples, (N, rows) for single rows."""
    aux: Any = None
    """Per-sample data for `predict` and `noise`: a pytree of arrays (N, ...)."""


@dataclass(frozen=True)
class Optical:
    """Attitude, and often position, of the tool in the tracker's reference frame."""

    time_ns: Times
    q_ref_body: Floats
    """Unit quaternions (N, 4), w x y z, body to reference."""
    valid: Flags
    position: Floats | None = None
    """Position (N, 3) in metres in the reference frame."""


@dataclass(frozen=True)
class Imu:
    """Gyroscope, and where recorded accelerometer and magnetometer, in the body frame."""

    time_ns: Times
    gyroscope: Floats
    """Angular rate (N, 3), rad/s."""
    accelerometer: Floats | None = None
    """Specific force (N, 3), m/s^2."""
    magnetometer: Floats | None = None
    """Field (N, 3) in the sensor's unit."""


@dataclass(frozen=True)
class Encoder:
    """Attitude truth from the robot's joints, in the tracker's reference frame."""

    time_ns: Times
    q_ref_body: Floats
    """Unit quaternions (N, 4)."""
    valid: Flags
    scored: Flags
    """Samples on which an estimate is judged."""


@dataclass(frozen=True)
class Recording:
    """One run: its streams, and what its description says besides."""

    name: str
    optical: Optical | None = None
    imu: Imu | None = None
    encoder: Encoder | None = None
    info: Mapping[str, Any] = field(default_factory=dict)
    """Free-form facts: marker geometry, pivot, licence, seed."""
    path: Path | None = None

    def __post_init__(self) -> None:
        if self.name in ("", ".", "..") or set(self.name) & set("/\\\0"):
            raise RecordingError(
                self.path or "recording",
                f"the name {self.name!r}",
                "a name that can be a folder's",
                "changing it in recording.toml",
            )
        for label in ("optical", "imu", "encoder"):
            stream = getattr(self, label)
            if stream is not None:
                _check_stream(self.path or self.name, label, stream)

    def replace(self, **changes: Any) -> "Recording":
        """A copy with some streams or facts changed."""
        return replace(self, **changes)

    def need_optical(self) -> Optical:
        """The optical stream, or an error that names the run."""
        return self._need("optical")

    def need_imu(self) -> Imu:
        """The IMU stream, or an error that names the run."""
        return self._need("imu")

    def need_encoder(self) -> Encoder:
        """The encoder stream, or an error that names the run."""
        return self._need("encoder")

    def _need(self, label: str) -> Any:
        stream = getattr(self, label)
        if stream is None:
            raise RecordingError(
                self.path or self.name,
                f"no {label} stream",
                "one for what was asked",
                f"adding {label}.csv and its section to recording.toml",
            )
        return stream


def _check_stream(place: Path | str, label: str, stream: Any) -> None:
    """Lengths agree, there is at least one sample, time increases."""
    times = stream.time_ns
    if times.dtype != np.int64:
        raise RecordingError(
            place,
            f"{label} times of type {times.dtype}",
            "int64 nanoseconds",
            "casting them exactly",
        )
    for key, value in vars(stream).items():
        if value is not None and len(value) != len(times):
            raise RecordingError(
                place,
                f"{len(value)} values of {label}.{key} for {len(times)} times",
                "as many values as times",
                "writing every sample's row whole",
            )
    if len(times) == 0:
        raise RecordingError(place, f"0 samples in {label}", "at least one", "recording again")
    backwards = np.flatnonzero(np.diff(times) <= 0)
    if backwards.size:
        first = int(backwards[0])
        raise RecordingError(
            place,
            f"{label} time {times[first + 1]} ns after {times[first]} ns",
            "times that increase",
            "sorting the samples and removing duplicates",
            line=first + 3,
            column="time",
        )


def unit_quaternions(values: Floats, tolerance: float = 0.1) -> tuple[Floats, Flags]:
    """Quaternions scaled to unit norm, and which of them were quaternions at all.

    A tracker writes a missing tool as a zero quaternion or leaves it out (NaN): such a row, or one
    whose norm is off by more than `tolerance`, is not valid and becomes the identity.
    """
    norm = np.linalg.norm(values, axis=1)
    with np.errstate(invalid="ignore"):
        valid = np.abs(norm - 1.0) <= tolerance
    unit = np.zeros_like(values)
    unit[:, 0] = 1.0
    unit[valid] = values[valid] / norm[valid, None]
    return unit, valid


def to_scipy(q: Floats) -> Rotation:
    """SciPy's rotation (which stores x, y, z, w) of quaternions w, x, y, z."""
    return Rotation.from_quat(np.roll(np.asarray(q), -1, axis=-1))


def from_scipy(rotation: Rotation) -> Floats:
    """Quaternions w, x, y, z of SciPy's rotation."""
    return np.roll(rotation.as_quat(), 1, axis=-1)


def encoder_at(encoder: Encoder, time_ns: Times, longest_gap_s: float = 0.1) -> Encoder:
    """The encoder's attitude at other times, along the shorter arc between its valid samples.

    Outside the recorded span, and inside gaps longer than `longest_gap_s`, the result is not valid:
    interpolation never invents truth.
    """
    kept = np.flatnonzero(encoder.valid)
    if kept.size < 2:
        unknown = np.tile([1.0, 0.0, 0.0, 0.0], (len(time_ns), 1))
        no = np.zeros(len(time_ns), bool)
        return Encoder(time_ns, unknown, no, no)
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
    return Encoder(time_ns, q, valid, valid & (encoder.scored & encoder.valid)[nearest])


def encoder_rate_at(encoder: Encoder, time_ns: Times, longest_gap_s: float = 0.1) -> Floats:
    """Body rate (N, 3), rad/s, at other times; NaN where the encoder does not tell.

    Central differences of the encoder's attitude, interpolated linearly, neither of them over gaps
    longer than `longest_gap_s`.
    """
    if len(encoder.time_ns) < 3:
        return np.full((len(time_ns), 3), np.nan)
    before, after = to_scipy(encoder.q_ref_body[:-2]), to_scipy(encoder.q_ref_body[2:])
    span = (encoder.time_ns[2:] - encoder.time_ns[:-2])[:, None] / NANOSECONDS
    rate = (before.inv() * after).as_rotvec() / span
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


def period_ns(time_ns: Times) -> int:
    """Nominal sampling period: the median step."""
    return int(np.median(np.diff(time_ns))) if len(time_ns) > 1 else 0
