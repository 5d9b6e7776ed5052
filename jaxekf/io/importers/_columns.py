"""Text files of samples as the ASL format writes them: whole nanoseconds, then numbers.

Header lines begin with ``#`` (or with ``time``) and may name the columns and their units; cells are
separated by commas or by white space. The numbers are parsed by NumPy; line by line only to say
what is wrong with a file, and where.
"""

import re
from collections.abc import Mapping, Sequence
from decimal import Decimal, InvalidOperation
from pathlib import Path
from typing import NamedTuple

import numpy as np

from jaxekf._support.errors import RecordingError
from jaxekf.recordings.types import Floats, Times

_INTEGER = re.compile(r"\s*[+-]?[0-9]+\s*")
_BLANK = re.compile(r",\s*(?=,|$)")
_HEADER_CELL = re.compile(r"\s*([^\[]*?)\s*(?:\[([^\]]*)\])?\s*")
_WORD_AND_UNIT = re.compile(r"[^\s\[]+(?:\s*\[[^\]]*\])?")

# How a component's name begins, over the spellings in use: q_RS_w, qw, quat.w; w_RS_S_x, gyro_x.
_BEGINNINGS = {
    "p": r"(?:p|pos|position|t)?",
    "q": r"q(?:uat(?:ernion)?)?",
    "w": r"(?:w|g|gyro\w*?|omega|angular_velocity)",
    "a": r"(?:a|acc\w*?|alpha|linear_acceleration)",  # alpha: Kalibr's bag extractor
}
# Units that would be read wrong. Others are spelled in too many ways to list.
_FOREIGN = {"t": r"s|[mµu]s", "p": r"[cmµ]m|in|ft", "w": r".*(?:deg|°)", "a": r"m?g"}
_EXPECTED = {"t": "ns", "p": "m", "w": "rad/s", "a": "m/s^2"}


class Sheet(NamedTuple):
    """The rows of a file as text, exact duplicates dropped, with the number of each one's line."""

    path: Path
    rows: list[str]
    lines: list[int]
    headers: list[tuple[int, str]]
    separator: str | None
    """A comma, or None for white space."""
    width: int
    """Cells in every row."""
    repeated: list[tuple[int, int]]
    """Line of each exact duplicate, and the place in `rows` of what it repeats."""
    cut: list[int]
    """The file's last line where it ends too early: it is not among the rows."""


class Columns(NamedTuple):
    """Where the wanted components are."""

    indices: list[int]
    labels: list[str]
    """What to call them in a message."""
    named: bool
    """Whether a header named them; otherwise they are taken in the order of the format."""


def read_sheet(path: Path) -> Sheet:
    """The rows of a file, without a last one that is cut short.

    Raises `RecordingError` where it is unreadable, empty or ragged.
    """
    if not path.is_file():
        raise RecordingError(path, "no such file", "a file of samples", "another path")
    try:
        text = path.read_text("utf-8-sig")
    except (UnicodeDecodeError, OSError) as error:
        raise RecordingError(
            path, f"unreadable text ({error})", "UTF-8", "saving as UTF-8"
        ) from error
    headers: list[tuple[int, str]] = []
    first: dict[str, int] = {}
    places: dict[str, int] = {}
    repeated: list[tuple[int, int]] = []
    latest = 0
    for number, line in enumerate(text.splitlines(), start=1):
        row = line.strip()
        if not row:
            continue
        latest = number
        if row[0] == "#" or (not first and row[:4].lower() == "time"):
            headers.append((number, row))
            continue
        if row in first:
            repeated.append((number, places[row]))
        else:
            places[row] = len(first)
            first[row] = number
    if not first:
        raise RecordingError(path, "0 samples", "at least one", "exporting the recording again")
    rows, cut = list(first), []
    separator = "," if "," in rows[0] else None
    width = _cells(rows[0], separator)
    last = rows[-1]
    if len(rows) > 1 and first[last] == latest and _cells(last, separator) < width:
        cut.append(first.pop(last))
        rows.pop()
    for row, number in first.items():
        if _cells(row, separator) != width:
            raise RecordingError(
                path,
                f"{_cells(row, separator)} cells",
                f"{width} as in the first row",
                "completing the row or removing it",
                line=number,
            )
    return Sheet(path, rows, list(first.values()), headers, separator, width, repeated, cut)


