"""The figures of a result: quantities of `jaxekf plot` over time, to zoom into."""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from jaxekf.evaluation.metrics import attitude_error
from jaxekf.recordings.truth import encoder_at, encoder_rate_at, encoder_velocity_at
from jaxekf.recordings.types import Floats
from jaxekf.reporting import plots
from jaxekf.reporting.plots._attitudes import euler_deg, same_turn
from jaxekf.reporting.plots._biases import encoder_bias, running_mean
from jaxekf.reporting.plots._measurements import seconds, truth
from jaxekf.reporting.plots.style import AXES, MEASURED, TRUTH
from jaxekf.reporting.report._comparison import ComparedResult
from jaxekf.reporting.report._grid import Column, Grid, Place

_ROW = 168
_QUANTILE = 0.995
_ANGLES = ("roll", "pitch", "yaw")
_BIAS_MEAN_S = 2.0
_DRAWN_PARTS = ("q_ref_body", "position", "velocity", "rate", "bias", "accelerometer_bias")
_MOST_OTHERS = 12


class Figure(NamedTuple):
    """A figure of one run."""

    name: str
    title: str
    caption: str
    document: dict[str, Any]
    """Data and layout for Plotly."""


class _Measured(NamedTuple):
    """A vector measured by a sensor, in the unit it is shown in."""

    t: Floats
    value: Floats
    """(M, 3)."""
    error: Floats | None
    """(M, 3) value minus truth, NaN if unknown."""
    label: str
    dots: bool


class _Vector(NamedTuple):
    """A vector over time, in the unit it is shown in."""

    labels: tuple[str, ...]
    """Label of each component."""
    unit: str
    value: Floats
    sigma: Floats
    truth: Floats | None
    error: Floats | None
    error_sigma: Floats
    measured: _Measured | None
    noisy: bool = False
    """Whether the noise of each instant is independent, so that truth is drawn above the estimate."""


def draw(compared: ComparedResult, bins: int) -> list[Figure]:
    """All figures of a result and its recording; long series are thinned to `bins` spans of time."""
    makers: tuple[Callable[[ComparedResult, int], Figure | None], ...] = (
        attitude,
        rate,
        bias,
        position,
        velocity,
        others,
    )
    return [figure for make in makers if (figure := make(compared, bins)) is not None]


def attitude(compared: ComparedResult, bins: int) -> Figure | None:
    """Roll, pitch and yaw; errors as rotation vectors in the body frame."""
    output = compared.result.outputs.get("attitude")
    if output is None:
        return None
    t, angles = compared.result.time, euler_deg(output.value)
    true = error = measured = None
    recording, sight = compared.recording, compared.sight
    known = None if recording is None else truth(compared.result, recording)
    if known is not None:
        true = same_turn(known.q_ref_body, t, t, angles)
        error = np.rad2deg(attitude_error(known.q_ref_body, output.value))
        true[~known.valid], error[~known.valid] = np.nan, np.nan
    if sight is not None:
        raw, off = sight.pose.q_ref_body[sight.seen], None
        if recording is not None and recording.encoder is not None:
            there = encoder_at(recording.encoder, sight.pose.time_ns[sight.seen])
            off = np.rad2deg(attitude_error(there.q_ref_body, raw))
            off[~there.valid] = np.nan
        measured = _Measured(sight.t, same_turn(raw, sight.t, t, angles), off, sight.label, True)
    vector = _Vector(
        _ANGLES,
        "deg",
        angles,
        plots.euler_sigma_deg(output.value, output.cov),
        true,
        error,
        np.rad2deg(output.sigma),
        measured,
    )
    caption = (
        f"Rotation from {_frame(compared)} to the body by yaw (z), pitch (y) and roll (x). Errors are"
        " rotation vectors in the body frame, estimate minus encoder."
    )
    return Figure("attitude", "Attitude", caption, _vector(compared, vector, bins))


def _frame(compared: ComparedResult) -> str:
    """Reference frame of attitudes and positions, in words."""
    return "the reference frame" if compared.sight is None else compared.sight.frame


def rate(compared: ComparedResult, bins: int) -> Figure | None:
    """Angular rate, estimate and gyroscope."""
    output = compared.result.outputs.get("rate")
    if output is None:
        return None
    true = error = measured = None
    recording, result = compared.recording, compared.result
    if recording is not None and recording.encoder is not None:
        true = np.rad2deg(encoder_rate_at(recording.encoder, result.time_ns))
        error = np.rad2deg(output.value) - true
    if recording is not None and recording.imu is not None:
        imu = recording.imu
        inside = (imu.time_ns >= result.time_ns[0]) & (imu.time_ns <= result.time_ns[-1])
        times, gyroscope = imu.time_ns[inside], np.rad2deg(imu.gyroscope[inside])
        off = None
        if recording.encoder is not None:
            off = gyroscope - np.rad2deg(encoder_rate_at(recording.encoder, times))
        measured = _Measured(seconds(times, result), gyroscope, off, "gyroscope", False)
    sigma = np.rad2deg(output.sigma)
    vector = _Vector(
        AXES, "deg/s", np.rad2deg(output.value), sigma, true, error, sigma, measured, noisy=True
    )
    caption = "Angular rate of the tool in the body frame; the gyroscope is shown as recorded."
    return Figure("rate", "Angular rate", caption, _vector(compared, vector, bins))


