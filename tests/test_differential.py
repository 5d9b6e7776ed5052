"""Angular velocity from accelerometer differences: exactness, second opinions, derivatives, flags."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.linalg import eig
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from jaxekf._support import compilation
from jaxekf.pose_solvers.accelerometer_array import (
    AccelerometerArray,
    _complement_projector,
    differences,
    exact_readings,
    three_dual_axis,
)
from jaxekf.pose_solvers.gyro_free_rate import angular_rate, restored, track

# Arrays have as many axes, of which some may feel nothing, so that one program serves all tests.
N = 12
INTERVAL = 2e-3
NOISE = 0.02


def cross_matrix(v):
    return np.array([[0, -v[2], v[1]], [v[2], 0, -v[0]], [-v[1], v[0], 0]])


def law(positions, axes, rate, acceleration, force):
    """The rigid-body law by matrices, in NumPy."""
    rotational = cross_matrix(acceleration) + cross_matrix(rate) @ cross_matrix(rate)
    return np.sum(axes * (force + positions @ rotational.T), axis=1)


def random_array(rng, used=N, size=0.05):
    """Places in a box and directions all around; the axes from `used` on feel nothing."""
    axes = rng.normal(size=(N, 3))
    axes /= np.linalg.norm(axes, axis=1, keepdims=True)
    axes[used:] = 0.0
    return rng.uniform(-size, size, (N, 3)), axes


def random_rate(rng, fastest=20.0):
    direction = rng.normal(size=3)
    return rng.uniform(0, fastest) * direction / np.linalg.norm(direction)


def found(positions, axes, noise, readings, before, interval, cov):
    prepared = differences(AccelerometerArray(positions, axes), noise)
    return angular_rate(prepared, readings, before, interval, cov)


def numbers(case):
    got = found(**case)
    return jnp.concatenate([got.rate, got.covariance.ravel(), got.transition.ravel()])


def derivatives(case, tangent, cotangent):
    """One derivative of `numbers` forward, (21,), and one in reverse, as `case`."""
    forward = jax.jvp(numbers, (case,), (tangent,))[1]
    return forward, jax.vjp(numbers, case)[1](cotangent)[0]


prepare = compilation.jit(differences)
_solve_chunk = compilation.jit(jax.vmap(lambda case: found(**case)))
_derivative_chunk = compilation.jit(jax.vmap(derivatives))


def in_chunks(program, *lists, size=64):
    """`program` for the members of lists, by one compilation."""
    n, parts = len(lists[0]), []
    for i in range(0, n, size):
        chosen = [
            some[i : i + size] + some[-1:] * (size - len(some[i : i + size])) for some in lists
        ]
        parts.append(program(*(jax.tree.map(lambda *x: np.stack(x), *some) for some in chosen)))
    return jax.tree.map(lambda *leaves: np.concatenate(leaves)[:n], *parts)


def solve(cases):
    """`found` for a list of cases."""
    return in_chunks(_solve_chunk, cases)


def make_case(
    positions, axes, rate, before, interval=INTERVAL, force=(1.0, -9.0, 4.0), noise=NOISE
):
    """Exact readings and all else that `found` takes."""
    return {
        "positions": positions,
        "axes": axes,
        "noise": noise * np.eye(N) if np.ndim(noise) == 0 else noise,
        "readings": law(positions, axes, rate, (rate - before) / interval, np.array(force)),
        "before": before,
        "interval": np.array(interval),
        "cov": np.zeros((3, 3)),
    }


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
    # A rotation vector rate t + acceleration t^2 / 2: its derivatives at 0 are those of the body.
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
    rng, cases, truth, conditions = np.random.default_rng(2), [], [], []
    for i in range(1400):
        used = 6 + i % 7
        positions, axes = random_array(rng, used)
        rate, force = random_rate(rng), rng.uniform(-20, 20, 3)
        before = rate - INTERVAL * rng.uniform(-300, 300, 3)
        cases.append(make_case(positions, axes, rate, before, force=force))
        truth.append(rate)
        conditions.append(condition(positions[:used], axes[:used]))
    got, conditions = solve(cases), np.array(conditions)
    error = np.linalg.norm(got.rate - truth, axis=1)
    assert error[got.valid].max() <= 1e-9
    assert got.valid[conditions < 10].all()
    assert got.valid[conditions > 30].sum() >= 20
    assert got.valid.mean() >= 0.98
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
    prepared = prepare(array, NOISE)
    assert int(prepared.independent) == 3 and not prepared.degenerate
    # P13z P23x P12y = P13y P23z P12x, without any two chips in one place.
    p13, p23 = p3 - p1, p3 - p2
    p1[2] += p13[2] - p13[1] * p23[2] * (p2 - p1)[0] / (p23[0] * (p2 - p1)[1])
    assert prepare(three_dual_axis(p1, p2, p3), NOISE).degenerate


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
        rate = random_rate(rng, 8.0)
        before = rate - rng.uniform(-0.5, 0.5, 3)
        factor = np.tril(0.01 * rng.normal(size=(N, N))) + np.diag(rng.uniform(0.03, 0.3, N))
        case = make_case(*random_array(rng), rate, before, interval, noise=factor)
        case["readings"] += factor @ rng.normal(size=N)
        got = solve([case])
        expected, cost, cov = second_opinion(
            case["positions"], case["axes"], factor, case["readings"], before, interval
        )
        assert got.valid[0]
        np.testing.assert_allclose(got.rate[0], expected, rtol=0, atol=1e-7)
        np.testing.assert_allclose(got.cost[0], cost, rtol=1e-7)
        np.testing.assert_allclose(got.covariance[0], cov, rtol=0, atol=1e-5 * cov.max())


def noisy_case(seed=5):
    """Residuals large enough, and an interval long enough, for their curvature to matter."""
    rng = np.random.default_rng(seed)
    rate = random_rate(rng, 8.0)
    before = rate - rng.uniform(-0.5, 0.5, 3)
    noise = np.tril(0.01 * rng.normal(size=(N, N))) + np.diag(rng.uniform(0.05, 0.2, N))
    case = make_case(*random_array(rng, 8), rate, before, 0.02, noise=noise)
    case["readings"] += 0.1 * rng.normal(size=N)
    return case | {"cov": np.diag([1e-3, 2e-3, 3e-3])}


def flat(got):
    """`numbers` of many results."""
    n = got.rate.shape[0]
    return np.concatenate(
        [x.reshape(n, -1) for x in (got.rate, got.covariance, got.transition)], axis=1
    )


def jacobians(case, entries):
    """Derivatives of `numbers` by some entries, (entries, 21): forward, and reverse."""
    none, tangents = jax.tree.map(np.zeros_like, case), []
    for name, place in entries:
        d = np.zeros_like(case[name])
        d[place] = 1.0
        tangents.append(none | {name: d})
    alike = [case] * len(entries)
    forward, _ = in_chunks(_derivative_chunk, alike, tangents, [np.zeros(21)] * len(entries))
    _, reverse = in_chunks(_derivative_chunk, [case] * 21, [none] * 21, list(np.eye(21)))
    columns = [reverse[name][(slice(None), *place)] for name, place in entries]
    return forward, np.stack(columns)


def test_derivatives():
    """Row 1: a derivative by readings, rate before, places, axes, noise, interval or covariance that is
    wrong, missing, or correct for zero residuals only; reverse mode unlike forward."""
    case, steps, cases = noisy_case(), [], []
    entries = [(name, place) for name, at in case.items() for place in np.ndindex(at.shape)]
    for name, place in entries:
        d = np.zeros_like(case[name])
        d[place] = 1e-4 * max(float(np.abs(case[name]).max()), 1e-3)
        steps.append(d[place])
        # Of fourth order: a step long enough for rounding not to matter.
        cases += [case | {name: case[name] + k * d} for k in (1, -1, 2, -2)]
    value = flat(solve(cases)).reshape(len(entries), 4, -1)
    near, far = value[:, 0] - value[:, 1], value[:, 2] - value[:, 3]
    numeric = (8 * near - far) / (12 * np.array(steps)[:, None])
    of = np.array([name for name, _ in entries])
    for exact in jacobians(case, entries):
        for name in case:
            off = np.abs(exact - numeric)[of == name]
            # Relative to the largest derivative of the same number by the same input.
            assert np.all(off <= 1e-6 * np.abs(exact[of == name]).max(axis=0) + 1e-11), name
        assert np.abs(exact[of == "noise"][:, :3]).max() > 1e-4


def second_along(case, way):
    """Second derivative (3,) of the rate along a straight line."""

    def slope(t):
        moved = jax.tree.map(lambda at, d: at + t * d, case, way)
        return jax.jvp(lambda c: found(**c).rate, (moved,), (way,))[1]

    return jax.jvp(slope, (0.0,), (1.0,))[1]


def test_second_derivative():
    """A rule for a derivative that is itself not differentiated as it should be."""
    case, rng = noisy_case(), np.random.default_rng(12)
    way = {name: 0.1 * np.abs(at).max() * rng.normal(size=at.shape) for name, at in case.items()}
    step = 2e-3
    line = [jax.tree.map(lambda at, d, k=k: at + k * step * d, case, way) for k in range(-3, 4)]
    weights = np.array([2, -27, 270, -490, 270, -27, 2]) / (180 * step**2)
    expected = weights @ solve(line).rate
    got = compilation.jit(second_along)(case, way)
    np.testing.assert_allclose(got, expected, rtol=0, atol=1e-6 * np.abs(expected).max())


def test_transition_is_the_derivative_by_the_rate_before():
    """A transition, or its part in the covariance, that is not the derivative the filter needs."""
    case, step = noisy_case(), 1e-4
    rate = np.array([4.0, 1.0, -3.0])
    case["readings"] = make_case(case["positions"], case["axes"], rate, case["before"], 0.02)[
        "readings"
    ]
    moves = [sign * d for d in step * np.eye(3) for sign in (1, -1)]
    got = solve(
        [case, case | {"cov": np.zeros((3, 3))}]
        + [case | {"before": case["before"] + d} for d in moves]
    )
    numeric = (got.rate[2::2] - got.rate[3::2]).T / (2 * step)
    transition = got.transition[0]
    np.testing.assert_allclose(transition, numeric, rtol=0, atol=1e-7)
    expected = got.covariance[1] + transition @ case["cov"] @ transition.T
    np.testing.assert_allclose(got.covariance[0], expected, rtol=1e-10)


def degenerate_arrays():
    rng = np.random.default_rng(6)
    positions, axes = random_array(rng)
    line = np.array([0.1, 0.2, 0.3]) + np.outer(rng.uniform(-0.05, 0.05, N), [0.6, 0.0, 0.8])
    alike = np.tile(axes[0], (N, 1))
    few = axes * (np.arange(N) < 5)[:, None]
    return {
        "one place": (np.tile(positions[0], (N, 1)), axes),
        "the origin": (np.zeros((N, 3)), axes),
        "a line": (line, axes),
        "a line along x": (line[:, :1] * [1.0, 0.0, 0.0], axes),
        "parallel axes": (positions, alike),
        "parallel axes on a line": (line, alike),
        "five axes": (positions, few),
        "no axes": (positions, 0.0 * axes),
    }


def test_degenerate_arrays():
    """An array that cannot tell the rate and is not flagged, or a NaN in value or derivative; also at rest,
    and without the angular acceleration."""
    cases = []
    for positions, axes in degenerate_arrays().values():
        for rate, interval in (
            ([4.0, 1.0, -3.0], 0.02),
            ([0.0, 0.0, 0.0], 0.02),
            ([0.0, 0.0, 0.0], 1e300),
        ):
            before = np.array(rate) + 0.01 * (interval < 1.0)
            cases.append(make_case(positions, axes, np.array(rate), before, interval))
            cases.append(cases[-1] | {"readings": np.arange(N) - 5.0})
    got = solve(cases)
    assert np.all(got.degenerate) and not np.any(got.valid)
    assert all(np.all(np.isfinite(leaf)) for leaf in got)
    good = make_case(*random_array(np.random.default_rng(6)), np.zeros(3), np.zeros(3))
    cases += [good, good | {"interval": np.array(np.inf)}]
    tangents = [jax.tree.map(np.ones_like, case) for case in cases]
    slopes = in_chunks(_derivative_chunk, cases, tangents, [np.ones(21)] * len(cases))
    assert all(np.all(np.isfinite(leaf)) for leaf in jax.tree.leaves(slopes))
    unknown = np.linalg.eigvalsh(got.covariance)[:, -1]
    assert unknown.min() > 1.0


def test_too_few_axes():
    """Four axes, of which one difference is left, that are not flagged; shapes that do not fit."""
    positions, axes = random_array(np.random.default_rng(7))
    prepared = prepare(AccelerometerArray(positions[:4], axes[:4]), NOISE)
    assert int(prepared.independent) == 1 and prepared.degenerate
    with pytest.raises(ValueError, match=r"axes of shape \(3, 12\)"):
        differences(AccelerometerArray(positions, axes.T), NOISE)


def test_axes_of_a_plane_tell_the_rate():
    """Axes that feel nothing of one direction of the force, taken for a degenerate array."""
    positions, axes = random_array(np.random.default_rng(8))
    axes[:, 2] = 0.0
    rate = np.array([4.0, 1.0, -3.0])
    got = solve([make_case(positions, axes, rate, rate + 0.1)])
    assert got.valid[0]
    np.testing.assert_allclose(got.rate[0], rate, rtol=0, atol=1e-9)


def test_derivative_of_the_projection_at_a_lower_rank():
    """A derivative of projector or inverse that holds for axes of full rank only; by NumPy's inverse."""
    rng = np.random.default_rng(13)
    tall, tall_change = rng.normal(size=(2, 7, 2))
    wide, wide_change = rng.normal(size=(2, 2, 3))

    def path(t):
        return (tall + t * tall_change) @ (wide + t * wide_change)

    def by_numpy(t):
        inverse = np.linalg.pinv(path(t), rcond=1e-9)
        return np.eye(7) - path(t) @ inverse, inverse

    change = tall_change @ wide + tall @ wide_change
    value, slope = compilation.jit(lambda m, d: jax.jvp(_complement_projector, (m,), (d,)))(
        path(0.0), change
    )
    step = 1e-5
    for got, there, ahead, behind, rate in zip(
        value, by_numpy(0.0), by_numpy(step), by_numpy(-step), slope, strict=True
    ):
        np.testing.assert_allclose(got, there, rtol=0, atol=1e-13)
        np.testing.assert_allclose(rate, (ahead - behind) / (2 * step), rtol=0, atol=1e-7)


