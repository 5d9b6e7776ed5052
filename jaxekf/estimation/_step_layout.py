"""Samples laid out in epochs and substeps, the arrays that the filter scans over."""

import numpy as np
from numpy.typing import NDArray

from jaxekf.filtering.steps import Rows, Steps
from jaxekf.recordings.sample_selection import take
from jaxekf.recordings.types import NANOSECONDS, Samples, Times, period_ns

_UPDATE_COST = 3.0  # of one slow update, in predictions; used only to choose the length of epochs
_LONGEST_EPOCH = 32


def slow_sensors(samples: dict[str, Samples], times: Times) -> tuple[str, ...]:
    """Sensors with samples at no more than half of the instants."""
    return tuple(name for name, s in samples.items() if 2 * len(s.time_ns) <= len(times) + 1)


def epochs_of(times: Times, slow_times: list[Times]) -> NDArray[np.intp]:
    """Index (K, S) into `times` of each substep, -1 in padding; slow samples are at the last substep."""
    if not slow_times:
        return np.arange(len(times))[:, None]
    ends = np.flatnonzero(np.isin(times, np.concatenate(slow_times)))
    if ends.size == 0 or ends[-1] != len(times) - 1:
        ends = np.append(ends, len(times) - 1)
    lengths = np.diff(ends, prepend=-1)
    sizes = np.arange(1, min(_LONGEST_EPOCH, int(lengths.max())) + 1)
    epochs = np.array([np.ceil(lengths / size).sum() for size in sizes])
    size = int(sizes[np.argmin(epochs * (sizes + _UPDATE_COST))])
    chunks = np.ceil(lengths / size).astype(int)
    index = np.full((int(chunks.sum()), size), -1)
    last_row = np.cumsum(chunks) - 1
    for end, length, row in zip(ends, lengths, last_row, strict=True):
        instants = np.arange(end - length + 1, end + 1)
        offset = (row + 1) * size - length
        index.reshape(-1)[offset : offset + length] = instants
    return index


def arrange(
    times: Times,
    index: NDArray[np.intp],
    samples: dict[str, Samples],
    slow: tuple[str, ...],
    start: int,
) -> tuple[Steps, Times]:
    """The steps without input, and the time (K, S) at the end of each substep.

    Parameters
    ----------
    times
        (N,) instants of the run, int64 nanoseconds.
    index
        (K, S) as of `epochs_of`.
    samples
        Samples of each sensor.
    slow
        Sensors that are sampled only at the ends of epochs.
    start
        First instant, int64 nanoseconds.
    """
    valid = index >= 0
    # A padded substep has the time of the valid one before it, or that of the start.
    flat = np.maximum.accumulate(index.reshape(-1)).reshape(index.shape)
    step_times = np.where(flat >= 0, times[np.maximum(flat, 0)], start)
    dt_ns = np.diff(step_times.reshape(-1), prepend=start).reshape(index.shape)
    fast = {
        n: _rows(s, np.where(valid, step_times, -1)) for n, s in samples.items() if n not in slow
    }
    ends = {n: _rows(samples[n], np.where(valid, step_times, -1)[:, -1]) for n in slow}
    steps = Steps((step_times - start) / NANOSECONDS, dt_ns / NANOSECONDS, valid, None, fast, ends)
    return steps, step_times


def _rows(samples: Samples, times: Times) -> Rows:
    """The samples at these times, masked at times without one."""
    at = np.clip(np.searchsorted(samples.time_ns, times), 0, len(samples.time_ns) - 1)
    here = samples.time_ns[at] == times
    nominal = period_ns(samples.time_ns)
    since = np.diff(samples.time_ns, prepend=samples.time_ns[0] - nominal)
    # A sample after a gap is not an average over the gap: its period is the nominal one.
    since = np.minimum(since, nominal) / NANOSECONDS
    taken = take(samples, at)
    return Rows(taken.value, taken.aux, taken.mask & here[..., None], since[at])
