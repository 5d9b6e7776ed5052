"""The report: one page without network, in which every number and every gap is the result's own."""

import json
import shutil
from dataclasses import replace
from html.parser import HTMLParser
from itertools import pairwise
from pathlib import Path

import numpy as np
import plotly.graph_objects as go
import pytest
from click.testing import CliRunner

import jaxekf
from jaxekf.cli import main
from jaxekf.estimation.result import OutputEstimate
from jaxekf.recordings.types import Encoder, Recording
from jaxekf.reporting.report import _consistency as consistency
from jaxekf.reporting.report import _figures as figures
from jaxekf.reporting.report import _thinning as thinning
from jaxekf.reporting.report import write_report
from jaxekf.reporting.report._comparison import compare
from jaxekf.reporting.report._saved import read_result
from jaxekf.simulation import demo

NAME = 'free <b>&"5"'
NOTE = 'a note </script><script>throw 1</script> & "so on"'
HOLE_S = (20.0, 21.0)
"""In which the encoder tells nothing."""


def call(*arguments):
    return CliRunner().invoke(main, [str(a) for a in arguments])


@pytest.fixture(scope="module")
def estimated(tmp_path_factory):
    """Recording, result folder and `jaxekf estimate --json` of a run with an awkward name and a hole in its
    truth."""
    folder = tmp_path_factory.mktemp("report")
    record = jaxekf.load(demo.FOLDER / "free-5")
    encoder = record.need_encoder()
    t = (encoder.time_ns - record.need_optical().time_ns[0]) / 1e9
    told = replace(encoder, valid=encoder.valid & ~((t > HOLE_S[0]) & (t < HOLE_S[1])))
    path = jaxekf.save(record.replace(name=NAME, encoder=told), folder / "run")
    made = call("estimate", path, "-o", folder / "result", "--json")
    assert made.exit_code == 0, made.output
    result = folder / "result" / NAME
    document = json.loads((result / "result.json").read_text())
    document["notes"].append(NOTE)
    (result / "result.json").write_text(json.dumps(document))
    return path, result, json.loads(made.stdout)["runs"][0]


@pytest.fixture(scope="module")
def bare(estimated, tmp_path_factory):
    """The same result without diagnosis, its recording gone."""
    folder = shutil.copytree(estimated[1], tmp_path_factory.mktemp("bare") / "result")
    document = json.loads((folder / "result.json").read_text())
    del document["diagnosis"]
    document["provenance"]["recording"] = "gone/with the <wind>"
    (folder / "result.json").write_text(json.dumps(document))
    return folder


@pytest.fixture(scope="module")
def page(estimated, bare, tmp_path_factory):
    """A report of both, and what the command said of it."""
    file = tmp_path_factory.mktemp("page") / "report.html"
    result = call("report", estimated[1], bare, "-o", file, "--json")
    assert result.exit_code == 0, result.output
    return file, json.loads(result.stdout)


class Reader(HTMLParser):
    """Elements, text and figures of a page, and whether its tags close."""

    VOID = ("meta", "br")

    def __init__(self, file):
        super().__init__()
        self.open, self.attributes, self.text = [], [], []
        self.figures, self.tags, self._script = {}, [], None
        self.feed(file.read_text("utf-8"))
        assert self.open == []

    def handle_starttag(self, tag, attrs):
        found = dict(attrs)
        self.tags.append(tag)
        self.attributes.append(found)
        self._script = found.get("id") if tag == "script" else None
        if tag not in self.VOID:
            self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        if self._script and self.open[-1] == "script":
            self.figures[self._script] = json.loads(data, parse_constant=pytest.fail)
        elif self.open and self.open[-1] not in ("script", "style"):
            self.text.append(data)


@pytest.fixture(scope="module")
def read(page):
    return Reader(page[0])


