"""`jaxekf report`: one HTML page of results and tunings."""

from pathlib import Path

import click

from jaxekf.cli.console import json_option, note, overwrite_option, print_json
from jaxekf.reporting.report import write_report


@click.command()
@click.argument("results", nargs=-1, required=True, type=click.Path(path_type=Path))
@click.option(
    "-o",
    "--output",
    type=click.Path(path_type=Path),
    default=Path("report.html"),
    show_default=True,
)
@overwrite_option
@json_option
def report(results: tuple[Path, ...], output: Path, overwrite: bool, as_json: bool) -> None:
    """Show RESULTS, folders written by jaxekf estimate or jaxekf tune, in one HTML file without network.

    Estimates are shown with their bands, tracker, gyroscope and encoder, biases, innovations, account of
    samples and verdicts; a recording is read from the path at which it was estimated. Tunings are shown
    with warnings, search, runs before and after, parameters and folds.
    """
    made = write_report(results, output, overwrite=overwrite)
    for name, missing in zip(made.runs, made.missing, strict=True):
        if missing:
            note(f"{name}: measurements and truth are not shown: {missing}")
    note(f"wrote {made.path} ({made.size / 1e6:.1f} MB)")
    if as_json:
        runs = [
            {"name": name, "result": str(folder), "recording_missing": missing, **row._asdict()}
            for name, folder, row, missing in zip(
                made.runs, made.folders, made.summaries, made.missing, strict=True
            )
        ]
        tunings = [
            {"name": each.name, "tuned": str(each.tuning.folder), "warnings": each.warnings}
            for each in made.tunings
        ]
        document = {"report": str(made.path), "bytes": made.size, "runs": runs}
        print_json(document | {"tunings": tunings})
