"""Rate, position and velocity: vectors beside what was measured and what is true, and their errors."""

from typing import Any, NamedTuple

import numpy as np
from matplotlib.figure import Figure

from jaxekf.estimation.result import Estimate
from jaxekf.recordings.truth import encoder_at, encoder_rate_at, encoder_velocity_at
from jaxekf.recordings.types import Encoder, Floats, Recording
from jaxekf.reporting.plots._sight import Sight, look, seconds, shade, truth
from jaxekf.reporting.plots.style import (
    AXES,
    ESTIMATE,
    MEASURED,
    TRUTH,
    band,
    finish,
    new_grid,
    styled,
    symmetric_limits,
)


class _Measured(NamedTuple):
    """What a sensor says of the same vector."""

    t: Floats
    """(M,) seconds since the estimate's first instant."""
    value: Floats
    """(M, 3)."""
    truth: Floats | None
    """(M, 3), NaN where it is not known."""
    label: str
    dots: bool


class _Vector(NamedTuple):
    """One vector over time, in the unit it is shown in."""

    labels: tuple[str, str]
    """Of the vector and of its error, with ``{}`` for the axis."""
    value: Floats
    sigma: Floats
    truth: Floats | None
    measured: _Measured | None
    noisy: bool = False
    """Whether each instant has noise of its own, as a rate read from a gyroscope has."""


def rate(estimate: Estimate, recording: Recording) -> Figure:
    """Angular rate on the left; error against truth with the 2 sigma band on the right."""
    imu, encoder = recording.need_imu(), recording.encoder
    inside = (imu.time_ns >= estimate.time_ns[0]) & (imu.time_ns <= estimate.time_ns[-1])
    times = imu.time_ns[inside]
    known = at_imu = None
    if encoder is not None:
        known = np.rad2deg(encoder_rate_at(encoder, estimate.time_ns))
        at_imu = np.rad2deg(encoder_rate_at(encoder, times))
    gyroscope = np.rad2deg(imu.gyroscope[inside])
    vector = _Vector(
        ("rate about {} (deg/s)", "error about {} (deg/s)"),
        np.rad2deg(estimate.rate.value),
        np.rad2deg(estimate.rate.sigma),
        known,
        _Measured(seconds(times, estimate), gyroscope, at_imu, "gyroscope", dots=False),
        noisy=True,
    )
    title = f"{estimate.run}: angular rate of the tool, body frame"
    return _draw(estimate, look(estimate, recording), vector, title)


def position(estimate: Estimate, recording: Recording) -> Figure:
    """Position of the body's origin on the left; error with the 2 sigma band on the right; mm."""
    sight, known = look(estimate, recording), truth(estimate, recording)
    measured = None
    if sight.pose.position is not None:
        times = sight.pose.time_ns[sight.seen]
        there = None
        if recording.encoder is not None:
            there = _known_mm(encoder_at(recording.encoder, times))
        seen = 1e3 * sight.pose.position[sight.seen]
        measured = _Measured(sight.t, seen, there, sight.label, dots=True)
    output = estimate.outputs["position"]
    vector = _Vector(
        ("{} (mm)", "error of {} (mm)"),
        1e3 * output.value,
        1e3 * output.sigma,
        None if known is None else _known_mm(known),
        measured,
    )
    return _draw(estimate, sight, vector, f"{estimate.run}: position of the body in {sight.frame}")


def velocity(estimate: Estimate, recording: Recording) -> Figure:
    """Velocity of the body's origin on the left; error with the 2 sigma band on the right; mm/s."""
    encoder, output = recording.encoder, estimate.outputs["velocity"]
    known = None
    if encoder is not None and encoder.position is not None:
        known = 1e3 * encoder_velocity_at(encoder, estimate.time_ns)
    vector = _Vector(
        ("velocity along {} (mm/s)", "error along {} (mm/s)"),
        1e3 * output.value,
        1e3 * output.sigma,
        known,
        None,
    )
    sight = look(estimate, recording)
    title = f"{estimate.run}: velocity of the body in {sight.frame}"
    return _draw(estimate, sight, vector, title)


