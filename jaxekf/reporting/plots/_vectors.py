"""Rate, position and velocity, with measurement and truth, and their errors."""

from collections.abc import Mapping
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np
from matplotlib.figure import Figure

from jaxekf.estimation.result import Estimate, Estimated
from jaxekf.recordings.truth import encoder_rate_at, encoder_velocity_at
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


class Measured(NamedTuple):
    """Measurements of a vector by one sensor, in the unit of the figure."""

    t: Floats
    """(M,) seconds since the estimate's first instant."""
    value: Floats
    """(M, 3)."""
    error: Floats | None
    """(M, 3) value minus truth, NaN where it is unknown."""
    label: str
    dots: bool = True


class Vector(NamedTuple):
    """One vector over time, in the unit of the figure."""

    labels: tuple[str, ...]
    """Label of each component."""
    unit: str
    value: Floats
    sigma: Floats
    truth: Floats | None
    error: Floats | None
    error_sigma: Floats
    measured: Measured | None
    noisy: bool = False
    """Whether it has white noise, as a rate from a gyroscope; the truth is then drawn in front."""


def rate_vector(
    estimate: Estimated, recording: Recording | None, poses: PoseMeasurements | None
) -> Vector:
    """Angular rate in deg/s, body frame, with the gyroscope."""
    encoder, imu = (None, None) if recording is None else (recording.encoder, recording.imu)
    known = measured = None
    if recording is not None and encoder is not None:
        at = estimate.clock.to_encoder(estimate.time_ns, recording)
        known = np.rad2deg(encoder_rate_at(encoder, at))
    if imu is not None:
        times = estimate.clock.from_imu(imu.time_ns)
        inside = (times >= estimate.time_ns[0]) & (times <= estimate.time_ns[-1])
        times, gyroscope, off = times[inside], np.rad2deg(imu.gyroscope[inside]), None
        if recording is not None and encoder is not None:
            at = estimate.clock.to_encoder(times, recording)
            off = gyroscope - np.rad2deg(encoder_rate_at(encoder, at))
        measured = Measured(seconds(times, estimate), gyroscope, off, "gyroscope", dots=False)
    output = estimate.outputs["rate"]
    return _vector("deg/s", np.rad2deg(output.value), np.rad2deg(output.sigma), known, measured)


def position_vector(
    estimate: Estimated, recording: Recording | None, poses: PoseMeasurements | None
) -> Vector:
    """Position of the body's origin in mm, with the poses."""
    measured = None
    if poses is not None and poses.pose.position is not None:
        seen = 1e3 * poses.pose.position[poses.seen]
        there = _known_mm(truth(recording, estimate, poses.pose.time_ns[poses.seen]))
        off = None if there is None else seen - there
        measured = Measured(poses.t, seen, off, poses.label)
    output, known = (
        estimate.outputs["position"],
        _known_mm(truth(recording, estimate, estimate.time_ns)),
    )
    return _vector("mm", 1e3 * output.value, 1e3 * output.sigma, known, measured)


def velocity_vector(
    estimate: Estimated, recording: Recording | None, poses: PoseMeasurements | None
) -> Vector:
    """Velocity of the body's origin in mm/s, which no sensor measures."""
    encoder, known = None if recording is None else recording.encoder, None
    if encoder is not None and encoder.position is not None:
        assert recording is not None
        at = estimate.clock.to_encoder(estimate.time_ns, recording)
        known = 1e3 * encoder_velocity_at(encoder, at)
    output = estimate.outputs["velocity"]
    return _vector("mm/s", 1e3 * output.value, 1e3 * output.sigma, known, None)


def _vector(
    unit: str, value: Floats, sigma: Floats, known: Floats | None, measured: Measured | None
) -> Vector:
    """A vector along x, y and z whose error is its difference from the truth."""
    error = None if known is None else value - known
    return Vector(AXES, unit, value, sigma, known, error, sigma, measured, unit == "deg/s")


@figure(lambda estimate, recording: "rate" in estimate.outputs and recording.imu is not None)
def rate(estimate: Estimate, recording: Recording) -> Figure:
    """Angular rate in deg/s, body frame, on the left; errors with the 2 sigma band on the right."""
    poses = pose_measurements(estimate, recording)
    names = "rate about {} (deg/s)", "rate error about {} (deg/s)"
    title = f"{estimate.run}: angular rate of the tool, body frame"
    return draw(estimate, poses, rate_vector(estimate, recording, poses), names, title)