def test_nothing_comes_from_elsewhere(page, read):
    """Would catch a file that needs the network, a dead link, or one too large to send."""
    assert page[0].stat().st_size == page[1]["bytes"] <= 8_000_000
    identities = [a["id"] for a in read.attributes if "id" in a]
    assert len(identities) == len(set(identities))
    for found in read.attributes:
        assert not {"src", "srcset", "action", "data", "poster"} & found.keys()
        if "href" in found:
            assert found["href"].startswith("#") and found["href"][1:] in identities
    assert "link" not in read.tags and "iframe" not in read.tags
    policies = [a["content"] for a in read.attributes if "http-equiv" in a]
    assert len(policies) == 1 and policies[0].startswith("default-src 'none'; script-src 'uns")
    styles = page[0].read_text("utf-8").split("</style>")[0]
    assert "url(" not in styles and "@import" not in styles


def test_names_and_notes_are_text(read):
    """Would catch a run's name or note that becomes markup, or ends a script."""
    text = "\n".join(read.text)
    assert NAME in text and NOTE in text and "gone/with the <wind>" in text
    assert "b" not in read.tags


def test_figures_are_what_plotly_takes(read):
    """Would catch a figure that is left out, an option Plotly has not, lengths that differ, or NaN."""
    both = {f"run-{i}-{name}-data" for i in (1, 2) for name in ("attitude", "rate", "bias")}
    assert set(read.figures) == both | {
        "run-1-innovations-data",
        "run-2-innovations-data",
        "run-1-errors-data",
    }
    plots = [a for a in read.attributes if a.get("class") == "plot"]
    assert {f"{a['id']}-data" for a in plots} == set(read.figures)
    for document in read.figures.values():
        go.Figure(document)
        for trace in document["data"]:
            count = len(trace["x"])
            assert len(trace["y"]) == count and len(trace.get("customdata", trace["x"])) == count
            assert all(v is None or np.isfinite(v) for v in trace["y"])
            assert count <= 1 or None not in trace["x"]


def test_the_table_holds_the_scores(estimated, page, read):
    """Would catch a number that `jaxekf estimate` does not report, or before and after mixed up."""
    first, second = page[1]["runs"]
    score = estimated[2]["score"]
    for name in ("attitude_rmse_deg", "rate_rmse_deg_s", "attitude_nees"):
        assert first[name] == pytest.approx(score[name], rel=1e-6)
        assert second[name] is None
    assert first["held_attitude_deg"] == pytest.approx(estimated[2]["hold_last_deg"], rel=1e-6)
    assert first["verdicts"] and "no diagnosis" in second["verdicts"][0]
    for value in (first["attitude_rmse_deg"], first["held_attitude_deg"]):
        assert f"{value:.3f}" in read.text
    for words in ("Account of samples", "masked", "noise.optical", "deg/s/√Hz", "jaxlib"):
        assert any(words in text for text in read.text), words


def named(document, name, axis="yaxis"):
    return [t for t in document["data"] if t["name"] == name and axis in t]


def test_what_is_not_known_is_a_gap(estimated, read):
    """Would catch a line across a hole of the truth, a tracker sample while it is hidden, or no shading."""
    document = read.figures["run-1-attitude-data"]
    inside = 0
    for trace in named(document, "encoder"):
        holes = [t for t, y in zip(trace["x"], trace["y"], strict=True) if y is None]
        assert any(HOLE_S[0] < t < HOLE_S[1] for t in holes)
        known = [t for t, y in zip(trace["x"], trace["y"], strict=True) if y is not None]
        inside += sum(HOLE_S[0] + 0.1 < t < HOLE_S[1] - 0.1 for t in known)
    assert inside == 0
    optical = jaxekf.load(estimated[0]).need_optical()
    seen = (optical.time_ns[optical.valid] - optical.time_ns[0]) / 1e9
    gaps = [(a, b) for a, b in pairwise(seen) if b - a > 0.1]
    assert len(gaps) == 3
    shades = {(s["x0"], s["x1"]) for s in document["layout"]["shapes"] if s["yref"] == "paper"}
    for begin, end in gaps:
        assert (round(begin, 3), round(end, 3)) in shades
        for trace in named(document, "tracker"):
            assert not any(begin + 1e-3 < t < end - 1e-3 for t in trace["x"])


