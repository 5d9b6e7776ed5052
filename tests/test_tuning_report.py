"""The record of a tuning and the report of it: numbers, warnings and figures are the tuning's own."""

import copy
import json
import shutil
from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import plotly.graph_objects as go
import pytest
from click.testing import CliRunner
from test_report import Reader
from test_report_browser import BROWSER, dom

import jaxekf
import tuning
from jaxekf._support.errors import RecordingError, TuningError
from jaxekf.cli import main
from jaxekf.estimation.parameters import as_arrays
from jaxekf.io.documents import codec
from jaxekf.io.documents.tuning import Step, TuningDocument
from jaxekf.reporting.report import _tuned as saved
from jaxekf.reporting.report import _tuning_figures as tuning_figures
from jaxekf.reporting.report import write_report
from jaxekf.simulation import attitude_runs
from tuning.objective.fisher_information import Information
from tuning.persistence import _tuning_warnings as tuning_warnings
from tuning.persistence.tuning_document import record
from tuning.results.comparison import as_dicts
from tuning.results.tuned import Iteration, Outcome

NAME = 'free <b>&"5"'
COLUMNS = (
    "attitude_rmse_deg",
    "rate_rmse_deg_s",
    "nis",
    "nees",
    "position_rmse_mm",
    "position_nees",
)


def call(*arguments):
    return CliRunner().invoke(main, [str(a) for a in arguments])


@pytest.fixture(scope="module")
def runs():
    return [
        attitude_runs.recording(
            f"run-{i}", attitude_runs.free_motion(i, rest_s=0.2), seed=i, duration_s=3.0
        )
        for i in range(3)
    ]


@pytest.fixture(scope="module")
def short(runs):
    """A tuning that ends early, of the plainest kind."""
    return tuning.tune(runs[:1], iterations=2, rescale=False)


@pytest.fixture(scope="module")
def found():
    """A tuning with bounds, own parameters, a common scale, intervals and numbers left open, as `tune`
    would put it together."""
    model = jaxekf.get_model("loose")
    start = as_arrays(model.parameters)
    free = [
        "noise",
        tuning.Free("noise.optical", bounds=(1e-3, 0.02)),
        tuning.Free("calibration.alignment", each_run=True),
    ]
    where = tuning.layout(model, start, free, 2)
    labels = where.labels()
    fixed = np.array([label == "noise.bias_walk" for label in labels])
    best = np.asarray(where.to_free(start)) + np.where(fixed, 0.0, 0.1 * np.arange(len(labels)))
    params = tuning.scaled(where.from_free(jnp.asarray(best), start), 4.0)
    known = Information(where, best, 1e4 * np.eye(len(labels)), np.zeros(len(labels)))
    names = ["run-0", "run-1"]
    history = (Iteration(0, 2.0, 3.0, False), Iteration(1, float("nan"), float("nan"), True))
    history += (Iteration(2, 1.0, 2.0, False),)
    return tuning.Tuned(
        model=model,
        params=where.together(params),
        start=start,
        objective=tuning.attitude_error(),
        best=history[2],
        history=history,
        stopped="converged",
        scale=4.0,
        layout=where,
        origin={"runs": names, "validation_runs": ["run-2"], "versions": {"jax": "1"}},
        each={name: where.one_run(params, i) for i, name in enumerate(names)},
        free=best,
        information=known,
        fixed=fixed,
        evaluations=3,
        starts=(Outcome(2.0, 3, "converged"), Outcome(float("inf"), 0, "it could not begin")),
    )


@pytest.fixture(scope="module")
def rows():
    """As `compare` makes them."""
    held = tuning.Row("run-2", "hold last", 9.0, 3.0, float("nan"), float("nan"))
    return [held, *(tuning.Row("run-2", name, 0.3, 0.9, 1.0, 1.0) for name in ("start", "tuned"))]


def row(run, variant, *values):
    return {"run": run, "variant": variant} | dict(zip(COLUMNS, values, strict=True))


def number(name, **changes):
    plain = {
        "label": name,
        "name": name,
        "run": None,
        "truth": False,
        "unit": "rad",
        "logarithm": True,
        "start": 0.01,
        "tuned": 0.04,
        "searched": 0.02,
        "interval": [0.03, 0.06],
        "moved": "x 4",
        "change": 4.0,
        "left_open": False,
        "would_tell": None,
        "bounds": None,
    }
    return plain | changes


