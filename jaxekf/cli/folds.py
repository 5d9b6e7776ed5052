"""`jaxekf tune --folds`: its option, and its tables."""

from functools import partial
from typing import Any

import click
import numpy as np

import tuning
from jaxekf.cli.comparison import in_degrees, print_comparison, short, units_by_name
from jaxekf.cli.console import print_table


def _number(ctx: click.Context, param: click.Parameter, value: str | None) -> int | None:
    """0 for one fold for each run."""
    if value is None or value == "all":
        return None if value is None else 0
    if not value.isdecimal():
        raise click.BadParameter(f"got '{value}', expected a number of folds or 'all'")
    return int(value)


folds_option = click.option(
    "--folds",
    metavar="K",
    callback=_number,
    help="First tune K times, each time without every K-th run, and judge it on those; all (or 0) leaves"
    " out each run once.",
)


def print_folds(found: tuning.CrossValidation) -> None:
    """Held-out runs, how far they spread, and what the folds found."""

    def told(of: str, column: str) -> dict[str, float]:
        return {name: getattr(spread, of) for name, spread in found.spread(column).items()}

    over_runs = {of: partial(told, of) for of in tuning.Spread._fields}
    print_comparison("Held out: each run by a tuning without it", found.rows, over_runs)
    units = units_by_name(found.folds[0].tuned.model)
    rows: list[list[Any]] = []
    for name, spread in found.parameters.items():
        turn, unit = in_degrees(units[name])
        for at in np.ndindex(spread.start.shape):
            if name.startswith("noise.") and len(at) == 2 and at[1] > at[0]:
                continue  # above the diagonal of a factor there is nothing
            entry = [short(turn(value[at])) for value in spread[:3]]
            rows.append([name + (str(list(at)) if at else ""), *entry, unit])
    print_table(
        f"Parameters of the {len(found.folds)} folds",
        ["parameter", "start", "mean", "deviation", "unit"],
        rows,
    )
