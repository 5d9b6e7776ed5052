"""Estimates at requested times: the filter's own belief, nothing else changed, and what is refused."""

import json
from dataclasses import replace

import jax
import numpy as np
import pytest
from click.testing import CliRunner

import jaxekf
from jaxekf._support.errors import ModelError, RecordingError
from jaxekf.cli import main
from jaxekf.io import csv_table
from jaxekf.simulation import demo
from jaxekf.simulation.marker_runs import ToolGrade, free_tool_motion, tool_recording

RUN = demo.FOLDER / "free-5"


@pytest.fixture(scope="module")
def tool():
    return tool_recording(
        "tool-1", free_tool_motion(1), seed=1, duration_s=2.0, grade=ToolGrade(imu_s=0.006)
    )


def hidden_at(recording, time_ns):
    """The recording with a hidden sample of its tracker at each of these times."""
    stream = recording.markers or recording.optical
    merged = np.union1d(stream.time_ns, time_ns + stream.latency_ns)
    at = np.minimum(np.searchsorted(stream.time_ns, merged), len(stream.time_ns) - 1)
    there = stream.time_ns[at] == merged
    taken = {
        name: value[at]
        for name in ("q_ref_body", "valid", "position", "visible")
        if (value := getattr(stream, name, None)) is not None
    }
    kind, seen = ("markers", "visible") if recording.markers else ("optical", "valid")
    taken[seen] = (taken[seen].T & there).T
    return recording.replace(**{kind: replace(stream, **taken | {"time_ns": merged})})


def asked_of(made):
    """Times of which some are instants, some right beside one, and some in the middle between two."""
    first, last = made.time_ns[0], made.time_ns[-1]
    rng = np.random.default_rng(4)
    times = rng.integers(first, last, 60)
    return np.unique(np.concatenate([times, made.time_ns[40:45], made.time_ns[60:65] + 1, [last]]))


@pytest.mark.parametrize(
    ("model", "smooth"), [("loose", True), ("loose_rate", False), ("tight", False)]
)
def test_equals_a_hidden_sample(model, smooth, tool):
    """Would catch an interpolated belief, a step skipped or taken twice, and instants that move others.

    A tracker's sample that is hidden measures nothing, but makes an instant: the same one.
    """
    recording = tool if model == "tight" else jaxekf.load(RUN)
    plain = jaxekf.estimate(recording, model, smooth=smooth)
    times = asked_of(plain)
    made = jaxekf.estimate(recording, model, smooth=smooth, at=times)
    found = made.requested
    np.testing.assert_array_equal(found.time_ns, times)
    np.testing.assert_array_equal(found.time, (times - plain.time_ns[0]) / 1e9)
    hidden = jaxekf.estimate(hidden_at(recording, times), model, smooth=smooth)
    at = np.searchsorted(hidden.time_ns, times)
    for one, other in zip(
        jax.tree.leaves((found.state, found.cov)),
        jax.tree.leaves((hidden.state, hidden.cov)),
        strict=True,
    ):
        np.testing.assert_allclose(one, other[at], rtol=0, atol=1e-12 * np.abs(other).max())
    # What was not asked for is as good as equal; steps cut in two are integrated better.
    np.testing.assert_array_equal(made.time_ns, plain.time_ns)
    error = made.attitude.value - plain.attitude.value
    assert np.abs(error).max() < 0.05 * plain.attitude.sigma.min()
    np.testing.assert_allclose(made.cov, plain.cov, rtol=0, atol=0.02 * plain.cov.max())
    one, other = (jaxekf.score(e, recording) for e in (made, plain))
    assert one.samples == other.samples
    np.testing.assert_allclose(one, other, rtol=0.02)


def test_regular_grid_of_many_runs():
    """Would catch a grid that begins or ends elsewhere, and times of one run asked of another."""
    runs = [jaxekf.load(demo.FOLDER / name) for name in ("free-4", "free-5")]
    grid = jaxekf.every(0.0123)
    all_on_it = jaxekf.estimate_many(runs, at=grid)
    times = runs[1].need_imu().time_ns[100:110] + 77
    both = jaxekf.estimate_many(runs, at=[grid, times])
    np.testing.assert_array_equal(both[1].requested.time_ns, times)
    first, last = both[0].time_ns[0], both[0].time_ns[-1]
    asked = both[0].requested.time_ns
    assert asked[0] == first
    assert set(np.diff(asked)) == {12_300_000}
    assert 0 <= last - asked[-1] < 12_300_000
    assert both[0].requested.excerpt
    assert not both[0].excerpt
    np.testing.assert_array_equal(all_on_it[0].requested.time_ns, asked)
    alone = jaxekf.estimate(runs[1], at=times).requested
    np.testing.assert_allclose(both[1].requested.cov, alone.cov, rtol=1e-10, atol=0)


