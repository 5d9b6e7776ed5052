"""Samples and start of the model `visual` from a camera's images."""

from collections.abc import Mapping
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from jaxekf._support.errors import RecordingError
from jaxekf.filtering.model import Start
from jaxekf.geometry import pinhole
from jaxekf.models import inertial
from jaxekf.pose_solvers import pnp
from jaxekf.pose_solvers.pnp import Resection
from jaxekf.recordings.types import (
    NANOSECONDS,
    Camera,
    Flags,
    Floats,
    Recording,
    Samples,
    Times,
    to_scipy,
)

_LINE_S = 0.35
_NEAR_S = 0.1
"""Largest time, s, between the first image and the IMU sample that gives acceleration and rate there."""
START_POSITION, START_ATTITUDE = 0.05, float(np.deg2rad(1.0))
"""Standard deviations, metres and radians, of the initial pose."""
_PIXEL = 1.0
"""Noise of image points that is assumed at least when an initial pose is chosen."""
_GOOD = 1.5
"""Largest uncertainty of an initial pose in units of these deviations: eight points usually reach it, four
rarely do. If no pose reaches it, the bound is relative to the best pose."""
_PATIENCE_S = 5.0
"""Seconds after which twice that uncertainty is accepted, and so on, since samples before the start are
lost. Images with fewer than `_SURE` points always need the strict bound, as they may fit a wrong pose
by chance."""
_SURE = pnp.FEWEST
_FIRST = 16
"""Images that are solved first in the search for a start."""


class Point(NamedTuple):
    """Data of one correspondence: its landmark and the reported noise."""

    p_ref_landmark: Any
    """(3,) metres."""
    sigma: Any
    """Reported standard deviation, pixels; 0 if none was reported; ()."""


class BilinearPoint(NamedTuple):
    """The same for the bilinear form, in which the image point enters the slope."""

    p_ref_landmark: Any
    sigma: Any
    pixel: Any
    """(2,) the image point."""
    depth: Any
    """Depth along the optical axis, m, from the single-image pose; ()."""


def camera(count: int, bilinear: bool, recording: Recording) -> Samples:
    """Image points (N, 2 count) of the first `count` visible landmarks; zeros in the bilinear form."""
    stream = recording.need_camera()
    usable = stream.usable
    # Visible landmarks in order, then others as padding.
    order = np.argsort(~usable, axis=1, kind="stable")[:, :count]
    here = np.arange(len(stream.time_ns))[:, None]
    mask = usable[here, order]
    pixel = np.where(mask[..., None], stream.pixel[here, order], 0.0)
    short = count - order.shape[1]
    sigma = np.zeros(mask.shape)
    if stream.sigma is not None:
        sigma = np.nan_to_num(np.where(mask, stream.sigma[here, order], 0.0))
    place = stream.p_ref_landmark[order]
    place, sigma, value = (_padded(a, short) for a in (place, sigma, pixel))
    aux: Any = Point(place, sigma)
    if bilinear:
        aux = BilinearPoint(place, sigma, value, _depth(stream, place, recording))
        value = np.zeros_like(value)
    rows = np.repeat(_padded(mask, short), 2, axis=1)
    taken = stream.time_ns - stream.latency_ns
    flat = value.reshape(len(value), 2 * count)
    there = stream.visible.sum(axis=1)
    known = (stream.latency_ns, ("camera",))
    return Samples(taken, flat, rows, aux, *known, points=there, copies=count)


def _padded(values: Any, short: int) -> Any:
    """Arrays with `short` more groups (axis 1), copies of the first."""
    return np.concatenate([values, np.repeat(values[:, :1], short, axis=1)], axis=1)


def _depth(stream: Camera, place: Any, recording: Recording) -> Any:
    """Depths (N, M), m, of landmarks (N, M, 3), from the pose of the nearest image that has one."""
    found = pnp.poses(stream)
    known = np.flatnonzero(found.valid)
    if known.size == 0:
        raise RecordingError(
            recording.path or recording.name,
            "no image from which a pose follows",
            "one, whose depths the bilinear form needs",
            "the model visual, or a run with six landmarks in an image",
        )
    at = known[np.argmin(np.abs(np.arange(len(found.valid))[:, None] - known[None]), axis=1)]
    away = place - found.position[at][:, None]
    inside = np.stack(
        [to_scipy(found.q_ref_body[at]).inv().apply(away[:, i]) for i in range(away.shape[1])],
        axis=1,
    )
    forward = to_scipy(stream.q_body_camera).inv()
    flat = (inside - stream.p_body_camera).reshape(-1, 3)
    return np.maximum(forward.apply(flat)[:, 2].reshape(place.shape[:2]), pinhole.NEAREST)


