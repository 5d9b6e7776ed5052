"""Calibration with the noise: parameters of each run, of the truth, what is known of them, and going on."""

import json
import os
import re
import signal
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from click.testing import CliRunner
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

import jaxekf
import tuning
from jaxekf import jit
from jaxekf._support.errors import TuningError
from jaxekf.cli import main
from jaxekf.estimation.parameters import as_arrays
from jaxekf.recordings.types import from_scipy, to_scipy
from jaxekf.simulation import attitude_runs
from tuning.objective import covariance_scale, objectives
from tuning.objective.data import prepare_groups
from tuning.parametrisation import free_vector
from tuning.parametrisation.truth_frame import no_correction
from tuning.persistence.tuning_document import record
from tuning.search.descent import Descent

MODEL = jaxekf.get_model("loose")
OFFSET_S = 0.004
MOUNTED = np.deg2rad([[0.6, -0.4, 0.5], [-0.5, 0.3, 0.8], [1.0, 0.7, -0.6]])
"""How the IMU is mounted in each run: rotation vectors from its frame to the tool's."""


def mounted(index, seed=None, duration_s=10.0, **motion):
    """A run whose IMU lags and is turned against the tool."""
    seed = index if seed is None else seed
    run = attitude_runs.recording(
        f"run-{index}",
        attitude_runs.free_motion(seed, speed_deg=60.0, rest_s=0.5, **motion),
        seed=seed,
        duration_s=duration_s,
    )
    imu = run.need_imu()
    turned = Rotation.from_rotvec(MOUNTED[index % 3]).inv().apply(imu.gyroscope)
    late = replace(imu, time_ns=imu.time_ns + round(OFFSET_S * 1e9), gyroscope=turned)
    return run.replace(imu=late)


@pytest.fixture(scope="module")
def runs():
    return [mounted(i) for i in range(3)]


FREE = (
    "noise",
    "calibration.clock_offset",
    tuning.Free("calibration.alignment", each_run=True),
)


@pytest.fixture(scope="module")
def tuned(runs):
    return tuning.tune(
        runs[:2], objective="map", free=FREE, confidence_intervals=True, iterations=40
    )


def test_each_run_has_its_own(runs, tuned):
    """Would catch runs that are given each other's parameters, and intervals that do not hold the truth."""
    assert len(tuned.intervals) == 10
    labels = {
        f"calibration.alignment[{i}] of run {k}": MOUNTED[k][i] for k in (0, 1) for i in range(3)
    }
    labels["calibration.clock_offset"] = OFFSET_S
    labels["noise.optical"] = np.deg2rad(0.3)
    for label, true in labels.items():
        value, low, high = tuned.intervals[label]
        assert low < value < high
        # Of eight intervals of 95 % one may miss; by twice its width none.
        assert abs(true - value) < 2.0 * max(high - value, value - low), label
    for k in (0, 1):
        own = tuned.each[f"run-{k}"]
        assert own.noise.optical == tuned.params.noise.optical
        np.testing.assert_allclose(own.calibration.alignment, MOUNTED[k], atol=3e-3)
    mean = MOUNTED[:2].mean(axis=0)
    np.testing.assert_allclose(tuned.params.calibration.alignment, mean, atol=3e-3)


def test_what_has_no_lower_limit_stays_at_its_start(tuned):
    """Would catch a bias walk that ten seconds limit to one side only and that is tuned to nothing, and one
    that passes for open though a large one is excluded (row 8)."""
    assert not tuned.open
    value, low, high = tuned.intervals["noise.bias_walk"]
    assert low == 0.0 < value < high < 20.0 * value
    assert float(tuned.params.noise.bias_walk) == pytest.approx(
        float(tuned.start.noise.bias_walk), rel=1e-12
    )
    assert "left_open" not in tuned.origin
    sentences = [s for s in record(tuned)["warnings"] if "no lower limit" in s]
    assert len(sentences) == 1 and "noise.bias_walk: 0 to" in sentences[0]


