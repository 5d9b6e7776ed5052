"""The host's side: one call for one run, the same for many, exact accounts, and errors in a sentence."""

import re
from dataclasses import replace
from pathlib import Path

import jax
import numpy as np
import pytest
import scenario

import jaxekf
import tuning
from jaxekf._support.errors import FilterError, ModelError, PrecisionError
from jaxekf.estimation import batch, padding, timeline
from jaxekf.estimation.parameters import as_arrays
from jaxekf.evaluation import metrics
from jaxekf.models import REGISTRY
from jaxekf.simulation import attitude_runs, camera_runs, demo, marker_runs

README = Path(__file__).parents[1] / "README.md"


def record(seed=1, duration_s=4.0, **kwargs):
    return attitude_runs.recording(
        f"run-{seed}",
        attitude_runs.free_motion(seed, rest_s=0.5),
        seed=seed,
        duration_s=duration_s,
        **kwargs,
    )


def test_many_equal_single_calls_with_one_compilation():
    """Would catch runs that leak into each other in a batch (row 11), or a program compiled anew."""
    records = [record(seed, 2.0) for seed in range(64)]
    together = jaxekf.estimate_many(records)
    singles = [jaxekf.estimate(records[0])]
    before = batch._run._cache_size()
    singles += [jaxekf.estimate(r) for r in records[1:]]
    assert batch._run._cache_size() == before
    for one, other in zip(together, singles, strict=True):
        np.testing.assert_allclose(one.attitude.value, other.attitude.value, atol=1e-9)
        np.testing.assert_allclose(one.cov, other.cov, atol=1e-9)
        assert one.log_likelihood == pytest.approx(other.log_likelihood, rel=1e-9)


def test_unequal_lengths_and_buckets():
    """Would catch padding that changes a result, or one program for every length."""
    records = [record(seed, 2.0 + 0.02 * seed) for seed in range(6)]
    lines = [line.steps for line in timeline.build_many(jaxekf.get_model("loose"), records)]
    sizes = {tuple(map(padding.bucket, (len(s.dt), len(s.knots.time)))) for s in lines}
    assert len(sizes) < len(records)
    together = jaxekf.estimate_many(records)
    before = batch._run._cache_size()
    singles = [jaxekf.estimate(r) for r in records]
    assert batch._run._cache_size() - before <= len(sizes)
    for one, other, r in zip(together, singles, records, strict=True):
        assert one.time_ns[-1] == r.need_imu().time_ns[-1]
        np.testing.assert_allclose(one.cov, other.cov, rtol=1e-9, atol=1e-18)


def test_smooth(tmp_path):
    """A smoother that is handed padding, another run's beliefs or a filter's outputs; a result that does
    not say which it is."""
    records = [record(seed, 2.0 + 0.3 * seed, occlusions=[(1.0, 1.4)]) for seed in range(1, 4)]
    filtered = jaxekf.estimate_many(records)
    smoothed = jaxekf.estimate_many(records, smooth=True)
    for before, after, r in zip(filtered, smoothed, records, strict=True):
        np.testing.assert_allclose(after.cov[-1], before.cov[-1], rtol=1e-9, atol=1e-15)
        np.testing.assert_allclose(after.attitude.value[-1], before.attitude.value[-1], atol=1e-12)
        assert after.log_likelihood == pytest.approx(before.log_likelihood, rel=1e-9)
        hidden = (after.time > 1.05) & (after.time < 1.35)
        assert np.all(after.attitude.sigma[hidden] < 0.95 * before.attitude.sigma[hidden])
        assert np.all(after.bias.sigma <= before.bias.sigma * (1.0 + 1e-9))
        rmse = metrics.score(after, r).attitude_rmse_deg
        assert rmse < 0.9 * metrics.score(before, r).attitude_rmse_deg
    alone = jaxekf.estimate(records[0], smooth=True)
    np.testing.assert_allclose(alone.cov, smoothed[0].cov, rtol=1e-9, atol=1e-15)
    assert alone.smoothed and not filtered[0].smoothed
    assert any("whole run" in note for note in alone.notes)
    assert '"smoothed": true' in (alone.save(tmp_path / "r") / "result.json").read_text()