@figure(has_output("position"))
def position(estimate: Estimate, recording: Recording) -> Figure:
    """Position of the body's origin in mm on the left; errors with the 2 sigma band on the right."""
    poses = pose_measurements(estimate, recording)
    names = "position {} (mm)", "position error {} (mm)"
    title = f"{estimate.run}: position of the body in {poses.frame}"
    return draw(estimate, poses, position_vector(estimate, recording, poses), names, title)


@figure(has_output("velocity"))
def velocity(estimate: Estimate, recording: Recording) -> Figure:
    """Velocity of the body's origin in mm/s on the left; errors with the 2 sigma band on the right."""
    poses = pose_measurements(estimate, recording)
    names = "velocity {} (mm/s)", "velocity error {} (mm/s)"
    title = f"{estimate.run}: velocity of the body in {poses.frame}"
    return draw(estimate, poses, velocity_vector(estimate, recording, poses), names, title)


def _known_mm(encoder: Encoder | None) -> Floats | None:
    """True positions (N, 3) in mm, NaN where unknown; None without an encoder of positions."""
    if encoder is None or encoder.position is None:
        return None
    return np.where(encoder.valid[:, None], 1e3 * encoder.position, np.nan)


def draw(
    estimate: Estimate,
    poses: PoseMeasurements,
    vector: Vector,
    names: tuple[str, str],
    title: str,
    *,
    limits: bool = True,
    error_style: Mapping[str, float] = MappingProxyType({}),
) -> Figure:
    """One row of panels for each axis; errors on the right if there is a truth.

    `names` are the axis labels of the vector and of its error, with ``{}`` for the component. With
    `limits` the vertical range is that of the curves, not of the band. `error_style` has the ``width`` of
    the error's line and the ``alpha`` of the measurements.
    """
    with styled():
        drawn, grid = new_grid(3, 1 if vector.error is None else 2, (11, 6.5), sharex=True)
        for i, row in enumerate(grid):
            for axes in row:
                shade(axes, poses)
            _curve(row[0], estimate, vector, i)
            row[0].set_ylabel(names[0].format(vector.labels[i]))
            if limits:
                row[0].set_ylim(*curve_range(vector, i, 0.1))
            if vector.error is not None:
                _error(row[1], estimate, vector, vector.error[:, i], i, **error_style)
                row[1].set_ylabel(names[1].format(AXES[i]))
        finish(drawn, grid, title, estimate.clock)
    return drawn


def _measured(axes: Any, values: Floats, measured: Measured, alpha: float = 1.0) -> None:
    marks: Any = {"ls": "", "marker": ".", "ms": 2.5} if measured.dots else {"lw": 0.6}
    axes.plot(measured.t, values, color=MEASURED, alpha=alpha, label=measured.label, **marks)


def _curve(axes: Any, estimate: Estimate, vector: Vector, i: int) -> None:
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


def _error(
    axes: Any,
    estimate: Estimate,
    vector: Vector,
    error: Floats,
    i: int,
    *,
    width: float = 0.8,
    alpha: float = 1.0,
) -> None:
    """Errors of measurement and estimate, each at its own times."""
    t, sigma, shown = estimate.time, vector.error_sigma[:, i], error
    if vector.measured is not None and vector.measured.error is not None:
        raw = vector.measured.error[:, i]
        _measured(axes, raw, vector.measured, alpha)
        shown = np.r_[error, raw]
    band(axes, t, np.zeros(len(error)), sigma, "2σ of the estimate")
    axes.plot(t, error, color=ESTIMATE, lw=0.5 if vector.noisy else width, label="estimate")
    if vector.noisy:
        for side in (-2.0, 2.0):  # the band's edges, since the noise hides the band
            axes.plot(t, side * sigma, color=TRUTH, lw=0.8)
    symmetric_limits(axes, shown)


def curve_range(vector: Vector, i: int, margin: float) -> tuple[float, float]:
    """Range of a component's estimate and of all but the outliers of its measurements, with a `margin` as
    a share of it on both sides."""
    values = vector.value[:, i]
    if vector.measured is not None:
        # A tracker may measure an attitude without a position.
        known = vector.measured.value[np.isfinite(vector.measured.value[:, i]), i]
        values = np.r_[values, np.quantile(known, [0.005, 0.995])] if known.size else values
    low, high = float(values.min()), float(values.max())
    more = margin * (high - low) + 1e-9
    return low - more, high + more
