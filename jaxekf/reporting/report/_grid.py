"""Plotly figures as plain JSON documents: rows and columns of panels that share their time axis.

The common style of all figures is here. A figure has one set of colours; the page's style sheet turns
those of `PALETTE` into others on a dark screen.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

from jaxekf.recordings.types import Floats
from jaxekf.reporting.plots.style import ESTIMATE, MEASURED, REFUSED, TRUTH
from jaxekf.reporting.report._thinning import Thinned, rounded, seconds, thin

THIRD = "#4f9a3a"
PALETTE = {
    ESTIMATE: "#6db3f2",
    MEASURED: "#f0a35e",
    TRUTH: "#ececec",
    REFUSED: "#ff7070",
    THIRD: "#8fd17a",
}
"""Each colour of the figures, and its replacement on a dark screen."""
ESTIMATED = "estimate"
SHADE = "rgba(128,128,128,0.24)"
AXIS_LINES: dict[str, Any] = dict.fromkeys(
    ("gridcolor", "zerolinecolor", "linecolor"), "rgba(128,128,128,0.28)"
)
_MOST_SHADES = 200
_ROW_GAP = 0.045
_TOP, _BOTTOM = 40, 44


class Column(NamedTuple):
    """A column of panels above one horizontal axis."""

    title: str
    range: tuple[float, float]
    share: float = 1.0
    timed: bool = True
    """Whether the axis is time, and so is linked to the others and shaded."""


class Place(NamedTuple):
    """Row and column of a panel."""

    row: int
    column: int = 0


class Grid:
    """A figure in the making."""

    def __init__(self, columns: Sequence[Column], rows: int, *, row_height: int, bins: int) -> None:
        self._columns, self._rows, self._bins = columns, rows, bins
        self._height = _TOP + _BOTTOM + rows * row_height
        self._data: list[dict[str, Any]] = []
        self._shapes: list[dict[str, Any]] = []
        self._axes: dict[str, Any] = {}
        self._named: set[str] = set()
        self._banded = False

    def axis(
        self, at: Place, title: str, limits: tuple[float, float] | None, *, log: bool = False
    ) -> None:
        """Title and range (for `log` in powers of ten) of the vertical axis of a panel."""
        height = (1.0 - _ROW_GAP * (self._rows - 1)) / self._rows
        top = 1.0 - at.row * (height + _ROW_GAP)
        axis: dict[str, Any] = axis_style(title) | {"nticks": 6}
        axis |= {"anchor": self._x(at), "domain": panel_domain(top, height)}
        if limits is not None:
            axis["range"] = rounded_pair(limits)
        if log:
            axis |= {"type": "log", "dtick": 1, "exponentformat": "none"}
        self._axes[layout_name(self._y(at))] = axis

    def line(
        self,
        at: Place,
        t: Floats,
        values: Floats,
        *,
        name: str,
        colour: str,
        unit: str,
        width: float = 1.2,
        dash: str = "solid",
    ) -> None:
        """A curve; it breaks where samples are missing."""
        drawn = thin(t, values, self._bins)
        style = {"color": colour, "width": width, "dash": dash}
        self._trace(at, drawn, values, name, unit, mode="lines", line=style)

    def estimate(
        self,
        at: Place,
        t: Floats,
        values: Floats,
        sigma: Floats,
        *,
        unit: str,
        about: str = "value",
        width: float = 1.2,
    ) -> None:
        """An estimate with its band of 2 sigma (which the page draws) `about` its ``value`` or ``zero``;
        for ``none`` the band is in the hover text only."""
        drawn = thin(t, values, self._bins)
        extra = {
            "mode": "lines",
            "line": {"color": ESTIMATE, "width": width},
            "customdata": rounded(2.0 * sigma[_before_breaks(drawn)]),
            "meta": {"band": about},
        }
        self._trace(at, drawn, values, ESTIMATED, f"{unit}, 2σ = %{{customdata}}", **extra)
        self._banded = True

    def dots(
        self,
        at: Place,
        t: Floats,
        values: Floats,
        *,
        name: str,
        colour: str,
        unit: str,
        size: float = 3.0,
        symbol: str = "circle",
    ) -> None:
        """Samples one by one."""
        drawn = thin(t, values, self._bins, line=False)
        style = {"color": colour, "size": size, "symbol": symbol}
        self._trace(at, drawn, values, name, unit, mode="markers", marker=style)

    def level(self, at: Place, value: float, colour: str, dash: str = "solid") -> None:
        """A horizontal line across a panel."""
        line = {"color": colour, "width": 1.2, "dash": dash}
        self._shapes.append(across(self._x(at), self._y(at), value, value) | {"line": line})

    def band(self, at: Place, low: float, high: float) -> None:
        """A horizontal band across a panel."""
        fill = {"fillcolor": ESTIMATE, "opacity": 0.16, "line": {"width": 0}, "layer": "below"}
        self._shapes.append(across(self._x(at), self._y(at), low, high) | fill)

    def shade(self, stretches: Sequence[tuple[float, float]], name: str) -> None:
        """Stretches of time in all panels; of very many the longest."""
        longest = sorted(sorted(stretches, key=lambda s: s[0] - s[1])[:_MOST_SHADES])
        for i, column in enumerate(self._columns):
            for begin, end in longest if column.timed else ():
                place = {"xref": axis_name("x", i), "x0": round(begin, 3), "x1": round(end, 3)}
                height = {"yref": "paper", "y0": 0, "y1": 1}
                style = {"fillcolor": SHADE, "line": {"width": 0}, "layer": "below"}
                self._shapes.append({"type": "rect"} | place | height | style)
        if longest:
            self.key(name, SHADE)

    def key(self, name: str, colour: str, *, opacity: float = 1.0) -> None:
        """An entry of the legend without a curve."""
        marker = {"symbol": "square", "size": 12, "color": colour, "opacity": opacity}
        entry = {"type": "scatter", "x": [None], "y": [None], "mode": "markers", "marker": marker}
        self._data.append(entry | {"name": name, "hoverinfo": "skip"})

    def document(self) -> dict[str, Any]:
        """Data and layout, for Plotly; `figures.js` adds bands and the domains of the columns."""
        if self._banded:
            self.key("2σ of the estimate", ESTIMATE, opacity=0.3)
        shares = [column.share for column in self._columns]
        layout = common_layout(self._height, shares) | {
            "hovermode": "x unified",
            "shapes": self._shapes,
            **self._axes,
        }
        for i, column in enumerate(self._columns):
            panels = [self._y(Place(row, i)) for row in range(self._rows)]
            drawn = [panel for panel in panels if layout_name(panel) in self._axes]
            layout[layout_name(axis_name("x", i))] = AXIS_LINES | {
                "anchor": drawn[-1] if drawn else panels[0],
                "range": rounded_pair(column.range),
                "title": {"text": column.title, "standoff": 6},
                "hoverformat": ".3f",
                "unifiedhovertitle": {"text": "%{x} s"},
                **({"matches": "x"} if i and column.timed else {}),
            }
        return {"data": self._data, "layout": layout}

    def _trace(
        self, at: Place, drawn: Thinned, values: Floats, name: str, unit: str, **style: Any
    ) -> None:
        trace = {
            "type": "scatter",
            "x": seconds(drawn.t),
            "y": rounded(drawn.take(values)),
            "xaxis": self._x(at),
            "yaxis": self._y(at),
            "name": name,
            "legendgroup": name,
            "showlegend": name not in self._named,
            "hovertemplate": f"%{{y}} {unit}",
            **style,
        }
        self._named.add(name)
        self._data.append(trace)

    def _x(self, at: Place) -> str:
        return axis_name("x", at.column)

    def _y(self, at: Place) -> str:
        return axis_name("y", at.row * len(self._columns) + at.column)


def axis_name(kind: str, number: int) -> str:
    """Plotly's name of an axis in a trace, by its number from zero."""
    return kind if number == 0 else f"{kind}{number + 1}"


