"""Tuning judged on runs that it has not learnt from: each run is held out once, and its fold's tuning
knows nothing of it."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple

import jax
import numpy as np

from jaxekf._support.errors import TuningError
from jaxekf.estimation.batch import Run, read
from jaxekf.estimation.parameters import leaf_names
from jaxekf.filtering.model import Model, Parameters
from jaxekf.models import adapted, get_model
from jaxekf.recordings.types import Floats, Recording
from tuning._tune import Tuned, fit_runs, tune
from tuning.comparison.baselines import by_allan, by_search, in_one_shape, ordered, work_of
from tuning.comparison.compare import Row, as_dicts, compare
from tuning.comparison.cost import Work, gradient_cost, mean
from tuning.objective.data import prepare_groups
from tuning.persistence import checkpoint as resume
from tuning.persistence.fold_checkpoint import Kept, fold_file, pack_tuned, unpack_tuned
from tuning.results import Fit, Fitted
from tuning.search.derivative_free import Asked, Problem

COLUMNS = tuple(name for name in Row._fields if name not in ("run", "variant"))
_BEST_AT_ONE = ("nis", "nees", "position_nees")


class Fold(NamedTuple):
    """One tuning, and the runs it has not seen."""

    held_out: tuple[str, ...]
    """Names."""
    tuned: Tuned
    beside: Mapping[str, Fitted] = MappingProxyType({})
    """What it was tried with too, by variant."""

    @property
    def work(self) -> dict[str, Work]:
        """What each variant took, by its name."""
        found = {name: work_of(fitted) for name, fitted in self.beside.items()}
        tuned = Work(float(self.tuned.filterings), float(self.tuned.evaluations))
        return {"start": Work(0.0, 0.0), **found, "tuned": tuned}


class Spread(NamedTuple):
    """A column of a table over the runs that have a number there; NaN where there are too few."""

    mean: float
    deviation: float
    """Standard deviation of a run, by n - 1."""
    worst: float
    """The largest error; of NIS and NEES what is farthest from 1 as a factor."""


class ParameterSpread(NamedTuple):
    """What the folds found for one parameter, in its unit."""

    start: Floats
    """Of the parameter's shape."""
    mean: Floats
    deviation: Floats
    """Standard deviation of a fold, by n - 1. Two folds share most of their runs, so that it is less than
    how far tunings on other runs would lie apart."""
    each: Floats
    """(folds, ...)"""


@dataclass(frozen=True)
class CrossValidation:
    """What came out of `cross_validate`."""

    rows: list[Row]
    """Of each run that was held out, in the order given: `hold last`, `start`, and by its fold what was set
    beside, and `tuned`."""
    folds: tuple[Fold, ...]
    gradient_cost: float = float("nan")
    """How many times as long the objective takes with its gradient, by the clock; NaN where nothing was set
    beside."""

    @property
    def work(self) -> dict[str, Work]:
        """What each variant took, the mean over the folds, by its name."""
        each = [fold.work for fold in self.folds]
        return {name: mean([work[name] for work in each]) for name in each[0]} if each else {}

    @property
    def forward(self) -> dict[str, float]:
        """The same in filterings of all training runs without a gradient; empty where no time was taken."""
        if np.isnan(self.gradient_cost):
            return {}
        return {name: work.forward(self.gradient_cost) for name, work in self.work.items()}

    def spread(self, column: str = "attitude_rmse_deg") -> dict[str, Spread]:
        """One of `COLUMNS` over the runs, by variant."""
        grouped: dict[str, list[float]] = {}
        for row in self.rows:
            value = float(getattr(row, column))
            grouped.setdefault(row.variant, []).extend([] if value != value else [value])
        return {name: _spread(values, column) for name, values in grouped.items()}

    @property
    def parameters(self) -> dict[str, ParameterSpread]:
        """The free parameters over the folds, by name; of what each run has of its own the fold's mean."""
        first, found = self.folds[0].tuned, {}
        values = [_by_name(fold.tuned.params) for fold in self.folds]
        start = _by_name(first.start._replace(truth=()))
        for name in (leaf.name for leaf in first.layout.leaves):
            if name in start:
                each = np.stack([value[name] for value in values])
                found[name] = ParameterSpread(
                    start[name], each.mean(axis=0), each.std(axis=0, ddof=1), each
                )
        return found

    def as_dict(self) -> dict[str, Any]:
        """All of it for JSON: rows, spread over the runs, the parameters of each fold in SI units, and what
        it took, in which the cost of a gradient is by the clock and differs from time to time."""
        by_column = {column: self.spread(column) for column in COLUMNS}
        return {
            "rows": as_dicts(self.rows),
            "spread": {
                variant: {column: spread[variant]._asdict() for column, spread in by_column.items()}
                for variant in dict.fromkeys(row.variant for row in self.rows)
            },
            "held_out": [list(fold.held_out) for fold in self.folds],
            "parameters": {
                name: {key: np.asarray(value).tolist() for key, value in told._asdict().items()}
                for name, told in self.parameters.items()
            },
            "work": {
                "gradient_cost": None if np.isnan(self.gradient_cost) else self.gradient_cost,
                "mean": {
                    name: {**work._asdict(), "forward": self.forward.get(name)}
                    for name, work in self.work.items()
                },
            },
        }