def _cells(row: str, separator: str | None) -> int:
    return row.count(",") + 1 if separator else len(row.split())


# ---------------------------------------------------------------------------------------------
# Which column is what


def locate(sheet: Sheet, wanted: Sequence[str]) -> Columns:
    """The columns of the wanted components, such as ``px`` or ``qw``.

    By the header's names where it has them; otherwise as `wanted` stands, from the second on.
    Raises `RecordingError` for too few columns, and for a header that names some of them only, one
    twice, or a unit that is not SI.
    """
    if sheet.width <= len(wanted):
        raise RecordingError(
            sheet.path,
            f"{sheet.width} cells",
            f"at least {len(wanted) + 1}: a time and {', '.join(wanted)}",
            "a file that holds them all",
            line=sheet.lines[0],
        )
    columns = [_named(sheet, line, header, wanted) for line, header in sheet.headers]
    named = [
        (line, one)
        for (line, _), one in zip(sheet.headers, columns, strict=True)
        if one is not None
    ]
    for line, one in named[1:]:
        if one.indices != named[0][1].indices:
            raise RecordingError(
                sheet.path,
                "a second header with other columns",
                "one order for all rows",
                "splitting the file there",
                line=line,
            )
    if named:
        return named[0][1]
    return Columns(list(range(1, len(wanted) + 1)), list(wanted), named=False)


def _named(sheet: Sheet, line: int, header: str, wanted: Sequence[str]) -> Columns | None:
    """The columns that a header line names; None for a remark, which names none."""
    names, units = _header_cells(header)
    found = _components(sheet, line, names, wanted)
    if not found or (len(names) != sheet.width and len(found) < len(wanted)):
        return None
    missing = [component for component in wanted if component not in found]
    if missing:
        raise RecordingError(
            sheet.path,
            f"a header without {', '.join(missing)}",
            f"columns for {', '.join(wanted)}",
            "naming every column, or removing the header to take them in this order",
            line=line,
        )
    if len(names) != sheet.width:
        raise RecordingError(
            sheet.path,
            f"a header of {len(names)} columns over rows of {sheet.width} cells",
            "as many names as cells",
            "correcting the header",
            line=line,
        )
    _check_units(sheet, line, units, found)
    indices = [found[component] for component in wanted]
    return Columns(indices, [names[i] for i in indices], named=True)


def _header_cells(header: str) -> tuple[list[str], list[str]]:
    """Names and units of a header line."""
    header = header.lstrip("#").strip()
    cells = header.split(",") if "," in header else _WORD_AND_UNIT.findall(header)
    matches = [(_HEADER_CELL.fullmatch(cell), cell) for cell in cells]
    names = ["_".join((match[1] if match else cell).split()) for match, cell in matches]
    units = ["".join((match[2] or "").split()) if match else "" for match, _ in matches]
    return names, units


def _components(
    sheet: Sheet, line: int, names: Sequence[str], wanted: Sequence[str]
) -> dict[str, int]:
    """Column of every wanted component that the names give. The first column is the time."""
    found: dict[str, int] = {}
    for component in wanted:
        kind, axis = component
        pattern = re.compile(rf"{_BEGINNINGS[kind]}(?:[_.].*)?[_.]?{axis}", re.IGNORECASE)
        at = [i for i, name in enumerate(names) if i > 0 and pattern.fullmatch(name)]
        if len(at) > 1:
            raise RecordingError(
                sheet.path,
                f"columns {' and '.join(names[i] for i in at)}",
                f"one for {component}",
                "renaming all but one",
                line=line,
            )
        if at:
            found[component] = at[0]
    return found


