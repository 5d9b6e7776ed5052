"""`loose_additive`: the filter of Cheng (2023), eqs. 1 to 17, as published, with misprints corrected.

Choose it only to reproduce the paper; use `loose` for work. Errors are additive, the rate acts on the left
in the reference frame, and every stream is held to the tracker's instants. The measured rate is used as it
is, so the model is right only for a constant axis of rotation and a start at the identity.

Corrections: eq. 14 ends in ``q(k)``; eq. 15's identity is 4 x 4; eq. 17's first term divides by the squared
rate (here by autodiff); the updated quaternion is normalised, and the sign of each measured one follows the
predicted one.

- States (10): quaternion `q_ref_body`, `rate_ref` rad/s (reference frame), `bias` rad/s.
- Input: none.
- Sensors: `optical`, the quaternion (eq. 11); `gyroscope`, rate plus bias (eq. 12).
- Noise: `quaternion` 1/sqrt(s), `acceleration` rad/s^2/sqrt(Hz), `bias_walk` rad/s^2/sqrt(Hz),
  `optical` 1, `gyroscope` rad/s.
- Calibration: none.
- Initial: `quaternion` 1, `rate` rad/s, `bias` rad/s.
"""

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
from jax import Array

from jaxekf.filtering.model import Model, Parameters, Sensor
from jaxekf.geometry import linalg, rotation
from jaxekf.geometry.manifold import AdditiveQuaternion
from jaxekf.models import _outputs, loose, sources


class State(NamedTuple):
    """Quaternion, rate in the reference frame, and bias."""

    q_ref_body: Any
    rate_ref: Any
    bias: Any


class Noise(NamedTuple):
    """Noise parameters. The paper's ``Q = T^2 Sigma_w``; a density here is ``sqrt(T Sigma_w)``."""

    quaternion: Any
    """Process noise of each quaternion component, spectral density; shape (), (4,) or (4, 4)."""
    acceleration: Any
    """Process noise of the rate, spectral density; shape (), (3,) or (3, 3)."""
    bias_walk: Any
    """Process noise of the bias, spectral density."""
    optical: Any
    """Standard deviation of a sample's quaternion components; shape (), (4,) or (4, 4)."""
    gyroscope: Any
    """Standard deviation of a held rate sample."""


class Calibration(NamedTuple):
    """This model has no calibration parameters."""


class Initial(NamedTuple):
    """Standard deviations of the initial state."""

    quaternion: Any
    rate: Any
    bias: Any


SPACE: Any = State(AdditiveQuaternion(), _outputs.RATE, _outputs.RATE)


def transition(x: State, u: Any, dt: Array, w: Array, params: Parameters) -> State:
    """Eq. 14: ``q(k+1) = g(rate, T) q(k)``; rate and bias are random walks (eqs. 9, 10)."""
    rotated = rotation.product(rotation.exp(x.rate_ref * dt), x.q_ref_body)
    return State(rotated + w[:4], x.rate_ref + w[4:7], x.bias + w[7:])


def process_noise(params: Parameters, dt: Array) -> Array:
    """Covariance (10, 10), ``Gamma Sigma_w Gamma'`` with ``Gamma = T I``, written in densities."""
    noise = params.noise
    densities = (noise.quaternion, noise.acceleration, noise.bias_walk)
    return linalg.block_covariance(densities, (4, 3, 3)) * dt


def predict_gyroscope(x: State, u: Any, params: Parameters, aux: Any) -> Array:
    """Eq. 12: rate plus bias."""
    return x.rate_ref + x.bias


def optical_noise(params: Parameters, aux: Any, dt: Array) -> Array:
    """Covariance (4, 4) of the quaternion's components."""
    return linalg.covariance(params.noise.optical, 4)


def gyroscope_noise(params: Parameters, aux: Any, dt: Array) -> Array:
    """Covariance (3, 3) of a held sample, (rad/s)^2."""
    return linalg.covariance(params.noise.gyroscope, 3)


def project(x: State) -> State:
    """The updated quaternion normalised, as an additive update leaves the unit sphere."""
    return x._replace(q_ref_body=rotation.normalise(x.q_ref_body))


def initial_mean(first: Mapping[str, Any]) -> State:
    """The first visible attitude, the first measured rate, and zero bias."""
    return State(*loose.first_values(first))


def initial_covariance(params: Parameters) -> Array:
    """Covariance (10, 10)."""
    return linalg.block_covariance(params.initial, (4, 3, 3))


def rate_body(x: State, u: Any, params: Parameters) -> Array:
    """The rate (3,) rotated into the body frame, in which other models and the encoder express it."""
    return rotation.rotate_inverse(x.q_ref_body, x.rate_ref)


DEFAULTS = Parameters(
    Noise(
        quaternion=1e-4,
        acceleration=np.deg2rad(30.0),
        bias_walk=np.deg2rad(0.005),
        optical=0.5 * np.deg2rad(0.3),
        gyroscope=np.deg2rad(0.6),
    ),
    Calibration(),
    Initial(quaternion=0.1, rate=np.deg2rad(10.0), bias=np.deg2rad(1.0)),
)

UNITS = Parameters(
    Noise("1/sqrt(s)", "rad/s^2/sqrt(Hz)", "rad/s^2/sqrt(Hz)", "1", "rad/s"),
    Calibration(),
    Initial("1", "rad/s", "rad/s"),
)

MODEL = Model(
    name="loose_additive",
    summary="Cheng (2023) as published: ten numbers, held streams, additive quaternion",
    space=SPACE,
    transition=transition,
    process_noise=process_noise,
    sensors=(
        Sensor(
            "optical",
            AdditiveQuaternion(),
            loose.predict_optical,
            optical_noise,
            sources.optical_attitude,
        ),
        Sensor("gyroscope", _outputs.RATE, predict_gyroscope, gyroscope_noise, sources.gyroscope),
    ),
    parameters=DEFAULTS,
    units=UNITS,
    noise_dims=Noise(4, 3, 3, 4, 3),
    initial_mean=initial_mean,
    initial_covariance=initial_covariance,
    start_with=("optical",),
    outputs=(_outputs.ATTITUDE, _outputs.rate(rate_body)),
    project=project,
    hold_to="optical",
)
