"""Single markers and an IMU: consistency, hidden and wrong markers, starts, latency, what was known."""

import os
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scenario
from scipy.stats import chi2

import jaxekf
import tuning
from jaxekf._support.constants import STANDARD_GRAVITY
from jaxekf._support.errors import ModelError, RecordingError
from jaxekf.estimation import causal, padding, timeline
from jaxekf.estimation.parameters import as_arrays
from jaxekf.evaluation import metrics
from jaxekf.models import tight
from jaxekf.pose_solvers import marker_pose
from jaxekf.recordings.types import Optical
from jaxekf.simulation import marker_runs
from jaxekf.simulation.marker_runs import ToolGrade

COARSE = ToolGrade(imu_s=0.006)
"""A slower IMU: as good a test, and three times as quick."""


def matched(grade=COARSE):
    """Parameters as the simulator has them."""
    params = tight.MODEL.parameters
    noise = params.noise._replace(
        gyroscope=np.deg2rad(grade.gyroscope_deg),
        accelerometer=1e-3 * STANDARD_GRAVITY * grade.accelerometer_mg,
        bias_walk=np.deg2rad(grade.bias_walk_deg),
        accelerometer_walk=grade.accelerometer_walk,
        marker=1e-3 * grade.marker_mm,
    )
    initial = params.initial._replace(
        bias=np.deg2rad(grade.bias_deg), accelerometer_bias=grade.accelerometer_bias
    )
    return as_arrays(params._replace(noise=noise, initial=initial))


def run(seed, duration_s=6.0, grade=COARSE, hidden=(), motion=None):
    motion = motion or marker_runs.free_tool_motion(seed)
    return marker_runs.tool_recording(
        f"run-{seed}", motion, seed=seed, duration_s=duration_s, grade=grade, hidden=hidden
    )


def errors(made, recording):
    """Position (m) and attitude (rad) errors at the estimate's instants, (N, 6)."""
    truth = recording.need_encoder()
    at = np.searchsorted(truth.time_ns, made.time_ns)
    off = truth.position[at] - made.outputs["position"].value
    turn = metrics.attitude_error(made.attitude.value, truth.q_ref_body[at])
    return np.concatenate([off, turn], axis=1)


@pytest.mark.long
@pytest.mark.parametrize("count", [0, 2, 3])
def test_consistency(count):
    """Noise integrated wrongly, or a covariance that forgets what is hidden: errors of the whole state
    that are not as large as their covariance says, or innovations that are not."""
    hidden = [(name, 3.0, 5.0) for name in ("3", "2", "1")[:count]]
    runs, others = [], []
    for seed in range(100 if os.environ.get("JAXEKF_LONG") else 50):
        motion = marker_runs.free_tool_motion(seed)
        options = {"seed": seed, "duration_s": 6.0, "grade": COARSE, "hidden": hidden}
        one, other = marker_runs.tool_run(f"run-{seed}", motion, **options)
        runs.append(one)
        others.append(other)
    found = jaxekf.estimate_many(runs, "tight", matched())
    nees, nis = [], {name: [] for name in found[0].sensors}
    for made, one, other in zip(found, runs, others, strict=True):
        at = np.searchsorted(one.need_encoder().time_ns, made.time_ns)
        rest = [
            true[at] - made.part(name).value
            for name, true in zip(other._fields, other, strict=True)
        ]
        error = np.concatenate([errors(made, one), *rest], axis=1)
        nees.append(metrics.normalised_square(error, made.cov))
        for name, record in made.sensors.items():
            nis[name].append(record.nis[10:])
    assert_in_band(np.array(nees)[:, found[0].time > 0.5], 15)
    for values in nis.values():
        assert_in_band(np.array(values), 3)


def assert_in_band(squares, freedom):
    """Squares (runs, N): their mean over the runs in the 99 % band for at least 90 % of N."""
    mean, runs = squares.mean(axis=0), len(squares)
    low, high = chi2.ppf([0.005, 0.995], freedom * runs) / runs
    share = np.mean((mean > low) & (mean < high))
    assert share >= 0.9, (share, mean.mean() / freedom)


def test_hidden_markers_cost_little():
    """A model that uses markers together only: one marker must hold the position."""
    hidden = [("3", 2.0, 6.0), ("2", 2.0, 6.0)]
    for seed in range(3):
        one = run(seed, hidden=hidden)
        error = errors(jaxekf.estimate(one, "tight", matched()), one)[-100:]
        assert np.sqrt(np.mean(error[:, :3] ** 2)) < 1e-3
        coarse = jaxekf.estimate(one, "loose_pose")
        assert np.sqrt(np.mean(errors(coarse, one)[-100:, :3] ** 2)) > 5e-3


