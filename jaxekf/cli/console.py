"""Options, tables, progress and JSON that the commands share."""

import json
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from time import monotonic
from typing import Any

import click
from rich import box
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn
from rich.table import Table
from rich.text import Text

from jaxekf.cli.commands import WRITTEN
from jaxekf.io.description import SCHEMA_VERSION
from jaxekf.io.documents import codec
from jaxekf.models import REGISTRY
from jaxekf.models.robust import OUTLIER_METHODS

_SECONDS_BETWEEN_LINES = 10.0
"""Time between two lines on an iteration where there is no bar."""
_UNLIMITED = 100_000
"""Width of a pipe or a file, in characters."""


def default_option(name: str, kind: Any, default: Any, contents: str) -> Callable[[Any], Any]:
    """An option with a default, which its help shows after `contents`."""
    return click.option(name, type=kind, default=default, show_default=True, help=contents)


json_option = click.option(
    "--json", "as_json", is_flag=True, help="JSON on standard output instead of a table."
)
overwrite_option = click.option(
    "--overwrite", is_flag=True, help="Replacement of an existing output."
)
model_option = default_option(
    "--model", None, "loose", f"Model: {', '.join(REGISTRY)}, or your own as module:attribute."
)
noise_option = click.option(
    "--noise",
    "noise_files",
    multiple=True,
    type=click.Path(),
    help="Noise and calibration: noise.toml, calibration.toml, or a folder with them; repeatable."
    "  [default: as in the model]",
)

_QUIET = "jaxekf.quiet"


def _be_quiet(ctx: click.Context, param: click.Parameter, value: bool) -> None:
    ctx.meta[_QUIET] = value


quiet_option = click.option(
    "--quiet",
    is_flag=True,
    envvar="JAXEKF_QUIET",
    expose_value=False,
    callback=_be_quiet,
    help="No lines on the progress, which standard error gets where it is not a terminal.",
)
sort_option = click.option(
    "--sort",
    is_flag=True,
    help="Sorting of rows by time, instead of an error for rows that are out of order.",
)
robust_option = click.option(
    "--robust",
    "outlier_method",
    type=click.Choice(OUTLIER_METHODS),
    help="Treatment of outliers: gate rejects them, huber and student reduce their weight (Huber or"
    " Student-t), none uses all samples with full weight.  [default: as in the model]",
)


def output_option(default: str, contents: str | None = None) -> Callable[[Any], Any]:
    """The option ``-o``: a path with its default, and the noun phrase of its help."""
    names, kind = ("-o", "--output"), click.Path(path_type=Path)
    return click.option(*names, type=kind, default=Path(default), show_default=True, help=contents)


def wrote(path: Path) -> None:
    """Print that an output is complete, and list it in the message of an interrupted command."""
    click.get_current_context().meta.setdefault(WRITTEN, []).append(path)
    note(f"wrote {path}")


def note(text: str) -> None:
    """Print a line for the user on standard error."""
    click.echo(text, err=True)


def stage(text: str) -> None:
    """Print what a long command does next, unless a terminal shows a bar for it, or --quiet is given."""
    context = click.get_current_context(silent=True)
    is_quiet = context is not None and context.meta.get(_QUIET, False)
    if not sys.stderr.isatty() and not is_quiet:
        note(text)


def print_json(document: Mapping[str, Any]) -> None:
    """Print a JSON document with its version; numbers that are not finite become null."""
    versioned = {"schema_version": SCHEMA_VERSION, **document}
    # In ASCII, which every terminal can print.
    click.echo(json.dumps(codec.plain(versioned), indent=2))


