"""The tuner: gradient steps over all training runs at once, judged on runs it does not learn from."""

import datetime
import hashlib
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from pathlib import Path
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np
import optax

from jaxekf._support.errors import TuningError
from jaxekf.estimation import parameters
from jaxekf.estimation.batch import Run, provenance, read, require_float64
from jaxekf.estimation.parameters import as_arrays
from jaxekf.filtering.model import Model, Parameters
from jaxekf.io.atomic import whole_set
from jaxekf.io.hashes import inputs_of
from jaxekf.models import adapted, get_model
from jaxekf.recordings.types import Flags, Floats, Recording
from tuning.comparison.compare import Row
from tuning.objective import covariance_scale
from tuning.objective.data import Data, prepare_groups
from tuning.objective.fisher_information import Information, information, interval, what_would_tell
from tuning.objective.objectives import Objective, attitude_error, parse
from tuning.parametrisation.free_vector import Free, Layout, layout, scaled, with_axes
from tuning.parametrisation.truth_frame import TruthFrame, no_correction
from tuning.persistence import checkpoint as resume
from tuning.persistence.tuning_document import JudgedOn, record, write_record
from tuning.results import Fitted
from tuning.search.descent import Descent, Iteration, Progress, own_step
from tuning.search.multistart import Outcome, Race, line_up
from tuning.search.optimisers import searcher

_OWN_FIT = 8
_WARM_STEPS = 12


@dataclass(frozen=True)
class Tuned:
    """What came out of a tuning."""

    model: Model
    params: Parameters
    """The best parameters, by validation where there is one; of what each run has of its own the mean."""
    start: Parameters
    objective: Objective
    best: Iteration
    history: tuple[Iteration, ...]
    stopped: str
    """Why the tuner stopped, in words."""
    scale: float
    """Factor by which all covariances were scaled after the fit so that errors match them."""
    layout: Layout
    origin: dict[str, Any] = field(default_factory=dict)
    each: dict[str, Parameters] = field(default_factory=dict)
    """Where runs have parameters of their own: those of each training run, by its name."""
    truth: TruthFrame | None = None
    """How the encoders lie to the tracker, where that was free."""
    free: Floats = field(default_factory=lambda: np.zeros(0))
    """(n,) the best free vector, before the scale."""
    information: Information | None = None
    """What the measurements tell of each number, at the best; None where it was not asked for."""
    fixed: Flags = field(default_factory=lambda: np.zeros(0, bool))
    """(n,) numbers that the data leave open and that stayed at their start."""
    evaluations: int = 0
    """Of the objective with its gradient, from all starts; with batches passes over all runs."""
    filterings: float = 0.0
    """Of all training runs, without a gradient: see `Descent.filterings`; one for the scale."""
    starts: tuple[Outcome, ...] = ()
    """What became of each start, the given one first, where there were several."""
    inputs: dict[str, dict[str, str]] = field(default_factory=dict)
    """Of each run that it saw, by name, the SHA-256 of every file it was read from."""

    @property
    def digest(self) -> str:
        """Tells this tuning's files from another's: each has it among where it came from."""
        told = hashlib.sha256(repr((self.model.name, sorted(self.each))).encode())
        for leaf in jax.tree.leaves((self.params, self.each)):
            told.update(np.asarray(leaf, float).tobytes())
        return told.hexdigest()[:16]

    @property
    def rejections(self) -> int:
        """Steps that were rejected because they were not finite."""
        return sum(step.rejected for step in self.history)

    @cached_property
    def intervals(self) -> dict[str, tuple[float, float, float]]:
        """Value and 95 % interval (Laplace's, by innovations and prior) of each free number that the data
        determine, by its label, in its unit; before the scale."""
        if self.information is None:
            return {}
        sigma = self.information.sigma(self.fixed)
        told = zip(self.layout.labels(), interval(self.layout, self.free, sigma), strict=True)
        unknown = self.fixed | self.layout.is_truth
        return {label: ends for (label, ends), out in zip(told, unknown, strict=True) if not out}

    @property
    def open(self) -> dict[str, str]:
        """What the data leave open, by label, and what recordings would tell it."""
        labels = self.layout.labels()
        found = [labels[i] for i in np.flatnonzero(self.fixed)]
        return {label: what_would_tell(label.split("[")[0].split(" of run")[0]) for label in found}

    @property
    def moved(self) -> list[str]:
        """How far each free number moved from its start, in words: the factor of a logarithm, else in
        deviations of its prior."""
        start = np.asarray(self.layout.to_free(self.start))
        told, at = [], 0
        for leaf in self.layout.leaves:
            for i in range(leaf.size):
                end, begin = self.free[at + i], start[at + i]
                change = leaf.straight(end, i) - leaf.straight(begin, i)
                if leaf.is_logarithm(i):
                    told.append(f"x {np.exp(change):.3g}")
                else:
                    told.append(f"{change / leaf.prior:+.2g} prior sigma")
            at += leaf.size
        return told

    def of_run(self, run: Run) -> Parameters:
        """The parameters of a training run, its own included."""
        return self.each.get(read([run])[0].name, self.params)

    def save(
        self,
        folder: Path | str,
        *,
        rows: Sequence[Row] = (),
        judged_on: JudgedOn | None = None,
        folds: Any = None,
    ) -> None:
        """Write `noise.toml` and `calibration.toml`, with units and where they came from; where runs have
        parameters of their own also ``runs/NAME`` with the same files for each. `tuning.json` beside them
        is for `jaxekf report`; the other arguments add to it what `tuning.save_record` says.

        A new folder is there whole or not at all. Where an earlier tuning is replaced, each file is whole,
        and the ``tuning`` in their origins tells those of one from those of another: `load_parameters`
        and the report refuse what a kill left of two.
        """
        told = record(self, rows=rows, judged_on=judged_on, folds=folds)
        origin = self.origin | {"tuning": self.digest}
        with whole_set(folder) as made:
            parameters.save(made, self.model, self.params, origin | {"inputs": self.inputs})
            for name, params in self.each.items():
                own = {key: files for key, files in self.inputs.items() if key == name}
                of_run = made / "runs" / name
                parameters.save(of_run, self.model, params, origin | {"inputs": own})
        if not parameters.leaf_names(self.params.calibration):
            # What an earlier model left there must not be read beside this one's noise.
            (Path(folder) / "calibration.toml").unlink(missing_ok=True)
        parameters.forget(Path(folder) / "runs", keep=self.each)
        write_record(folder, told)