def step(index, training, validation, rejected=False):
    return {
        "number": index,
        "training": training,
        "validation": validation,
        "rejected": rejected,
    }


def plain():
    """A record against which nothing speaks."""
    compared = [
        row(NAME, "hold last", 9.0, 3.0, None, None, None, None),
        row(NAME, "start", 0.4, 1.0, 0.2, 1.5, None, None),
        row(NAME, "tuned", 0.2, 0.9, 0.9, 1.1, None, None),
        row("other", "start", 0.6, 1.2, 0.2, 1.5, None, None),
        row("other", "tuned", 0.4, 1.1, 0.9, 0.9, None, None),
    ]
    shift = number("calibration.clock_offset", logarithm=False, unit="s", start=0.0, tuned=0.001)
    shift |= {"interval": None, "searched": 0.001, "moved": "+0.02 prior sigma", "change": 0.02}
    return {
        "schema_version": 1,
        "kind": "jaxekf tuning",
        "model": "loose",
        "objective": "1 * mean squared attitude error",
        "errors": ["attitude"],
        "runs": ["a", "b"],
        "validation_runs": [NAME, "other"],
        "date": "2026-01-02",
        "provenance": {"versions": {"jaxekf": "9.9"}, "free": ["noise.optical"]},
        "stopped": "converged",
        "evaluations": 4,
        "rejected_steps": 0,
        "covariance_scale": 4.0,
        "best_iteration": 2,
        "starts": [],
        "history": [step(0, 3.0, 4.0), step(1, 2.0, 3.5), step(2, 1.0, 1.5), step(3, 0.9, 1.75)],
        "numbers": [number("noise.optical"), shift],
        "units": {"noise.optical": "rad", "calibration.clock_offset": "s"},
        "truth": None,
        "judged_on": "validation runs",
        "rows": compared,
        "folds": None,
        "warnings": [],
    }


def folds():
    told = {"start": 0.01, "mean": 0.02, "deviation": None, "each": [0.019, 0.021]}
    alignment = {"start": [0.0] * 3, "mean": [0.01, 0.02, 0.03], "deviation": [0.001] * 3}
    return {
        "rows": [
            row("a", "start", 0.4, 1.0, 0.2, 1.5, 3.25, 1.0),
            row("a", "tuned", 0.3, 0.9, 0.9, 1.1, 1.25, 1.0),
            row("a", "tuned, pooled", 0.35, 0.9, 0.9, 1.1, None, None),
            row("b", "start", 0.4, 1.0, 0.2, 1.5, 2.0, 1.0),
            row("b", "tuned", 0.31, 0.9, 0.9, 1.1, 1.0, 1.0),
            row("b", "tuned, pooled", 0.35, 0.9, 0.9, 1.1, None, None),
        ],
        "held_out": [["a"], ["b"]],
        "parameters": {"noise.optical": told, "calibration.alignment": alignment},
    }


def typed(document=None):
    """A record as it is read."""
    return codec.convert(document or plain(), TuningDocument)


def steps(history):
    return codec.convert(history, list[Step])


def write(folder, document):
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "tuning.json").write_text(json.dumps(document), "utf-8")
    return folder


