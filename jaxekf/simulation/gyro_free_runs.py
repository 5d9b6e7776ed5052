"""A simulated handheld instrument for microsurgery with an accelerometer array and a magnetometer.

The system of Ang, Khosla and Riviere: three dual-axis accelerometers without a gyroscope, whose differences
give the rate (`jaxekf.pose_solvers.gyro_free_rate`), at 500 Hz. The hand's tremor is at 8 to 12 Hz, its
voluntary motion below 1 Hz; both are sums of sinusoids, so every derivative is exact. The reference frame
is theirs: x to magnetic north, y west, z up.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxekf._support import compilation
from jaxekf._support.compilation import require_float64
from jaxekf._support.constants import STANDARD_GRAVITY
from jaxekf.pose_solvers import accelerometer_array
from jaxekf.pose_solvers.accelerometer_array import AccelerometerArray
from jaxekf.pose_solvers.gyro_free_rate import restored, track
from jaxekf.recordings.types import Encoder, Floats, Imu, Recording, Times, to_scipy
from jaxekf.simulation.attitude_runs import Motion, sample_times, seconds
from jaxekf.simulation.marker_runs import GRAVITY_REF, ToolMotion

TREMOR_HZ = (8.0, 12.0)
VOLUNTARY_HZ = (0.05, 0.9)
TREMOR_UM = 50.0
"""Root mean square length of the tremor's translation, micrometres."""
TREMOR_LEVER_M = 0.1
"""The tremor's rotation is its translation over this lever: root mean square 0.5 mrad."""
VOLUNTARY_MM = 1.0
"""Root mean square length of the voluntary translation, mm."""
VOLUNTARY_DEG = 2.0
"""Root mean square of the voluntary rotation, all three angles together, deg."""
FORGET_S = 2.0
"""Time constant, s, of `gyro_free_rate.track` for this hand and the default array: of three half-hour runs
none diverges with up to 4 s, two do with 5 s."""
_TONES = 12
"""Sinusoids in each band of each degree of freedom."""
_BLOCK = 20_000
"""Samples that are simulated at once, each with some hundred sinusoids."""


@dataclass(frozen=True)
class SurgeryGrade:
    """Noise and rate of the sensors; the defaults are an ADXL-203 and an HMC-2003.

    Examples
    --------
    >>> from jaxekf.simulation import gyro_free_runs
    >>> grade = gyro_free_runs.SurgeryGrade(accelerometer_ug=100.0, hertz=400.0)
    >>> round(float(grade.acceleration_sigma / grade.acceleration_density), 6)  # sqrt(400)
    20.0
    """

    accelerometer_ug: float = 110.0
    """White noise of each accelerometer, micro-g/sqrt(Hz)."""
    magnetometer_ugauss: float = 40.0
    """Standard deviation of a field sample, microgauss: the HMC-2003's stated resolution."""
    field_gauss: float = 0.53
    """Strength of the Earth's field in Pittsburgh, gauss."""
    dip_deg: float = 67.0
    """Dip of the field below the horizontal there, deg."""
    hertz: float = 500.0

    @property
    def acceleration_density(self) -> float:
        """White noise of each accelerometer, m/s^2/sqrt(Hz)."""
        return 1e-6 * STANDARD_GRAVITY * self.accelerometer_ug

    @property
    def acceleration_sigma(self) -> float:
        """Standard deviation of a sample of each accelerometer, m/s^2."""
        return self.acceleration_density * np.sqrt(self.hertz)

    @property
    def field_ref(self) -> Floats:
        """(3,) gauss: the field in the reference frame."""
        dip = np.deg2rad(self.dip_deg)
        return self.field_gauss * np.array([np.cos(dip), 0.0, -np.sin(dip)])


class ArrayRun(NamedTuple):
    """Readings of an array and a magnetometer, with the ground truth at the same times.

    Examples
    --------
    >>> from jaxekf.simulation import gyro_free_runs
    >>> motion, array = gyro_free_runs.surgical_motion(1), gyro_free_runs.handheld_array()
    >>> run = gyro_free_runs.array_run(motion, array, seed=1, duration_s=1.0)
    >>> run.readings.shape, run.field.shape, run.rate.shape
    ((501, 6), (501, 3), (501, 3))
    """

    time_ns: Times
    readings: Floats
    """(N, n) m/s^2, one column for each accelerometer axis."""
    field: Floats
    """(N, 3) gauss, body frame."""
    truth: Encoder
    """Attitude, and position of the body's origin."""
    rate: Floats
    """True angular rate (N, 3), rad/s, body frame."""


