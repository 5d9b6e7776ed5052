"""Samples, gaps and masked rows of the streams of a recording over time."""

from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.patches import Patch

from jaxekf.checks.inspection import Inspection, StreamSummary
from jaxekf.recordings.types import NANOSECONDS, Flags, Floats, Recording, Times
from jaxekf.reporting.plots.style import ESTIMATE, REFUSED, beside, new_figure, stretches, styled

_BINS = 400
_HEIGHT = 0.72
_LEAST_WIDTH = 1 / 600
"""Least width of a bar, as a fraction of the axis, so that short gaps are visible."""
_GAP = "#f4cccc"
_COLOURS = ("#e69138", "#8e7cc3", "#6aa84f", "#bf9000", "#a64d79", "#45818e", "#7f6000", "#999999")


def time_axis(recording: Recording, found: Inspection) -> Figure:
    """One lane for each stream or marker, over seconds since the first sample of the recording.

    A lane has the rate of its samples, relative to the nominal one, as bars; gaps; and masked samples, with
    a colour for each reason.
    """
    lanes = _lanes(recording, found)
    origin = min(int(lane[1][0]) for lane in lanes.values())
    last = max(int(lane[1][-1]) for lane in lanes.values())
    span = max((last - origin) / NANOSECONDS, 1e-9)
    colours: dict[str, str] = {}
    with styled():
        figure = new_figure((11, 1.7 + 0.62 * len(lanes)))
        axes: Any = figure.subplots()
        for line, (summary, time_ns, masked) in enumerate(lanes.values()):
            t = (time_ns - origin) / NANOSECONDS
            _density(axes, line, t, summary, masked)
            least = _LEAST_WIDTH * span
            zero = origin / NANOSECONDS
            bars = [_bar(a - zero, b - zero, least) for a, b in summary.gaps.spans]
            axes.broken_barh(bars, _upper(line), color=_GAP, lw=0, zorder=2)
            edges = [(a, 0.0) for a, _ in bars] + [(a + w, 0.0) for a, w in bars]
            axes.broken_barh(edges, _upper(line), edgecolor=REFUSED, lw=0.4, zorder=3)
            for reason, flags in masked.items():
                colour = colours.setdefault(reason, _COLOURS[len(colours) % len(_COLOURS)])
                spans = [_bar(a, b, least) for a, b in _stretches(t, flags)]
                axes.broken_barh(spans, _upper(line), color=colour, lw=0, zorder=4)
            beside(axes, line, _summary_text(summary))
        axes.set_yticks(range(len(lanes)), list(lanes))
        axes.tick_params(axis="y", length=0)
        axes.set_ylim(len(lanes) - 0.45, -0.55)
        axes.set_xlim(-0.005 * span, 1.005 * span)
        axes.grid(visible=False, axis="y")
        axes.set_axisbelow(True)
        axes.set_xlabel(f"time since {origin / NANOSECONDS:.3f} s, corrected for latency (s)")
        legend = [Patch(color=ESTIMATE, label="sample rate (full height: nominal rate)")]
        if any(summary.gaps.count for summary, _, _ in lanes.values()):
            legend.append(Patch(facecolor=_GAP, edgecolor=REFUSED, lw=0.4, label="gap: no rows"))
        legend += [Patch(color=colour, label=name) for name, colour in colours.items()]
        figure.legend(handles=legend, loc="outside lower center", ncols=min(4, len(legend)))
        figure.suptitle(f"{found.run}: samples over time")
    return figure


def _lanes(
    recording: Recording, found: Inspection
) -> dict[str, tuple[StreamSummary, Times, dict[str, Flags]]]:
    """Summary, sample times and masked samples by reason, for each lane."""
    lanes = {}
    for label, stream in recording.streams.items():
        time_ns = stream.time_ns - stream.latency_ns
        if label == "markers":
            for i, (name, summary) in enumerate(found.markers.items()):
                lost = {"hidden, or quality too low": ~stream.usable[:, i]}
                lanes[f"marker {name}"] = (summary, time_ns, lost)
            continue
        if label == "camera":
            # The samples are the images: a lane for each landmark would be too many.
            empty = ~stream.usable.any(axis=1)
            masked = {"no landmark found": empty} if empty.any() else {}
        else:
            masked = _masked(recording, label, stream)
        lanes[label] = (found.streams[label], time_ns, masked)
    return lanes


def _masked(recording: Recording, label: str, stream: Any) -> dict[str, Flags]:
    """Flags of the unused samples of a stream, by reason."""
    bad = ~getattr(stream, "valid", np.ones(len(stream.time_ns), bool))
    account = recording.intake.get(label)
    by_reason: dict[str, Flags] = {}
    for name, reason in ({} if account is None else account.masked).items():
        flags = np.isin(stream.time_ns, reason.time_ns)
        if flags.any():
            by_reason[name] = flags
            bad = bad & ~flags
    if bad.any():
        by_reason["not valid"] = bad
    return by_reason


def _density(
    axes: Any, line: int, t: Floats, summary: StreamSummary, masked: dict[str, Flags]
) -> None:
    """Bars of the rate of usable samples, relative to the nominal rate."""
    good = np.ones(len(t), bool)
    for flags in masked.values():
        good &= ~flags
    span = float(t[-1] - t[0])
    if not summary.rate_hz > 0.0 or span <= 0.0:
        axes.plot(t[good], np.full(int(good.sum()), line), "|", color=ESTIMATE, ms=18)
        return
    # A bin holds about 20 samples, so that rounding to whole samples does not look like noise.
    bins = int(np.clip(span * summary.rate_hz / 20.0, 1, _BINS))
    edges = np.linspace(t[0], t[-1] + 1.0 / summary.rate_hz, bins + 1)
    count, whole = np.histogram(t[good], edges)[0], np.diff(edges) * summary.rate_hz
    # A bin may have one sample less because of where its edges are.
    top = _HEIGHT * np.where(count > whole - 1.5, 1.0, count / whole)
    foot = line + _HEIGHT / 2
    axes.stairs(foot - top, edges, baseline=foot, fill=True, color=ESTIMATE, lw=0, zorder=1)


def _upper(line: int) -> tuple[float, float]:
    return line - _HEIGHT / 2, _HEIGHT


def _bar(begin: float, end: float, least: float) -> tuple[float, float]:
    """Begin and width of a bar, at least `least` wide."""
    width = max(end - begin, least)
    return 0.5 * (begin + end - width), width


def _stretches(t: Floats, chosen: Flags) -> list[tuple[float, float]]:
    return [(float(t[a]), float(t[min(b, len(t) - 1)])) for a, b in stretches(chosen)]


def _summary_text(summary: StreamSummary) -> str:
    lines = [f"{summary.rate_hz:.4g} Hz" if summary.rate_hz == summary.rate_hz else "1 sample"]
    if summary.gaps.count:
        lines.append(f"{summary.gaps.count} gaps, {summary.gaps.lost_s:.3g} s")
    if summary.usable < summary.samples:
        lines.append(f"{100.0 * (1.0 - summary.usable / summary.samples):.2g} % masked")
    return "\n".join(lines)
