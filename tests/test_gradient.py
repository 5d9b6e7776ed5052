"""The gradient of every objective, where it could be wrong or not finite (row 4).

Each case would catch a branch that divides by zero, a mask that leaks NaN into the reverse pass, or a
term that the reverse pass forgets.
"""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxekf import get_model, jit, simulate
from jaxekf.models import REGISTRY
from jaxekf.parameters import as_arrays
from tuning import noise, objectives
from tuning.data import prepare

TERMS = ("attitude", "rate", "likelihood")
DURATION_S = 0.8


def perfect(record):
    """A run with exact measurements: every residual is exactly zero at the start."""
    grade = simulate.SensorGrade(0.0, 0.0, 0.0, 0.0, 0.0)
    motion = simulate.Motion()
    return simulate.recording(record, motion, seed=0, duration_s=DURATION_S, grade=grade)


def moving(name, seed, rest_s=0.1):
    motion = simulate.free_motion(seed, speed_deg=60.0, rest_s=rest_s)
    return simulate.recording(
        name, motion, seed=seed, duration_s=DURATION_S, occlusions=[(0.3, 0.45)]
    )


def hide(data, which):
    """Data with some tracker samples masked, at the level of arrays."""
    group = "slow" if "optical" in data.steps.slow else "fast"
    rows = getattr(data.steps, group)["optical"]
    mask = np.array(rows.mask)
    mask[:, which] = False
    changed = getattr(data.steps, group) | {"optical": rows._replace(mask=jnp.asarray(mask))}
    return data._replace(steps=data.steps._replace(**{group: changed}))


@partial(jax.jit, static_argnums=(0, 1))
def values(model, where, free, base, data):
    found = objectives.terms(model, where.from_free(free, base), data, TERMS)
    return jnp.stack([found[name] for name in TERMS])


@partial(jit, static_argnums=(0, 1))
def gradient(model, where, free, base, data, weights):
    _, pull = jax.vjp(lambda f: values(model, where, f, base, data), free)
    return pull(weights)[0]


def by_differences(model, where, free, base, data, weights, h=2e-3):
    """Fourth-order central differences of the weighted terms."""
    found = []
    for i in range(len(free)):
        step = jnp.zeros_like(free).at[i].set(h)
        f = [
            float(values(model, where, free + k * step, base, data) @ weights)
            for k in (-2, -1, 1, 2)
        ]
        found.append((f[0] - 8 * f[1] + 8 * f[2] - f[3]) / (12 * h))
    return np.array(found)


def start_of(model):
    """Defaults, the clock off the instants: there the objective is once, not twice differentiable, and
    differences of it would be worse than the gradient they check."""
    base = as_arrays(model.parameters)
    if not hasattr(base.calibration, "clock_offset"):
        return base
    calibration = base.calibration._replace(clock_offset=jnp.asarray(1.3e-3))
    return base._replace(calibration=calibration)


CASES = {
    "moving": lambda model: prepare(model, [moving("a", 1), moving("b", 2)]),
    "at rest": lambda model: prepare(model, [moving("a", 1, 9.0), moving("b", 2, 9.0)]),
    "at identity, exact": lambda model: prepare(model, [perfect("a"), perfect("b")]),
    "all hidden": lambda model: hide(prepare(model, [moving("a", 1), moving("b", 2)]), slice(None)),
    "first missing": lambda model: hide(prepare(model, [moving("a", 1), moving("b", 2)]), slice(1)),
}


@pytest.mark.parametrize("case", CASES)
@pytest.mark.parametrize("name", REGISTRY)
def test_gradient_matches_central_differences(name, case):
    model = get_model(name)
    data = CASES[case](model)
    base = start_of(model)
    where = noise.layout(
        model, base, [s for s in ("noise", "calibration", "initial") if getattr(base, s)]
    )
    free = where.to_free(base)
    for weights in (*np.eye(3), np.array([1.0, 0.1, 0.5])):
        got = np.asarray(gradient(model, where, free, base, data, jnp.asarray(weights)))
        expected = by_differences(model, where, free, base, data, weights)
        size = np.linalg.norm(expected)
        value = abs(float(values(model, where, free, base, data) @ weights))
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
    base = noise.with_axes(model, model.parameters, axes)
    where = noise.layout(model, base)
    free = where.to_free(base) + 0.05 * np.random.default_rng(0).standard_normal(
        len(where.labels())
    )
    weights = np.array([1.0, 0.1, 0.5])
    got = np.asarray(gradient(model, where, free, base, data, jnp.asarray(weights)))
    expected = by_differences(model, where, free, base, data, weights)
    assert np.linalg.norm(got - expected) <= 1e-6 * np.linalg.norm(expected)
    assert np.all(np.abs(got) > 0.0)
