"""Models of other systems, each written as a user would: the core fits them unchanged.

`MARKERS` fuses single optical markers with an IMU as input, `VISUAL` point correspondences with an IMU
as measurement, `POINTS` has nothing but correspondences. `linear_model` is a plain Kalman filter.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxekf.filtering import interpolation
from jaxekf.filtering.model import Belief, Input, Model, Parameters, Sensor, repeated
from jaxekf.filtering.steps import Knots, Rows, Steps
from jaxekf.geometry import manifold, rotation
from jaxekf.geometry.manifold import SO3, Euclidean


class Empty(NamedTuple):
    """No parameters."""


def _no_recording(recording):
    raise NotImplementedError("this model is fed from arrays")


def _diagonal(*deviations):
    return jnp.diag(jnp.concatenate([jnp.full(3, d) ** 2 for d in deviations]))


# Markers and an IMU as input: 16 numbers, 15 degrees of freedom.


class MarkerState(NamedTuple):
    position: Any
    q_ref_body: Any
    velocity: Any
    accelerometer_bias: Any
    gyroscope_bias: Any


class MarkerNoise(NamedTuple):
    accelerometer: Any
    gyroscope: Any
    accelerometer_walk: Any
    gyroscope_walk: Any
    marker: Any


class MarkerCalibration(NamedTuple):
    gravity_ref: Any
    p_body_marker: Any


class MarkerInitial(NamedTuple):
    position: Any
    attitude: Any
    velocity: Any
    accelerometer_bias: Any
    gyroscope_bias: Any


def _marker_transition(x, u, dt, w, params):
    force = u.mean[:3] - x.accelerometer_bias
    rate = u.mean[3:] - x.gyroscope_bias
    acceleration = rotation.rotate(x.q_ref_body, force) + params.calibration.gravity_ref
    return MarkerState(
        x.position + x.velocity * dt + 0.5 * acceleration * dt**2,
        SO3().retract(x.q_ref_body, rate * dt + w[3:6]),
        x.velocity + acceleration * dt + rotation.rotate(x.q_ref_body, w[:3]),
        x.accelerometer_bias + w[6:9],
        x.gyroscope_bias + w[9:],
    )


def _marker_process_noise(params, dt):
    noise = params.noise
    walks = (noise.accelerometer_walk, noise.gyroscope_walk)
    return _diagonal(noise.accelerometer, noise.gyroscope, *walks) * dt


def _marker(index):
    def predict(x, u, params, aux):
        arm = params.calibration.p_body_marker[index]
        return x.position + rotation.rotate(x.q_ref_body, arm)

    def noise(params, aux, dt):
        return (params.noise.marker / aux) ** 2 * jnp.eye(3)

    return Sensor(f"marker_{index}", Euclidean(3, "m"), predict, noise, gate=0.999)


MARKERS = Model(
    name="markers",
    summary="single markers with a quality, IMU as input",
    space=MarkerState(Euclidean(3), SO3(), Euclidean(3), Euclidean(3), Euclidean(3)),
    transition=_marker_transition,
    process_noise=_marker_process_noise,
    sensors=tuple(_marker(i) for i in range(3)),
    parameters=Parameters(
        MarkerNoise(0.02, 0.002, 0.001, 0.0005, 0.001),
        MarkerCalibration(
            np.array([0.0, 0.0, -9.81]),
            np.array([[0.1, 0.0, 0.02], [-0.05, 0.08, 0.0], [0.0, -0.07, 0.05]]),
        ),
        MarkerInitial(0.01, 0.05, 0.1, 0.1, 0.02),
    ),
    units=Parameters(Empty(), Empty(), Empty()),
    noise_dims=MarkerNoise(3, 3, 3, 3, 1),
    initial_mean=lambda first: MarkerState(
        jnp.array([0.2, -0.1, 0.5]),
        rotation.exp(jnp.array([0.2, -0.3, 0.4])),
        jnp.zeros(3),
        jnp.zeros(3),
        jnp.zeros(3),
    ),
    initial_covariance=lambda params: _diagonal(*params.initial),
    input=Input("imu", _no_recording),
)


# Point correspondences, the IMU as measurement: 22 numbers, 21 degrees of freedom.


class VisualState(NamedTuple):
    position: Any
    velocity: Any
    acceleration: Any
    q_ref_body: Any
    rate: Any
    gyroscope_bias: Any
    accelerometer_bias: Any


class VisualNoise(NamedTuple):
    jerk: Any
    angular_acceleration: Any
    gyroscope_walk: Any
    accelerometer_walk: Any
    accelerometer: Any
    gyroscope: Any
    camera_scale: Any


class VisualCalibration(NamedTuple):
    gravity_ref: Any
    focal_length: Any
    p_body_camera: Any


class VisualInitial(NamedTuple):
    position: Any
    velocity: Any
    acceleration: Any
    attitude: Any
    rate: Any
    gyroscope_bias: Any
    accelerometer_bias: Any


class Landmarks(NamedTuple):
    """Of each correspondence: where its landmark is, and how well its image point is known."""

    position: Any
    sigma: Any


def _visual_transition(x, u, dt, w, params):
    return VisualState(
        x.position + x.velocity * dt + 0.5 * x.acceleration * dt**2,
        x.velocity + x.acceleration * dt,
        x.acceleration + w[:3],
        SO3().retract(x.q_ref_body, x.rate * dt),
        x.rate + w[3:6],
        x.gyroscope_bias + w[6:9],
        x.accelerometer_bias + w[9:],
    )


def _visual_accelerometer(x, u, params, aux):
    force = x.acceleration - params.calibration.gravity_ref
    return rotation.rotate_inverse(x.q_ref_body, force) + x.accelerometer_bias


def _project(x, params, landmark):
    seen = rotation.rotate_inverse(x.q_ref_body, landmark - x.position)
    seen = seen - params.calibration.p_body_camera
    return params.calibration.focal_length * seen[:2] / seen[2]


POINT = Sensor(
    "camera",
    Euclidean(2),
    lambda x, u, params, aux: _project(x, params, aux.position),
    lambda params, aux, dt: (params.noise.camera_scale * aux.sigma) ** 2 * jnp.eye(2),
    gate=0.99,
)


VISUAL = Model(
    name="visual",
    summary="point correspondences, IMU as measurement",
    space=VisualState(
        Euclidean(3), Euclidean(3), Euclidean(3), SO3(), Euclidean(3), Euclidean(3), Euclidean(3)
    ),
    transition=_visual_transition,
    process_noise=lambda params, dt: _diagonal(*params.noise[:4]) * dt,
    sensors=(
        Sensor(
            "accelerometer",
            Euclidean(3, "m/s^2"),
            _visual_accelerometer,
            lambda params, aux, dt: _diagonal(params.noise.accelerometer),
        ),
        Sensor(
            "gyroscope",
            Euclidean(3, "rad/s"),
            lambda x, u, params, aux: x.rate + x.gyroscope_bias,
            lambda params, aux, dt: _diagonal(params.noise.gyroscope),
        ),
        repeated(POINT, 4),
    ),
    parameters=Parameters(
        VisualNoise(2.0, 1.0, 0.001, 0.002, 0.05, 0.01, 1.0),
        VisualCalibration(np.array([-9.81, 0.0, 0.0]), 1.5, np.array([0.02, 0.0, 0.05])),
        VisualInitial(0.02, 0.05, 0.2, 0.02, 0.1, 0.02, 0.1),
    ),
    units=Parameters(Empty(), Empty(), Empty()),
    noise_dims=VisualNoise(3, 3, 3, 3, 3, 3, 1),
    initial_mean=lambda first: VisualState(
        jnp.zeros(3),
        jnp.array([0.1, -0.2, 0.05]),
        jnp.array([0.3, 0.1, -0.2]),
        rotation.exp(jnp.array([0.1, -0.2, 0.15])),
        jnp.array([0.2, -0.1, 0.3]),
        jnp.zeros(3),
        jnp.zeros(3),
    ),
    initial_covariance=lambda params: _diagonal(*params.initial),
)


# Point correspondences alone: a pose that drifts. All that is particular to them, in 6 numbers.


class Pose(NamedTuple):
    position: Any
    q_ref_body: Any


class PoseNoise(NamedTuple):
    drift: Any
    turn: Any
    camera_scale: Any


class PoseCalibration(NamedTuple):
    focal_length: Any
    p_body_camera: Any


POINTS = Model(
    name="points",
    summary="point correspondences of a drifting pose",
    space=Pose(Euclidean(3), SO3()),
    transition=lambda x, u, dt, w, params: Pose(
        x.position + w[:3], SO3().retract(x.q_ref_body, w[3:])
    ),
    process_noise=lambda params, dt: _diagonal(*params.noise[:2]) * dt,
    sensors=(repeated(POINT, 4),),
    parameters=Parameters(
        PoseNoise(0.3, 0.2, 1.0),
        PoseCalibration(1.5, np.array([0.02, 0.0, 0.05])),
        Pose(0.05, 0.05),
    ),
    units=Parameters(Empty(), Empty(), Empty()),
    noise_dims=PoseNoise(3, 3, 1),
    initial_mean=lambda first: Pose(jnp.zeros(3), rotation.exp(jnp.array([0.1, -0.2, 0.15]))),
    initial_covariance=lambda params: _diagonal(*params.initial),
)


def linear_model(transition, input_noise, slopes, noises, gate=None):
    """A time-invariant linear system ``x+ = A x + w``, ``z = H x + v``; one sensor for each H."""

    def sensor(i, h, r):
        return Sensor(
            f"sensor_{i}",
            Euclidean(len(h)),
            lambda x, u, params, aux: jnp.asarray(h) @ x,
            lambda params, aux, dt: jnp.asarray(r),
            gate=gate,
        )

    n = len(transition)
    return Model(
        name="linear",
        summary="a time-invariant linear system",
        space=Euclidean(n),
        transition=lambda x, u, dt, w, params: jnp.asarray(transition) @ x + w,
        process_noise=lambda params, dt: jnp.asarray(input_noise),
        sensors=tuple(sensor(i, h, r) for i, (h, r) in enumerate(zip(slopes, noises, strict=True))),
        parameters=Parameters(Empty(), Empty(), Empty()),
        units=Parameters(Empty(), Empty(), Empty()),
        noise_dims=Empty(),
        initial_mean=lambda first: jnp.zeros(n),
        initial_covariance=lambda params: jnp.eye(n),
    )


# Data for the models above.

EPOCHS, SUBSTEPS = 6, 2


def _imu_knots(seed, rest, channels=6):
    rng = np.random.default_rng([seed, 11])
    time = np.arange(-0.01, 0.26, 0.01)
    turn = time[:, None] * rng.uniform(5.0, 15.0, channels) + rng.uniform(0.0, 6.0, channels)
    value = np.zeros_like(turn) if rest else 0.8 * np.sin(turn)
    value[:, :3] += [0.0, 0.0, 9.81]
    areas = 0.5 * (value[1:] + value[:-1]) * np.diff(time)[:, None]
    integral = np.concatenate([np.zeros((1, channels)), np.cumsum(areas, axis=0)])
    return Knots(time, value, integral)


def _aux(model, sensor, rng, lead):
    if model is MARKERS:
        return rng.uniform(0.5, 1.0, lead)
    if sensor.name == "camera":
        place = rng.uniform([-1.0, -1.0, 3.0], [1.0, 1.0, 5.0], (*lead, 4, 3))
        return Landmarks(place, rng.uniform(0.002, 0.004, (*lead, 4)))
    return None


def _skeleton(model, seed, rest):
    """Steps without values: times, inputs, aux and masks; the first epoch is padded in front."""
    rng = np.random.default_rng([seed, 13])
    dt = np.full((EPOCHS, SUBSTEPS), 0.01)
    valid = np.ones_like(dt, bool)
    dt[0, 0], valid[0, 0] = 0.0, False
    time = np.cumsum(dt.reshape(-1)).reshape(dt.shape)
    slow_names = {"camera"} | {f"marker_{i}" for i in range(3)}
    rows = {}
    for sensor in model.sensors:
        lead = (EPOCHS,) if sensor.name in slow_names else (EPOCHS, SUBSTEPS)
        mask = np.ones((*lead, sensor.rows), bool)
        if len(lead) == 2:
            mask[0, 0] = False
        else:
            mask[int(rng.integers(EPOCHS))] = False
        if sensor.name == "camera":
            mask[:, 5] = rng.uniform(size=EPOCHS) < 0.5
        aux = _aux(model, sensor, rng, lead)
        rows[sensor.name] = Rows(None, aux, mask, np.full(lead, 0.01))
    fast = {name: row for name, row in rows.items() if name not in slow_names}
    slow = {name: row for name, row in rows.items() if name in slow_names}
    knots = _imu_knots(seed, rest) if model is MARKERS else None
    return Steps(time, dt, valid, knots, fast, slow)


_STEPPERS = {}


def _steppers(model):
    """The model's transition and sensors, compiled once."""
    if model.name not in _STEPPERS:
        transition = jax.jit(
            lambda x, u, dt, params: model.transition(
                x, u, dt, jnp.zeros(model.process_noise(params, dt).shape[0]), params
            )
        )

        def draw(sensor):
            def value(x, u, params, aux, dt, normal):
                factor = jnp.linalg.cholesky(sensor.noise(params, aux, dt))
                error = factor @ normal
                return manifold.retract(sensor.space, sensor.predict(x, u, params, aux), error)

            return jax.jit(value)

        _STEPPERS[model.name] = transition, {s.name: draw(s) for s in model.sensors}
    return _STEPPERS[model.name]


