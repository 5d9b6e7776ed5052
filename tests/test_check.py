"""`jaxekf check`: what it tells of good and bad runs, and how scripts know which."""

import json
import os
from dataclasses import replace

import numpy as np
import pytest
from click.testing import CliRunner

from jaxekf.checks.inspection import find_gaps, inspect
from jaxekf.cli import main
from jaxekf.io import run_folder
from jaxekf.io.importers import asl, broad
from jaxekf.recordings.accounts import Intake, Reason
from jaxekf.recordings.types import Camera
from jaxekf.reporting.plots.timeaxis import time_axis
from jaxekf.simulation import attitude_runs, marker_runs
from jaxekf.simulation.camera_runs import CameraGrade, camera_recording

LONG = os.environ.get("JAXEKF_LONG") == "1"


def free(seed=0, duration_s=12.0, **options):
    motion = attitude_runs.free_motion(seed, rest_s=0.0)
    run = attitude_runs.recording(
        f"free-{seed}", motion, seed=seed, duration_s=duration_s, **options
    )
    return run.replace(encoder=None)


def late(run, seconds):
    optical = run.need_optical()
    return run.replace(optical=replace(optical, time_ns=optical.time_ns + round(1e9 * seconds)))


def run_check(*arguments):
    return CliRunner().invoke(main, ["check", *map(str, arguments)])


def test_gaps_are_counted_as_stated():
    """A threshold of another size, or lost seconds less the step that would have been there anyway."""
    step = np.array([10, 10, 10, 14, 16, 10, 10, 100, 10]) * 1_000_000
    found = find_gaps(np.concatenate([[0], np.cumsum(step)]))
    assert (found.count, found.longest_s, found.lost_s) == (2, 0.1, 0.116)
    assert found.spans == [(0.044, 0.06), (0.08, 0.18)]
    assert find_gaps(np.array([5])).count == 0


def test_verdicts_and_exit_status(tmp_path):
    """Scripts that cannot tell good runs from bad ones, or a bad run that keeps others from being told."""
    fine = run_folder.save(free(0), tmp_path / "fine")
    warned = run_folder.save(late(free(1), 0.02), tmp_path / "late")
    wrong = free(2)
    imu = replace(wrong.imu, gyroscope=np.rad2deg(wrong.imu.gyroscope))
    wrong = run_folder.save(wrong.replace(imu=imu), tmp_path / "wrong")
    occluded = run_folder.save(free(0, occlusions=[(3.0, 5.0)]), tmp_path / "fine.h5")
    assert run_check(occluded).exit_code == 0
    done = run_check(fine)
    assert done.exit_code == 0, done.output
    assert "free-0: fine" in done.stdout and "62.500" in done.stdout
    done = run_check(fine, warned)
    assert done.exit_code == 3
    assert "free-1: usable, but see the warnings" in done.stdout
    assert "ms older than stamped" in " ".join(done.stdout.split())
    done = run_check(tmp_path / "none", wrong, fine, "--json")
    assert done.exit_code == 1
    document = json.loads(done.stdout)
    assert document["verdict"] == "faults"
    assert [run["verdict"] for run in document["runs"]] == ["faults", "faults", "fine"]
    assert "no such folder" in document["runs"][0]["faults"][0]
    assert 'unit = "deg/s' in document["runs"][1]["faults"][0]
    assert all(line.startswith("Error: ") for line in done.stderr.splitlines())
    assert len(done.stderr.splitlines()) == 2
    good = document["runs"][2]
    assert good["streams"]["imu"]["rate_hz"] == pytest.approx(125.0)
    assert abs(good["alignment"]["tracker"]["latency_s"]) < 2e-3
    assert good["evidence"]["rate_ratio"] == pytest.approx(1.0, abs=0.02)