@pytest.mark.parametrize("count", [1, 4, 5, 9, 1000, 1025])
def test_buckets_waste_little(count):
    """Would catch buckets that are too small or too coarse."""
    assert count <= padding.bucket(count) <= max(1.26 * count, count + 1)


@pytest.mark.parametrize(
    "name",
    scenario.long_form(list(REGISTRY), {"loose_pose", "loose_additive", "marg", "visual_bilinear"}),
)
def test_account_is_exact(name):
    """Would catch rows that vanish: read = used + masked + gated + dropped."""
    r = record(3, occlusions=[(1.0, 1.5)], dropouts=0.05)
    if name in ("tight", "loose_pose"):
        hidden = [(marker, 1.0, 1.6) for marker in "123"]
        motion = marker_runs.sinusoidal_motion()
        r = marker_runs.tool_recording("run", motion, seed=3, duration_s=3.0, hidden=hidden)
    if name in ("triad", "marg"):
        grade = attitude_runs.SensorGrade(accelerometer=2e-3, magnetometer=0.01)
        r = record(3, grade=grade)
        r.imu.magnetometer[::4] = np.nan
    if name.startswith("visual"):
        grade = camera_runs.CameraGrade(points=8, mismatched=0.1)
        r = camera_runs.camera_recording(
            "run", seed=3, duration_s=3.0, grade=grade, blind=((1.0, 1.5),)
        )
        r.camera.pixel[25] = np.nan
    later = r.imu.time_ns + 20_000_000
    r = r.replace(imu=replace(r.imu, time_ns=later))
    made = jaxekf.estimate(r, name)
    for stream, count in made.account.items():
        assert count["read"] == sum(v for k, v in count.items() if k != "read"), (stream, count)
    if name in ("triad", "marg"):
        return
    if name.startswith("visual"):
        # The image at the start comes before the IMU's first sample.
        assert made.account["camera"]["dropped_outside_run"] >= 1
        camera, image = made.account["camera"], int(r.camera.visible[25].sum())
        assert camera["masked"] == image == 8
        assert camera["read"] == int(r.camera.visible.sum())
        assert camera["gated"] >= 5
        return
    optical = made.account["marker_2" if name == "tight" else "optical"]
    # The tracker's first two samples come before the gyroscope's first.
    assert optical["dropped_outside_run"] >= 2 or name == "loose_additive" or name == "loose_rate"
    assert optical["masked"] >= 31


def test_result_is_named_and_complete(tmp_path):
    """Would catch a result that cannot be used without the source at hand."""
    made = jaxekf.estimate(record())
    assert made.attitude.value.shape == (len(made.time_ns), 4)
    assert made.rate.frame == "body"
    assert made.bias.unit == "rad/s"
    assert made.error_labels[0] == "q_ref_body_x"
    assert made.cov.shape == (len(made.time_ns), 6, 6)
    np.testing.assert_allclose(np.linalg.norm(made.attitude.value, axis=1), 1.0, atol=1e-12)
    with pytest.raises(KeyError, match="expected one of"):
        made.part("biass")
    folder = made.save(tmp_path / "result")
    names = {p.name for p in folder.iterdir()}
    assert names == {
        "estimate.csv",
        "covariance.npz",
        "innovations_optical.csv",
        "innovations.npz",
        "noise.toml",
        "calibration.toml",
        "result.json",
    }
    with np.load(folder / "covariance.npz") as arrays:
        np.testing.assert_array_equal(arrays["time_ns"], made.time_ns)
        np.testing.assert_array_equal(arrays["cov"], made.cov)
    head = (folder / "estimate.csv").read_text().splitlines()
    assert head[0].startswith("time,q_ref_body_w,")
    assert len(head) == len(made.time_ns) + 1


