"""`jaxekf tune --folds`: its option, and its tables."""

from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

import click
import numpy as np

import tuning
from jaxekf.cli.comparison import in_degrees, print_comparison, short, units_by_name
from jaxekf.cli.console import note, print_table, tuning_progress
from jaxekf.io.run_folder import read_log
from jaxekf.recordings.types import Recording


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


beside_option = click.option(
    "--beside",
    multiple=True,
    type=click.Choice(tuning.BESIDE),
    help="With --folds: what is judged beside the tuning, allan (the start with what the runs' rest tells),"
    " coordinates or nelder-mead (searches without gradients), with the work of each; repeatable.",
)
static_option = click.option(
    "--static",
    type=click.Path(path_type=Path),
    help="With --beside allan: a static log, or a run that rests, to take noise from in place of the runs'"
    " rest.",
)


def check_folds(folds: int | None, beside: Sequence[str], static: Path | None) -> None:
    """Raise `click.UsageError` for options that belong to others which are not there."""
    if beside and folds is None:
        raise click.UsageError(
            f"got --beside {beside[0]} without --folds, expected folds to judge it in; add --folds all"
        )
    if static is not None and "allan" not in beside:
        raise click.UsageError(
            f"got --static {static} without --beside allan, expected what is to use it; add that, or leave"
            " it out"
        )


def held_out(
    runs: Sequence[Recording],
    folds: int,
    iterations: int,
    static: Path | None,
    **options: Any,
) -> tuning.CrossValidation:
    """The cross-validation that was asked for, with a progress bar; 0 folds for one for each run."""
    with tuning_progress(iterations) as bar:
        return tuning.cross_validate(
            runs,
            folds or None,
            iterations=iterations,
            static=None if static is None else read_log(static),
            progress=bar,
            stage=bar.stage,
            **options,
        )


def print_folds(found: tuning.CrossValidation) -> None:
    """Held-out runs, how far they spread, and what the folds found."""

    def told(of: str, column: str) -> dict[str, float]:
        return {name: getattr(spread, of) for name, spread in found.spread(column).items()}

    over_runs = {of: partial(told, of) for of in tuning.Spread._fields}
    title = "Held out: each run by a tuning without it"
    print_comparison(title, found.rows, over_runs, found.forward)
    if found.forward:
        note(
            "work is the mean over the folds, in filterings of all training runs; one with its gradient"
            f" takes the time of {found.gradient_cost:.2f}"
        )
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
