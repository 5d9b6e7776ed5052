"""The command line on runs of single markers: scores of the position, what was known live, refusals."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner

import jaxekf
from jaxekf.cli import main
from jaxekf.cli.comparison import print_comparison
from jaxekf.pose_solvers import marker_pose
from jaxekf.simulation import demo
from tuning import Row


def call(*arguments):
    return CliRunner().invoke(main, [str(a) for a in arguments])


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """A short recording on disk: one marker hidden for a while, then all."""
    done = call(
        "simulate",
        "--motion",
        "tool",
        "--seed",
        1,
        "--duration",
        2,
        "--hide",
        "1,1.3,2",
        "--hide",
        "1.5,1.6",
        "--latency",
        0.025,
        "-o",
        tmp_path_factory.mktemp("markers"),
        "--json",
    )
    assert done.exit_code == 0, done.output
    return Path(json.loads(done.stdout)["runs"][0])


def test_simulated_tool_is_as_asked(run):
    """Would catch options that do nothing, the wrong marker hidden, or a noise of another size."""
    recording = jaxekf.load(run)
    markers = recording.need_markers()
    assert (recording.name, recording.optical) == ("tool-1", None)
    assert markers.latency_ns == 25_000_000
    taken = (markers.time_ns - markers.latency_ns) / 1e9
    one, every = (taken >= 1.0) & (taken < 1.3), (taken >= 1.5) & (taken < 1.6)
    hidden = np.stack([every, one | every, every], axis=1)
    np.testing.assert_array_equal(markers.visible, ~hidden)
    raw, truth = marker_pose.from_markers(markers), recording.need_encoder()
    at = np.searchsorted(truth.time_ns, raw.time_ns - raw.latency_ns)
    corner = markers.position[:, 0] - truth.position[at]
    assert 1e3 * np.nanstd(corner) == pytest.approx(0.231, rel=0.2)


@pytest.fixture(scope="module")
def result(run, tmp_path_factory):
    """What `estimate --model tight` prints and writes."""
    output = tmp_path_factory.mktemp("result")
    exports = ["--export", "tum", "--export", "npz", "--export", "hdf5"]
    done = call("estimate", run, "--model", "tight", "-o", output, "--json", *exports)
    assert done.exit_code == 0, done.output
    return json.loads(done.stdout)["runs"][0]


def columns(folder):
    """The columns of a result's `estimate.csv` by name."""
    return np.genfromtxt(folder + "/estimate.csv", delimiter=",", names=True)


def truth_at(run, time):
    """True positions (N, 3) at the estimate's instants, which are some of the encoder's."""
    encoder = jaxekf.load(run).encoder
    seconds = encoder.time_ns / 1e9
    at = np.searchsorted(seconds, time - 1e-6)
    np.testing.assert_allclose(seconds[at], time, atol=1e-6)
    return encoder.position[at]


def test_position_is_scored(run, result):
    """Would catch a position's error in metres, of one axis, or measured with the wrong covariance."""
    table, judged = columns(result["result"]), result["score"]
    estimated = np.stack([table[f"position_{axis}"] for axis in "xyz"], axis=1)
    error = truth_at(run, table["time"]) - estimated
    expected = 1e3 * np.sqrt(np.mean(np.sum(error**2, axis=1)))
    assert judged["position_rmse_mm"] == pytest.approx(expected, rel=1e-6)
    with np.load(result["result"] + "/covariance.npz") as arrays:
        cov = arrays["cov_position"]
    nees = np.einsum("ni,nij,nj->n", error, np.linalg.inv(cov), error).mean() / 3.0
    assert judged["position_nees"] == pytest.approx(nees, rel=1e-6)
    assert 0.1 < nees < 10.0


def test_exports_hold_pose_frames_and_setup(run, result):
    """Would catch a trajectory without its position, frames of the wrong body, or a setup left out."""
    folder = Path(result["result"])
    read, again = (jaxekf.read_export(folder / f"estimate.{suffix}") for suffix in ("npz", "h5"))
    assert read.keys() == again.keys()
    path = np.loadtxt(folder / "trajectory.tum")
    np.testing.assert_array_equal(path[:, 1:4], read["outputs/position/value"])
    np.testing.assert_array_equal(path[:, [7, 4, 5, 6]], read["state/q_ref_body"])
    assert read["outputs/position/value@frame"] == "reference"
    assert read["outputs/object_attitude/value@frame"] == "object to reference"
    assert read["covariance@frames"][:6] == ["reference"] * 3 + ["body"] * 3
    places = read["parameters/setup/p_body_marker"]
    np.testing.assert_array_equal(places, jaxekf.load(run).need_markers().p_body_marker)


def test_blank_true_positions_do_not_count(run, result):
    """Would catch a score that is lost in one blank cell, or an unknown position that counts as zero."""
    recording = jaxekf.load(run)
    made = jaxekf.estimate(recording, "tight")
    position = recording.encoder.position.copy()
    position[100:150] = np.nan
    blank = replace(recording.encoder, position=position)
    got = jaxekf.score(made, recording.replace(encoder=blank))
    at = np.searchsorted(blank.time_ns, made.time_ns)
    error = (position[at] - made.outputs["position"].value)[np.isfinite(position[at, 0])]
    expected = 1e3 * np.sqrt(np.mean(np.sum(error**2, axis=1)))
    assert got.position_rmse_mm == pytest.approx(expected, rel=1e-9)
    assert got.samples == result["score"]["samples"]
    unknown = jaxekf.score(made, recording.replace(encoder=replace(blank, position=None)))
    assert np.isnan(unknown.position_rmse_mm)
    assert np.isnan(unknown.position_nees)
    assert unknown.attitude_rmse_deg == got.attitude_rmse_deg