def test_held_out_runs_are_fitted_without_their_truth(runs, tuned, tmp_path):
    """Would catch a held-out run's truth that leaks into its parameters, and files that lack a run."""
    found = tuning.fit_runs(runs[2:], tuned)["run-2"]
    blind = tuning.fit_runs([runs[2].replace(encoder=None)], tuned)["run-2"]
    for one, other in zip(jax.tree.leaves(found), jax.tree.leaves(blind), strict=True):
        np.testing.assert_array_equal(one, other)
    np.testing.assert_allclose(found.calibration.alignment, MOUNTED[2], atol=3e-3)
    assert found.noise == tuned.params.noise
    tuning.save(tuned, tmp_path)
    again = jaxekf.load_parameters(MODEL, tmp_path / "runs" / "run-1")
    np.testing.assert_allclose(
        again.calibration.alignment, tuned.each["run-1"].calibration.alignment
    )


def test_validation_runs_have_their_own(runs, tuned):
    """Would catch a validation run judged with another run's parameters, or with none of its own."""
    again = tuning.tune(
        runs[:2], validate=runs[2:], objective="map", free=FREE, start=tuned.start, iterations=8
    )
    own = tuning.fit_runs(runs[2:], again)["run-2"]
    held_out = tuning.prepare(MODEL, runs[2:])
    aim = tuning.innovation_likelihood()
    value = jit(lambda params, data: tuning.evaluate(MODEL, aim, params, data))
    found = float(value(own, held_out))
    assert again.best.validation == pytest.approx(found, abs=2e-3)
    # A run's own alignment matters: with the others' the innovations are far less likely.
    assert float(value(again.params, held_out)) > found + 0.05


def test_parameters_of_each_run_estimate_it(runs, tuned):
    """Would catch estimates that mix up whose parameters are whose."""
    own = [tuned.of_run(run) for run in runs[:2]]
    both = jaxekf.estimate_many(runs[:2], "loose", own)
    for run, params, made in zip(runs[:2], own, both, strict=True):
        alone = jaxekf.estimate(run, "loose", params)
        np.testing.assert_allclose(made.attitude.value, alone.attitude.value, rtol=0, atol=1e-12)
        np.testing.assert_array_equal(
            made.params.calibration.alignment, params.calibration.alignment
        )
    with pytest.raises(ValueError, match="one for each of 2 runs"):
        jaxekf.estimate_many(runs[:2], "loose", own[:1])


LEAVES = (
    tuning.Free("noise.optical", bounds=(1e-4, 0.1)),
    tuning.Free("noise.gyroscope", each_run=True),
    tuning.Free("calibration.alignment", each_run=True, bounds=(-0.5, 0.5)),
    "calibration.clock_drift",
    "truth",
)


@given(st.lists(st.floats(-3.0, 3.0), min_size=28, max_size=28))
def test_a_run_is_filtered_with_its_own_numbers(values):
    """Would catch an index that is off by a run, or bounds that are not kept or do not invert."""
    base = as_arrays(MODEL.parameters)._replace(truth=no_correction())
    where = free_vector.layout(MODEL, base, LEAVES, runs=4)
    assert len(where.labels()) == len(where.prior) == 28
    free = jnp.asarray(values)
    params = where.from_free(free, base)
    np.testing.assert_allclose(where.to_free(params), free, rtol=1e-6, atol=1e-6)
    assert 1e-4 < params.noise.optical < 0.1
    assert np.abs(params.calibration.alignment).max() < 0.5
    place = np.array([2, 0, 3])
    every = where.of_runs(params, (), place)
    flat = where.of_one_run()
    for k, index in enumerate(where.index(place)):
        alone = flat.from_free(free[index], base)
        for one, other in zip(jax.tree.leaves(alone), jax.tree.leaves(every), strict=True):
            np.testing.assert_allclose(one, other[k], rtol=1e-12)


