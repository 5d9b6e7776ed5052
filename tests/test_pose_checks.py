"""Poses and gyroscopes that contradict each other: flipped poses, moved trackers, another body's IMU,
frozen and mirrored gyroscopes, held values. Each blame has a rival beside it that must not get it."""

import re
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from sensor_runs import ns, pair, with_stream, wxyz

import jaxekf
from jaxekf.checks._held_values import held_findings
from jaxekf.checks._pose_findings import pose_findings
from jaxekf.checks._rotation_match import rotation_findings
from jaxekf.checks.inspection import SENSOR_CHECKS, inspect
from jaxekf.checks.plausibility import evidence
from jaxekf.checks.pose_flips import find_flips
from jaxekf.io import run_folder
from jaxekf.recordings.types import to_scipy

KINDS = (
    {},
    {"imu_hz": 500.0, "tracker_hz": 120.0},
    {"imu_hz": 100.0, "tracker_hz": 20.0, "noise_deg": 0.5},
    {"spin_deg_s": 400.0},
)


def flipped(time_ns, q, rotvec, stretches, share=0.01, seed=0):
    """Attitudes rotated in stretches (begin, length in s) and in single samples, and which they are."""
    t = time_ns / 1e9
    bad = (np.random.default_rng(seed).uniform(size=len(t)) < share) & (t > 1.0)
    for begin, lasts in stretches:
        bad |= (t >= begin) & (t < begin + lasts)
    turned = wxyz(to_scipy(q) * Rotation.from_rotvec(rotvec))
    return np.where(bad[:, None], turned, q), bad


def with_flips(run, rotvec=(0.0, 0.0, np.pi), stretches=((5.0, 0.25), (12.0, 1.2)), **options):
    q, bad = flipped(run.optical.time_ns, run.optical.q_ref_body, rotvec, stretches, **options)
    return with_stream(run, "optical", q_ref_body=q), bad


def found(check, run):
    return check(run, evidence(run))


@pytest.mark.parametrize("kind", range(len(KINDS)))
@pytest.mark.parametrize("angle", [40.0, 90.0, 180.0])
def test_every_flipped_pose_is_found(kind, angle):
    """Would catch a pose that is missed, or a good one that is blamed, at other rates and angles."""
    run, _ = pair(kind, **KINDS[kind])
    axis = np.random.default_rng(kind).normal(size=3)
    bad, truth = with_flips(run, np.deg2rad(angle) * axis / np.linalg.norm(axis))
    stream = bad.optical
    flips = find_flips(stream.time_ns, stream.q_ref_body, bad.imu)
    np.testing.assert_array_equal(flips.wrong, truth)
    assert flips.fixed and abs(np.rad2deg(flips.angle) - angle) < 2.0 and not flips.steps
    good = find_flips(stream.time_ns, run.optical.q_ref_body, run.imu)
    assert not good.wrong.any() and not good.steps


def test_clocks_and_frames_are_found_beside_flips():
    """Would catch flipped poses that keep check and align from clock and frame of the others."""
    bad, truth = with_flips(pair(1)[0])
    made = inspect(bad).alignment
    assert made is not None and abs(made.tracker.latency_s) < 1e-3
    assert np.rad2deg(np.linalg.norm(made.tracker.alignment)) < 0.2
    assert f"{truth.sum()} flipped poses are left out" in made.notes


def test_flips_are_a_warning_of_check():
    """Would catch flips that check passes over, or their share and time left out."""
    bad, truth = with_flips(pair(1)[0])
    text = next(t for t in inspect(bad).warnings if "contradicts" in t)
    first = bad.optical.time_ns[np.argmax(truth)] / 1e9
    assert f"{truth.sum()} of 1800 poses" in text and f"the first at {first:.3f} s" in text
    assert "by the same 180 deg" in text and "swapped markers" in text


