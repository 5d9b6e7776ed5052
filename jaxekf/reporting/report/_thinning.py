"""Series thinned for display: extremes and gaps are kept, numbers are short."""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from jaxekf.recordings.types import Floats

_FINENESS = 2e4
"""Steps into which the range of a series is divided by rounding."""
_GAP_PERIODS = 2.5


class Thinned(NamedTuple):
    """Which samples of a series are drawn, in order of time."""

    t: Floats
    """(M,) seconds; at a break the middle of it."""
    samples: NDArray[np.intp]
    """(M,) of the samples; -1 where the line breaks."""

    def take(self, values: Floats) -> Floats:
        """Values (N,) of the drawn samples, NaN at breaks."""
        return np.where(self.samples < 0, np.nan, np.asarray(values, float)[self.samples])


def thin(t: Floats, values: Floats, bins: int, *, line: bool = True) -> Thinned:
    """Thin times (N,) and values (N,) to the smallest and the largest finite sample in each of `bins` equal
    spans of time; few samples are all kept. Dots (not a `line`) keep two further samples in each of half as
    many spans: extremes alone would look like two clouds.

    A line has a break wherever samples between two drawn ones are not finite, or further apart
    than two and a half periods: nothing is drawn across missing samples.
    """
    finite = np.isfinite(values)
    kept = np.flatnonzero(finite)
    if len(kept) > 2 * bins:
        spans = bins if line else bins // 2
        length = max(float(t[-1] - t[0]), 1e-9)
        place = np.minimum(((t[kept] - t[0]) / length * spans).astype(int), spans - 1)
        first = np.flatnonzero(np.diff(place, prepend=-1))
        last = np.append(first[1:], len(kept)) - 1
        order = kept[np.lexsort((values[kept], place))]
        chosen = [order[first], order[last]]
        if not line:
            chosen += [kept[first], kept[(first + last) // 2]]
        kept = np.unique(np.concatenate(chosen))
    if not line or len(kept) < 2:
        return Thinned(t[kept], kept)
    step = np.diff(t)
    far = step > _GAP_PERIODS * float(np.median(step))
    missing = np.concatenate([[0], np.cumsum(~finite)])
    holes = np.concatenate([[0], np.cumsum(far)])
    before, after = kept[:-1], kept[1:]
    broken = (missing[after] > missing[before + 1]) | (holes[after] > holes[before])
    at = np.flatnonzero(broken) + 1
    middle = 0.5 * (t[kept[at - 1]] + t[kept[at]])
    return Thinned(np.insert(t[kept], at, middle), np.insert(kept, at, -1))


def rounded(values: Floats) -> list[float | int | None]:
    """Numbers for JSON, with enough decimals that rounding is not visible; null where not finite."""
    values = np.asarray(values, float)
    known = values[np.isfinite(values)]
    spread = float(np.ptp(known)) if known.size else 0.0
    scale = spread or float(np.abs(known).max(initial=0.0)) or 1.0
    decimals = min(max(0, math.ceil(-math.log10(scale / _FINENESS))), 15)
    return [_short(v, decimals) for v in values.tolist()]


def seconds(values: Floats) -> list[float | int | None]:
    """Times for JSON, to the millisecond."""
    return [_short(v, 3) for v in np.asarray(values, float).tolist()]


def _short(value: float, decimals: int) -> float | int | None:
    if not math.isfinite(value):
        return None
    near = round(value, decimals)
    return int(near) if near == int(near) else near