@pytest.mark.parametrize("at", [0.0101, 0.5, 0.999])
def test_bounds_change_nothing_at_the_start(at):
    """Would catch a start near one of its bounds at which steps, prior and interval are those of a number
    that the bounds have bent."""
    start = as_arrays(MODEL.parameters)
    start = start._replace(noise=start.noise._replace(optical=jnp.asarray(at)))
    bound = free_vector.layout(MODEL, start, [tuning.Free("noise.optical", bounds=(0.01, 1.0))])
    free = free_vector.layout(MODEL, start, ["noise.optical"])
    here = free.to_free(start)
    np.testing.assert_allclose(bound.to_free(start), here, rtol=0.0, atol=1e-12)
    slope = jax.jacfwd(lambda x: jnp.log(bound.from_free(x, start).noise.optical))(here)
    np.testing.assert_allclose(slope, 1.0, rtol=1e-9)


@pytest.mark.parametrize(
    ("free", "objective", "scaled"),
    [
        (["noise.optical"], tuning.attitude_error(), True),
        (["initial"], tuning.attitude_error(), True),
        (["calibration.clock_offset"], tuning.attitude_error(), False),
        (["noise"], tuning.innovation_likelihood(), False),
    ],
)
def test_only_free_noise_is_scaled(free, objective, scaled, runs):
    """Would catch noise that a tuning of calibration alone changes by the common scale."""
    where = free_vector.layout(MODEL, as_arrays(MODEL.parameters), free)
    groups = prepare_groups(MODEL, runs[:1], burn_in_s=0.0, need_truth=True)
    assert covariance_scale.is_open(objective, groups, where) is scaled


def test_what_an_earlier_tuning_left_is_gone(tuned, tmp_path):
    """Would catch a run's own parameters of another tuning read beside these."""
    for name in ("run-0", "gone", "mine"):
        (tmp_path / "runs" / name).mkdir(parents=True)
        (tmp_path / "runs" / name / "noise.toml").write_text("")
    (tmp_path / "runs" / "mine" / "notes.txt").write_text("a user's own")
    tuning.save(tuned, tmp_path)
    left = sorted(str(f.relative_to(tmp_path / "runs")) for f in tmp_path.glob("runs/*/*"))
    both = ["calibration.toml", "noise.toml"]
    assert left == ["mine/notes.txt", *(f"run-{i}/{name}" for i in range(2) for name in both)]
    tuning.save(replace(tuned, each={}), tmp_path)
    assert [f.name for f in (tmp_path / "runs").iterdir()] == ["mine"]


def test_results_of_one_name_are_refused(runs, tuned):
    """Would catch two runs of one name of which only one keeps its own parameters."""
    twice = [runs[0], runs[1].replace(name=runs[0].name)]
    with pytest.raises(TuningError, match="several runs of the name"):
        tuning.fit_runs(twice, tuned)
    with pytest.raises(TuningError, match="several runs of the name"):
        tuning.tune(twice, free=[tuning.Free("noise", each_run=True)])


@pytest.fixture(scope="module")
def everything():
    """Two short runs with all kinds of parameters free: layout, a point off the start, value, gradient."""
    base = as_arrays(MODEL.parameters)._replace(truth=no_correction())
    where = free_vector.layout(
        MODEL, base, (*LEAVES, "calibration.clock_offset", "initial"), runs=2
    )
    data = tuning.prepare(MODEL, [mounted(i, duration_s=1.2) for i in range(2)])
    rng = np.random.default_rng(5)
    free = np.asarray(where.to_free(base)) + 0.1 * rng.standard_normal(len(where.labels()))
    aim = objectives.parse("attitude+0.1*rate+0.2*truth+0.3*likelihood")

    def total(free):
        every = where.of_runs(where.from_free(free, base), data.setup, data.place)
        return objectives.evaluate_each(MODEL, aim, every, data)

    return where, free, jit(total), jit(jax.grad(total))


