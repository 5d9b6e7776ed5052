"""Simulated attitude runs: a robot joint at constant rate, smooth free rotation, and samples of any model.

Every source of randomness has an explicit seed or key.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax
from scipy.spatial.transform import Rotation

from jaxekf._support.compilation import require_float64
from jaxekf._support.constants import GRAVITY_REF
from jaxekf.filtering.ekf import inputs_of
from jaxekf.filtering.model import Model, Parameters
from jaxekf.filtering.steps import Steps
from jaxekf.geometry import manifold
from jaxekf.recordings.types import (
    NANOSECONDS,
    Encoder,
    Floats,
    Imu,
    Optical,
    Recording,
    Times,
    from_scipy,
    to_scipy,
)


@dataclass(frozen=True)
class SensorGrade:
    """Noise and rates of the simulated sensors.

    Examples
    --------
    >>> from jaxekf.simulation import attitude_runs
    >>> slow = attitude_runs.SensorGrade(optical_hz=20.0)
    >>> motion = attitude_runs.free_motion(1)
    >>> run = attitude_runs.recording("slow", motion, seed=1, duration_s=5.0, grade=slow)
    >>> len(run.need_optical().time_ns)
    101
    """

    gyroscope_deg: float = 0.05
    """White noise of the rate, deg/s/sqrt(Hz)."""
    bias_walk_deg: float = 0.005
    """Random walk of the bias, deg/s^2/sqrt(Hz)."""
    bias_deg: float = 0.5
    """Standard deviation of the initial bias, deg/s."""
    optical_deg: float = 0.3
    """Tracker attitude noise per axis, deg."""
    position_mm: float = 0.2
    """Tracker position noise per axis, mm."""
    optical_hz: float = 62.5
    imu_hz: float = 125.0
    encoder_hz: float = 125.0
    accelerometer: float | None = None
    """White noise of the specific force, m/s^2/sqrt(Hz); None for an IMU without accelerometer."""
    magnetometer: float | None = None
    """Noise of the field per axis, share of its norm; None for an IMU without magnetometer."""


FIELD_REF = (0.0, 0.5, -0.5 * np.sqrt(3.0))
"""Simulated magnetic field: north along y, 60 deg below the horizontal."""


@dataclass(frozen=True)
class Motion:
    """A smooth attitude over time: roll, pitch and yaw, each a constant rate and sinusoids.

    ``q(t) = exp(a_z(t) e_z) exp(a_y(t) e_y) exp(a_x(t) e_x)`` with
    ``a(t) = rate * ramp(t) + sum(amplitude * sin(2 pi f t + phase))``, minus its value at 0.

    Examples
    --------
    >>> import numpy as np
    >>> from jaxekf.simulation.attitude_runs import Motion
    >>> about_z = Motion(rate=(0.0, 0.0, np.pi / 2))  # rad/s: a quarter turn in a second
    >>> q_ref_body, rate = about_z.attitude(np.array([1.0]))
    >>> np.allclose(q_ref_body, np.sqrt([0.5, 0.0, 0.0, 0.5])), np.allclose(rate, [0.0, 0.0, np.pi / 2])
    (True, True)
    """

    rate: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Constant rate of each angle, rad/s, from `rest_s` on."""
    amplitude: Floats | None = None
    """(3, m) radians."""
    frequency: Floats | None = None
    """(3, m) hertz."""
    phase: Floats | None = None
    """(3, m) radians."""
    rest_s: float = 0.0
    """Duration of rest at the start, s."""

    def angles(self, t: Floats) -> tuple[Floats, Floats]:
        """The three angles (N, 3), rad, and their rates, rad/s, at times t (N,) in seconds."""
        moving = np.maximum(t - self.rest_s, 0.0)[:, None]
        on = (t >= self.rest_s)[:, None]
        angle, speed = moving * np.array(self.rate), np.where(on, np.array(self.rate), 0.0)
        if self.amplitude is None or self.frequency is None or self.phase is None:
            return angle, speed
        turn = 2.0 * np.pi * self.frequency
        argument = turn * moving[:, :, None] + self.phase
        swing = self.amplitude * (np.sin(argument) - np.sin(self.phase))
        return (
            angle + swing.sum(axis=2),
            speed + on * (self.amplitude * turn * np.cos(argument)).sum(axis=2),
        )

    def attitude(self, t: Floats) -> tuple[Floats, Floats]:
        """Quaternions (N, 4) body to reference, and body rates (N, 3) in rad/s."""
        angle, speed = self.angles(t)
        x, y, z = (Rotation.from_rotvec(angle[:, [i]] * np.eye(3)[i]) for i in range(3))
        axes = np.eye(3)
        rate = (y * x).inv().apply(axes[2]) * speed[:, [2]]
        rate += x.inv().apply(axes[1]) * speed[:, [1]] + axes[0] * speed[:, [0]]
        return from_scipy(z * y * x), rate


