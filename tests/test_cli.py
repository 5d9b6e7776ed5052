"""The command line, through its own entry point: files, JSON, and one line for what is wrong."""

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner

import jaxekf
from jaxekf.cli import main
from jaxekf.simulation import demo


def call(*arguments):
    return CliRunner().invoke(main, [str(a) for a in arguments])


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    folder = tmp_path_factory.mktemp("runs")
    result = call(
        "simulate",
        "--runs",
        2,
        "--seed",
        3,
        "--duration",
        4,
        "--rest",
        0.5,
        "--occlusion",
        "2,2.5",
        "-o",
        folder,
        "--json",
    )
    assert result.exit_code == 0, result.output
    return [Path(path) for path in json.loads(result.stdout)["runs"]]


def test_simulate_writes_runs(runs):
    """Would catch options that do nothing."""
    assert [path.name for path in runs] == ["free-3", "free-4"]
    optical = jaxekf.load(runs[0]).need_optical()
    t = (optical.time_ns - optical.time_ns[0]) / 1e9
    assert not optical.valid[(t >= 2.0) & (t < 2.5)].any()
    assert t[-1] == pytest.approx(4.0, abs=0.02)


def test_crop_makes_two_runs_of_one(runs, tmp_path):
    """Would catch a sample that is in both parts or in none, times that begin anew, or a lost mask."""
    for span, name in ((("--to", 1.5), "first"), (("--from", 1.5), "second")):
        result = call("crop", runs[0], *span, "-o", tmp_path / name, "--json")
        assert result.exit_code == 0, result.output
        assert json.loads(result.stdout)["samples"].keys() == {"optical", "imu", "encoder"}
    whole, *parts = [jaxekf.load(p) for p in (runs[0], tmp_path / "first", tmp_path / "second")]
    for label, stream in whole.streams.items():
        for key, value in stream.arrays.items():
            joined = [part.streams[label].arrays[key] for part in parts]
            np.testing.assert_array_equal(np.concatenate(joined), value, f"{label}.{key}")
    imu = parts[1].need_imu().time_ns[0] - whole.need_imu().time_ns[0]
    assert 0 <= imu - 1_500_000_000 < 8_000_000
    outside = call("crop", runs[0], "--from", 4.5, "-o", tmp_path / "none")
    assert outside.exit_code == 1 and "expected an interval within 0 to 4.000 s" in outside.output
    assert not (tmp_path / "none").exists()


def test_estimate_writes_results(runs, tmp_path):
    """Would catch JSON mixed with other text, or a result that is not where it is said to be."""
    result = call("estimate", *runs, "-o", tmp_path / "out", "--json")
    assert result.exit_code == 0, result.output
    document = json.loads(result.stdout)
    assert [run["run"] for run in document["runs"]] == ["free-3", "free-4"]
    for run in document["runs"]:
        assert (Path(run["result"]) / "estimate.csv").is_file()
        assert run["score"]["attitude_rmse_deg"] < 0.5 * run["hold_last_deg"]
    again = call("estimate", *runs, "-o", tmp_path / "out")
    assert again.exit_code == 1
    assert "exists" in again.output
    table = call("estimate", runs[0], "-o", tmp_path / "out", "--overwrite")
    assert table.exit_code == 0
    assert "attitude RMSE" in table.output


def test_tune_then_estimate_with_the_tuned_noise(runs, tmp_path):
    """Would catch noise files that estimate does not read, or --noise that does nothing."""
    result = call(
        "tune",
        runs[0],
        "--validate",
        runs[1],
        "--objective",
        "attitude+0.01*likelihood",
        "--iterations",
        4,
        "-o",
        tmp_path / "tuned",
        "--json",
    )
    assert result.exit_code == 0, result.output
    document = json.loads(result.stdout)
    assert document["origin"]["runs"] == ["free-3"]
    assert document["origin"]["validation_runs"] == ["free-4"]
    made = call(
        "estimate", runs[1], "--noise", tmp_path / "tuned", "-o", tmp_path / "out", "--json"
    )
    assert made.exit_code == 0, made.output
    read = jaxekf.load_parameters(jaxekf.get_model("loose"), tmp_path / "out" / "free-4")
    assert float(read.noise.optical) == document["noise"]["optical"]["value"]
    assert float(read.noise.optical) != float(jaxekf.get_model("loose").parameters.noise.optical)


def test_plot_draws_what_is_asked(runs, tmp_path):
    """Would catch a figure that is named but not written."""
    result = call("plot", runs[0], "--figure", "bias", "--figure", "occlusion", "-o", tmp_path)
    assert result.exit_code == 0, result.output
    assert {p.name for p in tmp_path.iterdir()} == {"free-3_bias.png", "free-3_occlusion.png"}


