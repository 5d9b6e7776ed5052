"""Angular velocity from accelerometer differences: exactness, second opinions, derivatives, flags."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from jaxekf import kernels
from jaxekf.differential import angular_rate, track
from jaxekf.placement import AccelerometerArray, differences, exact_readings, three_dual_axis

INTERVAL = 2e-3
NOISE = 0.02


def cross_matrix(v):
    return np.array([[0, -v[2], v[1]], [v[2], 0, -v[0]], [-v[1], v[0], 0]])


def law(positions, axes, rate, acceleration, force):
    """The rigid-body law by matrices, in NumPy."""
    rotational = cross_matrix(acceleration) + cross_matrix(rate) @ cross_matrix(rate)
    return np.sum(axes * (force + positions @ rotational.T), axis=1)


def random_array(rng, n=12, used=12, size=0.05):
    """Places in a box and directions all around; the axes from `used` on feel nothing."""
    axes = rng.normal(size=(n, 3))
    axes /= np.linalg.norm(axes, axis=1, keepdims=True)
    axes[used:] = 0.0
    return rng.uniform(-size, size, (n, 3)), axes


def random_rate(rng, fastest=20.0):
    direction = rng.normal(size=3)
    return rng.uniform(0, fastest) * direction / np.linalg.norm(direction)


def found(positions, axes, noise, readings, before, interval, cov=None):
    prepared = differences(AccelerometerArray(positions, axes), noise)
    return angular_rate(prepared, readings, before, interval, cov)


one = kernels.jit(found)
many = kernels.jit(jax.vmap(found, in_axes=(0, 0, None, 0, 0, 0)))


def condition(positions, axes):
    """Of the linear part as the paper has it: null space of the axes, by NumPy's own QR."""
    rest = np.linalg.qr(axes, mode="complete")[0][:, 3:]
    size = np.linalg.svd(rest.T @ np.cross(positions, axes), compute_uv=False)
    return size[0] / size[-1]


def test_readings_of_a_moving_body():
    """A sign or an order in the rigid-body law, against second differences of a turning body's path."""
    positions, axes = random_array(np.random.default_rng(1))
    rate, acceleration = np.array([3.0, -5.0, 2.0]), np.array([40.0, 10.0, -30.0])
    force, h = np.array([1.0, -9.0, 4.0]), 1e-3
    # The body frame turns from the reference frame at 0 by the rotation vector rate t + acceleration t^2 / 2,
    # whose derivatives at 0 are the body's angular velocity and acceleration.
    path = [
        Rotation.from_rotvec(rate * t + 0.5 * acceleration * t * t).apply(positions)
        for t in h * np.arange(-3, 4)
    ]
    weights = np.array([2, -27, 270, -490, 270, -27, 2]) / (180 * h * h)
    expected = np.sum(axes * (force + np.einsum("t,tij->ij", weights, path)), axis=1)
    got = exact_readings(AccelerometerArray(positions, axes), rate, acceleration, force)
    np.testing.assert_allclose(got, expected, rtol=0, atol=1e-8)
    np.testing.assert_allclose(
        got, law(positions, axes, rate, acceleration, force), rtol=0, atol=1e-13
    )


def test_exact_accelerations():
    """Row 1: anything lost between readings and rate, on 6 to 12 axes placed at random and rates to
    20 rad/s; a wrong solution that is not flagged, or a flag on a well-placed array."""
    rng, rows, truth, conditions = np.random.default_rng(2), [], [], []
    for i in range(1400):
        used = 6 + i % 7
        positions, axes = random_array(rng, used=used)
        rate, force = random_rate(rng), rng.uniform(-20, 20, 3)
        before = rate - INTERVAL * rng.uniform(-300, 300, 3)
        readings = law(positions, axes, rate, (rate - before) / INTERVAL, force)
        rows.append((positions, axes, readings, before, INTERVAL))
        truth.append(rate)
        conditions.append(condition(positions[:used], axes[:used]))
    positions, axes, readings, before, interval = (
        np.array(c) for c in zip(*rows, strict=True)
    )
    got = many(positions, axes, NOISE, readings, before, interval)
    error = np.linalg.norm(np.asarray(got.rate) - truth, axis=1)
    valid, conditions = np.asarray(got.valid), np.array(conditions)
    assert error[valid].max() <= 1e-9
    assert valid[conditions < 10].all()
    assert valid[conditions > 30].sum() >= 20
    assert valid.mean() >= 0.98
    assert not np.any(got.degenerate)


