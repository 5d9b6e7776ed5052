"""Sensors at the limit of their range: named where the numbers or the tracker show it, and not spoiling an
estimate."""

import numpy as np
import pytest
from sensor_runs import Motion, ns, pair, with_stream

import jaxekf
from jaxekf.checks._sensor_range import range_findings
from jaxekf.checks.plausibility import evidence
from jaxekf.estimation import padding
from jaxekf.recordings.clipping import clipped, limits
from jaxekf.recordings.truth import encoder_at
from jaxekf.recordings.types import to_scipy

BURSTS = ((8.0, 1300.0), (14.0, -1300.0))


@pytest.fixture(scope="module")
def fast():
    """A run of 20 s whose gyroscope reaches 3,400 deg/s in two bursts, and its bias."""
    return pair(3, duration_s=20.0, imu_hz=500.0, bursts=BURSTS)


def clip(run, limit_deg_s, axes=(0, 1, 2)):
    rate = run.imu.gyroscope.copy()
    limit = np.deg2rad(limit_deg_s)
    rate[:, axes] = np.clip(rate[:, axes], -limit, limit)
    return with_stream(run, "imu", gyroscope=rate)


def warned(run):
    return range_findings(run, evidence(run)).warnings


@pytest.mark.parametrize(("limit", "words"), [(2000.0, "±2000 deg/s"), (1746.3, "±1746 deg/s")])
def test_a_clipped_gyroscope_is_named(fast, limit, words):
    """Would catch a limit that is found only at a data sheet's figure, or without its place."""
    run, _ = fast
    (text,) = warned(clip(run, limit))
    at = np.flatnonzero(np.abs(run.imu.gyroscope).max(axis=1) >= np.deg2rad(limit))
    assert words in text and f"in {len(at)} of 10000 samples, on z" in text
    first, last = run.imu.time_ns[at[[0, -1]]] / 1e9
    assert f"from {first:.3f} to {last:.3f} s" in text
    assert warned(run) == ()


@pytest.mark.parametrize("limit", [2000.0, 500.0, 137.2])
def test_every_clipped_sample_is_found(fast, limit):
    """Would catch a limit of whole numbers of a converter, which differ in size by one, or of rates from
    which a bias was subtracted, missed on one side."""
    rate, limit = fast[0].imu.gyroscope, np.deg2rad(limit)
    step = limit / 32768.0
    whole = np.clip(np.round(rate / step), -32768.0, 32767.0) * step
    corrected = np.clip(rate, -limit, limit) - np.deg2rad([0.3, -0.2, 1.0])
    beyond = (np.abs(rate) >= limit).any(axis=1)
    for values in (whole, corrected):
        found = clipped(values)
        assert (found & beyond).sum() > 0.99 * beyond.sum() and (found & ~beyond).sum() < 3


def test_rivals_of_a_limit_are_not_called_one(fast):
    """Would catch a peak, coarse numbers, held or frozen values, or a state of rest taken for a clipped
    sensor."""
    run, _ = fast
    rate = np.rad2deg(run.imu.gyroscope)
    assert limits(np.round(rate)) == [] and limits(np.round(rate / 20.0) * 20.0) == []
    assert limits(np.repeat(rate, 4, axis=0)) == []
    frozen = rate.copy()
    top = int(np.argmax(rate[:, 2]))
    frozen[top : top + 400] = rate[top]
    assert limits(frozen) == []
    slow = np.round(np.random.default_rng(0).normal(size=(5000, 3)) * 0.6)
    assert limits(slow) == [] and limits(np.zeros((500, 3))) == []
    slow_sine = np.sin(np.arange(0, 60.0, 0.01))[:, None] * [30.0, 20.0, 10.0]
    assert limits(np.round(slow_sine * 10.0)) == []


