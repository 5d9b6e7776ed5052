"""A recorded run in memory: streams of samples with exact times, on the host, in NumPy.

Times are int64 nanoseconds and never pass through a float. Values are SI. A sample that must not be used
(a hidden tracker, a zero quaternion) is invalid, not removed.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from jaxekf._support import arrays
from jaxekf._support.errors import RecordingError
from jaxekf.recordings._stream_arrays import convert
from jaxekf.recordings.accounts import Intake
from jaxekf.recordings.stream_types import (
    Camera,
    Encoder,
    Flags,
    Floats,
    Imu,
    Markers,
    Optical,
    PlainStream,
    Times,
)

__all__ = [
    "NANOSECONDS",
    "STREAMS",
    "Camera",
    "Encoder",
    "Flags",
    "Floats",
    "Imu",
    "Markers",
    "Optical",
    "PlainStream",
    "Recording",
    "Samples",
    "Times",
    "from_scipy",
    "period_ns",
    "to_scipy",
]

NANOSECONDS = 1_000_000_000

STREAMS = ("optical", "markers", "camera", "imu", "encoder")
"""Streams that have a class and a field of `Recording` of their own; any other is a `PlainStream`."""


@dataclass(frozen=True)
class Samples:
    """Samples of one sensor or input of a model, read from a recording.

    Each sample holds the value at its own time (the end of the interval since the sample before). The
    `source` of a `Sensor` or an `Input` returns them.

    Examples
    --------
    >>> import jaxekf
    >>> run = jaxekf.load(jaxekf.demo.FOLDER / "free-5")
    >>> samples = jaxekf.get_model("loose").sensor("optical").source(run)
    >>> samples.value.shape, samples.origin
    ((1501, 4), ('optical',))
    >>> print(f"visible: {samples.mask.mean():.0%}")
    visible: 85%
    """

    time_ns: Times
    """(N,) int64 nanoseconds at which the samples were taken, increasing."""
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
    at_limit: Flags | None = None
    """(N,) where the sensor is at the limit of its range, so that the true value may be larger. As input
    such a sample is used with the noise of an unknown rotation, as a measurement it is masked."""
    copies: int = 1
    """Groups in a sample, those included that only fill it up."""

    def __post_init__(self) -> None:
        label = ":".join(self.origin) or "samples"
        convert(self, label, {})
        for name in ("value", "aux"):
            refuse = partial(RecordingError, label, column=name)
            found = arrays.float_tree(getattr(self, name), refuse, keep_whole=name == "aux")
            object.__setattr__(self, name, found)


@dataclass(frozen=True)
class Recording:
    """One run: its streams, and the further entries of its description.

    All streams are on one clock, in int64 nanoseconds. `jaxekf.load` reads a run from disk; one can also be
    made from arrays.

    Raises
    ------
    RecordingError
        A stream has no sample, arrays of different lengths, or times that do not increase; or the name
        cannot be that of a folder.

    Examples
    --------
    >>> import numpy as np
    >>> import jaxekf
    >>> jaxekf.set_up()
    >>> tracker, imu = 16_000_000 * np.arange(1501), 8_000_000 * np.arange(3001)
    >>> attitude = np.tile([1.0, 0.0, 0.0, 0.0], (1501, 1))
    >>> run = jaxekf.Recording(
    ...     "at-rest",
    ...     optical=jaxekf.Optical(tracker, attitude, valid=np.ones(1501, bool)),
    ...     imu=jaxekf.Imu(imu, gyroscope=np.full((3001, 3), np.deg2rad(0.5))),
    ... )
    >>> print(np.rad2deg(jaxekf.estimate(run).bias.value[-1]).round(1))  # deg/s
    [0.5 0.5 0.5]
    """

    name: str
    """Name of the run, and of its folder if it is saved."""
    optical: Optical | None = None
    """Attitude from the tracker."""
    imu: Imu | None = None
    """Gyroscope, accelerometer and magnetometer."""
    encoder: Encoder | None = None
    """Ground truth."""
    info: Mapping[str, Any] = field(default_factory=dict)
    """Facts: ``gravity_ref`` (gravity vector, m/s^2, reference frame), ``field_ref`` (magnetic north
    there), ``p_body_object`` and ``q_body_object`` (the point and frame of the tool that is asked for),
    licence, seed."""
    path: Path | None = None
    """Folder or file that the run was read from; None for a run made in memory."""
    markers: Markers | None = None
    """Positions of the single markers from the tracker."""
    camera: Camera | None = None
    """Image points of known landmarks."""
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


def _check_stream(place: Path | str, label: str, stream: Any) -> None:
    """Lengths agree, there is at least one sample, time increases."""
    times = stream.time_ns
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