def test_raw_pose_against_scipy():
    """A reflection, a transposed rotation or a centroid of hidden markers."""
    from scipy.spatial.transform import Rotation

    rng = np.random.default_rng(3)
    body = rng.standard_normal((5, 3))
    turns = Rotation.random(40, random_state=4)
    origin = rng.standard_normal((40, 3))
    seen = np.stack([turns.apply(b) for b in body], axis=1) + origin[:, None]
    seen += 0.01 * rng.standard_normal(seen.shape)
    usable = rng.uniform(size=(40, 5)) < 0.8
    seen[~usable] = np.nan
    fit = marker_pose.absolute_orientation(body, seen, usable)
    np.testing.assert_array_equal(fit.valid, usable.sum(axis=1) >= 3)
    for i in np.flatnonzero(fit.valid):
        chosen = usable[i]
        b, r = body[chosen], seen[i, chosen]
        expected, _ = Rotation.align_vectors(r - r.mean(axis=0), b - b.mean(axis=0))
        got = Rotation.from_quat(np.roll(fit.q_ref_body[i], -1))
        assert (got.inv() * expected).magnitude() < 1e-9
        place = r.mean(axis=0) - expected.apply(b.mean(axis=0))
        np.testing.assert_allclose(fit.position[i], place, atol=1e-9)
    line = np.array([[0.0, 0, 0], [1, 0, 0], [2, 0, 0]])
    assert not marker_pose.absolute_orientation(line, line[None], np.ones((1, 3), bool)).valid[0]


def test_start_waits_for_three_markers(monkeypatch):
    """A start from a pose that two markers do not give, or a wait of which nothing is said."""
    # Padded as the runs that do not wait: the same program.
    monkeypatch.setattr(padding, "bucket", lambda count: 384 if count <= 384 else 1024)
    one = run(1, hidden=[("2", 0.0, 1.0)])
    made = jaxekf.estimate(one, "tight", matched())
    waited = (made.time_ns[0] - one.need_encoder().time_ns[0]) / 1e9
    assert abs(waited - 1.0) < 0.02
    assert "waited 1.0" in made.notes[0]
    assert made.account["marker_1"]["dropped_outside_run"] >= 55
    assert np.abs(errors(made, one)[100:, :3]).max() < 3e-3
    never = run(1, hidden=[("2", 0.0, 9.0)])
    with pytest.raises(RecordingError, match="can start"):
        jaxekf.estimate(never, "tight")


def test_gravity_is_found_where_it_is_not_stated():
    """A tracker that stands askew taken for one that stands upright."""
    one = run(2, duration_s=20.0)
    stated = np.array(one.info["gravity_ref"])
    found = tight.adapt([one]).setup(one.replace(info={})).gravity_ref
    # The accelerometer's bias of 0.1 m/s^2 is not known here.
    assert np.linalg.norm(found - stated) < 0.4
    askew = replace(one.markers, position=one.markers.position[..., [2, 0, 1]])
    turned = tight.adapt([one]).setup(one.replace(info={}, markers=askew)).gravity_ref
    np.testing.assert_allclose(turned, found[[2, 0, 1]], atol=1e-9)


def outliers(one, at, size):
    """The recording with some samples of a marker far off."""
    position = one.markers.position.copy()
    for frame, marker in at:
        position[frame, marker] += size
    return one.replace(markers=replace(one.markers, position=position))


def test_outliers_are_refused():
    """Single wrong samples that move the estimate, or a marker's fault that is held against others."""
    one = run(4)
    clean = jaxekf.estimate(one, "tight", matched())
    at = [(frame, frame % 3) for frame in range(30, 300, 7)]
    spoilt = jaxekf.estimate(outliers(one, at, 0.05), "tight", matched())
    gated = sum(spoilt.account[f"marker_{i}"]["gated"] for i in "123")
    assert len(at) <= gated <= len(at) + 5
    difference = np.abs(errors(spoilt, one) - errors(clean, one))[:, :3]
    assert difference.max() < 1e-3


def test_a_wrong_marker_stays_out():
    """Patience that lets in a marker that disagrees for ever while the others agree."""
    one = run(5)
    wrong = outliers(one, [(frame, 1) for frame in range(60, 334)], 0.02)
    made = jaxekf.estimate(wrong, "tight", matched())
    assert made.account["marker_2"]["gated"] >= 273
    assert np.abs(errors(made, one)[-100:, :3]).max() < 2e-3


