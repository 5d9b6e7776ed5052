"""Simulated runs of a tool that moves in six degrees of freedom, tracked by single markers, with an IMU."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from jaxekf._support import constants
from jaxekf.models import tight
from jaxekf.recordings.types import Encoder, Floats, Imu, Markers, Recording, Times, to_scipy
from jaxekf.simulation.attitude_runs import Motion, sample_times, seconds

GRAVITY_REF = np.array(constants.GRAVITY_REF)


@dataclass(frozen=True)
class ToolGrade:
    """Noise and rates of IMU and tracker; the defaults are an ADIS16350 and Tobergte's tracker (2009).

    Examples
    --------
    >>> from jaxekf.simulation import marker_runs
    >>> motion = marker_runs.sinusoidal_motion()
    >>> sparse = marker_runs.ToolGrade(tracker_s=0.1)
    >>> run = marker_runs.tool_recording("tool", motion, seed=1, duration_s=2.0, grade=sparse)
    >>> run.markers.position.shape  # frames, markers, m
    (21, 3, 3)
    """

    gyroscope_deg: float = 0.05
    """White noise of the rate, deg/s/sqrt(Hz)."""
    accelerometer_mg: float = 1.85
    """White noise of the specific force, mg/sqrt(Hz)."""
    bias_walk_deg: float = 0.002
    """Random walk of the gyroscope's bias, deg/s^2/sqrt(Hz)."""
    accelerometer_walk: float = 1e-3
    """Random walk of the accelerometer's bias, m/s^3/sqrt(Hz)."""
    bias_deg: float = 0.5
    """Standard deviation of the gyroscope's initial bias, deg/s."""
    accelerometer_bias: float = 0.1
    """Standard deviation of the accelerometer's initial bias, m/s^2."""
    marker_mm: float = 0.231
    """Noise of a marker's position per axis, mm."""
    imu_s: float = 0.002
    tracker_s: float = 0.018
    latency_s: float = 0.034
    """Delay, s, between a tracker frame and its arrival, at which it is stamped."""


@dataclass(frozen=True)
class ToolMotion:
    """A smooth pose over time: `Motion` for the attitude, sinusoids for the position.

    Examples
    --------
    >>> import numpy as np
    >>> from jaxekf.simulation import marker_runs
    >>> motion, t, h = marker_runs.sinusoidal_motion(), np.array([1.0]), 1e-6
    >>> slope = (motion.position(t + h) - motion.position(t - h)) / (2.0 * h)
    >>> np.allclose(motion.velocity(t), slope)
    True
    """

    attitude: Motion
    amplitude: Floats
    """(3, m) metres."""
    frequency: Floats
    """(3, m) hertz."""
    phase: Floats
    """(3, m) radians."""

    def position(self, t: Floats) -> Floats:
        """(N, 3) metres in the reference frame."""
        return (self.amplitude * np.sin(self._argument(t))).sum(axis=2)

    def velocity(self, t: Floats) -> Floats:
        """(N, 3), m/s, reference frame."""
        turning = 2.0 * np.pi * self.frequency
        return (self.amplitude * turning * np.cos(self._argument(t))).sum(axis=2)

    def acceleration(self, t: Floats) -> Floats:
        """(N, 3), m/s^2, reference frame."""
        squared = (2.0 * np.pi * self.frequency) ** 2
        return -(self.amplitude * squared * np.sin(self._argument(t))).sum(axis=2)

    def _argument(self, t: Floats) -> Floats:
        return 2.0 * np.pi * self.frequency * t[:, None, None] + self.phase


def sinusoidal_motion() -> ToolMotion:
    """One sinusoid in each of the six degrees of freedom, as in the simulation of Tobergte (2009).

    Examples
    --------
    >>> import numpy as np
    >>> from jaxekf.simulation import marker_runs
    >>> t = np.linspace(0.0, 20.0, 2001)
    >>> np.abs(marker_runs.sinusoidal_motion().position(t)).max(axis=0).round(3).tolist()  # m
    [0.05, 0.04, 0.03]
    """
    attitude = Motion(
        amplitude=np.deg2rad([[10.0], [8.0], [12.0]]),
        frequency=np.array([[0.3], [0.25], [0.2]]),
        phase=np.array([[0.0], [1.0], [2.0]]),
    )
    return ToolMotion(
        attitude,
        np.array([[0.05], [0.04], [0.03]]),
        np.array([[0.25], [0.3], [0.2]]),
        np.array([[0.5], [0.0], [1.5]]),
    )


