"""Visual-inertial pose (Hol): images and IMU as measurements of 22 numbers."""

from dataclasses import replace
from functools import partial
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scenario
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

import jaxekf
import tuning
from jaxekf.cli.estimate import _row as table_row
from jaxekf.estimation import padding, timeline
from jaxekf.estimation.parameters import as_arrays
from jaxekf.filtering import ekf
from jaxekf.filtering.model import Belief
from jaxekf.geometry import linalg, manifold, pinhole
from jaxekf.models import _correspondences as correspondences
from jaxekf.models import search_regions, visual
from jaxekf.pose_solvers import pnp
from jaxekf.recordings.truth import encoder_at
from jaxekf.recordings.types import from_scipy, to_scipy
from jaxekf.reporting import plots
from jaxekf.reporting.plots import _measurements as measurements
from jaxekf.simulation import attitude_runs, camera_runs
from jaxekf.simulation.camera_runs import CameraGrade, camera_recording
from tuning.comparison.compare import _tracker_nis as tracker_nis

POINTS, SECONDS = 8, 5.0
"""The same for all runs that are estimated: one compilation."""


def few(**changes):
    """A grade with few points, so that nothing takes long."""
    return CameraGrade(points=POINTS, **changes)


def errors(made, recording, from_s=1.0):
    """Root mean squares of position (m) and attitude (rad) errors."""
    at = encoder_at(recording.need_encoder(), made.time_ns)
    chosen = made.time >= from_s
    off = made.outputs["position"].value - at.position
    turn = to_scipy(at.q_ref_body).inv() * to_scipy(made.attitude.value)
    return (
        np.sqrt(np.mean(np.sum(off[chosen] ** 2, axis=1))),
        np.sqrt(np.mean(turn.magnitude()[chosen] ** 2)),
    )


@pytest.mark.parametrize(
    "name", scenario.long_form(["visual", "visual_bilinear"], {"visual_bilinear"})
)
def test_the_eight_is_followed(name):
    """Would catch a lever arm, a latency or a gravity of the wrong sign, and gates that lock themselves."""
    recording = camera_recording("run", seed=2, duration_s=SECONDS, grade=few())
    late = replace(
        recording.camera, time_ns=recording.camera.time_ns + 30_000_000, latency_ns=30_000_000
    )
    made = jaxekf.estimate(recording.replace(camera=late), name)
    position, attitude = errors(made, recording)
    assert position < 0.02
    assert attitude < np.deg2rad(0.4)
    camera = made.account["camera"]
    assert camera["used"] >= camera["read"] - 2
    assert set(made.outputs) == {"position", "attitude", "velocity", "rate"}


def test_both_forms_agree():
    """Would catch a bilinear form whose noise is not its image point's: eqs. 3a and 11c say the same."""
    recording = camera_recording("run", seed=3, duration_s=1.0, grade=few(pixel=0.3))
    x, samples = None, []
    for model in (visual.for_points(POINTS), visual.for_points(POINTS, True)):
        line = timeline.build(model, recording)
        params = as_arrays(model.parameters)._replace(setup=line.setup)
        x = as_arrays(model.initial_mean(line.first)) if x is None else x
        rows = line.steps.slow["camera"]
        aux = jax.tree.map(lambda a: jnp.asarray(a[0, 0]), rows.aux)

        @jax.jit
        def whitened(x, params, aux, value, model=model):
            sensor = model.sensor("camera").single_group

            def residual(delta):
                there = manifold.retract(model.space, x, delta)
                return value - sensor.predict(there, None, params, aux)

            zero = jnp.zeros(21)
            factor = jnp.linalg.cholesky(sensor.noise(params, aux, jnp.asarray(0.08)))
            found = residual(zero), jax.jacfwd(residual)(zero)
            return tuple(jnp.linalg.solve(factor, part) for part in found)

        told = whitened(x, params, aux, jnp.asarray(rows.value[0, :2]))
        samples.append(tuple(map(np.asarray, told)))
    (one, first), (other, second) = samples
    assert np.linalg.norm(one) > 0.1
    assert np.linalg.norm(other) == pytest.approx(np.linalg.norm(one), rel=0.03)
    # What they say of the state: score and information, whatever the axes of the two rows.
    for a, b in ((first.T @ one, second.T @ other), (first.T @ first, second.T @ second)):
        np.testing.assert_allclose(a, b, atol=0.03 * np.abs(b).max())


