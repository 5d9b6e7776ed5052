"""Runs held out in folds: none leaks into its own tuning, and tables tell how far runs and folds spread."""

import json
from dataclasses import replace

import jax
import numpy as np
import pytest
from click.testing import CliRunner
from scipy.spatial.transform import Rotation

import jaxekf
import tuning
from jaxekf import simulate
from jaxekf.cli import main
from jaxekf.errors import TuningError
from jaxekf.parameters import as_arrays
from jaxekf.recording import from_scipy, to_scipy
from tuning import folds, validation

OPTIONS = {
    "objective": "attitude+0.01*likelihood",
    "free": ["noise", tuning.Free("calibration.alignment", each_run=True)],
    "iterations": 3,
}


@pytest.fixture(scope="module")
def runs():
    return [
        simulate.recording(f"run-{i}", simulate.free_motion(i, rest_s=0.2), seed=i, duration_s=3.0)
        for i in range(3)
    ]


@pytest.fixture(scope="module")
def start():
    base = as_arrays(jaxekf.get_model("loose").parameters)
    return base._replace(noise=jax.tree.map(lambda a: 3.0 * a, base.noise))


@pytest.fixture(scope="module")
def found(runs, start):
    return tuning.cross_validate(runs, start=start, **OPTIONS)


def same(one, other):
    pairs = zip(jax.tree.leaves(one), jax.tree.leaves(other), strict=True)
    return all(np.array_equal(a, b) for a, b in pairs)


def test_a_fold_is_a_tuning_on_the_other_runs(runs, start, found):
    """Would catch a held-out run that leaks into its own tuning, or options that get lost on the way."""
    assert [fold.held_out for fold in found.folds] == [("run-0",), ("run-1",), ("run-2",)]
    for i, fold in enumerate(found.folds):
        others = tuning.tune(runs[:i] + runs[i + 1 :], start=start, **OPTIONS)
        assert same(fold.tuned.params, others.params)
        own = tuning.fit_runs([runs[i]], others)[f"run-{i}"]
        variants = {"start": start, "tuned": own}
        expected = tuning.compare("loose", [runs[i]], variants).rows
        got = [row for row in found.rows if row.run == f"run-{i}"]
        assert [row.variant for row in got] == ["hold last", "start", "tuned"]
        for one, other in zip(got, expected, strict=True):
            np.testing.assert_allclose(one[2:], other[2:], rtol=1e-9)
    # With the whole set it would be another tuning.
    assert not same(found.folds[0].tuned.params, found.folds[1].tuned.params)


def test_the_truth_of_a_held_out_run_does_not_count(runs, start, found):
    """Would catch truth that reaches a held-out run's own parameters: with a false one the errors change,
    and nothing else of its fold does."""
    encoder = runs[0].need_encoder()
    q = to_scipy(encoder.q_ref_body) * Rotation.from_rotvec([0.0, 0.0, 0.3])
    false = replace(encoder, q_ref_body=from_scipy(q))
    again = tuning.cross_validate(
        [runs[0].replace(encoder=false), *runs[1:]], start=start, **OPTIONS
    )
    assert same(again.folds[0].tuned.params, found.folds[0].tuned.params)
    assert not same(again.folds[1].tuned.params, found.folds[1].tuned.params)
    rows = [
        next(row for row in one.rows if row[:2] == ("run-0", "tuned")) for one in (again, found)
    ]
    assert rows[0].nis == rows[1].nis
    assert rows[0].attitude_rmse_deg == pytest.approx(np.rad2deg(0.3), rel=0.05)
    assert rows[1].attitude_rmse_deg < 1.0


def test_spread_over_runs_and_folds(found):
    """Would catch a mean over the wrong rows, a deviation by n, or a worst NEES that is the largest."""
    errors = [row.attitude_rmse_deg for row in found.rows if row.variant == "tuned"]
    told = found.spread()["tuned"]
    assert told.mean == pytest.approx(np.mean(errors))
    assert told.deviation == pytest.approx(np.std(errors, ddof=1))
    assert told.worst == max(errors)
    assert np.isnan(found.spread("position_rmse_mm")["tuned"]).all()
    honest = [
        tuning.Row(f"run-{i}", "tuned", 0.1, 1.0, 1.0, nees) for i, nees in enumerate((0.2, 3.0))
    ]
    assert tuning.CrossValidation(honest, ()).spread("nees")["tuned"].worst == 0.2
    spread = found.parameters
    assert set(spread) == {
        *(f"noise.{name}" for name in ("gyroscope", "bias_walk", "optical")),
        "calibration.alignment",
    }
    optical = [float(fold.tuned.params.noise.optical) for fold in found.folds]
    assert float(spread["noise.optical"].mean) == pytest.approx(np.mean(optical))
    assert float(spread["noise.optical"].deviation) == pytest.approx(np.std(optical, ddof=1))
    assert spread["calibration.alignment"].each.shape == (3, 3)


