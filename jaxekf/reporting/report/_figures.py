"""Which figures a result can show, and what stands in them: the choices of `jaxekf plot`, to zoom into."""

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
from jaxekf.reporting.report._evidence import Evidence
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
    """What a sensor says of a vector, in the unit it is shown in."""

    t: Floats
    value: Floats
    """(M, 3)."""
    error: Floats | None
    """(M, 3) value less truth, NaN where that is not known."""
    label: str
    dots: bool


class _Vector(NamedTuple):
    """A vector over time, in the unit it is shown in."""

    labels: tuple[str, ...]
    """Of each component."""
    unit: str
    value: Floats
    sigma: Floats
    truth: Floats | None
    error: Floats | None
    error_sigma: Floats
    measured: _Measured | None
    noisy: bool = False
    """Whether each instant has noise of its own, so that truth stands before the estimate."""


def draw(seen: Evidence, bins: int) -> list[Figure]:
    """All figures that result and recording can show, with `bins` spans of time for long series."""
    makers: tuple[Callable[[Evidence, int], Figure | None], ...] = (
        attitude,
        rate,
        bias,
        position,
        velocity,
        others,
    )
    return [figure for make in makers if (figure := make(seen, bins)) is not None]


def attitude(seen: Evidence, bins: int) -> Figure | None:
    """Roll, pitch and yaw; errors as rotation vectors about the body's axes."""
    output = seen.result.outputs.get("attitude")
    if output is None:
        return None
    t, angles = seen.result.time, euler_deg(output.value)
    true = error = measured = None
    recording, sight = seen.recording, seen.sight
    known = None if recording is None else truth(seen.result, recording)
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
        f"Turns about z, y and x (yaw, pitch, roll) from {_frame(seen)} to the body. Errors are"
        " rotation vectors about the body's axes, estimate less encoder."
    )
    return Figure("attitude", "Attitude", caption, _vector(seen, vector, bins))


def _frame(seen: Evidence) -> str:
    """In words, what attitudes and positions are told in."""
    return "the reference frame" if seen.sight is None else seen.sight.frame


def rate(seen: Evidence, bins: int) -> Figure | None:
    """Angular rate beside the gyroscope's."""
    output = seen.result.outputs.get("rate")
    if output is None:
        return None
    true = error = measured = None
    recording, result = seen.recording, seen.result
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
    caption = "Angular rate of the tool in the body frame, the gyroscope as it was recorded."
    return Figure("rate", "Angular rate", caption, _vector(seen, vector, bins))


def position(seen: Evidence, bins: int) -> Figure | None:
    """Position of the body's origin."""
    output = seen.result.outputs.get("position")
    if output is None:
        return None
    true = error = measured = None
    recording, sight = seen.recording, seen.sight
    known = None if recording is None else truth(seen.result, recording)
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
    caption = f"Position of the body's origin in {_frame(seen)}."
    return Figure("position", "Position", caption, _vector(seen, vector, bins))


def velocity(seen: Evidence, bins: int) -> Figure | None:
    """Velocity of the body's origin, of which no sensor tells."""
    output = seen.result.outputs.get("velocity")
    if output is None:
        return None
    true = error = None
    encoder = None if seen.recording is None else seen.recording.encoder
    if encoder is not None and encoder.position is not None:
        true = 1e3 * encoder_velocity_at(encoder, seen.result.time_ns)
        error = 1e3 * output.value - true
    sigma = 1e3 * output.sigma
    vector = _Vector(AXES, "mm/s", 1e3 * output.value, sigma, true, error, sigma, None)
    caption = f"Velocity of the body's origin in {_frame(seen)}."
    return Figure("velocity", "Velocity", caption, _vector(seen, vector, bins))


def bias(seen: Evidence, bins: int) -> Figure | None:
    """Biases of the gyroscope and, where the model has it, of the accelerometer."""
    turning, force = seen.result.vector("bias"), seen.result.vector("accelerometer_bias")
    if turning is None:
        return None
    t = seen.result.time
    columns = [_timed(seen)] if force is None else [_timed(seen), _timed(seen)]
    grid = Grid(columns, 3, row_height=_ROW, bins=bins)
    recording, known = seen.recording, None
    if recording is not None and recording.imu is not None:
        known = encoder_bias(seen.result, recording)
    shade(grid, seen)
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
        caption += " Dashed: what the gyroscope said while the encoder stood still at the start."
    return Figure("bias", "Bias", caption, grid.document())


