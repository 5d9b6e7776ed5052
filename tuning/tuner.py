"""The tuner: a search over all training runs at once, validated on runs that it does not learn from."""

import datetime
from collections.abc import Sequence
from functools import partial
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import optax

from jaxekf._support.deprecations import renamed_arguments
from jaxekf._support.errors import TuningError
from jaxekf.estimation.batch import Run, read, require_float64
from jaxekf.estimation.versions import provenance
from jaxekf.filtering.model import Model, Parameters
from jaxekf.io.hashes import inputs_of
from jaxekf.models import adapted, get_model
from jaxekf.recordings.types import Recording
from tuning.objective import covariance_scale
from tuning.objective.data import prepare_groups
from tuning.objective.fisher_information import Information, information
from tuning.objective.objectives import Objective, as_objective
from tuning.parametrisation.free_vector import Free, Layout, initial_parameters, layout, scaled
from tuning.persistence.checkpoint import attach
from tuning.results.fitted import Fitted
from tuning.results.tuned import Progress, Tuned
from tuning.search.descent import Descent
from tuning.search.evaluation import own_step
from tuning.search.multistart import MultiStart, start_searches
from tuning.search.optimisers import LBFGS, Optimiser, as_optimiser

_OWN_STEPS = 8
_WARM_STEPS = 12


@renamed_arguments(judge="confidence_intervals")
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
    confidence_intervals: bool = False,
    warm: bool = False,
    optimiser: Optimiser | optax.GradientTransformation | str = LBFGS(),  # noqa: B008
    starts: int = 1,
    batch: int | None = None,
    seed: int = 0,
    checkpoint: Path | str | None = None,
    progress: Progress | None = None,
) -> Tuned:
    """Tune noise, and calibration if asked, by gradient over all runs; Ctrl-C keeps the best so far.

    Parameters
    ----------
    runs, validate
        Training runs, and runs that choose the best iteration (none: the training runs do). A validation
        run's own parameters are found from its innovations, never from its truth.
    objective
        Objective or its text; the attitude error unless given.
    free
        Free parameters, by name or as `Free`; all noise unless given. ``truth`` frees the encoder's clock
        and frames (`TruthFrame`).
    start, axes
        Initial parameters, by default the model's; free noise with one deviation for all axes (`tied`), one
        for `each`, or a `full` matrix, by default as in `start`.
    iterations, patience
        Largest number of iterations, and of iterations without improvement.
    burn_in_s, smooth
        Time at the start of each run that does not count, s; whether errors are those of the smoothed
        estimate.
    rescale
        Whether to scale Q, R and P0 afterwards so that the training errors match them. By default if noise
        is free and the objective has errors alone, which do not determine that scale.
    confidence_intervals
        Whether to compute the Fisher information of the innovations at the best; unobservable parameters
        then revert to their initial values.
    warm
        Whether to begin with up to 12 steps of Fisher scoring on the likelihood: errors are flat far from
        their minimum (of 20 starts within 1.5 decades 6 came within 1 % of the best, 19 with it).
    optimiser
        `LBFGS`, `FisherScoring`, `Adam`, or an optimiser of optax. Names and `batch` are deprecated.
    starts, seed
        Number of starts, the given one and samples about it (successive halving drops the worse half after
        8, 16 and 32 iterations); seed of the samples, and of the order of Adam's batches.
    checkpoint, progress
        File for the state of the search, from which a call with the same arguments goes on; it is removed
        at the end, but stays after Ctrl-C. Function called with each iteration and `iterations`.

    Returns
    -------
    Tuned
        Best parameters, and the history of the search.

    Raises
    ------
    TuningError
        If the problem is ill-posed; bad data raise as in `estimate`.

    Examples
    --------
    >>> import jaxekf, tuning
    >>> jaxekf.set_up()
    >>> runs = jaxekf.demo.paths(("free-1", "free-2"))
    >>> tuned = tuning.tune(runs, objective="likelihood", free=["noise.optical"], iterations=20)
    >>> tuned.stopped
    'converged'
    >>> print(f"from {tuned.start.noise.optical:.4f} to {tuned.params.noise.optical:.4f} rad")
    from 0.0052 to 0.0053 rad
    """
    require_float64()
    learnt, validation = read(runs), read(validate)
    method = as_optimiser(optimiser, batch)
    aim = as_objective(objective, smooth=smooth)
    chosen = adapted(get_model(model), [*learnt, *validation])
    base = initial_parameters(chosen, start, free, axes)
    where = layout(chosen, base, free, len(learnt))
    _check(learnt, validation, where, aim)
    groups = partial(prepare_groups, chosen, burn_in_s=burn_in_s, need_truth=aim.needs_truth)
    data = groups(learnt), groups(validation) if validation else None
    problem = chosen, aim, where, base, *data, iterations
    make = partial(method.search, *problem, starts=starts, seed=seed)
    searches = start_searches(make, starts, seed)
    if checkpoint is not None:
        limits = iterations, patience, burn_in_s, confidence_intervals, warm
        options = _names(learnt), _names(validation), *limits, method, starts, seed
        attach(searches, Path(checkpoint), repr(options))
    if warm:
        searches.warm(_WARM_STEPS)
    search = searches.run(patience, progress)
    known, stopped = _finish(search, patience, confidence_intervals, progress)
    tuned = _tuned(searches, search, known, stopped, learnt, validation, rescale)
    if checkpoint is not None and "interrupted" not in stopped:
        Path(checkpoint).unlink(missing_ok=True)
    return tuned


