"""Clock offset, drift and alignment of a tracker against an IMU: planted ones, and what becomes of them."""

import json
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import pytest
import rotating
from click.testing import CliRunner
from scipy.spatial.transform import Rotation

import jaxekf
from jaxekf._support.errors import ModelError, RecordingError
from jaxekf.calibration import time_offset
from jaxekf.calibration.alignment import align, align_run, calibration_for, combine_runs, poses
from jaxekf.calibration.attitude_alignment import refine, unobservable_axis
from jaxekf.checks.inspection import inspect
from jaxekf.cli import main
from jaxekf.estimation import parameters
from jaxekf.io.importers import broad
from jaxekf.recordings.types import Optical, from_scipy, to_scipy
from jaxekf.simulation import attitude_runs, marker_runs

TURN = np.deg2rad([1.0, -2.0, 0.5])


def late(optical, latency_s=0.0, drift=0.0, turn=(0.0, 0.0, 0.0)):
    """Poses stamped later than taken, by a clock that drifts, of a frame turned in the body."""
    since = optical.time_ns - (optical.time_ns[0] + optical.time_ns[-1]) // 2
    return replace(
        optical,
        time_ns=optical.time_ns + np.round(1e9 * latency_s + drift * since).astype(np.int64),
        q_ref_body=from_scipy(to_scipy(optical.q_ref_body) * Rotation.from_rotvec(turn)),
    )


def planted(seed, duration_s=60.0, motion=None, **wrong):
    """A run with a planted offset, drift and alignment."""
    chosen = motion or attitude_runs.free_motion(seed)
    run = attitude_runs.recording(f"run-{seed}", chosen, seed=seed, duration_s=duration_s)
    return run.replace(optical=late(run.need_optical(), **wrong))


def off_turn(found, turn=TURN):
    """By how much an alignment is off, as a turn in the tracked frame."""
    return (Rotation.from_rotvec(turn).inv() * Rotation.from_rotvec(found.alignment)).as_rotvec()


@pytest.fixture(scope="module")
def aligned():
    """Four runs with the same offset and alignment, aligned."""
    return [align_run(planted(seed, 40.0, latency_s=0.2, turn=TURN)) for seed in range(4)]


def test_offset_and_alignment_are_found(aligned):
    """A sign turned round, half a sample lost, and deviations that say more or less than the error."""
    for run in aligned:
        found = run.tracker
        assert abs(found.latency_s - 0.2) < 1e-3
        assert np.all(np.abs(off_turn(found)) < np.deg2rad(0.12))
        assert abs(found.drift) < 5.0 * found.drift_sigma < 2e-4
        assert found.scatter == pytest.approx(np.deg2rad(0.3), rel=0.05)
        # The encoder's clock and frame are the gyroscope's own.
        assert abs(run.encoder.latency_s) < 5e-4
        assert np.all(np.abs(run.encoder.alignment) < np.deg2rad(0.1))
    late = [(r.tracker.latency_s - 0.2) / r.tracker.latency_sigma_s for r in aligned]
    turned = [
        off_turn(r.tracker) @ np.linalg.inv(r.tracker.alignment_cov) @ off_turn(r.tracker)
        for r in aligned
    ]
    assert 0.3 < np.sqrt(np.mean(np.square(late))) < 1.8
    assert 0.3 < np.sqrt(np.mean(turned) / 3.0) < 1.6


def test_drift_over_ten_minutes():
    """A drift of the wrong sign or scale, or one that is not parted from the offset."""
    found = align(*streams(planted(3, 600.0, latency_s=-0.2, drift=50e-6, turn=TURN)))
    assert abs(found.drift - 50e-6) < 1e-6 < 5e-6
    assert abs(found.latency_s + 0.2) < 2e-4
    assert np.all(np.abs(off_turn(found)) < np.deg2rad(0.05))
    assert abs(found.drift - 50e-6) < 4.0 * found.drift_sigma


def streams(run):
    return poses(run), run.need_imu()


