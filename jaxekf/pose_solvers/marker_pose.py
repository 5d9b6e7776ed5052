"""Pose of a rigid tool from single markers, and gravity from poses and an accelerometer, on the host.

`absolute_orientation` solves single frames, `fit_markers` checks them against the tool's geometry,
`from_markers` returns them as a tracker's stream; `first_consistent_pose` and `gravity` prepare the start
of a filter.
"""

from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from jaxekf._support import arrays
from jaxekf._support.deprecations import renamed
from jaxekf._support.errors import RecordingError
from jaxekf.geometry.host_rotation import nearest_rotation
from jaxekf.recordings.truth import encoder_at
from jaxekf.recordings.types import (
    NANOSECONDS,
    Encoder,
    Flags,
    Floats,
    Imu,
    Markers,
    Optical,
    Times,
    from_scipy,
    to_scipy,
)

START_FIT = 4.0
"""Factor over the median error: a run does not start from a frame with a larger one."""
_LARGEST_MISFIT = 0.25
"""Share of the tool's size: a larger error means markers of another tool."""
_START_S = 1.0
_START_TURN = 6.0
_LEAST_TURN = 1e-3
_LARGEST_SPEED = 3.0
_LEAST_MARKERS = 3
_LEAST_SPREAD = 0.05
"""Ratio of width to length below which markers are collinear."""
_LONGEST_STEP_S = 0.2
_LEAST_GRAVITY_S = 0.5


class MarkerPose(NamedTuple):
    """Rigid-body poses of many frames."""

    q_ref_body: Floats
    """(N, 4) unit quaternions, body to reference."""
    position: Floats
    """(N, 3) metres, the body's origin in the reference frame."""
    error: Floats
    """(N,) metres, root mean square distance of the markers from their fitted places."""
    valid: Flags
    """(N,) False if fewer than three markers are visible or all are collinear; the pose is then the
    identity."""


def absolute_orientation(p_body_marker: Floats, position: Floats, usable: Flags) -> MarkerPose:
    """Least-squares poses from markers (Arun, Huang, Blostein 1987; Kabsch 1976; never a reflection).

    Parameters
    ----------
    p_body_marker
        (M, 3) metres, body frame.
    position
        (N, M, 3) metres, reference frame.
    usable
        (N, M) visible markers.

    Examples
    --------
    >>> import numpy as np
    >>> from jaxekf.pose_solvers import marker_pose
    >>> p_body_marker = 0.1 * np.eye(3)
    >>> turned = p_body_marker[:, [1, 0, 2]] * [-1.0, 1.0, 1.0]  # a quarter turn about z
    >>> pose = marker_pose.absolute_orientation(p_body_marker, turned[None], np.ones((1, 3), bool))
    >>> np.allclose(pose.q_ref_body, np.sqrt([0.5, 0.0, 0.0, 0.5])), bool(pose.valid[0])
    (True, True)
    """
    p_body_marker = arrays.floats(p_body_marker, arrays.argument("p_body_marker"), (None, 3))
    position = arrays.floats(position, arrays.argument("position"), (None, len(p_body_marker), 3))
    usable = arrays.flags(usable, arrays.argument("usable"), position.shape[:2])
    usable = usable & np.isfinite(position).all(axis=2)
    count = usable.sum(axis=1)
    weight = usable / np.maximum(count, 1)[:, None]
    measured = np.where(usable[..., None], position, 0.0)
    body = np.broadcast_to(p_body_marker, measured.shape)
    centre_body = np.einsum("nm,nmi->ni", weight, body)
    centre_ref = np.einsum("nm,nmi->ni", weight, measured)
    from_body = body - centre_body[:, None]
    from_ref = measured - centre_ref[:, None]
    spread = np.linalg.svd(
        np.where(usable[..., None], from_body, 0.0), compute_uv=False, full_matrices=False
    )
    valid = (count >= _LEAST_MARKERS) & (spread[:, 1] > _LEAST_SPREAD * spread[:, 0])
    cross = np.einsum("nm,nmi,nmj->nij", weight, from_ref, from_body)
    cross[~valid] = np.eye(3)
    matrix = nearest_rotation(cross)
    origin = centre_ref - np.einsum("nij,nj->ni", matrix, centre_body)
    off = from_ref - np.einsum("nij,nmj->nmi", matrix, from_body)
    error = np.sqrt(np.einsum("nm,nmi->n", weight, off**2))
    origin[~valid], error[~valid] = 0.0, 0.0
    return MarkerPose(from_scipy(Rotation.from_matrix(matrix)), origin, error, valid)


def fit_markers(markers: Markers, place: object) -> MarkerPose:
    """The pose of every frame, checked against the tool's geometry.

    Marker noise is small relative to the tool: a larger error means a wrong unit, wrong marker names,
    or the geometry of another tool.

    Raises
    ------
    RecordingError
        If the median error is above a quarter of the tool's size.
    """
    fit = absolute_orientation(markers.p_body_marker, markers.position, markers.usable)
    if not fit.valid.any():
        return fit
    size = float(np.ptp(markers.p_body_marker, axis=0).max())
    off = float(np.median(fit.error[fit.valid]))
    if off > _LARGEST_MISFIT * size:
        got = f"markers that are {off:.3g} m off a tool of {size:.3g} m in the best pose"
        hint = "metres in markers.csv and in its geometry, and each marker under its own name"
        raise RecordingError(str(place), got, f"at most {_LARGEST_MISFIT * size:.2g} m", hint)
    return fit


