"""Data files of the ASL format: stamps of whole nanoseconds, then numbers.

Header lines begin with ``#`` (or with ``time``) and may name the columns and their units. Cells are
separated by commas or by white space.
"""

import re
from collections.abc import Mapping, Sequence
from decimal import Decimal, InvalidOperation
from pathlib import Path
from typing import NamedTuple

import numpy as np

from jaxekf._support.errors import RecordingError
from jaxekf.io._csv_content import Content, read_content
from jaxekf.io._csv_text import WHITE_SPACE, read_rows
from jaxekf.io._csv_times import parsed_times
from jaxekf.io.csv_table import Table, check_increasing
from jaxekf.recordings.accounts import Indices, Reason
from jaxekf.recordings.types import Times

_COMMENT = re.compile(rb"#[^\n]*")
_HEADER_CELL = re.compile(r"\s*([^\[]*?)\s*(?:\[([^\]]*)\])?\s*")
_WORD_AND_UNIT = re.compile(r"[^\s\[]+(?:\s*\[[^\]]*\])?")

# Beginnings of a component's name, over the spellings in use: q_RS_w, qw, quat.w; w_RS_S_x, gyro_x.
_BEGINNINGS = {
    "p": r"(?:p|pos|position|t)?",
    "q": r"q(?:uat(?:ernion)?)?",
    "w": r"(?:w|g|gyro\w*?|omega|angular_velocity)",
    "a": r"(?:a|acc\w*?|alpha|linear_acceleration)",  # alpha: Kalibr's bag extractor
}
# Units that would be read wrong. Others are spelled in too many ways to list.
_FOREIGN = {"t": r"s|[mµu]s", "p": r"[cmµ]m|in|ft", "w": r".*(?:deg|°)", "a": r"m?g"}
_EXPECTED = {"t": "ns", "p": "m", "w": "rad/s", "a": "m/s^2"}


class Samples(NamedTuple):
    """The rows of a file, without exact duplicates."""

    table: Table
    time_ns: Times
    labels: tuple[str, ...]
    """The table's names of the components that were asked for."""
    named: bool
    """Whether a header names the columns; otherwise they are in the order of the format."""
    dropped: dict[str, Reason]
    """Exact duplicates, and a truncated last line, which gets the stamp of the row before it."""


class _Header(NamedTuple):
    """A line that begins with ``#`` or ``time``."""

    line: int
    text: str


class _Columns(NamedTuple):
    """The columns of the wanted components."""

    indices: list[int]
    labels: list[str]


def read_samples(path: Path, wanted: Sequence[str]) -> Samples:
    """Read a file.

    Parameters
    ----------
    path : Path
        The file.
    wanted : sequence of str
        Components such as ``px`` or ``qw``, found by the header's names; without a header, the columns from
        the second on are in this order.

    Raises
    ------
    RecordingError
        If the file is unreadable, empty or ragged, if it has too few columns, if a header names some of the
        components only, one twice or a unit that is not SI, and for stamps that are not whole nanoseconds
        or do not increase.
    """
    content, headers = _without_headers(read_content(path, "a file of samples"))
    first = re.compile(rb"[^\n]*\S[^\n]*").search(content.data)
    if first is None:
        raise RecordingError(path, "0 samples", "at least one", "exporting the recording again")
    delimiter = "," if b"," in first[0] else WHITE_SPACE
    width = first[0].count(b",") + 1 if delimiter == "," else len(first[0].split())
    named = _columns(path, headers, width, content.line(first.start()), wanted)
    columns = named or _Columns(list(range(1, len(wanted) + 1)), list(wanted))
    names = [str(number) for number in range(1, width + 1)]
    table = Table(path, tuple(names), read_rows(content, first.start(), names, delimiter))
    table = table.named({0: "time", **dict(zip(columns.indices, columns.labels, strict=True))})
    time_ns = _stamps(table)
    rows, originals = _duplicates(table, time_ns)
    dropped = {"repeated": Reason(table.lines[rows], time_ns[originals])} if rows.size else {}
    kept = np.ones(len(table), bool)
    kept[rows] = False
    table, time_ns = table.take(kept), time_ns[kept]
    check_increasing(table, time_ns)
    if table.text.cut:
        dropped["cut short"] = Reason(np.array(table.text.cut, np.intp), time_ns[-1:])
    return Samples(table, time_ns, tuple(columns.labels), named is not None, dropped)


# ---------------------------------------------------------------------------------------------
# Headers


def _without_headers(content: Content) -> tuple[Content, list[_Header]]:
    """The text with header lines made blank, which keeps the numbers of the others; and the headers."""
    data, headers = content.data, []

    def blank(found: re.Match[bytes]) -> bytes:
        begin = data.rfind(b"\n", 0, found.start()) + 1
        if data[begin : found.start()].strip():
            return found[0]
        headers.append(_Header(content.line(begin), found[0].decode("utf-8")))
        return b""

    rest = _COMMENT.sub(blank, data) if b"#" in data else data
    while found := re.match(rb"\s*(time[^\n]*)", rest, re.IGNORECASE):
        text = found[1].decode("utf-8")
        headers.append(_Header(rest.count(b"\n", 0, found.start(1)) + 1, text))
        rest = b"\n" * (headers[-1].line - 1) + rest[found.end() :]
    return content._replace(data=rest), sorted(headers)


