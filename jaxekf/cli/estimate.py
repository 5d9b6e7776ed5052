"""`jaxekf estimate`: attitude, rate, biases and pose of recorded runs."""

from collections.abc import Mapping, Sequence
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
    output_option,
    overwrite_option,
    print_json,
    print_table,
    quiet_option,
    robust_option,
    sort_option,
    stage,
    wrote,
)
from jaxekf.estimation import parameters
from jaxekf.estimation.batch import estimate_many
from jaxekf.estimation.causal import estimate_online
from jaxekf.estimation.clock import ClockName
from jaxekf.estimation.output_times import Every, OutputTimes, every, read_output_times
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
    """Read runs and print notes on masked and dropped rows.

    Parameters
    ----------
    paths
        Run folders or files. Their names must differ, since results have the names of the runs.
    sort
        Sort rows by time instead of raising for rows that are out of order.
    model
        The model that the runs are for. If an IMU is its input, a run is cut at the gaps of the IMU.

    Raises
    ------
    RecordingError
        A run cannot be read, or two runs have the same name.
    """
    recordings = []
    for path in paths:
        with memory.for_runs([path.name]):
            recordings.append(run_folder.load(path, sort=sort))
    require_different_names(paths, recordings)
    for recording in recordings:
        for label, account in recording.intake.items():
            for text in account.sentences(label):
                note(f"{recording.name}: {text}")
    if model is None or model.input is None:
        return recordings
    return [part for recording in recordings for part in _parts(recording)]


def require_different_names(paths: Sequence[Path], recordings: Sequence[Recording]) -> None:
    """Raise `RecordingError` if two runs have the same name."""
    names = [recording.name for recording in recordings]
    for path, name in zip(paths, names, strict=True):
        if names.count(name) > 1:
            raise RecordingError(
                path, f"the name '{name}' twice", "runs with different names", "renaming one"
            )


def _parts(recording: Recording) -> list[Recording]:
    """The parts of a run between gaps of the IMU; notes name the parts that cannot be estimated."""
    good, bad = split_at_gaps(recording)
    for part in bad:
        rows = ", ".join(f"{account.rows} of {label}" for label, account in part.intake.items())
        note(
            f"{recording.name}: {part.name} is left out: too short, or without a sample of the tracker"
            f" ({rows or 'no rows'})"
        )
    if len(good) + len(bad) > 1:
        note(
            f"{recording.name}: the IMU has gaps, over which it is not extrapolated:"
            f" {len(good)} of {len(good) + len(bad)} parts are estimated separately"
        )
    if not good:
        raise RecordingError(
            recording.path or recording.name,
            f"an IMU whose gaps leave no part of {len(bad)} that can be estimated",
            "half a second without a gap in which the tool is seen",
            "a better recording, or the model loose_rate",
        )
    return good


def describe(
    made: Estimate, recording: Recording, diagnosis: Diagnosis, score: Mapping[str, Any] | None
) -> dict[str, Any]:
    """Summary of one estimate with its diagnosis and, with an encoder, its score."""
    summary = made.summary() | {"diagnosis": diagnosis.as_dict()}
    if "bias" in {part.name for part in manifold.parts(made.model.space)}:
        summary["bias_deg_s"] = np.rad2deg(made.bias.value[-1]).tolist()
        summary["bias_sigma_deg_s"] = np.rad2deg(made.bias.sigma[-1]).tolist()
    if score is not None:
        summary["score"] = score
        if recording.optical is not None:
            summary["hold_last_deg"] = metrics.score_hold_last(recording, made.time_ns)
    return summary


