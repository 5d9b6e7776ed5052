"""`tight`: pose, velocity and IMU biases from single markers and an IMU, tightly coupled.

Choose it for a tracker that reports single markers: with two visible markers, one, or for a while none, the
pose is still estimated. It is the filter of Tobergte, Pomarlan, Hirzinger (2009), eqs. 16 to 23; each
marker is a sensor of its own, used at the time of its measurement.

- States (15 degrees of freedom), input, calibration and initial deviations: those of `inertial`.
- Sensors: `marker_NAME` for each marker, its position (m, reference frame; eq. 23).
- Noise: `gyroscope` rad/s/sqrt(Hz), `accelerometer` m/s^2/sqrt(Hz), `bias_walk` rad/s^2/sqrt(Hz),
  `accelerometer_walk` m/s^3/sqrt(Hz), `marker` m.
"""

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxekf._support.constants import STANDARD_GRAVITY
from jaxekf.filtering.model import Input, Model, Parameters, Sensor, Start
from jaxekf.filtering.model_origin import remembered
from jaxekf.geometry import linalg, rotation
from jaxekf.geometry.manifold import Euclidean
from jaxekf.models import inertial, sources
from jaxekf.pose_solvers import marker_pose
from jaxekf.recordings.types import NANOSECONDS, Recording, Samples

GATE = 0.999


class Noise(NamedTuple):
    """Noise parameters: each of shape (), (3,) or a lower-triangular factor (3, 3)."""

    gyroscope: Any
    accelerometer: Any
    bias_walk: Any
    """Random walk of the gyroscope's bias."""
    accelerometer_walk: Any
    marker: Any
    """Standard deviation of a sample of a marker's position, reference frame; a reported fit error is
    added."""


class Setup(NamedTuple):
    """Constants of a recording; further fields as in `inertial.Setup`."""

    gravity_ref: Any
    p_body_object: Any
    q_body_object: Any
    p_body_marker: Any
    """(M, 3) metres: the markers in the body frame, in the order of the model's sensors."""


def arm(index: int, params: Parameters) -> Array:
    """Position of a marker in the body frame (3,), m."""
    stated = params.setup.p_body_marker[index]
    rotated = rotation.rotate(rotation.exp(params.calibration.alignment), stated)
    return params.calibration.lever_arm + rotated


def _predict(index: int, x: inertial.State, u: Any, params: Parameters, aux: Any) -> Array:
    """Eq. 23: the body's position plus the marker's arm, in the reference frame, (3,) m."""
    return x.position + rotation.rotate(x.q_ref_body, arm(index, params))


def marker_noise(params: Parameters, aux: Any, dt: Array) -> Array:
    """Covariance (3, 3) of a marker's sample, m^2, reference frame; `aux` is its reported error."""
    return linalg.covariance(params.noise.marker, 3) + aux * aux * jnp.eye(3)


def sensor_name(marker: str) -> str:
    """Name of a marker's sensor."""
    return f"marker_{marker}"


def _source(name: str, recording: Recording) -> Samples:
    """A marker's positions (N, 3); masked everywhere if the recording does not have the marker."""
    markers = sources.single_markers(recording)
    count = len(markers.time_ns)
    taken = markers.time_ns - markers.latency_ns
    if name not in markers.names:
        never = np.zeros(count, bool)
        return Samples(taken, np.zeros((count, 3)), never, np.zeros(count), markers.latency_ns)
    at = markers.names.index(name)
    usable = markers.usable[:, at]
    error = np.zeros(count) if markers.error is None else np.nan_to_num(markers.error[:, at])
    position = np.where(usable[:, None], markers.position[:, at], 0.0)
    return Samples(taken, position, usable, error, markers.latency_ns, ("markers", name))


def _setup(names: tuple[str, ...], recording: Recording) -> Setup:
    markers = sources.single_markers(recording)
    places = dict(zip(markers.names, markers.p_body_marker, strict=True))
    # A marker that this recording does not have is always masked: its place does not matter.
    arms = np.array([places.get(name, np.zeros(3)) for name in names], float)
    return Setup(*inertial.setup(recording, partial(marker_pose.from_markers, markers)), arms)


