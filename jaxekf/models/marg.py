"""`marg`: attitude from gyroscope, accelerometer and magnetometer alone.

Choose it without a tracker, if the body accelerates or the magnetic field is disturbed. It improves on the
filter of Ang, Khosla and Riviere (`triad`) in three ways, each with parameters that a tuner can set:

- The accelerometer does not measure gravity: it is an input, integrated to a velocity, and a
  *pseudo-measurement* states that the velocity is near zero. This is a low-pass in Kalman form, with order
  and corner frequency set by the noise, from which the direction of gravity follows.
- The magnetometer measures a direction (in units of the field's strength) whose noise grows with the errors
  of norm and dip, since a disturbed field mostly differs in one of them.
- At rest the gyroscope measures its bias.

- States (12 degrees of freedom): `q_ref_body` (error: rad, body frame), `velocity` m/s (reference frame),
  `bias` rad/s, `scale` (gyroscope scale error, 1).
- Input: gyroscope rad/s and accelerometer m/s^2, body frame.
- Sensors: `magnetometer` (field direction), `velocity` (pseudo-measurement of zero), `rest` (bias).
- Noise: `gyroscope` rad/s/sqrt(Hz), `bias_walk` rad/s^2/sqrt(Hz), `accelerometer` m/s^2/sqrt(Hz),
  `velocity` m/s/sqrt(Hz), `rest` rad/s/sqrt(Hz), `magnetometer` 1/sqrt(Hz), `norm` 1/sqrt(Hz),
  `dip` 1/rad/sqrt(Hz).
- Calibration: `gyroscope_matrix`, `accelerometer_bias` m/s^2, `clock_offset` s, `magnetometer_lag` s,
  `declination` rad.
- Initial: `attitude` rad, `velocity` m/s, `bias` rad/s, `scale` 1.
"""

from collections.abc import Mapping
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxekf.filtering.interpolation import InputSample
from jaxekf.filtering.model import Input, Model, Parameters, Sensor, Start
from jaxekf.geometry import linalg, rotation
from jaxekf.geometry.manifold import SO3, Euclidean
from jaxekf.models import _earth as earth
from jaxekf.models import _outputs, inertial, sources
from jaxekf.pose_solvers import tilt
from jaxekf.recordings.types import NANOSECONDS, Recording, Samples

START_S = 0.1
"""Seconds whose mean specific force gives the initial attitude."""
LEAST_SINE = 0.05
"""Smallest sine of the angle between force and field at the start: a nearly vertical field gives no
heading."""


class State(NamedTuple):
    """Attitude and velocity in the reference frame, and errors of the gyroscope."""

    q_ref_body: Any
    velocity: Any
    bias: Any
    scale: Any
    """Scale error of the gyroscope's axes."""


class Noise(NamedTuple):
    """Noise parameters: of shape () or, but for the magnetometer's, (3,) or (3, 3)."""

    gyroscope: Any
    """White noise of the rate, spectral density."""
    bias_walk: Any
    """Random walk of the bias, spectral density of its derivative."""
    accelerometer: Any
    """White noise of the specific force, spectral density."""
    velocity: Any
    """Deviation of the body's velocity from zero, spectral density."""
    rest: Any
    """White noise of the rate at rest, spectral density: the weight of rest for the bias."""
    magnetometer: Any
    """Noise of a field with the norm and dip of the undisturbed one, share of its norm, spectral
    density; ()."""
    norm: Any
    """Additional noise per unit of the norm's relative error; ()."""
    dip: Any
    """Additional noise per radian of the dip's error; ()."""


class Calibration(NamedTuple):
    """Deterministic parameters: ``rate = (1 + scale) * (gyroscope_matrix @ (measured - bias))``."""

    gyroscope_matrix: Any
    """Scale, non-orthogonality and alignment, (3, 3)."""
    accelerometer_bias: Any
    """(3,) m/s^2."""
    clock_offset: Any
    """Seconds to add to the time of truth and estimate to get the gyroscope's, positive if it lags."""
    magnetometer_lag: Any
    """Seconds by which a magnetometer sample is older than the estimate at its time stamp; ()."""
    declination: Any
    """Radians from the stated north to that of the field, positive to the east; ()."""


class Initial(NamedTuple):
    """Standard deviations of the initial state."""

    attitude: Any
    """About the attitude of accelerometer and magnetometer at the start."""
    velocity: Any
    """About zero, as for bias and scale."""
    bias: Any
    scale: Any