def test_folder_with_pictures(tmp_path):
    """Pictures of runs of one name that overwrite each other, a folder overwritten unasked, or a crash on
    a run of markers or of one stream."""
    tool = marker_runs.tool_recording(
        "tool",
        marker_runs.free_tool_motion(1),
        seed=1,
        duration_s=6.0,
        hidden=[("2", 1.0, 2.0)],
        grade=marker_runs.ToolGrade(imu_s=0.01),
    ).replace(encoder=None)
    alone = free(0).replace(optical=None, name="tool")
    paths = [run_folder.save(tool, tmp_path / "a"), run_folder.save(alone, tmp_path / "b")]
    out = tmp_path / "checked"
    done = run_check(*paths, "-o", out)
    assert done.exit_code in (0, 3), done.output
    assert sorted(f.name for f in out.iterdir()) == [
        "check.json",
        "check_tool-2.png",
        "check_tool.png",
    ]
    document = json.loads((out / "check.json").read_text())
    markers = document["runs"][0]["streams"]["markers"]["each"]
    assert markers["2"]["hidden"]["lost_s"] == pytest.approx(1.0, abs=0.03)
    assert markers["1"]["hidden"]["count"] == 0
    assert "without tracker" in document["runs"][1]["notes"][0]
    again = run_check(*paths, "-o", out)
    assert again.exit_code == 1 and "a path that exists" in again.stderr
    assert run_check(*paths, "-o", out, "--overwrite").exit_code == done.exit_code


def seen_by_camera(run):
    """A run with a camera instead of a tracker: five landmarks, three found at most, and none from 3 to
    5 s."""
    time_ns = run.imu.time_ns[0] + np.arange(0, 12, 0.1) * 1e9
    visible = np.tile([True, True, True, False, False], (len(time_ns), 1))
    visible[::2, 0] = False
    visible[30:50] = False
    camera = Camera(
        time_ns.astype(np.int64),
        np.where(visible[..., None], [100.0, 200.0], np.nan),
        visible,
        ("A", "B", "C", "D", "E"),
        np.eye(5, 3),
        np.full(2, 400.0),
        np.full(2, 320.0),
    )
    return run.replace(optical=None, camera=camera)


def test_a_camera(tmp_path):
    """Would catch a camera that check passes over, images with some landmark hidden called masked, or
    without any called seen."""
    run = seen_by_camera(free(0))
    path, out = run_folder.save(run, tmp_path / "run"), tmp_path / "checked"
    done = run_check(path, "-o", out)
    assert done.exit_code == 0, done.output
    told = " ".join(done.stdout.split())
    assert "camera 120 100 10.000 0.000 11.900 0" in told
    assert "camera: 2.1 of 5 landmarks in an image on average, 20 of 120 images without any" in told
    assert sorted(f.name for f in out.iterdir()) == ["check.json", "check_free-0.png"]
    document = json.loads((out / "check.json").read_text())["runs"][0]
    found = document["streams"]["camera"]
    assert found["points_per_image"] == pytest.approx(250 / 120)
    assert found["images_without_points"] == 20 and found["landmarks"] == 5
    assert found["hidden"]["count"] == 1
    assert found["hidden"]["lost_s"] == pytest.approx(2.0)
    assert found["masked"] == {"blank": 350}
    assert found["gaps"]["count"] == 0
    made = run_folder.load(path)
    figure = time_axis(made, inspect(made))
    lanes, legend = figure.axes[0], figure.legends[0]
    assert [label.get_text() for label in lanes.get_yticklabels()] == ["camera", "imu"]
    assert [text.get_text() for text in legend.get_texts()][1:] == ["no landmark found"]
    assert "10 Hz\n17 % masked" in [text.get_text() for text in lanes.texts]
    seldom = replace(made.camera, visible=made.camera.visible & (np.arange(120) < 40)[:, None])
    assert inspect(made.replace(camera=seldom)).warnings == (
        "the camera sees nothing for 75 % of its time",
    )
    moved = replace(made.camera, time_ns=made.camera.time_ns + 9_000_000_000)
    assert "camera and IMU overlap for 3.0 s" in inspect(made.replace(camera=moved)).warnings[0]