def test_missing_readings_are_no_rate():
    """A NaN that is taken for a rate, or that the search never comes back from."""
    positions, axes = random_array(np.random.default_rng(8))
    case = make_case(positions, axes, np.ones(3), np.ones(3))
    case["readings"][3] = np.nan
    assert not solve([case]).valid[0]


@pytest.mark.parametrize("interval", [np.inf, 0.5, INTERVAL])
def test_sign_of_the_rate(interval):
    """Two opposite rates that explain the readings alike and are not flagged, or a flag where the
    angular acceleration tells them apart. SciPy looks for the other one."""
    positions, axes = random_array(np.random.default_rng(9))
    rate = np.array([0.3, -0.2, 0.25])
    case = make_case(positions, axes, rate, rate + 0.001, interval, noise=1e-4)
    got = solve([case])
    np.testing.assert_allclose(got.rate[0], rate, rtol=0, atol=1e-9)

    def residual(x):
        said = law(positions, axes, x[:3], (x[:3] - case["before"]) / interval, x[3:])
        return (said - case["readings"]) / 1e-4

    other = least_squares(residual, np.concatenate([-rate, np.zeros(3)]), xtol=1e-15, gtol=1e-15)
    rival = 2 * other.cost < 9.0 and np.linalg.norm(other.x[:3] - rate) > 0.01
    assert bool(got.ambiguous[0]) == rival == (interval == np.inf)
    assert bool(got.valid[0]) != rival


