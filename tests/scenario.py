"""Simulated runs of a tracker and a gyroscope as plain arrays, and their layouts as steps."""

import os
from collections.abc import Collection, Sequence
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from jaxekf import jit
from jaxekf._support import compilation
from jaxekf.filtering import ekf
from jaxekf.filtering.model import Parameters
from jaxekf.filtering.steps import Knots, Rows, Steps
from jaxekf.models import loose, loose_additive, loose_rate, tight
from jaxekf.recordings.types import Camera, Imu, Markers, Optical, Recording, from_scipy

LONG = os.environ.get("JAXEKF_LONG") == "1"


def long_form(values: Sequence[Any], only_long: Collection[Any]) -> list[Any]:
    """Parameters of a test, of which some are left to the long form: each takes the compiler half a minute
    and goes the way of another."""
    mark = pytest.mark.skipif(not LONG, reason="long form: set JAXEKF_LONG=1")
    return [
        pytest.param(*(v if isinstance(v, tuple) else (v,)), marks=mark) if v in only_long else v
        for v in values
    ]


ARMS = tight.L_SHAPE
BIAS = np.array([0.02, -0.015, 0.01])


# For comparisons with a tolerance: the last bit may depend on how the filter is compiled.
quick_jit = partial(jax.jit, compiler_options=compilation.QUICK)

# One compiled filter for each model and size, shared by all tests.
run_filter = jit(ekf.run_filter, static_argnums=0, compiler_options=compilation.FAST)
run_filter_quick = quick_jit(ekf.run_filter, static_argnums=0)

QUATERNION_ROWS = {"loose": 3, "loose_rate": 3, "loose_additive": 4}


def as_arrays(tree):
    """Every leaf a float64 JAX array, so that equal sizes share one compilation."""
    return jax.tree.map(lambda a: jnp.asarray(a, jnp.float64), tree)


def factor(seed, size, deviation):
    """A lower-triangular factor of a strongly correlated covariance."""
    rng = np.random.default_rng([seed, size])
    return deviation * (np.eye(size) + 0.5 * np.tril(rng.standard_normal((size, size))))


def parameters(name):
    """Correlated noise, and for `loose` a skewed, late gyroscope; every noise leaf a factor."""
    gyroscope, walk = factor(0, 3, 1e-3), factor(1, 3, 2e-3)
    optical, acceleration = factor(2, 3, 5e-3), factor(3, 3, 5.0)
    if name == "loose":
        matrix = np.eye(3) + 0.05 * np.random.default_rng(8).standard_normal((3, 3))
        noise = loose.Noise(gyroscope, walk, optical)
        turn = np.array([0.02, -0.03, 0.01])
        calibration, initial = (
            loose.Calibration(matrix, 0.0031, turn, 0.01),
            loose.Initial(0.1, 0.02),
        )
    elif name == "loose_rate":
        noise = loose_rate.Noise(acceleration, gyroscope, walk, optical)
        calibration, initial = loose_rate.Calibration(), loose_rate.Initial(0.1, 0.2, 0.02)
    else:
        sample, components = factor(22, 3, 0.01), factor(21, 4, 3e-3)
        quaternion = factor(20, 4, 1e-3)
        noise = loose_additive.Noise(quaternion, acceleration, walk, components, sample)
        calibration, initial = loose_additive.Calibration(), loose_additive.Initial(0.1, 0.2, 0.02)
    return as_arrays(Parameters(noise, calibration, initial))


class Motion(NamedTuple):
    """A smooth attitude ``exp(a(t))`` with sinusoids in the rotation vector ``a``."""

    amplitude: np.ndarray
    frequency: np.ndarray
    phase: np.ndarray

    def vector(self, t):
        """``a(t)``, shape (N, 3)."""
        return self.amplitude * np.sin(t[:, None] * self.frequency + self.phase)

    def attitude(self, t):
        """Quaternions (N, 4), body to reference."""
        return from_scipy(Rotation.from_rotvec(self.vector(t)))

    def rate(self, t, step=1e-5):
        """Body rate (N, 3), by central differences of the attitude."""
        before = Rotation.from_rotvec(self.vector(t - step))
        after = Rotation.from_rotvec(self.vector(t + step))
        return (before.inv() * after).as_rotvec() / (2.0 * step)