def test_rate_covariance_holds_for_the_rate(tmp_path):
    """Would catch a rate output without the gyroscope's own noise, or with it at the wrong bandwidth."""
    r = attitude_runs.recording("run", attitude_runs.free_motion(2), seed=2, duration_s=60.0)
    made = jaxekf.estimate(r)
    from jaxekf.recordings.truth import encoder_rate_at

    error = made.rate.value - encoder_rate_at(r.need_encoder(), made.time_ns)
    known = np.isfinite(error).all(axis=1) & (made.time > 5.0)
    nees = metrics.normalised_square(error[known], made.rate.cov[known]) / 3.0
    assert nees.mean() == pytest.approx(1.0, abs=0.06)


def test_float32_is_refused_in_a_sentence():
    """Would catch variances that are wrong by tens of percent without a word."""
    run, model = record(), jaxekf.get_model("loose")
    line = jaxekf.timeline.build(model, run)
    belief = jaxekf.initial_belief(model, model.parameters, line.first)
    given = model, model.parameters, belief, line.steps
    for call in (
        lambda: jaxekf.estimate(run),
        lambda: jaxekf.estimate_online(run),
        lambda: jaxekf.initial_belief(model, model.parameters, line.first),
        lambda: jaxekf.run_filter(*given),
        lambda: jaxekf.run_smoother(*given),
        lambda: jaxekf.run_iterated_smoother(*given),
        lambda: jaxekf.Stream(*given[:3], 0),
        lambda: tuning.tune([run]),
        lambda: tuning.tune_by_nelder_mead([run]),
        lambda: tuning.prepare(model, [run]),
        lambda: tuning.evaluate(model, tuning.attitude_error(), model.parameters, None),
        lambda: tuning.cross_validate([run, run.replace(name="other")]),
        lambda: attitude_runs.draw(model, given[1], belief.mean, line.steps, None),
    ):
        with jax.enable_x64(False), pytest.raises(PrecisionError, match="set_up"):
            call()


def test_broken_recursion_names_run_step_and_sensor():
    """Would catch NaN in a result, or an error that does not say where."""
    params = as_arrays(jaxekf.get_model("loose").parameters)
    zero = params._replace(noise=params.noise._replace(optical=np.float64(1e-200)))
    with pytest.raises(FilterError) as caught:
        jaxekf.estimate(record(), "loose", zero)
    for word in ("run-1", "step", " s,", "optical", "expected"):
        assert word in str(caught.value)


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("lose", "expected one of"),
        ("no_such_module:MODEL", "no_such_module"),
        ("math:pi", "type float"),
    ],
)
def test_unknown_models_are_refused(name, words):
    """Would catch a traceback for a misspelt model."""
    with pytest.raises(ModelError, match=words):
        jaxekf.get_model(name)


def test_own_model_without_editing_the_package(monkeypatch):
    """Would catch a core that only knows its own models: nine states, written by a user."""
    monkeypatch.chdir(README.parent / "examples")
    r = jaxekf.load(demo.FOLDER / "free-5")
    imu = r.need_imu()
    scaled = r.replace(imu=imu.__class__(imu.time_ns, imu.gyroscope * np.array([1.02, 0.99, 1.01])))
    made = jaxekf.estimate(scaled, "own_model:MODEL")
    part = made.part("scale")
    assert np.all(np.abs(part.value[-1] - [0.02, -0.01, 0.01]) < 4 * part.sigma[-1])
    assert np.all(part.sigma[-1] < 3e-3)
    better = jaxekf.score(made, scaled).attitude_rmse_deg
    assert better < jaxekf.score(jaxekf.estimate(scaled), scaled).attitude_rmse_deg


def test_readme_lines_run(capsys):
    """Would catch a README whose Python does not work (row 11)."""
    block = re.search(r"```python\n(.*?)```", README.read_text(), re.S)
    assert block is not None
    lines = [line for line in block.group(1).splitlines() if line.strip()]
    assert len(lines) == 5
    exec(compile("\n".join(lines), "README", "exec"), {})
    assert "free-5" in capsys.readouterr().out
