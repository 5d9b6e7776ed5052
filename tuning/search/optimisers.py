"""Optimisers as objects: each makes its own search, and refuses what does not go together with it."""

from dataclasses import dataclass, field, replace
from typing import Any, Protocol

import optax

from jaxekf._support.deprecations import warn_renamed
from jaxekf._support.errors import TuningError
from tuning.objective.objectives import Objective
from tuning.search._minibatch import MinibatchDescent
from tuning.search.descent import Descent


class Optimiser(Protocol):
    """An optimiser for `tuning.tune`; checkpoints know it by its `repr`."""

    def search(self, *problem: Any, starts: int, seed: int) -> Descent:
        """Search from the start of a problem, the first seven fields of `Descent`.

        Raises `TuningError` for an objective or a number of starts that the optimiser cannot take.
        """
        ...


@dataclass(frozen=True)
class LBFGS:
    """L-BFGS with backtracking, for any objective.

    Examples
    --------
    >>> import jaxekf, tuning
    >>> jaxekf.set_up()
    >>> runs = jaxekf.demo.paths(("free-1",))
    >>> problem = {"objective": "likelihood", "free": ["noise.optical"], "iterations": 20}
    >>> tuned = tuning.tune(runs, **problem, optimiser=tuning.LBFGS())  # the default
    >>> tuned.stopped, tuned.filterings
    ('converged', 0.0)
    """

    def search(self, *problem: Any, starts: int, seed: int) -> Descent:
        """See `Optimiser`."""
        return Descent(*problem)


@dataclass(frozen=True)
class FisherScoring:
    """Fisher scoring, for likelihood and `map` with up to about thirty free numbers.

    It takes few steps and compiles no gradient; each step filters all runs twice for each number.

    Examples
    --------
    >>> import jaxekf, tuning
    >>> jaxekf.set_up()
    >>> runs = jaxekf.demo.paths(("free-1",))
    >>> problem = {"objective": "likelihood", "free": ["noise.optical"], "iterations": 5}
    >>> tuned = tuning.tune(runs, **problem, optimiser=tuning.FisherScoring())
    >>> tuned.evaluations  # with a gradient
    0
    >>> print(f"{tuned.params.noise.optical:.4f} rad")
    0.0053 rad
    """

    def search(self, *problem: Any, starts: int, seed: int) -> Descent:
        """See `Optimiser`."""
        objective: Objective = problem[1]
        if objective.errors or objective.truth:
            raise TuningError(
                f"got Fisher scoring for '{objective.describe()}', expected likelihood or map, whose"
                " curvature it knows; take lbfgs"
            )
        return Descent(*problem, fisher=True)


@dataclass(frozen=True)
class Adam:
    """Adam on minibatches, for very many runs; an iteration is a pass over all of them.

    Examples
    --------
    >>> import tuning
    >>> optimiser = tuning.Adam(batch=4)  # for `tuning.tune(runs, optimiser=optimiser)`
    >>> optimiser.batch
    4
    """

    batch: int = 16
    """Number of runs of a step."""

    def __post_init__(self) -> None:
        if self.batch < 1:
            raise TuningError(
                f"got batches of {self.batch} runs, expected at least one; ask for more"
            )

    def search(self, *problem: Any, starts: int, seed: int) -> Descent:
        """See `Optimiser`."""
        if starts > 1:
            raise TuningError(
                f"got {starts} starts with adam, expected one, for its batches differ from step to step;"
                " take lbfgs or fisher"
            )
        return MinibatchDescent(*problem, size=self.batch, seed=seed)


@dataclass(frozen=True)
class _Optax:
    """An optimiser of optax, whose steps are taken as they are."""

    transformation: optax.GradientTransformation = field(repr=False)

    def search(self, *problem: Any, starts: int, seed: int) -> Descent:
        """See `Optimiser`."""
        return Descent(*problem, optimiser=self.transformation)


NAMED: dict[str, type[LBFGS | FisherScoring | Adam]] = {
    "lbfgs": LBFGS,
    "fisher": FisherScoring,
    "adam": Adam,
}


def from_name(name: str, batch: int | None = None) -> Optimiser:
    """The optimiser of a name on the command line. Raises `TuningError` for an unknown name, and for a
    batch if it takes none."""
    if name not in NAMED:
        raise TuningError(
            f"got the optimiser '{name}', expected one of {tuple(NAMED)} or one of optax; choose one"
        )
    return _with_batch(NAMED[name](), batch)


def _with_batch(optimiser: Optimiser, batch: int | None) -> Optimiser:
    if batch is None:
        return optimiser
    if not isinstance(optimiser, Adam):
        raise TuningError(
            f"got batches of {batch} runs for another optimiser than adam, expected none; take adam, or"
            " leave the batches out"
        )
    return replace(optimiser, batch=batch)


def as_optimiser(
    given: Optimiser | optax.GradientTransformation | str, batch: int | None = None
) -> Optimiser:
    """An optimiser from one of optax, or from a deprecated name and batch of `tuning.tune`."""
    if isinstance(given, str):
        optimiser = from_name(given, batch)
        warn_renamed(f"optimiser={given!r}", f"optimiser=tuning.{optimiser}", stacklevel=4)
        return optimiser
    if batch is not None:
        warn_renamed("batch", f"optimiser=tuning.Adam(batch={batch})", stacklevel=4)
    return _with_batch(
        _Optax(given) if isinstance(given, optax.GradientTransformation) else given, batch
    )
