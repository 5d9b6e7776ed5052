"""A recorded run in memory: streams of samples with exact times, on the host, in NumPy.

Times are int64 nanoseconds and never pass through a float. Values are SI. A sample that must not be used
(a hidden tracker, a zero quaternion) is invalid, not removed.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any, ClassVar, Self

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from jaxekf._support.errors import RecordingError
from jaxekf.recordings.accounts import Intake

Times = NDArray[np.int64]
Floats = NDArray[np.float64]
Flags = NDArray[np.bool_]

NANOSECONDS = 1_000_000_000

STREAMS = ("optical", "markers", "camera", "imu", "encoder")
"""Streams that have a class and a field of `Recording` of their own; any other is a `PlainStream`."""


@dataclass(frozen=True)
class Samples:
    """Samples of one sensor or input of a model, read from a recording.

    Each sample holds the value at its own time (the end of the interval since the sample before).
    """

    time_ns: Times
    value: Any
    """Array (N, ...) or a pytree of such."""
    mask: Flags
    """True where a row is visible: (N,) for whole samples, (N, rows) for single rows."""
    aux: Any = None
    """Per-sample data for `predict` and `noise`: a pytree of arrays (N, ...)."""
    latency_ns: int = 0
    """How long after `time_ns` a sample was known."""
    origin: tuple[str, ...] = ()
    """The recording's stream that it is of, and of which part of it, such as a marker: for the account."""
    thinned: int = 0
    """Samples of that stream that are left out here because they add no information."""
    points: Times | None = None
    """(N,) where a sample is made of like groups, such as the points of an image: how many of them the
    source has; the account counts these. None where a sample is one row of the source."""
    copies: int = 1
    """Groups in a sample, those included that only fill it up."""


class _Stream:
    """Shared by all streams."""

    per_sample: ClassVar[tuple[str, ...]] = ()
    """Names of the fields that have one entry for each sample, without the times."""
    time_ns: Times
    latency_ns: int = 0

    @property
    def arrays(self) -> dict[str, Any]:
        """Arrays with one entry for each sample, by name, ``time_ns`` first."""
        named = {name: getattr(self, name) for name in ("time_ns", *self.per_sample)}
        return {name: value for name, value in named.items() if value is not None}

    @property
    def seen(self) -> Flags:
        """(N,) True where some part of the sample is usable."""
        return np.ones(len(self.time_ns), bool)

    def take(self, chosen: Any) -> Self:
        """The stream with the chosen samples only (flags or indices)."""
        return replace(self, **{name: value[chosen] for name, value in self.arrays.items()})  # pyright: ignore


@dataclass(frozen=True)
class PlainStream(_Stream):
    """Columns of numbers that no built-in model reads, for a model of one's own; see `jaxekf.io.schema`."""

    time_ns: Times
    """Stamps; a sample was taken `latency_ns` before."""
    values: Mapping[str, Floats]
    """Arrays (N, c) by field, SI units; NaN where a cell is blank."""
    latency_ns: int = 0

    @property
    def arrays(self) -> dict[str, Any]:
        """The times and all fields."""
        return {"time_ns": self.time_ns, **self.values}

    @property
    def seen(self) -> Flags:
        """(N,) True where some field is finite."""
        finite = [np.isfinite(value).all(axis=1) for value in self.values.values()]
        return np.asarray(np.any(finite, axis=0))

    def take(self, chosen: Any) -> Self:
        """The stream with the chosen samples only (flags or indices)."""
        kept = {name: value[chosen] for name, value in self.values.items()}
        return replace(self, time_ns=self.time_ns[chosen], values=kept)


