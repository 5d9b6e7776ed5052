"""Instants at which an estimate is asked for, besides those at which something was measured.

They enter the timeline as instants without samples, so that what is told there is the filter's (or
smoother's) own belief and not an interpolation.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from jaxekf._support.errors import RecordingError
from jaxekf.io.csv_table import need_time, read_table, read_times
from jaxekf.recordings.types import NANOSECONDS, Times

_MOST = 5_000_000


@dataclass(frozen=True)
class Every:
    """A regular grid of instants from the first of a run on; see `every`. Raises `ValueError` for a period
    that is no positive whole number."""

    period_ns: int

    def __post_init__(self) -> None:
        if not isinstance(self.period_ns, int) or self.period_ns < 1:
            raise ValueError(
                f"got a period of {self.period_ns!r} ns, expected a whole number of at least 1; see"
                " jaxekf.every, which takes seconds"
            )


Requested = Times | Every
"""Times (N,) int64 nanoseconds on the recording's clock, or a grid."""


def every(seconds: float) -> Every:
    """Instants of a run at this distance, the first of them where the run begins: for ``estimate(at=...)``.

    Raises `ValueError` for a distance that is not at least a nanosecond.
    """
    period = float(seconds) * NANOSECONDS
    if not 1.0 <= period < np.inf:
        raise ValueError(
            f"got a distance of {seconds} s, expected a nanosecond or more; pass seconds, such as 0.01"
        )
    return Every(round(period))


def read_requested(path: Path | str) -> Times:
    """The column ``time`` of a CSV file, decimal seconds on the recording's clock; others are not read."""
    if not Path(path).is_file():
        raise RecordingError(path, "no such file", "a CSV file of times", "another path")
    table = read_table(Path(path))
    need_time(table)
    return read_times(table)


def within(asked: Any, start: int, end: int, place: Path | str) -> tuple[Times, str | None]:
    """What was asked for of a run from `start` to `end`, ns, and a note on what lies outside of it.

    Raises `RecordingError` where nothing lies inside, where times do not increase or are not integers.
    """
    if isinstance(asked, Every):
        count = (end - start) // asked.period_ns + 1
        if count > _MOST:
            raise RecordingError(
                place,
                f"{count} instants {asked.period_ns} ns apart",
                f"no more than {_MOST}",
                "a longer distance between them",
            )
        return start + asked.period_ns * np.arange(count, dtype=np.int64), None
    times = np.asarray(asked)
    if times.ndim != 1 or times.dtype.kind not in "iu" or np.ma.isMaskedArray(asked):
        raise RecordingError(
            place,
            f"requested times of type {times.dtype} and shape {times.shape}, or masked",
            "int64 nanoseconds on the recording's clock, shape (N,), none masked",
            "np.round(seconds * 1e9).astype(np.int64), or jaxekf.every(seconds)",
        )
    times = times.astype(np.int64)
    if (np.diff(times) <= 0).any():
        raise RecordingError(
            place, "requested times that do not increase", "each once, in order", "np.unique"
        )
    inside = times[(times >= start) & (times <= end)]
    run = f"{start / NANOSECONDS:.6f} to {end / NANOSECONDS:.6f} s"
    if not inside.size:
        got = "no requested times"
        if times.size:
            got = f"requested times from {times[0] / NANOSECONDS:.6f} to {times[-1] / NANOSECONDS:.6f} s"
        raise RecordingError(
            place, got, f"some within the run, {run}", "times in the recording's clock and unit"
        )
    if len(inside) == len(times):
        return inside, None
    left = len(times) - len(inside)
    return inside, f"{left} of {len(times)} requested times lie outside the run, {run}: left out"
