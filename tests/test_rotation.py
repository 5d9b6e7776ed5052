"""Unit quaternions: the group, its exponential, and derivatives where closed forms are 0/0."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import assume, example, given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from jaxekf.geometry import rotation

EXACT = 1e-14
product = jax.jit(rotation.product)
exp = jax.jit(rotation.exp)
log = jax.jit(rotation.log)
difference = jax.jit(rotation.difference)
right_jacobian = jax.jit(rotation.right_jacobian)
log_slope = jax.jit(jax.jacobian(rotation.log))


def to_scipy(q):
    return Rotation.from_quat(np.roll(np.asarray(q), -1, axis=-1))


@st.composite
def vectors(draw, size=3, largest=1.0):
    """Vectors in a box, not too close to zero."""
    vector = np.array(draw(st.lists(st.floats(-largest, largest), min_size=size, max_size=size)))
    assume(np.linalg.norm(vector) > 1e-3 * largest)
    return vector


@st.composite
def quaternions(draw):
    """Unit quaternions of either sign."""
    q = draw(vectors(4))
    return q / np.linalg.norm(q)


@st.composite
def rotation_vectors(draw, longest=np.pi - 1e-6):
    """Rotation vectors of any length below pi, tiny ones included."""
    direction = draw(vectors())
    size = draw(st.one_of(st.floats(0.0, longest), st.sampled_from([0.0, 1e-300, 1e-160, 1e-8])))
    return size * direction / np.linalg.norm(direction)


@given(quaternions(), quaternions(), quaternions())
def test_group_axioms(p, q, r):
    """A wrong sign in the Hamilton product, or a conjugate that is not the inverse."""
    np.testing.assert_allclose(
        product(product(p, q), r), product(p, product(q, r)), rtol=0, atol=EXACT
    )
    one = rotation.identity()
    np.testing.assert_allclose(product(one, q), q, rtol=0, atol=1e-300)
    np.testing.assert_allclose(product(q, one), q, rtol=0, atol=1e-300)
    np.testing.assert_allclose(product(q, rotation.conjugate(q)), one, rtol=0, atol=EXACT)
    np.testing.assert_allclose(np.linalg.norm(product(p, q)), 1.0, rtol=0, atol=EXACT)


@given(quaternions(), quaternions(), vectors(largest=10.0))
def test_against_scipy(p, q, v):
    """Another product, another order of the numbers, or rotations from reference to body."""
    a, b = to_scipy(p), to_scipy(q)
    np.testing.assert_allclose(
        rotation.to_matrix(product(p, q)), (a * b).as_matrix(), rtol=0, atol=EXACT
    )
    np.testing.assert_allclose(rotation.rotate(q, v), b.apply(v), rtol=0, atol=1e-13)
    np.testing.assert_allclose(rotation.rotate(q, v), rotation.to_matrix(q) @ v, rtol=0, atol=1e-13)
    np.testing.assert_allclose(rotation.rotate_inverse(q, v), b.inv().apply(v), rtol=0, atol=1e-13)


@given(rotation_vectors())
@example(np.zeros(3))
def test_exp_and_log_against_scipy(v):
    """A half-angle convention, or a series that disagrees with the closed form."""
    np.testing.assert_allclose(
        rotation.to_matrix(exp(v)), Rotation.from_rotvec(v).as_matrix(), rtol=0, atol=EXACT
    )
    np.testing.assert_allclose(log(exp(v)), v, rtol=0, atol=1e-13)
    np.testing.assert_allclose(np.linalg.norm(exp(v)), 1.0, rtol=0, atol=EXACT)


@given(quaternions())
def test_log_does_not_see_the_sign(q):
    """A log of -q that goes the long way round."""
    assume(abs(q[0]) > 1e-12)
    np.testing.assert_array_equal(log(q), log(-q))
    assert np.linalg.norm(log(q)) <= np.pi
    matrix = rotation.to_matrix(exp(log(q)))
    np.testing.assert_allclose(matrix, rotation.to_matrix(q), rtol=0, atol=EXACT)


@pytest.mark.parametrize("short_of_pi", [1e-3, 1e-7, 1e-12, 0.0])
@pytest.mark.parametrize("direction", [[1.0, 0.0, 0.0], [0.0, -1.0, 0.0], [0.6, -0.48, 0.64]])
def test_near_half_a_turn(short_of_pi, direction):
    """A log that is inaccurate, flips or is not finite where w is near 0."""
    v = (np.pi - short_of_pi) * np.array(direction)
    found = np.array(log(exp(v)))
    matrix = Rotation.from_rotvec(found).as_matrix()
    np.testing.assert_allclose(matrix, Rotation.from_rotvec(v).as_matrix(), rtol=0, atol=EXACT)
    assert abs(np.linalg.norm(found) - np.linalg.norm(v)) <= 1e-13
    np.testing.assert_array_equal(np.isfinite(log_slope(exp(v))), True)


def sinc_form(v):
    """`exp` in NumPy's own functions, good at any angle."""
    angle = np.linalg.norm(v)
    return np.concatenate([[np.cos(angle / 2)], 0.5 * np.sinc(angle / (2 * np.pi)) * v])