def smooth_motion(seed):
    """A motion about all axes, of the order of 1 rad/s."""
    rng = np.random.default_rng([seed, 17])
    shape = (3,)
    return Motion(
        rng.uniform(0.3, 0.8, shape), rng.uniform(1.0, 3.0, shape), rng.uniform(0, 6, shape)
    )


def rotation_of(q):
    """SciPy's rotations of quaternions (N, 4)."""
    return Rotation.from_quat(np.roll(q, -1, axis=1))


class Run(NamedTuple):
    """Events of one run, N of them, each an instant at which the filter steps."""

    time: np.ndarray
    truth: np.ndarray
    optical: np.ndarray
    optical_there: np.ndarray
    """(N,) whether the tracker was sampled, seen or hidden."""
    optical_seen: np.ndarray
    gyroscope: np.ndarray
    gyroscope_seen: np.ndarray
    """(N, 3) rows."""
    knots: Knots


def noisy_attitude(rng, truth, deviation):
    """Attitudes with a random rotation on the right and a random sign."""
    noise = Rotation.from_rotvec(deviation * rng.standard_normal((len(truth), 3)))
    measured = from_scipy(Rotation.from_quat(np.roll(truth, -1, axis=1)) * noise)
    return measured * rng.choice([-1.0, 1.0], len(truth))[:, None]


def knots_of(time, value):
    """A sampled input with its running integral."""
    areas = 0.5 * (value[1:] + value[:-1]) * np.diff(time)[:, None]
    return Knots(time, value, np.concatenate([np.zeros((1, 3)), np.cumsum(areas, axis=0)]))


