"""`jaxekf tune`: noise, and calibration if asked, from recorded runs."""

from pathlib import Path
from typing import Any

import click
import numpy as np

import tuning
from jaxekf._support import memory
from jaxekf.cli.comparison import in_degrees, print_comparison, short
from jaxekf.cli.console import (
    default_option,
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
    tuning_progress,
    wrote,
)
from jaxekf.cli.estimate import load_runs
from jaxekf.cli.folds import (
    baselines_option,
    check_folds,
    folds_option,
    held_out,
    print_folds,
    static_option,
)
from jaxekf.cli.renamed import renamed_options
from jaxekf.estimation import parameters
from jaxekf.filtering.model import Parameters
from jaxekf.io.atomic import check_output
from jaxekf.models import get_model
from jaxekf.models.robust import OutlierMethod, robust
from jaxekf.recordings.types import Recording
from tuning.objective.objectives import parse
from tuning.parametrisation.free_toml import read_free
from tuning.parametrisation.free_vector import AXES
from tuning.parametrisation.truth_frame import TRUTH_UNITS
from tuning.persistence.tuning_document import data_warnings
from tuning.results.comparison import as_dicts
from tuning.search.optimisers import NAMED, from_name

_RENAMED = {
    "--judge": "--confidence-intervals",
    "--no-judge": "--no-confidence-intervals",
    "--beside": "--baselines",
}


