"""Single markers: visibility, use by the filter, and innovations."""

from typing import Any, NamedTuple

import numpy as np
from matplotlib.figure import Figure

from jaxekf._support import chi_square
from jaxekf.estimation.result import Estimate, SensorRecord
from jaxekf.models import tight
from jaxekf.recordings.types import NANOSECONDS, Flags, Floats, Recording, Times, period_ns
from jaxekf.reporting.plots._measurements import pose_measurements, seconds, shade
from jaxekf.reporting.plots._registry import figure
from jaxekf.reporting.plots.style import (
    AXES,
    ESTIMATE,
    HIDDEN,
    MEASURED,
    REFUSED,
    TRUTH,
    band,
    beside,
    finish,
    new_figure,
    new_grid,
    stretches,
    styled,
)

_HEIGHT = 0.6
_AXIS_COLOURS = (ESTIMATE, MEASURED, "#6aa84f")


def marker_sensors(estimate: Estimate, recording: Recording) -> dict[str, SensorRecord]:
    """The records of the model's marker sensors by marker name, in the order of the recording."""
    names = () if recording.markers is None else recording.markers.names
    return {
        name: estimate.sensors[tight.sensor_name(name)]
        for name in names
        if tight.sensor_name(name) in estimate.sensors
    }


def _has_marker_sensors(estimate: Estimate, recording: Recording) -> bool:
    return bool(marker_sensors(estimate, recording))


class _Usage(NamedTuple):
    """Flags (frames,) of one marker: used, refused by the gate, or hidden."""

    used: Flags
    refused: Flags
    hidden: Flags


def _usage(frames: Times, record: SensorRecord) -> _Usage:
    used = np.isin(frames, record.time_ns[record.used.any(axis=1)])
    gated = record.gated.any(axis=1) & ~record.used.any(axis=1)
    refused = np.isin(frames, record.time_ns[gated])
    return _Usage(used, refused, ~used & ~refused)


@figure(_has_marker_sensors)
def visibility(estimate: Estimate, recording: Recording) -> Figure:
    """One line for each marker: used, refused by the gate, or hidden, with percentages."""
    markers = recording.need_markers()
    taken = estimate.clock.from_tracker(markers.time_ns - markers.latency_ns)
    frames = taken[(taken >= estimate.time_ns[0]) & (taken <= estimate.time_ns[-1])]
    t, width = seconds(frames, estimate), period_ns(taken) / NANOSECONDS
    records = marker_sensors(estimate, recording)
    with styled():
        drawn = new_figure((11, 1.7 + 0.5 * len(records)))
        axes: Any = drawn.subplots()
        for line, record in enumerate(records.values()):
            _line(axes, line, t, width, _usage(frames, record))
        axes.set_yticks(range(len(records)), [f"marker {name}" for name in records])
        axes.set_ylim(len(records) - 0.45, -0.55)
        axes.set_xlim(0.0, float(estimate.time[-1]))
        axes.grid(visible=False, axis="y")
        finish(
            drawn,
            np.array([[axes]]),
            f"{estimate.run}: visibility and use of each marker",
            estimate.clock,
        )
    return drawn


def _line(axes: Any, line: int, t: Floats, width: float, usage: _Usage) -> None:
    """Bars of used and hidden frames; a vertical line for each refused one, too short for a bar."""
    first = line == 0
    for chosen, colour, label in (
        (usage.hidden, HIDDEN, "hidden, or quality too low"),
        (usage.used, ESTIMATE, "used"),
    ):
        bars = _stretches(t, chosen, width)
        where = (line - _HEIGHT / 2, _HEIGHT)
        axes.broken_barh(bars, where, color=colour, lw=0, label=label if first else None)
    at, label = t[usage.refused] + width / 2, "refused by the gate" if first else None
    ends = line - _HEIGHT / 2, line + _HEIGHT / 2
    axes.vlines(at, *ends, color=REFUSED, lw=1.5, label=label)
    shares = [100.0 * part.mean() if part.size else 0.0 for part in usage]
    words = zip(shares, ("used", "refused", "hidden"), strict=True)
    text = "\n".join(f"{share:.1f} % {word}" for share, word in words)
    beside(axes, line, text)