def constant_rate_motion(rate_deg: float = -9.0, rest_s: float = 10.0) -> Motion:
    """The paper's experiment: a robot joint rotates about x at constant rate after a rest.

    Examples
    --------
    >>> import numpy as np
    >>> from jaxekf.simulation import attitude_runs
    >>> motion = attitude_runs.constant_rate_motion(rate_deg=-9.0, rest_s=10.0)
    >>> angles, _ = motion.angles(np.array([5.0, 20.0]))
    >>> np.allclose(np.rad2deg(angles[:, 0]), [0.0, -90.0])
    True
    """
    return Motion(rate=(np.deg2rad(rate_deg), 0.0, 0.0), rest_s=rest_s)


def free_motion(seed: int, *, speed_deg: float = 40.0, rest_s: float = 2.0) -> Motion:
    """A smooth random rotation about all axes, of about `speed_deg` deg/s rms in roll and yaw.

    Pitch stays within 70 deg, so that roll and yaw remain meaningful in a plot.

    Examples
    --------
    >>> import numpy as np
    >>> from jaxekf.simulation import attitude_runs
    >>> motion = attitude_runs.free_motion(1, rest_s=2.0)
    >>> _, rate = motion.attitude(np.linspace(0.0, 10.0, 101))
    >>> moving = np.linalg.norm(rate, axis=1) > 0.0
    >>> bool(moving[:20].any()), bool(moving[21:].all())
    (False, True)
    """
    rng = np.random.default_rng([seed, 1])
    frequency = rng.uniform(0.15, 0.9, (3, 4))
    share = rng.dirichlet(np.ones(4), 3)
    amplitude = np.deg2rad(speed_deg) * np.sqrt(2.0 * share) / (2.0 * np.pi * frequency)
    amplitude[1] *= min(1.0, np.deg2rad(35.0) / amplitude[1].sum())
    # cos(phase) = 0: the motion starts from rest without a jump in rate.
    phase = rng.choice([-0.5, 0.5], (3, 4)) * np.pi
    return Motion(amplitude=amplitude, frequency=frequency, phase=phase, rest_s=rest_s)


def sample_times(hertz: float, duration_s: float, start_ns: int) -> Times:
    """Regular sampling times, ns.

    Examples
    --------
    >>> from jaxekf.simulation import attitude_runs
    >>> attitude_runs.sample_times(62.5, 0.048, start_ns=0).tolist()
    [0, 16000000, 32000000, 48000000]
    """
    count = int(np.floor(duration_s * hertz + 1e-9)) + 1
    return start_ns + np.round(np.arange(count) / hertz * NANOSECONDS).astype(np.int64)


