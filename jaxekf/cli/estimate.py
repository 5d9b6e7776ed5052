"""`jaxekf estimate`: attitude, rate and bias of recorded runs."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import click
import numpy as np

from jaxekf._support import memory
from jaxekf._support.errors import RecordingError
from jaxekf.cli.console import (
    json_option,
    model_option,
    noise_option,
    note,
    overwrite_option,
    print_json,
    print_table,
    robust_option,
    sort_option,
    wrote,
)
from jaxekf.estimation import parameters
from jaxekf.estimation.batch import estimate_many
from jaxekf.estimation.causal import estimate_online
from jaxekf.estimation.output_times import Every, Requested, every, read_requested
from jaxekf.estimation.result import Estimate, trackers
from jaxekf.evaluation import metrics
from jaxekf.evaluation.diagnosis import Diagnosis, diagnose, diagnose_many
from jaxekf.filtering.model import Model
from jaxekf.geometry import manifold
from jaxekf.io import run_folder
from jaxekf.io.atomic import check_output
from jaxekf.io.export import FILES
from jaxekf.models import get_model
from jaxekf.models.robust import OutlierMethod, robust
from jaxekf.recordings.gaps import split_at_gaps
from jaxekf.recordings.types import Recording


def load_runs(
    paths: Sequence[Path], *, sort: bool = False, model: Model | None = None
) -> list[Recording]:
    """Read runs; each must have a name of its own, since results are named after them.

    What was masked or dropped is said. For a `model` that an IMU drives a run is cut at the IMU's gaps.
    """
    recordings = []
    for path in paths:
        with memory.for_runs([path.name]):
            recordings.append(run_folder.load(path, sort=sort))
    names = [recording.name for recording in recordings]
    for path, name in zip(paths, names, strict=True):
        if names.count(name) > 1:
            raise RecordingError(
                path, f"the name '{name}' twice", "runs with different names", "renaming one"
            )
    for recording in recordings:
        for label, account in recording.intake.items():
            for text in account.sentences(label):
                note(f"{recording.name}: {text}")
    if model is None or model.input is None:
        return recordings
    return [part for recording in recordings for part in _parts(recording)]


def _parts(recording: Recording) -> list[Recording]:
    """The parts of a run that can be estimated; what is left out is said, with its rows."""
    good, bad = split_at_gaps(recording)
    for part in bad:
        rows = ", ".join(f"{account.rows} of {label}" for label, account in part.intake.items())
        note(
            f"{recording.name}: {part.name} is left out, too short or without a sample of the tracker"
            f" ({rows or 'no rows'})"
        )
    if len(good) + len(bad) > 1:
        note(
            f"{recording.name}: the IMU has gaps, over which nothing is made up:"
            f" {len(good)} of {len(good) + len(bad)} parts are estimated, each for itself"
        )
    if not good:
        raise RecordingError(
            recording.path or recording.name,
            f"an IMU whose gaps leave no part of {len(bad)} that can be estimated",
            "half a second without a gap in which the tool is seen",
            "a better recording, or the model loose_rate",
        )
    return good


def describe(made: Estimate, recording: Recording, diagnosis: Diagnosis) -> dict[str, Any]:
    """Summary of one estimate, with what speaks against it and, where there is an encoder, its score."""
    summary = made.summary() | {"diagnosis": diagnosis.as_dict()}
    if "bias" in {part.name for part in manifold.parts(made.model.space)}:
        summary["bias_deg_s"] = np.rad2deg(made.bias.value[-1]).tolist()
        summary["bias_sigma_deg_s"] = np.rad2deg(made.bias.sigma[-1]).tolist()
    if recording.encoder is not None:
        summary["score"] = metrics.score(made, recording).as_dict()
        if recording.optical is not None:
            summary["hold_last_deg"] = metrics.score_hold_last(recording, made.time_ns)
    return summary


def warn(made: Estimate, diagnosis: Diagnosis) -> None:
    """Say what a table would hide: rows that fell outside the run, and whether it can be believed."""
    for name, count in made.account.items():
        if count.get("dropped_outside_run"):
            note(
                f"{made.run}: {count['dropped_outside_run']} of {count['read']} samples of {name} lie"
                " outside the run and were dropped"
            )
    for text in (*made.notes, *diagnosis.sentences(), *diagnosis.notes):
        note(f"{made.run}: {text}")


@click.command()
@click.argument("runs", nargs=-1, required=True, type=click.Path(path_type=Path))
@model_option
@robust_option
@noise_option
@sort_option
@click.option(
    "-o", "--output", type=click.Path(path_type=Path), default=Path("result"), show_default=True
)
@click.option(
    "--online",
    is_flag=True,
    help="At each sample of the IMU only with what had arrived by then, as a live system with the"
    " tracker's latency would have said; for models that an IMU drives.",
)
@click.option(
    "--smooth",
    is_flag=True,
    help="Each instant from the whole run, not only from what was measured until then.",
)
@click.option(
    "--export",
    "exports",
    multiple=True,
    type=click.Choice(tuple(FILES)),
    help="A further file in each result folder: everything as estimate.npz or estimate.h5, the path as"
    " trajectory.tum; repeatable.",
)
@click.option(
    "--at",
    "times_files",
    multiple=True,
    type=click.Path(path_type=Path),
    help="Estimate also at the times of this CSV file's column time, seconds on the recording's clock:"
    " writes requested.csv, and exports hold these times only. One for all runs, or repeated for each.",
)
@click.option(
    "--every",
    "distance",
    type=click.FloatRange(min=1e-9, max=1e9),
    metavar="SECONDS",
    help="As --at, on a regular grid from the first instant of each run on.",
)
@overwrite_option
@json_option
def estimate(
    runs: tuple[Path, ...],
    model: str,
    outlier_method: OutlierMethod | None,
    noise_files: tuple[str, ...],
    sort: bool,
    output: Path,
    online: bool,
    smooth: bool,
    exports: tuple[str, ...],
    times_files: tuple[Path, ...],
    distance: float | None,
    overwrite: bool,
    as_json: bool,
) -> None:
    """Estimate RUNS and write a result folder for each under the output."""
    if online and smooth:
        raise click.UsageError(
            "got --online and --smooth, expected one of them: what was known at a time does not know the"
            " whole run; leave one out"
        )
    requested = _requested(times_files, distance, len(runs))
    if online and requested is not None:
        raise click.UsageError(
            "got --online and times to estimate at, expected one of them: what was known is told at the"
            " samples of the IMU; leave one out, or feed a jaxekf.Stream"
        )
    chosen = get_model(model) if outlier_method is None else robust(model, outlier_method)
    params = parameters.load(chosen, *noise_files)
    recordings = load_runs(runs, sort=sort, model=chosen)
    if isinstance(requested, list):
        requested = [_inside(requested[runs.index(r.path or r.name)], r) for r in recordings]
    for recording in recordings:
        check_output(output / recording.name, "result.json", overwrite=overwrite)
    if online:
        made_of = (estimate_online(recording, chosen, params) for recording in recordings)
    else:
        made_of = iter(estimate_many(recordings, chosen, params, smooth=smooth, at=requested))
    estimates, summaries = [], []
    # One after the other as far as can be: what is finished is on the disk should the next one be stopped.
    for recording in recordings:
        with memory.for_runs([recording.name]):
            made = next(made_of)
            diagnosis = diagnose(made, recording)
            folder = made.save(
                output / recording.name,
                overwrite=overwrite,
                exports=exports,
                diagnosis=diagnosis.as_dict(curves=True),
            )
            summaries.append(describe(made, recording, diagnosis) | {"result": str(folder)})
        estimates.append(made)
        warn(made, diagnosis)
        wrote(folder)
    document = {"model": chosen.name, "online": online, "smoothed": smooth, "runs": summaries}
    if len(recordings) > 1:
        pooled = diagnose_many(estimates, recordings)
        document["diagnosis"] = pooled.as_dict()
        for text in (*pooled.sentences(), *pooled.notes):
            note(f"all {len(recordings)} runs together: {text}")
    if as_json:
        print_json(document)
        return
    known = ", as known at each time" if online else ", smoothed" if smooth else ""
    _print_estimates(f"Estimates by {chosen.name}{known}", summaries)


def _requested(
    files: tuple[Path, ...], distance: float | None, runs: int
) -> list[Requested] | Every | None:
    """The instants that were asked for by one of two options, for each run or all."""
    if files and distance is not None:
        raise click.UsageError(
            "got --at and --every, expected one of them, since each says which times; leave one out"
        )
    if len(files) not in (0, 1, runs):
        raise click.UsageError(
            f"got --at {len(files)} times for {runs} runs, expected once for all or once for each; give"
            " the files in the order of the runs"
        )
    if files:
        times: list[Requested] = [read_requested(file) for file in files]
        return times * runs if len(times) == 1 else times
    try:
        return None if distance is None else every(distance)
    except ValueError as error:
        raise click.UsageError(str(error)) from error


def _inside(asked: Requested | Every | None, recording: Recording) -> Any:
    """Of what was asked for of a run, what lies in one of its parts; None for nothing."""
    if "part" not in recording.info or not isinstance(asked, np.ndarray):
        return asked
    time = recording.need_imu().time_ns
    chosen = asked[(asked >= time[0]) & (asked <= time[-1])]
    return chosen if chosen.size else None


def _print_estimates(title: str, summaries: list[dict[str, Any]]) -> None:
    """One row a run; columns of position only where some run's can be judged."""
    columns = ["run", "seconds"]
    scores = {
        "attitude_rmse_deg": "attitude RMSE\n(deg)",
        "rate_rmse_deg_s": "rate RMSE\n(deg/s)",
        "attitude_nees": "NEES",
    }
    placed = [summary["score"]["position_rmse_mm"] for summary in summaries if "score" in summary]
    if any(value == value for value in placed):
        scores |= {
            "position_rmse_mm": "position RMSE\n(mm)",
            "position_nees": "position\nNEES",
        }
    columns += [*scores.values(), "tracker\nNIS", "tracker rows\nused"]
    print_table(title, columns, [_row(summary, tuple(scores)) for summary in summaries])


def _row(summary: dict[str, Any], scores: tuple[str, ...]) -> list[Any]:
    judged = summary.get("score", {})
    nan = float("nan")
    seeing = trackers(summary["account"])
    used, read = (sum(summary["account"][n].get(k, 0) for n in seeing) for k in ("used", "read"))
    known = [v for v in (summary["mean_nis"].get(n) for n in seeing) if v is not None]
    return [
        summary["run"],
        summary["duration_s"],
        *(judged.get(name, nan) for name in scores),
        sum(known) / len(known) if known else nan,
        f"{used} of {read}",
    ]
