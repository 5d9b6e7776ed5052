"""CSV files as columns of numbers and exact times, with every fault named by its place."""

import csv
import io
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from decimal import Decimal, InvalidOperation
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from jaxekf._support.errors import RecordingError
from jaxekf.io._csv_text import Text, read_text
from jaxekf.recordings.accounts import Indices, Place
from jaxekf.recordings.types import NANOSECONDS, Floats, Times

QUATERNION: tuple[str, ...] = ("qw", "qx", "qy", "qz")
POSITION: tuple[str, ...] = ("x", "y", "z")
TIME_UNITS = {"s": 9, "ms": 6, "us": 3, "µs": 3, "μs": 3, "ns": 0}
"""Powers of ten of a nanosecond."""

_PER_S = {"ms": 1e3, "µs": 1e6, "ns": 1e9}
_NUMBER = re.compile(
    r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?|[+-]?(nan|inf|infinity)", re.IGNORECASE
)
_LONGEST_TIME = 30
_LONGEST_WORD = 200
_CHUNK = 1 << 16
_LARGEST_NS = Decimal(2**63 - 1)


class Layout(NamedTuple):
    """How the columns of a file are laid out, where that is not as documented."""

    file: str | None = None
    columns: Mapping[str, str] | None = None
    """Our name of a column and the file's."""
    header: tuple[str, ...] | None = None
    """Names of all columns, of a file that has none; blank for one that is not read."""
    skip_lines: int = 0
    delimiter: str | None = None
    time_unit: str = "s"


@dataclass(frozen=True)
class Table:
    """A CSV file: its columns, and the cells below them."""

    path: Path
    columns: tuple[str, ...]
    """Names as this package knows them; blank for a column that is not read."""
    text: Text
    time_unit: str = "s"

    @property
    def lines(self) -> Indices:
        """(N,) number of the line of each row."""
        return self.text.lines

    @property
    def place(self) -> Place:
        """Where its rows stand."""
        return Place(self.path, self.text.lines)

    def __len__(self) -> int:
        return len(self.text.lines)

    def cell(self, row: int, name: str) -> str:
        """One cell, without blanks around it."""
        return self.text.cell(row, self.columns.index(name))

    def error(self, row: int, column: str, got: str, expected: str, hint: str) -> RecordingError:
        """A fault in one row."""
        return RecordingError(
            self.path, got, expected, hint, line=int(self.lines[row]), column=column
        )


class Sheet(NamedTuple):
    """What a CSV file is written from."""

    columns: Sequence[str]
    """Names of all columns after ``time``."""
    time_ns: Times
    values: Floats
    """(N, columns), without the column of words; NaN is written as a blank cell."""
    words: Sequence[str] | None = None
    """(N,) texts of the first column after ``time``, where that is not a number."""


def read_table(path: Path, layout: Layout | None = None) -> Table:
    """Read a file, its columns by the names that `layout` gives them.

    Raises `RecordingError` for what `read_text` refuses, and for columns twice or not there.
    """
    how = layout or Layout()
    text = read_text(path, skip_lines=how.skip_lines, header=how.header, delimiter=how.delimiter)
    names = text.header
    if how.columns is not None:
        names = _renamed(text, how.columns)
    if how.columns is None and how.header is None and "" in names[:-1]:
        raise RecordingError(
            path,
            f"a column without a name after '{names[names.index('') - 1]}'",
            "a name for each",
            "naming or removing it",
            line=text.header_line,
        )
    known = [name for name in names if name]
    if len(set(known)) != len(known):
        raise RecordingError(
            path,
            f"columns {','.join(text.header)}",
            "each once",
            "renaming one",
            line=text.header_line,
        )
    return Table(path, names, text, how.time_unit)


