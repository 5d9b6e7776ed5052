"""Adam on minibatches of runs, for many recorded runs."""

import time
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import jax
import numpy as np
import optax
from jax import Array

from jaxekf._support.compilation import jit
from jaxekf.filtering.model import Model, Parameters
from jaxekf.recordings.types import Floats
from tuning.objective.data import Data
from tuning.objective.objectives import Objective
from tuning.parametrisation.free_vector import Layout
from tuning.results.tuned import Iteration, Progress
from tuning.search._line_search import arrays_of, tree_of
from tuning.search.descent import Descent
from tuning.search.evaluation import evaluate_at, on_host

RATE = 0.1
"""Initial rate of Adam: about the change of each free number in a step, a tenth of an e-fold."""
_STALE = 2
"""Passes without improvement after which the rate is halved."""
_LEAST_RATE = 1e-3
"""Share of the initial rate at which the search has converged."""
_STATE = ("free", "rate", "skipped", "halved", "done")
KEEP_S = 20.0
"""Seconds between checkpoints within a pass."""


def _batch_value(
    model: Model,
    objective: Objective,
    where: Layout,
    free: Array,
    base: Parameters,
    data: Data,
    batch: "Batch",
    counts: dict[str, Array],
) -> Array:
    """Share of a batch in the objective of all runs."""
    some = jax.tree.map(lambda leaf: leaf[batch.chosen], data)
    fresh = batch.fresh[:, None, None]
    truth = {name: one._replace(judged=one.judged & fresh) for name, one in some.truth.items()}
    some = some._replace(truth=truth, counted=some.counted & fresh)
    return evaluate_at(model, objective, where, free, base, some, counts)


_gradient = partial(jit, static_argnums=(0, 1, 2))(jax.grad(_batch_value, 3))


class Batch(NamedTuple):
    """Runs of a step."""

    chosen: Any
    """(size,) places in the group."""
    fresh: Any
    """(size,) False for a run that only fills the batch."""


_ADAM = optax.scale_by_adam()
_adam_begin, _adam_step = jax.jit(_ADAM.init), jax.jit(_ADAM.update)


@dataclass
class MinibatchDescent(Descent):
    """A search by Adam in which an iteration is a pass over all runs, some at a time.

    After each pass the objective of all runs is evaluated without its gradient. By it, or by validation,
    the best is kept, and the rate is halved when it no longer falls.
    """

    size: int = 16
    """Largest number of runs of a step."""
    seed: int = 0
    """Seed of the order of the runs."""

    def __post_init__(self) -> None:
        super().__post_init__()
        self._begin(self.start, RATE)
        self.halved = self.done = 0

    def begin_at(self, free: Any) -> None:
        """Begin at another point than the start; the prior stays about the start."""
        super().begin_at(free)
        self._begin(on_host(free), self.rate)

    def _begin(self, free: Floats, rate: float) -> None:
        """Begin a pass here, without Adam's moments of earlier ones."""
        self.free, self.rate, self.skipped = np.asarray(free), rate, 0
        self.memory = _adam_begin(self.free)

    def restart(self, fixed: Any) -> None:
        """Go on from the best with more numbers fixed at their initial values."""
        super().restart(fixed)
        assert self.fallback is not None
        self._begin(self.fallback.free, RATE)
        self.halved = len(self.history)

    def probe(self, free: Any) -> float:
        """Objective of all runs at a point of no search."""
        self.filterings += 1
        return self.value(free)

    def _step(self, patience: int, progress: Progress | None) -> str:
        while len(self.history) < self.iterations or self.done:
            # With steps done it goes on in the middle of a pass, whose start is validated already.
            if not self.done and (reason := self._validate(patience, progress)):
                return reason
            self._pass(len(self.history) - 1)
            if self.keep is not None:
                self.keep(self.state_dict())
        return self.all_done if self.best is not None else super()._step(patience, progress)

    def _validate(self, patience: int, progress: Progress | None) -> str:
        """Validate the end of a pass and choose the rate of the next; return a reason to stop or ''."""
        value = float("nan") if self.skipped else self.value(self.free)
        self.filterings += not self.skipped
        finite = bool(np.isfinite(value))
        held = self.validation_value(self.free) if finite else float("nan")
        step = Iteration(len(self.history), value, held, not finite)
        self.record(step, self.free, progress)
        if step.number - self.last_improvement >= patience:
            return f"no improvement in {patience} iterations"
        assert self.best is not None
        if not finite:
            self._begin(self.best.free, 0.25 * self.rate)
        elif step.number - max(self.last_improvement, self.halved) >= _STALE:
            self.halved = step.number
            self._begin(self.best.free, 0.5 * self.rate)
        return "converged" if self.rate < _LEAST_RATE * RATE else ""

    def _pass(self, number: int) -> None:
        """Take a step for each batch, in an order given by the seed and the number of the pass."""
        rng = np.random.default_rng([self.seed, number])
        batches = [(data, batch) for data in self.training for batch in cut(data, self.size, rng)]
        order, kept = rng.permutation(len(batches)), time.monotonic()
        for i in order[self.done :]:
            data, batch = batches[i]
            slope = self.slope(data, batch, len(batches))
            if not np.isfinite(slope).all():
                self.skipped, self.done = 1, 0
                return
            change, self.memory = _adam_step(slope, self.memory)
            self.free = self.free - self.rate * np.asarray(change)
            self.done += 1
            if self.keep is not None and time.monotonic() - kept > KEEP_S:
                self.keep(self.state_dict())
                kept = time.monotonic()
        self.done = 0
        # Runs that fill the last batch are filtered too, but are less than a batch of each group.
        self.evaluations += 1

    def slope(self, data: Data, batch: Batch, number: int) -> Floats:
        """Gradient by one of `number` batches, prior included; their mean is that of all runs."""
        plain = on_host(self.free)
        given = self.model, self.objective, self.layout, plain, self.base
        counts = {name: total / number for name, total in self.training_counts.items()}
        slope = np.asarray(_gradient(*given, data, batch, counts))
        return np.where(self.fixed, 0.0, slope + self.prior(plain)[1])

    def state_dict(self) -> dict[str, Any]:
        """State of the search as arrays by name."""
        found = {f"batches_{name}": np.asarray(getattr(self, name)) for name in _STATE}
        return found | arrays_of(self.memory, "adam_") | super().state_dict()

    def restore(self, state: dict[str, Any]) -> None:
        """Go on from the state that `state_dict` returned."""
        super().restore(state)
        self._begin(state["batches_free"], float(state["batches_rate"]))
        for name in ("skipped", "halved", "done"):
            setattr(self, name, int(state[f"batches_{name}"]))
        self.memory = tree_of(state, "adam_", self.memory)


def cut(data: Data, size: int, rng: np.random.Generator) -> list[Batch]:
    """Runs of a group in random order, `size` at a time; the last batch is filled with the first runs."""
    runs = len(data.place)
    size = min(size, runs)
    order = rng.permutation(runs)
    number = -(-runs // size)
    chosen = np.resize(order, number * size).reshape(number, size)
    fresh = np.arange(number * size).reshape(number, size) < runs
    return [Batch(*each) for each in zip(chosen, fresh, strict=True)]
