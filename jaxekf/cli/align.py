"""`jaxekf align`: clock and frame of the tracker against the IMU."""

from pathlib import Path
from typing import Any

import click
import numpy as np
from msgspec import UNSET, Struct

from jaxekf._support.errors import RecordingError
from jaxekf.calibration.alignment import (
    CombinedAlignment,
    RunAlignment,
    align_run,
    calibration_for,
    combine_runs,
)
from jaxekf.calibration.attitude_alignment import AttitudeMatch, unobservable_axis
from jaxekf.checks.inspection import align_good_poses
from jaxekf.checks.sensor_agreement import evidence
from jaxekf.cli.console import (
    json_option,
    model_option,
    note,
    output_option,
    overwrite_option,
    print_json,
    print_table,
    sort_option,
)
from jaxekf.cli.estimate import load_runs, require_different_names
from jaxekf.estimation import parameters
from jaxekf.estimation.versions import provenance
from jaxekf.io.atomic import check_output, whole_folder
from jaxekf.io.documents import alignment as documents
from jaxekf.io.documents import codec
from jaxekf.io.hashes import inputs_of
from jaxekf.models import get_model
from jaxekf.recordings.types import Floats, Recording

_SOME_FAILED = 3
"""Exit status if some runs are left out, that of warnings in `jaxekf check`."""


@click.command()
@click.argument("runs", nargs=-1, required=True, type=click.Path(path_type=Path))
@model_option
@sort_option
@output_option("aligned")
@overwrite_option
@json_option
def align(
    runs: tuple[Path, ...], model: str, sort: bool, output: Path, overwrite: bool, as_json: bool
) -> None:
    """Clock offset and alignment between tracker and IMU, from the angular rates of RUNS.

    Latency: delay of the tracker's samples in seconds, in the middle of the run, in addition to the
    latency in the recording's description; drift: its growth in ppm. Alignment: tracker-to-IMU rotation
    (extrinsic rotation). The mean of all runs is written as calibration.toml for the model; align.json
    holds the numbers of each run. A run that cannot be read or aligned is left out and named, and the exit
    status is 3; 1 if none is left.
    """
    check_output(output, "align.json", overwrite=overwrite)
    chosen = get_model(model)
    recordings, found, failed = _align_each(runs, sort=sort)
    mean = combine_runs(found)
    params, sentences = calibration_for(chosen, mean)
    for run in found:
        for text in run.notes:
            note(f"{run.run}: {text}")
    for text in (*mean.sentences(), *sentences):
        note(text)
    made_of = provenance() | {"inputs": inputs_of(recordings)}
    document = documents.AlignmentDocument(
        model=chosen.name,
        runs=[run_document(run) for run in found],
        together=documents.MeanAlignment(**_shared(mean, documents.MeanAlignment)),
        calibration=parameters.to_document(chosen, params, {})["calibration"],
        notes=[*mean.sentences(), *sentences],
        failed=failed,
        provenance=made_of,
    )
    with whole_folder(output, "align.json", overwrite=overwrite) as folder:
        origin = {"aligned": [run.run for run in found]} | made_of
        parameters.save_calibration(folder, chosen, params, origin)
        (folder / "align.json").write_text(codec.as_text(document), "utf-8")
    note(f"wrote {output / 'calibration.toml'} for {chosen.name}")
    if as_json:
        print_json(codec.plain(document) | {"output": str(output)})
    else:
        _print(found, mean)
    if failed:
        click.get_current_context().exit(_SOME_FAILED)


def _align_each(
    runs: tuple[Path, ...], *, sort: bool
) -> tuple[list[Recording], list[RunAlignment], dict[str, str]]:
    """The runs that can be aligned, their alignments, and the error of each other run by its path.

    Raises the first error if no run is left.
    """
    paths, recordings, found, errors = [], [], [], {}
    for path in runs:
        try:
            (recording,) = load_runs([path], sort=sort)
            made = _align_one(recording)
        except RecordingError as error:
            errors[str(path)] = error
            continue
        paths.append(path)
        recordings.append(recording)
        found.append(made)
    if not found:
        raise next(iter(errors.values()))
    require_different_names(paths, recordings)
    for error in errors.values():
        note(f"Left out: {error}")
    return recordings, found, {path: str(error) for path, error in errors.items()}


def _align_one(recording: Recording) -> RunAlignment:
    try:
        return align_run(recording)
    except RecordingError:
        # Flipped poses would be the reason; without them the error is the same.
        return align_good_poses(recording, evidence(recording))