def test_what_lies_outside_is_said():
    """Would catch times that are dropped in silence, or carried on beyond the data."""
    whole = jaxekf.estimate(RUN)
    outside = np.array([whole.time_ns[0] - 1, whole.time_ns[-1] + 5])
    times = np.sort(np.append(outside, whole.time_ns[10]))
    made = jaxekf.estimate(RUN, at=times)
    assert list(made.requested.time_ns) == [whole.time_ns[10]]
    assert any("2 of 3 requested times are outside the run" in note for note in made.notes)
    for bad, words in (
        (outside, "expected some within the run"),
        (np.array([0.5, 0.7]), "expected int64 nanoseconds"),
        (times[::-1], "do not increase"),
        (np.array([], np.int64), "no requested times"),
        (jaxekf.every(1e-9), "no more than"),
        (np.array([1], "timedelta64[s]"), "expected int64 nanoseconds"),
        (np.ma.array([1, 2], mask=[True, False]), "without a mask"),
    ):
        with pytest.raises(RecordingError, match=words):
            jaxekf.estimate(RUN, at=bad)
    with pytest.raises(ModelError, match="its steps are the samples of optical"):
        jaxekf.estimate(RUN, "loose_additive", at=times)
    with pytest.raises(ValueError, match="requested times for 1 runs"):
        jaxekf.estimate_many([RUN, RUN], at=[times])
    for seconds in (0.0, float("nan")):
        with pytest.raises(ValueError, match="a nanosecond or more"):
            jaxekf.every(seconds)
    with pytest.raises(ValueError, match="a whole number of at least 1"):
        jaxekf.Every(-1)


def test_an_excerpt_is_exported_only(tmp_path):
    """Would catch innovations laid beside other states, and a result that lacks its instants."""
    made = jaxekf.estimate(RUN, at=jaxekf.every(0.5))
    with pytest.raises(ValueError, match="expected whole estimates"):
        jaxekf.diagnose(made.requested)
    with pytest.raises(RecordingError, match="requested times only"):
        made.requested.save(tmp_path / "result")
    assert jaxekf.read_export(made.requested.export(tmp_path / "a.npz"))["requested_times_only"]
    assert not jaxekf.read_export(made.export(tmp_path / "b.h5"))["requested_times_only"]


def call(*arguments):
    return CliRunner().invoke(main, [str(a) for a in arguments])


def test_command_line(tmp_path):
    """Would catch options that do nothing, exports at other times, and runs that are only judged alone."""
    names = ("free-4", "free-5")
    runs = [demo.FOLDER / name for name in names]
    times = [jaxekf.load(run).need_encoder().time_ns[200:205] + 123 for run in runs]
    asked = tmp_path / "asked.csv"
    values = np.full((5, 1), 3.0)
    csv_table.write_csv(asked, ["angle"], times[1], values, 9)
    arguments = ("--at", asked, "--export", "tum", "--json")
    result = call("estimate", runs[1], "-o", tmp_path / "one", *arguments)
    assert result.exit_code == 0, result.output
    folder = tmp_path / "one" / names[1]
    made = jaxekf.estimate(runs[1], at=times[1])
    table = csv_table.read_table(folder / "requested.csv")
    np.testing.assert_array_equal(csv_table.read_times(table), times[1])
    found = csv_table.finite_numbers(table, ("q_ref_body_w", "bias_z"))
    np.testing.assert_allclose(found[:, 0], made.requested.state.q_ref_body[:, 0], atol=1e-11)
    np.testing.assert_allclose(found[:, 1], made.requested.bias.value[:, 2], rtol=1e-11)
    lines = (folder / "trajectory.tum").read_text("utf-8").splitlines()
    assert sum(not line.startswith("#") for line in lines) == 5
    whole = csv_table.read_table(folder / "estimate.csv")
    assert len(whole) == len(made.time_ns)
    assert json.loads((folder / "result.json").read_text("utf-8"))["requested"] == 5
    result = call("estimate", *runs, "-o", tmp_path / "two", "--every", 0.01, "--json")
    assert result.exit_code == 0, result.output
    pooled = json.loads(result.stdout)["diagnosis"]
    assert pooled["runs"] == list(names)
    assert "all 2 runs together: " in result.stderr
    for name in names:
        grid = csv_table.read_times(csv_table.read_table(tmp_path / "two" / name / "requested.csv"))
        assert set(np.diff(grid)) == {10_000_000}
    for options, words in (
        (("--every", 0.1, "--at", asked), "got --at and --every"),
        (("--every", 0.1, "--online", "--model", "tight"), "got --online and times"),
        (("--at", tmp_path / "none.csv"), "expected a CSV file of times"),
        (("--every", "nan"), "a nanosecond or more"),
        (("--at", asked, "--at", asked), "once for all or once for each"),
    ):
        result = call("estimate", runs[0], "-o", tmp_path / "bad", *options)
        assert result.exit_code != 0
        assert words in result.stderr
        assert not (tmp_path / "bad").exists()
