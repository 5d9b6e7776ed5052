"""The gradient of every objective, where it could be wrong or not finite (row 4).

Each case would catch a branch that divides by zero, a mask that leaks NaN into the reverse pass, or a
term that the reverse pass forgets.
"""

from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxekf import get_model, jit
from jaxekf.estimation.parameters import as_arrays
from jaxekf.models import REGISTRY
from jaxekf.simulation import attitude_runs, camera_runs, marker_runs
from tuning.objective import objectives
from tuning.objective.data import prepare
from tuning.parametrisation import free_vector

TERMS = ("attitude", "rate", "likelihood")
DURATION_S = 0.8


# `loose_pose` has all but its sensor in common with `tight`, and takes as long to compile; so has
# `visual_bilinear` with `visual`, and noise that follows from an image beside.
NAMES = [name for name in REGISTRY if name not in ("loose_pose", "visual_bilinear")]


def perfect(model, record):
    """A run with exact measurements: every residual is exactly zero at the start."""
    if model.name == "tight":
        grade = marker_runs.ToolGrade(*[0.0] * 7, imu_s=0.01, tracker_s=0.02)
        return tool(record, 0, STILL, grade)
    if model.name == "visual":
        grade = camera_runs.CameraGrade(
            imu=marker_runs.ToolGrade(*[0.0] * 7, imu_s=0.01), pixel=0.0
        )
        return camera(record, 0, camera_runs.resting(), grade)
    grade = attitude_runs.SensorGrade(0.0, 0.0, 0.0, 0.0, 0.0, accelerometer=0.0, magnetometer=0.0)
    motion = attitude_runs.Motion()
    return attitude_runs.recording(record, motion, seed=0, duration_s=DURATION_S, grade=grade)


def moving(model, name, seed, rest_s=0.1):
    if model.name == "tight":
        motion = STILL if rest_s > DURATION_S else marker_runs.free_tool_motion(seed)
        grade = marker_runs.ToolGrade(imu_s=0.01, tracker_s=0.02)
        return tool(name, seed, motion, grade)
    if model.name == "visual":
        motion = camera_runs.resting() if rest_s > DURATION_S else camera_runs.eight(seed)
        return camera(name, seed, motion, camera_runs.CameraGrade())
    motion = attitude_runs.free_motion(seed, speed_deg=60.0, rest_s=rest_s)
    hidden = [(0.3, 0.45)]
    grade = attitude_runs.SensorGrade(accelerometer=2e-3, magnetometer=0.01)
    return attitude_runs.recording(
        name, motion, seed=seed, duration_s=DURATION_S, grade=grade, occlusions=hidden
    )


NOTHING = np.zeros((3, 1))
STILL = marker_runs.ToolMotion(
    attitude_runs.Motion(amplitude=NOTHING, frequency=NOTHING, phase=NOTHING),
    NOTHING,
    NOTHING,
    NOTHING,
)


def camera(name, seed, motion, grade):
    grade = replace(grade, points=8, camera_hz=25.0)
    return camera_runs.camera_recording(
        name, motion, seed=seed, duration_s=DURATION_S, grade=grade, blind=((0.3, 0.45),)
    )


def tool(name, seed, motion, grade):
    hidden = [("1", 0.3, 0.45), ("2", 0.3, 0.45), ("3", 0.4, 0.6)]
    return marker_runs.tool_recording(
        name, motion, seed=seed, duration_s=DURATION_S, grade=grade, hidden=hidden
    )


def hide(data, which):
    """Data with some of the samples masked, at the level of arrays; never the gyroscope's."""

    def hidden(rows):
        mask = np.array(rows.mask)
        mask[:, which] = False
        return rows._replace(mask=jnp.asarray(mask))

    def without(sensors):
        return {k: v if k == "gyroscope" else hidden(v) for k, v in sensors.items()}

    steps = data.steps
    return data._replace(steps=steps._replace(fast=without(steps.fast), slow=without(steps.slow)))


