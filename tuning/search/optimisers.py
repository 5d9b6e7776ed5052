"""Which search an optimiser's name stands for, and what does not go together."""

from collections.abc import Callable
from functools import partial
from typing import Any

from jaxekf._support.errors import TuningError
from tuning.objective.objectives import Objective
from tuning.search._minibatch import Batches
from tuning.search.descent import Descent

OPTIMISERS = ("lbfgs", "fisher", "adam")


def searcher(
    optimiser: Any, aim: Objective, starts: int, batch: int | None, seed: int
) -> Callable[..., Descent]:
    """What makes a search of the kind asked for."""
    if isinstance(optimiser, str) and optimiser not in OPTIMISERS:
        raise TuningError(
            f"got the optimiser '{optimiser}', expected one of {OPTIMISERS} or one of optax; choose one"
        )
    if starts < 1 or (batch is not None and batch < 1):
        raise TuningError(
            f"got {starts} starts and batches of {batch} runs, expected at least one; ask for more"
        )
    if optimiser == "fisher" and (aim.errors or aim.truth):
        raise TuningError(
            f"got Fisher scoring for '{aim.describe()}', expected likelihood or map, whose curvature it"
            " knows; take lbfgs"
        )
    if isinstance(optimiser, str) and optimiser == "adam":
        if starts > 1:
            raise TuningError(
                f"got {starts} starts with adam, expected one, for its batches differ from step to step;"
                " take lbfgs or fisher"
            )
        return partial(Batches, size=batch or Batches.size, seed=seed)
    if batch is not None:
        raise TuningError(
            f"got batches of {batch} runs for another optimiser than adam, expected none; take adam, or"
            " leave the batches out"
        )
    if isinstance(optimiser, str):
        return partial(Descent, fisher=optimiser == "fisher")
    return partial(Descent, optimiser=optimiser)
