"""Outliers: gates and weights, what they cost where there are none, and the way back after a gap."""

import dataclasses
from functools import partial

import jax
import jax.numpy as jnp
import naive
import numpy as np
import pytest
import scenario
import test_consistency as honest
import toy_models

import jaxekf
from jaxekf import jit
from jaxekf._support.errors import ModelError
from jaxekf.filtering import ekf, smoother
from jaxekf.filtering.model import Belief
from jaxekf.filtering.steps import Rows, Steps
from jaxekf.geometry import manifold, rotation
from jaxekf.models.robust import OUTLIER_METHODS
from jaxekf.recordings.truth import encoder_at
from jaxekf.recordings.types import to_scipy
from jaxekf.simulation import attitude_runs

RUNS = 100
EPOCHS = 1000
SIGMAS = 20.0


def linear_problem(means):
    """A plain Kalman filter of one correlated sensor in two groups, some samples far off."""
    rng = np.random.default_rng(3)
    transition = np.eye(3) + 0.1 * rng.standard_normal((3, 3))
    noise = 0.3 * (np.eye(3) + 0.4 * np.tril(rng.standard_normal((3, 3)), -1))
    model = toy_models.linear_model(
        transition, 0.1 * np.eye(3), [rng.standard_normal((3, 3))], [noise @ noise.T]
    )
    sensors = (dataclasses.replace(model.sensors[0], groups=(0, 0, 1)),)
    # The naive filter has no patience to lose.
    model = dataclasses.replace(model, sensors=sensors, gate_reset_after_s=1e9)
    model = jaxekf.robust(model, means)
    value = rng.standard_normal((12, 1, 3))
    value[[4, 7]] += 5.0
    mask = rng.uniform(size=(12, 1, 3)) < 0.8
    one = np.ones((12, 1))
    rows = Rows(value, None, mask, one)
    steps = Steps(np.cumsum(one)[:, None], one, one > 0, None, {"sensor_0": rows}, {})
    return model, Belief(jnp.zeros(3), jnp.eye(3)), jax.tree.map(jnp.asarray, steps)


@pytest.mark.parametrize("means", ["gate", "huber", "student"])
def test_against_the_naive_filter(means):
    """A weight of another group's rows, a derivative that forgets that weights move, and a smoother that
    takes samples with other weights than the filter did."""
    model, belief, steps = linear_problem(means)

    def fast(belief):
        output = smoother.run_smoother(model, model.parameters, belief, steps)
        at = output.filtered.instants
        found = tuple(at.predicted), tuple(at.updated), at.log_likelihood
        return scored((found, tuple(output.smoothed))), (found, output)

    def slow(belief):
        belief = belief._replace(cov=0.5 * (belief.cov + belief.cov.T))
        found = naive.run(model, model.parameters, belief, steps)
        smoothed = naive.smooth(model, model.parameters, belief, steps)[0]
        return scored((found, smoothed)), (found, smoothed)

    def scored(found):
        rng = np.random.default_rng(1)
        return sum(jnp.sum(a * rng.normal(size=a.shape)) for a in jax.tree.leaves(found))

    (_, (found, output)), slope = scenario.quick_jit(jax.value_and_grad(fast, has_aux=True))(belief)
    (_, (wanted, smoothed)), expected = scenario.quick_jit(jax.value_and_grad(slow, has_aux=True))(
        belief
    )
    every = jax.tree.leaves((found, tuple(output.smoothed), slope))
    for a, b in zip(every, jax.tree.leaves((wanted, smoothed, expected)), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-9, atol=1e-9)
    innovation = output.filtered.innovations["sensor_0"]
    if means == "gate":
        assert innovation.weight is None
        assert innovation.gated.any()
    else:
        weight = np.asarray(innovation.weight)
        assert not innovation.gated.any()
        assert weight[4].min() < 0.5
        assert np.all(weight[~np.asarray(innovation.used)] == 0.0)
        assert weight.max() == 1.0


@partial(jit, static_argnums=(0, 1))
def errors(model, drawn_from, params, steps, keys, share):
    """Error vectors (runs, K, 6) at the ends of epochs, deviations, and rows used and refused, of runs of
    which a `share` of the tracker's samples is turned by 20 deviations."""

    def one(key):
        first, second, third, fourth = jax.random.split(key, 4)
        mean = drawn_from.initial_mean({})
        cov = drawn_from.initial_covariance(params)
        error = jnp.linalg.cholesky(cov) @ jax.random.normal(first, cov.shape[:1])
        true = manifold.retract(drawn_from.space, mean, error)
        truth, drawn = attitude_runs.draw(drawn_from, params, true, steps, second)
        rows = drawn.slow["optical"]
        way = jax.random.normal(third, (rows.mask.shape[0], 3))
        way = way / jnp.linalg.norm(way, axis=1, keepdims=True)
        off = jax.random.uniform(fourth, rows.mask.shape[:1]) < share
        turn = SIGMAS * params.noise.optical * way * off[:, None]
        value = jax.vmap(rotation.product)(rows.value, jax.vmap(rotation.exp)(turn))
        return (
            truth,
            drawn._replace(slow={"optical": rows._replace(value=value)}),
            Belief(mean, cov),
        )

    truth, drawn, belief = jax.vmap(one)(keys)
    every = jax.tree.map(lambda a: jnp.broadcast_to(a, (len(keys), *a.shape)), params)
    output = ekf.run_filter_batch(model, every, belief, drawn)
    mean, cov, true = jax.tree.map(lambda a: a[:, :, -1], (*output.instants.updated, truth))
    error = jax.vmap(jax.vmap(partial(manifold.local, model.space)))(mean, true)
    sigma = jnp.sqrt(jnp.diagonal(cov, axis1=2, axis2=3))
    innovation = output.innovations["optical"]
    return error, sigma, innovation.used.any(axis=2), innovation.gated.any(axis=2)


