"""Errors are as large as the covariances say (row 7): 200 runs drawn from the models themselves."""

import os
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scenario
from scipy.linalg import solve_discrete_are
from scipy.stats import chi2

from jaxekf import get_model, jit
from jaxekf.estimation.batch import estimate_many
from jaxekf.estimation.parameters import as_arrays
from jaxekf.evaluation import metrics
from jaxekf.filtering import smoother
from jaxekf.filtering.model import Belief
from jaxekf.filtering.steps import Knots, Rows, Steps
from jaxekf.geometry import manifold
from jaxekf.recordings.truth import encoder_at
from jaxekf.simulation import attitude_runs

RUNS = 200
TRACKER_S = 0.016
LEVEL = 0.99


def parameters(name):
    """Noise with which the slowest mode of the filter settles in about a second."""
    params = as_arrays(get_model(name).parameters)
    noise = params.noise._replace(
        gyroscope=np.deg2rad(0.2), bias_walk=np.deg2rad(0.3), optical=np.deg2rad(0.3)
    )
    initial = params.initial._replace(attitude=np.deg2rad(3.0), bias=np.deg2rad(1.0))
    if name == "loose_rate":
        noise = noise._replace(acceleration=np.deg2rad(20.0))
        initial = initial._replace(rate=np.deg2rad(5.0))
    return as_arrays(params._replace(noise=noise, initial=initial))


def correlation_time(name, params):
    """Slowest time constant, in seconds, of the closed loop of one axis in steady state."""
    noise, dt = params.noise, TRACKER_S
    gyroscope, walk, optical = (
        float(x) ** 2 for x in (noise.gyroscope, noise.bias_walk, noise.optical)
    )
    if name == "loose":
        f, h = np.array([[1.0, -dt], [0.0, 1.0]]), np.array([[1.0, 0.0]])
        q, r = np.diag([gyroscope * dt, walk * dt]), np.array([[optical]])
    else:
        push = float(noise.acceleration) ** 2
        f = np.array([[1.0, dt, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]])
        h = np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 1.0]])
        q = np.diag([push * dt**3 / 3, push * dt, walk * dt])
        r = np.diag([optical, gyroscope / dt])
    p = solve_discrete_are(f.T, h.T, q, r)
    gain = p @ h.T @ np.linalg.inv(h @ p @ h.T + r)
    slowest = np.max(np.abs(np.linalg.eigvals((np.eye(len(f)) - gain @ h) @ f)))
    return -dt / np.log(slowest)


