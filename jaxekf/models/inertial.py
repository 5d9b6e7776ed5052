"""Strapdown state and prediction shared by `tight` and `loose_pose`; not a model by itself.

The equations are those of Tobergte, Pomarlan, Hirzinger (2009), eqs. 18 to 22, in the conventions of this
package: the body is the IMU's frame, attitude errors act on the right, gravity is the free-fall
acceleration. Corrections: eq. 19 multiplies by ``[0, t_s w]`` instead of the exponential, and eqs. 21 and
22 have no noise; here biases are random walks.

- States (15 degrees of freedom): `position` m and `velocity` m/s (reference frame), `q_ref_body` (error:
  rad, body frame), `bias` rad/s, `accelerometer_bias` m/s^2.
- Input: gyroscope rad/s and accelerometer m/s^2, body frame.
- Calibration: `latency` s, `lever_arm` m, `alignment` rad, `clock_drift` s/s, `gyroscope_matrix`,
  `accelerometer_matrix`.
- Initial: one standard deviation for each state, in its unit.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxekf._support.constants import GRAVITY_REF
from jaxekf._support.deprecations import renamed
from jaxekf.filtering.interpolation import InputSample
from jaxekf.filtering.model import Output, Parameters
from jaxekf.geometry import linalg, rotation
from jaxekf.geometry.manifold import SO3, Euclidean
from jaxekf.models import _outputs
from jaxekf.pose_solvers import marker_pose
from jaxekf.recordings.types import Floats, Optical, Recording


class State(NamedTuple):
    """The IMU in the tracker's reference frame, and its sensor biases."""

    position: Any
    q_ref_body: Any
    velocity: Any
    bias: Any
    """Gyroscope bias, rad/s, body frame."""
    accelerometer_bias: Any


class Initial(NamedTuple):
    """Standard deviations of the initial state."""

    position: Any
    """About the first pose, which is then used as a measurement, too: keep it and the attitude large."""
    attitude: Any
    velocity: Any
    bias: Any
    """About zero."""
    accelerometer_bias: Any
    """About zero."""


class Calibration(NamedTuple):
    """Deterministic parameters: corrections of the values stated in a recording."""

    latency: Any
    """Seconds by which the tracker's samples are older than stated; ()."""
    lever_arm: Any
    """Correction of the tool frame's position in the body, m, body frame; (3,)."""
    alignment: Any
    """Rotation vector from the stated to the actual tool frame, rad, body frame; (3,)."""
    clock_drift: Any = 0.0
    """Seconds that the IMU's clock gains on the tracker's per second; ()."""
    gyroscope_matrix: Any = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
    """Scale, non-orthogonality and alignment, ``rate = gyroscope_matrix @ measured - bias``, (3, 3)."""
    accelerometer_matrix: Any = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
    """The same for the accelerometer, whose frame should be the gyroscope's, (3, 3)."""


class Setup(NamedTuple):
    """Constants of a recording."""

    gravity_ref: Any
    """(3,) gravity vector in the reference frame, m/s^2."""
    p_body_object: Any
    """(3,) metres: the point of the tool whose pose is an output."""
    q_body_object: Any
    """(4,) object to body: the frame of the tool whose attitude is an output."""


SPACE: Any = State(
    _outputs.METRES,
    SO3(),
    _outputs.METRES_PER_SECOND,
    Euclidean(3, "rad/s"),
    Euclidean(3, "m/s^2"),
)

INITIAL = Initial(
    position=0.01,
    attitude=np.deg2rad(5.0),
    velocity=0.3,
    bias=np.deg2rad(1.0),
    accelerometer_bias=0.2,
)
INITIAL_UNITS = Initial("m", "rad", "m/s", "rad/s", "m/s^2")

CALIBRATION = Calibration(
    latency=np.array(0.0),
    lever_arm=np.zeros(3),
    alignment=np.zeros(3),
    clock_drift=np.array(0.0),
    gyroscope_matrix=np.eye(3),
    accelerometer_matrix=np.eye(3),
)
CALIBRATION_UNITS = Calibration("s", "m", "rad", "s/s", "1", "1")

SETUP = Setup(np.array(GRAVITY_REF), np.zeros(3), np.array([1.0, 0.0, 0.0, 0.0]))


def transition(x: State, u: InputSample, dt: Array, w: Array, params: Parameters) -> State:
    """Strapdown integration by mean rate and specific force over ``dt``, both constant in the body frame.

    While the body rotates by ``theta`` the force rotates with it: its integrals over the step are, up to
    ``theta^3``,

        (f + theta x f / 2 + theta x (theta x f) / 6) dt
        (f / 2 + theta x f / 6 + theta x (theta x f) / 24) dt^2

    ``w`` holds noise of angle and velocity, and the changes of both biases.
    """
    force = params.calibration.accelerometer_matrix @ u.mean[3:] - x.accelerometer_bias
    turn = _rate(x, u.mean, params) * dt
    once = rotation.cross(turn, force)
    twice = rotation.cross(turn, once)
    gained = (force + once / 2.0 + twice / 6.0) * dt + w[3:6]
    moved = (force / 2.0 + once / 6.0 + twice / 24.0) * dt * dt + 0.5 * dt * w[3:6]
    fall = params.setup.gravity_ref * dt
    return State(
        x.position + (x.velocity + 0.5 * fall) * dt + rotation.rotate(x.q_ref_body, moved),
        SO3().retract(x.q_ref_body, turn + w[:3]),
        x.velocity + fall + rotation.rotate(x.q_ref_body, gained),
        x.bias + w[6:9],
        x.accelerometer_bias + w[9:],
    )


