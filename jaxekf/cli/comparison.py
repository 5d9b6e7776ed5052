"""Tables of tunings: scores by variant, and parameters with their units."""

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any

import numpy as np

import tuning
from jaxekf.cli.console import print_table


def in_degrees(unit: str) -> tuple[Callable[[Any], Any], str]:
    """Function that converts a value to the unit that is shown, and that unit."""
    turn = np.rad2deg if unit.startswith("rad") else np.asarray
    return turn, unit.replace("rad", "deg", 1)


def short(value: object) -> str:
    """A number or an array in one line."""
    array = np.asarray(value, float)
    if array.ndim == 0:
        return f"{float(array):.5g}"
    return np.array2string(array, precision=4, separator=" ").replace("\n", "")


def print_comparison(
    title: str,
    rows: Sequence[tuning.Row],
    over_runs: Mapping[str, Callable[[str], dict[str, float]]] | None = None,
    work: Mapping[str, float] | None = None,
) -> None:
    """Print the scores of all variants, run by run and then over the runs.

    `over_runs` has functions from a column to a statistic by variant, by name; the mean unless given.
    `work` has entries by variant for one more column in the line of the means.
    """
    columns = {
        "attitude_rmse_deg": "attitude RMSE\n(deg)",
        "rate_rmse_deg_s": "rate RMSE\n(deg/s)",
        "nis": "tracker\nNIS",
        "nees": "NEES",
    }
    if any(row.position_rmse_mm == row.position_rmse_mm for row in rows):
        columns |= {
            "position_rmse_mm": "position RMSE\n(mm)",
            "position_nees": "position\nNEES",
        }
    shown = [[row.run, row.variant, *(getattr(row, field) for field in columns)] for row in rows]
    for name, statistic in (over_runs or {"mean": partial(tuning.mean_by_variant, rows)}).items():
        values = {field: statistic(field) for field in columns}
        for variant in dict.fromkeys(row.variant for row in rows):
            shown.append([name, variant, *(values[field][variant] for field in columns)])
    if work:
        columns["work"] = "work\n(filterings)"
        for row in shown:
            known = row[0] == "mean" and row[1] in work
            row.append(round(work[row[1]]) if known else float("nan"))
    print_table(title, ["run", "noise", *columns.values()], shown)
