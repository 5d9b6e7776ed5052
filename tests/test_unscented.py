"""The unscented transform against filterpy, closed forms, draws and differences."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from filterpy.kalman import MerweScaledSigmaPoints, unscented_transform
from hypothesis import given
from hypothesis import strategies as st
from oracle import attitude_errors, exp, right_jacobian
from scipy.spatial.transform import Rotation

from jaxekf import SO3, Euclidean, jit
from jaxekf.geometry import rotation, triad, unscented

DRAWS = 100_000


def bent(x):
    """A mildly nonlinear function of three numbers."""
    return jnp.stack([x[0] * x[1] + x[2], jnp.sin(x[2]) + x[0]])


def case(seed, size=3):
    rng = np.random.default_rng(seed)
    root = rng.normal(size=(size, size))
    return rng.normal(size=size), root @ root.T + 0.1 * np.eye(size)


@given(
    st.integers(0, 2**32 - 1),
    st.sampled_from([(0.5, 2.0, 1.0), (1.3, -0.5, -1.0)]),
)
def test_against_filterpy(seed, choice):
    """A weight, the distance of the points, or the order of the factor's columns and rows."""
    mean, cov = case(seed)
    alpha, beta, kappa = choice
    found = scaled(mean, cov, choice)
    points = MerweScaledSigmaPoints(3, alpha, beta, kappa, sqrt_method=np.linalg.cholesky)
    # Their points follow rows of the factor, which are right only for its transpose.
    points.sqrt = lambda matrix: np.linalg.cholesky(matrix).T
    inputs = points.sigma_points(mean, cov)
    outputs = np.stack([[x[0] * x[1] + x[2], np.sin(x[2]) + x[0]] for x in inputs])
    expected, spread = unscented_transform(outputs, points.Wm, points.Wc)
    np.testing.assert_allclose(found.mean, expected, rtol=1e-11, atol=1e-11)
    np.testing.assert_allclose(found.cov, spread, rtol=1e-11, atol=1e-11 * np.abs(spread).max())
    cross = np.einsum("p,pi,pj->ij", points.Wc, inputs - mean, outputs - expected)
    np.testing.assert_allclose(found.cross, cross, rtol=1e-11, atol=1e-11 * np.abs(cross).max())


PROGRAMS = {}


def scaled(mean, cov, choice):
    if choice not in PROGRAMS:
        alpha, beta, kappa = choice
        PROGRAMS[choice] = jit(
            lambda m, c: unscented.transform(bent, m, c, alpha=alpha, beta=beta, kappa=kappa)
        )
    return PROGRAMS[choice](mean, cov)


