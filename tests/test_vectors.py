"""TRIAD and its covariance: the answer, its error, its derivatives, and pairs that leave a turn open."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import assume, example, given
from hypothesis import strategies as st
from oracle import attitude_errors
from scipy.spatial.transform import Rotation

from jaxekf import jit
from jaxekf.geometry import rotation
from jaxekf.geometry import triad as vectors

DRAWS = 100_000
AXES = [*np.eye(3), *-np.eye(3), np.array([0.6, -0.48, 0.64]), np.array([-0.8, 0.6, 0.0])]
HALF_TURNS = [(np.pi - short) * axis for axis in AXES for short in (0.0, 1e-12, 1e-6, 1e-3)]
triad = jit(vectors.triad)
covariance = jit(vectors.triad_covariance)
from_matrix = jit(rotation.from_matrix)
many = jit(jax.vmap(vectors.triad, (0, 0, None, None)))


def to_scipy(q):
    return Rotation.from_quat(np.roll(np.asarray(q), -1, axis=-1))


def from_scipy(turn):
    return np.roll(turn.as_quat(), 1, axis=-1)


def some_cov(rng, size=3):
    """A covariance that is not a multiple of the identity, with correlations."""
    root = rng.normal(size=(size, size))
    return root @ root.T + 0.2 * np.eye(size)


numbers = st.floats(-1.0, 1.0)


@st.composite
def turns(draw):
    """Rotations of every kind, those near half a turn often."""
    if draw(st.booleans()):
        return Rotation.from_rotvec(draw(st.sampled_from(HALF_TURNS)))
    q = np.array(draw(st.lists(numbers, min_size=4, max_size=4)))
    assume(np.linalg.norm(q) > 1e-3)
    return Rotation.from_quat(q)


@st.composite
def pairs(draw):
    """Two vectors of any length that are not parallel."""
    pair = np.array(draw(st.lists(numbers, min_size=6, max_size=6))).reshape(2, 3)
    lengths = np.linalg.norm(pair, axis=1)
    assume(np.all(lengths > 1e-3))
    assume(np.linalg.norm(np.cross(*pair)) > 1e-2 * np.prod(lengths))
    return pair * draw(st.sampled_from([1e-200, 1e-3, 1.0, 9.81, 1e200]))


@given(turns())
@example(Rotation.identity())
def test_from_matrix(turn):
    """A transposed matrix, a division by a small component, or the other sign."""
    q = np.asarray(from_matrix(turn.as_matrix()))
    np.testing.assert_allclose(to_scipy(q).as_matrix(), turn.as_matrix(), rtol=0, atol=1e-15)
    np.testing.assert_allclose(np.linalg.norm(q), 1.0, rtol=0, atol=1e-15)
    assert q[0] >= 0.0


@given(turns(), pairs())
def test_turns_body_to_reference(turn, body):
    """The conjugate, or an attitude that fails near half a turn."""
    ref = turn.apply(body / np.abs(body).max())
    found = triad(body[0], body[1], ref[0], ref[1])
    assert found.valid
    matrix = to_scipy(found.q_ref_body).as_matrix()
    np.testing.assert_allclose(matrix, turn.as_matrix(), rtol=0, atol=1e-12)


@given(turns(), pairs(), pairs())
def test_against_scipy(turn, body, other):
    """Trust in the second vector instead of the first, where the angles of the pairs differ."""
    body, ref = body / np.abs(body).max(), turn.apply(other / np.abs(other).max())
    oracle, _ = Rotation.align_vectors(ref, body, weights=[np.inf, 1.0])
    found = to_scipy(triad(body[0], body[1], ref[0], ref[1]).q_ref_body)
    np.testing.assert_allclose(found.as_matrix(), oracle.as_matrix(), rtol=0, atol=1e-11)
    first = found.apply(body[0]) / np.linalg.norm(body[0])
    np.testing.assert_allclose(first, ref[0] / np.linalg.norm(ref[0]), rtol=0, atol=1e-14)


@given(turns(), turns(), pairs(), pairs())
def test_turns_of_either_frame(of_ref, of_body, body, ref):
    """An axis that comes from the coordinates instead of the vectors."""
    body, ref = body / np.abs(body).max(), ref / np.abs(ref).max()
    plain = to_scipy(triad(*body, *ref).q_ref_body)
    turned = to_scipy(triad(*of_body.apply(body), *of_ref.apply(ref)).q_ref_body)
    expected = of_ref * plain * of_body.inv()
    np.testing.assert_allclose(turned.as_matrix(), expected.as_matrix(), rtol=0, atol=1e-12)


@given(turns())
def test_sign_near_another(turn):
    """An attitude on the far side of the sphere, which a filter takes for an innovation of a turn."""
    up, field = vectors.north_west_up(1.1)
    body = turn.inv().apply(np.stack([up, field]))
    for near in (from_scipy(turn), -from_scipy(turn)):
        found = triad(*body, up, field, near=near).q_ref_body
        np.testing.assert_allclose(found, near, rtol=0, atol=1e-14)


def test_worlds():
    """East-north-up taken for the paper's world, a field that points up in the north, or gravity
    taken for what an accelerometer reads."""
    dip, declination = np.deg2rad(63.0), np.deg2rad(-12.0)
    up, field = vectors.north_west_up(dip)
    np.testing.assert_allclose(up, [0.0, 0.0, 1.0], rtol=0, atol=0)
    assert field[0] > 0.0 and field[1] == 0.0 and field[2] < 0.0
    np.testing.assert_allclose(np.arctan2(-field[2], field[0]), dip, rtol=0, atol=1e-15)

    # Lying flat with x to magnetic north: at rest it reads +g along z.
    force, magnetic = np.array([0.0, 0.0, 9.81]), 48.0 * np.array([np.cos(dip), 0, -np.sin(dip)])
    flat = triad(force, magnetic, up, field).q_ref_body
    np.testing.assert_allclose(flat, [1.0, 0.0, 0.0, 0.0], rtol=0, atol=1e-15)
    wrong = to_scipy(triad(-force, magnetic, up, field).q_ref_body)
    np.testing.assert_allclose(wrong.magnitude(), np.pi, rtol=0, atol=1e-14)

    # Magnetic north is y turned about the vertical, against the clock for one that lies west.
    in_enu = to_scipy(triad(force, magnetic, *vectors.east_north_up(dip, declination)).q_ref_body)
    heading = np.pi / 2 - declination
    np.testing.assert_allclose(in_enu.as_rotvec(), [0.0, 0.0, heading], rtol=0, atol=1e-14)
    np.testing.assert_allclose(np.linalg.norm(vectors.east_north_up(dip, 0.3)[1]), 1.0, rtol=1e-15)


def by_projection(first, second, ref):
    """Rotation matrices by Gram and Schmidt, another way to the same: (N, 3), (N, 3), (2, 3)."""

    def axes(a, b):
        x = a / np.linalg.norm(a, axis=-1, keepdims=True)
        y = b - np.sum(b * x, axis=-1, keepdims=True) * x
        y /= np.linalg.norm(y, axis=-1, keepdims=True)
        return np.stack([x, y, np.cross(x, y)], axis=-1)

    return np.einsum("ij,nkj->nik", axes(*ref), axes(first, second))


def test_covariance_against_draws():
    """A covariance that is not that of the answer: a frame, a factor or a length that is wrong.

    100,000 draws each at no turn, some turn, and at or near half a turn about many axes; noises with
    correlations, of up to a degree. The worst of the relative Frobenius norm and of each diagonal entry
    is 3 %; the draws themselves are good to 0.5 %.
    """
    rng = np.random.default_rng(8)
    ref = np.stack(vectors.north_west_up(np.deg2rad(65.0)))
    lengths = np.array([9.81, 48.0])
    standard = rng.normal(size=(2, DRAWS, 3))
    at_half = [HALF_TURNS[4 * i + i % 4] for i in range(len(AXES))]
    for at in [np.zeros(3), np.array([0.4, -1.0, 0.7]), *at_half]:
        turn = Rotation.from_rotvec(at)
        body = lengths[:, None] * turn.inv().apply(ref)
        covs = np.stack([(0.003 * length) ** 2 * some_cov(rng) for length in lengths])
        roots = np.linalg.cholesky(covs)
        first, second = body[:, None] + standard @ roots.transpose(0, 2, 1)
        found = many(first, second, ref[0], ref[1])
        assert np.all(found.valid)
        matrices = to_scipy(found.q_ref_body[:5000]).as_matrix()
        projected = by_projection(first[:5000], second[:5000], ref)
        np.testing.assert_allclose(matrices, projected, rtol=0, atol=1e-13)
        drawn = np.cov(attitude_errors(from_scipy(turn), found.q_ref_body).T)
        told = np.asarray(covariance(*body, *covs))
        assert np.linalg.norm(told - drawn) <= 0.03 * np.linalg.norm(drawn)
        np.testing.assert_allclose(np.diag(told), np.diag(drawn), rtol=0.03)


def central(function, x, step=1e-6):
    """Derivative of `function` by central differences, first axis over the entries of ``x``."""
    changes = step * np.eye(x.size).reshape(-1, *x.shape)
    return np.stack([function(x + e) - function(x - e) for e in changes]) / (2 * step)


def test_covariance_against_differences():
    """A wrong term that draws at the angles above would not show, at any angle of the pair."""
    rng = np.random.default_rng(3)
    for _ in range(20):
        body, ref = rng.normal(size=(2, 3)), rng.normal(size=(2, 3))
        covs = np.stack([some_cov(rng), some_cov(rng)])
        q = triad(*body, *ref).q_ref_body

        def error(x, q=q, ref=ref):
            return attitude_errors(q, triad(*x, *ref).q_ref_body[None])[0]

        slope = central(error, body).reshape(2, 3, 3)
        expected = np.einsum("kai,kab,kbj->ij", slope, covs, slope)
        told = covariance(*body, *covs)
        np.testing.assert_allclose(told, expected, rtol=1e-6, atol=1e-7 * np.abs(told).max())


def told(x, noise, fallback, near):
    """One number of everything that has a gradient; and what it is made of. `x` is (4, 3)."""
    found = vectors.triad(*x, near=near, fallback=fallback)
    cov = vectors.triad_covariance(x[0], x[1], noise[0], noise[1])
    return jnp.sum(found.q_ref_body * jnp.arange(1.0, 5.0)) + jnp.sum(cov), (found, cov)


told_with_slope = jit(jax.value_and_grad(told, argnums=(0, 1, 2), has_aux=True))


def test_gradients_against_differences():
    """A branch or a constant that hides part of a derivative, near half a turn too."""
    rng = np.random.default_rng(4)
    for at in [np.zeros(3), np.array([0.4, -1.0, 0.7]), *HALF_TURNS[::5]]:
        turn, body = Rotation.from_rotvec(at), rng.normal(size=(2, 3))
        x, near = np.concatenate([body, turn.apply(body)]), from_scipy(turn)
        noise = np.stack([some_cov(rng), some_cov(rng)])

        def value(x, noise=noise, near=near):
            return float(told_with_slope(x, noise, near, near)[0][0])

        slopes = told_with_slope(x, noise, near, near)[1]
        for found, expected in (
            (slopes[0], central(value, x)),
            (slopes[1], central(lambda noise, x=x, value=value: value(x, noise), noise)),
        ):
            scale = max(1.0, np.abs(expected).max())
            np.testing.assert_allclose(found.ravel(), expected, rtol=1e-6, atol=1e-6 * scale)


X, Y = np.eye(3)[:2]
OPEN = {
    "parallel": (X, 2.0 * X),
    "opposite": (X, -3.0 * X),
    "nearly parallel": (X, X + 1e-9 * Y),
    "no first": (0.0 * X, Y),
    "no second": (X, 0.0 * Y),
    "none": (0.0 * X, 0.0 * X),
    "not a number": (X, np.array([0.0, np.nan, 0.0])),
    "infinite": (np.array([np.inf, 0.0, 0.0]), Y),
}


@pytest.mark.parametrize("frame", ["body", "reference", "both"])
@pytest.mark.parametrize("pair", OPEN)
def test_pairs_that_leave_a_turn_open(pair, frame):
    """NaN, in the answer or its gradient, or an answer that looks like one."""
    good, bad = (X, X + Y), OPEN[pair]
    body, ref = (bad if frame != other else good for other in ("reference", "body"))
    fallback = np.array([0.5, -0.5, 0.5, 0.5])
    noise = np.stack([np.eye(3)] * 2) * (1.0 if frame == "reference" else np.nan)
    x = np.stack([*body, *ref])
    (_, (found, cov)), slopes = told_with_slope(x, noise, fallback, -fallback)
    assert not found.valid
    np.testing.assert_array_equal(found.q_ref_body, fallback)
    np.testing.assert_array_equal(slopes[2], [1.0, 2.0, 3.0, 4.0])
    if frame != "reference":
        np.testing.assert_array_equal(cov, np.eye(3))
        np.testing.assert_array_equal(slopes[0], 0.0)
        np.testing.assert_array_equal(slopes[1], 0.0)
    else:
        np.testing.assert_array_equal(np.isfinite(slopes[0]), True)
        np.testing.assert_array_equal(slopes[0][2:], 0.0)
    np.testing.assert_array_equal(triad(*body, *ref).q_ref_body, [1.0, 0.0, 0.0, 0.0])


def test_open_pairs_beside_good_ones():
    """A bad row of a batch that reaches its neighbours."""
    body = np.stack([(X, Y), OPEN["parallel"], (Y, X), OPEN["not a number"]])
    found = many(body[:, 0], body[:, 1], X, Y)
    np.testing.assert_array_equal(found.valid, [True, False, True, False])
    for i in (0, 2):
        alone = triad(*body[i], X, Y).q_ref_body
        np.testing.assert_allclose(found.q_ref_body[i], alone, rtol=0, atol=1e-16)


def test_least_angle_is_a_choice():
    """A threshold that is not used, or is in degrees."""
    pair = (X, X + 0.1 * Y)
    assert triad(*pair, *pair, least_sine=0.09).valid
    assert not triad(*pair, *pair, least_sine=0.1).valid
    noise = (np.eye(3), np.eye(3))
    open_turn = covariance(*pair, *noise, least_sine=0.1)
    np.testing.assert_array_equal(open_turn, np.eye(3))


@pytest.mark.parametrize("cov", [0.01, np.full(3, 0.01), np.full((2, 3, 3), 0.01)])
def test_a_covariance_of_another_shape_is_refused(cov):
    """Would catch variances that are broadcast: of 0.01 came a covariance with an eigenvalue of 0."""
    with pytest.raises(ValueError, match="expected \\(3, 3\\)"):
        vectors.triad_covariance(
            np.array([0.0, 0.0, 9.8]), np.array([1.0, 0.0, 0.0]), cov, np.eye(3)
        )