def recording(
    name: str,
    motion: Motion,
    *,
    seed: int,
    duration_s: float,
    grade: SensorGrade | None = None,
    occlusions: Sequence[tuple[float, float]] = (),
    dropouts: float = 0.0,
    start_ns: int = 0,
    marker_body: tuple[float, float, float] = (0.15, 0.0, 0.10),
) -> Recording:
    """Record a motion with a tracker, an IMU and an encoder.

    Parameters
    ----------
    name
        Name of the run.
    motion
        The motion.
    seed
        Seed of all sensor noise.
    duration_s
        Length, s.
    grade
        Noise and rates of the sensors.
    occlusions
        (start, end) in seconds without tracker samples.
    dropouts
        Probability that any other tracker sample is lost.
    start_ns
        Time of the first samples, ns.
    marker_body
        (3,) m, body frame: the point whose position the tracker reports; the tool rotates about the origin.

    Examples
    --------
    >>> from jaxekf.simulation import attitude_runs
    >>> motion = attitude_runs.free_motion(1)
    >>> run = attitude_runs.recording("run", motion, seed=1, duration_s=5.0, occlusions=[(2.0, 3.0)])
    >>> list(run.streams)
    ['optical', 'imu', 'encoder']
    >>> optical = run.need_optical()
    >>> hidden = optical.time_ns[~optical.valid] / 1e9  # s
    >>> round(float(hidden.min()), 1), round(float(hidden.max()), 1)
    (2.0, 3.0)
    """
    grade = grade or SensorGrade()
    rng = np.random.default_rng([seed, 0])
    joint = motion.amplitude is None and sum(r != 0.0 for r in motion.rate) == 1
    info: dict[str, Any] = {"simulated": True, "seed": seed, "marker_body": list(marker_body)}
    if joint:
        axis = [float(r != 0.0) for r in motion.rate]
        info["encoder_about"] = {"axis": axis, "acts_on": "reference"}
    if grade.accelerometer is not None:
        info["gravity_ref"] = list(GRAVITY_REF)
    if grade.magnetometer is not None:
        info["field_ref"] = list(FIELD_REF)
    optical = _optical(motion, grade, rng, duration_s, occlusions, dropouts, start_ns, marker_body)
    return Recording(
        name,
        optical,
        _earth(motion, grade, seed, _imu(motion, grade, rng, duration_s, start_ns)),
        _encoder(motion, grade, duration_s, start_ns),
        info,
    )


def seconds(times: Times) -> Floats:
    """Seconds since the first.

    Examples
    --------
    >>> import numpy as np
    >>> from jaxekf.simulation import attitude_runs
    >>> attitude_runs.seconds(np.array([1_700_000_000_000_000_000, 1_700_000_000_016_000_000])).tolist()
    [0.0, 0.016]
    """
    return (times - times[0]) / NANOSECONDS


def _optical(
    motion: Motion,
    grade: SensorGrade,
    rng: np.random.Generator,
    duration_s: float,
    occlusions: Sequence[tuple[float, float]],
    dropouts: float,
    start_ns: int,
    marker_body: tuple[float, float, float],
) -> Optical:
    times = sample_times(grade.optical_hz, duration_s, start_ns)
    t = seconds(times)
    q, _ = motion.attitude(t)
    noise = np.deg2rad(grade.optical_deg) * rng.standard_normal((len(t), 3))
    measured = to_scipy(q) * Rotation.from_rotvec(noise)
    blur = 1e-3 * grade.position_mm * rng.standard_normal((len(t), 3))
    position = to_scipy(q).apply(marker_body) + blur
    visible = rng.uniform(size=len(t)) >= dropouts
    for begin, end in occlusions:
        visible &= (t < begin) | (t >= end)
    visible[0] = True
    return Optical(times, from_scipy(measured), visible, position)


def _imu(
    motion: Motion, grade: SensorGrade, rng: np.random.Generator, duration_s: float, start_ns: int
) -> Imu:
    times = sample_times(grade.imu_hz, duration_s, start_ns)
    t = seconds(times)
    _, rate = motion.attitude(t)
    step = np.deg2rad(grade.bias_walk_deg) / np.sqrt(grade.imu_hz)
    bias = np.deg2rad(grade.bias_deg) * rng.standard_normal(3)
    bias = bias + np.cumsum(step * rng.standard_normal((len(t), 3)), axis=0)
    white = np.deg2rad(grade.gyroscope_deg) * np.sqrt(grade.imu_hz)
    return Imu(times, rate + bias + white * rng.standard_normal((len(t), 3)))


