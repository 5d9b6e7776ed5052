"""`jaxekf plot`: the figures of recorded runs."""

from pathlib import Path

import click

from jaxekf._support.errors import ModelError
from jaxekf.cli.console import (
    json_option,
    model_option,
    noise_option,
    note,
    output_option,
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


def draw(
    estimate: Estimate, recording: Recording, folder: Path, names: tuple[str, ...]
) -> list[Path]:
    """Write the named figures of one run into a folder."""
    folder.mkdir(parents=True, exist_ok=True)
    functions = plots.figure_functions()
    available = plots.available_figures(estimate, recording)
    missing = [name for name in names if name not in available]
    if missing:
        raise ModelError(
            f"run '{estimate.run}': got the figures {missing}, expected some of {list(available)} for this"
            " model and recording; leave the others out"
        )
    return [
        plots.save(functions[name](estimate, recording), folder / f"{estimate.run}_{name}.png")
        for name in names
    ]


@click.command()
@click.argument("runs", nargs=-1, required=True, type=click.Path(path_type=Path))
@click.option(
    "--figure",
    "figures",
    multiple=True,
    type=click.Choice(FIGURES),
    help="Figure to draw; repeatable.  [default: all that model and recording have data for]",
)
@model_option
@robust_option
@noise_option
@sort_option
@output_option("figures", "Folder for the PNG files RUN_FIGURE.png.")
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
    """Estimate RUNS and draw figures of the estimates.

    attitude, position, velocity, rate: values, and errors if there is an encoder. bias: gyroscope and
    accelerometer. occlusion: the longest time without a pose. path: in three dimensions. visibility and
    innovations: of single markers.
    """
    chosen = get_model(model) if outlier_method is None else robust(model, outlier_method)
    recordings = load_runs(runs, sort=sort, model=chosen)
    estimates = estimate_many(recordings, chosen, parameters.load(chosen, *noise_files))
    files: list[Path] = []
    for estimate, recording in zip(estimates, recordings, strict=True):
        names = figures or plots.available_figures(estimate, recording)
        if not names:
            note(f"{estimate.run}: no figure, since it has fewer than ten instants")
        drawn = draw(estimate, recording, output, names)
        files += drawn
        for file in drawn:
            wrote(file)
    if as_json:
        print_json({"figures": [str(file) for file in files]})