def _renamed(text: Text, columns: Mapping[str, str]) -> tuple[str, ...]:
    """Our names of the columns that the file calls so; blank for the others."""
    missing = [theirs for theirs in columns.values() if theirs not in text.header]
    if missing:
        raise RecordingError(
            text.path,
            f"columns {','.join(text.header)}",
            f"among them {','.join(missing)}, as recording.toml says",
            "correcting the names under columns in recording.toml",
            line=text.header_line,
        )
    ours = {theirs: name for name, theirs in columns.items()}
    if len(ours) != len(columns) or any(text.header.count(theirs) > 1 for theirs in ours):
        raise RecordingError(
            text.path,
            f"columns {','.join(text.header)} for {', '.join(columns.values())}",
            "each of them once",
            "correcting the names under columns in recording.toml",
            line=text.header_line,
        )
    return tuple(ours.get(name, "") for name in text.header)


def need_columns(table: Table, *layouts: str) -> None:
    """The columns are those of a layout as it is documented, such as ``time,angle[,scored]``.

    What stands in one pair of brackets is there whole or not at all; the order is free.
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
    """There is a column ``time``, whatever else there is."""
    if "time" not in table.columns:
        raise RecordingError(
            table.path,
            f"columns {','.join(table.columns)}",
            "one of the name time",
            "adding or renaming it",
            line=table.text.header_line,
        )


def numbers(table: Table, names: Sequence[str], *, blank: bool = False) -> Floats:
    """Columns as float64 (N, len(names)); with `blank`, empty cells are NaN."""
    at = [table.columns.index(name) for name in names]
    raw = table.text.data
    if blank and table.text.has_blank:
        raw = _nan_for_blank(raw)
    try:
        return np.loadtxt(
            io.TextIOWrapper(io.BytesIO(raw), "utf-8"),
            delimiter=",",
            usecols=at,
            comments=None,
            ndmin=2,
        )
    except ValueError:
        return _one_by_one(table, names, blank)


def _nan_for_blank(raw: bytes) -> bytes:
    """Cells without anything as ``nan``."""
    if b",," in raw:
        # Twice, for the second of three in a row ends where the first match does.
        raw = raw.replace(b",,", b",nan,").replace(b",,", b",nan,")
    if b",\n" in raw:
        raw = raw.replace(b",\n", b",nan\n")
    return raw.replace(b"\n,", b"\nnan,") if b"\n," in raw else raw


def _one_by_one(table: Table, names: Sequence[str], blank: bool) -> Floats:
    """The same cell by cell, to say which is none, and for numbers with blanks around them."""
    values = np.empty((len(table), len(names)))
    for j, name in enumerate(names):
        for i in range(len(table)):
            cell = table.cell(i, name)
            if blank and not cell:
                values[i, j] = np.nan
            elif _NUMBER.fullmatch(cell):
                values[i, j] = float(cell)
            else:
                raise table.error(i, name, f"'{cell}'", "a number", "correcting the cell")
    return values


def finite_numbers(table: Table, names: tuple[str, ...]) -> Floats:
    """Columns (N, len(names)) of finite numbers."""
    values = numbers(table, names)
    bad = np.argwhere(~np.isfinite(values))
    if bad.size:
        i, j = (int(at) for at in bad[0])
        raise table.error(i, names[j], f"{values[i, j]}", "a finite number", "removing the row")
    return values


def whole_or_blank(table: Table, names: Sequence[str]) -> Floats:
    """Columns (N, len(names)): in each row finite numbers, or NaN where all of its cells are blank."""
    values = numbers(table, names, blank=True)
    blank = np.isnan(values)
    bad = np.flatnonzero((blank.any(axis=1) & ~blank.all(axis=1)) | np.isinf(values).any(axis=1))
    if bad.size:
        row = int(bad[0])
        cells = [table.cell(row, name) for name in names]
        raise table.error(
            row,
            ",".join(names),
            f"'{','.join(cells)}'",
            f"{len(names)} finite numbers, or {len(names)} blank cells for what is not known",
            "completing or blanking them",
        )
    return values


def reported(table: Table, name: str, least: float = -np.inf) -> Floats | None:
    """A column (N,) of finite numbers not below `least`, NaN where blank; None without the column."""
    if name not in table.columns:
        return None
    values = numbers(table, (name,), blank=True)[:, 0]
    bad = np.flatnonzero(np.isinf(values) | (values < least))
    if bad.size:
        row = int(bad[0])
        raise table.error(
            row,
            name,
            f"{values[row]}",
            "a finite number" if np.isinf(least) else f"a finite number, {least:g} or more",
            "blanking the cell, which means that none was reported",
        )
    return values


def words(table: Table, name: str) -> NDArray[np.str_]:
    """A column (N,) of texts, without blanks around them."""
    at = table.columns.index(name)
    begin, end = table.text.begins(at), table.text.ends[:, at]
    width = int((end - begin).max(initial=1))
    if width > _LONGEST_WORD:
        return np.array([table.cell(i, name) for i in range(len(table))], str)
    rows = [
        _gather(table.text.data, begin[i : i + _CHUNK], end[i : i + _CHUNK], width)
        for i in range(0, len(table), _CHUNK)
    ]
    cells = np.concatenate(rows).view(f"S{width}")[:, 0]
    _, first, which = np.unique(cells, return_index=True, return_inverse=True)
    return np.array([table.cell(int(row), name) for row in first], str)[which]


def _gather(
    data: bytes, begin: NDArray[np.int64], end: NDArray[np.int64], width: int
) -> NDArray[np.uint8]:
    """(n, width) bytes of cells, filled up with zeros."""
    flat = np.frombuffer(data, np.uint8)
    at = begin[:, None] + np.arange(width)
    inside = at < end[:, None]
    return np.where(inside, flat[np.minimum(at, len(flat) - 1)], 0).astype(np.uint8)


def parse_seconds(text: str, exponent: int = 9) -> int:
    """Decimal seconds, or other units by their `exponent`, to nanoseconds, exactly; what is beyond is
    rounded. Raises `ValueError` for what is no time within the 64 bits of nanoseconds."""
    whole, _, part = text.partition(".")
    digits = (whole + part).isascii() and whole.isdigit() and (part.isdigit() or not part)
    if exponent == 9 and digits and len(whole) < 10 and len(part) <= 9:
        return int(whole) * NANOSECONDS + int(part.ljust(9, "0") or 0)
    if not _NUMBER.fullmatch(text):
        raise ValueError(text)
    value = Decimal(text)
    if not value.is_finite() or value.adjusted() > 20:
        raise ValueError(text)
    value = value.scaleb(exponent).to_integral_value()
    if not -_LARGEST_NS - 1 <= value <= _LARGEST_NS:
        raise ValueError(text)
    return int(value)


def stamps(table: Table) -> Times:
    """The column ``time`` (N,) in nanoseconds, in whatever order."""
    at = table.columns.index("time")
    exponent = TIME_UNITS[table.time_unit]
    begin, end = table.text.begins(at), table.text.ends[:, at]
    times = np.zeros(len(table), np.int64)
    for i in range(0, len(table), _CHUNK):
        chunk = slice(i, i + _CHUNK)
        found, plain = _plain_times(table.text.data, begin[chunk], end[chunk], exponent)
        times[chunk] = found
        for row in np.flatnonzero(~plain):
            cell = table.cell(i + int(row), "time")
            try:
                times[i + row] = parse_seconds(cell, exponent)
            except (InvalidOperation, ValueError, OverflowError):
                raise _no_time(table, i + int(row), cell) from None
    return times


def _no_time(table: Table, row: int, cell: str) -> RecordingError:
    """What is wrong with a cell that is no time; of numbers beyond 292 years, what unit they may be in."""
    unit, hint = table.time_unit, "correcting the cell"
    if _NUMBER.fullmatch(cell) and Decimal(cell).is_finite() and len(table) > 1:
        other = table.cell(row - 1 if row else 1, "time")
        if _NUMBER.fullmatch(other) and Decimal(other).is_finite():
            step = abs(Decimal(cell) - Decimal(other))
            fits = [u for u in ("ms", "µs", "ns") if 5e-5 < float(step) / _PER_S[u] < 0.5]
            hint = f'stating the unit of its times: time_unit = "{fits[0]}"' if fits else hint
    expected = "seconds" if unit == "s" else unit
    return table.error(row, "time", f"'{cell}'", f"a time in {expected}, within 292 years", hint)


def _plain_times(
    data: bytes, begin: NDArray[np.int64], end: NDArray[np.int64], exponent: int
) -> tuple[Times, NDArray[np.bool_]]:
    """Times of cells that are digits with at most one point, and which cells are."""
    width = int((end - begin).max(initial=1))
    plain = (end > begin) & (end - begin <= 19)
    cells = _gather(data, begin, end, min(width, 19))
    value = np.zeros(len(begin), np.int64)
    digits, decimals = np.zeros((2, len(begin)), np.int64)
    after = np.zeros(len(begin), bool)
    for column in cells.T:
        digit = (column >= 48) & (column <= 57)
        point = column == 46
        plain &= digit | (point & ~after) | (column == 0)
        value = np.where(digit, value * 10 + (column - 48), value)
        digits += digit
        decimals += digit & after
        after |= point
    power = exponent - decimals
    # Digits and zeros together stay below 2**63; a fraction of a nanosecond has to be rounded.
    plain &= (digits > 0) & (power >= 0) & (digits + power <= 18)
    return np.where(plain, value * 10 ** np.clip(power, 0, 18), 0), plain


def read_times(table: Table, *, repeated: bool = False) -> Times:
    """The column ``time`` (N,), which increases; with `repeated`, rows that follow may share a time."""
    times = stamps(table)
    step = np.diff(times)
    backwards = np.flatnonzero(step < 0 if repeated else step <= 0)
    if backwards.size:
        i = int(backwards[0]) + 1
        raise table.error(
            i,
            "time",
            f"{table.cell(i, 'time')} after {table.cell(i - 1, 'time')}",
            "times that do not decrease" if repeated else "times that increase",
            "sorting the rows" if repeated else "sorting the rows and removing duplicates",
        )
    return times


def flags(table: Table, name: str) -> NDArray[np.bool_]:
    """A column (N,) of which other numbers than 0 are true; all true without it."""
    if name not in table.columns:
        return np.ones(len(table), bool)
    return finite_numbers(table, (name,))[:, 0] != 0.0


def format_seconds(time_ns: int, decimals: int = 0) -> str:
    """Nanoseconds as decimal seconds, exactly; trailing zeros only to fill so many `decimals`."""
    sign, size = ("-", -time_ns) if time_ns < 0 else ("", time_ns)
    whole, part = divmod(int(size), NANOSECONDS)
    digits = f"{part:09d}".rstrip("0").ljust(decimals, "0")
    return f"{sign}{whole}.{digits}" if digits else f"{sign}{whole}"


def write_csv(
    path: Path, columns: Sequence[str], time_ns: Times, values: Floats, digits: int
) -> None:
    """A CSV file of a time column and numbers; NaN is written as a blank cell."""
    write_sheet(path, Sheet(columns, time_ns, values), digits)


def write_sheet(path: Path, sheet: Sheet, digits: int) -> None:
    """A CSV file of a time column, maybe one of words, and numbers with so many digits."""
    with path.open("w", encoding="utf-8", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(["time", *sheet.columns])
        for i, (time, row) in enumerate(zip(sheet.time_ns, sheet.values, strict=True)):
            cells = ["" if np.isnan(v) else f"{v:.{digits}g}" for v in row]
            words = () if sheet.words is None else (sheet.words[i],)
            writer.writerow([format_seconds(int(time)), *words, *cells])