def find_start(recording: Recording, samples: Mapping[str, Samples]) -> Start | None:
    """The first frame whose markers give a pose (three, not collinear); earlier samples are dropped."""
    times = next(iter(samples.values())).time_ns
    markers = sources.single_markers(recording)
    fit = marker_pose.fit_markers(markers, recording.path or recording.name)
    raw = marker_pose.from_markers(markers, fit)
    inside = np.isin(raw.time_ns - raw.latency_ns, times)
    valid = raw.valid & inside
    if not valid.any() or raw.position is None:
        return None
    valid &= fit.error <= marker_pose.START_FIT * np.median(fit.error[valid])
    first = int(np.argmax(valid))
    taken = raw.time_ns - raw.latency_ns
    waited = (taken[first] - times[0]) / NANOSECONDS
    note = ""
    if waited > 0.0:
        note = (
            f"waited {waited:.3f} s for a frame with three markers, not collinear, to start from;"
            f" {int((taken[inside] < taken[first]).sum())} frames before it are not used"
        )
    known = {
        "position": raw.position[first],
        "q_ref_body": raw.q_ref_body[first],
        "velocity": marker_pose.velocity_at(taken, raw.position, valid, first),
    }
    return Start(int(taken[first]), known, note)


def adapt(recordings: Sequence[Recording]) -> Model:
    """The model with a sensor for every marker of these recordings."""
    names: dict[str, None] = {}
    for recording in recordings:
        names |= dict.fromkeys(sources.single_markers(recording).names)
    return for_markers(tuple(names)) if names else MODEL


@remembered
def for_markers(names: tuple[str, ...]) -> Model:
    """The model for markers of these names; the same object for the same names."""
    params = DEFAULTS
    if len(names) != len(L_SHAPE):
        places = np.zeros((len(names), 3))
        places[: len(L_SHAPE)] = L_SHAPE[: len(names)]
        params = DEFAULTS._replace(setup=DEFAULTS.setup._replace(p_body_marker=places))
    return _build(names, params)


def _sensor(index: int, name: str) -> Sensor:
    predict: Callable[..., Any] = partial(_predict, index)
    source = partial(_source, name)
    space = Euclidean(3, "m", frame="reference")
    return Sensor(
        sensor_name(name), space, predict, marker_noise, source, gate=GATE, typical_aux=0.0
    )


L_SHAPE = np.array([[0.0, 0.0, 0.0], [0.1, 0.0, 0.0], [0.0, 0.1, 0.0]])
"""The paper's tool: markers on an L with legs of 10 cm, the IMU at its corner."""

DEFAULTS = Parameters(
    Noise(
        gyroscope=np.deg2rad(0.05),
        accelerometer=1.85e-3 * STANDARD_GRAVITY,
        bias_walk=np.deg2rad(0.002),
        accelerometer_walk=1e-3,
        marker=0.25e-3,
    ),
    inertial.CALIBRATION,
    inertial.INITIAL,
    Setup(*inertial.SETUP, L_SHAPE),
)

UNITS = Parameters(
    Noise("rad/s/sqrt(Hz)", "m/s^2/sqrt(Hz)", "rad/s^2/sqrt(Hz)", "m/s^3/sqrt(Hz)", "m"),
    inertial.CALIBRATION_UNITS,
    inertial.INITIAL_UNITS,
)


def _build(names: tuple[str, ...], params: Parameters) -> Model:
    return Model(
        name="tight",
        summary="pose, velocity and IMU biases from single markers and an IMU",
        space=inertial.SPACE,
        transition=inertial.transition,
        process_noise=inertial.process_noise,
        sensors=tuple(_sensor(i, name) for i, name in enumerate(names)),
        parameters=params,
        units=UNITS,
        noise_dims=Noise(3, 3, 3, 3, 3),
        initial_mean=inertial.initial_mean,
        initial_covariance=inertial.initial_covariance,
        find_start=find_start,
        adapt=adapt,
        setup=partial(_setup, names),
        input=Input("imu", sources.imu, inertial.clock_offset, inertial.clock_drift),
        outputs=inertial.OUTPUTS,
    )


MODEL = for_markers(("1", "2", "3"))
"""The model for three markers; `adapt` makes the one for a recording."""