def drawn(count, seconds, keep="everything", **changes):
    """Runs drawn from the model itself, along the eight, and what the filter makes of them."""
    model = jaxekf.robust(visual.for_points(POINTS), "none")
    recording = camera_recording("run", seed=5, duration_s=seconds, grade=few())
    line = timeline.build(model, recording)
    params = as_arrays(model.parameters)._replace(setup=line.setup)
    # A motion that wanders little, so that the landmarks stay ahead of the camera.
    params = params._replace(
        noise=params.noise._replace(jerk=jnp.asarray(0.3), angular_acceleration=jnp.asarray(0.1)),
        initial=params.initial._replace(
            velocity=jnp.asarray(0.1), acceleration=jnp.asarray(0.2), rate=jnp.asarray(0.05)
        ),
    )
    mean = as_arrays(model.initial_mean(line.first))
    cov = model.initial_covariance(params)
    steps = jax.tree.map(jnp.asarray, line.steps)

    def draw(key):
        first, rest = jax.random.split(key)
        start = manifold.retract(
            model.space, mean, jnp.linalg.cholesky(cov) @ jax.random.normal(first, (21,))
        )
        return attitude_runs.draw(model, params, start, steps, rest)

    def follow(truth, seen):
        output = ekf.run_filter(model, params, Belief(mean, cov), seen)
        at = output.instants
        error = jax.vmap(jax.vmap(partial(manifold.local, model.space)))(at.updated.mean, truth)
        nis = {name: i.nis for name, i in output.innovations.items()}
        ahead = jax.tree.map(lambda a: a[:, -1], at.predicted)
        return error, at.updated.cov, nis, ahead

    keys = jax.random.split(jax.random.key(7), count)
    truth, seen = scenario.quick_jit(jax.vmap(draw))(keys)
    error, cov, nis, ahead = scenario.quick_jit(jax.vmap(follow))(truth, seen)
    error = np.asarray(error)
    white = np.linalg.solve(np.asarray(cov), error[..., None])[..., 0]
    nees = np.sum(error * white, axis=-1)
    return model, params, steps, (nees, nis, ahead, seen.slow["camera"])


@pytest.fixture(scope="module")
def runs():
    return drawn(100, 1.5)


def in_band(values, freedom, count):
    """Share of instants whose sum over runs lies in the 99 % band of chi-square."""
    low, high = chi2.ppf([0.005, 0.995], freedom * count)
    total = values.sum(axis=0)
    return np.mean((total >= low) & (total <= high))


def test_consistency(runs):
    """Would catch a Jacobian, a noise or a discretisation that is not the model's own (row 2)."""
    _, _, steps, (nees, nis, _, camera) = runs
    count = len(nees)
    valid = np.asarray(steps.valid)
    assert in_band(np.asarray(nees)[:, valid], 21, count) >= 0.9
    for name in ("accelerometer", "gyroscope"):
        mask = np.asarray(steps.fast[name].mask)[..., 0]
        assert in_band(np.asarray(nis[name])[:, mask], 3, count) >= 0.9
    rows = np.asarray(camera.mask)[0].sum(axis=1)
    seen = np.flatnonzero(rows == rows.max())
    assert len(seen) >= 10
    assert in_band(np.asarray(nis["camera"])[:, seen], rows.max(), count) >= 0.9


def test_search_regions_hold_what_is_found(runs):
    """Would catch a region that lacks the pose's uncertainty or the point's noise (row 6)."""
    _, params, _, (_, _, ahead, camera) = runs
    find = scenario.quick_jit(
        jax.vmap(jax.vmap(partial(search_regions.search_regions, params))), static_argnums=()
    )
    found = find(ahead, camera.aux.p_ref_landmark)
    shape = (*camera.mask.shape[:-1], POINTS, 2)
    mask = np.asarray(camera.mask).reshape(shape).all(axis=-1) & np.asarray(found.in_front)
    pixel = np.asarray(camera.value).reshape(shape)
    share = search_regions.inside(found, pixel)[mask].mean()
    assert mask.sum() > 10_000
    assert 0.985 <= share <= 0.995
    half, angle = search_regions.ellipses(found)
    spread = np.asarray(found.cov)[mask]
    direction = np.stack([np.cos(angle[mask]), np.sin(angle[mask])], axis=-1)
    along = np.einsum("ni,nij,nj->n", direction, spread, direction)
    np.testing.assert_allclose(half[mask][:, 0] ** 2, chi2.ppf(0.99, 2) * along, rtol=1e-8)


