"""`jaxekf crop`: a part of a run as a run of its own."""

from pathlib import Path

import click

from jaxekf.cli.console import json_option, overwrite_option, print_json, sort_option, wrote
from jaxekf.cli.options import Finite
from jaxekf.io import run_folder
from jaxekf.io.atomic import check_output
from jaxekf.recordings.facts import FILE
from jaxekf.recordings.gaps import crop as crop_recording


@click.command()
@click.argument("run", type=click.Path(path_type=Path))
@click.option(
    "--from", "start_s", type=Finite(0.0), default=0.0, show_default=True,
    help="Start, s from the IMU's first sample.",
)  # fmt: skip
@click.option(
    "--to", "end_s", type=Finite(0.0), default=float("inf"), show_default="end of the run",
    help="End, s from the IMU's first sample; a sample at this time is left out.",
)  # fmt: skip
@click.option(
    "-o", "--output", metavar="PART", required=True, type=click.Path(path_type=Path),
    help="Folder of the part.",
)  # fmt: skip
@sort_option
@overwrite_option
@json_option
def crop(
    run: Path,
    start_s: float,
    end_s: float,
    output: Path,
    sort: bool,
    overwrite: bool,
    as_json: bool,
) -> None:
    """Write a part of a run as a run: jaxekf crop RUN --from 20 --to 60 -o PART.

    Two parts of one recording serve for tuning and for validation. The part has all streams; times, masks
    and units are those of the run.
    """
    check_output(output, FILE, overwrite=overwrite)
    part = crop_recording(run_folder.load(run, sort=sort), start_s, end_s)
    run_folder.save(part.replace(name=output.name), output, overwrite=overwrite)
    wrote(output)
    samples = {label: len(stream.time_ns) for label, stream in part.streams.items()}
    if as_json:
        print_json({"run": str(output), "part": part.info["part"], "samples": samples})
    else:
        click.echo(", ".join(f"{label}: {count} samples" for label, count in samples.items()))