CAMERA_FAULTS = {
    # What is changed of the camera: what is said, and whether the run can be used nevertheless.
    "focal in mm": (lambda c: {"focal": np.full(2, 3.2)}, "none of which fits any pose", "faults"),
    "names": (
        lambda c: {"p_ref_landmark": np.roll(c.p_ref_landmark, 7, axis=0)},
        "none of which fits any pose",
        "faults",
    ),
    "landmarks in mm": (
        lambda c: {"p_ref_landmark": 1e3 * c.p_ref_landmark},
        'stating [camera] unit = "mm, px"',
        "faults",
    ),
    "scale": (
        lambda c: {"p_ref_landmark": 1.3 * c.p_ref_landmark},
        "positions to scale",
        "warnings",
    ),
    "images of half the size": (
        lambda c: {"pixel": 0.5 * c.pixel},
        "of the camera's rotation: are both of one run",
        "warnings",
    ),
    "late": (lambda c: {"time_ns": c.time_ns + 40_000_000}, "the images are 40.", "warnings"),
    "turned": (
        lambda c: {"q_body_camera": np.full(4, 0.5)},
        "the camera is rotated by 120.",
        "warnings",
    ),
}


@pytest.fixture(scope="module")
def eight():
    """A camera and an IMU that draw the eight."""
    return camera_recording("eight", seed=2, duration_s=30.0)


def test_a_camera_as_it_should_be(eight, tmp_path):
    """Would catch warnings of a good camera, or clocks and lengths that are compared and not shown."""
    path = run_folder.save(eight, tmp_path / "eight")
    done = run_check(path, "-o", tmp_path / "out")
    assert done.exit_code == 0, done.output
    told = " ".join(done.stdout.split())
    assert "376 of 376 images looked at fit a pose, points 0.6" in told
    assert "camera, rate: the gyroscope turns 1.0" in told
    document = json.loads((tmp_path / "out" / "check.json").read_text())["runs"][0]
    found = document["streams"]["camera"]
    assert abs(found["alignment"]["latency_s"]) < 3e-3
    assert found["evidence"]["length_ratio"] == pytest.approx(1.0, abs=0.1)
    few = camera_recording("few", seed=3, duration_s=30.0, grade=CameraGrade(points=6))
    assert inspect(few).warnings == ()


@pytest.mark.parametrize("change", CAMERA_FAULTS)
def test_gross_faults_of_a_camera(eight, change):
    """Would catch a lens, places or a clock that are wrong by far and called fine."""
    changes, said, verdict = CAMERA_FAULTS[change]
    found = inspect(eight.replace(camera=replace(eight.camera, **changes(eight.camera))))
    assert found.verdict == verdict
    texts = found.faults if verdict == "faults" else found.warnings
    assert any(said in text for text in texts), texts


def test_a_gyroscope_in_degrees_beside_a_camera(eight):
    """Would catch a unit that only a tracker is compared for."""
    imu = replace(eight.imu, gyroscope=np.rad2deg(eight.imu.gyroscope))
    (said,) = inspect(eight.replace(imu=imu)).faults
    assert "as fast as the camera" in said and 'unit = "deg/s' in said


def test_gravity_the_other_way_round_beside_a_camera(eight):
    """Would catch gravity_ref that points up, of a run whose only poses are those of images."""
    (said,) = inspect(eight.replace(info={"gravity_ref": [9.81, 0.0, 0.0]})).faults
    assert "gravity vector 1" in said and "expected about [-9.9" in said


def test_a_tracker_of_12_5_hz_is_compared():
    """Would catch steps of which two are longer than the span that turns are taken over: nothing told."""
    run = free(0)
    every = round(0.08 / np.median(np.diff(run.optical.time_ns / 1e9)))
    parts = {"time_ns": run.optical.time_ns[::every]}
    for key in run.optical.per_sample:
        value = getattr(run.optical, key)
        parts[key] = None if value is None else value[::every]
    optical = replace(run.optical, **parts)
    step = np.median(np.diff(optical.time_ns)) / 1e9
    assert 0.075 < step < 0.1
    assert inspect(run.replace(optical=optical)).evidence.turns > 40


