"""The streams of a recorded run: one class for each kind of sensor, samples in order of time.

A stream is a frozen dataclass of NumPy arrays, one entry for each sample. Units are SI. A sample that must
not be used is invalid, not removed. Lists, other number types and columns of pandas are converted; times
must be whole nanoseconds.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from typing import Any, ClassVar, Self

import numpy as np

from jaxekf._support import arrays
from jaxekf._support.arrays import Shape
from jaxekf._support.errors import RecordingError
from jaxekf.recordings._stream_arrays import Flags, Floats, Times, convert


class _Stream:
    """Shared by all streams."""

    per_sample: ClassVar[tuple[str, ...]] = ()
    """Names of the fields that have one entry for each sample, without the times."""
    shapes: ClassVar[Mapping[str, Shape]] = {}
    """Shape of fields that is known without the other fields, None for the number of samples."""
    time_ns: Times
    latency_ns: int = 0

    def __post_init__(self) -> None:
        convert(self, type(self).__name__.lower(), {"time_ns": (None,), **self.shapes})

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

    def __post_init__(self) -> None:
        super().__post_init__()
        values = {}
        for name, value in self.values.items():
            refuse = partial(RecordingError, "stream", column=name)
            values[name] = arrays.floats(value, refuse)
            if values[name].ndim != 2:
                got, expected = f"an array of shape {values[name].shape}", "one of shape (N, c)"
                raise refuse(got, expected, "values[:, None] for one column")
        object.__setattr__(self, "values", values)

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
    """Attitude, and often position, of the tool in the tracker's reference frame.

    Examples
    --------
    The sample at 16 ms is hidden:

    >>> import numpy as np
    >>> import jaxekf
    >>> optical = jaxekf.Optical(
    ...     time_ns=np.array([0, 16_000_000, 32_000_000]),
    ...     q_ref_body=np.tile([1.0, 0.0, 0.0, 0.0], (3, 1)),
    ...     valid=np.array([True, False, True]),
    ... )
    >>> optical.take(optical.seen).time_ns
    array([       0, 32000000])
    """

    time_ns: Times
    """Stamps; a sample was taken `latency_ns` before."""
    q_ref_body: Floats
    """Unit quaternions (N, 4), w x y z, body to reference."""
    valid: Flags
    """(N,) False where the tool is hidden; numbers there are not used."""
    position: Floats | None = None
    """Position (N, 3) in metres in the reference frame, of the point `p_body_tool`."""
    error: Floats | None = None
    """Reported fit error (N,) in metres; NaN where none was reported."""
    p_body_tool: Floats | None = None
    """(3,) metres: the point of the body whose position is given; None for its origin."""
    latency_ns: int = 0
    """Time from a sample to its stamp."""

    per_sample: ClassVar = ("q_ref_body", "valid", "position", "error")
    shapes: ClassVar = {
        "q_ref_body": (None, 4),
        "valid": (None,),
        "position": (None, 3),
        "error": (None,),
        "p_body_tool": (3,),
    }

    @property
    def seen(self) -> Flags:
        """(N,) as `valid`."""
        return self.valid


@dataclass(frozen=True)
class Markers(_Stream):
    """Single optical markers of one rigid tool, each in the tracker's reference frame.

    Raises
    ------
    RecordingError
        The arrays do not have one position for each marker in each frame.

    Examples
    --------
    The second marker is hidden in the second frame:

    >>> import numpy as np
    >>> import jaxekf
    >>> place = np.array([[0.0, 0.0, 0.0], [0.1, 0.0, 0.0]])
    >>> markers = jaxekf.Markers(
    ...     time_ns=np.array([0, 16_000_000]),
    ...     position=np.stack([place, place]),
    ...     visible=np.array([[True, True], [True, False]]),
    ...     names=("left", "right"),
    ...     p_body_marker=place,
    ... )
    >>> markers.usable.sum(axis=0)
    array([2, 1])
    """

    time_ns: Times
    """Stamps of the tracker's frames; a frame was taken `latency_ns` before."""
    position: Floats
    """(N, M, 3) metres in the reference frame; of a hidden marker anything."""
    visible: Flags
    """(N, M) False where a marker is hidden."""
    names: tuple[str, ...]
    """Name of each marker (M); a model has a sensor for each, ``marker_left`` for instance."""
    p_body_marker: Floats
    """(M, 3) metres: the geometry, in the body frame (the IMU's)."""
    quality: Floats | None = None
    """(N, M) as reported, larger is better; NaN where none was reported."""
    quality_min: float = 0.0
    """Markers of less quality are not used."""
    error: Floats | None = None
    """(N, M) reported fit error in metres; NaN where none was reported."""
    latency_ns: int = 0
    """Time from a frame to its stamp."""

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
        super().__post_init__()
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
    """Image points of landmarks whose positions are known, from a camera that is fixed to the body.

    Raises
    ------
    RecordingError
        There is no landmark, or the arrays do not have one image point for each landmark in each image.

    Examples
    --------
    One landmark is not found in the second image:

    >>> import numpy as np
    >>> import jaxekf
    >>> camera = jaxekf.Camera(
    ...     time_ns=np.array([0, 80_000_000]),
    ...     pixel=np.array([[[320.0, 240.0], [400.0, 240.0]], [[322.0, 240.0], [0.0, 0.0]]]),
    ...     visible=np.array([[True, True], [True, False]]),
    ...     names=("door", "window"),
    ...     p_ref_landmark=np.array([[0.0, 0.0, 2.0], [0.2, 0.0, 2.0]]),
    ...     focal=np.array([800.0, 800.0]),
    ...     centre=np.array([320.0, 240.0]),
    ... )
    >>> camera.usable.sum(axis=1)
    array([2, 1])
    """

    time_ns: Times
    """Stamps of the images; an image was taken `latency_ns` before."""
    pixel: Floats
    """(N, L, 2) image points, pixels, u to the right and v down; of a landmark that was not found
    anything."""
    visible: Flags
    """(N, L) whether the landmark was found in the image."""
    names: tuple[str, ...]
    """Name of each landmark (L)."""
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
    """Time from an image to its stamp."""

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
        super().__post_init__()
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
    """Gyroscope, and if recorded accelerometer and magnetometer, in the body frame.

    Examples
    --------
    >>> import numpy as np
    >>> import jaxekf
    >>> imu = jaxekf.load(jaxekf.demo.FOLDER / "free-5").need_imu()
    >>> imu.gyroscope.shape, imu.magnetometer is None
    ((3001, 3), True)
    >>> print(f"{1e9 / np.diff(imu.time_ns).mean():.0f} Hz for {np.ptp(imu.time_ns) / 1e9:.0f} s")
    125 Hz for 24 s
    """

    time_ns: Times
    """(N,) int64 nanoseconds, increasing."""
    gyroscope: Floats
    """Angular rate (N, 3), rad/s."""
    accelerometer: Floats | None = None
    """Specific force (N, 3), m/s^2."""
    magnetometer: Floats | None = None
    """Magnetic field (N, 3) in the sensor's unit."""

    per_sample: ClassVar = ("gyroscope", "accelerometer", "magnetometer")
    shapes: ClassVar = dict.fromkeys(per_sample, (None, 3))


