"""`loose_pose`: pose, velocity and IMU biases from a tracker's pose of the tool and an IMU.

Choose it for trackers that report a pose (NDI tools, motion capture). For single markers it uses the pose
computed from each frame, which `tight` avoids; Tobergte, Pomarlan, Hirzinger (2009) compare the two. The
prediction is their eqs. 18 to 22, see `inertial`.

- States (15 degrees of freedom), input, calibration and initial deviations: those of `inertial`.
- Sensor: `optical`, position (m, reference frame) of the tracked point and attitude of the tool.
- Noise: `gyroscope` rad/s/sqrt(Hz), `accelerometer` m/s^2/sqrt(Hz), `bias_walk` rad/s^2/sqrt(Hz),
  `accelerometer_walk` m/s^3/sqrt(Hz), `position` m, `optical` rad.
"""

from collections.abc import Mapping
from functools import partial
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxekf._support.constants import STANDARD_GRAVITY
from jaxekf.filtering.model import Input, Model, Parameters, Sensor, Start
from jaxekf.geometry import linalg, rotation
from jaxekf.geometry.manifold import SO3, Euclidean
from jaxekf.models import inertial, sources
from jaxekf.pose_solvers import marker_pose
from jaxekf.recordings.types import Flags, Optical, Recording, Samples, Times

GATE = 0.999


class Pose(NamedTuple):
    """Pose of the tracked tool in the reference frame."""

    position: Any
    q_ref_body: Any


class Noise(NamedTuple):
    """Noise parameters: each of shape (), (3,) or a lower-triangular factor (3, 3)."""

    gyroscope: Any
    accelerometer: Any
    bias_walk: Any
    """Random walk of the gyroscope's bias."""
    accelerometer_walk: Any
    position: Any
    """Standard deviation of a sample of the tracker's position, reference frame; a reported fit error is
    added."""
    optical: Any
    """Standard deviation of a sample of the tracker's attitude, body frame."""


class Setup(NamedTuple):
    """Constants of a recording; further fields as in `inertial.Setup`."""

    gravity_ref: Any
    p_body_object: Any
    q_body_object: Any
    p_body_tool: Any
    """(3,) metres: the point whose position the tracker reports, body frame."""


def predict_pose(x: inertial.State, u: Any, params: Parameters, aux: Any) -> Pose:
    """Position of the tracked point and attitude of the tool."""
    point = params.setup.p_body_tool + params.calibration.lever_arm
    turn = rotation.exp(params.calibration.alignment)
    return Pose(
        x.position + rotation.rotate(x.q_ref_body, point), rotation.product(x.q_ref_body, turn)
    )


def pose_noise(params: Parameters, aux: Any, dt: Array) -> Array:
    """Covariance (6, 6) of a pose; `aux` is its reported error, m."""
    position = linalg.covariance(params.noise.position, 3) + aux * aux * jnp.eye(3)
    return linalg.block_diagonal([position, linalg.covariance(params.noise.optical, 3)])


def raw_pose(recording: Recording) -> Optical:
    """The tracker's pose, or that of its markers."""
    if recording.optical is None and recording.markers is not None:
        return marker_pose.from_markers(recording.markers)
    return recording.need_optical()


def _source(recording: Recording) -> Samples:
    optical = raw_pose(recording)
    position = sources.tracked_position(optical, recording)
    valid = optical.valid & np.asarray(np.isfinite(position).all(axis=1))
    value = Pose(np.where(valid[:, None], position, 0.0), optical.q_ref_body)
    error = np.zeros(len(valid)) if optical.error is None else np.nan_to_num(optical.error)
    taken = optical.time_ns - optical.latency_ns
    return Samples(taken, value, valid, error, optical.latency_ns, ("optical",))


def _setup(recording: Recording) -> Setup:
    return Setup(
        *inertial.setup(recording, partial(raw_pose, recording)), _tracked_point(recording)
    )


def find_start(recording: Recording, samples: Mapping[str, Samples]) -> Start | None:
    """The first visible pose that agrees with the gyroscope; earlier samples are dropped.

    See `marker_pose.first_consistent_pose`; a pose from single markers must also fit the tool.
    """
    tracked = samples["optical"]
    visible = np.asarray(tracked.mask.all(axis=1))
    if recording.optical is None and recording.markers is not None:
        visible &= _fits(recording, tracked.time_ns)
    arm = _tracked_point(recording)
    origin = tracked.value.position - sources.rotated_to_reference(tracked.value.q_ref_body, arm)
    poses = Optical(tracked.time_ns, tracked.value.q_ref_body, visible, origin)
    first = marker_pose.first_consistent_pose(poses, recording.need_imu())
    if first is None:
        return None
    skipped = int(visible[:first].sum())
    known = {
        "position": origin[first],
        "q_ref_body": tracked.value.q_ref_body[first],
        "velocity": marker_pose.velocity_at(tracked.time_ns, origin, visible, first),
    }
    note = (
        f"{skipped} poses at the start contradict the gyroscope or jump: they are not used"
        if skipped
        else ""
    )
    return Start(int(tracked.time_ns[first]), known, note)


def _fits(recording: Recording, taken: Times) -> Flags:
    """Poses at these times whose markers fit the tool as well as most."""
    markers = recording.need_markers()
    fit = marker_pose.fit_markers(markers, recording.path or recording.name)
    chosen = np.isin(markers.time_ns - markers.latency_ns, taken)
    error, valid = fit.error[chosen], fit.valid[chosen]
    limit = marker_pose.START_FIT * np.median(error[valid]) if valid.any() else 0.0
    return valid & (error <= limit)


def _tracked_point(recording: Recording) -> Any:
    stated = raw_pose(recording).p_body_tool
    return np.zeros(3) if stated is None else np.asarray(stated, float)


DEFAULTS = Parameters(
    Noise(
        gyroscope=np.deg2rad(0.05),
        accelerometer=1.85e-3 * STANDARD_GRAVITY,
        bias_walk=np.deg2rad(0.002),
        accelerometer_walk=1e-3,
        position=0.5e-3,
        optical=np.deg2rad(0.2),
    ),
    inertial.CALIBRATION,
    inertial.INITIAL,
    Setup(*inertial.SETUP, np.zeros(3)),
)

UNITS = Parameters(
    Noise("rad/s/sqrt(Hz)", "m/s^2/sqrt(Hz)", "rad/s^2/sqrt(Hz)", "m/s^3/sqrt(Hz)", "m", "rad"),
    inertial.CALIBRATION_UNITS,
    inertial.INITIAL_UNITS,
)

SPACE: Any = Pose(Euclidean(3, "m", frame="reference"), SO3())

MODEL = Model(
    name="loose_pose",
    summary="pose, velocity and IMU biases from the tracker's pose and an IMU",
    space=inertial.SPACE,
    transition=inertial.transition,
    process_noise=inertial.process_noise,
    sensors=(
        Sensor("optical", SPACE, predict_pose, pose_noise, _source, gate=GATE, typical_aux=0.0),
    ),
    parameters=DEFAULTS,
    units=UNITS,
    noise_dims=Noise(3, 3, 3, 3, 3, 3),
    initial_mean=inertial.initial_mean,
    initial_covariance=inertial.initial_covariance,
    find_start=find_start,
    setup=_setup,
    input=Input("imu", sources.imu, inertial.clock_offset, inertial.clock_drift),
    outputs=inertial.OUTPUTS,
)