def test_outliers_occlusions_and_gaps_do_not_count():
    """Wrong poses that rule a least-squares fit, and a gyroscope made up in a gap."""
    run = planted(1, 40.0, latency_s=0.034, turn=TURN)
    optical, imu = streams(run)
    q, valid = optical.q_ref_body.copy(), optical.valid.copy()
    q[300:310] = [0.0, 1.0, 0.0, 0.0]
    q[::97] = [1.0, 0.0, 0.0, 0.0]
    valid[900:1100] = False
    kept = np.ones(len(imu.time_ns), bool)
    kept[2500:2600] = False
    gap = replace(imu, time_ns=imu.time_ns[kept], gyroscope=imu.gyroscope[kept])
    found = align(replace(optical, q_ref_body=q, valid=valid), gap)
    assert abs(found.latency_s - 0.034) < 1e-3
    assert np.all(np.abs(off_turn(found)) < np.deg2rad(0.12))


def test_runs_together(aligned):
    """A mean without weights, and a chi-square that calls good runs bad, or bad ones good."""
    mean = combine_runs(aligned)
    assert abs(mean.latency_s - 0.2) < 4.0 * mean.latency_sigma_s < 4e-4
    assert mean.latency_sigma_s < min(run.tracker.latency_sigma_s for run in aligned)
    assert np.all(np.abs(off_turn(mean)) < np.deg2rad(0.04))
    assert mean.latency_p > 0.01 and mean.alignment_p > 0.01 and mean.sentences() == ()
    other = align_run(planted(9, 40.0, latency_s=0.21, turn=1.3 * TURN))
    apart = combine_runs([*aligned, other])
    assert apart.latency_p < 1e-6 and apart.alignment_p < 1e-6
    assert len(apart.sentences()) == 2
    assert apart.latency_sigma_s > 2.0 * mean.latency_sigma_s
    one = combine_runs(aligned[:1])
    assert one.latency_s == pytest.approx(aligned[0].tracker.latency_s, abs=1e-12)
    assert np.isnan(one.latency_p) and one.sentences() == ()


def test_one_axis_leaves_the_turn_about_it_open():
    """A turn about the only axis of rotation, which noise seems to determine, written as a fact; or a tilt
    that is not written, since one of three angles is unobservable."""
    turn = Rotation.from_rotvec(np.deg2rad([6.0, -4.0, 40.0]))
    flat = rotating.run(
        rotating.motion(3, (120.0, 0.0, 0.0)),
        duration_s=30.0,
        mounting_deg=np.rad2deg(turn.as_rotvec()),
    )
    found = align_run(flat)
    axis = unobservable_axis(found.tracker.alignment_cov)
    assert abs(axis @ [0.0, 0.0, 1.0]) > 0.9999
    tilt = Rotation.from_rotvec(found.tracker.alignment)
    assert abs(found.tracker.alignment @ axis) < 1e-9
    off = np.rad2deg(np.linalg.norm(tilt.apply([0, 0, 1]) - turn.apply([0, 0, 1])))
    sigma = np.rad2deg(np.sqrt(np.linalg.eigvalsh(found.tracker.alignment_cov)[1]))
    assert off < 4.0 * sigma < 0.2
    model = jaxekf.get_model("loose_pose")
    params, sentences = calibration_for(model, combine_runs([found]))
    np.testing.assert_allclose(params.calibration.alignment, found.tracker.alignment)
    assert "unobservable" in sentences[0]
    seen = inspect(flat)
    assert "unobservable" in " ".join(seen.notes) and "left out" in " ".join(seen.warnings)


def test_runs_about_two_axes_determine_the_alignment_together():
    """Runs of one axis each, whose open turns are averaged as if they were known."""
    turn = [6.0, -4.0, 40.0]
    made = [
        align_run(
            rotating.run(rotating.motion(3, about), duration_s=30.0, mounting_deg=turn, seed=k)
        )
        for k, about in enumerate([(120.0, 0.0, 0.0), (0.0, 120.0, 0.0)])
    ]
    assert all(unobservable_axis(one.tracker.alignment_cov) is not None for one in made)
    both = combine_runs(made)
    assert unobservable_axis(both.alignment_cov) is None
    np.testing.assert_allclose(np.rad2deg(both.alignment), turn, atol=0.15)
    assert both.alignment_p > 1e-3 and both.alignment_freedom == 1


