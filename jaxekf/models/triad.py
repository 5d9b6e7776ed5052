"""`triad`: attitude and rate bias, the attitude measured from gravity and the magnetic field.

Ang, Khosla, Riviere, eqs. 19 to 51: the rate of any source (an array of accelerometers, see
`jaxekf.pose_solvers.gyro_free_rate`, or a gyroscope) drives the prediction, and an attitude found from
specific force and magnetic field (`jaxekf.geometry.triad.triad`, eqs. 7 to 13) corrects it, with the
covariance of eqs. 41 to 46. The state has 7 numbers and 6 degrees of freedom. `marg` serves better
where the body accelerates.

What is wrong in print, and otherwise here: eqs. 21 and 24 disagree in the quaternion's order; eqs. 28, 30
and 31 lack the factor T; eq. 47 subtracts the bias twice; eq. 46 has rank 3, so that the error of three
components is taken. All is by derivation from ``q exp((rate - bias) dt)``.
"""

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
from jax import Array

from jaxekf._support.constants import STANDARD_GRAVITY
from jaxekf.filtering.interpolation import InputSample
from jaxekf.filtering.model import Input, Model, Output, Parameters, Sensor
from jaxekf.geometry import linalg, triad
from jaxekf.geometry.manifold import SO3, Euclidean
from jaxekf.models import _earth as earth
from jaxekf.models import inertial, loose, sources
from jaxekf.pose_solvers import tilt
from jaxekf.recordings.types import Recording, Samples


class State(NamedTuple):
    """Attitude in the reference frame, and bias of the rate."""

    q_ref_body: Any
    bias: Any


class Noise(NamedTuple):
    """What is random: each leaf of shape (), (3,) or a lower-triangular factor (3, 3)."""

    rate: Any
    """White noise of the rate, spectral density."""
    bias_walk: Any
    """Random walk of the bias, spectral density of its derivative."""
    accelerometer: Any
    """Specific force, standard deviation of a sample: by what it is not gravity."""
    magnetometer: Any
    """The field, standard deviation of a sample, share of its norm."""


class Calibration(NamedTuple):
    """What is not random."""

    clock_offset: Any
    """Seconds to add to the attitude's time to get the rate's, positive where the rate lags; ()."""


class Initial(NamedTuple):
    """Standard deviations of the belief a run starts from."""

    attitude: Any
    """About the first attitude, which is then used as a measurement: keep it wide."""
    bias: Any
    """About zero."""


class Readings(NamedTuple):
    """What an attitude was found from."""

    force: Any
    """(3,) m/s^2."""
    field: Any
    """(3,) in units of its median norm."""


SPACE: Any = State(SO3(), Euclidean(3, "rad/s"))


def transition(x: State, u: InputSample, dt: Array, w: Array, params: Parameters) -> State:
    """``q exp((mean rate - bias) dt + w_angle)`` and ``bias + w_bias``."""
    turn = (u.mean - x.bias) * dt + w[:3]
    return State(SO3().retract(x.q_ref_body, turn), x.bias + w[3:])


def process_noise(params: Parameters, dt: Array) -> Array:
    """Covariance (6, 6) of the angle and bias noise over ``dt``, exact for the double integrator."""
    return loose.angle_and_bias_noise(params.noise.rate, params.noise.bias_walk, dt)


def predict_attitude(x: State, u: InputSample, params: Parameters, aux: Any) -> Array:
    """The attitude itself."""
    return x.q_ref_body


def attitude_noise(params: Parameters, aux: Readings, dt: Array) -> Array:
    """Covariance (3, 3) of an attitude of two vectors, rad^2, body frame (eqs. 41 to 46)."""
    force, field = params.noise.accelerometer, params.noise.magnetometer
    return triad.triad_covariance(
        aux.force, aux.field, linalg.covariance(force, 3), linalg.covariance(field, 3)
    )


def attitude(recording: Recording) -> Samples:
    """Attitudes (N, 4) of each pair of readings; parallel vectors and what was not read are masked."""
    imu, about = earth.require_marg_imu(recording), earth.setup(recording)
    assert imu.accelerometer is not None and imu.magnetometer is not None
    norm = np.nanmedian(tilt.magnetic_field(imu).norm)
    force, field = imu.accelerometer, imu.magnetometer / norm
    found = earth.attitudes(force, field, about)
    valid = np.asarray(found.valid) & np.isfinite(field).all(axis=1)
    readings = Readings(force, np.where(valid[:, None], field, 1.0))
    return Samples(imu.time_ns, np.asarray(found.q_ref_body), valid, readings, origin=("imu",))


def initial_mean(first: Mapping[str, Any]) -> State:
    """The first attitude (the identity if there is none) and no bias."""
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
            aux_like=Readings(np.array([0.0, 0.0, STANDARD_GRAVITY]), np.array([0.0, 0.5, -0.866])),
        ),
    ),
    parameters=DEFAULTS,
    units=UNITS,
    noise_dims=Noise(3, 3, 3, 3),
    initial_mean=initial_mean,
    initial_covariance=inertial.initial_covariance,
    start_with=("attitude",),
    input=Input("gyroscope", sources.gyroscope, lambda params: params.calibration.clock_offset),
    outputs=(
        Output("attitude", SO3(), "body", lambda x, u, params: x.q_ref_body),
        Output(
            "rate",
            Euclidean(3, "rad/s"),
            "body",
            lambda x, u, params: u.value - x.bias,
            lambda u, params: linalg.covariance(params.noise.rate, 3) * u.bandwidth,
        ),
    ),
)
