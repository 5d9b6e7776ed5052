"""`loose`: attitude and gyroscope bias from a tracker's attitude and a gyroscope (recommended).

Choose it for a tracker that reports attitudes and an IMU on the tool, if no position is wanted. It is the
recommended form of Cheng's (2023) system: an error-state attitude and body rates instead of eqs. 1 to 17,
see `loose_additive`. The gyroscope drives the prediction at its own rate, so nothing about the motion
needs to be assumed.

- States (6 degrees of freedom): attitude `q_ref_body` (error: rotation vector, rad, body frame) and
  gyroscope bias `bias`, rad/s.
- Input: gyroscope, rad/s, body frame.
- Sensor: `optical`, the tracker's attitude.
- Noise: `gyroscope` rad/s/sqrt(Hz), `bias_walk` rad/s^2/sqrt(Hz), `optical` rad.
- Calibration: `gyroscope_matrix`, `clock_offset` s, `alignment` rad, `clock_drift` s/s.
- Initial: `attitude` rad, `bias` rad/s.
"""

from collections.abc import Mapping
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxekf._support.deprecations import renamed
from jaxekf.filtering.interpolation import InputSample
from jaxekf.filtering.model import Input, Model, Parameters, Sensor
from jaxekf.geometry import linalg, rotation
from jaxekf.geometry.manifold import SO3, Euclidean
from jaxekf.models import _outputs, inertial, sources


class State(NamedTuple):
    """Attitude of the tool in the tracker's reference frame, and bias of its gyroscope."""

    q_ref_body: Any
    bias: Any


class Noise(NamedTuple):
    """Noise parameters: each of shape (), (3,) or a lower-triangular factor (3, 3)."""

    gyroscope: Any
    """White noise of the rate, spectral density."""
    bias_walk: Any
    """Random walk of the bias, spectral density of its derivative."""
    optical: Any
    """Standard deviation of a sample of the tracker's attitude, body frame."""


class Calibration(NamedTuple):
    """Deterministic parameters.

    ``rate = exp(alignment) @ gyroscope_matrix @ (measured - bias - noise)``.
    """

    gyroscope_matrix: Any
    """Scale, non-orthogonality and rotation from the gyroscope's axes to the tool frame, (3, 3)."""
    clock_offset: Any
    """Seconds to add to the tracker's time to get the IMU's, positive if the IMU lags; ()."""
    alignment: Any = (0.0, 0.0, 0.0)
    """Rotation vector from IMU frame to tool frame, (3,), rad: changes when the IMU is mounted anew,
    unlike scale and non-orthogonality. Estimate either it or the rotation in `gyroscope_matrix`."""
    clock_drift: Any = 0.0
    """Seconds that the IMU's clock gains on the tracker's in a second; ()."""


class Initial(NamedTuple):
    """Standard deviations of the initial state."""

    attitude: Any
    """About the first visible tracker sample, which is then used as a measurement, too: keep it large."""
    bias: Any
    """About zero."""


SPACE: Any = State(SO3(), Euclidean(3, "rad/s"))


def rate_matrix(params: Parameters) -> Array:
    """Matrix (3, 3) from the gyroscope's axes to the tool's rate."""
    turn = rotation.to_matrix(rotation.exp(params.calibration.alignment))
    return turn @ params.calibration.gyroscope_matrix


def _rate(x: State, measured: Array, params: Parameters) -> Array:
    return rate_matrix(params) @ (measured - x.bias)


def transition(x: State, u: InputSample, dt: Array, w: Array, params: Parameters) -> State:
    """``q exp(rate_matrix @ ((mean rate - bias) dt + w_angle))`` and ``bias + w_bias``."""
    turn = rate_matrix(params) @ ((u.mean - x.bias) * dt + w[:3])
    return State(SO3().retract(x.q_ref_body, turn), x.bias + w[3:])


def process_noise(params: Parameters, dt: Array) -> Array:
    """Covariance (6, 6) of angle and bias noise over ``dt``, in the gyroscope's axes.

    It is exact for the double integrator (the bias changes while it is integrated), so that splitting
    a step changes nothing.
    """
    return angle_and_bias_noise(params.noise.gyroscope, params.noise.bias_walk, dt)


def angle_and_bias_noise(rate: Array, bias_walk: Array, dt: Array) -> Array:
    """The covariance (6, 6) of `process_noise` from the densities of rate and bias derivative."""
    white = linalg.covariance(rate, 3) * dt
    walk = linalg.covariance(bias_walk, 3)
    cross = -0.5 * walk * dt**2
    return jnp.block([[white + walk * dt**3 / 3.0, cross], [cross, walk * dt]])


def predict_optical(x: State, u: Any, params: Parameters, aux: Any) -> Array:
    """The attitude (4,), which the tracker measures directly."""
    return x.q_ref_body


def optical_noise(params: Parameters, aux: Any, dt: Array) -> Array:
    """Covariance (3, 3) of a tracker sample, rad^2, body frame."""
    return linalg.covariance(params.noise.optical, 3)


def first_values(
    first: Mapping[str, Any], attitude_sensor: str = "optical"
) -> tuple[Array, Array, Array]:
    """Attitude (4,), rate (3,) and bias (3,) of the first visible samples.

    A missing attitude is the identity, a missing rate zero; the bias is zero.
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
    """Covariance (3, 3), (rad/s)^2, of the rate output by the gyroscope's own noise."""
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
        sources.clock_offset,
        sources.clock_drift,
    ),
    outputs=(
        _outputs.ATTITUDE,
        _outputs.rate_of_reading(_rate, rate_noise),
    ),
)


__getattr__ = renamed(__name__, "initial_covariance>jaxekf.models.inertial.initial_covariance")