def test_what_is_warned_of():
    """An occlusion that is called a fault, or a wrong row, a long gap or a run at rest that is not."""
    run = free(0, occlusions=[(3.0, 5.0)])
    times = run.optical.time_ns
    hidden = Reason(np.arange(2, 4), times[2:4])
    strange = Reason(np.arange(7, 8), times[7:8])
    account = Intake(len(times), {"blank": hidden, "not finite": strange})
    found = inspect(run.replace(intake={"optical": account}))
    assert found.verdict == "warnings"
    assert found.notes == ("optical: 2 rows are masked, blank (lines 2 to 3)",)
    assert found.warnings == ("optical: 1 row is masked, not finite (line 7)",)
    assert found.streams["optical"].masked == {"blank": 2, "not finite": 1}
    assert found.streams["optical"].hidden.lost_s == pytest.approx(2.0, abs=0.03)
    imu = run.imu
    kept = (imu.time_ns < 6_000_000_000) | (imu.time_ns > 6_800_000_000)
    gap = replace(imu, time_ns=imu.time_ns[kept], gyroscope=imu.gyroscope[kept])
    assert "1 gaps of more than 0.5 s" in inspect(run.replace(imu=gap)).warnings[0]
    still = attitude_runs.recording("rest", attitude_runs.Motion(), seed=0, duration_s=10.0)
    found = inspect(still.replace(encoder=None))
    assert found.alignment is None and "little rotation" in found.warnings[0]


GAPS = {1: (28, 3.4, 1.06), 3: (80, 15.0, 1.99), 4: (36, 2.7, 0.48)}


@pytest.mark.parametrize("room", GAPS if LONG else [4])
def test_gaps_and_clock_of_tum_vi(data_dir, room):
    """Gaps of real motion capture that are missed or made up, and a clock that is off."""
    found = inspect(asl.load(data_dir / "tumvi" / f"room{room}"))
    count, lost, longest = GAPS[room]
    gaps = found.streams["optical"].gaps
    assert gaps.count == count
    assert gaps.lost_s == pytest.approx(lost, abs=0.05)
    assert gaps.longest_s == pytest.approx(longest, abs=0.005)
    assert abs(found.alignment.tracker.latency_s) < 2e-3
    assert found.faults == ()


def broad_trials(data_dir):
    return (
        sorted((data_dir / "broad").glob("*.mat")) if LONG else [broad.find(data_dir / "broad", 16)]
    )


def test_lag_of_broad(data_dir):
    """A lag that is not the gyroscope's of 3.5 to 5 ms in each trial."""
    for trial in broad_trials(data_dir):
        run = broad.load(trial).replace(encoder=None)
        if not LONG:
            run = first(run, 60.0)
        found = inspect(run)
        assert found.faults == ()
        assert -5e-3 < found.alignment.tracker.latency_s < -3.5e-3, trial


def first(run, seconds):
    """The start of a run."""
    optical, imu = run.optical, run.imu
    end = optical.time_ns[0] + round(1e9 * seconds)
    a, b = (int(np.searchsorted(s.time_ns, end)) for s in (optical, imu))
    cut = {"position": optical.position[:a]}
    optical = replace(
        optical,
        time_ns=optical.time_ns[:a],
        q_ref_body=optical.q_ref_body[:a],
        valid=optical.valid[:a],
        **cut,
    )
    imu = replace(
        imu,
        time_ns=imu.time_ns[:b],
        gyroscope=imu.gyroscope[:b],
        accelerometer=imu.accelerometer[:b],
        magnetometer=None,
    )
    return run.replace(optical=optical, imu=imu)
