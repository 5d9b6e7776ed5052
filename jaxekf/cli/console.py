"""What the commands share: options, tables, progress and JSON."""

import json
import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import click
from rich import box
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn
from rich.table import Table

from jaxekf.cli.commands import WRITTEN
from jaxekf.io.atomic import finite_or_null
from jaxekf.io.description import SCHEMA_VERSION
from jaxekf.models import REGISTRY
from jaxekf.models.robust import OUTLIER_METHODS

json_option = click.option(
    "--json", "as_json", is_flag=True, help="Print JSON on standard output instead of a table."
)
overwrite_option = click.option(
    "--overwrite", is_flag=True, help="Replace the output if it exists."
)
model_option = click.option(
    "--model",
    default="loose",
    show_default=True,
    help=f"{', '.join(REGISTRY)}, or your own as module:attribute.",
)
noise_option = click.option(
    "--noise",
    "noise_files",
    multiple=True,
    type=click.Path(),
    help="noise.toml, calibration.toml, or a folder that holds them; repeatable.",
)

sort_option = click.option(
    "--sort",
    is_flag=True,
    help="Put rows that are out of order in order of time, instead of refusing the file.",
)
robust_option = click.option(
    "--robust",
    "outlier_method",
    type=click.Choice(OUTLIER_METHODS),
    help="What to do with samples that do not fit: gate refuses them, huber and student let them count"
    " less, none takes all in full.  [default: as the model has it]",
)


def wrote(path: Path) -> None:
    """Say that an output is there, whole; should the command be stopped it is told again."""
    click.get_current_context().meta.setdefault(WRITTEN, []).append(path)
    note(f"wrote {path}")


def note(text: str) -> None:
    """A line for the person at the terminal, on standard error."""
    click.echo(text, err=True)


def print_json(document: Mapping[str, Any]) -> None:
    """One JSON document on standard output, with its version; numbers that are not finite become null."""
    told = {"schema_version": SCHEMA_VERSION, **document}
    click.echo(json.dumps(finite_or_null(told), indent=2))


def print_table(title: str, columns: Sequence[str], rows: Sequence[Sequence[Any]]) -> None:
    """A table on standard output; numbers to the right, unknown ones as a dash."""
    table = Table(title=title, title_justify="left", title_style="bold", box=box.SIMPLE_HEAD)
    for i, column in enumerate(columns):
        numeric = bool(rows) and isinstance(rows[0][i], float | int)
        table.add_column(column, justify="right" if numeric else "left", no_wrap=True)
    for row in rows:
        table.add_row(*[_cell(value) for value in row])
    wide = None if sys.stdout.isatty() else 120
    Console(width=wide).print(table)


def _cell(value: Any) -> str:
    if isinstance(value, float):
        return "–" if value != value else f"{value:.3f}"
    return str(value)


class TuningBar:
    """What a tuner tells its steps; `stage` says before them what they belong to."""

    def __init__(self, bar: Progress, iterations: int) -> None:
        self.bar, self.iterations, self.prefix = bar, iterations, "tuning"
        self.task = bar.add_task("tuning: compiling", total=iterations)

    def __call__(self, step: Any, total: int) -> None:
        held = "" if step.validation != step.validation else f", validation {step.validation:.5g}"
        told = "rejected step" if step.rejected else f"{step.training:.5g}{held}"
        text = f"{self.prefix}: {told}"
        self.bar.update(self.task, completed=step.number + 1, total=total, description=text)

    def stage(self, text: str) -> None:
        """Begin anew with another description, such as ``fold 2/5``."""
        self.prefix = text
        self.bar.reset(self.task, total=self.iterations, description=text)


@contextmanager
def tuning_progress(iterations: int) -> Iterator[TuningBar]:
    """A progress bar for the tuner on a terminal's standard error; silent in a pipe."""
    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
    )
    console = Console(stderr=True)
    with Progress(*columns, console=console, disable=not sys.stderr.isatty()) as bar:
        yield TuningBar(bar, iterations)
