"""The clock of an estimate's times: planted offsets and drifts between tracker, IMU and encoder."""

import json
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import jaxekf
from jaxekf._support.errors import ModelError
from jaxekf.estimation import timeline
from jaxekf.estimation.clock import Clock, clock_of
from jaxekf.models import loose
from jaxekf.recordings.types import from_scipy, to_scipy

DURATION_S = 12.0
OFFSETS = ((-0.05, 0.0), (0.02, 0.0), (0.2, 0.0), (0.0, 200e-6), (0.2, -200e-6))
"""Lateness of the tracker's stamps at the start, s, and its growth, s/s."""


def rotation(seed, t):
    """A smooth motion of three angles (N,), body to reference."""
    rng = np.random.default_rng([seed, 5])
    size, rate, phase = rng.uniform(0.3, 0.8, 3), rng.uniform(1.5, 3.0, 3), rng.uniform(0, 6, 3)
    return Rotation.from_euler("ZYX", size * np.sin(rate * t[:, None] + phase))


def body_rate(seed, t, half=1e-4):
    """Its angular rate (N, 3), rad/s, body frame."""
    return (rotation(seed, t - half).inv() * rotation(seed, t + half)).as_rotvec() / (2 * half)


def planted(seed, late_s=0.0, drift=0.0, begin_s=100.0):
    """A run whose IMU and encoder are on the true clock, the tracker on one that is late."""
    rng = np.random.default_rng([seed, 6])
    imu, tracker, encoder = (np.arange(0.0, DURATION_S, step) for step in (0.01, 0.04, 0.02))
    noise = Rotation.from_rotvec(np.deg2rad(0.2) * rng.standard_normal((len(tracker), 3)))
    gyroscope = body_rate(seed, imu) + 0.01 + 3e-3 * rng.standard_normal((len(imu), 3))
    stamps = begin_s + tracker * (1.0 + drift) + late_s
    every = np.ones(len(encoder), bool)
    return jaxekf.Recording(
        f"run-{seed}-{late_s}-{drift}",
        optical=jaxekf.Optical(
            ns(stamps), from_scipy(rotation(seed, tracker) * noise), np.ones(len(tracker), bool)
        ),
        imu=jaxekf.Imu(ns(begin_s + imu), gyroscope),
        encoder=jaxekf.Encoder(
            ns(begin_s + encoder), from_scipy(rotation(seed, encoder)), every, every
        ),
    )


def ns(seconds):
    return np.round(1e9 * seconds).astype(np.int64)


def parameters(late_s=0.0, drift=0.0):
    """Parameters of `loose` whose IMU is that much ahead of the tracker."""
    calibration = loose.DEFAULTS.calibration._replace(
        clock_offset=np.array(-late_s), clock_drift=np.array(-drift / (1.0 + drift))
    )
    noise = loose.DEFAULTS.noise._replace(optical=np.deg2rad(0.2))
    return loose.DEFAULTS._replace(calibration=calibration, noise=noise)


def best_shift_s(seed, made, begin_s=100.0):
    """By how much the truth at a later time fits the attitude better, s."""
    settled = made.time > 2.0
    t = made.time_ns[settled] / 1e9 - begin_s
    q, found = to_scipy(made.attitude.value[settled]), 0.0
    for _ in range(4):
        off = (q.inv() * rotation(seed, t + found)).as_rotvec()
        rate = body_rate(seed, t + found)
        found -= np.sum(off * rate) / np.sum(rate * rate)
    return found


@pytest.fixture(scope="module")
def estimates():
    """Ten runs for each offset, and their estimates, by one program."""
    cases = [(seed, *offset) for offset in OFFSETS for seed in range(10)]
    runs = [planted(*case) for case in cases]
    params = [parameters(*case[1:]) for case in cases]
    return cases, runs, jaxekf.estimate_many(runs, "loose", params, smooth=True)


def test_estimates_are_on_the_imu_clock(estimates):
    """Stamps that stay on the tracker's clock, move the wrong way, or forget the drift; scores there."""
    cases, runs, made = estimates
    shifts = np.array([best_shift_s(c[0], e) for c, e in zip(cases, made, strict=True)])
    print(f"largest shift {1e3 * np.abs(shifts).max():.3f} ms")
    assert np.abs(shifts).max() < 2e-4
    worst = max(
        jaxekf.score(e, r, burn_in_s=2.0).attitude_rmse_deg for e, r in zip(made, runs, strict=True)
    )
    assert worst < 0.1
    assert all(e.clock.name == "imu" for e in made)


