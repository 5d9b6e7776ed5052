"""Runs held out in folds: none leaks into its own tuning, and tables tell how far runs and folds spread."""

import json
from dataclasses import replace

import jax
import numpy as np
import pytest
from click.testing import CliRunner
from rich.progress import Progress
from scipy.spatial.transform import Rotation

import jaxekf
import tuning
from jaxekf._support.errors import TuningError
from jaxekf.cli import main
from jaxekf.cli.console import TuningBar
from jaxekf.estimation.parameters import as_arrays
from jaxekf.recordings.types import from_scipy, to_scipy
from jaxekf.simulation import attitude_runs
from tuning.comparison import compare, cost, cross_validation
from tuning.comparison.allan_only import allan_only
from tuning.objective import objectives
from tuning.search import derivative_free, evaluation, settling

OPTIONS = {
    "objective": "attitude+0.01*likelihood",
    "free": ["noise", tuning.Free("calibration.alignment", each_run=True)],
    "iterations": 3,
}


@pytest.fixture(scope="module")
def runs():
    return [
        attitude_runs.recording(
            f"run-{i}", attitude_runs.free_motion(i, rest_s=0.2), seed=i, duration_s=3.0
        )
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
    parts = cross_validation._parts([*seven, blind], [], 3)
    assert sorted(name for part in parts for name in part) == [run.name for run in seven]
    assert sorted(map(len, parts)) == [2, 2, 3]


def test_smoothing_is_judged_smoothed(runs, found, monkeypatch):
    """Would catch a tuning of the smoothed error that is judged by what the filter gives."""
    asked, estimate_many = [], compare.estimate_many

    def tune(seen, **options):
        asked.append(options["smooth"])
        return found.folds[0].tuned

    def plain(runs, model, params, *, smooth):
        asked.append(smooth)
        return estimate_many(runs, model, params)

    monkeypatch.setattr(cross_validation, "tune", tune)
    monkeypatch.setattr(compare, "estimate_many", plain)
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
        (lambda runs: tuning.cross_validate(runs, baselines=["grid"]), "grid"),
        (lambda runs: tuning.cross_validate(runs, baselines="allan"), "a list"),
        (lambda runs: tuning.cross_validate(runs, baselines=["allan"]), "static log"),
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
    arguments += ["--no-confidence-intervals", "-o", tmp_path / "tuned"]
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


def test_old_names_work_for_one_release(runs, found, tmp_path):
    """Would catch a script of the last release that breaks, or one that nobody warns."""
    with pytest.warns(DeprecationWarning, match="baselines"), pytest.raises(TuningError):
        tuning.cross_validate(runs, beside=["grid"])  # pyright: ignore[reportCallIssue]
    with pytest.warns(DeprecationWarning, match=r"Fold\.baselines"):
        assert found.folds[0].beside is found.folds[0].baselines
    with pytest.warns(DeprecationWarning, match=r"tuning\.BASELINES"):
        assert tuning.BESIDE == tuning.BASELINES  # pyright: ignore
    with pytest.warns(DeprecationWarning, match=r"tuning\.save"):
        found.folds[0].tuned.save(tmp_path)
    assert (tmp_path / "tuning.json").is_file()
    result = CliRunner().invoke(main, ["tune", str(tmp_path), "--beside=allan", "--no-judge"])
    assert "--beside is now --baselines" in result.output
    assert "--no-judge is now --no-confidence-intervals" in result.output
    assert "got --baselines allan without --folds" in " ".join(result.output.split())


LIMITS = tuning.Limits(sweeps=1, evaluations=12)


@pytest.fixture(scope="module")
def log():
    motion = attitude_runs.free_motion(9, rest_s=6.0)
    return attitude_runs.recording("log", motion, seed=9, duration_s=7.0)


@pytest.fixture(scope="module")
def beside(runs, start, log):
    return tuning.cross_validate(
        runs, start=start, static=log, baselines=tuning.BASELINES[::-1], limits=LIMITS, **OPTIONS
    )


def asked(start):
    return {"start": start, "objective": OPTIONS["objective"], "free": OPTIONS["free"]}


def test_what_is_set_beside_learns_from_the_folds_runs(runs, start, log, found, beside):
    """Would catch a search that sees the held-out run, another problem than the tuner's, own parameters
    that are not found for held-out runs, rows of another variant, or a tuning that is not the same then."""
    for i, fold in enumerate(beside.folds):
        others = runs[:i] + runs[i + 1 :]
        assert same(fold.tuned.params, found.folds[i].tuned.params)
        coordinates = tuning.tune_by_coordinates(others, sweeps=LIMITS.sweeps, **asked(start))
        simplex = tuning.tune_by_nelder_mead(others, evaluations=LIMITS.evaluations, **asked(start))
        assert coordinates.value < coordinates.history[0].value
        assert same(fold.baselines["coordinates"].params, coordinates.params)
        assert same(fold.baselines["nelder-mead"].params, simplex.params)
        model = jaxekf.get_model("loose")
        told = allan_only(model, start, others, log)
        assert same(fold.baselines["allan"].params, told.params)
        assert set(told.taken) >= {"gyroscope", "optical"}
        variants = {"start": start}
        for name, fitted in fold.baselines.items():
            variants[name] = tuning.fit_runs([runs[i]], fitted)[f"run-{i}"]
            assert not np.array_equal(
                variants[name].calibration.alignment, fitted.params.calibration.alignment
            )
        expected = tuning.compare("loose", [runs[i]], variants).rows
        got = [row for row in beside.rows if row.run == f"run-{i}"]
        assert [row.variant for row in got] == ["hold last", "start", *tuning.BASELINES, "tuned"]
        for one, other in zip(got, expected, strict=False):
            np.testing.assert_allclose(one[2:], other[2:], rtol=1e-9)


def test_validation_runs_play_no_part_beside(runs, start, log, beside, monkeypatch):
    """Would catch a search without gradients that looks at a validation run."""
    tuned = [fold.tuned for fold in beside.folds]
    monkeypatch.setattr(cross_validation, "tune", lambda seen, **options: tuned.pop(0))
    again = tuning.cross_validate(
        runs,
        start=start,
        static=log,
        validate=[runs[0].replace(name="judge", imu=runs[1].imu)],
        baselines=["coordinates"],
        limits=LIMITS,
        **OPTIONS,
    )
    for one, other in zip(again.folds, beside.folds, strict=True):
        assert same(one.baselines["coordinates"].params, other.baselines["coordinates"].params)


def test_work_is_counted_apart_from_the_rows(beside, monkeypatch):
    """Would catch work of one fold, a gradient that counts as a value, or a clock that reaches the rows."""
    counts = [fold.baselines["coordinates"].evaluations for fold in beside.folds]
    assert beside.work["coordinates"] == (np.mean(counts), 0.0)
    assert beside.work["nelder-mead"] == (LIMITS.evaluations, 0.0)
    assert beside.work["allan"] == beside.work["start"] == (0.0, 0.0)
    # Likelihood is in the objective, so that nothing is rescaled.
    assert beside.work["tuned"] == (0.0, np.mean([f.tuned.evaluations for f in beside.folds]))
    assert beside.gradient_cost > 1.0
    other = replace(beside, gradient_cost=7.0)
    assert other.forward["tuned"] == 7.0 * beside.work["tuned"].gradients
    assert other.forward["coordinates"] == beside.forward["coordinates"] == np.mean(counts)
    one, told = other.as_dict(), beside.as_dict()
    assert one["work"]["mean"]["tuned"]["forward"] == other.forward["tuned"]
    assert one.pop("work") != told.pop("work")
    assert json.dumps(one) == json.dumps(told)


def test_the_cost_of_a_gradient_is_measured(monkeypatch):
    """Would catch a ratio that is turned over, or written down."""

    class Clock:
        now = 0.0

        def perf_counter(self):
            return self.now

    class Slow:
        start = 0.0

        def value(self, at):
            clock.now += 0.002

        def value_and_gradient(self, at):
            clock.now += 0.010

    clock = Clock()
    monkeypatch.setattr(cost, "time", clock)
    assert cost.gradient_cost(Slow(), seconds=0.1) == pytest.approx(5.0)


def test_the_tuner_counts_what_it_filters_without_a_gradient(runs, start, found, monkeypatch):
    """Would catch Fisher information or validation runs that are free of charge."""
    calls = {"information": 0, "value": 0}

    def information(model, where, free, *given):
        calls["information"] += 1
        known = 1e9 * np.eye(len(free))
        return tuning.Information(where, np.asarray(free), known, np.zeros(len(free)))

    def value(*given):
        calls["value"] += 1
        return 0.0

    monkeypatch.setattr(settling, "information", information)
    monkeypatch.setattr(evaluation, "_value", value)
    monkeypatch.setattr(evaluation, "own_step", lambda model, where, free, *given: free)
    tuned = tuning.tune(
        runs[:2], validate=runs[2:], start=start, confidence_intervals=True, **OPTIONS
    )
    rows = [
        int(objectives.visible_rows(tuning.prepare(tuned.model, part, need_truth=False)))
        for part in (runs[:2], runs[2:])
    ]
    assert calls["information"] == 1
    assert calls["value"] == len(tuned.history)
    # Six numbers are those of one run; two steps on its own three come before it is judged.
    judging = calls["value"] * (1 + 2 * (2 * 3 + 1)) * rows[1] / rows[0]
    assert tuned.filterings == pytest.approx((2 * 6 + 1) + judging)


def test_a_stopped_cross_validation_goes_on(runs, start, log, beside, tmp_path, monkeypatch):
    """Would catch folds or searches that are done again, a fold that begins anew, one that comes back as
    another, and files that stay."""
    file = tmp_path / "state"
    given = {
        "start": start,
        "static": log,
        "baselines": tuning.BASELINES,
        "limits": LIMITS,
    } | OPTIONS
    stages, steps, searches = [], [], []

    def stop(step, total):
        if step.number == 2 and stages[-1] == "fold 2/3":
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        tuning.cross_validate(runs, checkpoint=file, progress=stop, stage=stages.append, **given)
    assert stages[:4] == [*(f"fold 1/3, {name}" for name in tuning.BASELINES), "fold 1/3"]
    kept = sorted(path.name for path in tmp_path.iterdir())
    assert kept == ["state.fold1", "state.fold2", "state.fold2.running"]

    search = derivative_free.Problem.by_coordinates
    monkeypatch.setattr(
        derivative_free.Problem,
        "by_coordinates",
        lambda self, sweeps: searches.append(stages[-1]) or search(self, sweeps),
    )
    stages.clear()
    again = tuning.cross_validate(
        runs,
        checkpoint=file,
        progress=lambda step, total: steps.append((stages[-1], step.number)),
        stage=stages.append,
        **given,
    )
    assert searches == ["fold 3/3, coordinates"]
    assert steps == [("fold 2/3", 2), *(("fold 3/3", i) for i in range(3))]
    for one, other in zip(again.folds, beside.folds, strict=True):
        assert one.held_out == other.held_out
        assert one.work == other.work
        for name in ("params", "each", "start", "free", "fixed"):
            assert same(getattr(one.tuned, name), getattr(other.tuned, name)), name
        for name in ("best", "history"):
            np.testing.assert_array_equal(getattr(one.tuned, name), getattr(other.tuned, name))
        for name in ("stopped", "scale", "layout", "objective"):
            assert getattr(one.tuned, name) == getattr(other.tuned, name), name
        assert one.tuned.origin == other.tuned.origin
    assert [row[:2] for row in again.rows] == [row[:2] for row in beside.rows]
    np.testing.assert_array_equal([row[2:] for row in again.rows], [row[2:] for row in beside.rows])
    with pytest.raises(TuningError, match="the state of another tuning"):
        tuning.cross_validate(runs, checkpoint=file, **given | {"iterations": 2})
    tuning.forget_folds(file)
    assert not list(tmp_path.iterdir())


def resting(name, rest_s, gyroscope_deg, seed):
    grade = attitude_runs.SensorGrade(gyroscope_deg=gyroscope_deg, imu_hz=100.0)
    motion = attitude_runs.free_motion(seed, rest_s=rest_s)
    return attitude_runs.recording(name, motion, seed=seed, duration_s=rest_s + 1.0, grade=grade)


def test_allan_only_pools_rests(log):
    """Would catch a mean of deviations, runs of another length that count alike, a walk made up in a short
    rest, a full matrix that loses what is not told, or a log that does not come first."""
    model = jaxekf.get_model("loose")
    one, two = resting("one", 5.0, 0.01, 1), resting("two", 20.0, 0.04, 2)
    moving = one.replace(name="moving", imu=replace(one.imu, gyroscope=one.imu.gyroscope[::-1]))
    found = allan_only(model, model.parameters, [one, moving, two])
    alone = [jaxekf.calibration.static_noise.static_noise(run) for run in (one, two)]
    square = [rest.imu.gyroscope.white**2 for rest in alone]
    long = [rest.imu.duration_s for rest in alone]
    expected = np.sqrt((long[0] * square[0] + long[1] * square[1]) / sum(long))
    np.testing.assert_allclose(found.params.noise.gyroscope, expected, rtol=1e-12)
    assert np.all(np.deg2rad(0.03) < expected) and np.all(expected < np.deg2rad(0.045))
    walk = allan_only(model, model.parameters, [two]).params.noise.bias_walk
    np.testing.assert_array_equal(found.params.noise.bias_walk, walk)
    assert same(found.params.initial, as_arrays(model.parameters).initial)

    full = tuning.with_axes(model, model.parameters, "full")
    told = allan_only(model, full, [one])
    np.testing.assert_allclose(
        told.params.noise.gyroscope, np.diag(alone[0].imu.gyroscope.white), rtol=1e-12
    )
    blind = log.replace(optical=None)
    both = allan_only(model, model.parameters, [one], blind).params.noise
    rest = jaxekf.calibration.static_noise.static_noise(blind)
    np.testing.assert_allclose(both.gyroscope, rest.imu.gyroscope.white, rtol=1e-12)
    np.testing.assert_allclose(both.optical, alone[0].tracker.optical.value, rtol=1e-12)
    walk = allan_only(model, model.parameters, [], blind).params.noise.bias_walk
    np.testing.assert_array_equal(both.bias_walk, walk)


@pytest.mark.parametrize("told", ["json", "tables"])
def test_command_line_beside(runs, found, beside, tmp_path, monkeypatch, told):
    """Would catch --baselines, --static or --state that do not reach the folds, work that is not shown, and
    folds' files that stay when all is done."""
    seen = {}

    def cross_validate(given, count, **options):
        seen.update(options, count=count)
        (tmp_path / "state.fold1").touch()
        return beside

    monkeypatch.setattr(tuning, "cross_validate", cross_validate)
    monkeypatch.setattr(tuning, "tune", lambda given, **options: found.folds[0].tuned)
    jaxekf.save(runs[0], tmp_path / "run")
    options = "--folds 3 --baselines allan --baselines coordinates --no-confidence-intervals"
    arguments = [tmp_path / "run", *options.split(), "-o", tmp_path / "tuned"]
    arguments += ["--static", tmp_path / "run", "--state", tmp_path / "state"]
    arguments += ["--json"] if told == "json" else []
    result = CliRunner().invoke(main, ["tune", *map(str, arguments)])
    assert result.exit_code == 0, result.output
    assert seen["count"] == 3
    assert seen["baselines"] == ("allan", "coordinates")
    assert seen["static"].name == "run-0"
    assert seen["checkpoint"] == tmp_path / "state"
    assert not (tmp_path / "state.fold1").exists()
    if told == "json":
        got = json.loads(result.stdout)["folds"]["work"]["mean"]
        assert got["coordinates"]["forward"] == beside.forward["coordinates"]
        assert got["tuned"]["forward"] == pytest.approx(beside.forward["tuned"])
        return
    words = [line.split() for line in result.stdout.splitlines()]
    shown = next(row for row in words if row[:2] == ["mean", "coordinates"])
    assert shown[-1] == str(round(beside.forward["coordinates"]))
    assert f"{beside.gradient_cost:.2f}" in result.stderr
    assert "fold" not in result.stderr.replace("folds", "")


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--baselines", "allan"], "without --folds"),
        (["--folds", "all", "--static", "log"], "without --baselines allan"),
        (
            ["--folds", "all", "--baselines", "coordinates", "--static", "log"],
            "without --baselines allan",
        ),
    ],
)
def test_options_that_belong_together(tmp_path, options, words):
    """Would catch an option that does nothing."""
    result = CliRunner().invoke(main, ["tune", str(tmp_path), *options])
    assert result.exit_code == 2
    assert words in " ".join(result.output.split())


def test_the_progress_bar_says_which_fold():
    """Would catch a bar that goes on counting into the next fold, or does not name it."""
    with Progress(disable=True) as bar:
        report = TuningBar(bar, 5)
        report(tuning.Iteration(2, 0.5, float("nan"), False), 5)
        assert (bar.tasks[0].description, bar.tasks[0].completed) == ("tuning: 0.5", 3)
        report.stage("fold 2/5")
        assert (bar.tasks[0].description, bar.tasks[0].completed) == ("fold 2/5", 0)
        report(tuning.Iteration(0, 0.5, 0.25, False), 5)
        assert bar.tasks[0].description == "fold 2/5: 0.5, validation 0.25"
