"""What is done without a gradient, on the tuner's own objective: coordinate search and Nelder-Mead.

Baselines to measure the tuner by, counted in evaluations of the objective: each filters all runs once.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple, TypedDict, Unpack

import jax.numpy as jnp
import numpy as np
from scipy.optimize import minimize

from jaxekf._support.errors import TuningError
from jaxekf.estimation.batch import Run, read, require_float64
from jaxekf.filtering.model import Model, Parameters
from jaxekf.models import adapted, get_model
from jaxekf.recordings.types import Flags, Floats
from tuning._tune import starting
from tuning.objective import covariance_scale
from tuning.objective.data import prepare_groups
from tuning.objective.objectives import Objective, attitude_error, parse
from tuning.parametrisation.free_vector import Free, Layout, layout, scaled
from tuning.search.descent import Descent

_FIRST_STEP = 0.1
"""Of a value by itself, and of a number below the diagonal of a full matrix, which is one of its row's
diagonal."""


class Lowered(NamedTuple):
    """Where a search first found a lower value."""

    evaluations: int
    """Made until then, this one included."""
    value: float


class Found(NamedTuple):
    """What a search came to."""

    best: Floats
    """(n,)"""
    value: float
    history: tuple[Lowered, ...]
    """From the start on, each lower than the one before."""
    evaluations: int
    """In total."""


@dataclass(frozen=True)
class Searched:
    """What came out of a tuning without gradients."""

    model: Model
    params: Parameters
    """The best, scaled; of what each run has of its own the mean."""
    value: float
    """The objective of `params`."""
    history: tuple[Lowered, ...]
    evaluations: int
    """Of the objective, without a gradient."""
    start: Parameters
    layout: Layout
    free: Floats
    """(n,) the best free vector, before the scale."""
    scale: float = 1.0
    """Factor by which all covariances were scaled after the search so that errors match them."""
    filterings: int = 0
    """Of all runs: the evaluations, and one more for the scale."""


class Asked(TypedDict, total=False):
    """What is searched for. Defaults and errors are those of `tune`."""

    model: str | Model
    objective: Objective | str | None
    free: Sequence[str | Free] | None
    start: Parameters | None
    axes: str | None
    burn_in_s: float
    smooth: bool
    rescale: bool | None


class _Counted:
    """A function that keeps its lowest value; one that is not finite is as high as can be."""

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

    Each number in turn is tried with its step added, and if that does not lower the value, taken away; what
    lowers it is kept. Then the number's step is multiplied by `growth`, or by `shrinkage` where neither
    did. The step of a `relative` number is that share of its value. Raises `TuningError` where the value
    at the start is not finite, and for less than one sweep.
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

    The first simplex is the start and, for each number, the start with its step added. It ends after so
    many evaluations, or when values and simplex agree within 1e-8. Raises `TuningError` where the value at
    the start is not finite, and for fewer evaluations than the simplex has corners.
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

    def __init__(self, runs: Sequence[Run], **asked: Unpack[Asked]) -> None:
        require_float64()
        learnt = read(runs)
        self.model = adapted(get_model(asked.get("model", "loose")), learnt)
        told, free = asked.get("objective"), asked.get("free")
        aim = parse(told) if isinstance(told, str) else told or attitude_error()
        aim = replace(aim, smoothed=asked.get("smooth", False) or aim.smoothed)
        self.base = starting(self.model, asked.get("start"), free, asked.get("axes"))
        self.layout = layout(self.model, self.base, free, len(learnt))
        burn_in_s = asked.get("burn_in_s", 0.0)
        groups = prepare_groups(self.model, learnt, burn_in_s=burn_in_s, need_truth=aim.needs_truth)
        # It is never stepped: its value is what is searched.
        self.search = Descent(self.model, aim, self.layout, self.base, groups, None, iterations=0)
        self.start, self.value = self.search.start, self.search.value
        rescale = asked.get("rescale")
        self.rescale = (
            covariance_scale.is_open(aim, groups, self.layout) if rescale is None else rescale
        )

    @property
    def relative(self) -> Flags:
        """(n,) numbers that are logarithms."""
        return self.layout.is_logarithm

    @property
    def steps(self) -> Floats:
        """(n,) first steps; a leaf of calibration has its natural unit as the unit of its free numbers."""
        linear = [leaf.kind == "linear" for leaf in self.layout.leaves for _ in range(leaf.size)]
        return np.where(linear, 1.0, _FIRST_STEP)

    def by_coordinates(self, sweeps: int) -> Found:
        """See `tune_by_coordinates`."""
        relative = self.relative

        def natural(free: Floats) -> Floats:
            return np.where(relative, np.exp(np.where(relative, free, 0.0)), free)

        def back(values: Floats) -> Floats:
            # A step of more than the whole value leads below zero: no deviation, and no finite objective.
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
        """By which the covariances of what was found are too small: 1 where nothing is to be scaled."""
        if not self.rescale:
            return 1.0
        params = self.layout.from_free(jnp.asarray(found.best), self.base)
        smooth = self.search.objective.smoothed
        given = self.model, params, self.search.training, self.layout
        return covariance_scale.scale(*given, smooth=smooth)

    def searched(self, found: Found, scale: float) -> Searched:
        """What was found as parameters."""
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
    runs: Sequence[Run], *, sweeps: int = 20, **asked: Unpack[Asked]
) -> Searched:
    """Tune by `coordinate_search`; the other arguments, defaults and errors are those of `tune`.

    Deviations start with steps of 10 % of their value, numbers below the diagonal of a full matrix with
    10 % of their row's diagonal one, calibration with its natural unit (5 ms, 0.01 rad, 1 %, 1 cm, 10 ppm).
    """
    problem = Problem(runs, **asked)
    found = problem.by_coordinates(sweeps)
    return problem.searched(found, problem.scale(found))


def tune_by_nelder_mead(
    runs: Sequence[Run], *, evaluations: int = 1_000, **asked: Unpack[Asked]
) -> Searched:
    """Tune by `nelder_mead` on the free vector, in which deviations are logarithms; the other arguments,
    defaults and errors are those of `tune`. The steps of the first simplex are those of
    `tune_by_coordinates`."""
    problem = Problem(runs, **asked)
    found = problem.by_nelder_mead(evaluations)
    return problem.searched(found, problem.scale(found))
