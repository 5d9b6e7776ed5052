"""Rate, position and velocity, with measurement and truth, and their errors."""

from typing import Any, NamedTuple

import numpy as np
from matplotlib.figure import Figure

from jaxekf.estimation.result import Estimate
from jaxekf.recordings.truth import encoder_at, encoder_rate_at, encoder_velocity_at
from jaxekf.recordings.types import Encoder, Floats, Recording
from jaxekf.reporting.plots._measurements import (
    PoseMeasurements,
    pose_measurements,
    seconds,
    shade,
    truth,
)
from jaxekf.reporting.plots._registry import figure, has_output
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
    """Measurements of the vector by one sensor."""

    t: Floats
    """(M,) seconds since the estimate's first instant."""
    value: Floats
    """(M, 3)."""
    truth: Floats | None
    """(M, 3) truth at these times, NaN where it is unknown."""
    label: str
    dots: bool


class _Vector(NamedTuple):
    """One vector over time, in the unit of the figure."""

    labels: tuple[str, str]
    """Axis labels of the vector and of its error, with ``{}`` for the axis."""
    value: Floats
    sigma: Floats
    truth: Floats | None
    measured: _Measured | None
    noisy: bool = False
    """Whether it has white noise, as a rate from a gyroscope; the truth is then drawn in front."""


@figure(lambda estimate, recording: "rate" in estimate.outputs and recording.imu is not None)
def rate(estimate: Estimate, recording: Recording) -> Figure:
    """Angular rate in deg/s, body frame, on the left; errors with the 2 sigma band on the right."""
    imu, encoder = recording.need_imu(), recording.encoder
    inside = (imu.time_ns >= estimate.time_ns[0]) & (imu.time_ns <= estimate.time_ns[-1])
    times = imu.time_ns[inside]
    known = at_imu = None
    if encoder is not None:
        known = np.rad2deg(encoder_rate_at(encoder, estimate.time_ns))
        at_imu = np.rad2deg(encoder_rate_at(encoder, times))
    gyroscope = np.rad2deg(imu.gyroscope[inside])
    vector = _Vector(
        ("rate about {} (deg/s)", "rate error about {} (deg/s)"),
        np.rad2deg(estimate.rate.value),
        np.rad2deg(estimate.rate.sigma),
        known,
        _Measured(seconds(times, estimate), gyroscope, at_imu, "gyroscope", dots=False),
        noisy=True,
    )
    title = f"{estimate.run}: angular rate of the tool, body frame"
    return _draw(estimate, pose_measurements(estimate, recording), vector, title)


@figure(has_output("position"))
def position(estimate: Estimate, recording: Recording) -> Figure:
    """Position of the body's origin in mm on the left; errors with the 2 sigma band on the right."""
    poses, known = pose_measurements(estimate, recording), truth(estimate, recording)
    measured = None
    if poses.pose.position is not None:
        times = poses.pose.time_ns[poses.seen]
        there = None
        if recording.encoder is not None:
            there = _known_mm(encoder_at(recording.encoder, times))
        seen = 1e3 * poses.pose.position[poses.seen]
        measured = _Measured(poses.t, seen, there, poses.label, dots=True)
    output = estimate.outputs["position"]
    vector = _Vector(
        ("position {} (mm)", "position error {} (mm)"),
        1e3 * output.value,
        1e3 * output.sigma,
        None if known is None else _known_mm(known),
        measured,
    )
    return _draw(estimate, poses, vector, f"{estimate.run}: position of the body in {poses.frame}")


@figure(has_output("velocity"))
def velocity(estimate: Estimate, recording: Recording) -> Figure:
    """Velocity of the body's origin in mm/s on the left; errors with the 2 sigma band on the right."""
    encoder, output = recording.encoder, estimate.outputs["velocity"]
    known = None
    if encoder is not None and encoder.position is not None:
        known = 1e3 * encoder_velocity_at(encoder, estimate.time_ns)
    vector = _Vector(
        ("velocity {} (mm/s)", "velocity error {} (mm/s)"),
        1e3 * output.value,
        1e3 * output.sigma,
        known,
        None,
    )
    poses = pose_measurements(estimate, recording)
    title = f"{estimate.run}: velocity of the body in {poses.frame}"
    return _draw(estimate, poses, vector, title)


def _known_mm(encoder: Encoder) -> Floats | None:
    """True positions (N, 3) in mm, NaN where unknown; None for an encoder without positions."""
    if encoder.position is None:
        return None
    return np.where(encoder.valid[:, None], 1e3 * encoder.position, np.nan)


def _draw(estimate: Estimate, poses: PoseMeasurements, vector: _Vector, title: str) -> Figure:
    """One row of panels for each axis; errors on the right if there is a truth."""
    with styled():
        drawn, grid = new_grid(3, 1 if vector.truth is None else 2, (11, 6.5), sharex=True)
        for i, axis in enumerate(AXES):
            axes = grid[i, 0]
            shade(axes, poses)
            _curve(axes, estimate, vector, i)
            axes.set_ylabel(vector.labels[0].format(axis))
            if vector.truth is not None:
                axes = grid[i, 1]
                shade(axes, poses)
                _error(axes, estimate, vector, vector.truth, i)
                axes.set_ylabel(vector.labels[1].format(axis))
        finish(drawn, grid, title)
    return drawn


def _measured(axes: Any, values: Floats, measured: _Measured) -> None:
    marks: Any = {"ls": "", "marker": ".", "ms": 2.5} if measured.dots else {"lw": 0.6}
    axes.plot(measured.t, values, color=MEASURED, label=measured.label, **marks)


def _curve(axes: Any, estimate: Estimate, vector: _Vector, i: int) -> None:
    """One component of the vector. The truth is a wide line behind a smooth estimate, or a thin one in
    front of a noisy estimate."""
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
    """Errors of measurement and estimate, each at its own times."""
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
    """Limits from the curves, not from the wide band at the start or from single outliers."""
    values = vector.value[:, i]
    if vector.measured is not None:
        # A tracker may measure an attitude without a position.
        known = vector.measured.value[np.isfinite(vector.measured.value[:, i]), i]
        values = np.r_[values, np.quantile(known, [0.005, 0.995])] if known.size else values
    low, high = values.min(), values.max()
    margin = 0.1 * (high - low) + 1e-9
    axes.set_ylim(low - margin, high + margin)