def print_table(title: str, columns: Sequence[str], rows: Sequence[Sequence[Any]]) -> None:
    """Print a table on standard output; numbers are right-aligned, NaN is a dash.

    No cell is ever shortened. In a terminal that is too narrow the heads take more lines, rows become
    columns, or each row becomes a block of lines ``name: value``. A pipe or file has no width.
    """
    shown = [[_cell(value) for value in row] for row in rows]
    numeric = [bool(rows) and isinstance(value, float | int) for value in (rows or [columns])[0]]
    width = _terminal_width()
    for table in _forms(columns, shown, numeric):
        table_width = Console(width=_UNLIMITED).measure(table).maximum
        if table_width <= width:
            console = Console(width=table_width)
            # In full, also where it is wider than the table.
            console.print(title, style="bold", soft_wrap=True, markup=False, highlight=False)
            console.print(table)
            return
    _print_blocks(title, columns, shown)


def _forms(
    columns: Sequence[str], rows: Sequence[Sequence[str]], numeric: Sequence[bool]
) -> Iterator[Table]:
    """The same table in forms that are narrower and narrower."""
    folded = [column.replace(" ", "\n") for column in columns]
    yield _table(columns, rows, numeric)
    yield _table(folded, rows, numeric)
    yield _table(folded, rows, numeric, padding=(0, 0))
    turned = [[" ".join(n.split()), *cells] for n, *cells in zip(columns, *rows, strict=True)]
    yield _table(turned[0], turned[1:], [False, *len(rows) * [True]])


def _table(
    heads: Sequence[str],
    rows: Sequence[Sequence[str]],
    numeric: Sequence[bool],
    padding: tuple[int, int] = (0, 1),
) -> Table:
    table = Table(box=box.SIMPLE_HEAD, padding=padding)
    for head, right in zip(heads, numeric, strict=True):
        table.add_column(Text(head), justify="right" if right else "left", no_wrap=True)
    for row in rows:
        table.add_row(*map(Text, row))  # a text in brackets is no style
    return table


def _print_blocks(title: str, columns: Sequence[str], rows: Sequence[Sequence[str]]) -> None:
    """Each row as lines ``name: value`` below its first cell."""
    click.secho(title, bold=True)
    for row in rows:
        click.echo(f"\n  {row[0]}")
        for name, cell in zip(columns[1:], row[1:], strict=True):
            click.echo(f"    {' '.join(name.split())}: {cell}")
    click.echo()


def _terminal_width() -> int:
    """Columns of the terminal; unlimited in a pipe or file."""
    return Console().width if sys.stdout.isatty() else _UNLIMITED


def _cell(value: Any) -> str:
    if isinstance(value, float):
        return "–" if value != value else f"{value:.3f}"
    return str(value)


class TuningBar:
    """A progress callback of the tuner; `stage` names the part of the tuning that follows."""

    def __init__(self, bar: Progress, iterations: int) -> None:
        self.bar, self.iterations, self.prefix = bar, iterations, "tuning"
        self.printed = monotonic()
        stage("tuning: compiling")
        self.task = bar.add_task("tuning: compiling", total=iterations)

    def __call__(self, step: Any, total: int) -> None:
        held = "" if step.validation != step.validation else f", validation {step.validation:.5g}"
        result = "rejected step" if step.rejected else f"{step.training:.5g}{held}"
        text = f"{self.prefix}: {result}"
        if monotonic() - self.printed > _SECONDS_BETWEEN_LINES:
            self.printed = monotonic()
            stage(f"{text} after iteration {step.number} of {total}")
        self.bar.update(self.task, completed=step.number + 1, total=total, description=text)

    def stage(self, text: str) -> None:
        """Reset the bar with another description, such as ``fold 2/5``."""
        self.prefix = text
        stage(text)
        self.bar.reset(self.task, total=self.iterations, description=text)


@contextmanager
def tuning_progress(iterations: int) -> Iterator[TuningBar]:
    """A progress bar for the tuner on standard error; lines where that is no terminal."""
    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
    )
    console = Console(stderr=True)
    with Progress(*columns, console=console, disable=not sys.stderr.isatty()) as bar:
        yield TuningBar(bar, iterations)
