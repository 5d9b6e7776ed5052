"""What only shows after very many steps."""

import os

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxekf import get_model, jit, run_filter
from jaxekf.estimation.parameters import as_arrays
from jaxekf.filtering.model import Belief
from jaxekf.filtering.steps import Knots, Rows, Steps
from jaxekf.geometry import rotation

DT = 0.005


def long_steps(count, seed=0):
    """A wandering gyroscope at 200 Hz; the tracker at every third instant, hidden for up to 10 s."""
    rng = np.random.default_rng([seed, 31])
    time = DT * np.arange(count)
    value = np.cumsum(0.02 * rng.standard_normal((count, 3)), axis=0)
    value = 1.5 * np.sin(value)
    areas = 0.5 * DT * (value[1:] + value[:-1])
    knots = Knots(time, value, np.concatenate([np.zeros((1, 3)), np.cumsum(areas, axis=0)]))
    seen = np.arange(count) % 3 == 0
    for begin in rng.integers(0, count, count // 20_000):
        seen[begin : begin + rng.integers(100, 2_000)] = False
    dt = np.full((count, 1), DT)
    dt[0] = 0.0

    @jax.jit
    def truth(turns):
        def step(q, turn):
            q = rotation.normalise(rotation.product(q, rotation.exp(turn)))
            return q, q

        return jax.lax.scan(step, jnp.array([1.0, 0.0, 0.0, 0.0]), turns)[1]

    q = truth(np.concatenate([np.zeros((1, 3)), areas]))
    noise = np.deg2rad(0.3) * rng.standard_normal((count, 3))
    measured = np.asarray(
        jax.jit(jax.vmap(lambda q, n: rotation.product(q, rotation.exp(n))))(q, noise)
    )
    mask = np.repeat(seen[:, None, None], 3, axis=2)
    rows = Rows(measured[:, None], None, mask, np.full((count, 1), 3 * DT))
    return Steps(time[:, None], dt, np.ones((count, 1), bool), knots, {"optical": rows}, {})


@pytest.mark.long
def test_covariance_stays_definite_and_quaternion_unit():
    """A form of the update that loses definiteness, or a norm that drifts: a million steps with gaps
    (a hundred thousand in short)."""
    count = 1_000_000 if os.environ.get("JAXEKF_LONG") else 100_000
    model = get_model("loose")
    params = as_arrays(model.parameters)
    steps = jax.tree.map(jnp.asarray, long_steps(count))
    belief = Belief(model.initial_mean({}), model.initial_covariance(params))

    @jit
    def run(params, belief, steps):
        at = run_filter(model, params, belief, steps, keep="estimates").instants
        return at.updated, at.healthy

    updated, healthy = run(params, belief, steps)
    assert bool(healthy.all())
    cov = np.asarray(updated.cov)[:, 0]
    deviations = np.sqrt(np.diagonal(cov, axis1=1, axis2=2))
    scaled = cov / deviations[:, :, None] / deviations[:, None]
    np.testing.assert_array_equal(cov, cov.swapaxes(1, 2))
    smallest = np.linalg.eigvalsh(scaled)[:, 0]
    # An attitude and its bias are correlated, but neither tells the other.
    assert smallest.min() > 1e-4
    norm = np.linalg.norm(np.asarray(updated.mean.q_ref_body)[:, 0], axis=1)
    assert np.abs(norm - 1.0).max() < 1e-12