def two_rates(rng, interval):
    """An array of six axes and two rates, near each other, whose differences are the same.

    Those of rates a and b differ by ``(M / T + 2 Q((a + b) / 2)) (a - b)``, so the middle is chosen where
    that matrix is singular, and the difference in its null space.
    """
    positions, axes = random_array(rng, 6)
    rest = np.linalg.qr(axes[:6], mode="complete")[0][:, 3:].T
    way = random_rate(rng)
    way /= np.linalg.norm(way)
    linear, curved = np.zeros((6, 3)), np.zeros((6, 3))
    for k, e in enumerate(np.eye(3)):
        linear[:, k] = law(positions, axes, np.zeros(3), e, np.zeros(3))[:6]
        twice = cross_matrix(way) @ cross_matrix(e) + cross_matrix(e) @ cross_matrix(way)
        curved[:, k] = np.sum(axes * (positions @ twice.T), axis=1)[:6]
    sizes, directions = eig(rest @ linear / interval, -rest @ curved)
    real = [i for i in range(3) if abs(sizes[i].imag) < 1e-12 and 0.5 < abs(sizes[i].real) < 20.0]
    if not real:
        return None
    middle, apart = sizes[real[0]].real * way, directions[:, real[0]].real
    apart *= 0.2 / np.linalg.norm(apart)
    return positions, axes, middle + apart, middle - apart


