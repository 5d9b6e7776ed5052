"""What speaks against an estimate: statistics against oracles, and planted faults called by their names."""

import json
import os
from dataclasses import replace

import numpy as np
import pytest
from click.testing import CliRunner
from scipy.stats import chi2, kstest

import jaxekf
from jaxekf._support.constants import GRAVITY_REF
from jaxekf.cli import main
from jaxekf.evaluation import _fault_signatures as fault_signatures
from jaxekf.evaluation import consistency
from jaxekf.io import run_folder
from jaxekf.recordings.types import Imu, Recording
from jaxekf.simulation import attitude_runs, demo, gyro_free_runs, marker_runs

GRADES = {
    "ordinary": attitude_runs.SensorGrade(),
    "poor gyroscope": attitude_runs.SensorGrade(
        gyroscope_deg=0.2, bias_walk_deg=0.1, optical_deg=0.3
    ),
}
MODEL = jaxekf.get_model("loose")
LATE_NS = 20_000_000
SEEDS = 50 if os.environ.get("JAXEKF_LONG") else 4


def matched(grade, **changed):
    """Parameters of `loose` that say what the simulator does, but for what is changed."""
    noise = MODEL.parameters.noise._replace(
        gyroscope=np.deg2rad(grade.gyroscope_deg),
        bias_walk=np.deg2rad(grade.bias_walk_deg),
        optical=np.deg2rad(grade.optical_deg),
    )
    return MODEL.parameters._replace(noise=noise._replace(**changed))


def runs(grade, seeds, seconds=60.0):
    return [
        attitude_runs.recording(
            f"run-{i}", attitude_runs.free_motion(i), seed=i, duration_s=seconds, grade=grade
        )
        for i in seeds
    ]


def late(recording):
    optical = recording.need_optical()
    return recording.replace(optical=replace(optical, time_ns=optical.time_ns + LATE_NS))


def planted(fault, grade, records):
    """Recordings and parameters with a fault."""
    params = matched(grade)
    if fault == "latency":
        return [late(r) for r in records], params
    if fault == "noise_too_small":
        return records, matched(grade, optical=np.deg2rad(grade.optical_deg) / np.sqrt(3.0))
    if fault == "gyroscope_bias":
        held = matched(grade, bias_walk=1e-9)
        return records, held._replace(initial=held.initial._replace(bias=1e-8))
    return records, params


def kinds(diagnosis, about="optical"):
    return [verdict.kind for verdict in diagnosis.verdicts if verdict.about == about]


@pytest.mark.long
@pytest.mark.parametrize("grade", GRADES)
@pytest.mark.parametrize("fault", ["noise_too_small", "latency", "gyroscope_bias"])
def test_planted_faults_are_named(fault, grade):
    """Would catch a fault that is overlooked, called by another's name, or given a wrong size (row 7:
    in at least 48 of 50 seeds)."""
    records, params = planted(fault, GRADES[grade], runs(GRADES[grade], range(SEEDS)))
    found = [jaxekf.diagnose(made) for made in jaxekf.estimate_many(records, MODEL, params)]
    named = 0
    for diagnosis in found:
        right = [v for v in diagnosis.verdicts if (v.kind, v.about) == (fault, "optical")]
        named += len(right) == 1 and len(diagnosis.verdicts) == 1
        if fault == "noise_too_small":
            assert all(v.factor == pytest.approx(np.sqrt(3.0), rel=0.05) for v in right)
        if fault == "latency":
            assert all(v.size == pytest.approx(1e-9 * LATE_NS, rel=0.05) for v in right)
            assert all("ms later" in v.sentence for v in right)
    assert named >= 0.96 * SEEDS, [kinds(diagnosis) for diagnosis in found]


@pytest.mark.long
@pytest.mark.parametrize("grade", GRADES)
def test_clean_runs_raise_no_alarm(grade):
    """Would catch verdicts on what is only chance, with truth and without (row 7: at most 2 of 50)."""
    records = runs(GRADES[grade], range(SEEDS))
    estimates = jaxekf.estimate_many(records, MODEL, matched(GRADES[grade]))
    found = [jaxekf.diagnose(*pair) for pair in zip(estimates, records, strict=True)]
    alarms = [diagnosis.sentences() for diagnosis in found if diagnosis.verdicts]
    assert len(alarms) <= 0.04 * SEEDS, alarms
    for diagnosis in found:
        assert "no inconsistency found" in diagnosis.sentences()[0]
        assert diagnosis.sensors["optical"].nis.mean == pytest.approx(1.0, abs=0.06)
        assert diagnosis.sensors["optical"].nis.inside == pytest.approx(0.95, abs=0.02)