def test_the_record_is_the_tuning(found, rows, tmp_path):
    """Would catch a number that is not the tuning's, NaN in JSON, or a value that the files do not hold."""
    tuning.save(found, tmp_path, rows=rows)
    text = (tmp_path / "tuning.json").read_text("utf-8")
    told = json.loads(text, parse_constant=pytest.fail)
    assert told == record(found, rows=rows)
    assert told["runs"] == ["run-0", "run-1"] and told["validation_runs"] == ["run-2"]
    assert told["judged_on"] == "validation runs" and told["rows"] == as_dicts(rows)
    assert told["history"][2] == step(2, 1.0, 2.0)
    assert told["history"][1] == step(1, None, None, True) and told["rejected_steps"] == 1
    assert told["starts"][1] == {"value": None, "iterations": 0, "ending": "it could not begin"}
    assert told["best_iteration"] == 2 and told["evaluations"] == 3
    assert told["provenance"]["versions"] == {"jax": "1"}
    numbers = {n["label"]: n for n in told["numbers"]}
    assert list(numbers) == found.layout.labels()
    assert [n["moved"] for n in told["numbers"]] == found.moved
    for label, (value, low, high) in found.intervals.items():
        assert numbers[label]["tuned"] == pytest.approx(value, rel=1e-12)
        assert numbers[label]["interval"] == pytest.approx([low, high], rel=1e-12)
    for label, motion in found.open.items():
        assert numbers[label]["left_open"] and numbers[label]["would_tell"] == motion
        assert numbers[label]["interval"] is None
    assert found.open and set(numbers) == set(found.open) | set(found.intervals)
    optical = numbers["noise.optical"]
    assert optical["bounds"] == pytest.approx([1e-3, 0.02])
    assert optical["start"] == pytest.approx(float(found.start.noise.optical))
    read = jaxekf.load_parameters(found.model, tmp_path)
    assert optical["tuned"] == pytest.approx(float(read.noise.optical), rel=1e-9)
    # In one scale with the interval, and with the change.
    assert optical["tuned"] / optical["searched"] == pytest.approx(np.sqrt(found.scale))
    assert optical["change"] == pytest.approx(optical["tuned"] / optical["start"])
    own = [n for n in told["numbers"] if n["name"] == "calibration.alignment[1]"]
    assert [n["run"] for n in own] == ["run-0", "run-1"]
    expected = [float(found.each[n["run"]].calibration.alignment[1]) for n in own]
    assert [n["tuned"] for n in own] == pytest.approx(expected, rel=1e-9)


def test_how_far_a_bounded_number_moved(found):
    """Would catch the move of what stands before the bounds, which goes to infinity at them."""
    at = found.layout.labels().index("noise.optical")
    free = found.free.copy()
    free[at] += 30.0
    far = replace(found, free=free)
    told = next(n for n in record(far)["numbers"] if n["name"] == "noise.optical")
    assert told["searched"] == pytest.approx(0.02, rel=1e-3)
    assert told["moved"] == far.moved[at] == f"x {0.04 / float(found.start.noise.optical):.3g}"
    assert any("at its upper bound" in sentence for sentence in record(far)["warnings"])


def test_rows_of_other_runs_than_said_are_refused(found, rows, tmp_path):
    """Would catch training runs that pass for held-out ones, or half a folder."""
    with pytest.raises(TuningError, match="expected 'validation runs'"):
        tuning.save(found, tmp_path / "tuned", rows=rows, judged_on="training runs")
    assert not (tmp_path / "tuned").exists()
    for name, kind in (("run-0", "training runs"), ("else", "other runs")):
        assert record(found, rows=[rows[0]._replace(run=name)])["judged_on"] == kind


def test_what_the_tuner_says_is_understood(short, tmp_path):
    """Would catch words of the tuner that the warnings no longer know, or a save without rows."""
    tuning.save(short, tmp_path)
    told = json.loads((tmp_path / "tuning.json").read_text("utf-8"))
    assert told["rows"] == [] and told["judged_on"] is None and told["folds"] is None
    assert [n["left_open"] for n in told["numbers"]] == [False] * len(told["numbers"])
    assert told["warnings"][0].startswith(
        "No run was held out: the tuning was validated on the training"
    )
    assert told["warnings"][1] == f"The search did not converge: {short.stopped}; ask for more"
    stopped = replace(short, stopped="interrupted; the best so far is kept")
    assert any("converge: interrupted" in sentence for sentence in record(stopped)["warnings"])
    assert write_report([tmp_path], tmp_path / "r.html").tunings[0].warnings == told["warnings"]


def opened(document):
    document["numbers"][0] |= {"left_open": True, "would_tell": "turning about two axes"}


def held_by_folds(document):
    document["validation_runs"], document["judged_on"] = [], "training runs"
    document["folds"] = folds()
    document["units"]["calibration.alignment"] = "rad"


def alone(document):
    document["validation_runs"], document["judged_on"] = [], "training runs"


def change(place, **changes):
    def spoil(document):
        document["numbers"][place] |= changes

    return spoil


def compared(place, **changes):
    def spoil(document):
        document["rows"][place] |= changes

    return spoil


def worse_fold(document):
    held_by_folds(document)
    document["folds"]["rows"][1] |= {"attitude_rmse_deg": 0.41, "nees": 0.4}