@pytest.mark.parametrize("second_deg", [0.3, 3.0])
def test_nearly_one_axis_has_large_deviations(second_deg):
    """A small deviation made of noise, where a little rotation about a second axis determines the turn."""
    scaled = []
    for seed in range(3):
        attitude = rotating.motion(seed, (120.0, second_deg, second_deg))
        made = rotating.run(attitude, duration_s=30.0, mounting_deg=(10, -5, 40), seed=seed)
        found = align(made.optical, made.imu)
        off = off_turn(found, np.deg2rad([10, -5, 40]))
        sigma = np.sqrt(found.alignment_cov[2, 2])
        assert unobservable_axis(found.alignment_cov) is None
        assert 0.03 / second_deg < np.rad2deg(sigma) < 3.0 / second_deg
        scaled.append(off[2] / sigma)
    assert np.max(np.abs(scaled)) < 3.5


def test_a_bad_run_is_left_out_and_named(tmp_path):
    """One bad run that refuses the result of the others, or that is missing from it without a word."""
    good = [jaxekf.save(planted(seed, 20.0), tmp_path / f"run-{seed}") for seed in (0, 1)]
    other = planted(2, 20.0).replace(optical=planted(3, 20.0).optical, encoder=None)
    bad = jaxekf.save(other, tmp_path / "bad")
    arguments = ["align", good[0], bad, good[1], "-o", tmp_path / "out"]
    done = CliRunner().invoke(main, [str(a) for a in arguments])
    assert done.exit_code == 3, done.output
    assert "Left out: " in done.stderr and "bad" in done.stderr
    document = json.loads((tmp_path / "out" / "align.json").read_text())
    assert [one["run"] for one in document["runs"]] == ["run-0", "run-1"]
    assert list(document["failed"]) == [str(bad)]
    alone = CliRunner().invoke(main, ["align", str(bad), "-o", str(tmp_path / "none")])
    assert alone.exit_code == 1 and not (tmp_path / "none").exists()


def test_what_does_not_belong_together_is_refused():
    """An offset made up for streams of two bodies, or for a clock that steps."""
    optical, imu = streams(planted(1, 40.0))
    _, other = streams(planted(2, 40.0))
    with pytest.raises(RecordingError):
        align(optical, other)
    start = time_offset.match(optical, imu)
    second = (np.arange(len(optical.time_ns)) > 1000) * 10**9
    jumped = replace(optical, time_ns=optical.time_ns + second)
    with pytest.raises(RecordingError, match="clocks that do not jump"):
        refine(jumped, imu, start)
    with pytest.raises(ModelError, match="no clock to calibrate"):
        calibration_for(jaxekf.get_model("loose_rate"), combine_runs([align_run(planted(1, 40.0))]))


def test_real_lag_of_the_gyroscope(data_dir):
    """BROAD's gyroscope lags by 3.5 to 5 ms in every trial: from the motion capture, and from a tracker of
    0.3 deg made of it, to a few tenths of a millisecond."""
    run = broad.load(broad.find(data_dir / "broad", "07"))
    truth = run.need_encoder()
    exact = align(Optical(truth.time_ns, truth.q_ref_body, truth.valid), run.need_imu())
    rough = align(broad.degrade(run, seed=0, trial=7).need_optical(), run.need_imu())
    for found in (exact, rough):
        assert -0.005 < found.latency_s < -0.0035
        assert found.latency_sigma_s < 5e-4
    assert abs(rough.latency_s - exact.latency_s) < 4.0 * rough.latency_sigma_s


TRACKERS_CLOCK = {"encoder_about": {"clock": "tracker"}}
"""Truth from the tracker itself, such as by its other cameras."""


def tool_run(seed, turn):
    """A tool whose tracker reports whole poses, of a frame turned in the body, later than it says."""
    motion = marker_runs.free_tool_motion(seed)
    run = marker_runs.tool_recording("tool", motion, seed=seed, duration_s=20.0)
    optical = late(poses(run), latency_s=0.06, turn=turn)
    encoder = late(run.need_encoder(), 0.06)
    return run.replace(
        optical=optical, markers=None, encoder=encoder, info={**run.info, **TRACKERS_CLOCK}
    )


