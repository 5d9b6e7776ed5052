"""Samples of an IMU at the limit of its range, where the true value is larger and not known.

A limit shows in the numbers alone: an extreme value that is repeated exactly, while the numbers below it
are not, in a signal whose noise would not let any other value be repeated.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from jaxekf.recordings.types import Flags, Floats

_FEWEST = 4
"""Repetitions of an extreme value from which on it may be a limit."""
_NEXT_LEVELS = 5
_MORE_OFTEN = 6
"""An extreme repeated this many times as often as any of the next five values is a limit: the top of
a smooth, coarsely quantised curve has up to 2.4 times as many samples as the level below it."""
_NOISE = 1e-5
"""Noise relative to the limit below which a signal is taken for one without noise, in which a constant
value is repeated without any limit."""
_SAME_SIZE = 0.01


class Limit(NamedTuple):
    """A value of one axis that no sample exceeds, and the samples that are there."""

    axis: int
    value: float
    at: NDArray[np.intp]
    """Rows at the limit."""
    noisy: bool
    """Whether the noise of the signal excludes a value that was constant by itself."""


def limits(values: Floats) -> list[Limit]:
    """Limits of the axes of a sensor with samples (N, 3), each side of an axis on its own.

    Values that are held (a row that repeats the one before) count once. A signal that is coarsely quantised
    repeats its extremes as often as other values, and has no limit.

    Examples
    --------
    >>> import numpy as np
    >>> rate = np.random.default_rng(0).normal(size=(1000, 3))
    >>> [(one.axis, one.value, len(one.at)) for one in limits(np.clip(rate, -2.0, 5.0))]
    [(0, -2.0, 28), (1, -2.0, 12), (2, -2.0, 22)]
    """
    rows = np.flatnonzero(np.isfinite(values).all(axis=1))
    if len(rows) < 20:
        return []
    extreme = (values[rows] == values[rows].max(axis=0)) | (
        values[rows] == values[rows].min(axis=0)
    )
    again = np.r_[False, (np.diff(values[rows], axis=0) == 0.0).all(axis=1)]
    kept = ~again | extreme.all(axis=1)
    found = []
    for axis in range(values.shape[1]):
        column = values[rows[kept], axis]
        for sign in (1.0, -1.0):
            top = float(np.max(sign * column))
            if top > 0.0 and _is_limit(sign * column, top):
                at = rows[values[rows, axis] == sign * top]
                found.append(Limit(axis, sign * top, at, _noise(sign * column, top) > _NOISE * top))
    return found


def clipped(values: Floats) -> Flags:
    """Rows (N,) of a sensor's samples (N, 3) of which an axis is at a limit, by the numbers alone."""
    at = np.zeros(len(values), bool)
    for one in limits(values):
        if one.noisy:
            at[one.at] = True
    return at


def sides(found: list[Limit]) -> dict[float, list[Limit]]:
    """Limits of the same size, whatever axis and sign, by that size."""
    groups: dict[float, list[Limit]] = {}
    for one in found:
        size = abs(one.value)
        near = [known for known in groups if abs(known - size) < _SAME_SIZE * known]
        groups.setdefault(near[0] if near else size, []).append(one)
    return groups


def _is_limit(column: Floats, top: float) -> bool:
    """Whether a value is repeated far more often than those next below it, and is no state of rest."""
    count = int((column == top).sum())
    if count < _FEWEST or count > 0.9 * len(column):
        return False
    size = 8 * count + 200
    upper = column if size >= len(column) else np.partition(column, -size)[-size:]
    _, counts = np.unique(upper, return_counts=True)
    below = counts[-1 - _NEXT_LEVELS : -1]
    if len(counts) < 1 + _NEXT_LEVELS or (count > 0.5 * len(column) and len(counts) < 50):
        return False
    often = int(below.max())
    return count >= (_FEWEST if often == 1 else _MORE_OFTEN * often)


def _noise(column: Floats, top: float) -> float:
    """Noise of a signal, standard deviation, by sixth differences away from its limit and from rest."""
    if len(column) < 50:
        return 0.0
    sixth = np.abs(np.diff(column, n=6)) / np.sqrt(924.0)
    inside = (column < top) & (column > column.min())
    free = np.lib.stride_tricks.sliding_window_view(inside, 7).all(axis=1)
    large = free & (np.abs(column[3:-3]) > 0.1 * top)
    chosen = large if large.sum() > 20 else free
    return 1.48 * float(np.median(sixth[chosen])) if chosen.sum() > 20 else 0.0