@partial(jax.jit, static_argnums=(0, 1))
def values(model, where, free, base, data):
    every = objectives.shared(where.from_free(free, base), data)
    found = objectives.terms_each(model, every, data, TERMS)
    return jnp.stack([found[name] for name in TERMS])


# Inside another program its own settings of the compiler would not count.
values_alone = jit(values, static_argnums=(0, 1))


@partial(jit, static_argnums=(0, 1))
def gradient(model, where, free, base, data, weights):
    _, pull = jax.vjp(lambda f: values(model, where, f, base, data), free)
    return pull(weights)[0]


def by_differences(model, where, free, base, data, h=2e-3):
    """Fourth-order central differences of all terms, (terms, n)."""
    found = []
    for i in range(len(free)):
        step = np.zeros(len(free))
        step[i] = h
        f = [
            np.asarray(values_alone(model, where, free + k * step, base, data))
            for k in (-2, -1, 1, 2)
        ]
        found.append((f[0] - 8 * f[1] + 8 * f[2] - f[3]) / (12 * h))
    return np.array(found).T


def start_of(model):
    """Defaults, the clock off the instants: there the objective is once, not twice differentiable, and
    differences of it would be worse than the gradient they check."""
    base = as_arrays(model.parameters)
    shifts = [n for n in ("clock_offset", "latency") if hasattr(base.calibration, n)]
    calibration = base.calibration
    if shifts:
        calibration = calibration._replace(**{shifts[0]: jnp.asarray(1.3e-3)})
    return base._replace(calibration=calibration)


def two_moving(model):
    return prepare(model, [moving(model, "a", 1), moving(model, "b", 2)])


CASES = {
    "moving": two_moving,
    "at rest": lambda m: prepare(m, [moving(m, "a", 1, 9.0), moving(m, "b", 2, 9.0)]),
    "at identity, exact": lambda m: prepare(m, [perfect(m, "a"), perfect(m, "b")]),
    "all hidden": lambda m: hide(two_moving(m), slice(None)),
    "first missing": lambda m: hide(two_moving(m), slice(1)),
}


@pytest.mark.parametrize("case", CASES)
@pytest.mark.parametrize("name", NAMES)
def test_gradient_matches_central_differences(name, case):
    model = get_model(name)
    data = CASES[case](model)
    base = start_of(model)
    where = free_vector.layout(
        model, base, [s for s in ("noise", "calibration", "initial") if getattr(base, s)]
    )
    free = np.asarray(where.to_free(base))
    each = by_differences(model, where, free, base, data)
    now = np.asarray(values_alone(model, where, free, base, data))
    for weights in (*np.eye(3), np.array([1.0, 0.1, 0.5])):
        got = np.asarray(gradient(model, where, free, base, data, jnp.asarray(weights)))
        expected = weights @ each
        size = np.linalg.norm(expected)
        value = abs(float(now @ weights))
        assert np.all(np.isfinite(got))
        # The floor is the rounding of the differences themselves, for gradients that are exactly 0.
        assert np.linalg.norm(got - expected) <= 1e-6 * size + 1e-10 * (1.0 + value), (
            weights,
            got,
            expected,
        )


@pytest.mark.parametrize("axes", ["each", "full"])
def test_gradient_reaches_every_entry_of_a_full_covariance(axes):
    """Would catch a triangular factor whose off-diagonal entries or logarithms have no gradient."""
    model = get_model("loose")
    data = CASES["moving"](model)
    base = free_vector.with_axes(model, model.parameters, axes)
    where = free_vector.layout(model, base)
    free = np.asarray(where.to_free(base)) + 0.05 * np.random.default_rng(0).standard_normal(
        len(where.labels())
    )
    weights = np.array([1.0, 0.1, 0.5])
    got = np.asarray(gradient(model, where, free, base, data, jnp.asarray(weights)))
    expected = weights @ by_differences(model, where, free, base, data)
    assert np.linalg.norm(got - expected) <= 1e-6 * np.linalg.norm(expected)
    assert np.all(np.abs(got) > 0.0)
