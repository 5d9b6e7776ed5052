"""Places of a stream's rows in its source, and the account of used, masked and dropped rows."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from jaxekf._support.errors import RecordingError

Times = NDArray[np.int64]
Indices = NDArray[np.intp]


class Place(NamedTuple):
    """Source of a stream's rows, for messages."""

    path: Path | str
    """A file, or ``file.h5:imu`` for a group of data sets."""
    numbers: Indices | None = None
    """(N,) number of the line of each row; None where rows are counted from 0."""
    samples: bool = False
    """Whether the numbers are those of samples, counted from 0, and not of lines."""

    @property
    def unit(self) -> str:
        """``line`` or ``sample``: the unit of the numbers."""
        return "sample" if self.numbers is None or self.samples else "line"

    def number(self, row: int) -> int:
        """Line or sample of a row."""
        return int(row) if self.numbers is None else int(self.numbers[row])

    def take(self, chosen: Indices) -> "Place":
        """The place of some of the rows, in their order."""
        numbers = chosen if self.numbers is None else self.numbers[chosen]
        return Place(self.path, numbers, self.unit == "sample")

    def error(
        self, row: int | None, column: str | None, got: str, expected: str, hint: str
    ) -> RecordingError:
        """A fault of one row, or of all of them."""
        if row is None or self.unit == "line":
            line = None if row is None else self.number(row)
            return RecordingError(self.path, got, expected, hint, line=line, column=column)
        number = self.number(row)
        whole = f"{self.path}/{column}[{number}]" if column else f"{self.path}[{number}]"
        return RecordingError(whole, got, expected, hint)


@dataclass(frozen=True)
class Reason:
    """Rows that were masked or dropped for the same reason."""

    numbers: Indices
    """Lines, or samples, of the rows, ascending."""
    time_ns: Times
    """(N,) their stamps."""

    @property
    def count(self) -> int:
        """How many there are."""
        return len(self.numbers)


class Part(NamedTuple):
    """Rows of one part of a stream whose rows are of several, such as one marker's."""

    rows: int
    dropped: Times
    """Stamps of its rows that were dropped."""
    absent: Times
    """Stamps of the stream's samples for which this part has no row."""


@dataclass(frozen=True)
class Intake:
    """Account of the rows of one stream: used, masked and dropped."""

    rows: int
    """Rows of samples in the source."""
    masked: Mapping[str, Reason] = field(default_factory=dict)
    dropped: Mapping[str, Reason] = field(default_factory=dict)
    notes: tuple[str, ...] = ()
    """Further changes, in sentences."""
    unit: str = "line"
    numbers: Indices | None = None
    """(N,) line or sample of each sample of the stream, which may be fewer than rows."""

    has_status: bool = False
    """Whether the source has a status for each row."""
    rounded: bool = False
    """Whether its numbers have so few decimals that a resting tool may repeat them."""
    parts: Mapping[str, Part] = field(default_factory=dict)
    """Accounts of the single markers, by name."""

    def sentences(self, label: str) -> tuple[str, ...]:
        """One warning for each reason, with count and first and last place."""
        found = []
        for verb, reasons in (("masked", self.masked), ("dropped", self.dropped)):
            for name, reason in reasons.items():
                first, last = reason.numbers[0], reason.numbers[-1]
                what = "row is" if reason.count == 1 else "rows are"
                where = f"{self.unit} {first}"
                if reason.count > 1:
                    where = f"{self.unit}s {first} to {last}"
                found.append(f"{label}: {reason.count} {what} {verb}, {name} ({where})")
        return (*found, *(f"{label}: {text}" for text in self.notes))

    def as_dict(self) -> dict[str, object]:
        """For JSON: count, first and last place by reason."""

        def counts(reasons: Mapping[str, Reason]) -> dict[str, object]:
            return {
                name: {
                    "count": reason.count,
                    "first": int(reason.numbers[0]),
                    "last": int(reason.numbers[-1]),
                }
                for name, reason in reasons.items()
            }

        return {
            "rows": self.rows,
            "masked": counts(self.masked),
            "dropped": counts(self.dropped),
            "notes": list(self.notes),
            "numbers_are": f"{self.unit}s",
        }

    def with_masked(self, name: str, reason: Reason) -> "Intake":
        """The same with more rows masked."""
        return self if reason.count == 0 else replace(self, masked={**self.masked, name: reason})
