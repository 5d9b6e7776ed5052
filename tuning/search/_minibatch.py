"""Adam on a few runs at a time: for so many recorded runs that one pass over all of them is long."""

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
from tuning.search.descent import Descent, Iteration, Progress, evaluate_at, on_host

RATE = 0.1
"""Of Adam at first: about as much as each free number moves in a step, a tenth of an e-fold."""
_STALE = 2
"""Passes without improvement after which the rate is halved."""
_LEAST_RATE = 1e-3
"""Share of the first rate at which it has converged."""
_KEPT = ("free", "rate", "skipped", "halved", "done")
KEEP_S = 20.0
"""Seconds after which the state is kept within a pass."""


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
    """The share that some runs of a group have in the objective of all runs."""
    some = jax.tree.map(lambda leaf: leaf[batch.chosen], data)
    fresh = batch.fresh[:, None, None]
    told = {name: truth._replace(judged=truth.judged & fresh) for name, truth in some.truth.items()}
    some = some._replace(truth=told, counted=some.counted & fresh)
    return evaluate_at(model, objective, where, free, base, some, counts)


_gradient = partial(jit, static_argnums=(0, 1, 2))(jax.grad(_batch_value, 3))


class Batch(NamedTuple):
    """Runs of a step."""

    chosen: Any
    """(size,) their place in the group."""
    fresh: Any
    """(size,) False where a run only fills the batch."""


_ADAM = optax.scale_by_adam()
_adam_begin, _adam_step = jax.jit(_ADAM.init), jax.jit(_ADAM.update)


@dataclass
class Batches(Descent):
    """The optimiser's loop in which an iteration is a pass over all runs, a few at a time.

    The objective of all runs is taken after each pass, without its gradient: by it, or by validation, the
    best is kept, and the rate is halved where it no longer falls.
    """

    size: int = 16
    """Runs of a step, at most."""
    seed: int = 0
    """Of the order of the runs."""

    def __post_init__(self) -> None:
        super().__post_init__()
        self._begin(self.start, RATE)
        self.halved = self.done = 0

    def begin_at(self, free: Any) -> None:
        """Begin elsewhere than at the start, about which the prior stays."""
        super().begin_at(free)
        self._begin(on_host(free), self.rate)

    def _begin(self, free: Floats, rate: float) -> None:
        """A pass from here, without memory of former ones."""
        self.free, self.rate, self.skipped = np.asarray(free), rate, 0
        self.memory = _adam_begin(self.free)

    def again(self, fixed: Any) -> None:
        """Go on from the best with more numbers held at their start."""
        super().again(fixed)
        assert self.fallback is not None
        self._begin(self.fallback.free, RATE)
        self.halved = len(self.history)

    def _step(self, patience: int, progress: Progress | None) -> str:
        while len(self.history) < self.iterations or self.done:
            # With steps done it goes on in the middle of a pass, whose beginning is judged already.
            if not self.done and (reason := self._judge_pass(patience, progress)):
                return reason
            self._pass(len(self.history) - 1)
            if self.keep is not None:
                self.keep(self.state_dict())
        return self.all_done if self.best is not None else super()._step(patience, progress)

    def _judge_pass(self, patience: int, progress: Progress | None) -> str:
        """Judge where the last pass led and choose the rate of the next; a reason to stop, or nothing."""
        value = float("nan") if self.skipped else self.value(self.free)
        self.filterings += not self.skipped
        finite = bool(np.isfinite(value))
        held = self.validation_value(self.free) if finite else float("nan")
        step = Iteration(len(self.history), value, held, not finite)
        self.record(step, self.free, progress)
        if step.number - self.since >= patience:
            return f"no improvement in {patience} iterations"
        assert self.best is not None
        if not finite:
            self._begin(self.best.free, 0.25 * self.rate)
        elif step.number - max(self.since, self.halved) >= _STALE:
            self.halved = step.number
            self._begin(self.best.free, 0.5 * self.rate)
        return "converged" if self.rate < _LEAST_RATE * RATE else ""

    def _pass(self, number: int) -> None:
        """A step for each batch, in an order that only the seed and the pass's number decide."""
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
        # What fills the last batch is filtered too, but is less than a batch of each group.
        self.evaluations += 1

    def slope(self, data: Data, batch: Batch, number: int) -> Floats:
        """The gradient by one batch of so many, prior included: their mean is that of all runs."""
        plain = on_host(self.free)
        given = self.model, self.objective, self.layout, plain, self.base
        counts = {name: total / number for name, total in self.training_counts.items()}
        slope = np.asarray(_gradient(*given, data, batch, counts))
        return np.where(self.fixed, 0.0, slope + self._prior(plain)[1])

    def state_dict(self) -> dict[str, Any]:
        """All that the loop goes on from, as arrays by name."""
        found = {f"batches_{name}": np.asarray(getattr(self, name)) for name in _KEPT}
        leaves = jax.tree.leaves(self.memory)
        found |= {f"adam_{i}": np.asarray(leaf) for i, leaf in enumerate(leaves)}
        return found | super().state_dict()

    def restore(self, kept: dict[str, Any]) -> None:
        """Go on from where `state_dict` was taken."""
        super().restore(kept)
        self._begin(kept["batches_free"], float(kept["batches_rate"]))
        for name in ("skipped", "halved", "done"):
            setattr(self, name, int(kept[f"batches_{name}"]))
        leaves, structure = jax.tree.flatten(self.memory)
        again = [np.asarray(kept[f"adam_{i}"], leaf.dtype) for i, leaf in enumerate(leaves)]
        self.memory = jax.tree.unflatten(structure, again)


def cut(data: Data, size: int, rng: np.random.Generator) -> list[Batch]:
    """The runs of a group in random order, as many at a time; the last batch is filled with the first."""
    runs = len(data.place)
    size = min(size, runs)
    order = rng.permutation(runs)
    number = -(-runs // size)
    chosen = np.resize(order, number * size).reshape(number, size)
    fresh = np.arange(number * size).reshape(number, size) < runs
    return [Batch(*each) for each in zip(chosen, fresh, strict=True)]
