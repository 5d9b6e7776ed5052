"""`visual`: pose, velocity and IMU biases from landmarks in images and an IMU, both as measurements.

Choose it for a camera that sees known landmarks. It is the filter of Hol (2008), eqs. 9 (process), 11a
(accelerometer), 11b (gyroscope) and 3a or 11c (point correspondences). Acceleration and rate are states,
random walks with spectral densities here, so images and IMU may come at any rates, and either may fail.

- States (21 degrees of freedom): `position` m, `velocity` m/s, `acceleration` m/s^2 (reference frame),
  `q_ref_body` (error: rad, body frame), `rate` rad/s (body frame), `bias` rad/s,
  `accelerometer_bias` m/s^2.
- Input: none.
- Sensors: `accelerometer`, `gyroscope`, and `camera` with two rows for each of as many landmarks as an
  image has at most, see `jaxekf.filtering.model.repeated`.
- Noise: `jerk` m/s^3/sqrt(Hz), `angular_acceleration` rad/s^2/sqrt(Hz), `bias_walk` rad/s^2/sqrt(Hz),
  `accelerometer_walk` m/s^3/sqrt(Hz), `gyroscope` rad/s/sqrt(Hz), `accelerometer` m/s^2/sqrt(Hz),
  `pixel` px.
- Calibration: `lever_arm` m, `alignment` rad, `focal` 1, `centre` px, `radial` 1, `latency` s.
- Initial: one standard deviation for each state, in its unit.

The measurement is the image point (reprojection, eq. 3a). `visual_bilinear` has the thesis' eq. 11c,
``0 = (I, -z) p_camera``, in metres, z the direction of the image point; choose it only for comparison, as
the point enters the slope there, and its depth the noise.
"""

from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxekf._support.constants import GRAVITY_REF
from jaxekf._support.deprecations import renamed
from jaxekf.filtering.model import Model, Parameters, Sensor, repeated
from jaxekf.filtering.model_origin import remembered
from jaxekf.geometry import linalg, pinhole, rotation
from jaxekf.geometry.manifold import SO3, Euclidean
from jaxekf.geometry.pinhole import Lens
from jaxekf.models import _correspondences as correspondences
from jaxekf.models import _outputs, inertial, sources
from jaxekf.models._correspondences import BilinearPoint, Point
from jaxekf.pose_solvers import pnp
from jaxekf.recordings.types import Recording, Samples

GATE = 0.999
_FEWEST = 8
"""Groups of an image come in multiples of this number, so that few models are compiled."""


class State(NamedTuple):
    """The body (the IMU) in the scene."""

    position: Any
    velocity: Any
    acceleration: Any
    q_ref_body: Any
    rate: Any
    """Body frame."""
    bias: Any
    """Gyroscope bias, rad/s, body frame."""
    accelerometer_bias: Any


class Noise(NamedTuple):
    """Noise parameters: of shape (), (3,) or (3, 3), but for `pixel`, ()."""

    jerk: Any
    """Random walk of the acceleration, reference frame."""
    angular_acceleration: Any
    """Random walk of the rate, body frame."""
    bias_walk: Any
    accelerometer_walk: Any
    gyroscope: Any
    accelerometer: Any
    pixel: Any
    """Standard deviation of an image point per axis; a reported one is added."""


class Calibration(NamedTuple):
    """Deterministic parameters: corrections of the camera's stated parameters."""

    lever_arm: Any
    """Correction of the camera's position in the body, m, body frame; (3,)."""
    alignment: Any
    """Rotation vector from the stated to the actual camera frame, rad, camera frame; (3,)."""
    focal: Any
    """Factors of the focal lengths; (2,)."""
    centre: Any
    """Correction of the principal point, pixels; (2,)."""
    radial: Any
    """Correction of the radial distortion; (2,)."""
    latency: Any
    """Seconds by which images are older than stated; ()."""


class Initial(NamedTuple):
    """Standard deviations of the initial state."""

    position: Any
    """About the pose of the first image, which is then used as a measurement, too: keep it and the attitude
    large, but not so large that mismatches fit."""
    velocity: Any
    acceleration: Any
    attitude: Any
    rate: Any
    bias: Any
    accelerometer_bias: Any


class Setup(NamedTuple):
    """Constants of a recording."""

    gravity_ref: Any
    """(3,) gravity vector in the scene, m/s^2."""
    focal: Any
    centre: Any
    radial: Any
    p_body_camera: Any
    """(3,) metres."""
    q_body_camera: Any
    """(4,)"""


SPACE: Any = State(
    Euclidean(3, "m", frame="reference"),
    Euclidean(3, "m/s", frame="reference"),
    Euclidean(3, "m/s^2", frame="reference"),
    SO3(),
    Euclidean(3, "rad/s"),
    Euclidean(3, "rad/s"),
    Euclidean(3, "m/s^2"),
)