def find_start(recording: Recording, samples: Mapping[str, Samples]) -> Start | None:
    """The first image with a certain pose, with the IMU sample next to it."""
    stream, imu = recording.need_camera(), recording.need_imu()
    taken = stream.time_ns - stream.latency_ns
    fit = np.isin(taken, samples["camera"].time_ns)
    fit &= (taken >= imu.time_ns[0]) & (taken <= imu.time_ns[-1])
    found, first = _first_pose(stream, fit)
    if first is None:
        enough = int((stream.usable[fit].sum(axis=1) >= pnp.FEWEST).sum())
        if enough:
            raise pnp.no_pose_error(recording.path or recording.name, enough)
        return None
    known: dict[str, Any] = {
        "position": found.position[first],
        "q_ref_body": found.q_ref_body[first],
        "velocity": _velocity(taken, found, fit, first),
    }
    near = int(np.argmin(np.abs(imu.time_ns - taken[first])))
    if abs(int(imu.time_ns[near] - taken[first])) <= _NEAR_S * NANOSECONDS:
        known["rate"] = imu.gyroscope[near]
        if imu.accelerometer is not None:
            force = to_scipy(found.q_ref_body[first]).apply(imu.accelerometer[near])
            known["acceleration"] = force + inertial.gravity(
                recording, lambda: pnp.as_optical(stream)
            )
    waited = (taken[first] - taken[0]) / NANOSECONDS
    note = ""
    if waited > 0.0:
        note = f"waited {waited:.3f} s for an image with a certain pose to start from"
    return Start(int(taken[first]), known, note)


def _first_pose(stream: Camera, fit: Flags) -> tuple[Resection, int | None]:
    """Poses of images, and the index of the first one that is certain enough to start from.

    The bound on the uncertainty grows with the time waited; if no pose reaches it, one nearly as
    certain as the best is taken, and None if there is no pose. Images are solved up to that one, and
    those from which its velocity follows.
    """
    taken, count = stream.time_ns, len(stream.time_ns)
    solved = np.zeros(count, bool)
    waited = np.maximum(taken - taken[np.argmax(fit)], 0) / NANOSECONDS if count else np.zeros(0)
    sure = stream.usable.sum(axis=1) >= _SURE
    limit = _GOOD * np.where(sure, 1.0 + waited / _PATIENCE_S, 1.0)
    some = _FIRST
    while True:
        found = pnp.cached_poses(stream)
        solved[np.flatnonzero(fit)[:some]] = True
        if found is None:
            found = pnp.poses(replace(stream, visible=stream.visible & solved[:, None]))
        else:
            solved[:] = True
        valid = found.valid & fit
        uncertainty = np.where(valid, _uncertainty(found), np.inf)
        good = np.flatnonzero(uncertainty <= limit)
        everything = bool(solved[fit].all())
        if good.size:
            first = int(good[0])
            needed = fit & (taken <= taken[first] + int(_LINE_S * NANOSECONDS))
            if everything or solved[needed].all():
                return found, first
        elif everything:
            if not valid.any():
                return found, None
            return found, int(
                np.argmax(uncertainty <= np.where(sure, _GOOD, 1.0) * uncertainty.min())
            )
        some *= 2


def _uncertainty(found: Resection) -> Floats:
    """(N,) largest standard deviation of each pose in units of `Initial`, for a pixel of noise at least."""
    sigma = np.sqrt(np.diagonal(found.cov, axis1=1, axis2=2))
    chance = np.maximum(1.0, _PIXEL / np.maximum(found.error, 1e-9))
    return chance * np.max(sigma / np.repeat([START_POSITION, START_ATTITUDE], 3), axis=1)


def _velocity(taken: Times, found: Resection, fit: Flags, first: int) -> Floats:
    """Velocity (3,), m/s, at an image: slope of a weighted line through the positions of the next 0.35 s.

    It is zero if there is only one position.
    """
    t = (taken - taken[first]) / NANOSECONDS
    near = found.valid & fit & (t >= 0.0) & (t <= _LINE_S)
    if near.sum() < 2:
        return np.zeros(3)
    weight = 1.0 / np.maximum(_uncertainty(found)[near], 1e-3)
    return np.polynomial.polynomial.polyfit(t[near], found.position[near], 1, w=weight)[1]
