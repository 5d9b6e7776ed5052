"""`jaxekf report`: one HTML page of results and tunings."""

from pathlib import Path

import click

from jaxekf.cli.console import json_option, note, output_option, overwrite_option, print_json
from jaxekf.reporting.report import write_report


@click.command()
@click.argument("results", nargs=-1, required=True, type=click.Path(path_type=Path))
@output_option("report.html", "HTML file.")
@overwrite_option
@json_option
def report(results: tuple[Path, ...], output: Path, overwrite: bool, as_json: bool) -> None:
    """Show RESULTS, folders written by jaxekf estimate or jaxekf tune, in one HTML file that works offline.

    Estimates: values with 2 sigma bands, tracker, gyroscope and encoder, biases, innovations, the account
    of all samples, and the diagnosis; a recording is read from the path that it was estimated from.
    Tunings: warnings, the search, scores before and after, parameters and folds.
    """
    written = write_report(results, output, overwrite=overwrite)
    for name, missing in zip(written.runs, written.missing, strict=True):
        if missing:
            note(f"{name}: measurements and truth are not shown: {missing}")
    note(f"wrote {written.path} ({written.size / 1e6:.1f} MB)")
    if as_json:
        runs = [
            {"name": name, "result": str(folder), "recording_missing": missing, **row._asdict()}
            for name, folder, row, missing in zip(
                written.runs, written.folders, written.summaries, written.missing, strict=True
            )
        ]
        tunings = [
            {"name": each.name, "tuned": str(each.tuning.folder), "warnings": each.warnings}
            for each in written.tunings
        ]
        document = {"report": str(written.path), "bytes": written.size, "runs": runs}
        print_json(document | {"tunings": tunings})
