"""Cross-validation of a tuning: each run is held out once, and scored with the tuning of its fold."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

from jaxekf._support.deprecations import renamed_arguments
from jaxekf._support.errors import TuningError
from jaxekf.estimation.batch import Run, read
from jaxekf.filtering.model import Model, Parameters
from jaxekf.models import adapted, get_model
from jaxekf.recordings.types import Recording
from tuning.comparison.baselines import by_allan, by_search, in_one_shape, ordered
from tuning.comparison.compare import compare
from tuning.comparison.cost import gradient_cost
from tuning.objective.data import prepare_groups
from tuning.persistence.checkpoint import digest
from tuning.persistence.fold_checkpoint import FoldCheckpoint, fold_file, pack_tuned, unpack_tuned
from tuning.results.fitted import Fitted, FittedParameters
from tuning.results.held_out import CrossValidation, Fold
from tuning.results.tuned import Tuned
from tuning.search.derivative_free import Problem, SearchOptions
from tuning.search.optimisers import LBFGS, as_optimiser
from tuning.tuner import fit_runs, tune


class Limits(NamedTuple):
    """Limits of the searches without gradients, as in the literature.

    Examples
    --------
    >>> import tuning
    >>> tuning.Limits(sweeps=5)  # for `tuning.cross_validate(..., limits=...)`
    Limits(sweeps=5, evaluations=None)
    """

    sweeps: int = 20
    """Sweeps of coordinate search."""
    evaluations: int | None = None
    """Evaluations of Nelder-Mead; None for as many as coordinate search makes at most."""


@renamed_arguments(beside="baselines", judge="confidence_intervals")
def cross_validate(
    runs: Sequence[Run],
    folds: int | None = None,
    *,
    model: str | Model = "loose",
    validate: Sequence[Run] = (),
    start: Parameters | None = None,
    burn_in_s: float = 0.0,
    smooth: bool = False,
    baselines: Sequence[str] = (),
    limits: Limits = Limits(),  # noqa: B008
    static: Run | None = None,
    checkpoint: Path | str | None = None,
    stage: Callable[[str], None] | None = None,
    **options: Any,
) -> CrossValidation:
    """Tune once for each fold, on all runs except the fold's, and score the held-out runs.

    Parameters that each run has for itself (`Free.each_run`) are found for a held-out run by `fit_runs`,
    from its innovations and never from its truth. Ctrl-C ends the whole.

    Parameters
    ----------
    runs
        Recordings, or their paths. Runs without an encoder are training runs of every fold.
    folds
        Number of folds, each of every `folds`-th run; None for one fold for each run (leave one out).
    model, start, burn_in_s, options
        As in `tune`.
    validate
        Runs that choose the best iteration of every fold; they are never held out.
    smooth
        Whether to tune and to compare the smoothed estimates.
    baselines
        Names of `BASELINES` that each fold is compared with, on its training runs alone: ``allan`` is the
        start with the sensor noise of the runs' static intervals; ``coordinates`` and ``nelder-mead`` are
        searches without gradients of the same objective and free parameters. Their work is counted.
    limits
        Limits of the searches without gradients.
    static
        Static log for ``allan``, instead of the runs' static intervals.
    checkpoint
        File name; finished parts of the folds are written to ``NAME.fold1`` and so on, and a call with the
        same arguments goes on from there. The files stay until `forget_folds`.
    stage
        Called with the part that begins, such as ``fold 2/5, coordinates``.

    Returns
    -------
    CrossValidation
        Rows of all held-out runs, and the folds.

    Raises
    ------
    TuningError
        For less than two folds, more folds than runs with an encoder, two runs of one name, files of
        another cross-validation, ``allan`` if no run rests, and as in `tune`.

    Examples
    --------
    >>> import jaxekf, tuning
    >>> jaxekf.set_up()
    >>> runs = jaxekf.demo.paths(("free-1", "free-2"))
    >>> problem = {"objective": "likelihood", "free": ["noise.optical"], "iterations": 2}
    >>> found = tuning.cross_validate(runs, **problem)
    >>> [fold.held_out for fold in found.folds]
    [('free-1',), ('free-2',)]
    >>> [(row.run, row.variant) for row in found.rows if row.variant == "tuned"]
    [('free-1', 'tuned'), ('free-2', 'tuned')]
    >>> tuning.BASELINES  # names for the argument `baselines`
    ('allan', 'coordinates', 'nelder-mead')
    """
    recordings, validation = read(runs), read(validate)
    chosen = adapted(get_model(model), [*recordings, *validation])
    parts, others = _parts(recordings, validation, folds), ordered(baselines)
    before = chosen.parameters if start is None else start
    optimiser = as_optimiser(options.pop("optimiser", LBFGS()), options.pop("batch", None))
    options |= {"start": start, "burn_in_s": burn_in_s, "smooth": smooth, "optimiser": optimiser}
    task = _Task(chosen, validation, options, checkpoint, limits, static, stage, len(parts))
    done: list[Fold] = []
    of_run: dict[str, dict[str, Parameters]] = {name: {} for name in (*others, "tuned")}
    cost = float("nan")
    for number, names in enumerate(parts, 1):
        seen = [run for run in recordings if run.name not in names]
        hidden = [run for run in recordings if run.name in names]
        fold, problem = task.fold(number, seen, others)
        for name, fitted in {**fold.baselines, "tuned": fold.tuned}.items():
            # The fold's own model may lack a marker that only its held-out runs have.
            fit = FittedParameters(chosen, fitted.params, fitted.layout)
            of_run[name] |= fit_runs(hidden, fit, burn_in_s=burn_in_s)
        done.append(fold._replace(held_out=tuple(names)))
        if others and number == len(parts):
            cost = gradient_cost(problem.evaluation)
    judged = [run for run in recordings if run.name in of_run["tuned"]]
    variants: dict[str, Any] = {"start": before}
    for name, found in of_run.items():
        variants[name] = in_one_shape([found[run.name] for run in judged])
    rows = compare(chosen, judged, variants, smooth=smooth).rows
    return CrossValidation(rows, tuple(done), cost)


@dataclass(frozen=True)
class _Task:
    """Arguments that all folds share."""

    model: Model
    validation: list[Recording]
    options: dict[str, Any]
    checkpoint: Path | str | None
    limits: Limits
    static: Run | None
    stage: Callable[[str], None] | None
    folds: int

    def fold(
        self, number: int, seen: list[Recording], baselines: list[str]
    ) -> tuple[Fold, Problem]:
        """Tuning and baselines of one fold on the runs that it sees; finished parts are not repeated."""
        options: Any = {k: v for k, v in self.options.items() if k in SearchOptions.__annotations__}
        problem = Problem(seen, model=self.model, **options)
        path = fold_file(self.checkpoint, number)
        parts = FoldCheckpoint(path, "" if path is None else self._mark(problem, seen))
        found: dict[str, Fitted] = {}
        for name in baselines:
            self._report(number, f", {name}")
            if name == "allan":
                start = self.options["start"]
                start = self.model.parameters if start is None else start
                log = None if self.static is None else read([self.static])[0]
                found[name] = by_allan(problem.model, start, problem.layout, seen, log)
            else:
                found[name] = by_search(name, problem, parts, *self.limits)
        self._report(number)
        tuned: list[Tuned] = []

        def search() -> dict[str, Any]:
            given = {"model": self.model, "validate": self.validation, "checkpoint": parts.running}
            tuned.append(tune(seen, **given, **self.options))
            if "interrupted" in tuned[0].stopped:
                raise KeyboardInterrupt
            return pack_tuned(tuned[0])

        arrays = parts.once("tuned", search)
        if not tuned:
            model = adapted(self.model, [*seen, *self.validation])
            tuned.append(unpack_tuned(arrays, model, problem, [run.name for run in seen]))
        return Fold((), tuned[0], found), problem

    def _report(self, number: int, part: str = "") -> None:
        if self.stage is not None:
            self.stage(f"fold {number}/{self.folds}{part}")

    def _mark(self, problem: Problem, seen: list[Recording]) -> str:
        """Digest of all that a fold's results depend on."""
        # Start and objective are in the problem, and no result depends on the progress that is reported.
        plain = {k: v for k, v in self.options.items() if k not in ("progress", "start")}
        options = (
            [run.name for run in seen],
            [run.name for run in self.validation],
            sorted(plain.items()),
            self.limits,
        )
        validation = None
        if self.validation:
            model = adapted(self.model, [*seen, *self.validation])
            validation = prepare_groups(
                model, self.validation, burn_in_s=self.options["burn_in_s"], need_truth=False
            )
        return digest(problem.evaluation, repr(options), validation)


def _parts(
    recordings: Sequence[Recording], validation: Sequence[Recording], folds: int | None
) -> list[list[str]]:
    """Names of the runs that each fold holds out."""
    names = [run.name for run in [*recordings, *validation]]
    twice = sorted({name for name in names if names.count(name) > 1})
    if twice:
        raise TuningError(
            f"got {twice} more than once among runs and validation runs, expected different names, for a"
            " run that is held out must not be a training run; leave out or rename one"
        )
    scored = [run.name for run in recordings if run.encoder is not None]
    count = len(scored) if folds is None else folds
    if not 2 <= count <= len(scored):
        raise TuningError(
            f"got {count} folds for {len(scored)} runs with an encoder, expected at least two folds and not"
            " more than runs; name more runs or ask for other folds"
        )
    return [scored[i::count] for i in range(count)]