def test_gradients_of_every_kind(everything):
    """Would catch a kind of parameter, or of objective, whose gradient is wrong or lost (row 3)."""
    where, free, value, slope = everything
    got = np.asarray(slope(jnp.asarray(free)))
    expected, h = np.zeros_like(got), 2e-3
    for i in range(len(free)):
        step = np.zeros_like(free)
        step[i] = h
        f = [float(value(free + k * step)) for k in (-2, -1, 1, 2)]
        expected[i] = (f[0] - 8 * f[1] + 8 * f[2] - f[3]) / (12 * h)
    assert np.linalg.norm(got - expected) <= 1e-6 * np.linalg.norm(expected)
    told = [not label.startswith("truth.origin") for label in where.labels()]
    assert np.all(np.abs(got)[told] > 0.0)


def test_gradients_are_finite_wherever_one_starts(everything):
    """Would catch an overflow or a zero that is divided by, within three decades (row 3)."""
    where, free, _, slope = everything
    logs = np.concatenate([np.full(leaf.size, leaf.kind == "log") for leaf in where.leaves])
    draws = 10_000 if os.environ.get("JAXEKF_LONG") == "1" else 300
    rng = np.random.default_rng(6)
    for _ in range(draws):
        wide = np.where(logs, np.log(1e3), 3.0) * rng.uniform(-1, 1, len(free))
        assert np.isfinite(np.asarray(slope(jnp.asarray(free + wide)))).all()


def test_errors_of_the_smoothed_estimate(runs):
    """Would catch an objective that says smoothed and judges the filter."""
    aim = replace(tuning.attitude_error(), smoothed=True)
    params = as_arrays(MODEL.parameters)
    data = tuning.prepare(MODEL, runs[:1])
    made = jaxekf.estimate(runs[0], "loose", params, smooth=True)
    expected = jaxekf.score(made, runs[0]).attitude_rmse_deg ** 2
    value = jit(lambda data: tuning.evaluate(MODEL, aim, params, data))(data)
    assert float(value) == pytest.approx(expected, rel=1e-9)


def test_the_encoder_is_found_where_it_lies(runs):
    """Would catch a truth whose clock or frame is corrected the wrong way round."""
    run = mounted(0).replace(name="run")
    encoder = run.need_encoder()
    reference, body = np.deg2rad([0.5, -0.3, 0.4]), np.deg2rad([-0.2, 0.6, 0.3])
    q = Rotation.from_rotvec(reference).inv() * to_scipy(encoder.q_ref_body)
    q = q * Rotation.from_rotvec(body)
    moved = replace(encoder, time_ns=encoder.time_ns + 8_000_000, q_ref_body=from_scipy(q))
    start = MODEL.parameters._replace(
        calibration=MODEL.parameters.calibration._replace(
            alignment=MOUNTED[0], clock_offset=np.array(OFFSET_S)
        )
    )
    found = tuning.tune(
        [run.replace(encoder=moved)],
        start=start,
        free=["truth"],
        objective="attitude",
        iterations=30,
        rescale=False,
        confidence_intervals=True,
    )
    assert not found.open
    assert not found.intervals
    assert float(found.truth.clock_offset) == pytest.approx(8e-3, abs=3e-4)
    # A small turn of the reference and one of the body are told apart by the motion.
    np.testing.assert_allclose(found.truth.reference, reference, atol=2.5e-3)
    np.testing.assert_allclose(found.truth.alignment, body, atol=2.5e-3)
    assert found.best.training**0.5 < 0.2
    np.testing.assert_array_equal(found.params.noise.optical, start.noise.optical)


def test_a_free_encoder_needs_an_objective_that_looks_at_it(runs):
    """Would catch an encoder that is tuned by what knows nothing of it."""
    with pytest.raises(TuningError, match="compares with the encoder"):
        tuning.tune(runs[:1], free=["truth"], objective="likelihood")