def test_own_model_by_name(tmp_path, monkeypatch):
    """Would catch --model module:attribute that does not find a file in the current folder."""
    examples = Path(__file__).parents[1] / "examples"
    monkeypatch.chdir(examples)
    run = demo.FOLDER / "free-5"
    result = call("estimate", run, "--model", "own_model:MODEL", "-o", tmp_path / "out", "--json")
    assert result.exit_code == 0, result.output
    assert "scale_x" in (tmp_path / "out" / "free-5" / "estimate.csv").read_text().splitlines()[0]


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["estimate", "nowhere"], "no such folder"),
        (["estimate", demo.FOLDER / "free-1", "--model", "lose"], "expected one of"),
        (["estimate", demo.FOLDER / "free-1", demo.FOLDER / "free-1"], "twice"),
        (["estimate", demo.FOLDER / "free-1", "--noise", "nowhere.toml"], "no such file"),
        (["tune", demo.FOLDER / "free-1", "--objective", "speed"], "speed"),
        (["tune", demo.FOLDER / "free-1", "--free", "noise.speed"], "noise.speed"),
    ],
)
def test_faults_are_one_line(arguments, words, tmp_path):
    """Would catch a traceback at the terminal."""
    result = call(*arguments, "-o", tmp_path / "out")
    assert result.exit_code == 1
    assert words in result.output
    assert "Traceback" not in result.output
    *warnings, told = result.output.strip().splitlines()
    assert told.startswith("Error: ")
    assert all("masked" in line or line == "tuning: compiling" for line in warnings)
    assert not (tmp_path / "out").exists()


def test_demo_does_the_main_job(tmp_path):
    """Would catch a demo that does not tune, does not improve, or leaves a file out."""
    result = call("demo", "-o", tmp_path / "demo", "--json")
    assert result.exit_code == 0, result.output
    document = json.loads(result.stdout)
    mean = document["mean_attitude_rmse_deg"]
    assert mean["tuned"] < 0.9 * mean["hand-set"]
    assert mean["tuned"] < 0.05 * mean["hold last"]
    rates = {row["variant"]: row["rate_rmse_deg_s"] for row in document["rows"]}
    assert rates["tuned"] < rates["hold last"]
    folder = tmp_path / "demo"
    figures = {p.stem for p in (folder / "figures").iterdir()}
    assert {
        f"constant-rate_{n}" for n in ("attitude", "rate", "bias", "occlusion", "path")
    } <= figures
    assert (folder / "noise.toml").is_file()
    for name in demo.TESTING:
        assert (folder / "result" / name / "estimate.csv").is_file()
    nis = [row["nis"] for row in document["rows"] if row["variant"] == "tuned"]
    assert np.all(np.abs(np.array(nis) - 1.0) < 0.2)


def test_the_installed_command_switches_to_float64(tmp_path):
    """Would catch a command line that leaves float64 to the user, or prints progress into a pipe."""
    run = demo.FOLDER / "constant-rate"
    command = [
        sys.executable,
        "-m",
        "jaxekf",
        "estimate",
        str(run),
        "-o",
        str(tmp_path / "out"),
        "--json",
    ]
    done = subprocess.run(command, capture_output=True, text=True, timeout=300, check=False)
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout)["runs"][0]["run"] == "constant-rate"
    assert "━" not in done.stderr


def test_a_result_never_replaces_its_recording(runs, tmp_path):
    """Would catch --overwrite that deletes the user's data."""
    folder = runs[0].parent
    before = sorted(p.name for p in runs[0].iterdir())
    result = call("estimate", runs[0], "-o", folder, "--overwrite")
    assert result.exit_code == 1
    assert sorted(p.name for p in runs[0].iterdir()) == before


def test_a_model_without_bias_and_rate(runs, tmp_path, monkeypatch):
    """Would catch a command line that knows the loose models only."""
    (tmp_path / "attitude_only.py").write_text(
        "from dataclasses import replace\n"
        "from jaxekf.models.loose import MODEL as LOOSE\n"
        "MODEL = replace(LOOSE, name='attitude_only', outputs=LOOSE.outputs[:1])\n"
    )
    monkeypatch.chdir(tmp_path)
    own = ["--model", "attitude_only:MODEL"]
    for arguments in (
        ["estimate", runs[0], "-o", "out"],
        ["tune", runs[0], "--iterations", 1, "-o", "tuned"],
        ["plot", runs[0], "-o", "figures"],
    ):
        result = call(*arguments, *own)
        assert result.exit_code == 0, result.output
    assert not list((tmp_path / "figures").glob("*rate*"))


def test_what_a_table_would_hide_is_said(runs, tmp_path):
    """Would catch dropped rows and hopeless noise passing without a word."""
    record = jaxekf.load(runs[0])
    imu = record.need_imu()
    half = len(imu.time_ns) // 2
    jaxekf.save(
        record.replace(imu=type(imu)(imu.time_ns[:half], imu.gyroscope[:half])), tmp_path / "run"
    )
    noise = tmp_path / "noise.toml"
    noise.write_text(
        'schema_version = 1\nmodel = "loose"\n[noise.optical]\nvalue = 1e-4\nunit = "rad"\n'
    )
    result = call("estimate", tmp_path / "run", "--noise", noise, "-o", tmp_path / "out")
    assert result.exit_code == 0, result.output
    assert "outside the run" in result.output
    assert "optical noise is set too small" in result.output
    assert "ms later" not in result.output and "ms earlier" not in result.output


@pytest.mark.parametrize(
    "arguments",
    [
        ["--seed", "-1"],
        ["--duration", "inf"],
        ["--optical-noise", "nan"],
        ["--gyroscope-noise", "-1"],
        ["--occlusion", "3,2"],
    ],
)
def test_simulate_refuses_nonsense(arguments, tmp_path):
    """Would catch a run that cannot be, or a traceback."""
    result = call("simulate", *arguments, "-o", tmp_path / "runs")
    assert result.exit_code == 2
    assert "Traceback" not in result.output
    assert not (tmp_path / "runs").exists()
