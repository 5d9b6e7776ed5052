"""What the tracker saw of a run, and when it saw nothing: measurements and shading of the figures.

Everything stands at the time it was taken, as the estimate does, and not when it arrived.
"""

from dataclasses import replace
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np

from jaxekf import pose
from jaxekf.recording import (
    NANOSECONDS,
    Encoder,
    Flags,
    Floats,
    Optical,
    Recording,
    Times,
    period_ns,
    to_scipy,
)
from jaxekf.result import Estimated
from jaxekf.truth import encoder_at

Stretch = tuple[float, float]


class Sight(NamedTuple):
    """The tracker's own view of a run."""

    pose: Optical
    """The raw pose, without any filter, of the body's origin; valid where there is one."""
    seen: Flags
    """(N,) poses that are valid and not before the estimate begins."""
    t: Floats
    """Seconds since the estimate's first instant, of the poses seen."""
    label: str
    lost: list[Stretch]
    """Begin and end, in seconds, of what is longer than two periods without a pose."""
    blind: list[Stretch]
    """Of what is without any marker."""


def seconds(time_ns: Times, estimate: Estimated) -> Floats:
    """Seconds since the estimate's first instant."""
    return (time_ns - estimate.time_ns[0]) / NANOSECONDS


def truth(estimate: Estimated, recording: Recording) -> Encoder | None:
    """The encoder at the estimate's instants."""
    if recording.encoder is None:
        return None
    return encoder_at(recording.encoder, estimate.time_ns)


def look(estimate: Estimated, recording: Recording) -> Sight:
    """What the tracker saw: its poses, or those of the markers where there are only those."""
    optical, markers = recording.optical, recording.markers
    raw, label = optical, "tracker"
    if raw is None:
        raw, label = pose.from_markers(recording.need_markers()), "pose of the markers"
    raw = at_origin(raw)
    seen = raw.valid & (raw.time_ns >= estimate.time_ns[0])
    blind: list[Stretch] = []
    if optical is None and markers is not None:
        blind = _gaps(raw.time_ns, np.asarray(markers.usable.any(axis=1)), estimate)
    lost = _gaps(raw.time_ns, raw.valid, estimate)
    return Sight(raw, seen, seconds(raw.time_ns[seen], estimate), label, lost, blind)


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
    words = "fewer than 3 markers" if sight.label != "tracker" else "tracker hidden"
    for stretches, colour, label in (
        (sight.lost, "0.90", words),
        (sight.blind, "0.78", "no marker"),
    ):
        for i, (begin, end) in enumerate(stretches):
            axes.axvspan(begin, end, color=colour, lw=0, zorder=0, label=label if i == 0 else None)


def longest_gap(recording: Recording, estimate: Estimated) -> Stretch:
    """Start and end, in seconds since the start of the estimate, of the longest time without a pose."""
    t, end = look(estimate, recording).t, float(estimate.time[-1])
    t = np.append(t[t < end], end)
    if len(t) < 2:
        return 0.0, end
    at = int(np.argmax(np.diff(t)))
    return float(t[at]), float(t[at + 1])