def _print(found: list[RunAlignment], mean: CombinedAlignment) -> None:
    rows = []
    for run in found:
        rows += aligned_rows(run)
    if len(found) > 1:
        turn, axis = _turn(mean.alignment, mean.alignment_cov)
        latency = _pm(1e3 * mean.latency_s, 1e3 * mean.latency_sigma_s)
        drift = _drift(mean.drift, mean.drift_sigma)
        rows.append(["mean", "tracker", latency, drift, turn, axis, ""])
    print_table("Against the IMU, with standard deviations", alignment_columns(), rows)
    if len(found) > 1:
        click.echo(
            f"Do the runs agree? latency: chi-square {mean.latency_chi2:.1f} of {mean.runs - 1},"
            f" p = {mean.latency_p:.2g}; alignment: {mean.alignment_chi2:.1f} of {mean.alignment_freedom},"
            f" p = {mean.alignment_p:.2g}"
        )


def alignment_columns() -> list[str]:
    """Headings of the columns of `aligned_row`."""
    return [
        "run",
        "stream",
        "latency\n(ms)",
        "drift\n(ppm)",
        "alignment\n(deg)",
        "about\n(x, y, z)",
        "gyroscope bias\n(deg/s)",
    ]


def aligned_rows(found: RunAlignment) -> list[list[Any]]:
    """The tracker and, if there is one, the encoder of a run."""
    streams = {"tracker": found.tracker, "encoder": found.encoder}
    return [
        aligned_row(found.run, name, made) for name, made in streams.items() if made is not None
    ]


def aligned_row(run: str, stream: str, made: AttitudeMatch) -> list[Any]:
    """One stream of a run, a row of the table."""
    turn, axis = _turn(made.alignment, made.alignment_cov)
    return [
        run,
        stream,
        _pm(1e3 * made.latency_s, 1e3 * made.latency_sigma_s),
        _drift(made.drift, made.drift_sigma),
        turn,
        axis,
        ", ".join(f"{value:+.3f}" for value in np.rad2deg(made.bias)),
    ]


def _turn(alignment: Floats, cov: Floats) -> tuple[str, str]:
    """Size with its deviation, degrees, and axis in words; without a turn about an unobservable axis."""
    size, unknown = float(np.linalg.norm(alignment)), unobservable_axis(cov)
    axis = alignment / size if size > 0.0 else np.linalg.eigh(cov)[1][:, 0]
    sigma = float(np.rad2deg(np.sqrt(axis @ cov @ axis)))
    about = ", ".join(f"{value:+.2f}" for value in axis)
    if unknown is None:
        return _pm(float(np.rad2deg(size)), sigma), about
    across = ", ".join(f"{value + 0.0:+.2f}" for value in np.round(unknown, 2))
    return f"{_pm(float(np.rad2deg(size)), sigma)}\nunobservable", f"{about}\n{across}"


def _drift(drift: float, sigma: float) -> str:
    """Drift in parts per million; a dash for a run that is too short."""
    return "–" if drift != drift else _pm(1e6 * drift, 1e6 * sigma)


def _pm(value: float, sigma: float) -> str:
    """A value with its deviation, to the deviation's second digit."""
    digits = int(np.clip(1 - np.floor(np.log10(max(sigma, 1e-9))), 0, 6))
    return f"{value:.{digits}f} ± {sigma:.{digits}f}"


def run_document(run: RunAlignment) -> documents.RunAlignment:
    """One run of `align.json`."""
    encoder = UNSET if run.encoder is None else match_document(run.encoder)
    return documents.RunAlignment(run.run, match_document(run.tracker), encoder, run.notes)


def match_document(made: AttitudeMatch) -> documents.StreamAlignment:
    """One stream of a run of `align.json`."""
    return documents.StreamAlignment(
        **_shared(made, documents.StreamAlignment),
        bias_deg_s=np.rad2deg(made.bias),
        scatter_deg=float(np.rad2deg(made.scatter)),
    )


def _shared(made: AttitudeMatch | CombinedAlignment, kind: type[Struct]) -> dict[str, Any]:
    """The fields of a document that have the same name in both, and the alignment in degrees."""
    found = {
        name: value for name, value in made._asdict().items() if name in kind.__struct_fields__
    }
    sigma = np.sqrt(np.diagonal(made.alignment_cov))
    degrees = {"alignment_deg": made.alignment, "alignment_sigma_deg": sigma}
    axis = unobservable_axis(made.alignment_cov)
    if axis is not None:
        found["unobservable_axis"] = axis
        degrees["alignment_sigma_deg"] = np.where(sigma > 1.0, np.nan, sigma)
    return found | {name: np.rad2deg(value) for name, value in degrees.items()}