def test_a_lost_filter_recovers():
    """A belief that is wrong and sure of it, kept for ever by its own gates."""
    one = run(6)
    shift = np.zeros_like(one.markers.position)
    shift[150:] = [0.3, -0.2, 0.1]
    moved = one.replace(markers=replace(one.markers, position=one.markers.position + shift))
    made = jaxekf.estimate(moved, "tight", matched())
    late = errors(made, one)[-100:, :3] + [0.3, -0.2, 0.1]
    assert np.abs(late).max() < 5e-3
    assert "the covariance was increased" in made.notes[0]
    held = made.time < 2.7 + tight.MODEL.gate_reset_after_s
    assert np.abs(errors(made, one)[held, :3]).max() < 0.3


@pytest.mark.parametrize("wrong_s", scenario.long_form([-0.02, 0.02], {-0.02}))
def test_latency_is_found(wrong_s):
    """A latency whose gradient is wrong or cut off: 20 ms off at the start, 0.5 ms at the end."""
    runs = []
    for seed in range(2):
        one = run(seed, duration_s=4.0)
        said = one.markers.latency_ns + round(1e9 * wrong_s)
        runs.append(one.replace(markers=replace(one.markers, latency_ns=said)))
    start = matched()
    # A gate would throw out what the wrong latency spoils, and with it the evidence.
    ungated = [replace(s, gate=None) for s in tight.MODEL.sensors]
    model = replace(tight.MODEL, sensors=tuple(ungated), adapt=None)
    tuned = tuning.tune(
        runs,
        model=model,
        objective="likelihood",
        free=["calibration.latency"],
        start=start,
        iterations=25,
    )
    assert abs(float(tuned.params.calibration.latency) + wrong_s) < 5e-4


def until(one, instant_ns):
    """The recording as far as it had arrived by an instant."""
    imu, markers = one.imu, one.markers
    i, m = imu.time_ns <= instant_ns, markers.time_ns <= instant_ns
    cut_imu = replace(imu, time_ns=imu.time_ns[i], gyroscope=imu.gyroscope[i])
    return one.replace(
        imu=replace(cut_imu, accelerometer=imu.accelerometer[i]),
        markers=replace(
            markers,
            time_ns=markers.time_ns[m],
            position=markers.position[m],
            visible=markers.visible[m],
        ),
    )


@pytest.mark.parametrize("latency_s", [0.0, 0.036])
def test_online_is_a_batch_of_what_had_arrived(latency_s, monkeypatch):
    """A look ahead, a frame that is used too late, or a past that is not carried on to the present."""
    # All batches padded to one length, for one program.
    monkeypatch.setattr(padding, "bucket", lambda count: 512)
    grade = replace(COARSE, latency_s=latency_s)
    one = run(8, duration_s=2.0, grade=grade, hidden=[("1", 0.8, 1.3)])
    told = causal.estimate_online(one, "tight", matched())
    assert told.time_ns[0] == one.markers.time_ns[0]
    for instant in (int(told.time_ns[i]) for i in (40, 41, 42, 150, 240)):
        batch = jaxekf.estimate(until(one, instant), "tight", matched())
        assert batch.time_ns[-1] == instant
        at = int(np.searchsorted(told.time_ns, instant))
        for a, b in zip(jax.tree.leaves(told.state), jax.tree.leaves(batch.state), strict=True):
            np.testing.assert_allclose(a[at], b[-1], rtol=0, atol=1e-10)
        np.testing.assert_allclose(told.cov[at], batch.cov[-1], rtol=0, atol=1e-10)
        rate = told.outputs["object_velocity"].value[at]
        np.testing.assert_allclose(rate, batch.outputs["object_velocity"].value[-1], atol=1e-10)


def test_online_needs_an_input():
    """A model that only looks back answered with a stack trace."""
    still = np.tile([1.0, 0.0, 0.0, 0.0], (50, 1))
    times = np.arange(50, dtype=np.int64) * 20_000_000
    optical = Optical(times, still, np.ones(50, bool))
    imu = run(0, duration_s=1.0).imu
    with pytest.raises(ModelError, match="without input"):
        causal.estimate_online(jaxekf.Recording("r", optical, imu), "loose_rate")