def tune(
    runs: Sequence[Run],
    *,
    validate: Sequence[Run] = (),
    model: str | Model = "loose",
    objective: Objective | str | None = None,
    free: Sequence[str | Free] | None = None,
    start: Parameters | None = None,
    axes: str | None = None,
    iterations: int = 60,
    patience: int = 15,
    burn_in_s: float = 0.0,
    rescale: bool | None = None,
    smooth: bool = False,
    judge: bool = False,
    warm: bool = False,
    optimiser: optax.GradientTransformation | Literal["lbfgs", "fisher", "adam"] = "lbfgs",
    starts: int = 1,
    batch: int | None = None,
    seed: int = 0,
    checkpoint: Path | str | None = None,
    progress: Progress | None = None,
) -> Tuned:
    """Tune noise, and calibration where asked, by gradient over all runs in one compiled call.

    `objective` is the attitude error unless given. `free` names what may change (default: all noise); a
    `Free` says more: a prior, bounds, and whether each run has its own. ``truth`` frees the encoder's
    clock and frames (`TruthFrame`). `axes` gives what is free one deviation for all axes (`tied`), one for
    `each`, or a `full` matrix; None leaves it as the start has it. With `smooth` errors are those of the
    smoothed estimate. The optimiser is L-BFGS; ``fisher`` scoring for likelihood and `map`, which needs few
    steps of two runs of the filter for each number: for up to some thirty; ``adam`` steps on `batch` runs
    at a time (16 unless given), an iteration being a pass over all of them, for very many runs; or any of
    optax.

    With several `starts` the search begins at the given one and at others drawn about it by the `seed`:
    deviations off by up to one and a half decades or their priors, calibration by half its prior's
    deviation. They go side by side in one program; after 8, 16 and 32 iterations the worse half is
    dropped, so that eight cost far less than eight times as much as one. The best is gone on with.

    The best parameters so far are kept, by the validation runs where there are any; what these have of
    their own is found from their innovations, never from their truth. The tuner stops when they have not
    improved for `patience` iterations. Steps that are not finite are rejected, shortened and counted.
    Ctrl-C ends the search and keeps the best so far.

    With `judge` the Fisher information of the innovations is taken at the best: numbers that the data leave
    open go back to their start, the search goes on without them, and the others have intervals.

    With `warm` the search begins where up to a dozen steps of Fisher scoring on the likelihood lead: errors
    are flat far from their minimum (of 20 starts within 1.5 decades 6 came within 1 % of the best, 19 so).

    With a `checkpoint` (a file) a tuning that was stopped, however, goes on from its last iteration when it
    is called again with the same arguments; the file is gone when it has ended, and stays after Ctrl-C.

    The error alone does not fix the common scale of Q, R and P0; with `rescale` (the default when noise is
    free and no likelihood is in the objective) they are scaled afterwards so that the training errors match
    their covariances: all of them, since only so does the estimate stay.

    Raises `TuningError` where the problem is ill-posed, and what `estimate` raises for bad data.
    """
    require_float64()
    learnt, judging = read(runs), read(validate)
    chosen = adapted(get_model(model), [*learnt, *judging])
    aim = parse(objective) if isinstance(objective, str) else objective or attitude_error()
    aim = replace(aim, smoothed=smooth or aim.smoothed)
    base = starting(chosen, start, free, axes)
    where = layout(chosen, base, free, len(learnt))
    _check(learnt, judging, where, aim)
    options: dict[str, Any] = {"burn_in_s": burn_in_s, "need_truth": aim.needs_truth}
    training = prepare_groups(chosen, learnt, **options)
    held_out = prepare_groups(chosen, judging, **options) if validate else None
    make = searcher(optimiser, aim, starts, batch, seed)
    race = line_up(
        partial(make, chosen, aim, where, base, training, held_out, iterations), starts, seed
    )
    if checkpoint is not None:
        asked = (_names(learnt), _names(judging), iterations, patience, burn_in_s, judge, warm)
        how = (optimiser if isinstance(optimiser, str) else "own", starts, batch, seed)
        resume.attach(race, Path(checkpoint), repr((*asked, *how)))
    if warm:
        race.warm(_WARM_STEPS)
    search = race.run(patience, progress)
    known, stopped = _search(search, patience, judge, progress)
    if rescale is None:
        rescale = covariance_scale.is_open(aim, training, where)
    tuned = _told(search, known, stopped, _names(learnt), _names(judging), rescale=rescale)
    if checkpoint is not None and "interrupted" not in stopped:
        Path(checkpoint).unlink(missing_ok=True)
    tuned = replace(tuned, inputs=inputs_of([*learnt, *judging]))
    return _of_all_starts(tuned, race, search) if starts > 1 else tuned