def free_tool_motion(seed: int) -> ToolMotion:
    """A random smooth hand motion: some 10 cm and 0.5 rad, below 1 Hz.

    Examples
    --------
    >>> import numpy as np
    >>> from jaxekf.simulation import marker_runs
    >>> position = marker_runs.free_tool_motion(1).position(np.linspace(0.0, 20.0, 2001))
    >>> bool((np.abs(position) < 0.15).all())  # m
    True
    """
    rng = np.random.default_rng([seed, 2])
    size = (3, 3)
    attitude = Motion(
        amplitude=rng.uniform(0.05, 0.25, size),
        frequency=rng.uniform(0.1, 0.7, size),
        phase=rng.uniform(0.0, 2.0 * np.pi, size),
    )
    return ToolMotion(
        attitude,
        rng.uniform(0.01, 0.05, size),
        rng.uniform(0.1, 0.7, size),
        rng.uniform(0.0, 2.0 * np.pi, size),
    )


@dataclass(frozen=True)
class Tool:
    """Marker positions in the IMU's frame.

    Examples
    --------
    >>> import numpy as np
    >>> from jaxekf.simulation import marker_runs
    >>> tool = marker_runs.Tool(("a", "b", "c", "d"), 0.1 * np.vstack([np.zeros(3), np.eye(3)]))
    >>> motion = marker_runs.free_tool_motion(1)
    >>> marker_runs.tool_recording("t", motion, seed=1, duration_s=1.0, tool=tool).markers.names
    ('a', 'b', 'c', 'd')
    """

    names: tuple[str, ...] = ("1", "2", "3")
    p_body_marker: Floats = field(default_factory=tight.L_SHAPE.copy)
    """(M, 3) metres; by default an L with legs of 10 cm and the IMU at its corner."""


Hidden = Sequence[tuple[str, float, float]]
"""Marker, and the times in seconds from and to which it is hidden."""


def cyclic(names: Sequence[str], duration_s: float, begin_s: float, each_s: float = 0.25) -> Hidden:
    """Occlusions that leave one marker visible at a time, each for `each_s` in turn, from `begin_s` on.

    Examples
    --------
    >>> from jaxekf.simulation import marker_runs
    >>> marker_runs.cyclic(("1", "2"), duration_s=2.0, begin_s=1.0, each_s=0.5)
    [('2', 1.0, 1.5), ('1', 1.5, 2.0)]
    """
    hidden = []
    count = int(np.ceil((duration_s - begin_s) / each_s))
    for i in range(count):
        start = begin_s + i * each_s
        shown = names[i % len(names)]
        hidden += [(name, start, start + each_s) for name in names if name != shown]
    return hidden


class Unrecorded(NamedTuple):
    """Ground truth at the IMU's times that no recording holds; each (N, 3).

    Examples
    --------
    >>> from jaxekf.simulation import marker_runs
    >>> motion = marker_runs.sinusoidal_motion()
    >>> run, truth = marker_runs.tool_run("tool", motion, seed=1, duration_s=2.0)
    >>> truth.velocity.shape == truth.bias.shape == run.need_imu().gyroscope.shape
    True
    """

    velocity: Floats
    """m/s, reference frame."""
    bias: Floats
    """Gyroscope bias, rad/s, body frame."""
    accelerometer_bias: Floats
    """m/s^2, body frame."""


def tool_recording(
    name: str,
    motion: ToolMotion,
    *,
    seed: int,
    duration_s: float,
    grade: ToolGrade | None = None,
    tool: Tool | None = None,
    hidden: Hidden = (),
    start_ns: int = 0,
) -> Recording:
    """Record a motion as single markers, with an IMU and the true pose at the IMU's times.

    Parameters
    ----------
    name
        Name of the run.
    motion
        The motion.
    seed
        Seed of all noise.
    duration_s
        Length, s.
    grade
        Noise and rates of the sensors.
    tool
        Marker positions.
    hidden
        Occlusions of single markers.
    start_ns
        Time of the first samples, ns; the first frame is taken then, and arrives and is stamped later by
        the latency.

    Examples
    --------
    >>> from jaxekf.simulation import marker_runs
    >>> motion = marker_runs.sinusoidal_motion()
    >>> hidden = [("1", 0.5, 1.0)]
    >>> run = marker_runs.tool_recording("tool", motion, seed=1, duration_s=2.0, hidden=hidden)
    >>> list(run.streams), bool(run.markers.visible[:, 0].all()), bool(run.markers.visible[:, 1].all())
    (['markers', 'imu', 'encoder'], False, True)
    """
    return tool_run(
        name,
        motion,
        seed=seed,
        duration_s=duration_s,
        grade=grade,
        tool=tool,
        hidden=hidden,
        start_ns=start_ns,
    )[0]