def at_rest(model):
    """The start of a run in which nothing moves: every rate and angle zero."""
    start = model.initial_mean({})
    still = jax.tree.map(jnp.zeros_like, start)
    return still._replace(q_ref_body=rotation.identity())


def toy_run(model, params, seed, rest=False):
    """A true trajectory of the model and noisy samples of it; exact samples of a body at rest."""
    steps = _skeleton(model, seed, rest)
    rng = np.random.default_rng([seed, 19])
    x = at_rest(model) if rest else model.initial_mean({})
    belief = Belief(x, model.initial_covariance(params))
    inputs = None
    if steps.knots is not None:
        knots = jax.tree.map(jnp.asarray, steps.knots)
        inputs = interpolation.sample(knots, jnp.asarray(steps.time), jnp.asarray(steps.dt))
    transition, draws = _steppers(model)
    values = {name: [] for name in draws}
    for k in range(EPOCHS):
        for s in range(SUBSTEPS):
            u = None if inputs is None else jax.tree.map(lambda a, i=(k, s): a[i], inputs)
            x = transition(x, u, steps.dt[k, s], params)
            at = [(name, rows, (k, s)) for name, rows in steps.fast.items()]
            if s == SUBSTEPS - 1:
                at += [(name, rows, (k,)) for name, rows in steps.slow.items()]
            for name, rows, i in at:
                normal = 0.0 if rest else rng.standard_normal(rows.mask.shape[-1])
                normal = np.broadcast_to(normal, rows.mask.shape[-1:])
                aux = jax.tree.map(lambda a, i=i: a[i], rows.aux)
                values[name].append(draws[name](x, u, params, aux, rows.dt[i], normal))

    def filled(name, rows):
        value = np.stack(values[name]).reshape(*rows.mask.shape[:-1], -1)
        return rows._replace(value=value)

    return belief, steps._replace(
        fast={name: filled(name, rows) for name, rows in steps.fast.items()},
        slow={name: filled(name, rows) for name, rows in steps.slow.items()},
    )