def _of_all_starts(tuned: Tuned, race: Race, search: Descent) -> Tuned:
    """With what became of each start, and the work of all."""
    more = race.filterings - search.filterings
    tuned = replace(tuned, starts=race.outcomes, evaluations=race.evaluations)
    return replace(tuned, filterings=tuned.filterings + more)


def starting(
    model: Model,
    start: Parameters | None,
    free: Sequence[str | Free] | None,
    axes: str | None,
) -> Parameters:
    """Where the search starts, in the shapes in which it is to go on."""
    base = as_arrays(model.parameters if start is None else start)
    if any((f.name if isinstance(f, Free) else f).startswith("truth") for f in free or ()):
        base = base._replace(truth=no_correction())
    return base if axes is None else with_axes(model, base, axes, free)


def _told(
    search: Descent,
    known: Information | None,
    stopped: str,
    runs: list[str],
    validate: list[str],
    *,
    rescale: bool,
) -> Tuned:
    """What came out of a search."""
    assert search.best is not None
    where, best = search.layout, search.best.step
    params, scale = where.from_free(search.best.free, search.base), 1.0
    together = where.together(params)
    if rescale:
        smooth = search.objective.smoothed
        scale = covariance_scale.scale(search.model, params, search.training, where, smooth=smooth)
        params, together = scaled(params, scale), scaled(together, scale)
    each = {name: where.one_run(params, i) for i, name in enumerate(runs)} if where.own else {}
    origin = {
        "runs": runs,
        "validation_runs": validate,
        "objective": search.objective.describe(),
        "free": [leaf.name for leaf in where.leaves],
        "iterations": len(search.history),
        "best_iteration": best.number,
        "training_value": best.training,
        "covariance_scale": scale,
        "date": datetime.date.today().isoformat(),
        **provenance(),
    }
    if where.own:
        origin["own_of_each_run"] = sorted(where.own)
    if search.fixed.any():
        origin["left_open"] = [where.labels()[i] for i in np.flatnonzero(search.fixed)]
    if validate:
        origin["validation_value"] = best.validation
    return Tuned(
        model=search.model,
        params=together._replace(truth=()),
        start=search.base,
        objective=search.objective,
        best=best,
        history=tuple(search.history),
        stopped=stopped,
        scale=scale,
        layout=where,
        origin=origin,
        each={name: own._replace(truth=()) for name, own in each.items()},
        truth=params.truth or None,
        free=np.asarray(search.best.free),
        information=known,
        fixed=search.fixed,
        evaluations=search.evaluations,
        filterings=search.filterings + rescale,
    )