def handheld_array(half_edge_m: float = 0.025) -> AccelerometerArray:
    """The paper's three dual-axis chips, on three corners of a cube about the body's origin.

    No two corners share an edge. The midpoint of the two chips with the same sensitive axis is then on that
    axis, and the mean of their readings is free of angular acceleration; see `mean_force`.

    Examples
    --------
    >>> import numpy as np
    >>> from jaxekf.simulation import gyro_free_runs
    >>> array = gyro_free_runs.handheld_array(half_edge_m=0.025)
    >>> np.allclose(np.linalg.norm(array.positions, axis=1), np.sqrt(3.0) * 0.025)
    True
    """
    corners = half_edge_m * jnp.array([[1.0, -1.0, 1.0], [-1.0, 1.0, 1.0], [1.0, 1.0, -1.0]])
    return accelerometer_array.three_dual_axis(*corners)


def surgical_motion(seed: int, *, body_acceleration: bool = True) -> ToolMotion:
    """A random hand motion at a microscope: tremor and voluntary motion in all six degrees of freedom.

    Without `body_acceleration` the body's origin is at rest and the body only rotates.

    Examples
    --------
    >>> import numpy as np
    >>> from jaxekf.simulation import gyro_free_runs
    >>> motion = gyro_free_runs.surgical_motion(1, body_acceleration=False)
    >>> bool(motion.acceleration(np.array([0.0, 1.0])).any())
    False
    """
    rng = np.random.default_rng([seed, 11])
    tremor_m, voluntary_m = 1e-6 * TREMOR_UM, 1e-3 * VOLUNTARY_MM
    turn = _tones(rng, tremor_m / TREMOR_LEVER_M, np.deg2rad(VOLUNTARY_DEG))
    shift = _tones(rng, tremor_m, voluntary_m)
    attitude = Motion(amplitude=turn[0], frequency=turn[1], phase=turn[2])
    return ToolMotion(attitude, shift[0] * body_acceleration, *shift[1:])


def _tones(
    rng: np.random.Generator, tremor: float, voluntary: float
) -> tuple[Floats, Floats, Floats]:
    """Amplitude, frequency and phase (3, m) of sinusoids with these root mean squares of the vector.

    One frequency is drawn from each equal part of a band: two similar ones would beat for minutes.
    """
    part = (np.arange(_TONES) + rng.uniform(size=(2, 3, _TONES))) / _TONES
    bands = np.array([TREMOR_HZ, VOLUNTARY_HZ])[:, :, None, None]
    frequency = bands[:, 0] + (bands[:, 1] - bands[:, 0]) * part
    share = rng.dirichlet(np.full(_TONES, 4.0), (2, 3))
    size = np.array([tremor, voluntary])[:, None, None] / np.sqrt(3.0)
    phase = rng.uniform(0.0, 2.0 * np.pi, (2, 3, _TONES))
    return _joined(size * np.sqrt(2.0 * share)), _joined(frequency), _joined(phase)


def _joined(bands: Floats) -> Floats:
    """(2, 3, m) as (3, 2 m)."""
    return np.concatenate(list(bands), axis=1)


def angular_acceleration(motion: Motion, t: Floats) -> Floats:
    """Angular acceleration (N, 3), rad/s^2, body frame, of a motion without rest at times t (N,), s.

    The derivative of ``rate = e_x a_x' + v a_y' + u a_z'``, with v and u the axes of the rotations about y
    and z in the body frame: ``v = R_x' e_y`` and ``u = R_x' R_y' e_z``.

    Examples
    --------
    >>> import numpy as np
    >>> from jaxekf.simulation import attitude_runs, gyro_free_runs
    >>> motion, t, h = attitude_runs.free_motion(1, rest_s=0.0), np.array([1.0]), 1e-6
    >>> slope = (motion.attitude(t + h)[1] - motion.attitude(t - h)[1]) / (2.0 * h)
    >>> np.allclose(gyro_free_runs.angular_acceleration(motion, t), slope, atol=1e-5)
    True
    """
    angle, speed = motion.angles(t)
    (x, y, _), (dx, dy, dz) = angle.T, speed.T
    amplitude, frequency, phase = motion.amplitude, motion.frequency, motion.phase
    ddx = ddy = ddz = np.zeros(len(t))
    if amplitude is not None and frequency is not None and phase is not None:
        turning = 2.0 * np.pi * frequency
        swing = amplitude * np.sin(turning * t[:, None, None] + phase)
        ddx, ddy, ddz = -(turning**2 * swing).sum(axis=2).T
    sx, cx, sy, cy = np.sin(x), np.cos(x), np.sin(y), np.cos(y)
    v = np.stack([np.zeros_like(x), cx, -sx], axis=1)
    u = np.stack([-sy, cy * sx, cy * cx], axis=1)
    ex = np.array([1.0, 0.0, 0.0])
    v_slope = -dx[:, None] * np.cross(ex, v)
    u_slope = -dx[:, None] * np.cross(ex, u) - dy[:, None] * np.cross(v, u)
    return (
        ddx[:, None] * ex
        + ddy[:, None] * v
        + ddz[:, None] * u
        + dy[:, None] * v_slope
        + dz[:, None] * u_slope
    )


