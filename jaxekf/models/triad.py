"""`triad`: attitude and rate bias from gravity, the magnetic field and a rate of any source.

Choose it to reproduce Ang, Khosla, Riviere (eqs. 19 to 51), or for a body that hardly accelerates; `marg`
is better for one that does. The rate (of an accelerometer array, see `jaxekf.pose_solvers.gyro_free_rate`,
or of a gyroscope) drives the prediction; an attitude from specific force and magnetic field
(`jaxekf.geometry.triad.triad`, eqs. 7 to 13) corrects it, with the covariance of eqs. 41 to 46.

Corrections of the print: eqs. 21 and 24 disagree in the quaternion's order; eqs. 28, 30 and 31 lack the
factor T; eq. 47 subtracts the bias twice; eq. 46 has rank 3, so the error has three components. The model
derives everything from ``q exp((rate - bias) dt)``.

- States (6 degrees of freedom): `q_ref_body` (error: rad, body frame), `bias` rad/s.
- Input: rate, rad/s, body frame.
- Sensor: `attitude`, from accelerometer and magnetometer.
- Noise: `rate` rad/s/sqrt(Hz), `bias_walk` rad/s^2/sqrt(Hz), `accelerometer` m/s^2, `magnetometer` 1.
- Calibration: `clock_offset` s.
- Initial: `attitude` rad, `bias` rad/s.
"""

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
from jax import Array

from jaxekf._support.constants import STANDARD_GRAVITY
from jaxekf.filtering.interpolation import InputSample
from jaxekf.filtering.model import Input, Model, Parameters, Sensor
from jaxekf.geometry import linalg, triad
from jaxekf.geometry.manifold import SO3, Euclidean
from jaxekf.models import _earth as earth
from jaxekf.models import _outputs, inertial, loose, sources
from jaxekf.pose_solvers import tilt
from jaxekf.recordings.types import Recording, Samples


class State(NamedTuple):
    """Attitude in the reference frame, and bias of the rate."""

    q_ref_body: Any
    bias: Any


class Noise(NamedTuple):
    """Noise parameters: each of shape (), (3,) or a lower-triangular factor (3, 3)."""

    rate: Any
    """White noise of the rate, spectral density."""
    bias_walk: Any
    """Random walk of the bias, spectral density of its derivative."""
    accelerometer: Any
    """Standard deviation of a specific-force sample from gravity, accelerations of the body included."""
    magnetometer: Any
    """Standard deviation of a field sample, share of its norm."""


class Calibration(NamedTuple):
    """Deterministic parameters."""

    clock_offset: Any
    """Seconds to add to the attitude's time to get the rate's, positive if the rate lags; ()."""


class Initial(NamedTuple):
    """Standard deviations of the initial state."""

    attitude: Any
    """About the first attitude, which is then used as a measurement, too: keep it large."""
    bias: Any
    """About zero."""


class Readings(NamedTuple):
    """The two vectors from which an attitude is computed."""

    force: Any
    """(3,) m/s^2."""
    field: Any
    """(3,) in units of its median norm."""


SPACE: Any = State(SO3(), Euclidean(3, "rad/s"))


def _rate(x: State, measured: Array, params: Parameters) -> Array:
    return measured - x.bias


def _rate_noise(u: InputSample, params: Parameters) -> Array:
    return linalg.covariance(params.noise.rate, 3) * u.bandwidth


def transition(x: State, u: InputSample, dt: Array, w: Array, params: Parameters) -> State:
    """``q exp((mean rate - bias) dt + w_angle)`` and ``bias + w_bias``."""
    turn = (u.mean - x.bias) * dt + w[:3]
    return State(SO3().retract(x.q_ref_body, turn), x.bias + w[3:])


def process_noise(params: Parameters, dt: Array) -> Array:
    """Covariance (6, 6) of the angle and bias noise over ``dt``, exact for the double integrator."""
    return loose.angle_and_bias_noise(params.noise.rate, params.noise.bias_walk, dt)


def predict_attitude(x: State, u: InputSample, params: Parameters, aux: Any) -> Array:
    """The attitude (4,), which the sensor measures directly."""
    return x.q_ref_body


def attitude_noise(params: Parameters, aux: Readings, dt: Array) -> Array:
    """Covariance (3, 3) of an attitude of two vectors, rad^2, body frame (eqs. 41 to 46)."""
    force, field = params.noise.accelerometer, params.noise.magnetometer
    return triad.triad_covariance(
        aux.force, aux.field, linalg.covariance(force, 3), linalg.covariance(field, 3)
    )


def attitude(recording: Recording) -> Samples:
    """Attitudes (N, 4) of each pair of readings; parallel vectors and missing readings are masked."""
    imu, about = earth.require_marg_imu(recording), earth.setup(recording)
    assert imu.accelerometer is not None and imu.magnetometer is not None
    norm = np.nanmedian(tilt.magnetic_field(imu).norm)
    force, field = imu.accelerometer, imu.magnetometer / norm
    found = earth.attitudes(force, field, about)
    valid = np.asarray(found.valid) & np.isfinite(field).all(axis=1)
    readings = Readings(force, np.where(valid[:, None], field, 1.0))
    return Samples(imu.time_ns, np.asarray(found.q_ref_body), valid, readings, origin=("imu",))


def initial_mean(first: Mapping[str, Any]) -> State:
    """The first attitude (the identity without any) and zero bias."""
    q, _, bias = loose.first_values(first, "attitude")
    return State(q, bias)


DEFAULTS = Parameters(
    Noise(
        rate=np.deg2rad(0.05),
        bias_walk=np.deg2rad(0.002),
        accelerometer=0.5,
        magnetometer=0.03,
    ),
    Calibration(clock_offset=np.array(0.0)),
    Initial(attitude=np.deg2rad(10.0), bias=np.deg2rad(1.0)),
)

UNITS = Parameters(
    Noise("rad/s/sqrt(Hz)", "rad/s^2/sqrt(Hz)", "m/s^2", "1"),
    Calibration("s"),
    Initial("rad", "rad/s"),
)

MODEL = Model(
    name="triad",
    summary="attitude and rate bias, attitude measured from gravity and magnetic field",
    space=SPACE,
    transition=transition,
    process_noise=process_noise,
    sensors=(
        Sensor(
            "attitude",
            SO3(),
            predict_attitude,
            attitude_noise,
            attitude,
            typical_aux=Readings(
                np.array([0.0, 0.0, STANDARD_GRAVITY]), np.array([0.0, 0.5, -0.866])
            ),
        ),
    ),
    parameters=DEFAULTS,
    units=UNITS,
    noise_dims=Noise(3, 3, 3, 3),
    initial_mean=initial_mean,
    initial_covariance=inertial.initial_covariance,
    start_with=("attitude",),
    input=Input("gyroscope", sources.gyroscope, sources.clock_offset),
    outputs=(
        _outputs.ATTITUDE,
        _outputs.rate_of_reading(_rate, _rate_noise),
    ),
)