def _search(
    search: Descent, patience: int, judge: bool, progress: Progress | None
) -> tuple[Information | None, str]:
    """Search, fix what the data leave open, and search on until that is all; what is known at the end."""
    while True:
        stopped = search.run(patience, progress)
        if not judge:
            return None, stopped
        assert search.best is not None
        known = information(
            search.model, search.layout, search.best.free, search.base, search.training
        )
        search.filterings += search.information_cost
        fixed = known.open(search.fixed)
        interrupted = "interrupted" in stopped
        if (fixed == search.fixed).all() or interrupted:
            return known, stopped
        search.again(fixed)


def fit_runs(
    runs: Sequence[Run], tuned: Fitted, *, burn_in_s: float = 0.0
) -> dict[str, Parameters]:
    """Parameters of runs that were not learnt from, by name: what each has of its own is found from its own
    innovations, with the prior about the mean of the training runs; its truth is not looked at.

    Where runs have nothing of their own these are the `params` of what was fitted, for each.
    """
    recordings = read(runs)
    names = _names_apart(recordings)
    # What an encoder has of its own no innovation tells.
    own = {name for name in tuned.layout.own if not name.startswith("truth.")}
    where = tuned.layout.only(own).for_runs_number(len(recordings))
    if not where.leaves:
        return dict.fromkeys(names, tuned.params)
    groups: tuple[Data, ...] = prepare_groups(
        tuned.model, recordings, burn_in_s=burn_in_s, need_truth=False
    )
    centre = np.asarray(where.to_free(tuned.params))
    found = centre
    for _ in range(_OWN_FIT):
        found = own_step(tuned.model, where, found, centre, tuned.params, groups)
    params = where.from_free(jnp.asarray(found), tuned.params)
    return {name: where.one_run(params, i) for i, name in enumerate(names)}


def _check(
    runs: Sequence[Recording], validate: Sequence[Recording], where: Layout, aim: Objective
) -> None:
    """A run that is learnt from cannot judge what was learnt, and no innovation tells of an encoder."""
    if where.is_truth.any() and not aim.needs_truth:
        raise TuningError(
            f"got the encoder's own clock or frame free for '{aim.describe()}', expected an objective that"
            " compares with the encoder; add attitude or truth to it, or leave truth out"
        )
    if where.own:
        _names_apart(runs)
    both = sorted(set(_names(runs)) & set(_names(validate)))
    if both:
        raise TuningError(
            f"got {both} among the training and the validation runs, expected different runs;"
            " leave each in one of them"
        )


def _names(runs: Sequence[Recording]) -> list[str]:
    return [run.name for run in runs]


def _names_apart(runs: Sequence[Recording]) -> list[str]:
    """Names of runs of which each has its own result: `TuningError` where two are of one name."""
    names = _names(runs)
    twice = sorted({name for name in names if names.count(name) > 1})
    if twice:
        raise TuningError(
            f"got several runs of the name {twice}, expected each its own; change the name in"
            " recording.toml, or leave out what is named twice"
        )
    return names