def test_instants_are_samples_of_the_imu_to_the_nanosecond(estimates):
    """Rounding that moves the IMU's own stamps, or estimates before its first or after its last sample."""
    _, runs, made = estimates
    for run, one in zip(runs, made, strict=True):
        imu = run.need_imu().time_ns
        inside = imu[(imu >= one.time_ns[0]) & (imu <= one.time_ns[-1])]
        assert np.isin(inside, one.time_ns).all()
        assert imu[0] <= one.time_ns[0] and one.time_ns[-1] <= imu[-1]
        assert (np.diff(one.time_ns) > 0).all()


def test_innovations_have_the_times_of_their_samples(estimates):
    """Innovations left on the tracker's clock while the estimate moves."""
    for (_, late, drift), run, one in zip(*estimates, strict=True):
        record = one.sensors["optical"]
        stamps = run.need_optical().time_ns / 1e9 - 100.0
        taken = 100.0 + (stamps - late) / (1.0 + drift)
        nearest = np.abs(record.time_ns[:, None] / 1e9 - taken).min(axis=1)
        assert nearest.max() < 2e-6 and np.isin(record.time_ns, one.time_ns).all()


def test_tracker_clock_on_request(estimates, tmp_path):
    """An option that does nothing; a score that corrects twice, or not at all, by the saved clock."""
    cases, runs, made = estimates
    seed, late, drift = cases[20]
    other = jaxekf.estimate(
        runs[20], "loose", parameters(late, drift), smooth=True, clock="tracker"
    )
    assert best_shift_s(seed, other) == pytest.approx(-late, abs=2e-4)
    assert other.clock == replace(made[20].clock, name="tracker")
    np.testing.assert_allclose(other.time_ns - made[20].time_ns, late * 1e9, atol=1.0)
    scores = [jaxekf.score(one, runs[20]).attitude_rmse_deg for one in (other, made[20])]
    assert scores[0] == pytest.approx(scores[1], rel=1e-6)
    saved = other.save(tmp_path / "result", exports=("npz", "tum"))
    document = json.loads((saved / "result.json").read_text())
    assert document["clock"]["name"] == "tracker"
    assert document["clock"]["offset_s"] == pytest.approx(-late)
    assert document["estimate_columns"][0]["frame"] == "tracker clock"
    assert "time on the tracker's clock" in (saved / "trajectory.tum").read_text()
    kept = jaxekf.read_export(saved / "estimate.npz")
    assert json.loads(kept["clock"])["name"] == kept["time_ns@clock"] == "tracker"


def test_requested_times_are_on_the_same_clock(estimates):
    """Requested times taken for the tracker's, moved by rounding, or a grid that begins there."""
    cases, runs, made = estimates
    seed, late, drift = cases[-1]
    params, run = parameters(late, drift), runs[-1]
    asked = made[-1].time_ns[[0, 300, 700]] + np.array([0, 3_000_001, 17], np.int64)
    found = jaxekf.estimate(run, "loose", params, smooth=True, at=asked)
    assert found.requested is not None
    np.testing.assert_array_equal(found.requested.time_ns, asked)
    truth = rotation(seed, asked / 1e9 - 100.0)
    off = (to_scipy(found.requested.attitude.value) * truth.inv()).magnitude()
    assert np.rad2deg(off).max() < 0.3
    grid = jaxekf.estimate(run, "loose", params, at=jaxekf.every(0.05)).requested
    assert grid is not None and set(np.diff(grid.time_ns)) == {50_000_000}
    assert grid.time_ns[0] == made[-1].time_ns[0] and grid.time[0] == 0.0


def test_encoder_with_a_latency_of_its_own(estimates):
    """A stated latency of the encoder that scores and figures ignore, or apply to the estimate."""
    _, runs, made = estimates
    encoder = runs[0].need_encoder()
    late = replace(encoder, time_ns=encoder.time_ns + 30_000_000)
    right = jaxekf.score(made[0], runs[0]).attitude_rmse_deg
    wrong = jaxekf.score(made[0], runs[0].replace(encoder=late)).attitude_rmse_deg
    stated = runs[0].replace(encoder=replace(late, latency_ns=30_000_000))
    assert wrong > 5.0 * right
    assert jaxekf.score(made[0], stated).attitude_rmse_deg == pytest.approx(right, rel=1e-9)


