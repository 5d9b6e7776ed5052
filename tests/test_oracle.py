"""The filter against a plain NumPy filter with hand-written Jacobians, and against filterpy."""

import jax
import jax.numpy as jnp
import numpy as np
import oracle
import pytest
import scenario
import toy_models
from filterpy.kalman import KalmanFilter
from scipy.spatial.transform import Rotation

from jaxekf.filtering import _linearisation as linearisation
from jaxekf.filtering.interpolation import InputSample
from jaxekf.filtering.model import Belief
from jaxekf.filtering.steps import Rows, Steps
from jaxekf.models import REGISTRY

NAMES = ("loose", "loose_rate", "loose_additive")


def system_of(name):
    """Parameters for the package, and the same system for the oracle."""
    params = scenario.parameters(name)
    cov = {key: np.asarray(leaf @ leaf.T) for key, leaf in params.noise._asdict().items()}
    if name == "loose":
        calibration = params.calibration
        turn = Rotation.from_rotvec(np.array(calibration.alignment)).as_matrix()
        matrix = turn @ np.asarray(calibration.gyroscope_matrix)
        return params, oracle.Loose(**cov, gyroscope_matrix=matrix)
    system = oracle.LooseRate if name == "loose_rate" else oracle.LooseAdditive
    return params, system(**cov)


def start_of(name, run, size):
    """A start off the truth, with a correlated covariance."""
    root = scenario.factor(30, size, 0.05)
    q = oracle.product(run.truth[0], oracle.exp(np.array([0.05, -0.04, 0.03])))
    zero = np.zeros(3)
    mean = (q, zero) if name == "loose" else (q, np.array([0.1, -0.2, 0.3]), zero)
    return mean, root @ root.T


def row_masks(run, name):
    """The tracker's row masks, some of them for single rows."""
    mask = scenario.optical_mask(run, name)
    mask[4, 1] = mask[12, 0] = mask[12, 2] = False
    return mask


def events_of(run, name, mask, offset, drift):
    since = scenario.since_last(run)
    events = []
    for i, dt in enumerate(np.diff(run.time, prepend=0.0)):
        samples = {"optical": (run.optical[i], mask[i], since[i])}
        u = None
        if name == "loose":
            ends = (1.0 + drift) * np.array([run.time[i] - dt, run.time[i]]) + offset
            u = oracle.interval_mean(run.knots.time, run.knots.value, *ends)
        else:
            samples["gyroscope"] = (run.gyroscope[i], run.gyroscope_seen[i], since[i])
        events.append((dt, u, samples))
    return events


def prepared(name, seed):
    run = scenario.make_run(seed)
    run.gyroscope_seen[7, 1] = run.gyroscope_seen[9, 0] = False
    model = REGISTRY[name]
    params, system = system_of(name)
    mean, cov = start_of(name, run, model.error_dim)
    belief = scenario.as_arrays(Belief(type(model.space)(*mean), cov))
    mask = row_masks(run, name)
    clock = (0.0, 0.0)
    if name == "loose":
        clock = (float(params.calibration.clock_offset), float(params.calibration.clock_drift))
    expected = oracle.run(system, mean, cov, events_of(run, name, mask, *clock))
    return run, model, params, belief, mask, expected


def assert_mean(actual, expected):
    """States equal, quaternions up to sign."""
    q = np.asarray(actual[0])
    sign = np.sign(np.sum(q * expected[0], axis=-1, keepdims=True))
    np.testing.assert_allclose(sign * q, expected[0], rtol=0, atol=1e-10)
    for got, wanted in zip(actual[1:], expected[1:], strict=True):
        np.testing.assert_allclose(got, wanted, rtol=0, atol=1e-10)


def stacked(results, stage):
    means = [result[stage][0] for result in results]
    covs = np.stack([result[stage][1] for result in results])
    return tuple(np.stack(part) for part in zip(*means, strict=True)), covs


def assert_instants(instants, expected):
    for stage in ("predicted", "updated"):
        mean, cov = stacked(expected, stage)
        got = getattr(instants, stage)
        assert_mean(got.mean, mean)
        np.testing.assert_allclose(got.cov, cov, rtol=0, atol=1e-10)
    log_likelihood = np.array([result["log_likelihood"] for result in expected])
    np.testing.assert_allclose(instants.log_likelihood, log_likelihood, rtol=1e-10, atol=1e-10)
    total = log_likelihood.sum()
    assert abs(float(np.sum(instants.log_likelihood)) - total) <= 1e-10 * abs(total)
    assert np.all(instants.healthy)


def assert_innovation(innovation, expected, name):
    residual, cov, nis = (
        np.stack(part) for part in zip(*(r["innovations"][name] for r in expected), strict=True)
    )
    np.testing.assert_allclose(innovation.residual, residual, rtol=0, atol=1e-10)
    np.testing.assert_allclose(innovation.cov, cov, rtol=1e-10, atol=1e-10)
    np.testing.assert_allclose(innovation.nis, nis, rtol=1e-8, atol=1e-10)