SPACE: Any = State(
    SO3(),
    Euclidean(3, "m/s", frame="reference"),
    Euclidean(3, "rad/s"),
    Euclidean(3, "1"),
)


def body_rate(x: State, measured: Array, params: Parameters) -> Array:
    """The rate (3,), rad/s, for a reading of the gyroscope (the first three components)."""
    return (1.0 + x.scale) * (params.calibration.gyroscope_matrix @ (measured[:3] - x.bias))


def transition(x: State, u: InputSample, dt: Array, w: Array, params: Parameters) -> State:
    """Strapdown integration of mean rate and specific force over ``dt``, as in `inertial`.

    ``w`` holds noise of angle and velocity, and the change of the bias.
    """
    force = u.mean[3:] - params.calibration.accelerometer_bias
    turn = body_rate(x, u.mean, params) * dt
    once = rotation.cross(turn, force)
    twice = rotation.cross(turn, once)
    gained = (force + once / 2.0 + twice / 6.0) * dt + w[3:6]
    return State(
        SO3().retract(x.q_ref_body, turn + w[:3]),
        x.velocity + params.setup.gravity_ref * dt + rotation.rotate(x.q_ref_body, gained),
        x.bias + w[6:],
        x.scale,
    )


def process_noise(params: Parameters, dt: Array) -> Array:
    """Covariance (9, 9) of angle, velocity and bias noise over ``dt``."""
    noise = params.noise
    return dt * linalg.block_covariance((noise.gyroscope, noise.accelerometer, noise.bias_walk))


def predict_magnetometer(x: State, u: InputSample, params: Parameters, aux: Any) -> Array:
    """The field's direction (3,) in the body frame at the time of the magnetometer's measurement."""
    gravity, declination = params.setup.gravity_ref, params.calibration.declination
    fall = gravity / jnp.sqrt(jnp.sum(gravity * gravity))
    field = rotation.rotate(rotation.exp(declination * fall), params.setup.field_ref)
    before = body_rate(x, u.value, params) * params.calibration.magnetometer_lag
    return rotation.rotate(rotation.exp(before), rotation.rotate_inverse(x.q_ref_body, field))


def magnetometer_noise(params: Parameters, aux: Any, dt: Array) -> Array:
    """Covariance (3, 3); `aux` holds the errors of norm (relative) and dip (rad) of the sample."""
    noise = params.noise
    off = noise.magnetometer**2 + (noise.norm * aux[0]) ** 2 + (noise.dip * aux[1]) ** 2
    return off / dt * jnp.eye(3)


def predict_velocity(x: State, u: InputSample, params: Parameters, aux: Any) -> Array:
    """The velocity (3,), m/s, whose pseudo-measurement is zero."""
    return x.velocity


def velocity_noise(params: Parameters, aux: Any, dt: Array) -> Array:
    """Covariance (3, 3) of a pseudo-measurement every ``dt``."""
    return linalg.covariance(params.noise.velocity, 3) / dt


def predict_rest(x: State, u: InputSample, params: Parameters, aux: Any) -> Array:
    """Reading of a static gyroscope: its bias, independent of its scale."""
    return x.bias


def rest_noise(params: Parameters, aux: Any, dt: Array) -> Array:
    """Covariance (3, 3) of readings averaged over ``dt``."""
    return linalg.covariance(params.noise.rest, 3) / dt


def magnetometer(recording: Recording) -> Samples:
    """The field (N, 3) in units of its median norm, with the errors of norm and dip."""
    imu = earth.require_marg_imu(recording)
    assert imu.magnetometer is not None
    field = tilt.magnetic_field(imu)
    good = np.isfinite(field.dip)
    rows = earth.thinned(imu, good)
    norm, dip = np.nanmedian(field.norm), np.nanmedian(field.dip)
    aux = np.stack([np.abs(field.norm[rows] / norm - 1.0), np.abs(field.dip[rows] - dip)], axis=1)
    left = int(good.sum()) - len(rows)
    every = np.ones(len(rows), bool)
    value = imu.magnetometer[rows] / norm
    return Samples(imu.time_ns[rows], value, every, aux, origin=("imu",), thinned=left)


def velocity(recording: Recording) -> Samples:
    """Zeros (N, 3) at the instants of the pseudo-measurement, at most 100 a second."""
    imu = earth.require_marg_imu(recording)
    rows = earth.thinned(imu, np.ones(len(imu.time_ns), bool))
    return Samples(imu.time_ns[rows], np.zeros((len(rows), 3)), np.ones(len(rows), bool))