def test_information_is_the_curvature(runs, tuned):
    """Would catch an information that is off by a factor: over long data it is minus the second derivative
    of the log-likelihood at its maximum."""
    groups = prepare_groups(MODEL, runs[:2], need_truth=False)
    search = Descent(MODEL, tuned.objective, tuned.layout, tuned.start, groups, None, iterations=1)
    search.fixed = tuned.fixed
    rows = sum(int(objectives.visible_rows(data)) for data in groups)
    free, kept, h = tuned.free, np.flatnonzero(~tuned.fixed), 1e-3

    def slope(free):
        return rows * np.asarray(search.value_and_gradient(free)[1])

    curved = np.zeros((len(free), len(free)))
    for i in kept:
        step = np.zeros(len(free))
        step[i] = h
        curved[i] = (slope(free + step) - slope(free - step)) / (2 * h)
    known = tuned.information.matrix + np.diag(tuned.layout.prior**-2.0)
    size = np.sqrt(np.diagonal(known)[kept])
    off = (known - curved)[np.ix_(kept, kept)] / np.outer(size, size)
    assert np.abs(off).max() < 0.15
    # At the maximum the score is the prior's pull.
    pull = tuned.information.score - (free - search.start) / tuned.layout.prior**2
    assert np.abs(pull[kept] / size).max() < 0.2
    # Fisher scoring takes value and gradient from the runs of the filter that its curvature takes anyway.
    at = free + 0.3 * np.cos(np.arange(len(free)))
    scoring = Descent(
        MODEL, tuned.objective, tuned.layout, tuned.start, groups, None, 1, fisher=True
    )
    scoring.fixed = tuned.fixed
    (value, gradient), (again, score) = (
        search.value_and_gradient(at),
        scoring.value_and_gradient(at),
    )
    assert again == pytest.approx(value, rel=1e-9)
    np.testing.assert_allclose(score, gradient, rtol=1e-4, atol=1e-5 * np.abs(gradient).max())


def test_fisher_scoring_goes_to_the_same_place(runs, tuned):
    """Would catch a curvature of another scale or sign: then it is no faster, or ends elsewhere."""
    again = tuning.tune(
        runs[:2],
        objective="map",
        free=FREE,
        confidence_intervals=True,
        iterations=40,
        optimiser=tuning.FisherScoring(),
    )
    assert len(again.history) <= 15
    assert again.best.training <= tuned.best.training + 1e-6
    sigma = tuned.information.sigma(tuned.fixed)
    kept = ~tuned.fixed
    assert np.abs((again.free - tuned.free)[kept] / sigma[kept]).max() < 0.2
    with pytest.raises(TuningError, match="expected likelihood or map"):
        tuning.tune(runs[:1], optimiser=tuning.FisherScoring())


SCRIPT = """
import os, signal, sys
import jax
jax.config.update("jax_enable_x64", True)
jax.config.update("jax_compilation_cache_dir", os.environ["JAXEKF_TEST_PROGRAMS"])
sys.path.insert(0, sys.argv[2])
import test_calibration as case

def stop(step, total):
    if step.number == 3:
        os.kill(os.getpid(), signal.SIGKILL)

case.long_tuning(sys.argv[1], stop)
"""


def long_tuning(checkpoint=None, progress=None):
    return tuning.tune(
        [mounted(0), mounted(1)],
        objective="map",
        free=FREE,
        iterations=8,
        checkpoint=checkpoint,
        progress=progress,
    )


@pytest.mark.skipif(not hasattr(signal, "SIGKILL"), reason="needs kill -9")
def test_a_killed_tuning_goes_on(tmp_path):
    """Would catch a state that is half written, or lacks what the optimiser knows (row 10)."""
    file = tmp_path / "state.npz"
    here = str(Path(__file__).parent)
    code = subprocess.run([sys.executable, "-c", SCRIPT, str(file), here], check=False).returncode
    assert code == -signal.SIGKILL
    assert file.is_file()
    seen = []
    again = long_tuning(file, lambda step, total: seen.append(step.number))
    assert seen[0] == 3
    assert not file.exists()
    straight = long_tuning()
    for one, other in zip(
        jax.tree.leaves(again.params), jax.tree.leaves(straight.params), strict=True
    ):
        np.testing.assert_allclose(one, other, rtol=1e-9, atol=1e-12)
    assert len(again.history) == len(straight.history)