def _check_units(sheet: Sheet, line: int, units: Sequence[str], found: Mapping[str, int]) -> None:
    """No stated unit is one whose numbers would be taken for another's."""
    for component, index in {"time": 0, **found}.items():
        kind = component[0]
        if kind in _FOREIGN and re.fullmatch(rf"(?:{_FOREIGN[kind]}).*", units[index].lower()):
            raise RecordingError(
                sheet.path,
                f"the unit {units[index]}",
                _EXPECTED[kind],
                "converting the column exactly",
                line=line,
                column=component,
            )


# ---------------------------------------------------------------------------------------------
# What they hold


def stamps(sheet: Sheet) -> Times:
    """The first column: int64 nanoseconds, exact and increasing. Raises `RecordingError`."""
    cells = [row.split(sheet.separator, 1)[0] for row in sheet.rows]
    if all(map(_INTEGER.fullmatch, cells)):
        whole = [int(cell) for cell in cells]
    else:
        whole = [_whole(sheet, at, cell) for at, cell in enumerate(cells)]
    try:
        times = np.array(whole, np.int64)
    except OverflowError:
        at = next(i for i, value in enumerate(whole) if not -(2**63) <= value < 2**63)
        raise _bad_time(sheet, at, cells[at], "removing the row") from None
    backwards = np.flatnonzero(times[1:] <= times[:-1])
    if backwards.size:
        at = int(backwards[0]) + 1
        raise RecordingError(
            sheet.path,
            f"{times[at]} after {times[at - 1]}",
            "times that increase",
            "sorting the rows and removing duplicates",
            line=sheet.lines[at],
            column="time",
        )
    return times


def _whole(sheet: Sheet, at: int, cell: str) -> int:
    """A stamp with a point or an exponent, where it says every nanosecond.

    ``1.5205303081819e+18`` is a whole number but was rounded on its way: it is refused.
    """
    try:
        value = Decimal(cell.strip())
    except InvalidOperation:
        raise _bad_time(sheet, at, cell, "correcting the cell") from None
    if not value.is_finite() or value != value.to_integral_value():
        raise _bad_time(sheet, at, cell, "writing nanoseconds without a fraction")
    if int(value.as_tuple().exponent) > 0:
        raise _bad_time(sheet, at, cell, "exporting all digits: this stamp was rounded")
    return int(value)


def _bad_time(sheet: Sheet, at: int, cell: str, hint: str) -> RecordingError:
    return RecordingError(
        sheet.path,
        f"'{cell.strip()}'",
        "a time in whole nanoseconds",
        hint,
        line=sheet.lines[at],
        column="time",
    )


def numbers(sheet: Sheet, columns: Columns) -> Floats:
    """The columns as float64 (N, columns); blank cells are NaN. Raises `RecordingError`."""
    rows = sheet.rows
    if sheet.separator:
        rows = [_BLANK.sub(",nan", row) for row in rows]
    try:
        return np.loadtxt(
            rows, delimiter=sheet.separator, usecols=columns.indices, comments=None, ndmin=2
        )
    except ValueError as error:
        raise _explain(sheet, columns, error) from None


def _explain(sheet: Sheet, columns: Columns, error: ValueError) -> RecordingError:
    """The first cell that is not a number."""
    for row, line in zip(sheet.rows, sheet.lines, strict=True):
        cells = [cell.strip() for cell in row.split(sheet.separator)]
        for index, label in zip(columns.indices, columns.labels, strict=True):
            try:
                float(cells[index] or "nan")
            except ValueError:
                return RecordingError(
                    sheet.path,
                    f"'{cells[index]}'",
                    "a number",
                    "correcting the cell",
                    line=line,
                    column=label,
                )
    return RecordingError(sheet.path, f"rows NumPy refuses ({error})", "numbers", "mending them")


def check_finite(sheet: Sheet, columns: Columns, values: Floats) -> None:
    """Raise `RecordingError` at the first value that is not finite."""
    bad = np.argwhere(~np.isfinite(values))
    if bad.size:
        i, j = (int(at) for at in bad[0])
        raise RecordingError(
            sheet.path,
            f"{values[i, j]}",
            "a finite number",
            "removing the row",
            line=sheet.lines[i],
            column=columns.labels[j],
        )