@dataclass(frozen=True)
class Optical(_Stream):
    """Attitude, and often position, of the tool in the tracker's reference frame."""

    time_ns: Times
    """Stamps; a sample was taken `latency_ns` before."""
    q_ref_body: Floats
    """Unit quaternions (N, 4), w x y z, body to reference."""
    valid: Flags
    position: Floats | None = None
    """Position (N, 3) in metres in the reference frame, of the point `p_body_tool`."""
    error: Floats | None = None
    """Reported fit error (N,) in metres; NaN where none was reported."""
    p_body_tool: Floats | None = None
    """(3,) metres: where in the body the point is whose position is given; None for its origin."""
    latency_ns: int = 0

    per_sample: ClassVar = ("q_ref_body", "valid", "position", "error")

    @property
    def seen(self) -> Flags:
        """(N,) as `valid`."""
        return self.valid


@dataclass(frozen=True)
class Markers(_Stream):
    """Single optical markers of one rigid tool, each in the tracker's reference frame."""

    time_ns: Times
    """Stamps of the tracker's frames; a frame was taken `latency_ns` before."""
    position: Floats
    """(N, M, 3) metres in the reference frame; of a hidden marker anything."""
    visible: Flags
    """(N, M)."""
    names: tuple[str, ...]
    p_body_marker: Floats
    """(M, 3) metres: the geometry, in the body frame (the IMU's)."""
    quality: Floats | None = None
    """(N, M) as reported, larger is better; NaN where none was reported."""
    quality_min: float = 0.0
    """Markers of less quality are not used."""
    error: Floats | None = None
    """(N, M) reported fit error in metres; NaN where none was reported."""
    latency_ns: int = 0

    per_sample: ClassVar = ("position", "visible", "quality", "error")

    @cached_property
    def usable(self) -> Flags:
        """(N, M): visible, finite and of sufficient quality."""
        usable = self.visible & np.isfinite(self.position).all(axis=2)
        if self.quality is not None:
            with np.errstate(invalid="ignore"):
                usable &= ~(self.quality < self.quality_min)
        return usable

    @property
    def seen(self) -> Flags:
        """(N,) True where any part is usable."""
        return np.asarray(self.usable.any(axis=1))

    def __post_init__(self) -> None:
        count = len(self.names)
        shapes = {
            "position": (len(self.time_ns), count, 3),
            "visible": (len(self.time_ns), count),
            "p_body_marker": (count, 3),
        }
        counted = f"{len(self.time_ns)} frames of {count} markers"
        hint = "giving every marker its place in the body and in every frame"
        _check_shapes("markers", self, shapes, counted, hint)


@dataclass(frozen=True)
class Camera(_Stream):
    """Image points of landmarks whose positions are known, from a camera that is fixed to the body."""

    time_ns: Times
    """Stamps of the images; an image was taken `latency_ns` before."""
    pixel: Floats
    """(N, L, 2) image points, pixels, u to the right and v down; of a landmark that was not found
    anything."""
    visible: Flags
    """(N, L) whether the landmark was found in the image."""
    names: tuple[str, ...]
    p_ref_landmark: Floats
    """(L, 3) metres: the landmarks in the reference frame."""
    focal: Floats
    """(2,) focal lengths, pixels."""
    centre: Floats
    """(2,) image point of the optical axis, pixels."""
    radial: Floats = field(default_factory=lambda: np.zeros(2))
    """(2,) of the lens: a point r from the axis appears ``1 + radial[0] r^2 + radial[1] r^4`` times as far
    from it, r in focal lengths."""
    p_body_camera: Floats = field(default_factory=lambda: np.zeros(3))
    """(3,) metres: the camera's centre in the body frame (the IMU's)."""
    q_body_camera: Floats = field(default_factory=lambda: np.array([1.0, 0.0, 0.0, 0.0]))
    """(4,) camera to body; the camera looks along its z, x is to the right and y down in the image."""
    sigma: Floats | None = None
    """(N, L) reported standard deviation of an image point, pixels; NaN where none was reported."""
    latency_ns: int = 0

    per_sample: ClassVar = ("pixel", "visible", "sigma")

    @cached_property
    def usable(self) -> Flags:
        """(N, L): found, and finite."""
        return self.visible & np.isfinite(self.pixel).all(axis=2)

    @property
    def seen(self) -> Flags:
        """(N,) True where any part is usable."""
        return np.asarray(self.usable.any(axis=1))

    def __post_init__(self) -> None:
        count, images = len(self.names), len(self.time_ns)
        if count == 0:
            raise RecordingError(
                "camera", "no landmark", "at least one", "naming the landmarks of the scene"
            )
        shapes = {
            "pixel": (images, count, 2),
            "visible": (images, count),
            "p_ref_landmark": (count, 3),
            "focal": (2,),
            "centre": (2,),
            "radial": (2,),
            "p_body_camera": (3,),
            "q_body_camera": (4,),
        }
        if self.sigma is not None:
            shapes["sigma"] = (images, count)
        hint = "giving every landmark its place in the scene and in every image"
        _check_shapes("camera", self, shapes, f"{images} images of {count} landmarks", hint)