def turning_run(seed, turn):
    """Attitudes and truth of a frame that is turned in the body and lies on the tracker's clock."""
    run = planted(seed, 20.0, latency_s=0.06, turn=turn)
    encoder = late(run.need_encoder(), 0.06, turn=turn)
    return run.replace(encoder=encoder, info={**run.info, **TRACKERS_CLOCK})


@pytest.mark.parametrize(("name", "make"), [("loose", turning_run), ("loose_pose", tool_run)])
def test_estimates_get_better_with_what_was_written(name, make, tmp_path):
    """A sign, or a frame, that differs between what is found and what a model takes: errors would grow."""
    model = jaxekf.get_model(name)
    # A model without an alignment is judged by its clock alone.
    turn = TURN if hasattr(model.parameters.calibration, "alignment") else 0.0 * TURN
    run = make(1, turn)
    jaxekf.save(run, tmp_path / "run")
    arguments = ("align", tmp_path / "run", "--model", name, "-o", tmp_path / "out", "--json")
    result = CliRunner().invoke(main, [str(a) for a in arguments])
    assert result.exit_code == 0, result.output
    found = json.loads(result.stdout)["runs"][0]["tracker"]
    assert found["latency_s"] == pytest.approx(0.06, abs=1e-3)
    told = parameters.load(model, tmp_path / "out")
    errors = [
        jaxekf.score(jaxekf.estimate(run, model=model, params=params), run).attitude_rmse_deg
        for params in (parameters.as_arrays(model.parameters), told)
    ]
    assert errors[1] < 0.25 and errors[1] < 0.5 * errors[0], errors
    assert not (tmp_path / "out" / "noise.toml").exists()


def test_command_prints_and_replaces(tmp_path):
    """A table that hides a stream, an output that is replaced unasked, and a library's traceback."""
    for seed in (0, 1):
        jaxekf.save(planted(seed, 20.0, latency_s=-0.05), tmp_path / f"run-{seed}")

    def call(*more):
        arguments = ["align", tmp_path / "run-0", tmp_path / "run-1", "-o", tmp_path / "out", *more]
        return CliRunner().invoke(main, [str(a) for a in arguments])

    first = call()
    assert first.exit_code == 0, first.output
    for text in ("tracker", "encoder", "mean", "-50.", "Do the runs agree?"):
        assert text in first.output
    again = call()
    assert again.exit_code == 1 and "exists" in again.output
    assert call("--overwrite").exit_code == 0
    document = json.loads((tmp_path / "out" / "align.json").read_text())
    assert document["together"]["latency_s"] == pytest.approx(-0.05, abs=1e-3)
    refused = call("--overwrite", "--model", "loose_rate")
    assert refused.exit_code == 1 and "no clock to calibrate" in refused.output
    assert (tmp_path / "out" / "calibration.toml").is_file()


class Drifting(NamedTuple):
    """Calibration of a model whose clock may drift."""

    clock_offset: float
    clock_drift: float


def test_drift_for_a_model_that_has_one():
    """The offset of a run's middle beside a drift that counts from its start; a drift made of noise."""
    loose = jaxekf.get_model("loose")
    able = loose.parameters._replace(calibration=Drifting(0.0, 0.0))
    model = replace(loose, parameters=able)
    run = align_run(planted(3, 60.0, latency_s=0.2, drift=100e-6))
    assert "drifts against the IMU's by" in run.notes[0]
    told = calibration_for(model, combine_runs([run]))[0].calibration
    assert told.clock_drift == pytest.approx(-100e-6, abs=25e-6)
    assert told.clock_offset == pytest.approx(-(0.2 - 30.0 * 100e-6), abs=1e-3)
    assert told.clock_offset == pytest.approx(-0.2 - 30.0 * told.clock_drift, abs=5e-4)
    steady = align_run(planted(3, 60.0, latency_s=0.2))
    told = calibration_for(model, combine_runs([steady]))[0].calibration
    assert told.clock_drift == 0.0
    assert told.clock_offset == pytest.approx(-steady.tracker.latency_s, abs=1e-12)