def process_noise(params: Parameters, dt: Array) -> Array:
    """Covariance (12, 12) of angle, velocity and bias noise over ``dt``, in the IMU's axes."""
    noise = params.noise
    return dt * linalg.block_covariance(
        (noise.gyroscope, noise.accelerometer, noise.bias_walk, noise.accelerometer_walk)
    )


def initial_covariance(params: Parameters) -> Array:
    """Covariance (3n, 3n) of n independent parts of three components each."""
    return linalg.block_covariance(params.initial)


def initial_mean(first: Any) -> State:
    """Pose and velocity of the start (the origin without any), zero biases."""
    return state_from(State, first)


def state_from(kind: Any, first: Any) -> Any:
    """A state of the values in `first` by name; without one the identity for the attitude, else zero."""
    blank = dict.fromkeys(kind._fields, jnp.zeros(3)) | {"q_ref_body": rotation.identity()}
    return kind(*(jnp.asarray(first.get(name, value)) for name, value in blank.items()))


def gravity(recording: Recording, raw: Callable[[], Optical]) -> Floats:
    """Gravity vector (3,), m/s^2, reference frame: stated, or estimated from the poses `raw()`."""
    stated = recording.info.get("gravity_ref")
    if stated is None:
        stated = marker_pose.gravity(raw(), recording.need_imu(), recording.path or recording.name)
    return np.asarray(stated, float)


def setup(recording: Recording, raw: Callable[[], Optical]) -> Setup:
    """Gravity and object frame of a recording; gravity is estimated from `raw()` if it is not stated."""
    info = recording.info
    frame = np.asarray(info.get("q_body_object", SETUP.q_body_object), float)
    return Setup(
        gravity(recording, raw),
        np.asarray(info.get("p_body_object", SETUP.p_body_object), float),
        frame / np.linalg.norm(frame),
    )


def clock_offset(params: Parameters) -> Array:
    """Offset () of the IMU's clock for the tracker's time: minus the latency, s."""
    return -params.calibration.latency


def clock_drift(params: Parameters) -> Array:
    """Seconds () that the IMU's clock gains per second."""
    return params.calibration.clock_drift


def _rate(x: State, measured: Array, params: Parameters) -> Array:
    return params.calibration.gyroscope_matrix @ measured[:3] - x.bias


def _object_position(x: State, u: InputSample, params: Parameters) -> Array:
    return x.position + rotation.rotate(x.q_ref_body, params.setup.p_body_object)


def _object_attitude(x: State, u: InputSample, params: Parameters) -> Array:
    return rotation.product(x.q_ref_body, params.setup.q_body_object)


def _object_velocity(x: State, u: InputSample, params: Parameters) -> Array:
    lever_velocity = rotation.cross(_rate(x, u.value, params), params.setup.p_body_object)
    return x.velocity + rotation.rotate(x.q_ref_body, lever_velocity)


def rate_noise(u: InputSample, params: Parameters) -> Array:
    """Covariance (3, 3), (rad/s)^2, of the rate output by the gyroscope's own noise."""
    return linalg.covariance(params.noise.gyroscope, 3) * u.bandwidth


def _object_velocity_noise(u: InputSample, params: Parameters) -> Array:
    """Upper bound of the covariance (3, 3) of the object's velocity by the gyroscope's own noise.

    It is isotropic, as the attitude is not known here.
    """
    arm = params.setup.p_body_object
    each = linalg.diagonal(rate_noise(u, params))
    return jnp.sum(arm * arm) * jnp.max(each) * jnp.eye(3)


__getattr__ = renamed(
    __name__,
    "STANDARD_GRAVITY>GRAVITY_REF block_diagonal>jaxekf.geometry.linalg.block_diagonal",
)


OUTPUTS = (
    _outputs.POSITION,
    _outputs.ATTITUDE,
    _outputs.VELOCITY,
    _outputs.rate_of_reading(_rate, rate_noise),
    Output(
        "object_position",
        _outputs.METRES,
        "reference",
        _object_position,
    ),
    Output(
        "object_attitude",
        SO3(),
        "object",
        _object_attitude,
    ),
    Output(
        "object_velocity",
        _outputs.METRES_PER_SECOND,
        "reference",
        _object_velocity,
        _object_velocity_noise,
    ),
)