@pytest.mark.parametrize(
    ("spoil", "words"),
    [
        (lambda d: None, []),
        (
            opened,
            [
                "not determine noise.optical, so that it keeps its initial value: turning about two axes"
            ],
        ),
        (change(0, change=9.9), []),
        (change(0, change=10.1), ["noise.optical moved by more than a factor of 10"]),
        (change(0, change=0.09, run="a"), ["noise.optical of a moved by more than a factor"]),
        (change(1, change=2.9), []),
        (change(1, change=-3.1), ["clock_offset moved by more than 3 deviations of its prior"]),
        (change(0, bounds=[0.001, 0.05]), []),
        (
            change(0, bounds=[0.001, 0.0201], tuned=0.02),
            ["noise.optical is at its upper bound (0.0201 rad)"],
        ),
        (change(1, bounds=[0.0009, 0.1]), ["clock_offset is at its lower bound (0.0009 s)"]),
        (change(1, bounds=[-0.001, 0.1]), []),
        # A number of a wide interval that stayed where it began is not drawn to a bound.
        (change(1, bounds=[1.0, 1e6], start=100.0, tuned=100.0, searched=100.0), []),
        (
            change(0, bounds=[0.001, 0.03], tuned=0.04),
            ["scale of all covariances (4) took noise.optical past the bounds"],
        ),
        (
            lambda d: d.update(also_scaled=["noise.gyroscope"]),
            ["(4) also holds for noise.gyroscope, not free"],
        ),
        (lambda d: d.update(rejected_steps=1), ["1 step was not finite"]),
        (lambda d: d.update(accepted={"optical": [95, 100]}), []),
        (
            lambda d: d.update(accepted={"optical": [17, 100], "markers": [99, 100]}),
            ["used only a part of the samples (optical: 17 %), since gates rejected"],
        ),
        (
            lambda d: d.update(accepted={"optical": [17, 100]}, gates_off=True),
            ["gates accept only a part of the samples (optical: 17 %); they were off"],
        ),
        (
            lambda d: d.update(accepted={"optical": [99, 100]}, gates_off=True),
            ["Gates rejected over 10 % of a sensor's samples at the start"],
        ),
        (
            change(0, interval=[0.0, 0.05]),
            ["no lower limit to noise.optical: 0 to 0.05 rad (95 %)"],
        ),
        (change(0, interval=[0.03, None]), ["no upper limit to noise.optical: 0.03 rad or more"]),
        (change(1, interval=[-0.001, 0.002]), []),
        (lambda d: d.update(stopped="the 9 iterations asked for are done"), ["ask for more"]),
        (lambda d: d.update(stopped="no improvement in 15 iterations"), []),
        (alone, ["No run was held out: the tuning was compared on the training runs themselves"]),
        (held_by_folds, []),
        (lambda d: d.update(validation_runs=[], judged_on="other runs"), []),
        (compared(2, nees=2.1), [f"outside 0.5 to 2 in {NAME}: 2.1 (held out)"]),
        (compared(2, nees=0.45), [f"outside 0.5 to 2 in {NAME}: 0.45"]),
        (compared(1, nees=7.0), []),
        (compared(2, nees=None), []),
        (compared(2, attitude_rmse_deg=0.403), []),
        (
            compared(4, attitude_rmse_deg=0.612),
            ["other (held out) got worse: its attitude RMSE is"],
        ),
        (compared(4, rate_rmse_deg_s=1.3), []),
        (
            lambda d: d.update(errors=["rate"]) or compared(4, rate_rmse_deg_s=1.3)(d),
            ["its rate RMSE is 1.3 deg/s, 8.33 % more"],
        ),
        (worse_fold, ["a (held out by its fold) got worse", "in a: 0.4 (held out by its fold)"]),
    ],
)
def test_warnings_appear_when_they_should_and_only_then(spoil, words):
    """Would catch a warning that never comes, comes always, or names another number, run or limit."""
    document = plain()
    spoil(document)
    told = tuning_warnings.cautions(document)
    assert len(told) == len(words)
    for sentence, part in zip(told, words, strict=True):
        assert part in sentence


def test_training_runs_are_not_blamed_for_their_nees():
    """Would catch a warning on held-out runs where none was."""
    document = plain()
    alone(document)
    document["rows"][2]["nees"] = 9.0
    assert len(tuning_warnings.cautions(document)) == 1