def make_run(seed, count=40):
    """A run at uneven instants about 8 ms apart, the tracker at every fourth, hidden a while."""
    rng = np.random.default_rng([seed, 3])
    motion = smooth_motion(seed)
    time = 0.008 * np.arange(count) + 0.001 * rng.uniform(-1.0, 1.0, count)
    time[0] = 0.0
    truth, rate = motion.attitude(time), motion.rate(time)
    there = np.arange(count) % 4 == 0
    hidden = (np.arange(count) >= count // 2) & (np.arange(count) < count // 2 + 9)
    knot_time = np.arange(-0.02, time[-1] + 0.03, 0.0093)
    knot_value = motion.rate(knot_time) + BIAS + 0.01 * rng.standard_normal((len(knot_time), 3))
    return Run(
        time,
        truth,
        noisy_attitude(rng, truth, 0.005),
        there,
        there & ~hidden,
        rate + BIAS + 0.01 * rng.standard_normal((count, 3)),
        rng.uniform(size=(count, 1)) * np.ones((1, 3)) < 0.9,
        knots_of(knot_time, knot_value),
    )


def optical_mask(run, name):
    """Row masks (N, rows) of the tracker for the model `name`."""
    return np.repeat(run.optical_seen[:, None], QUATERNION_ROWS[name], axis=1)


def since_last(run):
    """Seconds (N,) since the gyroscope's previous sample."""
    return np.diff(run.time, prepend=-0.008)


def flat_steps(run, name, mask=None):
    """The run as epochs of one substep, every sensor fast."""
    mask = optical_mask(run, name) if mask is None else mask
    since = since_last(run)[:, None]
    fast = {"optical": Rows(run.optical[:, None], None, mask[:, None], since)}
    if name != "loose":
        fast["gyroscope"] = Rows(run.gyroscope[:, None], None, run.gyroscope_seen[:, None], since)
    time = run.time[:, None]
    dt = np.diff(run.time, prepend=0.0)[:, None]
    return Steps(time, dt, np.ones_like(dt, bool), run.knots if name == "loose" else None, fast, {})


def epoch_index(there, substeps):
    """Events (K, S) cut after each tracker sample, -1 in the padding in front."""
    rows, begin = [], 0
    for end in [*np.flatnonzero(there), len(there) - 1]:
        while begin <= end:
            taken = np.arange(begin, min(begin + substeps, end + 1))
            rows.append(np.concatenate([np.full(substeps - len(taken), -1), taken]))
            begin = int(taken[-1]) + 1
    return np.array(rows)


def epoch_steps(run, name, substeps, mask=None):
    """The same run in epochs, the tracker slow; also the event of each substep, (K, S)."""
    mask = optical_mask(run, name) if mask is None else mask
    index = epoch_index(run.optical_there, substeps)
    valid = index >= 0
    event = np.maximum(np.maximum.accumulate(index.reshape(-1)), 0).reshape(index.shape)
    time = run.time[event]
    dt = np.where(valid, np.diff(run.time, prepend=0.0)[event], 0.0)
    last = event[:, -1]
    since = since_last(run)
    slow = {"optical": Rows(run.optical[last], None, mask[last], since[last])}
    fast = {}
    if name != "loose":
        seen = run.gyroscope_seen[event] & valid[..., None]
        fast["gyroscope"] = Rows(run.gyroscope[event], None, seen, since[event])
    knots = run.knots if name == "loose" else None
    return Steps(time, dt, valid, knots, fast, slow), index


def recording(seed, *, rest=False, start_ns=0, turn=None, turn_rate=False):
    """A recording of 0.3 s: IMU every 10 ms, tracker every 30 ms, one of its samples hidden.

    `turn` is a quaternion that turns the reference frame; with `turn_rate` the gyroscope's vectors
    are turned too, as for a rate that is given in the reference frame.
    """
    rng = np.random.default_rng([seed, 5])
    optical_ns = np.arange(0, 300, 30, dtype=np.int64) * 1_000_000 + 3_000_000
    imu_ns = np.arange(0, 310, 10, dtype=np.int64) * 1_000_000
    still = Motion(np.zeros(3), np.zeros(3), np.zeros(3))
    motion = still if rest else smooth_motion(seed)
    scale = 0.0 if rest else 1.0
    q = exact = motion.attitude(1e-9 * optical_ns)
    if not rest:
        q = noisy_attitude(rng, q, 0.005)
    t = 1e-9 * imu_ns
    noise = 0.01 * rng.standard_normal((len(t), 3))
    gyroscope = scale * (motion.rate(t) + BIAS + noise)
    up = Rotation.from_rotvec(motion.vector(t)).inv().apply([0.0, 0.0, 9.81])
    field = np.array([0.0, 0.5, -0.8])
    magnetic = Rotation.from_rotvec(motion.vector(t)).inv().apply(field)
    magnetic += scale * 0.02 * rng.standard_normal((len(t), 3))
    gravity = np.array([0.0, 0.0, -9.81])
    if turn is not None:
        rotation = Rotation.from_quat(np.roll(turn, -1))
        q = from_scipy(rotation * Rotation.from_quat(np.roll(q, -1, axis=1)))
        gyroscope = rotation.apply(gyroscope) if turn_rate else gyroscope
        gravity, field = rotation.apply(gravity), rotation.apply(field)
        exact = from_scipy(rotation * rotation_of(exact))
    valid = np.ones(len(q), bool)
    valid[1 + seed % 5] = False
    optical = Optical(start_ns + optical_ns, q, valid, np.zeros((len(q), 3)))
    blur = scale * 2e-4 * rng.standard_normal((len(q), 3, 3))
    seen = np.stack([rotation_of(exact).apply(arm) for arm in ARMS], axis=1) + blur
    visible = valid[:, None] & np.ones((1, 3), bool)
    visible[1 + (seed + 2) % 5, 1] = False
    markers = Markers(start_ns + optical_ns, seen, visible, ("1", "2", "3"), ARMS)
    camera = _camera(rng, start_ns + optical_ns, exact, valid, scale, turn)
    info = {"gravity_ref": gravity.tolist(), "field_ref": field.tolist()}
    imu = Imu(start_ns + imu_ns, gyroscope, up, magnetic)
    return Recording("simulated", optical, imu, None, info, markers=markers, camera=camera)


def _camera(rng, time_ns, q, valid, scale, turn):
    """Eight landmarks ahead of a camera at the body's origin, in images taken with the tracker's samples;
    one is not found in one of them. `turn` turns the landmarks."""
    lens = np.array([200.0, 210.0]), np.array([160.0, 120.0])
    places = np.random.default_rng(61).uniform([-1.5, -1.5, 3.5], [1.5, 1.5, 5.0], (8, 3))
    if turn is not None:
        places = rotation_of(turn[None])[0].apply(places)
    seen = np.stack([rotation_of(q).inv().apply(place) for place in places], axis=1)
    pixel = lens[0] * seen[..., :2] / np.maximum(seen[..., 2:], 0.1) + lens[1]
    pixel += scale * 0.7 * rng.standard_normal(pixel.shape)
    found = valid[:, None] & (seen[..., 2] > 1.0)
    found[3, 2] = False
    names = tuple(f"L{i}" for i in range(len(places)))
    return Camera(time_ns, pixel, found, names, places, *lens)