class Limits(NamedTuple):
    """How far the searches without gradients go, as the literature has it."""

    sweeps: int = 20
    """Of coordinate search."""
    evaluations: int | None = None
    """Of Nelder-Mead; None for as many as coordinate search makes at most, two each sweep and number."""


def cross_validate(
    runs: Sequence[Run],
    folds: int | None = None,
    *,
    model: str | Model = "loose",
    validate: Sequence[Run] = (),
    start: Parameters | None = None,
    burn_in_s: float = 0.0,
    smooth: bool = False,
    beside: Sequence[str] = (),
    limits: Limits = Limits(),  # noqa: B008
    static: Run | None = None,
    checkpoint: Path | str | None = None,
    stage: Callable[[str], None] | None = None,
    **options: Any,
) -> CrossValidation:
    """Tune once for each fold, on all runs but the fold's, and judge it on those.

    There are `folds` of them, each of every `folds`-th run, or with None one for each run (leave one out).
    Runs without an encoder cannot be judged and are learnt from each time. What each run has of its own
    (see `Free.each_run`) is found for a held-out run by `fit_runs`, from its innovations and never from
    its truth. Validation runs judge every fold's iterations and are never held out. With `smooth` the
    smoothed estimates are compared. The other arguments are those of `tune`, and so are the errors
    raised. Ctrl-C ends the whole.

    `beside` names what each fold is tried with too, on its training runs alone: ``allan``, the start with
    the noise that their static heads or a `static` log tell; ``coordinates`` and ``nelder-mead``, searches
    without gradients of the same objective and free parameters, as far as `limits` says. They are judged
    alike, and what each takes is counted (`CrossValidation.work`). Validation runs play no part in them.

    With a `checkpoint` (a file that need not be there) what is finished of each fold is kept in
    ``NAME.fold1`` and so on, and a cross-validation that was stopped goes on from there when it is called
    again with the same arguments. They stay until `forget_folds`. `stage` is told what begins, such as
    ``fold 2/5, coordinates``.

    Raises `TuningError` also for less than two folds, more than there are runs to be held out, two runs of
    one name, another cross-validation's files, and ``allan`` where no run rests.
    """
    recordings, judging = read(runs), read(validate)
    chosen = adapted(get_model(model), [*recordings, *judging])
    parts, others = _parts(recordings, judging, folds), ordered(beside)
    before = chosen.parameters if start is None else start
    options |= {"start": start, "burn_in_s": burn_in_s, "smooth": smooth}
    task = _Task(chosen, judging, options, checkpoint, limits, static)
    done: list[Fold] = []
    of_run: dict[str, dict[str, Parameters]] = {name: {} for name in (*others, "tuned")}
    cost = float("nan")
    for number, names in enumerate(parts, 1):
        seen = [run for run in recordings if run.name not in names]
        hidden = [run for run in recordings if run.name in names]
        tell = partial(_tell, stage, f"fold {number}/{len(parts)}")
        fold, problem = task.fold(number, seen, others, tell)
        for name, fitted in {**fold.beside, "tuned": fold.tuned}.items():
            # The fold's own model may lack a marker that only its held-out runs have.
            fit = Fit(chosen, fitted.params, fitted.layout)
            of_run[name] |= fit_runs(hidden, fit, burn_in_s=burn_in_s)
        done.append(fold._replace(held_out=tuple(names)))
        if others and number == len(parts):
            cost = gradient_cost(problem.search)
    judged = [run for run in recordings if run.name in of_run["tuned"]]
    variants: dict[str, Any] = {"start": before}
    for name, found in of_run.items():
        variants[name] = in_one_shape([found[run.name] for run in judged])
    rows = compare(chosen, judged, variants, smooth=smooth).rows
    return CrossValidation(rows, tuple(done), cost)


