"""Output times: instants of an estimate in addition to those of the measurements.

They are instants of the timeline without samples, so that the estimate there is the filter's or smoother's
own belief and not an interpolation.
"""

from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from jaxekf._support import arrays
from jaxekf._support.errors import ArgumentError, RecordingError
from jaxekf.io.csv_table import need_time, read_table, read_times
from jaxekf.recordings.types import NANOSECONDS, Times

_MOST = 5_000_000


@dataclass(frozen=True)
class Every:
    """A regular grid of output times that begins at the first instant of a run; see `every`.

    Raises
    ------
    ArgumentError
        The period is not a positive integer.

    Examples
    --------
    An estimate at 50 Hz, of a run of 24 s:

    >>> import jaxekf
    >>> jaxekf.set_up()
    >>> grid = jaxekf.Every(20_000_000)
    >>> estimate = jaxekf.estimate(jaxekf.demo.FOLDER / "free-5", at=grid)
    >>> len(estimate.requested.time_ns)
    1201
    """

    period_ns: int
    """Period in nanoseconds, at least 1."""

    def __post_init__(self) -> None:
        period = arrays.whole_number(self.period_ns, arrays.argument("period_ns"))
        if period < 1:
            raise ArgumentError(
                f"got a period of {period} ns, expected a whole number of at least 1; see jaxekf.every,"
                " which takes seconds"
            )
        object.__setattr__(self, "period_ns", period)


OutputTimes = Times | Every
"""Output times (N,) in int64 nanoseconds on the estimate's clock, or a grid."""


def every(seconds: float) -> Every:
    """A regular grid of output times, for ``estimate(at=...)``.

    Parameters
    ----------
    seconds
        Period of the grid in seconds, at least 1e-9.

    Returns
    -------
    Every
        The grid. It begins at the first instant of the run that is estimated.

    Raises
    ------
    ArgumentError
        The period is not a number, is less than a nanosecond, or is not finite.

    Examples
    --------
    The attitude at 50 Hz:

    >>> import jaxekf
    >>> jaxekf.set_up()
    >>> estimate = jaxekf.estimate(jaxekf.demo.FOLDER / "free-5", at=jaxekf.every(0.02))
    >>> estimate.requested.attitude.value.shape
    (1201, 4)
    """
    period = arrays.number(seconds, arrays.argument("seconds")) * NANOSECONDS
    if not 1.0 <= period < np.inf:
        raise ArgumentError(
            f"got a period of {seconds} s, expected a nanosecond or more; pass seconds, such as 0.01"
        )
    return Every(round(period))


def read_output_times(path: Path | str) -> Times:
    """Read output times from a CSV file.

    Parameters
    ----------
    path
        A file with the column ``time``, decimal seconds on the estimate's clock; others are ignored.

    Returns
    -------
    Times
        (N,) int64 nanoseconds.

    Raises
    ------
    RecordingError
        There is no such file, or it has no column of times.
    """
    if not Path(path).is_file():
        raise RecordingError(path, "no such file", "a CSV file of times", "another path")
    table = read_table(Path(path))
    need_time(table)
    return read_times(table)


def select_output_times(
    requested: Any, start: int, end: int, place: Path | str
) -> tuple[Times, str | None]:
    """The output times within a run.

    Parameters
    ----------
    requested
        Times (N,) int64 nanoseconds, or a grid.
    start, end
        First and last instant of the run, ns.
    place
        The recording, for error messages.

    Returns
    -------
    Times
        The requested times from `start` to `end`, (M,) int64 nanoseconds.
    str or None
        A note on the times that are outside the run.

    Raises
    ------
    RecordingError
        No time is within the run, or the times do not increase, are not integers, or are too many.
    """
    if isinstance(requested, Every):
        count = (end - start) // requested.period_ns + 1
        if count > _MOST:
            raise RecordingError(
                place,
                f"{count} instants {requested.period_ns} ns apart",
                f"no more than {_MOST}",
                "a longer period",
            )
        return start + requested.period_ns * np.arange(count, dtype=np.int64), None
    times = arrays.times(requested, partial(RecordingError, f"{place}: requested times (at)"))
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
            place, got, f"some within the run, {run}", "times on the estimate's clock and unit"
        )
    if len(inside) == len(times):
        return inside, None
    left = len(times) - len(inside)
    return inside, f"{left} of {len(times)} requested times are outside the run, {run}: left out"
