"""CSV files as columns of numbers and exact times, with every fault named by its place."""

import csv
from collections.abc import Sequence
from decimal import Decimal, InvalidOperation
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from jaxekf.errors import RecordingError
from jaxekf.recording import NANOSECONDS, Floats, Times

QUATERNION: tuple[str, ...] = ("qw", "qx", "qy", "qz")
POSITION: tuple[str, ...] = ("x", "y", "z")


class Table(NamedTuple):
    """A CSV file as text, its rows with the number of their line."""

    path: Path
    columns: tuple[str, ...]
    rows: list[list[str]]
    lines: list[int]


class Sheet(NamedTuple):
    """What a CSV file is written from."""

    columns: Sequence[str]
    """Names of all columns after ``time``."""
    time_ns: Times
    values: Floats
    """(N, columns), without the column of words; NaN is written as a blank cell."""
    words: Sequence[str] | None = None
    """(N,) texts of the first column after ``time``, where that is not a number."""


def read_table(path: Path) -> Table:
    if not path.is_file():
        raise RecordingError(
            path, "no such file", "the stream named in recording.toml", "adding it"
        )
    try:
        text = path.read_text("utf-8-sig")
    except (UnicodeDecodeError, OSError) as error:
        raise RecordingError(
            path, f"unreadable text ({error})", "UTF-8", "saving as UTF-8"
        ) from error
    rows, lines = [], []
    reader = csv.reader(text.splitlines())
    for row in reader:
        if row:
            rows.append(row)
            lines.append(reader.line_num)
    if not rows:
        raise RecordingError(
            path, "an empty file", "a header and samples", "exporting the run again"
        )
    columns = tuple(cell.strip() for cell in rows[0])
    if len(rows) == 1:
        raise RecordingError(path, "0 samples", "at least one", "exporting the run again", line=1)
    if len(set(columns)) != len(columns):
        raise RecordingError(path, f"columns {list(columns)}", "each once", "renaming one", line=1)
    for row, line in zip(rows[1:], lines[1:], strict=True):
        if len(row) != len(columns):
            raise RecordingError(
                path,
                f"{len(row)} cells",
                f"{len(columns)} as in the header",
                "completing the row or removing it",
                line=line,
            )
    return Table(path, columns, rows[1:], lines[1:])


def need_columns(table: Table, *layouts: str) -> None:
    """The columns are those of a layout as it is documented, such as ``time,angle[,scored]``.

    What stands in one pair of brackets is there whole or not at all; the order is free.
    """
    for layout in layouts:
        required, *optional = (part.split(",") for part in layout.replace("]", "").split("[,"))
        left = set(table.columns) - set(required)
        for group in optional:
            if left >= set(group):
                left -= set(group)
        if set(required) <= set(table.columns) and not left:
            return
    raise RecordingError(
        table.path,
        f"columns {','.join(table.columns)}",
        " or ".join(layouts),
        "renaming, adding or removing columns",
        line=1,
    )


def need_time(table: Table) -> None:
    """There is a column ``time``, whatever else there is."""
    if "time" not in table.columns:
        raise RecordingError(
            table.path,
            f"columns {','.join(table.columns)}",
            "one of the name time",
            "adding or renaming it",
            line=1,
        )


def numbers(table: Table, names: Sequence[str], *, blank: bool = False) -> Floats:
    """Columns as float64 (N, len(names)); with `blank`, empty cells are NaN."""
    values = np.empty((len(table.rows), len(names)))
    for j, name in enumerate(names):
        at = table.columns.index(name)
        for i, row in enumerate(table.rows):
            cell = row[at].strip()
            try:
                values[i, j] = np.nan if blank and not cell else float(cell)
            except ValueError:
                raise RecordingError(
                    table.path,
                    f"'{cell}'",
                    "a number",
                    "correcting the cell",
                    line=table.lines[i],
                    column=name,
                ) from None
    return values


def finite_numbers(table: Table, names: tuple[str, ...]) -> Floats:
    values = numbers(table, names)
    bad = np.argwhere(~np.isfinite(values))
    if bad.size:
        i, j = (int(at) for at in bad[0])
        raise RecordingError(
            table.path,
            f"{values[i, j]}",
            "a finite number",
            "removing the row",
            line=table.lines[i],
            column=names[j],
        )
    return values


def whole_or_blank(table: Table, names: Sequence[str]) -> Floats:
    """Columns (N, len(names)): in each row finite numbers, or NaN where all of its cells are blank."""
    values = numbers(table, names, blank=True)
    blank = np.isnan(values)
    bad = np.flatnonzero((blank.any(axis=1) & ~blank.all(axis=1)) | np.isinf(values).any(axis=1))
    if bad.size:
        row = int(bad[0])
        cells = [table.rows[row][table.columns.index(name)].strip() for name in names]
        raise RecordingError(
            table.path,
            f"'{','.join(cells)}'",
            f"{len(names)} finite numbers, or {len(names)} blank cells for what is not known",
            "completing or blanking them",
            line=table.lines[row],
            column=",".join(names),
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
        raise RecordingError(
            table.path,
            f"{values[row]}",
            "a finite number" if np.isinf(least) else f"a finite number, {least:g} or more",
            "blanking the cell, which means that none was reported",
            line=table.lines[row],
            column=name,
        )
    return values


def parse_seconds(text: str) -> int:
    """Decimal seconds to nanoseconds, exactly; digits beyond the ninth are rounded."""
    whole, _, part = text.partition(".")
    if whole.isdigit() and len(part) <= 9 and (part.isdigit() or not part):
        return int(whole) * NANOSECONDS + int(part.ljust(9, "0") or 0)
    return int((Decimal(text) * NANOSECONDS).to_integral_value())


def read_times(table: Table, *, repeated: bool = False) -> Times:
    """The column ``time`` (N,), which increases; with `repeated`, rows that follow may share a time."""
    at = table.columns.index("time")
    times = np.empty(len(table.rows), np.int64)
    for i, row in enumerate(table.rows):
        cell = row[at].strip()
        try:
            times[i] = parse_seconds(cell)
        except (InvalidOperation, ValueError, OverflowError):
            raise RecordingError(
                table.path,
                f"'{cell}'",
                "a time in seconds",
                "correcting the cell",
                line=table.lines[i],
                column="time",
            ) from None
    step = np.diff(times)
    backwards = np.flatnonzero(step < 0 if repeated else step <= 0)
    if backwards.size:
        i = int(backwards[0]) + 1
        raise RecordingError(
            table.path,
            f"{table.rows[i][at].strip()} after {table.rows[i - 1][at].strip()}",
            "times that do not decrease" if repeated else "times that increase",
            "sorting the rows" if repeated else "sorting the rows and removing duplicates",
            line=table.lines[i],
            column="time",
        )
    return times


def flags(table: Table, name: str) -> NDArray[np.bool_]:
    if name not in table.columns:
        return np.ones(len(table.rows), bool)
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