@pytest.mark.parametrize(
    ("stretches", "count"), [([(5.0, 14.0)], 1), ([(0.0, 3.0)], 1), ([(8.0, 1.0), (28.0, 3.0)], 2)]
)
def test_long_flips_and_flips_at_the_ends(stretches, count):
    """Would catch flips of nearly half of a run that hide the frame between tracker and IMU, or blame the
    gyroscope's axes, and flips at the ends of a run passed over."""
    bad, truth = with_flips(pair(2)[0], stretches=stretches, share=0.0)
    assert found(rotation_findings, bad) == ((), ())
    (text,) = found(pose_findings, bad).warnings
    number = int(re.search(r"contradicts (\d+) of", text)[1])
    assert abs(number - truth.sum()) < 3 and f"in {count} stretch" in text and "same 180" in text


def test_every_other_pose_wrong_leaves_the_cause_open():
    """Would catch the blame on another body's IMU where it is the poses that jump."""
    run, _ = pair(3)
    q, turn = run.optical.q_ref_body, Rotation.from_rotvec([0.0, 0.0, np.pi])
    q = np.where(np.arange(len(q))[:, None] % 2 == 0, q, wxyz(to_scipy(q) * turn))
    (text,) = found(rotation_findings, with_stream(run, "optical", q_ref_body=q)).warnings
    assert text.startswith("100 % of the tracker's turns") and "swapped markers" in text


def test_outliers_are_not_called_swapped_markers():
    """Would catch the wrong cause for poses that are wrong by another rotation each."""
    run, _ = pair(2)
    q = run.optical.q_ref_body.copy()
    at = np.arange(100, 1700, 40)
    turns = Rotation.random(len(at), random_state=1)
    q[at] = wxyz(to_scipy(q[at]) * turns)
    bad = with_stream(run, "optical", q_ref_body=q)
    (text,) = found(pose_findings, bad).warnings
    assert "outliers" in text and "swapped" not in text


def test_other_faults_are_no_flips():
    """Would catch a clock offset, a wrong scale or fast motion called flipped poses."""
    run, _ = pair(3)
    late = with_stream(run, "optical", time_ns=run.optical.time_ns + ns(0.3))
    scaled = with_stream(run, "imu", gyroscope=1.4 * run.imu.gyroscope)
    far = with_stream(run, "optical", time_ns=run.optical.time_ns + ns(3.5))
    quick, _ = pair(4, spin_deg_s=1500.0)
    for one in (late, scaled, far, quick):
        assert found(pose_findings, one) == ((), ())


def test_a_moved_tracker_is_a_step_that_stays():
    """Would catch a reference that moved called a flip, or half of the run called wrong."""
    run, _ = pair(5)
    moved = wxyz(Rotation.from_rotvec([0.3, 0.2, -0.4]) * to_scipy(run.optical.q_ref_body))
    after = run.optical.time_ns > ns(20.0)
    q = np.where(after[:, None], moved, run.optical.q_ref_body)
    (text,) = found(pose_findings, with_stream(run, "optical", q_ref_body=q)).warnings
    first = run.optical.time_ns[np.argmax(after)] / 1e9
    assert re.search(rf"steps by 3[01]\.\d deg at {first:.3f} s and does not return", text)


def test_truth_that_flips_or_freezes_is_not_scored(tmp_path):
    """Would catch a score against an encoder that is wrong for a part of the run."""
    run, _ = pair(6)
    truth = run.encoder
    q, flips = flipped(truth.time_ns, truth.q_ref_body, (np.pi, 0.0, 0.0), [(8.0, 1.0)], share=0.0)
    still = (truth.time_ns > ns(15.0)) & (truth.time_ns <= ns(17.0))
    q[still] = q[np.argmax(still) - 1]
    path = run_folder.save(with_stream(run, "encoder", q_ref_body=q), tmp_path / "run")
    read = jaxekf.load(path)
    np.testing.assert_array_equal(read.encoder.scored, ~(flips | still))
    masked = read.intake["encoder"].masked
    assert masked["flipped against the gyroscope"].count == flips.sum()
    assert masked["frozen while the IMU moves"].count == still.sum()
    bad = with_stream(run, "encoder", q_ref_body=q)
    stored = jaxekf.load(run_folder.save(bad, tmp_path / "run.h5"))
    np.testing.assert_array_equal(stored.encoder.scored, read.encoder.scored)
    # A body at rest at first, and turning at one rate then: its encoder repeats, too.
    spun, _ = pair(6, duration_s=40.0, amplitude_deg=(0.0, 0.0, 0.0), bursts=[(10.0, 90.0)])
    for number, good in enumerate((run, spun)):
        assert jaxekf.load(run_folder.save(good, tmp_path / f"{number}")).encoder.scored.all()
    for path in jaxekf.demo.paths(jaxekf.demo.TRAINING):
        assert jaxekf.load(path).encoder.scored.all()