def _tell(stage: Callable[[str], None] | None, fold: str, what: str = "") -> None:
    if stage is not None:
        stage(f"{fold}, {what}" if what else fold)


@dataclass(frozen=True)
class _Task:
    """What all folds share."""

    model: Model
    judging: list[Recording]
    options: dict[str, Any]
    checkpoint: Path | str | None
    limits: Limits
    static: Run | None

    def fold(
        self, number: int, seen: list[Recording], beside: list[str], tell: Callable[..., None]
    ) -> tuple[Fold, Problem]:
        """Everything that learns from the runs that one fold sees; what is kept of it is not done again."""
        asked = {k: v for k, v in self.options.items() if k in Asked.__annotations__}
        problem = Problem(seen, model=self.model, **asked)
        path = fold_file(self.checkpoint, number)
        kept = Kept(path, "" if path is None else self._mark(problem, seen))
        found: dict[str, Fitted] = {}
        for name in beside:
            tell(name)
            if name == "allan":
                start = self.options["start"]
                start = self.model.parameters if start is None else start
                log = None if self.static is None else read([self.static])[0]
                found[name] = by_allan(problem.model, start, problem.layout, seen, log)
            else:
                found[name] = by_search(name, problem, kept, *self.limits)
        tell()
        tuned: list[Tuned] = []

        def search() -> dict[str, Any]:
            given = {"model": self.model, "validate": self.judging, "checkpoint": kept.running}
            tuned.append(tune(seen, **given, **self.options))
            if "interrupted" in tuned[0].stopped:
                raise KeyboardInterrupt
            return pack_tuned(tuned[0])

        arrays = kept.once("tuned", search)
        if not tuned:
            model = adapted(self.model, [*seen, *self.judging])
            tuned.append(unpack_tuned(arrays, model, problem, [run.name for run in seen]))
        return Fold((), tuned[0], found), problem

    def _mark(self, problem: Problem, seen: list[Recording]) -> str:
        """A digest of all that a fold's results depend on."""
        plain = {
            k: v for k, v in self.options.items() if k not in ("progress", "start", "optimiser")
        }
        optimiser = self.options.get("optimiser")
        asked = (
            [run.name for run in seen],
            [run.name for run in self.judging],
            sorted(plain.items()),
            optimiser if isinstance(optimiser, str) else optimiser is not None,
            self.limits,
        )
        validation = None
        if self.judging:
            model = adapted(self.model, [*seen, *self.judging])
            validation = prepare_groups(
                model, self.judging, burn_in_s=self.options["burn_in_s"], need_truth=False
            )
        return resume.digest(problem.search, repr(asked), validation)


def _parts(
    recordings: Sequence[Recording], judging: Sequence[Recording], folds: int | None
) -> list[list[str]]:
    """The names of the runs that each fold holds out."""
    names = [run.name for run in [*recordings, *judging]]
    twice = sorted({name for name in names if names.count(name) > 1})
    if twice:
        raise TuningError(
            f"got {twice} more than once among runs and validation runs, expected different names, for a"
            " run that is held out must not be learnt from; leave out or rename one"
        )
    scored = [run.name for run in recordings if run.encoder is not None]
    count = len(scored) if folds is None else folds
    if not 2 <= count <= len(scored):
        raise TuningError(
            f"got {count} folds for {len(scored)} runs with an encoder, expected at least two folds and not"
            " more than runs; name more runs or ask for other folds"
        )
    return [scored[i::count] for i in range(count)]


def _spread(values: Sequence[float], column: str) -> Spread:
    nan = float("nan")
    if not values:
        return Spread(nan, nan, nan)
    array = np.array(values)
    with np.errstate(divide="ignore"):
        badness = np.abs(np.log(array)) if column in _BEST_AT_ONE else array
    deviation = float(array.std(ddof=1)) if len(values) > 1 else nan
    return Spread(float(array.mean()), deviation, float(array[np.argmax(badness)]))


def _by_name(params: Parameters) -> dict[str, Floats]:
    leaves = [np.asarray(leaf, float) for leaf in jax.tree.leaves(params)]
    return dict(zip(leaf_names(params), leaves, strict=True))
