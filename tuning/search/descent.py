"""The tuner's loop: step, judge on runs that are not learnt from, keep the best, and go on after a stop."""

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from functools import cached_property, partial
from typing import Any, NamedTuple

import jax
import numpy as np
import optax
from jax import Array

from jaxekf._support.compilation import jit
from jaxekf._support.errors import TuningError
from jaxekf.filtering.model import Model, Parameters
from jaxekf.recordings.types import Flags, Floats
from tuning.objective.data import Data
from tuning.objective.data import on_host as data_on_host
from tuning.objective.fisher_information import Information, information, of_runs
from tuning.objective.objectives import Objective, count, evaluate_each, visible_rows, weights_of
from tuning.parametrisation.free_vector import Layout
from tuning.search._line_search import Walk

_IMPROVEMENT = 1e-4
_LEAST_EVIDENCE = 3e-3
"""A gain of log-likelihood, of all rows together, that is not worth another step."""
_OWN_STEPS = 2
"""Steps of Fisher scoring on a held-out run's own parameters each time it judges."""


class Iteration(NamedTuple):
    """One step of the tuner."""

    number: int
    training: float
    validation: float
    """NaN without validation runs."""
    rejected: bool
    """The objective or its gradient was not finite; the step was shortened."""


Progress = Callable[[Iteration, int], None]


class Best(NamedTuple):
    """The best so far."""

    free: Any
    step: Iteration


def evaluate_at(
    model: Model,
    objective: Objective,
    where: Layout,
    free: Array,
    base: Parameters,
    data: Data,
    counts: dict[str, Array],
) -> Array:
    """The objective of a group's runs at a free vector."""
    every = where.of_runs(where.from_free(free, base), data.setup, data.place)
    return evaluate_each(model, objective, every, data, counts)


_value = jit(evaluate_at, static_argnums=(0, 1, 2))
_value_and_gradient = jit(jax.value_and_grad(evaluate_at, 3), static_argnums=(0, 1, 2))


@partial(jit, static_argnums=(0, 1, 2))
def _values_and_gradients(
    model: Model, objective: Objective, where: Layout, free: Array, *given: Any
) -> tuple[Array, Array]:
    """The same at several points (points, n): all runs at all of them side by side."""
    point = jax.value_and_grad(partial(evaluate_at, model, objective, where))
    return jax.vmap(lambda each: point(each, *given))(free)


def on_host(free: Any) -> Any:
    """The vector without its place: a gradient comes back shared among the devices, and a point found
    from it would be another argument to compile for."""
    return np.asarray(free)


def total_counts(groups: Sequence[Data], objective: Objective) -> dict[str, Any]:
    """What each term of the objective is the mean over, of all groups together."""
    found = [count(data_on_host(data), tuple(weights_of(objective))) for data in groups]
    return {name: sum((f[name] for f in found), np.zeros((), int)) for name in found[0]}


def _visible(groups: Sequence[Data]) -> int:
    """Measured rows of all groups."""
    return sum(int(visible_rows(data_on_host(data))) for data in groups)