def test_a_second_rate_close_by():
    """Two rates near each other that fit alike, of which the search can only take one, not flagged."""
    rng, cases, pairs = np.random.default_rng(10), [], []
    while len(cases) < 64:
        pair = two_rates(rng, 0.02)
        if pair is None:
            continue
        positions, axes, rate, _ = pair
        before = rate + 0.1 * random_array(rng)[1][0]
        cases.append(make_case(positions, axes, rate, before, 0.02))
        pairs.append(pair[2:])
    got = solve(cases)
    taken = np.linalg.norm(got.rate[:, None] - np.array(pairs), axis=2)
    assert taken.min(axis=1).max() < 1e-9
    assert np.all(got.ambiguous)


STEPS = 120


def hand():
    """The paper's array on a hand with tremor: places, axes, rates (STEPS + 1, 3), intervals, readings."""
    places = 0.03 * np.array([[1.0, 0.2, -0.3], [-0.4, 1.0, 0.3], [0.2, -0.5, 1.0]])
    array = jax.tree.map(np.asarray, three_dual_axis(*places))
    interval = np.random.default_rng(11).uniform(1e-3, 3e-3, STEPS)
    t = np.concatenate([[0.0], np.cumsum(interval)])[:, None]
    rate = np.sin(2 * np.pi * t * [9.0, 10.0, 11.0]) + [2.0, -1.0, 1.5] * np.cos(t)
    acceleration = np.diff(rate, axis=0) / interval[:, None]
    force = [9.8, 0.0, 0.0] * np.cos(5 * t)
    rows = zip(rate[1:], acceleration, force[1:], strict=True)
    return {
        "positions": array.positions,
        "axes": array.axes,
        "readings": np.stack([law(array.positions, array.axes, *row) for row in rows]),
        "start": rate[0],
        "interval": interval,
    }, rate