def _earth(motion: Motion, grade: SensorGrade, seed: int, imu: Imu) -> Imu:
    """The IMU with readings of gravity and field; it is at the tool's centre of rotation."""
    rng = np.random.default_rng([seed, 1])
    q, _ = motion.attitude(seconds(imu.time_ns))
    into_body = to_scipy(q).inv()

    def measured(vector: Sequence[float], deviation: float) -> Floats:
        return into_body.apply(vector) + deviation * rng.standard_normal((len(q), 3))

    force = field = None
    if grade.accelerometer is not None:
        up = [-g for g in GRAVITY_REF]
        force = measured(up, grade.accelerometer * np.sqrt(grade.imu_hz))
    if grade.magnetometer is not None:
        field = measured(FIELD_REF, grade.magnetometer)
    return Imu(imu.time_ns, imu.gyroscope, force, field)


def _encoder(motion: Motion, grade: SensorGrade, duration_s: float, start_ns: int) -> Encoder:
    times = sample_times(grade.encoder_hz, duration_s, start_ns)
    q, _ = motion.attitude(seconds(times))
    known = np.ones(len(times), bool)
    return Encoder(times, q, known, known)


def draw(
    model: Model, params: Parameters, start: Any, steps: Steps, key: Array
) -> tuple[Any, Steps]:
    """Draw ground truth and measurements from a model, for tests of consistency.

    Works under `vmap`.

    Parameters
    ----------
    model
        The model.
    params
        Its parameters.
    start
        True initial state.
    steps
        Timeline whose values are replaced.
    key
        Random key.

    Returns
    -------
    The states at the end of each substep, leading axes (K, S), and `steps` with simulated values.
    """
    require_float64()
    steps = jax.tree.map(jnp.asarray, steps)
    inputs = inputs_of(model, params, steps)

    def measure(x: Any, u: Any, rows: dict[str, Any], key: Array) -> dict[str, Any]:
        values = {}
        for i, (name, samples) in enumerate(sorted(rows.items())):
            sensor = model.sensor(name)
            noise = sensor.noise(params, samples.aux, samples.dt)
            error = _correlated(jax.random.fold_in(key, i), noise)
            expected = sensor.predict(x, u, params, samples.aux)
            values[name] = manifold.retract(sensor.space, expected, error)
        return values

    def substep(x: Any, given: Any) -> Any:
        dt, u, fast, key = given
        push, look = jax.random.split(key)
        w = _correlated(push, model.process_noise(params, dt))
        x = model.transition(x, u, dt, w, params)
        return x, (x, measure(x, u, fast, look))

    def epoch(x: Any, given: Any) -> Any:
        dt, u, fast, slow, key = given
        keys = jax.random.split(key, dt.shape[0] + 1)
        x, (states, measured) = lax.scan(substep, x, (dt, u, fast, keys[:-1]))
        last = None if u is None else jax.tree.map(lambda a: a[-1], u)
        return x, (states, measured, measure(x, last, slow, keys[-1]))

    keys = jax.random.split(key, steps.dt.shape[0])
    given = (steps.dt, inputs, steps.fast, steps.slow, keys)
    _, (states, fast, slow) = lax.scan(epoch, start, given)
    return states, steps._replace(
        fast={name: steps.fast[name]._replace(value=value) for name, value in fast.items()},
        slow={name: steps.slow[name]._replace(value=value) for name, value in slow.items()},
    )


def _correlated(key: Array, cov: Array) -> Array:
    """A normal sample with a covariance that may be singular (zero in a step of zero length)."""
    values, vectors = jnp.linalg.eigh(cov)
    draw = jax.random.normal(key, cov.shape[:1], cov.dtype)
    return vectors @ (jnp.sqrt(jnp.maximum(values, 0.0)) * draw)