@dataclass
class Descent:
    """The optimiser's loop and what it works on."""

    model: Model
    objective: Objective
    layout: Layout
    base: Parameters
    training: tuple[Data, ...]
    validation: tuple[Data, ...] | None
    iterations: int
    """At most."""
    optimiser: optax.GradientTransformation | None = None
    fisher: bool = False
    """Whether steps are those of Fisher scoring; for an objective of likelihood and prior."""
    keep: Callable[[dict[str, Any]], None] | None = None
    """Called after each step with all that the loop goes on from."""
    width: int = 1
    """Points that are evaluated side by side, so that one program serves for one and for many."""
    fixed: Flags = field(default_factory=lambda: np.zeros(0, bool))
    """(n,) numbers that stay at their start."""
    best: Best | None = None
    history: list[Iteration] = field(default_factory=list)
    evaluations: int = 0
    """Of the objective with its gradient; Fisher scoring takes none."""
    stopped: str = ""
    """Why it stopped; empty before it did."""
    filterings: float = 0.0
    """Of all training runs, without a gradient: for Fisher information, and of validation runs by their
    share of the rows."""

    def __post_init__(self) -> None:
        self.start = on_host(self.layout.to_free(self.base))
        if not self.fixed.size:
            self.fixed = np.zeros(len(self.start), bool)
        self.walk = self._walk(self.start)
        self.since = 0
        self.own_free: Floats | None = None
        self.fallback: Best | None = None
        self._known: Information | None = None

    @cached_property
    def training_counts(self) -> dict[str, Any]:
        """What the terms are the means over."""
        return total_counts(self.training, self.objective)

    @cached_property
    def validation_counts(self) -> dict[str, Any]:
        """The same of the validation runs."""
        return total_counts(self.validation or (), self.objective)

    @cached_property
    def _rows(self) -> int:
        """Measured rows of the training runs."""
        return max(_visible(self.training), 1)

    @property
    def information_cost(self) -> int:
        """Filterings of all training runs that Fisher information takes."""
        return 2 * len(self.layout.of_one_run().prior) + 1

    @cached_property
    def _judging_cost(self) -> float:
        """Filterings of all training runs that as many rows are as the validation runs take."""
        rows = _visible(self.validation or ())
        own = len(self.layout.own_of_one_run)
        return (1 + (_OWN_STEPS * (2 * own + 1) if own else 0)) * rows / self._rows

    def _walk(self, free: Any) -> Walk:
        # Of a likelihood a small part of the mean would be a large part of what tells parameters apart.
        likely = self.objective.likelihood + self.objective.truth
        least = _LEAST_EVIDENCE * likely / self._rows if likely else None
        direction = self._scoring if self.fisher else None
        return Walk(on_host(free), self.optimiser, least, direction)

    def _scoring(self, free: Floats, gradient: Floats) -> Floats:
        """The step of Fisher scoring: down the gradient by the inverse of the expected curvature."""
        # A direction is asked for only where value and score were taken just before.
        assert self._known is not None and np.array_equal(self._known.free, on_host(free))
        curved = self.objective.likelihood * self._known.matrix
        curved = curved + self.objective.prior * np.diag(self.layout.prior**-2.0)
        # Where nothing is known, and no prior counts, a step is short rather than endless.
        curved = curved + np.diag(1e-3 * self.layout.prior**-2.0)
        moving = np.flatnonzero(~self.fixed)
        step = np.zeros(len(gradient))
        down = -self._rows * gradient[moving]
        step[moving] = np.linalg.solve(curved[np.ix_(moving, moving)], down)
        return step

    def value_and_gradient(self, free: Any) -> tuple[float, Floats]:
        """The objective of the training runs, prior included."""
        plain = on_host(free)
        if self.fisher:
            return self._value_and_score(plain)
        if self.width > 1:
            return self.completed(plain, *self.plain_values_and_gradients([plain])[0])
        given = self.model, self.objective, self.layout, plain, self.base
        found = [_value_and_gradient(*given, data, self.training_counts) for data in self.training]
        gradient = sum((np.asarray(gradient) for _, gradient in found), np.zeros(plain.shape))
        return self.completed(plain, sum(float(value) for value, _ in found), gradient)

    def _value_and_score(self, free: Floats) -> tuple[float, Floats]:
        """The same by the filter alone, from the runs of it that the curvature takes anyway: the gradient
        of a large model takes the compiler longer than all the steps of Fisher scoring."""
        value = self.value(free)
        self.filterings += 1
        if not np.isfinite(value):
            return value, np.zeros(len(free))
        self._known = information(self.model, self.layout, free, self.base, self.training)
        self.filterings += self.information_cost
        slope = -self.objective.likelihood * self._known.score / self._rows
        slope = np.where(self.fixed, 0.0, slope + self._prior(free)[1])
        return value, slope

    def plain_values_and_gradients(self, points: Sequence[Floats]) -> list[tuple[float, Floats]]:
        """Of up to `width` points at once, without the prior."""
        filled = [*points, *[points[-1]] * (self.width - len(points))]
        given = self.model, self.objective, self.layout, np.stack(filled), self.base
        found = [
            _values_and_gradients(*given, data, self.training_counts) for data in self.training
        ]
        values = sum((np.asarray(value) for value, _ in found), np.zeros(self.width))
        gradients = sum((np.asarray(slope) for _, slope in found), np.zeros(given[3].shape))
        return [(float(values[i]), gradients[i]) for i in range(len(points))]

    def completed(self, free: Floats, value: float, gradient: Floats) -> tuple[float, Floats]:
        """Value and gradient of the runs with those of the prior, and none along what is fixed."""
        self.evaluations += 1
        prior, slope = self._prior(free)
        return value + prior, np.where(self.fixed, 0.0, gradient + slope)

    def value(self, free: Any) -> float:
        """The objective of the training runs, prior included: one filtering of all of them."""
        plain = on_host(free)
        given = self.model, self.objective, self.layout, plain, self.base
        found = [float(_value(*given, data, self.training_counts)) for data in self.training]
        return sum(found) + self._prior(plain)[0]

    def _prior(self, free: Floats) -> tuple[float, Floats]:
        """What the prior adds to the objective, and its gradient."""
        weight = self.objective.prior / self._rows
        off = (free - self.start) / self.layout.prior
        return 0.5 * weight * float(off @ off), weight * off / self.layout.prior

    def validation_value(self, free: Any) -> float:
        """The objective of the validation runs; their own parameters come from their innovations."""
        if self.validation is None:
            return float("nan")
        self.filterings += self._judging_cost
        counts, where, plain = self.validation_counts, self.layout, on_host(free)
        if where.own:
            where, plain = self._with_own(plain)
        given = self.model, self.objective, where, plain, self.base
        return sum(float(_value(*given, data, counts)) for data in self.validation)

    def _with_own(self, free: Any) -> tuple[Layout, Floats]:
        """The layout of the validation runs and a vector with their own parameters, a little nearer to the
        most probable ones than the last time."""
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

    def run(self, patience: int, progress: Progress | None) -> str:
        """Step until done; why it stopped."""
        try:
            self.stopped = self.stopped or self._step(patience, progress)
        except KeyboardInterrupt:
            self.interrupt()
        return self.stopped

    def interrupt(self) -> None:
        """Stop with the best so far; raises `KeyboardInterrupt` where there is none."""
        self.best = self.best or self.fallback
        if self.best is None:
            raise KeyboardInterrupt
        self.stopped = "interrupted; the best so far is kept"

    def warm(
        self,
        steps: int,
        keep: Callable[[dict[str, Any]], None] | None = None,
        kept: dict[str, Any] | None = None,
    ) -> None:
        """Begin not at the start but where some steps of Fisher scoring on the likelihood lead from there.

        Errors are flat, or rise, far from their minimum where the likelihood still falls towards its own.
        `keep` is called after each step with what these steps go on from, when it is given as `kept`.
        """
        aim = Objective(likelihood=1.0, prior=1.0)
        given = (self.model, aim, self.layout, self.base, self.training, None, steps)
        other = Descent(*given, fisher=True, width=self.width)
        other.begin_at(self.walk.candidate)
        other.keep = keep
        if kept:
            other.restore(kept)
        other.run(steps, None)
        if "interrupted" in other.stopped:
            raise KeyboardInterrupt
        assert other.best is not None
        self.begin_at(other.best.free)
        self.evaluations += other.evaluations
        self.filterings += other.filterings

    def begin_at(self, free: Any) -> None:
        """Begin elsewhere than at the start, about which the prior stays."""
        self.walk = self._walk(free)

    def again(self, fixed: Flags) -> None:
        """Go on from the best with more numbers held at their start, judged anew."""
        assert self.best is not None
        self.fixed = fixed
        free = np.where(fixed, self.start, on_host(self.best.free))
        self.walk = self._walk(free)
        self.fallback = self.best._replace(free=free)
        self.best, self.since = None, len(self.history)
        self.stopped = ""
        # Enough to come back from the start of a few numbers.
        self.iterations = max(self.iterations, len(self.history) + 10)

    def _step(self, patience: int, progress: Progress | None) -> str:
        while len(self.history) < self.iterations:
            if not self.history and not self.fisher and self.validation is not None:
                value, gradient, held = self._first()
            else:
                value, gradient = self.value_and_gradient(self.walk.candidate)
                held = None
            if reason := self.advance(value, gradient, patience, progress, held):
                return reason
            if self.keep is not None:
                self.keep(self.state_dict())
        if self.best is None:
            raise TuningError(
                f"got {self.iterations} iterations, expected at least one; ask for more"
            )
        return self.all_done

    def _first(self) -> tuple[float, Floats, float]:
        """Value, gradient and validation value of the first candidate, side by side: most of the time is
        taken by the compiler, which can work on both programs at once."""
        plain = on_host(self.walk.candidate)
        given = self.model, self.objective, self.layout, plain, self.base
        if self.width == 1:
            for data in self.training:
                # Traced before the other thread begins, so that the compiler begins with the larger one.
                _value_and_gradient.lower(*given, data, self.training_counts)
        with ThreadPoolExecutor(1) as beside:
            held = beside.submit(self.validation_value, self.walk.candidate)
            value, gradient = self.value_and_gradient(self.walk.candidate)
            return value, gradient, held.result()

    @property
    def all_done(self) -> str:
        """The reason to stop after the last iteration."""
        return f"the {self.iterations} iterations asked for are done"

    def advance(
        self,
        value: float,
        gradient: Floats,
        patience: int,
        progress: Progress | None,
        held: float | None = None,
    ) -> str:
        """Judge the candidate, which has this value and gradient, and choose the next; a reason to stop, or
        nothing. `held` is its validation value where that is known."""
        finite = np.isfinite(value) and bool(np.all(np.isfinite(gradient)))
        if not finite:
            held = float("nan")
        elif held is None:
            held = self.validation_value(self.walk.candidate)
        step = Iteration(len(self.history), value, held, not finite)
        self.record(step, self.walk.candidate, progress)
        if step.number - self.since >= patience:
            return f"no improvement in {patience} iterations"
        return self.walk.move(value, gradient, bool(finite))

    def record(self, step: Iteration, free: Any, progress: Progress | None) -> None:
        """Put a step down, and keep where it was if it is the best."""
        self.history.append(step)
        if progress is not None:
            progress(step, self.iterations)
        self._judge(step, free)

    def _judge(self, step: Iteration, free: Any) -> None:
        """Keep the step if it is the best."""
        judged = self.judged(step)
        before = float("inf") if self.best is None else self.judged(self.best.step)
        if not step.rejected and judged < before:
            least = self.walk.least
            if judged < before - (_IMPROVEMENT * abs(judged) if least is None else least):
                self.since = step.number
            self.best = Best(on_host(free), step)
        if self.best is None:
            raise TuningError(
                f"got an objective of {judged} or a gradient that is not finite at the start,"
                " expected finite ones; start from other noise or check the data"
            )

    def judged(self, step: Iteration) -> float:
        """By what a step is the best: validation where there is any."""
        return step.training if self.validation is None else step.validation

    def state_dict(self) -> dict[str, Any]:
        """All that the loop goes on from, as arrays by name."""
        assert self.best is not None
        found = {f"walk_{name}": value for name, value in self.walk.state_dict().items()}
        found |= {
            "history": np.array(self.history, float),
            "best_free": np.asarray(self.best.free),
            "best_number": np.array(self.best.step.number),
            "since": np.array(self.since),
            "iterations": np.array(self.iterations),
            "evaluations": np.array(self.evaluations),
            "filterings": np.array(self.filterings),
            "fixed": self.fixed,
            "stopped": np.array(self.stopped),
        }
        if self.own_free is not None:
            found["own_free"] = np.asarray(self.own_free)
        return found

    def beginning(self) -> dict[str, Any]:
        """Where a search that has not begun is to begin, and the work that it took to come there."""
        return {
            "begin": on_host(self.walk.candidate),
            "evaluations": np.array(self.evaluations),
            "filterings": np.array(self.filterings),
        }

    def restore(self, kept: dict[str, Any]) -> None:
        """Go on from where `state_dict` or `beginning` was taken."""
        self.evaluations = int(kept["evaluations"])
        self.filterings = float(kept["filterings"])
        if "begin" in kept:
            self.begin_at(kept["begin"])
            return
        self.fixed = np.asarray(kept["fixed"], bool)
        self.walk.restore({k.removeprefix("walk_"): v for k, v in kept.items()})
        self.history = [
            Iteration(int(n), float(t), float(v), bool(r)) for n, t, v, r in kept["history"]
        ]
        self.best = Best(kept["best_free"], self.history[int(kept["best_number"])])
        self.since = int(kept["since"])
        self.iterations = int(kept["iterations"])
        self.own_free = kept.get("own_free")
        self.stopped = str(kept["stopped"])


def own_step(
    model: Model,
    where: Layout,
    free: Floats,
    centre: Floats,
    base: Parameters,
    groups: Sequence[Data],
) -> Floats:
    """A step of Fisher scoring on what each run has of its own, by its innovations and the prior about
    `centre`; what is shared stays."""
    own = where.own_of_one_run
    prior = where.of_one_run().prior[own] ** -2.0
    found = free.copy()
    for data in groups:
        index = where.index(np.asarray(data.place))
        matrix, slope = of_runs(model, where, free[index], base, data, own)
        at = index[:, own]
        slope = slope - prior * (free[at] - centre[at])
        step = np.linalg.solve(matrix + np.diag(prior), slope[..., None])[..., 0]
        # Not farther than a prior's deviation at once: far from the answer the model is not linear.
        longest = np.max(np.abs(step) * np.sqrt(prior), axis=1, keepdims=True)
        found[at] = free[at] + step / np.maximum(longest, 1.0)
    return found
