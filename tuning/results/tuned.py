"""Result of a tuning by gradient."""

import hashlib
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np

import tuning
from jaxekf._support.deprecations import warn_renamed
from jaxekf.estimation.batch import Run, read
from jaxekf.filtering.model import Model, Parameters
from jaxekf.recordings.types import Flags, Floats
from tuning.objective.fisher_information import Information, informative_motion, interval
from tuning.objective.objectives import Objective
from tuning.parametrisation.free_vector import Layout
from tuning.parametrisation.truth_frame import TruthFrame


class Iteration(NamedTuple):
    """One step of the tuner.

    Examples
    --------
    >>> import jaxekf, tuning
    >>> jaxekf.set_up()
    >>> runs = jaxekf.demo.paths(("free-1",))
    >>> tuned = tuning.tune(runs, objective="likelihood", free=["noise.optical"], iterations=5)
    >>> first = tuned.history[0]
    >>> first.number, first.rejected, tuned.best.training < first.training
    (0, False, True)
    """

    number: int
    """Number of the step, the start being 0."""
    training: float
    """Objective of the training runs, in its own unit."""
    validation: float
    """NaN without validation runs."""
    rejected: bool
    """Whether the objective or its gradient was not finite; then the step was shortened."""


Progress = Callable[[Iteration, int], None]


class Outcome(NamedTuple):
    """Result of one start of several.

    Examples
    --------
    >>> import jaxekf, tuning
    >>> jaxekf.set_up()
    >>> runs = jaxekf.demo.paths(("free-1",))
    >>> problem = {"objective": "likelihood", "free": ["noise.optical"], "iterations": 2}
    >>> tuned = tuning.tune(runs, **problem, optimiser=tuning.FisherScoring(), starts=2)
    >>> [(outcome.iterations, outcome.ending) for outcome in tuned.starts]
    [(2, 'the 2 iterations asked for are done'), (2, 'the 2 iterations asked for are done')]
    """

    value: float
    """Lowest objective, of the validation runs if there are any; infinite if it could not begin."""
    iterations: int
    ending: str
    """Reason for its end, in words."""


@dataclass(frozen=True)
class Tuned:
    """Result of `tuning.tune`.

    Examples
    --------
    >>> import jaxekf, tuning
    >>> jaxekf.set_up()
    >>> runs = jaxekf.demo.paths(("free-1", "free-2"))
    >>> tuned = tuning.tune(runs, objective="likelihood", free=["noise.optical"], iterations=5)
    >>> tuned.moved, tuned.rejections, sorted(tuned.inputs)
    (['x 1.01'], 0, ['free-1', 'free-2'])
    >>> tuned.origin["free"], tuned.scale
    (['noise.optical'], 1.0)
    """

    model: Model
    params: Parameters
    """Best parameters, by validation if there is one; the mean over the runs where each run has its own."""
    start: Parameters
    """Initial parameters, in the shapes that were tuned."""
    objective: Objective
    best: Iteration
    """Iteration whose parameters were chosen."""
    history: tuple[Iteration, ...]
    """All iterations, in order."""
    stopped: str
    """Reason for the end of the search, in words."""
    scale: float
    """Factor on all covariances after the fit, so that the errors match them."""
    layout: Layout
    """Free parameters, and their order in `free`."""
    origin: dict[str, Any] = field(default_factory=dict)
    each: dict[str, Parameters] = field(default_factory=dict)
    """Parameters of each training run by its name, if runs have parameters of their own."""
    truth: TruthFrame | None = None
    """Clock and frames of the encoder, if they were free."""
    free: Floats = field(default_factory=lambda: np.zeros(0))
    """(n,) best free vector, before the scale."""
    information: Information | None = None
    """Fisher information at the best; None if it was not asked for."""
    fixed: Flags = field(default_factory=lambda: np.zeros(0, bool))
    """(n,) unobservable numbers, which kept their initial values."""
    evaluations: int = 0
    """Evaluations of the objective with its gradient, from all starts; of Adam passes over all runs."""
    filterings: float = 0.0
    """Filterings of all training runs without a gradient (see `Evaluation`); one for the scale."""
    starts: tuple[Outcome, ...] = ()
    """Result of each start, the given one first, if there were several."""
    inputs: dict[str, dict[str, str]] = field(default_factory=dict)
    """SHA-256 of every file that each run was read from, by the run's name."""

    @property
    def digest(self) -> str:
        """Identifier of this tuning; each of its files holds it."""
        found = hashlib.sha256(repr((self.model.name, sorted(self.each))).encode())
        for leaf in jax.tree.leaves((self.params, self.each)):
            found.update(np.asarray(leaf, float).tobytes())
        return found.hexdigest()[:16]

    @property
    def rejections(self) -> int:
        """Number of steps that were rejected because they were not finite."""
        return sum(step.rejected for step in self.history)

    @cached_property
    def intervals(self) -> dict[str, tuple[float, float, float]]:
        """Value and 95 % confidence interval of each observable free number by its label, in its unit.

        The intervals are Laplace's, from innovations and prior, before the scale.
        """
        if self.information is None:
            return {}
        sigma = self.information.sigma(self.fixed)
        ends = interval(self.layout, self.free, sigma)
        unknown = self.fixed | self.layout.is_truth
        every = zip(self.layout.labels(), ends, unknown, strict=True)
        return {label: found for label, found, out in every if not out}

    @property
    def open(self) -> dict[str, str]:
        """Unobservable numbers by label, each with the recordings that would make it observable."""
        labels = self.layout.labels()
        found = [labels[i] for i in np.flatnonzero(self.fixed)]
        return {
            label: informative_motion(label.split("[")[0].split(" of run")[0]) for label in found
        }

    @property
    def moved(self) -> list[str]:
        """Change of each free number from its start, in words: the factor of a logarithm, else in prior
        standard deviations."""
        return [
            f"x {change:.3g}" if leaf.is_logarithm(i) else f"{change:+.2g} prior sigma"
            for (leaf, i), change in zip(self.layout.numbers(), self.changes, strict=True)
        ]

    @property
    def changes(self) -> list[float]:
        """Change of each free number from its start: a factor of a logarithm, else in prior deviations."""
        start, found = np.asarray(self.layout.to_free(self.start)), []
        for (leaf, i), first, last in zip(self.layout.numbers(), start, self.free, strict=True):
            change = leaf.unbounded(last, i) - leaf.unbounded(first, i)
            found.append(float(np.exp(change)) if leaf.is_logarithm(i) else change / leaf.prior)
        return found

    def of_run(self, run: Run) -> Parameters:
        """Parameters of a training run, its own included."""
        return self.each.get(read([run])[0].name, self.params)

    def save(self, folder: Path | str, **options: Any) -> None:
        """Deprecated: `tuning.save`."""
        warn_renamed("Tuned.save(folder)", "tuning.save(tuned, folder)")
        tuning.save(self, folder, **options)
