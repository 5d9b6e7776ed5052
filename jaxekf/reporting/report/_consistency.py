"""Figures of consistency: NIS and whiteness of innovations, NEES against the encoder."""

from typing import Any, NamedTuple

import numpy as np

from jaxekf._support import chi_square
from jaxekf.evaluation.consistency import BAND
from jaxekf.evaluation.metrics import normalised_square
from jaxekf.io.documents.result import WhitenessTest
from jaxekf.recordings.types import NANOSECONDS, Floats
from jaxekf.reporting.plots.style import ESTIMATE, MEASURED, REFUSED, TRUTH
from jaxekf.reporting.report._comparison import ComparedResult
from jaxekf.reporting.report._figures import Figure, shade
from jaxekf.reporting.report._grid import THIRD, Column, Grid, Place

_ROW = 190
_ROWS = (ESTIMATE, MEASURED, THIRD, REFUSED)
_LEAST_DECADE = -2.0
_PERCENT = f"{100 * BAND:.0f} %"
_TIME = "time since the start of the estimate (s)"


def innovations(compared: ComparedResult, bins: int) -> Figure | None:
    """A row for each sensor: NIS over time and, where a diagnosis was saved, autocorrelation over lag."""
    result = compared.result
    if not result.sensors:
        return None
    tests = {} if result.diagnosis is None else result.diagnosis.sensors
    curves = {
        name: curve
        for name in result.sensors
        if name in tests and (curve := _curve(tests[name].whiteness)) is not None
    }
    columns = [Column(_TIME, (0.0, float(result.time[-1])), share=1.6 if curves else 1.0)]
    if curves:
        longest = max(float(curve.lag_s.max()) for curve in curves.values())
        columns.append(Column("lag (s)", (0.0, longest), timed=False))
    grid = Grid(columns, len(result.sensors), row_height=_ROW, bins=bins)
    shade(grid, compared)
    for i, (name, sensor) in enumerate(result.sensors.items()):
        t = (sensor.time_ns - result.time_ns[0]) / NANOSECONDS
        _squares(grid, Place(i), f"NIS of {name}", sensor.nis, sensor.freedom)
        fed, out = ~sensor.refused, sensor.refused
        grid.dots(
            Place(i), t[fed], _positive(sensor.nis[fed]), name="NIS", colour=ESTIMATE, unit=""
        )
        if out.any():
            refused = _positive(sensor.nis[out])
            style: Any = {"colour": REFUSED, "unit": "", "size": 5.0, "symbol": "x"}
            grid.dots(Place(i), t[out], refused, name="NIS, refused by the gate", **style)
        if name in curves:
            _autocorrelation(grid, Place(i, 1), curves[name])
    grid.key(f"{_PERCENT} of a consistent filter", ESTIMATE, opacity=0.3)
    caption = (
        f"Normalised innovation squared: for a consistent filter {_PERCENT} are in the band; the line is"
        " their expected mean."
    )
    if curves:
        caption += (
            f" Autocorrelation of whitened innovations, row by row: for a consistent filter within the"
            f" dashed bounds at {_PERCENT} of all lags."
        )
    return Figure("innovations", "Innovations", caption, grid.document())


def errors(compared: ComparedResult, bins: int) -> Figure | None:
    """NEES of each output that the encoder measures, too."""
    result = compared.result
    known = {name: e for name, e in compared.errors.items() if np.isfinite(e).all(axis=1).any()}
    if not known:
        return None
    columns = [Column(_TIME, (0.0, float(result.time[-1])))]
    grid = Grid(columns, len(known), row_height=_ROW, bins=bins)
    shade(grid, compared)
    for i, (name, error) in enumerate(known.items()):
        kept = np.isfinite(error).all(axis=1)
        squares = np.full(len(error), np.nan)
        squares[kept] = normalised_square(error[kept], result.outputs[name].cov[kept])
        freedom = np.full(len(error), float(error.shape[1]))
        _squares(grid, Place(i), f"NEES of {name}", squares, freedom)
        shown = _positive(squares)
        grid.line(Place(i), result.time, shown, name="NEES", colour=ESTIMATE, unit="", width=0.9)
    grid.key(f"{_PERCENT} of a consistent filter", ESTIMATE, opacity=0.3)
    caption = (
        "Normalised error squared against the encoder, at scored samples: above the band the covariance is"
        " too small, below it too large. Unlike innovations, errors are correlated over time: many"
        " neighbouring samples count as one."
    )
    return Figure("errors", "Errors against their covariance", caption, grid.document())


def _squares(grid: Grid, at: Place, title: str, squares: Floats, freedom: Floats) -> None:
    """Axis, chi-square band and expected mean of normalised squares."""
    common = float(np.bincount(freedom.astype(int)).argmax()) or 1.0
    low, high = (float(edge) for edge in chi_square.ppf([0.5 - BAND / 2, 0.5 + BAND / 2], common))
    known = squares[np.isfinite(squares) & (squares > 0)]
    least = float(np.quantile(known, 0.01)) if known.size else low
    most = float(known.max()) if known.size else high
    decades = np.log10([min(low, max(least, 10.0**_LEAST_DECADE)), 1.5 * max(high, most)])
    grid.axis(at, title, (float(decades[0]) - 0.1, float(decades[1])), log=True)
    grid.band(at, low, high)
    grid.level(at, common, TRUTH)


def _positive(squares: Floats) -> Floats:
    """Squares for a logarithmic axis: NaN for those that are not positive."""
    return np.where(squares > 0, squares, np.nan)


class _Curve(NamedTuple):
    """Autocorrelation over lag."""

    lag_s: Floats
    rows: Floats
    """(rows, lags)"""
    bound: Floats


def _curve(test: WhitenessTest) -> _Curve | None:
    """The curve of a saved test; None if there is none."""
    if test.lag_s is None or test.autocorrelation is None or test.bound is None:
        return None
    return _Curve(test.lag_s, test.autocorrelation, test.bound) if test.lag_s.size else None


def _autocorrelation(grid: Grid, at: Place, curve: _Curve) -> None:
    lag, rows, bound = curve
    reach = max(0.1, 1.15 * float(np.abs(rows).max(initial=0.0)), 1.5 * float(bound.max()))
    grid.axis(at, "autocorrelation", (-reach, reach))
    labels = ("x", "y", "z") if len(rows) == 3 else [str(i) for i in range(len(rows))]
    for i, (label, row) in enumerate(zip(labels, rows, strict=True)):
        style: Any = {"colour": _ROWS[i % len(_ROWS)], "unit": "", "width": 1.1}
        grid.line(at, lag, row, name=f"row {label}", **style)
    for side in (-1.0, 1.0):
        style = {"colour": TRUTH, "unit": "", "width": 1.0, "dash": "dash"}
        grid.line(at, lag, side * bound, name=f"{_PERCENT} bounds", **style)
