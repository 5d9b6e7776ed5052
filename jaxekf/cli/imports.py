"""`jaxekf import`: files of other programs as recorded runs."""

from pathlib import Path
from typing import Any

import click

from jaxekf.cli.console import json_option, note, overwrite_option, print_json, print_table
from jaxekf.cli.options import Finite
from jaxekf.io.atomic import check_output
from jaxekf.io.importers.formats import FORMATS, Option, read
from jaxekf.recordings.facts import FILE
from jaxekf.recordings.types import STREAMS, Recording


def _option(declared: dict[str, Option]) -> click.Option:
    """The option of the command that some formats declare, by the formats' names."""
    first = next(iter(declared.values()))
    formats: dict[str, list[str]] = {}
    for name, option in declared.items():
        formats.setdefault(option.help, []).append(name)
    text = "; ".join(f"{', '.join(names)}: {words}" for words, names in formats.items())
    text += "; repeatable." if first.repeatable else "."
    text += "" if first.default is None else f"  [default: {first.default}]"
    if first.kind is bool:
        return click.Option([first.flag, first.name], is_flag=True, help=text)
    kind: Any = click.Choice(first.choices) if first.choices else first.kind
    if first.bounds:
        kind = Finite(*first.bounds, min_open=True)
    return click.Option(
        [first.flag, first.name],
        type=kind,
        nargs=len(first.values) or 1,
        metavar=" ".join(first.values) or None,
        multiple=first.repeatable,
        help=text,
    )


_DECLARED: dict[str, dict[str, Option]] = {}
"""For each option, the formats that declare it, with their declarations."""
for _name, _form in FORMATS.items():
    for _each in _form.options:
        _DECLARED.setdefault(_each.name, {})[_name] = _each
_LIST = "\n".join(f"  {name:<10} {form.summary}" for name, form in FORMATS.items())


@click.command("import", epilog=f"\b\nFORMAT is one of:\n{_LIST}")
@click.argument("form", metavar="FORMAT", type=click.Choice(list(FORMATS)))
@click.argument("source", metavar="SRC", type=click.Path(path_type=Path))
@click.option(
    "-o", "--output", metavar="RUN", required=True, type=click.Path(path_type=Path),
    help="Folder of the run.",
)  # fmt: skip
@overwrite_option
@json_option
def import_run(
    form: str, source: Path, output: Path, overwrite: bool, as_json: bool, **options: Any
) -> None:
    """Convert a recording of another program to a run: jaxekf import FORMAT SRC -o RUN.

    Prints the account of every row and all assumptions, which are also in recording.toml. A tracker alone
    becomes a run by adding its imu.csv, on the same clock or on one that jaxekf align can match.
    """
    from jaxekf.io import run_folder

    check_output(output, FILE, overwrite=overwrite)
    given = {key: value for key, value in options.items() if value not in (None, (), False)}
    for key, declared in _DECLARED.items():
        if key in given and form not in declared:
            flag = next(iter(declared.values())).flag
            raise click.UsageError(
                f"got {flag} with {form}, expected it with {' or '.join(declared)} only; leave it out"
            )
    recording = read(form, source, **given)
    run_folder.save(recording, output, overwrite=overwrite)
    note(f"wrote {output}")
    if as_json:
        print_json(_document(recording, form, source, output))
        return
    rows = [
        [label, one["rows"], one["used"], one["masked"], one["dropped"]]
        for label, one in _counts(recording).items()
    ]
    print_table(recording.name, ["stream", "rows", "used", "masked", "dropped"], rows)
    for label, account in recording.intake.items():
        for text in account.sentences(label):
            click.echo(text)
    click.echo("Assumptions:")
    for text in recording.info.get("assumptions", ()):
        click.echo(f"- {text}")


# Before the options that other commands have too.
import_run.params[3:3] = [_option(declared) for declared in _DECLARED.values()]


def _counts(recording: Recording) -> dict[str, dict[str, int]]:
    """Rows of every stream: read, used, masked, dropped."""
    found = {}
    for label in STREAMS:
        if label not in recording.intake:
            continue
        account = recording.intake[label]
        masked, dropped = (
            sum(reason.count for reason in reasons.values())
            for reasons in (account.masked, account.dropped)
        )
        found[label] = {
            "rows": account.rows,
            "used": account.rows - masked - dropped,
            "masked": masked,
            "dropped": dropped,
        }
    return found


def _document(recording: Recording, form: str, source: Path, output: Path) -> dict[str, Any]:
    counts = _counts(recording)
    return {
        "run": str(output),
        "name": recording.name,
        "format": form,
        "source": str(source),
        "streams": {
            label: {"used": counts[label]["used"], **recording.intake[label].as_dict()}
            for label in counts
        },
        "assumptions": list(recording.info.get("assumptions", ())),
    }