@click.command(cls=renamed_options(_RENAMED))
@click.argument("runs", nargs=-1, required=True, type=click.Path(path_type=Path))
@click.option(
    "--validate",
    multiple=True,
    type=click.Path(path_type=Path),
    help="Validation run, which chooses the best iteration; repeatable.  [default: the training runs]",
)
@model_option
@noise_option
@robust_option
@sort_option
@click.option(
    "--objective",
    help="Objective: attitude, rate, position, truth, likelihood, map, or a weighted sum such as"
    " attitude+0.1*likelihood.  [default: attitude; map if only calibration is free]",
)
@click.option(
    "--free",
    multiple=True,
    help="Free parameters: noise, calibration, initial, truth or one leaf; repeatable.  [default: noise]",
)
@click.option(
    "--own",
    multiple=True,
    help="Parameter estimated separately for each run, such as calibration.alignment; repeatable.",
)
@click.option(
    "--parameters",
    "spec",
    type=click.Path(path_type=Path),
    help="TOML file of free parameters with priors and bounds, in [[free]] tables: name, each_run, prior,"
    " bounds.",
)
@click.option(
    "--axes",
    type=click.Choice(AXES),
    default=None,
    help="Shape of free noise: one deviation for all axes, one for each, or a full matrix.  [default: as at"
    " the start]",
)
@default_option(
    "--optimiser",
    click.Choice(tuple(NAMED)),
    "lbfgs",
    "Optimiser: lbfgs; fisher scoring, which takes few steps, for likelihood or map with up to about"
    " thirty numbers; adam on minibatches, for very many runs.",
)
@default_option(
    "--starts",
    click.IntRange(1),
    1,
    "Number of starts, the given one and samples about it; successive halving drops the worse half"
    " after 8, 16 and 32 iterations.",
)
@click.option(
    "--batch",
    type=click.IntRange(1),
    help="Runs per step of adam; an iteration is a pass over all runs.  [default: 16]",
)
@default_option(
    "--seed",
    click.IntRange(0),
    0,
    "Seed of the sampled starts, and of the order of adam's batches.",
)
@default_option("--iterations", click.IntRange(1), 60, "Largest number of iterations.")
@default_option(
    "--patience", click.IntRange(1), 15, "Largest number of iterations without improvement."
)
@default_option(
    "--burn-in", click.FloatRange(0.0), 0.0, "Time at the start of each run that does not count, s."
)
@click.option(
    "--rescale/--no-rescale",
    default=None,
    help="Scaling of Q, R and P0 after the search so that errors match them.  [default: if noise is free"
    " and the objective has errors alone]",
)
@click.option("--smooth", is_flag=True, help="Errors of the smoothed estimate.")
@default_option(
    "--confidence-intervals/--no-confidence-intervals",
    None,
    True,
    "95 % confidence intervals from the Fisher information; unobservable parameters revert to their"
    " initial values.",
)
@click.option(
    "--warm/--no-warm",
    default=None,
    help="First steps on the likelihood, since errors are flat far from their minimum.  [default: if the"
    " objective has errors alone]",
)
@click.option(
    "--state",
    type=click.Path(path_type=Path),
    help="File for the state of the tuning after each step; a stopped tuning goes on from it. Folds have"
    " files of their own next to it.",
)
@folds_option
@baselines_option
@static_option
@output_option("tuned", "Output folder.")
@overwrite_option
@quiet_option
@json_option
def tune(
    runs: tuple[Path, ...],
    validate: tuple[Path, ...],
    model: str,
    noise_files: tuple[str, ...],
    outlier_method: OutlierMethod | None,
    sort: bool,
    objective: str | None,
    free: tuple[str, ...],
    own: tuple[str, ...],
    spec: Path | None,
    optimiser: str,
    batch: int | None,
    burn_in: float,
    warm: bool | None,
    state: Path | None,
    folds: int | None,
    baselines: tuple[str, ...],
    static: Path | None,
    output: Path,
    overwrite: bool,
    as_json: bool,
    **options: Any,
) -> None:
    """Tune on RUNS and write noise.toml, calibration.toml, and tuning.json for jaxekf report.

    The start is --noise, or the model's defaults. --folds first shows the errors on held-out runs.
    """
    check_folds(folds, baselines, static)
    chosen = get_model(model) if outlier_method is None else robust(model, outlier_method)
    check_output(output, "noise.toml", overwrite=overwrite)
    start = parameters.load(chosen, *noise_files)
    training = load_runs(runs, sort=sort, model=chosen)
    validation = load_runs(validate, sort=sort, model=chosen)
    chosen_free = [*free, *(read_free(spec) if spec else ())]
    chosen_free += [tuning.Free(name, each_run=True) for name in own]
    aim = parse(objective or _default_objective(chosen_free))
    for run in training + validation if aim.needs_truth else ():
        if run.encoder is None:
            note(f"run '{run.name}' has no encoder and does not count in the error")
    # The others of `tuning.tune` have the names of their options: axes, starts, seed, iterations, ...
    options |= {
        "validate": validation,
        "model": chosen,
        "objective": aim,
        "free": chosen_free or None,
        "start": start,
        "optimiser": from_name(optimiser, batch),
        "burn_in_s": burn_in,
        # A method that was asked for holds, whatever it rejects.
        "gates_off": None if outlier_method is None else False,
        "warm": aim.errors_alone and optimiser != "adam" if warm is None else warm,
    }
    unseen = None
    if folds is not None:
        compared = {"baselines": baselines, "static": static, "checkpoint": state}
        unseen = held_out(training, folds, **compared, **options)
        if not as_json:
            print_folds(unseen)
    with (
        memory.for_runs([run.name for run in training]),
        tuning_progress(options["iterations"]) as progress,
    ):
        tuned = tuning.tune(training, checkpoint=state, progress=progress, **options)
    tuning.save(tuned, output, folds=unseen)
    if state is not None and folds is not None and "interrupted" not in tuned.stopped:
        tuning.forget_folds(state)
    _note(tuned, output)
    scored = [run for run in validation or training if run.encoder is not None]
    theirs = tuning.fit_runs(scored, tuned, burn_in_s=burn_in) if validation else {}
    rows = _compare(tuned, scored, start, theirs, options["smooth"]) if scored else []
    tuning.save_record(output, tuned, rows=rows, folds=unseen)
    if as_json:
        document = parameters.to_document(chosen, tuned.params, tuned.origin)
        document |= {"rows": as_dicts(rows), "rejected_steps": tuned.rejections}
        document |= {} if unseen is None else {"folds": unseen.as_dict()}
        print_json(document | _known(tuned))
        return
    _print(tuned, rows, "validation runs" if validation else "the training runs")


