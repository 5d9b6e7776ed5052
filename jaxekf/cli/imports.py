"""`jaxekf import`: files of other programs as recorded runs."""

from pathlib import Path
from typing import Any

import click

from jaxekf.cli.console import json_option, note, overwrite_option, print_json, print_table
from jaxekf.cli.options import Finite
from jaxekf.io import run_folder
from jaxekf.io.atomic import check_output
from jaxekf.io.importers.formats import FORMATS, read
from jaxekf.recordings.facts import FILE
from jaxekf.recordings.types import STREAMS, Recording

_LIST = "\n".join(f"  {name:<10} {one.about}" for name, one in FORMATS.items())


@click.command("import", epilog=f"\b\nFORMAT is one of:\n{_LIST}")
@click.argument("form", metavar="FORMAT", type=click.Choice(list(FORMATS)))
@click.argument("source", metavar="SRC", type=click.Path(path_type=Path))
@click.option(
    "-o", "--output", metavar="RUN", required=True, type=click.Path(path_type=Path),
    help="Folder of the run.",
)  # fmt: skip
@click.option("--tool", help="Which tool, rigid body or object, where SRC holds several.")
@click.option(
    "--rate",
    "rate_hz",
    type=Finite(0.0, 1e6, min_open=True),
    help="ndi: hertz at which frames are counted, where they have no time.  [default: 60]",
)
@click.option(
    "--status-ok",
    multiple=True,
    help="ndi: a word or number of the state that means a good pose; repeatable, replaces the usual ones.",
)
@click.option("--imu", help="asl: stream of the IMU, by name or path; ros: its topic.")
@click.option("--pose", help="asl: stream of the poses, by name or path; ros: their topic.")
@click.option("--child-frame", help="ros: which of several transforms on one topic.")
@click.option("--joint", help="ros: topic of the joint's angle, for truth; needs --axis.")
@click.option("--joint-name", help="ros: which of several joints on one topic.")
@click.option(
    "--axis",
    type=float,
    nargs=3,
    metavar="X Y Z",
    help="ros: the joint's axis, in the tracker's frame.",
)
@click.option(
    "--stamps",
    type=click.Choice(["header", "receive"]),
    help="ros: the headers' stamps, or when the recorder got each message.  [default: header]",
)
@click.option(
    "--sort",
    is_flag=True,
    help="Put rows or messages in order of time that are not (not asl, broad, repoimu, adis).",
)
@overwrite_option
@json_option
def import_run(
    form: str, source: Path, output: Path, overwrite: bool, as_json: bool, **options: Any
) -> None:
    """Write what another program recorded as a run: jaxekf import FORMAT SRC -o RUN.

    Prints what became of every row, and what was taken for granted; both also stand in recording.toml. A
    tracker alone becomes a run by adding its imu.csv, on the same clock or within half a second of it.
    """
    check_output(output, FILE, overwrite=overwrite)
    given = {key: value for key, value in options.items() if value not in (None, (), False)}
    for key in given:
        if key not in FORMATS[form].options:
            taken = " or ".join(name for name, one in FORMATS.items() if key in one.options)
            option = "--" + key.removesuffix("_hz").replace("_", "-")
            raise click.UsageError(
                f"got {option} with {form}, expected it with {taken} only; leave it out"
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
    click.echo("Taken for granted:")
    for text in recording.info.get("assumptions", ()):
        click.echo(f"- {text}")


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
