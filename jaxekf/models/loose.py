"""`loose`: attitude and gyroscope bias, the gyroscope as input, the tracker's attitude as measurement.

The recommended model of Cheng's (2023) system: 6 degrees of freedom, error-state attitude, body
rates. The gyroscope drives the prediction at its own rate, so that nothing is held and nothing about
the motion needs to be assumed.
"""

from collections.abc import Mapping
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxekf.filtering.interpolation import InputSample
from jaxekf.filtering.model import Input, Model, Output, Parameters, Sensor
from jaxekf.geometry import linalg, rotation
from jaxekf.geometry.manifold import SO3, Euclidean
from jaxekf.models import inertial, sources


class State(NamedTuple):
    """Attitude of the tool in the tracker's reference frame, and bias of its gyroscope."""

    q_ref_body: Any
    bias: Any


class Noise(NamedTuple):
    """What is random: each leaf of shape (), (3,) or a lower-triangular factor (3, 3)."""

    gyroscope: Any
    """White noise of the rate, spectral density."""
    bias_walk: Any
    """Random walk of the bias, spectral density of its derivative."""
    optical: Any
    """The tracker's attitude, standard deviation of a sample, body frame."""


class Calibration(NamedTuple):
    """What is not random: ``rate = exp(alignment) @ gyroscope_matrix @ (measured - bias - noise)``."""

    gyroscope_matrix: Any
    """Scale, non-orthogonality and alignment of the gyroscope to the tool's frame, (3, 3)."""
    clock_offset: Any
    """Seconds to add to the tracker's time to get the IMU's, positive where the IMU lags; ()."""
    alignment: Any = (0.0, 0.0, 0.0)
    """Rotation vector from the IMU's frame to the tool's, (3,): what changes when the IMU is mounted anew,
    while scale and non-orthogonality stay. One of it and the rotation in `gyroscope_matrix` is enough."""
    clock_drift: Any = 0.0
    """Seconds that the IMU's clock gains on the tracker's in a second; ()."""


class Initial(NamedTuple):
    """Standard deviations of the belief a run starts from."""

    attitude: Any
    """About the first visible tracker sample, which is then used as a measurement: keep it wide."""
    bias: Any
    """About zero."""


SPACE: Any = State(SO3(), Euclidean(3, "rad/s"))


def rate_matrix(params: Parameters) -> Array:
    """From the gyroscope's axes to the tool's rate, (3, 3)."""
    turn = rotation.to_matrix(rotation.exp(params.calibration.alignment))
    return turn @ params.calibration.gyroscope_matrix


def _rate(x: State, measured: Array, params: Parameters) -> Array:
    return rate_matrix(params) @ (measured - x.bias)


def transition(x: State, u: InputSample, dt: Array, w: Array, params: Parameters) -> State:
    """``q exp(rate_matrix @ ((mean rate - bias) dt + w_angle))`` and ``bias + w_bias``."""
    turn = rate_matrix(params) @ ((u.mean - x.bias) * dt + w[:3])
    return State(SO3().retract(x.q_ref_body, turn), x.bias + w[3:])


def process_noise(params: Parameters, dt: Array) -> Array:
    """Covariance (6, 6) of the angle and bias noise over ``dt``, in the gyroscope's own axes.

    Exact for the double integrator, so that cutting a step in two changes nothing: the bias walks
    while it is being integrated.
    """
    return angle_and_bias_noise(params.noise.gyroscope, params.noise.bias_walk, dt)


def angle_and_bias_noise(rate: Array, bias_walk: Array, dt: Array) -> Array:
    """Covariance (6, 6) of `process_noise`, of the densities of the rate and of its bias's derivative."""
    white = linalg.covariance(rate, 3) * dt
    walk = linalg.covariance(bias_walk, 3)
    cross = -0.5 * walk * dt**2
    return jnp.block([[white + walk * dt**3 / 3.0, cross], [cross, walk * dt]])


def predict_optical(x: State, u: Any, params: Parameters, aux: Any) -> Array:
    """The tracker sees the attitude itself."""
    return x.q_ref_body


def optical_noise(params: Parameters, aux: Any, dt: Array) -> Array:
    """Covariance (3, 3) of a tracker sample, rad^2, body frame."""
    return linalg.covariance(params.noise.optical, 3)


def first_values(
    first: Mapping[str, Any], attitude_sensor: str = "optical"
) -> tuple[Array, Array, Array]:
    """Attitude (4,), rate (3,) and bias (3,) of the first visible samples.

    The identity stands in for a missing attitude, zero for a missing rate; the bias is zero.
    """
    attitude, rate = first.get(attitude_sensor), first.get("gyroscope")
    q = rotation.identity() if attitude is None else rotation.normalise(jnp.asarray(attitude))
    zero = jnp.zeros(3, q.dtype)
    return q, zero if rate is None else jnp.asarray(rate), zero


def initial_mean(first: Mapping[str, Any]) -> State:
    """The first visible attitude (the identity if there is none) and zero bias."""
    q, _, bias = first_values(first)
    return State(q, bias)


def rate_noise(u: InputSample, params: Parameters) -> Array:
    """Covariance (3, 3) that the gyroscope's own sample puts on the rate, (rad/s)^2."""
    matrix = rate_matrix(params)
    white = linalg.covariance(params.noise.gyroscope, 3) * u.bandwidth
    return matrix @ white @ matrix.T


DEFAULTS = Parameters(
    Noise(
        gyroscope=np.deg2rad(0.05),
        bias_walk=np.deg2rad(0.005),
        optical=np.deg2rad(0.3),
    ),
    Calibration(
        gyroscope_matrix=np.eye(3),
        clock_offset=np.array(0.0),
        alignment=np.zeros(3),
        clock_drift=np.array(0.0),
    ),
    Initial(attitude=np.deg2rad(10.0), bias=np.deg2rad(1.0)),
)

UNITS = Parameters(
    Noise("rad/s/sqrt(Hz)", "rad/s^2/sqrt(Hz)", "rad"),
    Calibration("1", "s", "rad", "s/s"),
    Initial("rad", "rad/s"),
)

MODEL = Model(
    name="loose",
    summary="attitude and gyroscope bias, gyroscope as input (recommended)",
    space=SPACE,
    transition=transition,
    process_noise=process_noise,
    sensors=(Sensor("optical", SO3(), predict_optical, optical_noise, sources.optical_attitude),),
    parameters=DEFAULTS,
    units=UNITS,
    noise_dims=Noise(3, 3, 3),
    initial_mean=initial_mean,
    initial_covariance=inertial.initial_covariance,
    start_with=("optical",),
    input=Input(
        "gyroscope",
        sources.gyroscope,
        lambda params: params.calibration.clock_offset,
        lambda params: params.calibration.clock_drift,
    ),
    outputs=(
        Output("attitude", SO3(), "body", lambda x, u, params: x.q_ref_body),
        Output(
            "rate",
            Euclidean(3, "rad/s"),
            "body",
            lambda x, u, params: _rate(x, u.value, params),
            rate_noise,
        ),
    ),
)