def tracked(case):
    array = AccelerometerArray(case["positions"], case["axes"])
    given = case["readings"], case["start"], case["interval"], case["cov"]
    got = track(array, NOISE, *given)
    return jnp.sum(got.rate[-1] * jnp.array([1.0, -2.0, 3.0])), got


tracked_with_slope = compilation.jit(jax.value_and_grad(tracked, has_aux=True))


def test_track():
    """A step that starts from the wrong rate, intervals off by one, a covariance that is not carried."""
    case, rate = hand()
    case["cov"] = np.diag([1e-4, 2e-4, 3e-4])
    (_, got), _ = tracked_with_slope(case)
    assert np.all(got.valid)
    assert np.abs(got.rate - rate[1:]).max() <= 1e-9
    rest = np.zeros((N - 6, 3))
    positions, axes = (
        np.concatenate([case["positions"], rest]),
        np.concatenate([case["axes"], rest]),
    )
    steps = zip(rate[1:], rate[:-1], case["interval"], strict=True)
    alone = solve([make_case(positions, axes, *step) for step in steps])
    cov = case["cov"]
    for k in range(STEPS):
        cov = alone.covariance[k] + alone.transition[k] @ cov @ alone.transition[k].T
        np.testing.assert_allclose(got.covariance[k], cov, rtol=1e-8, atol=1e-12)
    # The product of the transitions, off what a wrong start adds to the last rate.
    off = 1e-6 * np.array([1.0, 2.0, -1.0])
    (_, other), _ = tracked_with_slope(case | {"start": case["start"] + off})
    for transition in alone.transition:
        off = transition @ off
    np.testing.assert_allclose(other.rate[-1] - got.rate[-1], off, rtol=1e-3, atol=1e-9)