def test_bands_are_the_estimate_s_own(estimated, read):
    """Would catch a band of one sigma, of another axis, or in radians."""
    result = read_result(estimated[1])
    error = [
        t for t in named(read.figures["run-1-attitude-data"], "estimate") if t["xaxis"] == "x2"
    ]
    assert len(error) == 3
    for i, trace in enumerate(error):
        at = np.array([k for k, y in enumerate(trace["y"]) if y is not None])
        drawn = np.searchsorted(result.time + 6e-4, np.array(trace["x"], float)[at])
        wanted = np.rad2deg(2.0 * result.outputs["attitude"].sigma[drawn, i])
        np.testing.assert_allclose(
            np.array(trace["customdata"], float)[at], wanted, atol=1e-3 * wanted.max()
        )
        assert trace["meta"] == {"band": "zero"}


def test_without_its_recording(read, bare):
    """Would catch a report that fails, or shows measurements it has not, when the recording is gone."""
    document = read.figures["run-2-attitude-data"]
    assert not named(document, "encoder") and not named(document, "tracker")
    assert named(document, "estimate")
    assert any(s["yref"] == "paper" for s in document["layout"]["shapes"])
    text = " ".join(read.text)
    assert "Measurements and truth are not shown" in text and "no such folder" in text
    assert "xaxis2" not in read.figures["run-2-innovations-data"]["layout"]


def test_another_recording_is_not_taken_for_it(estimated, tmp_path):
    """Would catch an estimate compared with the truth of another run."""
    result = read_result(shutil.copytree(estimated[1], tmp_path / "result"))
    short = jaxekf.load(estimated[0])
    imu = short.need_imu()
    cut = replace(imu, time_ns=imu.time_ns[:-1], gyroscope=imu.gyroscope[:-1])
    jaxekf.save(short.replace(imu=cut), tmp_path / "run")
    result.document.provenance["recording"] = str(tmp_path / "run")
    seen = compare(result)
    assert (
        "another recording" in seen.missing
        and "3000 samples of gyroscope, not 3001" in seen.missing
    )
    assert seen.recording is None and seen.score is None
    result.document.provenance["recording"] = str(demo.FOLDER / "free-5")
    assert "its name is 'free-5'" in compare(result).missing


def test_the_same_input_gives_the_same_file(estimated, tmp_path):
    """Would catch a time stamp, or an order that changes."""
    written = [write_report([estimated[1]], tmp_path / f"{i}.html").path for i in range(2)]
    assert written[0].read_bytes() == written[1].read_bytes()


def test_an_earlier_report_is_replaced_only_when_asked(estimated, page, tmp_path):
    """Would catch a lost report, or --overwrite that takes any file for one."""
    mine = tmp_path / "thesis.html"
    mine.write_text("<html>three years</html>")
    for arguments in (("-o", page[0]), ("-o", mine, "--overwrite"), ("-o", tmp_path)):
        result = call("report", estimated[1], *arguments)
        assert result.exit_code == 1 and len(result.output.strip().splitlines()) == 1
    assert mine.read_text() == "<html>three years</html>"
    copy = shutil.copy(page[0], tmp_path / "old.html")
    result = call("report", estimated[1], "-o", copy, "--overwrite")
    assert result.exit_code == 0 and Path(copy).stat().st_size < page[0].stat().st_size


def _edit(folder, **changes):
    document = json.loads((folder / "result.json").read_text()) | changes
    (folder / "result.json").write_text(json.dumps(document))


def of_before(folder):
    """A result folder as it was before innovations and scores were kept to the last bit."""
    document = json.loads((folder / "result.json").read_text())
    for key in ("innovations", "score"):
        del document[key]
    (folder / "result.json").write_text(json.dumps(document))
    (folder / "innovations.npz").unlink()
    return folder