def others(seen: Evidence, bins: int) -> Figure | None:
    """What else a model of one's own has in its state, number by number, in its own units."""
    result = seen.result
    left = [
        label
        for label in result.labels
        if not any(label.startswith(f"{part}_") for part in _DRAWN_PARTS)
        and {label, f"sigma_{label}"} <= result.columns.keys()
    ][:_MOST_OTHERS]
    if not left:
        return None
    grid = Grid([_timed(seen)], len(left), row_height=_ROW, bins=bins)
    shade(grid, seen)
    for i, label in enumerate(left):
        value, sigma = result.columns[label], result.columns[f"sigma_{label}"]
        unit = result.units.get(label, "")
        grid.axis(Place(i), f"{label} ({unit})", _settled(result.time, value, sigma))
        grid.estimate(Place(i), result.time, value, sigma, unit=unit)
    return Figure("state", "Other states", "The rest of the model's state.", grid.document())


def _timed(seen: Evidence) -> Column:
    """A column over the whole time of the run."""
    return Column("time since the start of the estimate (s)", (0.0, float(seen.result.time[-1])))


def shade(grid: Grid, seen: Evidence) -> None:
    """Grey where there is no pose of tracker or camera."""
    grid.shade(seen.lost, "tracker hidden" if seen.sight is None else seen.sight.words[0])


def _vector(seen: Evidence, vector: _Vector, bins: int) -> dict[str, Any]:
    """A row for each component; on the right its error, where truth is known."""
    t, columns = seen.result.time, [_timed(seen)]
    if vector.error is not None:
        columns.append(_timed(seen))
    grid = Grid(columns, 3, row_height=_ROW, bins=bins)
    shade(grid, seen)
    for i, label in enumerate(vector.labels):
        _value(grid, Place(i), t, vector, i, label)
        if vector.error is not None:
            _error(grid, Place(i, 1), t, vector, vector.error[:, i], i)
    return grid.document()


def _value(grid: Grid, at: Place, t: Floats, vector: _Vector, i: int, label: str) -> None:
    grid.axis(at, f"{label} ({vector.unit})", _limits(vector, i))
    measured, unit = vector.measured, vector.unit

    def tell_truth() -> None:
        if vector.truth is not None:
            width = 1.0 if vector.noisy else 2.4
            true = vector.truth[:, i]
            grid.line(at, t, true, name="encoder", colour=TRUTH, unit=unit, width=width)

    if measured is not None:
        _measurement(grid, at, measured, measured.value[:, i], unit)
    if not vector.noisy:
        tell_truth()
    # About a curve that has noise of its own at each instant a band is a second noisy curve.
    about = "none" if vector.noisy else "value"
    grid.estimate(at, t, vector.value[:, i], vector.sigma[:, i], unit=unit, about=about)
    if vector.noisy:
        tell_truth()


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
    """The range of the curves: a wide band at the start, or a stray sample, must not flatten them."""
    values = vector.value[:, i]
    if vector.measured is not None:
        raw = vector.measured.value[:, i]
        known = raw[np.isfinite(raw)]
        values = np.r_[values, np.quantile(known, [0.005, 0.995])] if known.size else values
    low, high = float(values.min()), float(values.max())
    margin = 0.08 * (high - low) + 1e-9
    return low - margin, high + margin


def _symmetric(values: Floats) -> tuple[float, float] | None:
    """A range about zero that single outliers do not rule."""
    known = np.abs(values[np.isfinite(values)])
    if not known.size:
        return None
    reach = 1.3 * float(np.quantile(known, _QUANTILE)) + 1e-12
    return -reach, reach


def _settled(t: Floats, value: Floats, sigma: Floats) -> tuple[float, float]:
    """A range that the wide band of the start does not rule."""
    settled = t >= min(2.0, 0.1 * float(t[-1]))
    middle, reach = float(np.median(value[settled])), 5.0 * float(np.median(sigma[settled]))
    reach = max(reach, 2.0 * float(np.ptp(value[settled])), 1e-12)
    return middle - reach, middle + reach
