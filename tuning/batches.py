"""Adam on a few runs at a time: for so many recorded runs that one pass over all of them is long."""

from dataclasses import dataclass
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jax import Array

from jaxekf.kernels import jit
from jaxekf.model import Model, Parameters
from jaxekf.recording import Floats
from tuning.data import Data
from tuning.descent import Descent, Iteration, Progress, evaluate_at, on_host
from tuning.noise import Layout
from tuning.objectives import Objective, count, weights_of

RATE = 0.1
"""Of Adam at first: about as much as each free number moves in a step, a tenth of an e-fold."""
_STALE = 2
"""Passes without improvement after which the rate is halved."""
_LEAST_RATE = 1e-3
"""Share of the first rate at which it has converged."""
_KEPT = ("free", "rate", "skipped", "halved")


def _batch_value(
    model: Model,
    objective: Objective,
    where: Layout,
    free: Array,
    base: Parameters,
    data: Data,
    chosen: Array,
) -> Array:
    """The objective of some runs of a group."""
    some = jax.tree.map(lambda leaf: leaf[chosen], data)
    counts = count(some, tuple(weights_of(objective)))
    return evaluate_at(model, objective, where, free, base, some, counts)


_gradient = partial(jit, static_argnums=(0, 1, 2))(jax.grad(_batch_value, 3))


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
        self.adam = optax.scale_by_adam()
        self._begin(self.start, RATE)
        self.halved = 0

    def begin_at(self, free: Any) -> None:
        """Begin elsewhere than at the start, about which the prior stays."""
        super().begin_at(free)
        self._begin(on_host(free), self.rate)

    def _begin(self, free: Floats, rate: float) -> None:
        """A pass from here, without memory of former ones."""
        self.free, self.rate, self.skipped = jnp.asarray(free), rate, 0
        self.memory = self.adam.init(self.free)

    def again(self, fixed: Any) -> None:
        """Go on from the best with more numbers held at their start."""
        super().again(fixed)
        assert self.fallback is not None
        self._begin(self.fallback.free, RATE)
        self.halved = len(self.history)

    def _step(self, patience: int, progress: Progress | None) -> str:
        while len(self.history) < self.iterations:
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
            if self.rate < _LEAST_RATE * RATE:
                return "converged"
            self._pass(step.number)
            if self.keep is not None:
                self.keep(self.state_dict())
        return self.all_done if self.best is not None else super()._step(patience, progress)

    def _pass(self, number: int) -> None:
        """A step for each batch, in an order that only the seed and the pass's number decide."""
        rng = np.random.default_rng([self.seed, number])
        batches = [(data, chosen) for data in self.training for chosen in cut(data, self.size, rng)]
        for i in rng.permutation(len(batches)):
            data, chosen = batches[i]
            given = self.model, self.objective, self.layout, on_host(self.free), self.base
            slope = np.asarray(_gradient(*given, data, chosen))
            slope = np.where(self.fixed, 0.0, slope + self._prior(on_host(self.free))[1])
            if not np.isfinite(slope).all():
                self.skipped += 1
                return
            change, self.memory = self.adam.update(jnp.asarray(slope), self.memory)
            self.free = self.free - self.rate * jnp.asarray(change)
        # What fills the last batch is filtered too, but is less than a batch of each group.
        self.evaluations += 1

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
        self.skipped, self.halved = int(kept["batches_skipped"]), int(kept["batches_halved"])
        leaves, structure = jax.tree.flatten(self.memory)
        again = [jnp.asarray(kept[f"adam_{i}"], leaf.dtype) for i, leaf in enumerate(leaves)]
        self.memory = jax.tree.unflatten(structure, again)


def cut(data: Data, size: int, rng: np.random.Generator) -> list[Any]:
    """The runs of a group in random order, as many at a time; the last batch is filled with the first."""
    runs = len(data.place)
    size = min(size, runs)
    order = rng.permutation(runs)
    number = -(-runs // size)
    return list(np.resize(order, number * size).reshape(number, size))