def position(compared: ComparedResult, bins: int) -> Figure | None:
    """Position of the body's origin."""
    output = compared.result.outputs.get("position")
    if output is None:
        return None
    true = error = measured = None
    recording, sight = compared.recording, compared.sight
    known = None if recording is None else truth(compared.result, recording)
    if known is not None and known.position is not None:
        true = np.where(known.valid[:, None], 1e3 * known.position, np.nan)
        error = 1e3 * output.value - true
    if sight is not None and sight.pose.position is not None:
        raw, off = 1e3 * sight.pose.position[sight.seen], None
        if recording is not None and recording.encoder is not None and true is not None:
            there = encoder_at(recording.encoder, sight.pose.time_ns[sight.seen])
            if there.position is not None:
                off = np.where(there.valid[:, None], raw - 1e3 * there.position, np.nan)
        measured = _Measured(sight.t, raw, off, sight.label, True)
    sigma = 1e3 * output.sigma
    vector = _Vector(AXES, "mm", 1e3 * output.value, sigma, true, error, sigma, measured)
    caption = f"Position of the body's origin in {_frame(compared)}."
    return Figure("position", "Position", caption, _vector(compared, vector, bins))


def velocity(compared: ComparedResult, bins: int) -> Figure | None:
    """Velocity of the body's origin, which no sensor measures."""
    output = compared.result.outputs.get("velocity")
    if output is None:
        return None
    true = error = None
    encoder = None if compared.recording is None else compared.recording.encoder
    if encoder is not None and encoder.position is not None:
        true = 1e3 * encoder_velocity_at(encoder, compared.result.time_ns)
        error = 1e3 * output.value - true
    sigma = 1e3 * output.sigma
    vector = _Vector(AXES, "mm/s", 1e3 * output.value, sigma, true, error, sigma, None)
    caption = f"Velocity of the body's origin in {_frame(compared)}."
    return Figure("velocity", "Velocity", caption, _vector(compared, vector, bins))


def bias(compared: ComparedResult, bins: int) -> Figure | None:
    """Bias of the gyroscope and, if the model has it, of the accelerometer."""
    turning, force = compared.result.vector("bias"), compared.result.vector("accelerometer_bias")
    if turning is None:
        return None
    t = compared.result.time
    columns = [_timed(compared)] if force is None else [_timed(compared), _timed(compared)]
    grid = Grid(columns, 3, row_height=_ROW, bins=bins)
    recording, known = compared.recording, None
    if recording is not None and recording.imu is not None:
        known = encoder_bias(compared.result, recording)
    shade(grid, compared)
    for i, axis in enumerate(AXES):
        at = Place(i)
        value, sigma = (np.rad2deg(array[:, i]) for array in turning)
        grid.axis(at, f"gyro {axis} (deg/s)", _settled(t, value, sigma))
        if known is not None:
            mean = running_mean(known.t, known.difference[:, i], _BIAS_MEAN_S)
            name = f"gyroscope − encoder, {_BIAS_MEAN_S:g} s mean"
            grid.line(at, *mean, name=name, colour=MEASURED, unit="deg/s", width=1.0)
        grid.estimate(at, t, value, sigma, unit="deg/s", width=1.4)
        if known is not None and known.at_rest is not None:
            grid.level(at, float(known.at_rest[i]), TRUTH, "dash")
        if force is not None:
            at = Place(i, 1)
            value, sigma = (array[:, i] for array in force)
            grid.axis(at, f"accel. {axis} (m/s²)", _settled(t, value, sigma))
            grid.estimate(at, t, value, sigma, unit="m/s²", width=1.4)
    caption = "Bias of the gyroscope" + (" and of the accelerometer." if force else ".")
    if known is not None and known.at_rest is not None:
        caption += " Dashed: mean of the gyroscope while the encoder was at rest at the start."
    return Figure("bias", "Bias", caption, grid.document())


def others(compared: ComparedResult, bins: int) -> Figure | None:
    """Further states of a user's model, number by number, in their own units."""
    result = compared.result
    left = [
        label
        for label in result.labels
        if not any(label.startswith(f"{part}_") for part in _DRAWN_PARTS)
        and {label, f"sigma_{label}"} <= result.columns.keys()
    ][:_MOST_OTHERS]
    if not left:
        return None
    grid = Grid([_timed(compared)], len(left), row_height=_ROW, bins=bins)
    shade(grid, compared)
    for i, label in enumerate(left):
        value, sigma = result.columns[label], result.columns[f"sigma_{label}"]
        unit = result.units.get(label, "")
        grid.axis(Place(i), f"{label} ({unit})", _settled(result.time, value, sigma))
        grid.estimate(Place(i), result.time, value, sigma, unit=unit)
    return Figure("state", "Other states", "Further states of the model.", grid.document())


