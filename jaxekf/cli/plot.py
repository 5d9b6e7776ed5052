"""`jaxekf plot`: the figures of recorded runs."""

from pathlib import Path

import click

from jaxekf._support.errors import ModelError
from jaxekf.cli.console import (
    json_option,
    model_option,
    noise_option,
    note,
    print_json,
    robust_option,
    sort_option,
    wrote,
)
from jaxekf.cli.estimate import load_runs
from jaxekf.estimation import parameters
from jaxekf.estimation.batch import estimate_many
from jaxekf.estimation.result import Estimate
from jaxekf.models import get_model
from jaxekf.models.robust import OutlierMethod, robust
from jaxekf.recordings.types import Recording
from jaxekf.reporting import plots

FIGURES = tuple(plots.figure_functions())


def draw(made: Estimate, recording: Recording, folder: Path, names: tuple[str, ...]) -> list[Path]:
    """Write the named figures of one run."""
    folder.mkdir(parents=True, exist_ok=True)
    functions = plots.figure_functions()
    possible = plots.possible_figures(made, recording)
    missing = [name for name in names if name not in possible]
    if missing:
        raise ModelError(
            f"run '{made.run}': got the figures {missing}, expected some of {list(possible)} for this"
            " model and recording; leave the others out"
        )
    return [
        plots.save(functions[name](made, recording), folder / f"{made.run}_{name}.png")
        for name in names
    ]


@click.command()
@click.argument("runs", nargs=-1, required=True, type=click.Path(path_type=Path))
@click.option(
    "--figure",
    "figures",
    multiple=True,
    type=click.Choice(FIGURES),
    help="Which; repeatable.  [default: all]",
)
@model_option
@robust_option
@noise_option
@sort_option
@click.option(
    "-o", "--output", type=click.Path(path_type=Path), default=Path("figures"), show_default=True
)
@json_option
def plot(
    runs: tuple[Path, ...],
    figures: tuple[str, ...],
    model: str,
    outlier_method: OutlierMethod | None,
    noise_files: tuple[str, ...],
    sort: bool,
    output: Path,
    as_json: bool,
) -> None:
    """Estimate RUNS and draw what model and recording can show.

    attitude, position, velocity, rate: values, and errors where there is an encoder; bias; occlusion: the
    longest time without a pose; path in three dimensions; of single markers visibility (used, refused,
    hidden) and innovations.
    """
    chosen = get_model(model) if outlier_method is None else robust(model, outlier_method)
    recordings = load_runs(runs, sort=sort, model=chosen)
    estimates = estimate_many(recordings, chosen, parameters.load(chosen, *noise_files))
    files: list[Path] = []
    for made, recording in zip(estimates, recordings, strict=True):
        names = figures or plots.possible_figures(made, recording)
        if not names:
            note(f"{made.run}: no figure: it needs ten instants or more")
        drawn = draw(made, recording, output, names)
        files += drawn
        for file in drawn:
            wrote(file)
    if as_json:
        print_json({"figures": [str(file) for file in files]})