def warn(made: Estimate, diagnosis: Diagnosis) -> None:
    """Print notes on dropped rows, on the start and on the consistency of an estimate."""
    for name, count in made.account.items():
        if count.get("dropped_outside_run"):
            note(
                f"{made.run}: {count['dropped_outside_run']} of {count['read']} samples of {name} are"
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
@output_option("result", "Folder for the result folders, one for each run.")
@click.option(
    "--online",
    is_flag=True,
    help="Causal estimates at each IMU sample, from measurements that had arrived after the tracker's"
    " latency, as in a live system; for models with an input.",
)
@click.option("--smooth", is_flag=True, help="Smoothed estimates: each instant from the whole run.")
@click.option(
    "--export",
    "exports",
    multiple=True,
    type=click.Choice(tuple(FILES)),
    help="Additional file in each result folder: the complete estimate as estimate.npz or estimate.h5, the"
    " trajectory as trajectory.tum; repeatable.",
)
@click.option(
    "--at",
    "times_files",
    multiple=True,
    type=click.Path(path_type=Path),
    help="CSV file with additional output times in the column time, s on the clock of the results. The"
    " estimates at these times are in requested.csv and in the exports. One file for all runs, or repeated"
    " for each.",
)
@click.option(
    "--every",
    "period",
    type=click.FloatRange(min=1e-9, max=1e9),
    metavar="SECONDS",
    help="Period of additional output times, s, from the first instant of each run on; see --at.",
)
@click.option(
    "--clock",
    type=click.Choice(("imu", "tracker")),
    default="imu",
    show_default=True,
    help="Clock of all times of the results and of --at: that of the IMU, by the clock offset (or latency)"
    " and drift of the parameters, or that of the tracker's samples, without them.",
)
@overwrite_option
@quiet_option
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
    period: float | None,
    clock: ClockName,
    overwrite: bool,
    as_json: bool,
) -> None:
    """Estimate attitude, rate, biases and pose of RUNS, and write a result folder for each."""
    if online and smooth:
        raise click.UsageError(
            "got --online and --smooth, expected one of them: a causal estimate does not use the whole run;"
            " leave one out"
        )
    requested = _requested(times_files, period, len(runs))
    if online and requested is not None:
        raise click.UsageError(
            "got --online and times to estimate at, expected one of them: causal estimates are at the"
            " samples of the IMU; leave one out, or use a jaxekf.Stream"
        )
    chosen = get_model(model) if outlier_method is None else robust(model, outlier_method)
    params = parameters.load(chosen, *noise_files)
    recordings = load_runs(runs, sort=sort, model=chosen)
    if isinstance(requested, list):
        requested = [_within_part(requested[runs.index(r.path or r.name)], r) for r in recordings]
    for recording in recordings:
        check_output(output / recording.name, "result.json", overwrite=overwrite)
    stage(f"estimating {len(recordings)} run{'s' * (len(recordings) > 1)} by {chosen.name}")
    if online:
        pending = (
            estimate_online(recording, chosen, params, clock=clock) for recording in recordings
        )
    else:
        pending = iter(
            estimate_many(recordings, chosen, params, smooth=smooth, at=requested, clock=clock)
        )
    estimates, summaries = [], []
    # Each result is written before the next estimate, so that it is kept if the command is interrupted.
    for recording in recordings:
        with memory.for_runs([recording.name]):
            made = next(pending)
            diagnosis = diagnose(made, recording)
            truth = recording.encoder is not None
            found = metrics.score(made, recording) if truth else None
            score = None if found is None else found.as_dict()
            folder = made.save(
                output / recording.name,
                overwrite=overwrite,
                exports=exports,
                diagnosis=diagnosis.as_dict(curves=True),
                score=score,
            )
            summaries.append(describe(made, recording, diagnosis, score) | {"result": str(folder)})
        estimates.append(made)
        warn(made, diagnosis)
        for text in () if found is None else found.sentences():
            note(f"{made.run}: {text}")
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
    kind = ", causal" if online else ", smoothed" if smooth else ""
    _print_estimates(f"Estimates by {chosen.name}{kind}", summaries)


def _requested(
    files: tuple[Path, ...], period: float | None, runs: int
) -> list[OutputTimes] | Every | None:
    """The output times of --at or --every: for each run, or one grid for all."""
    if files and period is not None:
        raise click.UsageError(
            "got --at and --every, expected one of them, since each gives the times; leave one out"
        )
    if len(files) not in (0, 1, runs):
        raise click.UsageError(
            f"got --at {len(files)} times for {runs} runs, expected once for all or once for each; give"
            " the files in the order of the runs"
        )
    if files:
        times: list[OutputTimes] = [read_output_times(file) for file in files]
        return times * runs if len(times) == 1 else times
    try:
        return None if period is None else every(period)
    except ValueError as error:
        raise click.UsageError(str(error)) from error


def _within_part(requested: OutputTimes | Every | None, recording: Recording) -> Any:
    """The output times of a run that are within one of its parts; None if there are none."""
    if "part" not in recording.info or not isinstance(requested, np.ndarray):
        return requested
    time = recording.need_imu().time_ns
    chosen = requested[(requested >= time[0]) & (requested <= time[-1])]
    return chosen if chosen.size else None


def _print_estimates(title: str, summaries: list[dict[str, Any]]) -> None:
    """One row for each run; columns of position only if the true position of some run is known."""
    columns = ["run", "seconds"]
    scores = {
        "attitude_rmse_deg": "attitude RMSE\n(deg)",
        "rate_rmse_deg_s": "rate RMSE\n(deg/s)",
        "attitude_nees": "NEES",
    }
    position_rmse = [
        summary["score"]["position_rmse_mm"] for summary in summaries if "score" in summary
    ]
    if any(value == value for value in position_rmse):
        scores |= {
            "position_rmse_mm": "position RMSE\n(mm)",
            "position_nees": "position\nNEES",
        }
    columns += [*scores.values(), "tracker\nNIS", "tracker rows\nused"]
    print_table(title, columns, [_row(summary, tuple(scores)) for summary in summaries])


def _row(summary: dict[str, Any], scores: tuple[str, ...]) -> list[Any]:
    score = summary.get("score", {})
    nan = float("nan")
    names = trackers(summary["account"])
    used, read = (sum(summary["account"][n].get(k, 0) for n in names) for k in ("used", "read"))
    nis = [v for v in (summary["mean_nis"].get(n) for n in names) if v is not None]
    return [
        summary["run"],
        summary["duration_s"],
        *(score.get(name, nan) for name in scores),
        sum(nis) / len(nis) if nis else nan,
        f"{used} of {read}",
    ]