def test_innovations_and_scores_are_kept_to_the_last_bit(estimated, tmp_path):
    """Would catch NIS or scores computed again from the rounded tables, or a result of an earlier version
    that is refused."""
    made, recording = jaxekf.estimate(estimated[0]), jaxekf.load(estimated[0])
    score = jaxekf.score(made, recording)
    record, saved = made.sensors["optical"], compare(read_result(estimated[1]))
    sensor = saved.result.sensors["optical"]
    np.testing.assert_array_equal(sensor.nis, record.nis)
    np.testing.assert_array_equal(sensor.time_ns, record.time_ns)
    np.testing.assert_array_equal(sensor.freedom, (record.used | record.gated).sum(axis=1))
    assert saved.score is not None and saved.score[:3] == score[:3]
    with np.load(estimated[1] / "innovations.npz") as arrays:
        np.testing.assert_array_equal(arrays["sensors/optical/residual"], record.residual)
        np.testing.assert_array_equal(arrays["sensors/optical/covariance"], record.cov)
    before = compare(read_result(of_before(shutil.copytree(estimated[1], tmp_path / "result"))))
    np.testing.assert_allclose(before.result.sensors["optical"].nis, sensor.nis, rtol=1e-8)
    np.testing.assert_array_equal(before.result.sensors["optical"].refused, sensor.refused)
    assert before.score is not None and before.score != saved.score
    assert before.score[:3] == pytest.approx(score[:3], rel=1e-6)


@pytest.mark.parametrize(
    ("spoil", "words"),
    [
        (shutil.rmtree, "no such folder"),
        (lambda f: (f / "result.json").unlink(), "without result.json"),
        (lambda f: (f / "result.json").write_text("{"), "not JSON"),
        (lambda f: (f / "result.json").write_text("[]"), "schema_version None"),
        (lambda f: _edit(f, schema_version=0), "schema_version 0"),
        (lambda f: _edit(f, account=None), "result.json:account: got null, expected object"),
        (lambda f: _edit(f, diagnosis={"verdicts": []}), "diagnosis.notes: got nothing"),
        (lambda f: (f / "estimate.csv").unlink(), "estimate.csv: got no such file"),
        (lambda f: (f / "estimate.csv").write_text("time,a\n0,1\n"), "other times"),
        (lambda f: (f / "innovations.npz").unlink(), "innovations.npz: got no such"),
        (lambda f: (f / "innovations.npz").write_text("x"), "cannot be read"),
        (lambda f: np.savez(f / "innovations.npz"), "got no sensors/optical/time_ns, sensors/opt"),
        (
            lambda f: (of_before(f) / "innovations_optical.csv").unlink(),
            "innovations_optical.csv: got no such",
        ),
        (
            lambda f: (of_before(f) / "innovations_optical.csv").write_text("time,a\n0,1\n"),
            "other columns",
        ),
        (lambda f: (f / "covariance.npz").write_text("x"), "cannot be read"),
        (lambda f: (f / "noise.toml").unlink(), "noise.toml: got no such file"),
        (lambda f: (f / "noise.toml").write_text("["), "not TOML"),
    ],
)
def test_what_is_no_result_is_said_in_one_sentence(bare, tmp_path, spoil, words):
    """Would catch a traceback, or half a report."""
    folder = shutil.copytree(bare, tmp_path / "result")
    spoil(folder)
    made = call("report", folder, "-o", tmp_path / "report.html")
    assert made.exit_code == 1 and words in made.output
    assert len(made.output.strip().splitlines()) == 1
    assert not (tmp_path / "report.html").exists()


def test_the_folder_above_is_told_from_a_result(bare, tmp_path):
    """Would catch a hint that leads nowhere for whoever names the folder of all results."""
    made = call("report", bare.parent, "-o", tmp_path / "report.html")
    assert "the folders in it (result)" in made.output


def test_thinning_keeps_extremes_and_gaps():
    """Would catch a peak that is lost, a line across missing samples, or half of the dots."""
    rng = np.random.default_rng(0)
    t = np.arange(100_000) / 1000.0
    values = rng.standard_normal(t.size)
    values[[12_345, 54_321]] = 50.0, -60.0
    values[70_000:70_010] = np.nan
    for line in (True, False):
        drawn = thinning.thin(t, values, 100, line=line)
        shown = drawn.take(values)
        assert np.nanmax(shown) == 50.0 and np.nanmin(shown) == -60.0
        assert len(shown) <= 201 and np.all(np.diff(drawn.t) >= 0)
        assert (np.isnan(shown).sum() == 1) == line
    typical = np.abs(thinning.thin(t, values, 100, line=False).take(values))
    assert np.mean(typical < 2.0) > 0.4
    assert np.isnan(thinning.thin(np.array([0.0, 1, 2, 9, 10]), np.ones(5), 9).take(np.ones(5)))[3]