@pytest.fixture(scope="module")
def shown(runs, tmp_path_factory):
    """A page of two tunings and a result, named in a mixed order and one of them twice."""
    folder = tmp_path_factory.mktemp("page")
    jaxekf.estimate(runs[0]).save(folder / "result")
    write(folder / NAME, plain())
    other = plain()
    held_by_folds(other)
    other |= {"truth": {"alignment": {"value": [0.1, 0.0, 0.0], "unit": "rad"}}}
    other["warnings"] = ["A warning </script><script>throw 1</script>", "Another one"]
    other["covariance_scale"] = 1.0
    other["starts"] = [{"value": None, "iterations": 0, "ending": "lost"}]
    other["starts"] += [{"value": 1.5, "iterations": 7, "ending": "won"}]
    write(folder / "tuned", other)
    given = [folder / "tuned", folder / "result", folder / NAME, folder / "result" / ".." / "tuned"]
    made = call("report", *given, folder / "result", "-o", folder / "r.html", "--json")
    assert made.exit_code == 0, made.output
    return folder / "r.html", json.loads(made.stdout)


@pytest.fixture(scope="module")
def read(shown):
    return Reader(shown[0])


def test_each_folder_is_shown_once(shown, read):
    """Would catch a folder named twice and shown twice, or tunings and runs mixed up."""
    assert [each["name"] for each in shown[1]["tunings"]] == ["tuned", NAME]
    assert [run["name"] for run in shown[1]["runs"]] == ["run-0"]
    assert shown[1]["tunings"][0]["warnings"][1] == "Another one"
    sections = [a["id"] for a in read.attributes if a.get("id", "").count("-") == 1]
    assert sections == ["tuning-1", "tuning-2", "run-1"]
    text = " ".join(read.text)
    assert "2 tunings, 1 run. " in text and text.index("Tuning: tuned") < text.rindex("run-0")


def test_what_stands_in_the_tables(read):
    """Would catch radians called degrees, a start that is the tuned value, a lost variant, or markup."""
    text = "|".join(t for t in read.text if t.strip())
    assert "A warning </script><script>throw 1</script>" in text and "b" not in read.tags
    # start, tuned, interval, unit and move, in degrees
    assert "noise.optical|0.57296|2.2918|1.7189|3.4377|deg|× 4" in text
    assert "calibration.clock_offset|0|0.001|–|–|s|+0.02 σ of the prior" in text
    assert "as given|–|0|lost|drawn 1|1.5|7|won" in text
    assert "validation runs (held out)" in text
    assert "the training runs themselves (not held out)" in text
    assert f"{NAME}|start|0.400|1.000|0.200|1.500|" in text
    assert "mean|start|0.500|1.100|0.200|1.500" in text
    assert "worst|tuned|0.400|1.100|0.900|0.900" in text
    assert "deviation|tuned|0.141|0.141|0.000|0.141" in text
    assert "a|tuned, pooled|0.350|0.900|–|0.900|1.100|–" in text
    assert "noise.optical|0.573|1.146|–|deg" in text
    assert "calibration.alignment[2]|0|1.719|0.0573|deg" in text
    assert "alignment|5.73  0  0|deg" in text
    # The overview takes the numbers of runs that were not learnt from, where there are any.
    assert "loose|2 runs|0.400|0.305|1.000|0.900|2.625|1.125|0.200|0.900|1.500|1.100" in text
    assert "0.500|0.300|1.100|1.000|–|–|0.200|0.900|1.500|1.000" in text
    assert (
        "|1.000|1.000|2 runs held out by folds|" in text
        and "|2 validation runs|no warnings" in text
    )


def test_warnings_stand_before_everything_else(shown):
    """Would catch warnings below the fold."""
    page = shown[0].read_text("utf-8")
    section = page[page.index('<section id="tuning-1">') :]
    assert section.index("Another one") < section.index("<figure>")


def test_figures_are_what_plotly_takes(read):
    """Would catch a figure that is left out, an option Plotly has not, an axis without a title, or NaN."""
    tunings = {name for name in read.figures if name.startswith("tuning")}
    kinds = ("search", "compared", "folds", "intervals")
    assert tunings == {f"tuning-1-{kind}-data" for kind in kinds} | {
        f"tuning-2-{kind}-data" for kind in kinds if kind != "folds"
    }
    for name in tunings:
        document = read.figures[name]
        go.Figure(document)
        for trace in document["data"]:
            assert len(trace["y"]) == len(trace["x"])
        titles = [
            v["title"]["text"] for k, v in document["layout"].items() if k.startswith("yaxis")
        ]
        assert all(titles) or "intervals" in name
    groups = [a["data-run"] for a in read.attributes if a.get("class") == "plot"]
    assert len(groups) == len(set(groups)) + groups.count("1") - 1


