"""Figures of a tuning: its search, runs before and after it, and confidence intervals."""

import html
import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from jaxekf.evaluation.spread import BEST_AT_ONE
from jaxekf.io.documents.tuning import FreeNumber, RunScore, Step, TuningDocument
from jaxekf.reporting.plots.style import ESTIMATE, MEASURED, REFUSED, TRUTH
from jaxekf.reporting.report._figures import Figure
from jaxekf.reporting.report._grid import (
    THIRD,
    across,
    axis_name,
    axis_style,
    common_layout,
    layout_name,
    panel_domain,
)
from jaxekf.reporting.report._tuned import HELD, before_and_after, variants

_TOP, _BOTTOM, _ROW, _GAP = 40, 44, 180, 34
_MOST_NUMBERS = 60
_MOST_TICKS = 60
_FAR = 20.0
_SYMBOLS = ("diamond", "square", "cross", "triangle-up")
_OTHERS = (THIRD, REFUSED, TRUTH)
_CONSISTENT = (0.5, 2.0)
COLUMNS = (
    ("attitude_rmse_deg", "attitude RMSE", "deg"),
    ("rate_rmse_deg_s", "rate RMSE", "deg/s"),
    ("position_rmse_mm", "position RMSE", "mm"),
    ("nis", "tracker NIS", ""),
    ("nees", "attitude NEES", ""),
    ("position_nees", "position NEES", ""),
)
"""Columns of the tables of runs, their headings and units."""


def draw_tuning(document: TuningDocument) -> list[Figure]:
    """All figures of a tuning."""
    again = any(number.left_open for number in document.numbers)
    found = [search(document.history, document.best_iteration, again=again)]
    if document.rows:
        found.append(compared("compared", "Runs before and after", document.rows))
    if document.folds is not None:
        found.append(compared("folds", "Held-out runs before and after", document.folds.rows))
    return [figure for figure in [*found, intervals(document.numbers)] if figure]


def known_columns(rows: Sequence[RunScore]) -> list[tuple[str, str, str]]:
    """The columns in which any row has a number."""
    return [c for c in COLUMNS if any(getattr(row, c[0]) is not None for row in rows)]


def search(history: Sequence[Step], best: int, *, again: bool = False) -> Figure | None:
    """The objective of training and validation runs over the iterations; `again` after a restart with
    unobservable parameters at their initial values."""
    kinds = [
        kind
        for kind in ("training", "validation")
        if any(getattr(step, kind) is not None and not step.rejected for step in history)
    ]
    if not kinds:
        return None
    numbers = [step.number for step in history]
    data, layout, above = [], _panels(len(kinds)), 0
    for i, (kind, colour) in enumerate(zip(kinds, (ESTIMATE, MEASURED), strict=False)):
        y_axis = axis_name("y", i)
        values = [None if step.rejected else getattr(step, kind) for step in history]
        style: dict[str, Any] = {"type": "scatter", "xaxis": "x", "yaxis": y_axis}
        line = {"color": colour, "width": 1.4}
        data.append(
            style
            | {"x": numbers, "y": values, "name": kind, "mode": "lines+markers", "line": line}
            | {"marker": {"color": colour, "size": 5}, "hovertemplate": "%{y}"}
        )
        points = style | {"mode": "markers", "showlegend": i == 0}
        known = dict(zip(numbers, values, strict=True))
        if known.get(best) is not None:
            marker = {"color": THIRD, "size": 13, "symbol": "star"}
            point = {"x": [best], "y": [known[best]], "marker": marker, "hoverinfo": "skip"}
            data.append(points | point | {"legendgroup": "best", "name": f"best: iteration {best}"})
        if rejected := _rejected(history, kind):
            marker = {"color": REFUSED, "size": 8, "symbol": "x"}
            where = {"x": [x for x, _ in rejected], "y": [y for _, y in rejected]}
            where |= {"marker": marker, "hovertemplate": "not finite"}
            data.append(points | where | {"legendgroup": "rejected", "name": "rejected"})
        limits, logarithmic, more = _limits([v for v in values if v is not None])
        above += more
        axis = layout[layout_name(axis_name("y", i))]
        axis |= axis_style(f"objective, {kind}") | {"range": limits, "nticks": 6}
        axis |= {"type": "log", "exponentformat": "power"} if logarithmic else {}
    last = max(numbers)
    layout["xaxis"] = axis_style("iteration") | {
        "anchor": axis_name("y", len(kinds) - 1),
        "range": [-0.02 * max(last, 1) - 0.3, 1.02 * last + 0.3],
        "tick0": 0,
        "dtick": max(1, math.ceil(last / 12)),
        "unifiedhovertitle": {"text": "iteration %{x}"},
    }
    layout["hovermode"] = "x unified"
    caption = (
        "Each iteration is one evaluation, including steps that the search took back. The best iteration"
        " is chosen by the validation runs, if there are any."
    )
    if again:
        caption += (
            " Unobservable parameters reverted to their initial values, and the search continued: lower"
            " values before that do not count."
        )
    if any(step.rejected for step in history):
        caption += " Rejected steps have no value: they are drawn at the level of the step before."
    if above:
        caption += f" Values above the range shown: {above}."
    return Figure("search", "The search", caption, {"data": data, "layout": layout})


