"""`loose_rate`: attitude, angular rate and gyroscope bias, the gyroscope as a measurement.

Choose it for smooth motion with a noisy gyroscope, whose own noise it filters, unlike `loose`. Its density
of angular acceleration describes the motion and must be tuned to the recordings first. The state is Cheng's
(2023), with an error-state attitude and body rates instead of his eqs. 9 to 14.

- States (9 degrees of freedom): attitude `q_ref_body` (error: rad, body frame), `rate` rad/s (body frame),
  `bias` rad/s.
- Input: none.
- Sensors: `optical`, the tracker's attitude; `gyroscope`, rate plus bias.
- Noise: `acceleration` rad/s^2/sqrt(Hz), `gyroscope` rad/s/sqrt(Hz), `bias_walk` rad/s^2/sqrt(Hz),
  `optical` rad.
- Calibration: none.
- Initial: `attitude` rad, `rate` rad/s, `bias` rad/s.
"""

from collections.abc import Mapping
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxekf._support.deprecations import renamed
from jaxekf.filtering.model import Model, Parameters, Sensor
from jaxekf.geometry import linalg
from jaxekf.geometry.manifold import SO3
from jaxekf.models import _outputs, inertial, loose, sources


class State(NamedTuple):
    """Attitude, body rate and gyroscope bias."""

    q_ref_body: Any
    rate: Any
    bias: Any


class Noise(NamedTuple):
    """Noise parameters: each of shape (), (3,) or a lower-triangular factor (3, 3)."""

    acceleration: Any
    """Angular acceleration, spectral density."""
    gyroscope: Any
    """White noise of the measured rate, spectral density."""
    bias_walk: Any
    """Random walk of the bias, spectral density of its derivative."""
    optical: Any
    """Standard deviation of a sample of the tracker's attitude, body frame."""


class Calibration(NamedTuple):
    """This model has no calibration parameters."""


class Initial(NamedTuple):
    """Standard deviations of the initial state."""

    attitude: Any
    rate: Any
    bias: Any


SPACE: Any = State(SO3(), _outputs.RATE, _outputs.RATE)


def transition(x: State, u: Any, dt: Array, w: Array, params: Parameters) -> State:
    """``q exp(rate dt + w_angle)``, ``rate + w_rate`` and ``bias + w_bias``."""
    turn = x.rate * dt + w[:3]
    return State(SO3().retract(x.q_ref_body, turn), x.rate + w[3:6], x.bias + w[6:])


def process_noise(params: Parameters, dt: Array) -> Array:
    """Covariance (9, 9) of angle, rate and bias noise over ``dt``, exact for the double integrator."""
    push = linalg.covariance(params.noise.acceleration, 3)
    walk = linalg.covariance(params.noise.bias_walk, 3) * dt
    cross = 0.5 * push * dt**2
    zero = jnp.zeros((3, 3))
    return jnp.block(
        [[push * dt**3 / 3.0, cross, zero], [cross, push * dt, zero], [zero, zero, walk]]
    )


def predict_gyroscope(x: State, u: Any, params: Parameters, aux: Any) -> Array:
    """Rate plus bias (3,), rad/s."""
    return x.rate + x.bias


def gyroscope_noise(params: Parameters, aux: Any, dt: Array) -> Array:
    """Covariance (3, 3) of a gyroscope sample that is the mean over its sampling period ``dt``."""
    return linalg.covariance(params.noise.gyroscope, 3) / dt


def initial_mean(first: Mapping[str, Any]) -> State:
    """The first visible attitude, the first measured rate, and zero bias."""
    return State(*loose.first_values(first))


DEFAULTS = Parameters(
    Noise(
        acceleration=np.deg2rad(10.0),
        gyroscope=np.deg2rad(0.05),
        bias_walk=np.deg2rad(0.005),
        optical=np.deg2rad(0.3),
    ),
    Calibration(),
    Initial(attitude=np.deg2rad(10.0), rate=np.deg2rad(10.0), bias=np.deg2rad(1.0)),
)

UNITS = Parameters(
    Noise("rad/s^2/sqrt(Hz)", "rad/s/sqrt(Hz)", "rad/s^2/sqrt(Hz)", "rad"),
    Calibration(),
    Initial("rad", "rad/s", "rad/s"),
)

MODEL = Model(
    name="loose_rate",
    summary="attitude, rate and gyroscope bias, gyroscope as measurement",
    space=SPACE,
    transition=transition,
    process_noise=process_noise,
    sensors=(
        Sensor(
            "optical", SO3(), loose.predict_optical, loose.optical_noise, sources.optical_attitude
        ),
        Sensor("gyroscope", _outputs.RATE, predict_gyroscope, gyroscope_noise, sources.gyroscope),
    ),
    parameters=DEFAULTS,
    units=UNITS,
    noise_dims=Noise(3, 3, 3, 3),
    initial_mean=initial_mean,
    initial_covariance=inertial.initial_covariance,
    start_with=("optical",),
    outputs=(_outputs.ATTITUDE, _outputs.rate(_outputs.rate_state)),
)


__getattr__ = renamed(__name__, "initial_covariance>jaxekf.models.inertial.initial_covariance")