def _default_objective(free: list[str | tuning.Free]) -> str:
    """The objective unless one is given: innovations determine calibration better than attitude errors."""
    names = [one.name if isinstance(one, tuning.Free) else one for one in free]
    return "map" if names and all(n.startswith("calibration") for n in names) else "attitude"


def _print(tuned: tuning.Tuned, rows: list[tuning.Row], runs: str) -> None:
    """The tables of a tuning."""
    _print_noise(tuned)
    _print_starts(tuned)
    _print_known(tuned)
    if rows:
        print_comparison(f"On {runs}", rows)


def _note(tuned: tuning.Tuned, output: Path) -> None:
    """Print the output folder, the end of the search, and unobservable parameters."""
    wrote(output / "noise.toml")
    for sentence in data_warnings(tuned):
        note(sentence)
    note(f"{tuned.stopped}, best at iteration {tuned.best.number}")
    if tuned.rejections:
        note(f"{tuned.rejections} steps were not finite and were rejected")
    for label, more in tuned.open.items():
        note(f"{label} is unobservable and keeps its initial value: {more} would determine it")


def _compare(
    tuned: tuning.Tuned,
    runs: list[Recording],
    start: Parameters,
    found: dict[str, Parameters],
    smooth: bool,
) -> list[tuning.Row]:
    """Scores of start and tuned parameters; `found` are those of held-out runs, by name."""
    own = [found.get(run.name, tuned.of_run(run)) for run in runs]
    variants = {"start": start, "tuned": own}
    return tuning.compare(tuned.model, runs, variants, smooth=smooth).rows


def _known(tuned: tuning.Tuned) -> dict[str, Any]:
    """Intervals, unobservable numbers, starts, runs' own parameters, and the truth's frame, for JSON."""
    each = {name: parameters.to_document(tuned.model, p, {}) for name, p in tuned.each.items()}
    truth = None
    if tuned.truth is not None:
        truth = {name: np.asarray(v).tolist() for name, v in tuned.truth._asdict().items()}
    return {
        "intervals": {label: list(ends) for label, ends in tuned.intervals.items()},
        "left_open": tuned.open,
        "starts": [one._asdict() for one in tuned.starts],
        "truth": truth,
        "own": {name: {k: one[k] for k in ("noise", "calibration")} for name, one in each.items()},
    }


def _print_starts(tuned: tuning.Tuned) -> None:
    """Print the result of each start, if there were several."""
    if not tuned.starts:
        return
    rows = [
        [str(i), f"{one.value:.6g}", str(one.iterations), one.ending]
        for i, one in enumerate(tuned.starts)
    ]
    print_table("Starts (0 is the given one)", ["start", "reached", "iterations", "ending"], rows)


def _print_known(tuned: tuning.Tuned) -> None:
    """Print value, interval and change of each observable number."""
    if not tuned.intervals:
        return
    first = dict(zip(tuned.layout.labels(), tuned.moved, strict=True))
    rows = []
    for label, ends in tuned.intervals.items():
        rows.append([label, *(f"{end:.5g}" for end in ends), first[label]])
    print_table(
        "Confidence intervals (SI)",
        ["number", "tuned", "95 %: from", "to", "moved by"],
        rows,
    )


def _print_noise(tuned: tuning.Tuned) -> None:
    units = parameters.leaves_by_name(tuned.model.units)
    before = parameters.leaves_by_name(tuned.start._replace(truth=()))
    rows = []
    for name, new in parameters.leaves_by_name(tuned.params).items():
        old = before[name]
        if np.array_equal(old, new):
            continue
        turn, shown = in_degrees(units[name])
        rows.append([name, short(turn(old)), short(turn(new)), shown])
    if tuned.truth is not None:
        for name, found in tuned.truth._asdict().items():
            turn, shown = in_degrees(getattr(TRUTH_UNITS, name))
            rows.append([f"truth.{name}", short(turn(0.0 * found)), short(turn(found)), shown])
    print_table("Tuned parameters", ["parameter", "start", "tuned", "unit"], rows)