def transition(x: State, u: Any, dt: Array, w: Array, params: Parameters) -> State:
    """Eqs. 9: position, velocity and attitude are integrated, the other states are random walks.

    ``w`` holds the changes of acceleration, rate and both biases. Their effect on position, velocity and
    attitude during the step is that of a change at constant speed.
    """
    acceleration_change, rate_change = w[:3], w[3:6]
    return State(
        x.position + (x.velocity + (x.acceleration / 2.0 + acceleration_change / 6.0) * dt) * dt,
        x.velocity + (x.acceleration + acceleration_change / 2.0) * dt,
        x.acceleration + acceleration_change,
        SO3().retract(x.q_ref_body, (x.rate + rate_change / 2.0) * dt),
        x.rate + rate_change,
        x.bias + w[6:9],
        x.accelerometer_bias + w[9:],
    )


def process_noise(params: Parameters, dt: Array) -> Array:
    """Covariance (12, 12) of the changes of acceleration, rate, and both biases over ``dt``."""
    noise = params.noise
    return dt * linalg.block_covariance(
        (noise.jerk, noise.angular_acceleration, noise.bias_walk, noise.accelerometer_walk)
    )


def predict_gyroscope(x: State, u: Any, params: Parameters, aux: Any) -> Array:
    """Eq. 11b: rate plus bias (3,), rad/s."""
    return x.rate + x.bias


def predict_accelerometer(x: State, u: Any, params: Parameters, aux: Any) -> Array:
    """Eq. 11a: acceleration minus gravity in the body frame, plus bias (3,), m/s^2."""
    force = x.acceleration - params.setup.gravity_ref
    return rotation.rotate_inverse(x.q_ref_body, force) + x.accelerometer_bias


def lens_of(params: Parameters) -> Lens:
    """The camera's intrinsic parameters, corrected."""
    setup, more = params.setup, params.calibration
    return Lens(setup.focal * more.focal, setup.centre + more.centre, setup.radial + more.radial)


def in_camera(x: State, params: Parameters, p_ref_landmark: Array) -> Array:
    """Eq. 3b: a landmark (3,) in the camera frame, m, at the time of the image."""
    setup, more = params.setup, params.calibration
    back = -more.latency
    position = x.position + (x.velocity + 0.5 * x.acceleration * back) * back
    attitude = SO3().retract(x.q_ref_body, x.rate * back)
    in_body = rotation.rotate_inverse(attitude, p_ref_landmark - position)
    turn = rotation.product(setup.q_body_camera, rotation.exp(more.alignment))
    return rotation.rotate_inverse(turn, in_body - setup.p_body_camera - more.lever_arm)


def predict_point(x: State, u: Any, params: Parameters, aux: Point) -> Array:
    """Eq. 3a: the image point (2,) of a landmark, pixels."""
    return pinhole.project(lens_of(params), in_camera(x, params, aux.p_ref_landmark))


def point_noise(params: Parameters, aux: Point, dt: Array) -> Array:
    """Covariance (2, 2), pixels squared."""
    return (params.noise.pixel**2 + aux.sigma**2) * jnp.eye(2)


def predict_bilinear(x: State, u: Any, params: Parameters, aux: BilinearPoint) -> Array:
    """Eq. 11c: offset (2,), m, of the landmark from the ray of its image point."""
    p = in_camera(x, params, aux.p_ref_landmark)
    return p[:2] - pinhole.ray(lens_of(params), aux.pixel) * p[2]


def bilinear_noise(params: Parameters, aux: BilinearPoint, dt: Array) -> Array:
    """Covariance (2, 2), m^2: that of the image point at the landmark's depth."""
    slope = jax.jacfwd(partial(pinhole.ray, lens_of(params)))(aux.pixel)
    variance = params.noise.pixel**2 + aux.sigma**2
    return variance * aux.depth**2 * linalg.multiply_transposed(slope, slope)


def _density(name: str, params: Parameters, aux: Any, dt: Array) -> Array:
    return linalg.covariance(getattr(params.noise, name), 3) / dt


def accelerometer(recording: Recording) -> Samples:
    """The accelerometer's specific force (N, 3), m/s^2, body frame."""
    both = sources.imu(recording)
    return Samples(both.time_ns, both.value[:, 3:], both.mask, origin=both.origin)


def setup(recording: Recording) -> Setup:
    """The camera as stated, and gravity: stated, or estimated from images and accelerometer."""
    stream = recording.need_camera()
    turn = np.asarray(stream.q_body_camera, float)
    return Setup(
        inertial.gravity(recording, lambda: pnp.as_optical(stream)),
        np.asarray(stream.focal, float),
        np.asarray(stream.centre, float),
        np.asarray(stream.radial, float),
        np.asarray(stream.p_body_camera, float),
        turn / np.linalg.norm(turn),
    )


