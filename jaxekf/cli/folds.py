"""`jaxekf tune --folds`: its options and tables."""

from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

import click
import numpy as np

import tuning
from jaxekf.cli.comparison import in_degrees, print_comparison, short
from jaxekf.cli.console import note, print_table, tuning_progress
from jaxekf.estimation.parameters import leaves_by_name
from jaxekf.io.run_folder import read_log
from jaxekf.recordings.types import Recording


def _number(ctx: click.Context, param: click.Parameter, value: str | None) -> int | None:
    """Number of folds; 0 for one for each run."""
    if value is None or value == "all":
        return None if value is None else 0
    if not value.isdecimal():
        raise click.BadParameter(f"got '{value}', expected a number of folds or 'all'")
    return int(value)


folds_option = click.option(
    "--folds",
    metavar="K",
    callback=_number,
    help="Number of folds of a cross-validation before the tuning, each of every K-th run; all (or 0): one"
    " for each run.  [default: no cross-validation]",
)


baselines_option = click.option(
    "--baselines",
    multiple=True,
    type=click.Choice(tuning.BASELINES),
    help="Baseline for --folds: allan (the start with the sensor noise of static intervals), coordinates or"
    " nelder-mead (searches without gradients), with the work of each; repeatable.",
)
static_option = click.option(
    "--static",
    type=click.Path(path_type=Path),
    help="Static log for --baselines allan, or a run at rest.  [default: the runs' static intervals]",
)


def check_folds(folds: int | None, baselines: Sequence[str], static: Path | None) -> None:
    """Raise `click.UsageError` for options without those that they belong to."""
    if baselines and folds is None:
        raise click.UsageError(
            f"got --baselines {baselines[0]} without --folds, expected folds; add --folds all"
        )
    if static is not None and "allan" not in baselines:
        raise click.UsageError(
            f"got --static {static} without --baselines allan, expected the baseline; add that, or leave it"
            " out"
        )


def held_out(
    runs: Sequence[Recording],
    folds: int,
    iterations: int,
    static: Path | None,
    **options: Any,
) -> tuning.CrossValidation:
    """Cross-validate with a progress bar; 0 folds for one for each run."""
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
    """Print held-out runs with their statistics, and the parameters of the folds."""

    def statistic(name: str, column: str) -> dict[str, float]:
        return {key: getattr(spread, name) for key, spread in found.spread(column).items()}

    over_runs = {name: partial(statistic, name) for name in tuning.Spread._fields}
    title = "Held out: each run by a tuning without it"
    print_comparison(title, found.rows, over_runs, found.forward)
    if found.forward:
        note(
            "work is the mean over the folds, in filterings of all training runs; one with its gradient"
            f" takes the time of {found.gradient_cost:.2f}"
        )
    units = leaves_by_name(found.folds[0].tuned.model.units)
    rows: list[list[Any]] = []
    for name, spread in found.parameters.items():
        turn, unit = in_degrees(units[name])
        for at in np.ndindex(spread.start.shape):
            if name.startswith("noise.") and len(at) == 2 and at[1] > at[0]:
                continue  # a triangular factor is zero above its diagonal
            entry = [short(turn(value[at])) for value in spread[:3]]
            rows.append([name + (str(list(at)) if at else ""), *entry, unit])
    print_table(
        f"Parameters of the {len(found.folds)} folds",
        ["parameter", "start", "mean", "deviation", "unit"],
        rows,
    )
