"""The cost of a gradient, measured by the clock."""

import statistics
import time

from tuning.search.evaluation import Evaluation

_LEAST, _MOST = 3, 30


def gradient_cost(problem: Evaluation, seconds: float = 1.0) -> float:
    """Time of the objective with its gradient as a multiple of the time without, at the start of a search.

    The times are medians of alternating calls, compiled before, during about `seconds` and at least three
    of each.
    """
    calls = problem.value, problem.value_and_gradient
    spent: tuple[list[float], ...] = ([], [])
    for call in calls:
        call(problem.start)
    until = time.perf_counter() + seconds
    while len(spent[0]) < _LEAST or (time.perf_counter() < until and len(spent[0]) < _MOST):
        for call, times in zip(calls, spent, strict=True):
            begin = time.perf_counter()
            call(problem.start)
            times.append(time.perf_counter() - begin)
    value, with_gradient = (statistics.median(times) for times in spent)
    return with_gradient / value