def _stretches(t: Floats, chosen: Flags, width: float) -> list[tuple[float, float]]:
    """Begin and length in seconds of intervals of chosen frames; a frame lasts until the next."""
    ends = np.append(t[1:], t[-1:] + width)
    return [(float(t[a]), float(ends[b - 1] - t[a])) for a, b in stretches(chosen)]


@figure(_has_marker_sensors)
def innovations(estimate: Estimate, recording: Recording) -> Figure:
    """For each marker: innovations in mm with their 2 sigma band on the left, NIS with the 95 % interval of
    the chi-square distribution on the right."""
    records, poses = marker_sensors(estimate, recording), pose_measurements(estimate, recording)
    with styled():
        size = (11, 1.2 + 1.8 * len(records))
        drawn, grid = new_grid(len(records), 2, size, sharex=True)
        for (name, record), row in zip(records.items(), grid, strict=True):
            t = seconds(record.time_ns, estimate)
            for axes in row:
                shade(axes, poses)
            _residuals(row[0], t, record)
            gate = estimate.model.sensor(tight.sensor_name(name)).gate
            _nis(row[1], t, record, gate)
            row[0].set_ylabel(f"marker {name}\ninnovation (mm)")
            row[1].set_ylabel(f"marker {name}\nNIS (1)")
        finish(
            drawn,
            grid,
            f"{estimate.run}: innovations of single markers, reference frame",
            estimate.clock,
        )
    return drawn


def _residuals(axes: Any, t: Floats, record: SensorRecord) -> None:
    """Innovations of the used samples, along each axis."""
    used = record.used.all(axis=1)
    rows = np.arange(record.residual.shape[1])
    # The standard deviations of the axes are nearly equal: one band is enough.
    sigma = 1e3 * np.sqrt(record.cov[:, rows, rows]).mean(axis=1)
    # The band ends where samples are missing, since nothing was predicted there.
    shown = _broken(np.column_stack([t, np.where(used, sigma, np.nan)]))
    band(axes, shown[:, 0], 0.0 * shown[:, 0], shown[:, 1], "predicted ± 2σ")
    for axis, colour, values in zip(AXES, _AXIS_COLOURS, record.residual.T, strict=True):
        axes.plot(t[used], 1e3 * values[used], ".", ms=2, color=colour, label=axis)
    if used.any():
        reach = 1.3 * max(
            np.quantile(2 * sigma[used], 0.95),
            1e3 * np.quantile(np.abs(record.residual[used]), 0.998),
        )
        axes.set_ylim(-reach, reach)


def _broken(rows: Floats) -> Floats:
    """Rows (N, 2) of time and value, with a NaN inserted in each gap."""
    if len(rows) < 2:
        return rows
    step = np.diff(rows[:, 0])
    far = np.flatnonzero(step > 2.5 * np.median(step)) + 1
    middle = np.column_stack([rows[far, 0], np.full(len(far), np.nan)])
    return np.insert(rows, far, middle, axis=0)


def _nis(axes: Any, t: Floats, record: SensorRecord, gate: float | None) -> None:
    """NIS, its expected mean, 95 % interval and gate."""
    rows = record.residual.shape[1]
    used = record.used.any(axis=1)
    gated = record.gated.any(axis=1) & ~used
    low, high = chi_square.ppf([0.025, 0.975], rows)
    axes.axhspan(low, high, color=ESTIMATE, alpha=0.22, lw=0, label="95 % interval, χ²")
    axes.plot(t[used], record.nis[used], ".", ms=2, color=ESTIMATE, label="NIS, used")
    axes.plot(t[gated], record.nis[gated], "x", ms=4, color=REFUSED, label="NIS, refused")
    axes.axhline(rows, color=TRUTH, lw=1, label="expected mean")
    if gate is not None:
        axes.axhline(chi_square.ppf(gate, rows), color=REFUSED, lw=1, ls="--", label="gate")
    axes.set_yscale("log")
    axes.set_ylim(bottom=1e-2)