def test_folds_hold_out_every_run_once(runs):
    """Would catch a run that is never held out, or one without truth that is."""
    seven = [runs[0].replace(name=f"run-{i}") for i in range(7)]
    blind = runs[0].replace(name="blind", encoder=None)
    parts = folds._parts([*seven, blind], [], 3)
    assert sorted(name for part in parts for name in part) == [run.name for run in seven]
    assert sorted(map(len, parts)) == [2, 2, 3]


def test_smoothing_is_judged_smoothed(runs, found, monkeypatch):
    """Would catch a tuning of the smoothed error that is judged by what the filter gives."""
    asked, estimate_many = [], validation.estimate_many

    def tune(seen, **options):
        asked.append(options["smooth"])
        return found.folds[0].tuned

    def plain(runs, model, params, *, smooth):
        asked.append(smooth)
        return estimate_many(runs, model, params)

    monkeypatch.setattr(folds, "tune", tune)
    monkeypatch.setattr(validation, "estimate_many", plain)
    tuning.cross_validate(runs, smooth=True)
    assert asked == [True] * 5  # three folds, start and tuned


def test_ctrl_c_ends_it(runs, start):
    """Would catch a fold whose tuning was cut short and that is taken for a whole one."""

    def stop(step, total):
        if step.number == 1:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        tuning.cross_validate(runs, start=start, progress=stop, **OPTIONS)


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda runs: tuning.cross_validate(runs[:1]), "1 folds for 1 runs"),
        (lambda runs: tuning.cross_validate(runs, 1), "1 folds for 3 runs"),
        (lambda runs: tuning.cross_validate(runs, 4), "4 folds for 3 runs"),
        (lambda runs: tuning.cross_validate([*runs, runs[0]]), "run-0"),
        (lambda runs: tuning.cross_validate(runs, validate=runs[:1]), "run-0"),
        (lambda runs: tuning.cross_validate(runs, checkpoint="state"), "checkpoint"),
    ],
)
def test_nonsense_is_refused_in_a_sentence(runs, call, words):
    """Would catch a held-out run that stops its own tuning, and a stack trace where a sentence is due."""
    with pytest.raises(TuningError, match=words) as caught:
        call(runs)
    assert "expected" in str(caught.value)


@pytest.mark.parametrize("told", ["json", "tables"])
def test_command_line(runs, start, found, tmp_path, monkeypatch, told):
    """Would catch --folds that does nothing, tables mixed into JSON, another tuning than from Python, or a
    last one that is not on all runs."""
    last = []

    def tune(given, **options):
        # One of the folds' in place of one more to compile.
        last.append([run.name for run in given])
        print("the last tuning")
        return found.folds[0].tuned

    monkeypatch.setattr(tuning, "tune", tune)
    for run in runs:
        jaxekf.save(run, tmp_path / run.name)
    jaxekf.save_parameters(tmp_path / "start", jaxekf.get_model("loose"), start, {})
    arguments = [*(tmp_path / run.name for run in runs), "--noise", tmp_path / "start"]
    arguments += ["--objective", OPTIONS["objective"], "--iterations", OPTIONS["iterations"]]
    arguments += ["--free", "noise", "--own", "calibration.alignment"]
    arguments += ["--no-judge", "-o", tmp_path / "tuned"]
    arguments += ["--folds", "all", "--json"] if told == "json" else ["--folds", 0]
    result = CliRunner().invoke(main, ["tune", *map(str, arguments)])
    assert result.exit_code == 0, result.output
    assert last == [["run-0", "run-1", "run-2"]]
    before, after = result.stdout.split("the last tuning")
    if told == "json":
        assert not before
        got, expected = json.loads(after)["folds"], json.loads(json.dumps(found.as_dict()))
        assert got["held_out"] == expected["held_out"]
        worst = got["spread"]["tuned"]["attitude_rmse_deg"]["worst"]
        assert worst == pytest.approx(found.spread()["tuned"].worst, rel=1e-6)
        each = got["parameters"]["noise.optical"]["each"]
        np.testing.assert_allclose(each, found.parameters["noise.optical"].each, rtol=1e-6)
        return
    assert before.index("Held out") < before.index("Parameters of the 3 folds")
    words = [line.split() for line in before.splitlines()]
    value = found.parameters["calibration.alignment"].mean[2]
    told_of = next(row for row in words if row[:1] == ["calibration.alignment[2]"])
    assert float(told_of[2]) == pytest.approx(np.rad2deg(value), rel=1e-3)
    for name in tuning.Spread._fields:
        row = next(row for row in words if row[:2] == [name, "tuned"])
        expected = getattr(found.spread()["tuned"], name)
        assert float(row[2]) == pytest.approx(expected, abs=6e-4)


def test_folds_are_a_number_or_all(tmp_path):
    """Would catch --folds some taken for none."""
    result = CliRunner().invoke(main, ["tune", str(tmp_path), "--folds", "some"])
    assert result.exit_code == 2
    assert "expected a number of folds or 'all'" in " ".join(result.output.split())