@dataclass(frozen=True)
class Encoder(_Stream):
    """Truth from the robot's joints, in the tracker's reference frame: attitude, maybe position.

    Examples
    --------
    Score an estimate only from 5 s on, by the samples that are `scored`:

    >>> from dataclasses import replace
    >>> import jaxekf
    >>> jaxekf.set_up()
    >>> run = jaxekf.load(jaxekf.demo.FOLDER / "free-5")
    >>> encoder = run.need_encoder()
    >>> late = encoder.time_ns >= encoder.time_ns[0] + 5_000_000_000
    >>> run = run.replace(encoder=replace(encoder, scored=encoder.scored & late))
    >>> jaxekf.score(jaxekf.estimate(run), run).samples
    2376
    """

    time_ns: Times
    """(N,) int64 nanoseconds, increasing."""
    q_ref_body: Floats
    """Unit quaternions (N, 4), w x y z, body to reference."""
    valid: Flags
    """(N,) False where the attitude is not known."""
    scored: Flags
    """(N,) samples on which an estimate is judged."""
    position: Floats | None = None
    """(N, 3) metres: position of the body's origin in the reference frame."""
    latency_ns: int = 0
    """Time from a sample, on the IMU's clock, to its stamp."""

    per_sample: ClassVar = ("q_ref_body", "valid", "scored", "position")
    shapes: ClassVar = {
        "q_ref_body": (None, 4),
        "valid": (None,),
        "scored": (None,),
        "position": (None, 3),
    }

    @property
    def seen(self) -> Flags:
        """(N,) as `valid`."""
        return self.valid


def _check_shapes(
    label: str, stream: Any, shapes: Mapping[str, tuple[int, ...]], counted: str, hint: str
) -> None:
    for key, shape in shapes.items():
        got = np.shape(getattr(stream, key))
        if got != shape:
            raise RecordingError(label, f"{key} of shape {got}", f"{shape} for {counted}", hint)
