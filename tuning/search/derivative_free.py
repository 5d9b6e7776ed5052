"""Searches without gradients on the tuner's objective: coordinate search and Nelder-Mead.

They are baselines for the tuner. Each evaluation of the objective filters all runs once.
"""

from collections.abc import Callable, Sequence
from typing import TypedDict, Unpack

import jax.numpy as jnp
import numpy as np
from scipy.optimize import minimize

from jaxekf._support.errors import TuningError
from jaxekf.estimation.batch import Run, read, require_float64
from jaxekf.filtering.model import Model, Parameters
from jaxekf.models import adapted, get_model
from jaxekf.recordings.types import Flags, Floats
from tuning.objective import covariance_scale
from tuning.objective.data import prepare_groups
from tuning.objective.objectives import Objective, as_objective
from tuning.parametrisation.free_vector import Free, initial_parameters, layout, scaled
from tuning.results.searched import Found, Lowered, Searched
from tuning.search.evaluation import Evaluation

_FIRST_STEP = 0.1
"""First step as a share of a noise parameter; below the diagonal of a full matrix of the row's diagonal."""


class SearchOptions(TypedDict, total=False):
    """Options of a search without gradients. Defaults and errors are those of `tune`."""

    model: str | Model
    objective: Objective | str | None
    free: Sequence[str | Free] | None
    start: Parameters | None
    axes: str | None
    burn_in_s: float
    smooth: bool
    rescale: bool | None


class _Counted:
    """A function with the number of its evaluations and its lowest value; not finite counts as infinite."""

    def __init__(self, function: Callable[[Floats], float], start: Floats) -> None:
        self.function = function
        self.evaluations = 0
        self.best, self.value = start, float("inf")
        self.history: list[Lowered] = []
        if not np.isfinite(self(start)):
            raise TuningError(
                "got an objective that is not finite at the start, expected a finite one; start from other"
                " noise or check the data"
            )

    def __call__(self, at: Floats) -> float:
        value = float(self.function(at))
        self.evaluations += 1
        value = value if np.isfinite(value) else float("inf")
        if value < self.value:
            self.best, self.value = at.copy(), value
            self.history.append(Lowered(self.evaluations, value))
        return value

    def found(self) -> Found:
        return Found(self.best, self.value, tuple(self.history), self.evaluations)


def coordinate_search(
    function: Callable[[Floats], float],
    start: Floats,
    *,
    step: Floats,
    relative: Flags,
    sweeps: int = 20,
    growth: float = 1.1,
    shrinkage: float = 0.5,
) -> Found:
    """Lower a function of (n,) numbers by one number at a time (Abbeel et al. 2005; MATLAB's `tune`).

    Each number in turn is tried with its step added and, if that does not lower the value, with its step
    subtracted; a lower value is accepted. Then the number's step is multiplied by `growth`, or by
    `shrinkage` if neither trial was accepted. The step of a `relative` number is a share of its value.
    Raises `TuningError` if the value at the start is not finite, and for less than one sweep.
    """
    if sweeps < 1:
        raise TuningError(f"got {sweeps} sweeps, expected at least one; ask for more")
    counted, steps = _Counted(function, np.asarray(start, float)), np.array(step, float)
    for _ in range(sweeps):
        for i in range(len(steps)):
            before, lowest = counted.best, counted.value
            change = steps[i] * (before[i] if relative[i] else 1.0)
            for signed in (change, -change):
                tried = before.copy()
                tried[i] += signed
                if counted(tried) < lowest:
                    break
            steps[i] *= growth if counted.value < lowest else shrinkage
    return counted.found()


def nelder_mead(
    function: Callable[[Floats], float], start: Floats, *, step: Floats, evaluations: int
) -> Found:
    """Lower a function of (n,) numbers by SciPy's Nelder-Mead, its coefficients adapted to n.

    The first simplex is the start and, for each number, the start with its step added. It ends after
    `evaluations`, or when values and simplex agree within 1e-8. Raises `TuningError` if the value at the
    start is not finite, and for fewer evaluations than the simplex has corners.
    """
    start, step = np.asarray(start, float), np.asarray(step, float)
    if evaluations < len(start) + 2:
        raise TuningError(
            f"got {evaluations} evaluations for {len(start)} numbers, expected at least {len(start) + 2};"
            " ask for more"
        )
    counted = _Counted(function, start)

    options = {
        "initial_simplex": np.vstack([start, start + np.diag(step)]),
        # SciPy evaluates the start again, as the first corner.
        "maxfev": evaluations - 1,
        "adaptive": True,
        "xatol": 1e-8,
        "fatol": 1e-8,
    }
    minimize(counted, start, method="Nelder-Mead", options=options)
    return counted.found()