def _columns(
    path: Path, headers: Sequence[_Header], width: int, line: int, wanted: Sequence[str]
) -> _Columns | None:
    """The columns that headers name; None if no header does."""
    if width <= len(wanted):
        got = f"{width} cells"
        expected = f"at least {len(wanted) + 1}: a time and {', '.join(wanted)}"
        raise RecordingError(path, got, expected, "a file that holds them all", line=line)
    found = [(header, _named(path, header, width, wanted)) for header in headers]
    named = [(header, columns) for header, columns in found if columns is not None]
    for header, columns in named[1:]:
        if columns.indices != named[0][1].indices:
            got = "a second header with other columns"
            expected = "one order for all rows"
            raise RecordingError(path, got, expected, "splitting the file there", line=header.line)
    return named[0][1] if named else None


def _named(path: Path, header: _Header, width: int, wanted: Sequence[str]) -> _Columns | None:
    """The columns that a header names; None for a remark, which names none."""
    names, units = _header_cells(header.text)
    found = _components(path, header.line, names, wanted)
    if not found or (len(names) != width and len(found) < len(wanted)):
        return None
    missing = [component for component in wanted if component not in found]
    if missing:
        got = f"a header without {', '.join(missing)}"
        hint = "naming every column, or removing the header to take them in this order"
        raise RecordingError(path, got, f"columns for {', '.join(wanted)}", hint, line=header.line)
    if len(names) != width:
        got = f"a header of {len(names)} columns over rows of {width} cells"
        expected = "as many names as cells"
        raise RecordingError(path, got, expected, "correcting the header", line=header.line)
    _check_units(path, header.line, units, found)
    indices = [found[component] for component in wanted]
    return _Columns(indices, [names[i] for i in indices])


def _header_cells(header: str) -> tuple[list[str], list[str]]:
    """Names and units of a header line."""
    header = header.lstrip("#").strip()
    cells = header.split(",") if "," in header else _WORD_AND_UNIT.findall(header)
    matches = [(_HEADER_CELL.fullmatch(cell), cell) for cell in cells]
    names = ["_".join((match[1] if match else cell).split()) for match, cell in matches]
    units = ["".join((match[2] or "").split()) if match else "" for match, _ in matches]
    return names, units


def _components(
    path: Path, line: int, names: Sequence[str], wanted: Sequence[str]
) -> dict[str, int]:
    """Column of every wanted component that has a name. The first column is the time."""
    found: dict[str, int] = {}
    for component in wanted:
        kind, axis = component
        pattern = re.compile(rf"{_BEGINNINGS[kind]}(?:[_.].*)?[_.]?{axis}", re.IGNORECASE)
        at = [i for i, name in enumerate(names) if i > 0 and pattern.fullmatch(name)]
        if len(at) > 1:
            got = f"columns {' and '.join(names[i] for i in at)}"
            expected = f"one for {component}"
            raise RecordingError(path, got, expected, "renaming all but one", line=line)
        if at:
            found[component] = at[0]
    return found


def _check_units(path: Path, line: int, units: Sequence[str], found: Mapping[str, int]) -> None:
    """Raise for a stated unit other than the one that is read."""
    for component, index in {"time": 0, **found}.items():
        kind = component[0]
        if kind in _FOREIGN and re.fullmatch(rf"(?:{_FOREIGN[kind]}).*", units[index].lower()):
            got = f"the unit {units[index]}"
            hint = "converting the column exactly"
            raise RecordingError(path, got, _EXPECTED[kind], hint, line=line, column=component)


# ---------------------------------------------------------------------------------------------
# Stamps and duplicates


def _stamps(table: Table) -> Times:
    """The column ``time`` (N,) in nanoseconds, exact, in any order.

    A stamp may have a point or an exponent if it states every nanosecond. ``1.5205303081819e+18`` is a
    whole number, but a rounded one: it is refused.
    """

    def parsed(row: int) -> int:
        cell, hint = table.number(row, "time"), "correcting the cell"
        try:
            value = Decimal(cell)
            if not value.is_finite() or value != value.to_integral_value():
                hint = "writing nanoseconds without a fraction"
            elif int(value.as_tuple().exponent) > 0:
                hint = "exporting all digits: this stamp was rounded"
            elif not -(2**63) <= value < 2**63:
                hint = "removing the row"
            else:
                return int(value)
        except InvalidOperation:
            pass
        raise table.error(row, "time", f"'{cell}'", "a time in whole nanoseconds", hint)

    return parsed_times(table.text, 0, Decimal(1), parsed)


def _duplicates(table: Table, time_ns: Times) -> tuple[Indices, Indices]:
    """Rows that repeat an earlier one exactly, anywhere in the file, and the rows that they repeat."""
    order = np.argsort(time_ns, kind="stable")
    same = np.flatnonzero(np.diff(time_ns[order]) == 0)
    first: dict[bytes, int] = {}
    found: list[tuple[int, int]] = []
    for row in np.unique(order[np.concatenate([same, same + 1])]).tolist():
        original = first.setdefault(table.text.row(row).strip(), row)
        if original != row:
            found.append((row, original))
    rows, originals = np.array(found, np.intp).reshape(-1, 2).T
    return rows, originals
