"""A factor of covariances that may lack full rank."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from jaxekf import jit
from jaxekf.geometry.linalg import semidefinite_factor

factor = jit(semidefinite_factor)


@given(st.integers(0, 2**32 - 1), st.integers(0, 4), st.sampled_from([1e-12, 1.0, 1e12]))
def test_semidefinite_factor(seed, rank, scale):
    """A factor that is not one, whatever the rank; rounding that makes a singular one NaN."""
    rng = np.random.default_rng(seed)
    root = rng.normal(size=(4, rank)) * np.array([[1.0], [1e-4], [30.0], [1.0]])
    matrix = scale * root @ root.T
    lower = np.asarray(factor(matrix))
    bound = np.sqrt(np.outer(np.diag(matrix), np.diag(matrix)))
    assert np.all(np.abs(lower @ lower.T - matrix) <= 1e-6 * bound)
    np.testing.assert_array_equal(np.triu(lower, 1), 0.0)
    if rank == 4 and np.linalg.cond(matrix) < 1e10:
        np.testing.assert_allclose(
            lower, np.linalg.cholesky(matrix), rtol=1e-5, atol=1e-9 * scale**0.5
        )


def test_rounding_beside_small_variances():
    """A singular covariance that looks indefinite once a variance of 1e-10 has been taken out."""
    rng = np.random.default_rng(12)
    for _ in range(20):
        root = np.vstack([[1.0, 0.0], [1.0, 1e-5], rng.normal(size=(2, 2))])
        matrix = root @ root.T
        lower = np.asarray(factor(matrix))
        bound = np.sqrt(np.outer(np.diag(matrix), np.diag(matrix)))
        assert np.all(np.abs(lower @ lower.T - matrix) <= 1e-3 * bound)


def test_what_is_no_covariance_is_not_mended():
    """A variance below zero, or a covariance without variance, that is quietly taken for none."""
    indefinite = [
        np.diag([1.0, -1e-3, 1.0, 1.0]),
        np.array([[0, 1, 0, 0], [1, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1.0]]),
        np.array([[1, 1.1, 0, 0], [1.1, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1.0]]),
        np.array([[1, 1, 1, 0], [1, 1, 0, 0], [1, 0, 1, 0], [0, 0, 0, 1.0]]),
    ]
    for matrix in indefinite:
        assert np.linalg.eigvalsh(matrix)[0] < 0.0
        assert np.any(np.isnan(factor(matrix)))
    lanes = np.stack([indefinite[0], np.eye(4), np.zeros((4, 4))], axis=-1)
    found = np.asarray(factor(lanes))
    np.testing.assert_array_equal(found[..., 1:], lanes[..., 1:])
    assert np.any(np.isnan(found[..., 0]))
