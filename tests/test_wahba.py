"""The q-method against SciPy's solution of Wahba's problem, its derivatives, and its covariance."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from oracle import attitude_errors
from scipy.spatial.transform import Rotation

from jaxekf import jit
from jaxekf.geometry import wahba

DRAWS = 100_000
AXES = [*np.eye(3), *-np.eye(3), np.array([0.6, -0.48, 0.64]), np.array([-0.8, 0.6, 0.0])]
HALF_TURNS = [(np.pi - short) * axis for axis in AXES for short in (0.0, 1e-12, 1e-3)]
q_method = jit(wahba.q_method)
covariance = jit(wahba.q_method_covariance)
many = jit(jax.vmap(wahba.q_method, (0, None, None)))


def to_scipy(q):
    return Rotation.from_quat(np.roll(np.asarray(q), -1, axis=-1))


def unit(x):
    return x / np.linalg.norm(x, axis=-1, keepdims=True)


@st.composite
def problems(draw):
    """Directions of a body, those of the reference with errors up to large ones, weights, and a turn."""
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    turn = Rotation.random(rng=rng)
    if draw(st.booleans()):
        turn = Rotation.from_rotvec(draw(st.sampled_from(HALF_TURNS)))
    body = unit(rng.normal(size=(4, 3)))
    ref = turn.apply(unit(body + draw(st.sampled_from([0.0, 0.01, 0.3])) * rng.normal(size=(4, 3))))
    # Some take no part, so that the shape, and with it the program, stays the same.
    used = np.arange(4) < draw(st.integers(2, 4))
    weights = np.where(used, rng.uniform(0.1, 2.0, 4), 0.0)
    matrix = np.einsum("n,ni,nj->ij", weights / weights.sum(), ref, body)
    s = np.linalg.svd(matrix, compute_uv=False) * [1, 1, np.sign(np.linalg.det(matrix)) or 1]
    assume(s[1] + s[2] > 0.05)
    return body, ref, weights, turn


@given(problems())
def test_against_scipy(problem):
    """The conjugate, a wrong sign within the matrix, weights squared, or unused vectors that count."""
    body, ref, weights, _ = problem
    used = weights > 0.0
    oracle, _ = Rotation.align_vectors(ref[used], body[used], weights[used])
    scaled = body * np.array([[1.0], [1e-3], [9.81], [1e150]])
    found = q_method(scaled, ref, weights)
    assert found.valid and found.q_ref_body[0] >= 0.0
    matrix = to_scipy(found.q_ref_body).as_matrix()
    np.testing.assert_allclose(matrix, oracle.as_matrix(), rtol=0, atol=1e-12)


@given(problems(), st.integers(0, 2**32 - 1))
def test_turns_of_either_frame(problem, seed):
    """An answer that depends on the coordinates: a part of the matrix left out."""
    body, ref, weights, _ = problem
    of_ref, of_body = Rotation.random(2, rng=np.random.default_rng(seed))
    plain = to_scipy(q_method(body, ref, weights).q_ref_body)
    turned = to_scipy(q_method(of_body.apply(body), of_ref.apply(ref), weights).q_ref_body)
    expected = (of_ref * plain * of_body.inv()).as_matrix()
    np.testing.assert_allclose(turned.as_matrix(), expected, rtol=0, atol=1e-12)


@given(problems())
def test_meets_exact_directions(problem):
    """An attitude that fails at half a turn, where all directions agree."""
    body, _, weights, turn = problem
    ref = turn.apply(body)
    found = q_method(body, ref, weights).q_ref_body
    np.testing.assert_allclose(to_scipy(found).as_matrix(), turn.as_matrix(), rtol=0, atol=1e-12)


def turn_of(x, near, fallback):
    """The answer to directions and, in the last column, weights (2 n, 4), and one number of it."""
    half = len(x) // 2
    found = wahba.q_method(x[:half, :3], x[half:, :3], x[:half, 3], near=near, fallback=fallback)
    return jnp.dot(np.array([0.3, -1.2, 0.7, 0.4]), found.q_ref_body), found


def told(x, near, fallback):
    """`turn_of` and the covariance, with the last column of the second half for the deviations."""
    half = len(x) // 2
    number, found = turn_of(x, near, fallback)
    cov = wahba.q_method_covariance(x[:half, :3], x[half:, 3])
    return number + jnp.sum(cov), (found, cov)


def along(x, direction, near):
    """Second derivative along `direction`."""

    def first(x):
        return jax.jvp(lambda x: turn_of(x, near, near)[0], (x,), (direction,))[1]

    return jax.jvp(first, (x,), (direction,))[1]


told_with_slope = jit(jax.value_and_grad(told, has_aux=True))


def test_gradients_against_differences():
    """Derivatives of `eigh`, which are not finite where unused eigenvalues are equal, as they are for
    three equal axes; the second derivative of a single step from the eigenvector."""
    second = jit(along)
    rng = np.random.default_rng(4)
    step, stride = 1e-6, 1e-4
    for at in [np.zeros(3), *HALF_TURNS[::7]]:
        turn = Rotation.from_rotvec(at)
        near = np.roll(turn.as_quat(), 1)

        def value(x, near=near):
            return float(told_with_slope(x, near, near)[0][0])

        for body in (np.eye(3), rng.normal(size=(3, 3))):
            exact = at[0] == 0.0 and body[0, 1] == 0.0
            ref = turn.apply(body + (0.0 if exact else 0.1) * rng.normal(size=(3, 3)))
            x = np.hstack([np.vstack([body, ref]), np.ones((6, 1))])
            changes = step * np.eye(x.size).reshape(-1, *x.shape)
            gained = np.array([value(x + e) - value(x - e) for e in changes]).reshape(x.shape)
            (_, (found, _)), slope = told_with_slope(x, near, near)
            assert found.valid and found.q_ref_body @ near > 0.9
            np.testing.assert_allclose(slope, gained / (2 * step), rtol=1e-6, atol=1e-6)
            # The covariance does not depend on what changes here.
            e = np.zeros_like(x)
            e[3:, :3] = rng.normal(size=(3, 3)) / 3.0
            bend = (value(x - stride * e) - 2 * value(x) + value(x + stride * e)) / stride**2
            np.testing.assert_allclose(second(x, e, near), bend, rtol=1e-5, atol=1e-6)


X, Y, Z = np.eye(3)
OPEN = {
    "on one line": (np.stack([X, 2 * X, -X]), np.stack([Y, Y, -Y])),
    "nearly on one line": (np.stack([X, X + 1e-9 * Y, X]), np.stack([Y, Y, Y])),
    "a single one": (np.stack([X, 0 * X, 0 * X]), np.stack([Y, Z, X])),
    "a single pair": (np.stack([X, Y, 0 * X]), np.stack([Y, np.nan * X, X])),
    "none": (np.zeros((3, 3)), np.eye(3)),
    "infinite": (np.array([X, [np.inf, 0, 0], [0, 0, np.nan]]), np.eye(3)),
    "contradictions": (np.stack([X, Y, Z]), np.stack([-X, -Y, -Z])),
}


@pytest.mark.parametrize("case", OPEN)
def test_open_turns(case):
    """NaN from a matrix without inverse, or an arbitrary turn that passes for an answer."""
    body, ref = OPEN[case]
    fallback = np.array([0.5, -0.5, 0.5, 0.5])
    weights = np.array([1.0, 1.0, np.nan if case == "none" else 1.0])
    x = np.vstack([np.column_stack([body, weights]), np.column_stack([ref, weights])])
    (_, (found, cov)), slope = told_with_slope(x, -fallback, fallback)
    assert not found.valid
    np.testing.assert_array_equal(found.q_ref_body, fallback)
    np.testing.assert_array_equal(np.isfinite(slope), True)
    np.testing.assert_array_equal(slope[3:, :3], 0.0)
    # The covariance, which does not look at the references, is told by two readings of the body.
    if case not in ("a single pair", "contradictions"):
        np.testing.assert_array_equal(cov, np.eye(3))
        np.testing.assert_array_equal(slope, 0.0)


def test_the_identity_stands_in():
    """A fallback that has to be given."""
    found = q_method(*np.zeros((2, 4, 3)), np.ones(4))
    np.testing.assert_array_equal(found.q_ref_body, [1.0, 0.0, 0.0, 0.0])
    assert not found.valid


def test_least_gap_is_a_choice():
    """A threshold that is not used. Two equal weights at angle a leave a gap of 1 - cos(a)."""
    pair = np.stack([X, np.cos(0.3) * X + np.sin(0.3) * Y])
    gap = 1.0 - np.cos(0.3)
    deviations = np.ones(2)
    assert q_method(pair, pair, least_gap=gap - 1e-6).valid
    assert not q_method(pair, pair, least_gap=gap + 1e-6).valid
    with pytest.raises(ValueError, match=r"\(n, 3\)"):
        wahba.q_method(pair[0], pair[0])
    # The covariance draws the line within the same order.
    assert covariance(pair, deviations, least_gap=0.9 * gap)[0, 0] != 1.0
    np.testing.assert_array_equal(covariance(pair, deviations, least_gap=1.1 * gap), np.eye(3))


DEVIATIONS = np.array([0.002, 0.01, 0.004, 0.006])


@pytest.mark.parametrize("weighted", ["by deviation", "equally"])
def test_covariance_against_draws(weighted):
    """A covariance in the reference frame, half an angle, or one that holds for the best weights only.

    100,000 draws each, at and near half a turn; the worst of the relative Frobenius norm and of each
    diagonal entry is 3 %.
    """
    rng = np.random.default_rng(6)
    equal = weighted == "equally"
    weights = np.ones(4) if equal else DEVIATIONS**-2
    for at in [HALF_TURNS[0], HALF_TURNS[20 if equal else 11]]:
        turn = Rotation.from_rotvec(at)
        body = unit(rng.normal(size=(4, 3)))
        noise = DEVIATIONS[:, None] * rng.normal(size=(DRAWS, 4, 3))
        across = noise - np.sum(noise * body, axis=-1, keepdims=True) * body
        found = many(unit(body + across), turn.apply(body), weights)
        assert np.all(found.valid)
        drawn = np.cov(attitude_errors(np.roll(turn.as_quat(), 1), found.q_ref_body).T)
        told = np.asarray(covariance(7.0 * body, DEVIATIONS, weights if equal else None))
        assert np.linalg.norm(told - drawn) <= 0.03 * np.linalg.norm(drawn)
        np.testing.assert_allclose(np.diag(told), np.diag(drawn), rtol=0.03)


def test_covariance_of_shuster():
    """Weights that change the answer when they are the best ones, or hidden directions that count."""
    body = unit(np.random.default_rng(7).normal(size=(4, 3)))
    deviations = np.array([0.01, 0.02, np.inf, 0.05])
    used = [0, 1, 3]
    information = sum(
        (np.eye(3) - np.outer(b, b)) / s**2
        for b, s in zip(body[used], deviations[used], strict=True)
    )
    expected = np.linalg.inv(information)
    for weights in (None, np.where(np.isfinite(deviations), 5.0 / deviations**2, 0.0)):
        found = covariance(body, deviations, weights)
        np.testing.assert_allclose(found, expected, rtol=1e-12, atol=1e-18)
    slope = jit(jax.grad(lambda d: jnp.sum(wahba.q_method_covariance(body, d))))(deviations)
    assert np.all(np.isfinite(slope)) and slope[2] == 0.0
