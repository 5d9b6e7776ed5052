"""`visual`: pose from landmarks in images and an IMU, both of them measurements.

The filter of Hol (2008): 22 numbers, 21 degrees of freedom, eqs. 9 (process), 11a (accelerometer), 11b
(gyroscope) and 3a or 11c (point correspondences). The state carries acceleration and rate, which are
random walks here with spectral densities; so images and IMU may come at any rates, and either may fail.

A camera's sample has one group of two rows for each of as many landmarks as an image has at most; see
`jaxekf.filtering.model.repeated`. The measurement is the image point itself (reprojection).
`visual_bilinear` has the thesis' 11c: ``0 = (I, -z) p_camera``, in metres, z the direction of the image
point; there the point goes into the slope, and its depth into the noise.
"""

from collections.abc import Mapping, Sequence
from functools import lru_cache, partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxekf._support.constants import GRAVITY_REF
from jaxekf.filtering.model import Model, Output, Parameters, Sensor, repeated
from jaxekf.geometry import linalg, pinhole, rotation
from jaxekf.geometry.manifold import SO3, Euclidean
from jaxekf.geometry.pinhole import Lens
from jaxekf.models import _correspondences as correspondences
from jaxekf.models import inertial, sources
from jaxekf.models._correspondences import BilinearPoint, Point
from jaxekf.pose_solvers import pnp
from jaxekf.recordings.types import Recording, Samples

GATE = 0.999
_FEWEST = 8
"""Groups of an image that a model has at least; it has a multiple of them, so that few are compiled."""


class State(NamedTuple):
    """The body (the IMU) in the scene."""

    position: Any
    velocity: Any
    acceleration: Any
    q_ref_body: Any
    rate: Any
    """Body frame."""
    bias: Any
    """Of the gyroscope."""
    accelerometer_bias: Any


class Noise(NamedTuple):
    """What is random: leaves of shape (), (3,) or (3, 3), but for `pixel`, ()."""

    jerk: Any
    """Random walk of the acceleration, reference frame."""
    angular_acceleration: Any
    """Random walk of the rate, body frame."""
    bias_walk: Any
    accelerometer_walk: Any
    gyroscope: Any
    accelerometer: Any
    pixel: Any
    """Standard deviation of an image point in each direction; a reported one adds to it."""


class Calibration(NamedTuple):
    """Corrections of what a recording states of its camera."""

    lever_arm: Any
    """Metres from where the camera is said to be in the body to where it is, body frame; (3,)."""
    alignment: Any
    """Rotation vector from the camera's frame as it is said to be to what it is, camera frame; (3,)."""
    focal: Any
    """Factors of the focal lengths; (2,)."""
    centre: Any
    """Pixels to add to the image point of the axis; (2,)."""
    radial: Any
    """To add to the radial distortion; (2,)."""
    latency: Any
    """Seconds that images are older than they are said to be; ()."""


class Initial(NamedTuple):
    """Standard deviations of the belief a run starts from."""

    position: Any
    """About the pose of the first image, which is then used as a measurement: keep it and the attitude
    wide, but not so wide that mismatches fit."""
    velocity: Any
    acceleration: Any
    attitude: Any
    rate: Any
    bias: Any
    accelerometer_bias: Any


class Setup(NamedTuple):
    """What a recording tells of its run."""

    gravity_ref: Any
    """(3,) free fall in the scene, m/s^2."""
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
    """Eqs. 9: position, velocity and attitude carried on, all else a random walk.

    ``w`` holds the changes of acceleration, rate and both biases. What they add to position, velocity and
    attitude on the way is that of a change at a constant speed.
    """
    jump, swing = w[:3], w[3:6]
    return State(
        x.position + (x.velocity + (x.acceleration / 2.0 + jump / 6.0) * dt) * dt,
        x.velocity + (x.acceleration + jump / 2.0) * dt,
        x.acceleration + jump,
        SO3().retract(x.q_ref_body, (x.rate + swing / 2.0) * dt),
        x.rate + swing,
        x.bias + w[6:9],
        x.accelerometer_bias + w[9:],
    )