def test_the_search_as_it_was():
    """Would catch training and validation exchanged, another best, or a rejected step drawn as a value."""
    history = [*plain()["history"], step(4, None, None, True), step(5, 5000.0, 1.6)]
    figure = tuning_figures.search(steps(history), 2)
    assert figure is not None
    traces = {(t["name"], t["yaxis"]): t for t in figure.document["data"]}
    assert traces["training", "y"]["y"] == [3.0, 2.0, 1.0, 0.9, None, 5000.0]
    assert traces["validation", "y2"]["y"] == [4.0, 3.5, 1.5, 1.75, None, 1.6]
    assert traces["best: iteration 2", "y2"]["y"] == [1.5]
    assert (traces["rejected", "y"]["x"], traces["rejected", "y"]["y"]) == ([4], [0.9])
    layout = figure.document["layout"]
    assert layout["yaxis"]["type"] == "log" and "type" not in layout["yaxis2"]
    assert layout["xaxis"]["title"]["text"] == "iteration"
    none = [step(0, None, None, True)]
    assert tuning_figures.search(steps(none), 0) is None
    for value in history:
        value["validation"] = None
    alone = tuning_figures.search(steps(history), 2)
    assert alone is not None and "yaxis2" not in alone.document["layout"]


def test_a_step_far_astray_does_not_flatten_the_rest():
    """Would catch a curve in which nothing is seen beside one wild trial of a likelihood."""
    values = [-1.0, -2.0, 900.0, -3.0]
    figure = tuning_figures.search(steps([step(i, v, None) for i, v in enumerate(values)]), 3)
    assert figure is not None
    low, high = figure.document["layout"]["yaxis"]["range"]
    assert low < -3.0 and -1.0 < high < 10.0
    assert "Values above the range shown: 1." in figure.caption


def test_before_and_after_in_their_units():
    """Would catch dots of another run or column, or a name that Plotly takes for markup."""
    figure = tuning_figures.compared(
        "folds", "Folds", typed(plain() | {"folds": folds()}).folds.rows
    )
    assert figure is not None
    layout = figure.document["layout"]
    titles = [layout[f"yaxis{i}"]["title"]["text"] for i in ("", 2, 3, 4, 5, 6)]
    assert titles[:3] == ["attitude RMSE (deg)", "rate RMSE (deg/s)", "position RMSE (mm)"]
    traces = {(t.get("name"), t["yaxis"]): t for t in figure.document["data"]}
    assert traces["tuned", "y3"]["y"] == [1.25, 1.0] and traces["tuned", "y3"]["xaxis"] == "x"
    assert traces["tuned, pooled", "y3"]["y"] == [None, None]
    shown_once = [t["name"] for t in figure.document["data"] if t.get("showlegend")]
    assert sorted(shown_once) == ["start", "tuned", "tuned, pooled"]
    named = tuning_figures.compared("compared", "", typed().rows)
    assert named is not None
    assert named.document["layout"]["xaxis"]["ticktext"][0] == 'free &lt;b&gt;&amp;"5"'
    assert "hold last" not in {t.get("name") for t in named.document["data"]}


def test_intervals_are_multiples_of_the_start():
    """Would catch an interval about zero, by the tuned value, or of a number that is no logarithm."""
    figure = tuning_figures.intervals(typed().numbers)
    assert figure is not None
    (trace,) = figure.document["data"]
    assert trace["x"] == pytest.approx([4.0])
    assert trace["error_x"]["array"] == pytest.approx([2.0])
    assert trace["error_x"]["arrayminus"] == pytest.approx([1.0])
    assert tuning_figures.intervals(typed().numbers[1:]) is None
    assert tuning_figures.intervals(typed().numbers[:1] * 100) is None


def test_only_a_tuning(tmp_path):
    """Would catch an overview of runs where there are none, or a page that speaks of bands."""
    page = write_report([write(tmp_path / "tuned", plain())], tmp_path / "r.html").path
    text = " ".join(Reader(page).text)
    assert "1 tuning. Drag to zoom, double-click to go back." in text
    assert "Bands" not in text and "NIS tracker" not in text


def without(*keys):
    def spoil(document):
        inner = document
        for key in keys[:-1]:
            inner = inner[key]
        del inner[keys[-1]]

    return spoil