@dataclass(frozen=True)
class Imu(_Stream):
    """Gyroscope, and where recorded accelerometer and magnetometer, in the body frame."""

    time_ns: Times
    gyroscope: Floats
    """Angular rate (N, 3), rad/s."""
    accelerometer: Floats | None = None
    """Specific force (N, 3), m/s^2."""
    magnetometer: Floats | None = None
    """Field (N, 3) in the sensor's unit."""

    per_sample: ClassVar = ("gyroscope", "accelerometer", "magnetometer")


@dataclass(frozen=True)
class Encoder(_Stream):
    """Truth from the robot's joints, in the tracker's reference frame: attitude, maybe position."""

    time_ns: Times
    q_ref_body: Floats
    """Unit quaternions (N, 4)."""
    valid: Flags
    scored: Flags
    """Samples on which an estimate is judged."""
    position: Floats | None = None
    """(N, 3) metres: position of the body's origin in the reference frame."""

    per_sample: ClassVar = ("q_ref_body", "valid", "scored", "position")

    @property
    def seen(self) -> Flags:
        """(N,) as `valid`."""
        return self.valid


@dataclass(frozen=True)
class Recording:
    """One run: its streams, and the further entries of its description."""

    name: str
    optical: Optical | None = None
    imu: Imu | None = None
    encoder: Encoder | None = None
    info: Mapping[str, Any] = field(default_factory=dict)
    """Facts: ``gravity_ref`` (gravity vector, m/s^2, reference frame), ``field_ref`` (magnetic north
    there),
    ``p_body_object`` and
    ``q_body_object`` (the point and frame of the tool that is asked for), licence, seed."""
    path: Path | None = None
    markers: Markers | None = None
    camera: Camera | None = None
    intake: Mapping[str, Intake] = field(default_factory=dict)
    """Account of the rows of each stream's source; empty for a run made in memory."""
    sources: Mapping[str, str] = field(default_factory=dict)
    """SHA-256 of each file it was read from, by name; empty for an importer that reports none."""
    others: Mapping[str, PlainStream] = field(default_factory=dict)
    """Streams besides those above, by name."""

    def __post_init__(self) -> None:
        if self.name in ("", ".", "..") or set(self.name) & set("/\\\0"):
            got = f"the name {self.name!r}"
            expected = "a name that can be a folder's"
            hint = "changing it in recording.toml"
            raise RecordingError(self.path or "recording", got, expected, hint)
        for label, stream in self.streams.items():
            _check_stream(self.path or self.name, label, stream)

    @property
    def streams(self) -> dict[str, Any]:
        """All streams that there are, by name."""
        known = {label: getattr(self, label) for label in STREAMS}
        return {k: stream for k, stream in known.items() if stream is not None} | dict(self.others)

    def replace(self, **changes: Any) -> "Recording":
        """A copy with some streams or facts changed."""
        return replace(self, **changes)

    def with_streams(self, streams: Mapping[str, Any], **changes: Any) -> "Recording":
        """A copy with these streams in place of those of the same names; None removes one."""
        built_in = {label: stream for label, stream in streams.items() if label in STREAMS}
        others = {**self.others, **{k: v for k, v in streams.items() if k not in STREAMS}}
        others = {label: stream for label, stream in others.items() if stream is not None}
        return replace(self, **built_in, others=others, **changes)

    def samples(self, label: str, name: str) -> Samples:
        """A field of a plain stream as a sensor's `source` returns it, masked where it is not finite.

        Parameters
        ----------
        label
            Name of the stream, such as ``force_torque``.
        name
            Field of the stream, such as ``force``.

        Raises
        ------
        RecordingError
            Without that stream or that field.
        """
        stream = self._need(label)
        if name not in stream.values:
            got = f"no field {name} of {label}"
            expected = f"one of {', '.join(stream.values)}"
            hint = f"adding its columns to {label}.csv, or another field"
            raise RecordingError(self.path or self.name, got, expected, hint)
        value = stream.values[name]
        finite = np.isfinite(value).all(axis=1)
        taken = stream.time_ns - stream.latency_ns
        return Samples(taken, value, finite, latency_ns=stream.latency_ns, origin=(label,))

    def need_optical(self) -> Optical:
        """The optical stream, or an error that names the run."""
        return self._need("optical")

    def need_markers(self) -> Markers:
        """The markers, or an error that names the run."""
        return self._need("markers")

    def need_camera(self) -> Camera:
        """The camera, or an error that names the run."""
        return self._need("camera")

    def need_imu(self) -> Imu:
        """The IMU stream, or an error that names the run."""
        return self._need("imu")

    def need_encoder(self) -> Encoder:
        """The encoder stream, or an error that names the run."""
        return self._need("encoder")

    def _need(self, label: str) -> Any:
        stream = self.streams.get(label)
        if stream is None:
            got = f"no {label} stream"
            hint = f"adding {label}.csv and its section to recording.toml"
            raise RecordingError(self.path or self.name, got, "one for what was asked", hint)
        return stream