def test_derivative_of_a_track():
    """A derivative that is lost on the way from sample to sample."""
    case = hand()[0] | {"cov": np.zeros((3, 3))}
    _, slope = tracked_with_slope(case)
    for name, place in (
        ("positions", (3, 1)),
        ("axes", (4, 2)),
        ("start", (2,)),
        ("interval", (3,)),
        ("readings", (7, 0)),
    ):
        d = np.zeros_like(case[name])
        d[place] = step = 1e-4 * float(np.abs(case[name]).max())
        near, far = (
            tracked_with_slope(case | {name: case[name] + k * d})[0][0]
            - tracked_with_slope(case | {name: case[name] - k * d})[0][0]
            for k in (1, 2)
        )
        np.testing.assert_allclose(slope[name][place], (8 * near - far) / (12 * step), rtol=1e-6)


def forgetting(case):
    array = AccelerometerArray(case["positions"], case["axes"])
    given = case["readings"], case["start"], case["interval"], case["cov"]
    got = track(array, NOISE, *given, forget_s=case["forget"])
    whole = restored(got.rate, case["start"], case["interval"], case["forget"])
    weights = jnp.array([1.0, -2.0, 3.0])
    return jnp.sum((got.rate[-1] + 2.0 * whole[-1]) * weights), (got, whole)


forgetting_with_slope = compilation.jit(jax.value_and_grad(forgetting, has_aux=True))


def test_forgotten_rate_is_restored():
    """A rate led back at another pace, twice, or by the wrong sample's interval; what is added again not
    what was taken. At such a part of a hand's rates that the
    centripetal part does not count."""
    case, rate = hand()
    rate, forget = 1e-5 * rate, 0.05
    rows = zip(rate[1:], np.diff(rate, axis=0) / case["interval"][:, None], strict=True)
    readings = [law(case["positions"], case["axes"], *row, np.ones(3)) for row in rows]
    slow = {"start": rate[0], "readings": np.stack(readings), "forget": np.array(forget)}
    (_, (got, whole)), _ = forgetting_with_slope(case | slow | {"cov": np.zeros((3, 3))})
    np.testing.assert_allclose(whole, rate[1:], rtol=0, atol=1e-8)
    expected, before = [], rate[0]
    for step, interval in zip(np.diff(rate, axis=0), case["interval"], strict=True):
        before = before * np.exp(-interval / forget) + step
        expected.append(before)
    np.testing.assert_allclose(got.rate, expected, rtol=0, atol=1e-8)
    assert np.abs(got.rate - rate[1:]).max() > 1e-5