def _timed(compared: ComparedResult) -> Column:
    """A column over the whole time of the run."""
    return Column(
        "time since the start of the estimate (s)", (0.0, float(compared.result.time[-1]))
    )


def shade(grid: Grid, compared: ComparedResult) -> None:
    """Grey bands for stretches without a pose of tracker or camera."""
    grid.shade(
        compared.gaps, "tracker hidden" if compared.sight is None else compared.sight.words[0]
    )


def _vector(compared: ComparedResult, vector: _Vector, bins: int) -> dict[str, Any]:
    """A row for each component; on the right its error, if truth is known."""
    t, columns = compared.result.time, [_timed(compared)]
    if vector.error is not None:
        columns.append(_timed(compared))
    grid = Grid(columns, 3, row_height=_ROW, bins=bins)
    shade(grid, compared)
    for i, label in enumerate(vector.labels):
        _value(grid, Place(i), t, vector, i, label)
        if vector.error is not None:
            _error(grid, Place(i, 1), t, vector, vector.error[:, i], i)
    return grid.document()


def _value(grid: Grid, at: Place, t: Floats, vector: _Vector, i: int, label: str) -> None:
    grid.axis(at, f"{label} ({vector.unit})", _limits(vector, i))
    measured, unit = vector.measured, vector.unit

    def draw_truth() -> None:
        if vector.truth is not None:
            width = 1.0 if vector.noisy else 2.4
            true = vector.truth[:, i]
            grid.line(at, t, true, name="encoder", colour=TRUTH, unit=unit, width=width)

    if measured is not None:
        _measurement(grid, at, measured, measured.value[:, i], unit)
    if not vector.noisy:
        draw_truth()
    # A band about a noisy curve would be a second noisy curve.
    about = "none" if vector.noisy else "value"
    grid.estimate(at, t, vector.value[:, i], vector.sigma[:, i], unit=unit, about=about)
    if vector.noisy:
        draw_truth()


def _error(grid: Grid, at: Place, t: Floats, vector: _Vector, error: Floats, i: int) -> None:
    unit, sigma, measured = vector.unit, vector.error_sigma[:, i], vector.measured
    shown = error
    off = None if measured is None or measured.error is None else measured.error[:, i]
    if off is not None:
        shown = np.r_[error, off]
    grid.axis(at, f"error {AXES[i]} ({unit})", _symmetric(shown))
    if measured is not None and off is not None:
        _measurement(grid, at, measured, off, unit)
    grid.estimate(at, t, error, sigma, unit=unit, about="zero", width=0.8 if vector.noisy else 1.2)
    for side in (
        (-2.0, 2.0) if vector.noisy else ()
    ):  # the band's edges, since the noise hides the band
        style: Any = {"colour": TRUTH, "unit": unit, "width": 1.0, "dash": "dot"}
        grid.line(at, t, side * sigma, name="edges of 2σ", **style)


def _measurement(grid: Grid, at: Place, measured: _Measured, values: Floats, unit: str) -> None:
    name = measured.label
    if measured.dots:
        grid.dots(at, measured.t, values, name=name, colour=MEASURED, unit=unit)
    else:
        grid.line(at, measured.t, values, name=name, colour=MEASURED, unit=unit, width=0.8)


def _limits(vector: _Vector, i: int) -> tuple[float, float]:
    """Range of the curves, not widened by the band at the start or by outliers."""
    values = vector.value[:, i]
    if vector.measured is not None:
        raw = vector.measured.value[:, i]
        known = raw[np.isfinite(raw)]
        values = np.r_[values, np.quantile(known, [0.005, 0.995])] if known.size else values
    low, high = float(values.min()), float(values.max())
    margin = 0.08 * (high - low) + 1e-9
    return low - margin, high + margin


def _symmetric(values: Floats) -> tuple[float, float] | None:
    """A range about zero, not widened by outliers."""
    known = np.abs(values[np.isfinite(values)])
    if not known.size:
        return None
    reach = 1.3 * float(np.quantile(known, _QUANTILE)) + 1e-12
    return -reach, reach


def _settled(t: Floats, value: Floats, sigma: Floats) -> tuple[float, float]:
    """A range that is not widened by the band at the start."""
    settled = t >= min(2.0, 0.1 * float(t[-1]))
    middle, reach = float(np.median(value[settled])), 5.0 * float(np.median(sigma[settled]))
    reach = max(reach, 2.0 * float(np.ptp(value[settled])), 1e-12)
    return middle - reach, middle + reach