def left_series(v, terms=40):
    """`right_jacobian` summed as ``sum (-[v])^k / (k + 1)!``."""
    cross = np.array([[0, -v[2], v[1]], [v[2], 0, -v[0]], [-v[1], v[0], 0]])
    total, term = np.eye(3), np.eye(3)
    for k in range(1, terms):
        term = term @ -cross / (k + 1)
        total = total + term
    return total


@pytest.mark.parametrize("size", [0.0, 1e-9, 0.03, 0.0632, 0.0633, 0.0999999, 0.1000001, 0.2, 3.0])
def test_both_branches_agree_with_independent_forms(size):
    """A coefficient of a series, or a threshold at which it is no longer exact."""
    v = size * np.array([0.6, -0.48, 0.64])
    # NumPy's and XLA's sines are right to the last bit or one beside it, by the processor.
    np.testing.assert_allclose(exp(v), sinc_form(v), rtol=0, atol=4.5e-16)
    np.testing.assert_allclose(log(sinc_form(v)), v, rtol=1e-15, atol=1e-15)
    np.testing.assert_allclose(right_jacobian(v), left_series(v), rtol=0, atol=1e-14)


@pytest.mark.parametrize("size", [np.pi - 1e-9, np.pi + 1e-9, 5.0, 6.3, 9.4, 9.5, 1e3, 1e5])
def test_exp_beyond_half_a_turn(size):
    """A whole turn that is not taken off, or taken off with the wrong sign; a slope lost on the way."""
    v = size * np.array([0.6, -0.48, 0.64])
    rounding = 1e-15 + 2e-16 * size
    np.testing.assert_allclose(exp(v), sinc_form(v), rtol=0, atol=rounding)
    slope, step = jax.jacrev(rotation.exp)(jnp.asarray(v)), 1e-5
    for axis, way in enumerate(np.eye(3)):
        numeric = (sinc_form(v + step * way) - sinc_form(v - step * way)) / (2.0 * step)
        np.testing.assert_allclose(slope[:, axis], numeric, rtol=0, atol=1e-9 + rounding / step)


@given(rotation_vectors(2.5))
def test_right_jacobian(v):
    """A left Jacobian, or a transposed one."""
    step = 1e-6
    columns = []
    for e in step * np.eye(3):
        ahead, behind = difference(exp(v), exp(v + e)), difference(exp(v), exp(v - e))
        columns.append((ahead - behind) / (2 * step))
    np.testing.assert_allclose(right_jacobian(v), np.stack(columns, axis=1), rtol=0, atol=1e-9)


def round_trip(v):
    return rotation.log(rotation.exp(v))


round_trip_slope = jax.jit(jax.jacobian(round_trip))
round_trip_curvature = jax.jit(jax.hessian(round_trip))


@pytest.mark.parametrize("size", [0.0, 1e-200, 1e-9, 0.05, 0.1, 2.0])
def test_log_of_exp_is_linear(size):
    """A first derivative that is not the identity, or a second that is not zero or not finite."""
    v = size * np.array([0.6, -0.48, 0.64])
    np.testing.assert_allclose(round_trip_slope(v), np.eye(3), rtol=0, atol=1e-13)
    np.testing.assert_allclose(round_trip_curvature(v), 0.0, rtol=0, atol=1e-12)


def test_derivatives_at_zero():
    """NaN from 0/0 under differentiation, or a wrong curvature, at no rotation."""
    zero = jnp.zeros(3)
    slope = np.vstack([np.zeros(3), 0.5 * np.eye(3)])
    np.testing.assert_array_equal(jax.jit(jax.jacobian(rotation.exp))(zero), slope)
    curvature = np.zeros((4, 3, 3))
    curvature[0] = -0.25 * np.eye(3)
    np.testing.assert_array_equal(jax.jit(jax.hessian(rotation.exp))(zero), curvature)
    for function, at in (
        (rotation.log, rotation.identity()),
        (rotation.log, -rotation.identity()),
        (rotation.right_jacobian, zero),
        (lambda v: rotation.difference(rotation.identity(), rotation.exp(v)), zero),
    ):
        np.testing.assert_array_equal(np.isfinite(jax.jit(jax.jacobian(function))(at)), True)
        np.testing.assert_array_equal(np.isfinite(jax.jit(jax.hessian(function))(at)), True)


@given(vectors(4), vectors(), vectors())
def test_small_helpers(q, a, b):
    """A norm that is not one, a cross product of the wrong sign, a misplaced real part."""
    unit = rotation.normalise(q)
    np.testing.assert_allclose(np.linalg.norm(unit), 1.0, rtol=0, atol=EXACT)
    np.testing.assert_allclose(unit * np.linalg.norm(q), q, rtol=0, atol=1e-14)
    kept = np.linalg.norm(rotation.keep_unit((1.0 + 1e-7) * unit))
    np.testing.assert_allclose(kept, 1.0, rtol=0, atol=1e-13)
    np.testing.assert_allclose(rotation.skew(a) @ b, np.cross(a, b), rtol=0, atol=EXACT)
    np.testing.assert_array_equal(rotation.pure(a), [0.0, *a])