def tool_run(
    name: str,
    motion: ToolMotion,
    *,
    seed: int,
    duration_s: float,
    grade: ToolGrade | None = None,
    tool: Tool | None = None,
    hidden: Hidden = (),
    start_ns: int = 0,
) -> tuple[Recording, Unrecorded]:
    """The same as `tool_recording`, with the ground truth that a recording does not hold.

    Examples
    --------
    >>> import numpy as np
    >>> from jaxekf.simulation import marker_runs
    >>> motion = marker_runs.sinusoidal_motion()
    >>> run, truth = marker_runs.tool_run("tool", motion, seed=1, duration_s=2.0)
    >>> np.allclose(truth.velocity[0], motion.velocity(np.zeros(1)))
    True
    """
    grade, tool = grade or ToolGrade(), tool or Tool()
    rng = np.random.default_rng([seed, 6])
    taken = sample_times(1.0 / grade.tracker_s, duration_s, start_ns)
    imu_ns = sample_times(1.0 / grade.imu_s, duration_s, start_ns)
    markers = tool_markers(motion, tool, taken, rng, grade, hidden)
    info = {"simulated": True, "seed": seed, "gravity_ref": GRAVITY_REF.tolist()}
    return with_truth(Recording(name, info=info, markers=markers), motion, imu_ns, rng, grade)


def with_truth(
    tracked: Recording,
    motion: ToolMotion,
    imu_ns: Times,
    rng: np.random.Generator,
    grade: ToolGrade,
) -> tuple[Recording, Unrecorded]:
    """A run of a tracker alone with the IMU, the true pose and velocity at the IMU's times."""
    t = seconds(imu_ns)
    q, _ = motion.attitude.attitude(t)
    known = np.ones(len(imu_ns), bool)
    truth = Encoder(imu_ns, q, known, known, motion.position(t))
    gravity_ref = np.array(tracked.info["gravity_ref"])
    imu, *biases = tool_imu(motion, imu_ns, rng, grade, gravity_ref)
    return tracked.replace(imu=imu, encoder=truth), Unrecorded(motion.velocity(t), *biases)


def tool_markers(
    motion: ToolMotion,
    tool: Tool,
    taken_ns: Times,
    rng: np.random.Generator,
    grade: ToolGrade,
    hidden: Hidden,
) -> Markers:
    """The tracker's measurement of the tool; hidden markers are NaN."""
    t = seconds(taken_ns)
    q, _ = motion.attitude.attitude(t)
    arms = np.stack([to_scipy(q).apply(place) for place in tool.p_body_marker], axis=1)
    exact = motion.position(t)[:, None] + arms
    measured = exact + 1e-3 * grade.marker_mm * rng.standard_normal(exact.shape)
    visible = np.ones(measured.shape[:2], bool)
    for name, begin, end in hidden:
        visible[(t >= begin) & (t < end), tool.names.index(name)] = False
    measured[~visible] = np.nan
    latency = round(grade.latency_s * 1e9)
    return Markers(
        taken_ns + latency, measured, visible, tool.names, tool.p_body_marker, latency_ns=latency
    )


def tool_imu(
    motion: ToolMotion,
    time_ns: Times,
    rng: np.random.Generator,
    grade: ToolGrade,
    gravity_ref: Floats = GRAVITY_REF,
) -> tuple[Imu, Floats, Floats]:
    """Gyroscope and accelerometer with white noise and random-walk biases, and these biases."""
    t = seconds(time_ns)
    q, rate = motion.attitude.attitude(t)
    force = to_scipy(q).inv().apply(motion.acceleration(t) - gravity_ref)
    dt = grade.imu_s
    gyroscope = np.deg2rad([grade.gyroscope_deg, grade.bias_walk_deg, grade.bias_deg])
    turning, bias = _biased(rate, rng, dt, *gyroscope)
    white = 1e-3 * constants.STANDARD_GRAVITY * grade.accelerometer_mg
    walk, start = grade.accelerometer_walk, grade.accelerometer_bias
    pushing, accelerometer_bias = _biased(force, rng, dt, white, walk, start)
    return Imu(time_ns, turning, pushing), bias, accelerometer_bias


def _biased(
    exact: Floats, rng: np.random.Generator, dt: float, white: float, walk: float, start: float
) -> tuple[Floats, Floats]:
    """Samples with white noise and a bias that starts at random and is a random walk, and that bias."""
    first = start * rng.standard_normal(3)
    steps = walk * np.sqrt(dt) * rng.standard_normal(exact.shape)
    noise = white / np.sqrt(dt) * rng.standard_normal(exact.shape)
    bias = first + np.cumsum(steps, axis=0)
    return exact + bias + noise, bias


def raw_yaw(q: Floats) -> Floats:
    """Heading (N,) in radians of quaternions (N, 4).

    Examples
    --------
    >>> import numpy as np
    >>> from jaxekf.simulation import marker_runs
    >>> quarter_turn_about_z = np.sqrt([[0.5, 0.0, 0.0, 0.5]])
    >>> np.rad2deg(marker_runs.raw_yaw(quarter_turn_about_z)).round(6).tolist()
    [90.0]
    """
    return to_scipy(q).as_euler("ZYX")[:, 0]