def blank_steps(name, epochs):
    """Two gyroscope periods an epoch, the tracker at its end, hidden now and then."""
    time = (np.arange(2 * epochs).reshape(epochs, 2) + 1.0) * TRACKER_S / 2
    dt = np.full((epochs, 2), TRACKER_S / 2)
    seen = np.ones((epochs, 3), bool)
    seen[epochs // 2 : epochs // 2 + 31] = False
    identity = np.tile([1.0, 0.0, 0.0, 0.0], (epochs, 1))
    slow = {"optical": Rows(identity, None, seen, np.full(epochs, TRACKER_S))}
    fast, knots = {}, None
    if name == "loose":
        t = np.arange(2 * epochs + 1) * TRACKER_S / 2
        value = np.stack([np.sin(0.9 * t), np.cos(1.3 * t), 0.5 * np.sin(2.1 * t)], axis=1)
        steps = 0.5 * (value[1:] + value[:-1]) * np.diff(t)[:, None]
        knots = Knots(t, value, np.concatenate([np.zeros((1, 3)), np.cumsum(steps, axis=0)]))
    else:
        fast["gyroscope"] = Rows(np.zeros((epochs, 2, 3)), None, np.ones((epochs, 2, 3), bool), dt)
    return Steps(time, dt, np.ones((epochs, 2), bool), knots, fast, slow)


@partial(jit, static_argnums=0)
def monte_carlo(model, params, steps, keys):
    """What became of simulated runs at the ends of epochs, (runs, K): the tracker's NIS, health, error
    vectors of the whole state and their covariances, of the filter and of the smoother."""

    def one(key):
        first, second = jax.random.split(key)
        mean = model.initial_mean({})
        cov = model.initial_covariance(params)
        error = jnp.linalg.cholesky(cov) @ jax.random.normal(first, cov.shape[:1])
        truth, drawn = attitude_runs.draw(
            model, params, manifold.retract(model.space, mean, error), steps, second
        )
        return truth, drawn, Belief(mean, cov)

    truth, drawn, belief = jax.vmap(one)(keys)
    every = jax.tree.map(lambda a: jnp.broadcast_to(a, (len(keys), *a.shape)), params)
    found = smoother.run_smoother_batch(model, every, belief, drawn)
    output = found.filtered

    def ends(estimated):
        mean, cov, true = jax.tree.map(lambda a: a[:, :, -1], (*estimated, truth))
        return jax.vmap(jax.vmap(partial(manifold.local, model.space)))(mean, true), cov

    innovations = output.innovations["optical"].nis
    healthy = output.instants.healthy
    return innovations, healthy, ends(output.instants.updated), ends(found.smoothed)


@pytest.mark.parametrize("name", scenario.long_form(["loose", "loose_rate"], {"loose_rate"}))
def test_errors_and_innovations_are_as_large_as_their_covariances(name):
    """Would catch a wrong F, G, Q, R or reset, noise that depends on the sampling rate, and a smoother
    that promises more, or gains less, than the samples after an instant give."""
    model, params = get_model(name), parameters(name)
    settle = correlation_time(name, params)
    epochs = int(np.ceil(20.0 * settle / TRACKER_S)) + 50
    assert epochs * TRACKER_S >= 20.0 * settle
    keys = jax.random.split(jax.random.key(7), RUNS)
    steps = blank_steps(name, epochs)
    found = jax.tree.map(np.asarray, monte_carlo(model, params, steps, keys))
    nis, healthy, filtered, smoothed = found
    assert healthy.all()
    seen = steps.slow["optical"].mask[:, 0]

    def nees(estimated, size):
        error, cov = estimated[0][..., :size], estimated[1][..., :size, :size]
        return np.einsum("rki,rki->rk", error, np.linalg.solve(cov, error[..., None])[..., 0])

    for squares, freedom in (
        (nees(filtered, 3), 3),
        (nis[:, seen], 3),
        (nees(smoothed, model.error_dim), model.error_dim),
    ):
        values = squares.mean(axis=0)
        low, high = chi2.ppf([0.5 * (1 - LEVEL), 0.5 * (1 + LEVEL)], freedom * RUNS) / RUNS
        inside = np.mean((values >= low) & (values <= high))
        assert inside >= 0.9, (name, inside, values.mean() / freedom)

    def size(estimated, chosen):
        error, cov = estimated[0][:, chosen, :3], estimated[1][:, chosen, :3, :3]
        return np.mean(np.sum(error**2, axis=-1)), np.mean(np.trace(cov, axis1=-2, axis2=-1))

    for chosen in (seen, ~seen):
        ratios = np.divide(size(smoothed, chosen), size(filtered, chosen))
        gained, expected = np.sqrt(ratios)
        assert abs(gained / expected - 1.0) < 0.03, (name, gained, expected)


@pytest.mark.long
def test_loose_is_consistent_on_physically_simulated_runs():
    """Would catch a gyroscope density that does not match white noise on single samples, an input
    that is not the interval mean, or a wrong start: here the simulator, not the model, makes the runs."""
    count = 200 if os.environ.get("JAXEKF_LONG") else 40
    grade = attitude_runs.SensorGrade(gyroscope_deg=0.2, bias_walk_deg=0.1, optical_deg=0.3)
    records = [
        attitude_runs.recording(
            f"run-{i}",
            attitude_runs.free_motion(i),
            seed=i,
            duration_s=30.0,
            grade=grade,
            occlusions=[(12.0, 13.0)],
        )
        for i in range(count)
    ]
    model = get_model("loose")
    noise = model.parameters.noise._replace(
        gyroscope=np.deg2rad(0.2), bias_walk=np.deg2rad(0.1), optical=np.deg2rad(0.3)
    )
    estimates = estimate_many(records, model, model.parameters._replace(noise=noise))
    nees = []
    for made, record in zip(estimates, records, strict=True):
        truth = encoder_at(record.need_encoder(), made.time_ns)
        error = metrics.attitude_error(made.attitude.value, truth.q_ref_body)
        nees.append(metrics.normalised_square(error, made.attitude.cov))
    mean = np.mean(nees, axis=0)
    low, high = chi2.ppf([0.5 * (1 - LEVEL), 0.5 * (1 + LEVEL)], 3 * count) / count
    assert np.mean((mean >= low) & (mean <= high)) >= 0.9, mean.mean()
