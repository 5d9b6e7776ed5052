"""CSV files as columns of numbers and exact times; errors name the file, line and column."""

import csv
import io
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from decimal import Decimal
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from jaxekf._support.errors import RecordingError
from jaxekf.io._csv_text import Text, read_text
from jaxekf.io._csv_times import (
    CHUNK,
    NUMBER,
    format_seconds,
    gather,
    parse_seconds,
    parsed_times,
    scaled,
)
from jaxekf.recordings.accounts import Indices, Place
from jaxekf.recordings.types import Floats, Times

QUATERNION: tuple[str, ...] = ("qw", "qx", "qy", "qz")
POSITION: tuple[str, ...] = ("x", "y", "z")
TIME_UNITS = {"s": 9, "ms": 6, "us": 3, "µs": 3, "μs": 3, "ns": 0}
"""Powers of ten of a nanosecond."""

_PER_S = {"ms": 1e3, "µs": 1e6, "ns": 1e9}
_LONGEST_WORD = 200
_SPACES = re.compile(rb"(?:(?<=[,\n])|\A)[ \t]+(?=[,\n])")
"""Cells that hold spaces only."""


class Layout(NamedTuple):
    """Layout of a file's columns, if it differs from the documented one."""

    file: str | None = None
    columns: Mapping[str, str] | None = None
    """This package's name of a column, and the file's."""
    header: tuple[str, ...] | None = None
    """Names of all columns, of a file that has none; blank for one that is not read."""
    skip_lines: int = 0
    delimiter: str | None = None
    time_unit: str = "s"


@dataclass(frozen=True)
class Table:
    """A CSV file: its columns by name, and the cells below them."""

    path: Path
    columns: tuple[str, ...]
    """Names as this package knows them; blank for a column that is not read."""
    text: Text
    time_unit: str = "s"
    times: Times | None = None
    """(N,) stamps that were repaired, ns; None to take those of the column ``time``."""

    @property
    def lines(self) -> Indices:
        """(N,) number of each row's line."""
        return self.text.lines

    @property
    def place(self) -> Place:
        """The file and the lines of its rows, for messages."""
        return Place(self.path, self.text.lines)

    def __len__(self) -> int:
        return len(self.text.lines)

    def cell(self, row: int, name: str) -> str:
        """One cell, without spaces around it."""
        return self.text.cell(row, self.columns.index(name))

    def number(self, row: int, name: str) -> str:
        """One cell, a number's decimal mark as a point."""
        cell = self.cell(row, name)
        return cell.replace(",", ".") if self.text.decimal_commas else cell

    def named(self, names: Mapping[int, str]) -> "Table":
        """The same table with only these columns, by index, read."""
        columns = tuple(names.get(i, "") for i in range(len(self.columns)))
        return replace(self, columns=columns)

    def take(self, chosen: NDArray[np.bool_]) -> "Table":
        """The rows that a mask (N,) chooses."""
        times = None if self.times is None else self.times[chosen]
        return replace(self, text=self.text.take(chosen), times=times)

    def error(self, row: int, column: str, got: str, expected: str, hint: str) -> RecordingError:
        """The error of one cell."""
        return RecordingError(
            self.path, got, expected, hint, line=int(self.lines[row]), column=column
        )


class Sheet(NamedTuple):
    """Content of a CSV file to be written."""

    columns: Sequence[str]
    """Names of all columns after ``time``."""
    time_ns: Times
    values: Floats
    """(N, columns) without the column of words; NaN is written as a blank cell."""
    words: Sequence[str] | None = None
    """(N,) texts of the first column after ``time``, if it is not a number."""


def read_table(path: Path, layout: Layout | None = None) -> Table:
    """Read a file; `layout` gives the names of its columns.

    Raises
    ------
    RecordingError
        As `read_text` does, and if a column is missing or present twice.
    """
    how = layout or Layout()
    text = read_text(path, skip_lines=how.skip_lines, header=how.header, delimiter=how.delimiter)
    names = text.header
    if how.columns is not None:
        names = _renamed(text, how.columns)
    if how.columns is None and how.header is None and "" in names[:-1]:
        got = f"a column without a name after '{names[names.index('') - 1]}'"
        expected = "a name for each"
        raise RecordingError(path, got, expected, "naming or removing it", line=text.header_line)
    known = [name for name in names if name]
    if len(set(known)) != len(known):
        got = f"columns {','.join(text.header)}"
        raise RecordingError(path, got, "each once", "renaming one", line=text.header_line)
    return Table(path, names, text, how.time_unit)


def _renamed(text: Text, columns: Mapping[str, str]) -> tuple[str, ...]:
    """This package's name of each of the file's columns; blank for a column that is not read."""
    missing = [theirs for theirs in columns.values() if theirs not in text.header]
    if missing:
        got = f"columns {','.join(text.header)}"
        expected = f"among them {','.join(missing)}, as recording.toml states"
        hint = "correcting the names under columns in recording.toml"
        raise RecordingError(text.path, got, expected, hint, line=text.header_line)
    ours = {theirs: name for name, theirs in columns.items()}
    if len(ours) != len(columns) or any(text.header.count(theirs) > 1 for theirs in ours):
        got = f"columns {','.join(text.header)} for {', '.join(columns.values())}"
        hint = "correcting the names under columns in recording.toml"
        raise RecordingError(text.path, got, "each of them once", hint, line=text.header_line)
    return tuple(ours.get(name, "") for name in text.header)