def layout_name(axis: str) -> str:
    """Plotly's name of the same axis in a layout."""
    return f"{axis[0]}axis{axis[1:]}"


def panel_domain(top: float, height: float) -> list[float]:
    """Vertical extent of a panel, as shares of the figure."""
    return [round(max(top - height, 0.0), 5), round(top, 5)]


def across(x_axis: str, y_axis: str, low: float, high: float) -> dict[str, Any]:
    """A shape over the whole width of a panel: a line, or a rectangle between two values."""
    place = {"xref": f"{x_axis} domain", "yref": y_axis, "x0": 0, "x1": 1, "y0": low, "y1": high}
    return place | {"type": "line" if low == high else "rect"}


def common_layout(height: int, shares: Sequence[float] = (1.0,)) -> dict[str, Any]:
    """Layout of every figure; `figures.js` places columns of these `shares` side by side."""
    return {
        "height": height,
        "margin": {"l": 64, "r": 16, "t": _TOP, "b": _BOTTOM},
        "paper_bgcolor": "rgba(0,0,0,0)",
        "plot_bgcolor": "rgba(0,0,0,0)",
        "font": {"family": "system-ui, sans-serif", "size": 12, "color": TRUTH},
        "modebar": {"bgcolor": "rgba(0,0,0,0)", "color": "#8a8d94", "activecolor": MEASURED},
        "legend": {"orientation": "h", "x": 0, "y": 1, "yanchor": "bottom"},
        "meta": {"shares": list(shares), "height": height},
    }


def axis_style(title: str) -> dict[str, Any]:
    """Title and lines of an axis."""
    return AXIS_LINES | {"title": {"text": title, "standoff": 6, "font": {"size": 11}}}


def rounded_pair(limits: tuple[float, float]) -> list[float]:
    """Limits of an axis with eight digits."""
    return [float(f"{limit:.8g}") for limit in limits]


def _before_breaks(drawn: Thinned) -> Any:
    """The index of each drawn sample; at a break that of the one before, so that a band continues."""
    index = drawn.samples.copy()
    breaks = index < 0
    index[breaks] = index[(breaks.nonzero()[0] - 1).clip(0)]
    return index