def _rejected(history: Sequence[Step], kind: str) -> list[tuple[int, float]]:
    """Iteration and level of rejected steps: the last value before them, or the first after."""
    values = [None if step.rejected else getattr(step, kind) for step in history]
    level, found = next(value for value in values if value is not None), []
    for step, value in zip(history, values, strict=True):
        if step.rejected:
            found.append((step.number, level))
        level = level if value is None else value
    return found


def _limits(values: Sequence[float]) -> tuple[list[float], bool, int]:
    """Range of an axis, whether it is logarithmic, and the number of values above it: a range for all steps
    could flatten the rest of the search."""
    low, high = min(values), max(values)
    if low > 0.0 and high > _FAR * low:
        return [math.log10(low) - 0.1, math.log10(high) + 0.1], True, 0
    span = values[0] - low or high - low or abs(low) or 1.0
    if high - low > _FAR * span:
        high = low + 2.0 * span
    margin = 0.08 * (high - low or span)
    return [low - margin, high + margin], False, sum(v > high for v in values)


def compared(name: str, title: str, rows: Sequence[RunScore]) -> Figure | None:
    """A dot for each run and variant, one panel for each column, without ``hold last``."""
    columns = known_columns([row for row in rows if row.variant != HELD])
    runs = list(dict.fromkeys(row.run for row in rows))
    if not columns:
        return None
    wide = min(len(columns), 2)
    layout = _panels(len(columns), wide)
    data: list[dict[str, Any]] = []
    for i, (column, head, unit) in enumerate(columns):
        place = {"type": "scatter", "xaxis": axis_name("x", i % wide), "yaxis": axis_name("y", i)}
        values = {(row.run, row.variant): getattr(row, column) for row in rows}
        traces = _dots(rows, runs, values, unit)
        data += [place | t | {"showlegend": i == 0 and t["showlegend"]} for t in traces]
        axis = layout[layout_name(axis_name("y", i))]
        axis |= axis_style(f"{head} ({unit})" if unit else head)
        known = [v for t in traces for v in t["y"] if v is not None]
        axis |= _scale(known, about_one=column in BEST_AT_ONE)
        if column in BEST_AT_ONE:
            layout["shapes"] += _consistency_band(place["xaxis"], place["yaxis"])
    step = math.ceil(len(runs) / _MOST_TICKS)
    for i in range(wide):
        lowest = max(k for k in range(len(columns)) if k % wide == i)
        layout[layout_name(axis_name("x", i))] = axis_style("") | {
            "anchor": axis_name("y", lowest),
            "range": [-0.5, len(runs) - 0.5],
            "tickvals": list(range(0, len(runs), step)),
            "ticktext": [_safe(run) for run in runs[::step]],
            "automargin": True,
            "showgrid": False,
            "zeroline": False,
            **({"matches": "x"} if i else {}),
        }
    layout["hovermode"] = "closest"
    caption = "A dot for each run; “hold last” is in the table only."
    if any(column in BEST_AT_ONE for column, _, _ in columns):
        low, high = _CONSISTENT
        caption += (
            " NIS and NEES are 1 (the line) for a consistent filter; the band goes from"
            f" {low:g} to {high:g}."
        )
    return Figure(name, title, caption, {"data": data, "layout": layout})