def from_markers(markers: Markers, fit: MarkerPose | None = None) -> Optical:
    """The pose that a tracker would report for its markers, frame by frame, without a filter.

    Parameters
    ----------
    markers
        Single markers.
    fit
        Result of `fit_markers`, if it is known.
    """
    if fit is None:
        fit = absolute_orientation(markers.p_body_marker, markers.position, markers.usable)
    late = markers.latency_ns
    return Optical(markers.time_ns, fit.q_ref_body, fit.valid, fit.position, latency_ns=late)


def velocity_at(times: Times, position: Floats, valid: Flags, first: int) -> Floats:
    """Velocity (3,), m/s, at the valid sample `first`, by the difference to the next valid one.

    It is zero if the next one is more than 0.2 s later.
    """
    after = np.flatnonzero(valid[first + 1 :])
    if after.size == 0:
        return np.zeros(3)
    second = first + 1 + int(after[0])
    step = (times[second] - times[first]) / NANOSECONDS
    if step > _LONGEST_STEP_S:
        return np.zeros(3)
    return (position[second] - position[first]) / step


def first_consistent_pose(optical: Optical, imu: Imu) -> int | None:
    """Index of the first valid pose that agrees with the gyroscope and does not jump.

    The search covers the first second; if no pose agrees, the first valid one is returned, and None
    without any. A tracker that has just found its tool may begin with a wrong pose, which persists
    for as long as gates refuse the samples that contradict it.
    """
    rows = np.flatnonzero(optical.valid)
    if rows.size == 0:
        return None
    times = optical.time_ns[rows] - optical.latency_ns
    span = np.diff(times) / NANOSECONDS
    known = (imu.time_ns - times[0]) / NANOSECONDS
    middle = (times[:-1] - times[0]) / NANOSECONDS + 0.5 * span
    rate = np.stack([np.interp(middle, known, imu.gyroscope[:, i]) for i in range(3)], axis=1)
    turn = to_scipy(optical.q_ref_body[rows])
    measured = Rotation.from_rotvec(rate * span[:, None])
    off = (measured.inv() * turn[:-1].inv() * turn[1:]).magnitude()
    near = span <= _LONGEST_STEP_S
    if not near.any():
        return int(rows[0])
    good = near & (off <= max(_LEAST_TURN, _START_TURN * float(np.median(off[near]))))
    if optical.position is not None:
        good &= np.linalg.norm(np.diff(optical.position[rows], axis=0), axis=1) <= (
            _LARGEST_SPEED * span
        )
    good &= times[:-1] - times[0] <= _START_S * NANOSECONDS
    return int(rows[np.argmax(good)]) if good.any() else int(rows[0])


def gravity(optical: Optical, imu: Imu, place: object) -> Floats:
    """Gravity vector (3,), m/s^2, in the reference frame, from poses and specific forces.

    Over every stretch with poses the mean specific force, rotated into the reference frame, is the
    mean acceleration (the change of velocity) minus gravity. The accelerometer's bias enters the
    result as far as the tool did not rotate.

    Raises
    ------
    RecordingError
        If accelerometer or positions are missing, or if no stretch of half a second has poses.
    """
    if imu.accelerometer is None or optical.position is None:
        raise RecordingError(str(place), "no accelerometer", "one", "a run with ax, ay, az")
    taken = optical.time_ns - optical.latency_ns
    arm = np.zeros(3) if optical.p_body_tool is None else optical.p_body_tool
    position = optical.position - to_scipy(optical.q_ref_body).apply(arm)
    path = Encoder(taken, optical.q_ref_body, optical.valid, optical.valid, position)
    at = encoder_at(path, imu.time_ns)
    force = to_scipy(at.q_ref_body).apply(imu.accelerometer)
    t = (imu.time_ns - imu.time_ns[0]) / NANOSECONDS
    known = np.concatenate([[0], at.valid.astype(int), [0]])
    begins, ends = np.flatnonzero(np.diff(known) == 1), np.flatnonzero(np.diff(known) == -1)
    total, lasted = np.zeros(3), 0.0
    for begin, end in zip(begins, ends, strict=True):
        inside = slice(begin, end)
        if t[end - 1] - t[begin] < _LEAST_GRAVITY_S or at.position is None:
            continue
        where = at.position[inside]
        start, stop, span = _end_velocities(t[inside], where)
        chosen = (t[inside] >= span[0]) & (t[inside] <= span[1])
        seconds = t[inside][chosen]
        gained = np.trapezoid(force[inside][chosen], seconds, axis=0)
        total += stop - start - gained
        lasted += seconds[-1] - seconds[0]
    if lasted == 0.0:
        got = f"no stretch of {_LEAST_GRAVITY_S} s with poses to find gravity from"
        expected = "one, or gravity_ref = [x, y, z] in recording.toml"
        hint = "stating the gravity vector in the reference frame of the poses"
        raise RecordingError(str(place), got, expected, hint)
    return total / lasted


def _end_velocities(t: Floats, position: Floats) -> tuple[Floats, Floats, tuple[float, float]]:
    """Velocities of lines fitted to both ends of a stretch, and the times at which they are valid."""
    width = min(0.1, 0.4 * (t[-1] - t[0]))
    head, tail = t <= t[0] + width, t >= t[-1] - width

    def slope(chosen: Flags) -> tuple[Floats, float]:
        middle = float(t[chosen].mean())
        line = np.polynomial.polynomial.polyfit(t[chosen] - middle, position[chosen], 1)
        return line[1], middle

    start, early = slope(head)
    stop, late = slope(tail)
    return start, stop, (early, late)


__getattr__ = renamed(__name__, "Fit>MarkerPose first_steady>first_consistent_pose")
