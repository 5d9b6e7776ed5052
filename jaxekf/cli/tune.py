"""`jaxekf tune`: noise, and calibration where asked, from recorded runs."""

from pathlib import Path
from typing import Any, Literal

import click
import jax
import numpy as np

import tuning
from jaxekf._support import memory
from jaxekf.cli.comparison import in_degrees, print_comparison, short, units_by_name
from jaxekf.cli.console import (
    json_option,
    model_option,
    noise_option,
    note,
    overwrite_option,
    print_json,
    print_table,
    sort_option,
    tuning_progress,
    wrote,
)
from jaxekf.cli.estimate import load_runs
from jaxekf.cli.folds import (
    beside_option,
    check_folds,
    folds_option,
    held_out,
    print_folds,
    static_option,
)
from jaxekf.estimation import parameters
from jaxekf.filtering.model import Parameters
from jaxekf.io.atomic import check_output
from jaxekf.models import get_model
from jaxekf.recordings.types import Recording
from tuning.comparison.compare import as_dicts
from tuning.objective.objectives import parse
from tuning.parametrisation.free_toml import read_free
from tuning.parametrisation.free_vector import AXES
from tuning.parametrisation.truth_frame import TRUTH_UNITS
from tuning.search.optimisers import OPTIMISERS


@click.command()
@click.argument("runs", nargs=-1, required=True, type=click.Path(path_type=Path))
@click.option(
    "--validate",
    multiple=True,
    type=click.Path(path_type=Path),
    help="A run the tuner does not learn from but is judged by; repeatable.",
)
@model_option
@noise_option
@sort_option
@click.option(
    "--objective",
    default="attitude",
    show_default=True,
    help="attitude, rate, likelihood, or a weighted sum such as attitude+0.1*likelihood.",
)
@click.option(
    "--free",
    multiple=True,
    help="What may change: noise, calibration, initial or one leaf; repeatable.  [default: noise]",
)
@click.option(
    "--own",
    multiple=True,
    help="What may change and each run has its own of, such as calibration.alignment; repeatable.",
)
@click.option(
    "--parameters",
    "spec",
    type=click.Path(path_type=Path),
    help="What may change, with priors and bounds, as [[free]] tables in a TOML file: name, each_run,"
    " prior, bounds.",
)
@click.option(
    "--axes",
    type=click.Choice(AXES),
    default=None,
    help="One deviation for all axes, one for each, or a full matrix.  [default: as the start has it]",
)
@click.option(
    "--optimiser",
    type=click.Choice(OPTIMISERS),
    default="lbfgs",
    show_default=True,
    help="fisher scoring takes few steps to the end; for likelihood or map, and up to some thirty numbers."
    " adam takes some runs at a time, for very many.",
)
@click.option(
    "--starts",
    type=click.IntRange(1),
    default=1,
    show_default=True,
    help="Search from so many starts side by side, the given one and others drawn about it; the worse half"
    " is dropped after 8, 16 and 32 iterations.",
)
@click.option(
    "--batch",
    type=click.IntRange(1),
    help="Runs of a step of adam; an iteration is a pass over all of them.  [default: 16]",
)
@click.option(
    "--seed",
    type=click.IntRange(0),
    default=0,
    show_default=True,
    help="Of the starts that are drawn, and of the order of adam's batches.",
)
@click.option("--iterations", type=click.IntRange(1), default=60, show_default=True)
@click.option(
    "--patience",
    type=click.IntRange(1),
    default=15,
    show_default=True,
    help="Iterations without improvement before stopping.",
)
@click.option(
    "--burn-in",
    type=click.FloatRange(0.0),
    default=0.0,
    show_default=True,
    help="Seconds at the start of each run that do not count.",
)
@click.option(
    "--rescale/--no-rescale",
    default=None,
    help="Scale Q, R and P0 so that errors match them.  [default: unless the likelihood counts]",
)
@click.option("--smooth", is_flag=True, help="Errors are those of the smoothed estimate.")
@click.option(
    "--judge/--no-judge",
    default=True,
    show_default=True,
    help="Tell what the data determine, with 95 % intervals; what they leave open stays at its start.",
)
@click.option(
    "--warm/--no-warm",
    default=None,
    help="Begin with some steps on the likelihood, for errors are flat far from their minimum.  [default:"
    " where the objective is of errors alone]",
)
@click.option(
    "--state",
    type=click.Path(path_type=Path),
    help="Keep the state of the tuning in this file after each step; if it is there, go on from it. Folds"
    " have files of their own beside it.",
)
@folds_option
@beside_option
@static_option
@click.option(
    "-o", "--output", type=click.Path(path_type=Path), default=Path("tuned"), show_default=True
)
@overwrite_option
@json_option
def tune(
    runs: tuple[Path, ...],
    validate: tuple[Path, ...],
    model: str,
    noise_files: tuple[str, ...],
    sort: bool,
    objective: str,
    free: tuple[str, ...],
    own: tuple[str, ...],
    spec: Path | None,
    axes: str | None,
    optimiser: Literal["lbfgs", "fisher", "adam"],
    starts: int,
    batch: int | None,
    seed: int,
    iterations: int,
    patience: int,
    burn_in: float,
    rescale: bool | None,
    smooth: bool,
    judge: bool,
    warm: bool | None,
    state: Path | None,
    folds: int | None,
    beside: tuple[str, ...],
    static: Path | None,
    output: Path,
    overwrite: bool,
    as_json: bool,
) -> None:
    """Tune on RUNS and write noise.toml, calibration.toml, and tuning.json for jaxekf report.

    --noise gives the start; the model's defaults otherwise. --folds first shows how well such a tuning does
    on runs that it has not seen.
    """
    check_folds(folds, beside, static)
    chosen = get_model(model)
    check_output(output, "noise.toml", overwrite=overwrite)
    start = parameters.load(chosen, *noise_files)
    aim = parse(objective)
    training = load_runs(runs, sort=sort, model=chosen)
    judging = load_runs(validate, sort=sort, model=chosen)
    asked = [*free, *(read_free(spec) if spec else ())]
    asked += [tuning.Free(name, each_run=True) for name in own]
    for run in training + judging if aim.needs_truth else ():
        if run.encoder is None:
            note(f"run '{run.name}' has no encoder and does not count in the error")
    options: dict[str, Any] = {
        "validate": judging,
        "model": chosen,
        "objective": aim,
        "free": asked or None,
        "start": start,
        "axes": axes,
        "optimiser": optimiser,
        "starts": starts,
        "batch": batch,
        "seed": seed,
        "iterations": iterations,
        "patience": patience,
        "burn_in_s": burn_in,
        "rescale": rescale,
        "smooth": smooth,
        "judge": judge,
        "warm": aim.errors_alone and optimiser != "adam" if warm is None else warm,
    }
    unseen = None
    if folds is not None:
        asked_beside = {"beside": beside, "static": static, "checkpoint": state}
        unseen = held_out(training, folds, **asked_beside, **options)
        if not as_json:
            print_folds(unseen)
    with memory.for_runs([run.name for run in training]), tuning_progress(iterations) as progress:
        tuned = tuning.tune(training, checkpoint=state, progress=progress, **options)
    tuned.save(output, folds=unseen)
    if state is not None and folds is not None and "interrupted" not in tuned.stopped:
        tuning.forget_folds(state)
    _note(tuned, output)
    scored = [run for run in judging or training if run.encoder is not None]
    theirs = tuning.fit_runs(scored, tuned, burn_in_s=burn_in) if judging else {}
    rows = _compare(tuned, scored, start, theirs, smooth) if scored else []
    tuning.save_record(output, tuned, rows=rows, folds=unseen)
    if as_json:
        document = parameters.to_document(chosen, tuned.params, tuned.origin)
        document |= {"rows": as_dicts(rows), "rejected_steps": tuned.rejections}
        document |= {} if unseen is None else {"folds": unseen.as_dict()}
        print_json(document | _known(tuned))
        return
    _print(tuned, rows, "validation runs" if judging else "the training runs")