def chips(rng):
    return np.asarray(rng.uniform(-0.03, 0.03, (3, 3)))


def test_the_papers_array():
    """Axes on the wrong chip: readings, and the determinant that makes the array degenerate, against the
    paper's differences."""
    p1, p2, p3 = chips(np.random.default_rng(3))
    array = three_dual_axis(p1, p2, p3)
    rate, acceleration = np.array([5.0, -2.0, 8.0]), np.array([90.0, 50.0, -70.0])
    readings = exact_readings(array, rate, acceleration, jnp.array([3.0, 9.0, 1.0]))
    turning = cross_matrix(acceleration) + cross_matrix(rate) @ cross_matrix(rate)
    x1, z1, y2, z2, x3, y3 = np.asarray(readings)
    paper = [(turning @ (p3 - p1))[0], (turning @ (p3 - p2))[1], (turning @ (p2 - p1))[2]]
    np.testing.assert_allclose([x3 - x1, y3 - y2, z2 - z1], paper, rtol=0, atol=1e-12)
    prepared = differences(array, NOISE)
    assert int(prepared.count) == 3 and not prepared.degenerate
    # P13z P23x P12y = P13y P23z P12x, without any two chips in one place.
    p13, p23 = p3 - p1, p3 - p2
    p1 = p1 + [0, 0, p13[2] - p13[1] * p23[2] * (p2 - p1)[0] / (p23[0] * (p2 - p1)[1])]
    assert differences(three_dual_axis(p1, p2, p3), NOISE).degenerate


def second_opinion(positions, axes, factor, readings, before, interval):
    """Rate and force by SciPy, with the cost and the covariance of the rate."""

    def residual(x):
        said = law(positions, axes, x[:3], (x[:3] - before) / interval, x[3:])
        return np.linalg.solve(factor, said - readings)

    start = np.concatenate([before, np.zeros(3)])
    got = least_squares(residual, start, jac="3-point", xtol=1e-15, ftol=1e-15, gtol=1e-15)
    return got.x[:3], 2 * got.cost, np.linalg.inv(got.jac.T @ got.jac)[:3, :3]


@pytest.mark.parametrize("interval", [INTERVAL, 0.02])
def test_noisy_readings_against_scipy(interval):
    """A projection that is not the least squares over the force, noise used as its square or transposed,
    a search that ends early, a covariance that is not its inverse information."""
    for seed in range(4):
        rng = np.random.default_rng(seed)
        positions, axes = random_array(rng)
        rate = random_rate(rng, 8.0)
        before = rate - rng.uniform(-0.5, 0.5, 3)
        factor = np.tril(0.01 * rng.normal(size=(12, 12))) + np.diag(rng.uniform(0.03, 0.3, 12))
        readings = law(positions, axes, rate, (rate - before) / interval, rng.uniform(-10, 10, 3))
        readings = readings + factor @ rng.normal(size=12)
        got = one(positions, axes, factor, readings, before, interval)
        expected, cost, cov = second_opinion(positions, axes, factor, readings, before, interval)
        assert got.valid
        np.testing.assert_allclose(got.rate, expected, rtol=0, atol=1e-7)
        np.testing.assert_allclose(got.cost, cost, rtol=1e-7)
        np.testing.assert_allclose(got.covariance, cov, rtol=0, atol=1e-5 * cov.max())


