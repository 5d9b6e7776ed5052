"""Statistics of a score over several runs."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

BEST_AT_ONE = ("nis", "nees", "position_nees")
"""Scores that are 1 for a consistent filter; the others are errors."""


class Spread(NamedTuple):
    """Statistics of a column over the runs that have a number there; NaN if there are too few.

    Examples
    --------
    >>> from jaxekf.evaluation.spread import spread_of
    >>> spread = spread_of([0.1, 0.2, 0.3], "attitude_rmse_deg")
    >>> [round(number, 3) for number in spread]  # mean, deviation of a run, worst
    [0.2, 0.1, 0.3]
    """

    mean: float
    deviation: float
    """Standard deviation of a run, by n - 1."""
    worst: float
    """Largest error; for NIS and NEES the number farthest from 1 as a factor."""


def spread_of(values: Sequence[float], column: str) -> Spread:
    """The statistics of one number for each run."""
    nan, array = float("nan"), np.array(values, float)
    if not array.size:
        return Spread(nan, nan, nan)
    with np.errstate(divide="ignore"):
        badness = np.abs(np.log(array)) if column in BEST_AT_ONE else array
    deviation = float(array.std(ddof=1)) if len(array) > 1 else nan
    return Spread(float(array.mean()), deviation, float(array[np.argmax(badness)]))
