"""Result of a cross-validation: folds, their spread, and the work that they took."""

import statistics
from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np

from jaxekf._support.deprecations import warn_renamed
from jaxekf.estimation.parameters import leaves_by_name
from jaxekf.evaluation.spread import Spread, spread_of
from jaxekf.recordings.types import Floats
from tuning.results.comparison import Row, as_dicts, by_variant
from tuning.results.fitted import Fitted
from tuning.results.searched import Searched
from tuning.results.tuned import Tuned

COLUMNS = tuple(name for name in Row._fields if name not in ("run", "variant"))


class Work(NamedTuple):
    """Number of filterings of all training runs.

    Examples
    --------
    >>> import tuning
    >>> tuning.Work(filterings=5.0, gradients=10.0).forward(gradient_cost=3.0)
    35.0
    """

    filterings: float
    """Filterings without a gradient: values, Fisher information (two for each number and one), the scale,
    and validation runs by their share of the rows."""
    gradients: float
    """Filterings with the gradient of the objective."""

    def forward(self, gradient_cost: float) -> float:
        """Total in filterings without a gradient; one with a gradient counts as `gradient_cost`."""
        return self.filterings + (gradient_cost * self.gradients if self.gradients else 0.0)


def work_of(fitted: Fitted) -> Work:
    """Work of a tuning or a search; zero for parameters that were not searched for."""
    if isinstance(fitted, Tuned):
        return Work(float(fitted.filterings), float(fitted.evaluations))
    return Work(float(fitted.filterings) if isinstance(fitted, Searched) else 0.0, 0.0)


class Fold(NamedTuple):
    """One tuning, and the runs that it did not learn from.

    Examples
    --------
    >>> import jaxekf, tuning
    >>> jaxekf.set_up()
    >>> runs = jaxekf.demo.paths(("free-1", "free-2"))
    >>> problem = {"objective": "likelihood", "free": ["noise.optical"], "iterations": 2}
    >>> first = tuning.cross_validate(runs, **problem).folds[0]
    >>> first.held_out, first.tuned.origin["runs"], first.work["tuned"].gradients
    (('free-1',), ['free-2'], 2.0)
    """

    held_out: tuple[str, ...]
    """Names of runs."""
    tuned: Tuned
    baselines: Mapping[str, Fitted] = MappingProxyType({})
    """Baselines on the same training runs, by variant."""

    @property
    def beside(self) -> Mapping[str, Fitted]:
        """Deprecated: `baselines`."""
        warn_renamed("Fold.beside", "Fold.baselines")
        return self.baselines

    @property
    def work(self) -> dict[str, Work]:
        """Work of each variant, by its name."""
        every = {**self.baselines, "tuned": self.tuned}
        return {"start": Work(0.0, 0.0)} | {name: work_of(one) for name, one in every.items()}


class ParameterSpread(NamedTuple):
    """Values of one parameter over the folds, in its unit.

    Examples
    --------
    >>> import jaxekf, tuning
    >>> jaxekf.set_up()
    >>> runs = jaxekf.demo.paths(("free-1", "free-2"))
    >>> problem = {"objective": "likelihood", "free": ["noise.optical"], "iterations": 2}
    >>> optical = tuning.cross_validate(runs, **problem).parameters["noise.optical"]
    >>> optical.each.shape, f"{optical.mean:.4f} rad", bool(optical.deviation < 0.1 * optical.mean)
    ((2,), '0.0052 rad', True)
    """

    start: Floats
    """In the parameter's shape."""
    mean: Floats
    deviation: Floats
    """Standard deviation of a fold, by n - 1. Two folds share most of their runs; tunings on independent
    runs would differ by more."""
    each: Floats
    """(folds, ...)"""


@dataclass(frozen=True)
class CrossValidation:
    """Result of `tuning.cross_validate`.

    Examples
    --------
    >>> import jaxekf, tuning
    >>> jaxekf.set_up()
    >>> runs = jaxekf.demo.paths(("free-1", "free-2"))
    >>> problem = {"objective": "likelihood", "free": ["noise.optical"], "iterations": 2}
    >>> found = tuning.cross_validate(runs, **problem)
    >>> {name: round(spread.mean, 2) for name, spread in found.spread("attitude_rmse_deg").items()}
    {'hold last': 8.38, 'start': 0.1, 'tuned': 0.1}
    """

    rows: list[Row]
    """Rows of each held-out run in the order given: `hold last`, `start`, and its fold's baselines and
    `tuned`."""
    folds: tuple[Fold, ...]
    gradient_cost: float = float("nan")
    """Time of the objective with its gradient as a multiple of the time without; NaN without baselines."""

    @property
    def work(self) -> dict[str, Work]:
        """Work of each variant by its name, the mean over the folds."""
        each = [fold.work for fold in self.folds]
        names = each[0] if each else ()
        mean = statistics.fmean
        return {
            name: Work(*map(mean, zip(*(w[name] for w in each), strict=True))) for name in names
        }

    @property
    def forward(self) -> dict[str, float]:
        """`work` in filterings of all training runs without a gradient; empty without baselines."""
        if np.isnan(self.gradient_cost):
            return {}
        return {name: work.forward(self.gradient_cost) for name, work in self.work.items()}

    def spread(self, column: str = "attitude_rmse_deg") -> dict[str, Spread]:
        """Statistics of one of `COLUMNS` over the runs, by variant."""
        columns = by_variant(self.rows, column)
        return {name: spread_of(values, column) for name, values in columns.items()}

    @property
    def parameters(self) -> dict[str, ParameterSpread]:
        """Free parameters over the folds by name; the fold's mean where each run has its own."""
        tuned, found = self.folds[0].tuned, {}
        values = [leaves_by_name(fold.tuned.params) for fold in self.folds]
        start = leaves_by_name(tuned.start._replace(truth=()))
        for name in (leaf.name for leaf in tuned.layout.leaves):
            if name in start:
                each = np.stack([np.asarray(value[name], float) for value in values])
                deviation, first = each.std(axis=0, ddof=1), np.asarray(start[name], float)
                found[name] = ParameterSpread(first, each.mean(axis=0), deviation, each)
        return found

    def as_dict(self) -> dict[str, Any]:
        """Contents for JSON: rows, statistics over the runs, parameters of each fold in SI units, and work.

        The cost of a gradient is measured by the clock and differs from time to time.
        """
        by_column = {column: self.spread(column) for column in COLUMNS}
        return {
            "rows": as_dicts(self.rows),
            "spread": {
                variant: {column: spread[variant]._asdict() for column, spread in by_column.items()}
                for variant in dict.fromkeys(row.variant for row in self.rows)
            },
            "held_out": [list(fold.held_out) for fold in self.folds],
            "parameters": {
                name: {key: np.asarray(value).tolist() for key, value in spread._asdict().items()}
                for name, spread in self.parameters.items()
            },
            "work": {
                "gradient_cost": None if np.isnan(self.gradient_cost) else self.gradient_cost,
                "mean": {
                    name: {**work._asdict(), "forward": self.forward.get(name)}
                    for name, work in self.work.items()
                },
            },
        }