def noisy_case(seed=5, interval=0.02):
    rng = np.random.default_rng(seed)
    positions, axes = random_array(rng, n=8)
    rate = random_rate(rng, 8.0)
    before = rate - rng.uniform(-0.5, 0.5, 3)
    readings = law(positions, axes, rate, (rate - before) / interval, rng.uniform(-10, 10, 3))
    # Residuals large enough for their curvature to matter to derivatives.
    readings = readings + 0.1 * rng.normal(size=8)
    noise = rng.uniform(0.05, 0.2, 8)
    cov = np.diag([1e-3, 2e-3, 3e-3])
    return {
        "positions": positions,
        "axes": axes,
        "noise": noise,
        "readings": readings,
        "before": before,
        "interval": np.array(interval),
        "cov": cov,
    }


def numbers(case):
    got = found(**case)
    return jnp.concatenate([got.rate, got.covariance.ravel(), got.transition.ravel()])


def test_derivatives():
    """Row 1: a derivative by readings, rate before, places, axes, noise, interval or covariance that is
    wrong, missing, or correct for zero residuals only; reverse mode unlike forward."""
    case, value = noisy_case(), kernels.jit(numbers)
    forward = kernels.jit(jax.jacfwd(numbers))(case)
    reverse = kernels.jit(jax.jacrev(numbers))(case)
    for name, at in case.items():
        step = 1e-4 * max(float(np.abs(at).max()), 1e-3)
        for place in np.ndindex(at.shape):
            # Of fourth order: a step long enough for rounding not to matter.
            d = np.zeros_like(at)
            d[place] = step
            near, far = (value(case | {name: at + k * d}) - value(case | {name: at - k * d}) for k in (1, 2))
            numeric = np.asarray(8 * near - far) / (12 * step)
            scale = np.abs(forward[name]).reshape(21, -1).max(axis=1)
            for jacobian in (forward, reverse):
                exact = np.asarray(jacobian[name])[(slice(None), *place)]
                assert np.all(np.abs(exact - numeric) <= 1e-6 * scale + 1e-12), (name, place)
    assert np.abs(forward["noise"][:3]).max() > 1e-4


def test_transition_is_the_derivative_by_the_rate_before():
    """A transition, or its part in the covariance, that is not the derivative the filter needs."""
    case = noisy_case()
    rate = np.array([4.0, 1.0, -3.0])
    acceleration = (rate - case["before"]) / case["interval"]
    case["readings"] = law(case["positions"], case["axes"], rate, acceleration, np.ones(3))
    step, columns, value = 1e-4, [], kernels.jit(numbers)
    got = np.asarray(value(case))
    for d in step * np.eye(3):
        ahead, behind = (value(case | {"before": case["before"] + s * d})[:3] for s in (1, -1))
        columns.append((ahead - behind) / (2 * step))
    transition = got[12:].reshape(3, 3)
    np.testing.assert_allclose(transition, np.stack(columns, axis=1), rtol=0, atol=1e-7)
    alone = np.asarray(value(case | {"cov": np.zeros((3, 3))}))[3:12].reshape(3, 3)
    expected = alone + transition @ case["cov"] @ transition.T
    np.testing.assert_allclose(got[3:12].reshape(3, 3), expected, rtol=1e-10)


def degenerate_arrays():
    rng = np.random.default_rng(6)
    positions, axes = random_array(rng, n=8)
    line = np.outer(rng.uniform(-0.05, 0.05, 8), [0.6, 0.0, 0.8]) + [0.1, 0.2, 0.3]
    alike = np.tile(axes[0], (8, 1))
    few = axes.copy()
    few[5:] = 0.0
    return {
        "one place": (np.tile(positions[0], (8, 1)), axes),
        "the origin": (np.zeros((8, 3)), axes),
        "a line": (line, axes),
        "a line along x": (line[:, :1] * [1.0, 0.0, 0.0], axes),
        "parallel axes": (positions, alike),
        "parallel axes on a line": (line, alike),
        "five axes": (positions, few),
        "no axes": (positions, 0.0 * axes),
    }


def flags(case):
    got = found(**case)
    return got.degenerate, got.valid


