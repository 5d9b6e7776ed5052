"""The objective of training and validation runs as a function of the free vector, and the work it takes."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property, partial
from typing import Any

import jax
import numpy as np
from jax import Array

from jaxekf._support.compilation import jit
from jaxekf.filtering.model import Model, Parameters
from jaxekf.recordings.types import Flags, Floats
from tuning.objective.data import Data
from tuning.objective.data import on_host as data_on_host
from tuning.objective.fisher_information import Information, information, of_runs
from tuning.objective.objectives import Objective, count, evaluate_each, visible_rows, weights_of
from tuning.parametrisation.free_vector import Layout

_OWN_STEPS = 2
"""Steps of Fisher scoring on a validation run's own parameters at each evaluation."""


def evaluate_at(
    model: Model,
    objective: Objective,
    where: Layout,
    free: Array,
    base: Parameters,
    data: Data,
    counts: dict[str, Array],
) -> Array:
    """Objective of a group's runs at a free vector (n,)."""
    every = where.of_runs(where.from_free(free, base), data.setup, data.place)
    return evaluate_each(model, objective, every, data, counts)


_value = jit(evaluate_at, static_argnums=(0, 1, 2))
_value_and_gradient = jit(jax.value_and_grad(evaluate_at, 3), static_argnums=(0, 1, 2))


@partial(jit, static_argnums=(0, 1, 2))
def _values_and_gradients(
    model: Model, objective: Objective, where: Layout, free: Array, *given: Any
) -> tuple[Array, Array]:
    """Values and gradients at several points (points, n), in one program."""
    point = jax.value_and_grad(partial(evaluate_at, model, objective, where))
    return jax.vmap(lambda each: point(each, *given))(free)


def on_host(free: Any) -> Any:
    """The vector without its device: a gradient comes back sharded among the devices, and a point computed
    from it would be another argument to compile for."""
    return np.asarray(free)


def total_counts(groups: Sequence[Data], objective: Objective) -> dict[str, Any]:
    """Number of samples that each term of the objective is the mean over, in all groups together."""
    found = [count(data_on_host(data), tuple(weights_of(objective))) for data in groups]
    return {name: sum((f[name] for f in found), np.zeros((), int)) for name in found[0]}


def _row_count(groups: Sequence[Data]) -> int:
    return sum(int(visible_rows(data_on_host(data))) for data in groups)