def rest(recording: Recording) -> Samples:
    """Mean rates (N, 3) since the previous instant, visible if the IMU is static."""
    imu = earth.require_marg_imu(recording)
    rows = earth.thinned(imu, np.ones(len(imu.time_ns), bool))
    total = np.concatenate([np.zeros((1, 3)), np.cumsum(imu.gyroscope, axis=0)])
    before = np.concatenate([[-1], rows[:-1]])
    mean = (total[rows + 1] - total[before + 1]) / (rows - before)[:, None]
    return Samples(imu.time_ns[rows], mean, tilt.static_samples(imu)[rows])


def find_start(recording: Recording, samples: Mapping[str, Samples]) -> Start | None:
    """The first magnetometer sample that, with the mean specific force after it, gives an attitude."""
    imu, about = earth.require_marg_imu(recording), earth.setup(recording)
    assert imu.accelerometer is not None
    field = samples["magnetometer"]
    total = np.concatenate([np.zeros((1, 3)), np.cumsum(imu.accelerometer, axis=0)])
    begin = np.searchsorted(imu.time_ns, field.time_ns)
    end = np.searchsorted(imu.time_ns, field.time_ns + int(START_S * NANOSECONDS))
    found = earth.attitudes(total[end] - total[begin], field.value, about, LEAST_SINE)
    good = np.flatnonzero(np.asarray(found.valid))
    if not good.size:
        return None
    q = np.asarray(found.q_ref_body)[good[0]]
    return Start(int(field.time_ns[good[0]]), {"q_ref_body": q})


def initial_mean(first: Mapping[str, Any]) -> State:
    """The attitude of the start (the identity without any), all other states zero."""
    q = jnp.asarray(first.get("q_ref_body", rotation.identity()))
    zero = jnp.zeros(3, q.dtype)
    return State(q, zero, zero, zero)


def rate_noise(u: InputSample, params: Parameters) -> Array:
    """Covariance (3, 3), (rad/s)^2, of the rate output by the gyroscope's own noise."""
    matrix = params.calibration.gyroscope_matrix
    return linalg.congruence(matrix, linalg.covariance(params.noise.gyroscope, 3) * u.bandwidth)


DEFAULTS = Parameters(
    Noise(
        gyroscope=np.deg2rad(0.06),
        bias_walk=np.deg2rad(0.005),
        accelerometer=0.03,
        velocity=0.1,
        rest=np.deg2rad(0.02),
        magnetometer=0.05,
        norm=0.5,
        dip=0.4,
    ),
    Calibration(
        gyroscope_matrix=np.eye(3),
        accelerometer_bias=np.zeros(3),
        clock_offset=np.array(0.0),
        magnetometer_lag=np.array(0.0),
        declination=np.array(0.0),
    ),
    Initial(attitude=np.deg2rad(10.0), velocity=0.1, bias=np.deg2rad(0.3), scale=0.003),
    earth.SETUP,
)

UNITS = Parameters(
    Noise(
        "rad/s/sqrt(Hz)",
        "rad/s^2/sqrt(Hz)",
        "m/s^2/sqrt(Hz)",
        "m/s/sqrt(Hz)",
        "rad/s/sqrt(Hz)",
        "1/sqrt(Hz)",
        "1/sqrt(Hz)",
        "1/rad/sqrt(Hz)",
    ),
    Calibration("1", "m/s^2", "s", "s", "rad"),
    Initial("rad", "m/s", "rad/s", "1"),
)

MODEL = Model(
    name="marg",
    summary="attitude from gyroscope, accelerometer and magnetometer alone",
    space=SPACE,
    transition=transition,
    process_noise=process_noise,
    sensors=(
        Sensor(
            "magnetometer",
            Euclidean(3, "1"),
            predict_magnetometer,
            magnetometer_noise,
            magnetometer,
            typical_aux=np.zeros(2),
        ),
        Sensor("velocity", SPACE.velocity, predict_velocity, velocity_noise, velocity),
        Sensor("rest", Euclidean(3, "rad/s"), predict_rest, rest_noise, rest),
    ),
    parameters=DEFAULTS,
    units=UNITS,
    noise_dims=Noise(3, 3, 3, 3, 3, 1, 1, 1),
    initial_mean=initial_mean,
    initial_covariance=inertial.initial_covariance,
    find_start=find_start,
    setup=earth.setup,
    input=Input("imu", sources.imu, sources.clock_offset),
    outputs=(
        _outputs.ATTITUDE,
        _outputs.rate_of_reading(body_rate, rate_noise),
    ),
)