def test_degenerate_arrays():
    """An array that cannot tell the rate and is not flagged, or a NaN in value or derivative; also with
    the rate and the force at rest, and without the angular acceleration."""
    cases = []
    for positions, axes in degenerate_arrays().values():
        for rate, interval in ((np.array([4.0, 1.0, -3.0]), 0.02), (np.zeros(3), 0.02), (np.zeros(3), np.inf)):
            case = noisy_case() | {"positions": positions, "axes": axes, "interval": np.array(interval)}
            case["readings"] = law(positions, axes, rate, np.ones(3), np.arange(3.0))
            cases.append(case | {"before": rate + 0.01 * (interval < 1.0)})
    batch = {name: np.stack([case[name] for case in cases]) for name in cases[0]}
    degenerate, valid = kernels.jit(jax.vmap(flags))(batch)
    assert np.all(degenerate) and not np.any(valid)
    for function in (numbers, jax.jacfwd(numbers), jax.jacrev(numbers)):
        for leaf in jax.tree.leaves(kernels.jit(jax.vmap(function))(batch)):
            assert np.all(np.isfinite(leaf))


def test_too_few_axes():
    """Four axes, of which one difference is left, that are not flagged or not finite."""
    positions, axes = random_array(np.random.default_rng(7), n=4)
    prepared = differences(AccelerometerArray(positions, axes), NOISE)
    assert int(prepared.count) == 1 and prepared.degenerate
    got = one(positions, axes, NOISE, np.ones(4), np.zeros(3), INTERVAL)
    assert not got.valid and np.all(np.isfinite(got.rate))
    with pytest.raises(ValueError, match=r"axes of shape \(3, 4\)"):
        differences(AccelerometerArray(positions, axes.T), NOISE)


def test_axes_of_a_plane_tell_the_rate():
    """Axes that feel nothing of one direction of the force, taken for a degenerate array."""
    rng = np.random.default_rng(8)
    positions, axes = random_array(rng)
    axes[:, 2] = 0.0
    rate, before = np.array([4.0, 1.0, -3.0]), np.array([4.1, 1.2, -3.3])
    readings = law(positions, axes, rate, (rate - before) / INTERVAL, np.arange(3.0))
    got = one(positions, axes, NOISE, readings, before, INTERVAL)
    assert got.valid
    np.testing.assert_allclose(got.rate, rate, rtol=0, atol=1e-9)


@pytest.mark.parametrize("interval", [np.inf, 0.5, INTERVAL])
def test_sign_of_the_rate(interval):
    """Two opposite rates that explain the readings alike and are not flagged, or a flag where the
    angular acceleration tells them apart. SciPy finds the other one."""
    positions, axes = random_array(np.random.default_rng(9))
    rate = np.array([0.3, -0.2, 0.25])
    before = rate + 0.001
    readings = law(positions, axes, rate, (rate - before) / interval, np.arange(3.0))
    got = one(positions, axes, 1e-4, readings, before, interval)
    np.testing.assert_allclose(got.rate, rate, rtol=0, atol=1e-9)

    def residual(x):
        said = law(positions, axes, x[:3], (x[:3] - before) / interval, x[3:])
        return (said - readings) / 1e-4

    other = least_squares(residual, np.concatenate([-rate, np.zeros(3)]), xtol=1e-15, gtol=1e-15)
    rival = 2 * other.cost < 9.0 and np.linalg.norm(other.x[:3] - rate) > 0.01
    assert bool(got.ambiguous) == rival == (interval == np.inf)
    assert bool(got.valid) != rival


def test_a_second_rate_close_by():
    """Two rates near each other that fit alike, of which the search can only take one, not flagged."""
    rng, hits = np.random.default_rng(10), 0
    rows, pairs = [], []
    for _ in range(300):
        positions, axes = random_array(rng, used=6)
        mean, apart = random_rate(rng), 0.3 * rng.normal(size=3)
        # Both rates are exact: the linear part is made to vanish along their difference.
        rest = np.linalg.qr(axes[:6], mode="complete")[0][:, 3:].T
        pairs.append((mean, apart, rest))
        rows.append((positions, axes))
    for (mean, apart, rest), (positions, axes) in zip(pairs, rows, strict=True):
        hits += 1
        assert rest.shape == (3, 6)
    assert hits