@dataclass
class Evaluation:
    """A tuning problem, and its objective at any free vector (n,), prior included."""

    model: Model
    objective: Objective
    layout: Layout
    base: Parameters
    training: tuple[Data, ...]
    validation: tuple[Data, ...] | None
    width: int = field(default=1, kw_only=True)
    """Points that are evaluated at once, so that one program serves one start and several."""
    fixed: Flags = field(default_factory=lambda: np.zeros(0, bool), kw_only=True)
    """(n,) numbers that keep their initial values."""
    evaluations: int = field(default=0, kw_only=True)
    """Evaluations of the objective with its gradient; Fisher scoring takes none."""
    filterings: float = field(default=0.0, kw_only=True)
    """Filterings of all training runs without a gradient: for Fisher information, and for validation runs
    by their share of the rows."""

    def __post_init__(self) -> None:
        self.start = on_host(self.layout.to_free(self.base))
        if not self.fixed.size:
            self.fixed = np.zeros(len(self.start), bool)
        self.own_free: Floats | None = None
        self._known: Information | None = None

    @cached_property
    def training_counts(self) -> dict[str, Any]:
        """Number of samples that each term is the mean over, in the training runs."""
        return total_counts(self.training, self.objective)

    @cached_property
    def validation_counts(self) -> dict[str, Any]:
        """Number of samples that each term is the mean over, in the validation runs."""
        return total_counts(self.validation or (), self.objective)

    @cached_property
    def rows(self) -> int:
        """Measured rows of the training runs."""
        return max(_row_count(self.training), 1)

    @property
    def information_cost(self) -> int:
        """Filterings of all training runs that Fisher information takes."""
        return 2 * len(self.layout.of_one_run().prior) + 1

    @cached_property
    def _validation_cost(self) -> float:
        """Work of one validation, in filterings of all training runs."""
        own = len(self.layout.own_of_one_run)
        each = 1 + (_OWN_STEPS * (2 * own + 1) if own else 0)
        return each * _row_count(self.validation or ()) / self.rows

    def value(self, free: Any) -> float:
        """Objective of the training runs: one filtering of all of them."""
        plain = on_host(free)
        value = self._sum(self.training, self.training_counts, self.layout, plain)
        return value + self.prior(plain)[0]

    def _sum(self, groups: Sequence[Data], counts: Any, where: Layout, free: Floats) -> float:
        given = self.model, self.objective, where, free, self.base
        return sum(float(_value(*given, data, counts)) for data in groups)

    def value_and_gradient(self, free: Any) -> tuple[float, Floats]:
        """Objective of the training runs and its gradient (n,)."""
        plain = on_host(free)
        if self.width > 1:
            return self.completed(plain, *self.plain_values_and_gradients([plain])[0])
        given = self.model, self.objective, self.layout, plain, self.base
        found = [_value_and_gradient(*given, data, self.training_counts) for data in self.training]
        gradient = sum((np.asarray(gradient) for _, gradient in found), np.zeros(plain.shape))
        return self.completed(plain, sum(float(value) for value, _ in found), gradient)

    def trace_gradient(self, free: Floats) -> None:
        """Trace the program of `value_and_gradient` without compiling it."""
        given = self.model, self.objective, self.layout, on_host(free), self.base
        for data in self.training if self.width == 1 else ():
            _value_and_gradient.lower(*given, data, self.training_counts)

    def plain_values_and_gradients(self, points: Sequence[Floats]) -> list[tuple[float, Floats]]:
        """Values and gradients at up to `width` points at once, without the prior."""
        filled = [*points, *[points[-1]] * (self.width - len(points))]
        given = self.model, self.objective, self.layout, np.stack(filled), self.base
        found = [
            _values_and_gradients(*given, data, self.training_counts) for data in self.training
        ]
        values = sum((np.asarray(value) for value, _ in found), np.zeros(self.width))
        gradients = sum((np.asarray(slope) for _, slope in found), np.zeros(given[3].shape))
        return [(float(values[i]), gradients[i]) for i in range(len(points))]

    def completed(self, free: Floats, value: float, gradient: Floats) -> tuple[float, Floats]:
        """Value and gradient of the runs plus those of the prior; zero along fixed numbers."""
        self.evaluations += 1
        prior, slope = self.prior(free)
        return value + prior, np.where(self.fixed, 0.0, gradient + slope)

    def value_and_score(self, free: Any) -> tuple[float, Floats]:
        """`value_and_gradient` by the filter alone, from the filterings that Fisher information takes.

        The gradient of a large model takes the compiler longer than all steps of Fisher scoring.
        """
        plain = on_host(free)
        value = self.value(plain)
        self.filterings += 1
        if not np.isfinite(value):
            return value, np.zeros(len(plain))
        self._known = information(self.model, self.layout, plain, self.base, self.training)
        self.filterings += self.information_cost
        slope = -self.objective.likelihood * self._known.score / self.rows
        return value, np.where(self.fixed, 0.0, slope + self.prior(plain)[1])

    def scoring_step(self, free: Floats, gradient: Floats) -> Floats:
        """Step (n,) of Fisher scoring: down the gradient by the inverse of the expected curvature."""
        # A step is asked for only at the point of the last `value_and_score`.
        assert self._known is not None and np.array_equal(self._known.free, on_host(free))
        curved = self.objective.likelihood * self._known.matrix
        curved = curved + self.objective.prior * np.diag(self.layout.prior**-2.0)
        # Without information and without a prior the step stays short.
        curved = curved + np.diag(1e-3 * self.layout.prior**-2.0)
        moving = np.flatnonzero(~self.fixed)
        step = np.zeros(len(gradient))
        down = -self.rows * gradient[moving]
        step[moving] = np.linalg.solve(curved[np.ix_(moving, moving)], down)
        return step

    def prior(self, free: Floats) -> tuple[float, Floats]:
        """Share of the prior in the objective, and its gradient (n,)."""
        weight = self.objective.prior / self.rows
        off = (free - self.start) / self.layout.prior
        return 0.5 * weight * float(off @ off), weight * off / self.layout.prior

    def validation_value(self, free: Any) -> float:
        """Objective of the validation runs; their own parameters come from their innovations."""
        if self.validation is None:
            return float("nan")
        self.filterings += self._validation_cost
        where, plain = self.layout, on_host(free)
        if where.own:
            where, plain = self._with_own(plain)
        return self._sum(self.validation, self.validation_counts, where, plain)

    def _with_own(self, free: Any) -> tuple[Layout, Floats]:
        """Layout of the validation runs, and a vector with their own parameters; each call brings these
        nearer to the most probable ones."""
        assert self.validation is not None
        total = sum(len(data.place) for data in self.validation)
        where = self.layout.for_runs_number(total)
        params = self.layout.together(self.layout.from_free(free, self.base))
        plain = np.array(where.to_free(params))
        own = where.is_own
        if self.own_free is not None:
            plain[own] = self.own_free
        centre = on_host(where.to_free(params))
        for _ in range(_OWN_STEPS):
            plain = own_step(self.model, where, plain, centre, self.base, self.validation)
        self.own_free = plain[own]
        return where, plain


def own_step(
    model: Model,
    where: Layout,
    free: Floats,
    centre: Floats,
    base: Parameters,
    groups: Sequence[Data],
) -> Floats:
    """A step of Fisher scoring on the parameters that each run has for itself, by its innovations and the
    prior about `centre`; shared parameters are kept."""
    own = where.own_of_one_run
    prior = where.of_one_run().prior[own] ** -2.0
    found = free.copy()
    for data in groups:
        index = where.index(np.asarray(data.place))
        matrix, slope = of_runs(model, where, free[index], base, data, own)
        at = index[:, own]
        slope = slope - prior * (free[at] - centre[at])
        step = np.linalg.solve(matrix + np.diag(prior), slope[..., None])[..., 0]
        # At most one prior deviation: farther from the minimum the model is not linear.
        longest = np.max(np.abs(step) * np.sqrt(prior), axis=1, keepdims=True)
        found[at] = free[at] + step / np.maximum(longest, 1.0)
    return found
