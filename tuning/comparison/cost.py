"""What a tuning costs, counted in filterings of all its runs."""

import statistics
import time
from collections.abc import Sequence
from typing import NamedTuple

from tuning.search.descent import Descent

_LEAST, _MOST = 3, 30


class Work(NamedTuple):
    """Filterings of all training runs."""

    filterings: float
    """Without a gradient: values, Fisher information (two for each number and one), the scale, and
    validation runs by their share."""
    gradients: float
    """With the gradient of the objective."""

    def forward(self, gradient_cost: float) -> float:
        """All in filterings without a gradient, one with it counting as `gradient_cost`."""
        return self.filterings + (gradient_cost * self.gradients if self.gradients else 0.0)


def mean(of: Sequence[Work]) -> Work:
    """Over folds."""
    return Work(*(statistics.fmean(values) for values in zip(*of, strict=True)))


def gradient_cost(search: Descent, seconds: float = 1.0) -> float:
    """How many times as long as its value the objective takes with its gradient, at the start of a search.

    Medians of calls in turn, compiled before, for about `seconds` and at least three of each.
    """
    calls = search.value, search.value_and_gradient
    spent: tuple[list[float], ...] = ([], [])
    for call in calls:
        call(search.start)
    until = time.perf_counter() + seconds
    while len(spent[0]) < _LEAST or (time.perf_counter() < until and len(spent[0]) < _MOST):
        for call, times in zip(calls, spent, strict=True):
            begin = time.perf_counter()
            call(search.start)
            times.append(time.perf_counter() - begin)
    value, with_gradient = (statistics.median(times) for times in spent)
    return with_gradient / value