@pytest.mark.parametrize(
    ("spoil", "words"),
    [
        (lambda d: d.update(schema_version=2), "schema_version 2, expected 1"),
        (without("schema_version"), "schema_version None"),
        (without("numbers"), "tuning.json:numbers: got nothing"),
        (without("numbers", 1, "unit"), "tuning.json:numbers[1].unit: got nothing"),
        (without("history", 0, "rejected"), "history[0].rejected: got nothing"),
        (lambda d: d["rows"][2].update(nees="1"), "rows[2].nees: got str"),
        (
            lambda d: d["numbers"][0].update(interval=[1.0]),
            "numbers[0].interval: got 1, expected array of length 2",
        ),
        (
            lambda d: d.update(folds=folds() | {"parameters": {"a": {"start": 1}}}),
            "folds.parameters[...].mean: got nothing",
        ),
        (lambda d: d.update(warnings="none"), "warnings: got str, expected array"),
        (lambda d: d.update(covariance_scale=float("nan")), "NaN"),
        (lambda d: d.update(covariance_scale=float("inf")), "Infinity"),
    ],
)
def test_a_broken_record_is_said_in_one_sentence(tmp_path, spoil, words):
    """Would catch a traceback, half a page, or a record of another version taken for this one's."""
    document = copy.deepcopy(plain())
    spoil(document)
    folder = write(tmp_path / "tuned", document)
    made = call("report", folder, "-o", tmp_path / "r.html")
    assert made.exit_code == 1 and words in made.output and "tuning.json" in made.output
    assert "tuning again" in made.output and len(made.output.strip().splitlines()) == 1
    assert not (tmp_path / "r.html").exists()


def test_text_that_is_no_record(tmp_path):
    """Would catch a traceback where a sentence with the file and what to do is due."""
    folder = write(tmp_path / "tuned", [])
    for text, words in (
        ("{", "not JSON"),
        ("[]", "schema_version None"),
        ("[" * 99999, "not JSON"),
    ):
        (folder / "tuning.json").write_text(text)
        made = call("report", folder, "-o", tmp_path / "r.html")
        assert made.exit_code == 1 and words in made.output and "tuning.json" in made.output
    (folder / "tuning.json").unlink()
    with pytest.raises(RecordingError, match=r"tuning\.json: got no such file"):
        saved.read_tuning(folder)
    (folder / "noise.toml").write_text("")
    made = call("report", folder, "-o", tmp_path / "r.html")
    assert "without result.json or tuning.json" in made.output and "tuning again" in made.output


def test_jaxekf_tune_writes_what_the_report_shows(runs, found, rows, tmp_path, monkeypatch):
    """Would catch a command whose record lacks the rows, or tells training runs as held out."""

    def compare(model, given, variants, *, smooth):
        told = [r._replace(run=run.name) for run in given for r in rows]
        return tuning.Comparison(told, {}, given)

    monkeypatch.setattr(tuning, "tune", lambda *a, **k: found)
    monkeypatch.setattr(tuning, "fit_runs", lambda *a, **k: {})
    monkeypatch.setattr(tuning, "compare", compare)
    paths = [jaxekf.save(run, tmp_path / run.name) for run in runs]
    for name, held in (("held", ["--validate", paths[2]]), ("seen", [])):
        made = call("tune", *paths[:2], *held, "-o", tmp_path / name, "--json")
        assert made.exit_code == 0, made.output
        told = json.loads((tmp_path / name / "tuning.json").read_text("utf-8"))
        assert told["rows"] == json.loads(made.stdout)["rows"]
        assert {r["run"] for r in told["rows"]} == ({"run-2"} if held else {"run-0", "run-1"})
        assert told["judged_on"] == ("validation runs" if held else "training runs")
    page = call("report", tmp_path / "held", tmp_path / "seen", "-o", tmp_path / "r.html")
    assert page.exit_code == 0, page.output


@pytest.mark.skipif(BROWSER is None, reason="There is no Chromium here.")
def test_a_browser_draws_it(shown, tmp_path):
    """Would catch a script error, a figure that is not drawn, or a request."""
    folder = tmp_path / "profile"
    small = shutil.copy(shown[0], tmp_path / "page.html")
    page, states, console = dom(small, folder)
    assert states == {"errors": "0", "blocked": "0", "drawn": "11", "ready": "true"}, console
    assert console == []
    assert all('<svg class="main-svg"' in text for text in page.split("<figure>")[1:])