def monte_carlo(means, share, steps):
    original = jaxekf.get_model("loose")
    params = honest.parameters("loose")
    keys = jax.random.split(jax.random.key(11), RUNS)
    model = jaxekf.robust(original, means)
    return [np.asarray(a) for a in errors(model, original, params, steps, keys, share)]


@pytest.fixture(scope="module")
def whole():
    """Steps in which the tracker always sees."""
    steps = honest.blank_steps("loose", EPOCHS)
    rows = steps.slow["optical"]
    return steps._replace(slow={"optical": rows._replace(mask=np.ones_like(rows.mask))})


@pytest.fixture(scope="module")
def clean(whole):
    """Root mean square of every part of the error without outliers, (6,)."""
    error = monte_carlo("none", 0.0, whole)[0]
    return np.sqrt(np.mean(error[:, 200:] ** 2, axis=(0, 1)))


@pytest.mark.parametrize("means", ["none", "gate", "huber", "student"])
def test_outliers_cost_little(means, whole, clean):
    """One sample in twenty is 20 deviations off: means that let them in, or throw good ones out."""
    error = monte_carlo(means, 0.05, whole)[0]
    ratio = np.sqrt(np.mean(error[:, 200:] ** 2, axis=(0, 1))) / clean
    attitude = np.sqrt(np.mean(ratio[:3] ** 2))
    if means == "none":
        assert attitude > 2.0  # else the test would prove nothing
    else:
        assert ratio.max() <= 1.1, ratio


def test_a_gate_refuses_as_often_as_it_says(whole):
    """A bound of another number of rows, or a covariance of another sample: 1 in 1000 honest ones."""
    _, _, used, gated = monte_carlo("gate", 0.0, whole)
    assert used.sum() + gated.sum() == RUNS * EPOCHS
    assert 0.0005 <= gated.mean() <= 0.002


def test_back_after_a_gap(whole):
    """A gate that locks out: 10 s without tracker, then with it, and within 1 s all is as said again."""
    rows = whole.slow["optical"]
    mask = np.array(rows.mask)
    begin, end = 200, 200 + round(10.0 / honest.TRACKER_S)
    mask[begin:end] = False
    hidden = whole._replace(slow={"optical": rows._replace(mask=mask)})
    error, sigma, _, _ = monte_carlo("gate", 0.0, hidden)
    after = end + round(1.0 / honest.TRACKER_S)
    inside = np.abs(error[:, after]) <= 3.0 * sigma[:, after]
    assert inside.mean() >= 0.97
    lost = np.rad2deg(np.abs(error[:, end - 1, :3])).mean()
    assert lost > 2.0 * np.rad2deg(np.abs(error[:, after, :3])).mean()


def test_models_and_means_that_do_not_fit():
    """A misspelt word taken for none, and least squares that silently count outliers in full."""
    with pytest.raises(ModelError, match="gate, huber, student, none"):
        jaxekf.robust("loose", "cauchy")
    with pytest.raises(ModelError, match="between 0 and 1"):
        jaxekf.robust("loose", "gate", 99.9)
    model, belief, steps = linear_problem("huber")
    with pytest.raises(ModelError, match="heavy tails"):
        jaxekf.run_iterated_smoother(model, model.parameters, belief, steps)
    assert jaxekf.robust("loose", "huber") is jaxekf.robust("loose", "huber")


def test_what_a_result_tells(tmp_path):
    """Weights that are applied and not told."""
    run = jaxekf.load(jaxekf.demo.FOLDER / "free-5")
    wrong = run.optical.q_ref_body.copy()
    wrong[100:1400:100] = scenario.from_scipy(
        scenario.Rotation.from_rotvec([0.0, 0.0, 0.5])
        * jaxekf.recordings.types.to_scipy(wrong[100:1400:100])
    )
    spoilt = run.replace(optical=dataclasses.replace(run.optical, q_ref_body=wrong))
    made = jaxekf.estimate(spoilt, jaxekf.robust("loose", "student"))
    assert any("robust weight below 0.5" in note for note in made.notes)
    assert made.summary()["outliers"] == {"optical": {"gate": None, "weighting": "student"}}
    head = (made.save(tmp_path / "r") / "innovations_optical.csv").read_text().splitlines()[0]
    assert "weight_x" in head
    assert np.all(made.sensors["optical"].weight <= 1.0)
    assert jaxekf.score(made, run).attitude_rmse_deg < 0.2