def process_noise(params: Parameters, dt: Array) -> Array:
    """Covariance (12, 12) of the changes of acceleration, rate, and both biases over ``dt``."""
    noise = params.noise
    densities = (
        noise.jerk,
        noise.angular_acceleration,
        noise.bias_walk,
        noise.accelerometer_walk,
    )
    return dt * linalg.block_diagonal([linalg.covariance(d, 3) for d in densities])


def predict_gyroscope(x: State, u: Any, params: Parameters, aux: Any) -> Array:
    """Eq. 11b."""
    return x.rate + x.bias


def predict_accelerometer(x: State, u: Any, params: Parameters, aux: Any) -> Array:
    """Eq. 11a: what acceleration and gravity are in the body."""
    force = x.acceleration - params.setup.gravity_ref
    return rotation.rotate_inverse(x.q_ref_body, force) + x.accelerometer_bias


def lens_of(params: Parameters) -> Lens:
    """The camera's lens as stated and corrected."""
    setup, more = params.setup, params.calibration
    return Lens(setup.focal * more.focal, setup.centre + more.centre, setup.radial + more.radial)


def in_camera(x: State, params: Parameters, p_ref_landmark: Array) -> Array:
    """Eq. 3b: a landmark (3,) in the camera's frame, metres, when the image was taken."""
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
    """Eq. 11c: how far (2,), metres, the landmark lies off the ray of its image point, beside the axis."""
    p = in_camera(x, params, aux.p_ref_landmark)
    return p[:2] - pinhole.ray(lens_of(params), aux.pixel) * p[2]


def bilinear_noise(params: Parameters, aux: BilinearPoint, dt: Array) -> Array:
    """Covariance (2, 2), metres squared: that of the image point at the landmark's depth."""
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
    """The camera as stated, and gravity: stated, or found from images and accelerometer."""
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
    """What was found at the start (at the origin, at rest, where it was not), no biases."""
    zero = jnp.zeros(3)
    return State(
        jnp.asarray(first.get("position", zero)),
        jnp.asarray(first.get("velocity", zero)),
        jnp.asarray(first.get("acceleration", zero)),
        jnp.asarray(first.get("q_ref_body", rotation.identity())),
        jnp.asarray(first.get("rate", zero)),
        zero,
        zero,
    )


def adapt(bilinear: bool, recordings: Sequence[Recording]) -> Model:
    """The model for as many landmarks as an image of these recordings has at most."""
    most = max((int(r.need_camera().usable.sum(axis=1).max()) for r in recordings), default=1)
    return for_points(-(-max(most, 1) // _FEWEST) * _FEWEST, bilinear)


@lru_cache(maxsize=32)
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
    Output(
        "position",
        Euclidean(3, "m", frame="reference"),
        "reference",
        lambda x, u, params: x.position,
    ),
    Output("attitude", SO3(), "body", lambda x, u, params: x.q_ref_body),
    Output(
        "velocity",
        Euclidean(3, "m/s", frame="reference"),
        "reference",
        lambda x, u, params: x.velocity,
    ),
    Output("rate", Euclidean(3, "rad/s"), "body", lambda x, u, params: x.rate),
)


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
        aux_like=like,
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
            Sensor(
                "accelerometer",
                Euclidean(3, "m/s^2"),
                predict_accelerometer,
                partial(_density, "accelerometer"),
                accelerometer,
            ),
            Sensor(
                "gyroscope",
                Euclidean(3, "rad/s"),
                predict_gyroscope,
                partial(_density, "gyroscope"),
                sources.gyroscope,
            ),
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
"""For eight landmarks in an image; `adapt` makes the one that a recording needs."""
BILINEAR = for_points(_FEWEST, True)