def _finish(
    search: Descent, patience: int, confidence_intervals: bool, progress: Progress | None
) -> tuple[Information | None, str]:
    """Search, fix unobservable numbers and search on until there are no more; return the information at the
    end, and the reason for it."""
    while True:
        stopped = search.run(patience, progress)
        if not confidence_intervals:
            return None, stopped
        assert search.best is not None
        known = information(
            search.model, search.layout, search.best.free, search.base, search.training
        )
        search.filterings += search.information_cost
        fixed = known.open(search.fixed)
        if (fixed == search.fixed).all() or "interrupted" in stopped:
            return known, stopped
        search.restart(fixed)


def _tuned(
    searches: MultiStart,
    search: Descent,
    known: Information | None,
    stopped: str,
    learnt: list[Recording],
    validation: list[Recording],
    rescale: bool | None,
) -> Tuned:
    """Result of a finished search."""
    assert search.best is not None
    where, best, runs = search.layout, search.best.step, _names(learnt)
    params, scale = where.from_free(search.best.free, search.base), 1.0
    together = where.together(params)
    if rescale is None:
        rescale = covariance_scale.is_open(search.objective, search.training, where)
    if rescale:
        smooth = search.objective.smoothed
        scale = covariance_scale.scale(search.model, params, search.training, where, smooth=smooth)
        params, together = scaled(params, scale), scaled(together, scale)
    each = {name: where.one_run(params, i) for i, name in enumerate(runs)} if where.own else {}
    origin = {
        "runs": runs,
        "validation_runs": _names(validation),
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
    if validation:
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
        evaluations=searches.evaluations,
        filterings=searches.filterings + rescale,
        starts=searches.outcomes if len(searches.searches) > 1 else (),
        inputs=dict(inputs_of([*learnt, *validation])),
    )


def fit_runs(
    runs: Sequence[Run], tuned: Fitted, *, burn_in_s: float = 0.0
) -> dict[str, Parameters]:
    """Parameters of runs that were not training runs, by name.

    Parameters that each run has for itself are found from its own innovations, with the prior about the
    mean of the training runs, and never from its truth. Without any these are the `params` of `tuned`.

    Parameters
    ----------
    runs
        Recordings, or their paths.
    tuned
        Result of a tuning.
    burn_in_s
        Time at the start of each run that does not count, s.

    Raises
    ------
    TuningError
        If two runs have the same name.

    Examples
    --------
    >>> import jaxekf, tuning
    >>> jaxekf.set_up()
    >>> runs = jaxekf.demo.paths(("free-1",))
    >>> tuned = tuning.tune(runs, objective="likelihood", free=["noise.optical"], iterations=2)
    >>> fitted = tuning.fit_runs(jaxekf.demo.paths(("free-5",)), tuned)
    >>> fitted["free-5"] == tuned.params  # no parameter that each run has for itself
    True
    """
    recordings = read(runs)
    names = _different_names(recordings)
    # No innovation depends on the encoder.
    own = {name for name in tuned.layout.own if not name.startswith("truth.")}
    where = tuned.layout.only(own).for_runs_number(len(recordings))
    if not where.leaves:
        return dict.fromkeys(names, tuned.params)
    groups = prepare_groups(tuned.model, recordings, burn_in_s=burn_in_s, need_truth=False)
    centre = np.asarray(where.to_free(tuned.params))
    found = centre
    for _ in range(_OWN_STEPS):
        found = own_step(tuned.model, where, found, centre, tuned.params, groups)
    params = where.from_free(jnp.asarray(found), tuned.params)
    return {name: where.one_run(params, i) for i, name in enumerate(names)}


def _check(
    runs: Sequence[Recording], validate: Sequence[Recording], where: Layout, aim: Objective
) -> None:
    """Refuse training runs among the validation runs, and a free encoder without errors to fit it by."""
    if where.is_truth.any() and not aim.needs_truth:
        raise TuningError(
            f"got the encoder's own clock or frame free for '{aim.describe()}', expected an objective that"
            " compares with the encoder; add attitude or truth to it, or leave truth out"
        )
    if where.own:
        _different_names(runs)
    both = sorted(set(_names(runs)) & set(_names(validate)))
    if both:
        raise TuningError(
            f"got {both} among the training and the validation runs, expected different runs;"
            " leave each in one of them"
        )


def _names(runs: Sequence[Recording]) -> list[str]:
    return [run.name for run in runs]


def _different_names(runs: Sequence[Recording]) -> list[str]:
    """Names of runs that each have a result of their own. Raises `TuningError` if two are equal."""
    names = _names(runs)
    twice = sorted({name for name in names if names.count(name) > 1})
    if twice:
        raise TuningError(
            f"got several runs of the name {twice}, expected each its own; change the name in"
            " recording.toml, or leave out what is named twice"
        )
    return names