def test_forgetting_never_is_not_forgetting():
    """An optional argument that changes more than it says."""
    case = hand()[0] | {"cov": np.diag([1e-4, 2e-4, 3e-4])}
    (_, plain), _ = tracked_with_slope(case)
    (_, (got, whole)), _ = forgetting_with_slope(case | {"forget": np.array(1e15)})
    for mine, theirs in zip(got[:4], plain[:4], strict=True):
        np.testing.assert_allclose(mine, theirs, rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(whole, plain.rate, rtol=0, atol=1e-9)


def test_noise_of_a_forgetting_track():
    """Error that is not held at ``d sqrt(forget_s / 2)``, in the rates or in their covariance; a transition
    that leaves out what is forgotten."""
    case, forget, interval, n = hand()[0], 0.1, 2e-3, 20_000
    rng = np.random.default_rng(14)
    array = AccelerometerArray(case["positions"], case["axes"])
    readings = [9.8, 1.0, 2.0] @ case["axes"].T + 1e-7 * rng.normal(size=(n, 6))

    @compilation.jit
    def run(readings):
        none = jnp.zeros(3)
        return track(array, 1e-7, readings, none, interval, jnp.zeros((3, 3)), forget_s=forget)

    got = run(readings)
    step = np.array(got.covariance[0])
    kept = np.exp(-interval / forget)
    np.testing.assert_allclose(got.covariance[-1], step / (1.0 - kept**2), rtol=1e-3)
    np.testing.assert_allclose(got.covariance[-1], step / interval * forget / 2, rtol=0.03)
    np.testing.assert_allclose(got.transition[-1], kept * np.eye(3), rtol=0, atol=1e-4)
    # Some 400 independent samples.
    whitened = np.linalg.solve(np.linalg.cholesky(got.covariance[-1]), got.rate[500:].T)
    np.testing.assert_allclose(whitened.std(axis=1), 1.0, rtol=0.15)


def test_derivative_of_a_forgetting_track():
    """A derivative that what is forgotten, or restored, does not pass on; by its time constant, too."""
    case = hand()[0] | {"cov": np.zeros((3, 3)), "forget": np.array(0.3)}
    _, slope = forgetting_with_slope(case)
    for name, place in (("start", (2,)), ("interval", (3,)), ("readings", (7, 0)), ("forget", ())):
        d = np.zeros_like(case[name])
        d[place] = step = 1e-4 * float(np.abs(case[name]).max())
        near, far = (
            forgetting_with_slope(case | {name: case[name] + k * d})[0][0]
            - forgetting_with_slope(case | {name: case[name] - k * d})[0][0]
            for k in (1, 2)
        )
        np.testing.assert_allclose(slope[name][place], (8 * near - far) / (12 * step), rtol=1e-6)


def test_track_without_covariance_and_wrong_shapes():
    """A way through the scan that needs a covariance; readings of another array."""
    case, rate = hand()
    array = AccelerometerArray(case["positions"], case["axes"])
    got = jax.eval_shape(track, array, NOISE, case["readings"], rate[0], INTERVAL)
    assert got.rate.shape == (STEPS, 3) and got.covariance.shape == (STEPS, 3, 3)
    with pytest.raises(ValueError, match=r"expected \(N, 6\)"):
        track(array, NOISE, case["readings"][:, :5], rate[0], INTERVAL)


@given(st.integers(0, 2**32 - 1), st.floats(1e-3, 1e3), st.floats(1e-3, 10.0))
def test_units_and_origin_do_not_matter(seed, longer, slower):
    """A tolerance in metres, seconds or units of the noise, or a rate that depends on the origin."""
    rng = np.random.default_rng(seed)
    rate = random_rate(rng)
    case = make_case(*random_array(rng), rate, rate - INTERVAL * rng.uniform(-300, 300, 3))
    scale = longer / slower**2
    other = {
        "positions": longer * (case["positions"] + 0.1),
        "noise": scale * case["noise"],
        "readings": scale * case["readings"],
        "before": case["before"] / slower,
        "interval": case["interval"] * slower,
    }
    got = solve([case, case | other])
    np.testing.assert_allclose(got.rate[1] * slower, got.rate[0], rtol=0, atol=1e-9)
    assert got.valid[0] == got.valid[1]