def test_another_tunings_state_is_refused(tmp_path, runs):
    """Would catch a tuning that goes on from something else."""
    file = tmp_path / "state.npz"
    file.write_text("no state")
    with pytest.raises(TuningError, match="no state of a tuning"):
        long_tuning(file)
    file.unlink()

    def stop(step, total):
        if step.number == 2:
            raise RuntimeError

    with pytest.raises(RuntimeError):
        long_tuning(file, stop)
    with pytest.raises(TuningError, match="the state of another tuning"):
        tuning.tune(runs[:1], iterations=8, checkpoint=file)


@pytest.mark.parametrize(
    ("free", "words"),
    [
        (tuning.Free("noise.optical", prior=0.0), "a prior of 0.0"),
        (tuning.Free("noise.optical", bounds=(1.0, 2.0)), "bounds 1.0 and 2.0"),
        (tuning.Free("noise.optical", bounds=(0.0, 2.0)), "of deviations positive"),
        (tuning.Free("calibration.clock_offset", bounds=(-1.0, np.inf)), "finite numbers"),
        (tuning.Free("truth.origin"), "truth.origin"),
    ],
)
def test_what_makes_no_sense_is_refused(free, words):
    """Would catch a start outside its bounds, and truth where none is."""
    with pytest.raises(TuningError, match=words):
        free_vector.layout(MODEL, as_arrays(MODEL.parameters), [free])


SPEC = """
[[free]]
name = "noise"

[[free]]
name = "calibration.clock_offset"

[[free]]
name = "calibration.alignment"
each_run = true
"""


def test_command_line(runs, tuned, tmp_path):
    """Would catch options that do nothing, and what is known that is not shown (one program for all)."""
    paths = [jaxekf.save(run, tmp_path / run.name) for run in runs]
    spec = tmp_path / "free.toml"
    spec.write_text(SPEC)
    out = tmp_path / "tuned"
    options = [
        "--objective",
        "map",
        "--iterations",
        "40",
        "--parameters",
        spec,
        "-o",
        out,
        "--json",
    ]
    result = CliRunner().invoke(
        main, [str(a) for a in ["tune", *paths[:2], *options, "--state", tmp_path / "state.npz"]]
    )
    assert result.exit_code == 0, result.output
    told = json.loads(result.stdout)
    for label, ends in tuned.intervals.items():
        np.testing.assert_allclose(told["intervals"][label], ends, rtol=1e-3, atol=1e-5)
    assert not told["left_open"] and told["intervals"]["noise.bias_walk"][1] == 0.0
    assert "no lower limit to noise.bias_walk: 0 to" in result.stderr
    own = told["own"]["run-1"]["calibration"]["alignment"]["value"]
    np.testing.assert_allclose(own, MOUNTED[1], atol=3e-3)
    assert (out / "runs" / "run-1" / "calibration.toml").is_file()
    rows = {(row["run"], row["variant"]): row["attitude_rmse_deg"] for row in told["rows"]}
    assert rows["run-0", "tuned"] < rows["run-0", "start"]


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("[[free]]\nname = 3", "name = 3"),
        ("[[free]]\neach_run = true", "expected name"),
        ("[[free]]\nname = 'noise'\nbounds = [1]", "expected two numbers"),
        ("[[free]]\nname = 'noise'\nprior = true", "prior = True"),
        ("[free]\nname = 'noise'", "nothing but"),
        ("free = ", "got no TOML"),
    ],
)
def test_faulty_lists_of_parameters(text, words, tmp_path):
    """Would catch a key that is ignored, and a stack trace where a sentence is due."""
    file = tmp_path / "free.toml"
    file.write_text(text)
    with pytest.raises(TuningError, match=re.escape(words)):
        tuning.read_free(file)