def specific_forces(motion: ToolMotion, array: AccelerometerArray, t: Floats) -> Floats:
    """Specific force along each axis of an array (N, n), m/s^2, at times t (N,), s.

    Examples
    --------
    >>> import numpy as np
    >>> from jaxekf.simulation import camera_runs, gyro_free_runs
    >>> array, t = gyro_free_runs.handheld_array(), np.zeros(1)
    >>> forces = gyro_free_runs.specific_forces(camera_runs.resting(), array, t)
    >>> force = gyro_free_runs.mean_force(array, forces)
    >>> np.linalg.norm(force, axis=1).round(2).tolist()  # m/s^2: gravity alone
    [9.81]
    """
    q, rate = motion.attitude.attitude(t)
    force = to_scipy(q).inv().apply(motion.acceleration(t) - GRAVITY_REF)
    acceleration = angular_acceleration(motion.attitude, t)
    places, axes = np.asarray(array.positions), np.asarray(array.axes)
    # omega x (omega x p) = omega (omega . p) - |omega|^2 p.
    inward = (rate @ axes.T) * (rate @ places.T)
    inward -= np.sum(rate**2, axis=1)[:, None] * np.sum(places * axes, axis=1)
    return force @ axes.T + acceleration @ np.cross(places, axes).T + inward


def array_run(
    motion: ToolMotion,
    array: AccelerometerArray,
    *,
    seed: int,
    duration_s: float,
    grade: SurgeryGrade | None = None,
    start_ns: int = 0,
) -> ArrayRun:
    """Samples of every accelerometer axis and of the field, with white noise.

    Half an hour at 500 Hz takes some 200 MB and is simulated in blocks.

    Parameters
    ----------
    motion
        The motion.
    array
        The accelerometer array.
    seed
        Seed of the noise.
    duration_s
        Length, s.
    grade
        Noise and rate of the sensors.
    start_ns
        Time of the first sample, ns.

    Examples
    --------
    >>> from jaxekf.simulation import gyro_free_runs
    >>> motion, array = gyro_free_runs.surgical_motion(1), gyro_free_runs.handheld_array()
    >>> run = gyro_free_runs.array_run(motion, array, seed=1, duration_s=1.0)
    >>> run.readings.shape  # samples, accelerometer axes
    (501, 6)
    """
    grade = grade or SurgeryGrade()
    rng = np.random.default_rng([seed, 12])
    time_ns = sample_times(grade.hertz, duration_s, start_ns)
    count, axes = len(time_ns), len(np.asarray(array.axes))
    readings, field = np.empty((count, axes)), np.empty((count, 3))
    q, rate, position = np.empty((count, 4)), np.empty((count, 3)), np.empty((count, 3))
    for at, t in _blocks(seconds(time_ns)):
        q[at], rate[at] = motion.attitude.attitude(t)
        position[at] = motion.position(t)
        noise = grade.acceleration_sigma * rng.standard_normal((len(t), axes))
        readings[at] = specific_forces(motion, array, t) + noise
        noise = 1e-6 * grade.magnetometer_ugauss * rng.standard_normal((len(t), 3))
        field[at] = to_scipy(q[at]).inv().apply(grade.field_ref) + noise
    known = np.ones(count, bool)
    return ArrayRun(time_ns, readings, field, Encoder(time_ns, q, known, known, position), rate)