class Problem:
    """The tuner's objective as a function of the free vector, evaluated by the tuner's own program."""

    def __init__(self, runs: Sequence[Run], **options: Unpack[SearchOptions]) -> None:
        require_float64()
        learnt, free = read(runs), options.get("free")
        self.model = adapted(get_model(options.get("model", "loose")), learnt)
        aim = as_objective(options.get("objective"), smooth=options.get("smooth", False))
        start, axes = options.get("start"), options.get("axes")
        self.base = initial_parameters(self.model, start, free, axes)
        self.layout = layout(self.model, self.base, free, len(learnt))
        burn_in_s = options.get("burn_in_s", 0.0)
        groups = prepare_groups(self.model, learnt, burn_in_s=burn_in_s, need_truth=aim.needs_truth)
        self.evaluation = Evaluation(self.model, aim, self.layout, self.base, groups, None)
        self.start, self.value = self.evaluation.start, self.evaluation.value
        rescale = options.get("rescale")
        self.rescale = (
            covariance_scale.is_open(aim, groups, self.layout) if rescale is None else rescale
        )

    @property
    def relative(self) -> Flags:
        """(n,) numbers that are logarithms."""
        return self.layout.is_logarithm

    @property
    def steps(self) -> Floats:
        """(n,) first steps; the free numbers of calibration are in its natural unit."""
        linear = [leaf.kind == "linear" for leaf, _ in self.layout.numbers()]
        return np.where(linear, 1.0, _FIRST_STEP)

    def by_coordinates(self, sweeps: int) -> Found:
        """See `tune_by_coordinates`."""
        relative = self.relative

        def natural(free: Floats) -> Floats:
            return np.where(relative, np.exp(np.where(relative, free, 0.0)), free)

        def back(values: Floats) -> Floats:
            # A step of more than the whole value leads below zero, to no deviation and no finite objective.
            admissible = np.where(relative & (values > 0.0), values, 1.0)
            logs = np.where(values > 0.0, np.log(admissible), np.nan)
            return np.where(relative, logs, values)

        found = coordinate_search(
            lambda values: self.value(back(values)),
            natural(self.start),
            step=self.steps,
            relative=relative,
            sweeps=sweeps,
        )
        return found._replace(best=back(found.best))

    def by_nelder_mead(self, evaluations: int) -> Found:
        """See `tune_by_nelder_mead`."""
        return nelder_mead(self.value, self.start, step=self.steps, evaluations=evaluations)

    def scale(self, found: Found) -> float:
        """Factor by which the covariances at the minimum are too small; 1 if they are not to be scaled."""
        if not self.rescale:
            return 1.0
        params = self.layout.from_free(jnp.asarray(found.best), self.base)
        smooth = self.evaluation.objective.smoothed
        given = self.model, params, self.evaluation.training, self.layout
        return covariance_scale.scale(*given, smooth=smooth)

    def searched(self, found: Found, scale: float) -> Searched:
        """Result of a search as parameters."""
        params = self.layout.from_free(jnp.asarray(found.best), self.base)
        return Searched(
            model=self.model,
            params=self.layout.together(scaled(params, scale))._replace(truth=()),
            value=found.value,
            history=found.history,
            evaluations=found.evaluations,
            start=self.base,
            layout=self.layout,
            free=found.best,
            scale=scale,
            filterings=found.evaluations + self.rescale,
        )


def tune_by_coordinates(
    runs: Sequence[Run], *, sweeps: int = 20, **options: Unpack[SearchOptions]
) -> Searched:
    """Tune by `coordinate_search`, without gradients.

    Parameters
    ----------
    runs
        Recordings or paths of runs.
    sweeps
        Number of passes over all numbers.
    **options
        Arguments of `tune` with its defaults; errors are those of `tune`, too.

    Notes
    -----
    The first steps are 10 % of a deviation, 10 % of the row's diagonal entry below the diagonal of a full
    matrix, and the natural unit of a calibration (5 ms, 0.01 rad, 1 %, 1 cm, 10 ppm).

    Examples
    --------
    >>> import jaxekf, tuning
    >>> jaxekf.set_up()
    >>> runs = jaxekf.demo.paths(("free-1",))
    >>> problem = {"objective": "likelihood", "free": ["noise.optical"]}
    >>> found = tuning.tune_by_coordinates(runs, **problem, sweeps=4)
    >>> print(f"{found.params.noise.optical:.4f} rad after {found.evaluations} evaluations")
    0.0054 rad after 8 evaluations
    """
    problem = Problem(runs, **options)
    found = problem.by_coordinates(sweeps)
    return problem.searched(found, problem.scale(found))


def tune_by_nelder_mead(
    runs: Sequence[Run], *, evaluations: int = 1_000, **options: Unpack[SearchOptions]
) -> Searched:
    """Tune by `nelder_mead` on the free vector, in which deviations are logarithms.

    Parameters
    ----------
    runs
        Recordings or paths of runs.
    evaluations
        Largest number of evaluations of the objective.
    **options
        As in `tune_by_coordinates`, whose first steps span the first simplex.

    Examples
    --------
    >>> import jaxekf, tuning
    >>> jaxekf.set_up()
    >>> runs = jaxekf.demo.paths(("free-1",))
    >>> problem = {"objective": "likelihood", "free": ["noise.optical"]}
    >>> found = tuning.tune_by_nelder_mead(runs, **problem, evaluations=8)
    >>> print(f"{found.params.noise.optical:.4f} rad after {found.evaluations} evaluations")
    0.0053 rad after 8 evaluations
    """
    problem = Problem(runs, **options)
    found = problem.by_nelder_mead(evaluations)
    return problem.searched(found, problem.scale(found))