def _check_shapes(
    label: str, stream: Any, shapes: Mapping[str, tuple[int, ...]], counted: str, hint: str
) -> None:
    for key, shape in shapes.items():
        got = np.shape(getattr(stream, key))
        if got != shape:
            raise RecordingError(label, f"{key} of shape {got}", f"{shape} for {counted}", hint)


def _check_stream(place: Path | str, label: str, stream: Any) -> None:
    """Lengths agree, there is at least one sample, time increases."""
    times = stream.time_ns
    if times.dtype != np.int64:
        got = f"{label} times of type {times.dtype}"
        raise RecordingError(place, got, "int64 nanoseconds", "casting them exactly")
    for key, value in stream.arrays.items():
        if len(value) != len(times):
            got = f"{len(value)} values of {label}.{key} for {len(times)} times"
            hint = "writing every sample's row whole"
            raise RecordingError(place, got, "as many values as times", hint)
    if len(times) == 0:
        raise RecordingError(place, f"0 samples in {label}", "at least one", "recording again")
    backwards = np.flatnonzero(np.diff(times) <= 0)
    if backwards.size:
        first = int(backwards[0])
        got = f"{label} time {times[first + 1]} ns after {times[first]} ns"
        expected, hint = "times that increase", "sorting the samples and removing duplicates"
        raise RecordingError(place, got, expected, hint, line=first + 3, column="time")


def to_scipy(q: Floats) -> Rotation:
    """SciPy's rotation (which stores x, y, z, w) of quaternions w, x, y, z."""
    return Rotation.from_quat(np.roll(np.asarray(q), -1, axis=-1))


def from_scipy(rotation: Rotation) -> Floats:
    """Quaternions w, x, y, z of SciPy's rotation."""
    return np.roll(rotation.as_quat(), 1, axis=-1)


def period_ns(time_ns: Times) -> int:
    """Nominal sampling period: the median step."""
    return int(np.median(np.diff(time_ns))) if len(time_ns) > 1 else 0