def _blocks(t: Floats) -> Iterator[tuple[slice, Floats]]:
    for start in range(0, len(t), _BLOCK):
        at = slice(start, start + _BLOCK)
        yield at, t[at]


def mean_force(array: AccelerometerArray, readings: Floats) -> Floats:
    """Specific force (N, 3), m/s^2, that alone explains the readings (N, n) best.

    A dual-axis chip measures two components only, so the whole array is needed: for the paper's, each
    component is the mean of two axes. Its noise is independent of that of the rate, which uses the
    residuals. The remaining rigid-body terms stay in; for `handheld_array`, at its origin, these are
    the centripetal terms, some mm/s^2 at a rate of 0.3 rad/s.

    Examples
    --------
    >>> import numpy as np
    >>> from jaxekf.simulation import gyro_free_runs
    >>> array, force = gyro_free_runs.handheld_array(), np.array([0.0, 0.0, 9.81])
    >>> readings = force @ np.asarray(array.axes).T  # at rest
    >>> np.allclose(gyro_free_runs.mean_force(array, readings[None]), force)
    True
    """
    return readings @ np.linalg.pinv(np.asarray(array.axes)).T


@compilation.jit
def _rates(
    array: AccelerometerArray, noise: Array, readings: Array, interval: Array, forget: Array
) -> Array:
    start = jnp.zeros(3)
    found = track(array, noise, readings, start, interval, forget_s=forget)
    return restored(found.rate, start, interval, forget)


def array_rate(
    array: AccelerometerArray, readings: Floats, grade: SurgeryGrade, forget_s: float = FORGET_S
) -> Floats:
    """Angular rate (N, 3), rad/s, from an array's readings (N, n), with an unknown initial rate.

    It uses `jaxekf.pose_solvers.gyro_free_rate.track` with `forget_s`, and `restored`: the errors are the
    initial rate and a random walk (`rate_walk`). The rate is early by half an interval, as the backward
    difference of eq. 3 takes the angular acceleration at a sample for that of the previous interval.

    Examples
    --------
    >>> import jaxekf, numpy as np
    >>> from jaxekf.simulation import gyro_free_runs
    >>> jaxekf.set_up()
    >>> motion, array = gyro_free_runs.surgical_motion(1), gyro_free_runs.handheld_array()
    >>> run = gyro_free_runs.array_run(motion, array, seed=1, duration_s=1.0)
    >>> rate = gyro_free_runs.array_rate(array, run.readings, gyro_free_runs.SurgeryGrade())
    >>> rate.shape == run.rate.shape, bool(np.isfinite(rate).all())
    (True, True)
    """
    require_float64()
    sigma, interval = grade.acceleration_sigma, 1.0 / grade.hertz
    return np.asarray(_rates(array, sigma, readings, interval, forget_s))


def rate_walk(array: AccelerometerArray, grade: SurgeryGrade) -> Floats:
    """Random walk of an array's rate, lower-triangular factor (3, 3), rad/s^2/sqrt(Hz).

    Each step adds ``T^2 inv(M) Xi inv(M)'`` to the covariance of the rate, ``Xi`` that of the
    differences and M their linear part: per second T times that with ``Xi`` of a sample, or, as here,
    ``inv(M) Xi inv(M)'`` with ``Xi`` of a density.
    """
    linear = np.asarray(
        accelerometer_array.differences(array, grade.acceleration_density).linear, float
    )
    return np.asarray(np.linalg.cholesky(np.linalg.inv(linear.T @ linear)), np.float64)


def array_recording(
    name: str,
    run: ArrayRun,
    array: AccelerometerArray,
    *,
    grade: SurgeryGrade | None = None,
    forget_s: float = FORGET_S,
) -> Recording:
    """A run as that of an IMU.

    The gyroscope is the array's rate (`array_rate`), the accelerometer its mean force (`mean_force`), the
    magnetometer the field in gauss, and the encoder the ground truth.
    """
    grade = grade or SurgeryGrade()
    rate = array_rate(array, run.readings, grade, forget_s)
    imu = Imu(run.time_ns, rate, mean_force(array, run.readings), run.field)
    info = {
        "simulated": True,
        "gravity_ref": GRAVITY_REF.tolist(),
        "field_ref": (grade.field_ref / grade.field_gauss).tolist(),
    }
    return Recording(name, None, imu, run.truth, info)
