"""The figures of a result: quantities of `jaxekf plot` over time, to zoom into."""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from jaxekf.estimation.result import Estimated
from jaxekf.recordings.types import Floats, Recording
from jaxekf.reporting.plots._attitudes import attitude_vector
from jaxekf.reporting.plots._biases import encoder_bias, running_mean
from jaxekf.reporting.plots._measurements import PoseMeasurements
from jaxekf.reporting.plots._vectors import (
    Measured,
    Vector,
    curve_range,
    position_vector,
    rate_vector,
    velocity_vector,
)
from jaxekf.reporting.plots.style import AXES, MEASURED, TRUTH
from jaxekf.reporting.report._comparison import ComparedResult
from jaxekf.reporting.report._grid import Column, Grid, Place

_ROW = 168
_QUANTILE = 0.995
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


class _Quantity(NamedTuple):
    """A vector that the report shows, if the model has the output."""

    title: str
    caption: str
    """With ``{}`` for the reference frame."""
    vector: Callable[[Estimated, Recording | None, PoseMeasurements | None], Vector]


_QUANTITIES = {
    "attitude": _Quantity(
        "Attitude",
        "Rotation from {} to the body by yaw (z), pitch (y) and roll (x). Errors are rotation vectors in"
        " the body frame, estimate minus encoder.",
        attitude_vector,
    ),
    "rate": _Quantity(
        "Angular rate",
        "Angular rate of the tool in the body frame; the gyroscope is shown as recorded.",
        rate_vector,
    ),
    "position": _Quantity("Position", "Position of the body's origin in {}.", position_vector),
    "velocity": _Quantity("Velocity", "Velocity of the body's origin in {}.", velocity_vector),
}


def draw(compared: ComparedResult, bins: int) -> list[Figure]:
    """All figures of a result and its recording; long series are thinned to `bins` spans of time."""
    drawn = (
        quantity("attitude", compared, bins),
        quantity("rate", compared, bins),
        bias(compared, bins),
        quantity("position", compared, bins),
        quantity("velocity", compared, bins),
        others(compared, bins),
    )
    return [figure for figure in drawn if figure is not None]


def quantity(name: str, compared: ComparedResult, bins: int) -> Figure | None:
    """An output of the model with measurement, truth and error; None for a model without it."""
    if name not in compared.result.outputs:
        return None
    title, caption, make = _QUANTITIES[name]
    vector = make(compared.result, compared.recording, compared.sight)
    frame = "the reference frame" if compared.sight is None else compared.sight.frame
    return Figure(name, title, caption.format(frame), _vector(compared, vector, bins))


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
        f"time{compared.result.clock.label} since the start of the estimate (s)",
        (0.0, float(compared.result.time[-1])),
    )


def shade(grid: Grid, compared: ComparedResult) -> None:
    """Grey bands for stretches without a pose of tracker or camera."""
    grid.shade(
        compared.gaps, "tracker hidden" if compared.sight is None else compared.sight.words[0]
    )


def _vector(compared: ComparedResult, vector: Vector, bins: int) -> dict[str, Any]:
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


def _value(grid: Grid, at: Place, t: Floats, vector: Vector, i: int, label: str) -> None:
    grid.axis(at, f"{label} ({vector.unit})", curve_range(vector, i, 0.08))
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


def _error(grid: Grid, at: Place, t: Floats, vector: Vector, error: Floats, i: int) -> None:
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


def _measurement(grid: Grid, at: Place, measured: Measured, values: Floats, unit: str) -> None:
    name = measured.label
    if measured.dots:
        grid.dots(at, measured.t, values, name=name, colour=MEASURED, unit=unit)
    else:
        grid.line(at, measured.t, values, name=name, colour=MEASURED, unit=unit, width=0.8)


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
