"""Colours, bands, legends and files of all figures. Only this module changes matplotlib's settings."""

from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.image import imsave

from jaxekf.estimation.clock import Clock
from jaxekf.io.atomic import whole_file
from jaxekf.recordings.types import Flags, Floats

ESTIMATE, MEASURED, TRUTH, HELD = "#0b5394", "#e69138", "#222222", "#a61c00"
REFUSED, HIDDEN = "#cc0000", "#d9d9d9"
AXES = ("x", "y", "z")
_LEGEND_COLUMNS = 7
STYLE: Any = {
    "font.size": 9,
    "axes.grid": True,
    "grid.alpha": 0.25,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "legend.frameon": False,
    "savefig.dpi": 130,
}


def styled() -> AbstractContextManager[None]:
    """A context in which matplotlib has the settings of `STYLE`."""
    return mpl.rc_context(STYLE)


def new_figure(size: tuple[float, float]) -> Figure:
    """An empty figure of `size` inches."""
    with styled():
        return Figure(figsize=size, layout="constrained")


def new_grid(
    rows: int, columns: int, size: tuple[float, float], **kwargs: Any
) -> tuple[Figure, Any]:
    """A figure of `size` inches with an array (rows, columns) of axes."""
    with styled():
        figure = new_figure(size)
        return figure, figure.subplots(rows, columns, squeeze=False, **kwargs)


def band(axes: Any, t: Floats, centre: Floats, sigma: Floats, label: str | None) -> None:
    """Fill two standard deviations above and below a curve."""
    axes.fill_between(
        t, centre - 2 * sigma, centre + 2 * sigma, color=ESTIMATE, alpha=0.22, lw=0, label=label
    )


def beside(axes: Any, lane: int, text: str) -> None:
    """Print a text to the right of a lane."""
    at = axes.get_yaxis_transform()
    axes.text(1.01, lane, text, transform=at, va="center", fontsize=8)


def stretches(chosen: Flags) -> Any:
    """First index and last, exclusive, of each stretch of chosen samples (M, 2)."""
    return np.flatnonzero(np.diff(np.r_[False, chosen, False].astype(int))).reshape(-1, 2)


def symmetric_limits(axes: Any, values: Floats) -> None:
    """Set limits symmetric about zero that hold 99.5 % of the values."""
    values = values[np.isfinite(values)]
    if values.size:
        bound = 1.3 * np.quantile(np.abs(values), 0.995) + 1e-12
        axes.set_ylim(-bound, bound)


def finish(figure: Figure, grid: Any, title: str, clock: Clock | None = None) -> None:
    """Add time labels below the columns, the title, and one legend of all curves at the bottom."""
    label = "" if clock is None else clock.label
    for axes in grid[-1]:
        axes.set_xlabel(f"time{label} since the start of the estimate (s)")
    named: dict[str, Any] = {}
    for axes in grid.flat:
        for handle, label in zip(*axes.get_legend_handles_labels(), strict=True):
            named.setdefault(label, handle)
    lines = -(-len(named) // _LEGEND_COLUMNS)
    columns = -(-len(named) // max(1, lines))
    figure.legend(
        list(named.values()), list(named), loc="outside lower center", ncols=max(1, columns)
    )
    figure.suptitle(title)


def save(figure: Figure, file: Path | str) -> Path:
    """Write a figure as a PNG file, atomically; an existing file is replaced."""
    canvas = FigureCanvasAgg(figure)
    with styled(), whole_file(file, overwrite=True) as temporary:
        figure.set_dpi(STYLE["savefig.dpi"])
        # `savefig` would lay out and draw twice, which doubles the time.
        canvas.draw()
        imsave(temporary, canvas.buffer_rgba(), format="png", dpi=figure.dpi)
    return Path(file)