def test_old_names_work_for_one_release():
    """Would catch a script with an old name of an argument or a field that breaks, or is not warned."""
    with pytest.warns(DeprecationWarning, match="outlier_method"):
        model = jaxekf.robust("loose", means="huber")
    assert model is jaxekf.robust("loose", "huber")
    with pytest.warns(DeprecationWarning, match="gate_reset_after_s"):
        changed = dataclasses.replace(model, patience_s=2.0)
    assert changed.gate_reset_after_s == 2.0
    with pytest.warns(DeprecationWarning, match="gate_reset_after_s"):
        assert changed.patience_s == 2.0
    (sensor,) = model.sensors
    with pytest.warns(DeprecationWarning, match="typical_aux"):
        assert dataclasses.replace(sensor, aux_like=1.0).typical_aux == 1.0
    with pytest.warns(DeprecationWarning, match="single_group"):
        assert sensor.alike is None


WRONG = [
    (5.0, 0.3),
    (5.0, 3.0),
    (20.0, 1.2),
    (60.0, 0.6),
    (180.0, 0.25),
    (180.0, 1.2),
    (120.0, 5.0),
]
"""Angle, degrees, and length, seconds, of stretches of wrong poses."""
BEGIN_S, LENGTH_S = 8.0, 16.0


def wrong_poses(seed, angle_deg, length_s, speed_deg=40.0):
    """A run whose poses are turned about one body axis for a while."""
    motion = attitude_runs.free_motion(seed, speed_deg=speed_deg)
    run = attitude_runs.recording(f"w{seed}", motion, seed=seed, duration_s=LENGTH_S)
    optical, axis = run.need_optical(), np.random.default_rng(seed).standard_normal(3)
    time = (optical.time_ns - optical.time_ns[0]) / 1e9
    wrong = (time >= BEGIN_S) & (time < BEGIN_S + length_s)
    turn = scenario.Rotation.from_rotvec(np.deg2rad(angle_deg) * axis / np.linalg.norm(axis))
    turned = scenario.from_scipy(to_scipy(optical.q_ref_body) * turn)
    q = np.where(wrong[:, None], turned, optical.q_ref_body)
    return run.replace(optical=dataclasses.replace(optical, q_ref_body=q))


@pytest.mark.parametrize(
    ("method", "smooth"),
    scenario.long_form(
        [(method, smooth) for method in OUTLIER_METHODS[:3] for smooth in (False, True)],
        {(method, True) for method in ("huber", "student")},
    ),
)
def test_back_within_a_second_of_right_poses(method, smooth):
    """Would catch a filter that stays with wrong poses, or whose bias or covariance they have spoilt."""
    runs = [wrong_poses(seed, *stretch) for seed, stretch in enumerate(WRONG)]
    model = jaxekf.robust("loose", method)
    for run, made, stretch in zip(
        runs, jaxekf.estimate_many(runs, model, smooth=smooth), WRONG, strict=True
    ):
        truth = to_scipy(encoder_at(run.need_encoder(), made.time_ns).q_ref_body)
        error = (truth.inv() * to_scipy(made.attitude.value)).as_rotvec()
        later = made.time > BEGIN_S + stretch[1] + 1.0
        assert np.rad2deg(np.linalg.norm(error[later], axis=1)).max() < 1.0, stretch
        assert np.sqrt(np.mean((error[later] / made.attitude.sigma[later]) ** 2)) < 3.0, stretch
        assert np.isfinite(made.cov).all()
        if stretch[1] > model.gate_reset_after_s and not smooth:
            assert any("contradicted the estimate" in note for note in made.notes), stretch


def test_a_bias_survives_wrong_poses_behind_a_gate():
    """Would catch a reset that forgets the bias, which the gyroscope's own samples never contradicted."""
    run = wrong_poses(3, 90.0, 1.0)
    made = jaxekf.estimate(run, jaxekf.robust("loose", "gate"))
    clean = jaxekf.estimate(wrong_poses(3, 0.0, 1.0), jaxekf.robust("loose", "gate"))
    last = made.time > BEGIN_S + 3.0
    apart = np.abs(made.bias.value - clean.bias.value)[last]
    assert (apart < 3.0 * made.bias.sigma[last]).all()
    assert made.bias.sigma[-1].max() < 2.0 * clean.bias.sigma[-1].max()


def test_sensors_that_observe_other_states_do_not_confirm_each_other():
    """Would catch a gyroscope, accepted at every sample, that keeps a lost attitude from being reset."""
    run = wrong_poses(4, 60.0, 3.0, speed_deg=4.0)
    made = jaxekf.estimate(run, jaxekf.robust("loose_rate", "gate"))
    assert any("contradicted the estimate" in note for note in made.notes)
    truth = to_scipy(encoder_at(run.need_encoder(), made.time_ns).q_ref_body)
    error = (truth.inv() * to_scipy(made.attitude.value)).magnitude()
    assert np.rad2deg(error[made.time > BEGIN_S + 4.0].max()) < 1.0