def test_numbers_are_short_and_exact_enough():
    """Would catch rounding that is seen, or NaN in JSON."""
    values = np.array([1234.5678901, np.nan, 1234.567, 1234.6])
    assert thinning.rounded(values) == [1234.56789, None, 1234.567, 1234.6]
    assert thinning.rounded(np.zeros(2)) == [0, 0]
    assert thinning.seconds(np.array([0.12345, 2.0])) == [0.123, 2]


def test_position_velocity_and_states_of_one_s_own(estimated):
    """Would catch metres called millimetres, an axis exchanged, or a state that is left out."""
    made = read_result(estimated[1])
    count = len(made.time_ns)
    path = np.stack([made.time * scale for scale in (0.001, 0.002, 0.003)], axis=1)
    cov = np.broadcast_to(np.eye(3) * 1e-6, (count, 3, 3))
    speed = np.broadcast_to([0.001, 0.002, 0.003], (count, 3))
    q = np.tile([1.0, 0.0, 0.0, 0.0], (count, 1))
    true = np.ones(count, bool)
    encoder = Encoder(made.time_ns, q, true, true, path - 0.002)
    result = replace(
        made,
        outputs={
            "position": OutputEstimate(path, cov, "reference", "m"),
            "velocity": OutputEstimate(speed, cov, "reference", "m/s"),
        },
        labels=(*made.labels, "scale_x"),
        columns=made.columns | {"scale_x": path[:, 0], "sigma_scale_x": np.full(count, 0.1)},
    )
    seen = compare(result)._replace(
        recording=Recording(NAME, encoder=encoder),
        sight=None,
        errors={"position": np.full((count, 3), 0.002)},
    )
    drawn = {figure.name: figure.document for figure in figures.draw(seen, 500)}
    assert list(drawn) == ["bias", "position", "velocity", "state"]
    for name, last in (("position", (24.0, 48.0, 72.0)), ("velocity", (1.0, 2.0, 3.0))):
        values = [t for t in named(drawn[name], "estimate") if t["xaxis"] == "x"]
        assert [t["y"][-1] for t in values] == pytest.approx(last, abs=0.05)
        assert [t["customdata"][0] for t in values] == pytest.approx([2.0] * 3)
    errors = [t for t in named(drawn["position"], "estimate") if t["xaxis"] == "x2"]
    assert [t["y"][0] for t in errors] == pytest.approx([2.0] * 3)
    assert drawn["state"]["layout"]["yaxis"]["title"]["text"] == "scale_x ()"
    nees = consistency.errors(seen, 500)
    assert nees is not None
    assert named(nees.document, "NEES")[0]["y"][0] == pytest.approx(12.0)


def test_what_is_saved_of_a_diagnosis(estimated, tmp_path):
    """Would catch NaN in result.json, or curves where none were asked for."""
    made = jaxekf.estimate(estimated[0])
    folder = made.save(tmp_path / "result", diagnosis={"sensors": {"a": (np.nan, 1.0)}})
    assert json.loads((folder / "result.json").read_text())["diagnosis"] == {
        "sensors": {"a": [None, 1.0]}
    }
    diagnosis = json.loads((estimated[1] / "result.json").read_text())["diagnosis"]
    white = diagnosis["sensors"]["optical"]["whiteness"]
    assert len(white["autocorrelation"]) == 3
    assert len(white["autocorrelation"][0]) == len(white["lag_s"]) == len(white["bound"])
    plain = estimated[2]["diagnosis"]["sensors"]["optical"]["whiteness"]
    assert set(white) - set(plain) == {"lag_s", "autocorrelation", "bound"}