def need_columns(table: Table, *layouts: str) -> None:
    """Raise unless the columns are those of a documented layout, such as ``time,angle[,scored]``.

    Columns in one pair of brackets are present together or absent together; the order is free.
    """
    known = {name for name in table.columns if name}
    for layout in layouts:
        required, *optional = (part.split(",") for part in layout.replace("]", "").split("[,"))
        left = known - set(required)
        for group in optional:
            if left >= set(group):
                left -= set(group)
        if set(required) <= known and not left:
            return
    raise RecordingError(
        table.path,
        f"columns {','.join(name for name in table.columns if name)}",
        " or ".join(layouts),
        "renaming, adding or removing columns, or stating which is which under columns in"
        " recording.toml",
        line=table.text.header_line,
    )


def need_time(table: Table) -> None:
    """Raise unless there is a column ``time``."""
    if "time" not in table.columns:
        got = f"columns {','.join(table.columns)}"
        expected = "one of the name time"
        hint = "adding or renaming it"
        raise RecordingError(table.path, got, expected, hint, line=table.text.header_line)


def numbers(table: Table, names: Sequence[str], *, blank: bool = False) -> Floats:
    """Columns as float64 (N, len(names)); with `blank`, empty cells are NaN."""
    at = [table.columns.index(name) for name in names]
    raw = table.text.with_decimal_points()
    if blank and table.text.has_blank:
        raw = _nan_for_empty(raw)
    try:
        return _loaded(raw, at)
    except ValueError:
        if not blank:
            return _one_by_one(table, names, blank)
    try:
        # Some empty cells may hold spaces.
        return _loaded(_SPACES.sub(b"nan", raw), at)
    except ValueError:
        return _one_by_one(table, names, blank)


def _loaded(raw: bytes, columns: Sequence[int]) -> Floats:
    return np.loadtxt(
        io.TextIOWrapper(io.BytesIO(raw), "utf-8"),
        delimiter=",",
        usecols=columns,
        comments=None,
        ndmin=2,
    )


def _nan_for_empty(raw: bytes) -> bytes:
    """Empty cells as ``nan``."""
    if b",," in raw:
        # Twice: a match ends where the next of three commas in a row would begin.
        raw = raw.replace(b",,", b",nan,").replace(b",,", b",nan,")
    if b",\n" in raw:
        raw = raw.replace(b",\n", b",nan\n")
    raw = raw.replace(b"\n,", b"\nnan,") if b"\n," in raw else raw
    return b"nan" + raw if raw.startswith(b",") else raw


def _one_by_one(table: Table, names: Sequence[str], blank: bool) -> Floats:
    """Columns read cell by cell, which names the first cell that is not a number."""
    values = np.empty((len(table), len(names)))
    for j, name in enumerate(names):
        for i in range(len(table)):
            cell = table.number(i, name)
            if blank and not cell:
                values[i, j] = np.nan
            elif NUMBER.fullmatch(cell):
                values[i, j] = float(cell)
            else:
                raise _not_a_number(table, i, name)
    return values


def _not_a_number(table: Table, row: int, name: str) -> RecordingError:
    return table.error(row, name, f"'{table.cell(row, name)}'", "a number", "correcting the cell")


def finite_numbers(table: Table, names: tuple[str, ...]) -> Floats:
    """Columns (N, len(names)) of finite numbers."""
    values = numbers(table, names)
    bad = np.argwhere(~np.isfinite(values))
    if bad.size:
        i, j = (int(at) for at in bad[0])
        raise table.error(i, names[j], f"{values[i, j]}", "a finite number", "removing the row")
    return values


def whole_or_blank(table: Table, names: Sequence[str]) -> Floats:
    """Columns (N, len(names)): each row holds finite numbers, or NaN if all its cells are blank."""
    values = numbers(table, names, blank=True)
    blank = np.isnan(values)
    bad = np.flatnonzero((blank.any(axis=1) & ~blank.all(axis=1)) | np.isinf(values).any(axis=1))
    if bad.size:
        row = int(bad[0])
        cells = [table.cell(row, name) for name in names]
        got = f"'{','.join(cells)}'"
        expected = f"{len(names)} finite numbers, or {len(names)} blank cells for unknown values"
        raise table.error(row, ",".join(names), got, expected, "completing or blanking them")
    return values