def _dots(
    rows: Sequence[RunScore], runs: Sequence[str], values: dict[Any, Any], unit: str
) -> list[dict[str, Any]]:
    """Dots of each variant, and below them lines from before to after."""
    first, last = before_and_after(rows)
    by_variant = {
        variant: [values.get((run, variant)) for run in runs]
        for variant in _drawn(rows, first, last)
    }
    found = [_links(by_variant[first], by_variant[last])] if first != last else []
    # The others come first in the order of drawing.
    for i, (variant, each) in enumerate(by_variant.items()):
        colour, symbol = _OTHERS[i % len(_OTHERS)], _SYMBOLS[i % len(_SYMBOLS)]
        if variant in (first, last):
            colour, symbol = ESTIMATE if variant == last else MEASURED, "circle"
        found.append(
            {
                "x": list(range(len(runs))),
                "y": each,
                "mode": "markers",
                "name": _safe(variant),
                "legendgroup": variant,
                "showlegend": True,
                "marker": {"color": colour, "size": 8, "symbol": symbol},
                "text": [_safe(run) for run in runs],
                "hovertemplate": f"%{{text}}: %{{y:.4g}} {unit}",
            }
        )
    return found


def _drawn(rows: Sequence[RunScore], first: str, last: str) -> list[str]:
    """Variants in the order of drawing, the tuned one on top."""
    others = [name for name in variants(rows) if name not in (HELD, first, last)]
    return list(dict.fromkeys([*others, first, last]))


def _links(first: Sequence[float | None], last: Sequence[float | None]) -> dict[str, Any]:
    """Lines from before to after, run by run."""
    x: list[float | None] = []
    y: list[float | None] = []
    for i, ends in enumerate(zip(first, last, strict=True)):
        if None not in ends:
            x, y = [*x, i, i, None], [*y, *ends, None]
    line = {"color": "rgba(128,128,128,0.6)", "width": 2}
    return {"x": x, "y": y, "mode": "lines", "line": line, "hoverinfo": "skip", "showlegend": False}


def _scale(values: Sequence[float], *, about_one: bool) -> dict[str, Any]:
    """Range and ticks of an axis: NIS and NEES about one, others close to the values; by decades for a wide
    range."""
    positive = [v for v in values if v > 0.0]
    ends = [min(positive, default=1.0), max(positive, default=1.0)]
    if about_one:
        ends = [min(ends[0], _CONSISTENT[0]), max(ends[1], _CONSISTENT[1])]
    elif ends[1] <= _FAR * ends[0]:
        low, high = min(values, default=0.0), max(values, default=1.0)
        margin = 0.12 * (high - low) or 0.05 * abs(high) or 1.0
        return {"range": [low - margin, high + margin], "nticks": 6}
    low, high = (math.log10(end) for end in ends)
    decades = range(math.floor(low) - 1, math.ceil(high) + 1)
    ticks = [c * 10.0**k for k in decades for c in ((1, 2, 5) if high - low < 2.0 else (1,))]
    inside = [tick for tick in ticks if low - 0.1 <= math.log10(tick) <= high + 0.1]
    marks = {"tickvals": inside, "ticktext": [f"{tick:g}" for tick in inside]}
    return {"type": "log", "range": [low - 0.1, high + 0.1], **marks}