def test_object_frame():
    """An object's point or frame turned the wrong way; a velocity that forgets the swing."""
    one = run(3)
    turn = np.array([0.5, 0.5, -0.5, 0.5])
    info = dict(one.info) | {"p_body_object": [0.0, 0.0, 0.3], "q_body_object": turn.tolist()}
    made = jaxekf.estimate(one.replace(info=info), "tight", matched())
    point = np.array([0.0, 0.0, 0.3])
    rotation = jaxekf.recordings.types.to_scipy(made.attitude.value)
    where = made.outputs["position"].value + rotation.apply(point)
    np.testing.assert_allclose(made.outputs["object_position"].value, where, atol=1e-12)
    whole = rotation * jaxekf.recordings.types.to_scipy(turn)
    got = jaxekf.recordings.types.to_scipy(made.outputs["object_attitude"].value)
    assert (got.inv() * whole).magnitude().max() < 1e-12
    speed = np.gradient(where, made.time, axis=0)
    settled = slice(100, -100)
    difference = made.outputs["object_velocity"].value[settled] - speed[settled]
    assert np.sqrt(np.mean(difference**2)) < 0.05
    swing = np.linalg.norm(np.cross(made.rate.value, point), axis=1)[settled]
    assert swing.max() > 0.15


def test_names_of_markers_choose_the_model():
    """A model built anew for each run, which would be compiled anew; a marker that a run lacks."""
    a, b = run(0), run(1)
    assert tight.adapt([a]) is tight.adapt([b]) is tight.MODEL
    names = ("1", "2", "3", "4")
    far = np.vstack([a.markers.p_body_marker, [0.05, 0.05, 0.02]])
    seen = np.concatenate([a.markers.position, a.markers.position[:, :1] * np.nan], axis=1)
    shown = np.concatenate([a.markers.visible, np.zeros((len(seen), 1), bool)], axis=1)
    more = a.replace(
        markers=replace(a.markers, names=names, p_body_marker=far, position=seen, visible=shown)
    )
    both = jaxekf.estimate_many([more, b], "tight", matched())
    alone = jaxekf.estimate(a, "tight", matched())
    np.testing.assert_allclose(both[0].cov, alone.cov, atol=1e-12)
    assert both[1].account["marker_4"]["used"] == 0
    assert jnp.shape(both[1].params.setup.p_body_marker) == (4, 3)


@pytest.mark.parametrize("frame", [0, 1])
def test_a_start_does_not_trust_an_outlier(frame):
    """One marker 50 mm off in one of the two frames that give pose and velocity: metres of error for
    seconds, while the gates refuse every good sample."""
    one = run(4, duration_s=0.5)
    position = one.markers.position.copy()
    position[frame, 0] += 0.05
    spoilt = one.replace(markers=replace(one.markers, position=position))
    model = tight.adapt([one])
    good, found = timeline.build(model, one).first, timeline.build(model, spoilt).first
    np.testing.assert_allclose(found["position"], good["position"], atol=0.01)
    np.testing.assert_allclose(found["velocity"], good["velocity"], atol=0.2)


@pytest.mark.parametrize("model", ["tight", "loose_pose"])
def test_markers_of_another_unit_are_refused(model):
    """Millimetres where metres belong: without a word the filter starts 100 m from its tool."""
    one = run(5, duration_s=0.5)
    spoilt = one.replace(markers=replace(one.markers, position=1e3 * one.markers.position))
    with pytest.raises(RecordingError, match="off a tool of"):
        timeline.build(
            jaxekf.get_model(model).adapt([spoilt])
            if model == "tight"
            else jaxekf.get_model(model),
            spoilt,
        )


def test_a_pose_to_start_from_turns_as_the_gyroscope_did():
    """A first pose 20 deg off: gates then refuse every good one until the belief is widened."""
    one = run(6, duration_s=1.0)
    poses = marker_pose.from_markers(one.markers)
    wrong = poses.q_ref_body.copy()
    wrong[:2] = wrong[:2] @ np.diag([0.98, 1.0, 1.0, 1.0]) + [0.0, 0.17, 0.0, 0.0]
    wrong[:2] /= np.linalg.norm(wrong[:2], axis=1)[:, None]
    spoilt = one.replace(markers=None, optical=replace(poses, q_ref_body=wrong))
    spoilt.optical.q_ref_body[1] = poses.q_ref_body[1]
    built = timeline.build(jaxekf.get_model("loose_pose"), spoilt)
    np.testing.assert_array_equal(built.first["q_ref_body"], poses.q_ref_body[1])
    assert "poses at the start" in built.notes[0]
