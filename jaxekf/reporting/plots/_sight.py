"""What tracker or camera saw of a run, and when it saw nothing: measurements and shading of the figures.

Everything stands at the time it was taken, as the estimate does, and not when it arrived.
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
"""More poses than a figure can show are not solved for."""


class Sight(NamedTuple):
    """The tracker's or the camera's own view of a run; nothing is seen of a run without either."""

    pose: Optical
    """The raw pose, without any filter, of the body's origin; valid where there is one."""
    seen: Flags
    """(N,) poses that are valid and not before the estimate begins."""
    t: Floats
    """Seconds since the estimate's first instant, of the poses seen."""
    known: Floats
    """The same of all poses, those included that were not solved for."""
    label: str
    lost: list[Stretch]
    """Begin and end, in seconds, of what is longer than two periods without a pose."""
    blind: list[Stretch]
    """Of what is without any marker or landmark."""
    words: tuple[str, str] = ("tracker hidden", "")
    """For what is lost and what is blind."""
    frame: str = "the tracker's frame"
    """That poses are in."""


def seconds(time_ns: Times, estimate: Estimated) -> Floats:
    """Seconds since the estimate's first instant."""
    return (time_ns - estimate.time_ns[0]) / NANOSECONDS


def truth(estimate: Estimated, recording: Recording) -> Encoder | None:
    """The encoder at the estimate's instants."""
    if recording.encoder is None:
        return None
    return encoder_at(recording.encoder, estimate.time_ns)


def look(estimate: Estimated, recording: Recording) -> Sight:
    """What the tracker saw: its poses, or those of markers or images where there are only those."""
    optical, markers, camera = recording.optical, recording.markers, recording.camera
    if optical is not None:
        return _sight(estimate, at_origin(optical), "tracker")
    if markers is not None:
        found = _sight(estimate, at_origin(pose.from_markers(markers)), "pose of the markers")
        blind = _gaps(found.pose.time_ns, np.asarray(markers.usable.any(axis=1)), estimate)
        return found._replace(blind=blind, words=("fewer than 3 markers", "no marker"))
    if camera is not None:
        return _of_images(estimate, camera)
    nothing = Optical(np.zeros(0, np.int64), np.zeros((0, 4)), np.zeros(0, bool))
    return _sight(estimate, nothing, "")._replace(lost=[], frame="the reference frame")


def _sight(estimate: Estimated, raw: Optical, label: str) -> Sight:
    seen = raw.valid & (raw.time_ns >= estimate.time_ns[0])
    lost = _gaps(raw.time_ns, raw.valid, estimate)
    t = seconds(raw.time_ns[seen], estimate)
    return Sight(raw, seen, t, t, label, lost, [])


def _of_images(estimate: Estimated, camera: Camera) -> Sight:
    """Poses of some images, of each by itself; what is lost is told by all of them."""
    raw = at_origin(pnp.as_optical(camera, _MOST_IMAGES))
    taken = raw.time_ns
    enough = np.asarray(camera.usable.sum(axis=1) >= pnp.FEWEST)
    return _sight(estimate, raw, "pose of an image")._replace(
        known=seconds(taken[enough & (taken >= estimate.time_ns[0])], estimate),
        lost=_gaps(taken, enough, estimate),
        blind=_gaps(taken, np.asarray(camera.usable.any(axis=1)), estimate),
        words=(f"fewer than {pnp.FEWEST} landmarks", "no landmark"),
        frame="the scene",
    )


def at_origin(raw: Optical) -> Optical:
    """The pose of the body's origin at the times it was taken."""
    position = raw.position
    if position is not None and raw.p_body_tool is not None:
        position = position - to_scipy(raw.q_ref_body).apply(raw.p_body_tool)
    taken = raw.time_ns - raw.latency_ns
    return replace(raw, time_ns=taken, position=position, p_body_tool=None, latency_ns=0)


def _gaps(time_ns: Times, seen: Flags, estimate: Estimated) -> list[Stretch]:
    """Stretches of the estimate with nothing seen for more than two periods, its end included."""
    longest = 2.5 * period_ns(time_ns) / NANOSECONDS
    end = float(estimate.time[-1])
    t = np.append(seconds(time_ns[seen], estimate), end)
    ends = pairwise(t)
    return [(max(float(a), 0.0), float(b)) for a, b in ends if b - a > longest and b > 0.0]


def shade(axes: Any, sight: Sight) -> None:
    """Grey where there is no pose, darker where no marker at all is seen."""
    for stretches, colour, label in (
        (sight.lost, "0.90", sight.words[0]),
        (sight.blind, "0.78", sight.words[1]),
    ):
        for i, (begin, end) in enumerate(stretches):
            axes.axvspan(begin, end, color=colour, lw=0, zorder=0, label=label if i == 0 else None)


def longest_gap(recording: Recording, estimate: Estimated) -> Stretch:
    """Start and end, in seconds since the start of the estimate, of the longest time without a pose."""
    t, end = look(estimate, recording).known, float(estimate.time[-1])
    t = np.append(t[t < end], end)
    if len(t) < 2:
        return 0.0, end
    at = int(np.argmax(np.diff(t)))
    return float(t[at]), float(t[at + 1])