@pytest.mark.parametrize("name", NAMES)
def test_oracle_flat(name):
    """A wrong Jacobian, gain, reset, mask, whitening, likelihood or interval mean."""
    run, model, params, belief, mask, expected = prepared(name, 0)
    output = scenario.run_filter(model, params, belief, scenario.flat_steps(run, name, mask))
    instants, innovations = jax.tree.map(lambda a: a[:, 0], (output.instants, output.innovations))
    assert_instants(instants, expected)
    assert mask.any() and not mask.all()
    for sensor in model.sensors:
        assert_innovation(innovations[sensor.name], expected, sensor.name)


@pytest.mark.parametrize("name", NAMES)
def test_oracle_epochs(name):
    """Epochs that are laid out, padded in front or ended differently from a flat timeline."""
    run, model, params, belief, mask, expected = prepared(name, 1)
    steps, index = scenario.epoch_steps(run, name, 5, mask)
    assert (index < 0).any() and (index >= 0).sum() == len(run.time)
    output = scenario.run_filter(model, params, belief, steps)
    assert_instants(jax.tree.map(lambda a: a[index >= 0], output.instants), expected)
    ended = [expected[i] for i in index[:, -1]]
    assert_innovation(output.innovations["optical"], ended, "optical")
    padding = np.asarray(output.instants.log_likelihood)[index < 0]
    np.testing.assert_array_equal(padding, 0.0)


def test_oracle_follows_the_truth():
    """An oracle (and so a filter that equals it) that agrees with nothing outside."""
    run, _, _, _, _, expected = prepared("loose", 0)
    (q, _), _ = stacked(expected, "updated")
    errors = [
        np.linalg.norm(oracle.log(oracle.product(oracle.conjugate(a), b)))
        for a, b in zip(run.truth, q, strict=True)
    ]
    start = np.linalg.norm([0.05, -0.04, 0.03])
    assert max(errors) < start
    assert errors[-1] < 0.25 * start


def added_noise(model, params, dt):
    """F and G Sigma G' of a step at rest."""
    zero = jnp.zeros(3)
    q = jnp.array([1.0, 0.0, 0.0, 0.0])
    x = model.space._make([q] + [zero] * (len(model.space) - 1))
    u = InputSample(zero, zero, jnp.zeros(()))
    _, f, g = linearisation.linearise_transition(model, params, x, u, dt)
    return f, g @ model.process_noise(params, dt) @ g.T


@pytest.mark.parametrize("name", ["loose", "loose_rate"])
def test_step_cut_in_two(name):
    """Process noise that depends on how often the filter steps."""
    model = REGISTRY[name]
    params, _ = system_of(name)
    dt = jnp.array(0.1)
    _, whole = added_noise(model, params, dt)
    f, half = added_noise(model, params, dt / 2)
    np.testing.assert_allclose(f @ half @ f.T + half, whole, rtol=1e-12, atol=1e-18)


def step_log_likelihood(kalman, z):
    kalman.predict()
    kalman.update(z)
    return kalman.log_likelihood


def test_linear_case_against_filterpy():
    """A filter that is not the Kalman filter where everything is linear."""
    rng = np.random.default_rng(5)
    dt, count = 0.1, 30
    a = np.kron(np.array([[1.0, dt], [0.0, 1.0]]), np.eye(2))
    q = 0.3 * np.kron(np.array([[dt**3 / 3.0, dt**2 / 2.0], [dt**2 / 2.0, dt]]), np.eye(2))
    h = np.eye(2, 4)
    r = np.array([[0.5, 0.2], [0.2, 0.4]])
    z = np.cumsum(rng.standard_normal((count, 2)), axis=0)
    root = scenario.factor(1, 4, 1.0)
    start, cov = rng.standard_normal(4), root @ root.T
    kalman = KalmanFilter(dim_x=4, dim_z=2)
    kalman.x, kalman.P, kalman.F, kalman.Q, kalman.H, kalman.R = start, cov, a, q, h, r
    means, covs, gained = [], [], []
    for sample in z:
        gained.append(step_log_likelihood(kalman, sample))
        means.append(kalman.x.copy())
        covs.append(kalman.P.copy())

    rows = Rows(z[:, None], None, np.ones((count, 1, 2), bool), np.full((count, 1), dt))
    time = dt * np.arange(1, count + 1)[:, None]
    steps = Steps(time, np.full_like(time, dt), time > 0, None, {"sensor_0": rows}, {})
    model = toy_models.linear_model(a, q, [h], [r])
    output = scenario.run_filter(model, model.parameters, Belief(jnp.asarray(start), cov), steps)
    updated = jax.tree.map(lambda array: np.asarray(array)[:, 0], output.instants.updated)
    np.testing.assert_allclose(updated.mean, np.stack(means), rtol=0, atol=1e-10)
    np.testing.assert_allclose(updated.cov, np.stack(covs), rtol=0, atol=1e-10)
    np.testing.assert_allclose(output.instants.log_likelihood[:, 0], gained, rtol=1e-10, atol=0)