def test_position_is_shown_where_there_is_one(run, tmp_path):
    """Would catch a column of dashes for models without position, or none for those with it."""
    shown = call("estimate", run, "--model", "tight", "-o", tmp_path / "tight")
    assert "position RMSE" in shown.stdout
    plain = call("estimate", demo.FOLDER / "free-5", "-o", tmp_path / "loose", "--json")
    assert json.loads(plain.stdout)["runs"][0]["score"]["position_rmse_mm"] is None
    table = call("estimate", demo.FOLDER / "free-5", "-o", tmp_path / "loose", "--overwrite")
    assert table.exit_code == 0, table.output
    assert "position" not in table.stdout


def test_position_is_compared_where_there_is_one(capsys):
    """Would catch a comparison without position, its column for attitude alone, or a mean that is lost
    in one run without truth."""
    loose = [Row("a", "tuned", 0.1, 1.0, 1.0, 1.0)]
    print_comparison("compared", loose)
    assert "position" not in capsys.readouterr().out
    print_comparison("compared", [*loose, Row("b", "tuned", 0.1, 1.0, 1.0, 1.0, 0.25, 1.5)])
    lines = capsys.readouterr().out.splitlines()
    assert any("position RMSE" in line for line in lines)
    mean = next(line for line in lines if "mean" in line)
    assert mean.split()[-2:] == ["0.250", "1.500"]


def test_online_is_what_was_known(run, result, tmp_path):
    """Would catch --online that does nothing, or that looks ahead: with the tracker 25 ms late a live
    system starts later and is worse."""
    done = call("estimate", run, "--model", "tight", "--online", "-o", tmp_path, "--json")
    assert done.exit_code == 0, done.output
    document = json.loads(done.stdout)
    told = document["runs"][0]
    assert document["online"] is True
    assert any("25 ms late" in note for note in told["notes"])
    online = jaxekf.estimate_online(run, "tight")
    table = columns(told["result"])
    np.testing.assert_allclose(
        table["position_x"], online.outputs["position"].value[:, 0], atol=1e-9
    )
    # The first sample of the IMU, every 2 ms, by which the first frame has arrived.
    assert table["time"][0] - columns(result["result"])["time"][0] == pytest.approx(0.026, abs=1e-6)
    assert told["score"]["position_rmse_mm"] > 1.1 * result["score"]["position_rmse_mm"]


def test_online_of_a_model_that_only_looks_back(tmp_path):
    """Would catch a stack trace, a refusal after the work was done, or one that names no other model."""
    done = call(
        "estimate",
        demo.FOLDER / "free-5",
        "--model",
        "loose_rate",
        "--online",
        "-o",
        tmp_path / "o",
    )
    assert done.exit_code == 1
    assert sum(line.startswith("Error: ") for line in done.output.splitlines()) == 1
    for words in (
        "'loose_rate' without input",
        "loose, loose_pose, marg, tight, triad",
        "not online",
    ):
        assert words in done.output
    assert not (tmp_path / "o").exists()


def test_plot_draws_single_markers(run, tmp_path):
    """Would catch a command that writes no figure and says nothing."""
    done = call("plot", run, "--model", "tight", "--figure", "visibility", "-o", tmp_path, "--json")
    assert done.exit_code == 0, done.output
    assert json.loads(done.stdout)["figures"] == [str(tmp_path / "tool-1_visibility.png")]
    wrong = call("plot", demo.FOLDER / "free-5", "--figure", "visibility", "-o", tmp_path)
    assert wrong.exit_code == 1
    assert "attitude" in wrong.output
    assert sum(line.startswith("Error: ") for line in wrong.output.splitlines()) == 1


@pytest.mark.parametrize("command", ["estimate", "plot", "tune"])
def test_the_wrong_model_names_the_right_one(run, tmp_path, command):
    """Would catch a user of single markers told to add a file that the tracker does not write."""
    done = call(command, run, "-o", tmp_path / "o")
    assert done.exit_code == 1
    assert sum(line.startswith("Error: ") for line in done.output.splitlines()) == 1
    assert "single markers" in done.output
    assert "--model tight" in done.output
    back = call(command, demo.FOLDER / "free-5", "--model", "tight", "-o", tmp_path / "o")
    assert back.exit_code == 1
    assert sum(line.startswith("Error: ") for line in back.output.splitlines()) == 1
    assert "loose_pose" in back.output


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--motion", "tool", "--occlusion", "1,2"], "--hide"),
        (["--motion", "tool", "--optical-noise", "1"], "--optical-noise with --motion tool"),
        (["--hide", "1,2"], "--hide with --motion free"),
        (["--motion", "tool", "--hide", "1,2,7"], "marker '7'"),
        (["--motion", "tool", "--hide", "2,1,1"], "START < END"),
        (["--motion", "tool", "--latency", "nan"], "expected a number"),
    ],
)
def test_simulate_refuses_what_a_motion_has_no_use_for(arguments, words, tmp_path):
    """Would catch an option that is passed over in silence, or a marker that is not there."""
    done = call("simulate", *arguments, "-o", tmp_path / "runs")
    assert done.exit_code == 2
    assert words in " ".join(done.output.split())
    assert not (tmp_path / "runs").exists()