def test_plain_transform_of_the_paper():
    """Defaults other than eqs. 34 to 37 as corrected: for three numbers the middle has no weight."""
    mean, cov = case(1)
    root = np.linalg.cholesky(cov)
    for kappa in (0.0, 0.7):
        plain = jit(functools.partial(unscented.transform, bent, kappa=kappa))
        steps = np.sqrt(3 + kappa) * np.hstack([np.zeros((3, 1)), root, -root])
        outputs = np.stack([np.asarray(bent(mean + step)) for step in steps.T])
        weights = np.array([kappa / (3 + kappa), *[1 / (2 * (3 + kappa))] * 6])
        middle = weights @ outputs
        spread = np.einsum("p,pi,pj->ij", weights, outputs - middle, outputs - middle)
        found = plain(mean, cov)
        np.testing.assert_allclose(found.mean, middle, rtol=1e-12)
        np.testing.assert_allclose(found.cov, spread, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("alpha", [1.0, 1e-3])
def test_moments_of_a_quadratic(alpha):
    """A mean that is not exact to second order, or digits lost where a small alpha makes weights of
    a million."""
    rng = np.random.default_rng(2)
    mean, cov = case(3)
    square, line = rng.normal(size=(3, 3)), rng.normal(size=3)
    square = square + square.T

    def fn(x):
        return (x @ square @ x + line @ x)[None]

    found = jit(functools.partial(unscented.transform, fn, alpha=alpha, beta=2.0))(mean, cov)
    expected = mean @ square @ mean + line @ mean + np.trace(square @ cov)
    np.testing.assert_allclose(found.mean, [expected], rtol=1e-8)
    slope = 2 * square @ mean + line
    np.testing.assert_allclose(found.cross[:, 0], cov @ slope, rtol=1e-8)

    # Of one number, at the distance at which the fourth moment is a Gaussian's, the variance as well.
    square = jit(functools.partial(unscented.transform, lambda x: x * x, kappa=2.0))
    one = square(np.array([0.8]), np.array([[0.5]]))
    np.testing.assert_allclose(one.cov, [[4 * 0.8**2 * 0.5 + 2 * 0.5**2]], rtol=1e-14)
    np.testing.assert_allclose(one.mean, [0.8**2 + 0.5], rtol=1e-14)


def test_quadratic_against_draws():
    """A covariance that is not that of what the function gives: 100,000 draws and the known moments of
    quadratics; 3 %, the worst of the relative Frobenius norm and of each diagonal entry."""
    rng = np.random.default_rng(5)
    mean, cov = np.array([1.0, -0.5, 0.8]), 0.03 * case(4)[1] / 2.0
    drawn = mean + rng.normal(size=(DRAWS, 3)) @ np.linalg.cholesky(cov).T

    def fn(x):
        bent = [x[0] + 0.3 * x[0] * x[0], x[1] + 0.3 * x[1] * x[2], x[2] - 0.2 * x[1] * x[1]]
        return jnp.stack(bent)

    outputs = np.asarray(jit(jax.vmap(fn))(drawn))
    slopes = np.array([[1.6, 0, 0], [0, 1.24, -0.15], [0, 0.2, 1.0]])
    squares = np.zeros((3, 3, 3))
    squares[0, 0, 0], squares[1, 1, 2], squares[1, 2, 1], squares[2, 1, 1] = 0.3, 0.15, 0.15, -0.2
    known = slopes @ cov @ slopes.T
    known += 2 * np.einsum("iab,bc,jcd,da->ij", squares, cov, squares, cov)
    found = jit(functools.partial(unscented.transform, fn, beta=2.0))(mean, cov)
    for truth in (np.cov(outputs.T), known):
        assert np.linalg.norm(found.cov - truth) <= 0.03 * np.linalg.norm(truth)
        np.testing.assert_allclose(np.diag(found.cov), np.diag(truth), rtol=0.03)
    shift = np.einsum("iab,ab->i", squares, cov)
    np.testing.assert_allclose(found.mean, np.asarray(fn(mean)) + shift, rtol=1e-13)


PAIR = Euclidean(6)
HALF_TURNS = np.pi * np.array([[1.0, 0.0, 0.0], [0.6, -0.48, 0.64], [0.0, 1e-7 - 1.0, 0.0]])
triad_many = jit(jax.vmap(triad.triad, (0, 0, None, None)))


@jit
def triad_moments(readings, cov, ref):
    def attitude(x):
        return triad.triad(x[:3], x[3:], *ref).q_ref_body

    return unscented.transform_on(attitude, readings, cov, PAIR, SO3(), beta=2.0)


REFERENCES = np.stack(triad.north_west_up(1.1))


def drawn_attitudes(turn, noise, standard):
    """What the transform finds for TRIAD, and what draws do: readings and errors (N, 6), (N, 3)."""
    readings = turn.inv().apply(REFERENCES).ravel()
    drawn = readings + standard @ noise.T
    found = triad_moments(readings, noise @ noise.T, REFERENCES)
    q = triad_many(drawn[:, :3], drawn[:, 3:], *REFERENCES).q_ref_body
    return found, drawn - readings, attitude_errors(found.mean, q)


def test_attitude_against_draws():
    """A covariance in another frame, or a mean of quaternions whose signs differ: TRIAD with errors of
    0.6 to 2.7 degrees, at half a turn too; 100,000 draws, limits as above."""
    rng = np.random.default_rng(9)
    noise = 0.012 * np.kron(np.eye(2), np.linalg.cholesky(case(6)[1] / 3.0))
    standard = rng.normal(size=(DRAWS, 6))
    for at in [np.array([0.4, -1.0, 0.7]), *HALF_TURNS]:
        found, changes, errors = drawn_attitudes(Rotation.from_rotvec(at), noise, standard)
        truth = np.cov(errors.T)
        assert np.linalg.norm(found.cov - truth) <= 0.03 * np.linalg.norm(truth)
        np.testing.assert_allclose(np.diag(found.cov), np.diag(truth), rtol=0.03)
        # The mean is right to what the draws can tell: five standard errors.
        assert np.all(np.abs(errors.mean(axis=0)) <= 5 * np.sqrt(np.diag(truth) / DRAWS))
        cross = changes.T @ errors / DRAWS
        assert np.linalg.norm(found.cross - cross) <= 0.03 * np.linalg.norm(cross)

    # With errors four times as large the derivative is no longer enough.
    coarse = np.kron(np.diag([0.04, 0.06]), np.linalg.cholesky(case(6)[1] / 3.0))
    turn = Rotation.from_rotvec([0.4, -1.0, 0.7])
    found, _, errors = drawn_attitudes(turn, coarse, standard)
    fine, _, _ = drawn_attitudes(turn, 1e-3 * coarse, standard)
    truth, linear = np.cov(errors.T), 1e6 * fine.cov
    assert np.linalg.norm(found.cov - truth) <= 0.03 * np.linalg.norm(truth)
    assert np.linalg.norm(linear - truth) >= 0.1 * np.linalg.norm(truth)


def test_on_flat_spaces_nothing_changes():
    """A manifold form that is another transform."""
    mean, cov = case(7)

    @jit
    def both(mean, cov):
        flat = Euclidean(3), Euclidean(2)
        return (
            unscented.transform(bent, mean, cov, beta=2.0, kappa=1.0),
            unscented.transform_on(bent, mean, cov, *flat, beta=2.0, kappa=1.0),
        )

    for a, b in zip(*both(mean, cov), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-13, atol=1e-14)


def test_covariance_is_counted_from_the_new_mean():
    """A covariance left at the function of the mean, or turned the wrong way, where the two differ."""

    def vector(x):
        return jnp.stack([0.1 * x[0], 0.05 * x[0] + 0.02 * x[1], 0.6 * x[1] ** 2])

    @jit
    def both(mean, cov):
        plain = unscented.transform(vector, mean, cov)
        flat, turn = Euclidean(2), SO3()
        return plain, unscented.transform_on(
            lambda x: rotation.exp(vector(x)), mean, cov, flat, turn
        )

    plain, on = both(np.zeros(2), np.eye(2))
    jacobian = right_jacobian(np.asarray(plain.mean))
    np.testing.assert_allclose(on.mean, exp(np.asarray(plain.mean)), rtol=0, atol=1e-15)
    np.testing.assert_allclose(on.cov, jacobian @ plain.cov @ jacobian.T, rtol=0, atol=1e-15)
    np.testing.assert_allclose(on.cross, plain.cross @ jacobian.T, rtol=0, atol=1e-15)


def test_attitude_as_input():
    """An error taken on the left: the turned vector's covariance is ``R [v]x P [v]x' R'``."""
    q, v = np.asarray(rotation.exp(jnp.array([0.3, 2.0, -1.0]))), np.array([0.2, -1.0, 9.0])
    cov = 1e-8 * case(8)[1]

    @jit
    def turned(q, cov):
        return unscented.transform_on(lambda q: rotation.rotate(q, v), q, cov, SO3(), Euclidean(3))

    found = turned(q, cov)
    matrix = Rotation.from_quat(np.roll(q, -1)).as_matrix()
    slope = -matrix @ np.array([[0, -v[2], v[1]], [v[2], 0, -v[0]], [-v[1], v[0], 0]])
    expected = slope @ cov @ slope.T
    np.testing.assert_allclose(found.cov, expected, rtol=1e-5, atol=1e-5 * np.abs(expected).max())
    np.testing.assert_allclose(found.cross, cov @ slope.T, rtol=1e-5, atol=1e-5 * 1e-7)


def size(x):
    found = unscented.transform(bent, x[0], x[1:] @ x[1:].T, alpha=0.7, beta=1.0)
    return jnp.sum(found.mean) + jnp.sum(jnp.sin(found.cov)) + jnp.sum(found.cross**2)


def test_gradients_against_differences():
    """A derivative that is lost in the factor, alone and in a batch."""
    x = np.random.default_rng(10).normal(size=(2, 4, 3))
    with_slope = jit(jax.vmap(jax.value_and_grad(size)))
    step, slope = 1e-6, with_slope(x)[1]
    for i in np.ndindex(4, 3):
        change = np.zeros_like(x)
        change[:, *i] = step
        gained = np.asarray(with_slope(x + change)[0] - with_slope(x - change)[0]) / (2 * step)
        np.testing.assert_allclose(slope[:, *i], gained, rtol=1e-6, atol=1e-6)


def test_covariances_without_full_rank():
    """NaN from a root of zero, or a direction without variance that adds some."""

    def total(mean, cov):
        found = unscented.transform(bent, mean, cov)
        return jnp.sum(found.mean) + jnp.sum(found.cov), found

    with_slope = jit(jax.value_and_grad(total, argnums=(0, 1), has_aux=True))
    mean, cov = case(11)
    cov[1], cov[:, 1] = 0.0, 0.0
    (_, found), slopes = with_slope(mean, cov)
    kept = [0, 2]
    # The plain transform of two numbers has points at another distance: kappa makes it the same.
    fewer = functools.partial(
        unscented.transform, lambda x: bent(jnp.stack([x[0], mean[1], x[1]])), kappa=1.0
    )
    alone = jit(fewer)(mean[kept], cov[np.ix_(kept, kept)])
    np.testing.assert_allclose(found.mean, alone.mean, rtol=1e-14)
    np.testing.assert_allclose(found.cov, alone.cov, rtol=1e-13)
    np.testing.assert_allclose(np.asarray(found.cross)[kept], alone.cross, rtol=1e-13)
    np.testing.assert_array_equal(found.cross[1], 0.0)
    assert all(np.all(np.isfinite(slope)) for slope in slopes)
    step = 1e-6 * np.eye(3)[0]
    gained = with_slope(mean + step, cov)[0][0] - with_slope(mean - step, cov)[0][0]
    np.testing.assert_allclose(slopes[0][0], gained / 2e-6, rtol=1e-6)
    (_, found), slopes = with_slope(mean, np.zeros((3, 3)))
    np.testing.assert_array_equal(found.mean, bent(mean))
    np.testing.assert_array_equal(found.cov, 0.0)
    assert all(np.all(np.isfinite(slope)) for slope in slopes)


def test_what_cannot_be_done_is_said():
    """A root of a negative number, or shapes that broadcast to nonsense."""
    with pytest.raises(ValueError, match="alpha"):
        unscented.transform(bent, np.zeros(3), np.eye(3), kappa=-3.0)
    with pytest.raises(ValueError, match="vmap"):
        unscented.transform(bent, np.zeros((2, 3)), np.eye(3))
    with pytest.raises(ValueError, match="vmap"):
        unscented.transform(bent, np.zeros(3), np.eye(2))