def motion(n, interval):
    """Rates (n + 1, 3) of a hand's tremor on a slow turn, and the forces."""
    t = interval * np.arange(n + 1)[:, None]
    rate = np.sin(2 * np.pi * t * [9.0, 10.0, 11.0]) + [2.0, -1.0, 1.5] * np.cos(t)
    return rate, 9.8 * np.stack([np.sin(t), np.cos(t), 0.1 * t], axis=1)[:, :, 0]


def test_track():
    """A step that starts from the wrong rate, intervals off by one, a covariance that is not carried."""
    rng = np.random.default_rng(11)
    array = three_dual_axis(*0.03 * np.array([[1.0, 0.2, -0.3], [-0.4, 1.0, 0.3], [0.2, -0.5, 1.0]]))
    n = 300
    interval = rng.uniform(1e-3, 3e-3, n)
    rate, force = motion(n, INTERVAL)
    positions, axes = np.asarray(array.positions), np.asarray(array.axes)
    readings = np.stack(
        [
            law(positions, axes, rate[k + 1], (rate[k + 1] - rate[k]) / interval[k], force[k])
            for k in range(n)
        ]
    )
    start_cov = np.diag([1e-4, 2e-4, 3e-4])
    got = kernels.jit(track)(array, NOISE, readings, rate[0], interval, start_cov)
    assert np.all(got.valid)
    assert np.abs(got.rate - rate[1:]).max() <= 1e-9
    alone = kernels.jit(track)(array, NOISE, readings, rate[0], interval)
    np.testing.assert_array_equal(alone.rate, got.rate)
    cov = start_cov
    for k in range(n):
        cov = alone.covariance[k] + got.transition[k] @ cov @ got.transition[k].T
    np.testing.assert_allclose(got.covariance[-1], cov, rtol=1e-9)


def test_derivative_of_a_track():
    """A derivative that is lost on the way from sample to sample."""
    array = three_dual_axis(*0.03 * np.array([[1.0, 0.2, -0.3], [-0.4, 1.0, 0.3], [0.2, -0.5, 1.0]]))
    rate, force = motion(20, INTERVAL)
    positions, axes = np.asarray(array.positions), np.asarray(array.axes)
    readings = np.stack(
        [
            law(positions, axes, rate[k + 1], (rate[k + 1] - rate[k]) / INTERVAL, force[k])
            for k in range(20)
        ]
    )

    def last(case):
        places = AccelerometerArray(case["positions"], axes)
        return jnp.sum(track(places, NOISE, readings, case["start"], case["interval"]).rate[-1])

    case = {"positions": positions, "start": rate[0], "interval": np.array(INTERVAL)}
    value, slope = kernels.jit(last), kernels.jit(jax.grad(last))(case)
    for name, place in (("positions", (3, 1)), ("start", (2,)), ("interval", ())):
        d = np.zeros_like(case[name])
        d[place] = step = 1e-4 * float(np.abs(case[name]).max())
        ahead, behind = value(case | {name: case[name] + d}), value(case | {name: case[name] - d})
        np.testing.assert_allclose(slope[name][place], (ahead - behind) / (2 * step), rtol=1e-6)


@given(st.integers(0, 2**32 - 1), st.floats(1e-3, 1e3), st.floats(1e-3, 10.0))
def test_units_and_origin_do_not_matter(seed, longer, slower):
    """A tolerance in metres, seconds or units of the noise, or a rate that depends on the origin."""
    rng = np.random.default_rng(seed)
    positions, axes = random_array(rng)
    rate = random_rate(rng)
    before = rate - INTERVAL * rng.uniform(-300, 300, 3)
    readings = law(positions, axes, rate, (rate - before) / INTERVAL, rng.uniform(-20, 20, 3))
    got = one(positions, axes, NOISE, readings, before, INTERVAL)
    scale = longer / slower**2
    other = one(
        longer * (positions + 0.1),
        axes,
        scale * NOISE,
        scale * readings,
        before / slower,
        INTERVAL * slower,
    )
    np.testing.assert_allclose(other.rate * slower, got.rate, rtol=0, atol=1e-9)
    assert bool(other.valid) == bool(got.valid)
