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
LINES = "rgba(128,128,128,0.28)"
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
        axis = {
            "anchor": self._x(at),
            "domain": [round(max(top - height, 0.0), 5), round(top, 5)],
            "title": {"text": title, "standoff": 6, "font": {"size": 11}},
            "gridcolor": LINES,
            "zerolinecolor": LINES,
            "linecolor": LINES,
            "nticks": 6,
        }
        if limits is not None:
            axis["range"] = rounded_pair(limits)
        if log:
            axis |= {"type": "log", "dtick": 1, "exponentformat": "none"}
        self._axes[self._named_axis(at)] = axis

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
        self._shapes.append(
            {
                "type": "line",
                "xref": f"{self._x(at)} domain",
                "yref": self._y(at),
                "x0": 0,
                "x1": 1,
                "y0": value,
                "y1": value,
                "line": {"color": colour, "width": 1.2, "dash": dash},
            }
        )

    def band(self, at: Place, low: float, high: float) -> None:
        """A horizontal band across a panel."""
        self._shapes.append(
            {
                "type": "rect",
                "xref": f"{self._x(at)} domain",
                "yref": self._y(at),
                "x0": 0,
                "x1": 1,
                "y0": low,
                "y1": high,
                "fillcolor": ESTIMATE,
                "opacity": 0.16,
                "line": {"width": 0},
                "layer": "below",
            }
        )

    def shade(self, stretches: Sequence[tuple[float, float]], name: str) -> None:
        """Stretches of time in all panels; of very many the longest."""
        longest = sorted(sorted(stretches, key=lambda s: s[0] - s[1])[:_MOST_SHADES])
        for i, column in enumerate(self._columns):
            for begin, end in longest if column.timed else ():
                self._shapes.append(
                    {
                        "type": "rect",
                        "xref": self._x(Place(0, i)),
                        "yref": "paper",
                        "x0": round(begin, 3),
                        "x1": round(end, 3),
                        "y0": 0,
                        "y1": 1,
                        "fillcolor": SHADE,
                        "line": {"width": 0},
                        "layer": "below",
                    }
                )
        if longest:
            self.key(name, SHADE)

    def key(self, name: str, colour: str, *, opacity: float = 1.0) -> None:
        """An entry of the legend without a curve."""
        marker = {"symbol": "square", "size": 12, "color": colour, "opacity": opacity}
        self._data.append(
            {
                "type": "scatter",
                "x": [None],
                "y": [None],
                "mode": "markers",
                "name": name,
                "marker": marker,
                "hoverinfo": "skip",
            }
        )

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
            lowest = max((row for row in range(self._rows) if self._has(Place(row, i))), default=0)
            axis: dict[str, Any] = {
                "anchor": self._y(Place(lowest, i)),
                "range": rounded_pair(column.range),
                "title": {"text": column.title, "standoff": 6},
                "gridcolor": LINES,
                "zerolinecolor": LINES,
                "linecolor": LINES,
                "hoverformat": ".3f",
                "unifiedhovertitle": {"text": "%{x} s"},
            }
            if i and column.timed:
                axis["matches"] = "x"
            layout["xaxis" if i == 0 else f"xaxis{i + 1}"] = axis
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

    def _has(self, at: Place) -> bool:
        return self._named_axis(at) in self._axes

    def _named_axis(self, at: Place) -> str:
        return self._y(at).replace("y", "yaxis")

    def _number(self, at: Place) -> int:
        return at.row * len(self._columns) + at.column + 1

    def _x(self, at: Place) -> str:
        return "x" if at.column == 0 else f"x{at.column + 1}"

    def _y(self, at: Place) -> str:
        number = self._number(at)
        return "y" if number == 1 else f"y{number}"


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
    """Title and lines of an axis of a figure without `Grid`."""
    lines = {"gridcolor": LINES, "zerolinecolor": LINES, "linecolor": LINES}
    return {"title": {"text": title, "standoff": 6, "font": {"size": 11}}, **lines}


def rounded_pair(limits: tuple[float, float]) -> list[float]:
    """Limits of an axis with eight digits."""
    return [float(f"{limit:.8g}") for limit in limits]


def _before_breaks(drawn: Thinned) -> Any:
    """The index of each drawn sample; at a break that of the one before, so that a band continues."""
    index = drawn.samples.copy()
    breaks = index < 0
    index[breaks] = index[(breaks.nonzero()[0] - 1).clip(0)]
    return index
