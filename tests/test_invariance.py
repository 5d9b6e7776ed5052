"""Changes of description that must not change the estimate."""

import jax
import numpy as np
import oracle
import pytest
import scenario
from hypothesis import given, settings
from hypothesis import strategies as st

from jaxekf.estimation import timeline
from jaxekf.filtering import ekf
from jaxekf.models import REGISTRY

NAMES = ("loose", "loose_rate", "loose_additive")
SHIFT_NS = 1_700_000_000 * 1_000_000_000
TOLERANCE = 1e-9


def filtered(name, recording):
    """Timeline and output of a recording, from its own first samples."""
    model = REGISTRY[name]
    line = timeline.build(model, recording)
    params = scenario.as_arrays(model.parameters)
    belief = scenario.as_arrays(ekf.initial_belief(model, params, line.first))
    return line, scenario.run_filter(model, params, belief, line.steps).instants


REFERENCE = {}


def reference(name):
    if name not in REFERENCE:
        REFERENCE[name] = filtered(name, scenario.recording(2))
    return REFERENCE[name]


def turned(name, belief, r):
    """The belief in a reference frame turned by the quaternion `r`."""
    left, matrix = oracle.left_matrix(r), oracle.matrix(r)
    q, *rest = (np.asarray(leaf) for leaf in belief.mean)
    cov = np.asarray(belief.cov)
    if name == "loose_additive":
        rest = [value @ matrix.T for value in rest]
        change = oracle.block_diagonal([left, matrix, matrix])
        cov = change @ cov @ change.T
    return [q @ left.T, *rest], cov


def assert_same(name, actual, mean, cov):
    """Beliefs equal, attitudes as rotations.

    An additive quaternion of the other sign has cross-covariances of the other sign.
    """
    q, *rest = (np.asarray(leaf) for leaf in actual.mean)
    sign = np.where(np.sum(q * mean[0], axis=-1) < 0.0, -1.0, 1.0)
    np.testing.assert_allclose(sign[..., None] * q, mean[0], rtol=0, atol=TOLERANCE)
    for got, wanted in zip(rest, mean[1:], strict=True):
        np.testing.assert_allclose(got, wanted, rtol=0, atol=TOLERANCE)
    got = np.array(actual.cov)
    if name == "loose_additive":
        got[..., :4, 4:] *= sign[..., None, None]
        got[..., 4:, :4] *= sign[..., None, None]
    np.testing.assert_allclose(got, cov, rtol=0, atol=TOLERANCE)


@pytest.mark.parametrize("name", NAMES)
@settings(max_examples=15)
@given(flipped=st.sets(st.integers(0, 9), min_size=1))
def test_sign_of_measured_quaternions(name, flipped):
    """A residual that takes q and -q for different rotations, in the start or in an update."""
    recording = scenario.recording(2)
    q = recording.optical.q_ref_body.copy()
    q[sorted(flipped)] *= -1.0
    optical = type(recording.optical)(
        recording.optical.time_ns, q, recording.optical.valid, recording.optical.position
    )
    _, actual = filtered(name, recording.replace(optical=optical))
    _, expected = reference(name)
    assert_same(name, actual.updated, list(expected.updated.mean), expected.updated.cov)
    np.testing.assert_allclose(
        actual.log_likelihood, expected.log_likelihood, rtol=0, atol=TOLERANCE
    )


@pytest.mark.parametrize("name", NAMES)
def test_start_time(name):
    """Times that pass through a float before they are subtracted."""
    line, expected = reference(name)
    later, actual = filtered(name, scenario.recording(2, start_ns=SHIFT_NS))
    np.testing.assert_array_equal(later.time_ns - SHIFT_NS, line.time_ns)
    np.testing.assert_allclose(later.steps.dt, line.steps.dt, rtol=0, atol=1e-15)
    assert line.steps.dt.max() > 0.0
    jax.tree.map(
        lambda a, b: np.testing.assert_allclose(a, b, rtol=0, atol=TOLERANCE), actual, expected
    )


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("seed", range(4))
def test_turned_reference_frame(name, seed):
    """An error on the wrong side, or a vector left in the wrong frame."""
    r = np.random.default_rng([seed, 31]).standard_normal(4)
    r = r / np.linalg.norm(r)
    recording = scenario.recording(2, turn=r, turn_rate=name == "loose_additive")
    _, actual = filtered(name, recording)
    _, expected = reference(name)
    for stage in ("predicted", "updated"):
        mean, cov = turned(name, getattr(expected, stage), r)
        assert_same(name, getattr(actual, stage), mean, cov)
    np.testing.assert_allclose(
        actual.log_likelihood, expected.log_likelihood, rtol=0, atol=TOLERANCE
    )