def initial_mean(first: Mapping[str, Any]) -> State:
    """State of the start (at rest at the origin without one), zero biases."""
    return inertial.state_from(State, first)


def adapt(bilinear: bool, recordings: Sequence[Recording]) -> Model:
    """The model for the largest number of landmarks in an image of these recordings."""
    most = max((int(r.need_camera().usable.sum(axis=1).max()) for r in recordings), default=1)
    return for_points(-(-max(most, 1) // _FEWEST) * _FEWEST, bilinear)


@remembered
def for_points(count: int, bilinear: bool = False) -> Model:
    """The model for images of up to `count` landmarks; the same object for the same numbers."""
    return _build(count, bilinear)


DEFAULTS = Parameters(
    Noise(
        jerk=3.0,
        angular_acceleration=1.0,
        bias_walk=np.deg2rad(0.002),
        accelerometer_walk=1e-3,
        gyroscope=np.deg2rad(0.05),
        accelerometer=2e-2,
        pixel=0.7,
    ),
    Calibration(
        lever_arm=np.zeros(3),
        alignment=np.zeros(3),
        focal=np.ones(2),
        centre=np.zeros(2),
        radial=np.zeros(2),
        latency=np.array(0.0),
    ),
    Initial(
        position=correspondences.START_POSITION,
        velocity=1.0,
        acceleration=1.0,
        attitude=correspondences.START_ATTITUDE,
        rate=0.2,
        bias=np.deg2rad(1.0),
        accelerometer_bias=0.2,
    ),
    Setup(
        np.array(GRAVITY_REF),
        np.array([213.0, 213.0]),
        np.array([160.0, 120.0]),
        np.zeros(2),
        np.zeros(3),
        np.array([1.0, 0.0, 0.0, 0.0]),
    ),
)

UNITS = Parameters(
    Noise(
        "m/s^3/sqrt(Hz)",
        "rad/s^2/sqrt(Hz)",
        "rad/s^2/sqrt(Hz)",
        "m/s^3/sqrt(Hz)",
        "rad/s/sqrt(Hz)",
        "m/s^2/sqrt(Hz)",
        "px",
    ),
    Calibration("m", "rad", "1", "px", "1", "s"),
    Initial("m", "m/s", "m/s^2", "rad", "rad/s", "rad/s", "m/s^2"),
)

OUTPUTS = (
    _outputs.POSITION,
    _outputs.ATTITUDE,
    _outputs.VELOCITY,
    _outputs.rate(_outputs.rate_state),
)


def _imu_sensor(name: str, unit: str, predict: Any, source: Any) -> Sensor:
    return Sensor(name, Euclidean(3, unit), predict, partial(_density, name), source)


def _point(count: int, bilinear: bool) -> Sensor:
    """One correspondence."""
    place = np.array([0.0, 0.0, 2.0])
    like: Any = Point(place, 0.0)
    if bilinear:
        like = BilinearPoint(place, 0.0, np.array([160.0, 120.0]), 2.0)
    return Sensor(
        "camera",
        Euclidean(2, "m" if bilinear else "px"),
        predict_bilinear if bilinear else predict_point,
        bilinear_noise if bilinear else point_noise,
        partial(correspondences.camera, count, bilinear),
        gate=GATE,
        typical_aux=like,
    )


def _build(count: int, bilinear: bool) -> Model:
    labels = [f"{axis}{i}" for i in range(count) for axis in "uv"]
    return Model(
        name="visual_bilinear" if bilinear else "visual",
        summary="pose, velocity and IMU biases from landmarks in images and an IMU"
        + (", correspondences as published" if bilinear else ""),
        space=SPACE,
        transition=transition,
        process_noise=process_noise,
        sensors=(
            _imu_sensor("accelerometer", "m/s^2", predict_accelerometer, accelerometer),
            _imu_sensor("gyroscope", "rad/s", predict_gyroscope, sources.gyroscope),
            repeated(_point(count, bilinear), count, labels),
        ),
        parameters=DEFAULTS,
        units=UNITS,
        noise_dims=Noise(3, 3, 3, 3, 3, 3, 1),
        initial_mean=initial_mean,
        initial_covariance=inertial.initial_covariance,
        find_start=correspondences.find_start,
        adapt=partial(adapt, bilinear),
        setup=setup,
        outputs=OUTPUTS,
    )


MODEL = for_points(_FEWEST)
"""The model for eight landmarks in an image; `adapt` makes the one for a recording."""
BILINEAR = for_points(_FEWEST, True)


__getattr__ = renamed(__name__, "SeenPoint>BilinearPoint")