def test_mismatches_are_gated():
    """Would catch mismatches that pull the pose, and good points refused with them (row 4)."""
    found, refused = {}, 0
    for share in (0.0, 0.1):
        grade = few(mismatched=share)
        made = []
        for seed in range(6):
            run = camera_recording(f"run-{seed}", seed=seed, duration_s=SECONDS, grade=grade)
            made.append((run, jaxekf.estimate(run, "visual")))
        found[share] = np.sqrt(np.mean([np.square(errors(e, r)) for r, e in made], axis=0))
        record = made[0][1].sensors["camera"]
        refused = record.gated.sum() / (record.gated | record.used).sum()
    assert (found[0.1] <= 1.15 * found[0.0]).all()
    assert 0.05 < refused < 0.14


def test_images_alone_with_mismatches():
    """Would catch a reflection from a subset in one plane, which no rotation is; images given up in which
    one landmark lies beside a plane that holds the others; and a pose that mismatches pull."""
    beside = 0
    for seed in range(3):
        grade = CameraGrade(mismatched=0.1)
        run = camera_recording("run", seed=seed, duration_s=5.4, grade=grade)
        camera = run.camera
        floor = camera.usable & (camera.p_ref_landmark[:, 0] == 0.0)
        beside += np.sum(floor.sum(axis=1) == 1)
        found = pnp.poses(camera)
        assert found.valid.all()
        at = encoder_at(run.need_encoder(), camera.time_ns)
        off = np.linalg.norm(found.position - at.position, axis=1)[at.valid]
        assert np.median(off) < 0.03
        assert off.max() < 0.2
    assert beside > 5