def reported(table: Table, name: str, least: float = -np.inf) -> Floats | None:
    """A column (N,) of finite numbers of at least `least`, NaN for blank cells; None without the column."""
    if name not in table.columns:
        return None
    values = numbers(table, (name,), blank=True)[:, 0]
    bad = np.flatnonzero(np.isinf(values) | (values < least))
    if bad.size:
        row = int(bad[0])
        expected = "a finite number" if np.isinf(least) else f"a finite number, {least:g} or more"
        hint = "blanking the cell, which means that no value was reported"
        raise table.error(row, name, f"{values[row]}", expected, hint)
    return values


def words(table: Table, name: str) -> NDArray[np.str_]:
    """A column (N,) of texts, without spaces around them."""
    at = table.columns.index(name)
    begin, end = table.text.begins(at), table.text.ends[:, at]
    width = int((end - begin).max(initial=1))
    if width > _LONGEST_WORD:
        return np.array([table.cell(i, name) for i in range(len(table))], str)
    rows = [
        gather(table.text.data, begin[i : i + CHUNK], end[i : i + CHUNK], width)
        for i in range(0, len(table), CHUNK)
    ]
    cells = np.concatenate(rows).view(f"S{width}")[:, 0]
    _, first, which = np.unique(cells, return_index=True, return_inverse=True)
    return np.array([table.cell(int(row), name) for row in first], str)[which]


def stamps(table: Table) -> Times:
    """The column ``time`` (N,) in nanoseconds, in any order, with repairs."""
    if table.times is not None:
        return table.times
    exponent = TIME_UNITS[table.time_unit]

    def parsed(row: int) -> int:
        try:
            return parse_seconds(table.number(row, "time"), exponent)
        except ValueError:
            raise _no_time(table, row) from None

    return parsed_times(
        table.text, table.columns.index("time"), Decimal(1).scaleb(exponent), parsed
    )


def times_or_blank(
    table: Table, name: str, unit_ns: int | Decimal
) -> tuple[Times, NDArray[np.bool_]]:
    """A column (N,) of times in units of `unit_ns` nanoseconds, exact, and which cells are not blank."""
    known = np.ones(len(table), bool)

    def parsed(row: int) -> int:
        cell = table.number(row, name)
        known[row] = bool(cell)
        try:
            return scaled(cell, Decimal(unit_ns)) if cell else 0
        except ValueError:
            if not NUMBER.fullmatch(cell):
                raise _not_a_number(table, row, name) from None
            raise table.error(row, name, f"'{cell}'", "a time", "correcting the cell") from None

    return parsed_times(table.text, table.columns.index(name), Decimal(unit_ns), parsed), known


def _no_time(table: Table, row: int) -> RecordingError:
    """The error of a cell that is not a time; for one beyond 292 years, with the unit it may have."""
    unit, hint = table.time_unit, "correcting the cell"
    cell = table.number(row, "time")
    if NUMBER.fullmatch(cell) and Decimal(cell).is_finite() and len(table) > 1:
        other = table.number(row - 1 if row else 1, "time")
        if NUMBER.fullmatch(other) and Decimal(other).is_finite():
            step = abs(Decimal(cell) - Decimal(other))
            fits = [u for u in ("ms", "µs", "ns") if 5e-5 < float(step) / _PER_S[u] < 0.5]
            hint = f'stating the unit of its times: time_unit = "{fits[0]}"' if fits else hint
    expected = "seconds" if unit == "s" else unit
    return table.error(row, "time", f"'{cell}'", f"a time in {expected}, within 292 years", hint)


def read_times(table: Table) -> Times:
    """The column ``time`` (N,), which increases."""
    times = stamps(table)
    check_increasing(table, times)
    return times


def check_increasing(table: Table, times: Times) -> None:
    """Raise at the first time (N,) that does not increase."""
    backwards = np.flatnonzero(np.diff(times) <= 0)
    if backwards.size:
        i = int(backwards[0]) + 1
        got = f"{table.cell(i, 'time')} after {table.cell(i - 1, 'time')}"
        hint = "sorting the rows and removing duplicates"
        raise table.error(i, "time", got, "times that increase", hint)


def flags(table: Table, name: str) -> NDArray[np.bool_]:
    """A column (N,), true for numbers other than 0; all true without the column."""
    if name not in table.columns:
        return np.ones(len(table), bool)
    return finite_numbers(table, (name,))[:, 0] != 0.0


def write_csv(
    path: Path, columns: Sequence[str], time_ns: Times, values: Floats, digits: int
) -> None:
    """Write a CSV file of a time column and numbers; NaN becomes a blank cell."""
    write_sheet(path, Sheet(columns, time_ns, values), digits)


def write_sheet(path: Path, sheet: Sheet, digits: int) -> None:
    """Write a CSV file of a time column, perhaps one of words, and numbers of `digits` digits."""
    with path.open("w", encoding="utf-8", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(["time", *sheet.columns])
        for i, (time, row) in enumerate(zip(sheet.time_ns, sheet.values, strict=True)):
            cells = ["" if np.isnan(v) else f"{v:.{digits}g}" for v in row]
            words = () if sheet.words is None else (sheet.words[i],)
            writer.writerow([format_seconds(int(time)), *words, *cells])
