"""Files with one line for each part, such as a marker, of each frame: lines as frames, and what became of
each part.

The lines of a frame are consecutive and share one time.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from jaxekf.io.csv_table import Sheet, Table, stamps, words
from jaxekf.recordings import screening
from jaxekf.recordings.accounts import Indices, Intake, Part, Place
from jaxekf.recordings.types import Camera, Flags, Floats, Markers, Times


class Frames(NamedTuple):
    """The n lines of a file that are kept, in order of time, and the N frames that they are of."""

    time_ns: Times
    """(N,) stamps of the frames."""
    lines: Indices
    """(n,) which of the file's lines they are, counted from 0."""
    times: Times
    """(n,) their stamps."""
    frame: Indices
    """(n,) which frame each is of."""
    part: Indices
    """(n,) which part each is of."""
    names: tuple[str, ...]
    """Names of the M parts."""

    def spread(self, values: Floats) -> Floats:
        """Values (lines of the file, ...) as (N, M, ...), NaN where a frame has no line of a part."""
        shape = (len(self.time_ns), len(self.names), *values.shape[1:])
        found = np.full(shape, np.nan)
        found[self.frame, self.part] = values[self.lines]
        return found


def frames(
    table: Table,
    columns: Sequence[Floats],
    part: Indices,
    names: tuple[str, ...],
    *,
    sort: bool,
    slowest_s: float = screening.SLOWEST_S,
) -> tuple[Frames, Intake]:
    """The frames of a table whose lines are each of a part, and the account of its lines.

    `columns` are all numbers that a line has, by which a repeated line is recognised. Raises what
    `intake.in_order` and `intake.check_rate` do.
    """
    every = stamps(table)
    order, account = screening.in_order(
        table.place, every, columns, sort=sort, part=part, parts=names
    )
    times, kept = every[order], part[order]
    first: Flags = np.concatenate([[True], np.diff(times) > 0])
    frame = np.cumsum(first) - 1
    made = Frames(times[first], order, times, frame, kept, names)
    screening.check_rate(table.place, made.time_ns, slowest_s)
    count = np.bincount(part, minlength=len(names))
    there = np.zeros((len(made.time_ns), len(names)), bool)
    there[frame, kept] = True
    gone = np.setdiff1d(np.arange(len(part)), order)
    parts = {
        name: Part(int(count[m]), every[gone[part[gone] == m]], made.time_ns[~there[:, m]])
        for m, name in enumerate(names)
    }
    return made, replace(account, parts=parts)


def part_of_each_line(
    table: Table, part: str, names: tuple[str, ...], expected: str, adding: Callable[[str], str]
) -> Indices:
    """Index (lines,) into `names` of the part that each line is of, by the name in the column `part`.

    `expected` and `adding` are the texts of the error for an unknown name: expectation and remedy.
    """
    index = {name: i for i, name in enumerate(names)}
    cells = words(table, part)
    kinds, which = np.unique(cells, return_inverse=True)
    found = np.array([index.get(str(kind), -1) for kind in kinds], np.intp)[which]
    bad = np.flatnonzero(found < 0)
    if bad.size:
        name = str(cells[bad[0]])
        hint = adding(name) if name else f"naming the {part} or removing the line"
        raise table.error(int(bad[0]), part, f"{part} '{name}'", expected, hint)
    return found


def part_sheet(
    stream: Markers | Camera, part: str, columns: Sequence[str], values: Floats, *reported: str
) -> Sheet:
    """A line for every part of every sample: its `values` (N, M, c), blank where it is not seen, and
    the figures that were `reported` of it, where the stream has them."""
    names = [part, *columns]
    blocks = [values.reshape(-1, len(columns))]
    for key in reported:
        if (figures := getattr(stream, key)) is not None:
            names.append(key)
            blocks.append(figures.reshape(-1, 1))
    samples, count = values.shape[:2]
    times = np.repeat(stream.time_ns, count)
    return Sheet(names, times, np.concatenate(blocks, axis=1), stream.names * samples)


NAMES = "printable names, without blanks at their ends, each once"
"""Requirement for names of parts: a cell of a CSV file can hold them and give them back."""


def bad_name(names: Sequence[str]) -> int | None:
    """The first of some names that is none, or is there before; None where all are good."""
    seen: set[str] = set()
    for i, name in enumerate(names):
        if not name or name != name.strip() or not name.isprintable() or name in seen:
            return i
        seen.add(name)
    return None


def check_names(place: Place, names: Sequence[str], part: str) -> None:
    """Raise `RecordingError` unless each part has a name of its own, as a CSV file can hold, and one
    exists."""
    bad = bad_name(names)
    if bad is not None:
        raise place.error(bad, "names", repr(names[bad]), NAMES, f"renaming the {part}")
    if not names:
        raise place.error(None, None, f"no {part}", "at least one", "giving its name and position")


def dense_frames(
    place: Place,
    time_ns: Times,
    rows: Sequence[Any],
    names: tuple[str, ...],
    sort: bool,
    slowest_s: float = screening.SLOWEST_S,
) -> tuple[Times, Indices, Intake]:
    """Frames that hold every part: their times, their indices in order of time, and the account, in which
    each part of each frame is a row."""
    order, account = screening.in_order(place, time_ns, rows, sort=sort)
    screening.check_rate(place, time_ns[order], slowest_s)
    count = len(names)
    repeated = {
        reason: replace(r, numbers=np.repeat(r.numbers, count), time_ns=np.repeat(r.time_ns, count))
        for reason, r in account.dropped.items()
    }
    again = [r.time_ns for r in account.dropped.values()]
    none = time_ns[:0]
    parts = {name: Part(len(time_ns), np.concatenate([*again, none]), none) for name in names}
    account = replace(account, rows=len(time_ns) * count, dropped=repeated, parts=parts)
    return time_ns[order], order, account