def test_encoder_on_the_tracker_clock(estimates):
    """Truth from the tracker's own cameras compared on the IMU's clock, as soon as an offset is known."""
    cases, runs, made = estimates
    late = cases[25][1]
    encoder = runs[25].need_encoder()
    same = runs[25].replace(encoder=replace(encoder, time_ns=encoder.time_ns + ns(late)))
    stated = same.replace(info={"encoder_about": {"clock": "tracker"}})
    right = jaxekf.score(made[25], runs[25]).attitude_rmse_deg
    assert jaxekf.score(made[25], same).attitude_rmse_deg > 5.0 * right
    assert jaxekf.score(made[25], stated).attitude_rmse_deg == pytest.approx(right, rel=1e-6)


def test_models_with_one_clock():
    """A clock named where there are not two, or times moved by an offset of zero."""
    run = planted(0)
    for name in ("loose_rate", "loose"):
        model = jaxekf.get_model(name)
        clock = clock_of(model, model.parameters, "imu")
        assert clock.name == ("recording" if name == "loose_rate" else "imu")
        line = timeline.build(model, run, clock=clock)
        plain = timeline.build(model, run)
        np.testing.assert_array_equal(line.time_ns, plain.time_ns)
        np.testing.assert_array_equal(
            line.on_clock(line.time_ns[line.valid]), line.time_ns[line.valid]
        )
    with pytest.raises(ModelError, match="expected 'imu' or 'tracker'"):
        clock_of(jaxekf.get_model("loose"), loose.DEFAULTS, "encoder")


def test_live_estimates_are_on_the_imu_clock():
    """The present of the input taken for the same reading of the tracker's clock, 0.2 s away."""
    late, run = 0.2, planted(3, 0.2)
    imu, optical = run.need_imu(), run.need_optical()
    model, params = jaxekf.get_model("loose"), parameters(late)
    first = {"optical": optical.q_ref_body[0]}
    belief = jaxekf.initial_belief(model, params, first)
    stream = jaxekf.Stream(model, params, belief, int(optical.time_ns[0]))
    for time, rate in zip(imu.time_ns[:200].tolist(), imu.gyroscope, strict=False):
        stream.put_input(time, rate)
    for time, q in zip(optical.time_ns[:50].tolist(), optical.q_ref_body, strict=False):
        stream.put("optical", time, q)
    known = stream.known()
    assert known.time_ns == imu.time_ns[199]
    truth = rotation(3, np.array([known.time_ns / 1e9 - 100.0]))
    q = np.asarray(known.belief.mean.q_ref_body)
    assert np.rad2deg((to_scipy(q).inv() * truth).magnitude()).max() < 0.5


def test_both_ways():
    """An inverse that drops the drift, beyond the nanosecond of rounding."""
    clock = Clock("imu", -3.5, 500e-6, 7_000_000_000)
    times = np.array([7_000_000_000, 7_000_000_001, 900_000_000_003], np.int64)
    back = clock.tracker_from_imu(clock.imu_from_tracker(times))
    assert np.abs(back - times).max() <= 1


def late_encoder(run, late_s):
    encoder = run.need_encoder()
    return run.replace(encoder=replace(encoder, time_ns=encoder.time_ns + ns(late_s)))


def test_a_late_encoder_is_named(estimates):
    """A score of a wrong clock without a word; the shift's sign, size or deviation wrong."""
    _, runs, made = estimates
    off = []
    for run, one in zip(runs[:10], made[:10], strict=True):
        assert jaxekf.score(one, run, burn_in_s=2.0).sentences() == ()
        found = jaxekf.score(one, late_encoder(run, 0.112), burn_in_s=2.0)
        off.append((found.time_shift_s - 0.112) / found.time_shift_sigma_s)
        (text,) = found.sentences()
        assert "later" in text and "time_shift = -0.11" in text
        assert "align" not in text and found.shifted_rmse_deg < 0.1
    assert np.sqrt(np.mean(np.square(off))) < 2.0


def test_a_tracker_that_disagrees_is_not_the_encoder():
    """The encoder blamed for a tracker whose clock is not the IMU's, although the rate agrees."""
    runs = [planted(seed, 0.06) for seed in range(4)]
    texts = []
    for run, one in zip(runs, jaxekf.estimate_many(runs, "loose", tight_tracker()), strict=True):
        texts += jaxekf.score(one, run, burn_in_s=2.0).sentences()
    assert texts and all("jaxekf align" in text and "time_shift" not in text for text in texts)


def tight_tracker():
    """Parameters of `loose` with a tracker that outweighs the gyroscope."""
    params = parameters()
    noise = params.noise._replace(gyroscope=np.deg2rad(20.0), optical=np.deg2rad(0.2))
    return params._replace(noise=noise)