def _consistency_band(x_axis: str, y_axis: str) -> list[dict[str, Any]]:
    """A line at one, and the band of consistency about it."""
    fill = {"fillcolor": ESTIMATE, "opacity": 0.12, "line": {"width": 0}, "layer": "below"}
    line = {"line": {"color": TRUTH, "width": 1.2}, "layer": "below"}
    band = across(x_axis, y_axis, *_CONSISTENT) | fill
    return [band, across(x_axis, y_axis, 1, 1) | line]


def intervals(numbers: Sequence[FreeNumber]) -> Figure | None:
    """Value and interval of each tuned logarithm as multiples of its start; None for too many to read."""
    shown = [
        n for n in numbers if n.logarithm and n.interval and n.start and n.tuned and all(n.interval)
    ]
    if not shown or len(shown) > _MOST_NUMBERS:
        return None
    start = np.array([n.start for n in shown])
    value = np.array([n.tuned for n in shown]) / start
    ends = np.array([n.interval for n in shown]) / start[:, None]
    names = [_safe(n.name + (f" of {n.run}" if n.run else "")) for n in shown]
    trace = {
        "type": "scatter",
        "x": value.tolist(),
        "y": list(range(len(shown))),
        "mode": "markers",
        "marker": {"color": ESTIMATE, "size": 8},
        "error_x": {
            "type": "data",
            "symmetric": False,
            "array": (ends[:, 1] - value).tolist(),
            "arrayminus": (value - ends[:, 0]).tolist(),
            "color": ESTIMATE,
            "thickness": 1.6,
        },
        "customdata": ends.tolist(),
        "text": names,
        "hovertemplate": "%{text}: x %{x:.3g} (%{customdata[0]:.3g} to %{customdata[1]:.3g})",
        "name": "",
        "showlegend": False,
    }
    layout = common_layout(_TOP + _BOTTOM + 26 * len(shown))
    layout["margin"]["t"] = 10
    low, high = (float(np.log10(e)) for e in (min(ends.min(), 1.0), max(ends.max(), 1.0)))
    margin = max(0.05 * (high - low), 0.03)
    layout["xaxis"] = axis_style("tuned, as a multiple of the start") | {
        "type": "log",
        "range": [low - margin, high + margin],
        "exponentformat": "none",
    }
    layout["yaxis"] = axis_style("") | {
        "range": [len(shown) - 0.4, -0.6],
        "tickvals": list(range(len(shown))),
        "ticktext": names,
        "automargin": True,
        "zeroline": False,
    }
    line = {"type": "line", "xref": "x", "yref": "paper", "x0": 1, "x1": 1, "y0": 0, "y1": 1}
    layout["shapes"] = [line | {"line": {"color": TRUTH, "width": 1.2, "dash": "dash"}}]
    layout["hovermode"] = "closest"
    caption = (
        "Tuned values and their 95 % intervals as multiples of the start (the dashed line). Unobservable"
        " parameters keep their initial values; they and intervals open to one side are not shown."
    )
    return Figure("intervals", "Confidence intervals", caption, {"data": [trace], "layout": layout})


def _panels(count: int, wide: int = 1) -> dict[str, Any]:
    """A layout of panels, side by side and above each other, with empty vertical axes."""
    high = math.ceil(count / wide)
    inner = high * _ROW + (high - 1) * _GAP
    layout = common_layout(_TOP + _BOTTOM + inner, (1.0,) * wide)
    layout["shapes"] = []
    for i in range(count):
        top = 1.0 - (i // wide) * (_ROW + _GAP) / inner
        place = {"anchor": axis_name("x", i % wide), "domain": panel_domain(top, _ROW / inner)}
        layout[layout_name(axis_name("y", i))] = place
    return layout


def _safe(name: str) -> str:
    """A name as text for Plotly, which reads some HTML."""
    return html.escape(name, quote=False)