def _print(tuned: tuning.Tuned, rows: list[tuning.Row], judged: str) -> None:
    """The tables of a tuning."""
    _print_noise(tuned)
    _print_starts(tuned)
    _print_known(tuned)
    if rows:
        print_comparison(f"On {judged}", rows)


def _note(tuned: tuning.Tuned, output: Path) -> None:
    """Where it is, how it ended, and what to know of it."""
    wrote(output / "noise.toml")
    note(f"{tuned.stopped}, best at iteration {tuned.best.number}")
    if tuned.rejections:
        note(f"{tuned.rejections} steps were not finite and were rejected")
    for label, more in tuned.open.items():
        note(f"the data leave {label} open, so that it stays at its start: {more} would tell it")


def _compare(
    tuned: tuning.Tuned,
    runs: list[Recording],
    start: Parameters,
    found: dict[str, Parameters],
    smooth: bool,
) -> list[tuning.Row]:
    """Start and tuned parameters beside each other; `found` are those of held-out runs, by name."""
    own = [found.get(run.name, tuned.of_run(run)) for run in runs]
    variants = {"start": start, "tuned": own}
    return tuning.compare(tuned.model, runs, variants, smooth=smooth).rows


def _known(tuned: tuning.Tuned) -> dict[str, Any]:
    """For JSON: intervals, what was left open, starts, what each run has of its own, the truth's frame."""
    each = {name: parameters.to_document(tuned.model, p, {}) for name, p in tuned.each.items()}
    truth = None
    if tuned.truth is not None:
        truth = {name: np.asarray(v).tolist() for name, v in tuned.truth._asdict().items()}
    return {
        "intervals": {label: list(ends) for label, ends in tuned.intervals.items()},
        "left_open": tuned.open,
        "starts": [one._asdict() for one in tuned.starts],
        "truth": truth,
        "own": {
            name: {k: told[k] for k in ("noise", "calibration")} for name, told in each.items()
        },
    }