@pytest.fixture(scope="module")
def pair():
    """Two clean runs, short."""
    return runs(GRADES["ordinary"], (1, 2), 30.0)


def test_signatures_are_derivatives_of_the_innovations(pair):
    """Would catch a wrong sign, frame or gain: the innovations of the same run with a small fault differ
    by the fault's signature."""
    record, params = pair[0], matched(GRADES["ordinary"])
    optical, imu = record.need_optical(), record.need_imu()
    step = 1e-4
    pushed = imu.gyroscope + step * np.array([1.0, 0.0, 0.0])
    shifted = [
        record.replace(imu=replace(imu, gyroscope=pushed)),
        record.replace(imu=replace(imu, gyroscope=imu.gyroscope * (1.0 - step * np.eye(3)[1]))),
    ]
    base, *others = jaxekf.estimate_many([record, *shifted], MODEL, params)
    made = base.sensors["optical"]
    gain = fault_signatures._gains(base, "optical", slice(0, 3), made.cov, made.used.all(axis=1))
    each = fault_signatures._signatures(base, made.time_ns, *gain)
    for other, column in zip(others, (1, 4 + 4), strict=True):
        change = (other.sensors["optical"].residual - made.residual) / step
        expected = each[:, :, column]
        assert np.abs(change - expected)[1:].max() < 0.02 * np.abs(expected).max()
    # A clock offset of the whole tracker: the truth is later samples, so compare sizes by the fit.
    moved = replace(optical, time_ns=optical.time_ns - LATE_NS // 4)
    found = fault_signatures.find_faults(
        jaxekf.estimate(record.replace(optical=moved), MODEL, params), "optical"
    )
    assert found is not None
    assert found.size[0] == pytest.approx(-0.25e-9 * LATE_NS, abs=4 * found.sigma(slice(0, 1))[0])


@pytest.mark.parametrize(
    ("fault", "change"),
    [
        ("noise_too_large", lambda p: p._replace(noise=p.noise._replace(optical=np.deg2rad(0.6)))),
        ("correlated", lambda p: p._replace(noise=p.noise._replace(gyroscope=np.deg2rad(0.01)))),
        (
            "gyroscope_matrix",
            lambda p: p._replace(
                calibration=p.calibration._replace(gyroscope_matrix=np.diag([1.03, 1.0, 1.0]))
            ),
        ),
    ],
)
def test_other_faults_are_told_apart(pair, fault, change):
    """Would catch too little process noise taken for too little sensor noise, and the like."""
    made = jaxekf.estimate_many(pair, MODEL, change(matched(GRADES["ordinary"])))
    assert kinds(jaxekf.diagnose_many(made)) == [fault]


def test_outliers_are_not_taken_for_noise(pair):
    """Would catch the advice to raise the noise where single samples are to be gated."""
    optical = pair[0].need_optical()
    q = optical.q_ref_body.copy()
    at = np.random.default_rng(0).uniform(size=len(q)) < 0.02
    q[at] = attitude_runs.from_scipy(
        attitude_runs.Rotation.from_quat(np.roll(q[at], -1, axis=1))
        * attitude_runs.Rotation.from_rotvec(np.full((at.sum(), 3), np.deg2rad(3.0)))
    )
    spoilt = pair[0].replace(optical=replace(optical, q_ref_body=q))
    made = jaxekf.estimate(spoilt, MODEL, matched(GRADES["ordinary"]))
    assert kinds(jaxekf.diagnose(made)) == ["outliers"]


def test_smoothed_runs_and_gaps(pair):
    """Would catch smoothed covariances taken for the filter's, or gaps that look like latency."""
    grade = GRADES["ordinary"]
    gaps = attitude_runs.recording(
        "gaps",
        attitude_runs.free_motion(5),
        seed=5,
        duration_s=30.0,
        grade=grade,
        occlusions=[(8.0, 10.0)],
        dropouts=0.2,
    )
    records = [late(pair[0]), gaps]
    first, second = jaxekf.estimate_many(records, MODEL, matched(grade), smooth=True)
    assert kinds(jaxekf.diagnose(first)) == ["latency"]
    diagnosis = jaxekf.diagnose(second, gaps)
    assert not diagnosis.verdicts
    assert [fault.kind for fault in diagnosis.sensors["optical"].faults] == ["latency"]


def test_pooled_runs_find_what_one_hides(pair):
    """Would catch pooling that takes the mean of verdicts instead of the evidence together."""
    made = jaxekf.estimate_many(pair, MODEL, matched(GRADES["ordinary"]))
    alone = [jaxekf.diagnose(one).sensors["optical"] for one in made]
    both = jaxekf.diagnose_many(made, pair)
    pooled = both.sensors["optical"]
    assert both.runs == ("run-1", "run-2")
    assert pooled.nis.samples == sum(one.nis.samples for one in alone)
    assert np.diff(pooled.nis.interval) < np.diff(alone[0].nis.interval)
    assert pooled.faults[0].sigma[0] < min(one.faults[0].sigma[0] for one in alone)
    assert set(both.parts) == {"attitude", "rate"}
    with pytest.raises(ValueError, match="same order"):
        jaxekf.diagnose_many(made, pair[::-1])
    with pytest.raises(ValueError, match="no estimates"):
        jaxekf.diagnose_many([])


def test_few_samples_give_no_verdict():
    """Would catch certainty from a fraction of a second, and silence about it."""
    grade = GRADES["ordinary"]
    record = runs(grade, (3,), 0.6)[0]
    small = matched(grade, optical=np.deg2rad(0.05))
    diagnosis = jaxekf.diagnose(jaxekf.estimate(record, MODEL, small))
    assert not diagnosis.verdicts
    assert any("too few to judge" in note for note in diagnosis.notes)


def surgery(seconds):
    """A hand that never rests, with gyroscope, accelerometer and magnetometer; it lies on its side."""
    array, motion = gyro_free_runs.handheld_array(), gyro_free_runs.surgical_motion(1)
    made = gyro_free_runs.array_run(motion, array, seed=1, duration_s=seconds)
    force = gyro_free_runs.mean_force(array, made.readings)
    imu = Imu(made.time_ns, made.rate[:, [1, 2, 0]], force[:, [1, 2, 0]], made.field[:, [1, 2, 0]])
    world = {"gravity_ref": list(GRAVITY_REF), "field_ref": [1.0, 0.0, 0.0]}
    return Recording("hand", None, imu, None, world)


@pytest.mark.parametrize("name", ["marg", "triad"])
def test_runs_without_a_tracker_can_be_judged(name, recwarn):
    """Would catch a sensor that has not one sample, such as rest in a run that never rests, and a gain of
    noise that turns with the body worked out as if it did not, which ran away until it overflowed."""
    run = surgery(6.0)
    made = jaxekf.estimate(run, name)
    diagnosis = jaxekf.diagnose(made, run)
    assert set(diagnosis.sensors) == set(made.sensors)
    assert name == "triad" or diagnosis.sensors["rest"].nis.samples == 0
    json.dumps(diagnosis.as_dict())
    assert not [w.message for w in recwarn if issubclass(w.category, RuntimeWarning)]


@pytest.mark.parametrize("name", ["tight", "loose_pose", "loose_rate", "loose_additive"])
def test_every_model_can_be_judged(name):
    """Would catch statistics that only suit `loose`: markers, poses, several sensors, quaternions, and a
    sensor that is never seen."""
    if name in ("tight", "loose_pose"):
        hidden = [("1", 0.0, 9.0)] if name == "loose_pose" else [("1", 2.0, 9.0)]
        motion = marker_runs.sinusoidal_motion()
        hidden = [] if name == "loose_pose" else hidden
        run = marker_runs.tool_recording("run", motion, seed=3, duration_s=6.0, hidden=hidden)
    else:
        run = jaxekf.load(demo.FOLDER / "constant-rate")
    made = jaxekf.estimate(run, name)
    diagnosis = jaxekf.diagnose(made, run)
    assert set(diagnosis.sensors) == set(made.sensors)
    assert diagnosis.sentences()
    json.dumps(diagnosis.as_dict(), allow_nan=False)
    for sensor, found in diagnosis.sensors.items():
        assert found.nis.mean == pytest.approx(made.mean_nis(sensor))
        assert found.whiteness.autocorrelation.shape == (
            made.model.sensor(sensor).rows,
            len(found.whiteness.lag_s),
        )


def test_consistency_equals_scipy():
    """Would catch a wrong band, distance or interval: honest squares against SciPy's own numbers."""
    rng = np.random.default_rng(1)
    squares = rng.chisquare(3, 4000)
    found = consistency.judge_squares([squares], [np.full(4000, 3)])
    law = chi2(3)
    assert found.ks == pytest.approx(kstest(squares, law.cdf).statistic, abs=1e-12)
    assert found.band == pytest.approx(law.interval(0.95))
    low, high = law.interval(0.95)
    assert found.inside == pytest.approx(np.mean((squares > low) & (squares < high)))
    assert found.interval[0] < 1.0 < found.interval[1]
    assert found.effective == pytest.approx(4000, rel=0.1)
    assert found.ks_p > 0.01
    large = consistency.judge_squares([4.0 * squares], [np.full(4000, 3)])
    assert large.factor == pytest.approx(2.0, rel=0.05)
    assert large.ks_p < 1e-6


def autoregressive(rng, count, phi, rows=3):
    noise = rng.standard_normal((count, rows)) * np.sqrt(1.0 - phi**2)
    noise[0] = rng.standard_normal(rows)
    for k in range(1, count):
        noise[k] += phi * noise[k - 1]
    return noise


def test_intervals_hold_for_correlated_squares():
    """Would catch an interval that takes correlated samples for independent ones."""
    rng = np.random.default_rng(2)
    outside = 0
    for _ in range(60):
        squares = np.sum(autoregressive(rng, 3000, 0.95) ** 2, axis=1)
        found = consistency.judge_squares([squares], [np.full(3000, 3)])
        outside += not found.interval[0] <= 1.0 <= found.interval[1]
        # Squares of a process with autocorrelation phi^l have phi^(2l).
        assert found.effective < 600
    assert outside <= 2


def test_autocorrelation_equals_numpy_with_gaps():
    """Would catch lags that are counted across gaps, or a transform that wraps around."""
    rng = np.random.default_rng(3)
    values = autoregressive(rng, 400, 0.5, 2)
    values[rng.uniform(size=values.shape) < 0.1] = np.nan
    rho, pairs = consistency.autocorrelation([values], 20)
    for row in range(2):
        x = values[:, row]
        products = [x[: len(x) - lag] * x[lag:] for lag in range(21)]
        expected = np.array([np.nanmean(p) for p in products])
        np.testing.assert_allclose(rho[row], expected / expected[0], atol=1e-12)
        assert pairs[row].tolist() == [np.isfinite(p).sum() for p in products]
    time_ns = np.delete(np.arange(10, dtype=np.int64) * 16_000_000 + 7, [3, 4])
    grid = consistency.on_grid(time_ns, np.arange(8.0)[:, None])
    assert np.flatnonzero(np.isnan(grid[:, 0])).tolist() == [3, 4]


def test_whiteness_tells_how_long():
    """Would catch a correlation time in samples, or a test that calls white correlated."""
    rng = np.random.default_rng(4)
    time_ns = np.arange(6000, dtype=np.int64) * 16_000_000
    white = consistency.judge_whiteness([time_ns], [rng.standard_normal((6000, 3))])
    assert white.correlated_s == 0.0
    assert white.p > 1e-3
    assert np.mean(np.abs(white.autocorrelation) > white.bound) < 0.08
    phi = np.exp(-0.016 / 0.2)
    found = consistency.judge_whiteness([time_ns], [autoregressive(rng, 6000, phi)])
    assert found.correlated_s == pytest.approx(0.2, rel=0.3)
    assert found.p < 1e-12


def test_whitening_uses_the_visible_rows_alone():
    """Would catch the covariance of hidden rows mixed into those that were used."""
    rng = np.random.default_rng(5)
    factor = rng.standard_normal((3, 3))
    cov = np.tile(factor @ factor.T + np.eye(3), (4, 1, 1))
    residual = rng.standard_normal((4, 3))
    used = np.array([[1, 1, 1], [1, 0, 1], [0, 0, 0], [0, 1, 1]], bool)
    found = consistency.whiten(residual, cov, used)
    assert np.array_equal(np.isfinite(found), used)
    for k in range(4):
        rows = np.flatnonzero(used[k])
        e, s = residual[k, rows], cov[k][np.ix_(rows, rows)]
        assert np.nansum(found[k] ** 2) == pytest.approx(e @ np.linalg.solve(s, e) if len(e) else 0)


def test_estimate_says_so_on_the_command_line(tmp_path):
    """Would catch verdicts that only Python sees."""
    run = late(jaxekf.load(demo.FOLDER / "free-5"))
    run_folder.save(run, tmp_path / "free-5")
    result = CliRunner().invoke(
        main, ["estimate", str(tmp_path / "free-5"), "-o", str(tmp_path / "out"), "--json"]
    )
    assert result.exit_code == 0, result.output
    assert "ms later than it was taken" in result.stderr
    verdicts = json.loads(result.stdout)["runs"][0]["diagnosis"]["verdicts"]
    assert verdicts[0]["kind"] == "latency"
    assert verdicts[0]["size"] == pytest.approx(0.02, rel=0.05)