def test_images_without_a_pose_are_told():
    """Would catch a pose made up of three points, and arrays that none of the images fills."""
    run = camera_recording("run", seed=2, duration_s=1.0, grade=few())
    camera = run.camera
    order = np.cumsum(camera.visible, axis=1)
    three = replace(camera, visible=camera.visible & (order <= 3))
    mixed = camera.visible.copy()
    mixed[::2] = three.visible[::2]
    for changed, valid in ((three, 0), (replace(camera, visible=mixed), len(mixed) // 2)):
        found = pnp.poses(changed)
        assert found.valid.sum() == valid
        assert not found.position[~found.valid].any()
        assert not found.fits[~found.valid].any()
    whole = pnp.poses(camera)
    np.testing.assert_allclose(found.position[1::2], whole.position[1::2], atol=1e-8)


def test_cameras_that_see_nothing_are_refused():
    """Would catch an array of no rows that NumPy cannot shape, instead of a sentence."""
    run = camera_recording("run", seed=2, duration_s=1.0, grade=few())
    camera = run.camera
    with pytest.raises(jaxekf.RecordingError, match="no landmark"):
        replace(camera, names=(), pixel=camera.pixel[:, :0], visible=camera.visible[:, :0])
    nothing = {"pixel": camera.pixel[:0], "visible": camera.visible[:0]}
    empty = replace(camera, time_ns=camera.time_ns[:0], **nothing)
    dark = replace(camera, visible=np.zeros_like(camera.visible))
    for changed, said in ((empty, "0 samples in camera"), (dark, "landmarks in an image")):
        with pytest.raises(jaxekf.RecordingError, match=said):
            jaxekf.estimate(run.replace(camera=changed), "visual")


def test_a_start_is_sought_where_a_pose_follows():
    """Would catch a start from images before the first with a pose, or from too few of them: solving for
    all images of an hour to start from the first would take minutes."""
    run = camera_recording("run", seed=2, duration_s=4.0, grade=few(), blind=((0.0, 2.0),))
    camera = run.camera
    order = np.cumsum(camera.visible, axis=1)
    visible = camera.visible & ((order <= 3) | (np.arange(len(order)) >= 40)[:, None])
    late = run.replace(camera=replace(camera, visible=visible))
    samples = {"camera": correspondences.camera(8, False, late)}
    start = correspondences.find_start(late, samples)
    assert start.time_ns == camera.time_ns[40]
    whole = pnp.poses(late.camera)
    np.testing.assert_allclose(start.first["position"], whole.position[40], atol=1e-8)
    near = slice(40, 45)
    t = (camera.time_ns[near] - camera.time_ns[40]) / 1e9
    weight = 1.0 / correspondences._uncertainty(whole)[near]
    slope = np.polyfit(t, whole.position[near], 1, w=weight)[0]
    np.testing.assert_allclose(start.first["velocity"], slope, atol=1e-6)


def with_unseen(camera, count):
    """The camera with further landmarks, behind the others, that no image shows."""
    more = [f"unseen-{i}" for i in range(count)]
    images = len(camera.time_ns)
    return replace(
        camera,
        names=(*camera.names, *more),
        pixel=np.concatenate([camera.pixel, np.full((images, count, 2), np.nan)], axis=1),
        visible=np.concatenate([camera.visible, np.zeros((images, count), bool)], axis=1),
        p_ref_landmark=np.concatenate([camera.p_ref_landmark, camera.p_ref_landmark[:count] + 1.0]),
    )


def test_a_start_is_where_the_pose_is_known(monkeypatch):
    """Would catch a run that starts from four points which a pose far off fits as well, metres away, while
    the gates refuse every good point thereafter."""
    grade = CameraGrade(points=4)
    run = camera_recording("run", seed=1, duration_s=SECONDS, grade=grade)
    # As many landmarks as elsewhere, of which the others are never seen, and as long: the same program.
    monkeypatch.setattr(padding, "bucket", lambda count: 64)
    run = run.replace(camera=with_unseen(run.camera, POINTS - 4))
    first = int(np.argmax(pnp.poses(run.camera).valid))
    made = jaxekf.estimate(run, "visual")
    assert made.time_ns[0] > run.camera.time_ns[first]
    position, attitude = errors(made, run)
    assert position < 0.05
    assert attitude < np.deg2rad(0.5)
    assert any("with a certain pose" in note for note in made.notes)


def test_a_start_does_not_wait_for_the_best_image():
    """Would catch a run of poor images of which most is lost before the one that tells its pose best."""
    run = camera_recording("run", seed=0, duration_s=6.0, grade=few(pixel=6.0))
    camera = run.camera
    found = pnp.poses(camera)
    doubt = np.where(found.valid, correspondences._uncertainty(found), np.inf)
    assert np.argmin(doubt) > 50
    start = correspondences.find_start(run, {"camera": correspondences.camera(8, False, run)})
    first = int(np.flatnonzero(camera.time_ns == start.time_ns)[0])
    assert first < 30
    assert doubt[first] < 3.0 < np.median(doubt)
    # Of images of which none is known well, the first of those that are known alike.
    early = np.arange(len(doubt)) < 12
    _, first = correspondences._first_pose(camera, early)
    assert first == np.argmax(doubt <= 1.5 * doubt[early].min()) < np.argmin(doubt[early])


def test_what_lies_behind_the_camera_tells_nothing():
    """Would catch slopes of points that no image shows, which let such a point through every gate and make
    the covariance infinite."""
    params = as_arrays(visual.DEFAULTS)
    project = partial(pinhole.project, visual.lens_of(params))
    both = jax.jit(lambda place: (project(place), jax.jacrev(project)(place)))
    for place in ([0.1, 0.2, -0.5], [0.1, 0.2, 0.0], [0.1, 0.2, 1e-4]):
        point, slope = both(jnp.asarray(place))
        assert not np.any(slope)
        assert np.all(np.abs(point) > 1e3)


def test_a_point_that_no_lens_maps_is_no_point():
    """Would catch sums of an image that one huge point makes infinite, so that no image has a pose."""
    camera = camera_recording("run", seed=2, duration_s=1.0, grade=few()).camera
    known = pnp.poses(camera)
    image, landmark = np.argwhere(camera.usable)[0]
    # A point at which the lens maps nothing: ``1 + radial r^2`` is 0 there.
    bent = replace(camera, radial=np.array([-0.25, 0.0]))
    for changed, pixel in (
        (camera, [1e300, -1e300]),
        (bent, camera.centre + np.array([2.0 * camera.focal[0], 0.0])),
    ):
        point = camera.pixel.copy()
        point[image, landmark] = pixel
        found = pnp.poses(replace(changed, pixel=point))
        assert not found.fits[image, landmark]
        assert np.isfinite(found.position).all()
        if changed is camera:
            assert found.valid.tolist() == known.valid.tolist()
            np.testing.assert_allclose(found.position[1:], known.position[1:], atol=1e-8)
    point = camera.pixel.copy()
    point[image] = 1e300
    assert pnp.poses(replace(camera, pixel=point)).valid.sum() == known.valid.sum() - 1


def test_figures_of_a_camera(tmp_path):
    """Would catch a camera whose runs have no pictures, or poses of thinned images taken for gaps."""
    blind = ((1.5, 2.0),)
    run = camera_recording("run", seed=2, duration_s=SECONDS, grade=few(), blind=blind)
    made = jaxekf.estimate(run, "visual")
    names = plots.available_figures(made, run)
    assert names == ("attitude", "bias", "occlusion", "path", "position", "rate", "velocity")
    for name in names:
        figure = plots.figure_functions()[name](made, run)
        plots.save(figure, tmp_path / f"{name}.png")
        said = [
            text.get_text() for text in (figure.legends or [figure.axes[0].get_legend()])[0].texts
        ]
        if name in ("attitude", "position", "path"):
            assert "pose of an image" in said
        if name not in ("path", "occlusion"):
            assert "no landmark" in said
    begin, end = plots.longest_gap(run, made)
    assert end - begin == pytest.approx(0.5, abs=0.1)
    whole = measurements.pose_measurements(made, run)
    thin = run.replace(camera=replace(run.camera))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(measurements, "_MOST_IMAGES", 20)
        shown = measurements.pose_measurements(made, thin)
        assert plots.longest_gap(thin, made) == (begin, end)
    assert 0 < len(shown.t) <= 20 < len(whole.t)
    assert (shown.lost, shown.blind) == (whole.lost, whole.blind)


def test_poses_are_kept_with_their_camera():
    """Would catch images solved again for every figure, and poses of a camera that is gone given to another
    at the same place in memory."""
    camera = camera_recording("run", seed=2, duration_s=1.0, grade=few()).camera
    found = pnp.poses(camera)
    assert pnp.poses(camera) is found and pnp.cached_poses(camera) is found
    kept = len(pnp._CACHE)
    del camera
    assert len(pnp._CACHE) == kept - 1


def test_tables_count_a_camera_as_the_tracker():
    """Would catch `0 of 0` rows and no NIS of a run with a camera, and a mean over the IMU beside it: that
    the gyroscope is predicted badly says nothing of the images."""
    nis = {"accelerometer": 0.4, "gyroscope": 0.02, "camera": 0.9}
    account = {name: {"used": 7, "read": 8} for name in nis}
    assert [s.name for s in visual.MODEL.sensors] == list(nis)
    summary = {"run": "a", "duration_s": 1.0, "account": account, "mean_nis": nis}
    assert table_row(summary, ())[2:] == [0.9, "7 of 8"]
    assert tracker_nis(SimpleNamespace(sensors=nis, mean_nis=nis.get)) == 0.9
    assert tracker_nis(SimpleNamespace(sensors={"own": 0.5}, mean_nis={"own": 0.5}.get)) == 0.5


def test_points_that_fit_no_pose_are_not_called_too_few():
    """Would catch a user whose names or lens are wrong being sent to record more landmarks."""
    run = camera_recording("run", seed=2, duration_s=1.0, grade=few())
    camera = run.camera
    mixed = np.random.default_rng(0).permutation(len(camera.names))
    for changed in (
        replace(camera, p_ref_landmark=camera.p_ref_landmark[mixed]),
        replace(camera, focal=np.array([3.2, 3.2])),
    ):
        with pytest.raises(jaxekf.RecordingError, match="none of which fits any pose") as told:
            jaxekf.estimate(run.replace(camera=changed), "visual")
        assert "names" in str(told.value)


def test_gravity_off_by_a_degree():
    """Would catch gravity that is subtracted in the wrong frame: without vision 1 deg is 0.17 m/s^2, and
    8.5 cm after a second, as the source says (row 5)."""
    run = camera_recording("run", seed=4, duration_s=SECONDS, grade=few(), blind=((0.1, 9.0),))
    up = np.asarray(run.info["gravity_ref"])
    off = Rotation.from_rotvec(np.deg2rad([0.0, 1.0, 0.0])).apply(up)
    params = visual.DEFAULTS._replace(
        initial=visual.DEFAULTS.initial._replace(accelerometer_bias=1e-6, attitude=1e-6),
        noise=visual.DEFAULTS.noise._replace(accelerometer_walk=1e-9),
    )
    ends = []
    for gravity in (up, off):
        changed = run.replace(info=dict(run.info) | {"gravity_ref": gravity.tolist()})
        made = jaxekf.estimate(changed, "visual", params)
        ends.append(made.outputs["position"].value)
    at = np.flatnonzero(made.time >= made.time[0] + 0.08)
    # From the second image on, the last.
    start, second = at[0], np.argmin(np.abs(made.time - made.time[at[0]] - 1.0))
    drift = (ends[1] - ends[0])[second] - (ends[1] - ends[0])[start]
    assert np.linalg.norm(drift) == pytest.approx(0.085, abs=0.01)


@pytest.mark.long
@pytest.mark.skipif(not scenario.LONG, reason="long form: set JAXEKF_LONG=1")
def test_the_camera_is_found_where_it_is():
    """Would catch a lever arm or alignment whose gradient has the wrong frame (row 3)."""
    turn, shift = np.deg2rad([1.2, -1.0, 1.25]), np.array([0.012, -0.011, 0.0115])
    trained = []
    for seed in range(4):
        run = camera_recording(
            f"run-{seed}",
            camera_runs.shaken(seed),
            seed=seed,
            duration_s=15.0,
            # A minute of eight points leaves a standard deviation of 2 mm, of thirty 1 mm.
            grade=CameraGrade(),
        )
        camera = run.need_camera()
        wrong = replace(
            camera,
            q_body_camera=from_scipy(
                to_scipy(camera.q_body_camera) * Rotation.from_rotvec(turn).inv()
            ),
            p_body_camera=camera.p_body_camera - shift,
        )
        trained.append(run.replace(camera=wrong, encoder=None))
    tuned = tuning.tune(
        trained,
        # A camera that is 2 deg off puts most points beyond the gates.
        model=jaxekf.robust("visual", "none"),
        objective="map",
        free=["calibration.lever_arm", "calibration.alignment"],
        optimiser=tuning.FisherScoring(),
        iterations=12,
        confidence_intervals=True,
    )
    calibration = tuned.params.calibration
    off = Rotation.from_rotvec(calibration.alignment) * Rotation.from_rotvec(turn).inv()
    assert np.rad2deg(off.magnitude()) < 0.1
    assert np.linalg.norm(np.asarray(calibration.lever_arm) - shift) < 2e-3
    planted = dict(zip("012", shift, strict=True)), dict(zip("012", turn, strict=True))
    held = 0
    for name, true in zip(("lever_arm", "alignment"), planted, strict=True):
        for i, value in true.items():
            _, low, high = tuned.intervals[f"calibration.{name}[{i}]"]
            held += low <= value <= high
    # Of six intervals of 95 %; four or fewer hold in 3 of 100 draws.
    assert held >= 4


def test_whitening_is_that_of_the_whole_image():
    """Would catch a NIS of many rows that is not ``r' inv(S) r``."""
    rng = np.random.default_rng(8)
    root = rng.standard_normal((20, 20))
    cov, residual = root @ root.T + np.eye(20), rng.standard_normal(20)
    wanted = float(residual @ np.linalg.solve(cov, residual))
    assert float(ekf._nis(jnp.asarray(residual), jnp.asarray(cov))) == pytest.approx(wanted)
    small = linalg.squared_distance(jnp.asarray(residual[:5]), jnp.asarray(cov[:5, :5]))
    assert float(ekf._nis(jnp.asarray(residual[:5]), jnp.asarray(cov[:5, :5]))) == float(small)