def _known_mm(encoder: Encoder) -> Floats | None:
    """True positions (N, 3) in mm, NaN where they are not known; None for an encoder without."""
    if encoder.position is None:
        return None
    return np.where(encoder.valid[:, None], 1e3 * encoder.position, np.nan)


def _draw(estimate: Estimate, sight: Sight, vector: _Vector, title: str) -> Figure:
    """A row for each axis; the errors on the right where the truth is known."""
    with styled():
        figure, grid = new_grid(3, 1 if vector.truth is None else 2, (11, 6.5), sharex=True)
        for i, axis in enumerate(AXES):
            axes = grid[i, 0]
            shade(axes, sight)
            _curve(axes, estimate, vector, i)
            axes.set_ylabel(vector.labels[0].format(axis))
            if vector.truth is not None:
                axes = grid[i, 1]
                shade(axes, sight)
                _error(axes, estimate, vector, vector.truth, i)
                axes.set_ylabel(vector.labels[1].format(axis))
        finish(figure, grid, title)
    return figure


def _measured(axes: Any, values: Floats, measured: _Measured) -> None:
    marks: Any = {"ls": "", "marker": ".", "ms": 2.5} if measured.dots else {"lw": 0.6}
    axes.plot(measured.t, values, color=MEASURED, label=measured.label, **marks)


def _curve(axes: Any, estimate: Estimate, vector: _Vector, i: int) -> None:
    """The vector along one axis. The truth is wide, so that a smooth estimate does not hide it, or stands
    before a noisy one."""
    t, value = estimate.time, vector.value[:, i]
    if vector.measured is not None:
        _measured(axes, vector.measured.value[:, i], vector.measured)
    if vector.truth is not None:
        line: Any = {"lw": 1.0, "zorder": 3} if vector.noisy else {"lw": 2.2}
        axes.plot(t, vector.truth[:, i], color=TRUTH, label="encoder", **line)
    band(axes, t, value, vector.sigma[:, i], "2σ of the estimate")
    axes.plot(t, value, color=ESTIMATE, lw=1.0, label="estimate")
    _limits(axes, vector, i)


def _error(axes: Any, estimate: Estimate, vector: _Vector, known: Floats, i: int) -> None:
    """Measured and estimated, each less the truth at its own time."""
    error = vector.value[:, i] - known[:, i]
    shown = error
    if vector.measured is not None and vector.measured.truth is not None:
        raw = vector.measured.value[:, i] - vector.measured.truth[:, i]
        _measured(axes, raw, vector.measured)
        shown = np.r_[error, raw]
    band(axes, estimate.time, np.zeros(len(error)), vector.sigma[:, i], "2σ of the estimate")
    width = 0.5 if vector.noisy else 0.8
    axes.plot(estimate.time, error, color=ESTIMATE, lw=width, label="estimate")
    if vector.noisy:
        for side in (-2.0, 2.0):  # the band's edges, since the noise hides the band
            axes.plot(estimate.time, side * vector.sigma[:, i], color=TRUTH, lw=0.8)
    symmetric_limits(axes, shown)


def _limits(axes: Any, vector: _Vector, i: int) -> None:
    """The range of the curves: a wide band at the start, or a stray sample, must not flatten them."""
    values = vector.value[:, i]
    if vector.measured is not None:
        # A tracker may tell an attitude without a position.
        known = vector.measured.value[np.isfinite(vector.measured.value[:, i]), i]
        values = np.r_[values, np.quantile(known, [0.005, 0.995])] if known.size else values
    low, high = values.min(), values.max()
    margin = 0.1 * (high - low) + 1e-9
    axes.set_ylim(low - margin, high + margin)