def test_a_constant_rate_without_noise_needs_the_tracker():
    """Would catch a turntable of a simulation, which repeats its rate exactly, called clipped, and a
    clipped gyroscope without noise that the tracker gives away passed over."""
    turn = np.linspace(0.0, 20.0, 4001)
    rate = np.clip(np.where(turn > 10.0, turn - 10.0, 0.0), 0.0, 2.0)[:, None] * [0.0, 0.0, 1.0]
    (one,) = limits(rate)
    assert not one.noisy and not clipped(rate).any()
    run, _ = pair(4, duration_s=20.0, gyro_deg=0.0, bursts=((8.0, 600.0), (14.0, 600.0)))
    assert "the limit of its range, 900 deg/s" in warned(clip(run, 900.0))[0]
    path = Motion(0, amplitude_deg=(0.0, 0.0, 0.0), spin_deg_s=200.0)
    table, _ = pair(0, amplitude_deg=(0.0, 0.0, 0.0), spin_deg_s=200.0)
    even = np.tile(np.rad2deg([0.0, 0.0, 0.0]), (len(table.imu.time_ns), 1))
    even[:] = path.rate(table.imu.time_ns[:1] / 1e9)
    even[:400] = np.linspace(0.0, 1.0, 400)[:, None] * even[400]
    assert warned(with_stream(table, "imu", gyroscope=even)) == ()


def test_other_sensors_clip_in_their_unit(fast):
    """Would catch an accelerometer's limit in the wrong unit, or on the wrong axis."""
    run, _ = fast
    random = np.random.default_rng(1)
    force = 9.80665 * (random.normal(size=(len(run.imu.time_ns), 3)) * [1.0, 1.0, 3.0])
    force[:, 2] = np.minimum(force[:, 2], 9.80665 * 4.0)
    text = warned(with_stream(run, "imu", accelerometer=force))[0]
    assert text.startswith("the accelerometer is at the limit of its range, 4 g,")
    assert "on z," in text


def test_the_bias_is_right_after_clipped_stretches(fast):
    """Would catch a filter that takes 2000 deg/s for the rate: it turned the missing angle into bias."""
    run, bias = fast
    jaxekf.set_up()
    bad = clip(run, 2000.0)
    estimate = jaxekf.estimate(bad)
    late = estimate.time_ns > ns(14.8)
    error = (estimate.bias.value[late] - bias) / estimate.bias.sigma[late]
    assert np.abs(error).max() < 4.0 and np.abs(error[-1]).max() < 3.0
    assert "at the limit of its range, 2000 deg/s, in 2 stretches" in " ".join(estimate.notes)
    known = (estimate.time_ns > ns(16.0)) & (estimate.time_ns < run.encoder.time_ns[-1])
    truth = to_scipy(encoder_at(run.encoder, estimate.time_ns[known]).q_ref_body)
    apart = (truth.inv() * to_scipy(estimate.attitude.value[known])).magnitude()
    assert np.rad2deg(apart).max() < 0.5


def test_runs_with_and_without_a_limit_are_one_batch(fast):
    """Would catch a batch that cannot be stacked, or whose good run changes in it."""
    run, _ = fast
    model = jaxekf.get_model("loose")
    lines = jaxekf.timeline.build_many(model, [run, clip(run, 2000.0)])
    assert lines[0].steps.excess is None
    stacked = padding.stack(lines)
    assert not stacked.excess[0].any() and stacked.excess[1].any()
    assert not stacked.excess[..., 3:].any()
    alone = padding.pad(lines[1].steps, stacked.dt.shape[1] + 3, stacked.dt.shape[2])
    assert not alone.excess[-3:].any()


def test_a_measured_rate_is_masked(fast):
    """Would catch a model that measures the rate, and is misled by a lower bound."""
    run, _ = fast
    line = jaxekf.timeline.build(jaxekf.get_model("loose_rate"), clip(run, 2000.0))
    bad = int((np.abs(run.imu.gyroscope).max(axis=1) >= np.deg2rad(2000.0)).sum())
    assert line.account["gyroscope"]["masked"] == bad
    assert line.steps.excess[..., 3:6].any() and not line.steps.excess[..., :3].any()
    # The rate may wander by the limit within each of the two stretches.
    total = line.steps.excess[..., 3].sum()
    assert total == pytest.approx(2.0 * np.deg2rad(2000.0) ** 2, rel=0.02)