@pytest.mark.parametrize("seed", range(10))
def test_a_gyroscope_that_is_not_the_tools_is_named(seed):
    """Would catch another body's IMU, a frozen one, and mirrored or exchanged axes called usable."""
    run, _ = pair(seed)
    assert found(rotation_findings, run) == ((), ())
    rate = run.imu.gyroscope
    other = with_stream(run, "imu", gyroscope=pair(seed + 50)[0].imu.gyroscope)
    assert "another body" in found(rotation_findings, other).warnings[0]
    for bad in (rate * [1.0, 1.0, -1.0], rate[:, [1, 0, 2]], -rate):
        text = found(rotation_findings, with_stream(run, "imu", gyroscope=bad)).warnings[0]
        assert text.startswith("with one axis mirrored the gyroscope explains")
    frozen = rate.copy()
    frozen[3000:3600] = frozen[3000]
    text = found(rotation_findings, with_stream(run, "imu", gyroscope=frozen)).warnings[0]
    assert "frozen for 3.00 s in 1 stretch, first at 15.000 s" in text
    constant = with_stream(run, "imu", gyroscope=np.tile(rate[:1], (len(rate), 1)))
    assert "all its samples are the same" in found(rotation_findings, constant).warnings[0]


@pytest.mark.parametrize("seed", range(8))
def test_good_pairs_raise_no_alarm(seed):
    """Would catch a check that cries wolf: at other rates, mountings, spins and sizes of motion."""
    for options in (*KINDS, {"amplitude_deg": (5.0, 3.0, 5.0)}, {"duration_s": 12.0}):
        run, _ = pair(seed, **options)
        mounted = run.imu.gyroscope @ Rotation.from_rotvec([0.3, -0.4, 1.2]).as_matrix()
        run = with_stream(run, "imu", gyroscope=mounted)
        measured = evidence(run)
        assert [check(run, measured) for check in SENSOR_CHECKS] == [((), ())] * len(SENSOR_CHECKS)


def test_offset_clocks_and_rest_are_not_another_body():
    """Would catch the blame on the IMU where a clock is off by seconds or steps, or nothing turns."""
    run, _ = pair(7)
    tracker = run.optical.time_ns
    step = np.where(tracker > ns(15.0), tracker + ns(3.0), tracker)
    for stamps in (tracker + ns(3.5), tracker - ns(6.0), step):
        bad = with_stream(run, "optical", time_ns=stamps)
        assert found(rotation_findings, bad) == ((), ())
    rest, _ = pair(8, amplitude_deg=(0.0, 0.0, 0.0))
    other = with_stream(rest, "imu", gyroscope=pair(9)[0].imu.gyroscope * 0.02)
    assert found(rotation_findings, other) == ((), ())
    still = with_stream(rest, "imu", gyroscope=np.zeros_like(rest.imu.gyroscope))
    assert found(rotation_findings, still) == ((), ())


def test_held_and_rounded_values_are_notes():
    """Would catch values that are written several times passed over, or rest called held."""
    run, _ = pair(0)
    count = len(run.imu.time_ns)
    force = 9.8 + np.random.default_rng(0).normal(size=(count, 3))
    held = force[np.arange(count) // 4 * 4]
    imu = replace(run.imu, accelerometer=held)
    (note,) = found(held_findings, run.replace(imu=imu)).notes
    assert "the accelerometer is written at 200 Hz and read at 50 Hz: 75 % of" in note
    rounded = replace(run.imu, accelerometer=np.round(force / 5.0) * 5.0)
    (note,) = found(held_findings, run.replace(imu=rounded)).notes
    assert "the accelerometer is rounded to steps of 5 m/s^2" in note
    fine = np.round(force / 0.5) * 0.5
    still = np.where(np.arange(count)[:, None] < 3000, 9.8, force)
    for values in (force, fine, still):
        assert found(held_findings, run.replace(imu=replace(imu, accelerometer=values))).notes == ()
