"""Poses measured by tracker or camera, and the times without one, for the figures.

All times are those at which a sample was taken, on the clock of the estimate, not those at which it
arrived.
"""

from dataclasses import replace
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np

from jaxekf.estimation.result import Estimated
from jaxekf.pose_solvers import marker_pose as pose
from jaxekf.pose_solvers import pnp
from jaxekf.recordings.truth import encoder_at
from jaxekf.recordings.types import (
    NANOSECONDS,
    Camera,
    Encoder,
    Flags,
    Floats,
    Optical,
    Recording,
    Times,
    period_ns,
    to_scipy,
)

Stretch = tuple[float, float]
_MOST_IMAGES = 3000
"""Largest number of images whose poses are computed; a figure cannot show more."""


class PoseMeasurements(NamedTuple):
    """Poses of one run by its tracker or camera, without any filter; none for a run without either."""

    pose: Optical
    """Measured poses of the body's origin."""
    seen: Flags
    """(N,) poses that are valid and not before the first instant of the estimate."""
    t: Floats
    """Seconds from the estimate's first instant to each pose in `seen`."""
    t_all: Floats
    """As `t`, with the poses of images that were not computed (see `_MOST_IMAGES`)."""
    label: str
    """Legend text of the poses."""
    lost: list[Stretch]
    """Begin and end in seconds of the intervals longer than two periods without a pose."""
    blind: list[Stretch]
    """Begin and end in seconds of those without any marker or landmark."""
    words: tuple[str, str] = ("tracker hidden", "")
    """Legend texts of `lost` and `blind`."""
    frame: str = "the tracker frame"
    """Reference frame of the poses."""


def seconds(time_ns: Times, estimate: Estimated) -> Floats:
    """Seconds since the estimate's first instant."""
    return (time_ns - estimate.time_ns[0]) / NANOSECONDS


def truth(recording: Recording | None, estimate: Estimated, time_ns: Times) -> Encoder | None:
    """The encoder at some times of the estimate's clock; None without a recording or an encoder."""
    if recording is None or recording.encoder is None:
        return None
    return encoder_at(recording.encoder, estimate.clock.to_encoder(time_ns, recording))


def pose_measurements(estimate: Estimated, recording: Recording) -> PoseMeasurements:
    """The poses of the tracker or, without a tracker, those computed from markers or images."""
    optical, markers, camera = recording.optical, recording.markers, recording.camera
    if optical is not None:
        return _valid_poses(estimate, _placed(estimate, optical), "tracker")
    if markers is not None:
        measured = _valid_poses(
            estimate, _placed(estimate, pose.from_markers(markers)), "pose of the markers"
        )
        blind = _gaps(measured.pose.time_ns, np.asarray(markers.usable.any(axis=1)), estimate)
        return measured._replace(blind=blind, words=("fewer than 3 markers", "no marker"))
    if camera is not None:
        return _of_images(estimate, camera)
    nothing = Optical(np.zeros(0, np.int64), np.zeros((0, 4)), np.zeros(0, bool))
    return _valid_poses(estimate, nothing, "")._replace(lost=[], frame="the reference frame")


def _valid_poses(estimate: Estimated, raw: Optical, label: str) -> PoseMeasurements:
    seen = raw.valid & (raw.time_ns >= estimate.time_ns[0])
    lost = _gaps(raw.time_ns, raw.valid, estimate)
    t = seconds(raw.time_ns[seen], estimate)
    return PoseMeasurements(raw, seen, t, t, label, lost, [])


def _of_images(estimate: Estimated, camera: Camera) -> PoseMeasurements:
    """The pose of each image by itself, for at most `_MOST_IMAGES` images; `lost` is by all images."""
    raw = _placed(estimate, pnp.as_optical(camera, _MOST_IMAGES))
    taken = estimate.clock.from_tracker(camera.time_ns - camera.latency_ns)
    enough = np.asarray(camera.usable.sum(axis=1) >= pnp.FEWEST)
    return _valid_poses(estimate, raw, "pose of an image")._replace(
        t_all=seconds(taken[enough & (taken >= estimate.time_ns[0])], estimate),
        lost=_gaps(taken, enough, estimate),
        blind=_gaps(taken, np.asarray(camera.usable.any(axis=1)), estimate),
        words=(f"fewer than {pnp.FEWEST} landmarks", "no landmark"),
        frame="the scene",
    )


def at_origin(raw: Optical) -> Optical:
    """The poses of the body's origin, at the times at which they were taken."""
    position = raw.position
    if position is not None and raw.p_body_tool is not None:
        position = position - to_scipy(raw.q_ref_body).apply(raw.p_body_tool)
    taken = raw.time_ns - raw.latency_ns
    return replace(raw, time_ns=taken, position=position, p_body_tool=None, latency_ns=0)


def _placed(estimate: Estimated, raw: Optical) -> Optical:
    """The poses of the body's origin, on the clock of the estimate."""
    there = at_origin(raw)
    return replace(there, time_ns=estimate.clock.from_tracker(there.time_ns))


def _gaps(time_ns: Times, seen: Flags, estimate: Estimated) -> list[Stretch]:
    """Intervals of the estimate longer than two periods without a sample in `seen`, up to its end."""
    longest = 2.5 * period_ns(time_ns) / NANOSECONDS
    end = float(estimate.time[-1])
    t = np.append(seconds(time_ns[seen], estimate), end)
    ends = pairwise(t)
    return [(max(float(a), 0.0), float(b)) for a, b in ends if b - a > longest and b > 0.0]


def shade(axes: Any, poses: PoseMeasurements) -> None:
    """Shade the times without a pose grey, and those without any marker or landmark darker."""
    for stretches, colour, label in (
        (poses.lost, "0.90", poses.words[0]),
        (poses.blind, "0.78", poses.words[1]),
    ):
        for i, (begin, end) in enumerate(stretches):
            axes.axvspan(begin, end, color=colour, lw=0, zorder=0, label=label if i == 0 else None)


def longest_gap(recording: Recording, estimate: Estimated) -> Stretch:
    """Begin and end of the longest time without a pose, in seconds since the start of the estimate."""
    t, end = pose_measurements(estimate, recording).t_all, float(estimate.time[-1])
    t = np.append(t[t < end], end)
    if len(t) < 2:
        return 0.0, end
    at = int(np.argmax(np.diff(t)))
    return float(t[at]), float(t[at + 1])