def _print_starts(tuned: tuning.Tuned) -> None:
    """What became of each start, where there were several."""
    if not tuned.starts:
        return
    rows = [
        [str(i), f"{one.value:.6g}", str(one.iterations), one.ending]
        for i, one in enumerate(tuned.starts)
    ]
    print_table("Starts (0 is the given one)", ["start", "reached", "iterations", "ending"], rows)


def _print_known(tuned: tuning.Tuned) -> None:
    """Value and interval of each number that the data determine, and how far it moved."""
    if not tuned.intervals:
        return
    first = dict(zip(tuned.layout.labels(), tuned.moved, strict=True))
    rows = []
    for label, ends in tuned.intervals.items():
        rows.append([label, *(f"{end:.5g}" for end in ends), first[label]])
    print_table(
        "What is known (SI, before the common scale)",
        ["number", "tuned", "95 %: from", "to", "moved by"],
        rows,
    )


def _print_noise(tuned: tuning.Tuned) -> None:
    units = units_by_name(tuned.model)
    names = parameters.leaf_names(tuned.params)
    before = jax.tree.leaves(tuned.start._replace(truth=()))
    after = jax.tree.leaves(tuned.params)
    rows = []
    for name, old, new in zip(names, before, after, strict=True):
        if np.array_equal(old, new):
            continue
        turn, shown = in_degrees(units[name])
        rows.append([name, short(turn(old)), short(turn(new)), shown])
    if tuned.truth is not None:
        for name, found in tuned.truth._asdict().items():
            turn, shown = in_degrees(getattr(TRUTH_UNITS, name))
            rows.append([f"truth.{name}", short(turn(0.0 * found)), short(turn(found)), shown])
    print_table("Tuned parameters", ["parameter", "start", "tuned", "unit"], rows)
